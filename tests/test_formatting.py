"""Numbers as people read them, on pages and on terminals; values as JSON takes them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from implicam.formatting import decimal_number, json_default, json_safe, number, number_with_sd, percent, without_dust

READABLE = st.floats(1e-8, 1e9) | st.floats(-1e9, -1e-8)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.2134, "0.213"), (0.99996, "1.00"), (0, "0"), (-3.698, "-3.70"), (123.4, "123"), (98765.4, "98765"),
     (2e-7, "2.00e-07"), (3e9, "3.00e+09"), (np.nan, "–"), (np.inf, "–")],
)  # fmt: skip
def test_on_a_page_numbers_read_well(value: float, text: str):
    assert number(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (1.0, "1.00"), (123456.0, "123456"), (-2.714, "-2.71"), (0.00001234, "0.0000123"), (np.nan, "-"),
     (1e-30, "1.00e-30"), (np.inf, "-"), (99.96, "100.0"), (1.5e-8, "0.000000015"), (1e12, "1000000000000")],
)  # fmt: skip
def test_on_a_terminal_numbers_read_as_people_write_them(value: float, text: str) -> None:
    assert decimal_number(value) == text


@given(READABLE, st.integers(1, 6))
def test_what_is_read_back_is_rounded_by_half_a_digit_at_most(value: float, digits: int) -> None:
    half = 0.5001 * 10.0 ** (math.floor(math.log10(abs(value))) - digits + 1)
    assert abs(float(number(value, digits)) - value) <= half
    assert abs(float(decimal_number(value, digits)) - value) <= max(half, 0.5001e-9)


def test_signs() -> None:
    assert (number(-1.234), number(-1.234, minus="−"), number(1.234, sign=True)) == ("-1.23", "−1.23", "+1.23")
    assert (number(0.0, sign=True), number(None, sign=True), number(-math.inf, minus="−")) == ("0", "–", "–")


def test_what_is_nothing_beside_its_neighbours_is_zero() -> None:
    assert str(without_dust([-3e-8, 120.0, -0.0])) == "[0.0, 120.0, 0.0]"
    assert without_dust([-3e-8, 2e-8]) == [-3e-8, 2e-8]  # beside each other they are something
    assert without_dust([]) == []
    assert str(without_dust([math.nan, 1.0, -0.0])) == "[nan, 1.0, 0.0]"


def test_no_minus_before_zeros() -> None:
    assert number_with_sd(-3e-8, 0.1) == "0.00 ± 0.10"
    assert number_with_sd(-0.004, 0.12) == "0.00 ± 0.12"
    assert number_with_sd(-0.006, 0.12) == "-0.01 ± 0.12"


def test_shares() -> None:
    assert (percent(0.954), percent(0.954, 1), percent(1)) == ("95 %", "95.4 %", "100 %")
    assert (percent(None), percent(math.nan), percent(math.inf, none="-")) == ("–", "–", "-")


def test_json_has_no_nan_and_its_keys_are_text() -> None:
    value = {1: (math.nan, [np.float64(np.inf), 2.5, 7, True, None, "NaN"]), "row": {"sd": 1234567.891}}
    safe = {"1": [None, [None, 2.5, 7, True, None, "NaN"]], "row": {"sd": 1234567.891}}
    assert json_safe(value) == safe
    assert json.loads(json.dumps(json_safe(value), allow_nan=False)) == safe
    assert json_safe(value, 3)["row"]["sd"] == 1.23e6


def test_json_takes_arrays_and_paths_and_refuses_the_rest() -> None:
    value: dict[str, Any] = {"n": np.int64(3), "x": np.array([[1.5, 2.0]]), "b": np.True_, "at": Path("a") / "b"}
    assert json.loads(json.dumps(value, default=json_default)) == {"n": 3, "x": [[1.5, 2]], "b": True, "at": "a/b"}
    with pytest.raises(TypeError, match="a value of type set has no form in JSON"):
        json.dumps({1, 2}, default=json_default)
