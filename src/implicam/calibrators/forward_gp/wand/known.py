"""What is known of the places of markers beside what cameras saw of them: lengths of the wand, and known positions.

A known position is a place with a normal prior. Several that are not on one line say where the world is, so nothing is
held then; and they say something of the scale, against the error that all lengths share, which is one unknown more
(V10).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from implicam.calibrators.forward_gp.wand.bundle import FrameEquations, Lengths, WhiteRows
from implicam.errors import FitError
from implicam.geometry import Bools, Floats, Pose, register
from implicam.rig_model.placement import MAX_EXTENT_ERROR, MAX_SCALE_ERROR, MAX_SCALE_SDS, other_scale

MIN_KNOWN = 3
"""Known positions that a world takes."""

LEAST_SD = 1e-5
"""Of a known position that is stated to be exact, in units of the wand's length."""

TRIMMED_ROUNDS, TRIMMED_MEDIANS = 4, 3.0
"""Rounds in which known positions that are so many medians off are left out, before anything is weighted."""

MIN_KNOWN_SHARE = 0.5
"""Of the known positions that must agree with the wand."""

MAX_MISFIT = 0.1
"""Median distance of known positions from where the wand's cameras place them, over their extent, that is no world."""


class KnownPlaces(NamedTuple):
    """Known positions: rows (k,) numbers of the places, xyz (k, 3) and sd (k, 3)."""

    rows: np.ndarray
    xyz: Floats
    sd: Floats

    def select(self, keep: np.ndarray) -> KnownPlaces:
        """Some of them.

        Args:
            keep: (k,) which, or their numbers.
        """
        return KnownPlaces(self.rows[keep], self.xyz[keep], self.sd[keep])

    def moved(self, pose: Pose, scale: float) -> KnownPlaces:
        """In another frame.

        Args:
            pose: The other frame from this one.
            scale: By which positions are divided at last.
        """
        sd = np.sqrt(self.sd**2 @ (pose.rotation**2).T) / scale
        return KnownPlaces(self.rows, pose.apply(self.xyz) / scale, sd)


