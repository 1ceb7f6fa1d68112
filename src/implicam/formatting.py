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


def number(value: float | None, digits: int = 3, *, sign: bool = False, minus: str = "-") -> str:
    """A number with so many significant digits, without an exponent where it is readable; "–" where there is none.

    For pages and figures. sign: a plus before numbers above zero. minus: the sign before those below.
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
    """A number with so many significant digits, never in powers of ten where people would not write them; "-" for none.

    For terminals: ASCII only. A number that rounds up to the next power of ten keeps a digit more (9.996 is 10.00).
    """
    if not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    if abs(value) < MIN_DECIMAL_VALUE:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{min(decimals, MAX_DECIMALS)}f}"


def percent(share: float | None, decimals: int = 0, *, none: str = "–") -> str:
    """A share of one in per cent; `none` where there is none."""
    return none if share is None or not math.isfinite(share) else f"{100 * share:.{decimals}f} %"


def json_safe(value: Any, digits: int | None = None) -> Any:
    """Tables and lists as JSON has them: keys are text, and numbers that do not exist are null.

    digits: how many significant ones a float keeps; all, unless given.
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
    """What `json.dumps` cannot write itself: NumPy's numbers and arrays, and paths; TypeError for anything else."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"a value of type {type(value).__name__} has no form in JSON")


def list_some(names: Sequence[str], most: int = 5, total: int | None = None) -> str:
    """The first few names of a list, with commas, and how many more there are.

    Args:
        names: all of them, or as many as are told.
        most: how many are told.
        total: how many there are, where `names` are not all.
    """
    more = (len(names) if total is None else total) - min(len(names), most)
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")
