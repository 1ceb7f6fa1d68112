"""From the rig's own frame to the world: the rigid motion that brings measured points onto known ones.

With known correspondences in closed form (geometry.register), then weighted by what each point is worth; or, as in the
paper, by iterative closest point. Its uncertainty goes into the cameras': a rig that is turned a little measures wrong.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial import cKDTree

from implicam.calibrators.forward_gp.lens import CentralCamera, Floats
from implicam.calibrators.forward_gp.posterior import CameraModel
from implicam.errors import FitError
from implicam.geometry import Bools, Pose, register, rotation_from_vector
from implicam.measurement import Measurement

FAR = 25.0
"""Squared distance, in its own covariance, of a known point from where it should be: one in 65,000 of good ones."""

MATCHING = ("points", "icp")

ROUNDS = 60


class Alignment(NamedTuple):
    """rig_from_world; used (n,) the known points it comes from; K (6, P) how its step (rotation vector, translation)
    follows errors of the cameras' unknowns, and own (6, 6) its covariance from the points' own noise; errors and sds
    (m, 3) of the used points in the world, each left out in turn."""

    rig_from_world: Pose
    used: Bools
    K: Floats
    own: Floats
    errors: Floats
    sds: Floats


def align(
    models: tuple[CameraModel, ...], uv: Floats, noise: Floats, measured: Measurement, xyz: Floats, sd: Floats, how: str
) -> Alignment:
    """models: cameras in the rig's frame. uv (n, C, 2) and noise (n, C): their views of the known points xyz (n, 3),
    whose declared sd is (n, 3); measured: these points in the rig's frame. FitError where they do not fix a motion."""
    there = np.asarray(measured.measured, dtype=np.bool_)
    used = there
    if used.sum() < 3:
        raise FitError(
            f"{used.sum()} known points can be measured with the boards' calibration; it takes three to align it.",
            fix="add known points that two cameras see, or leave out points.csv to measure in the first camera's frame",
        )
    point, M = _sensitivities(models, uv, noise, measured.xyz, used)
    for _ in range(8):
        pose = _matched(measured.xyz, xyz, used, how)
        pose, Q, G, W, residual = _weighted(pose, measured, xyz, sd, used, there)
        distance = np.einsum("ni,nij,nj->n", residual, W, residual)
        good = there & (distance <= max(FAR, float(np.quantile(distance[used], 0.9))))
        if good.sum() < 3 or (good == used).all():
            break
        used = good
    GtW = G.swapaxes(1, 2) @ W
    declared = np.nan_to_num(sd)[:, :, None] ** 2 * np.eye(3)
    declared = pose.rotation @ declared @ pose.rotation.T
    own = Q @ np.einsum("nai,nij,nbj->ab", GtW[used], (point + declared)[used], GtW[used]) @ Q.T
    K = Q @ np.einsum("nai,nip->ap", GtW[used], M[used])
    errors, sds = _left_out(pose, Q, G, W, residual, measured.cov, own, used)
    return Alignment(pose, used, K, own, errors, sds)


def _matched(measured: Floats, xyz: Floats, used: Bools, how: str) -> Pose:
    """rig_from_world in closed form, from named pairs or from the closest ones."""
    pose, _ = register(xyz[used], measured[used])
    return pose if how == "points" else icp(xyz, measured[used], pose)


def icp(known: Floats, measured: Floats, start: Pose) -> Pose:
    """measured_from_known by iterative closest point (Besl & McKay 1992): each measured point (m, 3) is matched with
    the known point (n, 3) closest to it, whatever its name."""
    tree, pose = cKDTree(known), start
    pairs = np.full(len(measured), -1)
    for _ in range(ROUNDS):
        _, nearest = tree.query(pose.inverse().apply(measured))
        if (nearest == pairs).all():
            break
        pairs = np.asarray(nearest)
        pose, _ = register(known[pairs], measured)
    return pose


