"""Positions as a person types them: to the last bit, with sign, unit and decimal comma; and what to ask before one is
taken."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations

import numpy as np

from implicam.active import Target, Workspace
from implicam.dataset import Floats
from implicam.dataset.units import METRES_PER_UNIT
from implicam.errors import UsageError
from implicam.measurement import Measurement

TYPED_COLUMN = "typed"
"""The further column of points.csv with the texts: `x=-0.38296; y=0,25 cm; z=1e-3`."""

MAX_CHARACTERS = 60
MAX_EXPONENT = 30

FAR_FROM_TARGET = 0.25
"""Of the workspace's diagonal: a ball that is farther from its target is asked about."""

OUTSIDE = 0.01
"""Of the workspace's diagonal: so far outside of it is still at its edge."""

FAR_SDS, FAR_FROM_MEASURED = 6.0, 0.005
"""A position is far from what the cameras measure beyond so many standard uncertainties, and this part of the
workspace's diagonal: what a hand and a ruler may be off."""

_SIGNS = str.maketrans(dict.fromkeys("−‐‑‒–—﹣－", "-") | {"＋": "+", "，": ",", "．": ".", "’": "'"})
_THIN_SPACES = "\u00a0\u2009\u202f"  # between groups of three digits, from a document; nobody types them by mistake
_UNITS = {**METRES_PER_UNIT, "μm": 1e-6, '"': METRES_PER_UNIT["in"], "″": METRES_PER_UNIT["in"]}
_LENGTH = re.compile(rf"([+-]?)\s*([0-9.,'{_THIN_SPACES}]+)(?:[eE]([+-]?[0-9]{{1,6}}))?\s*([^\W\d_]*|[\"″])")


@dataclass(frozen=True, eq=False)
class TypedPosition:
    """A position that was typed: (3,) in the session's length unit, and the texts of x, y and z as they were typed."""

    xyz: Floats
    texts: tuple[str, str, str]

    @property
    def as_typed(self) -> str:
        """The texts in one, for `TYPED_COLUMN`."""
        return "; ".join(f"{axis}={text}" for axis, text in zip("xyz", self.texts, strict=True))


class PositionQuestion(UsageError):
    """A position that was not taken yet: the person is to be asked, and says it again as confirmed.

    Attributes:
        questions: What is odd about it, in sentences with the numbers.
    """

    def __init__(self, questions: Sequence[str]) -> None:
        self.questions = tuple(questions)
        super().__init__(
            "is the ball really there?", why="; ".join(questions), fix="correct the numbers, or say that it is"
        )


def parse_position(texts: Sequence[str], unit: str) -> TypedPosition:
    """The position that a person typed.

    Args:
        texts: Of x, y and z.
        unit: The session's, in which numbers without one are.

    Raises:
        UsageError: One of them is no length, or may mean two.

    >>> parse_position(("-0.38296", "0,25", "12,5 cm"), "mm").xyz.tolist()
    [-0.38296, 0.25, 125.0]
    """
    x, y, z = (parse_length(text, unit, axis) for axis, text in zip("xyz", texts, strict=True))
    first, second, third = (" ".join(text.split()) for text in texts)
    return TypedPosition(np.array([x, y, z]), (first, second, third))


def parse_length(text: str, unit: str, what: str = "") -> float:
    """The length that a person typed, as the nearest number there is.

    A comma or a point is the decimal sign; the other one, an apostrophe or a thin space may stand between groups of
    three digits. `1,234` alone may mean either, and is refused.

    Args:
        text: Such as "-0.38296", "0,25", "1e-3", "12,5 cm" or "1,234.5".
        unit: The session's, in which it is given back; a number without a unit is in it.
        what: What to call it in the error: "x".

    Raises:
        UsageError: It is no length, or may mean two.

    >>> parse_length("−382.5667340745084", "mm"), parse_length("1e-3", "mm"), parse_length("0.25m", "mm")
    (-382.5667340745084, 0.001, 250.0)
    """
    called = f"{what} = " if what else ""
    found = _LENGTH.fullmatch(text.translate(_SIGNS).strip()) if len(text) <= MAX_CHARACTERS else None
    if found is None:
        raise UsageError(
            f"{called}{text[:MAX_CHARACTERS]!r} is no length.",
            why="it takes one number, perhaps with a unit" if text.strip() else "it is empty",
            fix="type a number such as -0.38296, 0,25, 1e-3 or 12.5 cm",
        )
    sign, digits, exponent, given = found.groups()
    if given and given not in _UNITS:
        raise UsageError(
            f"{called}{text!r} is in a unit that is not known: {given!r}.", fix=f"use {', '.join(METRES_PER_UNIT)}"
        )
    plain = _plain_digits(digits, f"{called}{text!r}")
    if abs(int(exponent or 0)) > MAX_EXPONENT:
        raise UsageError(f"{called}{text!r} is no length that can be.", fix="check the exponent")
    number = f"{plain}e{exponent or 0}"
    factor = Fraction(str(_UNITS[given])) / Fraction(str(METRES_PER_UNIT[unit])) if given else Fraction(1)
    value = float(number) if factor == 1 else float(Fraction(number) * factor)  # each is rounded once
    return -value if sign == "-" else value


