"""Known positions that are off, a whole shot at a time: eqs. (16) and (22) of docs/method.md.

Two kinds. *Declared* errors (sd_x, sd_y, sd_z) are random: each shot is shifted on its own, the true positions are
measured. Errors that are *not declared* are looked for where shots of many points contradict each other: a plate on a
traverse whose scale is not quite right. There the known positions are all there is to say what the world is, so what
varies smoothly from shot to shot (up to a parabola along the traverse) is the world, and what is left is the error of
a shot, whose size is estimated. Positions are measured in the world as labelled; away from the shots the error bar
includes that a label there would be off as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from implicam.geometry import Floats
from implicam.rig_model.settings import DEFAULT_SETTINGS, RigModelSettings

WORLD_POLYNOMIAL_TERMS = 3
"""Constant, linear, quadratic: what of the shots' errors is the world."""


@dataclass(frozen=True, eq=False)
class Shots:
    """Shots whose errors are estimated. shot (n,) of each point; centre (S, 3); axes (S, 3, 3) rows: principal
    directions of each shot's points; extent (S, 3) half sizes along them; radius (S,); along (3, 3) rows: first the
    direction in which the shots follow each other; pattern (S, S - WORLD_POLYNOMIAL_TERMS) orthonormal, what is not
    smooth."""

    shot: NDArray[np.int64]
    centre: Floats
    axes: Floats
    extent: Floats
    radius: Floats
    along: Floats
    pattern: Floats
    settings: RigModelSettings

    @classmethod
    def of(
        cls,
        points: Floats,
        labels: NDArray[np.str_],
        settings: RigModelSettings = DEFAULT_SETTINGS,
        *,
        fewest: int = WORLD_POLYNOMIAL_TERMS + 1,
        direction: Floats | None = None,
    ) -> Shots | None:
        """The shots of known points; up to `WORLD_POLYNOMIAL_TERMS` of them have no unknowns.

        Args:
            points: Known positions (n, 3) in the working frame.
            labels: (n,) name of each point's shot.
            settings: How many points a shot takes, and when shots are parallel plates.
            fewest: Shots at least.
            direction: (3,) in which the shots follow each other, where it is known.

        Returns:
            None where there are too few shots, or too few points in them, or where all stand in one place.
        """
        _, shot, count = np.unique(labels, return_inverse=True, return_counts=True)
        S = len(count)
        if fewest > S or count.min() < settings.min_points_per_shot:
            return None
        members = [points[shot == s] for s in range(S)]
        centre = np.array([m.mean(axis=0) for m in members])
        axes = np.array([np.linalg.svd(m - c, full_matrices=True)[2] for m, c in zip(members, centre, strict=True)])
        spans = [np.abs((m - c) @ a.T) for m, c, a in zip(members, centre, axes, strict=True)]
        extent = np.array([span.max(axis=0) for span in spans])
        radius = np.array([np.sqrt(np.mean(np.sum(span**2, axis=1))) for span in spans])
        direction = _common_normal(axes, extent, settings) if direction is None else direction
        along = np.linalg.svd(centre - centre.mean(axis=0) if direction is None else direction[None])[2]
        t = (centre - centre.mean(axis=0)) @ along[0]
        if np.ptp(t) < 1e-9 or len(np.unique(np.round(t / np.ptp(t), 6))) < min(fewest, S):
            return None
        smooth = np.vander(t / np.abs(t).max(), WORLD_POLYNOMIAL_TERMS)
        pattern = np.linalg.qr(smooth, mode="complete")[0][:, WORLD_POLYNOMIAL_TERMS:]
        return cls(shot.astype(np.int64), centre, axes, extent, radius, along, pattern, settings)

    def errors(self, points: Floats) -> ShotErrors:
        """All shots as one: shift along, across (2), and three tilts, each with every pattern.

        Args:
            points: (n, 3) those that the shots are of, in the working frame.

        Returns:
            The errors with one shot and k = 6 x patterns components, in the working frame.
        """
        own = self._rigid(points, self.shot)  # (n, 3, 6)
        basis = own[:, :, :, None] * self.pattern[self.shot][:, None, None, :]
        group = np.repeat([0, 1, 1, 2, 2, 2], self.pattern.shape[1])
        basis = basis.reshape(len(points), 3, -1)
        sd = np.full((1, basis.shape[2]), self.settings.initial_shot_sd_wf)
        return ShotErrors(np.zeros(len(points), dtype=np.int64), basis, sd, group)

    def _rigid(self, points: Floats, shot: NDArray[np.int64]) -> Floats:
        """(n, 3, 6) displacement of points with their shot: by a unit along, across and by a tilt of a unit at rms."""
        lever = (points - self.centre[shot]) / self.radius[shot][:, None]
        shifts = np.broadcast_to(self.along.T, (len(points), 3, 3))
        tilts = np.cross(np.eye(3)[None], lever[:, None, :]).swapaxes(1, 2)
        return np.concatenate([shifts, tilts], axis=2)

    @cached_property
    def reach(self) -> float:
        """The distance over which the label of a shot holds; zero where shots overlap."""
        apart = self._outside(self.centre)
        np.fill_diagonal(apart, np.inf)
        return self.settings.label_reach_gaps * float(np.median(apart.min(axis=1)))

    def _outside(self, points: Floats) -> Floats:
        """(n, S) how far points are outside the box of each shot's points."""
        local = np.abs(np.einsum("sij,nsj->nsi", self.axes, points[:, None] - self.centre))
        return np.asarray(np.linalg.norm(np.maximum(local - self.extent, 0), axis=2), dtype=np.float64)

    def _nearest(self, points: Floats) -> tuple[NDArray[np.int64], Floats, Floats]:
        """The shot nearest to each point (n,), how much its label holds there, and what part of its variance is open.

        Shots that overlap contradict each other in one place: what is measured is their mean, and none of this counts.
        """
        outside = self._outside(points)
        nearest = np.argmin(outside, axis=1)
        if self.reach == 0:
            return nearest, np.zeros(len(points)), np.zeros(len(points))
        holds = np.exp(-0.5 * (outside.min(axis=1) / self.reach) ** 2)
        return nearest, holds, 1 - holds**2

    def label_slope(self, points: Floats, sd: Floats) -> Floats:
        """How far a label near each point is off, by each of the unknowns in their sds, eq. (22).

        Args:
            points: (n, 3) anywhere in the working frame.
            sd: (K,) of the unknowns.

        Returns:
            (n, 3, K) in the working frame.
        """
        nearest, holds, _ = self._nearest(points)
        rigid = self._rigid(points, nearest)
        known = holds[:, None, None, None] * rigid[:, :, :, None] * self.pattern[nearest][:, None, None, :]
        return np.asarray(known.reshape(len(points), 3, len(sd)) * sd, dtype=np.float64)

    def unresolved_covariance(self, points: Floats, sd: Floats) -> Floats:
        """The error of a label near each point, as far as the shots do not tell it: nothing at a shot.

        Args:
            points: (n, 3) anywhere in the working frame.
            sd: (6,) of a shot's error: shift along, across (2), and three tilts.

        Returns:
            (n, 3, 3) covariances in the working frame.
        """
        nearest, _, open_part = self._nearest(points)
        lengths = np.linalg.norm(points - self.centre[nearest], axis=1) / self.radius[nearest]
        within = np.minimum(1, self.settings.max_tilt_radii / np.maximum(lengths, 1e-12))
        lever = self._rigid(points, nearest) * sd
        lever[:, :, 3:] *= within[:, None, None]
        return np.asarray(open_part[:, None, None] * (lever @ lever.swapaxes(1, 2)), dtype=np.float64)

    def world_variance_ratio(self, points: Floats) -> Floats:
        """The variance of the world at each point over that of a shot's error, eq. (28): the world is the parabola
        through the shots by definition, or the line through two.

        Args:
            points: (n, 3) anywhere in the working frame.

        Returns:
            (n,), at most `max_world_variance_ratio`.
        """
        t = (self.centre - (middle := self.centre.mean(axis=0))) @ self.along[0]
        half = np.abs(t).max()
        terms = min(WORLD_POLYNOMIAL_TERMS, len(t))
        farthest = self.settings.max_world_half_lengths
        at = np.clip((points - middle) @ self.along[0] / half, -farthest, farthest)
        weights = np.vander(at, terms) @ np.linalg.pinv(np.vander(t / half, terms))
        most = self.settings.max_world_variance_ratio
        return np.asarray(np.minimum(np.sum(weights**2, axis=1), most), dtype=np.float64)


