"""`implicam shoot`: pictures of all cameras at once, into a dataset folder."""

from __future__ import annotations

import itertools
import re
import sys
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from implicam.cli import show
from implicam.cli.app import Json, command, must_be_folder
from implicam.cli.options import OptionsOfParts, options_of_setup
from implicam.errors import UsageError
from implicam.images import opencv

if TYPE_CHECKING:
    from implicam.session.shots import Taken

MAX_MISSED = 3
"""Sets in a row that may fail before it is given up, where it goes on by itself."""

SECONDS_PER = {"": 1.0, "s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}


def _shoot(
    folder: Annotated[
        Path | None, typer.Argument(help="A new folder, or one to go on with.", show_default=False)
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="FOLDER", help="The same.")] = None,
    every: Annotated[str | None, typer.Option("--every", metavar="TIME", help="A set every 2s, 500ms, 1min.")] = None,
    on_key: Annotated[bool, typer.Option("--on-key", help="A set at each Enter; q and Enter ends.")] = False,
    on_trigger: Annotated[
        bool, typer.Option("--on-trigger", help="A set at each pulse of a trigger that another fires.")
    ] = False,
    count: Annotated[
        int | None, typer.Option("--count", min=1, metavar="N", help="How many sets (default: one now, else no end).")
    ] = None,
    json: Json = False,
    **options: Any,
) -> None:
    """Take pictures with all cameras at once, into a dataset folder that `detect` reads.

    Now, at each Enter, at each pulse, or every so often; run it again and the numbers go on.
    A set is whole or not kept. Without cameras it shows a simulated rig whose ball moves.
    """
    from implicam.session.setup import Setup, with_options
    from implicam.session.shots import ShotFolder, shutter_of, take_sets

    if (folder is None) == (output is None):
        raise UsageError("where the pictures go is not said.", fix="name one folder: implicam shoot my-photos")
    place = folder or output
    assert place is not None
    must_be_folder(place)
    setup = with_options(Setup(), **options)
    _check_when(every, on_key, on_trigger, bool(setup.trigger))
    seconds = None if every is None else _seconds(every)
    opencv()
    shutter, before = shutter_of(setup, waits=on_trigger)
    say = partial(_say, json)
    shots: list[str] = []

    def tell(taken: Taken) -> None:
        shots.append(taken.shot)
        if not json:
            show.line(str(taken))

    endless = on_key or on_trigger or every is not None
    count = count if endless or count is not None else 1
    with ShotFolder(place, shutter.cameras, options["unit"], say) as kept:
        try:
            with shutter.opened():
                kept.tell()
                say(_invite(seconds, on_key, on_trigger))
                take_sets(
                    shutter,
                    kept,
                    _due(seconds, on_key, count, say),
                    before=before,
                    kept=tell,
                    missed=lambda error: show.note(f"not kept: {error.what} {error.why}"),
                    most_missed=MAX_MISSED if endless else 1,
                )
        except KeyboardInterrupt:
            say(f"ended; {_told(len(shots))} in {place}")
            if not endless:
                raise typer.Exit(130) from None
    if json:
        show.emit_json({"dataset": str(place), "shots": shots, "cameras": [camera.name for camera in kept.cameras]})
        return
    show.line(f"{place}: {_told(len(shots))} of {len(kept.cameras)} cameras")


_options = partial(options_of_setup, "cameras", "trigger", "unit", "rig", "rig_cameras", "seed")
shoot_command = command("shoot")(OptionsOfParts(_shoot, "count", _options))


def _say(json: bool, text: str) -> None:
    if text and not json:
        show.say(text)


def _told(sets: int) -> str:
    return f"{sets} set{'s' * (sets != 1)}"


def _check_when(every: str | None, on_key: bool, on_trigger: bool, trigger: bool) -> None:
    given = [name for name, on in (("--every", every), ("--on-key", on_key), ("--on-trigger", on_trigger)) if on]
    if len(given) > 1:
        raise UsageError(f"{' and '.join(given)} exclude each other.", fix="give one of them")
    if on_trigger and trigger:
        raise UsageError(
            "--on-trigger and --trigger exclude each other.",
            why="--trigger is a box that this command fires; --on-trigger waits for one that another fires",
            fix="leave one out; with a box of ours, --every 2s or --on-key say when it fires",
        )


def _seconds(text: str) -> float:
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(ms|s|min|h|)\s*", text)
    if match is None or float(match[1]) == 0:
        raise UsageError(f"--every {text!r} is no time.", fix="write 2s, 500ms or 1min")
    return float(match[1]) * SECONDS_PER[match[2]]


def _invite(seconds: float | None, on_key: bool, on_trigger: bool) -> str:
    if on_key:
        return "Enter takes a set, q and Enter ends"
    if on_trigger:
        return "waiting for the trigger; Ctrl-C ends"
    return "" if seconds is None else f"a set every {seconds:g} s; Ctrl-C ends"


def _due(seconds: float | None, on_key: bool, count: int | None, say: Any) -> Iterable[object]:
    """Gives something whenever a set is to be taken."""
    from implicam.session.shots import every

    if seconds is not None:
        return every(seconds, say, count)
    if on_key:
        return itertools.islice(_keys(), count)
    return itertools.count() if count is None else range(count)


def _keys() -> Iterator[str]:
    """A line for each Enter, until q or the end of the input."""
    for line in sys.stdin:
        if line.strip().casefold() in ("q", "quit"):
            return
        yield line
