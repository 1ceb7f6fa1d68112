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
    """A number that a finding rests on.

    Attributes:
        value: The number; it supports the finding above `least`.
        low: The lower end of its 95 % interval.
        high: The upper end.
        template: The case in words, with {} for the number.
        least: The threshold.
        difference: Whether numbers of several rigs are averaged as they are; ratios by their logarithms.
    """

    value: float
    low: float
    high: float
    template: str
    least: float = 1.0
    difference: bool = False

    @property
    def words(self) -> str:
        """The number in words."""
        if not np.isfinite(self.value):
            return self.template.format("unknown")
        exact = self.high - self.low < 1e-9 * abs(self.value)
        return self.template.format(number(self.value) if exact else interval(self.value, self.low, self.high))

    @property
    def verdict(self) -> str:
        """`HOLDS`, `FAILS` or `OPEN`."""
        return HOLDS if self.low > self.least else FAILS if self.high < self.least else OPEN


Test = Callable[[Rows, str, Sequence[str]], list[Case]]
"""The cases of a finding: from all rows of its experiment, a Gaussian process, and the sets of cameras it speaks of."""


def where(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """The rows with some values, of runs that did not fail.

    Args:
        rows: Rows of a table.
        wanted: Column = value.
    """
    return [row for row in rows if not row.get("failure") and all(row.get(k) == v for k, v in wanted.items())]


def column(rows: Iterable[Row], key: str) -> Floats:
    """The numbers of a column.

    Args:
        rows: n rows, all of which have it.
        key: The column.

    Returns:
        (n,).
    """
    return np.array([float(row[key]) for row in rows], dtype=np.float64)


def median_row(rows: Iterable[Row], key: str) -> list[Row]:
    """The row with the median of a column, the lower one of two; none where there is no row.

    Args:
        rows: Rows of a table, of runs that did not fail.
        key: The column.
    """
    ordered = sorted(rows, key=lambda row: float(row[key]))
    return ordered[(len(ordered) - 1) // 2 :][:1]


def rows_by_rig(rows: Iterable[Row]) -> list[list[Row]]:
    """The rows of each rig, in the order of the first of each.

    Args:
        rows: Rows of a table, with a column "rig" where there are several.
    """
    rigs: dict[str, list[Row]] = {}
    for row in rows:
        rigs.setdefault(str(row.get("rig", "")), []).append(row)
    return list(rigs.values())


def ratio(above: Floats, below: Floats, words: str, *, least: float = 1.0) -> Case:
    """The geometric mean of ratios over pairs, with its 95 % interval.

    Args:
        above: (n,).
        below: (n,); a pair whose ratio is not a positive number is left out.
        words: The case in words, with {} for the number.
        least: The threshold.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(above / below)
    return _case([logs[np.isfinite(logs)]], words, least)


def unpaired(
    above: Floats, below: Floats, words: str, *, least: float = 1.0, alone: tuple[float, float] = (0.0, 0.0)
) -> Case:
    """The ratio of the geometric means of two independent samples, with its 95 % interval.

    Args:
        above: (n,).
        below: (m,).
        words: The case in words, with {} for the number.
        least: The threshold.
        alone: Standard deviation of the logarithm, of each of the two, where it is a sample of one.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = [np.log(sample) for sample in (above, 1 / below)]
    return _case([sample[np.isfinite(sample)] for sample in logs], words, least, alone)


def _case(samples: Sequence[Floats], words: str, least: float, alone: Sequence[float] = (0.0, 0.0)) -> Case:
    """The exponential of the sum of the samples' means; without numbers a case that decides nothing."""
    if not all(len(sample) for sample in samples):
        return Case(np.nan, np.nan, np.nan, words, least)
    middle = sum(float(sample.mean()) for sample in samples)
    spread = float(np.hypot.reduce([half_width(*pair) for pair in zip(samples, alone, strict=False)]))
    value, low, high = np.exp(middle + np.array([0.0, -spread, spread]))
    return Case(float(value), float(low), float(high), words, least)


def over_rigs(cases: Sequence[Case]) -> Case:
    """One case of several rigs: the mean of their numbers, with its 95 % interval over the rigs, after Student.

    Splits of the points of one rig share its lenses, its noise and its lattice; what holds for rigs is told by rigs.

    Args:
        cases: The same case of each rig; those without a number are left out.

    Returns:
        The case itself where only one has a number: its interval is that over its runs.
    """
    known = [case for case in cases if np.isfinite(case.value)]
    if len(known) < 2:
        return (known or list(cases))[0]
    values = np.array([case.value for case in known])
    if not known[0].difference:
        values = np.log(values)
    mean, spread = float(values.mean()), half_width(values)
    ends = np.array([mean, mean - spread, mean + spread])
    value, low, high = ends if known[0].difference else np.exp(ends)
    first = known[0]
    return Case(float(value), float(low), float(high), first.template, first.least, first.difference)


def half_width(sample: Floats, alone: float = 0.0) -> float:
    """Half the width of the 95 % interval of a mean, after Student.

    Args:
        sample: (n,).
        alone: Standard deviation, for a sample of one.
    """
    n = len(sample)
    if n == 1:
        return float(stats.norm.ppf(0.975)) * alone
    return float(stats.t.ppf(0.975, n - 1) * sample.std(ddof=1) / np.sqrt(n))


def interval(value: float, low: float, high: float) -> str:
    """A number with its interval in words: three digits each, four where it is nearly one.

    Args:
        value: The number.
        low: The lower end.
        high: The upper end.
    """
    digits = 4 if abs(value - 1) < 0.05 else 3
    return f"{number(value, digits)} [{number(low, digits)}, {number(high, digits)}]"


def share_of_drop(first: Floats, then: Floats, last: Floats, words: str) -> Case:
    """How many % of a drop have come early; it supports a finding above half.

    A rise is no drop and decides nothing.

    Args:
        first: (n,) at the start.
        then: (n,) early.
        last: (n,) at the end.
        words: The case in words, with {} for the number.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        share = 100 * (first - then) / (first - last)
    if not len(share) or not (first > last).all():
        return Case(np.nan, np.nan, np.nan, words, 50, difference=True)
    mean, spread = float(share.mean()), half_width(share)
    return Case(mean, mean - spread, mean + spread, words, 50, difference=True)


def stages(parts: Sequence[Mapping[int, Row]], key: str) -> tuple[Floats, Floats, Floats]:
    """A column at the start, early and at the end, of the runs that have all three.

    Args:
        parts: At each of the three, number of a run -> its row.
        key: The column.

    Returns:
        (n,) each.
    """
    runs = sorted(set.intersection(*(set(part) for part in parts)))
    first, then, last = (column([part[run] for run in runs], key) for part in parts)
    return first, then, last
