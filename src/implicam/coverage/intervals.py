"""95 % intervals that stay honest when points of one shot, and the axes of one point, share errors.

They count clusters, not numbers:

- share p of N indicators in G clusters: the linearised cluster-robust variance V = G/(G-1) sum_g (S_g - p N_g)²/N²
  (Cochran, Sampling Techniques, §9A.2; Liang & Zeger 1986) gives the design effect V N / (p(1-p)) (Kish 1965), that
  an effective number of indicators, and that a Wilson (1927) interval (Korn & Graubard 1998);
- mean of positive values: the same variance, on a log scale, because a mean of chi-squared values is skewed;
- both with Student's t of (effective clusters - 1) degrees of freedom in place of 1.96.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from implicam.dataset import Floats


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval; NaN where it cannot be estimated.

    Attributes:
        value: The number.
        low: The lower end of the interval.
        high: The upper end.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Clusters:
    """Which of n points belong together.

    Attributes:
        labels: (n,), equal within a cluster.
    """

    labels: NDArray[Any]

    @cached_property
    def index(self) -> NDArray[np.intp]:
        """(n,) the cluster of each point, from 0."""
        return np.unique(self.labels, return_inverse=True)[1]

    @cached_property
    def sizes(self) -> Floats:
        """(clusters,) points per cluster."""
        return self.sums(np.ones(len(self.labels)))

    @property
    def effective(self) -> float:
        """Kish's effective number: that of equal clusters whose total varies as much."""
        return float(self.sizes.sum() ** 2 / (self.sizes**2).sum())

    @property
    def t(self) -> float:
        """The factor from a standard error to half a 95 % interval."""
        return float(stdtrit(max(self.effective - 1, 1), 0.975))

    def sums(self, values: NDArray[Any]) -> Floats:
        """The sum of values per cluster.

        Args:
            values: (n,).

        Returns:
            (clusters,).
        """
        return np.asarray(np.bincount(self.index, weights=values), dtype=np.float64)

    def variance_of_mean(self, values: NDArray[Any]) -> float:
        """Cluster-robust variance of the mean of values.

        Args:
            values: (n,), in at least two clusters.
        """
        groups = len(self.sizes)
        residual = self.sums(values) - values.mean() * self.sizes
        return groups / (groups - 1) * float((residual**2).sum()) / len(values) ** 2


def shares(values: Floats, bounds: ArrayLike, clusters: Clusters) -> list[Estimate]:
    """The share of values within each bound.

    Misses are rare at 0.99, and a few hardly show how strongly a cluster agrees. So the design effect is at least that
    of the indicator "below the median", which has the most data; agreement in the tails is weaker, if anything.

    Args:
        values: (n, k), k of each point.
        bounds: (b,) or one number; a value on a bound is within it.
        clusters: Of the n points.

    Returns:
        One estimate per bound. With a single cluster its interval is all of 0 to 1; without values it is NaN.
    """
    limits = np.atleast_1d(np.asarray(bounds, dtype=np.float64))
    if not len(values):
        return [Estimate(np.nan, np.nan, np.nan)] * len(limits)
    if len(clusters.sizes) < 2:
        return [Estimate(float((values <= bound).mean()), 0.0, 1.0) for bound in limits]
    agreement = _design_effect(values <= np.median(values), clusters)
    return [_share(values <= bound, clusters, agreement) for bound in limits]


def mean_interval(values: Floats, clusters: Clusters) -> Estimate:
    """The mean of positive values, with an interval on a log scale.

    Args:
        values: (n,) positive.
        clusters: Of the n points.

    Returns:
        The mean; its interval is NaN with fewer than two clusters.
    """
    mean = float(values.mean()) if len(values) else float("nan")
    if len(values) == 0 or len(clusters.sizes) < 2 or mean <= 0:
        return Estimate(mean, np.nan, np.nan)
    relative = np.sqrt(clusters.variance_of_mean(values)) / mean
    factor = float(np.exp(min(clusters.t * relative, 700.0)))  # exp(700) is near the largest float
    return Estimate(mean, mean / factor, mean * factor)


def _share(hits: NDArray[np.bool_], clusters: Clusters, least_design_effect: float) -> Estimate:
    effective = hits.size / max(_design_effect(hits, clusters), least_design_effect)
    return _wilson(float(hits.mean()), effective, clusters.t)


def _design_effect(hits: NDArray[np.bool_], clusters: Clusters) -> float:
    """Variance of the share over that of independent indicators: at least 1, at most as if each cluster were one."""
    p = float(hits.mean())
    if p in (0.0, 1.0):
        return 1.0
    variance = clusters.variance_of_mean(hits.mean(axis=1))
    return float(np.clip(variance * hits.size / (p * (1 - p)), 1.0, hits.size / clusters.effective))


def _wilson(p: float, n: float, z: float) -> Estimate:
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + (z / (2 * n)) ** 2)
    # At p = 0 or 1 rounding could put the share itself outside.
    return Estimate(p, max(0.0, min(p, float(centre - half))), min(1.0, max(p, float(centre + half))))
