"""The normal equations of one camera, eq. (13), and their stable solution."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack, solve_triangular

from implicam.geometry import Floats
from implicam.rig_model.camera_model import CameraModel, CameraViews
from implicam.threads import side_by_side

JITTERS = (0.0, 1e-13, 1e-11, 1e-9)
"""Added to a unit diagonal, one after the other, where the matrix is indefinite by rounding."""

POINTS_PER_CHUNK = 4096
"""Points at a time."""


def stable_cholesky(A: Floats) -> Floats:
    """Cholesky factors; where rounding made a matrix indefinite, of the nearest that is not.

    Args:
        A: (..., p, p) with unit diagonals.

    Returns:
        (..., p, p) lower factors.

    Raises:
        numpy.linalg.LinAlgError: Not even the largest of `JITTERS` on the diagonal helps.
    """
    for jitter in JITTERS:
        try:
            return np.asarray(np.linalg.cholesky(A + jitter * np.eye(A.shape[-1]) if jitter else A), dtype=np.float64)
        except np.linalg.LinAlgError:
            continue
    raise np.linalg.LinAlgError("the views do not fix the camera")


def invert_stack(A: Floats) -> Floats:
    """Inverses of symmetric matrices (n, k, k), NaN where there is none.

    Args:
        A: (n, k, k) symmetric.

    Returns:
        (n, k, k), symmetric; NaN where a matrix is singular or not finite.
    """
    good = np.asarray(np.isfinite(A).all(axis=(1, 2)))
    out = np.full(A.shape, np.nan)
    try:
        inverse = np.linalg.inv(A[good])
    except np.linalg.LinAlgError:  # some are singular to the last bit: find out which
        good[good] = np.linalg.matrix_rank(A[good], hermitian=True) == A.shape[1]
        inverse = np.linalg.inv(A[good])
    out[good] = 0.5 * (inverse + inverse.swapaxes(1, 2))
    return out


def camera_normals(
    models: tuple[CameraModel, ...], points: Floats, camera_views: tuple[CameraViews, ...]
) -> list[NormalEquations]:
    """The normal equations of each camera, eq. (13).

    Args:
        models: The cameras where they are linearised, with their priors.
        points: Known positions (n, 3) in the working frame.
        camera_views: Per camera, what it saw.

    Returns:
        Per camera, as if the positions were exact.
    """
    return side_by_side(lambda pair: _normal(pair[0], points, pair[1]), list(zip(models, camera_views, strict=True)))


class CameraFailedError(np.linalg.LinAlgError):
    """The views of one camera do not fix it: `number` of those being fitted."""

    def __init__(self, number: int, why: str) -> None:
        super().__init__(why)
        self.number = number


@contextmanager
def name_failing_camera(number: int) -> Iterator[None]:
    """Say which camera it was whose equations have no solution.

    Args:
        number: Of the camera, among those being fitted.

    Raises:
        CameraFailedError: For a `numpy.linalg.LinAlgError` within; one that names its camera already stays.
    """
    try:
        yield
    except CameraFailedError:
        raise
    except np.linalg.LinAlgError as error:
        raise CameraFailedError(number, str(error)) from error


class NormalEquations(NamedTuple):
    """The normal equations of one camera, eq. (13): A step = b, with the sum of squares and of the noise's logs."""

    A: Floats
    b: Floats
    squares: float
    logs: float


def _normal(model: CameraModel, points: Floats, seen: CameraViews) -> NormalEquations:
    p, m, P = model.camera.size, len(model.field.inducing), model.size
    off = model.prior.mean - model.camera.parameters
    A, b = np.zeros((P, P)), np.zeros(P)
    A[:p, :p] = model.prior.precision
    A[range(p, P), range(p, P)] = 1.0
    b[:p] = model.prior.precision @ off
    squares, logs = float(off @ b[:p]), 0.0
    for sd, y, J, phi, _ in whitened_rows(model, points, seen):
        flat = J.reshape(-1, p)
        A[:p, :p] += flat.T @ flat
        b[:p] += flat.T @ y.ravel()
        inner = phi.T @ phi
        for axis in range(2):
            block = slice(p + axis * m, p + (axis + 1) * m)
            A[block, block] += inner
            across = J[:, axis].T @ phi
            A[:p, block] += across
            A[block, :p] += across.T
            b[block] += phi.T @ y[:, axis]
        squares += float(np.sum(y**2))
        logs += 4 * float(np.sum(np.log(sd)))
    return NormalEquations(A, b, squares, logs)


