"""Exact Gaussian-process regression: condition on data, predict, add a point.

Rasmussen & Williams, Alg. 2.1 (prediction, marginal likelihood) and eqs. 5.10-5.12 (leave one out).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from implicam.errors import NumericalError
from implicam.gp.kernels import Floats, Kernel
from implicam.gp.linalg import cholesky, solve, solve_lower

BLOCK_ENTRIES = 1 << 22  # of K_* at a time: 32 MB, so that a million predictions need no more


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """A Gaussian process conditioned on n values; build it with `condition`.

    Attributes:
        kernel: The kernel.
        noise_variance: Of each output.
        mean: The constant prior mean.
        X: (n, d) inputs.
        y: (n,) noisy outputs.
        L: (n, n) lower Cholesky factor of K + noise_variance I.
        alpha: (n,) (K + noise_variance I)^-1 (y - mean).
    """

    kernel: Kernel
    noise_variance: float
    mean: float
    X: Floats
    y: Floats
    L: Floats
    alpha: Floats

    @classmethod
    def condition(
        cls, kernel: Kernel, noise_variance: float, X: Floats, y: Floats, mean: float = 0.0
    ) -> GaussianProcess:
        """Condition on data.

        Args:
            kernel: The kernel.
            noise_variance: Of each output.
            X: (n, d) inputs.
            y: (n,) noisy outputs.
            mean: The constant prior mean.

        Raises:
            NumericalError: The matrix is not positive definite, the arrays do not fit together, or hold NaN.
        """
        X, y = np.array(X, dtype=np.float64), np.array(y, dtype=np.float64)
        _check(kernel, X, y)
        K = kernel(X, X)
        K[np.diag_indices_from(K)] += noise_variance
        L = cholesky(K.T)  # K is symmetric, and its transpose is in LAPACK's order
        return cls(kernel, noise_variance, mean, X, y, L, solve(L, y - mean))

    def __len__(self) -> int:
        return len(self.y)

    def predict(self, X: Floats) -> tuple[Floats, Floats]:
        """Predict the function, without the noise of a new output.

        Args:
            X: (m, d) inputs.

        Returns:
            (m,) mean and (m,) variance.
        """
        X = np.asarray(X, dtype=np.float64)
        mean, variance = np.empty(len(X)), np.empty(len(X))
        step = max(1, BLOCK_ENTRIES // max(1, len(self)))
        for start in range(0, len(X), step):
            block = slice(start, start + step)
            K = self.kernel(self.X, X[block])
            mean[block] = self.mean + K.T @ self.alpha  # line 4
            v = solve_lower(self.L, K)  # line 5
            variance[block] = self.kernel.signal_variance - np.einsum("ij,ij->j", v, v)  # line 6
        # Where data are dense the difference of two large numbers may round below zero.
        return mean, np.maximum(variance, 0.0)

    def add(self, x: Floats, y: float) -> GaussianProcess:
        """The process conditioned on one more value, in O(n²): the factor grows by one row.

        Args:
            x: (d,) its input.
            y: The output.

        Raises:
            NumericalError: The matrix would be singular.
        """
        x = np.asarray(x, dtype=np.float64)[None, :]
        row = solve_lower(self.L, self.kernel(self.X, x)[:, 0])
        pivot = self.kernel.signal_variance + self.noise_variance - row @ row
        if not pivot > 0:
            raise NumericalError(
                "the added point makes the covariance matrix singular.",
                why="it coincides with a point already there and the noise variance is too small",
                fix="raise the noise variance, or do not add the same point twice",
            )
        n = len(self)
        L = np.zeros((n + 1, n + 1), order="F")
        L[:n, :n], L[n, :n], L[n, n] = self.L, row, np.sqrt(pivot)
        X_new, y_new = np.concatenate([self.X, x]), np.append(self.y, y)
        return GaussianProcess(
            self.kernel, self.noise_variance, self.mean, X_new, y_new, L, solve(L, y_new - self.mean)
        )

    def log_marginal_likelihood(self) -> float:
        """Log density of the outputs, hyperparameters given (line 7)."""
        fit = -0.5 * (self.y - self.mean) @ self.alpha
        return float(fit - np.log(np.diag(self.L)).sum() - 0.5 * len(self) * np.log(2 * np.pi))

    def leave_one_out(self) -> tuple[Floats, Floats]:
        """(n,) mean and (n,) variance of each output predicted from all others, noise included (eq. 5.12)."""
        inverse = solve(self.L, np.eye(len(self)))
        precision = np.diag(inverse)
        return self.y - self.alpha / precision, 1.0 / precision


def _check(kernel: Kernel, X: Floats, y: Floats) -> None:
    if X.ndim != 2 or X.shape[1] != len(kernel.lengthscale) or y.shape != (len(X),) or len(X) == 0:
        raise NumericalError(
            f"inputs of shape {X.shape} and outputs of shape {y.shape} do not fit a kernel of "
            f"{len(kernel.lengthscale)} lengthscales.",
            fix="give X (n, d) and y (n,) with n > 0",
        )
    if not (np.isfinite(X).all() and np.isfinite(y).all()):
        raise NumericalError("an input or an output is not finite.", fix="leave out points with NaN or infinity")
