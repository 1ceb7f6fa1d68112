"""`implicam label`: name six dots in the pictures of each camera, in the browser."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from implicam.cli import show
from implicam.cli.app import Browser, Json, Pattern, Pictures, Port, Token, command
from implicam.detect.labelling import Labelling
from implicam.detect.labels import LABELS_FILE, MIN_LABELS


@command("label")
def label_command(
    dataset: Annotated[Path, typer.Argument(help="A folder with the photographs in images/<camera>/<shot>.png.")],
    layout: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where the dots are (default DATASET/points.csv).")
    ] = None,
    labels: Annotated[
        Path | None, typer.Option(metavar="FILE", help=f"What is written (default DATASET/{LABELS_FILE}).")
    ] = None,
    pictures: Pictures = None,
    pattern: Pattern = None,
    port: Port = 8091,
    token: Token = None,
    browser: Browser = True,
    json: Json = False,
) -> None:
    """Click six dots of a known target in each camera's picture; detect --target dots finds the others.

    The page is for this machine only. Every label is saved at once; run it again to go on.
    """
    from implicam.viewer.label_page import serve

    labelling = Labelling.open(dataset, layout=layout, labels=labels, pictures=pictures, pattern=pattern)
    then = _next_command(dataset, layout=layout, labels=labels, pictures=pictures, pattern=pattern)
    for text in labelling.notes:
        show.note(text)
    try:
        serve(labelling, then, port=port, token=token, open_browser=browser, say=show.say)
    except KeyboardInterrupt:
        show.say(f"ended; every label is in {labelling.path}")
    counts = {view: len(labelling.marks(view)) for view in labelling.pictures}
    if json:
        rows = [{"camera": view.camera, "shot": view.shot, "labels": count} for view, count in counts.items()]
        show.emit_json({"labels": str(labelling.path), "needed": MIN_LABELS, "pictures": rows, "then": then})
        return
    for view, count in counts.items():
        lacking = f", {MIN_LABELS - count} more needed" if count < MIN_LABELS else ""
        show.line(f"{' '.join(filter(None, view))}: {count} label{'s' * (count != 1)}{lacking}")
    show.line(f"next: {then}")


def _next_command(dataset: Path, **options: Path | str | None) -> str:
    given = [word for name, value in options.items() if value is not None for word in (f"--{name}", str(value))]
    return shlex.join(["implicam", "detect", str(dataset), "--target", "dots", *given])
