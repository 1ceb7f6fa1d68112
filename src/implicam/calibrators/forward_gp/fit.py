"""From known points to a fitted rig: start, hyperparameters, posterior, and the views that contradict the others.

The order of docs/method.md, section "Fit".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from implicam.calibrators.forward_gp.choose_camera import (
    Candidate,
    Scene,
    as_started,
    candidate_again,
    candidates,
    choose,
)
from implicam.calibrators.forward_gp.evidence import CameraEvidence, Hyperparameters, RigEvidence
from implicam.calibrators.forward_gp.general_camera import AnyCamera
from implicam.calibrators.forward_gp.heavy_tails import (
    DEGREES,
    MOST_VIEWS,
    Tails,
    degrees_of_agreement,
    looks_heavy,
    outlier_distance,
    weights_of,
    whitened,
)
from implicam.calibrators.forward_gp.label_errors import LabelErrors
from implicam.calibrators.forward_gp.leave_one_out import (
    OUTLIER,
    Bools,
    judged_all,
    left_out,
    left_out_from,
    left_out_positions,
    next_inliers,
    residuals_of,
)
from implicam.calibrators.forward_gp.lens import Floats, Image, Prior, ProjectiveCamera
from implicam.calibrators.forward_gp.posterior import (
    CameraFailedError,
    CameraModel,
    DepthScale,
    Posterior,
    ShotErrors,
    Sightings,
    condition,
    empty_field,
    field_coordinates,
)
from implicam.calibrators.forward_gp.scatter import Scatter, condition_scattered
from implicam.calibrators.forward_gp.start import FEWEST, Started, pixel_extent, start_again, start_camera
from implicam.calibrators.forward_gp.wrong_views import Linear
from implicam.errors import FitError
from implicam.progress import Progress, silent
from implicam.row_order import what_is_wrong
from implicam.threads import side_by_side

MOST = 300
"""Points of one camera that the hyperparameters are found from; more cost time and tell little more."""

MOST_UNCERTAIN = 50
"""The same where every point has an error of its own: three unknowns each."""

ENOUGH_VIEWS = 12
"""Views of a camera that are too many to call too few the reason why nothing fits them."""

TOLERABLE = {"central": 0.05, "general": 0.05, "none": 0.3}
"""Median error of a start, in half the extent of the pixels, beyond which it is none."""

TOLERANCE = {"central": 1e-6, "general": 1e-6, "none": 1e-9}
"""Part of the field's variance that its features may leave out; without a lens model the field is large."""

MAX_SETTLING_STEPS = 15
"""Gauss-Newton steps of the cameras; ordinary ones take one to four."""

MAX_MISFIT_VIEWS = 1000
"""Views that say whether a step is for the better."""

MISFIT_TOLERANCE = 1e-3
"""By how much a step may worsen minus twice the log posterior: rounding and what is left out of the views."""

FAR_OFF = 4.0
"""Median error of a fitted camera at its own views, in its noise, beyond which the fit has failed."""

FEWEST_WITHOUT_LENS = 40
"""Views that a camera without a lens model takes: its field must learn what a lens would say."""

LARGE_FIELD = 3e-3
"""A field's sd, in half the longer side, that makes an ordinary camera doubtful: 2 px in 1280."""

CLEAR_NATS = 3.0
"""By how much left-out views must at least be more probable without a lens model."""

MAX_SQUARES = 20.0
"""Squared errors of known points, in their median, beyond which more does not count when fits are compared."""

AUTO = "auto"
"""The kind of each camera is chosen by the data."""

ROUNDS, ROUNDS_WITH_SHOTS = 6, 18
SEARCHED, FEW_CHANGED = 2, 0.01
"""Of these, those that look for lengthscales in any case, where known positions are exact; and the part of the views
which, when they change later, tell nothing new of how smooth a field is."""

REWEIGHTED = 3
"""Rounds more where the noise has heavy tails."""

