"""Where points are, from the tables of a rig, by NumPy and SciPy: what kernel.c does where it could not be compiled.

The same equations from the same tables with the same last step, (20), (21) and (22a) of docs/method.md, all points at
once: the values of a table at n places are a sparse matrix of weights times the table. Points whose views disagree are
left to the exact path; the kernel finds their wrong views itself.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.special import chdtrc

from implicam.geometry import Bools, Floats
from implicam.tabulated.library import LEFT_TO_EXACT, MEASURED, TOO_FEW_VIEWS
from implicam.tabulated.sight_lines import SightLines
from implicam.tabulated.spline_table import SplineTable, slopes, weights

Singles = NDArray[np.float32]

MAX_STEPS, MAX_CONDITION = 8, 1e9
"""As of kernel.c."""

SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Entries of a symmetric matrix, as six numbers."""

_FULL = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])


class Found(NamedTuple):
    """Points in the working frame: xyz (n, 3), cov (n, 3, 3), p (n,), share (n,), NaN where code (n,) is not MEASURED;
    left_out (n, C)."""

    xyz: Floats
    cov: Floats
    p: Floats
    share: Floats
    code: NDArray[np.int8]
    left_out: Bools


class _Lines(NamedTuple):
    """Lines of sight of one camera, as of kernel.c; lost (n,) where the table has none of a view; certainty (n,) one
    over the variance of its noise, zero where there is no view."""

    lost: Bools
    near: Floats
    along: Floats
    across: Floats
    across_near: Floats
    pixel: Floats
    certainty: Floats


