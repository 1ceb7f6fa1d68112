"""From a few corners of a checkerboard to all that can be seen: a grid that grows, and is checked.

The node (i, j) of a grid is a corner, i counted along `down` and j along `right`, which are right-handed in the
picture: a mirror image never arises. Where a node must be follows from a homography through its nearest known
neighbours, itself left out; this places missing nodes, gives the directions of the edges to the fit of the corner, and
finds the corners that are not where their neighbours say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from implicam.dataset import Floats
from implicam.detect.corners import Bools, Corners, fit_corners
from implicam.images import Grey, opencv

NEIGHBOURS = 16

MIN_CORNERS = 9
"""Corners of the smallest grid: three rows of three."""

MAX_RESIDUAL_HEIGHTS = 0.35
"""A corner whose residuals are a larger part of its height is none."""

MAX_TURN_RAD = 0.35
"""Radians that an edge may be turned from where the neighbours put it: more, and the fit has found other edges."""

QUADRANT_SQUARES = 0.3
"""Where the colour of a square is read, in squares from the corner in both directions."""

MIN_GREY_HEIGHTS = 0.35
"""How far a square's grey must be on its side of the middle, as a part of the height, to have that colour."""

MIN_HEIGHT_RATIO = 0.3
"""A corner whose height is a smaller part of the median is dropped."""

MAX_ASTRAY_SQUARES = 0.25
"""Squares that a corner may lie from where its neighbours put it, when it is first found."""

STEP_SQUARES = 2
"""Squares that a grid grows by at once: a few fits of many corners take less time than many fits of a few."""

MAX_GAP_SQUARES = 4
"""Squares across which a grid is continued, where something stands before the board."""

MAX_ASKEW_SQUARES = 0.4
"""Squares that corners may lie from the plane of another part of their board: beyond, they are of another one."""

