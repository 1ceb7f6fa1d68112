"""Reading CSV and TOML so that every mistake is named: file, line, value, cure."""

from __future__ import annotations

import csv
import difflib
import math
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from implicam.dataset.cells import unguard_cell
from implicam.dataset.model import (
    MAX_CELL_CHARACTERS,
    SD_POINT,
    WIDE_TABLE,
    Camera,
    Floats,
    KnownPositions,
    check_name,
    check_position_sd,
    check_unique,
)
from implicam.dataset.plain import to_plain
from implicam.errors import DatasetError

MAX_LINE_BYTES = 1 << 18  # no line of a table is longer; a longer one means that the file is something else
MAX_TOML_BYTES = 1 << 19
MAX_TOML_LINE_DOTS = 500  # tomllib takes quadratic time for a key of many parts

Row = tuple[int, list[str]]


class NumberColumn(NamedTuple):
    """The cure where a number is missing, the texts (small letters) that say that none is meant to be there, and the
    decimal mark."""

    cure_nan: str
    missing: tuple[str, ...] = ()
    decimal: str = "."


@dataclass(frozen=True)
class Columns:
    """A table of n rows by columns: texts and numbers (n,), NaN where missing; `place(i)` says where row i stands."""

    texts: Mapping[str, list[str]]
    numbers: Mapping[str, Floats]
    n: int
    place: Callable[[int], str]

    def stack(self, columns: Sequence[str]) -> Floats:
        """Columns of numbers side by side.

        Args:
            columns: Their names.

        Returns:
            (n, columns), NaN in a column that is not there.
        """
        return np.stack([self.numbers.get(column, np.full(self.n, np.nan)) for column in columns], axis=1)

    def known_positions(self, points: Sequence[str], extra: Iterable[str]) -> KnownPositions:
        """The positions, uncertainties and extra columns of the points.

        Args:
            points: n names; each point is a shot of its own where the table has no column `shot`.
            extra: Names of columns with text.

        Raises:
            DatasetError: A shot's name or an uncertainty is not possible; names the line.
        """
        shots = self.texts.get("shot", points)
        for i, shot in enumerate(shots):
            check_name(shot, "shot", self.place(i))
        sd = self.stack(SD_POINT)
        check_position_sd(sd, self.place)
        texts = {column: np.array(self.texts[column], dtype=np.str_) for column in extra}
        return KnownPositions(np.array(shots, dtype=np.str_), self.stack("xyz"), sd, texts)


def read_columns(
    path: Path | str,
    header: Sequence[str],
    rows: Iterable[Row],
    names: Sequence[str],
    numbers: Mapping[str, NumberColumn],
    unit: str = "line",
) -> Columns:
    """Read the rows of a table into columns.

    Args:
        path: The file, for errors; or the file and what in it.
        header: The names of all columns.
        rows: Line number and cells of each row, as `read_table` gives them.
        names: Columns whose texts lose the spaces around them; all other text stays as it is.
        numbers: Columns of numbers, and what may be missing in them.
        unit: What an error calls a row: "line", or "row".

    Raises:
        DatasetError: A cell is no number; names the line.
    """
    columns: dict[str, list[Any]] = {column: [] for column in header}
    lines, in_file = list[int](), f"{path}, {unit} "  # formatted once: a table may have a million rows
    for line, row in rows:
        lines.append(line)
        for column, text in zip(header, row, strict=True):
            if column in numbers:
                value: str | float = read_number(text, f"{in_file}{line}", column, **numbers[column]._asdict())
            else:
                value = text.strip() if column in names else text
            columns[column].append(value)
    values = {column: np.array(columns[column], dtype=np.float64) for column in header if column in numbers}
    texts = {column: columns[column] for column in header if column not in numbers}
    return Columns(texts, values, len(lines), lambda i: f"{in_file}{lines[i]}")


