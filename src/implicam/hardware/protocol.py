"""What a driver is: three small protocols, and what all drivers share. A new driver is one file beside this one.

    FrameSource   one camera: open, frame, close
    Trigger       the box that exposes all cameras at once: open, fire, close
    Robot         whatever puts the target somewhere and knows where it is: open, position, move, stop, close

A driver is found by a spec, the words of a command line: `from_spec` makes one of it. CONTRIBUTING.md, "A robot", has
the steps; contract tests hold every driver to the sentences below. A driver never imports its vendor's library before
`open`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, wait
from dataclasses import dataclass
from typing import ClassVar, Protocol, Self, TypeVar, runtime_checkable

import numpy as np

from implicam.errors import HardwareError, UsageError
from implicam.geometry import Floats
from implicam.images import Grey

__all__ = [
    "Box",
    "CameraDriver",
    "Floats",
    "Frame",
    "FrameSource",
    "Grey",
    "MovedByHand",
    "Robot",
    "RobotDriver",
    "RobotOptions",
    "TellsSettings",
    "Trigger",
    "TriggerDriver",
    "check_position",
    "format_position",
    "incomplete_spec_error",
    "open_all",
    "take_frames",
    "wait_for",
]


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture: grey (height, width) from 0 to 1; a number that counts up; when it was taken, as time.time()."""

    picture: Grey
    number: int
    taken: float


class FrameSource(Protocol):
    """One camera. Used from one thread at a time; different cameras from different threads."""

    @property
    def name(self) -> str:
        """The camera's name in the dataset."""

    @property
    def live(self) -> bool:
        """Whether it has a new picture whenever asked: no film, no folder, nothing that waits for a trigger."""

    def open(self) -> None:
        """Ready the camera. Opening twice is harmless. HardwareError with the cure."""

    def frame(self, timeout: float = 5.0) -> Frame:
        """A picture taken after the call; of a film, the next one.

        After an error the next call reopens the camera by itself.

        Args:
            timeout: Seconds to wait for it.

        Raises:
            HardwareError: None came in time, or the camera is gone.
        """

    def close(self) -> None:
        """Release the camera. Closing twice is harmless; `open` opens it again."""


@runtime_checkable
class TellsSettings(Protocol):
    """A `FrameSource` that is set when it is opened, and says what has become of it."""

    def tell_settings(self) -> list[str]:
        """What the camera was set to when it was opened last, in sentences; empty where that is not known."""

    def keep_settings(self) -> dict[str, str]:
        """The same for a later session to compare with: "device", a name that lasts, and "settings", in words."""


class CameraDriver(Protocol):
    """What the registry of cameras asks of a driver's class."""

    spec: ClassVar[str]
    """What its specs look like, for help and errors: "genicam:SERIAL@producer.cti"."""

    @classmethod
    def takes(cls, spec: str) -> bool:
        """Whether a spec without the driver's name, such as a number or a folder, is meant for it.

        Args:
            spec: The words of the command line.
        """

    @classmethod
    def from_spec(cls, name: str, rest: str, *, triggered: bool) -> FrameSource:
        """A camera of this driver, not yet opened.

        Args:
            name: The camera's name in the dataset.
            rest: The spec, or what follows the driver's name and a colon.
            triggered: The camera exposes only when a trigger fires.

        Raises:
            UsageError: The spec is not complete.
        """


class Trigger(Protocol):
    """What exposes all cameras at the same instant."""

    def open(self) -> None:
        """Connect to the box. Opening twice is harmless. HardwareError with the cure."""

    def fire(self) -> None:
        """Expose the cameras once; returns when the box has acknowledged. HardwareError where it does not."""

    def close(self) -> None:
        """Disconnect. Closing twice is harmless."""


class TriggerDriver(Protocol):
    """What the registry of triggers asks of a driver's class."""

    spec: ClassVar[str]
    """What its specs look like, for help and errors: "udp://HOST:PORT"."""

    @classmethod
    def from_spec(cls, rest: str) -> Trigger:
        """A trigger of this driver, not yet connected.

        Args:
            rest: What follows the driver's name and a colon.

        Raises:
            UsageError: The spec is not complete.
        """


