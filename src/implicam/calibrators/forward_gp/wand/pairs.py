"""Two cameras from what both saw of a wand: no focal length, lens or pose is given, eq. (V3).

A ladder of lenses turns pixels into rays; for every pair of rungs the eight-point algorithm (Longuet-Higgins 1981, in
coordinates of unit second moment as Hartley 1997 asks) finds the essential matrix, by random samples, for a part of the
views is wrong. Where lines of sight meet, the wand must be as long in one frame as in the other: of all rungs that
rank best by both, the adjustment decides.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.geometry import Bools, Floats, Pose
from implicam.lenses import PERSPECTIVE_K, KannalaBrandt
from implicam.rig_model import CentralCamera, Image

FOCALS_HALF_SIDES = np.geomspace(0.5, 8.0, 8)
"""Rungs of the ladder: focal lengths over half the longer side, from a fisheye to a telephoto lens."""

SAMPLES = 200
"""Random samples of eight points for each pair of rungs: where a third of the points is wrong, eight are clean."""

MIN_SHARED_POINTS, MIN_WHOLE_FRAMES = 16, 6
"""What two cameras must share to be started together: points, and frames in which both see both markers."""


class PairStart(NamedTuple):
    """Two cameras in the frame of the first, and how well they fit: px, the median distance from epipolar lines; spread
    of the wand's log length; inliers (n,) of the shared points."""

    cameras: tuple[CentralCamera, CentralCamera]
    px: float
    spread: float
    inliers: Bools

    @property
    def rank(self) -> float:
        """Small is good; noise in the pixels and in the length does not count as difference."""
        return float(np.log(self.px + 0.3) + np.log(self.spread + 0.003))


def pair_starts(
    uv: Floats,
    frame: NDArray[np.int64],
    marker: NDArray[np.int64],
    images: Sequence[Image],
    length: Floats,
    *,
    still: bool = False,
) -> list[PairStart]:
    """All rungs of both cameras, the best first.

    Args:
        uv: (n, 2, 2) pixels of n points in both cameras.
        frame: (n,) of each point.
        marker: (n,) 0 or 1, or -1 of a point that is no end of the wand.
        images: Of both cameras.
        length: (n,) of the wand in the frame of each point.
        still: No wand, but points and scale bars: these are ranked by epipolar lines alone, and without a bar the
            distance of the cameras is 1.

    Returns:
        Those whose lines of sight meet before both cameras.
    """
    n, rng = len(uv), np.random.default_rng(0)
    samples = np.argsort(rng.random((SAMPLES, n)), axis=1)[:, :8]
    more = rng.normal(size=(SAMPLES, 1, 9))
    ends = _whole_frames(frame, marker)
    found = []
    for focals, k, rays in _rungs(uv, images):
        E, px, inliers = _essential(rays, focals, samples, more)
        placed = _placed(E, rays, inliers, ends, length, 0 if still else MIN_WHOLE_FRAMES)
        if placed is None:
            continue
        pose, size, spread = placed
        poses = Pose(np.eye(3), np.zeros(3)), Pose(pose.rotation, pose.translation / size)
        cameras = tuple(
            CentralCamera(KannalaBrandt(f, f, *image.centre.tolist(), *k.tolist()), place)
            for f, image, place in zip(focals, images, poses, strict=True)
        )
        found.append(PairStart((cameras[0], cameras[1]), px, spread, inliers))
    return sorted(found, key=lambda start: start.rank)


def _rungs(uv: Floats, images: Sequence[Image]) -> Iterator[tuple[tuple[float, float], Floats, Floats]]:
    """Focal lengths, distortion, and unit rays (2, n, 3) of every pair of lenses of one kind."""
    for k in (np.zeros(4), PERSPECTIVE_K):
        each = []
        for c, image in enumerate(images):
            offset = (uv[:, c] - image.centre) / image.half / FOCALS_HALF_SIDES[:, None, None]
            radius = np.linalg.norm(offset, axis=2)
            theta = np.arctan(radius) if k.any() else np.minimum(radius, np.pi)
            across = offset * (np.sin(theta) / np.maximum(radius, 1e-12))[..., None]
            each.append(np.concatenate([across, np.cos(theta)[..., None]], axis=2))
        for i, one in enumerate(FOCALS_HALF_SIDES):
            for j, two in enumerate(FOCALS_HALF_SIDES):
                yield (float(one * images[0].half), float(two * images[1].half)), k, np.stack([each[0][i], each[1][j]])


