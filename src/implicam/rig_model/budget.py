"""Where the uncertainty of a position comes from: a budget as the GUM has it; eq. (B1) of docs/method.md.

About a position, its error is linear in the pixel noise and in what is unknown of the cameras. With the weights of the
measurement each source passes through the same gain, and so their variances add up to that of the position.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from implicam.geometry import Bools, Floats
from implicam.rig_model.camera_model import CameraModel, apply_covariance_root
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.triangulate import Labels, covariance_of_world

SOURCES = ("pixel noise", "lens and pose", "lens misfit", "known positions")
"""Of an error: the views that measure; what too few known points with noisy views leave unknown of each camera's lens
and pose; what no lens model holds; and errors of the known positions themselves."""


@dataclass(frozen=True, eq=False)
class Budget:
    """Of n positions.

    Attributes:
        cov: (sources, n, 3, 3) part of each of `SOURCES`; NaN where a position cannot be measured.
    """

    cov: Floats

    @property
    def variance(self) -> Floats:
        """(n, sources) mean over the axes."""
        return np.asarray(np.trace(self.cov, axis1=2, axis2=3).T / 3, dtype=np.float64)

    @property
    def total(self) -> Floats:
        """(n, 3, 3)."""
        return np.asarray(self.cov.sum(axis=0), dtype=np.float64)


def uncertainty_budget(
    posterior: Posterior, points: Floats, noise: Floats, misfit: Floats, seen: Bools, labels: Labels | None
) -> Budget:
    """Where the uncertainty of positions would come from, if they were measured.

    Args:
        posterior: What is known of the C cameras.
        points: (n, 3) in the working frame.
        noise: (C,) sd of a view, pixels, the misfit included.
        misfit: (C,) of it, what the lens model leaves.
        seen: (n, C) which cameras see them.
        labels: How known positions are off; None where they are not.

    Returns:
        In the working frame.
    """
    n, C = seen.shape
    D, own = np.zeros((n, C, 2, 3)), np.zeros((n, C, 3))
    halves = []
    for c, model in enumerate(posterior.models):
        rows, slope = model.rows_and_slope(points)
        D[:, c] = np.where(seen[:, c, None, None], slope, 0.0)
        own[:, c] = np.stack(
            [np.full(n, noise[c] ** 2 - misfit[c] ** 2), rows.rest + misfit[c] ** 2, rows.rest], axis=1
        )
        roots = posterior.root(c), posterior.alone[c], _lens_and_pose(posterior.alone[c], model)
        halves.append([np.where(seen[:, c, None, None], apply_covariance_root(rows, root), 0.0) for root in roots])
    everything, alone, lens = (
        _covariance([half[i] for half in halves], together=i == 0 and posterior.tied) for i in range(3)
    )
    views = (own[:, :, 0] + own[:, :, 1]).repeat(2, axis=1)
    unseen = ~seen.repeat(2, axis=1)
    S = everything + np.einsum("ni,ij->nij", np.where(unseen, 1.0, views), np.eye(2 * C))
    slope = D.reshape(n, 2 * C, 3)
    W = np.linalg.inv(np.where(np.isfinite(S), S, np.eye(2 * C)))
    WD = W @ np.nan_to_num(slope)
    enough = (seen.sum(axis=1) >= 2) & np.isfinite(S).all(axis=(1, 2))
    information = np.where(enough[:, None, None], np.nan_to_num(slope).swapaxes(1, 2) @ WD, np.eye(3))
    gain = np.linalg.solve(information, WD.swapaxes(1, 2))
    gain[~enough] = np.nan

    def through(variance: Floats) -> Floats:
        return np.asarray(gain @ variance @ gain.swapaxes(1, 2), dtype=np.float64)

    def of_views(k: int) -> Floats:
        return through(np.einsum("ni,ij->nij", np.where(unseen, 0.0, own[:, :, k].repeat(2, axis=1)), np.eye(2 * C)))

    parts = np.stack([of_views(0), through(lens), of_views(1) + through(alone - lens), through(everything - alone)])
    if labels is not None:
        views_noise = np.broadcast_to(noise, seen.shape)
        parts[3] += covariance_of_world(posterior, points, views_noise, seen, parts.sum(axis=0), labels)
    return Budget(parts)


def _lens_and_pose(root: Floats, model: CameraModel) -> Floats:
    """(rows, P) of lens and pose if the field's weights were known: what is left when these are taken first."""
    p = model.camera.size
    order = [*range(p, root.shape[1]), *range(p)]
    R = qr(root[:, order], mode="r")[0]
    left = np.zeros((max(len(R) - (root.shape[1] - p), 0), root.shape[1]))
    left[:, :p] = R[root.shape[1] - p :, root.shape[1] - p :][: len(left)]
    return left


def _covariance(halves: list[Floats], *, together: bool) -> Floats:
    """(n, 2 C, 2 C) of halves (n, 2, q) of each camera, which have the same unknowns or each its own."""
    if together:
        half = np.concatenate(halves, axis=1)
        return np.asarray(half @ half.swapaxes(1, 2), dtype=np.float64)
    n, C = len(halves[0]), len(halves)
    found = np.zeros((n, C, 2, C, 2))
    for c, half in enumerate(halves):
        found[:, c, :, c] = half @ half.swapaxes(1, 2)
    return found.reshape(n, 2 * C, 2 * C)
