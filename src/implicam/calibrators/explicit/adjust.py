"""Bundle adjustment: lenses and poses of all cameras and the poses of all boards, from all views of corners at once.

Levenberg-Marquardt on robust residuals. A view joins one camera and one board, so the Jacobian is sparse in blocks: the
normal equations have a block for each camera (A), one for each board (D) and one for each pair that met (B). The boards
are eliminated by the Schur complement A - B D^-1 B^T; work grows linearly with the number of boards. Triggs et al.
2000, "Bundle Adjustment: A Modern Synthesis", sections 4.3 and 6.1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.explicit.boards import BoardView
from implicam.calibrators.explicit.settings import DEFAULT_SETTINGS, ExplicitSettings
from implicam.geometry import Bools, Floats, Pose, rotation_from_vector
from implicam.progress import Progress, silent
from implicam.rig_model import CentralCamera, Prior, solve_normal
from implicam.rig_model.camera import cross

LOST_SQUARED_RESIDUAL = 1e4
"""Squared residual of a corner that the lens has no pixel for."""

RAYLEIGH_MEDIAN = 1.1774
"""Median length of a residual with sd 1 in u and in v."""

MAX_ITERATIONS = 60

RELATIVE_TOLERANCE = 1e-8
"""Relative change of the sum of squares in one step."""

MIN_EIGENVALUE = 1e-14
"""Least eigenvalue of a normal matrix with a diagonal of ones."""

MIN_BOARD_INFORMATION = 1e-9
"""Keeps a board of which nothing is left solvable; one corner counts a million million times as much."""


class Placed(NamedTuple):
    """Poses rig_from_board of all boards: rotations (b, 3, 3), translations (b, 3)."""

    rotation: Floats
    translation: Floats

    @classmethod
    def of(cls, poses: Sequence[Pose]) -> Placed:
        """From single poses.

        Args:
            poses: rig_from_board of each board.

        Returns:
            The same, stacked.
        """
        return cls(np.array([p.rotation for p in poses]), np.array([p.translation for p in poses]))

    def pose(self, k: int) -> Pose:
        """The pose of one board.

        Args:
            k: Its number.

        Returns:
            rig_from_board.
        """
        return Pose(self.rotation[k], self.translation[k])


class Stack(NamedTuple):
    """All that one camera saw, n corners: xyz (n, 3) on their boards, uv (n, 2), relative (n,) noise, board (n,)
    numbers, and the rows of each view."""

    xyz: Floats
    uv: Floats
    relative: Floats
    board: NDArray[np.int64]
    sections: tuple[tuple[int, slice], ...]

    @classmethod
    def of(cls, views: Sequence[BoardView]) -> Stack:
        """From the views of one camera.

        Args:
            views: Its views, one for each board that it saw; there may be none.

        Returns:
            The stack, in the order of the views.
        """
        ends = np.cumsum([0, *(len(view.rows) for view in views)]).tolist()
        sections = tuple((view.board, slice(a, b)) for view, a, b in zip(views, ends[:-1], ends[1:], strict=True))
        xyz = np.concatenate([np.zeros((0, 3)), *(view.xyz for view in views)])
        uv = np.concatenate([np.zeros((0, 2)), *(view.uv for view in views)])
        relative = np.concatenate([np.zeros(0), *(view.relative for view in views)])
        board = np.repeat([view.board for view in views], [len(view.rows) for view in views]).astype(np.int64)
        return cls(xyz, uv, relative, board, sections)


@dataclass(frozen=True, eq=False)
class Views:
    """Views of boards, and the same stacked for each of `count` cameras."""

    each: tuple[BoardView, ...]
    count: int

    @cached_property
    def stacks(self) -> tuple[Stack, ...]:
        """All that each camera saw."""
        return tuple(Stack.of([view for view in self.each if view.camera == c]) for c in range(self.count))

    def select(self, keep: Sequence[Bools]) -> Views:
        """Some of the corners; views of which none is left are left out.

        Args:
            keep: Per camera (n,) which, in the order of its stack.

        Returns:
            The views with these alone.
        """
        some = (view.select(keep[c][rows]) for c, view, rows in self.in_stacks())
        return Views(tuple(view for view in some if len(view.rows)), self.count)

    def in_stacks(self) -> Iterator[tuple[int, BoardView, slice]]:
        """Camera number, view, and its rows in the camera's stack."""
        for c, stack in enumerate(self.stacks):
            own = (view for view in self.each if view.camera == c)
            for view, (_, rows) in zip(own, stack.sections, strict=True):
                yield c, view, rows


