"""Measuring tables that are too large for memory: in parts, each of which is on disk before the next is begun.

Beside the result stands a folder, `measured.csv.parts`, with what is done so far and what it was made from. Whatever
ends the work, the same call goes on after the last part, and no row is there twice or missing. The parts are put
together when all of them are there.
"""

from __future__ import annotations

import csv
import io
import json
import shutil
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam import calibration_file
from implicam.calibrators.elsewhere import bytes_of_calibration, calibration_of_bytes
from implicam.calibrators.protocol import RigCalibration
from implicam.dataset import Floats, Names
from implicam.dataset.cells import guard_cell
from implicam.dataset.folder import format_cells
from implicam.dataset.model import check_views
from implicam.errors import DatasetError, UsageError, import_extra
from implicam.files import convert_write_errors, refuse_other_files, replacing, write_text
from implicam.measurement import DOUBTFUL, MEASURED_COLUMNS
from implicam.progress import Progress, silent
from implicam.rig_model import MeasuredPixels
from implicam.workers import Task, compute_on_cluster

PARTS_A_WORKER = 2
"""Parts that each thread of a cluster's workers has: one that is measured, one that waits."""

POINTS_AT_ONCE = 100_000
"""Points of a part: some 100 MB with ten cameras."""

ENDINGS = (".csv", ".parquet", ".npz")
PLAN = "plan.json"

Columns = dict[str, Floats]

ARRAYS = ("xyz", "cov", "consistency", "views", "code", "share_calibration", "left_out")
"""Members of an .npz that is written; further point, where the points have names."""


class NumberedPart(NamedTuple):
    """A part, its number, and that of its first row; points (n,) names, which every point has by now."""

    number: int
    first: int
    points: list[str]
    uv: Floats


class Part(NamedTuple):
    """Some points: names (n,), None where they are numbered; pixels uv (n, C, 2) of the calibrated cameras."""

    points: list[str] | None
    uv: Floats


@dataclass(frozen=True)
class BulkResult:
    """What was measured.

    Attributes:
        rows: Points of the table.
        measured: How many have a position.
        resumed: Rows that an earlier call had measured.
        alarms: Of parts that contradict the calibration, with the number of their first row; their rows say so, too.
    """

    rows: int
    measured: int
    resumed: int
    alarms: tuple[str, ...]


def measure_file(
    calibration: RigCalibration,
    source: str | Path,
    target: str | Path,
    *,
    points_at_once: int = POINTS_AT_ONCE,
    scheduler: str | None = None,
    progress: Progress = silent,
) -> BulkResult:
    """Measure a table of any length, and go on where an earlier call was ended.

    The table has the columns u_CAMERA and v_CAMERA, empty where a camera does not see a point, and point where the
    points have names (.csv with commas, .parquet); or it is an .npz with uv (n, cameras, 2), NaN for views that are
    missing, cameras with their names, and point. What is written is measured.csv (docs/formats.md), the same as
    .parquet, or an .npz with `ARRAYS`. Each camera's usual noise is taken.

    Args:
        calibration: By `forward-gp` or `explicit`.
        source: The table.
        target: The file to write; one that is there is replaced when all is measured.
        points_at_once: Points of a part.
        scheduler: The address of a Dask scheduler whose workers measure; they read and write no files.
        progress: Is told how many rows are measured.

    Returns:
        How many rows there were, and which parts contradict the calibration.

    Raises:
        UsageError: An ending, a column, or the parts of an earlier call do not fit.
        DatasetError: The table has a mistake; names the row and the cure.
        MissingExtraError: What reads or writes Parquet, or `distributed`, is not installed.
        ImplicamError: A file cannot be written, or there is no such cluster.

    >>> import numpy as np
    >>> import implicam as ic
    >>> from implicam.bulk import measure_file
    >>> rig = ic.simulated("stereo", points=300, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig.select(np.arange(40)))
    >>> np.savez("new.npz", uv=rig.observations.uv)
    >>> measure_file(calibration, "new.npz", "measured.csv", points_at_once=100)
    BulkResult(rows=300, measured=300, resumed=0, alarms=())
    """
    source, target = Path(source), Path(target)
    for path in (source, target):
        if path.suffix.lower() not in ENDINGS:
            raise UsageError(
                f"{path}: no table of any length is read or written as {path.suffix or 'a file without an ending'}.",
                fix=f"use {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}",
            )
    if points_at_once < 1:
        raise UsageError(f"parts of {points_at_once} points are none.", fix=f"take {POINTS_AT_ONCE}")
    parts = _Parts(target, _plan(calibration, source, points_at_once))
    resumed = parts.rows
    read = numbered_parts(calibration, source, points_at_once, len(parts.done), resumed)
    for part, found in _measured(calibration, read, scheduler):
        parts.add(part, found)
        progress("measuring", parts.rows, parts.rows)
    if not parts.rows:
        raise DatasetError(f"{source} has no points.", fix="give one row for each point")
    parts.put_together()
    return BulkResult(parts.rows, parts.measured, resumed, tuple(parts.alarms))


