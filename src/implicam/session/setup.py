"""From words to a guided session: which cameras, robot and rules; kept in the session, so that it can be continued."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from implicam.active import Below, Budget, Loop, Rule, Within, Workspace, acquisition_from_name, workspace_from
from implicam.active.acquisitions import DEFAULT_ACQUISITION
from implicam.active.design_model import can_design_experiments, design_error
from implicam.calibrators import CALIBRATORS, DEFAULT_METHOD, calibrator_from_name
from implicam.dataset import Camera, Floats
from implicam.dataset.model import METRES_PER_UNIT
from implicam.detect import Ball
from implicam.errors import UsageError, did_you_mean
from implicam.hardware import (
    FrameSource,
    Person,
    Robot,
    Trigger,
    camera_from,
    robot_from,
    simulated_rig,
    take_frames,
    trigger_from,
)
from implicam.rig_model import MIN_POINTS_PER_CAMERA
from implicam.session.controller import Equipment, SessionController
from implicam.session.folder import is_session
from implicam.session.journal import Session
from implicam.simulate import BALL_RADIUS_MM, Rig, build_rig

SIMULATED = "simulated"
SIMULATED_SPEED = 0.4
"""m/s of the simulated robot: fast enough not to wait for, slow enough to see it move."""

PATIENCE = 60.0
"""Seconds for the next picture of a camera that has none to spare: somebody, or another program, has to take it."""


@dataclass(frozen=True)
class Setup:
    """Plain values; lengths in the dataset's unit but where it says so.

    cameras: (name, spec) of real cameras, none for the simulated `rig` (with `rig_cameras` of it, built with `seed`).
    robot: "" for what goes with the cameras, else a spec of `robot_from`. radius: of the ball, to correct its outline.
    workspace: words as `workspace_from` takes them, "" for what the robot can reach. below: stop when the 95 %
    uncertainty is below it everywhere; within: or when it is so many times what pixel noise alone leaves; budget: or
    after so many points. reach: as in `Loop`. speed: m/s.
    sd: standard uncertainty of the robot's positions, or of what a person types, None for the robot's own. tool: the
    ball's centre in the frame of a UR robot's flange, None for the TCP that is set on it.
    """

    rig: str = "bar6"
    rig_cameras: str | None = None
    cameras: tuple[tuple[str, str], ...] = ()
    robot: str = ""
    trigger: str | None = None
    unit: str = "mm"
    radius: float | None = None
    bright: bool = False
    workspace: str = ""
    method: str = DEFAULT_METHOD
    acquisition: str = DEFAULT_ACQUISITION
    below: float | None = None
    within: float = 1.2
    budget: int = 60
    reach: float | None = None
    speed: float | None = None
    sd: float | None = None
    tool: tuple[float, ...] | None = None
    dry_run: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple((str(name), str(spec)) for name, spec in self.cameras))
        object.__setattr__(self, "tool", None if self.tool is None else tuple(map(float, self.tool)))
        if self.unit not in METRES_PER_UNIT:
            raise UsageError(
                f"there is no length unit {self.unit!r}{did_you_mean(self.unit, METRES_PER_UNIT)}.",
                fix=f"use {', '.join(METRES_PER_UNIT)}",
            )
        method, _ = CALIBRATORS.find(self.method)
        if not can_design_experiments(method.calibration):
            raise design_error(method.calibration.method)
        acquisition_from_name(self.acquisition)
        _ = self.rule
        for what in ("reach", "speed", "sd", "radius"):
            value = getattr(self, what)
            if value is not None and not 0 < value < np.inf:
                raise UsageError(f"{what} = {value:g} is not possible.", fix="give a number greater than zero")
        if self.budget < MIN_POINTS_PER_CAMERA:
            raise UsageError(
                f"{self.budget} points are too few to calibrate.", fix=f"a budget of {MIN_POINTS_PER_CAMERA} or more"
            )

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> Setup:
        """The inverse of `as_settings`; what this version does not know is left out."""
        known = {field.name for field in fields(cls)}
        return cls(**{key: value for key, value in settings.items() if key in known})

    def as_settings(self) -> dict[str, Any]:
        """As plain values, for the session's own table."""
        return asdict(self)

    @property
    def simulated(self) -> bool:
        """Whether there is no hardware."""
        return not self.cameras

    @property
    def rule(self) -> Rule:
        """When to stop."""
        rule = Within(self.within) | Budget(self.budget)
        return rule if self.below is None else Below(self.below) | rule

    def built(self) -> Rig:
        """The simulated rig."""
        if self.unit not in ("mm", "m"):
            raise UsageError("a simulated rig has mm or m.", fix="--unit mm")
        return build_rig(self.rig, seed=self.seed, unit=self.unit, cameras=self.rig_cameras)  # type: ignore[arg-type]


def open_session(
    folder: Path, setup: Setup | None, *, auto: bool = False, say: Callable[[str], None] = print
) -> SessionController:
    """The controller of a new session, or of the one in the folder: with its own setup where `setup` is None.

    Opens no camera and no robot yet but to learn the size of the pictures. UsageError where the folder is in use, or
    holds something else.
    """
    if is_session(folder):
        session = Session.open(folder)
        try:
            now = _continued(session, setup)
            controller = _made(session, now, _hardware(now, say), auto)
            kept = session.settings
            for key, value in now.as_settings().items():  # once it is known that it works
                if key not in kept or kept[key] != value:
                    session.set(key, value)
            return controller
        except BaseException:
            session.close()
            raise
    setup = setup or Setup()
    eyes, robot, room = _hardware(setup, say)
    session = Session.create(
        folder,
        name=folder.absolute().name,
        length_unit=setup.unit,
        cameras=_sized(setup, eyes, say),
        settings=setup.as_settings(),
    )
    return _made(session, setup, (eyes, robot, room), auto)


