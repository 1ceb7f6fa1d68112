"""A calibration after one of its cameras has moved, from the views that showed it; eq. (M4) of docs/method.md.

The camera is taken to where it stands now, its lens and its residual field with it. Its new pose is known as well as
the other cameras could tell, so from now on its errors and theirs are one: what is unknown of all cameras is written
anew, with the seven numbers of the movement besides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from implicam.geometry import Bools, Floats, Pose
from implicam.gp.linalg import covariance_root
from implicam.rig_model.camera_model import CameraModel
from implicam.rig_model.movement import NUMBERS, PRIOR_SDS, Check, CheckedRig, Evidence, Motion, Stand, see_moved
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.triangulate import predict_covariance

GRID_SIDES, DISTANCES = 12, 4
"""Pixels along a side, and points along each line of sight, at which parameters before and after are compared."""
NEARER, FARTHER = 0.7, 1.4
"""Of the distances of the points that showed the movement."""


@dataclass(frozen=True, eq=False)
class Repair:
    """How one camera moved, and what is unknown of that; in the working frame.

    Attributes:
        camera: Its number in the posterior.
        motion: What it did.
        shared: (q, 7) how the error of the movement follows from the q white unknowns of all cameras, in the order of
            `CheckedRig.roots`.
        own: (7, 7) root W of what is unknown of it besides, W^T W.
        distances: (2,) between which the points were, from the camera.
        told: In words: which camera, how far, and from which data that is known.
    """

    camera: int
    motion: Motion
    shared: Floats
    own: Floats
    distances: Floats
    told: str = ""


def white_unknowns(posterior: Posterior) -> int:
    """How many white unknowns all cameras have together, in the order of `CheckedRig.roots`.

    Args:
        posterior: What is known of the cameras.
    """
    if posterior.tied:
        return len(posterior.root(0))
    return sum(len(root) for root in posterior.alone)


def find_repair(check: Check, one: Evidence, told: str) -> Repair:
    """What the check knows of a movement and of its error.

    Args:
        check: Of the rig.
        one: Of the camera that moved.
        told: In words, for those who use the calibration.
    """
    rig = check.rig
    rows = np.flatnonzero(one.seen.any(axis=1))
    motions = [one.motion if c == one.camera else Motion() for c in range(len(rig.stands))]
    found = rig.select(rows).equations(motions, one.x[rows], one.seen[rows])
    factor = np.linalg.cholesky(np.eye(len(found.left)) + found.half @ found.half.T)
    mine = found.by_step[:, NUMBERS * one.camera : NUMBERS * (one.camera + 1)]
    X = solve_triangular(factor, mine, lower=True)
    information = X.T @ X + np.diag(1 / PRIOR_SDS**2)
    gain = np.linalg.solve(information, solve_triangular(factor, X, lower=True, trans="T").T)  # (7, N)
    noise = max(check.noise_ratio, 1.0)
    seen = rows[one.seen[rows, one.camera]]
    away = np.linalg.norm(one.x[seen] - rig.stands[one.camera].centre - one.motion.shift, axis=1)
    return Repair(
        one.camera,
        one.motion,
        -(gain @ found.half).T,
        noise * covariance_root(gain @ gain.T).T,
        np.array([away.min(), away.max()]),
        told,
    )


def repaired(posterior: Posterior, repair: Repair) -> Posterior:
    """What is known of all cameras, the one that moved where it stands now.

    Args:
        posterior: As calibrated, or as repaired before.
        repair: Of the movement since.
    """
    c = repair.camera
    model = posterior.models[c]
    stand = Stand.of(model)
    after = move_model(model, stand, repair.motion)
    by_old, by_step = _parameters_after(model, after, stand, repair)
    old = np.eye(model.size)
    old[: len(by_old), : len(by_old)] = by_old
    step = np.zeros((NUMBERS, model.size))
    step[:, : by_step.shape[1]] = by_step
    models = (*posterior.models[:c], after, *posterior.models[c + 1 :])
    added = repair.own @ step
    if posterior.joint is not None:
        return _joined(posterior, models, c, old, repair.shared @ step, added)
    return _tied(posterior, models, c, old, step, repair.shared, added)


def _joined(
    posterior: Posterior, models: tuple[CameraModel, ...], c: int, old: Floats, through: Floats, added: Floats
) -> Posterior:
    """One root of all cameras stays one root, with seven rows more."""
    assert posterior.joint is not None
    start, end = posterior.offsets[c : c + 2]
    joint = np.concatenate([posterior.joint, np.zeros((NUMBERS, posterior.joint.shape[1]))])
    joint[: len(through), start:end] = joint[: len(through), start:end] @ old + through
    joint[len(through) :, start:end] = added
    unknowns = posterior.unknowns
    if unknowns is not None:
        cross = np.concatenate([unknowns.cross, np.zeros((NUMBERS, unknowns.cross.shape[1]))])
        unknowns = unknowns._replace(cross=cross)
    return replace(posterior, models=models, joint=joint, unknowns=unknowns)


def _tied(
    posterior: Posterior, models: tuple[CameraModel, ...], c: int, old: Floats, step: Floats, shared: Floats,
    added: Floats,
) -> Posterior:  # fmt: skip
    """Of each camera's own unknowns only the part that the movement's error follows from becomes a tie."""
    offsets = posterior.offsets
    before = np.zeros((0, offsets[-1])) if posterior.ties is None else posterior.ties
    lengths = [len(root) for root in posterior.alone]
    parts = np.split(shared, np.cumsum(lengths))
    mine = slice(offsets[c], offsets[c + 1])
    ties = before.copy()
    ties[:, mine] = before[:, mine] @ old + parts[-1] @ step
    alone, rows, basis = [], [ties], []
    for number, root in enumerate(posterior.alone):
        Q = np.linalg.qr(parts[number])[0]  # (rows, 7)
        own = slice(offsets[number], offsets[number + 1])
        tie, rest = Q.T @ root, root - Q @ (Q.T @ root)
        tied = np.zeros((Q.shape[1], offsets[-1]))
        tied[:, own] = tie @ old if number == c else tie
        tied[:, mine] += Q.T @ parts[number] @ step
        alone.append(_square_root(rest @ old if number == c else rest))
        rows.append(tied)
        basis.append(Q)
    last = np.zeros((NUMBERS, offsets[-1]))
    last[:, mine] = added
    unknowns = posterior.unknowns
    if unknowns is not None:
        cross = np.split(unknowns.cross, np.cumsum(lengths))
        own_cross = [Q.T @ part for Q, part in zip(basis, cross[:-1], strict=True)]
        left = [part - Q @ tie for Q, part, tie in zip(basis, cross[:-1], own_cross, strict=True)]
        unknowns = unknowns._replace(
            cross=np.concatenate([*left, cross[-1], *own_cross, np.zeros((NUMBERS, unknowns.cross.shape[1]))])
        )
    return replace(posterior, models=models, alone=tuple(alone), ties=np.concatenate([*rows, last]), unknowns=unknowns)


def _square_root(root: Floats) -> Floats:
    """(P, P) with the same W^T W; a root of as many rows stays, for others refer to these."""
    rows, size = root.shape
    if rows == size:
        return root
    found = np.zeros((size, size))
    R = np.linalg.qr(root, mode="r")
    found[: len(R)] = R
    return found


def move_model(model: CameraModel, stand: Stand, motion: Motion) -> CameraModel:
    """The camera after a movement: it sees what `see_moved` says.

    Args:
        model: The camera as it was calibrated.
        stand: Where it stood.
        motion: How it moved.
    """
    back = motion.rotation.T
    pose = Pose(back, stand.centre - back @ (stand.centre + motion.shift))
    camera, ruler = (one.in_frame(pose) for one in (model.camera, model.field_camera))
    grown = 1 + motion.zoom
    return replace(model, camera=camera.zoomed(grown, stand.middle), field_camera=ruler, signal=grown * model.signal)


def _parameters_after(model: CameraModel, after: CameraModel, stand: Stand, repair: Repair) -> tuple[Floats, Floats]:
    """(p, p) and (7, p): the steps of the camera's parameters where it stands now that show in its picture as steps of
    its parameters before, and as steps of the movement."""
    half, centre = model.image.half, model.image.centre
    sides = np.linspace(-1, 1, GRID_SIDES)
    uv = centre + half * np.stack(np.meshgrid(sides, sides), axis=-1).reshape(-1, 2)
    start, rays = after.camera.lines(uv)
    rays = rays[np.isfinite(rays).all(axis=1)]
    distances = np.geomspace(NEARER * repair.distances[0], FARTHER * repair.distances[1], DISTANCES)
    points = start + (distances[:, None, None] * rays).reshape(-1, 3)
    off = points - stand.centre - repair.motion.shift
    grown = 1 + repair.motion.zoom
    J = after.camera.view(points).by_parameters
    J_before = grown * model.camera.view(off @ repair.motion.rotation + stand.centre).by_parameters
    by_step = see_moved(model, stand, repair.motion, points).by_step
    wanted = np.concatenate([J_before, by_step], axis=2)
    good = np.isfinite(J).all(axis=(1, 2)) & np.isfinite(wanted).all(axis=(1, 2))
    A, b = J[good].reshape(-1, J.shape[2]), wanted[good].reshape(-1, wanted.shape[2])
    sizes = np.linalg.norm(A, axis=0)
    sizes = np.where(sizes > 0, sizes, 1.0)
    found = np.linalg.lstsq(A / sizes, b, rcond=1e-12)[0] / sizes[:, None]
    p = J.shape[2]
    return found[:, :p].T, found[:, p:].T


def errors_with_and_without(rig: CheckedRig, after: Posterior, one: Evidence) -> tuple[Floats, Floats, Floats]:
    """What the movement costs: standard uncertainties of the points that showed it.

    Args:
        rig: As calibrated.
        after: As repaired.
        one: Of the camera that moved.

    Returns:
        (n,) each, in the working frame, root of the mean variance of the three axes: as if the camera had not moved;
        as repaired; without the camera. NaN where too few views are left.
    """
    rows = np.flatnonzero(one.seen.any(axis=1))
    x, noise, seen = one.x[rows], rig.noise[rows], one.seen[rows]
    without: Bools = seen.copy()
    without[:, one.camera] = False

    def sizes(posterior: Posterior, used: Bools) -> Floats:
        cov = predict_covariance(posterior, x, noise, used)
        return np.asarray(np.sqrt(np.trace(cov, axis1=1, axis2=2) / 3), dtype=np.float64)

    return sizes(rig.posterior, seen), sizes(after, seen), sizes(rig.posterior, without)


def all_repaired(posterior: Posterior, repairs: Sequence[Repair]) -> Posterior:
    """After one movement after the other.

    Args:
        posterior: As calibrated.
        repairs: In the order of time.
    """
    for repair in repairs:
        posterior = repaired(posterior, repair)
    return posterior
