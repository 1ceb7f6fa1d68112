"""The result: per region, how large the errors are and whether the covariance said so."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from implicam.coverage.intervals import Estimate

LEVELS = (0.50, 0.68, 0.90, 0.95, 0.99)
"""Nominal probabilities at which coverage is counted."""

# Below this a 95 % interval that holds 0.95 says little: at most 4 in 5 could be all there is.
_TOO_WIDE = 0.80


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
        """Error bars "too small", "right" or "too large", judged by the 95 % ellipsoid's interval, or "cannot tell"."""
        inside = self.level(0.95).ellipsoid
        if inside.high < 0.95:
            return "too small"
        if inside.low > 0.95:
            return "too large"
        return "right" if inside.low >= _TOO_WIDE else "cannot tell"


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
        plain: dict[str, Any] = _plain(asdict(self))
        for row, summary in zip(plain["rows"], self.rows, strict=True):
            row["verdict"] = summary.verdict
        return plain


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
