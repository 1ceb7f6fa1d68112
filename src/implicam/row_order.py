"""Why no camera sees the known points at these pixels: rows that do not belong together, by one camera's own views.

A video that starts a picture late, a frame that was dropped, a row that slipped in a spreadsheet, a table read from its
end, a camera that was moved half-way, pictures of two sizes: each shows in a linear camera, if it fits well once the
rows are corrected. A linear one is enough: it needs no guess, and lens distortion is small beside the error of a wrong
row. What concerns a whole rig is in mistakes.py.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.errors import FitError
from implicam.geometry import resect_robustly

Floats = NDArray[np.float64]

MAX_ROW_SHIFT = 3
"""By so many rows the pixels may be late or early."""

REVERSED = 0
"""In place of a number of rows: from the last row to the first."""

MIN_VIEWS = 10
"""Views that a linear camera is fitted to here: 20 numbers for 11."""

MAX_ERROR_RATIO = 0.2
"""What is left with the rows put right, in what is left as they are, that says that they were wrong."""

MAX_RELATIVE_ERROR = 0.02
"""And in half the extent of the pixels."""

MISFIT_ERROR_MEDIANS = 10.0
"""Times the median error, for a row that does not fit."""

MIN_MISFITS, MIN_MISFIT_SHARE = 4, 0.03
"""Such rows, and their share, that are more than wrong detections if they all fit once the rows are moved."""

MIN_REPEATED_PIXELS, MIN_REPEATED_SHARE = 5, 0.2
"""Pixels that are those of the row before, and their share, which are no chance."""

MAX_ROWS = 1000
"""Rows that are looked at."""


class Order(NamedTuple):
    """The order that a camera's pixels are in, where it is not that of the points.

    Attributes:
        rows: By how many rows they are late, below zero early; or `REVERSED`.
        fit: How well they fit once that is corrected, in words.
    """

    rows: int
    fit: str

    @property
    def how(self) -> str:
        """The order in words."""
        return "in the order from the last row to the first" if self.rows == REVERSED else describe_shift(self.rows)


def describe_shift(rows: int) -> str:
    """A number of rows in words.

    Args:
        rows: Above zero for late, below for early.
    """
    return f"{abs(rows)} row{'s' * (abs(rows) > 1)} {'late' if rows > 0 else 'early'}"


def shift_rows(values: Floats, rows: int) -> Floats:
    """Give each row the values of a later one.

    Args:
        values: (n, ...).
        rows: How many rows later; below zero earlier.

    Returns:
        (n, ...), NaN where there is no such row.
    """
    out = np.full_like(values, np.nan)
    if abs(rows) >= len(values):
        return out
    if rows >= 0:
        out[: len(values) - rows] = values[rows:]
    else:
        out[-rows:] = values[:rows]
    return out


def describe_moved_camera(row: int) -> str:
    """A camera that moved, in words, with the cure.

    Args:
        row: The first row after the move, from zero.
    """
    return (
        f"from row {row + 1} on it sees like another camera: was it moved, turned or refocused there? Then take the "
        "known points before it, or those after it"
    )


def find_row_order(points: Floats, uv: Floats) -> Order | None:
    """The order that a camera's pixels are in.

    Args:
        points: (n, 3) known points, in the order in which they were seen.
        uv: (n, 2) pixels of one camera, NaN where not seen.

    Returns:
        The order; None where it is that of the points, or cannot be told.
    """
    ways = {rows: shift_rows(uv, rows)[:MAX_ROWS] for rows in _shifts()} | {REVERSED: uv[::-1][:MAX_ROWS]}
    points, uv = points[:MAX_ROWS], uv[:MAX_ROWS]
    as_is = _errors_seen(points, uv, at_best=True)  # wrong detections alone must not make the order look wrong
    if not len(as_is):
        return None
    now, far = float(np.median(as_is)), MISFIT_ERROR_MEDIANS * float(np.median(as_is))
    put_right = {rows: errors for rows, way in ways.items() if len(errors := _errors_seen(points, way))}
    if not put_right:
        return None
    misfits = {rows: float(np.mean(np.minimum(errors, far))) for rows, errors in put_right.items()}
    best = min(misfits, key=lambda rows: misfits[rows])
    left, tolerable = float(np.median(put_right[best])), MAX_RELATIVE_ERROR * _half(uv)
    if left < MAX_ERROR_RATIO * now and left < tolerable:
        return Order(best, f"they fit to {left:.2g} px, as they are to {now:.2g}")
    # a lattice that slips along itself fits as it did, but for the ends of its lines; one that is turned over fits as
    # it did in all of them, and there a few wrong views would decide
    misfits.pop(REVERSED, None)
    if not misfits:
        return None
    best = min(misfits, key=lambda rows: misfits[rows])
    left = float(np.median(put_right[best]))
    if not left < tolerable:
        return None
    before, after = (int(np.sum(errors > MISFIT_ERROR_MEDIANS * max(left, now))) for errors in (as_is, put_right[best]))
    if before >= max(MIN_MISFITS, MIN_MISFIT_SHARE * len(as_is)) and after <= MAX_ERROR_RATIO * before:
        return Order(best, f"{f'all but {after}' if after else 'all'} fit, as they are {before} of {len(as_is)} do not")
    return None


def describe_order(order: Order) -> str:
    """The order of one camera in words.

    Args:
        order: As of `find_row_order`.
    """
    return f"its pixels are {order.how}: put right {order.fit}"


def describe_change(points: Floats, uv: Floats) -> str:
    """What is wrong with a camera from some row on, or in some rows.

    Args:
        points: (n, 3) known points, in the order in which they were seen.
        uv: (n, 2) pixels of one camera, NaN where not seen.

    Returns:
        It in words; empty where nothing is wrong.
    """
    return _repeated(points, uv) or _in_two_parts(points, uv)


def describe_row_mistake(points: Floats, uv: Floats) -> str:
    """What is wrong with the rows of a camera that misses its known points: their order, or `describe_change`.

    Args:
        points: (n, 3) known points, in the order in which they were seen.
        uv: (n, 2) pixels of one camera, NaN where not seen.

    Returns:
        It in words; empty where the rows show nothing.
    """
    order = find_row_order(points, uv)
    return describe_change(points, uv) if order is None else describe_order(order)


def _repeated(points: Floats, uv: Floats) -> str:
    """Pictures that are there twice: a camera that is slower than the others, or froze."""
    same = (uv[1:] == uv[:-1]).all(axis=1) & (points[1:] != points[:-1]).any(axis=1)
    count, seen = int(same.sum()), int(np.isfinite(uv[:, 0]).sum())
    if count < max(MIN_REPEATED_PIXELS, MIN_REPEATED_SHARE * seen):
        return ""
    return f"{count} of its {seen} pixels are those of the row before, to the last bit: its pictures are there twice"


def _in_two_parts(points: Floats, uv: Floats) -> str:
    """Rows of which the first and the last fit well, but not with the same camera, or not as they stand."""
    points, uv = points[:MAX_ROWS], uv[:MAX_ROWS]
    seen = np.flatnonzero(np.isfinite(uv[:, 0]))
    size = max(MIN_VIEWS, len(seen) // 3)
    if len(seen) < 2 * size:
        return ""
    first, last = slice(0, seen[size - 1] + 1), slice(seen[-size], None)
    before, after = _shift_of(points[first], uv[first]), _shift_of(points[last], uv[last])
    if before is None or after is None or (before == after and before != 0):
        return ""
    views = [shift_rows(uv, before), shift_rows(uv, after)]
    cameras = _camera(points[first], views[0][first]), _camera(points[last], views[1][last])
    if cameras[0] is None or cameras[1] is None:
        return ""
    errors = _errors(cameras[0], points, views[0]), _errors(cameras[1], points, views[1])
    row = _row_of_change(*errors)
    now = float(np.median(_errors_seen(points, uv, at_best=True)))
    if before != after:
        together = np.concatenate([views[0][:row], views[1][row:]])
        if not float(np.median(_errors_seen(points, together, at_best=True))) < MAX_ERROR_RATIO * now:
            return ""
        slip = describe_shift(after - before)
        return f"from about row {row + 1} on its pixels are {slip}: a picture or a row is there twice, or missing"
    if not seen[0] < row <= seen[-1]:
        return ""
    alone = max(float(np.nanmedian(errors[0][:row])), float(np.nanmedian(errors[1][row:])))
    if not alone < MAX_ERROR_RATIO * now:
        return ""
    ratio = _pixel_ratio(points, cameras[0], cameras[1])
    if ratio is not None:
        return f"from row {row + 1} on its pictures are {ratio:.3g} times the size of those before"
    return describe_moved_camera(row)


def _shift_of(points: Floats, uv: Floats) -> int | None:
    """By how many rows the pixels are late, so that a camera fits; None where none does."""
    left = {rows: _left(points, shift_rows(uv, rows)) for rows in (0, *_shifts())}
    best = min(left, key=lambda rows: (left[rows], abs(rows)))
    best = best if left[best] < MAX_ERROR_RATIO * left[0] else 0
    return best if left[best] < MAX_RELATIVE_ERROR * _half(uv) else None


def _shifts() -> list[int]:
    return [rows for rows in range(-MAX_ROW_SHIFT, MAX_ROW_SHIFT + 1) if rows]


def _camera(points: Floats, uv: Floats, *, at_best: bool = False) -> Floats | None:
    """(3, 4) the linear camera that sees most of the points at their pixels, as `resect_robustly`; None for too few.

    at_best: the least that any camera leaves, however few views it fits; else they must be MIN_VIEWS."""
    seen = np.isfinite(uv[:, 0])
    if seen.sum() < MIN_VIEWS:
        return None
    subsets = at_best and bool(seen.sum() >= 2 * MIN_VIEWS)  # of fewer some subset fits half, whatever they are
    try:
        camera, kept = resect_robustly(points[seen], uv[seen], subsets=subsets)
    except (FitError, np.linalg.LinAlgError):
        return None
    return camera if at_best or kept.sum() >= MIN_VIEWS else None


def _errors(camera: Floats, points: Floats, uv: Floats) -> Floats:
    return np.asarray(np.linalg.norm(_pixels(camera, points) - uv, axis=1), dtype=np.float64)


def _pixels(camera: Floats, points: Floats) -> Floats:
    ends = points @ camera[:, :3].T + camera[:, 3]
    with np.errstate(all="ignore"):  # no pixel beside the camera
        return np.asarray(ends[:, :2] / ends[:, 2:], dtype=np.float64)


def _errors_seen(points: Floats, uv: Floats, *, at_best: bool = False) -> Floats:
    """Of the rows that are seen, in pixels, by the camera that fits them; none where none can be fitted."""
    camera = _camera(points, uv, at_best=at_best)
    return np.zeros(0) if camera is None else _errors(camera, points, uv)[np.isfinite(uv[:, 0])]


def _left(points: Floats, uv: Floats) -> float:
    """Median error in pixels of all rows that are seen."""
    errors = _errors_seen(points, uv)
    return float(np.median(errors)) if len(errors) else np.inf


def _half(uv: Floats) -> float:
    return float(np.nanmax(np.nanmax(uv, axis=0) - np.nanmin(uv, axis=0))) / 2


def _row_of_change(first: Floats, last: Floats) -> int:
    """The row from which errors (n,) of the last camera are smaller than those of the first."""
    first, last = np.nan_to_num(first), np.nan_to_num(last)
    most = 3 * max(float(np.median(first)), float(np.median(last)))  # a wrong view must not decide
    worse = np.minimum(first, most) - np.minimum(last, most)
    return int(np.argmin(np.concatenate([[0.0], np.cumsum(worse)])))


def _pixel_ratio(points: Floats, first: Floats, last: Floats) -> float | None:
    """How many times larger the pictures of the last camera are, where they are the first one's, resized."""
    before, after = _pixels(first, points), _pixels(last, points)
    ratio = float(np.median(np.linalg.norm(after, axis=1) / np.linalg.norm(before, axis=1)))
    same = np.median(np.linalg.norm(after - ratio * before, axis=1)) < MAX_RELATIVE_ERROR * _half(after)
    return ratio if same and abs(np.log(ratio)) > 0.1 else None
