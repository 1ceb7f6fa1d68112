"""A world laid anew: where it is, how exactly that is known, and the cameras seen from there; eq. (V9).

A calibration without known positions has a world of its own. Something that its cameras measure says where another one
is: then the errors of these places, and not those of where the wand was, are what positions are uncertain by. Nothing
is fitted: distances and their uncertainties stay what they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from implicam.errors import FitError
from implicam.geometry import Floats, Pose, cross_matrices, vector_from_rotation
from implicam.gp.linalg import covariance_root
from implicam.rig_model.camera import CentralCamera
from implicam.rig_model.general_camera import GeneralCamera
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
    camera: CentralCamera | GeneralCamera, root: Floats, frame: Frame, camera_from_world: Pose, middle: Floats
) -> Placement:
    """The world of a camera: its centre and its axes.

    Args:
        camera: As it was fitted, in the working frame.
        root: (q, p or more) of the covariance of its numbers, of all tied cameras the same rows.
        frame: The working frame.
        camera_from_world: Where it is, its field taken into account: of the lens nearest to all that was learned.
        middle: (3,) as of `Placement`.
    """

    def from_world(pose: Pose) -> Pose:  # in the length unit
        return Pose(pose.rotation, frame.scale * pose.translation - pose.rotation @ frame.offset)

    here, h, slopes = from_world(camera.pose), 1e-6, []
    for i in range(camera.size):
        step = np.zeros(camera.size)
        step[i] = h
        both = [from_world(camera.moved(sign * step).pose) for sign in (1.0, -1.0)]
        slopes.append((step_between(here, both[0], middle) - step_between(here, both[1], middle)) / (2 * h))
    # z are of the true cameras less the fitted ones
    return Placement(camera_from_world, middle, -np.array(slopes).T @ root[:, : camera.size].T, np.zeros((6, 6)))


class WorldStep(NamedTuple):
    """How a world that was laid anew is uncertain against that of the fit: a step of the motion about the origin of the
    working frame, in its axes and unit; follows (6, q) the standard normal numbers z of the fit's root, and has own (6,
    6) covariance besides."""

    follows: Floats
    own: Floats

    @property
    def half(self) -> Floats:
        """(6, 6) a root of `own`: half half^T."""
        return covariance_root(self.own)

    def shared(self, xyz: Floats, E: Floats) -> Floats:
        """What errors share in this world.

        Args:
            xyz: (n, 3) places in the working frame.
            E: (n, 3, q) of their errors in the world of the fit.

        Returns:
            (n, 3, q + 6).
        """
        G = motions_about(xyz, np.zeros(3))
        return np.concatenate([E + G @ self.follows, G @ self.half], axis=2)

    def covariance(self, xyz: Floats, E: Floats, cov: Floats) -> Floats:
        """The covariance of places in this world.

        Args:
            xyz: (n, 3) places in the working frame.
            E: (n, 3, q) of their errors in the world of the fit.
            cov: (n, 3, 3) there.

        Returns:
            (n, 3, 3).
        """
        now = self.shared(xyz, E)
        return np.asarray(cov - E @ E.swapaxes(1, 2) + now @ now.swapaxes(1, 2), dtype=np.float64)

    def root(self, joint: Floats, moves: Floats) -> Floats:
        """(q + 6, P) of the covariance of all cameras in this world.

        Args:
            joint: (q, P) in the world of the fit.
            moves: (P, 6) how the numbers of all cameras change when all places turn about the origin of the working
                frame, and shift.
        """
        return np.concatenate([joint - (moves @ self.follows).T, (moves @ self.half).T])


def lay_anew(
    posterior: Posterior, frame: Frame, before: WorldStep | None, placement: Placement
) -> tuple[Posterior, Frame, WorldStep]:
    """The cameras in a new world.

    Args:
        posterior: What the fit knows of them, all tied, in the world of the fit but the axes of now.
        frame: The working frame.
        before: How the world of now is uncertain against that of the fit; None where it is that.
        placement: Where the new world is, seen from that of now.

    Returns:
        The same, in a working frame that turns with the world and has its middle where it was: of a camera only the
        rotation changes, and what is known of its numbers is known of the same numbers.
    """
    if posterior.joint is None:
        raise ValueError("the cameras of a calibration without known positions are tied")
    q, middle = len(posterior.joint), frame.to_working(placement.middle)
    about_origin = np.eye(6)
    about_origin[3:, :3], about_origin[3:, 3:] = cross_matrices(middle[None])[0], np.eye(3) / frame.scale
    follows, own = about_origin @ placement.follows, about_origin @ placement.own @ about_origin.T
    if before is not None:
        half = before.half + follows[:, q:]
        follows, own = before.follows + follows[:, :q], half @ half.T + own
    turn = placement.new_from_old.rotation
    both = np.zeros((6, 6))
    both[:3, :3], both[3:, 3:] = turn, turn
    back = Pose(turn.T, np.zeros(3))
    models = []
    for model in posterior.models:
        camera = model.camera.in_frame(back)
        field_camera = camera if model.field_camera is model.camera else model.field_camera.in_frame(back)
        models.append(replace(model, camera=camera, field_camera=field_camera))
    off = None if posterior.displacement is None else posterior.displacement @ turn.T
    moved = replace(posterior, models=tuple(models), displacement=off)
    there = Frame(placement.new_from_old.apply(frame.offset), frame.scale)
    return moved, there, WorldStep(both @ follows, both @ own @ both.T)
