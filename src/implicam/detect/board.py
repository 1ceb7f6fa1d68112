"""A printed checkerboard: every corner with the same number in every camera and shot, or a reason why not.

Corner 1 touches the board's black outermost corner square that is at the top left when the board stands with its
`columns` running to the right; numbers run along the rows. The mirror image of a checkerboard is a checkerboard, too:
corners are numbered as they lie on the printed side, and a picture that was mirrored afterwards is read wrongly.

The seeds of `seeds.py` grow (`grid.py`) until nothing more of the board is seen, and the grid with the most corners is
read (`numbering.py`); OpenCV's detector and the paper's are asked where what grew from the saddle points alone cannot
be read. A grid that can be read in more than one way is refused, with all the
ways in `Detected.others`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from implicam.dataset import Floats
from implicam.dataset.boards import corner_name
from implicam.detect.corner_noise import true_sd
from implicam.detect.corners import Bools
from implicam.detect.grid import Grid, are_checkered, grow_grid, join_grids
from implicam.detect.model import Detected, DetectorBase, Inferred, View, nothing
from implicam.detect.numbering import END, MORE, Numbering, Sides, find_numberings, find_sides
from implicam.detect.plane import MAX_SEARCH_SD_SQUARES, BoardPlane, complete_grid
from implicam.detect.seeds import find_saddles, from_libcbdetect, from_opencv, from_saddles, resize, to_original_pixels
from implicam.errors import UsageError
from implicam.images import Grey, opencv
from implicam.registry import Option

MIN_CONTRAST_SDS = 10.0
"""From dark to bright, in sds of the noise of a pixel, below which a dim picture shows nothing: noise alone has 6."""

MAX_SEARCH_PIXELS = 2_500_000
"""Pixels beyond which the search is done in a smaller picture; corners are always fitted in the original."""

MAX_OTHER_READINGS = 12
"""Readings that are kept of a board that is refused, at most."""

MAX_TIMES_FOUND = 8
"""Times that a checkerboard was found, or found again, after which no more are looked for."""

MIN_CORNERS_OF_ANOTHER = 12
"""Corners of a second checkerboard that make it one."""


@dataclass(frozen=True)
class Board(DetectorBase):
    """A checkerboard with rows x columns inner corners, and squares of `square` in the dataset's unit, None if unknown.

    rows + columns must be odd: a board whose half turn looks the same cannot be numbered. infer: place the hidden
    corners, too, as `Detected.inferred`. refine: move each corner to where it and all others together say it is; its
    error is about halved, but is that of its neighbours then, so that the standard uncertainty written stays its own.
    """

    rows: int = 8
    columns: int = 11
    square: float | None = 13.29
    infer: bool = False
    refine: bool = False

    def __post_init__(self) -> None:
        if min(self.rows, self.columns) < 3 or max(self.rows, self.columns) > 200:
            raise UsageError(
                f"a board of {self.rows} x {self.columns} inner corners cannot be found.",
                why="rows and columns are those of the corners between squares, from 3 to 200",
                fix="for example 8 x 11",
            )
        if self.square is not None and not (np.isfinite(self.square) and self.square > 0):
            raise UsageError(f"square = {self.square}; it must be positive.", fix="measure the edge of a square")
        if (self.rows + self.columns) % 2 == 0:
            raise UsageError(
                f"a board of {self.rows} x {self.columns} inner corners looks the same upside down.",
                why="half a turn gives black squares for black ones where rows + columns is even",
                fix=f"use a ChArUco board, or another size, for example {self.rows} x {self.columns + 1}",
            )

    @classmethod
    def from_options(
        cls,
        dataset: Path,
        described: Mapping[str, Any],
        *,
        board: Annotated[str | None, Option("inner corners, 8x11", "RxC")] = None,
        square: Annotated[float | None, Option("edge of a square, in the dataset's unit", "LENGTH", 0)] = None,
        infer: Annotated[bool, Option("write where hidden corners must be to detections/inferred.csv")] = False,
        refine: Annotated[bool, Option("move each corner to where all together say; not for calibration")] = False,
    ) -> Board:
        """Make the detector from the options of the command line.

        Args:
            dataset: The dataset's folder.
            described: The table [target] of dataset.toml, whose rows and columns stand in for `board`.
            board: Inner corners, rows x columns: "8x11".
            square: Edge of a square in the dataset's unit.
            infer: Whether hidden corners are placed.
            refine: Whether corners are moved to where all together say they are.

        Raises:
            UsageError: The size is not known, or there can be no such board.
        """
        rows, columns = parse_board_size(board, described, "--board 8x11 (inner corners, rows x columns)")
        return cls(rows, columns, float(square) if square else None, infer, refine)

    def options(self) -> dict[str, Any]:
        """All that the results depend on."""
        return {"target": "board", **asdict(self)}

    def describe(self) -> dict[str, Any]:
        """The board as [target] has it; without its square where that is not known."""
        square = {} if self.square is None else {"square": self.square}
        return {"kind": "board", "rows": self.rows, "columns": self.columns, **square}

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
        grids: list[Grid] = []
        found = nothing(
            f"no checkerboard was found (looked for {self.rows} x {self.columns} inner corners). Show the board "
            "whole and sharp, well lit and without glare, with squares at least 5 pixels wide."
        )
        for seeds in (self._quick_seeds, self._slow_seeds):
            exhausted = self._grow(picture, seeds(picture, grids), grids)
            if grids:
                found = self._read(picture, self._join_parts(picture, grids), view)
            if len(found) or exhausted or self._is_settled(grids):
                break
        return found

    def _grow(self, picture: Grey, seeds: Iterator[Floats], grids: list[Grid]) -> bool:
        """Add the checkerboards that grow from seeds to a list; whether so many grew that no more are looked for."""
        limit, grown = self._limit, 0
        for seed in seeds:
            grid = grow_grid(picture, seed[:limit, :limit], limit)
            if grid is not None:
                _add_grid(grids, grid)
                grown += 1
            if grown == MAX_TIMES_FOUND:
                return True
        return False

    @property
    def _limit(self) -> int:
        """Rows or columns beyond which a grid need not grow."""
        return max(self.rows, self.columns) + 3

    def _join_parts(self, picture: Grey, grids: list[Grid]) -> list[Grid]:
        """All checkerboards in the picture, the one with the most corners first; the parts of a board that something
        covers joined where that is certain."""
        grids = sorted(grids, key=lambda grid: -grid.count)
        if self._is_whole(grids[0]) or self._is_too_large(grids[0]):
            return grids
        first, rest = complete_grid(picture, grids[0], (self.rows, self.columns)), []
        for grid in grids[1:]:
            if _share_corners(first, grid):
                continue
            both = join_grids(picture, first, grid, (self.rows, self.columns), self._limit)
            if both is None or both.count <= first.count:
                rest.append(grid)
            else:
                first = both
        return [first, *rest]

    def _quick_seeds(self, picture: Grey, grids: list[Grid]) -> Iterator[Floats]:
        """Seeds from saddle points while the grids found so far, a list that grows meanwhile, hold no whole board."""
        scale = _search_scale(picture)
        yield from _saddle_seeds(picture, scale, grids)
        if not self._is_settled(grids):
            yield from _saddle_seeds(picture, scale / 2, grids)

    def _slow_seeds(self, picture: Grey, grids: list[Grid]) -> Iterator[Floats]:
        """Seeds from OpenCV and the paper's detector, which take longer than all the rest together."""
        scale = _search_scale(picture)
        yield from from_opencv(picture, scale)
        if not self._is_settled(grids):
            yield from from_libcbdetect(picture, scale)

    def _is_settled(self, grids: list[Grid]) -> bool:
        """Whether another search can find nothing more of the board."""
        return any(self._is_whole(grid) or self._is_too_large(grid) for grid in grids)

    def _is_too_large(self, grid: Grid) -> bool:
        shape, board = sorted((grid.rows, grid.columns)), sorted((self.rows, self.columns))
        return shape[0] > board[0] or shape[1] > board[1]

    def _is_whole(self, grid: Grid) -> bool:
        return grid.count == self.rows * self.columns

    def _read(self, picture: Grey, grids: list[Grid], view: View) -> Detected:
        """Number the largest grid that may be the board."""
        ends = [self._find_sides(picture, grid) for grid in grids]
        ways = [find_numberings(grid, end, self.rows, self.columns) for grid, end in zip(grids, ends, strict=True)]
        fitting = [k for k in range(len(grids)) if ways[k]]
        if not fitting or (fitting[0] > 0 and len(ways[fitting[0]]) > 1):
            return nothing(self._explain_misfit(grids[0], ends[0]), outlines=(hull_of(grids[0].uv[grids[0].occupied]),))
        first = fitting[0]
        grid = self._with_true_sd(grids[first])
        possible = [self._name_corners(grid, way, view) for way in ways[first]]
        outline = (hull_of(grid.uv[grid.occupied]),)
        if len(possible) > 1:
            return nothing(
                f"{grid.count} of the board's {self.rows * self.columns} corners are seen, and it is not certain "
                f"which: they can be numbered in {len(possible)} ways. Show more of the board, with the white margin "
                "after its outermost squares.",
                outlines=outline,
                others=tuple(possible[:MAX_OTHER_READINGS]),
            )
        for k in fitting[1:]:
            if grids[k].count >= MIN_CORNERS_OF_ANOTHER and not self._may_be_hidden_part(
                grid, ways[first][0], grids[k]
            ):
                return nothing(
                    f"two checkerboards are in view, of {grid.count} and {grids[k].count} corners, and either may be "
                    "the board. Take the other one away, or cover it.",
                    outlines=(*outline, hull_of(grids[k].uv[grids[k].occupied])),
                )
        found = replace(
            possible[0], reason=explain_missing(len(possible[0]), self.rows * self.columns), outlines=outline
        )
        if not self.infer or self._is_whole(grid):
            return found
        return replace(found, inferred=self._infer_hidden(picture, grid, ways[first][0], view))

    def _find_sides(self, picture: Grey, grid: Grid) -> Sides:
        """What follows the grid; a part of a board is read as far as its corners can place what is beyond them."""
        size = max(self.rows, self.columns)
        if self._is_whole(grid) or self._is_too_large(grid):
            return find_sides(picture, grid)
        return find_sides(picture, grid, self._plane_of(grid), size - min(grid.rows, grid.columns))

    def _name_corners(self, grid: Grid, way: Numbering, view: View) -> Detected:
        """The corners under their names, in the order of their numbers."""
        row, column = way.of((grid.rows, grid.columns))
        there = grid.occupied
        number = (row * self.columns + column)[there]
        order = np.argsort(number)
        uv, sd = grid.uv[there], grid.corners.sd[there.ravel()][order]
        if self.refine:
            uv = self._plane_of(grid).predict(np.argwhere(there).astype(np.float64)).uv
        uv = uv[order]
        return Detected(tuple(corner_name(view.shot, int(j)) for j in number[order]), uv, sd)

    def _with_true_sd(self, grid: Grid) -> Grid:
        """With the standard uncertainties that the corners show together."""
        there = grid.occupied
        corners, seen = grid.corners, grid.corners[there.ravel()]
        sd = corners.sd.copy()
        sd[there.ravel()] = true_sd(np.argwhere(there).astype(np.float64), seen, max(self.rows, self.columns) / 2)
        return replace(grid, corners=replace(corners, sd=sd))

    def _plane_of(self, grid: Grid) -> BoardPlane:
        return BoardPlane.of(grid, max(self.rows, self.columns) / 2)

    def _infer_hidden(self, picture: Grey, grid: Grid, way: Numbering, view: View) -> Inferred:
        """The corners that were not found, where they are in the picture and are placed well enough."""
        reach, shape = max(self.rows, self.columns), (grid.rows, grid.columns)
        nodes: Floats = np.argwhere(~grid.pad(reach).occupied).astype(np.float64) - reach
        row, column = way.at(nodes[:, 0].astype(np.intp), nodes[:, 1].astype(np.intp), shape)
        own = (row >= 0) & (row < self.rows) & (column >= 0) & (column < self.columns)
        number = (row * self.columns + column)[own]
        nodes = nodes[own]
        plane = self._plane_of(grid)
        places, sd = plane.locate(nodes)
        inside = ((places.uv > -0.5) & (places.uv < np.array(picture.shape)[::-1] - 0.5)).all(axis=1)
        kept = np.flatnonzero(inside & (sd < MAX_SEARCH_SD_SQUARES))
        kept = kept[np.argsort(number[kept])]
        names = tuple(corner_name(view.shot, int(j)) for j in number[kept])
        return Inferred(names, *plane.predict(nodes[kept]))

    def _may_be_hidden_part(self, grid: Grid, way: Numbering, other: Grid) -> bool:
        """Whether another grid lies about where corners of the board are missing, so that it need be no other board."""
        row, column = way.of((grid.rows, grid.columns))
        known = np.column_stack([row[grid.occupied], column[grid.occupied]]).astype(np.float64)
        h, _ = opencv().findHomography(grid.uv[grid.occupied].reshape(-1, 1, 2), known.reshape(-1, 1, 2), 0)
        if h is None or self._is_whole(grid):
            return False
        place = np.hstack([other.uv[other.occupied], np.ones((other.count, 1))]) @ h.T
        place = place[:, :2] / place[:, 2:]
        return bool(((place > -1.5) & (place < np.array([self.rows, self.columns]) + 0.5)).all())

    def _explain_misfit(self, grid: Grid, ends: Sides) -> str:
        """Why no grid can be the board."""
        size = f"{grid.rows} x {grid.columns}"
        whole = all(end[0] == END for end in ends)
        exactly = "has" if whole else "has at least"
        if sorted((grid.rows, grid.columns)) == sorted((self.rows, self.columns)):
            return (
                f"the checkerboard in view has {size} inner corners in sight, but goes on beyond them, or has its "
                f"black and white squares exchanged. Give the size of the whole board instead of {self.rows} x "
                f"{self.columns}."
            )
        more = " and more" if not whole and any(end[0] == MORE for end in ends) else ""
        return (
            f"the checkerboard in view {exactly} {size} inner corners{more}, which is no board of {self.rows} x "
            f"{self.columns}. Give the size that the board has, or take this one out of the picture."
        )