def numbered_parts(
    calibration: RigCalibration, source: Path, points_at_once: int, number: int, first: int, *, prefix: str = ""
) -> Iterator[NumberedPart]:
    """The parts of a table from one on, checked.

    Args:
        calibration: Whose cameras are read.
        source: The table.
        points_at_once: Rows of a part.
        number: Of the part to begin with.
        first: Number of its first row, from 0.
        prefix: Of the names of points that have none.
    """
    try:
        for part in _READERS[source.suffix.lower()](source, calibration.camera_names, points_at_once, number):
            check_views(part.uv, np.full_like(part.uv, np.nan), _cameras(calibration), _place(source, first))
            points = part.points or [f"{prefix}p{i + 1:07d}" for i in range(first, first + len(part.uv))]
            yield NumberedPart(number, first, points, part.uv)
            number, first = number + 1, first + len(part.uv)
    except UnicodeDecodeError as error:
        raise DatasetError(f"{source} is no UTF-8.", why=str(error), fix="save it as CSV in UTF-8") from error
    except (OSError, csv.Error) as error:
        raise DatasetError(f"{source} cannot be read.", why=str(error), fix="check the file") from error


def _measured(
    calibration: RigCalibration, parts: Iterator[NumberedPart], scheduler: str | None
) -> Iterator[tuple[NumberedPart, MeasuredPixels]]:
    """Each part and what was found; on a cluster in the order in which they end."""
    if scheduler is None:
        yield from ((part, calibration.measure_pixels(part.uv)) for part in parts)
        return
    content, sent = bytes_of_calibration(calibration), dict[str, NumberedPart]()  # type: ignore[arg-type]

    def tasks() -> Iterator[Task]:
        for part in parts:
            name = f"part {part.number}"
            sent[name] = part
            yield Task(f"{__name__}:measure_part", name, {"calibration": content, "uv": part.uv})

    for name, found in compute_on_cluster(scheduler, tasks(), a_worker=PARTS_A_WORKER):
        part = sent.pop(name)
        yield part, replace(found, uv=part.uv)


def measure_part(calibration: bytes, uv: Floats) -> MeasuredPixels:
    """What a worker does.

    Args:
        calibration: The bytes of its file.
        uv: (n, C, 2) pixels.

    Returns:
        What was found, without the pixels, which the caller has.
    """
    rig = calibration_of_bytes(calibration)
    assert isinstance(rig, RigCalibration)
    found = rig.measure_pixels(uv)
    return replace(found, uv=np.empty((0, *uv.shape[1:])), find_alarm=partial(str, found.alarm))


def _cameras(calibration: RigCalibration) -> list[Any]:
    rig = calibration.map
    return [rig.trained.cameras[c] for c in rig.cameras]


def _place(source: Path, first: int) -> Callable[[int, int], str]:
    return lambda i, _: f"{source}, row {first + i + 1}"


