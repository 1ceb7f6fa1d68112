"""What the page says, and which buttons make sense: from a State to words and HTML, without a browser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from implicam.active import Step
from implicam.dataset import Floats
from implicam.figures.style import BLUE, GREEN, ORANGE, VERMILLION
from implicam.formatting import number
from implicam.session.controller import State

BUSY = ("starting", "moving", "fitting")
IDLE = "#5b6270"


@dataclass(frozen=True)
class Headline:
    """One line in large type, one below it, and the colour of the phase."""

    title: str
    detail: str
    colour: str


def headline(state: State, moves: bool) -> Headline:
    """What to do now. moves: whether a robot moves the ball, or a person."""
    found = f"Found in {len(state.cameras_with_ball)} of {len(state.looks)} cameras"
    point = f"Point {state.target.name.lstrip('p0') or '?'}" if state.target is not None else "No target"
    if state.phase == "aim":
        return _aim(state, point, moves)
    if state.phase == "shown" and not state.cameras_with_ball:
        return Headline("The ball was not found", "Redo it when the ball is in sight, or skip this target.", VERMILLION)
    if state.phase == "trouble":
        problem = state.problem
        return Headline("Something needs you", problem.what if problem is not None else state.message, VERMILLION)
    if state.phase == "moving":
        return Headline(f"{point}: the robot moves …" if moves else f"{point}: looking …", "", BLUE)
    return {
        "shown": Headline(f"{found}: accept?", "Accept keeps the point; redo looks again.", GREEN),
        "fitting": Headline("Calculating …", state.message, BLUE),
        "done": Headline("Done: the rig is calibrated", "", GREEN),
    }.get(state.phase, Headline("Connecting …", state.message, BLUE))


def _aim(state: State, point: str, moves: bool) -> Headline:
    if state.stop:
        return Headline(f"Good enough: {state.stop}", "Finish now, or go on for even better.", GREEN)
    if state.target is None:
        return Headline("No place is left to measure", state.message, ORANGE)
    if state.auto:
        return Headline(f"{point}: by itself", "The next target is gone to without asking.", BLUE)
    if moves:
        return Headline(f"{point}: press Go", "The robot takes the ball to the circle.", ORANGE)
    return Headline(f"{point}: put the ball here", "Into the circle in every picture; then say where it is.", ORANGE)


def way(here: Floats, there: Floats, unit: str) -> str:
    """The way that is left from here to there, both (3,): along each axis, with its sign; HTML."""
    step = there - here
    length = float(np.linalg.norm(step))
    digits = int(np.clip(1 - np.floor(np.log10(max(length, 1e-9))), 0, 4))  # two digits of the whole way
    cells = "".join(
        f"<span><i>{axis}</i> {'+' if d >= 0 else '−'}{abs(float(d)):.{digits}f} {escape(unit)}</span>"
        for axis, d in zip("xyz", step, strict=True)
    )
    return f"<div class='way'><span><b>{length:.{digits}f} {escape(unit)}</b> to go</span>{cells}</div>"


def to_go(state: State, measured: Floats, unit: str) -> str:
    """How far the ball is from its target, HTML; in pixels where the calibration cannot measure it yet."""
    if state.target is None or state.phase not in ("aim", "moving", "shown"):
        return ""
    here = state.position if state.phase == "shown" else measured
    if state.phase == "shown" and np.isfinite(here).all():
        return f"<div class='detail'>ball at {escape(place(here, unit))}</div>"
    if np.isfinite(here).all():
        return way(here, state.target.xyz, unit)
    offs = [float(np.linalg.norm(look.uv - look.expected)) for look in state.looks]
    offs = [off for off in offs if np.isfinite(off)]
    if offs:
        return f"<div class='way'><b>{np.mean(offs):.0f} px</b> to go</div>"
    return ""


def place(xyz: Floats, unit: str) -> str:
    """A position in words."""
    cells = ", ".join(f"{axis} {number(float(value), 4)}" for axis, value in zip("xyz", xyz, strict=True))
    return f"{cells} {unit}"


def banner(state: State, measured: Floats, unit: str, moves: bool) -> str:
    """The head of the pictures, HTML: what to do, in type that is read from two metres; a problem with its cure."""
    head = headline(state, moves)
    lines = [f"<div class='title'>{escape(head.title)}</div>"]
    if head.detail:
        lines.append(f"<div class='detail'>{escape(head.detail)}</div>")
    if state.phase == "trouble" and state.problem is not None:
        lines += [
            f"<div class='detail'><b>{word}</b> {escape(text)}</div>"
            for word, text in (("why:", state.problem.why), ("to do:", state.problem.fix))
            if text
        ]
        lines.append("<div class='detail'>Nothing is lost. Press Try again when it is mended.</div>")
    if state.phase == "done":
        lines.append(_results(state))
    if state.phase == "aim" and state.target is not None:
        lines.append(f"<div class='detail'>target: {escape(place(state.target.xyz, unit))}</div>")
    lines.append(to_go(state, measured, unit))
    return f"<div class='banner' style='border-color:{head.colour}'>{''.join(lines)}</div>"


def _results(state: State) -> str:
    links = "<a class='file' href='/calibration.implicam' download>Download the calibration</a>"
    if state.report is not None:
        links += "<a class='file' href='/report.html' target='_blank' rel='noopener'>Open the report</a>"
    else:
        links += "<span class='detail'>Too few points for a report.</span>"
    return f"<div class='detail'>{escape(state.message)}</div><div>{links}</div>"


def numbers(history: Sequence[Step], unit: str, skipped: int) -> str:
    """What is known so far: points, and the 95 % uncertainty; HTML."""
    step = history[-1] if history else Step(0)
    rest = f" · {skipped} skipped" if skipped else ""
    if not np.isfinite(step.usual):
        return (
            f"<div class='numbers'><div><b>{step.points}</b> points{rest}</div>"
            "<div class='small'>no calibration yet: the first points are spread evenly</div></div>"
        )
    return (
        f"<div class='numbers'><div><b>{step.points}</b> points{rest}</div>"
        f"<div><b>{number(step.usual, 2)} {escape(unit)}</b> in 95 % of the workspace</div>"
        f"<div><b>{number(step.worst, 2)} {escape(unit)}</b> everywhere</div>"
        "<div class='small'>95 % uncertainty of a measured position</div></div>"
    )


def allowed(state: State, moves: bool) -> dict[str, bool]:
    """Which buttons make sense now: go, accept, redo, skip, undo, finish, auto, stop."""
    ready = state.phase in ("aim", "shown") and not state.auto
    return {
        "go": state.phase in ("trouble", "done")
        or (state.phase == "aim" and state.target is not None and not state.auto),
        "accept": state.phase == "shown" and bool(state.cameras_with_ball) and not state.auto,
        "redo": state.phase == "shown" and not state.auto,
        "skip": ready and state.target is not None,
        "undo": ready and state.data is not None and len(state.data) > 0,
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
    return {"go": go, "finish": f"Stop now{reached}"}
