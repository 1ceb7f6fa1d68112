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
from implicam.gp.linalg import address, cholesky, load_routine, solve_lower

MAX_CANDIDATE_POINTS = 1000
"""Points of many among which the inducing points are looked for; drawn at random but always the same."""

FEWEST_POINTS_BY_ROWS = 250
"""From so many points on, a kernel matrix takes longer than the rows of its pivots one by one."""

MOST_ROWS = 0.2
"""A part of the points: with more pivots than this the whole matrix takes less time again."""

_DPSTRF = load_routine("dpstrf", 9)


@dataclass(frozen=True, eq=False)
class LowRank:
    """A kernel of unit variance and its inducing points.

    Attributes:
        kernel: The kernel.
        inducing: (m, d) inputs.
    """

    kernel: Kernel
    inducing: Floats

    @classmethod
    def of(cls, kernel: Kernel, X: Floats, tolerance: float) -> LowRank:
        """Choose inducing points so that little variance is left at any point.

        Args:
            kernel: Of unit variance.
            X: (n, d) points; of more than `MAX_CANDIDATE_POINTS`, as many are drawn at random but always the same.
            tolerance: The variance that may be left.
        """
        drawn = (
            X
            if len(X) <= MAX_CANDIDATE_POINTS
            else X[np.random.default_rng(0).choice(len(X), MAX_CANDIDATE_POINTS, replace=False)]
        )
        pivots, _ = pivoted_kernel(kernel, drawn, tolerance)
        return cls(kernel, drawn[pivots])

    @cached_property
    def factor(self) -> Floats:
        """(m, m) Cholesky factor of the kernel matrix of the inducing points; chosen well, it needs no jitter."""
        return cholesky(np.asfortranarray(self.kernel(self.inducing, self.inducing)))

    def features(self, X: Floats) -> Floats:
        """The features phi at inputs.

        Args:
            X: (n, d).

        Returns:
            (n, m).
        """
        return self.features_from(self.kernel(X, self.inducing))

    def features_from(self, K: Floats) -> Floats:
        """The features phi, from covariances.

        Args:
            K: (n, m) covariance with the inducing points.

        Returns:
            (n, m).
        """
        return solve_lower(self.factor, K.T).T

    def coefficients(self, weights: Floats) -> Floats:
        """The coefficients such that `K coefficients = phi weights`.

        Args:
            weights: (m, k) of the features.

        Returns:
            (m, k).
        """
        return np.asarray(np.linalg.solve(self.factor.T, weights), dtype=np.float64)

    def slope(self, X: Floats, K: Floats, coefficients: Floats) -> Floats:
        """The derivative of `K coefficients` with respect to the inputs; for the squared exponential only.

        Args:
            X: (n, d) inputs.
            K: (n, m) their covariance with the inducing points.
            coefficients: (m, k).

        Returns:
            (n, k, d).
        """
        scaled = X / self.kernel.lengthscale**2
        pulled = self.inducing / self.kernel.lengthscale**2
        value = K @ coefficients
        both = coefficients[:, :, None] * pulled[:, None, :]
        toward = np.einsum("nm,mkd->nkd", K, both, optimize=True)
        return np.asarray(toward - value[:, :, None] * scaled[:, None, :], dtype=np.float64)


def pivoted_kernel(kernel: Kernel, X: Floats, tolerance: float) -> tuple[NDArray[np.int64], Floats]:
    """`pivoted_cholesky` of the kernel matrix of many points, of which only the pivots' rows are made.

    Args:
        kernel: Of any variance.
        X: (n, d) points.
        tolerance: What may be left on the diagonal.

    Returns:
        (m,) pivots, and (n, m) the factor, rows as in X.
    """
    n = len(X)
    if n < FEWEST_POINTS_BY_ROWS or not np.isfinite(X).all():
        return pivoted_cholesky(kernel(X, X), tolerance)
    columns = np.ascontiguousarray((X / kernel.lengthscale).T)
    squares = np.einsum("ij,ij->j", columns, columns)
    left = np.full(n, kernel.signal_variance)
    rows = np.empty((64, n))
    pivots: list[int] = []
    while len(pivots) < n:
        i, m = int(left.argmax()), len(pivots)
        if not left[i] > tolerance:
            break
        if m > MOST_ROWS * n:
            return pivoted_cholesky(kernel(X, X), tolerance)
        if m == len(rows):
            rows = np.concatenate([rows, np.empty_like(rows)])
        d2 = columns[:, i] @ columns
        d2 *= -2.0
        d2 += squares
        d2 += squares[i]
        row = kernel.of_squared_distances(np.maximum(d2, 0.0, out=d2))
        if m:
            row -= rows[:m, i] @ rows[:m]
        row /= np.sqrt(left[i])
        rows[m] = row
        left -= np.multiply(row, row, out=row)
        pivots.append(i)
        left[pivots] = -np.inf  # by rounding a little may be left there
    return np.array(pivots, dtype=np.int64), np.ascontiguousarray(rows[: len(pivots)].T)


def pivoted_cholesky(K: Floats, tolerance: float) -> tuple[NDArray[np.int64], Floats]:
    """The pivoted Cholesky factor of a matrix, stopped when little is left on the diagonal.

    Args:
        K: (n, n) symmetric.
        tolerance: What may be left on the diagonal of `K - factor factor^T`.

    Returns:
        (m,) pivots, and (n, m) the factor, rows as in K.
    """
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
