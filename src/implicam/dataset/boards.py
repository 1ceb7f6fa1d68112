"""Boards: what the table [target] of dataset.toml says of one, and where its corners are.

    kind        table                                   corners
    board       rows, columns, square                   rows x columns inner corners of a checkerboard
    charuco     rows, columns, square, marker, ...      (rows - 1) x (columns - 1): rows and columns count squares
    aprilgrid   rows, columns, tag, spacing, ...        2 rows x 2 columns: rows and columns count tags
    dotgrid     rows, columns, spacing                  rows x columns dots in staggered rows, for corners

Lengths are in the dataset's unit; other keys (dictionary, border) matter to the detector alone. A corner is named
<shot>-c001, counted along the rows: on a checkerboard from the top, on an AprilGrid, as in Kalibr, from the bottom.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.units import METRES_PER_UNIT
from implicam.errors import DatasetError, UsageError

Floats = NDArray[np.float64]

MAX_ROWS_OR_COLUMNS = 500
"""Rows or columns of a board."""

SIZE_RANGE_METRES = (1e-6, 5.0)
"""Edges of squares, markers and tags."""

CORNER = re.compile(r"(?P<shot>.+)-c(?P<number>[0-9]+)")
"""The name of a corner."""


def corner_name(shot: str, number: int) -> str:
    """The name that a corner has in points.csv and observations.csv.

    Args:
        shot: The name of the shot.
        number: Of the corner, from 0; names count from 1.
    """
    return f"{shot}-c{number + 1:03d}"


def corner_shots(points: NDArray[np.str_]) -> NDArray[np.str_]:
    """The shot of each point of a dataset without known positions, which says it in the name of a corner.

    Args:
        points: (n,) names.

    Returns:
        (n,) names of shots; of a point that is no corner its own.
    """
    found = [CORNER.fullmatch(str(point)) for point in points]
    shots = [match["shot"] if match else str(point) for point, match in zip(points, found, strict=True)]
    return np.array(shots, dtype=np.str_)


def is_board(target: object) -> TypeGuard[Mapping[str, Any]]:
    """Whether an entry `target` of dataset.toml describes a board.

    Args:
        target: What stands there, None where nothing does.
    """
    return isinstance(target, Mapping) and target.get("kind") in BOARD_KINDS


def corner_positions(target: Mapping[str, Any]) -> Floats:
    """Where the corners are on a board.

    Args:
        target: The table [target]; of one of `BOARD_KINDS`.

    Returns:
        (n, 2) to the right and down on the printed side, in the order of the corners' numbers, in the table's unit.

    Raises:
        DatasetError: Something is missing or impossible.
    """
    return BOARD_KINDS[target["kind"]](target)


def check_size(target: Mapping[str, Any], unit: str) -> None:
    """Refuse lengths that no board has: a number in millimetres where the unit is metres, say.

    Args:
        target: The table [target].
        unit: The dataset's length unit; one without a known size allows all.

    Raises:
        UsageError: A length is impossible.
    """
    for name in ("square", "marker", "tag", "spacing"):
        length = target.get(name)
        if length is not None and unit in METRES_PER_UNIT:
            low, high = SIZE_RANGE_METRES
            if not low <= length * METRES_PER_UNIT[unit] <= high:
                raise UsageError(
                    f"{name} = {length:g} {unit} is no size for a board.",
                    why="lengths are in the dataset's length unit",
                    fix=f"give it in {unit}",
                )


def _checkerboard(target: Mapping[str, Any]) -> Floats:
    return _lattice(_count(target, "rows", 2), _count(target, "columns", 2), _length(target, "square"))


def _charuco(target: Mapping[str, Any]) -> Floats:
    return _lattice(_count(target, "rows", 3) - 1, _count(target, "columns", 3) - 1, _length(target, "square"))


def _aprilgrid(target: Mapping[str, Any]) -> Floats:
    rows, columns = _count(target, "rows", 1), _count(target, "columns", 1)
    return aprilgrid_corners(rows, columns, _length(target, "tag"), _length(target, "spacing"))


def _dotgrid(target: Mapping[str, Any]) -> Floats:
    return staggered_dots(_count(target, "rows", 3), _count(target, "columns", 3), _length(target, "spacing"))


def staggered_dots(rows: int, columns: int, spacing: float) -> Floats:
    """The dots of OpenCV's asymmetric circles grid, along the rows from the top left.

    Args:
        rows: Of dots.
        columns: Dots in a row.
        spacing: From one row to the next, and half the way from a dot to the next in its row.

    Returns:
        (rows columns, 2) to the right and down; every second row begins a spacing further right.
    """
    row, column = np.divmod(np.arange(rows * columns), columns)
    return np.asarray(np.column_stack([2 * column + row % 2, row]) * spacing, dtype=np.float64)


BOARD_KINDS: Mapping[str, Callable[[Mapping[str, Any]], Floats]] = {
    "board": _checkerboard,
    "charuco": _charuco,
    "aprilgrid": _aprilgrid,
    "dotgrid": _dotgrid,
}
"""Kind -> where the corners are."""


def aprilgrid_corners(rows: int, columns: int, tag: float, spacing: float) -> Floats:
    """The corners of the tags of an AprilGrid, in Kalibr's order: along the rows, the lowest row first.

    Args:
        rows: Of tags.
        columns: Of tags.
        tag: The edge of a tag's black square.
        spacing: Between two tags, in the same unit.

    Returns:
        (4 rows columns, 2) to the right and down; the lowest left corner is (0, height).
    """
    x, y = (np.add.outer(np.arange(n) * (tag + spacing), [0.0, tag]).ravel() for n in (columns, rows))
    right, up = np.meshgrid(x, y)
    return np.column_stack([right.ravel(), y[-1] - up.ravel()])


def _lattice(rows: int, columns: int, square: float) -> Floats:
    numbers = np.arange(rows * columns)
    return np.asarray(np.column_stack([numbers % columns, numbers // columns]) * square, dtype=np.float64)


def _count(target: Mapping[str, Any], name: str, least: int) -> int:
    count = _entry(target, name)
    if type(count) is not int or not least <= count <= MAX_ROWS_OR_COLUMNS:
        raise _error(target, f"{name} = {count!r} must be a whole number from {least} to {MAX_ROWS_OR_COLUMNS}")
    return count


def _length(target: Mapping[str, Any], name: str) -> float:
    length = _entry(target, name)
    if type(length) not in (int, float) or not 1e-9 < length < 1e9:
        raise _error(target, f"{name} = {length!r} must be a length")
    return float(length)


def _entry(target: Mapping[str, Any], name: str) -> Any:
    if name not in target:
        raise _error(target, f"{name} is missing")
    return target[name]


def _error(target: Mapping[str, Any], why: str) -> DatasetError:
    needed = {
        "board": "rows, columns (of inner corners) and square",
        "charuco": "rows, columns (of squares) and square",
        "dotgrid": "rows, columns (dots in a row) and spacing (from one row to the next)",
    }
    needs = needed.get(target["kind"], "rows, columns (of tags), tag and spacing")
    return DatasetError(
        "[target] in dataset.toml does not describe a board.",
        why=why,
        fix=f'it needs kind = "{target["kind"]}" with {needs}, in the dataset\'s length unit',
    )