def explain_missing(found: int, total: int) -> str:
    """How many of a board's corners are missing, in words; empty where none are.

    Args:
        found: Corners found.
        total: Corners of the board.
    """
    return "" if found == total else f"{total - found} of the board's {total} corners are hidden or not clear."


def parse_board_size(text: str | None, described: Mapping[str, Any], example: str) -> tuple[int, int]:
    """The rows and columns of a board.

    Args:
        text: "8x11" from the command line; None to take them from `described`.
        described: The table [target] of dataset.toml.
        example: The cure that the error states.

    Raises:
        UsageError: There are no two whole numbers.
    """
    rows, columns = described.get("rows"), described.get("columns")
    if text is not None:
        rows, _, columns = text.lower().partition("x")
    try:
        return int(rows), int(columns)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise UsageError(
            "the size of the board is not known." if text is None else f"--board {text!r} is not a size.", fix=example
        ) from None


def explain_unusable(picture: Grey) -> str:
    """Why a picture cannot show anything, in words; empty where it can.

    Args:
        picture: (height, width) grey from 0 to 1.
    """
    if picture.ndim != 2 or min(picture.shape, default=0) < 16:
        return f"the picture is too small: {' x '.join(map(str, picture.shape[::-1]))} pixels."
    if not np.isfinite(picture).all():
        return "the picture holds values that are no numbers. Export it again."
    low, high = np.quantile(picture[::3, ::3], (0.002, 0.998))
    if high - low < 0.02 and high - low < MIN_CONTRAST_SDS * _pixel_noise(picture):  # 10 bits in 16 are dark, and good
        what = "black" if high < 0.1 else "white" if low > 0.9 else "plain grey"
        return f"the picture is {what}: nothing can be seen in it. Check lens cap, exposure and light."
    return ""


