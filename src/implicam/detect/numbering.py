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

from implicam.dataset import Floats
from implicam.detect.grid import Grid, sample_bilinear
from implicam.detect.plane import BoardPlane
from implicam.images import Grey

Ints = NDArray[np.intp]

TOP, RIGHT, BOTTOM, LEFT = range(4)

END, MORE, UNKNOWN = "end", "more", "unknown"

RIM_SQUARES = 0.3
"""Squares from the middle of a square towards its edge where its colour is read: near the edge, for something white in
front of a board must not look like the margin."""

MIN_GREY_HEIGHTS = 0.4
"""How far a grey must be on one side of the middle, as a part of the height, to be called black or white."""

SPOTS_SQUARES = (-0.2, 0.0, 0.2)
"""Squares from the middle of a square, along the line, where its grey is read; all must agree."""

MAX_READ_SD_SQUARES = 0.1
"""Squares of uncertainty with which a square can be read."""

Sides = tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...], tuple[str, ...]]
"""Of top, right, bottom, left: what follows each line of corners, from the outermost that was found outwards."""


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
        return self.at(i, j, shape)

    def at(self, i: Ints, j: Ints, shape: tuple[int, int]) -> tuple[Ints, Ints]:
        """The row and column on the board of some nodes, also beyond the grid.

        Args:
            i: Rows of the nodes.
            j: Columns of the nodes.
            shape: Rows and columns of the grid.

        Returns:
            Rows and columns on the board, of the shape of i and j.
        """
        r, c = _turn(i, j, shape, self.turns)
        return (r + self.row).astype(np.intp), (c + self.column).astype(np.intp)


def find_sides(picture: Grey, grid: Grid, plane: BoardPlane | None = None, reach: int = 0) -> Sides:
    """What follows the squares beyond a grid, line by line.

    Args:
        picture: (height, width) grey from 0 to 1.
        grid: Found in it.
        plane: What places the squares beyond the grid, and those whose corners are covered; without it, only squares
            between known corners are read.
        reach: Lines of corners beyond the grid's that are looked at, as far as they can be placed.

    Returns:
        For top, right, bottom, left, a word for the outermost line of corners found and each line beyond it, up to the
        first `END` (white follows the squares, and no more squares follow), else `MORE` squares follow, or `UNKNOWN`:
        covered, outside of the picture, or neither.
    """
    squares = _Squares(picture, grid, plane, reach if plane else 0)
    top, right, bottom, left = (squares.judge_side(side) for side in range(4))
    return top, right, bottom, left


