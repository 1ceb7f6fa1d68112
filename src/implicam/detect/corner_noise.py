"""How far off corners are, learned from the picture itself: the board says by how much they contradict each other.

What a fit leaves at one corner says too little, or too much, of its error: JPEG and a colour sensor's interpolation
make the errors of neighbouring pixels alike, and leave patterns that do not move a corner. But a board is flat and a
lens is smooth: where each corner must be follows from all the others (`projective.py`), and the ratio of their true
errors to the stated ones has a marginal likelihood. It is found for all corners together; their own residuals say how
they differ.

Corners that all lie at the same phase of the pixels' grid are off together, and no neighbour tells it: then what is
left at the edges counts as one common shift.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dsytrd

from implicam.dataset import Floats
from implicam.detect.corners import Bools, Corners
from implicam.detect.projective import Departure, ProjectiveProcess, fit_affine, project

REACH_HALVES = 1.4
"""Correlation length of what a lens does to a board, in halves of the board's longer side."""

BENDS = (0.003, 0.03, 0.1, 0.3)
"""How far lenses bend a board, in halves of its longer side: each is tried."""

SLACK = 1e-6
"""Of each corner about a smooth map, in halves of the board's longer side."""

PRIOR_LOG_SD = 0.7
"""Of the logarithm of the ratio, which is 1 where the corners say nothing."""

LOG_RATIOS = np.linspace(-2.5, 5.0, 151)
"""That are looked at."""

MIN_CORNERS = 6
"""Corners from which they can contradict each other: a homography takes four."""

MIN_LOCKED = 0.5
"""From 0, all phases alike, to 1, one phase: from which corners are off together."""


JUDGING = Departure(0.1, REACH_HALVES, 1e-4)
"""What a lens may do to a board before a corner contradicts the others."""

MIN_CORNERS_TO_JUDGE, MAX_CONTRADICTION_SDS = 9, 6.0
"""Corners from which one can be told to be wrong, and standard deviations from where the others put it."""

MEDIAN_SQUARE = 1.386
"""Median of the squared length of two normal variables."""

HIDDEN_PART = 1.5
"""A common shift over what is left at the edges: the fit has followed what it could."""


def true_sd(nodes: Floats, corners: Corners, half_length: float) -> Floats:
    """The standard uncertainties of corners as the board shows them.

    Args:
        nodes: (n, 2) where the corners are on the board, in squares.
        corners: n corners as fitted, none NaN.
        half_length: Half the longer side of the board, in the same unit.

    Returns:
        (n, 2) pixels; as the fit states them where there are too few corners.
    """
    if len(nodes) < MIN_CORNERS:
        return corners.sd
    ratio = error_ratio(nodes, corners.uv, corners.sd, half_length)
    locked = _find_locked(corners.uv)
    if not locked.any():
        return ratio * corners.sd
    shift = HIDDEN_PART * np.median(corners.edge_shift, axis=0) * locked
    return np.asarray(np.hypot(max(ratio, 1.0) * corners.sd, shift), dtype=np.float64)


def agreeing(nodes: Floats, corners: Corners, half_length: float) -> Bools:
    """Which corners are where all the others put them: something cut into the rest, or they are at the sheet's rim.

    Args:
        nodes: (n, 2) where the corners are on the board.
        corners: n corners as fitted, none NaN.
        half_length: Half the longer side of the board, in the unit of `nodes`.

    Returns:
        (n,) which agree; all where there are too few to tell.
    """
    keep = np.asarray(corners.misfit < max(3 * float(np.median(corners.misfit)), 0.1), dtype=np.bool_)
    while keep.sum() > MIN_CORNERS_TO_JUDGE:
        some = np.flatnonzero(keep)
        x, y, stated = _normalised(nodes[some], corners.uv[some], corners.sd[some], half_length)
        process = ProjectiveProcess.condition(x, y, stated**2, fit_affine(x, y), JUDGING, turns=8)
        uv, covariance = process.leave_one_out()
        square = np.einsum("ni,nij,nj->n", y - uv, np.linalg.inv(covariance), y - uv)
        square = square / max(1.0, float(np.median(square)) / MEDIAN_SQUARE)  # a few bad ones do not excuse themselves
        bad = square > max(MAX_CONTRADICTION_SDS**2, 0.5 * float(square.max()))
        if not bad.any():
            break
        keep[some[bad]] = False
    return keep