@dataclass(frozen=True, eq=False)
class Bundle:
    """cameras and their poses in the rig's frame, which is that of the first camera; boards: rig_from_board of each;
    noise: (C,) in pixels; held: the cameras are known, and only the boards move.

    slack: sd of how far the board was elsewhere in each view of its own, in the board's length unit, where pictures are
    not of the same instants; it turned by as much at its rim. It is integrated out, not with the robust cost.

    settings: priors and thresholds."""

    cameras: tuple[CentralCamera, ...]
    priors: tuple[Prior, ...]
    boards: Placed
    views: Views
    noise: Floats
    held: bool = False
    slack: float = 0.0
    settings: ExplicitSettings = DEFAULT_SETTINGS

    @property
    def starts(self) -> list[int]:
        """Where each camera's unknowns start, and where they end."""
        return [0, *map(int, np.cumsum([camera.size for camera in self.cameras]))]

    @property
    def free(self) -> Bools:
        """(P,) which of the cameras' unknowns are free."""
        free = np.full(self.starts[-1], not self.held, dtype=np.bool_)
        free[self.cameras[0].size - 6 : self.cameras[0].size] = False
        return free

    def corners(self, c: int) -> Floats:
        """Where the corners are that a camera saw.

        Args:
            c: Number of the camera.

        Returns:
            (n, 3) in the rig's frame, in the order of its stack.
        """
        stack = self.views.stacks[c]
        turned = np.einsum("nij,nj->ni", self.boards.rotation[stack.board], stack.xyz)
        return np.asarray(turned + self.boards.translation[stack.board], dtype=np.float64)

    def residuals(self, c: int) -> Floats:
        """What a camera saw minus what is predicted.

        Args:
            c: Number of the camera.

        Returns:
            (n, 2) pixels; NaN where the lens has none.
        """
        return self.views.stacks[c].uv - self.cameras[c].pixel(self.corners(c))

    def lengths(self, c: int) -> Floats:
        """How far off the corners of a camera are.

        Args:
            c: Number of the camera.

        Returns:
            (n,) lengths of the residuals in its usual pixels, over their relative noise; infinite where the lens has
            none.
        """
        error = np.linalg.norm(self.residuals(c), axis=1) / self.views.stacks[c].relative
        return np.where(np.isfinite(error), error, np.inf)

    def moved(self, step: Floats, boards: Floats) -> Bundle:
        """The bundle with cameras and boards changed.

        Args:
            step: (P,) of the cameras; nothing changes where they are held.
            boards: (boards, 6) rotation vectors, radians, and translations in the rig's frame.

        Returns:
            The new bundle.
        """
        parts = np.split(step, self.starts[1:-1])
        cameras = self.cameras
        if not self.held:
            cameras = tuple(camera.moved(part) for camera, part in zip(self.cameras, parts, strict=True))
        turned = rotation_from_vector(boards[:, :3]) @ self.boards.rotation
        return replace(self, cameras=cameras, boards=Placed(turned, self.boards.translation + boards[:, 3:]))


class Adjusted(NamedTuple):
    """bundle: where it ends; root (q, P) with root^T root the covariance of the cameras' unknowns; converged."""

    bundle: Bundle
    root: Floats
    converged: bool


def adjust(
    bundle: Bundle, *, robust: bool = True, progress: Progress = silent, iterations: int = MAX_ITERATIONS
) -> Adjusted:
    """The bundle with the least robust (or plain) sum of squares, from where it starts.

    Args:
        bundle: Where it starts.
        robust: Take Cauchy's cost, and not the plain sum of squares.
        progress: Is told how many steps are done.
        iterations: Steps at most.

    Returns:
        Where it ends, with the covariance of the cameras there.

    Raises:
        numpy.linalg.LinAlgError: The views do not fix the cameras.
    """
    cost, damping, converged = _cost(bundle, robust), 1e-3, False
    normal = _Normal.of(bundle, robust)
    for number in range(iterations):
        progress("adjusting the bundle", number, iterations)
        previous = cost
        while damping < 1e10:
            candidate = bundle.moved(*normal.step(damping))
            now = _cost(candidate, robust)
            if now < cost:
                bundle, cost, damping = candidate, now, max(damping / 10, 1e-14)
                normal = _Normal.of(bundle, robust)
                break
            damping *= 10
        if cost > previous * (1 - RELATIVE_TOLERANCE):
            converged = True
            break
    progress("adjusting the bundle", iterations, iterations)
    return Adjusted(bundle, normal.root(), converged)


