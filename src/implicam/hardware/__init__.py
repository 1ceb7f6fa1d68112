"""Cameras, triggers and robots behind small protocols; one driver, one file. See docs/hardware.md.

camera = camera_from("cam1", "rtsp://192.168.0.21/main")
robot = robot_from("ur:192.168.0.10", box=((200, -300, 100), (600, 300, 500)))
robot.move(xyz); frame = camera.frame()
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from implicam.errors import UsageError, did_you_mean
from implicam.hardware.csv_player import CsvPlayer
from implicam.hardware.folder_camera import FolderCamera
from implicam.hardware.genicam import GenICamCamera
from implicam.hardware.guard import GuardedRobot, guard_robot
from implicam.hardware.opencv_camera import STREAM_PREFIXES, OpenCVCamera
from implicam.hardware.person import Person
from implicam.hardware.protocol import (
    CameraDriver,
    Frame,
    FrameSource,
    MovedByHand,
    Robot,
    RobotDriver,
    RobotOptions,
    Trigger,
    TriggerDriver,
    take_frames,
)
from implicam.hardware.simulated import PhotographingCamera, SimulatedRobot, simulated_rig
from implicam.hardware.trigger import NetworkTrigger, TCPTrigger, TriggerSimulator
from implicam.hardware.ur import URRobot
from implicam.registry import Registry, offers

__all__ = [
    "CAMERAS",
    "ROBOTS",
    "TRIGGERS",
    "CsvPlayer",
    "FolderCamera",
    "Frame",
    "FrameSource",
    "GenICamCamera",
    "GuardedRobot",
    "MovedByHand",
    "NetworkTrigger",
    "OpenCVCamera",
    "Person",
    "PhotographingCamera",
    "Robot",
    "RobotOptions",
    "SimulatedRobot",
    "Trigger",
    "TriggerSimulator",
    "URRobot",
    "camera_from",
    "guard_robot",
    "list_specs",
    "robot_from",
    "simulated_rig",
    "take_frames",
    "trigger_from",
]

CAMERAS: Registry[type[CameraDriver]] = Registry(
    "camera",
    {"opencv": OpenCVCamera, "folder": FolderCamera, "genicam": GenICamCamera},
    "implicam.cameras",
    offers(CameraDriver),
)
"""Name -> driver; those that take a spec without their name are asked in this order, the ones `HERE` last."""

HERE = (OpenCVCamera, FolderCamera, GenICamCamera)

ROBOTS: Registry[type[RobotDriver]] = Registry(
    "robot", {"person": Person, "csv": CsvPlayer, "ur": URRobot}, "implicam.robots", offers(RobotDriver)
)
"""Name -> driver."""

TRIGGERS: Registry[type[TriggerDriver]] = Registry(
    "trigger", {"udp": NetworkTrigger, "tcp": TCPTrigger}, "implicam.triggers", offers(TriggerDriver)
)
"""Name -> driver."""

HEEDED = ("speed", "sd", "tool")
"""The `RobotOptions` that only a driver can heed; the guard sees to the others."""


def list_specs(drivers: Registry[Any]) -> str:
    """What the specs of all drivers look like that can be imported, for help texts and errors.

    Args:
        drivers: `CAMERAS`, `ROBOTS` or `TRIGGERS`.

    Returns:
        The `spec` of each driver, with commas between them.
    """
    return ", ".join(driver.spec for driver in drivers.importable().values())


def camera_from(name: str, spec: str, *, triggered: bool = False) -> FrameSource:
    """The camera that the words of a command line name; it is not opened.

    Args:
        name: The camera's name in the dataset.
        spec: A driver's name, a colon, and what it asks for; or what one of the drivers takes as it is.
        triggered: The camera exposes only when a trigger fires.

    Raises:
        UsageError: No driver takes it; the error says what the specs look like.
    """
    driver, colon, _ = spec.partition(":")
    if colon and driver in CAMERAS:
        kind, rest = CAMERAS.find(spec)
        return kind.from_spec(name, rest, triggered=triggered)
    for kind in sorted(CAMERAS.importable().values(), key=lambda kind: kind in HERE):  # those of packages first
        if kind.takes(spec):
            return kind.from_spec(name, spec, triggered=triggered)
    if driver in CAMERAS:
        raise UsageError(
            f"{spec!r} alone names no camera.", why="it is a driver's name", fix=f"write {CAMERAS[driver].spec}"
        )
    why = "there is no such file or folder either"
    if Path(spec).is_file():
        why = f"there is such a file, and by its ending it is no film; opencv:{spec} tries to read it as one"
    raise _unknown_error(CAMERAS, spec, (*CAMERAS, "/dev/video0", *STREAM_PREFIXES), why=why)


def robot_from(spec: str, **options: Any) -> GuardedRobot:
    """The robot that the words of a command line name, guarded; it is not connected.

    Args:
        spec: A driver's name; for most a colon, and what it asks for: "ur:192.168.0.10".
        options: The fields of `RobotOptions`.

    Raises:
        UsageError: There is no such driver, something that it needs is missing, or it cannot heed an option.
    """
    driver, rest = _find_driver(ROBOTS, spec)
    name, wishes = spec.partition(":")[0], RobotOptions(**options)
    made = guard_robot(driver.from_spec(rest, replace(wishes, confirm=None)), wishes, spec)  # the guard asks
    for option in HEEDED:
        if getattr(wishes, option) is not None and option not in driver.options:
            raise UsageError(
                f"the robot {name!r} does not heed {option}.",
                why="its driver cannot tell it so" if made.alone else "nothing moves by itself there",
                fix=f"leave {option} out",
            )
    if wishes.dry_run and not made.alone:
        raise UsageError(
            f"the robot {name!r} has no dry run.", why="nothing moves by itself there", fix="leave the dry run out"
        )
    return made


def trigger_from(spec: str) -> Trigger:
    """The trigger that the words of a command line name; it is not connected.

    Args:
        spec: A driver's name, a colon, and what it asks for: "udp://192.168.0.50:4000".

    Raises:
        UsageError: There is no such driver, or the spec is not complete.
    """
    driver, rest = _find_driver(TRIGGERS, spec)
    return driver.from_spec(rest)


Driver = TypeVar("Driver")


def _find_driver(drivers: Registry[Driver], spec: str) -> tuple[Driver, str]:
    if spec.partition(":")[0] not in drivers:
        raise _unknown_error(drivers, spec, tuple(drivers))
    return drivers.find(spec)


def _unknown_error(drivers: Registry[Any], spec: str, known: tuple[str, ...], why: str = "") -> UsageError:
    hint = did_you_mean(spec, known) or did_you_mean(spec.partition(":")[0], [word.partition(":")[0] for word in known])
    return UsageError(f"{spec!r} names no {drivers.kind}{hint}.", why=why, fix=f"write {list_specs(drivers)}")
