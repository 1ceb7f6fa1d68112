"""What is printed on a board: black shapes on white, to be drawn on paper or shown to simulated cameras."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from implicam.dataset import Floats
from implicam.dataset.boards import staggered_dots
from implicam.detect.aprilgrid import AprilGrid
from implicam.detect.board import Board
from implicam.detect.charuco import Charuco
from implicam.detect.dictionaries import dictionary_of
from implicam.detect.dotgrid import DotGrid
from implicam.errors import UsageError
from implicam.images import Grey, opencv

WHITE_SQUARES = 0.5
"""White about a board, in squares: a detector needs it to see where the board ends."""


DOT_SPACINGS = 0.4
"""Radius of a dot, in spacings."""


@dataclass(frozen=True, eq=False)
class Print:
    """What is black on a board, in millimetres from its top left: rectangles (k, 4) of left, top, width, height; and
    discs (m, 3) of their middles and radii.

    size: (2,) width and height. white: about it. words: what it is, and the options that detect it. origin: (2,) the
    place from which `corner_positions` counts.
    """

    black: Floats
    size: Floats
    white: float
    words: tuple[str, str]
    origin: Floats
    discs: Floats = field(default_factory=lambda: np.zeros((0, 3)))

    def picture(self, samples: float) -> Grey:
        """How black it is, with the white about it.

        Args:
            samples: Per unit of length.

        Returns:
            (height, width) from 0, white, to 1, black; its top left corner is `white` before that of the print.
        """
        width, height = np.ceil((self.size + 2 * self.white) * samples).astype(int)
        drawn = np.zeros((height, width), dtype=np.float32)
        for x, y, w, h in moved(self.black, np.full(2, self.white)) * samples:
            (left, across), (top, down) = _covered(x, x + w), _covered(y, y + h)
            part = drawn[top : top + len(down), left : left + len(across)]
            part += np.outer(down, across)[: part.shape[0], : part.shape[1]].astype(np.float32)
        y, x = np.indices((height, width), sparse=True)
        for u, v, r in np.add(self.discs, [self.white, self.white, 0]) * samples:
            top, left = max(int(v - r) - 2, 0), max(int(u - r) - 2, 0)
            spot = slice(top, int(v + r) + 3), slice(left, int(u + r) + 3)
            far = np.hypot(x[:, spot[1]] + 0.5 - u, y[spot[0]] + 0.5 - v)
            drawn[spot] = np.maximum(drawn[spot], np.clip(r - far + 0.5, 0, 1))
        return np.minimum(drawn, 1)


Printable = Board | Charuco | AprilGrid | DotGrid


def printed(board: Printable) -> Print:
    """What is printed on a board.

    Args:
        board: Its detector.

    Raises:
        UsageError: Its size is not known.
        MissingExtraError: It has markers, and OpenCV is not installed.
    """
    if isinstance(board, Board):
        return _checkerboard(board)
    if isinstance(board, DotGrid):
        return _dots(board)
    return _charuco(board) if isinstance(board, Charuco) else _aprilgrid(board)


def _checkerboard(board: Board) -> Print:
    if board.square is None:
        raise UsageError("the size of the squares is not known.", fix="--square 20, in mm")
    rows, columns, square = board.rows + 1, board.columns + 1, board.square
    i, j = np.nonzero(np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 0)
    words = f"Checkerboard, {board.rows} x {board.columns} inner corners, squares of {square:g} mm"
    told = f"--target board --board {board.rows}x{board.columns} --square {square:g}"
    black = np.column_stack([j, i, np.ones(len(i)), np.ones(len(i))]) * square
    return Print(
        np.asarray(black, dtype=np.float64),
        np.array([columns, rows]) * square,
        WHITE_SQUARES * square,
        (words, told),
        np.array([square, square]),
    )


def _charuco(board: Charuco) -> Print:
    aruco = opencv().aruco
    dictionary = dictionary_of(board.dictionary)
    plan = aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)
    plan.setLegacyPattern(board.legacy)
    bits = int(dictionary.markerSize) + 2
    marks = [np.asarray(points, dtype=np.float64)[0, :2] for points in plan.getObjPoints()]
    marked = {tuple(np.floor(corner / board.square).astype(int)) for corner in marks}
    black = [
        np.array([[j, i, 1, 1]]) * board.square
        for i in range(board.rows)
        for j in range(board.columns)
        if (j, i) not in marked
    ]
    for number, corner in zip(plan.getIds().ravel(), marks, strict=True):
        image = aruco.generateImageMarker(dictionary, int(number), bits)
        black.append(moved(_cells(image, board.marker / bits), corner))
    words = (
        f"ChArUco board, {board.rows} x {board.columns} squares of {board.square:g} mm, markers of {board.marker:g} mm "
        f"({board.dictionary})"
    )
    told = (
        f"--target charuco --board {board.rows}x{board.columns} --square {board.square:g} --marker {board.marker:g} "
        f"--dictionary {board.dictionary}{' --legacy' if board.legacy else ''}"
    )
    size = np.array([board.columns, board.rows]) * board.square
    return Print(np.concatenate(black), size, WHITE_SQUARES * board.square, (words, told), np.full(2, board.square))


def _aprilgrid(board: AprilGrid) -> Print:
    aruco, dictionary, border = opencv().aruco, dictionary_of(board.dictionary), board.border or 2
    bits = int(dictionary.markerSize) + 2 * border
    pitch, gap = board.tag + board.spacing, board.spacing
    i, j = np.indices((board.rows + 1, board.columns + 1)).reshape(2, -1)
    black = [np.column_stack([j * pitch, i * pitch, np.full(len(i), gap), np.full(len(i), gap)])]
    for number in range(board.rows * board.columns):
        row, column = divmod(number, board.columns)
        image = aruco.generateImageMarker(dictionary, board.first + number, bits, borderBits=border)
        corner = np.array([gap + column * pitch, gap + (board.rows - 1 - row) * pitch])
        black.append(moved(_cells(image, board.tag / bits), corner))
    words = (
        f"AprilGrid, {board.rows} x {board.columns} tags of {board.tag:g} mm, {gap:g} mm apart ({board.dictionary}, "
        f"borders of {border} bits)"
    )
    told = f"--target aprilgrid --board {board.rows}x{board.columns} --tag {board.tag:g} --spacing {gap:g}"
    if board.dictionary != AprilGrid.dictionary:
        told += f" --dictionary {board.dictionary}"
    told += f" --first {board.first}" if board.first else ""
    size = np.array([board.columns, board.rows]) * pitch + gap
    return Print(np.concatenate(black), size, gap / 2, (words, told), np.full(2, gap))


def _dots(board: DotGrid) -> Print:
    spacing, radius = board.spacing, DOT_SPACINGS * board.spacing
    middles = staggered_dots(board.rows, board.columns, spacing)
    words = f"Dots in staggered rows, {board.rows} x {board.columns}, {spacing:g} mm from one row to the next"
    told = f"--target dotgrid --board {board.rows}x{board.columns} --spacing {spacing:g}"
    discs = np.column_stack([middles + radius, np.full(len(middles), radius)])
    size, none = np.ptp(middles, axis=0) + 2 * radius, np.zeros((0, 4))
    return Print(none, size, spacing, (words, told), np.full(2, radius), discs)


def _covered(start: float, end: float) -> tuple[int, Floats]:
    """The first sample that a line covers, and how much of each from there on."""
    first, after = int(np.floor(start + 1e-9)), int(np.ceil(end - 1e-9))
    at = np.arange(first, after)
    return first, np.asarray(np.minimum(end, at + 1) - np.maximum(start, at), dtype=np.float64)


def _cells(image: Any, edge: float) -> Floats:
    """The black runs of a marker drawn with a pixel a bit, as rectangles."""
    found = []
    for i, row in enumerate(image):
        change = np.flatnonzero(np.diff(np.concatenate([[0], row < 128, [0]]).astype(int)))
        found += [(start, i, end - start, 1) for start, end in change.reshape(-1, 2)]
    return np.array(found, dtype=np.float64) * edge


def moved(black: Floats, by: Floats) -> Floats:
    """Rectangles elsewhere.

    Args:
        black: (k, 4) as in `Print`.
        by: (2,) how far, right and down.
    """
    return np.asarray(black + np.concatenate([by, [0, 0]]), dtype=np.float64)
