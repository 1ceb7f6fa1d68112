"""What is known of every camera after seeing the known points: one joint normal distribution, eqs. (13) to (15), (17).

The unknowns of a camera are its lens and pose (a step from where it is linearised) and the weights of its residual
field, first of u, then of v. Where known positions are exact, cameras are independent. Where positions have an error,
of a point or of a whole shot, all cameras see the same error: it is eliminated shot by shot, and what is left ties the
cameras together. Work and memory grow linearly with the number of points.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_triangular

from implicam.calibrators.forward_gp.evidence import field_kernel, stable_cholesky
from implicam.calibrators.forward_gp.general_camera import AnyCamera
from implicam.calibrators.forward_gp.lens import Floats, Image, Prior, View
from implicam.gp.low_rank import LowRank
from implicam.threads import side_by_side

CHUNK = 4096
"""Points at a time."""

TYPICAL_DEPTH_SPREAD = 0.12
"""Standard deviation of the log distance of the known points in an ordinary rig. Where the volume is thinner, depth
counts in its own spread: what a window or water does varies over the volume, however far that is."""

LIKELY = (np.log(3e-3), 1.0)
"""Prior of how far a shot is off, median and log sd, in the working frame: a thousandth of the volume's size."""


class DepthScale(NamedTuple):
    """How log distance becomes a coordinate of the field: its mean over the known points, and the unit it counts in."""

    mean: float = 0.0
    unit: float = 1.0

    @classmethod
    def of(cls, view: View) -> DepthScale:
        """Of the known points that a camera sees."""
        spread = float(np.std(view.log_distance))
        return cls(float(np.mean(view.log_distance)), min(max(spread / TYPICAL_DEPTH_SPREAD, 1e-6), 1.0))


AS_IT_IS = DepthScale()
"""Log distance itself is the coordinate."""


def field_coordinates(view: View, image: Image, depth: DepthScale | None = None) -> Floats:
    """(n, 3) where a field is looked up: pixel about the centre in half the longer side, scaled log distance, eq. (8).

    depth: as of these very points where it is not given."""
    mean, unit = DepthScale.of(view) if depth is None else depth
    return np.column_stack([(view.uv - image.centre) / image.half, (view.log_distance - mean) / unit])


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A camera, its residual field and its noise; weights (m, 2) of the field's features, zero before the fit.

    The field is looked up where the `ruler` sees a point: the camera as it was when the field was laid out. It stays
    when the camera moves, for a telephoto lens may move far along its axis with its focal length, and no pixel shows.
    """

    camera: AnyCamera
    ruler: AnyCamera
    prior: Prior
    image: Image
    field: LowRank
    signal: float  # px
    noise: float  # px, of a view with the camera's usual noise
    weights: Floats
    depth: DepthScale = AS_IT_IS
    family: str = "ordinary"

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.camera.size + 2 * len(self.field.inducing)

    def _views(self, points: Floats) -> tuple[View, View]:
        """What the camera sees, and its ruler."""
        view = self.camera.view(points)
        return view, view if self.ruler is self.camera else self.ruler.view(points)

    def coordinates(self, view: View) -> Floats:
        """(n, 3) where the field is looked up."""
        return field_coordinates(view, self.image, self.depth)

    @cached_property
    def _coefficients(self) -> Floats:
        return self.field.coefficients(self.signal * self.weights)

    def predict(self, points: Floats) -> tuple[Floats, Floats]:
        """Mean pixels (n, 2) and their derivative by the point (n, 2, 3); NaN where the lens has no answer."""
        view, measured = self._views(points)
        q = self.coordinates(measured)
        K = self.field.kernel(q, self.field.inducing)
        by_q = self.field.slope(q, K, self._coefficients)
        by_point = (
            view.by_point
            + by_q[:, :, :2] @ (measured.by_point / self.image.half)
            + by_q[:, :, 2, None] * (measured.distance_by_point[:, None, :] / self.depth.unit)
        )
        return view.uv + K @ self._coefficients, by_point

    def rows(self, points: Floats) -> Rows:
        """How the pixels of points (n, 3) depend on the camera's unknowns, about the present mean."""
        view, measured = self._views(points)
        K = self.field.kernel(self.coordinates(measured), self.field.inducing)
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


def spread(rows: Rows, root: Floats) -> Floats:
    """(n, 2, q) whose products `spread spread^T` are the covariances of mean pixels, from a camera's root (q, P)."""
    p, m = rows.J.shape[2], rows.phi.shape[1]
    out = rows.J @ root[:, :p].T
    for i in range(2):
        out[:, i] += rows.phi @ root[:, p + i * m : p + (i + 1) * m].T
    return np.asarray(out, dtype=np.float64)


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
    """Of all shots, in their sds: mean (shots * k,), covariance, and cross, of which `joint^T cross` is
    the covariance with the cameras' (sum P, shots * k)."""

    mean: Floats
    covariance: Floats
    cross: Floats


