"""Every method on every split: fit, measure, judge, and the error where all methods measured."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Protocol, runtime_checkable

import numpy as np

from implicam.calibrators import Calibration, Calibrator
from implicam.compare.splits import RANDOM, Split
from implicam.dataset import Dataset
from implicam.errors import DatasetError, FitError, ImplicamError, NumericalError, UsageError
from implicam.evaluation import Evaluation, evaluate
from implicam.measurement import Measurement
from implicam.progress import Progress, silent
from implicam.workers import Task, compute_on_cluster

NAN = float("nan")
_WHAT = "comparing"


@dataclass(frozen=True)
class Trial:
    """One method on one split. Lengths are in the dataset's unit; NaN where a number is not known.

    Attributes:
        method: Its name.
        known: Points trained on.
        seed: That of the `Split`.
        rmse: Root mean square error in 3D.
        median: Median error in 3D.
        limit: Root mean square of the Cramer-Rao limit at the same points.
        coverage_95: Coverage of the 95 % interval per axis, all axes together.
        ellipsoid_95: Coverage of the 95 % ellipsoid.
        nees: Mean of e' C^-1 e; 3 is right.
        held_out: Points to be measured.
        unmeasured: How many of them could not be measured.
        fit_seconds: Of this fit; where a method fits all splits at once, its share.
        failure: Why there are no numbers; empty where there are.
        split: The kind of the `Split`.
        left_out: That of the `Split`.
        all_others: That of the `Split`.
        rmse_common: Root mean square error over the points that every method measured (`compare_on` says which methods
            count).
        common: How many points these are.
        mean_sd: Stated standard deviation, mean over x, y, z and the points, as the paper averages it.
    """

    method: str
    known: int
    seed: int
    rmse: float = NAN
    median: float = NAN
    limit: float = NAN
    coverage_95: float = NAN
    ellipsoid_95: float = NAN
    nees: float = NAN
    held_out: int = 0
    unmeasured: int = 0
    fit_seconds: float = NAN
    failure: str = ""
    split: str = RANDOM
    left_out: str = ""
    all_others: bool = False
    rmse_common: float = NAN
    common: int = 0
    mean_sd: float = NAN


@runtime_checkable
class FitsMany(Protocol):
    """A method that fits many datasets in less time together than one by one."""

    def fit_many(self, datasets: Sequence[Dataset], progress: Progress = silent) -> Sequence[Calibration | FitError]:
        """Fit to each of several datasets.

        Args:
            datasets: What to fit to.
            progress: Called as the fits go on.

        Returns:
            For each dataset, in order, a calibration, or why there is none.
        """


@dataclass(frozen=True)
class _Judged:
    """A trial, and the squared error of each held-out point that was measured, by name."""

    trial: Trial
    squared: Mapping[str, float]


def compare_on(
    splits: Sequence[Split],
    methods: Mapping[str, Calibrator],
    progress: Progress = silent,
    scheduler: str | None = None,
) -> list[Trial]:
    """Fit and judge every method on every split.

    A fit that fails is a trial with a reason. Where methods measure different points, their errors are those of easy
    and of hard points, so each trial also has the error at the points that all of them measured. A method that measured
    nothing in a cell (all splits of one kind and number of points) does not count in that cell; one that measured
    something counts in every split of it, so that the means over the splits are of the same points, too.

    Args:
        splits: Which points train and which judge.
        methods: Name -> method.
        progress: Called before each fit; of a cluster, after each.
        scheduler: The address of a Dask scheduler whose workers fit and judge, side by side.

    Returns:
        The trials, in the order of the splits, then of the methods.

    Raises:
        UsageError: There is no method or no split.
        ImplicamError: There is no such cluster.
        DatasetError: Known positions are missing, or the parts of a split have different length units.
    """
    if not methods or not splits:
        raise UsageError("comparing needs at least one method, one number of points and one seed.")
    _check_lengths(splits)
    total, done = len(methods) * len(splits), 0
    trials: list[Trial] = []
    cells = [list(group) for _, group in groupby(splits, key=lambda split: split.cell)]
    if scheduler is not None:
        found = _on_cluster(cells, methods, scheduler, _Counting(progress, 0, total))
        return [trial for judged in found for trial in _with_common(judged)]
    for cell in cells:
        judged = {}
        for name, method in methods.items():
            judged[name] = _judge_cell(name, method, cell, _Counting(progress, done, total))
            done += len(cell)
        trials += _with_common(judged)
    progress(_WHAT, total, total)
    return trials


def _on_cluster(
    cells: Sequence[Sequence[Split]], methods: Mapping[str, Calibrator], scheduler: str, counting: _Counting
) -> list[dict[str, list[_Judged]]]:
    """Of each cell what every method did on its splits, each on some worker; a method that fits many at once gets all
    splits of a cell."""
    tasks: list[Task] = []
    places: dict[str, tuple[int, str, int]] = {}
    for number, cell in enumerate(cells):
        for name, method in methods.items():
            size = len(cell) if isinstance(method, FitsMany) else 1
            for start in range(0, len(cell), size):
                some = cell[start : start + size]
                given = {"name": name, "method": method, "splits": some}
                tasks.append(Task(f"{__name__}:judge_splits", f"{name}, fit {len(tasks)}", given))
                places[tasks[-1].name] = number, name, start
    found: list[dict[str, list[Any]]] = [{name: [None] * len(cell) for name in methods} for cell in cells]
    done = 0
    for task, judged in compute_on_cluster(scheduler, tasks):
        number, name, start = places[task]
        found[number][name][start : start + len(judged)] = judged
        done += len(judged)
        counting(done)
    return found


def judge_splits(name: str, method: Calibrator, splits: Sequence[Split]) -> list[_Judged]:
    """What a worker does: a method on some splits of one kind.

    Args:
        name: Of the method.
        method: The method.
        splits: Which points train and which judge.

    Returns:
        Of each split the trial, and the squared errors.
    """
    return _judge_cell(name, method, splits, _Counting(silent, 0, len(splits)))


@dataclass(frozen=True)
class _Counting:
    """Progress of one cell, counted in fits of the whole comparison."""

    progress: Progress
    before: int
    total: int

    def __call__(self, done: int) -> None:
        self.progress(_WHAT, self.before + done, self.total)


def _check_lengths(splits: Sequence[Split]) -> None:
    """Before the work: known positions are there, in one unit."""
    for split in splits:
        _ = split.train.positions, split.held_out.positions
        if split.train.length_unit != split.held_out.length_unit:
            raise DatasetError(
                f"{split.held_out.name!r} is in {split.held_out.length_unit}, and {split.train.name!r} is in "
                f"{split.train.length_unit}.",
                why="errors are differences of positions, so both must be in one length unit",
                fix="convert the known positions of one of them",
            )


def _judge_cell(name: str, method: Calibrator, cell: Sequence[Split], counting: _Counting) -> list[_Judged]:
    """The fits of a method that fits many at once are counted when they are all done."""
    fits = fit_each(method, [split.train for split in cell], counting, counting.progress)
    return [_judge(name, split, fit, seconds) for split, (fit, seconds) in zip(cell, fits, strict=True)]


def fit_each(
    method: Calibrator,
    datasets: Sequence[Dataset],
    starting: Callable[[int], None] = lambda i: None,
    progress: Progress = silent,
) -> Iterator[tuple[Calibration | ImplicamError, float]]:
    """Fit a method to each of several datasets, many at once where the method can.

    Args:
        method: The method.
        datasets: What to fit to.
        starting: Called with the number of a dataset before the work on it.
        progress: Called as a fit of many at once goes on.

    Yields:
        For each dataset, the calibration or why there is none, and the seconds that it took.
    """
    if isinstance(method, FitsMany):
        starting(0)
        start = time.perf_counter()
        fits = _fit_many(method, datasets, progress)
        seconds = (time.perf_counter() - start) / len(datasets)
        yield from ((fit, seconds) for fit in fits)
        return
    for i, data in enumerate(datasets):
        starting(i)
        start = time.perf_counter()
        fit = _fit(method, data)
        yield fit, time.perf_counter() - start


# Data that one method cannot use are its failure, not the end of the comparison. A mistake in its code is no result.
_CANNOT = (FitError, NumericalError, DatasetError)


def _fit(method: Calibrator, train: Dataset) -> Calibration | ImplicamError:
    try:
        return method.fit(train)
    except _CANNOT as error:
        return error
    except np.linalg.LinAlgError as error:
        return NumericalError(f"the equations have no solution: {error}.")


def _fit_many(
    method: FitsMany, datasets: Sequence[Dataset], progress: Progress
) -> Sequence[Calibration | ImplicamError]:
    try:
        return method.fit_many(datasets, progress)
    except _CANNOT as error:
        return [error] * len(datasets)


def judge(name: str, split: Split, fit: Calibration | ImplicamError, seconds: float) -> Trial:
    """The trial of a fit at the held-out points of a split.

    Args:
        name: Of the method.
        split: The split.
        fit: The calibration, or why there is none.
        seconds: That the fit took.
    """
    return _judge(name, split, fit, seconds).trial


def _judge(name: str, split: Split, fit: Calibration | ImplicamError, seconds: float) -> _Judged:
    known: dict[str, Any] = {"split": split.kind, "left_out": split.left_out, "all_others": split.all_others}
    blank = Trial(name, len(split.train), split.seed, **known)
    if isinstance(fit, ImplicamError):
        return _Judged(replace(blank, failure=fit.what), {})
    try:
        evaluation = evaluate(fit, split.held_out, regions=False)
    except (FitError, NumericalError) as error:
        return _Judged(replace(blank, failure=error.what), {})
    trial = replace(trial_from_evaluation(evaluation, name, len(split.train), split.seed, seconds), **known)
    return _Judged(trial, _squared(evaluation))


def trial_from_evaluation(evaluation: Evaluation, name: str, known: int, seed: int, seconds: float) -> Trial:
    """The numbers of an evaluation that a comparison shows.

    Args:
        evaluation: The evaluation.
        name: Of the method.
        known: Points trained on.
        seed: Of the split.
        seconds: That the fit took.
    """
    overall = evaluation.coverage.overall
    level = overall.level(0.95)
    return Trial(
        name,
        known,
        seed,
        rmse=overall.rmse,
        median=overall.median_error,
        limit=overall.rmse / overall.rmse_over_limit,
        coverage_95=level.pooled.value,
        ellipsoid_95=level.ellipsoid.value,
        nees=overall.nees.value,
        held_out=len(evaluation.data),
        unmeasured=overall.unmeasured,
        fit_seconds=seconds,
        mean_sd=mean_sd(evaluation.measurement),
    )


def mean_sd(measurement: Measurement) -> float:
    """Stated standard deviation, mean over x, y, z and the points that were measured; NaN where none was.

    Args:
        measurement: The measured points.
    """
    sd = measurement.sd[measurement.measured]
    return float(sd.mean()) if len(sd) else NAN


def _squared(evaluation: Evaluation) -> dict[str, float]:
    squared = ((evaluation.measurement.xyz - evaluation.true_xyz) ** 2).sum(axis=1)
    names = map(str, evaluation.data.points)
    return {name: float(value) for name, value in zip(names, squared, strict=True) if np.isfinite(value)}


def _with_common(judged: Mapping[str, list[_Judged]]) -> list[Trial]:
    """The trials of a cell by split, each with the error at the points that all methods measured."""
    counting = [k for k, trials in enumerate(judged.values()) if any(one.squared for one in trials)]
    trials: list[Trial] = []
    for row in zip(*judged.values(), strict=True):
        measured = [row[k].squared.keys() for k in counting]
        common = set.intersection(*map(set, measured)) if measured else set()
        trials += [_at(one, common) if k in counting else one.trial for k, one in enumerate(row)]
    return trials


def _at(one: _Judged, common: set[str]) -> Trial:
    if not common:
        return one.trial
    mean = float(np.mean([one.squared[name] for name in sorted(common)]))
    return replace(one.trial, rmse_common=mean**0.5, common=len(common))
