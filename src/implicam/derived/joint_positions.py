"""The joint distribution of a few measured points, in factored form: nothing is quadratic in their number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats
from implicam.errors import UsageError, did_you_mean
from implicam.formatting import list_some
from implicam.gp.linalg import covariance_root
from implicam.measurement import Measurement


@dataclass(frozen=True, eq=False)
class JointPositions:
    """Positions of k points with all their covariances.

    Attributes:
        points: The names.
        xyz: (k, 3) in the world.
        own: (k, 3, 3) covariance of the error that each point has of its own.
        shared: (k, 3, q): the rest of each error is `shared @ z`, z standard normal numbers that all points share.
        length_unit: Of the positions.
    """

    points: tuple[str, ...]
    xyz: Floats
    own: Floats
    shared: Floats
    length_unit: str

    @property
    def cov(self) -> Floats:
        """(3 k, 3 k) covariance of x1, y1, z1, x2, ...; for few points."""
        flat = self.shared.reshape(-1, self.shared.shape[2])
        full = flat @ flat.T
        for i, own in enumerate(self.own):
            full[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += own
        return np.asarray(full, dtype=np.float64)


def joint(measurement: Measurement, points: Sequence[str | int]) -> JointPositions:
    """The joint distribution of some measured points.

    Args:
        measurement: As a calibration gave it.
        points: Names, or numbers.

    Returns:
        Their positions and covariances.

    Raises:
        UsageError: A point is not there or was not measured, or the method does not say what errors share.
    """
    return joint_of_rows(
        measurement, np.array([find_measured_point(measurement, point) for point in points], dtype=np.int64)
    )


def find_point(measurement: Measurement, point: str | int) -> int:
    """The number of a point, measured or not.

    Args:
        measurement: The points.
        point: A name or a number.

    Raises:
        UsageError: It is not there.
    """
    if isinstance(point, str):
        found = np.flatnonzero(measurement.points == point)
        if len(found):
            return int(found[0])
        near = did_you_mean(point, map(str, measurement.points))
        raise UsageError(
            f"there is no point {point!r}{near}.", fix=f"the points are {list_some(measurement.points.tolist())}"
        )
    if isinstance(point, int | np.integer) and -len(measurement) <= point < len(measurement):
        return int(point) % len(measurement)
    raise UsageError(f"there is no point {point!r}.", fix=f"give a name, or a number from 0 to {len(measurement) - 1}")


def find_measured_point(measurement: Measurement, point: str | int) -> int:
    """The number of a point that was measured.

    Args:
        measurement: The points.
        point: A name or a number.

    Raises:
        UsageError: It is not there, or was not measured.
    """
    number = find_point(measurement, point)
    if not measurement.measured[number]:
        raise UsageError(
            f"point {str(measurement.points[number])!r} was not measured.",
            why=str(measurement.reason[number]),
            fix="measure it, or leave it out",
        )
    return number


def joint_of_rows(measurement: Measurement, rows: NDArray[np.int64], *, short: bool = True) -> JointPositions:
    """The joint distribution of measured points by their numbers.

    Args:
        measurement: As a calibration gave it.
        rows: (k,) numbers of points that were measured.
        short: The shared numbers z may be others than those of the calibration, and then fewer.

    Raises:
        UsageError: The method does not say what errors share.
    """
    if measurement.shared is None:
        raise UsageError(
            "what the errors of these points have in common is not known.",
            why="only forward-gp, explicit and inverse-gp say it, and only in the program that measured the points",
            fix="measure the points with one of these methods, and ask then; a table does not keep it",
        )
    shared = measurement.shared.of(rows)
    k, _, q = shared.shape
    own = _nearest_covariances(measurement.cov[rows] - shared @ shared.swapaxes(1, 2), measurement.cov[rows])
    if short and q > 3 * k:
        flat = shared.reshape(-1, q)
        shared = covariance_root(flat @ flat.T).reshape(k, 3, -1)
    names = tuple(map(str, measurement.points[rows]))
    return JointPositions(names, measurement.xyz[rows], own, shared, measurement.length_unit)


def _nearest_covariances(parts: Floats, whole: Floats) -> Floats:
    """(k, 3, 3) without negative variances: heavy-tailed noise makes the whole a little more or less than its parts."""
    values, vectors = np.linalg.eigh(0.5 * (parts + parts.swapaxes(1, 2)))
    least = 1e-9 * np.trace(whole, axis1=1, axis2=2)[:, None]
    return np.asarray(np.einsum("nij,nj,nkj->nik", vectors, np.maximum(values, least), vectors))
