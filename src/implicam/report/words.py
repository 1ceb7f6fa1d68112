"""The report in sentences: headline, verdict, key numbers. Plain text; the page escapes it."""

from __future__ import annotations

import math

import numpy as np

from implicam.coverage import Estimate, Summary
from implicam.dataset import Floats
from implicam.formatting import number, percent
from implicam.report.data import KnownLengths, ReportData

VERDICTS = {
    "right": ("The error bars tell the truth.", "good"),
    "too small": ("The error bars are too small.", "bad"),
    "too large": ("The error bars are too large.", "careful"),
    "cannot tell": ("Too few points to judge the error bars.", "unknown"),
}
"""Verdict in words, and the tone that colours it."""


def per_cent(share: Estimate) -> str:
    """A share with its interval in brackets: `94.1 % (91.2–96.3)`.

    Args:
        share: From 0 to 1, with its interval; a dash where it is not finite.
    """
    if not math.isfinite(share.value):
        return "–"
    return f"{percent(share.value, 1)} ({100 * share.low:.1f}–{100 * share.high:.1f})"


def interval(value: Estimate) -> str:
    """A value with its interval: `2.94 (2.71–3.19)`, without brackets where there is none.

    Args:
        value: In any unit.
    """
    if not math.isfinite(value.low):
        return number(value.value)
    return f"{number(value.value)} ({number(value.low)}–{number(value.high)})"


MAX_RIGHT_FACTOR, MAX_CAREFUL_FACTOR = 1.4, 2.0
"""Rms of distances over what the error bars say: so much is chance with a few boards; beyond
the second they are wrong."""


def headline(data: ReportData) -> str:
    """The result in one sentence.

    Args:
        data: What the report is about.
    """
    unit, n = data.unit, int(data.measurement.measured.sum())
    if n == 0:
        return "No point could be measured."
    if data.coverage is None or data.coverage.overall.n == 0:
        if data.lengths is not None:
            known = data.lengths
            return (
                f"Distances between {known.what} are off by {number(known.rms)} {unit} rms; 95 % intervals contained "
                f"the truth for {percent(known.inside)} of {len(known.errors):,}."
            )
        typical = number(_median(data.spread))
        return f"{_points(n)} measured, with a typical stated uncertainty of {typical} {unit} in 3D."
    row = data.coverage.overall
    inside = row.level(0.95).ellipsoid
    off = f"A measured position is off by {number(row.rmse)} {unit} rms"
    if not math.isfinite(inside.value):
        return f"{off}, over {_points(row.n)}."
    return f"{off}; its 95 % ellipsoid contained the truth for {per_cent(inside)} of {_points(row.n - row.unusable)}."


def verdict(data: ReportData) -> tuple[str, str, str]:
    """What the error bars are worth.

    Args:
        data: What the report is about.

    Returns:
        Title, explanation, and tone: "good", "bad", "careful" or "unknown".
    """
    if data.lengths is not None:
        return _verdict_of_lengths(data.lengths, data.unit)
    if data.coverage is None:
        return (
            "The error bars were not checked here.",
            "The true positions are not known, so this page shows what the instrument states about itself, not "
            "whether that is so. Measure a few points whose positions you know, and evaluate.",
            "unknown",
        )
    row = data.coverage.overall
    title, tone = VERDICTS[row.verdict]
    return title, f"{_judgement(row)} {_independence(row)}".strip(), tone


def _verdict_of_lengths(known: KnownLengths, unit: str) -> tuple[str, str, str]:
    factor = known.rms / known.stated_rms
    seen = f"Of these distances the error bars predict {number(known.stated_rms)} {unit} rms; it is "
    seen += f"{number(known.rms)} {unit}, {number(factor, 2)} times that."
    blind = (
        "A distance shows noise, wrong scale and bent space, but no error that shifts or turns all of it. It has two "
        "ends, so it compares with a position's uncertainty along one axis, times 1.4, and not with its 95 % ellipsoid."
    )
    if factor <= MAX_RIGHT_FACTOR:
        return "The error bars hold for distances.", f"{seen} {blind}", "good"
    if factor <= MAX_CAREFUL_FACTOR:
        return "The error bars are somewhat too small for distances.", f"{seen} {blind}", "careful"
    return "The error bars are too small.", f"{seen} Do not rely on them: look at the notes below. {blind}", "bad"


