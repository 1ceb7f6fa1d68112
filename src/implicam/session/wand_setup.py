"""From the words of a command line to a session with a wand: which one, who waves it, and the loop."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from implicam.active import Workspace, workspace_from
from implicam.active.wand_loop import WandLoop
from implicam.calibrators import DEFAULT_METHOD, calibrator_from_name
from implicam.dataset.wand import WAND, wand_of
from implicam.detect import TARGETS, Detector, options_of
from implicam.errors import UsageError
from implicam.hardware import FrameSource, Person
from implicam.hardware.simulated_wave import simulated_wave
from implicam.session.controller import Equipment
from implicam.session.journal import TARGET_KEY, Session
from implicam.session.wand_session import WandController
from implicam.simulate import Optics
from implicam.simulate.targets import WAND_SHARE

if TYPE_CHECKING:
    from implicam.session.setup import Setup

WAND_METHOD = DEFAULT_METHOD
"""The one method that takes a wand."""

WAVING_SECONDS = 1.5
"""That a simulated hand takes from one place to the next, to be watched."""

DARK_ROOM = Optics(clutter=False)
"""Of simulated cameras: as people choose it for a wand with bright balls."""

WAND_OPTIONS = ("wand", "wand_sd", "markers", "told_by")
"""The options of a session that say what the wand is."""


def wand_length(setup: Setup) -> float:
    """Between the ends of the wand of a session; of a simulated one that says nothing, 0.6 of the volume's shortest
    edge.

    Args:
        setup: With a wand.

    Raises:
        UsageError: It is not stated.
    """
    if setup.wand is not None:
        return setup.wand
    if setup.simulated:
        return WAND_SHARE * float(setup.built().volume.size.min())
    raise UsageError(
        "the length of the wand is not known.",
        why="without it the rig has no size",
        fix=f"state the distance between its two ends, in {setup.unit}: --wand 500",
    )


def wand_detector(setup: Setup) -> Detector:
    """The detector of the wand that a session shows.

    Args:
        setup: With a wand.

    Raises:
        UsageError: An option is not possible, or the method takes no wand.
    """
    if setup.method.partition(":")[0] != WAND_METHOD:
        raise UsageError(f"{setup.method} takes no wand.", fix=f"--method {WAND_METHOD}, or leave it out")
    if setup.robot not in ("", Person.spec):
        raise UsageError(
            f"the robot {setup.robot!r} waves no wand.",
            why="a wand is waved by hand, at places that nobody knows",
            fix="leave --robot out",
        )
    given = {"markers": setup.markers, "told_by": setup.told_by, "length": wand_length(setup)}
    known = options_of(WAND)
    found: Detector = TARGETS[WAND].from_options(
        Path(), {}, **{name: value for name, value in given.items() if value is not None and name in known}
    )
    return found


def wand_settings(setup: Setup) -> dict[str, Any]:
    """What a session keeps of its wand: the table [target].

    Args:
        setup: With a wand.
    """
    stated = {} if setup.wand_sd is None else {"length_sd": float(setup.wand_sd)}
    return {TARGET_KEY: {**wand_detector(setup).describe(), **stated}}


def wand_hardware(
    setup: Setup, cameras: list[FrameSource] | None
) -> tuple[list[FrameSource], Person, Workspace | None]:
    """Cameras, who waves the wand, and where positions have to be good.

    Args:
        setup: With a wand.
        cameras: Those of the setup; None for simulated ones, and a hand that waves.

    Raises:
        UsageError: The wand does not fit into the simulated rig.
    """
    volume = workspace_from(setup.workspace, None) if setup.workspace else None
    if cameras is None:
        found, _ = simulated_wave(
            setup.built(), wand_length(setup), seed=setup.seed, seconds=WAVING_SECONDS, optics=DARK_ROOM
        )
        cameras = list(found)
    return cameras, Person(lambda _: None, (np.nan,) * 3), volume


def made_wand_session(session: Session, setup: Setup, equipment: Equipment, volume: Workspace | None) -> WandController:
    """The controller of a session with a wand.

    Args:
        session: New, or to go on with.
        setup: With a wand.
        equipment: With its detector.
        volume: Where positions have to be good, in the frame of the first camera; None for where the wand was.
    """
    wand = wand_of(session.empty)
    assert wand is not None  # as `wand_settings` has kept it
    loop = WandLoop(calibrator_from_name(setup.method), wand, session.cameras, volume, setup.rule, setup.seed)
    return WandController(session, equipment, loop, hand=getattr(equipment.cameras[0], "hand", None))
