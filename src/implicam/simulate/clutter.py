"""What is behind the target: a laboratory's wall, things on it, and blobs that look like the target but are not it."""

from __future__ import annotations

import numpy as np

from implicam.images import Grey, opencv

CLUTTER_COUNT, LOOK_ALIKE_COUNT = 24, 14


def background(width: int, height: int, rng: np.random.Generator, *, clutter: bool = True) -> Grey:
    """The picture of what is behind the target, without noise.

    Args:
        width: Of the picture, pixels.
        height: Of the picture, pixels.
        rng: Random numbers.
        clutter: Whether there are things on the wall; without them it is plain, with a slow gradient.

    Returns:
        (height, width) brightness from 0 to 1.
    """
    v, u = np.mgrid[-0.5 : 0.5 : height * 1j, -0.5 : 0.5 : width * 1j].astype(np.float32)
    tilt = rng.normal(scale=0.08, size=2)
    wall = np.asarray(rng.uniform(0.2, 0.35) + tilt[0] * u + tilt[1] * v, np.float32)
    if not clutter:
        return wall
    cv2 = opencv()
    coarse = rng.normal(scale=0.05, size=(height // 40 + 2, width // 40 + 2)).astype(np.float32)
    wall = wall + cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(CLUTTER_COUNT):
        _draw_clutter(wall, rng)
    for _ in range(LOOK_ALIKE_COUNT):
        _draw_look_alike(wall, rng)
    return np.asarray(np.clip(wall, 0.03, 0.95), np.float32)


def _draw_clutter(wall: Grey, rng: np.random.Generator) -> None:
    """A cable, a box, a bracket."""
    cv2 = opencv()
    height, width = wall.shape
    at = (float(rng.uniform(0, width)), float(rng.uniform(0, height)))
    grey = float(rng.uniform(0.08, 0.6))
    kind = rng.integers(3)
    if kind == 0:
        to = (int(rng.uniform(0, width)), int(rng.uniform(0, height)))
        cv2.line(wall, (int(at[0]), int(at[1])), to, grey, int(rng.integers(2, 9)), cv2.LINE_AA)
    else:
        size = rng.uniform(20, 220, size=2)
        box = cv2.boxPoints((at, (float(size[0]), float(size[1])), float(rng.uniform(0, 180)))).astype(np.int32)
        if kind == 1:
            cv2.fillConvexPoly(wall, box, grey, cv2.LINE_AA)
        else:
            cv2.polylines(wall, [box], True, grey, int(rng.integers(2, 6)), cv2.LINE_AA)


def _draw_look_alike(wall: Grey, rng: np.random.Generator) -> None:
    """A dark disc on a grey wall, a bright disc, a hole that is no circle, a white patch with nothing before it."""
    height, width = wall.shape
    at = rng.uniform((60, 60), (width - 60, height - 60))
    radius = float(rng.uniform(6, 22))
    kind = rng.integers(4)
    if kind == 0:
        _draw_spot(wall, at, (2.2 * radius, 2.2 * radius), float(rng.uniform(0.25, 0.45)), square=True)
        _draw_spot(wall, at, (radius, radius), float(rng.uniform(0.1, 0.2)))
    elif kind == 1:
        _draw_spot(wall, at, (radius, radius), float(rng.uniform(0.55, 0.9)))
    elif kind == 2:
        _draw_spot(wall, at, (3.5 * radius, 3 * radius), float(rng.uniform(0.6, 0.8)), square=True)
        _draw_spot(wall, at, (radius, float(rng.uniform(0.3, 0.45)) * radius), 0.1, angle=float(rng.uniform(0, 180)))
    else:
        _draw_spot(wall, at, (3 * radius, 3 * radius), float(rng.uniform(0.6, 0.8)), square=True)


def _draw_spot(
    wall: Grey, at: np.ndarray, size: tuple[float, float], grey: float, *, angle: float = 0.0, square: bool = False
) -> None:
    """A filled ellipse, or a rectangle, half `size`; OpenCV draws on a grid of 1/16 pixel."""
    cv2 = opencv()
    if square:
        box = cv2.boxPoints(((float(at[0]), float(at[1])), (2 * size[0], 2 * size[1]), angle))
        cv2.fillConvexPoly(wall, np.rint(16 * box).astype(np.int32), grey, cv2.LINE_AA, 4)
        return
    middle, axes = (tuple(round(16 * x) for x in pair) for pair in (at, size))
    cv2.ellipse(wall, middle, axes, angle, 0, 360, grey, -1, cv2.LINE_AA, 4)
