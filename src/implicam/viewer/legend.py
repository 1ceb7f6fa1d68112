"""What the colours of the workspace mean, and the curve of uncertainty against points."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from implicam.active import Below, Rule, Step
from implicam.active.stopping import Both, Either
from implicam.dataset import Floats
from implicam.figures.style import ORANGE, SKY, VERMILLION
from implicam.viewer.space import Scale

U95, EXCESS = "95 % uncertainty", "excess over the limit"
EXCESS_SCALE = Scale(1.0, 5.0)
"""Times what pixel noise alone would leave: 1 is the limit."""


def legend(scale: Scale, what: str, unit: str) -> str:
    """The colour bar with its numbers; HTML."""
    stops = np.exp(np.linspace(np.log(scale.low), np.log(scale.high), 12))
    colours = ", ".join(f"rgb({r},{g},{b})" for r, g, b in scale.colours(stops))
    width = np.log(scale.high / scale.low)
    marks = "".join(
        f"<span style='left:{100 * np.log(tick / scale.low) / width:.1f}%'>{tick:g}</span>" for tick in scale.ticks()
    )
    unit = unit if what == U95 else "times"
    return (
        f"<div class='legend'><div>{escape(what)}, {escape(unit)}</div>"
        f"<div class='bar' style='background:linear-gradient(to right, {colours})'></div>"
        f"<div class='marks'>{marks}</div>"
        f"<div><span style='color:white'>●</span> known points &nbsp;<span style='color:{ORANGE}'>●</span> target "
        f"&nbsp;<span style='color:{SKY}'>●</span> ball &nbsp;<span style='color:#7d818a'>◆</span> skipped</div></div>"
    )


def line(rule: Rule) -> Below | None:
    """The stopping line: the rule of an uncertainty that has to be reached; None where there is none."""
    if isinstance(rule, Below):
        return rule
    if isinstance(rule, Both | Either):
        return line(rule.first) or line(rule.second)
    return None


def curve(history: Sequence[Step], rule: Rule) -> tuple[Floats, ...]:
    """Points, worst, usual and the stopping line, (n,) each, of the steps that have an uncertainty; two empty ones
    before there is any."""
    stop = line(rule)
    steps = [step for step in history if np.isfinite(step.usual)]
    table = np.array([[s.points, s.worst, s.usual] for s in steps], dtype=np.float64).reshape(-1, 3)
    if not len(table):
        table = np.array([[0.0, np.nan, np.nan], [1.0, np.nan, np.nan]])
    return table[:, 0], table[:, 1], table[:, 2], np.full(len(table), np.nan if stop is None else stop.value)


def across(points: int) -> dict[str, Any]:
    """Of uPlot, for so many points: x from none to some more than there are, in steps, so that it rarely jumps."""
    most = next(most for most in (15 * 2**k for k in range(64)) if points < most)
    return {"x": {"time": False, "range": (0, most)}, "y": {"auto": True, "distr": 3, "log": 10}}


def chart(unit: str, rule: Rule) -> dict[str, Any]:
    """How the curve is drawn, in uPlot's words; the stopping line is the grid of an axis of its own."""
    stop = line(rule)
    grid = {"stroke": "rgba(128,128,128,0.25)", "width": 1}
    ink = {"stroke": "#aab2c0", "grid": grid, "ticks": grid, "font": "13px system-ui", "labelFont": "13px system-ui"}
    mark = {"stroke": VERMILLION, "width": 2, "dash": (8, 6)}
    right = {
        **ink, "scale": "y", "side": 1, "size": 44, "stroke": VERMILLION, "grid": mark, "ticks": {"show": False},
        "splits": [] if stop is None else [stop.value],
    }  # fmt: skip
    return {
        "series": (
            {"label": "points"},
            {"label": f"everywhere, {unit}", "stroke": ORANGE, "width": 3, "points": {"show": True, "size": 6}},
            {"label": f"in 95 %, {unit}", "stroke": SKY, "width": 3, "points": {"show": True, "size": 6}},
            {"label": "stop", "stroke": VERMILLION, "width": 0, "points": {"show": False}},
        ),
        "scales": across(0),
        "axes": (
            {**ink, "label": "known points", "labelSize": 20, "size": 30},
            {**ink, "label": f"95 % uncertainty, {unit}", "labelSize": 20, "size": 52},
            *([] if stop is None else [right]),
        ),
        "legend": {"show": True, "live": False},
    }
