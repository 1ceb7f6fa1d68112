"""An AprilGrid, Kalibr's board: AprilTags in rows, a small black square where four of them meet.

OpenCV reads the tags, where they lie together says which generator numbered them, and every corner of every tag is then
fitted as that of a checkerboard: a black square touches it from outside. A tag that was not read but whose neighbours
were has its corners fitted as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats
from implicam.dataset.boards import aprilgrid_corners
from implicam.detect.board import MAX_SEARCH_PIXELS, explain_unusable, parse_board_size
from implicam.detect.dictionaries import check_dictionary, dictionary_of
from implicam.detect.marked import explain_mirrored, fit_marked_corners, report_corners
from implicam.detect.model import Detected, DetectorBase, View, nothing
from implicam.detect.seeds import resize, to_original_pixels
from implicam.errors import UsageError
from implicam.images import Grey, eight_bit, opencv
from implicam.registry import Option

USUAL_SPACING = 0.3
"""Of Kalibr's boards, in edges of a tag."""

BORDERS = (2, 1)
"""Bits that a tag's black border is wide: of Kalibr's own boards, and of most others."""

MIN_SPACING, MAX_SPACING = 0.05, 1.0
"""Between tags, in edges of a tag."""

MAX_MISFIT_TAGS = 0.15
"""Edges of a tag that tags usually are from their places, lens and all."""

MAX_TAG_OFF_TAGS = 0.5
"""Edges of a tag from its place beyond which a tag was misread, or belongs to another board."""

MIN_BETTER_TIMES = 3.0
"""How many times worse all other ways to number the tags must fit."""


