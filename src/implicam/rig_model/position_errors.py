"""How far single known positions are off: a common covariance, from what the cameras agree on, eqs. (23) to (26).

Each point is measured without its own views. What the cameras agree on, and the known position contradicts, is the
error of the position; what they disagree on is noise. A few dots of a target may be off by much more than the rest, so
the errors have a Student t distribution, of a degree that is chosen by the data. This module sees numbers per point,
and knows nothing of cameras.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import chdtri, fdtri, gammainccinv

from implicam.geometry import Floats
from implicam.rig_model.settings import RigModelSettings

QUADRATURE_NODES = 7
"""Of the quadrature over a point's own scale."""

MIN_CURVATURE = 0.05
"""Of minus the log posterior: the prior alone is more curved; what is less is rounding, or not yet the optimum."""

LOG_NOISE_BOUNDS, LOG_VARIANCE_BOUNDS = (-3.0, 0.0), (2 * np.log(1e-7), 2 * np.log(0.3))
"""Of the log noise factor, and of the log variance of a position in the working frame."""


class Agreement(NamedTuple):
    """Of n points, each from its views, whitened by the covariance S (r, r) of what is predicted without them.

    information (n, 3, 3) D^T S^-1 D, D being the slope of the views by the position; pull (n, 3) D^T S^-1 r of the
    residuals r; squares (n,) r^T S^-1 r; coordinates (n,) how many r has.
    """

    information: Floats
    pull: Floats
    squares: Floats
    coordinates: Floats

    def select(self, rows: NDArray[np.int64]) -> Agreement:
        """What is said of some of the points.

        Args:
            rows: Their numbers.

        Returns:
            The same of these.
        """
        return Agreement(*(column[rows] for column in self))


@dataclass(frozen=True, eq=False)
class PositionErrors:
    """Errors of known positions: Student t with `scale` (3, 3), a squared length in the working frame, and `freedom`.

    noise: what is left of the noise that the fit without them has found, at most 1. gain: nats of evidence by which
    they explain the views better than noise alone. scale and noise are of the mean variance, as eq. (12) has it. size:
    (n,) of each known point, by how much it seems to be farther off than usual. level: what error bars are judged by.
    """

    scale: Floats
    freedom: float
    noise: float
    gain: float
    level: float
    size: Floats | None = None

    @property
    def covariance(self) -> Floats:
        """(3, 3) of the normal distribution whose ellipsoid at the level holds as many of the errors: it is larger."""
        if np.isinf(self.freedom):
            return self.scale
        ratio = 3 * fdtri(3, self.freedom, self.level) / chdtri(3, 1 - self.level)
        return np.asarray(self.scale * ratio, dtype=np.float64)

    @property
    def root(self) -> Floats:
        """(3, 3) whose product with its transpose is the scale."""
        values, vectors = np.linalg.eigh(self.scale)
        return np.asarray(vectors * np.sqrt(values), dtype=np.float64)

    def weights(self, agreement: Agreement) -> Floats:
        """By how much each point's own scale is larger than the usual one; EM's: one over the mean precision.

        Args:
            agreement: What the views of n points say of their positions, each predicted without the point.

        Returns:
            (n,) ratios of variances; 1 where the errors are normal.
        """
        found = _Scales.of(agreement, self.scale).likelihood(np.log(self.noise), self.freedom)
        return np.asarray(1 / np.sum(found.share / _nodes(self.freedom)[0][:, None], axis=0), dtype=np.float64)


def estimate_position_errors(agreement: Agreement, settings: RigModelSettings) -> PositionErrors | None:
    """The most probable errors of known positions, eqs. (23) to (25).

    Args:
        agreement: What the views of each point say of its position, each predicted without the point.
        settings: Priors, and how clearly errors must explain the views better than noise alone.

    Returns:
        The errors, with mean variances; None where noise alone explains the views as well.
    """
    if len(agreement.coordinates) < 4:
        return None
    found = _most_probable(agreement, np.inf, None, settings)
    gain = _evidence(agreement, found, settings)
    if gain < settings.min_position_gain_nats:
        return None
    normal = found.value
    for freedom in settings.position_degrees_of_freedom:
        other = _most_probable(agreement, freedom, found.at, settings)
        if other.value < min(found.value, normal - settings.min_position_tail_gain_nats):
            found = other
    return _mean_variances(agreement, found, gain + normal - found.value, settings)


class _Found(NamedTuple):
    """at (7,): the logs of the scale and of the noise; value: minus the log posterior there."""

    at: Floats
    freedom: float
    value: float


