"""A guided session on disk: session.db is the one store, the dataset's files beside it are an export.

An accepted point is in the database when `accept` returns, and the files follow; nothing is read back from them
(docs/decisions/0025-one-store.md). The order makes a kill harmless at any moment:
  1. The new points.csv and observations.csv are written beside the old ones, so that a full disk shows before 2.
  2. The shot's name is committed as `begun`, then its pictures are written (only where there are pictures).
  3. The point is committed. From here on it is accepted.
  4. The files are renamed into place.
The next opening finishes what was left: pictures of a shot that is no point move to undone/, the dataset's files are
written again where they do not say what the database says.
"""

from __future__ import annotations

import json
import logging
import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from implicam.dataset import Camera, Dataset, Floats, Observations, join
from implicam.dataset.folder import description_text
from implicam.errors import DatasetError, ImplicamError, UsageError
from implicam.images import Grey
from implicam.session import folder as files
from implicam.session.database import (
    DATABASE,
    Database,
    damaged_error,
    insert_shot,
    json_text,
    now,
    read_accepted,
    read_cameras,
    shots_of,
)

_LOG = logging.getLogger(__name__)

__all__ = ["TARGET_KEY", "Event", "Session", "Skipped"]

TARGET_KEY = "target_table"
"""The setting of a session that is the table [target] of its dataset: which board it shows."""


@dataclass(frozen=True, eq=False)
class Skipped:
    """A target that was not measured: where it was to be, (3,) in the world frame, and why not."""

    xyz: Floats
    reason: str
    time: datetime


@dataclass(frozen=True)
class Event:
    """Something that happened, with whatever was said about it."""

    what: str
    more: Mapping[str, Any]
    time: datetime


