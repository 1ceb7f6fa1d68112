"""Lengthscales, size of the fields and noise, by the evidence of all cameras together, eq. (V6).

Cameras that are fitted to known points can be asked one by one (forward-gp). Here every place has taken up a part of
the noise of its own views: residuals are smaller than the noise, and correlated between cameras. So places and lenses
are integrated out first, of all cameras together; what is left is linear in the weights of the fields, and one
eigendecomposition serves all sizes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from implicam.calibrators.forward_gp.settings import ForwardGPSettings
from implicam.calibrators.forward_gp.wand.bundle import FrameEquations, WhiteRows
from implicam.calibrators.forward_gp.wand.known import Facts
from implicam.geometry import Floats
from implicam.rig_model import CameraModel, CameraViews, Hyperparameters
from implicam.rig_model.field import DepthScale, empty_field, field_coordinates

FIELD_VARIANCE_TOLERANCE = 1e-4
"""Part of the field's variance that its features may leave out."""

MAX_LENGTHSCALES_TRIED = 7

MIN_EIGENVALUE_RATIO = 1e-12


class Evidence(NamedTuple):
    """What is left of the views when places and lenses are integrated out, with the noise of the models: eigenvalues e
    (m,) of the fields, y (m,) in their basis, squares of all, and degrees of freedom."""

    e: Floats
    y: Floats
    squares: float
    degrees: float

    def __call__(self, signal: float, noise: float) -> float:
        """Minus the log evidence, in nats.

        Args:
            signal: Sd of the fields over that of the models.
            noise: Of the noise over that of the models.
        """
        v = 1 + (signal / noise) ** 2 * self.e
        quadratic = self.squares - float(np.sum(self.y**2 * (signal / noise) ** 2 / v))
        return 0.5 * (quadratic / noise**2 + float(np.sum(np.log(v)))) + self.degrees * float(np.log(noise))


def white_models(
    models: Sequence[CameraModel], places: Floats, seen: Sequence[CameraViews], *, with_fields: bool = False
) -> list[WhiteRows]:
    """The views in units of their noise, slopes by lens, pose and the weights of the field.

    Args:
        models: The C cameras where they are linearised.
        places: (2 F, 3).
        seen: Per camera the views to use.
        with_fields: Residuals are those of the cameras as they are, and not with the weights of their fields at zero.
    """
    found = []
    for model, views in zip(models, seen, strict=True):
        rows = model.without_weights().rows(places[views.rows])
        n, m = rows.phi.shape
        p = model.camera.size
        J = np.zeros((n, 2, model.size))
        J[:, :, :p], J[:, 0, p : p + m], J[:, 1, p + m :] = rows.J, rows.phi, rows.phi
        unit = (model.noise * views.relative)[:, None]
        off, J, D = (views.uv - rows.mean) / unit, J / unit[..., None], rows.by_point / unit[..., None]
        if with_fields:
            off = off - J[:, :, p:] @ model.weights.T.ravel()
        found.append(WhiteRows(views.rows, np.nan_to_num(off), np.nan_to_num(J), np.nan_to_num(D)))
    return found


def add_priors(
    equations: FrameEquations, models: Sequence[CameraModel], *, fields: bool, held: bool
) -> tuple[float, Floats]:
    """The priors of the lenses, and of the weights of the fields, into normal equations; and six numbers that say where
    the world is, if no known place does: the pose of the first camera is held.

    Args:
        equations: Of these cameras; changed.
        models: The cameras.
        fields: Whether weights have their prior too.
        held: Whether no known place says where the world is.

    Returns:
        Squares of the priors, and (P,) the precision that was added to each unknown of a lens.
    """
    start, squares, added = 0, 0.0, np.zeros(len(equations.b))
    for model in models:
        p = model.camera.size
        own, field = slice(start, start + p), slice(start + p, start + model.size)
        off = model.prior.mean - model.camera.parameters
        equations.A[own, own] += model.prior.precision
        equations.b[own] += model.prior.precision @ off
        added[own] = np.diag(model.prior.precision)
        squares += float(off @ model.prior.precision @ off)
        if fields:
            index = np.arange(field.start, field.stop)
            equations.A[index, index] += 1.0
        start += model.size
    if held:
        pose = np.arange(models[0].camera.size - 6, models[0].camera.size)
        equations.A[pose, pose] += 1e3 * equations.A[pose, pose]
    return squares, added


