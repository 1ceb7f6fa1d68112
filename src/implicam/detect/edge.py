"""The edge of a disc to a hundredth of a pixel: a blurred step around an ellipse, fitted to the pixels along it.

Near the edge a picture is `inner (1 - Phi(d / s)) + outer Phi(d / s)`: d the signed distance from an ellipse, s the
blur, Phi the normal distribution; inner and outer vary slowly around the edge, for light is never even. All is found by
Gauss-Newton at once, with a prior that says how uneven light may be, and the covariance of the centre follows from the
noise that the pixels themselves show inside and outside. What does not look like a step (a highlight, a cable) is left
out, sector by sector.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from implicam.dataset import Floats
from implicam.images import Grey, opencv

Bools = NDArray[np.bool_]

SPOKES = 72
"""Directions in which the edge is looked for first."""

SECTORS = 24
"""Parts of the edge that are judged, each as a whole."""

ODD_SECTOR_RATIO = 2.5
"""A sector is left out where it fits so many times worse than usual."""

MIN_BREAK_STEPS, MIN_BREAK_SDS, BREAK_REACH_PX = 0.1, 3.0, 2.0
"""The edge is broken in a sector whose pixels on one side of it, so far beyond the blur, are together so far from the
fit: in parts of the step, and in standard deviations of their mean."""

GEOMETRY_NUMBERS = 6
"""Numbers of the edge: centre (2), shape (3), blur. Those of the light follow."""

LIGHT_WAVES, LIGHT_SLOPES = 6, 5
"""How finely the light may vary around the edge, and its slope away from the edge: a stem or a shadow is light, too."""

LIGHT_NUMBERS = 1 + 2 * LIGHT_WAVES + LIGHT_SLOPES

WAVE_PRIOR_SDS, SLOPE_PRIOR_SD = (0.05, 0.2), 0.1
"""Prior sd of each wave of the light inside and outside, and of the slope per pixel, as parts of the step."""

UNMODELLED_SD_BLURS = 0.01
"""Standard deviation, in blurs, of what light that is not of this form does to the centre: rendered balls with shading
and a soft shadow, without any noise, are off by 0.005 to 0.01 of the blur."""

BAND_MARGIN_PX = 2.0
"""Pixels beyond the blur that tell the light."""


class Ellipse(NamedTuple):
    """The points with |shape (p - centre)| = 1; shape (2, 2) symmetric, per pixel."""

    centre: Floats
    shape: Floats

    @property
    def axes(self) -> tuple[float, float]:
        """Half the longer and half the shorter axis, pixels."""
        less, more = self._values
        return 1 / less, 1 / more

    @property
    def radius(self) -> float:
        """Of the circle with the same area."""
        less, more = self._values
        return float(1 / np.sqrt(less * more))

    @property
    def is_one(self) -> bool:
        """Whether the numbers are of an ellipse: its shape is positive definite, and all are finite."""
        (a, b), (_, c) = self.shape.tolist()
        return bool(np.isfinite(self.centre).all()) and a + c > 0 and a * c > b * b

    @property
    def _values(self) -> tuple[float, float]:
        """The shape's singular values, the smaller first; in closed form, because fits ask for them again and again."""
        (a, b), (_, c) = self.shape.tolist()
        mean, half = (a + c) / 2, math.hypot((a - c) / 2, b)
        return max(abs(abs(mean) - half), 1e-300), abs(mean) + half

    def points(self, n: int = 64) -> Floats:
        """Points on the ellipse; the last is the first again.

        Args:
            n: How many.

        Returns:
            (n, 2) pixels.
        """
        angle = np.linspace(0, 2 * np.pi, n)
        circle = np.column_stack([np.cos(angle), np.sin(angle)])
        return np.asarray(self.centre + circle @ np.linalg.inv(self.shape).T, dtype=np.float64)


