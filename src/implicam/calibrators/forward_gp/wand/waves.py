"""What the cameras saw of a wand, as arrays: frames, two markers each, and the views of every camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.wand.bundle import Lengths
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
        lengths: (F,) between the two markers.
        jitter: (F,) sd of that: flex, and centres of markers; of a scale bar, its standard uncertainty.
        ends: (F,) whether the two markers are the wand's ends, or those of a scale bar.
        exchanged: (F, C) where the names of the ends were exchanged, and are put right in `seen`.
        names: (C,) of the cameras; frame_names (F,).
        known: Places that are known, in a world of their own.
        still: Points and scale bars that lie still, and no wand: the fewest lengths do, and none says what a lens is.
    """

    rows: NDArray[np.int64]
    seen: tuple[CameraViews, ...]
    images: tuple[Image, ...]
    stated: Floats
    lengths: Floats
    jitter: Floats
    ends: Bools
    exchanged: Bools
    names: tuple[str, ...]
    frame_names: tuple[str, ...]
    known: KnownPlaces = NOTHING_KNOWN
    still: bool = False

    def lengths_of(self, frames: NDArray[np.int64], relative_sd: float = 0.0) -> Lengths:
        """Of some frames.

        Args:
            frames: Their numbers.
            relative_sd: Their sd at least, over the length.
        """
        length = self.lengths[frames]
        return Lengths(frames, length, np.maximum(self.jitter[frames], relative_sd * length))

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

    @cached_property
    def whole_views(self) -> Bools:
        """(F, C) which cameras see both ends."""
        both = np.isfinite(self.uv[..., 0]).reshape(self.frames, 2, -1).all(axis=1)
        return np.asarray(both & self.ends[:, None])

    def with_exchanged(self, wrong: Bools) -> Waves:
        """With the names of both ends exchanged.

        Args:
            wrong: (F, C) in which pictures.
        """
        seen = []
        for c, views in enumerate(self.seen):
            rows = np.where(wrong[views.rows // 2, c], views.rows ^ 1, views.rows)
            order = np.argsort(rows)
            seen.append(CameraViews(rows[order], views.uv[order], views.relative[order]))
        return replace(self, seen=tuple(seen), exchanged=self.exchanged ^ wrong)

    def all_exchanged(self, c: int) -> Waves:
        """With the names of both ends exchanged in all frames of a camera.

        Args:
            c: Its number.
        """
        wrong = np.zeros((self.frames, len(self.seen)), dtype=np.bool_)
        wrong[:, c] = self.ends
        return self.with_exchanged(wrong)

    @cached_property
    def _number(self) -> Floats | None:
        """(F,) of the frames; None where their names are no numbers."""
        try:
            return np.array([float(name) for name in self.frame_names])
        except ValueError:
            return None

    def shifted(self, c: int, late: float) -> Waves | None:
        """With what a camera would have seen if its pictures had not been late.

        Args:
            c: Its number.
            late: By so many frames; what is between two frames is interpolated.

        Returns:
            The same of all other cameras; None where frames have no numbers.
        """
        if self._number is None:
            return None
        at = {
            (number, single): i for i, (number, single) in enumerate(zip(self._number.tolist(), self.ends, strict=True))
        }
        below = np.floor(-late)
        part = -late - below
        uv = self.uv[:, c].reshape(-1, 2, 2)
        there = np.full_like(uv, np.nan)
        for i, number in enumerate(self._number.tolist()):
            one, two = at.get((number + below, self.ends[i])), at.get((number + below + 1, self.ends[i]))
            if one is not None and (two is not None or part == 0):
                there[i] = uv[one] if part == 0 else (1 - part) * uv[one] + part * uv[two]
        rows = np.flatnonzero(np.isfinite(there.reshape(-1, 2)).all(axis=1))
        moved = CameraViews(rows, there.reshape(-1, 2)[rows], np.ones(len(rows)))
        return replace(self, seen=tuple(moved if k == c else views for k, views in enumerate(self.seen)))

    def usual_noise(self, c: int, usual_half_sides: float) -> float:
        """Of a camera, in pixels: what it states, or what is usual.

        Args:
            c: Its number.
            usual_half_sides: The usual noise, over half the longer side.
        """
        stated = float(self.stated[c])
        return stated if np.isfinite(stated) else usual_half_sides * self.images[c].half
