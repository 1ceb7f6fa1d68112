"""The 3D scene: where the points are, how far off each is, and how sure it was."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from implicam.dataset import Floats, Names
from implicam.figures.style import GREY, INK, SKY, VERMILLION, figure_3d, plain, points_3d
from implicam.formatting import number

_FACTORS = (1, 10, 100, 1000, 10_000)
# A line is seen from about a fiftieth of the scene; then neighbours do not yet tangle.
_VISIBLE_SHARE = 0.02
_SMALLEST_PX, _LARGEST_PX = 5.0, 13.0
_VIEW = {"eye": {"x": 1.36, "y": 1.36, "z": 0.73}, "center": {"x": 0, "y": 0, "z": -0.16}}


def scene(
    measured_xyz: Floats,
    sd: Floats,
    *,
    names: Names | Sequence[str],
    views: ArrayLike,
    unit: str,
    known_xyz: Floats | None = None,
    true_xyz: Floats | None = None,
    error: Floats | None = None,
    cameras: Mapping[str, ArrayLike] | None = None,
) -> Any:
    """An interactive Plotly figure of n measured points.

    measured_xyz and sd: (n, 3) in `unit`, NaN where not measured (not drawn). error: (n,) distance from the truth, the
    colour; without it the colour is the stated uncertainty. Size grows with the stated uncertainty. true_xyz: (n, 3)
    draws a line from each measured point towards its truth, exaggerated by the factor on the buttons. known_xyz: (m, 3)
    the points the rig was calibrated from. cameras: name -> (3,) centre, hidden until clicked in the legend.
    """
    i = np.isfinite(measured_xyz).all(axis=1)
    spread = np.linalg.norm(sd[i], axis=1)
    texts = _hover(np.asarray(names)[i], np.asarray(views)[i], sd[i], None if error is None else error[i], unit)
    traces = [] if known_xyz is None else [_known(known_xyz)]
    traces.append(_measured(measured_xyz[i], spread, None if error is None else error[i], texts, unit))
    lines, menus = [], []
    if true_xyz is not None and i.any():
        chosen = _factor(measured_xyz[i], true_xyz[i])
        factors = [factor for factor in _FACTORS if factor <= 10 * chosen]
        lines = [_lines(measured_xyz[i], true_xyz[i], factor, factor == chosen) for factor in factors]
        menus = [_buttons(len(traces), factors, chosen)]
    traces += lines
    if cameras:
        traces.append(_cameras(cameras))
    return figure_3d(traces, unit, _VIEW, updatemenus=menus, legend={"x": 0, "y": 1})


def _known(xyz: Floats) -> Any:
    return points_3d(
        xyz,
        f"known points ({len(xyz)})",
        marker={"symbol": "cross", "size": 4, "color": SKY},
        hovertemplate="known point<br>(%{x:.4~g}, %{y:.4~g}, %{z:.4~g})<extra></extra>",
    )


def _measured(xyz: Floats, spread: Floats, error: Floats | None, texts: list[str], unit: str) -> Any:
    value, what = (spread, "stated uncertainty") if error is None else (error, "error")
    # The top of the scale is a high quantile, so that one blunder does not paint all others alike.
    top = float(np.nanquantile(value, 0.98)) if np.isfinite(value).any() else 1.0
    bar = {
        "title": {"text": f"{what}<br>({plain(unit)})", "side": "top"},
        "thickness": 14, "len": 0.75, "outlinewidth": 0, "ticks": "outside", "tickformat": ".3~g", "x": 0.9,
    }  # fmt: skip
    marker = {
        "size": _sizes(spread), "color": value, "colorscale": "Cividis", "cmin": 0.0, "cmax": top or 1.0,
        "colorbar": bar, "line": {"width": 0.5, "color": GREY}, "opacity": 1.0,
    }  # fmt: skip
    name = f"measured points ({len(xyz)})"
    return points_3d(xyz, name, marker=marker, text=texts, hovertemplate="%{text}<extra></extra>")


def _lines(start: Floats, true: Floats, factor: int, visible: bool) -> Any:
    path = np.full((len(start), 3, 3), np.nan)  # the third vertex stays NaN and breaks the line
    path[:, 0], path[:, 1] = start, start + factor * (true - start)
    return points_3d(
        path.reshape(-1, 3),
        f"towards the truth, ×{factor}",
        mode="lines",
        line={"color": VERMILLION, "width": 2.5},
        hoverinfo="skip",
        visible=visible,
    )


def _cameras(cameras: Mapping[str, ArrayLike]) -> Any:
    return points_3d(
        np.array([np.asarray(c, dtype=np.float64) for c in cameras.values()]),
        "cameras (click to show)",
        mode="markers+text",
        visible="legendonly",  # they stand far off and would shrink everything else
        marker={"symbol": "diamond", "size": 6, "color": GREY},
        text=[plain(name) for name in cameras],
        hovertemplate="camera %{text}<extra></extra>",
    )


def _buttons(first: int, factors: list[int], chosen: int) -> dict[str, Any]:
    which = list(range(first, first + len(factors)))

    def button(label: str, shown: int) -> dict[str, Any]:
        return {"label": label, "method": "restyle", "args": [{"visible": [f == shown for f in factors]}, which]}

    return {
        "type": "buttons", "direction": "right", "x": 0, "xanchor": "left", "y": 1.0, "yanchor": "bottom",
        "pad": {"b": 6}, "active": factors.index(chosen), "showactive": True,
        # Fixed colours: Plotly lights the active button near-white in every theme.
        "font": {"color": INK, "size": 12}, "bgcolor": "#d5dee8", "bordercolor": GREY,
        "buttons": [button(f"errors ×{f:,}", f) for f in factors] + [button("no errors", 0)],
    }  # fmt: skip


def _factor(start: Floats, true: Floats) -> int:
    """The smallest exaggeration at which the median line can be seen."""
    size = float(np.linalg.norm(np.ptp(start, axis=0)))
    typical = float(np.nanmedian(np.linalg.norm(true - start, axis=1), axis=0)) if np.isfinite(true).any() else 0.0
    return next((f for f in _FACTORS if f * typical >= _VISIBLE_SHARE * size), _FACTORS[-1] if typical else 1)


def _hover(names: Any, views: Any, sd: Floats, error: Floats | None, unit: str) -> list[str]:
    texts = []
    for k, name in enumerate(names):
        off = "" if error is None or not np.isfinite(error[k]) else f"error {number(error[k])} {plain(unit)}<br>"
        x, y, z = (number(float(s)) for s in sd[k])
        texts.append(
            f"<b>{plain(name)}</b><br>{off}sd x {x}, y {y}, z {z} {plain(unit)}<br>from {_views(int(views[k]))}"
        )
    return texts


def _views(count: int) -> str:
    return f"{count} view" + "s" * (count != 1)


def _sizes(spread: Floats) -> Floats:
    finite = spread[np.isfinite(spread)]
    if not len(finite) or np.ptp(finite) <= 1e-9 * finite.max():
        return np.full(spread.shape, (_SMALLEST_PX + _LARGEST_PX) / 3)
    low, high = np.quantile(finite, [0.02, 0.98])
    share = np.clip((spread - low) / max(high - low, 1e-300), 0, 1)
    return np.asarray(_SMALLEST_PX + (_LARGEST_PX - _SMALLEST_PX) * np.nan_to_num(share), dtype=np.float64)
