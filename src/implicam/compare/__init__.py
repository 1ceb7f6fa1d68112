"""Methods side by side: the same splits, the same held-out points, in the same run, with error bars over the splits.

A `Split` says which points train and which judge (splits.py); `compare_on` fits and judges every method on every split
(trials.py); `summarise` makes a row of the trials of a method (summary.py).

The module can be called: `ic.compare(data, ["forward-gp", "inverse-gp"])` (`compare` below).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib.util import find_spec

from implicam.calibrators import Calibrator, calibrator_from_name, compared_names, library_of
from implicam.callable_module import make_callable
from implicam.compare.splits import RANDOM, SHOT, Split, plane_axis, plane_splits, random_splits, shot_splits
from implicam.compare.summary import NUMBERS, Row, as_json, mean_and_error, summarise
from implicam.compare.trials import Trial, compare_on, fit_each, judge, trial_from_evaluation
from implicam.dataset import Dataset
from implicam.progress import Progress, silent


def compare(
    data: Dataset,
    methods: Mapping[str, Calibrator] | Iterable[str] | None = None,
    sizes: Sequence[int] | None = None,
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
        methods: Name -> method; or names, "affine:stiff" for a variant; None for all that are installed.
        sizes: Numbers of points to train on; None for those of `usual_sizes`.
        seeds: How many draws of each number.
        check: Another dataset of the same rig to judge by; None for the points that were not drawn.
        progress: Called before each fit.

    Returns:
        The trials, in the order of the splits (sizes, then seeds), then of the methods.

    Raises:
        UsageError: There is nothing to compare, or a number of points leaves none to evaluate on.
        DatasetError: Known positions are missing, or the two datasets have different length units.
    """
    if not isinstance(methods, Mapping):
        methods = {name: calibrator_from_name(name) for name in (methods or available_methods()[0])}
    splits = random_splits(data, usual_sizes(len(data)) if sizes is None else sizes, seeds=seeds, check=check)
    return compare_on(splits, methods, progress)


def available_methods() -> tuple[list[str], list[tuple[str, str]]]:
    """All methods and the variants worth showing whose libraries are installed; and the others, each with its extra."""
    available, missing = [], []
    for name in compared_names():
        library = library_of(name)
        if library is None or find_spec(library[0]) is not None:
            available.append(name)
        else:
            missing.append((name, library[1]))
    return available, missing


def usual_sizes(n: int) -> list[int]:
    """Numbers of points to train on: a tenth of all, a fifth, half, nine tenths.

    Args:
        n: How many there are.
    """
    return sorted({min(n - 1, max(5, round(n * share))) for share in (0.1, 0.2, 0.5, 0.9)})


__all__ = [
    "NUMBERS",
    "RANDOM",
    "SHOT",
    "Row",
    "Split",
    "Trial",
    "as_json",
    "available_methods",
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
    "usual_sizes",
]

make_callable(__name__, compare)