def state_of_file(source: Path) -> list[str | int]:
    """Name, bytes and time in ns of a table, by which a change is noticed.

    Args:
        source: The table.
    """
    try:
        state = source.stat()
    except OSError as error:
        raise DatasetError(
            f"{source} cannot be read.", why=error.strerror or str(error), fix="check the name"
        ) from error
    return [source.name, state.st_size, state.st_mtime_ns]


def count_rows(source: Path) -> int:
    """Rows of a table, without measuring it.

    Args:
        source: The table.
    """
    ending = source.suffix.lower()
    try:
        if ending == ".csv":
            with source.open(newline="", encoding="utf-8-sig", errors="replace") as file:
                return max(0, sum(1 for line in file if line.strip()) - 1)
        if ending == ".npz":
            with np.load(source, allow_pickle=False) as arrays:
                return len(arrays["uv"])
        parquet = import_extra("pyarrow.parquet", "parquet", "reading Parquet")
        return int(parquet.ParquetFile(source).metadata.num_rows)
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:  # pyarrow's are ValueErrors
        why = " ".join(str(error).split())
        raise DatasetError(f"{source} cannot be read as a table.", why=why, fix="check the file") from error


def _plan(calibration: RigCalibration, source: Path, points_at_once: int) -> dict[str, Any]:
    """What the parts are made from."""
    return {
        "calibration": calibration_file.checksum(calibration),  # type: ignore[arg-type]
        "table": state_of_file(source),
        "points_at_once": points_at_once,
        "implicam": calibration_file.package_version(),
    }


def _is_part(name: str) -> bool:
    """Whether `_Parts` writes a file of this name; a kill leaves a hidden one."""
    return name.lstrip(".").startswith(("part-", PLAN))


class _Parts:
    """The parts on disk. Each is a file as the whole will be, and a summary that is written after it."""

    def __init__(self, target: Path, plan: Mapping[str, Any]) -> None:
        self.target, self.ending = target, target.suffix.lower()
        if self.ending == ".parquet":
            import_extra("pyarrow.parquet", "parquet", "writing Parquet")
        self.folder = target.with_name(f"{target.name}.parts")
        self.done: dict[int, dict[str, Any]] = {}
        path = self.folder / PLAN
        if not self._file(0, ".json").exists():  # nothing is done
            refuse_other_files(self.folder, _is_part, "a measurement in parts")
            with convert_write_errors(str(self.folder)):
                shutil.rmtree(self.folder, ignore_errors=True)
                self.folder.mkdir(parents=True)
            write_text(path, json.dumps(plan, indent=1))
            return
        if json.loads(path.read_text(encoding="utf-8")) != plan:
            raise UsageError(
                f"{self.folder} has parts of another measurement.",
                why="the calibration, the table, the size of parts or implicam is another than when they were made",
                fix="delete the folder to begin anew, or name another file to write",
            )
        while (said := self._file(len(self.done), ".json")).exists() and self._file(len(self.done)).exists():
            self.done[len(self.done)] = json.loads(said.read_text(encoding="utf-8"))

    @property
    def rows(self) -> int:
        """Of the parts that are done."""
        return sum(int(part["rows"]) for part in self.done.values())

    @property
    def measured(self) -> int:
        """How many of these have a position."""
        return sum(int(part["measured"]) for part in self.done.values())

    @property
    def alarms(self) -> list[str]:
        """Of the parts."""
        return [part["alarm"] for _, part in sorted(self.done.items()) if part["alarm"]]

    def _file(self, number: int, ending: str = "") -> Path:
        return self.folder / f"part-{number:06d}{ending or self.ending}"

    def add(self, part: NumberedPart, found: MeasuredPixels) -> None:
        """Write a part, and then that it is done."""
        alarm = found.alarm
        with replacing(self._file(part.number)) as temporary:
            _WRITERS[self.ending](temporary, part.points, found, bool(alarm))
        told = f"from row {part.first + 1} on: {alarm}" if alarm else ""
        said = {"rows": len(part.points), "measured": int(found.measured.sum()), "alarm": told}
        write_text(self._file(part.number, ".json"), json.dumps(said))
        self.done[part.number] = said

    def put_together(self) -> None:
        """Make one file of all parts, and take these away."""
        with replacing(self.target) as temporary:
            _JOINERS[self.ending](temporary, [self._file(number) for number in range(len(self.done))])
        shutil.rmtree(self.folder, ignore_errors=True)


