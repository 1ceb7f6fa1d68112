"""The corners of a board whose markers say which is which: fitted as those of a checkerboard, and judged together."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats
from implicam.dataset.boards import corner_name
from implicam.detect.board import explain_missing, hull_of
from implicam.detect.corner_noise import agreeing, true_sd
from implicam.detect.corners import Bools, Corners, fit_corners
from implicam.detect.dictionaries import dictionary_of
from implicam.detect.grid import MAX_ASTRAY_SQUARES, MAX_RESIDUAL_HEIGHTS, Places, predict_places
from implicam.detect.model import Detected, nothing
from implicam.images import Grey, eight_bit, opencv

MIN_MIRRORED = 4
"""Markers in the mirror image of a picture without any, from which it is mirrored."""

MIN_CORNERS = 6
"""Corners from which their neighbourhood can be checked."""


def fit_marked_corners(
    picture: Grey,
    nodes: Floats,
    start: Floats,
    parity: NDArray[np.intp],
    *,
    reach: float = 1.5,
    bare: float = 1.0,
    rounds: int = 20,
) -> tuple[Corners, Bools]:
    """Fit the corners that the markers place, and those of whose neighbours they do.

    Args:
        picture: (height, width) grey from 0 to 1.
        nodes: (n, 2) row and column of all corners on the board; about a corner nothing else is printed within 1.
        start: (n, 2) pixels where the markers put them, NaN where they do not.
        parity: (n,) even where the corner is bright right below and right of it, or dark there, odd where not.
        reach: How far, in rows or columns, a corner may be from one that is known, to be looked for.
        bare: As `fit_corners` takes it.
        rounds: Times that neighbours are added, at most.

    Returns:
        The corners; and (n,) which of them are clear and where the others put them.
    """
    there = np.isfinite(start[:, 0])
    corners = Corners.unknown(len(nodes))
    for _ in range(rounds):
        before = there
        if there.sum() < MIN_CORNERS:
            break
        places = predict_places(nodes[there], start[there], nodes)
        near = np.linalg.norm(nodes[:, None] - nodes[there], axis=2).min(axis=1) < reach
        start = np.where(near[:, None] & ~there[:, None], places.uv, start)
        corners = fit_corners(picture, start, places.right, places.down, bare=bare)
        there = _find_sound(corners, parity)
        there &= _find_in_place(corners, nodes, there)
        start = np.where(there[:, None], corners.uv, np.nan)
        if (there == before).all():
            break
    return corners, there


def report_corners(
    corners: Corners, there: Bools, nodes: Floats, half_length: float, shot: str, too_few: Callable[[int], str]
) -> Detected:
    """The corners of a board with their true uncertainty, without those that the others contradict.

    Args:
        corners: (n,) all corners of the board.
        there: (n,) which of them were found.
        nodes: (n, 2) row and column of each, in the unit of the length.
        half_length: Half the longer side of the board.
        shot: Corners are named after it.
        too_few: Why nothing is given where so many are too few.

    Returns:
        The corners in the order of their numbers, or the reason why they cannot be given.
    """
    number = np.flatnonzero(there)
    if len(number) >= MIN_CORNERS:
        number = number[agreeing(nodes[number], corners[number], half_length)]
    if len(number) < MIN_CORNERS:
        return nothing(too_few(len(number)))
    return Detected(
        tuple(corner_name(shot, int(j)) for j in number),
        corners.uv[number],
        true_sd(nodes[number], corners[number], half_length),
        explain_missing(len(number), len(nodes)),
        (hull_of(corners.uv[number]),),
    )


def explain_mirrored(picture: Grey, dictionary: str, border: int, own: range) -> str:
    """That a picture is mirrored in which no marker was read, in words; empty where its mirror image shows none either.

    Args:
        picture: (height, width) grey from 0 to 1.
        dictionary: OpenCV's name of the markers.
        border: Bits that their black border is wide.
        own: Numbers of the board's markers.
    """
    how = opencv().aruco.DetectorParameters()
    how.markerBorderBits = border
    reader = opencv().aruco.ArucoDetector(dictionary_of(dictionary), how)
    _, ids, _ = reader.detectMarkers(np.ascontiguousarray(eight_bit(picture)[:, ::-1]))
    count = 0 if ids is None else sum(number in own for number in ids.ravel().tolist())
    if count < MIN_MIRRORED:
        return ""
    return (
        f"the picture is mirrored: no marker was read in it, and {count} in its mirror image. Turn mirroring off where "
        "the camera is set up, or flip the pictures back."
    )


def in_squares(off: Floats, places: Places) -> Floats:
    """Differences in pixels as parts of the steps right and down there.

    Args:
        off: (n, 2) pixels.
        places: Where they are.
    """
    steps = np.stack([places.right, places.down], axis=2)
    return np.asarray(np.einsum("nij,nj->ni", np.linalg.pinv(steps), off), dtype=np.float64)


def _find_sound(corners: Corners, parity: NDArray[np.intp]) -> Bools:
    """Which corners (n,) look like corners: little left over, and bright and dark in turn as their neighbours."""
    with np.errstate(invalid="ignore"):
        good = (corners.misfit < MAX_RESIDUAL_HEIGHTS) & np.isfinite(corners.uv).all(axis=1)
        signed = corners.height * (1 - 2 * (parity % 2))
        if good.any():
            middle = np.median(signed[good])
            good &= signed * np.sign(middle) > 0.3 * abs(middle)
    return np.asarray(good, dtype=np.bool_)


def _find_in_place(corners: Corners, nodes: Floats, there: Bools) -> Bools:
    """Which corners (n,) are where those that are `there` say; their own say left out."""
    if there.sum() < MIN_CORNERS:
        return np.zeros_like(there)
    places = predict_places(nodes[there], corners.uv[there], nodes)
    with np.errstate(invalid="ignore"):
        off = np.abs(in_squares(corners.uv - places.uv, places)).max(axis=1)
    return np.asarray(off < MAX_ASTRAY_SQUARES / 2, dtype=np.bool_)
