"""`implicam check`: does a calibration still hold?"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from implicam.calibrators import load_calibration
from implicam.cli import show
from implicam.cli.app import Json, check_figure, command, must_be_calibration, must_not_replace, read
from implicam.cli.options import with_table_options
from implicam.dataset import TableOptions
from implicam.dataset.table_options import DOCUMENTED
from implicam.errors import UsageError
from implicam.formatting import decimal_number, number_with_sd
from implicam.stability import (
    BIASED,
    DISAGREE,
    MIDWAY,
    MOVED,
    NUMBER_NAMES,
    ONE_MOVED,
    SEVERAL,
    STANDS,
    CalibrationCheck,
    CalibrationRepair,
    CameraMovement,
    append_to_log,
    check_calibration,
    read_log,
)


@command("check")
@with_table_options
def check_command(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    dataset: Annotated[Path, typer.Argument(help="New views of 20 points or more; none of them need be known.")],
    level: Annotated[
        float, typer.Option("--level", metavar="P", help="How often a rig that stands may raise an alarm.")
    ] = 0.05,
    log: Annotated[Path | None, typer.Option("--log", metavar="CSV", help="Add the result to this history.")] = None,
    repair: Annotated[
        Path | None,
        typer.Option("--repair", metavar="FILE", help="Write the calibration with the camera where it stands now."),
    ] = None,
    figure: Annotated[
        Path | None, typer.Option("--figure", metavar="FILE", help="Draw the history: .png, .pdf or .svg; with --log.")
    ] = None,
    table: TableOptions = DOCUMENTED,
    json: Json = False,
) -> None:
    """Check whether a calibration still holds, from new views: did a camera move, which, how far?

    No known point is needed; where there are some they are compared, too. Ends with 1 where it does not hold.
    """
    _check_names(log, repair, figure)
    for made in filter(None, (log, repair, figure)):
        must_not_replace(made, calibration, dataset)
    fitted = load_calibration(calibration)
    data = read(dataset, table, calibration=fitted)
    with show.progress(json) as progress:
        progress("checking", 0, 1)
        found = check_calibration(fitted, data, level=level)
        progress("checking", 1, 1)
    if log is not None:
        append_to_log(log, found, data.name)
    if log is not None and figure is not None:
        _draw_history(log, figure)
    repaired = None
    if repair is not None and found.verdict == MOVED:
        repaired = found.repair()
        repaired.calibration.save(repair)
    if json:
        show.emit_json(_as_json(found) | {"repair": None if repaired is None else _repair_as_json(repaired)})
        raise typer.Exit(int(not found.holds))
    _tell(found, len(data))
    if log is not None:
        show.line(f"{log}: one more check{'' if figure is None else f', drawn in {figure}'}")
    if repaired is not None:
        show.line(repaired.sentence())
        show.line(f"{repair}: the calibration as the rig stands now")
    elif repair is not None:
        show.line(f"{repair} is not written: {_NO_REPAIR[found.verdict]}")
    raise typer.Exit(int(not found.holds))


def _check_names(log: Path | None, repair: Path | None, figure: Path | None) -> None:
    if figure is not None and log is None:
        raise UsageError("--figure draws a history of checks, and there is none.", fix="name one: --log checks.csv")
    if figure is not None:
        check_figure(figure)
    if log is not None and log.suffix.lower() != ".csv":
        raise UsageError(f"{log} is no name for a history, which is a CSV.", fix="end it in .csv")
    if repair is not None:
        must_be_calibration(repair)


def _draw_history(log: Path, figure: Path) -> None:
    from implicam.figures.check_history import check_history_figure
    from implicam.figures.printed import save_figure

    save_figure(check_history_figure(read_log(log)), figure)


def _tell(found: CalibrationCheck, given: int) -> None:
    first, *others = found.sentences()
    if found.holds:
        show.line(first)
    else:
        show.alarm(first)
    for sentence in others:
        show.line(sentence)
    if not found.holds and found.cameras:
        show.table(_table(found, given, "if it alone moved", lambda one: map(number_with_sd, one.step, one.sd)))
    if found.cameras:
        show.table(_table(found, given, "named half the time", lambda one: map(_smallest, found.noticed[one.camera])))
        show.line("named half the time: the smallest movement, of this kind alone, that this check would name so often")


_NO_REPAIR = {
    STANDS: "there is nothing to repair",
    ONE_MOVED: "show the cameras points that three of them see, or calibrate again with known points",
    MIDWAY: "check the part of the views after the movement by itself",
    SEVERAL: "one camera that moved can be put right by the others; calibrate again with known points",
    BIASED: "no camera's movement explains it; calibrate again with known points",
    DISAGREE: "of these cameras it cannot be told that one has moved; calibrate with known points",
}
"""Verdict of a check -> why no calibration is written."""


def _table(found: CalibrationCheck, given: int, what: str, cells: Callable[[CameraMovement], Iterable[str]]) -> Any:
    """A row for each camera, the likeliest to have moved first."""
    units = ["deg"] * 3 + [found.length_unit] * 3 + ["%"]
    headings = [what, *(f"{name}, {unit}" for name, unit in zip(NUMBER_NAMES, units, strict=True))]
    used = f"{found.points} points" if found.points == given else f"{found.points} of {given} points used"
    return show.text_table(used, headings, [[one.camera, *cells(one)] for one in found.cameras])


def _smallest(noticed: float) -> str:
    return "-" if np.isinf(noticed) else decimal_number(float(noticed), 2)


def _repair_as_json(repaired: CalibrationRepair) -> dict[str, Any]:
    without = repaired.sd_without
    return {
        "camera": repaired.moved.camera, "sd_unmoved": repaired.sd_unmoved, "sd": repaired.sd,
        "sd_without": without if np.isfinite(without) else None, "said": repaired.sentence(),
    }  # fmt: skip


def _as_json(found: CalibrationCheck) -> dict[str, Any]:
    cameras = [
        {"camera": one.camera}
        | {
            name: {"value": float(value), "sd": float(sd), "noticed": float(least) if np.isfinite(least) else None}
            for name, value, sd, least in zip(NUMBER_NAMES, one.step, one.sd, found.noticed[one.camera], strict=True)
        }
        for one in found.cameras
    ]
    known = found.known and {
        "points": found.known.points, "p_value": found.known.p_value, "bias": found.known.bias.tolist(),
        "bias_sd": found.known.bias_sd.tolist(),
    }  # fmt: skip
    return {
        "verdict": found.verdict, "holds": found.holds, "p_value": found.p_value, "candidates": list(found.candidates),
        "not_judged": list(found.not_judged),
        "cameras": cameras, "known": known, "points": found.points,
        "noise_ratio": found.noise_ratio if np.isfinite(found.noise_ratio) else None,
        "length_unit": found.length_unit, "said": found.sentences(),
    }  # fmt: skip
