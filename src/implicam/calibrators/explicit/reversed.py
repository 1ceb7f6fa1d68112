"""Boards whose corners one of two cameras counts from another end than the other: named, before anything is adjusted.

Each camera alone cannot tell: a board that is counted from the other end is a board that is turned by half a turn, and
one that is counted backwards along its rows is seen from behind. But the cameras must agree on where a board is, and do
so for the boards that are counted alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from implicam.calibrators.explicit.boards import BoardView
from implicam.geometry import Floats, Pose
from implicam.rig_model import CentralCamera

WAYS = {
    "": (1.0, 1.0, 1.0),
    "from the other end (first and last exchanged)": (-1.0, -1.0, 1.0),
    "backwards along the rows": (-1.0, 1.0, -1.0),
    "from the last row to the first": (1.0, -1.0, -1.0),
}
"""How corners are counted, and what that does to the axes of a board: a rotation of it, each undone by itself."""

MAX_REFERENCES = 8
"""Boards from which the pose of one camera to the other is tried."""

MIN_TIMES_BETTER = 5.0
"""How many times better a board must fit when it is counted in another way, and than it may be off after that."""

MIN_PART_EXPLAINED = 0.8
"""The part of the boards that fit when some are counted in another way."""

MIN_BOARDS = 3
"""Boards that both cameras saw: two contradict each other, and do not say which is counted rightly."""


class Reversed(NamedTuple):
    """Boards (numbers) that one of two cameras counts in another way than the other; of how many that both saw, and by
    how many pixels corners are usually off when they are counted alike."""

    boards: tuple[int, ...]
    way: str
    of: int
    error: float


def find_reversed(
    camera: CentralCamera,
    seen: Mapping[int, BoardView],
    placed: Mapping[int, Pose],
    other: Mapping[int, Pose],
    middle: Floats,
) -> Reversed | None:
    """The boards that two cameras count in different ways.

    Args:
        camera: One of the two, at the origin of its own frame.
        seen: Number of the board -> what it saw of it.
        placed: Number of the board -> camera_from_board of this camera alone.
        other: The same of the other camera.
        middle: (3,) of the board.

    Returns:
        The boards; None where all are counted alike, or where that explains nothing.
    """
    common = sorted(placed.keys() & other.keys())
    if len(common) < MIN_BOARDS:
        return None
    turns = {way: _turn(np.array(signs), middle) for way, signs in WAYS.items()}

    each = [(seen[k], other[k] @ turn) for k in common for turn in turns.values()]
    in_other = np.concatenate([pose.apply(view.xyz) for view, pose in each])
    uv = np.concatenate([view.uv for view, _ in each])
    ends = np.cumsum([len(view.uv) for view, _ in each])[:-1]

    def errors(camera_from_other: Pose) -> Floats:
        """(boards, ways) pixels that the corners are off."""
        off = np.linalg.norm(camera.pixel(camera_from_other.apply(in_other)) - uv, axis=1)
        parts = np.split(np.nan_to_num(off, nan=np.inf), ends)
        return np.array([np.median(part) for part in parts]).reshape(len(common), len(turns))

    best = np.full((len(common), len(turns)), np.inf)
    step = -(-len(common) // MAX_REFERENCES)
    for k in common[::step]:
        for turn in turns.values():
            tried = errors(placed[k] @ turn @ other[k].inverse())
            if np.median(tried.min(axis=1)) < np.median(best.min(axis=1)):
                best = tried
    usual = float(np.median(best.min(axis=1)))
    chosen, as_they_are = best.argmin(axis=1), best[:, 0]
    wrong = (chosen > 0) & (as_they_are > MIN_TIMES_BETTER * np.maximum(best.min(axis=1), usual))
    explained = best.min(axis=1) < MIN_TIMES_BETTER * max(usual, 1e-9)
    if not wrong.any() or explained.mean() < MIN_PART_EXPLAINED:
        return None
    way = list(turns)[np.bincount(chosen[wrong]).argmax()]
    return Reversed(tuple(k for k, bad in zip(common, wrong, strict=True) if bad), way, len(common), usual)


def _turn(signs: Floats, middle: Floats) -> Pose:
    """The board about its middle."""
    rotation = np.diag(signs)
    return Pose(rotation, middle - rotation @ middle)
