"""What the page says, and which buttons make sense: from a State to words, without a browser."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from implicam.dataset import Floats
from implicam.formatting import number
from implicam.session.controller import State
from implicam.session.detections import Look

ON_TARGET_PX = 12.0
"""Pixels: a ball so near to its reticle is where it has to be."""


@dataclass(frozen=True)
class Headline:
    """One line in large type, one below it, and whether that is good, bad, busy, or asks for something."""

    title: str
    detail: str
    kind: str


MAX_SUSPECTS_NAMED = 3
"""Points that are not where they are said to be, and stand in the headline by name."""


def headline(state: State, moves: bool, unit: str = "mm") -> Headline:
    """What to do now.

    Args:
        state: Of the controller.
        moves: Whether a robot moves the ball, or a person.
        unit: Of lengths.
    """
    said = _headline(state, moves)
    doubts = _suspects(state, unit) if state.phase in ("aim", "shown", "done") else ""
    stopped = "Stopped by hand: nothing moves until Go." if state.stopped and state.phase in ("aim", "shown") else ""
    why = state.uncalibrated if state.phase in ("aim", "shown") else ""
    uncalibrated = (
        f"No calibration yet: {why} Another point may help; a wrong one is deleted in the list." if why else ""
    )
    detail = " ".join(filter(None, (stopped, said.detail, doubts, uncalibrated)))
    return replace(said, detail=detail, kind="bad" if doubts and said.kind == "good" else said.kind)


def _suspects(state: State, unit: str) -> str:
    """Points that are not where they are said to be, in a sentence."""
    named = state.suspects[:MAX_SUSPECTS_NAMED]
    if not named:
        return ""
    more = f" and {len(state.suspects) - len(named)} more" if len(state.suspects) > len(named) else ""
    points = ", ".join(f"{name} ({number(far, 2)} {unit} off)" for name, far in named)
    return f"Not where the cameras measure it: {points}{more}. Measure it again, or delete it, in the list of points."


def _done(state: State) -> Headline:
    told, tone = state.verdict
    if tone == "bad":
        return Headline("Calibrated, but do not rely on it yet", told, "bad")
    if told:
        return Headline("Done: the rig is calibrated", told, "good" if tone == "good" else "ask")
    return Headline("Calibrated, and not checked", "Too few known points to hold some of them out.", "ask")


def _headline(state: State, moves: bool) -> Headline:
    found = f"Found in {len(state.cameras_with_ball)} of {len(state.looks)} cameras"
    point = f"Point {state.target.name.lstrip('p0') or '?'}" if state.target is not None else "No target"
    if state.phase == "aim":
        return _aim(state, point, moves)
    if state.phase == "shown" and not state.cameras_with_ball:
        return Headline("The ball was not found", "Redo it when the ball is in sight, or skip this target.", "bad")
    if state.phase == "trouble":
        problem = state.problem
        return Headline("Something needs you", problem.what if problem is not None else state.message, "bad")
    if state.phase == "moving" and state.stopped:
        return Headline("Stopped", "The robot was stopped by hand; what was begun comes to its end.", "bad")
    if state.phase == "done":
        return _done(state)
    if state.phase == "moving":
        return Headline(f"{point}: the robot moves …" if moves else f"{point}: looking …", "", "busy")
    return {
        "shown": Headline(f"{found}: accept?", "Accept keeps the point; redo looks again.", "good"),
        "fitting": Headline("Calculating …", state.message, "busy"),
    }.get(state.phase, Headline("Connecting …", state.message, "busy"))


def _aim(state: State, point: str, moves: bool) -> Headline:
    if state.stop:
        return Headline(f"Good enough: {state.stop}", "Finish now, or go on for even better.", "good")
    if state.target is None:
        return Headline("No place is left to measure", state.message, "ask")
    if state.auto:
        return Headline(f"{point}: by itself", "The next target is gone to without asking.", "busy")
    if moves:
        return Headline(f"{point}: press Go", f"The robot takes the ball {_where_it_goes(state)}.", "ask")
    if not np.isfinite(state.target.uv).any() and np.isfinite(state.rough).any():
        return Headline(
            f"{point}: put the ball here",
            "Somewhere in the dashed circles, which are rough; then say where it is.",
            "ask",
        )
    if not np.isfinite(state.target.uv).any():
        return Headline(
            f"{point}: put the ball here", "Measure its way there, and say where it is. No circles yet.", "ask"
        )
    return Headline(f"{point}: put the ball here", "Into the circle in every picture; then say where it is.", "ask")


def _where_it_goes(state: State) -> str:
    """Of a robot: what there is to see of the target in the pictures."""
    if state.target is not None and np.isfinite(state.target.uv).any():
        return "to the circle"
    return "into the dashed circles" if np.isfinite(state.rough).any() else "there; no circles yet"


def way(here: Floats, there: Floats, unit: str) -> dict[str, Any]:
    """The way that is left.

    Args:
        here: (3,).
        there: (3,).
        unit: Of both.

    Returns:
        `total`, and `axes`: of x, y and z with its sign, in words.
    """
    step = there - here
    length = float(np.linalg.norm(step))
    digits = int(np.clip(1 - np.floor(np.log10(max(length, 1e-9))), 0, 4))  # two digits of the whole way
    axes = {a: f"{'+' if d >= 0 else '−'}{abs(float(d)):.{digits}f} {unit}" for a, d in zip("xyz", step, strict=True)}
    return {"total": f"{length:.{digits}f} {unit}", "axes": axes}


def to_go(state: State, measured: Floats, unit: str) -> dict[str, Any] | None:
    """How far the ball is from its target, as `way`; in pixels where the calibration cannot measure it yet.

    Args:
        state: Of the controller.
        measured: (3,) where the calibration sees the ball; NaN for nowhere.
        unit: Of lengths.
    """
    if state.target is None or state.phase not in ("aim", "moving"):
        return None
    if np.isfinite(measured).all():
        return way(measured, state.target.xyz, unit)
    offs = [float(np.linalg.norm(look.uv - look.expected)) for look in state.looks]
    offs = [off for off in offs if np.isfinite(off)]
    return {"total": f"{np.mean(offs):.0f} px", "axes": {}} if offs else None


def allowed(state: State, moves: bool) -> dict[str, bool]:
    """Which buttons make sense now: go, accept, redo, skip, undo, finish, auto, stop; delete and again, of a
    point in the list."""
    ready = state.phase in ("aim", "shown") and not state.auto
    return {
        "go": state.phase in ("trouble", "done")
        or (state.phase == "aim" and state.target is not None and not state.auto),
        "accept": state.phase == "shown" and bool(state.cameras_with_ball) and not state.auto,
        "redo": state.phase == "shown" and not state.auto,
        "skip": ready and state.target is not None,
        **dict.fromkeys(("undo", "delete", "again"), ready and state.data is not None and len(state.data) > 0),
        "finish": state.phase == "done" or (ready and state.calibration is not None),
        "auto": moves and state.phase not in ("trouble", "done"),
        "stop": moves,
    }


def proposed(state: State) -> str:
    """The one button that is the next thing to press."""
    if state.phase == "aim":
        return "finish" if state.stop and state.calibration is not None else "go"
    if state.phase == "shown":
        return "accept" if state.cameras_with_ball else "redo"
    return {"trouble": "go", "done": "finish"}.get(state.phase, "")


def labels(state: State, moves: bool, unit: str) -> dict[str, str]:
    """What the two buttons that change are called now: go, finish."""
    go = {"trouble": "Try again", "done": "Measure more"}.get(state.phase, "Go" if moves else "The ball is here")
    if state.phase == "done":
        return {"go": go, "finish": "Close the session"}
    worst = state.history[-1].worst if state.history else np.nan
    reached = f": {number(worst, 2)} {unit} everywhere" if np.isfinite(worst) else ""
    return {"go": go, "finish": f"Finish{reached}"}


def trouble_of(state: State, camera: str) -> str:
    """What is wrong with this camera, in words; empty where nothing is known to be."""
    problem = state.problem
    if state.phase != "trouble" or problem is None or not re.search(rf"\b{re.escape(camera)}\b", problem.what):
        return ""
    return problem.what


def current(state: State) -> State:
    """The state with the reticles of its target: pictures of the point before show where that one was."""
    target = state.target
    if state.phase != "aim" or target is None or len(target.uv) != len(state.looks):
        return state
    return replace(state, looks=tuple(replace(a, expected=uv) for a, uv in zip(state.looks, target.uv, strict=True)))


def away(look: Look) -> float:
    """Pixels from the ball to where the target is expected; NaN where either is not known."""
    return float(np.linalg.norm(look.uv - look.expected))


def verdict(state: State, look: Look, rough: Floats | None = None) -> tuple[str, str]:
    """What there is to say of one camera, in a few words, and whether it is good, bad, idle, or asks for something.

    Args:
        state: Of the controller.
        look: What the camera shows.
        rough: (3,) u, v and radius of the circle for the target, of a camera that is not calibrated; NaN for none.
    """
    found, planned = len(look.found) > 0, state.target is not None and bool(np.isfinite(look.expected).all())
    if found and planned:
        distance = away(look)
        if state.phase == "shown":
            return f"found, {distance:.0f} px from the circle", "good"
        return ("on target", "good") if distance <= ON_TARGET_PX else (f"{distance:.0f} px to go", "ask")
    roughly = rough is not None and bool(np.isfinite(rough).all())
    if found and rough is not None and roughly:
        inside = np.linalg.norm(look.uv - rough[:2]) <= rough[2]
        return ("in the rough circle", "good") if inside else ("not in the rough circle", "ask")
    if state.calibration is not None and not planned and state.target is not None and not roughly:
        return "target not in view", "idle"
    if found:
        return "ball found", "good"
    return ("ball not found", "bad") if state.phase == "shown" else ("no ball seen", "idle")