SETTLED = 0.1
"""Relative change of the shots' errors between two rounds below which they are found."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Known points (n, 3) in the working frame; per camera what it saw (all of it), its image, and its stated noise in
    pixels or NaN; how the points may be off; lens: "auto", "central" or "none"."""

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
    (1, k) its estimated sds, for error bars. tails: of the pixel noise, where it is not normal. label_errors: how
    single known positions are off besides, if they are; untold_sd (6,): how planes may be off that are too few to tell.
    ordinary_px: per fitted camera, see `Started`."""

    posterior: Posterior
    cameras: tuple[int, ...]
    blind: tuple[tuple[int, str], ...]
    kept: tuple[Bools, ...]
    hyperparameters: Hyperparameters
    errors: ShotErrors | None
    label_sd: Floats | None
    tails: Tails | None = None
    label_errors: LabelErrors | None = None
    untold_sd: Floats | None = None
    ordinary_px: tuple[float, ...] = ()

    def left_by_ordinary(self, number: int) -> float:
        """The median error, px, that an ordinary camera would leave in fitted camera `number`; NaN if it is one."""
        return self.ordinary_px[number] if self.ordinary_px else float("nan")


def fit_rig(problem: Problem, progress: Progress, before: FittedRig | None = None) -> FittedRig:
    """Fit every camera that can be fitted. before: a fit in the same working frame to most of these points, from a
    moment ago: its cameras and hyperparameters are the guess. Where known positions have declared errors, which make
    hyperparameters costly, they are kept."""
    progress("fitting", 0, 3)
    started, blind = _started(problem, before)
    fitted = _fit_without_failures(problem, progress, before, started, blind)
    return _with_projections(problem, fitted, started) if problem.lens == AUTO else fitted


def _fit_without_failures(
    problem: Problem,
    progress: Progress,
    before: FittedRig | None,
    started: dict[int, Started],
    blind: list[tuple[int, str]],
) -> FittedRig:
    """One bad camera never takes the rig down: it goes on without a lens model, or is left out. Changes `started` and
    `blind`."""
    while True:
        try:
            return _fit_started(problem, progress, before, started, blind)
        except CameraFailedError as error:
            failed = list(started)[error.number]
            again = None
            if problem.lens == AUTO and started[failed].family != "none":
                again = _without_lens(problem, failed)
            if again is not None:
                started[failed] = again._replace(ordinary_px=started[failed].ordinary_px)
                continue
            blind.append((failed, f"no camera model fits its views: {error}."))
            del started[failed]
            _require_two(problem, started, blind)


def _without_lens(problem: Problem, c: int) -> Started | None:
    """Camera c as a linear projection with a field; None where it saw too little for one."""
    seen = problem.sightings[c]
    if len(seen.rows) < FEWEST_WITHOUT_LENS:
        return None
    try:
        found = start_camera(problem.points[seen.rows], seen.uv, problem.images[c], "none")
        _check_start(found, problem.points[seen.rows], seen.uv, problem)
    except FitError:
        return None
    return found


def _with_projections(problem: Problem, fitted: FittedRig, started: dict[int, Started]) -> FittedRig:
    """The rig with those cameras as linear projections that clearly predict left-out views better so."""
    tried = {}
    for number, c in enumerate(fitted.cameras):
        model = fitted.posterior.models[number]
        odd = model.family in ("free", "crop") or model.signal > LARGE_FIELD * model.image.half
        if odd and model.family != "none" and c in started:
            found = _without_lens(problem, c)
            if found is not None:
                tried[c] = found._replace(ordinary_px=started[c].ordinary_px)
    if not tried:
        return fitted
    blind = list(fitted.blind)
    try:
        other = _fit_started(problem, silent, None, {c: tried.get(c, started[c]) for c in fitted.cameras}, blind)
    except np.linalg.LinAlgError:
        return fitted
    if _measures_better(problem, other, fitted):
        return other
    better = {
        c for number, c in enumerate(fitted.cameras) if c in tried and _predicts_better(problem, other, fitted, number)
    }
    if better == set(tried) or not better:
        return other if better else fitted
    mixed = {c: tried[c] if c in better else started[c] for c in fitted.cameras}
    try:
        return _fit_started(problem, silent, None, mixed, blind)
    except np.linalg.LinAlgError:
        return fitted


def _predicts_better(problem: Problem, one: FittedRig, other: FittedRig, number: int) -> bool:
    """Whether a camera's left-out views are clearly more probable in one fit than in another."""
    gain = _left_out_log_densities(problem, one, number) - _left_out_log_densities(problem, other, number)
    clearly = 2 * float(np.std(gain)) * np.sqrt(len(gain))
    return bool(np.sum(gain) > max(clearly, CLEAR_NATS))


