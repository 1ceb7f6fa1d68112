"""Which views of a point are wrong: a robust place first, then every choice of views in closed form, and a re-solve.

Trying all choices costs a solution each: with two wrong views among C that is C^2 / 2 of them. Here the work for a
point is a few solutions, whatever C, and grows linearly with the number of cameras. Eqs. (W1) to (W3) of
docs/method.md; docs/decisions/0016.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from implicam.geometry import Bools, Floats
from implicam.rig_model.normal_equations import invert_stack
from implicam.rig_model.settings import RigModelSettings

Ints = NDArray[np.int64]

MAX_PAIRS_TRIED = 40
"""Pairs of lines of sight that a place is tried from: all of up to nine views. Of more, with 45 % of them wrong, one in
a million points has no good pair among so many."""

FAR_STEP_PX = 10.0
"""Pixels: a step from a robust place beyond which the cameras are linearised once more."""

MAX_LINEARISATIONS = 3
"""At most so many times."""

P_VALUE_SLACK = 20.0
"""How wrong the p-value in closed form may be before a choice is solved again: the cameras are not quite linear."""

HOPELESS_CHI_SQUARED = 1e3
"""Chi-squared in closed form beyond which four views or more do not agree anywhere."""

UNANSWERED_RESIDUAL_SDS = 1e4
"""Residual, in standard deviations, given to a view whose camera has no answer at the robust place."""


class LinearisedViews(NamedTuple):
    """The views of n points about a place each: residuals r (n, C, 2) and slopes D (n, C, 2, 3), zero where not seen;
    each: inverse covariances (n, C, 2, 2) of single views; joint: (n, 2C, 2C) of all together where the cameras are
    tied, else None. Both are unity where a view is not seen."""

    r: Floats
    D: Floats
    each: Floats
    joint: Floats | None


class Points(Protocol):
    """Points whose views are asked about, by their rows."""

    @property
    def settings(self) -> RigModelSettings:
        """Which views disagree, and which choice is clearly better."""

    @property
    def degrees(self) -> float | None:
        """Degrees of freedom of the noise, None where it is normal."""

    def lines(self, rows: Ints) -> tuple[Floats, Floats]:
        """The lines of sight of some points.

        Args:
            rows: Numbers (n,) of the points.

        Returns:
            Centres (C, 3) of the cameras and directions (n, C, 3) in the working frame, NaN for none.
        """

    def linearise(self, rows: Ints, x: Floats, seen: Bools, before: LinearisedViews | None = None) -> LinearisedViews:
        """Views of points about places.

        Args:
            rows: Numbers (n,) of the points.
            x: (n, 3) the places, in the working frame.
            seen: (n, C) the views to use.
            before: Of a place nearby, whose covariances are taken; None to find them.

        Returns:
            The views; NaN where a camera has no answer.
        """

    def solve(self, rows: Ints, seen: Bools) -> tuple[Floats, Floats, Floats]:
        """Where points are, from some of their views alone.

        Args:
            rows: Numbers (n,) of the points.
            seen: (n, C) the views to use.

        Returns:
            Positions (n, 3) and covariances (n, 3, 3) in the working frame, and p-values (n,); NaN for none.
        """


class BetterChoice(NamedTuple):
    """Points (rows) with a position from views of one mind, and the views left out (n, C)."""

    rows: Ints
    xyz: Floats
    cov: Floats
    p: Floats
    left_out: Bools


def max_wrong_views(views: Ints) -> Ints:
    """How many views of a point may be left out: the others must be able to contradict, and be more.

    Args:
        views: (n,) how many views each point has.

    Returns:
        (n,) none of one or two, one of three or four, two of five to seven, of more (views - 2) // 2.
    """
    views = np.asarray(views)
    few = np.clip((views - 1) // 2, 0, 2)
    return np.asarray(np.where(views >= 8, (views - 2) // 2, few), dtype=np.int64)


def exclude_wrong_views(points: Points, rows: Ints, seen: Bools) -> Iterator[BetterChoice]:
    """The points that agree without a few of their views, which are clearly the wrong ones; eqs. (W1) to (W3).

    Args:
        points: All points.
        rows: Numbers (n,) of those whose views disagree.
        seen: Their views (n, C).

    Yields:
        Some of these points at a time, each at most once; nothing of those that cannot be mended.
    """
    views = seen.sum(axis=1)
    if (views == 3).any():
        yield _try_each(points, rows[views == 3], seen[views == 3])
    rows, seen = rows[views > 3], seen[views > 3]
    if not len(rows):
        return
    choices = _Choices.about(points, rows, seen)
    left = np.ones(len(rows), dtype=np.bool_)
    for size in (1, 2, 3, 0):
        sizes = choices.clearly_off if size == 0 else np.full(len(rows), size)
        eligible = left & (sizes <= max_wrong_views(seen.sum(axis=1))) & ((size > 0) | (sizes > 3))
        if not eligible.any():
            continue
        for number in np.unique(sizes[eligible]):
            some = np.flatnonzero(eligible & (sizes == number))
            best, second = choices.two_best(some, int(number))
            promising = choices.promising(some, best, second, int(number))
            some, best, second = some[promising], best.select(promising), second.select(promising)
            close = _close(seen[some].sum(axis=1) - number, second.chi2)
            for rivals, part in ((True, close), (False, ~close)):
                groups = (best.group[part], second.group[part]) if rivals else (best.group[part],)
                found = _choose_clearly_better(points, rows[some[part]], seen[some[part]], groups)
                left[some[np.isin(rows[some], found.rows)]] = False
                yield found


def _close(views: Ints, chi2: Floats) -> Bools:
    """Whether the second best choice, which leaves these views with that chi-squared in closed form, must be solved:
    three views of which one is wrong may agree somewhere far away, by chance; four hardly."""
    return np.asarray((views <= 3) | (chi2 < HOPELESS_CHI_SQUARED))


def _try_each(points: Points, rows: Ints, seen: Bools) -> BetterChoice:
    """Three views: the three pairs are tried."""
    member = np.argsort(~seen, axis=1, kind="stable")[:, :3]
    return _choose_clearly_better(points, rows, seen, tuple(member[:, [k]] for k in range(3)))


def _choose_clearly_better(points: Points, rows: Ints, seen: Bools, groups: tuple[Ints, ...]) -> BetterChoice:
    """Solve without each group of views (n, k), and keep the points where one of them clearly makes the rest agree."""
    n = len(rows)
    if n == 0:
        C = seen.shape[1]
        return BetterChoice(rows, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros((0, C), dtype=np.bool_))
    out = np.zeros((len(groups), *seen.shape), dtype=np.bool_)
    for k, group in enumerate(groups):
        np.put_along_axis(out[k], group, True, axis=1)
    again = np.tile(rows, len(groups))
    x, cov, p = points.solve(again, (seen & ~out).reshape(-1, seen.shape[1]))
    ps = np.where(np.isfinite(p), p, 0.0).reshape(len(groups), n)
    order = np.argsort(-ps, axis=0)
    best, index = order[0], np.arange(n)
    second = ps[order[1], index] if len(groups) > 1 else np.zeros(n)
    least, ratio = points.settings.agree_p_value, points.settings.clearly_better_ratio
    good = np.flatnonzero((ps[best, index] > least) & (ps[best, index] > ratio * second))
    where = best[good] * n + good
    return BetterChoice(rows[good], x[where], cov[where], p[where], out[best[good], good])


class _Groups(NamedTuple):
    """For each of n points a group of views (n, k), and the chi-squared (n,) of the others in closed form."""

    group: Ints
    chi2: Floats

    def select(self, keep: Bools) -> _Groups:
        return _Groups(self.group[keep], self.chi2[keep])


class _Choices(NamedTuple):
    """What the views of points left would be, whichever are left out, about a place that most of them agree on.

    u (n, C, 2) and B (n, C, 2, 3): weighted residuals after the best step, and weighted slopes; inverse: (n, 3, 3) of
    the normal matrix; squares (n,) of all residuals after the best step; distance (n, C): how far each view is from
    the place, squared, in its covariance.
    """

    seen: Bools
    weights: LinearisedViews
    u: Floats
    B: Floats
    inverse: Floats
    squares: Floats
    distance: Floats
    degrees: float | None
    settings: RigModelSettings

    @classmethod
    def about(cls, points: Points, rows: Ints, seen: Bools) -> _Choices:
        """Linearise about the place that most views agree on."""
        linear = _linearise_at_majority(points, rows, seen)
        n, C = seen.shape
        D, r = linear.D, linear.r
        B, Wr = apply_weights(linear, D), apply_weights(linear, r[..., None])[..., 0]
        Dt = D.reshape(n, 2 * C, 3).swapaxes(1, 2)
        inverse = invert_stack(Dt @ B.reshape(n, 2 * C, 3))
        g = (Dt @ Wr.reshape(n, 2 * C, 1))[..., 0]
        step = np.einsum("nij,nj->ni", inverse, g)
        u = Wr - np.einsum("ncij,nj->nci", B, step)
        squares = np.sum(r * Wr, axis=(1, 2)) - np.einsum("ni,ni->n", g, step)
        distance = np.where(seen, np.einsum("nci,ncij,ncj->nc", r, linear.each, r), -1.0)
        return cls(seen, linear, u, B, inverse, squares, distance, points.degrees, points.settings)

    @property
    def clearly_off(self) -> Ints:
        """(n,) how many views are far from the place."""
        return np.asarray((chdtrc(2, self._as_normal) < self.settings.disagree_p_value).sum(axis=1), dtype=np.int64)

    @property
    def _as_normal(self) -> Floats:
        """(n, C) the squared distances that are as rare with normal noise, eq. (T5)."""
        distance = np.maximum(self.distance, 0)
        return distance if self.degrees is None else self.degrees * np.log1p(distance / self.degrees)

    def two_best(self, some: Ints, size: int) -> tuple[_Groups, _Groups]:
        """Of points (some) the two groups of `size` views whose absence leaves the smallest chi-squared."""
        worst = np.argsort(-self.distance[some], axis=1, kind="stable")
        n, C = len(some), self.seen.shape[1]
        best = [_Groups(np.full((n, size), -1), np.full(n, np.inf)) for _ in range(2)]
        for places in _all_but_one(size, C, self.settings):
            others = worst[:, list(places)]
            chi2 = self._without(some, others)  # (n, C): without these and each other view
            for _ in range(2):
                last = np.argmin(chi2, axis=1)
                group = np.sort(np.column_stack([others, last]), axis=1)
                value = chi2[np.arange(n), last]
                chi2[np.arange(n), last] = np.inf
                _insert(best, group, value)
        return best[0], best[1]

    def promising(self, some: Ints, best: _Groups, second: _Groups, size: int) -> Bools:
        """Which of the points are worth solving again."""
        free = np.maximum(2 * (self.seen[some].sum(axis=1) - size) - 3, 1)
        p = [np.where(np.isfinite(g.chi2), chdtrc(free, self._misfit(some, g)), 0) for g in (best, second)]
        known = (best.group >= 0).all(axis=1) & (second.group >= 0).all(axis=1)
        return np.asarray(
            known
            & (p[0] * P_VALUE_SLACK > self.settings.agree_p_value)
            & (p[0] * P_VALUE_SLACK > self.settings.clearly_better_ratio * p[1])
        )

    def _misfit(self, some: Ints, without: _Groups) -> Floats:
        """(n,) chi-squared without a group of views; with heavy tails, at the place instead of the best one."""
        if self.degrees is None:
            return np.maximum(without.chi2, 0)
        others = self._as_normal[some]
        np.put_along_axis(others, np.maximum(without.group, 0), 0.0, axis=1)
        return np.asarray(others.sum(axis=1), dtype=np.float64)

    def _without(self, some: Ints, others: Ints) -> Floats:
        """(n, C) chi-squared without the views `others` (n, k) and each single one more; inf where there is none."""
        n = len(some)
        u, squares = self.u[some], self.squares[some]
        M = self._blocks(some)
        if others.shape[1]:
            k = others.shape[1]
            column = self._columns(some, others)  # (n, C, 2, 2k)
            inside = np.take_along_axis(column, others[:, :, None, None], axis=1).reshape(n, 2 * k, 2 * k)
            T = column @ invert_stack(inside)[:, None]
            u_inside = np.take_along_axis(u, others[:, :, None], axis=1).reshape(n, 2 * k)
            squares = squares - np.einsum("ni,nij,nj->n", u_inside, invert_stack(inside), u_inside)
            u = u - np.einsum("ncij,nj->nci", T, u_inside)
            M = M - T @ column.swapaxes(2, 3)
        chi2 = squares[:, None] - _quadratic(M, u)
        allowed = self.seen[some].copy()
        np.put_along_axis(allowed, others, False, axis=1)
        return np.where(allowed & np.isfinite(chi2), np.maximum(chi2, 0), np.inf)

    def _blocks(self, some: Ints) -> Floats:
        """(n, C, 2, 2) the diagonal blocks of M = W - W D (D^T W D)^-1 D^T W, eq. (W2)."""
        B = self.B[some]
        W = self.weights.each[some]
        if self.weights.joint is not None:
            n, C = self.seen[some].shape
            J = self.weights.joint[some].reshape(n, C, 2, C, 2)
            W = np.stack([J[:, c, :, c] for c in range(C)], axis=1)
        return np.asarray(W - B @ self.inverse[some][:, None] @ B.swapaxes(2, 3), dtype=np.float64)

    def _columns(self, some: Ints, others: Ints) -> Floats:
        """(n, C, 2, 2k) the columns of M that belong to the views `others` (n, k)."""
        B = self.B[some]
        n, C = B.shape[:2]
        k = others.shape[1]
        through = B @ self.inverse[some][:, None]
        chosen = np.take_along_axis(B, others[:, :, None, None], axis=1).reshape(n, 2 * k, 3)
        columns = -through @ chosen.swapaxes(1, 2)[:, None]
        if self.weights.joint is None:
            own = np.take_along_axis(self.weights.each[some], others[:, :, None, None], axis=1)
            for i in range(k):
                columns[np.arange(n), others[:, i], :, 2 * i : 2 * i + 2] += own[:, i]
            return np.asarray(columns, dtype=np.float64)
        J = self.weights.joint[some].reshape(n, C, 2, C, 2)
        for i in range(k):
            columns[:, :, :, 2 * i : 2 * i + 2] += J[np.arange(n), :, :, others[:, i]]
        return np.asarray(columns, dtype=np.float64)


def _all_but_one(size: int, C: int, settings: RigModelSettings) -> list[tuple[int, ...]]:
    """Groups, but for one view each: places in the list of views, the farthest first."""
    if size == 1:
        return [()]
    if size == 2:
        return [(place,) for place in range(min(settings.max_suspects_of_two, C))]
    if size == 3:
        return list(combinations(range(min(settings.max_suspects_of_three, C)), 2))
    return [tuple(k for k in range(size) if k != without) for without in range(size - 3, size)]


def _insert(best: list[_Groups], group: Ints, value: Floats) -> None:
    """Keep the two smallest of different groups."""
    same = [(group == b.group).all(axis=1) for b in best]
    value = np.where(same[0] | same[1], np.inf, value)
    first = value < best[0].chi2
    second = ~first & (value < best[1].chi2)
    best[1] = _Groups(
        np.where(first[:, None], best[0].group, np.where(second[:, None], group, best[1].group)),
        np.where(first, best[0].chi2, np.where(second, value, best[1].chi2)),
    )
    best[0] = _Groups(np.where(first[:, None], group, best[0].group), np.where(first, value, best[0].chi2))


def _linearise_at_majority(points: Points, rows: Ints, seen: Bools) -> LinearisedViews:
    """The views about a place that most of them agree on; those whose camera has no answer there are as far off as can
    be."""
    trusted = seen.sum(axis=1) - max_wrong_views(seen.sum(axis=1))
    centres, directions = points.lines(rows)
    usable = seen & np.isfinite(directions).all(axis=2)
    across = _normals_of(np.where(usable[..., None], directions, [0.0, 0.0, 1.0]))
    x = _least_trimmed_squares(across, np.einsum("ncij,cj->nci", across, centres), usable, trusted)
    linear = points.linearise(rows, x, seen)
    far = np.arange(len(rows))
    for number in range(MAX_LINEARISATIONS):
        if number:
            linear = _replace_rows(linear, far, points.linearise(rows[far], x[far], seen[far]))
        step, pixels = _step(linear, far, seen, trusted)
        x[far] += step
        far = far[pixels > FAR_STEP_PX]
        if not len(far):
            break
    linear = points.linearise(rows, x, seen, linear)
    answered = ~seen | _answered(linear)
    if answered.all():
        return linear
    again = points.linearise(rows, x, seen & answered)
    return again._replace(r=np.where(answered[..., None], again.r, UNANSWERED_RESIDUAL_SDS))


def _step(linear: LinearisedViews, some: Ints, seen: Bools, trusted: Ints) -> tuple[Floats, Floats]:
    """(n, 3) from the place of some points to where most of their views agree, and (n,) how many pixels that is."""
    fine = (seen & _answered(linear))[some]
    root = _root_2x2(np.where(fine[..., None, None], linear.each[some], np.eye(2)))
    D = np.where(fine[..., None, None], linear.D[some], 0)
    r = np.where(fine[..., None], linear.r[some], 0)
    step = _least_trimmed_squares(root @ D, (root @ r[..., None])[..., 0], fine, trusted[some])
    moved = np.linalg.norm(np.einsum("ncij,nj->nci", D, step), axis=2)
    return step, moved.sum(axis=1) / np.maximum(fine.sum(axis=1), 1)


def _answered(linear: LinearisedViews) -> Bools:
    """(n, C) where the camera has an answer."""
    finite = np.isfinite(linear.r).all(axis=2) & np.isfinite(linear.D).all(axis=(2, 3))
    return np.asarray(finite & np.isfinite(linear.each).all(axis=(2, 3)))


def _replace_rows(linear: LinearisedViews, some: Ints, new: LinearisedViews) -> LinearisedViews:
    """With that of some points anew; in place."""
    for old, other in zip(linear, new, strict=True):
        if old is not None and other is not None:
            old[some] = other
    return linear


def _least_trimmed_squares(A: Floats, b: Floats, usable: Bools, trusted: Ints) -> Floats:
    """(n, 3) x of which the `trusted` (n,) smallest of `|A_c x - b_c|^2` (A (n, C, 2, 3)) have the smallest sum: least
    trimmed squares (Rousseeuw 1984), from pairs of views, then concentrated twice, eq. (W1)."""
    n, C = usable.shape
    flat = A.reshape(n, 2 * C, 3)
    pairs = _pairs(usable)
    N, g = A.swapaxes(2, 3) @ A, (A.swapaxes(2, 3) @ b[..., None])[..., 0]
    row = np.arange(n)[:, None, None]
    tried = _least_squares(N[row, pairs].sum(axis=2), g[row, pairs].sum(axis=2))  # (n, MAX_PAIRS_TRIED, 3)
    trusted = np.minimum(trusted, np.maximum(usable.sum(axis=1), 1))
    error = _errors(flat, b, tried, usable)
    total = np.take_along_axis(np.cumsum(np.sort(error, axis=2), axis=2), (trusted - 1)[:, None, None], axis=2)
    x = tried[np.arange(n), np.argmin(total[..., 0], axis=1)]
    for _ in range(2):
        error = _errors(flat, b, x[:, None], usable)[:, 0]
        limit = np.take_along_axis(np.sort(error, axis=1), (trusted - 1)[:, None], axis=1)
        inside = (error <= limit) & usable
        x = _least_squares(np.einsum("nc,ncij->nij", inside, N), np.einsum("nc,nci->ni", inside, g))
    return np.asarray(x, dtype=np.float64)


def _errors(flat: Floats, b: Floats, x: Floats, usable: Bools) -> Floats:
    """(n, tried, C) squared errors of the equations at x (n, tried, 3); huge for views that are not there."""
    n, C = usable.shape
    left = (flat @ x.swapaxes(1, 2)).reshape(n, C, 2, -1) - b[..., None]
    error = np.sum(left**2, axis=2)
    error[~usable | ~np.isfinite(error).all(axis=2)] = 1e300 / C
    return np.asarray(error.swapaxes(1, 2), dtype=np.float64)


def _pairs(usable: Bools) -> Ints:
    """(n, MAX_PAIRS_TRIED, 2) pairs of usable views: all of few, some of many."""
    order = np.argsort(~usable, axis=1, kind="stable")
    chosen = _pair_table(usable.shape[1])[usable.sum(axis=1)]
    pairs = np.take_along_axis(order, chosen.reshape(len(order), -1), axis=1).reshape(chosen.shape)
    return np.asarray(pairs, dtype=np.int64)


@lru_cache(maxsize=8)
def _pair_table(C: int) -> Ints:
    """(C + 1, MAX_PAIRS_TRIED, 2) for each number of views."""
    table = np.zeros((C + 1, MAX_PAIRS_TRIED, 2), dtype=np.int64)
    draw = np.random.default_rng(0)
    for views in range(2, C + 1):
        pairs = np.array(list(combinations(range(views), 2)))
        some = draw.permutation(len(pairs))[:MAX_PAIRS_TRIED]
        table[views] = pairs[np.resize(some, MAX_PAIRS_TRIED)]
    return table


def _normals_of(directions: Floats) -> Floats:
    """(n, C, 2, 3) two unit vectors across each direction (n, C, 3)."""
    least = np.eye(3)[np.argmin(np.abs(directions), axis=2)]
    first = np.cross(directions, least)
    first /= np.linalg.norm(first, axis=2, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=2)


def _root_2x2(W: Floats) -> Floats:
    """Roots R of 2 x 2 matrices W = R^T R, in stacks."""
    a = np.sqrt(np.maximum(W[..., 0, 0], 1e-300))
    b = W[..., 0, 1] / a
    c = np.sqrt(np.maximum(W[..., 1, 1] - b**2, 0))
    return np.stack([np.stack([a, b], axis=-1), np.stack([np.zeros_like(a), c], axis=-1)], axis=-2)


def _quadratic(M: Floats, u: Floats) -> Floats:
    """u^T M^-1 u of stacks of symmetric 2 x 2 matrices."""
    a, b, c = M[..., 0, 0], M[..., 0, 1], M[..., 1, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (c * u[..., 0] ** 2 - 2 * b * u[..., 0] * u[..., 1] + a * u[..., 1] ** 2) / (a * c - b**2)
    return np.asarray(found, dtype=np.float64)


def _least_squares(N: Floats, g: Floats) -> Floats:
    """N^-1 g of stacks (..., 3, 3), with what lines in parallel leave open held near zero."""
    ridge = 1e-12 * np.trace(N, axis1=-2, axis2=-1) + 1e-300
    held = N + ridge[..., None, None] * np.eye(3)
    return np.asarray(np.linalg.solve(held, g[..., None])[..., 0], dtype=np.float64)


def apply_weights(linear: LinearisedViews, what: Floats) -> Floats:
    """The inverse covariance of the views of each point, times columns.

    Args:
        linear: The views of n points.
        what: (n, C, 2, k).

    Returns:
        (n, C, 2, k); across cameras where these are tied.
    """
    if linear.joint is None:
        return np.asarray(linear.each @ what, dtype=np.float64)
    n, C, _, k = what.shape
    return np.asarray((linear.joint @ what.reshape(n, 2 * C, k)).reshape(what.shape), dtype=np.float64)
