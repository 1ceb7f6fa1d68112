"""Calibrated lengths: a table `lengths.csv`, or one length between points named `bar01_a` and `bar01_b`."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from implicam.dataset import Floats
from implicam.dataset.dialect import read_brought_table
from implicam.dataset.tables import NumberColumn, read_columns
from implicam.errors import DatasetError, UsageError, did_you_mean

REFERENCE_TEMPERATURE_C = 20.0
"""At which lengths are stated (ISO 1)."""
LENGTHS_FILE = "lengths.csv"
REQUIRED_COLUMNS = ("a", "b", "length")
TEXT_COLUMNS = ("line", "name", "artefact")
NUMBER_COLUMNS = (
    "sd", "U", "k", "temperature", "sd_temperature", "expansion", "sd_expansion", "sd_setup",
)  # fmt: skip
USUAL_COVERAGE_FACTOR = 2.0
MAX_EXPANSION_PER_K = 1e-3
"""Ten times that of plastics: a larger one is in another unit."""
MIN_TEMPERATURE_C, MAX_TEMPERATURE_C = -100.0, 300.0
"""Of an artefact: no lengths are calibrated for others, and what is beyond is a slip, or in another unit."""
_END = re.compile(r"(.+)([-_.])([abAB])")


@dataclass(frozen=True)
class CalibratedLength:
    """A length that is known, between two points that the cameras saw.

    Attributes:
        a: Name of the point at one end.
        b: Name of the point at the other.
        length: As the certificate states it, at 20 degrees C where a temperature is given.
        sd: Standard uncertainty of the certificate: its expanded uncertainty over its coverage factor. None: not
            stated.
        line: The measuring line that it is on; empty: found from where it was measured.
        name: Of the length; empty for `a - b`.
        artefact: What it was measured on. Lengths of one artefact share the errors of certificate and temperature.
        temperature: Of the artefact, degrees C. None: no correction.
        sd_temperature: Its standard uncertainty.
        expansion: Coefficient of thermal expansion, per K.
        sd_expansion: Its standard uncertainty.
        sd_setup: Standard uncertainty of what each measurement adds: holding, bending, the marks' centres.

    >>> import implicam as ic
    >>> steel = ic.CalibratedLength("p1", "p2", 500.0, sd=0.001, temperature=22.0, expansion=11.5e-6)
    >>> round(steel.corrected, 4)
    500.0115
    """

    a: str
    b: str
    length: float
    sd: float | None = None
    line: str = ""
    name: str = ""
    artefact: str = ""
    temperature: float | None = None
    sd_temperature: float = 0.0
    expansion: float | None = None
    sd_expansion: float = 0.0
    sd_setup: float = 0.0

    def __post_init__(self) -> None:
        if self.a == self.b:
            raise UsageError(f"a length is between two points, and {self.a!r} is one.", fix="give another end")
        if not (math.isfinite(self.length) and self.length > 0):
            raise UsageError(f"{self.title}: a calibrated length of {self.length!r} is none.", fix="it is above 0")
        for what in ("sd", "sd_temperature", "sd_expansion", "sd_setup"):
            value = getattr(self, what)
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise UsageError(f"{self.title}: {what} is {value!r}.", fix="an uncertainty is 0 or more")
        self._check_temperature()

    def _check_temperature(self) -> None:
        if self.expansion is not None and not abs(self.expansion) <= MAX_EXPANSION_PER_K:
            raise UsageError(
                f"{self.title}: a coefficient of expansion of {self.expansion!r} per K is not possible.",
                fix="steel has 11.5e-6, aluminium 23e-6: write it per K, not in 1e-6 per K",
            )
        if self.temperature is not None and not MIN_TEMPERATURE_C <= self.temperature <= MAX_TEMPERATURE_C:
            raise UsageError(
                f"{self.title}: no artefact is measured at {self.temperature:g} degrees C.",
                fix="give its temperature in degrees C, mostly near 20",
            )
        if self.temperature is None:
            if self.expansion is not None:
                raise UsageError(
                    f"{self.title}: there is a coefficient of expansion, but no temperature.",
                    fix="give the temperature of the artefact, or leave the coefficient out",
                )
        elif self.expansion is None and self.temperature != REFERENCE_TEMPERATURE_C:
            raise UsageError(
                f"{self.title}: at {self.temperature:g} degrees C it is not as long as at "
                f"{REFERENCE_TEMPERATURE_C:g}, and how much is not known.",
                fix="give the coefficient of expansion per K (steel 11.5e-6); 0 where it is not to be corrected",
            )

    @property
    def title(self) -> str:
        """Its name, or its ends."""
        return self.name or f"{self.a} - {self.b}"

    @property
    def corrected(self) -> float:
        """The length at the temperature that it was measured at."""
        return self.length * (1 + (self.expansion or 0.0) * self._warmer)

    @property
    def sd_of_temperature(self) -> float:
        """Standard uncertainty that temperature and coefficient of expansion bring."""
        parts = (self.expansion or 0.0) * self.sd_temperature, self._warmer * self.sd_expansion
        return self.length * math.hypot(*parts)

    @property
    def sd_shared(self) -> float:
        """Standard uncertainty that all lengths of its artefact share: certificate and temperature."""
        return math.hypot(self.sd or 0.0, self.sd_of_temperature)

    @property
    def sd_test(self) -> float:
        """Standard uncertainty of the test at this length; none of it is the instrument's."""
        return math.hypot(self.sd_shared, self.sd_setup)

    @property
    def _warmer(self) -> float:
        return 0.0 if self.temperature is None else self.temperature - REFERENCE_TEMPERATURE_C


