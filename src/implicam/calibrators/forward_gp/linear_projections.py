"""Which cameras are predicted better as linear projections with a large field than with a lens model."""

from __future__ import annotations

import numpy as np

from implicam.errors import FitError
from implicam.geometry import Floats
from implicam.rig_model.fit_result import FitResult
from implicam.rig_model.initialise import InitialCamera, check_start, start_camera
from implicam.rig_model.leave_one_out import MAX_SQUARED_MAHALANOBIS, left_out_positions, left_out_residuals
from implicam.rig_model.training_data import TrainingData

MIN_VIEWS_WITHOUT_LENS = 40
"""Views that a camera without a lens model takes: its field must learn what a lens would say."""

LARGE_FIELD_HALF_SIDES = 3e-3
"""A field's sd, in half the longer side, that makes an ordinary camera doubtful: 2 px in 1280."""

MIN_GAIN_NATS = 3.0
"""By how much left-out views must at least be more probable without a lens model."""

MAX_SQUARES_MEDIANS = 20.0
"""Squared errors of known points, in their median, beyond which more does not count when fits are compared."""


def start_without_lens(training: TrainingData, c: int) -> InitialCamera | None:
    """Camera c as a linear projection with a field; None where it saw too little for one."""
    seen = training.camera_views[c]
    if len(seen.rows) < MIN_VIEWS_WITHOUT_LENS:
        return None
    try:
        found = start_camera(training.points[seen.rows], seen.uv, training.images[c], "none")
        check_start(found, training.points[seen.rows], seen.uv, training)
    except FitError:
        return None
    return found


def predicts_better(training: TrainingData, one: FitResult, other: FitResult, number: int) -> bool:
    """Whether a camera's left-out views are clearly more probable in one fit than in another."""
    gain = _left_out_log_densities(training, one, number) - _left_out_log_densities(training, other, number)
    clearly = 2 * float(np.std(gain)) * np.sqrt(len(gain))
    return bool(np.sum(gain) > max(clearly, MIN_GAIN_NATS))


def measures_better(training: TrainingData, one: FitResult, other: FitResult) -> bool:
    """Whether known points, measured without themselves, are clearly nearer to their positions in one fit than in
    another. A view of a steep camera says little of depth, so its density is not all that counts."""
    squares = []
    for fitted in (one, other):
        seen = tuple(training.camera_views[c] for c in fitted.cameras)
        error = left_out_positions(fitted.posterior, training.points, seen, fitted.inliers)
        squares.append(np.sum(error**2, axis=1))
    one_squares, other_squares = np.array(squares)[:, np.isfinite(squares).all(axis=0)]
    if len(one_squares) < MIN_VIEWS_WITHOUT_LENS:
        return False
    limit = MAX_SQUARES_MEDIANS * float(np.median(other_squares))  # a wrong point says nothing of either
    gain = np.minimum(other_squares, limit) - np.minimum(one_squares, limit)
    return bool(np.sum(gain) > 2 * float(np.std(gain)) * np.sqrt(len(gain)))


def _left_out_log_densities(training: TrainingData, fitted: FitResult, number: int) -> Floats:
    """(n,) of each view of a camera, predicted from all others; a wrong view costs what a view just rejected does."""
    seen, inliers = training.camera_views[fitted.cameras[number]], fitted.inliers[number]
    residual, covariance = left_out_residuals(fitted.posterior, number, training.points, seen, inliers)
    distance = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(covariance), residual)
    distance = np.where(np.isfinite(distance), distance, MAX_SQUARED_MAHALANOBIS)
    return np.asarray(
        -0.5 * np.minimum(distance, MAX_SQUARED_MAHALANOBIS) - 0.5 * np.linalg.slogdet(covariance)[1], dtype=np.float64
    )