MIN_CORNERS_OF_LINE = 2
"""An outermost row or column with fewer corners is dropped: one corner is no row."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Corners in rows and columns; `corners` holds rows * columns of them, NaN where there is a hole."""

    rows: int
    columns: int
    corners: Corners

    @property
    def uv(self) -> Floats:
        """(rows, columns, 2) pixels."""
        return self.corners.uv.reshape(self.rows, self.columns, 2)

    @property
    def occupied(self) -> Bools:
        """(rows, columns) where a corner was found."""
        return np.isfinite(self.uv[..., 0])

    @cached_property
    def found(self) -> Floats:
        """(count, 2) pixels of the corners that were found, row by row."""
        return self.uv[self.occupied]

    @cached_property
    def largest_step(self) -> float:
        """Pixels between neighbours at most; NaN where no two are neighbours."""
        steps = [np.linalg.norm(np.diff(self.uv, axis=axis), axis=2).ravel() for axis in (0, 1)]
        return float(np.nanmax(np.concatenate(steps)))

    @property
    def count(self) -> int:
        """How many corners were found."""
        return int(self.occupied.sum())

    @property
    def clear(self) -> Bools:
        """(rows, columns) where a corner was found that nothing else cuts into."""
        misfit = self.corners.misfit.reshape(self.rows, self.columns)
        with np.errstate(invalid="ignore"):
            return np.asarray(misfit < max(3 * float(np.nanmedian(misfit)), 0.1), dtype=np.bool_)

    @property
    def polarity(self) -> float:
        """+1 where the square right below and right of node (0, 0) is bright, -1 where it is dark."""
        return float(np.sign(np.nansum(self._signed_heights()))) or 1.0

    def _signed_heights(self) -> Floats:
        i, j = np.indices((self.rows, self.columns))
        return np.asarray(self.corners.height.reshape(i.shape) * (1 - 2 * ((i + j) % 2)), dtype=np.float64)

    def keep_only(self, keep: Bools) -> Grid:
        """The same grid without some of its corners.

        Args:
            keep: (rows, columns) where corners stay.
        """
        return replace(self, corners=_merge_corners(Corners.unknown(keep.size), self.corners, keep.ravel()))

    def turn(self, turns: int) -> Grid:
        """The same corners, counted from another end.

        Args:
            turns: Quarter turns.
        """
        index = np.rot90(np.arange(self.rows * self.columns).reshape(self.rows, self.columns), turns)
        corners = self.corners[index.ravel()]
        rows, columns = (self.rows, self.columns) if turns % 2 == 0 else (self.columns, self.rows)
        return Grid(rows, columns, replace(corners, height=corners.height * (-1) ** turns))

    def pad(self, by: int) -> Grid:
        """The grid with empty rows and columns all round.

        Args:
            by: How many on each side.
        """
        inner = np.zeros((self.rows + 2 * by, self.columns + 2 * by), dtype=np.bool_)
        inner[by : by + self.rows, by : by + self.columns] = True
        return Grid(inner.shape[0], inner.shape[1], _scatter_corners(self.corners, inner.ravel()))

    def crop(self) -> Grid:
        """Without empty rows and columns at the rim."""
        there = self.occupied
        rows, columns = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
        if len(rows) == 0:
            return Grid(0, 0, self.corners[np.zeros(0, dtype=np.intp)])
        index = np.arange(there.size).reshape(there.shape)
        index = index[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        return Grid(int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1, self.corners[index.ravel()])

    def places(self, nodes: Floats) -> Places:
        """Predict where nodes must be from their nearest known neighbours.

        Args:
            nodes: (n, 2) row and column, whole numbers or not.
        """
        known = np.argwhere(self.occupied).astype(np.float64)
        return predict_places(known, self.uv[self.occupied], nodes)

    def levels_near(self, nodes: Floats) -> tuple[Floats, Floats]:
        """The grey between dark and bright, and from there to bright, of the known corner nearest to each node.

        Args:
            nodes: (n, 2) row and column, whole numbers or not.

        Returns:
            (n,) and (n,).
        """
        known = np.argwhere(self.occupied)
        nearest = np.argmin(np.linalg.norm(nodes[:, None] - known[None], axis=2), axis=1)
        row = known[nearest] @ [self.columns, 1]
        return self.corners.mean[row], np.abs(self.corners.height[row])


class Places(NamedTuple):
    """uv (n, 2) pixels, and there the steps right and down (n, 2) pixels per square."""

    uv: Floats
    right: Floats
    down: Floats


def grow_grid(picture: Grey, seed: Floats, limit: int) -> Grid | None:
    """All of a checkerboard that can be seen, from a few of its corners.

    Args:
        picture: (height, width) grey from 0 to 1.
        seed: (rows, columns, 2) pixels of corners found roughly, NaN for holes.
        limit: Rows or columns beyond which it need not grow.

    Returns:
        The grid, None where the seed is no part of a checkerboard.
    """
    grid = _grid_from_seed(picture, seed)
    return None if grid is None else _grow_from(picture, grid, limit)


def join_grids(picture: Grey, a: Grid, b: Grid, size: tuple[int, int], limit: int) -> Grid | None:
    """Join two grids that are parts of one board, behind something that hides what is between.

    The plane of each must put the corners of the other on whole numbers of squares, and the colours must agree.

    Args:
        picture: (height, width) grey from 0 to 1.
        a: The one; its numbering stays.
        b: The other.
        size: Rows and columns of the board's corners, upright or lying; together they must not be larger.
        limit: Rows or columns beyond which the whole need not grow.

    Returns:
        The whole; None if they are not parts of one board.
    """
    for turns in range(4):
        turned = b.turn(turns)
        shift = _find_shift(a, turned)
        if shift is None:
            continue
        again = _find_shift(turned, a)
        if again is None or (shift != -again).any() or a.polarity != turned.polarity * (-1) ** int(shift.sum()):
            return None
        whole = _overlay_grids(a, turned, shift)
        if whole is None or max(whole.occupied.shape) > max(size) or min(whole.occupied.shape) > min(size):
            return None
        return _grow_from(picture, whole, limit)
    return None


def _find_shift(a: Grid, b: Grid) -> NDArray[np.intp] | None:
    """The node of `a` that node (0, 0) of `b` is, (2,), if all of b's are nodes of a's plane; else None."""
    nodes = np.argwhere(a.occupied).astype(np.float64)
    h, _ = opencv().findHomography(a.uv[a.occupied].reshape(-1, 1, 2), nodes.reshape(-1, 1, 2), 0)
    if h is None:
        return None
    place = np.hstack([b.uv[b.occupied], np.ones((b.count, 1))]) @ h.T
    away = place[:, :2] / place[:, 2:] - np.argwhere(b.occupied)
    shift = np.rint(np.median(away, axis=0))
    return shift.astype(np.intp) if np.abs(away - shift).max() < MAX_ASKEW_SQUARES else None


def _overlay_grids(a: Grid, b: Grid, shift: NDArray[np.intp]) -> Grid | None:
    """Both in one grid; None where both have a corner."""
    low = np.minimum(shift, 0)
    high = np.maximum(np.add(shift, (b.rows, b.columns)), (a.rows, a.columns))
    rows, columns = (high - low).tolist()
    boxes = []
    for grid, at in ((a, -low), (b, shift - low)):
        box = np.zeros((rows, columns), dtype=np.bool_)
        box[at[0] : at[0] + grid.rows, at[1] : at[1] + grid.columns] = True
        boxes.append(Grid(rows, columns, _scatter_corners(grid.corners, box.ravel())))
    if (boxes[0].occupied & boxes[1].occupied).any():
        return None
    return Grid(rows, columns, _merge_corners(boxes[0].corners, boxes[1].corners, boxes[1].occupied.ravel()))


def _grow_from(picture: Grey, grid: Grid, limit: int) -> Grid | None:
    across = False
    while True:
        larger = _extend(picture, grid, across=across, limit=limit)
        if larger.count == grid.count and across:
            return _drop_wrong_corners(grid)
        across = larger.count == grid.count
        grid = larger


def _grid_from_seed(picture: Grey, seed: Floats) -> Grid | None:
    rows, columns = seed.shape[:2]
    if rows < 3 or columns < 3 or np.isfinite(seed[..., 0]).sum() < MIN_CORNERS:
        return None
    if _handedness(seed) < 0:
        seed = seed[:, ::-1]
    empty = replace(Corners.unknown(rows * columns), uv=seed.reshape(-1, 2))
    rough = Grid(rows, columns, empty)
    nodes = np.argwhere(rough.occupied)
    places = rough.places(nodes.astype(np.float64))
    if not _is_checkered(picture, nodes, places._replace(uv=rough.uv[rough.occupied])):
        return None
    places = places._replace(uv=rough.uv[rough.occupied])
    if len(nodes) == MIN_CORNERS and not _fit_rough(picture, nodes[4:5], Places(*(x[4:5] for x in places)))[1].all():
        return None  # all of them must be good, so that one tells it for most seeds
    found, good = _fit_rough(picture, nodes, places)
    grid = replace(rough, corners=_scatter_corners(found, rough.occupied.ravel()))
    grid = grid.keep_only(scatter(good, rough.occupied))
    return grid.crop() if grid.count >= MIN_CORNERS else None


def _fit_rough(picture: Grey, nodes: NDArray[np.intp], places: Places) -> tuple[Corners, Bools]:
    """Corners fitted where nothing else of their grid is known, and which of them are corners."""
    found = fit_corners(picture, places.uv, places.right, places.down)
    good = _judge_corners(found, nodes, places, None)
    return found, good & _have_four_squares(picture, places._replace(uv=found.uv), found.mean, found.height)


def are_checkered(picture: Grey, seeds: Floats) -> Bools:
    """Whether the four squares about most rough corners are bright and dark in turn; saves fitting most seeds.

    Args:
        picture: (height, width) grey from 0 to 1.
        seeds: (m, rows, columns, 2) pixels of corners found roughly, without holes.

    Returns:
        (m,).
    """
    nodes = np.argwhere(np.ones(seeds.shape[1:3]))
    uv, known = seeds.reshape(len(seeds), len(nodes), 2), nodes.astype(np.float64)
    return _is_checkered(picture, nodes, predict_places(known, uv, known)._replace(uv=uv))


def _is_checkered(picture: Grey, nodes: NDArray[np.intp], places: Places) -> Bools:
    """Whether it is so of the corners (..., n) at nodes (n, 2), some of which may be missing."""
    squares = _sample_quadrants(picture, Places(*(x.reshape(-1, 2) for x in places))).reshape(4, *places.uv.shape[:-1])
    crossed = (squares[0] + squares[3] - squares[1] - squares[2]) * (1 - 2 * (nodes.sum(axis=1) % 2))
    apart = np.minimum(squares[0], squares[3]) > np.maximum(squares[1], squares[2])
    apart |= np.maximum(squares[0], squares[3]) < np.minimum(squares[1], squares[2])
    sign = np.sign(_median_known(crossed))[..., None]
    return np.asarray(np.mean(apart & (sign * crossed > 0), axis=-1) > 0.6, dtype=np.bool_)


def _median_known(values: Floats) -> Floats:
    """The median over the last axis of what is not NaN; 0 where nothing is."""
    count = np.isfinite(values).sum(axis=-1)
    ranked = np.sort(values, axis=-1)  # NaN last
    middle = [
        np.take_along_axis(ranked, np.maximum(k, 0)[..., None], -1)[..., 0] for k in ((count - 1) // 2, count // 2)
    ]
    return np.where(count > 0, (middle[0] + middle[1]) / 2, 0.0)


def _handedness(uv: Floats) -> float:
    right, down = np.diff(uv[:-1], axis=1), np.diff(uv[:, :-1], axis=0)
    return float(np.nanmedian(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]))


def _judge_corners(
    found: Corners,
    nodes: NDArray[np.intp],
    places: Places,
    grid: Grid | None,
    astray: Floats | float = MAX_ASTRAY_SQUARES,
) -> Bools:
    """Which of the corners fitted (n,) at nodes (n, 2) are corners of this checkerboard."""
    with np.errstate(invalid="ignore"):
        signed = found.height * (1 - 2 * (nodes.sum(axis=1) % 2))
        sound = found.misfit < MAX_RESIDUAL_HEIGHTS
        if grid is None:
            usual = np.median(np.abs(found.height[sound])) if sound.any() else np.inf
            polarity = np.sign(np.median(signed[sound])) if sound.any() else 1.0
        else:
            usual, polarity = np.nanmedian(np.abs(grid.corners.height)), grid.polarity
        steps = np.stack([places.right, places.down], axis=2)
        good = np.asarray(np.isfinite(np.hstack([places.right, places.down, found.uv])).all(axis=1), dtype=np.bool_)
        steps[~good] = np.eye(2)
        away = np.where(good[:, None], found.uv - places.uv, np.inf)
        moved = np.asarray(np.linalg.solve(steps, away[..., None]), dtype=np.float64)[..., 0]
        good &= (np.abs(moved).max(axis=1) < astray) & (found.turned < MAX_TURN_RAD)
        return np.asarray(good & sound & (polarity * signed > MIN_HEIGHT_RATIO * usual), dtype=np.bool_)


def _extend(picture: Grey, grid: Grid, *, across: bool, limit: int) -> Grid:
    """The grid with the missing nodes near it that are found and hang together with it; `across` gaps also others,
    where two neighbours are found too."""
    reach = MAX_GAP_SQUARES if across else STEP_SQUARES
    wide = grid.pad(reach)
    there = wide.occupied
    shape = ndimage.generate_binary_structure(2, 1 if across else 2)
    near = ndimage.binary_dilation(there, shape, iterations=reach) & ~there
    used_rows, used_columns = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
    if len(used_rows) >= limit:
        near[: used_rows[0]] = near[used_rows[-1] + 1 :] = False
    if len(used_columns) >= limit:
        near[:, : used_columns[0]] = near[:, used_columns[-1] + 1 :] = False
    places = wide.places(np.argwhere(near).astype(np.float64))
    if across:
        return add_corners(picture, wide, near, places, neighbours=2)
    return add_corners(picture, wide, near, places, touching=True)


def add_corners(
    picture: Grey,
    grid: Grid,
    where: Bools,
    places: Places,
    *,
    neighbours: int = 0,
    touching: bool = False,
    astray: Floats | float = MAX_ASTRAY_SQUARES,
) -> Grid:
    """Look for corners at nodes where none is known.

    Args:
        picture: (height, width) grey from 0 to 1.
        grid: The corners known.
        where: (rows, columns) the n nodes to look at.
        places: Where they must be, in the order of `np.argwhere(where)`.
        neighbours: So many of the four neighbours of a corner must be found with it.
        touching: Whether corners must hang together with those known, from neighbour to neighbour.
        astray: (n,) or one number, squares that a corner may lie from its place.

    Returns:
        The grid with the corners found, without empty rows and columns at the rim.
    """
    nodes = np.argwhere(where)
    if len(nodes) == 0:
        return grid.crop()
    plausible = _have_four_squares(picture, places, *_expected_levels(grid, nodes))
    astray = np.broadcast_to(astray, len(nodes))[plausible]
    where, nodes, places = scatter(plausible, where), nodes[plausible], Places(*(x[plausible] for x in places))
    if len(nodes) == 0:
        return grid.crop()
    found = fit_corners(picture, places.uv, places.right, places.down)
    good = scatter(_judge_corners(found, nodes, places, grid, astray), where)
    if neighbours:
        good &= _count_neighbours(good) >= neighbours
    if touching:
        good &= ndimage.binary_propagation(grid.occupied, mask=grid.occupied | good)
    corners = _merge_corners(grid.corners, _scatter_corners(found, where.ravel()), good.ravel())
    return Grid(grid.rows, grid.columns, corners).crop()


def _expected_levels(grid: Grid, nodes: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Mean and signed height (n,) that corners at nodes (n, 2) should have."""
    mean, height = grid.levels_near(nodes.astype(np.float64))
    return mean, (1 - 2 * (nodes.sum(axis=1) % 2)) * grid.polarity * height


def _have_four_squares(picture: Grey, places: Places, mean: Floats, height: Floats) -> Bools:
    """(n,) whether the four squares about the places have the colours of a checkerboard."""
    good = np.isfinite(height)
    for sign, grey in zip((1, -1, -1, 1), _sample_quadrants(picture, places), strict=True):
        with np.errstate(invalid="ignore"):
            good &= sign * (grey - mean) * np.sign(height) > MIN_GREY_HEIGHTS * np.abs(height)
    return good


def _sample_quadrants(picture: Grey, places: Places) -> Floats:
    """(4, n) grey in the squares up left, up right, down left, down right of the places."""
    ways = [j * places.right + i * places.down for i, j in ((-1, -1), (-1, 1), (1, -1), (1, 1))]
    return np.stack([sample_bilinear(picture, places.uv + QUADRANT_SQUARES * way) for way in ways])


def sample_bilinear(picture: Grey, uv: Floats) -> Floats:
    """The grey values at pixels, bilinear.

    Args:
        picture: (height, width).
        uv: (n, 2) pixels.

    Returns:
        (n,), NaN outside the picture.
    """
    at = np.where(np.isfinite(uv), uv, -1)[:, ::-1].T
    grey = ndimage.map_coordinates(picture, at, output=np.float64, order=1, cval=np.nan)
    return np.asarray(grey, dtype=np.float64)


def _count_neighbours(there: Bools) -> Floats:
    cross = ndimage.generate_binary_structure(2, 1).astype(np.float64)
    return np.asarray(ndimage.convolve(there.astype(np.float64), cross, mode="constant") - there, dtype=np.float64)


def _drop_wrong_corners(grid: Grid) -> Grid | None:
    """Without the corners that are not where their neighbours say, or that something else cuts into; None if few."""
    for _ in range(4):
        if grid.count < MIN_CORNERS:
            return None
        nodes = np.argwhere(grid.occupied)
        uv = grid.uv[grid.occupied]
        off = np.linalg.norm(grid.places(nodes.astype(np.float64)).uv - uv, axis=1)
        inner = _count_neighbours(grid.occupied)[grid.occupied] >= 3  # the others are extrapolated: less certain
        bound = np.where(inner, 5, 12) * (np.median(off[inner]) if inner.any() else np.median(off)) + 0.1
        there = scatter(off < bound, grid.occupied) & grid.clear
        there &= _count_neighbours(there) >= 1
        smaller = drop_thin_rims(grid.keep_only(there))
        if smaller.count == grid.count:
            return grid
        grid = smaller
    return grid if grid.count >= MIN_CORNERS else None


def drop_thin_rims(grid: Grid) -> Grid:
    """Without outermost rows and columns of fewer than `MIN_CORNERS_OF_LINE` corners.

    Args:
        grid: The corners.
    """
    there = grid.occupied
    changed = True
    while changed and there.any():
        changed = False
        for lines in (there, there.T):
            used = np.flatnonzero(lines.any(axis=1))
            for k in {used[0], used[-1]} if len(used) else ():
                if 0 < lines[k].sum() < MIN_CORNERS_OF_LINE:
                    lines[k] = False
                    changed = True
    return grid.keep_only(there).crop()


def predict_places(known: Floats, uv: Floats, nodes: Floats) -> Places:
    """Predict where nodes are, each by the homography through its nearest known nodes, without the node itself.

    Linear, with its denominator 1 at the node; a little of the plane's perspective is taken away (a ridge) where the
    neighbours do not fix it, so that three or four of them give an affine map.

    Args:
        known: (k, 2) row and column of the nodes that are known; the nearest `NEIGHBOURS` are used.
        uv: (k, 2) their pixels; or (m, k, 2), of m grids.
        nodes: (n, 2) row and column, whole numbers or not.

    Returns:
        The n places; of m grids, all of them with m before n.
    """
    nodes = nodes.astype(np.float64)
    distance = np.linalg.norm(nodes[:, None] - known[None], axis=2)
    distance[distance < 1e-6] = np.inf
    n = min(NEIGHBOURS, len(known) - 1)
    pick = np.argsort(distance, axis=1, kind="stable")[:, :n]
    d = np.take_along_axis(distance, pick, axis=1)
    weight = np.where(np.isfinite(d), 1 / d, 0)  # of the residual: squared in the normal equations
    x = np.where(np.isfinite(d)[..., None], known[pick] - nodes[:, None], 0)
    pixels = uv[..., pick, :]
    middle = pixels.mean(axis=-2)
    pixels = pixels - middle[..., None, :]
    s = np.sqrt(np.mean(pixels**2, axis=(-2, -1)))[..., None] + 1e-9
    h = _fit_homographies(x, pixels / s[..., None], weight)
    at = h[..., [2, 5]]
    right = h[..., [1, 4]] - at * h[..., 7:8]
    down = h[..., [0, 3]] - at * h[..., 6:7]
    return Places(middle + s * at, s * right, s * down)


def _fit_homographies(x: Floats, y: Floats, weight: Floats) -> Floats:
    """(..., n, 8) of y = (h0 x0 + h1 x1 + h2, h3 x0 + h4 x1 + h5) / (1 + h6 x0 + h7 x1), from points x (n, k, 2) and
    y (..., n, k, 2)."""
    *several, k, _ = y.shape
    rows = np.zeros((*several, 2 * k, 8))
    for c in range(2):
        part = rows[..., c::2, :]
        part[..., 3 * c : 3 * c + 2], part[..., 3 * c + 2] = x, 1
        part[..., 6:] = -y[..., c : c + 1] * x
    w = np.repeat(weight, 2, axis=1)
    rows *= w[..., None]
    normal = rows.swapaxes(-1, -2) @ rows
    index = np.arange(8)
    normal[..., index, index] += np.where(index < 6, 1e-12, 1e-7) * np.maximum(np.sum(w**2, axis=1), 1e-9)[:, None]
    right = rows.swapaxes(-1, -2) @ (y.reshape(*several, 2 * k) * w)[..., None]
    return np.asarray(np.linalg.solve(normal, right)[..., 0], dtype=np.float64)


def scatter(values: Bools, where: Bools) -> Bools:
    """Values (k,) put where `where` is true, false elsewhere.

    Args:
        values: One for each place.
        where: The k places.
    """
    out = np.zeros_like(where)
    out[where] = values
    return out


def _scatter_corners(corners: Corners, where: Bools) -> Corners:
    """Corners (k,) put where `where` (n,) is true, NaN elsewhere."""
    out = Corners.unknown(len(where))
    out[where] = corners
    return out


def _merge_corners(old: Corners, new: Corners, where: Bools) -> Corners:
    out = old[np.arange(len(where))]
    out[where] = new[where]
    return out
