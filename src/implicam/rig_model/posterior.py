"""What is known of every camera after seeing the known points: one joint normal distribution, eqs. (13) to (15), (17).

The unknowns of a camera are its lens and pose (a step from where it is linearised) and the weights of its residual
field, first of u, then of v. Where known positions are exact, cameras are independent. Where positions have an error,
of a point or of a whole shot, all cameras see the same error: it is eliminated shot by shot, and what is left ties the
cameras together. Work and memory grow linearly with the number of points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from implicam.geometry import Floats
from implicam.rig_model.camera_model import CameraModel, CameraViews
from implicam.rig_model.normal_equations import (
    NormalEquations,
    camera_normals,
    eliminate_camera,
    name_failing_camera,
    solve_normal,
)
from implicam.rig_model.schur import ShotSchurBlock, Unknowns, eliminate, unknowns_given_cameras, views_by_shots
from implicam.rig_model.shot_errors import ShotErrors


@dataclass(frozen=True, eq=False)
class Posterior:
    """All cameras and what is unknown of them.

    Covariances are kept as *roots* W with `covariance = W^T W`: where parameters nearly make up for each other (focal
    length and distance of a telephoto lens) the covariance itself would lose all digits of what pixels show.

    Attributes:
        models: The cameras at the posterior mean.
        alone: Roots (P, P) of each camera, if the known positions were where they seem now.
        joint: The root (sum P, sum P) where errors of whole shots tie the cameras; else None.
        steps: How far the lens and pose of each camera moved.
        evidence: Log marginal likelihood, up to a constant.
        unknowns: What is known of the errors of shots, where they are estimated.
        displacement: (n, 3) posterior mean of how far the known points are off, where they are.
        ties: (q, sum P) instead of joint, where single known positions are off: the roots of the cameras alone above
            these rows are the joint root, eq. (27).
    """

    models: tuple[CameraModel, ...]
    alone: tuple[Floats, ...]
    joint: Floats | None = None
    steps: tuple[Floats, ...] = ()
    evidence: float = 0.0
    unknowns: Unknowns | None = None
    displacement: Floats | None = None
    ties: Floats | None = None

    @cached_property
    def errors_known(self) -> bool:
        """Whether anything is known of the errors of the cameras; not where another program calibrated them, and they
        are taken as they are."""
        return any(self.root(c).any() for c in range(len(self.models)))

    @property
    def tied(self) -> bool:
        """Whether errors of known positions, or boards, tie the cameras."""
        return self.joint is not None or self.ties is not None

    def root(self, c: int) -> Floats:
        """A root of the covariance of a camera's unknowns, everything included.

        Where cameras are tied, the roots of all have the same rows, and their products are the covariances between
        cameras.

        Args:
            c: Number of the camera in `models`.

        Returns:
            (rows, P), W of the covariance W^T W.
        """
        start, end = self.offsets[c : c + 2]
        if self.ties is not None:
            own = np.zeros((self.offsets[-1] + len(self.ties), end - start))
            own[start:end], own[self.offsets[-1] :] = self.alone[c], self.ties[:, start:end]
            return own
        return self.alone[c] if self.joint is None else self.joint[:, start:end]

    def shared_root(self, c: int) -> Floats:
        """The part of the root by which a camera is tied to the others; there must be ties.

        Args:
            c: Number of the camera in `models`.

        Returns:
            (q, P).
        """
        start, end = self.offsets[c : c + 2]
        both = self.joint if self.ties is None else self.ties
        assert both is not None
        return both[:, start:end]

    @property
    def offsets(self) -> list[int]:
        """Where each camera's unknowns start."""
        ends = np.cumsum([model.size for model in self.models])
        return [0, *map(int, ends)]


def condition(
    models: tuple[CameraModel, ...], points: Floats, camera_views: tuple[CameraViews, ...], errors: ShotErrors | None
) -> Posterior:
    """The posterior from known points and what each camera saw, eqs. (13) to (15).

    Args:
        models: The cameras where they are linearised, with their priors.
        points: Known positions (n, 3) in the working frame.
        camera_views: Per camera, what it saw.
        errors: How whole shots may be off; None where known positions are exact.

    Returns:
        The posterior, whose models have moved to its mean, so that a second call linearises there.

    Raises:
        CameraFailedError: The views of a camera do not fix it.
    """
    normals = camera_normals(models, points, camera_views)
    if errors is None:
        return _condition_independent(models, normals)
    return _condition_tied(models, points, camera_views, normals, errors)


