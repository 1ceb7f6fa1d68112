"""A Universal Robots arm, by the library ur-rtde: the target is at its tool centre point (TCP).

The dataset's world frame is the robot's base frame, in the dataset's unit; inside, the robot has metres. What protects
people is the robot's own safety configuration; the box, the speed limit and the questions here come on top of it.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Self

import numpy as np

from implicam.dataset.model import METRES_PER_UNIT
from implicam.errors import HardwareError, UsageError, import_extra
from implicam.hardware.protocol import Floats, RobotOptions, incomplete, point, wait_for
from implicam.hardware.ur_worker import DECELERATION, Worker

FASTEST = 0.25
"""m/s. The reduced speed of ISO 10218-1 for a robot that people are near to."""

ACCELERATION = 0.3
"""m/s² when a move begins and ends."""

REPEATS_M = 1e-4
"""The UR10 repeats to 0.1 mm by its data sheet; how true its positions are as a whole, no data sheet says."""

NEAR_M, STILL_M_S = 5e-4, 1e-4
"""How far from the target, and how slow, a robot is that has arrived."""

SILENCE, STUCK = 1.0, 3.0
"""Seconds without a word, or without motion, after which the robot is taken as lost, or as stuck."""

PORTS = (30004, 29999, 30002)
"""Data, dashboard, programs."""

CONNECTING, ANSWER = 15.0, 10.0
"""Seconds that ur-rtde may take: its own patience to start its program on the robot is 5 s."""

RUNNING = 7
"""Robot mode: powered on, brakes released."""


class URRobot:
    """The `Robot` at `host`, in remote control.

    box: the two opposite corners (3,), (3,) of the space that the TCP may be in, in `unit`; it is a convex box, so that
    a straight move between two points of it stays in it. tool: the target's centre (3,) in the flange's frame, in
    `unit`; None leaves the TCP that is set on the robot. speed: m/s, at most 0.25. dry_run: only says what it would do;
    connects to read the position, and uploads nothing. confirm: is asked before each move with here and there; a move
    that it does not answer with True is refused. The tool keeps the orientation that it has.
    """

    moves = alone = True
    spec: ClassVar[str] = "ur:HOST"

    @classmethod
    def from_spec(cls, rest: str, options: RobotOptions) -> Self:
        """A robot by its address, not connected yet.

        Args:
            rest: The host's name or address.
            options: All but `ask` are used; `box` is required.

        Raises:
            UsageError: The host or the box is missing, or an option is out of range.
        """
        if not rest:
            raise incomplete("robot", cls, rest)
        if options.box is None:
            raise UsageError(
                f"ur:{rest} needs a box that it may move in.",
                why="without one, a mistyped number is a collision",
                fix="give two opposite corners of the free space, in the dataset's unit, robot base frame",
            )
        kept = ("unit", "box", "sd", "dry_run", "confirm", "say", "speed")
        given = {key: value for key in kept if (value := getattr(options, key)) is not None}
        return cls(rest, options.tool, **given)

    def __init__(
        self,
        host: str,
        tool: Sequence[float] | None = None,
        *,
        box: tuple[Sequence[float] | Floats, Sequence[float] | Floats],
        speed: float = 0.1,
        dry_run: bool = False,
        confirm: Callable[[Floats, Floats], bool] | None = None,
        unit: str = "mm",
        sd: Sequence[float] | None = None,
        say: Callable[[str], None] = print,
    ) -> None:
        if unit not in METRES_PER_UNIT:
            raise UsageError(f"there is no length unit {unit!r}.", fix=f"use {', '.join(METRES_PER_UNIT)}")
        if not 0 < speed <= FASTEST:
            raise UsageError(f"speed = {speed} m/s is out of range.", fix=f"0.1 is calm; {FASTEST} is the most")
        self.host, self.unit, self._speed = host, unit, speed
        self._metres = METRES_PER_UNIT[unit]
        self._low, self._high = _corners(box)
        self._tool = None if tool is None else point(np.asarray(tool, dtype=np.float64), "tool") * self._metres
        self._dry, self._confirm, self._say = dry_run, confirm, say
        x, y, z = (REPEATS_M / self._metres,) * 3 if sd is None else tuple(float(value) for value in sd)
        self.sd = (x, y, z)
        self._worker: Worker | None = None
        self._stop = threading.Event()
        self._commands = threading.Lock()

    def open(self) -> None:
        """Connect, and upload the control program unless this is a dry run."""
        if self._worker is not None:
            return
        import_extra("rtde_receive", "robot", "a UR robot")
        for port in PORTS[:1] if self._dry else PORTS:  # ur-rtde itself would wait for minutes
            self._knock(port)
        self._worker = Worker()
        try:
            self._ask("receive", "connect", self.host)
            self._check()
            if not self._dry:
                self._ask("control", "connect", self.host)
                if self._tool is not None:
                    self._ask("control", "setTcp", [*self._tool.tolist(), 0.0, 0.0, 0.0])
        except BaseException:
            self._drop()
            raise

    def position(self) -> Floats:
        """(3,) where the TCP is now, as the robot measures it."""
        self.open()
        self._check()
        return self._here()

    def move(self, xyz: Floats) -> Floats:
        """Move the TCP in a straight line; both ends must be inside the box.

        Args:
            xyz: (3,) in the robot's base frame, in `unit`.

        Returns:
            (3,) where it stands then; in a dry run it has not moved.

        Raises:
            HardwareError: An end is outside of the box, the move was not confirmed, the robot was stopped or refuses,
                or the connection is lost.
        """
        self._stop.clear()
        target, here = point(xyz), self.position()
        self._check_inside(target, "the target")
        self._check_inside(here, "the robot")
        words = f"{self.host}: from {_text(here)} to {_text(target)} {self.unit} at {self._speed:g} m/s"
        if self._dry:
            self._say(f"dry run, {words}")
            return here
        if self._confirm is not None and self._confirm(here, target) is not True:
            raise HardwareError(f"the move was refused; {words}.", why="it was not confirmed", fix="choose another one")
        self._start(target)
        try:
            self._wait(target)
        except KeyboardInterrupt:
            self.stop()
            raise
        return self._here()

    def stop(self) -> None:
        """Slow down to a stand and drop the move. What stops a robot in an emergency is its red button."""
        self._stop.set()
        with self._commands:
            if self._worker is not None and not self._dry:
                self._ask("control", "stopL", DECELERATION)

    def reachable(self) -> Floats | None:
        """Anywhere in the box."""
        return None

    def close(self) -> None:
        """End the control program and disconnect; the robot stays where it is."""
        try:
            if self._worker is not None and not self._dry:
                self._worker.call("control", "stopScript")
        except (RuntimeError, TimeoutError):
            return  # it is gone already
        finally:
            self._drop()

    def _drop(self) -> None:
        """Without a word to the robot."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.end()

    def _ask(self, thing: str, method: str, *args: object) -> Any:
        """What ur-rtde answers; HardwareError for what it raises, and where it does not answer: then it is dropped."""
        if self._worker is None:
            raise self._lost("the connection was closed")
        try:
            return self._worker.call(thing, method, *args, timeout=CONNECTING if method == "connect" else ANSWER)
        except TimeoutError as error:
            self._drop()
            raise self._lost(str(error)) from error
        except RuntimeError as error:
            raise self._refused(str(error)) from error

    def _knock(self, port: int) -> None:
        try:
            socket.create_connection((self.host, port), timeout=3.0).close()
        except OSError as error:
            raise HardwareError(
                f"the robot at {self.host} does not answer on port {port}.",
                why=str(error),
                fix="check that it is on, its cable and its address; on an e-Series, enable the network services "
                "RTDE, Dashboard and Secondary Client under Settings, Security, Services",
            ) from error

    def _here(self) -> Floats:
        return np.array(self._ask("receive", "getActualTCPPose")[:3], dtype=np.float64) / self._metres

    def _check(self) -> None:
        """HardwareError where the robot is silent, stopped by its safety system, or not running."""
        before = self._ask("receive", "getTimestamp")
        new = wait_for(lambda: True if self._ask("receive", "getTimestamp") != before else None, SILENCE, pause=0.002)
        if new is None:
            self._drop()
            raise self._lost(f"it has said nothing for {SILENCE:g} s")
        if self._ask("receive", "isEmergencyStopped"):
            raise self._halted("an emergency stop", "release the button and start the robot on its pendant")
        if self._ask("receive", "isProtectiveStopped"):
            raise self._halted("a protective stop", "free the arm, and unlock it on its pendant")
        if self._ask("receive", "getRobotMode") != RUNNING:
            raise self._halted("no power on its joints", "switch it on and release the brakes on its pendant")

    def _lost(self, why: str) -> HardwareError:
        return HardwareError(
            f"the connection to the robot at {self.host} is lost.",
            why=f"{why}; a move that had begun may go on to its end, inside the box",
            fix="look at the robot before anything else, then at its cable and power; the next move connects again",
        )

    def _halted(self, what: str, fix: str) -> HardwareError:
        """The robot's programs end with it: the next move connects again, and uploads ours."""
        here = self._here()
        self._drop()
        return HardwareError(
            f"the robot at {self.host} has {what}.", why=f"it stands at {_text(here)} {self.unit}", fix=fix
        )

    def _check_inside(self, xyz: Floats, what: str) -> None:
        slack = NEAR_M / self._metres if what == "the robot" else 0.0
        if (xyz < self._low - slack).any() or (xyz > self._high + slack).any():
            raise HardwareError(
                f"{what} at {_text(xyz)} {self.unit} is outside of the box; nothing was moved.",
                why=f"the box goes from {_text(self._low)} to {_text(self._high)}, and the straight line leaves it",
                fix="move the robot into it by hand, or choose a target inside, or give the box that is free",
            )

    def _start(self, target: Floats) -> None:
        with self._commands:
            if self._stop.is_set():
                raise self._stopped()
            pose = [*(target * self._metres).tolist(), *self._ask("receive", "getActualTCPPose")[3:]]
            begun = self._ask("control", "moveL", pose, self._speed, ACCELERATION, True)
        if not begun:
            self._check()
            self._drop()
            raise self._refused("its control program does not run; it did not begin to move")

    def _wait(self, target: Floats) -> None:
        """Until the robot stands at the target; HardwareError for whatever keeps it from there."""
        place, since = self._here(), time.monotonic()
        while True:
            self._check()
            if self._stop.is_set():
                raise self._stopped()
            here = self._here()
            off = float(np.linalg.norm(here - target)) * self._metres
            speed = float(np.linalg.norm(self._ask("receive", "getActualTCPSpeed")[:3]))
            if off < NEAR_M and speed < STILL_M_S:
                return
            if np.linalg.norm(here - place) * self._metres > NEAR_M / 5:
                place, since = here, time.monotonic()
            if time.monotonic() - since > STUCK:
                self.stop()
                raise HardwareError(
                    f"the robot stands {off * 1e3:.2f} mm from its target {_text(target)} {self.unit}.",
                    why=f"it has not moved for {STUCK:g} s: out of reach, a joint limit, or the speed slider is at 0",
                    fix="read the pendant's log, and choose another target",
                )

    def _stopped(self) -> HardwareError:
        return HardwareError(
            f"the robot was stopped at {_text(self._here())} {self.unit}.",
            why="stop() was called",
            fix="move again when it is safe",
        )

    def _refused(self, why: str) -> HardwareError:
        return HardwareError(
            f"the robot at {self.host} refuses.",
            why=why.strip() or "it does not say why",
            fix="switch it to remote control, end other programs on it, and look at its pendant",
        )


def _corners(box: tuple[Sequence[float] | Floats, Sequence[float] | Floats]) -> tuple[Floats, Floats]:
    corners = np.asarray(box, dtype=np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all():
        raise UsageError("the robot's box has two corners of three numbers.", fix="box=((x, y, z), (x, y, z))")
    low, high = corners.min(axis=0), corners.max(axis=0)
    if (low == high).any():
        raise UsageError(f"the box from {_text(low)} to {_text(high)} is flat.", fix="give two opposite corners")
    return low, high


def _text(xyz: Floats) -> str:
    return "(" + ", ".join(f"{value:.5g}" for value in xyz) + ")"