def read_table(path: Path, required: Sequence[str], example: str = "") -> tuple[list[str], Iterator[Row]]:
    """Read the header of a CSV table, and its rows as they are asked for; blank lines are skipped.

    Args:
        path: The file.
        required: Columns that must be there.
        example: How a header looks, for the error; empty for `required`.

    Returns:
        The names of the columns; and an iterator of line number and cells of each row.

    Raises:
        DatasetError: There is no such file, or its header has a mistake. The iterator raises it for a row.
    """
    example = example or ",".join(required)
    require_file(path, f"put a comma-separated table with the columns {example} there")
    rows = split_lines(path)
    _, header = next(rows, (1, []))
    if not header:
        raise DatasetError(f"{path} is empty.", fix=f"its first line must be {example}, then one row per entry")
    header = [name.strip() for name in header]
    check_header(path, header, required)
    return header, check_width(f"{path}, line", len(header), rows)


def require_file(path: Path, fix: str) -> None:
    """Refuse a path at which there is no file.

    Args:
        path: The file.
        fix: The cure that the error states.

    Raises:
        DatasetError: There is none, or it is a folder.
    """
    if path.is_dir():
        raise DatasetError(f"{path} is a folder, not a file.", fix=fix)
    if not path.is_file():
        raise DatasetError(f"{path} does not exist.", why=f"{path.parent} holds: {_list_folder(path.parent)}", fix=fix)


@contextmanager
def naming(place: Path | str) -> Iterator[None]:
    """A context that puts the file's name before an error of the values themselves.

    Args:
        place: The file, or where in it.

    Raises:
        DatasetError: That of the values, with the place before it.
    """
    try:
        yield
    except DatasetError as error:
        if str(place) in error.what:
            raise
        raise DatasetError(f"{place}: {error.what}", why=error.why, fix=error.fix) from None


def split_lines(path: Path, separator: str = ",") -> Iterator[Row]:
    """The rows of a table of text with the numbers of their lines; blank lines are skipped.

    Args:
        path: The file.
        separator: What is between two cells.

    Raises:
        DatasetError: A row is not well-formed, or the file is no text; names the line.
    """
    reader = csv.reader(read_lines(path), strict=True, delimiter=separator)
    first = 1  # the line on which the row begins; a quoted cell may go on over several
    try:
        for row in reader:
            if len(row) > 1 or (row and row[0].strip()):
                yield first, [unguard_cell(cell) for cell in row] if _may_be_guarded(row) else row
            first = reader.line_num + 1
    except csv.Error as error:
        raise DatasetError(
            f"{path}, line {first}: not a well-formed CSV row.",
            why=str(error),
            fix=f'write a cell that contains a {"comma" if separator == "," else "separator"} or a quote as "...", '
            "with inner quotes doubled",
        ) from error


def _may_be_guarded(row: list[str]) -> bool:
    return any(cell[:1] == "'" for cell in row)


def read_lines(path: Path) -> Iterator[str]:
    """Lines as text, read one at a time, so that a gigabyte of something else costs one line of memory.

    Args:
        path: The file.

    Raises:
        DatasetError: A line is no text, or too long.
    """
    with path.open("rb") as file:
        for number in range(1, 1 << 62):
            line = file.readline(MAX_LINE_BYTES + 1)
            if not line:
                return
            if number == 1:
                line = line.removeprefix(b"\xef\xbb\xbf")  # the byte order mark that Excel writes
                _refuse_other_text(path, line)
            if len(line) > MAX_LINE_BYTES or b"\0" in line:
                raise DatasetError(
                    f"{path}, line {number}: this is not a text table.",
                    why="the line holds zero bytes"
                    if b"\0" in line
                    else f"the line is longer than {MAX_LINE_BYTES} bytes",
                    fix="export the data as comma-separated text (CSV, UTF-8)",
                )
            yield _decode(path, number, line)


