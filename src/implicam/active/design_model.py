"""How exactly a calibration measures at places, and what a known point there would add; before anything is measured.

A calibration is linear in what it does not know, near what it does: so the covariance after one more point depends on
where the point is, not on what the cameras will see. Both kinds of methods answer the same questions:

- forward (`PredictsPixels`: forward-gp, explicit): pixels depend on the unknowns of the cameras;
- inverse (`HasPositionProcesses`: inverse-gp): each coordinate is a Gaussian process of the pixels, and the pixels of a
  place are predicted by a forward model that was fitted to the same points, or known because the place was recorded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from implicam.calibrators import CALIBRATORS, Calibration, HasPositionProcesses, PredictsPixels
from implicam.calibrators.position_processes import PositionProcesses
from implicam.dataset import Dataset, Floats
from implicam.dataset.image_bounds import are_on_image
from implicam.errors import UsageError
from implicam.gp.low_rank import pivoted_cholesky
from implicam.rig_model import Sensitivity

Bools = NDArray[np.bool_]

ELLIPSOID_95_SCALE = float(np.sqrt(chdtri(3, 0.05)))
"""The 95 % ellipsoid of a position, in units of the ellipsoid of one standard deviation."""


@dataclass(frozen=True, eq=False)
class Places:
    """Positions, and where the cameras see them.

    Attributes:
        xyz: (n, 3) positions in the world.
        uv: (n, cameras, 2) the pixels at which all cameras of the dataset see them, or would.
        seen: (n, cameras) where they do: in the picture, and not behind the lens.
    """

    xyz: Floats
    uv: Floats
    seen: Bools

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, index: NDArray[np.int64] | Bools) -> Places:
        """Some of the places.

        Args:
            index: (k,) numbers, or (n,) which to keep.
        """
        return Places(self.xyz[index], self.uv[index], self.seen[index])

    @classmethod
    def predicted(cls, rig: PredictsPixels, xyz: Floats) -> Places:
        """Where a calibration says that the cameras would see positions.

        Args:
            rig: A calibration that predicts pixels.
            xyz: (n, 3) positions in the world.
        """
        uv = rig.predict(xyz)
        return cls(xyz, uv, are_on_image(rig.trained, uv))

    @classmethod
    def recorded(cls, data: Dataset) -> Places:
        """Known points that were recorded already, to choose from.

        Args:
            data: A dataset with known positions.
        """
        return cls(data.xyz, data.observations.uv, data.observations.seen)


@dataclass(frozen=True, eq=False)
class PredictedCovariance:
    """The covariance that a position measured at each of n places would have.

    Attributes:
        total: (n, 3, 3) covariance in the squared length unit; NaN where nothing can be measured.
        make_floor: Computes `floor` when it is first asked for, because it can cost as much as all the rest.
    """

    total: Floats
    make_floor: Callable[[], Floats]

    @cached_property
    def floor(self) -> Floats:
        """(n, 3, 3) the covariance that pixel noise alone would leave, however well the cameras are known."""
        return self.make_floor()

    @property
    def measured(self) -> Bools:
        """(n,) where a position can be measured."""
        return np.isfinite(self.total[:, 0, 0])

    @property
    def sd(self) -> Floats:
        """(n,) standard deviation of a position, of all three axes together, in the length unit."""
        return np.asarray(np.sqrt(np.trace(self.total, axis1=1, axis2=2)), dtype=np.float64)

    @property
    def excess(self) -> Floats:
        """(n,) the standard deviation over that which pixel noise alone would leave."""
        return np.asarray(self.sd / np.sqrt(np.trace(self.floor, axis1=1, axis2=2)), dtype=np.float64)

    @property
    def u95(self) -> Floats:
        """(n,) 95 % uncertainty in the length unit: the longest semi-axis of the 95 % ellipsoid of the position."""
        largest = np.full(len(self.total), np.nan)
        i = self.measured
        largest[i] = ELLIPSOID_95_SCALE * np.sqrt(np.linalg.eigvalsh(self.total[i])[:, -1])
        return largest


class DesignModel(Protocol):
    """A calibration, the candidates for the next known point, and the places at which it is judged."""

    @property
    def candidates(self) -> Places:
        """Where the next known point may be."""

    @property
    def judged(self) -> Places:
        """Where the calibration has to be good."""

    @property
    def at_judged(self) -> PredictedCovariance:
        """The covariance of measuring at the judged places."""

    @property
    def at_candidates(self) -> PredictedCovariance:
        """The covariance of measuring at the candidates."""

    @property
    def useful(self) -> Bools:
        """(m,) at which candidates a known point could be used."""

    def gain(self, weights: Floats) -> Floats:
        """How much a known point at each candidate would reduce the variance at the judged places, to first order.

        Args:
            weights: (g,) of the judged places, NaN for those that do not count.

        Returns:
            (m,) by how much `sum weights * trace of the covariance` would fall; zero where a point is of no use.
        """

    def information(self) -> Floats:
        """(m,) what a known point at each candidate would tell about the unknowns, in nats."""

    def after(self, i: int) -> Self:
        """The design when one candidate is a known point too.

        Args:
            i: The number of the candidate.
        """


@dataclass(frozen=True, eq=False)
class ForwardDesignModel:
    """The design model of a method that predicts pixels.

    Attributes:
        candidates: Where the next known point may be, m places.
        judged: Where the calibration has to be good, g places.
        parts: The sensitivities at candidates and judged places, in this order; zero, with unit noise, where a camera
            does not see a place.
        place: (3, 3) covariance of a known position.
    """

    candidates: Places
    judged: Places
    parts: tuple[Sensitivity, ...]
    place: Floats

    @classmethod
    def of(cls, rig: PredictsPixels, candidates: Places, judged: Places) -> ForwardDesignModel:
        """The design model of a rig whose known positions are exact.

        Args:
            rig: A calibration that predicts pixels.
            candidates: Where the next known point may be.
            judged: Where the calibration has to be good.
        """
        xyz = np.concatenate([candidates.xyz, judged.xyz])
        seen = np.concatenate([candidates.seen, judged.seen])
        parts = tuple(_masked(part, seen[:, part.cameras]) for part in rig.sensitivities(xyz))
        return cls(candidates, judged, parts, np.zeros((3, 3)))

    @property
    def useful(self) -> Bools:
        """(m,) which candidates any camera sees; their position is known, so one view is enough."""
        return np.asarray(self.candidates.seen.any(axis=1))

    @cached_property
    def _predicted(self) -> PredictedCovariance:
        seen = np.concatenate([self.candidates.seen, self.judged.seen]).sum(axis=1) >= 2
        n = len(seen)
        now, ever = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
        for part, S in zip(self.parts, self._covariances, strict=True):
            Dt = part.slope.swapaxes(1, 2)
            now += Dt @ np.linalg.solve(S, part.slope)
            ever += Dt @ (part.slope / part.noise[..., None])
        total, floor = np.full((n, 3, 3), np.nan), np.full((n, 3, 3), np.nan)
        total[seen], floor[seen] = np.linalg.inv(now[seen]), np.linalg.inv(ever[seen])
        return PredictedCovariance(total, lambda: floor)

    @cached_property
    def _covariances(self) -> tuple[Floats, ...]:
        """(n, r, r) of the pixels of each place: noise, and what is unknown of the cameras."""
        return tuple(_covariance(part) for part in self.parts)

    @property
    def at_judged(self) -> PredictedCovariance:
        """The covariance of measuring at the judged places."""
        m = len(self.candidates)
        return PredictedCovariance(self._predicted.total[m:], lambda: self._predicted.floor[m:])

    @property
    def at_candidates(self) -> PredictedCovariance:
        """The covariance of measuring at the candidates."""
        m = len(self.candidates)
        return PredictedCovariance(self._predicted.total[:m], lambda: self._predicted.floor[:m])

    def gain(self, weights: Floats) -> Floats:
        """How much a known point at each candidate would reduce the variance at the judged places, to first order.

        Cohn's criterion for a linear model with normal errors: a position is off by `A (error of the pixels)`,
        A = T D^T S^-1, and one more point reduces their covariance by `K (S + place)^-1 K^T`.

        Args:
            weights: (g,) of the judged places, NaN for those that do not count.

        Returns:
            (m,) by how much `sum weights * trace of the covariance` would fall; zero where a point is of no use.
        """
        m = len(self.candidates)
        total = self._predicted.total[m:]
        good = np.isfinite(total[:, 0, 0]) & np.isfinite(weights)
        root = np.sqrt(weights[good])[:, None, None]
        found = np.zeros(m)
        for part, S in zip(self.parts, self._covariances, strict=True):
            judged = slice(m, None)
            A = total[good] @ np.linalg.solve(S[judged][good], part.slope[judged][good]).swapaxes(1, 2)
            moved = (root * (A @ part.half[judged][good])).reshape(-1, part.half.shape[2])
            q = part.half.shape[2]
            h = (part.half[:m].reshape(-1, q) @ _root(moved.T @ moved)).reshape(m, part.half.shape[1], -1)
            observed = S[:m] + self._of_place(part)
            found += np.einsum("nij,nij->n", np.linalg.inv(observed), h @ h.swapaxes(1, 2))
        return np.where(self.useful, found, 0.0)

    def information(self) -> Floats:
        """As of `DesignModel`: half the log determinant of the predicted views' covariance over that of their noise."""
        m = len(self.candidates)
        found = np.zeros(m)
        for part, S in zip(self.parts, self._covariances, strict=True):
            noise = self._of_place(part) + _diagonal(part.noise[:m] + part.rest[:m])
            found += 0.5 * (np.linalg.slogdet(S[:m] + self._of_place(part))[1] - np.linalg.slogdet(noise)[1])
        return np.where(self.useful, found, 0.0)

    def _of_place(self, part: Sensitivity) -> Floats:
        """(m, r, r) what the error of a known position adds to its views."""
        D = part.slope[: len(self.candidates)]
        return np.asarray(D @ self.place @ D.swapaxes(1, 2), dtype=np.float64)

    def after(self, i: int) -> ForwardDesignModel:
        """The design when one candidate is a known point too.

        `half <- half (I - V diag(1 - 1/sqrt(1 + s^2)) V^T)`, s and V the singular values and vectors of the candidate's
        whitened half.

        Args:
            i: The number of the candidate.
        """
        parts = []
        for part in self.parts:
            noise = self._of_place(part)[i] + np.diag(part.noise[i] + part.rest[i])
            _, s, Vt = np.linalg.svd(np.linalg.solve(np.linalg.cholesky(noise), part.half[i]), full_matrices=False)
            shrink = Vt.T * (1 - 1 / np.sqrt(1 + s**2))
            parts.append(part._replace(half=part.half - (part.half @ shrink) @ Vt))
        return replace(self, parts=tuple(parts))


