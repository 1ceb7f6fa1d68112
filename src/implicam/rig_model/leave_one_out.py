"""Known points and views without themselves: what all others predict of them, in closed form, eq. (18)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.geometry import Bools, Floats
from implicam.rig_model.camera_model import CameraViews, apply_covariance_root
from implicam.rig_model.fit_result import FitResult
from implicam.rig_model.normal_equations import slices
from implicam.rig_model.position_errors import Agreement
from implicam.rig_model.posterior import Posterior
from implicam.threads import side_by_side

MIN_ONE_MINUS_LEVERAGE = 1e-9
"""One minus the leverage of a view, at least: below, rounding decides."""

MIN_INFORMATION_RATIO = 1e-12
"""Of a position, in its worst direction over that in its best: what is less is rounding."""


def squared_distances(posterior: Posterior, c: int, points: Floats, seen: CameraViews, inliers: Bools) -> Floats:
    """How far each view of a camera is from what the others predict: closed form for the views used, eq. (18).

    Args:
        posterior: What is known of the cameras.
        c: Number of the camera in it.
        points: Known positions (m, 3) in the working frame.
        seen: The camera's views, n of them.
        inliers: (n,) those that the posterior is from.

    Returns:
        (n,) squared distances in the covariance of the prediction and the noise; infinite where there is none.
    """
    residual, covariance = left_out_residuals(posterior, c, points, seen, inliers)
    inverse = np.linalg.inv(covariance)
    distance = np.einsum("ni,nij,nj->n", residual, inverse, residual)
    return np.asarray(np.where(np.isfinite(distance), distance, np.inf), dtype=np.float64)


def left_out_residuals(
    posterior: Posterior, c: int, points: Floats, seen: CameraViews, inliers: Bools
) -> tuple[Floats, Floats]:
    """How far a camera's views are from what all other views predict, in closed form, eq. (18).

    A lens is extrapolated behind the camera, to pixels that may be anything, with a spread to match. A view that is
    off by more than the picture is none of that point, whatever the spread: its covariance is that of the noise.

    Args:
        posterior: What is known of the cameras.
        c: Number of the camera in it.
        points: Known positions (m, 3) in the working frame.
        seen: The camera's views, n of them.
        inliers: (n,) those that the posterior is from.

    Returns:
        Residuals (n, 2) in pixels, and their covariances (n, 2, 2).
    """
    at = posterior_residuals(posterior, c, points, seen)
    residual, covariance = left_out_residuals_from(at, inliers)
    elsewhere = ~inliers & ~(np.linalg.norm(at.residual, axis=1) <= 2 * posterior.models[c].image.half)
    return residual, np.where(elsewhere[:, None, None], (at.sd**2)[:, None, None] * np.eye(2), covariance)


class Residuals(NamedTuple):
    """Of one camera's views: residual (n, 2) from the posterior mean, reach (n, 2, 2) its covariance, rest (n,) what
    the features leave out, sd (n,) of the noise."""

    residual: Floats
    reach: Floats
    rest: Floats
    sd: Floats


def posterior_residuals(posterior: Posterior, c: int, points: Floats, seen: CameraViews) -> Residuals:
    """What is left of all views of a camera at the posterior mean.

    Args:
        posterior: What is known of the cameras.
        c: Number of the camera in it.
        points: Known positions (n, 3) in the working frame.
        seen: What this camera saw of them.

    Returns:
        Of each view, in pixels; about the position that the posterior gives the point, where it is off.
    """
    model = posterior.models[c]
    where = points[seen.rows]
    if posterior.displacement is not None:
        where = where + posterior.displacement[seen.rows]
    n = len(where)
    residual, reach, rest = np.empty((n, 2)), np.empty((n, 2, 2)), np.empty(n)
    for part in slices(n):
        rows = model.rows(where[part])
        half = apply_covariance_root(rows, posterior.alone[c])
        residual[part], rest[part] = seen.uv[part] - rows.mean, rows.rest
        reach[part] = half @ half.swapaxes(1, 2)
    return Residuals(residual, reach, rest, model.noise * seen.relative)


def left_out_residuals_from(at: Residuals, inliers: Bools) -> tuple[Floats, Floats]:
    """As `left_out_residuals`, from what is left at the posterior mean.

    Args:
        at: Of the n views of a camera.
        inliers: (n,) the views that the posterior is from.

    Returns:
        Residuals (n, 2) in pixels, and their covariances (n, 2, 2).
    """
    smooth = at.reach / (at.sd**2)[:, None, None]
    left = np.where(inliers[:, None, None] & np.isfinite(smooth), np.eye(2) - smooth, np.eye(2))
    values, vectors = np.linalg.eigh(left)  # rounding can make a view that decides alone more than decisive
    inside = vectors / np.maximum(values, MIN_ONE_MINUS_LEVERAGE)[:, None, :] @ vectors.swapaxes(1, 2)
    residual = np.einsum("nij,nj->ni", inside, at.residual)
    extra = np.where(inliers[:, None, None], 0, at.reach)
    return residual, inside * (at.sd**2)[:, None, None] + extra + at.rest[:, None, None] * np.eye(2)


def update_inliers(
    posterior: Posterior,
    points: Floats,
    seen: tuple[CameraViews, ...],
    inliers: tuple[Bools, ...],
    limit: float,
) -> tuple[Bools, ...]:
    """The views to use next: not those that contradict the others.

    Args:
        posterior: What is known of the cameras.
        points: Known positions (n, 3) in the working frame.
        seen: Per camera, what it saw.
        inliers: Per camera, the views that the posterior is from.
        limit: Squared distance from what the others predict beyond which a view contradicts them.

    Returns:
        Per camera, which of its views to use.
    """

    def one(c: int) -> Bools:
        return next_inliers(squared_distances(posterior, c, points, seen[c], inliers[c]), inliers[c], limit)

    return tuple(side_by_side(one, range(len(seen))))


def next_inliers(distance: Floats, inliers: Bools, limit: float) -> Bools:
    """The views to use next: the far ones go, the worst tenth at a time, those that agree come back.

    Args:
        distance: (n,) squared distances from what the others predict.
        inliers: (n,) the views used until now.
        limit: Squared distance beyond which a view contradicts the others.

    Returns:
        (n,) the views to use.
    """
    worst = np.quantile(distance[inliers], 0.9) if inliers.any() else 0.0
    return np.asarray(np.where(inliers, distance <= max(limit, worst), distance <= limit), dtype=np.bool_)


class LeftOutViews(NamedTuple):
    """Per view of one camera, predicted without it: rows (n,) of the points; residual (n, 2) and covariance inverse
    (n, 2, 2); slope (n, 2, 3) by the position; variance_ratio (n,) of the prediction, in its worst direction, over the
    noise: where it is large, the point says how the camera is."""

    rows: NDArray[np.int64]
    residual: Floats
    inverse: Floats
    slope: Floats
    variance_ratio: Floats

    @property
    def squared_distance(self) -> Floats:
        """(n,) of each view from its prediction, in the covariance of this."""
        return np.asarray(np.einsum("ni,nij,nj->n", self.residual, self.inverse, self.residual), dtype=np.float64)

    @property
    def information(self) -> Floats:
        """(n, 3, 3) what each view says of the displacement of its point."""
        return np.asarray(self.slope.swapaxes(1, 2) @ self.inverse @ self.slope, dtype=np.float64)

    @property
    def pull(self) -> Floats:
        """(n, 3) the information times the displacement that each view asks for."""
        return np.asarray(np.einsum("nki,nkj,nj->ni", self.slope, self.inverse, self.residual), dtype=np.float64)


def left_out_views(
    posterior: Posterior, points: Floats, seen: tuple[CameraViews, ...], inliers: tuple[Bools, ...]
) -> list[LeftOutViews]:
    """The views of each camera, each predicted without itself.

    Args:
        posterior: What is known of the cameras.
        points: Known positions (n, 3) in the working frame.
        seen: Per camera, what it saw.
        inliers: Per camera, the views that the posterior is from.

    Returns:
        Per camera, all of its views.
    """
    where = points if posterior.displacement is None else points + posterior.displacement

    def of_camera(c: int) -> LeftOutViews:
        model, one = posterior.models[c], seen[c]
        residual, covariance = left_out_residuals(posterior, c, points, one, inliers[c])
        slope = np.empty((len(one.rows), 2, 3))
        for part in slices(len(slope)):
            slope[part] = model.predict(where[one.rows[part]])[1]
        values = np.linalg.eigvalsh(covariance) / ((model.noise * one.relative) ** 2)[:, None]
        ratio = np.where((values > 0).all(axis=1), values[:, 1], np.inf)  # negative: rounding, at a leverage of one
        inverse = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        return LeftOutViews(one.rows, residual, inverse, slope, ratio)

    return side_by_side(of_camera, range(len(seen)))


def sum_over_cameras(views: list[LeftOutViews], inliers: tuple[Bools, ...], n: int) -> tuple[Agreement, Floats]:
    """What all views in use say of the position of each point.

    Args:
        views: Per camera, predicted without themselves.
        inliers: Per camera, which of them are in use.
        n: Number of known points.

    Returns:
        What they say together of the n points, in the working frame; and the largest variance ratio (n,) of these
        views, zero for points without one.
    """
    total = Agreement(np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros(n), np.zeros(n))
    largest = np.zeros(n)
    for view, k in zip(views, inliers, strict=True):
        rows = view.rows[k]  # a camera sees a point once
        information, pull = view.information, view.pull
        total.information[rows] += information[k]
        total.pull[rows] += pull[k]
        total.squares[rows] += view.squared_distance[k]
        total.coordinates[rows] += 2
        largest[rows] = np.maximum(largest[rows], view.variance_ratio[k])
    return total, largest


def left_out_positions(views: list[LeftOutViews], inliers: tuple[Bools, ...], n: int) -> tuple[Floats, Floats]:
    """How far each known point is measured off its position by views predicted without it, eq. (18).

    Args:
        views: Per camera, predicted without themselves.
        inliers: Per camera, which of them are in use.
        n: Number of known points.

    Returns:
        Errors (n, 3) and their covariances (n, 3, 3) in the working frame; NaN where fewer than two cameras see it.
    """
    total, _ = sum_over_cameras(views, inliers, n)
    information = np.where(np.isfinite(total.information), total.information, 0.0)
    values = np.linalg.eigvalsh(information)
    good = (total.coordinates >= 4) & (values[:, 0] > MIN_INFORMATION_RATIO * values[:, 2])
    good &= np.isfinite(total.pull).all(axis=1)
    error, covariance = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    covariance[good] = np.linalg.inv(information[good])
    error[good] = np.einsum("nij,nj->ni", covariance[good], total.pull[good])
    return error, covariance


def left_out_points(fitted: FitResult, points: Floats, seen: tuple[CameraViews, ...]) -> tuple[Floats, Floats]:
    """Errors of known points, each measured without its own views: eq. (18) with all views of a point together.

    Args:
        fitted: A fit that found errors of known positions.
        points: Known positions (n, 3) in the working frame.
        seen: What each fitted camera saw.

    Returns:
        Of the m points that two cameras see: errors (m, 3) against the known positions, and their covariances
        (m, 3, 3), in which the errors of the positions are included.
    """
    errors, posterior = fitted.position_errors, fitted.posterior
    assert errors is not None
    assert errors.size is not None
    n, C = len(points), len(seen)
    residual, slope = np.zeros((n, 2 * C)), np.zeros((n, 2 * C, 3))
    noise2, half = np.ones((n, 2 * C)), np.zeros((n, 2 * C, posterior.root(0).shape[0]))
    shift = np.zeros((n, 3))
    if fitted.errors is not None and posterior.unknowns is not None:
        shift = fitted.errors.scaled @ posterior.unknowns.mean
    for c, (one, inliers) in enumerate(zip(seen, fitted.inliers, strict=True)):
        used, pair = one.select(inliers), slice(2 * c, 2 * c + 2)
        model, where = posterior.models[c], (points + shift)[used.rows]
        rows, slope[used.rows, pair] = model.rows_and_slope(where)
        residual[used.rows, pair] = used.uv - rows.mean
        noise2[used.rows, pair] = (model.noise * used.relative)[:, None] ** 2
        half[used.rows, pair] = apply_covariance_root(rows, posterior.root(c))
    own = slope @ (errors.root * errors.size[:, None, None])
    views = noise2[:, :, None] * np.eye(2 * C) + own @ own.swapaxes(1, 2)
    without = views @ np.linalg.solve(
        views - half @ half.swapaxes(1, 2), np.concatenate([views, residual[..., None]], 2)
    )
    measured = without[:, :, :-1] - own @ own.swapaxes(1, 2)  # a measurement does not know of the label's error
    weighted = np.linalg.solve(measured, slope)
    information = slope.swapaxes(1, 2) @ weighted
    good = (np.linalg.eigvalsh(information)[:, 0] > MIN_INFORMATION_RATIO * np.trace(information, axis1=1, axis2=2)) & (
        np.sum(slope.any(axis=2), axis=1) >= 4
    )
    covariance = np.linalg.inv(information[good])
    error = np.einsum("nij,nkj,nk->ni", covariance, weighted[good], without[good, :, -1])
    return error, covariance + errors.covariance