# ---- reading ---------------------------------------------------------------------------------------------------------


def _wanted(source: Path, given: list[str], names: tuple[str, ...]) -> tuple[list[str], list[str]]:
    """The columns of the cameras that are there, and names of the cameras that are not."""
    refused = [name for name in given if name.startswith("sd_")]
    if refused:
        raise UsageError(
            f"{source} has the column {refused[0]}, and tables of any length have no uncertainties of their own.",
            fix="measure it as a whole, or leave the column out: each camera's usual noise is then taken",
        )
    twice = [name for name in given if given.count(name) > 1 and (name == "point" or name[2:] in names)]
    if twice:
        raise DatasetError(f"{source} has the column {twice[0]} more than once.", fix="leave one of them in")
    missing = [name for name in names if not {f"u_{name}", f"v_{name}"} <= set(given)]
    if len(missing) > len(names) - 2:
        raise DatasetError(
            f"{source} has columns of fewer than two cameras of the calibration.",
            why=f"its columns are {', '.join(given[:12])}; those of {', '.join(missing[:5])} are missing",
            fix=f"name them u_{names[0]},v_{names[0]},u_{names[1]},v_{names[1]}, ...",
        )
    return [f"{axis}_{name}" for name in names if name not in missing for axis in "uv"], missing


def _pixels(columns: Mapping[str, Floats], names: tuple[str, ...], n: int) -> Floats:
    uv = np.full((n, len(names), 2), np.nan)
    for c, name in enumerate(names):
        for k, axis in enumerate("uv"):
            if f"{axis}_{name}" in columns:
                uv[:, c, k] = columns[f"{axis}_{name}"]
    return uv


def _read_csv(source: Path, names: tuple[str, ...], size: int, skip: int) -> Iterator[Part]:
    with source.open(newline="", encoding="utf-8-sig") as file:
        lines = (line for line in file if line.strip())
        head = [cell.strip() for cell in next(csv.reader(islice(lines, 1)), [])]
        wanted, _ = _wanted(source, head, names)
        for _ in islice(lines, skip * size):
            pass
        first = skip * size
        while some := list(islice(lines, size)):
            columns, points = _cells_by_arrow(some, head, wanted) or _cells(source, some, head, wanted, first)
            yield Part(points, _pixels(columns, names, len(some)))
            first += len(some)


def _cells_by_arrow(lines: list[str], head: list[str], wanted: list[str]) -> tuple[Columns, list[str] | None] | None:
    """The numbers and names in lines of CSV, ten times as fast as `_cells`; None where pyarrow is not installed, or the
    lines are not as it wants them."""
    if find_spec("pyarrow") is None:
        return None
    pyarrow, arrow = import_extra("pyarrow", "parquet", "CSV"), import_extra("pyarrow.csv", "parquet", "CSV")
    named = ["point"] if "point" in head else []
    types = dict.fromkeys(wanted, pyarrow.float64()) | dict.fromkeys(named, pyarrow.string())
    convert = arrow.ConvertOptions(column_types=types, include_columns=[*wanted, *named], null_values=[""])
    try:
        table = arrow.read_csv(
            pyarrow.BufferReader("".join(lines).encode()), arrow.ReadOptions(column_names=head), None, convert
        )
    except (pyarrow.ArrowException, ValueError):  # the slow way says which cell it is
        return None
    if table.num_rows != len(lines):
        return None
    columns = {name: np.asarray(table.column(name).to_numpy(), dtype=np.float64) for name in wanted}
    return columns, [str(name or "") for name in table.column("point").to_pylist()] if named else None


