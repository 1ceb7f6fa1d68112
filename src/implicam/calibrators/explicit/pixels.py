"""What the pixels of a camera are like: square or not, the lens over the middle of the picture or anywhere.

Most cameras have square pixels and a lens over the middle, and with few views it pays to know that. Resized pictures,
PAL and anamorphic video, and cut-out pictures do not. Four priors of one camera are told apart by the marginal
likelihood of its views (MacKay 2003, chapter 28): the wide ones pay for what they allow, and win only where the views
say so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from implicam.calibrators.explicit.lenses import USUAL_PIXELS
from implicam.calibrators.explicit.settings import ExplicitSettings
from implicam.rig_model import CentralCamera, Image, Prior

ASPECTS = (1.0, 0.5, 0.63, 0.79, 1.26, 1.59, 2.0)
"""Ratios fy / fx that a start tries: the steps of 26 % are close enough for what follows."""


CROPPED = "cropped"
"""The name of square pixels of a picture that was cut out."""


class Pixels(NamedTuple):
    """A prior: aspect, sd of log(fy / fx); centre, sd of the principal point as a part of the longer side; odds, how
    many times rarer than the usual it is before a view is seen."""

    name: str
    aspect: float
    centre: float
    odds: float


def square(settings: ExplicitSettings, widening: float = 1.0) -> Pixels:
    """Square pixels and a lens over the middle of the picture: the usual.

    Args:
        settings: The prior's standard deviations.
        widening: Of the prior of the middle.

    Returns:
        The prior.
    """
    return Pixels(USUAL_PIXELS, settings.log_aspect_prior_sd, widening * settings.centre_prior_sd_sides, 1.0)


def kinds(usual: Pixels, settings: ExplicitSettings) -> tuple[Pixels, ...]:
    """The usual and what else there is; the last allows all.

    Args:
        usual: As of `square`.
        settings: The priors and odds of the others.

    Returns:
        Four priors.
    """
    aspect, centre = settings.stretched_log_aspect_prior_sd, settings.cropped_centre_prior_sd_sides
    return (
        usual,
        Pixels("stretched", aspect, usual.centre, settings.stretched_odds_ratio),
        Pixels(CROPPED, usual.aspect, centre, settings.cropped_odds_ratio),
        Pixels("any", aspect, centre, settings.any_pixels_odds_ratio),
    )


def prior_of(camera: CentralCamera, image: Image, widest: float, pixels: Pixels, settings: ExplicitSettings) -> Prior:
    """The prior of a camera's lens (eq. (3) of docs/method.md) with this one of its pixels.

    Args:
        camera: Its focal lengths are where log(fy / fx) is made linear.
        image: Where its pixels are measured from.
        widest: Radians off its axis up to which it is used.
        pixels: The prior of its pixels.
        settings: The prior of its distortion.

    Returns:
        Mean and precision, zero for what nothing is known of.
    """
    usual = camera.prior(image, widest, settings)
    mean, precision = usual.mean.copy(), usual.precision.copy()
    lens = camera.lens
    # log(fy / fx) about 0, made linear where the lens is: (fy - fx) over their mean has the same slope
    typical = lens.fx if pixels.name in (USUAL_PIXELS, CROPPED) else 0.5 * (lens.fx + lens.fy)
    precision[:2, :2] = np.array([[1, -1], [-1, 1]]) / (pixels.aspect * typical) ** 2
    precision[2, 2] = precision[3, 3] = 1 / (pixels.centre * 2 * image.half) ** 2
    return Prior(mean, precision)


def told(name: str, camera: CentralCamera, image: Image, pixels: str) -> list[str]:
    """A note on a camera whose pixels are not the usual ones.

    Args:
        name: Of the camera.
        camera: As it was fitted.
        image: Where its pixels are measured from.
        pixels: Name of the prior that won.

    Returns:
        The note; no note for the usual ones.
    """
    lens, notes = camera.lens, []
    if pixels in ("stretched", "any"):
        notes.append(f"its pixels are not square, fy / fx = {lens.fy / lens.fx:.4g}")
    if pixels in (CROPPED, "any"):
        off = np.array([lens.cx, lens.cy]) - image.centre
        notes.append(f"its lens is {off[0]:+.3g}, {off[1]:+.3g} px off the middle of the picture")
    return [f"{name}: {' and '.join(notes)}, as its views clearly say."] if notes else []


def log_density_at_peak(prior: Prior, camera: CentralCamera, image: Image, pixels: Pixels) -> float:
    """Log of the proper part of the prior where it is highest, up to what is the same for all pixels; and its odds.

    Args:
        prior: As of `prior_of`.
        camera: As it was fitted.
        image: Where its pixels are measured from.
        pixels: The prior of its pixels.

    Returns:
        In nats.
    """
    own = -np.log(pixels.aspect) - 2 * np.log(pixels.centre) - np.log(camera.lens.fx / image.half)
    distortion = np.linalg.slogdet(prior.precision[4:-6, 4:-6])[1]
    return float(own + 0.5 * distortion - np.log(pixels.odds))


def noise_prior(sd: float, image: Image, settings: ExplicitSettings) -> float:
    """The log prior of a noise.

    Args:
        sd: The noise, pixels.
        image: Half its longer side is the unit.
        settings: Median and sd of the log.

    Returns:
        In nats, up to a constant.
    """
    median = settings.noise_prior_median_half_sides * image.half
    return float(-0.5 * (np.log(sd / median) / settings.noise_prior_log_sd) ** 2)
