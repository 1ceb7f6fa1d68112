"""The files of a session's folder: its tables, its pictures, and what was taken back."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from implicam.dataset import Camera, Dataset, folder_files
from implicam.dataset.folder import DESCRIPTION, IMAGES, POINTS, VIEWS, description_text
from implicam.errors import DatasetError, ImageError, ImplicamError, UsageError
from implicam.files import convert_write_errors, replacing
from implicam.images import Grey, write_picture
from implicam.logs import LOG
from implicam.session.database import DATABASE
from implicam.threads import side_by_side

UNDONE = "undone"
"""The folder of what was taken out of the dataset: undone/<camera>/<shot>.png, and tables edited by hand."""

_LOGS = (LOG, f"{LOG}.1")  # what the command line may have written before the session is begun
_PARTIAL_PATTERN = ".*.partial-*"  # left by `files.replacing` in a process that was killed
_MAX_NAME_BYTES = 200  # bytes of a name that becomes a file's; most disks take 255, and `replacing` adds some


def is_session(folder: Path) -> bool:
    """Whether a session was begun in the folder. The file is not opened: that could cost its lock (`Database`).

    Args:
        folder: Any path; it need not exist.
    """
    file = Path(folder) / DATABASE
    return file.is_file() and file.stat().st_size > 0


def writing_into(folder: Path) -> AbstractContextManager[None]:
    """A context in which what the system refuses becomes an ImplicamError.

    Args:
        folder: Named in the error.
    """
    return convert_write_errors(f"into {folder}", "the permissions and the free space")


@dataclass(frozen=True, eq=False)
class Tables:
    """The dataset's files as the session's points say them: an export, written whole and never read back.

    Attributes:
        content: File name -> bytes; a file that is not named should not be there.
    """

    content: Mapping[str, bytes]

    @classmethod
    def of(cls, data: Dataset | None, empty: Dataset) -> Tables:
        """The tables of all points.

        Args:
            data: The accepted points; None where there is none, and then there is only dataset.toml.
            empty: The same dataset without points.
        """
        files = folder_files(data) if data else {DESCRIPTION: description_text(empty)}
        return cls({name: text.encode() for name, text in files.items()})

    def with_shot(self, shot: Dataset, data: Dataset) -> Tables:
        """The tables after one shot more, whose rows alone are written where the columns stay the same.

        Args:
            shot: The new points.
            data: All points with them.
        """
        more = Tables.of(shot, shot).content
        if more.keys() != self.content.keys():
            return Tables.of(data, data)
        grown = {DESCRIPTION: more[DESCRIPTION]}
        for name in more.keys() - {DESCRIPTION}:
            rows = more[name].index(b"\n") + 1  # no heading has a line break
            if self.content[name][:rows] != more[name][:rows]:
                return Tables.of(data, data)
            grown[name] = self.content[name] + more[name][rows:]
        return Tables({name: grown[name] for name in more})

    def write_beside(self, beside: ExitStack, folder: Path, before: Mapping[str, bytes]) -> None:
        """Write what has changed under other names first; `beside` renames the files when it closes, the last first.

        A new point so gets its position before its views, and who reads between the two finds a dataset at any time.

        Args:
            beside: An open stack of contexts; an error inside it leaves the old files.
            folder: Of the session.
            before: What is in the files now.
        """
        for name, content in self.content.items():
            if before.get(name) != content:
                beside.enter_context(replacing(folder / name)).write_bytes(content)

    def rewrite(self, folder: Path) -> None:
        """Make the files say the same, after points were taken away, or when a session is opened.

        An undone point loses its views first, where a new one gets its position first.

        Args:
            folder: Of the session.
        """
        wrong = {name: text for name, text in self.content.items() if _read_or_none(folder / name, len(text)) != text}
        with ExitStack() as beside:
            for name in reversed(wrong):
                beside.enter_context(replacing(folder / name)).write_bytes(wrong[name])
        for name in (VIEWS, POINTS):
            if name not in self.content:
                (folder / name).unlink(missing_ok=True)

    def keep_edited(self, folder: Path) -> None:
        """Move a table that someone changed by hand to undone/ before it is written again; a longer one is not read.

        Args:
            folder: Of the session.
        """
        for name in (DESCRIPTION, VIEWS, POINTS):
            file, ours = folder / name, self.content.get(name, b"")
            if file.is_file() and file.stat().st_size and not ours.startswith(_read_or_none(file, len(ours)) or b"\0"):
                file.rename(
                    _find_free_path(folder / UNDONE / name)
                )  # else only the last points are missing, after a kill


def check_no_links(folder: Path, cameras: Sequence[Camera]) -> None:
    """Refuse folders of pictures that are links: files are moved out of these and deleted there, wherever that is.

    Args:
        folder: Of the session; it may be a link itself.
        cameras: All of the session.

    Raises:
        DatasetError: One of them is a link.
    """
    for top in (folder / IMAGES, folder / UNDONE):
        for place in (top, *(top / camera.name for camera in cameras)):
            if place.is_symlink():
                raise DatasetError(
                    f"{place} is a link to another folder.",
                    why="a session moves and deletes pictures in it, and a folder from elsewhere may link to yours",
                    fix="put the pictures there in its place; a link to the whole session is no trouble",
                )


def remove_partial(folder: Path, cameras: Sequence[Camera]) -> None:
    """Delete half-written files that a killed process left.

    Args:
        folder: Of the session, which must be locked, so that no other process is writing.
        cameras: The folders of their pictures are cleaned as well.
    """
    for place in [folder, *(folder / IMAGES / camera.name for camera in cameras)]:
        for partial in list(place.glob(_PARTIAL_PATTERN)):
            partial.unlink()


def picture_path(folder: Path, camera: str, shot: str) -> Path:
    """Where a picture is: images/<camera>/<shot>.png.

    Args:
        folder: Of the session.
        camera: Its name.
        shot: Its name.
    """
    return folder / IMAGES / camera / f"{shot}.png"


def write_pictures(folder: Path, shot: str, pictures: Mapping[str, Grey]) -> None:
    """Write images/<camera>/<shot>.png, whole, and flushed to the disk together with its name.

    Args:
        folder: Of the session.
        shot: Its name.
        pictures: Camera name -> grey (height, width), from 0 to 1, or uint8.
    """

    def write(camera: str) -> None:
        path, picture = picture_path(folder, camera, shot), pictures[camera]
        write_picture(path, picture, bits=_choose_bits(picture))
        flush_folder(path.parent)

    side_by_side(write, pictures, calls_blas=False)  # the disk is waited for, and compression lets others work
    for place in (folder / IMAGES, folder):
        flush_folder(place)


def set_pictures_aside(folder: Path, shots: Iterable[str], cameras: Sequence[Camera]) -> None:
    """Move the pictures of some shots to undone/.

    Args:
        folder: Of the session.
        shots: Their names.
        cameras: All of the session.
    """
    for shot in shots:
        for camera in cameras:
            picture = picture_path(folder, camera.name, shot)
            if picture.exists():
                picture.rename(_find_free_path(folder / UNDONE / camera.name / picture.name))


def make_folder(folder: Path) -> None:
    """Make a folder for a new session; a session.db without tables, as a kill leaves it, counts as nothing.

    Args:
        folder: Its parents are made as well.

    Raises:
        UsageError: It holds a session or something else.
        ImplicamError: It cannot be made or read.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        found = sorted({entry.name for entry in folder.iterdir()} - {DATABASE, f"{DATABASE}-journal", *_LOGS})
    except OSError as error:
        raise ImplicamError(
            f"cannot make the folder {folder}.", why=str(error), fix="choose a place you may write to"
        ) from error
    if is_session(folder):
        raise UsageError(f"{folder} holds a session already.", fix="continue it, or choose another folder")
    if found:
        raise UsageError(
            f"{folder} is not empty.",
            why=f"it holds {', '.join(found[:5])}{', ...' if len(found) > 5 else ''}, and a session would mix with it",
            fix="choose a new or empty folder",
        )