@dataclass(frozen=True, eq=False)
class Posterior:
    """All cameras and what is unknown of them.

    Covariances are kept as *roots* W with `covariance = W^T W`: where parameters nearly make up for each other (focal
    length and distance of a telephoto lens) the covariance itself would lose all digits of what pixels show.
    alone: of each camera (P, P), if the known positions were where they seem now; joint: (sum P, sum P) where unknown
    positions tie the cameras, else None. steps: how far each lens moved. evidence: log marginal likelihood, up to a
    constant. displacement: (n, 3) of the known points, the posterior mean.
    """

    models: tuple[CameraModel, ...]
    alone: tuple[Floats, ...]
    joint: Floats | None
    steps: tuple[Floats, ...]
    evidence: float
    unknowns: Unknowns | None = None
    displacement: Floats | None = None

    def root(self, c: int) -> Floats:
        """(., P) root of the covariance of camera c's unknowns, everything included."""
        start, end = self.offsets[c : c + 2]
        return self.alone[c] if self.joint is None else self.joint[:, start:end]

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
    normals = side_by_side(lambda pair: _normal(pair[0], points, pair[1]), list(zip(models, sightings, strict=True)))
    if errors is None:
        return _independent(models, normals)
    return _tied(models, points, sightings, normals, errors)


def _independent(models: tuple[CameraModel, ...], normals: list[_Normal]) -> Posterior:
    """Known positions are exact: every camera on its own, eq. (13)."""
    value, means, roots = 0.0, [], []
    for c, normal in enumerate(normals):
        with naming_camera(c):
            root, mean, log_determinant = solve_normal(normal.A, normal.b)
        value += 0.5 * (float(normal.b @ mean) - log_determinant - normal.squares - normal.logs)
        means.append(mean)
        roots.append(root)
    return Posterior(_moved(models, means), tuple(roots), None, _steps(models, means), value)


