"""Gauss-Newton: the posterior, linearised where it ends, eqs. (6) and (13)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from implicam.geometry import Floats
from implicam.rig_model.camera import Prior
from implicam.rig_model.camera_model import CameraModel, CameraViews, thin_views
from implicam.rig_model.general_camera import AnyCamera
from implicam.rig_model.normal_equations import CameraFailedError
from implicam.rig_model.posterior import Posterior, condition
from implicam.rig_model.shot_errors import ShotErrors
from implicam.rig_model.tied import Scatter, condition_scattered
from implicam.threads import side_by_side

MAX_GAUSS_NEWTON_STEPS = 15
"""Gauss-Newton steps of the cameras; ordinary ones take one to four."""

MAX_MISFIT_VIEWS = 1000
"""Views that say whether a step is for the better."""

MISFIT_TOLERANCE = 1e-3
"""By how much a step may worsen minus twice the log posterior: rounding."""

SAMPLING_SDS = 4.0
"""Some of the views may call a step worse that all of them ask for; by so many sds of what that is by chance."""


def iterate_linearisation(
    models: tuple[CameraModel, ...],
    points: Floats,
    used: tuple[CameraViews, ...],
    errors: ShotErrors | None,
    scatter: Scatter | None = None,
) -> Posterior:
    """The posterior, linearised where it ends: Gauss-Newton for the lens, exact for the field.

    Args:
        models: The cameras to start from, with their fields laid out.
        points: Known positions (n, 3) in the working frame.
        used: Per camera, the views to use.
        errors: How whole shots may be off; None where they are not.
        scatter: How single known positions are off; None where they are not.

    Raises:
        CameraFailedError: The views of a camera do not fix it.
    """
    if errors is None and scatter is None and len(models) > 1:
        return _linearise_alone(models, points, used)
    misfits: list[_Misfit] = []
    for _ in range(MAX_GAUSS_NEWTON_STEPS):
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


def _linearise_alone(models: tuple[CameraModel, ...], points: Floats, used: tuple[CameraViews, ...]) -> Posterior:
    """The same where known positions are exact: no camera takes part in the steps that another still needs."""

    def one(c: int) -> Posterior:
        try:
            return iterate_linearisation((models[c],), points, (used[c],), None)
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


class _Misfit(NamedTuple):
    """How badly a camera fits, with the field that then fits best: what Gauss-Newton must not increase.

    prior; points (n, 3), pixels (n, 2) and sd (n,) of at most MAX_MISFIT_VIEWS views; phi (n, m) the field's features
    over sd, and the Cholesky factor (m, m) of I + phi^T phi; left_out, the part of all views that these are not.
    """

    prior: Prior
    points: Floats
    uv: Floats
    sd: Floats
    phi: Floats
    factor: Floats
    left_out: float

    @classmethod
    def of(cls, model: CameraModel, points: Floats, seen: CameraViews) -> _Misfit:
        """Of the camera's present field."""
        every = len(seen.rows)
        seen = thin_views(seen, MAX_MISFIT_VIEWS)
        where = points[seen.rows]
        sd = model.noise * seen.relative
        phi = model.rows(where).phi / sd[:, None]
        factor = np.asarray(np.linalg.cholesky(np.eye(phi.shape[1]) + phi.T @ phi), dtype=np.float64)
        return cls(model.prior, where, seen.uv, sd, phi, factor, 1 - len(seen.rows) / max(every, 1))

    def __call__(self, camera: AnyCamera) -> float:
        """Minus twice the log posterior, up to a constant; infinite where the camera loses a point."""
        y = self._residuals(camera)
        if not (camera.sane and np.isfinite(y).all()):
            return np.inf
        off = self.prior.mean - camera.parameters
        return self._squares_beside_field(y) + float(off @ self.prior.precision @ off)

    def worsened_by_chance(self, before: AnyCamera, after: AnyCamera) -> float:
        """By how much these views may call a step worse that is for the better by all views: their slope where all of
        them are best is that of a random part, and 2 sqrt(length^2 left_out) its sd along a step of that length."""
        moved = self._residuals(after) - self._residuals(before)
        return SAMPLING_SDS * 2 * float(np.sqrt(self.left_out * max(self._squares_beside_field(moved), 0.0)))

    def _residuals(self, camera: AnyCamera) -> Floats:
        return np.asarray((self.uv - camera.pixel(self.points)) / self.sd[:, None])

    def _squares_beside_field(self, y: Floats) -> float:
        """What the field that fits best leaves of residuals (n, 2)."""
        field = np.linalg.solve(self.factor, self.phi.T @ y)
        return float(np.sum(y**2) - np.sum(field**2))

    def weights(self, camera: AnyCamera) -> Floats:
        """(m, 2) of the field that then fits best: those of a whole step do not belong to half of it."""
        y = self._residuals(camera)
        return np.asarray(np.linalg.solve(self.factor.T, np.linalg.solve(self.factor, self.phi.T @ y)))


def _downhill(
    before: CameraModel, after: CameraModel, step: Floats, points: Floats, misfit: _Misfit | None
) -> CameraModel:
    """A camera never steps so far that it loses a point it saw, or fits worse: half the step, then, or half of that."""
    now = np.inf if misfit is None else misfit(before.camera)
    for halvings in range(20):
        camera = after.camera if halvings == 0 else before.camera.moved(step * 0.5**halvings)
        if (
            (misfit is None or _fits(misfit, before.camera, camera, now))
            and camera.sane
            and np.isfinite(camera.pixel(points)).all()
        ):
            if halvings == 0:
                return after
            return replace(after, camera=camera, weights=after.weights if misfit is None else misfit.weights(camera))
    return before if misfit is None else replace(before, weights=misfit.weights(before.camera))


def _fits(misfit: _Misfit, before: AnyCamera, after: AnyCamera, now: float) -> bool:
    found, most = misfit(after), now + MISFIT_TOLERANCE
    return found <= most or (np.isfinite(found) and found <= most + misfit.worsened_by_chance(before, after))


def _small(step: Floats, root: Floats) -> bool:
    sd = np.sqrt(np.sum(root[:, : len(step)] ** 2, axis=0))
    return bool(np.all(np.abs(step) <= 0.02 * sd))
