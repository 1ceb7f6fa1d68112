"""Where every corner of a board must be, and how surely, from those that are seen: a Gaussian process on its grid.

The idea is that of Hillen et al. 2023, "Enhanced checkerboard detection using Gaussian processes": a process learns the
map from rows and columns to pixels. Here its mean is a homography, unknown itself, and what it learns besides is the
lens (`projective.py`). How far the lens bends a board is not known from a few of its corners: each of `DEPARTURES` has
its own process, and they are mixed by their evidence. None of them is nearly straight, for a lens bends most where the
corners seen are not: what a patch shows of it says too little of the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from implicam.dataset import Floats
from implicam.detect.corners import Bools
from implicam.detect.grid import MAX_ASTRAY_SQUARES, Grid, Places, add_corners, drop_thin_rims, scatter
from implicam.detect.projective import Departure, ProjectiveProcess, fit_affine
from implicam.images import Grey

REACH_HALVES = 1.4
"""Correlation length of what a lens does to a board, in halves of the board's longer side."""

DEPARTURES = tuple(Departure(bend, REACH_HALVES, slack) for bend in (0.03, 0.1, 0.3) for slack in (1e-5, 1e-4, 4e-4))
"""What lenses do to a board, in units of half its longer side."""

FIRST_TURNS, TRIAL_TURNS = 8, 2
"""Steps towards the most probable homography: once, and then with each departure."""

MIN_WEIGHT = 1e-3
"""A process whose share of the evidence is smaller is left out."""

MAX_SEARCH_SD_SQUARES = 0.1
"""Squares of uncertainty with which a corner is looked for: with more, it might be the next one."""

MAX_ASTRAY_SDS, TOLERATED_SQUARES = 4.0, 0.03
"""A corner so many standard deviations, and so many squares more, from where the others put it is none."""

MAX_CONTRADICTION_SDS = 5.0
"""Standard deviations from where all others put it that a corner may be found."""

MIN_CORNERS = 9
"""Corners that are kept: with fewer, none can be told to be wrong."""

MAX_ROUNDS = 20


class Predicted(NamedTuple):
    """uv: (n, 2) pixels. covariance: (n, 2, 2) of them."""

    uv: Floats
    covariance: Floats


@dataclass(frozen=True, eq=False)
class BoardPlane:
    """What the corners seen say of all others; made by `of`.

    Attributes:
        middle: (2,) row and column that is the zero of the processes.
        half_length: Squares that are 1 there.
        origin: (2,) pixels that are the zero of the processes.
        scale: Pixels that are 1 there.
        parts: The processes.
        weights: Their shares.
    """

    middle: Floats
    half_length: float
    origin: Floats
    scale: float
    parts: tuple[ProjectiveProcess, ...]
    weights: Floats

    @classmethod
    def of(cls, grid: Grid, half_length: float) -> BoardPlane:
        """Learn from the corners of a grid.

        Args:
            grid: With four corners or more, not all in one line.
            half_length: Half the longer side of the board, in squares.
        """
        there = grid.occupied
        nodes, uv = np.argwhere(there).astype(np.float64), grid.uv[there]
        middle, origin = nodes.mean(axis=0), uv.mean(axis=0)
        x = (nodes - middle) / half_length
        scale = float(np.sqrt(np.sum((uv - origin) ** 2) / np.sum(x**2)))
        y, variance = (uv - origin) / scale, (grid.corners.sd[there.ravel()] / scale) ** 2
        first = ProjectiveProcess.condition(x, y, variance, fit_affine(x, y), DEPARTURES[0], turns=FIRST_TURNS)
        parts = [ProjectiveProcess.condition(x, y, variance, first.theta, d, turns=TRIAL_TURNS) for d in DEPARTURES]
        evidence = np.array([part.evidence for part in parts])
        weights = np.exp(evidence - evidence.max())
        kept = np.flatnonzero(weights > MIN_WEIGHT * weights.sum())
        weights = weights[kept] / weights[kept].sum()
        return cls(middle, half_length, origin, scale, tuple(parts[k] for k in kept), weights)

    def predict(self, nodes: Floats) -> Predicted:
        """Predict where nodes are.

        Args:
            nodes: (n, 2) row and column, whole numbers or not.
        """
        x = (nodes - self.middle) / self.half_length
        return self._mix([part.predict(x) for part in self.parts])

    def leave_one_out(self) -> Predicted:
        """What the other corners say of each corner that was learned from, its own noise included."""
        return self._mix([part.leave_one_out() for part in self.parts])

    def _mix(self, each: Sequence[tuple[Floats, Floats]]) -> Predicted:
        means, covariances = (np.stack(part) for part in zip(*each, strict=True))
        uv = np.einsum("p,pnc->nc", self.weights, means)
        off = means - uv
        covariance = np.einsum("p,pncl->ncl", self.weights, covariances + off[..., :, None] * off[..., None, :])
        return Predicted(self.origin + self.scale * uv, self.scale**2 * covariance)

    def locate(self, nodes: Floats) -> tuple[Places, Floats]:
        """Where nodes are, as `Grid.places` has it, and how surely.

        Args:
            nodes: (n, 2) row and column, whole numbers or not.

        Returns:
            The places, and (n,) the standard uncertainty of each in squares, in the direction where it is largest.
        """
        n = len(nodes)
        steps = np.array([(0, 0), (0, 0.5), (0, -0.5), (0.5, 0), (-0.5, 0)])
        uv, covariance = self.predict((nodes[None] + steps[:, None]).reshape(-1, 2))
        at, right, left, down, up = uv.reshape(5, n, 2)
        places = Places(at, right - left, down - up)
        squares = np.linalg.pinv(np.stack([places.right, places.down], axis=2))
        spread = squares @ covariance[:n] @ squares.swapaxes(1, 2)
        return places, np.sqrt(np.linalg.eigvalsh(spread)[:, -1])