def _cells(
    source: Path, lines: list[str], head: list[str], wanted: list[str], first: int
) -> tuple[Columns, list[str] | None]:
    """The same by Python alone; an error names the row."""
    rows, columns = list(csv.reader(lines)), {}
    if len(rows) != len(lines):
        i = next(i for i, row in enumerate(rows) if any("\n" in cell or "\r" in cell for cell in row))
        raise DatasetError(
            f"{source}, row {first + i + 1}: a cell goes over more than one line.",
            why="tables of any length are read line by line",
            fix="take the line breaks out of the cells, or measure it as a whole",
        )
    for i, row in enumerate(rows):
        if any(row[len(head) :]):  # 1,5 for 1.5 moves all that follow into another column
            raise DatasetError(
                f"{source}, row {first + i + 1} has {len(row)} cells, and there are {len(head)} columns.",
                fix="write decimals with a point, and names with commas in quotes",
            )
    for name in wanted:
        k = head.index(name)
        try:
            columns[name] = np.array([float(row[k]) if row[k] else np.nan for row in rows])
        except (ValueError, IndexError):
            raise _unreadable(source, rows, k, name, first) from None
    return columns, [row[head.index("point")] for row in rows] if "point" in head else None


def _unreadable(source: Path, rows: list[list[str]], k: int, name: str, first: int) -> DatasetError:
    """Which row of a table it is that has no number."""
    for i, row in enumerate(rows):
        try:
            float(row[k] or "nan")
        except (ValueError, IndexError):
            cell = row[k] if k < len(row) else "nothing"
            place = f"{source}, row {first + i + 1}"
            return DatasetError(f"{place}: {name} is {cell!r}.", fix="write a number, or leave the cell empty")
    raise AssertionError("all rows can be read")


def _read_parquet(source: Path, names: tuple[str, ...], size: int, skip: int) -> Iterator[Part]:
    parquet = import_extra("pyarrow.parquet", "parquet", "reading Parquet")
    pyarrow = import_extra("pyarrow", "parquet", "reading Parquet")
    first = skip * size
    try:
        file = parquet.ParquetFile(source)
        head = list(file.schema_arrow.names)
        wanted, _ = _wanted(source, head, names)
        for name in wanted:
            _refuse_no_numbers(source, name, file.schema_arrow.field(name).type)
        named = ["point"] if "point" in head else []
        for batch in _in_parts(_batches_from(file, first, size, [*wanted, *named]), size):
            columns = {name: _numbers(source, name, batch.column(name), first) for name in wanted}
            points = [_name(value) for value in batch.column("point").to_pylist()] if named else None
            yield Part(points, _pixels(columns, names, batch.num_rows))
            first += batch.num_rows
    except pyarrow.ArrowException as error:
        raise DatasetError(
            f"{source} cannot be read as Parquet.", why=" ".join(str(error).split()), fix="check the file"
        ) from error


def _refuse_no_numbers(source: Path, name: str, kind: Any) -> None:
    """Refuse a column of a type that pyarrow would make numbers of, such as dates."""
    types = import_extra("pyarrow.types", "parquet", "reading Parquet")
    kind = kind.value_type if types.is_dictionary(kind) else kind
    numbers = (types.is_integer, types.is_floating, types.is_decimal, types.is_null, *_texts(types))
    if not any(test(kind) for test in numbers):
        raise DatasetError(f"{source}: {name} is of the type {kind}.", fix="write pixels as numbers")


def _texts(types: Any) -> tuple[Callable[[Any], bool], ...]:
    return types.is_string, types.is_large_string


def _numbers(source: Path, name: str, column: Any, first: int) -> Floats:
    """A column of Parquet; where it is text, an error names the row."""
    values = column.to_numpy(zero_copy_only=False)
    if values.dtype.kind != "O":
        return np.asarray(values, dtype=np.float64)
    numbers = np.full(len(values), np.nan)
    for i, value in enumerate(values):
        if value is not None and value != "":
            try:
                numbers[i] = float(value)
            except ValueError:
                raise DatasetError(
                    f"{source}, row {first + i + 1}: {name} is {value!r}.",
                    fix="write a number, or leave the cell empty",
                ) from None
    return numbers


