"""A smooth Gaussian process in few features: `k(x, x') = phi(x) . phi(x')` to a tolerance, at any number of points.

The pivoted Cholesky factor of the kernel matrix (Harbrecht, Peters & Schneider 2012) picks points one by one, each
where most variance is left, and stops when less than `tolerance` is left anywhere. What the process is at these
*inducing* points decides what it is at all others, so a prediction costs their number, however many points there are.
With the tolerance far below the noise the answer is the exact one.
"""

from __future__ import annotations

from ctypes import byref, c_char, c_double, c_int
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from implicam.gp.kernels import Floats, Kernel
from implicam.gp.linalg import address, cholesky, routine, solve_lower

MAX_DRAWN = 1000
"""Points of many among which the inducing points are looked for; drawn at random but always the same."""

_DPSTRF = routine("dpstrf", 9)


@dataclass(frozen=True, eq=False)
class LowRank:
    """A kernel of unit variance and its inducing points (m, d)."""

    kernel: Kernel
    inducing: Floats

    @classmethod
    def of(cls, kernel: Kernel, X: Floats, tolerance: float) -> LowRank:
        """Enough of the points X (n, d) as inducing points to leave less than `tolerance` of the variance at any."""
        drawn = X if len(X) <= MAX_DRAWN else X[np.random.default_rng(0).choice(len(X), MAX_DRAWN, replace=False)]
        pivots, _ = pivoted_cholesky(kernel(drawn, drawn), tolerance)
        return cls(kernel, drawn[pivots])

    @cached_property
    def factor(self) -> Floats:
        """(m, m) Cholesky factor of the kernel matrix of the inducing points; chosen well, it needs no jitter."""
        return cholesky(np.asfortranarray(self.kernel(self.inducing, self.inducing)))

    def features(self, X: Floats) -> Floats:
        """(n, m) phi."""
        return self.features_from(self.kernel(X, self.inducing))

    def features_from(self, K: Floats) -> Floats:
        """(n, m) phi, from the covariance (n, m) with the inducing points."""
        return solve_lower(self.factor, K.T).T

    def coefficients(self, weights: Floats) -> Floats:
        """(m, k) such that `K coefficients = phi weights`, for weights (m, k)."""
        return np.asarray(np.linalg.solve(self.factor.T, weights), dtype=np.float64)

    def slope(self, X: Floats, K: Floats, coefficients: Floats) -> Floats:
        """(n, k, d) derivative of `K coefficients` with respect to X (n, d); the squared exponential only."""
        scaled = X / self.kernel.lengthscale**2
        pulled = self.inducing / self.kernel.lengthscale**2
        value = K @ coefficients
        both = coefficients[:, :, None] * pulled[:, None, :]
        toward = np.einsum("nm,mkd->nkd", K, both, optimize=True)
        return np.asarray(toward - value[:, :, None] * scaled[:, None, :], dtype=np.float64)


def pivoted_cholesky(K: Floats, tolerance: float) -> tuple[NDArray[np.int64], Floats]:
    """Pivots (m,) and the factor (n, m), rows as in K, with `K - factor factor^T` below `tolerance` on the diagonal."""
    A = np.array(K, order="F")
    n, rank, info = c_int(len(A)), c_int(0), c_int(0)
    pivots, work = np.zeros(len(A), dtype=np.int32), np.zeros(2 * len(A))
    lower, least = byref(c_char(b"L")), byref(c_double(tolerance))
    _DPSTRF(
        lower, byref(n), address(A), byref(n), pivots.ctypes.data, byref(rank), least, work.ctypes.data, byref(info)
    )
    order, m = pivots.astype(np.int64) - 1, rank.value
    factor = np.empty((len(A), m))
    factor[order] = np.tril(A[:, :m])
    return order[:m], factor
