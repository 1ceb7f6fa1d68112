"""Kinds of cameras: four priors on one camera model, and how probable each is after the views, eqs. (3) and (11).

Every kind has the same parameters; one that a kind does not have is held by a narrow prior. So evidences compare
directly: with few points the simplest kind wins, with more the views overrule it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from implicam.calibrators.forward_gp.evidence import (
    CameraEvidence,
    Spectrum,
)
from implicam.calibrators.forward_gp.settings import ForwardGPSettings
from implicam.geometry import Bools, Floats
from implicam.lenses import PERSPECTIVE_K
from implicam.rig_model.camera import Image, Prior
from implicam.rig_model.field import DepthScale, field_coordinates
from implicam.rig_model.general_camera import CENTRE, KAPPA, MIN_RHO, RHO, GeneralCamera

_PROPER = slice(1, 12)
"""The parameters with a proper prior in every kind: focal length and pose are flat."""


class Scene(NamedTuple):
    """What one camera saw: points (n, 3), pixels (n, 2), relative noise (n,), image, stated noise in pixels or NaN."""

    points: Floats
    uv: Floats
    relative: Floats
    image: Image
    stated: float
    settings: ForwardGPSettings

    def error(self, camera: GeneralCamera) -> Floats:
        """How far a camera is off the pixels.

        Args:
            camera: In the working frame.

        Returns:
            (n,) px, infinite where the camera sees nothing.
        """
        away = np.linalg.norm(camera.pixel(self.points) - self.uv, axis=1)
        return np.asarray(np.where(np.isnan(away), np.inf, away), dtype=np.float64)

    def near(self, error: Floats, inliers: Bools) -> Bools:
        """The views that a camera explains, judged by the median of those kept; of few views, which a camera of
        seventeen numbers may nearly go through, by the noise.

        Args:
            error: (n,) px.
            inliers: (n,) the views kept until now.

        Returns:
            (n,) the views explained.
        """
        by_error = self.settings.max_start_error_medians * float(np.median(error[inliers]))
        return np.asarray(error <= max(by_error, self.settings.min_tolerated_noises * self.noise), dtype=np.bool_)

    def select(self, rows: NDArray[np.int64] | Bools) -> Scene:
        """Some of the views.

        Args:
            rows: Their numbers, or (n,) which.

        Returns:
            The scene with these alone.
        """
        return self._replace(points=self.points[rows], uv=self.uv[rows], relative=self.relative[rows])

    @property
    def noise(self) -> float:
        """Px, as stated or usual."""
        usual = float(np.exp(self.settings.log_noise_prior[0])) * self.image.half
        return float(self.stated) if np.isfinite(self.stated) else usual


def family_prior(camera: GeneralCamera, family: str, image: Image, widest: float, settings: ForwardGPSettings) -> Prior:
    """The prior of a kind of camera, eq. (3).

    Args:
        camera: Its inverse distance is the unit of distortion.
        family: The kind.
        image: Where its pixels are measured from.
        widest: Radians off its axis up to which it is used.
        settings: The prior's standard deviations.

    Returns:
        Mean (17,) and precision (17, 17), zero for what nothing is known of.
    """
    kind = settings.kinds[family]
    mean, precision = np.zeros(camera.size), np.zeros((camera.size, camera.size))
    mean[CENTRE] = image.centre
    sd = np.array([kind.p, kind.q, kind.tilt, kind.tilt, *2 * [kind.centre * 2 * image.half]])
    precision[range(1, 7), range(1, 7)] = 1 / sd**2
    powers = np.array([2, 4, 6, 8])
    own = np.array(settings.distortion_prior_sd)
    own[:2] = np.maximum(own[:2], settings.telephoto_edge_sd / widest ** powers[:2])
    own = np.minimum(own, settings.distortion_at_edge_prior_sd / widest**powers)
    unit = camera.rho**powers
    covariance = np.diag(own**2) + 0.25 * np.outer(PERSPECTIVE_K, PERSPECTIVE_K)
    precision[KAPPA, KAPPA] = np.linalg.inv(covariance) / np.outer(unit, unit)
    precision[RHO, RHO] = 1 / settings.rho_prior_sd_per_wf**2
    return Prior(mean, precision)


def near_prior(camera: GeneralCamera, prior: Prior, image: Image, settings: ForwardGPSettings) -> Prior:
    """The prior of a free camera about where it was found.

    Args:
        camera: As it was found.
        prior: Of its kind.
        image: Where its pixels are measured from.
        settings: The sds about it.

    Returns:
        The prior, with shape, tilt, principal point and inverse distance about those of the camera.
    """
    mean, precision = prior.mean.copy(), prior.precision.copy()
    at = camera.parameters
    p, q, tilt, centre = settings.near_prior_sd
    sd = np.array([p, q, tilt, tilt, *2 * [centre * 2 * image.half]])
    mean[1:7] = at[1:7]
    precision[range(1, 7), range(1, 7)] = 1 / sd**2
    mean[RHO], precision[RHO, RHO] = at[RHO], 1 / (settings.near_rho_prior_relative_sd * at[RHO]) ** 2
    return Prior(mean, precision)


def widest_angle(camera: GeneralCamera, points: Floats) -> float:
    """The angle off the axis of the farthest of points.

    Args:
        camera: In the working frame.
        points: (n, 3) in the working frame, one or more.

    Returns:
        Radians.
    """
    there = camera.pose.apply(points)
    return float(np.arctan2(np.hypot(there[:, 0], there[:, 1]), there[:, 2]).max())


def log_evidences(camera: GeneralCamera, priors: Sequence[Prior], views: Scene) -> list[float]:
    """Log marginal likelihood of the views with each prior, in nats: lens and pose integrated out, linear about this
    camera, sizes at their most probable.

    Args:
        camera: About which all is linear.
        priors: The kinds to compare.
        views: What it saw.

    Returns:
        One for each prior; minus infinity where the camera does not see all points, or the equations have no solution.
    """
    view, settings = camera.view(views.points), views.settings
    if not np.isfinite(view.by_parameters).all():
        return [-np.inf for _ in priors]
    depth = DepthScale.of(view, settings.typical_log_distance_sd)
    residual, q = views.uv - view.uv, field_coordinates(view, views.image, depth)
    at = camera.parameters
    every = [
        CameraEvidence(residual, view.by_parameters, prior.mean - at, prior, q, views.relative) for prior in priors
    ]
    try:
        spectrum = every[0].spectrum(np.array(settings.choice_lengthscale), 1e-6)
    except np.linalg.LinAlgError:
        return [-np.inf for _ in priors]
    at_infinity = settings.at_infinity_nats if camera.rho < 1.01 * MIN_RHO else 0.0
    return [_log_evidence(one, spectrum, views) - at_infinity for one in every]


def _log_evidence(one: CameraEvidence, spectrum: Spectrum, views: Scene) -> float:
    settings, stated = views.settings, np.isfinite(views.stated)
    usual, usual_sd = settings.log_noise_prior
    median = np.log([np.exp(settings.log_signal_prior(lens=True)[0]) * views.image.half, 1.0])
    median[1] = np.log(views.stated) if stated else usual + np.log(views.image.half)
    sd = np.array([settings.choice_signal_log_sd, settings.stated_noise_log_sd if stated else usual_sd])

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
