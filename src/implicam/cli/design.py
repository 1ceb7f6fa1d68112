"""`implicam design`: what a placement of cameras will be worth, before it is built."""

from __future__ import annotations

import math
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from implicam.active import Workspace, workspace_from
from implicam.active.workspace import read_places
from implicam.cli import show
from implicam.cli.app import Json, Seed, command, must_be_page
from implicam.dataset import Floats
from implicam.design import Assumptions, Design, compare_designs
from implicam.errors import UsageError
from implicam.formatting import decimal_number, percent
from implicam.rig_model import MIN_POINTS_PER_CAMERA

MAX_CAMERAS_SHOWN = 16


class LengthUnit(StrEnum):
    """Of everything."""

    mm = "mm"
    m = "m"


@command("design")
def design_command(
    rig: Annotated[str, typer.Argument(metavar="RIG", help="bar6, grid9, dome8, ..., or a drawing RIG.toml.")],
    other: Annotated[str | None, typer.Argument(metavar="[RIG2]", help="Another one, to compare with.")] = None,
    workspace: Annotated[
        str | None,
        typer.Option(metavar="BOX", help="x0:x1,y0:y1,z0:z1 in the drawing's frame; or a CSV file of its corners."),
    ] = None,
    points: Annotated[
        str, typer.Option(metavar="N|FILE", help="How many known points, evenly spread; or a CSV file of them.")
    ] = "36",
    noise: Annotated[float, typer.Option(metavar="PX", help="Pixel noise, standard deviation.")] = 0.2,
    lens_error: Annotated[float, typer.Option(metavar="PX", help="Error no lens model contains, rms pixels.")] = 0.5,
    robot_noise: Annotated[
        float, typer.Option(metavar="LENGTH", help="Error of the known positions, sd per axis.")
    ] = 0.0,
    unit: Annotated[LengthUnit | None, typer.Option(help="That of the (first) drawing if not told.")] = None,
    check: Annotated[
        int, typer.Option(min=0, metavar="N", help="Also build N rigs in simulation, calibrate and measure with them.")
    ] = 0,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE.html", help="Also write a page with 3D views.")
    ] = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Predict how uncertain a placement of cameras will be with N known points, and which camera helps most."""
    if output is not None:
        must_be_page(output)
    box = None if workspace is None else workspace_from(workspace, None)
    if box is not None and box.places is not None:
        box = Workspace.hull(box.places)  # what lies between them is measured too, and may be known
    assumed = Assumptions(noise, lens_error, robot_noise)
    specs = [rig] if other is None else [rig, other]
    with show.progress(json) as progress:
        designs = compare_designs(
            specs,
            assumed,
            _known(points),
            workspace=box,
            unit=unit,
            check=check,
            seed=seed,
            progress=progress,
        )
        if output is not None:
            from implicam.design.page import write_page

            write_page(output, designs)
    if json:
        show.emit_json({"designs": [_as_json(design) for design in designs], "page": output and str(output)})
        return
    _print(designs)
    if output is not None:
        show.line(f"{output}: the rig{'s' * (len(designs) > 1)} and the uncertainty in 3D")


def _known(text: str) -> int | Floats:
    """How many known points, or their positions."""
    if text.lower().endswith(".csv"):
        return read_places(Path(text))
    try:
        count = int(text)
        if not MIN_POINTS_PER_CAMERA <= count <= 2000:
            raise ValueError(text)
    except ValueError:
        raise UsageError(
            f"--points {text!r} is no number of known points.",
            fix=f"write a whole number from {MIN_POINTS_PER_CAMERA} to 2000, or the name of a CSV file with x,y,z",
        ) from None
    return count


def _print(designs: list[Design]) -> None:
    first = designs[0]
    assumed, unit = first.prediction.assumed, first.prediction.rig.length_unit
    exact = f", off by {decimal_number(assumed.position_sd)} {unit}" if assumed.position_sd else ""
    show.line(
        f"{len(first.prediction.known)} known points{exact}; pixel noise {decimal_number(assumed.noise, 2)} px, lens "
        f"errors {decimal_number(assumed.lens_error, 2)} px; workspace: {first.workspace.name} {unit}"
    )
    for design in designs:
        show.line(f"{design.name}: {_words(design)}")
    show.line("")
    _print_spreads(designs)
    for design in designs:
        if design.realised is not None:
            _print_check(design)
    for design in designs:
        _print_parts(design, several=len(designs) > 1)


def _words(design: Design) -> str:
    found = design.prediction
    text = f"{len(found.rig.cameras)} cameras"
    if found.blind:
        text += f"; {percent(found.blind)} of the workspace is blind: fewer than two of them see it, or from one place"
    if found.uncalibrated:
        names = ", ".join(found.uncalibrated)
        text += f"; not calibrated, for want of {MIN_POINTS_PER_CAMERA} known points: {names}"
    return text


def _print_spreads(designs: list[Design]) -> None:
    headings = [""]
    for design in designs:
        names = ["median", "95 %", "worst"]
        headings += [f"{design.name}\n{names[0]}", names[1], names[2]] if len(designs) > 1 else names
    rows = []
    for spreads in zip(*(design.spreads for design in designs), strict=True):
        name, unit = spreads[0].name, spreads[0].unit
        row = [f"{name}, {unit}" if unit else f"{name}, %"]
        for each in spreads:
            values = (each.median, each.usual, each.worst)
            row += [decimal_number(x) if unit else percent(x, none="-").replace(" %", "") for x in values]
        rows.append(row)
    show.table(show.text_table("Predicted over the workspace", headings, rows))


def _print_check(design: Design) -> None:
    found, unit = design.realised, design.prediction.rig.length_unit
    assert found is not None
    rows = [[f"{axis}, {unit}", *(decimal_number(value) for value in values)] for axis, *values in design.check_rows()]
    (error, error_sd), (stated, stated_sd) = found.error_ratio, found.stated_ratio
    rows.append(["all over predicted", "1", _with_sd(error, error_sd), _with_sd(stated, stated_sd)])
    title = f"{design.name}: {len(found.errors)} rigs built, calibrated and measured with (rms over places and rigs)"
    show.table(show.text_table(title, ["", "predicted", "error", "stated sd"], rows))
    show.notes([f"{design.name}: {text}" for text in show.counted(found.failed, "rig", "not calibrated")])


def _with_sd(value: float, sd: float) -> str:
    return f"{value:.3f} ± {sd:.3f}" if math.isfinite(sd) else f"{value:.3f}"


def _print_parts(design: Design, *, several: bool) -> None:
    parts = sorted(design.parts, key=lambda part: -part.lost)
    rows = [
        [p.name, str(p.known_seen), percent(p.part_seen), percent(p.lost, 1), percent(p.blind)]
        for p in parts[:MAX_CAMERAS_SHOWN]
    ]
    title = f"{design.name}: which camera helps most" if several else "Which camera helps most"
    headings = ["camera", "known points\nit sees", "of the work-\nspace", "accuracy lost\nwithout it", "blind\nthen"]
    show.table(show.text_table(title, headings, rows))
    if len(parts) > MAX_CAMERAS_SHOWN:
        show.line(f"and {len(parts) - MAX_CAMERAS_SHOWN} cameras more that help less; --json lists them all\n")


def _as_json(design: Design) -> dict[str, Any]:
    found = design.prediction
    table: dict[str, Any] = {
        "name": design.name,
        "cameras": len(found.rig.cameras),
        "not_calibrated": list(found.uncalibrated),
        "length_unit": found.rig.length_unit,
        "known_points": len(found.known),
        "assumed": asdict(found.assumed),
        "places": len(found.places),
        "blind_share": found.blind,
        "spreads": [asdict(spread) for spread in design.spreads],
        "each_camera": [asdict(part) for part in design.parts],
    }
    if design.realised is not None:
        (error, error_sd), (stated, stated_sd) = design.realised.error_ratio, design.realised.stated_ratio
        table["check"] = {
            "rigs": len(design.realised.errors),
            "failed": list(design.realised.failed),
            "axes": [{"axis": axis, "predicted": p, "error": e, "stated": s} for axis, p, e, s in design.check_rows()],
            "error_over_predicted": [error, error_sd],
            "stated_over_predicted": [stated, stated_sd],
        }
    return table
