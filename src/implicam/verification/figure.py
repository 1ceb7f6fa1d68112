"""The figure of a result in a notebook: errors over lengths, their uncertainties, the limit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from implicam.figures.style import BLUE, GREY, VERMILLION, axis, graph_objects, layout, plain

if TYPE_CHECKING:
    from implicam.verification.result import Verification


def errors_over_lengths(found: Verification) -> Any:
    """Errors over calibrated lengths.

    Args:
        found: The result of a test.

    Returns:
        A Plotly figure.

    Raises:
        MissingExtraError: Plotly is not installed.
    """
    go, unit = graph_objects(), found.length_unit
    length = np.array([one.length.length for one in found.measured])
    traces = [
        go.Scatter(
            x=length, y=[one.error for one in found.measured], mode="markers", name="error and U of the test",
            error_y={"array": [one.expanded_test for one in found.measured], "thickness": 1.4, "width": 3},
            marker={"size": 7, "color": BLUE}, text=[plain(one.length.title) for one in found.measured],
            hovertemplate="%{text}<br>error %{y:.4g}<extra></extra>",
        )
    ]  # fmt: skip
    if found.mpe is not None:
        ends = [0.0, 1.05 * float(length.max())]
        for sign in (1, -1):
            look = {"color": VERMILLION, "dash": "dash", "width": 2}
            name = f"MPE = {found.mpe}"
            traces.append(
                go.Scatter(
                    x=ends,
                    y=[sign * found.mpe.at(end) for end in ends],
                    mode="lines",
                    name=name,
                    line=look,
                    showlegend=sign > 0,
                )
            )
    axes = {"xaxis": axis(f"calibrated length ({unit})", rangemode="tozero"), "yaxis": axis(f"error ({unit})")}
    figure = go.Figure(traces, layout(**axes, legend={"orientation": "h", "y": 1.02, "yanchor": "bottom"}))
    return figure.add_hline(y=0, line={"color": GREY, "width": 1})
