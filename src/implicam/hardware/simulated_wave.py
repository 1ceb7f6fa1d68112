"""Stands in for a person who waves a wand: goes where the pictures say, and waves it there, in all directions.

cameras, hand = simulated_wave(build_rig("bar6", seed=1), 96.0, seed=2)
hand.wave_at(uv); frame = cameras[0].frame()
"""

from __future__ import annotations

import time

import numpy as np

from implicam.errors import UsageError
from implicam.geometry import Pose, rotation_from_vector
from implicam.hardware.protocol import Floats
from implicam.hardware.simulated_hand import HandCamera, MovingHand
from implicam.simulate import Optics, Rig, Studio, Target
from implicam.simulate.targets import WAND_ENDS, WAND_JITTER_RATIO, WAND_SHARE

REACH_SHARE = 0.12
"""How far the middle of the wand goes to each side while it is waved at a place, over the volume's edges."""

ARMS_SHARE = 0.7
"""How far from the middle of the volume it goes along each axis, over the volume's edges: it is no farther reached."""

WAVES_PER_SECOND = np.array([0.17, 0.23, 0.13])
"""To and fro along each axis: slow enough for pictures that are hardly blurred."""

TURNS_PER_SECOND = np.array([0.11, 0.17, 0.07])
"""About each axis."""


class SimulatedWave(MovingHand):
    """Stands in for a person with a wand, two balls on a rod.

    Attributes:
        seconds: That it takes from one place to the next; 0 where nobody watches, and each set of pictures shows the
            wand somewhere else about its place.
    """

    def __init__(self, rig: Rig, length: float, *, seed: int, seconds: float = 0.0) -> None:
        self.length, self._bends = length, np.random.default_rng([seed, 33])
        ends = np.array([[-0.5, 0, 0], [0.5, 0, 0]]) * length
        first = Pose(np.eye(3), rig.volume.world_from_box.translation)
        super().__init__(rig, ends, first, seed=seed, seconds=seconds)
        self._unwatched = first

    def wave_at(self, uv: Floats) -> None:
        """Go to a place, as well as a hand can, and wave there.

        Args:
            uv: (cameras, 2) where it is in the pictures; NaN where it is not.
        """
        goal = _place_of(self.rig, uv)
        if goal is None:
            return
        box = self.rig.volume
        inside = box.world_from_box.inverse().apply(goal[None])[0] + 0.03 * box.size * self._rng.normal(size=3)
        goal = box.world_from_box.apply(np.clip(inside, -ARMS_SHARE * box.size, ARMS_SHARE * box.size)[None])[0]
        self._go_to(Pose(np.eye(3), goal))

    def shown(self, pose: Pose) -> Target:
        """The wand; its length is not the same in all pictures.

        Args:
            pose: world_from_wand, its ends along x.
        """
        bent = 1 + WAND_JITTER_RATIO * self._bends.normal()
        ends = pose.apply(bent * self.corners)
        names = np.array([f"held {end}" for end in WAND_ENDS])
        return Target("wand", names, np.array(["held", "held"]), ends, wand=self.length)

    def pose(self, when: float | None = None) -> Pose:
        """world_from_wand while it is waved, its ends along x.

        Args:
            when: As of time.monotonic(); None for now.
        """
        now = time.monotonic() if when is None else when
        if self.seconds <= 0:
            return self._unwatched
        box = self.rig.volume
        off = REACH_SHARE * box.size * np.sin(2 * np.pi * WAVES_PER_SECOND * now)
        turn = rotation_from_vector(2 * np.pi * np.sin(2 * np.pi * TURNS_PER_SECOND * now) * [0.3, 0.5, 0.5])
        return Pose(turn, self._carried(now).translation + box.world_from_box.rotation @ off)

    def _begin_set(self) -> None:
        """Somewhere else about its place, where nobody watches."""
        if self.seconds > 0:
            return
        box = self.rig.volume
        off = box.world_from_box.rotation @ (REACH_SHARE * box.size * self._rng.normal(size=3))
        turn = np.linalg.qr(self._rng.normal(size=(3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        self._unwatched = Pose(turn, self._to.translation + off)


def _place_of(rig: Rig, uv: Floats) -> Floats | None:
    """(3,) where lines of sight meet; on a single one, the place nearest to the middle of the volume."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for camera, pixel in zip(rig.cameras, uv, strict=True):
        if not np.isfinite(pixel).all():
            continue
        rays, _ = camera.ray_from_pixel(pixel[None])
        if not np.isfinite(rays).all():
            continue
        pose = camera.camera_from_world
        across = np.eye(3) - np.outer(along := rays[0] @ pose.rotation, along)
        A, b = A + across, b + across @ pose.centre
    if not A.any():
        return None
    weak = 1e-3 * np.eye(3)  # where one camera looks along its line, the middle of the volume says how far
    return np.asarray(np.linalg.solve(A + weak, b + weak @ rig.volume.world_from_box.translation), dtype=np.float64)


def simulated_wave(
    rig: Rig, length: float | None, *, seed: int, seconds: float = 0.0, optics: Optics | None = None
) -> tuple[list[HandCamera], SimulatedWave]:
    """Cameras, and somebody who waves a wand in front of them.

    Args:
        rig: The simulated rig.
        length: Between the ends, in the rig's unit; None for 0.6 of the volume's shortest edge.
        seed: Of the noise of the pictures, and of the hand.
        seconds: That it takes from one place to the next; 0 where nobody watches.
        optics: How the cameras take pictures; None for the usual.

    Returns:
        One camera for each of the rig's, in their order, and the hand.

    Raises:
        UsageError: The wand does not fit into the volume.
    """
    usual = WAND_SHARE * float(rig.volume.size.min()) if length is None else length
    if not 0 < usual < float(np.linalg.norm(rig.volume.size)):
        raise UsageError(
            f"a wand of {usual:g} {rig.length_unit} does not fit into the volume of this rig.",
            fix=f"it is {', '.join(f'{edge:g}' for edge in rig.volume.size)} {rig.length_unit} large",
        )
    hand = SimulatedWave(rig, usual, seed=seed, seconds=seconds)
    shown = hand.shown(hand.pose())
    studio = Studio(rig, shown, optics or Optics(), seed).showing(shown, seed=seed)
    return [HandCamera(studio, c, hand) for c in range(len(rig.cameras))], hand