def size_fields(
    models: Sequence[CameraModel], places: Floats, seen: Sequence[CameraViews], hyper: Hyperparameters, typical: float
) -> tuple[CameraModel, ...]:
    """The cameras with fields laid out anew.

    Args:
        models: The cameras.
        places: (2 F, 3).
        seen: Per camera the views to use.
        hyper: Lengthscales, signal and noise.
        typical: Sd of the log distance in an ordinary rig.
    """
    sized = []
    for c, (model, views) in enumerate(zip(models, seen, strict=True)):
        view = model.camera.view(places[views.rows])
        depth = DepthScale.of(view, typical)
        field = empty_field(hyper.lengthscale[c], field_coordinates(view, model.image, depth), FIELD_VARIANCE_TOLERANCE)
        sized.append(
            replace(
                model, field_camera=model.camera, depth=depth, field=field, signal=float(hyper.signal[c]),
                noise=float(hyper.noise[c]), weights=np.zeros((len(field.inducing), 2)),
            )
        )  # fmt: skip
    return tuple(sized)


def evidence_of(models: Sequence[CameraModel], places: Floats, seen: Sequence[CameraViews], facts: Facts) -> Evidence:
    """The evidence of the sizes of fields and noise, near those of the models.

    Args:
        models: The cameras where they are linearised, with fields.
        places: (F, 2, 3).
        seen: Per camera the views to use.
        facts: Those to use.
    """
    equations = facts.equations(white_models(models, places.reshape(-1, 3), seen), places)
    held = not len(facts.known.rows)
    squares, added = add_priors(equations, models, fields=False, held=held)
    _, G, g = equations.halved()
    S, b = equations.A - G.T @ G, equations.b - G.T @ g
    squares += equations.squares - float(g @ g)
    lens = np.zeros(len(b), dtype=np.bool_)
    start = 0
    for model in models:
        lens[start : start + model.camera.size] = True
        start += model.size
    if facts.grows:
        lens[start], added[start] = True, facts.growth_sd**-2
    scale = 1 / np.sqrt(np.diag(S)[lens])
    L = np.linalg.cholesky(S[np.ix_(lens, lens)] * scale[:, None] * scale + 1e-12 * np.eye(len(scale)))
    half = np.linalg.solve(L, scale[:, None] * np.column_stack([S[np.ix_(lens, ~lens)], b[lens]]))
    M = S[np.ix_(~lens, ~lens)] - half[:, :-1].T @ half[:, :-1]
    c = b[~lens] - half[:, :-1].T @ half[:, -1]
    squares -= float(half[:, -1] @ half[:, -1])
    e, V = np.linalg.eigh(M)
    good = e > MIN_EIGENVALUE_RATIO * e[-1]
    told = float(np.sum(1 - np.minimum(added[lens] * np.sum(np.linalg.inv(L) ** 2, axis=0) * scale**2, 1)))
    told -= 6 if held else 0
    unknown = 3 * len(np.unique(np.concatenate([views.rows for views in seen])))
    degrees = 2 * sum(len(views.rows) for views in seen) + facts.numbers - unknown - told
    return Evidence(e[good], V[:, good].T @ c, squares, max(degrees, 1.0))