def _measures_better(problem: Problem, one: FittedRig, other: FittedRig) -> bool:
    """Whether known points, measured without themselves, are clearly nearer to their positions in one fit than in
    another. A view of a steep camera says little of depth, so its density is not all that counts."""
    squares = []
    for fitted in (one, other):
        seen = tuple(problem.sightings[c] for c in fitted.cameras)
        error = left_out_positions(fitted.posterior, problem.points, seen, fitted.kept)
        squares.append(np.sum(error**2, axis=1))
    one_squares, other_squares = np.array(squares)[:, np.isfinite(squares).all(axis=0)]
    if len(one_squares) < FEWEST_WITHOUT_LENS:
        return False
    limit = MAX_SQUARES * float(np.median(other_squares))  # a wrong point says nothing of either
    gain = np.minimum(other_squares, limit) - np.minimum(one_squares, limit)
    return bool(np.sum(gain) > 2 * float(np.std(gain)) * np.sqrt(len(gain)))


def _left_out_log_densities(problem: Problem, fitted: FittedRig, number: int) -> Floats:
    """(n,) of each view of a camera, predicted from all others; a wrong view costs what a view just rejected does."""
    seen, kept = problem.sightings[fitted.cameras[number]], fitted.kept[number]
    residual, covariance = left_out(fitted.posterior, number, problem.points, seen, kept)
    distance = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(covariance), residual)
    distance = np.where(np.isfinite(distance), distance, OUTLIER)
    return np.asarray(-0.5 * np.minimum(distance, OUTLIER) - 0.5 * np.linalg.slogdet(covariance)[1], dtype=np.float64)


def _check_fitted(problem: Problem, state: _Round, seen: tuple[Sightings, ...]) -> None:
    """A camera that ends far off its own known points is no camera, whatever its covariance says."""
    points = problem.points
    if state.posterior.displacement is not None:
        points = points + state.posterior.displacement
    for number, (model, views, kept) in enumerate(zip(state.posterior.models, seen, state.kept, strict=True)):
        rows = views.rows[kept]
        error = np.linalg.norm(model.predict(points[rows])[0] - views.uv[kept], axis=1) / views.relative[kept]
        if len(rows) < FEWEST or not np.median(error) < FAR_OFF * model.noise:
            off = float(np.median(error)) if len(rows) else np.nan
            raise CameraFailedError(number, f"it ends {off:.3g} px off its own known points")


def _started(problem: Problem, before: FittedRig | None) -> tuple[dict[int, Started], list[tuple[int, str]]]:
    guess = {} if before is None else dict(zip(before.cameras, before.posterior.models, strict=True))
    if problem.lens == AUTO:
        return choose_cameras(problem, guess)

    def start(c: int, points: Floats, uv: Floats) -> Started:
        if c in guess:
            return start_again(guess[c].camera, points, uv, problem.images[c], problem.lens)
        return start_camera(points, uv, problem.images[c], problem.lens)

    return start_rig(problem, start)


