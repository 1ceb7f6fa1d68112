"""`implicam detect`: the options of every detector, and what was found."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated, Any

import typer

from implicam.cli import show
from implicam.cli.app import Json, Pattern, Pictures, command, command_line
from implicam.cli.options import OptionsOfParts
from implicam.detect import TARGETS, DetectionRun, call, detector_from_options, options_of
from implicam.detect.call import must_be_dataset_folder
from implicam.detect.folder import DETECTIONS
from implicam.logs import LOG, log_to_file


def _options() -> dict[str, dict[str, inspect.Parameter]]:
    return {target: options_of(target) for target in TARGETS}


def _detect(
    dataset: Annotated[Path, typer.Argument(help="A folder with images/<camera>/<shot>.png, or films <camera>.mp4.")],
    target: Annotated[
        str | None, typer.Option(metavar="NAME", help=f"{', '.join(TARGETS)} (default: what dataset.toml says).")
    ] = None,
    pictures: Pictures = None,
    pattern: Pattern = None,
    films: Annotated[
        str | None,
        typer.Option(
            "--films", metavar="FOLDER", help="Where <camera>.mp4 are in DATASET (default: films, or itself)."
        ),
    ] = None,
    times: Annotated[
        Path | None,
        typer.Option("--times", metavar="FILE", help="Of films: a table camera,frame,time_s, by one clock."),
    ] = None,
    offsets: Annotated[
        str | None,
        typer.Option(
            "--offsets",
            metavar="LIST",
            help="Of films: seconds to add, cam2=0.0374,...; 0 for none (default: found from the target's movement).",
        ),
    ] = None,
    every: Annotated[int, typer.Option("--every", min=1, metavar="N", help="Of films: search every Nth picture.")] = 1,
    frames: Annotated[
        int | None, typer.Option("--frames", min=1, metavar="N", help="Of films: keep N instants that differ most.")
    ] = None,
    overlays: Annotated[bool, typer.Option(help="Draw what was found, to check by eye.")] = True,
    restart: Annotated[bool, typer.Option("--restart", help="Forget what an earlier run found.")] = False,
    unit: Annotated[
        str | None, typer.Option(metavar="UNIT", help="Length unit, where dataset.toml is missing.")
    ] = None,
    json: Json = False,
    **options: Any,
) -> None:
    """Find the target in photographs or films: images -> observations.csv, each view with its uncertainty."""
    must_be_dataset_folder(dataset)
    detector = detector_from_options(target, dataset, **options)  # before a log is written there
    with log_to_file(dataset / DETECTIONS / LOG, command_line()), show.progress(json) as progress:
        run = call.detect(
            dataset, detector, unit=unit, pictures=pictures, pattern=pattern, films=films, times=times, offsets=offsets,
            every=every, frames=frames, overlays=overlays, restart=restart, progress=progress,
        )  # fmt: skip
    _print_result(run, json)


detect_command = command("detect")(OptionsOfParts(_detect, "target", _options))


def _print_result(run: DetectionRun, json: bool) -> None:
    """What was found, where, and why not."""
    if json:
        show.emit_json(
            {"observations": str(run.observations), "summary": str(run.summary),
             "cameras": [count._asdict() for count in run.cameras], "reasons": [list(pair) for pair in run.reasons],
             "notes": list(run.notes), "resumed": run.resumed, "seconds_per_picture": run.seconds_per_picture,
             "sheets": [str(path) for path in run.sheets]}
        )  # fmt: skip
        return
    points = int(run.data.observations.seen.sum())
    show.table(show.detection_table(run))
    show.line(f"{run.observations}: {points} views of {len(run.data)} points in {len(run.cameras)} cameras")
    if run.sheets:
        show.line(f"look at {run.sheets[0]}{f' and {len(run.sheets) - 1} more' if len(run.sheets) > 1 else ''}")
    noted = "\n".join(run.notes)  # these name their files, and say the reason too
    show.notes([f"{times} picture{'s' * (times != 1)}: {why}" for why, times in run.reasons if why not in noted])
    for text in run.notes:
        show.note(text)
