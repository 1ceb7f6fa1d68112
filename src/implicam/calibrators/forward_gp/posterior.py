"""What is known of every camera after seeing the known points: one joint normal distribution, eqs. (13) to (17).

The unknowns of a camera are its lens and pose (a step from where it is linearised) and the weights of its residual
field, first of u, then of v. Where known positions are exact, cameras are independent. Where positions have an error,
of a point or of a whole shot, all cameras see the same error: it is eliminated shot by shot, and what is left ties the
cameras together. Work and memory grow linearly with the number of points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.forward_gp.evidence import field_kernel
from implicam.calibrators.forward_gp.lens import AnyCamera, Floats, Image, Prior, View
from implicam.gp.low_rank import LowRank
from implicam.threads import side_by_side

CHUNK = 4096
"""Points at a time."""

LIKELY = (np.log(3e-3), 1.0)
"""Prior of how far a shot is off, median and log sd, in the working frame: a thousandth of the volume's size."""


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A camera, its residual field and its noise; weights (m, 2) of the field's features, zero before the fit."""

    camera: AnyCamera
    prior: Prior
    image: Image
    field: LowRank
    signal: float  # px
    noise: float  # px, of a view with the camera's usual noise
    weights: Floats

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.camera.size + 2 * len(self.field.inducing)

    def coordinates(self, view: View) -> Floats:
        """(n, 3) where the field is looked up: pixel about the centre in half the longer side, log distance."""
        return np.column_stack([(view.uv - self.image.centre) / self.image.half, view.log_distance])

    @cached_property
    def _coefficients(self) -> Floats:
        return self.field.coefficients(self.signal * self.weights)

    def predict(self, points: Floats) -> tuple[Floats, Floats]:
        """Mean pixels (n, 2) and their derivative by the point (n, 2, 3); NaN where the lens has no answer."""
        view = self.camera.view(points)
        q = self.coordinates(view)
        K = self.field.kernel(q, self.field.inducing)
        by_q = self.field.slope(q, K, self._coefficients)
        by_point = (
            view.by_point
            + by_q[:, :, :2] @ (view.by_point / self.image.half)
            + by_q[:, :, 2, None] * view.distance_by_point[:, None, :]
        )
        return view.uv + K @ self._coefficients, by_point

    def rows(self, points: Floats) -> Rows:
        """How the pixels of points (n, 3) depend on the camera's unknowns, about the present mean."""
        view = self.camera.view(points)
        q = self.coordinates(view)
        K = self.field.kernel(q, self.field.inducing)
        phi = self.field.features_from(K)
        left = np.maximum(1 - np.sum(phi**2, axis=1), 0)
        mean = view.uv + K @ self._coefficients
        return Rows(mean, view.by_parameters, self.signal * phi, self.signal**2 * left, view.by_point)


class Rows(NamedTuple):
    """pixel = mean + J step + phi (weights - their mean) + rest + noise, for n points.

    mean (n, 2); J (n, 2, p); phi (n, m), the same for u and v; rest (n,) variance the features leave, px^2; by_point
    (n, 2, 3).
    """

    mean: Floats
    J: Floats
    phi: Floats
    rest: Floats
    by_point: Floats


class Sightings(NamedTuple):
    """What one camera saw: rows (n,) of the points, uv (n, 2), relative (n,) noise over the camera's."""

    rows: NDArray[np.int64]
    uv: Floats
    relative: Floats

    def select(self, keep: NDArray[np.bool_]) -> Sightings:
        """Some of them."""
        return Sightings(self.rows[keep], self.uv[keep], self.relative[keep])


@dataclass(frozen=True, eq=False)
class ShotErrors:
    """How known positions may be off: `displacement of point i = basis[i] @ (sd of its shot * unknowns N(0, 1))`.

    shot (n,) number of the point's shot; basis (n, 3, k) in the working frame; sd (shots, k). group (k,): components
    with the same number >= 0 have one sd that is estimated; -1 is declared and stays.
    """

    shot: NDArray[np.int64]
    basis: Floats
    sd: Floats
    group: NDArray[np.int64]

    @cached_property
    def scaled(self) -> Floats:
        """(n, 3, k) displacement of each point by one standard deviation of each component."""
        return self.basis * self.sd[self.shot][:, None, :]

    @property
    def count(self) -> int:
        """Number of shots."""
        return len(self.sd)

    @property
    def estimated(self) -> bool:
        """Whether any sd is estimated."""
        return bool((self.group >= 0).any())

    def updated(self, mean: Floats, variance: Floats) -> tuple[ShotErrors, Floats]:
        """With more probable sds, from the posterior of the unknowns (shots, k) in sds: one step of EM, eq. (17); and
        (shots, k) the sds for error bars.

        With few shots the most probable sd is too small for error bars: as for the noise, eq. (12), they are made of
        the mean variance.
        """
        second = (mean**2 + variance) * self.sd**2
        sd, mean_sd = self.sd.copy(), self.sd.copy()
        for number in np.unique(self.group[self.group >= 0]):
            members = self.group == number
            n, total = second[:, members].size, float(second[:, members].sum())
            u = 0.5 * np.log(total / n)
            for _ in range(30):  # Newton; the log posterior is concave in u = log sd
                pull = total * np.exp(-2 * u)
                u -= (n - pull + (u - LIKELY[0]) / LIKELY[1] ** 2) / (2 * pull + 1 / LIKELY[1] ** 2)
            told = float(np.sum(1 - np.minimum(variance[:, members], 1)))  # of n, how many the data tell
            sd[:, members] = np.exp(u)
            mean_sd[:, members] = np.exp(u + 1 / (2 * told + 1 / LIKELY[1] ** 2))
        return replace(self, sd=sd), mean_sd


