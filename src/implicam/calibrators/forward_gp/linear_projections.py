"""Which cameras are predicted better as linear projections with a large field than with a lens model."""

from __future__ import annotations

import numpy as np

from implicam.calibrators.forward_gp.settings import Training
from implicam.errors import FitError
from implicam.geometry import Floats
from implicam.rig_model.fit_result import FitResult
from implicam.rig_model.initialise import InitialCamera, check_start, start_camera
from implicam.rig_model.leave_one_out import left_out_positions, left_out_residuals


def start_without_lens(training: Training, c: int, before: InitialCamera) -> InitialCamera | None:
    """Camera c, started with a lens before, as a linear projection; None where it saw too little for its field."""
    seen = training.camera_views[c]
    if len(seen.rows) < training.settings.min_views_without_lens:
        return None
    try:
        found = start_camera(training.points[seen.rows], seen.uv, training.images[c], "none", training.settings)
        check_start(found, training.points[seen.rows], seen.uv, training)
    except FitError:
        return None
    return found._replace(ordinary_px=before.ordinary_px)


def predicts_better(training: Training, one: FitResult, other: FitResult, number: int) -> bool:
    """Whether a camera's left-out views are clearly more probable in one fit than in another."""
    gain = _left_out_log_densities(training, one, number) - _left_out_log_densities(training, other, number)
    clearly = 2 * float(np.std(gain)) * np.sqrt(len(gain))
    return bool(np.sum(gain) > max(clearly, training.settings.min_gain_without_lens_nats))


def measures_better(training: Training, one: FitResult, other: FitResult) -> bool:
    """Whether known points, measured without themselves, are clearly nearer to their positions in one fit than in
    another. A view of a steep camera says little of depth, so its density is not all that counts."""
    squares = []
    for fitted in (one, other):
        seen = training.of_cameras(fitted.cameras).camera_views
        error, _ = left_out_positions(fitted.posterior, training.points, seen, fitted.inliers)
        squares.append(np.sum(error**2, axis=1))
    one_squares, other_squares = np.array(squares)[:, np.isfinite(squares).all(axis=0)]
    if len(one_squares) < training.settings.min_views_without_lens:
        return False
    most = training.settings.max_squared_error_medians  # a wrong point says nothing of either
    limit = most * float(np.median(other_squares))
    gain = np.minimum(other_squares, limit) - np.minimum(one_squares, limit)
    return bool(np.sum(gain) > 2 * float(np.std(gain)) * np.sqrt(len(gain)))


def _left_out_log_densities(training: Training, fitted: FitResult, number: int) -> Floats:
    """(n,) of each view of a camera, predicted from all others; a wrong view costs what a view just rejected does."""
    seen, inliers = training.camera_views[fitted.cameras[number]], fitted.inliers[number]
    residual, covariance = left_out_residuals(fitted.posterior, number, training.points, seen, inliers)
    distance = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(covariance), residual)
    limit = training.settings.max_squared_mahalanobis
    distance = np.minimum(np.where(np.isfinite(distance), distance, limit), limit)
    return np.asarray(-0.5 * (distance + np.linalg.slogdet(covariance)[1]), dtype=np.float64)
