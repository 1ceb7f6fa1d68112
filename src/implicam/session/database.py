"""session.db: the tables of a guided session, who may open them, and how a point becomes rows and comes back.

    session    one row: name, length_unit; created and opened (the last time), ISO 8601 in UTC as all times here
    cameras    number, name, width, height (pixels, empty where unknown), more (further entries, TOML)
    settings   key, value (JSON), time of the last change
    shots      number (the order of accepting), name, state, time, notes (JSON)
               state: accepted; undone (taken back, kept); begun (its pictures are being written, it is no point yet)
    points     one row a point: shot, number (its place in the shot), point, x, y, z, sd_x, sd_y, sd_z, more;
               the corners of boards, and the ends of a wand, at places that nobody knows have no numbers
    views      one row a view: shot, point, camera, u, v, sd_u, sd_v, more
    skipped    number, x, y, z, reason, time
    events     number, time, what, more (JSON)

World frame, length unit and pixels are those of the dataset (docs/conventions.md). An sd that is not stated is NULL;
`more` holds the further columns of points.csv and observations.csv as JSON, text by name. The pictures are files,
images/<camera>/<shot>.png. `PRAGMA user_version` is the version of these tables, `PRAGMA application_id` is 'impc'.
"""

from __future__ import annotations

import json
import math
import os
import sqlite3
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset import Camera, Dataset, Floats, KnownPositions, Names, Observations
from implicam.dataset.boards import corner_shots
from implicam.dataset.folder import POINTS, VIEWS
from implicam.dataset.model import MAX_CELL_CHARACTERS
from implicam.dataset.wand import FRAME
from implicam.errors import DatasetError, ImplicamError, UsageError
from implicam.files import toml_text
from implicam.formatting import json_default

DATABASE = "session.db"
TABLES_VERSION = 1
MAX_DATABASE_BYTES = 1_000_000_000
"""Of a session.db that is opened: some thousand boards of a hundred corners for a rig of 24 cameras."""

MAX_VALUE_BYTES = 64_000_000
"""Of one text in it."""

MAX_CELLS = 50_000_000
"""Of a table of points and cameras, and of all further columns together."""

_CHUNK_ROWS = 10_000

MAX_OPENING_SECONDS = 120.0
"""For which a database may be read until its points are there; one made to be read for ever is refused."""
APPLICATION_ID = int.from_bytes(b"impc", "big")

# Numbers have no declared type: a column that is REAL turns -0.0 into 0.0, and what is accepted comes back bit by bit.
_TABLES = (
    "CREATE TABLE session (name TEXT, length_unit TEXT, created TEXT, opened TEXT)",
    "CREATE TABLE cameras (number INTEGER PRIMARY KEY, name TEXT UNIQUE, width INTEGER, height INTEGER, more TEXT)",
    "CREATE TABLE settings (key TEXT PRIMARY KEY, value TEXT, time TEXT)",
    "CREATE TABLE shots (number INTEGER PRIMARY KEY, name TEXT UNIQUE,"
    " state TEXT CHECK (state IN ('begun', 'accepted', 'undone')), time TEXT, notes TEXT)",
    "CREATE TABLE points (shot TEXT, number INTEGER, point TEXT, x, y, z, sd_x, sd_y, sd_z, more TEXT,"
    " PRIMARY KEY (shot, number))",
    "CREATE TABLE views (shot TEXT, point TEXT, camera TEXT, u, v, sd_u, sd_v, more TEXT,"
    " PRIMARY KEY (shot, point, camera))",
    "CREATE TABLE skipped (number INTEGER PRIMARY KEY, x, y, z, reason TEXT, time TEXT)",
    "CREATE TABLE events (number INTEGER PRIMARY KEY, time TEXT, what TEXT, more TEXT)",
)


