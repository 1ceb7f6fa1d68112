"""What every method offers, so that everything above works with each of them.

A *calibrator* is a method with its options, a frozen value; `fit` returns a *calibration*, the fitted map of the rig.
To add a method: 1. write `calibrators/<method>.py` with the two classes; 2. add it to `METHODS` in
`calibrators/__init__.py`; 3. run the tests: one contract test runs over every entry of METHODS.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Dataset, Observations, copies_of, copy_notes
from implicam.dataset.copies import why_no_camera
from implicam.errors import DatasetError, FitError
from implicam.measurement import Measurement
from implicam.progress import Progress, silent

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Unused:
    """A known point that the fit could not use, and why."""

    point: str
    reason: str


@dataclass(frozen=True)
class Rejected:
    """A view that the fit does not use, because it contradicts the others: `residual` pixels off what they predict."""

    point: str
    camera: str
    residual: float


def copied_points(data: Dataset) -> tuple[Unused, ...]:
    """The known points that are copies of others: each is used once."""
    copies = copies_of(data)
    return tuple(
        Unused(str(data.points[i]), "a copy of another: the same pixels at the same position to the last bit")
        for i in np.flatnonzero(copies.points)
    )


def blind_with_copies(data: Dataset, blind: tuple[tuple[int, str], ...]) -> tuple[tuple[int, str], ...]:
    """Why cameras (their number, the reason) are not calibrated, of those that are copies what they are."""
    copies = copies_of(data)
    return tuple((c, why_no_camera(data, c, copies) if copies.cameras[c] else why) for c, why in blind)


def point_copy_notes(data: Dataset) -> list[str]:
    """What is there more than once among points; a method that names its uncalibrated cameras names copied ones too."""
    return copy_notes(data)[int(copies_of(data).cameras.sum()) :]


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


def same_cameras(trained: Observations, observations: Observations) -> Observations:
    """The observations with the calibration's cameras in its order; an error where one of them is missing."""
    wanted, given = trained.camera_names, observations.camera_names
    missing = [name for name in wanted if name not in given]
    if missing:
        raise DatasetError(
            f"the observations have no camera {', '.join(map(repr, missing))}.",
            why=f"the calibration was made with {', '.join(wanted)}; these data have {', '.join(given)}",
            fix="measure with data of the same rig, with the same camera names in dataset.toml",
        )
    ordered = observations.with_cameras(wanted)
    for camera, other in zip(trained.cameras, ordered.cameras, strict=True):
        if None not in (camera.width, other.width) and (camera.width, camera.height) != (other.width, other.height):
            raise DatasetError(
                f"camera {camera.name!r} has images of {other.width} x {other.height} pixels; it was calibrated with "
                f"{camera.width} x {camera.height}.",
                why="a calibration holds for one image size",
                fix="turn the pictures back as they were: width and height are exchanged"
                if (other.width, other.height) == (camera.height, camera.width)
                else "record with the size of the calibration, or calibrate again",
            )
    return ordered


def why_not_all_seen(seen: NDArray[np.bool_], names: tuple[str, ...], method: str) -> str:
    """The reason for a point that not every camera saw."""
    blind = [name for name, ok in zip(names, seen, strict=True) if not ok]
    return f"{method} needs every camera; not seen by {', '.join(blind)}"


def require_points(n: int, least: int, method: str, why: str = "") -> None:
    """FitError for fewer usable points than a method needs; `why` others cannot be used, where there are others."""
    if n < least:
        raise FitError(
            f"{n} usable known point{'s' * (n != 1)}; {method} needs at least {least}.",
            why=why,
            fix="add known points"
            + (", or leave out the camera that misses most of them (--without NAME)" if why else ""),
        )


FLAT = 1e-3
"""Thickness over width of what is called a plane, or a line."""


def require_volume(xyz: NDArray[np.float64], method: str) -> None:
    """FitError for points (n, 3) on one plane or line."""
    require_two_values(xyz, method)
    extents = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if extents[2] > FLAT * extents[0]:
        return
    shape = "line" if extents[1] <= FLAT * extents[0] else "plane"
    raise FitError(
        f"the {len(xyz)} known points lie on one {shape}.",
        why=f"{method} cannot tell from them how far a camera is",
        fix="add known points in front of it and behind, for example a second position of the board",
    )


def require_two_values(xyz: NDArray[np.float64], method: str) -> None:
    """FitError where all points (n, 3) have the same x, y or z."""
    same = [axis for axis, values in zip("xyz", xyz.T, strict=True) if np.ptp(values) == 0]
    if same:
        axes = " and ".join(same)
        value = ", ".join(f"{axis} = {xyz[0, 'xyz'.index(axis)] + 0.0:g}" for axis in same)
        raise FitError(
            f"all {len(xyz)} usable points have the same {value}.",
            why=f"{method} learns {axes} from examples, and has seen one value only",
            fix=f"add points with other {axes}, for example a second position of the board",
        )


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
