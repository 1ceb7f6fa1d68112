"""All priors and thresholds of a method in one flat, frozen value, each with a default, a unit and a sentence.

A method writes a frozen, keyword-only dataclass that inherits `Settings`. A field's type is that of its default: a
whole number, a number, or a tuple of numbers; its name ends in its unit (`UNITS`); the text below it says what it does.
The rest is done here: values that make no sense are refused, tables are read and written, and `described` tells a user.

Here are numbers that are judgements: of what is usual, of what is clear, of what counts. What only says how closely an
equation is solved (steps, tolerances, jitters, sizes of chunks, random draws) is a constant beside the code.
"""

from __future__ import annotations

import ast
import inspect
import math
import sys
import textwrap
from collections.abc import Mapping
from dataclasses import Field, asdict, dataclass, fields
from itertools import pairwise
from typing import Any, NamedTuple, Self

from implicam.errors import UsageError, did_you_mean

BELOW_ONE = ("_share", "_probability", "_p_value", "_p_values", "_slope_ratio", "error_bar_level")
"""What a setting's name ends in where its value must be below one."""

ABOVE = {"degrees_of_freedom": 2, "_folds": 1, "_corners": 3, "_residual_ratio": 1}
"""What a setting's name ends in -> what its value must be above; all others are above zero."""

MAX_COUNT = 10**6
"""Largest whole number: more of anything is a mistake, or an attack on the memory."""

NO_UNIT = "no unit"
COUNT = "count"

UNITS = {
    "_per_wf": "1 / working frame",
    "_wf": "working frame",
    "_half_sides": "half sides",
    "_sides": "longer sides",
    "_half_extents": "half extents",
    "_half_lengths": "half lengths",
    "_extents": "extents",
    "_radii": "radii",
    "_gaps": "gaps",
    "_medians": "medians",
    "_noises": "noises",
    "_residuals": "residuals",
    "_sds": "standard deviations",
    "_nats": "nats",
    "_px": "px",
    "_degrees": "degrees",
    "lengthscale": "half sides; log distance",
    "lengthscale_prior_median": "half sides; log distance",
    **dict.fromkeys(
        ["_ratio", "_share", "_probability", "_p_value", "_p_values", "_level", "_odds", "_cosine", "_tolerance"],
        NO_UNIT,
    ),
    **dict.fromkeys(["_log_sd", "log_distance_sd", "_relative_sd", "_edge_sd", "_prior_sd", "_kind", "_rate"], NO_UNIT),
    **dict.fromkeys(["_mahalanobis", "_chi_squared", "_freedom", "_log_sd_variance", "_noise_variance"], NO_UNIT),
}
"""What a setting's name ends in -> its unit in words; a whole number is a `COUNT`.

The working frame's unit is the spread of the known points; half sides are half the longer side of the image; extents
are those of what is spoken of: pixels, boards, known points.
"""

WITHOUT = "_without_lens"
"""May follow the unit: the same where there is no lens model."""


class Described(NamedTuple):
    """A setting for people.

    Attributes:
        name: of the field.
        value: now.
        default: what it is where nobody says otherwise.
        unit: in words.
        text: what it does.
    """

    name: str
    value: Any
    default: Any
    unit: str
    text: str


