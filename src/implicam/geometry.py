"""Poses, rigid registration, one camera from known points, and points from several cameras.

A pose turns coordinates of one frame into another: `camera_from_world.apply(xyz)`, and
`camera_from_board = camera_from_world @ world_from_board`: the inner names cancel. Lengths are in whatever unit the
points use. A camera matrix P (3, 4) is `pixel_from_world`: w (u, v, 1) = P (x, y, z, 1), with w > 0 in front of the
camera. Chapters and algorithms: Hartley & Zisserman, Multiple View Geometry, 2nd edition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from implicam.errors import FitError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

MAX_FLAT_EXTENT_RATIO = 1e-3
"""Points whose extent in one direction is less than this part of the largest are taken as flat (or a line)."""

MIN_POINTS = 6
"""Known points that fix the 11 numbers of a camera matrix."""

MAX_RESECTION_POINTS = 120
"""Points beyond which a rough resection gains nothing."""

MIN_EIGENVALUE_RATIO = 1e-14
"""The second-smallest eigenvalue, as a part of the largest, below which the null space is not one vector."""

LINEAR_SUBSETS = 40
"""Random subsets of seven points that a linear resection tries: with a fifth of wrong views eight of them hold none."""

MAX_PIXEL_DISTANCE_RATIO = 4.0
"""Times the distance from the middle that three quarters of the pixels keep: what is farther off is a wild view."""

MAX_PINHOLE_ANGLE_RAD = 1.2
"""Radians off the axis beyond which no lens is a pinhole."""

SUSPECT_ERROR_RATIO, MAX_SUSPECT_SHARE = 6.0, 0.08
"""Errors so many times the median are suspect; a larger part of suspects asks for random subsets."""

POOR_ERROR_RATIO = 0.05
"""A median error that is this part of the median distance from the middle is no fit: it asks for them, too."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A rigid motion `x_to = rotation x_from + translation`.

    Attributes:
        rotation: (3, 3).
        translation: (3,), in the length unit of the points.
    """

    rotation: Floats
    translation: Floats

    def __post_init__(self) -> None:
        for name, shape in (("rotation", (3, 3)), ("translation", (3,))):
            array = np.array(getattr(self, name), dtype=np.float64).reshape(shape)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def apply(self, points: Floats) -> Floats:
        """Points of the one frame in the other.

        Args:
            points: (..., 3).

        Returns:
            (..., 3).
        """
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
    """The pose of a camera that looks at a target.

    Args:
        centre: (3,) of the camera, in the world.
        target: (3,) in the world.
        up: (3,) direction in the world that is up in the image; where the camera looks along it, another is taken.

    Returns:
        `camera_from_world`.
    """
    forward = _unit(np.subtract(target, centre))
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) < 1e-9 * np.linalg.norm(up):  # straight up or down: any sideways will do
        right = np.cross(forward, np.roll(np.asarray(up, dtype=np.float64), 1))
    right = _unit(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Pose(rotation, -rotation @ np.asarray(centre, dtype=np.float64))


def rotation_from_vector(vector: ArrayLike) -> Floats:
    """Rotation matrices of rotation vectors (OpenCV's rvec).

    Args:
        vector: (..., 3) axis times angle in radians.

    Returns:
        (..., 3, 3).
    """
    return np.asarray(Rotation.from_rotvec(np.asarray(vector, dtype=np.float64)).as_matrix(), dtype=np.float64)


def cross_matrices(a: Floats) -> Floats:
    """What vectors make of another one by the cross product: `cross_matrices(a) @ v` is a x v.

    Args:
        a: (n, 3).

    Returns:
        (n, 3, 3).
    """
    return np.asarray(np.cross(a[:, None], np.eye(3)).swapaxes(1, 2), dtype=np.float64)


def vector_from_rotation(rotation: ArrayLike) -> Floats:
    """Rotation vectors of rotation matrices.

    Args:
        rotation: (..., 3, 3).

    Returns:
        (..., 3) axis times angle in radians.
    """
    return np.asarray(Rotation.from_matrix(np.asarray(rotation, dtype=np.float64)).as_rotvec(), dtype=np.float64)


def register(source: Floats, target: Floats) -> tuple[Pose, float]:
    """The rigid motion that brings points onto their partners, by least squares (Kabsch 1976).

    It is never a mirror image (Umeyama 1991). Pairs with a NaN are left out.

    Args:
        source: (n, 3).
        target: (n, 3) their partners.

    Returns:
        `target_from_source`, and the root mean square of the distances that are left.

    Raises:
        FitError: There are fewer than three pairs, or the points lie on one line.
    """
    pair = np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1)
    a, b = source[pair], target[pair]
    if len(a) < 3 or min(_extents(a)[1], _extents(b)[1]) < MAX_FLAT_EXTENT_RATIO:
        raise FitError(
            f"{len(a)} pairs of points do not fix a rigid motion.",
            why="it takes three that are not on one line",
            fix="give more points, spread out",
        )
    rotation = _nearest_rotations(((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))[None])[0]
    pose = Pose(rotation, b.mean(axis=0) - rotation @ a.mean(axis=0))
    return pose, float(np.sqrt(np.mean(np.sum((pose.apply(a) - b) ** 2, axis=1))))


def resect(xyz: Floats, uv: Floats) -> Floats:
    """The camera matrix from known points and their pixels: a pinhole without distortion.

    This is the direct linear transformation with normalised coordinates (Alg. 7.1, without its non-linear step).

    Args:
        xyz: (n, 3) known points in the world.
        uv: (n, 2) pixels, NaN where not seen.

    Returns:
        P (3, 4), `pixel_from_world`.

    Raises:
        FitError: There are fewer than six points, or they leave P undetermined (flat ones, for example).
    """
    xyz, uv = _seen(xyz, uv)
    _check_spread(xyz)
    world, pixel = _normalising(xyz), _normalising(uv)
    rays = _homogeneous(uv) @ pixel.T
    cameras, determined = _linear_cameras(_homogeneous(xyz) @ world.T, rays[None])
    if not determined[0]:
        raise _undetermined()
    p: Floats = np.linalg.inv(pixel) @ cameras[0] @ world
    p = p / np.linalg.norm(p[2, :3])
    in_front = np.median(_homogeneous(xyz) @ p[2]) > 0
    return p if in_front else -p


def resect_robustly(xyz: Floats, uv: Floats, *, subsets: bool = True) -> tuple[Floats, Bools]:
    """As `resect`, where some views may be wrong.

    Of random subsets of seven points (always the same) the one with the least median error is taken, then up to three
    times what agrees with it.

    Args:
        xyz: (n, 3) known points in the world.
        uv: (n, 2) pixels, all of them seen.
        subsets: Whether to try random subsets; without them it starts from all points: ten times faster, for few wrong
            views.

    Returns:
        P (3, 4), and (n,) which views agree with it.

    Raises:
        FitError: As `resect`.
    """
    inliers = _of_best_subset(xyz, uv) if subsets else np.ones(len(xyz), dtype=np.bool_)
    for _ in range(3):
        p = resect(xyz[inliers], uv[inliers])
        error = _linear_error(p, xyz, uv)
        inside = error <= 4 * np.median(error[inliers])
        if inside.sum() < MIN_POINTS + 1 or (inside == inliers).all():
            break
        inliers = inside
    return p, np.asarray(inliers, dtype=np.bool_)


def _of_best_subset(xyz: Floats, uv: Floats) -> Bools:
    """(n,) the seven tenths of the views that agree best with the subset that leaves the least median error."""
    rng = np.random.default_rng(0)
    best, inliers = np.inf, np.ones(len(xyz), dtype=np.bool_)
    starts = [np.arange(len(xyz))]
    if len(xyz) >= 2 * MIN_POINTS:
        starts += [rng.choice(len(xyz), MIN_POINTS + 1, replace=False) for _ in range(LINEAR_SUBSETS)]
    for rows in starts:
        try:
            error = _linear_error(resect(xyz[rows], uv[rows]), xyz, uv)
        except FitError:
            continue
        if np.median(error) < best:
            best, inliers = (
                float(np.median(error)),
                error <= np.sort(error)[int(0.7 * len(error))],
            )  # some may be infinite
    if not np.isfinite(best):
        raise _undetermined()
    return np.asarray(inliers, dtype=np.bool_)


def _linear_error(p: Floats, xyz: Floats, uv: Floats) -> Floats:
    """(n,) px between pixels and what a camera matrix projects, infinite behind it."""
    u, v, w = (_homogeneous(xyz) @ p.T).T
    w = np.where(w > 0, w, np.nan)
    error = np.hypot(u / w - uv[:, 0], v / w - uv[:, 1])
    return np.asarray(np.where(np.isnan(error), np.inf, error), dtype=np.float64)


def camera_from_linear(p: Floats) -> tuple[float, Floats, Floats, bool, Pose] | None:
    """The parts of a camera matrix (Hartley & Zisserman, section 6.2.4).

    `[fx skew; 0 fy]` up to a rotation about the axis is focal * exp([[p, q], [q, -p]]) (the polar decomposition), and a
    negative determinant is a mirror.

    Args:
        p: (3, 4) camera matrix.

    Returns:
        Focal length in pixels, pixel shape (2,) p and q, principal point (2,) in pixels, whether it is mirrored,
        `camera_from_world`. None where the camera is at infinity.
    """
    size = float(np.linalg.norm(p[2, :3]))
    if not size > 1e-12 * np.abs(p).max():
        return None
    p = p / size
    axis = p[2, :3]
    centre = p[:2, :3] @ axis
    across = p[:2, :3] - np.outer(centre, axis)
    parts = pixel_shape_of(across)
    if parts is None:
        return None
    focal, shape, root = parts
    rows = np.linalg.solve(root, across)
    mirrored = bool(np.cross(rows[0], rows[1]) @ axis < 0)
    sign = np.array([-1.0 if mirrored else 1.0, 1.0])
    rotation = np.vstack([rows * sign[:, None], axis])
    sideways = sign * np.linalg.solve(root, p[:2, 3] - centre * p[2, 3])
    return focal, shape, centre, mirrored, Pose(rotation, np.append(sideways, p[2, 3]))


def pixel_shape_of(across: Floats) -> tuple[float, Floats, Floats] | None:
    """The polar decomposition of a map to pixels.

    Args:
        across: (2, 3).

    Returns:
        The size f and the shape (2,) p and q of `f exp([[p, q], [q, -p]])`, and this symmetric factor (2, 2). None
        where the map has no area.
    """
    values, vectors = np.linalg.eigh(across @ across.T)
    if not values[0] > 1e-12 * values[1] > 0:
        return None
    size = float(np.prod(values) ** 0.25)
    log = vectors * (0.5 * np.log(values) - np.log(size)) @ vectors.T
    shape = np.array([0.5 * (log[0, 0] - log[1, 1]), log[0, 1]])
    return size, shape, np.asarray(vectors * np.sqrt(values) @ vectors.T, dtype=np.float64)


def resect_affine(xyz: Floats, uv: Floats) -> tuple[Floats, Floats, Bools]:
    """The parallel projection `A x + b` that is nearest to most views.

    Args:
        xyz: (n, 3) known points in the world.
        uv: (n, 2) pixels, all of them seen.

    Returns:
        A (2, 3), b (2,), and (n,) which views it explains.

    Raises:
        FitError: There are fewer than six points, or they lie on one plane.
    """
    _check_spread(xyz)
    inliers = np.ones(len(xyz), dtype=np.bool_)
    for _ in range(6):
        found = np.linalg.lstsq(_homogeneous(xyz[inliers]), uv[inliers], rcond=None)[0]
        error = np.linalg.norm(_homogeneous(xyz) @ found - uv, axis=1)
        inside = error <= 3 * np.median(error)
        if inside.sum() < MIN_POINTS or (inside == inliers).all() or _extents(xyz[inside])[2] < MAX_FLAT_EXTENT_RATIO:
            break
        inliers = inside
    A, b = np.asarray(found[:3].T, dtype=np.float64), np.asarray(found[3], dtype=np.float64)
    return A, b, np.asarray(inliers, dtype=np.bool_)


def camera_centre(p: Floats) -> Floats:
    """The centre of a camera.

    Args:
        p: (3, 4) camera matrix.

    Returns:
        (3,) in the world; not finite if the camera is at infinity.
    """
    centre = np.linalg.svd(p)[2][-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(centre[:3] / centre[3], dtype=np.float64)


def triangulate(cameras: Floats, uv: Floats) -> Floats:
    """Points from camera matrices and pixels.

    Least squares on the distances to the planes that a view's column and row span with the camera's centre: it does not
    depend on the unit or the origin of the world.

    Args:
        cameras: (cameras, 3, 4) matrices.
        uv: (n, cameras, 2) pixels, NaN where not seen.

    Returns:
        (n, 3) in the world; NaN for fewer than two views, or rays that (nearly) coincide.
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
    """How far points are from the cameras; for grouping results by region, not for measuring.

    Each camera's centre is estimated from the known points and its pixels, whatever its lens.

    Args:
        xyz: (n, 3) known points in the world.
        uv: (n, cameras, 2) pixels, NaN where not seen.
        sizes: (cameras, 2) width and height in pixels, where known.

    Returns:
        (n,) the mean over cameras of the distance, in the unit of the points. None where no camera can be placed: too
        few points, or flat ones.
    """
    centres = []
    for c in range(uv.shape[1]):
        try:
            middle = None if sizes is None else (sizes[c] - 1) / 2
            centres.append(resect_any_lens(xyz, uv[:, c], middle=middle).camera_from_world.centre)
        except FitError:
            continue
    if not centres:
        return None
    return np.asarray(np.mean([np.linalg.norm(xyz - centre, axis=1) for centre in centres], axis=0), dtype=np.float64)


class Resection(NamedTuple):
    """A camera with an unknown lens, placed roughly.

    Attributes:
        camera_from_world: Its pose.
        focal: Focal length, pixels.
        pinhole: Whether the pinhole fits best; if not, the equidistant lens does.
        rms: Root mean square error of the inliers, pixels.
        inliers: (n,) which views were used and are not far off.
        doubtful: Whether many views are far off, or all are: wrong views, or a camera unlike both lenses.
    """

    camera_from_world: Pose
    focal: float
    pinhole: bool
    rms: float
    inliers: Bools
    doubtful: bool


def resect_any_lens(xyz: Floats, uv: Floats, *, middle: Floats | None = None, subsets: bool = True) -> Resection:
    """Place a camera with an unknown lens, without a starting guess.

    Pixels become rays by the equidistant and the pinhole lens for a ladder of focal lengths, a linear resection
    follows, and the best wins. Views far off are then left out and it is done again. At most `MAX_RESECTION_POINTS`
    points are used, drawn at random but always the same.

    Args:
        xyz: (n, 3) known points in the world.
        uv: (n, 2) pixels, NaN where not seen.
        middle: (2,) pixel where the lens's axis meets the image; None for the middle of the pixels.
        subsets: Whether to start from random subsets (RANSAC) too where many views are far off; with them a third of
            the views may be wrong.

    Raises:
        FitError: As `resect`.
    """
    rows, middle = _rows_and_middle(xyz, uv, middle)
    points, offset = xyz[rows], uv[rows] - middle
    found, errors, keep = _trimmed(points, offset, np.ones(len(rows), dtype=np.bool_))
    bad = float(np.median(errors))
    tolerable = POOR_ERROR_RATIO * float(np.median(np.linalg.norm(offset, axis=1)))
    doubtful = bool(bad > tolerable or np.mean(errors > max(SUSPECT_ERROR_RATIO * bad, tolerable)) > MAX_SUSPECT_SHARE)
    if subsets and doubtful:
        for start in _by_subsets(points, offset):
            again = _trimmed(points, offset, start)
            if np.median(again[1]) < np.median(errors):
                found, errors, keep = again
    inliers = np.zeros(len(xyz), dtype=np.bool_)
    inliers[rows[keep]] = True
    rms = float(np.sqrt(np.mean(errors[keep] ** 2)))
    return Resection(found.camera_from_world, found.focal, found.pinhole, rms, inliers, doubtful)


def _rows_and_middle(xyz: Floats, uv: Floats, middle: Floats | None) -> tuple[NDArray[np.intp], Floats]:
    """The points that a rough resection uses, by number, and the middle of their pixels where none is given."""
    rows = np.flatnonzero(np.isfinite(uv).all(axis=1) & np.isfinite(xyz).all(axis=1))
    if len(rows) > MAX_RESECTION_POINTS:
        rows = np.sort(np.random.default_rng(0).choice(rows, MAX_RESECTION_POINTS, replace=False))
    _check_spread(xyz[rows])
    return rows, np.quantile(uv[rows], (0.05, 0.95), axis=0).mean(axis=0) if middle is None else middle


def resect_any_pixels(
    xyz: Floats, uv: Floats, *, middle: Floats | None = None, aspects: Sequence[float] = (1.0,)
) -> tuple[Resection, float]:
    """As `resect_any_lens`, for pixels that need not be square.

    Args:
        xyz: (n, 3) known points in the world.
        uv: (n, 2) pixels, NaN where not seen.
        middle: (2,) pixel where the lens's axis meets the image; None for the middle of the pixels.
        aspects: Ratios fy / fx to try.

    Returns:
        The camera that fits best, its focal length and rms in pixels of u; and its ratio.

    Raises:
        FitError: As `resect`.
    """
    rows, middle = _rows_and_middle(xyz, uv, middle)

    def off(aspect: float) -> float:
        offset = (uv[rows] - middle) / np.array([1.0, aspect])
        errors = _trimmed(xyz[rows], offset, np.ones(len(rows), dtype=np.bool_))[1]
        return float(np.median(errors) * np.sqrt(aspect))  # no ratio may win by making pixels large

    best = min(aspects, key=off) if len(aspects) > 1 else aspects[0]
    squared = middle + (uv - middle) / np.array([1.0, best])
    return resect_any_lens(xyz, squared, middle=middle), float(best)


def _trimmed(xyz: Floats, offset: Floats, keep: Bools) -> tuple[_Candidate, Floats, Bools]:
    """The best lens for the points kept; those far off left out, others taken in, four times at most."""
    lenses = candidate_rays(offset)
    for _ in range(4):
        found, errors = _best_lens(xyz, lenses, keep)
        inside = errors <= 2.5 * np.median(errors)
        if inside.sum() < 2 * MIN_POINTS or _extents(xyz[inside])[2] < MAX_FLAT_EXTENT_RATIO or (inside == keep).all():
            break
        keep = inside
    return found, errors, keep


def _by_subsets(xyz: Floats, offset: Floats) -> list[Bools]:
    """RANSAC: for the best few of a hundred random subsets, the points (n,) that agree with it best.

    Of subsets of seven points a hundred hold several clean ones, even where a third of the views is wrong.
    """
    rng = np.random.default_rng(0)
    lenses = candidate_rays(offset, every=3)
    found = []
    for _ in range(100):
        subset = np.zeros(len(xyz), dtype=np.bool_)
        subset[rng.choice(len(xyz), min(7, len(xyz)), replace=False)] = True
        try:
            found.append(_best_lens(xyz, lenses, subset)[1])
        except FitError:  # a subset can be degenerate where the points are not
            continue
    best = sorted(found, key=lambda errors: float(np.median(errors)))[:4]
    return [errors <= np.quantile(errors, 0.6) for errors in best]


def resect_rays(xyz: Floats, rays: Floats) -> Pose:
    """The pose of a camera from known points and the rays on which it sees them.

    Linear: ray x (M x + t) = 0, then the rotation nearest to M, then the translation for that rotation.

    Args:
        xyz: (n, 3) known points in the world.
        rays: (n, 3) unit vectors in the camera frame.

    Returns:
        `camera_from_world`.

    Raises:
        FitError: The points do not fix it.
    """
    rotations, translations, determined = _resect_many(xyz, rays[None])
    if not determined[0]:
        raise _undetermined()
    return Pose(rotations[0], translations[0])


def poses_from_rays(xyz: Floats, rays: Floats) -> list[Pose]:
    """All locally best poses of a camera that sees four or more known points, flat or not, on given rays.

    By orthogonal iteration from 24 evenly spread rotations, so that no guess is needed.

    Args:
        xyz: (n, 3) known points in the world.
        rays: (n, 3) unit vectors in the camera frame.

    Returns:
        `camera_from_world` of each, the best first; few points may have more than one. Only poses with all points in
        front of the camera are among them.
    """
    centre, turns = xyz.mean(axis=0), rotations_to_start()
    R, t, off = orthogonal_iteration(xyz - centre, np.broadcast_to(rays, (len(turns), *rays.shape)), turns, 200)
    found: list[Pose] = []
    for k in np.argsort(off):
        pose = Pose(R[k], t[k] - R[k] @ centre)
        if np.isfinite(off[k]) and all(np.trace(pose.rotation.T @ one.rotation) < 3 - 1e-3 for one in found):
            found.append(pose)
    return found


def rotations_to_start() -> Floats:
    """(24, 3, 3) evenly spread rotations, those of a cube: near enough to any other for an iteration to find it."""
    return np.asarray(Rotation.create_group("O").as_matrix(), dtype=np.float64)


def orthogonal_iteration(xyz: Floats, rays: Floats, R: Floats, steps: int) -> tuple[Floats, Floats, Floats]:
    """Poses of cameras that see the same known points on given rays, from k guesses of their rotations.

    Lu, Hager & Mjolsness (2000): points are brought onto their rays in turn with the rotation that fits best.

    Args:
        xyz: (n, 3) known points, with their mean in the origin.
        rays: (k, n, 3) unit vectors in the frame of each camera.
        R: (k, 3, 3) rotations to start from.
        steps: How many.

    Returns:
        (k, 3, 3) rotations, (k, 3) translations, and (k,) the sum of the squared angles in radians that are left;
        infinite where a point is behind the camera.

    >>> xyz = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, -1]])
    >>> there = xyz + np.array([0, 0, 5.0])
    >>> rays = there / np.linalg.norm(there, axis=1, keepdims=True)
    >>> bool(np.allclose(orthogonal_iteration(xyz, rays[None], np.eye(3)[None], 9)[1], [[0, 0, 5]]))
    True
    """
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    solve = np.linalg.inv(across.mean(axis=1))

    def shift(R: Floats) -> Floats:
        """(k, 3) the best translations."""
        pull = (across @ (xyz @ R.swapaxes(1, 2))[..., None]).mean(axis=1)
        return np.asarray(-(solve @ pull)[..., 0], dtype=np.float64)

    for _ in range(steps):
        there = xyz @ R.swapaxes(1, 2) + shift(R)[:, None]
        onto = rays * np.maximum(np.sum(there * rays, axis=2), 0)[..., None]
        R = _nearest_rotations((onto - onto.mean(axis=1, keepdims=True)).swapaxes(1, 2) @ xyz)
    t = shift(R)
    there = xyz @ R.swapaxes(1, 2) + t[:, None]
    along = np.sum(there * rays, axis=2)
    off = np.sum(np.arctan2(np.linalg.norm(there - along[..., None] * rays, axis=2), along) ** 2, axis=1)
    return R, t, np.where((along > 0).all(axis=1), off, np.inf)


def _resect_many(xyz: Floats, rays: Floats) -> tuple[Floats, Floats, Bools]:
    """Rotations (k, 3, 3) and translations (k, 3) for k sets of rays (k, n, 3) of the same points; and where fixed."""
    world = _normalising(xyz)
    cameras, determined = _linear_cameras(_homogeneous(xyz) @ world.T, rays)
    m = (cameras @ world)[:, :, :3]
    facing = np.where(np.linalg.det(m) < 0, -1.0, 1.0)
    rotations = _nearest_rotations(facing[:, None, None] * m)
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]  # what of a vector is not along the ray
    turned = xyz @ rotations.swapaxes(1, 2)
    pull = np.einsum("knij,knj->ki", across, turned)
    return rotations, -np.linalg.solve(across.sum(axis=1), pull[..., None])[..., 0], determined