def _evidence(agreement: Agreement, found: _Found, settings: RigModelSettings) -> float:
    """Log of how much more probable the views are with errors of any size than with none: Laplace, the noise at its
    most probable either way, eq. (25)."""
    alone = float(_noise_alone(agreement, np.linspace(*LOG_NOISE_BOUNDS, 121), settings).min())
    prior = np.array([_prior(z, settings)[1] - _prior(0 * z, settings)[1] for z in np.eye(7)])
    curvature = _curvature(agreement, found, settings)
    shrunk = np.linalg.slogdet(prior[:6, :6])[1] - np.linalg.slogdet(curvature[:6, :6])[1]
    return float(alone - found.value + 0.5 * shrunk)


def _curvature(agreement: Agreement, found: _Found, settings: RigModelSettings) -> Floats:
    """(7, 7) second derivatives of minus the log posterior."""
    objective, h = _objective(agreement, found.freedom, settings), 1e-3
    hessian = np.array([(objective(found.at + d)[1] - objective(found.at - d)[1]) / (2 * h) for d in h * np.eye(7)])
    values, turned = np.linalg.eigh(0.5 * (hessian + hessian.T))
    return np.asarray(turned * np.maximum(values, MIN_CURVATURE) @ turned.T, dtype=np.float64)


def _noise_alone(agreement: Agreement, log_noise: Floats, settings: RigModelSettings) -> Floats:
    squares, coordinates = float(agreement.squares.sum()), float(agreement.coordinates.sum())
    prior = (log_noise / settings.position_noise_prior_log_sd) ** 2
    return 0.5 * (squares * np.exp(-2 * log_noise) + 2 * coordinates * log_noise + prior)


def _most_probable(agreement: Agreement, freedom: float, start: Floats | None, settings: RigModelSettings) -> _Found:
    objective = _objective(agreement, freedom, settings)
    if start is None:
        sizes = [(size, noise) for size in (5e-4, 2e-3, 8e-3) for noise in (-0.1, -0.7)]
        trials = [np.array([*np.full(3, 2 * np.log(size)), 0, 0, 0, noise]) for size, noise in sizes]
        start = min(trials, key=lambda z: objective(z)[0])
    bounds = [LOG_VARIANCE_BOUNDS] * 3 + [(-10.0, 10.0)] * 3 + [LOG_NOISE_BOUNDS]
    z = minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-6}).x
    return _Found(z, freedom, objective(z)[0])


def _objective(
    agreement: Agreement, freedom: float, settings: RigModelSettings
) -> Callable[[Floats], tuple[float, Floats]]:
    """Minus the log posterior of z: the matrix logarithm of the scale (xx, yy, zz, xy, xz, yz), and the log noise."""

    def objective(z: Floats) -> tuple[float, Floats]:
        values, vectors = np.linalg.eigh(_symmetric_matrix(z))
        scale = (vectors * np.exp(values)) @ vectors.T
        found = _Scales.of(agreement, scale).likelihood(z[6], freedom)
        chain = vectors @ ((vectors.T @ found.by_scale @ vectors) * _divided_differences(values)) @ vectors.T
        gradient = np.array([*np.diag(chain), *(2 * chain[_OFF]), found.by_noise])
        prior, by_prior = _prior(z, settings)
        return found.value + prior, gradient + by_prior

    return objective


_OFF = (np.array([0, 0, 1]), np.array([1, 2, 2]))


def _symmetric_matrix(z: Floats) -> Floats:
    Z = np.diag(z[:3])
    Z[_OFF] = Z[_OFF[::-1]] = z[3:6]
    return Z


def _divided_differences(values: Floats) -> Floats:
    """(3, 3) divided differences of the exponential: the derivative of a matrix exponential, in its eigenvectors."""
    difference = values[:, None] - values
    near = np.abs(difference) < 1e-6
    size = np.exp(values)
    middle = np.exp(0.5 * (values[:, None] + values))
    return np.asarray(np.where(near, middle, (size[:, None] - size) / np.where(near, 1, difference)), dtype=np.float64)


def _prior(z: Floats, settings: RigModelSettings) -> tuple[float, Floats]:
    """Minus the log prior, the same in every world frame, and its slope."""
    median, sd = np.log(settings.position_sd_prior_median_wf), settings.position_sd_prior_log_sd
    unlike_sd, noise_sd = settings.position_anisotropy_prior_sd, settings.position_noise_prior_log_sd
    usual = z[:3].sum() / 6  # log sd, mean over the directions
    unlike = np.array([*(0.5 * z[:3] - usual), *(0.5 * z[3:6])])
    twice = np.array([1.0, 1, 1, 2, 2, 2])
    value = 0.5 * ((usual - median) / sd) ** 2 + 0.5 * np.sum(twice * unlike**2) / unlike_sd**2
    value += 0.5 * (z[6] / noise_sd) ** 2
    slope = 0.5 * twice * unlike / unlike_sd**2  # the mean of `unlike` is zero
    slope[:3] += (usual - median) / sd**2 / 6
    return float(value), np.append(slope, z[6] / noise_sd**2)