def _pixel_noise(picture: Grey) -> float:
    """Sd of the grey of a pixel, from neighbours; at least a third of the steps in which it is given."""
    steps = np.abs(np.diff(picture[::3], axis=1)).ravel()
    step = float(steps[steps > 0].min(initial=1.0))
    return max(float(np.median(steps) / (0.6745 * np.sqrt(2))), step / 3)


def _search_scale(picture: Grey) -> float:
    """The factor by which a picture is shrunk before the board is looked for."""
    return float(min(1.0, 0.5 ** np.ceil(np.log2(max(picture.size / MAX_SEARCH_PIXELS, 1)) / 2)))


def _saddle_seeds(picture: Grey, scale: float, grids: list[Grid]) -> Iterator[Floats]:
    """Seeds from the saddle points that no grid has yet, as long as each lets a grid grow."""
    small = resize(picture, scale)

    def taken(uv: Floats) -> Bools:
        uv = to_original_pixels(uv, small, picture)
        there = np.zeros(len(uv), dtype=np.bool_)
        for grid in grids:
            there |= _are_inside(grid, uv)
        return there

    def checkered(seeds: Floats) -> Bools:
        return are_checkered(picture, to_original_pixels(seeds, small, picture))

    for seed in from_saddles(find_saddles(np.asarray(small, dtype=np.float32)), taken, checkered):
        yield to_original_pixels(seed, small, picture)


