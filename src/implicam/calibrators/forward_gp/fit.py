"""From known points to a fitted rig: start, hyperparameters, posterior, and the views that contradict the others.

The order of docs/method.md, section "Fit".
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from implicam.calibrators.forward_gp.choose_camera import (
    Candidate,
    Scene,
    as_started,
    candidate_again,
    candidates,
    choose,
)
from implicam.calibrators.forward_gp.linear_projections import (
    LARGE_FIELD,
    measures_better,
    predicts_better,
    start_without_lens,
)
from implicam.calibrators.forward_gp.rounds import Round, check_fitted, next_round
from implicam.errors import FitError
from implicam.geometry import Floats
from implicam.progress import Progress, silent
from implicam.rig_model.camera_model import CameraModel
from implicam.rig_model.fit_result import FitResult
from implicam.rig_model.initialise import (
    Started,
    lens_only_model,
    require_two_cameras,
    start_again,
    start_camera,
    start_rig,
)
from implicam.rig_model.leave_one_out import update_inliers
from implicam.rig_model.normal_equations import CameraFailedError
from implicam.rig_model.training_data import Problem
from implicam.threads import side_by_side

AUTO = "auto"
"""The kind of each camera is chosen by the data."""

ROUNDS, ROUNDS_WITH_SHOTS = 6, 18

SEARCHED, FEW_CHANGED = 2, 0.01
"""Of these, those that look for lengthscales in any case, where known positions are exact; and the part of the views
which, when they change later, tell nothing new of how smooth a field is."""


def fit_rig(problem: Problem, progress: Progress, before: FitResult | None = None) -> FitResult:
    """Fit every camera that can be fitted. before: a fit in the same working frame to most of these points, from a
    moment ago: its cameras and hyperparameters are the guess. Where known positions have declared errors, which make
    hyperparameters costly, they are kept."""
    progress("fitting", 0, 3)
    started, uncalibrated = _started(problem, before)
    fitted = _fit_without_failures(problem, progress, before, started, uncalibrated)
    return _with_projections(problem, fitted, started) if problem.lens == AUTO else fitted


def _fit_without_failures(
    problem: Problem,
    progress: Progress,
    before: FitResult | None,
    started: dict[int, Started],
    uncalibrated: list[tuple[int, str]],
) -> FitResult:
    """One bad camera never takes the rig down: it goes on without a lens model, or is left out. Changes `started` and
    `uncalibrated`."""
    while True:
        try:
            return _fit_started(problem, progress, before, started, uncalibrated)
        except CameraFailedError as error:
            failed = list(started)[error.number]
            again = None
            if problem.lens == AUTO and started[failed].family != "none":
                again = start_without_lens(problem, failed)
            if again is not None:
                started[failed] = again._replace(ordinary_px=started[failed].ordinary_px)
                continue
            uncalibrated.append((failed, f"no camera model fits its views: {error}."))
            del started[failed]
            require_two_cameras(problem, started, uncalibrated)


def _with_projections(problem: Problem, fitted: FitResult, started: dict[int, Started]) -> FitResult:
    """The rig with those cameras as linear projections that clearly predict left-out views better so."""
    tried = {}
    for number, c in enumerate(fitted.cameras):
        model = fitted.posterior.models[number]
        odd = model.family in ("free", "crop") or model.signal > LARGE_FIELD * model.image.half
        if odd and model.family != "none" and c in started:
            found = start_without_lens(problem, c)
            if found is not None:
                tried[c] = found._replace(ordinary_px=started[c].ordinary_px)
    if not tried:
        return fitted
    uncalibrated = list(fitted.uncalibrated)
    try:
        other = _fit_started(problem, silent, None, {c: tried.get(c, started[c]) for c in fitted.cameras}, uncalibrated)
    except np.linalg.LinAlgError:
        return fitted
    if measures_better(problem, other, fitted):
        return other
    better = {
        c for number, c in enumerate(fitted.cameras) if c in tried and predicts_better(problem, other, fitted, number)
    }
    if better == set(tried) or not better:
        return other if better else fitted
    mixed = {c: tried[c] if c in better else started[c] for c in fitted.cameras}
    try:
        return _fit_started(problem, silent, None, mixed, uncalibrated)
    except np.linalg.LinAlgError:
        return fitted


def _started(problem: Problem, before: FitResult | None) -> tuple[dict[int, Started], list[tuple[int, str]]]:
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
        seen = problem.camera_views[c]
        return Scene(problem.points[seen.rows], seen.uv, seen.relative, problem.images[c], float(problem.stated[c]))

    def look(c: int) -> list[Candidate] | FitError:
        try:
            known = candidate_again(scene(c), guess[c].camera, guess[c].family) if c in guess else None
            return [known] if known is not None else candidates(scene(c))
        except FitError as error:
            return error
        except np.linalg.LinAlgError as error:
            return FitError(f"its equations have no solution: {error}.")

    found = side_by_side(look, range(len(problem.camera_views)))
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
    before: FitResult | None,
    started: dict[int, Started],
    uncalibrated: list[tuple[int, str]],
) -> FitResult:
    cameras = tuple(started)
    seen = tuple(problem.camera_views[c] for c in cameras)
    images = tuple(problem.images[c] for c in cameras)
    inliers = tuple(started[c].inliers for c in cameras)
    models = tuple(lens_only_model(started[c], image) for c, image in zip(cameras, images, strict=True))
    progress("fitting", 1, 3)
    stated = problem.stated[list(cameras)]
    rounds = ROUNDS_WITH_SHOTS if problem.errors is not None and problem.errors.estimated else ROUNDS
    hyper = before.hyperparameters if before is not None and before.cameras == cameras else None
    tied = problem.errors is not None and not problem.errors.estimated
    state = Round(hyper, models, None, inliers, problem.errors, None, settled=False, fixed=hyper if tied else None)
    changed = 1.0  # part of the views
    for number in range(rounds):
        search = number < SEARCHED or changed > FEW_CHANGED
        state = next_round(problem, state, seen, images, stated, search=search)
        judged = state.inliers
        if state.settled or number >= rounds // 2:  # earlier it is too soon to say what contradicts the others
            judged = update_inliers(state.posterior, problem.points, seen, state.inliers)
        changed = float(np.mean(np.concatenate(judged) != np.concatenate(state.inliers)))
        if state.settled and not changed:
            break
        progress("fitting", 2, 3)
        if number < rounds - 1:  # the last round's views stay those of its posterior
            state = state._replace(inliers=judged)
    progress("fitting", 3, 3)
    assert state.hyper is not None
    check_fitted(problem, state, seen)
    ordinary_px = tuple(one.ordinary_px for one in started.values())
    return FitResult(
        state.posterior,
        cameras,
        tuple(uncalibrated),
        state.inliers,
        state.hyper,
        state.errors,
        state.label_sd,
        ordinary_px=ordinary_px,
    )