def find_numberings(grid: Grid, sides: Sides, rows: int, columns: int) -> list[Numbering]:
    """All the ways to read a grid as part of a board.

    Args:
        grid: The corners found.
        sides: What `find_sides` says of it.
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
                hidden = [row, columns - column - width, rows - row - height, column]  # lines beyond the grid
                numbering = Numbering(turns, row, column)
                fits = all(_agrees(sides[side], hidden[(side + turns) % 4]) for side in range(4))
                if fits and _has_same_colours(grid, numbering):
                    found.append(numbering)
    return found


def _agrees(words: tuple[str, ...], hidden: int) -> bool:
    """Whether what was read of a side allows a board that has so many lines beyond the grid there."""
    return all(word == UNKNOWN or (word == END) == (line == hidden) for line, word in enumerate(words))


def _has_same_colours(grid: Grid, numbering: Numbering) -> bool:
    """Whether the square after node (0, 0) has the colour that this reading gives it."""
    half = np.array(0.5)
    r, c = _turn(half, half, (grid.rows, grid.columns), numbering.turns)
    black = (np.floor(r) + numbering.row + np.floor(c) + numbering.column) % 2 == 0
    return bool(black == (grid.polarity < 0))


def _turn(i: NDArray[Any], j: NDArray[Any], shape: tuple[int, int], turns: int) -> tuple[NDArray[Any], NDArray[Any]]:
    rows, columns = shape
    return [(i, j), (j, rows - 1 - i), (rows - 1 - i, columns - 1 - j), (columns - 1 - j, i)][turns]


class _Squares:
    """What is read of the squares of a grid and those around it.

    Square (i, j) has node (i, j) at its top left; `colours[side, i + margin, j + margin]` is what is read of it near
    its edge on that side: 1 for white, -1 for black, 0 for neither.
    """

    def __init__(self, picture: Grey, grid: Grid, plane: BoardPlane | None, reach: int) -> None:
        self.grid, self.reach, self.margin, self.learned = grid, reach, reach + 2, plane is not None
        shape = (grid.rows + 2 * self.margin - 1, grid.columns + 2 * self.margin - 1)
        squares = np.argwhere(np.ones(shape, dtype=np.bool_)) - self.margin
        middle: Floats = squares.astype(np.float64) + 0.5
        if plane is None:
            places, sd = grid.places(middle), np.zeros(len(middle))
        else:
            places, sd = plane.locate(middle)
        mean, height = grid.levels_near(middle)
        self.colours = np.zeros((4, *shape), dtype=np.intp)
        for side in range(4):
            out = np.array([(-1.0, 0.0), (0.0, 1.0), (1.0, 0.0), (0.0, -1.0)])[side]
            greys = []
            for aside in SPOTS_SQUARES:
                i, j = RIM_SQUARES * out + aside * out[::-1]
                grey = sample_bilinear(picture, places.uv + j * places.right + i * places.down)
                greys.append((grey - mean) / height)
            with np.errstate(invalid="ignore"):
                white, black = (np.min([s * np.array(greys)], axis=(0, 1)) > MIN_GREY_HEIGHTS for s in (1, -1))
            sure = sd < MAX_READ_SD_SQUARES
            self.colours[side] = ((white & sure) * 1 - (black & sure) * 1).reshape(shape)
        self.bright = (grid.polarity * (1 - 2 * (squares.sum(axis=1) % 2)) > 0).reshape(shape)

    def judge_side(self, side: int) -> tuple[str, ...]:
        """A word for each line of corners, from the grid's outermost outwards."""
        lines = [self._read_line(side, beyond) for beyond in range(self.reach + 1)]
        last_pattern = max((k for k, (_, pattern) in enumerate(lines) if pattern), default=-1)
        words = [UNKNOWN if word == END and k < last_pattern else word for k, (word, _) in enumerate(lines)]
        return tuple(words[: words.index(END) + 1] if END in words else words)

    def _read_line(self, side: int, beyond: int) -> tuple[str, bool]:
        """What follows the squares just outwards of a line of corners; and whether they are dark and bright in turn."""
        grid, m = self.grid, self.margin
        upright = side in (TOP, BOTTOM)
        ends = (grid.rows if upright else grid.columns) - 1
        outward = 1 if side in (BOTTOM, RIGHT) else -1
        at = m + (ends + beyond if outward > 0 else -1 - beyond)
        turned, bright = (self.colours, self.bright) if upright else (self.colours.swapaxes(1, 2), self.bright.T)
        last, after, bright = turned[side, at], turned[(side + 2) % 4, at + outward], bright[at]
        if not self.learned:
            there = grid.occupied if upright else grid.occupied.T
            there = there[ends if outward > 0 else 0]
            known = m + np.flatnonzero(there[:-1] & there[1:])
            last, after, bright = last[known], after[known], bright[known]
        word, pattern = _judge_colours(last, after, bright)
        spanned = slice(m, -m) if self.learned else slice(None)  # the board's, whatever is in front of them
        if word == END and np.any(~bright[spanned] & (last[spanned] > 0)):
            word = UNKNOWN  # something white is in front of this line, and may well be what follows it
        return word, pattern


def _judge_colours(last: Ints, after: Ints, bright: NDArray[np.bool_]) -> tuple[str, bool]:
    """From the colours of squares and of what follows each, and which of the squares are to be bright."""
    dark_squares, white_squares = ~bright & (last < 0), bright & (last > 0)
    white_after_dark = np.sum(dark_squares & (after > 0))
    white_after, dark_after = np.sum(white_squares & (after > 0)), np.sum(white_squares & (after < 0))
    pattern = min(dark_squares.sum(), white_squares.sum()) >= 2 and not np.any(bright & (last < 0))
    if white_after_dark >= 2 and white_after >= 2 and dark_after <= 0.2 * white_after:
        return END, bool(pattern)
    return (MORE if white_after_dark >= 2 and dark_after >= 2 and white_after == 0 else UNKNOWN), bool(pattern)
