"""What the commands print: tables, progress, JSON, errors. Numbers go to stdout, talk goes to stderr."""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars
from rich.table import Table

from implicam.compare import Row
from implicam.coverage import Estimate, Summary
from implicam.demo import HELD_OUT, Demo
from implicam.evaluate import Evaluation
from implicam.measurement import Measurement
from implicam.progress import Progress, silent

err = Console(stderr=True, highlight=False)


def out() -> Console:
    """The console of results; made anew so that it follows a redirected stdout."""
    return Console(highlight=False, soft_wrap=False)


@contextmanager
def progress(quiet: bool = False) -> Iterator[Progress]:
    """A progress bar on stderr with the time left; nothing where nobody watches."""
    if quiet or not err.is_terminal:
        yield silent
        return
    times = (TimeElapsedColumn(), TimeRemainingColumn())
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *times)
    with Bars(*columns, console=err, transient=True) as bars:
        tasks: dict[str, Any] = {}

        def step(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(escape(what), total=total)
            bars.update(tasks[what], completed=done, total=total)

        yield step


def emit_json(value: Any) -> None:
    """Print JSON; numbers that do not exist are null."""
    sys.stdout.write(json.dumps(_plain(value), indent=2, ensure_ascii=False) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def say(text: str) -> None:
    """A line of talk on stderr."""
    err.print(escape(text), soft_wrap=True)


def error_lines(text: str) -> None:
    """The three parts of an error."""
    head, *rest = text.splitlines()
    err.print(f"[bold red]error:[/] {escape(head)}", soft_wrap=True)
    for line in rest:
        say(line)


def note(text: str) -> None:
    """Something that the user should know before trusting a number."""
    err.print(f"[bold yellow]note:[/] {escape(text)}", soft_wrap=True)


def number(value: float, digits: int = 3) -> str:
    """A number with so many significant digits, never in powers of ten where people would not write them."""
    if not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(decimals, 9)}f}"


def percent(share: Estimate) -> str:
    """A share with its 95 % interval."""
    if not math.isfinite(share.value):
        return "-"
    return f"{100 * share.value:.1f} [{100 * share.low:.1f}, {100 * share.high:.1f}]"


def reasons(measurement: Measurement) -> list[str]:
    """How many points could not be measured, and why, the commonest reason first."""
    counts = Counter(str(reason) for reason in measurement.reason[~measurement.measured])
    return [f"{count} not measured: {reason}" for reason, count in counts.most_common()]


def evaluation_tables(evaluation: Evaluation) -> list[Table]:
    """Accuracy by region, and coverage by level."""
    unit = evaluation.data.length_unit
    rows = evaluation.coverage.rows
    accuracy = Table(title=f"Errors ({unit}), against {evaluation.against}", title_justify="left", show_lines=False)
    limited = any(math.isfinite(row.rmse_over_limit) for row in rows)
    headings = ["points", "n", "rmse x", "y", "z", "rmse 3D", "median", "stated", *(["rmse/limit"] if limited else []),
                "NEES (3)", "NLL", "CRPS"]  # fmt: skip
    for i, heading in enumerate(headings):
        accuracy.add_column(heading, justify="left" if i == 0 else "right", no_wrap=True)
    for row in rows:
        accuracy.add_row(*_accuracy_cells(row, limited))
    return [accuracy, _coverage_table(rows)]


def _accuracy_cells(row: Summary, limited: bool) -> list[str]:
    axes = [number(value) for value in row.rmse_axes]
    limit = [number(row.rmse_over_limit)] if limited else []
    return [row.region, str(row.n), *axes, number(row.rmse), number(row.median_error), number(row.stated_rms), *limit,
            number(row.nees.value), number(row.nll), number(row.crps)]  # fmt: skip


def _coverage_table(rows: Sequence[Summary]) -> Table:
    table = Table(title="Coverage in % [95 % interval]", title_justify="left")
    table.add_column("points", no_wrap=True)
    for nominal in (50, 68, 90, 95, 99):
        table.add_column(f"{nominal} %", justify="right", no_wrap=True)
    for row in rows[:1]:
        table.add_row("per axis", *(percent(level.pooled) for level in row.levels))
        table.add_row("3D ellipsoid", *(percent(level.ellipsoid) for level in row.levels))
        for i, axis in enumerate("xyz"):
            table.add_row(f"{axis} alone", *(percent(level.axes[i]) for level in row.levels))
    for row in rows[1:]:
        table.add_row(f"3D, {row.region}", *(percent(level.ellipsoid) for level in row.levels))
    return table


def demo_table(demo: Demo) -> Table:
    """Cameras and known points down, accuracy and honesty across."""
    title = f"A simulated rig, judged at {HELD_OUT} random positions it has not seen"
    table = Table(title=title, title_justify="left")
    for heading in ("cameras", "method", "known points", f"rmse {demo.unit}", "rmse / limit", "95 % coverage"):
        table.add_column(heading, justify="left" if heading in ("cameras", "method") else "right")
    for row in demo.rows:
        t = row.trial
        cells = (number(t.rmse), number(t.rmse / t.limit), f"{100 * t.coverage_95:.1f} %")
        table.add_row(row.cameras, t.method, str(t.known), *cells, end_section=t.known == demo.rows[-1].trial.known)
    return table


def compare_table(rows: Sequence[Row], unit: str) -> Table:
    """Methods by number of known points: mean ± standard error over the seeds."""
    table = Table(title=f"Means ± standard error over seeds; lengths in {unit}", title_justify="left")
    limited = any(math.isfinite(row.mean["rmse_over_limit"]) for row in rows)
    columns = [("rmse", "rmse 3D"), ("median", "median")]
    columns += [("rmse_over_limit", "rmse/limit")] if limited else []
    columns += [("coverage_95", "95 % per axis"), ("ellipsoid_95", "95 % ellipsoid"), ("nees", "NEES (3)")]
    columns += [("fit_seconds", "fit, s")]
    for heading in ("method", "known points", "seeds", *(heading for _, heading in columns)):
        table.add_column(heading, justify="left" if heading == "method" else "right", no_wrap=True)
    for row in rows:
        cells = [_plus_minus(row.mean[key], row.standard_error[key]) for key, _ in columns]
        table.add_row(row.method, str(row.known), str(row.seeds), *(cells if row.seeds else ["-"] * len(columns)))
    return table


def _plus_minus(mean: float, error: float) -> str:
    if not math.isfinite(mean):
        return "-"
    return number(mean) + (f" ± {number(error, 1)}" if math.isfinite(error) else "")
