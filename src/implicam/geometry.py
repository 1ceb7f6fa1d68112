"""Poses, rigid registration, one camera from known points, and points from several cameras.

A pose turns coordinates of one frame into another: `camera_from_world.apply(xyz)`, and
`camera_from_board = camera_from_world @ world_from_board`: the inner names cancel. Lengths are in whatever unit the
points use. A camera matrix P (3, 4) is `pixel_from_world`: w (u, v, 1) = P (x, y, z, 1), with w > 0 in front of the
camera. Chapters and algorithms: Hartley & Zisserman, Multiple View Geometry, 2nd edition.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from implicam.errors import FitError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

FLAT = 1e-3
"""Points whose extent in one direction is less than this part of the largest are taken as flat (or a line)."""

FEWEST = 6
"""Known points that fix the 11 numbers of a camera matrix."""

ENOUGH = 300
"""Points beyond which a rough resection gains nothing."""

UNDETERMINED = 1e-14
"""The second-smallest eigenvalue, as a part of the largest, below which the null space is not one vector."""

PINHOLE_TO = 1.2
"""Radians off the axis beyond which no lens is a pinhole."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A rigid motion `x_to = rotation x_from + translation`; rotation (3, 3), translation (3,)."""

    rotation: Floats
    translation: Floats

    def __post_init__(self) -> None:
        for name, shape in (("rotation", (3, 3)), ("translation", (3,))):
            array = np.array(getattr(self, name), dtype=np.float64).reshape(shape)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def apply(self, points: Floats) -> Floats:
        """Points (..., 3) of the one frame in the other."""
        return points @ self.rotation.T + self.translation

    def inverse(self) -> Pose:
        """`world_from_camera` of `camera_from_world`."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: Pose) -> Pose:
        """`a_from_b @ b_from_c` is `a_from_c`."""
        return Pose(self.rotation @ other.rotation, self.apply(other.translation))

    @property
    def centre(self) -> Floats:
        """(3,) the origin of the first-named frame in the second: of `camera_from_world`, where the camera is."""
        return self.inverse().translation


def look_at(centre: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Pose:
    """`camera_from_world` of a camera at `centre` that looks at `target`, the image's up side towards `up`."""
    forward = _unit(np.subtract(target, centre))
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) < 1e-9 * np.linalg.norm(up):  # straight up or down: any sideways will do
        right = np.cross(forward, np.roll(np.asarray(up, dtype=np.float64), 1))
    right = _unit(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Pose(rotation, -rotation @ np.asarray(centre, dtype=np.float64))


def rotation_from_vector(vector: ArrayLike) -> Floats:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3): axis times angle in radians (OpenCV's rvec)."""
    return np.asarray(Rotation.from_rotvec(np.asarray(vector, dtype=np.float64)).as_matrix(), dtype=np.float64)


def vector_from_rotation(rotation: ArrayLike) -> Floats:
    """Rotation vectors (..., 3) of rotation matrices (..., 3, 3)."""
    return np.asarray(Rotation.from_matrix(np.asarray(rotation, dtype=np.float64)).as_rotvec(), dtype=np.float64)


def register(source: Floats, target: Floats) -> tuple[Pose, float]:
    """`target_from_source` that brings points (n, 3) onto their partners with least squares, and the rms distance left.

    Pairs with a NaN are left out. Kabsch 1976, with Umeyama's 1991 guard against a mirror image. FitError for fewer
    than three pairs, or points on one line.
    """
    pair = np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1)
    a, b = source[pair], target[pair]
    if len(a) < 3 or min(_extents(a)[1], _extents(b)[1]) < FLAT:
        raise FitError(
            f"{len(a)} pairs of points do not fix a rigid motion.",
            why="it takes three that are not on one line",
            fix="give more points, spread out",
        )
    rotation = _nearest_rotation((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    pose = Pose(rotation, b.mean(axis=0) - rotation @ a.mean(axis=0))
    return pose, float(np.sqrt(np.mean(np.sum((pose.apply(a) - b) ** 2, axis=1))))


def resect(xyz: Floats, uv: Floats) -> Floats:
    """Camera matrix P (3, 4), `pixel_from_world`, from known points (n, 3) and their pixels (n, 2), NaN where not seen.

    The direct linear transformation with normalised coordinates (Alg. 7.1, without its non-linear step): a pinhole
    without distortion. FitError for fewer than six points, or points that leave P undetermined (flat ones, say).
    """
    xyz, uv = _seen(xyz, uv)
    _check_spread(xyz)
    world, pixel = _normalising(xyz), _normalising(uv)
    rays = _homogeneous(uv) @ pixel.T
    p = np.linalg.inv(pixel) @ _linear_camera(_homogeneous(xyz) @ world.T, rays) @ world
    p = p / np.linalg.norm(p[2, :3])
    in_front = np.median(_homogeneous(xyz) @ p[2]) > 0
    return p if in_front else -p


def camera_centre(p: Floats) -> Floats:
    """(3,) centre of the camera with matrix P, in the world frame; not finite if the camera is at infinity."""
    centre = np.linalg.svd(p)[2][-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(centre[:3] / centre[3], dtype=np.float64)


def triangulate(cameras: Floats, uv: Floats) -> Floats:
    """Points (n, 3) from camera matrices (cameras, 3, 4) and pixels (n, cameras, 2), NaN where not seen.

    Least squares on the distances to the planes that a view's column and row span with the camera's centre: it does
    not depend on the unit or the origin of the world. NaN for fewer than two views, or rays that (nearly) coincide.
    """
    planes = uv[..., None] * cameras[:, None, 2] - cameras[:, :2]  # (n, cameras, 2, 4)
    planes = planes.reshape(len(uv), -1, 4)
    planes = np.nan_to_num(planes / np.linalg.norm(planes[..., :3], axis=-1, keepdims=True))
    u, s, vt = np.linalg.svd(planes[..., :3], full_matrices=False)
    good = (np.isfinite(uv).all(axis=-1).sum(axis=1) >= 2) & (s[:, 2] > 1e-6 * s[:, 0])
    s[~good] = np.nan
    along = np.einsum("nki,nk->ni", u, planes[..., 3]) / s
    return np.asarray(-np.einsum("nij,ni->nj", vt, along), dtype=np.float64)


def depth_of_points(xyz: Floats, uv: Floats, sizes: Floats | None = None) -> Floats | None:
    """(n,) how far the points are from the cameras: the mean over cameras of the distance, in the unit of the points.

    For grouping results by region, not for measuring. Each camera's centre is estimated from the known points (n, 3)
    and its pixels in uv (n, cameras, 2), whatever its lens. sizes: (cameras, 2) width and height in pixels, where
    known. None where no camera can be placed: too few points, or flat ones.
    """
    centres = []
    for c in range(uv.shape[1]):
        try:
            middle = None if sizes is None else (sizes[c] - 1) / 2
            centres.append(resect_any_lens(xyz, uv[:, c], middle=middle)[0].centre)
        except FitError:
            continue
    if not centres:
        return None
    return np.asarray(np.mean([np.linalg.norm(xyz - centre, axis=1) for centre in centres], axis=0), dtype=np.float64)


def resect_any_lens(xyz: Floats, uv: Floats, *, middle: Floats | None = None) -> tuple[Pose, float]:
    """`camera_from_world` of a camera with an unknown lens, and the rms it leaves in pixels; no starting guess.

    Known points (n, 3), their pixels (n, 2), NaN where not seen. Pixels become rays by the equidistant and the
    pinhole model for a ladder of focal lengths about `middle` (where the axis meets the image; else the middle of the
    pixels), a linear resection follows, and the best wins. Views far off are then left out and it is done again, which
    bears a tenth of wrong detections. At most `ENOUGH` points are used, drawn at random but always the same. Fails as
    `resect`.
    """
    xyz, uv = _seen(xyz, uv)
    if len(xyz) > ENOUGH:
        drawn = np.random.default_rng(0).choice(len(xyz), ENOUGH, replace=False)
        xyz, uv = xyz[drawn], uv[drawn]
    _check_spread(xyz)
    middle = np.quantile(uv, (0.05, 0.95), axis=0).mean(axis=0) if middle is None else middle
    keep = np.ones(len(xyz), dtype=np.bool_)
    for _ in range(8):
        pose, errors = _best_lens(xyz, uv - middle, keep)
        inside = errors <= 2.5 * np.median(errors)
        if inside.sum() < 2 * FEWEST or _extents(xyz[inside])[2] < FLAT or (inside == keep).all():
            break
        keep = inside
    return pose, float(np.sqrt(np.mean(errors[keep] ** 2)))


def resect_rays(xyz: Floats, rays: Floats) -> Pose:
    """`camera_from_world` from known points (n, 3) and unit rays (n, 3) in the camera frame.

    Linear: ray x (M x + t) = 0, then the rotation nearest to M, then the translation for that rotation.
    """
    world = _normalising(xyz)
    m = (_linear_camera(_homogeneous(xyz) @ world.T, rays) @ world)[:, :3]
    facing = np.sign(np.linalg.det(m)) or 1.0
    rotation = _nearest_rotation(facing * m)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]  # what of a vector is not along the ray
    turned = xyz @ rotation.T
    return Pose(rotation, -np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, turned)))


