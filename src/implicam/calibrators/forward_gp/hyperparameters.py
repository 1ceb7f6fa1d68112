"""Lengthscales, field size and noise of all cameras from the marginal likelihood, eqs. (9) to (12)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from implicam.calibrators.forward_gp.evidence import CameraEvidence, RigEvidence
from implicam.calibrators.forward_gp.settings import ForwardGPSettings, Training
from implicam.errors import FitError
from implicam.geometry import Floats
from implicam.rig_model.camera import ProjectiveCamera
from implicam.rig_model.camera_model import CameraModel, CameraViews, thin_views
from implicam.rig_model.field import DepthScale, Hyperparameters, empty_field, field_coordinates
from implicam.rig_model.posterior import log_evidence
from implicam.rig_model.shot_errors import ShotErrors

FIELD_VARIANCE_TOLERANCE = {"central": 1e-6, "general": 1e-6, "none": 1e-9}
"""Part of the field's variance that its features may leave out; without a lens model the field is large."""


def estimate_hyperparameters(
    training: Training,
    models: tuple[CameraModel, ...],
    used: tuple[CameraViews, ...],
    before: Hyperparameters | None,
    moved: Floats | None,
    *,
    search: bool,
) -> Hyperparameters:
    """The most probable hyperparameters of all cameras, eqs. (9) to (12).

    Args:
        training: What these cameras saw.
        models: The cameras where they are linearised.
        used: Per camera, the views to use.
        before: A guess, or None.
        moved: (n, 3) how far the known points are off, or None where that is not known.
        search: Look for other lengthscales than those of the guess, too.
    """
    found = Hyperparameters(np.ones((len(models), 2)), np.ones(len(models)), np.ones(len(models)))
    groups = []
    for numbers in _group_by_kind(models):
        evidence = [_evidence(training, models[c], used[c], moved) for c in numbers]
        half = np.array([models[c].image.half for c in numbers])
        kind = models[numbers[0]].camera.kind
        lens = kind != ProjectiveCamera.kind
        rig = RigEvidence(
            evidence, half, training.stated[numbers], lens, FIELD_VARIANCE_TOLERANCE[kind], training.settings
        )
        guess = None if before is None else Hyperparameters(*(values[numbers] for values in before))
        for values, part in zip(found, rig.maximise(guess, search=search or moved is not None), strict=True):
            values[numbers] = part
        groups.append((numbers, rig))
    if training.errors is None or training.errors.estimated:
        return found
    _refuse_too_many(size_fields(training, models, used, found), training.settings)
    return _joint_sizes(training, models, used, found, groups, training.errors)


def _refuse_too_many(models: tuple[CameraModel, ...], settings: ForwardGPSettings) -> None:
    unknowns = sum(model.size for model in models)
    if unknowns > settings.max_tied_unknowns:
        raise FitError(
            f"{len(models)} cameras are too many for known positions with declared errors (sd_x, sd_y, sd_z).",
            why=f"all cameras share these errors, so all of their {unknowns} unknowns are one system of equations; "
            f"{settings.max_tied_unknowns} at most can be solved in reasonable time and memory",
            fix="leave sd_x, sd_y and sd_z out: the errors then count as noise of the pixels, and error bars are "
            "rather too large than too small; or calibrate fewer cameras",
        )


def _group_by_kind(models: tuple[CameraModel, ...]) -> list[list[int]]:
    """The numbers of cameras whose fields are of one kind: what a lens model leaves, or a linear projection."""
    none = [c for c, model in enumerate(models) if model.camera.kind == ProjectiveCamera.kind]
    return [group for group in ([c for c in range(len(models)) if c not in none], none) if group]


def _evidence(training: Training, model: CameraModel, seen: CameraViews, moved: Floats | None) -> CameraEvidence:
    """One camera's evidence. The error of a shot of many points is known well, so the points are where it says
    (`moved`); that of a single point is not, and is one more unknown of the camera."""
    errors = training.errors if training.errors is not None and not training.errors.estimated else None
    most, few = training.settings.max_points_for_sizes, training.settings.max_uncertain_points_for_sizes
    seen = thin_views(seen, most if errors is None or errors.count <= few else few)
    points = training.points if moved is None else training.points + moved
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
    q = field_coordinates(view, model.image, DepthScale.of(view, training.settings.typical_log_distance_sd))
    return CameraEvidence(seen.uv - view.uv, X, off, prior, q, seen.relative)


def size_fields(
    training: Training, models: tuple[CameraModel, ...], used: tuple[CameraViews, ...], hyper: Hyperparameters
) -> tuple[CameraModel, ...]:
    """The cameras with fields laid out anew.

    Args:
        training: What the fit starts from.
        models: The cameras.
        used: Per camera, the views to use.
        hyper: Lengthscales, signal and noise of these cameras.

    Returns:
        The cameras, whose fields have no weights yet.
    """

    def one(c: int) -> CameraModel:
        model = models[c]
        points = training.points[used[c].rows]
        view = model.camera.sight(points[:: max(1, len(points) // 4000)])
        depth = DepthScale.of(view, training.settings.typical_log_distance_sd)
        tolerance = FIELD_VARIANCE_TOLERANCE[model.camera.kind]
        field = empty_field(hyper.lengthscale[c], field_coordinates(view, model.image, depth), tolerance)
        return replace(
            model,
            field_camera=model.camera,
            depth=depth,
            field=field,
            signal=float(hyper.signal[c]),
            noise=float(hyper.noise[c]),
            weights=np.zeros((len(field.inducing), 2)),
        )

    return tuple(one(c) for c in range(len(models)))


def _joint_sizes(
    training: Training,
    models: tuple[CameraModel, ...],
    used: tuple[CameraViews, ...],
    hyper: Hyperparameters,
    groups: list[tuple[list[int], RigEvidence]],
    errors: ShotErrors,
) -> Hyperparameters:
    """Signal and noise from all cameras at once, where positions have errors of their own.

    One camera cannot tell the error of a position from its own noise; together they can, for all see the same error.
    """
    points = np.unique(np.concatenate([seen.rows for seen in used]))
    most = training.settings.max_points_for_sizes
    if len(points) > most:
        points = np.random.default_rng(0).choice(points, most, replace=False)
    some = tuple(seen.select(np.isin(seen.rows, points)) for seen in used)
    laid_out = size_fields(training, models, some, hyper)

    def loss(z: Floats) -> float:
        signal, noise = np.exp(z)
        sized = tuple(replace(m, signal=m.signal * signal, noise=m.noise * noise) for m in laid_out)
        evidence = log_evidence(sized, training.points, some, errors)
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
