"""Cameras, triggers and robots behind small protocols; one driver, one file. See docs/hardware.md.

camera = camera_from("cam1", "rtsp://192.168.0.21/main")
robot = robot_from("ur:192.168.0.10", box=((200, -300, 100), (600, 300, 500)))
robot.move(xyz); frame = camera.frame()
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from implicam.errors import UsageError, did_you_mean
from implicam.formatting import list_some
from implicam.hardware.csv_player import CsvPlayer
from implicam.hardware.device_settings import changed_settings, shared_device
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
    TellsSettings,
    Trigger,
    TriggerDriver,
    open_all,
    take_frames,
)
from implicam.hardware.simulated import PhotographingCamera, SimulatedRobot, simulated_rig
from implicam.hardware.trigger import NetworkTrigger, TCPTrigger, TriggerBoxes, TriggerSimulator
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
    "TellsSettings",
    "Trigger",
    "TriggerBoxes",
    "TriggerSimulator",
    "URRobot",
    "camera_from",
    "compare_settings",
    "guard_robot",
    "keep_settings",
    "list_specs",
    "open_all",
    "refuse_one_device_twice",
    "robot_from",
    "simulated_rig",
    "take_frames",
    "tell_settings",
    "trigger_from",
    "triggers_from",
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


def triggers_from(specs: Sequence[str], cameras: Sequence[str]) -> Trigger | None:
    """The trigger of all cameras that the words of a command line name; nothing is connected.

    Args:
        specs: Of one box for all cameras, as `trigger_from` takes it; or of several, each with its cameras:
            "udp://192.168.0.50:4000=cam1,cam2".
        cameras: The names of all cameras.

    Returns:
        One trigger, whatever the number of boxes; None where there is no spec.

    Raises:
        UsageError: A camera hangs on no box or on two, a name is of no camera, or a spec names no trigger.
    """
    if not specs:
        return None
    wired = [_read_wires(spec, cameras, alone=len(specs) == 1) for spec in specs]
    box_of: dict[str, str] = {}
    for address, names in wired:
        for name in names:
            if name in box_of:
                raise UsageError(
                    f"camera {name} hangs on two trigger boxes, {box_of[name]} and {address}.",
                    why="a camera listens to one line",
                    fix="name it in one --trigger only",
                )
            box_of[name] = address
    idle = [name for name in cameras if name not in box_of]
    if idle:
        raise UsageError(
            f"on no trigger box hangs {list_some(idle)}.",
            why="the pictures of a set are of the same pulse, so all cameras are triggered or none",
            fix=f"add it to a box: --trigger {wired[0][0]}={','.join([*wired[0][1], *idle])}",
        )
    if len(wired) == 1:
        return trigger_from(wired[0][0])
    addresses = [address for address, _ in wired]
    twice = next((address for address in addresses if addresses.count(address) > 1), None)
    if twice is not None:
        raise UsageError(f"the trigger box {twice} is there twice.", fix="name all its cameras in one --trigger")
    return TriggerBoxes([(trigger_from(address), names) for address, names in wired])


def _read_wires(spec: str, cameras: Sequence[str], *, alone: bool) -> tuple[str, tuple[str, ...]]:
    """The address of a box and the cameras on it."""
    address, equals, words = spec.rpartition("=")
    if not equals:
        if alone:
            return spec, tuple(cameras)
        raise UsageError(
            f"--trigger {spec} does not say which cameras hang on it.",
            why="there are several trigger boxes",
            fix=f"write --trigger {spec}=cam1,cam2",
        )
    names = tuple(dict.fromkeys(name.strip() for name in words.split(",") if name.strip()))
    for name in names:
        if name not in cameras:
            raise UsageError(
                f"--trigger {spec} names {name!r}, and there is no such camera{did_you_mean(name, cameras)}.",
                fix=f"the cameras are {', '.join(cameras)}",
            )
    if not names:
        raise UsageError(f"--trigger {spec} names no camera.", fix=f"write --trigger {address}=cam1,cam2")
    return address, names


def tell_settings(cameras: Sequence[FrameSource]) -> list[str]:
    """What the cameras were set to when they were opened, in sentences.

    Args:
        cameras: Those that cannot tell are left out.
    """
    return [text for camera in cameras if isinstance(camera, TellsSettings) for text in camera.tell_settings()]


def keep_settings(cameras: Sequence[FrameSource]) -> dict[str, dict[str, str]]:
    """The same for a later session to compare with: camera -> "device" and "settings".

    Args:
        cameras: Those that cannot tell are left out.
    """
    told = {camera.name: camera.keep_settings() for camera in cameras if isinstance(camera, TellsSettings)}
    return {name: kept for name, kept in told.items() if kept}


def compare_settings(before: object, now: Mapping[str, Mapping[str, str]]) -> list[str]:
    """What is other than in an earlier session, in sentences.

    Args:
        before: As `keep_settings` gave it then; from a file, so that what is no such thing says nothing.
        now: As it gives it now.
    """
    told = []
    kept: Mapping[Any, Any] = before if isinstance(before, Mapping) else {}
    for name, today in now.items():
        then = kept.get(name)
        if not isinstance(then, Mapping) or not all(isinstance(text, str) for text in then.values()):
            continue
        if then.get("device") and today.get("device") and then["device"] != today["device"]:
            told.append(
                f"camera {name} is another device than before: it was {then['device']}, and is {today['device']}"
            )
        told += [
            f"camera {name}: {text}" for text in changed_settings(then.get("settings", ""), today.get("settings", ""))
        ]
    return told


def refuse_one_device_twice(cameras: Sequence[FrameSource]) -> None:
    """UsageError where two cameras are one device, under two of its names.

    Args:
        cameras: Not opened yet.
    """
    devices = [(camera.name, camera.source) for camera in cameras if isinstance(camera, OpenCVCamera) and camera.device]
    both = shared_device(devices)
    if both is not None:
        raise UsageError(
            f"the cameras {both[0]} and {both[1]} are one and the same device.",
            fix="give each its own: `ls -l /dev/v4l/by-id /dev/v4l/by-path` lists them",
        )


Driver = TypeVar("Driver")


def _find_driver(drivers: Registry[Driver], spec: str) -> tuple[Driver, str]:
    if spec.partition(":")[0] not in drivers:
        raise _unknown_error(drivers, spec, tuple(drivers))
    return drivers.find(spec)


def _unknown_error(drivers: Registry[Any], spec: str, known: tuple[str, ...], why: str = "") -> UsageError:
    hint = did_you_mean(spec, known) or did_you_mean(spec.partition(":")[0], [word.partition(":")[0] for word in known])
    return UsageError(f"{spec!r} names no {drivers.kind}{hint}.", why=why, fix=f"write {list_specs(drivers)}")
