"""A projective map with a smooth departure from it, as one Gaussian process: from a target to the pixels of a camera.

To first order in the numbers theta of a projective map, pixel = f(theta, x) + g(x): the covariance of two pixels is
J S J^T + k, with J the derivatives of f, S a prior that knows no more than how large the picture is, and k a smooth
kernel for what water, glass or a lens adds (Rasmussen & Williams, section 2.7). Flat targets, few points and points on
one line need no case of their own: what those seen do not fix is uncertain by what the prior allows.

x has three coordinates, and theta the eleven numbers of a camera matrix, or two for the plane of a board, and theta the
eight of a homography. Everything is in normalised units: x with mean 0 and rms of about 1 over the target, pixels in a
scale that makes the map's steps about 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from implicam.dataset import Floats
from implicam.gp.kernels import Kernel
from implicam.gp.linalg import cholesky, solve, solve_lower

AFFINE_PRIOR_SD, ORIGIN_PRIOR_SD = 1.5, 5.0
"""Prior sd of the numbers of a row of the map, with pixels in units of the target's size: all that is possible."""

ALONG_PRIOR_SD, ACROSS_PRIOR_SD = 0.2, 0.06
"""Prior sd of the perspective: how much the distance from the camera changes over the target, as a part of itself,
along the line of sight; and across it, which is what an axis that does not meet the target does."""

SETTLED = 1e-12
"""Change of the map's numbers, in units of the target's size, below which a further step says nothing."""


class Departure(NamedTuple):
    """What is smooth and not projective: its sd `bend` in the units of the pixels, its correlation length `reach` in
    those of x, and `slack`, the sd of each point about all of that."""

    bend: float
    reach: float
    slack: float

    def kernel(self, dimensions: int) -> Kernel:
        """The kernel of one pixel coordinate.

        Args:
            dimensions: Of x.
        """
        return Kernel("squared-exponential", self.bend**2, np.full(dimensions, self.reach))


@dataclass(frozen=True, eq=False)
class ProjectiveProcess:
    """The process conditioned on n points seen; build it with `condition`.

    Attributes:
        x: (n, d) on the target.
        uv: (n, 2) pixels.
        theta: (3 d + 2,) the most probable projective map.
        prior: (3 d + 2, 3 d + 2) its prior covariance.
        departure: From it.
        L: (2 n, 2 n) Cholesky factor of the covariance of uv.
        alpha: (2 n,) the inverse of that covariance times what is to be explained.
        evidence: Log density of uv, up to a constant.
    """

    x: Floats
    uv: Floats
    theta: Floats
    prior: Floats
    departure: Departure
    L: Floats
    alpha: Floats
    evidence: float

    @classmethod
    def condition(
        cls, x: Floats, uv: Floats, variance: Floats, theta: Floats, departure: Departure, *, turns: int = 5
    ) -> ProjectiveProcess:
        """Condition on points seen.

        Args:
            x: (n, d) on the target.
            uv: (n, 2) pixels.
            variance: (n,) or (n, 2) of the pixels, without the slack.
            theta: (3 d + 2,) a first map, `fit_affine` for one.
            departure: From it.
            turns: Steps of Gauss and Newton towards the most probable map, and one that only conditions.

        Raises:
            NumericalError: The covariance is not positive definite.
        """
        noise = np.broadcast_to(variance.reshape(len(x), -1), (len(x), 2)).ravel() + departure.slack**2
        prior = _prior_covariance(theta)
        smooth = np.kron(departure.kernel(x.shape[1])(x, x), np.eye(2))
        smooth[np.diag_indices_from(smooth)] += noise
        for turn in range(turns):
            image, J = project(theta, x)
            L = cholesky(np.asfortranarray(J @ prior @ J.T + smooth))
            rest = (uv - image).ravel() + J @ theta
            alpha = solve(L, rest)
            if turn == turns - 1:
                break
            before, theta = theta, prior @ (J.T @ alpha)
            if np.abs(theta - before).max() < SETTLED:
                break
        evidence = -0.5 * rest @ alpha - np.log(np.diag(L)).sum()
        return cls(x, uv, theta, prior, departure, L, alpha, float(evidence))

    def predict(self, x: Floats) -> tuple[Floats, Floats]:
        """Predict the pixels of other points, the slack of each included.

        Args:
            x: (k, d) on the target.

        Returns:
            (k, 2) pixels, and (k, 2, 2) their covariances.
        """
        image, J = project(self.theta, x)
        known = project(self.theta, self.x)[1]
        kernel = self.departure.kernel(x.shape[1])
        K = known @ self.prior @ J.T + np.kron(kernel(self.x, x), np.eye(2))
        v = solve_lower(self.L, K).reshape(-1, len(x), 2)
        uv = image + (K.T @ self.alpha - J @ self.theta).reshape(-1, 2)
        J = J.reshape(len(x), 2, -1)
        covariance = np.einsum("nci,ij,nlj->ncl", J, self.prior, J) - np.einsum("knc,knl->ncl", v, v)
        covariance[:, [0, 1], [0, 1]] += self.departure.bend**2
        covariance[:, [0, 1], [0, 1]] = np.maximum(covariance[:, [0, 1], [0, 1]], 0) + self.departure.slack**2
        return uv, covariance

    def leave_one_out(self) -> tuple[Floats, Floats]:
        """What the others say of each point, both coordinates of its pixel left out.

        Returns:
            (n, 2) pixels, and (n, 2, 2) covariances of the pixel seen about them, its own noise included.
        """
        n = len(self.x)
        inverse = solve(self.L, np.eye(2 * n))
        blocks = np.linalg.inv(inverse.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)])
        uv = self.uv - np.einsum("nij,nj->ni", blocks, self.alpha.reshape(n, 2))
        return uv, np.asarray(blocks, dtype=np.float64)


