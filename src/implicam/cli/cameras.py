"""`implicam export` and `implicam import`: cameras for other programs, and from them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from implicam.calibrators import load_calibration
from implicam.calibrators.explicit import calibration_of, rig_of
from implicam.cli import show
from implicam.cli.app import Json, command, must_be_calibration, must_not_replace
from implicam.dataset.table_options import TableOptions
from implicam.exchange import FOLDERS, FORMATS, UNKNOWN_UNIT, WRITTEN, export_cameras, import_cameras


@command("export")
def export_command(
    calibration: Annotated[Path, typer.Argument(help="A calibration by explicit, or by forward-gp.")],
    to: Annotated[str, typer.Option("--to", metavar="NAME", help=f"One of {', '.join(WRITTEN)}.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help=f"The file to write; for {', '.join(FOLDERS)} a folder.")
    ],
    json: Json = False,
) -> None:
    """Write the cameras for another program: lenses and places, as far as its format holds them."""
    must_not_replace(output, calibration)
    rig, lost = rig_of(load_calibration(calibration))
    notes = [*lost, *export_cameras(rig, to, output)]
    if json:
        show.emit_json({"cameras": len(rig.cameras), "format": to, "file": str(output), "notes": notes})
        return
    show.line(f"{output}: {len(rig.cameras)} cameras as {FORMATS[to].what}")
    show.notes(notes)


@command("import")
def import_command(
    cameras: Annotated[
        list[Path], typer.Argument(help="Cameras that another program calibrated: its file, folder, or files.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The calibration file to write (*.implicam).")],
    kind: Annotated[
        str | None,
        typer.Option("--from", metavar="NAME", help=f"One of {', '.join(FORMATS)}; where the content does not tell."),
    ] = None,
    noise: Annotated[
        float, typer.Option("--noise", min=1e-6, metavar="PX", help="Noise of views that do not state theirs.")
    ] = 0.3,
    unit: Annotated[
        str | None, typer.Option("--unit", metavar="UNIT", help="Length unit, where the file does not state it.")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option("--size", metavar="SIZE", help="Of the images, where the file does not state it: 1280x800."),
    ] = None,
    json: Json = False,
) -> None:
    """Make a calibration of another program's cameras, to measure with them and to check them."""
    must_be_calibration(output)
    for file in cameras:
        must_not_replace(output, file)
    rig = import_cameras(cameras, kind)
    rig = rig.in_unit(unit) if unit and rig.length_unit != UNKNOWN_UNIT else import_cameras(cameras, kind, unit=unit)
    rig = rig.with_sizes(TableOptions(size=size).sizes(tuple(camera.name for camera in rig.cameras))) if size else rig
    calibration = calibration_of(rig, cameras[0].stem, noise)
    calibration.save(output)
    if json:
        show.emit_json({"calibration": str(output), "cameras": len(rig.cameras), "notes": calibration.notes()})
        return
    show.line(f"{output}: {len(rig.cameras)} cameras, lengths in {rig.length_unit}")
    show.notes(calibration.notes())
