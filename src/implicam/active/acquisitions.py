"""Where to measure next: a score for every candidate, the largest wins. CONTRIBUTING.md has the recipe for one more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from implicam.active.design_model import DesignModel
from implicam.dataset import Floats
from implicam.errors import UsageError
from implicam.registry import Registry, offers


class Acquisition(Protocol):
    """A rule that scores candidates; it has no state: the same design and random numbers give the same scores.

    Attributes:
        name: Its name on the command line and in files.
        same_candidates: Whether the loop offers it the same candidates in the same order each time, without as many as
            there are known points, instead of new ones.
    """

    name: ClassVar[str]
    same_candidates: ClassVar[bool] = False

    def scores(self, design: DesignModel, rng: np.random.Generator) -> Floats:
        """How much a known point at each candidate is expected to help.

        Args:
            design: What is known now and what one more point would change, with m candidates.
            rng: Random numbers, for rules that need some.

        Returns:
            (m,) scores, never negative; NaN where a point is of no use.
        """


@dataclass(frozen=True)
class Random(Acquisition):
    """All candidates alike."""

    name: ClassVar[str] = "random"

    def scores(self, design: DesignModel, rng: np.random.Generator) -> Floats:
        """Random numbers.

        Args:
            design: What is known now and what one more point would change, with m candidates.
            rng: Random numbers.

        Returns:
            (m,) from 0 to 1.
        """
        return rng.random(len(design.candidates))


@dataclass(frozen=True)
class Sobol(Acquisition):
    """Evenly spread, whatever the cameras: the candidates in their own order, which is that of a Sobol sequence."""

    name: ClassVar[str] = "sobol"
    same_candidates: ClassVar[bool] = True

    def scores(self, design: DesignModel, rng: np.random.Generator) -> Floats:
        """The candidates in their own order.

        Args:
            design: What is known now and what one more point would change, with m candidates.
            rng: Not used.

        Returns:
            (m,) the first candidate has the largest score.
        """
        return np.arange(len(design.candidates), 0, -1, dtype=np.float64)


@dataclass(frozen=True)
class MaximumVariance(Acquisition):
    """The paper's rule, uncertainty sampling: the largest standard deviation, averaged over x, y and z."""

    name: ClassVar[str] = "variance"

    def scores(self, design: DesignModel, rng: np.random.Generator) -> Floats:
        """The mean standard deviation of x, y and z of a position measured at each candidate.

        Args:
            design: What is known now and what one more point would change, with m candidates.
            rng: Not used.

        Returns:
            (m,) in the length unit; NaN where nothing can be measured.
        """
        total = design.at_candidates.total
        return np.asarray(np.sqrt(np.diagonal(total, axis1=1, axis2=2)).mean(axis=1), dtype=np.float64)


@dataclass(frozen=True)
class RelativeExcess(Acquisition):
    """What more points can still remove: total variance over the variance that pixel noise alone would leave."""

    name: ClassVar[str] = "excess"

    def scores(self, design: DesignModel, rng: np.random.Generator) -> Floats:
        """The ratio of the total variance to that which pixel noise alone would leave, minus one.

        Args:
            design: What is known now and what one more point would change, with m candidates.
            rng: Not used.

        Returns:
            (m,) scores; NaN where nothing can be measured.
        """
        return np.asarray(np.maximum(design.at_candidates.excess**2 - 1, 0), dtype=np.float64)


@dataclass(frozen=True)
class IntegratedVariance(Acquisition):
    """By how much a point would reduce the variance of the whole workspace (Cohn, Ghahramani & Jordan 1996).

    Attributes:
        relative: Whether variances are divided by what pixel noise alone would leave; if not, they are in the squared
            length unit, and the far end, with its large noise, counts most.
        power: Of the excess that a place has now; the larger, the more the worst places count. The score is the slope
            of the mean of `excess^(2 power)`.
    """

    relative: bool = True
    power: float = 2.0

    name: ClassVar[str] = "integrated"

    def scores(self, design: DesignModel, rng: np.random.Generator) -> Floats:
        """By how much a known point at each candidate would reduce the weighted mean variance of the judged places.

        Args:
            design: What is known now and what one more point would change, with m candidates.
            rng: Not used.

        Returns:
            (m,) scores; zero where a point is of no use.
        """
        now = design.at_judged
        floor = np.trace(now.floor, axis1=1, axis2=2) if self.relative else 1.0
        excess = np.trace(now.total, axis1=1, axis2=2) / floor
        worst = np.nanmax(excess, initial=0.0) or 1.0
        weights = (excess / worst) ** (self.power - 1) / floor / max(1, int(now.measured.sum()))
        return np.asarray(design.gain(weights), dtype=np.float64)


