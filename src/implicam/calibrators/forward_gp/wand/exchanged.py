"""Pictures in which the two ends of the wand bear each other's names: seen, and put right.

Of one camera's two views nothing tells which end is which; of two cameras that are known, lines of sight meet, and as
far apart as the wand is long, in one way only. Where several cameras see a frame, those that agree with fewer
others are exchanged; which of two is, does not matter, for a wand looks the same from either end.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.wand.pairs import meet_two
from implicam.calibrators.forward_gp.wand.waves import Waves
from implicam.geometry import Bools, Floats, Pose
from implicam.rig_model import CentralCamera, GeneralCamera

CLEARLY_OFF = 2.0
"""Views that do not agree are so many times farther off than views that do may be."""

MAX_LENGTH_ERROR = 0.05
"""Of the wand, over its length, where its ends are put right."""


def find_exchanged(waves: Waves, cameras: Mapping[int, CentralCamera | GeneralCamera], near_px: float) -> Bools:
    """In which pictures the ends are exchanged.

    Args:
        waves: What was seen.
        cameras: By number.
        near_px: How far views that agree are off, in pixels of an image of 1280.

    Returns:
        (F, C).
    """
    if waves.still:
        return np.zeros((waves.frames, len(waves.seen)), dtype=np.bool_)
    whole, uv = waves.whole_views, waves.uv
    votes = np.zeros((waves.frames, uv.shape[1], uv.shape[1]), dtype=np.int8)
    for i, j in combinations(sorted(cameras), 2):
        frames = np.flatnonzero(whole[:, i] & whole[:, j])
        if not len(frames):
            continue
        off, sizes = [], []
        for crossed in (0, 1):
            one = _meet(waves, cameras, (i, j), (2 * frames, 2 * frames + crossed))
            two = _meet(waves, cameras, (i, j), (2 * frames + 1, 2 * frames + 1 - crossed))
            off.append(np.maximum(one[1], two[1]))
            sizes.append(np.linalg.norm(two[0] - one[0], axis=1) / waves.lengths[frames])
        right = np.abs(np.array(sizes) - 1) < MAX_LENGTH_ERROR
        straight = (off[0] < near_px) & (off[1] > CLEARLY_OFF * near_px)
        crossed_only = (off[1] < near_px) & right[1] & ((off[0] > CLEARLY_OFF * near_px) | ~right[0])
        vote = straight.astype(np.int8) - (crossed_only & ~straight)
        votes[frames, i, j] = votes[frames, j, i] = vote
    found = np.zeros((waves.frames, uv.shape[1]), dtype=np.bool_)
    for frame in np.flatnonzero((votes < 0).any(axis=(1, 2))):
        found[frame] = _minority(votes[frame])
    return found


def _meet(
    waves: Waves,
    cameras: Mapping[int, CentralCamera | GeneralCamera],
    pair: tuple[int, int],
    rows: tuple[NDArray[np.int64], NDArray[np.int64]],
) -> tuple[Floats, Floats]:
    """Where lines of sight of two cameras' views of places meet (n, 3), and the farther of both views from there, in
    pixels of 1280; infinite behind a camera."""
    uv = [waves.uv[row, c] for c, row in zip(pair, rows, strict=True)]
    lines = [cameras[c].lines(seen) for c, seen in zip(pair, uv, strict=True)]
    x, before = meet_two(np.stack([lines[0][1], lines[1][1]]), Pose(np.eye(3), lines[0][0] - lines[1][0]))
    x = x + lines[0][0]
    off = [
        np.linalg.norm(cameras[c].pixel(x) - seen, axis=1) / (waves.images[c].half / 640)
        for c, seen in zip(pair, uv, strict=True)
    ]
    far = np.max(off, axis=0)
    return x, np.where(before & np.isfinite(far), far, np.inf)


def _minority(votes: NDArray[np.int8]) -> Bools:
    """Cameras (C,) that have to be exchanged so that those agree that do: the fewer of both groups, of equal ones that
    without the first camera. Nothing where the votes contradict each other."""
    side = np.zeros(len(votes), dtype=np.int8)
    for first in range(len(votes)):
        if side[first] or not votes[first].any():
            continue
        side[first], todo = 1, [first]
        group = [first]
        while todo:
            c = todo.pop()
            for k in np.flatnonzero(votes[c]):
                if side[k] == 0:
                    side[k] = side[c] * votes[c, k]
                    todo.append(int(k))
                    group.append(int(k))
        inside = np.array(group)
        agrees = side[inside][:, None] * side[inside] * votes[np.ix_(inside, inside)]
        if (agrees < 0).any():
            side[inside] = 1
        elif (side[inside] < 0).sum() > len(inside) / 2:
            side[inside] *= -1
    return np.asarray(side < 0, dtype=np.bool_)
