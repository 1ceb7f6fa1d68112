"""What inverse-gp learns, in standardised units: one smooth map for all three coordinates, or the paper's three maps.

The smooth map has a mean that is linear in the three leading principal components of the pixels (a position has three
degrees of freedom, and so has what the cameras see of it), one kernel for x, y and z with a joint covariance, and
priors that prefer long ranges. See docs/decisions/0017-inverse-gp.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from implicam.calibrators.inverse_gp_settings import DEFAULT_SETTINGS, InverseGPSettings
from implicam.dataset import Floats
from implicam.gp import GaussianProcess, Kriging, LengthscalePrior, Smoothness, maximise_posterior
from implicam.threads import blas_threads, cores, side_by_side

DEGREES_OF_FREEDOM = 3
"""Of a position, and so of the pixels of any number of cameras."""
MAX_POINTS_ON_ONE_THREAD = 3000
"""Points up to which several BLAS threads may lose more by waiting for each other than they gain."""


class Part(NamedTuple):
    """A Gaussian process whose variance, its noise included, times `share` (3, 3) is part of a position's covariance,
    in standardised units; outputs: how many it stands for."""

    process: GaussianProcess | Kriging
    share: Floats
    outputs: int


class Map(Protocol):
    """From standardised pixels to standardised positions."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """Its Gaussian processes."""

    def inputs(self, X: Floats) -> Floats:
        """What the processes take.

        Args:
            X: (k, d) standardised pixels.

        Returns:
            (k, d).
        """

    def drift(self, X: Floats, explained: Sequence[Floats]) -> list[Floats]:
        """What is uncertain of the mean of each part.

        Args:
            X: (k, d) standardised pixels.
            explained: Of each part (n, k) what its known points explain: L^-1 K(known, X).

        Returns:
            Of each part (p, k).
        """

    def uncertain(self, X: Floats) -> Floats:
        """What is in the covariance beside the parts.

        Args:
            X: (k, d) standardised pixels.

        Returns:
            (k, 3, 3) in standardised units.
        """

    def predict(self, X: Floats) -> tuple[Floats, Floats]:
        """Predict new noisy positions.

        Args:
            X: (k, d) standardised pixels.

        Returns:
            Mean (k, 3) and covariance (k, 3, 3), in standardised units.
        """

    @property
    def noise(self) -> Floats:
        """(3, 3) what is noise of the covariance that `predict` states: pixel noise, as it moves a position."""

    def leave_one_out(self) -> tuple[Floats, Floats]:
        """Errors (n, 3) of the known points, each predicted from all others, and their variances (n, 3)."""


@dataclass(frozen=True, eq=False)
class ThreeMaps:
    """Three Gaussian processes that know nothing of each other: the paper's, one an axis; or, coregionalised, of three
    mixtures of the axes.

    Attributes:
        processes: The three.
        axes: (3, 3) what each adds to x, y and z: positions are `outputs @ axes`. Unity for one an axis.
    """

    processes: tuple[GaussianProcess, ...]
    axes: Floats

    @property
    def parts(self) -> tuple[Part, ...]:
        """The processes, each with its share of the covariance."""
        return tuple(Part(gp, np.outer(axis, axis), 1) for gp, axis in zip(self.processes, self.axes, strict=True))

    def inputs(self, X: Floats) -> Floats:
        """The pixels themselves.

        Args:
            X: (k, d) standardised pixels.

        Returns:
            X itself.
        """
        return X

    def drift(self, X: Floats, explained: Sequence[Floats]) -> list[Floats]:
        """Nothing: their mean is known.

        Args:
            X: (k, d) standardised pixels.
            explained: As of `Map`; only their number counts.

        Returns:
            Of each part (0, k).
        """
        return [np.zeros((0, len(X))) for _ in explained]

    def uncertain(self, X: Floats) -> Floats:
        """Nothing: hyperparameters are taken as known.

        Args:
            X: (k, d) standardised pixels.

        Returns:
            (k, 3, 3) zeros.
        """
        return np.zeros((len(X), 3, 3))

    def predict(self, X: Floats) -> tuple[Floats, Floats]:
        """The processes side by side; with one an axis the covariance is diagonal.

        Args:
            X: (k, d) standardised pixels.

        Returns:
            Mean (k, 3) and covariance (k, 3, 3) of new noisy positions, in standardised units.
        """

        def one(gp: GaussianProcess) -> tuple[Floats, Floats]:
            mean, variance = gp.predict(X)
            return mean, variance + gp.noise_variance

        answers = side_by_side(one, self.processes)
        means = np.stack([mean for mean, _ in answers], axis=1)
        variances = np.stack([variance for _, variance in answers], axis=1)
        return means @ self.axes, np.asarray(np.einsum("nk,kij->nij", variances, self._shares), dtype=np.float64)

    @property
    def noise(self) -> Floats:
        """(3, 3) of the processes together."""
        return np.asarray(np.einsum("k,kij->ij", [gp.noise_variance for gp in self.processes], self._shares))

    @property
    def _shares(self) -> Floats:
        return np.stack([np.outer(axis, axis) for axis in self.axes])

    def leave_one_out(self) -> tuple[Floats, Floats]:
        """In closed form, hyperparameters kept."""
        pairs = [(gp.y, *gp.leave_one_out()) for gp in self.processes]
        errors = np.stack([y - mean for y, mean, _ in pairs], axis=1)
        variances = np.stack([variance for *_, variance in pairs], axis=1)
        return errors @ self.axes, variances @ self.axes**2


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """One process for all three coordinates. basis (d, d): the process takes `pixels @ basis`; axes (d, q): the mean
    is linear in `pixels @ axes`."""

    kriging: Kriging
    basis: Floats
    axes: Floats

    @classmethod
    def condition(
        cls,
        smoothness: Smoothness,
        basis: Floats,
        spread: Floats,
        X: Floats,
        Y: Floats,
        settings: InverseGPSettings = DEFAULT_SETTINGS,
    ) -> SmoothMap:
        """Condition on known points.

        Args:
            smoothness: Lengthscales and noise, in the coordinates of the basis.
            basis: (d, d) the process takes `pixels @ basis`.
            spread: (d,) standard deviations of the pixels.
            X: (n, d) standardised pixels.
            Y: (n, 3) standardised positions.
            settings: How many residuals the linear mean must leave.

        Returns:
            The map.
        """
        axes = _mean_axes(X, spread, settings)
        with few_threads(len(X)):
            return cls(Kriging.condition(smoothness, X @ basis, Y, _with_one(X @ axes)), basis, axes)

    @property
    def parts(self) -> tuple[Part, ...]:
        """A single one."""
        return (Part(self.kriging, self.kriging.sigma, 3),)

    def inputs(self, X: Floats) -> Floats:
        """Standardised pixels in the basis that was chosen.

        Args:
            X: (k, d) standardised pixels.

        Returns:
            (k, d).
        """
        return X @ self.basis

    def drift(self, X: Floats, explained: Sequence[Floats]) -> list[Floats]:
        """What is uncertain of the linear mean.

        Args:
            X: (k, d) standardised pixels.
            explained: Of its one part (n, k) what the known points explain.

        Returns:
            Of its one part (q + 1, k), q being the directions in which the mean is linear.
        """
        return [self.kriging.drift(_with_one(X @ self.axes), explained[0])]

    def uncertain(self, X: Floats) -> Floats:
        """What is not known of the lengthscales.

        Args:
            X: (k, d) standardised pixels.

        Returns:
            (k, 3, 3) in standardised units.
        """
        return self._at(X)[2]

    def predict(self, X: Floats) -> tuple[Floats, Floats]:
        """Predict new noisy positions, with the covariance of all three coordinates.

        Args:
            X: (k, d) standardised pixels.

        Returns:
            Mean (k, 3) and covariance (k, 3, 3), in standardised units.
        """
        mean, factor, moved = self._at(X)
        return mean, self.kriging.sigma * (factor + self.kriging.noise_variance)[:, None, None] + moved

    def _at(self, X: Floats, block: int = 2000) -> tuple[Floats, Floats, Floats]:
        pieces = [X[i : i + block] for i in range(0, max(1, len(X)), block)]
        with few_threads(len(self.kriging)):
            found = [self.kriging.predict(self.inputs(x), _with_one(x @ self.axes)) for x in pieces]
        mean, factor, moved = (np.concatenate(values) for values in zip(*found, strict=True))
        return mean, factor, moved

    @property
    def noise(self) -> Floats:
        """(3, 3) with the covariance of the coordinates."""
        return np.asarray(self.kriging.sigma * self.kriging.noise_variance, dtype=np.float64)

    def leave_one_out(self) -> tuple[Floats, Floats]:
        """In closed form, lengthscales kept."""
        errors, factor = self.kriging.leave_one_out()
        return errors, factor[:, None] * np.diag(self.kriging.sigma)


def _with_one(X: Floats) -> Floats:
    return np.column_stack([np.ones(len(X)), X])


def _principal(X: Floats, spread: Floats) -> tuple[Floats, Floats]:
    """Directions (d, d) of the pixels as they are, unscaled, for their noise is alike in all of them; for standardised
    X. And the standard deviations (d,) along them, in that of a middling pixel coordinate."""
    weights = spread / np.sqrt(np.mean(spread**2))
    _, sizes, directions = np.linalg.svd(X * weights)
    sd = np.zeros(X.shape[1])
    sd[: len(sizes)] = sizes / np.sqrt(len(X))
    return weights[:, None] * directions.T, sd


def _mean_axes(X: Floats, spread: Floats, settings: InverseGPSettings) -> Floats:
    """(d, q) what the mean is linear in: up to three principal components, of unit size; fewer with few points."""
    directions, sd = _principal(X, spread)
    q = min(DEGREES_OF_FREEDOM, int(np.sum(sd > 1e-9 * sd[0])), max(0, len(X) - 1 - settings.min_residuals))
    return directions[:, :q] / sd[:q]


def _bases(
    X: Floats, spread: Floats, shortest: float, settings: InverseGPSettings
) -> list[tuple[Floats, LengthscalePrior]]:
    """The coordinates that lengthscales are given in, and their priors. Principal axes: what is a small difference of
    large pixels (depth, for two cameras) has a size of its own. Pixel by pixel: with few points of many cameras it is
    cameras that differ in what they are worth."""
    d = X.shape[1]
    common, own = settings.common_lengthscale_prior_log_sd, settings.own_lengthscale_prior_log_sd
    directions, sd = _principal(X, spread)
    q = min(DEGREES_OF_FREEDOM, d)
    unit = np.full(d, sd[q - 1])
    unit[:q] = sd[:q]
    leading = np.arange(d) < q
    rest = ~leading
    covariance = np.diag(np.where(leading, common**2, own**2)) + common**2 * np.outer(rest, rest)
    principal = directions / np.maximum(unit, 1e-9 * sd[0])
    along_axes = np.full(d, settings.axis_lengthscale_prior_median_sds)
    found = [(principal, LengthscalePrior(along_axes, covariance, shortest))]
    if len(X) <= settings.max_points_for_both_bases:
        alike = common**2 * np.ones((d, d)) + own**2 * np.eye(d)
        of_pixels = np.full(d, settings.pixel_lengthscale_prior_median_sds)
        found.append((np.eye(d), LengthscalePrior(of_pixels, alike, shortest)))
    return found


def learn_smooth(
    X: Floats,
    Y: Floats,
    spread: Floats,
    shape: str,
    shortest: float,
    seed: int,
    settings: InverseGPSettings = DEFAULT_SETTINGS,
    start: tuple[Smoothness, bool] | None = None,
    anew: bool = True,
) -> tuple[Smoothness, Floats]:
    """Learn how smooth the map is, in the more probable of the bases.

    Args:
        X: (n, d) standardised pixels.
        Y: (n, 3) standardised positions.
        spread: (d,) standard deviations of the pixels.
        shape: Name of the kernel.
        shortest: Bound of every lengthscale.
        seed: Of the part of many points that a search begins on.
        settings: The priors.
        start: An earlier smoothness, and whether it was along principal axes.
        anew: Search from no guess as well, in both bases; without `start` that is always done.

    Returns:
        The smoothness, and the basis (d, d) that it is in.

    Raises:
        NumericalError: No search succeeded.
    """
    bases = _bases(X, spread, shortest, settings)
    H = _with_one(X @ _mean_axes(X, spread, settings))

    def one(number: int) -> tuple[Smoothness, Floats]:
        basis, prior = bases[number]
        known = start[0] if start is not None and start[1] == (number == 0) else None
        return maximise_posterior(X @ basis, Y, H, shape, prior, start=known, anew=anew, seed=seed), basis

    wanted = range(len(bases))
    if start is not None and not anew:
        wanted = range(0, 1) if start[1] or len(bases) == 1 else range(1, 2)
    with few_threads(len(X)):
        found = [one(number) for number in wanted]
    return min(found, key=lambda pair: pair[0].value)


def few_threads(points: int) -> AbstractContextManager[None]:
    """One BLAS thread for matrices of so few points, on which several only wait for each other (threads.py).

    Args:
        points: How many known points there are.

    Returns:
        A context in which BLAS has this many threads.
    """
    return blas_threads(1 if points <= MAX_POINTS_ON_ONE_THREAD else cores())


def is_principal(basis: Floats) -> bool:
    """Whether a basis is that of principal axes, not that of the pixels.

    Args:
        basis: (d, d), one that `learn_smooth` has chosen.

    Returns:
        Whether it is anything but unity.
    """
    return not np.array_equal(basis, np.eye(len(basis)))
