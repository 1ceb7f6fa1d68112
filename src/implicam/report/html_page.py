"""The page: one HTML file that works offline, with everything inside it and every name escaped."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from implicam import figures
from implicam.coverage import Summary
from implicam.figures.instrument import camera_residuals, rig_scene, uncertainty_slices, uncertainty_volume
from implicam.figures.interactive3d import POLICY, figure_json, plotly_js
from implicam.files import write_text
from implicam.formatting import number, percent
from implicam.report import words
from implicam.report.data import ReportData
from implicam.report.instrument import CELLS, Instrument
from implicam.rig_model import SOURCES
from implicam.templates import Markup, render

MAX_DRAWN_CAMERAS, MAX_NAMED_VIEWS = 24, 12
"""Of a rig of many cameras so many are drawn; of a camera so many views that are not used are named."""


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
        pages=[] if data.instrument is None else _camera_pages(data.instrument),
        budget=[] if data.instrument is None else list(_budget_rows(data.instrument)),
        sources=SOURCES,
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
    if data.instrument is not None and len(data.instrument.regions):
        plots |= _draw_instrument(data.instrument)
    return plots


def _draw_instrument(instrument: Instrument) -> dict[str, Markup]:
    """The figures of the cameras themselves."""
    unit, known = instrument.unit, instrument.calibration.data.xyz
    variance = np.maximum(instrument.variance, 0)
    maps = {"standard uncertainty": instrument.sd}
    maps |= {
        f"from {name}": np.sqrt(part) for name, part in zip(SOURCES, variance.T, strict=True) if np.nanmax(part) > 0
    }
    drawn = {"rig": figure_json(rig_scene(known, instrument.frusta, unit))}
    if all(len(axis) > 1 for axis in instrument.axes):
        drawn["slices"] = figure_json(uncertainty_slices(instrument.axes, maps, unit))
        drawn["volume"] = figure_json(uncertainty_volume(instrument.places, instrument.sd, unit, known))
    return drawn


def _budget_rows(instrument: Instrument) -> Iterator[list[str]]:
    for region in instrument.regions:
        parts = [
            f"{number(float(p), 2)} ({percent(float(s))})" for p, s in zip(region.parts, region.shares, strict=True)
        ]
        yield [region.name, *parts, number(region.sd, 3), number(2 * region.sd, 3)]


def _camera_pages(instrument: Instrument) -> list[dict[str, Any]]:
    """What the page says of each camera, and its figure where there are not too many."""
    pages = []
    for number_, page in enumerate(instrument.cameras):
        lost = int((~page.used).sum())
        facts = [
            ("lens", page.lens), ("views of known points", f"{len(page.uv):,}"), ("of them not used", f"{lost:,}"),
            ("noise of a view", f"{number(page.noise, 2)} px"), ("rms residual per axis", f"{number(page.rms, 2)} px"),
            ("parts of the picture with known points", f"{round(page.covered * CELLS**2)} of {CELLS**2}"),
        ]  # fmt: skip
        figure = None
        if number_ < MAX_DRAWN_CAMERAS:
            figure = figure_json(camera_residuals(page.uv, page.residual, page.used, page.size, page.points.tolist()))
        worst = np.argsort(-np.linalg.norm(page.residual, axis=1) * ~page.used)[: min(lost, MAX_NAMED_VIEWS)]
        rejected = [(str(page.points[i]), f"{number(float(np.linalg.norm(page.residual[i])))} px") for i in worst]
        pages.append({"name": page.name, "facts": facts, "figure": figure, "rejected": rejected, "lost": lost})
    return pages


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
