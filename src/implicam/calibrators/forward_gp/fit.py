"""From known points to a fitted rig: start, hyperparameters, posterior, and the views that contradict the others.

The order of docs/method.md, section "Fit".
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.evidence import CameraEvidence, Hyperparameters, RigEvidence
from implicam.calibrators.forward_gp.lens import Floats, Image
from implicam.calibrators.forward_gp.posterior import (
    CameraModel,
    Posterior,
    ShotErrors,
    Sightings,
    condition,
    empty_field,
)
from implicam.calibrators.forward_gp.start import Started, start_camera
from implicam.errors import FitError
from implicam.progress import Progress
from implicam.threads import side_by_side

Bools = NDArray[np.bool_]

MOST = 300
"""Points of one camera that the hyperparameters are found from; more cost time and tell little more."""

MOST_UNCERTAIN = 120
"""The same where every point has an error of its own: three unknowns each."""

OUTLIER = 25.0
"""Squared distance, in its own covariance, of a view from what all others predict: one in 270,000 of good ones."""

TOLERANCE = {"central": 1e-6, "none": 1e-9}
"""Part of the field's variance that its features may leave out; without a lens model the field is large."""

ROUNDS, ROUNDS_WITH_SHOTS = 6, 18
SETTLED = 0.1
"""Relative change of the shots' errors between two rounds below which they are found."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Known points (n, 3) in the working frame; per camera what it saw (all of it), its image, and its stated noise in
    pixels or NaN; how the points may be off; lens: "central" or "none"."""

    points: Floats
    sightings: tuple[Sightings, ...]
    images: tuple[Image, ...]
    stated: Floats
    errors: ShotErrors | None
    lens: str


@dataclass(frozen=True, eq=False)
class FittedRig:
    """cameras: numbers of those that could be fitted, in order, as posterior.models. blind: (number, why) of others.
    kept: per fitted camera (n seen,) the views used. errors: how known positions are off, where they are; label_sd
    (1, k) its estimated sds, for error bars."""

    posterior: Posterior
    cameras: tuple[int, ...]
    blind: tuple[tuple[int, str], ...]
    kept: tuple[Bools, ...]
    hyperparameters: Hyperparameters
    errors: ShotErrors | None
    label_sd: Floats | None


def fit_rig(problem: Problem, progress: Progress) -> FittedRig:
    """Fit every camera that can be fitted."""
    progress("fitting", 0, 3)
    started, blind = _start(problem)
    cameras = tuple(started)
    seen = tuple(problem.sightings[c] for c in cameras)
    images = tuple(problem.images[c] for c in cameras)
    kept = tuple(started[c].kept for c in cameras)
    models = tuple(
        CameraModel(
            started[c].camera,
            started[c].prior,
            image,
            empty_field(np.ones(2), np.zeros((1, 3)), 1.0),
            0.0,
            1.0,
            np.zeros((1, 2)),
        )
        for c, image in zip(cameras, images, strict=True)
    )
    progress("fitting", 1, 3)
    stated = problem.stated[list(cameras)]
    hyper: Hyperparameters | None = None
    errors, moved, label_sd = problem.errors, None, None
    estimated = errors is not None and errors.estimated
    for _ in range(ROUNDS_WITH_SHOTS if estimated else ROUNDS):
        used = tuple(s.select(k) for s, k in zip(seen, kept, strict=True))
        hyper = _hyperparameters(problem, models, used, images, stated, hyper, moved)
        posterior = _conditioned(problem, models, used, hyper, errors)
        models = posterior.models
        if errors is not None and posterior.unknowns is not None:
            before, moved = errors.sd, posterior.displacement
            mean, variance = posterior.unknowns.mean, np.diag(posterior.unknowns.covariance)
            errors, label_sd = errors.updated(mean.reshape(before.shape), variance.reshape(before.shape))
            if not np.allclose(errors.sd, before, rtol=SETTLED):  # too early to say what contradicts the others
                continue
        judged = _judged_all(posterior, problem.points, seen, kept)
        if all((j == k).all() for j, k in zip(judged, kept, strict=True)):
            break
        kept = judged
    progress("fitting", 3, 3)
    assert hyper is not None
    return FittedRig(posterior, cameras, tuple(blind), kept, hyper, errors, label_sd)


def _start(problem: Problem) -> tuple[dict[int, Started], list[tuple[int, str]]]:
    def one(c: int) -> Started | FitError:
        seen = problem.sightings[c]
        try:
            return start_camera(problem.points[seen.rows], seen.uv, problem.images[c], problem.lens)
        except FitError as error:
            return error

    started, blind = {}, []
    for c, found in enumerate(side_by_side(one, range(len(problem.sightings)))):
        if isinstance(found, FitError):
            blind.append((c, found.what))
        else:
            started[c] = found
    return started, blind


def _hyperparameters(
    problem: Problem,
    models: tuple[CameraModel, ...],
    used: tuple[Sightings, ...],
    images: tuple[Image, ...],
    stated: Floats,
    before: Hyperparameters | None,
    moved: Floats | None,
) -> Hyperparameters:
    evidence = [_evidence(problem, model, seen, moved) for model, seen in zip(models, used, strict=True)]
    half = np.array([image.half for image in images])
    return RigEvidence(evidence, half, stated, problem.lens, TOLERANCE[problem.lens]).maximise(before)