def _prior_covariance(theta: Floats) -> Floats:
    """Prior covariance of the numbers of a map; a camera's line of sight is that of theta, a board may tilt anyhow."""
    d = (len(theta) - 2) // 3
    S = np.diag(np.array([*([AFFINE_PRIOR_SD] * d + [ORIGIN_PRIOR_SD]) * 2, *[ALONG_PRIOR_SD] * d]) ** 2)
    if d == 3:
        sight = np.cross(theta[:3], theta[4:7])
        sight = sight / max(float(np.linalg.norm(sight)), 1e-9)
        S[8:, 8:] = (ALONG_PRIOR_SD**2 - ACROSS_PRIOR_SD**2) * np.outer(sight, sight) + ACROSS_PRIOR_SD**2 * np.eye(3)
    return np.asarray(S, dtype=np.float64)


def project(theta: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Apply a projective map.

    Args:
        theta: (3 d + 2,) its numbers: two rows of d + 1, and the d of the denominator, whose constant is 1.
        x: (n, d) on the target.

    Returns:
        Pixels (n, 2), and their derivatives by theta (2 n, 3 d + 2).
    """
    n, d = x.shape
    one = np.hstack([x, np.ones((n, 1))])
    away: Floats = np.maximum(1 + x @ theta[2 * d + 2 :], 0.1)[:, None]
    uv: Floats = np.asarray(one @ theta[: 2 * d + 2].reshape(2, d + 1).T / away, dtype=np.float64)
    J = np.zeros((n, 2, 3 * d + 2))
    J[:, 0, : d + 1] = J[:, 1, d + 1 : 2 * d + 2] = one / away
    J[:, :, 2 * d + 2 :] = -uv[..., None] * (x / away)[:, None]
    return uv, np.asarray(J.reshape(2 * n, -1), dtype=np.float64)


def fit_affine(x: Floats, uv: Floats) -> Floats:
    """A first map without perspective, by least squares with a little ridge.

    Args:
        x: (n, d) on the target.
        uv: (n, 2) pixels.

    Returns:
        (3 d + 2,).
    """
    d = x.shape[1]
    one = np.hstack([x, np.ones((len(x), 1))])
    normal = one.T @ one + 1e-6 * len(x) * np.eye(d + 1)
    return np.concatenate([*np.linalg.solve(normal, one.T @ uv).T, np.zeros(d)])