def complete_grid(picture: Grey, grid: Grid, size: tuple[int, int]) -> Grid:
    """Look for all corners of a board that what is known of it can place, across whatever covers it.

    Args:
        picture: (height, width) grey from 0 to 1.
        grid: A part of the board.
        size: Rows and columns of the board's corners, upright or lying; the grid does not grow beyond.

    Returns:
        The grid with the corners found, and without those that the others contradict.
    """
    half_length = max(size) / 2
    for _ in range(MAX_ROUNDS):
        plane = BoardPlane.of(grid, half_length)
        margin = max(size) - min(grid.rows, grid.columns, max(size))
        wide = grid.pad(margin)
        where = _find_possible(wide, size)
        nodes = np.argwhere(where)
        places, sd = plane.locate(nodes.astype(np.float64) - margin)
        sure = sd < MAX_SEARCH_SD_SQUARES
        where[tuple(nodes[~sure].T)] = False
        astray = np.minimum(MAX_ASTRAY_SDS * sd[sure] + TOLERATED_SQUARES, MAX_ASTRAY_SQUARES)
        larger = add_corners(picture, wide, where, Places(*(x[sure] for x in places)), astray=astray)
        if larger.count == grid.count:
            break
        grid = larger
    return drop_thin_rims(_drop_contradicted(grid, half_length))


def _drop_contradicted(grid: Grid, half_length: float) -> Grid:
    """Without the corners that something cuts into, and those that are not where the others put them, the worst first:
    they push others off."""
    grid = grid.keep_only(grid.clear)
    while grid.count > MIN_CORNERS:
        there = grid.occupied
        uv, covariance = BoardPlane.of(grid, half_length).leave_one_out()
        off = grid.uv[there] - uv
        square = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
        keep = square < np.maximum(MAX_CONTRADICTION_SDS**2, 0.5 * square.max())
        if keep.all():
            break
        grid = grid.keep_only(scatter(keep, there))
    return grid


def _find_possible(grid: Grid, size: tuple[int, int]) -> Bools:
    """The nodes where a corner is missing that could belong to a board of that size, each by itself."""
    there = grid.occupied
    boxes = []
    for axis in (0, 1):
        used = np.flatnonzero(there.any(axis=1 - axis))
        index = np.arange(there.shape[axis])
        boxes.append(np.maximum(index, used[-1]) - np.minimum(index, used[0]) + 1)
    height, width = np.meshgrid(*boxes, indexing="ij")
    fits = (np.maximum(height, width) <= max(size)) & (np.minimum(height, width) <= min(size))
    return np.asarray(fits & ~there, dtype=np.bool_)
