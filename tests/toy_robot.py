"""A robot, a camera and a trigger written by the recipe "A robot" of CONTRIBUTING.md alone.

`Gantry` stands in for three axes that one commands over a serial port; `GantryCamera` photographs the ball where the
gantry is, `GantryTrigger` counts. None is hardware.
"""

from __future__ import annotations

from typing import ClassVar, Self

import numpy as np

from implicam.errors import HardwareError, UsageError
from implicam.hardware import Frame, FrameSource, RobotOptions, simulated_rig
from implicam.hardware.protocol import Floats, check_position, incomplete_spec_error
from implicam.simulate import build_rig

RIG = build_rig("stereo", seed=0)
PLACE: list[Floats] = [np.array(RIG.volume.world_from_box.translation)]
"""Where the ball is; the gantry moves it, the cameras see it there."""


class Gantry:
    """Three axes at a serial port."""

    moves = alone = True
    spec: ClassVar[str] = "gantry:PORT"

    @classmethod
    def from_spec(cls, rest: str, options: RobotOptions) -> Self:
        if not rest:
            raise incomplete_spec_error("robot", cls, rest)
        if options.box is None:
            raise UsageError("the gantry needs a box.", why="it could collide", fix="give --workspace")
        return cls(rest, *options.box)

    def __init__(self, port: str, low: Floats, high: Floats) -> None:
        self.port, self._low, self._high = port, np.asarray(low), np.asarray(high)
        self._is_open = False

    @property
    def sd(self) -> tuple[float, float, float]:
        return (0.01, 0.01, 0.01)

    def open(self) -> None:
        self._is_open = True

    def position(self) -> Floats:
        return PLACE[0].copy()

    def move(self, xyz: Floats) -> Floats:
        self.open()
        wish = check_position(xyz)
        if not ((wish >= self._low - 1e-9) & (wish <= self._high + 1e-9)).all():
            raise HardwareError(f"{wish} is out of the box.", why="a gantry ends there", fix="choose another place")
        PLACE[0] = wish
        return wish.copy()

    def stop(self) -> None:
        pass

    def reachable(self) -> Floats | None:
        return None

    def close(self) -> None:
        self._is_open = False


class GantryCamera:
    """A camera that looks at the gantry."""

    spec: ClassVar[str] = "gantry:NUMBER"

    @classmethod
    def takes(cls, spec: str) -> bool:
        return False

    @classmethod
    def from_spec(cls, name: str, rest: str, *, triggered: bool) -> FrameSource:
        if not rest.isdecimal():
            raise incomplete_spec_error("camera", cls, rest)
        return cls(name, int(rest))

    def __init__(self, name: str, number: int) -> None:
        self.name, self.live = name, True
        cameras, self._ball = simulated_rig(RIG, seed=number)
        self._camera = cameras[number]

    def open(self) -> None:
        pass

    def frame(self, timeout: float = 5.0) -> Frame:
        self._ball.move(PLACE[0])
        return self._camera.frame(timeout)

    def close(self) -> None:
        pass


class GantryTrigger:
    """An output line of the gantry."""

    spec: ClassVar[str] = "gantry:LINE"

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

    def close(self) -> None:
        pass
