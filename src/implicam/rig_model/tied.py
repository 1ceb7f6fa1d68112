"""Cameras tied by errors of single known positions, and of shots besides: eqs. (14) and (15), in few numbers.

Each camera alone, as if the positions were exact, has the covariance W^T W of its unknowns. In units of these
(*white*), what the errors take away is a symmetric matrix with eigenvalues below one, and of those that matter there
are a few dozen. So the joint covariance is block diagonal plus low rank, eq. (27), and measuring costs little more.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.geometry import Floats
from implicam.rig_model.camera_model import CameraModel, CameraViews, apply_covariance_root
from implicam.rig_model.normal_equations import camera_normals, solve_normal
from implicam.rig_model.posterior import Posterior, move_to_mean
from implicam.rig_model.schur import eliminate, unknowns_given_cameras
from implicam.rig_model.shot_errors import ShotErrors
from implicam.threads import side_by_side

POINTS_PER_CHUNK = 512
"""Points at a time: each has a row of all cameras' unknowns."""

MIN_VARIANCE_GROWTH = 1e-4
"""Relative growth of a variance by the tie below which it is left out."""

MAX_INFORMATION_LOST = 1 - 1e-12
"""At most this part of what a camera alone knows is taken away: the rest is rounding."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """How single known positions are off: `displacement of point i = size[i] root N(0, I)`, root (3, 3), size (n,)."""

    root: Floats
    size: Floats


def condition_scattered(
    models: tuple[CameraModel, ...],
    points: Floats,
    camera_views: tuple[CameraViews, ...],
    errors: ShotErrors | None,
    scatter: Scatter,
) -> Posterior:
    """As `posterior.condition`, where each known point has an error of its own.

    Args:
        models: The cameras where they are linearised, with their priors.
        points: Known positions (n, 3) in the working frame.
        camera_views: Per camera, what it saw.
        errors: Those of shots besides, all as one "shot"; or None.
        scatter: How single known positions are off.

    Returns:
        The posterior, whose models have moved to its mean; its cameras are tied by `ties`.

    Raises:
        numpy.linalg.LinAlgError: The views of a camera do not fix it.
    """
    normals = camera_normals(models, points, camera_views)
    alone = [solve_normal(normal.A, normal.b) for normal in normals]
    rig = _Rig(models, points, camera_views, errors, scatter, tuple(root for root, _, _ in alone))
    b = np.concatenate([root @ normal.b for root, normal in zip(rig.alone, normals, strict=True)])
    value = -sum(normal.squares + normal.logs + log for normal, (_, _, log) in zip(normals, alone, strict=True))
    k, P = rig.shot_unknowns, len(b)
    shots = np.eye(k, k + P + 1)  # normal equations of the shots: with themselves, with the cameras, right hand side
    M = np.zeros((P, P))
    for some in rig.displacement_equations():
        shots += some.shots
        half, squares_less_logs = eliminate(some.H, some.rest)
        value += squares_less_logs
        shots -= half[:, :k].T @ half
        M += half[:, k:-1].T @ half[:, k:-1]
        b -= half[:, k:-1].T @ half[:, -1]
    if k:
        half, squares_less_logs = eliminate(shots[None, :, :k], shots[None, :, k:])
        value += squares_less_logs
        M += half[:, :-1].T @ half[:, :-1]
        b -= half[:, :-1].T @ half[:, -1]
    lost, turned = np.linalg.eigh(M)
    lost = np.clip(lost, 0, MAX_INFORMATION_LOST)
    grown = lost / (1 - lost)
    white = b + turned @ (grown * (turned.T @ b))  # (I - M)^-1 b
    value += float(b @ white) - float(np.sum(np.log1p(-lost)))
    kept = grown > MIN_VARIANCE_GROWTH
    ties = np.sqrt(grown[kept])[:, None] * turned[:, kept].T
    unknowns = None
    if k:  # the root of the white unknowns is their own above the ties
        unknowns = unknowns_given_cameras(shots[:, :k], shots[:, k:], white, np.concatenate([np.eye(P), ties]))
    means = [root.T @ part for root, part in zip(rig.alone, rig.split(white), strict=True)]
    return Posterior(
        move_to_mean(models, means),
        rig.alone,
        None,
        tuple(mean[: model.camera.size] for model, mean in zip(models, means, strict=True)),
        0.5 * value,
        unknowns,
        rig.displacement(white, np.zeros(0) if unknowns is None else unknowns.mean),
        np.hstack([part.T @ root for part, root in zip(rig.split(ties.T), rig.alone, strict=True)]).copy(),
    )


class _DisplacementEquations(NamedTuple):
    """Normal equations of the displacements of m points: H (m, 3, 3), and rest (m, 3, k + P + 1) with the shots, the
    white unknowns of the cameras, and the right hand side; shots (k, k + P + 1), what their views say of the shots."""

    H: Floats
    rest: Floats
    shots: Floats


@dataclass(frozen=True, eq=False)
class _Rig:
    """What is given, and alone: per camera the root (P, P) of what is known of it if the positions are exact."""

    models: tuple[CameraModel, ...]
    points: Floats
    camera_views: tuple[CameraViews, ...]
    errors: ShotErrors | None
    scatter: Scatter
    alone: tuple[Floats, ...]

    @property
    def shot_unknowns(self) -> int:
        """Their number."""
        return 0 if self.errors is None else self.errors.basis.shape[2]

    def split(self, white: Floats) -> list[Floats]:
        """Into the parts of each camera, along the first axis."""
        return np.split(white, np.cumsum([len(root) for root in self.alone])[:-1])

    def displacement_equations(self) -> Iterator[_DisplacementEquations]:
        """Of some points at a time, in units of the noise and of the sds of the displacements."""
        for start in range(0, len(self.points), POINTS_PER_CHUNK):
            yield self._equations(slice(start, min(start + POINTS_PER_CHUNK, len(self.points))))

    def _equations(self, part: slice) -> _DisplacementEquations:
        """A view is of one camera: all are never beside each other in one matrix of all their unknowns, of which nearly
        everything would be zero."""
        m, k = part.stop - part.start, self.shot_unknowns
        starts = k + np.cumsum([0, *(len(root) for root in self.alone)])
        width = int(starts[-1]) + 1
        H, rest, shots = np.zeros((m, 3, 3)) + np.eye(3), np.zeros((m, 3, width)), np.zeros((k, width))
        own = self.scatter.root * self.scatter.size[part, None, None]

        def fill(c: int) -> tuple[NDArray[np.int64], Floats, Floats, Floats]:
            """Its own columns; and what it adds to those that all cameras share: shots, right hand side."""
            seen = self.camera_views[c]
            seen = seen.select((seen.rows >= part.start) & (seen.rows < part.stop))
            model = self.models[c].without_weights()
            rows = model.rows(self.points[seen.rows])
            noise = (model.noise * seen.relative)[:, None, None]
            at, columns = seen.rows - part.start, slice(starts[c], starts[c + 1])
            by_point = rows.by_point / noise
            slopes = by_point @ own[at]
            across = slopes.swapaxes(1, 2)
            white = apply_covariance_root(rows, self.alone[c]) / noise
            rest[at, :, columns] = across @ white
            shared = ((seen.uv - rows.mean) / noise[..., 0])[..., None]
            if self.errors is not None:
                shared = np.concatenate([by_point @ self.errors.scaled[seen.rows], shared], axis=2)
                flat = shared[..., :k].reshape(-1, k).T
                shots[:, columns] = flat @ white.reshape(-1, white.shape[2])
                return at, across @ slopes, across @ shared, flat @ shared.reshape(-1, k + 1)
            return at, across @ slopes, across @ shared, np.zeros((0, 1))

        ends = [*range(k), width - 1]
        for at, square, to_shared, of_shots in side_by_side(fill, range(len(self.models))):
            H[at] += square  # a camera sees a point once
            rest[at[:, None], :, ends] += to_shared.swapaxes(1, 2)
            shots[:, ends] += of_shots
        return _DisplacementEquations(H, rest, shots)

    def displacement(self, white: Floats, shots: Floats) -> Floats:
        """(n, 3) of the known points, the posterior mean, that of their shot included."""
        taken = np.concatenate([-shots, -white, [1.0]])
        parts = [np.linalg.solve(one.H, (one.rest @ taken)[..., None]) for one in self.displacement_equations()]
        found = np.concatenate(parts)[..., 0]
        found = self.scatter.size[:, None] * (found @ self.scatter.root.T)
        return found if self.errors is None else found + self.errors.scaled @ shots
