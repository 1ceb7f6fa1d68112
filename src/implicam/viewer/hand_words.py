"""What the pages of sessions by hand, with a board and with a wand, say and show alike; without a browser."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from implicam.active import Rule
from implicam.formatting import number
from implicam.session.by_hand import ByHandState
from implicam.session.detections import Look
from implicam.viewer.snapshot import numbers_of, said_of
from implicam.viewer.words import Headline, trouble_of


def sentence(text: str) -> str:
    """With a capital letter.

    Args:
        text: Any.
    """
    return f"{text[:1].upper()}{text[1:]}"


def common_headline(state: ByHandState, aim: Headline, done: Headline | None, unchecked: str) -> Headline:
    """What to do now.

    Args:
        state: Of the controller.
        aim: What it is while somebody holds the target.
        done: What it is at the end where something speaks against the calibration; None where nothing does.
        unchecked: Why a calibration was not checked.
    """
    if state.phase == "aim":
        return aim
    if state.phase == "trouble":
        problem = state.problem
        return Headline("Something needs you", problem.what if problem is not None else state.message, "bad")
    if state.phase == "moving" and state.stopped:
        return Headline("Stopped", "The robot was stopped by hand; what was begun comes to its end.", "bad")
    if state.phase == "moving":
        return Headline("The robot moves …", "", "busy")
    if state.phase == "fitting":
        return Headline("Calculating …", f"{sentence(state.message)}.", "busy")
    if state.phase != "done":
        return Headline("Connecting …", state.message, "busy")
    told, tone = state.verdict
    if done is not None:
        return done
    if tone == "bad":
        return Headline("Calibrated, but do not rely on it yet", told, "bad")
    if told:
        return Headline("Done: the rig is calibrated", told, "good" if tone == "good" else "ask")
    return Headline("Calibrated, and not checked", unchecked, "ask")


def allowed(state: ByHandState, moves: bool = False) -> dict[str, bool]:
    """Which buttons make sense now.

    Args:
        state: Of the controller.
        moves: Whether a robot moves the target, or a person.
    """
    aim = state.phase == "aim"
    return {
        "go": state.phase in ("trouble", "done") or (aim and state.target is not None),
        "accept": False,
        "redo": False,
        "skip": aim and state.target is not None,
        **dict.fromkeys(("undo", "delete"), aim and state.data is not None and len(state.data) > 0),
        "again": False,
        "finish": state.phase == "done" or (aim and state.calibration is not None),
        "auto": state.phase not in ("trouble", "done"),
        "stop": moves,
    }


def common_snapshot(
    state: ByHandState,
    head: Headline,
    cameras: Sequence[Mapping[str, Any]],
    rule: Rule,
    *,
    unit: str,
    skipped: int,
    word: str,
    labels: Mapping[str, str],
    moves: bool = False,
) -> dict[str, Any]:
    """All that the page needs to know of a state, without pictures and places.

    Args:
        state: Of the controller.
        head: What to do now.
        cameras: A table of each.
        rule: When to stop.
        unit: The length unit.
        skipped: How many places were left out.
        word: What is counted: board, frame.
        labels: Of the buttons go and skip; finish with what it reaches.
        moves: Whether a robot moves the target, or a person.
    """
    following = "finish" if state.stop or state.phase == "done" else "go" if state.phase != "fitting" else ""
    go = {"trouble": "Try again", "done": "Take more"}.get(state.phase, "")
    finish = "Close the session" if state.phase == "done" else labels["finish"]
    named = {**labels, "finish": finish, **({"go": go} if go else {})}
    return {
        **said_of(state, head),
        "target": None,
        "position": None,
        "to_go": None,
        "buttons": {
            button: {"enabled": enabled, "next": button == following, "label": named.get(button, "")}
            for button, enabled in allowed(state, moves).items()
        },
        "cameras": list(cameras),
        "numbers": {**numbers_of(state.history, rule, unit, skipped), "word": word},
    }


def finish_label(state: ByHandState, what: str, unit: str) -> str:
    """Of the button, with what is reached.

    Args:
        state: Of the controller.
        what: "worst", everywhere; "usual", in 95 % of the volume.
        unit: The length unit.
    """
    reached = getattr(state.history[-1], what) if state.history else np.nan
    if not np.isfinite(reached):
        return "Finish"
    return f"Finish: {number(reached, 2)} {unit} {'everywhere' if what == 'worst' else 'in 95 %'}"


def camera_table(state: ByHandState, c: int, name: str, look: Look | None) -> dict[str, Any]:
    """What every page says of a camera: whether it is shown, its picture's size, how far it is.

    Args:
        state: Of the controller.
        c: Its number.
        name: Its name.
        look: What it shows.
    """
    problem = trouble_of(state, name)
    progress = state.cameras[c] if c < len(state.cameras) else None
    far = {} if progress is None else {"part": round(progress.part, 3), "told": progress.words}
    if problem or look is None or look.frame is None:
        reason = problem or "waiting for its first picture"
        says, kind = ("camera trouble", "bad") if problem else ("no picture", "idle")
        return {"name": name, "shown": False, "says": says, "kind": kind, "reason": reason, **far}
    height, width = look.frame.picture.shape
    nothing: dict[str, Any] = {"reason": "", "ball": None, "outlines": [], "target": None, "corners": [], "hold": None}
    return {"name": name, "shown": True, "width": width, "height": height, "kind": "idle", **nothing, **far}