def choose_cameras(
    problem: Problem, guess: Mapping[int, CameraModel]
) -> tuple[dict[int, Started], list[tuple[int, str]]]:
    """The kind of each camera, and where it starts; guess: cameras that fitted most of the points a moment ago."""

    def scene(c: int) -> Scene:
        seen = problem.sightings[c]
        return Scene(problem.points[seen.rows], seen.uv, seen.relative, problem.images[c], float(problem.stated[c]))

    def look(c: int) -> list[Candidate] | FitError:
        try:
            known = candidate_again(scene(c), guess[c].camera, guess[c].family) if c in guess else None
            return [known] if known is not None else candidates(scene(c))
        except FitError as error:
            return error
        except np.linalg.LinAlgError as error:
            return FitError(f"its equations have no solution: {error}.")

    found = side_by_side(look, range(len(problem.sightings)))
    seeing = [c for c, some in enumerate(found) if not isinstance(some, FitError)]
    chosen = dict(zip(seeing, choose([some for some in found if not isinstance(some, FitError)]), strict=True))

    def start(c: int, points: Floats, uv: Floats) -> Started:
        some = found[c]
        if isinstance(some, FitError):
            raise some
        return as_started(chosen[c], scene(c), some)

    return start_rig(problem, start)


def _fit_started(
    problem: Problem,
    progress: Progress,
    before: FittedRig | None,
    started: dict[int, Started],
    blind: list[tuple[int, str]],
) -> FittedRig:
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
    changed = 1.0  # part of the views
    for number in range(rounds):
        search = number < SEARCHED or changed > FEW_CHANGED
        state = _round(problem, state, seen, images, stated, search=search)
        judged = state.kept
        if state.settled or number >= rounds // 2:  # earlier it is too soon to say what contradicts the others
            judged = judged_all(state.posterior, problem.points, seen, state.kept)
        changed = float(np.mean(np.concatenate(judged) != np.concatenate(state.kept)))
        if state.settled and not changed:
            break
        progress("fitting", 2, 3)
        if number < rounds - 1:  # the last round's views stay those of its posterior
            state = state._replace(kept=judged)
    progress("fitting", 3, 3)
    assert state.hyper is not None
    _check_fitted(problem, state, seen)
    ordinary_px = tuple(one.ordinary_px for one in started.values())
    return FittedRig(
        state.posterior,
        cameras,
        tuple(blind),
        state.kept,
        state.hyper,
        state.errors,
        state.label_sd,
        ordinary_px=ordinary_px,
    )


def with_heavy_tails(problem: Problem, fitted: FittedRig) -> FittedRig:
    """After a few rounds more with views weighted by a t, where the noise of the fit clearly is one; else the same."""
    cameras = fitted.cameras
    seen, images = tuple(problem.sightings[c] for c in cameras), tuple(problem.images[c] for c in cameras)
    stated, hyper, errors = problem.stated[list(cameras)], fitted.hyperparameters, fitted.errors
    fixed = hyper if errors is not None and not errors.estimated else None
    state = _Round(
        hyper,
        fitted.posterior.models,
        fitted.posterior,
        fitted.kept,
        errors,
        fitted.label_sd,
        settled=True,
        errors=errors,
        fixed=fixed,
    )
    try:
        for number in range(REWEIGHTED):
            found = _tails(problem, state, seen, images)
            if found is None:
                break
            tails, kept = found
            again = state._replace(tails=tails, kept=kept)
            state = _round(problem, again, seen, images, stated, search=number == 0)
        if state.tails is None:
            return fitted
        _check_fitted(problem, state, seen)
    except np.linalg.LinAlgError:
        return fitted
    assert state.hyper is not None
    return replace(
        fitted,
        posterior=state.posterior,
        kept=state.kept,
        hyperparameters=state.hyper,
        errors=state.errors,
        label_sd=state.label_sd,
        tails=state.tails,
    )


