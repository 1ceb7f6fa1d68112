"""Judge covariances by errors.

NEES is e' C⁻¹ e, expected 3 (Bar-Shalom, Estimation with Applications to Tracking and Navigation, §5.4); the CRPS of a
Gaussian in closed form is Gneiting & Raftery 2007, eq. 21.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri, ndtr, ndtri  # scipy.stats would double the time of `import implicam`

from implicam.coverage.intervals import Clusters, mean_interval, shares
from implicam.coverage.model import LEVELS, Coverage, Level, Summary
from implicam.dataset import Floats, Names
from implicam.errors import UsageError

READING_ORDER = ("near", "low", "middle", "far", "high")
"""Labels that rows follow in this order; others come after them, by alphabet."""

_NEES_QUANTILE_95 = float(chdtri(3, 0.05))
# A correlation matrix this close to singular claims to know one direction a million times better than another.
_MIN_CORRELATION_EIGENVALUE = 1e-12
# Beyond these, squares of squares overflow; no length unit makes sense of them.
_MAX_ERROR, _MIN_VARIANCE = 1e70, 1e-100


def assess(
    errors: ArrayLike,
    cov: ArrayLike,
    *,
    clusters: ArrayLike | None = None,
    regions: Mapping[str, ArrayLike] | None = None,
    limit: ArrayLike | None = None,
) -> Coverage:
    """Judge covariances by the errors of the positions that they belong to.

    One bad covariance is a reason in the result, not an exception.

    Args:
        errors: (n, 3) measured minus true position; a row of NaN is a point that was not measured.
        cov: (n, 3, 3) stated covariances, in the squared unit of the errors.
        clusters: (n,) labels, one per shot. Without them, and in a row whose points all come from one shot, every point
            counts as independent (`Summary.cluster_kind` says which).
        regions: Name -> (n,) labels; each label becomes a row, "" none.
        limit: (n, 3, 3) Cramer-Rao covariances, NaN where unknown.

    Returns:
        A row over all points, then one per region.

    Raises:
        UsageError: An array has the wrong shape.

    >>> import implicam as ic
    >>> import numpy as np
    >>> rng = np.random.default_rng(1)
    >>> coverage = ic.assess(rng.normal(size=(200, 3)), np.tile(np.eye(3), (200, 1, 1)))
    >>> coverage.overall.n
    200
    """
    e = np.asarray(errors, dtype=np.float64)
    if e.ndim != 2 or e.shape[1] != 3:
        raise UsageError(f"errors have the shape {e.shape}; expected (n, 3).")
    n = len(e)
    c = _shaped(np.asarray(cov, dtype=np.float64), (n, 3, 3), "cov")
    unknown = np.full((n, 3, 3), np.nan)
    bound = unknown if limit is None else _shaped(np.asarray(limit, dtype=np.float64), (n, 3, 3), "limit")
    shots = None if clusters is None else _shaped(np.asarray(clusters), (n,), "clusters")
    measured = _every(np.abs(e) < _MAX_ERROR)
    why = np.where(measured, _objections(c), "")
    sample = _Sample(e, c, bound, shots, measured, measured & (why == ""))
    rows = [_summary("all", "all points", sample)]
    for group, labels in (regions or {}).items():
        named = _shaped(np.asarray(labels).astype(np.str_), (n,), f"region {group!r}")
        rows += [_summary(group, label, sample.select(named == label)) for label in _reading_order(named)]
    return Coverage(tuple(rows), tuple((int(i), str(why[i])) for i in np.flatnonzero(why != "")))


def tercile_labels(values: ArrayLike, names: tuple[str, str, str] = ("near", "middle", "far")) -> Names:
    """Labels of the lowest, middle and highest third of values.

    Args:
        values: (n,).
        names: Of the three thirds.

    Returns:
        (n,) labels; "" where the value is not finite.
    """
    x = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(x)
    labels = np.full(x.shape, "", dtype=f"<U{max(map(len, names))}")
    if finite.any():
        cuts = np.quantile(x[finite], [1 / 3, 2 / 3])
        labels[finite] = np.array(names)[np.searchsorted(cuts, x[finite], side="left")]
    return labels


@dataclass(frozen=True, eq=False)
class _Sample:
    """Points of one region; `usable` are those measured whose covariance can be judged."""

    errors: Floats
    cov: Floats
    limit: Floats
    shots: NDArray[Any] | None
    measured: NDArray[np.bool_]
    usable: NDArray[np.bool_]

    def select(self, i: NDArray[np.bool_]) -> _Sample:
        shots = None if self.shots is None else self.shots[i]
        return _Sample(self.errors[i], self.cov[i], self.limit[i], shots, self.measured[i], self.usable[i])

    def clusters(self) -> tuple[Clusters, str]:
        """Of the usable points; one shot alone cannot show how shots differ, so then points must do."""
        if self.shots is not None:
            by_shot = Clusters(self.shots[self.usable])
            if len(by_shot.sizes) > 1:
                return by_shot, "shots"
        return Clusters(np.flatnonzero(self.usable)), "points" if self.shots is None else "points of one shot"


def _summary(group: str, region: str, sample: _Sample) -> Summary:
    all_errors = sample.errors[sample.measured]
    length = np.linalg.norm(all_errors, axis=1)
    e, cov = sample.errors[sample.usable], sample.cov[sample.usable]
    clusters, kind = sample.clusters()
    sd = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    nees, log_det = _nees(e, cov, sd)
    return Summary(
        group=group,
        region=region,
        n=len(all_errors),
        unmeasured=int((~sample.measured).sum()),
        unusable=len(all_errors) - len(e),
        clusters=len(clusters.sizes),
        cluster_kind=kind,
        rmse_axes=_triple(np.sqrt(_mean(all_errors**2))),
        rmse=float(np.sqrt(_mean(length**2))),
        median_error=_quantile(length, 0.5),
        p95_error=_quantile(length, 0.95),
        mean_sd=_triple(_mean(sd)),
        stated_rms=float(np.sqrt(_mean((sd**2).sum(axis=1)))),
        levels=_levels(np.abs(e) / sd, nees, clusters),
        nees=mean_interval(nees, clusters),
        nll=float(_mean(0.5 * (nees + log_det + 3 * np.log(2 * np.pi)))),
        crps=float(_mean(_crps(e, sd).ravel())),
        sd_factor=float(np.sqrt(_quantile(nees, 0.95) / _NEES_QUANTILE_95)),
        rmse_over_limit=_over_limit(all_errors, sample.limit[sample.measured]),
    )


def _levels(z: Floats, nees: Floats, clusters: Clusters) -> tuple[Level, ...]:
    bounds = ndtri(0.5 + np.array(LEVELS) / 2)
    pooled = shares(z, bounds, clusters)
    by_axis = [shares(z[:, [axis]], bounds, clusters) for axis in range(3)]
    ellipsoid = shares(nees[:, None], chdtri(3, 1 - np.array(LEVELS)), clusters)
    return tuple(
        Level(nominal, pooled[i], (by_axis[0][i], by_axis[1][i], by_axis[2][i]), ellipsoid[i])
        for i, nominal in enumerate(LEVELS)
    )


def _nees(e: Floats, cov: Floats, sd: Floats) -> tuple[Floats, Floats]:
    """NEES e' C⁻¹ e and log det C, through correlations so that badly scaled axes lose no digits."""
    lower = np.linalg.cholesky(_correlation(cov, sd))
    white = np.linalg.solve(lower, (e / sd)[..., None])[..., 0]
    log_det = 2 * np.log(np.diagonal(lower, axis1=1, axis2=2) * sd).sum(axis=1)
    return (white**2).sum(axis=1), log_det