def _name(value: Any) -> str:
    """The name of a point; pandas makes 7.0 of a number 7 where others of the column are missing."""
    if value is None or value != value:
        return ""
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)


def _batches_from(file: Any, first: int, size: int, columns: list[str]) -> Iterator[Any]:
    """Batches of Parquet from a row on; row groups before it are not read."""
    ends = np.cumsum([0, *(file.metadata.row_group(i).num_rows for i in range(file.num_row_groups))])
    groups = np.flatnonzero(ends[1:] > first).tolist()
    if not groups:
        return
    skip = first - int(ends[groups[0]])
    for batch in file.iter_batches(size, row_groups=groups, columns=columns):
        if skip < batch.num_rows:
            yield batch.slice(skip)
        skip = max(0, skip - batch.num_rows)


def _in_parts(batches: Iterator[Any], size: int) -> Iterator[Any]:
    """Batches end with row groups; parts do not."""
    pyarrow = import_extra("pyarrow", "parquet", "reading Parquet")
    kept: list[Any] = []
    rows = 0
    for batch in batches:
        kept.append(batch)
        rows += batch.num_rows
        while rows >= size:
            table = pyarrow.Table.from_batches(kept).combine_chunks()
            yield table.slice(0, size).combine_chunks().to_batches()[0]
            kept = table.slice(size).to_batches()
            rows -= size
    if rows:
        yield pyarrow.Table.from_batches(kept).combine_chunks().to_batches()[0]


def _read_npz(source: Path, names: tuple[str, ...], size: int, skip: int) -> Iterator[Part]:
    try:
        with np.load(source, allow_pickle=False) as file:
            uv = np.asarray(file["uv"], dtype=np.float64)
            given = [str(name) for name in file["cameras"]] if "cameras" in file else list(names)
            points = file.get("point")
    except (KeyError, ValueError, zipfile.BadZipFile) as error:
        raise DatasetError(
            f"{source} has no pixels.", why=str(error), fix="numpy.savez(path, uv=..., cameras=[...])"
        ) from error
    if uv.ndim != 3 or uv.shape[1:] != (len(given), 2):
        raise DatasetError(
            f"{source}: uv has the shape {uv.shape}; (points, {len(given)}, 2) is wanted.",
            why=f"the cameras are {', '.join(given)}",
            fix="numpy.savez(path, uv=..., cameras=[...])",
        )
    _wanted(source, [f"{axis}_{name}" for name in given for axis in "uv"], names)
    order = [given.index(name) if name in given else -1 for name in names]
    for i in range(skip * size, len(uv), size):
        some = uv[i : i + size, order]
        some[:, [k < 0 for k in order]] = np.nan
        yield Part(None if points is None else [str(name) for name in points[i : i + size]], np.ascontiguousarray(some))


_READERS: dict[str, Callable[[Path, tuple[str, ...], int, int], Iterator[Part]]] = {
    ".csv": _read_csv,
    ".parquet": _read_parquet,
    ".npz": _read_npz,
}


# ---- writing ---------------------------------------------------------------------------------------------------------


def _columns(points: list[str], found: MeasuredPixels, doubtful: bool) -> dict[str, Any]:
    """The columns of measured.csv."""
    numbers = np.concatenate([found.xyz, found.sd, found.cov[:, [0, 0, 1], [1, 2, 2]]], axis=1).T
    reason: Names = found.reason
    if doubtful:
        words = [f"{DOUBTFUL}; {text}" if text else DOUBTFUL for text in reason.tolist()]
        reason = np.array(words, dtype=np.str_)
    last = (found.views, found.consistency, reason, found.share_calibration)
    return dict(zip(MEASURED_COLUMNS, (points, *numbers, *last), strict=True))


