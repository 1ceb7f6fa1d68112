"""A wand: two markers a known distance apart, seen again and again at places that nobody knows.

A dataset without known positions whose points are markers in frames: the columns `frame` and `marker` say which. The
table [target] of dataset.toml may say more:

    kind = "wand", ends = ["a", "b"], length = 500.0, length_sd = 0.05, jitter = 0.02

ends: the two markers of the wand, where there are others besides; length: between them, in the dataset's unit;
length_sd: standard uncertainty of the length, one error for all frames; jitter: how much the length varies from frame
to frame, by flex and by what a detector takes for the middle of a marker. Other markers are single points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.model import Dataset
from implicam.errors import DatasetError, did_you_mean

WAND = "wand"
"""Kind of the target."""

FRAME, MARKER = "frame", "marker"
"""Columns of points."""


class Wand(NamedTuple):
    """What is known of a wand: names of its two markers (none: the only two there are), its length (0: not stated), its
    standard uncertainty, and the sd of the length from frame to frame (0: not stated), in the dataset's unit."""

    ends: tuple[str, ...] = ()
    length: float = 0.0
    length_sd: float = 0.0
    jitter: float = 0.0

    def as_table(self) -> dict[str, Any]:
        """The table [target]."""
        stated = {"length": self.length, "length_sd": self.length_sd, "jitter": self.jitter}
        ends = {"ends": list(self.ends)} if self.ends else {}
        return {"kind": WAND, **ends, **{name: value for name, value in stated.items() if value}}


def wand_of(data: Dataset) -> Wand | None:
    """What [target] says of a wand.

    Args:
        data: The dataset.

    Returns:
        The wand; None where the target is another.

    Raises:
        DatasetError: The table makes no sense.
    """
    target = data.extra.get("target")
    if not isinstance(target, Mapping) or target.get("kind") != WAND:
        return None
    ends = target.get("ends", ())
    if not isinstance(ends, list | tuple) or len(ends) not in (0, 2) or not all(isinstance(one, str) for one in ends):
        raise _error(f"ends = {ends!r} must be the names of two markers")
    numbers = {}
    for name in ("length", "length_sd", "jitter"):
        value = target.get(name, 0.0)
        if type(value) not in (int, float) or not 0 <= value < 1e9:
            raise _error(f"{name} = {value!r} must be a length")
        numbers[name] = float(value)
    return Wand(tuple(ends), **numbers)


def marker_rows(data: Dataset, ends: tuple[str, ...]) -> tuple[list[str], NDArray[np.int64]]:
    """Frames of the wand, and single points.

    Args:
        data: Markers in frames.
        ends: Names of the wand's two markers; none where the data have no others.

    Returns:
        (F,) the name of each frame, and (F, 2) the rows of both ends in the data, -1 for one that is not there; after
        the wand's frames those of single points, in the first column.

    Raises:
        DatasetError: The points are no markers in frames, the ends are not among them, or cannot be told.
    """
    columns = data.further_columns()
    if not {FRAME, MARKER} <= columns.keys():
        raise DatasetError(
            f"dataset {data.name!r} does not say which of its points are the two ends of a wand at one instant.",
            why=f"it has no columns {FRAME!r} and {MARKER!r}",
            fix="add them: a row a point, with the number of the frame and the name of the marker (docs/formats.md)",
        )
    frames, markers = (columns[name].tolist() for name in (FRAME, MARKER))
    names = list(dict.fromkeys(markers))
    if not ends:
        if len(names) != 2:
            plural = "s" * (len(names) != 1)
            raise DatasetError(
                f"dataset {data.name!r} has {len(names)} marker{plural} ({', '.join(names[:5])}), and a wand two.",
                why="which of them are its ends is not said" if len(names) > 2 else "",
                fix="--wand-ends A,B (the others are single points)"
                if len(names) > 2
                else f"name both, each point's in the column {MARKER!r}",
            )
        ends = tuple(names)
    for end in ends:
        if end not in names:
            raise DatasetError(
                f"dataset {data.name!r} has no marker {end!r}{did_you_mean(end, names)}.",
                fix=f"its markers are {', '.join(names[:10])}",
            )
    at: dict[str, list[int]] = {}
    single = []
    for row, (frame, marker) in enumerate(zip(frames, markers, strict=True)):
        if marker not in ends:
            single.append(row)
            continue
        place = at.setdefault(frame, [-1, -1])
        if place[ends.index(marker)] >= 0:
            raise DatasetError(
                f"marker {marker!r} is twice in frame {frame!r} of dataset {data.name!r}.", fix="keep one of the two"
            )
        place[ends.index(marker)] = row
    rows = [*at.values(), *([row, -1] for row in single)]
    return [*at, *(frames[row] for row in single)], np.array(rows, dtype=np.int64).reshape(-1, 2)


