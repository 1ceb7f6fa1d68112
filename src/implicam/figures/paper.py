"""The paper's curves for print: error and uncertainty against training points, and against points added.

Rows are mappings, one per run; a number that is None or NaN is not drawn. Lengths are mm. The keys that several
figures share:

    set      the set of cameras, "2R", "2R2W" or "2R4W": a panel or a line each, in alphabetical order
    method   "inverse-gp", "inverse-gp:plain", "inverse-gp:paper", "mlp", "forward-gp", "explicit" or any other word
    known    training points
    rmse     root mean square of the distances from the truth, over the test points
    mean_sd  stated standard deviation, averaged over x, y, z and the test points, as in the paper

All return a matplotlib Figure; save it with `figure.savefig(path)`, .pdf, .png or .svg.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from implicam.dataset import Floats
from implicam.figures.printed import choose_looks, mark_empty, new_figure, place_legend, plain_log, style_axes, values
from implicam.figures.style import BLUE, GREEN, GREY, ORANGE, VERMILLION

Row = Mapping[str, Any]

EXPLICIT, EXPLICIT_PAPER, EXPLICIT_BUNDLE = "explicit", "explicit:paper", "explicit:paper-bundle"
LINES = (EXPLICIT_PAPER, EXPLICIT_BUNDLE, EXPLICIT)
"""Methods that are horizontal lines: from pictures of a board, the paper's pipeline in two variants, and ours."""
# The paper's colours, from the palette; the dashes tell them apart in grey.
_BUDGET_LOOKS: dict[str, dict[str, Any]] = {
    "50+10": {"color": GREEN, "ls": (0, (7, 2))},
    "25+6": {"color": ORANGE, "ls": (0, (4, 2, 1, 2))},
    "10+4": {"color": VERMILLION, "ls": (0, (1.5, 1.5))},
}
_SET_LOOKS: tuple[dict[str, Any], ...] = (
    {"color": BLUE, "marker": "o", "ls": "-"},
    {"color": VERMILLION, "marker": "s", "ls": "--"},
    {"color": GREEN, "marker": "^", "ls": "-."},
)
_SET_TITLES = {
    "2R": "2R: two regular cameras",
    "2R2W": "2R2W: two regular, two wide-angle cameras",
    "2R4W": "2R4W: two regular, four wide-angle cameras",
}
_RUNS_LEGEND = "marker: median of the runs; thick bar: middle half; thin bar: all"
_LABEL_GAP_SHARE = 0.085  # of a panel's height, between labels beside it


