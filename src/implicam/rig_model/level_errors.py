"""Planes of known points that are too few, or too much of one piece, to tell how far each is off: eq. (28).

Two or three boards on a slide cannot contradict each other, and neither do the levels of one stepped target. What one
of them may be off is then a matter of experience: `untold` says of what size, and Shots what follows between them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.geometry import Floats
from implicam.rig_model.shot_errors import SHOT_SD_PRIOR, WORLD_POLYNOMIAL_TERMS, Shots

SHOT_SD = float(np.exp(sum(SHOT_SD_PRIOR)))
"""Sd of the error of one of two or three shots, in the working frame: eq. (17) where nothing is told."""

LEVEL_SD = 0.3 * SHOT_SD
"""The same of a level of one target: machined in one piece, not moved and stopped again."""

ACROSS_SD_RATIO = 0.7
"""Across the traverse a shot is off by this part of what it is along it."""

TILT_SD_RATIO = 0.33
"""A tilt moves the rim of a shot by this part of its shift."""

MIN_LEVELS, MAX_LEVELS = 2, 12
"""Of a stepped target; more are a lattice."""

MIN_POINTS_PER_LEVEL = 6
"""Points that a level has on average; a plane takes three."""

MAX_RELATIVE_THICKNESS = 1e-3
"""Thickness of a level and a tenth of the gap to the next, as a part of the target's extent."""

TRIPLES_TRIED, MAX_POINTS_LOOKED_AT = 600, 200
"""Levels are looked for along the normals of so many random triples of points, among so many points."""


class Planes(NamedTuple):
    """Shots or levels, and their sds (6,), in the working frame: along, across (2), three tilts."""

    shots: Shots
    sd: Floats


def untold(points: Floats, labels: NDArray[np.str_]) -> Planes | None:
    """The planes of known points (n, 3) of which nothing can be told; None where there are none, or enough shots."""
    names = np.unique(labels)
    if len(names) == 1:
        found = levels(points)
        if found is None:
            return None
        there, number = found.number >= 0, found.number.astype(np.str_)
        shots = Shots.of(points[there], number[there], fewest=2, direction=found.normal)
        return None if shots is None else Planes(shots, _sd(LEVEL_SD))
    if len(names) > WORLD_POLYNOMIAL_TERMS:
        return None
    shots = Shots.of(points, labels, fewest=2)
    return None if shots is None else Planes(shots, _sd(SHOT_SD))


def _sd(size: float) -> Floats:
    return size * np.array([1, ACROSS_SD_RATIO, ACROSS_SD_RATIO, TILT_SD_RATIO, TILT_SD_RATIO, TILT_SD_RATIO])


class Levels(NamedTuple):
    """number (n,) of each point's level, -1 where it has too few points; normal (3,) to them."""

    number: NDArray[np.int64]
    normal: Floats


def levels(points: Floats) -> Levels | None:
    """Of the points (n, 3) of one target; None if it has none.

    Of the axes along which the points stand on a few planes, that with the fewest, and then the one along which the
    target is thinnest; of all directions where no axis is one, since a target may be turned. (Stairs have slanted
    planes too, through the edges of their steps, and these can be fewer.)
    """
    some = points[np.linspace(0, len(points) - 1, min(MAX_POINTS_LOOKED_AT, len(points))).astype(int)]
    normals = np.concatenate([np.eye(3), _normals(some)])
    along = some @ normals.T
    apart, clear = _steps(np.sort(along, axis=0))
    counts = apart.sum(axis=0) + 1
    slanted = np.arange(len(normals)) >= 3
    for k in np.lexsort((np.ptp(along, axis=0), counts, slanted)):
        if not clear[k] or not MIN_LEVELS <= counts[k] <= min(MAX_LEVELS, len(points) / MIN_POINTS_PER_LEVEL):
            continue
        number = _numbers(points @ normals[k])
        large = np.bincount(number) >= MIN_POINTS_PER_LEVEL
        if large.sum() >= MIN_LEVELS and len(large) <= MAX_LEVELS:
            return Levels(np.where(large[number], number, -1), normals[k])
    return None


def _normals(points: Floats) -> Floats:
    """(k, 3) normals of planes through three of the points (n, 3)."""
    rng = np.random.default_rng(0)
    a, b, c = (points[rng.integers(len(points), size=TRIPLES_TRIED)] for _ in range(3))
    first, second = b - a, c - a
    normal = np.cross(first, second)
    size = np.linalg.norm(normal, axis=1)
    good = size > 0.1 * np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    return np.asarray(normal[good] / size[good, None], dtype=np.float64)


def _steps(t: Floats) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Of sorted values t (n, k): (n - 1, k) where a level ends; and (k,) whether the levels are thin and well apart."""
    step = np.diff(t, axis=0)
    extent = np.ptp(t, axis=0)
    apart = step >= 10 * MAX_RELATIVE_THICKNESS * extent
    within = np.where(apart, 0, step)
    thin = within.max(axis=0) <= MAX_RELATIVE_THICKNESS * extent
    return apart, thin & (within.sum(axis=0) <= MAX_RELATIVE_THICKNESS * extent * (apart.sum(axis=0) + 1)) & (
        extent > 0
    )


def _numbers(t: Floats) -> NDArray[np.int64]:
    """(n,) numbers of the levels."""
    order = np.argsort(t)
    number = np.zeros(len(t), dtype=np.int64)
    number[order[1:]] = np.cumsum(_steps(t[order, None])[0][:, 0])
    return number
