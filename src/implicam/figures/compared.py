"""Methods compared, for print: error, coverage and time against the number of known points, or what was left out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from implicam.compare import RANDOM, mean_and_error, plane_axis
from implicam.dataset import Floats
from implicam.errors import import_extra
from implicam.figures.printed import PURPOSE, new_figure, place_legend, plain_log, style_axes, values
from implicam.figures.style import BLACK, BLUE, GREEN, GREY, MARKS, ORANGE, PURPLE, SKY, VERMILLION

_COLOURS = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY, BLACK)
_LIMIT = "Cramér-Rao limit"

Row = Mapping[str, Any]


def compare_figure(table: Iterable[Row], *, unit: str) -> Any:
    """Methods side by side.

    Random splits are drawn against the number of points. Where shots or planes were left out there is a line per method
    (and kind of plane), each left-out shot a faint dot. Markers are means, bars one standard error of the mean over
    seeds, shots or planes: the numbers of the table. Nothing touches pyplot's global state.

    Args:
        table: One row per trial, with the keys `method`, `known` (points trained on), `rmse` (in `unit`),
            `ellipsoid_95` (share of points in their 95 % ellipsoid), `fit_seconds` (each None or NaN where there is
            none), and optionally `limit` (the Cramer-Rao rms), `split`, `left_out` and `all_others` (as in
            `implicam.compare.Trial`).
        unit: Of length.

    Returns:
        A matplotlib Figure; save it with `figure.savefig(path)`, .png, .pdf or .svg.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    rows = list(table)
    kinds = {str(row.get("split", RANDOM)) for row in rows}
    sizes = {int(row["known"]) for row in rows}
    left_out = kinds - {RANDOM}
    if left_out and (len(kinds) > 1 or len(sizes) == 1 or any(row.get("all_others") for row in rows)):
        return _range_plot(rows, unit)
    return _curves(rows, unit, "shots left out" if left_out else "seeds")


def _curves(rows: Sequence[Row], unit: str, over: str) -> Any:
    """Against the number of known points."""
    figure = new_figure(11.0, 4.3)
    panels = figure.subplots(1, 3)
    methods = _names(rows)
    for k, method in enumerate(methods):
        mine = [row for row in rows if str(row["method"]) == method]
        # Dodged a little, so that bars of different methods stand side by side.
        shift = 1.03 ** (k - (len(methods) - 1) / 2)
        look = {"color": _COLOURS[k % len(_COLOURS)], "marker": MARKS[k % len(MARKS)], "label": method}
        for axes, key in zip(panels, ("rmse", "ellipsoid_95", "fit_seconds"), strict=True):
            known, middle, error = _over_splits(mine, key)
            if len(known):
                axes.errorbar(known * shift, middle, yerr=_bars(middle, error), **_LOOK, lw=1.4, **look)
    _draw_limit(panels[0], rows)
    _finish_curves(panels, sorted({int(row["known"]) for row in rows}), unit)
    place_legend(figure, panels[:1], f"mean ± standard error over the {over}")
    return figure


_LOOK: dict[str, Any] = {"capsize": 3, "ms": 6.5, "mec": "white", "mew": 0.5}


def _names(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(str(row["method"]) for row in rows))


def _over_splits(rows: Sequence[Row], key: str) -> tuple[Floats, Floats, Floats]:
    """Known points, and the mean and its standard error (NaN for one split) of a column at each."""
    known = sorted({int(row["known"]) for row in rows})
    found = [(k, values([row for row in rows if int(row["known"]) == k], key)) for k in known]
    stats = [(k, *mean_and_error(values)) for k, values in found if len(values)]
    known_points, middle, error = np.array(stats, dtype=np.float64).reshape(-1, 3).T
    return known_points, middle, error


def _bars(middle: Floats, error: Floats) -> Floats:
    """(2, n) lengths of the bars; on a log axis the lower end cannot be zero."""
    error = np.nan_to_num(error)
    return np.stack([np.minimum(error, 0.999 * np.abs(middle)), error])


def _draw_limit(axes: Any, rows: Sequence[Row]) -> None:
    known, limit, _ = _over_splits(rows, "limit")
    if len(known) == 1:
        axes.axhline(limit[0], color=GREY, ls="--", lw=1.2, label=_LIMIT)
    elif len(known):
        axes.plot(known, limit, color=GREY, ls="--", lw=1.2, label=_LIMIT)


