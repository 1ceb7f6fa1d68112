"""Pixel noise with heavy tails: Student's t, its degrees of freedom from the data, in the fit and when measuring.

Detections are mostly good to a tenth of a pixel and sometimes off by a whole one. Taken for normal, such noise either
bends the result or makes all error bars those of the bad views. Here a view's error is a bivariate t with `degrees`
degrees of freedom; where the data do not say so clearly it is normal, and nothing changes. Eqs. (T1) to (T5) of
docs/method.md; docs/decisions/0016.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import chdtrc, gammaln, logsumexp, ndtri

from implicam.geometry import Bools, Floats
from implicam.rig_model.camera_model import CameraViews
from implicam.rig_model.settings import RigModelSettings
from implicam.rig_model.wrong_views import Ints, LinearisedViews

MAX_EM_STEPS = 40
"""Of EM for scale and share of wrong detections, at each number of degrees ..."""

EM_RELATIVE_TOLERANCE = 1e-6
"""... or fewer, where no scale squared changes by this part any more."""

POSTERIOR_DRAWS = 512
"""Places at which the posterior of a position is looked up: its sds are then good to a few per cent."""

REWEIGHTINGS_TO_MODE = 10
"""Times that views are weighted to find a mode."""

VIEWS_PER_BATCH = 256
"""Views whose positions are integrated at once, so that all fits in the processor's cache."""

EVIDENCE_DRAWS = 64
"""The same for the evidence of the degrees."""

MAX_CONDITION = 1e10
"""Condition of a point's normal matrix beyond which its views do not fix it."""

PROPOSAL_WIDENING = 1.5
"""How much wider than the posterior at its mode they are spread."""


class HeavyTails(NamedTuple):
    """degrees: of freedom. weights: per camera (n seen,), how much each of its views counts, eq. (T3)."""

    degrees: float
    weights: tuple[Floats, ...]

    def weight_views(self, seen: tuple[CameraViews, ...], *, with_loss: bool) -> tuple[CameraViews, ...]:
        """The views, noisier where they count less.

        Args:
            seen: Per camera, the n views that the weights are of.
            with_loss: Noisier by the loss of information, too.

        Returns:
            The same views with other relative noise.
        """
        loss = self.loss if with_loss else 1.0
        return tuple(
            s._replace(relative=s.relative * np.sqrt(loss / w)) for s, w in zip(seen, self.weights, strict=True)
        )

    @property
    def loss(self) -> float:
        """How many times less a view with such noise tells than a normal one of the same scale, eq. (T3)."""
        return information_loss(self.degrees)


def information_loss(degrees: float | None) -> float:
    """Scale matrix over inverse Fisher information of a bivariate t; 1 for normal noise (None).

    Args:
        degrees: Degrees of freedom; None for normal noise.

    Returns:
        The ratio, 1 or more.
    """
    return 1.0 if degrees is None else (degrees + 4) / (degrees + 2)


def outlier_distance(degrees: float, normal: float) -> float:
    """The squared distance beyond which a view is as rare as beyond `normal` with normal noise.

    Args:
        degrees: Degrees of freedom of the noise.
        normal: A squared distance under normal noise.

    Returns:
        The squared distance, in the scale matrix of the t.
    """
    return float(degrees * np.expm1(normal / degrees))


def student_t_weights(distance: Floats, degrees: float) -> Floats:
    """How much views count, eq. (T3).

    Args:
        distance: Squared distances, in the scale matrix of each view; of any shape.
        degrees: Degrees of freedom of the noise.

    Returns:
        Weights of the same shape: 1 at a squared distance of 2, less beyond.
    """
    return np.asarray((degrees + 2) / (degrees + distance), dtype=np.float64)


