"""Cameras, triggers and robots behind three small protocols; one driver, one file. See docs/hardware.md.

camera = camera_from("cam1", "rtsp://192.168.0.21/main")
robot = robot_from("ur:192.168.0.10", box=((200, -300, 100), (600, 300, 500)))
robot.move(xyz); frame = camera.frame()
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from implicam.errors import UsageError, did_you_mean
from implicam.hardware.csv_player import CsvPlayer
from implicam.hardware.folder_camera import FolderCamera
from implicam.hardware.genicam import GenICamCamera
from implicam.hardware.opencv_camera import STREAMS, OpenCVCamera
from implicam.hardware.person import Person
from implicam.hardware.protocol import Frame, FrameSource, Robot, Trigger, exposed
from implicam.hardware.simulated import PhotographingCamera, SimulatedRobot, simulated_rig
from implicam.hardware.trigger import NetworkTrigger, TriggerSimulator
from implicam.hardware.ur import URRobot

__all__ = [
    "CsvPlayer",
    "FolderCamera",
    "Frame",
    "FrameSource",
    "GenICamCamera",
    "NetworkTrigger",
    "OpenCVCamera",
    "Person",
    "PhotographingCamera",
    "Robot",
    "SimulatedRobot",
    "Trigger",
    "TriggerSimulator",
    "URRobot",
    "camera_from",
    "exposed",
    "robot_from",
    "simulated_rig",
    "trigger_from",
]

CAMERAS = "0, /dev/video0, rtsp://..., http://..., film.avi, folder/, genicam:SERIAL@producer.cti"


def camera_from(name: str, spec: str, *, triggered: bool = False) -> FrameSource:
    """The camera that the words of a command line name: one of `CAMERAS`; UsageError for others. Opens nothing.

    triggered: it exposes only when a trigger fires.
    """
    if spec.startswith("genicam:"):
        serial, _, producer = spec.removeprefix("genicam:").partition("@")
        if not serial or not producer:
            raise _unknown("camera", spec, (), "genicam:SERIAL@/path/of/producer.cti")
        return GenICamCamera(name, serial, producer, triggered=triggered)
    if spec.isdecimal() or spec.startswith(("/dev/", *STREAMS)):
        return OpenCVCamera(name, spec, triggered=triggered)
    if spec.endswith("/") or (spec and Path(spec).is_dir()):
        return FolderCamera(name, spec)
    if Path(spec).is_file():
        return OpenCVCamera(name, spec)
    raise _unknown("camera", spec, ("genicam", "/dev/video0", *STREAMS), CAMERAS)


def robot_from(spec: str, *, ask: Callable[[Any], None] | None = None, **ur: Any) -> Robot:
    """The robot that "ur:HOST", "csv:FILE" or "person" names; UsageError for others. Opens nothing.

    ask: what shows a person where the target is to go. ur: options of `URRobot`; its box is required.
    """
    kind, _, rest = spec.partition(":")
    if kind == "ur" and rest:
        if ur.get("box") is None:
            raise UsageError(
                f"{spec} needs a box that it may move in.",
                why="without one, a mistyped number is a collision",
                fix="give two opposite corners of the free space, in the dataset's unit, robot base frame",
            )
        return URRobot(rest, **ur)
    if kind == "csv" and rest:
        return CsvPlayer(rest)
    if spec == "person" and ask is not None:
        return Person(ask)
    raise _unknown("robot", spec, ("ur:HOST", "csv:FILE", "person"), "ur:HOST, csv:FILE, person")


def trigger_from(spec: str) -> Trigger:
    """The trigger box at "udp://host:port" or "tcp://host:port"; UsageError for others. Opens nothing."""
    return NetworkTrigger(spec)


def _unknown(what: str, spec: str, known: tuple[str, ...], fix: str) -> UsageError:
    hint = did_you_mean(spec, known) or did_you_mean(spec.partition(":")[0], [word.partition(":")[0] for word in known])
    return UsageError(
        f"{spec!r} names no {what}{hint}.", why="there is no such file or folder either", fix=f"write {fix}"
    )
