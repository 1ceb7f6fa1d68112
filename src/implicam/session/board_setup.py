"""From the words of a command line to a session with a board: which one, who holds it, and the loop."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from implicam.active import Workspace, workspace_from
from implicam.active.board_design import BoardShape
from implicam.active.board_loop import BoardLoop
from implicam.active.board_poses import KnownPosesLoop, described, poses_from, poses_of
from implicam.calibrators import DEFAULT_METHOD, calibrator_from_name
from implicam.dataset.boards import BOARD_KINDS, check_size, corner_positions
from implicam.dataset.wand import WAND
from implicam.detect import ALSO_CALLED, TARGETS, Detector, options_of
from implicam.errors import UsageError, did_you_mean
from implicam.hardware import FrameSource, Person
from implicam.hardware.simulated_hand import simulated_hand
from implicam.session.board_session import BoardController
from implicam.session.controller import Equipment
from implicam.session.journal import TARGET_KEY, Session

if TYPE_CHECKING:
    from implicam.session.setup import Setup

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
    whole = table["kind"] in ("board", "dotgrid")
    return BoardShape(np.column_stack([flat, np.zeros(len(flat))]), square, whole, edges=table["kind"] != "dotgrid")


def board_hardware(
    setup: Setup, cameras: list[FrameSource] | None
) -> tuple[list[FrameSource], Person, Workspace | None]:
    """Cameras, who holds the board, and where positions have to be good.

    Args:
        setup: With a target that is a board.
        cameras: Those of the setup; None for simulated ones, and a hand that says so.

    Raises:
        UsageError: Simulated cameras cannot show such a board, or a robot is named.
    """
    detector = board_detector(setup)
    if setup.poses:
        poses_from(setup.poses)  # what is wrong with them is said before anything is begun
    if setup.robot not in ("", Person.spec):
        raise UsageError(
            f"the robot {setup.robot!r} holds no board.",
            why="a board is held by hand here, at places that nobody knows",
            fix="leave --robot out",
        )
    volume = workspace_from(setup.workspace, None) if setup.workspace else None
    if cameras is None:
        found, _ = simulated_hand(setup.built(), detector.describe(), seed=setup.seed, seconds=HAND_SECONDS)
        cameras = list(found)
    sd = (setup.sd if setup.sd is not None else np.nan,) * 3
    return cameras, Person(lambda _: None, sd), volume


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
    if kept:
        known = KnownPosesLoop(
            calibrator_from_name(setup.method), shape_of(equipment.detector), session.cameras, volume, setup.rule,
            setup.seed, poses=poses_of(kept),
        )  # fmt: skip
        return BoardController(session, equipment, known, hand=hand)
    method = BOARD_METHOD if setup.method == DEFAULT_METHOD else setup.method
    if method.partition(":")[0] != BOARD_METHOD:
        raise UsageError(f"{method} takes no boards held by hand.", fix=f"--method {BOARD_METHOD}, or leave it out")
    loop = BoardLoop(
        calibrator_from_name(method), shape_of(equipment.detector), session.cameras, volume, setup.rule, setup.seed
    )
    return BoardController(session, equipment, loop, hand=hand)