class ArraySolver:
    """The tables of a rig as NumPy takes them."""

    def __init__(self, table: SplineTable, lines: SightLines, step_sds: float, least_p: tuple[float, float]) -> None:
        """Lay the tables out.

        Args:
            table: What the cameras see.
            lines: Where their pixels look.
            step_sds: The last step of Gauss-Newton in standard deviations of the position.
            least_p: The p-value below which two views, and that below which more, are left to the exact path.
        """
        self.table, self.lines, self.least_p = table, lines, least_p
        self.step_sds = step_sds
        nodes, C = int(np.prod(table.own.shape[:3])), table.own.shape[3]
        flat = table.own.reshape(nodes, C, 5)
        self.means = np.ascontiguousarray(flat[:, :, :2].reshape(nodes, 2 * C))
        self.variances = np.ascontiguousarray(flat[:, :, 2:].reshape(nodes, 3 * C))
        self.sight = [points.reshape(-1, 8) for points in lines.points]
        self.any_marked = bool(table.marked.any())

    def measure(self, uv: Floats, noise: Floats) -> Found:
        """Measure points.

        Args:
            uv: (n, C, 2) pixels, NaN where not seen.
            noise: (n, C) of the views, pixels.
        """
        seen = np.asarray(np.isfinite(uv).all(axis=2))
        n, C = seen.shape
        m = seen.sum(axis=1)
        code = np.where(m < 2, np.int8(TOO_FEW_VIEWS), np.int8(LEFT_TO_EXACT))
        found = Found(
            np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), np.full(n, np.nan), np.full(n, np.nan), code,
            np.zeros((n, C), dtype=np.bool_),
        )  # fmt: skip
        going = np.flatnonzero(m >= 2)
        with np.errstate(all="ignore"):
            x = self._start(uv[going], noise[going], seen[going])
            for _ in range(MAX_STEPS):
                x, going = _those((x, going), self._in_box(x))
                if not len(going):
                    break
                x, going = self._step(x, going, uv, noise, seen, found)
        return found

    def _step(
        self, x: Floats, going: NDArray[np.int64], uv: Floats, noise: Floats, seen: Bools, found: Found
    ) -> tuple[Floats, NDArray[np.int64]]:
        """One of Gauss-Newton; puts down the points that are done, and returns the others."""
        use, variance = seen[going], noise[going] ** 2
        r, D, S, accurate = self._look(x, uv[going], use)
        S[0] += variance
        S[2] += variance
        f = np.where(use, 1 / (S[0] * S[2] - S[1] ** 2), 0.0)
        W = (S[2] * f, -S[1] * f, S[0] * f)
        WD = [
            [W[0] * a + W[1] * b for a, b in zip(*D, strict=True)],
            [W[1] * a + W[2] * b for a, b in zip(*D, strict=True)],
        ]
        Wr = (W[0] * r[0] + W[1] * r[1], W[1] * r[0] + W[2] * r[1])
        H = np.stack([(D[0][i] * WD[0][j] + D[1][i] * WD[1][j]).sum(axis=1) for i, j in SYMMETRIC])
        g = np.stack([(D[0][i] * Wr[0] + D[1][i] * Wr[1]).sum(axis=1) for i in range(3)])
        squares = (r[0] * Wr[0] + r[1] * Wr[1]).sum(axis=1)
        cov, good = _inverse(H)
        step = _times(cov, g)
        size = (step * g).sum(axis=0)
        x = x + step.T
        views = use.sum(axis=1)
        good &= accurate & np.isfinite(squares)
        done = good & (size < self.step_sds**2)
        p = chdtrc(2 * views - 3, np.maximum(squares - size, 0))
        kept = done & self._in_box(x) & (p >= np.where(views == 2, *self.least_p))
        rows = going[kept]
        found.xyz[rows], found.cov[rows] = x[kept], cov.T[kept][:, _FULL].reshape(-1, 3, 3)
        found.p[rows], found.code[rows] = p[kept], MEASURED
        found.share[rows] = _share([[a[kept] for a in row] for row in D], variance[kept], use[kept], cov[:, kept])
        on = good & ~done
        return x[on], going[on]

    def _start(self, uv: Floats, noise: Floats, seen: Bools) -> Floats:
        """(n, 3) where lines of sight meet, each as heavy as a pixel is short there."""
        lines = [self._lines_of(c, uv[:, c], noise[:, c], seen[:, c]) for c in range(len(self.sight))]
        lost = np.logical_or.reduce([line.lost for line in lines])
        x, two = np.zeros((3, len(uv))), seen.sum(axis=1) == 2  # where two meet, weights hardly matter
        for again in range(2):
            A, b = np.zeros((6, len(uv))), np.zeros((3, len(uv)))
            for line in lines:
                part: Any = 0.5
                if again:
                    part = np.clip(((x - line.near) * line.along).sum(axis=0), -0.5, 1.5)
                    part[two] = 0.5
                weight = line.certainty / (line.pixel[0] + part * (line.pixel[1] - line.pixel[0])) ** 2
                A += weight * line.across
                b += weight * line.across_near
            inverse, good = _inverse(A)
            x = _times(inverse, b)
        x[:, lost | ~good] = np.nan
        return x.T

    def _lines_of(self, c: int, uv: Floats, noise: Floats, seen: Bools) -> _Lines:
        """The lines of sight of camera c."""
        cells = self.lines.points.shape[1] - 3
        t = (uv - self.lines.frames[c, :2]) * self.lines.frames[c, 2:]
        inside = ((t >= 0) & (t <= cells)).all(axis=1)
        t = np.where(inside[:, None], t, 0.0)
        cell = np.minimum(t.astype(np.int32), cells - 1)
        w, at = weights((t - cell).astype(np.float32)), cell[:, :, None] + np.arange(4, dtype=np.int32)
        index = at[:, 1, :, None] * (cells + 3) + at[:, 0, None, :]
        found = _weighted(w[:, 1, :, None] * w[:, 0, None, :], index, self.sight[c]).T.astype(np.float64, order="C")
        near, d = found[:3], found[3:6] - found[:3]
        along = d / (d**2).sum(axis=0)
        across = np.stack([float(i == j) - d[i] * along[j] for i, j in SYMMETRIC])
        certainty = np.where(inside, noise**-2.0, 0.0)
        return _Lines(seen & ~inside, near, along, across, _times(across, near), found[6:], certainty)

    def _in_box(self, x: Floats) -> Bools:
        t = (x - self.table.low) / self.table.step
        return np.asarray(((t >= 0) & (t <= self.table.cells)).all(axis=1))

    def _look(self, x: Floats, uv: Floats, use: Bools) -> tuple[list[Floats], list[list[Floats]], list[Floats], Bools]:
        """What the cameras see of places in the box: residuals u and v, their slopes by x, y, z, variances uu, uv, vv,
        (n, C) each, zero where not in use; and (n,) whether the table is accurate there."""
        table, (n, C) = self.table, use.shape
        t = (x - table.low) / table.step
        cell = np.minimum(t.astype(np.int32), (table.cells - 1).astype(np.int32))
        w, d = weights(t - cell), slopes(t - cell) / table.step[:, None]
        at = cell[:, :, None] + np.arange(4, dtype=np.int32)
        _, ny, nz = table.own.shape[:3]
        index = (at[:, 0, :, None, None] * ny + at[:, 1, None, :, None]) * nz + at[:, 2, None, None, :]
        value = _outer(w[:, 0], w[:, 1], w[:, 2])
        mean = _weighted(value, index, self.means).reshape(n, C, 2)
        by = [
            _weighted(_outer(*(d[:, b] if b == a else w[:, b] for b in range(3))), index, self.means).reshape(n, C, 2)
            for a in range(3)
        ]
        S = _weighted(value, index, self.variances).reshape(n, C, 3)
        r, D = [], []
        P = table.projections
        rows = [x @ P[:, k, :3].T + P[:, k, 3] for k in range(3)]
        depth = 1 / rows[2]
        for k in range(2):
            pixel = rows[k] * depth
            r.append(np.where(use, uv[..., k] - pixel - mean[..., k], 0.0))
            D.append([np.where(use, (P[:, k, a] - pixel * P[:, 2, a]) * depth + by[a][..., k], 0.0) for a in range(3)])
        accurate = np.ones(n, dtype=np.bool_)
        if self.any_marked:
            accurate = ~(table.marked[tuple(cell.T)] & use).any(axis=1)
        return r, D, [S[..., k].astype(np.float64) for k in range(3)], accurate


