"""Active learning, for print: what each rule reaches with how many known points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from implicam.dataset import Floats
from implicam.figures.printed import new_figure, plain_log, style_axes
from implicam.figures.style import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION

_LOOKS: dict[str, dict[str, Any]] = {
    "random": {"color": GREY, "marker": "x", "ls": ":"},
    "sobol": {"color": SKY, "marker": "^", "ls": ":"},
    "grid": {"color": BLACK, "marker": "s", "ls": "none"},
    "variance": {"color": VERMILLION, "marker": "v", "ls": "--"},
    "d-optimal": {"color": PURPLE, "marker": "P", "ls": "-."},
    "excess": {"color": ORANGE, "marker": "D", "ls": "-"},
    "integrated": {"color": BLUE, "marker": "o", "ls": "-"},
    "own start": {"color": GREEN, "marker": "*", "ls": "-"},
}
_WORDS = {"variance": "variance (the paper's rule)", "own start": "integrated, evenly spread start"}


@dataclass(frozen=True, eq=False)
class Panel:
    """One panel: a quantity, on a log scale, against the number of known points.

    Attributes:
        title: Over the panel.
        ylabel: What is drawn upwards.
        rules: Name -> (points, mean, standard error), (k,) each.
        line: A value to be drawn as a line, and its name; None for none.
    """

    title: str
    ylabel: str
    rules: Mapping[str, tuple[Floats, Floats, Floats]]
    line: tuple[float, str] | None = None


def learning(rows: Sequence[Sequence[Panel]]) -> Any:
    """Rows of panels; bands and bars are one standard error of the mean.

    Args:
        rows: The panels of each row.

    Returns:
        A matplotlib Figure.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    columns = max(map(len, rows))
    figure = new_figure(4.4 * columns, 3.7 * len(rows) + 0.7)
    grid = figure.subplots(len(rows), columns, squeeze=False)
    handles: dict[str, Any] = {}
    for across, panels in zip(grid, rows, strict=True):
        for axes, panel in zip(across, panels, strict=False):
            handles |= _draw(axes, panel)
        for axes in across[len(panels) :]:
            axes.set_axis_off()
    names = [name for name in _LOOKS if name in handles]
    labels = [_WORDS.get(name, name) for name in names]
    figure.legend([handles[name] for name in names], labels, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _draw(axes: Any, panel: Panel) -> dict[str, Any]:
    handles = {}
    style_axes(axes)
    for name, (points, mean, error) in panel.rules.items():
        look = _LOOKS.get(name, {"color": GREY})
        every = max(1, len(points) // 8)
        if look.get("ls") == "none":
            handles[name] = axes.errorbar(points, mean, yerr=error, ms=5, zorder=3, **look)
            continue
        axes.fill_between(points, mean - error, mean + error, color=look["color"], alpha=0.18, lw=0)
        (handles[name],) = axes.plot(points, mean, ms=5, lw=1.6, markevery=every, **look)
    if panel.line is not None:
        value, words = panel.line
        axes.axhline(value, color="0.3", lw=1)
        axes.annotate(
            words, (0, value), xycoords=("axes fraction", "data"), xytext=(3, 3), textcoords="offset points",
            ha="left", fontsize=8, color="0.3",
        )  # fmt: skip
    axes.set_title(panel.title, fontsize=10, loc="left")
    axes.set(xlabel="known points", ylabel=panel.ylabel)
    plain_log(axes.yaxis, name="y")
    axes.set_xlim(left=0)
    return handles
