"""Run the paper's experiments: compute what is missing, put it into tables, judge the findings, draw, write it down."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from implicam.errors import DatasetError, ImplicamError, import_extra
from implicam.experiments import active, ball, board, tables
from implicam.experiments.account import markdown
from implicam.experiments.cells import Cell, Results, load_results, run
from implicam.experiments.evidence import Row
from implicam.experiments.findings import verdicts
from implicam.experiments.pictures import draw
from implicam.experiments.plan import Plan
from implicam.experiments.source import Source
from implicam.experiments.stored import Values
from implicam.files import write_text
from implicam.formatting import json_safe
from implicam.progress import Progress, silent

EXPERIMENTS = (ball.NAME, active.NAME, board.NAME)
_CELLS: dict[str, Callable[[Source, Plan], list[Cell]]] = {
    ball.NAME: ball.cells,
    active.NAME: active.cells,
    board.NAME: board.cells,
}
EXTRA_OF_LIBRARY = {
    "torch": "paper",
    "gpytorch": "paper",
    "joblib": "paper",
    "matplotlib": "report",
    "plotly": "report",
    "jinja2": "report",
}
"""Library -> the extra that brings it."""


@dataclass(frozen=True)
class Reproduction:
    """What a run of the experiments made.

    Attributes:
        summary: All tables and verdicts as plain values.
        files: What was written, by what it is.
        failures: Cells without a result, and why.
        notes: What should be known before the numbers are trusted.
    """

    summary: Mapping[str, Any]
    files: Mapping[str, Path]
    failures: Mapping[str, str]
    notes: tuple[str, ...]


def reproduce(
    experiments: Sequence[str],
    folder: Path,
    sources: Source | Sequence[Source],
    plan: Plan,
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: Progress = silent,
) -> Reproduction:
    """Run some experiments; what was computed before, by the same plan on the same data, is kept.

    The account is of all experiments that have been computed whole, this time or before. Figures in 3D and of single
    boards are those of the first rig; tables, curves and verdicts are of all.

    Args:
        experiments: Some of `EXPERIMENTS`.
        folder: Where results are kept and written.
        sources: The data; several simulated rigs, or one.
        plan: How much is computed.
        jobs: Processes on this machine; None for one a core.
        scheduler: The address of a Dask scheduler whose workers compute instead.
        progress: Called as the work goes on.

    Raises:
        DatasetError: The data have nothing for any of the experiments.
        MissingExtraError: A library is not installed.
        ImplicamError: Every cell failed.
    """
    for library, extra in EXTRA_OF_LIBRARY.items():
        if find_spec(library) is None:  # said before the work, not after; importing them all takes seconds
            import_extra(library, extra, "the paper's experiments")
    start = time.perf_counter()
    rigs = [sources] if isinstance(sources, Source) else list(sources)
    first = rigs[0]
    absent = [name for name in experiments if not _CELLS[name](first, plan)]
    if len(absent) == len(experiments):
        raise DatasetError(
            f"{first.folder} has no data for {', '.join(absent)}.",
            fix="it needs the folder ball (or a dataset itself) for ball and active, board for board",
        )
    done = [
        _compute(experiments, folder, source, plan, _tell_rig(progress, i, len(rigs)), jobs=jobs, scheduler=scheduler)
        for i, source in enumerate(rigs)
    ]
    progress("tables and figures", 0, 1)
    names = [name for name in EXPERIMENTS if all(name in rig.cells for rig in done)]
    rows = {name: [row for rig in done for row in rig.rows(name)] for name in names}
    values = done[0].values
    everything, failures = sum(rig.count for rig in done), {k: v for rig in done for k, v in rig.failures.items()}
    already = sum(rig.already for rig in done)
    for name, table in rows.items():
        if table:
            write_text(folder / f"{name}.csv", _csv(table))
    if rows.get(board.NAME):
        write_text(folder / "board-by-board.csv", _csv(tables.by_board(rows[board.NAME])))
    figures = dict(draw(rows, values, folder / "figures"))
    summary = {
        "source": {**first.options, "sets": {name: list(cameras) for name, cameras in first.sets.items()}},
        "rigs": [rig.source.seed for rig in done],
        "plan": asdict(plan),
        "parts": {name: _part(done, name) for name in names if rows[name]},
        "cells": {"all": everything, "already": already, "failed": len(failures)},
        "failures": {name: " ".join(text.split()) for name, text in failures.items()},
        "wall_seconds": time.perf_counter() - start,
        **_tables(rows),
        "verdicts": [asdict(verdict) for verdict in verdicts(rows)],
        "figures": figures,
    }
    write_text(folder / "summary.json", json.dumps(json_safe(summary, 6), indent=1) + "\n")
    write_text(folder / "reproduce.md", markdown(json_safe(summary, 6)))
    progress("tables and figures", 1, 1)
    notes = [note for rig in done for note in rig.notes]
    notes += [f"{first.folder} has no data for {name}; it is left out" for name in absent]
    files = {"account": folder / "reproduce.md", "figures": folder / "figures", "summary": folder / "summary.json"}
    return Reproduction(summary, files, failures, tuple(notes))


@dataclass(frozen=True)
class _Rig:
    """What was computed of one rig, this time or before.

    Attributes:
        source: Its data.
        cells: By experiment, of those that are whole.
        values: Of each cell.
        seconds: Of work, of each cell.
        failures: Cells without a result, and why; their names begin with the rig's where there are several.
        notes: What should be known before the numbers are trusted.
        count: How many cells this run was about.
        already: How many of them had been computed before.
    """

    source: Source
    cells: Mapping[str, Sequence[Cell]]
    values: Mapping[str, Values]
    seconds: Mapping[str, float]
    failures: Mapping[str, str]
    notes: tuple[str, ...]
    count: int
    already: int

    def rows(self, experiment: str) -> list[Row]:
        """The rows of all cells that have a result, with the rig's name."""
        found = [self.values[cell.name].get("rows", []) for cell in self.cells[experiment] if cell.name in self.values]
        return [{**row, "rig": self.source.name} for rows in found for row in rows]