def _tied(
    models: tuple[CameraModel, ...],
    points: Floats,
    sightings: tuple[Sightings, ...],
    normals: list[_Normal],
    errors: ShotErrors,
) -> Posterior:
    """All cameras see the same errors of the known positions, eqs. (14) and (15)."""
    ends = np.cumsum([normal.b.size for normal in normals])
    A, b = block_diag(*(normal.A for normal in normals)), np.concatenate([normal.b for normal in normals])
    value = -sum(normal.squares + normal.logs for normal in normals)
    parts = list(_by_shots(sightings, errors))

    def meeting(seen: tuple[Sightings, ...], part: slice) -> _Meeting:
        return _Meeting.of(models, points, seen, errors, part)

    kept = meeting(*parts[0]) if len(parts) == 1 else None  # of many, each is made twice and never kept
    alone = []
    for c, normal in enumerate(normals):
        with naming_camera(c):
            alone.append(solve_normal(normal.A, normal.b)[0])
    for each in parts:
        block = kept or meeting(*each)
        squares, logs = block.eliminate(A, b)
        value += squares - logs
    joint, mean, log_determinant = solve_normal(A, b)
    value += float(b @ mean) - log_determinant
    means = np.split(mean, ends[:-1])
    found = np.concatenate([(kept or meeting(*each)).unknowns(mean) for each in parts])
    displacement = np.asarray(np.einsum("nik,nk->ni", errors.scaled, found[errors.shot]), dtype=np.float64)
    unknowns = kept.all_unknowns(mean, joint) if kept is not None and errors.estimated else None
    return Posterior(
        _moved(models, means), tuple(alone), joint, _steps(models, means), 0.5 * value, unknowns, displacement
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


class CameraFailedError(np.linalg.LinAlgError):
    """The views of one camera do not fix it: `number` of those being fitted."""

    def __init__(self, number: int, why: str) -> None:
        super().__init__(why)
        self.number = number


@contextmanager
def naming_camera(number: int) -> Iterator[None]:
    """Say which camera it was whose equations have no solution."""
    try:
        yield
    except CameraFailedError:
        raise
    except np.linalg.LinAlgError as error:
        raise CameraFailedError(number, str(error)) from error


class _Normal(NamedTuple):
    """The normal equations of one camera, eq. (13): A step = b, with the sum of squares and of the noise's logs."""

    A: Floats
    b: Floats
    squares: float
    logs: float


def _normal(model: CameraModel, points: Floats, seen: Sightings) -> _Normal:
    p, m, P = model.camera.size, len(model.field.inducing), model.size
    off = model.prior.mean - model.camera.parameters
    A, b = np.zeros((P, P)), np.zeros(P)
    A[:p, :p] = model.prior.precision
    A[range(p, P), range(p, P)] = 1.0
    b[:p] = model.prior.precision @ off
    squares, logs = float(off @ b[:p]), 0.0
    for sd, y, J, phi, _ in _whitened(model, points, seen):
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
    return _Normal(A, b, squares, logs)


def _whitened(
    model: CameraModel, points: Floats, seen: Sightings
) -> Iterator[tuple[Floats, Floats, Floats, Floats, Floats]]:
    """In parts: the noise (n,), and in units of it the residuals, their slopes by lens, field and point."""
    bare = replace(model, weights=np.zeros_like(model.weights))
    for part in _chunks(len(seen.rows)):
        sd = model.noise * seen.relative[part]
        rows = bare.rows(points[seen.rows[part]])
        yield (
            sd,
            (seen.uv[part] - rows.mean) / sd[:, None],
            rows.J / sd[:, None, None],
            rows.phi / sd[:, None],
            rows.by_point / sd[:, None, None],
        )


def _by_shots(sightings: tuple[Sightings, ...], errors: ShotErrors) -> Iterator[tuple[tuple[Sightings, ...], slice]]:
    """The sightings of some shots at a time, so that memory does not grow with their number."""
    for part in _chunks(errors.count, 512):
        inside = (errors.shot >= part.start) & (errors.shot < part.stop)
        yield tuple(seen.select(inside[seen.rows]) for seen in sightings), part


class _Meeting(NamedTuple):
    """How some shots' unknowns meet each other and the cameras', eq. (14): H (S, k, k), g (S, k), G (S, k, sum P)."""

    H: Floats
    g: Floats
    G: Floats

    @classmethod
    def of(
        cls,
        models: tuple[CameraModel, ...],
        points: Floats,
        sightings: tuple[Sightings, ...],
        errors: ShotErrors,
        part: slice,
    ) -> _Meeting:
        """From the views of these shots."""
        S, k = part.stop - part.start, errors.basis.shape[2]
        found = side_by_side(
            lambda pair: _meet(pair[0], points, pair[1], errors, part), list(zip(models, sightings, strict=True))
        )
        H = np.eye(k) + np.sum([one.H for one in found], axis=0)
        assert H.shape == (S, k, k)
        return cls(H, np.sum([one.g for one in found], axis=0), np.concatenate([one.G for one in found], axis=2))

    def eliminate(self, A: Floats, b: Floats) -> tuple[float, float]:
        """Take the shots out of the cameras' normal equations, eq. (15); what they add to the evidence."""
        L = np.linalg.cholesky(self.H)
        half = np.linalg.solve(L, np.concatenate([self.G, self.g[..., None]], axis=2))
        flat = half.reshape(-1, half.shape[2])
        A -= flat[:, :-1].T @ flat[:, :-1]
        b -= flat[:, :-1].T @ flat[:, -1]
        logs = 2 * float(np.sum(np.log(np.diagonal(L, axis1=1, axis2=2))))
        return float(np.sum(flat[:, -1] ** 2)), logs

    def unknowns(self, mean: Floats) -> Floats:
        """(S, k) posterior mean, from that of the cameras."""
        found = np.linalg.solve(self.H, (self.g - self.G @ mean)[..., None])[..., 0]
        return np.asarray(found, dtype=np.float64)

    def all_unknowns(self, mean: Floats, joint: Floats) -> Unknowns:
        """What is known of the shots' errors, after that of the cameras."""
        S, k = self.g.shape
        inverse = np.linalg.inv(self.H)
        pull = (inverse @ self.G).reshape(S * k, -1)
        cross = -joint @ pull.T
        covariance = cross.T @ cross
        for s in range(S):
            covariance[s * k : (s + 1) * k, s * k : (s + 1) * k] += inverse[s]
        return Unknowns(self.unknowns(mean).ravel(), covariance, cross)


def _meet(model: CameraModel, points: Floats, seen: Sightings, errors: ShotErrors, part: slice) -> _Meeting:
    S, k = part.stop - part.start, errors.basis.shape[2]
    p, m = model.camera.size, len(model.field.inducing)
    total = _Meeting(np.zeros((S, k, k)), np.zeros((S, k)), np.zeros((S, k, model.size)))
    start = 0
    for sd, y, J, phi, by_point in _whitened(model, points, seen):
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


def solve_normal(A: Floats, b: Floats) -> tuple[Floats, Floats, float]:
    """Root of the covariance, mean and log determinant; scaled first, since lens parameters differ by many orders of
    magnitude."""
    if not np.isfinite(A).all():
        raise np.linalg.LinAlgError("a camera has turned its back on points that it saw")
    scale = 1 / np.sqrt(np.diag(A))
    L = stable_cholesky(A * scale[:, None] * scale)
    root = np.ascontiguousarray(solve_triangular(L, np.diag(scale), lower=True))
    return root, root.T @ (root @ b), float(2 * np.sum(np.log(np.diag(L) / scale)))


def _chunks(n: int, size: int = CHUNK) -> Iterator[slice]:
    for start in range(0, n, size):
        yield slice(start, min(start + size, n))


def empty_field(lengthscale: Floats, q: Floats, tolerance: float) -> LowRank:
    """A field with inducing points chosen among q (n, 3)."""
    return LowRank.of(field_kernel(lengthscale), q, tolerance)
