"""Tables in Excel's .xlsx, read and written with openpyxl.

A workbook is read where one sheet of it holds a table. Numbers are numbers there, so it needs no decimal mark. A
formula whose value was not stored, and an error such as #REF!, are refused: a cell without a value would be a view that
is missing.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from implicam.dataset.header_rows import MAX_TITLE_ROWS, is_header
from implicam.dataset.headings import find_positions, read_headings
from implicam.dataset.sheet import Sheet, cell_text, sheet_below
from implicam.dataset.tables import Row, require_file
from implicam.errors import DatasetError, import_extra
from implicam.files import MAX_INFLATION_RATIO, MIN_INFLATED_BYTES, replacing

DESCRIPTION_SHEET = "implicam"
"""The sheet that holds the description of a dataset, the text of dataset.toml, a line a cell."""

MAX_CELLS = 20_000_000
"""Rows times columns that a sheet may declare; Excel itself has room for 17 billion."""


def read_excel(path: Path, cameras: Sequence[str] = ()) -> tuple[Sheet, str | None]:
    """Read a workbook.

    Args:
        path: The file.
        cameras: Names that cameras are known to have.

    Returns:
        The table, and the description that `write_excel` put beside it; None where there is none.

    Raises:
        DatasetError: It is no workbook, several sheets hold tables, or a cell has no value of its own.
        MissingExtraError: openpyxl is not installed.
    """
    openpyxl = import_extra("openpyxl", "excel", "reading Excel workbooks")
    require_file(path, "check the name")
    content = path.read_bytes()
    try:
        _refuse_bomb(path, content)
        values = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True)
        return _read_sheets(path, values, openpyxl.load_workbook(io.BytesIO(content), read_only=True), cameras)
    except DatasetError:
        raise
    except (zipfile.BadZipFile, KeyError, ValueError, TypeError, OSError, EOFError, SyntaxError) as error:
        raise DatasetError(
            f"{path} is not a readable Excel workbook.",
            why=str(error)[:300],
            fix="save it as .xlsx (not .xls), or as CSV",
        ) from None


def _refuse_bomb(path: Path, content: bytes) -> None:
    """Refuse a zip that would grow beyond all measure, before it is unpacked."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        size = sum(member.file_size for member in archive.infolist())
    if size > max(MIN_INFLATED_BYTES, MAX_INFLATION_RATIO * len(content)):
        raise DatasetError(
            f"{path} is {len(content):,} bytes long, and would be {size:,} bytes unpacked.",
            why="no table shrinks so much",
            fix="save the table as CSV",
        )


def _read_sheets(path: Path, values: Any, formulas: Any, cameras: Sequence[str]) -> tuple[Sheet, str | None]:
    description = None
    tables: dict[str, Sheet] = {}
    for name in values.sheetnames:
        cells = _cells(path, name, values[name], formulas[name])
        if name == DESCRIPTION_SHEET:
            description = "\n".join("".join(row) for _, row in cells)
        elif any(any(row) for _, row in cells):
            tables[name] = _sheet(path, name, cells, cameras)
    readable = {name: sheet for name, sheet in tables.items() if is_header(sheet.header, cameras)}
    found = list((readable or tables).values())
    if len(found) != 1:
        raise DatasetError(
            f"{path} has {len(found)} sheets with a table: {', '.join(map(repr, list(tables)[:8]))}."
            if found
            else f"{path} is empty.",
            fix="keep one sheet, or save the one that is meant as CSV",
        )
    others = {name: sheet for name, sheet in tables.items() if sheet is not found[0]}
    return (found[0] if description is not None else _with_positions(found[0], others)), description


