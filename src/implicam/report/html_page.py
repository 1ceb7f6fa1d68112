"""The page: one HTML file that works offline, with everything inside it and every name escaped."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Sequence
from html import escape
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from implicam import figures
from implicam.coverage import Summary
from implicam.errors import import_extra
from implicam.figures.interactive3d import POLICY
from implicam.files import write_text
from implicam.formatting import number
from implicam.report import words
from implicam.report.data import ReportData
from implicam.report.look import SCRIPT, STYLE

_LONG = 15


def write_report(path: str | Path, data: ReportData) -> None:
    """Write the report as one self-contained HTML file (about 5 MB, nearly all of it plotly.js).

    The same data give the same bytes, as long as the versions are the same. Raises MissingExtraError without plotly.
    """
    write_text(Path(path), page(data))


def page(data: ReportData) -> str:
    """The report as HTML text."""
    plotly = import_extra("plotly.offline", "report", "the HTML report")
    body = "\n".join(
        [_head(data), _result(data), _scene(data), _honesty(data), _regions(data), _left_out(data), _method(data)]
    )
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{escape(data.title)}</title>\n'
        f"<style>{STYLE}</style>\n<script>{plotly.get_plotlyjs()}</script>\n</head>\n<body>\n<main>\n{body}\n</main>\n"
        f"<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )


def _head(data: ReportData) -> str:
    facts = "".join(f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in data.facts)
    subtitle = f'<p class="subtitle">{escape(data.subtitle)}</p>' if data.subtitle else ""
    return (
        f'<header>\n<p class="kind">Measurement report</p>\n<h1>{escape(data.title)}</h1>\n{subtitle}'
        f"{f'<dl class=facts>{facts}</dl>' if facts else ''}\n</header>"
    )


def _result(data: ReportData) -> str:
    title, why, tone = words.verdict(data)
    tiles = "".join(
        f'<div class="tile"><dt>{escape(label)}</dt><dd class="value">{escape(value)}</dd><dd>{escape(note)}</dd></div>'
        for label, value, note in words.tiles(data)
    )
    return (
        f'<section id="result">\n<p class="headline">{escape(words.headline(data))}</p>\n'
        f'<div class="verdict {tone}"><strong>{escape(title)}</strong> {escape(why)}</div>\n'
        f'<dl class="tiles">{tiles}</dl>\n</section>'
    )


def _scene(data: ReportData) -> str:
    m = data.measurement
    figure = figures.scene(
        m.xyz, data.sd, names=m.points, views=m.views, unit=data.unit, known_xyz=data.known_xyz, true_xyz=data.true_xyz,
        error=data.error, cameras=data.cameras,
    )  # fmt: skip
    colour = "stated uncertainty" if data.error is None else "error"
    lines = "" if data.true_xyz is None else " Lines run towards the truth, exaggerated by the factor chosen above."
    caption = f"Colour: {colour}. Size: stated uncertainty.{lines} Drag to turn, scroll to zoom, hover for a point."
    return f'<section id="scene">\n<h2>Where</h2>\n{_plot("scene", figure, caption)}\n</section>'


def _honesty(data: ReportData) -> str:
    if data.coverage is None or data.coverage.overall.n == 0:
        return ""
    plots = [
        _plot(
            "reliability",
            figures.reliability(data.coverage),
            "For each stated probability, the share of points whose truth was inside. On the dashed line the error "
            "bars are right; above it too large, below it too small. Bars: 95 % intervals.",
        )
    ]
    if data.error is not None:
        figure = figures.error_against_sd(data.error, data.spread, names=data.measurement.points, unit=data.unit)
        caption = (
            "Each point's error against the uncertainty stated for it. Lines: 1, 2 and 3 times the stated; hardly a "
            "point should be above 3×. A cloud rising to the right: the instrument knows its worse points."
        )
        plots.append(_plot("error-sd", figure, caption))
    pair = f'<div class="pair">{"".join(plots)}</div>'
    return f'<section id="honesty">\n<h2>Do the error bars tell the truth?</h2>\n{pair}\n</section>'


def _regions(data: ReportData) -> str:
    if data.coverage is None:
        return ""
    unit = data.unit
    head = [
        "region", "points", f"rms error ({unit})", f"95 % within ({unit})", f"stated rms ({unit})", "in 95 % ellipsoid",
        "NEES (right: 3)", f"CRPS ({unit})", "NLL (nats)", "error bars",
    ]  # fmt: skip
    rows = [_region(row) for row in data.coverage.rows]
    return f'<section id="regions">\n<h2>By region</h2>\n{_table(head, rows, "numbers")}\n</section>'


def _region(row: Summary) -> list[str]:
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


def _left_out(data: ReportData) -> str:
    points = data.unmeasured
    judged = () if data.coverage is None else data.coverage.reasons
    unjudged = [(str(data.measurement.points[i]), reason) for i, reason in judged]
    text = "Every point was measured." if not points else ""
    listed = "".join(
        [
            _reasons("Not measured", points),
            _reasons("Measured without a view that contradicts the others", data.without_a_view),
            _reasons("Measured, but the covariance could not be judged", unjudged),
        ]
    )
    return f'<section id="left-out">\n<h2>What was left out</h2>\n<p>{text}</p>{listed}\n</section>'


def _reasons(title: str, points: Sequence[tuple[str, str]]) -> str:
    if not points:
        return ""
    table = _table(["point", "reason"], points, "text")
    label = f"{escape(title)}: {len(points):,}"
    return f"<details{'' if len(points) > _LONG else ' open'}><summary>{label}</summary>{table}</details>"


def _method(data: ReportData) -> str:
    notes = "".join(f"<li>{escape(note)}</li>" for note in data.notes)
    terms = "".join(f"<div><dt>{escape(term)}</dt><dd>{escape(text)}</dd></div>" for term, text in _TERMS)
    return (
        f'<section id="method">\n<h2>How it was computed</h2>\n<ul>{notes}</ul>\n'
        f'<dl class="terms">{terms}</dl>\n</section>\n'
        f'<footer id="versions">{escape(" · ".join(_versions()))}</footer>'
    )


_TERMS = (
    ("error", "distance between the measured and the true position."),
    ("rms", "root of the mean square over points; in 3D over the distances, so about √3 times that of one axis."),
    ("stated uncertainty", "one standard deviation from the covariance of the position; in 3D the root of its trace."),
    (
        "95 % ellipsoid",
        "the region around a measured position that, by its covariance, holds the truth 95 times in 100; the χ² limit "
        "for three dimensions.",
    ),
    (
        "brackets",
        "a 95 % interval. Shares: Wilson, with an effective number of points that allows for errors shared by the axes "
        "of a point and by the points of a shot. NEES: cluster-robust, on a log scale.",
    ),
    ("NEES", "normalised squared error, eᵀC⁻¹e, averaged; 3 if the covariance is right, larger if it is too small."),
    ("CRPS", "continuous ranked probability score, mean over axes: small for small errors with honest error bars."),
    ("NLL", "negative log density of the truth under the stated Gaussian; smaller is better, but only in one unit."),
)  # fmt: skip


def _versions() -> Iterable[str]:
    for name in ("implicam", "numpy", "scipy", "plotly"):
        try:
            yield f"{name} {version(name)}"
        except PackageNotFoundError:  # run from a source tree that is not installed
            yield name
    yield f"Python {platform.python_version()}"


def _plot(name: str, figure: Any, caption: str) -> str:
    # Inside a script element only "<" can end it; in JSON it stands in strings only, where \u003c is the same.
    content = figure.to_json().replace("<", "\\u003c")
    return (
        f'<figure><div class="plot" id="plot-{name}" role="img" aria-label="{escape(caption)}"></div>'
        f'<script type="application/json" id="data-{name}">{content}</script>'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str) -> str:
    top = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="wide"><table class="{kind}"><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'
