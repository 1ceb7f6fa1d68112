"""Where to hold a board in the picture of a camera that is not calibrated yet: what it has not been shown.

Nothing is known of such a camera but its picture, so it is taken for a pinhole with a usual focal length: good enough
to tell left from right, near from far, and how a board is tilted; not to measure.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from implicam.active.board_design import DESIGN_CORNERS, BoardShape
from implicam.dataset import Floats
from implicam.geometry import Pose, look_at, poses_from_rays, rotation_from_vector

USUAL_FOCAL_WIDTHS = 0.8
"""Focal length over the width of the picture: 64 degrees across."""

FEATURE_SCALES = np.array([0.3, 0.3, 0.5, 0.4, 0.4])
"""By so much two views differ that tell different things: of the picture's width and height, of the logarithm of the
span, of the sines of the tilts."""

TILTS_DEG = ((0, 35), (0, -35), (-35, 0), (35, 0), (20, 20), (-20, -20))
"""About the board's x and y."""

PLACES, SPANS = (0.5, 0.3, 0.7), (0.5, 0.32)
"""Of the picture's width and height; the board's diagonal over the width."""


class Framing(NamedTuple):
    """How a board is in a picture.

    Attributes:
        place: (2,) its middle, as parts of width and height.
        span: Its diagonal over the picture's width, as if it faced the camera.
        tilt: (2,) how far it faces right and down, sines.
        camera_from_board: By the usual focal length.
    """

    place: Floats
    span: float
    tilt: Floats
    camera_from_board: Pose

    @property
    def features(self) -> Floats:
        """(5,) to be compared, each in its own scale."""
        own = np.array([*self.place, np.log(self.span), *self.tilt], dtype=np.float64)
        return np.asarray(own / FEATURE_SCALES, dtype=np.float64)


def usual_pixels(points: Floats, size: tuple[int, int]) -> Floats:
    """Where a camera of the usual focal length sees points.

    Args:
        points: (n, 3) in its frame.
        size: Width and height of its picture.

    Returns:
        (n, 2) pixels.
    """
    middle = (np.array(size) - 1) / 2
    return np.asarray(USUAL_FOCAL_WIDTHS * size[0] * points[:, :2] / points[:, 2:] + middle, dtype=np.float64)


def framing_of(shape: BoardShape, corners: Floats, uv: Floats, size: tuple[int, int]) -> Framing | None:
    """How a board is in a picture that shows it.

    Args:
        shape: The board.
        corners: (n, 3) those that were found, on the board.
        uv: (n, 2) their pixels.
        size: Width and height of the picture.

    Returns:
        The framing; None where no board is seen like that.
    """
    if len(corners) < 4:
        return None
    few = np.unique(np.linspace(0, len(corners) - 1, DESIGN_CORNERS).astype(int))
    off = (uv[few] - (np.array(size) - 1) / 2) / (USUAL_FOCAL_WIDTHS * size[0])
    rays = np.column_stack([off, np.ones(len(off))])
    found = poses_from_rays(corners[few], rays / np.linalg.norm(rays, axis=1, keepdims=True))
    return _framing(shape, found[0], size) if found else None


def _framing(shape: BoardShape, pose: Pose, size: tuple[int, int]) -> Framing:
    middle = pose.apply(shape.middle)
    (uv,) = usual_pixels(middle[None], size)
    span = USUAL_FOCAL_WIDTHS * shape.diagonal / float(np.linalg.norm(middle))
    facing = look_at(np.zeros(3), middle, (0.0, -1.0, 0.0)).rotation @ pose.rotation
    return Framing(np.asarray(uv / np.array(size), dtype=np.float64), span, -facing[:2, 2], pose)


def third_of(place: Floats, camera: str) -> str:
    """Where something is in a picture, in words: "left third, lower part of cam2".

    Args:
        place: (2,) as parts of width and height.
        camera: Whose picture it is.
    """
    across = ("left third", "middle", "right third")[int(np.clip(3 * place[0], 0, 2))]
    down = ("upper part", "", "lower part")[int(np.clip(3 * place[1], 0, 2))]
    where = down if across == "middle" and down else across if not down else f"{across}, {down}"
    return f"{where} of {camera}"


def unseen_framing(shape: BoardShape, size: tuple[int, int], seen: Sequence[Framing]) -> Framing:
    """Of the places and tilts that a camera should be shown, that which differs most from what it has seen.

    Args:
        shape: The board.
        size: Width and height of the picture.
        seen: What it has been shown.
    """
    offered = list(_offered(shape, size))
    if not seen:
        return offered[0]
    known = np.array([one.features for one in seen])
    far = [float(np.linalg.norm(known - one.features, axis=1).min()) for one in offered]
    return offered[int(np.argmax(far))]


def is_new(framing: Framing, seen: Sequence[Framing]) -> bool:
    """Whether a view tells something that others do not.

    Args:
        framing: The view.
        seen: The others, of the same camera.
    """
    return all(float(np.linalg.norm(one.features - framing.features)) > 0.6 for one in seen)


def _offered(shape: BoardShape, size: tuple[int, int]) -> Iterator[Framing]:
    for span, x, y, tilt in product(SPANS, PLACES, PLACES, TILTS_DEG):
        off = (np.array([x, y]) * size - (np.array(size) - 1) / 2) / (USUAL_FOCAL_WIDTHS * size[0])
        ray = np.array([*off, 1.0])
        place = ray / np.linalg.norm(ray) * USUAL_FOCAL_WIDTHS * shape.diagonal / span
        frame = look_at(np.zeros(3), place, (0.0, -1.0, 0.0)).rotation.T
        frame = frame @ rotation_from_vector(np.radians([*tilt, 0.0]))
        pose = Pose(frame, place - frame @ shape.middle)
        rim = usual_pixels(pose.apply(shape.outline), size)
        if ((rim > 0) & (rim < np.array(size) - 1)).all():
            yield _framing(shape, pose, size)
