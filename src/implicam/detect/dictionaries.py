"""Sets of markers, by the names that OpenCV has for them."""

from __future__ import annotations

from typing import Any

from implicam.errors import UsageError, did_you_mean
from implicam.images import opencv


def check_dictionary(name: str) -> None:
    """Refuse a name that OpenCV does not know.

    Args:
        name: For example DICT_5X5_100.

    Raises:
        UsageError: There is no such dictionary.
    """
    known = [one for one in dir(opencv().aruco) if one.startswith("DICT_")]
    if name not in known:
        raise UsageError(
            f"there is no dictionary {name!r}{did_you_mean(name, known)}.",
            fix="use the name that OpenCV has for it, for example DICT_5X5_100 or DICT_APRILTAG_36h11",
        )


def dictionary_of(name: str) -> Any:
    """OpenCV's dictionary.

    Args:
        name: One that `check_dictionary` accepts.
    """
    aruco = opencv().aruco
    return aruco.getPredefinedDictionary(getattr(aruco, name))
