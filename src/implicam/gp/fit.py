"""Maximum marginal likelihood for an exact GP with an ARD kernel.

The signal variance is profiled out: with `A = R + rho I` (R the correlation matrix, rho the noise-to-signal ratio) its
best value is `y^T A^-1 y / n`, so only the log lengthscales and log rho are searched (Rasmussen & Williams eq. 5.8-5.9
with that substitution). One evaluation costs one Cholesky, one inverse and four cheap matrix products, whatever the
number of lengthscales.

Finding the optimum: the likelihood has several local optima, most of them with a lengthscale stuck at its bound. Two
ways lead to a good one: from short lengthscales on all data, where that is cheap; and from the best of a small subset,
every lengthscale pulled back to where its gradient is alive, in coordinates whitened by the Fisher information, which
makes most directions equally steep. `_ways` chooses.
See docs/decisions/0003-gp-fit.md for what was tried.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import blas
from scipy.optimize import minimize

from implicam.errors import NumericalError
from implicam.gp.kernels import SHAPES, Floats, Kernel, squared_distances
from implicam.gp.linalg import cholesky, factor_in_place, invert_in_place, solve
from implicam.threads import side_by_side

MAX_LENGTHSCALE_SDS, MIN_LENGTHSCALE_SDS = 1e6, 0.05  # default lengthscale bounds, in standard deviations of an input
MAX_START_LENGTHSCALE_SDS = 30.0  # beyond this a lengthscale has next to no gradient: a search must not start there
MAX_NOISE_RATIO = 10.0  # largest noise-to-signal ratio
SEARCH_SUBSET_POINTS = 80
MAX_POINTS_FOR_FULL_SEARCH = 100  # every search costs next to nothing
MAX_POINTS_FOR_ONE_FULL_SEARCH = 300  # one search on all data costs little
_FAILED = 1e12


@dataclass(frozen=True, eq=False)
class Fit:
    """Hyperparameters at the optimum, in the units of the data, and how it was reached.

    Attributes:
        kernel: The kernel, with its signal variance and lengthscales.
        noise_variance: Of an output.
        log_marginal_likelihood: At the optimum, in nats.
        evaluations: Number of points -> how often the likelihood was evaluated on so many.
        converged: Whether the search ended by itself.
    """

    kernel: Kernel
    noise_variance: float
    log_marginal_likelihood: float
    evaluations: dict[int, int] = field(default_factory=dict)
    """Number of points -> how often the likelihood was evaluated on so many."""
    converged: bool = True


class ProfiledLikelihood:
    """Negative log marginal likelihood of standardised data, and its gradient.

    Its argument is theta (d + 1,): the log lengthscales and log rho. It is made from X (n, d), y (n,) and the name of a
    kernel shape.
    """

    def __init__(self, X: Floats, y: Floats, shape: str) -> None:
        self.X, self.y, self.shape = X, y, SHAPES[shape]
        n, d = X.shape
        self.evaluations = 0
        # Fresh n x n arrays would cost more in page faults than the arithmetic on them.
        self._d2: Floats = np.empty((n, n))
        self._A: Floats = np.empty((n, n))
        self._upper: Floats = np.triu(np.ones((n, n)))
        self._left, self._right = np.ones((n, d + 2)), np.ones((n, d + 2))

    def __call__(self, theta: Floats) -> tuple[float, Floats]:
        """The value and its gradient.

        Args:
            theta: (d + 1,) log lengthscales and log rho.

        Returns:
            The value, and (d + 1,); a very large value with a zero gradient where the matrix is not positive definite.
        """
        self.evaluations += 1
        n, d = self.X.shape
        rho = float(np.exp(theta[d]))
        scaled = self.X * np.exp(-theta[:d])
        correlation, slope = self.shape(self._squared_distances(scaled))
        # LAPACK sees the transpose: what is upper here is lower there, and the other half stays zero.
        np.multiply(correlation, self._upper, out=self._A)
        self._A.flat[:: n + 1] = 1.0 + rho
        L = self._A.T
        if factor_in_place(L) != 0:
            return _FAILED, np.zeros(d + 1)
        a = solve(L, self.y)
        signal = float(self.y @ a) / n
        value = 0.5 * n * (np.log(2 * np.pi * signal) + 1) + np.log(np.diagonal(L)).sum()

        # gradient = ½ tr((A^-1 - a a^T / signal) dA); only the lower triangle is ever formed
        invert_in_place(L)
        inverse = L
        gradient = np.empty(d + 1)
        gradient[d] = 0.5 * rho * (np.trace(inverse) - a @ a / signal)
        blas.dsyr(-1.0 / signal, a, lower=1, a=inverse, overwrite_a=1)
        M = np.multiply(inverse.T, slope, out=self._A)
        ones = np.ones(n)
        gradient[:d] = (M @ ones + ones @ M) @ scaled**2 - 2 * np.einsum("ij,ij->j", scaled, M @ scaled)
        return float(value), gradient

    def _squared_distances(self, scaled: Floats) -> Floats:
        """r², in one matrix product: [-2x, |x|², 1] [x', 1, |x'|²]^T, written into the buffer."""
        d = scaled.shape[1]
        squares = np.einsum("ij,ij->i", scaled, scaled)
        self._left[:, :d], self._left[:, d] = -2.0 * scaled, squares
        self._right[:, :d], self._right[:, d + 1] = scaled, squares
        np.dot(self._left, self._right.T, out=self._d2)
        return self._d2

    def signal_variance(self, theta: Floats) -> float:
        """The profiled signal variance.

        Args:
            theta: (d + 1,) log lengthscales and log rho.

        Raises:
            NumericalError: The matrix is not positive definite.
        """
        d = self.X.shape[1]
        scaled = self.X * np.exp(-theta[:d])
        A = self.shape(squared_distances(scaled, scaled))[0]
        A.flat[:: len(A) + 1] = 1.0 + np.exp(theta[d])
        return float(self.y @ solve(cholesky(A.T), self.y)) / len(A)

    def fisher_information(self, theta: Floats) -> Floats:
        """Expected second derivatives: ½ tr(A^-1 dA A^-1 dA') less what the profiled signal variance absorbs.

        Args:
            theta: (d + 1,) log lengthscales and log rho.

        Returns:
            (d + 1, d + 1).
        """
        n, d = self.X.shape
        scaled = self.X * np.exp(-theta[:d])
        correlation, slope = self.shape(squared_distances(scaled, scaled))
        inverse = np.linalg.inv(correlation + np.exp(theta[d]) * np.eye(n))
        products = [inverse @ (slope * (x[:, None] - x) ** 2) for x in scaled.T]
        G = np.stack([*products, np.exp(theta[d]) * inverse])
        traces = np.trace(G, axis1=1, axis2=2)
        fisher = 0.5 * np.einsum("aij,bji->ab", G, G, optimize=True) - np.outer(traces, traces) / (2 * n)
        return np.asarray(0.5 * (fisher + fisher.T))


def maximise(
    X: Floats,
    y: Floats,
    shape: str = "squared-exponential",
    *,
    shortest: float = MIN_LENGTHSCALE_SDS,
    start: Fit | None = None,
    seed: int = 0,
) -> Fit:
    """Hyperparameters of a zero-mean GP that maximise the marginal likelihood.

    Args:
        X: (n, d) inputs.
        y: (n,) outputs.
        shape: A key of `SHAPES`.
        shortest: The least lengthscale, in standard deviations of its input: prior knowledge of how smooth the function
            is.
        start: An earlier fit to go on from (a point was added), which is cheaper than a search from no guess.
        seed: Of the subset that a search begins on.

    Raises:
        NumericalError: The arrays do not fit together, hold NaN, or the outputs are all zero.
    """
    if start is not None:
        return _search(X, y, shape, "continued", shortest, start, seed)
    return _best([_search(X, y, shape, way, shortest, None, seed) for way in _ways(len(X))])


def maximise_each(
    X: Floats,
    Y: Floats,
    shape: str = "squared-exponential",
    *,
    shortest: float = MIN_LENGTHSCALE_SDS,
    seed: int = 0,
    done: Callable[[int, int], None] = lambda done, of: None,
    starts: Sequence[Fit] = (),
    anew: bool = True,
) -> list[Fit]:
    """As `maximise`, for each of several outputs, all searches side by side.

    Args:
        X: (n, d) inputs.
        Y: (n, m) outputs.
        shape: A key of `SHAPES`.
        shortest: The least lengthscale, in standard deviations of its input.
        seed: Of the subset that a search begins on.
        done: Called with the numbers of finished and of all searches.
        starts: Earlier fits, one for each output, to go on from.
        anew: Whether to search from no guess as well; without `starts` that is always done.

    Returns:
        For each output the most probable result.

    Raises:
        NumericalError: As `maximise`.
    """
    ended: list[int] = []
    columns = np.asarray(Y).T
    ways = _ways(len(X)) if anew or not starts else ()
    tasks: list[tuple[Floats, str, Fit | None]] = [(y, way, None) for way in ways for y in columns]
    tasks += [(y, "continued", start) for y, start in zip(columns, starts, strict=False)]

    def one(task: tuple[Floats, str, Fit | None]) -> Fit:
        y, way, start = task
        fit = _search(X, y, shape, way, shortest, start, seed)
        ended.append(1)
        done(len(ended), len(tasks))
        return fit

    fits = side_by_side(one, tasks)
    outputs = np.shape(Y)[1]
    return [_best(fits[i::outputs]) for i in range(outputs)]


def _ways(n: int) -> tuple[str, ...]:
    if n <= MAX_POINTS_FOR_FULL_SEARCH:
        return "from_short", "from_subset"  # the longer first, so that the last ones to end are short
    return ("from_short",) if n <= MAX_POINTS_FOR_ONE_FULL_SEARCH else ("from_subset",)


def _best(fits: list[Fit]) -> Fit:
    """The best of several searches of one output, with the evaluations of all."""
    counts: dict[int, int] = {}
    for fit in fits:
        for n, count in fit.evaluations.items():
            counts[n] = counts.get(n, 0) + count
    return replace(max(fits, key=lambda fit: fit.log_marginal_likelihood), evaluations=counts)


def _search(X: Floats, y: Floats, shape: str, way: str, shortest: float, start: Fit | None, seed: int) -> Fit:
    """One search on standardised data, its result in the units of the data."""
    X, y = np.asarray(X, dtype=np.float64), np.asarray(y, dtype=np.float64)
    _check(X, y)
    spread = X.std(axis=0)
    spread[spread == 0] = 1.0
    size = float(np.sqrt(np.mean(y**2)))
    search = _Search((X - X.mean(axis=0)) / spread, y / size, shape, shortest, seed)
    if start is None:
        theta, value = search.from_short() if way == "from_short" else search.from_subset()
    else:
        theta, value = search.continued(start, spread)
    n, d = X.shape
    signal = search.all_data.signal_variance(theta) * size**2
    return Fit(
        Kernel(shape, signal, np.exp(theta[:d]) * spread),
        float(np.exp(theta[d])) * signal,
        -value - n * np.log(size),
        search.evaluations,
        search.converged,
    )


class _Search:
    """One search for the optimum, on standardised data."""

    def __init__(self, X: Floats, y: Floats, shape: str, shortest: float, seed: int) -> None:
        n, d = X.shape
        self.X, self.y, self.shape, self.d = X, y, shape, d
        self.all_data = ProfiledLikelihood(X, y, shape)
        self.subset = np.random.default_rng(seed).permutation(n)[:SEARCH_SUBSET_POINTS]
        # Below this ratio rounding, about n times 1e-16, would make the Cholesky fail.
        quietest = max(1e-12, 20 * n * np.finfo(float).eps)
        self.low = np.append(np.full(d, np.log(shortest)), np.log(quietest))
        self.high = np.append(np.full(d, np.log(MAX_LENGTHSCALE_SDS)), np.log(MAX_NOISE_RATIO))
        self.evaluations: dict[int, int] = {}
        self.converged = True

    def from_subset(self) -> tuple[Floats, float]:
        """From the best that several starts find on the subset, whitened: quick, and seldom far from the best."""
        few = ProfiledLikelihood(self.X[self.subset], self.y[self.subset], self.shape)
        starts = [self._isotropic(3.0, 1e-6), self._isotropic(10.0, 1e-8)]
        theta, _ = min((self._descend(few, start, coarse=True) for start in starts), key=lambda found: found[1])
        return self._descend(self.all_data, theta)

    def from_short(self) -> tuple[Floats, float]:
        """From short lengthscales, unwhitened: the inputs are dropped one by one, which often ends better.

        The lower bound holds at the end only, because the way there may lead through shorter ones.
        """
        bound, self.low = self.low, np.minimum(self.low, np.log(MIN_LENGTHSCALE_SDS))
        self.low[-1] = bound[-1]
        theta, value = self._descend(self.all_data, self._isotropic(1.0, 1e-4), whiten=False)
        self.low = bound
        return (theta, value) if (theta >= bound).all() else self._descend(self.all_data, np.maximum(theta, bound))

    def continued(self, start: Fit, spread: Floats) -> tuple[Floats, float]:
        """From the optimum of nearly the same data."""
        ratio = start.noise_variance / start.kernel.signal_variance
        theta = np.append(np.log(start.kernel.lengthscale / spread), np.log(ratio))
        return self._descend(self.all_data, theta, revive=False)

    def _isotropic(self, lengthscale: float, rho: float) -> Floats:
        # Distances grow with the square root of the dimension, and so must the lengthscale.
        return np.append(np.full(self.d, np.log(lengthscale * np.sqrt(self.d / 4))), np.log(rho))

    def _descend(
        self,
        likelihood: ProfiledLikelihood,
        theta: Floats,
        *,
        coarse: bool = False,
        whiten: bool = True,
        revive: bool = True,
    ) -> tuple[Floats, float]:
        start = np.clip(theta, self.low, self.high)
        if revive:
            start[: self.d] = np.minimum(start[: self.d], max(np.log(MAX_START_LENGTHSCALE_SDS), self.low[0]))
        unwhiten = self._whitening(start, len(likelihood.y)) if whiten else np.eye(self.d + 1)

        def whitened(z: Floats) -> tuple[float, Floats]:
            wanted = start + unwhiten @ z
            theta = np.clip(wanted, self.low, self.high)
            value, gradient = likelihood(theta)
            # A clipped direction is flat; without this the line search would run along it for ever.
            return value, unwhiten.T @ np.where(theta == wanted, gradient, 0.0)

        before = likelihood.evaluations
        # In whitened coordinates half the squared gradient is about the distance to the optimum in nats.
        options = {"gtol": 0.05 if coarse else 0.01, "ftol": 1e-7, "maxcor": 20, "maxiter": 200, "maxls": 12}
        found = minimize(whitened, np.zeros(self.d + 1), jac=True, method="L-BFGS-B", options=options)
        n = len(likelihood.y)
        self.evaluations[n] = self.evaluations.get(n, 0) + likelihood.evaluations - before
        if likelihood is self.all_data:
            self.converged = bool(found.fun < _FAILED and found.nit < options["maxiter"])
        return np.clip(start + unwhiten @ found.x, self.low, self.high), float(found.fun)

    def _whitening(self, theta: Floats, n: int) -> Floats:
        """Columns that turn unit steps into equally steep ones; the added 1 keeps unseen directions modest."""
        few = ProfiledLikelihood(self.X[self.subset], self.y[self.subset], self.shape)
        fisher = few.fisher_information(theta) * (n / len(self.subset))
        eigenvalues, vectors = np.linalg.eigh(fisher + np.eye(self.d + 1))
        return np.asarray(vectors / np.sqrt(np.maximum(eigenvalues, 1.0)))


def _check(X: Floats, y: Floats) -> None:
    if X.ndim != 2 or y.shape != (len(X),) or len(X) < 2:
        raise NumericalError(
            f"cannot learn from inputs of shape {X.shape} and outputs of shape {y.shape}.",
            fix="give X (n, d) and y (n,) with n of at least 2",
        )
    if not (np.isfinite(X).all() and np.isfinite(y).all()):
        raise NumericalError("an input or an output is not finite.", fix="leave out points with NaN or infinity")
    if np.mean(y**2) == 0:
        raise NumericalError(
            "all outputs are zero, so no variance can be learned.", fix="give outputs that vary between the points"
        )