class Robot(Protocol):
    """Whatever puts the target somewhere and knows where it is; positions (3,) in the dataset's unit and world frame.

    sd: standard uncertainty of `position` along x, y, z in that unit, (nan, nan, nan) where unknown. moves: False for
    a person, whom `move` only asks. alone: whether it gets there without a person's help, so that a session may go on
    by itself.
    """

    @property
    def sd(self) -> tuple[float, float, float]:
        """Standard uncertainty of `position`."""

    @property
    def moves(self) -> bool:
        """Whether `move` puts the target there, or only asks for it."""

    @property
    def alone(self) -> bool:
        """Whether it gets there without a person's help."""

    def open(self) -> None:
        """Connect; nothing moves. Opening twice is harmless. HardwareError with the cure."""

    def position(self) -> Floats:
        """(3,) where the target stands now. HardwareError where that is not known, or while it moves without `move`."""

    def move(self, xyz: Floats) -> Floats:
        """Go somewhere in a straight line, and wait until there; after any error the robot is told to stop.

        Args:
            xyz: (3,) in the dataset's unit and world frame.

        Returns:
            (3,) where the target is then.

        Raises:
            HardwareError: It was stopped, the place is out of its box, it refuses, or it has fallen silent.
        """

    def stop(self) -> None:
        """Stop at once, from any thread, without waiting for `move`. Harmless when it stands still, and twice."""

    def reachable(self) -> Floats | None:
        """(n, 3) the only places it can still go to; None for anywhere in its box."""

    def close(self) -> None:
        """Disconnect; the robot stays where it is. Closing twice is harmless."""


@runtime_checkable
class MovedByHand(Protocol):
    """A `Robot` that is told where the target has been put, because it cannot know: a person with a ruler."""

    def set_position(self, xyz: Floats) -> None:
        """Say where the target is.

        Args:
            xyz: (3,) in the dataset's unit and world frame.
        """


@dataclass(frozen=True)
class RobotOptions:
    """What a session knows when it makes a robot; a driver takes what it needs, and does nothing else.

    Attributes:
        ask: Shows a person where the target is to go, a position (3,).
        unit: The length unit of the dataset; box, sd and tool are in it.
        box: Two opposite corners (3,) of the space that a robot may move in, in its base frame.
        speed: m/s; None for the driver's own.
        sd: Standard uncertainty of positions along x, y, z; None for the driver's own.
        tool: (3,) the target's centre in the frame of the robot's flange; None where the robot knows it.
        dry_run: Say where it would go; move nothing.
        confirm: Asked before each move with here and there, each (3,); only True lets it move.
        say: Shows a line of text to the user.
    """

    ask: Callable[[Floats], None] | None = None
    unit: str = "mm"
    box: tuple[Sequence[float] | Floats, Sequence[float] | Floats] | None = None
    speed: float | None = None
    sd: Sequence[float] | None = None
    tool: Sequence[float] | None = None
    dry_run: bool = False
    confirm: Callable[[Floats, Floats], bool] | None = None
    say: Callable[[str], None] = print


class RobotDriver(Protocol):
    """What the registry of robots asks of a driver's class."""

    spec: ClassVar[str]
    """What its specs look like, for help and errors: "ur:HOST"."""

    options: ClassVar[tuple[str, ...]]
    """Which of "speed", "sd" and "tool" it heeds; `robot_from` refuses one that is given and not heeded."""

    @classmethod
    def from_spec(cls, rest: str, options: RobotOptions) -> Robot:
        """A robot of this driver, not yet connected.

        Args:
            rest: What follows the driver's name and a colon; empty where the name stands alone.
            options: What the session knows.

        Raises:
            UsageError: The spec, or an option that this driver needs, is missing or wrong.
        """


def incomplete_spec_error(what: str, driver: type[CameraDriver | RobotDriver | TriggerDriver], rest: str) -> UsageError:
    """The error of a spec that names a driver and does not say what it needs.

    Args:
        what: "camera", "robot" or "trigger".
        driver: The driver's class; its `spec` says what to write.
        rest: What follows the colon in the spec.

    Returns:
        The error, to be raised.
    """
    name = driver.spec.partition(":")[0]
    spec = f"{name}:{rest}" if rest else name
    return UsageError(f"{spec!r} names no {what}.", fix=f"write {driver.spec}")


def check_position(xyz: Floats, what: str = "position") -> Floats:
    """Check a position before it is sent to a robot.

    Args:
        xyz: Three numbers.
        what: What to call them in the error.

    Returns:
        (3,) finite float64, a copy.

    Raises:
        HardwareError: These are not three finite numbers.
    """
    out = np.array(xyz, dtype=np.float64)
    if out.shape != (3,) or not np.isfinite(out).all():
        raise HardwareError(
            f"{xyz} is no {what}.", why="it takes three finite numbers x, y, z", fix="give the place to go to"
        )
    return out


def format_position(xyz: Floats) -> str:
    """A position in words, to five digits.

    Args:
        xyz: (3,).
    """
    return "(" + ", ".join(f"{value:.5g}" for value in xyz) + ")"


ROUNDING = 1e-12
"""Of numbers that are computed: a corner of the workspace is inside of its box."""