def log_evidence(
    models: tuple[CameraModel, ...], points: Floats, camera_views: tuple[CameraViews, ...], errors: ShotErrors
) -> float:
    """As `condition(...).evidence`, of shots with few unknowns. Cameras are eliminated first, one by one, and the shots
    are left: work grows linearly with the cameras, and their joint covariance is never made.

    Args:
        models: The cameras where they are linearised, with their priors.
        points: Known positions (n, 3) in the working frame.
        camera_views: Per camera, what it saw.
        errors: How whole shots may be off.

    Raises:
        CameraFailedError: The views of a camera do not fix it.
    """
    normals = camera_normals(models, points, camera_views)
    k = errors.basis.shape[2]
    shots = np.unique(np.concatenate([errors.shot[seen.rows] for seen in camera_views]))
    H, g = np.eye(k * len(shots)), np.zeros(k * len(shots))
    value = -sum(normal.squares + normal.logs for normal in normals)
    for c, (normal, seen) in enumerate(zip(normals, camera_views, strict=True)):
        own = np.unique(errors.shot[seen.rows])
        block = ShotSchurBlock.of((models[c],), points, (seen,), errors.only(own), slice(0, len(own)))
        with name_failing_camera(c):
            half, squares_less_logs = eliminate_camera(normal, block.G.reshape(k * len(own), -1))
        value += squares_less_logs
        at = k * np.searchsorted(shots, own)[:, None] + np.arange(k)  # (own, k)
        H[at[:, :, None], at[:, None, :]] += block.H - np.eye(k)
        at = at.ravel()
        both = slice(None) if len(own) == len(shots) else np.ix_(at, at)  # a slice is copied four times faster
        H[both] -= half[:, :-1].T @ half[:, :-1]
        g[at] += block.g.ravel() - half[:, :-1].T @ half[:, -1]
    return 0.5 * (value + eliminate(H[None], g[None, :, None])[1])


def _condition_independent(models: tuple[CameraModel, ...], normals: list[NormalEquations]) -> Posterior:
    """Known positions are exact: every camera on its own, eq. (13)."""
    value, means, roots = 0.0, [], []
    for c, normal in enumerate(normals):
        with name_failing_camera(c):
            root, mean, log_determinant = solve_normal(normal.A, normal.b)
        value += 0.5 * (float(normal.b @ mean) - log_determinant - normal.squares - normal.logs)
        means.append(mean)
        roots.append(root)
    return Posterior(move_to_mean(models, means), tuple(roots), None, _steps(models, means), value)


def _condition_tied(
    models: tuple[CameraModel, ...],
    points: Floats,
    camera_views: tuple[CameraViews, ...],
    normals: list[NormalEquations],
    errors: ShotErrors,
) -> Posterior:
    """All cameras see the same errors of the known positions, eqs. (14) and (15)."""
    ends = np.cumsum([normal.b.size for normal in normals])
    A, b = block_diag(*(normal.A for normal in normals)), np.concatenate([normal.b for normal in normals])
    value = -sum(normal.squares + normal.logs for normal in normals)
    parts = list(views_by_shots(camera_views, errors))

    def meeting(seen: tuple[CameraViews, ...], part: slice) -> ShotSchurBlock:
        return ShotSchurBlock.of(models, points, seen, errors, part)

    kept = meeting(*parts[0]) if len(parts) == 1 else None  # of many, each is made twice and never kept
    alone = []
    for c, normal in enumerate(normals):
        with name_failing_camera(c):
            alone.append(solve_normal(normal.A, normal.b)[0])
    for each in parts:
        block = kept or meeting(*each)
        half, squares_less_logs = eliminate(block.H, block.rest)
        A -= half[:, :-1].T @ half[:, :-1]
        b -= half[:, :-1].T @ half[:, -1]
        value += squares_less_logs
    joint, mean, log_determinant = solve_normal(A, b)
    value += float(b @ mean) - log_determinant
    means = np.split(mean, ends[:-1])
    found = np.concatenate([(kept or meeting(*each)).unknowns(mean) for each in parts])
    displacement = np.asarray(np.einsum("nik,nk->ni", errors.scaled, found[errors.shot]), dtype=np.float64)
    unknowns = None
    if kept is not None and errors.estimated:
        unknowns = unknowns_given_cameras(block_diag(*kept.H), np.concatenate(kept.rest), mean, joint)
    return Posterior(
        move_to_mean(models, means), tuple(alone), joint, _steps(models, means), 0.5 * value, unknowns, displacement
    )


def move_to_mean(models: tuple[CameraModel, ...], means: list[Floats]) -> tuple[CameraModel, ...]:
    """Each camera at its posterior mean, the weights of its field too.

    Args:
        models: The cameras where they are linearised.
        means: Per camera (P,), the step of its lens and pose, then the weights of its field.

    Returns:
        The cameras moved.
    """
    return tuple(
        replace(
            model,
            camera=model.camera.moved(mean[: model.camera.size]),
            weights=np.ascontiguousarray(mean[model.camera.size :].reshape(2, -1).T),
        )
        for model, mean in zip(models, means, strict=True)
    )


def _steps(models: tuple[CameraModel, ...], means: list[Floats]) -> tuple[Floats, ...]:
    return tuple(mean[: model.camera.size] for model, mean in zip(models, means, strict=True))