def _cost(bundle: Bundle, robust: bool) -> float:
    if not all(camera.sane for camera in bundle.cameras):
        return float("inf")
    total = 0.0
    for c, (camera, prior) in enumerate(zip(bundle.cameras, bundle.priors, strict=True)):
        off = prior.mean - camera.parameters
        total += float(off @ prior.precision @ off)
        if bundle.slack > 0 and not robust:
            total += float(np.sum(_whitened(bundle, c, robust)[0] ** 2))
            continue
        squares = _squares(bundle, c)
        scale = bundle.settings.cauchy_scale_sds**2
        total += float(np.sum(scale * np.log1p(squares / scale) if robust else squares))
    return total


def _squares(bundle: Bundle, c: int) -> Floats:
    """(n,) squared residuals of a camera in standard deviations."""
    squares = (bundle.lengths(c) / bundle.noise[c]) ** 2
    return np.where(np.isfinite(squares), squares, LOST_SQUARED_RESIDUAL)


class _Normal(NamedTuple):
    """The normal equations: A (P, P), a (P,) of the cameras; D (b, 6, 6), d (b, 6) of the boards; B (b, P, 6)."""

    A: Floats
    a: Floats
    D: Floats
    d: Floats
    B: Floats
    free: Bools

    @classmethod
    def of(cls, bundle: Bundle, robust: bool) -> _Normal:
        starts, n = bundle.starts, len(bundle.boards.translation)
        P = starts[-1]
        A, a = np.zeros((P, P)), np.zeros(P)
        D, d, B = np.tile(MIN_BOARD_INFORMATION * np.eye(6), (n, 1, 1)), np.zeros((n, 6)), np.zeros((n, P, 6))
        for c, (camera, prior) in enumerate(zip(bundle.cameras, bundle.priors, strict=True)):
            own = slice(starts[c], starts[c + 1])
            r, J, K = _whitened(bundle, c, robust)
            flat = J.reshape(-1, camera.size)
            A[own, own] += prior.precision + flat.T @ flat
            a[own] += prior.precision @ (prior.mean - camera.parameters) + flat.T @ r.ravel()
            for k, rows in bundle.views.stacks[c].sections:
                Kk, Jk = K[rows].reshape(-1, 6), J[rows].reshape(-1, camera.size)
                D[k] += Kk.T @ Kk
                d[k] += Kk.T @ r[rows].ravel()
                B[k, own] += Jk.T @ Kk
        return cls(A, a, D, d, B, bundle.free)

    def step(self, damping: float) -> tuple[Floats, Floats]:
        """Of the cameras (P,) and the boards (b, 6); damping as a part of the diagonal (Marquardt)."""
        diagonal = np.arange(6)
        D = self.D.copy()
        D[:, diagonal, diagonal] *= 1 + damping
        S, s = self.reduced(self.A + damping * np.diag(np.diag(self.A)), D)
        cameras = np.zeros(len(self.a))
        scale = 1 / np.sqrt(np.diag(S))
        cameras[self.free] = scale * np.linalg.solve(S * scale[:, None] * scale, scale * s)
        boards = np.linalg.solve(D, (self.d - np.einsum("bpk,p->bk", self.B, cameras))[..., None])[..., 0]
        return cameras, boards

    def root(self) -> Floats:
        """(q, P) root of the covariance of the cameras' unknowns, the boards integrated out; zero where fixed."""
        if not self.free.any():
            return np.zeros((0, len(self.a)))
        S, s = self.reduced(self.A, self.D)
        found, _, _ = solve_normal(*_definite(S, s))
        root = np.zeros((len(found), len(self.a)))
        root[:, self.free] = found
        return root

    def reduced(self, A: Floats, D: Floats) -> tuple[Floats, Floats]:
        """The Schur complement and its right-hand side, for the unknowns that are free."""
        B = self.B[:, self.free]
        pulled = np.linalg.solve(D, np.concatenate([B.swapaxes(1, 2), self.d[..., None]], axis=2))  # (b, 6, P + 1)
        flat = B.swapaxes(0, 1).reshape(B.shape[1], len(B) * 6)
        S = A[np.ix_(self.free, self.free)] - flat @ pulled[:, :, :-1].reshape(len(B) * 6, B.shape[1])
        s = self.a[self.free] - flat @ pulled[:, :, -1].reshape(-1)
        return 0.5 * (S + S.T), s