class Session:
    """The points of a session, open for adding; several threads may use it. Made by `create` and `open`."""

    def __init__(self, folder: Path, database: Database) -> None:
        self._lock = threading.RLock()
        self._database = database
        self.folder = folder
        with _reporting_damage(self.folder):
            ((self.name, self.length_unit),) = database.rows("SELECT name, length_unit FROM session")
            self._settings = _read_settings(database)
            self.cameras = read_cameras(database)
            for camera in self.cameras:
                files.check_file_name(camera.name, "camera")
            for (shot,) in database.rows("SELECT name FROM shots"):
                files.check_file_name(shot, "shot")
            self._empty = _make_empty_dataset(self.name, self.length_unit, self.cameras, self._settings.get(TARGET_KEY))
            self._data = read_accepted(database, self._empty)
            self._tables = files.Tables.of(self._data, self._empty)
        database.end_of_reading()

    @classmethod
    def create(
        cls, folder: Path, *, name: str, length_unit: str, cameras: Sequence[Camera], settings: Mapping[str, Any]
    ) -> Session:
        """Begin a session in a new or empty folder.

        Args:
            folder: Made where it does not exist.
            name: Of the session and its dataset.
            length_unit: That of all positions.
            cameras: In their order; the folders of their pictures are named after them.
            settings: Plain values, kept as JSON; `TARGET_KEY` is the table [target] of its dataset.

        Raises:
            UsageError: Something else is in the folder, or a setting has no form in JSON.
            DatasetError: A name, the unit or a camera cannot stand in a dataset.
            ImplicamError: The folder cannot be written.
        """
        folder = Path(folder).absolute()
        target = settings.get(TARGET_KEY)
        description_text(_make_empty_dataset(name, length_unit, cameras, target))  # refuses what a dataset cannot hold
        for camera in cameras:
            files.check_file_name(camera.name, "camera")
        values = {key: json_text(value, f"the setting {key!r}") for key, value in settings.items()}
        files.make_folder(folder)
        database = Database.create(folder / DATABASE)
        database.write_tables(name, length_unit, cameras, values)
        files.flush_folder(folder.parent)
        return cls._start(folder, database)

    @classmethod
    def open(cls, folder: Path) -> Session:
        """Continue a session with exactly the points that were accepted.

        Args:
            folder: Of the session.

        Raises:
            UsageError: It is open elsewhere.
            DatasetError: There is none, or its database is damaged, another program's, or a newer version's.
            ImplicamError: The folder cannot be written.
        """
        folder = Path(folder).absolute()
        return cls._start(folder, Database.open(folder / DATABASE))

    @staticmethod
    def read_settings(folder: Path) -> dict[str, Any]:
        """The settings of a session, without its points and without a change to its files; it fails as `open` does.

        Args:
            folder: Of the session.
        """
        folder = Path(folder).absolute()
        database = Database.open(folder / DATABASE)
        try:
            with _reporting_damage(folder):
                return _read_settings(database)
        finally:
            database.close()

    @classmethod
    def _start(cls, folder: Path, database: Database) -> Session:
        try:
            session = cls(folder, database)
            files.check_no_links(folder, session.cameras)
            session._repair()
        except BaseException:
            database.close()
            raise
        return session

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the session, so that another process can open it; nothing is left to be written."""
        with self._lock:
            self._database.close()

    @property
    def data(self) -> Dataset | None:
        """All accepted points in order, as `read_dataset(folder)` gives them; None where there is none."""
        with self._lock:
            return self._data

    @property
    def empty(self) -> Dataset:
        """The session's dataset without points: name, unit, cameras, and what it shows."""
        return self._empty

    @property
    def settings(self) -> dict[str, Any]:
        """A copy of the settings as they are stored: tuples are lists, NumPy's numbers plain ones."""
        with self._lock:
            return dict(self._settings)

    def accept(self, point: Dataset, *, pictures: Mapping[str, Grey] = {}, notes: Mapping[str, Any] = {}) -> None:
        """Add one shot; it is on disk when this returns, and where it raises, nothing was added.

        Args:
            point: The views of all cameras, one point of a ball or several of a board or wand, of one shot whose name
                is new; with known positions, or all shots of the session without. Its numbers are kept bit by bit, its
                columns too; its dataset name is not.
            pictures: Camera name -> grey (height, width) from 0 to 1; 16 bits are written where 8 would lose something.
            notes: Plain values, kept as JSON beside the shot.

        Raises:
            DatasetError: The shot does not fit the session.
            ImageError: A picture is not grey, or not as large as the camera's.
            UsageError: A note has no form in JSON, or the session is closed.
            ImplicamError: The disk is full or cannot be written.
        """
        with self._lock:
            shot = self._check_shot(point)
            name = str(shots_of(shot)[0])
            files.check_pictures(pictures, self.cameras)
            noted = json_text(dict(notes), "a note")
            data = join(self._data, shot) if self._data else shot
            try:
                with self._adding(self._tables.with_shot(shot, data)):
                    if pictures:
                        self._commit_begun(name)
                        files.write_pictures(self.folder, name, pictures)
                    with self._database.transaction():
                        insert_shot(self._database, shot, noted)
                    self._data = data
            except BaseException:
                with suppress(ImplicamError):  # `open` does it the next time
                    self._set_pictures_aside()
                raise

    def undo(self) -> str | None:
        """Take the last accepted shot back: its name, None where there is none. It stays in the database as undone."""
        with self._lock:
            if self._data is None:
                return None
            last = str(shots_of(self._data)[-1])
            self.remove(last)
            return last

    def remove(self, shot: str) -> None:
        """Take any accepted shot back. It stays in the database as undone, and its pictures in undone/.

        Args:
            shot: Its name.

        Raises:
            UsageError: There is no accepted shot of this name.
        """
        with self._lock:
            if self._data is None or shot not in shots_of(self._data).tolist():
                raise UsageError(f"there is no point {shot!r} in the session.", fix="name one that was accepted")
            with self._database.transaction():
                self._database.run("UPDATE shots SET state = 'undone', time = ? WHERE name = ?", now(), shot)
            self._data = read_accepted(self._database, self._empty)
            self._tables = files.Tables.of(self._data, self._empty)
            self._run_after_commit(lambda: self._tables.rewrite(self.folder))
            self._run_after_commit(self._set_pictures_aside)

    def pictures_of(self, shot: str) -> dict[str, Path]:
        """Where the pictures of an accepted shot are: camera name -> file.

        Args:
            shot: Its name; of another one there are none.
        """
        places = {camera.name: files.picture_path(self.folder, camera.name, shot) for camera in self.cameras}
        return {camera: path for camera, path in places.items() if path.is_file()}

    def skip(self, xyz: ArrayLike, reason: str) -> None:
        """Keep that a target was not measured, and why.

        Args:
            xyz: (3,) where it was to be, in the session's length unit, world frame.
            reason: In words.

        Raises:
            UsageError: Xyz is not three finite numbers.
        """
        target = np.asarray(xyz, dtype=np.float64)
        if target.shape != (3,) or not np.isfinite(target).all():
            raise UsageError(f"a skipped target {str(target)[:80]} is no position.", fix="give x, y and z, finite")
        with self._lock, self._database.transaction():
            sql = "INSERT INTO skipped (x, y, z, reason, time) VALUES (?, ?, ?, ?, ?)"
            self._database.run(sql, *target.tolist(), reason, now())

    def log(self, what: str, /, **more: Any) -> None:
        """Keep an event with its time.

        Args:
            what: In a few words.
            more: Plain values, kept as JSON.

        Raises:
            UsageError: A value has no form in JSON.
        """
        text = json_text(more, f"the event {what!r}")
        _LOG.info("%s %s", what, text)
        with self._lock, self._database.transaction():
            self._database.run("INSERT INTO events (time, what, more) VALUES (?, ?, ?)", now(), what, text)

    def set(self, key: str, value: Any) -> None:
        """Change a setting; it is on disk when this returns.

        Args:
            key: Its name.
            value: A plain value, kept as JSON.

        Raises:
            UsageError: The value has no form in JSON.
        """
        text = json_text(value, f"the setting {key!r}")
        with self._lock:
            with self._database.transaction():
                self._database.run("INSERT OR REPLACE INTO settings VALUES (?, ?, ?)", key, text, now())
            self._settings[key] = json.loads(text)

    @property
    def skipped(self) -> list[Skipped]:
        """The targets that were not measured, in order."""
        with self._lock:
            rows = self._database.rows("SELECT x, y, z, reason, time FROM skipped ORDER BY number")
        with _reporting_damage(self.folder):
            return [Skipped(np.array(xyz, dtype=float), why, datetime.fromisoformat(time)) for *xyz, why, time in rows]

    @property
    def events(self) -> list[Event]:
        """What happened, in order."""
        with self._lock:
            rows = self._database.rows("SELECT what, more, time FROM events ORDER BY number")
        with _reporting_damage(self.folder):
            return [Event(what, json.loads(more), datetime.fromisoformat(time)) for what, more, time in rows]

    def next_name(self) -> str:
        """p001, p002, ...: one more than the highest number that was ever given, to an undone point too."""
        with self._lock:
            rows = self._database.rows("SELECT name FROM shots WHERE state != 'begun' UNION SELECT point FROM points")
        numbers = [int(name[1:]) for (name,) in rows if re.fullmatch("p[0-9]{1,18}", name)]
        return f"p{max(numbers, default=0) + 1:03d}"

    def _check_shot(self, point: Dataset) -> Dataset:
        """The shot as the session keeps it; DatasetError where it does not fit."""
        if "target" not in self._empty.extra:
            _ = point.positions  # no board: without positions it is nothing
        if self._data is not None and (point.known is None) != (self._data.known is None):
            raise DatasetError(
                "a session has known positions or none.",
                why="what was accepted before is of the other kind",
                fix="begin another session in another folder",
            )
        names = sorted(set(shots_of(point).tolist()))
        if len(names) != 1:
            raise DatasetError(f"{len(names)} shots at once: {', '.join(names[:5])}.", fix="accept one after the other")
        files.check_file_name(names[0], "shot")
        if self._list_begun_shots():  # left by an `accept` that failed
            self._set_pictures_aside()
        states = self._database.rows("SELECT state FROM shots WHERE name = ?", names[0])
        if states:
            raise DatasetError(
                f"the shot {names[0]!r} is there already ({states[0][0]}).", fix=f"name it {self.next_name()!r}"
            )
        if point.length_unit != self.length_unit:
            raise DatasetError(
                f"the shot {names[0]!r} is in {point.length_unit!r}, the session in {self.length_unit!r}.",
                fix=f"give positions and their standard uncertainties in {self.length_unit!r}",
            )
        _check_cameras(point.cameras, self.cameras)
        seen = point.observations.with_cameras(self._empty.observations.camera_names)
        if not seen.seen.any():
            raise DatasetError(
                f"the shot {names[0]!r} was seen by no camera.", fix="take it again, or skip the target and say why"
            )
        observations = Observations(seen.points, self.cameras, seen.uv, seen.sd, seen.extra)
        own = {} if point.known else point.columns
        return Dataset(self.name, self.length_unit, observations, point.known, self._empty.extra, columns=own)

    def _commit_begun(self, shot: str) -> None:
        """Commit that files of this name are about to appear, so that a kill leaves none unknown."""
        with self._database.transaction():
            self._database.run("INSERT INTO shots (name, state, time) VALUES (?, 'begun', ?)", shot, now())

    @contextmanager
    def _adding(self, tables: files.Tables) -> Iterator[None]:
        """Write the tables of one point more, let the caller commit, and rename them into place."""
        with ExitStack() as beside:
            tables.write_beside(beside, self.folder, self._tables.content)
            yield
            self._tables = tables
            self._run_after_commit(beside.close)

    def _run_after_commit(self, step: Callable[[], None]) -> None:
        """What follows a commit. The point is safe, so a failure is an event, and the next opening tries again."""
        try:
            step()
        except (ImplicamError, OSError) as error:
            with suppress(ImplicamError):
                self.log("files", problem=str(error))

    def _set_pictures_aside(self) -> None:
        """Move the pictures of shots that are no points to undone/, and forget the shots that were only begun."""
        shots = [name for (name,) in self._database.rows("SELECT name FROM shots WHERE state != 'accepted'")]
        with files.writing_into(self.folder):
            files.set_pictures_aside(self.folder, shots, self.cameras)
        with self._database.transaction():
            self._database.run("DELETE FROM shots WHERE state = 'begun'")

    def _list_begun_shots(self) -> list[str]:
        return [name for (name,) in self._database.rows("SELECT name FROM shots WHERE state = 'begun'")]

    def _repair(self) -> None:
        """Finish what was interrupted when a process was killed."""
        for shot in self._list_begun_shots():
            self.log("interrupted", shot=shot)
        with files.writing_into(self.folder):
            files.remove_partial(self.folder, self.cameras)
            self._set_pictures_aside()
            self._tables.keep_edited(self.folder)
            self._tables.rewrite(self.folder)


