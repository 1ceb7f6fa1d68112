"""What data must offer to a method: the cameras of a calibration, and enough known points in a volume."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Observations
from implicam.errors import DatasetError, FitError

MAX_RELATIVE_THICKNESS = 1e-3
"""Thickness over width of what is called a plane, or a line."""


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


def require_points(n: int, least: int, method: str, why: str = "") -> None:
    """FitError for fewer usable points than a method needs; `why` others cannot be used, where there are others."""
    if n < least:
        raise FitError(
            f"{n} usable known point{'s' * (n != 1)}; {method} needs at least {least}.",
            why=why,
            fix="add known points"
            + (", or leave out the camera that misses most of them (--without NAME)" if why else ""),
        )


def require_volume(xyz: NDArray[np.float64], method: str) -> None:
    """FitError for points (n, 3) on one plane or line."""
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