class Unknowns(NamedTuple):
    """Of all shots, in their sds: mean (shots * k,), covariance, and cross, (sum P, shots * k), with the cameras'."""

    mean: Floats
    covariance: Floats
    cross: Floats


@dataclass(frozen=True, eq=False)
class Posterior:
    """All cameras and what is unknown of them.

    covariances: per camera (P, P); alone: the same if the known positions were where they seem now; joint:
    (sum P, sum P) where the cameras are tied, else None. steps: how far each lens moved. evidence: log marginal
    likelihood, up to a constant. displacement: (n, 3) of the known points, the posterior mean.
    """

    models: tuple[CameraModel, ...]
    covariances: tuple[Floats, ...]
    alone: tuple[Floats, ...]
    joint: Floats | None
    steps: tuple[Floats, ...]
    evidence: float
    unknowns: Unknowns | None = None
    displacement: Floats | None = None

    @property
    def offsets(self) -> list[int]:
        """Where each camera's unknowns start."""
        ends = np.cumsum([model.size for model in self.models])
        return [0, *map(int, ends)]


def condition(
    models: tuple[CameraModel, ...], points: Floats, sightings: tuple[Sightings, ...], errors: ShotErrors | None
) -> Posterior:
    """The posterior from known points (n, 3) and what each camera saw, eqs. (13) to (15).

    The models returned have moved to the posterior mean, so that a second call linearises there.
    """
    normals = side_by_side(
        lambda pair: _normal(pair[0], points, pair[1], errors), list(zip(models, sightings, strict=True))
    )
    if errors is None:
        return _independent(models, normals)
    return _tied(models, normals, errors)


def _independent(models: tuple[CameraModel, ...], normals: list[_Normal]) -> Posterior:
    """Known positions are exact: every camera on its own, eq. (13)."""
    value, means, covariances = 0.0, [], []
    for normal in normals:
        covariance, mean, log_determinant = _solve(normal.A, normal.b)
        value += 0.5 * (float(normal.b @ mean) - log_determinant - normal.squares - normal.logs)
        means.append(mean)
        covariances.append(covariance)
    alone = tuple(covariances)
    return Posterior(_moved(models, means), alone, alone, None, _steps(models, means), value)


def _tied(models: tuple[CameraModel, ...], normals: list[_Normal], errors: ShotErrors) -> Posterior:
    """All cameras see the same errors of the known positions, eqs. (14) and (15)."""
    A, b, squares, logs = _without_shots(normals, errors)
    joint, mean, log_determinant = _solve(A, b)
    value = float(b @ mean) - log_determinant + squares - logs - sum(n.squares + n.logs for n in normals)
    ends = np.cumsum([normal.b.size for normal in normals])
    means = np.split(mean, ends[:-1])
    covariances = tuple(np.array(joint[e - len(m) : e, e - len(m) : e]) for e, m in zip(ends, means, strict=True))
    alone = tuple(_solve(normal.A, normal.b)[0] for normal in normals)
    H, g, G = _shots(normals, slice(None))
    each = np.linalg.solve(H, (g - G @ mean)[..., None])[..., 0]
    displacement = np.asarray(np.einsum("nik,nk->ni", errors.scaled, each[errors.shot]), dtype=np.float64)
    unknowns = _unknowns(normals, means, joint) if errors.estimated else None
    return Posterior(
        _moved(models, means), covariances, alone, joint, _steps(models, means), 0.5 * value, unknowns, displacement
    )


def _moved(models: tuple[CameraModel, ...], means: list[Floats]) -> tuple[CameraModel, ...]:
    """Each camera at its posterior mean, the weights of its field too."""
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


@dataclass(eq=False)
class _Normal:
    """The normal equations of one camera, and how they meet the shots' unknowns: eq. (14)."""

    A: Floats
    b: Floats
    squares: float
    logs: float
    H: Floats | None = None  # (shots, k, k)
    g: Floats | None = None  # (shots, k)
    G: Floats | None = None  # (shots, k, P)