@dataclass(frozen=True)
class Settings:
    """What the settings of every method do alike; to be inherited."""

    def __new__(cls, **given: Any) -> Self:
        """UsageError, instead of a TypeError, for a name that is no setting."""
        known = [field.name for field in fields(cls)]
        for name in given:
            if name not in known:
                raise UsageError(
                    f"there is no setting {name!r}{did_you_mean(name, known)}.",
                    fix=f"the settings are the fields of {cls.__name__}",
                )
        return super().__new__(cls)

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            problem = _problem(field, value)
            if problem:
                raise UsageError(
                    f"the setting {field.name} must be {problem}, and is {value!r}.",
                    fix=f"leave it out: {field.default!r} is the default",
                )

    def __repr__(self) -> str:
        """As it would be written: the settings that are not at their default."""
        changed = (f"{name}={value!r}" for name, value in self.changed().items())
        return f"{type(self).__name__}({', '.join(changed)})"

    def changed(self) -> dict[str, Any]:
        """Name -> value of the settings that are not at their default."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name)) != f.default}

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Self:
        """The settings of a table, the others at their default.

        Args:
            table: Name to value, as `as_table` writes it and a calibration file keeps it.

        Raises:
            UsageError: A name is not known, or a value makes no sense.
        """
        if not isinstance(table, Mapping):
            raise UsageError(f"settings are a table of names and values, and not {table!r}.")
        defaults = {field.name: field.default for field in fields(cls)}
        return cls(**{name: _as_default(defaults.get(name), value) for name, value in table.items()})

    def as_table(self) -> dict[str, Any]:
        """All settings, as a calibration file keeps them: numbers and lists of numbers."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    def described(self) -> list[Described]:
        """Every setting with its default, its unit and what it does, in the order of the fields."""
        texts = _texts(type(self))
        return [
            Described(f.name, getattr(self, f.name), f.default, unit_of(f.name, f.default), texts.get(f.name, ""))
            for f in fields(self)
        ]


def unit_of(name: str, default: Any) -> str:
    """The unit of a setting in words.

    Args:
        name: Of the setting; its ending says the unit.
        default: Its default value; a whole number is a count.

    Returns:
        The unit.

    Raises:
        KeyError: The name of a setting that is no whole number does not end in one of `UNITS`.
    """
    if isinstance(default, int):
        return COUNT
    bare = name.removesuffix(WITHOUT)
    return UNITS[max((ending for ending in UNITS if bare.endswith(ending)), key=len, default=name)]


def _texts(kind: type[Settings]) -> dict[str, str]:
    """Field -> the text below it in the source, on one line; nothing where there is no source to be read."""
    found: dict[str, str] = {}
    for owner in reversed(kind.__mro__):
        try:
            source = inspect.getsource(owner) if issubclass(owner, Settings) else ""
        except (OSError, TypeError):
            continue
        body = [line for tree in ast.parse(textwrap.dedent(source)).body for line in getattr(tree, "body", [])]
        for field, text in pairwise(body):
            match field, text:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(told))):
                    found[name] = " ".join(told.split())
    return found


def _as_default(default: Any, value: Any) -> Any:
    """A value of a table in the type of the default, where it has one of that kind."""
    if isinstance(default, tuple) and isinstance(value, list):
        return tuple(value)
    number = isinstance(default, float) and type(value) is int and abs(value) <= sys.float_info.max
    return float(value) if number else value


def _problem(field: Field[Any], value: Any) -> str:
    """What a setting must be that it is not; empty where it is."""
    numbers = value if isinstance(field.default, tuple) else (value,)
    kinds = int if isinstance(field.default, int) else int | float
    if not isinstance(numbers, tuple) or not all(isinstance(n, kinds) and not isinstance(n, bool) for n in numbers):
        return "a whole number" if kinds is int else "a number" if numbers == (value,) else "a tuple of numbers"
    if isinstance(field.default, tuple) and "..." not in str(field.type) and len(numbers) != len(field.default):
        return f"{len(field.default)} numbers"
    if not numbers:
        return "at least one number"
    lowest = next((least for ending, least in ABOVE.items() if field.name.endswith(ending)), 0)
    if kinds is int:
        return "" if all(lowest < n <= MAX_COUNT for n in numbers) else f"above {lowest}, and at most {MAX_COUNT:,}"
    highest = 1 if field.name.endswith(BELOW_ONE) else math.inf
    if not all(lowest < n < highest and abs(n) <= sys.float_info.max for n in numbers):
        return f"above {lowest}" + (" and below 1" if highest == 1 else "" if lowest else ", and finite")
    return ""
