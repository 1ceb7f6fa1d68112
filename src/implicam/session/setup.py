"""From words to a guided session: which cameras, robot and rules; kept in the session, so that it can be continued."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from implicam.active import (
    Below,
    Budget,
    Converged,
    Loop,
    Rule,
    Time,
    Within,
    Workspace,
    acquisition_from_name,
    workspace_from,
)  # fmt: skip
from implicam.active.acquisitions import ACQUISITIONS, DEFAULT_ACQUISITION
from implicam.active.board_loop import Pictures
from implicam.active.board_poses import turn_from
from implicam.active.design_model import can_design_experiments, design_error, design_methods
from implicam.addresses import without_secrets
from implicam.calibrators import CALIBRATORS, DEFAULT_METHOD, calibrator_from_name
from implicam.dataset import Camera, Floats
from implicam.dataset.boards import BOARD_KINDS
from implicam.dataset.units import METRES_PER_UNIT, refuse_unknown_unit
from implicam.dataset.wand import WAND
from implicam.detect import Ball, Detector
from implicam.errors import DatasetError, HardwareError, UsageError
from implicam.hardware import (
    CAMERAS,
    ROBOTS,
    TRIGGERS,
    FrameSource,
    Person,
    Robot,
    TellsSettings,
    Trigger,
    camera_from,
    compare_settings,
    keep_settings,
    list_specs,
    open_all,
    refuse_one_device_twice,
    robot_from,
    simulated_rig,
    take_frames,
    tell_settings,
    triggers_from,
)
from implicam.registry import Option
from implicam.rig_model import MIN_POINTS_PER_CAMERA
from implicam.session.board_setup import (
    BALL,
    SIMULATED,
    SIMULATED_SPEED,
    SIZES,
    board_detector,
    board_hardware,
    board_settings,
    made_board_session,
    shown_target,
    sizes_of,
)
from implicam.session.controller import Equipment, SessionController
from implicam.session.folder import is_session
from implicam.session.journal import Session
from implicam.session.trust import (
    DEVICES,
    check_nothing_native,
    check_passwords,
    check_trusted,
    in_words,
    remember,
)
from implicam.session.wand_setup import (
    WAND_OPTIONS,
    made_wand_session,
    wand_detector,
    wand_hardware,
    wand_settings,
)
from implicam.simulate import BALL_RADIUS_MM, Rig, build_rig

CAMERAS_KEY = "camera_settings"
"""The setting of a session that holds what its cameras were set to, as `keep_settings` gives it."""

MAX_POINTS, MAX_FRAMES = 60, 1000
"""Points or boards, and frames of a wand, after which a session ends that says nothing else."""

PICTURE_TIMEOUT_SECONDS, LIVE_TIMEOUT_SECONDS = 60.0, 10.0
"""For the next picture: of a camera that has none to spare, because somebody or another program has to take it; and of
one that is live or triggered."""

# options under the headings of `implicam acquire --help`
_rig = partial(Option, panel="Without hardware")
_real = partial(Option, panel="Cameras and robot")
_plan = partial(Option, panel="Where, and how long")
_shown = partial(Option, panel="What is shown to the cameras")

Tool = tuple[float, ...]


@dataclass(frozen=True)
class Setup:
    """What a session is begun with, as plain values: the options of `implicam acquire`, and what a session keeps.

    Lengths are in the dataset's unit. Without `cameras`, (name, spec) each, it is the simulated `rig`, built with
    `seed`. robot: "" for what goes with the cameras, else a spec of `robot_from`. workspace: words as `workspace_from`
    takes them, "" for what the robot can reach. reach: as in `Loop`. sd: standard uncertainty of the robot's positions,
    or of what a person types, None for the robot's own. tool: the ball's centre in the frame of a UR robot's flange,
    None for the TCP that is set on it. target: what is shown, and of a board held by hand its size; then `workspace` is
    in the frame of the first camera, and "" for where it is seen well. `cameras` and `tool` may be the words of a
    command line.

    Raises:
        UsageError: a value is not possible.
    """

    rig: Annotated[str, _rig("bar6, grid9, dome8 ..., or a drawing RIG.toml")] = "bar6"
    rig_cameras: Annotated[str | None, _rig("Some of its cameras: 2R, cam1,cam4", "LIST", flags="--cameras")] = None
    target: Annotated[str, _shown(lambda: f"{', '.join((BALL, *BOARD_KINDS, WAND))}")] = BALL
    board: Annotated[str | None, _shown("Of a board: inner corners, squares, tags or dots, 8x11", "RxC")] = None
    square: Annotated[float | None, _shown("Edge of its squares", "LENGTH", 0)] = None
    marker: Annotated[float | None, _shown("charuco: edge of its markers", "LENGTH", 0)] = None
    tag: Annotated[float | None, _shown("aprilgrid: edge of its tags", "LENGTH", 0)] = None
    spacing: Annotated[
        float | None, _shown("aprilgrid: between two tags; dots: from one row to the next", "LENGTH", 0)
    ] = None
    dictionary: Annotated[str | None, _shown("charuco, aprilgrid: OpenCV's name of the markers")] = None
    legacy: Annotated[bool, _shown("charuco: printed with OpenCV before 4.6", flags="--legacy/--no-legacy")] = False
    wand: Annotated[float | None, _shown("Of a wand: between its two ends", "LENGTH", 0)] = None
    wand_sd: Annotated[float | None, _shown("Standard uncertainty of that length", "LENGTH", 0)] = None
    markers: Annotated[int | None, _shown("wand: 2 (default), or 3 on a line", "N", 2)] = None
    told_by: Annotated[str | None, _shown("wand: which end is which: size, brightness, spacing", "NAME")] = None
    poses: Annotated[
        str, _shown('A board at known poses, one after the other: a CSV, or "x=0 y=0 z=0:190:10"', "WHAT")
    ] = ""
    facing: Annotated[
        str, _shown('A board on a robot: "nx,ny,nz", the normal of its printed side, or r:rx,ry,rz', "N")
    ] = ""
    hold_out: Annotated[
        int, _shown("Boards at known poses that judge the calibration, and are not used for it", "N", 0)
    ] = 0
    cameras: Annotated[
        tuple[tuple[str, str], ...],
        _real(lambda: f"One a camera; WHAT is {list_specs(CAMERAS)}", "NAME=WHAT", flags="--camera", kind=list[str]),
    ] = ()
    robot: Annotated[str, _real(lambda: f"{list_specs(ROBOTS)} (default {Person.spec})", "WHAT")] = ""
    trigger: Annotated[
        tuple[str, ...],
        _real(lambda: f"{list_specs(TRIGGERS)}; several boxes: one each, =cam1,cam2", "WHAT", kind=list[str]),
    ] = ()
    pulse_every: Annotated[float, _real("With a trigger: between pulses for live pictures, 0: none", "S")] = 1.0
    speed: Annotated[float | None, _real("Of the robot", "M/S")] = None
    sd: Annotated[float | None, _real("Standard uncertainty of known positions", "LENGTH")] = None
    tool: Annotated[Tool | None, _real("ur: the ball's centre, from the flange", "X,Y,Z", kind=str)] = None
    dry_run: Annotated[bool, _real("ur: say where it would go; move nothing", flags="--dry-run/--no-dry-run")] = False
    radius: Annotated[float | None, _real("Of the ball, to correct its outline", "LENGTH")] = None
    bright: Annotated[bool, _real("The ball is lighter than what is behind", flags="--bright/--dark")] = False
    unit: Annotated[str, _real("Of lengths", "UNIT")] = "mm"
    workspace: Annotated[str, _plan('x0:x1,y0:y1,z0:z1, a CSV of places, or "x=0,50 y=0:80:20 z=0,40"', "WHERE")] = ""
    below: Annotated[float | None, _plan("Stop at this 95 % uncertainty, everywhere", "LENGTH")] = None
    within: Annotated[float, _plan("Or at so many times what pixel noise leaves", "TIMES")] = 1.2
    converged: Annotated[float | None, _plan("Or when five points changed it by less than so many %", "PERCENT")] = None
    budget: Annotated[int | None, _plan("Or after N points, boards (60) or frames of a wand (1000)", "N", 1)] = None
    minutes: Annotated[float | None, _plan("Or after so many minutes of this sitting", "MIN")] = None
    acquisition: Annotated[str, _plan(lambda: ", ".join(ACQUISITIONS))] = DEFAULT_ACQUISITION
    reach: Annotated[float | None, _plan("A way that costs as much time as one point: no zigzag", "LENGTH")] = None
    method: Annotated[str, _plan(lambda: ", ".join(design_methods()))] = DEFAULT_METHOD
    seed: Annotated[int, _plan("Rig and choices", "N", 0)] = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(map(_camera, self.cameras)))
        _refuse_twice([name for name, _ in self.cameras])
        trigger: Any = self.trigger or ()  # older sessions have None, or one
        object.__setattr__(self, "trigger", (trigger,) if isinstance(trigger, str) else tuple(trigger))
        object.__setattr__(self, "target", shown_target(self.target))
        object.__setattr__(self, "tool", None if self.tool is None else _tool(self.tool))
        refuse_unknown_unit(self.unit)
        method, _ = CALIBRATORS.find(self.method)
        if not can_design_experiments(method.calibration):
            raise design_error(method.calibration.method)
        acquisition_from_name(self.acquisition)
        _ = self.rule
        for what in ("reach", "speed", "sd", "radius", "converged", "minutes"):
            value = getattr(self, what)
            if value is not None and not 0 < value < np.inf:
                raise UsageError(f"{what} = {value:g} is not possible.", fix="give a number greater than zero")
        if not 0 <= self.pulse_every < np.inf:
            raise UsageError(f"--pulse-every {self.pulse_every:g} is no time.", fix="give seconds, or 0 for no pulse")
        self._refuse_words_of_another_target()
        if self.target == WAND:
            wand_detector(self)
        elif self.target != BALL:
            board_detector(self)
            if self.facing:
                turn_from(self.facing, "--facing")
        if (self.poses or self.facing or self.hold_out) and self.target in (BALL, WAND):
            raise UsageError(
                "--poses, --facing and --hold-out are those of a board.",
                fix=f"--target {'|'.join(BOARD_KINDS)}; a ball: --workspace",
            )
        if self.most < MIN_POINTS_PER_CAMERA:
            raise UsageError(
                f"{self.most} points are too few to calibrate.", fix=f"a budget of {MIN_POINTS_PER_CAMERA} or more"
            )

    def _refuse_words_of_another_target(self) -> None:
        """The size of a board says nothing of a wand: who gives it means another target."""
        others = {BALL: (*SIZES, *WAND_OPTIONS), WAND: (*SIZES, "radius")}.get(self.target, (*WAND_OPTIONS, "radius"))
        stray = [f"--{name.replace('_', '-')}" for name in others if getattr(self, name) not in (None, False)]
        if stray:
            raise UsageError(
                f"{', '.join(stray)}: the target is a {self.target}, of which that says nothing.",
                fix=f"leave it out, or say what is shown: --target {'|'.join((BALL, *BOARD_KINDS, WAND))}",
            )

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> Setup:
        """The inverse of `as_settings`.

        Args:
            settings: Plain values; what this version does not know is left out.

        Raises:
            DatasetError: A value is of another kind.
        """
        known = {field.name: field.default for field in fields(cls)}
        try:
            for key, default in known.items():
                if isinstance(default, str) and not isinstance(settings.get(key, ""), str):
                    raise TypeError(f"{key} is no text")
            return cls(**{key: value for key, value in settings.items() if key in known})
        except (TypeError, ValueError, AttributeError) as error:
            raise DatasetError(
                "the settings of this session cannot be read.",
                why=str(error),
                fix="bring back a copy of session.db, or begin another session",
            ) from error

    def as_settings(self) -> dict[str, Any]:
        """As plain values, for the session's own table: without passwords."""
        kept = asdict(self)
        kept["cameras"] = [[name, without_secrets(spec)] for name, spec in self.cameras]
        kept["robot"] = without_secrets(self.robot)
        kept["trigger"] = list(map(without_secrets, self.trigger))
        kept["tool"] = None if self.tool is None else list(self.tool)
        return kept

    @property
    def simulated(self) -> bool:
        """Whether there is no hardware."""
        return not self.cameras

    @property
    def most(self) -> int:
        """After so many points, boards or frames it ends."""
        return self.budget or (MAX_FRAMES if self.target == WAND else MAX_POINTS)

    @property
    def rule(self) -> Rule:
        """When to stop."""
        most: Rule = Budget(self.most)
        if self.target != BALL:
            most = Pictures(self.most, "frames" if self.target == WAND else "boards")
        rule = Within(self.within) | most
        if self.below is not None:
            rule = Below(self.below, "usual" if self.target == WAND else "worst") | rule
        if self.converged is not None:
            rule = rule | Converged(self.converged / 100)
        return rule if self.minutes is None else rule | Time(60 * self.minutes)

    def built(self) -> Rig:
        """The simulated rig."""
        if self.unit not in ("mm", "m"):
            raise UsageError("a simulated rig has mm or m.", fix="--unit mm")
        return build_rig(self.rig, seed=self.seed, unit=self.unit, cameras=self.rig_cameras)  # type: ignore[arg-type]


