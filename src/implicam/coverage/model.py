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
    """Observed coverage at one nominal probability.

    Attributes:
        nominal: The nominal probability.
        pooled: Of the intervals of x, y and z, all together.
        axes: Of the intervals of x, y and z alone.
        ellipsoid: Of the 3D ellipsoids.
    """

    nominal: float
    pooled: Estimate
    axes: tuple[Estimate, Estimate, Estimate]
    ellipsoid: Estimate


@dataclass(frozen=True)
class Summary:
    """The errors and covariances of one region. Lengths are in the unit of the errors.

    Attributes:
        group: "all", or the name of the regions.
        region: The label.
        n: Points measured, which rmse, median and p95 are of.
        unmeasured: Points without a position, counted only.
        unusable: Measured points whose covariance could not be judged (`Coverage.reasons`); they count in n only.
        clusters: How many things the intervals took as independent.
        cluster_kind: What these are: "shots"; "points" where there are no shots; "points of one shot" where one shot is
            all there is, so that the intervals may be too narrow.
        rmse_axes: Root mean square error of x, y and z.
        rmse: Root mean square error in 3D, sqrt(mean |e|²).
        median_error: Median of |e|.
        p95_error: 95th percentile of |e|.
        mean_sd: Mean stated standard deviation of x, y and z.
        stated_rms: What the covariances say the rmse should be, sqrt(mean trace C).
        levels: Coverage at each of `LEVELS`.
        nees: Mean e' C⁻¹ e; 3 is right.
        nll: Mean negative log density of the 3D Gaussian in nats; it depends on the unit.
        crps: Continuous ranked probability score, mean over points and axes.
        sd_factor: Times this, the 95 % ellipsoid would have held 95 %.
        rmse_over_limit: Rms error over the Cramer-Rao limit; 1 is perfect, NaN without limits.
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
        """The coverage at one nominal probability.

        Args:
            nominal: One of `LEVELS`.

        Raises:
            ValueError: It is none of them.
        """
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
    """How well covariances agree with errors.

    Attributes:
        rows: One per region, the first over all points.
        reasons: The number of a point, and why its covariance was not judged.

    >>> import implicam as ic
    >>> import numpy as np
    >>> rng = np.random.default_rng(1)
    >>> ic.assess(rng.normal(size=(200, 3)), np.tile(np.eye(3), (200, 1, 1))).overall.n
    200
    """

    rows: tuple[Summary, ...]
    reasons: tuple[tuple[int, str], ...] = ()

    @property
    def overall(self) -> Summary:
        """The row over all points."""
        return self.rows[0]

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and text, ready for JSON; None where there is no number."""
        plain: dict[str, Any] = json_safe(asdict(self))
        for row, summary in zip(plain["rows"], self.rows, strict=True):
            row["verdict"] = summary.verdict
        return plain


def _ratio(a: float, b: float) -> float:
    """The quotient; infinite where it is not known, so that it proves nothing."""
    return a / b if np.isfinite(a) and b > 0 else float("inf")
