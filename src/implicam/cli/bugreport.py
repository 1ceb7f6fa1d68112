"""`implicam bugreport`: what helps to find a mistake, packed into a zip."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from implicam.cli import show
from implicam.cli.app import Json, command
from implicam.errors import UsageError


@command("bugreport")
def bugreport_command(
    folder: Annotated[Path, typer.Argument(help="A session, or another folder that implicam wrote.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="A .zip (default FOLDER-bugreport.zip).")
    ] = None,
    json: Json = False,
) -> None:
    """Pack versions, settings, log and tables of a folder, to send with a question; no pictures, no passwords."""
    from implicam.session.bugreport import write_bugreport

    file = Path(f"{folder.resolve().name}-bugreport.zip") if output is None else output
    if file.suffix.lower() != ".zip":
        raise UsageError(f"{file} is no name for a zip.", fix=f"-o {file.stem}.zip")
    packed = write_bugreport(folder, file)
    if json:
        sizes = {name: len(content) for name, content in packed.members.items()}
        show.emit_json({"bugreport": str(file), "packed": sizes, "left_out": packed.left_out})
        return
    show.line(f"{file}:")
    for name, content in sorted(packed.members.items()):
        show.line(f"  {name:<18} {len(content):>10,} bytes")
    for text in packed.left_out:
        show.note(f"left out: {text}")
    show.note(
        "packed without pictures, and without passwords and user names of addresses; positions, pixels and names of "
        "files are in it. Look into it before you send it."
    )
