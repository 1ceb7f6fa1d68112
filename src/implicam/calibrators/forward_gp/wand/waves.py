"""What the cameras saw of a wand, as arrays: frames, two markers each, and the views of every camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.wand.known import NOTHING_KNOWN, KnownPlaces
from implicam.geometry import Bools, Floats
from implicam.rig_model import CameraViews, Image


@dataclass(frozen=True, eq=False)
class Waves:
    """A wand, seen in F frames; a single point is a frame with one marker, of which no length is known.

    Attributes:
        rows: (F, 2) of the two markers in the dataset; -1 for none.
        seen: Per camera what it saw: `rows` are numbers of places, 2 frame + marker.
        images: Where the pixels of each camera are measured from.
        stated: (C,) stated noise in pixels, NaN where none is.
        length: Of the wand.
        jitter: Sd of the length of one frame about that of all: flex, and centres of markers.
        ends: (F,) whether the two markers are the wand's ends.
        known: Places that are known, in a world of their own.
    """

    rows: NDArray[np.int64]
    seen: tuple[CameraViews, ...]
    images: tuple[Image, ...]
    stated: Floats
    length: float
    jitter: float
    ends: Bools
    known: KnownPlaces = NOTHING_KNOWN

    @property
    def frames(self) -> int:
        """Their number."""
        return len(self.rows)

    @cached_property
    def uv(self) -> Floats:
        """(2 F, C, 2) pixels of all places, NaN where not seen."""
        uv = np.full((2 * self.frames, len(self.seen), 2), np.nan)
        for c, seen in enumerate(self.seen):
            uv[seen.rows, c] = seen.uv
        return uv

    def usual_noise(self, c: int, usual_half_sides: float) -> float:
        """Of a camera, in pixels: what it states, or what is usual.

        Args:
            c: Its number.
            usual_half_sides: The usual noise, over half the longer side.
        """
        stated = float(self.stated[c])
        return stated if np.isfinite(stated) else usual_half_sides * self.images[c].half
