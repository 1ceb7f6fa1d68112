"""A dataset as a folder: dataset.toml, points.csv, observations.csv."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.model import (
    POINT_COLUMNS,
    SD_POINT,
    SD_VIEW,
    VIEW_COLUMNS,
    Camera,
    Dataset,
    Floats,
    KnownPositions,
    Names,
    Observations,
    check_inside,
)
from implicam.dataset.tables import (
    Row,
    description_from_toml,
    name_in,
    naming,
    number,
    parse_toml,
    read_table,
    read_toml,
)
from implicam.errors import DatasetError, did_you_mean
from implicam.files import replacing_folder, toml_text

DESCRIPTION, POINTS, VIEWS, IMAGES = "dataset.toml", "points.csv", "observations.csv", "images"
TRUTH = "truth.toml"
"""What only a simulated rig has beside its data; its photographs can be taken again."""

_NO_VIEW = "leave both u and v empty where the view is missing, or remove the row"
_NO_SD = "leave the cell empty where no uncertainty is stated"


def read_folder(path: Path) -> Dataset:
    """Read a dataset folder; every mistake is a DatasetError naming file, line, value and cure."""
    name, unit, cameras, extra = read_description(path)
    points = read_points(path / POINTS) if (path / POINTS).exists() else None
    observations, missing = _read_observations(path / VIEWS, cameras, points)
    notes = (f"{missing} rows of {VIEWS} have no pixels: views that are missing.",) if missing else ()
    with naming(path / DESCRIPTION):
        return Dataset(name, unit, observations, points.known if points else None, extra, notes)


def read_description(path: Path) -> tuple[str, str, tuple[Camera, ...], dict[str, Any]]:
    """What dataset.toml in the folder says: name, length unit, cameras, and its further entries."""
    toml = path / DESCRIPTION
    return description_from_toml(read_toml(toml), toml)


def read_known(path: Path) -> tuple[list[str], KnownPositions] | None:
    """The names and positions in the folder's points.csv, in its order; None where there is none."""
    if not (path / POINTS).exists():
        return None
    points = read_points(path / POINTS)
    return points.names, points.known


@dataclass(frozen=True)
class _Points:
    path: Path
    names: list[str]
    known: KnownPositions


def read_points(path: Path) -> _Points:
    """The table points.csv: names, and known positions in their order."""
    header, rows = read_table(path, POINT_COLUMNS)
    at = {column: i for i, column in enumerate(header)}
    extra_columns = [c for c in header if c not in (*POINT_COLUMNS, *SD_POINT)]
    names: dict[str, int] = {}
    shots, xyz, sd = [], [], []
    extra: dict[str, list[str]] = {c: [] for c in extra_columns}
    for line, row in rows:
        place = f"{path}, line {line}"
        name = name_in(row[at["point"]], "point", place)
        if name in names:
            raise DatasetError(
                f"{place}: point {name!r} is there twice (first on line {names[name]}).",
                fix="remove one, or give each point a name of its own",
            )
        names[name] = line
        shots.append(name_in(row[at["shot"]], "shot", place))
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
    with naming(path):
        known = KnownPositions(
            np.array(shots, dtype=np.str_),
            np.reshape(xyz, (n, 3)),
            np.reshape(sd, (n, 3)),
            {c: np.array(values, dtype=np.str_) for c, values in extra.items()},
        )
    return _Points(path, list(names), known)


def _read_observations(path: Path, cameras: tuple[Camera, ...], points: _Points | None) -> tuple[Observations, int]:
    """The observations, and how many rows of the table are views that are missing."""
    header, rows = read_table(path, VIEW_COLUMNS)
    index, views = _view_rows(path, header, rows, cameras, points)
    if not views.lines:
        raise DatasetError(f"{path} has a header and no rows.", fix="add one row per view: point,camera,u,v")
    n, c = len(index), len(cameras)
    i, j = np.array(views.point), np.array(views.camera)
    uv, sd = np.full((n, c, 2), np.nan), np.full((n, c, 2), np.nan)
    uv[i, j] = views.uv
    if views.sd:
        sd[i, j] = views.sd
    lines = np.zeros((n, c), dtype=np.int64)
    lines[i, j] = views.lines
    check_inside(uv, cameras, lambda p, k: f"{path}, line {lines[p, k]}")
    extra = {column: _spread(values, i, j, (n, c)) for column, values in views.extra.items()}
    with naming(path):
        return Observations(np.array(list(index), dtype=np.str_), cameras, uv, sd, extra), views.missing


