"""A dataset as one table: x,y,z,u_cam1,v_cam1,... in CSV or Parquet, or as the arrays of an NPZ.

The table has one row per point; an empty cell is a missing view. What dataset.toml says (name, unit, image sizes)
travels in `<file>.toml` beside a CSV, in the schema of a Parquet file, in the array `dataset` of an NPZ. A CSV
without it still reads: name from the file, cameras from the columns, image sizes unknown, unit from `unit`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.folder import SD_POINT, SD_VIEW, cell, check_inside, csv_text, description_text
from implicam.dataset.model import Camera, Dataset, Floats, KnownPositions, Names, Observations
from implicam.dataset.tables import description_from_toml, number, parse_toml, read_table, read_toml
from implicam.errors import DatasetError, ImplicamError, import_extra
from implicam.files import npz_bytes, read_npz, replacing, toml_text, write_text

_META = "wide_table"  # the table of the sidecar that tells apart columns a name alone cannot


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


def _layout(header: list[str], description: dict[str, Any] | None, path: Path, unit: str | None) -> _Layout:
    extra: dict[str, Any] = {}
    view_extra: tuple[str, ...] = ()
    if description is None:
        if unit is None:
            raise DatasetError(
                f"{path}: the length unit of x, y, z is not stated.",
                why=f"a wide CSV carries it in {path.with_suffix('.toml').name} beside it, which is not there",
                fix='add --unit mm, or unit="mm" in read_dataset(...)',
            )
        cameras = tuple(
            Camera(column[2:]) for column in header if column.startswith("u_") and "v_" + column[2:] in header
        )
        name = path.stem
    else:
        described = dict(description)
        meta = described.pop(_META, {})
        view_extra = tuple(map(str, meta.get("view_columns", ()))) if isinstance(meta, dict) else ()
        name, unit, cameras, extra = description_from_toml(described, path)
    if not cameras:
        raise DatasetError(
            f"{path}, line 1: there are no camera columns.", fix="name them u_cam1,v_cam1,u_cam2,v_cam2, ..."
        )
    for column in (f"{q}_{camera.name}" for camera in cameras for q in "uv"):
        if column not in header:
            raise DatasetError(f"{path}, line 1: the column {column!r} is missing.", fix="every camera needs u_ and v_")
    taken = {"point", "shot", "x", "y", "z", *SD_POINT}
    taken |= {f"{q}_{c.name}" for c in cameras for q in ("u", "v", *SD_VIEW, *view_extra)}
    point_extra = tuple(column for column in header if column not in taken)
    return _Layout(cameras, view_extra, point_extra, name, unit, extra)


Cells = Mapping[str, NDArray[Any]]


def _assemble(cells: Cells, layout: _Layout, n: int, place: Callable[[int], str]) -> Dataset:
    """A dataset from number columns (NaN where empty) and text columns."""
    nan = np.full(n, np.nan)
    text = np.full(n, "")
    cameras = layout.cameras

    def views(first: str, second: str) -> Floats:
        columns = [[cells.get(f"{q}_{c.name}", nan) for q in (first, second)] for c in cameras]
        return np.array(columns, dtype=np.float64).reshape(len(cameras), 2, n).transpose(2, 0, 1)

    uv = views("u", "v")
    half = np.isnan(uv[..., 0]) != np.isnan(uv[..., 1])
    for i, k in np.argwhere(half)[:1]:
        raise DatasetError(
            f"{place(i)}: only one of u_{cameras[k].name} and v_{cameras[k].name} is there.",
            fix="a missing view leaves both empty",
        )
    check_inside(uv, cameras, lambda i, k: place(i))
    points = cells.get("point", np.array([f"p{i + 1:04d}" for i in range(n)]))
    view_extra = {
        key: np.stack([cells.get(f"{key}_{c.name}", text) for c in cameras], axis=1).astype(np.str_)
        for key in layout.view_extra
    }
    observations = Observations(points, cameras, uv, views(*SD_VIEW), view_extra)
    known = _known(cells, layout, points, place) if "x" in cells else None
    return Dataset(layout.name, layout.unit, observations, known, layout.extra)


def _known(cells: Cells, layout: _Layout, points: Names, place: Callable[[int], str]) -> KnownPositions:
    xyz = np.stack([cells[axis] for axis in "xyz"], axis=1)
    for i in np.flatnonzero(np.isnan(xyz).any(axis=1))[:1]:
        raise DatasetError(
            f"{place(i)}: point {str(points[i])!r} has no known position.",
            fix="fill in x, y and z, remove the row, or leave the columns x, y, z out altogether to measure the points",
        )
    nan = np.full(len(points), np.nan)
    sd = np.stack([cells.get(c, nan) for c in SD_POINT], axis=1)
    extra = {c: cells[c].astype(np.str_) for c in layout.point_extra}
    return KnownPositions(cells.get("shot", points), xyz, sd, extra)


def read_wide_csv(path: Path, unit: str | None = None) -> Dataset:
    """Read `x,y,z,u_cam1,v_cam1,...`, with or without point, shot, sd_x, sd_u_cam1 and further columns."""
    header, rows = read_table(path, ())
    sidecar = path.with_suffix(".toml")
    layout = _layout(header, read_toml(sidecar) if sidecar.exists() else None, path, unit)
    for axis in "xyz":
        if ("x" in header) != (axis in header):
            raise DatasetError(f"{path}, line 1: x, y and z must all be there, or none.", fix="add the missing column")
    numeric = set(layout.numbers()) & set(header)
    columns: dict[str, list[Any]] = {column: [] for column in header}
    lines = []
    for line, row in rows:
        lines.append(line)
        for column, text in zip(header, row, strict=True):
            value = _optional(text, f"{path}, line {line}", column) if column in numeric else text
            columns[column].append(value)
    if not lines:
        raise DatasetError(f"{path} has a header and no rows.", fix="add one row per point")
    cells = {c: np.array(v, dtype=np.float64 if c in numeric else np.str_) for c, v in columns.items()}
    return _named(path, lambda: _assemble(cells, layout, len(lines), lambda i: f"{path}, line {lines[i]}"))


def _optional(text: str, place: str, column: str) -> float:
    if text == "" or text.lower() == "nan":  # in a wide table this is how a missing view is written
        return float("nan")
    return number(text, place, column, cure_nan="leave the cell empty where there is no value")


def _named(path: Path, read: Callable[[], Dataset]) -> Dataset:
    """Put the file's name before an error of the values themselves."""
    try:
        return read()
    except DatasetError as error:
        if str(path) in error.what:
            raise
        raise DatasetError(f"{path}: {error.what}", why=error.why, fix=error.fix) from None


