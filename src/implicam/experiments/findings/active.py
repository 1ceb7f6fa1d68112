"""Experiment 2: the cases of each finding."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from implicam.experiments.evidence import Case, Row, Rows, Test, column, share_of_drop, stages, where

EARLY_POINTS, WINDOW_STEPS = 20, 10
"""Points added that are almost none of 100; steps that are looked at there and at the end."""
MAX_CONVERGED_RANGE = 0.1
"""The range of the starts, over the whole drop, that is one value."""


def _starts(rows: Rows, gp: str, cameras: str, added: int) -> dict[int, Row]:
    return {int(row["repeat"]): row for row in where(rows, method=gp, set=cameras, added=added)}


def _last_step(rows: Rows, gp: str, cameras: str) -> int:
    """How many points are added in all; 0 where these are too few to tell early from late."""
    last = max((int(row["added"]) for row in where(rows, method=gp, set=cameras)), default=0)
    return last if last >= 2 * EARLY_POINTS else 0


def _drops_fast(rows: Rows, gp: str, sets: Sequence[str]) -> list[Case]:
    """Of the largest and of the mean standard deviation of the positions that are left."""
    last = _last_step(rows, gp, sets[0])
    if not last:
        return []
    parts = [_starts(rows, gp, sets[0], added) for added in (0, EARLY_POINTS, last)]
    return [
        share_of_drop(
            *stages(parts, key), f"{what} sd: {{}} % of its drop by {EARLY_POINTS} of {last} points (fast: half)"
        )
        for key, what in (("max_sd", "largest"), ("mean_sd", "mean"))
    ]


def _one_value(rows: Rows, gp: str, sets: Sequence[str]) -> list[Case]:
    """The range of the starts over the whole drop, the median of some steps: without an interval, a case is one number.

    A case supports the finding above a threshold, so it is the drop over the range.
    """
    last = _last_step(rows, gp, sets[0])
    if not last:
        return []
    mean = {added: column(_starts(rows, gp, sets[0], added).values(), "mean_sd") for added in range(last + 1)}
    if not all(len(sd) > 1 for sd in mean.values()):
        return []
    drop = float(mean[0].mean() - mean[last].mean())
    if drop <= 0:
        return []
    ranges = {added: float(np.ptp(sd)) / drop for added, sd in mean.items()}
    early = float(np.median([ranges[added] for added in range(EARLY_POINTS, EARLY_POINTS + WINDOW_STEPS)]))
    late = float(np.median([ranges[added] for added in range(last - WINDOW_STEPS + 1, last + 1)]))
    over = {f"after {EARLY_POINTS} points": 1 / max(early, 1e-9), "at the end": 1 / max(late, 1e-9)}
    return [
        Case(value, value, value, f"the whole drop is {{}} times what starts differ by {when} (one value: 10 times)",
             1 / MAX_CONVERGED_RANGE)
        for when, value in over.items()
    ]  # fmt: skip


TESTS: dict[str, Test] = {"sd_drops_fast": _drops_fast, "any_start_converges": _one_value}