class _Views:
    """The columns of observations.csv as they are read."""

    def __init__(self, extra_columns: Iterable[str]) -> None:
        self.missing = 0
        self.lines: list[int] = []
        self.point: list[int] = []
        self.camera: list[int] = []
        self.uv: list[list[float]] = []
        self.sd: list[list[float]] = []
        self.extra: dict[str, list[str]] = {c: [] for c in extra_columns}


def _view_rows(
    path: Path, header: list[str], rows: Iterable[Row], cameras: tuple[Camera, ...], points: _Points | None
) -> tuple[dict[str, int], _Views]:
    at = {column: i for i, column in enumerate(header)}
    views = _Views(c for c in header if c not in (*VIEW_COLUMNS, *SD_VIEW))
    camera_index = {camera.name: k for k, camera in enumerate(cameras)}
    index = {name: i for i, name in enumerate(points.names)} if points else {}
    seen: dict[tuple[int, int], int] = {}
    in_file = f"{path}, line "  # formatted once: a table may have a million rows
    stated = [c for c in SD_VIEW if c in at]
    for line, row in rows:
        place = f"{in_file}{line}"
        i = _point_index(row[at["point"]].strip(), index, points, place)
        k = _camera_index(row[at["camera"]].strip(), camera_index, place)
        if (i, k) in seen:
            raise DatasetError(
                f"{place}: point {row[at['point']]!r} is seen twice by camera {row[at['camera']]!r} "
                f"(first on line {seen[i, k]}).",
                fix="keep one of the two rows",
            )
        seen[i, k] = line
        if _no_pixels(row[at["u"]], row[at["v"]]):
            views.missing += 1
            continue
        views.lines.append(line)
        views.point.append(i)
        views.camera.append(k)
        views.uv.append([number(row[at[c]], place, c, cure_nan=_NO_VIEW) for c in "uv"])
        if stated:
            views.sd.append([_sd(row, at, c, place, zero=False) for c in SD_VIEW])
        for c, values in views.extra.items():
            values.append(row[at[c]])
    return index, views


def _no_pixels(u: str, v: str) -> bool:
    """Whether a row says that the view is missing."""
    return u.strip().lower() in _NOTHING and v.strip().lower() in _NOTHING


_NOTHING = ("", "nan")


def _point_index(name: str, index: dict[str, int], points: _Points | None, place: str) -> int:
    if name not in index:
        name = name_in(name, "point", place)
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


def _sd(row: list[str], at: Mapping[str, int], column: str, place: str, *, zero: bool) -> float:
    text = row[at[column]].strip() if column in at else ""
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


def _spread(values: list[str], i: NDArray[Any], j: NDArray[Any], shape: tuple[int, int]) -> Names:
    text = np.array(values, dtype=np.str_)
    table = np.full(shape, "", dtype=text.dtype)
    table[i, j] = text
    return table


def write_folder(
    data: Dataset,
    path: Path,
    *,
    overwrite: bool = False,
    also: Mapping[str, str] | None = None,
    fill: Callable[[Path], None] | None = None,
) -> None:
    """Write a dataset folder, whole or not at all; `also` maps further relative file names to their text, and `fill`
    writes the rest into the folder."""
    files = {**folder_files(data), **(also or {})}
    if overwrite:
        _refuse_to_destroy(path)
    with replacing_folder(path, overwrite=overwrite) as temporary:
        for name, text in files.items():
            target = temporary / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text, encoding="utf-8", newline="")
        if fill is not None:
            fill(temporary)


def _refuse_to_destroy(path: Path) -> None:
    """Overwriting replaces the whole folder: never one that is no dataset, never one with photographs."""
    if not path.is_dir() or not any(path.iterdir()):
        return
    if not (path / DESCRIPTION).exists():
        raise DatasetError(
            f"{path} is not a dataset, so it is not overwritten.",
            why=f"it has no {DESCRIPTION}, and replacing it would delete what it holds",
            fix="choose another name, or remove the folder yourself",
        )
    if (path / IMAGES).exists() and not (path / TRUTH).exists():
        raise DatasetError(
            f"{path} holds {IMAGES}, so it is not overwritten.",
            why="photographs cannot be computed again",
            fix="choose another name, or move the images away first",
        )


