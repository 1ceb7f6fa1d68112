"""What cameras see, as uniform cubic B-splines over a box: each pixel as its best linear projection and a remainder.

The remainder and the covariance are smooth over the box, so a few cells per axis hold them to a small part of a view's
standard deviation. How many is found along lines through the box, then checked at random places, where cells that are
not accurate enough are marked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.geometry import Bools, Floats
from implicam.progress import Progress, silent
from implicam.rig_model import FittedRig, apply_covariance_root
from implicam.threads import side_by_side

MAX_PIXEL_ERROR_SDS, MAX_VARIANCE_ERROR = 0.003, 0.005
"""Of the table: in standard deviations of a view, and in its variance."""

CELLS = (6, 8, 12, 16, 24, 32, 48)
"""Cells along an axis to choose from."""

AXIS_SHARE = 0.3
"""What the splines along one axis may be off, in what the table may be, for it adds the errors of three."""

LINE_STEPS, LINES = 192, 6
"""Places along a line, at which the sites of all `CELLS` lie, and lines along each axis."""

MAX_IMAGE_HALVES, MAX_TABLE_HALVES = 1.5, 3.0
"""A place is visible to a camera up to so many halves of its longer side off the middle; beyond the second, the table
is filled from the nodes around."""

CHECKED_PLACES, CHECK_ROUNDS = 2000, 4
"""Random places at which the table is compared, and how often at most, with other places, until none is off."""

ROWS_AT_A_TIME = 512

CHANNELS = 8
"""Of a camera in `SplineTable.grid`: five are used."""


class Exact(NamedTuple):
    """What C cameras see of n places.

    mean (n, C, 2) pixels; own (n, C, 2, 2) covariance of what is unknown of each camera, without the noise of a view;
    joint (n, C, 2, C, 2) the same of all together, where errors of known positions tie the cameras, else None;
    through (n, 2C, k) covariance with the unknowns of the labels.
    """

    mean: Floats
    own: Floats
    joint: Floats | None
    through: Floats


def look(rig: FittedRig, points: Floats) -> Exact:
    """What the cameras see, by the method itself.

    Args:
        rig: The cameras.
        points: (n, 3) in the working frame.

    Returns:
        NaN where a camera has no answer.
    """
    some = [points[i : i + ROWS_AT_A_TIME] for i in range(0, len(points), ROWS_AT_A_TIME)]
    mean, own, joint, through = zip(*side_by_side(lambda part: _look(rig, part), some), strict=True)
    together = np.concatenate(joint) if rig.posterior.tied else None
    return Exact(np.concatenate(mean), np.concatenate(own), together, np.concatenate(through))


def _look(rig: FittedRig, points: Floats) -> Exact:
    n, C, posterior = len(points), len(rig.cameras), rig.posterior
    unknowns = None if rig.labels is None else rig.labels.unknowns
    through = np.zeros((n, 2 * C, 0 if unknowns is None else len(unknowns.mean)))
    mean, own = np.empty((n, C, 2)), np.empty((n, C, 2, 2))
    halves = []
    with np.errstate(all="ignore"):
        for c, model in enumerate(posterior.models):
            rows = model.rows(points)
            half = apply_covariance_root(rows, posterior.root(c) if posterior.tied else posterior.alone[c])
            mean[:, c] = rows.mean
            own[:, c] = half @ half.swapaxes(1, 2) + rows.rest[:, None, None] * np.eye(2)
            if posterior.tied:
                halves.append(half)
        if not posterior.tied:
            return Exact(mean, own, None, through)
        every = np.concatenate(halves, axis=1)
        joint = (every @ every.swapaxes(1, 2)).reshape(n, C, 2, C, 2)
        for c in range(C):
            joint[:, c, :, c] = own[:, c]
        return Exact(mean, own, joint, through if unknowns is None else every @ unknowns.cross)


@dataclass(frozen=True, eq=False)
class SplineTable:
    """The table of a rig.

    Attributes:
        low: (3,) lowest corner of the box, in the working frame.
        step: (3,) size of a cell.
        projections: (C, 3, 4) of each camera, to which `own` is the remainder.
        own: (nx, ny, nz, C, 5) coefficients: u, v, and their variances uu, uv, vv.
        ties: (nx, ny, nz, pairs, 4) covariances of two cameras: uu, uv, vu, vv, of (0, 1), (0, 2), ...; no pairs where
            cameras are independent.
        through: (nx, ny, nz, C, 2, k).
        marked: (cells x, y, z, C) whether the table is not accurate enough there.
        pixel_error: The largest error at the places checked last, over the sd of a view.
        variance_error: The same of covariances, over the variances of a view.
        places: How many places were checked.
    """

    low: Floats
    step: Floats
    projections: Floats
    own: NDArray[np.float32]
    ties: NDArray[np.float32]
    through: NDArray[np.float32]
    marked: Bools
    pixel_error: float = np.nan
    variance_error: float = np.nan
    places: int = 0

    @property
    def cells(self) -> NDArray[np.int64]:
        """(3,) their number along each axis."""
        return np.array(self.own.shape[:3]) - 3

    def at(self, points: Floats) -> tuple[Exact, NDArray[np.int64]]:
        """What the table says.

        Args:
            points: (n, 3) in the box, in the working frame.

        Returns:
            As `look`, but for covariances of pairs and labels that are not there; and the cell (n, 3) of each point.
        """
        t = np.clip((points - self.low) / self.step, 0, self.cells)
        cell = np.minimum(t.astype(np.int64), self.cells - 1)
        each = weights(t - cell)  # (n, 3, 4)
        near = cell[:, :, None] + np.arange(4)
        w = each[:, 0, :, None, None] * each[:, 1, None, :, None] * each[:, 2, None, None, :]
        index = near[:, 0, :, None, None], near[:, 1, None, :, None], near[:, 2, None, None, :]

        def interpolated(table: NDArray[np.float32]) -> Floats:
            flat = table.reshape(*table.shape[:3], -1)
            rows = [
                np.einsum("nijk,nijkc->nc", w[i : i + 256], flat[tuple(part[i : i + 256] for part in index)])
                for i in range(0, len(points), 256)
            ]
            return np.concatenate(rows).reshape(len(points), *table.shape[3:])

        own, ties, C = interpolated(self.own), interpolated(self.ties), len(self.projections)
        mean = own[..., :2] + _project(self.projections, points)
        covariance = own[..., [2, 3, 3, 4]].reshape(len(points), C, 2, 2)
        joint = None
        if self.ties.shape[3]:
            joint = np.zeros((len(points), C, 2, C, 2))
            for c in range(C):
                joint[:, c, :, c] = covariance[:, c]
            for pair, (c, d) in enumerate(_pairs(C)):
                joint[:, c, :, d] = ties[:, pair].reshape(-1, 2, 2)
                joint[:, d, :, c] = joint[:, c, :, d].swapaxes(1, 2)
        through = interpolated(self.through).reshape(len(points), 2 * C, -1)
        return Exact(mean, covariance, joint, through), cell

    def grid(self) -> NDArray[np.float32]:
        """(nx, ny, nz, C, CHANNELS) `own` and zeros, so that one load brings all of a camera at a node."""
        padded = np.zeros((*self.own.shape[:4], CHANNELS), dtype=np.float32)
        padded[..., :5] = self.own
        return padded


BOX_MARGIN = 0.1
"""By which the box of a table is larger than that of the known points, on each side, in its sides."""


def box_of(rig: FittedRig, xyz: Floats) -> tuple[Floats, Floats]:
    """The box of known points and a margin; a side that is thin has that of the widest.

    Args:
        rig: The cameras.
        xyz: (n, 3) known points, in the world.

    Returns:
        The lowest and the highest corner, in the working frame.
    """
    points = rig.frame.to_working(xyz)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = BOX_MARGIN * np.maximum(high - low, 0.2 * np.max(high - low))
    return low - margin, high + margin


def tabulate(rig: FittedRig, low: Floats, high: Floats, progress: Progress = silent) -> SplineTable:
    """The table of a rig over a box, as accurate as `MAX_PIXEL_ERROR_SDS` and `MAX_VARIANCE_ERROR` ask.

    Args:
        rig: The cameras.
        low: (3,) lowest corner of the box, in the working frame.
        high: (3,) the highest.
        progress: Is told how far it is.

    Returns:
        The table, with the cells marked where it is not accurate enough.
    """
    compare = _Comparison(rig)
    projections = _best_projections(rig, low, high, compare)
    progress("tabulating", 0, 3)
    cells = _cells(rig, low, high, projections, compare)
    progress("tabulating", 1, 3)
    table = _build(rig, low, high, cells, projections, compare)
    progress("tabulating", 2, 3)
    rng = np.random.default_rng(0)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
    for number in range(CHECK_ROUNDS):
        places = np.concatenate([rng.uniform(low, high, (CHECKED_PLACES, 3)), corners])
        pixel, variance, cell, seen = compare.errors(table, places)
        off = (pixel > MAX_PIXEL_ERROR_SDS) | (variance > MAX_VARIANCE_ERROR)
        if number == 0 and off.any() and min(table.cells) < CELLS[-1]:  # finer first; what is then off, is marked
            table = _build(rig, low, high, _finer(table.cells), projections, compare)
            continue
        good = seen & ~table.marked[tuple(cell.T)]
        table = _with_marks(table, cell, off)
        if not (off & good).any():
            break
    last = good & ~off
    worst = [float(np.max(errors[last], initial=0.0)) for errors in (pixel, variance)]
    progress("tabulating", 3, 3)
    return replace(table, pixel_error=worst[0], variance_error=worst[1], places=len(places))


def _finer(cells: NDArray[np.int64]) -> tuple[int, ...]:
    return tuple(next((count for count in CELLS if count > cell), CELLS[-1]) for cell in cells)


def _with_marks(table: SplineTable, cell: NDArray[np.int64], off: Bools) -> SplineTable:
    """Mark the cells of places that are off, and their neighbours."""
    marked = table.marked.copy()
    for at, cameras in zip(cell, off, strict=True):
        if cameras.any():
            marked[tuple(slice(max(a - 1, 0), a + 2) for a in at)] |= cameras
    return replace(table, marked=marked)


class _Comparison:
    """Errors of a table, in the noise of views."""

    def __init__(self, rig: FittedRig) -> None:
        self.rig, models = rig, rig.posterior.models
        self.noise = np.array([model.noise for model in models])
        self.centre, self.half = np.array([m.image.centre for m in models]), np.array([m.image.half for m in models])

    def visible(self, mean: Floats, halves: float) -> Bools:
        """(n, C) whether pixels (n, C, 2) are so near to the image."""
        with np.errstate(invalid="ignore"):
            return np.asarray((np.abs(mean - self.centre) <= halves * self.half[:, None]).all(axis=2))

    def off(self, found: Exact, exact: Exact) -> tuple[Floats, Floats]:
        """(n, C) errors of pixels over the sd of a view, and of the covariances of each camera over its variance."""
        n, C = exact.mean.shape[:2]
        sd = np.sqrt(np.einsum("ncii->nci", exact.own) + self.noise[:, None] ** 2)
        pixel = np.max(np.abs(found.mean - exact.mean) / sd, axis=2)
        variance = np.abs(found.own - exact.own) / (sd[..., :, None] * sd[..., None, :])
        worst = np.asarray(variance.max(axis=(2, 3)))
        if exact.joint is not None and found.joint is not None:
            ties = np.abs(found.joint - exact.joint) / (sd[:, :, :, None, None] * sd[:, None, None])
            ties = np.where(np.isfinite(ties), ties, 0.0)  # of a pair whose other camera does not see it
            worst = np.maximum(worst, ties.max(axis=(2, 3, 4)))
        if exact.through.shape[2]:
            off = np.abs(found.through - exact.through) / sd.reshape(n, 2 * C, 1)
            worst = np.maximum(worst, off.reshape(n, C, -1).max(axis=2))
        return np.asarray(pixel), worst

    def errors(self, table: SplineTable, places: Floats) -> tuple[Floats, Floats, NDArray[np.int64], Bools]:
        """At places (n, 3): both errors (n, C), zero where a camera does not see a place; the cells (n, 3); and
        (n, C) who sees."""
        exact, (found, cell) = look(self.rig, places), table.at(places)
        pixel, variance = self.off(found, exact)
        seen = self.visible(exact.mean, MAX_IMAGE_HALVES)
        doubtful = ~seen & self.visible(found.mean, MAX_IMAGE_HALVES)  # it says it sees what it does not
        pixel = np.where(seen, pixel, np.where(doubtful, np.inf, 0.0))
        return pixel, np.where(seen, variance, 0.0), cell, seen


def _best_projections(rig: FittedRig, low: Floats, high: Floats, compare: _Comparison) -> Floats:
    """(C, 3, 4) the linear projection of each camera that is nearest to what it sees of the box; the middle of its
    image where there is none that has the box before it."""
    axes = [np.linspace(a, b, 7) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    homogeneous = np.column_stack([points, np.ones(len(points))])
    exact = look(rig, points)
    found = []
    for c, good in enumerate(compare.visible(exact.mean, MAX_IMAGE_HALVES).T):
        constant = np.zeros((3, 4))
        constant[:, 3] = *compare.centre[c], 1.0
        P = constant
        if good.sum() >= 12:
            uv = (exact.mean[good, c] - compare.centre[c]) / compare.half[c]
            X, zero = homogeneous[good], np.zeros((int(good.sum()), 4))
            rows = np.concatenate([np.hstack([X, zero, -uv[:, :1] * X]), np.hstack([zero, X, -uv[:, 1:] * X])])
            P = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 4)
            P[:2] = P[:2] * compare.half[c] + compare.centre[c][:, None] * P[2]
            depth = homogeneous @ P[2]
            P, depth = (P, depth) if np.median(depth) > 0 else (-P, -depth)
            if not depth.min() > 1e-2 * depth.max():  # the camera's plane cuts the box
                P = constant
        found.append(P / np.linalg.norm(P[2]))
    return np.array(found)


def _project(projections: Floats, points: Floats) -> Floats:
    """(n, C, 2) pixels of points by linear projections."""
    rows = np.einsum("cij,nj->nci", projections[:, :, :3], points) + projections[:, :, 3]
    return np.asarray(rows[..., :2] / rows[..., 2:])


def _pairs(C: int) -> list[tuple[int, int]]:
    return [(c, d) for c in range(C) for d in range(c + 1, C)]


def weights(f: NDArray[Any]) -> NDArray[Any]:
    """Weights of uniform cubic B-splines.

    Args:
        f: (...) the part of a cell.

    Returns:
        (..., 4).
    """
    g = 1 - f
    both = [g**3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3]
    return np.stack(both, axis=-1) / 6


def slopes(f: NDArray[Any]) -> NDArray[Any]:
    """Slopes of `weights` by f.

    Args:
        f: (...) the part of a cell.

    Returns:
        (..., 4) per cell.
    """
    return np.stack([-((1 - f) ** 2), 3 * f**2 - 4 * f, -3 * f**2 + 2 * f + 1, f**2], axis=-1) / 2


def sites(cells: int) -> Floats:
    """Where a spline takes its values: the nodes, and the middles of the outermost cells.

    Args:
        cells: How many there are.

    Returns:
        (cells + 3,) in cells.
    """
    return np.sort(np.append(np.arange(cells + 1.0), [0.5, cells - 0.5]))


def coefficients(cells: int) -> Floats:
    """Coefficients from the values at the sites.

    Args:
        cells: How many there are.

    Returns:
        (cells + 3, cells + 3).
    """
    return np.asarray(np.linalg.inv(_basis(sites(cells), cells)))


def _basis(t: Floats, cells: int) -> Floats:
    """(n, cells + 3) weights of all coefficients at t, in cells."""
    cell = np.minimum(t.astype(np.int64), cells - 1)
    out = np.zeros((len(t), cells + 3))
    out[np.arange(len(t))[:, None], cell[:, None] + np.arange(4)] = weights(t - cell)
    return out


def _channels(exact: Exact, projections: Floats, points: Floats) -> Floats:
    """(n, channels) all that is tabulated: own, ties and through, one after the other."""
    n, C = exact.mean.shape[:2]
    own = np.concatenate(
        [exact.mean - _project(projections, points), exact.own.reshape(n, C, 4)[:, :, [0, 1, 3]]], axis=2
    )
    ties = [] if exact.joint is None else [exact.joint[:, c, :, d].reshape(n, 4) for c, d in _pairs(C)]
    return np.column_stack([own.reshape(n, -1), *ties, exact.through.reshape(n, -1)])


def filled(values: Floats) -> Floats:
    """With what is NaN filled smoothly from around: the mean of the neighbours, again and again.

    Args:
        values: (nx, ny, nz).

    Returns:
        (nx, ny, nz), zero where there is nothing at all.
    """
    hole = ~np.isfinite(values)
    if not hole.any() or hole.all():
        return np.where(hole, 0.0, values)
    out = np.where(hole, np.mean(values[~hole]), values)
    for _ in range(100):
        padded = np.pad(out, 1, mode="edge")
        around = sum(np.roll(padded, shift, axis)[1:-1, 1:-1, 1:-1] for axis in range(3) for shift in (-1, 1))
        out[hole] = np.asarray(around)[hole] / 6
    return out


def _build(
    rig: FittedRig, low: Floats, high: Floats, cells: tuple[int, ...], projections: Floats, compare: _Comparison
) -> SplineTable:
    step = (high - low) / np.array(cells)
    axes = [a + sites(count) * size for a, count, size in zip(low, cells, step, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    sides = points.shape[:3]
    exact = look(rig, points.reshape(-1, 3))
    C, k = len(projections), exact.through.shape[2]
    near = compare.visible(exact.mean, MAX_TABLE_HALVES)
    every = near[:, :, None, None, None] & near[:, None, None, :, None]
    exact = Exact(
        np.where(near[..., None], exact.mean, np.nan),
        np.where(near[..., None, None], exact.own, np.nan),
        None if exact.joint is None else np.where(every, exact.joint, np.nan),
        np.where(np.repeat(near, 2, axis=1)[:, :, None], exact.through, np.nan),
    )
    values = _channels(exact, projections, points.reshape(-1, 3)).reshape(*sides, -1)
    for channel in np.flatnonzero(~np.isfinite(values).all(axis=(0, 1, 2))):
        values[..., channel] = filled(values[..., channel])
    for axis, count in enumerate(cells):
        values = np.moveaxis(np.tensordot(coefficients(count), values, axes=(1, axis)), 0, axis)
    pairs = len(_pairs(C)) if rig.posterior.tied else 0
    own, ties, through = np.split(values.astype(np.float32), [5 * C, 5 * C + 4 * pairs], axis=3)
    return SplineTable(
        low, step, projections, own.reshape(*sides, C, 5), ties.reshape(*sides, pairs, 4),
        through.reshape(*sides, C, 2, k), np.zeros((*cells, C), dtype=np.bool_),
    )  # fmt: skip


def _cells(rig: FittedRig, low: Floats, high: Floats, projections: Floats, compare: _Comparison) -> tuple[int, ...]:
    """How many cells each axis needs, by splines along lines through the box."""
    rng, t = np.random.default_rng(1), np.linspace(0, 1, LINE_STEPS + 1)
    needed = []
    for axis in range(3):
        starts = rng.uniform(low, high, (LINES, 3))
        starts[:2] = np.where(rng.random((2, 3)) < 0.5, low, high)  # edges of the box
        lines = []
        for start in starts:
            points = np.tile(start, (len(t), 1))
            points[:, axis] = low[axis] + t * (high[axis] - low[axis])
            lines.append(points)
        every = np.concatenate(lines)
        exact = look(rig, every)
        channels = _channels(exact, projections, every).reshape(LINES, len(t), -1)
        scale = _scales(exact, compare, rig.posterior.tied).reshape(LINES, len(t), -1)
        enough = cells_are_enough(channels, scale)
        needed.append(next((count for count in CELLS if enough(count)), CELLS[-1]))
    return tuple(needed)


def cells_are_enough(channels: Floats, scale: Floats) -> Callable[[int], bool]:
    """Whether so many cells are enough along lines.

    Args:
        channels: (lines, places, channels), NaN where a camera has no answer.
        scale: The same: what each may be off.

    Returns:
        A function of the number of cells.
    """
    lines = [_filled_line(line) for line in channels]

    def enough(cells: int) -> bool:
        t = np.linspace(0, cells, LINE_STEPS + 1)
        at = np.round(sites(cells) * LINE_STEPS / cells).astype(np.int64)
        turn = _basis(t, cells) @ coefficients(cells)
        for line, exact, allowed in zip(lines, channels, scale, strict=True):
            off = np.abs(turn @ line[at] - exact) / allowed
            off = off[np.isfinite(off)]
            if len(off) and np.quantile(off, 0.999) > AXIS_SHARE:
                return False
        return True

    return enough


def _filled_line(line: Floats) -> Floats:
    out, t = line.copy(), np.arange(len(line))
    for channel in out.T:
        good = np.isfinite(channel)
        channel[:] = np.interp(t, t[good], channel[good]) if good.any() else 0.0
    return out


def _scales(exact: Exact, compare: _Comparison, tied: bool) -> Floats:
    """(n, channels) what each channel may be off; NaN where a camera does not see a place."""
    n, C = exact.mean.shape[:2]
    S = np.einsum("ncii->nci", exact.own) + compare.noise[:, None] ** 2
    S = np.where(compare.visible(exact.mean, MAX_IMAGE_HALVES)[..., None], S, np.nan)
    sd = np.sqrt(S)
    pairs = np.array([[0, 0], [0, 1], [1, 1]])
    own = [
        np.column_stack([MAX_PIXEL_ERROR_SDS * sd[:, c], MAX_VARIANCE_ERROR * sd[:, c, pairs].prod(axis=2)])
        for c in range(C)
    ]
    ties = [
        MAX_VARIANCE_ERROR * (sd[:, c, :, None] * sd[:, d, None, :]).reshape(n, 4)
        for c, d in (_pairs(C) if tied else [])
    ]
    k = exact.through.shape[2]
    through = MAX_VARIANCE_ERROR * np.repeat(sd.reshape(n, 2 * C), k, axis=1)
    return np.column_stack([*own, *ties, through])