NOTHING_KNOWN = KnownPlaces(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


class Facts(NamedTuple):
    """lengths and known places in use; growth: of all lengths together over what they are stated to be, with its sd
    (0: not an unknown)."""

    lengths: Lengths
    known: KnownPlaces
    growth: float = 0.0
    growth_sd: float = 0.0

    @property
    def numbers(self) -> int:
        """Numbers they state."""
        return len(self.lengths.frames) + self.known.xyz.size

    @property
    def grows(self) -> bool:
        """Whether the growth is an unknown, the last of those of the cameras."""
        return self.growth_sd > 0

    def equations(self, white: Sequence[WhiteRows], places: Floats) -> FrameEquations:
        """Normal equations of views and facts, without priors of the cameras.

        Args:
            white: Views of each camera.
            places: (F, 2, 3).
        """
        lengths = self.lengths._replace(length=self.lengths.length * (1 + self.growth))
        off, slope = lengths.linear(places)
        found = FrameEquations.of(white, len(places), (lengths.frames, off, slope))
        squares = found.squares + _add_known(found, self.known, places)
        if not self.grows:
            return found._replace(squares=squares)
        P = len(found.b)
        A, b, G = np.zeros((P + 1, P + 1)), np.zeros(P + 1), np.zeros((*found.G.shape[:2], P + 1))
        A[:P, :P], b[:P], G[:, :, :P] = found.A, found.b, found.G
        by_growth = -self.lengths.length / lengths.sd
        A[P, P] = float(by_growth @ by_growth) + self.growth_sd**-2
        b[P] = float(by_growth @ off) - self.growth / self.growth_sd**2
        G[lengths.frames, :, P] += slope * by_growth[:, None]
        squares += (self.growth / self.growth_sd) ** 2
        return FrameEquations(A, b, found.H, found.g, G, squares)


def _add_known(equations: FrameEquations, known: KnownPlaces, places: Floats) -> float:
    """Into the blocks of the frames; and the squares of what is off."""
    frames, end = known.rows // 2, known.rows % 2
    off, weight = known.xyz - places[frames, end], known.sd**-2.0
    for axis in range(3):
        at = 3 * end + axis
        equations.H[frames, at, at] += weight[:, axis]
        equations.g[frames, at] += weight[:, axis] * off[:, axis]
    return float(np.sum(weight * off**2))


def known_that_agree(known: KnownPlaces, places: Floats, spread: Floats, used: Bools, limit: float) -> Bools:
    """(k,) known places that agree with what cameras and lengths say, each as if it had not been used.

    Args:
        known: All of them.
        places: (F, 2, 3).
        spread: (k, 6, 6) covariance of the places of their frames, with what is unknown of the cameras.
        used: (k,) which are used.
        limit: Of the squared distance.
    """
    frames, end = known.rows // 2, known.rows % 2
    off = (known.xyz - places[frames, end]) / known.sd
    block = (
        spread.reshape(-1, 2, 3, 2, 3)[np.arange(len(end)), end, :, end] / known.sd[:, :, None] / known.sd[:, None, :]
    )
    values, vectors = np.linalg.eigh(np.eye(3) + np.where(used, -1.0, 1.0)[:, None, None] * block)
    turned = np.einsum("nij,ni->nj", vectors, off)
    return np.asarray(np.sum(turned**2 / np.maximum(values, 1e-9), axis=1) <= limit)


class LaidOver(NamedTuple):
    """here_from_world; fits (k,) which known places do; ratio of known over measured distances, with its sd."""

    here_from_world: Pose
    fits: Bools
    ratio: float
    ratio_sd: float


def lay_known_over(known: KnownPlaces, at: Floats, length_sd: float) -> LaidOver:
    """Where the world of known positions is in that of a wand.

    Args:
        known: In their world.
        at: (2 F, 3) places, NaN where unknown.
        length_sd: Relative sd of the length of the wand.

    Returns:
        Where it is, which of them fit, and by how much they are larger.

    Raises:
        FitError: They are too few, on one line, of another scale, or nowhere near.
    """
    there = np.isfinite(at[known.rows]).all(axis=1)
    if there.sum() < MIN_KNOWN:
        raise FitError(
            f"{there.sum()} of {len(known.rows)} known points can be placed by two cameras that the wand calibrates; "
            f"it takes {MIN_KNOWN}.",
            fix="show them to two cameras or more, while the wand is waved or before or after it",
        )
    a, b = known.xyz[there], at[known.rows[there]]
    good = np.ones(len(a), dtype=np.bool_)
    for _ in range(TRIMMED_ROUNDS):
        pose, _ = register(a[good], b[good])
        off = np.linalg.norm(pose.apply(a) - b, axis=1)
        near = off <= max(TRIMMED_MEDIANS * float(np.median(off[good])), 3 * LEAST_SD)
        if near.sum() < max(MIN_KNOWN + 1, 0.7 * len(a)) or (near == good).all():
            break
        good = near
    about = [x[good] - x[good].mean(axis=0) for x in (a, b)]
    extents = [float(np.linalg.norm(x)) for x in about]
    ratio = extents[0] / extents[1]
    _, left = register(about[0] / ratio, about[1])
    sd = float(np.hypot(left / extents[1], length_sd))
    if abs(ratio - 1) > min(MAX_EXTENT_ERROR, max(MAX_SCALE_ERROR, MAX_SCALE_SDS * sd)):
        raise other_scale(ratio)
    size = extents[0] / np.sqrt(good.sum())
    if np.median(off[good]) > MAX_MISFIT * size:
        raise FitError(
            f"the known points and the wand contradict each other: laid over each other they are "
            f"{np.median(off[good]) / size:.0%} of their extent apart.",
            why="names are exchanged, the known positions are as in a mirror, or they moved",
            fix="check names and positions, or calibrate without them and look: implicam world",
        )
    used = np.zeros(len(known.rows), dtype=np.bool_)
    used[np.flatnonzero(there)[good]] = True
    return LaidOver(pose, used, ratio, sd)


def refuse_contradicting_known(known: KnownPlaces, places: Floats, used: Bools) -> None:
    """Stop where most known places contradict the wand, or the others.

    Args:
        known: All of them.
        places: (F, 2, 3).
        used: (k,) which agree.

    Raises:
        FitError: Too few agree.
    """
    if not len(used) or used.sum() >= max(MIN_KNOWN, MIN_KNOWN_SHARE * len(used)):
        return
    raise FitError(
        f"{used.sum()} of {len(used)} known points agree with the wand.",
        why="the length of the wand is wrong, or the stated uncertainties are too small: a wand that is 1 % off "
        "contradicts exact points",
        fix="measure the wand again, or state how exact it is (--wand-sd) and how exact the known points are (sd_x, "
        "sd_y, sd_z); implicam world tells by how much they differ",
    )
