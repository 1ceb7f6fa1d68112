"""A placement of cameras: the rig and the uncertainty in 3D, and slices through the uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from implicam.dataset import Floats
from implicam.figures.calibration_plots import TOOLBAR_PX
from implicam.figures.panels3d import line_segments
from implicam.figures.style import BLUE, GREY, INK, VERMILLION, axis, figure_3d, graph_objects, layout, plain, points_3d
from implicam.formatting import number

COLOUR_SCALE = "Cividis"
"""Of the uncertainty: dark is certain."""
SLICE_AXES = ((0, 1, 2), (0, 2, 1), (1, 2, 0))
"""Of each slice: across, up, and the axis that it is square to."""
EYE_DISTANCE = 2.4
"""From where the scene is seen, in its own size, so that all of it fits into half a page."""
SCENE_WIDTH = 0.86
"""Of the 3D view, as a part of the figure; the rest is the colour bar's."""
SLICE_GAP = 0.09
"""Between slices, as a part of the width."""


@dataclass(frozen=True)
class UncertaintyScale:
    """What colours mean.

    Attributes:
        low, high: Ends of the scale; what is beyond has the colour of the end.
        unit: Of length.
    """

    low: float
    high: float
    unit: str

    def bar(self, **more: Any) -> dict[str, Any]:
        """Plotly's colour bar.

        Args:
            **more: Of Plotly's options, which win over those here.

        Returns:
            The options of a colour bar.
        """
        title = {"text": f"95 % uncertainty<br>({plain(self.unit)})", "side": "top"}
        quiet = {"thickness": 14, "outlinewidth": 0, "ticks": "outside", "tickformat": ".3~g"}
        return {"title": title, **quiet, **more}


def placement_scene(
    places: Floats,
    u95: Floats,
    *,
    cameras: Mapping[str, Floats],
    known_xyz: Floats,
    corners: Floats,
    up: ArrayLike,
    scale: UncertaintyScale,
) -> Any:
    """A Plotly figure of cameras, workspace and uncertainty.

    Args:
        places: (n, 3) all over the workspace.
        u95: (n,) 95 % uncertainty there, NaN where nothing is measured.
        cameras: Name -> (5, 3) the centre of a camera and the corners of its picture at some distance.
        known_xyz: (N, 3) the known points.
        corners: (8, 3) of the workspace, in the order of `itertools.product` of its ends.
        up: (3,) which way is up.
        scale: What colours mean.

    Returns:
        The figure.
    """
    edges = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]
    box = line_segments(corners[[a for a, _ in edges]], corners[[b for _, b in edges]])
    sides = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
    pyramids = np.concatenate(
        [line_segments(c[[a for a, _ in sides]], c[[b for _, b in sides]]) for c in cameras.values()]
    )
    centres = np.array([each[0] for each in cameras.values()])
    measured = np.isfinite(u95)
    marker = {
        "size": 4.5, "color": u95[measured], "colorscale": COLOUR_SCALE, "cmin": scale.low, "cmax": scale.high,
        "colorbar": scale.bar(len=0.7, x=SCENE_WIDTH), "opacity": 0.85,
    }  # fmt: skip
    texts = [f"95 % uncertainty {number(u)} {plain(scale.unit)}" for u in u95[measured]]
    traces = [
        points_3d(box, "workspace", mode="lines", line={"color": GREY, "width": 2}, hoverinfo="skip"),
        points_3d(pyramids, "views", mode="lines", line={"color": INK, "width": 2}, hoverinfo="skip", showlegend=False),
        points_3d(
            centres,
            f"cameras ({len(cameras)})",
            mode="markers+text" if len(cameras) <= 16 else "markers",
            text=[plain(name) for name in cameras],
            marker={"symbol": "square", "size": 5, "color": BLUE},
            hovertemplate="camera %{text}<extra></extra>",
        ),
        points_3d(places[measured], "places", marker=marker, text=texts, hovertemplate="%{text}<extra></extra>"),
        points_3d(
            known_xyz,
            f"known points ({len(known_xyz)})",
            marker={"symbol": "cross", "size": 3, "color": VERMILLION},
            hoverinfo="skip",
        ),
    ]
    if not measured.all():
        blind = {"symbol": "x", "size": 3, "color": GREY}
        traces.append(points_3d(places[~measured], "blind", marker=blind, hoverinfo="skip"))
    extent = np.ptp(np.concatenate([pyramids[np.isfinite(pyramids[:, 0])], corners]), axis=0)
    length = float(extent.max() / np.cbrt(np.prod(extent)))
    return figure_3d(
        traces,
        scale.unit,
        _view(np.asarray(up, dtype=np.float64), length),
        legend={"x": 0, "y": 1},
        scene={"domain": {"x": [0, SCENE_WIDTH]}},
    )


