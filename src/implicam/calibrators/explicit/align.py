"""From the rig's own frame to the world: the rigid motion that brings measured points onto known ones.

With known correspondences in closed form (geometry.register), then weighted by what each point is worth; or, as in the
paper, by iterative closest point. Its uncertainty goes into the cameras': a rig that is turned a little measures wrong.
"""

from __future__ import annotations

from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial import cKDTree

from implicam.calibrators.explicit.misfit import Left, error_ratio
from implicam.calibrators.explicit.settings import ExplicitSettings
from implicam.dataset import Names
from implicam.errors import FitError
from implicam.geometry import Bools, Floats, Pose, register, rotation_from_vector
from implicam.rig_model import CameraModel, CentralCamera

POINTS, ICP = "points", "icp"
MATCHING = (POINTS, ICP)

MAX_ROUNDS = 60


class Known(NamedTuple):
    """Known points: xyz (n, 3) in the world, their declared sd (n, 3), 0 where none, and shots (n,)."""

    xyz: Floats
    sd: Floats
    shots: Names


class Alignment(NamedTuple):
    """rig_from_world; used (n,) the known points it comes from; K (6, P) how its step (rotation vector, translation)
    follows errors of the cameras' unknowns, and own (6, 6) its covariance from the points' own noise; errors and sds
    (m, 3) of the used points in the world, each left out in turn; scale: world over rig, if it were free; error_ratio:
    how many times larger errors are than the cameras' covariance says (misfit.py)."""

    rig_from_world: Pose
    used: Bools
    K: Floats
    own: Floats
    errors: Floats
    sds: Floats
    scale: float
    error_ratio: float = 1.0

    @property
    def misfit(self) -> float:
        """Rms of the errors in their own standard deviations: 1 where boards and known points agree."""
        return float(np.sqrt(np.mean((self.errors / self.sds) ** 2)))


def align(
    models: tuple[CameraModel, ...],
    root: Floats,
    uv: Floats,
    noise: Floats,
    start: Floats,
    known: Known,
    how: str,
    settings: ExplicitSettings,
) -> Alignment:
    """The motion that brings the rig onto the known points, weighted by what each is worth, without those that
    contradict.

    Args:
        models: Cameras in the rig's frame.
        root: (q, P) of their covariance.
        uv: (n, C, 2) their views of the known points, NaN where not used.
        noise: (n, C) of the views, pixels.
        start: (n, 3) where the points are in the rig's frame, roughly, NaN where not measured.
        known: Where they are in the world.
        how: `points` or `icp`.
        settings: What contradicts.

    Returns:
        The motion, with its uncertainty and what is left.

    Raises:
        FitError: The known points do not fix a motion, or contradict the boards.
    """
    there = np.asarray(np.isfinite(start).all(axis=1))
    if there.sum() < 3:
        raise FitError(
            f"{there.sum()} known points can be measured with the boards' calibration; it takes three to align it.",
            fix="add known points that two cameras see, or leave out points.csv to measure in the first camera's frame",
        )
    measured, point, M = _by_pixels(models, uv, noise, start, there)
    spread = M @ root.T
    cov = point + spread @ spread.swapaxes(1, 2)
    used = there
    for _ in range(8):
        pose, pairs = matched(measured, known.xyz, used, how, settings)
        xyz, sd = known.xyz[pairs], known.sd[pairs]
        pose, Q, G, W, residual = _weighted(pose, measured, cov, xyz, sd, used, there)
        distance = np.einsum("ni,nij,nj->n", residual, W, residual)
        good = there & (
            distance <= max(settings.max_aligned_squared_mahalanobis, float(np.quantile(distance[used], 0.9)))
        )
        if (good == used).all():
            break
        if good.sum() < max(3, 0.5 * there.sum()):  # no few wrong points: the whole does not fit, and a note says so
            used = there
            pose, Q, G, W, residual = _weighted(pose, measured, cov, xyz, sd, used, there)
            break
        used = good
    usual = float(np.mean(np.trace(cov[used], axis1=1, axis2=2)) / 3)
    alike = np.broadcast_to(usual * np.eye(3), cov.shape)
    motions = [(pose, Q, G, W, residual), _weighted(pose, measured, alike, xyz, sd, used, there)]

    weighted = Left(
        residual[used], W[used], G[used], Q, point[used], spread[used],
        pose.rotation * sd[used][:, None, :], known.shots[pairs][used],
    )  # fmt: skip
    ratio = error_ratio(weighted, settings.error_ratio_prior_log_sd)

    def alignment(pose: Pose, Q: Floats, G: Floats, W: Floats, residual: Floats) -> Alignment:
        B = (Q @ G.swapaxes(1, 2) @ W)[used]
        own = _own_noise(B, point[used], pose, sd[used], known.shots[pairs][used])
        K = np.einsum("nai,nip->ap", B, M[used])
        follows = (M[used] - G[used] @ K) @ root.T
        left = point[used] + follows @ follows.swapaxes(1, 2) + G[used] @ own @ G[used].swapaxes(1, 2)
        left = left + pose.rotation @ (sd[used][:, :, None] ** 2 * np.eye(3)) @ pose.rotation.T
        errors, sds = left_out(pose, Q, G[used], W[used], residual[used], left)
        return Alignment(pose, used, K, own, errors, sds, extent_ratio(measured[used], xyz[used]), ratio)

    def loss(one: Alignment) -> float:
        return float(np.sum(one.errors**2 / (usual + sd[used] ** 2)))

    both = [alignment(*motion) for motion in motions]
    best = int(np.argmin([loss(one) for one in both])) if used.sum() > 3 else 0
    left = motions[best][4][there]
    extent = float(np.sqrt(np.sum(known.xyz.var(axis=0))))
    check_alignment(both[best], left, xyz[there], measured[there], extent, settings)
    return both[best]