def _columns(data: Dataset) -> tuple[dict[str, NDArray[Any]], str]:
    """The columns of the table (numbers or text), and the sidecar's text."""
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
    view_extra = {
        f"{key}_{c.name}": v[:, k] for key, v in observations.extra.items() for k, c in enumerate(data.cameras)
    }
    point_extra = dict(data.known.extra) if data.known else {}
    for column in [*view_extra, *point_extra]:
        clash = column in columns or (column in view_extra and column in point_extra)
        if clash or (column in SD_POINT):
            raise DatasetError(
                f"the extra column {column!r} would stand twice in one wide table.",
                fix="rename it, or write the dataset as a folder or NPZ",
            )
    description = parse_toml(description_text(data))
    if observations.extra:
        description = {_META: {"view_columns": list(observations.extra)}, **description}
    return {**columns, **point_extra, **view_extra}, toml_text(description)


def write_wide_csv(data: Dataset, path: Path) -> None:
    """Write one wide CSV, and its description beside it as `<name>.toml`."""
    columns, description = _columns(data)
    cells = [v if v.dtype.kind == "U" else np.array([cell(x) for x in v]) for v in columns.values()]
    write_text(path.with_suffix(".toml"), description)
    write_text(path, csv_text(list(columns), (list(row) for row in zip(*cells, strict=True))))


