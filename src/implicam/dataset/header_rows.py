"""Where the headings of a table are: in its first row, below a title or a comment, or in two rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from implicam.dataset.headings import read_headings
from implicam.errors import DatasetError

MAX_TITLE_ROWS = 10


class HeaderRows(NamedTuple):
    """The headings, the number of rows above the first row of data, and what was done to find them, in words."""

    header: list[str]
    rows: int
    said: str = ""


def find_header(rows: Sequence[Sequence[str]], cameras: Sequence[str] = ()) -> HeaderRows | None:
    """Find the headings of a table.

    Args:
        rows: The first rows, without those that are empty.
        cameras: Names that cameras are known to have.

    Returns:
        The headings; None where no row is one of headings that can be read.
    """
    for i, row in enumerate(rows[: MAX_TITLE_ROWS + 1]):
        header = [cell.strip() for cell in row]
        above = f"left out above the headings: {_title(rows[0])!r}{' and more' if i > 1 else ''}" if i else ""
        if is_header(header, cameras):
            return HeaderRows(header, i + 1, above)
        commented = [header[0].lstrip("# ").strip(), *header[1:]]
        if header[0].startswith("#") and is_header(commented, cameras):
            return HeaderRows(commented, i + 1, above)
        joined = _joined(header, rows[i + 1]) if i + 1 < len(rows) else []
        if joined and is_header(joined, cameras):
            both = f"the headings are in two rows: {joined[-1]!r}"
            return HeaderRows(joined, i + 2, f"{above}; {both}" if above else both)
        if not _is_title(header):
            return None
    return None


def is_header(header: Sequence[str], cameras: Sequence[str] = ()) -> bool:
    """Whether names are those of a table that can be read.

    Args:
        header: Without spaces around them.
        cameras: Names that cameras are known to have.
    """
    try:
        read_headings(header, "", cameras)
    except DatasetError:
        return False
    return len(set(header)) == len(header) or "" in header


def _is_title(row: Sequence[str]) -> bool:
    filled = [cell for cell in row if cell]
    return row[0].startswith("#") or (len(filled) < 3 and not any(map(is_number, filled[:1])))


def _title(row: Sequence[str]) -> str:
    return " ".join(cell.strip() for cell in row if cell.strip())[:60]


def _joined(above: Sequence[str], below: Sequence[str]) -> list[str]:
    """Headings of two rows, the upper of which spans columns: "Camera 1" above "u" and "v"."""
    below = [cell.strip() for cell in below]
    if len(below) > len(above) or any(map(is_number, below)) or sum(map(bool, below)) < 2 or "" not in above:
        return []
    joined, over = [], ""
    for i, upper in enumerate(above):
        over = upper or over
        joined.append(f"{over} {below[i]}".strip() if i < len(below) and below[i] else upper)
    return joined if len(set(joined)) == len(joined) else []


def is_number(text: str) -> bool:
    """Whether a cell is a number, with a decimal point or comma.

    Args:
        text: Of the cell.
    """
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True
