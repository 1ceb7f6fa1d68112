"""Known points and views that a fit does not use, and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from implicam.dataset import Dataset, describe_copies, find_copies
from implicam.dataset.copies import explain_copy


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


def list_copied_points(data: Dataset) -> tuple[Unused, ...]:
    """The known points that are copies of others: each is used once.

    Args:
        data: The dataset that is fitted.
    """
    copies = find_copies(data)
    return tuple(
        Unused(str(data.points[i]), "a copy of another: the same pixels at the same position to the last bit")
        for i in np.flatnonzero(copies.points)
    )


def explain_copied_cameras(data: Dataset, uncalibrated: tuple[tuple[int, str], ...]) -> tuple[tuple[int, str], ...]:
    """Say of uncalibrated cameras that are copies whose copies they are.

    Args:
        data: The dataset that was fitted.
        uncalibrated: Number of each camera that is not calibrated, and the reason.

    Returns:
        The same cameras; of copies the reason is that they are copies.
    """
    copies = find_copies(data)
    return tuple((c, explain_copy(data, c, copies) if copies.cameras[c] else why) for c, why in uncalibrated)


def describe_point_copies(data: Dataset) -> list[str]:
    """What occurs more than once among points; a method that names its uncalibrated cameras names copied ones too.

    Args:
        data: The dataset that is fitted.
    """
    return describe_copies(data)[int(find_copies(data).cameras.sum()) :]
