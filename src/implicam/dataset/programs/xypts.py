"""`dltdv`, `easywand`, `argus`: one table of pixels, a row a frame, two columns for each point and camera.

DLTdv 8 and easyWand call them pt1_cam1_X, pt1_cam1_Y (v from the top, the first pixel is 1), Argus NAME_cam_1_x,
NAME_cam_1_y; NaN is a point that was not clicked. DLTdv's sparse tables have a title, a line of rows, columns and
entries, and a line of row, column and value for each number that is not 0, separated by tabs; how many cameras there
are is in PREFIXoffsets.tsv beside them, which has a column for each. DLTdv 5 and older Argus count v from below:
--v-up. The known positions of calibration points are another file (`xyz`): of the rows of the table, or of the points
of its only row.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.dialect import find_separator, rows_of
from implicam.dataset.folder import csv_text, format_cells
from implicam.dataset.model import Dataset
from implicam.dataset.programs.views import Numbers, Views, pixel_number
from implicam.dataset.tables import Row, check_width, read_lines, read_number
from implicam.dataset.wand import FRAME, MARKER
from implicam.errors import DatasetError, did_you_mean
from implicam.files import write_text

DLTDV = re.compile(r"(?P<point>pt\d+)_(?P<camera>cam\d+)_(?P<axis>[xy])", re.IGNORECASE)
ARGUS = re.compile(r"(?P<point>.+)_(?P<camera>cam_\d+)_(?P<axis>[xy])", re.IGNORECASE)

MAX_SPARSE_LINES, MAX_SPARSE_CELLS = 5_000_000, 20_000_000
_WHOLE = "write a whole number"

Columns = dict[tuple[str, str], dict[str, int]]
"""(point, camera) -> axis -> number of the column."""


def read_dltdv(path: Path, positions: Sequence[Numbers]) -> Views:
    """Read the xypts.csv of DLTdv or easyWand.

    Args:
        path: The file.
        positions: Known positions; empty where there are none.

    Raises:
        DatasetError: A heading is no pair of such a table, a cell is no number, or the positions do not fit.
    """
    return _read(path, positions, DLTDV, "pt1_cam1_X")


def read_argus(path: Path, positions: Sequence[Numbers]) -> Views:
    """Read the xypts.csv of Argus.

    Args:
        path: The file.
        positions: Known positions; empty where there are none.

    Raises:
        DatasetError: A heading is no pair of such a table, a cell is no number, or the positions do not fit.
    """
    return _read(path, positions, ARGUS, "track_cam_1_x")


def _read(path: Path, positions: Sequence[Numbers], form: re.Pattern[str], example: str) -> Views:
    sparse = _read_sparse(path, form)
    if sparse is not None:
        return _views(path, [(1, sparse[0]), *enumerate(sparse[1:], 2)], positions, form, example)
    writing = find_separator(path, lambda rows: 0 if form.fullmatch(rows[0][0].strip()) else None)
    rows = list(rows_of(path, writing))
    if not rows:
        raise DatasetError(f"{path} is empty.", fix=f"its first line names columns such as {example}")
    return _views(path, rows, positions, form, example)


def _read_sparse(path: Path, form: re.Pattern[str]) -> list[list[str]] | None:
    """The headings and rows that a sparse table of DLTdv stands for; None of another file."""
    lines = [text.split("\t") for text in islice(read_lines(path), MAX_SPARSE_LINES)]
    if len(lines) < 2 or len(lines[0]) > 1 or not all(len(line) == 3 for line in lines[1:]):
        return None
    if form is not DLTDV:
        raise DatasetError(f"{path} is a sparse table, which is not read.", fix='save the points as "Dense .csv"')
    frames, width, _ = (int(read_number(cell, f"{path}, line 2", "size", cure_nan=_WHOLE)) for cell in lines[1])
    beside = path.with_name(path.name.replace("xypts", "offsets"))
    if beside == path or not beside.is_file():
        raise DatasetError(
            f"{path}: how many cameras there are is not known.",
            why=f"a sparse table has {width} columns without names, 2 for each point and camera; {beside.name}, "
            "which has one for each camera, is not beside it",
            fix=f"put {beside.name} there, or save the points from DLTdv as flat tables (CSV)",
        )
    size = next(islice(read_lines(beside), 1, 2), "").split("\t")
    cameras = int(read_number(size[1], f"{beside}, line 2", "cameras", cure_nan=_WHOLE)) if len(size) == 3 else 0
    if cameras < 1 or width % (2 * cameras) or not 0 < frames * width <= MAX_SPARSE_CELLS:
        raise DatasetError(
            f"{path}: {frames} rows of {width} columns are no pixels of {cameras} cameras.",
            why=f"{beside.name} states the cameras, and each has 2 columns for each point",
            fix="give both files as DLTdv saved them",
        )
    points = width // (2 * cameras)
    names = [f"pt{p + 1}_cam{c + 1}_{axis}" for p in range(points) for c in range(cameras) for axis in "XY"]
    table = [["NaN"] * width for _ in range(frames)]
    for number, cells in enumerate(lines[2:], 3):
        place = f"{path}, line {number}"
        row, column = (
            int(read_number(cell, place, what, cure_nan=_WHOLE))
            for cell, what in zip(cells, ("row", "column"), strict=False)
        )
        if not (1 <= row <= frames and 1 <= column <= width):
            raise DatasetError(f"{place}: row {row}, column {column} of {frames} x {width}.", fix="correct the line")
        table[row - 1][column - 1] = cells[2].strip()
    return [names, *table]


def _views(path: Path, rows: list[Row], positions: Sequence[Numbers], form: re.Pattern[str], example: str) -> Views:
    _refuse_no_headings(path, rows[0], example)
    columns = _pairs([cell.strip() for cell in rows[0][1]], form, example, f"{path}, line {rows[0][0]}")
    points = list(dict.fromkeys(point for point, _ in columns))
    frames = rows[1:]
    names = _names(points, len(frames), positions, path)
    views = Views()
    for frame, (line, row) in enumerate(check_width(f"{path}, line", len(rows[0][1]), frames), 1):
        place = f"{path}, line {line}"
        for (point, camera), axes in columns.items():
            pixel = pixel_number(row[axes["x"]], place, "x"), pixel_number(row[axes["y"]], place, "y")
            name = names[frame - 1][points.index(point)]
            views.add(name, camera, pixel, place)
            views.describe(name, frame=str(frame), marker=point)
            if positions:
                i = frame - 1 if len(points) == 1 else points.index(point)
                views.place_point(name, positions[i], place)
    return views


def _refuse_no_headings(path: Path, first: Row, example: str) -> None:
    """EasyWand reads tables without headings; how many cameras there are cannot be told from them."""
    line, cells = first
    try:
        for cell in cells:
            float(cell)
    except ValueError:
        return
    columns = len(cells)
    names = [example.replace("cam1", f"cam{c + 1}").replace("cam_1", f"cam_{c + 1}") for c in range(columns // 2)]
    pairs = ",".join(f"{name},{name[:-1]}{'Y' if name.endswith('X') else 'y'}" for name in names[:8])
    raise DatasetError(
        f"{path}, line {line}: the table has {columns} columns of numbers, and no headings.",
        why="which columns are of which point and camera is then not known",
        fix=f"write a first line; of one point and {columns // 2} cameras: {pairs}{', ...' if columns > 16 else ''}",
    )


def _names(points: list[str], frames: int, positions: Sequence[Numbers], path: Path) -> list[list[str]]:
    """The name of each point of each frame: p0001 where a frame has one, else frame and point."""
    several = len(points) > 1
    if positions and (len(positions) != (len(points) if several else frames) or (several and frames > 1)):
        raise DatasetError(
            f"{path} has {frames} rows of {len(points)} points, and there are {len(positions)} known positions.",
            why="known positions belong to the rows of one point, or to the points of one row",
            fix="digitize the known points as the rows of one point, in the order of their positions",
        )
    if not several:
        return [[f"p{frame:04d}"] for frame in range(1, frames + 1)]
    return [[f"{frame} {point}" for point in points] for frame in range(1, frames + 1)]


def _pairs(header: list[str], form: re.Pattern[str], example: str, place: str) -> Columns:
    columns: Columns = {}
    for i, heading in enumerate(header):
        found = form.fullmatch(heading)
        if found is None:
            raise DatasetError(
                f"{place}: the column {heading[:60]!r} is not of the kind {example!r}.",
                fix="give the table as the program wrote it; implicam convert lists the kinds it reads (--help)",
            )
        axes = columns.setdefault((found["point"], found["camera"].lower().replace("_", "")), {})
        if found["axis"].lower() in axes:
            raise DatasetError(f"{place}: the column {heading!r} is there twice.", fix="leave one out")
        axes[found["axis"].lower()] = i
    for axes in columns.values():
        if len(axes) == 1:
            ((axis, i),) = axes.items()
            other = header[i][:-1] + {"x": "y", "y": "x", "X": "Y", "Y": "X"}[header[i][-1]]
            alone = [header[next(iter(a.values()))] for a in columns.values() if len(a) == 1 and axis not in a]
            raise DatasetError(
                f"{place}: there is a column {header[i]!r} but no {other!r}{did_you_mean(other, alone)}.",
                fix="correct the heading, or add the other column",
            )
    return columns


def write_dltdv(data: Dataset, path: Path) -> list[str]:
    """Write xypts.csv: a row for each point, and the known positions beside it; of markers a row for each frame.

    Args:
        data: The dataset; its pixels as the program counts them.
        path: The file; the positions are in the file of the same name with xyz in place of xypts.

    Returns:
        What it could not hold, in sentences.

    Raises:
        ImplicamError: A file cannot be written.
    """
    return _write(data, path, "pt{point}_cam{camera}_{axis}", "XY")


def write_argus(data: Dataset, path: Path) -> list[str]:
    """Write xypts.csv as Argus has it, as `write_dltdv`.

    Args:
        data: The dataset; its pixels as the program counts them.
        path: The file; the positions are in the file of the same name with xyz in place of xypts.

    Returns:
        What it could not hold, in sentences.

    Raises:
        ImplicamError: A file cannot be written.
    """
    return _write(data, path, "track{point}_cam_{camera}_{axis}", "xy")


def _write(data: Dataset, path: Path, form: str, axes: str) -> list[str]:
    places, notes = _rows_of_frames(data)
    frames, points = places.shape
    uv = np.full((frames, points, len(data.cameras), 2), np.nan)
    uv[places >= 0] = data.observations.uv[places[places >= 0]]
    header = [
        form.format(point=point + 1, camera=camera + 1, axis=axis)
        for point in range(points)
        for camera in range(len(data.cameras))
        for axis in axes
    ]
    rows = [[cell or "NaN" for cell in format_cells(row)] for row in uv.reshape(frames, -1)]
    write_text(path, csv_text(header, rows))
    notes = [
        f"The cameras are {', '.join(f'{i} = {c.name}' for i, c in enumerate(data.cameras, 1))}; names are lost.",
        *notes,
    ]
    if data.known is not None:
        beside = path.with_name(path.stem.replace("xypts", "xyz") + ".csv")
        beside = beside if beside != path else path.with_name(path.stem + "_xyz.csv")
        write_text(beside, "".join(",".join(format_cells(row)) + "\n" for row in data.xyz))
        notes.append(f"The known positions are in {beside.name}.")
    return notes


MAX_EMPTY_ROWS = 20
"""Rows of frames in which nothing was seen, for each row of one in which something was."""


def _rows_of_frames(data: Dataset) -> tuple[NDArray[np.int64], list[str]]:
    """(frames, points) which point of the data is in which row, -1 for none, and notes: a row a point, or, of markers
    in frames whose positions are not known, a row a frame, numbered as the frames are where that is possible."""
    columns = data.further_columns()
    if data.known is not None or not {FRAME, MARKER} <= columns.keys():
        return np.arange(len(data))[:, None], []
    frames, markers = (columns[name].tolist() for name in (FRAME, MARKER))
    names = list(dict.fromkeys(markers))
    row_of = {frame: i for i, frame in enumerate(dict.fromkeys(frames))}
    notes = [f"The points are {', '.join(f'{i} = {name}' for i, name in enumerate(names, 1))}."]
    if all(frame.isdecimal() for frame in row_of):
        numbers = [int(frame) for frame in row_of]
        first = min(numbers)
        if max(numbers) - first < MAX_EMPTY_ROWS * len(numbers) and len(set(numbers)) == len(numbers):
            row_of = {frame: int(frame) - first for frame in row_of}
            notes.append(f"Row 1 is frame {first}.")
    places = np.full((max(row_of.values()) + 1, len(names)), -1, dtype=np.int64)
    for row, (frame, marker) in enumerate(zip(frames, markers, strict=True)):
        places[row_of[frame], names.index(marker)] = row
    return places, notes