def _those(arrays: tuple[Floats, NDArray[np.int64]], keep: Bools) -> tuple[Floats, NDArray[np.int64]]:
    return arrays[0][keep], arrays[1][keep]


def _outer(a: Floats, b: Floats, c: Floats) -> Singles:
    """(n, 4, 4, 4) weights of nodes, rounded once: remainders may be a thousand pixels."""
    return (a[:, :, None, None] * b[:, None, :, None] * c[:, None, None, :]).astype(np.float32)


def _weighted(w: Singles, index: NDArray[np.int32], table: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n, k) sums of rows of a table, with weights."""
    n, each = len(w), w[:1].size if len(w) else 1
    start = np.arange(0, n * each + 1, each, dtype=np.int32)
    return np.asarray(csr_array((w.reshape(-1), index.reshape(-1), start), shape=(n, len(table))) @ table)


def _inverse(A: NDArray[Any]) -> tuple[NDArray[Any], Bools]:
    """Inverses of symmetric matrices (6, n), and where they are good."""
    a, b, c = A[3] * A[5] - A[4] ** 2, A[2] * A[4] - A[1] * A[5], A[1] * A[4] - A[2] * A[3]
    det = A[0] * a + A[1] * b + A[2] * c
    out = np.stack([a, b, c, A[0] * A[5] - A[2] ** 2, A[1] * A[2] - A[0] * A[4], A[0] * A[3] - A[1] ** 2]) / det
    condition = (out[0] + out[3] + out[5]) * (A[0] + A[3] + A[5])
    return out, np.asarray((det > 0) & (condition < MAX_CONDITION))


def _times(A: NDArray[Any], x: NDArray[Any]) -> NDArray[Any]:
    """(3, n) products of symmetric matrices (6, n) and vectors (3, n)."""
    return np.stack(
        [
            A[0] * x[0] + A[1] * x[1] + A[2] * x[2],
            A[1] * x[0] + A[3] * x[1] + A[4] * x[2],
            A[2] * x[0] + A[4] * x[1] + A[5] * x[2],
        ]
    )


def _share(D: list[list[Floats]], variance: Floats, use: Bools, cov: Floats) -> Floats:
    """(n,) share of the variance that perfectly known cameras would not have, eq. (22a)."""
    f = np.where(use, 1 / variance, 0.0)
    N = np.stack([(f * (D[0][i] * D[0][j] + D[1][i] * D[1][j])).sum(axis=1) for i, j in SYMMETRIC])
    inverse, good = _inverse(N)
    parts = (inverse[0] + inverse[3] + inverse[5]) / (cov[0] + cov[3] + cov[5])
    return np.where(good, np.clip(1 - parts, 0.0, 1.0), np.nan)
