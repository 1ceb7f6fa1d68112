"""The result of an acceptance test: each length with its decision, what all say together, as text, table and JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset.folder import csv_text, format_cells
from implicam.files import write_text
from implicam.formatting import decimal_number, list_some, percent
from implicam.plotted import Plotted
from implicam.verification.lengths import CalibratedLength
from implicam.verification.limit import MaximumPermissibleError
from implicam.verification.statistics import ErrorBarsTest, ScaleTest
from implicam.verification.volume import VolumeCoverage

CONFORMS, NOT_CONFORMS, UNDECIDED, NO_LIMIT = "conforms", "does not conform", "undecided", "no limit"
SCALE_ERROR_TOLD = 1e-4
"""The power to find a scale error of this size is told."""
MAX_ROWS_SHOWN = 12
COLUMNS = (
    "line", "name", "artefact", "a", "b", "calibrated", "measured", "error", "sd_test", "expanded_test", "mpe",
    "decision", "sd_predicted", "note",
)  # fmt: skip


@dataclass(frozen=True)
class LengthResult:
    """One length of an acceptance test.

    Attributes:
        length: As it was calibrated.
        line: The measuring line that it is on.
        measured: As the instrument measured it; NaN where it did not.
        error: Measured minus calibrated, at the artefact's temperature.
        sd_test: Standard uncertainty of the test: certificate, temperature, setup; nothing of the instrument's.
        expanded_test: k times it.
        limit: The maximum permissible error of this length; NaN without one.
        sd_predicted: Standard uncertainty of the measured length, as the calibration states it; NaN where it cannot.
        decision: `conforms`, `does not conform`, `undecided` or `no limit`.
        note: Why it was not measured, or what else to know.
    """

    length: CalibratedLength
    line: str
    measured: float
    error: float
    sd_test: float
    expanded_test: float
    limit: float
    sd_predicted: float
    decision: str
    note: str = ""

    @property
    def is_measured(self) -> bool:
        """Whether there is a value."""
        return math.isfinite(self.measured)


@dataclass(frozen=True, eq=False)
class Verification(Plotted):
    """The result of an acceptance test.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=60, seed=1)
    >>> length = float(sum((rig.xyz[0] - rig.xyz[1]) ** 2)) ** 0.5
    >>> known = ic.CalibratedLength(*rig.points[:2], length, sd=0.001)
    >>> tested = ic.verify(ic.ForwardGP().fit(rig), rig, [known], mpe="0.5 + L/1000")
    >>> tested.decision, tested.lengths[0].is_measured
    ('conforms', True)

    Attributes:
        lengths: Each of them.
        mpe: The limit; None without one.
        k: Coverage factor of expanded uncertainties.
        bars: Whether errors are as large as predicted; None where the calibration does not predict what they share.
        scale: The error of scale; None where it cannot be told.
        volume: Where the lengths are; None where no volume is known.
        method: Of the calibration.
        length_unit: Of all lengths.
        notes: What else to know before trusting the result.
    """

    lengths: tuple[LengthResult, ...]
    mpe: MaximumPermissibleError | None
    k: float
    bars: ErrorBarsTest | None
    scale: ScaleTest | None
    volume: VolumeCoverage | None
    method: str
    length_unit: str
    notes: tuple[str, ...]

    @property
    def measured(self) -> tuple[LengthResult, ...]:
        """The lengths that were measured."""
        return tuple(one for one in self.lengths if one.is_measured)

    @property
    def decision(self) -> str:
        """Of all lengths: `conforms`, `does not conform`, `undecided` or `no limit`."""
        if self.mpe is None:
            return NO_LIMIT
        decisions = {one.decision for one in self.lengths}
        return next((d for d in (NOT_CONFORMS, UNDECIDED) if d in decisions), CONFORMS)

    @property
    def worst(self) -> LengthResult:
        """The length that comes nearest to its limit, or is farthest beyond; without a limit the one most in error."""
        over = [abs(one.error) / (one.limit if self.mpe else 1.0) for one in self.measured]
        return self.measured[int(np.argmax(over))]

    @property
    def demonstrated(self) -> float:
        """The smallest limit, the same for all lengths, that would have been proven."""
        return max(abs(one.error) + one.expanded_test for one in self.measured)

    @property
    def trusted(self) -> bool:
        """Whether the result is good news: conformity is proven; without a limit, nothing speaks against error bars
        and scale."""
        if self.mpe is not None:
            return self.decision == CONFORMS
        honest = self.bars is None or self.bars.verdict != "too small"
        return honest and not (self.scale is not None and self.scale.found)

    def sentences(self) -> list[str]:
        """What was found, in words."""
        return [self.verdict_sentence(), *self.findings()]

    def verdict_sentence(self) -> str:
        """The decision in a sentence."""
        unit, worst = self.length_unit, self.worst
        size = f"the largest error is {_plus(worst.error)} {unit} (U = {decimal_number(worst.expanded_test, 2)} {unit})"
        if self.mpe is None:
            proven = decimal_number(self.demonstrated)
            return f"Without a limit: {size}; a limit of {proven} {unit} for all lengths would be proven."
        limit = f"MPE = {self.mpe} {unit}"
        if self.decision == CONFORMS:
            return f"Conformity with {limit} is proven: all {len(self.lengths)} lengths, each with its uncertainty."
        over = [one.length.title for one in self.lengths if one.decision == self.decision]
        which = f"{len(over)} of {len(self.lengths)} lengths: {list_some(over, 3)}"
        if self.decision == NOT_CONFORMS:
            return f"Non-conformity with {limit} is proven, by {which}."
        return f"Neither conformity nor non-conformity with {limit} is proven, because of {which}."

    def findings(self) -> list[str]:
        """What else was found, in sentences: error bars, scale, volume."""
        said = []
        if self.bars is not None:
            bars, means = self.bars, _BARS[self.bars.verdict]
            said.append(
                f"Errors are {decimal_number(bars.ratio, 2)} times what the calibration predicts (95 %: "
                f"{decimal_number(bars.low, 2)} to {decimal_number(bars.high, 2)}): {means}."
            )
        if self.scale is not None:
            said += self._scale_sentences(self.scale)
        if self.volume is not None:
            missed = sum(not check.fulfilled for check in self.volume.checks)
            asked = f"{len(self.volume.checks) - missed} of {len(self.volume.checks)} things that the standards ask"
            said.append(f"The lengths cover {percent(self.volume.covered)} of {self.volume.volume}; {asked} are there.")
        return said

    def _scale_sentences(self, scale: ScaleTest) -> list[str]:
        found = "An error of scale is found" if scale.found else "No error of scale is found"
        low, high = scale.interval
        p = decimal_number(scale.p_value, 2)
        power = percent(scale.power(SCALE_ERROR_TOLD))
        return [
            f"{found}: {scale.value:+.1e} (95 %: {low:+.1e} to {high:+.1e}), p = {p}.",
            f"Such a test finds a scale error of {SCALE_ERROR_TOLD:.0e} with a probability of {power}, "
            f"and one of {scale.detectable:.1e} with 95 %.",
        ]

    def write_csv(self, path: str | Path) -> None:
        """Write verify.csv: a row for each length.

        Args:
            path: Of the table.

        Raises:
            ImplicamError: It cannot be written.
        """
        write_text(Path(path), self.csv_text())

    def csv_text(self) -> str:
        """The text of verify.csv."""
        rows = []
        for one in self.lengths:
            known, numbers = one.length, (one.measured, one.error, one.sd_test, one.expanded_test, one.limit)
            rows.append(
                [one.line, known.title, known.artefact, known.a, known.b, *format_cells(np.array([known.corrected])),
                 *format_cells(np.array(numbers)), one.decision, *format_cells(np.array([one.sd_predicted])), one.note]
            )  # fmt: skip
        return csv_text(COLUMNS, rows)

    def as_table(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        volume = self.volume and {
            "volume": self.volume.volume, "covered": self.volume.covered,
            "checks": [check._asdict() for check in self.volume.checks],
            "next": [
                {"ends": one.ends.tolist(), "middle": one.middle.tolist(), "direction": one.direction.tolist(),
                 "covered": one.covered} for one in self.volume.next
            ],
        }  # fmt: skip
        bars = self.bars and {
            "lengths": self.bars.lengths, "chi_squared": self.bars.chi_squared, "p_value": self.bars.p_value,
            "ratio": self.bars.ratio, "low": self.bars.low, "high": self.bars.high, "verdict": self.bars.verdict,
        }  # fmt: skip
        scale = self.scale and {
            "value": self.scale.value, "sd": self.scale.sd, "low": self.scale.interval[0],
            "high": self.scale.interval[1], "p_value": self.scale.p_value, "found": self.scale.found,
            "power": {f"{SCALE_ERROR_TOLD:g}": self.scale.power(SCALE_ERROR_TOLD)},
            "detectable": self.scale.detectable,
        }  # fmt: skip
        rows = [
            {"line": one.line, "name": one.length.title, "calibrated": one.length.corrected, "measured": one.measured,
             "error": one.error, "sd_test": one.sd_test, "expanded_test": one.expanded_test, "mpe": one.limit,
             "decision": one.decision, "sd_predicted": one.sd_predicted, "note": one.note} for one in self.lengths
        ]  # fmt: skip
        return {
            "decision": self.decision, "mpe": self.mpe and str(self.mpe), "k": self.k,
            "largest_error": self.worst.error, "demonstrated_mpe": self.demonstrated, "error_bars": bars,
            "scale": scale, "volume": volume, "lengths": rows, "length_unit": self.length_unit,
            "said": self.sentences(), "notes": list(self.notes),
        }  # fmt: skip

    def plot(self) -> Any:
        """The errors over the lengths with their uncertainties and the limit, a figure of Plotly.

        Raises:
            MissingExtraError: Plotly is not installed.
        """
        from implicam.verification.figure import errors_over_lengths

        return errors_over_lengths(self)

    def __repr__(self) -> str:
        return "\n".join([f"{self.decision}: {len(self.measured)} of {len(self.lengths)} lengths measured"]
                         + [f"  {sentence}" for sentence in self.sentences()])  # fmt: skip

    def _repr_html_(self) -> str:
        unit = self.length_unit
        heads = (
            "length",
            f"calibrated, {unit}",
            f"error, {unit}",
            f"U of the test, {unit}",
            f"MPE, {unit}",
            "decision",
        )
        rows = [self._html_row(one) for one in self.lengths[:MAX_ROWS_SHOWN]]
        more = len(self.lengths) - len(rows)
        return (
            "".join(f"<p>{escape(sentence)}</p>" for sentence in self.sentences())
            + f"<table><thead><tr>{''.join(f'<th>{head}</th>' for head in heads)}</tr></thead>"
            + f"<tbody>{''.join(rows)}</tbody></table>"
            + (f"<p>... and {more} more</p>" if more > 0 else "")
        )

    def _html_row(self, one: LengthResult) -> str:
        numbers = [_plus(one.error), decimal_number(one.expanded_test, 2), decimal_number(one.limit)]
        cells = [one.length.title, decimal_number(one.length.corrected, 7), *numbers, one.decision]
        return "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"


_BARS = {
    "right": "its error bars hold",
    "too small": "its error bars are too small",
    "too large": "its error bars are too large",
    "cannot tell": "too few lengths to judge its error bars",
}


def _plus(value: float) -> str:
    return ("+" if value > 0 else "") + decimal_number(value)


def decide(error: float, limit: float, expanded: float) -> str:
    """The decision rule of ISO 14253-1: the uncertainty counts against whoever wants to prove something.

    Args:
        error: Of a length.
        limit: Its maximum permissible error.
        expanded: The expanded uncertainty of the test.
    """
    if abs(error) <= limit - expanded:
        return CONFORMS
    return NOT_CONFORMS if abs(error) > limit + expanded else UNDECIDED
