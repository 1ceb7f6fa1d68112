"""What stands between a session and any robot, for the driver that forgot something.

`guard_robot` wraps a driver: in a dry run its `move` is never called; elsewhere not before the target, the box and the
person have been asked; what it answers is checked; a move that ends with an error, whatever it is, is stopped; and
after such a move the robot has no position until it has been seen to stand.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from implicam.dataset.units import METRES_PER_UNIT
from implicam.errors import HardwareError, UsageError
from implicam.hardware.protocol import (
    Box,
    Floats,
    MovedByHand,
    Robot,
    RobotOptions,
    check_position,
    format_position,
)
from implicam.registry import missing_members

OUTSIDE_M = 1e-3
"""Metres that a robot may stand outside of its box: it was sent to the very edge, and is not exact."""

STANDING_M, STANDING_SECONDS = 1e-4, 0.5
"""A robot that has gone no further than this in this time stands; further where its `sd` is larger."""


class GuardedRobot:
    """The `Robot` that a driver is, guarded; see `guard_robot`. What else the driver has is found here too.

    Attributes:
        driver: The robot that is guarded.
        dry_run: Whether `move` only says where it would go.
    """

    def __init__(self, driver: Robot, options: RobotOptions, name: str) -> None:
        self.driver, self.dry_run = driver, options.dry_run
        self._options, self._name = options, name
        boxed = options.box is not None and driver.alone
        self._box = Box.from_corners(options.box, options.unit) if boxed else None  # type: ignore[arg-type]
        self._stop = threading.Event()
        self._may_move = False  # the last move ended with an error, and it was not seen to stand since

    def __getattr__(self, name: str) -> Any:
        if name == "driver":  # while it is being copied, or made
            raise AttributeError(name)
        return getattr(self.driver, name)

    @property
    def speed(self) -> float | None:
        """m/s that was asked for; None for the driver's own."""
        return self._options.speed

    @property
    def limits(self) -> str:
        """Where it may go, in words."""
        if self._box is None:
            return "anywhere it can reach"
        low, high = (format_position(np.asarray(corner)) for corner in self._options.box)  # type: ignore[union-attr]
        return f"in the box from {low} to {high} {self._options.unit}"

    def ask_before_moving(self, confirm: Callable[[Floats, Floats], bool]) -> None:
        """Ask before each move from now on.

        Args:
            confirm: Is given here and there, each (3,); only True lets it move.
        """
        self._options = replace(self._options, confirm=confirm)

    @property
    def sd(self) -> tuple[float, float, float]:
        """Standard uncertainty of `position`, of the driver."""
        x, y, z = self.driver.sd
        return (float(x), float(y), float(z))

    @property
    def moves(self) -> bool:
        """Whether `move` puts the target there, or only asks for it."""
        return self.driver.moves

    @property
    def alone(self) -> bool:
        """Whether it gets there without anybody's help."""
        return self.driver.alone

    def open(self) -> None:
        """Connect."""
        self.driver.open()

    def position(self) -> Floats:
        """(3,) where the target is now; HardwareError where that is not known, or it moves."""
        here = self._check_answer(self.driver.position(), "position")
        if not self._may_move:
            return here
        time.sleep(STANDING_SECONDS)
        now = self._check_answer(self.driver.position(), "position")
        far = float(np.linalg.norm(now - here))
        if far > max(STANDING_M / METRES_PER_UNIT[self._options.unit], *np.nan_to_num(self.sd)):
            raise HardwareError(
                f"{self._name} still moves; it is at {format_position(now)} {self._options.unit}.",
                why="its last move ended with an error, and it has not come to a stand",
                fix="press its red button where it must not go on; else wait until it stands, and try again",
            )
        self._may_move = False
        return now

    def move(self, xyz: Floats) -> Floats:
        """Go somewhere, unless this is a dry run, and wait until there.

        Args:
            xyz: (3,) in the dataset's unit and world frame.

        Returns:
            (3,) where the target is then; in a dry run it has not moved.

        Raises:
            HardwareError: An end of the way is outside of the box, the move was not confirmed, or the driver's own.
        """
        self._stop.clear()
        target, options = check_position(xyz), self._options
        if self._box is not None:
            self._box.check(target, "the target")
        if self.driver.alone:
            here = self.position()
            if self._box is not None:
                self._box.check(here, "the robot", slack=OUTSIDE_M / METRES_PER_UNIT[options.unit])
            words = f"{self._name}: from {format_position(here)} to {format_position(target)} {options.unit}"
            words += "" if options.speed is None else f" at {options.speed:g} m/s"
            if self.dry_run:
                options.say(f"dry run, {words}")
                return here
            if options.confirm is not None and options.confirm(here, target) is not True:
                raise HardwareError(f"the move was refused; {words}.", why="it was not confirmed", fix="choose another")
        elif self.dry_run:
            raise HardwareError(f"{self._name} has no dry run.", why="it does not move by itself", fix="leave it out")
        if self._stop.is_set():
            raise HardwareError(f"{self._name} was stopped before it moved.", why="stop() was called", fix="move again")
        self._may_move = self.driver.alone
        try:
            there = self._check_answer(self.driver.move(target.copy()), "move")
        except BaseException:
            with suppress(Exception):  # Ctrl-C, silence, a driver's mistake: it does not go on while it hears us
                self.driver.stop()
            raise
        self._may_move = False
        return there

    def stop(self) -> None:
        """Stop at once, from any thread; in a dry run too."""
        self._stop.set()
        self.driver.stop()

    def reachable(self) -> Floats | None:
        """(n, 3) the only places it can still go to; None for anywhere in its box."""
        return self.driver.reachable()

    def close(self) -> None:
        """Disconnect; the robot stays where it is."""
        self.driver.close()

    def _check_answer(self, xyz: object, method: str) -> Floats:
        """(3,) a copy of what the driver returned."""
        with suppress(TypeError, ValueError):
            answer = np.array(xyz, dtype=np.float64)
            if answer.shape == (3,) and np.isfinite(answer).all():
                return answer
        raise HardwareError(
            f"{self._name} does not say where it is: its driver's {method}() returned {xyz!r}.",
            why="it must be three finite numbers x, y, z",
            fix="look at the robot first; then mend its driver, or tell who wrote it",
        )


class GuardedByHand(GuardedRobot):
    """The same of a `MovedByHand`."""

    def set_position(self, xyz: Floats) -> None:
        """Say where the target is.

        Args:
            xyz: (3,) in the dataset's unit and world frame.
        """
        self.driver.set_position(check_position(xyz))  # type: ignore[attr-defined]


def guard_robot(robot: Robot, options: RobotOptions, name: str = "the robot") -> GuardedRobot:
    """Guard a robot; one that is guarded already is so by these options too.

    Args:
        robot: Of any driver.
        options: Of them `unit`, `box`, `dry_run`, `confirm` and `say` are used.
        name: What to call it in messages.

    Returns:
        A `Robot`, and `MovedByHand` where the other one is.

    Raises:
        UsageError: The driver lacks something that `Robot` asks for, or the box is none.
    """
    missing = missing_members(robot, Robot)
    if missing:
        raise UsageError(
            f"the driver of {name} is not complete: it has no {', '.join(missing)}.",
            why="a session must be able to move, ask and stop every robot",
            fix='write what implicam.hardware.Robot asks for; CONTRIBUTING.md, "A robot"',
        )
    kind = GuardedByHand if isinstance(robot, MovedByHand) else GuardedRobot
    return kind(robot, options, name)
