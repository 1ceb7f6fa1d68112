"""From known points to a fitted rig: start, hyperparameters, posterior, and the views that contradict the others.

The order of docs/method.md, section "Fit".
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from implicam.calibrators.forward_gp.choose_camera import (
    Candidate,
    as_started,
    candidate_again,
    candidates,
    choose,
)
from implicam.calibrators.forward_gp.families import Scene
from implicam.calibrators.forward_gp.linear_projections import Comparison, start_without_lens
from implicam.calibrators.forward_gp.rounds import Round, check_fitted, next_round
from implicam.calibrators.forward_gp.settings import Training
from implicam.errors import FitError
from implicam.geometry import Floats
from implicam.progress import Progress, silent
from implicam.rig_model.camera_model import CameraModel
from implicam.rig_model.fit_result import FitResult
from implicam.rig_model.initialise import (
    InitialCamera,
    lens_only_model,
    require_two_cameras,
    start_camera,
    start_rig,
)
from implicam.rig_model.leave_one_out import update_inliers
from implicam.rig_model.normal_equations import CameraFailedError
from implicam.rig_model.posterior import Posterior
from implicam.threads import side_by_side

_LOG = logging.getLogger(__name__)

AUTO = "auto"
"""The kind of each camera is chosen by the data."""


def fit_rig(training: Training, progress: Progress, before: FitResult | None = None) -> FitResult:
    """Fit every camera that can be fitted.

    Args:
        training: What all cameras saw.
        progress: Is told how far it is.
        before: A fit in the same working frame to most of these points, from a moment ago: its cameras and
            hyperparameters are the guess. Where known positions have declared errors, which make hyperparameters
            costly, they are kept.

    Raises:
        FitError: Fewer than two cameras can be fitted.
    """
    progress("fitting", 0, 3)
    started, uncalibrated = _start_cameras(training, before)
    while True:
        try:
            fitted = _fit_from_start(training, progress, before, started)
            break
        except CameraFailedError as error:  # one bad camera never takes the rig down
            failed = list(started)[error.number]
            again = None
            if training.lens == AUTO and started[failed].family != "none":
                again = start_without_lens(training, failed, started[failed])
            if again is not None:
                started[failed] = again
                continue
            uncalibrated.append((failed, f"no camera model fits its views: {error}."))
            del started[failed]
            require_two_cameras(training, started, uncalibrated)
    if training.lens == AUTO:
        fitted = _try_linear_projections(training, fitted, started)
    return replace(fitted, uncalibrated=tuple(uncalibrated))


def _try_linear_projections(training: Training, fitted: FitResult, started: dict[int, InitialCamera]) -> FitResult:
    """The rig with those cameras as linear projections that clearly predict left-out views better so."""
    tried = {}
    for model, (c, start) in zip(fitted.posterior.models, started.items(), strict=True):
        large = training.settings.large_field_half_sides * model.image.half
        if model.family in ("free", "crop") or (model.family != "none" and model.signal > large):
            found = start_without_lens(training, c, start)
            if found is not None:
                tried[c] = found
    if not tried:
        return fitted
    try:
        other = _fit_from_start(training, silent, None, started | tried)
        compared = Comparison(training, other, fitted)
        if compared.measures_better():
            return other
        cameras = enumerate(fitted.cameras)
        better = {c: tried[c] for number, c in cameras if c in tried and compared.predicts_better(number)}
        if better.keys() == tried.keys():
            return other
        return _fit_from_start(training, silent, None, started | better) if better else fitted
    except np.linalg.LinAlgError:
        return fitted


def _start_cameras(
    training: Training, before: FitResult | None
) -> tuple[dict[int, InitialCamera], list[tuple[int, str]]]:
    guess = {} if before is None else dict(zip(before.cameras, before.posterior.models, strict=True))
    if training.lens == AUTO:
        return choose_cameras(training, guess)

    def start(c: int, points: Floats, uv: Floats) -> InitialCamera:
        known = guess[c].camera if c in guess else None
        return start_camera(points, uv, training.images[c], training.lens, training.settings, known)

    return start_rig(training, start)


def choose_cameras(
    training: Training, guess: Mapping[int, CameraModel]
) -> tuple[dict[int, InitialCamera], list[tuple[int, str]]]:
    """The kind of each camera, and where it starts.

    Args:
        training: What the fit starts from.
        guess: Cameras that fitted most of the points a moment ago, by their numbers.

    Returns:
        The start of each camera that has one, by its number; and (number, why) of the others.

    Raises:
        FitError: Fewer than two cameras can be started.
    """

    def scene(c: int) -> Scene:
        seen = training.camera_views[c]
        stated = float(training.stated[c])
        return Scene(training.points[seen.rows], seen.uv, seen.relative, training.images[c], stated, training.settings)

    def look(c: int) -> list[Candidate] | FitError:
        try:
            known = candidate_again(scene(c), guess[c].camera, guess[c].family) if c in guess else None
            return [known] if known is not None else candidates(scene(c))
        except FitError as error:
            return error
        except np.linalg.LinAlgError as error:
            return FitError(f"its equations have no solution: {error}.")

    found = side_by_side(look, range(len(training.camera_views)))
    seeing = {c: some for c, some in enumerate(found) if not isinstance(some, FitError)}
    chosen = dict(zip(seeing, choose(list(seeing.values()), training.settings), strict=True))

    def start(c: int, points: Floats, uv: Floats) -> InitialCamera:
        some = found[c]
        if isinstance(some, FitError):
            raise some
        return as_started(chosen[c], scene(c), some)

    return start_rig(training, start)


def _fit_from_start(
    training: Training,
    progress: Progress,
    before: FitResult | None,
    started: dict[int, InitialCamera],
) -> FitResult:
    cameras = tuple(started)
    mine, settings = training.of_cameras(cameras), training.settings
    models = tuple(lens_only_model(start, image) for start, image in zip(started.values(), mine.images, strict=True))
    for c, start in started.items():
        _LOG.info("%s starts from %d of %d views", training.names[c], start.inliers.sum(), len(start.inliers))
    progress("fitting", 1, 3)
    guess = before.hyperparameters if before is not None and before.cameras == cameras else None
    inliers = tuple(start.inliers for start in started.values())
    state = Round(Posterior(models, ()), inliers, guess, training.errors)
    shots = training.errors is not None and training.errors.estimated
    keep_sizes = guess is not None and training.errors is not None and not shots
    rounds = settings.max_rounds_with_shots if shots else settings.max_rounds
    changed = 1.0  # part of the views
    for number in range(rounds):
        search = number < settings.min_search_rounds or changed > settings.max_changed_share
        state = next_round(mine, state, search=search, keep_sizes=keep_sizes)
        judged = state.inliers
        if state.settled or number >= rounds // 2:  # earlier it is too soon to say what contradicts the others
            limit = settings.max_squared_mahalanobis
            judged = update_inliers(state.posterior, mine.points, mine.camera_views, state.inliers, limit)
        changed = float(np.mean(np.concatenate(judged) != np.concatenate(state.inliers)))
        _LOG.info("round %d: %.1f %% of the views changed sides%s", number, 100 * changed, ", settled" * state.settled)
        if state.settled and not changed:
            break
        progress("fitting", 2, 3)
        if number < rounds - 1:  # the last round's views stay those of its posterior
            state = state._replace(inliers=judged)
    progress("fitting", 3, 3)
    assert state.hyper is not None
    check_fitted(mine, state)
    return FitResult(
        state.posterior,
        cameras,
        (),
        state.inliers,
        state.hyper,
        state.errors,
        state.label_sd,
        ordinary_px=tuple(start.ordinary_px for start in started.values()),
    )
