"""A table that people bring, without a description beside it: read as far as there is one way to read it.

One row per point, `x,y,z,u_cam1,v_cam1,...`, or one per view, `point,camera,u,v`. A note says in one line how the
headings were read, where they are not those of docs/formats.md; other notes name each mark for a missing view.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from implicam.dataset.dialect import AS_DOCUMENTED, Writing, find_separator, look_at_numbers, rows_of
from implicam.dataset.header_rows import MAX_TITLE_ROWS, HeaderRows, find_header, is_number
from implicam.dataset.headings import Headings, read_headings, squeezed
from implicam.dataset.long_table import Brought, pivot
from implicam.dataset.model import SD_POINT, SD_VIEW
from implicam.dataset.tables import (
    NO_VALUE_WORDS,
    Columns,
    NumberColumn,
    Row,
    check_headings,
    check_width,
    read_columns,
    require_file,
)
from implicam.errors import DatasetError

EXAMPLE_HEADER = "x,y,z,u_cam1,v_cam1,u_cam2,v_cam2, ..."

_PIXEL = NumberColumn("leave the cell empty where there is no value", (*NO_VALUE_WORDS, "nan"))
_OTHER_NUMBER = NumberColumn("leave the cell empty where there is no value", ("", "nan"))


@dataclass(frozen=True)
class Sheet:
    """Cells of text, as a file has them.

    Attributes:
        place: The file, or the file and what in it, for errors.
        header: The first row.
        rows: Gives the other rows, each time from the start: number and cells.
        unit: What an error calls a row: "line", or "row".
        first: The number of the header.
        writing: How the text is written.
    """

    place: str
    header: list[str]
    rows: Callable[[], Iterator[Row]]
    unit: str = "line"
    first: int = 1
    writing: Writing = AS_DOCUMENTED
    said: tuple[str, ...] = ()
    """What was done to find the headings, in words."""
    cameras: tuple[str, ...] = ()
    """Names that cameras are known to have."""

    @property
    def header_place(self) -> str:
        """Where the header stands, for errors."""
        return f"{self.place}, {self.unit} {self.first}"


def sheet_of_text(path: Path, cameras: Sequence[str] = ()) -> Sheet:
    """The cells of a CSV, with commas, semicolons, tabs, bars or blanks.

    Args:
        path: The file.
        cameras: Names that cameras are known to have.

    Raises:
        DatasetError: There is no such file, it is no text, or has no header.
    """
    require_file(path, f"put a comma-separated table with the columns {EXAMPLE_HEADER} there")

    def header_number(rows: list[list[str]]) -> int | None:
        found = find_header(rows, cameras)
        return None if found is None else found.rows - 1

    writing = find_separator(path, header_number)
    top = list(islice(rows_of(path, writing), MAX_TITLE_ROWS + 2))
    if not top:
        raise DatasetError(f"{path} is empty.", fix=f"its first line must be {EXAMPLE_HEADER}, then one row per entry")
    return sheet_below(str(path), top, lambda: rows_of(path, writing), "line", cameras, writing)


def sheet_below(
    place: str,
    top: Sequence[Row],
    everything: Callable[[], Iterator[Row]],
    unit: str,
    cameras: Sequence[str] = (),
    writing: Writing = AS_DOCUMENTED,
) -> Sheet:
    """A sheet with the headings where they are: in the first row, or below a title.

    Args:
        place: The file, or the file and what in it.
        top: The first rows, at least one.
        everything: Gives all rows, each time from the start.
        unit: What an error calls a row.
        cameras: Names that cameras are known to have.
        writing: How the text is written.
    """
    found = find_header([row for _, row in top], cameras) or HeaderRows([cell.strip() for cell in top[0][1]], 1)
    said = (found.said,) if found.said else ()

    def rows() -> Iterator[Row]:
        return islice(everything(), found.rows, None)

    first = top[found.rows - 1][0]
    return Sheet(place, list(found.header), rows, unit, first, writing, said, tuple(cameras))


def cell_text(value: object) -> str:
    """A value as it would stand in a CSV: a whole number without a point, another to its last bit, nothing for None.

    Args:
        value: Of a cell of a workbook or a Parquet file.
    """
    if value is None:
        return ""
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return str(int(value))
    return str(value)


def read_sheet(sheet: Sheet) -> Brought:
    """Read a table that states by its headings what is in it.

    Args:
        sheet: The table.

    Raises:
        DatasetError: There are two ways to read it, or it has a mistake; names the line, the value and the cure.
    """
    sheet = _with_index_named(_without_empty_columns(sheet))
    _refuse_numbers(sheet)
    check_headings(sheet.header_place, sheet.header)
    headings = read_headings(sheet.header, sheet.header_place, sheet.cameras)
    table, words, decimal = _read_cells(sheet, headings)
    if not table.n:
        raise DatasetError(f"{sheet.place} has a header and no rows.", fix="add one row per point")
    points, said = _name_points(table, headings, sheet)
    if headings.camera and points is not None:
        found = pivot(table, headings, points)
    else:
        names = headings.renamed()
        texts = {names.get(column, column): cells for column, cells in table.texts.items()}
        texts |= {} if points is None else {"point": points}
        numbers = {names.get(column, column): values for column, values in table.numbers.items()}
        views = tuple(name for name in headings.views if name not in SD_VIEW)
        found = Brought(Columns(texts, numbers, table.n, table.place), tuple(headings.pixels), views, headings.further)
    _refuse_alike(found, sheet.place)
    said = "; ".join([*([said] if said else []), *sheet.said])
    notes = (*_describe(sheet.writing._replace(decimal=decimal), headings, said), *_count_missing(words))
    return replace(found, unit=headings.unit, notes=notes)


def _read_cells(sheet: Sheet, headings: Headings) -> tuple[Columns, Counter[str], str]:
    """The columns under their own headings, the words for missing pixels, and the decimal mark."""
    header, names = sheet.header, headings.renamed()
    pixels = [column for pair in headings.pixels.values() for column in pair]
    sd = {column for name in SD_VIEW for column in headings.views.get(name, {}).values()}
    sd |= {column for column in header if column in (SD_POINT if not headings.camera else (*SD_POINT, *SD_VIEW))}
    numbers = {**dict.fromkeys([*headings.positions, *sorted(sd)], _OTHER_NUMBER), **dict.fromkeys(pixels, _PIXEL)}
    at = {column: i for i, column in enumerate(header)}
    found = look_at_numbers(_rows(sheet), [at[c] for c in numbers], {at[c] for c in pixels}, sheet.place, sheet.unit)
    numbers = {column: kind._replace(decimal=found.decimal) for column, kind in numbers.items()}
    trimmed = [
        column for column in header if names.get(column, column) in ("point", "shot") or column == headings.camera
    ]
    table = read_columns(sheet.place, header, _rows(sheet), trimmed, numbers, sheet.unit)
    return table, found.words, found.decimal


def _rows(sheet: Sheet) -> Iterator[Row]:
    """The rows, each as wide as the header; empty cells beyond it do not count."""
    width = len(sheet.header)
    rows = ((i, row if any(map(str.strip, row[width:])) else row[:width]) for i, row in sheet.rows())
    return check_width(f"{sheet.place}, {sheet.unit}", width, rows)


def _without_empty_columns(sheet: Sheet) -> Sheet:
    """The sheet without columns in which nothing stands, as a separator at the end of each line makes them."""
    header = [name.strip() for name in sheet.header]
    nameless = [i for i, name in enumerate(header) if not name]
    if nameless:
        nameless = [i for i in nameless if not any(i < len(row) and row[i].strip() for _, row in sheet.rows())]
    if not nameless:
        return replace(sheet, header=header)
    kept = [i for i in range(len(header)) if i not in frozenset(nameless)]

    def rows() -> Iterator[Row]:
        for line, row in sheet.rows():
            short = len(row) < len(header)  # an error, which the number of its cells tells
            yield line, row if short else [*(row[i] for i in kept), *row[len(header) :]]

    return replace(sheet, header=[header[i] for i in kept], rows=rows)


def _with_index_named(sheet: Sheet) -> Sheet:
    """The sheet without pandas' index, a first column without a name that counts the rows; one of names is `point`."""
    if not sheet.header or sheet.header[0] or "" in sheet.header[1:]:
        return sheet
    cells = [row[0].strip() for _, row in sheet.rows() if row]
    if cells in ([str(i) for i in range(len(cells))], [str(i + 1) for i in range(len(cells))]):

        def rows() -> Iterator[Row]:
            return ((line, row[1:]) for line, row in sheet.rows())

        said = "left out is the first column, which has no name and counts the rows"
        return replace(sheet, header=sheet.header[1:], rows=rows, said=(*sheet.said, said))
    try:
        named = read_headings(sheet.header[1:], "", sheet.cameras).point
    except DatasetError:
        return sheet
    if named or len(set(cells)) < len(cells) or any(map(is_number, cells)):
        return sheet
    return replace(sheet, header=["point", *sheet.header[1:]], said=(*sheet.said, "the first column names the points"))