def _compute(
    experiments: Sequence[str],
    folder: Path,
    source: Source,
    plan: Plan,
    progress: Progress,
    *,
    jobs: int | None,
    scheduler: str | None,
) -> _Rig:
    """The cells of one rig: those of these experiments are computed, those of others taken where they are whole."""
    cells = {name: _CELLS[name](source, plan) for name in experiments}
    everything = [cell for found in cells.values() for cell in found]
    place = folder / "cells" / f"{plan.name}-{source.name}"
    results = run(everything, place, jobs=jobs, scheduler=scheduler, progress=progress)
    if not results.values:
        raise ImplicamError(f"all {len(everything)} cells failed.", why=next(iter(results.failures.values())))
    before = _whole_before([name for name in EXPERIMENTS if name not in cells], source, plan, place)
    return _Rig(
        source,
        {**cells, **before[0]},
        {**results.values, **before[1].values},
        {**results.seconds, **before[1].seconds},
        {f"{source.name}: {name}": why for name, why in results.failures.items()},
        results.notes,
        len(everything),
        results.already,
    )


def _tell_rig(progress: Progress, i: int, rigs: int) -> Progress:
    """Progress that says which of several rigs it is about."""
    if rigs == 1:
        return progress
    return lambda what, done, total: progress(f"rig {i + 1} of {rigs}: {what}", done, total)


def _whole_before(
    names: Sequence[str], source: Source, plan: Plan, place: Path
) -> tuple[dict[str, list[Cell]], Results]:
    """The cells of other experiments of which every one has been computed before, and their results."""
    cells = {}
    for name in names:
        found = _CELLS[name](source, plan)
        if found and len(load_results(found, place).values) == len(found):
            cells[name] = found
    return cells, load_results([cell for found in cells.values() for cell in found], place)


def _tables(rows: Mapping[str, Sequence[Row]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if rows.get(ball.NAME):
        mine = rows[ball.NAME]
        found |= {
            "ball": tables.ball_table(mine),
            "tenfold": tables.tenfold(mine),
            "flattery": tables.lattice_bias(mine),
        }
    if rows.get(active.NAME):
        found["active"] = tables.active_table(rows[active.NAME])
    if rows.get(board.NAME):
        mine = rows[board.NAME]
        found |= {
            "board": tables.board_table(mine),
            "published": tables.published_beside(mine),
            "nearness": tables.nearness(mine),
        }
    return found


def _part(rigs: Sequence[_Rig], experiment: str) -> dict[str, Any]:
    """What a part took on all rigs: seconds of work of its cells, in all and by method."""
    by_method: dict[str, float] = {}
    for rig in rigs:
        for cell in rig.cells[experiment]:
            method = str(cell.options.get("method", "explicit"))
            by_method[method] = by_method.get(method, 0.0) + rig.seconds.get(cell.name, 0.0)
    count = sum(len(rig.cells[experiment]) for rig in rigs)
    return {"cells": count, "seconds": sum(by_method.values()), "by_method": by_method}


def _csv(rows: Sequence[Row]) -> str:
    """All rows, a column for each key that any of them has; six digits, lists left out."""
    columns = list(dict.fromkeys(key for row in rows for key, value in row.items() if not isinstance(value, list)))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    return buffer.getvalue()