def looks_heavy(distance: Floats, background: Floats, settings: RigModelSettings) -> bool:
    """Whether the noise of single cameras looks as if it had heavy tails: that is quickly seen, and seldom so.

    Args:
        distance: Squared distances (n,) of views from what all others predict, in their covariances.
        background: (n,) the density of a wrong detection, anywhere in the image, over that of a normal view at its
            centre.
        settings: The degrees of freedom to try, and how much more likely a t must be.
    """
    good = np.isfinite(distance) & (distance >= 0)
    q, b = distance[good], background[good]
    if len(q) < settings.min_tail_views:
        return False
    normal = _likelihoods(q, b, np.array([np.inf]))[0]
    found = _likelihoods(q, b, np.array(settings.tail_degrees_of_freedom))
    best = found[np.argmax(found[:, 0])]
    clearly = best[0] > normal[0] + settings.min_tail_gain_nats
    return bool(clearly and best[2] < settings.max_wrong_detection_share)


def _likelihoods(q: Floats, background: Floats, degrees: Floats) -> Floats:
    """(k, 3) for each of the degrees (k,), all finite or none: the largest log likelihood, over the scale squared and
    the share of wrong detections; and these. By EM."""
    t = degrees[:, None]
    scale = np.full(t.shape, max(float(np.median(q)) / (2 * np.log(2)), 1e-300))
    wrong = np.full(t.shape, 0.01)
    for _ in range(MAX_EM_STEPS):
        before = scale
        if np.isinf(degrees).all():
            density, w = np.exp(-0.5 * q / scale) / scale, np.ones_like(scale)
        else:
            apart = q / scale
            density = np.exp(-0.5 * (t + 2) * np.log1p(apart / t)) / scale
            w = (t + 2) / (t + apart)
        good = (1 - wrong) * density
        right = good / (good + wrong * background)
        share = right.mean(axis=1, keepdims=True)
        scale = np.maximum((right * w) @ q[:, None] / (2 * len(q) * share), 1e-300)
        wrong = np.clip(1 - share, 1e-6, 0.9)
        if (np.abs(scale - before) <= EM_RELATIVE_TOLERANCE * scale).all():
            break
    values = np.sum(np.log((1 - wrong) * density + wrong * background), axis=1, keepdims=True)
    return np.concatenate([values, scale, wrong], axis=1)


def consistency(distance: Floats, seen: Bools, degrees: float) -> Floats:
    """How well the views of points agree, eq. (T5).

    Args:
        distance: Squared distances (n, C) of the views at the most probable position.
        seen: (n, C) the views in use.
        degrees: Degrees of freedom of the noise.

    Returns:
        (n,) p-values; NaN with fewer than two views, or without a finite distance.
    """
    views = seen.sum(axis=1)
    total = np.sum(np.where(seen, degrees * np.log1p(distance / degrees), 0), axis=1)
    free = np.maximum(2 * views - 3 * degrees / (degrees + 2), 1)
    return np.asarray(np.where((views >= 2) & np.isfinite(total), chdtrc(free, total), np.nan), dtype=np.float64)


def equivalent_normal_noise(noise: Floats, distance: Floats, seen: Bools, degrees: float) -> Floats:
    """The noise of normal views that tell as much as these: by their distances, eq. (T3); of two views, where nothing
    says which is the worse, the standard deviation.

    Args:
        noise: (n, C) scale of the t, pixels.
        distance: (n, C) squared distances, in the scale matrix of each view.
        seen: (n, C) the views in use.
        degrees: Degrees of freedom of the noise, more than two.

    Returns:
        (n, C) standard deviations, pixels.
    """
    weighted = information_loss(degrees) / student_t_weights(distance, degrees)
    plain = degrees / (degrees - 2)
    few = (seen.sum(axis=1) < 3)[:, None]
    return np.asarray(noise * np.sqrt(np.where(few, plain, weighted)), dtype=np.float64)


class RefinedPositions(NamedTuple):
    """The posterior of n positions: step (n, 3) from where the views were linearised, covariance (n, 3, 3), NaN where
    two places are likely; and squared distances (n, C) of the views at the most probable one."""

    step: Floats
    cov: Floats
    distance: Floats