def _whole_frames(frame: NDArray[np.int64], marker: NDArray[np.int64]) -> NDArray[np.int64]:
    """(m, 2) rows of both ends of the frames that have both."""
    first = {int(f): i for i, f in enumerate(frame) if marker[i] == 0}
    pairs = [(first[int(f)], i) for i, f in enumerate(frame) if marker[i] == 1 and int(f) in first]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _essential(
    rays: Floats, focals: tuple[float, float], samples: NDArray[np.int64], more: Floats
) -> tuple[Floats, float, Bools]:
    """The essential matrix that the most rays agree on: it, their median distance in pixels, and which they are."""
    to = [np.linalg.cholesky(np.linalg.inv(one.T @ one / len(one) + 1e-12 * np.eye(3))).T for one in rays]
    white = [one @ by.T for one, by in zip(rays, to, strict=True)]
    rows = (white[1][:, :, None] * white[0][:, None, :]).reshape(-1, 9)
    A = np.concatenate([rows[samples], more], axis=1)
    try:
        e = np.linalg.solve(A, np.eye(9)[8][:, None])[..., 0]
    except np.linalg.LinAlgError:  # two points in one place
        e = np.linalg.solve(A + 1e-9 * np.eye(9), np.eye(9)[8][:, None])[..., 0]
    E = to[1].T @ e.reshape(-1, 3, 3) @ to[0]
    distance = _distance(E, rays, focals)
    median = np.median(distance, axis=1)
    best = int(np.argmin(np.where(np.isfinite(median), median, np.inf)))
    off = distance[best]
    for _ in range(4):
        inliers = off <= 2.5 * np.median(off)
        _, vectors = np.linalg.eigh(rows[inliers].T @ rows[inliers])
        E1 = to[1].T @ vectors[:, 0].reshape(3, 3) @ to[0]
        off = _distance(E1[None], rays, focals)[0]
    inliers = off <= 2.5 * np.median(off)
    return E1, float(np.median(off)), inliers


def _distance(E: Floats, rays: Floats, focals: tuple[float, float]) -> Floats:
    """(k, n) of rays from the epipolar planes of matrices (k, 3, 3), in pixels: Sampson's."""
    forth, back = rays[0] @ E.swapaxes(1, 2), rays[1] @ E  # (k, n, 3)
    off = np.einsum("kni,ni->kn", forth, rays[1])
    scale = np.sqrt(np.sum(forth**2, axis=2) / focals[1] ** 2 + np.sum(back**2, axis=2) / focals[0] ** 2)
    return np.asarray(np.abs(off) / np.maximum(scale, 1e-300), dtype=np.float64)


def _placed(
    E: Floats, rays: Floats, inliers: Bools, ends: NDArray[np.int64], length: Floats, least: int
) -> tuple[Pose, float, float] | None:
    """The second camera from the first of the four poses of an essential matrix (Hartley & Zisserman, section 9.6.2),
    the wand as measured with a base of 1 over its length, and the spread of its logarithm."""
    whole = ends[inliers[ends].all(axis=1)]
    if len(whole) < least:
        return None
    U, _, Vt = np.linalg.svd(E)
    U, Vt = U * np.sign(np.linalg.det(U)), Vt * np.sign(np.linalg.det(Vt))
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    best: tuple[int, Pose, Floats] | None = None
    for R in (U @ W @ Vt, U @ W.T @ Vt):
        for t in (U[:, 2], -U[:, 2]):
            x, before = meet_two(rays, Pose(R, t))
            count = int((before & inliers).sum())
            if best is None or count > best[0]:
                best = count, Pose(R, t), x
    assert best is not None
    count, pose, x = best
    if count < 0.6 * inliers.sum():
        return None
    size = np.linalg.norm(x[whole[:, 1]] - x[whole[:, 0]], axis=1) / length[whole[:, 0]]
    log = np.log(np.maximum(size[np.isfinite(size)], 1e-12))
    if len(log) < least:
        return None
    middle = float(np.median(log)) if len(log) else 0.0
    if len(log) < MIN_WHOLE_FRAMES:
        return pose, float(np.exp(middle)), 1.0
    return pose, float(np.exp(middle)), float(1.4826 * np.median(np.abs(log - middle)))


def meet_two(rays: Floats, second: Pose) -> tuple[Floats, Bools]:
    """Where the lines of sight of two cameras meet, in the frame of the first.

    Args:
        rays: (2, n, 3) unit vectors in the cameras' own frames.
        second: Pose of the second from the first.

    Returns:
        (n, 3) the middle of their common perpendicular, and (n,) whether it lies ahead on both.
    """
    a, b = rays[0], rays[1] @ second.rotation
    centre = second.centre
    ab = np.sum(a * b, axis=1)
    det = np.maximum(1 - ab**2, 1e-15)
    ca, cb = a @ centre, b @ centre
    s, t = (ca - ab * cb) / det, (ab * ca - cb) / det
    return 0.5 * (s[:, None] * a + centre + t[:, None] * b), np.asarray((s > 0) & (t > 0))
