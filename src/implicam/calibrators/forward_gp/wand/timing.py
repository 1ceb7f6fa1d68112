"""Cameras that expose earlier or later than the others: seen by a wand that moves.

A camera that is late by tau frames sees the wand where it will be: its views are off by tau times the velocity of their
place in its picture. Places, lenses and fields are unknown too, and take up a part of that: so tau is one more
unknown of each camera, in the same linear equations, up to a shift that all cameras share.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.wand.bundle import FrameEquations, WhiteRows
from implicam.geometry import Bools, Floats

MIN_FRAMES = 20
"""Frames with a velocity, that take to say anything of time."""

MAX_BEND = 0.5
"""Second difference of the places over their step from frame to frame, in the median: with more, frames do not follow
each other closely enough for a velocity."""

CLEAR_SDS, MIN_OFFSET_FRAMES = 6.0, 0.03
"""An offset of so many standard uncertainties, and of so many frames, is worth a note."""

USUAL_FRAMES = 1.0
"""Prior sd of an offset: so long as nothing tells of it."""


class Offset(NamedTuple):
    """A camera by its number, and by how many frames its pictures are later than those of most others."""

    camera: int
    frames: float
    sd: float


def velocities(frames: Sequence[str], places: Floats, known: Bools) -> Floats | None:
    """How places move, per frame.

    Args:
        frames: (F,) names; numbers, if there is a velocity.
        places: (F, 2, 3).
        known: (F, 2) which of them are.

    Returns:
        (F, 2, 3), NaN where unknown; None where frames do not follow each other.
    """
    try:
        number = np.array([float(name) for name in frames])
    except ValueError:
        return None
    at = {value: i for i, value in enumerate(number.tolist())}
    rows = [(at[n - 1], i, at[n + 1]) for n, i in at.items() if n - 1 in at and n + 1 in at]
    if len(rows) < MIN_FRAMES:
        return None
    before, now, after = np.array(rows).T
    there = np.where(known[..., None], places, np.nan)
    step = 0.5 * (there[after] - there[before])
    bend = np.linalg.norm(there[after] - 2 * there[now] + there[before], axis=2)
    size = np.linalg.norm(step, axis=2)
    good = np.isfinite(bend) & np.isfinite(size)
    if good.sum() < MIN_FRAMES or np.median(bend[good]) > MAX_BEND * np.median(size[good]):
        return None
    out = np.full(places.shape, np.nan)
    out[now] = step
    return out


def time_offsets(
    white: Sequence[WhiteRows], lengths: tuple[NDArray[np.int64], Floats, Floats], equations: FrameEquations,
    velocity: Floats,
) -> tuple[Floats, Floats] | None:  # fmt: skip
    """By how many frames each camera is late, everything else of the cameras and all places being unknown too.

    Args:
        white: Of each camera its views in units of their noise, and their slopes.
        lengths: Frames, residuals and slopes of lengths.
        equations: Of these views and lengths, with the priors of the cameras.
        velocity: (2 F, 3) of all places, per frame; NaN where unknown.

    Returns:
        (C,) frames, about the median of all cameras (of two, about the first), and their standard uncertainties; None
        where too few views have a velocity.
    """
    moving = np.isfinite(velocity[:, 0])
    if min(int(moving[one.rows].sum()) for one in white) < MIN_FRAMES:
        return None
    still = np.where(moving[:, None], velocity, 0.0)
    more = []
    for one in white:
        by_time = np.einsum("nij,nj->ni", one.by_place, still[one.rows])
        more.append(one._replace(J=np.concatenate([one.J, by_time[..., None]], axis=2)))
    frames, C = len(velocity) // 2, len(white)
    plain, own = FrameEquations.of(white, frames, lengths), FrameEquations.of(more, frames, lengths)
    ends = np.cumsum([one.J.shape[2] for one in more])
    late = ends - 1
    others = np.setdiff1d(np.arange(ends[-1]), late)
    own.A[np.ix_(others, others)] += equations.A - plain.A
    own.b[others] += equations.b - plain.b
    own.A[late, late] += 1 / USUAL_FRAMES**2
    _, G, g = own.halved()
    S, b = own.A - G.T @ G, own.b - G.T @ g
    scale = 1 / np.sqrt(np.diag(S))
    inverse = np.linalg.inv(S * scale[:, None] * scale + 1e-12 * np.eye(len(S))) * scale[:, None] * scale
    tau, covariance = (inverse @ b)[late], inverse[np.ix_(late, late)]
    about = np.zeros((C, C))
    about[:, 0 if C == 2 else int(np.argsort(tau)[C // 2])] = 1.0
    to = np.eye(C) - about
    return to @ tau, np.sqrt(np.maximum(np.diag(to @ covariance @ to.T), 0))


def clear_offsets(cameras: Sequence[int], found: tuple[Floats, Floats] | None) -> tuple[Offset, ...]:
    """Those that are worth a note.

    Args:
        cameras: Their numbers.
        found: As `time_offsets` gives it.
    """
    if found is None:
        return ()
    return tuple(
        Offset(c, float(tau), float(sd))
        for c, tau, sd in zip(cameras, *found, strict=True)
        if abs(tau) > max(CLEAR_SDS * sd, MIN_OFFSET_FRAMES)
    )