def _decode(path: Path, number: int, line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DatasetError(
            f"{path}, line {number}: byte {line[error.start]:#04x} is not UTF-8 text.",
            fix="save the file as CSV UTF-8",
        ) from None


def _refuse_other_text(path: Path, line: bytes) -> None:
    if line.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise DatasetError(f"{path}, line 1: the file is UTF-16 text.", fix="save it as CSV UTF-8")
    if b"\r" in line.rstrip(b"\r\n") and b"\0" not in line:
        raise DatasetError(
            f"{path}, line 1: the lines end as on old Macintosh computers (carriage return alone).",
            fix="save it as CSV UTF-8 with the line ends of Windows or Unix",
        )


def check_header(path: Path, header: list[str], required: Sequence[str]) -> None:
    """Check the headings of a table.

    Args:
        path: The file.
        header: They, without spaces around them.
        required: Columns that must be there.

    Raises:
        DatasetError: One is missing, or has a mistake.
    """
    if len(header) == 1:
        for separator, name in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
            if separator in header[0]:
                raise DatasetError(
                    f"{path}, line 1: the columns are separated by {name}: {header[0][:60]!r}.",
                    why="implicam reads comma-separated tables with decimal points, so that 1,5 is never mistaken",
                    fix="save as CSV with commas and decimal points (Excel: set the region to English, or "
                    f"pandas: read_csv(..., sep={separator!r}, decimal=',').to_csv(..., index=False))",
                )
    for name in required:
        if name not in header:
            raise DatasetError(
                f"{path}, line 1: the column {name!r} is missing; found {','.join(header)[:120]!r}.",
                why=_hint_misspelling(name, header),
                fix=f"the first line must name at least the columns {','.join(required)}",
            )
    check_headings(f"{path}, line 1", header)


def check_headings(place: str, header: Sequence[str]) -> None:
    """Refuse a column that has no name, one that no dataset could have, or the name of another.

    Args:
        place: File and line, for errors.
        header: The headings.

    Raises:
        DatasetError: For the first such column.
    """
    for name, times in Counter(header).items():
        if times > 1:
            raise DatasetError(
                f"{place}: the column {name[:60]!r} is there {times} times.",
                why="cells beyond the last name may be empty" if name == "" else "",
                fix="give every column a name of its own",
            )
        if name == "":
            raise DatasetError(
                f"{place}: a column has no name.",
                why="a comma at the end of a line, a spreadsheet, or the index of pandas makes one more column",
                fix="remove the comma or the column from every line, or give it a name",
            )
        with naming(place):
            check_name(name, "column name")


def check_width(place: str, width: int, rows: Iterable[Row]) -> Iterator[Row]:
    """The same rows, each checked.

    Args:
        place: What stands before the number of a line in an error: "rig.csv, line".
        width: Cells that a row has.
        rows: Line number and cells.

    Raises:
        DatasetError: A row has more cells, or fewer, or a cell is too long.
    """
    for line, row in rows:
        if len(row) != width:
            raise DatasetError(
                f"{place} {line}: {len(row)} cells, but the header names {width}: {','.join(row)[:80]!r}.",
                why="a decimal comma splits a number in two" if len(row) > width else "the row may be cut off",
                fix="give every column one cell; use decimal points",
            )
        if max(map(len, row)) > MAX_CELL_CHARACTERS:
            raise DatasetError(
                f"{place} {line}: a cell has {max(map(len, row))} characters: {max(row, key=len)[:40]!r}...",
                why="a quote may be missing" if any("\n" in cell for cell in row) else "",
                fix=f"shorten it to {MAX_CELL_CHARACTERS} characters",
            )
        yield line, row


def read_name(text: str, what: str, place: str) -> str:
    """Read a name, without the spaces around it.

    Args:
        text: The cell.
        what: What it names, for the error.
        place: File and line, for the error.

    Raises:
        DatasetError: The name is not usable.
    """
    name = text.strip()
    check_name(name, what, place)
    return name


NO_VALUE_WORDS = ("", "-", "--", "n/a", "na", "#n/a", "none", "null", "missing")
"""What people and spreadsheets write where there is no value; refused, with the cure that belongs to it."""


def read_number(
    text: str, place: str, column: str, *, cure_nan: str, missing: Sequence[str] = (), decimal: str = "."
) -> float:
    """Read a finite number.

    Args:
        text: The cell.
        place: File and line, for the error.
        column: Its column, for the error.
        cure_nan: What to do where the number is missing or not finite.
        missing: Texts (small letters) that are read as NaN.
        decimal: The decimal mark.

    Raises:
        DatasetError: If the text is no finite number; names the place, the value and the cure.
    """
    text = text.strip()
    if text.lower() in missing:
        return math.nan
    try:
        if "_" in text or not text.isascii():
            raise ValueError
        value = float(text if decimal == "." else text.replace(decimal, "."))
    except ValueError:
        comma = "," in text and decimal == "."
        raise DatasetError(
            f"{place}: {column} = {text[:60]!r} is not a number.",
            why="it has a decimal comma" if comma else "the cell is empty" if text == "" else "",
            fix="write it with a decimal point"
            if comma
            else cure_nan
            if text.lower() in NO_VALUE_WORDS
            else "correct the value or remove the row",
        ) from None
    if not math.isfinite(value):
        raise DatasetError(f"{place}: {column} = {text[:60]!r} is not a finite number.", fix=cure_nan)
    return value


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file as a dict of plain values.

    Args:
        path: The file.

    Raises:
        DatasetError: There is no such file, it is too long, or it is no TOML.
    """
    require_file(
        path,
        "a dataset is a folder with dataset.toml, observations.csv and (unless it is to be measured) points.csv; "
        "see docs/formats.md",
    )
    if path.stat().st_size > MAX_TOML_BYTES:
        raise DatasetError(
            f"{path} is {path.stat().st_size:,} bytes long; this is no dataset.toml.",
            fix="see docs/formats.md",
        )
    content = path.read_bytes()
    try:
        return parse_toml(content.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise DatasetError(
            f"{path}, line {line}: byte {content[error.start]:#04x} is not UTF-8 text.", fix="save the file as UTF-8"
        ) from None
    except ValueError as error:
        raise DatasetError(
            f"{path}: not valid TOML: {error}.",
            fix='check that line: text wants quotes (name = "my-rig"), tables are written [[cameras]]',
        ) from None


def parse_toml(text: str) -> dict[str, Any]:
    """Read TOML text as a dict of plain values.

    Args:
        text: Its content.

    Raises:
        ValueError: It is no TOML, is too long or too deeply nested.
    """
    if len(text) > MAX_TOML_BYTES:
        raise ValueError(f"it is {len(text):,} characters long")
    for line, content in enumerate(text.split("\n"), 1):
        if content.count(".") > MAX_TOML_LINE_DOTS:
            raise ValueError(f"more than {MAX_TOML_LINE_DOTS} dots in one line (at line {line}); break it into several")
    try:
        table: dict[str, Any] = to_plain(tomllib.loads(text))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    return table


def description_from_toml(table: dict[str, Any], path: Path) -> tuple[str, str, tuple[Camera, ...], dict[str, Any]]:
    """Read name, length unit, cameras and the further entries of a description.

    Args:
        table: The content of dataset.toml, as `read_toml` gives it.
        path: The file, for errors.

    Returns:
        Name, length unit, cameras, and the further entries.

    Raises:
        DatasetError: One of them is missing or has a mistake.
    """
    extra = dict(table)
    extra.pop(WIDE_TABLE, None)
    name = _pop_text(extra, "name", path, example="my-rig")
    unit = _pop_text(extra, "length_unit", path, example="mm")
    cameras = extra.pop("cameras", None)
    if not isinstance(cameras, list) or not cameras or not all(isinstance(c, dict) for c in cameras):
        raise DatasetError(
            f"{path}: there is no [[cameras]] table.",
            why=_hint_misspelling("cameras", extra),
            fix='add, for each camera, [[cameras]] with name = "cam1", width = 1280, height = 800',
        )
    made = tuple(_read_camera(dict(c), path) for c in cameras)
    with naming(path):
        check_unique([camera.name for camera in made], "camera")
    return name, unit, made, extra


def _read_camera(table: dict[str, Any], path: Path) -> Camera:
    name = _pop_text(table, "name", path, example="cam1")
    with naming(path):
        return Camera(name, table.pop("width", None), table.pop("height", None), table)


def _hint_misspelling(word: str, found: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, list(found), n=1)
    return f"{close[0]!r} may be a misspelling of it" if close else ""


def _pop_text(table: dict[str, Any], key: str, path: Path, *, example: str) -> str:
    if key not in table:
        raise DatasetError(
            f"{path}: {key!r} is missing.", why=_hint_misspelling(key, table), fix=f'write the line {key} = "{example}"'
        )
    value = table.pop(key)
    if not isinstance(value, str) or value.strip() == "":
        raise DatasetError(f"{path}: {key} = {repr(value)[:60]} must be text.", fix=f'write {key} = "{example}"')
    return value.strip()


def _list_folder(folder: Path) -> str:
    if not folder.is_dir():
        return f"nothing ({folder} is not a folder)"
    names = sorted(entry.name for entry in folder.iterdir())
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "") or "nothing"