def _tails(
    problem: Problem, state: _Round, seen: tuple[Sightings, ...], images: tuple[Image, ...]
) -> tuple[Tails, tuple[Bools, ...]] | None:
    """Degrees of freedom of the noise, from how far all views are from what the others predict; the weight of each view
    by how far it is from what all say; and the views to use. None where the noise is normal."""
    weighted = state.weighted(seen, told=True)

    def one(c: int, most: int) -> _Predicted:
        some = _some(len(seen[c].rows), most)
        return _Predicted.of(
            state.posterior, c, problem.points, seen[c].select(some), weighted[c].select(some), state.kept[c][some]
        )

    if state.tails is None:
        few = [one(c, MOST_VIEWS) for c in range(len(seen))]
        areas = [(2 * image.half) ** 2 for image in images]
        background = [2 * np.pi * f.variance / area for f, area in zip(few, areas, strict=True)]
        if not looks_heavy(np.concatenate([f.distance for f in few]), np.concatenate(background)):
            return None
        try:
            degrees = degrees_of_agreement(*_agreement(state.posterior, problem.points, few))
        except np.linalg.LinAlgError:  # the cameras among themselves say nothing of the noise
            return None
    else:
        degrees = state.tails.degrees
    if degrees is None:
        return None
    every = [one(c, len(problem.points)) for c in range(len(seen))]
    limit = outlier_distance(degrees, OUTLIER)
    judged = tuple(next_inliers(p.distance, k, limit) for p, k in zip(every, state.kept, strict=True))
    return Tails(degrees, tuple(weights_of(p.own, degrees) for p in every)), judged


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
        cls, posterior: Posterior, c: int, points: Floats, seen: Sightings, weighted: Sightings, kept: Bools
    ) -> _Predicted:
        at = residuals_of(posterior, c, points, weighted)
        variance = (posterior.models[c].noise * seen.relative) ** 2
        residual, covariance = left_out_from(at, kept)
        covariance = covariance - (at.sd**2 - variance)[:, None, None] * np.eye(2)
        distance = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(covariance), residual)
        sound = np.isfinite(distance) & (covariance[:, 0, 0] > 0) & (np.linalg.det(covariance) > 0)
        distance = np.where(sound, distance, np.inf)
        expected = (np.sum(at.residual**2, axis=1) + np.trace(at.reach, axis1=1, axis2=2)) / variance
        return cls(seen.rows, residual, covariance, distance, np.where(kept, expected, distance), variance)


def _agreement(posterior: Posterior, points: Floats, predicted: list[_Predicted]) -> tuple[Floats, Floats, Bools]:
    """Of points, slopes and residuals of their views in the scale of the noise, and which there are: not those that are
    wrong even with heavy tails."""
    limit = outlier_distance(min(DEGREES), OUTLIER)
    n, C = len(points), len(predicted)
    each = np.broadcast_to(np.eye(2), (n, C, 2, 2)).copy()
    r, D, there = np.zeros((n, C, 2)), np.zeros((n, C, 2, 3)), np.zeros((n, C), dtype=np.bool_)
    for c, view in enumerate(predicted):
        good = view.distance <= limit
        rows = view.rows[good]
        each[rows, c] = np.linalg.inv(view.covariance[good])
        r[rows, c], there[rows, c] = view.residual[good], True
        D[rows, c] = posterior.models[c].predict(points[rows])[1]
    return *whitened(Linear(r, D, each, None)), there


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
    tails: Tails | None = None

    def weighted(self, seen: tuple[Sightings, ...], *, told: bool) -> tuple[Sightings, ...]:
        """The sightings with their weights as noise; told: as much as they tell, for what is known of the cameras."""
        return seen if self.tails is None else self.tails.weighted(seen, told=told)

    @property
    def posterior(self) -> Posterior:
        assert self.found is not None
        return self.found


def _round(
    problem: Problem,
    last: _Round,
    seen: tuple[Sightings, ...],
    images: tuple[Image, ...],
    stated: Floats,
    *,
    search: bool,
) -> _Round:
    """Sizes, posterior, and how far the shots are off. search: for other lengthscales too."""
    kept = tuple(
        k & np.isfinite(m.camera.pixel(problem.points[s.rows])).all(axis=1)  # a camera can turn its back on a point
        for k, m, s in zip(last.kept, last.models, seen, strict=True)
    )
    for number, k in enumerate(kept):
        if k.sum() < FEWEST:
            raise CameraFailedError(number, f"{k.sum()} of its {len(k)} views agree with the others")
    used = tuple(s.select(k) for s, k in zip(last.weighted(seen, told=False), kept, strict=True))
    moved = None if last.found is None or last.found.unknowns is None else last.found.displacement
    hyper = last.fixed or _hyperparameters(problem, last.models, used, images, stated, last.hyper, moved, search)
    errors = last.next_errors
    used = tuple(s.select(k) for s, k in zip(last.weighted(seen, told=True), kept, strict=True))
    posterior = _conditioned(problem, last.models, used, hyper, errors)
    following, label_sd, settled = errors, None, True
    if errors is not None and posterior.unknowns is not None:
        mean, variance = posterior.unknowns.mean, np.diag(posterior.unknowns.covariance)
        following, label_sd = errors.updated(mean.reshape(errors.sd.shape), variance.reshape(errors.sd.shape))
        settled = bool(np.allclose(following.sd, errors.sd, rtol=SETTLED))
    return _Round(
        hyper, posterior.models, posterior, kept, following, label_sd, settled, errors, last.fixed, last.tails
    )


