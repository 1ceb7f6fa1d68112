"""Kinds of cameras: four priors on one camera model, and how probable each is after the views, eqs. (3) and (11).

Every kind has the same parameters; one that a kind does not have is held by a narrow prior. So evidences compare
directly: with few points the simplest kind wins, with more the views overrule it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from implicam.calibrators.forward_gp.evidence import (
    LOG_NOISE_PRIOR,
    LOG_SIGNAL_PRIOR,
    STATED_NOISE_LOG_SD,
    CameraEvidence,
    Spectrum,
)
from implicam.geometry import Floats
from implicam.rig_model.camera import DISTORTION_AT_EDGE_PRIOR_SD, DISTORTION_PRIOR_SD, PERSPECTIVE_K, Image, Prior
from implicam.rig_model.field import field_coordinates
from implicam.rig_model.general_camera import CENTRE, KAPPA, MIN_RHO, RHO, GeneralCamera


class Family(NamedTuple):
    """Prior sds: of p and q of the pixels' shape, of the tilt, of the principal point in the longer side of the image;
    weight: prior odds of the kind."""

    p: float
    q: float
    tilt: float
    centre: float
    weight: float


FAMILIES = {
    "ordinary": Family(0.001, 1e-5, 1e-5, 0.02, 1.0),
    "aspect": Family(0.15, 0.02, 1e-5, 0.02, 0.05),
    "crop": Family(0.001, 1e-5, 1e-5, 0.4, 0.05),
    "free": Family(0.15, 0.08, 0.3, 0.4, 0.02),
}
"""ordinary: square pixels, the lens over the image's centre. aspect: pixels of any shape. crop: the lens anywhere.
free: all of it, and a tilted image plane."""

MIRRORED_PRIOR_ODDS = 0.2
"""Prior odds of a mirrored picture; each kind and sign gains 1 for every other camera of the rig that has it."""

TELEPHOTO_EDGE_SD = np.array([0.01, 0.0005])
"""What k1 and k2 may do at the edge of the image at least, as a part of the radius: at 2 degrees a prior of the angle
alone would allow no distortion at all."""

RHO_PRIOR_SD = 3.0
"""Prior sd of the inverse distance of the working frame's origin, in the working frame."""

NEAR_FAMILY = Family(0.05, 0.05, 0.25, 0.25, 0.0)
"""Of a free camera after the choice: sds about the camera found. Where its field is large it would wander without."""
NEAR_RHO_RELATIVE_SD = 0.75

CHOICE_SIGNAL_LOG_SD = 0.5
"""Log sd of the field's size while kinds are compared: a field of 100 px must not stand in for a tilt."""

AT_INFINITY_NATS = 3.0
"""Nats against a camera at the largest distance there is: a perspective of the wrong sign ends there."""

CHOICE_LENGTHSCALE = np.array([1.0, 2.0])

MAX_CHOICE_VIEWS = 200
"""Views that kinds are compared by."""

_PROPER = slice(1, 12)
"""The parameters with a proper prior in every kind: focal length and pose are flat."""


def family_prior(camera: GeneralCamera, family: str, image: Image, widest: float) -> Prior:
    """Eq. (3) of a camera that is used up to `widest` radians off its axis."""
    kind = FAMILIES[family]
    mean, precision = np.zeros(camera.size), np.zeros((camera.size, camera.size))
    mean[CENTRE] = image.centre
    sd = np.array([kind.p, kind.q, kind.tilt, kind.tilt, *2 * [kind.centre * 2 * image.half]])
    precision[range(1, 7), range(1, 7)] = 1 / sd**2
    powers = np.array([2, 4, 6, 8])
    own = DISTORTION_PRIOR_SD.copy()
    own[:2] = np.maximum(own[:2], TELEPHOTO_EDGE_SD / widest ** powers[:2])
    own = np.minimum(own, DISTORTION_AT_EDGE_PRIOR_SD / widest**powers)
    unit = camera.rho**powers
    covariance = np.diag(own**2) + 0.25 * np.outer(PERSPECTIVE_K, PERSPECTIVE_K)
    precision[KAPPA, KAPPA] = np.linalg.inv(covariance) / np.outer(unit, unit)
    precision[RHO, RHO] = 1 / RHO_PRIOR_SD**2
    return Prior(mean, precision)