def error_ratio(nodes: Floats, uv: Floats, sd: Floats, half_length: float) -> float:
    """How many times larger errors are than stated.

    Args:
        nodes: (n, 2) where points are on a flat board.
        uv: (n, 2) pixels.
        sd: (n, 2) as stated.
        half_length: Half the longer side of the board, in the unit of `nodes`.

    Returns:
        The root of the mean of the squared ratio after the corners.
    """
    x, y, stated = _normalised(nodes, uv, sd, half_length)
    usual = Departure(0.03, REACH_HALVES, SLACK)
    process = ProjectiveProcess.condition(x, y, 4 * stated**2, fit_affine(x, y), usual, turns=8)
    image, J = project(process.theta, x)
    rest = ((y - image).ravel() + J @ process.theta) / stated.ravel()
    J = J / stated.ravel()[:, None]
    flat = J @ process.prior @ J.T
    curved = np.kron(usual._replace(bend=1).kernel(2)(x, x), np.eye(2)) / np.outer(stated, stated)
    # of a ratio c the covariance over the stated one is this and c^2: one reduction serves all ratios
    log_density = _log_densities([flat + bend**2 * curved for bend in BENDS], rest, np.exp(2 * LOG_RATIOS))
    density = log_density - 0.5 * (LOG_RATIOS / PRIOR_LOG_SD) ** 2
    weight = np.exp(density - density.max())
    return float(np.sqrt(np.sum(weight * np.exp(2 * LOG_RATIOS)) / np.sum(weight)))


def _log_densities(covariances: list[Floats], rest: Floats, added: Floats) -> Floats:
    """Gaussian log densities of `rest` (n,), up to a constant, of each covariance (n, n) with each number added to its
    diagonal: (covariances, added).

    Householder's reflections that begin with `rest` make a covariance tridiagonal, T, and `rest` a multiple of its
    first axis (Golub & Van Loan, section 8.3). The pivots of T + c, from the last up, give its determinant, and the
    first of them is one over the corner of its inverse (a continued fraction).
    """
    n = len(rest)
    whole = np.zeros((n + 1, n + 1), order="F")
    diagonal, beside = np.zeros((len(covariances), n + 1)), np.zeros((len(covariances), n))
    for k, covariance in enumerate(covariances):
        whole[1:, 0], whole[1:, 1:] = rest, covariance
        _, diagonal[k], beside[k], _, _ = dsytrd(whole, lower=1)
    pivot = np.full((len(covariances), len(added)), np.inf)
    log_determinant = np.zeros_like(pivot)
    for i in range(n, 0, -1):
        below = beside[:, i] ** 2 if i < n else np.zeros(len(covariances))
        pivot = diagonal[:, i, None] + added - below[:, None] / pivot
        log_determinant += np.log(pivot)
    return np.asarray(-0.5 * (beside[:, :1] ** 2 / pivot + log_determinant), dtype=np.float64)


def _normalised(nodes: Floats, uv: Floats, sd: Floats, half_length: float) -> tuple[Floats, Floats, Floats]:
    """Nodes and pixels about their middles, and standard uncertainties, in units in which the board is about 1 long."""
    middle, origin = nodes.mean(axis=0), uv.mean(axis=0)
    x = (nodes - middle) / half_length
    scale = float(np.sqrt(np.sum((uv - origin) ** 2) / np.sum(x**2)))
    return x, (uv - origin) / scale, sd / scale


def _find_locked(uv: Floats) -> Floats:
    """(2,) how far the corners lie at one phase of the pixels' grid, or of every second pixel; 0 where they do not."""
    phases = np.abs(np.exp(1j * np.pi * np.multiply.outer([1, 2], uv)).mean(axis=1)).max(axis=0)
    return np.where(phases > MIN_LOCKED, phases, 0.0)