class Database:
    """The one connection to a session's database, which is locked until `close`, or the end of the process.

    Every failure is an ImplicamError that says what to do. The caller sees to it that one thread uses it at a time.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self._path, self._connection = path, connection

    @classmethod
    def create(cls, path: Path) -> Database:
        """Create a database, locked, inside a transaction that `write_tables` ends.

        Args:
            path: The file.

        Returns:
            The database, without tables yet.

        Raises:
            UsageError: There is a session already, or it is open elsewhere.
            ImplicamError: The file cannot be written.
        """
        database = cls._connect(path, "rwc")
        with database._closing_on_error():
            database.run("BEGIN EXCLUSIVE")
            if database.rows("SELECT name FROM sqlite_master"):
                raise UsageError(
                    f"{path} is there already.",
                    why="a session was begun in this folder before",
                    fix="continue it, or choose another folder",
                )
        return database

    def write_tables(self, name: str, length_unit: str, cameras: Sequence[Camera], settings: Mapping[str, str]) -> None:
        """Write the tables and what a session begins with, all or nothing.

        Args:
            name: Of the session.
            length_unit: That of its positions.
            cameras: In their order.
            settings: Key -> value as JSON text.

        Raises:
            ImplicamError: The file cannot be written; the database is closed then.
        """
        with self._closing_on_error():
            for table in _TABLES:
                self.run(table)
            self.run("INSERT INTO session VALUES (?, ?, ?, ?)", name, length_unit, now(), now())
            for number, camera in enumerate(cameras):
                more = toml_text(camera.extra)
                self.run(
                    "INSERT INTO cameras VALUES (?, ?, ?, ?, ?)", number, camera.name, camera.width, camera.height, more
                )
            for key, value in settings.items():
                self.run("INSERT INTO settings VALUES (?, ?, ?)", key, value, now())
            self.run(f"PRAGMA application_id = {APPLICATION_ID}")
            self.run(f"PRAGMA user_version = {TABLES_VERSION}")
            self.run("COMMIT")

    @classmethod
    def open(cls, path: Path) -> Database:
        """Open a database, check it and lock it; where that fails, nothing in it was changed.

        Args:
            path: The file.

        Raises:
            UsageError: It is open elsewhere.
            DatasetError: There is none, or it is damaged, another program's, or a newer version's.
            ImplicamError: The file cannot be written.
        """
        if not os.path.isfile(path):  # Path.is_file raises where the folder may not be read
            raise DatasetError(
                f"{path.parent} is no session.",
                why=f"it has no {path.name}, or may not be looked into",
                fix="name the folder of a session, or begin one there",
            )
        _check_files(path)
        database = cls._connect(path, "rw")
        with database._closing_on_error():
            database._limit_reading()
            database.run("BEGIN EXCLUSIVE")
            database._check()
            database.run("UPDATE session SET opened = ?", now())  # a disk that cannot be written to shows now
            database.run("COMMIT")
        return database

    @classmethod
    def _connect(cls, path: Path, mode: str) -> Database:
        """The lock is SQLite's own, on the open file: a kill frees it, and no lock file can be left behind.

        On Unix such a lock is also lost when this process opens and closes session.db by any other way than SQLite.

        A rollback journal and no write-ahead log: between two points session.db alone is the whole session, for one
        who copies it, and a point is committed every few seconds, so a second flush costs nothing that is noticed.
        EXTRA is FULL, and the folder is flushed too when the journal goes: else a power cut could bring it back, and
        with it the state before the last point.
        """
        try:
            uri = f"{path.absolute().as_uri()}?mode={mode}"
            connection = sqlite3.connect(uri, uri=True, timeout=0, isolation_level=None, check_same_thread=False)
        except sqlite3.Error as error:
            raise _explain_sqlite_error(path, error) from error
        database = cls(path, connection)
        with database._closing_on_error():
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_VALUE_BYTES)
            connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
            for setting in (
                "trusted_schema = OFF", "cell_size_check = ON", "secure_delete = ON", "locking_mode = EXCLUSIVE",
                "synchronous = EXTRA",
            ):  # fmt: skip
                database.run(f"PRAGMA {setting}")
        return database

    def _limit_reading(self) -> None:
        end = time.monotonic() + MAX_OPENING_SECONDS
        self._connection.set_progress_handler(lambda: time.monotonic() > end, 100_000)

    def end_of_reading(self) -> None:
        """What was opened has been read: from here on nothing limits how long a statement may take."""
        self._connection.set_progress_handler(None, 0)

    def _check(self) -> None:
        (application,), (version,) = self.rows("PRAGMA application_id") + self.rows("PRAGMA user_version")
        if not self.rows("SELECT name FROM sqlite_master"):
            raise DatasetError(
                f"{self._path} is empty.",
                why="the program was stopped while it began the session, or the file was cut off",
                fix=f"remove it and begin again; where {POINTS} is beside it, keep that, and begin in another folder",
            )
        if application != APPLICATION_ID:
            raise DatasetError(
                f"{self._path} is no session.", why="another program made this database", fix="choose another folder"
            )
        if version > TABLES_VERSION:
            raise DatasetError(
                f"{self._path} was written by a newer implicam.",
                why=f"its tables have the version {version}; this one knows up to {TABLES_VERSION}",
                fix="update implicam: pip install --upgrade implicam",
            )
        self._check_schema()
        faults = self.rows("PRAGMA integrity_check(1)")
        if faults != [("ok",)]:
            raise damaged_error(self._path, str(faults[0][0]))
        (pages,), (page_bytes,) = self.rows("PRAGMA page_count") + self.rows("PRAGMA page_size")
        if self._path.stat().st_size < pages * page_bytes:  # SQLite would take zeros for the rest of the last page
            raise damaged_error(self._path, "its end is cut off")

    def _check_schema(self) -> None:
        """Refuse all but the eight tables as they are made here: a view can be endless, a trigger can do anything."""
        query = "SELECT type, name, tbl_name, sql FROM sqlite_master"
        with closing(sqlite3.connect(":memory:")) as made:
            for table in _TABLES:
                made.execute(table)
            ours = set(made.execute(query))
        found = self.rows(f"{query} LIMIT {2 * len(ours)}")
        odd = sorted({f"{kind} {str(name)[:60]!r}" for kind, name, *_ in set(found) ^ ours})
        if odd:
            raise damaged_error(self._path, f"its tables are not as implicam makes them: {', '.join(odd[:5])}")
        ((mode,),) = self.rows("PRAGMA journal_mode")
        if mode != "delete":
            raise damaged_error(self._path, f"another program changed its journal to {str(mode)[:20]!r}")

    def run(self, sql: str, *values: Any) -> None:
        """Execute one statement.

        Args:
            sql: The statement, with a question mark for each value.
            values: In their order.

        Raises:
            UsageError: The database is closed, or a value cannot be kept.
            DatasetError: The database is damaged.
            ImplicamError: The file cannot be written.
        """
        self.rows(sql, *values)

    def rows(self, sql: str, *values: Any) -> list[tuple[Any, ...]]:
        """Execute one statement and fetch what it answers; it fails as `run` does.

        Args:
            sql: The statement, with a question mark for each value.
            values: In their order.

        Returns:
            The rows.
        """
        return [row for some in self.chunks(sql, *values) for row in some]

    def chunks(self, sql: str, *values: Any) -> Iterator[list[tuple[Any, ...]]]:
        """As `rows`, some at a time, so that not all are in memory at once.

        Args:
            sql: The statement, with a question mark for each value.
            values: In their order.

        Yields:
            Some rows.
        """
        try:
            cursor = self._connection.execute(sql, values)
            while some := cursor.fetchmany(_CHUNK_ROWS):
                yield some
        except sqlite3.Error as error:
            raise _explain_sqlite_error(self._path, error) from error
        except UnicodeDecodeError as error:  # of SQLite's own message, too, which quotes what is there
            raise damaged_error(self._path, str(error)) from error
        except (UnicodeEncodeError, OverflowError) as error:
            raise UsageError(
                "a text or a number cannot be kept in a session.", why=str(error), fix="correct the text or the number"
            ) from error

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """What is run inside is on disk when this ends, all of it; where anything fails, none of it."""
        self.run("BEGIN IMMEDIATE")
        try:
            yield
            self.run("COMMIT")
        except BaseException:
            with suppress(sqlite3.Error):  # SQLite may have rolled back by itself
                self._connection.execute("ROLLBACK")
            raise

    def close(self) -> None:
        """Unlock the session and close it."""
        self._connection.close()

    @contextmanager
    def _closing_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self.close()
            raise


def _check_files(path: Path) -> None:
    """Refuse what SQLite must not even begin to open; session.db itself is not opened here (`Database._connect`).

    A journal may name a second one of several databases, which SQLite deletes once all is played back, whatever file
    it is. Ours never has one.
    """
    size = path.stat().st_size
    if size > MAX_DATABASE_BYTES:
        raise damaged_error(path, f"it has {size:,} bytes, and a session at most {MAX_DATABASE_BYTES:,}")
    journal = path.with_name(f"{path.name}-journal")
    with suppress(OSError), journal.open("rb") as file:
        file.seek(-len(_JOURNAL_MAGIC), os.SEEK_END)
        if file.read() == _JOURNAL_MAGIC:
            raise damaged_error(path, f"{journal.name} beside it names another file, which would be deleted")


_JOURNAL_MAGIC = bytes.fromhex("d9d505f920a163d7")


def _explain_sqlite_error(path: Path, error: sqlite3.Error) -> ImplicamError:
    """SQLite's errors, by their names, as ours."""
    name, why = getattr(error, "sqlite_errorname", None) or "", str(error)
    if isinstance(error, sqlite3.ProgrammingError) and "closed" in why:
        return UsageError(f"the session in {path.parent} is closed.", fix="open it again")
    if name.startswith("SQLITE_INTERRUPT"):
        return damaged_error(path, f"reading it takes longer than {MAX_OPENING_SECONDS:g} s")
    if name.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
        return UsageError(
            f"the session in {path.parent} is open elsewhere.",
            why="another program holds session.db, and two would overwrite each other's points",
            fix="close the other one (a page, a terminal, a database viewer), or choose another folder",
        )
    if name.startswith(("SQLITE_FULL", "SQLITE_IOERR", "SQLITE_READONLY", "SQLITE_CANTOPEN", "SQLITE_PERM")):
        return ImplicamError(
            f"cannot write {path}.",
            why=why,
            fix="check the permissions and the free space; every point accepted before is kept",
        )
    return damaged_error(path, why)


