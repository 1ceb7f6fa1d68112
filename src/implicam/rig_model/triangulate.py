"""Where a point is, from what the cameras see: Bayes' rule by Gauss-Newton, eqs. (19) to (22) of docs/method.md."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from implicam.geometry import Bools, Floats
from implicam.gp.linalg import covariance_root
from implicam.rig_model.camera_model import apply_covariance_root
from implicam.rig_model.heavy_tails import consistency, equivalent_normal_noise, refine_positions
from implicam.rig_model.normal_equations import POINTS_PER_CHUNK, invert_stack
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.schur import Unknowns
from implicam.rig_model.settings import DEFAULT_SETTINGS, RigModelSettings
from implicam.rig_model.shot_errors import Shots
from implicam.rig_model.wrong_views import LinearisedViews, apply_weights, exclude_wrong_views
from implicam.threads import side_by_side

MAX_GAUSS_NEWTON_STEPS = 12
CONVERGED_STEP_SDS = 1e-3
"""Of a step, in standard deviations of the position."""

MIN_INFORMATION_RATIO = 1e-14
"""Of a position, in its worst direction over that in its best: what is less is rounding, and may be negative."""

STEPS_TO_MEND, HOPELESS_CHI_SQUARED = 3, 1e4
"""Steps after which chi-squared beyond this, at the end of the next step, will not come down to what is possible."""


class Located(NamedTuple):
    """xyz (n, 3) and cov (n, 3, 3), NaN where the point has no position; p (n,) that the views agree, NaN where it
    cannot be tested; left_out (n, C) the views not used; share (n,) of the variance that perfectly known cameras would
    not have, eq. (22a)."""

    xyz: Floats
    cov: Floats
    p: Floats
    left_out: Bools
    share: Floats


class Labels(NamedTuple):
    """How the known positions of a shot are off: the shots, their sds (k,) as fitted, what is known of the errors (None
    of shots too few to tell), and sds (6,) for error bars."""

    shots: Shots
    sd: Floats
    unknowns: Unknowns | None
    bars: Floats

    def off(self, x: Floats) -> Floats:
        """How far a label near each point is off, as far as it is known.

        Args:
            x: (n, 3) in the working frame.

        Returns:
            (n, 3) in the working frame; zero where nothing is known of the errors.
        """
        if self.unknowns is None:
            return np.zeros_like(x)
        return np.asarray(self.shots.label_slope(x, self.sd) @ self.unknowns.mean, dtype=np.float64)

    def own(self, x: Floats) -> Floats:
        """The error that a known position near each point may have besides.

        Args:
            x: (n, 3) in the working frame.

        Returns:
            (n, 3, 3) covariances in the working frame.
        """
        return np.nan_to_num(self.shots.unresolved_covariance(x, self.bars))

    def world(self, x: Floats) -> Floats:
        """How well the shots say what the world is there, which is made of their labels, eq. (28).

        Args:
            x: (n, 3) in the working frame.

        Returns:
            (n, 3, 3) covariances in the working frame.
        """
        return self.own(x) * np.nan_to_num(self.shots.world_variance_ratio(x))[:, None, None]


def locate(
    posterior: Posterior,
    uv: Floats,
    noise: Floats,
    labels: Labels | None = None,
    degrees: float | None = None,
    settings: RigModelSettings = DEFAULT_SETTINGS,
) -> Located:
    """Where points are, from what the cameras see, eqs. (19) to (22).

    Args:
        posterior: What is known of the C cameras.
        uv: Pixels (n, C, 2), NaN where a camera does not see a point.
        noise: (n, C) in pixels: the sd of normal noise, or the scale of a Student t.
        labels: How known positions are off; None where they are not.
        degrees: Degrees of freedom of the noise; None where it is normal.
        settings: Which views disagree, and which choice among them is clear.

    Returns:
        Positions in the working frame, NaN where a point has none.
    """
    if len(uv) == 0:
        none = np.zeros(uv.shape[:2], dtype=np.bool_)
        return Located(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), none, np.zeros(0))
    parts = [slice(i, i + POINTS_PER_CHUNK) for i in range(0, len(uv), POINTS_PER_CHUNK)]

    def one(part: slice) -> Located:
        return _locate(_Seen(posterior, uv[part], noise[part], labels, degrees, settings))

    found = side_by_side(one, parts)
    return Located(*(np.concatenate(columns) for columns in zip(*found, strict=True)))


def shared_errors(
    posterior: Posterior,
    uv: Floats,
    noise: Floats,
    xyz: Floats,
    left_out: Bools,
    labels: Labels | None = None,
    degrees: float | None = None,
    settings: RigModelSettings = DEFAULT_SETTINGS,
) -> Floats:
    """What the errors of located points have in common: how they follow from what is unknown of the cameras, and of
    the known positions, which is the same for all points; eq. (22b).

    Args:
        posterior: What is known of the C cameras.
        uv: Pixels (n, C, 2), NaN where a camera does not see a point.
        noise: (n, C) as of `locate`.
        xyz: (n, 3) as `locate` found them.
        left_out: (n, C) the views that it did not use.
        labels: As of `locate`.
        degrees: As of `locate`.
        settings: As of `locate`.

    Returns:
        E (n, 3, q): the error of a point is `E @ z` and an error of its own, z of q independent standard normal
        numbers that all points share. NaN where a point has no position.
    """
    seen = np.isfinite(uv).all(axis=2) & ~left_out
    found = np.flatnonzero(np.isfinite(xyz).all(axis=1))
    points = _Seen(posterior, uv, noise, labels, degrees, settings)
    rows = np.arange(len(uv))[found]
    step = POINTS_PER_CHUNK // 16  # what the views of each share with all others is large
    parts = [points.shared(rows[i : i + step], xyz, seen) for i in range(0, len(rows), step)]
    if not parts:
        return np.full((len(uv), 3, 0), np.nan)
    slopes = np.full((len(uv), 3, parts[0].shape[2]), np.nan)
    slopes[found] = np.concatenate(parts)
    return slopes


def _locate(points: _Seen) -> Located:
    seen = np.asarray(np.isfinite(points.uv).all(axis=2))
    xyz, cov, p = points.solve(np.arange(len(seen)), seen)
    left_out = np.zeros_like(seen)
    bad = np.flatnonzero((seen.sum(axis=1) >= 3) & ~(p >= points.settings.disagree_p_value))
    for some in np.split(bad, range(POINTS_PER_CHUNK // 16, len(bad), POINTS_PER_CHUNK // 16)):
        for better in exclude_wrong_views(points, some, seen[some]):
            rows = better.rows
            xyz[rows], cov[rows], p[rows], left_out[rows] = better.xyz, better.cov, better.p, better.left_out
    impossible = p < points.settings.min_p_value
    xyz[impossible], cov[impossible] = np.nan, np.nan
    return Located(xyz, cov, p, left_out, points.calibration_share(xyz, cov, seen & ~left_out))


@dataclass(frozen=True, eq=False)
class _Seen:
    """Points to be located, as `wrong_views` asks about them: pixels uv (n, C, 2) and noise (n, C)."""

    posterior: Posterior
    uv: Floats
    noise: Floats
    labels: Labels | None = None
    degrees: float | None = None
    settings: RigModelSettings = DEFAULT_SETTINGS

    def solve(self, rows: NDArray[np.int64], seen: Bools) -> tuple[Floats, Floats, Floats]:
        """Positions, covariances and p-values of points from the views `seen` alone."""
        start = meet_lines(*self.lines(rows), seen)
        found = _solve(self.posterior, start, self.uv[rows], self.noise[rows], seen, self.labels)
        if self.degrees is None:
            return found.xyz, found.cov, _p_value(found.chi2, seen.sum(axis=1))
        return self._by_t(found, rows, seen, self.degrees)

    def _by_t(
        self, found: _Solution, rows: NDArray[np.int64], seen: Bools, degrees: float
    ) -> tuple[Floats, Floats, Floats]:
        """The same with noise that is a t, from the solution with normal noise of the same scale."""
        good = np.flatnonzero(np.isfinite(found.x).all(axis=1))
        xyz, cov, p = found.xyz, found.cov, _p_value(found.chi2, seen.sum(axis=1))
        if not len(good):
            return xyz, cov, p
        rows, seen = rows[good], seen[good]
        linear = self.linearise(rows, found.x[good], seen)
        if linear.joint is None:
            better = refine_positions(linear, degrees, self.settings)
            xyz[good], cov[good] = found.x[good] + better.step, better.cov
            p[good] = consistency(better.distance, seen, degrees)
            return xyz, cov, p
        for _ in range(self.settings.reweightings):
            distance = np.einsum("nci,ncij,ncj->nc", linear.r, linear.each, linear.r)
            noise = equivalent_normal_noise(self.noise[rows], distance, seen, degrees)
            again = _solve(self.posterior, found.x[good], self.uv[rows], noise, seen, self.labels)
            linear = self.linearise(rows, again.x, seen, linear)
        xyz[good], cov[good] = again.xyz, again.cov
        distance = np.einsum("nci,ncij,ncj->nc", linear.r, linear.each, linear.r)
        p[good] = consistency(distance, seen, degrees)
        return xyz, cov, p

    def calibration_share(self, x: Floats, cov: Floats, seen: Bools) -> Floats:
        """(n,) share of the variance of positions x (n, 3) that perfectly known cameras would not have, eq. (22a);
        NaN where nothing is known of their errors."""
        share = np.full(len(x), np.nan)
        if not self.posterior.errors_known:
            return share
        rows = np.flatnonzero(np.isfinite(x).all(axis=1))
        x, cov, seen, noise = x[rows], cov[rows], seen[rows], self.noise[rows]
        if self.degrees is None:
            D = _residuals(self.posterior, x, self.uv[rows], seen)[1]
        else:
            linear = self.linearise(rows, x, seen)
            D, scale = linear.D, noise
            distance = np.einsum("nci,ncij,ncj->nc", linear.r, linear.each, linear.r)
            noise = equivalent_normal_noise(noise, distance, seen, self.degrees)
            if linear.joint is None:  # cov was integrated: its linear counterpart has the same weights as the noise
                more = (noise**2 - scale**2)[..., None, None] * np.eye(2)
                weight = np.linalg.inv(np.linalg.inv(linear.each) + np.where(seen[..., None, None], more, 0))
                cov = invert_stack(np.einsum("ncki,nckl,nclj->nij", D, weight, D))
        from_noise = invert_stack(np.einsum("ncki,nc,nckj->nij", D, noise**-2.0, D))
        parts = np.trace(from_noise, axis1=1, axis2=2) / np.trace(cov, axis1=1, axis2=2)
        share[rows] = np.clip(1 - parts, 0.0, 1.0)
        return share

    def shared(self, rows: NDArray[np.int64], xyz: Floats, seen: Bools) -> Floats:
        """(k, 3, q) of points rows (k,), whose errors are these times unknowns that all points share; xyz and seen are
        those of all points."""
        x, seen, noise = xyz[rows], seen[rows], self.noise[rows]
        weights = _Weights(self.posterior, x, noise, seen)
        r, D = _residuals(self.posterior, x, self.uv[rows], seen)
        if self.degrees is not None:
            distance = np.einsum("nci,ncij,ncj->nc", r, weights.each, r)
            weights = _Weights(self.posterior, x, equivalent_normal_noise(noise, distance, seen, self.degrees), seen)
        n, C = seen.shape
        WD = apply_weights(LinearisedViews(r, D, weights.each, weights.joint), D).reshape(n, 2 * C, 3)
        H = D.reshape(n, 2 * C, 3).swapaxes(1, 2) @ WD
        gain = np.where(seen.repeat(2, axis=1)[:, None], invert_stack(H) @ WD.swapaxes(1, 2), 0.0)
        E = weights.shared(gain)
        if self.labels is None or self.labels.unknowns is None:
            return E
        known = np.nan_to_num(self.labels.shots.label_slope(x, self.labels.sd))
        unknowns = self.labels.unknowns
        own = covariance_root(unknowns.covariance - unknowns.cross.T @ unknowns.cross)
        return np.concatenate([E + known @ unknowns.cross.T, known @ own], axis=2)

    def linearise(
        self, rows: NDArray[np.int64], x: Floats, seen: Bools, before: LinearisedViews | None = None
    ) -> LinearisedViews:
        """The views about x (n, 3)."""
        weights = _Weights(self.posterior, x, self.noise[rows], seen) if before is None else before
        r, D = _residuals(self.posterior, x, self.uv[rows], seen)
        return LinearisedViews(r, D, weights.each, weights.joint)

    def lines(self, rows: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """Centres (C, 3) and directions (n, C, 3) of the lines of sight."""
        return self._lines[0], self._lines[1][rows]

    @cached_property
    def _lines(self) -> tuple[Floats, Floats]:
        found = [model.camera.lines(self.uv[:, c]) for c, model in enumerate(self.posterior.models)]
        return np.array([centre for centre, _ in found]), np.stack([direction for _, direction in found], axis=1)


def _p_value(chi2: Floats, views: NDArray[np.int64]) -> Floats:
    degrees = np.maximum(2 * views - 3, 1)
    return np.where((views >= 2) & np.isfinite(chi2), chdtrc(degrees, chi2), np.nan)


def _solve(posterior: Posterior, x: Floats, uv: Floats, noise: Floats, seen: Bools, labels: Labels | None) -> _Solution:
    """Points with the views `seen` (n, C), from x (n, 3)."""
    n = len(uv)
    before = np.full((n, 3), np.nan)
    xyz, cov, chi2 = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), np.full(n, np.nan)
    rows = np.flatnonzero(np.isfinite(x).all(axis=1))
    x, uv, noise, seen = x[rows], uv[rows], noise[rows], seen[rows]
    done = np.zeros(len(rows), dtype=np.bool_)
    hopeless = done.copy()
    going = np.arange(len(rows))  # those that have not converged
    weights = _Weights(posterior, x, noise, seen)
    for iteration in range(MAX_GAUSS_NEWTON_STEPS):
        H, g, squares = weights.normal(x[going], uv[going], seen[going])
        step = _solve_stack(H, g)
        size = np.einsum("ni,nij,nj->n", step, H, step)
        x[going] += step
        done[going] = size < CONVERGED_STEP_SDS**2
        hopeless[going] = (iteration >= STEPS_TO_MEND) & (squares - size > HOPELESS_CHI_SQUARED)
        on = ~done[going] & ~hopeless[going] & np.isfinite(size)
        going = going[on]
        if not len(going):
            break
        if iteration in (0, 2, 5):
            weights = _Weights(posterior, x[going], noise[going], seen[going])
        elif not on.all():
            weights = weights.select(on)
    weights = _Weights(posterior, x, noise, seen)
    H, g, squares = weights.normal(x, uv, seen)
    step = _solve_stack(H, g)
    found = done & np.isfinite(H).all(axis=(1, 2)) & np.isfinite(step).all(axis=1)
    information = np.linalg.eigvalsh(np.where(found[:, None, None], H, np.eye(3)))
    found &= information[:, 0] > MIN_INFORMATION_RATIO * information[:, 2]
    covariance = invert_stack(H)
    found &= np.isfinite(covariance).all(axis=(1, 2))
    x = x + step
    before[rows[found]] = x[found]
    if labels is not None:
        x, covariance = _as_labelled(weights, labels, x, covariance, seen)
    kept = rows[found]
    xyz[kept] = x[found]
    cov[kept] = covariance[found]
    chi2[kept] = (squares - np.einsum("ni,ni->n", g, step))[found]
    chi2[rows[hopeless]] = HOPELESS_CHI_SQUARED
    return _Solution(xyz, cov, chi2, before)


class _Solution(NamedTuple):
    """Positions (n, 3), covariances and chi-squared (n,) of points, NaN where there is none; x (n, 3): the positions
    before labels are taken into account."""

    xyz: Floats
    cov: Floats
    chi2: Floats
    x: Floats


def _as_labelled(weights: _Weights, labels: Labels, x: Floats, cov: Floats, seen: Bools) -> tuple[Floats, Floats]:
    unknowns = labels.unknowns
    return as_labelled(labels, x, cov, None if unknowns is None else weights.with_cameras(x, cov, seen, unknowns.cross))


def as_labelled(labels: Labels, x: Floats, cov: Floats, with_unknowns: Floats | None) -> tuple[Floats, Floats]:
    """Positions and covariance in the world as labelled, eq. (22): a label near x is off, by what is known of its shot,
    and where no shot is near, the world itself is known as well as its labels.

    Args:
        labels: How known positions are off.
        x: (n, 3) positions, in the working frame.
        cov: (n, 3, 3) of them.
        with_unknowns: (n, 3, k) covariance of their errors with the unknowns of the labels, where there are any.

    Returns:
        The same of the labels that would be there.
    """
    unknown = labels.world(x)
    if labels.unknowns is None or with_unknowns is None:
        return x, cov + unknown
    known = np.nan_to_num(labels.shots.label_slope(x, labels.sd))
    own = known @ labels.unknowns.covariance @ known.swapaxes(1, 2)
    tied = with_unknowns @ known.swapaxes(1, 2)
    return x - known @ labels.unknowns.mean, cov + own + tied + tied.swapaxes(1, 2) + unknown


def covariance_of_world(
    posterior: Posterior, points: Floats, noise: Floats, seen: Bools, cov: Floats, labels: Labels
) -> Floats:
    """What the world as labelled adds to the covariance of positions, eq. (22).

    Args:
        posterior: What is known of the C cameras.
        points: (n, 3) in the working frame.
        noise: (n, C) of each view, in pixels.
        seen: (n, C) the views in use.
        cov: (n, 3, 3) without it.
        labels: How known positions are off.

    Returns:
        (n, 3, 3) in the working frame.
    """
    return _as_labelled(_Weights(posterior, points, noise, seen), labels, points, cov, seen)[1] - cov


def meet_lines(centres: Floats, directions: Floats, seen: Bools) -> Floats:
    """Where lines of sight meet best.

    Args:
        centres: (C, 3) of the cameras.
        directions: (n, C, 3) unit vectors, NaN for none.
        seen: (n, C) the lines to use.

    Returns:
        (n, 3), NaN for fewer than two lines, or where they (nearly) coincide.
    """
    good = seen & np.isfinite(directions).all(axis=2)
    d = np.where(good[..., None], directions, 0)
    across = good[..., None, None] * np.eye(3) - d[..., :, None] * d[..., None, :]
    A, b = across.sum(axis=1), np.einsum("ncij,cj->ni", across, centres)
    start = _solve_stack(A, b)
    start[(good.sum(axis=1) < 2) | (np.linalg.eigvalsh(A)[:, 0] < 1e-9)] = np.nan
    return start


def _residuals(posterior: Posterior, x: Floats, uv: Floats, seen: Bools) -> tuple[Floats, Floats]:
    """Residuals (n, C, 2) and slopes (n, C, 2, 3) of the views at x (n, 3); zero where not seen."""
    n, C = seen.shape
    r, D = np.zeros((n, C, 2)), np.zeros((n, C, 2, 3))
    for c, model in enumerate(posterior.models):
        mean, slope = model.predict(x)
        r[:, c] = np.where(seen[:, c, None], uv[:, c] - mean, 0.0)
        D[:, c] = np.where(seen[:, c, None, None], slope, 0.0)
    return r, D


class _Weights:
    """The inverse covariance of all views of each point, at one place: per camera, or joint where they are tied."""

    def __init__(self, posterior: Posterior, x: Floats, noise: Floats, seen: Bools) -> None:
        self.posterior = posterior
        rows = [model.rows(x) for model in posterior.models]
        n, C = seen.shape
        own = [(noise[:, c] ** 2 + rows[c].rest)[:, None, None] * np.eye(2) for c in range(C)]
        self.each = np.empty((n, C, 2, 2))
        self.joint: Floats | None = None
        self.halves: list[Floats] = []  # of ties: each camera's own
        if posterior.joint is None:
            self.halves = [apply_covariance_root(rows[c], posterior.alone[c]) for c in range(C)]
            own = [own[c] + _square(self.halves[c]) for c in range(C)]
        if not posterior.tied:
            for c in range(C):
                self.each[:, c] = invert_stack(np.where(seen[:, c, None, None], own[c], np.eye(2)))
            return
        self.half = np.concatenate([apply_covariance_root(rows[c], posterior.shared_root(c)) for c in range(C)], axis=1)
        S = _square(self.half).reshape(len(x), C, 2, C, 2)  # half is (n, 2C, sum P), of ties (n, 2C, q)
        for c in range(C):
            S[:, c, :, c] += own[c]
            self.each[:, c] = invert_stack(np.where(seen[:, c, None, None], S[:, c, :, c], np.eye(2)))
        both = seen[:, :, None, None, None] & seen[:, None, None, :, None]
        masked = np.where(both, S, np.eye(2 * C).reshape(C, 2, C, 2))
        self.joint = invert_stack(masked.reshape(len(x), 2 * C, 2 * C))

    def select(self, keep: Bools) -> _Weights:
        """Those of some points."""
        chosen = copy(self)
        chosen.each = self.each[keep]
        if self.joint is not None:
            chosen.joint, chosen.half = self.joint[keep], self.half[keep]
        return chosen

    def with_cameras(self, x: Floats, cov: Floats, seen: Bools, cross: Floats) -> Floats:
        """(n, 3, k) covariance of the positions' error with unknowns that `cross` ties to the cameras'."""
        assert self.joint is not None
        n, C = seen.shape
        D = np.stack([model.predict(x)[1] for model in self.posterior.models], axis=1)
        D = np.where(seen[..., None, None], D, 0).reshape(n, 2 * C, 3)
        through = np.where(seen.repeat(2, axis=1)[..., None], self._through(cross), 0)
        return np.asarray(cov @ D.swapaxes(1, 2) @ self.joint @ through, dtype=np.float64)

    def shared(self, gain: Floats) -> Floats:
        """(n, 3, q) how positions follow from the white unknowns of the cameras: `gain` (n, 3, 2C) of what the views
        are off, zero where not seen. In the order of `_through`."""
        parts = [gain[:, :, 2 * c : 2 * c + 2] @ np.nan_to_num(half) for c, half in enumerate(self.halves)]
        if self.posterior.tied:
            parts.append(gain @ np.nan_to_num(self.half))
        return np.concatenate(parts, axis=2)

    def _through(self, cross: Floats) -> Floats:
        """(n, 2C, k) covariance of what the cameras would see with unknowns that `cross` ties to the joint root."""
        if not self.halves:
            return np.asarray(self.half @ cross, dtype=np.float64)
        parts = np.split(cross, np.cumsum([half.shape[2] for half in self.halves]))
        own = [half @ part for half, part in zip(self.halves, parts[:-1], strict=True)]
        return np.asarray(np.concatenate(own, axis=1) + self.half @ parts[-1], dtype=np.float64)

    def normal(self, x: Floats, uv: Floats, seen: Bools) -> tuple[Floats, Floats, Floats]:
        """H (n, 3, 3), gradient (n, 3) and weighted squares (n,) of the residuals at x (n, 3)."""
        n, C = seen.shape
        r, D = _residuals(self.posterior, x, uv, seen)
        linear = LinearisedViews(r, D, self.each, self.joint)
        WD, Wr = apply_weights(linear, D), apply_weights(linear, r[..., None])[..., 0]
        Dt = D.reshape(n, 2 * C, 3).swapaxes(1, 2)
        H = Dt @ WD.reshape(n, 2 * C, 3)
        g = (Dt @ Wr.reshape(n, 2 * C, 1))[..., 0]
        return 0.5 * (H + H.swapaxes(1, 2)), g, np.sum(r * Wr, axis=(1, 2))


def _square(half: Floats) -> Floats:
    return np.asarray(half @ half.swapaxes(1, 2), dtype=np.float64)


def _solve_stack(A: Floats, b: Floats) -> Floats:
    """A^-1 b of stacks, NaN where A is singular or not finite."""
    return np.asarray(np.einsum("nij,nj->ni", invert_stack(A), b), dtype=np.float64)


def predict_covariance(posterior: Posterior, points: Floats, noise: Floats, seen: Bools) -> Floats:
    """The covariance that `locate` would state of points at known places, eq. (20).

    Args:
        posterior: What is known of the C cameras.
        points: (n, 3) in the working frame, where all cameras in use have an answer.
        noise: (n, C) of each view, in pixels.
        seen: (n, C) the views in use.

    Returns:
        (n, 3, 3) in the working frame; NaN with fewer than two views.
    """
    weights = _Weights(posterior, points, noise, seen)
    information, _, _ = weights.normal(points, np.zeros((*seen.shape, 2)), seen)
    information[seen.sum(axis=1) < 2] = np.nan
    return invert_stack(information)
