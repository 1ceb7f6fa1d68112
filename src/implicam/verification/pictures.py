"""The pictures of a protocol, in units of their own: errors over lengths, and the volume from four sides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from implicam.dataset import Floats
from implicam.formatting import number
from implicam.verification.result import (
    CONFORMS,
    NO_LIMIT,
    NOT_CONFORMS,
    UNDECIDED,
    LengthResult,
    Verification,
)
from implicam.verification.volume import VolumeCoverage

TONES = {CONFORMS: "good", NOT_CONFORMS: "bad", UNDECIDED: "careful", NO_LIMIT: "unknown"}
CHART = (480.0, 290.0)
CHART_LEFT, CHART_BOTTOM, CHART_TOP, CHART_RIGHT = 62.0, 42.0, 14.0, 12.0
PANEL, PANEL_MARGIN = (260.0, 200.0), 40.0
OBLIQUE = np.array([[0.87, -0.49, 0.0], [0.25, 0.44, 0.86]])
"""The fourth view: right and up of the picture in the world."""


class Mark(NamedTuple):
    """An error in a chart: its place, the ends of the test's uncertainty and of the predicted one, and its tone."""

    x: float
    y: float
    low: float
    high: float
    predicted_low: float
    predicted_high: float
    tone: str
    title: str


class Chart(NamedTuple):
    """Errors over lengths, in units of the picture.

    left, right, top, bottom: of the axes. zero: y of no error. limits: corners of the upper and lower limit.
    x_ticks, y_ticks: place and text.
    """

    size: tuple[float, float]
    left: float
    right: float
    top: float
    bottom: float
    zero: float
    limits: tuple[str, ...]
    marks: list[Mark]
    x_ticks: list[tuple[float, str]]
    y_ticks: list[tuple[float, str]]

    @classmethod
    def of(cls, found: Verification) -> Chart:
        """The chart of a result.

        Args:
            found: The result, with one measured length or more.
        """
        left, right, top, bottom = CHART_LEFT, CHART[0] - CHART_RIGHT, CHART_TOP, CHART[1] - CHART_BOTTOM
        longest = 1.05 * max(one.length.length for one in found.lengths)
        wide = [float(np.nan_to_num(found.k * one.sd_predicted)) for one in found.measured]
        reach = 1.05 * max(
            abs(one.error) + max(one.expanded_test, half) for one, half in zip(found.measured, wide, strict=True)
        )
        if found.mpe is not None:
            reach = max(reach, 1.15 * found.mpe.at(longest))

        def x(length: float) -> float:
            return round(left + (right - left) * length / longest, 2)

        def y(error: float) -> float:
            return round((top + bottom) / 2 - (bottom - top) / 2 * error / reach, 2)

        def mark(one: LengthResult, half: float) -> Mark:
            title = f"{one.length.title}: {signed_number(one.error, 3)} {found.length_unit}"
            low, high = y(one.error - one.expanded_test), y(one.error + one.expanded_test)
            predicted = y(one.error - half), y(one.error + half)
            return Mark(x(one.length.length), y(one.error), low, high, *predicted, TONES[one.decision], title)

        limits: tuple[str, ...] = ()
        if found.mpe is not None:
            ends = [(at, found.mpe.at(at)) for at in (0.0, longest)]
            limits = tuple(" ".join(f"{x(at)},{y(sign * limit)}" for at, limit in ends) for sign in (1, -1))
        marks = [mark(one, half) for one, half in zip(found.measured, wide, strict=True)]
        x_ticks = [(x(value), f"{value:g}") for value in _ticks(0, longest)]
        y_ticks = [(y(value), f"{value:g}".replace("-", "−")) for value in _ticks(-reach, reach)]
        return cls(CHART, left, right, top, bottom, y(0.0), limits, marks, x_ticks, y_ticks)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers, about five."""
    rough = (high - low) / 5
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * f for f in (1, 2, 5, 10) if power * f >= rough * 0.999)
    return [round(i * step, 12) + 0.0 for i in range(math.ceil(low / step), math.floor(high / step) + 1)]


class Segment(NamedTuple):
    """A line of a panel, its class, and the text at its middle."""

    x1: float
    y1: float
    x2: float
    y2: float
    kind: str
    text: str = ""


class Panel(NamedTuple):
    """A view of the volume: lines, and the texts along its axes."""

    size: tuple[float, float]
    title: str
    segments: list[Segment]
    texts: list[tuple[float, float, str, str]]


def panels(volume: VolumeCoverage, measured: Sequence[LengthResult]) -> list[Panel]:
    """The volume from four sides: along the axes of the world, and from an oblique one.

    Args:
        volume: Where the lengths are.
        measured: Those of `volume`, with their decisions.
    """
    views = [("x", "y"), ("x", "z"), ("y", "z")]
    found = []
    for across, up in views:
        matrix = np.zeros((2, 3))
        matrix[0, "xyz".index(across)] = matrix[1, "xyz".index(up)] = 1.0
        found.append(_panel(volume, measured, matrix, (across, up)))
    return [*found, _panel(volume, measured, OBLIQUE, None)]


def _panel(
    volume: VolumeCoverage, measured: Sequence[LengthResult], matrix: Floats, axes: tuple[str, str] | None
) -> Panel:
    width, height = PANEL
    placed = [one.ends for one in volume.next]
    everything = np.concatenate([volume.corners, volume.ends.reshape(-1, 3), *placed]) @ matrix.T
    low, high = everything.min(axis=0), everything.max(axis=0)
    room = np.array([width, height]) - 2 * PANEL_MARGIN
    scale = float((room / np.maximum(high - low, 1e-300)).min())
    shift = np.array([width, height]) / 2 - scale * np.array([1, -1]) * (low + high) / 2

    def line(ends: Floats, kind: str, text: str = "") -> Segment:
        (x1, y1), (x2, y2) = (scale * np.array([1, -1]) * (ends @ matrix.T) + shift).round(1).tolist()
        return Segment(x1, y1, x2, y2, kind, text)

    edges = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]
    segments = [line(volume.corners[list(edge)], "edge") for edge in edges]
    segments += [line(ends, f"length {TONES[one.decision]}") for ends, one in zip(volume.ends, measured, strict=True)]
    segments += [line(ends, "next", str(i + 1)) for i, ends in enumerate(placed)]
    if axes is None:
        return Panel(PANEL, "from the side", segments, [])
    x0, x1 = (scale * np.array([low[0], high[0]]) + shift[0]).tolist()
    y0, y1 = (-scale * np.array([low[1], high[1]]) + shift[1]).tolist()
    below, beside = y0 + 15, x0 - 5
    numbers = [f"{value:.4g}".replace("-", "−") for value in (low[0], high[0], low[1], high[1])]
    texts = [
        (x0, below, "start", numbers[0]), (x1, below, "end", numbers[1]), ((x0 + x1) / 2, below, "middle", axes[0]),
        (beside, y0, "end", numbers[2]), (beside, y1 + 9, "end", numbers[3]), (beside, (y0 + y1) / 2, "end", axes[1]),
    ]  # fmt: skip
    return Panel(PANEL, f"{axes[0]} and {axes[1]}", segments, texts)


def signed_number(value: float, digits: int) -> str:
    """A number with its sign, for a page.

    Args:
        value: The number.
        digits: Significant digits.
    """
    return number(value, digits, sign=True, minus="−")
