"""When to stop: rules that combine with `&` (both) and `|` (either). Each says why, in words, or nothing.

rule = (Below(0.2) & AtLeast(12)) | Budget(60)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from implicam.errors import UsageError, did_you_mean
from implicam.formatting import decimal_number, percent


@dataclass(frozen=True)
class Step:
    """The uncertainty over the workspace with a number of known points; NaN before there is a calibration.

    Attributes:
        points: How many known points.
        worst: 95 % uncertainty of a position at the worst place, in the length unit.
        mean: The same, on average.
        usual: The same, not exceeded in 95 % of the workspace.
        excess: 95th percentile of the standard deviation over that which pixel noise alone would leave.
        measured: The part of the workspace in which a position can be measured, from 0 to 1.
        seconds: Since the beginning.
    """

    points: int
    worst: float = math.nan
    mean: float = math.nan
    usual: float = math.nan
    excess: float = math.nan
    measured: float = 0.0
    seconds: float = 0.0


class Rule:
    """A stopping rule: `met(history)` is why to stop, empty for not yet."""

    def met(self, history: Sequence[Step], unit: str = "") -> str:
        """Why to stop now.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.

        Returns:
            The reason in words; empty where it is not time to stop.
        """
        raise NotImplementedError

    def progress(self, history: Sequence[Step], unit: str = "") -> str:
        """How far it is from stopping, in words: "1.34 mm everywhere; stop at 1.20 mm"; or nothing.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.
        """
        return ""

    def __and__(self, other: Rule) -> Rule:
        return Both(self, other)

    def __or__(self, other: Rule) -> Rule:
        return Either(self, other)


@dataclass(frozen=True)
class Both(Rule):
    """When both are met."""

    first: Rule
    second: Rule

    def met(self, history: Sequence[Step], unit: str = "") -> str:
        """Why to stop now: both reasons.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.

        Returns:
            The reasons in words; empty where one rule is not met.
        """
        one, two = self.first.met(history, unit), self.second.met(history, unit)
        return f"{one}, and {two}" if one and two else ""


@dataclass(frozen=True)
class Either(Rule):
    """When one of them is met."""

    first: Rule
    second: Rule

    def met(self, history: Sequence[Step], unit: str = "") -> str:
        """Why to stop now: the first reason there is.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.

        Returns:
            The reason in words; empty where neither rule is met.
        """
        return self.first.met(history, unit) or self.second.met(history, unit)


def parts_of(rule: Rule) -> list[Rule]:
    """The rules of which one consists.

    Args:
        rule: Of any kind.
    """
    if isinstance(rule, Both | Either):
        return [*parts_of(rule.first), *parts_of(rule.second)]
    return [rule]


def _where(step: Step) -> str:
    """Nothing, or which part of the workspace this is about."""
    return "" if step.measured > 0.995 else f" that enough cameras see ({percent(step.measured)} of the workspace)"


UNCERTAINTY_PLACES = {"worst": "everywhere", "usual": "in 95 % of the workspace", "mean": "on average"}


@dataclass(frozen=True)
class Below(Rule):
    """When the 95 % uncertainty is small enough.

    Attributes:
        value: The largest uncertainty at which to stop, in the length unit.
        of: "worst", everywhere; "usual", in 95 % of the workspace; "mean", on average.

    Raises:
        UsageError: The value is not a positive number, or `of` is another word.
    """

    value: float
    of: str = "worst"

    def __post_init__(self) -> None:
        if self.of not in UNCERTAINTY_PLACES:
            raise UsageError(
                f"there is no uncertainty {self.of!r}{did_you_mean(self.of, UNCERTAINTY_PLACES)}.",
                fix=f"use {', '.join(UNCERTAINTY_PLACES)}",
            )
        if not 0 < self.value < math.inf:
            raise UsageError(f"a stop below {self.value} is never reached.", fix="give a length greater than zero")

    def progress(self, history: Sequence[Step], unit: str = "") -> str:
        """How far it is from stopping.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.
        """
        now = getattr(history[-1], self.of) if history else math.nan
        if not math.isfinite(now):
            return ""
        reached, wanted = (f"{decimal_number(value, 3)} {unit}".strip() for value in (now, self.value))
        return f"{reached} {UNCERTAINTY_PLACES[self.of]}; stop at {wanted}"

    def met(self, history: Sequence[Step], unit: str = "") -> str:
        """Why to stop now: the uncertainty is small enough.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.

        Returns:
            The uncertainty in words; empty where it is larger than `value`.
        """
        now = getattr(history[-1], self.of) if history else math.nan
        if not now <= self.value:
            return ""
        return f"{now:.2g} {unit}".strip() + f" {UNCERTAINTY_PLACES[self.of]}{_where(history[-1])}"


@dataclass(frozen=True)
class Within(Rule):
    """When, in 95 % of the workspace, a position is hardly more uncertain than pixel noise alone would leave it.

    Then more points hardly help, and better pictures would.

    Attributes:
        times: The largest ratio of the standard deviations at which to stop.

    Raises:
        UsageError: The ratio is not a number above 1.
    """

    times: float = 1.2

    def __post_init__(self) -> None:
        if not 1 < self.times < math.inf:
            raise UsageError(
                f"a stop within {self.times} times the noise is never reached.", fix="give more than 1, such as 1.2"
            )

    def progress(self, history: Sequence[Step], unit: str = "") -> str:
        """How far it is from stopping.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.
        """
        now = history[-1].excess if history else math.nan
        return f"{now:.2f} times what pixel noise leaves; stop at {self.times:.2f}" if math.isfinite(now) else ""

    def met(self, history: Sequence[Step], unit: str = "") -> str:
        """Why to stop now: pixel noise dominates.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.

        Returns:
            The ratio in words; empty where it is larger than `times`.
        """
        now = history[-1].excess if history else math.nan
        return f"{now:.2f} times what pixel noise alone leaves{_where(history[-1])}" if now <= self.times else ""


@dataclass(frozen=True)
class Converged(Rule):
    """When the last points together hardly changed the 95 % uncertainty.

    Attributes:
        change: The part of the uncertainty by which it may still have changed.
        over: The number of points.
        of: "worst", "usual" or "mean", as of `Below`.
    """

    change: float = 0.05
    over: int = 5
    of: str = "usual"

    def met(self, history: Sequence[Step], unit: str = "") -> str:
        """Why to stop now: the uncertainty hardly changes.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.

        Returns:
            The change in words; empty where it is larger than `change`, or there are too few steps.
        """
        values = [getattr(step, self.of) for step in history]
        if len(values) <= self.over or not all(math.isfinite(v) for v in values[-self.over - 1 :]):
            return ""
        last = values[-self.over - 1 :]
        spread = (max(last) - min(last)) / last[-1]
        return f"the last {self.over} points changed it by {percent(spread)}" if spread <= self.change else ""


@dataclass(frozen=True)
class AtLeast(Rule):
    """When there are so many known points."""

    points: int

    def progress(self, history: Sequence[Step], unit: str = "") -> str:
        """How far it is from stopping.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.
        """
        return f"{history[-1].points if history else 0} of {self.points} points"

    def met(self, history: Sequence[Step], unit: str = "") -> str:
        """Why to stop now: there are enough points.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.

        Returns:
            The number in words; empty where it is smaller than `points`.
        """
        return f"{history[-1].points} points" if history and history[-1].points >= self.points else ""


@dataclass(frozen=True)
class Budget(AtLeast):
    """When the budget of known points is spent."""

    def met(self, history: Sequence[Step], unit: str = "") -> str:
        """Why to stop now: the budget is spent.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.

        Returns:
            The number in words; empty where it is smaller than `points`.
        """
        return f"all {self.points} points of the budget are measured" if super().met(history, unit) else ""


@dataclass(frozen=True)
class Time(Rule):
    """When so many seconds have passed since the beginning."""

    seconds: float

    def progress(self, history: Sequence[Step], unit: str = "") -> str:
        """How far it is from stopping.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.
        """
        return f"{history[-1].seconds if history else 0:.0f} of {self.seconds:.0f} s"

    def met(self, history: Sequence[Step], unit: str = "") -> str:
        """Why to stop now: the time is over.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.

        Returns:
            The time in words; empty where it is shorter than `seconds`.
        """
        over = history and history[-1].seconds >= self.seconds
        return f"{history[-1].seconds:.0f} s have passed" if over else ""


@dataclass(frozen=True)
class Never(Rule):
    """Until a person stops it."""

    def met(self, history: Sequence[Step], unit: str = "") -> str:
        """No reason, ever.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.

        Returns:
            Empty.
        """
        return ""