class _Candidate(NamedTuple):
    camera_from_world: Pose
    focal: float
    pinhole: bool


def _best_lens(xyz: Floats, lenses: tuple[Floats, Bools, Floats], keep: Bools) -> tuple[_Candidate, Floats]:
    """The pose for the lens that fits the points kept best, and the errors (n,) of all points in pixels; lenses: of
    `candidate_rays`."""
    focal, pinhole, rays = lenses
    rotations, translations, determined = _resect_many(xyz[keep], rays[:, keep])
    if not determined.any():
        raise _undetermined()
    points = xyz @ rotations.swapaxes(1, 2) + translations[:, None]
    along = np.sum(rays * points, axis=2)
    aside = np.sqrt(np.maximum(np.sum(points**2, axis=2) - along**2, 0))
    # In pixels: angles would favour the longest lens, where all of them are small.
    errors = focal[:, None] * np.arctan2(aside, along)
    best = int(np.argmin(np.where(determined, np.sum(errors[:, keep] ** 2, axis=1), np.inf)))
    pose = Pose(rotations[best], translations[best])
    return _Candidate(pose, float(focal[best]), bool(pinhole[best])), errors[best]


def candidate_rays(offset: Floats, every: int = 1) -> tuple[Floats, Bools, Floats]:
    """A ladder of lenses, and where their pixels look.

    Args:
        offset: (n, 2) pixels from where the lens's axis meets the image.
        every: Take one rung of so many.

    Returns:
        (k,) focal lengths in pixels, (k,) whether the lens is a pinhole or else equidistant, and (k, n, 3) the unit
        rays.
    """
    radius = np.linalg.norm(offset, axis=1)
    plausible = radius <= MAX_PIXEL_DISTANCE_RATIO * np.quantile(radius, 0.75)  # no wild view decides
    outermost = float(radius[plausible].max()) or 1.0
    widest = np.geomspace(0.03, 2.5, 40)[::every]  # radians at the outermost point
    bent = outermost / widest[:, None]
    theta = radius / bent
    sideways = offset / bent[..., None] * np.sinc(theta / np.pi)[..., None]
    equidistant = np.concatenate([sideways, np.cos(theta)[..., None]], axis=2)
    straight = outermost / np.tan(widest[widest < MAX_PINHOLE_ANGLE_RAD, None])
    flat = np.concatenate([offset / straight[..., None], np.ones((len(straight), len(offset), 1))], axis=2)
    rays = np.concatenate([equidistant, flat / np.linalg.norm(flat, axis=2, keepdims=True)])
    focal = np.concatenate([bent, straight])[:, 0]
    return focal, np.arange(len(focal)) >= len(widest), rays


