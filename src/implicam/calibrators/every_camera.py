"""What methods share that learn one map from the pixels of all cameras to a position.

Such a method knows no cameras: it takes the points that every camera saw, standardises pixels and positions, and cannot
say whether the views of a point agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.protocol import Arrays, finite_column
from implicam.dataset import Dataset, Floats, Names, remove_copies
from implicam.dataset.requirements import MAX_RELATIVE_THICKNESS, require_points, require_two_values
from implicam.dataset.unused import Unused, list_copied_points
from implicam.settings import Settings

MIN_POINTS = 5
"""Known points: fewer than a line and a noise can be learned from."""


@dataclass(frozen=True, kw_only=True, repr=False)
class EveryCameraSettings(Settings):
    """The settings that all of these methods have."""

    min_points_per_lattice_value: int = 8
    """Known points that share each value of a coordinate: with so many, on average, they are no random positions."""


USUAL = EveryCameraSettings()


@dataclass(frozen=True)
class Scaling:
    """Standardised = (value - offset) / scale, column by column."""

    offset: Floats
    scale: Floats

    @classmethod
    def of(cls, values: Floats) -> Scaling:
        """The scaling that gives each column mean 0 and standard deviation 1.

        Args:
            values: (n, d).

        Returns:
            The scaling; a column of equal values is not scaled.
        """
        scale = values.std(axis=0)
        return cls(values.mean(axis=0), np.where(scale > 0, scale, 1.0))

    def apply(self, values: Floats) -> Floats:
        """Standardise values.

        Args:
            values: (n, d), columns as of the offset.

        Returns:
            (n, d).
        """
        return (values - self.offset) / self.scale


def seen_by_all(data: Dataset, method: str) -> tuple[Dataset, tuple[Unused, ...]]:
    """The points with every view, each once, and why the others are not used.

    Args:
        data: Known points and what the cameras saw of them.
        method: The name of the method, for reasons and errors.

    Returns:
        The data of the points used, without cameras that are there twice; and the reason of each point that is not.

    Raises:
        DatasetError: The data have no known positions.
        FitError: The points are too few, or all their positions share a coordinate.
    """
    copied = list_copied_points(data)
    data = remove_copies(data, cameras_too=True)
    seen = data.observations.seen
    complete = seen.all(axis=1)
    names = data.observations.camera_names
    unused = tuple(
        Unused(str(data.points[i]), why_not_all_seen(seen[i], names, method)) for i in np.flatnonzero(~complete)
    )
    _ = data.positions  # a clear error where there are none
    per_camera = ", ".join(f"{name} sees {count}" for name, count in zip(names, seen.sum(axis=0), strict=True))
    why = f"only points seen by every camera can be used; of {len(data)} points, {per_camera}" if unused else ""
    require_points(len(np.unique(data.places[complete])), MIN_POINTS, method, why)
    usable = data.select(complete)
    require_two_values(usable.xyz, method)
    return usable, (*unused, *copied)


def pixels_of(data: Dataset) -> Floats:
    """The concatenated pixels u1, v1, u2, v2, ...

    Args:
        data: n points.

    Returns:
        (n, 2 cameras) pixels, NaN where not seen.
    """
    return data.observations.uv.reshape(len(data), -1)


def scaling_arrays(pixels: Scaling, positions: Scaling) -> dict[str, NDArray[Any]]:
    """The two scalings as arrays of a calibration file.

    Args:
        pixels: Of the 2 C pixel coordinates.
        positions: Of x, y, z.

    Returns:
        Name -> array.
    """
    return {
        "pixel_offset": pixels.offset,
        "pixel_scale": pixels.scale,
        "position_offset": positions.offset,
        "position_scale": positions.scale,
    }


def scalings(arrays: Arrays, data: Dataset) -> tuple[Scaling, Scaling]:
    """The inverse of `scaling_arrays`.

    Args:
        arrays: Of the file.
        data: That the file's calibration was fitted to; the number of its cameras counts.

    Returns:
        The scalings of pixels and of positions.

    Raises:
        KeyError: An array is missing.
        ValueError: One does not fit the data, or is not finite, or a scale is not positive.
    """
    pixels, positions = (
        Scaling(
            finite_column(arrays, f"{what}_offset", (d,)), finite_column(arrays, f"{what}_scale", (d,), positive=True)
        )
        for what, d in (("pixel", 2 * len(data.cameras)), ("position", 3))
    )
    return pixels, positions


def why_not_all_seen(seen: NDArray[np.bool_], names: tuple[str, ...], method: str) -> str:
    """The reason for a point that not every camera saw.

    Args:
        seen: (cameras,) which saw the point.
        names: Of the cameras.
        method: The name of the method.

    Returns:
        The reason, which names the cameras that did not see it.
    """
    blind = [name for name, ok in zip(names, seen, strict=True) if not ok]
    return f"{method} needs every camera; not seen by {', '.join(blind)}"


def missing_view_reasons(seen: NDArray[np.bool_], names: tuple[str, ...], method: str) -> Names:
    """Why points were not measured.

    Args:
        seen: (n, cameras) which camera saw which point.
        names: Of the cameras.
        method: The name of the method.

    Returns:
        (n,) reasons; empty where every camera saw the point.
    """
    reasons = ["" if row.all() else why_not_all_seen(row, names, method) for row in seen]
    return np.array(reasons, dtype=np.str_)


def flat_note(data: Dataset) -> list[str]:
    """A note on known points in one plane, whichever way it lies.

    Args:
        data: With its known positions.

    Returns:
        The note; no note where they fill a volume.
    """
    extents = np.linalg.svd(data.xyz - data.xyz.mean(axis=0), compute_uv=False)
    if extents[-1] > MAX_RELATIVE_THICKNESS * extents[0]:
        return []
    return [
        "The known positions lie in one plane. Positions off it are not measured but guessed, and their error bars "
        "cannot say how badly: add known points in front of it and behind."
    ]


def lattice_note(data: Dataset, method: str, settings: EveryCameraSettings = USUAL) -> list[str]:
    """A note on known positions that share their coordinates, which a map from pixels to positions can learn.

    Args:
        data: With its known positions.
        method: The name of the method.
        settings: How many points share a value on a lattice.

    Returns:
        The note; no note where there is no lattice.
    """
    lattice = [
        f"{axis} has {len(np.unique(values))} values"
        for axis, values in zip("xyz", data.xyz.T, strict=True)
        if len(np.unique(values)) <= len(values) / settings.min_points_per_lattice_value
    ]
    if not lattice:
        return []
    in_shots = len(np.unique(data.shots)) < len(data)
    return [
        f"The known positions lie on a lattice ({', '.join(lattice)} at {len(data)} points). {method} may "
        "learn its planes instead of the space between them: judge it by points off the lattice"
        f"{' or by --leave-out shot' * in_shots}, not by a random split."
    ]