@dataclass(frozen=True)
class DOptimal(Acquisition):
    """The view that tells most about the unknowns, wherever in the workspace that helps: information, in nats."""

    name: ClassVar[str] = "d-optimal"

    def scores(self, design: DesignModel, rng: np.random.Generator) -> Floats:
        """Half the log of the ratio of the determinants, with a known point at each candidate and without.

        Args:
            design: What is known now and what one more point would change, with m candidates.
            rng: Not used.

        Returns:
            (m,) nats; zero where a point is of no use.
        """
        return design.information()


ACQUISITIONS: Registry[Acquisition] = Registry(
    "acquisition",
    {
        rule.name: rule
        for rule in (Random(), Sobol(), MaximumVariance(), RelativeExcess(), IntegratedVariance(), DOptimal())
    },
    "implicam.acquisitions",
    offers(Acquisition, "name", a_class=False),
)
"""Name -> rule."""

DEFAULT_ACQUISITION = IntegratedVariance.name


def acquisition_from_name(name: str) -> Acquisition:
    """The rule with this name.

    Args:
        name: A key of `ACQUISITIONS`.

    Raises:
        UsageError: There is no such rule, or a variant is asked for; acquisitions have none.
    """
    rule, variant = ACQUISITIONS.find(name)
    if variant:
        raise UsageError(f"the acquisition {rule.name} has no variants.", fix=f"write {rule.name}")
    return rule


@dataclass(frozen=True, eq=False)
class Choice:
    """Candidates that were chosen, in the order in which to visit them.

    Attributes:
        index: Their numbers among the candidates.
        scores: The score of each when it was chosen.
    """

    index: list[int]
    scores: list[float]
    _before_last: tuple[DesignModel, int]

    @property
    def after(self) -> DesignModel:
        """The design when all of them are known points."""
        design, last = self._before_last
        return design.after(last)


def choose(
    design: DesignModel,
    rule: Acquisition,
    rng: np.random.Generator,
    *,
    count: int = 1,
    here: Floats | None = None,
    reach: float = np.inf,
) -> Choice:
    """Choose the best candidates, each as if those before it were known already.

    Args:
        design: What is known now, with m candidates.
        rule: What scores the candidates.
        rng: Random numbers for the rule.
        count: How many to choose; fewer come back where no more are of any use.
        here: (3,) where the target is now, in the world; with it, the chosen ones are ordered to a short path.
        reach: The distance that costs as much time as one measurement. A score then counts per time, so that a robot
            does not cross the volume for little.

    Returns:
        The candidates chosen, in the order in which to visit them.

    Raises:
        UsageError: No candidate is of any use.
    """
    chosen: list[int] = []
    scores: list[float] = []
    place = here
    for _ in range(count):
        if chosen:
            design = design.after(chosen[-1])
        score = np.where(design.useful, rule.scores(design, rng), np.nan)
        score[chosen] = np.nan
        if not np.isfinite(score).any():
            break
        worth = score
        if place is not None and np.isfinite(reach):
            worth = score / (1 + np.linalg.norm(design.candidates.xyz - place, axis=1) / reach)
        best = int(np.nanargmax(worth))
        chosen.append(best)
        scores.append(float(score[best]))
        place = design.candidates.xyz[best] if place is not None else None
    if not chosen:
        raise UsageError(
            "no candidate can be used for calibration.",
            why="the cameras would see none of them",
            fix="give another workspace (--workspace), one that the cameras look at",
        )
    order = short_path(design.candidates.xyz[chosen], here)
    return Choice([chosen[k] for k in order], [scores[k] for k in order], (design, chosen[-1]))


def short_path(xyz: Floats, here: Floats | None) -> list[int]:
    """A short way through all places: to the nearest, and on; then pieces are turned round while that helps (2-opt).

    Args:
        xyz: (k, 3) places.
        here: (3,) where the path begins; None for the order in which they are.

    Returns:
        The numbers of the places, in the order in which to visit them.

    >>> short_path(np.array([[3.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.zeros(3))
    [1, 2, 0]
    """
    if here is None:
        return list(range(len(xyz)))
    left, order, place = list(range(len(xyz))), [], here
    while left:
        order.append(min(left, key=lambda k: float(np.linalg.norm(xyz[k] - place))))
        left.remove(order[-1])
        place = xyz[order[-1]]
    better = True
    while better:
        better = False
        for i in range(len(order)):
            for j in range(i + 2, len(order) + 1):
                turned = [*order[:i], *reversed(order[i:j]), *order[j:]]
                if path_length(xyz[turned], here) < path_length(xyz[order], here) * (1 - 1e-12):
                    order, better = turned, True
    return order


def path_length(xyz: Floats | Sequence[Floats], here: Floats) -> float:
    """The length of the path from `here` through places, in their order.

    Args:
        xyz: (k, 3) places.
        here: (3,) where the path begins.

    Returns:
        The length, in the unit of the places.
    """
    return float(np.linalg.norm(np.diff(np.concatenate([here[None], np.asarray(xyz)]), axis=0), axis=1).sum())
