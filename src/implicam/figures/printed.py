"""What the figures for print share: an empty figure, quiet axes, plain numbers on log axes, the look of a method."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset import Floats
from implicam.errors import import_extra
from implicam.figures.style import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION
from implicam.files import replacing

PURPOSE = "a figure for print"
# Marker and dash differ wherever the colour does, so that methods are told apart in grey too.
_LOOKS: dict[str, dict[str, Any]] = {
    "inverse-gp": {"color": BLUE, "marker": "o", "ls": "-"},
    "inverse-gp:plain": {"color": BLUE, "marker": "h", "ls": (0, (5, 1, 1, 1))},
    "inverse-gp:paper": {"color": SKY, "marker": "s", "ls": "--"},
    "mlp": {"color": PURPLE, "marker": "^", "ls": "-."},
    "forward-gp": {"color": BLACK, "marker": "D", "ls": ":"},
    "explicit": {"color": GREEN, "marker": "v", "ls": (0, (7, 2))},
}
_OTHERS: tuple[dict[str, Any], ...] = (
    {"color": VERMILLION, "marker": "P", "ls": "-"},
    {"color": ORANGE, "marker": "X", "ls": "--"},
    {"color": GREY, "marker": "*", "ls": "-."},
)


def new_figure(width: float, height: float) -> Any:
    """An empty matplotlib Figure; nothing touches pyplot's global state.

    Args:
        width: Inches.
        height: Inches.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    module = import_extra("matplotlib.figure", "report", PURPOSE)
    return module.Figure(figsize=(width, height), layout="constrained")


def choose_looks(methods: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Colour, marker and dash of each method; a method of the paper or of ours looks the same in every figure.

    Args:
        methods: Their names.

    Returns:
        Name -> matplotlib's words for its look; the methods of the paper and ours come first.
    """
    names = set(methods)
    others = sorted(names - set(_LOOKS))
    known = {name: look for name, look in _LOOKS.items() if name in names}
    return known | {name: _OTHERS[i % len(_OTHERS)] for i, name in enumerate(others)}


def style_axes(axes: Any) -> None:
    """A light grid behind the data, and no box around them.

    Args:
        axes: A matplotlib Axes.
    """
    axes.grid(True, color="0.9", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def plain_log(axis: Any, *, name: str) -> None:
    """Make an axis logarithmic, with plain numbers: 1, 2, 5 where there is space, else decades.

    Args:
        axis: A matplotlib Axis.
        name: "x" or "y".
    """
    ticker = import_extra("matplotlib.ticker", "report", PURPOSE)
    axis.axes.set(**{f"{name}scale": "log"})
    axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(ticker.NullFormatter())
    # Panels that share an axis share its ticks, and so all their data count.
    shared = getattr(axis.axes, f"get_shared_{name}_axes")().get_siblings(axis.axes)
    ends = np.array([getattr(axes, f"{name}axis").get_data_interval() for axes in shared])
    ends = ends[np.isfinite(ends).all(axis=1) & (ends[:, 0] > 0)]
    low, high = (float(ends[:, 0].min()), float(ends[:, 1].max())) if len(ends) else (1.0, 1.0)
    decades = np.log10(high / low) if 0 < low < high < np.inf else 1.0
    if decades < 0.7:  # one or two of 1, 2, 5 at most
        axis.set_major_locator(ticker.MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    else:
        axis.set_major_locator(ticker.LogLocator(subs=(1,) if decades > 2.5 else (1, 2, 5)))


def values(rows: Iterable[Mapping[str, Any]], key: str) -> Floats:
    """The numbers of a column that are there and finite.

    Args:
        rows: Rows of a table.
        key: The column.

    Returns:
        (k,).
    """
    found = [float(row[key]) for row in rows if row.get(key) is not None]
    return np.array([value for value in found if np.isfinite(value)], dtype=np.float64)


def mark_empty(axes: Any) -> None:
    """Write into an empty panel that there is no result.

    Args:
        axes: A matplotlib Axes.
    """
    axes.text(0.5, 0.5, "no result", ha="center", va="center", color="0.4", transform=axes.transAxes)


def place_legend(figure: Any, panels: Iterable[Any], title: str, columns: int = 4) -> None:
    """One legend below all panels, each label once.

    Args:
        figure: A matplotlib Figure.
        panels: The Axes whose labels are collected.
        title: Of the legend.
        columns: How many at most.
    """
    found: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    if found:
        where = {"loc": "outside lower center", "ncols": min(len(found), columns), "frameon": False, "fontsize": 9}
        figure.legend(list(found.values()), list(found), title=title, title_fontsize=9, handlelength=3.2, **where)


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure, whole or not at all.

    Args:
        figure: A matplotlib Figure.
        path: Of the file, .png, .pdf or .svg; it is replaced.

    Raises:
        ImplicamError: The file cannot be written.
    """
    with replacing(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:].lower(), dpi=160)
