"""Stands in for hardware: a simulated robot that holds a ball, and cameras that photograph it where it is now.

cameras, robot = simulated_rig(build_rig("bar6", seed=1), seed=2)
robot.move(xyz); frame = cameras[0].frame()
"""

from __future__ import annotations

import threading
import time
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from implicam.errors import HardwareError
from implicam.hardware.protocol import Floats, Frame, check_position
from implicam.simulate import Optics, Rig, Studio, Target
from implicam.threads import cores

SEED_STEP = 1_000_003
"""From one picture's seed to the next one's: their noise is not the same."""


class SimulatedRobot:
    """Stands in for a robot: moves on straight lines with `speed` (units a second), and is off by `sd` at each move.

    The true position is the reported one plus N(0, sd²) along each axis. fail_next_move: the next move stops half way.
    """

    moves = alone = simulated = True

    def __init__(self, start: Floats, *, sd: float, speed: float, rng: np.random.Generator) -> None:
        self.sd = (sd, sd, sd) if sd > 0 else (np.nan, np.nan, np.nan)
        self._speed, self._sd, self._rng = speed, sd, rng
        self._reported = check_position(start)
        self._error = np.zeros(3)
        self._fails = False
        self._stop = threading.Event()

    @property
    def true_position(self) -> Floats:
        """(3,) where the ball really is; only the simulated cameras, and tests, may know."""
        return self._reported + self._error

    def fail_next_move(self) -> None:
        """The next move ends half way, as after a protective stop."""
        self._fails = True

    def open(self) -> None:
        """Nothing to connect."""

    def position(self) -> Floats:
        """(3,) where it reports to be."""
        return self._reported.copy()

    def move(self, xyz: Floats) -> Floats:
        """Travel to a position at the robot's speed.

        Args:
            xyz: (3,) in the rig's unit and world frame.

        Returns:
            (3,) the position as reported.

        Raises:
            HardwareError: It was stopped, or told to fail, and stands somewhere on the way; or xyz is no position.
        """
        target, start = check_position(xyz), self._reported
        self._stop.clear()
        seconds = float(np.linalg.norm(target - start)) / self._speed
        fails, self._fails = self._fails, False
        begun = time.monotonic()
        stopped = self._stop.wait(seconds / 2 if fails else seconds)
        part = 1.0 if seconds == 0 else min(1.0, (time.monotonic() - begun) / seconds)
        if not (stopped or fails):
            part = 1.0
        self._reported = start + (0.5 if fails and not stopped else part) * (target - start)
        self._error = self._sd * self._rng.normal(size=3)
        if stopped or fails:
            raise HardwareError(
                "the simulated robot was stopped on its way.",
                why="stop() was called" if stopped else "it was told to fail",
                fix="move again",
            )
        return self.position()

    def stop(self) -> None:
        """Stop at once."""
        self._stop.set()

    def reachable(self) -> Floats | None:
        """Anywhere."""
        return None

    def close(self) -> None:
        """Nothing to disconnect."""


class PhotographingCamera:
    """Stands in for a camera: photographs the ball of a `SimulatedRobot` through a simulated lens.

    fail_for: the next n calls of `frame` fail, as if it were unplugged. cover: the ball is hidden
    in the next n pictures. drawing: entered while a picture is made; None for nothing.
    """

    live = True

    def __init__(
        self, studio: Studio, camera: int, robot: SimulatedRobot, drawing: AbstractContextManager[Any] | None = None
    ) -> None:
        self.name = studio.rig.cameras[camera].name
        self._studio, self._camera, self._robot = studio, camera, robot
        self._drawing = nullcontext() if drawing is None else drawing
        self._fails = self._covers = self._number = 0

    def fail_for(self, n: int) -> None:
        """Let the next calls of `frame` raise HardwareError.

        Args:
            n: The number of calls.
        """
        self._fails = n

    def cover(self, n: int = 1) -> None:
        """Hide the ball in the next pictures.

        Args:
            n: The number of pictures.
        """
        self._covers = n

    def open(self) -> None:
        """Nothing to connect."""

    def frame(self, timeout: float = 5.0) -> Frame:
        """A photograph of where the ball is now.

        Args:
            timeout: Not used: the picture is there at once.

        Raises:
            HardwareError: The camera was told to fail.
        """
        if self._fails > 0:
            self._fails -= 1
            raise HardwareError(
                f"camera {self.name} is gone.", why="it was told to fail (simulated)", fix="take the picture again"
            )
        hidden, self._covers = self._covers > 0, max(0, self._covers - 1)
        self._number += 1
        here = _ball_at(self._hidden_place() if hidden else self._robot.true_position)
        studio = self._studio.showing(here, seed=self._studio.seed + SEED_STEP * self._number)
        with self._drawing:
            return Frame(studio.picture(self._camera, 0), self._number, time.time())

    def close(self) -> None:
        """Nothing to release."""

    def _hidden_place(self) -> Floats:
        """(3,) a place that the camera cannot see."""
        pose = self._studio.rig.cameras[self._camera].camera_from_world
        return np.asarray(pose.centre - 10 * np.linalg.norm(self._studio.rig.volume.size) * pose.rotation[2])


def simulated_rig(
    rig: Rig,
    *,
    seed: int,
    sd: float = 0.0,
    speed: float = 1e6,
    optics: Optics | None = None,
    start: Floats | None = None,
) -> tuple[list[PhotographingCamera], SimulatedRobot]:
    """Cameras and a robot that stand in for hardware.

    Args:
        rig: The simulated rig.
        seed: Of the noise of pictures and positions.
        sd: Standard deviation of the robot's positions along each axis, in the rig's unit.
        speed: Of the robot, in units of the rig a second.
        optics: How the cameras take pictures; None for the usual.
        start: (3,) where the ball is first, in the rig's unit and world frame; None for the middle of the volume.

    Returns:
        One camera for each of the rig's, in their order, and the robot that holds the ball.
    """
    middle = rig.volume.world_from_box.translation if start is None else start
    robot = SimulatedRobot(middle, sd=sd, speed=speed, rng=np.random.default_rng([seed, 11]))
    ball = _ball_at(middle)
    studio = Studio(rig, ball, optics or Optics(), seed).showing(ball, seed=seed)
    drawing = threading.Semaphore(cores())  # more at once take no less time, and 25 MB each
    return [PhotographingCamera(studio, c, robot, drawing) for c in range(len(rig.cameras))], robot


def _ball_at(xyz: Floats) -> Target:
    name = np.array(["ball"])
    return Target("ball", name, name, np.array(xyz, dtype=np.float64).reshape(1, 3))
