"""From the words of a command line to a session with a board: which one, who holds it, and the loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from implicam.active import Workspace, workspace_from
from implicam.active.board_design import MIN_CORNERS, BoardShape
from implicam.active.board_loop import BoardLoop
from implicam.active.board_poses import (
    KnownPose,
    KnownPosesLoop,
    carried_poses,
    described,
    poses_from,
    poses_of,
    turn_from,
)
from implicam.calibrators import DEFAULT_METHOD, calibrator_from_name
from implicam.dataset import Floats
from implicam.dataset.boards import BOARD_KINDS, check_size, corner_positions
from implicam.dataset.units import METRES_PER_UNIT
from implicam.dataset.wand import WAND
from implicam.detect import ALSO_CALLED, TARGETS, Detector, options_of
from implicam.errors import UsageError, did_you_mean
from implicam.formatting import list_some
from implicam.geometry import Pose
from implicam.hardware import FrameSource, Person, Robot
from implicam.hardware.simulated import SimulatedRobot
from implicam.hardware.simulated_hand import simulated_hand
from implicam.session.board_session import BoardController
from implicam.session.controller import Equipment
from implicam.session.journal import TARGET_KEY, Session

if TYPE_CHECKING:
    from implicam.session.setup import Setup
    from implicam.simulate import Rig

BALL = "ball"

BOARD_METHOD = "explicit"
"""The one method that takes boards at places nobody knows."""

HAND_SECONDS = 1.5
"""That a simulated hand takes from one outline to the next, to be watched."""

EXAMPLE_BOARDS: dict[str, dict[str, Any]] = {
    "board": {"board": "8x11", "square": 13.29},
    "charuco": {"board": "9x12", "square": 13.29, "marker": 10.0},
    "aprilgrid": {"board": "5x7", "tag": 16.0, "spacing": 4.8},
    "dotgrid": {"board": "11x4", "spacing": 12.0},
}
"""Of a simulated session that says no size: in mm, that of the paper."""

POSES_KEY = "known_poses"
"""The setting of a session that holds the known poses of its board, as `described` gives them."""

MIN_DOTS_COSINE = 0.5
"""Of the angle between a plate of dots and the line to a camera that is to find all of them."""

MIN_SPACING_PX = 10.0
"""From one corner to the next, below which no picture is asked for."""

ROBOT_PLACES = 600
"""Where a robot can put the board, among which it is sent."""

SIMULATED = "simulated"
SIMULATED_SPEED = 0.4
"""m/s of the simulated robot: fast enough not to wait for, slow enough to see it move."""

SIZES = ("board", "square", "marker", "tag", "spacing", "dictionary", "legacy")
"""The options of a session that say what the board is."""


def shown_target(name: str | None) -> Any:
    """The target that a session shows by another name: a plate of dots that moves has no labels, and is `dotgrid`.

    Args:
        name: As a person says it; None where nothing is said.
    """
    return {**ALSO_CALLED, "dots": "dotgrid"}.get(name or "", name)


def board_detector(setup: Setup) -> Detector:
    """The detector of the board that a session shows.

    Args:
        setup: With a target that is a board.

    Raises:
        UsageError: It is no board, or its size is missing or impossible.
    """
    if setup.target not in BOARD_KINDS:
        raise UsageError(
            f"a session cannot show a target {setup.target!r}{did_you_mean(setup.target, (BALL, *BOARD_KINDS, WAND))}.",
            fix=f"--target {'|'.join((BALL, *BOARD_KINDS, WAND))}",
        )
    known, given = options_of(setup.target), sizes_of(setup)
    for name in given:
        if name not in known:
            raise UsageError(f"the target {setup.target!r} has no option --{name}.", fix="leave it out")
    detector: Detector = TARGETS[setup.target].from_options(Path(), {}, **given)
    table = detector.describe()
    if "square" not in table and setup.target == "board":
        raise UsageError("the size of the squares is not known.", fix=f"--square 20, in {setup.unit}")
    check_size(table, setup.unit)
    corner_positions(table)
    return detector


def sizes_of(setup: Setup) -> dict[str, Any]:
    """What a session says of the size of its board, by option; of a simulated one that says nothing, the example's.

    Args:
        setup: Of any session.
    """
    given = {name: getattr(setup, name) for name in SIZES}
    given = {name: value for name, value in given.items() if value is not None and value is not False}
    if given or not setup.simulated:
        return given
    scale = {"mm": 1.0, "m": 1e-3}.get(setup.unit, 1.0)
    example = EXAMPLE_BOARDS.get(setup.target, {})
    return {name: value if isinstance(value, str) else scale * value for name, value in example.items()}


def board_settings(setup: Setup) -> dict[str, Any]:
    """What a session keeps of its board: the table [target], and known poses, whatever becomes of their file.

    Args:
        setup: With a target that is a board.

    Raises:
        UsageError: The poses cannot be read.
    """
    kept: dict[str, Any] = {TARGET_KEY: board_detector(setup).describe()}
    return kept if not setup.poses else {**kept, POSES_KEY: described(poses_from(setup.poses))}


def shape_of(detector: Detector) -> BoardShape:
    """The board that a detector finds.

    Args:
        detector: Of a board.
    """
    table = detector.describe()
    flat = corner_positions(table)
    square = float(table.get("square", table.get("tag", table.get("spacing", 0.0))))
    shape = BoardShape(np.column_stack([flat, np.zeros(len(flat))]), square, table["kind"] == "board")
    if table["kind"] != "dotgrid":
        return shape
    return shape._replace(whole=True, edges=False, facing=MIN_DOTS_COSINE)  # flat ellipses are not found


def board_hardware(
    setup: Setup, cameras: list[FrameSource] | None, robot: Callable[[], Robot]
) -> tuple[list[FrameSource], Robot, Workspace | None]:
    """Cameras, who holds the board, and where positions have to be good; of a robot, where it may put corner 1.

    Args:
        setup: With a target that is a board.
        cameras: Those of the setup; None for simulated ones, and a hand, or a simulated robot, that holds the board.
        robot: Makes that of the setup, where it names one.

    Raises:
        UsageError: A pose is wrong, or it is not known where the robot may go, or how the board is turned.
    """
    detector = board_detector(setup)
    if setup.poses:
        poses_from(setup.poses)  # what is wrong with them is said before anything is begun
    carried = is_carried(setup)
    _refuse_useless(setup, carried)
    volume = workspace_from(setup.workspace, None) if setup.workspace else None
    if carried:
        volume = volume if volume is not None else _swept(setup, detector)
        turn = _rotation_of(setup)
    if cameras is None:
        rig = setup.built()
        if setup.poses:
            _refuse_unseen(rig, shape_of(detector), poses_from(setup.poses))
        found, hand = simulated_hand(rig, detector.describe(), seed=setup.seed, seconds=HAND_SECONDS)
        if carried and volume is not None:
            speed = (setup.speed or SIMULATED_SPEED) / METRES_PER_UNIT[setup.unit]
            rng = np.random.default_rng([setup.seed, 51])
            arm = SimulatedRobot(volume.centre, sd=setup.sd or 0.0, speed=speed, rng=rng)
            hand.carried = lambda: Pose(turn, arm.true_position)
            return list(found), arm, volume
        cameras = list(found)
    if carried:
        return cameras, robot(), volume
    sd = (setup.sd if setup.sd is not None else np.nan,) * 3
    return cameras, Person(lambda _: None, sd), volume


def is_carried(setup: Setup) -> bool:
    """Whether a robot moves the board.

    Args:
        setup: With a target that is a board.
    """
    return setup.robot not in ("", Person.spec)


def _refuse_useless(setup: Setup, carried: bool) -> None:
    """UsageError for options that say nothing of such a session, or are missing."""
    if setup.facing and not carried:
        raise UsageError("--facing says how a robot holds the board.", fix="give --robot, or leave it out")
    if setup.hold_out and not (carried or setup.poses):
        raise UsageError(
            "boards held by hand are held out by themselves.",
            why="the report judges by every third board, at places that nobody knows",
            fix="leave --hold-out out; it is for --poses, or a robot",
        )
    if setup.simulated and carried and setup.robot != SIMULATED:
        raise UsageError(
            f"the robot {setup.robot!r} does not move in front of simulated cameras.",
            fix=f"give cameras (--camera NAME=WHAT), or --robot {SIMULATED}",
        )
    if carried and not setup.simulated and setup.robot == SIMULATED:
        raise UsageError("a simulated robot does not move in front of real cameras.", fix="name another --robot")
    if carried and not setup.simulated and not setup.workspace:
        raise UsageError(
            "there is no workspace.",
            why="where the robot may put the board is not known",
            fix="give places of the board's corner 1 in the dataset's unit: --workspace=x0:x1,y0:y1,z0:z1",
        )
    if carried and not setup.simulated and not setup.facing:
        raise UsageError(
            "how the board is turned is not known.",
            why="the robot moves it without turning it, and tells where it is",
            fix="--facing=0,0,-1, the normal of its printed side in the robot's frame; or --facing=r:RX,RY,RZ",
        )


def _refuse_unseen(rig: Rig, shape: BoardShape, poses: Sequence[KnownPose]) -> None:
    """UsageError where no simulated camera can see the board at one of its poses: nobody could go on there."""
    needed = len(shape.corners) if shape.whole else MIN_CORNERS
    unseen, turned_away = [], False
    for one in poses:
        corners, front = one.pose.apply(shape.corners), -one.pose.rotation[:, 2]
        there = [camera for camera in rig.cameras if _can_be_found(*camera.pixel_from_world(corners), needed)]
        towards = [camera.camera_from_world.centre - one.pose.apply(shape.middle) for camera in there]
        if not any(front @ line > shape.facing * np.linalg.norm(line) for line in towards):  # of a mirror, its image
            unseen.append(one.name)
            turned_away |= bool(there)
    if not unseen:
        return
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) / 2 * rig.volume.size
    places = rig.volume.world_from_box.apply(corners)
    box = ", ".join(
        f"{axis} {low:.4g} to {high:.4g}" for axis, low, high in zip("xyz", places.min(0), places.max(0), strict=True)
    )
    normal = ", ".join(f"{value:.3g}" for value in np.round(-rig.volume.world_from_box.rotation[:, 2], 3) + 0.0)
    raise UsageError(
        f"no camera of the simulated rig {rig.name!r} sees the board at {list_some(unseen)}"
        f" ({len(unseen)} of {len(poses)} poses).",
        why=f"its cameras look at {box}, and a board that faces them there, near enough, has the normal ({normal})"
        + ("; at some of these poses they see its back, or it lies edge-on" if turned_away else ""),
        fix="give poses in there, with nx,ny,nz in the CSV file; or leave --poses out to see how it works",
    )


def _can_be_found(uv: Floats, on_image: NDArray[np.bool_], needed: int) -> bool:
    """Whether enough corners are in a picture, and as far apart as any detector needs."""
    if on_image.sum() < needed:
        return False
    nearest = cKDTree(uv[on_image]).query(uv[on_image], k=2)[0][:, 1]
    return bool(np.median(nearest) > MIN_SPACING_PX)


def _rotation_of(setup: Setup) -> Floats:
    """(3, 3) world_from_board of a board that a robot holds; a simulated one faces the cameras."""
    return turn_from(setup.facing, "--facing") if setup.facing else setup.built().volume.world_from_box.rotation


def _swept(setup: Setup, detector: Detector) -> Workspace:
    """Where a simulated robot may put corner 1 so that the board stays in the rig's volume, or at its middle."""
    shape, box = shape_of(detector), setup.built().volume
    low, high = shape.corners.min(axis=0), shape.corners.max(axis=0)
    half = np.maximum((box.size - (high - low)) / 2, 0.02 * box.size)  # of a large board: a little
    ends = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * half - (low + high) / 2
    return Workspace.hull(box.world_from_box.apply(ends))