def _view(up: Floats, length: float) -> dict[str, Any]:
    """From the side and above, as Plotly says it; length: of the scene, over the geometric mean of its sides."""
    beside = np.eye(3)[np.argmin(np.abs(up))]
    beside = beside - (beside @ up) * up
    beside /= np.linalg.norm(beside)
    eye = EYE_DISTANCE * length * (0.7 * beside + 0.6 * np.cross(up, beside) + 0.4 * up)

    def words(vector: Floats) -> dict[str, float]:
        return dict(zip("xyz", map(float, np.round(vector, 4)), strict=True))

    return {"eye": words(eye), "up": words(up)}


def uncertainty_slices(
    ends: tuple[Floats, Floats, Floats],
    planes: tuple[Floats, Floats, Floats],
    middle: Floats,
    up: ArrayLike,
    scale: UncertaintyScale,
) -> Any:
    """A Plotly figure of three slices through the workspace.

    Args:
        ends: (k,) coordinates along x, y and z.
        planes: Uncertainty (k, k) in each of the slices `SLICE_AXES`, rows along the axis that goes up; NaN for none.
        middle: (3,) where the slices meet.
        up: (3,) which way is up.
        scale: What colours mean.

    Returns:
        The figure.
    """
    go = graph_objects()
    figure = go.Figure(layout=layout(margin={"l": 62, "r": 100, "t": TOOLBAR_PX + 28, "b": 52}))
    width = (1 - 2 * SLICE_GAP) / 3
    for k, ((across, upward, fixed), values) in enumerate(zip(SLICE_AXES, planes, strict=True)):
        suffix = "" if k == 0 else str(k + 1)
        heat = go.Heatmap(
            x=ends[across], y=ends[upward], z=values, zmin=scale.low, zmax=scale.high, colorscale=COLOUR_SCALE,
            xaxis=f"x{suffix}", yaxis=f"y{suffix}", showscale=k == 0, colorbar=scale.bar(len=1.0, x=1.02),
            hovertemplate=f"{'xyz'[across]} %{{x:.4~g}}, {'xyz'[upward]} %{{y:.4~g}}: %{{z:.3~g}}<extra></extra>",
        )  # fmt: skip
        figure.add_trace(heat)
        left = k * (width + SLICE_GAP)
        figure.update_layout(
            {
                f"xaxis{suffix}": axis(
                    f"{'xyz'[across]} ({scale.unit})",
                    domain=[left, min(left + width, 1.0)],
                    anchor=f"y{suffix}",
                    constrain="domain",
                ),
                f"yaxis{suffix}": axis(
                    f"{'xyz'[upward]} ({scale.unit})",
                    anchor=f"x{suffix}",
                    scaleanchor=f"x{suffix}",
                    constrain="domain",
                    autorange="reversed" if np.asarray(up)[upward] < 0 else True,
                ),
            }
        )
        figure.add_annotation(
            text=f"{'xyz'[fixed]} = {number(float(middle[fixed]))} {plain(scale.unit)}", showarrow=False,
            xref="paper", yref="paper", x=left + width / 2, y=1.0, yanchor="bottom", xanchor="center",
        )  # fmt: skip
    return figure