def whitened_rows(
    model: CameraModel, points: Floats, seen: CameraViews
) -> Iterator[tuple[Floats, Floats, Floats, Floats, Floats]]:
    """The views of a camera in units of their noise, some at a time.

    Args:
        model: The camera where it is linearised; the weights of its field count as zero.
        points: Known positions (n, 3) in the working frame.
        seen: What the camera saw of them.

    Yields:
        Of m views in the order of `seen`: the noise (m,) in pixels; and in units of it the residuals (m, 2), and their
        slopes by the camera (m, 2, p), by the field (m, features), and by the point (m, 2, 3).
    """
    bare = model.without_weights()
    for part in slices(len(seen.rows)):
        sd = model.noise * seen.relative[part]
        rows = bare.rows(points[seen.rows[part]])
        yield (
            sd,
            (seen.uv[part] - rows.mean) / sd[:, None],
            rows.J / sd[:, None, None],
            rows.phi / sd[:, None],
            rows.by_point / sd[:, None, None],
        )


def solve_normal(A: Floats, b: Floats) -> tuple[Floats, Floats, float]:
    """Solve normal equations, scaled first, since lens parameters differ by many orders of magnitude.

    Args:
        A: (P, P).
        b: (P,).

    Returns:
        Root W (P, P) of the covariance W^T W = A^-1, the mean (P,), and the log determinant of A.

    Raises:
        numpy.linalg.LinAlgError: A is not finite, or the views do not fix the camera.
    """
    L, scale = _scaled_cholesky(A)
    root = np.ascontiguousarray(lapack.dtrtri(L, lower=1)[0] * scale)  # a third of the work of solving for a matrix
    return root, root.T @ (root @ b), float(2 * np.sum(np.log(np.diag(L) / scale)))


def eliminate_camera(normal: NormalEquations, across: Floats) -> tuple[Floats, float]:
    """Take a camera out of normal equations that it shares with others.

    Args:
        normal: Its own.
        across: The blocks (q, P) with the others.

    Returns:
        L^-1 of those (P, q) and of its right hand side (P,), side by side; and what it adds to twice the evidence.

    Raises:
        numpy.linalg.LinAlgError: The views do not fix it.
    """
    L, scale = _scaled_cholesky(normal.A)
    half = solve_triangular(L, scale[:, None] * np.column_stack([across.T, normal.b]), lower=True)
    logs = 2 * float(np.sum(np.log(np.diag(L) / scale)))
    return np.asarray(half, dtype=np.float64), float(np.sum(half[:, -1] ** 2)) - logs


def _scaled_cholesky(A: Floats) -> tuple[Floats, Floats]:
    """L (P, P) and scale (P,) of `scale A scale = L L^T`, with a unit diagonal."""
    if not np.isfinite(A).all():
        raise np.linalg.LinAlgError("a camera has turned its back on points that it saw")
    scale = 1 / np.sqrt(np.diag(A))
    return stable_cholesky(A * scale[:, None] * scale), np.asarray(scale, dtype=np.float64)


def slices(n: int, size: int = POINTS_PER_CHUNK) -> Iterator[slice]:
    """Slices of rows, so many at a time.

    Args:
        n: Number of rows.
        size: Rows in each slice; the last may have fewer.

    Yields:
        The slices, in order.
    """
    for start in range(0, n, size):
        yield slice(start, min(start + size, n))
