"""Where a point is, from what the cameras see: Bayes' rule by Gauss-Newton, eqs. (19) to (22) of docs/method.md."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from implicam.calibrators.forward_gp.lens import Floats
from implicam.calibrators.forward_gp.posterior import CHUNK, Posterior, Unknowns, spread
from implicam.calibrators.forward_gp.shots import Shots
from implicam.threads import side_by_side

Bools = NDArray[np.bool_]

ITERATIONS = 12
CONVERGED = 1e-3
"""Of a step, in standard deviations of the position."""

DISAGREE = 1e-4
"""Below this p-value the views disagree, and one or two are looked for that the others would do better without."""

AGREE = 1e-3
"""The p-value that the others must have among themselves then."""

CLEARLY = 100.0
"""How many times better they must agree than without any other view."""

IMPOSSIBLE = 1e-10
"""Below this p-value there is no position, but a wrong match: a number would be worse than none."""


class Located(NamedTuple):
    """xyz (n, 3) and cov (n, 3, 3), NaN where the point has no position; p (n,) that the views agree, NaN where it
    cannot be tested; left_out (n, C) the views not used."""

    xyz: Floats
    cov: Floats
    p: Floats
    left_out: Bools


class Labels(NamedTuple):
    """How the known positions of a shot are off: the shots, their sds (k,) as fitted, what is known of the errors (None
    of shots too few to tell), and sds (6,) for error bars."""

    shots: Shots
    sd: Floats
    unknowns: Unknowns | None
    bars: Floats

    def off(self, x: Floats) -> Floats:
        """(n, 3) how far a label near each of x (n, 3) is off, as far as it is known."""
        if self.unknowns is None:
            return np.zeros_like(x)
        return np.asarray(self.shots.labels(x, self.sd)[0] @ self.unknowns.mean, dtype=np.float64)

    def own(self, x: Floats) -> Floats:
        """(n, 3, 3) covariance of the error that a known position near each of x (n, 3) may have besides."""
        return np.nan_to_num(self.shots.untold(x, self.bars))

    def world(self, x: Floats) -> Floats:
        """(n, 3, 3) how well the shots say what the world is there, which is made of their labels, eq. (28)."""
        return self.own(x) * np.nan_to_num(self.shots.drawn_along(x))[:, None, None]


def locate(posterior: Posterior, uv: Floats, noise: Floats, labels: Labels | None = None) -> Located:
    """Points from pixels uv (n, C, 2), NaN where not seen, with noise (n, C) in pixels."""
    if len(uv) == 0:
        return Located(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros(uv.shape[:2], dtype=np.bool_))
    parts = [slice(i, i + CHUNK) for i in range(0, len(uv), CHUNK)]
    found = side_by_side(lambda part: _locate(posterior, uv[part], noise[part], labels), parts)
    return Located(*(np.concatenate(columns) for columns in zip(*found, strict=True)))


def _locate(posterior: Posterior, uv: Floats, noise: Floats, labels: Labels | None) -> Located:
    seen = np.asarray(np.isfinite(uv).all(axis=2))
    xyz, cov, chi2 = _solve(posterior, uv, noise, seen, labels)
    p = _p_value(chi2, seen.sum(axis=1))
    left_out = np.zeros_like(seen)
    for count in (1, 2):  # two wrong views among five can still be told
        bad = np.flatnonzero((seen.sum(axis=1) >= 2 * count + 1) & ~(p >= DISAGREE))
        for some in np.split(bad, range(CHUNK // 16, len(bad), CHUNK // 16)):
            _leave_out(posterior, (uv[some], noise[some], seen[some]), labels, count, some, (xyz, cov, p, left_out))
    impossible = p < IMPOSSIBLE
    xyz[impossible], cov[impossible] = np.nan, np.nan
    return Located(xyz, cov, p, left_out)


def _leave_out(
    posterior: Posterior,
    views: tuple[Floats, Floats, Bools],
    labels: Labels | None,
    count: int,
    rows: NDArray[np.int64],
    out: tuple[Floats, Floats, Floats, Bools],
) -> None:
    """For points whose views disagree: leave out the `count` views that clearly are the wrong ones, if there are."""
    uv, noise, seen = views
    n, C = seen.shape
    if n == 0:
        return
    groups = list(combinations(range(C), count))
    tried, ps = [], np.full((n, len(groups)), -1.0)
    for k, group in enumerate(groups):
        there = np.asarray(seen[:, group].all(axis=1))
        without = seen & there[:, None]
        without[:, group] = False
        x, cov, chi2 = _solve(posterior, uv, noise, without, labels)
        p = _p_value(chi2, without.sum(axis=1))
        ps[:, k] = np.where(there & np.isfinite(p), p, -1.0)
        tried.append((x, cov))
    best = np.argmax(ps, axis=1)
    ordered = np.sort(ps, axis=1)
    second = np.maximum(ordered[:, -2], 0) if len(groups) > 1 else np.zeros(n)
    xyz, cov, p_values, left_out = out
    for row in np.flatnonzero((ordered[:, -1] > AGREE) & (ordered[:, -1] > CLEARLY * second)):
        i, k = rows[row], best[row]
        xyz[i], cov[i], p_values[i] = tried[k][0][row], tried[k][1][row], ps[row, k]
        left_out[i, groups[k]] = True


def _p_value(chi2: Floats, views: NDArray[np.int64]) -> Floats:
    degrees = np.maximum(2 * views - 3, 1)
    return np.where((views >= 2) & np.isfinite(chi2), chdtrc(degrees, chi2), np.nan)


def _solve(
    posterior: Posterior, uv: Floats, noise: Floats, seen: Bools, labels: Labels | None
) -> tuple[Floats, Floats, Floats]:
    """Position, covariance and chi-squared (n,) of points with the views `seen` (n, C); NaN where there is none."""
    n = len(uv)
    xyz, cov, chi2 = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), np.full(n, np.nan)
    x = _start(posterior, uv, seen)
    rows = np.flatnonzero(np.isfinite(x).all(axis=1))
    x, uv, noise, seen = x[rows], uv[rows], noise[rows], seen[rows]
    done = np.zeros(len(rows), dtype=np.bool_)
    weights = _Weights(posterior, x, noise, seen)
    for iteration in range(ITERATIONS):
        H, g, squares = weights.normal(x, uv, seen)
        step = _solved(H, g)
        size = np.einsum("ni,nij,nj->n", step, H, step)
        x = x + step
        done = size < CONVERGED**2
        last = iteration == ITERATIONS - 1 or bool((done | ~np.isfinite(size)).all())
        if last or iteration in (0, 2, 5):
            weights = _Weights(posterior, x, noise, seen)
        if last:
            break
    H, g, squares = weights.normal(x, uv, seen)
    step = _solved(H, g)
    found = done & np.isfinite(H).all(axis=(1, 2)) & np.isfinite(step).all(axis=1)
    covariance = _inverted(H)
    found &= np.isfinite(covariance).all(axis=(1, 2))
    x = x + step
    if labels is not None:
        x, covariance = _as_labelled(weights, labels, x, covariance, seen)
    kept = rows[found]
    xyz[kept] = x[found]
    cov[kept] = covariance[found]
    chi2[kept] = (squares - np.einsum("ni,ni->n", g, step))[found]
    return xyz, cov, chi2


def _as_labelled(weights: _Weights, labels: Labels, x: Floats, cov: Floats, seen: Bools) -> tuple[Floats, Floats]:
    """Positions (n, 3) and covariance in the world as labelled, eq. (22): a label near x is off, by what is known of
    its shot, and where no shot is near, the world itself is known as well as its labels."""
    unknown = labels.world(x)
    if labels.unknowns is None:
        return x, cov + unknown
    known = np.nan_to_num(labels.shots.labels(x, labels.sd)[0])
    own = known @ labels.unknowns.covariance @ known.swapaxes(1, 2)
    tied = weights.with_cameras(x, cov, seen, labels.unknowns.cross) @ known.swapaxes(1, 2)
    return x - known @ labels.unknowns.mean, cov + own + tied + tied.swapaxes(1, 2) + unknown


def _start(posterior: Posterior, uv: Floats, seen: Bools) -> Floats:
    """(n, 3) where the lines of sight meet best; NaN for fewer than two, or where they (nearly) coincide."""
    n = len(uv)
    A, b = np.zeros((n, 3, 3)), np.zeros((n, 3))
    count = np.zeros(n)
    for c, model in enumerate(posterior.models):
        centre, direction = model.camera.lines(np.where(seen[:, c, None], uv[:, c], np.nan))
        good = np.isfinite(direction).all(axis=1)
        d = direction[good]
        across = np.eye(3) - d[:, :, None] * d[:, None, :]
        A[good] += across
        b[good] += across @ centre
        count += good
    start = _solved(A, b)
    start[(count < 2) | (np.linalg.eigvalsh(A)[:, 0] < 1e-9)] = np.nan
    return start


class _Weights:
    """The inverse covariance of all views of each point, at one place: per camera, or joint where they are tied."""

    def __init__(self, posterior: Posterior, x: Floats, noise: Floats, seen: Bools) -> None:
        self.models = posterior.models
        rows = [model.rows(x) for model in self.models]
        C = len(self.models)
        own = [(noise[:, c] ** 2 + rows[c].rest)[:, None, None] * np.eye(2) for c in range(C)]
        self.each: list[Floats] = []
        self.joint: Floats | None = None
        self.halves: list[Floats] = []  # of ties: each camera's own
        if posterior.joint is None:
            self.halves = [spread(rows[c], posterior.alone[c]) for c in range(C)]
            own = [own[c] + _square(self.halves[c]) for c in range(C)]
        if not posterior.tied:
            for c in range(C):
                self.each.append(_inverted(np.where(seen[:, c, None, None], own[c], np.eye(2))))
            return
        self.half = np.concatenate([spread(rows[c], posterior.shared_root(c)) for c in range(C)], axis=1)
        S = _square(self.half).reshape(len(x), C, 2, C, 2)  # half is (n, 2C, sum P), of ties (n, 2C, q)
        for c in range(C):
            S[:, c, :, c] += own[c]
        both = seen[:, :, None, None, None] & seen[:, None, None, :, None]
        masked = np.where(both, S, np.eye(2 * C).reshape(C, 2, C, 2))
        self.joint = _inverted(masked.reshape(len(x), 2 * C, 2 * C))

    def with_cameras(self, x: Floats, cov: Floats, seen: Bools, cross: Floats) -> Floats:
        """(n, 3, k) covariance of the positions' error with unknowns that `cross` ties to the cameras'."""
        assert self.joint is not None
        n, C = seen.shape
        D = np.stack([model.predict(x)[1] for model in self.models], axis=1)
        D = np.where(seen[..., None, None], D, 0).reshape(n, 2 * C, 3)
        through = np.where(seen.repeat(2, axis=1)[..., None], self._through(cross), 0)
        return np.asarray(cov @ D.swapaxes(1, 2) @ self.joint @ through, dtype=np.float64)

    def _through(self, cross: Floats) -> Floats:
        """(n, 2C, k) covariance of what the cameras would see with unknowns that `cross` ties to the joint root."""
        if not self.halves:
            return np.asarray(self.half @ cross, dtype=np.float64)
        parts = np.split(cross, np.cumsum([half.shape[2] for half in self.halves]))
        own = [half @ part for half, part in zip(self.halves, parts[:-1], strict=True)]
        return np.asarray(np.concatenate(own, axis=1) + self.half @ parts[-1], dtype=np.float64)

    def normal(self, x: Floats, uv: Floats, seen: Bools) -> tuple[Floats, Floats, Floats]:
        """H (n, 3, 3), gradient (n, 3) and weighted squares (n,) of the residuals at x (n, 3)."""
        n, C = len(x), len(self.models)
        r, D = np.zeros((n, C, 2)), np.zeros((n, C, 2, 3))
        for c, model in enumerate(self.models):
            mean, slope = model.predict(x)
            r[:, c] = np.where(seen[:, c, None], uv[:, c] - mean, 0.0)
            D[:, c] = np.where(seen[:, c, None, None], slope, 0.0)
        if self.joint is None:
            W = np.stack(self.each, axis=1)  # (n, C, 2, 2)
            WD, Wr = W @ D, (W @ r[..., None])[..., 0]
        else:
            WD = (self.joint @ D.reshape(n, 2 * C, 3)).reshape(D.shape)
            Wr = (self.joint @ r.reshape(n, 2 * C, 1)).reshape(r.shape)
        Dt = D.reshape(n, 2 * C, 3).swapaxes(1, 2)
        H = Dt @ WD.reshape(n, 2 * C, 3)
        g = (Dt @ Wr.reshape(n, 2 * C, 1))[..., 0]
        return 0.5 * (H + H.swapaxes(1, 2)), g, np.sum(r * Wr, axis=(1, 2))


def _square(half: Floats) -> Floats:
    return np.asarray(half @ half.swapaxes(1, 2), dtype=np.float64)


def _solved(A: Floats, b: Floats) -> Floats:
    """A^-1 b of stacks, NaN where A is singular or not finite."""
    return np.asarray(np.einsum("nij,nj->ni", _inverted(A), b), dtype=np.float64)


def _inverted(A: Floats) -> Floats:
    """Inverses of a stack of symmetric matrices, NaN where there is none."""
    good = np.asarray(np.isfinite(A).all(axis=(1, 2)))
    out = np.full(A.shape, np.nan)
    try:
        inverse = np.linalg.inv(A[good])
    except np.linalg.LinAlgError:  # some are singular to the last bit: find out which
        good[good] = np.linalg.matrix_rank(A[good], hermitian=True) == A.shape[1]
        inverse = np.linalg.inv(A[good])
    out[good] = 0.5 * (inverse + inverse.swapaxes(1, 2))
    return out
