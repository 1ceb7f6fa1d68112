"""Cameras, triggers and robots behind small protocols; one driver, one file. See docs/hardware.md.

camera = camera_from("cam1", "rtsp://192.168.0.21/main")
robot = robot_from("ur:192.168.0.10", box=((200, -300, 100), (600, 300, 500)))
robot.move(xyz); frame = camera.frame()
"""

from __future__ import annotations

from typing import Any

from implicam.errors import UsageError, did_you_mean
from implicam.hardware.csv_player import CsvPlayer
from implicam.hardware.folder_camera import FolderCamera
from implicam.hardware.genicam import GenICamCamera
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
    take_frames,
)
from implicam.hardware.simulated import PhotographingCamera, SimulatedRobot, simulated_rig
from implicam.hardware.trigger import NetworkTrigger, TriggerSimulator
from implicam.hardware.ur import URRobot
from implicam.registry import Registry, offers

__all__ = [
    "CAMERAS",
    "ROBOTS",
    "CsvPlayer",
    "FolderCamera",
    "Frame",
    "FrameSource",
    "GenICamCamera",
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
"""Name -> driver; those that take a spec without their name are asked in this order."""

ROBOTS: Registry[type[RobotDriver]] = Registry(
    "robot", {"person": Person, "csv": CsvPlayer, "ur": URRobot}, "implicam.robots", offers(RobotDriver)
)
"""Name -> driver."""


def list_specs(drivers: Registry[Any]) -> str:
    """What the specs of all drivers look like, for help texts and errors.

    Args:
        drivers: `CAMERAS` or `ROBOTS`.

    Returns:
        The `spec` of each driver, with commas between them.
    """
    return ", ".join(driver.spec for driver in drivers.values())


def camera_from(name: str, spec: str, *, triggered: bool = False) -> FrameSource:
    """The camera that the words of a command line name; it is not opened.

    Args:
        name: The camera's name in the dataset.
        spec: A driver's name, a colon, and what it asks for; or what one of the drivers takes as it is.
        triggered: The camera exposes only when a trigger fires.

    Raises:
        UsageError: No driver takes it; the error says what the specs look like.
    """
    driver, colon, rest = spec.partition(":")
    if colon and driver in CAMERAS:
        return CAMERAS[driver].from_spec(name, rest, triggered=triggered)
    for kind in CAMERAS.values():
        if kind.takes(spec):
            return kind.from_spec(name, spec, triggered=triggered)
    known = (*CAMERAS, "/dev/video0", *STREAM_PREFIXES)
    raise _unknown_error("camera", spec, known, CAMERAS, why="there is no such file or folder either")


def robot_from(spec: str, **options: Any) -> Robot:
    """The robot that the words of a command line name; it is not connected.

    Args:
        spec: A driver's name; for most a colon, and what it asks for: "ur:192.168.0.10".
        options: The fields of `RobotOptions`.

    Raises:
        UsageError: There is no such driver, or something that it needs is missing.
    """
    name, _, rest = spec.partition(":")
    if name not in ROBOTS:
        raise _unknown_error("robot", spec, tuple(ROBOTS), ROBOTS)
    return ROBOTS[name].from_spec(rest, RobotOptions(**options))


def trigger_from(spec: str) -> Trigger:
    """The trigger box at an address; it is not connected.

    Args:
        spec: "udp://host:port" or "tcp://host:port".

    Raises:
        UsageError: The address is of no such form.
    """
    return NetworkTrigger(spec)


def _unknown_error(what: str, spec: str, known: tuple[str, ...], drivers: Registry[Any], why: str = "") -> UsageError:
    hint = did_you_mean(spec, known) or did_you_mean(spec.partition(":")[0], [word.partition(":")[0] for word in known])
    return UsageError(f"{spec!r} names no {what}{hint}.", why=why, fix=f"write {list_specs(drivers)}")
