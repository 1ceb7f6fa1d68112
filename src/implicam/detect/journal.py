"""Detection in every picture; each result is written at once, so that a run that was killed goes on where it stopped.

One JSON line per picture, the later line wins. Each ends in a checksum, so that half a line, or a damaged one, is not
there at all: the picture is searched again.
"""

from __future__ import annotations

import hashlib
import json
import threading
import time
import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from implicam.calibration_file import package_version
from implicam.dataset.model import check_name
from implicam.detect.model import Detected, Detector, View
from implicam.errors import DatasetError, ImageError, ImplicamError, MissingExtraError
from implicam.formatting import json_default
from implicam.images import Grey, blank, read_picture
from implicam.progress import Progress
from implicam.threads import side_by_side

_CHECK = b', "crc": '


class Key(NamedTuple):
    """What a result depends on: the picture, and the detector's options as `digest` gives them."""

    camera: str
    shot: str
    file: str
    size: int
    mtime_ns: int
    options: str

    @classmethod
    def of(cls, view: View, path: Path, options: str) -> Key:
        """The key of a picture as its file is now.

        Args:
            view: Which picture it is.
            path: Its file.
            options: The detector's `digest`.

        Raises:
            OSError: The file is not there.
        """
        state = path.stat()
        return cls(view.camera, view.shot, path.name, state.st_size, state.st_mtime_ns, options)


@dataclass(frozen=True, eq=False)
class Entry:
    """What a detector found in a picture of width x height pixels."""

    width: int
    height: int
    found: Detected

    def as_dict(self) -> dict[str, Any]:
        """As plain values."""
        return {"width": self.width, "height": self.height, "found": self.found.as_dict()}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Entry:
        """The inverse of `as_dict`.

        Args:
            table: Plain values, as `as_dict` gives them.

        Raises:
            ValueError: They are not such values; or KeyError or TypeError.
        """
        return cls(int(table["width"]), int(table["height"]), Detected.from_dict(table["found"]))


def digest(detector: Detector) -> str:
    """A short text for a detector, all its options, and the version of implicam, which may find something else.

    Args:
        detector: Any.
    """
    text = json.dumps(
        [package_version(), type(detector).__name__, detector.options()], sort_keys=True, default=json_default
    )
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class Journal:
    """The file, open for adding lines; several threads may add. ImplicamError where it cannot be written."""

    def __init__(self, path: Path, *, restart: bool = False) -> None:
        self._lock = threading.Lock()
        self._path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if restart:
                path.unlink(missing_ok=True)
            self.entries = _read(path)
            self._file = path.open("ab", buffering=0)
            if not _ends_with_newline(path):  # a kill may have left half a line: the next must begin on its own
                self._file.write(b"\n")
        except OSError as error:
            raise self._write_error(error) from error

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def add(self, key: Key, entry: Entry) -> Entry:
        """Write a line.

        Args:
            key: What the result depends on.
            entry: The result.

        Returns:
            The entry as it will be read again.

        Raises:
            TypeError: JSON cannot hold the entry; or ValueError.
            ImplicamError: The file cannot be written.
        """
        content = json.dumps({**key._asdict(), **entry.as_dict()}, default=json_default).encode()
        line = content[:-1] + _CHECK + str(zlib.crc32(content)).encode() + b"}\n"
        read = _parse_line(line)
        if read is None:
            raise ValueError("what was found cannot be written down")
        try:
            with self._lock:
                if self._file.write(line) < len(line):
                    raise OSError("the disk took only a part of a line")
        except OSError as error:
            raise self._write_error(error) from error
        return read[1]

    def _write_error(self, error: OSError) -> ImplicamError:
        return ImplicamError(
            f"cannot write {self._path}.",
            why=str(error),
            fix="check the permissions and the free space; what was found so far is kept",
        )


def _read(path: Path) -> dict[Key, Entry]:
    """The whole lines of a journal."""
    if not path.exists():
        return {}
    with path.open("rb") as file:
        return dict(filter(None, map(_parse_line, file)))


def _ends_with_newline(path: Path) -> bool:
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - 1))
        return file.read(1) in (b"\n", b"")


def _parse_line(line: bytes) -> tuple[Key, Entry] | None:
    """A line's key and entry, or None where the line is not as it was written."""
    content, mark, check = line.rpartition(_CHECK)
    content += b"}"
    if not mark or check != str(zlib.crc32(content)).encode() + b"}\n":
        return None
    try:
        table = json.loads(content)
        key, entry = Key(*(table[name] for name in Key._fields)), Entry.from_dict(table)
        hash(key)
        return key, entry
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError):
        return None