def _common_normal(axes: Floats, extent: Floats, settings: RigModelSettings) -> Floats | None:
    """(3,) of parallel plates, None of other shots. Where some of a plate's points are missing, its centre lies beside
    the others', so that the centres say poorly where thin slabs follow each other."""
    normals = axes[:, 2]
    flat = extent[:, 2] <= settings.max_plate_thickness_ratio * extent[:, 1]
    parallel = np.abs(normals @ normals[0]) >= 1 - settings.max_plate_one_minus_cosine
    return np.asarray(normals[0], dtype=np.float64) if (flat & parallel).all() else None


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

    def only(self, shots: NDArray[np.int64]) -> ShotErrors:
        """Of some shots, numbered anew; the points of others must not be asked for.

        Args:
            shots: (s,) their numbers, in order.
        """
        number = np.minimum(np.searchsorted(shots, self.shot), len(shots) - 1)
        return replace(self, shot=number, sd=self.sd[shots])

    def update(self, mean: Floats, variance: Floats, settings: RigModelSettings) -> tuple[ShotErrors, Floats]:
        """More probable sds: one step of EM, eq. (17).

        With few shots the most probable sd is too small for error bars: as for the noise, eq. (12), they are made of
        the mean variance.

        Args:
            mean: Posterior mean (shots, k) of the unknowns, in sds.
            variance: Their posterior variance (shots, k).
            settings: The prior of the sds.

        Returns:
            These errors with other sds, and sds (shots, k) for error bars.
        """
        second = (mean**2 + variance) * self.sd**2
        sd, mean_sd = self.sd.copy(), self.sd.copy()
        usual, precision = np.log(settings.shot_sd_prior_median_wf), 1 / settings.shot_sd_prior_log_sd**2
        for number in np.unique(self.group[self.group >= 0]):
            members = self.group == number
            n, total = second[:, members].size, float(second[:, members].sum())
            u = 0.5 * np.log(total / n)
            for _ in range(30):  # Newton; the log posterior is concave in u = log sd
                pull = total * np.exp(-2 * u)
                u -= (n - pull + (u - usual) * precision) / (2 * pull + precision)
            told = float(np.sum(1 - np.minimum(variance[:, members], 1)))  # of n, how many the data tell
            sd[:, members] = np.exp(u)
            mean_sd[:, members] = np.exp(u + 1 / (2 * told + precision))
        return replace(self, sd=sd), mean_sd
