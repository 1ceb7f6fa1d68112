"""Where the world is: the covariance of the cameras, and what it is relative to, eqs. (V7) and (V8).

No view and no length says where the world is. An adjustment holds something, such as the pose of a camera; what that
leaves uncertain is uncertain relative to it. The S-transformation (Baarda 1973) tells the same relative to something
else: here to all places of the wand together, as least squares would lay them over the true ones. So errors are
smallest where the wand was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from implicam.calibrators.forward_gp.wand.bundle import FrameEquations
from implicam.geometry import Bools, Floats, Pose, cross_matrices, rotation_from_vector, vector_from_rotation
from implicam.rig_model import CameraModel, CentralCamera, GeneralCamera, Posterior, solve_normal
from implicam.rig_model.camera import ProjectiveCamera
from implicam.rig_model.general_camera import AnyCamera
from implicam.rig_model.normal_equations import name_failing_camera


def posterior_in_gauge(
    models: Sequence[CameraModel],
    places: Floats,
    anchors: Bools,
    equations: FrameEquations,
    root: Floats,
    length_sd: float,
) -> Posterior:
    """What is known of the cameras, in a world that is laid over the anchors.

    Args:
        models: The cameras at the optimum.
        places: (F, 2, 3).
        anchors: (2 F,) the places that say where the world is.
        equations: At the optimum, priors included.
        root: (P, P) of the covariance of the cameras, with whatever was held.
        length_sd: Relative sd of the length of the wand, an error that all frames share.

    Returns:
        All cameras tied.
    """
    flat, F, P = places.reshape(-1, 3), len(places), root.shape[1]
    middle = flat[anchors].mean(axis=0)
    lever = flat - middle
    motion = np.zeros((2 * F, 3, 6))  # of a place, by a turn about the middle and a shift
    motion[:, :, :3], motion[:, :, 3:] = -cross_matrices(lever), np.eye(3)
    motion[~anchors] = 0.0
    onto = np.linalg.inv(np.einsum("nki,nkj->ij", motion, motion)) @ motion.reshape(-1, 6).T  # (6, 6 F)
    # places follow the cameras by -H^-1 G, and have the error of their own views besides
    scale = 1 / np.sqrt(np.einsum("fii->fi", equations.H))
    inverse = np.linalg.inv(equations.H * scale[:, :, None] * scale[:, None, :]) * scale[:, :, None] * scale[:, None, :]
    by_frame = onto.reshape(6, F, 6).swapaxes(0, 1)  # (F, 6, 6)
    follow = -np.einsum("fki,fij,fjp->kp", by_frame, inverse, equations.G, optimize=True)  # (6, P)
    own = np.einsum("fki,fij,flj->kl", by_frame, inverse, by_frame, optimize=True)  # (6, 6)
    N = cameras_move_with_the_world(models, middle)  # (P, 6): how the cameras' numbers change when the world is moved
    # the world is moved so that the anchors stay
    turned = root @ (np.eye(P) - N @ follow).T
    lower = np.linalg.cholesky(0.5 * (own + own.T) + 1e-15 * np.trace(own) * np.eye(6))
    parts = [turned, (N @ lower).T]
    if length_sd > 0:
        parts.append(length_sd * cameras_grow_with_the_world(models, middle)[None])
    return posterior_of(models, equations, np.concatenate(parts))


def posterior_of(models: Sequence[CameraModel], equations: FrameEquations, root: Floats) -> Posterior:
    """All cameras tied.

    Args:
        models: The cameras at the optimum.
        equations: At the optimum, priors included.
        root: (q, P or more) of the covariance of the cameras; unknowns beside theirs come last.
    """
    starts = np.concatenate([[0], np.cumsum([model.size for model in models])])
    joint = np.linalg.qr(root[:, : starts[-1]], mode="r")  # of as many rows as unknowns
    alone = []
    for c, (start, end) in enumerate(pairwise(starts)):
        own = equations.A[start:end, start:end]
        with name_failing_camera(c):
            alone.append(solve_normal(own, np.zeros(len(own)))[0])
    return Posterior(tuple(models), tuple(alone), np.ascontiguousarray(joint), (), 0.0)


def cameras_move_with_the_world(models: Sequence[CameraModel], middle: Floats) -> Floats:
    """How the numbers of all cameras change when all places turn about the middle, and shift.

    Args:
        models: The cameras.
        middle: (3,).

    Returns:
        (P, 6), by a turn (radians) and a shift.
    """
    h = 1e-6
    columns = []
    for d in h * np.eye(6):
        both = []
        for sign in (1.0, -1.0):
            turn = rotation_from_vector(sign * d[:3])
            # places x become turn (x - middle) + middle + shift; a camera that sees them as before looks back
            forth = Pose(turn, middle - turn @ middle + sign * d[3:])
            both.append([_step(model.camera, model.camera.in_frame(forth.inverse())) for model in models])
        slopes = [(one - two) / (2 * h) for one, two in zip(*both, strict=True)]
        columns.append(np.concatenate([_padded(slope, model) for slope, model in zip(slopes, models, strict=True)]))
    return np.array(columns).T


def cameras_grow_with_the_world(models: Sequence[CameraModel], middle: Floats) -> Floats:
    """How they change when the world grows about the middle.

    Args:
        models: The cameras.
        middle: (3,).

    Returns:
        (P,), by a relative growth.
    """
    h, out = 1e-6, []
    for model in models:
        # x grows to middle + s (x - middle): R x + T becomes s times itself where T' = s T + (s - 1) R middle
        camera = _posed(model.camera)
        by = camera.pose.translation + camera.pose.rotation @ middle
        both = [replace(camera, pose=Pose(camera.pose.rotation, camera.pose.translation + d * by)) for d in (h, -h)]
        out.append(_padded((_step(camera, both[0]) - _step(camera, both[1])) / (2 * h), model))
    return np.concatenate(out)


def _posed(camera: AnyCamera) -> CentralCamera | GeneralCamera:
    assert not isinstance(camera, ProjectiveCamera)  # a wand is never fitted with one
    return camera


def _step(before: AnyCamera, after: AnyCamera) -> Floats:
    """(p,) the step from one camera to another of the same lens that is elsewhere."""
    one, two = _posed(before), _posed(after)
    step = two.parameters - one.parameters
    turn = vector_from_rotation(two.pose.rotation @ one.pose.rotation.T)
    if isinstance(one, GeneralCamera):
        step[-3:] = turn
    else:
        step[-6:-3], step[-3:] = turn, two.pose.translation - one.pose.translation
    return step


def _padded(slope: Floats, model: CameraModel) -> Floats:
    """With the weights of the field, which do not change."""
    return np.concatenate([slope, np.zeros(model.size - len(slope))])
