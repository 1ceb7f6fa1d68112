"""Methods side by side: the same splits, the same held-out points, in the same run, with error bars over seeds."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from implicam.calibrators import Calibrator
from implicam.dataset import Dataset
from implicam.errors import FitError, NumericalError, UsageError
from implicam.evaluate import Evaluation, evaluate
from implicam.progress import Progress, silent


@dataclass(frozen=True)
class Trial:
    """One method, one number of known points, one random split. Lengths in the dataset's unit.

    limit: rms of the Cramer-Rao limit at the same points, NaN where unknown. coverage_95: per axis, pooled;
    ellipsoid_95: of the 3D ellipsoid. held_out points were to be measured, and unmeasured of them could not be.
    failure: why there are no numbers, else empty.
    """

    method: str
    known: int
    seed: int
    rmse: float = float("nan")
    median: float = float("nan")
    limit: float = float("nan")
    coverage_95: float = float("nan")
    ellipsoid_95: float = float("nan")
    nees: float = float("nan")
    held_out: int = 0
    unmeasured: int = 0
    fit_seconds: float = float("nan")
    failure: str = ""


@dataclass(frozen=True)
class Row:
    """The trials of one method with one number of known points: means, and standard errors over the seeds.

    The keys are NUMBERS; `measured` is the share of the held-out points that could be measured.
    """

    method: str
    known: int
    seeds: int
    mean: dict[str, float]
    standard_error: dict[str, float]
    failures: tuple[str, ...]


NUMBERS = (
    "rmse", "median", "limit", "rmse_over_limit", "coverage_95", "ellipsoid_95", "nees", "measured", "fit_seconds",
)  # fmt: skip


def compare(
    data: Dataset,
    methods: Mapping[str, Calibrator],
    sizes: Sequence[int],
    *,
    seeds: int = 5,
    check: Dataset | None = None,
    progress: Progress = silent,
) -> list[Trial]:
    """Fit each method to `n` random known points, for each n of `sizes` and each seed, and evaluate.

    Held out are the points not drawn, or those of `check`, another dataset of the same rig: give it where the known
    points stand on a lattice, because on a lattice the held-out points lie on planes that were also trained on.
    """
    if seeds < 1 or not sizes or not methods:
        raise UsageError("comparing needs at least one method, one number of points and one seed.")
    if check is None and max(sizes) >= len(data):
        raise UsageError(
            f"{max(sizes)} of {len(data)} points leave none to evaluate on.",
            fix=f"choose numbers below {len(data)}, or give another dataset with --check",
        )
    trials: list[Trial] = []
    # No split is drawn twice: neither for the same size again, nor where all points are taken.
    splits = [(size, seed) for size in dict.fromkeys(sizes) for seed in range(1 if size == len(data) else seeds)]
    total = len(methods) * len(splits)
    for size, seed in splits:
        train, rest = (data, data) if size == len(data) else data.split(size, seed=seed)
        for name, method in methods.items():
            progress("comparing", len(trials), total)
            trials.append(_trial(name, method, train, rest if check is None else check, seed))
    progress("comparing", total, total)
    return trials


def _trial(name: str, method: Calibrator, train: Dataset, held_out: Dataset, seed: int) -> Trial:
    start = time.perf_counter()
    try:
        calibration = method.fit(train)
    except (FitError, NumericalError) as error:
        return Trial(name, len(train), seed, failure=error.what)
    seconds = time.perf_counter() - start
    return trial_of(evaluate(calibration, held_out, regions=False), name, len(train), seed, seconds)


def trial_of(evaluation: Evaluation, name: str, known: int, seed: int, seconds: float) -> Trial:
    """The numbers of an evaluation that a comparison shows."""
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
    )


def summarise(trials: Sequence[Trial]) -> list[Row]:
    """One row per method and number of points, in the order of the trials."""
    groups: dict[tuple[int, str], list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.known, trial.method), []).append(trial)
    return [_row(group) for group in groups.values()]


def _row(trials: list[Trial]) -> Row:
    good = [trial for trial in trials if not trial.failure]
    table = np.array([[_number(trial, key) for key in NUMBERS] for trial in good]).reshape(-1, len(NUMBERS))
    n = len(table)
    mean = table.mean(axis=0) if n else np.full(len(NUMBERS), np.nan)
    error = table.std(axis=0, ddof=1) / np.sqrt(n) if n > 1 else np.full(len(NUMBERS), np.nan)
    return Row(
        trials[0].method,
        trials[0].known,
        n,
        dict(zip(NUMBERS, mean.tolist(), strict=True)),
        dict(zip(NUMBERS, error.tolist(), strict=True)),
        tuple(dict.fromkeys(trial.failure for trial in trials if trial.failure)),
    )


def _number(trial: Trial, key: str) -> float:
    if key == "rmse_over_limit":
        return trial.rmse / trial.limit
    if key == "measured":
        return 1 - trial.unmeasured / trial.held_out
    return float(getattr(trial, key))


def as_json(trials: Sequence[Trial]) -> dict[str, Any]:
    """Trials and rows as plain values."""
    return {"trials": [asdict(t) for t in trials], "rows": [asdict(row) for row in summarise(trials)]}
