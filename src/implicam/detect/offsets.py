"""How the clocks of cameras differ, from a target that both see move, without any calibration.

At the right offset the pixels of two cameras satisfy one epipolar equation, b' F a = 0, at every instant. The search:

1. Along a line of sight no camera sees anything, so velocities in two cameras (2 + 2 numbers) have but three of the
   world behind them: at the right offset they are related. The canonical correlations of the velocities at all offsets
   (Hotelling 1936; all at once, by FFT) give the candidates.
2. Each is refined: Sampson's distances to the epipolar lines are least, with a drift of the clocks and a radial
   distortion of either lens (the division model, Fitzgibbon 2001) as further unknowns.
3. Uncertainty by a jackknife over pieces of the film, so that errors that are alike from picture to picture count once.

It refuses what it cannot tell: a target at rest, a movement that fits at several offsets, or at all of them. A throw
without a bounce, a straight line and a steady circle, screw or pendulum are such movements, for a later part of them
is an image of an earlier one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize_scalar
from scipy.special import stdtrit

from implicam.dataset import Floats
from implicam.detect.tracks import MAX_GAP_PERIODS, Track, spline
from implicam.errors import ImplicamError

MIN_PICTURES, MIN_SHARE = 40, 0.4
"""Pictures that both must have seen of the target at an offset that is considered, and their part of those that one of
them saw it in: any movement fits some other for a moment."""

TOO_LITTLE = 1e12
"""The residual at an offset at which both saw too little: a number, for a search by halving knows no infinity."""

MAX_CANDIDATES, MAX_POINTS = 10, 8
"""Offsets that are refined, and points of a target that are used."""

RIVAL_RATIO, RIVAL_GAIN = 1.5, 0.3
"""An offset whose residual is no larger than this times the best one's, and that explains this part of what the best
one explains, fits as well."""

WORTH_FITTING = 4.0
"""Of the candidates, those with less than so many times the least residual are fitted with all that is unknown."""

MIN_CONTRAST = 8.0
"""How many times larger the residual at any other offset must be, usually, than at the one that is found."""

DRIFT_SD, DISTORTION_SD = 2e-4, 0.3
"""Before anything was seen: how far clocks run apart, seconds per second (a quartz: 5e-5, a nominal frame rate that is
not quite true: more); and the coefficient of the division model, with half of the diagonal as the unit of length."""

PIECES = 24
"""Parts of the film whose errors are taken as independent of each other."""

JUMP_SDS, MAX_NOISE, CLEARLY = 5.0, 3.0, 3.0
"""Offsets of parts of a film that differ by so many standard deviations say that pictures are missing; the largest
residual, in standard deviations of the detections, of a part that fits; and how many times larger it must be at the
offset of the whole film."""

MAX_SCANNED = 300
"""Places that the search for an offset compares; the fit compares all."""

Span = tuple[float, float]
"""From one time to another, by the clock of the first track."""

WHOLE: Span = (-math.inf, math.inf)


Rows = NDArray[np.intp]


class OffsetError(ImplicamError):
    """The offset between two cameras cannot be told from what they saw."""


class Offset(NamedTuple):
    """By how much the clock of a camera is behind: add it to the camera's times to get those of the other.

    seconds, sd: with its standard uncertainty, in the middle of what both saw. drift: seconds per second; drift_sd.
    around: the camera's own time of that middle. pictures: how many were compared. residual: of the epipolar equation,
    in standard deviations of the detections. rival: how many times larger the residual of the next best offset is,
    infinite where none comes near.
    """

    seconds: float
    sd: float
    drift: float
    drift_sd: float
    around: float
    pictures: int
    residual: float
    rival: float


def find_offset(first: Track, second: Track) -> Offset:
    """The offset of the second camera's clock to the first one's.

    Args:
        first: Where a camera saw points; cleaned of wrong detections.
        second: Where another one saw some of the same points.

    Raises:
        OffsetError: It cannot be told, and why.
    """
    names = (first.camera, second.camera)
    common = [name for name in first.points if name in second.points]
    if not common:
        raise _cannot(names, "they saw no point of the same name", "film the same target with both")
    common = common[:: -(-len(common) // MAX_POINTS)]
    a, b = first.select(common), second.select(common)
    turned = len(a) > len(b)  # the slower film is compared at its own pictures, so that no picture counts twice
    if turned:
        a, b = b, a
    pair = _Pair(a, b)
    best, rival = _choose(sorted(map(pair.search, pair.candidates(names))), pair, names)
    found = pair.judge(best, rival, names)
    return found if turned else found._replace(seconds=-found.seconds, drift=-found.drift, around=pair.b_middle(best))


def _cannot(names: tuple[str, str], why: str, fix: str) -> OffsetError:
    return OffsetError(
        f"the offset between the clocks of {names[0]!r} and {names[1]!r} cannot be told from their films.",
        why=why,
        fix=fix,
    )


RICHER = "film the target moving with turns and changes of speed, in all directions; or give --times, or --offsets"


@dataclass(frozen=True, eq=False)
class _Fit:
    """values: offset (b's clock minus a's, seconds), drift, two distortions, nine of F. scale: the robust residual."""

    values: Floats
    scale: float
    rows: Rows


class _Pair:
    """Two tracks of the same points, and splines through the second one."""

    def __init__(self, a: Track, b: Track) -> None:
        self.a, self.b = a, b
        self._splines, self._own = [], []
        for p in range(b.uv.shape[1]):
            own = b.times[np.isfinite(b.uv[:, p, 0])]
            self._own.append(own)
            self._splines.append(spline(b, p) if len(own) >= 4 else None)
        rows, points = np.nonzero(np.isfinite(a.uv[:, :, 0]))
        self._times, self._points = a.times[rows], points
        self._uv, self._sd = a.uv[rows, points], a.sd[rows, points].mean(axis=1)
        seen = [int(np.isfinite(track.uv[:, :, 0]).any(axis=1).sum()) * track.period for track in (a, b)]
        self._most = min(seen) / a.period  # pictures of `a` that both could have seen the target in
        self._b_sd = float(np.nanmedian(b.sd)) if np.isfinite(b.sd).any() else math.nan

    # ---- candidates

    def candidates(self, names: tuple[str, str]) -> list[float]:
        """Offsets worth a closer look, the likeliest first."""
        step = max(self.a.period, self.b.period)
        (a, a_start), (b, b_start) = _velocities(self.a, step), _velocities(self.b, step)
        for track, velocity, name in ((self.a, a, self.a.camera), (self.b, b, self.b.camera)):
            noise = 2 * float(np.nanmedian(track.sd)) ** 2
            if np.isfinite(velocity[:, 0]).sum() < MIN_PICTURES:
                raise _cannot(names, f"{name!r} saw the target in too few pictures in a row", "film it for longer")
            if np.nanmean(velocity**2) < 4 * noise:
                raise _cannot(names, f"in the film of {name!r} the target rests", RICHER)
        score, lags = _correlate(a, b)
        if not np.isfinite(score).any():
            raise _cannot(names, "at no offset both saw the target for long enough", "film it for longer")
        peaks = [
            i
            for i in np.argsort(-np.where(np.isfinite(score), score, -np.inf))
            if np.isfinite(score[i]) and score[i] >= np.nanmax(score[max(0, i - 2) : i + 3])
        ]
        return [float(b_start - a_start + lags[i] * step) for i in peaks[:MAX_CANDIDATES]]

    # ---- the epipolar fit

    def _compared(self, offset: float, span: Span = WHOLE) -> Rows:
        """The rows of `a` for which `b` has a place near its own pictures, with a margin for offsets close by."""
        good = np.zeros(len(self._times), dtype=np.bool_)
        period, margin = self.b.period, 1.5 * self.b.period
        for p, own in enumerate(self._own):
            if self._splines[p] is None:
                continue
            mine = self._points == p
            at = self._times[mine] + offset
            after = np.clip(np.searchsorted(own, at), 1, len(own) - 1)
            gap = own[after] - own[after - 1] <= MAX_GAP_PERIODS * period
            good[mine] = gap & (at > own[0] + margin) & (at < own[-1] - margin)
        return np.flatnonzero(good & (self._times >= span[0]) & (self._times <= span[1]))

    def _b_at(self, rows: Rows, offset: float, drift: float) -> Floats:
        times = self._times[rows]
        at = times + offset + drift * (times - times.mean())
        uv = np.empty((len(rows), 2))
        for p, curve in enumerate(self._splines):
            mine = self._points[rows] == p
            if mine.any() and curve is not None:
                uv[mine] = curve(at[mine])
        return uv

    def search(self, offset: float, span: Span = WHOLE) -> tuple[float, float]:
        """The residual of the best F near a candidate, without drift or distortion, and where."""
        step = max(self.a.period, self.b.period)
        coarse = min((self._scan(offset + k * step, span), offset + k * step) for k in np.arange(-3, 3.01, 0.5))
        if coarse[0] >= TOO_LITTLE:
            return coarse
        fine = minimize_scalar(
            self._scan, args=(span,), bounds=(coarse[1] - 0.5 * step, coarse[1] + 0.5 * step), method="bounded",
            options={"xatol": 0.01 * step},
        )  # fmt: skip
        return min((float(fine.fun), float(fine.x)), coarse)

    def fit(self, offset: float, span: Span = WHOLE) -> _Fit | None:
        """All that is unknown, from an offset that is nearly right; None where too little is seen there."""
        found = None
        for _ in range(4):  # the pictures that are compared follow the offset
            rows = self._compared(offset, span)
            if not self._enough(rows, span):
                return None
            found = _Fit(*_Epipolar(self, rows, offset).solve(), rows)
            if abs(found.values[0] - offset) < 0.5 * self.b.period:
                break
            offset = float(found.values[0])
        return found

    def _enough(self, rows: Rows, span: Span) -> bool:
        pictures = len(np.unique(self._times[rows]))
        share = MIN_SHARE if span == WHOLE else 0.0
        return pictures >= max(MIN_PICTURES, share * self._most)

    def _scan(self, offset: float, span: Span = WHOLE) -> float:
        """The residual of the best F at an offset, quickly; `TOO_LITTLE` where too little is seen there."""
        rows = self._compared(offset, span)
        if not self._enough(rows, span):
            return TOO_LITTLE
        return _Epipolar(self, rows[:: -(-len(rows) // MAX_SCANNED)], offset).linear()[1]

    # ---- what the fit is worth

    def b_middle(self, fit: _Fit) -> float:
        """The time, by b's clock, of the middle of what both saw."""
        return float(self._times[fit.rows].mean() + fit.values[0])

    def usual(self, fit: _Fit) -> float:
        """The usual residual at offsets that are wrong."""
        away = np.concatenate([np.linspace(-4, -0.3, 12), np.linspace(0.3, 4, 12)])
        scales = [self._scan(fit.values[0] + seconds) for seconds in away]
        known = [scale for scale in scales if scale < TOO_LITTLE]
        return float(np.median(known)) if known else math.inf

    def gain(self, fit: _Fit) -> float:
        """How much better the tracks fit than at wrong offsets, nats over all pictures; zero where it says nothing.

        What moves simply fits at any offset, such as the few pictures that two films have in common at a large one.
        """
        contrast = self.usual(fit) / fit.scale
        pictures = len(np.unique(self._times[fit.rows]))
        return pictures * math.log(contrast) if contrast > MIN_CONTRAST else 0.0

    def judge(self, fit: _Fit, rival: float, names: tuple[str, str]) -> Offset:
        """The offset with its uncertainty, as b's clock minus a's; OffsetError where it is not told."""
        sd, drift_sd = np.sqrt(np.diag(self._covariance(fit)))
        if not sd < 0.5 * max(self.a.period, self.b.period):
            raise _cannot(names, f"all offsets within {2 * sd:.2g} s fit alike: the movement is too simple", RICHER)
        self.refuse_jump(fit, max(MAX_NOISE, 1.5 * fit.scale), names)
        times = self._times[fit.rows]
        return Offset(
            float(fit.values[0]), float(sd), float(fit.values[1]), float(drift_sd), float(times.mean()),
            len(np.unique(times)), fit.scale, rival,
        )  # fmt: skip

    def _covariance(self, fit: _Fit) -> Floats:
        return _Epipolar(self, fit.rows, float(fit.values[0])).uncertainty(fit.values, fit.scale)

    def refuse_jump(self, fit: _Fit, noise: float, names: tuple[str, str]) -> None:
        """OffsetError where parts of the film have other offsets, each with no more residual than `noise`."""
        times = self._times[fit.rows]
        edges = np.quantile(times, np.linspace(0, 1, 4))
        distances = _Epipolar(self, fit.rows, float(fit.values[0])).distances(fit.values)
        parts = []
        for low, high in pairwise(edges):
            scale, offset = self.search(float(fit.values[0]), (low, high))
            own = self.fit(offset, (low, high)) if scale < TOO_LITTLE else None
            if own is not None and own.scale <= noise:
                whole = _robust_scale(distances[(times >= low) & (times <= high)])
                sd = math.sqrt(self._covariance(own)[0, 0])
                parts.append(((low + high) / 2, float(own.values[0]), sd, whole > CLEARLY * own.scale))
        least = 0.3 * min(self.a.period, self.b.period)  # what is lost are whole pictures
        for (t, x, x_sd, x_better), (u, y, y_sd, y_better) in combinations(parts, 2):
            # a part that moves simply may fit at other offsets as well: then it fits at that of the whole film, too
            if (x_better or y_better) and abs(y - x) > max(
                least, JUMP_SDS * math.hypot(x_sd, y_sd, DRIFT_SD * (u - t))
            ):
                raise _cannot(
                    names,
                    f"it changes by {abs(y - x) * 1e3:.0f} ms between {t:.3g} and {u:.3g} s of the film of "
                    f"{self.a.camera!r}: a film has lost pictures, or its times are not those of the exposures",
                    "give the true times with --times, or film again with a constant frame rate",
                )


