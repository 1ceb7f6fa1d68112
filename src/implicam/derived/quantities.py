"""Single numbers with their standard uncertainty: distances and angles between measured points.

First order, as the GUM has it (JCGM 100, and Supplement 2 for several quantities): where points are as near to each
other as their error bars, a note says that this is not enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from implicam.dataset import Floats
from implicam.derived.joint_positions import JointPositions, find_measured_point, joint, joint_of_rows
from implicam.errors import UsageError
from implicam.formatting import number_with_sd
from implicam.measurement import Measurement

MAX_BIAS_SDS = 0.1
"""How far a distance is too long on average, in its standard uncertainties, before a note says so."""
PAIRS_PER_CHUNK = 200


@dataclass(frozen=True)
class Quantity:
    """A number that follows from measured points.

    Attributes:
        value: The number.
        sd: Its standard uncertainty.
        unit: Of both.
        note: What else to know of it; empty where nothing.

    >>> import implicam as ic
    >>> ic.Quantity(10.0, 0.1, "mm")
    10.00 ± 0.10 mm
    """

    value: float
    sd: float
    unit: str
    note: str = ""

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Where the true value lies, with this probability.

        Args:
            level: Above 0 and below 1.

        Raises:
            UsageError: The level is no probability.
        """
        if not 0 < level < 1:
            raise UsageError(f"a level of {level!r} is no probability.", fix="give one above 0 and below 1")
        half = float(ndtri(0.5 * (1 + level))) * self.sd
        return self.value - half, self.value + half

    def __repr__(self) -> str:
        return f"{number_with_sd(self.value, self.sd)} {self.unit}{f' ({self.note})' if self.note else ''}"


def distance(measurement: Measurement, a: str | int, b: str | int) -> Quantity:
    """How far two measured points are from each other.

    Args:
        measurement: As a calibration gave it.
        a: A point's name or number.
        b: Another.

    Returns:
        The distance in the length unit, with what the two errors share taken into account.

    Raises:
        UsageError: A point is not there or was not measured, both are one, or what their errors share is not known.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> measured = calibration.measure(rig)
    >>> length = ic.distance(measured, 0, 1)
    >>> length.unit, length.sd > 0
    ('mm', True)
    """
    return distances(measurement, [(a, b)])[0]


def distances(measurement: Measurement, pairs: Sequence[tuple[str | int, str | int]]) -> list[Quantity]:
    """How far the two points of each pair are from each other.

    Args:
        measurement: As a calibration gave it.
        pairs: Names or numbers of points.

    Returns:
        A distance for each pair.

    Raises:
        UsageError: As for `distance`.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> measured = calibration.measure(rig)
    >>> len(ic.distances(measured, [(0, 1), (2, 3)]))
    2
    """
    rows = _numbers_of_pairs(measurement, pairs)
    found: list[Quantity] = []
    for start in range(0, len(rows), PAIRS_PER_CHUNK):
        found += _distances(measurement, rows[start : start + PAIRS_PER_CHUNK])
    return found


def _numbers_of_pairs(measurement: Measurement, pairs: Sequence[tuple[str | int, str | int]]) -> NDArray[np.int64]:
    """(n, 2) numbers of points that were measured, the two of a pair different."""
    rows = np.array([[find_measured_point(measurement, point) for point in pair] for pair in pairs], dtype=np.int64)
    rows = rows.reshape(len(pairs), 2)
    for a in rows[rows[:, 0] == rows[:, 1], 0]:
        name = str(measurement.points[a])
        raise UsageError(f"a distance is between two points, and {name!r} is one.", fix="give two different points")
    return rows