def _plain_digits(digits: str, called: str) -> str:
    """Digits with nothing but a decimal point; UsageError where they are no number, or two."""
    for space in _THIN_SPACES:
        digits = digits.replace(space, "'")
    commas, points = digits.count(","), digits.count(".")
    if re.fullmatch(r"[1-9][0-9]{0,2},[0-9]{3}", digits):
        whole, part = digits.split(",")
        raise UsageError(
            f"{called} may mean {whole}.{part} or {whole}{part}.",
            why="a comma is a decimal sign to some, and stands between thousands to others",
            fix=f"type {whole}.{part} or {whole}{part}",
        )
    decimal = ""
    if commas and points:
        decimal = max(",.", key=digits.rindex)
    elif commas + points == 1:
        decimal = "," if commas else "."
    whole, _, part = digits.rpartition(decimal) if decimal else (digits, "", "")
    good = re.fullmatch(r"[0-9]*|[0-9]{1,3}(?:([,.'])[0-9]{3}(?:\1[0-9]{3})*)", whole) and re.fullmatch("[0-9]*", part)
    plain = re.sub("[,.']", "", whole) + (f".{part}" if part else "")
    if not good or not plain:
        raise UsageError(
            f"{called} is no number.", why="commas, points or spaces stand where none can", fix="type it as -1234.5"
        )
    return plain


def questions_before(xyz: Floats, unit: str, workspace: Workspace, target: Target | None) -> tuple[str, ...]:
    """What to ask about a position before pictures are taken of it.

    Args:
        xyz: (3,) in the session's length unit, world frame.
        unit: That length unit.
        workspace: Where targets can be.
        target: Where the ball was to be; None where that is not known.

    Returns:
        Sentences with the numbers; none where nothing is odd.
    """
    asked = []
    outside = float(np.max(workspace.normals @ xyz - workspace.offsets))
    if outside > OUTSIDE * workspace.size:
        asked.append(f"{_words(xyz)} {unit} is {outside:.4g} {unit} outside of the workspace, {workspace.name} {unit}")
    if target is None:
        return tuple(asked)
    away = float(np.linalg.norm(xyz - target.xyz))
    if away > FAR_FROM_TARGET * workspace.size:
        asked.append(
            f"{_words(xyz)} {unit} is {away:.4g} {unit} from the target {_words(target.xyz)} {unit}"
            + _slip(xyz, target.xyz, 0.2 * away, unit)
        )
    return tuple(asked)


def questions_after(
    xyz: Floats, sd: Floats, unit: str, workspace: Workspace, measured: Measurement | None
) -> tuple[str, ...]:
    """What to ask about a position once the cameras have measured the ball.

    Args:
        xyz: (3,) in the session's length unit, world frame.
        sd: (3,) its standard uncertainty, NaN where not stated.
        unit: That length unit.
        workspace: Where targets can be.
        measured: The ball, by what all cameras see; None where there is no calibration yet.

    Returns:
        Sentences with the numbers; none where nothing is odd, or the cameras cannot tell.
    """
    if measured is None or len(measured) != 1 or not np.isfinite(measured.xyz[0]).all():
        return ()
    apart = xyz - measured.xyz[0]
    away = float(np.linalg.norm(apart))
    along = apart / away if away else apart
    own = math.sqrt(along @ (measured.cov[0] + np.diag(np.nan_to_num(sd) ** 2)) @ along)
    if away <= max(FAR_SDS * own, FAR_FROM_MEASURED * workspace.size):
        return ()
    return (
        f"{_words(xyz)} {unit} is {away:.3g} {unit} from where the cameras see the ball, "
        f"{_words(measured.xyz[0])} {unit}, which is known to {own:.2g} {unit} in that direction"
        + _slip(xyz, measured.xyz[0], 0.2 * away, unit),
    )


def _words(xyz: Floats) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in xyz) + ")"


def _slip(xyz: Floats, where: Floats, near: float, unit: str) -> str:
    """The one slip of a person that explains a position, in words; empty where none does, to within `near`."""
    tries = [(f"{axis} had the other sign", np.where(np.arange(3) == i, -xyz, xyz)) for i, axis in enumerate("xyz")]
    for i, j in combinations(range(3), 2):
        swapped = xyz.copy()
        swapped[[i, j]] = xyz[[j, i]]
        tries.append((f"{'xyz'[i]} and {'xyz'[j]} were exchanged", swapped))
    tries += [(f"it were {words}", xyz * factor) for factor, words in _SCALES.items()]
    best, moved = min(tries, key=lambda one: float(np.linalg.norm(one[1] - where)))
    left = float(np.linalg.norm(moved - where))
    return f"; if {best}, it would be {left:.3g} {unit} from there" if left <= near else ""


_SCALES = {0.1: "a tenth", 10.0: "ten times as much", 0.001: "a thousandth", 1000.0: "a thousand times as much"}

__all__ = [
    "TYPED_COLUMN",
    "PositionQuestion",
    "TypedPosition",
    "parse_length",
    "parse_position",
    "questions_after",
    "questions_before",
]
