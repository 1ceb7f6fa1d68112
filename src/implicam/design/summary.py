"""What a prediction says in a few numbers: over the workspace, and of each camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from implicam.dataset import Floats
from implicam.design.prediction import Prediction
from implicam.progress import Progress, silent

USUAL_QUANTILE = 0.95
PLACE_COUNT_WITHOUT_EACH = 300
"""Places at which a rig is judged without each of its cameras."""


@dataclass(frozen=True)
class Spread:
    """How a quantity is distributed over the part of the workspace that is measured.

    Attributes:
        name: Of the quantity.
        unit: Of length, or nothing.
        median: In half of the workspace it is less.
        usual: In 95 % of it.
        worst: The largest.
    """

    name: str
    unit: str
    median: float
    usual: float
    worst: float


@dataclass(frozen=True)
class CameraPart:
    """What one camera is worth.

    Attributes:
        name: Of the camera.
        known_seen: Known points that it sees.
        part_seen: Part of the workspace that it sees.
        lost: How much of the accuracy, 1 / sd in the mean of the workspace, would be lost without it.
        blind: Part of the workspace that fewer than two cameras would see without it.
    """

    name: str
    known_seen: int
    part_seen: float
    lost: float
    blind: float


def summarise_spreads(prediction: Prediction) -> tuple[Spread, ...]:
    """The distribution over the workspace of what a position will be measured with.

    Args:
        prediction: Of a placement.

    Returns:
        Standard deviations along x, y, z, and of all axes together; the 95 % uncertainty (the longest semi-axis of the
        ellipsoid); the standard deviation that pixel noise alone would leave; and the part of the variance that better
        known cameras would remove.
    """
    found, unit = prediction.predicted, prediction.rig.length_unit
    sds = np.sqrt(np.diagonal(found.total, axis1=1, axis2=2))
    floor = np.sqrt(np.trace(found.floor, axis1=1, axis2=2))
    return (
        *(_spread(f"sd along {axis}", unit, sds[:, i]) for i, axis in enumerate("xyz")),
        _spread("sd of all axes", unit, found.sd),
        _spread("95 % uncertainty", unit, found.u95),
        _spread("sd by pixel noise alone", unit, floor),
        _spread("share of calibration", "", 1 - (floor / found.sd) ** 2),
    )


def _spread(name: str, unit: str, values: Floats) -> Spread:
    values = values[np.isfinite(values)]
    if not len(values):
        return Spread(name, unit, np.nan, np.nan, np.nan)
    return Spread(name, unit, float(np.median(values)), float(np.quantile(values, USUAL_QUANTILE)), float(values.max()))


def judge_cameras(prediction: Prediction, progress: Progress = silent) -> tuple[CameraPart, ...]:
    """What each camera is worth: the accuracy without it, and what would be blind.

    Args:
        prediction: Of a placement.
        progress: Is told how far it is.

    Returns:
        One for each camera, in the order of the drawing. A camera that sees too few known points is worth nothing.
    """
    some = slice(PLACE_COUNT_WITHOUT_EACH)
    xyz, seen = prediction.places[some], prediction.seen[some]
    with_all = prediction.predicted.sd[some]
    without = {c: (0.0, float(np.mean(~np.isfinite(with_all)))) for c in range(len(prediction.rig.cameras))}
    steps = prediction.planned.covariance_without_each(xyz, seen)
    for done, (c, covariance) in enumerate(steps, 1):
        sd = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
        left = np.nan_to_num(with_all / sd)[np.isfinite(with_all)]  # where nothing is measured, nothing is left
        lost = float(1 - np.mean(left)) if len(left) else 0.0
        without[c] = lost, float(np.mean(~np.isfinite(sd)))
        progress("without each camera", done, len(prediction.planned.numbers))
    return tuple(
        CameraPart(
            camera.name,
            int(prediction.known_seen[:, c].sum()),
            float(prediction.seen[:, c].mean()),
            *without[c],
        )
        for c, camera in enumerate(prediction.rig.cameras)
    )
