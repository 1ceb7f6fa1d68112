"""One round of the fit: hyperparameters, posterior, and how far shots are off."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from implicam.calibrators.forward_gp.hyperparameters import estimate_hyperparameters, size_fields
from implicam.calibrators.forward_gp.settings import Training
from implicam.geometry import Bools, Floats
from implicam.rig_model.camera_model import CameraViews
from implicam.rig_model.field import Hyperparameters
from implicam.rig_model.heavy_tails import HeavyTails
from implicam.rig_model.linearise import iterate_linearisation
from implicam.rig_model.normal_equations import CameraFailedError
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.shot_errors import ShotErrors
from implicam.rig_model.training_data import MIN_POINTS_PER_CAMERA


class Round(NamedTuple):
    """What a round of the fit hands to the next.

    posterior: before the first round, the cameras as they were started. inliers: per camera the views (n,) to use.
    hyper: a guess before the first round, or None. next_errors: of the known points, more probable than `errors`, those
    of the posterior; label_sd: their sds for error bars. settled: the two are about the same. tails: of the noise.
    """

    posterior: Posterior
    inliers: tuple[Bools, ...]
    hyper: Hyperparameters | None
    next_errors: ShotErrors | None
    errors: ShotErrors | None = None
    label_sd: Floats | None = None
    settled: bool = False
    tails: HeavyTails | None = None

    def used(self, seen: tuple[CameraViews, ...], *, with_loss: bool) -> tuple[CameraViews, ...]:
        """The views to use, with their weights as noise.

        Args:
            seen: Per camera, what it saw.
            with_loss: Noisier by the loss of information too: for what is known of the cameras.

        Returns:
            Per camera, its inliers.
        """
        weighted = seen if self.tails is None else self.tails.weight_views(seen, with_loss=with_loss)
        return tuple(views.select(k) for views, k in zip(weighted, self.inliers, strict=True))


def next_round(training: Training, last: Round, *, search: bool, keep_sizes: bool) -> Round:
    """Sizes, posterior, and how far the shots are off.

    Args:
        training: What the cameras of the round saw, and no others.
        last: The round before.
        search: Look for other lengthscales, too.
        keep_sizes: Keep the hyperparameters of the last round, if it has any.

    Raises:
        CameraFailedError: Too few views of a camera agree with the others.
    """
    models, seen, errors = last.posterior.models, training.camera_views, last.next_errors
    inliers = tuple(
        k & np.isfinite(m.camera.pixel(training.points[s.rows])).all(axis=1)  # a camera can turn its back on a point
        for k, m, s in zip(last.inliers, models, seen, strict=True)
    )
    for number, k in enumerate(inliers):
        if k.sum() < MIN_POINTS_PER_CAMERA:
            raise CameraFailedError(number, f"{k.sum()} of its {len(k)} views agree with the others")
    last = last._replace(inliers=inliers)
    hyper = last.hyper
    if hyper is None or not keep_sizes:
        moved = None if last.posterior.unknowns is None else last.posterior.displacement
        used = last.used(seen, with_loss=False)
        hyper = estimate_hyperparameters(training, models, used, last.hyper, moved, search=search)
    used = last.used(seen, with_loss=True)
    posterior = iterate_linearisation(size_fields(training, models, used, hyper), training.points, used, errors)
    this = Round(posterior, inliers, hyper, errors, errors, settled=True, tails=last.tails)
    if errors is None or posterior.unknowns is None:
        return this
    mean, variance = posterior.unknowns.mean, np.diag(posterior.unknowns.covariance)
    shape, settings = errors.sd.shape, training.settings
    following, label_sd = errors.update(mean.reshape(shape), variance.reshape(shape), settings)
    settled = bool(np.allclose(following.sd, errors.sd, rtol=settings.shot_sd_tolerance))
    return this._replace(next_errors=following, label_sd=label_sd, settled=settled)


def check_fitted(training: Training, state: Round) -> None:
    """Stop at a camera that ends far off its own known points: it is no camera, whatever its covariance says.

    Args:
        training: What the cameras of the round saw, and no others.
        state: Of the fit.

    Raises:
        CameraFailedError: A camera's median error is too large, or it has too few views.
    """
    points, posterior = training.points, state.posterior
    if posterior.displacement is not None:
        points = points + posterior.displacement
    for number, (model, views) in enumerate(zip(posterior.models, training.camera_views, strict=True)):
        used = views.select(state.inliers[number])
        error = np.linalg.norm(model.pixel(points[used.rows]) - used.uv, axis=1) / used.relative
        limit = training.settings.max_median_error_noises * model.noise
        if len(error) < MIN_POINTS_PER_CAMERA or not np.median(error) < limit:
            off = float(np.median(error)) if len(error) else np.nan
            raise CameraFailedError(number, f"it ends {off:.3g} px off its own known points")