def without_field(started: Started, image: Image, noise: float = 1.0) -> CameraModel:
    """A camera model that is nothing but the camera; noise in pixels."""
    field = empty_field(np.ones(2), np.zeros((1, 3)), 1.0)
    none = np.zeros((1, 2))
    return CameraModel(
        started.camera, started.camera, started.prior, image, field, 0.0, noise, none, family=started.family
    )


def start_rig(
    problem: Problem, start: Callable[[int, Floats, Floats], Started]
) -> tuple[dict[int, Started], list[tuple[int, str]]]:
    """Each camera that `start` can place from its number, known points (n, 3) and pixels, and why it cannot the others.

    FitError where fewer than two can be placed.
    """

    def one(c: int) -> Started | FitError:
        seen = problem.sightings[c]
        try:
            _check_places(problem.points[seen.rows])
            started = start(c, problem.points[seen.rows], seen.uv)
            _check_start(started, problem.points[seen.rows], seen.uv, problem)
            return started
        except np.linalg.LinAlgError:
            return FitError(f"the known points do not fix it.{_why(problem, c)}")
        except FitError as error:
            return type(error)(error.what + _why(problem, c), why=error.why, fix=error.fix)

    started, blind = {}, []
    for c, found in enumerate(side_by_side(one, range(len(problem.sightings)))):
        if isinstance(found, FitError):
            blind.append((c, found.what))
        else:
            started[c] = found
    _require_two(problem, started, blind)
    return started, blind


def _require_two(problem: Problem, started: dict[int, Started], blind: list[tuple[int, str]]) -> None:
    if len(started) < 2:
        raise FitError(
            f"{len(started)} of {len(problem.names)} cameras can be calibrated; a position takes two.",
            why="; ".join(f"{problem.names[c]}: {why}" for c, why in blind) or "there is one camera",
            fix=_cure(problem, blind),
        )


def _why(problem: Problem, c: int) -> str:
    """What its rows say of a camera that no model fits, as a sentence after another."""
    seen = problem.sightings[c]
    uv = np.full((len(problem.points), 2), np.nan)
    uv[seen.rows] = seen.uv
    why = what_is_wrong(problem.points, uv)
    return f" {why[0].upper()}{why[1:]}." if why else ""


def _check_places(points: Floats) -> None:
    """FitError for many views of few places: to click a point again says nothing new of the camera."""
    places = len(np.unique(points, axis=0))
    if places < FEWEST <= len(points):
        raise FitError(f"its {len(points)} views are of {places} different positions, and it takes {FEWEST}.")


def _cure(problem: Problem, blind: list[tuple[int, str]]) -> str:
    if not blind:
        return "use two cameras or more: a position is where their lines of sight meet"
    if sum(len(seen.rows) >= ENOUGH_VIEWS for seen in problem.sightings) >= 2:
        return "look whether pixels and known positions belong together: order of the rows, names, axes, units"
    return "show the cameras more known points, in the whole volume"


