"""How far off the known points are after the alignment, over what the boards say: error bars learn it from them.

A lens that no model holds shifts whole boards, and their poses follow: what is left at the corners then says little of
how far off a measured point is, more on one rig and less on another. The known points are at places of their own. What
is left there after the alignment is a quadratic form of normal errors; its mean and its variance follow from the
covariance that the boards give, with the errors that all points share through the cameras (Satterthwaite 1946 for its
degrees of freedom).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from implicam.dataset import Names
from implicam.geometry import Floats

RATIOS = np.exp(np.linspace(-3.0, 5.0, 801))
"""That are looked at: from a twentieth to 150."""


class Left(NamedTuple):
    """What an alignment leaves at m known points, in the rig's frame.

    Attributes:
        residual: (m, 3).
        W: (m, 3, 3) the weights of the alignment.
        G: (m, 3, 6) how the points follow the motion.
        Q: (6, 6) inverse of the normal matrix.
        point: (m, 3, 3) covariance from the noise of each point's own views.
        spread: (m, 3, q) root of what the cameras' errors do to all points together.
        declared: (m, 3, 3) root of the covariance of the known position.
        shots: (m,) points of one shot share the error of their known position.
    """

    residual: Floats
    W: Floats
    G: Floats
    Q: Floats
    point: Floats
    spread: Floats
    declared: Floats
    shots: Names


def error_ratio(left: Left, prior_log_sd: float) -> float:
    """How many times larger errors are than the covariance of cameras and views says.

    Args:
        left: What the alignment leaves at the known points.
        prior_log_sd: Of the logarithm of the ratio, which is 1 where the known points say nothing.

    Returns:
        The root of the mean of the squared ratio after the known points: few points leave it near 1, and above rather
        than below.
    """
    squares, cameras, declared, degrees = expected_squares(left)
    expected = RATIOS**2 * cameras + declared
    log_density = -0.5 * (np.log(RATIOS) / prior_log_sd) ** 2 - 0.5 * degrees * (np.log(expected) + squares / expected)
    weight = np.exp(log_density - log_density.max())
    return float(np.sqrt(np.sum(weight * RATIOS**2) / np.sum(weight)))


def expected_squares(left: Left) -> tuple[float, float, float, float]:
    """What the alignment leaves, and what should be left.

    Args:
        left: What the alignment leaves at the known points.

    Returns:
        The weighted sum of squares; its expectation from cameras and views, and that from the known positions; and its
        degrees of freedom, 3 m - 6 where all errors are the points' own.
    """
    L = np.linalg.cholesky(left.W).swapaxes(1, 2)
    U = (L @ left.G).reshape(-1, 6) @ np.linalg.cholesky(left.Q)  # orthonormal: what the motion takes away

    def without_motion(columns: Floats) -> Floats:
        return np.asarray(columns - U @ (U.T @ columns), dtype=np.float64)

    own = L @ left.point @ L.swapaxes(1, 2)
    known = L @ left.declared
    shared = without_motion((L @ left.spread).reshape(len(U), -1))
    by_shot, alone = _by_shot(known, left.shots)
    by_shot = without_motion(by_shot)
    stated = alone @ alone.swapaxes(1, 2)
    expected = [
        float(np.einsum("nii->", block) - np.sum(U * _times(block, U)) + np.sum(columns**2))
        for block, columns in ((own, shared), (stated, by_shot))
    ]
    block, columns = own + stated, np.hstack([shared, by_shot])
    turned = _times(block, U)
    variance = np.sum(block**2) - 2 * np.sum(turned**2) + np.sum((U.T @ turned) ** 2)
    variance += 2 * np.sum(columns * _times(block, columns)) + np.sum((columns.T @ columns) ** 2)
    squares = float(np.sum((L @ left.residual[..., None]) ** 2))
    return squares, expected[0], expected[1], float(sum(expected) ** 2 / variance)


def _times(block: Floats, columns: Floats) -> Floats:
    """(3 m, k) columns times blocks (m, 3, 3) along a diagonal."""
    return np.asarray((block @ columns.reshape(len(block), 3, -1)).reshape(columns.shape), dtype=np.float64)


def _by_shot(known: Floats, shots: Names) -> tuple[Floats, Floats]:
    """Columns (3 m, 3 k) of the k shots with several points; and (m, 3, 3) the roots of the others, zero for these."""
    _, number, count = np.unique(shots, return_inverse=True, return_counts=True)
    several = np.flatnonzero(count > 1)
    columns = np.zeros((len(known), 3, len(several), 3))
    for k, shot in enumerate(several):
        mine = number == shot
        columns[mine, :, k] = known[mine]
    return columns.reshape(3 * len(known), -1), np.where((count[number] == 1)[:, None, None], known, 0.0)
