"""The 3D scene: where the points are, how far off each is, and how certain it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from implicam.dataset import Floats, Names
from implicam.figures.style import GREY, INK, SKY, VERMILLION, figure_3d, plain, points_3d
from implicam.formatting import number, percent

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
    share_calibration: Floats | None = None,
) -> Any:
    """An interactive figure of n measured points.

    Size grows with the stated uncertainty. Colour is the error, or without it the stated uncertainty.

    Args:
        measured_xyz: (n, 3) in `unit`, NaN where not measured (not drawn).
        sd: (n, 3) standard uncertainties in `unit`.
        names: (n,) of the points.
        views: (n,) how many views each was measured with.
        unit: Of length.
        known_xyz: (m, 3) the points that the rig was calibrated from.
        true_xyz: (n, 3) draws a line from each measured point towards its truth, exaggerated by the factor on the
            buttons.
        error: (n,) distance from the truth.
        cameras: Name -> (3,) centre; hidden until clicked in the legend.
        share_calibration: (n,) the share of each variance that more known points could remove, another colour to
            choose.

    Returns:
        A Plotly figure.

    Raises:
        MissingExtraError: Plotly is not installed.
    """
    i = np.isfinite(measured_xyz).all(axis=1)
    spread = np.linalg.norm(sd[i], axis=1)
    off = None if error is None else error[i]
    share = None if share_calibration is None or not np.isfinite(share_calibration[i]).any() else share_calibration[i]
    texts = _hover(np.asarray(names)[i], np.asarray(views)[i], sd[i], off, share, unit)
    traces = [] if known_xyz is None else [_known(known_xyz)]
    colours = _colours(spread, off, share, unit)
    traces.append(_measured(measured_xyz[i], spread, colours[0], texts))
    lines, menus = [], []
    if true_xyz is not None and i.any():
        chosen = _factor(measured_xyz[i], true_xyz[i])
        factors = [factor for factor in _FACTORS if factor <= 10 * chosen]
        lines = [_lines(measured_xyz[i], true_xyz[i], factor, factor == chosen) for factor in factors]
        menus = [_buttons(len(traces), factors, chosen)]
    if len(colours) > 1:
        menus.append(_colour_menu(len(traces) - 1, colours))
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


class _Colour(NamedTuple):
    """What the points may be coloured by: its name, its title at the scale, values (n,), and the top of the scale."""

    name: str
    title: str
    values: Floats
    top: float


def _colours(spread: Floats, error: Floats | None, share: Floats | None, unit: str) -> list[_Colour]:
    """What there is to choose from, the usual one first."""
    lengths = [("stated uncertainty", spread)] if error is None else [("error", error), ("stated uncertainty", spread)]
    found = [_Colour(name, f"{name}<br>({plain(unit)})", values, _scale_top(values)) for name, values in lengths]
    if share is not None:
        title = "share from lack of<br>known points (%)"
        found.append(_Colour("lack of known points", title, 100 * share, _scale_top(100 * share)))
    return found


def _scale_top(values: Floats) -> float:
    """A high quantile, so that one blunder does not paint all others alike."""
    top = float(np.nanquantile(values, 0.98)) if np.isfinite(values).any() else 1.0
    return top or 1.0


def _measured(xyz: Floats, spread: Floats, colour: _Colour, texts: list[str]) -> Any:
    bar = {
        "title": {"text": colour.title, "side": "top"},
        "thickness": 14, "len": 0.75, "outlinewidth": 0, "ticks": "outside", "tickformat": ".3~g", "x": 0.9,
    }  # fmt: skip
    marker = {
        "size": _sizes(spread), "color": colour.values, "colorscale": "Cividis", "cmin": 0.0, "cmax": colour.top,
        "colorbar": bar, "line": {"width": 0.5, "color": GREY}, "opacity": 1.0,
    }  # fmt: skip
    name = f"measured points ({len(xyz)})"
    return points_3d(xyz, name, marker=marker, text=texts, hovertemplate="%{text}<extra></extra>")


def _colour_menu(trace: int, colours: list[_Colour]) -> dict[str, Any]:
    """A list to choose the colour of the measured points from."""

    def entry(colour: _Colour) -> dict[str, Any]:
        look = {
            "marker.color": [colour.values.tolist()],
            "marker.cmax": [colour.top],
            "marker.colorbar.title.text": [colour.title],
        }
        return {"label": f"colour: {colour.name}", "method": "restyle", "args": [look, [trace]]}

    return {
        "type": "dropdown", "direction": "up", "x": 0, "xanchor": "left", "y": 0, "yanchor": "bottom",
        "font": {"color": INK, "size": 12}, "bgcolor": "#d5dee8", "bordercolor": GREY,
        "buttons": [entry(colour) for colour in colours],
    }  # fmt: skip


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


def _hover(names: Any, views: Any, sd: Floats, error: Floats | None, share: Floats | None, unit: str) -> list[str]:
    texts = []
    for k, name in enumerate(names):
        off = "" if error is None or not np.isfinite(error[k]) else f"error {number(error[k])} {plain(unit)}<br>"
        x, y, z = (number(float(s)) for s in sd[k])
        lack = (
            "" if share is None or not np.isfinite(share[k]) else f"<br>{percent(share[k])} from lack of known points"
        )
        sds = f"sd x {x}, y {y}, z {z} {plain(unit)}{lack}"
        texts.append(f"<b>{plain(name)}</b><br>{off}{sds}<br>from {_views(int(views[k]))}")
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
