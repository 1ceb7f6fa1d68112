"""What the figures share: colours, layout."""

from __future__ import annotations

import html
from types import ModuleType
from typing import Any

from implicam.errors import import_extra

BLUE, SKY, GREEN, ORANGE, VERMILLION, PURPLE, BLACK = (
    "#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00", "#CC79A7", "#000000",
)  # fmt: skip
MARKS = ("o", "s", "^", "D", "v", "P", "X")
"""matplotlib markers that differ without colour."""

# Half-transparent grey reads on white and on black, so that a page can switch its theme under the figure.
GRID = "rgba(128,128,128,0.25)"
GREY = "#7f7f7f"
INK = "#1d2733"
WHITE = "#ffffff"
CLEAR = "rgba(0,0,0,0)"


def graph_objects() -> ModuleType:
    """Plotly's, or a MissingExtraError that says how to get it."""
    return import_extra("plotly.graph_objects", "report", "an interactive figure")


def plain(text: object) -> str:
    """User text as text: Plotly reads <b> and <a href> in labels, and a point's name must not become a link."""
    return html.escape(str(text), quote=True)


def layout(**more: Any) -> dict[str, Any]:
    """A layout without background or margins, in the page's own font."""
    return {
        "template": "none",
        "paper_bgcolor": CLEAR,
        "plot_bgcolor": CLEAR,
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
        "margin": {"l": 62, "r": 16, "t": 16, "b": 52},
        # Plotly's own toolbar has the background's colour at half strength: of a clear one a grey bar over the figure.
        "modebar": {"bgcolor": CLEAR, "color": GREY, "activecolor": BLUE},
        "hoverlabel": {"bgcolor": WHITE, "bordercolor": GREY, "font": {"color": INK, "size": 13}},
        **more,
    }


def axis(title: str, **more: Any) -> dict[str, Any]:
    """A quiet axis."""
    lines = {"gridcolor": GRID, "linecolor": GREY, "zerolinecolor": GRID, "showline": True, "ticks": "outside"}
    return {"title": {"text": plain(title)}, "automargin": True, "tickcolor": GREY, **lines, **more}
