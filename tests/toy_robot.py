"""A robot, a camera and a trigger written by the recipe "A robot" of CONTRIBUTING.md alone.

`ToyRobot` stands in for three axes that one commands over a serial port; `ToyCamera` photographs the ball where they
are, `ToyTrigger` counts. None is hardware: what would be behind the port is `AXES`.
"""

from __future__ import annotations

import threading
import time
from typing import ClassVar, Self

import numpy as np

from implicam.dataset.units import METRES_PER_UNIT
from implicam.errors import HardwareError, UsageError
from implicam.hardware import Frame, FrameSource, RobotOptions, simulated_rig
from implicam.hardware.protocol import Box, Floats, check_position, format_position, incomplete_spec_error
from implicam.simulate import build_rig
from implicam.testing import StandIn

RIG = build_rig("stereo", seed=0)


class Axes:
    """The stand-in: a controller that knows millimetres, and goes on straight lines."""

    def __init__(self, start: Floats) -> None:
        self._lock, self._start, self._end = threading.RLock(), np.array(start), np.array(start)
        self._begun, self._seconds = 0.0, 0.0
        self.silent, self.haste, self.link = False, 1.0, 0  # haste: times as fast as it is told

    def place(self) -> Floats:
        with self._lock:
            part = min(1.0, (time.monotonic() - self._begun) / self._seconds) if self._seconds else 1.0
            return np.asarray(self._end if part == 1.0 else self._start + part * (self._end - self._start))

    def silence(self, on: bool) -> None:
        self.silent = on

    def cut(self) -> None:
        self.link += 1

    def go(self, link: int, target: Floats, speed: float) -> None:
        with self._lock:
            self._answer(link)
            self._start, self._end = self.place(), np.array(target)
            way, self._begun = float(np.linalg.norm(self._end - self._start)), time.monotonic()
            self._seconds = way / speed / self.haste

    def halt(self, link: int) -> None:
        with self._lock:
            self._answer(link)
            self._start = self._end = self.place()

    def ask(self, link: int) -> tuple[Floats, bool]:
        """Where they are, and whether they move."""
        with self._lock:
            self._answer(link)
            place = self.place()
            return place, not np.array_equal(place, self._end)

    def _answer(self, link: int) -> None:
        if self.silent or link != self.link:
            raise OSError("no answer")


AXES = Axes(RIG.volume.world_from_box.translation)
STAND_IN = StandIn(AXES.place, AXES.silence, AXES.cut)


class ToyRobot:
    """Three axes at a serial port."""

    moves = alone = True
    spec: ClassVar[str] = "toy:PORT"
    options: ClassVar[tuple[str, ...]] = ("speed", "sd")

    @classmethod
    def from_spec(cls, rest: str, options: RobotOptions) -> Self:
        if not rest:
            raise incomplete_spec_error("robot", cls, rest)
        if options.box is None:
            raise UsageError("the toy needs a box.", why="it could collide", fix="give --workspace=x0:x1,y0:y1,z0:z1")
        return cls(rest, options)

    def __init__(self, port: str, options: RobotOptions) -> None:
        self.port, self._unit, self._dry = port, options.unit, options.dry_run
        self._mm = METRES_PER_UNIT[options.unit] * 1e3  # in one unit of the dataset
        self._box = Box.from_corners(options.box, options.unit)
        self._speed = (options.speed or 0.25) * 1e3  # mm/s
        x, y, z = options.sd or (0.01 / self._mm,) * 3
        self.sd = (x, y, z)
        self._link: int | None = None
        self._stopped = threading.Event()

    def open(self) -> None:
        if self._link is None:
            self._link = AXES.link
            self._ask()

    def position(self) -> Floats:
        here, moving = self._ask()
        if moving:
            raise HardwareError("the toy moves.", why=f"it is at {format_position(here)}", fix="wait until it stands")
        return here

    def move(self, xyz: Floats) -> Floats:
        self._stopped.clear()
        target = check_position(xyz)
        self._box.check(target, "the target")
        here = self.position()
        if self._dry:
            return here
        try:
            self._go(target)
            while self._ask()[1] and not self._stopped.wait(0.01):
                pass
            if self._stopped.is_set():
                raise HardwareError("the toy was stopped.", why="stop() was called", fix="move again when it is safe")
        except BaseException:
            self.stop()  # an error, Ctrl-C: it does not go on, if it still hears us
            raise
        return self.position()

    def stop(self) -> None:
        self._stopped.set()
        if self._link is not None:
            try:
                AXES.halt(self._link)
            except OSError:
                self._link = None

    def reachable(self) -> Floats | None:
        return None

    def close(self) -> None:
        self._link = None

    def _go(self, target: Floats) -> None:
        try:
            AXES.go(self._link, target * self._mm, self._speed)
        except OSError as error:
            raise self._lost_error(error) from error

    def _ask(self) -> tuple[Floats, bool]:
        self.open()
        try:
            here, moving = AXES.ask(self._link)
        except OSError as error:
            raise self._lost_error(error) from error
        return here / self._mm, moving

    def _lost_error(self, error: OSError) -> HardwareError:
        self._link = None
        return HardwareError(
            f"the toy at {self.port} does not answer.",
            why=f"{error}; a move that had begun may go on to its end",
            fix="look at it before anything else, then at its cable; the next move connects again",
        )


class Line:
    """The wire from the trigger to the cameras."""

    def __init__(self) -> None:
        self._pulses, self._heard = 0, threading.Condition()

    def pulse(self) -> None:
        with self._heard:
            self._pulses += 1
            self._heard.notify_all()

    def wait_for_pulse(self, timeout: float) -> bool:
        with self._heard:
            before = self._pulses
            return self._heard.wait_for(lambda: self._pulses > before, timeout)


LINE = Line()


class ToyCamera:
    """A camera that looks at the axes."""

    spec: ClassVar[str] = "toy:NUMBER"

    @classmethod
    def takes(cls, spec: str) -> bool:
        return spec.endswith(".toy")

    @classmethod
    def from_spec(cls, name: str, rest: str, *, triggered: bool) -> FrameSource:
        number = rest.removesuffix(".toy")
        if not number.isdecimal():
            raise incomplete_spec_error("camera", cls, rest)
        return cls(name, int(number), live=not triggered)

    def __init__(self, name: str, number: int, *, live: bool) -> None:
        self.name, self.live = name, live
        cameras, self._ball = simulated_rig(RIG, seed=number)
        self._camera = cameras[number]

    def open(self) -> None:
        pass

    def frame(self, timeout: float = 5.0) -> Frame:
        if not self.live and not LINE.wait_for_pulse(timeout):
            raise HardwareError(f"camera {self.name}: no picture within {timeout:g} s.", why="it waits for its trigger")
        self._ball.move(AXES.place())
        return self._camera.frame(timeout)

    def close(self) -> None:
        pass


class ToyTrigger:
    """An output line of the toy."""

    spec: ClassVar[str] = "toy:LINE"

    @classmethod
    def from_spec(cls, rest: str) -> Self:
        if not rest.isdecimal():
            raise incomplete_spec_error("trigger", cls, rest)
        return cls(int(rest))

    def __init__(self, line: int) -> None:
        self.line, self.fired = line, 0

    def open(self) -> None:
        pass

    def fire(self) -> None:
        self.fired += 1
        LINE.pulse()

    def close(self) -> None:
        pass
