"""A plate with dots in staggered rows, which OpenCV calls an asymmetric circles grid: dark on bright, or the reverse.

OpenCV finds the dots and their order; each is then measured where the others say that it is (`blobs.py`). The picture
of a disc that is tilted is an ellipse whose middle is not the picture of the disc's middle: that is corrected by the
map from the plate to the picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats
from implicam.dataset.boards import corner_name, staggered_dots
from implicam.detect.blobs import find_scale, measure_spots
from implicam.detect.board import MAX_SEARCH_PIXELS, explain_missing, explain_unusable, hull_of, parse_board_size
from implicam.detect.corner_noise import agreeing, error_ratio
from implicam.detect.corners import Corners
from implicam.detect.grid import predict_places
from implicam.detect.marked import MIN_CORNERS
from implicam.detect.model import Detected, DetectorBase, View, nothing
from implicam.detect.seeds import resize, to_original_pixels
from implicam.errors import UsageError
from implicam.images import Grey, eight_bit, opencv
from implicam.registry import Option

MIN_DOT_PX, MAX_DOT_PART = 12.0, 0.02
"""Areas of dots that are looked for: square pixels, and as a part of the picture."""

MAX_OFF_SPACINGS = 0.15
"""Spacings that a dot may be from where the others put it: farther, and it is none."""


@dataclass(frozen=True)
class DotGrid(DetectorBase):
    """Rows x columns of dots, `spacing` from one row to the next in the dataset's unit; in a row they are twice as far
    apart, and every second row begins one spacing further right.

    An even number of rows looks the same after half a turn, and is refused. Dots are numbered along the rows from the
    top left one of the side that ends with full margins on the right: row 1 begins at the very left.
    """

    rows: int
    columns: int
    spacing: float

    def __post_init__(self) -> None:
        if min(self.rows, self.columns) < 3 or max(self.rows, self.columns) > 60:
            raise UsageError(
                f"a plate of {self.rows} x {self.columns} dots cannot be found.",
                why="rows and columns count dots, from 3 to 60",
                fix="for example 11 x 4",
            )
        if self.rows % 2 == 0:
            raise UsageError(
                f"a plate of {self.rows} x {self.columns} dots in staggered rows looks the same upside down.",
                why="half a turn exchanges its first row and its last where the number of rows is even",
                fix=f"use another one, {self.rows + 1} x {self.columns} say",
            )
        if not 0 < self.spacing < np.inf:
            raise UsageError(f"spacing = {self.spacing}; it must be positive.", fix="measure from one row to the next")

    @classmethod
    def from_options(
        cls,
        dataset: Path,
        described: Mapping[str, Any],
        *,
        board: Annotated[str | None, Option("dots in staggered rows, 11x4", "RxC")] = None,
        spacing: Annotated[float | None, Option("from one row of dots to the next", "LENGTH", 0)] = None,
    ) -> DotGrid:
        """Make the detector from the options of the command line.

        Args:
            dataset: The dataset's folder.
            described: The table [target] of dataset.toml, whose rows and columns stand in for `board`.
            board: Rows x columns of dots: "11x4".
            spacing: From one row to the next in the dataset's unit.

        Raises:
            UsageError: Something is missing, or there can be no such plate.
        """
        rows, columns = parse_board_size(board, described, "--board 11x4 (rows x dots in a row)")
        if not spacing:
            raise UsageError("a plate of dots needs --spacing.", fix="measure from one row of dots to the next")
        return cls(rows, columns, float(spacing))

    def options(self) -> dict[str, Any]:
        """All that the results depend on."""
        return {"target": "dotgrid", **asdict(self)}

    def describe(self) -> dict[str, Any]:
        """The plate as [target] has it."""
        return {"kind": "dotgrid", **asdict(self)}

    def detect(self, picture: Grey, view: View) -> Detected:
        """Find the dots in one picture.

        Args:
            picture: (height, width) grey from 0 to 1.
            view: Which picture it is; dots are named after the shot.

        Returns:
            The dots in the order of their numbers, or the reason why they cannot be given.
        """
        unfit = explain_unusable(picture)
        if unfit:
            return nothing(unfit)
        for shown in (1 - picture, picture):  # dark dots first
            start = self._order(shown)
            if start is not None:
                return self._measured(shown, start, view)
        return nothing(
            f"no plate with {self.rows} x {self.columns} dots in staggered rows was found. Show it whole and sharp, "
            "with dots at least 5 pixels wide and a margin about them."
        )

    def _order(self, bright: Grey) -> Floats | None:
        """(n, 2) pixels of all dots, bright ones, as OpenCV orders them."""
        cv2 = opencv()
        scale = float(min(1.0, 0.5 ** np.ceil(np.log2(max(bright.size / MAX_SEARCH_PIXELS, 1)) / 2)))
        image = resize(eight_bit(1 - bright), scale)
        how = cv2.SimpleBlobDetector_Params()
        how.minArea, how.maxArea = MIN_DOT_PX, MAX_DOT_PART * image.size
        how.minDistBetweenBlobs = 3
        finder = cv2.SimpleBlobDetector_create(how)
        found, uv = cv2.findCirclesGrid(
            image, (self.columns, self.rows), flags=cv2.CALIB_CB_ASYMMETRIC_GRID, blobDetector=finder
        )
        if not found:
            return None
        return to_original_pixels(uv.reshape(-1, 2).astype(np.float64), image, bright)

    def _measured(self, bright: Grey, start: Floats, view: View) -> Detected:
        """The dots where the others say that they are, measured."""
        nodes = staggered_dots(self.rows, self.columns, 1.0)
        half = float(np.ptp(nodes, axis=0).max() / 2)
        there = np.asarray(_astray(nodes, start) < MAX_OFF_SPACINGS, dtype=np.bool_)
        if there.sum() < MIN_CORNERS:
            return nothing("dots were found, and they do not lie in staggered rows. Show the plate nearer and sharper.")
        places = predict_places(nodes[there], start[there], nodes)
        near = np.where(there[:, None], start, places.uv)
        step = float(np.median(np.linalg.norm(places.right, axis=1)))
        sigma, _ = find_scale(bright, near[there][:: max(1, int(there.sum()) // 12)], 0.5 * step)
        spots = measure_spots(bright, near, sigma)
        corners = Corners.unknown(len(nodes))
        corners.uv[:], corners.sd[:], corners.misfit[:] = spots.uv, spots.sd, 0.0
        there = np.asarray(np.isfinite(spots.uv).all(axis=1), dtype=np.bool_)
        if there.sum() >= MIN_CORNERS:
            there[there] = _astray(nodes[there], spots.uv[there]) < MAX_OFF_SPACINGS
        numbers = np.flatnonzero(there)
        if len(numbers) >= MIN_CORNERS:
            numbers = numbers[agreeing(nodes[numbers], corners[numbers], half)]
        if len(numbers) < MIN_CORNERS:
            return nothing(f"{len(numbers)} dots are clear: too few. Show the plate sharper, and without glare.")
        uv = spots.uv[numbers]
        uv = uv - _middles_off(nodes[numbers], uv, spots.area[numbers])
        sd = spots.sd[numbers] * max(1.0, error_ratio(nodes[numbers], uv, spots.sd[numbers], half))
        return Detected(
            tuple(corner_name(view.shot, int(j)) for j in numbers),
            uv,
            sd,
            explain_missing(len(numbers), len(nodes)),
            (hull_of(uv),),
        )


def _astray(nodes: Floats, uv: Floats) -> Floats:
    """(n,) how far dots are from where the others put them, in spacings."""
    places = predict_places(nodes, uv, nodes)
    steps = np.stack([places.down, places.right], axis=2)  # of nodes (x, y): what is called a row there is x here
    off = np.einsum("nij,nj->ni", np.linalg.pinv(steps), uv - places.uv)
    return np.asarray(np.linalg.norm(off, axis=1), dtype=np.float64)


def _middles_off(nodes: Floats, uv: Floats, area: Floats) -> Floats:
    """(n, 2) pixels from the picture of each disc's middle to the middle of its picture, the ellipse.

    The dual of the circle about p with radius r is C = p p^T - r^2 diag(1, 1, 0), p with a one below; that of its
    picture is H C H^T, and the middle of a conic is the last column of its dual over the last number.
    """
    H, _ = opencv().findHomography(nodes.reshape(-1, 1, 2), uv.reshape(-1, 1, 2), 0)
    if H is None:
        return np.zeros_like(uv)
    p = np.column_stack([nodes, np.ones(len(nodes))])
    seen = p @ H.T
    jacobian = np.abs(np.linalg.det(H) / seen[:, 2] ** 3)  # of areas
    squared = float(np.median(area / (np.pi * jacobian)))
    dual: NDArray[np.float64] = np.einsum("ni,nj->nij", p, p) - squared * np.diag([1.0, 1.0, 0.0])
    conic = H @ dual @ H.T
    return np.asarray(conic[:, :2, 2] / conic[:, 2:, 2] - seen[:, :2] / seen[:, 2:], dtype=np.float64)
