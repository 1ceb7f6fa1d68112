"""Pixels that are marks for "not seen": (-1, -1), (0, 0), or one and the same pixel over and over.

Here a missing view is NaN, never zero and never (-1, -1). Tables of other programs have such marks, and read as pixels
they would spoil a calibration silently. So they are removed here, and the dataset's notes say which marks and how many.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.model import Dataset, Floats, Observations

MISSING_VIEW_PIXELS = ((-1.0, -1.0), (0.0, 0.0))
"""No detector finds a centre exactly there, and many write it where they found none."""

MIN_PLACES_AT_ONE_PIXEL = 5
"""Different positions at one pixel, to the last bit, from which on the pixel is a mark."""

MIN_REPEATED_SHARE = 0.02
"""The least share of all views that a repeated pixel must have: whole-number pixels coincide now and then."""


def remove_marks(data: Dataset) -> Dataset:
    """Read marks, such as (-1, -1), as missing views.

    Args:
        data: The dataset as the file has it.

    Returns:
        The dataset with a note on each mark; the same dataset where there are none.
    """
    observations = data.observations
    places = None if data.known is None else data.known.xyz
    pixels = (*MISSING_VIEW_PIXELS, *_find_repeated(observations, places))
    found = {pixel: _find_pixel(observations.uv, pixel) for pixel in pixels}
    notes = [_describe_mark(observations, pixel, marked) for pixel, marked in found.items() if marked.any()]
    if not notes:
        return data
    marked = np.any(list(found.values()), axis=0)
    uv = np.where(marked[..., None], np.nan, observations.uv)
    extra = {key: np.where(marked, "", text) for key, text in observations.extra.items()}  # of removed views
    cleaned = replace(observations, uv=uv, extra=extra)
    return replace(data, observations=cleaned, notes=(*data.notes, *notes))


def _find_pixel(uv: Floats, pixel: tuple[float, float]) -> NDArray[np.bool_]:
    return np.asarray((uv == np.array(pixel)).all(axis=2), dtype=np.bool_)


def _find_repeated(observations: Observations, places: Floats | None) -> list[tuple[float, float]]:
    """Pixels that stand for many places: known to be different ones, or seen to be by the other cameras."""
    counts = Counter(map(tuple, observations.uv[observations.seen].tolist()))
    least = max(MIN_PLACES_AT_ONE_PIXEL, MIN_REPEATED_SHARE * sum(counts.values()))
    often = [pixel for pixel, times in counts.items() if times >= least and pixel not in MISSING_VIEW_PIXELS]
    return [(u, v) for u, v in often if _stands_for_many(observations, places, (u, v))]


def _stands_for_many(observations: Observations, places: Floats | None, pixel: tuple[float, float]) -> bool:
    repeated = _find_pixel(observations.uv, pixel)
    rows = repeated.any(axis=1)
    if places is not None:
        return len(np.unique(places[rows], axis=0)) >= MIN_PLACES_AT_ONE_PIXEL
    # positions unknown: a point at rest has one pixel in every camera, so only a negative pixel or u = v is a mark
    u, v = pixel
    others = np.where(repeated[..., None], np.nan, observations.uv)[rows]
    odd = u < 0 or v < 0 or u == v
    return odd and len(np.unique(others.reshape(len(others), -1), axis=0)) >= MIN_PLACES_AT_ONE_PIXEL


def _describe_mark(observations: Observations, pixel: tuple[float, float], marked: NDArray[np.bool_]) -> str:
    names = np.array(observations.camera_names)[marked.any(axis=0)]
    where = ", ".join(map(str, names[:4])) + (f" and {len(names) - 4} more cameras" if len(names) > 4 else "")
    return (
        f"The pixel ({pixel[0]:g}, {pixel[1]:g}) occurs {marked.sum()} times ({where}): a mark for a view that is "
        "missing, and taken as such."
    )
