"""Where the corners of a checkerboard are, to a few hundredths of a pixel, and how well that is known.

A corner is where two straight edges cross. The picture around it is modelled as

    grey = mean + height E(d1 / blur) E(d2 / blur),

d1 and d2 the signed distances from the two edges, E(x) = erf(x / sqrt 2) an edge blurred by a Gaussian. Eight numbers
are fitted to the pixels of a window by least squares: the crossing (u, v), the two directions, the blur, the mean, the
height. For edges that are not square to each other the blurred corner is not quite a product; but the true picture and
the model are both point-symmetric about the crossing, so the crossing is not biased by it, nor by a blur of another
shape or by a response that is not linear.

The covariance is the usual one of least squares, noise² (JᵀJ)⁻¹, with the noise from the residuals, so that shot noise
and what the model does not describe count. All corners of a board are fitted side by side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from implicam.dataset import Floats
from implicam.images import Grey

Bools = NDArray[np.bool_]

MAX_WINDOW_PX = 9.0
"""Pixels from the crossing to the window's rim at most: over more, edges are not straight behind a wide lens."""

MIN_WINDOW_PX = 2.5
"""Pixels to the rim at least: where squares are smaller, there is nothing to fit."""

EDGE_CLEARANCE_PX = 1.6
"""Pixels that the window stays away from the edges of the neighbouring corners, which are blurred too."""

MAX_ROUNDS = 12

SETTLED_PX = 2e-4
"""Pixels of a step below which a corner's fit ends; the next step would be a tenth of it."""

