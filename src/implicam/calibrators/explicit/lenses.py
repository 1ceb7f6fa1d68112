"""Which lens model a camera gets: the one that predicts held-out pixels best, or the one that is named."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeVar

import numpy as np

from implicam.errors import FitError
from implicam.geometry import Floats
from implicam.lenses import LENSES, KannalaBrandt
from implicam.rig_model import CentralCamera, RigModelSettings

AUTO = "auto"

START_FAMILY = KannalaBrandt.family
"""The family of the cameras that known points and boards give first; the others start from it."""

FOLDS = 5

USUAL_PIXELS = "square"
"""The name of the usual pixels (pixels.py)."""


class Choice(NamedTuple):
    """The lens model a camera got; rms errors in pixels at views held out, of each that was tried; and its pixels."""

    lens: str
    held_out: Mapping[str, float]
    pixels: str = USUAL_PIXELS


def angles(camera: CentralCamera, points: Floats) -> Floats:
    """(n,) off the camera's axis, radians."""
    there = camera.pose.apply(points)
    return np.asarray(np.arctan2(np.hypot(there[:, 0], there[:, 1]), there[:, 2]), dtype=np.float64)


def with_lens(camera: CentralCamera, family: str, points: Floats) -> CentralCamera:
    """The same camera with the lens of another family that sees points (n, 3) nearest to where it sees them; FitError
    where there is none."""
    return CentralCamera(LENSES[family].nearest(camera.lens, camera.pose.apply(points)), camera.pose)


Made = TypeVar("Made")


def choose_lens(family: str, make: Callable[[str], Made], held_out: Callable[[Made], Floats]) -> tuple[Made, Choice]:
    """The named family, or of all that can be started the one with the least squared errors (n,) at held-out views.

    A view that one of them keeps and another does not (NaN) counts as far off for that one, as `clipped` has it. A
    later family must be better than the first by more than the standard error of the difference: where there is little
    to tell them apart, the first, `START_FAMILY`, is the safer one.
    """
    if family != AUTO:
        return make(family), Choice(family, {})
    started: dict[str, Made] = {}
    failure: FitError | None = None
    for name in dict.fromkeys([START_FAMILY, *LENSES]):
        try:
            started[name] = make(name)
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