@dataclass(frozen=True)
class AprilGrid(DetectorBase):
    """Rows x columns of TAGS with the edge `tag`, and `spacing` between them, in the dataset's unit.

    Corners are numbered along the rows of corners, two to a tag, from the outermost corner of tag 0: the lowest left
    one of a board of Kalibr, the top left one of generators that begin there. dictionary: OpenCV's name of the tags.
    border: bits that the black border of a tag is wide, 0 to try what is usual. first: the number of the first tag; the
    text here calls it tag 0.
    """

    rows: int
    columns: int
    tag: float
    spacing: float
    dictionary: str = "DICT_APRILTAG_36h11"
    border: int = 0
    first: int = 0

    def __post_init__(self) -> None:
        if min(self.rows, self.columns) < 1 or max(self.rows, self.columns) > 50 or self.rows * self.columns < 2:
            raise UsageError(
                f"an AprilGrid of {self.rows} x {self.columns} tags cannot be used.",
                why="rows and columns count tags, up to 50, and one tag alone does not say which way up it is",
                fix="for example 6 x 6",
            )
        if not (0 < self.tag < np.inf and MIN_SPACING <= self.spacing / self.tag <= MAX_SPACING):
            raise UsageError(
                f"tag = {self.tag:g} and spacing = {self.spacing:g} do not go together.",
                why="both are lengths: the edge of a tag's black square, and the gap between two tags, which is the "
                "edge of the small black squares; Kalibr's tagSpacing is their ratio",
                fix="measure both on the printed board: --tag 88 --spacing 26.4 where tagSpacing is 0.3",
            )
        check_dictionary(self.dictionary)
        if self.first < 0 or self.first + self.rows * self.columns > len(dictionary_of(self.dictionary).bytesList):
            raise UsageError(
                f"{self.dictionary} has too few tags for {self.rows} x {self.columns}, the first of them {self.first}.",
                fix="use the dictionary that the board was printed with",
            )
        if self.border not in (0, *BORDERS):
            raise UsageError(f"border = {self.border}; it is 1 or 2 bits wide.", fix="leave it out to try both")

    @classmethod
    def from_options(
        cls,
        dataset: Path,
        described: Mapping[str, Any],
        *,
        board: Annotated[str | None, Option("tags, 6x6", "RxC")] = None,
        tag: Annotated[float | None, Option("edge of a tag's black square, in the dataset's unit", "LENGTH", 0)] = None,
        spacing: Annotated[float | None, Option("between two tags (default 0.3 of a tag)", "LENGTH", 0)] = None,
        dictionary: Annotated[str | None, Option("OpenCV's name, such as DICT_APRILTAG_36h11")] = None,
        first: Annotated[int | None, Option("number of the first tag, where it is not 0", "N", 0)] = None,
        border: Annotated[
            int | None, Option("bits of a tag's black border, 1 or 2 (default: what fits)", "N", 1)
        ] = None,
    ) -> AprilGrid:
        """Make the detector from the options of the command line.

        Args:
            dataset: The dataset's folder.
            described: The table [target] of dataset.toml, whose rows and columns stand in for `board`.
            board: Tags, rows x columns: "6x6".
            tag: Edge of a tag's black square in the dataset's unit.
            spacing: Between two tags in the dataset's unit; None for 0.3 of a tag, which the picture must bear out.
            dictionary: OpenCV's name of the tags' dictionary; None for the default of the class.
            first: The number of the first tag; None for 0.
            border: Bits that a tag's black border is wide; None to try.

        Raises:
            UsageError: Something is missing, or there can be no such board.
        """
        rows, columns = parse_board_size(board, described, "--board 6x6 (tags, rows x columns)")
        if not tag:
            raise UsageError("an AprilGrid needs --tag.", fix="measure the edge of a tag's black square")
        gap = float(spacing) if spacing else USUAL_SPACING * float(tag)
        return cls(rows, columns, float(tag), gap, str(dictionary or cls.dictionary), int(border or 0), int(first or 0))

    def options(self) -> dict[str, Any]:
        """All that the results depend on."""
        return {"target": "aprilgrid", **asdict(self)}

    def describe(self) -> dict[str, Any]:
        """The board as [target] has it."""
        kind = {"kind": "aprilgrid", **asdict(self)}
        return {key: value for key, value in kind.items() if key not in ("border", "first") or value}

    def detect(self, picture: Grey, view: View) -> Detected:
        """Find the corners of the tags in one picture.

        Args:
            picture: (height, width) grey from 0 to 1.
            view: Which picture it is; corners are named after the shot.

        Returns:
            The corners in the order of their numbers, or the reason why they cannot be given.
        """
        unfit = explain_unusable(picture)
        if unfit:
            return nothing(unfit)
        seen = self._read_tags(picture)
        if seen.reason:
            return nothing(seen.reason)
        placed = self._place(seen)
        if placed.reason:
            return nothing(placed.reason)
        unit = min(seen.border / (seen.bits + 2 * seen.border), self.spacing / self.tag)  # nothing is printed within it
        nodes = self._nodes(placed.upwards) / unit
        start = np.full((len(nodes), 2), np.nan)
        start[placed.numbers] = placed.uv
        rows, columns = np.divmod(np.arange(len(nodes)), 2 * self.columns)
        pitch = (1 + self.spacing / self.tag) / unit
        corners, there = fit_marked_corners(picture, nodes, start, rows + columns, reach=1.5 * pitch)
        return report_corners(
            corners, there, nodes, float(max(np.ptp(nodes, axis=0)) / 2), view.shot,
            lambda count: f"{len(seen.ids)} tags of the board were read, and {count} corners of tags are clear: too "
            "few. Show more of the board, sharper or nearer.",
        )  # fmt: skip

    def _nodes(self, upwards: bool) -> Floats:
        """(n, 2) row, downwards, and column of the corners by their numbers, in edges of a tag."""
        flat = aprilgrid_corners(self.rows, self.columns, 1.0, self.spacing / self.tag)
        y = flat[:, 1] if upwards else flat[:, 1].max() - flat[:, 1]
        return np.column_stack([y, flat[:, 0]])

    def _read_tags(self, picture: Grey) -> _Tags:
        """The tags that OpenCV reads, with the border and in the size of the picture with which it reads the most."""
        best, total = _Tags.none(), self.rows * self.columns
        others: set[int] = set()
        cv2 = opencv()
        bits = int(dictionary_of(self.dictionary).markerSize)
        for scale in (1.0, 2.0) if picture.size <= MAX_SEARCH_PIXELS else (1.0,):
            image = resize(eight_bit(picture), scale)
            for border in (self.border,) if self.border else BORDERS:
                how = cv2.aruco.DetectorParameters()
                how.markerBorderBits = border
                outlines, ids, _ = cv2.aruco.ArucoDetector(dictionary_of(self.dictionary), how).detectMarkers(image)
                if ids is None:
                    continue
                ids = ids.ravel().astype(np.intp) - self.first
                own = np.flatnonzero((ids >= 0) & (ids < total))
                others |= {int(number) + self.first for number in np.delete(ids, own)}
                if len(own) > len(best.ids):
                    uv = np.array([outlines[k].reshape(4, 2) for k in own], dtype=np.float64).reshape(-1, 2)
                    there = to_original_pixels(uv, image, picture).reshape(-1, 4, 2)
                    best = _Tags(ids[own], there, border, bits)
            if len(best.ids) >= 0.8 * total:
                break
        if len(best.ids) < len(others):
            return best._replace(
                reason=f"tags {min(others)} to {max(others)} were read, and the board has {self.first} to "
                f"{self.first + total - 1}. Give --first, the number of its first tag, or the size that it has."
            )
        if len(best.ids) == 0:
            mirrored = explain_mirrored(
                picture, self.dictionary, self.border or BORDERS[0], range(self.first, self.first + total)
            )
            return best._replace(
                reason=mirrored
                or f"no tag of {self.dictionary} was read. Show the board sharp and "
                "near (a tag needs twenty pixels), and check that it was printed from these tags."
            )
        if len(np.unique(best.ids)) < len(best.ids):
            return best._replace(reason="the same tag is seen twice: two boards are in view. Take one away.")
        return best

    def _place(self, seen: _Tags) -> _Placed:
        """Which corner of the board each corner of a tag is: of all ways to lay tags out, the only one that fits."""
        ways = [self._try(seen, upwards, turns) for upwards in (True, False) for turns in range(4)]
        ways.sort(key=lambda way: way.misfit)
        if ways[0].misfit > MAX_MISFIT_TAGS:
            return ways[0]._replace(
                reason=f"the {len(seen.ids)} tags that were read do not lie as on an AprilGrid of {self.rows} x "
                f"{self.columns} tags with gaps of {self.spacing / self.tag:.2g} tags. Give the size that it has "
                "(rows x columns of tags), and --tag and --spacing as measured on it."
            )
        if ways[1].misfit < max(MIN_BETTER_TIMES * ways[0].misfit, 0.5 * MAX_MISFIT_TAGS):
            return ways[0]._replace(
                reason=f"{len(seen.ids)} tag{'s were' if len(seen.ids) > 1 else ' was'} read, and it is not certain "
                "which way up the board is. Show more of it, tags of two rows at least."
            )
        return ways[0]

    def _try(self, seen: _Tags, upwards: bool, turns: int) -> _Placed:
        """One way: rows of tags count upwards or downwards, and tags are printed so many quarter turns round."""
        row, column = np.divmod(seen.ids, self.columns)
        # OpenCV gives the corners of a tag clockwise from its own top left
        down, right = (np.roll([[0, 0, 1, 1], [0, 1, 1, 0]], turns, axis=1)[k] for k in (0, 1))
        of_row = 1 - down if upwards else down
        numbers = ((2 * row[:, None] + of_row) * 2 * self.columns + 2 * column[:, None] + right).ravel()
        nodes = self._nodes(upwards)[numbers]
        uv = seen.uv.reshape(-1, 2)
        h, _ = opencv().findHomography(uv.reshape(-1, 1, 2), nodes.reshape(-1, 1, 2), 0)
        if h is None:
            return _Placed(numbers, uv, upwards, np.inf)
        place = np.hstack([uv, np.ones((len(uv), 1))]) @ h.T
        off = np.linalg.norm(place[:, :2] / place[:, 2:] - nodes, axis=1)
        keep = np.repeat(off.reshape(-1, 4).max(axis=1) < MAX_TAG_OFF_TAGS, 4)
        return _Placed(numbers[keep], uv[keep], upwards, float(np.median(off)))


class _Tags(NamedTuple):
    """Numbers (n,) of tags, their corners (n, 4, 2) in pixels, clockwise; the bits of their border and inside of it; or
    the reason why there are none."""

    ids: NDArray[np.intp]
    uv: Floats
    border: int
    bits: int
    reason: str = ""

    @classmethod
    def none(cls) -> _Tags:
        return cls(np.zeros(0, dtype=np.intp), np.zeros((0, 4, 2)), 1, 1)


class _Placed(NamedTuple):
    """Numbers (n,) of corners of the board and their pixels (n, 2); whether rows count upwards; how far off they
    usually are, in edges of a tag; or the reason why they cannot be numbered."""

    numbers: NDArray[np.intp]
    uv: Floats
    upwards: bool
    misfit: float
    reason: str = ""