def _best_lens(xyz: Floats, offset: Floats, keep: Bools) -> tuple[Pose, Floats]:
    """The pose for the lens that fits the points kept best, and the errors (n,) of all points in pixels."""
    fits = []
    for focal, rays in _candidate_rays(offset):
        pose = resect_rays(xyz[keep], rays[keep])
        points = pose.apply(xyz)
        sine, cosine = np.linalg.norm(np.cross(rays, points), axis=1), np.sum(rays * points, axis=1)
        # In pixels: angles would favour the longest lens, where all of them are small.
        fits.append((pose, focal * np.arctan2(sine, cosine)))
    return min(fits, key=lambda fit: float(np.sum(fit[1][keep] ** 2)))


def _candidate_rays(offset: Floats) -> Iterator[tuple[float, Floats]]:
    """Focal lengths in pixels, and the unit rays (n, 3) of pixels (n, 2) from the middle, from fisheye to telephoto."""
    radius = np.linalg.norm(offset, axis=1)
    outermost = float(radius.max()) or 1.0
    for widest in np.geomspace(0.03, 2.5, 40):  # radians at the outermost point
        focal = outermost / widest
        theta = radius / focal
        sideways = offset / focal * np.sinc(theta / np.pi)[:, None]
        yield focal, np.column_stack([sideways, np.cos(theta)])
        if widest < PINHOLE_TO:
            focal = outermost / np.tan(widest)
            rays = _homogeneous(offset / focal)
            yield focal, rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _linear_camera(points: Floats, rays: Floats) -> Floats:
    """The (3, 4) matrix A, up to scale, that brings points (n, 4) onto rays (n, 3): least squares of ray x (A point).

    Solved with the 12 x 12 normal matrix, the sum of (|ray|² I - ray ray^T) (x) point point^T: normalised coordinates
    keep it well conditioned, and its size does not grow with n.
    """
    outer = (points[:, :, None] * points[:, None, :]).reshape(-1, 16)
    across = np.sum(rays**2, axis=1)[:, None, None] * np.eye(3) - rays[:, :, None] * rays[:, None, :]
    normal = (across.reshape(-1, 9).T @ outer).reshape(3, 3, 4, 4).swapaxes(1, 2).reshape(12, 12)
    values, vectors = np.linalg.eigh(normal)
    if values[1] < UNDETERMINED * values[-1]:
        raise FitError(
            "the known points do not fix the camera.",
            why="more than one camera sees them at these pixels: they lie on one plane, or on a curve through it",
            fix="add points elsewhere in the volume",
        )
    return np.asarray(vectors[:, 0].reshape(3, 4), dtype=np.float64)


