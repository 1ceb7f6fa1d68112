"""One camera from known points, from no guess: its lens model and what its pixels are like.

A linear resection tries a ladder of lenses and of pixel shapes (geometry.resect_any_pixels), Levenberg-Marquardt
refines the winner, evidence chooses among the priors of pixels.py, held-out views among the lens models.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from implicam.calibrators.explicit.lenses import START_FAMILY, Choice, angles, choose_lens, clipped, with_lens
from implicam.calibrators.explicit.pixels import (
    ASPECTS,
    Pixels,
    kinds,
    log_density_at_peak,
    noise_prior,
    prior_of,
    square,
)
from implicam.calibrators.explicit.settings import ExplicitSettings
from implicam.errors import FitError
from implicam.geometry import Bools, Floats, resect_any_pixels
from implicam.lenses import PERSPECTIVE_K, KannalaBrandt
from implicam.rig_model import (
    MIN_POINTS_PER_CAMERA,
    CentralCamera,
    Image,
    InitialCamera,
    levenberg_marquardt,
)


class MirroredError(FitError):
    """The pictures of a camera are mirrored, or the known positions are."""


class _Candidate(NamedTuple):
    """A camera fitted with the prior of some pixels; kept (n,): the views it was fitted to."""

    started: InitialCamera
    camera: CentralCamera
    pixels: Pixels

    @property
    def inliers(self) -> Bools:
        return self.started.inliers


class Scene(NamedTuple):
    """What one camera saw: known points (n, 3) at pixels uv (n, 2) of an image; settings: what is usual."""

    points: Floats
    uv: Floats
    image: Image
    settings: ExplicitSettings

    def select(self, some: Bools) -> Scene:
        """Some of the points.

        Args:
            some: (n,) which.

        Returns:
            The scene with these alone.
        """
        return self._replace(points=self.points[some], uv=self.uv[some])


def start_with_lens(
    points: Floats, uv: Floats, image: Image, family: str, settings: ExplicitSettings
) -> tuple[InitialCamera, Choice]:
    """A camera from known points, from no guess, with its lens model and pixels.

    Args:
        points: (n, 3) known positions in the working frame.
        uv: (n, 2) pixels at which all of them are seen.
        image: Where pixels are measured from.
        family: Name of the lens, or `auto`.
        settings: Priors and thresholds.

    Returns:
        The start of the camera, and which lens it got.

    Raises:
        FitError: The points are too few, or do not fix a camera.
        MirroredError: A mirrored camera would see them so.
    """
    if len(points) < MIN_POINTS_PER_CAMERA:
        raise FitError(f"{len(points)} known points are seen; a camera needs at least {MIN_POINTS_PER_CAMERA}.")
    scene = Scene(points, uv, image, settings)
    first = _resected(scene)
    _check_mirror(first, scene)
    tried = _with_pixels([first], scene)

    def with_family(name: str) -> _Candidate:
        if name == START_FAMILY:
            return tried[0]
        starts = [one._replace(camera=with_lens(one.camera, name, points[one.inliers])) for one in tried]
        return _with_pixels(starts, scene)[0]

    found, choice = choose_lens(
        family, with_family, lambda one: _held_out(one.started, scene), settings.max_start_error_medians
    )
    return found.started, choice._replace(pixels=found.pixels.name)


def _resected(scene: Scene) -> _Candidate:
    """The ladder's best, refined with the usual pixels where they fit, and with any where they do not."""
    image, usual = scene.image, square(scene.settings)
    found, aspect = resect_any_pixels(scene.points, scene.uv, middle=image.centre, aspects=ASPECTS)
    k = PERSPECTIVE_K if found.pinhole else np.zeros(4)
    lens = KannalaBrandt(found.focal, found.focal * aspect, *image.centre.tolist(), *k.tolist())
    pixels = usual if aspect == 1 else kinds(usual, scene.settings)[1]
    return _refined(CentralCamera(lens, found.camera_from_world), pixels, found.inliers, scene, 1e-3)


def _with_pixels(starts: Sequence[_Candidate], scene: Scene) -> list[_Candidate]:
    """The cameras refined with each prior of their pixels that may be right, the most probable one first; one alone
    where the usual one is clearly right."""
    settings = scene.settings
    usual, *between, widest = kinds(square(settings, settings.centre_prior_widening_ratio), settings)

    def fitted(pixels: Pixels, start: _Candidate) -> _Candidate:
        return _refined(start.camera, pixels, start.inliers, scene)

    judged = _Evidence(scene)
    found = [fitted(usual, starts[0]), fitted(widest, starts[0])]
    simple, free = judged.of(found)
    if free < simple - settings.max_usual_gain_nats:
        return found[:1]
    found = [found[0], *(fitted(pixels, starts[0]) for pixels in between), found[1]]
    evidence = judged.of(found)
    best = found[int(np.argmax(evidence))]
    found = [one for one, log in zip(found, evidence, strict=True) if log > max(evidence) - settings.max_lacking_nats]
    for i, one in enumerate(found):  # an unusual lens has optima that are not the best
        others = [start for start in (best, *starts[1:]) if start is not one]
        tries = [one, *(fitted(one.pixels, start) for start in others)]
        found[i] = tries[int(np.argmax(judged.of(tries)))]
    order = np.argsort(judged.of(found), kind="stable")[::-1]
    return [found[i] for i in order]