def read_lengths(path: Path) -> list[CalibratedLength]:
    """Read a table of calibrated lengths.

    Args:
        path: CSV, also with semicolons and decimal commas, with the columns a, b, length, and any of line, name,
            artefact, sd (or U and k), temperature, sd_temperature, expansion, sd_expansion, sd_setup.

    Raises:
        DatasetError: It cannot be read; names the line.
    """
    wanted = ("length", *NUMBER_COLUMNS)
    header, rows, decimal = read_brought_table(path, REQUIRED_COLUMNS, wanted, "line,name,a,b,length,U")
    known = (*REQUIRED_COLUMNS, *TEXT_COLUMNS, *NUMBER_COLUMNS)
    for column in header:
        if column not in known:
            raise DatasetError(
                f"{path}, line 1: the column {column!r} is not known{did_you_mean(column, known)}.",
                why=f"a table of lengths has {', '.join(known)}",
                fix="rename the column, or take it out",
            )
    if "sd" in header and "U" in header:
        raise DatasetError(
            f"{path}, line 1: there are both sd and U.",
            why="both are the uncertainty of the certificate: sd is standard, U is expanded, k times as large",
            fix="take one out",
        )
    must = NumberColumn("give the calibrated length", decimal=decimal)
    may = NumberColumn("leave the cell empty", missing=("",), decimal=decimal)
    numbers = dict.fromkeys(NUMBER_COLUMNS, may)
    table = read_columns(path, header, rows, ("a", "b", *TEXT_COLUMNS), {"length": must, **numbers})
    if not table.n:
        raise DatasetError(f"{path} has no lengths.", fix="add a row for each length")
    found = []
    for i in range(table.n):
        cells = {name: float(values[i]) for name, values in table.numbers.items() if not math.isnan(values[i])}
        if "U" in cells:
            cells["sd"] = cells.pop("U") / _coverage_factor(cells.pop("k", USUAL_COVERAGE_FACTOR), table.place(i))
        elif cells.pop("k", None) is not None:
            raise DatasetError(f"{table.place(i)}: there is k, but no U.", fix="give U, the expanded uncertainty")
        texts = {name: values[i] for name, values in table.texts.items()}
        try:
            found.append(CalibratedLength(**texts, **cells))  # type: ignore[arg-type]
        except UsageError as error:
            raise DatasetError(f"{table.place(i)}: {error.what}", why=error.why, fix=error.fix) from None
    return found


def _coverage_factor(k: float, place: str) -> float:
    if not k >= 1:
        raise DatasetError(
            f"{place}: a coverage factor k of {k:g} is not usual.", fix="the certificate states it; mostly 2"
        )
    return k


def lengths_by_names(points: Sequence[str], length: float, *, sd: float | None = None) -> list[CalibratedLength]:
    """The same length between all points whose names differ in their end, `_a` and `_b` (also with `-` or `.`).

    Args:
        points: Names.
        length: What is known between the two.
        sd: Its standard uncertainty; None: not stated.

    Raises:
        DatasetError: There is no such pair.
    """
    ends: dict[str, dict[str, str]] = {}
    for point in points:
        if found := _END.fullmatch(point):
            ends.setdefault(found[1] + found[2], {})[found[3].lower()] = point
    pairs = {stem[:-1]: end for stem, end in ends.items() if len(end) == 2}
    if not pairs:
        raise DatasetError(
            "which points are the ends of lengths is not known.",
            why="no two are named alike but for the end: bar01_a and bar01_b",
            fix=f"write a table {LENGTHS_FILE} with the columns {','.join(REQUIRED_COLUMNS)}, or name the points so",
        )
    return [CalibratedLength(end["a"], end["b"], length, sd, line=stem, name=stem) for stem, end in pairs.items()]


def check_pairs(lengths: Sequence[CalibratedLength]) -> None:
    """Refuse two rows that are one measurement.

    Args:
        lengths: The lengths.

    Raises:
        UsageError: Two have the same ends.
    """
    for pair, times in Counter(tuple(sorted((one.a, one.b))) for one in lengths).items():
        if times > 1:
            raise UsageError(
                f"the length between {pair[0]} and {pair[1]} is there {times} times.",
                why="two rows with the same points are one measurement, not a repeated one",
                fix="measure it again and give the points of each repetition names of their own",
            )


def shared_covariance(lengths: Sequence[CalibratedLength]) -> Floats:
    """(n, n) covariance of the errors that the test itself brings.

    Args:
        lengths: n lengths. Those of one artefact share the errors of certificate and temperature fully.
    """
    shared = np.array([one.sd_shared for one in lengths])
    artefacts = np.array([one.artefact for one in lengths])
    same = artefacts[:, None] == artefacts[None, :]
    return np.asarray(np.outer(shared, shared) * same + np.diag([one.sd_setup**2 for one in lengths]))