MIN_SD_PX = 0.003
"""Pixels that no standard uncertainty goes below: what curved edges and the sensor's pixels do to the model."""


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners as fitted, n of them. uv: (n, 2) pixels; sd: (n, 2) standard uncertainties.

    mean, height: (n,) grey halfway, and from there to bright; the height is negative where the square between the two
    steps given is dark. misfit: (n,) rms of the residuals as a part of the height. blur: (n,) pixels.
    turned: (n,) radians, how far the edges are from the directions given. edge_shift: (n, 2) pixels that what is left
    at the edges, beyond what is left elsewhere, would move them by if all of it were of one sign.
    Everything is NaN where there is no corner to be fitted, or too near to the rim of the picture.
    """

    uv: Floats
    sd: Floats
    mean: Floats
    height: Floats
    misfit: Floats
    blur: Floats
    turned: Floats
    edge_shift: Floats

    @classmethod
    def unknown(cls, n: int) -> Corners:
        """Corners that are all NaN.

        Args:
            n: How many.
        """
        return cls(*(np.full((n, *more), np.nan) for more in ((2,), (2,), (), (), (), (), (), (2,))))

    def __getitem__(self, rows: Bools | NDArray[np.intp]) -> Corners:
        return Corners(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def __setitem__(self, rows: Bools | NDArray[np.intp], others: Corners) -> None:
        for name in self.__dataclass_fields__:
            getattr(self, name)[rows] = getattr(others, name)


def fit_corners(picture: Grey, uv: Floats, right: Floats, down: Floats, *, bare: float = 1.0) -> Corners:
    """Fit corners, each to the pixels in a window around it.

    Args:
        picture: (height, width) grey from 0 to 1.
        uv: (n, 2) pixels near the corners, within about a third of a square.
        right: (n, 2) pixels from a corner to its neighbour along the rows, roughly.
        down: (n, 2) the same along the columns.
        bare: How far from an edge, in squares, its bright side is bare of print: 1 on a checkerboard; on a ChArUco
            board markers begin earlier.

    Returns:
        n corners, NaN where none can be fitted.
    """
    uv, right, down = (np.asarray(x, dtype=np.float64) for x in (uv, right, down))
    out = Corners.unknown(len(uv))
    longest = np.nanmax(np.linalg.norm([right, down], axis=2), initial=MIN_WINDOW_PX)
    half = int(np.ceil(np.clip(0.9 * longest, MIN_WINDOW_PX, MAX_WINDOW_PX)))
    with np.errstate(invalid="ignore"):
        inside = np.isfinite(uv + right + down).all(axis=1)
        inside &= ((uv >= half + 0.5) & (uv <= np.array(picture.shape)[::-1] - half - 1.5)).all(axis=1)
    for rows in np.array_split(np.flatnonzero(inside), max(1, int(inside.sum()) // 256)):
        if len(rows):
            out[rows] = _Windows(picture, uv[rows], right[rows], down[rows], half, bare).fit()
    return out


class _Windows:
    """The pixels around n corners, and the fit of the model to them.

    Boards spend most of their time here: pixels are the last axis, neighbours in memory, and those that are in no
    corner's window are left out.
    """

    def __init__(self, picture: Grey, uv: Floats, right: Floats, down: Floats, half: int, bare: float) -> None:
        corner = np.rint(uv).astype(int)
        step = np.arange(-half, half + 1)
        dv, du = (x.ravel() for x in np.meshgrid(step, step, indexing="ij"))
        self.around = np.stack([du, dv]).astype(np.float64)
        self.picture = picture[corner[:, 1, None] + dv, corner[:, 0, None] + du].astype(np.float64)
        self.corner = corner.astype(np.float64)
        self.steps = np.stack([right, down], axis=2)  # (n, 2, 2): pixels from squares
        self.angle = np.arctan2(self.steps[:, 1], self.steps[:, 0])  # (n, 2): of the edges to the right and down
        self.half, self.bare = half, bare
        self.start = uv - corner

    def fit(self) -> Corners:
        n = len(self.start)
        state = self._restart(np.hstack([self.start, self.angle, np.full((n, 1), np.log(0.8))]))
        damping, rows = np.full(n, 1e-3), np.arange(n)
        for turn in range(MAX_ROUNDS):
            if turn == 2:  # the window follows the corner once only: else the fit does not converge
                state = self._restart(state.parameters)
            now = state if len(rows) == n else _some(state, rows)
            trial = self._limit(now.parameters - _solve_step(now, damping[rows]), rows)
            change = np.abs(trial - now.parameters)[:, :2].max(axis=1)
            tried = self._evaluate(trial, rows)
            better = tried.error < now.error
            damping[rows] *= np.where(better, 0.2, 5)
            if better.all() and len(rows) == n:
                state = tried
            else:
                for whole, part in zip(state, tried, strict=True):
                    whole[rows[better]] = part[better]
            if turn >= 2:  # what is no corner never settles: the others do not wait for it
                rows = rows[change >= SETTLED_PX]
            if not len(rows):
                break
        return self._collect(state)

    def _restart(self, parameters: Floats) -> _State:
        self._choose_window(parameters)
        return self._evaluate(parameters, np.arange(len(parameters)))

    def _choose_window(self, parameters: Floats) -> None:
        """The pixels that are used, and their weight (n, pixels), 1 in the window and 0 outside; the window is
        point-symmetric about the corner, as the model is."""
        u, v = (self.around[k] - parameters[:, k, None] for k in range(2))
        near = u * u + v * v < (self.half - 0.5) ** 2
        used = near.any(axis=0)
        u, v, inside = u[:, used], v[:, used], near[:, used]
        inverse = _invert(self.steps)
        slope = np.linalg.norm(inverse, axis=2)  # squares per pixel
        reach = np.maximum(1 - EDGE_CLEARANCE_PX * slope, 0.35)
        squares = [np.abs(inverse[:, k, 0, None] * u + inverse[:, k, 1, None] * v) for k in range(2)]
        inside &= (squares[0] < reach[:, 0, None]) & (squares[1] < reach[:, 1, None])
        if self.bare < 1:
            bare = np.maximum(self.bare - EDGE_CLEARANCE_PX * slope, 1.5 * slope)
            inside &= (squares[0] < bare[:, 0, None]) | (squares[1] < bare[:, 1, None])
        some = inside.any(axis=0)
        where = np.flatnonzero(used)[some]
        self.offset, self.grey = self.around[:, where], self.picture[:, where]
        self.weight = np.asarray(inside[:, some], dtype=np.float64)

    def _evaluate(self, parameters: Floats, rows: NDArray[np.intp]) -> _State:
        """Mean and height enter linearly and are solved for each time (variable projection, Golub & Pereyra 1973); the
        Jacobian is that of the whole model: u, v, two angles, log blur, mean, height."""
        weight, grey = self.weight[rows], self.grey[rows]
        u, v = (self.offset[k] - parameters[:, k, None] for k in range(2))
        inverse_blur = np.exp(-parameters[:, 4, None])
        cos, sin = np.cos(parameters[:, 2:4]) * inverse_blur, np.sin(parameters[:, 2:4]) * inverse_blur
        # k = 0: the edge that runs to the right, and how far below it
        distance = [v * cos[:, k, None] - u * sin[:, k, None] for k in range(2)]
        shape = [erf(x * np.sqrt(0.5)) for x in distance]
        product = -shape[0] * shape[1]  # below the one edge and left of the other is not between the two steps
        mean, height = _fit_lines(product, grey, weight)
        residual = height[:, None] * product
        residual += mean[:, None]
        residual -= grey
        residual *= weight
        scale = weight * (-np.sqrt(2 / np.pi) * height)[:, None]
        a, b = (scale * shape[1 - k] * np.exp(-0.5 * distance[k] ** 2) for k in range(2))
        jacobian = np.empty((len(parameters), 7, product.shape[1]))
        jacobian[:, 0] = a * sin[:, 0, None] + b * sin[:, 1, None]
        np.negative(a * cos[:, 0, None] + b * cos[:, 1, None], out=jacobian[:, 1])
        for k, part in enumerate((a, b)):
            np.multiply(part, u * -cos[:, k, None] - v * sin[:, k, None], out=jacobian[:, 2 + k])
        np.negative(a * distance[0] + b * distance[1], out=jacobian[:, 4])
        jacobian[:, 5] = weight
        np.multiply(product, weight, out=jacobian[:, 6])
        error = np.einsum("np,np->n", residual, residual)
        return _State(error, parameters, np.column_stack([mean, height]), residual, jacobian)

    def _limit(self, parameters: Floats, rows: NDArray[np.intp]) -> Floats:
        start = self.start[rows]
        parameters[:, :2] = start + np.clip(parameters[:, :2] - start, -self.half / 2, self.half / 2)
        parameters[:, 4] = np.clip(parameters[:, 4], np.log(0.25), np.log(4.0))
        return parameters

    def _collect(self, state: _State) -> Corners:
        parameters, (mean, height) = state.parameters, state.levels.T
        normal = state.jacobian @ state.jacobian.swapaxes(1, 2)
        spare = self.weight.sum(axis=1) - 7
        with np.errstate(invalid="ignore", divide="ignore"):
            noise = np.where(spare > 5, state.error / spare, np.nan)
            misfit = np.sqrt(noise) / np.abs(height)
            scale = np.sqrt(np.einsum("nii->ni", normal)) + 1e-12
            inverse = np.linalg.pinv(normal / (scale[:, :, None] * scale[:, None, :]), hermitian=True)
            variance = np.einsum("nii->ni", inverse)[:, :2] / scale[:, :2] ** 2 * noise[:, None]
        good = np.isfinite(variance).all(axis=1) & np.isfinite(misfit)
        sd = np.sqrt(np.where(good[:, None], variance, np.nan) + MIN_SD_PX**2)
        uv = np.where(good[:, None], self.corner + parameters[:, :2], np.nan)
        turned = np.abs(np.sin(parameters[:, 2:4] - self.angle)).max(axis=1)
        shift = np.column_stack([_shift_of_edges(state.residual, state.jacobian[:, k], self.weight) for k in range(2)])
        return Corners(uv, sd, mean, height, misfit, np.exp(parameters[:, 4]), turned, shift)


class _State(NamedTuple):
    """Where n fits stand.

    error: (n,) sums of squares. parameters: (n, 5) crossing, two angles, log blur. levels: (n, 2) mean and height.
    residual: (n, pixels), and jacobian: (n, 7, pixels), both 0 outside of the window.
    """

    error: Floats
    parameters: Floats
    levels: Floats
    residual: Floats
    jacobian: Floats


def _some(state: _State, rows: Bools | NDArray[np.intp]) -> _State:
    return _State(*(x[rows] for x in state))


def _solve_step(state: _State, damping: Floats) -> Floats:
    """(n, 5) a step of Levenberg and Marquardt, to be subtracted."""
    normal = state.jacobian @ state.jacobian.swapaxes(1, 2)
    diagonal = np.einsum("nii->ni", normal)
    diagonal += damping[:, None] * diagonal + 1e-9
    gradient = state.jacobian @ state.residual[..., None]
    step = np.asarray(np.linalg.solve(normal, gradient)[:, :5, 0], dtype=np.float64)
    return np.clip(step, -0.7, 0.7)


def _invert(matrices: Floats) -> Floats:
    """The inverses of (n, 2, 2); of those that have none, Moore and Penrose's."""
    (a, b), (c, d) = matrices.transpose(1, 2, 0)
    determinant = a * d - b * c
    if (np.abs(determinant) <= 1e-12 * (a * a + b * b + c * c + d * d)).any():
        return np.asarray(np.linalg.pinv(matrices), dtype=np.float64)
    adjugate = np.stack([d, -b, -c, a], axis=1).reshape(-1, 2, 2)
    return np.asarray(adjugate / determinant[:, None, None], dtype=np.float64)


def _shift_of_edges(residual: Floats, slope: Floats, weight: Floats) -> Floats:
    """(n,) pixels, from the residuals where the grey changes with a coordinate, (n, pixels) slope, and where not."""
    steep = slope**2
    flat = weight * (steep < 0.05 * steep.max(axis=1, keepdims=True))
    total = np.maximum(steep.sum(axis=1), 1e-12)
    there = np.sum(steep * residual**2, axis=1) / total
    elsewhere = np.sum(flat * residual**2, axis=1) / np.maximum(flat.sum(axis=1), 1.0)
    return np.asarray(np.sqrt(np.maximum(there - elsewhere, 0) * total / np.maximum((steep**2).sum(axis=1), 1e-24)))


def _fit_lines(x: Floats, y: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Weighted straight lines y = a + b x, one a row: a (n,), b (n,)."""
    total = np.maximum(weight.sum(axis=1), 1e-12)
    mx, my = (weight * x).sum(axis=1) / total, (weight * y).sum(axis=1) / total
    dx = (x - mx[:, None]) * weight
    b = (dx * y).sum(axis=1) / np.maximum((dx * x).sum(axis=1), 1e-12)
    return my - b * mx, b