def fit_ellipse(points: Floats, start: Ellipse) -> Ellipse:
    """The ellipse nearest to points, by least squares of the distances.

    Args:
        points: (n, 2) pixels.
        start: An ellipse near them.
    """
    ellipse = start
    for _ in range(20):
        distance, slope = _signed_distance(points, ellipse)
        change: Floats = -np.linalg.lstsq(slope, distance)[0].astype(np.float64)
        ellipse = _change_ellipse(ellipse, change)
        if np.abs(change[:2]).max() < 1e-7:
            break
    return ellipse


def _change_ellipse(ellipse: Ellipse, change: Floats) -> Ellipse:
    """Centre and shape changed by (5,): the derivatives of `_signed_distance`."""
    shape = ellipse.shape + np.array([[change[2], change[3]], [change[3], change[4]]])
    return Ellipse(ellipse.centre + change[:2], shape)


class Edge(NamedTuple):
    """A fitted edge: covariance (2, 2) of its centre; levels inside and outside, and the rms left over, in grey values;
    blur in pixels; `support`, the part of the edge that was fitted; `broken`, the part where it is no such step, though
    the noise may hide that from `support`; and `uneven`, the largest wave of the light outside, in steps."""

    ellipse: Ellipse
    covariance: Floats
    inner: float
    outer: float
    residual: float
    blur: float
    support: float
    broken: float
    uneven: float


class Rough(NamedTuple):
    """An ellipse through the steepest rises, and how good it is: the usual rise times the part that has it."""

    ellipse: Ellipse
    quality: float


def find_rough_edge(
    picture: Grey, centre: Floats, radius: float, *, step: float = 0.0, steep_first: bool = False
) -> Rough | None:
    """Find the edge of a disc that is darker than what is around it, to a pixel or so.

    Args:
        picture: (height, width) grey from 0 to 1.
        centre: (2,) a pixel near the disc's middle.
        radius: The disc's radius in pixels, roughly.
        step: Least difference of grey between the disc and what is around it.
        steep_first: Begin with the rises that are steep enough, and bear that most are so at the end only: for a centre
            that is off. A shadow beside a ball draws the template towards itself; the near part of the ball's own edge
            is then too near to be looked for, and the edge of the shadow is found there, which is less steep.

    Returns:
        The edge; None where there is none on most sides.
    """
    least = 0.45 if steep_first else 0.6
    for _ in range(3):
        points, rise = _find_steepest_rise(picture, centre, radius)
        steep = rise > 0.6 * step
        if np.mean(steep) < 0.6:  # no ellipse can be better than that
            return None
        found = _fit_robust_ellipse(points, steep if steep_first else np.ones_like(steep), centre, radius)
        if found is None or np.linalg.norm(found[0].centre - centre) > radius:
            return None
        ellipse, on_it = found
        part = float(np.mean(on_it & steep))
        if part < least or ellipse.axes[1] < 0.55 * ellipse.axes[0]:
            return None
        moved = np.linalg.norm(ellipse.centre - centre)
        centre, radius = ellipse.centre, ellipse.radius
        if moved < 0.7:
            break
    if part < 0.6:
        return None
    return Rough(ellipse, part * _median(rise))


