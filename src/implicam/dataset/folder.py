"""A dataset as a folder: dataset.toml, points.csv, observations.csv."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset.cells import guard_cell
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
    check_name,
    check_unique,
    check_views,
)
from implicam.dataset.tables import (
    Columns,
    NumberColumn,
    description_from_toml,
    naming,
    parse_toml,
    read_columns,
    read_table,
    read_toml,
)
from implicam.errors import DatasetError, did_you_mean
from implicam.files import replacing_folder, toml_text

DESCRIPTION, POINTS, VIEWS, IMAGES = "dataset.toml", "points.csv", "observations.csv", "images"
TRUTH = "truth.toml"
"""What only a simulated rig has beside its data; its photographs can be taken again."""

_OF_POINTS = "point_columns"
"""Entry of dataset.toml: which columns of observations.csv say something of the point, not of the view."""

_SD_NUMBER = NumberColumn("leave the cell empty where no uncertainty is stated", missing=("",))
_POSITION_NUMBER = NumberColumn("a known point needs its position: add it, or remove the point")
_PIXEL_NUMBER = NumberColumn(
    "leave both u and v empty where the view is missing, or remove the row", missing=("", "nan")
)
_POINT_NUMBERS = {**dict.fromkeys("xyz", _POSITION_NUMBER), **dict.fromkeys(SD_POINT, _SD_NUMBER)}
_VIEW_NUMBERS = {**dict.fromkeys("uv", _PIXEL_NUMBER), **dict.fromkeys(SD_VIEW, _SD_NUMBER)}


def read_folder(path: Path) -> Dataset:
    """Read a dataset folder, without looking for marks of missing views.

    Args:
        path: The folder.

    Raises:
        DatasetError: For the first mistake; names file, line, value and cure.
    """
    name, unit, cameras, extra = read_description(path)
    table = read_known(path)
    observations, missing = _read_observations(path, cameras, table and table[0])
    notes = (f"{missing} rows of {VIEWS} have no pixels: views that are missing.",) if missing else ()
    with naming(path / DESCRIPTION):
        listed = extra.pop(_OF_POINTS, []) if table is None else []
        observations, columns = _columns_of_points(observations, listed)
        return Dataset(name, unit, observations, table and table[1], extra, notes, columns)


def _columns_of_points(observations: Observations, listed: Any) -> tuple[Observations, dict[str, Names]]:
    """The columns of observations.csv that dataset.toml says are those of points, one text for all views of each."""
    seen, rest, found = observations.seen, dict(observations.extra), dict[str, Names]()
    for name in listed if isinstance(listed, list) else [listed]:
        if name not in rest:
            raise DatasetError(f"{VIEWS} has no column {str(name)!r}.", fix=f"remove it from {_OF_POINTS}, or add it")
        views = rest.pop(name)
        found[name] = views[np.arange(len(views)), seen.argmax(axis=1)]
        for i, k in np.argwhere((views != found[name][:, None]) & seen)[:1]:
            texts, point = (str(views[i, k])[:60], str(found[name][i])[:60]), str(observations.points[i])
            raise DatasetError(
                f"{VIEWS}: {name} = {texts[0]!r}, and {texts[1]!r} in another view of point {point!r}.",
                fix=f"give all views of a point the same {name}, or remove it from {_OF_POINTS}",
            )
    return replace(observations, extra=rest), found


def read_description(path: Path) -> tuple[str, str, tuple[Camera, ...], dict[str, Any]]:
    """Read what dataset.toml says.

    Args:
        path: The folder.

    Returns:
        Name, length unit, cameras, and the further entries as plain values.

    Raises:
        DatasetError: The file is missing or has a mistake.
    """
    toml = path / DESCRIPTION
    return description_from_toml(read_toml(toml), toml)


def read_known(path: Path) -> tuple[list[str], KnownPositions] | None:
    """Read the folder's points.csv.

    Args:
        path: The folder.

    Returns:
        Names and positions in the order of the file; None where there is no such file.

    Raises:
        DatasetError: The file has a mistake; names the line.
    """
    return read_points(path / POINTS) if (path / POINTS).exists() else None


def read_points(path: Path) -> tuple[list[str], KnownPositions]:
    """Read a table with the columns of points.csv.

    Args:
        path: The file.

    Returns:
        n names, and n positions in the same order.

    Raises:
        DatasetError: The file is missing, has no rows or a mistake; names the line.
    """
    header, rows = read_table(path, POINT_COLUMNS)
    table = read_columns(path, header, rows, ("point", "shot"), _POINT_NUMBERS)
    if not table.n:
        raise DatasetError(
            f"{path} has a header and no rows.",
            fix="add the known positions, or delete the file if they are unknown",
        )
    names = table.texts["point"]
    check_unique(names, "point", table.place)
    with naming(path):
        return names, table.known_positions(names, [c for c in header if c not in (*POINT_COLUMNS, *SD_POINT)])


def _read_observations(
    path: Path, cameras: tuple[Camera, ...], points: Sequence[str] | None
) -> tuple[Observations, int]:
    """The observations, and how many rows of the table are views that are missing."""
    header, rows = read_table(path / VIEWS, VIEW_COLUMNS)
    table = read_columns(path / VIEWS, header, rows, ("point", "camera"), _VIEW_NUMBERS)
    names, row_of = _match_views(table, cameras, path / POINTS, points)
    pixels = table.stack(("u", "v"))
    given = ~np.isnan(pixels).all(axis=1)
    if not given.any():
        raise DatasetError(f"{path / VIEWS} has a header and no rows.", fix="add one row per view: point,camera,u,v")
    i, k = np.array(list(row_of)).T  # of each row, in the table's order
    uv, sd = np.full((2, len(names), len(cameras), 2), np.nan)
    uv[i, k], sd[i, k] = pixels, table.stack(SD_VIEW)
    check_views(uv, sd, cameras, lambda point, camera: table.place(row_of[point, camera]))
    extra = {}
    for column in header:
        if column not in (*VIEW_COLUMNS, *SD_VIEW):
            text = np.array(table.texts[column], dtype=np.str_)
            extra[column] = np.full(uv.shape[:2], "", dtype=text.dtype)
            extra[column][i[given], k[given]] = text[given]
    with naming(path / VIEWS):
        return Observations(np.array(names, dtype=np.str_), cameras, uv, sd, extra), int((~given).sum())


def _match_views(
    table: Columns, cameras: Sequence[Camera], known: Path, points: Sequence[str] | None
) -> tuple[list[str], dict[tuple[int, int], int]]:
    """The points of the table, and (number of the point, number of the camera) -> row, in the table's order."""
    camera_index = {camera.name: k for k, camera in enumerate(cameras)}
    index = {name: i for i, name in enumerate(points or ())}
    row_of: dict[tuple[int, int], int] = {}
    for row, (point, camera) in enumerate(zip(table.texts["point"], table.texts["camera"], strict=True)):
        place = table.place(row)
        if point not in index:
            check_name(point, "point", place)
            if points:
                raise DatasetError(
                    f"{place}: point {point!r} has no known position in {known.name}{did_you_mean(point, index)}.",
                    fix=f"add it to {known}, remove this row, or measure it from a dataset without {known.name}",
                )
            index[point] = len(index)
        if camera not in camera_index:
            raise DatasetError(
                f"{place}: camera {camera!r} is not in dataset.toml{did_you_mean(camera, camera_index)}.",
                fix=f"the cameras are {', '.join(camera_index)}; correct the row or add a [[cameras]] table",
            )
        view = index[point], camera_index[camera]
        if view in row_of:
            raise DatasetError(
                f"{place}: point {point!r} is seen twice by camera {camera!r} (first at {table.place(row_of[view])}).",
                fix="keep one of the two rows",
            )
        row_of[view] = row
    return list(index), row_of


