"""The protocol of an acceptance test: one HTML page without scripts, light, dark and printed."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from implicam.calibration_file import package_version
from implicam.files import write_text
from implicam.formatting import decimal_number, number, percent
from implicam.templates import Markup, render
from implicam.verification.pictures import TONES, Chart, panels, signed_number
from implicam.verification.result import (
    CONFORMS,
    NO_LIMIT,
    NOT_CONFORMS,
    SCALE_ERROR_TOLD,
    UNDECIDED,
    LengthResult,
    Verification,
)
from implicam.verification.volume import VolumeCoverage

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
PURPOSES = ("acceptance", "reverification")
HEADLINES = {
    CONFORMS: "The instrument conforms to its specification.",
    NOT_CONFORMS: "The instrument does not conform to its specification.",
    UNDECIDED: "It is undecided whether the instrument conforms to its specification.",
    NO_LIMIT: "No limit was stated, so nothing was decided.",
}
BURDEN = {
    "acceptance": "In an acceptance test the manufacturer has to prove conformity, and has not done so.",
    "reverification": "In a reverification the user has to prove conformity, and has not done so.",
}
"""Of an undecided result."""
ROW_HALF_WIDTH, ROW_LIMIT = 60.0, 44.0
"""Of the bar in a row: half its width, and how far from the middle its limit is."""


@dataclass(frozen=True)
class Circumstances:
    """Who tested what, when and how; all of it is only printed.

    Attributes:
        purpose: `acceptance` or `reverification`.
        when: Date and time.
        by: Who tested.
        instrument: What was tested.
        certificate: Of the artefact.
        note: Anything else: temperature of the room, place, order number.
        calibration: Name of the calibration file.
        checksum: Of that file.
        dataset: Name of what was seen.
    """

    purpose: str = PURPOSES[0]
    when: str = ""
    by: str = ""
    instrument: str = ""
    certificate: str = ""
    note: str = ""
    calibration: str = ""
    checksum: str = ""
    dataset: str = ""


def write_protocol(path: Path, found: Verification, about: Circumstances) -> None:
    """Write the protocol as one HTML file that loads nothing.

    Args:
        path: The file; one that is there is replaced.
        found: The result.
        about: Who, when, what.

    Raises:
        MissingExtraError: Jinja2 is not installed.
        ImplicamError: The file cannot be written.
    """
    write_text(path, page(found, about))


def page(found: Verification, about: Circumstances) -> str:
    """The protocol as HTML text.

    Args:
        found: The result.
        about: Who, when, what.

    Raises:
        MissingExtraError: Jinja2 is not installed.
    """
    return render(
        __package__,
        "protocol.html",
        policy=POLICY,
        css=Markup(render("implicam.report", "page.css")),
        title=f"{about.purpose.capitalize()} test{f' of {about.instrument}' if about.instrument else ''}",
        about=about,
        facts=list(_facts(found, about)),
        unit=found.length_unit,
        tone=TONES[found.decision],
        headline=HEADLINES[found.decision],
        burden=BURDEN[about.purpose],
        found=found,
        tiles=list(_tiles(found)),
        chart=Chart.of(found),
        rows=_rows(found),
        artefacts=len({one.length.artefact for one in found.lengths}) > 1,
        panels=[] if found.volume is None else panels(found.volume, found.measured),
        placed=[] if found.volume is None else _placed_rows(found.volume),
        percent=percent,
        not_measured=[(one.length.title, one.note) for one in found.lengths if not one.is_measured],
        versions=f"implicam {package_version()} · Python {platform.python_version()}",
    )


def _facts(found: Verification, about: Circumstances) -> Iterator[tuple[str, str]]:
    temperatures = sorted({one.length.temperature for one in found.lengths if one.length.temperature is not None})
    told = f"{temperatures[0]:g}" if len(temperatures) == 1 else ""
    if len(temperatures) > 1:
        told = f"{temperatures[0]:g} to {temperatures[-1]:g}"
    facts = (
        ("Instrument", about.instrument), ("Tested by", about.by), ("Date", about.when),
        ("Certificate of the artefact", about.certificate), ("Temperature of the artefact", told and f"{told} °C"),
        ("Limit (MPE)", f"{found.mpe} {found.length_unit}" if found.mpe else "none"),
        ("Coverage factor k", f"{found.k:g}"), ("Calibration", about.calibration), ("Method", found.method),
        ("Measured", about.dataset), ("SHA-256 of the calibration file", about.checksum), ("Note", about.note),
    )  # fmt: skip
    return ((label, value) for label, value in facts if value)


def _tiles(found: Verification) -> Iterator[tuple[str, str, str]]:
    unit, worst = found.length_unit, found.worst
    yield (
        "largest error" if found.mpe is None else "largest error against its limit",
        f"{signed_number(worst.error, 3)} {unit}",
        f"{worst.length.title}; limit {number(worst.limit)} {unit}" if found.mpe else worst.length.title,
    )  # fmt: skip
    yield (
        "smallest limit that is proven", f"{number(found.demonstrated)} {unit}",
        "the largest sum of error and uncertainty of the test",
    )  # fmt: skip
    if found.bars is not None:
        yield (
            "errors over predicted", f"{number(found.bars.ratio, 2)}×",
            f"1 is right; 95 %: {number(found.bars.low, 2)} to {number(found.bars.high, 2)}",
        )  # fmt: skip
    if found.scale is not None:
        power = percent(found.scale.power(SCALE_ERROR_TOLD))
        half = (found.scale.interval[1] - found.scale.interval[0]) / 2
        what = "found" if found.scale.found else "none found"
        yield (
            f"error of scale: {what}", f"{1e6 * found.scale.value:+.0f} ± {1e6 * half:.0f} ppm".replace("-", "−"),
            f"95 %; {1e6 * SCALE_ERROR_TOLD:.0f} ppm would be found with {power}",
        )  # fmt: skip
    lines = len({one.line for one in found.measured})
    yield (
        "lengths measured",
        f"{len(found.measured)} of {len(found.lengths)}",
        f"on {lines} line{'s' * (lines != 1)}" if lines else "",
    )


class Row(NamedTuple):
    """A length in the table: its texts, and its bar, from -ROW_HALF_WIDTH to ROW_HALF_WIDTH."""

    one: LengthResult
    cells: list[str]
    tone: str
    at: float
    low: float
    high: float
    beyond: bool


def _rows(found: Verification) -> list[Row]:
    scale = min((one.limit for one in found.measured), default=1.0) if found.mpe else found.demonstrated
    decimals = max(0, 2 - math.floor(math.log10(scale))) if scale > 0 else 3
    rows = []
    for one in found.lengths:
        unit = ROW_LIMIT / (one.limit if found.mpe else max(found.demonstrated, 1e-300))
        at, half = (one.error * unit, one.expanded_test * unit) if one.is_measured else (0.0, 0.0)
        place, low, high = (float(np.clip(v, -ROW_HALF_WIDTH, ROW_HALF_WIDTH)) for v in (at, at - half, at + half))
        cells = [
            f"{one.length.corrected:.{decimals}f}",
            f"{one.measured:.{decimals}f}" if one.is_measured else "–",
            f"{one.error:+.{decimals}f}".replace("-", "−") if one.is_measured else "–",
            decimal_number(one.expanded_test, 2),
            f"{one.limit:.{decimals}f}" if found.mpe else "–",
            decimal_number(one.sd_predicted, 2) if math.isfinite(one.sd_predicted) else "–",
        ]
        rows.append(Row(one, cells, TONES[one.decision], place, low, high, abs(at) > ROW_HALF_WIDTH))
    return rows


def _placed_rows(volume: VolumeCoverage) -> list[list[str]]:
    rows = []
    for i, one in enumerate(volume.next):
        a, b = (", ".join(f"{value:.4g}" for value in end) for end in one.ends)
        along = ", ".join(f"{value + 0.0:.2f}" for value in one.direction)
        size = float(np.linalg.norm(one.ends[1] - one.ends[0]))
        rows.append([str(i + 1), number(size, 4), a, b, along, percent(one.covered)])
    return rows
