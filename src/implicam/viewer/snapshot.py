"""What the page of a session shows, as tables without a browser: the state in words, pictures' marks, the curve."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from implicam.active import Below, Rule, Step
from implicam.active.stopping import AtLeast, parts_of
from implicam.dataset import Floats
from implicam.drawing import finite_points
from implicam.formatting import number
from implicam.session.controller import State
from implicam.session.detections import Look
from implicam.viewer import words

MAX_OUTLINE_POINTS = 48
"""Of one curve of an outline, for the page."""


def snapshot(
    state: State, cameras: Sequence[str], measured: Floats, rule: Rule, *, unit: str, moves: bool, skipped: int
) -> dict[str, Any]:
    """All that the page needs to know of a state, without pictures and places.

    Args:
        state: Of the controller.
        cameras: Their names.
        measured: (3,) where the calibration sees the ball in the live pictures; NaN for nowhere.
        rule: When to stop.
        unit: The length unit.
        moves: Whether a robot moves the ball, or a person.
        skipped: How many targets were left out.
    """
    state = words.current(state)
    head = words.headline(state, moves, unit)
    looks = {look.camera: look for look in state.looks}
    target = state.target
    circles = state.rough if len(state.rough) == len(cameras) else np.full((len(cameras), 3), np.nan)
    return {
        **said_of(state, head),
        "target": None if target is None else {"name": target.name, "xyz": target.xyz.tolist()},
        "position": finite_or_none(state.position),
        "to_go": words.to_go(state, measured, unit),
        "buttons": _buttons(state, moves, unit),
        "cameras": [_camera(state, name, looks.get(name), rough) for name, rough in zip(cameras, circles, strict=True)],
        "numbers": numbers_of(state.history, rule, unit, skipped),
    }


def said_of(state: State, head: words.Headline) -> dict[str, Any]:
    """What the page of any target says of its state: the headline, and what to do after trouble.

    Args:
        state: Of the controller.
        head: What to do now.
    """
    problem = state.problem if state.phase == "trouble" else None
    return {
        "version": state.version,
        "phase": state.phase,
        "kind": head.kind,
        "title": head.title,
        "detail": head.detail,
        "why": "" if problem is None else problem.why,
        "fix": "" if problem is None else problem.fix,
        "message": state.message,
        "auto": state.auto,
        "report": state.report is not None,
    }


def curve(history: Sequence[Step], rule: Rule) -> dict[str, Any]:
    """The uncertainty against the number of points, and where the rules would stop.

    Args:
        history: The steps so far.
        rule: When to stop.
    """
    steps = [step for step in history if np.isfinite(step.usual)]
    return {
        "points": [step.points for step in steps],
        "worst": [step.worst for step in steps],
        "usual": [step.usual for step in steps],
        "stops": [{"value": one.value, "of": one.of} for one in parts_of(rule) if isinstance(one, Below)],
        "budgets": [one.points for one in parts_of(rule) if isinstance(one, AtLeast)],
    }


def _buttons(state: State, moves: bool, unit: str) -> dict[str, dict[str, Any]]:
    may, next_one, labels = words.allowed(state, moves), words.proposed(state), words.labels(state, moves, unit)
    return {
        word: {"enabled": enabled, "next": word == next_one, "label": labels.get(word, "")}
        for word, enabled in may.items()
    }


def _camera(state: State, name: str, look: Look | None, rough: Floats) -> dict[str, Any]:
    """What one camera shows, in pixels of its picture, and what there is to say of it."""
    problem = words.trouble_of(state, name)
    if problem or look is None or look.frame is None:
        reason = problem or (look.found.reason if look is not None else "") or "waiting for its first picture"
        says = "camera trouble" if problem else "no picture"
        return {"name": name, "shown": False, "says": says, "kind": "bad" if problem else "idle", "reason": reason}
    height, width = look.frame.picture.shape
    says, kind = words.verdict(state, look, rough)
    aims = state.phase in ("aim", "moving", "shown")
    planned = np.isfinite(look.expected).all() and aims
    return {
        "name": name,
        "shown": True,
        "width": width,
        "height": height,
        "says": says,
        "kind": kind,
        "reason": look.found.reason if state.phase == "shown" else "",
        "ball": finite_or_none(look.uv),
        "outlines": [_outline(line) for line in look.found.outlines] if len(look.found) else [],
        "target": look.expected.tolist() if planned else None,
        "rough": finite_or_none(rough) if aims and not planned else None,
    }


def _outline(line: Floats) -> list[list[float]]:
    kept = finite_points(line)
    step = max(1, len(kept) // MAX_OUTLINE_POINTS)
    return np.round(kept[::step], 2).tolist()  # type: ignore[no-any-return]


def numbers_of(history: Sequence[Step], rule: Rule, unit: str, skipped: int) -> dict[str, Any]:
    """Points, the 95 % uncertainty, and how far each rule is from stopping.

    Args:
        history: The steps so far.
        rule: When to stop.
        unit: The length unit.
        skipped: How many targets were left out.
    """
    step = history[-1] if history else Step(0)
    known = bool(np.isfinite(step.usual))
    return {
        "points": step.points,
        "skipped": skipped,
        "usual": f"{number(step.usual, 2)} {unit}" if known else "",
        "worst": f"{number(step.worst, 2)} {unit}" if known else "",
        "progress": [one.progress(history, unit) for one in parts_of(rule)],
    }


def finite_or_none(values: Floats) -> list[float] | None:
    """A place for JSON; None where it is not known."""
    return values.tolist() if np.isfinite(values).all() else None