def _definite(S: Floats, s: Floats) -> tuple[Floats, Floats]:
    """The normal matrix, on its diagonal as much more as it takes to be positive definite: rounding may take that where
    an adjustment has got lost."""
    scale = np.sqrt(np.maximum(np.diag(S), np.finfo(np.float64).tiny))
    least = float(np.linalg.eigvalsh(S / scale[:, None] / scale)[0])
    return S + np.diag(scale**2) * max(MIN_EIGENVALUE - least, 0), s


def _whitened(bundle: Bundle, c: int, robust: bool) -> tuple[Floats, Floats, Floats]:
    """Of a camera: residuals (n, 2) and their slopes by it (n, 2, p) and by the board (n, 2, 6), in standard
    deviations, weighted; zero where the lens has no pixel."""
    camera, stack = bundle.cameras[c], bundle.views.stacks[c]
    turned = np.einsum("nij,nj->ni", bundle.boards.rotation[stack.board], stack.xyz)
    seen = camera.view(turned + bundle.boards.translation[stack.board])
    weight = 1 / (bundle.noise[c] * stack.relative)
    if robust:  # iteratively reweighted: Cauchy's weight
        squares = np.sum((stack.uv - seen.uv) ** 2, axis=1) * weight**2
        weight = weight / np.sqrt(1 + squares / bundle.settings.cauchy_scale_sds**2)
    there = np.isfinite(seen.uv).all(axis=1) & np.isfinite(seen.by_parameters).all(axis=(1, 2))
    weight = np.where(there, weight, 0)[:, None]
    by_board = np.concatenate([cross(turned[:, None, :], seen.by_point), seen.by_point], axis=2)
    blocks = (stack.uv - seen.uv, seen.by_parameters, by_board)
    if not there.all():
        blocks = (np.nan_to_num(blocks[0]), np.nan_to_num(blocks[1]), np.nan_to_num(blocks[2]))
    r, J, K = blocks[0] * weight, blocks[1] * weight[..., None], blocks[2] * weight[..., None]
    if bundle.slack > 0 and not robust:
        for (_, rows), (Q, size) in zip(stack.sections, _slacks(bundle, c, K), strict=True):
            less = Q * (1 - 1 / np.sqrt(1 + size**2))
            for block in (r, J, K):
                flat = block[rows].reshape(len(Q), -1)
                block[rows] = (flat - less @ (Q.T @ flat)).reshape(block[rows].shape)
    return r, J, K


def _slacks(bundle: Bundle, c: int, by_board: Floats) -> Iterator[tuple[Floats, Floats]]:
    """For each view of a camera, the directions (2 n, 6) in which slack moves its whitened pixels, orthonormal, and
    the sds (6,) of that; by_board (n, 2, 6): how the pixels follow a board's turn and shift."""
    stack = bundle.views.stacks[c]
    for k, rows in stack.sections:
        turned = stack.xyz[rows] @ bundle.boards.rotation[k].T
        middle = turned.mean(axis=0)
        radius = max(float(np.sqrt(np.mean(np.sum((turned - middle) ** 2, axis=1)))), 1e-9)
        flat = by_board[rows].reshape(-1, 6)
        about = flat[:, :3] - cross(middle, flat[:, 3:])  # turned about its middle, not about its first corner
        Q, size, _ = np.linalg.svd(bundle.slack * np.column_stack([about / radius, flat[:, 3:]]), full_matrices=False)
        yield Q, size


def log_marginal_with_slack(bundle: Bundle) -> float:
    """Log marginal likelihood of the views for the bundle's slack, cameras and boards integrated out (Laplace).

    Args:
        bundle: Adjusted by plain least squares.

    Returns:
        In nats, up to a constant.
    """
    normal = _Normal.of(bundle, robust=False)
    _, _, cameras = solve_normal(*_definite(*normal.reduced(normal.A, normal.D)))
    total = _cost(bundle, robust=False) + np.sum(np.linalg.slogdet(normal.D)[1]) + cameras
    plain = replace(bundle, slack=0.0)
    for c in range(len(bundle.cameras)):
        for _, size in _slacks(bundle, c, _whitened(plain, c, robust=False)[2]):
            total += np.sum(np.log1p(size**2))
    return float(-0.5 * total)