def folder_files(data: Dataset) -> dict[str, str]:
    """The files of a dataset folder: name -> text. DatasetError for what this form cannot hold."""
    _refuse_to_lose(data)
    files = {DESCRIPTION: description_text(data), VIEWS: _observations_text(data.observations)}
    if data.known is not None:
        files[POINTS] = _points_text(data.points, data.known)
    return files


def _refuse_to_lose(data: Dataset) -> None:
    """observations.csv has a row per view, so what belongs to no view has no place in it."""
    observations = data.observations
    seen = observations.seen
    instead = "write it as .csv, .parquet or .npz"
    if not seen.any():
        raise DatasetError(f"dataset {data.name!r} has no view at all.", fix="a folder needs one; " + instead)
    unseen = data.points[~seen.any(axis=1)]
    if data.known is None and len(unseen):
        raise DatasetError(
            f"point {str(unseen[0])!r} was seen by no camera, so a folder without {POINTS} would lose it"
            f"{f' and {len(unseen) - 1} more' if len(unseen) > 1 else ''}.",
            fix=f"leave such points out (data.select(data.observations.seen.any(axis=1))), or {instead}",
        )
    for column, text in observations.extra.items():
        for i, k in np.argwhere((text != "") & ~seen)[:1]:
            raise DatasetError(
                f"point {str(data.points[i])!r}, camera {data.cameras[k].name!r}: the column {column!r} says "
                f"{str(text[i, k])[:60]!r} of a view that is missing, which a folder would lose.",
                fix="empty it, or " + instead,
            )


def description_text(data: Dataset) -> str:
    """dataset.toml as text."""
    cameras = [{**camera.as_table(), **camera.extra} for camera in data.cameras]
    table = {"name": data.name, "length_unit": data.length_unit, **data.extra}
    try:
        text = _with_camera_tables(table, cameras)
        parse_toml(text)  # what is written must be readable again: sizes, time zones
    except ValueError as error:
        raise DatasetError(
            f"the description of dataset {data.name!r} cannot be written.",
            why=str(error),
            fix="shorten or leave out its extra entries, or those of its cameras",
        ) from None
    return text


def _with_camera_tables(table: dict[str, Any], cameras: list[dict[str, Any]]) -> str:
    """As people write it, a [[cameras]] table each; tomli_w would put short ones on one line."""
    if any(isinstance(value, (dict, list)) for camera in cameras for value in camera.values()):
        return toml_text({**table, "cameras": cameras})
    return toml_text(table) + "".join(f"\n[[cameras]]\n{toml_text(camera)}" for camera in cameras)


def _points_text(points: Names, known: KnownPositions) -> str:
    sd = {c: column for c, column in zip(SD_POINT, known.sd.T, strict=True) if not np.isnan(column).all()}
    columns = [points.tolist(), known.shots.tolist(), *map(cells, known.xyz.T), *map(cells, sd.values())]
    columns += [column.tolist() for column in known.extra.values()]
    return csv_text([*POINT_COLUMNS, *sd, *known.extra], zip(*columns, strict=True))


def _observations_text(observations: Observations) -> str:
    seen = observations.seen
    i, k = np.nonzero(seen)
    stated = () if np.isnan(observations.sd).all() else SD_VIEW
    columns = [observations.points[i].tolist(), np.array(observations.camera_names)[k].tolist()]
    columns += [cells(column) for column in observations.uv[seen].T]
    columns += [cells(column) for column in observations.sd[seen].T] if stated else []
    columns += [column[seen].tolist() for column in observations.extra.values()]
    return csv_text([*VIEW_COLUMNS, *stated, *observations.extra], zip(*columns, strict=True))


def cells(values: Floats) -> list[str]:
    """Numbers as the shortest texts that read back to the same bits; nothing for NaN."""
    return ["" if value != value else repr(value) for value in values.tolist()]


class _Lines(list[str]):
    """Where csv.writer writes. It quotes every cell with a line break of either kind only if a row ends in both."""

    ENDING = "\r\n"

    def write(self, row: str) -> None:
        self.append(row.removesuffix(self.ENDING))


def csv_text(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A comma-separated table."""
    lines = _Lines()
    writer = csv.writer(lines, lineterminator=_Lines.ENDING)
    writer.writerow(header)
    writer.writerows(rows)
    return "\n".join([*lines, ""])