def tiles(data: ReportData) -> list[tuple[str, str, str]]:
    """The key numbers.

    Args:
        data: What the report is about.

    Returns:
        Label, value and explanation of each.
    """
    unit, m = data.unit, data.measurement
    measured = int(m.measured.sum())
    count = ("points measured", f"{measured:,} of {len(m):,}", "the others are listed below, with the reason")
    if measured == len(m):
        count = ("points measured", f"{measured:,}", "none was left out")
    sources = _sources(data)
    if data.coverage is None or data.coverage.overall.n == 0:
        x, y, z = (number(_median(sd)) for sd in data.sd.T)
        if data.lengths is not None:
            known = data.lengths
            error = f"the error bars predict {number(known.stated_rms)} {unit}"
            inside = f"of {len(known.errors):,} distances; 95 % is right"
            sources = [
                ("rms error of distances", f"{number(known.rms)} {unit}", error),
                ("inside their 95 % interval", percent(known.inside), inside),
                *sources,
            ]
        return [count, (f"stated sd, median ({unit})", f"{x} / {y} / {z}", "in x, y and z"), *sources]
    row = data.coverage.overall
    found = [
        ("rms error, 3D", f"{number(row.rmse)} {unit}", f"the error bars predict {number(row.stated_rms)} {unit}"),
        (
            "half / 95 % of points within",
            f"{number(row.median_error)} / {number(row.p95_error)} {unit}",
            "of the truth",
        ),
        ("rms error in x / y / z", " / ".join(number(r, 2) for r in row.rmse_axes) + f" {unit}", _stated(row, unit)),
        ("NEES", interval(row.nees), "squared error over stated variance, 3 is right"),
    ]
    if math.isfinite(row.rmse_over_limit):
        times = f"{number(row.rmse_over_limit)}×"
        found.append(("rms error over the Cramér–Rao limit", times, "1× is the best these pixels allow on average"))
    return [*found, *sources, count]


def _sources(data: ReportData) -> list[tuple[str, str, str]]:
    """The tile of what the uncertainty comes from; none where the method cannot tell."""
    share = data.measurement.share_calibration
    if not np.isfinite(share).any():
        return []
    variance = data.spread**2
    noise, lack = (_median(np.sqrt(variance * part)) for part in (1 - share, share))
    note = f"medians in 3D; more known points could remove the second, {percent(_median(share))} of the variance"
    return [("from pixel noise / lack of known points", f"{number(noise)} / {number(lack)} {data.unit}", note)]


def _judgement(row: Summary) -> str:
    inside = row.level(0.95).ellipsoid
    seen = f"95 % of points should lie in their 95 % ellipsoid; {per_cent(inside)} did."
    seen += f" NEES should be 3; it is {interval(row.nees)}." if math.isfinite(row.nees.value) else ""
    factor = number(row.sd_factor, 2)
    return {
        "right": f"{seen} The intervals include both.",
        "too small": f"{seen} The instrument claims to know more than it does: its standard uncertainties "
        f"would have to be {factor} times as large.",
        "too large": f"{seen} The instrument is better than it says: its standard uncertainties could be "
        f"{factor} times as large.",
        "cannot tell": f"{seen} Such wide intervals prove nothing: evaluate more points."
        if math.isfinite(inside.value)
        else "No point has both a known truth and a usable covariance.",
    }[row.verdict]


def _independence(row: Summary) -> str:
    if row.cluster_kind == "shots":
        return f"The interval counts {row.clusters} shots, because points of one shot share errors."
    if row.cluster_kind == "points of one shot":
        return "All points come from one shot and may share errors, so the interval may be too narrow."
    return ""


def _stated(row: Summary, unit: str) -> str:
    return "mean stated sd " + " / ".join(number(sd, 2) for sd in row.mean_sd) + f" {unit}"


def _median(values: Floats) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")


def _points(n: int) -> str:
    return f"{n:,} point" + ("" if n == 1 else "s")
