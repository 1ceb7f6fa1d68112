"""From known points to a fitted rig: start, hyperparameters, posterior, and the views that contradict the others.

The order of docs/method.md, section "Fit".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from implicam.calibrators.forward_gp.evidence import CameraEvidence, Hyperparameters, RigEvidence
from implicam.calibrators.forward_gp.label_errors import LabelErrors
from implicam.calibrators.forward_gp.lens import Floats, Image
from implicam.calibrators.forward_gp.posterior import (
    CameraModel,
    Posterior,
    ShotErrors,
    Sightings,
    condition,
    empty_field,
    spread,
)
from implicam.calibrators.forward_gp.scatter import Scatter, condition_scattered
from implicam.calibrators.forward_gp.start import FEWEST, Started, start_again, start_camera
from implicam.errors import FitError
from implicam.progress import Progress
from implicam.threads import side_by_side

Bools = NDArray[np.bool_]

MOST = 300
"""Points of one camera that the hyperparameters are found from; more cost time and tell little more."""

MOST_UNCERTAIN = 50
"""The same where every point has an error of its own: three unknowns each."""

OUTLIER = 25.0
"""Squared distance, in its own covariance, of a view from what all others predict: one in 270,000 of good ones."""

TOLERABLE = {"central": 0.05, "none": 0.3}
"""Median error of a start, in half the extent of the pixels, beyond which it is none."""

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
    names: tuple[str, ...]
    sightings: tuple[Sightings, ...]
    images: tuple[Image, ...]
    stated: Floats
    errors: ShotErrors | None
    lens: str


@dataclass(frozen=True, eq=False)
class FittedRig:
    """cameras: numbers of those that could be fitted, in order, as posterior.models. blind: (number, why) of others.
    kept: per fitted camera (n seen,) the views used. errors: how known positions are off, where they are; label_sd
    (1, k) its estimated sds, for error bars. label_errors: how single known positions are off besides, if they are;
    untold_sd (6,): how planes may be off that are too few to tell."""

    posterior: Posterior
    cameras: tuple[int, ...]
    blind: tuple[tuple[int, str], ...]
    kept: tuple[Bools, ...]
    hyperparameters: Hyperparameters
    errors: ShotErrors | None
    label_sd: Floats | None
    label_errors: LabelErrors | None = None
    untold_sd: Floats | None = None


def fit_rig(problem: Problem, progress: Progress, before: FittedRig | None = None) -> FittedRig:
    """Fit every camera that can be fitted. before: a fit in the same working frame to most of these points, from a
    moment ago: its cameras and hyperparameters are the guess. Where known positions have declared errors, which make
    hyperparameters costly, they are kept."""
    progress("fitting", 0, 3)
    guess = {} if before is None else dict(zip(before.cameras, before.posterior.models, strict=True))

    def start(c: int, points: Floats, uv: Floats) -> Started:
        if c in guess:
            return start_again(guess[c].camera, points, uv, problem.images[c], problem.lens)
        return start_camera(points, uv, problem.images[c], problem.lens)

    started, blind = start_rig(problem, start)
    cameras = tuple(started)
    seen = tuple(problem.sightings[c] for c in cameras)
    images = tuple(problem.images[c] for c in cameras)
    kept = tuple(started[c].kept for c in cameras)
    models = tuple(without_field(started[c], image) for c, image in zip(cameras, images, strict=True))
    progress("fitting", 1, 3)
    stated = problem.stated[list(cameras)]
    rounds = ROUNDS_WITH_SHOTS if problem.errors is not None and problem.errors.estimated else ROUNDS
    hyper = before.hyperparameters if before is not None and before.cameras == cameras else None
    tied = problem.errors is not None and not problem.errors.estimated
    state = _Round(hyper, models, None, kept, problem.errors, None, settled=False, fixed=hyper if tied else None)
    for number in range(rounds):
        state = _round(problem, state, seen, images, stated)
        judged = state.kept
        if state.settled or number >= rounds // 2:  # earlier it is too soon to say what contradicts the others
            judged = judged_all(state.posterior, problem.points, seen, state.kept)
        if state.settled and all((j == k).all() for j, k in zip(judged, state.kept, strict=True)):
            break
        progress("fitting", 2, 3)
        if number < rounds - 1:  # the last round's views stay those of its posterior
            state = state._replace(kept=judged)
    progress("fitting", 3, 3)
    assert state.hyper is not None
    return FittedRig(state.posterior, cameras, tuple(blind), state.kept, state.hyper, state.errors, state.label_sd)


class _Round(NamedTuple):
    """What a round of the fit hands to the next; errors: those of its posterior, next_errors: more probable ones;
    fixed: hyperparameters that are kept."""

    hyper: Hyperparameters | None
    models: tuple[CameraModel, ...]
    found: Posterior | None
    kept: tuple[Bools, ...]
    next_errors: ShotErrors | None
    label_sd: Floats | None
    settled: bool
    errors: ShotErrors | None = None
    fixed: Hyperparameters | None = None

    @property
    def posterior(self) -> Posterior:
        assert self.found is not None
        return self.found


def _round(
    problem: Problem, last: _Round, seen: tuple[Sightings, ...], images: tuple[Image, ...], stated: Floats
) -> _Round:
    """Sizes, posterior, and how far the shots are off."""
    kept = tuple(
        k & np.isfinite(m.camera.pixel(problem.points[s.rows])).all(axis=1)  # a camera can turn its back on a point
        for k, m, s in zip(last.kept, last.models, seen, strict=True)
    )
    used = tuple(s.select(k) for s, k in zip(seen, kept, strict=True))
    moved = None if last.found is None or last.found.unknowns is None else last.found.displacement
    hyper = last.fixed or _hyperparameters(problem, last.models, used, images, stated, last.hyper, moved)
    errors = last.next_errors
    posterior = _conditioned(problem, last.models, used, hyper, errors)
    following, label_sd, settled = errors, None, True
    if errors is not None and posterior.unknowns is not None:
        mean, variance = posterior.unknowns.mean, np.diag(posterior.unknowns.covariance)
        following, label_sd = errors.updated(mean.reshape(errors.sd.shape), variance.reshape(errors.sd.shape))
        settled = bool(np.allclose(following.sd, errors.sd, rtol=SETTLED))
    return _Round(hyper, posterior.models, posterior, kept, following, label_sd, settled, errors, last.fixed)


def without_field(started: Started, image: Image, noise: float = 1.0) -> CameraModel:
    """A camera model that is nothing but the camera; noise in pixels."""
    field = empty_field(np.ones(2), np.zeros((1, 3)), 1.0)
    return CameraModel(started.camera, started.camera, started.prior, image, field, 0.0, noise, np.zeros((1, 2)))


def start_rig(
    problem: Problem, start: Callable[[int, Floats, Floats], Started]
) -> tuple[dict[int, Started], list[tuple[int, str]]]:
    """Each camera that `start` can place from its number, known points (n, 3) and pixels, and why it cannot the others.

    FitError where fewer than two can be placed.
    """

    def one(c: int) -> Started | FitError:
        seen = problem.sightings[c]
        try:
            started = start(c, problem.points[seen.rows], seen.uv)
            _check_start(started, problem.points[seen.rows], seen.uv, problem)
            return started
        except FitError as error:
            return error

    started, blind = {}, []
    for c, found in enumerate(side_by_side(one, range(len(problem.sightings)))):
        if isinstance(found, FitError):
            blind.append((c, found.what))
        else:
            started[c] = found
    if len(started) < 2:
        raise FitError(
            f"{len(started)} of {len(problem.names)} cameras can be calibrated; a position takes two.",
            why="; ".join(f"{problem.names[c]}: {why}" for c, why in blind) or "there is one camera",
            fix="show the cameras more known points, in the whole volume",
        )
    return started, blind


def _check_start(started: Started, points: Floats, uv: Floats, problem: Problem) -> None:
    error = np.linalg.norm(started.camera.pixel(points) - uv, axis=1)[started.kept]
    half = float(np.ptp(uv, axis=0).max()) / 2
    if len(error) < FEWEST:
        raise FitError(
            f"{len(error)} of its {len(uv)} views agree on one camera, and it takes {FEWEST}.",
            fix="add known points, or look for wrong detections",
        )
    if not np.median(error) < TOLERABLE[problem.lens] * half:
        raise FitError(
            f"no camera sees the known points at these pixels: the best of all fits leaves {np.median(error):.3g} px."
        )


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
    rig = RigEvidence(evidence, half, stated, problem.lens, TOLERANCE[problem.lens])
    found = rig.maximise(before)
    if problem.errors is None or problem.errors.estimated:
        return found
    return _joint_sizes(problem, models, used, found, rig)


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
    """The posterior with fields laid out anew."""
    return settle(_sized(problem, models, used, hyper), problem.points, used, errors)


def settle(
    models: tuple[CameraModel, ...],
    points: Floats,
    used: tuple[Sightings, ...],
    errors: ShotErrors | None,
    scatter: Scatter | None = None,
) -> Posterior:
    """The posterior, linearised where it ends: Gauss-Newton for the lens, exact for the field."""
    for _ in range(4):
        if scatter is None:
            posterior = condition(models, points, used, errors)
        else:
            posterior = condition_scattered(models, points, used, errors, scatter)
        models = tuple(
            _in_front(before, after, step, points[seen.rows])
            for before, after, step, seen in zip(models, posterior.models, posterior.steps, used, strict=True)
        )
        if all(_small(step, posterior.root(c)) for c, step in enumerate(posterior.steps)):
            break
    return replace(posterior, models=models)


def _sized(
    problem: Problem, models: tuple[CameraModel, ...], used: tuple[Sightings, ...], hyper: Hyperparameters
) -> tuple[CameraModel, ...]:
    """The cameras with fields laid out anew."""

    def one(c: int) -> CameraModel:
        model = models[c]
        points = problem.points[used[c].rows]
        view = model.camera.view(points[:: max(1, len(points) // 4000)])
        field = empty_field(hyper.lengthscale, model.coordinates(view), TOLERANCE[problem.lens])
        return replace(
            model,
            ruler=model.camera,
            field=field,
            signal=float(hyper.signal[c]),
            noise=float(hyper.noise[c]),
            weights=np.zeros((len(field.inducing), 2)),
        )

    return tuple(one(c) for c in range(len(models)))


def _joint_sizes(
    problem: Problem,
    models: tuple[CameraModel, ...],
    used: tuple[Sightings, ...],
    hyper: Hyperparameters,
    rig: RigEvidence,
) -> Hyperparameters:
    """Signal and noise from all cameras at once, where positions have errors of their own.

    One camera cannot tell the error of a position from its own noise; together they can, for all see the same error.
    """
    points = np.unique(np.concatenate([seen.rows for seen in used]))
    if len(points) > MOST:
        points = np.random.default_rng(0).choice(points, MOST, replace=False)
    some = tuple(seen.select(np.isin(seen.rows, points)) for seen in used)
    laid_out = _sized(problem, models, some, hyper)

    def loss(z: Floats) -> float:
        signal, noise = np.exp(z)
        sized = tuple(replace(m, signal=m.signal * signal, noise=m.noise * noise) for m in laid_out)
        evidence = condition(sized, problem.points, some, problem.errors).evidence
        return rig.penalty(hyper.signal * signal, hyper.noise * noise) - evidence

    first = min((np.array([0.0, noise]) for noise in (0.0, 1.0, 2.0)), key=loss)
    simplex = first + np.array([[0, 0], [0.4, 0], [0, 0.4]])
    options = {"initial_simplex": simplex, "xatol": 0.05, "fatol": 0.05, "maxfev": 24}
    z = minimize(loss, first, method="Nelder-Mead", options=options).x
    curvature = np.empty(2)
    for axis, h in enumerate(0.2 * np.eye(2)):
        curvature[axis] = (loss(z + h) - 2 * loss(z) + loss(z - h)) / 0.2**2
    signal, noise = np.exp(z + 1 / np.maximum(curvature, 1.0))  # the mean variance, eq. (12)
    return Hyperparameters(hyper.lengthscale, hyper.signal * signal, hyper.noise * noise)


def _in_front(before: CameraModel, after: CameraModel, step: Floats, points: Floats) -> CameraModel:
    """A camera never steps so far that it loses a point it saw: half the step, then, or half of that."""
    for halvings in range(20):
        camera = after.camera if halvings == 0 else before.camera.moved(step * 0.5**halvings)
        if camera.sane and np.isfinite(camera.pixel(points)).all():
            return after if halvings == 0 else replace(after, camera=camera)
    return before


def _small(step: Floats, root: Floats) -> bool:
    sd = np.sqrt(np.sum(root[:, : len(step)] ** 2, axis=0))
    return bool(np.all(np.abs(step) <= 0.02 * sd))


def squared_distances(posterior: Posterior, c: int, points: Floats, seen: Sightings, kept: Bools) -> Floats:
    """(n,) how far each view is from what the others predict: closed form for the views used, eq. (18)."""
    residual, covariance = left_out(posterior, c, points, seen, kept)
    inverse = np.linalg.inv(covariance)
    distance = np.einsum("ni,nij,nj->n", residual, inverse, residual)
    return np.asarray(np.where(np.isfinite(distance), distance, np.inf), dtype=np.float64)


def left_out(posterior: Posterior, c: int, points: Floats, seen: Sightings, kept: Bools) -> tuple[Floats, Floats]:
    """Residuals (n, 2) of camera c's views from the prediction without them, and their covariance (n, 2, 2), px."""
    model = posterior.models[c]
    sd = model.noise * seen.relative
    where = points[seen.rows]
    if posterior.displacement is not None:
        where = where + posterior.displacement[seen.rows]
    rows = model.rows(where)
    half = spread(rows, posterior.alone[c])
    reach = half @ half.swapaxes(1, 2)
    residual = seen.uv - rows.mean
    smooth = reach / (sd**2)[:, None, None]
    inside = np.linalg.inv(np.where(kept[:, None, None], np.eye(2) - smooth, np.eye(2)))
    residual = np.einsum("nij,nj->ni", inside, residual)
    extra = np.where(kept[:, None, None], 0, reach)
    return residual, inside * (sd**2)[:, None, None] + extra + rows.rest[:, None, None] * np.eye(2)


def judged_all(
    posterior: Posterior, points: Floats, seen: tuple[Sightings, ...], kept: tuple[Bools, ...]
) -> tuple[Bools, ...]:
    """Per camera, the views to use next: not those that contradict the others."""

    def one(c: int) -> Bools:
        return _judged(squared_distances(posterior, c, points, seen[c], kept[c]), kept[c])

    return tuple(side_by_side(one, range(len(seen))))


def _judged(distance: Floats, kept: Bools) -> Bools:
    """The views to use next: the far ones go, the worst tenth at a time, those that agree come back."""
    worst = np.quantile(distance[kept], 0.9) if kept.any() else 0.0
    return np.asarray(np.where(kept, distance <= max(OUTLIER, worst), distance <= OUTLIER), dtype=np.bool_)
