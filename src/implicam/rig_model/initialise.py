"""One camera from known points, from no guess at all: eqs. (5) to (7) of docs/method.md.

A linear resection tries a ladder of lenses (geometry.resect_any_lens), Levenberg-Marquardt refines the winner with the
lens prior, and views that stay far off what most agree on are set aside, for the fit proper to judge.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from implicam.errors import FitError
from implicam.geometry import Bools, Floats, resect, resect_any_lens
from implicam.lenses import PERSPECTIVE_K, KannalaBrandt
from implicam.rig_model.camera import CentralCamera, Image, Prior, ProjectiveCamera
from implicam.rig_model.camera_model import CameraModel
from implicam.rig_model.field import empty_field
from implicam.rig_model.general_camera import AnyCamera
from implicam.rig_model.settings import DEFAULT_SETTINGS, RigModelSettings
from implicam.rig_model.training_data import MIN_POINTS_PER_CAMERA, TrainingData, pixel_extent
from implicam.row_order import describe_row_mistake
from implicam.threads import side_by_side

ENOUGH_VIEWS = 12
"""Views of a camera that are too many to call too few the reason why nothing fits them."""


class InitialCamera(NamedTuple):
    """A camera that fits, its prior, and the views (n,) it was started from; family: what kind it is;
    ordinary_px: the median error that an ordinary camera would leave, NaN where none was tried beside it."""

    camera: AnyCamera
    prior: Prior
    inliers: Bools
    family: str = "ordinary"
    ordinary_px: float = float("nan")


def start_camera(
    points: Floats,
    uv: Floats,
    image: Image,
    lens: str,
    settings: RigModelSettings = DEFAULT_SETTINGS,
    guess: AnyCamera | None = None,
) -> InitialCamera:
    """A camera from known points.

    Args:
        points: Known points (n, 3) in the working frame, all seen by the camera.
        uv: The pixels (n, 2) at which it sees them.
        image: Where pixels are measured from.
        lens: "central" or "none".
        settings: Which views do not start a fit, and the priors.
        guess: A camera that fitted most of these points a moment ago.

    Raises:
        FitError: The points do not fix a camera.
    """
    if len(points) < MIN_POINTS_PER_CAMERA:
        raise FitError(f"{len(points)} known points are seen; a camera needs at least {MIN_POINTS_PER_CAMERA}.")
    if lens == "none":
        return _start_projective(points, uv, image, settings)
    camera = guess
    if isinstance(camera, CentralCamera):
        error = np.linalg.norm(camera.pixel(points) - uv, axis=1)
        inliers = error <= max(settings.max_start_error_medians * float(np.nanmedian(error)), 1e-4 * image.half)
    if not isinstance(camera, CentralCamera) or inliers.sum() < max(MIN_POINTS_PER_CAMERA, len(points) / 2):
        found = resect_any_lens(points, uv, middle=image.centre)
        k = PERSPECTIVE_K if found.pinhole else np.zeros(4)
        lens_model = KannalaBrandt(found.focal, found.focal, *image.centre.tolist(), *k.tolist())
        camera, inliers = CentralCamera(lens_model, found.camera_from_world), found.inliers
    in_camera = camera.pose.apply(points[inliers])
    widest = float(np.arctan2(np.hypot(in_camera[:, 0], in_camera[:, 1]), in_camera[:, 2]).max())
    prior = camera.prior(image, widest, settings)
    return _refine(camera, prior, points, uv, image, inliers, settings.max_start_error_medians)


def _start_projective(points: Floats, uv: Floats, image: Image, settings: RigModelSettings) -> InitialCamera:
    # any lens at all tells the wrong views from the right
    inliers = resect_any_lens(points, uv, middle=image.centre).inliers
    for _ in range(5):
        camera = ProjectiveCamera(resect(points[inliers], uv[inliers]))
        error = np.linalg.norm(camera.pixel(points) - uv, axis=1)
        inside = ~(error > settings.max_start_error_medians * np.nanmedian(error))
        if inside.sum() < MIN_POINTS_PER_CAMERA or (inside == inliers).all():
            break
        inliers = inside
    front = ~np.isnan(camera.pixel(points)[:, 0])  # no linear projection sees what is behind it
    return InitialCamera(camera, camera.prior(image, 1.0, settings), inliers & front, "none")


def _refine(
    camera: AnyCamera, prior: Prior, points: Floats, uv: Floats, image: Image, inliers: Bools, max_medians: float
) -> InitialCamera:
    """Levenberg-Marquardt on the views kept, and again with those it brings back or shows to be wrong."""
    sd = 1e-3 * image.half
    for _ in range(4):
        camera = levenberg_marquardt(camera, prior, points[inliers], uv[inliers], sd)
        error = np.linalg.norm(camera.pixel(points) - uv, axis=1)
        sd = max(float(np.median(error[inliers])), 1e-5 * image.half)
        inside = error <= max(max_medians * float(np.median(error[inliers])), 1e-4 * image.half)
        if inside.sum() < MIN_POINTS_PER_CAMERA or (inside == inliers).all():
            break
        inliers = inside
    return InitialCamera(camera, prior, inliers)


def levenberg_marquardt(
    camera: AnyCamera, prior: Prior, points: Floats, uv: Floats, sd: float, max_steps: int = 300, gain: float = 1e-9
) -> AnyCamera:
    """The camera that minimises `sum (residual / sd)^2` plus the prior's own square, eq. (6).

    The damped equations are solved in units of their own diagonal: parameters differ by many orders of magnitude.

    Args:
        camera: Where to start.
        prior: Of its parameters.
        points: Known positions (n, 3).
        uv: Pixels (n, 2) at which the camera sees them.
        sd: Of the pixels.
        max_steps: Steps at most.
        gain: The part of the sum that a step must gain for another one to follow.
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


