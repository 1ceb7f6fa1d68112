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
    """Plotly's module of that name.

    Raises:
        MissingExtraError: Plotly is not installed; says how to get it.
    """
    return import_extra("plotly.graph_objects", "report", "an interactive figure")


def plain(text: object) -> str:
    """Text from a user, escaped: Plotly reads <b> and <a href> in labels, and a point's name must not become a link.

    Args:
        text: Anything; it becomes text.
    """
    return html.escape(str(text), quote=True)


def layout(**more: Any) -> dict[str, Any]:
    """A layout without background or margins, in the page's own font.

    Args:
        more: Entries to add or replace, in Plotly's words.
    """
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
    """An axis with thin grey lines.

    Args:
        title: Its name.
        more: Entries to add or replace, in Plotly's words.
    """
    lines = {"gridcolor": GRID, "linecolor": GREY, "zerolinecolor": GRID, "showline": True, "ticks": "outside"}
    return {"title": {"text": plain(title)}, "automargin": True, "tickcolor": GREY, **lines, **more}


def points_3d(xyz: Floats, name: str, **look: Any) -> Any:
    """A trace of points in a 3D scene; markers, unless `look` says otherwise.

    Args:
        xyz: (n, 3); NaN is a gap.
        name: In the legend.
        look: In Plotly's words.

    Returns:
        A Plotly trace.

    Raises:
        MissingExtraError: Plotly is not installed.
    """
    x, y, z = xyz.T
    return graph_objects().Scatter3d(x=x, y=y, z=z, name=name, **{"mode": "markers", **look})


def figure_3d(traces: list[Any], unit: str, camera: Mapping[str, Any], **more: Any) -> Any:
    """A figure of one 3D scene with thin grey axes.

    Args:
        traces: What it shows.
        unit: Of length, as the axes name it.
        camera: From where the scene is seen, in Plotly's words.
        more: Of the layout; a `scene` in it is merged with ours.

    Returns:
        A Plotly figure. It has no margins but space for buttons at the top, and a legend without background.

    Raises:
        MissingExtraError: Plotly is not installed.
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
