"""What the page of a session with a wand says and shows: from a state to words and tables, without a browser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from implicam.active import AtLeast, Rule, Step
from implicam.active.stopping import parts_of
from implicam.active.wand_loop import MIN_WHOLE_FRAMES, WaveTarget
from implicam.formatting import json_safe
from implicam.session.detections import Look
from implicam.session.wand_session import CLUTTERED, FEW, TOO_FAST, UNTOLD, WandState
from implicam.viewer.hand_words import camera_table, common_headline, common_snapshot, finish_label, sentence
from implicam.viewer.words import Headline

CURES = {
    TOO_FAST: "Slower: cameras without a trigger see one place only where it hardly moves.",
    UNTOLD: "Which end is which cannot be seen: turn the wand across the line of sight.",
    CLUTTERED: "Cover what looks like a marker, or wave nearer.",
    FEW: "Two cameras must see both ends.",
}
"""Of what is left out just now."""


def headline(state: WandState) -> Headline:
    """What to do now.

    Args:
        state: Of the controller.
    """
    done = None
    if state.contradictions:
        detail = " ".join(filter(None, (state.verdict[0], state.contradictions[0])))
        done = Headline("Done, but do not rely on it yet", detail, "bad")
    return common_headline(state, _aim(state), done, "Too few frames to hold some of them out.")


def _aim(state: WandState) -> Headline:
    said = _told(state)
    if state.contradictions:
        return Headline("The lengths contradict the error bars", f"{state.contradictions[0]} {said}", "bad")
    if state.stop:
        return Headline(f"Enough: {state.stop}", f"{said} Finish now, or go on for even better.".strip(), "good")
    if not state.auto:
        return Headline("Paused: nothing is kept by itself", "Tick the box to go on, or keep single sets.", "ask")
    target = state.target
    if state.judgement.reason:
        return Headline(
            "Wave the wand", f"Not kept: {state.judgement.reason}. {CURES.get(state.judgement.reason, '')}", "ask"
        )
    words = target.words.rsplit(", ", 1)[0] if isinstance(target, WaveTarget) else ""
    why = f"{sentence(target.why)}." if isinstance(target, WaveTarget) and target.why else ""
    title = f"Wave it in the {words}" if words else "Wave the wand"
    return Headline(
        title, " ".join(filter(None, (_early(state), why, said))), "good" if state.judgement.ready else "ask"
    )


def _early(state: WandState) -> str:
    if state.calibration is not None or state.taken == 0:
        return ""
    if state.unfitted:
        return f"No calibration yet: {state.unfitted}"
    return "" if state.busy else f"The first fit comes with {MIN_WHOLE_FRAMES} frames."


def _told(state: WandState) -> str:
    lengths = f"{sentence(state.lengths)}." if state.lengths else ""
    failed = f"The last fit failed: {state.unfitted}" if state.unfitted and state.calibration is not None else ""
    return " ".join(filter(None, (lengths, state.out_of_reach, failed)))


def wand_snapshot(state: WandState, cameras: Sequence[str], rule: Rule, *, unit: str, skipped: int) -> dict[str, Any]:
    """All that the page needs to know of a state, without pictures and places.

    Args:
        state: Of the controller.
        cameras: Their names.
        rule: When to stop.
        unit: The length unit.
        skipped: How many places were left out.
    """
    head, target = headline(state), state.target if isinstance(state.target, WaveTarget) else None
    looks = {look.camera: look for look in state.looks}
    labels = {"go": "Keep this", "finish": finish_label(state, "usual", unit), "skip": "Another place"}
    rows = [_camera(state, c, name, looks.get(name)) for c, name in enumerate(cameras)]
    busy = "The cameras are being fitted meanwhile." if state.busy else ""
    head = replace(head, detail=" ".join(filter(None, (head.detail, busy))))
    found = common_snapshot(state, head, rows, rule, unit=unit, skipped=skipped, word="frame", labels=labels)
    kept = 0 if state.data is None else len(set(state.data.columns.get("frame", np.array([])).tolist()))
    left = [f"{count} left out: {why}" for why, count in state.left_out]
    rules = [  # frames are counted when they are kept, all else when they are fitted
        one.progress([Step(kept)] if isinstance(one, AtLeast) else state.history, unit) for one in parts_of(rule)
    ]
    numbers = {**found["numbers"], "points": kept, "progress": [*rules, *left]}
    shown = target is not None and state.phase == "aim"
    return {
        **found,
        "numbers": numbers,
        "target": {"name": target.name, "words": target.words, "xyz": _known(target.xyz)} if shown and target else None,
    }


def _camera(state: WandState, c: int, name: str, look: Look | None) -> dict[str, Any]:
    table = camera_table(state, c, name, look)
    cells = None
    if c < len(state.cells):
        cells = json_safe(np.round(state.cells[c].known, 2).tolist())
    if not table["shown"] or look is None:
        return {**table, "cells": cells}
    count = len(look.found)
    spots = len(look.found.notes.get("spots", ()))
    nothing = "which end is which?" if "log_ratio" in look.found.notes else "one end" if spots == 1 else "no wand"
    says, kind = ("both ends", "good") if count else (nothing, "idle")
    target = state.target
    uv = target.uv[c] if target is not None and state.phase == "aim" and c < len(target.uv) else np.full(2, np.nan)
    return {
        **table,
        "says": f"{says} · {table['told']}" if "told" in table else says,
        "kind": kind,
        "corners": np.round(look.found.uv, 1).tolist() if count else [],
        "target": _known(uv),
        "cells": cells,
    }


def _known(values: Any) -> list[float] | None:
    return values.tolist() if np.isfinite(values).all() else None