def _finish_curves(panels: Sequence[Any], known: Sequence[int], unit: str) -> None:
    error, inside, seconds = panels
    ticker = import_extra("matplotlib.ticker", "report", PURPOSE)
    for axes in panels:
        axes.set_xscale("log")
        axes.set_xticks(known, [str(k) for k in known])
        axes.xaxis.set_minor_locator(ticker.NullLocator())
        axes.set_xlabel("known points")
        style_axes(axes)
    plain_log(error.yaxis, name="y")
    error.set_ylabel(f"rms error ({unit})")
    inside.axhline(0.95, color=GREY, ls="--", lw=1.2)
    inside.set_ylim(top=1.02)
    inside.set_ylabel("share inside 95 % ellipsoids\n(0.95 is honest)")
    plain_log(seconds.yaxis, name="y")
    seconds.set_ylabel("seconds to fit")


# what was left out


def _range_plot(rows: Sequence[Row], unit: str) -> Any:
    """A line per method, number of points and kind of split; kinds differ in colour and marker."""
    methods = _names(rows)
    cells = list(dict.fromkeys((_points(row), method) for method in methods for row in rows))
    cells = sorted(cells, key=lambda cell: (cell[0], methods.index(cell[1])))
    kinds = list(dict.fromkeys(str(row.get("split", RANDOM)) for row in rows))
    figure = new_figure(11.0, 1.9 + (0.28 + 0.16 * len(kinds)) * len(cells))
    panels = figure.subplots(1, 2, sharey=True)
    step = 0.8 / len(kinds)
    for k, kind in enumerate(kinds):
        look = {"color": _COLOURS[k % len(_COLOURS)], "marker": MARKS[k % len(MARKS)], "label": _called(kind)}
        mine = [row for row in rows if str(row.get("split", RANDOM)) == kind]
        for axes, key in zip(panels, ("rmse", "ellipsoid_95"), strict=True):
            _draw_ranges(axes, mine, key, cells, step * (k - (len(kinds) - 1) / 2), look)
    _finish_ranges(panels, cells, unit)
    place_legend(figure, panels[:1], "large: mean ± standard error; small: each split")
    return figure


def _points(row: Row) -> int:
    return 0 if row.get("all_others") else int(row["known"])


def _called(kind: str) -> str:
    if plane_axis(kind):
        return f"planes across {plane_axis(kind)} left out"
    return "random splits" if kind == RANDOM else "shots left out"


def _draw_ranges(
    axes: Any, rows: Sequence[Row], key: str, cells: Sequence[tuple[int, str]], shift: float, look: dict[str, Any]
) -> None:
    at, middle, error = [], [], []
    for i, cell in enumerate(cells):
        found = values([row for row in rows if (_points(row), str(row["method"])) == cell], key)
        if not len(found):
            place = {"va": "center", "size": 7, "transform": axes.get_yaxis_transform()}
            axes.text(0.01, i + shift, "no result", color=look["color"], **place)
            continue
        faint = {**look, "label": None, "ms": 3, "mew": 0, "alpha": 0.35}
        axes.plot(found, np.full(len(found), i + shift), ls="", **faint)
        mean, sd = mean_and_error(found)
        at.append(i + shift)
        middle.append(mean)
        error.append(sd)
    if at:
        axes.errorbar(middle, at, xerr=_bars(np.array(middle), np.array(error)), ls="", **_LOOK, **look)


def _finish_ranges(panels: Sequence[Any], cells: Sequence[tuple[int, str]], unit: str) -> None:
    several = len({points for points, _ in cells}) > 1
    names = [f"{method}, {points} points" if several else method for points, method in cells]
    error, inside = panels
    for axes in panels:
        style_axes(axes)
        axes.set_yticks(range(len(cells)), names)
        axes.grid(False, axis="y")
        for line in np.arange(0.5, len(cells) - 1):
            axes.axhline(line, color="0.85", lw=0.6)
    error.set_ylim(len(cells) - 0.5, -0.5)
    plain_log(error.xaxis, name="x")
    error.set_xlabel(f"rms error ({unit})")
    inside.axvline(0.95, color=GREY, ls="--", lw=1.2)
    inside.set_xlim(right=1.02)
    inside.set_xlabel("share inside the 95 % ellipsoid (0.95 is honest)")
