"""A dataset as one table: x,y,z,u_cam1,v_cam1,... in CSV or Parquet, or as the arrays of an NPZ.

The table has one row per point; an empty cell is a missing view. What dataset.toml says (name, unit, image sizes)
travels in `<file>.csv.toml` beside a CSV, in the schema of a Parquet file, in the array `dataset` of an NPZ. A table
without it is one that people bring: sheet.py reads it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.arrays import default_names
from implicam.dataset.excel import DESCRIPTION_SHEET, read_excel, write_excel
from implicam.dataset.folder import csv_text, description_text, format_cells
from implicam.dataset.model import (
    SD_POINT,
    SD_VIEW,
    WIDE_TABLE,
    Camera,
    Dataset,
    Floats,
    KnownPositions,
    Observations,
    check_name,
    check_unique,
    check_views,
)
from implicam.dataset.sheet import EXAMPLE_HEADER, Sheet, cell_text, read_sheet, sheet_of_text
from implicam.dataset.tables import (
    Columns,
    NumberColumn,
    Row,
    check_headings,
    description_from_toml,
    naming,
    parse_toml,
    read_columns,
    read_table,
    read_toml,
    require_file,
)
from implicam.dataset.units import UNKNOWN_UNIT
from implicam.errors import DatasetError, ImplicamError, did_you_mean, import_extra
from implicam.files import npz_bytes, read_npz, replacing, toml_text, write_text


@dataclass(frozen=True)
class _Layout:
    """Which column holds what."""

    cameras: tuple[Camera, ...]
    view_extra: tuple[str, ...]
    point_extra: tuple[str, ...]
    name: str
    unit: str
    extra: dict[str, Any]

    def numbers(self) -> list[str]:
        views = [f"{q}_{camera.name}" for camera in self.cameras for q in ("u", "v", *SD_VIEW)]
        return ["x", "y", "z", *SD_POINT, *views]


def _description_path(path: Path) -> Path:
    return path.with_name(path.name + ".toml")  # not rig.toml, which may be anything


def _described_layout(header: list[str], description: dict[str, Any], path: Path) -> _Layout:
    """The layout of a table with a description, which leaves nothing to be guessed."""
    meta = description.get(WIDE_TABLE, {})
    listed = meta.get("view_columns", ()) if isinstance(meta, dict) else ()
    view_extra = tuple(map(str, listed)) if isinstance(listed, list) else ()
    name, unit, cameras, extra = description_from_toml(description, path)
    known = [camera.name for camera in cameras]
    for camera in _cameras_named(header):
        if camera not in known:
            raise DatasetError(
                f"{path}, line 1: the columns u_{camera} and v_{camera} belong to no camera of the description"
                f"{did_you_mean(camera, known)}.",
                fix=f"the cameras are {', '.join(known)}; rename the columns, or add a [[cameras]] table",
            )
    columns = set(header)
    if len(columns & set("xyz")) not in (0, 3):
        raise DatasetError(f"{path}, line 1: x, y and z must all be there, or none.", fix="add the missing column")
    for column in (f"{q}_{camera.name}" for camera in cameras for q in "uv"):
        if column not in columns:
            raise DatasetError(f"{path}, line 1: the column {column!r} is missing.", fix="every camera needs u_ and v_")
    taken = {"point", "shot", "x", "y", "z", *SD_POINT}
    taken |= {f"{q}_{c.name}" for c in cameras for q in ("u", "v", *SD_VIEW, *view_extra)}
    point_extra = tuple(column for column in header if column not in taken)
    return _Layout(cameras, view_extra, point_extra, name, unit, extra)


def read_brought(sheet: Sheet, path: Path, unit: str | None) -> Dataset:
    """The dataset of a table that has no description; its name is that of the file.

    Args:
        sheet: The table.
        path: The file.
        unit: The length unit; None where the headings state it.

    Raises:
        DatasetError: The unit is not stated, there are two ways to read the table, or it has a mistake.
    """
    brought = read_sheet(sheet)
    if unit is None and not brought.unit and "x" in brought.columns.numbers:
        raise DatasetError(
            f"{path}: {_UNIT_MISSING}",
            why=f"a table carries it in {_description_path(path).name} beside it, which is not there"
            if path.suffix.lower() == ".csv"
            else "no heading says it",
            fix='add --unit mm, or unit="mm" in read_dataset(...)',
        )
    if unit is not None and brought.unit not in ("", unit):
        raise DatasetError(
            f"{path} is in {brought.unit!r}, not in {unit!r}.",
            why="the headings of x, y and z say so",
            fix="leave out --unit, or correct the headings",
        )
    with naming(path):
        cameras = tuple(Camera(name) for name in brought.cameras)
        stated = unit or brought.unit or UNKNOWN_UNIT
        layout = _Layout(cameras, brought.views, brought.further, path.stem, stated, {})
        return replace(_assemble(brought.columns, layout), notes=brought.notes)


_UNIT_MISSING = "the length unit of x, y, z is not stated."


def is_unit_missing(error: DatasetError) -> bool:
    """Whether a table could not be read only because it does not state its length unit.

    Args:
        error: Of reading it.
    """
    return error.what.endswith(_UNIT_MISSING)


def _cameras_named(header: Iterable[str]) -> list[str]:
    """The cameras that have both a column u_ and a column v_."""
    columns = list(header)
    second = {column[2:] for column in columns if column.startswith("v_")}
    return [column[2:] for column in columns if column.startswith("u_") and column[2:] in second]


def _assemble(table: Columns, layout: _Layout) -> Dataset:
    """A dataset from the columns of a wide table."""
    cameras = layout.cameras

    def views(columns: tuple[str, str]) -> Floats:
        names = [f"{column}_{camera.name}" for camera in cameras for column in columns]
        return table.stack(names).reshape(table.n, len(cameras), 2)

    uv, sd = views(("u", "v")), views(SD_VIEW)
    check_views(uv, sd, cameras, lambda i, k: table.place(i))
    points = table.texts.get("point", default_names(table.n))
    check_unique(points, "point", table.place)
    empty = [""] * table.n
    view_extra = {
        key: np.array([table.texts.get(f"{key}_{c.name}", empty) for c in cameras], dtype=np.str_).T
        for key in layout.view_extra
    }
    observations = Observations(np.array(points, dtype=np.str_), cameras, uv, sd, view_extra)
    known = None
    if "x" in table.numbers:
        for i in np.flatnonzero(np.isnan(table.stack("xyz")).any(axis=1))[:1]:
            raise DatasetError(
                f"{table.place(i)}: point {points[i]!r} has no known position.",
                fix="fill in x, y and z, remove the row, or leave the columns x, y, z out altogether to measure the "
                "points",
            )
        known = table.known_positions(points, layout.point_extra)
    columns = {} if known else {c: np.array(table.texts[c], dtype=np.str_) for c in layout.point_extra}
    return Dataset(layout.name, layout.unit, observations, known, layout.extra, columns=columns)


def read_wide_csv(path: Path, unit: str | None = None, cameras: Sequence[str] = ()) -> Dataset:
    """Read `x,y,z,u_cam1,v_cam1,...`, with or without point, shot, sd_x, sd_u_cam1 and further columns.

    A table without a description may be written as people write it, see `read_sheet`.

    Args:
        path: The file; its description is read from `<name>.csv.toml` beside it, where that is there.
        unit: The length unit where there is no description; else it is not used.
        cameras: Names that cameras are known to have; not used either where there is a description.

    Raises:
        DatasetError: The unit is not stated, or there is a mistake; names file, line, value and cure.
    """
    sidecar = _description_path(path)
    if not sidecar.exists():
        return read_brought(sheet_of_text(path, cameras), path, unit)
    header, rows = read_table(path, (), EXAMPLE_HEADER)
    layout = _described_layout(header, read_toml(sidecar), path)
    numbers = dict.fromkeys(layout.numbers(), NumberColumn("leave the cell empty where there is no value", ("", "nan")))
    table = read_columns(path, header, rows, ("point", "shot"), numbers)
    if not table.n:
        raise DatasetError(f"{path} has a header and no rows.", fix="add one row per point")
    with naming(path):
        return _assemble(table, layout)


def make_columns(data: Dataset) -> tuple[dict[str, NDArray[Any]], str]:
    """The columns of the table, and the text of its description.

    Args:
        data: The dataset.

    Returns:
        The columns, numbers or text, (n,) each; and TOML.

    Raises:
        DatasetError: It has no points, or two columns would have the same name.
    """
    if not len(data):
        raise DatasetError(f"dataset {data.name!r} has no points.", fix="a table needs one; write it as .npz")
    observations = data.observations
    columns: dict[str, NDArray[Any]] = {"point": data.points}
    if data.known:
        columns |= {"shot": data.known.shots, **dict(zip("xyz", data.known.xyz.T, strict=True))}
        columns |= {c: v for c, v in zip(SD_POINT, data.known.sd.T, strict=True) if not np.isnan(v).all()}
    for k, camera in enumerate(data.cameras):
        columns |= {
            f"u_{camera.name}": observations.uv[:, k, 0],
            f"v_{camera.name}": observations.uv[:, k, 1],
        }
        if not np.isnan(observations.sd).all():
            columns |= {f"sd_{q}_{camera.name}": observations.sd[:, k, i] for i, q in enumerate("uv")}
    view_extra = [
        (f"{key}_{c.name}", v[:, k]) for key, v in observations.extra.items() for k, c in enumerate(data.cameras)
    ]
    extra = [*(data.known.extra if data.known else data.columns).items(), *view_extra]
    _check_distinct(data.cameras, [column for column, _ in extra])
    description = parse_toml(description_text(data))
    if observations.extra:
        description = {WIDE_TABLE: {"view_columns": list(observations.extra)}, **description}
    return {**columns, **dict(extra)}, toml_text(description)


def _check_distinct(cameras: tuple[Camera, ...], extra: list[str]) -> None:
    """Refuse extra columns that a reader could take for something else, or for each other."""
    taken = {"point", "shot", *_Layout(cameras, (), (), "", "", {}).numbers()}
    taken |= {column for column, times in Counter(extra).items() if times > 1}
    taken |= {f"u_{name}" for name in _cameras_named([*extra, *taken])}
    for column in extra:
        if column in taken:
            raise DatasetError(
                f"the extra column {column!r} could be mistaken for another in one wide table.",
                fix="rename it, or write the dataset as a folder or NPZ",
            )
        with naming("as a wide table"):
            check_name(column, "column name")


def write_wide_csv(data: Dataset, path: Path) -> None:
    """Write one wide CSV, and its description beside it as `<name>.csv.toml`.

    Two files cannot change at one instant. Where the description changes, the old one goes first: a kill in between
    leaves a table without a description, which reading reports, never a table with the description of another.

    Args:
        data: The dataset.
        path: The file; one that is there is replaced.

    Raises:
        DatasetError: A table cannot hold the dataset: it has no points, or a column that could be mistaken for another.
        ImplicamError: The files cannot be written.
    """
    columns, description = make_columns(data)
    text = [v.tolist() if v.dtype.kind == "U" else format_cells(v) for v in columns.values()]
    sidecar = _description_path(path)
    unchanged = sidecar.is_file() and sidecar.read_bytes() == description.encode()
    if not unchanged:
        sidecar.unlink(missing_ok=True)
    write_text(path, csv_text(list(columns), zip(*text, strict=True)))
    if not unchanged:
        write_text(sidecar, description)


def read_excel_workbook(path: Path, unit: str | None = None, cameras: Sequence[str] = ()) -> Dataset:
    """Read a wide table from Excel's .xlsx.

    Args:
        path: The file.
        unit: The length unit where the workbook has no description; else it is not used.
        cameras: Names that cameras are known to have; not used either where there is a description.

    Raises:
        DatasetError: It is no workbook, the unit is not stated, or there is a mistake; names the sheet and the row.
        MissingExtraError: openpyxl is not installed.
    """
    sheet, text = read_excel(path, cameras)
    if text is None:
        return read_brought(sheet, path, unit)
    try:
        description = parse_toml(text)
    except ValueError as error:
        raise DatasetError(
            f"{path}, sheet {DESCRIPTION_SHEET!r}: not valid TOML: {error}.", fix="write it again, or delete the sheet"
        ) from None
    check_headings(sheet.header_place, sheet.header)
    layout = _described_layout(sheet.header, description, path)
    numbers = dict.fromkeys(layout.numbers(), NumberColumn("leave the cell empty where there is no value", ("", "nan")))
    table = read_columns(sheet.place, sheet.header, sheet.rows(), (), numbers, sheet.unit)
    with naming(path):
        return _assemble(table, layout)


def write_excel_workbook(data: Dataset, path: Path) -> None:
    """Write a wide table as Excel's .xlsx, its description on a sheet beside it.

    Args:
        data: The dataset.
        path: The file; one that is there is replaced.

    Raises:
        DatasetError: A table cannot hold the dataset: it has no points, or a column that could be mistaken for another.
        MissingExtraError: openpyxl is not installed.
        ImplicamError: The file cannot be written.
    """
    columns, description = make_columns(data)
    cells = [(name, [None if value != value else value for value in v.tolist()]) for name, v in columns.items()]
    write_excel(path, cells, description)


def _sheet_of_columns(path: Path, header: list[str], columns: list[list[str]]) -> Sheet:
    """A Parquet file without a description as a sheet."""

    def rows() -> Iterator[Row]:
        return ((i, list(row)) for i, row in enumerate(zip(*columns, strict=True), 1))

    return Sheet(str(path), header, rows, unit="row", first=0)


def read_parquet(path: Path, unit: str | None = None, cameras: Sequence[str] = ()) -> Dataset:
    """Read a wide table from Parquet.

    Args:
        path: The file.
        unit: The length unit where the file has no description; else it is not used.
        cameras: Names that cameras are known to have; not used either where there is a description.

    Raises:
        DatasetError: It is no readable Parquet file, the unit is not stated, or it has a mistake.
        MissingExtraError: pyarrow is not installed.
    """
    parquet = import_extra("pyarrow.parquet", "parquet", "reading Parquet")
    arrow = import_extra("pyarrow", "parquet", "reading Parquet")
    require_file(path, "check the name")
    try:
        # pre_buffer and threads off: a damaged file is to fail here, not in another thread
        table = parquet.ParquetFile(path, pre_buffer=False).read(use_threads=False)
        metadata = table.schema.metadata or {}
        description = parse_toml(metadata[b"implicam"].decode()) if b"implicam" in metadata else None
        columns = {c: table.column(i).to_pylist() for i, c in enumerate(table.column_names)}
        names = list(table.column_names)
    except (arrow.ArrowException, OSError, ValueError, TypeError, KeyError, OverflowError, MemoryError) as error:
        raise DatasetError(
            f"{path} is not a readable Parquet file.", why=str(error)[:300], fix="write it again"
        ) from None
    for column, times in Counter(names).items():
        if times > 1:
            raise DatasetError(f"{path}: the column {column[:60]!r} is there {times} times.", fix="leave one out")
    if description is None:
        text = [[cell_text(value) for value in column] for column in columns.values()]
        return read_brought(replace(_sheet_of_columns(path, names, text), cameras=tuple(cameras)), path, unit)
    layout = _described_layout(names, description, path)
    numeric = set(layout.numbers())
    numbers = {c: _read_numbers(v, c, path) for c, v in columns.items() if c in numeric}
    texts = {c: _read_texts(v, c, path) for c, v in columns.items() if c not in numeric}
    with naming(path):
        return _assemble(Columns(texts, numbers, table.num_rows, lambda i: f"{path}, row {i + 1}"), layout)


def _read_numbers(values: list[Any], column: str, path: Path) -> Floats:
    """A column of Parquet as numbers, NaN where there is none."""
    _check_types(values, (int, float), "a number", column, path)
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _read_texts(values: list[Any], column: str, path: Path) -> list[str]:
    """A column of Parquet as text, empty where there is none."""
    _check_types(values, str, "text", column, path)
    return [value or "" for value in values]


def _check_types(values: list[Any], wanted: type | tuple[type, ...], what: str, column: str, path: Path) -> None:
    for i, value in enumerate(values):
        if value is not None and (not isinstance(value, wanted) or isinstance(value, bool)):
            raise DatasetError(
                f"{path}, row {i + 1}: {column} = {str(value)[:60]!r} is not {what}.",
                fix="convert the column, or leave it out",
            )


def write_parquet(data: Dataset, path: Path) -> None:
    """Write a wide table as Parquet; NaN is written as NaN.

    Args:
        data: The dataset.
        path: The file; one that is there is replaced.

    Raises:
        DatasetError: A table cannot hold the dataset: it has no points, or a column that could be mistaken for another.
        MissingExtraError: pyarrow is not installed.
        ImplicamError: The file cannot be written.
    """
    pyarrow = import_extra("pyarrow", "parquet", "writing Parquet")
    parquet = import_extra("pyarrow.parquet", "parquet", "writing Parquet")
    columns, description = make_columns(data)
    table = pyarrow.table({c: pyarrow.array(v.tolist()) for c, v in columns.items()})
    with replacing(path) as temporary:
        parquet.write_table(table.replace_schema_metadata({"implicam": description}), temporary)


def arrays_from_dataset(data: Dataset) -> dict[str, NDArray[Any]]:
    """The dataset as named arrays without objects; what an NPZ and a calibration file carry.

    Args:
        data: The dataset.

    Returns:
        Name -> array; those of positions only where they are known.

    Raises:
        DatasetError: The description cannot be written so that it can be read again.
    """
    o, k = data.observations, data.known
    arrays: dict[str, NDArray[Any]] = {
        "dataset": np.array(description_text(data)),
        "points": o.points,
        "uv": o.uv,
        "uv_sd": o.sd,
        "view_columns": np.array(list(o.extra), dtype=np.str_),
        "view_text": np.array([*o.extra.values()], dtype=np.str_).reshape(len(o.extra), *o.uv.shape[:2]),
    }
    if k:
        arrays |= {
            "shots": k.shots,
            "xyz": k.xyz,
            "xyz_sd": k.sd,
            "point_columns": np.array(list(k.extra), dtype=np.str_),
            "point_text": np.array([*k.extra.values()], dtype=np.str_).reshape(len(k.extra), len(data)),
        }
    elif data.columns:
        arrays |= {
            "point_columns": np.array(list(data.columns), dtype=np.str_),
            "point_text": np.array([*data.columns.values()], dtype=np.str_).reshape(len(data.columns), len(data)),
        }
    return arrays


def dataset_from_arrays(arrays: Mapping[str, NDArray[Any]], path: Path) -> Dataset:
    """The dataset of named arrays, the inverse of `arrays_from_dataset`.

    Args:
        arrays: Name -> array.
        path: The file that they come from, for errors.

    Raises:
        DatasetError: One is missing, or they do not fit together.
    """
    try:
        with naming(path):
            description = parse_toml(str(arrays["dataset"][()]))
            name, unit, cameras, extra = description_from_toml(description, path)
            view_extra = dict(zip(arrays["view_columns"].tolist(), arrays["view_text"], strict=True))
            observations = Observations(arrays["points"], cameras, arrays["uv"], arrays["uv_sd"], view_extra)
            known, columns = None, {}
            if "xyz" in arrays or "point_columns" in arrays:
                columns = dict(zip(arrays["point_columns"].tolist(), arrays["point_text"], strict=True))
            if "xyz" in arrays:
                known = KnownPositions(arrays["shots"], arrays["xyz"], arrays["xyz_sd"], columns)
            return Dataset(name, unit, observations, known, extra, columns={} if known else columns)
    except KeyError as error:
        raise DatasetError(f"{path} has no array {error}.", fix="write it again with implicam") from None
    except (ValueError, TypeError, IndexError) as error:
        raise DatasetError(f"{path}: its arrays do not fit together.", why=str(error)) from None


def read_npz_dataset(path: Path) -> Dataset:
    """Read a dataset from NPZ, never with pickle.

    Args:
        path: The file.

    Raises:
        DatasetError: It is no NPZ file, is damaged, or its arrays do not fit together.
    """
    require_file(path, "check the name")
    with path.open("rb") as file:
        if file.read(2) != b"PK":
            raise DatasetError(f"{path} is not an NPZ file.", fix="write it with implicam")
    arrays = read_npz(path, lambda reason: _damaged_error(path, reason))
    return dataset_from_arrays(arrays, path)


def _damaged_error(path: Path, reason: str) -> ImplicamError:
    return DatasetError(f"{path} is damaged: {reason}.", fix="write it again with implicam")


def write_npz_dataset(data: Dataset, path: Path) -> None:
    """Write a dataset as NPZ.

    Args:
        data: The dataset.
        path: The file; one that is there is replaced.

    Raises:
        DatasetError: The description cannot be written so that it can be read again.
        ImplicamError: The file cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(npz_bytes(arrays_from_dataset(data)))