STILL_PX, STILL_SHARE = 1.0, 0.7
"""A marker lies still where this share of its views are within so many pixels (of an image of 1280) of those of a frame
before."""


def lying_still(data: Dataset, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Frames in which nothing moved since one before: the same place seen again, with the same errors of detector and
    lens. Copies of any earlier frame, to the last digit, too: an export that repeats itself tells nothing new.

    Args:
        data: Markers in frames.
        rows: (F, 2) as of `marker_rows`.

    Returns:
        (F,) number of the first frame at that place, its own where it is that.
    """
    uv = data.observations.uv
    half = np.array([max(c.width or 1280, c.height or 0) / 2 for c in data.cameras]) / 640
    markers = data.further_columns()[MARKER]
    first, last = np.arange(len(rows)), dict[str, int]()
    alike = dict[str, int]()
    for f, pair in enumerate(rows.tolist()):
        seen = np.array([uv[row] if row >= 0 else np.full(uv.shape[1:], np.nan) for row in pair])
        if np.isfinite(seen[..., 0]).sum() >= 4 and (same := alike.setdefault(str(seen.tolist()), f)) != f:
            first[f] = first[same]
            continue
        key = str(markers[pair[0]]) if pair[0] >= 0 and pair[1] < 0 else ""
        single = key != "" and key in last and (rows[last[key]] >= 0).sum() == 1
        before = last.get(key) if key == "" or single else None
        if before is not None:
            both = [(a, b) for a, b in zip(rows[before].tolist(), pair, strict=True) if a >= 0 and b >= 0]
            off = (
                np.concatenate([np.linalg.norm(uv[a] - uv[b], axis=1) / half for a, b in both]) if both else np.zeros(0)
            )
            off = off[np.isfinite(off)]
            if len(off) >= 2 and np.mean(off <= STILL_PX) >= STILL_SHARE:
                first[f] = before
                continue
        last[key] = f
    return first


def each_place_once(data: Dataset, rows: NDArray[np.int64], first: NDArray[np.int64]) -> Dataset:
    """The markers with the middle of the pixels of all frames in which they lay still, at the first of these.

    Args:
        data: Markers in frames.
        rows: (F, 2) as of `marker_rows`.
        first: (F,) as of `lying_still`.
    """
    uv = data.observations.uv.copy()
    for f in np.flatnonzero(np.bincount(first, minlength=len(rows)) > 1):
        for end in (0, 1):
            mine = rows[first == f, end]
            mine = mine[mine >= 0]
            if rows[f, end] < 0 or not len(mine):
                continue
            seen = np.isfinite(data.observations.uv[mine, :, 0]).any(axis=0) & np.isfinite(uv[rows[f, end], :, 0])
            uv[rows[f, end], seen] = np.nanmedian(data.observations.uv[mine][:, seen], axis=0)
    return replace(data, observations=replace(data.observations, uv=uv))


def _error(why: str) -> DatasetError:
    return DatasetError(
        "[target] in dataset.toml does not describe a wand.",
        why=why,
        fix='it needs kind = "wand"; and may have ends, length, length_sd and jitter, in the dataset\'s length unit',
    )
