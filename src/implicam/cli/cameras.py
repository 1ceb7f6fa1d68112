"""`implicam export` and `implicam import`: cameras for other programs, and from them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from implicam.calibration_file import checksum
from implicam.calibrators import Calibration, load_calibration
from implicam.calibrators.explicit import calibration_of, rig_of
from implicam.calibrators.undistortion import PinholeView, pinhole_maps
from implicam.cli import show
from implicam.cli.app import Json, command, must_be_calibration, must_be_folder, must_not_replace
from implicam.cli.options import Options, OptionsOfParts, options_of_fields
from implicam.dataset.table_options import TableOptions
from implicam.deploy import write_cpp, write_onnx
from implicam.deploy.cpp_table import EXAMPLE_FILE, HEADER_FILE, TABLE_FILE
from implicam.errors import UsageError, did_you_mean
from implicam.exchange import FOLDERS, FORMATS, UNKNOWN_UNIT, export_cameras, import_cameras
from implicam.exchange.pixel_maps import MAPS_FORMAT, check_maps_folder, write_maps
from implicam.files import is_file_name

ONNX_FORMAT, CPP_FORMAT = "onnx", "cpp"
WRITE_FOLDERS = (*FOLDERS, MAPS_FORMAT, CPP_FORMAT)
NAMES = (*FORMATS, MAPS_FORMAT, ONNX_FORMAT, CPP_FORMAT)


def _map_options() -> Options:
    return {MAPS_FORMAT: options_of_fields(PinholeView)}


def _export(
    calibration: Annotated[Path, typer.Argument(help="A calibration; of onnx also by inverse-gp.")],
    to: Annotated[str, typer.Option("--to", metavar="NAME", help=f"One of {', '.join(NAMES)}.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help=f"The file to write; for {', '.join((*FOLDERS, MAPS_FORMAT, CPP_FORMAT))} a folder."
        ),
    ],
    json: Json = False,
    **options: Any,
) -> None:
    """Write the cameras for another program: lenses and places, as far as its format holds them; pixel maps that make
    pinholes of them, with the sd of the maps; or all that was learned: a graph of ONNX, a table with a C++ header."""
    must_not_replace(output, calibration)
    if to not in NAMES:
        raise UsageError(
            f"there is no format {to!r}{did_you_mean(to, NAMES)}.", fix=f"choose one of {', '.join(NAMES)}"
        )
    given = {name: value for name, value in options.items() if value is not None}
    if to == MAPS_FORMAT:
        _export_maps(load_calibration(calibration), PinholeView(**_with_size(given)), output, json)
        return
    if given:
        raise UsageError(
            f"--{min(given).replace('_', '-')} is an option of {MAPS_FORMAT}, and {to} has none.", fix="leave it out"
        )
    if to == ONNX_FORMAT:
        if is_file_name(output) and output.suffix.lower() != ".onnx":
            raise UsageError(f"{output} is no name for a graph of ONNX.", fix="end it in .onnx")
        notes = write_onnx(load_calibration(calibration), output, checksum(calibration))
        _tell(to, output, "a graph of ONNX, float64", notes, json)
        return
    if to == CPP_FORMAT:
        must_be_folder(output)
        with show.progress(json) as progress:
            notes = write_cpp(load_calibration(calibration), output, checksum(calibration), progress)
        _tell(to, output, f"{HEADER_FILE}, {TABLE_FILE} and {EXAMPLE_FILE}, for C++17", notes, json)
        return
    rig, lost = rig_of(load_calibration(calibration))
    notes = [*lost, *export_cameras(rig, to, output)]
    if json:
        show.emit_json({"cameras": len(rig.cameras), "format": to, "file": str(output), "notes": notes})
        return
    show.line(f"{output}: {len(rig.cameras)} cameras as {FORMATS[to].what}")
    show.notes(notes)


export_command = command("export")(OptionsOfParts(_export, "output", _map_options))


def _tell(to: str, output: Path, what: str, notes: list[str], json: bool) -> None:
    if json:
        show.emit_json({"format": to, "file": str(output), "notes": notes})
        return
    show.line(f"{output}: {what}")
    show.notes(notes)


def _with_size(given: dict[str, Any]) -> dict[str, Any]:
    """The options with WxH as two numbers."""
    if "size" not in given:
        return given
    sides = str(given["size"]).lower().split("x")
    if len(sides) != 2 or not all(side.isdecimal() for side in sides):
        raise UsageError(
            f"--size {given['size']!r} is no size.", fix="give width and height in pixels: --size 1280x800"
        )
    return given | {"size": (int(sides[0]), int(sides[1]))}


def _export_maps(calibration: Calibration, view: PinholeView, output: Path, json: bool) -> None:
    must_be_folder(output)
    check_maps_folder(output, calibration.data.camera_names)
    with show.progress(json) as progress:
        maps, notes = pinhole_maps(calibration, view, progress)
    write_maps(maps, calibration.data.length_unit, output)
    told = [each.summary() for each in maps]
    if json:
        show.emit_json({"cameras": told, "format": MAPS_FORMAT, "folder": str(output), "notes": notes})
        return
    show.line(f"{output}: pixel maps that make pinholes of {len(maps)} cameras")
    show.table(show.maps_table(told))
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
        show.emit_json({"calibration": str(output), "cameras": len(rig.cameras), "notes": calibration.notes})
        return
    show.line(f"{output}: {len(rig.cameras)} cameras, lengths in {rig.length_unit}")
    show.notes(calibration.notes)
