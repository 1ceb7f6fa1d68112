"""Where each pixel looks, as bicubic B-splines over the image: a near and a far point of its line of sight.

The points are those that the whole camera sees there, its residual field included, so that lines of sight meet where
Gauss-Newton hardly has to move (docs/decisions/0026-compiled-map.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.geometry import Floats
from implicam.rig_model import CameraModel, FittedRig
from implicam.tabulated.spline_table import coefficients, filled, sites

SIGHT_CELLS = 24
"""Cells along u and along v."""

MARGIN = 0.02
"""By which a table is larger than the image, in its sides."""

STEPS = 3
"""Of Newton, from the line of sight of the camera without its field."""

MAX_MOVE = 0.2
"""Of a point by its field, in its distance; beyond, the line without the field is taken."""


class SightLines(NamedTuple):
    """Lines of sight of C cameras: frames (C, 4) first u and v, and cells per pixel along u and v; points
    (C, v, u, 8) coefficients of a near point (3) and a far one (3), in the working frame, and of the length across the
    line that is a pixel near and far."""

    frames: Floats
    points: NDArray[np.float32]


def tabulate_sight_lines(rig: FittedRig, low: Floats, high: Floats) -> SightLines:
    """Where the pixels of all cameras look.

    Args:
        rig: The cameras.
        low: (3,) lowest corner of the box that they look at, in the working frame.
        high: (3,) the highest.

    Returns:
        The tables.
    """
    t, frames, points = sites(SIGHT_CELLS), [], []
    turn = coefficients(SIGHT_CELLS)
    for model in rig.posterior.models:
        first, last = _image_range(rig, model, low, high)
        per_cell = (last - first) / SIGHT_CELLS
        v, u = np.meshgrid(first[1] + t * per_cell[1], first[0] + t * per_cell[0], indexing="ij")
        values = _near_and_far(model, np.column_stack([u.ravel(), v.ravel()]), 0.5 * (low + high), high - low)
        values = values.reshape(len(t), len(t), 8)
        for k in range(8):
            values[..., k] = filled(values[..., k, None])[..., 0]
        frames.append([*first, *(1 / per_cell)])
        points.append(np.einsum("iv,ju,vuk->ijk", turn, turn, values).astype(np.float32))
    return SightLines(np.array(frames), np.array(points))


def _image_range(rig: FittedRig, model: CameraModel, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """First and last pixel (2,): of the image, or as far as the box is seen where its size is not known."""
    camera = rig.trained.cameras[rig.cameras[rig.posterior.models.index(model)]]
    if camera.width is not None and camera.height is not None:
        size = np.array([camera.width, camera.height], dtype=np.float64)
        return -0.5 - MARGIN * size, size - 0.5 + MARGIN * size
    centre, half = model.image.centre, model.image.half * (1 + 2 * MARGIN)
    return np.asarray(centre - half), np.asarray(centre + half)


def _near_and_far(model: CameraModel, uv: Floats, middle: Floats, sides: Floats) -> Floats:
    """(n, 8) a near and a far point on the lines of sight of pixels (n, 2), before and behind the middle of the box,
    and the length of a pixel at both."""
    with np.errstate(all="ignore"):
        centre, directions = model.camera.lines(uv)
        towards = middle - centre
        distance = float(np.linalg.norm(towards))
        if np.nanmean(directions @ towards) < 0:  # a linear projection says nothing of the sign
            directions = -directions
        depth = 0.4 * float(np.abs(towards) @ sides) / max(distance, 1e-12)
        ends = (max(distance - depth, 0.4 * distance), distance + depth)
        (near, there), (far, beyond) = (_seen_there(model, uv, centre, directions, end) for end in ends)
        return np.column_stack([near, far, there, beyond])


def _seen_there(
    model: CameraModel, uv: Floats, centre: Floats, directions: Floats, far: float
) -> tuple[Floats, Floats]:
    """(n, 3) points at that distance that the camera with its field sees at the pixels; (n,) the length of a pixel."""
    start = centre + far * directions
    across = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    first = np.cross(directions, across)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    T = np.stack([first, np.cross(directions, first)], axis=2)  # (n, 3, 2)
    x = start.copy()
    for _ in range(STEPS):
        mean, slope = model.predict(x)
        J = slope @ T
        det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
        off = uv - mean
        a = (J[:, 1, 1] * off[:, 0] - J[:, 0, 1] * off[:, 1]) / det
        b = (J[:, 0, 0] * off[:, 1] - J[:, 1, 0] * off[:, 0]) / det
        x = x + T[:, :, 0] * a[:, None] + T[:, :, 1] * b[:, None]
    good = np.linalg.norm(x - start, axis=1) < MAX_MOVE * far
    return np.where(good[:, None], x, start), np.where(good, 1 / np.sqrt(np.abs(det)), np.nan)