def _distances(measurement: Measurement, pairs: NDArray[np.int64]) -> list[Quantity]:
    rows, at = np.unique(pairs, return_inverse=True)
    points = joint_of_rows(measurement, rows)
    a, b = at.reshape(pairs.shape).T
    step = points.xyz[b] - points.xyz[a]
    length = np.linalg.norm(step, axis=1)
    shared = points.shared[b] - points.shared[a]
    cov = points.own[a] + points.own[b] + shared @ shared.swapaxes(1, 2)
    along = np.divide(step, length[:, None], out=np.zeros_like(step), where=length[:, None] > 0)
    variance = np.einsum("ni,nij,nj->n", along, cov, along)
    variance = np.where(length > 0, variance, np.trace(cov, axis1=1, axis2=2))
    across = np.maximum(np.trace(cov, axis1=1, axis2=2) - variance, 0.0)
    sd = np.sqrt(variance)
    near = across > 2 * MAX_BIAS_SDS * length * sd
    note = (
        "the points are so near that their error bars make the distance longer, and the interval is not to be trusted"
    )
    return [
        Quantity(float(d), float(u), points.length_unit, note if n else "")
        for d, u, n in zip(length, sd, near, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class JointDistances:
    """Distances between measured points with what their errors share.

    Attributes:
        values: (n,) the distances.
        cov: (n, n) their covariance.
        unit: The length unit.
    """

    values: Floats
    cov: Floats
    unit: str


def joint_distances(measurement: Measurement, pairs: Sequence[tuple[str | int, str | int]]) -> JointDistances:
    """Distances of pairs of points with the covariance of all of them: for tests of many lengths together.

    Args:
        measurement: As a calibration gave it.
        pairs: n names or numbers of points.

    Raises:
        UsageError: As for `distance`.

    >>> import implicam as ic
    >>> from implicam.derived import joint_distances
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> measured = ic.ForwardGP().fit(rig).measure(rig)
    >>> joint_distances(measured, [(0, 1), (2, 3)]).cov.shape
    (2, 2)
    """
    numbers = _numbers_of_pairs(measurement, pairs)
    rows, at = np.unique(numbers, return_inverse=True)
    points = joint_of_rows(measurement, rows)
    a, b = at.reshape(numbers.shape).T
    step = points.xyz[b] - points.xyz[a]
    length = np.linalg.norm(step, axis=1)
    along = step / np.maximum(length, np.finfo(float).tiny)[:, None]
    slope = np.zeros((len(numbers), len(rows), 3))  # of each distance by each coordinate
    each = np.arange(len(numbers))
    slope[each, a], slope[each, b] = -along, along
    shared = slope.reshape(len(numbers), -1) @ points.shared.reshape(3 * len(rows), -1)
    own = np.einsum("nki,kij->nkj", slope, np.linalg.cholesky(points.own)).reshape(len(numbers), -1)
    return JointDistances(length, np.asarray(shared @ shared.T + own @ own.T), points.length_unit)


def angle(measurement: Measurement, a: str | int, vertex: str | int, b: str | int) -> Quantity:
    """The angle at a measured point between two others.

    Args:
        measurement: As a calibration gave it.
        a: A point's name or number.
        vertex: The point where the angle is.
        b: A third point.

    Returns:
        The angle from 0 to 180 degrees.

    Raises:
        UsageError: A point is not there, was not measured or coincides with the vertex, or the method does not say what
            errors share.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> measured = calibration.measure(rig)
    >>> ic.angle(measured, 0, 1, 2).value > 0
    True
    """
    points = joint(measurement, (a, vertex, b))
    p, q = points.xyz[0] - points.xyz[1], points.xyz[2] - points.xyz[1]
    lengths = np.linalg.norm(p), np.linalg.norm(q)
    if not min(lengths) > 0:
        raise UsageError("an angle is between two points and a third.", fix="give three different points")
    p, q = p / lengths[0], q / lengths[1]
    normal = np.cross(p, q)
    sine = float(np.linalg.norm(normal))
    value = float(np.arctan2(sine, p @ q))
    normal = normal / sine if sine > 0 else _any_across(p)
    by_a, by_b = np.cross(p, normal) / lengths[0], np.cross(normal, q) / lengths[1]
    slope = np.stack([by_a, -by_a - by_b, by_b])
    sd = float(np.sqrt(variance_of(points, slope)))
    straight = min(value, np.pi - value) < 3 * sd
    note = "so nearly straight that the angle cannot be normally distributed" if straight else ""
    return Quantity(float(np.degrees(value)), float(np.degrees(sd)), "degrees", note)


def _any_across(direction: Floats) -> Floats:
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    return np.asarray(across / np.linalg.norm(across), dtype=np.float64)


def variance_of(points: JointPositions, slope: Floats) -> float:
    """The variance of what depends on the points linearly.

    Args:
        points: k points.
        slope: (k, 3) by each coordinate.
    """
    own = np.einsum("ki,kij,kj->", slope, points.own, slope)
    return float(own + np.sum(np.einsum("ki,kiq->q", slope, points.shared) ** 2))
