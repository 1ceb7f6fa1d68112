"""Methods side by side: the same splits, the same held-out points, in the same run, with error bars over the splits.

A `Split` says which points train and which judge (splits.py); `compare_on` fits and judges every method on every split
(trials.py); `summarise` makes a row of the trials of a method (summary.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from implicam.calibrators import Calibrator
from implicam.compare.splits import RANDOM, SHOT, Split, plane_axis, plane_splits, random_splits, shot_splits
from implicam.compare.summary import NUMBERS, Row, as_json, mean_and_error, summarise
from implicam.compare.trials import Trial, compare_on, fit_each, judge, trial_from_evaluation
from implicam.dataset import Dataset
from implicam.progress import Progress, silent


def compare(
    data: Dataset,
    methods: Mapping[str, Calibrator],
    sizes: Sequence[int],
    *,
    seeds: int = 5,
    check: Dataset | None = None,
    progress: Progress = silent,
) -> list[Trial]:
    """Fit each method to random known points, for each number of points and each seed, and evaluate.

    Held out are the points that were not drawn, or those of `check`. Give `check` where the known points stand on a
    lattice, because there the held-out points lie on planes that were also trained on. Without such a dataset,
    `compare_on(plane_splits(data, sizes), methods)` holds whole planes out.

    Args:
        data: Known points to train on.
        methods: Name -> method.
        sizes: Numbers of points to train on.
        seeds: How many draws of each number.
        check: Another dataset of the same rig to judge by; None for the points that were not drawn.
        progress: Called before each fit.

    Returns:
        The trials, in the order of the splits (sizes, then seeds), then of the methods.

    Raises:
        UsageError: There is nothing to compare, or a number of points leaves none to evaluate on.
        DatasetError: Known positions are missing, or the two datasets have different length units.
    """
    return compare_on(random_splits(data, sizes, seeds=seeds, check=check), methods, progress)


__all__ = [
    "NUMBERS",
    "RANDOM",
    "SHOT",
    "Row",
    "Split",
    "Trial",
    "as_json",
    "compare",
    "compare_on",
    "fit_each",
    "judge",
    "mean_and_error",
    "plane_axis",
    "plane_splits",
    "random_splits",
    "shot_splits",
    "summarise",
    "trial_from_evaluation",
]
