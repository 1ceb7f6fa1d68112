"""Experiment 2, active learning: the next point is where the stated uncertainty is largest.

Starts from a random fifth of the lattice; each step measures the positions that are left and adds the one whose
standard deviation, averaged over x, y and z, is largest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators import Calibration, TakesPoints, calibrator_from_name
from implicam.compare import fit_each
from implicam.dataset import Dataset, Floats
from implicam.errors import ImplicamError
from implicam.experiments.ball import errors
from implicam.experiments.cells import Cell
from implicam.experiments.plan import METHODS, NETWORK, Plan, slug
from implicam.experiments.source import BALL, CHECK, Source
from implicam.experiments.stored import Values

NAME = "active"
POINTS_PER_CHECK = 5
"""Points added between two looks at the random positions, which cost more than those that are left."""


def cells(source: Source, plan: Plan) -> list[Cell]:
    """The cells of experiment 2: one for each set, method and start; networks of all starts are trained as one batch.

    Args:
        source: The data.
        plan: How much is computed.
    """
    found = []
    for method in METHODS:
        repeats = list(range(plan.repeats[method]))
        starts = [repeats] if method == NETWORK else [[repeat] for repeat in repeats]
        for cameras in list(source.sets) if BALL in source.parts else []:
            total = len(source.data(BALL, cameras))
            start = max(5, total * plan.start_share // 100)
            for together in starts:
                options = {
                    "source": source.options,
                    "cameras": cameras,
                    "method": method,
                    "repeats": together,
                    "start": start,
                    "additions": max(0, min(plan.additions, total - start - 1)),
                    "lot": plan.lot[method],
                }
                name = f"{NAME}/{cameras}/{slug(method)}/{'-'.join(map(str, together))}"
                found.append(Cell(grow, name, options))
    return found


def grow(
    source: Mapping[str, Any],
    cameras: str,
    method: str,
    repeats: Sequence[int],
    start: int,
    additions: int,
    lot: int,
) -> Values:
    """The rows of some starts, side by side.

    A new fit comes after every `lot` points. Between two fits a Gaussian process takes each point with its
    hyperparameters kept; another method has no row there, and the points of a lot are the least certain of its last
    fit.

    Args:
        source: The data: `Source.options`.
        cameras: A set of cameras.
        method: Its name.
        repeats: The numbers of the starts.
        start: How many points each begins with.
        additions: How many points are added.
        lot: How many points are added between two fits.

    Returns:
        "rows": uncertainty and error in mm of the positions that are left, and ("check_...") at random positions, where
        there are such.
    """
    of = Source(**source)
    data = of.data(BALL, cameras)
    check = of.data(CHECK, cameras) if CHECK in of.parts else None
    chosen = [np.isin(np.arange(len(data)), _start(len(data), start, repeat)) for repeat in repeats]
    fits: list[Calibration | ImplicamError] = []
    sds = [np.zeros(len(data))] * len(repeats)
    rows = list[Values]()
    for added in range(additions + 1):
        new = added % lot == 0 or added == additions
        if new:
            fits = [fit for fit, _ in fit_each(calibrator_from_name(method), [data.select(mask) for mask in chosen])]
        for i, (repeat, mask) in enumerate(zip(repeats, chosen, strict=True)):
            fit = _update_fit(fits[i], data, mask, new)
            where = {"set": cameras, "method": method, "repeat": repeat, "added": added, "known": int(mask.sum())}
            if isinstance(fit, ImplicamError):
                rows.append({**where, "failure": fit.what})
            elif fit is not None:
                numbers, sds[i] = _measure_rest(fit, data, mask)
                off = {}
                if check is not None and added % POINTS_PER_CHECK == 0:
                    off = errors(fit.measure(check.observations), check)
                rows.append({**where, **numbers, **{f"check_{key}": value for key, value in off.items()}})
            if not isinstance(fits[i], ImplicamError):
                mask[int(np.argmax(np.where(mask, -np.inf, sds[i])))] = True
    return {"rows": rows}


def _update_fit(
    fit: Calibration | ImplicamError, data: Dataset, mask: NDArray[np.bool_], new: bool
) -> Calibration | ImplicamError | None:
    """What is known with the points of the mask: a new fit; else one that took them in at once, or None."""
    if new:
        return fit
    return fit.condition_on(data.select(mask)) if isinstance(fit, TakesPoints) else None


def _start(total: int, count: int, repeat: int) -> NDArray[np.int64]:
    return np.random.default_rng([repeat, 2]).permutation(total)[:count]


def _measure_rest(fit: Calibration, data: Dataset, mask: NDArray[np.bool_]) -> tuple[Values, Floats]:
    """The numbers of the positions that are left, and (n,) the standard deviation of each; what cannot be measured is
    least certain."""
    rest = data.select(~mask)
    measured = fit.measure(rest.observations)
    sd = np.full(len(data), np.inf)
    sd[~mask] = np.where(measured.measured, measured.sd.mean(axis=1), np.inf)
    return errors(measured, rest), sd