def made_board_session(
    session: Session, setup: Setup, equipment: Equipment, volume: Workspace | None
) -> BoardController:
    """The controller of a session with a board.

    Args:
        session: New, or to go on with.
        setup: With a target that is a board.
        equipment: With its detector.
        volume: Where positions have to be good, in the frame of the first camera; None for where it is seen well.

    Raises:
        UsageError: The method takes no boards.
    """
    kept = session.settings.get(POSES_KEY)
    hand = getattr(equipment.cameras[0], "hand", None)  # only simulated cameras know who holds the board
    carried = is_carried(setup)
    if kept or carried:
        poses, free = poses_of(kept or []), not kept
        if free:
            assert volume is not None
            poses = carried_poses(volume.candidates(ROBOT_PLACES, setup.seed), _rotation_of(setup))
        known = KnownPosesLoop(
            calibrator_from_name(setup.method), shape_of(equipment.detector), session.cameras,
            None if carried else volume, setup.rule, setup.seed, poses=poses, free=free,
            placed_sd=float(np.nan_to_num(np.max(equipment.robot.sd))), hold_out=setup.hold_out,
        )  # fmt: skip
        return BoardController(session, equipment, known, hand=hand, auto=not carried)
    method = BOARD_METHOD if setup.method == DEFAULT_METHOD else setup.method
    if method.partition(":")[0] != BOARD_METHOD:
        raise UsageError(f"{method} takes no boards held by hand.", fix=f"--method {BOARD_METHOD}, or leave it out")
    loop = BoardLoop(
        calibrator_from_name(method), shape_of(equipment.detector), session.cameras, volume, setup.rule, setup.seed
    )
    return BoardController(session, equipment, loop, hand=hand)