def root_with_slack(bundle: Bundle, root: Floats) -> Floats:
    """A root of the covariance where there was slack, of cameras that were adjusted without: to each view's own error
    comes what the slack of its board moved the cameras by.

    Args:
        bundle: With its slack.
        root: (q, P) of the covariance without.

    Returns:
        (P, P), or fewer rows where there are fewer in all.
    """
    plain = replace(bundle, slack=0.0)
    normal, starts, pulls = _Normal.of(plain, robust=False), bundle.starts, []
    back = np.linalg.solve(normal.D, normal.B.swapaxes(1, 2))  # (b, 6, P): how boards follow the cameras
    for c in range(len(bundle.cameras)):
        _, J, K = _whitened(plain, c, robust=False)
        for (k, rows), (Q, size) in zip(bundle.views.stacks[c].sections, _slacks(bundle, c, K), strict=True):
            G = (Q * size).T
            pull = -(G @ K[rows].reshape(len(Q), 6)) @ back[k]
            pull[:, starts[c] : starts[c + 1]] += G @ J[rows].reshape(len(Q), -1)
            pulls.append(pull)
    both = np.vstack([root, np.concatenate(pulls) @ root.T @ root])
    return np.asarray(np.linalg.qr(both, mode="r"), dtype=np.float64)


def slack_in_pixels(bundle: Bundle) -> Floats:
    """How far slack moves the corners of a view, which residuals do not show: the poses of boards follow it.

    Args:
        bundle: With its slack.

    Returns:
        (cameras,) pixels along u or v, rms over the corners of all views.
    """
    plain, found = replace(bundle, slack=0.0), np.zeros(len(bundle.cameras))
    for c, stack in enumerate(bundle.views.stacks):
        squares = [np.sum(size**2) for _, size in _slacks(bundle, c, _whitened(plain, c, robust=False)[2])]
        found[c] = bundle.noise[c] * np.sqrt(np.sum(squares) / max(2 * len(stack.uv), 1))
    return found


def unexplained(bundle: Bundle, c: int) -> Floats:
    """What the slack of a camera's boards does not explain of its residuals either.

    Args:
        bundle: With its slack.
        c: Number of the camera.

    Returns:
        (n,) lengths in its usual pixels; infinite where the lens has none.
    """
    r, _, K = _whitened(replace(bundle, slack=0.0), c, robust=False)
    r = r.copy()
    for (_, rows), (Q, size) in zip(bundle.views.stacks[c].sections, _slacks(bundle, c, K), strict=True):
        flat = r[rows].ravel()
        r[rows] = (flat - Q @ (size**2 / (1 + size**2) * (Q.T @ flat))).reshape(-1, 2)
    off = np.linalg.norm(r, axis=1) * bundle.noise[c]
    return np.where(np.isfinite(bundle.lengths(c)), off, np.inf)


def log_marginal(bundle: Bundle) -> float:
    """Log of the integral of exp(-cost / 2) over all unknowns, by Laplace's method where the bundle is: cameras and
    boards; robust cost.

    Args:
        bundle: Adjusted with the robust cost.

    Returns:
        In nats, up to a constant.
    """
    normal = _Normal.of(bundle, robust=True)
    boards = np.linalg.slogdet(normal.D)[1]
    _, _, cameras = solve_normal(*_definite(*normal.reduced(normal.A, normal.D)))
    return float(-0.5 * (_cost(bundle, robust=True) + np.sum(boards) + cameras))


def spreads(bundle: Bundle) -> Floats:
    """The usual residual of each camera, whatever a few wrong corners say.

    Args:
        bundle: As it is.

    Returns:
        (C,) pixels per coordinate.
    """
    return np.array([np.median(bundle.lengths(c)) / RAYLEIGH_MEDIAN for c in range(len(bundle.cameras))])


def adjust_in_steps(bundle: Bundle, half: Floats, *, one_noise: bool = False, progress: Progress = silent) -> Adjusted:
    """Adjusted with the residuals' own size as the noise, which shrinks: far from the answer nothing is an outlier.

    Args:
        bundle: Where it starts.
        half: (C,) half the longer side of each image, pixels.
        one_noise: The noise is the same for all cameras.
        progress: Is told how many steps are done.

    Returns:
        Where it ends.

    Raises:
        numpy.linalg.LinAlgError: The views do not fix the cameras.
    """

    def noise_of(bundle: Bundle) -> Floats:
        own = spreads(bundle)
        if one_noise:
            own = np.full(len(own), np.sqrt(np.mean(np.minimum(own, half) ** 2)))
        return np.minimum(np.maximum(own, 1e-5 * half), half)

    for _ in range(4):
        noise = noise_of(bundle)
        found = adjust(replace(bundle, noise=noise), progress=progress)
        bundle = found.bundle
        if np.allclose(noise, noise_of(bundle), rtol=0.05):
            break
    return found
