"""A world laid anew: where it is, how exactly that is known, and the cameras seen from there; eq. (V9).

A calibration without known positions has a world of its own. Something that its cameras measure says where another one
is: then the errors of these places, and not those of where the wand was, are what positions are uncertain by. Nothing
is fitted: distances and their uncertainties stay what they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from implicam.errors import FitError
from implicam.geometry import Floats, Pose, cross_matrices, vector_from_rotation
from implicam.gp.linalg import covariance_root
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.training_data import Frame

MAX_EXTENT_ERROR = 0.1
"""By which part the extent of known points may be off before anything else is looked at: it is no world."""

MAX_SCALE_SDS, MAX_SCALE_ERROR = 4.0, 0.02
"""By how many standard deviations a scale may be off before that is told, and by which part before it is no world."""

UNITS_APART = (1e-3, 1e-2, 0.1, 10.0, 100.0, 1e3, 25.4, 1 / 25.4, 304.8, 1 / 304.8, 0.3048, 1 / 0.3048)
"""Ratios of length units that are mistaken for each other; a scale that is one of them by 5 % is told so."""


def other_scale(ratio: float) -> FitError:
    """What to say where known points and a wand are of another scale.

    Args:
        ratio: Of known over measured distances.
    """
    if any(abs(ratio / factor - 1) < 0.05 for factor in UNITS_APART):
        why = "they and the length of the wand are not in one unit: the ratio is that of two length units"
        fix = "state the length unit of the known points (length_unit in dataset.toml, --unit), the wand's in the same"
    else:
        why = "the length of the wand, or the known positions, are wrong"
        fix = f"measure the wand: with these points it would be {ratio:.4g} times as long; check names and positions"
    return FitError(f"the known points are {ratio:.4g} times as far apart as the wand says.", why=why, fix=fix)


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a new world is.

    Attributes:
        new_from_old: The motion, in the length unit.
        middle: (3,) in the old world, about which the step of this motion turns.
        follows: (6, q) how the step (a turn about the middle in radians, then a shift; in the axes of the old world)
            follows the standard normal numbers z that all measured points share: est. less true, as their errors.
        own: (6, 6) its covariance besides: what was measured has noise of its own, and known positions have errors.
    """

    new_from_old: Pose
    middle: Floats
    follows: Floats
    own: Floats

    def sd_at(self, xyz: Floats) -> Floats:
        """What the measuring of the world itself makes uncertain at places.

        Args:
            xyz: (n, 3) in the old world.

        Returns:
            (n,) root of the mean variance of x, y and z, in the length unit.
        """
        motion = motions_about(xyz, self.middle)
        variance = np.einsum("nik,kl,nil->n", motion, self.own, motion)
        return np.asarray(np.sqrt(np.maximum(variance, 0) / 3), dtype=np.float64)


def motions_about(xyz: Floats, middle: Floats) -> Floats:
    """How places move by a turn about a middle, and a shift.

    Args:
        xyz: (n, 3).
        middle: (3,).

    Returns:
        (n, 3, 6).
    """
    shift = np.broadcast_to(np.eye(3), (len(xyz), 3, 3))
    return np.concatenate([-cross_matrices(xyz - middle), shift], axis=2)


def step_between(before: Pose, after: Pose, middle: Floats) -> Floats:
    """The small motion of places after which the one pose does what the other does without it.

    Args:
        before: New_from_old.
        after: One that differs little from it.
        middle: (3,) about which the step turns.

    Returns:
        (6,) turn and shift.
    """
    turn = vector_from_rotation(before.rotation.T @ after.rotation)
    return np.concatenate([turn, before.rotation.T @ (after.apply(middle) - before.apply(middle))])


def placement_at_camera(
    posterior: Posterior, frame: Frame, number: int, camera_from_world: Pose, middle: Floats
) -> Placement:
    """The world of a camera: its centre and its axes.

    Args:
        posterior: What is known of the cameras, all tied.
        frame: The working frame.
        number: Of the camera in the posterior.
        camera_from_world: Where it is, its field taken into account: of the lens nearest to all that was learned.
        middle: (3,) as of `Placement`.
    """
    camera = posterior.models[number].camera

    def from_world(pose: Pose) -> Pose:  # in the length unit
        return Pose(pose.rotation, frame.scale * pose.translation - pose.rotation @ frame.offset)

    here = from_world(camera.pose)  # type: ignore[union-attr]  # those without a pose are told apart by the caller
    h, slopes = 1e-6, []
    for i in range(camera.size):
        step = np.zeros(camera.size)
        step[i] = h
        both = [from_world(camera.moved(sign * step).pose) for sign in (1.0, -1.0)]  # type: ignore[union-attr]
        slopes.append((step_between(here, both[0], middle) - step_between(here, both[1], middle)) / (2 * h))
    # z are of the true cameras less the fitted ones
    return Placement(
        camera_from_world, middle, -np.array(slopes).T @ posterior.root(number)[:, : camera.size].T, np.zeros((6, 6))
    )  # fmt: skip


def placed(posterior: Posterior, frame: Frame, placement: Placement, moves: Floats) -> tuple[Posterior, Frame]:
    """The cameras in a new world.

    Args:
        posterior: What is known of them, all tied.
        frame: The working frame.
        placement: Where the new world is.
        moves: (P, 6) how the numbers of all cameras change when all places turn about the middle of the placement, and
            shift, in the working frame.

    Returns:
        The same cameras in a working frame that turns with the world and has its middle where it was; so of a camera
        only the rotation changes, and what is known of its numbers is known of the same numbers.
    """
    if posterior.joint is None:
        raise ValueError("the cameras of a calibration without known positions are tied")
    unit = np.repeat([1.0, 1 / frame.scale], 3)[:, None]
    half = covariance_root(unit * placement.own * unit.T)
    parts = [posterior.joint - (moves @ (unit * placement.follows)).T, (moves @ half).T]
    root = np.linalg.qr(np.concatenate(parts), mode="r")
    turn = placement.new_from_old.rotation
    back = Pose(turn.T, np.zeros(3))
    models = []
    for model in posterior.models:
        camera = model.camera.in_frame(back)
        field_camera = camera if model.field_camera is model.camera else model.field_camera.in_frame(back)
        models.append(replace(model, camera=camera, field_camera=field_camera))
    off = None if posterior.displacement is None else posterior.displacement @ turn.T
    moved = replace(posterior, models=tuple(models), joint=np.ascontiguousarray(root), displacement=off)
    return moved, Frame(placement.new_from_old.apply(frame.offset), frame.scale)