def noise_floor_covariance(rig: PredictsPixels, places: Places) -> Floats:
    """The covariance of a position that pixel noise alone would leave.

    Args:
        rig: A calibration that predicts pixels.
        places: n places, with the cameras that see each.

    Returns:
        (n, 3, 3), NaN with fewer than two views.
    """
    information = np.zeros((len(places), 3, 3))
    views = np.zeros(len(places))
    for part in rig.sensitivities(places.xyz):
        part = _masked(part, places.seen[:, part.cameras])
        information += part.slope.swapaxes(1, 2) @ (part.slope / part.noise[..., None])
        views += places.seen[:, part.cameras].sum(axis=1)
    floor = np.full_like(information, np.nan)
    floor[views >= 2] = np.linalg.inv(information[views >= 2])
    return floor


def _masked(part: Sensitivity, seen: Bools) -> Sensitivity:
    """Zero slope and spread, unit noise, where a camera does not see a place; changed in place: they are large."""
    unseen = ~seen.repeat(2, axis=1)
    with np.errstate(invalid="ignore"):  # of infinities; the sum of what is finite is finite
        for values in (part.slope, part.half):
            unseen |= ~np.isfinite(values.sum(axis=2))
    for values, instead in ((part.slope, 0.0), (part.half, 0.0), (part.rest, 0.0), (part.noise, 1.0)):
        values[unseen] = instead
    return part