def _seen(xyz: Floats, uv: Floats) -> tuple[Floats, Floats]:
    seen = np.isfinite(uv).all(axis=1) & np.isfinite(xyz).all(axis=1)
    return xyz[seen], uv[seen]


def _check_spread(xyz: Floats) -> None:
    if len(xyz) < FEWEST:
        raise FitError(
            f"{len(xyz)} known points are seen; a camera needs at least {FEWEST}.", fix="show it more known points"
        )
    if _extents(xyz)[2] < FLAT:
        raise FitError(
            f"the {len(xyz)} known points lie on one plane, which does not fix a camera.",
            why=f"their smallest extent is less than {FLAT:g} of their largest",
            fix="add points at another depth",
        )


def _extents(points: Floats) -> Floats:
    """(3,) singular values of the centred points, as parts of the largest."""
    s = np.zeros(3)
    found = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    s[: len(found)] = found
    return s / s[0] if s[0] > 0 else s


def _normalising(points: Floats) -> Floats:
    """The similarity, homogeneous, that gives points (n, d) mean zero and rms distance sqrt(d)."""
    d = points.shape[1]
    mean = points.mean(axis=0)
    scale = float(np.sqrt(np.mean((points - mean) ** 2))) or 1.0
    transform: Floats = np.eye(d + 1) / scale
    transform[:d, d], transform[d, d] = -mean / scale, 1.0
    return transform


def _nearest_rotation(m: Floats) -> Floats:
    """The rotation R that maximises trace(R^T m), never a mirror image."""
    u, _, vt = np.linalg.svd(m)
    u[:, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))
    return np.asarray(u @ vt, dtype=np.float64)


def _homogeneous(points: Floats) -> Floats:
    return np.hstack([points, np.ones((len(points), 1))])


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector), dtype=np.float64)
