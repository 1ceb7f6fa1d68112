"""Errors that whole shots of known positions share, eliminated from the normal equations of the cameras.

A Schur complement, shot by shot: eqs. (14) and (15).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from implicam.geometry import Floats
from implicam.rig_model.camera_model import CameraModel, CameraViews
from implicam.rig_model.normal_equations import slices, whitened_rows
from implicam.rig_model.shot_errors import ShotErrors
from implicam.threads import side_by_side


class Unknowns(NamedTuple):
    """Of all shots, in their sds: mean (shots * k,), covariance, and cross, of which `root^T cross` with the joint root
    is the covariance with the cameras' (sum P, shots * k)."""

    mean: Floats
    covariance: Floats
    cross: Floats


def views_by_shots(
    camera_views: tuple[CameraViews, ...], errors: ShotErrors
) -> Iterator[tuple[tuple[CameraViews, ...], slice]]:
    """The views of some shots at a time, so that memory does not grow with their number.

    Args:
        camera_views: Per camera, what it saw.
        errors: Which point belongs to which shot.

    Yields:
        The views of the points of some shots, per camera; and which shots these are.
    """
    for part in slices(errors.count, 512):
        inside = (errors.shot >= part.start) & (errors.shot < part.stop)
        yield tuple(seen.select(inside[seen.rows]) for seen in camera_views), part


class ShotSchurBlock(NamedTuple):
    """How some shots' unknowns meet each other and the cameras', eq. (14): H (S, k, k), g (S, k), G (S, k, sum P)."""

    H: Floats
    g: Floats
    G: Floats

    @classmethod
    def of(
        cls,
        models: tuple[CameraModel, ...],
        points: Floats,
        camera_views: tuple[CameraViews, ...],
        errors: ShotErrors,
        part: slice,
    ) -> ShotSchurBlock:
        """From the views of these shots.

        Args:
            models: The C cameras where they are linearised, of P unknowns each.
            points: Known positions (n, 3) in the working frame.
            camera_views: Per camera, what it saw of these shots.
            errors: How whole shots may be off.
            part: The S shots.

        Returns:
            What their views say, the prior of the shots' errors included.
        """
        S, k = part.stop - part.start, errors.basis.shape[2]
        found = side_by_side(
            lambda pair: _accumulate(pair[0], points, pair[1], errors, part),
            list(zip(models, camera_views, strict=True)),
        )
        H = np.eye(k) + np.sum([one.H for one in found], axis=0)
        assert H.shape == (S, k, k)
        return cls(H, np.sum([one.g for one in found], axis=0), np.concatenate([one.G for one in found], axis=2))

    @property
    def rest(self) -> Floats:
        """(S, k, sum P + 1) with the cameras, and the right hand side."""
        return np.concatenate([self.G, self.g[..., None]], axis=2)

    def unknowns(self, mean: Floats) -> Floats:
        """The posterior mean of the shots' errors, in their sds.

        Args:
            mean: (sum P,) that of the cameras.

        Returns:
            (S, k).
        """
        found = np.linalg.solve(self.H, (self.g - self.G @ mean)[..., None])[..., 0]
        return np.asarray(found, dtype=np.float64)


def eliminate(H: Floats, rest: Floats) -> tuple[Floats, float]:
    """Take unknowns out of normal equations, eq. (15).

    Args:
        H: Their own blocks (S, k, k).
        rest: The blocks (S, k, q) with all other unknowns, the right hand side last.

    Returns:
        L^-1 rest (S k, q), of H = L L^T, whose product with itself is taken from the equations of the others; and what
        it adds to twice the evidence.
    """
    L = np.linalg.cholesky(H)
    half = np.linalg.solve(L, rest).reshape(-1, rest.shape[2])
    logs = 2 * float(np.sum(np.log(np.diagonal(L, axis1=1, axis2=2))))
    return half, float(np.sum(half[:, -1] ** 2)) - logs


def unknowns_given_cameras(H: Floats, rest: Floats, mean: Floats, root: Floats) -> Unknowns:
    """What is known of the shots' errors, after that of the cameras.

    Args:
        H: Normal equations (K, K) of the shots.
        rest: (K, sum P + 1) with the cameras, and their right hand side.
        mean: (sum P,) of the cameras.
        root: (q, sum P) of the cameras' covariance.
    """
    inverse = np.linalg.inv(H)
    pull = inverse @ rest[:, :-1]
    cross = -root @ pull.T
    return Unknowns(inverse @ rest[:, -1] - pull @ mean, inverse + cross.T @ cross, cross)


def _accumulate(
    model: CameraModel, points: Floats, seen: CameraViews, errors: ShotErrors, part: slice
) -> ShotSchurBlock:
    S, k = part.stop - part.start, errors.basis.shape[2]
    p, m = model.camera.size, len(model.field.inducing)
    total = ShotSchurBlock(np.zeros((S, k, k)), np.zeros((S, k)), np.zeros((S, k, model.size)))
    start = 0
    for sd, y, J, phi, by_point in whitened_rows(model, points, seen):
        rows = seen.rows[start : start + len(sd)]
        start += len(sd)
        B = by_point @ errors.scaled[rows]  # (n, 2, k)
        if S == 1:  # all points in one sum: a matrix product
            flat = B.reshape(-1, k)
            total.H[0] += flat.T @ flat
            total.g[0] += flat.T @ y.ravel()
            total.G[0, :, :p] += flat.T @ J.reshape(-1, p)
            for axis in range(2):
                total.G[0, :, p + axis * m : p + (axis + 1) * m] += B[:, axis].T @ phi
            continue
        shot = errors.shot[rows] - part.start
        Bt = B.swapaxes(1, 2)
        np.add.at(total.H, shot, Bt @ B)
        np.add.at(total.g, shot, np.einsum("nik,ni->nk", B, y))
        np.add.at(total.G[:, :, :p], shot, Bt @ J)
        for axis in range(2):
            block = total.G[:, :, p + axis * m : p + (axis + 1) * m]
            np.add.at(block, shot, B[:, axis, :, None] * phi[:, None, :])
    return total
