"""What data must offer to a method: the cameras of a calibration, and enough known points in a volume."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Dataset, Observations
from implicam.errors import DatasetError, FitError, UsageError

MAX_RELATIVE_THICKNESS = 1e-3
"""Thickness over width of what is called a plane, or a line."""


def observations_of(given: Observations | Dataset) -> Observations:
    """What the cameras saw.

    Args:
        given: The observations, or a dataset that has them.

    Raises:
        UsageError: It is neither; says what would do.
    """
    found = given.observations if isinstance(given, Dataset) else given
    if not isinstance(found, Observations):
        raise UsageError(
            f"observations are wanted, and not {_type_of(given)}.",
            fix=_reading(given, "measure(ic.Dataset.from_arrays(uv)), or measure(ic.read_dataset(path))"),
        )
    return found


def require_dataset(given: object) -> None:
    """Refuse what is no dataset.

    Args:
        given: What a fit was asked to learn from.

    Raises:
        UsageError: It is no dataset; says what would do.
    """
    if not isinstance(given, Dataset):
        raise UsageError(
            f"a dataset is wanted, and not {_type_of(given)}.",
            why="a fit needs the known positions beside the pixels" if isinstance(given, Observations) else "",
            fix=_reading(given, 'fit(ic.Dataset.from_arrays(uv, xyz, unit="mm")), or fit(ic.read_dataset(path))'),
        )


def _type_of(given: object) -> str:
    return f"an array of shape {given.shape}" if isinstance(given, np.ndarray) else f"a {type(given).__name__}"


def _reading(given: object, otherwise: str) -> str:
    return f"read it first: ic.read_dataset({str(given)!r})" if isinstance(given, str | Path) else otherwise


def match_cameras(trained: Observations, observations: Observations) -> Observations:
    """The observations with the cameras of a calibration, in its order.

    Args:
        trained: The observations that the calibration was made from.
        observations: Those to be measured; other cameras are left out.

    Raises:
        DatasetError: A camera of the calibration is missing, or has images of another size.
    """
    wanted, given = trained.camera_names, observations.camera_names
    missing = [name for name in wanted if name not in given]
    if missing:
        raise DatasetError(
            f"the observations have no camera {', '.join(map(repr, missing))}.",
            why=f"the calibration was made with {', '.join(wanted)}; these data have {', '.join(given)}",
            fix="give the cameras the names that they had when the rig was calibrated",
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


def require_points(n: int, least: int, method: str, why: str = "") -> None:
    """Refuse too few known points.

    Args:
        n: Usable known points.
        least: How many the method needs.
        method: Its name.
        why: Why others cannot be used, where there are others.

    Raises:
        FitError: n is less than `least`.
    """
    if n < least:
        raise FitError(
            f"{n} usable known point{'s' * (n != 1)}; {method} needs at least {least}.",
            why=why,
            fix="add known points"
            + (", or leave out the camera that misses most of them (--without NAME)" if why else ""),
        )


def require_volume(xyz: NDArray[np.float64], method: str) -> None:
    """Refuse known points on one plane or line.

    Args:
        xyz: (n, 3) in any unit.
        method: The method's name.

    Raises:
        FitError: They are as thin as `MAX_RELATIVE_THICKNESS`, or all have the same x, y or z.
    """
    require_two_values(xyz, method)
    extents = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if extents[2] > MAX_RELATIVE_THICKNESS * extents[0]:
        return
    shape = "line" if extents[1] <= MAX_RELATIVE_THICKNESS * extents[0] else "plane"
    raise FitError(
        f"the {len(xyz)} known points lie on one {shape}.",
        why=f"{method} cannot tell from them how far a camera is",
        fix="add known points in front of it and behind, for example a second position of the board",
    )


def require_two_values(xyz: NDArray[np.float64], method: str) -> None:
    """Refuse known points that all have the same x, y or z.

    Args:
        xyz: (n, 3) in any unit.
        method: The method's name.

    Raises:
        FitError: A coordinate has one value only.
    """
    same = [axis for axis, values in zip("xyz", xyz.T, strict=True) if np.ptp(values) == 0]
    if same:
        axes = " and ".join(same)
        value = ", ".join(f"{axis} = {xyz[0, 'xyz'.index(axis)] + 0.0:g}" for axis in same)
        raise FitError(
            f"all {len(xyz)} usable points have the same {value}.",
            why=f"{method} learns {axes} from examples, and has seen one value only",
            fix=f"add points with other {axes}, for example a second position of the board",
        )