def _choose(searched: Sequence[tuple[float, float]], pair: _Pair, names: tuple[str, str]) -> tuple[_Fit, float]:
    """Of residuals and offsets, the least first, the one that fits; and how much larger the next one's residual is."""
    near = [offset for scale, offset in searched if scale < min(TOO_LITTLE, WORTH_FITTING * searched[0][0])]
    fits = sorted(filter(None, map(pair.fit, near)), key=lambda fit: fit.scale)
    if not fits:
        raise _cannot(names, "at no offset both saw the target for long enough", "film it for longer")
    pair.refuse_jump(max(fits, key=lambda fit: len(fit.rows)), MAX_NOISE, names)
    gains = {id(fit): pair.gain(fit) for fit in fits}
    best = max(fits, key=lambda fit: gains[id(fit)])
    if not gains[id(best)] > 0:
        raise _cannot(
            names, "no offset fits much better than others: the movement is too simple, or not of one target", RICHER
        )
    apart = 2 * max(pair.a.period, pair.b.period)
    others = [fit for fit in fits if abs(fit.values[0] - best.values[0]) > apart]
    for fit in others:
        if fit.scale < RIVAL_RATIO * best.scale and gains[id(fit)] > RIVAL_GAIN * gains[id(best)]:
            both = " and ".join(f"{one.values[0]:.4g} s" for one in (best, fit))
            raise _cannot(names, f"{both} fit alike: the movement repeats itself", RICHER)
    rival = min((fit.scale for fit in others), default=math.inf) / best.scale
    return best, rival