class _Likelihood(NamedTuple):
    """value: minus log likelihood; by_scale (3, 3) and by_noise: its slopes; share (nodes, n): posterior probability of
    each node of a point's own scale."""

    value: float
    by_scale: Floats
    by_noise: float
    share: Floats


class _Scales(NamedTuple):
    """The points in coordinates in which scale and information are diagonal: w (n, 3) information in units of the
    scale, pull (n, 3), back (n, 3, 3) to the world."""

    agreement: Agreement
    w: Floats
    pull: Floats
    back: Floats

    @classmethod
    def of(cls, agreement: Agreement, scale: Floats) -> _Scales:
        values, vectors = np.linalg.eigh(scale)
        root = vectors * np.sqrt(np.maximum(values, 1e-300))  # scale = root root^T
        w, turned = np.linalg.eigh(root.T @ agreement.information @ root)
        pull = np.einsum("nji,nj->ni", turned, agreement.pull @ root)
        return cls(agreement, np.maximum(w, 0), pull, np.linalg.inv(root).T @ turned)

    def likelihood(self, log_noise: float, freedom: float) -> _Likelihood:
        """Eq. (24), the points' own scales integrated out."""
        own, weight = _nodes(freedom)
        noise2 = np.exp(2 * log_noise)
        size = (own / noise2)[:, None, None]
        inside = 1 + size * self.w  # (nodes, n, 3)
        explained = np.sum(size * self.pull**2 / inside, axis=2)
        left = (self.agreement.squares - explained) / noise2
        each = (
            0.5 * (left + np.sum(np.log(inside), axis=2))
            + self.agreement.coordinates * log_noise
            - np.log(weight)[:, None]
        )
        least = each.min(axis=0)
        share = np.exp(least - each)
        total = share.sum(axis=0)
        share = share / total
        u = self.pull / inside
        part = share[..., None] * size
        diagonal = np.sum(part * self.w / inside, axis=0)
        outer = np.einsum("jni,jnk->nik", part * u, u) / noise2
        inner = np.eye(3) * diagonal[:, None, :] - outer
        by_scale = 0.5 * np.einsum("nij,njk,nlk->il", self.back, inner, self.back, optimize=True)
        trace = float(np.sum(diagonal - np.sum(part * u**2, axis=0) / noise2))  # of (slope by scale) x 2 scale
        by_noise = float(np.sum(self.agreement.coordinates) - np.sum(share * left) - trace)
        return _Likelihood(float(np.sum(least - np.log(total))), by_scale, by_noise, share)


@lru_cache
def _nodes(freedom: float) -> tuple[Floats, Floats]:
    """Scales of a point over the usual one, and their weights: Gauss's rule in the probability of an inverse gamma."""
    if np.isinf(freedom):
        return np.ones(1), np.ones(1)
    at, weight = np.polynomial.legendre.leggauss(QUADRATURE_NODES)
    own = freedom / 2 / gammainccinv(freedom / 2, 0.5 * (at + 1))
    return np.asarray(own, dtype=np.float64), np.asarray(weight / 2, dtype=np.float64)


def _mean_variances(agreement: Agreement, found: _Found, gain: float, settings: RigModelSettings) -> PositionErrors:
    """With mean variances, larger than the most probable ones where there are few points: as eq. (12)."""
    spread = np.linalg.inv(_curvature(agreement, found, settings))
    logs, axes = np.linalg.eigh(_symmetric_matrix(found.at))
    along = 0.5 * np.array([[*(q**2), 2 * q[0] * q[1], 2 * q[0] * q[2], 2 * q[1] * q[2]] for q in axes.T])
    variance = np.einsum("ai,ij,aj->a", along, spread[:6, :6], along)
    variance = np.minimum(variance, settings.max_position_log_sd_variance)
    noise = float(np.exp(found.at[6] + min(spread[6, 6], settings.max_position_log_noise_variance)))
    scale = (axes * np.exp(logs + 2 * variance)) @ axes.T
    return PositionErrors(scale, found.freedom, min(noise, 1.0), gain, settings.error_bar_level)
