"""Pixels that are marks for "not seen": (-1, -1), (0, 0), or one and the same pixel over and over.

Missing is NaN, never zero, never (-1, -1); yet tables of other programs have such marks, and taken as pixels they spoil
a calibration without a word. What is read is cleaned here, and the dataset says what was a mark and how often.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.model import Dataset, Floats, Observations

MARKS = ((-1.0, -1.0), (0.0, 0.0))
"""No detector finds a centre exactly there, and many write it where they found none."""

REPEATS = 5
"""So many different places at one pixel, to the last bit, are none."""

SHARE = 0.02
"""The least share of all views that a repeated pixel must have: whole-number pixels coincide now and then."""


def without_marks(data: Dataset) -> Dataset:
    """The same with marks as missing views and a note on them; the dataset itself where there is none."""
    observations = data.observations
    places = None if data.known is None else data.known.xyz
    found = {pixel: _at(observations.uv, pixel) for pixel in (*MARKS, *_repeated(observations, places))}
    notes = [_note(observations, pixel, there) for pixel, there in found.items() if there.any()]
    if not notes:
        return data
    marked = np.any(list(found.values()), axis=0)
    uv = np.where(marked[..., None], np.nan, observations.uv)
    extra = {key: np.where(marked, "", text) for key, text in observations.extra.items()}  # of a view that is none
    cleaned = replace(observations, uv=uv, extra=extra)
    return replace(data, observations=cleaned, notes=(*data.notes, *notes))


def _at(uv: Floats, pixel: tuple[float, float]) -> NDArray[np.bool_]:
    return np.asarray((uv == np.array(pixel)).all(axis=2), dtype=np.bool_)


def _repeated(observations: Observations, places: Floats | None) -> list[tuple[float, float]]:
    """Pixels that stand for many places: known to be different ones, or seen to be by the other cameras."""
    counts = Counter(map(tuple, observations.uv[observations.seen].tolist()))
    least = max(REPEATS, SHARE * sum(counts.values()))
    often = [pixel for pixel, times in counts.items() if times >= least and pixel not in MARKS]
    return [(u, v) for u, v in often if _stands_for_many(observations, places, (u, v))]


def _stands_for_many(observations: Observations, places: Floats | None, pixel: tuple[float, float]) -> bool:
    there = _at(observations.uv, pixel)
    rows = there.any(axis=1)
    if places is not None:
        return len(np.unique(places[rows], axis=0)) >= REPEATS
    # nobody knows where the points are: one at rest has one pixel in every camera, so only an odd one is a mark
    u, v = pixel
    others = np.where(there[..., None], np.nan, observations.uv)[rows]
    odd = u < 0 or v < 0 or u == v
    return odd and len(np.unique(others.reshape(len(others), -1), axis=0)) >= REPEATS


def _note(observations: Observations, pixel: tuple[float, float], there: NDArray[np.bool_]) -> str:
    names = np.array(observations.camera_names)[there.any(axis=0)]
    where = ", ".join(map(str, names[:4])) + (f" and {len(names) - 4} more cameras" if len(names) > 4 else "")
    return (
        f"The pixel ({pixel[0]:g}, {pixel[1]:g}) is there {there.sum()} times ({where}): a mark for a view that is "
        "missing, and taken as such."
    )
