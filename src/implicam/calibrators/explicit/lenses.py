"""Which lens model a camera gets: the one that predicts held-out pixels best, or the one that is named."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np

from implicam.errors import FitError, ImplicamError, PartError
from implicam.geometry import Floats
from implicam.lenses import LENSES, KannalaBrandt
from implicam.rig_model import CentralCamera

AUTO = "auto"

START_FAMILY = KannalaBrandt.family
"""The family of the cameras that known points and boards give first; the others start from it."""

USUAL_PIXELS = "square"
"""The name of the usual pixels (pixels.py)."""


class Choice(NamedTuple):
    """The lens model a camera got; rms errors in pixels at views held out, of each that was tried; its pixels; and the
    families that could not be tried, with the reason."""

    lens: str
    held_out: Mapping[str, float]
    pixels: str = USUAL_PIXELS
    dropped: Mapping[str, str] = MappingProxyType({})


def angles(camera: CentralCamera, points: Floats) -> Floats:
    """How far off a camera's axis points are.

    Args:
        camera: The camera.
        points: (n, 3) in the frame that its pose is from.

    Returns:
        (n,) radians.
    """
    there = camera.pose.apply(points)
    return np.asarray(np.arctan2(np.hypot(there[:, 0], there[:, 1]), there[:, 2]), dtype=np.float64)


def with_lens(camera: CentralCamera, family: str, points: Floats) -> CentralCamera:
    """The same camera with the nearest lens of another family.

    Args:
        camera: The camera.
        family: Name of the lens.
        points: (n, 3) in the frame that its pose is from, where the new lens is to be near to the old one.

    Returns:
        The camera in the same place.

    Raises:
        FitError: There is no such lens.
    """
    return CentralCamera(LENSES[family].nearest(camera.lens, camera.pose.apply(points)), camera.pose)


Made = TypeVar("Made")


def choose_lens(
    family: str, make: Callable[[str], Made], held_out: Callable[[Made], Floats], max_medians: float
) -> tuple[Made, Choice]:
    """The named family, or of all that can be started the one with the least squared errors at held-out views.

    A view that one of them keeps and another does not (NaN) counts as far off for that one, as `clipped` has it. A
    later family must be better than the first by more than the standard error of the difference: where there is little
    to tell them apart, the first, `START_FAMILY`, is the safer one. One that cannot be started, or whose package fails,
    is left out, with the reason in the choice.

    Args:
        family: Name of the lens, or `auto`.
        make: Makes a camera with a family of lenses, or raises FitError.
        held_out: Squared errors (n,) of such a camera at held-out views, pixels squared, NaN for those it does not
            keep.
        max_medians: A far-off view counts as the median of the squared errors times the square of this.

    Returns:
        What was made, and which family it is.

    Raises:
        FitError: No family, or not the one that is named, can be started.
        PartError: The lens that is named, of another package, fails.
    """
    if family != AUTO:
        with _named(family), _cure_in_reason():
            return make(family), Choice(family, {})
    started: dict[str, Made] = {}
    failure: FitError | None = None
    dropped: dict[str, str] = {}
    for name in dict.fromkeys([START_FAMILY, *LENSES]):
        try:
            with _named(name):
                started[name] = make(name)
        except FitError as error:
            failure, dropped[name] = error, error.what
        except PartError as error:
            dropped[name] = f"{error.what} {error.why}"
    if not started:
        assert failure is not None
        raise failure
    if len(started) == 1:
        ((name, only),) = started.items()
        return only, Choice(name, {}, dropped=dropped)
    squares: dict[str, Floats] = {}
    for name, one in started.items():
        try:
            with _named(name):
                squares[name] = held_out(one)
        except PartError as error:
            dropped[name] = f"{error.what} {error.why}"
    kept = ~np.logical_and.reduce([np.isnan(s) for s in squares.values()])
    squares = {name: _with_far(s[kept], max_medians) for name, s in squares.items()}
    best, *others = squares
    for name in others:
        gain = squares[best] - squares[name]
        if np.mean(gain) > np.std(gain) / np.sqrt(len(gain)):
            best = name
    rms = {name: float(np.sqrt(np.mean(s) / 2)) for name, s in squares.items()}
    return started[best], Choice(best, rms, dropped=dropped)


@contextmanager
def _named(family: str) -> Iterator[None]:
    """An error that is no answer of a lens of another package is said to be its, and not a mistake in implicam."""
    try:
        yield
    except (ImplicamError, np.linalg.LinAlgError):
        raise
    except Exception as error:
        package = LENSES.package_of(family)
        if package == "implicam":
            raise
        raise PartError(
            f"the lens {family!r} of the package {package} fails.",
            why=f"{type(error).__name__}: {' '.join(str(error).split())}",
            fix=f"check it in the tests of {package}: implicam.testing.check_lens",
        ) from error


@contextmanager
def _cure_in_reason() -> Iterator[None]:
    """What is told of a camera that is not calibrated is one sentence: the cure goes into it."""
    try:
        yield
    except FitError as error:
        if not error.fix:
            raise
        raise type(error)(f"{error.what.rstrip('.')}; {error.fix}.", why=error.why, fix=error.fix) from error


def dropped_notes(names: Sequence[str], choices: Sequence[Choice]) -> list[str]:
    """A note for each family of lenses that could not be tried, with its cameras and the reason of the first; and for
    each package that brings one under a name that is taken.

    Args:
        names: Of the calibrated cameras.
        choices: Of these, in the same order.

    Returns:
        The notes.
    """
    reasons: dict[str, dict[str, str]] = {}
    for name, choice in zip(names, choices, strict=True):
        for family, reason in choice.dropped.items():
            reasons.setdefault(family, {})[name] = reason
    notes = []
    for family, by_camera in reasons.items():
        whose = "any camera" if len(by_camera) == len(names) else ", ".join(by_camera)
        notes.append(f"lens {family} was not tried for {whose}: {next(iter(by_camera.values()))}")
    return notes + [error.what for family, error in LENSES.refused().items() if family not in reasons]


def _with_far(squares: Floats, max_medians: float) -> Floats:
    """(n,) squared errors, with NaN replaced by what `clipped` makes of an error that is far off."""
    return np.where(np.isnan(squares), max_medians**2 * np.nanmedian(squares), squares)


def clipped(errors: Floats, max_medians: float) -> Floats:
    """Errors, none of them so many medians off that it decides alone.

    Args:
        errors: (n,) lengths; what is not finite counts as far off.
        max_medians: How many medians an error may be.

    Returns:
        (n,).
    """
    errors = np.where(np.isfinite(errors), errors, np.inf)
    return np.minimum(errors, max_medians * float(np.median(errors)))
