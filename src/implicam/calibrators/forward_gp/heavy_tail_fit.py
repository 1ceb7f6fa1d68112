"""After the fit: is the pixel noise heavy-tailed, and the rig fitted with views weighted by a Student's t."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.rounds import Round, check_fitted, next_round
from implicam.calibrators.forward_gp.settings import Training
from implicam.geometry import Bools, Floats
from implicam.rig_model.camera_model import CameraViews, random_subset
from implicam.rig_model.fit_result import FitResult
from implicam.rig_model.heavy_tails import (
    HeavyTails,
    degrees_of_agreement,
    looks_heavy,
    outlier_distance,
    student_t_weights,
    whiten,
)
from implicam.rig_model.leave_one_out import (
    left_out_residuals_from,
    next_inliers,
    posterior_residuals,
)
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.wrong_views import LinearisedViews


def refit_with_heavy_tails(training: Training, fitted: FitResult) -> FitResult:
    """A few rounds more with views weighted by a Student t, where the noise of the fit clearly is one.

    Args:
        training: What all cameras saw.
        fitted: A fit that took the noise for normal.

    Returns:
        The fit with heavy tails, or as it was.
    """
    mine, errors = training.of_cameras(fitted.cameras), fitted.errors
    state = Round(
        fitted.posterior, fitted.inliers, fitted.hyperparameters, errors, errors, fitted.label_sd, settled=True
    )
    keep_sizes = errors is not None and not errors.estimated
    try:
        for number in range(training.settings.tail_rounds):
            found = _estimate_tails(mine, state)
            if found is None:
                break
            tails, inliers = found
            again = state._replace(tails=tails, inliers=inliers)
            state = next_round(mine, again, search=number == 0, keep_sizes=keep_sizes)
        if state.tails is None:
            return fitted
        check_fitted(mine, state)
    except np.linalg.LinAlgError:
        return fitted
    assert state.hyper is not None
    return replace(
        fitted,
        posterior=state.posterior,
        inliers=state.inliers,
        hyperparameters=state.hyper,
        errors=state.errors,
        label_sd=state.label_sd,
        tails=state.tails,
    )


def _estimate_tails(training: Training, state: Round) -> tuple[HeavyTails, tuple[Bools, ...]] | None:
    """Degrees of freedom of the noise, from how far all views are from what the others predict; the weight of each view
    by how far it is from what all say; and the views to use. None where the noise is normal."""
    seen, settings = training.camera_views, training.settings
    weighted = seen if state.tails is None else state.tails.weight_views(seen, with_loss=True)

    def one(c: int, most: int) -> _Predicted:
        some = random_subset(len(seen[c].rows), most)
        return _Predicted.of(
            state.posterior, c, training.points, seen[c].select(some), weighted[c].select(some), state.inliers[c][some]
        )

    if state.tails is None:
        few = [one(c, settings.max_tail_views_per_camera) for c in range(len(seen))]
        areas = [(2 * image.half) ** 2 for image in training.images]
        background = [2 * np.pi * f.variance / area for f, area in zip(few, areas, strict=True)]
        if not looks_heavy(np.concatenate([f.distance for f in few]), np.concatenate(background), settings):
            return None
        try:
            degrees = degrees_of_agreement(*_whiten_views(state.posterior, training, few), settings)
        except np.linalg.LinAlgError:  # the cameras among themselves say nothing of the noise
            return None
    else:
        degrees = state.tails.degrees
    if degrees is None:
        return None
    every = [one(c, len(training.points)) for c in range(len(seen))]
    limit = outlier_distance(degrees, settings.max_squared_mahalanobis)
    judged = tuple(next_inliers(p.distance, k, limit) for p, k in zip(every, state.inliers, strict=True))
    return HeavyTails(degrees, tuple(student_t_weights(p.own, degrees) for p in every)), judged


class _Predicted(NamedTuple):
    """Of one camera's views: rows of the points, residual (n, 2) from what the others predict, and its scale matrix in
    covariance (n, 2, 2); the squared distance (n,) by these; own: the expected one from what all say; variance (n,) of
    the noise, the scale squared, px^2."""

    rows: NDArray[np.int64]
    residual: Floats
    covariance: Floats
    distance: Floats
    own: Floats
    variance: Floats

    @classmethod
    def of(
        cls, posterior: Posterior, c: int, points: Floats, seen: CameraViews, weighted: CameraViews, inliers: Bools
    ) -> _Predicted:
        at = posterior_residuals(posterior, c, points, weighted)
        variance = (posterior.models[c].noise * seen.relative) ** 2
        residual, covariance = left_out_residuals_from(at, inliers)
        covariance = covariance - (at.sd**2 - variance)[:, None, None] * np.eye(2)
        distance = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(covariance), residual)
        sound = np.isfinite(distance) & (covariance[:, 0, 0] > 0) & (np.linalg.det(covariance) > 0)
        distance = np.where(sound, distance, np.inf)
        expected = (np.sum(at.residual**2, axis=1) + np.trace(at.reach, axis1=1, axis2=2)) / variance
        return cls(seen.rows, residual, covariance, distance, np.where(inliers, expected, distance), variance)


def _whiten_views(
    posterior: Posterior, training: Training, predicted: list[_Predicted]
) -> tuple[Floats, Floats, Bools]:
    """Of points, slopes and residuals of their views in the scale of the noise, and which there are: not those that are
    wrong even with heavy tails."""
    settings = training.settings
    limit = outlier_distance(min(settings.tail_degrees_of_freedom), settings.max_squared_mahalanobis)
    n, C = len(training.points), len(predicted)
    each = np.broadcast_to(np.eye(2), (n, C, 2, 2)).copy()
    r, D, seen = np.zeros((n, C, 2)), np.zeros((n, C, 2, 3)), np.zeros((n, C), dtype=np.bool_)
    for c, view in enumerate(predicted):
        good = view.distance <= limit
        rows = view.rows[good]
        each[rows, c] = np.linalg.inv(view.covariance[good])
        r[rows, c], seen[rows, c] = view.residual[good], True
        D[rows, c] = posterior.models[c].predict(training.points[rows])[1]
    return *whiten(LinearisedViews(r, D, each, None)), seen
