"""One camera from known points, from no guess at all: eqs. (5) to (7) of docs/method.md.

A linear resection tries a ladder of lenses (geometry.resect_any_lens), Levenberg-Marquardt refines the winner with the
lens prior, and views that stay far off what most agree on are set aside, for the fit proper to judge.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.general_camera import AnyCamera
from implicam.calibrators.forward_gp.lens import (
    TANGENT,
    CentralCamera,
    Floats,
    Image,
    Prior,
    ProjectiveCamera,
)
from implicam.cameras import KannalaBrandt
from implicam.errors import FitError
from implicam.geometry import FAR_OUT, resect, resect_any_lens

Bools = NDArray[np.bool_]

FEWEST = 8
"""Known points that a camera must see: 16 numbers for the 14 of lens and pose."""

FAR = 8.0
"""Times the median error: farther off, a view does not start the fit; the fit itself has the finer test."""


def pixel_extent(uv: Floats) -> tuple[Floats, Floats]:
    """The lowest and highest (2,) of pixels (n, 2), wild ones aside."""
    away = np.linalg.norm(uv - np.median(uv, axis=0), axis=1)
    inside = uv[away <= FAR_OUT * np.quantile(away, 0.75)]
    return inside.min(axis=0), inside.max(axis=0)


class Started(NamedTuple):
    """A camera that fits, its prior, and the views (n,) it was started from; family: what kind it is;
    ordinary_px: the median error that an ordinary camera would leave, NaN where none was tried beside it."""

    camera: AnyCamera
    prior: Prior
    kept: Bools
    family: str = "ordinary"
    ordinary_px: float = float("nan")


def start_camera(points: Floats, uv: Floats, image: Image, lens: str) -> Started:
    """A camera of the kind `lens` from points (n, 3), all seen at uv (n, 2); FitError where they do not fix one."""
    if len(points) < FEWEST:
        raise FitError(f"{len(points)} known points are seen; a camera needs at least {FEWEST}.")
    if lens == "none":
        return _start_projective(points, uv, image)
    found = resect_any_lens(points, uv, middle=image.centre)
    k = TANGENT if found.pinhole else np.zeros(4)
    camera = CentralCamera(
        KannalaBrandt(found.focal, found.focal, *image.centre.tolist(), *k.tolist()), found.camera_from_world
    )
    return _with_prior(camera, points, uv, image, found.kept)


def start_again(camera: AnyCamera, points: Floats, uv: Floats, image: Image, lens: str) -> Started:
    """The same from a camera that fitted most of these points a moment ago; from no guess where it does not."""
    error = np.linalg.norm(camera.pixel(points) - uv, axis=1)
    kept = error <= max(FAR * float(np.nanmedian(error)), 1e-4 * image.half)
    if not isinstance(camera, CentralCamera) or kept.sum() < max(FEWEST, len(points) / 2):
        return start_camera(points, uv, image, lens)
    return _with_prior(camera, points, uv, image, kept)


def _with_prior(camera: CentralCamera, points: Floats, uv: Floats, image: Image, kept: Bools) -> Started:
    there = camera.pose.apply(points[kept])
    widest = float(np.arctan2(np.hypot(there[:, 0], there[:, 1]), there[:, 2]).max())
    return _refined(camera, camera.prior(image, widest), points, uv, image, kept)


def _start_projective(points: Floats, uv: Floats, image: Image) -> Started:
    kept = resect_any_lens(points, uv, middle=image.centre).kept  # any lens at all tells the wrong views from the right
    for _ in range(5):
        camera = ProjectiveCamera(resect(points[kept], uv[kept]))
        error = np.linalg.norm(camera.pixel(points) - uv, axis=1)
        inside = ~(error > FAR * np.nanmedian(error))
        if inside.sum() < FEWEST or (inside == kept).all():
            break
        kept = inside
    front = ~np.isnan(camera.pixel(points)[:, 0])  # no linear projection sees what is behind it
    return Started(camera, camera.prior(image, 1.0), kept & front, "none")


def _refined(camera: AnyCamera, prior: Prior, points: Floats, uv: Floats, image: Image, kept: Bools) -> Started:
    """Levenberg-Marquardt on the views kept, and again with those it brings back or shows to be wrong."""
    sd = 1e-3 * image.half
    for _ in range(4):
        camera = levenberg_marquardt(camera, prior, points[kept], uv[kept], sd)
        error = np.linalg.norm(camera.pixel(points) - uv, axis=1)
        sd = max(float(np.median(error[kept])), 1e-5 * image.half)
        inside = error <= max(FAR * float(np.median(error[kept])), 1e-4 * image.half)
        if inside.sum() < FEWEST or (inside == kept).all():
            break
        kept = inside
    return Started(camera, prior, kept)


def levenberg_marquardt(
    camera: AnyCamera, prior: Prior, points: Floats, uv: Floats, sd: float, max_steps: int = 300, gain: float = 1e-9
) -> AnyCamera:
    """The camera that minimises `sum (residual / sd)^2` plus the prior's own square, eq. (6).

    It ends after `max_steps`, or with a step that gains less than the part `gain`. The damped equations are solved in
    units of their own diagonal: parameters differ by many orders of magnitude.
    """

    def cost(candidate: AnyCamera) -> float:
        if not candidate.sane:
            return np.inf
        off = prior.mean - candidate.parameters
        total = float(np.sum((uv - candidate.pixel(points)) ** 2) / sd**2 + off @ prior.precision @ off)
        return total if np.isfinite(total) else np.inf

    best, damping = cost(camera), 1e-3
    for _ in range(max_steps):
        view = camera.view(points)
        J = view.by_parameters.reshape(-1, camera.size) / sd
        off = prior.mean - camera.parameters
        normal = J.T @ J + prior.precision
        gradient = J.T @ ((uv - view.uv).ravel() / sd) + prior.precision @ off
        if not np.isfinite(normal).all():
            break
        scale = 1 / np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
        scaled, pull = normal * scale[:, None] * scale, gradient * scale
        previous = best
        while damping < 1e9:
            try:
                step = np.asarray(scale * np.linalg.solve(scaled + damping * np.eye(len(pull)), pull), dtype=np.float64)
            except np.linalg.LinAlgError:
                damping *= 6
                continue
            candidate = camera.moved(step)
            now = cost(candidate)
            if now < best:
                camera, best, damping = candidate, now, max(damping / 8, 1e-12)
                break
            damping *= 6
        if best > previous * (1 - gain):
            break
    return camera
