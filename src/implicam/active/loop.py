"""The loop: while not stop: choose, observe, tell, refit.

loop = Loop(ForwardGP(), Workspace.box(low, high), rule=Below(0.2) | Budget(60))
loop.run(oracle)                                  # or, one at a time:
while not loop.stop:
    (target,) = loop.ask()
    loop.tell(oracle.observe(target))
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import count, islice
from typing import NamedTuple, Protocol

import numpy as np
from scipy.spatial import cKDTree

from implicam.active.acquisitions import (
    DEFAULT_ACQUISITION,
    Acquisition,
    Choice,
    acquisition_from_name,
    choose,
    short_path,
)
from implicam.active.design_model import (
    ForwardDesignModel,
    InverseDesignModel,
    Places,
    PredictedCovariance,
    can_design_experiments,
    design_error,
    design_model_of,
)
from implicam.active.stopping import Never, Rule, Step
from implicam.active.workspace import Workspace
from implicam.calibrators import Calibration, Calibrator, ForwardGP, ForwardGPCalibration, PredictsPixels, Updatable
from implicam.dataset import Dataset, Floats, join
from implicam.errors import FitError, ImplicamError, UsageError
from implicam.progress import Progress, silent
from implicam.rig_model import MIN_POINTS_PER_CAMERA
from implicam.threads import blas_threads

MAX_WARM_START_GROWTH = 1.25
"""Between two fits from no guess the number of points grows by this factor at most; the same for the forward model that
predicts pixels for inverse-gp."""

MAX_COLD_START_POINTS = 16
"""Up to so many points each fit begins from no guess: they say little about where the optimum is."""

REFUSED_RADIUS_RATIO, RELATIVE_PLACE_TOLERANCE = 0.05, 1e-6
"""Part of the workspace's size: so near to a place where no target could be measured none is asked for again; and, of a
list of places, how far rounding may move one."""

MAX_SKIPPED_TARGETS = 20
"""The loop ends after so many targets in a row that could not be measured."""


@dataclass(frozen=True, eq=False)
class Target:
    """Where to put the next known point.

    Attributes:
        name: The name of the point.
        xyz: (3,) in the world.
        uv: (cameras, 2) the pixel at which each camera will see it; NaN where it will not, or where no calibration is
            there yet.
        score: Of the acquisition; NaN for a point to begin with.
    """

    name: str
    xyz: Floats
    uv: Floats
    score: float = float("nan")


def make_targets(places: Places, chosen: Choice, data: Dataset) -> list[Target]:
    """The chosen candidates as targets, with names that no point of the data has.

    Args:
        places: The candidates.
        chosen: Which of them, in the order in which to visit them.
        data: What is known already.
    """
    uv = np.where(places.seen[..., None], places.uv, np.nan)
    return [
        Target(name, places.xyz[i], uv[i], score)
        for name, i, score in zip(new_point_names(data), chosen.index, chosen.scores, strict=False)
    ]


def new_point_names(data: Dataset | None) -> Iterator[str]:
    """Names for new points, without end: p and a number, from the number of points on.

    Args:
        data: Known points, whose names are left out; None for none.
    """
    used = set() if data is None else set(data.points.tolist())
    names = (f"p{number:03d}" for number in count(len(used) + 1))
    return (name for name in names if name not in used)


class Answer(NamedTuple):
    """What came of a target.

    Attributes:
        data: One shot of known points; None where nothing was measured.
        reason: Why nothing was measured, in words.
    """

    data: Dataset | None
    reason: str = ""


class Oracle(Protocol):
    """Answers what the cameras see when the target is there."""

    def observe(self, target: Target) -> Answer:
        """Measure a known point at a target, or near it; a target that cannot be measured is no error.

        Args:
            target: Where.

        Returns:
            What the cameras saw, or the reason why nothing was measured.
        """


@dataclass(eq=False)
class Loop:
    """Active learning of a calibration; it changes with each point that it is told.

    Attributes:
        calibrator: The method.
        workspace: Where targets can be, and where the calibration has to be good.
        acquisition: What scores the candidates.
        rule: When to stop.
        start: The number of evenly spread points before the first fit, on a short way from the middle.
        candidates: How many places are scored for the next target.
        judged: How many places the calibration is judged at.
        reach: The distance that costs as much time as one measurement.
        seed: Of the candidates, the judged places and random rules.
        growth: A fit begins from no guess when the number of points has grown by this factor, and from the last result
            otherwise; 1 for always from no guess, as the paper does.
        pool: A recorded dataset from which the targets are chosen, with its own pixels.
        data: What is known already.
        history: One step for each change of the data: the uncertainty over the workspace.
        calibration: The last fit; None before there is one.
        problem: Why the last fit failed; None where it did not.
        predicted: The covariance at the judged places; None before there is a calibration.
        judged_at: (g, 3) the judged places in the world.
    """

    calibrator: Calibrator
    workspace: Workspace
    acquisition: Acquisition = field(default_factory=lambda: acquisition_from_name(DEFAULT_ACQUISITION))
    rule: Rule = field(default_factory=Never)
    start: int = MIN_POINTS_PER_CAMERA
    candidates: int = 1500
    judged: int = 400
    reach: float = np.inf
    seed: int = 0
    growth: float = MAX_WARM_START_GROWTH
    pool: Dataset | None = None
    data: Dataset | None = None

    def __post_init__(self) -> None:
        self.history: list[Step] = []
        self.calibration: Calibration | None = None
        self.problem: ImplicamError | None = None
        self.predicted: PredictedCovariance | None = None
        self.judged_at: Floats = self.workspace.judged(self.judged, self.seed)
        self._started = time.monotonic()
        self._refused: list[tuple[Floats, str]] = []
        self._pilot: ForwardGPCalibration | None = None
        self._asked = self._cold_start_points = 0
        if self.data is not None:
            self.reset(self.data)

    @property
    def stop(self) -> str:
        """Why to stop, in words; empty where not yet."""
        return self.rule.met(self.history, self.data.length_unit if self.data is not None else "")

    @property
    def points(self) -> int:
        """How many known points there are."""
        return 0 if self.data is None else len(self.data)

    @property
    def skipped(self) -> list[tuple[Floats, str]]:
        """Where targets could not be measured, (3,) in the world, and why."""
        return self._refused

    def ask(self, number: int = 1, here: Floats | None = None) -> list[Target]:
        """The next targets, in the order in which to visit them.

        Args:
            number: How many.
            here: (3,) where the target is now, in the world; None where that does not matter.

        Raises:
            UsageError: No place is left that any camera would see.
        """
        self._asked += 1
        if self.calibration is None:
            return self._starting_targets(number, here)
        rng = np.random.default_rng([self.seed, self._asked, 3])
        try:
            with blas_threads(1):  # thousands of small matrices: threads would only wait for each other
                design = self._design_model()
                chosen = choose(design, self.acquisition, rng, count=number, here=here, reach=self.reach)
        except FitError as error:  # the forward model of inverse-gp: more points will help
            self.problem = error
            return self._starting_targets(number, here)
        assert self.data is not None
        targets = make_targets(design.candidates, chosen, self.data)
        if self.pool is None:
            return targets
        return [replace(target, name=self._name(target.xyz, k)) for k, target in enumerate(targets)]

    def tell(self, answer: Answer | Dataset, target: Target | None = None, progress: Progress = silent) -> None:
        """Add what was measured and fit again.

        Args:
            answer: What was measured, or the reason why nothing was.
            target: The target that was asked for; where nothing was measured, it is not asked for again.
            progress: Called as the fit goes on.

        Raises:
            DatasetError: The new points do not go with those that are there: other cameras, another unit, a name twice.
        """
        data, reason = (answer, "") if isinstance(answer, Dataset) else answer
        if data is None:
            if target is not None:
                self.refuse(target.xyz, reason)
            return
        self.reset(data if self.data is None else join(self.data, data), progress)

    def refuse(self, xyz: Floats, reason: str) -> None:
        """Remember a place where no target could be measured; neither it nor what is near it is asked for again.

        Args:
            xyz: (3,) the place in the world.
            reason: Why, in words.
        """
        self._refused.append((xyz, reason))

    def reset(self, data: Dataset | None, progress: Progress = silent) -> None:
        """Go on with other known points: some that were there already, or fewer because one was withdrawn.

        Args:
            data: All known points from now on; None for none. With fewer points than before, the history is cut.
            progress: Called as the fit goes on.
        """
        if data is None or self.data is None or len(data) <= len(self.data):
            self._pilot = None
            self.history = [step for step in self.history if data is not None and step.points < len(data)]
        self.data = data
        before, self.calibration = self.calibration, None
        self.predicted = self.problem = None
        if data is not None and len(data) >= self.start:
            try:
                self.calibration = self._fit(before, data, progress)
            except FitError as error:
                self.problem = error  # more points will help
        if data is not None:
            self.history.append(self._step())

    def run(self, oracle: Oracle, progress: Progress = silent) -> Loop:
        """Ask and tell until the rule says stop, no place is left, or too many targets in a row were not measured.

        Args:
            oracle: What measures at a target.
            progress: Called after each target.

        Returns:
            The loop itself.
        """
        in_vain = 0
        while not self.stop and in_vain < MAX_SKIPPED_TARGETS:
            try:
                (target, *_) = self.ask(here=None if self.data is None else self.data.xyz[-1])
            except UsageError:
                break
            answer = oracle.observe(target)
            in_vain = in_vain + 1 if answer.data is None else 0
            self.tell(answer, target)
            progress("measuring", self.points, self.points + 1)
        return self

    def _fit(self, before: Calibration | None, data: Dataset, progress: Progress) -> Calibration:
        """A fit to all points, begun from the last result; from no guess too when there are many more points."""
        if self.growth <= 1:
            return self.calibrator.fit(data, progress)
        anew = not MAX_COLD_START_POINTS < len(data) < self.growth * self._cold_start_points
        if anew:
            self._cold_start_points = len(data)
        if isinstance(before, Updatable) and len(before.data) < len(data):
            return before.refit_from(data, progress, anew=anew)
        return self.calibrator.fit(data, progress)

    def _starting_targets(self, number: int, here: Floats | None) -> list[Target]:
        """Places to begin with: the evenly spread ones along a short way from the middle; when they are used up, those
        that are farthest from what is known and what was refused."""
        used = [*(self.data.xyz if self.data is not None else ()), *(xyz for xyz, _ in self._refused)]
        if self.pool is None and len(used) + number <= self.start:
            places = self._left_of_way(used)[:number]
        else:
            places = self._farthest(used, number)
        nowhere = np.full((self._cameras, 2), np.nan)
        return [Target(self._name(place, k), place, nowhere) for k, place in enumerate(places)]

    def _left_of_way(self, used: Sequence[Floats]) -> list[Floats]:
        """The places to begin with that are left, each next to the one before. A target is measured near its place, so
        each point that was used stands for the nearest of them."""
        spread, middle = self.workspace.design(self.start, self.seed), self.workspace.centre
        first = spread[np.argmin(np.linalg.norm(spread - middle, axis=1))]
        left = list(spread[short_path(spread, first)])
        for place in used:
            left.pop(int(np.argmin(np.linalg.norm(np.array(left) - place, axis=1))))
        return left

    def _farthest(self, used: list[Floats], number: int) -> list[Floats]:
        """Places that are as far from what was used, and from each other, as can be."""
        pool = self.pool.xyz if self.pool is not None else self.workspace.candidates(self.candidates, self.seed)
        if self.pool is None and self.workspace.places is not None:
            pool = self._not_visited(pool)
        places: list[Floats] = []
        for _ in range(number):
            free = pool[[not any(np.array_equal(xyz, place) for place in used) for xyz in pool]]
            if not len(free):
                break
            places.append(free[0] if not used else free[np.argmax(_distance(free, np.array(used)))])
            used.append(places[-1])
        if not places:
            raise UsageError("no place of the workspace is left.", fix="give a larger one (--workspace)")
        return places

    @property
    def _cameras(self) -> int:
        known = self.data if self.data is not None else self.pool
        return 0 if known is None else len(known.cameras)

    def _name(self, xyz: Floats, k: int) -> str:
        if self.pool is not None:
            return str(self.pool.points[int(np.argmin(np.linalg.norm(self.pool.xyz - xyz, axis=1)))])
        return next(islice(new_point_names(self.data), k, None))

    def _design_model(self) -> ForwardDesignModel | InverseDesignModel:
        assert self.calibration is not None
        candidates: Floats | Places
        if self.pool is not None:
            candidates = Places.recorded(self.pool.select(self._unused_rows()))
        else:
            candidates = self._free_candidates()
        return design_model_of(self.calibration, candidates, self._judged(), self._forward())

    def _unused_rows(self) -> list[int]:
        assert self.pool is not None
        used = {*(self.data.points.tolist() if self.data is not None else ())}
        refused = {tuple(xyz) for xyz, _ in self._refused}
        left = [
            i
            for i, (name, xyz) in enumerate(zip(self.pool.points.tolist(), self.pool.xyz, strict=True))
            if name not in used and tuple(xyz) not in refused
        ]
        if not left:
            raise UsageError("every point of the pool is used.", fix="record more, or stop here")
        return left

    def _free_candidates(self) -> Floats:
        """Places where the next target may be: without the surroundings of what could not be measured, and of a list
        of places without those that are known."""
        same, places = self.acquisition.same_candidates, self.workspace.places
        # Other candidates each time, or places between them would never be measured.
        seed = self.seed if same else 1000 * self.seed + self._asked
        number = self.candidates + (self.points if same else 0)
        if places is not None:  # all of a list: one by one they are used up, whatever the rule
            number = max(number, len(places))
        candidates = self.workspace.candidates(number, seed)
        size = self.workspace.size
        if places is not None:
            candidates = self._not_visited(candidates)
            radius = RELATIVE_PLACE_TOLERANCE * size
        else:
            candidates = candidates[self.points :] if same else candidates
            radius = REFUSED_RADIUS_RATIO * size
        for place, _ in self._refused:
            candidates = candidates[np.linalg.norm(candidates - place, axis=1) > radius]
        if not len(candidates):
            raise UsageError("no place of the workspace is left.", fix="give a larger one (--workspace)")
        return candidates[: self.candidates]

    def _not_visited(self, places: Floats) -> Floats:
        """The places (n, 3) of a list that no known point stands for. A known point is where the target really was, so
        it stands for the nearest place, if that is nearer than half way to the next."""
        if self.data is None or len(places) < 2:
            return places
        tree = cKDTree(places)
        spacing = tree.query(places, k=2)[0][:, 1]
        distance, nearest = tree.query(self.data.xyz)
        visited = np.zeros(len(places), dtype=np.bool_)
        visited[nearest[distance <= 0.5 * spacing[nearest]]] = True
        return places[~visited]

    def _forward(self) -> Calibration | None:
        """For a method that does not predict pixels, a forward model of the same points that does; else None."""
        if self.calibration is None or self.data is None or isinstance(self.calibration, PredictsPixels):
            return None
        if not can_design_experiments(self.calibration):
            raise design_error(self.calibration.method)
        if self._pilot is None or len(self.data) >= MAX_WARM_START_GROWTH * len(self._pilot.data):
            self._pilot = ForwardGP().fit(self.data)
            self._judged_by_pilot = Places.predicted(self._pilot, self.judged_at)
        return self._pilot

    def _judged(self) -> Floats | Places:
        """The judged places; with their pixels where a forward model predicts them, which is costly."""
        return self.judged_at if self._forward() is None else self._judged_by_pilot

    def _step(self) -> Step:
        """The uncertainty now; also sets `predicted`."""
        passed = time.monotonic() - self._started
        if self.calibration is None:
            return Step(self.points, seconds=passed)
        try:
            with blas_threads(1):
                design = design_model_of(self.calibration, self.judged_at[:0], self._judged(), self._forward())
                predicted = design.at_judged
        except FitError as error:
            self.problem = error
            return Step(self.points, seconds=passed)
        self.predicted = predicted
        return summarise_step(predicted, self.points, passed)


def summarise_step(predicted: PredictedCovariance, points: int, seconds: float = 0.0) -> Step:
    """The uncertainty over the places where something can be measured.

    Args:
        predicted: The covariance at the judged places.
        points: How many known points there are.
        seconds: Since the beginning.

    Returns:
        The step; its lengths are NaN where nothing can be measured.
    """
    u95, excess = predicted.u95[predicted.measured], predicted.excess[predicted.measured]
    share = float(predicted.measured.mean()) if len(predicted.measured) else 0.0
    if not len(u95):
        return Step(points, seconds=seconds)
    return Step(
        points, float(u95.max()), float(u95.mean()), float(np.quantile(u95, 0.95)), float(np.quantile(excess, 0.95)),
        share, seconds,
    )  # fmt: skip


def _distance(xyz: Floats, others: Floats) -> Floats:
    """(n,) from each of (n, 3) to the nearest of others (k, 3)."""
    found: Sequence[Floats] = [np.linalg.norm(xyz - other, axis=1) for other in others]
    return np.asarray(np.min(found, axis=0), dtype=np.float64)