def copy_database(source: Database, path: Path, change: Callable[[str], str]) -> None:
    """Write the rows of a database into another file, and nothing else that the file may still hold.

    Args:
        source: An open one.
        path: The new file.
        change: Text of a cell -> text to be written.
    """
    with closing(sqlite3.connect(path, isolation_level=None)) as copy:
        copy.execute("BEGIN")
        for table in _TABLES:
            copy.execute(table)
            name = table.split()[2]
            for row in source.rows(f"SELECT * FROM {name}"):
                cells = [change(cell) if isinstance(cell, str) else cell for cell in row]
                copy.execute(f"INSERT OR IGNORE INTO {name} VALUES ({', '.join('?' * len(cells))})", cells)
        copy.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        copy.execute(f"PRAGMA user_version = {TABLES_VERSION}")
        copy.execute("COMMIT")


def damaged_error(path: Path, why: str) -> DatasetError:
    """The error for a database that cannot be trusted.

    Args:
        path: The database's file.
        why: What is wrong with it.

    Returns:
        The error, to be raised.
    """
    return DatasetError(
        f"{path} is damaged, or is no session; nothing in its folder was changed.",
        why=why,
        fix=f"bring back a copy of it; or go on without: {POINTS} and {VIEWS} beside it hold the accepted "
        "points as a dataset, and a new session can begin in another folder",
    )


