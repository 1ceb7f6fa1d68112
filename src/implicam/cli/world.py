"""`implicam world`: where the world of a calibration from a wand is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from implicam import calibration_file
from implicam.calibrators import load_calibration
from implicam.cli import show
from implicam.cli.app import Json, command, must_be_calibration, must_not_replace, read, read_to_measure
from implicam.cli.options import with_table_options
from implicam.dataset import TableOptions
from implicam.dataset.folder import read_points
from implicam.dataset.table_options import DOCUMENTED
from implicam.world import set_world, with_known_positions

_AXES = "Points that say where the axes are, instead of known positions"


def _names(given: str | None) -> tuple[str, ...]:
    return tuple(name.strip() for name in (given or "").split(",") if name.strip())


@command("world")
@with_table_options
def world_command(
    calibration: Annotated[Path, typer.Argument(help="A calibration file made without known positions.")],
    dataset: Annotated[
        Path | None, typer.Argument(help="What the cameras saw of an L-frame, known points, a floor, a plumb line.")
    ] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="The calibration file to write.")] = Path(
        "world.implicam"
    ),
    points: Annotated[
        Path | None,
        typer.Option("--points", metavar="CSV", help="Where DATASET's points or markers are in the world: points.csv."),
    ] = None,
    origin: Annotated[
        str | None, typer.Option(metavar="POINT", help="It is at 0, 0, 0.", rich_help_panel=_AXES)
    ] = None,
    x: Annotated[
        str | None,
        typer.Option("--x", metavar="B or A,B", help="x points from origin, or A, to B.", rich_help_panel=_AXES),
    ] = None,
    y: Annotated[
        str | None, typer.Option("--y", metavar="POINT", help="It is where y is positive.", rich_help_panel=_AXES)
    ] = None,
    plane: Annotated[
        str | None,
        typer.Option(metavar="A,B,C,...", help="z = 0 there; z points to the cameras' side.", rich_help_panel=_AXES),
    ] = None,
    down: Annotated[
        str | None,
        typer.Option(metavar="A,...,B", help="A plumb line from top to bottom; z is up.", rich_help_panel=_AXES),
    ] = None,
    falling: Annotated[
        str | None,
        typer.Option(metavar="MARKER", help="It was dropped or thrown, in frames; z is up.", rich_help_panel=_AXES),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Its centre and axes are the world's.", rich_help_panel=_AXES),
    ] = None,
    table: TableOptions = DOCUMENTED,
    json: Json = False,
) -> None:
    """Set the world of a calibration from a wand, without a new fit: an L-frame, known points, a floor, gravity.

    What the measuring of these leaves uncertain goes into all error bars; distances stay what they are.
    """
    must_be_calibration(output)
    must_not_replace(output, calibration, dataset, points)
    fitted = load_calibration(calibration)
    data = None
    if dataset is not None:
        named = points is not None or any((origin, x, y, plane, down, falling))
        data = read_to_measure(dataset, table, fitted) if named else read(dataset, table, calibration=fitted)
    if points is not None and data is not None:
        data = with_known_positions(data, *read_points(points))
    placed = set_world(
        fitted, data, origin=origin or "", x=_names(x), y=y or "", plane=_names(plane), down=_names(down),
        falling=falling or "", camera=camera or "",
    )  # fmt: skip
    verdict = calibration_file.describe(calibration).get("verdict")
    calibration_file.save(placed, output, verdict)
    notes = [*(() if data is None else data.notes), *placed.world]
    if json:
        show.emit_json({"calibration": str(output), "world": list(placed.world), "notes": notes})
        return
    show.line(f"{output}: {placed.world[0]}")
    show.notes([note for note in notes if note != placed.world[0]])