def read_parquet(path: Path) -> Dataset:
    """Read a wide table from Parquet."""
    parquet = import_extra("pyarrow.parquet", "parquet", "reading Parquet")
    _must_exist(path)
    try:
        table = parquet.read_table(path)
        description = parse_toml((table.schema.metadata or {})[b"implicam"].decode())
        cells = {c: np.array(table.column(c).to_pylist()) for c in table.column_names}
    except KeyError:
        raise DatasetError(
            f"{path} carries no implicam description.",
            why="name, unit and image sizes are kept in the metadata of the schema",
            fix="write it with implicam, or convert it to a wide CSV and state the unit",
        ) from None
    except (OSError, ValueError, TypeError, MemoryError) as error:
        raise DatasetError(
            f"{path} is not a readable Parquet file.", why=str(error)[:300], fix="write it again"
        ) from None
    layout = _layout(table.column_names, description, path, None)
    numeric = set(layout.numbers())
    cells = {c: v.astype(np.float64 if c in numeric else np.str_) for c, v in cells.items()}
    return _named(path, lambda: _assemble(cells, layout, table.num_rows, lambda i: f"{path}, row {i + 1}"))


def write_parquet(data: Dataset, path: Path) -> None:
    """Write a wide table as Parquet; NaN is written as NaN."""
    pyarrow = import_extra("pyarrow", "parquet", "writing Parquet")
    parquet = import_extra("pyarrow.parquet", "parquet", "writing Parquet")
    columns, description = _columns(data)
    table = pyarrow.table({c: pyarrow.array(v.tolist()) for c, v in columns.items()})
    with replacing(path) as temporary:
        parquet.write_table(table.replace_schema_metadata({"implicam": description}), temporary)


def arrays_from_dataset(data: Dataset) -> dict[str, NDArray[Any]]:
    """The dataset as named arrays without objects; what an NPZ and a calibration file carry."""
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
    return arrays


def dataset_from_arrays(arrays: Mapping[str, NDArray[Any]], path: Path) -> Dataset:
    """The inverse; whatever does not fit together is a DatasetError."""
    try:
        description = parse_toml(str(arrays["dataset"][()]))
        name, unit, cameras, extra = description_from_toml(description, path)
        columns = [str(c) for c in arrays["view_columns"]]
        view_extra = dict(zip(columns, arrays["view_text"], strict=True))
        observations = Observations(arrays["points"], cameras, arrays["uv"], arrays["uv_sd"], view_extra)
        known = None
        if "xyz" in arrays:
            columns = [str(c) for c in arrays["point_columns"]]
            point_extra = dict(zip(columns, arrays["point_text"], strict=True))
            known = KnownPositions(arrays["shots"], arrays["xyz"], arrays["xyz_sd"], point_extra)
        return _named(path, lambda: Dataset(name, unit, observations, known, extra))
    except KeyError as error:
        raise DatasetError(f"{path} has no array {error}.", fix="write it again with implicam") from None
    except (ValueError, TypeError, IndexError) as error:
        raise DatasetError(f"{path}: its arrays do not fit together.", why=str(error)) from None


def read_npz_dataset(path: Path) -> Dataset:
    """Read a dataset from NPZ, never with pickle."""
    _must_exist(path)
    with path.open("rb") as file:
        if file.read(2) != b"PK":
            raise DatasetError(f"{path} is not an NPZ file.", fix="write it with implicam")
        file.seek(0)
        content = file.read()
    arrays = read_npz(content, lambda reason: _refused(path, reason))
    return dataset_from_arrays(arrays, path)


def _refused(path: Path, reason: str) -> ImplicamError:
    return DatasetError(f"{path} is damaged: {reason}.", fix="write it again with implicam")


def write_npz_dataset(data: Dataset, path: Path) -> None:
    """Write a dataset as NPZ."""
    with replacing(path) as temporary:
        temporary.write_bytes(npz_bytes(arrays_from_dataset(data)))


def _must_exist(path: Path) -> None:
    if not path.is_file():
        raise DatasetError(f"{path} does not exist.", fix="check the name")