@dataclass(frozen=True, eq=False)
class JournalResults:
    """What the detector found in each picture, and the reasons why others could not be searched."""

    entries: Mapping[View, Entry]
    problems: Mapping[View, str]
    resumed: int
    seconds: float

    @property
    def sizes(self) -> dict[str, tuple[int, int]]:
        """(width, height) of most of a camera's pictures."""
        counts: dict[str, Counter[tuple[int, int]]] = {}
        for view, entry in self.entries.items():
            counts.setdefault(view.camera, Counter())[entry.width, entry.height] += 1
        return {camera: max((n, size) for size, n in count.items())[1] for camera, count in counts.items()}


def detect_all(
    pictures: Mapping[View, Path], detector: Detector, path: Path, *, restart: bool, progress: Progress
) -> JournalResults:
    """Detect in each picture that the journal does not know yet, on all cores.

    A picture that cannot be used, and a detector that fails on one, are problems, and are tried again the next time.

    Args:
        pictures: View -> file.
        detector: Used in several threads at a time.
        path: The journal's file.
        restart: Whether to forget what the journal has.
        progress: Told how many pictures are done.

    Raises:
        ImplicamError: The journal cannot be written.
    """
    options = digest(detector)
    entries: dict[View, Entry] = {}
    problems: dict[View, str] = {}
    seconds: list[float] = []
    total = len(pictures)
    with Journal(path, restart=restart) as journal:

        def work(item: tuple[View, Path]) -> None:
            view, file = item
            start = time.perf_counter()
            try:
                entries[view] = _look(file, view, detector, journal, options)
            except ImageError as error:
                problems[view] = join_lines(error).replace(str(file), "the file")
            seconds.append(time.perf_counter() - start)
            progress("looking at pictures", resumed + len(seconds), total)

        new = []
        for view, file in pictures.items():
            entry = find_entry(journal, view, file, options)
            if entry is None:
                new.append((view, file))
            else:
                entries[view] = entry
        resumed = len(entries)
        progress("looking at pictures", resumed, total)
        side_by_side(work, new)
    return JournalResults(entries, problems, resumed, float(np.mean(seconds)) if seconds else float("nan"))


def find_entry(journal: Journal, view: View, path: Path, options: str) -> Entry | None:
    """What the journal has of a picture, None where it has nothing that is possible.

    Args:
        journal: The journal.
        view: Which picture it is.
        path: Its file.
        options: The detector's `digest`.
    """
    try:
        entry = journal.entries.get(Key.of(view, path, options))
    except OSError:
        return None  # `_look` will say why
    return None if entry is None or _find_fault(entry) else entry


def _look(path: Path, view: View, detector: Detector, journal: Journal, options: str) -> Entry:
    """Read a picture, detect, and write it down. ImageError for a picture, or a detector, that fails."""
    try:
        key = Key.of(view, path, options)
    except OSError as error:
        raise ImageError(f"{path} cannot be read", why=str(error)) from error
    return look_at(read_picture(path), path, key, detector, journal)


def look_at(picture: Grey, path: Path, key: Key, detector: Detector, journal: Journal) -> Entry:
    """Detect in a picture, and write it down.

    Args:
        picture: (height, width) grey.
        path: Its file, for messages.
        key: What the result depends on.
        detector: What to look for.
        journal: Where to write.

    Raises:
        ImageError: The picture is blank, or the detector fails.
        ImplicamError: The journal cannot be written.
    """
    height, width = picture.shape
    view = View(key.camera, key.shot)
    empty = blank(picture)
    if empty:
        raise ImageError(
            f"{path} is {empty}",
            why="nothing in it stands out from the noise",
            fix="check the lens cap and the exposure",
        )
    try:
        entry = Entry(width, height, detector.detect(picture, view))
        fault = _find_fault(entry)
        if fault:
            raise ValueError(fault)
        return journal.add(key, entry)
    except MissingExtraError:
        raise
    except ImplicamError as error:
        raise ImageError(f"the detector failed: {join_lines(error)}") from error
    except Exception as error:
        raise ImageError(f"the detector failed: {type(error).__name__}: {error}") from error


def _find_fault(entry: Entry) -> str:
    """What is impossible in a detector's answer; empty where nothing is."""
    found, size = entry.found, np.array([entry.width, entry.height])
    if not (found.uv.shape == found.sd.shape == (len(found), 2)):
        return f"{len(found)} names, but pixels {found.uv.shape} and uncertainties {found.sd.shape}"
    if not ((found.uv >= -1 - 0.01 * size.max()) & (found.uv <= size + 0.01 * size.max())).all():
        return "a point outside the picture"
    if ((found.sd <= 0) | np.isinf(found.sd)).any():
        return "a standard uncertainty that is not greater than zero"
    if len(set(found.points)) < len(found):
        return "a point twice"
    try:
        for name in found.points:
            check_name(name, "point")
    except DatasetError as error:
        return error.what
    return ""


def join_lines(error: ImplicamError) -> str:
    """An error's three lines in one sentence.

    Args:
        error: Any of ours.
    """
    what = error.what.rstrip(".")
    return what + (f" ({error.why.rstrip('.')})" if error.why else "") + (f"; {error.fix}" if error.fix else "")
