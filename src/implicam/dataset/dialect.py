"""How a table of text is written: what separates its cells, and whether its numbers have decimal commas.

Neither is guessed where there are two ways to read the file: then it is refused, with what makes it doubtful.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from implicam.dataset.tables import (
    NO_VALUE_WORDS,
    Row,
    check_header,
    check_width,
    read_lines,
    require_file,
    split_lines,
)
from implicam.errors import DatasetError

SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars"}
BLANKS = " "
"""Any number of blanks, where none of `SEPARATORS` is there."""

ROWS_LOOKED_AT = 50
"""Rows that must have as many cells as the header, before a character is taken for the separator."""

_SAID_BY_EXCEL = re.compile(r'"?sep=(.)"?\s*')  # a first line for Excel, which is no row
_LIKE_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")


class Writing(NamedTuple):
    """The separator, the number of lines before the header, and the decimal mark."""

    separator: str = ","
    skipped: int = 0
    decimal: str = "."

    def describe(self) -> list[str]:
        """What is unlike a CSV with commas and decimal points, in words."""
        marks = {**SEPARATORS, BLANKS: "blanks"}
        said = [] if self.separator == "," else [f"separated by {marks.get(self.separator, repr(self.separator))}"]
        return [*said, "decimal commas"] if self.decimal == "," else said


AS_DOCUMENTED = Writing()


def find_separator(path: Path, find_header: Callable[[list[list[str]]], int | None]) -> Writing:
    """Find what separates the cells of a table.

    Args:
        path: The file.
        find_header: The number of the row of headings, of the first rows; None where there is none that can be read.
            It decides where two characters would do.

    Returns:
        The separator, a comma where the header has one cell only.

    Raises:
        DatasetError: Two characters would do, or the file is no text.
    """
    lines = list(islice(read_lines(path), ROWS_LOOKED_AT))
    told = _SAID_BY_EXCEL.fullmatch(lines[0]) if lines else None
    if told:
        return Writing(told[1], 1)
    split = {mark: _split(lines, mark) for mark in SEPARATORS}
    at = {mark: find_header(rows) for mark, rows in split.items() if rows}
    below = {mark: rows[at.get(mark) or 0 :] for mark, rows in split.items()}
    possible = {mark: rows for mark, rows in below.items() if rows and len(rows[0]) > 1}
    if not any(number is not None for number in at.values()):
        blank = [line.split() for line in lines if line.strip()]
        number = find_header(blank)
        if number is not None and len({len(row) for row in blank[number:]}) == 1:
            return Writing(BLANKS)
    if len(possible) < 2:
        return Writing(next(iter(possible), ","))
    even = [mark for mark, rows in possible.items() if len({len(row) for row in rows}) == 1]
    read = [mark for mark in even or possible if at[mark] is not None]
    if len(read) == 1:
        return Writing(read[0])
    if len(even) == 1:
        return Writing(even[0])
    raise DatasetError(
        f"{path}, line 1: {' or '.join(SEPARATORS[mark] for mark in possible)} may separate the columns: "
        f"{lines[0].strip()[:60]!r}.",
        why="the headings can be read either way",
        fix='write a heading that contains one of them as "...", or leave it out of the headings',
    )


def _split(lines: list[str], separator: str) -> list[list[str]]:
    """The rows, as far as they can be read; the last may be cut off in a quoted cell."""
    rows = list[list[str]]()
    with suppress(csv.Error):
        rows += (row for row in csv.reader(lines, delimiter=separator, strict=True) if any(map(str.strip, row)))
    return rows


def rows_of(path: Path, writing: Writing) -> Iterator[Row]:
    """The rows of a table, its header first; lines without any text are left out.

    Args:
        path: The file.
        writing: How it is written.

    Raises:
        DatasetError: A row is not well-formed; names the line.
    """
    if writing.separator == BLANKS:
        yield from ((line, text.split()) for line, text in enumerate(read_lines(path), 1) if text.strip())
        return
    for line, row in split_lines(path, writing.separator):
        if line > writing.skipped and any(map(str.strip, row)):
            yield line, row


class Cells(NamedTuple):
    """What stands in the columns of numbers: the decimal mark, and how often which word says that there is no value."""

    decimal: str
    words: Counter[str]


def look_at_numbers(
    rows: Iterable[Row], numbers: Sequence[int], pixels: Collection[int], place: str, unit: str
) -> Cells:
    """Find the decimal mark of a table's numbers, and count the words that stand for none.

    Args:
        rows: Line number and cells.
        numbers: Which columns hold numbers.
        pixels: Which of them hold pixels; the words are counted there.
        place: The file, for errors.
        unit: What an error calls a row: "line", or "row".

    Raises:
        DatasetError: Some numbers have a comma and others a point, or the commas may separate thousands.
    """
    first: dict[str, tuple[int, str]] = {}
    thousands, words = True, Counter[str]()
    for line, row in rows:
        for i in numbers:
            cell = row[i].strip() if i < len(row) else ""
            if "," in cell:
                first.setdefault(",", (line, cell))
                thousands = thousands and _LIKE_THOUSANDS.fullmatch(cell) is not None
            if "." in cell:
                first.setdefault(".", (line, cell))
            elif i in pixels and cell and cell.lower() in (*NO_VALUE_WORDS, "nan"):
                words[cell] += 1
    if "," in first and "." in first:
        (a, comma), (b, point) = first[","], first["."]
        where = f"{unit} {a}" if a == b else f"{unit}s {a} and {b}"
        raise DatasetError(
            f"{place}, {where}: one number has a comma and one has a point: {comma[:30]!r} and {point[:30]!r}.",
            why="it cannot be told which is the decimal mark, and whether the other separates thousands",
            fix="write all numbers with decimal points, and without marks between thousands",
        )
    if "," in first and thousands:
        line, comma = first[","]
        raise DatasetError(
            f"{place}, {unit} {line}: {comma[:30]!r} may be a number with a decimal comma, or with a comma between "
            "thousands.",
            why="all numbers with a comma have three digits behind it, and none begins with 0",
            fix="write them with decimal points, or with another number of decimals",
        )
    return Cells("," if "," in first else ".", words)


class BroughtTable(NamedTuple):
    """A table with the columns of docs/formats.md, however it separates them: header, rows, and the decimal mark."""

    header: list[str]
    rows: Iterator[Row]
    decimal: str


def read_brought_table(
    path: Path, required: Sequence[str], numbers: Collection[str] = (), example: str = ""
) -> BroughtTable:
    """As `read_table`, of a table that a person wrote: with commas, semicolons, tabs or bars, and decimal commas.

    Args:
        path: The file.
        required: Columns that must be there.
        numbers: Columns that hold numbers, as far as they are there.
        example: How a header looks, for the error; empty for `required`.

    Returns:
        The table; `rows` raises DatasetError for a row that is no row of it.

    Raises:
        DatasetError: There is no such file, its header has a mistake, or it can be read in two ways.
    """
    example = example or ",".join(required)
    require_file(path, f"put a table with the columns {example} there")

    def first_row(rows: list[list[str]]) -> int | None:
        return 0 if rows and set(required) <= {cell.strip() for cell in rows[0]} else None

    writing = find_separator(path, first_row)
    rows = rows_of(path, writing)
    header = [name.strip() for name in next(rows, (1, []))[1]]
    if not header:
        raise DatasetError(f"{path} is empty.", fix=f"its first line must be {example}, then one row per entry")
    check_header(path, header, required)
    at = [i for i, name in enumerate(header) if name in numbers]
    decimal = look_at_numbers(islice(rows_of(path, writing), 1, None), at, (), str(path), "line").decimal
    return BroughtTable(header, check_width(f"{path}, line", len(header), rows), decimal)