def _velocities(track: Track, step: float) -> tuple[Floats, float]:
    """(n, 2) the mean movement of a track's points from step to step, NaN in gaps, and the time of the first."""
    grid = np.arange(track.times[0], track.times[-1], step)
    uv = np.full((len(grid), track.uv.shape[1], 2), np.nan)
    for p in range(track.uv.shape[1]):
        rows = np.flatnonzero(np.isfinite(track.uv[:, p, 0]))
        if len(rows) < 2:
            continue
        own = track.times[rows]
        after = np.clip(np.searchsorted(own, grid), 1, len(own) - 1)
        inside = (own[after] - own[after - 1] <= MAX_GAP_PERIODS * track.period) & (grid >= own[0]) & (grid <= own[-1])
        for axis in range(2):
            uv[inside, p, axis] = np.interp(grid[inside], own, track.uv[rows, p, axis])
    moves = np.diff(uv, axis=0)
    seen = np.isfinite(moves[:, :, 0])
    total = np.where(seen[:, :, None], moves, 0).sum(axis=1)
    count = seen.sum(axis=1)[:, None]
    return np.where(count > 0, total / np.maximum(count, 1), np.nan), float(grid[0])


def _correlate(a: Floats, b: Floats) -> tuple[Floats, Rows]:
    """How much velocities tell of each other at each lag: nats, less what unrelated ones would; and the lags."""
    masks = [np.isfinite(v[:, 0]).astype(float) for v in (a, b)]
    filled = [np.where(np.isfinite(v), v, 0) for v in (a, b)]
    filled = [v / math.sqrt(max(float((v**2).sum() / m.sum()), 1e-300)) for v, m in zip(filled, masks, strict=True)]

    lags = np.arange(-(len(a) - 1), len(b))
    count = np.maximum(_over_lags(*masks), 0)
    n = np.maximum(count, 1e-9)
    blocks = np.zeros((len(lags), 4, 4))
    for i in range(2):
        for j in range(2):
            blocks[:, i, j] = _over_lags(filled[0][:, i] * filled[0][:, j], masks[1]) / n
            blocks[:, 2 + i, 2 + j] = _over_lags(masks[0], filled[1][:, i] * filled[1][:, j]) / n
            blocks[:, i, 2 + j] = _over_lags(filled[0][:, i], filled[1][:, j]) / n
    blocks[:, 2:, :2] = blocks[:, :2, 2:].transpose(0, 2, 1)
    blocks += 1e-3 * np.eye(4)
    log_det = [np.linalg.slogdet(part)[1] for part in (blocks[:, :2, :2], blocks[:, 2:, 2:], blocks)]
    information = np.maximum(0.5 * (log_det[0] + log_det[1] - log_det[2]), 0)
    independent = count / _correlation_length(filled, masks)
    fewest = max(MIN_PICTURES, MIN_SHARE * min(masks[0].sum(), masks[1].sum()))
    return np.where(count >= fewest, independent * information - 2, np.nan), lags