def _are_inside(grid: Grid, uv: Floats) -> Bools:
    """Which pixels (n, 2) are within a square or so of the grid's corners."""
    du, dv = (grid.found[:, k] - uv[:, k, None] for k in range(2))
    return np.asarray((du * du + dv * dv).min(axis=1) < (0.8 * grid.largest_step) ** 2, dtype=np.bool_)


def _add_grid(grids: list[Grid], grid: Grid) -> None:
    """Add a grid to the list; of two that share corners, the one with more stays, then the one that fits better."""
    for k, known in enumerate(grids):
        if _share_corners(known, grid):
            if (grid.count, -_rms_misfit(grid)) > (known.count, -_rms_misfit(known)):
                grids[k] = grid
            return
    grids.append(grid)


def _rms_misfit(grid: Grid) -> float:
    return float(np.sqrt(np.nanmean(grid.corners.misfit**2)))


def _share_corners(a: Grid, b: Grid) -> bool:
    apart = np.linalg.norm(a.uv[a.occupied][:, None] - b.uv[b.occupied][None], axis=2)
    return bool(apart.min() < 1.0)


def hull_of(uv: Floats) -> Floats:
    """The convex hull of points as a closed curve.

    Args:
        uv: (n, 2) pixels.

    Returns:
        (k, 2) pixels, the last the same as the first.
    """
    hull = opencv().convexHull(uv.astype(np.float32))[:, 0]
    return np.asarray(np.vstack([hull, hull[:1]]), dtype=np.float64)
