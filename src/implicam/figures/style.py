"""What the figures share: colours, layout."""

from __future__ import annotations

import html
from collections.abc import Mapping
from types import ModuleType
from typing import Any

from implicam.dataset import Floats
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


def points_3d(xyz: Floats, name: str, **look: Any) -> Any:
    """A Plotly trace of points (n, 3) in a 3D scene; markers, unless `look` says otherwise."""
    x, y, z = xyz.T
    return graph_objects().Scatter3d(x=x, y=y, z=z, name=name, **{"mode": "markers", **look})


def figure_3d(traces: list[Any], unit: str, camera: Mapping[str, Any], **more: Any) -> Any:
    """A Plotly figure of one 3D scene with quiet axes.

    Args:
        traces: what it shows.
        unit: of length, as the axes name it.
        camera: from where the scene is seen, in Plotly's words.
        more: of the layout; a `scene` in it is joined with ours.

    Returns:
        The figure. It has no margins but room for buttons at the top, and a legend without background.
    """
    scene: dict[str, Any] = {"aspectmode": "data", "camera": camera}
    for name in "xyz":
        title = {"text": plain(f"{name} ({unit})")}
        scene[f"{name}axis"] = {
            "title": title, "gridcolor": GREY, "gridwidth": 0.5, "zeroline": False, "showbackground": False,
        }  # fmt: skip
    figure = graph_objects().Figure(traces, layout(scene=scene, uirevision="keep"))
    figure.update_layout(margin={"l": 0, "r": 0, "t": 44, "b": 0}, legend={"bgcolor": CLEAR, "itemsizing": "constant"})
    return figure.update_layout(**more)
