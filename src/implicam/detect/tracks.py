"""Where a camera saw moving points, picture by picture, and where they were between two pictures.

Between pictures a coordinate is a spline with an error bar: kriging in the pictures around, with the covariance of an
integrated Wiener process, of which a smoothing spline is the mean (Wahba 1978). Its acceleration, or the change of
that, is white noise; which of the two, how strong it is and how much more than stated the detections scatter, the track
says by its restricted likelihood.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import null_space

from implicam.dataset import Floats

Bools = NDArray[np.bool_]

WINDOW = 8
"""Pictures that a place between pictures is computed from."""

MAX_GAP_PERIODS = 2.5
"""Across a longer gap nothing is interpolated."""

MAX_POINTS_FITTED, MAX_WINDOWS_FITTED = 8, 300
"""Points, and windows of each, from which the process is estimated: more say the same."""

WRONG_STEPS, MIN_WRONG_PX = 15.0, 4.0
"""A detection is wrong that is farther from where those around put it than so many times the usual, and pixels."""

SHARP_SDS = 5.0
"""A picture that differs by so many standard deviations from what the others say is a turn too sharp for them."""


class Process(NamedTuple):
    """How points move: the derivative that is white noise, its strength (px² per period), the detections' excess."""

    order: int
    strength: float
    excess: float


class Places(NamedTuple):
    """(m, p, 2) pixels at m times, their standard uncertainties, and (m, p, 2) pixels per second."""

    uv: Floats
    sd: Floats
    velocity: Floats


