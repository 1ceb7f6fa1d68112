"""The page: one HTML file that works offline, with everything inside it and every name escaped."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from implicam import figures
from implicam.coverage import Summary
from implicam.figures.interactive3d import POLICY, figure_json, plotly_js
from implicam.files import write_text
from implicam.formatting import number
from implicam.report import words
from implicam.report.data import ReportData
from implicam.templates import Markup, render


def write_report(path: str | Path, data: ReportData) -> None:
    """Write the report as one self-contained HTML file (about 5 MB, nearly all of it plotly.js).

    The same data give the same bytes, as long as the versions are the same.

    Args:
        path: The file; one that is there is replaced.
        data: What the report is about.

    Raises:
        MissingExtraError: Plotly or Jinja2 is not installed.
        ImplicamError: The file cannot be written.
    """
    write_text(Path(path), page(data))


def page(data: ReportData) -> str:
    """The report as HTML text.

    Args:
        data: What the report is about.

    Raises:
        MissingExtraError: Plotly or Jinja2 is not installed.
    """
    return render(
        __package__,
        "page.html",
        data=data,
        words=words,
        policy=POLICY,
        plotly_js=plotly_js("the HTML report"),
        plots=_draw_plots(data),
        regions=[] if data.coverage is None else [_region_row(row) for row in data.coverage.rows],
        versions=_versions(),
    )


def _draw_plots(data: ReportData) -> dict[str, Markup | None]:
    """The figures as JSON, by name; None for those that the data do not have."""
    m = data.measurement
    scene = figures.scene(
        m.xyz, data.sd, names=m.points, views=m.views, unit=data.unit, known_xyz=data.known_xyz, true_xyz=data.true_xyz,
        error=data.error, cameras=data.cameras, share_calibration=m.share_calibration,
    )  # fmt: skip
    plots: dict[str, Markup | None] = {"scene": figure_json(scene), "reliability": None, "error": None}
    if data.coverage is not None and data.coverage.overall.n:
        plots["reliability"] = figure_json(figures.reliability(data.coverage))
        if data.error is not None:
            against = figures.error_against_sd(data.error, data.spread, names=m.points, unit=data.unit)
            plots["error"] = figure_json(against)
    return plots


def _region_row(row: Summary) -> list[str]:
    return [
        row.region if row.group == "all" else f"{row.group}: {row.region}",
        f"{row.n:,}",
        number(row.rmse),
        number(row.p95_error),
        number(row.stated_rms),
        words.per_cent(row.level(0.95).ellipsoid),
        words.interval(row.nees),
        number(row.crps),
        number(row.nll),
        row.verdict,
    ]


def _versions() -> Iterator[str]:
    for name in ("implicam", "numpy", "scipy", "plotly"):
        try:
            yield f"{name} {version(name)}"
        except PackageNotFoundError:  # run from a source tree that is not installed
            yield name
    yield f"Python {platform.python_version()}"
