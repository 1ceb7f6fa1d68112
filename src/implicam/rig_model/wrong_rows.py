"""Why no camera sees the known points at these pixels: rows that do not belong together, by the camera's own views.

A video that starts a picture late, a frame that was dropped, a row that slipped in a spreadsheet, a camera that was
knocked half-way, pictures of two sizes: of each a plain camera tells, if it fits well once the rows are put right. A
linear one is enough: it needs no guess, and what a lens bends is little beside what a wrong row is off by.
"""

from __future__ import annotations

import numpy as np

from implicam.errors import FitError
from implicam.geometry import Bools, Floats, resect, resect_robustly

SLIPPED = 3
"""By so many rows the pixels may be late or early."""

FEWEST = 12
"""Views that a linear camera, of eleven numbers, is fitted to here."""

CLEAR = 0.2
"""What is left with the rows put right, in what is left as they are, that says that they were wrong."""

TOLERABLE = 0.02
"""And in half the extent of the pixels."""

FAR = 10.0
"""Times the median error, for a row that does not fit."""

FEWEST_ENDS, ENDS = 4, 0.03
"""Such rows, and their share, that are more than wrong detections if they all fit once the rows are moved."""

FEWEST_REPEATED, REPEATED = 5, 0.2
"""Pixels that are those of the row before, and their share, which are no chance."""

MOST = 1000
"""Rows that are looked at."""


def slipped(points: Floats, uv: Floats) -> str:
    """Of known points (n, 3) in the order they were seen in, at pixels (n, 2), NaN where not seen: by how many rows the
    pixels are late or early, in words; empty where they are not."""
    points, uv = points[:MOST], uv[:MOST]
    as_is = _best_errors(points, uv)
    if not len(as_is):
        return ""
    now, far = float(np.median(as_is)), FAR * float(np.median(as_is))
    moved = {shift: _all_errors(points, _moved_up(uv, shift)) for shift in _shifts()}
    best = min(moved, key=lambda shift: float(np.mean(np.minimum(moved[shift], far))) if len(moved[shift]) else np.inf)
    if not len(moved[best]):
        return ""
    left = float(np.median(moved[best]))
    if not left < TOLERABLE * _half(uv):
        return ""
    words = f"its pixels are {_rows(best)}: moved back to their places"
    if left < CLEAR * now:
        return f"{words} they fit to {left:.2g} px, as they are to {now:.2g}"
    # a lattice that slips along itself fits as it did, but for the ends of its lines
    before, after = (int(np.sum(errors > FAR * max(left, now))) for errors in (as_is, moved[best]))
    if before >= max(FEWEST_ENDS, ENDS * len(as_is)) and after <= CLEAR * before:
        return f"{words} {f'all but {after}' if after else 'all'} fit, as they are {before} of {len(as_is)} do not"
    return ""


def what_is_wrong(points: Floats, uv: Floats) -> str:
    """The same of a camera that misses its known points, for whatever reason that its rows show."""
    return slipped(points, uv) or _repeated(points, uv) or _in_two_parts(points, uv)


def _repeated(points: Floats, uv: Floats) -> str:
    """Pictures that are there twice: a camera that is slower than the others, or froze."""
    same = (uv[1:] == uv[:-1]).all(axis=1) & (points[1:] != points[:-1]).any(axis=1)
    count, seen = int(same.sum()), int(np.isfinite(uv[:, 0]).sum())
    if count < max(FEWEST_REPEATED, REPEATED * seen):
        return ""
    return f"{count} of its {seen} pixels are those of the row before, to the last bit: its pictures are there twice"