def rmse_curves(rows: Iterable[Row], *, total: int | None = None) -> Any:
    """Error against training points, log scale: a panel for each set, a line for each method (the paper's Figure 5).

    Args:
        rows: Keys set, method, known, rmse. Rows of `LINES` have `budget` ("50+10": pictures of each camera and of
            each pair) in place of known, and become a horizontal line: at the error of the subset with the median
            `reprojection` error, as in the paper, the median over the rigs (`rig`). Where the paper's pipeline is
            there, of ours only the largest budget is drawn.
        total: Number of points to split; the axis then shows the share trained on as well.

    Returns:
        A matplotlib Figure.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    table = list(rows)
    learners = [row for row in table if row["method"] not in LINES]
    explicit = [row for row in table if row["method"] in LINES]
    sets = _words(table, "set")
    figure = new_figure(7.5, 1.7 + 2.6 * max(len(sets), 1))
    panels = figure.subplots(max(len(sets), 1), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, name in zip(panels, sets or [""], strict=True):
        _runs_of_methods(
            axes, _where(learners, set=name), "rmse", _sizes(learners), choose_looks(_words(learners, "method"))
        )
        _explicit_lines(axes, _where(explicit, set=name))
        axes.set_title(_SET_TITLES.get(name, name), loc="left", size=10)
        axes.set_ylabel("rms error (mm)")
        style_axes(axes)
    _log_or_empty(panels)
    _against_known(panels[-1:], _sizes(learners), total)
    for axes, name in zip(panels, sets, strict=False):
        _label_lines(axes, _where(explicit, set=name))
    place_legend(figure, panels, _RUNS_LEGEND, columns=2)
    return figure


def sd_curves(rows: Iterable[Row], *, total: int | None = None) -> Any:
    """Average stated standard deviation against training points, log scale (the paper's Figure 6).

    There is a panel for each method that states one, a line for each set; "explicit", which has no training points, is
    left out.

    Args:
        rows: Keys set, method, known, mean_sd.
        total: As in `rmse_curves`.

    Returns:
        A matplotlib Figure.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    table = [row for row in rows if row["method"] not in LINES and len(values([row], "mean_sd"))]
    methods = list(choose_looks(_words(table, "method")))
    figure = new_figure(1.2 + 3.7 * max(len(methods), 1), 4.0)
    panels = figure.subplots(1, max(len(methods), 1), sharey=True, squeeze=False)[0]
    styles = {name: _SET_LOOKS[i % len(_SET_LOOKS)] for i, name in enumerate(_words(table, "set"))}
    for axes, method in zip(panels, methods or [""], strict=True):
        for i, (name, look) in enumerate(styles.items()):
            shift = _dodge(_sizes(table), i, len(styles))
            _draw_runs(
                axes, _where(table, method=method, set=name), "mean_sd", _sizes(table), shift, {**look, "label": name}
            )
        axes.set_title(method, loc="left", size=10)
        style_axes(axes)
    panels[0].set_ylabel("average stated standard deviation (mm)")
    _log_or_empty(panels)
    _against_known(panels, _sizes(table), total)
    place_legend(figure, panels, _RUNS_LEGEND)
    return figure


def sd_against_rmse(rows: Iterable[Row], *, floor: float | None = None) -> Any:
    """Average stated standard deviation against error, both on log scales: does the uncertainty follow the error?

    There is a panel for each set, a faint dot for each run and, for each method, a line through the medians of the runs
    with the same `known` or budget, in ascending order. On the diagonal the stated uncertainty is right: the rms of a
    distance is root 3 times the standard deviation of an axis.

    Args:
        rows: Keys set, method, known (or budget), rmse, mean_sd.
        floor: Standard deviation below which a method cannot state one, drawn as a line, mm.

    Returns:
        A matplotlib Figure.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    table = [row for row in rows if len(values([row], "rmse")) and len(values([row], "mean_sd"))]
    sets = _words(table, "set")
    figure = new_figure(1.0 + 3.5 * max(len(sets), 1), 4.4)
    panels = figure.subplots(1, max(len(sets), 1), sharex=True, sharey=True, squeeze=False)[0]
    for axes, name in zip(panels, sets or [""], strict=True):
        for method, look in choose_looks(_words(table, "method")).items():
            _draw_pairs(axes, _where(table, set=name, method=method), {**look, "label": method})
        axes.set_title(_SET_TITLES.get(name, name).partition(":")[0], loc="left", size=10)
        axes.set_xlabel("rms error (mm)")
        style_axes(axes)
    panels[0].set_ylabel("average stated standard deviation (mm)")
    _log_or_empty(panels, x=True)
    if table:
        for axes in panels:
            _draw_honest(axes, floor)
    place_legend(figure, panels, "large: medians over runs with the same number of points; small: each run")
    return figure


def active_curves(rows: Iterable[Row]) -> Any:
    """Uncertainty against points added by active learning (the paper's Figure 8).

    There is a row of panels for each method, a column for each set, a thin line for each repeat.

    Args:
        rows: Keys set, method, repeat (which start), added (points added so far), max_sd and mean_sd (largest and mean,
            over the points that are left, of the standard deviation averaged over x, y, z).

    Returns:
        A matplotlib Figure.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    table = list(rows)
    methods, sets = list(choose_looks(_words(table, "method"))) or [""], _words(table, "set") or [""]
    figure = new_figure(1.0 + 3.4 * len(sets), 1.2 + 2.5 * len(methods))
    panels = figure.subplots(len(methods), len(sets), sharex=True, sharey="row", squeeze=False)
    for line, method in zip(panels, methods, strict=True):
        for axes, name in zip(line, sets, strict=True):
            _draw_repeats(axes, _where(table, method=method, set=name))
            axes.set_title(f"{name}, {method}" if len(methods) > 1 else name, loc="left", size=10)
            style_axes(axes)
        line[0].set_ylabel("standard deviation (mm)")
        _log_or_empty(line)
    for axes in panels[-1]:
        axes.set_xlabel("points added")
    place_legend(figure, panels.ravel(), "a line for each start")
    return figure


# choosing rows


def _words(rows: Iterable[Row], key: str) -> list[str]:
    return sorted({str(row[key]) for row in rows})


def _sizes(rows: Iterable[Row]) -> list[int]:
    return sorted({int(row["known"]) for row in rows})


def _where(rows: Iterable[Row], **wanted: str) -> list[Row]:
    return [row for row in rows if all(str(row[key]) == value for key, value in wanted.items())]


# runs as a line of medians with bars


def _runs_of_methods(axes: Any, rows: Sequence[Row], key: str, sizes: Sequence[int], styles: dict[str, Any]) -> None:
    for i, (method, look) in enumerate(styles.items()):
        shift = _dodge(sizes, i, len(styles))
        _draw_runs(axes, _where(rows, method=method), key, sizes, shift, {**look, "label": method})


def _dodge(sizes: Sequence[int], i: int, n: int) -> float:
    """How far the i-th of n series stands to the side, so that bars do not cover each other."""
    gap = min(float(np.diff(sizes).min()), np.ptp(sizes) / 8) if len(sizes) > 1 else 1.0
    return 0.62 * gap * (i - (n - 1) / 2) / n


def _draw_runs(
    axes: Any, rows: Sequence[Row], key: str, sizes: Sequence[int], shift: float, look: dict[str, Any]
) -> None:
    """Medians joined by a line (broken where no run has a number), with bars for the middle half and for all."""
    found = [values([row for row in rows if int(row["known"]) == size], key) for size in sizes]
    quantiles = np.array([_quantiles(runs) for runs in found], dtype=np.float64).reshape(-1, 5)
    at = np.asarray(sizes, dtype=np.float64) + shift
    if not np.isfinite(quantiles).any():
        return
    lowest, low, middle, high, highest = quantiles.T
    axes.vlines(at, lowest, highest, color=look["color"], lw=0.8)
    axes.vlines(at, low, high, color=look["color"], lw=3.2, alpha=0.55)
    axes.plot(at, middle, **look, lw=1.1, ms=4.6, mec="white", mew=0.4)


def _quantiles(runs: Floats) -> Floats:
    return np.quantile(runs, [0, 0.25, 0.5, 0.75, 1]) if len(runs) else np.full(5, np.nan)


def _explicit_lines(axes: Any, rows: Sequence[Row]) -> None:
    for (method, budget), error in _heights(rows).items():
        axes.axhline(
            error,
            zorder=1.9,
            label=f"{method}, {_spaced(budget)} pictures",
            **{**_BUDGET_LOOKS.get(budget, _OTHER_BUDGET_LOOK), **_LINE_LOOKS[method]},
        )


_OTHER_BUDGET_LOOK: dict[str, Any] = {"color": GREY, "ls": (0, (1, 3))}


_LINE_LOOKS: dict[str, dict[str, Any]] = {
    EXPLICIT_PAPER: {"lw": 1.6},
    EXPLICIT_BUNDLE: {"lw": 0.8},
    EXPLICIT: {"lw": 1.6},
}


def _heights(rows: Sequence[Row]) -> dict[tuple[str, str], float]:
    """Errors of the lines, by method and budget."""
    budgets = [*_BUDGET_LOOKS, *sorted({str(row["budget"]) for row in rows} - set(_BUDGET_LOOKS))]
    paper = any(row["method"] == EXPLICIT_PAPER for row in rows)
    found = {}
    for method in LINES:
        for budget in budgets[:1] if paper and method == EXPLICIT else budgets:
            errors = _of_median_subsets(_where(rows, method=method, budget=budget))
            if errors:
                found[method, budget] = float(np.median(errors))
    return found


def _of_median_subsets(rows: Sequence[Row]) -> list[float]:
    """For each rig the error of the subset with the median reprojection error, the lower one of two."""
    rigs: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if len(values([row], "rmse")):
            rigs.setdefault(str(row.get("rig", "")), []).append((row.get("reprojection", row["rmse"]), row["rmse"]))
    return [sorted(pairs)[(len(pairs) - 1) // 2][1] for pairs in rigs.values()]


def _spaced(budget: str) -> str:
    return budget.replace("+", " + ")


def _label_lines(axes: Any, rows: Sequence[Row]) -> None:
    """Name the explicit lines, of the paper's pipeline where it is there, at the panel's right edge, kept apart where
    they nearly coincide."""
    heights, named = _heights(rows), EXPLICIT_PAPER
    if not any(method == named for method, _ in heights):
        named = EXPLICIT
    medians = sorted(
        ((budget, error) for (method, budget), error in heights.items() if method == named), key=lambda item: item[1]
    )
    low, high = np.log(axes.get_ylim())
    places = _apart([(float(np.log(error)) - low) / (high - low) for _, error in medians], _LABEL_GAP_SHARE)
    for (budget, _), place in zip(medians, places, strict=True):
        colour = _BUDGET_LOOKS.get(budget, _OTHER_BUDGET_LOOK)["color"]
        where = {"transform": axes.transAxes, "va": "center", "size": 8}
        axes.text(1.01, place, _spaced(budget), color=colour, weight="bold", **where)


def _apart(places: Sequence[float], gap: float) -> list[float]:
    """Ascending places moved so that neighbours are at least `gap` apart, groups staying centred."""
    groups: list[list[float]] = []
    for place in places:
        groups.append([place])
        while len(groups) > 1 and _start(groups[-1], gap) < _start(groups[-2], gap) + gap * len(groups[-2]):
            groups[-2:] = [groups[-2] + groups[-1]]
    return [_start(group, gap) + gap * i for group in groups for i in range(len(group))]


def _start(group: Sequence[float], gap: float) -> float:
    return sum(group) / len(group) - gap * (len(group) - 1) / 2


# pairs and repeats


def _draw_pairs(axes: Any, rows: Sequence[Row], look: dict[str, Any]) -> None:
    if not rows:
        return
    dots = {"color": look["color"], "marker": look["marker"], "ls": "", "ms": 2.2, "mew": 0, "alpha": 0.3}
    axes.plot(values(rows, "rmse"), values(rows, "mean_sd"), **dots)
    cells: dict[Any, list[Row]] = {}
    for row in rows:
        cells.setdefault(row["budget"] if "budget" in row else int(row["known"]), []).append(row)
    medians = [[float(np.median(values(cells[c], key))) for c in sorted(cells)] for key in ("rmse", "mean_sd")]
    axes.plot(*medians, **look, lw=1.1, ms=6, mec="white", mew=0.5)


def _draw_honest(axes: Any, floor: float | None) -> None:
    ends = np.array(axes.get_xlim())
    limits = axes.get_ylim()
    # Behind the data, which should lie on it.
    axes.plot(
        ends, ends / np.sqrt(3), color=GREY, lw=1.4, zorder=1, label="honest: rms error = √3 × standard deviation"
    )
    if floor is not None:
        axes.axhline(floor, color=GREY, lw=1.2, ls=(0, (1, 2)), label=f"noise floor, {floor:g} mm")
    axes.set(xlim=ends, ylim=limits)


def _draw_repeats(axes: Any, rows: Sequence[Row]) -> None:
    for key, label, look in (
        ("max_sd", "largest of the points left", {"color": BLUE, "ls": "-"}),
        ("mean_sd", "mean of the points left", {"color": VERMILLION, "ls": "--"}),
    ):
        for i, repeat in enumerate(_words(rows, "repeat")):
            mine = sorted(_where(rows, repeat=repeat), key=lambda row: int(row["added"]))
            sd = [float("nan") if row.get(key) is None else float(row[key]) for row in mine]
            axes.plot([int(row["added"]) for row in mine], sd, **look, lw=0.9, label=label if i == 0 else None)


# axes


def _log_or_empty(panels: Iterable[Any], *, x: bool = False) -> None:
    for axes in panels:
        if not axes.lines:
            mark_empty(axes)
        plain_log(axes.yaxis, name="y")
        if x:
            plain_log(axes.xaxis, name="x")


def _against_known(panels: Iterable[Any], sizes: Sequence[int], total: int | None) -> None:
    """Ticks at the numbers of training points, with the share of all where their total is known."""
    labels = [f"{size}\n{round(100 * size / total)}%" if total else str(size) for size in sizes]
    for axes in panels:
        axes.set_xticks(sizes, labels, size=8.5)
        axes.set_xlabel(f"training points, and their share of {total}" if total else "training points")
