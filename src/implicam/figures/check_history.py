"""The history of checks of a calibration, for print: does it hold, and how far each camera is from where it stood."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from implicam.errors import import_extra
from implicam.figures.printed import PURPOSE, new_figure, place_legend, plain_log, style_axes
from implicam.figures.style import BLUE, GREEN, GREY, ORANGE, VERMILLION

_GROUPS = (
    ("turn", ("tilt", "pan", "roll"), "deg"),
    ("shift", ("right", "down", "forward"), None),  # in the length unit
    ("zoom", ("zoom",), "%"),
)
_LABELS = ("tilt, right, zoom", "pan, down", "roll, forward")
_COLOURS, _MARKS = (BLUE, GREEN, ORANGE), ("o", "s", "^")
LEAST_P_VALUE = 1e-6
"""Smaller ones are drawn there."""
ROW_INCHES, MOST_CAMERAS = 1.35, 12


def check_history_figure(rows: Sequence[Mapping[str, str]]) -> Any:
    """How a calibration held over time.

    At the top the p-value of each check, alarms marked with what they say; below, for each camera, its turn, shift and
    zoom as they are if it alone moved, with standard uncertainties.

    Args:
        rows: Of a history as `append_to_log` writes it, one for each check and camera.

    Returns:
        A matplotlib Figure; save it with `figure.savefig(path)`, .png, .pdf or .svg.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    dates = import_extra("matplotlib.dates", "report", PURPOSE)
    every = list(dict.fromkeys(row["camera"] for row in rows))
    worst = {name: max(_sds(row) for row in rows if row["camera"] == name) for name in every}
    shown = [name for name in every if name in sorted(every, key=lambda one: -worst[one])[:MOST_CAMERAS]]
    names = sorted(shown)
    figure = new_figure(11.0, 2.0 + ROW_INCHES * len(names))
    grid = figure.add_gridspec(len(names) + 1, 3, height_ratios=[1.5, *[1.0] * len(names)])
    top = figure.add_subplot(grid[0, :])
    alarms = _draw_p_values(top, rows)
    unit = rows[0]["length_unit"]
    for i, name in enumerate(names):
        mine = [row for row in rows if row["camera"] == name]
        times = [datetime.fromisoformat(row["time"]) for row in mine]
        for k, (what, numbers, in_unit) in enumerate(_GROUPS):
            axes = figure.add_subplot(grid[i + 1, k], sharex=top)
            for j, number in enumerate(numbers):
                values, sds = ([float(row[key]) for row in mine] for key in (number, f"sd_{number}"))
                axes.errorbar(
                    times, values, yerr=sds, color=_COLOURS[j], marker=_MARKS[j], label=_LABELS[j],
                    ms=4, lw=0.8, capsize=2, elinewidth=0.8,
                )  # fmt: skip
            for time in alarms:
                axes.axvline(time, color=VERMILLION, lw=0.8, alpha=0.6)
            axes.axhline(0, color=GREY, lw=0.6)
            style_axes(axes)
            axes.tick_params(labelbottom=i == len(names) - 1, labelsize=8)
            if i == 0:
                axes.set_title(f"{what}, {in_unit or unit}", fontsize=9)
            if k == 0:
                axes.set_ylabel(name, fontsize=9)
    place_legend(figure, [figure.axes[1]], "")
    locator = dates.AutoDateLocator(maxticks=8)
    top.xaxis.set_major_locator(locator)
    top.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))
    left = f"; the {len(names)} of {len(every)} cameras that moved most" if len(names) < len(every) else ""
    figure.suptitle(
        f"Checks of the calibration: each camera as if it alone moved, ± standard uncertainty{left}", fontsize=10
    )
    return figure


def _sds(row: Mapping[str, str]) -> float:
    """The largest of a camera's seven numbers, in its sds."""
    numbers = [number for _, group, _ in _GROUPS for number in group]
    sizes = [abs(float(row[number])) / max(float(row[f"sd_{number}"]), 1e-300) for number in numbers]
    return float(np.max(np.nan_to_num(sizes)))


def _draw_p_values(axes: Any, rows: Sequence[Mapping[str, str]]) -> list[datetime]:
    """The p-value of each check; returns the times of alarms."""
    checks = {row["time"]: row for row in reversed(rows)}  # the first row of a check has its likeliest camera
    rows = [checks[time] for time in sorted(checks)]
    times = [datetime.fromisoformat(row["time"]) for row in rows]
    p = np.maximum([float(row["p_value"]) for row in rows], LEAST_P_VALUE)
    held = np.array([row["verdict"] == "stands" for row in rows])
    axes.plot(times, p, color=GREY, lw=0.8, zorder=1)
    for good, colour, label in ((held, BLUE, "stands"), (~held, VERMILLION, "alarm")):
        some = [time for time, one in zip(times, good, strict=True) if one]
        axes.scatter(some, p[good], color=colour, s=22, label=label, zorder=2)
    before, above = "", False
    for time, value, row, good in zip(times, p, rows, held, strict=True):
        said = f"{row['camera']} moved" if row["verdict"] == "moved" else row["verdict"]
        new, before = not good and said != before, said
        if new:
            above = not above
            axes.annotate(
                said, (time, value), (4, 6 if above else -14), textcoords="offset points", fontsize=8, color=VERMILLION
            )
    plain_log(axes.yaxis, name="y")
    margin = max(0.03 * (times[-1] - times[0]), timedelta(hours=12))
    axes.set_xlim(times[0] - margin, times[-1] + margin)
    axes.set_ylim(min(0.2 * p.min(), 5e-3), 3.0)
    axes.set_ylabel("p-value", fontsize=9)
    axes.legend(fontsize=8, frameon=False, loc="upper right", ncols=2)
    axes.tick_params(labelbottom=False, labelsize=8)
    style_axes(axes)
    return [time for time, good in zip(times, held, strict=True) if not good]
