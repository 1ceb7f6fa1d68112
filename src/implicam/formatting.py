"""Numbers as people read them, and values as JSON takes them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

MIN_DECIMAL_VALUE = 1e-8
"""Smaller numbers would be nothing but zeros on a terminal."""
MAX_DECIMALS = 9

MAX_DUST_SHARE = 1e-6
"""Of the largest of several numbers: a smaller one beside it is what rounding leaves, -0.00000003 say."""


def number(value: float | None, digits: int = 3, *, sign: bool = False, minus: str = "-") -> str:
    """A number with a number of significant digits, for pages and figures.

    It has no exponent from 1e-4 up to 1e7.

    Args:
        value: None or not finite for none.
        digits: Significant digits.
        sign: Whether to write a plus before numbers above zero.
        minus: The sign before numbers below zero.

    Returns:
        The text; "–" where there is no number.
    """
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    before = minus if value < 0 else "+" if sign else ""
    scientific = f"{abs(value):.{digits - 1}e}"
    exponent = int(scientific.partition("e")[2])  # of the rounded number: 9.996 has the digits of 10.0
    return before + (f"{abs(value):.{max(0, digits - 1 - exponent)}f}" if -4 <= exponent <= 6 else scientific)


def decimal_number(value: float, digits: int = 3) -> str:
    """A number with a number of significant digits, for terminals: ASCII, without an exponent down to 1e-8.

    A number that rounds up to the next power of ten keeps a digit more (9.996 is 10.00).

    Args:
        value: The number.
        digits: Significant digits.

    Returns:
        The text; "-" where the number is not finite.
    """
    if not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    if abs(value) < MIN_DECIMAL_VALUE:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{min(decimals, MAX_DECIMALS)}f}"


def number_with_sd(value: float, sd: float) -> str:
    """A number with its uncertainty, both to the second digit of the uncertainty.

    Args:
        value: The number.
        sd: Its standard uncertainty.
    """
    if not math.isfinite(sd) or sd <= 0:
        return f"{value:.6g}"
    decimals = max(0, 1 - math.floor(math.log10(sd)))
    return f"{round(value, decimals) + 0.0:.{decimals}f} ± {sd:.{decimals}f}"  # + 0.0: no minus before zeros


def without_dust(values: Sequence[float]) -> list[float]:
    """Numbers of one kind, such as the three of a place, with zero for what is nothing beside the largest.

    Args:
        values: The numbers.

    Returns:
        The numbers; zero, never minus zero, for those below a part of the largest of `MAX_DUST_SHARE`.
    """
    largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    return [0.0 if abs(value) <= MAX_DUST_SHARE * largest else value for value in values]


def percent(share: float | None, decimals: int = 0, *, none: str = "–") -> str:
    """A share in per cent.

    Args:
        share: Of one; None or not finite for none.
        decimals: After the point.
        none: What to return where there is none.
    """
    return none if share is None or not math.isfinite(share) else f"{100 * share:.{decimals}f} %"


def json_safe(value: Any, digits: int | None = None) -> Any:
    """Tables and lists as JSON has them: keys are text, and numbers that are not finite are null.

    Args:
        value: Mappings, lists, tuples and plain values, nested.
        digits: Significant digits that a float keeps; None for all.
    """
    if isinstance(value, Mapping):
        return {str(key): json_safe(item, digits) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_safe(item, digits) for item in value]
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        return None
    return value if digits is None else float(f"{value:.{digits}g}")


def json_default(value: Any) -> Any:
    """What `json.dumps` cannot write itself: NumPy's numbers and arrays, and paths.

    Args:
        value: The value.

    Raises:
        TypeError: It is anything else.
    """
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"a value of type {type(value).__name__} has no form in JSON")


def list_some(names: Sequence[str], most: int = 5, total: int | None = None) -> str:
    """The first few names of a list, with commas, and how many more there are.

    Args:
        names: All of them, or as many as are known.
        most: How many are written.
        total: How many there are, where `names` are not all.
    """
    more = (len(names) if total is None else total) - min(len(names), most)
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def short_names(names: Sequence[str]) -> list[str]:
    """Names without what is the same in all of them, for places with little room: t0012 is 12 beside t0436.

    Args:
        names: All of them, each different.
    """
    low, high = min(names, default=""), max(names, default="")  # what these two share, all of them do
    same = next((k for k, (one, other) in enumerate(zip(low, high, strict=False)) if one != other), 0)
    start = low[:same].rstrip("0123456789")
    rest = [name[len(start) :] for name in names]
    short = [text.lstrip("0") or "0" for text in rest] if all(text.isdigit() for text in rest) else rest
    return short if len(set(short)) == len(names) and all(short) else list(names)