def _crps(e: Floats, sd: Floats) -> Floats:
    z = e / sd
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    crps: Floats = sd * (z * (2 * ndtr(z) - 1) + 2 * density - 1 / np.sqrt(np.pi))
    return crps


def _over_limit(errors: Floats, limit: Floats) -> float:
    trace = np.trace(limit, axis1=1, axis2=2)
    known = np.isfinite(trace) & (trace > 0)
    return float(np.sqrt(_mean((errors[known] ** 2).sum(axis=1)) / _mean(trace[known])))


def _objections(cov: Floats) -> Names:
    """(n,) why a covariance cannot be judged; empty where it can. Later tests see the identity where one failed."""
    finite = _every(np.isfinite(cov).reshape(-1, 9))
    positive = finite & _every(np.diagonal(cov, axis1=1, axis2=2) > _MIN_VARIANCE)
    safe = np.where(positive[:, None, None], cov, np.eye(3))
    # A correlation beyond 1 is not definite, however large; clipped, it cannot overflow on the way there.
    correlation = np.clip(_correlation(safe, np.sqrt(np.diagonal(safe, axis1=1, axis2=2))), -2, 2)
    symmetric = np.abs(correlation - correlation.swapaxes(1, 2)).max(axis=(1, 2), initial=0.0) < 1e-6
    definite = np.linalg.eigvalsh(correlation)[:, 0] > _MIN_CORRELATION_EIGENVALUE
    return np.select(
        [~finite, ~positive, ~symmetric, ~definite],
        [
            "its covariance is not finite",
            "a standard uncertainty is zero, or its square negative",
            "its covariance is not symmetric",
            "its covariance is singular: it claims certainty along a direction",
        ],
        default="",
    )


def _correlation(cov: Floats, sd: Floats) -> Floats:
    with np.errstate(over="ignore"):
        return np.asarray(cov / sd[:, :, None] / sd[:, None, :], dtype=np.float64)


def _reading_order(labels: Names) -> list[str]:
    known = {name: i for i, name in enumerate(READING_ORDER)}
    present = [str(label) for label in np.unique(labels) if label != ""]
    return sorted(present, key=lambda label: (known.get(label, len(known)), label))


def _every(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.asarray(flags.all(axis=1), dtype=np.bool_)


def _mean(values: Floats) -> Any:
    return values.mean(axis=0) if len(values) else np.full(values.shape[1:], np.nan)


def _quantile(values: Floats, q: float) -> float:
    return float(np.quantile(values, q)) if len(values) else float("nan")


def _triple(values: Floats) -> tuple[float, float, float]:
    x, y, z = values
    return float(x), float(y), float(z)


def _shaped(array: NDArray[Any], shape: tuple[int, ...], name: str) -> NDArray[Any]:
    if array.shape != shape:
        raise UsageError(f"{name} has the shape {array.shape}; expected {shape}.")
    return array