def write_part(path: Path, ending: str, points: list[str], found: MeasuredPixels, doubtful: bool) -> None:
    """Write a part that stands alone.

    Args:
        path: The file.
        ending: Of what it will be called.
        points: (n,) names.
        found: What was measured.
        doubtful: Whether the part contradicts the calibration.
    """
    _WRITERS[ending](path, points, found, doubtful)
    if ending == ".csv":
        path.write_bytes((",".join(MEASURED_COLUMNS) + "\n").encode() + path.read_bytes())


def _write_csv(path: Path, points: list[str], found: MeasuredPixels, doubtful: bool) -> None:
    columns = _columns([guard_cell(name) for name in points], found, doubtful)
    if find_spec("pyarrow") is not None:
        arrow = import_extra("pyarrow.csv", "parquet", "CSV")
        arrow.write_csv(_arrow(columns), path, arrow.WriteOptions(include_header=False, quoting_style="needed"))
        return
    cells = [
        format_cells(v) if v.dtype.kind == "f" else map(str, v.tolist()) for v in map(np.asarray, columns.values())
    ]
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(zip(*cells, strict=True))


def _arrow(columns: Mapping[str, Any]) -> Any:
    """The columns of measured.csv as a table of pyarrow; NaN is no number."""
    pyarrow, table = import_extra("pyarrow", "parquet", "writing Parquet"), {}
    for name, values in columns.items():
        if isinstance(values, np.ndarray) and values.dtype.kind == "f":
            table[name] = pyarrow.array(values, pyarrow.float64(), from_pandas=True)
        else:
            table[name] = pyarrow.array(list(values), pyarrow.int64() if name == "views" else pyarrow.string())
    return pyarrow.table(table)


def _write_parquet(path: Path, points: list[str], found: MeasuredPixels, doubtful: bool) -> None:
    parquet = import_extra("pyarrow.parquet", "parquet", "writing Parquet")
    parquet.write_table(_arrow(_columns(points, found, doubtful)), path)


def _write_npz(path: Path, points: list[str], found: MeasuredPixels, doubtful: bool) -> None:
    arrays = {name: getattr(found, name) for name in ARRAYS}
    with path.open("wb") as file:
        np.savez(file, point=np.array(points, dtype=np.str_), **arrays)


def _join_csv(path: Path, parts: list[Path]) -> None:
    with path.open("wb") as file:
        file.write((",".join(MEASURED_COLUMNS) + "\n").encode())
        for part in parts:
            with part.open("rb") as one:
                shutil.copyfileobj(one, file, 1 << 20)


def _join_parquet(path: Path, parts: list[Path]) -> None:
    parquet = import_extra("pyarrow.parquet", "parquet", "writing Parquet")
    writer = None
    try:
        for part in parts:
            table = parquet.read_table(part)
            writer = writer or parquet.ParquetWriter(path, table.schema)
            writer.write_table(table)
    finally:
        if writer is not None:
            writer.close()


def _join_npz(path: Path, parts: list[Path]) -> None:
    """One array after the other, so that no more than a part is in memory."""
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("point", *ARRAYS):
            sides, types = [], []
            for part in parts:
                array = _member(part, name)
                sides.append(array.shape)
                types.append(array.dtype)
            dtype = np.result_type(*types) if types else np.dtype(np.float64)
            shape = (sum(side[0] for side in sides), *(sides[0][1:] if sides else ()))
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                head = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
                header = io.BytesIO()
                np.lib.format.write_array_header_1_0(header, head)
                file.write(header.getvalue())
                for part in parts:
                    file.write(np.ascontiguousarray(_member(part, name), dtype=dtype).tobytes())


def _member(part: Path, name: str) -> NDArray[Any]:
    with np.load(part, allow_pickle=False) as file:
        return np.asarray(file[name])


_WRITERS: dict[str, Callable[[Path, list[str], MeasuredPixels, bool], None]] = {
    ".csv": _write_csv,
    ".parquet": _write_parquet,
    ".npz": _write_npz,
}
_JOINERS: dict[str, Callable[[Path, list[Path]], None]] = {
    ".csv": _join_csv,
    ".parquet": _join_parquet,
    ".npz": _join_npz,
}