@dataclass(frozen=True, eq=False)
class Track:
    """Where a camera saw points.

    camera: its name. times: (n,) seconds, ascending, by the camera's own clock. uv: (n, p, 2) pixels, NaN where not
    seen. sd: (n, p, 2) their standard uncertainties. points: p names. size: width and height of the pictures.
    numbers: (n,) which pictures of the film they are; empty where that does not matter.
    """

    camera: str
    times: Floats
    uv: Floats
    sd: Floats
    points: tuple[str, ...]
    size: tuple[int, int]
    numbers: NDArray[np.int_] = field(default_factory=lambda: np.zeros(0, np.int_))

    def __len__(self) -> int:
        return len(self.times)

    @cached_property
    def period(self) -> float:
        """The usual time from picture to picture, seconds."""
        return float(np.median(np.diff(self.times))) if len(self) > 1 else math.nan

    def select(self, points: Sequence[str]) -> Track:
        """The track of some points.

        Args:
            points: Names, in the order wanted.
        """
        columns = [self.points.index(name) for name in points]
        return replace(self, uv=self.uv[:, columns], sd=self.sd[:, columns], points=tuple(points))

    def without_wrong(self) -> tuple[Track, int]:
        """Without detections that those before and after contradict; and how many there were."""
        uv, dropped = self.uv.copy(), 0
        for p in range(uv.shape[1]):
            for _ in range(len(self) // 3 + 1):
                rows = np.flatnonzero(np.isfinite(uv[:, p, 0]))
                wrong = _find_wrong(self.times[rows], uv[rows, p])
                if not len(wrong):
                    break
                uv[rows[wrong], p] = np.nan
                dropped += len(wrong)
        return replace(self, uv=uv), dropped

    @cached_property
    def process(self) -> Process:
        """How the points move, estimated from the track."""
        return _estimate_process(self)

    @cached_property
    def sharp(self) -> Bools:
        """(n, p) where a picture is not where the ones around it say: a turn, or a blow, quicker than the film."""
        sharp = np.zeros(self.uv.shape[:2], dtype=np.bool_)
        for p in range(self.uv.shape[1]):
            rows = self._rows(p)
            if len(rows) <= WINDOW:
                continue
            around = _neighbours(len(rows), rows_of=np.arange(len(rows)), leave_out=True)
            found = self._krige(p, rows, around, self.times[rows])
            noise = self.process.excess * self.sd[rows, p].mean(axis=1)
            away = np.abs(self.uv[rows, p] - found.uv).max(axis=1)
            sharp[rows, p] = away > SHARP_SDS * np.sqrt(found.sd[:, 0] ** 2 + noise**2)
        return sharp

    def at(self, times: Floats) -> Places:
        """Where the points were.

        A time at which there is a picture gets what was found in it. Before the first picture, after the last one,
        inside a gap and beside a sharp turn there is nothing.

        Args:
            times: (m,) seconds by the clock of the track.

        Returns:
            NaN where that cannot be said.
        """
        shape = (len(times), self.uv.shape[1], 2)
        uv, sd, velocity = (np.full(shape, np.nan) for _ in range(3))
        for p in range(shape[1]):
            rows = self._rows(p)
            if len(rows) < WINDOW:
                rows_exact, at_exact = _match(self.times[rows], times, self.period)
                uv[at_exact, p], sd[at_exact, p] = self.uv[rows[rows_exact], p], self.sd[rows[rows_exact], p]
                continue
            after = np.searchsorted(self.times[rows], times)
            found = self._krige(p, rows, _neighbours(len(rows), rows_of=after, leave_out=False), times)
            inside = self._is_inside(p, rows, times, after)
            uv[inside, p], sd[inside, p] = found.uv[inside], found.sd[inside]
            velocity[inside, p] = found.velocity[inside]
            rows_exact, at_exact = _match(self.times[rows], times, self.period)
            uv[at_exact, p] = self.uv[rows[rows_exact], p]
            sd[at_exact, p] = self.process.excess * self.sd[rows[rows_exact], p]
            velocity[at_exact, p] = found.velocity[at_exact]
        return Places(uv, sd, velocity)

    def _rows(self, p: int) -> NDArray[np.int_]:
        return np.flatnonzero(np.isfinite(self.uv[:, p, 0]))

    def _is_inside(self, p: int, rows: NDArray[np.int_], times: Floats, after: NDArray[np.int_]) -> Bools:
        own = self.times[rows]
        sharp = self.sharp[rows, p]
        between = (after > 0) & (after < len(rows))
        right = np.clip(after, 1, len(rows) - 1)
        gap = own[right] - own[right - 1]
        return np.asarray(
            between & (gap <= MAX_GAP_PERIODS * self.period) & ~sharp[right] & ~sharp[right - 1], dtype=np.bool_
        )

    def _krige(self, p: int, rows: NDArray[np.int_], around: NDArray[np.int_], times: Floats) -> Places:
        """Places of a point at m times from the pictures `around` (m, k): (m, 2) each."""
        order, strength, excess = self.process
        own = self.times[rows]
        h = (own[around] - times[:, None]) / self.period
        noise = np.square(excess * self.sd[rows, p]).mean(axis=1)[around]
        weights, slopes, variance = _weights(h, order, strength, noise)
        values = self.uv[rows, p][around]
        uv = np.einsum("mk,mkc->mc", weights, values)
        velocity = np.einsum("mk,mkc->mc", slopes, values) / self.period
        return Places(uv, np.repeat(np.sqrt(np.maximum(variance, 0))[:, None], 2, axis=1), velocity)


def spline(track: Track, p: int, *, derivative: int = 0) -> CubicSpline:
    """A cubic spline through a point's pixels: quick, and smooth in time, for the search of an offset.

    Args:
        track: With four or more pictures of the point.
        p: The number of the point.
        derivative: 1 for pixels per second.
    """
    rows = np.flatnonzero(np.isfinite(track.uv[:, p, 0]))
    through = CubicSpline(track.times[rows], track.uv[rows, p])
    return through.derivative(derivative) if derivative else through


def _match(own: Floats, times: Floats, period: float) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Rows of `own` and `times` that are the same instant, to a millionth of a period."""
    if not len(own):
        return np.zeros(0, np.int_), np.zeros(0, np.int_)
    near = np.clip(np.searchsorted(own, times), 1, max(1, len(own) - 1))
    left = np.clip(near - 1, 0, len(own) - 1)
    near = np.minimum(near, len(own) - 1)
    nearest = np.where(np.abs(own[left] - times) <= np.abs(own[near] - times), left, near)
    same = np.abs(own[nearest] - times) <= 1e-6 * (period if math.isfinite(period) else 1.0)
    return nearest[same], np.flatnonzero(same)


def _neighbours(n: int, *, rows_of: NDArray[np.int_], leave_out: bool) -> NDArray[np.int_]:
    """(m, WINDOW) of n rows around where a time would be inserted, or around a row without itself."""
    half = WINDOW // 2
    size = WINDOW + leave_out
    first = np.clip(rows_of - half, 0, n - size)
    around = first[:, None] + np.arange(size)
    if not leave_out:
        return around
    keep = around != rows_of[:, None]
    return np.asarray(around[keep].reshape(len(rows_of), WINDOW), np.int_)


def _covariance(h: Floats, order: int) -> Floats:
    """The generalised covariance of a process whose derivative of that order is white noise of strength 1."""
    power = 2 * order - 1
    return np.asarray((-1) ** order * np.abs(h) ** power / (2 * math.factorial(power)), np.float64)


def _weights(h: Floats, order: int, strength: float, noise: Floats) -> tuple[Floats, Floats, Floats]:
    """Universal kriging at 0 from places h (m, k) with noise variances (m, k).

    Returns:
        Weights (m, k), those of the derivative, and the variance (m,) of the first.
    """
    m, k = h.shape
    inner = strength * _covariance(h[:, :, None] - h[:, None, :], order)
    drift = h[:, :, None] ** np.arange(order)
    system = np.zeros((m, k + order, k + order))
    system[:, :k, :k] = inner + noise[:, :, None] * np.eye(k)
    system[:, :k, k:], system[:, k:, :k] = drift, drift.transpose(0, 2, 1)
    right = np.zeros((m, k + order, 2))
    to_zero = strength * _covariance(h, order)
    right[:, :k, 0] = to_zero
    # d/dt of c(h - t) at t = 0; c is even, so its slope is odd
    right[:, :k, 1] = (
        -strength * (-1) ** order * np.sign(h) * np.abs(h) ** (2 * order - 2) / (2 * math.factorial(2 * order - 2))
    )
    right[:, k, 0] = 1
    right[:, k + 1, 1] = 1
    solved = np.linalg.solve(system, right)[:, :k]
    w = solved[:, :, 0]
    variance = np.einsum("mi,mij,mj->m", w, inner, w) + (w**2 * noise).sum(axis=1) - 2 * (w * to_zero).sum(axis=1)
    return w, solved[:, :, 1], variance


def _estimate_process(track: Track) -> Process:
    """Maximise the restricted likelihood of windows, from which a polynomial is removed."""
    spacing, contrasts, noise = [], [], []
    step = max(1, track.uv.shape[1] // MAX_POINTS_FITTED)
    for p in range(0, track.uv.shape[1], step):
        rows = track._rows(p)
        starts = np.arange(0, len(rows) - WINDOW + 1, WINDOW)
        for start in starts[:: max(1, len(starts) // MAX_WINDOWS_FITTED)]:
            own = rows[start : start + WINDOW]
            h = (track.times[own] - track.times[own].mean()) / track.period
            if h[-1] - h[0] > 2 * WINDOW:
                continue
            spacing.append(h)
            contrasts.append(track.uv[own, p])
            noise.append(np.square(track.sd[own, p]).mean(axis=1))
    if not spacing:
        return Process(2, 1.0, 1.0)
    h, values, variances = np.array(spacing), np.array(contrasts), np.array(noise)
    found = [_fit_order(order, h, values, variances) for order in (2, 3)]
    return max(found)[1]


def _fit_order(order: int, h: Floats, values: Floats, variances: Floats) -> tuple[float, Process]:
    # With contrasts A orthogonal to polynomials: A y ~ N(0, strength A K A' + excess² A D A'). The likelihood of all
    # orders has the same degrees of freedom only if all remove the same polynomial, so the larger one is removed.
    basis = np.array([null_space((one[:, None] ** np.arange(3)).T).T for one in h])
    kernel = np.einsum("wik,wkl,wjl->wij", basis, _covariance(h[:, :, None] - h[:, None, :], order), basis)
    plain = np.einsum("wik,wk,wjk->wij", basis, variances, basis)
    seen = np.einsum("wik,wkc->wic", basis, values)
    floor = float(np.median(variances))
    best = (-np.inf, Process(order, 1.0, 1.0))
    for excess in (1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0):
        for strength in floor * 10.0 ** np.arange(-4, 8.1, 0.5):
            s = strength * kernel + excess**2 * plain
            factor = np.linalg.cholesky(s + 1e-12 * floor * np.eye(s.shape[1]))
            white = np.linalg.solve(factor, seen)
            per_window = -0.5 * np.square(white).sum(axis=(1, 2)) - 2 * np.log(
                np.diagonal(factor, axis1=1, axis2=2)
            ).sum(axis=1)
            score = float(per_window.sum())
            if score > best[0]:
                best = score, Process(order, float(strength), excess)
    return best


def _find_wrong(times: Floats, uv: Floats) -> NDArray[np.int_]:
    """Rows that the two before and the two after contradict; of neighbours only the worst."""
    n = len(times)
    if n < 7:
        return np.zeros(0, np.int_)
    rows = np.clip(np.arange(n), 2, n - 3)
    around = rows[:, None] + np.array([-2, -1, 0, 1, 2])
    keep = around != np.arange(n)[:, None]
    keep[keep.sum(axis=1) == 5, 4] = False
    around = around[keep].reshape(n, 4)
    h = times[around] - times[:, None]
    away = np.empty(n)
    weights = np.ones((n, 4))
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[:, i] *= h[:, j] / (h[:, j] - h[:, i])
    away = np.linalg.norm(np.einsum("nk,nkc->nc", weights, uv[around]) - uv, axis=1) / np.sqrt(
        1 + np.square(weights).sum(axis=1)
    )
    usual = np.array([np.median(away[max(0, i - 15) : i + 16]) for i in range(n)])
    over = away / np.maximum(WRONG_STEPS * usual, MIN_WRONG_PX)
    worst = np.array([over[max(0, i - 3) : i + 4].max() for i in range(n)])
    return np.flatnonzero((over > 1) & (over == worst))
