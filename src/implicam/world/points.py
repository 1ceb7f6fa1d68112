"""Points that say where a world is: seen, standing still, and not on one line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from implicam.dataset import Dataset, KnownPositions
from implicam.dataset.wand import FRAME, MARKER
from implicam.errors import DatasetError, FitError, did_you_mean
from implicam.formatting import list_some
from implicam.geometry import Floats
from implicam.measurement import Measurement
from implicam.rig_model.placement import Placement

MIN_POINTS = 3
"""Known points, or points of a plane, that a world takes."""

MAX_CHANCE_PROBABILITY = 1e-4
"""Known points contradict each other, or a plane is none, where chance would leave so much so rarely."""

MIN_SPREAD = 0.02
"""Extent of points across their longest direction, over that along it, below which they lie on one line."""

MAX_STILL_PX = 3.0
"""Median distance of a marker's pixels from their middle over several frames: it moves."""


class Laid(NamedTuple):
    """A placement, and what to tell of it."""

    placement: Placement
    told: tuple[str, ...]


def refuse_line(xyz: Floats, what: str, names: Sequence[str]) -> None:
    """Stop where points lie on one line.

    Args:
        xyz: (n, 3).
        what: They are.
        names: Of them.

    Raises:
        FitError: They do.
    """
    sizes = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if sizes[1] < MIN_SPREAD * sizes[0] or not sizes[0] > 0:
        raise FitError(
            f"the {what} {list_some(list(map(str, names)))} lie on one line.",
            why="the world could turn about it",
            fix="add one that is well beside this line",
        )


def require_measured(measured: Measurement, count: int, least: int, what: str) -> None:
    """Stop where too few points can be measured, and say why.

    Args:
        measured: The points.
        count: Of those that could be.
        least: So many are needed.
        what: They are.

    Raises:
        DatasetError: There are fewer.
    """
    if count < least:
        lost = [f"{measured.points[i]}: {measured.reason[i]}" for i in np.flatnonzero(~measured.measured)]
        raise DatasetError(
            f"{count} of the {what} can be measured; a world takes {least}.",
            why="; ".join(lost[:5]),
            fix="show them to two calibrated cameras or more",
        )


def standing_points(data: Dataset, names: Sequence[str]) -> Dataset:
    """The points named, each once: a marker that stands still in several frames is one point, as exact as in one frame,
    since what a camera or a detector is off by there is the same in all.

    Args:
        data: Points, or markers in frames.
        names: Of points or markers.

    Raises:
        DatasetError: One is not there, or moves.
    """
    known = set(map(str, data.points))
    columns = data.further_columns()
    markers = columns[MARKER] if {FRAME, MARKER} <= columns.keys() else None
    rows: list[int] = []
    uv = data.observations.uv.copy()
    labels = []
    for name in names:
        if name in known:
            rows.append(int(np.flatnonzero(data.points == name)[0]))
        elif markers is not None and (markers == name).any():
            mine = np.flatnonzero(markers == name)
            rows.append(int(mine[0]))
            uv[mine[0]] = _still(uv[mine], name)
        else:
            every = [*known, *(() if markers is None else set(markers.tolist()))]
            raise DatasetError(
                f"dataset {data.name!r} has no point {name!r}{did_you_mean(name, every)}.",
                fix=f"its points are {list_some(sorted(every))}",
            )
        labels.append(name)
    observations = replace(data.observations, uv=uv).select(np.array(rows))
    return replace(data, observations=replace(observations, points=np.array(labels)), known=None, columns={})


def _still(uv: Floats, name: str) -> Floats:
    """(C, 2) the middle of pixels (k, C, 2) of a marker in k frames."""
    with np.errstate(all="ignore"):
        seen = np.isfinite(uv).all(axis=2).sum(axis=0) > 0
        middle = np.full(uv.shape[1:], np.nan)
        middle[seen] = np.nanmedian(uv[:, seen], axis=0)
        off = np.linalg.norm(uv - middle, axis=2)
        if np.isfinite(off).any() and np.nanmedian(off) > MAX_STILL_PX:
            raise DatasetError(
                f"marker {name!r} moves: its pixels are {np.nanmedian(off):.0f} from their middle (median).",
                fix="a point that says where the world is stands still; name one frame's point, as in '12 a'",
            )
    return middle


def with_known_positions(data: Dataset, names: Sequence[str], known: KnownPositions) -> Dataset:
    """What cameras saw of points whose positions are stated elsewhere.

    Args:
        data: Views of points, or of markers that stand still.
        names: Of the known positions.
        known: These, in the same order.

    Raises:
        DatasetError: None of the names is there.
    """
    columns = data.further_columns()
    there = set(map(str, data.points)) | set(columns[MARKER].tolist() if MARKER in columns else ())
    rows = [i for i, name in enumerate(names) if name in there]
    if not rows:
        raise DatasetError(
            f"none of the {len(names)} known points is in dataset {data.name!r}.",
            why=f"it has {list_some(sorted(there))}",
            fix="names of points, or of markers, must be the same in both",
        )
    found = standing_points(data, [names[i] for i in rows])
    return replace(found, known=known.select(np.array(rows)))