def _normal(model: CameraModel, points: Floats, seen: Sightings, errors: ShotErrors | None) -> _Normal:
    p, m, P = model.camera.size, len(model.field.inducing), model.size
    off = model.prior.mean - model.camera.parameters
    A, b = np.zeros((P, P)), np.zeros(P)
    A[:p, :p] = model.prior.precision
    A[range(p, P), range(p, P)] = 1.0
    b[:p] = model.prior.precision @ off
    total = _Normal(A, b, float(off @ b[:p]), 0.0)
    if errors is not None:
        k = errors.basis.shape[2]
        total.H, total.g = np.zeros((errors.count, k, k)), np.zeros((errors.count, k))
        total.G = np.zeros((errors.count, k, P))
    bare = replace(model, weights=np.zeros_like(model.weights))
    for part in _chunks(len(seen.rows)):
        index, sd = seen.rows[part], model.noise * seen.relative[part]
        rows = bare.rows(points[index])
        y, J, phi = (seen.uv[part] - rows.mean) / sd[:, None], rows.J / sd[:, None, None], rows.phi / sd[:, None]
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
        total.squares += float(np.sum(y**2))
        total.logs += 4 * float(np.sum(np.log(sd)))
        if errors is not None:
            _meet_shots(total, errors, index, rows.by_point / sd[:, None, None], y, J, phi)
    return total


def _meet_shots(
    total: _Normal, errors: ShotErrors, index: NDArray[np.int64], D: Floats, y: Floats, J: Floats, phi: Floats
) -> None:
    assert total.H is not None
    assert total.g is not None
    assert total.G is not None
    p, m = J.shape[2], phi.shape[1]
    B = D @ errors.scaled[index]  # (n, 2, k)
    shot = errors.shot[index]
    order = np.argsort(shot, kind="stable")
    shots, starts = np.unique(shot[order], return_index=True)

    def summed(values: Floats) -> Floats:
        return np.asarray(np.add.reduceat(values[order], starts, axis=0), dtype=np.float64)

    Bt = B.swapaxes(1, 2)
    total.H[shots] += summed(Bt @ B)
    total.g[shots] += summed(np.einsum("nik,ni->nk", B, y))
    total.G[shots, :, :p] += summed(Bt @ J)
    for axis in range(2):
        total.G[shots, :, p + axis * m : p + (axis + 1) * m] += summed(B[:, axis, :, None] * phi[:, None, :])


def _without_shots(normals: list[_Normal], errors: ShotErrors) -> tuple[Floats, Floats, float, float]:
    """The joint normal equations after the shots' unknowns are eliminated, eq. (15)."""
    sizes = [normal.b.size for normal in normals]
    ends = np.cumsum(sizes)
    A, b = np.zeros((ends[-1], ends[-1])), np.concatenate([normal.b for normal in normals])
    for normal, end in zip(normals, ends, strict=True):
        A[end - len(normal.A) : end, end - len(normal.A) : end] = normal.A
    squares = logs = 0.0
    for part in _chunks(errors.count, 512):
        H, g, G = _shots(normals, part)
        L = np.linalg.cholesky(H)
        half = np.linalg.solve(L, np.concatenate([G, g[..., None]], axis=2))
        flat = half.reshape(-1, half.shape[2])
        A -= flat[:, :-1].T @ flat[:, :-1]
        b -= flat[:, :-1].T @ flat[:, -1]
        squares += float(np.sum(flat[:, -1] ** 2))
        logs += 2 * float(np.sum(np.log(np.diagonal(L, axis1=1, axis2=2))))
    return A, b, squares, logs


def _shots(normals: list[_Normal], part: slice) -> tuple[Floats, Floats, Floats]:
    H = np.sum([normal.H[part] for normal in normals], axis=0)  # type: ignore[index]
    g = np.sum([normal.g[part] for normal in normals], axis=0)  # type: ignore[index]
    G = np.concatenate([normal.G[part] for normal in normals], axis=2)  # type: ignore[index]
    return H + np.eye(H.shape[1]), g, G


def _unknowns(normals: list[_Normal], means: list[Floats], joint: Floats) -> Unknowns:
    """What is known of the shots' errors, after that of the cameras."""
    H, g, G = _shots(normals, slice(None))
    shots, k = g.shape
    inverse = np.linalg.inv(H)
    mean = np.einsum("skl,sl->sk", inverse, g - G @ np.concatenate(means)).ravel()
    pull = (inverse @ G).reshape(shots * k, -1)
    cross = -joint @ pull.T
    covariance = -pull @ cross
    for s in range(shots):
        covariance[s * k : (s + 1) * k, s * k : (s + 1) * k] += inverse[s]
    return Unknowns(mean, covariance, cross)


def _solve(A: Floats, b: Floats) -> tuple[Floats, Floats, float]:
    """Covariance, mean and log determinant; scaled first, since lens parameters differ by many orders of magnitude."""
    scale = 1 / np.sqrt(np.diag(A))
    L = np.linalg.cholesky(A * scale[:, None] * scale)
    inverse = np.linalg.inv(L) * scale
    covariance = inverse.T @ inverse
    return covariance, covariance @ b, float(2 * np.sum(np.log(np.diag(L) / scale)))


def _chunks(n: int, size: int = CHUNK) -> Iterator[slice]:
    for start in range(0, n, size):
        yield slice(start, min(start + size, n))


def empty_field(lengthscale: Floats, q: Floats, tolerance: float) -> LowRank:
    """A field with inducing points chosen among q (n, 3)."""
    return LowRank.of(field_kernel(lengthscale), q, tolerance)