def write_folder(
    data: Dataset,
    path: Path,
    *,
    overwrite: bool = False,
    also: Mapping[str, str] | None = None,
    fill: Callable[[Path], None] | None = None,
) -> None:
    """Write a dataset folder, whole or not at all.

    Args:
        data: The dataset.
        path: The folder.
        overwrite: Whether an existing dataset folder may be replaced; never one with photographs.
        also: Text files to add: relative name -> text.
        fill: Called with the temporary folder to write more into it, before it is renamed.

    Raises:
        DatasetError: A folder cannot hold the dataset, or must not be replaced.
        ImplicamError: The folder exists, or cannot be written.
    """
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
    """The files of a dataset folder as texts.

    Args:
        data: The dataset.

    Returns:
        File name -> text.

    Raises:
        DatasetError: A folder cannot hold the dataset: a row of observations.csv is a view, so what belongs to no view
            would be lost.
    """
    _refuse_to_lose(data)
    if data.columns:
        repeated = {c: np.where(data.observations.seen, v[:, None], "") for c, v in data.columns.items()}
        observations = replace(data.observations, extra={**repeated, **data.observations.extra})
        data = replace(
            data, observations=observations, columns={}, extra={_OF_POINTS: list(data.columns), **data.extra}
        )
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
    """The text of dataset.toml.

    Args:
        data: The dataset.

    Raises:
        DatasetError: An extra entry cannot be written so that it can be read again.
    """
    cameras = [{**camera.as_table(), **camera.extra} for camera in data.cameras]
    table = {"name": data.name, "length_unit": data.length_unit, **data.extra}
    try:
        text = _with_camera_tables(table, cameras)
        parse_toml(text)  # it must be readable again: too long, or a time zone
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
    columns = [points.tolist(), known.shots.tolist(), *map(format_cells, known.xyz.T), *map(format_cells, sd.values())]
    columns += [column.tolist() for column in known.extra.values()]
    return csv_text([*POINT_COLUMNS, *sd, *known.extra], zip(*columns, strict=True))


def _observations_text(observations: Observations) -> str:
    seen = observations.seen
    i, k = np.nonzero(seen)
    stated = () if np.isnan(observations.sd).all() else SD_VIEW
    columns = [observations.points[i].tolist(), np.array(observations.camera_names)[k].tolist()]
    columns += [format_cells(column) for column in observations.uv[seen].T]
    columns += [format_cells(column) for column in observations.sd[seen].T] if stated else []
    columns += [column[seen].tolist() for column in observations.extra.values()]
    return csv_text([*VIEW_COLUMNS, *stated, *observations.extra], zip(*columns, strict=True))


def format_cells(values: Floats) -> list[str]:
    """Numbers as the shortest texts that read back to the same bits; an empty text for NaN.

    Args:
        values: (n,).
    """
    return ["" if value != value else repr(value) for value in values.tolist()]


class _Lines(list[str]):
    """Where csv.writer writes. It quotes every cell with a line break of either kind only if a row ends in both."""

    ENDING = "\r\n"

    def write(self, row: str) -> None:
        self.append(row.removesuffix(self.ENDING))


def csv_text(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """The text of a comma-separated table, in which no spreadsheet finds a formula.

    Args:
        header: The names of the columns.
        rows: The cells of each row.
    """
    lines = _Lines()
    writer = csv.writer(lines, lineterminator=_Lines.ENDING)
    writer.writerow(map(guard_cell, header))
    writer.writerows([guard_cell(cell) for cell in row] for row in rows)
    return "\n".join([*lines, ""])
