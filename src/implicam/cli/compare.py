"""`implicam compare`: which methods on which splits, a table and a figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from implicam.calibrators import calibrator_from_name
from implicam.cli import show
from implicam.cli.app import Cameras, Json, LeaveOut, Scheduler, Without, check_figure, command, must_be_shot, read
from implicam.cli.compare_table import compare_failures, compare_table
from implicam.cli.options import with_table_options
from implicam.compare import (
    Split,
    Trial,
    as_json,
    available_methods,
    compare_on,
    plane_splits,
    random_splits,
    shot_splits,
    summarise,
    usual_sizes,
)
from implicam.dataset import Dataset, TableOptions
from implicam.dataset.table_options import DOCUMENTED
from implicam.dataset.wand import FRAME, MARKER, wand_of
from implicam.errors import UsageError


@command("compare")
@with_table_options
def compare_command(
    dataset: Annotated[Path, typer.Argument(help="Known points.")],
    methods: Annotated[
        str | None,
        typer.Option(
            "--methods", metavar="LIST", help="Separated by commas; a variant follows a colon (default: all)."
        ),
    ] = None,
    train: Annotated[
        str | None, typer.Option("--train", metavar="LIST", help="Numbers of known points, such as 17,35,87.")
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            "--seeds", min=1, metavar="N", help="Random splits (default 5); at most so many shots, planes (all)."
        ),
    ] = None,
    check: Annotated[Path | None, typer.Option("--check", help="Judge on this dataset of the same rig.")] = None,
    leave_out: LeaveOut = None,
    lattice: Annotated[bool, typer.Option("--lattice", help="Hold each inner plane of a lattice out, too.")] = False,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Figure to write (.png, .pdf or .svg).")] = None,
    cameras: Cameras = None,
    without: Without = None,
    scheduler: Scheduler = None,
    table: TableOptions = DOCUMENTED,
    json: Json = False,
) -> None:
    """All methods on the same splits: one table, one figure, error bars over the splits."""
    if output is not None:
        check_figure(output)
    data = read(dataset, table, cameras, without)
    check_data = None if check is None else read(check, table, cameras, without)
    splits = _splits(data, train, seeds, check_data, leave_out, lattice)
    names = [name.strip() for name in methods.split(",")] if methods else _available_methods()
    chosen = {name: calibrator_from_name(name) for name in names}
    with show.progress(json) as progress:
        trials = compare_on(splits, chosen, progress, scheduler)
    if output is not None:
        _write_figure(trials, data.length_unit, output)
    if json:
        show.emit_json({"length_unit": data.length_unit, **as_json(trials), "figure": output and str(output)})
        return
    rows = summarise(trials)
    show.table(compare_table(rows, data.length_unit))
    limited = any(math.isfinite(row.mean["rmse_over_limit"]) for row in rows)
    show.explain("rmse", *["limit"] * limited, "NEES")
    if output is not None:
        show.line(f"figure: {output}")
    show.notes(compare_failures(trials))


def _available_methods() -> list[str]:
    """All methods and the variants worth showing, as far as their libraries are installed."""
    available, missing = available_methods()
    for name, extra in missing:
        show.note(f'left out {name}: pip install "implicam[{extra}]" to add it')
    return available


def _splits(
    data: Dataset, train: str | None, seeds: int | None, check: Dataset | None, leave_out: str | None, lattice: bool
) -> list[Split]:
    must_be_shot(leave_out)
    if data.known is None and (wand_of(data) is not None or {FRAME, MARKER} <= data.further_columns().keys()):
        raise UsageError(
            f"dataset {data.name!r} is of a wand, and compare needs known points.",
            why="points are held out and compared with where they are known to be; of a wand nothing is known but its "
            "length, and one method uses it",
            fix="calibrate it, and judge it by lengths (implicam verify) or known points (implicam evaluate)",
        )
    if (check is not None) + (leave_out is not None) + lattice > 1:
        raise UsageError("--check, --leave-out and --lattice exclude each other.", fix="give one of them")
    if leave_out is not None:
        return shot_splits(data, _sizes(train, len(data)) if train else None, most=seeds)
    draws = seeds or 5
    if not lattice:
        return random_splits(data, _sizes(train, len(data)), seeds=draws, check=check)
    fewest = min(len(split.train) for split in plane_splits(data))
    sizes = _sizes(train, len(data)) if train else [min(fewest, round(len(data) / 2), MOST_ON_LATTICE)]
    return random_splits(data, sizes, seeds=draws) + plane_splits(data, sizes, most=seeds)


MOST_ON_LATTICE = 200
"""Points to train on with --lattice, unless --train says more: every plane costs a fit of every method."""


def _sizes(text: str | None, n: int) -> list[int]:
    if text is None:
        return usual_sizes(n)
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise UsageError(f"--train {text!r} is not a list of numbers.", fix="write for example 17,35,87") from None


def _write_figure(trials: Sequence[Trial], unit: str, path: Path) -> None:
    from implicam.figures import compare_figure
    from implicam.figures.printed import save_figure

    save_figure(compare_figure([asdict(trial) for trial in trials], unit=unit), path)
