"""What a person types is taken to the last bit, or asked about; numbers that may mean two are refused."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from implicam.active import Workspace
from implicam.dataset import read_dataset
from implicam.errors import UsageError
from implicam.hardware import Person
from implicam.session import Session
from implicam.session.controller import SessionController
from implicam.session.setup import Setup, open_session
from implicam.session.typed import (
    PositionQuestion,
    parse_length,
    parse_position,
    questions_after,
    questions_before,
)

pytestmark = pytest.mark.usefixtures("looks_kept")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("-0.38296", -0.38296),
        ("-382.5667340745084", -382.5667340745084),
        ("0,25", 0.25),
        ("1e-3", 1e-3),
        ("−12,5", -12.5),
        ("–12,5", -12.5),
        ("+3", 3.0),
        ("- 3", -3.0),
        (" 7 ", 7.0),
        (".5", 0.5),
        ("5.", 5.0),
        ("-0", -0.0),
        ("1,5e2", 150.0),
        ("1.5E+2", 150.0),
        ("12,5 cm", 125.0),
        ("0.25m", 250.0),
        ("-0.0cm", -0.0),
        ("1 in", 25.4),
        ('2"', 50.8),
        ("1500 µm", 1.5),
        ("1500 μm", 1.5),  # the Greek letter
        ("0.1 m", 100.0),
        ("1,234.5", 1234.5),
        ("1.234,5", 1234.5),
        ("1,234,567", 1234567.0),
        ("1.234.567,25", 1234567.25),
        ("1'234.5", 1234.5),
        ("1’234,567", 1234.567),
        ("1\u202f234,5", 1234.5),
        ("1234,567", 1234.567),
        ("0,234", 0.234),
        ("1,2345", 1.2345),
        ("1.234", 1.234),
        ("0.1000000000000000055511151231257827", 0.1),
    ],
)
def test_what_a_text_means_to_the_last_bit(text: str, value: float) -> None:
    taken = parse_length(text, "mm")
    assert taken == value
    assert math.copysign(1, taken) == math.copysign(1, value)


@pytest.mark.parametrize("text", ["1,234", "-12,345", "999,999", "1,234 mm", "1,234e2"])
def test_what_may_mean_two_is_refused_with_both(text: str) -> None:
    with pytest.raises(UsageError, match="may mean") as told:
        parse_length(text, "mm", "x")
    assert told.value.what.startswith("x = ")
    assert " or " in told.value.fix


@pytest.mark.parametrize(
    "text",
    ["", " ", "abc", "1 2", "12 5", "1,2,3", "1.2.3", "1,23.4", "1.2,3.4", "1,,5", "--3", "0x1F", "nan", "inf", "1_000",
     "1e", "1e99", "1e999999999", "5 parsec",
     "３", "10²", "½", "1;2", "=1+1", ".", ",", "-", "mm", "1" * 61, "1,2345,678"],
)  # fmt: skip
def test_what_is_no_length_is_refused_with_the_cure(text: str) -> None:
    with pytest.raises(UsageError) as told:
        parse_length(text, "mm", "y")
    assert told.value.what.startswith("y = ")
    assert told.value.fix


@given(
    st.floats(allow_nan=False, allow_infinity=False, min_value=-1e9, max_value=1e9), st.sampled_from(["repr", "comma"])
)
def test_any_number_comes_back_bit_by_bit(value: float, way: str) -> None:
    text = repr(value)
    if abs(value) < 1e-29 and value:
        return
    if way == "comma" and len(text.partition(".")[2].partition("e")[0]) != 3:
        text = text.replace(".", ",")
    taken = parse_length(text, "m")
    assert taken == value
    assert math.copysign(1, taken) == math.copysign(1, value)


@given(
    st.decimals(-10000, 10000, places=9),
    st.sampled_from([("cm", "mm", 10), ("m", "mm", 1000), ("in", "mm", Fraction("25.4"))]),
)
def test_a_unit_is_one_rounding(number: Decimal, units: tuple[str, str, Any]) -> None:
    given_unit, unit, factor = units
    exact = Fraction(number) * factor
    assert parse_length(f"{number:f} {given_unit}", unit) == float(exact)


# what is asked

BOX = Workspace.box((-100, -100, 300), (100, 100, 500))


def target(*xyz: float) -> Any:
    return SimpleNamespace(xyz=np.array(xyz))


def test_what_is_odd_before_pictures_is_said_with_the_numbers() -> None:
    def ask(*xyz: float, at: Any = None) -> tuple[str, ...]:
        return questions_before(np.array(xyz), "mm", BOX, at)

    assert ask(10, 20, 400, at=target(12, 18, 395)) == ()
    assert ask(101, 0, 400) == ()  # at the edge
    assert ask(0, 0, 400, at=None) == ()
    (outside,) = ask(150, 0, 400, at=target(100, 0, 400))
    assert "(150, 0, 400) mm is 50 mm outside of the workspace, a box of 200 x 200 x 200 mm" in outside
    (far,) = ask(-90, 50, 400, at=target(90, 50, 400))
    assert "is 180 mm from the target (90, 50, 400) mm" in far
    assert far.endswith("if x had the other sign, it would be 0 mm from there")
    assert "if x and y were exchanged" in ask(10, 90, 400, at=target(90, 10, 400))[0]
    assert "if it were a thousandth" in ask(10e3, 20e3, 400e3, at=target(10, 20, 400))[1]
    assert "if it were ten times as much" in ask(1, 2, 40, at=target(10, 20, 400))[1]


def measured(xyz: list[float], sd: float) -> Any:
    class One(SimpleNamespace):
        def __len__(self) -> int:
            return 1

    return One(xyz=np.array([xyz]), cov=np.eye(3)[None] * sd**2)


def test_what_the_cameras_see_elsewhere_is_asked_about() -> None:
    nothing = np.full(3, np.nan)

    def ask(xyz: list[float], sd: Any, seen: Any) -> tuple[str, ...]:
        return questions_after(np.array(xyz), np.array(sd), "mm", BOX, seen)

    assert ask([0, 0, 400], nothing, None) == ()
    assert ask([0, 0, 400], nothing, measured([np.nan] * 3, 1)) == ()
    assert ask([0, 0, 400], nothing, measured([1.5, 0, 400], 0.01)) == ()  # a ruler may be that far off
    (far,) = ask([0, 0, 400], nothing, measured([8, 0, 400], 0.05))
    assert "(0, 0, 400) mm is 8 mm from where the cameras see the ball, (8, 0, 400) mm" in far
    assert "known to 0.05 mm" in far
    assert ask([0, 0, 400], nothing, measured([8, 0, 400], 2.0)) == ()  # they do not know it any better
    assert ask([0, 0, 400], [2.0] * 3, measured([8, 0, 400], 0.05)) == ()  # nor does the person
    assert "if y had the other sign" in ask([0, -20.5, 400], nothing, measured([0, 20, 400], 0.1))[0]


# in a session


def by_hand(controller: Any) -> tuple[SessionController, Any]:
    """The session as a person drives it; the simulated robot is the hand that holds the ball."""
    person = Person(lambda wish: None)
    equipment = replace(controller.equipment, robot=person)
    return SessionController(controller.session, equipment, controller.loop), controller.equipment.robot


TYPED = ("-0.38296", "-382.5667340745084", "0,25", "1e-3")


@pytest.mark.slow
def test_what_is_typed_is_in_points_csv_to_the_last_bit(tmp_path: Path) -> None:
    """The four numbers of the issue, and a unit."""
    with open_session(tmp_path / "s", Setup(rig="stereo")) as made:
        controller, hand = by_hand(made)
        controller.start()
        texts = [(TYPED[0], TYPED[1], TYPED[2]), (TYPED[3], "12,5 cm", TYPED[0])]
        for words in texts:
            assert controller.state.target is not None
            hand.move(controller.state.target.xyz)
            with pytest.raises(PositionQuestion, match="is the ball really there"):
                controller.report_position(words)
            assert controller.state.phase == "aim"
            controller.report_position(words, confirmed=True)
            assert controller.state.phase == "shown"
            controller.redo()  # what was typed stays
            controller.accept()
    with (tmp_path / "s" / "points.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    values = {
        "-0.38296": -0.38296,
        "-382.5667340745084": -382.5667340745084,
        "0,25": 0.25,
        "1e-3": 1e-3,
        "12,5 cm": 125.0,
    }
    for row, words in zip(rows, texts, strict=True):
        assert [float(row[axis]) for axis in "xyz"] == [values[word] for word in words]
        assert row["typed"] == "; ".join(f"{axis}={word}" for axis, word in zip("xyz", words, strict=True))
    data = read_dataset(tmp_path / "s")
    assert data.xyz.tolist() == [[values[word] for word in words] for words in texts]
    with Session.open(tmp_path / "s") as session:
        assert session.data is not None
        assert session.data.xyz.tobytes() == data.xyz.tobytes()
        assert session.data.positions.extra["typed"].tolist() == [row["typed"] for row in rows]


@pytest.mark.slow
def test_from_the_ninth_point_on_the_cameras_contradict(tmp_path: Path) -> None:
    with open_session(tmp_path / "s", Setup(rig="bar6")) as made:
        controller, hand = by_hand(made)
        controller.start()
        for _ in range(9):
            assert controller.state.target is not None
            xyz = hand.move(controller.state.target.xyz)
            controller.report_position(tuple(map(repr, xyz.tolist())))  # true: nothing is asked
            controller.accept()
        assert controller.loop.calibration is not None
        assert controller.state.target is not None
        xyz = hand.move(controller.state.target.xyz)
        wrong = xyz + np.array([0, 0, 12.0])  # a block too many under it
        with pytest.raises(PositionQuestion, match="from where the cameras see the ball") as asked:
            controller.report_position(tuple(map(repr, wrong.tolist())))
        assert " mm from where the cameras see the ball" in asked.value.questions[0]
        assert (controller.state.phase, len(controller.session.data or ())) == ("aim", 9)
        controller.report_position(tuple(map(repr, wrong.tolist())), confirmed=True)
        assert controller.state.phase == "shown"
        controller.report_position(parse_position(tuple(map(repr, xyz.tolist())), "mm"))
        controller.accept()
        assert controller.session.data is not None
        assert controller.session.data.xyz[-1].tolist() == xyz.tolist()
