"""Reading CSV and TOML so that every mistake is named: file, line, value, cure."""

from __future__ import annotations

import csv
import math
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from implicam.dataset.model import Camera
from implicam.errors import DatasetError, did_you_mean

MAX_LINE_BYTES = 1 << 18  # no line of a table is longer; a longer one means that the file is something else
MAX_TOML_BYTES = 1 << 20

Row = tuple[int, list[str]]


def read_table(path: Path, required: Sequence[str]) -> tuple[list[str], Iterator[Row]]:
    """The header, and the rows with their line numbers, read as they are asked for."""
    if not path.is_file():
        raise DatasetError(
            f"{path} does not exist.",
            why=f"{path.parent} holds: {_listing(path.parent)}",
            fix=f"put a comma-separated table with the columns {','.join(required)} there",
        )
    rows = _rows(path)
    _, header = next(rows, (1, []))
    if not header:
        raise DatasetError(
            f"{path} is empty.", fix=f"its first line must be {','.join(required)}, then one row per entry"
        )
    header = [name.strip() for name in header]
    _check_header(path, header, required)
    return header, _checked_width(path, len(header), rows)


def _rows(path: Path) -> Iterator[Row]:
    reader = csv.reader(_lines(path), strict=True)
    try:
        for row in reader:
            if row:
                yield reader.line_num, row
    except csv.Error as error:
        raise DatasetError(
            f"{path}, line {reader.line_num}: not a well-formed CSV row.",
            why=str(error),
            fix='write a cell that contains a comma or a quote as "...", with inner quotes doubled',
        ) from error


def _lines(path: Path) -> Iterator[str]:
    """Lines as text, read one at a time, so that a gigabyte of something else costs one line of memory."""
    with path.open("rb") as file:
        for number in range(1, 1 << 62):
            line = file.readline(MAX_LINE_BYTES + 1)
            if not line:
                return
            if number == 1:
                line = line.removeprefix(b"\xef\xbb\xbf")  # the mark that Excel puts before UTF-8
                _refuse_utf16(path, line)
            if len(line) > MAX_LINE_BYTES or b"\0" in line:
                raise DatasetError(
                    f"{path}, line {number}: this is not a text table.",
                    why="the line holds zero bytes"
                    if b"\0" in line
                    else f"the line is longer than {MAX_LINE_BYTES} bytes",
                    fix="export the data as comma-separated text (CSV, UTF-8)",
                )
            yield _decoded(path, number, line)


def _decoded(path: Path, number: int, line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DatasetError(
            f"{path}, line {number}: byte {line[error.start]:#04x} is not UTF-8 text.",
            fix="save the file as CSV UTF-8",
        ) from None


def _refuse_utf16(path: Path, line: bytes) -> None:
    if line.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise DatasetError(f"{path}, line 1: the file is UTF-16 text.", fix="save it as CSV UTF-8")


def _check_header(path: Path, header: list[str], required: Sequence[str]) -> None:
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
                why=f"a column may be misspelt{did_you_mean(name, header)}" if did_you_mean(name, header) else "",
                fix=f"the first line must name at least the columns {','.join(required)}",
            )
    for name in header:
        if name == "" or not name.isprintable() or header.count(name) > 1:
            raise DatasetError(
                f"{path}, line 1: column name {name!r} is empty, unprintable or there twice.",
                fix="give every column a name of its own",
            )


def _checked_width(path: Path, width: int, rows: Iterator[Row]) -> Iterator[Row]:
    for line, row in rows:
        if len(row) != width:
            raise DatasetError(
                f"{path}, line {line}: {len(row)} cells, but the header names {width}: {','.join(row)[:80]!r}.",
                why="a decimal comma splits a number in two" if len(row) > width else "the row may be cut off",
                fix="give every column one cell; use decimal points",
            )
        yield line, [cell.strip() for cell in row]


