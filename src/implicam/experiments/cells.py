"""Sweeps: a list of independent cells, one result file each.

A result is written when its cell is done, so that an interrupted sweep goes on where it stopped, and nothing is
computed twice. A cell that fails is reported, and the others go on. Where the cells are computed (`workers`) does not
change a bit of any result, on processors of one kind: another BLAS kernel rounds differently.
"""

from __future__ import annotations

import json
import os
import pkgutil
import re
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from implicam.calibration_file import package_version
from implicam.errors import ImplicamError, UsageError
from implicam.experiments.stored import (
    Stored,
    Values,
    canonical,
    decode,
    encode,
    failure_file,
    result_file,
    write_result,
)
from implicam.files import write_text
from implicam.progress import Progress, silent
from implicam.threads import cores
from implicam.workers import DaskCluster, LocalProcesses, Task, compute_all

Work = Callable[..., Mapping[str, Any]]

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,99}(/[A-Za-z0-9][A-Za-z0-9._+-]{0,99})*")


@dataclass(frozen=True)
class Cell:
    """One independent piece of a sweep.

    Attributes:
        work: A top-level function of a module, or its name "package.module:function". It is called as work(**options)
            in another process, perhaps on another machine, and returns a dict of plain JSON values and NumPy arrays.
            Its numbers must depend on the options only: a seed is an option.
        name: Unique in the sweep and the path of its result, such as "ball/2R/inverse-gp/157".
        options: Plain JSON values, as `work` gets them: a tuple becomes a list.

    Raises:
        UsageError: The name cannot be a path, the options are not JSON, or the function cannot be found by its name.
    """

    work: str | Work
    name: str
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name) or any(part.endswith((".npz", ".txt", ".")) for part in self.name.split("/")):
            raise UsageError(
                f"{self.name[:200]!r} cannot be the name of a cell.",
                why="it becomes the path of a file on any system",
                fix="parts of letters, digits and . _ + - that begin with a letter or digit, joined by /",
            )
        try:
            plain = json.loads(canonical(self.options))
        except (TypeError, ValueError) as error:
            raise UsageError(
                f"the options of the cell {self.name!r} are no plain JSON values.",
                why=str(error),
                fix="give numbers, text, lists and dicts; a NumPy number by float(...) or int(...)",
            ) from error
        object.__setattr__(self, "options", plain)
        object.__setattr__(self, "work", _dotted_name(self.work))

    @property
    def task(self) -> Task:
        """The cell as it is sent to a worker."""
        own = f"{compute_cell.__module__}:{compute_cell.__name__}"
        return Task(own, self.name, {"work": str(self.work), "options": canonical(self.options)})


def compute_cell(work: str, options: str) -> bytes:
    """What a worker does for a cell.

    Args:
        work: The dotted name of the cell's function.
        options: Its options as JSON text.

    Returns:
        The bytes of the result file.
    """
    start = time.perf_counter()
    values = pkgutil.resolve_name(work)(**json.loads(options))
    return encode(work, options, time.perf_counter() - start, values)


def _failure(name: str, error: ImplicamError) -> str:
    """Why a cell has no result, in three lines."""
    fix = error.fix or f"read the traceback in {name}.failed.txt; the next run tries this cell again"
    return str(ImplicamError(f"{name}: {error.what}", why=error.why, fix=fix))


def _dotted_name(work: str | Work) -> str:
    """The name by which another process finds the function; UsageError where it could not."""
    name = work if isinstance(work, str) else f"{work.__module__}:{getattr(work, '__qualname__', '')}"
    try:
        found = pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError) as error:
        found, why = None, str(error)
    else:
        why = "it is a function within a function, or has another name" if callable(found) else "it is no function"
    if not callable(found) or (found is not work and not isinstance(work, str)) or name.startswith("__main__"):
        raise UsageError(
            f"{name!r} cannot be the work of a cell.",
            why="other processes do not have what the main script defines" if name.startswith("__main__") else why,
            fix='give a top-level function of a module that can be imported, or its name "package.module:function"',
        )
    return name


@dataclass(frozen=True)
class Results:
    """What a sweep has, by the names of its cells, in their order.

    Attributes:
        values: Of each cell that has a result.
        seconds: That its work took.
        failures: Why a cell has none, in three lines (what, why, fix); the traceback is in <folder>/<name>.failed.txt.
        already: How many results were there before.
        notes: What should be known before the numbers are trusted.
    """

    values: Mapping[str, Values]
    seconds: Mapping[str, float]
    failures: Mapping[str, str]
    already: int
    notes: tuple[str, ...] = ()