def _linear_cameras(points: Floats, rays: Floats) -> tuple[Floats, Bools]:
    """The (k, 3, 4) matrices A, up to scale, that bring points (n, 4) onto rays (k, n, 3): least squares of
    ray x (A point); and (k,) where the points fix it.

    Solved with the 12 x 12 normal matrix, the sum of (|ray|² I - ray ray^T) (x) point point^T: normalised coordinates
    keep it well conditioned, and its size does not grow with n.
    """
    k, n = rays.shape[:2]
    outer = (points[:, :, None] * points[:, None, :]).reshape(n, 16)
    across = np.sum(rays**2, axis=2)[..., None, None] * np.eye(3) - rays[..., :, None] * rays[..., None, :]
    normal = (across.reshape(k, n, 9).swapaxes(1, 2) @ outer).reshape(k, 3, 3, 4, 4).swapaxes(2, 3).reshape(k, 12, 12)
    values, vectors = np.linalg.eigh(normal)
    determined = values[:, 1] >= MIN_EIGENVALUE_RATIO * values[:, -1]
    return vectors[:, :, 0].reshape(k, 3, 4), np.asarray(determined, dtype=np.bool_)


def _undetermined() -> FitError:
    return FitError(
        "the known points do not fix the camera.",
        why="more than one camera sees them at these pixels: they lie on one plane, or on a curve through it",
        fix="add points elsewhere in the volume",
    )


def _seen(xyz: Floats, uv: Floats) -> tuple[Floats, Floats]:
    seen = np.isfinite(uv).all(axis=1) & np.isfinite(xyz).all(axis=1)
    return xyz[seen], uv[seen]


def _check_spread(xyz: Floats) -> None:
    if len(xyz) < MIN_POINTS:
        raise FitError(
            f"{len(xyz)} known points are seen; a camera needs at least {MIN_POINTS}.", fix="show it more known points"
        )
    if _extents(xyz)[2] < MAX_FLAT_EXTENT_RATIO:
        raise FitError(
            f"the {len(xyz)} known points lie on one plane, which does not fix a camera.",
            why=f"their smallest extent is less than {MAX_FLAT_EXTENT_RATIO:g} of their largest",
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


def _nearest_rotations(m: Floats) -> Floats:
    """The rotations R (k, 3, 3) that maximise trace(R^T m), never a mirror image."""
    u, _, vt = np.linalg.svd(m)
    u[:, :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[:, None]
    return np.asarray(u @ vt, dtype=np.float64)


def _homogeneous(points: Floats) -> Floats:
    return np.hstack([points, np.ones((len(points), 1))])


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector), dtype=np.float64)