def _by_pixels(
    models: tuple[CameraModel, ...], uv: Floats, noise: Floats, start: Floats, there: Bools
) -> tuple[Floats, Floats, Floats]:
    """Points (n, 3) by least squares on the pixels alone; their covariance (n, 3, 3) from the pixels' noise; and (n, 3,
    P) how they follow errors of the cameras' unknowns. Zero where not there."""
    n, total = len(start), sum(model.camera.size for model in models)
    x = np.where(there[:, None], start, 0)
    for _ in range(6):
        H, g = np.zeros((n, 3, 3)), np.zeros((n, 3))
        back, first = np.zeros((n, 3, total)), 0
        for c, model in enumerate(models):
            rows = np.flatnonzero(there & np.isfinite(uv[:, c]).all(axis=1))
            view = model.camera.view(x[rows])
            Jt = view.by_point.swapaxes(1, 2) / noise[rows, c, None, None] ** 2
            H[rows] += Jt @ view.by_point
            g[rows] += np.einsum("nij,nj->ni", Jt, uv[rows, c] - view.uv)
            back[rows, :, first : first + model.camera.size] = -Jt @ view.by_parameters
            first += model.camera.size
        point = np.zeros((n, 3, 3))
        point[there] = np.linalg.inv(H[there])
        x = x + np.einsum("nij,nj->ni", point, g)
    return x, point, point @ back


def matched(
    measured: Floats, xyz: Floats, used: Bools, how: str, settings: ExplicitSettings
) -> tuple[Pose, NDArray[np.int64]]:
    """The motion in closed form, and which known point each measured one is.

    Args:
        measured: (n, 3) in the rig's frame.
        xyz: (n, 3) the known points of the same names, in the world.
        used: (n,) which of the pairs the motion is from.
        how: `points`, by their names, or `icp`, by the closest.
        settings: When two ways to match are told apart.

    Returns:
        rig_from_world, and (n,) the number of each measured point's known one.

    Raises:
        FitError: The points lie on one line, or can be matched in several ways.
    """
    if how == POINTS:
        return register(xyz[used], measured[used])[0], np.arange(len(xyz))
    named = register(xyz[used], measured[used])[0]
    pose = closest_points(xyz, measured[used], named, settings.min_icp_residual_ratio)
    _, nearest = cKDTree(xyz).query(pose.inverse().apply(measured))
    return pose, np.asarray(nearest, dtype=np.int64)