def check_file_name(name: str, what: str) -> None:
    """Refuse a name that cannot name a file or folder on every disk.

    Args:
        name: Of a camera or a shot.
        what: "camera" or "shot", for the error.

    Raises:
        DatasetError: It has a slash or a backslash, begins with a dot, or is too long.
    """
    if set("/\\") & set(name) or name.startswith(".") or len(name.encode()) > _MAX_NAME_BYTES:
        raise DatasetError(
            f"the {what} name {name[:60]!r} cannot name a file.",
            why="its pictures are kept under this name",
            fix=f"leave out slashes, backslashes and a leading dot; at most {_MAX_NAME_BYTES} bytes",
        )


def check_pictures(pictures: Mapping[str, Grey], cameras: Sequence[Camera]) -> None:
    """Refuse pictures that do not fit the session's cameras.

    Args:
        pictures: Camera name -> grey (height, width).
        cameras: All of the session.

    Raises:
        DatasetError: There is no such camera.
        ImageError: A picture is not grey and finite, or not as large as the camera's.
    """
    known = {camera.name: camera for camera in cameras}
    for name, picture in pictures.items():
        if name not in known:
            raise DatasetError(f"a picture of {name!r}, which is no camera.", fix=f"the cameras are {', '.join(known)}")
        if picture.ndim != 2 or not picture.size or not np.isfinite(picture).all():
            raise ImageError(
                f"the picture of {name!r} is not grey.",
                why=f"its shape is {picture.shape}",
                fix="give finite grey values, (height, width)",
            )
        size = known[name].height, known[name].width
        if None not in size and picture.shape != size:
            raise ImageError(
                f"the picture of {name!r} has {picture.shape[1]} x {picture.shape[0]} pixels.",
                why=f"this camera began here with {size[1]} x {size[0]}",
                fix="give the whole picture, as the camera takes it",
            )


def _choose_bits(picture: Grey) -> int:
    """8 where such a file reads back to the same values, else 16."""
    if picture.dtype == np.uint8:
        return 8
    steps = np.rint(np.clip(picture, 0, 1) * 255).astype(np.float32)
    return 8 if np.array_equal(steps * np.float32(1 / 255), picture) else 16


def _read_or_none(path: Path, most: int) -> bytes | None:
    """What is in a file; None where there is none, or it is longer."""
    return path.read_bytes() if path.is_file() and path.stat().st_size <= most else None


def _find_free_path(path: Path) -> Path:
    """The path, or one with a number where something is there; its folder exists."""
    path.parent.mkdir(parents=True, exist_ok=True)
    number, free = 1, path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


def flush_folder(folder: Path) -> None:
    """Flush the file names in a folder to the disk, where the system can; Windows and some network shares cannot.

    Args:
        folder: Any; errors are ignored.
    """
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
