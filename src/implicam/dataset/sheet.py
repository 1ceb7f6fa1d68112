"""A table that people bring, without a description beside it: read as far as there is one way to read it.

One row per point, `x,y,z,u_cam1,v_cam1,...`, or one per view, `point,camera,u,v`. A note says in one line how the
headings were read, where they are not those of docs/formats.md; other notes name each mark for a missing view.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from implicam.dataset.dialect import AS_DOCUMENTED, Writing, find_separator, look_at_numbers, rows_of
from implicam.dataset.headings import Headings, read_headings
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

    @property
    def header_place(self) -> str:
        """Where the header stands, for errors."""
        return f"{self.place}, {self.unit} {self.first}"


def sheet_of_text(path: Path) -> Sheet:
    """The cells of a CSV, with commas, semicolons, tabs or bars.

    Args:
        path: The file.

    Raises:
        DatasetError: There is no such file, it is no text, or has no header.
    """
    require_file(path, f"put a comma-separated table with the columns {EXAMPLE_HEADER} there")
    writing = find_separator(path, is_header)
    first, header = next(rows_of(path, writing), (1, list[str]()))
    if not header:
        raise DatasetError(f"{path} is empty.", fix=f"its first line must be {EXAMPLE_HEADER}, then one row per entry")

    def rows() -> Iterator[Row]:
        everything = rows_of(path, writing)
        next(everything)
        return everything

    return Sheet(str(path), header, rows, first=first, writing=writing)


def is_header(header: Sequence[str]) -> bool:
    """Whether names are those of a table that can be read.

    Args:
        header: Without spaces around them.
    """
    try:
        read_headings(header, "")
    except DatasetError:
        return False
    return True


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
    sheet = _without_empty_columns(sheet)
    _refuse_numbers(sheet)
    check_headings(sheet.header_place, sheet.header)
    headings = read_headings(sheet.header, sheet.header_place)
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


def _refuse_numbers(sheet: Sheet) -> None:
    if sum(map(_is_number, sheet.header)) > len(sheet.header) / 2:
        raise DatasetError(
            f"{sheet.header_place}: the first {sheet.unit} holds numbers, and no names of columns.",
            fix="write x,y,z,u_cam1,v_cam1,u_cam2,v_cam2, ... as its first line",
        )


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


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
