"""Find rows and cameras that occur more than once under different names, the same to the last bit.

This happens when files are joined twice, or a camera is exported under two names. A copy carries no information, so it
must not count as evidence: a fit would estimate a noise that is too small, and a held-out fold would hold known points.

Points are copies where the known position is the same and so are all pixels, in two cameras or more. With whole-number
pixels a point that was measured twice at rest may look like that: it adds nothing either. One camera alone proves
nothing, unless the table has copies that do. Cameras are copies where all views that both have are the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.model import Dataset, Floats, Observations, find_first_equal

Integers = NDArray[np.int64]

MIN_COMMON_VIEWS = 5
"""Views that two cameras must have in common, with the same pixels and not all at one, to be one camera."""

MAX_COPIES_NAMED = 3
"""Copies that a note names one by one."""


@dataclass(frozen=True, eq=False)
class Copies:
    """point_of (n,), camera_of (C,): the number of the first that is the same; its own where there is none before."""

    point_of: Integers
    camera_of: Integers

    @property
    def points(self) -> NDArray[np.bool_]:
        """(n,) which points are copies of others."""
        return np.asarray(self.point_of != np.arange(len(self.point_of)), dtype=np.bool_)

    @property
    def cameras(self) -> NDArray[np.bool_]:
        """(C,) which cameras are copies of others."""
        return np.asarray(self.camera_of != np.arange(len(self.camera_of)), dtype=np.bool_)


def find_copies(data: Dataset) -> Copies:
    """Which points and cameras are copies of others; points only where their positions are known.

    Args:
        data: n points, C cameras.
    """
    n, cameras = len(data), len(data.cameras)
    camera_of = _find_camera_copies(data.observations)
    if data.known is None:
        return Copies(np.arange(n), camera_of)
    own = np.flatnonzero(camera_of == np.arange(cameras))
    observations = data.observations
    views = observations.seen[:, own].sum(axis=1)
    pixels = observations.uv[:, own].reshape(n, 2 * len(own))
    point_of = find_first_equal(np.concatenate([pixels, data.known.xyz], axis=1))
    certain = (views >= 2) & (point_of != np.arange(n))
    copied = (views >= 1) if certain.any() else certain
    return Copies(np.where(copied, point_of, np.arange(n)), camera_of)


def _find_camera_copies(observations: Observations) -> Integers:
    uv, seen = observations.uv, observations.seen
    found = np.arange(seen.shape[1])
    order = np.argsort(-seen.sum(axis=0), kind="stable")  # the one that saw the most stays
    for later, c in enumerate(order):
        for original in order[:later]:
            if found[original] == original and _are_same(uv[:, c], uv[:, original], seen[:, c] & seen[:, original]):
                found[c] = original
                break
    return found


def _are_same(a: Floats, b: Floats, both: NDArray[np.bool_]) -> bool:
    if both.sum() < MIN_COMMON_VIEWS or (a[both] != b[both]).any():
        return False
    return len(np.unique(a[both], axis=0)) >= MIN_COMMON_VIEWS - 2


def remove_copies(data: Dataset, *, cameras_too: bool = False) -> Dataset:
    """The dataset with each point and camera once; the same dataset where nothing is a copy.

    Args:
        data: The dataset.
        cameras_too: Whether a copied camera is left out; else it stays, without views.
    """
    copies = find_copies(data)
    if copies.points.any():
        data = data.select(~copies.points)
    if not copies.cameras.any():
        return data
    observations = data.observations
    if cameras_too:
        names = np.array(observations.camera_names)[~copies.cameras]
        return data.with_cameras([str(name) for name in names])
    blank = np.where(copies.cameras[None, :, None], np.nan, observations.uv)
    return replace(data, observations=replace(observations, uv=blank))


def describe_copies(data: Dataset) -> list[str]:
    """What occurs more than once, in sentences for the user.

    Args:
        data: The dataset.

    Returns:
        One note for each copied camera, then one for all copied points; none where nothing is a copy.
    """
    copies, notes = find_copies(data), list[str]()
    names = data.observations.camera_names
    notes += [f"{names[c]} is not used: {explain_copy(data, int(c), copies)}." for c in np.flatnonzero(copies.cameras)]
    extra = np.flatnonzero(copies.points)
    if len(extra):
        some = ", ".join(f"{data.points[i]} of {data.points[copies.point_of[i]]}" for i in extra[:MAX_COPIES_NAMED])
        more = f" and {len(extra) - MAX_COPIES_NAMED} more" if len(extra) > MAX_COPIES_NAMED else ""
        notes.append(
            f"{len(extra)} of {len(data)} known points are copies of others, the same pixels at the same position to "
            f"the last bit ({some}{more}): each is used once. Were files joined twice?"
        )
    return notes


def explain_copy(data: Dataset, c: int, copies: Copies) -> str:
    """Why a copied camera is not used, in words.

    Args:
        data: The dataset.
        c: Number of the camera.
        copies: Of the same dataset.
    """
    original = data.observations.camera_names[copies.camera_of[c]]
    return f"its pixels are those of {original} to the last bit, so the two are one camera"
