"""Which lens model a camera gets: the one that predicts held-out pixels best, or the one that is named."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeVar

import numpy as np

from implicam.calibrators.forward_gp.lens import CentralCamera, Floats, Image, Prior
from implicam.calibrators.forward_gp.start import FAR, FEWEST, Started, levenberg_marquardt, start_camera
from implicam.cameras import BrownConrady, KannalaBrandt
from implicam.errors import FitError

FAMILIES: dict[str, type[BrownConrady] | type[KannalaBrandt]] = {
    "brown-conrady": BrownConrady,
    "kannala-brandt": KannalaBrandt,
}
"""The names of the lens models."""

AUTO = "auto"

WIDEST = np.radians(75.0)
"""Off the axis; a perspective lens is not tried beyond."""

FOLDS = 5

SHIFTED = 5.0
"""How many times wider the prior of the principal point is here than in forward-gp, whose field can make up for it."""


class Choice(NamedTuple):
    """The lens model a camera got, and rms errors in pixels at views held out, of each that was tried."""

    lens: str
    held_out: Mapping[str, float]


def name_of(camera: CentralCamera) -> str:
    """The name of a camera's lens model."""
    return next(name for name, kind in FAMILIES.items() if isinstance(camera.lens, kind))


def angles(camera: CentralCamera, points: Floats) -> Floats:
    """(n,) off the camera's axis, radians."""
    there = camera.pose.apply(points)
    return np.asarray(np.arctan2(np.hypot(there[:, 0], there[:, 1]), there[:, 2]), dtype=np.float64)


def as_brown_conrady(camera: CentralCamera, points: Floats) -> CentralCamera:
    """The same camera with a perspective lens: least squares on the pixels of points (n, 3). FitError where they are
    too far off the axis for one."""
    widest = float(angles(camera, points).max())
    if not widest < WIDEST:
        raise FitError(
            f"a perspective lens cannot look {np.degrees(widest):.0f}° off its axis.",
            fix="use kannala-brandt, or auto, for this camera",
        )
    there = camera.pose.apply(points)
    xy = there[:, :2] / there[:, 2:]
    uv = camera.pixel(points)
    r2 = np.sum(xy**2, axis=1)
    middle = np.array([camera.lens.cx, camera.lens.cy])
    flat, target = xy.ravel(), (uv - middle).ravel()
    # u - cx = fx x (1 + k1 r² + k2 r⁴): linear in fx, fx k1, fx k2; no third term, which only invites folds
    powers = np.repeat(r2, 2)[:, None] ** np.arange(3)
    a = np.linalg.lstsq(flat[:, None] * powers, target, rcond=None)[0]
    for k in ((a[1] / a[0], a[2] / a[0]), (a[1] / a[0], 0.0), (0.0, 0.0)):
        lens = BrownConrady(float(a[0]), float(a[0]), *middle.tolist(), *map(float, k))
        if a[0] > 0 and lens.pixel_from_camera_point(there)[1].all():
            return CentralCamera(lens, camera.pose)
    raise FitError("no perspective lens sees these points.", fix="use kannala-brandt, or auto, for this camera")


Made = TypeVar("Made")


def chosen(
    family: str, candidates: Mapping[str, Callable[[], Made]], held_out: Callable[[Made], Floats]
) -> tuple[Made, Choice]:
    """The named family, or of all that can be started the one with the least squared errors (n,) at held-out views.

    A later candidate must be better than the first by more than the standard error of the difference: where there is
    little to tell them apart, the first is the safer one.
    """
    if family != AUTO:
        return candidates[family](), Choice(family, {})
    started: dict[str, Made] = {}
    failure: FitError | None = None
    for name, make in candidates.items():
        try:
            started[name] = make()
        except FitError as error:
            failure = error
    if not started:
        assert failure is not None
        raise failure
    if len(started) == 1:
        ((name, only),) = started.items()
        return only, Choice(name, {})
    squares = {name: held_out(one) for name, one in started.items()}
    best, *others = squares
    for name in others:
        gain = squares[best] - squares[name]
        if np.mean(gain) > np.std(gain) / np.sqrt(len(gain)):
            best = name
    return started[best], Choice(best, {name: float(np.sqrt(np.mean(s) / 2)) for name, s in squares.items()})


def start_with_lens(points: Floats, uv: Floats, image: Image, family: str) -> tuple[Started, Choice]:
    """A camera from known points (n, 3), all seen at uv (n, 2), and its lens model; FitError as `start_camera`."""
    first = _freely_centred(start_camera(points, uv, image, "central"), points, uv, image)
    assert isinstance(first.camera, CentralCamera)
    bent = first.camera

    def perspective() -> Started:
        kept = points[first.kept]
        camera = as_brown_conrady(bent, kept)
        prior = freely_centred(camera.prior(image, float(angles(bent, kept).max())))
        fitted = levenberg_marquardt(camera, prior, kept, uv[first.kept], _sd(camera, kept, uv[first.kept], image))
        return Started(fitted, prior, first.kept)

    candidates: dict[str, Callable[[], Started]] = {"kannala-brandt": lambda: first, "brown-conrady": perspective}
    return chosen(family, candidates, lambda started: _held_out(started, points, uv, image))


def freely_centred(prior: Prior) -> Prior:
    """The prior without a strong opinion on where the lens stands over the sensor: shifted lenses exist."""
    precision = prior.precision.copy()
    precision[2:4, 2:4] /= SHIFTED**2
    return prior._replace(precision=precision)


def _freely_centred(started: Started, points: Floats, uv: Floats, image: Image) -> Started:
    """The start refined with that prior, and with the views that it then explains."""
    assert isinstance(started.camera, CentralCamera)
    prior, kept, camera = freely_centred(started.prior), started.kept, started.camera
    for _ in range(3):
        sd = _sd(camera, points[kept], uv[kept], image)
        fitted = levenberg_marquardt(camera, prior, points[kept], uv[kept], sd)
        assert isinstance(fitted, CentralCamera)
        camera = fitted
        error = np.linalg.norm(camera.pixel(points) - uv, axis=1)
        inside = np.asarray(error <= max(FAR * float(np.median(error[kept])), 1e-4 * image.half))
        if inside.sum() < FEWEST or (inside == kept).all():
            break
        kept = inside
    return Started(camera, prior, kept)


def _sd(camera: CentralCamera, points: Floats, uv: Floats, image: Image) -> float:
    error = np.linalg.norm(camera.pixel(points) - uv, axis=1)
    return max(float(np.nanmedian(error)), 1e-5 * image.half)


def _held_out(started: Started, points: Floats, uv: Floats, image: Image) -> Floats:
    """(n,) squared errors of views in `FOLDS` random folds, each predicted from the others; far ones count little."""
    points, uv = points[started.kept], uv[started.kept]
    assert isinstance(started.camera, CentralCamera)
    sd = _sd(started.camera, points, uv, image)
    fold = np.random.default_rng(0).permutation(np.arange(len(points)) % FOLDS)
    errors = np.full(len(points), np.inf)
    for k in range(FOLDS):
        others = fold != k
        camera = levenberg_marquardt(started.camera, started.prior, points[others], uv[others], sd)
        errors[~others] = np.linalg.norm(camera.pixel(points[~others]) - uv[~others], axis=1)
    return clipped(errors) ** 2


def clipped(errors: Floats) -> Floats:
    """Errors, none of them so far off that it decides alone."""
    errors = np.where(np.isfinite(errors), errors, np.inf)
    return np.minimum(errors, FAR * float(np.median(errors)))