def _over_lags(x: Floats, y: Floats) -> Floats:
    """Row l: the sum over i of x[i] y[i + l], from as far back as there is anything."""
    from scipy.signal import correlate  # late: it takes a second of every command's start

    return np.asarray(correlate(y, x, mode="full", method="fft"), np.float64)


def _correlation_length(filled: Sequence[Floats], masks: Sequence[Floats]) -> float:
    """In how many steps velocities become others."""
    lengths = []
    for v, m in zip(filled, masks, strict=True):
        own = _over_lags(v[:, 0], v[:, 0]) + _over_lags(v[:, 1], v[:, 1])
        count = _over_lags(m, m)
        middle = len(v) - 1
        rho = own[middle:] / np.maximum(count[middle:], 1) / (own[middle] / count[middle])
        below = np.flatnonzero(rho < 0.3)
        lengths.append(float(below[0]) if len(below) else len(v) / 4)
    return max(1.0, *lengths)


class _Epipolar:
    """The epipolar equation of some rows of a pair. Coordinates are made to be of size one first."""

    def __init__(self, pair: _Pair, rows: Rows, offset: float) -> None:
        self._pair, self.rows, self._start = pair, rows, offset
        self._a = _Normal.of(pair.a, pair._uv[rows])
        self._b = _Normal.of(pair.b, pair._b_at(rows, offset, 0.0))
        self._sd = np.stack([pair._sd[rows], np.full(len(rows), pair._b_sd)])

    def _homogeneous(self, values: Floats) -> tuple[Floats, Floats]:
        a = self._a.apply(self._pair._uv[self.rows], values[2])
        b = self._b.apply(self._pair._b_at(self.rows, values[0], values[1]), values[3])
        return a, b

    def distances(self, values: Floats) -> Floats:
        """Sampson's distances in standard deviations of the detections.

        Args:
            values: Offset, drift, two distortions, nine of F.
        """
        a, b = self._homogeneous(values)
        f = values[4:].reshape(3, 3)
        to_b, to_a = a @ f.T, b @ f
        spread = np.square(to_b[:, :2]).sum(axis=1) * (self._sd[1] / self._b.unit) ** 2
        spread += np.square(to_a[:, :2]).sum(axis=1) * (self._sd[0] / self._a.unit) ** 2
        return np.asarray((b * to_b).sum(axis=1) / np.sqrt(spread + 1e-300), np.float64)

    def linear(self) -> tuple[Floats, float]:
        """F by linear least squares, weighted again twice; all values, and the robust residual."""
        values = np.zeros(13)
        values[0] = self._start
        a, b = self._homogeneous(values)
        design = (b[:, :, None] * a[:, None, :]).reshape(len(a), 9)
        weights = np.ones(len(a))
        scale = math.inf
        for _ in range(4):
            weighted = design * weights[:, None]
            values[4:] = np.linalg.eigh(weighted.T @ weighted)[1][:, 0]
            distance = self.distances(values)
            scale = _robust_scale(distance)
            spread = np.abs(design @ values[4:]) / np.maximum(np.abs(distance), 1e-12)
            weights = 1 / np.maximum(spread, 1e-12) / (1 + np.square(distance / (3 * scale + 1e-12)))
            weights /= weights.max()
        return values, scale

    def _residuals(self, values: Floats, scale: float) -> Floats:
        prior = [
            values[1] / DRIFT_SD,
            values[2] / DISTORTION_SD,
            values[3] / DISTORTION_SD,
            (np.linalg.norm(values[4:]) - 1) / 1e-3,
        ]
        return np.concatenate([self.distances(values) / scale, prior])

    def solve(self) -> tuple[Floats, float]:
        """The values that make the distances least, and their robust scale."""
        values, scale = self.linear()
        for _ in range(3):
            units = np.array([self._pair.b.period, 1e-4, 0.1, 0.1, *[1.0] * 9])
            found = least_squares(
                lambda x, s=scale, u=units: self._robust(self._residuals(x * u, s)), values / units, method="lm",
                xtol=1e-8, ftol=1e-8, max_nfev=60,
            )  # fmt: skip
            values = found.x * units
            values[4:] /= np.linalg.norm(values[4:])
            before, scale = scale, max(_robust_scale(self.distances(values)), 1e-6)
            if abs(scale - before) < 0.02 * before:
                break
        return values, scale

    @staticmethod
    def _robust(residuals: Floats) -> Floats:
        """Residuals whose squares are Cauchy's loss at three standard deviations; the priors as they are."""
        data = residuals[:-4]
        flat = 3 * np.sign(data) * np.sqrt(np.log1p(np.square(data / 3)))
        return np.concatenate([flat, residuals[-4:]])

    def uncertainty(self, values: Floats, scale: float) -> Floats:
        """(2, 2) the covariance of offset and drift."""
        units = np.array([self._pair.b.period, 1e-4, 0.1, 0.1, *[1.0] * 9])
        steps = 1e-5 * units
        jacobian = np.stack(
            [(self._residuals(values + h, scale) - self._residuals(values - h, scale)) / 2e-5 for h in np.diag(steps)],
            axis=1,
        )
        residuals = self._residuals(values, scale)
        n = len(self.rows)
        weights = np.concatenate([1 / (1 + np.square(residuals[:n] / 3)), np.ones(4)])
        pieces = _pieces(self._pair._times[self.rows])
        weighted = weights[:, None] * jacobian
        of_priors = weighted[n:].T @ jacobian[n:]
        normals = np.stack([weighted[:n][pieces == k].T @ jacobian[:n][pieces == k] for k in range(pieces.max() + 1)])
        gradients = np.stack([weighted[:n][pieces == k].T @ residuals[:n][pieces == k] for k in range(len(normals))])
        normal = normals.sum(axis=0) + of_priors
        inverse = np.linalg.pinv(normal, rcond=1e-13, hermitian=True)
        # the jackknife: what leaving each piece out would change, in the linearised problem
        without = np.stack(
            [
                np.linalg.pinv(normal - own, rcond=1e-13, hermitian=True) @ g
                for own, g in zip(normals, gradients, strict=True)
            ]
        )
        k = len(without)
        jackknife = without.T @ without * (k - 1) / k + inverse @ of_priors @ inverse
        # a normal interval of this variance is as wide as Student's with k - 1 degrees of freedom
        wider = (stdtrit(max(k - 1, 1), 0.975) / 1.96) ** 2
        plain = inverse * np.mean(weights[:n] * np.square(residuals[:n])) * n / max(n - 13, 1)
        larger = jackknife if jackknife[0, 0] * wider > plain[0, 0] else plain / wider
        covariance = wider * larger[:2, :2] * np.outer(units[:2], units[:2])
        return np.asarray(covariance, np.float64)


