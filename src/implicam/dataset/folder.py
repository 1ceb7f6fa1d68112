"""A dataset as a folder: dataset.toml, points.csv, observations.csv."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.model import Camera, Dataset, Floats, KnownPositions, Names, Observations
from implicam.dataset.tables import Row, description_from_toml, number, read_table, read_toml
from implicam.errors import DatasetError, did_you_mean
from implicam.files import replacing_folder, toml_text

POINT_COLUMNS = ("point", "shot", "x", "y", "z")
VIEW_COLUMNS = ("point", "camera", "u", "v")
SD_POINT, SD_VIEW = ("sd_x", "sd_y", "sd_z"), ("sd_u", "sd_v")

# A centroid may lie a little outside: half of the ball is still in the image.
OUTSIDE_SHARE, OUTSIDE_PIXELS = 0.02, 2.0

_NO_VIEW = "a view that is missing has no row: remove it"
_NO_SD = "leave the cell empty where no uncertainty is stated"


def read_folder(path: Path) -> Dataset:
    """Read a dataset folder; every mistake is a DatasetError naming file, line, value and cure."""
    toml = path / "dataset.toml"
    name, unit, cameras, extra = description_from_toml(read_toml(toml), toml)
    points = _read_points(path / "points.csv") if (path / "points.csv").exists() else None
    observations = _read_observations(path / "observations.csv", cameras, points)
    return Dataset(name, unit, observations, points.known if points else None, extra)


@dataclass(frozen=True)
class _Points:
    path: Path
    names: list[str]
    known: KnownPositions


def _read_points(path: Path) -> _Points:
    header, rows = read_table(path, POINT_COLUMNS)
    at = {column: header.index(column) for column in header}
    extra_columns = [c for c in header if c not in (*POINT_COLUMNS, *SD_POINT)]
    names: dict[str, int] = {}
    shots, xyz, sd = [], [], []
    extra: dict[str, list[str]] = {c: [] for c in extra_columns}
    for line, row in rows:
        place = f"{path}, line {line}"
        name = _name(row[at["point"]], "point", place)
        if name in names:
            raise DatasetError(
                f"{place}: point {name!r} is there twice (first on line {names[name]}).",
                fix="remove one, or give each point a name of its own",
            )
        names[name] = line
        shots.append(_name(row[at["shot"]], "shot", place))
        xyz.append(
            [
                number(
                    row[at[c]],
                    place,
                    c,
                    cure_nan="a known point needs its position: add it, or remove the point",
                )
                for c in "xyz"
            ]
        )
        sd.append([_sd(row, at, c, place, zero=True) for c in SD_POINT])
        for c in extra_columns:
            extra[c].append(row[at[c]])
    if not names:
        raise DatasetError(
            f"{path} has a header and no rows.",
            fix="add the known positions, or delete the file if they are unknown",
        )
    n = len(names)
    known = KnownPositions(
        np.array(shots, dtype=np.str_),
        np.reshape(xyz, (n, 3)),
        np.reshape(sd, (n, 3)),
        {c: np.array(values, dtype=np.str_) for c, values in extra.items()},
    )
    return _Points(path, list(names), known)


def _read_observations(path: Path, cameras: tuple[Camera, ...], points: _Points | None) -> Observations:
    header, rows = read_table(path, VIEW_COLUMNS)
    index, views = _view_rows(path, header, rows, cameras, points)
    if not views.lines:
        raise DatasetError(f"{path} has a header and no rows.", fix="add one row per view: point,camera,u,v")
    n, c = len(index), len(cameras)
    i, j = np.array(views.point), np.array(views.camera)
    uv, sd = np.full((n, c, 2), np.nan), np.full((n, c, 2), np.nan)
    uv[i, j], sd[i, j] = np.reshape(views.uv, (-1, 2)), np.reshape(views.sd, (-1, 2))
    lines = np.zeros((n, c), dtype=np.int64)
    lines[i, j] = views.lines
    check_inside(uv, cameras, lambda p, k: f"{path}, line {lines[p, k]}")
    extra = {column: _spread(values, i, j, (n, c)) for column, values in views.extra.items()}
    return Observations(np.array(list(index), dtype=np.str_), cameras, uv, sd, extra)


class _Views:
    """The columns of observations.csv as they are read."""

    def __init__(self, extra_columns: Iterable[str]) -> None:
        self.lines: list[int] = []
        self.point: list[int] = []
        self.camera: list[int] = []
        self.uv: list[list[float]] = []
        self.sd: list[list[float]] = []
        self.extra: dict[str, list[str]] = {c: [] for c in extra_columns}


def _view_rows(
    path: Path, header: list[str], rows: Iterable[Row], cameras: tuple[Camera, ...], points: _Points | None
) -> tuple[dict[str, int], _Views]:
    at = {column: header.index(column) for column in header}
    views = _Views(c for c in header if c not in (*VIEW_COLUMNS, *SD_VIEW))
    camera_index = {camera.name: k for k, camera in enumerate(cameras)}
    index = {name: i for i, name in enumerate(points.names)} if points else {}
    seen: dict[tuple[int, int], int] = {}
    for line, row in rows:
        place = f"{path}, line {line}"
        i = _point_index(_name(row[at["point"]], "point", place), index, points, place)
        k = _camera_index(row[at["camera"]], camera_index, place)
        if (i, k) in seen:
            raise DatasetError(
                f"{place}: point {row[at['point']]!r} is seen twice by camera {row[at['camera']]!r} "
                f"(first on line {seen[i, k]}).",
                fix="keep one of the two rows",
            )
        seen[i, k] = line
        views.lines.append(line)
        views.point.append(i)
        views.camera.append(k)
        views.uv.append([number(row[at[c]], place, c, cure_nan=_NO_VIEW) for c in "uv"])
        views.sd.append([_sd(row, at, c, place, zero=False) for c in SD_VIEW])
        for c, values in views.extra.items():
            values.append(row[at[c]])
    return index, views


def _point_index(name: str, index: dict[str, int], points: _Points | None, place: str) -> int:
    if name not in index:
        if points:
            raise DatasetError(
                f"{place}: point {name!r} has no known position in {points.path.name}{did_you_mean(name, index)}.",
                fix=f"add it to {points.path}, remove this row, or measure it from a dataset without points.csv",
            )
        index[name] = len(index)
    return index[name]


def _camera_index(name: str, cameras: dict[str, int], place: str) -> int:
    if name not in cameras:
        raise DatasetError(
            f"{place}: camera {name!r} is not in dataset.toml{did_you_mean(name, cameras)}.",
            fix=f"the cameras are {', '.join(cameras)}; correct the row or add a [[cameras]] table",
        )
    return cameras[name]


def _name(text: str, what: str, place: str) -> str:
    if text == "" or not text.isprintable():
        raise DatasetError(f"{place}: {what} {text!r} is not a name.", fix=f"every row needs a printable {what} name")
    return text


def _sd(row: list[str], at: Mapping[str, int], column: str, place: str, *, zero: bool) -> float:
    text = row[at[column]] if column in at else ""
    if text == "":
        return float("nan")
    value = number(text, place, column, cure_nan=_NO_SD)
    if value < 0 or (value == 0 and not zero):
        raise DatasetError(
            f"{place}: {column} = {text!r} must be {'at least' if zero else 'greater than'} zero.",
            why="it is a standard uncertainty",
            fix=_NO_SD,
        )
    return value


def check_inside(uv: Floats, cameras: tuple[Camera, ...], place: Any) -> None:
    """Refuse pixels far outside the image; `place(point, camera)` says where the value stands."""
    for k, camera in enumerate(cameras):
        if camera.width is None or camera.height is None:
            continue
        size = np.array([camera.width, camera.height], dtype=np.float64)
        margin = OUTSIDE_PIXELS + OUTSIDE_SHARE * size.max()
        outside = (uv[:, k] < -0.5 - margin) | (uv[:, k] > size - 0.5 + margin)
        for i in np.flatnonzero(outside.any(axis=1))[:1]:
            u, v = uv[i, k]
            raise DatasetError(
                f"{place(i, k)}: pixel u = {u:g}, v = {v:g} is far outside the {camera.width} x {camera.height} "
                f"image of {camera.name!r}.",
                why="u is the column and v the row, counted from 0 at the centre of the top-left pixel",
                fix="correct the value, remove the row, or correct width and height in dataset.toml",
            )


def _spread(values: list[str], i: NDArray[Any], j: NDArray[Any], shape: tuple[int, int]) -> Names:
    text = np.array(values, dtype=np.str_)
    table = np.full(shape, "", dtype=text.dtype)
    table[i, j] = text
    return table


def write_folder(data: Dataset, path: Path, *, overwrite: bool = False, also: Mapping[str, str] | None = None) -> None:
    """Write a dataset folder, whole or not at all; `also` maps further relative file names to their text."""
    with replacing_folder(path, overwrite=overwrite) as temporary:
        for name, text in {**folder_files(data), **(also or {})}.items():
            target = temporary / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text, encoding="utf-8", newline="")


def folder_files(data: Dataset) -> dict[str, str]:
    """The files of a dataset folder: name -> text."""
    files = {"dataset.toml": description_text(data), "observations.csv": _observations_text(data.observations)}
    if data.known is not None:
        files["points.csv"] = _points_text(data.points, data.known)
    return files


def description_text(data: Dataset) -> str:
    """dataset.toml as text."""
    cameras = []
    for camera in data.cameras:
        sizes = {"width": camera.width, "height": camera.height}
        known = {key: size for key, size in sizes.items() if size is not None}
        cameras.append({"name": camera.name, **known, **camera.extra})
    return toml_text({"name": data.name, "length_unit": data.length_unit, **data.extra, "cameras": cameras})


def _points_text(points: Names, known: KnownPositions) -> str:
    stated = [c for c, column in zip(SD_POINT, known.sd.T, strict=True) if not np.isnan(column).all()]
    header = [*POINT_COLUMNS, *stated, *known.extra]
    sd = {c: column for c, column in zip(SD_POINT, known.sd.T, strict=True) if c in stated}
    rows = (
        [
            p,
            shot,
            *map(cell, xyz),
            *(cell(sd[c][i]) for c in stated),
            *(column[i] for column in known.extra.values()),
        ]
        for i, (p, shot, xyz) in enumerate(zip(points, known.shots, known.xyz, strict=True))
    )
    return csv_text(header, rows)


def _observations_text(observations: Observations) -> str:
    stated = [] if np.isnan(observations.sd).all() else list(SD_VIEW)
    header = [*VIEW_COLUMNS, *stated, *observations.extra]
    names = observations.camera_names
    rows = (
        [observations.points[i], names[k], *map(cell, observations.uv[i, k])]
        + ([cell(x) for x in observations.sd[i, k]] if stated else [])
        + [column[i, k] for column in observations.extra.values()]
        for i, k in np.argwhere(observations.seen)
    )
    return csv_text(header, rows)


def cell(value: float) -> str:
    """A number as the shortest text that reads back to the same bits; nothing for NaN."""
    return "" if np.isnan(value) else repr(float(value))


def csv_text(header: list[str], rows: Iterable[list[Any]]) -> str:
    """A comma-separated table."""
    buffer = io.StringIO(newline="")
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return buffer.getvalue()
