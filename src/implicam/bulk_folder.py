"""Measuring a folder of tables whose files are read and written by whoever measures: this machine, or the workers of a
Dask cluster that see the same files.

Beside the result stands a folder, `measured.parts`, with the parts that are done. Each is written under a name that
follows from its file and rows alone, and appears whole or not at all, so that a part that is measured twice (a worker
has died, or works on for a caller that is gone) is the same file, and no row is there twice or missing. When all are
there, the folder gets its name.
"""

from __future__ import annotations

import json
import secrets
import shutil
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from implicam import calibration_file
from implicam.bulk import (
    ENDINGS,
    PARTS_A_WORKER,
    POINTS_AT_ONCE,
    BulkResult,
    NumberedPart,
    count_rows,
    state_of_file,
    write_part,
)
from implicam.bulk import numbered_parts as read_parts
from implicam.calibrators.elsewhere import bytes_of_calibration, calibration_of_bytes
from implicam.calibrators.protocol import RigCalibration
from implicam.errors import DatasetError, ImplicamError, UsageError
from implicam.files import convert_write_errors, is_file_name, refuse_other_files, replacing, write_text
from implicam.progress import Progress, silent
from implicam.workers import Task, compute_on_cluster

PARTS_A_TASK = 4
"""Parts of a file that one task measures: a table is read from its beginning to where the task begins."""

DONE = "done"  # a folder that is taken away in one step, by which the work has ended
PLAN = f"{DONE}/plan.json"
SUMMARY = f"{DONE}/summary.json"


def measure_folder(
    calibration: RigCalibration,
    source: str | Path,
    target: str | Path,
    *,
    points_at_once: int = POINTS_AT_ONCE,
    scheduler: str | None = None,
    progress: Progress = silent,
) -> BulkResult:
    """Measure all tables of a folder, each as `implicam.bulk.measure_file` does, into a folder of parts.

    The rows of run.csv are in run-000000.csv, run-000001.csv, ..., each a table with a head; .parquet and .npz
    likewise. Points without names are called run/p0000001 and so on. Whatever ends the work, the same call goes on.

    Args:
        calibration: By `forward-gp` or `explicit`.
        source: A folder of .csv, .parquet or .npz; other files than hidden ones, or such as _SUCCESS, are refused.
        target: The folder to write; there must be none yet.
        points_at_once: Rows of a part.
        scheduler: The address of a Dask scheduler whose workers read and write the files, under the same paths.
        progress: Is told how many rows are measured, of how many.

    Returns:
        How many rows there were, and which parts contradict the calibration.

    Raises:
        UsageError: The folder to write, or the parts of an earlier call do not fit.
        DatasetError: A table has a mistake, or the folder has none; names the row and the cure.
        MissingExtraError: What reads or writes Parquet, or `distributed`, is not installed.
        ImplicamError: A file cannot be written, there is no such cluster, or its workers see other files.

    >>> import numpy as np
    >>> from pathlib import Path
    >>> import implicam as ic
    >>> from implicam.bulk_folder import measure_folder
    >>> rig = ic.simulated("stereo", points=300, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig.select(np.arange(40)))
    >>> Path("runs").mkdir()
    >>> np.savez("runs/a.npz", uv=rig.observations.uv)
    >>> measure_folder(calibration, "runs", "measured", points_at_once=200)
    BulkResult(rows=300, measured=300, resumed=0, alarms=())
    >>> sorted(path.name for path in Path("measured").iterdir())
    ['a-000000.npz', 'a-000001.npz']
    """
    source, target = Path(source).resolve(), Path(target).resolve()
    if points_at_once < 1:
        raise UsageError(f"parts of {points_at_once} points are none.", fix=f"take {POINTS_AT_ONCE}")
    files = _tables(source)
    if is_file_name(target) or target == source:
        raise UsageError(f"{target} is no name for a folder of results.", fix="name another, such as measured")
    plan = json.dumps(
        {
            "calibration": calibration_file.checksum(calibration),  # type: ignore[arg-type]
            "tables": [state_of_file(path) for path in files],
            "points_at_once": points_at_once,
            "implicam": calibration_file.package_version(),
        },
        indent=1,
    )
    folder = target.with_name(f"{target.name}.parts")
    if not _has_plan(target, plan):
        _begin(folder, target, plan)
        content = bytes_of_calibration(calibration)  # type: ignore[arg-type]
        said, resumed = _measure_all(content, files, folder, plan, points_at_once, scheduler, progress)
        write_text(folder / SUMMARY, json.dumps([said, resumed]))
        with convert_write_errors(str(target)):
            if target.exists():
                target.rmdir()
            folder.rename(target)
    said, resumed = json.loads((target / SUMMARY).read_text(encoding="utf-8"))
    _tidy(target)
    return BulkResult(
        sum(part["rows"] for part in said.values()),
        sum(part["measured"] for part in said.values()),
        resumed,
        tuple(part["alarm"] for part in said.values() if part["alarm"]),
    )