def closest_points(known: Floats, measured: Floats, named: Pose, min_ratio: float) -> Pose:
    """The motion by iterative closest point, from the principal axes in all 24 ways, whatever the names.

    Where a symmetric target fits in several ways, that which the names lead to is taken if it is one of them.

    Args:
        known: (n, 3) in the world.
        measured: (m, 3) in the rig's frame.
        named: measured_from_known by the names.
        min_ratio: Two ways are told apart where one leaves so many times what the other leaves.

    Returns:
        measured_from_known.

    Raises:
        FitError: The points can be matched in more than one way, and the names lead to none of these.
    """
    starts = [named, *_by_axes(known, measured)]
    found = sorted(((icp(known, measured, start), i) for i, start in enumerate(starts)), key=lambda one: one[0][1])
    least = max(found[0][0][1], 1e-9 * float(np.ptp(known)))
    alike = [(pose, i) for (pose, rms), i in found if rms <= min_ratio * least]
    for pose, i in alike:
        if i == 0:
            return pose
    best = alike[0][0]
    if any(np.abs(pose.rotation - best.rotation).max() > 0.02 for pose, _ in alike):
        raise FitError(
            "the known points can be matched by closeness in more than one way.",
            why="turned by a symmetry of their arrangement they fit as well, and their names fit none of it",
            fix="correct the names and use --align points",
        )
    return best


def _by_axes(known: Floats, measured: Floats) -> list[Pose]:
    """measured_from_known that bring principal axes onto principal axes, in all ways that are rotations."""
    a, b = known - known.mean(axis=0), measured - measured.mean(axis=0)
    axes_a, axes_b = (np.linalg.svd(x, full_matrices=False)[2] for x in (a, b))
    poses = []
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        rotation = axes_b.T @ (np.array(signs)[:, None] * axes_a[list(order)])
        if np.linalg.det(rotation) > 0:
            poses.append(Pose(rotation, measured.mean(axis=0) - rotation @ known.mean(axis=0)))
    return poses


def icp(known: Floats, measured: Floats, start: Pose) -> tuple[Pose, float]:
    """The motion by iterative closest point (Besl & McKay 1992): each measured point is matched with the known point
    closest to it.

    Args:
        known: (n, 3) in the world.
        measured: (m, 3) in the rig's frame.
        start: measured_from_known to begin with.

    Returns:
        measured_from_known, and the rms distance left; infinite for a start that leads nowhere.
    """
    tree, pose = cKDTree(known), start
    pairs = np.full(len(measured), -1)
    for _ in range(MAX_ROUNDS):
        _, nearest = tree.query(pose.inverse().apply(measured))
        if (nearest == pairs).all() or len(np.unique(nearest)) < 3:
            break
        pairs = np.asarray(nearest)
        try:
            pose, _ = register(known[pairs], measured)
        except FitError:  # all onto one line: a start that leads nowhere
            return pose, float("inf")
    distance, _ = tree.query(pose.inverse().apply(measured))
    return pose, float(np.sqrt(np.mean(np.square(distance))))


