"""Which pixels are in a camera's picture, and how large that is."""

from __future__ import annotations

import numpy as np

from implicam.dataset.model import Observations
from implicam.geometry import Bools, Floats

UNKNOWN_SIZE_MARGIN_SHARE = 0.25
"""Where the size of a picture is not known, it is taken to reach beyond what was seen by this part of its extent."""


def are_on_image(observations: Observations, uv: Floats) -> Bools:
    """Which pixels are in the picture; where its size is not known, which are near those that were seen.

    Args:
        observations: The cameras, with their image sizes where known, and what they saw.
        uv: (n, cameras, 2) pixels.

    Returns:
        (n, cameras), false for NaN and for a camera of unknown size that saw nothing.
    """
    seen = np.zeros(uv.shape[:2], dtype=np.bool_)
    for c in range(len(observations.cameras)):
        bounds = image_bounds(observations, c)
        if bounds is not None:
            seen[:, c] = ((uv[:, c] >= bounds[0]) & (uv[:, c] <= bounds[1])).all(axis=1)
    return seen


def image_bounds(observations: Observations, c: int) -> tuple[Floats, Floats] | None:
    """Where the picture of a camera begins and ends; where its size is not known, about what was seen in it.

    Args:
        observations: The cameras, with their image sizes where known, and what they saw.
        c: The number of the camera.

    Returns:
        The lowest and the highest (u, v), each (2,); None for a camera of unknown size that saw nothing.
    """
    camera = observations.cameras[c]
    if camera.width is not None and camera.height is not None:
        return np.array([-0.5, -0.5]), np.array([camera.width, camera.height]) - 0.5
    if not observations.seen[:, c].any():
        return None
    pixels = observations.uv[observations.seen[:, c], c]
    margin = UNKNOWN_SIZE_MARGIN_SHARE * np.ptp(pixels, axis=0)
    return pixels.min(axis=0) - margin, pixels.max(axis=0) + margin
