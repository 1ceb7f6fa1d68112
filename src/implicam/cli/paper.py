"""implicam paper: the paper's experiments, computed, drawn and written down."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from implicam.cli import show
from implicam.cli.app import Json, Scheduler, Seed, command, command_line, must_be_folder
from implicam.errors import UsageError
from implicam.formatting import decimal_number
from implicam.logs import LOG, log_to_file


class Experiment(StrEnum):
    """The paper's three."""

    ball = "ball"
    active = "active"
    board = "board"
    all = "all"


@command("paper")
def paper_command(
    experiment: Annotated[Experiment, typer.Argument(help="The ball in a grid, active learning, the moving board.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for results and figures.")] = Path(
        "implicam-paper"
    ),
    data: Annotated[
        Path | None, typer.Option("--data", metavar="DIR", help="Measured data instead of the simulated rig.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A taste in a few minutes.")] = False,
    runs: Annotated[
        int | None, typer.Option("--runs", min=2, metavar="N", help="So many runs of every method on each rig.")
    ] = None,
    rigs: Annotated[
        int | None,
        typer.Option("--rigs", min=1, max=100, metavar="N", help="So many simulated rigs (5; with --quick 1)."),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", min=1, metavar="N", help="Processes (default: one a core).")
    ] = None,
    scheduler: Scheduler = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Reproduce the paper: its tables and figures beside ours. Interrupted, it goes on where it stopped."""
    from implicam.experiments.plan import FULL, QUICK, RIGS
    from implicam.experiments.reproduction import EXPERIMENTS, reproduce
    from implicam.experiments.source import Source

    must_be_folder(output)
    if data is not None and not data.is_dir():
        raise UsageError(
            f"{data} is not a folder.", fix="give the folder of the measured data, as docs/paper.md describes it"
        )
    plan = QUICK if quick else FULL
    chosen = EXPERIMENTS if experiment is Experiment.all else (experiment.value,)
    if data is not None and rigs is not None:
        raise UsageError("measured data are of one rig.", fix="leave out --rigs, or --data")
    count = rigs or (1 if quick or data is not None else RIGS)
    sources = [Source.of(data, seed + i) for i in range(count)]
    plan = plan.with_runs(runs) if runs is not None else plan.shared_by(count)
    if count > 1 and not json:
        show.say(f"{count} rigs, one after another, each about as long. --rigs 1 gives the first alone all runs.")
    try:
        with log_to_file(output / LOG, command_line()), show.progress(json) as progress:
            made = reproduce(chosen, output, sources, plan, jobs=jobs, scheduler=scheduler, progress=progress)
    except KeyboardInterrupt:
        show.say(f"interrupted; what was done is kept in {output / 'cells'}: the same command goes on from there")
        raise typer.Exit(130) from None
    files = {key: str(path) for key, path in made.files.items()}
    if json:
        show.emit_json({**made.summary, **files, "failures": dict(made.failures), "notes": list(made.notes)})
        return
    for table in _tables(made.summary):
        show.table(table)
    for key, path in files.items():
        show.line(f"  {key:<10}{path}")
    show.notes([*made.failures.values(), *made.notes])


def _tables(summary: Mapping[str, Any]) -> list[Table]:
    """What fits a terminal; the account has the rest."""
    tables = [_findings(summary["verdicts"])] if summary["verdicts"] else []
    if summary.get("ball"):
        tables.append(_ball(summary["ball"]))
    if summary.get("active"):
        tables.append(_active(summary["active"]))
    if summary.get("published"):
        tables.append(_published(summary["published"]))
    tables.append(_times(summary))
    return tables


def _findings(verdicts: Sequence[Mapping[str, Any]]) -> Table:
    """How many of the findings hold; which ones and why is in the account."""
    from implicam.experiments.evidence import FAILS, HOLDS, OPEN
    from implicam.experiments.plan import GP, PAPER

    rows = []
    for experiment in dict.fromkeys(verdict["experiment"] for verdict in verdicts):
        for method in (PAPER, GP):
            mine = [v["verdict"] for v in verdicts if v["experiment"] == experiment and v["method"] == method]
            rows.append([experiment, method, *(str(mine.count(verdict)) for verdict in (HOLDS, FAILS, OPEN))])
    title = "The paper's findings, each for each set of cameras it speaks of"
    return show.text_table(title, ["", "Gaussian process", "hold", "do not", "not decided"], rows, left=2)


def _ball(table: Sequence[Mapping[str, Any]]) -> Table:
    """At positions off the lattice where there are such; the fewest, a middling and the most points."""
    from implicam.experiments.plan import LEARNERS
    from implicam.experiments.source import BALL, CHECK

    rows = [row for row in table if row.get("trained") == BALL]
    judged = CHECK if any(row["judged"] == CHECK for row in rows) else BALL
    rows = [row for row in rows if row["judged"] == judged]
    known = sorted({row["known"] for row in rows})
    cells = [
        [cameras, str(n), *(_median(rows, set=cameras, known=n, method=method) for method in LEARNERS)]
        for cameras in dict.fromkeys(row["set"] for row in rows)
        for n in sorted({known[0], known[len(known) // 2], known[-1]})
    ]
    where = "random positions" if judged == CHECK else "the positions left out"
    return show.text_table(
        f"Ball: rms error at {where}, median of the runs, mm", ["cameras", "points", *LEARNERS], cells
    )


def _median(rows: Sequence[Mapping[str, Any]], **wanted: Any) -> str:
    found = [row["rmse"][1] for row in rows if all(row[key] == value for key, value in wanted.items())]
    return decimal_number(found[0]) if found else "-"


def _active(table: Sequence[Mapping[str, Any]]) -> Table:
    """At the start, after some points and at the end: what is stated, and what errors are."""
    keys = ("mean_sd", "max_sd", "rmse")
    rows = [
        [row["set"], row["method"], str(row["known"]), *(decimal_number(row[key][1]) for key in keys)] for row in table
    ]
    heads = ["cameras", "method", "points", "mean sd", "largest sd", "rms error"]
    title = "Active learning: at the positions that are left, median of the starts, mm"
    return show.text_table(title, heads, rows, left=2)


def _published(table: Sequence[Mapping[str, Any]]) -> Table:
    """The paper's Table 1 beside ours: mean error and stated standard deviation."""
    from implicam.experiments.plan import FORWARD, GP, PAPER

    rows = [
        [row["set"], str(row["boards"]), decimal_number(row["paper_gp_rmse"][0]), _mean(row, PAPER, "rmse"),
         decimal_number(row["paper_gp_sd"][0]), _mean(row, PAPER, "sd"), _mean(row, GP, "rmse"),
         _mean(row, FORWARD, "rmse")]
        for row in table
    ]  # fmt: skip
    heads = ["cameras", "boards", "error,\npublished", f"\n{PAPER}", "sd,\npublished", f"\n{PAPER}", f"\n{GP}",
             f"\n{FORWARD}"]  # fmt: skip
    return show.text_table("Board: the paper's Table 1 and ours, mm", heads, rows)


def _mean(row: Mapping[str, Any], method: str, key: str) -> str:
    return decimal_number(row[method][key][0]) if method in row else "-"


def _times(summary: Mapping[str, Any]) -> Table:
    parts = summary["parts"]
    rows = [[name, str(part["cells"]), f"{part['seconds']:.0f}"] for name, part in parts.items()]
    rows.append(["all", str(summary["cells"]["all"]), f"{sum(part['seconds'] for part in parts.values()):.0f}"])
    already = summary["cells"]["already"]
    title = f"Time: {summary['wall_seconds']:.0f} s" + f", {already} cells were there before" * bool(already)
    return show.text_table(title, ["part", "cells", "seconds of work"], rows)
