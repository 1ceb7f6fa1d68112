"""`implicam verify`: the acceptance test with calibrated lengths."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from implicam import calibration_file
from implicam.active.workspace import workspace_from
from implicam.calibrators import Calibration, load_calibration
from implicam.cli import show
from implicam.cli.app import Json, command, must_not_replace, read_to_measure
from implicam.cli.options import with_table_options
from implicam.dataset import Dataset, Floats, TableOptions
from implicam.dataset.table_options import DOCUMENTED
from implicam.dataset.units import UNKNOWN_UNIT
from implicam.errors import DatasetError, UsageError, import_extra
from implicam.files import refuse_folder, write_text
from implicam.formatting import decimal_number
from implicam.verification import CalibratedLength, Verification, read_lengths, verify
from implicam.verification.acceptance import COVERAGE_FACTOR, NEXT_LENGTHS
from implicam.verification.lengths import LENGTHS_FILE, lengths_by_names
from implicam.verification.printing import find_browser, print_page
from implicam.verification.protocol import PURPOSES, Circumstances, write_protocol
from implicam.verification.result import CONFORMS, NO_LIMIT

MAX_ROWS_SHOWN = 40


@command("verify")
@with_table_options
def verify_command(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    dataset: Annotated[Path, typer.Argument(help="What the cameras saw of the ends of calibrated lengths.")],
    lengths: Annotated[
        Path | None,
        typer.Option("--lengths", metavar="CSV", help=f"Columns a,b,length and more (default DATASET/{LENGTHS_FILE})."),
    ] = None,
    length: Annotated[
        float | None, typer.Option("--length", help="One length, between all points named bar01_a and bar01_b.")
    ] = None,
    length_sd: Annotated[
        float | None, typer.Option("--length-sd", min=0, help="Its standard uncertainty (U / k of the certificate).")
    ] = None,
    mpe: Annotated[
        str | None, typer.Option("--mpe", metavar="LIMIT", help='Maximum permissible error: 0.05 or "0.05 + L/20000".')
    ] = None,
    k: Annotated[float, typer.Option("--k", help="Coverage factor of the uncertainty of the test.")] = COVERAGE_FACTOR,
    temperature: Annotated[
        float | None, typer.Option("--temperature", metavar="C", help="Of the artefact, where the table has none.")
    ] = None,
    expansion: Annotated[
        float | None, typer.Option("--expansion", metavar="PER_K", help="Its thermal expansion; steel has 11.5e-6.")
    ] = None,
    workspace: Annotated[
        str | None,
        typer.Option(
            "--workspace", metavar="BOX", help="Measuring volume x0:x1,y0:y1,z0:z1, or box or hull (default)."
        ),
    ] = None,
    count: Annotated[
        int, typer.Option("--next", "-n", min=0, metavar="N", help="How many further lengths to place.")
    ] = NEXT_LENGTHS,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The protocol; the table goes to the same name with .csv.")
    ] = Path("verify.html"),
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Also print the protocol to PDF, with Chromium or Chrome.")
    ] = False,
    purpose: Annotated[
        str, typer.Option("--purpose", metavar="WORD", help=f"What for: {' or '.join(PURPOSES)}.")
    ] = PURPOSES[0],
    by: Annotated[str, typer.Option("--by", metavar="NAME", help="Who tests, for the protocol.")] = "",
    instrument: Annotated[
        str, typer.Option("--instrument", metavar="NAME", help="What is tested, for the protocol.")
    ] = "",
    certificate: Annotated[
        str, typer.Option("--certificate", metavar="NUMBER", help="Of the artefact, for the protocol.")
    ] = "",
    note: Annotated[str, typer.Option("--note", help="Anything else, for the protocol.")] = "",
    table: TableOptions = DOCUMENTED,
    json: Json = False,
) -> None:
    """Test lengths against a limit, as VDI/VDE 2634-1 and ISO 10360 do: decision, scale, error bars, a protocol.

    Ends with 1 unless conformity is proven; without a limit where error bars or scale are wrong.
    """
    refuse_folder(output)
    if output.suffix.lower() != ".html":
        raise UsageError(f"{output} is no page.", fix=f"end the name in .html: -o {output.stem}.html")
    if purpose not in PURPOSES:
        raise UsageError(f"--purpose {purpose!r} is not known.", fix=f"write {' or '.join(PURPOSES)}")
    beside, printed = output.with_suffix(".csv"), output.with_suffix(".pdf")
    for path in (output, beside, printed):
        must_not_replace(path, calibration, dataset, lengths or _lengths_file(dataset))
    import_extra("jinja2", "report", "the protocol")
    fitted = load_calibration(calibration)
    unit = table.unit or fitted.data.length_unit
    data = read_to_measure(dataset, replace(table, unit=None), fitted)
    if not table.unit and data.length_unit not in (unit, UNKNOWN_UNIT):
        raise UsageError(
            f"{dataset} is in {data.length_unit!r}, and the calibration in {unit!r}.",
            why="it cannot be told in which of the two the calibrated lengths are",
            fix=f"say it: --unit {data.length_unit} or --unit {unit}",
        )
    known = _lengths(lengths, length, length_sd, dataset, data)
    known = [_at_temperature(one, temperature, expansion) for one in known]
    volume = None if workspace is None else workspace_from(workspace, _known_xyz(fitted, unit))
    with show.progress(json) as progress:
        progress("measuring", 0, 1)
        found = verify(fitted, data, known, mpe=mpe, k=k, workspace=volume, next_lengths=count, length_unit=unit)
        progress("measuring", 1, 1)
    when = datetime.now().astimezone().isoformat(" ", "minutes")
    about = Circumstances(
        purpose,
        when,
        by,
        instrument,
        certificate,
        note,
        calibration.name,
        calibration_file.checksum(calibration),
        data.name,
    )
    write_protocol(output, found, about)
    write_text(beside, found.csv_text())
    browser = find_browser() if pdf else None
    if browser:
        print_page(output, printed, browser)
    files = [output, beside, *([printed] if browser else [])]
    if json:
        told = {"protocol": str(output), "table": str(beside), "pdf": str(printed) if browser else None}
        show.emit_json({**told, **found.as_table()})
    else:
        _show(found, files)
        if pdf and not browser:
            show.note(
                f"no Chromium or Chrome was found, so there is no PDF: open {output} in a browser and print it there"
            )
    raise typer.Exit(int(not found.trusted))


def _lengths(
    path: Path | None, length: float | None, sd: float | None, dataset: Path, data: Dataset
) -> list[CalibratedLength]:
    if path is not None and length is not None:
        raise UsageError("--lengths and --length do not go together.", fix="give one of them")
    if sd is not None and length is None:
        raise UsageError("--length-sd belongs to --length.", fix="a table has a column sd, or U and k")
    if length is not None:
        return lengths_by_names(list(map(str, data.points)), length, sd=sd)
    if path is None:
        path = _lengths_file(dataset)
        if not path.is_file():
            raise DatasetError(
                f"{path} does not exist, so no length is known.",
                fix="write that table with the columns a,b,length (and U), name another with --lengths, or give one "
                "length for all points named bar01_a and bar01_b: --length 500 --length-sd 0.002",
            )
    return read_lengths(path)


def _lengths_file(dataset: Path) -> Path:
    """Where lengths are looked for, in a folder or beside a file."""
    return (dataset if dataset.is_dir() else dataset.parent) / LENGTHS_FILE


def _at_temperature(one: CalibratedLength, temperature: float | None, expansion: float | None) -> CalibratedLength:
    """With what the command line says, where the table does not."""
    if one.temperature is not None or (temperature is None and expansion is None):
        return one
    return replace(one, temperature=temperature, expansion=expansion if one.expansion is None else one.expansion)


def _known_xyz(fitted: Calibration, unit: str) -> Floats | None:
    data = fitted.data
    if data.known is None:
        return None
    return (data if unit == data.length_unit else data.in_unit(unit)).xyz


def _show(found: Verification, files: list[Path]) -> None:
    unit = found.length_unit
    first, *others = found.sentences()
    if found.decision in (CONFORMS, NO_LIMIT):
        show.line(first)
    else:
        show.alarm(first)
    for sentence in others:
        show.line(sentence)
    headings = ["length", "line", f"calibrated, {unit}", "error", "U of the test", "MPE", "predicted sd", "decision"]
    rows = [
        [one.length.title, one.line, decimal_number(one.length.corrected, 7), decimal_number(one.error),
         decimal_number(one.expanded_test, 2), decimal_number(one.limit), decimal_number(one.sd_predicted, 2),
         one.decision if one.is_measured else "not measured"] for one in found.lengths[:MAX_ROWS_SHOWN]
    ]  # fmt: skip
    show.table(show.text_table(f"Lengths in {unit}, k = {found.k:g}", headings, rows, left=2))
    if len(found.lengths) > MAX_ROWS_SHOWN:
        show.line(f"and {len(found.lengths) - MAX_ROWS_SHOWN} more in {files[1]}")
    if found.volume is not None:
        asked = [[check.asked, check.found, "yes" if check.fulfilled else "no"] for check in found.volume.checks]
        show.table(show.text_table("The arrangement", ["asked", "found", ""], asked, left=2))
        for one in found.volume.next:
            ends = " to ".join(", ".join(f"{value:.4g}" for value in end) for end in one.ends)
            show.line(f"next length: {ends} {unit}; then {100 * one.covered:.0f} % is covered")
    show.notes(found.notes)
    show.line(f"{', '.join(map(str, files))}: written")
