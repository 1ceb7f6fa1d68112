"""Small bright spots: where they are, to a few hundredths of a pixel, and how well that is known.

Spots are found as maxima of the scale-normalised Laplacian of Gaussian (Lindeberg 1998): a disc of radius R answers
most at sigma = R / sqrt 2. Each is then measured by its intensity-weighted centroid over the part that is brighter than
about half its maximum,

    u = sum(m s x) / sum(m s),    s = grey - background,    m = ramp(smoothed s / its maximum),

with a ramp, not a step, so that the noise of a pixel at the rim moves the centroid a little, never with a jump. To
first order, noise n_j of pixel j moves it by A_j n_j / sum(m s) with

    A = m (x - u) + G * (m' s (x - u)),

G the smoothing and m' the slope of the ramp; the variance is the sum of the squares. The noise variance of a pixel is
that of the spot's surroundings plus a part in proportion to its own brightness (shot noise, paint), which all spots of
the picture share: it is read off their residuals about a round profile. A spot with larger residuals than the others
is less certain by as much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from implicam.dataset import Floats
from implicam.images import Grey, opencv

Bools = NDArray[np.bool_]

RAMP_LOW, RAMP_HIGH = 0.3, 0.6
"""Parts of the maximum between which the weight of a pixel goes from 0 to 1; a narrower ramp shows the pixels."""

MIN_SCALE_PX, SCALE_FACTOR = 0.8, 1.2
"""Scales that are tried where a spot is shown: the first in pixels, and the factor from one to the next."""

MAX_CLICK_PX = 3.0
"""Pixels from a click to the spot that is meant."""

MIN_RESPONSE_NOISES = 5.0
"""A spot answers the Laplacian so many times its noise at least."""

MAX_RADIUS_SCALES, MAX_RADIUS_EXTRA_PX = 2.5, 2.0
"""Their sum is how far from its middle a spot ends at the latest."""

SMOOTHING_PX = 1.2
"""Pixels of the smoothing before a spot is told from its surroundings: noise of single pixels must not do that."""

MAX_ELONGATION = 3.0
"""Length over width beyond which it is a scratch or a rim."""

BACKGROUND_STEPS = (0.0, 0.2, 0.35, 0.5, 0.6)
"""Parts of the spot's height by which its background is raised, one after the other, until it stands alone."""

MIN_BRIGHTNESS_NOISES = 4.0
"""Noise of its surroundings, smoothed, that a spot is brighter than them at least."""

MAX_SD_SCALES = 0.5
"""Of the scale: a spot of a larger standard uncertainty is not measured."""

MIN_SD_PX = 0.006
"""Pixels that no standard uncertainty goes below: what the sensor's pixels do to a centroid."""


@dataclass(frozen=True, eq=False)
class Spots:
    """Spots as measured, n of them; NaN where there is none that can be measured.

    uv: (n, 2) pixels; sd: (n, 2) their standard uncertainties; area: (n,) square pixels.
    """

    uv: Floats
    sd: Floats
    area: Floats