def _camera(camera: str | Sequence[str]) -> tuple[str, str]:
    """Name and spec of a camera, as they are or as "name=spec"."""
    if not isinstance(camera, str):
        name, spec = camera
        return str(name), str(spec)
    name, _, spec = camera.partition("=")
    if not (name and spec):
        raise UsageError(f"--camera {camera} names no camera.", fix="write --camera left=0")
    return name, spec


def _refuse_twice(names: Sequence[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"there are two cameras {name!r}.", fix="give each camera its own name")


def _tool(tool: str | Sequence[float]) -> Tool:
    return tuple(position_from_text(tool, "--tool").tolist()) if isinstance(tool, str) else tuple(map(float, tool))


def position_from_text(text: str, option: str) -> Floats:
    """The position that "120,-40,300" means.

    Args:
        text: Three numbers with commas between them.
        option: Of the command line, which the error names.

    Returns:
        (3,) as given.

    Raises:
        UsageError: It is no position.
    """
    try:
        position = np.array([float(number) for number in text.split(",")], dtype=np.float64)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise ValueError("it takes three numbers")
    except ValueError as error:
        raise UsageError(f"{text!r} is no position.", why=str(error), fix=f"write {option}=120,-40,300") from error
    return position


Hardware = tuple[list[FrameSource], Robot, Workspace | None]
"""The workspace is None for a board that nobody has said the volume of."""


def open_session(
    folder: Path,
    setup: Setup | None,
    *,
    auto: bool = False,
    named: Collection[str] | None = None,
    trust: bool = False,
    say: Callable[[str], None] = print,
) -> SessionController:
    """The controller of a new session, or of the one in the folder.

    The robot is connected, so that a wrong address is said at once, and never kept. The cameras of a new session are
    opened to learn the size of the pictures.

    Args:
        folder: Of the session.
        setup: What to begin it with, or what to change; None for what it was begun with.
        auto: Go on without being asked.
        named: The fields of `setup` that a person has named just now; None for all where there is a setup. What is left
            must have been confirmed on this machine before (trust.py).
        trust: The person confirms all equipment of the session.
        say: Shows a line of text.

    Raises:
        UsageError: The folder is in use or holds something else, the setup is not possible, or equipment of a session
            from elsewhere was not confirmed.
        HardwareError: The robot, or in a new session a camera, does not answer.
    """
    if is_session(folder):
        session = Session.open(folder)
        try:
            now = _continued(session, setup)
            if named is None:
                named = () if setup is None else now.as_settings()
            check_nothing_native(folder, asdict(now))
            check_trusted(folder, now.as_settings(), named=named, trust=trust)
            check_passwords(folder, asdict(now))
            with _connected(_found_again(session, now, say)) as hardware:
                _compare_cameras(session, hardware[0], say)
                controller = _made(session, now, hardware, auto)
                kept = session.settings
                for key, value in now.as_settings().items():  # once it is known that it works
                    if key not in kept or kept[key] != value:
                        session.set(key, value)
                return controller
        except BaseException:
            session.close()
            raise
    setup = setup or Setup()
    with _connected(_hardware(setup, say)) as hardware:
        sized = _sized(setup, hardware[0], say)
        session = Session.create(
            folder,
            name=folder.absolute().name,
            length_unit=setup.unit,
            cameras=sized,
            settings={
                **setup.as_settings(),
                CAMERAS_KEY: keep_settings(hardware[0]),
                **_shown_settings(setup),
            },
        )
        remember(folder, setup.as_settings())
        return _made(session, setup, hardware, auto)


def _shown_settings(setup: Setup) -> dict[str, Any]:
    """What a session keeps of what it shows."""
    if setup.target == BALL:
        return {}
    return wand_settings(setup) if setup.target == WAND else board_settings(setup)


def _compare_cameras(session: Session, cameras: Sequence[FrameSource], say: Callable[[str], None]) -> None:
    """Say which devices are set otherwise than when the session was begun, or are others; one that does not open is the
    page's to tell."""
    telling = [camera for camera in cameras if isinstance(camera, TellsSettings)]
    if not telling:
        return
    with ThreadPoolExecutor(len(telling)) as pool:
        list(pool.map(_opened_once, telling))
    now = keep_settings(telling)
    if now:
        for text in (*tell_settings(telling), *compare_settings(session.settings.get(CAMERAS_KEY, {}), now)):
            say(text)
        session.set(CAMERAS_KEY, now)


def _opened_once(camera: FrameSource) -> None:
    with suppress(HardwareError):
        camera.open()
    camera.close()


@contextmanager
def _connected(hardware: Hardware) -> Iterator[Hardware]:
    """With the robot connected; it is let go of after an error."""
    robot = hardware[1]
    try:
        robot.open()
        yield hardware
    except BaseException:
        robot.close()
        raise


def _found_again(session: Session, setup: Setup, say: Callable[[str], None]) -> Hardware:
    """As `_hardware`; what a session was begun with and is not to be had any more is said to be of the session."""
    before = Setup.from_settings(session.settings)
    try:
        return _hardware(setup, say)
    except UsageError as error:
        if (setup.cameras, setup.robot, setup.trigger) != (before.cameras, before.robot, before.trigger):
            raise
        words = in_words({key: value for key, value in before.as_settings().items() if key in DEVICES})
        raise UsageError(
            f"the session in {session.folder} cannot go on: {error.what}",
            why=f"it was begun with {words}; what was measured is kept" + (f". {error.why}" if error.why else ""),
            fix=f"{error.fix}. Where a package brought what is missing, install it again; or name another",
        ) from error


def _continued(session: Session, setup: Setup | None) -> Setup:
    """What the session was begun with; another setup replaces it where the rig and the unit stay."""
    before = Setup.from_settings(session.settings)
    if setup is None:
        return before
    changes_to(session.folder, before, {key: getattr(setup, key) for key in _lasting(before)}, all_given=True)
    if setup.simulated != before.simulated:
        raise UsageError(f"the session in {session.folder} has other cameras.", fix="begin another in another folder")
    return setup


def _lasting(before: Setup) -> list[str]:
    """What a session keeps to its end."""
    return [
        "unit",
        "target",
        "poses",
        "facing",
        "hold_out",
        *SIZES,
        *WAND_OPTIONS,
        *(("rig", "rig_cameras", "seed") if before.simulated else ()),
    ]


def changes_to(folder: Path, before: Setup, given: Mapping[str, Any], *, all_given: bool = False) -> dict[str, Any]:
    """What is given anew for a session that is there, without what it has anyway.

    Args:
        folder: Of the session.
        before: What it was begun with.
        given: Options by name; None for those that were not given.
        all_given: None is a value too.

    Raises:
        UsageError: Something is to be another that stays to the end: what is shown, its size, the unit.
    """
    found = given = {**given, "target": shown_target(given.get("target"))}
    if given.get("unit") is not None:  # a word that is none is a slip of the hand, whatever was begun
        refuse_unknown_unit(given["unit"])
    has = {**{key: getattr(before, key) for key in _lasting(before)}, **sizes_of(before)}
    for key in has:
        if key not in given or given[key] == getattr(before, key) or (given[key] is None and not all_given):
            continue
        if given[key] != has[key]:
            shown = f"{key.replace('_', '-')} {has[key]}" if has[key] not in (None, "") else f"no {key}"
            raise UsageError(
                f"the session in {folder} was begun with {shown}.",
                fix="leave the option out, or begin another session in another folder",
            )
        found[key] = getattr(before, key)
    return found


def _made(session: Session, setup: Setup, hardware: Hardware, auto: bool) -> SessionController:
    cameras, robot, workspace = hardware
    trigger = trigger_of(setup)
    radius = setup.radius
    if radius is None and setup.simulated and setup.target == BALL:
        radius = BALL_RADIUS_MM * setup.built().units_per_mm
    waits = trigger is None and not all(source.live for source in cameras)
    timeout = PICTURE_TIMEOUT_SECONDS if waits else LIVE_TIMEOUT_SECONDS
    detector: Detector = Ball(bright=setup.bright)
    if setup.target != BALL:
        detector = wand_detector(setup) if setup.target == WAND else board_detector(setup)
    equipment = Equipment(
        cameras, robot, detector, trigger, radius, timeout, setup.dry_run, setup.unit,
        setup.pulse_every,
    )  # fmt: skip
    if setup.target == WAND:
        return made_wand_session(session, setup, equipment, workspace)
    if setup.target != BALL:
        return made_board_session(session, setup, equipment, workspace)
    assert workspace is not None
    loop = Loop(
        calibrator_from_name(setup.method),
        workspace,
        acquisition_from_name(setup.acquisition),
        setup.rule,
        reach=np.inf if setup.reach is None else setup.reach,
        seed=setup.seed,
    )
    return SessionController(session, equipment, loop, auto=auto)


def _hardware(setup: Setup, say: Callable[[str], None]) -> Hardware:
    if setup.target != BALL:
        if setup.simulated:
            trigger_of(setup)  # there must be none
        shown = None if setup.simulated else cameras_of(setup)
        if setup.target == WAND:
            return wand_hardware(setup, shown)
        return board_hardware(setup, shown, lambda: _robot(setup, say))
    if setup.simulated:
        return _simulated(setup)
    cameras = cameras_of(setup)
    robot = _robot(setup, say)
    if setup.workspace:
        return cameras, robot, workspace_from(setup.workspace, None)
    robot.open()
    places = robot.reachable()
    if places is None:
        raise UsageError(
            "there is no workspace.",
            why="where the target can be put is not known",
            fix="give it in the dataset's unit: --workspace=x0:x1,y0:y1,z0:z1, or a CSV file of places",
        )
    return cameras, robot, Workspace.only(places)


def cameras_of(setup: Setup, *, triggered: bool = False) -> list[FrameSource]:
    """The cameras of a setup with hardware, not opened yet.

    Args:
        setup: With `cameras`.
        triggered: Whether another trigger than the setup's exposes them.

    Raises:
        UsageError: A spec names no camera or no trigger, or two cameras are one device.
    """
    triggered = triggered or trigger_of(setup) is not None
    cameras = [camera_from(name, spec, triggered=triggered) for name, spec in setup.cameras]
    refuse_one_device_twice(cameras)
    return cameras


def trigger_of(setup: Setup) -> Trigger | None:
    """The trigger of a setup, all its boxes as one, not connected yet; None where it has none.

    Args:
        setup: Its cameras say which names the boxes may have.

    Raises:
        UsageError: A spec names no trigger, a camera hangs on no box or on two, or the cameras are simulated.
    """
    if setup.trigger and setup.simulated:
        raise UsageError(
            "simulated cameras wait for no trigger.", fix="give cameras (--camera NAME=WHAT), or leave --trigger out"
        )
    return triggers_from(setup.trigger, [name for name, _ in setup.cameras])


def _simulated(setup: Setup) -> Hardware:
    rig = setup.built()
    trigger_of(setup)  # there must be none
    if setup.robot not in ("", SIMULATED):
        raise UsageError(
            f"the robot {setup.robot!r} does not move in front of simulated cameras.",
            fix="give cameras (--camera NAME=WHAT), or leave --robot out",
        )
    speed = (setup.speed or SIMULATED_SPEED) / METRES_PER_UNIT[setup.unit]
    cameras, robot = simulated_rig(rig, seed=setup.seed, sd=setup.sd or 0.0, speed=speed)
    workspace = workspace_from(setup.workspace, None) if setup.workspace else Workspace.from_box(rig.volume)
    return list(cameras), robot, workspace


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


def _sized(setup: Setup, cameras: list[FrameSource], say: Callable[[str], None]) -> list[Camera]:
    """The cameras with the size of their pictures: one of each is taken, and they are closed again."""
    if setup.simulated:
        return [Camera(camera.name, camera.width, camera.height) for camera in setup.built().cameras]
    trigger = trigger_of(setup)
    if trigger is None and not all(source.live for source in cameras):
        say("waiting for one picture of each camera, to learn its size")
    with ExitStack() as devices, ThreadPoolExecutor(len(cameras)) as pool:
        needed: list[FrameSource | Trigger] = [*cameras, *([] if trigger is None else [trigger])]
        for device in needed:
            devices.callback(device.close)
        open_all(needed, pool)
        timeout = PICTURE_TIMEOUT_SECONDS if trigger is None else LIVE_TIMEOUT_SECONDS
        frames = take_frames(cameras, trigger, timeout, pool)
        for text in tell_settings(cameras):
            say(text)
        sizes = [frame.picture.shape for frame in frames]
    return [Camera(source.name, width, height) for source, (height, width) in zip(cameras, sizes, strict=True)]


def with_options(setup: Setup, **given: Any) -> Setup:
    """The setup with what was given on the command line.

    Args:
        setup: What was there.
        given: Options by name; None for those that were not given.
    """
    return replace(setup, **{key: value for key, value in given.items() if value is not None})
