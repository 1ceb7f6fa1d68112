"""A target in the live pictures of a camera: near its last place first, and in the whole picture when it is lost.

What is found near is accepted by the same tests as in the whole picture. They take a thing that looks like a ball for
one where the ball itself is hidden. When the ball is back the whole picture tells; looking near would stay with that
thing. So only what has moved or come is followed: what an earlier picture does not show at its place, because cameras
stand still and such things do too. Every few pictures the whole is searched anyway. And nothing that is kept is found
this way: a picture that is measured is searched as a whole.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats
from implicam.detect.model import Detected, Detector, View
from implicam.images import Grey

WHOLE_EVERY = 10
"""Pictures from one that is searched as a whole to the next, at most."""

MOVED_PX, ELSEWHERE_RADII, PLACES = 2.0, 2.5, 3
"""What is so many pixels from where it was has moved; what is so many of its radii away is at another place; pictures
of so many places are kept."""


@runtime_checkable
class LooksNear(Protocol):
    """A detector that can look around the place where its target was."""

    def detect_near(self, picture: Grey, view: View, last: Detected) -> Detected | None:
        """What is there.

        Args:
            picture: (height, width) grey from 0 to 1.
            view: Which picture it is.
            last: What was found in the picture before, one point with its `radius_px` among the notes.

        Returns:
            One point; None where the whole picture has to be searched.
        """

    def was_there(self, earlier: NDArray[Any], picture: Grey, found: Detected) -> bool:
        """Whether an earlier picture shows the same thing at the same place.

        Args:
            earlier: (height, width) grey, of any unit.
            picture: (height, width) grey.
            found: In `picture`.
        """


class _Seen(NamedTuple):
    """A picture in 256 steps, a quarter of the memory; and where the target was found in it, (2,)."""

    picture: NDArray[np.uint8]
    uv: Floats


class Follower:
    """Follows the target of one camera; of a detector that does not look near, it does nothing.

    detector: what to look for. number: of the camera, so that not all search the whole picture at the same time.
    """

    def __init__(self, detector: Detector, number: int = 0) -> None:
        self._detector = detector if isinstance(detector, LooksNear) else None
        self._last: Detected | None = None  # what is followed
        self._before: Detected | None = None  # what was found in the picture before, followed or not
        self._seen: list[_Seen] = []  # the last places
        self._pictures = number % WHOLE_EVERY  # since the whole was searched

    def near(self, picture: Grey, view: View) -> Detected | None:
        """The target near its last place; None where the whole picture is to be searched.

        Args:
            picture: (height, width) grey from 0 to 1.
            view: Which picture it is.
        """
        self._pictures += 1
        if self._detector is None or self._last is None or self._pictures >= WHOLE_EVERY:
            return None
        found = self._detector.detect_near(picture, view, self._last)
        if found is None or not self._is_it(picture, found):
            return None
        self._last = self._before = found
        return found

    def found(self, picture: Grey, whole: Detected) -> Detected:
        """Remember what was found in the whole picture.

        Args:
            picture: (height, width) grey from 0 to 1.
            whole: As `Detector.detect` gave it.

        Returns:
            The same.
        """
        if self._pictures >= WHOLE_EVERY:
            self._pictures = 0
        if self._detector is None or len(whole) != 1:
            self._last = self._before = None
            return whole
        self._last, self._before = whole if self._is_it(picture, whole) else None, whole
        if not any(not _is_elsewhere(whole, seen) for seen in self._seen):
            self._seen = [*self._seen[1 - PLACES :], _Seen((picture * 255).astype(np.uint8), whole.uv[0])]
        return whole

    def _is_it(self, picture: Grey, found: Detected) -> bool:
        """Whether it is what was followed, or has moved, or was not there when the target was elsewhere."""
        assert self._detector is not None
        if self._before is not None:
            way = _apart(found, self._before.uv[0])
            same = way < float(found.notes["radius_px"])  # two things of one size are further apart
            if same and (self._last is not None or way > MOVED_PX):
                return True
        other = next((seen for seen in reversed(self._seen) if _is_elsewhere(found, seen)), None)
        return (
            other is not None
            and other.picture.shape == picture.shape
            and not self._detector.was_there(other.picture, picture, found)
        )


def _is_elsewhere(found: Detected, seen: _Seen) -> bool:
    return _apart(found, seen.uv) > ELSEWHERE_RADII * float(found.notes["radius_px"])


def _apart(found: Detected, uv: Floats) -> float:
    return float(np.linalg.norm(found.uv[0] - uv))