def run(
    cells: Sequence[Cell],
    folder: str | Path,
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: Progress = silent,
) -> Results:
    """Compute the cells that have no result yet; failed ones are tried again.

    A result counts when its file is whole and its work and options are those of the cell. Interrupt it at any time:
    what is done is kept. Two runs on one folder may compute a cell twice, and do no other harm.

    Args:
        cells: What to compute.
        folder: Where results are.
        jobs: Processes on this machine; None for one a core.
        scheduler: The address of a Dask scheduler whose workers compute instead.
        progress: Called after each cell.

    Raises:
        UsageError: Two cells have one name, or both `jobs` and `scheduler` are given.
        ImplicamError: The folder cannot be written, or there is no scheduler.
    """
    _check_arguments(cells, jobs, scheduler)
    folder = Path(folder)
    stored, notes = _read_stored(cells, folder)
    missing = [cell.task for cell in cells if cell.name not in stored]
    already, failures = len(stored), dict[str, str]()
    what = f"computing {', '.join(sorted({cell.name.partition('/')[0] for cell in cells})[:3])}"
    progress(what, already, len(cells))
    if missing:
        _make_folder(folder)
        with closing(compute_all(_workers(len(missing), jobs, scheduler), missing)) as all_done:
            for done in all_done:
                if done.error is not None:
                    failures[done.name] = _failure(done.name, done.error)
                    write_text(failure_file(folder, done.name), f"{failures[done.name]}\n\n{done.trace}")
                else:
                    write_result(folder, done.name, done.value)
                    stored[done.name] = decode(done.value)
                progress(what, len(stored) + len(failures), len(cells))
    return _collect(cells, stored, failures, already, notes)


def load_results(cells: Sequence[Cell], folder: str | Path) -> Results:
    """The results that are stored, and count; computes nothing.

    Args:
        cells: Whose results.
        folder: Where they are.
    """
    stored, notes = _read_stored(cells, Path(folder))
    return _collect(cells, stored, {}, len(stored), notes)


def _check_arguments(cells: Sequence[Cell], jobs: int | None, scheduler: str | None) -> None:
    same = Counter(cell.name.casefold() for cell in cells)  # some file systems take upper for lower case
    twice = [cell.name for cell in cells if same[cell.name.casefold()] > 1]
    if twice:
        raise UsageError(
            f"two cells are called {twice[0]!r}, or differ in upper and lower case only.",
            why="each has a file of its name",
            fix="put what differs between them into their names",
        )
    if jobs is not None and jobs < 1:
        raise UsageError(f"{jobs} processes cannot compute anything.", fix="give 1 or more, or leave it out")
    if jobs is not None and scheduler is not None:
        raise UsageError("give a number of processes or a scheduler, not both.", why="a cluster has its own workers")


def _make_folder(folder: Path) -> None:
    """Before the work: a place for its results."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ImplicamError(
            f"cannot create the folder {folder}.", why=str(error), fix="choose a place you may write to"
        ) from error
    if not os.access(folder, os.W_OK):
        raise ImplicamError(f"cannot write into {folder}.", fix="choose a place you may write to")


def _workers(count: int, jobs: int | None, scheduler: str | None) -> LocalProcesses | DaskCluster:
    return DaskCluster(scheduler) if scheduler is not None else LocalProcesses(min(count, jobs or cores()))


def _read_stored(cells: Sequence[Cell], folder: Path) -> tuple[dict[str, Stored], list[str]]:
    """The results that count, and notes on those that do not."""
    stored, notes, other = dict[str, Stored](), list[str](), 0
    for cell in cells:
        path = result_file(folder, cell.name)
        if not path.exists():
            continue
        try:
            result = decode(path)
        except ImplicamError as error:
            notes.append(f"{path} is damaged and was computed again: {error.why}")
            continue
        if (result.work, result.options) == (cell.work, canonical(cell.options)):
            stored[cell.name] = result
        else:
            other += 1
    if other:
        notes.append(f"{other} results in {folder} were of other options or other work and were computed again")
    return stored, notes


def _collect(
    cells: Sequence[Cell], stored: Mapping[str, Stored], failures: Mapping[str, str], already: int, notes: list[str]
) -> Results:
    ours = package_version()
    versions = Counter(result.version for result in stored.values() if result.version != ours)
    notes += [
        f"{count} results were computed by implicam {version}; this is {ours}" for version, count in versions.items()
    ]
    names = [cell.name for cell in cells if cell.name in stored]
    return Results(
        values={name: stored[name].values for name in names},
        seconds={name: stored[name].seconds for name in names},
        failures={cell.name: failures[cell.name] for cell in cells if cell.name in failures},
        already=already,
        notes=tuple(notes),
    )