def _check_start(started: Started, points: Floats, uv: Floats, problem: Problem) -> None:
    error = np.linalg.norm(started.camera.pixel(points) - uv, axis=1)[started.kept]
    low, high = pixel_extent(uv)
    half = float((high - low).max()) / 2
    if len(error) < FEWEST:
        raise FitError(
            f"{len(error)} of its {len(uv)} views agree on one camera, and it takes {FEWEST}.",
            fix="add known points, or look for wrong detections",
        )
    if not np.median(error) < TOLERABLE[started.camera.kind] * half:
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
    search: bool,
) -> Hyperparameters:
    found = Hyperparameters(np.ones((len(models), 2)), np.ones(len(models)), np.ones(len(models)))
    groups = []
    for numbers in _alike(models):
        evidence = [_evidence(problem, models[c], used[c], moved) for c in numbers]
        half = np.array([images[c].half for c in numbers])
        kind = models[numbers[0]].camera.kind
        rig = RigEvidence(evidence, half, stated[numbers], kind, TOLERANCE[kind])
        guess = None if before is None else Hyperparameters(*(values[numbers] for values in before))
        for values, part in zip(found, rig.maximise(guess, search=search or moved is not None), strict=True):
            values[numbers] = part
        groups.append((numbers, rig))
    if problem.errors is None or problem.errors.estimated:
        return found
    return _joint_sizes(problem, models, used, found, groups)


def _alike(models: tuple[CameraModel, ...]) -> list[list[int]]:
    """The numbers of cameras whose fields are of one kind: what a lens model leaves, or a linear projection."""
    none = [c for c, model in enumerate(models) if model.camera.kind == ProjectiveCamera.kind]
    return [group for group in ([c for c in range(len(models)) if c not in none], none) if group]


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
    return CameraEvidence(seen.uv - view.uv, X, off, prior, field_coordinates(view, model.image), seen.relative)


def _thinned(seen: Sightings, most: int) -> Sightings:
    return seen if len(seen.rows) <= most else seen.select(_some(len(seen.rows), most))


def _some(n: int, most: int) -> Bools:
    """At most so many of n, at random."""
    keep = np.full(n, n <= most)
    if n > most:
        keep[np.random.default_rng(0).choice(n, most, replace=False)] = True
    return keep


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
    if errors is None and scatter is None and len(models) > 1:
        return _settled_alone(models, points, used)
    misfits: list[_Misfit] = []
    for _ in range(MAX_SETTLING_STEPS):
        if scatter is None:
            posterior = condition(models, points, used, errors)
        else:
            posterior = condition_scattered(models, points, used, errors, scatter)
        steps = posterior.steps
        small = [_small(step, posterior.root(c)) for c, step in enumerate(steps)]
        tied = posterior.displacement is not None
        if not all(small) and (tied or not misfits):
            where = points if posterior.displacement is None else points + posterior.displacement
            misfits = [_Misfit.of(model, where, seen) for model, seen in zip(models, used, strict=True)]
        models = tuple(
            _downhill(models[c], posterior.models[c], steps[c], points[used[c].rows], None if small[c] else misfits[c])
            for c in range(len(models))
        )
        if all(small):
            break
    return replace(posterior, models=models)


def _settled_alone(models: tuple[CameraModel, ...], points: Floats, used: tuple[Sightings, ...]) -> Posterior:
    """The same where known positions are exact: no camera takes part in the steps that another still needs."""

    def one(c: int) -> Posterior:
        try:
            return settle((models[c],), points, (used[c],), None)
        except CameraFailedError as error:
            raise CameraFailedError(c, str(error)) from error

    found = side_by_side(one, range(len(models)))
    return Posterior(
        tuple(each.models[0] for each in found),
        tuple(each.alone[0] for each in found),
        None,
        tuple(each.steps[0] for each in found),
        sum(each.evidence for each in found),
    )


