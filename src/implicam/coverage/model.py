"""The result: per region, how large the errors are and whether the covariance said so."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from implicam.coverage.intervals import Estimate
from implicam.formatting import json_safe

LEVELS = (0.50, 0.68, 0.90, 0.95, 0.99)
"""Nominal probabilities at which coverage is counted."""

# Below this a 95 % interval that holds 0.95 says little: at most 4 in 5 could be all there is.
_MIN_LOWER_BOUND = 0.80

NEES_RIGHT = 3.0
"""Expected squared error of a position in its own covariance: one for each axis."""

SLIGHT_NEES_RATIO = 1.25
"""Mean NEES this many times too large or small (error bars 12 % off) is not worth a word, however sure it is."""

DOUBT_WIDENING = 1.5
"""Intervals of the mean NEES are so much wider, on a log scale, before error bars are called wrong by them alone: with
that of coverage they are two tests, and together they are to call honest error bars wrong in 1 of 20 cases at most."""

FEW_CLUSTERS = 10
"""Of fewer an interval can be narrow by chance, and points of one shot share errors: then VAGUE_NEES_RATIO counts."""

VAGUE_NEES_RATIO = 4.0
"""An interval of the mean NEES that reaches so far beyond the right value (error bars half or twice) says little."""


@dataclass(frozen=True)
class Level:
    """Observed coverage at one nominal probability: all axes together, x, y and z alone, and the 3D ellipsoid."""

    nominal: float
    pooled: Estimate
    axes: tuple[Estimate, Estimate, Estimate]
    ellipsoid: Estimate


@dataclass(frozen=True)
class Summary:
    """One region. Lengths in the unit of the errors.

    n: points measured, the base of rmse, median and p95. unmeasured: points without a position, counted only.
    unusable: measured points whose covariance could not be judged (`Coverage.reasons`); they count in n only.
    rmse: sqrt(mean |e|²); stated_rms: what the covariance says it should be, sqrt(mean trace C). mean_sd: per axis.
    nees: mean e' C⁻¹ e, right at 3. nll: mean negative log density of the 3D Gaussian in nats (depends on the unit).
    crps: mean over points and axes. sd_factor: times this, the 95 % ellipsoid would have held 95 %.
    rmse_over_limit: rms error over the Cramer-Rao limit, 1 is perfect, NaN without limits.
    clusters: how many things the intervals took as independent, and `cluster_kind` what: "shots"; "points" where
    there are no shots; "points of one shot" where one shot is all there is, so that the intervals may be too narrow.
    """

    group: str
    region: str
    n: int
    unmeasured: int
    unusable: int
    clusters: int
    cluster_kind: str
    rmse_axes: tuple[float, float, float]
    rmse: float
    median_error: float
    p95_error: float
    mean_sd: tuple[float, float, float]
    stated_rms: float
    levels: tuple[Level, ...]
    nees: Estimate
    nll: float
    crps: float
    sd_factor: float
    rmse_over_limit: float

    def level(self, nominal: float) -> Level:
        """The coverage at one of LEVELS."""
        return self.levels[LEVELS.index(nominal)]

    @property
    def verdict(self) -> str:
        """Error bars "too small", "right" or "too large", or "cannot tell".

        Judged by the 95 % interval of what the 95 % ellipsoids hold, and by that of the mean NEES: a coverage near 1
        cannot tell how much too wide error bars are, NEES can. Where they contradict each other, too small counts.
        """
        inside, nees = self.level(0.95).ellipsoid, self.nees
        enough = self.clusters >= FEW_CLUSTERS and self.cluster_kind != "points of one shot"
        least = SLIGHT_NEES_RATIO if enough else VAGUE_NEES_RATIO
        sure = max(_ratio(nees.high, nees.value) ** DOUBT_WIDENING, least)
        if inside.high < 0.95 or nees.value > NEES_RIGHT * sure:
            return "too small"
        if inside.low > 0.95 or nees.value < NEES_RIGHT / sure:
            return "too large"
        sharp = nees.low >= NEES_RIGHT / VAGUE_NEES_RATIO and nees.high <= NEES_RIGHT * VAGUE_NEES_RATIO
        return "right" if inside.low >= _MIN_LOWER_BOUND and sharp else "cannot tell"


@dataclass(frozen=True)
class Coverage:
    """One row per region, the first over all points; reasons: (point's index, why its covariance was not judged)."""

    rows: tuple[Summary, ...]
    reasons: tuple[tuple[int, str], ...] = ()

    @property
    def overall(self) -> Summary:
        """The row over all points."""
        return self.rows[0]

    def as_dict(self) -> dict[str, Any]:
        """Ready for JSON: plain numbers, lists and text; None where there is no number."""
        plain: dict[str, Any] = json_safe(asdict(self))
        for row, summary in zip(plain["rows"], self.rows, strict=True):
            row["verdict"] = summary.verdict
        return plain


def _ratio(a: float, b: float) -> float:
    """The quotient; infinite where it is not known, so that it proves nothing."""
    return a / b if np.isfinite(a) and b > 0 else float("inf")
