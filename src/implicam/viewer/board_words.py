"""What the page of a session with a board says and shows: from a state to words and tables, without a browser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from implicam.active import Rule, Target
from implicam.active.board_loop import BoardTarget
from implicam.dataset import Floats
from implicam.session.board_session import NOT_SEEN, BoardState
from implicam.session.detections import Look
from implicam.viewer.hand_words import camera_table, common_headline, common_snapshot, finish_label, sentence
from implicam.viewer.words import Headline

CURE = (
    "To do: hold the board still, lean it on something, or let a trigger expose all cameras at one instant; then take "
    "back the boards that were moving (under Boards), and show others."
)
"""Of cameras that contradict each other."""


def headline(state: BoardState, moves: bool = False) -> Headline:
    """What to do now.

    Args:
        state: Of the controller.
        moves: Whether a robot moves the board, or a person.
    """
    done = None
    if state.contradictions:
        detail = " ".join(filter(None, (state.verdict[0], _contradiction(state))))
        done = Headline("Done, but the cameras contradict each other", detail, "bad")
    aim = _aim(state, moves)
    if state.stopped:
        aim = replace(aim, detail=f"Stopped by hand: nothing moves until Go. {aim.detail}".strip())
    return common_headline(state, aim, done, "No boards were held out to check it.")


def _contradiction(state: BoardState) -> str:
    """The first pair of cameras, how many more there are, and the cure."""
    more = len(state.contradictions) - 1
    others = f"So do {more} more pair{'s' * (more != 1)} of cameras." if more else ""
    return " ".join(filter(None, (state.contradictions[0], others, CURE)))


def _aim(state: BoardState, moves: bool) -> Headline:
    head = _guidance(state, moves)
    if state.contradictions:
        following = f"{head.title}." if not state.stop else f"{sentence(state.stop)}."
        return Headline("The cameras contradict each other", f"{_contradiction(state)} Now: {following}", "bad")
    if state.unfitted and not state.stop:
        return replace(head, detail=" ".join(filter(None, (head.detail, f"The last fit failed: {state.unfitted}"))))
    return head


def _guidance(state: BoardState, moves: bool) -> Headline:
    target, judged = state.target, state.judgement
    if state.stop:
        return Headline(f"Good enough: {state.stop}", "Finish now, or go on for even better.", "good")
    why = f"{target.why}." if isinstance(target, BoardTarget) and target.why else ""  # it may begin with a camera
    if target is None:
        return Headline("No pose is left", state.message, "ask")
    if moves:
        return _of_robot(state, target, why)
    if judged.reason == NOT_SEEN:  # nowhere: then why is more use than where it is to be
        why = next((f"{look.camera}: {look.found.reason}" for look in state.looks if look.found.reason), why)
    board = f"Board {len(state.history) + 1}: hold it into the outline"
    if isinstance(target, BoardTarget) and target.known:
        board = f"Put it at {target.words.partition(',')[0]}"
    if judged.ready:
        return Headline("Hold it there …" if state.auto else "Take it now", why, "good")
    return Headline(f"{board}" if not judged.reason else sentence(judged.reason), why, "ask")


def _of_robot(state: BoardState, target: Target, why: str) -> Headline:
    held_out = isinstance(target, BoardTarget) and target.held_out
    board = "A held-out board" if held_out else f"Board {len(state.history) + 1}"
    if state.auto:
        return Headline(f"{board}: by itself", "The next place is gone to without asking.", "busy")
    said = state.judgement.reason  # why the last picture was not kept
    return Headline(f"{board}: press Go", f"{sentence(said)}. {why}" if said else sentence(why), "ask")


def _meanwhile(state: BoardState) -> str:
    if not state.busy:
        return ""
    forecast = (
        "; until then the numbers are a forecast" if state.forecast and np.isfinite(state.history[-1].worst) else ""
    )
    return f"The cameras are being fitted meanwhile{forecast}."


def board_snapshot(
    state: BoardState, cameras: Sequence[str], rule: Rule, *, unit: str, skipped: int, moves: bool = False
) -> dict[str, Any]:
    """All that the page needs to know of a state, without pictures and places.

    Args:
        state: Of the controller.
        cameras: Their names.
        rule: When to stop.
        unit: The length unit.
        skipped: How many poses were left out.
        moves: Whether a robot moves the board, or a person.
    """
    head = headline(state, moves)
    looks = {look.camera: look for look in state.looks}
    target = state.target if isinstance(state.target, BoardTarget) else None
    near = np.isfinite(state.off) and state.phase == "aim" and not moves
    go, skip = ("Go", "Another place") if moves else ("Take it now", "Another pose")
    labels = {"go": go, "finish": finish_label(state, "worst", unit), "skip": skip}
    rows = [_camera(state, c, name, looks.get(name), target) for c, name in enumerate(cameras)]
    head = replace(head, detail=" ".join(filter(None, (head.detail, _meanwhile(state)))))
    return {
        **common_snapshot(
            state, head, rows, rule, unit=unit, skipped=skipped, word="board", labels=labels, moves=moves
        ),
        "target": None if target is None else {"name": target.name, "words": target.words},
        "to_go": {"total": f"{state.off:.0f} px", "axes": {}} if near else None,
    }


def _camera(state: BoardState, c: int, name: str, look: Look | None, target: BoardTarget | None) -> dict[str, Any]:
    table = camera_table(state, c, name, look)
    if not table["shown"] or look is None:
        return table
    outline = target.outlines[c] if target is not None and c < len(target.outlines) and state.phase == "aim" else None
    count = len(look.found)
    says, kind = (f"{count} corners", "good") if count else ("no board seen", "idle")
    return {
        **table,
        "says": f"{says} · {table['told']}" if "told" in table else says,
        "kind": kind,
        "corners": np.round(look.found.uv, 1).tolist() if count else [],
        "hold": None if outline is None else _finite(outline),
    }


def _finite(outline: Floats) -> list[list[float]]:
    return np.round(outline[np.isfinite(outline).all(axis=1)], 1).tolist()  # type: ignore[no-any-return]