def _continued(session: Session, setup: Setup | None) -> Setup:
    """What the session was begun with; another setup replaces it where the rig and the unit stay."""
    before = Setup.from_settings(session.settings)
    if setup is None:
        return before
    same = ("rig", "rig_cameras", "unit", "seed") if before.simulated else ("unit",)
    for key in same:
        if getattr(setup, key) != getattr(before, key):
            raise UsageError(
                f"the session in {session.folder} was begun with {key} {getattr(before, key)}.",
                fix="leave the option out, or begin another session in another folder",
            )
    if setup.simulated != before.simulated:
        raise UsageError(f"the session in {session.folder} has other cameras.", fix="begin another in another folder")
    return setup


Hardware = tuple[list[FrameSource], Robot, Workspace]


def _made(session: Session, setup: Setup, hardware: Hardware, auto: bool) -> SessionController:
    eyes, robot, room = hardware
    trigger = None if setup.trigger is None else trigger_from(setup.trigger)
    radius = setup.radius
    if radius is None and setup.simulated:
        radius = BALL_RADIUS_MM * setup.built().units_per_mm
    timeout = 10.0 if trigger is not None or all(source.live for source in eyes) else PATIENCE
    equipment = Equipment(eyes, robot, Ball(bright=setup.bright), trigger, radius, timeout, setup.dry_run)
    loop = Loop(
        calibrator_from_name(setup.method),
        room,
        acquisition_from_name(setup.acquisition),
        setup.rule,
        reach=np.inf if setup.reach is None else setup.reach,
        seed=setup.seed,
    )
    return SessionController(session, equipment, loop, auto=auto)


def _hardware(setup: Setup, say: Callable[[str], None]) -> Hardware:
    if setup.simulated:
        return _simulated(setup)
    eyes = [camera_from(name, spec, triggered=setup.trigger is not None) for name, spec in setup.cameras]
    robot = _robot(setup, say)
    if setup.workspace:
        return eyes, robot, workspace_from(setup.workspace, None)
    robot.open()
    places = robot.reachable()
    if places is None:
        raise UsageError(
            "there is no workspace.",
            why="where the target can be put is not known",
            fix="give it in the dataset's unit: --workspace=x0:x1,y0:y1,z0:z1, or a CSV file of places",
        )
    return eyes, robot, Workspace.only(places)


def _simulated(setup: Setup) -> Hardware:
    rig = setup.built()
    if setup.robot not in ("", SIMULATED):
        raise UsageError(
            f"the robot {setup.robot!r} does not move in front of simulated cameras.",
            fix="give cameras (--camera NAME=WHAT), or leave --robot out",
        )
    speed = (setup.speed or SIMULATED_SPEED) / METRES_PER_UNIT[setup.unit]
    eyes, robot = simulated_rig(rig, seed=setup.seed, sd=setup.sd or 0.0, speed=speed)
    room = workspace_from(setup.workspace, None) if setup.workspace else Workspace.from_box(rig.volume)
    return list(eyes), robot, room


def _robot(setup: Setup, say: Callable[[str], None]) -> Robot:
    return robot_from(
        setup.robot or Person.spec,
        ask=lambda _: None,
        unit=setup.unit,
        box=_corners(setup),
        speed=setup.speed,
        sd=None if setup.sd is None else (setup.sd,) * 3,
        tool=setup.tool,
        dry_run=setup.dry_run,
        say=say,
    )


def _corners(setup: Setup) -> tuple[Floats, Floats] | None:
    """The box that a robot may move in: that around the workspace."""
    if not setup.workspace:
        return None
    vertices = workspace_from(setup.workspace, None).vertices
    return vertices.min(axis=0), vertices.max(axis=0)


def _sized(setup: Setup, eyes: list[FrameSource], say: Callable[[str], None]) -> list[Camera]:
    """The cameras with the size of their pictures: one of each is taken, and they are closed again."""
    if setup.simulated:
        return [Camera(camera.name, camera.width, camera.height) for camera in setup.built().cameras]
    trigger = None if setup.trigger is None else trigger_from(setup.trigger)
    if trigger is None and not all(source.live for source in eyes):
        say("waiting for one picture of each camera, to learn its size")
    with ExitStack() as devices, ThreadPoolExecutor(len(eyes)) as pool:
        needed: list[FrameSource | Trigger] = [*eyes, *([] if trigger is None else [trigger])]
        for device in needed:
            devices.callback(device.close)
            device.open()
        frames = take_frames(eyes, trigger, PATIENCE if trigger is None else 10.0, pool)
        sizes = [frame.picture.shape for frame in frames]
    return [Camera(source.name, width, height) for source, (height, width) in zip(eyes, sizes, strict=True)]


def changed(setup: Setup, **given: Any) -> Setup:
    """The setup with what was given on the command line: everything that is not None."""
    return replace(setup, **{key: value for key, value in given.items() if value is not None})