class _Normal(NamedTuple):
    """Pixels to numbers of size one: first without distortion around the middle of the picture, then moved and scaled.

    unit: pixels.
    """

    middle: Floats
    radius: float
    shift: Floats
    unit: float

    @classmethod
    def of(cls, track: Track, uv: Floats) -> _Normal:
        size = np.array(track.size, dtype=np.float64)
        middle, radius = (size - 1) / 2, float(np.linalg.norm(size) / 2)
        shift = uv.mean(axis=0) if len(uv) else middle
        unit = float(np.sqrt(np.square(uv - shift).sum(axis=1).mean() / 2)) if len(uv) else 1.0
        return cls(middle, radius, shift, max(unit, 1e-9))

    def apply(self, uv: Floats, distortion: float) -> Floats:
        """(n, 3) homogeneous."""
        away = (uv - self.middle) / self.radius
        straight = self.middle + self.radius * away / (1 + distortion * np.square(away).sum(axis=1, keepdims=True))
        return np.concatenate([(straight - self.shift) / self.unit, np.ones((len(uv), 1))], axis=1)


def _robust_scale(values: Floats) -> float:
    return float(1.4826 * np.median(np.abs(values)))


def _pieces(times: Floats) -> Rows:
    """The number of the piece of film that each time is in."""
    edges = np.quantile(times, np.linspace(0, 1, PIECES + 1)[1:-1])
    return np.unique(np.searchsorted(edges, times), return_inverse=True)[1]
