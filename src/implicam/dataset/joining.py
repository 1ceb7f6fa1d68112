"""One dataset of the points of several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
from typing import cast

import numpy as np

from implicam.dataset.model import Dataset, KnownPositions, Names, Observations
from implicam.errors import DatasetError, UsageError


def join(*datasets: Dataset | Sequence[Dataset]) -> Dataset:
    """One dataset of the points of several, named and described as the first.

    Args:
        datasets: In the order of their points, one by one or as a list; with the same cameras and length unit, and all
            with known positions or none.

    Raises:
        UsageError: There is none, or one of them is no dataset.
        DatasetError: Two do not belong together, or a point has the same name in both.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> len(ic.join(rig.select(range(10)), rig.select(range(10, 30))))
    30
    """
    given: list[object] = []
    for one in datasets:
        given += one if isinstance(one, list | tuple) else [one]
    for part in given:
        if not isinstance(part, Dataset):
            raise UsageError(f"a {type(part).__name__} is no dataset.", fix="join(a, b), both of read_dataset say")
    if not given:
        raise UsageError("no dataset is given.", fix="join(a, b)")
    return reduce(_join_two, cast(list[Dataset], given))


def _join_two(first: Dataset, second: Dataset) -> Dataset:
    if first.cameras != second.cameras or first.length_unit != second.length_unit:
        raise DatasetError(
            f"datasets {first.name!r} and {second.name!r} do not belong to one rig.",
            why="their cameras or length units differ",
            fix="join only datasets with the same [[cameras]] and length_unit",
        )
    if (first.known is None) != (second.known is None):
        raise DatasetError("one dataset has known positions and the other has none.", fix="join datasets of one kind")
    a, b = first.observations, second.observations
    observations = Observations(
        np.concatenate([a.points, b.points]),
        a.cameras,
        np.concatenate([a.uv, b.uv]),
        np.concatenate([a.sd, b.sd]),
        _join_columns(a.extra, b.extra, a.uv.shape[:2], b.uv.shape[:2]),
    )
    known = None
    if first.known and second.known:
        p, q = first.known, second.known
        known = KnownPositions(
            np.concatenate([p.shots, q.shots]),
            np.concatenate([p.xyz, q.xyz]),
            np.concatenate([p.sd, q.sd]),
            _join_columns(p.extra, q.extra, (len(first),), (len(second),)),
        )
    columns = _join_columns(first.columns, second.columns, (len(first),), (len(second),))
    return replace(first, observations=observations, known=known, columns=columns)


def _join_columns(
    a: Mapping[str, Names], b: Mapping[str, Names], shape_a: tuple[int, ...], shape_b: tuple[int, ...]
) -> dict[str, Names]:
    keys = [*a, *(key for key in b if key not in a)]
    empty_a, empty_b = np.full(shape_a, ""), np.full(shape_b, "")
    return {key: np.concatenate([a.get(key, empty_a), b.get(key, empty_b)]) for key in keys}