def _find_steepest_rise(picture: Grey, centre: Floats, radius: float) -> tuple[Floats, Floats]:
    """Where the picture brightens most along each spoke, (SPOKES, 2), between half and 1.6 times the radius; and by how
    much (SPOKES,) from a pixel before to a pixel behind."""
    step = max(0.25, radius / 40)
    r = np.arange(0.45 * radius, 1.65 * radius + step, step)
    angle = np.arange(SPOKES) * (2 * np.pi / SPOKES)
    out = np.column_stack([np.cos(angle), np.sin(angle)])
    at = (centre + r[None, :, None] * out[:, None, :]).astype(np.float32)
    cv2 = opencv()
    profile = cv2.remap(picture, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    window = max(1, round(0.5 / step))
    rise = profile[:, 2 * window :] - profile[:, : -2 * window]
    kernel = np.ones(2 * window + 1, np.float32) / (2 * window + 1)
    rise = cv2.filter2D(rise, -1, kernel[None])
    best = np.argmax(rise, axis=1)
    across = max(1, round(1.5 / step))
    places = best + window
    spoke = np.arange(SPOKES)
    low = profile[spoke, np.maximum(places - across, 0)]
    high = profile[spoke, np.minimum(places + across, len(r) - 1)]
    return centre + r[places][:, None] * out, np.asarray(high - low, dtype=np.float64)


def _fit_robust_ellipse(points: Floats, first: Bools, centre: Floats, radius: float) -> tuple[Ellipse, Bools] | None:
    """The ellipse through most of the points, and (n,) which those are: iteratively reweighted, about the centre.

    first: (n,) those to begin with.
    """
    p = (points - centre) / radius
    basis = np.column_stack([p[:, 0] ** 2, 2 * p[:, 0] * p[:, 1], p[:, 1] ** 2, p])
    prior = 0.02 * len(p) * np.diag([1.0, 1, 1, 0.1, 0.1])
    pull = 0.02 * len(p) * np.array([1.0, 0, 1, 0, 0])  # towards the circle we came from, gently
    weight = first.astype(np.float64)
    for _ in range(5):
        weighted = (basis * weight[:, None]).T
        solved = np.linalg.solve(weighted @ basis + prior, weighted.sum(axis=1) + pull)
        a, b, c = solved[:3].tolist()
        if (a + c) / 2 - math.hypot((a - c) / 2, b) < 0.05:  # the smaller eigenvalue
            return None
        off = 0.5 * (basis @ solved - 1)  # about the distance, in radii
        scale = max(1.48 * _median(np.abs(off)), 0.01)
        weight = np.maximum(1 - (off / (4 * scale)) ** 2, 0) ** 2
    form = np.array([[a, b], [b, c]])
    middle = -0.5 * np.linalg.solve(form, solved[3:])
    form = form / (1 + middle @ form @ middle)
    values, vectors = np.linalg.eigh(form)
    ellipse = Ellipse(centre + radius * middle, vectors @ np.diag(np.sqrt(values)) @ vectors.T / radius)
    return ellipse, np.abs(off) < max(0.1, 1.5 / radius)


class _Band(NamedTuple):
    """Pixels along the edge: where they are (n, 2), and their grey values (n,)."""

    uv: Floats
    grey: Floats


class _Fit(NamedTuple):
    """Where Gauss-Newton stands: the edge, its blur, the light (2 LIGHT_NUMBERS,), and the noise (2,) inside and
    outside."""

    ellipse: Ellipse
    blur: float
    light: Floats
    noise: Floats


def fit_edge(picture: Grey, start: Ellipse, blur: float = 1.0) -> Edge | None:
    """Fit the edge of a disc to the pixels along it.

    Args:
        picture: (height, width) grey from 0 to 1.
        start: An ellipse within a pixel or so of the edge.
        blur: Of the edge, in pixels, roughly.

    Returns:
        The edge; None where there is none, or it is not wholly in the picture.
    """
    ellipse, kept = start, np.ones(SECTORS, dtype=np.bool_)
    band = fit = None
    for _ in range(3):
        band = _cut_band(picture, ellipse, 3 * blur + BAND_MARGIN_PX)
        if band is None:
            return None
        use = kept[_sector_of(band.uv, ellipse)]
        fit = _gauss_newton(_Band(band.uv[use], band.grey[use]), ellipse, blur, fit)
        if fit is None:
            return None
        settled = 0.8 < fit.blur / blur < 1.25  # else the band was too narrow, or needlessly wide
        ellipse, blur = fit.ellipse, fit.blur
        worse = _sector_rms(band.grey - _evaluate_model(band.uv, fit)[0], _sector_of(band.uv, ellipse))
        again = worse <= ODD_SECTOR_RATIO * max(_median(worse), 0.004)
        if again.mean() < 0.4 or (settled and (again == kept).all()):
            break
        kept = again
    assert band is not None
    assert fit is not None
    return _judge(band, fit, kept)


def _judge(band: _Band, fit: _Fit, kept: Bools) -> Edge | None:
    """Levels and covariance of what was found."""
    sector = _sector_of(band.uv, fit.ellipse)
    use = kept[sector]
    model, J, step = _evaluate_model(band.uv, fit)
    left = band.grey - model
    residual, J, step = left[use], J[use], step[use]
    if len(J) < 2 * J.shape[1]:
        return None
    JW = J / _noise_variance(fit.noise, step)[:, None]
    try:
        covariance = np.linalg.inv(JW.T @ J + np.diag(_prior_precision(fit)))
    except np.linalg.LinAlgError:
        return None
    rms = float(np.sqrt(np.mean(residual**2)))
    own = covariance[:2, :2] + (UNMODELLED_SD_BLURS * fit.blur) ** 2 * np.eye(2)
    inner, outer = float(fit.light[0]), float(fit.light[LIGHT_NUMBERS])
    broken = _share_broken(left, _signed_distance(band.uv, fit.ellipse)[0], sector, fit.blur, outer - inner, rms)
    waves = fit.light[LIGHT_NUMBERS + 1 :][: 2 * LIGHT_WAVES]
    uneven = float(np.abs(waves).max()) / max(abs(outer - inner), 1e-9)
    return Edge(fit.ellipse, own, inner, outer, rms, fit.blur, float(kept.mean()), broken, uneven)


def _share_broken(
    residual: Floats, distance: Floats, sector: NDArray[np.int64], blur: float, step: float, rms: float
) -> float:
    """The part of the sectors in which the pixels (n,) just inside or just outside are another grey than the fit."""
    broken = np.zeros(SECTORS, dtype=np.bool_)
    for side in (distance < 0, distance >= 0):
        near = side & (np.abs(distance) < blur + BREAK_REACH_PX)
        count = np.maximum(np.bincount(sector[near], minlength=SECTORS), 1)
        off = np.abs(np.bincount(sector[near], weights=residual[near], minlength=SECTORS)) / count
        broken |= off > np.maximum(MIN_BREAK_STEPS * abs(step), MIN_BREAK_SDS * rms / np.sqrt(count))
    return float(broken.mean())


def _cut_band(picture: Grey, ellipse: Ellipse, width: float) -> _Band | None:
    """The pixels within `width` of the ellipse; None where it is not wholly in the picture."""
    reach = ellipse.axes[0] + width + 1
    low = np.floor(ellipse.centre - reach).astype(int)
    high = np.ceil(ellipse.centre + reach).astype(int) + 1
    height, columns = picture.shape
    if (low < 0).any() or high[0] > columns or high[1] > height or not np.isfinite(reach) or reach > 2000:
        return None
    v, u = np.mgrid[low[1] : high[1], low[0] : high[0]]
    uv = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
    distance = _signed_distance(uv, ellipse)[0]
    near = (distance < width) & (distance > -min(width, 0.8 * ellipse.axes[1]))
    grey = picture[low[1] : high[1], low[0] : high[0]].ravel()[near]
    return _Band(uv[near], grey.astype(np.float64))


def _signed_distance(uv: Floats, ellipse: Ellipse) -> tuple[Floats, Floats]:
    """Signed distance (n,) from the ellipse, right to first order near it; its derivative (n, 5) by the centre and by
    the shape's numbers (0, 0), (0, 1), (1, 1)."""
    p = (uv - ellipse.centre).T
    q = ellipse.shape @ p
    size = np.maximum(np.hypot(*q), 1e-9)
    unit = q / size
    slope = ellipse.shape @ unit
    steep = np.maximum(np.hypot(*slope), 1e-9)
    by_shape = unit[0] * p[0], unit[0] * p[1] + unit[1] * p[0], unit[1] * p[1]
    return (size - 1) / steep, (np.stack([-slope[0], -slope[1], *by_shape]) / steep).T


def _evaluate_model(uv: Floats, fit: _Fit) -> tuple[Floats, Floats, Floats]:
    """Grey values (n,), their derivative (n, GEOMETRY_NUMBERS + 2 LIGHT_NUMBERS), and how far outside each pixel is,
    0 to 1. Live pictures spend most of their time here: rows are pixels' neighbours in memory, and nothing is built
    twice."""
    d, by_ellipse = _signed_distance(uv, fit.ellipse)
    around = _wave_basis(uv, fit.ellipse)
    z = d / fit.blur
    step, density = ndtr(z), np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
    rows = np.empty((GEOMETRY_NUMBERS + 2 * LIGHT_NUMBERS, len(uv)))
    light, jump = rows[GEOMETRY_NUMBERS:], np.zeros(len(uv))
    for side, sign, share, depth in ((0, -1, 1 - step, np.minimum(d, 0)), (1, 1, step, np.maximum(d, 0))):
        numbers = fit.light[side * LIGHT_NUMBERS :][:LIGHT_NUMBERS]
        own, waves = light[side * LIGHT_NUMBERS :], len(around)
        np.multiply(around, share, out=own[:waves])
        np.multiply(around[:LIGHT_SLOPES], depth * share, out=own[waves:LIGHT_NUMBERS])
        jump += sign * (numbers[:waves] @ around + (numbers[waves:] @ around[:LIGHT_SLOPES]) * depth)
    steepness = jump * density / fit.blur
    np.multiply(by_ellipse.T, steepness, out=rows[:5])
    rows[5] = -steepness * z
    return fit.light @ light, rows.T, step


def _wave_basis(uv: Floats, ellipse: Ellipse) -> Floats:
    """(1 + 2 LIGHT_WAVES, n) 1 and cos, sin of 1, 2, ... times the angle around the centre."""
    q = ellipse.shape @ (uv - ellipse.centre).T
    turn = (q[0] + 1j * q[1]) / np.maximum(np.hypot(*q), 1e-9)
    basis, power = np.ones((1 + 2 * LIGHT_WAVES, len(uv))), turn
    for k in range(1, 2 * LIGHT_WAVES, 2):
        basis[k], basis[k + 1] = power.real, power.imag
        power = power * turn
    return basis


def _prior_precision(fit: _Fit) -> Floats:
    """(GEOMETRY_NUMBERS + 2 LIGHT_NUMBERS,) of the prior: the light is nearly even inside, less so outside, and
    never jumps."""
    jump = abs(fit.light[LIGHT_NUMBERS] - fit.light[0]) + 1e-3
    return np.asarray(_PRIOR_PRECISION / jump**2, dtype=np.float64)


def _prior_precision_of_a_step() -> Floats:
    sides = [np.repeat([np.inf, wave, SLOPE_PRIOR_SD], [1, 2 * LIGHT_WAVES, LIGHT_SLOPES]) for wave in WAVE_PRIOR_SDS]
    return np.concatenate([np.full(GEOMETRY_NUMBERS, np.inf), *sides]) ** -2


_PRIOR_PRECISION = _prior_precision_of_a_step()


def _noise_variance(noise: Floats, step: Floats) -> Floats:
    return np.asarray(noise[0] ** 2 * (1 - step) + noise[1] ** 2 * step, dtype=np.float64)


def _gauss_newton(band: _Band, start: Ellipse, blur: float, last: _Fit | None) -> _Fit | None:
    """The most probable edge and light, given the pixels of the band; None where it runs away. last: what another band
    has given, to begin with."""
    uv, grey = band
    outside = _signed_distance(uv, start)[0] > 0
    if outside.sum() < 2 * LIGHT_NUMBERS or (~outside).sum() < 10:
        return None
    fit = _begin_fit(band, outside, start, blur) if last is None else last
    weight = np.ones(len(uv))
    for iteration in range(15):
        model, J, step = _evaluate_model(uv, fit)
        residual = grey - model
        if iteration >= 2 or last is not None:  # outliers are known after a first fit
            if step.min() >= 0.5 or step.max() < 0.5:  # the edge has left the band
                return None
            fit = fit._replace(noise=_estimate_noise(residual, step))
            weight = np.maximum(1 - residual**2 / (25 * _noise_variance(fit.noise, step)), 0) ** 2
        sharpness = np.sqrt(weight / _noise_variance(fit.noise, step))
        rows = J.T * sharpness
        normal, pull = rows @ rows.T, rows @ (residual * sharpness)  # a product with itself costs half of another
        precision = _prior_precision(fit)
        normal.ravel()[:: len(normal) + 1] += precision
        pull[GEOMETRY_NUMBERS:] -= precision[GEOMETRY_NUMBERS:] * fit.light
        try:
            change: Floats = np.linalg.solve(normal, pull).astype(np.float64, copy=False)
        except np.linalg.LinAlgError:
            return None
        fit = _apply_change(fit, change, start)
        if not _is_sane(fit.ellipse, start):
            return None
        if (iteration > 3 or last is not None) and np.abs(change[:2]).max() < 2e-3 * fit.blur:
            break
    return fit


def _begin_fit(band: _Band, outside: Bools, start: Ellipse, blur: float) -> _Fit:
    """Even light on both sides of an edge."""
    light = np.zeros(2 * LIGHT_NUMBERS)
    light[0], light[LIGHT_NUMBERS] = _median(band.grey[~outside]), _median(band.grey[outside])
    return _Fit(start, blur, light, np.full(2, 0.1 * abs(light[LIGHT_NUMBERS] - light[0]) + 1e-3))


def _apply_change(fit: _Fit, change: Floats, start: Ellipse) -> _Fit:
    radius = start.radius
    damp = min(1.0, 0.3 * radius / max(math.hypot(*change[:2]), 1e-9))
    blur = min(max(fit.blur + damp * float(change[5]), 0.6 * fit.blur), 1.6 * fit.blur)
    blur = min(max(blur, 0.3), 0.5 * radius)
    light = fit.light + damp * change[GEOMETRY_NUMBERS:]
    return _Fit(_change_ellipse(fit.ellipse, damp * change[:5]), blur, light, fit.noise)


def _estimate_noise(residual: Floats, step: Floats) -> Floats:
    """(2,) standard deviation inside and outside, bearing outliers; never less than the sensor's steps."""
    sides = (residual[step < 0.5], residual[step >= 0.5])
    taken = LIGHT_NUMBERS + GEOMETRY_NUMBERS / 2  # what the fit has explained away
    return np.array([max(1.48 * _median(np.abs(r)) * np.sqrt(len(r) / max(len(r) - taken, 1)), 1e-3) for r in sides])


def _is_sane(ellipse: Ellipse, start: Ellipse) -> bool:
    """Still an ellipse, near where it started."""
    if not ellipse.is_one:
        return False
    radius = start.radius
    near = math.hypot(*(ellipse.centre - start.centre)) < 0.6 * radius
    return near and 0.5 < ellipse.radius / radius < 2


def _median(values: Floats) -> float:
    """As `np.median`, which takes four times as long for the few values of an edge."""
    low, high = (len(values) - 1) // 2, len(values) // 2
    ordered = np.partition(values, (low, high))
    return float(ordered[low] + ordered[high]) / 2


def _sector_of(uv: Floats, ellipse: Ellipse) -> NDArray[np.int64]:
    p = uv - ellipse.centre
    return np.floor((np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS


def _sector_rms(residual: Floats, sector: NDArray[np.int64]) -> Floats:
    count = np.maximum(np.bincount(sector, minlength=SECTORS), 1)
    return np.sqrt(np.bincount(sector, weights=residual**2, minlength=SECTORS) / count)
