"""Why a point was not measured, or not with all its views: a number for each, and words when they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Names
from implicam.geometry import Bools, Floats

Codes = NDArray[np.int8]


class Reason(IntEnum):
    """What became of a point."""

    MEASURED = 0
    NOT_SEEN = 1
    NOT_SEEN_BY_CALIBRATED = 2
    ONE_VIEW = 3
    CONTRADICTION = 4
    NO_POSITION = 5


WORDS = {
    Reason.MEASURED: "",
    Reason.NOT_SEEN: "no camera saw it",
    Reason.NOT_SEEN_BY_CALIBRATED: "no calibrated camera saw it",
    Reason.CONTRADICTION: "its views contradict each other: a wrong match in one of them",
    Reason.NO_POSITION: "no position explains its views: a wrong match, or a place that a camera cannot see",
}


def reason_codes(measured: Bools, p: Floats, usable: NDArray[np.int64], views: NDArray[np.int64]) -> Codes:
    """What became of n points.

    Args:
        measured: (n,) whether there is a position.
        p: (n,) that the views agree, NaN where it cannot be tested.
        usable: (n,) how many calibrated cameras saw it.
        views: (n,) how many cameras saw it.

    Returns:
        (n,) of `Reason`.
    """
    codes = np.where(np.isfinite(p), np.int8(Reason.CONTRADICTION), np.int8(Reason.NO_POSITION))
    codes[usable == 1] = Reason.ONE_VIEW
    codes[usable == 0] = Reason.NOT_SEEN_BY_CALIBRATED
    codes[views == 0] = Reason.NOT_SEEN
    codes[measured] = Reason.MEASURED
    return codes


def reasons_in_words(codes: Codes, seen: Bools, left_out: Bools, names: Sequence[str]) -> Names:
    """The reasons of n points.

    Args:
        codes: (n,) of `Reason`.
        seen: (n, C) the views that a point has.
        left_out: (n, C) the views that were not used.
        names: Of the C cameras.

    Returns:
        (n,) empty where a point was measured with all its views.
    """
    words = [WORDS.get(Reason(code), "") for code in range(len(Reason))]
    of = codes.astype(np.intp)
    for i in np.flatnonzero(codes == Reason.ONE_VIEW).tolist():
        of[i] = len(Reason) + int(np.argmax(seen[i]))
    words += [f"only {name} saw it; a position takes two cameras" for name in names]
    without = np.flatnonzero((codes == Reason.MEASURED) & left_out.any(axis=1))
    groups, number = np.unique(left_out[without], axis=0, return_inverse=True)
    of[without] = len(words) + number.reshape(-1)
    for group in groups:
        away = " and ".join(names[c] for c in np.flatnonzero(group).tolist())
        words.append(f"measured without {away}, whose view contradicts the others")
    used, number = np.unique(of, return_inverse=True)  # text is as wide as the longest that is there
    return np.array([words[k] for k in used], dtype=np.str_)[number]