def laplacian(picture: Grey, sigma: float) -> Grey:
    """The scale-normalised Laplacian of Gaussian, positive on bright spots.

    Args:
        picture: (height, width) grey from 0 to 1.
        sigma: The scale in pixels.

    Returns:
        (height, width).
    """
    cv2 = opencv()
    smooth = cv2.GaussianBlur(picture, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(-(sigma**2) * cv2.Laplacian(smooth, cv2.CV_32F, borderType=cv2.BORDER_REPLICATE))


def find_scale(picture: Grey, uv: Floats, largest: float, within: float = MAX_CLICK_PX) -> tuple[float, Floats]:
    """Find the one scale of the spots that some pixels show.

    It is one scale for all: specks of noise and glints, which are small, are at odds with each other.

    Args:
        picture: (height, width) grey from 0 to 1.
        uv: (n, 2) pixels, each near a spot.
        largest: The largest scale to be tried, in pixels.
        within: How near, in pixels.

    Returns:
        The scale in pixels; and the answers (n,) of the spots to it, negative where a spot is dark, NaN outside the
        picture.
    """
    sigmas = MIN_SCALE_PX * SCALE_FACTOR ** np.arange(
        0, 1 + np.log(max(largest / MIN_SCALE_PX, 1.0)) / np.log(SCALE_FACTOR)
    )
    answers = np.array([_strongest_answers(picture, u, v, sigmas, within) for u, v in uv]).reshape(-1, len(sigmas))
    clear = np.sign(answers) * np.maximum(np.abs(answers) - MIN_RESPONSE_NOISES * _answer_noise(picture, sigmas), 0)
    inside = np.isfinite(answers[:, 0])
    height = np.abs(answers[inside]).max(axis=1, keepdims=True)
    score = np.abs(np.mean(clear[inside] / np.maximum(height, 1e-9), axis=0)) if inside.any() else np.zeros(len(sigmas))
    best = int(np.argmax(score))
    return float(sigmas[best]), answers[:, best]


def _strongest_answers(picture: Grey, u: float, v: float, sigmas: Floats, within: float) -> Floats:
    """The strongest answer, of either sign, to each scale within so many pixels of a pixel."""
    reach = int(np.ceil(4 * sigmas[-1] + within + 2))
    left, top = max(round(u) - reach, 0), max(round(v) - reach, 0)
    if not (-0.5 <= u < picture.shape[1] - 0.5 and -0.5 <= v < picture.shape[0] - 0.5):
        return np.full(len(sigmas), np.nan)
    window = np.ascontiguousarray(picture[top : round(v) + reach + 1, left : round(u) + reach + 1])
    rows, columns = np.indices(window.shape)
    near = np.hypot(columns + left - u, rows + top - v) <= within
    found = np.array([laplacian(window, float(sigma))[near] for sigma in sigmas], dtype=np.float64)
    return np.asarray(found[np.arange(len(sigmas)), np.argmax(np.abs(found), axis=1)], dtype=np.float64)


def _answer_noise(picture: Grey, sigma: Floats) -> Floats:
    """Noise of the answer to scales (k,), from the noise that neighbouring pixels show (Immerkaer 1996)."""
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32) / 6
    noise = 1.4826 * float(np.median(np.abs(opencv().filter2D(picture, -1, mask))))
    return np.asarray(noise / (np.sqrt(2 * np.pi) * sigma), dtype=np.float64)


def find_spots(picture: Grey, sigma: float, least: float | None = None) -> tuple[Floats, Floats]:
    """Find all bright spots of about one scale.

    Args:
        picture: (height, width) grey from 0 to 1.
        sigma: The scale in pixels.
        least: Answer of the Laplacian that a spot has at least; None for what stands out of the noise.

    Returns:
        Pixels (n, 2), to about half a pixel; and answers (n,) of the Laplacian.
    """
    cv2 = opencv()
    answer = laplacian(picture, sigma)
    around = cv2.dilate(answer, np.ones((3, 3), np.uint8))
    if least is None:
        least = max(MIN_RESPONSE_NOISES * float(_answer_noise(picture, np.array([sigma]))[0]), 1e-4)
    at = np.flatnonzero(answer.ravel() > least)  # few: what is compared with its surroundings
    at = at[answer.ravel()[at] == around.ravel()[at]]
    v, u = np.unravel_index(at, answer.shape)
    inside = (u > 1) & (v > 1) & (u < picture.shape[1] - 2) & (v < picture.shape[0] - 2)
    u, v = u[inside], v[inside]
    across, along = _principal_curvatures(answer, u, v)
    round_enough = (across > 0) & (along < MAX_ELONGATION**2 * across)
    uv = np.column_stack([u, v]).astype(np.float64)[round_enough]
    return uv, answer[v, u].astype(np.float64)[round_enough]


def find_spot_near(
    picture: Grey, uv: Floats, within: float, *, like: Floats | None = None, largest: float = 16.0
) -> Floats | None:
    """Find the spot, bright or dark, that a person means who points at a pixel.

    Args:
        picture: (height, width) grey from 0 to 1.
        uv: (2,) the pixel.
        within: So many pixels from it at most.
        like: (n, 2) pixels of known spots of the same kind, which tell the scale; without, the one that is sought does.
        largest: The largest scale to be tried, in pixels.

    Returns:
        (2,) the pixel of its middle; None where there is no spot.
    """
    shown, near = (uv[None], within) if like is None or not len(like) else (like, MAX_CLICK_PX)
    best, answers = find_scale(picture, shown, largest, near)
    if not np.isfinite(answers).any():
        return None
    reach = int(np.ceil(within + 8 * largest + 12))
    left, top = (max(round(float(x)) - reach, 0) for x in uv)
    window = picture[top : round(float(uv[1])) + reach + 1, left : round(float(uv[0])) + reach + 1]
    window = np.ascontiguousarray(1 - window if np.nansum(answers) < 0 else window)
    corner = np.array([left, top])
    for sigma in (best, *LONE_SPOT_FACTORS * best) if shown is not like else (best,):
        found = _nearest_spot(window, uv - corner, within, float(sigma)) if sigma <= largest else None
        if found is not None:
            return np.asarray(found + corner, dtype=np.float64)
    return None