def _refuse_alike(found: Brought, place: str) -> None:
    """Refuse cameras whose names differ in case, blanks and marks only: a slip makes two cameras of one."""
    first: dict[str, str] = {}
    for camera in found.cameras:
        other = first.setdefault(squeezed(camera), camera)
        if other != camera and squeezed(camera):
            views = {name: int(np.isfinite(found.columns.numbers[f"u_{name}"]).sum()) for name in (other, camera)}
            told = " and ".join(f"{name!r} ({n} view{'s' * (n != 1)})" for name, n in views.items())
            raise DatasetError(
                f"{place}: {told} are two cameras whose names are alike.",
                why="a slip in a name makes two cameras of one, and each then has too few views",
                fix="write the name of a camera the same everywhere; two that are two need names that differ in more",
            )


def _refuse_numbers(sheet: Sheet) -> None:
    if sum(map(is_number, sheet.header)) > len(sheet.header) / 2:
        raise DatasetError(
            f"{sheet.header_place}: the first {sheet.unit} holds numbers, and no names of columns.",
            fix="write x,y,z,u_cam1,v_cam1,u_cam2,v_cam2, ... as its first line",
        )


def _name_points(table: Columns, headings: Headings, sheet: Sheet) -> tuple[list[str] | None, str]:
    """The name of each row's point, None where the rows have none; and what was said to be a part of it."""
    if not headings.point:
        if headings.camera:
            raise DatasetError(
                f"{sheet.header_place}: no column names the points.",
                why="the table has one row for each view, and the views of a point belong together",
                fix="add a column point",
            )
        return None, "the points are named p0001, p0002, ..." if headings.guessed else ""
    points = table.texts[headings.point]
    one = points if not headings.camera else list(zip(points, table.texts[headings.camera], strict=True))
    if not headings.time or len(set(one)) == len(one):
        return points, ""
    both = [f"{time.strip()} {point}" for time, point in zip(table.texts[headings.time], points, strict=True)]
    return both, f"a point is named by {headings.time!r} and {headings.point!r}, as {both[0]!r}"


def _describe(writing: Writing, headings: Headings, said: str) -> list[str]:
    """One line that says how the table was read; none where it is as in docs/formats.md."""
    how = [*writing.describe(), *(headings.describe() if headings.guessed else []), *([said] if said else [])]
    if headings.further:
        more = f" and {len(headings.further) - 8} more" if len(headings.further) > 8 else ""
        how.append(f"kept as they are: {', '.join(map(repr, headings.further[:8]))}{more}")
    return [f"The table was read so: {'; '.join(how)}."] if how else []


def _count_missing(words: Counter[str]) -> list[str]:
    return [
        f"{times} cells of pixels say {word!r}: views that are missing, and taken as such."
        for word, times in words.items()
    ]