def now() -> str:
    """The time as it is stored."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def json_text(value: Any, what: str) -> str:
    """Write a value as JSON.

    Args:
        value: Text, numbers, booleans, None, lists and tables of these; NumPy's numbers and arrays as well.
        what: What to call it in the error.

    Raises:
        UsageError: The value has no form in JSON.
    """
    try:
        text = json.dumps(value, default=json_default, ensure_ascii=False)
        text.encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise UsageError(
            f"{what} cannot be kept in a session.",
            why=str(error),
            fix="use text, numbers, true or false, None, and lists and tables of these",
        ) from None
    return text


def read_cameras(database: Database) -> tuple[Camera, ...]:
    """Read the cameras, in their order.

    Args:
        database: An open one.
    """
    rows = database.rows("SELECT name, width, height, more FROM cameras ORDER BY number")
    return tuple(Camera(name, width, height, tomllib.loads(more)) for name, width, height, more in rows)


def insert_shot(database: Database, data: Dataset, notes: str) -> None:
    """Insert the rows of one accepted shot, inside a transaction of the caller.

    Args:
        database: An open one.
        data: The points of one shot, in the session's unit and with its cameras; with known positions, or corners of a
            board, or markers of a wand, at a place that nobody knows.
        notes: JSON text.
    """
    shot = str(shots_of(data)[0])
    database.run("DELETE FROM shots WHERE name = ? AND state = 'begun'", shot)
    database.run("INSERT INTO shots (name, state, time, notes) VALUES (?, 'accepted', ?, ?)", shot, now(), notes)
    known, seen = data.known, data.observations
    columns = data.columns if known is None else known.extra
    nowhere: list[float | None] = [None] * 6
    for i, point in enumerate(data.points.tolist()):
        more = json_text({key: str(text[i]) for key, text in columns.items()}, "a column")
        numbers = nowhere if known is None else _nulls_for_nan(known.xyz[i], known.sd[i])
        database.run("INSERT INTO points VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", shot, i, point, *numbers, more)
    for i, k in np.argwhere(seen.seen):
        more = json_text({key: str(text[i, k]) for key, text in seen.extra.items()}, "a column")
        place = shot, str(data.points[i]), data.cameras[k].name
        numbers = _nulls_for_nan(seen.uv[i, k], seen.sd[i, k])
        database.run("INSERT INTO views VALUES (?, ?, ?, ?, ?, ?, ?, ?)", *place, *numbers, more)


def _nulls_for_nan(*arrays: Floats) -> list[float | None]:
    """Numbers in a row; NULL for NaN."""
    return [None if value != value else value for array in arrays for value in array.tolist()]


def read_accepted(database: Database, empty: Dataset) -> Dataset | None:
    """Read all accepted points, in their order.

    Args:
        database: An open one.
        empty: A dataset without points, for its name, unit and cameras.

    Returns:
        The dataset; None where no point was accepted.

    Raises:
        ValueError: An accepted shot has no points or no views: the database is damaged. Others, such as KeyError, come
            from rows that do not fit together; `Session` takes all of them for damage.
    """
    of_accepted = "JOIN shots ON shots.name = shot WHERE state = 'accepted' ORDER BY shots.number,"
    points = _read_columns(
        database, f"SELECT x, y, z, sd_x, sd_y, sd_z, more, shot, point FROM points {of_accepted} points.number", 6
    )
    views = _read_columns(
        database, f"SELECT u, v, sd_u, sd_v, more, shot, point, camera FROM views {of_accepted} views.rowid", 4
    )
    shots = [name for (name,) in database.rows("SELECT name FROM shots WHERE state = 'accepted' ORDER BY number")]
    if not (shots == list(dict.fromkeys(points.shots)) == list(dict.fromkeys(views.shots))):
        raise ValueError("an accepted shot has no points, or no views")
    if not shots:
        return None
    names, n, c = points.names, len(points.names), len(empty.cameras)
    known, columns = None, _read_extra_columns(points.more, (n,))
    if not np.isnan(points.numbers).all():  # else corners of boards, or markers, at places that nobody knows
        known = KnownPositions(_text(points.shots), points.numbers[:, :3], points.numbers[:, 3:], columns)
    row_of = {name: i for i, name in enumerate(names)}
    camera_of = {name: k for k, name in enumerate(empty.observations.camera_names)}
    i = np.array([row_of[name] for name in views.names], dtype=np.intp)
    k = np.array([camera_of[name] for name in views.cameras], dtype=np.intp)
    if n * c > MAX_CELLS:
        raise ValueError(f"{n:,} points and {c:,} cameras are too many")
    table = np.full((n, c, 4), np.nan)
    table[i, k] = views.numbers
    observations = Observations(
        _text(names), empty.cameras, table[..., :2], table[..., 2:], _read_extra_columns(views.more, (n, c), (i, k))
    )
    own = columns if known is None else {}
    data = Dataset(empty.name, empty.length_unit, observations, known, empty.extra, columns=own)
    if known is None and shots_of(data).tolist() != points.shots:
        raise ValueError("a point without a position is no corner of its shot, and no marker of its frame")
    return data


def shots_of(data: Dataset) -> Names:
    """The shot of each point: as the known positions say it, the frame of a wand, or the names of corners.

    Args:
        data: Of a session.
    """
    if data.known is not None:
        return data.known.shots
    return data.columns[FRAME] if FRAME in data.columns else corner_shots(data.points)


@dataclass
class _Columns:
    """Rows of points or views, column by column; a text that is there often is kept once."""

    numbers: Floats
    more: list[str]
    shots: list[str]
    names: list[str]
    cameras: list[str]


def _read_columns(database: Database, sql: str, count: int) -> _Columns:
    """The rows of a query: so many numbers, then `more`, then the names of shot, point and camera, where it has one."""
    numbers: list[Floats] = []
    texts: list[list[str]] = [[], [], [], []]
    once: dict[str, str] = {}
    for rows in database.chunks(sql):
        numbers.append(np.array([row[:count] for row in rows], dtype=np.float64))
        for at, column in zip(range(count, len(rows[0])), texts, strict=False):
            column += [once.setdefault(row[at], row[at]) for row in rows]
    return _Columns(np.concatenate(numbers) if numbers else np.empty((0, count)), *texts)


def _text(cells: list[str]) -> Names:
    """Texts as an array, which takes as much for each as for the longest."""
    if max(map(len, cells)) > MAX_CELL_CHARACTERS:
        raise ValueError(f"a text has more than {MAX_CELL_CHARACTERS} characters")
    return np.array(cells, dtype=np.str_)


def _read_extra_columns(more: list[str], shape: tuple[int, ...], at: Any = slice(None)) -> dict[str, Names]:
    """The further columns, from the JSON of each row, spread over `shape`; empty where a row has none."""
    texts = {text: json.loads(text) for text in set(more)}  # mostly one: {}
    keys = list(dict.fromkeys(key for text in dict.fromkeys(more) for key in texts[text]))
    if len(keys) * math.prod(shape) > MAX_CELLS:
        raise ValueError(f"{len(keys):,} further columns of {math.prod(shape):,} cells are too many")
    columns = {}
    for key in keys:
        text = _text([texts[row].get(key, "") for row in more])
        columns[key] = np.full(shape, "", dtype=text.dtype)
        columns[key][at] = text
    return columns
