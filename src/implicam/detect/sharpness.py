"""How sharp the edges of a board are in a picture: out of focus, or moved while it was exposed."""

from __future__ import annotations

import numpy as np

from implicam.dataset import Floats
from implicam.detect.grid import sample_bilinear
from implicam.images import Grey

MAX_EDGES = 40
"""Edges that are looked at."""

HALF_LENGTH_PX, STEPS_PER_PX = 8, 4
"""Of the line across an edge along which the picture is sampled."""


def edge_width(picture: Grey, corners: Floats, uv: Floats) -> float:
    """How many pixels it takes from black to white across the edges between neighbouring corners of a board.

    A perfect lens and sensor leave about 1.5; an edge that is blurred by a normal distribution of sd s takes 2.5 s.

    Args:
        picture: (height, width) grey.
        corners: (n, 2) or (n, 3) corners on the board.
        uv: (n, 2) their pixels.

    Returns:
        The 80 % quantile over the edges, because what moves along an edge does not blur it; NaN for fewer than two
        corners.
    """
    if len(corners) < 2:
        return float("nan")
    apart = np.linalg.norm(corners[:, None] - corners[None], axis=2) + 1e12 * np.eye(len(corners))
    first, second = np.nonzero(np.triu(apart < 1.01 * apart.min()))
    chosen = np.unique(np.linspace(0, len(first) - 1, MAX_EDGES).astype(int))
    a, b = uv[first[chosen]], uv[second[chosen]]
    along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    across = np.column_stack([-along[:, 1], along[:, 0]])
    reach = np.minimum(HALF_LENGTH_PX, 0.3 * np.linalg.norm(b - a, axis=1))
    count = 2 * HALF_LENGTH_PX * STEPS_PER_PX + 1
    at = np.linspace(-1, 1, count)[None, :] * reach[:, None]
    places = ((a + b) / 2)[:, None] + at[..., None] * across[:, None]
    value = sample_bilinear(picture, places.reshape(-1, 2)).reshape(at.shape)
    low, high = np.floor(uv.min(axis=0)).astype(int), np.ceil(uv.max(axis=0)).astype(int) + 1
    inside = picture[max(low[1], 0) : high[1], max(low[0], 0) : high[0]]
    contrast = float(np.subtract(*np.quantile(inside[::2, ::2], (0.9, 0.1)))) if inside.size else 0.0
    slope = np.nanmax(np.abs(np.gradient(value, axis=1)) / np.gradient(at, axis=1), axis=1, initial=0.0)
    widths = contrast / np.maximum(slope, 1e-6)
    return float(np.quantile(widths, 0.8))
