"""One round of the fit: hyperparameters, posterior, and how far shots are off."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from implicam.calibrators.forward_gp.hyperparameters import estimate_hyperparameters, size_fields
from implicam.calibrators.forward_gp.settings import Training
from implicam.geometry import Bools, Floats
from implicam.rig_model.camera import Image
from implicam.rig_model.camera_model import CameraModel, CameraViews
from implicam.rig_model.field import Hyperparameters
from implicam.rig_model.heavy_tails import HeavyTails
from implicam.rig_model.linearise import iterate_linearisation
from implicam.rig_model.normal_equations import CameraFailedError
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.shot_errors import ShotErrors
from implicam.rig_model.training_data import MIN_POINTS_PER_CAMERA


def check_fitted(training: Training, state: Round, seen: tuple[CameraViews, ...]) -> None:
    """A camera that ends far off its own known points is no camera, whatever its covariance says."""
    points = training.points
    if state.posterior.displacement is not None:
        points = points + state.posterior.displacement
    for number, (model, views, inliers) in enumerate(zip(state.posterior.models, seen, state.inliers, strict=True)):
        rows = views.rows[inliers]
        error = np.linalg.norm(model.predict(points[rows])[0] - views.uv[inliers], axis=1) / views.relative[inliers]
        limit = training.settings.max_median_error_noises * model.noise
        if len(rows) < MIN_POINTS_PER_CAMERA or not np.median(error) < limit:
            off = float(np.median(error)) if len(rows) else np.nan
            raise CameraFailedError(number, f"it ends {off:.3g} px off its own known points")


class Round(NamedTuple):
    """What a round of the fit hands to the next; errors: those of its posterior, next_errors: more probable ones;
    fixed: hyperparameters that are kept."""

    hyper: Hyperparameters | None
    models: tuple[CameraModel, ...]
    found: Posterior | None
    inliers: tuple[Bools, ...]
    next_errors: ShotErrors | None
    label_sd: Floats | None
    settled: bool
    errors: ShotErrors | None = None
    fixed: Hyperparameters | None = None
    tails: HeavyTails | None = None

    def weighted(self, seen: tuple[CameraViews, ...], *, told: bool) -> tuple[CameraViews, ...]:
        """The views with their weights as noise; told: as much as they tell, for what is known of the cameras."""
        return seen if self.tails is None else self.tails.weighted(seen, told=told)

    @property
    def posterior(self) -> Posterior:
        """That of a round that has been."""
        assert self.found is not None
        return self.found


def next_round(
    training: Training,
    last: Round,
    seen: tuple[CameraViews, ...],
    images: tuple[Image, ...],
    stated: Floats,
    *,
    search: bool,
) -> Round:
    """Sizes, posterior, and how far the shots are off. search: for other lengthscales too."""
    inliers = tuple(
        k & np.isfinite(m.camera.pixel(training.points[s.rows])).all(axis=1)  # a camera can turn its back on a point
        for k, m, s in zip(last.inliers, last.models, seen, strict=True)
    )
    for number, k in enumerate(inliers):
        if k.sum() < MIN_POINTS_PER_CAMERA:
            raise CameraFailedError(number, f"{k.sum()} of its {len(k)} views agree with the others")
    used = tuple(s.select(k) for s, k in zip(last.weighted(seen, told=False), inliers, strict=True))
    moved = None if last.found is None or last.found.unknowns is None else last.found.displacement
    hyper = last.fixed or estimate_hyperparameters(
        training, last.models, used, images, stated, last.hyper, moved, search
    )
    errors = last.next_errors
    used = tuple(s.select(k) for s, k in zip(last.weighted(seen, told=True), inliers, strict=True))
    posterior = condition_with_new_fields(training, last.models, used, hyper, errors)
    following, label_sd, settled = errors, None, True
    if errors is not None and posterior.unknowns is not None:
        mean, variance = posterior.unknowns.mean, np.diag(posterior.unknowns.covariance)
        shape, settings = errors.sd.shape, training.settings
        following, label_sd = errors.updated(mean.reshape(shape), variance.reshape(shape), settings)
        settled = bool(np.allclose(following.sd, errors.sd, rtol=settings.shot_sd_tolerance))
    return Round(
        hyper, posterior.models, posterior, inliers, following, label_sd, settled, errors, last.fixed, last.tails
    )


def condition_with_new_fields(
    training: Training,
    models: tuple[CameraModel, ...],
    used: tuple[CameraViews, ...],
    hyper: Hyperparameters,
    errors: ShotErrors | None,
) -> Posterior:
    """The posterior with fields laid out anew."""
    return iterate_linearisation(size_fields(training, models, used, hyper), training.points, used, errors)
