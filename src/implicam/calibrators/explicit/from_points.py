"""The classical calibration from known points: every camera resected, then refined.

Where known positions are exact, the cameras do not depend on each other; where an error of theirs is declared, all
cameras see the same error and are refined together. The equations are those of forward-gp without its field
(docs/method.md, eqs. (13) to (15)); the noise is what the residuals say, per camera.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from implicam.calibrators.explicit.lenses import Choice
from implicam.calibrators.explicit.settings import ExplicitSettings
from implicam.calibrators.explicit.start import MirroredError, start_with_lens
from implicam.errors import FitError
from implicam.geometry import Bools, Floats
from implicam.progress import Progress
from implicam.rig_model import (
    MIN_POINTS_PER_CAMERA,
    CameraModel,
    CameraViews,
    FitResult,
    Hyperparameters,
    InitialCamera,
    Posterior,
    TrainingData,
    apply_covariance_root,
    condition,
    iterate_linearisation,
    lens_only_model,
    levenberg_marquardt,
    start_rig,
    update_inliers,
)

MAX_ROUNDS = 8

MAX_MISFIT_RATIO = 2.0
"""Times what was left: a step to more than that was no step towards the optimum."""


def fit_points(
    training: TrainingData, family: str, settings: ExplicitSettings, progress: Progress
) -> tuple[FitResult, dict[int, Choice]]:
    """Fit every camera that can be fitted.

    Args:
        training: What the fit starts from.
        family: Name of the lens of all cameras, or `auto`.
        settings: Priors and thresholds.
        progress: Is told how far the fit is.

    Returns:
        The fit; and the lens model that each camera got, by its number.

    Raises:
        FitError: Fewer than two cameras can be started.
    """
    progress("fitting", 0, 3)
    choices: dict[int, Choice] = {}

    def start(c: int, points: Floats, uv: Floats) -> InitialCamera:
        started, choices[c] = start_with_lens(points, uv, training.images[c], family, settings)
        return started

    started, uncalibrated = _started(training, start)
    fitted = refined(training, started, uncalibrated, settings, progress)
    return fitted, {c: choices[c] for c in fitted.cameras}


def refined(
    training: TrainingData,
    started: Mapping[int, InitialCamera],
    uncalibrated: Sequence[tuple[int, str]],
    settings: ExplicitSettings,
    progress: Progress,
) -> FitResult:
    """Cameras from where they start, with the noise that the residuals show and without the views that contradict.

    Args:
        training: What the fit starts from.
        started: The start of each camera that has one, by its number.
        uncalibrated: (number, why) of the others.
        settings: Priors and thresholds.
        progress: Is told how far the fit is.

    Returns:
        The fit, in the working frame.

    Raises:
        numpy.linalg.LinAlgError: The views of a camera do not fix it.
    """
    cameras = tuple(started)
    progress("fitting", 1, 3)
    seen = tuple(training.camera_views[c] for c in cameras)
    inliers = tuple(started[c].inliers for c in cameras)
    stated = training.stated[list(cameras)]
    models = tuple(lens_only_model(started[c], training.images[c]) for c in cameras)
    first = _first_noise(training, models, seen, inliers)
    models = with_noise(models, first)
    for number in range(MAX_ROUNDS):
        used = tuple(
            s.select(k & np.isfinite(m.camera.pixel(training.points[s.rows])).all(axis=1))
            for s, k, m in zip(seen, inliers, models, strict=True)
        )
        posterior = _settled(models, training, used, first)
        noise = _noise(training, posterior, used, stated, settings.noise_prior_residuals)
        close = np.allclose(noise, [m.noise for m in models], rtol=0.01)
        models = with_noise(posterior.models, noise)
        limit = settings.max_squared_mahalanobis
        judged = update_inliers(replace(posterior, models=models), training.points, seen, inliers, limit)
        if close and all((a == b).all() for a, b in zip(judged, inliers, strict=True)):
            break
        if number < MAX_ROUNDS - 1:
            inliers = judged
        progress("fitting", 2, 3)
    posterior = _settled(models, training, tuple(s.select(k) for s, k in zip(seen, inliers, strict=True)), first)
    progress("fitting", 3, 3)
    hyper = Hyperparameters(np.ones(2), np.zeros(len(cameras)), noise)
    return FitResult(posterior, cameras, tuple(uncalibrated), inliers, hyper, training.errors, None)


def _started(
    training: TrainingData, start: Callable[[int, Floats, Floats], InitialCamera]
) -> tuple[dict[int, InitialCamera], list[tuple[int, str]]]:
    """As start_rig; where mirrors are why it fails, the error says so."""
    mirrored: dict[int, MirroredError] = {}

    def noting(c: int, points: Floats, uv: Floats) -> InitialCamera:
        try:
            return start(c, points, uv)
        except MirroredError as error:
            mirrored[c] = error
            raise

    try:
        return start_rig(training, noting)
    except FitError as error:
        if not mirrored:
            raise
        names = [training.names[c] for c in sorted(mirrored)]
        listed = " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
        everyone = len(names) == sum(len(seen.rows) >= MIN_POINTS_PER_CAMERA for seen in training.camera_views)
        raise FitError(
            f"{listed} see{'s' * (len(names) == 1)} the known points as in a mirror.",
            why=error.why,
            fix="is an axis of the known positions negated, or are two exchanged (left-handed)? Or is v counted from "
            "below? Turn the sign of one axis in points.csv, or write height - 1 - v for v"
            if everyone
            else "pictures flipped left to right (webcams do so) or through a mirror: write width - 1 - u for u of "
            f"{listed}, or switch the flip off",
        ) from error


def _settled(
    models: tuple[CameraModel, ...], training: TrainingData, used: tuple[CameraViews, ...], first: Floats
) -> Posterior:
    """As linearise.iterate_linearisation; a camera that Gauss-Newton would lead astray, as a lens can that bends much,
    is taken there by damped steps, and stays. first (C,): the noise at the start, pixels."""
    posterior = iterate_linearisation(models, training.points, used, training.errors)

    def left(model: CameraModel, seen: CameraViews) -> float:
        off = np.sum((seen.uv - model.camera.pixel(training.points[seen.rows])) ** 2)
        return float(off) if np.isfinite(off) else np.inf

    astray = [
        left(after, seen) > (MAX_MISFIT_RATIO * noise) ** 2 * 2 * len(seen.rows) + left(before, seen)
        for before, after, seen, noise in zip(models, posterior.models, used, first, strict=True)
    ]
    if not any(astray):
        return posterior
    damped = []
    for model, lost, seen in zip(models, astray, used, strict=True):
        camera = model.camera
        if lost:
            camera = levenberg_marquardt(camera, model.prior, training.points[seen.rows], seen.uv, model.noise)
        damped.append(replace(model, camera=camera, field_camera=camera))
    posterior = condition(tuple(damped), training.points, used, training.errors)
    ends = (
        replace(after, camera=before.camera, field_camera=before.camera) if lost else after
        for before, after, lost in zip(damped, posterior.models, astray, strict=True)
    )
    return replace(posterior, models=tuple(ends))


def with_noise(models: Sequence[CameraModel], noise: Floats) -> tuple[CameraModel, ...]:
    """The cameras with other noise.

    Args:
        models: C cameras.
        noise: (C,) pixels.

    Returns:
        The cameras.
    """
    return tuple(replace(m, noise=float(sd)) for m, sd in zip(models, noise, strict=True))


def _first_noise(
    training: TrainingData, models: Sequence[CameraModel], seen: Sequence[CameraViews], inliers: Sequence[Bools]
) -> Floats:
    """(C,) from the residuals of the start, never nothing."""
    noise = []
    for m, s, k in zip(models, seen, inliers, strict=True):
        error = (s.uv - m.camera.pixel(training.points[s.rows]))[k] / s.relative[k, None]
        noise.append(max(float(np.sqrt(np.nanmean(error**2))), 1e-5 * m.image.half))
    return np.array(noise)


def _noise(
    training: TrainingData, posterior: Posterior, used: tuple[CameraViews, ...], stated: Floats, prior: float
) -> Floats:
    """(C,) the noise of each camera in pixels: the residuals' sum of squares over the degrees of freedom left.

    prior: so many residuals the stated noise counts like."""
    if training.errors is not None:
        return _noise_beside_errors(training, posterior, used, stated, prior)
    squares, freedom = np.zeros(len(used)), np.zeros(len(used))
    for c, seen in enumerate(used):
        model = posterior.models[c]
        rows = model.rows(training.points[seen.rows])
        squares[c] = np.sum(((seen.uv - rows.mean) / seen.relative[:, None]) ** 2)
        reach = apply_covariance_root(rows, posterior.alone[c]) / (model.noise * seen.relative)[:, None, None]
        freedom[c] = max(2 * len(seen.rows) - float(np.sum(reach**2)), 0.0)
    told = np.isfinite(stated)
    together = float(np.sum(squares) / max(np.sum(freedom), 1e-3))
    believed = np.where(told, np.nan_to_num(stated) ** 2, together)
    floor = np.array([1e-6 * model.image.half for model in posterior.models])
    return np.asarray(
        np.maximum(np.sqrt((squares + prior * believed) / (freedom + prior)), floor),
        dtype=np.float64,
    )


def _noise_beside_errors(
    training: TrainingData, posterior: Posterior, used: tuple[CameraViews, ...], stated: Floats, prior: float
) -> Floats:
    """(C,) where known positions have errors of their own: one factor for all cameras, the most probable one."""
    now = np.array([model.noise for model in posterior.models])
    base = np.where(np.isfinite(stated), stated, now)

    def loss(log_factor: float) -> float:
        models = with_noise(posterior.models, base * np.exp(log_factor))
        return (
            -iterate_linearisation(models, training.points, used, training.errors).evidence
            + 0.5 * prior * log_factor**2
        )

    found = minimize_scalar(loss, bounds=(-3.0, 3.0), method="bounded", options={"xatol": 0.02})
    return np.asarray(base * np.exp(found.x), dtype=np.float64)