def _covariance(part: Sensitivity) -> Floats:
    return part.half @ part.half.swapaxes(1, 2) + _diagonal(part.noise + part.rest)


def _root(M: Floats) -> Floats:
    """(q, k) R with M = R R^T to a millionth of its largest, k small: few of all unknowns matter."""
    return pivoted_cholesky(M, 1e-6 * float(np.diagonal(M).max(initial=0.0)))[1]


def _diagonal(variances: Floats) -> Floats:
    return np.asarray(variances[:, :, None] * np.eye(variances.shape[1]), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class InverseDesignModel:
    """The design model of Gaussian processes from pixels to positions.

    Attributes:
        candidates: Where the next known point may be, m places; only those that every camera sees count.
        judged: Where the calibration has to be good, g places; only those that every camera sees count.
        at: The processes at candidates and judged places, in this order.
        pilot: A calibration that says what pixel noise leaves at each place. Without it the noise of the processes is
            taken, and with few points that is nearly everything.
    """

    candidates: Places
    judged: Places
    at: PositionProcesses
    pilot: PredictsPixels | None = None

    @property
    def useful(self) -> Bools:
        """(m,) which candidates every camera sees."""
        return np.asarray(self.candidates.seen.all(axis=1))

    def _predicted(self, part: slice, places: Places) -> PredictedCovariance:
        seen = places.seen.all(axis=1)
        total = np.where(np.reshape(seen, (-1, 1, 1)), self.at.covariance[part], np.nan)

        def floor() -> Floats:
            if self.pilot is not None:
                return noise_floor_covariance(self.pilot, places)
            return np.broadcast_to(self.at.noise_covariance, total.shape)

        return PredictedCovariance(total, floor)

    @property
    def at_judged(self) -> PredictedCovariance:
        """The covariance of measuring at the judged places."""
        return self._predicted(slice(len(self.candidates), None), self.judged)

    @property
    def at_candidates(self) -> PredictedCovariance:
        """The covariance of measuring at the candidates."""
        return self._predicted(slice(len(self.candidates)), self.candidates)

    def gain(self, weights: Floats) -> Floats:
        """How much a known point at each candidate would reduce the variance at the judged places.

        In closed form: the covariance squared over the variance of a new output.

        Args:
            weights: (g,) of the judged places, NaN for those that do not count.

        Returns:
            (m,) by how much `sum weights * trace of the covariance` would fall; zero where a point is of no use.
        """
        m = len(self.candidates)
        weights = weights * self.at.widened[m:]
        good = np.isfinite(weights) & self.judged.seen.all(axis=1)
        found = np.zeros(m)
        for process in self.at.processes:
            covariance = process.covariance(slice(m), m + np.flatnonzero(good))
            variance = process.variances[:m] + process.noise_variance
            found += np.trace(process.share) * (covariance**2 @ weights[good]) / variance
        return np.where(self.useful, found, 0.0)

    def information(self) -> Floats:
        """As of `DesignModel`: half the log of the variance of a new output over that of its noise, all three axes."""
        m = len(self.candidates)
        ratios = [one.outputs * np.log1p(one.variances[:m] / one.noise_variance) for one in self.at.processes]
        return np.where(self.useful, 0.5 * np.sum(ratios, axis=0), 0.0)

    def after(self, i: int) -> InverseDesignModel:
        """The design when one candidate is a known point too.

        Args:
            i: The number of the candidate.
        """
        return replace(self, at=self.at.with_known(i))


def can_design_experiments(calibration: Calibration | type) -> bool:
    """Whether a calibration says what one more known point would add.

    Args:
        calibration: A calibration, or a class of them.
    """
    return any(hasattr(calibration, name) for name in ("sensitivities", "position_processes"))


def design_methods() -> list[str]:
    """The methods that say what one more known point would add, of those that can be imported."""
    return [name for name, (_, made) in CALIBRATORS.importable().items() if can_design_experiments(made)]


def design_error(method: str) -> UsageError:
    """The error for a method that does not say what one more known point would add.

    Args:
        method: Its name.
    """
    return UsageError(
        f"{method} cannot say where to measure next.",
        why="its error bars do not say what one more known point would change",
        fix=f"use one of {', '.join(design_methods())}",
    )


def design_model_of(
    calibration: Calibration, candidates: Floats | Places, judged: Floats | Places, pilot: Calibration | None = None
) -> ForwardDesignModel | InverseDesignModel:
    """The design model of a calibration.

    Args:
        calibration: That of the rig.
        candidates: (m, 3) in the world, or places whose pixels are known.
        judged: (g, 3) in the world, or places whose pixels are known.
        pilot: Another calibration of the same rig, which predicts pixels; needed for a method that does not.

    Returns:
        The design model, with the covariance of a known position that the data state.

    Raises:
        UsageError: The method cannot say what one more known point would add, or nothing predicts pixels.
    """
    if not can_design_experiments(calibration):
        raise design_error(calibration.method)
    pilot = calibration if isinstance(calibration, PredictsPixels) else pilot

    def places(where: Floats | Places) -> Places:
        if isinstance(where, Places):
            return where
        if not isinstance(pilot, PredictsPixels):
            raise UsageError(
                f"{calibration.method} does not say what the cameras would see of a place.",
                fix="give a forward-gp calibration of the same points as well, or places whose pixels are known",
            )
        return Places.predicted(pilot, where)

    candidates, judged = places(candidates), places(judged)
    if isinstance(calibration, PredictsPixels):
        return replace(ForwardDesignModel.of(calibration, candidates, judged), place=_place(calibration.data))
    assert isinstance(calibration, HasPositionProcesses)
    at = calibration.position_processes(np.concatenate([candidates.uv, judged.uv]))
    return InverseDesignModel(candidates, judged, at, pilot if isinstance(pilot, PredictsPixels) else None)


def _place(data: Dataset) -> Floats:
    """(3, 3) the covariance of a known position, as those of the data state it."""
    if data.known is None or not (data.known.sd > 0).any():
        return np.zeros((3, 3))
    sd = np.nan_to_num(data.known.sd)
    return np.diag(np.median(sd**2, axis=0))
