"""Means over the splits, with their standard errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from implicam.compare.splits import RANDOM
from implicam.compare.trials import Trial
from implicam.dataset import Floats


@dataclass(frozen=True)
class Row:
    """The trials of one method with one number of known points: means, and standard errors over the splits.

    A number is averaged over the splits that have it: a fit may succeed and measure nothing.

    Attributes:
        method: Its name.
        known: Points trained on; their mean where all others trained.
        seeds: Splits in which the fit succeeded.
        mean: Name in `NUMBERS` -> mean; "measured" is the share of the held-out points that could be measured.
        standard_error: Name in `NUMBERS` -> standard error of the mean; NaN with fewer than two splits.
        failures: Why fits failed, each reason once.
        tried: How many splits there are.
        split: As of `Trial`.
        all_others: As of `Trial`.
    """

    method: str
    known: int
    seeds: int
    mean: dict[str, float]
    standard_error: dict[str, float]
    failures: tuple[str, ...]
    tried: int = 0
    split: str = RANDOM
    all_others: bool = False


NUMBERS = (
    "rmse", "median", "limit", "rmse_over_limit", "coverage_95", "ellipsoid_95", "nees", "measured", "fit_seconds",
    "rmse_common", "common",
)  # fmt: skip


def summarise(trials: Sequence[Trial]) -> list[Row]:
    """One row per kind of split, number of points and method, in the order of the trials.

    Args:
        trials: As of `compare_on`.
    """
    groups: dict[tuple[str, int, str], list[Trial]] = {}
    for trial in trials:
        known = 0 if trial.all_others else trial.known
        groups.setdefault((trial.split, known, trial.method), []).append(trial)
    return [_row(group) for group in groups.values()]


def _row(trials: list[Trial]) -> Row:
    good = [trial for trial in trials if not trial.failure]
    table = np.array([[_number(trial, key) for key in NUMBERS] for trial in good]).reshape(-1, len(NUMBERS))
    stats = dict(zip(NUMBERS, map(mean_and_error, table.T), strict=True))
    first = trials[0]
    return Row(
        first.method,
        round(np.mean([trial.known for trial in trials])),
        len(good),
        {key: mean for key, (mean, _) in stats.items()},
        {key: error for key, (_, error) in stats.items()},
        tuple(dict.fromkeys(trial.failure for trial in trials if trial.failure)),
        len(trials),
        first.split,
        first.all_others,
    )


def mean_and_error(values: Floats) -> tuple[float, float]:
    """The mean of values and its standard error; NaN values are left out.

    Args:
        values: (n,).

    Returns:
        Mean and standard error; NaN where there are too few values.
    """
    found = values[~np.isnan(values)]
    n = len(found)
    mean = float(found.mean()) if n else float("nan")
    with np.errstate(invalid="ignore"):  # an infinite number has no standard error
        return mean, float(found.std(ddof=1) / np.sqrt(n)) if n > 1 else float("nan")


def _number(trial: Trial, key: str) -> float:
    if key == "rmse_over_limit":
        return trial.rmse / trial.limit
    if key == "measured":
        return 1 - trial.unmeasured / trial.held_out
    return float(getattr(trial, key))


def as_json(trials: Sequence[Trial]) -> dict[str, Any]:
    """Trials and rows as plain values.

    Args:
        trials: As of `compare_on`.
    """
    return {"trials": [asdict(t) for t in trials], "rows": [asdict(row) for row in summarise(trials)]}
