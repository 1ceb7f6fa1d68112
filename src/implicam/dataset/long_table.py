"""A table with a row for each view, `point,camera,u,v`, as a table with a row for each point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.headings import Headings
from implicam.dataset.model import SD_POINT, SD_VIEW, Floats
from implicam.dataset.tables import Columns
from implicam.errors import DatasetError


@dataclass(frozen=True)
class Brought:
    """What a sheet holds: its columns under the names of docs/formats.md, and how they were found.

    Attributes:
        columns: A row for each point.
        cameras: Their names.
        views: The names of further columns of views; the columns are NAME_CAMERA.
        further: The names of further columns of points.
        unit: The length unit that the headings state, or empty.
        notes: How the table was read, and what was read as missing, in sentences.
    """

    columns: Columns
    cameras: tuple[str, ...]
    views: tuple[str, ...]
    further: tuple[str, ...]
    unit: str = ""
    notes: tuple[str, ...] = ()


def pivot(table: Columns, headings: Headings, points: Sequence[str]) -> Brought:
    """A row for each point, in the order in which they appear.

    Args:
        table: A row for each view, under the headings of the file.
        headings: What they mean.
        points: The name of each row's point.

    Raises:
        DatasetError: A view is there twice, or a point has two positions; names the line.
    """
    row_of: dict[str, int] = {}
    camera_of: dict[str, int] = {}
    views: dict[tuple[int, int], int] = {}
    for i, (point, camera) in enumerate(zip(points, table.texts[headings.camera], strict=True)):
        view = row_of.setdefault(point, len(row_of)), camera_of.setdefault(camera, len(camera_of))
        if view in views:
            raise DatasetError(
                f"{table.place(i)}: point {point!r} is seen twice by camera {camera!r} (first at "
                f"{table.place(views[view])}).",
                fix="keep one of the two rows, or add a column frame if the points are seen again in each",
            )
        views[view] = i
    k, c = np.array(list(views)).T
    first = np.full(len(row_of), len(points))
    np.minimum.at(first, k, np.arange(len(points)))
    numbers = {}
    for column, name in [*zip(headings.positions, "xyz", strict=False), *((sd, sd) for sd in SD_POINT)]:
        if column in table.numbers:
            numbers[name] = _one_of_each(table, column, k, first)
    pixels = dict(zip(("u", "v"), headings.pixels[""], strict=True))
    for name, column in {**pixels, **{sd: sd for sd in SD_VIEW if sd in table.numbers}}.items():
        values = np.full((len(row_of), len(camera_of)), np.nan)
        values[k, c] = table.numbers[column]
        numbers |= {f"{name}_{camera}": values[:, j] for camera, j in camera_of.items()}
    texts: dict[str, list[str]] = {"point": list(row_of)}
    of_views = list[str]()
    for column in (column for column in table.texts if column in (*headings.further, "shot")):
        cells = np.array(table.texts[column], dtype=np.str_)
        if (cells == cells[first][k]).all() or column == "shot":
            texts[column] = cells[first].tolist()
            continue
        of_views.append(column)
        spread = np.full((len(row_of), len(camera_of)), "", dtype=cells.dtype)
        spread[k, c] = cells
        texts |= {f"{column}_{camera}": spread[:, j].tolist() for camera, j in camera_of.items()}
    columns = Columns(texts, numbers, len(row_of), lambda i: table.place(int(first[i])))
    further = tuple(column for column in texts if column in headings.further)
    return Brought(columns, tuple(camera_of), tuple(of_views), further)


def _one_of_each(table: Columns, column: str, k: NDArray[np.int64], first: NDArray[np.int64]) -> Floats:
    """The value of each point; refused where its rows have several."""
    values = table.numbers[column]
    own = values[first][k]
    for i in np.flatnonzero((values != own) & ~(np.isnan(values) & np.isnan(own)))[:1]:
        raise DatasetError(
            f"{table.place(int(i))}: {column} = {values[i]:g}, but {own[i]:g} in the row of another view of the point.",
            fix="give a point one position, or each a name of its own",
        )
    return np.asarray(values[first], dtype=np.float64)