def _nearest_spot(picture: Grey, uv: Floats, within: float, sigma: float) -> Floats | None:
    """The middle (2,) of the spot nearest to a pixel that is not much fainter than the others there."""
    rough, strength = find_spots(picture, sigma)
    near = np.linalg.norm(rough - uv, axis=1) <= within + sigma
    spots, strength = measure_spots(picture, rough[near], sigma).uv, strength[near]
    off = np.linalg.norm(spots - uv, axis=1)
    meant = off <= within  # NaN is not
    if not meant.any():
        return None
    meant &= strength >= MIN_STRENGTH_RATIO * strength[meant].max()
    return np.asarray(spots[np.argmin(np.where(meant, off, np.inf))], dtype=np.float64)


LONE_SPOT_FACTORS = np.array([2.0, 3.0])
"""A single spot may answer best to the scale of a glint or of a speck on it; these are tried then."""

MIN_STRENGTH_RATIO = 0.3
"""Of the strongest answer near a pixel: fainter spots beside it are not meant."""


def _principal_curvatures(answer: Grey, u: NDArray[np.intp], v: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """The smaller and the larger principal curvature (n,) of the answer: a ridge bends one way only."""
    f = answer.astype(np.float64) if answer.size < 1 << 16 else answer
    uu = 2 * f[v, u] - f[v, u - 1] - f[v, u + 1]
    vv = 2 * f[v, u] - f[v - 1, u] - f[v + 1, u]
    uv = (f[v - 1, u + 1] + f[v + 1, u - 1] - f[v + 1, u + 1] - f[v - 1, u - 1]) / 4
    mean, half = (uu + vv) / 2, np.hypot((uu - vv) / 2, uv)
    return mean - half, mean + half


def measure_spots(picture: Grey, uv: Floats, sigma: float) -> Spots:
    """Centroids of bright spots, with their uncertainties.

    Args:
        picture: (height, width) grey from 0 to 1.
        uv: (n, 2) pixels near their middles.
        sigma: Their scale in pixels: the radius over the square root of two.

    Returns:
        n spots, NaN where there is none that can be measured.
    """
    windows = [_Window.of(picture, float(u), float(v), sigma) for u, v in uv]
    good = [window for window in windows if window is not None]
    share = _estimate_shared_noise(good)
    empty = np.full(5, np.nan)
    rows = [empty if window is None else (*window.uv, *window.sd(share), window.area) for window in windows]
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    table[~(table[:, 2:4].max(axis=1) < MAX_SD_SCALES * sigma)] = np.nan
    return Spots(table[:, :2], table[:, 2:4], table[:, 4])


def _estimate_shared_noise(windows: list[_Window]) -> float:
    """Noise variance per brightness: the median over the spots, of which most are sound."""
    found = [float(np.sum(w.residual**2 - w.noise**2) / np.sum(w.bright[w.core])) for w in windows]
    return max(float(np.median(found)), 0.0) if found else 0.0


@dataclass(frozen=True, eq=False)
class _Window:
    """One spot and its surroundings."""

    uv: Floats
    area: float
    bright: Floats  # (k, k) grey above the background
    pull: Floats  # (k, k, 2) pixels that the centroid moves per unit of noise of each pixel
    noise: float  # sd of the background
    core: Bools  # (k, k) pixels of the spot
    residual: Floats  # (core,) about the round profile, scaled for what the profile's own freedom takes away

    @classmethod
    def of(cls, picture: Grey, u: float, v: float, sigma: float) -> _Window | None:
        half = int(np.ceil(3 * sigma + 3))
        at = np.array([round(u), round(v)])
        y, x = np.indices((2 * half + 1, 2 * half + 1)) - half
        rows, columns = np.clip(at[1] + y, 0, picture.shape[0] - 1), np.clip(at[0] + x, 0, picture.shape[1] - 1)
        outside = (rows != at[1] + y) | (columns != at[0] + x)
        grey = picture[rows, columns].astype(np.float64)
        far = np.hypot(x, y)
        ring = grey[(far > half - 2.5) & (far <= half + 0.5) & ~outside]
        if len(ring) < len(grey):
            return None
        level, noise = _estimate_background(ring)
        bright = grey - level
        found = _weigh_pixels(bright, far, sigma, noise)
        if found is None or (found[0][outside] > 0).any():
            return None
        weight, slope, raised = found
        return cls._measure(bright - raised, weight, slope, np.stack([x, y], axis=2).astype(np.float64), noise, at)

    @classmethod
    def _measure(
        cls, bright: Floats, weight: Floats, slope: Floats, xy: Floats, noise: float, at: NDArray[np.int64]
    ) -> _Window | None:
        mass = weight * bright
        total = float(mass.sum())
        if total <= 0:
            return None
        centre = np.einsum("ij,ijk->k", mass, xy) / total
        d = xy - centre
        spread = np.einsum("ij,ijk,ijl->kl", np.maximum(mass, 0), d, d) / total
        narrow, wide = np.linalg.eigvalsh(spread)
        if not 0 < wide < MAX_ELONGATION**2 * narrow:
            return None
        direct, rim = weight[..., None] * d, (slope * bright)[..., None] * d
        pull = direct + np.stack([ndimage.gaussian_filter(rim[..., k], SMOOTHING_PX) for k in range(2)], axis=2)
        core = weight > 0
        distance = np.sqrt(np.einsum("ijk,kl,ijl->ij", d, np.linalg.inv(spread), d) * np.sqrt(narrow * wide))
        residual = _residuals_about_profile(bright[core], distance[core])
        return cls(centre + at, float(weight.sum()), bright, pull / total, noise, core, residual)

    def sd(self, share: float) -> Floats:
        """(2,) standard uncertainties in pixels; share: noise variance per brightness."""
        variance = self.noise**2 + share * np.maximum(self.bright, 0)
        odd = float(np.sum(self.residual**2)) / max(float(np.sum(variance[self.core])), 1e-18)
        usual = 1 + 3 * np.sqrt(2 / len(self.residual))
        spread = np.einsum("ijk,ij->k", self.pull**2, variance) * (odd if odd > usual else 1.0)
        return np.asarray(np.sqrt(spread + MIN_SD_PX**2), dtype=np.float64)


def _estimate_background(ring: Floats) -> tuple[float, float]:
    """The background and its noise, without the bright or dark things that may lie in the ring."""
    middle = float(np.median(ring))
    off = np.abs(ring - middle)
    step = float(np.diff(np.unique(ring)).min(initial=1.0)) if ring.min() < ring.max() else 0.0  # between grey values
    sound = ring[off <= max(6 * float(np.median(off)), 1.5 * step)]
    return float(sound.mean()), float(np.hypot(sound.std(), step / np.sqrt(12)))


def _weigh_pixels(bright: Floats, far: Floats, sigma: float, noise: float) -> tuple[Floats, Floats, float] | None:
    """Weights of the pixels (k, k), the slope of the weight with the smoothed brightness, and what the background is
    brighter than `bright` says: it is raised until the spot stands alone, beside a brighter thing or on a slope."""
    smooth = ndimage.gaussian_filter(bright, SMOOTHING_PX)
    summit = (smooth == ndimage.maximum_filter(smooth, 3)) & (far <= sigma + 1.5)
    if not summit.any():
        return None
    top = int(np.argmax(np.where(summit, smooth, -np.inf)))
    rough = noise / (2 * np.sqrt(np.pi) * SMOOTHING_PX)  # the noise that is left; the largest of several is 2 sd above
    peak = float(smooth.flat[top]) - 2 * rough
    end = far > MAX_RADIUS_SCALES * sigma + MAX_RADIUS_EXTRA_PX
    for raised in BACKGROUND_STEPS:
        height = (1 - raised) * peak
        if height <= MIN_BRIGHTNESS_NOISES * rough:
            return None
        weight = np.clip(((smooth - raised * peak) / height - RAMP_LOW) / (RAMP_HIGH - RAMP_LOW), 0, 1)
        parts, _ = ndimage.label(weight > 0)
        weight[parts != parts.flat[top]] = 0
        if not (weight[end] > 0).any():
            return (
                weight,
                np.where((weight > 0) & (weight < 1), 1 / (height * (RAMP_HIGH - RAMP_LOW)), 0),
                raised * peak,
            )
    return None


def _residuals_about_profile(values: Floats, distance: Floats) -> Floats:
    """What is left of values (n,) when their dependence on the distance from the middle is taken away.

    The dependence is linear between knots a pixel apart. Each residual is scaled for what its own value pulled the
    profile towards it (its leverage), and all for the five numbers
    of middle and ellipse, so that its mean square is the variance of its noise.
    """
    knots = np.arange(0, np.ceil(distance.max()) + 1)
    hats = np.maximum(1 - np.abs(distance[:, None] - knots), 0)
    basis = np.linalg.qr(hats[:, hats.sum(axis=0) > 0.5])[0]
    leverage = np.sum(basis**2, axis=1)
    left = np.maximum(1 - leverage, 0.1) * max(1 - 5 / len(values), 0.1)
    return np.asarray((values - basis @ (basis.T @ values)) / np.sqrt(left), dtype=np.float64)
