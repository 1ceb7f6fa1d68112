"""Several outputs with one kernel and correlated values: the intrinsic coregionalisation model.

The covariance of outputs i at x and j at x' is `B_ij k(x, x') + N_ij [x = x']` with covariances B of the signal and N
of the noise (Goovaerts 1997; Alvarez, Rosasco & Lawrence 2012, section 4.2). A matrix T that turns N into unity and B
into a diagonal, `T^T N T = I` and `T^T B T = diag(signal)`, makes the mixed outputs `Y T` independent processes with
unit noise. So the mn x mn matrix falls into m of n x n, and the search is over T, the signals and the lengthscales.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from implicam.errors import NumericalError
from implicam.gp.fit import MAX_LENGTHSCALE_SDS, MAX_START_LENGTHSCALE_SDS, Fit
from implicam.gp.kernels import SHAPES, Floats, Kernel, squared_distances
from implicam.gp.linalg import cholesky, solve
from implicam.threads import side_by_side

MAX_SIGNAL = 1e12
"""Signal over noise variance of a mixed output: beyond it rounding makes the matrix singular."""
MIN_SIGNAL = 1e-6
MAX_SEARCH_STEPS = 300
_FAILED = 1e12


@dataclass(frozen=True, eq=False)
class CoregionalisedFit:
    """Hyperparameters at the optimum.

    Attributes:
        kernels: Of the m mixed outputs, alike but for the signal variance; their noise variance is 1.
        mixing: (m, m) T: mixed outputs are `Y @ mixing`.
        log_marginal_likelihood: Of the outputs Y, in nats.
        converged: Whether the search ended by itself.
    """

    kernels: tuple[Kernel, ...]
    mixing: Floats
    log_marginal_likelihood: float
    converged: bool

    @property
    def signal_covariance(self) -> Floats:
        """(m, m) B."""
        back = np.linalg.inv(self.mixing)
        signals = np.array([kernel.signal_variance for kernel in self.kernels])
        return np.asarray(back.T @ (signals[:, None] * back))

    @property
    def noise_covariance(self) -> Floats:
        """(m, m) N."""
        back = np.linalg.inv(self.mixing)
        return np.asarray(back.T @ back)


class CoregionalisedLikelihood:
    """Negative log marginal likelihood, and its gradient, over log lengthscales (d,), log signals (m,) and T (m, m)."""

    def __init__(self, X: Floats, Y: Floats, shape: str) -> None:
        self.X, self.Y, self.shape = X, Y, SHAPES[shape]

    def __call__(self, theta: Floats) -> tuple[float, Floats]:
        """The value and its gradient.

        Args:
            theta: (d + m + m²,) log lengthscales, log signals, and T row by row.

        Returns:
            The value, and (d + m + m²,); a very large value with a zero gradient where a matrix is not positive
            definite.
        """
        (n, d), m = self.X.shape, self.Y.shape[1]
        signals, mixing = np.exp(theta[d : d + m]), theta[d + m :].reshape(m, m)
        scaled = self.X * np.exp(-theta[:d])
        correlation, slope = self.shape(squared_distances(scaled, scaled))
        size = np.linalg.slogdet(mixing)[1]
        Z = self.Y @ mixing
        value = 0.5 * m * n * np.log(2 * np.pi) - n * size
        through_mixing = np.empty((m, m))
        through_signals = np.empty(m)
        weights = np.zeros((n, n))  # of the derivative by the kernel matrix
        for i in range(m):
            A = signals[i] * correlation
            A[np.diag_indices(n)] += 1.0
            try:
                L = cholesky(A)
            except NumericalError:
                return _FAILED, np.zeros(len(theta))
            inverse = solve(L, np.eye(n))
            a = inverse @ Z[:, i]
            value += 0.5 * Z[:, i] @ a + np.log(np.diagonal(L)).sum()
            through_mixing[:, i] = self.Y.T @ a
            M = 0.5 * signals[i] * (inverse - np.outer(a, a))
            through_signals[i] = np.sum(M * correlation)
            weights += M
        if not np.isfinite(value):
            return _FAILED, np.zeros(len(theta))
        through_mixing -= n * np.linalg.inv(mixing).T
        M = weights * slope
        lengths = 2 * (M.sum(axis=1) @ scaled**2 - np.einsum("ij,ij->j", scaled, M @ scaled))
        return float(value), np.concatenate([lengths, through_signals, through_mixing.ravel()])


def maximise_coregionalised(
    X: Floats, Y: Floats, shape: str, starts: Sequence[Fit], *, shortest: float
) -> CoregionalisedFit:
    """Hyperparameters of zero-mean correlated outputs that maximise the marginal likelihood.

    Args:
        X: (n, d) inputs.
        Y: (n, m) outputs, n greater than m.
        shape: A key of `SHAPES`.
        starts: Independent fits, one for each output: the search begins from the lengthscales of each, and their mean.
        shortest: The least lengthscale, in the unit of its input.

    Raises:
        NumericalError: No start has a positive definite covariance.
    """
    likelihood = CoregionalisedLikelihood(X, Y, shape)
    # A lengthscale that is long for one output has next to no gradient, but may be short for another.
    alive = [np.minimum(start.kernel.lengthscale, MAX_START_LENGTHSCALE_SDS) for start in starts]
    ratios = [start.noise_variance / start.kernel.signal_variance for start in starts]
    alive.append(np.exp(np.mean(np.log(alive), axis=0)))
    ratios.append(float(np.exp(np.mean(np.log(ratios)))))
    tasks = list(zip(alive, ratios, strict=True))
    found = side_by_side(lambda task: _search(likelihood, shape, *task, shortest), tasks)
    best = max(found, key=lambda fit: fit.log_marginal_likelihood)
    if best.log_marginal_likelihood <= -_FAILED:
        raise NumericalError(
            "the outputs have no positive definite covariance.", fix="leave out points that are there twice"
        )
    return best


def _search(
    likelihood: CoregionalisedLikelihood, shape: str, lengthscale: Floats, ratio: float, shortest: float
) -> CoregionalisedFit:
    """From lengthscales (d,) and a ratio of noise to signal, with the covariance that is best if both are alike."""
    X, Y = likelihood.X, likelihood.Y
    (n, d), m = X.shape, Y.shape[1]
    low = np.concatenate([np.full(d, np.log(shortest)), np.full(m, np.log(MIN_SIGNAL)), np.full(m * m, -np.inf)])
    high = np.concatenate(
        [np.full(d, np.log(MAX_LENGTHSCALE_SDS)), np.full(m, np.log(MAX_SIGNAL)), np.full(m * m, np.inf)]
    )
    lengths = np.clip(np.log(lengthscale), low[:d], high[:d])
    A = Kernel(shape, 1.0, np.exp(lengths))(X, X)
    A[np.diag_indices(n)] += ratio
    signal = Y.T @ solve(cholesky(A), Y) / n
    first = np.linalg.inv(cholesky(ratio * signal)).T
    # Coordinates of about unit size: T = first @ (I + E).
    zero = np.concatenate([lengths, np.full(m, -np.log(ratio)), np.zeros(m * m)])

    def theta_of(z: Floats) -> Floats:
        mixing = first @ (np.eye(m) + z[d + m :].reshape(m, m))
        return np.concatenate([z[: d + m], mixing.ravel()])

    def objective(z: Floats) -> tuple[float, Floats]:
        value, gradient = likelihood(theta_of(z))
        mixed = first.T @ gradient[d + m :].reshape(m, m)
        return value, np.concatenate([gradient[: d + m], mixed.ravel()])

    bounds = list(zip(low, high, strict=True))
    options = {"maxiter": MAX_SEARCH_STEPS, "maxcor": 20, "ftol": 1e-9, "gtol": 0.01}
    ended = minimize(objective, np.clip(zero, low, high), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    theta = theta_of(ended.x)
    kernels = tuple(Kernel(shape, float(np.exp(theta[d + i])), np.exp(theta[:d])) for i in range(m))
    mixing = theta[d + m :].reshape(m, m)
    return CoregionalisedFit(kernels, mixing, -float(ended.fun), bool(ended.nit < MAX_SEARCH_STEPS))