@dataclass(frozen=True, eq=False)
class Box:
    """The space that a robot may move in: convex, so that a straight way between two points of it stays in it.

    Attributes:
        low: (3,) its lowest corner.
        high: (3,) its highest corner.
        unit: Of both, for messages.
    """

    low: Floats
    high: Floats
    unit: str = "mm"

    @classmethod
    def from_corners(cls, corners: tuple[Sequence[float] | Floats, Sequence[float] | Floats], unit: str = "mm") -> Self:
        """The box between two opposite corners.

        Args:
            corners: Each (3,), in any order.
            unit: Of both.

        Raises:
            UsageError: These are not two corners, or it is flat.
        """
        try:
            both = np.array(corners, dtype=np.float64)
        except (TypeError, ValueError):
            both = np.full(0, np.nan)
        if both.shape != (2, 3) or not np.isfinite(both).all():
            raise UsageError("the robot's box has two corners of three numbers.", fix="box=((x, y, z), (x, y, z))")
        low, high = both.min(axis=0), both.max(axis=0)
        if (low == high).any():
            raise UsageError(
                f"the box from {format_position(low)} to {format_position(high)} is flat.",
                fix="give two opposite corners",
            )
        return cls(low, high, unit)

    def check(self, xyz: Floats, what: str, slack: float = 0.0) -> None:
        """Refuse what is outside.

        Args:
            xyz: (3,).
            what: What to call it in the error.
            slack: How far outside it may be.

        Raises:
            HardwareError: It is outside.
        """
        slack = max(slack, ROUNDING * float(np.abs([self.low, self.high]).max()))
        if not ((xyz >= self.low - slack) & (xyz <= self.high + slack)).all():
            raise HardwareError(
                f"{what} at {format_position(xyz)} {self.unit} is outside of the box; nothing was moved.",
                why=f"the box goes from {format_position(self.low)} to {format_position(self.high)}, and the straight "
                "line leaves it",
                fix="move the robot into it by hand, or choose a target inside, or give the box that is free",
            )


def open_all(devices: Sequence[FrameSource | Trigger], pool: Executor) -> None:
    """Open devices side by side: a USB camera that waits for a trigger takes a second.

    Args:
        devices: Cameras and triggers.
        pool: At least one thread.

    Raises:
        HardwareError: The first that failed, once all have answered.
    """
    opening = [pool.submit(device.open) for device in devices]
    wait(opening)
    for one in opening:
        one.result()


ARMING_SECONDS = 0.05
"""Seconds from asking the cameras for a picture until all of them wait for the trigger."""


def take_frames(cameras: Sequence[FrameSource], trigger: Trigger | None, timeout: float, pool: Executor) -> list[Frame]:
    """Take a new picture with each camera, all at one instant as far as they are triggered.

    Args:
        cameras: Each is asked in a thread of `pool`.
        trigger: Fired once all cameras wait; None where the cameras run freely.
        timeout: Seconds for each picture.
        pool: At least one thread for each camera, so that all of them wait when the trigger fires.

    Returns:
        A frame of each camera, in their order.

    Raises:
        HardwareError: The trigger or a camera failed, or a camera did not wait for the trigger; once all have answered,
            because a camera answers one thread at a time. After it, triggered cameras are closed: nothing of this
            pulse is left for the next.
    """
    if trigger is not None:
        open_all(cameras, pool)  # a camera that is being opened hears no pulse
    waiting = [pool.submit(camera.frame, timeout) for camera in cameras]
    if trigger is None:
        wait(waiting)
        return [one.result() for one in waiting]
    try:
        time.sleep(ARMING_SECONDS)
        _refuse_early(cameras, waiting)
        trigger.fire()
        wait(waiting)
        return [one.result() for one in waiting]
    except HardwareError:
        wait(waiting)
        for camera in cameras:
            camera.close()
        raise


def _refuse_early(cameras: Sequence[FrameSource], waiting: Sequence[Future[Frame]]) -> None:
    """HardwareError where a picture is there before the pulse: it is of another one, or of none."""
    for camera, one in zip(cameras, waiting, strict=True):
        if one.done():
            one.result()  # its own error
            raise HardwareError(
                f"camera {camera.name} gave a picture before its trigger fired.",
                why="it runs freely, or something else fires the trigger",
                fix="set the camera to wait for its trigger, in its maker's program; or leave --trigger out",
            )


Value = TypeVar("Value")


def wait_for(look: Callable[[], Value | None], timeout: float, pause: float = 0.01) -> Value | None:
    """Call a function again and again until it returns something.

    Args:
        look: Returns None as long as there is nothing.
        timeout: Seconds after which to give up; it is called at least once.
        pause: Seconds between two calls.

    Returns:
        The first value that is not None; None where there was none in time.
    """
    end = time.monotonic() + timeout
    while True:
        value = look()
        if value is not None or time.monotonic() >= end:
            return value
        time.sleep(min(pause, max(0.0, end - time.monotonic())))