@contextmanager
def _reporting_damage(folder: Path) -> Iterator[None]:
    """Values that cannot be read are a damaged database."""
    try:
        yield
    except (DatasetError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise damaged_error(folder / DATABASE, str(error)) from error


def _read_settings(database: Database) -> dict[str, Any]:
    return {key: json.loads(text) for key, text in database.rows("SELECT key, value FROM settings")}


def _make_empty_dataset(
    name: str, length_unit: str, cameras: Sequence[Camera], target: Mapping[str, Any] | None = None
) -> Dataset:
    none = np.empty((0, len(cameras), 2))
    observations = Observations(np.array([], dtype=np.str_), tuple(cameras), none, none)
    return Dataset(name, length_unit, observations, None, {"target": dict(target)} if target else {})


def _check_cameras(given: Sequence[Camera], ours: Sequence[Camera]) -> None:
    sizes = {camera.name: (camera.width, camera.height) for camera in given}
    if set(sizes) != {camera.name for camera in ours}:
        raise DatasetError(
            f"the point has the cameras {', '.join(sizes)}.",
            why="a session keeps the cameras that it began with",
            fix=f"give the views of {', '.join(camera.name for camera in ours)}, NaN where one saw nothing",
        )
    for camera in ours:
        sides = zip(sizes[camera.name], (camera.width, camera.height), strict=True)
        if any(None not in side and side[0] != side[1] for side in sides):
            raise DatasetError(
                f"camera {camera.name!r} now has images of {sizes[camera.name][0]} x {sizes[camera.name][1]} pixels.",
                why=f"the session began with {camera.width} x {camera.height}",
                fix="set the camera as it was, or begin a new session",
            )
