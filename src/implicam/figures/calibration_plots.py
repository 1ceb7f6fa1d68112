"""Do the error bars tell the truth? Two figures, each with the line on which right error bars lie."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from implicam.coverage import Coverage, Estimate
from implicam.dataset import Floats, Names
from implicam.figures.style import BLUE, CLEAR, GREY, VERMILLION, axis, graph_objects, layout, plain
from implicam.formatting import number

TOOLBAR_PX = 36
"""Height of plotly's toolbar, which otherwise lies on the legend and on the names of the lines."""


def reliability(coverage: Coverage) -> Any:
    """Observed against nominal coverage in per cent, with 95 % intervals: the 3D ellipsoid, and all axes together.

    Args:
        coverage: Its overall row is drawn.

    Returns:
        A Plotly figure.

    Raises:
        MissingExtraError: Plotly is not installed.
    """
    go = graph_objects()
    levels = coverage.overall.levels
    nominal = [100 * level.nominal for level in levels]
    series = [
        _series(go, nominal, [level.ellipsoid for level in levels], "3D ellipsoid", BLUE, "circle", -0.45),
        _series(go, nominal, [level.pooled for level in levels], "x, y, z each", VERMILLION, "square", 0.45),
    ]
    honest = go.Scatter(
        x=[0, 100], y=[0, 100], mode="lines", name="honest", line={"color": GREY, "dash": "dash", "width": 1.5},
        hoverinfo="skip",
    )  # fmt: skip
    lows = [100 * e.low for level in levels for e in (level.ellipsoid, level.pooled)]
    bottom = min(45.0, float(np.nan_to_num(lows, nan=100.0).min()) - 3)
    figure = go.Figure([honest, *series], layout())
    figure.update_layout(
        xaxis=axis(
            "stated: so many % of points should be inside",
            range=[45, 102],
            tickvals=nominal,
            ticktext=_per_cent(nominal),
        ),
        yaxis=axis("observed: so many % were", range=[max(-2.0, bottom), 102]),
        legend={"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom", "bgcolor": CLEAR},
        margin={"t": TOOLBAR_PX + 30},
    )
    _remark(figure, "error bars too large", 0.03, 0.97, "left")
    _remark(figure, "error bars too small", 0.97, 0.03, "right")
    return figure


def error_against_sd(error: Floats, spread: Floats, *, names: Names | Sequence[str], unit: str) -> Any:
    """Each point's error against its stated uncertainty, both distances in 3D, on log axes.

    Lines: error = 1, 2, 3 times the stated uncertainty. With right error bars, more than half of the points lie below
        the
    first, hardly any above the third.

    Args:
        error: (n,) in `unit`; points whose error is not a positive number are not drawn.
        spread: (n,) sqrt(trace of the covariance), in `unit`.
        names: (n,) of the points.
        unit: Of length.

    Returns:
        A Plotly figure.

    Raises:
        MissingExtraError: Plotly is not installed.
    """
    go = graph_objects()
    i = np.isfinite(error) & np.isfinite(spread) & (error > 0) & (spread > 0)
    x, y = spread[i], error[i]
    texts = [
        f"<b>{plain(name)}</b><br>error {number(e)} {plain(unit)}<br>stated {number(s)} {plain(unit)}"
        for name, e, s in zip(np.asarray(names)[i], y, x, strict=True)
    ]
    cloud = go.Scatter(
        x=x, y=y, mode="markers", name="points", text=texts, hovertemplate="%{text}<extra></extra>",
        marker={"color": BLUE, "size": 6, "opacity": 0.6},
    )  # fmt: skip
    figure = go.Figure([cloud], layout(showlegend=False))
    figure.update_layout(
        margin={"t": TOOLBAR_PX},
        xaxis=axis(f"stated uncertainty ({unit})", type="log", **_ticks(x)),
        yaxis=axis(f"error ({unit})", type="log", **_ticks(y)),
    )
    if len(x):
        _guides(go, figure, np.array([x.min() / 1.1, x.max() * 1.1]))
    return figure


def _series(
    go: Any, nominal: Sequence[float], found: Sequence[Estimate], name: str, colour: str, symbol: str, shift: float
) -> Any:
    value, low, high = (100 * np.array([getattr(e, key) for e in found]) for key in ("value", "low", "high"))
    return go.Scatter(
        x=np.array(nominal) + shift,  # side by side, not on top of each other
        y=value,
        mode="markers",
        name=name,
        marker={"color": colour, "symbol": symbol, "size": 9},
        error_y={"type": "data", "array": high - value, "arrayminus": value - low, "thickness": 1.8, "width": 4},
        text=[
            f"{p:g} % stated: {v:.1f} % ({a:.1f}–{b:.1f})" for p, v, a, b in zip(nominal, value, low, high, strict=True)
        ],
        hovertemplate=f"{name}<br>%{{text}}<extra></extra>",
    )


def _guides(go: Any, figure: Any, ends: Floats) -> None:
    for k, dash in ((1, "solid"), (2, "dash"), (3, "dot")):
        line = {"color": GREY, "dash": dash, "width": 1.5}
        figure.add_trace(go.Scatter(x=ends, y=k * ends, mode="lines", line=line, hoverinfo="skip"))
        figure.add_annotation(
            x=np.log10(ends[1]),
            y=np.log10(k * ends[1]),
            text=f"{k}×",
            showarrow=False,
            xanchor="left",
            font={"color": GREY},
        )


def _ticks(values: Floats) -> dict[str, Any]:
    """1, 2, 5 per decade: Plotly's own leave a range of less than a decade almost bare."""
    if not len(values):
        return {}
    low, high = np.floor(np.log10(values.min())), np.ceil(np.log10(values.max()))
    steps = (1, 2, 5) if high - low <= 4 else (1,)
    ticks = [float(f"{step}e{int(decade)}") for decade in np.arange(low, high + 1) for step in steps]
    return {"tickvals": ticks, "ticktext": [f"{tick:g}" for tick in ticks]}


def _remark(figure: Any, text: str, x: float, y: float, anchor: str) -> None:
    place = {"x": x, "y": y, "xref": "paper", "yref": "paper", "xanchor": anchor, "showarrow": False}
    figure.add_annotation(text=text, font={"color": GREY}, **place)


def _per_cent(values: Sequence[float]) -> list[str]:
    return [f"{value:g}" for value in values]
