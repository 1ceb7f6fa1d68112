"""Positions from a table: where another machine was at each shot, or the only positions that a slide has."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import ClassVar, Self

import numpy as np

from implicam.errors import HardwareError, UsageError
from implicam.hardware.protocol import Floats, RobotOptions, check_position, incomplete_spec_error

POSITION_COLUMNS, SD_COLUMNS = ("x", "y", "z"), ("sd_x", "sd_y", "sd_z")
MAX_FILE_BYTES = 200_000_000


class CsvPlayer:
    """The `Robot` whose places are the rows x, y, z[, sd_x, sd_y, sd_z] of a CSV file; each is used once.

    `move` goes to the row nearest to the wish of those that are left; `reachable` gives them. Other columns are
    ignored. HardwareError, on `open`, with the file and line for what is no number.
    """

    moves = True
    alone = False  # a person or another machine puts the target there
    spec: ClassVar[str] = "csv:FILE"
    options: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def from_spec(cls, rest: str, options: RobotOptions) -> Self:
        """A player of the file that a spec names; the file is not read yet.

        Args:
            rest: The path of the CSV file.
            options: No option is needed.

        Raises:
            UsageError: There is no path, or `options.sd` is given: the table says how well its positions are known.
        """
        if not rest:
            raise incomplete_spec_error("robot", cls, rest)
        if options.sd is not None:
            raise UsageError("the table says how well its positions are known.", fix="give it columns sd_x, sd_y, sd_z")
        return cls(rest)

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._xyz, self._sd = np.zeros((0, 3)), np.zeros((0, 3))
        self._left = np.zeros(0, dtype=np.bool_)
        self._here: int | None = None
        self._is_open = False

    @property
    def sd(self) -> tuple[float, float, float]:
        """What the row says where the target is; NaN where it says nothing."""
        if self._here is None:
            return (np.nan, np.nan, np.nan)
        x, y, z = self._sd[self._here].tolist()
        return (x, y, z)

    def open(self) -> None:
        """Read the file; the second time nothing happens, and the rows that were used stay used."""
        if self._is_open:
            return
        rows = read_positions(self.path)
        self._xyz, self._sd = rows[:, :3], rows[:, 3:]
        self._left = np.ones(len(rows), dtype=np.bool_)
        self._is_open = True

    def position(self) -> Floats:
        """(3,) the row that was gone to last; HardwareError before the first move."""
        if self._here is None:
            raise HardwareError(
                f"{self.path.name} is at none of its rows yet.", why="no move was made", fix="move to a position first"
            )
        return np.array(self._xyz[self._here])

    def move(self, xyz: Floats) -> Floats:
        """Go to the nearest row that is left; of two as near, to the earlier one.

        Args:
            xyz: (3,) the wish, in the dataset's unit and world frame.

        Returns:
            (3,) the position of that row.

        Raises:
            HardwareError: All rows have been used, the file cannot be read, or the wish is no position.
        """
        wish = check_position(xyz)
        self.open()
        rows = np.flatnonzero(self._left)
        if len(rows) == 0:
            raise HardwareError(
                f"all {len(self._xyz)} rows of {self.path} have been used.",
                why="each row is one position, and is used once",
                fix="end the session, or give a file with more rows",
            )
        self._here = int(rows[np.argmin(np.linalg.norm(self._xyz[rows] - wish, axis=1))])
        self._left[self._here] = False
        return self.position()

    def stop(self) -> None:
        """Nothing to stop."""

    def reachable(self) -> Floats:
        """(n, 3) the rows that are left."""
        self.open()
        return self._xyz[self._left].copy()

    def close(self) -> None:
        """Forget which rows were used: `open` reads the file again."""
        self._is_open = False
        self._here = None


def read_positions(path: Path) -> Floats:
    """Read a table of positions.

    Args:
        path: A CSV file with a head x, y, z and, where known, sd_x, sd_y, sd_z; other columns are ignored.

    Returns:
        (n, 6) x, y, z and their standard uncertainties in the file's unit, NaN where it has none.

    Raises:
        HardwareError: The file cannot be read, a column is missing, a cell is no number or an sd not above zero; the
            error names the line.
    """
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise HardwareError(f"{path} is larger than 200 MB.", fix="give a table of positions, one row a shot")
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise HardwareError(
            f"{path} cannot be read.", why=str(error), fix="check the name; CSV text in UTF-8"
        ) from error
    reader = csv.reader(lines)
    head = [word.strip() for word in next(reader, [])]
    missing = [word for word in POSITION_COLUMNS if head.count(word) != 1]
    if missing:
        raise HardwareError(
            f"{path}, line 1: there is no single column {', '.join(missing)}.",
            why=f"the columns are {', '.join(head) or 'none'}",
            fix="begin the file with the line x,y,z or x,y,z,sd_x,sd_y,sd_z",
        )
    rows = [_read_row(path, reader.line_num, head, cells) for cells in reader if any(cell.strip() for cell in cells)]
    if not rows:
        raise HardwareError(f"{path} has no row of numbers.", fix="one position a line below x,y,z")
    return np.array(rows, dtype=np.float64)


def _read_row(path: Path, line: int, head: list[str], cells: list[str]) -> list[float]:
    if len(cells) != len(head):
        raise HardwareError(
            f"{path}, line {line}: {len(cells)} cells under {len(head)} columns.", fix="give every column one cell"
        )
    table = dict(zip(head, cells, strict=True))
    out = [_read_number(path, line, word, table[word]) for word in POSITION_COLUMNS]
    return out + [_sd(path, line, word, table.get(word, "")) for word in SD_COLUMNS]


def _sd(path: Path, line: int, column: str, cell: str) -> float:
    value = _read_number(path, line, column, cell) if cell.strip() else np.nan
    if value <= 0:
        raise HardwareError(
            f"{path}, line {line}: {column} = {value:g}.",
            why="a standard uncertainty is above zero",
            fix="leave the cell empty where it is not known",
        )
    return value


def _read_number(path: Path, line: int, column: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise HardwareError(
            f"{path}, line {line}: {column} = {cell[:40]!r} is no number.", fix="write numbers with a decimal point"
        )
    return value
