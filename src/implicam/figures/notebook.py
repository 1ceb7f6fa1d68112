"""One figure for each thing that a notebook shows: a dataset, a calibration, a measurement."""

from __future__ import annotations

from functools import singledispatch
from typing import Any

import numpy as np

from implicam.calibrators.protocol import CalibrationBase
from implicam.dataset import Dataset, Floats
from implicam.figures.scene_figure import scene
from implicam.figures.style import INK, VERMILLION, figure_3d, graph_objects, layout, plain, points_3d
from implicam.measurement import Measurement

VIEW = {"eye": {"x": 1.36, "y": 1.36, "z": 0.73}, "center": {"x": 0, "y": 0, "z": -0.16}}

COLOURS = "Viridis"


@singledispatch
def plot(thing: Any) -> Any:
    """The figure of a dataset, a calibration or a measurement.

    Args:
        thing: One of them.

    Returns:
        A Plotly figure.

    Raises:
        TypeError: It is something else.
        MissingExtraError: Plotly is not installed.
    """
    raise TypeError(f"there is no figure of {type(thing).__name__}")


@plot.register
def _(thing: Measurement) -> Any:
    """Where the points are; size and colour are their uncertainty."""
    return scene(
        thing.xyz, thing.sd, names=thing.points, views=thing.views, unit=thing.length_unit,
        share_calibration=thing.share_calibration if np.isfinite(thing.share_calibration).any() else None,
    )  # fmt: skip


@plot.register
def _(thing: Dataset) -> Any:
    """Known positions with the number of cameras that see each; without them, the pixels of each camera."""
    if thing.known is None:
        return _pixels(thing)
    seen = thing.observations.seen
    cameras = np.array([plain(camera.name) for camera in thing.cameras])
    hover = [
        f"<b>{plain(name)}</b><br>seen by {', '.join(cameras[row]) or 'none'}"
        for name, row in zip(thing.points, seen, strict=True)
    ]
    count = seen.sum(axis=1)
    marker = {
        "size": 5, "color": count, "colorscale": COLOURS, "cmin": 0, "cmax": len(thing.cameras),
        "colorbar": {"title": {"text": "cameras<br>that see it"}, "thickness": 14, "len": 0.7, "outlinewidth": 0},
    }  # fmt: skip
    points = points_3d(
        np.array(thing.xyz), f"known points ({len(thing)})", marker=marker, hovertext=hover, hoverinfo="text"
    )
    return figure_3d([points], thing.length_unit, VIEW)


@plot.register
def _(thing: CalibrationBase) -> Any:
    """Its known points as it measures them, their distances from the known positions, and the cameras."""
    if thing.data.known is None:
        return plot(thing.data)
    data: Dataset = thing.data
    measured = thing.measure(data)  # type: ignore[attr-defined]
    error = np.linalg.norm(measured.xyz - data.xyz, axis=1)
    figure = scene(
        measured.xyz, measured.sd, names=measured.points, views=measured.views, unit=measured.length_unit,
        known_xyz=data.xyz, true_xyz=data.xyz, error=error, cameras=_centres(thing),
    )  # fmt: skip
    return figure


def _centres(calibration: Any) -> dict[str, Floats]:
    """Where the cameras are, of a calibration that knows it."""
    found = {}
    for name, camera in getattr(calibration, "cameras", {}).items():
        pose = getattr(camera, "camera_from_world", None)
        if pose is not None and np.isfinite(pose.centre).all():
            found[name] = np.asarray(pose.centre)
    return found


def _pixels(data: Dataset) -> Any:
    """A panel for each camera: where it saw the points."""
    go = graph_objects()
    traces, buttons = list[Any](), list[dict[str, Any]]()
    for k, camera in enumerate(data.cameras):
        uv = data.observations.uv[:, k]
        seen = np.isfinite(uv[:, 0])
        traces.append(
            go.Scatter(
                x=uv[seen, 0], y=uv[seen, 1], mode="markers", name=plain(camera.name), visible=k == 0,
                marker={"size": 6, "color": VERMILLION}, text=[plain(name) for name in data.points[seen]],
                hovertemplate="%{text}<br>u %{x:.2f}, v %{y:.2f}<extra></extra>",
            )
        )  # fmt: skip
        width, height = camera.width, camera.height
        axes: dict[str, list[float]] = {}
        if width is not None and height is not None:
            axes = {"xaxis.range": [-0.5, width - 0.5], "yaxis.range": [height - 0.5, -0.5]}
        shown = [i == k for i in range(len(data.cameras))]
        buttons.append({"label": plain(camera.name), "method": "update", "args": [{"visible": shown}, axes]})
    figure = go.Figure(traces, layout())
    first = buttons[0]["args"][1]
    look = {"color": INK, "zeroline": False, "showline": True, "mirror": True, "constrain": "domain"}
    figure.update_xaxes(title="u (px)", range=first.get("xaxis.range"), **look)
    upright = {"range": first["yaxis.range"]} if first else {"autorange": "reversed"}
    figure.update_yaxes(title="v (px)", scaleanchor="x", **upright, **look)
    menu = {"type": "dropdown", "buttons": buttons, "x": 0, "xanchor": "left", "y": 1.02, "yanchor": "bottom"}
    return figure.update_layout(updatemenus=[menu], margin={"l": 60, "r": 10, "t": 44, "b": 50})
