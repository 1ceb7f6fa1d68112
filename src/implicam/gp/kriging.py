"""Universal kriging of several outputs with one kernel: a mean that is linear in given functions, integrated out.

Model, for outputs Y (n, m) at inputs X (n, d):

    Y = H B + F + E,    columns of F and E:  cov(F) = R (x) Sigma,  cov(E) = rho I (x) Sigma

R is the correlation matrix of an ARD kernel, H (n, p) the functions of the mean, B (p, m) their coefficients with a
flat prior, Sigma (m, m) the covariance of the outputs with the Jeffreys prior. B and Sigma are integrated out: what is
left is the restricted likelihood of the lengthscales and of rho (Patterson & Thompson 1971), and a prediction whose
covariance is that of a matrix-t distribution. Lengthscales have a log-normal prior. What is uncertain of them enters
the predictions to first order (Zimmerman & Cressie 1992), from the curvature at the optimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from implicam.errors import NumericalError
from implicam.gp.kernels import SHAPES, Floats, Kernel, squared_distances
from implicam.gp.linalg import cholesky, factor_in_place, invert_in_place, solve_lower

MAX_POINTS_FOR_FULL_SEARCH = 100
"""Beyond so many points the search begins on a part of them."""
STARTS = ((0.0, -7.0), (0.7, -12.0))
"""Where a search begins: every lengthscale so many prior sd above its median, and the log of rho."""
MAX_LOG_RHO = 9.0
"""Largest log of rho: beyond, nothing but the mean is learned."""
MIN_CURVATURE = 0.25
"""Of the log posterior, in prior standard deviations: a direction is never less certain than twice its prior."""
DIFFERENCE_STEP_SDS = 1e-3
"""Of the finite differences of the gradient, whose unit is a prior standard deviation."""
_FAILED = 1e12


@dataclass(frozen=True, eq=False)
class LengthscalePrior:
    """The log-normal prior of the lengthscales.

    Attributes:
        median: (d,).
        covariance: (d, d) of the logs.
        shortest: No lengthscale is shorter.
    """

    median: Floats
    covariance: Floats
    shortest: float = 1e-6

    @property
    def root(self) -> Floats:
        """(d, d) lower Cholesky factor of the covariance."""
        return np.asarray(np.linalg.cholesky(self.covariance))

    def log_lengthscale(self, t: Floats) -> tuple[Floats, Floats]:
        """The log lengthscales of whitened coordinates.

        Args:
            t: (d,) standard normal under the prior.

        Returns:
            (d,) log lengthscales, and their slope (d, d), which is zero where the bound holds.
        """
        wanted, low = np.log(self.median) + self.root @ t, np.log(self.shortest)
        return np.maximum(wanted, low), self.root * (wanted > low)[:, None]

    def whitened(self, lengthscale: Floats) -> Floats:
        """The inverse of `log_lengthscale`.

        Args:
            lengthscale: (d,).

        Returns:
            (d,) whitened coordinates.
        """
        return np.asarray(np.linalg.solve(self.root, np.log(lengthscale / self.median)))


class RestrictedPosterior:
    """Negative log posterior and its gradient, up to a constant.

    Its argument is [t (d,), log rho], t the whitened log lengthscales. It is made from X (n, d), Y (n, m), H (n, p),
    the name of a kernel shape and a prior.
    """

    def __init__(self, X: Floats, Y: Floats, H: Floats, shape: str, prior: LengthscalePrior) -> None:
        self.X, self.Y, self.H, self.shape, self.prior = X, Y, H, SHAPES[shape], prior
        self.freedom = len(X) - H.shape[1]
        self.evaluations = 0

    def __call__(self, theta: Floats) -> tuple[float, Floats]:
        """The value and its gradient.

        Args:
            theta: (d + 1,) whitened log lengthscales and log rho.

        Returns:
            The value, and (d + 1,); a very large value with a zero gradient where the matrix is not positive definite.
        """
        self.evaluations += 1
        n, m = self.Y.shape
        t, rho = theta[:-1], float(np.exp(theta[-1]))
        log_lengthscale, turn = self.prior.log_lengthscale(t)
        scaled = self.X * np.exp(-log_lengthscale)
        A, slope = self.shape(squared_distances(scaled, scaled))
        A = np.array(A, order="F")
        A.flat[:: n + 1] = 1.0 + rho
        if factor_in_place(A) != 0:
            return _FAILED, np.zeros(len(theta))
        half_log_det = np.log(np.diagonal(A)).sum()
        inverse = _inverse_from_factor(A)
        AH, AY = inverse @ self.H, inverse @ self.Y
        M = self.H.T @ AH
        a = AY - AH @ np.linalg.solve(M, AH.T @ self.Y)
        S = self.Y.T @ a / self.freedom
        sign, log_det_S = np.linalg.slogdet(S)
        if sign <= 0 or not np.isfinite(log_det_S):
            return _FAILED, np.zeros(len(theta))
        value = 0.5 * self.freedom * log_det_S + m * (half_log_det + 0.5 * np.linalg.slogdet(M)[1]) + 0.5 * t @ t

        # gradient = 1/2 tr(W dA), W = m P - a S^-1 a^T with P the inverse less its part along H
        W = m * (inverse - AH @ np.linalg.solve(M, AH.T)) - a @ np.linalg.solve(S, a.T)
        gradient = np.empty(len(theta))
        gradient[-1] = 0.5 * rho * np.trace(W)
        W *= slope
        by_log_lengthscale = W.sum(axis=1) @ scaled**2 - np.einsum("ij,ij->j", scaled, W @ scaled)
        gradient[:-1] = turn.T @ by_log_lengthscale + t
        return float(value), gradient


def _inverse_from_factor(L: Floats) -> Floats:
    """(n, n) the inverse of L L^T, both halves; L is overwritten."""
    invert_in_place(L)
    lower = np.tril(L)
    lower += np.tril(L, -1).T
    return lower


@dataclass(frozen=True, eq=False)
class Smoothness:
    """What is learned of the kernel.

    Attributes:
        shape: A key of `SHAPES`.
        lengthscale: (d,).
        noise_ratio: rho.
        root: (d + 1, d + 1) of the covariance of [log lengthscale, log rho].
        value: The negative log posterior there.
    """

    shape: str
    lengthscale: Floats
    noise_ratio: float
    root: Floats
    value: float = np.nan


def maximise_posterior(
    X: Floats,
    Y: Floats,
    H: Floats,
    shape: str,
    prior: LengthscalePrior,
    *,
    start: Smoothness | None = None,
    anew: bool = True,
    seed: int = 0,
) -> Smoothness:
    """The most probable lengthscales and noise ratio.

    Args:
        X: (n, d) inputs.
        Y: (n, m) outputs.
        H: (n, p) functions of the mean.
        shape: A key of `SHAPES`.
        prior: Of the lengthscales.
        start: An earlier result of nearly the same data to go on from.
        anew: Whether to search from no guess as well; without `start` that is always done.
        seed: Of the part of many points that a search begins on.

    Raises:
        NumericalError: No search succeeded.
    """
    n, d = X.shape
    everything = RestrictedPosterior(X, Y, H, shape, prior)
    # Below this ratio rounding, about n times 1e-16, would make the Cholesky fail.
    quietest = np.log(max(1e-12, 20 * n * np.finfo(float).eps))
    starts = (
        [np.append(np.full(d, t), max(log_rho, quietest)) for t, log_rho in STARTS] if anew or start is None else []
    )
    if starts and n > MAX_POINTS_FOR_FULL_SEARCH:
        part = np.random.default_rng(seed).permutation(n)[:MAX_POINTS_FOR_FULL_SEARCH]
        few = RestrictedPosterior(X[part], Y[part], H[part], shape, prior)
        starts = [_descend(few, starts, quietest)[0]]
    if start is not None:
        starts.append(np.append(prior.whitened(start.lengthscale), np.log(start.noise_ratio)))
    theta, value = _descend(everything, starts, quietest)
    log_lengthscale, turn = prior.log_lengthscale(theta[:-1])
    jacobian = np.eye(d + 1)
    jacobian[:d, :d] = turn
    root = jacobian @ _root_of_inverse(_curvature(everything, theta))
    return Smoothness(shape, np.exp(log_lengthscale), float(np.exp(theta[-1])), root, value)


def _descend(posterior: RestrictedPosterior, starts: Sequence[Floats], quietest: float) -> tuple[Floats, float]:
    """The best of searches from several starts."""
    d = posterior.X.shape[1]
    bounds = [(-12.0, 12.0)] * d + [(quietest, MAX_LOG_RHO)]
    options = {"ftol": 1e-8, "gtol": 1e-3, "maxcor": 20, "maxiter": 200}
    found = [minimize(posterior, s, jac=True, method="L-BFGS-B", bounds=bounds, options=options) for s in starts]
    best = min(found, key=lambda one: float(one.fun))
    if best.fun >= _FAILED:
        raise NumericalError(
            "no lengthscales were found with which the outputs can be learned.",
            why="an output is an exact function of the others, or rounding swallows the differences of the inputs",
            fix="add known points elsewhere, and look for repeated ones",
        )
    return np.asarray(best.x), float(best.fun)


def _curvature(posterior: RestrictedPosterior, theta: Floats) -> Floats:
    """(d + 1, d + 1) second derivatives, by differences of the gradient away from where it fails."""
    _, here = posterior(theta)
    rows = []
    for k in range(len(theta)):
        away = theta.copy()
        away[k] += DIFFERENCE_STEP_SDS
        value, there = posterior(away)
        rows.append((there - here) / DIFFERENCE_STEP_SDS if value < _FAILED else np.zeros(len(theta)))
    H = np.array(rows)
    return np.asarray(0.5 * (H + H.T))


def _root_of_inverse(curvature: Floats) -> Floats:
    """C with C C^T the inverse, no direction less certain than MIN_CURVATURE allows."""
    values, vectors = np.linalg.eigh(curvature)
    return np.asarray(vectors / np.sqrt(np.maximum(values, MIN_CURVATURE)))


@dataclass(frozen=True, eq=False)
class Kriging:
    """The model conditioned on its data; build it with `condition`.

    Attributes:
        kernel: Of unit variance.
        smoothness: Its lengthscales, the noise ratio, and how uncertain they are.
        X: (n, d) inputs.
        Y: (n, m) outputs.
        H: (n, p) functions of the mean.
        L: (n, n) factor of A = R + rho I.
        G: (p, p) factor of H^T A^-1 H.
        a: (n, m) A^-1 (Y - H B).
        coefficients: (p, m) those of the mean, B.
        sigma: (m, m) covariance of an output whose variance factor is one, the uncertainty of Sigma included.
    """

    kernel: Kernel
    smoothness: Smoothness
    X: Floats
    Y: Floats
    H: Floats
    L: Floats
    G: Floats
    a: Floats
    coefficients: Floats
    sigma: Floats

    @classmethod
    def condition(cls, smoothness: Smoothness, X: Floats, Y: Floats, H: Floats) -> Kriging:
        """Condition on data.

        Args:
            smoothness: The lengthscales and the noise ratio.
            X: (n, d) inputs.
            Y: (n, m) outputs.
            H: (n, p) functions of the mean.

        Raises:
            NumericalError: The covariance matrix is not positive definite.
        """
        kernel = Kernel(smoothness.shape, 1.0, smoothness.lengthscale)
        K = kernel(X, X)
        K[np.diag_indices_from(K)] = 1.0 + smoothness.noise_ratio
        L = cholesky(K.T)
        whiteH, whiteY = solve_lower(L, H), solve_lower(L, Y)
        G = cholesky(np.array(whiteH.T @ whiteH, order="F"))
        along = solve_lower(G, whiteH.T @ whiteY)
        coefficients = np.asarray(np.linalg.solve(G.T, along), dtype=np.float64)
        residual = whiteY - whiteH @ coefficients
        (n, m), p = Y.shape, H.shape[1]
        # covariance of a matrix-t: Sigma has the Jeffreys prior, and n - p residuals have told of it
        sigma = residual.T @ residual / max(n - p - m - 1, 1)
        a = np.asarray(np.linalg.solve(L.T, residual), dtype=np.float64)
        return cls(kernel, smoothness, X, Y, H, L, G, a, coefficients, 0.5 * (sigma + sigma.T))

    def __len__(self) -> int:
        return len(self.X)

    @property
    def noise_variance(self) -> float:
        """Noise variance of an output, in units of the kernel's variance."""
        return self.smoothness.noise_ratio

    def explained(self, X: Floats) -> Floats:
        """V of places: their covariance is `kernel + drift^T drift - V^T V`.

        Args:
            X: (k, d) inputs.

        Returns:
            (n, k).
        """
        return solve_lower(self.L, self.kernel(self.X, X))

    def drift(self, H: Floats, explained: Floats) -> Floats:
        """The uncertainty of the mean at places.

        Args:
            H: (k, p) functions of the mean there.
            explained: (n, k) as of `explained`.

        Returns:
            (p, k).
        """
        return solve_lower(self.G, H.T - solve_lower(self.L, self.H).T @ explained)

    def predict(self, X: Floats, H: Floats) -> tuple[Floats, Floats, Floats]:
        """Predict the outputs at places, without the noise of a new output.

        Args:
            X: (k, d) inputs.
            H: (k, p) functions of the mean there.

        Returns:
            (k, m) mean; (k,) variance factor, by which `sigma` is to be multiplied; (k, m, m) what uncertain
            lengthscales add to the covariance.
        """
        V = self.explained(X)
        W = self.drift(H, V)
        factor = 1.0 - np.einsum("ij,ij->j", V, V) + np.einsum("ij,ij->j", W, W)
        mean = self.kernel(X, self.X) @ self.a + H @ self.coefficients
        moved = np.einsum("jc,kjm->kcm", self.smoothness.root, self._by_hyperparameters(X, H))
        return mean, np.maximum(factor, 0.0), np.einsum("kcm,kcl->kml", moved, moved)

    def _by_hyperparameters(self, X: Floats, H: Floats) -> Floats:
        """(k, d + 1, m) derivatives of the mean by [log lengthscale, log rho]: `dk a - (k P + ...) dA a`."""
        own, new = self.X / self.kernel.lengthscale, X / self.kernel.lengthscale
        d, m = own.shape[1], self.Y.shape[1]
        back, coefficients = self.constants_by_hyperparameters()
        correlation, slope = SHAPES[self.kernel.shape](squared_distances(new, own))
        found = -(correlation @ back + H @ coefficients).reshape(len(X), d + 1, m)
        found[:, :d] += _weighted_squares(slope, new, own, self.a)
        return np.asarray(found)

    def constants_by_hyperparameters(self) -> tuple[Floats, Floats]:
        """What the derivatives of the mean by [log lengthscale, log rho] have in common at all places.

        Returns:
            (n, (d + 1) m) and (p, (d + 1) m): minus the correlations with the known inputs times the first, minus the
            functions of the mean times the second, is what the known outputs answer to a change.
        """
        own = self.X / self.kernel.lengthscale
        (n, d), m = own.shape, self.Y.shape[1]
        among = np.empty((n, d + 1, m))
        among[:, :d] = _weighted_squares(SHAPES[self.kernel.shape](squared_distances(own, own))[1], own, own, self.a)
        among[:, d] = self.noise_variance * self.a
        flat = among.reshape(n, -1)
        whiteH, white = solve_lower(self.L, self.H), solve_lower(self.L, flat)
        coefficients = np.linalg.solve(self.G.T, solve_lower(self.G, whiteH.T @ white))
        back = np.linalg.solve(self.L.T, white - whiteH @ coefficients)
        return np.asarray(back), np.asarray(coefficients)

    def leave_one_out(self) -> tuple[Floats, Floats]:
        """Each output predicted from all others: `(P Y)_i / P_ii` and `1 / P_ii`.

        Returns:
            (n, m) errors, and (n,) the factor of their covariance, noise included.
        """
        whiteH = solve_lower(self.L, self.H)
        root = solve_lower(self.L, np.eye(len(self)))
        along = root.T @ np.linalg.solve(self.G, whiteH.T).T
        precision = np.einsum("ji,ji->i", root, root) - np.einsum("ij,ij->i", along, along)
        return self.a / precision[:, None], 1.0 / precision


def _weighted_squares(weights: Floats, A: Floats, B: Floats, a: Floats) -> Floats:
    """(k, d, m) `sum_i weights_ki (A_kj - B_ij)^2 a_im`, without an array of k x n x d."""
    n, d = B.shape
    by_square = (B[:, :, None] ** 2 * a[:, None]).reshape(n, -1)
    by_value = (B[:, :, None] * a[:, None]).reshape(n, -1)
    k, m = len(A), a.shape[1]
    return np.asarray(
        (weights @ by_square).reshape(k, d, m)
        - 2 * A[:, :, None] * (weights @ by_value).reshape(k, d, m)
        + A[:, :, None] ** 2 * (weights @ a)[:, None]
    )