def start_rig(
    training: TrainingData, start: Callable[[int, Floats, Floats], InitialCamera]
) -> tuple[dict[int, InitialCamera], list[tuple[int, str]]]:
    """Start every camera that can be started.

    Args:
        training: What the cameras saw.
        start: Makes a camera from its number, known points (n, 3) and the pixels (n, 2) at which it sees them.

    Returns:
        The cameras by number, and (number, why not) of the others.

    Raises:
        FitError: Fewer than two can be started.
    """

    def one(c: int) -> InitialCamera | FitError:
        seen = training.camera_views[c]
        try:
            _check_places(training.points[seen.rows])
            started = start(c, training.points[seen.rows], seen.uv)
            check_start(started, training.points[seen.rows], seen.uv, training)
            return started
        except np.linalg.LinAlgError:
            return FitError(f"the known points do not fix it.{_explain_rows(training, c)}")
        except FitError as error:
            return type(error)(error.what + _explain_rows(training, c), why=error.why, fix=error.fix)

    started, uncalibrated = {}, []
    for c, found in enumerate(side_by_side(one, range(len(training.camera_views)))):
        if isinstance(found, FitError):
            uncalibrated.append((c, found.what))
        else:
            started[c] = found
    require_two_cameras(training, started, uncalibrated)
    return started, uncalibrated


def require_two_cameras(
    training: TrainingData, started: dict[int, InitialCamera], uncalibrated: list[tuple[int, str]]
) -> None:
    """Stop where fewer than two cameras are left.

    Args:
        training: What the fit starts from.
        started: The cameras that have a start, by their numbers.
        uncalibrated: (number, why) of the others.

    Raises:
        FitError: There are fewer than two; it says why of each of the others.
    """
    if len(started) < 2:
        raise FitError(
            f"{len(started)} of {len(training.names)} cameras can be calibrated; a position takes two.",
            why="; ".join(f"{training.names[c]}: {why}" for c, why in uncalibrated) or "there is one camera",
            fix=_advise(training, uncalibrated),
        )


def _explain_rows(training: TrainingData, c: int) -> str:
    """What its rows say of a camera that no model fits, as a sentence after another."""
    seen = training.camera_views[c]
    uv = np.full((len(training.points), 2), np.nan)
    uv[seen.rows] = seen.uv
    why = describe_row_mistake(training.points, uv)
    return f" {why[0].upper()}{why[1:]}." if why else ""


def _check_places(points: Floats) -> None:
    """FitError for many views of few places: to click a point again says nothing new of the camera."""
    places = len(np.unique(points, axis=0))
    if places < MIN_POINTS_PER_CAMERA <= len(points):
        raise FitError(
            f"its {len(points)} views are of {places} different positions, and it takes {MIN_POINTS_PER_CAMERA}."
        )


def _advise(training: TrainingData, uncalibrated: list[tuple[int, str]]) -> str:
    if not uncalibrated:
        return "use two cameras or more: a position is where their lines of sight meet"
    if sum(len(seen.rows) >= ENOUGH_VIEWS for seen in training.camera_views) >= 2:
        return "look whether pixels and known positions belong together: order of the rows, names, axes, units"
    return "show the cameras more known points, in the whole volume"


def check_start(started: InitialCamera, points: Floats, uv: Floats, training: TrainingData) -> None:
    """Stop at a start that too few views agree on, or that leaves too much.

    Args:
        started: The camera, and which of its views agree.
        points: (n, 3) known positions in the working frame, which it sees.
        uv: (n, 2) their pixels.
        training: What the fit starts from; its settings say what is too much.

    Raises:
        FitError: Fewer than `MIN_POINTS_PER_CAMERA` views agree, or their median error is too large.
    """
    settings = training.settings
    error = np.linalg.norm(started.camera.pixel(points) - uv, axis=1)[started.inliers]
    low, high = pixel_extent(uv)
    half = float((high - low).max()) / 2
    if len(error) < MIN_POINTS_PER_CAMERA:
        raise FitError(
            f"{len(error)} of its {len(uv)} views agree on one camera, and it takes {MIN_POINTS_PER_CAMERA}.",
            fix="add known points, or look for wrong detections",
        )
    without_lens = started.camera.kind == ProjectiveCamera.kind
    most = settings.max_start_error_half_extents_without_lens if without_lens else settings.max_start_error_half_extents
    if not np.median(error) < most * half:
        raise FitError(
            f"no camera sees the known points at these pixels: the best of all fits leaves {np.median(error):.3g} px."
        )


def lens_only_model(started: InitialCamera, image: Image, noise: float = 1.0) -> CameraModel:
    """A camera model that is nothing but the camera.

    Args:
        started: The camera and its prior.
        image: Where its pixels are measured from.
        noise: Pixels.

    Returns:
        The model, with a field that is zero everywhere.
    """
    field = empty_field(np.ones(2), np.zeros((1, 3)), 1.0)
    none = np.zeros((1, 2))
    return CameraModel(
        started.camera, started.camera, started.prior, image, field, 0.0, noise, none, family=started.family
    )
