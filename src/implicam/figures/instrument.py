"""What a calibration is as an instrument: maps of its uncertainty, the rig in 3D, and what each camera saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from implicam.dataset import Floats
from implicam.figures.style import (
    BLUE,
    CLEAR,
    GREY,
    INK,
    SKY,
    VERMILLION,
    axis,
    figure_3d,
    graph_objects,
    layout,
    plain,
    points_3d,
)
from implicam.formatting import number
from implicam.geometry import Bools

COLOURS = "Cividis"
MENU = {"font": {"color": INK, "size": 12}, "bgcolor": "#d5dee8", "bordercolor": GREY}
THRESHOLDS = 9
MAX_ARROWS = 400
"""Of one camera; of more residuals evenly many are drawn."""
_VIEW = {"eye": {"x": 1.36, "y": 1.36, "z": 0.73}, "center": {"x": 0, "y": 0, "z": -0.1}}


def uncertainty_slices(axes: tuple[Floats, Floats, Floats], maps: Mapping[str, Floats], unit: str) -> Any:
    """Three slices through the middle of a box, of a map that a menu chooses.

    Args:
        axes: x, y and z of the grid.
        maps: Name -> (n,) standard uncertainties on it, x slowest; NaN where there is none.
        unit: Of length.

    Returns:
        A Plotly figure.

    Raises:
        MissingExtraError: Plotly is not installed.
    """
    go = graph_objects()
    cubes = {name: values.reshape([len(a) for a in axes]) for name, values in maps.items()}
    middle = [len(a) // 2 for a in axes]
    flats = {
        name: [cube[:, :, middle[2]].T, cube[:, middle[1], :].T, cube[middle[0], :, :].T]
        for name, cube in cubes.items()
    }
    first = next(iter(maps))
    tops = {name: float(np.nanquantile(values, 0.98)) for name, values in maps.items()}
    across = (("x", "y", axes[0], axes[1]), ("x", "z", axes[0], axes[2]), ("y", "z", axes[1], axes[2]))
    figure = go.Figure(layout=layout(showlegend=False, margin={"l": 52, "r": 16, "t": 66, "b": 52}))
    for i, (a, b, left, up) in enumerate(across):
        k = "" if i == 0 else str(i + 1)
        figure.add_trace(
            go.Heatmap(
                x=left, y=up, z=flats[first][i], coloraxis="coloraxis", xaxis=f"x{k}", yaxis=f"y{k}", zsmooth="best",
                hovertemplate=f"{a} %{{x:.4~g}}, {b} %{{y:.4~g}}<br>%{{z:.3~g}} {plain(unit)}<extra></extra>",
            )
        )  # fmt: skip
        low = i * 0.345
        figure.update_layout(
            {
                f"xaxis{k}": axis(f"{a} ({unit})", domain=[low, low + 0.265], anchor=f"y{k}"),
                f"yaxis{k}": axis(f"{b} ({unit})", anchor=f"x{k}"),
            }
        )
        constant = "zyx"[i]
        at = number(float((axes[2], axes[1], axes[0])[i][middle[2 - i]]))
        figure.add_annotation(
            text=f"{constant} = {at}", x=low + 0.132, y=1.02, xref="paper", yref="paper", showarrow=False,
            yanchor="bottom", font={"color": GREY},
        )  # fmt: skip
    figure.update_layout(
        coloraxis={
            "colorscale": COLOURS, "cmin": 0, "cmax": tops[first],
            "colorbar": {"title": {"text": plain(unit), "side": "top"}, "thickness": 14, "outlinewidth": 0},
        },
        updatemenus=[
            {
                "type": "dropdown", "x": 0, "xanchor": "left", "y": 1.1, "yanchor": "bottom", **MENU,
                "buttons": [
                    {"label": name, "method": "update", "args": [{"z": flats[name]}, {"coloraxis.cmax": tops[name]}]}
                    for name in maps
                ],
            }
        ],
    )  # fmt: skip
    return figure


def uncertainty_volume(places: Floats, sd: Floats, unit: str, known: Floats | None = None) -> Any:
    """Where the uncertainty is above a threshold that a slider chooses.

    Args:
        places: (n, 3) in `unit`.
        sd: (n,) standard uncertainties, NaN where there is none.
        unit: Of length.
        known: (m, 3) the known points, drawn besides.

    Returns:
        A Plotly figure.

    Raises:
        MissingExtraError: Plotly is not installed.
    """
    good = np.isfinite(sd)
    places, sd = places[good], sd[good]
    levels = np.unique(np.quantile(sd, np.linspace(0, 0.98, THRESHOLDS)))
    top = float(np.quantile(sd, 0.98))
    marker = {
        "size": 4, "color": sd, "colorscale": COLOURS, "cmin": 0, "cmax": top, "opacity": 0.8,
        "colorbar": {"title": {"text": plain(unit), "side": "top"}, "thickness": 14, "outlinewidth": 0, "len": 0.7},
    }  # fmt: skip
    traces = (
        [] if known is None else [points_3d(known, "known points", marker={"size": 2, "color": SKY}, hoverinfo="skip")]
    )
    steps = []
    texts = [f"{number(float(value))} {plain(unit)}" for value in sd]
    first = len(traces)
    start = min(len(levels) - 1, 2 * len(levels) // 3)
    for k, level in enumerate(levels):
        some = sd >= level
        traces.append(
            points_3d(
                places[some], f"{number(float(level))} {plain(unit)} or more", visible=k == start,
                marker=marker | {"color": sd[some]}, text=[t for t, s in zip(texts, some, strict=True) if s],
                hovertemplate="%{text}<extra></extra>",
            )
        )  # fmt: skip
        shown = [True] * first + [j == k for j in range(len(levels))]
        steps.append({"label": number(float(level)), "method": "restyle", "args": [{"visible": shown}]})
    slider = {
        "active": start, "steps": steps,
        "currentvalue": {"prefix": "standard uncertainty at least ", "suffix": f" {plain(unit)}"},
        "pad": {"t": 6, "b": 10}, "x": 0.02, "len": 0.9, "bgcolor": "#d5dee8", "bordercolor": GREY,
    }  # fmt: skip
    figure = figure_3d(traces, unit, _VIEW, sliders=[slider], legend={"x": 0, "y": 1})
    return figure.update_layout(margin={"b": 96})


def rig_scene(known: Floats, frusta: Mapping[str, Floats], unit: str) -> Any:
    """Where the cameras stand, and what they look at.

    Args:
        known: (m, 3) the known points, in `unit`.
        frusta: Camera -> (5, 3): its centre, and where it sees the corners of its picture, in their order.
        unit: Of length.

    Returns:
        A Plotly figure.

    Raises:
        MissingExtraError: Plotly is not installed.
    """
    traces = [points_3d(known, f"known points ({len(known)})", marker={"size": 2.5, "color": BLUE}, hoverinfo="skip")]
    paths = []
    for corners in frusta.values():
        centre, around = corners[0], np.concatenate([corners[1:], corners[1:2]])
        gap = np.full((1, 3), np.nan)
        paths += [around, gap, *(np.stack([centre, corner, gap[0]]) for corner in corners[1:])]
    if paths:
        lines = np.concatenate(paths)
        traces.append(
            points_3d(lines, "what they see", mode="lines", line={"color": GREY, "width": 2}, hoverinfo="skip")
        )
        centres = np.stack([corners[0] for corners in frusta.values()])
        traces.append(
            points_3d(
                centres, f"cameras ({len(centres)})", mode="markers+text", text=[plain(name) for name in frusta],
                marker={"symbol": "diamond", "size": 4, "color": VERMILLION}, hovertemplate="%{text}<extra></extra>",
            )
        )  # fmt: skip
    eye = {name: 1.2 * value for name, value in _VIEW["eye"].items()}
    return figure_3d(traces, unit, _VIEW | {"eye": eye}, legend={"x": 0, "y": 1})


def camera_residuals(
    uv: Floats, residual: Floats, used: Bools, size: tuple[Floats, Floats], names: Sequence[str]
) -> Any:
    """The picture of one camera: where it saw known points, and how far each view is from what is predicted.

    Args:
        uv: (n, 2) pixels.
        residual: (n, 2) px.
        used: (n,) which views the fit uses.
        size: The first and last (u, v) of the picture.
        names: (n,) of the points.

    Returns:
        A Plotly figure.

    Raises:
        MissingExtraError: Plotly is not installed.
    """
    go = graph_objects()
    off = np.linalg.norm(residual, axis=1)
    typical = float(np.median(off[used])) if used.any() else 1.0
    reach = float(np.linalg.norm(size[1] - size[0]))
    factor = 10.0 ** np.floor(np.log10(max(0.03 * reach / max(typical, 1e-9), 1.0)))
    figure = go.Figure(
        layout=layout(legend={"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom", "bgcolor": CLEAR})
    )
    drawn = (
        np.unique(np.linspace(0, len(uv) - 1, min(len(uv), MAX_ARROWS)).astype(int)) if len(uv) else np.zeros(0, int)
    )
    drawn = np.union1d(drawn, np.flatnonzero(~used)).astype(int)
    for kind, colour, label in ((used, BLUE, "used"), (~used, VERMILLION, "not used")):
        rows = drawn[kind[drawn]]
        if not len(rows):
            continue
        path = np.full((len(rows), 3, 2), np.nan)
        path[:, 0], path[:, 1] = uv[rows], uv[rows] + factor * residual[rows]
        flat = path.reshape(-1, 2)
        line = {"color": colour, "width": 1.3}
        figure.add_trace(
            go.Scatter(x=flat[:, 0], y=flat[:, 1], mode="lines", line=line, hoverinfo="skip", showlegend=False)
        )
        figure.add_trace(
            go.Scatter(
                x=uv[rows, 0], y=uv[rows, 1], mode="markers",
                name=f"{label} ({int(kind.sum())}), residuals ×{factor:g}",
                marker={"color": colour, "size": 4}, hovertemplate="%{text}<extra></extra>",
                text=[f"{plain(names[i])}: {number(float(off[i]))} px off" for i in rows],
            )
        )  # fmt: skip
    low, high = size
    figure.add_shape(type="rect", x0=low[0], y0=low[1], x1=high[0], y1=high[1], line={"color": GREY, "width": 1.5})
    margin = 0.02 * (high - low)
    figure.update_layout(
        margin={"t": 34, "l": 56, "r": 12, "b": 46},
        xaxis=axis("u (px)", range=[low[0] - margin[0], high[0] + margin[0]], zeroline=False),
        yaxis=axis("v (px)", range=[high[1] + margin[1], low[1] - margin[1]], scaleanchor="x", zeroline=False),
    )
    return figure
