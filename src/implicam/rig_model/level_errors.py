"""Planes of known points that are too few, or too much of one piece, to tell how far each is off: eq. (28).

Two or three boards on a slide cannot contradict each other, and neither do the levels of one stepped target. What one
of them may be off is then a matter of experience: `find_uncertain_planes` says of what size, and Shots what follows
between them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.geometry import Floats
from implicam.rig_model.settings import RigModelSettings
from implicam.rig_model.shot_errors import WORLD_POLYNOMIAL_TERMS, Shots

TRIPLES_TRIED, MAX_POINTS_LOOKED_AT = 600, 200
"""Levels are looked for along the normals of so many random triples of points, among so many points."""


class Planes(NamedTuple):
    """Shots or levels, and their sds (6,), in the working frame: along, across (2), three tilts."""

    shots: Shots
    sd: Floats


def find_uncertain_planes(points: Floats, labels: NDArray[np.str_], settings: RigModelSettings) -> Planes | None:
    """Planes of known points whose errors cannot be estimated, since they cannot contradict each other.

    Args:
        points: Known positions (n, 3) in the working frame.
        labels: (n,) name of each point's shot.
        settings: How far planes are usually off, and what a level is.

    Returns:
        Two or three shots, or the levels of one; None where there are none, or shots enough to estimate.
    """
    names = np.unique(labels)
    if len(names) == 1:
        found = find_levels(points, settings)
        if found is None:
            return None
        on_level, number = found.number >= 0, found.number.astype(np.str_)
        shots = Shots.of(points[on_level], number[on_level], settings, fewest=2, direction=found.normal)
        return None if shots is None else Planes(shots, settings.level_sd_ratio * _shot_sd(settings))
    if len(names) > WORLD_POLYNOMIAL_TERMS:
        return None
    shots = Shots.of(points, labels, settings, fewest=2)
    return None if shots is None else Planes(shots, _shot_sd(settings))


def _shot_sd(settings: RigModelSettings) -> Floats:
    """(6,) sds of one of two or three shots: eq. (17) where nothing is told."""
    along = settings.shot_sd_prior_median_wf * float(np.exp(settings.shot_sd_prior_log_sd))
    return along * np.array([1, *2 * [settings.across_sd_ratio], *3 * [settings.tilt_sd_ratio]])


class Levels(NamedTuple):
    """number (n,) of each point's level, -1 where it has too few points; normal (3,) to them."""

    number: NDArray[np.int64]
    normal: Floats


def find_levels(points: Floats, settings: RigModelSettings) -> Levels | None:
    """The levels on which the points of one target stand.

    Of the axes along which the points stand on a few planes, that with the fewest, and then the one along which the
    target is thinnest; of all directions where no axis is one, since a target may be turned. (Stairs have slanted
    planes too, through the edges of their steps, and these can be fewer.)

    Args:
        points: (n, 3) of one target.
        settings: How many levels it may have, how thin they are, and how many points each has.

    Returns:
        The level of each point; None if the target has none.
    """
    some = points[np.linspace(0, len(points) - 1, min(MAX_POINTS_LOOKED_AT, len(points))).astype(int)]
    normals = np.concatenate([np.eye(3), _normals(some)])
    along = some @ normals.T
    thickness, fewest = settings.max_level_thickness_ratio, settings.min_points_per_level
    apart, clear = _steps(np.sort(along, axis=0), thickness)
    counts = apart.sum(axis=0) + 1
    slanted = np.arange(len(normals)) >= 3
    for k in np.lexsort((np.ptp(along, axis=0), counts, slanted)):
        if not clear[k] or not settings.min_levels <= counts[k] <= min(settings.max_levels, len(points) / fewest):
            continue
        number = _numbers(points @ normals[k], thickness)
        large = np.bincount(number) >= fewest
        if large.sum() >= settings.min_levels and len(large) <= settings.max_levels:
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


def _steps(t: Floats, thickness: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Of sorted values t (n, k): (n - 1, k) where a level ends; and (k,) whether the levels are thin and well apart."""
    step = np.diff(t, axis=0)
    extent = np.ptp(t, axis=0)
    apart = step >= 10 * thickness * extent
    within = np.where(apart, 0, step)
    thin = within.max(axis=0) <= thickness * extent
    return apart, thin & (within.sum(axis=0) <= thickness * extent * (apart.sum(axis=0) + 1)) & (extent > 0)


def _numbers(t: Floats, thickness: float) -> NDArray[np.int64]:
    """(n,) numbers of the levels."""
    order = np.argsort(t)
    number = np.zeros(len(t), dtype=np.int64)
    number[order[1:]] = np.cumsum(_steps(t[order, None], thickness)[0][:, 0])
    return number
