"""What every method offers, so that everything above works with each of them.

A *calibrator* is a method with its options, a frozen value; `fit` returns a *calibration*, the fitted map of the rig.
To add a method: 1. write `calibrators/<method>.py` with the two classes; 2. add it to `METHODS` in
`calibrators/__init__.py`; 3. run the tests: one contract test runs over every entry of METHODS.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Dataset, Observations
from implicam.dataset.unused import Rejected, Unused
from implicam.errors import FitError
from implicam.measurement import Measurement
from implicam.progress import Progress, silent

Arrays = Mapping[str, NDArray[Any]]


class Calibration(Protocol):
    """A fitted map of a rig, and the data it was fitted from."""

    method: ClassVar[str]

    @property
    def data(self) -> Dataset:
        """The data it was fitted from."""

    @property
    def unused(self) -> tuple[Unused, ...]:
        """The known points that the fit could not use."""

    @property
    def rejected(self) -> tuple[Rejected, ...]:
        """The views that the fit does not use because they contradict the others, the farthest first."""

    def measure(self, observations: Observations) -> Measurement:
        """Measure each point; one that cannot be measured keeps its row, with a reason."""

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """What a calibration file must carry beside the data: a readable table, and arrays."""

    @classmethod
    def from_state(cls, data: Dataset, table: Mapping[str, Any], arrays: Arrays) -> Self:
        """The inverse of `state`; KeyError, ValueError or TypeError for anything that does not fit."""

    def refit(self, data: Dataset, progress: Progress = silent) -> Self:
        """The same method with the same options on other data: cross-validation, or one point more."""

    def save(self, path: str | Path) -> None:
        """Write a `.implicam` file."""

    def notes(self) -> list[str]:
        """What the user should know before trusting this calibration; empty where all is well."""

    def residuals(self) -> dict[str, Any]:
        """A few readable numbers on how well the calibration fits its own data."""


class Calibrator(Protocol):
    """A method and its options, not fitted yet."""

    method: ClassVar[str]

    def fit(self, data: Dataset, progress: Progress = silent) -> Calibration:
        """Fit to known points; FitError says why it cannot be done."""


def why_not_all_seen(seen: NDArray[np.bool_], names: tuple[str, ...], method: str) -> str:
    """The reason for a point that not every camera saw."""
    blind = [name for name, ok in zip(names, seen, strict=True) if not ok]
    return f"{method} needs every camera; not seen by {', '.join(blind)}"


@contextmanager
def solvable() -> Iterator[None]:
    """Turn equations of a fit without a solution into a FitError; numbers that run away on the way warn nobody."""
    try:
        with np.errstate(all="ignore"):
            yield
    except np.linalg.LinAlgError as error:
        raise FitError(
            "the known points do not fix the rig: the equations have no solution.",
            why=str(error),
            fix="add known points elsewhere in the volume, and look for wrong ones",
        ) from error


def finite_column(arrays: Arrays, name: str, shape: tuple[int, ...], *, positive: bool = False) -> NDArray[np.float64]:
    """An array of a calibration file; ValueError where it is not finite float64 of this shape."""
    array = arrays[name]
    if array.dtype != np.float64 or array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite float64 of shape {shape}, and is {array.dtype} {array.shape}")
    if positive and not (array > 0).all():
        raise ValueError(f"{name} must be positive")
    return array
