"""A ChArUco board: a checkerboard whose white squares carry markers, so that any part of it tells which part it is.

OpenCV reads the markers and says which corners they surround; the corners themselves are then fitted as those of a
checkerboard are (`corners.py`), in a window that leaves the markers out, and those that the reader missed but whose
neighbours it has are fitted as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats
from implicam.detect.board import MAX_SEARCH_PIXELS, explain_unusable, parse_board_size
from implicam.detect.dictionaries import check_dictionary, dictionary_of
from implicam.detect.grid import predict_places
from implicam.detect.marked import MIN_CORNERS, explain_mirrored, fit_marked_corners, in_squares, report_corners
from implicam.detect.model import Detected, DetectorBase, View, nothing
from implicam.detect.seeds import resize, to_original_pixels
from implicam.errors import UsageError
from implicam.images import Grey, eight_bit, opencv
from implicam.registry import Option

MAX_MARKER_OFF_SQUARES = 0.3
"""Squares that a marker may be from where its neighbours put it; more than a fifth beyond, and it is another board."""


@dataclass(frozen=True)
class Charuco(DetectorBase):
    """A ChArUco board of rows x columns SQUARES, edges of squares and markers in the dataset's unit.

    dictionary: OpenCV's name of the set of markers. legacy: printed with OpenCV before 4.6, and an even number of rows.
    Corner 1 is the inner corner at the top left of the board as OpenCV draws it, and numbers run along the rows.
    """

    rows: int
    columns: int
    square: float
    marker: float
    dictionary: str = "DICT_5X5_100"
    legacy: bool = False

    def __post_init__(self) -> None:
        if min(self.rows, self.columns) < 3 or max(self.rows, self.columns) > 100:
            raise UsageError(
                f"a ChArUco board of {self.rows} x {self.columns} squares cannot be used.",
                why="rows and columns count squares, from 3 to 100",
                fix="for example 9 x 12",
            )
        if not 0 < self.marker < self.square < np.inf:
            raise UsageError(
                f"marker = {self.marker} and square = {self.square} do not go together.",
                why="a marker lies inside of a square",
                fix="measure the edges of both on the printed board",
            )
        check_dictionary(self.dictionary)
        if self.rows * self.columns // 2 > len(self._dictionary().bytesList):
            raise UsageError(
                f"{self.dictionary} has too few markers for {self.rows} x {self.columns} squares.",
                why=f"the board needs {self.rows * self.columns // 2}",
                fix="use the dictionary that the board was printed with",
            )

    @classmethod
    def from_options(
        cls,
        dataset: Path,
        described: Mapping[str, Any],
        *,
        board: Annotated[str | None, Option("squares, 9x12", "RxC")] = None,
        square: Annotated[float | None, Option("edge of a square, in the dataset's unit", "LENGTH", 0)] = None,
        marker: Annotated[float | None, Option("edge of a marker, in the dataset's unit", "LENGTH", 0)] = None,
        dictionary: Annotated[str | None, Option("OpenCV's name, such as DICT_5X5_100")] = None,
        legacy: Annotated[bool, Option("printed with OpenCV before 4.6, an even number of rows")] = False,
    ) -> Charuco:
        """Make the detector from the options of the command line.

        Args:
            dataset: The dataset's folder.
            described: The table [target] of dataset.toml, whose rows and columns stand in for `board`.
            board: Squares, rows x columns: "9x12".
            square: Edge of a square in the dataset's unit.
            marker: Edge of a marker in the dataset's unit.
            dictionary: OpenCV's name of the markers' dictionary; None for the default of the class.
            legacy: Whether OpenCV before 4.6 drew it.

        Raises:
            UsageError: Something is missing, or there can be no such board.
        """
        rows, columns = parse_board_size(board, described, "--board 9x12 (squares, rows x columns)")
        if not square or not marker:
            raise UsageError(
                "a ChArUco board needs --square and --marker.", fix="measure both edges on the printed board"
            )
        return cls(rows, columns, float(square), float(marker), str(dictionary or cls.dictionary), bool(legacy))

    def options(self) -> dict[str, Any]:
        """All that the results depend on."""
        return {"target": "charuco", **asdict(self)}

    def describe(self) -> dict[str, Any]:
        """The board as [target] has it."""
        kind = {"kind": "charuco", **asdict(self)}
        return kind if self.legacy else {key: value for key, value in kind.items() if key != "legacy"}

    def detect(self, picture: Grey, view: View) -> Detected:
        """Find the corners of the board in one picture.

        Args:
            picture: (height, width) grey from 0 to 1.
            view: Which picture it is; corners are named after the shot.

        Returns:
            The corners in the order of their numbers, or the reason why they cannot be given.
        """
        unfit = explain_unusable(picture)
        if unfit:
            return nothing(unfit)
        seen = self._read_markers(picture, 1.0)
        if len(seen.ids) < self._total and picture.size <= MAX_SEARCH_PIXELS:
            again = self._read_markers(picture, 2.0)  # small markers are read better when they are made larger
            seen = again if len(again.ids) > len(seen.ids) else seen
        if seen.reason:
            return nothing(seen.reason)
        nodes = np.argwhere(np.ones((self.rows - 1, self.columns - 1), dtype=np.bool_)).astype(np.float64)
        start = np.full((len(nodes), 2), np.nan)
        start[seen.ids] = seen.uv
        bare = (1 - self.marker / self.square) / 2
        parity = nodes.sum(axis=1).astype(np.intp)
        corners, there = fit_marked_corners(picture, nodes, start, parity, bare=bare, rounds=self.rows + self.columns)
        return report_corners(
            corners, there, nodes, max(self.rows, self.columns) / 2, view.shot,
            lambda count: f"{len(seen.ids)} markers of the board were read, and {count} corners between them are "
            "clear: too few. Show more of the board, sharper or nearer.",
        )  # fmt: skip

    @property
    def _total(self) -> int:
        return (self.rows - 1) * (self.columns - 1)

    def _dictionary(self) -> Any:
        return dictionary_of(self.dictionary)

    def _read_markers(self, picture: Grey, scale: float) -> _Seen:
        """What OpenCV reads, and whether the markers lie as on this board."""
        cv2 = opencv()
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, self._dictionary())
        board.setLegacyPattern(self.legacy)
        reader = cv2.aruco.CharucoDetector(board)
        image = resize(eight_bit(picture), scale)
        try:
            corners, ids, outlines, names = reader.detectBoard(image)
        except cv2.error as error:
            return _refuse(f"OpenCV could not read the ChArUco board: {error}")
        if names is None or len(names) == 0:
            mirrored = explain_mirrored(picture, self.dictionary, 1, range(self.rows * self.columns // 2))
            return _refuse(
                mirrored
                or f"no marker of {self.dictionary} was read. Show the board sharp and near (a marker needs a dozen "
                "pixels), and check that it was printed from this dictionary."
            )
        names = names.ravel()
        middle = np.array([np.mean(outline.reshape(-1, 2), axis=0) for outline in outlines], dtype=np.float64)
        if len(np.unique(names)) < len(names):
            return _refuse("the same marker is seen twice: two ChArUco boards are in view. Take one away.")
        if not self._lie_in_their_places(board, names, middle):
            return _refuse(
                f"the markers do not lie as on a ChArUco board of {self.rows} x {self.columns} squares. Give the size "
                "that the board has (rows x columns of squares), or --legacy for one printed with OpenCV before 4.6."
            )
        if corners is None or ids is None or len(ids) == 0:
            return _refuse(f"{len(names)} markers were read, but no corner lies between two. Show more of it.")
        uv = to_original_pixels(corners.reshape(-1, 2).astype(np.float64), image, picture)
        return _Seen(ids.ravel().astype(np.intp), uv, "")

    def _lie_in_their_places(self, board: Any, names: NDArray[np.int32], middle: Floats) -> bool:
        """Whether the markers' middles (n, 2) are where their neighbours say that this board has them."""
        of = {int(name): np.mean(points, axis=0)[1::-1] for name, points in zip(board.getIds(), board.getObjPoints())}  # noqa: B905
        known = np.array([name in of for name in names.tolist()])
        if known.mean() < 0.8:
            return False
        if known.sum() < MIN_CORNERS:
            return True
        nodes = np.array([of[int(name)] for name in names[known]], dtype=np.float64) / self.square
        places = predict_places(nodes, middle[known], nodes)
        off = in_squares(middle[known] - places.uv, places)
        return bool(np.mean(np.abs(off).max(axis=1) > MAX_MARKER_OFF_SQUARES) < 0.2)


class _Seen(NamedTuple):
    """Numbers (n,) and pixels (n, 2) of the corners that OpenCV gives; or the reason why it gives none."""

    ids: NDArray[np.intp]
    uv: Floats
    reason: str


def _refuse(reason: str) -> _Seen:
    return _Seen(np.zeros(0, dtype=np.intp), np.zeros((0, 2)), reason)