def estimate_sizes(
    models: Sequence[CameraModel],
    places: Floats,
    seen: Sequence[CameraViews],
    facts: Facts,
    stated: Floats,
    own: Floats,
    settings: ForwardGPSettings,
    before: Hyperparameters | None,
    *,
    search: bool,
) -> Hyperparameters:
    """The most probable lengthscales, and mean variances of fields and noise, eqs. (9) to (12).

    Args:
        models: The cameras, near their optimum.
        places: (F, 2, 3).
        seen: Per camera the views to use.
        facts: Lengths and known places to use.
        stated: (C,) stated noise, NaN where none is.
        own: (C,) log of the noise of each camera over what is stated or usual, but for a factor of all.
        settings: Priors.
        before: Those of the last round; None in the first.
        search: Look for other lengthscales.
    """
    half = np.array([model.image.half for model in models])
    usual_signal = np.exp(settings.log_signal_prior(lens=True)[0]) * half
    told = bool(np.isfinite(stated).all())
    usual = np.where(np.isfinite(stated), stated, np.exp(settings.log_noise_prior[0]) * half) * np.exp(own)
    sds = np.array(
        [settings.signal_prior_log_sd, settings.stated_noise_log_sd if told else settings.noise_prior_log_sd]
    )
    at = np.array([0.0, 0.0 if before is None else float(np.mean(np.log(before.noise / usual)))])
    noise = usual * np.exp(at[1])
    if before is not None:
        at[0] = float(np.mean(np.log(before.signal / usual_signal)))
    median, log_sd = np.log(settings.lengthscale_prior_median), np.array(settings.lengthscale_prior_log_sd)
    least, most = np.log(settings.min_lengthscale), np.log(settings.max_lengthscale)
    tried: dict[tuple[float, ...], tuple[float, Floats, Callable[[Floats], float]]] = {}
    flat = places.reshape(-1, 3)

    def value_at(log_lengthscale: Floats) -> float:
        nonlocal at
        inside = np.clip(log_lengthscale, least, most)
        hyper = Hyperparameters(np.tile(np.exp(inside), (len(models), 1)), usual_signal, noise)
        sized = size_fields(models, flat, seen, hyper, settings.typical_log_distance_sd)
        evidence = evidence_of(sized, places, seen, facts)
        base = float(np.mean(np.log(noise / usual)))

        def loss(z: Floats) -> float:
            return evidence(np.exp(z[0]), np.exp(z[1] - base)) + 0.5 * float(np.sum((z / sds) ** 2))

        simplex = at + np.array([[0, 0], [0.3, 0], [0, 0.1]])
        found = minimize(
            loss, at, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 0.01, "fatol": 0.01}
        )
        at = found.x
        value = float(found.fun + 0.5 * np.sum(((inside - median) / log_sd) ** 2))
        tried[tuple(inside)] = value, found.x, loss
        return value + float(np.sum((log_lengthscale - inside) ** 2))

    first = median if before is None else np.log(before.lengthscale[0])
    if search:
        simplex = first + (0.5 if before is None else 0.2) * np.array([[0, 0], [-1, 0.3], [0.3, -1]])
        options = {"initial_simplex": simplex, "xatol": 0.1, "fatol": 0.1, "maxfev": MAX_LENGTHSCALES_TRIED}
        minimize(value_at, first, method="Nelder-Mead", options=options)
    else:
        value_at(first)
    best = min(tried, key=lambda key: tried[key][0])
    _, z, loss = tried[best]
    larger = _spread(loss, z)
    return Hyperparameters(
        np.tile(np.exp(best), (len(models), 1)),
        usual_signal * np.exp(z[0]) * larger[0],
        usual * np.exp(z[1]) * larger[1],
    )


def _spread(loss: Callable[[Floats], float], z: Floats) -> Floats:
    """(2,) by how much sds of mean variance are larger than the most probable ones, eq. (12)."""
    h = np.array([0.1, 0.02])
    hessian, middle = np.zeros((2, 2)), loss(z)
    for i in range(2):
        d = h * np.eye(2)[i]
        hessian[i, i] = (loss(z + d) - 2 * middle + loss(z - d)) / h[i] ** 2
    plus, minus = h, h * [1, -1]
    cross = (loss(z + plus) + loss(z - plus) - loss(z + minus) - loss(z - minus)) / (4 * h[0] * h[1])
    hessian[0, 1] = hessian[1, 0] = cross
    values, vectors = np.linalg.eigh(hessian)
    return np.exp(np.diag(vectors / np.maximum(values, 1.0) @ vectors.T))
