"""Mistakes that people make with known points, and that the numbers themselves give away, named before all else.

Positions partly in another unit, and rows that belong to other rows. No such sentence is a guess: with the mistake
undone the numbers fit, and as they are they do not.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Dataset, Floats
from implicam.dataset.copies import without_copies
from implicam.errors import FitError
from implicam.geometry import resect

UNITS = {
    1000.0: "metres and millimetres, say",
    100.0: "metres and centimetres, say",
    25.4: "inches and millimetres, say",
}
"""By how much positions in two units differ."""

FEWEST_IN_UNIT = 3
"""Points in another unit."""

ALIKE = (0.1, 3.0)
"""Width of the points in another unit, once converted, over that of the others; of their pixels at least the first."""

FEWEST_VIEWS = 10
"""Views of a camera by whose fit an order of the rows can be told from another: 20 numbers for 11."""

ROWS = (1, -1, 2, -2, 0)
"""Rows by which views come later than their positions, as they are tried; 0: from the last row to the first."""

FITS, BETTER = 0.05, 0.25
"""Misfit of a linear camera in the right order, over the spread of its pixels, and over that of the order as it is."""

MOST = 0.9
"""Share of the views that a misfit is of: the rest may be wrong detections. In a lattice most rows fit one row on."""


class Mistake(NamedTuple):
    """A sentence with its cure; grave where no camera can be right."""

    grave: bool
    reason: str


def mistakes_in(data: Dataset) -> list[Mistake]:
    """What is plainly wrong with the known points; empty where nothing is, or where there are none."""
    if data.known is None:
        return []
    data = without_copies(data)
    return list(_two_units(data)) or list(_other_rows(data))


@contextmanager
def mistakes_named(data: Dataset) -> Iterator[None]:
    """Where a fit fails, the mistake is its reason if there is one."""
    try:
        yield
    except FitError as error:
        found = mistakes_in(data)
        if not found:
            raise
        raise FitError(error.what, why=" ".join(one.reason for one in found), fix="correct them first") from error


def _two_units(data: Dataset) -> Iterator[Mistake]:
    xyz = data.xyz
    size = np.linalg.norm(xyz, axis=1)
    order = np.argsort(size)
    if len(xyz) < 2 * FEWEST_IN_UNIT or not size[order[0]] > 0:
        return
    parts = range(FEWEST_IN_UNIT, len(xyz) - FEWEST_IN_UNIT + 1)
    k = max(parts, key=lambda k: float(size[order[k]] / size[order[k - 1]]))
    few, many = order[:k], order[k:]
    low, high = xyz[many].min(axis=0), xyz[many].max(axis=0)
    width = float(np.linalg.norm(high - low))
    for factor, units in UNITS.items():
        converted = factor * xyz[few]
        ratio = float(np.linalg.norm(np.ptp(converted, axis=0))) / max(width, 1e-300)
        beside = (converted > low - 0.5 * width) & (converted < high + 0.5 * width)
        apart = size[few].max() * 2 < size[many].min()
        if apart and ALIKE[0] < ratio < ALIKE[1] and beside.all() and _as_wide(data, few, many):
            names = ", ".join(str(data.points[i]) for i in np.sort(few)[:3])
            yield Mistake(
                True,
                f"{len(few)} of {len(xyz)} known positions ({names}, ...) are in another unit than the rest: times "
                f"{factor:g} they lie among them ({units}). Give all of them in one unit.",
            )
            return


def _as_wide(data: Dataset, few: NDArray[np.int64], many: NDArray[np.int64]) -> bool:
    """Whether cameras see points that are told to be at one place as far apart as the others."""
    uv = data.observations.uv
    ratios = []
    for c in range(uv.shape[1]):
        widths = [_spread(uv[rows, c]) for rows in (few, many)]
        if all(width > 0 for width in widths):
            ratios.append(widths[0] / widths[1])
    return bool(ratios) and float(np.median(ratios)) > ALIKE[0]


def _spread(uv: Floats) -> float:
    """Of pixels (n, 2) about their middle; zero for fewer than two."""
    uv = uv[~np.isnan(uv[:, 0])]
    return float(np.sqrt(np.mean(np.sum((uv - uv.mean(axis=0)) ** 2, axis=1)))) if len(uv) > 1 else 0.0


def _other_rows(data: Dataset) -> Iterator[Mistake]:
    """Each camera alone: do its views fit the positions of other rows, and not those of their own?"""
    names = data.observations.camera_names
    own = {name: _misfit(data.xyz, data.observations.uv[:, c]) for c, name in enumerate(names)}
    tested = [name for name in names if own[name] > FITS / 10]  # of the others nothing could be better
    moved: dict[int, list[str]] = {}
    for rows in ROWS:
        misfits = {
            name: _misfit(data.xyz, _moved_up(data.observations.uv[:, names.index(name)], rows)) for name in tested
        }
        moved[rows] = [name for name in tested if misfits[name] < min(FITS, BETTER * own[name])]
    rows = max(moved, key=lambda rows: len(moved[rows]))
    if not moved[rows]:
        return
    if len(moved[rows]) > 0.5 * sum(np.isfinite(misfit) for misfit in own.values()):
        yield Mistake(
            True,
            f"The known positions are in another order than the views: {_row_words(rows)} the views of "
            f"{_and(moved[rows])} fit them, and as they are they do not. Look at how rows were matched with pictures.",
        )
        return
    for rows, some in moved.items():
        some = [name for name in some if all(name not in moved[other] for other in ROWS if abs(other) < abs(rows))]
        if some:
            yield Mistake(
                False,
                f"Are the pictures of {_and(some)} of other instants than the others'? {_row_words(rows).capitalize()} "
                "they fit the known positions, and as they are they do not.",
            )


def _row_words(rows: int) -> str:
    if rows == 0:
        return "read from the last row to the first"
    return f"{abs(rows)} row{'s' * (abs(rows) > 1)} {'earlier' if rows > 0 else 'later'}"


def _and(names: list[str]) -> str:
    return " and ".join(names) if len(names) < 3 else f"{', '.join(names[:-1])} and {names[-1]}"


def _moved_up(uv: Floats, rows: int) -> Floats:
    """Each row with the view of the one `rows` after it, NaN where there is none; 0: the other way round."""
    if rows == 0:
        return uv[::-1]
    moved = np.roll(uv, -rows, axis=0)
    moved[slice(-rows, None) if rows > 0 else slice(None, -rows)] = np.nan
    return moved


def _misfit(xyz: Floats, uv: Floats) -> float:
    """Misfit of a linear camera to MOST of the views, over the spread of its pixels; NaN for too few views."""
    seen = ~np.isnan(uv[:, 0])
    if seen.sum() < FEWEST_VIEWS:
        return float("nan")
    xyz, uv = xyz[seen], uv[seen]
    kept = np.ones(len(uv), dtype=np.bool_)
    error = np.zeros(len(uv))
    try:
        for _ in range(3):
            p = resect(xyz[kept], uv[kept])
            seen_at = np.column_stack([xyz, np.ones(len(xyz))]) @ p.T
            with np.errstate(all="ignore"):
                error = np.nan_to_num(np.linalg.norm(seen_at[:, :2] / seen_at[:, 2:] - uv, axis=1), nan=np.inf)
            kept = error <= 3 * np.median(error)
    except (FitError, np.linalg.LinAlgError):
        return float("nan")
    return float(np.quantile(error, MOST)) / max(_spread(uv), 1e-300)
