"""Methods compared, for print: how error and honesty change with the number of known points."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from implicam.dataset import Floats
from implicam.errors import import_extra
from implicam.figures.style import BLACK, BLUE, GREEN, GREY, MARKS, ORANGE, PURPLE, SKY, VERMILLION

_COLOURS = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY, BLACK)

Row = Mapping[str, Any]


def compare_figure(table: Iterable[Row], *, unit: str) -> Any:
    """A matplotlib Figure of rmse (left) and 95 % coverage (right) against the number of known points.

    table: one row per method, number of known points and seed, with the keys `method`, `known`, `rmse` (in `unit`),
    `coverage_95` (0 to 1, None or NaN where the method states none) and, optionally, `limit`, the Cramer-Rao rms. Each
    marker is the median over seeds, each bar runs from the least to the greatest. Save with `figure.savefig(path)`,
    .png or .pdf; nothing touches pyplot's global state.
    """
    figure_module = import_extra("matplotlib.figure", "report", "a figure for print")
    rows = list(table)
    figure = figure_module.Figure(figsize=(9.0, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    methods = list(dict.fromkeys(str(row["method"]) for row in rows))
    for k, method in enumerate(methods):
        mine = [row for row in rows if str(row["method"]) == method]
        # Dodged a little, so that bars of different methods stand side by side.
        shift = 1.03 ** (k - (len(methods) - 1) / 2)
        look = {"color": _COLOURS[k % len(_COLOURS)], "marker": MARKS[k % len(MARKS)], "label": method}
        _draw(left, mine, "rmse", shift, look)
        _draw(right, mine, "coverage_95", shift, look)
    _draw_limit(left, rows)
    _finish(left, right, [int(row["known"]) for row in rows], unit)
    return figure


def _draw(axes: Any, rows: Sequence[Row], key: str, shift: float, look: dict[str, Any]) -> None:
    known, low, middle, high = _over_seeds(rows, key)
    if len(known):
        axes.errorbar(
            known * shift,
            middle,
            yerr=[middle - low, high - middle],
            capsize=3,
            lw=1.4,
            ms=5.5,
            mec="white",
            mew=0.6,
            **look,
        )


def _draw_limit(axes: Any, rows: Sequence[Row]) -> None:
    known, _, limit, _ = _over_seeds(rows, "limit")
    if len(known) == 1:
        axes.axhline(limit[0], color=GREY, ls="--", lw=1.2, label="Cramér-Rao limit")
    elif len(known):
        axes.plot(known, limit, color=GREY, ls="--", lw=1.2, label="Cramér-Rao limit")


def _over_seeds(rows: Sequence[Row], key: str) -> tuple[Floats, Floats, Floats, Floats]:
    """Known points, and least, median and greatest of a column at each; values that are missing are left out."""
    groups: dict[int, list[float]] = {}
    for row in rows:
        value = row.get(key)
        if value is not None and np.isfinite(value):
            groups.setdefault(int(row["known"]), []).append(float(value))
    known = sorted(groups)
    stats = [(min(groups[k]), float(np.median(groups[k])), max(groups[k])) for k in known]
    low, middle, high = np.array(stats, dtype=np.float64).reshape(-1, 3).T
    return np.array(known, dtype=np.float64), low, middle, high


def _finish(left: Any, right: Any, known: Sequence[int], unit: str) -> None:
    ticker = import_extra("matplotlib.ticker", "report", "a figure for print")
    for axes in (left, right):
        axes.set_xscale("log")
        axes.set_xticks(sorted(set(known)), [str(k) for k in sorted(set(known))])
        axes.xaxis.set_minor_locator(ticker.NullLocator())
        axes.set_xlabel("known points")
        axes.grid(True, color="0.9", lw=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    left.set_yscale("log")
    plain = ticker.FuncFormatter(lambda value, _: f"{value:g}")
    left.yaxis.set_major_formatter(plain)
    left.yaxis.set_minor_formatter(ticker.NullFormatter())
    left.yaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    left.set_ylabel(f"rms error ({unit})")
    right.axhline(0.95, color=GREY, ls="--", lw=1.2)
    right.text(1.01, 0.95, "honest", color=GREY, ha="left", va="center", transform=right.get_yaxis_transform())
    right.set_ylim(top=1.02)
    right.set_ylabel("share inside the 95 % ellipsoid")
    if left.get_legend_handles_labels()[0]:
        left.legend(frameon=False)
