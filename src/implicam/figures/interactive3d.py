"""The panels of `implicam.figures.panels3d` for a browser: one scene, a menu of panels, a page that loads nothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from implicam.dataset import Floats
from implicam.errors import import_extra
from implicam.figures.panels3d import (
    COLOUR_MAP,
    Panel,
    PanelPoints,
    Scales,
    bounding_box,
    exaggerated_residuals,
    known_of,
    line_segments,
    points_in_view,
    scales_of,
    select_points,
    title_of,
)
from implicam.figures.style import BLACK, BLUE, GREEN, GREY, ORANGE, SKY, VERMILLION, WHITE, figure_3d, plain, points_3d
from implicam.formatting import number
from implicam.templates import Markup, render

# Nothing may be loaded from anywhere; Plotly compiles some of its own code, hence eval.
POLICY = Markup(
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; img-src data: blob:; "
    "font-src data:; base-uri 'none'; form-action 'none'"
)
_PER_PANEL = 4  # traces
# From where the printed figures look: 60 degrees to the side, 30 above.
_VIEW = {"eye": {"x": 1.05, "y": -1.8, "z": 1.2}, "center": {"x": 0, "y": 0, "z": -0.1}}


def panels_3d(panels: Iterable[Panel], *, scales: Scales | None = None, every: int = 1) -> Any:
    """One of several panels at a time, chosen from a menu; all with the same axes and scales.

    It is one scene, because a browser gives a page some eight to sixteen of them and experiment 3 has twelve panels.

    Args:
        panels: As of `implicam.figures.panels3d`.
        scales: What colour and size mean; None for scales of the panels.
        every: Draw one test point of so many.

    Returns:
        A Plotly figure.

    Raises:
        MissingExtraError: Plotly is not installed.
    """
    chosen = list(panels)
    scales = scales or scales_of(chosen)
    found = [select_points(panel, every) for panel in chosen]
    traces = [trace for i, panel in enumerate(chosen) for trace in _traces(panel, found[i], scales, i == 0)]
    titles = [plain(title_of(panel, d)) for panel, d in zip(chosen, found, strict=True)]
    corners = bounding_box(
        [c for panel, d in zip(chosen, found, strict=True) for c in points_in_view(panel, d, scales)]
    )
    return _figure(traces, corners, [_menu(titles)] if len(titles) > 1 else [])


def draw_alignment_3d(
    true_xyz: Floats, aligned_xyz: Floats, camera_xyz: Floats | None = None, *, camera: str = "cam2"
) -> Any:
    """Explicit calibration's points before and after alignment; as `panels3d.draw_alignment`.

    Args:
        true_xyz: (n, 3) the robot's positions, mm.
        aligned_xyz: (n, 3) explicit calibration's, moved onto them, mm.
        camera_xyz: (n, 3) the same points in the frame of `camera`, before they were moved, mm.
        camera: The name of that camera.

    Returns:
        A Plotly figure.

    Raises:
        MissingExtraError: Plotly is not installed.
    """
    parts: list[tuple[Floats | None, str, str, str]] = [
        (true_xyz, "robot's positions", "cross", BLUE),
        (aligned_xyz, "explicit, aligned", "circle-open", GREEN),
        (camera_xyz, f"explicit, in the frame of {camera}", "diamond-open", ORANGE),
    ]
    traces = [
        _points(np.asarray(xyz), plain(name), marker={"symbol": symbol, "size": 4, "color": colour})
        for xyz, name, symbol, colour in parts
        if xyz is not None
    ]
    lines, words = exaggerated_residuals(true_xyz, aligned_xyz)
    traces.append(_points(lines, plain(words), mode="lines", line={"color": VERMILLION, "width": 3}))
    return _figure(traces, bounding_box(xyz for xyz, *_ in parts if xyz is not None), [])


def html_page(figure: Any, *, title: str, caption: str = "") -> str:
    """A figure as one HTML page that works offline (about 5 MB, nearly all of it plotly.js); same figure, same text.

    Args:
        figure: A Plotly figure.
        title: Of the page.
        caption: Below the figure.

    Raises:
        MissingExtraError: Plotly or Jinja2 is not installed.
    """
    return render(
        __package__,
        "figure.html",
        policy=POLICY,
        plotly_js=plotly_js("an interactive figure"),
        figure=figure_json(figure),
        title=title,
        caption=caption,
    )


def plotly_js(purpose: str) -> Markup:
    """Plotly's own script, for a page that loads nothing.

    Args:
        purpose: What needs it, in words.

    Raises:
        MissingExtraError: Plotly is not installed; says the purpose.
    """
    return Markup(import_extra("plotly.offline", "report", purpose).get_plotlyjs())


def figure_json(figure: Any) -> Markup:
    """A Plotly figure as JSON that may stand inside a script element of a page.

    Args:
        figure: The figure.
    """
    # Only "<" can end a script element; in JSON it stands in strings only, where \u003c is the same.
    return Markup(figure.to_json().replace("<", "\\u003c"))


def _traces(panel: Panel, found: PanelPoints, scales: Scales, visible: bool) -> list[Any]:
    """The _PER_PANEL traces of a panel."""
    lines = line_segments(found.xyz, found.true)
    known = known_of(panel)
    traces = [
        _points(known, f"training points ({len(known)})", marker={"symbol": "cross", "size": 3, "color": SKY}),
        _points(lines, "to the truth", mode="lines", line={"color": BLACK, "width": 2}),
        _points(found.true, "truth", marker={"size": 2, "color": BLACK}),
        _measured(found, scales),
    ]
    for trace in traces:
        trace.visible = visible
    return traces


def _points(xyz: Floats, name: str, **look: Any) -> Any:
    return points_3d(xyz, name, hoverinfo="skip", **look)


def _measured(found: PanelPoints, scales: Scales) -> Any:
    colour, low, top, ticks = found.error, 0.0, scales.error_top, dict[str, Any]()
    if scales.error_low > 0:  # Plotly has no logarithmic colours
        colour = np.log10(np.maximum(colour, scales.error_low))
        low, top = float(np.log10(scales.error_low)), float(np.log10(top))
        lengths = [m * 10.0**e for e in range(-6, 7) for m in (1, 2, 5)]
        lengths = [length for length in lengths if scales.error_low <= length <= scales.error_top]
        ticks = {"tickvals": np.log10(lengths).tolist(), "ticktext": [f"{length:g}" for length in lengths]}
    bar = {
        **ticks, "title": {"text": "distance from<br>the truth (mm)", "side": "top"}, "thickness": 14, "len": 0.7,
        "outlinewidth": 0, "ticks": "outside", "x": 0.95,
    }  # fmt: skip
    marker = {
        "size": scales.diameters(found.sd, len(found.xyz)), "color": colour, "cmin": low,
        "cmax": top, "colorscale": COLOUR_MAP.capitalize(), "colorbar": bar,
        "line": {"width": 1, "color": BLACK}, "opacity": 1.0,
    }  # fmt: skip
    certain = "" if found.sd is None else ", larger: less certain"
    name = f"measured ({len(found.xyz)}){certain}"
    return points_3d(found.xyz, name, marker=marker, text=_hover(found), hoverinfo="text")


def _hover(found: PanelPoints) -> list[str]:
    sd = np.full(len(found.error), np.nan) if found.sd is None else found.sd
    return [f"off by {number(e)} mm<br>stated sd {number(s)} mm" for e, s in zip(found.error, sd, strict=True)]


def _menu(titles: Sequence[str]) -> dict[str, Any]:
    def shown(i: int) -> list[bool]:
        return [k == i for k in range(len(titles)) for _ in range(_PER_PANEL)]

    buttons = [{"label": t, "method": "restyle", "args": [{"visible": shown(i)}]} for i, t in enumerate(titles)]
    return {
        "type": "dropdown", "buttons": buttons, "x": 0, "xanchor": "left", "y": 1.0, "yanchor": "bottom",
        "pad": {"b": 6}, "bgcolor": WHITE, "bordercolor": GREY,
    }  # fmt: skip


def _figure(traces: list[Any], corners: Floats, menus: list[Any]) -> Any:
    """One scene with the same room for all panels, so that another panel does not change the view."""
    ranges = {f"{name}axis": {"range": list(corners[:, i])} for i, name in enumerate("xyz")}
    legend = {"x": 0, "y": 0, "yanchor": "bottom"}
    return figure_3d(traces, "mm", _VIEW, scene=ranges, updatemenus=menus, legend=legend)
