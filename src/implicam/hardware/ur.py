"""A Universal Robots arm, by the library ur-rtde: the target is at its tool centre point (TCP).

The dataset's world frame is the robot's base frame, in the dataset's unit; inside, the robot has metres. What protects
people is the robot's own safety configuration; the box, the speed limit and the questions here come on top of it.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, ClassVar, Self

import numpy as np

from implicam.dataset.units import METRES_PER_UNIT, refuse_unknown_unit
from implicam.errors import HardwareError, UsageError, import_extra
from implicam.hardware.protocol import (
    Box,
    Floats,
    RobotOptions,
    check_position,
    format_position,
    incomplete_spec_error,
    wait_for,
)
from implicam.hardware.ur_worker import DECELERATION_M_S2, Worker

MAX_SPEED_M_S = 0.25
"""The reduced speed of ISO 10218-1 for a robot that people are near to."""

ACCELERATION_M_S2 = 0.3
"""When a move begins and ends."""

REPEATABILITY_M = 1e-4
"""The UR10 repeats to 0.1 mm by its data sheet; how true its positions are as a whole, no data sheet says."""

ARRIVAL_DISTANCE_M, STANDSTILL_SPEED_M_S = 5e-4, 1e-4
"""A robot that is nearer to its target and slower than this has arrived."""

HALT_SECONDS = 0.5
"""What it may take to come to a stand once it was told to stop."""

SILENCE_SECONDS, STANDSTILL_SECONDS = 1.0, 3.0
"""Without data for so long, the connection is taken as lost; without motion, the robot as stuck."""

PORTS = (30004, 29999, 30002)
"""Data, dashboard, programs."""

CONNECT_SECONDS, ANSWER_SECONDS = 15.0, 10.0
"""That ur-rtde may take; it waits up to 5 s itself for its program to start on the robot."""

ROBOT_MODE_RUNNING = 7
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
    options: ClassVar[tuple[str, ...]] = ("speed", "sd", "tool")

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
            raise incomplete_spec_error("robot", cls, rest)
        if options.box is None:
            raise UsageError(
                f"ur:{rest} needs a box that it may move in.",
                why="without one, a mistyped number is a collision",
                fix="give two opposite corners of the free space, in the dataset's unit, robot base frame; on the "
                "command line --workspace=x0:x1,y0:y1,z0:z1",
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
        refuse_unknown_unit(unit)
        if not 0 < speed <= MAX_SPEED_M_S:
            raise UsageError(f"speed = {speed} m/s is out of range.", fix=f"0.1 is calm; {MAX_SPEED_M_S} is the most")
        self.host, self.unit, self._speed = host, unit, speed
        self._metres = METRES_PER_UNIT[unit]
        self._box = Box.from_corners(box, unit)
        self._tool = None if tool is None else check_position(np.asarray(tool, dtype=np.float64), "tool") * self._metres
        self._dry, self._confirm, self._say = dry_run, confirm, say
        x, y, z = (REPEATABILITY_M / self._metres,) * 3 if sd is None else tuple(float(value) for value in sd)
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
            self._check_port(port)
        self._worker = Worker()
        try:
            self._ask("receive", "connect", self.host)
            self._check_state()
            if not self._dry:
                self._ask("control", "connect", self.host)
                if self._tool is not None:
                    self._ask("control", "setTcp", [*self._tool.tolist(), 0.0, 0.0, 0.0])
        except BaseException:
            self._disconnect()
            raise

    def position(self) -> Floats:
        """(3,) where the TCP stands now, as the robot measures it; HardwareError where it moves by itself."""
        self.open()
        self._check_state()
        if wait_for(lambda: True if self._read_speed() < STANDSTILL_SPEED_M_S else None, HALT_SECONDS) is None:
            raise HardwareError(
                f"the robot at {self.host} moves: it is at {format_position(self._read_position())} {self.unit}.",
                why="a move that the connection was lost on goes on, or somebody else moves it",
                fix="press its red button where it must not go on; else wait until it stands, and try again",
            )
        return self._read_position()

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
        target, here = check_position(xyz), self.position()
        self._box.check(target, "the target")
        self._box.check(here, "the robot", slack=ARRIVAL_DISTANCE_M / self._metres)
        way = f"from {format_position(here)} to {format_position(target)} {self.unit}"
        words = f"{self.host}: {way} at {self._speed:g} m/s"
        if self._dry:
            self._say(f"dry run, {words}")
            return here
        if self._confirm is not None and self._confirm(here, target) is not True:
            raise HardwareError(f"the move was refused; {words}.", why="it was not confirmed", fix="choose another one")
        try:
            self._start(target)
            self._wait(target)
        except BaseException:
            with suppress(HardwareError):
                self.stop()
            raise
        return self._read_position()

    def stop(self) -> None:
        """Slow down to a stand and drop the move. What stops a robot in an emergency is its red button."""
        self._stop.set()
        with self._commands:
            if self._worker is not None and not self._dry:
                self._ask("control", "stopL", DECELERATION_M_S2)

    def reachable(self) -> Floats | None:
        """None: anywhere in the box."""
        return None

    def close(self) -> None:
        """End the control program and disconnect; the robot stays where it is."""
        try:
            if self._worker is not None and not self._dry:
                self._worker.call("control", "stopScript")
        except (RuntimeError, TimeoutError):
            return  # it is disconnected already
        finally:
            self._disconnect()

    def _disconnect(self) -> None:
        """Disconnect without telling the robot."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.end()

    def _ask(self, thing: str, method: str, *args: object) -> Any:
        """What ur-rtde answers; HardwareError for what it raises, and where it does not answer: then it is dropped."""
        if self._worker is None:
            raise self._connection_lost_error("the connection was closed")
        try:
            return self._worker.call(
                thing, method, *args, timeout=CONNECT_SECONDS if method == "connect" else ANSWER_SECONDS
            )
        except TimeoutError as error:
            self._disconnect()
            raise self._connection_lost_error(str(error)) from error
        except RuntimeError as error:
            raise self._refused_error(str(error)) from error

    def _check_port(self, port: int) -> None:
        try:
            socket.create_connection((self.host, port), timeout=3.0).close()
        except OSError as error:
            raise HardwareError(
                f"the robot at {self.host} does not answer on port {port}.",
                why=str(error),
                fix="check that it is on, its cable and its address; on an e-Series, enable the network services "
                "RTDE, Dashboard and Secondary Client under Settings, Security, Services",
            ) from error

    def _read_position(self) -> Floats:
        return np.array(self._ask("receive", "getActualTCPPose")[:3], dtype=np.float64) / self._metres

    def _read_speed(self) -> float:
        """Of the TCP, m/s."""
        return float(np.linalg.norm(self._ask("receive", "getActualTCPSpeed")[:3]))

    def _check_state(self) -> None:
        """HardwareError where the robot is silent, stopped by its safety system, or not running."""
        before = self._ask("receive", "getTimestamp")
        new = wait_for(
            lambda: True if self._ask("receive", "getTimestamp") != before else None, SILENCE_SECONDS, pause=0.002
        )
        if new is None:
            self._disconnect()
            raise self._connection_lost_error(f"it has sent nothing for {SILENCE_SECONDS:g} s")
        if self._ask("receive", "isEmergencyStopped"):
            raise self._halted_error("an emergency stop", "release the button and start the robot on its pendant")
        if self._ask("receive", "isProtectiveStopped"):
            raise self._halted_error("a protective stop", "free the arm, and unlock it on its pendant")
        if self._ask("receive", "getRobotMode") != ROBOT_MODE_RUNNING:
            raise self._halted_error("no power on its joints", "switch it on and release the brakes on its pendant")

    def _connection_lost_error(self, why: str) -> HardwareError:
        return HardwareError(
            f"the connection to the robot at {self.host} is lost.",
            why=f"{why}; a move that had begun may go on to its end, inside the box",
            fix="look at the robot before anything else, then at its cable and power; the next move connects again",
        )

    def _halted_error(self, what: str, fix: str) -> HardwareError:
        """The robot's programs end with it: the next move connects again, and uploads ours."""
        here = self._read_position()
        self._disconnect()
        return HardwareError(
            f"the robot at {self.host} has {what}.", why=f"it stands at {format_position(here)} {self.unit}", fix=fix
        )

    def _start(self, target: Floats) -> None:
        with self._commands:
            if self._stop.is_set():
                raise self._stopped_error()
            pose = [*(target * self._metres).tolist(), *self._ask("receive", "getActualTCPPose")[3:]]
            begun = self._ask("control", "moveL", pose, self._speed, ACCELERATION_M_S2, True)
        if not begun:
            self._check_state()
            self._disconnect()
            raise self._refused_error("its control program does not run; it did not begin to move")

    def _wait(self, target: Floats) -> None:
        """Until the robot stands at the target; HardwareError for whatever keeps it from there."""
        place, since = self._read_position(), time.monotonic()
        while True:
            self._check_state()
            if self._stop.is_set():
                raise self._stopped_error()
            here = self._read_position()
            off = float(np.linalg.norm(here - target)) * self._metres
            if off < ARRIVAL_DISTANCE_M and self._read_speed() < STANDSTILL_SPEED_M_S:
                return
            if np.linalg.norm(here - place) * self._metres > ARRIVAL_DISTANCE_M / 5:
                place, since = here, time.monotonic()
            if time.monotonic() - since > STANDSTILL_SECONDS:
                self.stop()
                raise HardwareError(
                    f"the robot stands {off * 1e3:.2f} mm from its target {format_position(target)} {self.unit}.",
                    why=f"no motion for {STANDSTILL_SECONDS:g} s: out of reach, at a joint limit, or speed slider at 0",
                    fix="read the pendant's log, and choose another target",
                )

    def _stopped_error(self) -> HardwareError:
        return HardwareError(
            f"the robot was stopped at {format_position(self._read_position())} {self.unit}.",
            why="stop() was called",
            fix="move again when it is safe",
        )

    def _refused_error(self, why: str) -> HardwareError:
        return HardwareError(
            f"the robot at {self.host} refuses.",
            why=why.strip() or "it does not say why",
            fix="switch it to remote control, end other programs on it, and look at its pendant",
        )