def _with_positions(table: Sheet, others: dict[str, Sheet]) -> Sheet:
    """The table with the known positions of another sheet beside it, where names of points say which is which."""
    header = [cell.strip() for cell in table.header]
    own = read_headings(header, table.header_place, table.cameras)
    places = {name: find_positions(sheet.header, sheet.header_place) for name, sheet in others.items()}
    with_positions = [name for name, columns in places.items() if columns] if not own.positions else []
    unused = [name for name in others if name not in with_positions]
    said = (*table.said, f"left out are the sheets {', '.join(map(repr, unused))}") if unused else table.said
    if not with_positions:
        return replace(table, said=said)
    name, sheet = with_positions[0], others[with_positions[0]]
    point, _ = places[name] or ("", ())
    if len(with_positions) > 1 or not own.point:
        why = f"the sheets {', '.join(map(repr, with_positions))} have x, y and z"
        raise DatasetError(
            f"{table.place}: it cannot be told which known positions belong to these pixels.",
            why=why if own.point else f"{why}, and no column names the points of these pixels",
            fix="put x, y and z beside the pixels, or name the points in both sheets, and keep one sheet of positions",
        )
    at, rows = sheet.header.index(point), {}
    for line, row in sheet.rows():
        key = row[at].strip()
        if key in rows:
            raise DatasetError(
                f"{sheet.place}, row {line}: the point {key!r} is there twice.", fix="give each point one position"
            )
        rows[key] = [cell for i, cell in enumerate(row) if i != at]
    more = [heading for heading in sheet.header if heading != point]
    of_table = header.index(own.point)

    def joined() -> Iterator[Row]:
        return ((line, [*row, *rows.get(row[of_table].strip(), [""] * len(more))]) for line, row in table.rows())

    named = {row[of_table].strip() for _, row in table.rows()}
    rest = len(set(rows) - named)
    told = f"the known positions are in the sheet {name!r}"
    told += f", {rest} of them of points that no camera saw" if rest else ""
    return replace(table, header=[*header, *more], rows=joined, said=(*said, told))


def _cells(path: Path, name: str, values: Any, formulas: Any) -> list[Row]:
    """The cells of a sheet as text, with the numbers of the rows."""
    if (values.max_row or 0) * (values.max_column or 0) > MAX_CELLS:
        raise DatasetError(
            f"{path}, sheet {name!r}: {values.max_row} rows of {values.max_column} cells are too many.",
            fix="delete the empty rows and columns around the table, or save it as CSV",
        )
    rows = []
    pairs = zip(values.iter_rows(values_only=True), formulas.iter_rows(values_only=True), strict=True)
    for number, (row, written) in enumerate(pairs, 1):
        for column, (value, formula) in enumerate(zip(row, written, strict=True), 1):
            if value is None and formula is not None:
                where = f"{path}, sheet {name!r}, row {number}, cell {column}"
                raise DatasetError(
                    f"{where}: the value of the formula {str(formula)[:60]!r} is not in the file.",
                    why="a program wrote the formula, and no spreadsheet has computed it since",
                    fix="open the file in a spreadsheet and save it, or write values in place of formulas",
                )
        rows.append((number, [cell_text(value) for value in row]))
    return rows


def _sheet(path: Path, name: str, cells: list[Row], cameras: Sequence[str]) -> Sheet:
    filled = [(number, row) for number, row in cells if any(cell.strip() for cell in row)]
    return sheet_below(f"{path}, sheet {name!r}", filled[: MAX_TITLE_ROWS + 2], lambda: iter(filled), "row", cameras)


def write_excel(path: Path, columns: Sequence[tuple[str, list[Any]]], description: str = "") -> None:
    """Write a table, and its description on a sheet of its own; openpyxl writes numbers with 16 digits.

    Args:
        path: The file; one that is there is replaced.
        columns: Heading and cells of each: numbers, text, or None for an empty cell. A text is never a formula.
        description: The text of dataset.toml; a table without one has no such sheet.

    Raises:
        DatasetError: A text has a character that no workbook has.
        MissingExtraError: openpyxl is not installed.
        ImplicamError: The file cannot be written.
    """
    openpyxl = import_extra("openpyxl", "excel", "writing Excel workbooks")
    book = openpyxl.Workbook(write_only=True)

    def cell(sheet: Any, value: object) -> Any:
        made = openpyxl.cell.WriteOnlyCell(sheet, value=value)
        if isinstance(value, str):
            made.data_type = "s"  # "=1+1" is a name
        return made

    table = book.create_sheet("table")
    try:
        table.append([cell(table, heading) for heading, _ in columns])
        for row in zip(*(cells for _, cells in columns), strict=True):
            table.append([cell(table, value) for value in row])
        if description:
            beside = book.create_sheet(DESCRIPTION_SHEET)
            for line in description.splitlines():
                beside.append([cell(beside, line)])
    except openpyxl.utils.exceptions.IllegalCharacterError as error:
        raise DatasetError(
            f"{path} cannot hold all text of the table.",
            why=f"a cell has a character that no workbook has: {str(error)[:100]}",
            fix="write it as .csv or .parquet",
        ) from None
    with replacing(path) as temporary:
        book.save(temporary)