def _sized(
    problem: Problem, models: tuple[CameraModel, ...], used: tuple[Sightings, ...], hyper: Hyperparameters
) -> tuple[CameraModel, ...]:
    """The cameras with fields laid out anew."""

    def one(c: int) -> CameraModel:
        model = models[c]
        points = problem.points[used[c].rows]
        view = model.camera.view(points[:: max(1, len(points) // 4000)])
        depth = DepthScale.of(view)
        tolerance = TOLERANCE[model.camera.kind]
        field = empty_field(hyper.lengthscale[c], field_coordinates(view, model.image, depth), tolerance)
        return replace(
            model,
            ruler=model.camera,
            depth=depth,
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
    groups: list[tuple[list[int], RigEvidence]],
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
        penalties = (rig.penalty(hyper.signal[c] * signal, hyper.noise[c] * noise) for c, rig in groups)
        return float(sum(penalties)) - evidence

    first = min((np.array([0.0, noise]) for noise in (0.0, 1.0, 2.0)), key=loss)
    simplex = first + np.array([[0, 0], [0.4, 0], [0, 0.4]])
    options = {"initial_simplex": simplex, "xatol": 0.05, "fatol": 0.05, "maxfev": 24}
    z = minimize(loss, first, method="Nelder-Mead", options=options).x
    curvature = np.empty(2)
    for axis, h in enumerate(0.2 * np.eye(2)):
        curvature[axis] = (loss(z + h) - 2 * loss(z) + loss(z - h)) / 0.2**2
    signal, noise = np.exp(z + 1 / np.maximum(curvature, 1.0))  # the mean variance, eq. (12)
    return Hyperparameters(hyper.lengthscale, hyper.signal * signal, hyper.noise * noise)


class _Misfit(NamedTuple):
    """How badly a camera fits, with the field that then fits best: what Gauss-Newton must not increase.

    prior; points (n, 3), pixels (n, 2) and sd (n,) of at most MAX_MISFIT_VIEWS views; phi (n, m) the field's features
    over sd, and the Cholesky factor (m, m) of I + phi^T phi.
    """

    prior: Prior
    points: Floats
    uv: Floats
    sd: Floats
    phi: Floats
    factor: Floats

    @classmethod
    def of(cls, model: CameraModel, points: Floats, seen: Sightings) -> _Misfit:
        """Of the camera's present field."""
        seen = _thinned(seen, MAX_MISFIT_VIEWS)
        where = points[seen.rows]
        sd = model.noise * seen.relative
        phi = model.rows(where).phi / sd[:, None]
        factor = np.asarray(np.linalg.cholesky(np.eye(phi.shape[1]) + phi.T @ phi), dtype=np.float64)
        return cls(model.prior, where, seen.uv, sd, phi, factor)

    def __call__(self, camera: AnyCamera) -> float:
        """Minus twice the log posterior, up to a constant; infinite where the camera loses a point."""
        y = (self.uv - camera.pixel(self.points)) / self.sd[:, None]
        if not (camera.sane and np.isfinite(y).all()):
            return np.inf
        off = self.prior.mean - camera.parameters
        field = np.linalg.solve(self.factor, self.phi.T @ y)
        return float(np.sum(y**2) - np.sum(field**2) + off @ self.prior.precision @ off)

    def weights(self, camera: AnyCamera) -> Floats:
        """(m, 2) of the field that then fits best: those of a whole step do not belong to half of it."""
        y = (self.uv - camera.pixel(self.points)) / self.sd[:, None]
        return np.asarray(np.linalg.solve(self.factor.T, np.linalg.solve(self.factor, self.phi.T @ y)))


def _downhill(
    before: CameraModel, after: CameraModel, step: Floats, points: Floats, misfit: _Misfit | None
) -> CameraModel:
    """A camera never steps so far that it loses a point it saw, or fits worse: half the step, then, or half of that."""
    now = np.inf if misfit is None else misfit(before.camera)
    for halvings in range(20):
        camera = after.camera if halvings == 0 else before.camera.moved(step * 0.5**halvings)
        fits = misfit is None or misfit(camera) <= now + MISFIT_TOLERANCE
        if fits and camera.sane and np.isfinite(camera.pixel(points)).all():
            if halvings == 0:
                return after
            return replace(after, camera=camera, weights=after.weights if misfit is None else misfit.weights(camera))
    return before if misfit is None else replace(before, weights=misfit.weights(before.camera))


def _small(step: Floats, root: Floats) -> bool:
    sd = np.sqrt(np.sum(root[:, : len(step)] ** 2, axis=0))
    return bool(np.all(np.abs(step) <= 0.02 * sd))
