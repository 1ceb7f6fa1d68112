"""Which lens model a camera gets: the one that predicts held-out pixels best, or the one that is named."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeVar

import numpy as np

from implicam.cameras import BrownConrady, KannalaBrandt
from implicam.errors import FitError
from implicam.geometry import Floats
from implicam.rig_model import CentralCamera, RigModelSettings

FAMILIES: dict[str, type[BrownConrady] | type[KannalaBrandt]] = {
    "brown-conrady": BrownConrady,
    "kannala-brandt": KannalaBrandt,
}
"""The names of the lens models."""

AUTO = "auto"

MAX_PERSPECTIVE_ANGLE_RAD = np.radians(75.0)
"""Off the axis; a perspective lens is not tried beyond."""

FOLDS = 5

USUAL_PIXELS = "square"
"""The name of the usual pixels (pixels.py)."""


class Choice(NamedTuple):
    """The lens model a camera got; rms errors in pixels at views held out, of each that was tried; and its pixels."""

    lens: str
    held_out: Mapping[str, float]
    pixels: str = USUAL_PIXELS


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
    if not widest < MAX_PERSPECTIVE_ANGLE_RAD:
        raise FitError(
            f"a perspective lens cannot look {np.degrees(widest):.0f}° off its axis.",
            fix="use kannala-brandt, or auto, for this camera",
        )
    there = camera.pose.apply(points)
    xy = there[:, :2] / there[:, 2:]
    uv = camera.pixel(points)
    r2 = np.sum(xy**2, axis=1)
    middle, shape = np.array([camera.lens.cx, camera.lens.cy]), np.array([1.0, camera.lens.fy / camera.lens.fx])
    flat, target = xy.ravel(), ((uv - middle) / shape).ravel()
    # u - cx = fx x (1 + k1 r² + k2 r⁴): linear in fx, fx k1, fx k2; no third term, which only invites folds
    powers = np.repeat(r2, 2)[:, None] ** np.arange(3)
    a = np.linalg.lstsq(flat[:, None] * powers, target, rcond=None)[0]
    for k in ((a[1] / a[0], a[2] / a[0]), (a[1] / a[0], 0.0), (0.0, 0.0)):
        lens = BrownConrady(float(a[0]), float(a[0] * shape[1]), *middle.tolist(), *map(float, k))
        if a[0] > 0 and lens.pixel_from_camera_point(there)[1].all():
            return CentralCamera(lens, camera.pose)
    raise FitError("no perspective lens sees these points.", fix="use kannala-brandt, or auto, for this camera")


Made = TypeVar("Made")


def chosen(
    family: str, candidates: Mapping[str, Callable[[], Made]], held_out: Callable[[Made], Floats]
) -> tuple[Made, Choice]:
    """The named family, or of all that can be started the one with the least squared errors (n,) at held-out views.

    A view that one of them keeps and another does not (NaN) counts as far off for that one, as `clipped` has it. A
    later candidate must be better than the first by more than the standard error of the difference: where there is
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
    kept = ~np.logical_and.reduce([np.isnan(s) for s in squares.values()])
    squares = {name: _with_far(s[kept]) for name, s in squares.items()}
    best, *others = squares
    for name in others:
        gain = squares[best] - squares[name]
        if np.mean(gain) > np.std(gain) / np.sqrt(len(gain)):
            best = name
    return started[best], Choice(best, {name: float(np.sqrt(np.mean(s) / 2)) for name, s in squares.items()})


def _with_far(squares: Floats) -> Floats:
    """(n,) squared errors, with NaN replaced by what `clipped` makes of an error that is far off."""
    return np.where(np.isnan(squares), RigModelSettings.max_start_error_medians**2 * np.nanmedian(squares), squares)


def clipped(errors: Floats) -> Floats:
    """Errors, none of them so far off that it decides alone."""
    errors = np.where(np.isfinite(errors), errors, np.inf)
    return np.minimum(errors, RigModelSettings.max_start_error_medians * float(np.median(errors)))
