"""The noise of each camera over the rig's, from what the adjustment leaves of its views, eq. (V11).

A place draws its views to itself, and more so those of a camera that is trusted; so what is left of a camera's views
is compared with what is expected of them, the trace of their part of I - H (Förstner 1979, variance components). Two
cameras that see everything together leave the same of each other, and nothing is learned.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from implicam.calibrators.forward_gp.wand.bundle import FrameEquations, WhiteRows
from implicam.geometry import Floats

MAX_VIEWS = 250
"""Of a camera, by which its noise is judged: the standard uncertainty is 3 % then."""

MIN_LEFT = 20.0
"""Numbers that must be left of a camera's views to say something of it."""


LONGER_STEP = 1.5
"""Places follow the cameras that are trusted, and half of a step comes back."""


class Left(NamedTuple):
    """What is left of the views of each camera (C,): squares, in its noise; and numbers that are free in them, of those
    that were looked at and of all."""

    squares: Floats
    free: Floats
    all_free: Floats


def left_of_views(white: Sequence[WhiteRows], equations: FrameEquations, inverse: Floats, root: Floats) -> Left:
    """What is left of the views of each camera, at the optimum.

    Args:
        white: Of each camera, with fields: as of `white_models`.
        equations: Those that were solved.
        inverse: (F, 6, 6) covariance of the places, if the cameras are as they are.
        root: (P, P) of the covariance of the cameras.
    """
    found, start = [], 0
    blocks = inverse.reshape(-1, 2, 3, 6)
    for one in white:
        n, _, size = one.J.shape
        at = np.arange(n) if n <= MAX_VIEWS else np.random.default_rng(0).permutation(n)[:MAX_VIEWS]
        frame, end = one.rows[at] // 2, one.rows[at] % 2
        D = one.by_place[at]
        follows = D @ blocks[frame, end]  # (m, 2, 6)
        slope = -follows @ equations.G[frame]
        slope[:, :, start : start + size] += one.J[at]
        drawn = np.sum((slope @ root.T) ** 2)
        own = follows.reshape(-1, 2, 2, 3)[np.arange(len(at)), :, end]
        drawn += np.sum(own * D)
        free = max(2 * len(at) - float(drawn), 0.0)
        found.append((float(np.sum(one.residual[at] ** 2)), free, free * n / max(len(at), 1)))
        start += size
    return Left(*np.array(found).T)


def own_noise(left: Left, before: Floats, prior_sd: float) -> Floats:
    """The log noise of each camera over the rig's.

    Args:
        left: Of its views.
        before: (C,) what it was taken for.
        prior_sd: Of the same, before anything is seen.

    >>> told = own_noise(Left(np.array([100.0, 100.0, 900.0]), np.full(3, 100.0), np.full(3, 400.0)), np.zeros(3), 0.15)
    >>> bool(told[0] == told[1] < 0 < told[2] < np.log(3))
    True
    """
    known = left.free >= MIN_LEFT
    if known.sum() < 2:
        return before
    told = before.copy()
    told[known] += LONGER_STEP * 0.5 * np.log(np.maximum(left.squares[known], 1e-12) / left.free[known])
    weight = np.where(known, left.free, 0.0)
    told -= float(weight @ told) / float(weight.sum())
    variance = 1 / (2 * np.maximum(left.free, 1e-3))
    return np.where(known, told * prior_sd**2 / (prior_sd**2 + variance), 0.0)
