"""`implicam board print`: a board to print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from implicam.cli import show
from implicam.cli.app import Json, check_figure, command
from implicam.dataset.boards import BOARD_KINDS
from implicam.detect import ALSO_CALLED, TARGETS, options_of
from implicam.errors import UsageError, did_you_mean

ACTIONS = ("print",)


@command("board")
def board_command(
    action: Annotated[str, typer.Argument(metavar="print", help="What to do.")],
    target: Annotated[str, typer.Option(metavar="NAME", help=f"{', '.join(BOARD_KINDS)}.")] = "board",
    board: Annotated[
        str | None, typer.Option(metavar="RxC", help="Inner corners of a checkerboard, squares, tags or dots: 8x11.")
    ] = None,
    square: Annotated[float | None, typer.Option(metavar="MM", min=0, help="Edge of a square.")] = None,
    marker: Annotated[float | None, typer.Option(metavar="MM", min=0, help="charuco: edge of a marker.")] = None,
    tag: Annotated[float | None, typer.Option(metavar="MM", min=0, help="aprilgrid: edge of a tag.")] = None,
    spacing: Annotated[
        float | None,
        typer.Option(
            metavar="MM", min=0, help="aprilgrid: between two tags (default 0.3 of a tag); dotgrid: from row to row."
        ),
    ] = None,
    dictionary: Annotated[
        str | None, typer.Option(metavar="NAME", help="charuco, aprilgrid: OpenCV's name of the markers.")
    ] = None,
    paper: Annotated[str, typer.Option(metavar="NAME", help="a4, a3, a2, a1, a0, letter, tabloid.")] = "a4",
    output: Annotated[Path, typer.Option("-o", "--output", help="A .pdf, .svg or .png.")] = Path("board.pdf"),
    json: Json = False,
) -> None:
    """Make a board to print in true size, with bars to check the printer."""
    if action not in ACTIONS:
        raise UsageError(f"board {action!r} is not known{did_you_mean(action, ACTIONS)}.", fix="implicam board print")
    target = ALSO_CALLED.get(target, target)
    if target not in BOARD_KINDS:
        raise UsageError(f"{target!r} is no board{did_you_mean(target, BOARD_KINDS)}.", fix=f"use {list(BOARD_KINDS)}")
    check_figure(output)
    from implicam.figures.board_sheet import draw_board  # late: it imports matplotlib

    given: dict[str, Any] = {
        "board": board, "square": square, "marker": marker, "tag": tag, "spacing": spacing, "dictionary": dictionary,
    }  # fmt: skip
    given = {name: value for name, value in given.items() if value is not None}
    for name in given:
        if name not in options_of(target):
            raise UsageError(f"a board of the kind {target!r} has no --{name}.", fix="leave it out")
    across, along = draw_board(TARGETS[target].from_options(Path(), {}, **given), paper, output)
    if json:
        show.emit_json({"board": str(output), "bars_mm": [across, along]})
        return
    show.line(f"{output}: print it in true size (100 %), then measure the bars of {across:g} and {along:g} mm")
    show.note("glue it to something flat: glass, aluminium, a wooden board; a board that bends bends the calibration.")