def _weighted(
    pose: Pose, measured: Floats, cov: Floats, xyz: Floats, sd: Floats, used: Bools, there: Bools
) -> tuple[Pose, Floats, Floats, Floats, Floats]:
    """The most probable motion, by Gauss-Newton: it, the inverse Q (6, 6) of the normal matrix, and for all points G
    (n, 3, 6), weights W (n, 3, 3) and residuals (n, 3) in the rig's frame; zero where not measured."""
    n = len(xyz)
    cov = np.where(there[:, None, None], cov, np.eye(3))
    for _ in range(4):
        declared = pose.rotation @ (sd[:, :, None] ** 2 * np.eye(3)) @ pose.rotation.T
        W = np.where(there[:, None, None], np.linalg.inv(cov + declared), 0)
        turned = xyz @ pose.rotation.T
        G = np.concatenate([-_cross(turned), np.broadcast_to(np.eye(3), (n, 3, 3))], axis=2)
        residual = np.where(there[:, None], measured - turned - pose.translation, 0)
        GtW = G.swapaxes(1, 2) @ W
        Q = np.linalg.inv(np.einsum("nai,nib->ab", GtW[used], G[used]))
        step = Q @ np.einsum("nai,ni->a", GtW[used], residual[used])
        pose = Pose(rotation_from_vector(step[:3]) @ pose.rotation, pose.translation + step[3:])
    residual = np.where(there[:, None], measured - pose.apply(xyz), 0)
    return pose, Q, G, W, residual


def _own_noise(B: Floats, point: Floats, pose: Pose, sd: Floats, shots: Names) -> Floats:
    """(6, 6) covariance of the motion from the pixels' noise of each point, and from the declared errors of the known
    ones: those of a shot are one error. B (m, 6, 3): how the motion follows each measured point."""
    total = np.einsum("nai,nij,nbj->ab", B, point, B)
    for shot in np.unique(shots):
        mine = shots == shot
        lever = B[mine].sum(axis=0) @ pose.rotation
        total += lever @ np.diag(np.mean(sd[mine] ** 2, axis=0)) @ lever.T
    return np.asarray(total, dtype=np.float64)


def left_out(pose: Pose, Q: Floats, G: Floats, W: Floats, residual: Floats, cov: Floats) -> tuple[Floats, Floats]:
    """Errors and standard deviations of the used points, each as if the motion came from the others.

    Args:
        pose: rig_from_world.
        Q: (6, 6) inverse of the normal matrix.
        G: (m, 3, 6) how the points follow the motion.
        W: (m, 3, 3) their weights.
        residual: (m, 3) in the rig's frame.
        cov: (m, 3, 3) covariances of the errors, in the rig's frame.

    Returns:
        Errors and sds (m, 3) in the world; of three points the errors are the residuals.
    """
    error = residual
    if len(residual) > 3:  # with three, two would be left: nothing to align with
        inside = np.eye(3) - G @ Q @ (G.swapaxes(1, 2) @ W)
        error = np.asarray(np.linalg.solve(inside, residual[..., None])[..., 0], dtype=np.float64)
    world = pose.rotation.T @ cov @ pose.rotation
    return error @ pose.rotation, np.sqrt(np.diagonal(world, axis1=1, axis2=2))


def extent_ratio(measured: Floats, xyz: Floats) -> float:
    """World over rig, the ratio of the extents: 1 where the board's square is right.

    Args:
        measured: (m, 3) in the rig's frame.
        xyz: (m, 3) the same points in the world.

    Returns:
        The ratio.
    """
    a, b = measured - measured.mean(axis=0), xyz - xyz.mean(axis=0)
    return float(np.sqrt(np.sum(b**2) / np.sum(a**2)))