def number(text: str, place: str, column: str, *, cure_nan: str) -> float:
    """A finite number, or an error that names the place, the value and the cure."""
    try:
        if "_" in text or not text.isascii():
            raise ValueError
        value = float(text)
    except ValueError:
        comma = "," in text
        raise DatasetError(
            f"{place}: {column} = {text!r} is not a number.",
            why="it has a decimal comma" if comma else "the cell is empty" if text == "" else "",
            fix="write it with a decimal point"
            if comma
            else cure_nan
            if text == ""
            else "correct the value or remove the row",
        ) from None
    if not math.isfinite(value):
        raise DatasetError(f"{place}: {column} = {text!r} is not a finite number.", fix=cure_nan)
    return value


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as a dict."""
    if not path.is_file():
        raise DatasetError(
            f"{path} does not exist.",
            why=f"{path.parent} holds: {_listing(path.parent)}",
            fix="a dataset is a folder with dataset.toml, observations.csv and (unless it is to be measured) "
            "points.csv; see docs/formats.md",
        )
    if path.stat().st_size > MAX_TOML_BYTES:
        raise DatasetError(
            f"{path} is {path.stat().st_size:,} bytes long; this is no dataset.toml.",
            fix="see docs/formats.md",
        )
    try:
        return parse_toml(path.read_bytes().decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path}: byte {error.start} is not UTF-8 text.", fix="save the file as UTF-8") from None
    except ValueError as error:
        raise DatasetError(
            f"{path}: not valid TOML: {error}.",
            fix='check that line: text wants quotes (name = "my-rig"), tables are written [[cameras]]',
        ) from None


def parse_toml(text: str) -> dict[str, Any]:
    """TOML text as a dict; ValueError for whatever is wrong with it."""
    try:
        return tomllib.loads(text.replace("\r\n", "\n"))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def description_from_toml(table: dict[str, Any], path: Path) -> tuple[str, str, tuple[Camera, ...], dict[str, Any]]:
    """Name, length unit, cameras and whatever else dataset.toml says."""
    extra = dict(table)
    name = _text_entry(extra, "name", path, example="my-rig")
    unit = _text_entry(extra, "length_unit", path, example="mm")
    cameras = extra.pop("cameras", None)
    if not isinstance(cameras, list) or not cameras or not all(isinstance(c, dict) for c in cameras):
        raise DatasetError(
            f"{path}: there is no [[cameras]] table{did_you_mean('cameras', extra)}.",
            fix='add, for each camera, [[cameras]] with name = "cam1", width = 1280, height = 800',
        )
    return name, unit, tuple(_camera(dict(c), path) for c in cameras), extra


def _camera(table: dict[str, Any], path: Path) -> Camera:
    name = _text_entry(table, "name", path, example="cam1")
    sizes = {}
    for key in ("width", "height"):
        if key not in table and did_you_mean(key, table):
            raise DatasetError(
                f"{path}: camera {name!r} has no {key}{did_you_mean(key, table)}.",
                fix=f"write {key} = 1280, in pixels",
            )
        sizes[key] = table.pop(key, None)
    try:
        return Camera(name, sizes["width"], sizes["height"], table)
    except DatasetError as error:
        raise DatasetError(f"{path}: {error.what}", why=error.why, fix=error.fix) from None


def _text_entry(table: dict[str, Any], key: str, path: Path, *, example: str) -> str:
    if key not in table:
        raise DatasetError(
            f"{path}: {key!r} is missing{did_you_mean(key, table)}.", fix=f'add the line {key} = "{example}"'
        )
    value = table.pop(key)
    if not isinstance(value, str) or value.strip() == "":
        raise DatasetError(f"{path}: {key} = {value!r} must be text.", fix=f'write {key} = "{example}"')
    return value.strip()


def _listing(folder: Path) -> str:
    if not folder.is_dir():
        return f"nothing ({folder} is not a folder)"
    names = sorted(entry.name for entry in folder.iterdir())
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "") or "nothing"