def near_prior(camera: GeneralCamera, prior: Prior, image: Image) -> Prior:
    """The prior of a free camera about where it was found."""
    mean, precision = prior.mean.copy(), prior.precision.copy()
    at = camera.parameters
    sd = np.array(
        [NEAR_FAMILY.p, NEAR_FAMILY.q, NEAR_FAMILY.tilt, NEAR_FAMILY.tilt, *2 * [NEAR_FAMILY.centre * 2 * image.half]]
    )
    mean[1:7] = at[1:7]
    precision[range(1, 7), range(1, 7)] = 1 / sd**2
    mean[RHO], precision[RHO, RHO] = at[RHO], 1 / (NEAR_RHO_RELATIVE_SD * at[RHO]) ** 2
    return Prior(mean, precision)


def widest_angle(camera: GeneralCamera, points: Floats) -> float:
    """Radians off the axis of the farthest of points (n, 3)."""
    there = camera.pose.apply(points)
    return float(np.arctan2(np.hypot(there[:, 0], there[:, 1]), there[:, 2]).max())


class Views(NamedTuple):
    """What kinds are compared by: points (n, 3), pixels (n, 2), relative noise (n,), the image, and the stated noise in
    pixels or NaN."""

    points: Floats
    uv: Floats
    relative: Floats
    image: Image
    stated: float


def log_evidences(camera: GeneralCamera, priors: Sequence[Prior], views: Views) -> list[float]:
    """Log marginal likelihood of the views with each prior, in nats: lens and pose integrated out, linear about this
    camera, sizes at their most probable."""
    view = camera.view(views.points)
    if not np.isfinite(view.by_parameters).all():
        return [-np.inf for _ in priors]
    residual, q = views.uv - view.uv, field_coordinates(view, views.image)
    at = camera.parameters
    every = [
        CameraEvidence(residual, view.by_parameters, prior.mean - at, prior, q, views.relative) for prior in priors
    ]
    try:
        spectrum = every[0].spectrum(CHOICE_LENGTHSCALE, 1e-6)
    except np.linalg.LinAlgError:
        return [-np.inf for _ in priors]
    at_infinity = AT_INFINITY_NATS if camera.rho < 1.01 * MIN_RHO else 0.0
    return [_log_evidence(one, spectrum, views) - at_infinity for one in every]


def _log_evidence(one: CameraEvidence, spectrum: Spectrum, views: Views) -> float:
    stated = np.isfinite(views.stated)
    median = np.log([np.exp(LOG_SIGNAL_PRIOR["general"][0]) * views.image.half, 1.0])
    median[1] = np.log(views.stated) if stated else LOG_NOISE_PRIOR[0] + np.log(views.image.half)
    sd = np.array([CHOICE_SIGNAL_LOG_SD, STATED_NOISE_LOG_SD if stated else LOG_NOISE_PRIOR[1]])

    def loss(z: Floats) -> tuple[float, Floats]:
        value, by_signal, by_noise = one.objective(spectrum, *np.exp(median + z))
        return value + 0.5 * float(np.sum((z / sd) ** 2)), np.array([by_signal, by_noise]) + z / sd**2

    rms = np.sqrt(np.mean((one.residual / views.relative[:, None]) ** 2))
    start = np.array([0.0, np.clip(np.log(rms) - median[1], -4, 8)])
    try:
        found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=[(-4, 8), (-6, 10)], options={"ftol": 1e-6})
        proper = np.linalg.slogdet(_scaled(one.prior.precision[_PROPER, _PROPER]))
    except np.linalg.LinAlgError:
        return -np.inf
    logs = float(proper[1] + np.sum(np.log(np.diag(one.prior.precision)[_PROPER])))
    return -float(found.fun) + 0.5 * logs


def _scaled(A: Floats) -> Floats:
    scale = 1 / np.sqrt(np.diag(A))
    return A * scale[:, None] * scale
