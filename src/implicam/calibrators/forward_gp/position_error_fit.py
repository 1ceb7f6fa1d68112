"""After the fit: are single known positions off, by how much, and what then is known of the cameras.

The fit takes errors of known positions for pixel noise. Here they are told apart (position_errors.py), the views are
judged again, and the cameras are conditioned once more, with less noise and tied by the errors of the positions.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from implicam.calibrators.forward_gp.heavy_tail_fit import refit_with_heavy_tails
from implicam.calibrators.forward_gp.settings import ForwardGPSettings, Training
from implicam.dataset import Names
from implicam.geometry import Bools, Floats
from implicam.rig_model.fit_result import FitResult
from implicam.rig_model.leave_one_out import LeftOutViews, left_out_views, sum_over_cameras
from implicam.rig_model.level_errors import find_uncertain_planes
from implicam.rig_model.linearise import iterate_linearisation
from implicam.rig_model.position_errors import Agreement, PositionErrors, estimate_position_errors
from implicam.rig_model.tied import Scatter


def separate_position_errors(training: Training, fitted: FitResult, shots: Names) -> FitResult:
    """Tell errors of known positions and heavy tails from the pixel noise, for which the fit took them.

    Errors of positions come first. A dot that is off makes outliers in all cameras at once, which look like heavy tails
    to each of them; tails of the pixels, which cameras do not share, never look like dots that are off. What is
    declared is not estimated.

    Args:
        training: What all cameras saw.
        fitted: A fit to it.
        shots: (n,) name of each point's shot.

    Returns:
        The fit with errors of known positions if all cameras agree on them, or with heavy tails, or as it was.
    """
    if training.errors is not None and not training.errors.estimated:
        return refit_with_heavy_tails(training, fitted)
    planes = find_uncertain_planes(training.points, shots, training.settings) if training.errors is None else None
    if planes is not None:
        fitted = replace(fitted, plane_sd=planes.sd)
    scattered = _separate(training, fitted)
    if scattered.position_errors is not None:
        return scattered
    heavy = refit_with_heavy_tails(training, fitted)
    return fitted if heavy.tails is None else _separate(training, heavy)


def _separate(training: Training, fitted: FitResult) -> FitResult:
    seen, settings = training.of_cameras(fitted.cameras).camera_views, training.settings
    if fitted.posterior.offsets[-1] > settings.max_tied_unknowns:
        return fitted
    if fitted.tails is not None:
        seen = fitted.tails.weight_views(seen, with_loss=True)
    inliers, points = fitted.inliers, training.points
    views = left_out_views(fitted.posterior, points, seen, inliers)
    total, ratio = sum_over_cameras(views, inliers, len(points))
    errors = _estimate(total, ratio, settings)
    if errors is None:
        return fitted
    inliers = _update_inliers(views, inliers, errors, total, settings.max_squared_mahalanobis)
    if any((a != b).any() for a, b in zip(inliers, fitted.inliers, strict=True)):
        errors = _estimate(*sum_over_cameras(views, inliers, len(points)), settings) or errors
    models = tuple(replace(model, noise=model.noise * errors.noise) for model in fitted.posterior.models)
    used = tuple(one.select(k) for one, k in zip(seen, inliers, strict=True))
    assert errors.size is not None
    try:
        posterior = iterate_linearisation(models, points, used, fitted.errors, Scatter(errors.root, errors.size))
    except np.linalg.LinAlgError:  # then the cameras stay as they were, with more noise than there is
        return fitted
    return replace(fitted, posterior=posterior, inliers=inliers, position_errors=errors)


def _estimate(total: Agreement, variance_ratio: Floats, settings: ForwardGPSettings) -> PositionErrors | None:
    """The errors, with how much larger than usual each point's own scale is."""
    limit, most = settings.max_left_out_variance_ratio, settings.max_points_for_position_errors
    rows = np.flatnonzero((total.coordinates >= 4) & (variance_ratio < limit)).astype(np.int64)
    some = rows if len(rows) <= most else np.random.default_rng(0).choice(rows, most, replace=False)
    errors = estimate_position_errors(total.select(some), settings)
    if errors is None:
        return None
    size = np.ones(len(variance_ratio))
    size[rows] = np.sqrt(errors.weights(total.select(rows)))
    return replace(errors, size=size)


def _update_inliers(
    views: list[LeftOutViews], inliers: tuple[Bools, ...], found: PositionErrors, total: Agreement, limit: float
) -> tuple[Bools, ...]:
    """The views to use: those that agree with what the others say of where their point is."""
    noise2 = found.noise**2
    prior = np.linalg.inv(found.covariance)
    judged = []
    for view, k in zip(views, inliers, strict=True):
        information, pull = view.information, view.pull
        others = (total.information[view.rows] - np.where(k[:, None, None], information, 0)) / noise2 + prior
        drawn = (total.pull[view.rows] - np.where(k[:, None], pull, 0)) / noise2
        where = np.linalg.inv(others)
        residual = view.residual - np.einsum("nij,njk,nk->ni", view.slope, where, drawn)
        covariance = noise2 * np.linalg.inv(view.inverse) + view.slope @ where @ view.slope.swapaxes(1, 2)
        distance = np.einsum("ni,ni->n", residual, np.linalg.solve(covariance, residual[..., None])[..., 0])
        judged.append(np.asarray(distance <= limit, dtype=np.bool_))
    return tuple(judged)
