"""Values as TOML can hold them."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import date, time
from typing import Any

import numpy as np

MAX_TOML_DEPTH = 50


def to_plain(value: Any, depth: int = 0) -> Any:
    """A copy made of the types that TOML knows.

    Args:
        value: Text, numbers, booleans, dates, lists and mappings of these; NumPy's numbers and arrays as well.
        depth: How deeply the value is nested already.

    Raises:
        ValueError: It has no form in TOML.
    """
    if depth > MAX_TOML_DEPTH:
        raise ValueError("it is nested too deeply")
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        if not all(isinstance(key, str) for key in value):
            raise ValueError("the keys of a table are text")
        return {_encodable(key): to_plain(item, depth + 1) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(item, depth + 1) for item in value]
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise ValueError("a whole number has more than 64 bits")
    if isinstance(value, str):
        return _encodable(value)
    if not isinstance(value, int | float | date | time):
        raise ValueError(f"a value of type {type(value).__name__} has no form in TOML")
    return value


def _encodable(text: str) -> str:
    text.encode()  # UnicodeEncodeError, a ValueError, for half of a surrogate pair
    return text