def _weighted(
    pose: Pose, measured: Measurement, xyz: Floats, sd: Floats, used: Bools, there: Bools
) -> tuple[Pose, Floats, Floats, Floats, Floats]:
    """The most probable motion, by Gauss-Newton: it, the inverse Q (6, 6) of the normal matrix, and for all points G
    (n, 3, 6), weights W (n, 3, 3) and residuals (n, 3) in the rig's frame; zero where not measured."""
    n = len(xyz)
    cov = np.where(there[:, None, None], measured.cov, np.eye(3))
    for _ in range(4):
        declared = pose.rotation @ (np.nan_to_num(sd)[:, :, None] ** 2 * np.eye(3)) @ pose.rotation.T
        W = np.where(there[:, None, None], np.linalg.inv(cov + declared), 0)
        turned = xyz @ pose.rotation.T
        G = np.concatenate([-_cross(turned), np.broadcast_to(np.eye(3), (n, 3, 3))], axis=2)
        residual = np.where(there[:, None], measured.xyz - turned - pose.translation, 0)
        GtW = G.swapaxes(1, 2) @ W
        Q = np.linalg.inv(np.einsum("nai,nib->ab", GtW[used], G[used]))
        step = Q @ np.einsum("nai,ni->a", GtW[used], residual[used])
        pose = Pose(rotation_from_vector(step[:3]) @ pose.rotation, pose.translation + step[3:])
    residual = np.where(there[:, None], measured.xyz - pose.apply(xyz), 0)
    return pose, Q, G, W, residual


def _sensitivities(
    models: tuple[CameraModel, ...], uv: Floats, noise: Floats, xyz: Floats, used: Bools
) -> tuple[Floats, Floats]:
    """(n, 3, 3) covariance of a measured point from its own pixels' noise, and (n, 3, P) how it follows errors of the
    cameras' unknowns; zero where not used."""
    n, total = len(xyz), sum(model.camera.size for model in models)
    H, back = np.zeros((n, 3, 3)), np.zeros((n, 3, total))
    start = 0
    for c, model in enumerate(models):
        rows = np.flatnonzero(used & np.isfinite(uv[:, c]).all(axis=1))
        view = model.camera.view(xyz[rows])
        weight = 1 / noise[rows, c] ** 2
        Jt = view.by_point.swapaxes(1, 2) * weight[:, None, None]
        H[rows] += Jt @ view.by_point
        back[rows, :, start : start + model.camera.size] = -Jt @ view.by_parameters
        start += model.camera.size
    point = np.zeros((n, 3, 3))
    point[used] = np.linalg.inv(H[used])
    return point, point @ back


def _left_out(
    pose: Pose, Q: Floats, G: Floats, W: Floats, residual: Floats, cov: Floats, own: Floats, used: Bools
) -> tuple[Floats, Floats]:
    """Errors and sds (m, 3) in the world of the used points, each as if the motion came from the others."""
    inside = np.eye(3) - G[used] @ Q @ (G[used].swapaxes(1, 2) @ W[used])
    error = np.linalg.solve(inside, residual[used, :, None])[..., 0]
    spread = cov[used] + G[used] @ own @ G[used].swapaxes(1, 2)
    world = pose.rotation.T @ spread @ pose.rotation
    return error @ pose.rotation, np.sqrt(np.diagonal(world, axis1=1, axis2=2))


def in_world(
    cameras: tuple[CentralCamera, ...], root: Floats, alignment: Alignment
) -> tuple[tuple[CentralCamera, ...], Floats]:
    """Cameras (camera_from_rig) and the root (q, P) of their covariance, seen from the world."""
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
    """Cameras and the root of their covariance, for points of which `offset` is taken, then divided by `scale`."""
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
    """One matrix with the blocks along its diagonal."""
    return np.asarray(block_diag(*blocks), dtype=np.float64)


def _cross(v: Floats) -> Floats:
    """(n, 3, 3) matrices [v]x with [v]x w = v x w."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - out.swapaxes(1, 2)
