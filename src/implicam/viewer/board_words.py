"""What the page of a session with a board says and shows: from a state to words and tables, without a browser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from implicam.active import Rule
from implicam.active.board_loop import BoardTarget
from implicam.dataset import Floats
from implicam.formatting import number
from implicam.session.board_session import BoardState
from implicam.session.detections import Look
from implicam.viewer.snapshot import numbers_of
from implicam.viewer.words import Headline, trouble_of

CURE = (
    "To do: hold the board still, lean it on something, or let a trigger expose all cameras at one instant; then take "
    "back the boards that were moving (under Boards), and show others."
)
"""Of cameras that contradict each other."""


def headline(state: BoardState) -> Headline:
    """What to do now.

    Args:
        state: Of the controller.
    """
    if state.phase == "aim":
        return _aim(state)
    if state.phase == "trouble":
        problem = state.problem
        return Headline("Something needs you", problem.what if problem is not None else state.message, "bad")
    return {
        "fitting": Headline("Calculating …", f"{_sentence(state.message)}.", "busy"),
        "done": _done(state),
    }.get(state.phase, Headline("Connecting …", state.message, "busy"))


def _contradiction(state: BoardState) -> str:
    """The first pair of cameras, how many more there are, and the cure."""
    more = len(state.contradictions) - 1
    others = f"So do {more} more pair{'s' * (more != 1)} of cameras." if more else ""
    return " ".join(filter(None, (state.contradictions[0], others, CURE)))


def _done(state: BoardState) -> Headline:
    told, tone = state.verdict
    if state.contradictions:
        detail = " ".join(filter(None, (told, _contradiction(state))))
        return Headline("Done, but the cameras contradict each other", detail, "bad")
    if tone == "bad":
        return Headline("Calibrated, but do not rely on it yet", told, "bad")
    if told:
        return Headline("Done: the rig is calibrated", told, "good" if tone == "good" else "ask")
    return Headline("Calibrated, and not checked", "No boards were held out to check it.", "ask")


def _aim(state: BoardState) -> Headline:
    head = _guidance(state)
    if state.contradictions:
        following = f"{head.title}." if not state.stop else f"{_sentence(state.stop)}."
        return Headline("The cameras contradict each other", f"{_contradiction(state)} Now: {following}", "bad")
    if state.unfitted and not state.stop:
        return replace(head, detail=" ".join(filter(None, (head.detail, f"The last fit failed: {state.unfitted}"))))
    return head


def _guidance(state: BoardState) -> Headline:
    target, judged = state.target, state.judgement
    if state.stop:
        return Headline(f"Good enough: {state.stop}", "Finish now, or go on for even better.", "good")
    why = f"{target.why}." if isinstance(target, BoardTarget) and target.why else ""  # it may begin with a camera
    if target is None:
        return Headline("No pose is left", state.message, "ask")
    board = f"Board {len(state.history) + 1}: hold it into the outline"
    if isinstance(target, BoardTarget) and target.known:
        board = f"Put it at {target.words.partition(',')[0]}"
    if judged.ready:
        return Headline("Hold it there …" if state.auto else "Take it now", why, "good")
    return Headline(f"{board}" if not judged.reason else _sentence(judged.reason), why, "ask")


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}"


def _meanwhile(state: BoardState) -> str:
    if not state.busy:
        return ""
    forecast = (
        "; until then the numbers are a forecast" if state.forecast and np.isfinite(state.history[-1].worst) else ""
    )
    return f"The cameras are being fitted meanwhile{forecast}."


def allowed(state: BoardState) -> dict[str, bool]:
    """Which buttons make sense now.

    Args:
        state: Of the controller.
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
        "stop": False,
    }


def board_snapshot(state: BoardState, cameras: Sequence[str], rule: Rule, *, unit: str, skipped: int) -> dict[str, Any]:
    """All that the page needs to know of a state, without pictures and places.

    Args:
        state: Of the controller.
        cameras: Their names.
        rule: When to stop.
        unit: The length unit.
        skipped: How many poses were left out.
    """
    head = headline(state)
    problem = state.problem if state.phase == "trouble" else None
    looks = {look.camera: look for look in state.looks}
    target = state.target if isinstance(state.target, BoardTarget) else None
    near = np.isfinite(state.off) and state.phase == "aim"
    may = allowed(state)
    following = "finish" if state.stop or state.phase == "done" else "go" if state.phase != "fitting" else ""
    go = {"trouble": "Try again", "done": "Take more"}.get(state.phase, "Take it now")
    worst = state.history[-1].worst if state.history else np.nan
    finish = "Close the session" if state.phase == "done" else "Finish"
    if np.isfinite(worst) and state.phase != "done":
        finish += f": {number(worst, 2)} {unit} everywhere"
    labels = {"go": go, "finish": finish, "skip": "Another pose"}
    numbers = numbers_of(state.history, rule, unit, skipped)
    return {
        "version": state.version,
        "phase": state.phase,
        "kind": head.kind,
        "title": head.title,
        "detail": " ".join(filter(None, (head.detail, _meanwhile(state)))),
        "why": "" if problem is None else problem.why,
        "fix": "" if problem is None else problem.fix,
        "message": state.message,
        "target": None if target is None else {"name": target.name, "words": target.words},
        "position": None,
        "to_go": {"total": f"{state.off:.0f} px", "axes": {}} if near else None,
        "auto": state.auto,
        "buttons": {
            word: {"enabled": enabled, "next": word == following, "label": labels.get(word, "")}
            for word, enabled in may.items()
        },
        "cameras": [_camera(state, c, name, looks.get(name), target) for c, name in enumerate(cameras)],
        "numbers": {**numbers, "word": "board"},
        "report": state.report is not None,
    }


def _camera(state: BoardState, c: int, name: str, look: Look | None, target: BoardTarget | None) -> dict[str, Any]:
    problem = trouble_of(state, name)
    progress = state.cameras[c] if c < len(state.cameras) else None
    far = {} if progress is None else {"part": round(progress.part, 3), "told": progress.words}
    if problem or look is None or look.frame is None:
        reason = problem or "waiting for its first picture"
        says = "camera trouble" if problem else "no picture"
        return {
            "name": name,
            "shown": False,
            "says": says,
            "kind": "bad" if problem else "idle",
            "reason": reason,
            **far,
        }
    height, width = look.frame.picture.shape
    outline = target.outlines[c] if target is not None and c < len(target.outlines) and state.phase == "aim" else None
    count = len(look.found)
    says, kind = (f"{count} corners", "good") if count else ("no board seen", "idle")
    return {
        "name": name,
        "shown": True,
        "width": width,
        "height": height,
        "says": f"{says} · {progress.words}" if progress is not None else says,
        "kind": kind,
        "reason": "",
        "ball": None,
        "outlines": [],
        "target": None,
        "corners": np.round(look.found.uv, 1).tolist() if count else [],
        "hold": None if outline is None else _finite(outline),
        **far,
    }


def _finite(outline: Floats) -> list[list[float]]:
    return np.round(outline[np.isfinite(outline).all(axis=1)], 1).tolist()  # type: ignore[no-any-return]