def _in_two_parts(points: Floats, uv: Floats) -> str:
    """Rows of which the first and the last fit well, but not with the same camera, or not as they stand."""
    points, uv = points[:MOST], uv[:MOST]
    seen = np.flatnonzero(np.isfinite(uv[:, 0]))
    size = max(FEWEST, len(seen) // 3)
    if len(seen) < 2 * size:
        return ""
    first, last = slice(0, seen[size - 1] + 1), slice(seen[-size], None)
    before, after = _shift_of(points[first], uv[first]), _shift_of(points[last], uv[last])
    if before is None or after is None or (before == after and before != 0):
        return ""
    views = [_moved_up(uv, before), _moved_up(uv, after)]
    cameras = _camera(points[first], views[0][first]), _camera(points[last], views[1][last])
    if cameras[0] is None or cameras[1] is None:
        return ""
    errors = _errors(cameras[0], points, views[0]), _errors(cameras[1], points, views[1])
    row = _change(*errors)
    now = float(np.median(_best_errors(points, uv)))
    if before != after:
        together = np.concatenate([views[0][:row], views[1][row:]])
        if not float(np.median(_best_errors(points, together))) < CLEAR * now:
            return ""
        slip = _rows(after - before)
        return f"from about row {row + 1} on its pixels are {slip}: a picture or a row is there twice, or missing"
    if not seen[0] < row <= seen[-1]:
        return ""
    alone = max(float(np.nanmedian(errors[0][:row])), float(np.nanmedian(errors[1][row:])))
    if not alone < CLEAR * now:
        return ""
    ratio = _pixel_ratio(points, cameras[0], cameras[1])
    if ratio is not None:
        return f"from row {row + 1} on its pictures are {ratio:.3g} times the size of those before"
    return f"from row {row + 1} on it sees like another camera, as if it had been knocked, turned or refocused there"


def _shift_of(points: Floats, uv: Floats) -> int | None:
    """By how many rows the pixels are late, so that a camera fits; None where none does."""
    left = {s: _left(points, _moved_up(uv, s)) for s in (0, *_shifts())}
    best = min(left, key=lambda s: (left[s], abs(s)))
    best = best if left[best] < CLEAR * left[0] else 0
    return best if left[best] < TOLERABLE * _half(uv) else None


def _shifts() -> list[int]:
    return [s for s in range(-SLIPPED, SLIPPED + 1) if s]


def _rows(shift: int) -> str:
    return f"{abs(shift)} row{'s' * (abs(shift) > 1)} {'late' if shift > 0 else 'early'}"


def _moved_up(uv: Floats, rows: int) -> Floats:
    """Each row with the pixels `rows` after it; NaN where there are none."""
    out = np.full_like(uv, np.nan)
    if rows >= 0:
        out[: len(uv) - rows] = uv[rows:]
    else:
        out[-rows:] = uv[:rows]
    return out


def _camera(points: Floats, uv: Floats) -> Floats | None:
    """(3, 4) a linear camera, fitted twice: without the rows that are off by far the second time."""
    seen = np.isfinite(uv[:, 0])
    for _ in range(3):
        if seen.sum() < FEWEST:
            return None
        try:
            camera = resect(points[seen], uv[seen])
        except (FitError, np.linalg.LinAlgError):
            return None
        error = _errors(camera, points, uv)
        again: Bools = np.asarray(error <= 4 * np.nanmedian(error[seen]), dtype=np.bool_)
        if (again == seen).all():
            break
        seen = again
    return camera


def _errors(camera: Floats, points: Floats, uv: Floats) -> Floats:
    return np.asarray(np.linalg.norm(_pixels(camera, points) - uv, axis=1), dtype=np.float64)


def _pixels(camera: Floats, points: Floats) -> Floats:
    ends = points @ camera[:, :3].T + camera[:, 3]
    return np.asarray(ends[:, :2] / ends[:, 2:], dtype=np.float64)


def _all_errors(points: Floats, uv: Floats) -> Floats:
    """Of the rows that are seen, in pixels; none where no camera can be fitted."""
    camera = _camera(points, uv)
    return np.zeros(0) if camera is None else _errors(camera, points, uv)[np.isfinite(uv[:, 0])]


def _left(points: Floats, uv: Floats) -> float:
    """Median error in pixels of all rows that are seen."""
    errors = _all_errors(points, uv)
    return float(np.median(errors)) if len(errors) else np.inf


def _best_errors(points: Floats, uv: Floats) -> Floats:
    """As `_all_errors`, by the best of many cameras that a few rows fix each: wrong detections do not decide."""
    plain, seen = _all_errors(points, uv), np.isfinite(uv[:, 0])
    if not len(plain):
        return plain
    try:
        camera, _ = resect_robustly(points[seen], uv[seen])
    except (FitError, np.linalg.LinAlgError):
        return plain
    robust = _errors(camera, points[seen], uv[seen])
    return min(plain, robust, key=lambda errors: float(np.median(errors)))


def _half(uv: Floats) -> float:
    return float(np.nanmax(np.nanmax(uv, axis=0) - np.nanmin(uv, axis=0))) / 2


def _change(first: Floats, last: Floats) -> int:
    """The row from which errors (n,) of the last camera are smaller than those of the first."""
    first, last = np.nan_to_num(first), np.nan_to_num(last)
    most = 3 * max(float(np.median(first)), float(np.median(last)))  # a wrong view must not decide
    worse = np.minimum(first, most) - np.minimum(last, most)
    return int(np.argmin(np.concatenate([[0.0], np.cumsum(worse)])))


def _pixel_ratio(points: Floats, first: Floats, last: Floats) -> float | None:
    """How many times larger the pictures of the last camera are, where they are the first one's, resized."""
    before, after = _pixels(first, points), _pixels(last, points)
    ratio = float(np.median(np.linalg.norm(after, axis=1) / np.linalg.norm(before, axis=1)))
    same = np.median(np.linalg.norm(after - ratio * before, axis=1)) < TOLERABLE * _half(after)
    return ratio if same and abs(np.log(ratio)) > 0.1 else None
