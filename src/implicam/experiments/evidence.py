"""The numbers that findings rest on: ratios with their 95 % intervals, and which side of a threshold they lie."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from implicam.dataset import Floats
from implicam.formatting import number

HOLDS, FAILS, OPEN = "holds", "does not hold", "not decided"

Row = Mapping[str, Any]
Rows = Sequence[Row]


@dataclass(frozen=True)
class Case:
    """A number that a finding rests on, in words; it supports the finding above `least`."""

    value: float
    low: float
    high: float
    words: str
    least: float = 1.0

    @property
    def verdict(self) -> str:
        """HOLDS, FAILS or OPEN."""
        return HOLDS if self.low > self.least else FAILS if self.high < self.least else OPEN


Test = Callable[[Rows, str, Sequence[str]], list[Case]]
"""The cases of a finding: from all rows of its experiment, a Gaussian process, and the sets of cameras it speaks of."""


def where(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """The rows with these values, of runs that did not fail."""
    return [row for row in rows if not row.get("failure") and all(row.get(k) == v for k, v in wanted.items())]


def column(rows: Iterable[Row], key: str) -> Floats:
    """The numbers of a column."""
    return np.array([float(row[key]) for row in rows], dtype=np.float64)


def ratio(above: Floats, below: Floats, words: str, *, least: float = 1.0) -> Case:
    """Geometric mean of above / below (n,) over pairs, with its 95 % interval."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(above / below)
    return _case([logs[np.isfinite(logs)]], words, least)


def unpaired(above: Floats, below: Floats, words: str, *, least: float = 1.0, alone: float = 0.0) -> Case:
    """Ratio of the geometric means of two samples that have nothing to do with each other, with its 95 % interval.

    alone: standard deviation of the logarithm of a sample of one.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = [np.log(sample) for sample in (above, 1 / below)]
    return _case([sample[np.isfinite(sample)] for sample in logs], words, least, alone)


def _case(samples: Sequence[Floats], words: str, least: float, alone: float = 0.0) -> Case:
    """The exponential of the sum of the samples' means; without numbers a case that decides nothing."""
    if not all(len(sample) for sample in samples):
        return Case(np.nan, np.nan, np.nan, words.format("unknown"), least)
    middle = sum(float(sample.mean()) for sample in samples)
    spread = float(np.hypot.reduce([half_width(sample, alone) for sample in samples]))
    value, low, high = np.exp(middle + np.array([0.0, -spread, spread]))
    return Case(float(value), float(low), float(high), words.format(interval(value, low, high)), least)


def half_width(sample: Floats, alone: float = 0.0) -> float:
    """Of the 95 % interval of a mean, after Student; of a sample of one from the standard deviation `alone`."""
    n = len(sample)
    if n == 1:
        return 1.96 * alone
    return float(stats.t.ppf(0.975, n - 1) * sample.std(ddof=1) / np.sqrt(n))


def interval(value: float, low: float, high: float) -> str:
    """A number with its interval: three digits each, four where it is nearly one."""
    digits = 4 if abs(value - 1) < 0.05 else 3
    return f"{number(value, digits)} [{number(low, digits)}, {number(high, digits)}]"


def share_of_drop(first: Floats, then: Floats, last: Floats, words: str) -> Case:
    """How many % of a drop (n,) have come early, the least of it half; a rise is no drop and decides nothing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = 100 * (first - then) / (first - last)
    if not len(share) or not (first > last).all():
        return Case(np.nan, np.nan, np.nan, words.format("unknown"), 50)
    mean, spread = float(share.mean()), half_width(share)
    low, high = mean - spread, mean + spread
    return Case(mean, low, high, words.format(interval(mean, low, high)), 50)


def stages(parts: Sequence[Mapping[int, Row]], key: str) -> tuple[Floats, Floats, Floats]:
    """A column at the start, early and at the end, of the runs that have all three."""
    runs = sorted(set.intersection(*(set(part) for part in parts)))
    first, then, last = (column([part[run] for run in runs], key) for part in parts)
    return first, then, last
