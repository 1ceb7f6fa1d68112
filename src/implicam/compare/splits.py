"""Which points train and which judge: at random, a shot left out, a plane of a lattice left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Dataset, Floats
from implicam.errors import DatasetError, UsageError

Item = TypeVar("Item")

RANDOM, SHOT = "random", "shot"
AXES = "xyz"
_PLANES = {f"plane {axis}": axis for axis in AXES}  # kind of a split whose held-out points share a coordinate

MAX_PLANE_THICKNESS = 1e-3
"""How far the points of one plane may differ in its coordinate, as a share of the largest extent of all points."""
MIN_POINTS_PER_PLANE = 4
"""Fewer points than this on a plane, on average, are no lattice: random positions fall together too."""
MIN_CROSSING_SHARE = 1 / 8
"""The least share of the crossings of the planes of two axes that holds points."""


@dataclass(frozen=True, eq=False)
class Split:
    """Known points to train on, and known points to judge by; no fit uses the latter.

    Attributes:
        kind: `RANDOM`, `SHOT`, or "plane x", "plane y", "plane z".
        train: The points to train on.
        held_out: The points to judge by.
        seed: Of the draw, or the number of the shot or plane.
        left_out: The shot, or the plane as "z = 3"; empty where points were held out at random.
        all_others: Whether nothing was drawn: everything else trains.
    """

    kind: str
    train: Dataset
    held_out: Dataset
    seed: int
    left_out: str = ""
    all_others: bool = False

    @property
    def cell(self) -> tuple[str, int]:
        """Equal for the splits that are averaged together: the same kind, the same number of points drawn."""
        return self.kind, 0 if self.all_others else len(self.train)


def plane_axis(kind: str) -> str:
    """The coordinate that the held-out points of a kind of split share.

    Args:
        kind: As of `Split`.

    Returns:
        "x", "y" or "z"; empty for other kinds.
    """
    return _PLANES.get(kind, "")


def random_splits(data: Dataset, sizes: Sequence[int], *, seeds: int, check: Dataset | None = None) -> list[Split]:
    """Random draws of known points; the rest is held out, or all of `check`.

    No split comes twice: neither for a size that is given twice, nor where all points are taken.

    Args:
        data: Known points to draw from.
        sizes: Numbers of points to draw.
        seeds: How many draws of each number.
        check: Another dataset to judge by; None for the points that were not drawn.

    Raises:
        UsageError: There is no size or no seed, or a number of points leaves none to judge by.
    """
    if seeds < 1 or not sizes:
        raise _nothing_to_compare()
    if check is None and max(sizes) >= len(data):
        raise UsageError(
            f"{max(sizes)} of {len(data)} points leave none to evaluate on.",
            fix=f"choose numbers below {len(data)}, or give another dataset with --check",
        )
    splits = []
    for size in dict.fromkeys(sizes):
        for seed in range(1 if size == len(data) else seeds):
            train, rest = (data, data) if size == len(data) else data.split(size, seed=seed)
            splits.append(Split(RANDOM, train, rest if check is None else check, seed))
    return splits


def shot_splits(data: Dataset, sizes: Sequence[int] | None = None, *, most: int | None = None) -> list[Split]:
    """Each shot (a board, a plate) held out in turn; the others train.

    Args:
        data: Known points.
        sizes: Numbers of points to draw from the others; None for all of them.
        most: How many shots to hold out at most, drawn at random; None for all.

    Raises:
        DatasetError: There is only one shot.
        UsageError: Each shot is a single point, so that this would be a random split; or the others are fewer than a
            size.
    """
    names = [str(name) for name in np.unique(data.shots)]
    if len(names) < 2:
        raise DatasetError(
            f"dataset {data.name!r} has one shot only, so no shot can be left out.",
            fix="leave out --leave-out, or give the points of each exposure their own shot in points.csv; where they "
            "stand on a lattice, --lattice leaves its planes out",
        )
    if len(names) == len(data):
        raise UsageError(
            f"each of the {len(data)} points of {data.name!r} is a shot of its own, so leaving a shot out leaves out "
            "one point.",
            why="only points of one exposure (a board, a plate) share errors that a random split would hide",
            fix="leave out --leave-out: random splits are as good here",
        )
    held_out = [(name, data.shots == name) for name in _at_most(most, names)]
    return _leave_out(SHOT, data, held_out, sizes)


def plane_splits(data: Dataset, sizes: Sequence[int] | None = None, *, most: int | None = None) -> list[Split]:
    """Each inner plane of a lattice of known positions held out in turn, across x, y and z; the others train.

    The outer planes are never held out, because measuring them is to extrapolate.

    Args:
        data: Known points.
        sizes: Numbers of points to draw from the others; None for all of them.
        most: How many planes to hold out along an axis at most, drawn at random; None for all.

    Raises:
        DatasetError: The points stand on no lattice with an inner plane.
        UsageError: The others are fewer than a size.
    """
    splits = []
    for kind, axis in _PLANES.items():
        planes = lattice_planes(data.xyz, AXES.index(axis))
        inner = [] if planes is None else [(f"{axis} = {value:g}", on) for value, on in planes[1:-1]]
        splits += _leave_out(kind, data, _at_most(most, inner), sizes)
    if not splits:
        raise _no_lattice(data)
    return splits


def lattice_planes(xyz: Floats, axis: int) -> list[tuple[float, NDArray[np.bool_]]] | None:
    """The planes of a lattice across one axis of the world.

    There are none where the coordinates are spread over many values: a plane is thinner than `MAX_PLANE_THICKNESS` and
    has `MIN_POINTS_PER_PLANE` points on average. There are none either where they meet those of another axis at few of
    their crossings only (`MIN_CROSSING_SHARE`): these are the rows of a lattice that is turned about the third axis.

    Args:
        xyz: (n, 3) positions in the world.
        axis: 0, 1 or 2.

    Returns:
        For each plane, by rising coordinate: the coordinate, and (n,) which points lie on it. None where there are
            none.
    """
    gathered = [_plane_numbers(xyz, k) for k in range(3)]
    mine = gathered[axis]
    if mine is None:
        return None
    for other in (found for k, found in enumerate(gathered) if k != axis and found is not None):
        crossings = (mine.max() + 1) * (other.max() + 1)
        if len(np.unique(mine * (other.max() + 1) + other)) < MIN_CROSSING_SHARE * crossings:
            return None
    return [(float(np.median(xyz[mine == k, axis])), mine == k) for k in range(mine.max() + 1)]


def _plane_numbers(xyz: Floats, axis: int) -> NDArray[np.intp] | None:
    """(n,) which of few values the coordinate has, counted from the least; None where it has many."""
    if not len(xyz):
        return None
    values = xyz[:, axis]
    tolerance = MAX_PLANE_THICKNESS * float(np.ptp(xyz, axis=0).max())
    order = np.argsort(values)
    label = np.empty(len(values), dtype=np.intp)
    label[order] = np.cumsum(np.diff(values[order], prepend=values[order[0]]) > tolerance)
    count = label.max() + 1
    lowest, highest = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(lowest, label, values)
    np.maximum.at(highest, label, values)
    too_thick = (highest - lowest).max() > tolerance
    return None if too_thick or len(values) < MIN_POINTS_PER_PLANE * count else label


def _leave_out(
    kind: str, data: Dataset, held_out: list[tuple[str, NDArray[np.bool_]]], sizes: Sequence[int] | None
) -> list[Split]:
    """By number of points, then by what is left out, which has the same number in every cell."""
    if sizes is not None and not sizes:
        raise _nothing_to_compare()
    splits = []
    for size in (None,) if sizes is None else tuple(dict.fromkeys(sizes)):
        for i, (name, out) in enumerate(held_out):
            train = _draw(data.select(~out), size, i, name)
            splits.append(Split(kind, train, data.select(out), i, name, size is None))
    return splits


def _draw(others: Dataset, size: int | None, seed: int, left_out: str) -> Dataset:
    if size is None or size == len(others):
        return others
    if size > len(others):
        raise UsageError(
            f"{size} points cannot be drawn where {left_out} is left out: {len(others)} others are there.",
            fix=f"choose numbers up to {len(others)} with --train",
        )
    return others.split(size, seed=seed)[0]


def _at_most(most: int | None, items: list[Item]) -> list[Item]:
    if most is None or most >= len(items):
        return items
    if most < 1:
        raise _nothing_to_compare()
    return [items[i] for i in np.sort(np.random.default_rng(0).permutation(len(items))[:most])]


def _nothing_to_compare() -> UsageError:
    return UsageError("comparing needs at least one method, one number of points and one seed.")


def _no_lattice(data: Dataset) -> DatasetError:
    found = [len(np.unique(values)) for values in data.xyz.T]
    return DatasetError(
        f"the {len(data)} known positions of {data.name!r} stand on no lattice with an inner plane.",
        why=f"x, y and z have {found[0]}, {found[1]} and {found[2]} values; a lattice has three or more, each shared "
        f"by {MIN_POINTS_PER_PLANE} points or more within {MAX_PLANE_THICKNESS:g} of the extent. Planes are looked for "
        "across x, y and z of the "
        "world only, not across a lattice that stands at an angle",
        fix="leave out --lattice: away from a lattice a random split has no such bias; or --leave-out shot, where each "
        "plane is a shot",
    )