def _refined(
    camera: CentralCamera, pixels: Pixels, inliers: Bools, scene: Scene, first: float | None = None
) -> _Candidate:
    """Levenberg-Marquardt on the views kept, and again with those it brings back or shows to be wrong; first: the noise
    to begin with in half the longer side, where the start is rough."""
    points, uv, image, settings = scene
    sd = _sd(camera, scene.select(inliers)) if first is None else first * image.half
    for _ in range(4):
        widest = float(angles(camera, points[inliers]).max())
        prior = prior_of(camera, image, widest, pixels, settings)
        fitted = levenberg_marquardt(camera, prior, points[inliers], uv[inliers], sd)
        assert isinstance(fitted, CentralCamera)
        camera = fitted
        error = np.linalg.norm(camera.pixel(points) - uv, axis=1)
        sd = max(float(np.median(error[inliers])), 1e-5 * image.half)
        limit = settings.max_start_error_medians * float(np.median(error[inliers]))
        inside = np.asarray(error <= max(limit, 1e-4 * image.half))
        if inside.sum() < MIN_POINTS_PER_CAMERA or (inside == inliers).all():
            break
        inliers = inside
    return _Candidate(InitialCamera(camera, prior, inliers), camera, pixels)


class _Evidence:
    """Judges candidates on the same views; what it has judged it knows."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.known: dict[tuple[int, bytes], tuple[_Candidate, float]] = {}

    def of(self, found: list[_Candidate]) -> list[float]:
        """Log marginal likelihood of each, by Laplace's method at its best noise, on the views that all keep."""
        common = np.logical_and.reduce([one.inliers for one in found])
        if common.sum() < MIN_POINTS_PER_CAMERA:
            common = found[-1].inliers
        for one in found:
            key = (id(one), common.tobytes())  # it is kept in the value, so that no other can have its id
            if key not in self.known:
                self.known[key] = (one, _log_evidence(one, self.scene.select(common)))
        return [self.known[id(one), common.tobytes()][1] for one in found]


def _log_evidence(one: _Candidate, scene: Scene) -> float:
    points, uv, image, settings = scene
    camera, prior = one.camera, one.started.prior
    sd = _sd(camera, scene)
    for _ in range(3):
        fitted = levenberg_marquardt(camera, prior, points, uv, sd)
        assert isinstance(fitted, CentralCamera)
        camera = fitted
        view = camera.view(points)
        J = view.by_parameters.reshape(-1, camera.size)
        squares = float(np.sum((uv - view.uv) ** 2))
        if not np.isfinite(squares) or not np.isfinite(J).all():
            return -np.inf
        normal = J.T @ J / sd**2 + prior.precision
        scale = 1 / np.sqrt(np.diag(normal))
        used = float(np.trace(np.linalg.solve(normal * scale[:, None] * scale, (J * scale).T @ (J * scale)))) / sd**2
        now = np.sqrt(max(squares / max(J.shape[0] - used, 1.0), (1e-5 * image.half) ** 2))
        if abs(np.log(now / sd)) < 0.02:
            break
        sd = float(now)
    off = prior.mean - camera.parameters
    determinant = np.linalg.slogdet(normal * scale[:, None] * scale)[1] - 2 * np.sum(np.log(scale))
    likelihood = -J.shape[0] * np.log(sd) - 0.5 * squares / sd**2 - 0.5 * float(off @ prior.precision @ off)
    before = log_density_at_peak(prior, camera, image, one.pixels) + noise_prior(sd, image, settings)
    return float(likelihood - 0.5 * determinant + before)


def _check_mirror(found: _Candidate, scene: Scene) -> None:
    """MirroredError where the picture turned left to right fits far better than it does as it is."""
    points, uv, image, settings = scene
    left = median_pixel_error(found.camera, points, uv)
    if left < settings.min_mirrored_error_half_sides * image.half:
        return
    turned = np.column_stack([2 * image.centre[0] - uv[:, 0], uv[:, 1]])
    try:
        other = _resected(scene._replace(uv=turned))
    except FitError:
        return
    mirrored = median_pixel_error(other.camera, points, turned)
    if mirrored < settings.max_mirrored_ratio * left:
        raise MirroredError(
            f"its pictures are mirrored, or the known positions are: as they are {left:.3g} px are left, mirrored "
            f"{mirrored:.2g} px."
        )


def median_pixel_error(camera: CentralCamera, points: Floats, uv: Floats) -> float:
    """The median distance of points, where a camera sees them, from their pixels.

    Args:
        camera: The camera.
        points: (n, 3) in the frame that its pose is from.
        uv: (n, 2) pixels.

    Returns:
        Pixels; a point that the camera cannot see is infinitely far.
    """
    error = np.linalg.norm(camera.pixel(points) - uv, axis=1)
    return float(np.median(np.where(np.isfinite(error), error, np.inf)))


def _sd(camera: CentralCamera, scene: Scene) -> float:
    error = np.linalg.norm(camera.pixel(scene.points) - scene.uv, axis=1)
    return max(float(np.nanmedian(error)), 1e-5 * scene.image.half)


def _held_out(started: InitialCamera, scene: Scene) -> Floats:
    """(n,) squared errors of views in random folds, each predicted from the others; far ones count little, and views
    that the camera could not keep are NaN."""
    squares, folds = np.full(len(scene.points), np.nan), scene.settings.point_folds
    kept = scene.select(started.inliers)
    points, uv = kept.points, kept.uv
    assert isinstance(started.camera, CentralCamera)
    sd = _sd(started.camera, kept)
    fold = np.random.default_rng(0).permutation(np.arange(len(points)) % folds)
    errors = np.full(len(points), np.inf)
    for k in range(folds):
        others = fold != k
        camera = levenberg_marquardt(started.camera, started.prior, points[others], uv[others], sd)
        errors[~others] = np.linalg.norm(camera.pixel(points[~others]) - uv[~others], axis=1)
    squares[started.inliers] = clipped(errors, scene.settings.max_start_error_medians) ** 2
    return squares