def check_alignment(
    found: Alignment, residual: Floats, xyz: Floats, measured: Floats, extent: float, settings: ExplicitSettings
) -> None:
    """Stop where boards and known points are not of one rig, or not of one unit.

    Args:
        found: The motion.
        residual: (m, 3) of the points measured, in the rig's frame.
        xyz: (m, 3) where they are in the world.
        measured: (m, 3) where they are in the rig's frame.
        extent: Of the known points.
        settings: What is too much.

    Raises:
        FitError: Too much is left, or the scale is wrong; it says so if a mirror explains it.
    """
    rms = float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))
    most = settings.max_alignment_error_extents
    if rms < most * extent and abs(found.scale - 1) < most:
        return
    _, mirrored = register(xyz * np.array([1.0, 1.0, -1.0]), measured)
    if mirrored < settings.max_mirrored_ratio * min(rms, most * extent):
        raise FitError(
            f"the known points are as in a mirror: aligned, {rms:.3g} are left; with one axis turned, {mirrored:.2g}.",
            why="the pictures are flipped (webcams do so), v is counted from below, or the known positions are "
            "left-handed",
            fix="write width - 1 - u for u in observations.csv, or height - 1 - v for v, of boards and points; or turn "
            "the sign of one axis in points.csv",
        )
    raise FitError(
        f"the boards and the known points contradict each other: aligned, they are {rms:.3g} apart, the known points "
        f"extend over {extent:.3g}.",
        why=f"the known points are {found.scale:.4g} times as far apart as the boards say",
        fix="check the board's square, the length units, and the names and positions of the known points",
    )


def in_world(
    cameras: tuple[CentralCamera, ...], root: Floats, alignment: Alignment
) -> tuple[tuple[CentralCamera, ...], Floats]:
    """Cameras and the root of their covariance, seen from the world.

    Args:
        cameras: With their poses camera_from_rig.
        root: (q, P) of their covariance.
        alignment: The motion and its uncertainty.

    Returns:
        The cameras with poses camera_from_world, and the root (q + 6, P).
    """
    rig_from_world = alignment.rig_from_world
    moved, blocks, levers = [], [], []
    for camera in cameras:
        moved.append(CentralCamera(camera.lens, camera.pose @ rig_from_world))
        R = camera.pose.rotation
        own, lever = np.eye(camera.size), np.zeros((camera.size, 6))
        # x = Rc (Ra X + ta) + tc: turning the camera moves Rc ta along
        own[-3:, -6:-3] = -_cross((R @ rig_from_world.translation)[None])[0]
        lever[-6:-3, :3], lever[-3:, 3:] = R, R
        blocks.append(own)
        levers.append(lever)
    L = np.concatenate(levers)
    follow = block_diagonal(blocks) + L @ alignment.K
    values, vectors = np.linalg.eigh(alignment.own)
    half = (vectors * np.sqrt(np.maximum(values, 0))).T
    return tuple(moved), np.vstack([root @ follow.T, half @ L.T])


def in_frame(
    cameras: tuple[CentralCamera, ...], root: Floats, offset: Floats, scale: float
) -> tuple[tuple[CentralCamera, ...], Floats]:
    """Cameras and the root of their covariance, in a frame that is shifted and scaled.

    Args:
        cameras: With their poses camera_from_world.
        root: (q, P) of their covariance.
        offset: (3,) that is taken from points.
        scale: Which they are then divided by.

    Returns:
        The cameras, and the root (q, P).
    """
    moved, blocks = [], []
    for camera in cameras:
        turned = camera.pose.rotation @ offset
        moved.append(CentralCamera(camera.lens, Pose(camera.pose.rotation, (turned + camera.pose.translation) / scale)))
        own = np.eye(camera.size)
        own[-3:, -6:-3] = -_cross(turned[None])[0] / scale
        own[-3:, -3:] /= scale
        blocks.append(own)
    return tuple(moved), root @ block_diagonal(blocks).T


def block_diagonal(blocks: list[Floats]) -> Floats:
    """One matrix with the blocks along its diagonal.

    Args:
        blocks: Matrices of any sizes.

    Returns:
        The matrix, zero elsewhere.
    """
    return np.asarray(block_diag(*blocks), dtype=np.float64)


def _cross(v: Floats) -> Floats:
    """(n, 3, 3) matrices [v]x with [v]x w = v x w."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - out.swapaxes(1, 2)
