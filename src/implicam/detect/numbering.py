"""Which corner of the board each corner of a grid is: by the colours of the squares, and by where the board ends.

A board has (rows + 1) x (columns + 1) squares; square (i, j) is black where i + j is even, and corner (r, c) is where
the squares (r, c), (r, c + 1), (r + 1, c), (r + 1, c + 1) meet. Where rows + columns is odd, half a turn exchanges
black and white, so a whole board can be read in one way only. Part of a board can be read in several; what leaves
fewer is where its end is seen: after the last square of the pattern comes the white margin, not the next square.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.detect.grid import Grid, sample_bilinear
from implicam.images import Grey

Ints = NDArray[np.intp]

TOP, RIGHT, BOTTOM, LEFT = range(4)

END, MORE, UNKNOWN = "end", "more", "unknown"

WITHIN_SQUARES, BEYOND_SQUARES = 0.7, 1.3
"""Squares outwards from a grid's outermost line where the last square, and what follows it, are read."""

MIN_GREY_HEIGHTS = 0.4
"""How far a grey must be on one side of the middle, as a part of the height, to be called black or white."""


class Numbering(NamedTuple):
    """A way to read a grid: it is turned by `turns` quarter turns; its first row and column are `row` and `column`."""

    turns: int
    row: int
    column: int

    def of(self, shape: tuple[int, int]) -> tuple[Ints, Ints]:
        """The row and column on the board of each node of a grid.

        Args:
            shape: Rows and columns of the grid.

        Returns:
            Rows and columns on the board, both of that shape.
        """
        i, j = np.indices(shape)
        r, c = _turn(i, j, shape, self.turns)
        return (r + self.row).astype(np.intp), (c + self.column).astype(np.intp)


def find_sides(picture: Grey, grid: Grid) -> tuple[str, str, str, str]:
    """What follows the grid's outermost squares.

    Args:
        picture: (height, width) grey from 0 to 1.
        grid: Found in it.

    Returns:
        For top, right, bottom, left: `END` (white), `MORE` squares, or `UNKNOWN`: covered, outside of the picture, or
        neither.
    """
    top, right, bottom, left = (_judge_side(picture, grid, side) for side in range(4))
    return top, right, bottom, left


def find_numberings(grid: Grid, ends: tuple[str, str, str, str], rows: int, columns: int) -> list[Numbering]:
    """All the ways to read a grid as part of a board.

    Args:
        grid: The corners found.
        ends: What `find_sides` says of it.
        rows: Rows of the board's inner corners.
        columns: Columns of the board's inner corners.

    Returns:
        The ways; an empty list where it cannot be part of such a board.
    """
    found = []
    for turns in range(4):
        height, width = (grid.rows, grid.columns) if turns % 2 == 0 else (grid.columns, grid.rows)
        for row in range(rows - height + 1):
            for column in range(columns - width + 1):
                touches = [row == 0, column + width == columns, row + height == rows, column == 0]
                fits = all(
                    ends[side] == UNKNOWN or touches[(side + turns) % 4] == (ends[side] == END) for side in range(4)
                )
                numbering = Numbering(turns, row, column)
                if fits and _has_same_colours(grid, numbering):
                    found.append(numbering)
    return found


def _has_same_colours(grid: Grid, numbering: Numbering) -> bool:
    """Whether the square after node (0, 0) has the colour that this reading gives it."""
    half = np.array(0.5)
    r, c = _turn(half, half, (grid.rows, grid.columns), numbering.turns)
    black = (np.floor(r) + numbering.row + np.floor(c) + numbering.column) % 2 == 0
    return bool(black == (grid.polarity < 0))


def _turn(i: NDArray[Any], j: NDArray[Any], shape: tuple[int, int], turns: int) -> tuple[NDArray[Any], NDArray[Any]]:
    rows, columns = shape
    return [(i, j), (j, rows - 1 - i), (rows - 1 - i, columns - 1 - j), (columns - 1 - j, i)][turns]


def _judge_side(picture: Grey, grid: Grid, side: int) -> str:
    along, out = np.array([[0.0, 1.0], [1.0, 0.0]])[[side % 2, 1 - side % 2]]
    out = out if side in (BOTTOM, RIGHT) else -out
    start = np.array([grid.rows - 1 if side == BOTTOM else 0, grid.columns - 1 if side == RIGHT else 0], np.float64)
    length = grid.columns if side in (TOP, BOTTOM) else grid.rows
    nodes = start + np.arange(length)[:, None] * along
    i, j = nodes.astype(int).T
    there = grid.occupied[i, j]
    first = np.flatnonzero(there[:-1] & there[1:])
    if len(first) < 4:
        return UNKNOWN
    middle = nodes[first] + along / 2
    row = i[first] * grid.columns + j[first]
    mean, height = grid.corners.mean[row], np.abs(grid.corners.height[row])
    last, after = (
        (sample_bilinear(picture, grid.places(middle + depth * out).uv) - mean) / height
        for depth in (WITHIN_SQUARES, BEYOND_SQUARES)
    )
    cell = np.floor(middle + out / 2).sum(axis=1)
    bright = grid.polarity * (1 - 2 * (cell % 2)) > 0
    return _judge_greys(last, after, bright)


def _judge_greys(last: NDArray[np.float64], after: NDArray[np.float64], bright: NDArray[np.bool_]) -> str:
    """From the greys of the outermost squares and of what follows them, and which of the squares are to be bright."""
    with np.errstate(invalid="ignore"):
        dark_square = np.sum(~bright & (last < -MIN_GREY_HEIGHTS) & (after > MIN_GREY_HEIGHTS))
        white_after = np.sum(bright & (last > MIN_GREY_HEIGHTS) & (after > MIN_GREY_HEIGHTS))
        dark_after = np.sum(bright & (last > MIN_GREY_HEIGHTS) & (after < -MIN_GREY_HEIGHTS))
    if dark_square >= 2 and white_after >= 2 and dark_after <= 0.2 * white_after:
        return END
    return MORE if dark_square >= 2 and dark_after >= 2 and white_after == 0 else UNKNOWN