def refine_positions(linear: LinearisedViews, degrees: float, settings: RigModelSettings) -> RefinedPositions:
    """Mean and covariance of each position under noise with heavy tails, eq. (T4).

    Args:
        linear: The views of n points, linearised near the positions; cameras are not tied.
        degrees: Degrees of freedom of the noise.
        settings: With how many views a second mode is looked for, and when two places are too different.
    """
    A, b = whiten(linear)
    n, C = b.shape[:2]
    out = RefinedPositions(np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, C)))
    seen = np.any(A != 0, axis=(2, 3))
    views = seen.sum(axis=1)
    order = np.argsort(~seen, axis=1, kind="stable")
    for V in np.unique(views):
        alike = np.flatnonzero(views == V)
        size = max(1, VIEWS_PER_BATCH // int(V))
        for some in np.split(alike, range(size, len(alike), size)):
            chosen = order[some, :V]
            found = _integrate(A[some[:, None], chosen], b[some[:, None], chosen], degrees, settings)
            out.step[some], out.cov[some] = found.step, found.cov
            out.distance[some[:, None], chosen] = found.distance
    return out


def _integrate(A: Floats, b: Floats, degrees: float, settings: RigModelSettings) -> RefinedPositions:
    """By importance sampling, from a mixture of spherical t about every place that may be a mode: with few views, each
    of them may be the wrong one."""
    n = len(b)
    modes = [_expand_at_mode(A, b, degrees, start) for start in _starts(A, b, settings.max_views_with_second_mode)]
    z, log_density = _draws(POSTERIOR_DRAWS)
    centre = np.stack([mode.step for mode in modes], axis=1)  # (n, K, 3)
    spread = np.stack([mode.spread for mode in modes], axis=1)
    K = len(modes)
    own = np.arange(POSTERIOR_DRAWS) % K  # the component that each draw belongs to
    x = centre[:, own] + (spread[:, own] @ z[None, :, :, None])[..., 0]  # (n, POSTERIOR_DRAWS, 3)
    log_weight = -0.5 * (degrees + 2) * _log_terms(A, b, x, degrees)
    if K == 1:
        log_weight = log_weight - log_density
    else:
        back = np.linalg.inv(spread)
        away = (x[:, None] - centre[:, :, None]) @ back.swapaxes(2, 3)  # (n, K, POSTERIOR_DRAWS, 3)
        sizes = np.linalg.slogdet(back)[1][..., None]
        log_weight = log_weight - logsumexp(sizes - 3.5 * np.log1p(np.sum(away**2, axis=3) / 4), axis=1)
    weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    mean = np.einsum("nk,nki->ni", weight, x)
    about = x - mean[:, None]
    cov = np.einsum("nk,nki,nkj->nij", weight, about, about)
    agreeing = information_loss(degrees) * np.linalg.inv(np.einsum("ncij,ncik->njk", A, A))
    larger = np.linalg.eigvals(np.linalg.solve(agreeing, cov)).real.max(axis=1)
    two_places = larger > settings.max_error_bar_ratio**2
    mean[two_places], cov[two_places] = np.nan, np.nan
    left = np.stack([mode.left for mode in modes], axis=1)
    distance = np.sum(left**2, axis=3)  # (n, K, V)
    best = np.argmin(np.sum(np.log1p(distance / degrees), axis=2), axis=1)
    return RefinedPositions(mean, cov, distance[np.arange(n), best])


def _starts(A: Floats, b: Floats, few: int) -> list[Floats]:
    """Least squares (n, 3), and with few views, without each of them."""
    N = A.swapaxes(2, 3) @ A
    g = (A.swapaxes(2, 3) @ b[..., None])[..., 0]
    H, pull = N.sum(axis=1), g.sum(axis=1)
    starts = [np.linalg.solve(H, pull[..., None])[..., 0]]
    V = b.shape[1]
    if 3 <= V <= few:
        held = 1e-6 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        starts += [np.linalg.solve(H - N[:, c] + held, (pull - g[:, c])[..., None])[..., 0] for c in range(V)]
    return starts


def whiten(linear: LinearisedViews) -> tuple[Floats, Floats]:
    """Slopes and residuals of single views in the scale of their noise.

    Args:
        linear: The views of n points; what ties cameras (`joint`) is left aside.

    Returns:
        Slopes A (n, C, 2, 3) and residuals b (n, C, 2).

    Raises:
        numpy.linalg.LinAlgError: The inverse covariance of a view is not positive definite.
    """
    root = np.linalg.cholesky(linear.each).swapaxes(2, 3)  # each = root^T root
    return np.asarray(root @ linear.D), np.asarray((root @ linear.r[..., None])[..., 0])


def degrees_of_agreement(A: Floats, b: Floats, seen: Bools, settings: RigModelSettings) -> float | None:
    """Degrees of freedom of the noise from what cameras say of the same points, wherever these are: the position of
    each point is integrated out, eq. (T2).

    A known position that is off by itself looks like heavy tails in every single camera; here it does not count. And
    where cameras agree among themselves much better than with the known positions, the errors are mostly of these: what
    cameras share is not their noise, and noise is taken for normal.

    Args:
        A: Slopes (n, C, 2, 3) of views, as `whiten` gives them.
        b: Their residuals (n, C, 2).
        seen: (n, C) the views in use.
        settings: The degrees to try, how many points to use, and how clear the finding must be.

    Returns:
        The degrees; None where the noise is normal, or where there are too few views to tell.
    """
    views = seen.sum(axis=1)
    some = np.flatnonzero(views >= 2)[: settings.max_confirming_points]
    A, b, views = np.where(seen[..., None, None], A, 0)[some], np.where(seen[..., None], b, 0)[some], views[some]
    H = np.einsum("ncij,ncik->njk", A, A)
    good = np.linalg.cond(H) < MAX_CONDITION
    A, b, views, H, seen = A[good], b[good], views[good], H[good], seen[some][good]
    free = float(np.sum(2 * views - 3))
    if free < settings.min_tail_views:
        return None
    g = np.einsum("ncij,nci->nj", A, b)
    squares = np.sum(b**2, axis=(1, 2)) - np.einsum("ni,ni->n", g, np.linalg.solve(H, g[..., None])[..., 0])
    log_sizes = 0.5 * float(
        np.sum(3 * np.log(2 * np.pi) - np.linalg.slogdet(H)[1]) - np.sum(views) * 2 * np.log(2 * np.pi)
    )
    usual = max(float(squares.sum()) / free, 1e-300)
    normal = log_sizes - 0.5 * free * (1 + np.log(usual))

    found = [
        (*_maximise_evidence(A, b, views, degrees, usual), degrees) for degrees in settings.tail_degrees_of_freedom
    ]
    value, scale, degrees = max(found, key=lambda one: one[0])
    alone = _likelihoods(np.sum(b**2, axis=2)[seen], np.zeros(int(seen.sum())), np.array([degrees]))[0, 1]
    confirmed = value > normal + settings.min_confirming_tail_gain_nats
    return degrees if confirmed and scale > settings.min_disagreement_variance_ratio * alone else None


def _maximise_evidence(A: Floats, b: Floats, views: Ints, degrees: float, usual: float) -> tuple[float, float]:
    """The largest evidence over the scale squared, and that."""
    free = float(np.sum(2 * views - 3))
    found = minimize_scalar(
        lambda u: 0.5 * free * u - _evidence(A, b * np.exp(-0.5 * u), views, degrees),
        bracket=(np.log(usual) - 1.0, np.log(usual) - 0.4),
        method="brent",
        options={"xtol": 0.05, "maxiter": 6},
    )
    return -float(found.fun), float(np.exp(found.x))


def _evidence(A: Floats, b: Floats, views: Ints, degrees: float) -> float:
    """Log density of the views of unit scale (those not there are zero), each point's position integrated out."""
    mode = _expand_at_mode(A, b, degrees)
    z, log_density = _draws(EVIDENCE_DRAWS)
    log_weight = -0.5 * (degrees + 2) * _log_terms(A, mode.left, z @ mode.spread.swapaxes(1, 2), degrees) - log_density
    sizes = np.linalg.slogdet(mode.spread)[1] - views * np.log(2 * np.pi)
    return float(np.sum(logsumexp(log_weight, axis=1) - np.log(len(z)) + sizes))


class _Mode(NamedTuple):
    """Of n points the most probable step (n, 3) near a start, residuals there (n, C, 2), and a root (n, 3, 3) of a
    covariance larger than the posterior's."""

    step: Floats
    left: Floats
    spread: Floats


def _expand_at_mode(A: Floats, b: Floats, degrees: float, start: Floats | None = None) -> _Mode:
    step = _find_mode(A, b, degrees, np.zeros((len(A), 3)) if start is None else start)
    left = b - np.einsum("ncij,nj->nci", A, step)
    w = student_t_weights(np.sum(left**2, axis=2), degrees)
    H = np.einsum("nc,ncij,ncik->njk", w, A, A)
    return _Mode(step, left, PROPOSAL_WIDENING * np.sqrt(information_loss(degrees)) * _inverse_root(H))


def _log_terms(A: Floats, left: Floats, away: Floats, degrees: float) -> Floats:
    """(n, K) sum over the views of log(1 + squared distance / degrees), at steps away (n, K, 3)."""
    n, C = left.shape[:2]
    moved = (A.reshape(n, 2 * C, 3) @ away.swapaxes(1, 2)).reshape(n, C, 2, -1)
    squares = np.sum((left[..., None] - moved) ** 2, axis=2)
    return np.asarray(np.sum(np.log1p(squares / degrees), axis=1), dtype=np.float64)


def _find_mode(A: Floats, b: Floats, degrees: float, step: Floats) -> Floats:
    """(n, 3) the most probable step near a start: least squares, weighted again and again."""
    for _ in range(REWEIGHTINGS_TO_MODE):
        left = b - np.einsum("ncij,nj->nci", A, step)
        w = student_t_weights(np.sum(left**2, axis=2), degrees)
        H = np.einsum("nc,ncij,ncik->njk", w, A, A)
        step = step + _solve_stack(H, np.einsum("nc,ncij,nci->nj", w, A, left))
    return step


def _inverse_root(H: Floats) -> Floats:
    """R with R R^T = H^-1, in stacks."""
    L = np.linalg.cholesky(H)
    return np.asarray(np.linalg.inv(L).swapaxes(1, 2), dtype=np.float64)


def _solve_stack(H: Floats, g: Floats) -> Floats:
    """H^-1 g of stacks (n, 3, 3) and (n, 3); where one is singular, with as much more on the diagonal as rounding."""
    try:
        return np.asarray(np.linalg.solve(H, g[..., None])[..., 0], dtype=np.float64)
    except np.linalg.LinAlgError:
        more = 1e-12 * np.trace(H, axis1=1, axis2=2) + np.finfo(float).tiny
        return np.asarray(np.linalg.solve(H + more[:, None, None] * np.eye(3), g[..., None])[..., 0], dtype=np.float64)


@lru_cache(maxsize=2)
def _draws(count: int) -> tuple[Floats, Floats]:
    """(count, 3) places of a spherical t with four degrees of freedom, z and -z, and the log of its density."""
    from scipy.stats import qmc  # late: `import implicam` is to stay quick

    u = np.clip(qmc.Sobol(5, scramble=True, rng=np.random.default_rng(0)).random(count // 2), 1e-6, 1 - 1e-6)
    chi2 = -2 * np.log(u[:, 3] * u[:, 4])  # with four degrees
    z = ndtri(u[:, :3]) / np.sqrt(chi2 / 4)[:, None]
    z = np.concatenate([z, -z])
    return z, gammaln(3.5) - 1.5 * np.log(4 * np.pi) - 3.5 * np.log1p(np.sum(z**2, axis=1) / 4)