def _evidence(problem: Problem, model: CameraModel, seen: Sightings, moved: Floats | None) -> CameraEvidence:
    """One camera's evidence. The error of a shot of many points is known well, so the points are where it says
    (`moved`); that of a single point is not, and is one more unknown of the camera."""
    errors = problem.errors if problem.errors is not None and not problem.errors.estimated else None
    seen = _thinned(seen, MOST if errors is None or errors.count <= MOST_UNCERTAIN else MOST_UNCERTAIN)
    points = problem.points if moved is None else problem.points + moved
    view = model.camera.view(points[seen.rows])
    X, off, prior = view.by_parameters, model.prior.mean - model.camera.parameters, model.prior
    if errors is not None:
        B = view.by_point @ errors.scaled[seen.rows]  # (n, 2, k)
        shots, number = np.unique(errors.shot[seen.rows], return_inverse=True)
        k = B.shape[2]
        wide = np.zeros((len(B), 2, len(shots), k))
        wide[np.arange(len(B)), :, number] = B
        X = np.concatenate([X, wide.reshape(len(B), 2, -1)], axis=2)
        extra = k * len(shots)
        off = np.concatenate([off, np.zeros(extra)])
        precision = np.eye(len(off))
        precision[:-extra, :-extra] = prior.precision
        prior = prior._replace(mean=off, precision=precision)
    return CameraEvidence(seen.uv - view.uv, X, off, prior, model.coordinates(view), seen.relative)


def _thinned(seen: Sightings, most: int) -> Sightings:
    if len(seen.rows) <= most:
        return seen
    keep = np.zeros(len(seen.rows), dtype=np.bool_)
    keep[np.random.default_rng(0).choice(len(keep), most, replace=False)] = True
    return seen.select(keep)


def _conditioned(
    problem: Problem,
    models: tuple[CameraModel, ...],
    used: tuple[Sightings, ...],
    hyper: Hyperparameters,
    errors: ShotErrors | None,
) -> Posterior:
    """The posterior, linearised where it ends: Gauss-Newton for the lens, exact for the field."""
    tolerance = TOLERANCE[problem.lens]

    def sized(c: int) -> CameraModel:
        model = models[c]
        points = problem.points[used[c].rows]
        view = model.camera.view(points[:: max(1, len(points) // 4000)])
        field = empty_field(hyper.lengthscale, model.coordinates(view), tolerance)
        return replace(
            model,
            field=field,
            signal=float(hyper.signal[c]),
            noise=float(hyper.noise[c]),
            weights=np.zeros((len(field.inducing), 2)),
        )

    models = tuple(sized(c) for c in range(len(models)))
    for _ in range(4):
        posterior = condition(models, problem.points, used, errors)
        models = posterior.models
        if all(_small(step, cov) for step, cov in zip(posterior.steps, posterior.covariances, strict=True)):
            break
    return posterior


def _small(step: Floats, covariance: Floats) -> bool:
    return bool(np.all(np.abs(step) <= 0.02 * np.sqrt(np.diag(covariance)[: len(step)])))


def squared_distances(posterior: Posterior, c: int, points: Floats, seen: Sightings, kept: Bools) -> Floats:
    """(n,) how far each view is from what the others predict: closed form for the views used, eq. (18)."""
    residual, spread = left_out(posterior, c, points, seen, kept)
    inverse = np.linalg.inv(spread)
    distance = np.einsum("ni,nij,nj->n", residual, inverse, residual)
    return np.asarray(np.where(np.isfinite(distance), distance, np.inf), dtype=np.float64)


def left_out(posterior: Posterior, c: int, points: Floats, seen: Sightings, kept: Bools) -> tuple[Floats, Floats]:
    """Residuals (n, 2) of camera c's views from the prediction without them, and their covariance (n, 2, 2), px."""
    model, covariance = posterior.models[c], posterior.alone[c]
    sd = model.noise * seen.relative
    where = points[seen.rows]
    if posterior.displacement is not None:
        where = where + posterior.displacement[seen.rows]
    rows = model.rows(where)
    reach = projected(rows.J, rows.phi, covariance)
    residual = seen.uv - rows.mean
    smooth = reach / (sd**2)[:, None, None]
    inside = np.linalg.inv(np.where(kept[:, None, None], np.eye(2) - smooth, np.eye(2)))
    residual = np.einsum("nij,nj->ni", inside, residual)
    extra = np.where(kept[:, None, None], 0, reach)
    return residual, inside * (sd**2)[:, None, None] + extra + rows.rest[:, None, None] * np.eye(2)


def projected(J: Floats, phi: Floats, covariance: Floats) -> Floats:
    """(n, 2, 2) covariance of the mean pixels from that of a camera's unknowns."""
    p, m = J.shape[2], phi.shape[1]
    out = np.empty((len(J), 2, 2))
    half = [J[:, i] @ covariance[:p] + phi @ covariance[p + i * m : p + (i + 1) * m] for i in range(2)]
    for i in range(2):
        for j in range(2):
            out[:, i, j] = np.sum(half[i][:, :p] * J[:, j], axis=1)
            out[:, i, j] += np.sum(half[i][:, p + j * m : p + (j + 1) * m] * phi, axis=1)
    return out


def _judged_all(
    posterior: Posterior, points: Floats, seen: tuple[Sightings, ...], kept: tuple[Bools, ...]
) -> tuple[Bools, ...]:
    def one(c: int) -> Bools:
        return _judged(squared_distances(posterior, c, points, seen[c], kept[c]), kept[c])

    return tuple(side_by_side(one, range(len(seen))))


def _judged(distance: Floats, kept: Bools) -> Bools:
    """The views to use next: the far ones go, the worst tenth at a time, those that agree come back."""
    worst = np.quantile(distance[kept], 0.9) if kept.any() else 0.0
    return np.asarray(np.where(kept, distance <= max(OUTLIER, worst), distance <= OUTLIER), dtype=np.bool_)