def _measure_all(
    content: bytes,
    files: list[Path],
    folder: Path,
    plan: str,
    size: int,
    scheduler: str | None,
    progress: Progress,
) -> tuple[dict[str, dict[str, Any]], int]:
    """What was said of each part, and how many rows were done before."""
    shared = {"folder": str(folder), "plan": plan}
    rows = dict(
        _computed(
            scheduler,
            (Task(f"{__name__}:rows_of", str(path), {"source": str(path), **shared}) for path in files),
        )
    )
    wanted = {path: [_part(path, i) for i in range(-(-rows[str(path)] // size))] for path in files}
    if not any(wanted.values()):
        raise DatasetError(f"the tables of {files[0].parent} have no points.", fix="give one row for each point")
    names = [name for some in wanted.values() for name in some]
    said = {name: part for name in names if (part := _said(folder, name))}
    before = set(said)
    resumed = done = sum(part["rows"] for part in said.values())
    progress("measuring", done, sum(rows.values()))

    def tasks() -> Iterator[Task]:
        for path, some in wanted.items():
            for i in range(0, len(some), PARTS_A_TASK):
                if not before.issuperset(some[i : i + PARTS_A_TASK]):
                    where = {"calibration": content, "source": str(path), "size": size, "begin": i}
                    yield Task(f"{__name__}:measure_parts", f"{path.name} from part {i} on", {**where, **shared})

    for _, found in _computed(scheduler, tasks()):
        done += sum(part["rows"] for name, part in found.items() if name not in before)
        said |= found
        progress("measuring", done, sum(rows.values()))
    lost = [name for name in names if name not in said or not (folder / name).exists()]
    if lost or done != sum(rows.values()):
        raise ImplicamError(
            f"{folder} has {done:,} of {sum(rows.values()):,} rows, and {len(lost)} parts are missing.",
            why="a worker wrote where it cannot be seen here, or a table was not read as it was counted",
            fix="run again; what is done is kept",
        )
    return {name: said[name] for name in names}, resumed


def _tidy(target: Path) -> None:
    """Take away what is no result."""
    with convert_write_errors(str(target)):
        for hidden in target.glob(".*"):  # of a worker that was killed
            hidden.unlink(missing_ok=True)
        away = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
        (target / DONE).rename(away)
        shutil.rmtree(away, ignore_errors=True)


def _tables(source: Path) -> list[Path]:
    """The tables of a folder in the order of their names; what else is there would be left out unnoticed."""
    try:
        paths = sorted(path for path in source.iterdir() if not path.name.startswith((".", "_")))
    except OSError as error:
        raise DatasetError(
            f"{source} cannot be read.", why=error.strerror or str(error), fix="check the name"
        ) from error
    others = [path.name for path in paths if path.suffix.lower() not in ENDINGS or path.is_dir()]
    if others or not paths:
        raise DatasetError(
            f"{source} holds {others[0]!r}, which is no table." if others else f"{source} holds no table.",
            why=f"tables of any length are {', '.join(ENDINGS)}",
            fix="give a folder of tables, and nothing else",
        )
    stems = [path.stem for path in paths]
    twice = [stem for stem in stems if stems.count(stem) > 1]
    if twice:
        raise DatasetError(f"{source} has two tables called {twice[0]}.", fix="rename one: their parts are named so")
    return paths


def _part(source: Path, number: int) -> str:
    return f"{source.stem}-{number:06d}{source.suffix.lower()}"


def _has_plan(folder: Path, plan: str) -> bool:
    try:
        return (folder / PLAN).read_text(encoding="utf-8") == plan
    except OSError:
        return False


def _begin(folder: Path, target: Path, plan: str) -> None:
    """Make the folder of parts, or go on with the one that is there."""
    if target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise UsageError(f"{target} already exists.", fix="choose another name, or remove it")
    if (folder / PLAN).exists():
        if not _has_plan(folder, plan):
            raise UsageError(
                f"{folder} has parts of another measurement.",
                why="the calibration, a table, the size of parts or implicam is another than when they were made",
                fix="delete the folder to begin anew, or name another folder to write",
            )
        return
    refuse_other_files(folder, lambda name: name.startswith(f"{DONE}/"), "a measurement in parts")
    with convert_write_errors(str(folder)):
        (folder / DONE).mkdir(parents=True, exist_ok=True)
    write_text(folder / PLAN, plan)


def _said(folder: Path, name: str) -> dict[str, Any] | None:
    """What was said of a part that is done."""
    path = folder / DONE / f"{name}.json"
    if not path.exists() or not (folder / name).exists():
        return None
    said: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return said


def _computed(scheduler: str | None, tasks: Any) -> Iterator[tuple[str, Any]]:
    """The name of each task and what came of it, here or on a cluster."""
    if scheduler is not None:
        yield from compute_on_cluster(scheduler, tasks, a_worker=PARTS_A_WORKER)
        return
    work: dict[str, Callable[..., Any]] = {"rows_of": rows_of, "measure_parts": measure_parts}
    for task in tasks:
        yield task.name, work[task.work.partition(":")[2]](**task.arguments)


def _check_shared(source: Path, folder: Path, plan: str) -> None:
    """Whether this process sees what the caller sees, and the table is what it was."""
    if not _has_plan(folder, plan):
        raise ImplicamError(
            f"a worker does not find {folder / PLAN}, which the caller has written.",
            why="workers read and write the files of a folder themselves; or the caller was ended and has ended since",
            fix="put tables and results where all workers see them under the same path; "
            "or measure one table, which the caller reads and writes",
        )
    if state_of_file(source) not in json.loads(plan)["tables"]:
        raise DatasetError(f"{source} has changed since the work began.", fix="begin anew when it is complete")


def rows_of(source: str, folder: str, plan: str) -> int:
    """What a worker does first: count the rows of a table.

    Args:
        source: The table.
        folder: Of the parts.
        plan: What the caller has written there.
    """
    _check_shared(Path(source), Path(folder), plan)
    return count_rows(Path(source))


def measure_parts(
    calibration: bytes, source: str, size: int, begin: int, folder: str, plan: str
) -> dict[str, dict[str, Any]]:
    """What a worker does then: read, measure and write some parts of a table; those that are done are kept.

    Args:
        calibration: The bytes of its file.
        source: The table.
        size: Rows of a part.
        begin: Number of the first part.
        folder: Of the parts.
        plan: What the caller has written there.

    Returns:
        For each part, by the name of its file: rows, measured and alarm.
    """
    table, parts = Path(source), Path(folder)
    rig = calibration_of_bytes(calibration)
    assert isinstance(rig, RigCalibration)
    _check_shared(table, parts, plan)
    said: dict[str, dict[str, Any]] = {}
    read = read_parts(rig, table, size, begin, begin * size, prefix=f"{table.stem}/")
    for part in islice(read, PARTS_A_TASK):
        name = _part(table, part.number)
        said[name] = _said(parts, name) or _measure(rig, table, part, parts, plan, name)
    return said


def _measure(
    rig: RigCalibration, table: Path, part: NumberedPart, folder: Path, plan: str, name: str
) -> dict[str, Any]:
    found = rig.measure_pixels(part.uv)
    alarm = found.alarm
    with replacing(folder / name) as temporary:
        write_part(temporary, table.suffix.lower(), part.points, found, bool(alarm))
        _check_shared(table, folder, plan)  # a caller that was ended may have been followed by another
    said = {
        "rows": len(part.points),
        "measured": int(np.count_nonzero(found.measured)),
        "alarm": f"{table.name} from row {part.first + 1} on: {alarm}" if alarm else "",
    }
    write_text(folder / DONE / f"{name}.json", json.dumps(said))
    return said
