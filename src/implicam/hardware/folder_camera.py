"""A folder that another program fills with pictures: any camera whose own software can save what it takes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import ClassVar, NamedTuple, Self

from implicam.errors import HardwareError, ImageError
from implicam.hardware.protocol import Frame, Grey, wait_for
from implicam.images import ENDINGS, read_picture
from implicam.picture_names import in_order

MAX_WRITE_PAUSE_SECONDS = 10.0
"""A file that was written to less long ago may not be whole yet."""


class _Stamp(NamedTuple):
    inode: int
    changed: int
    size: int


class FolderCamera:
    """The `FrameSource` of a watched folder. A file that appears, or is replaced, after the call is a new picture.

    A file that is there when `frame` is called is of before, even if it is still being written; a new one counts when
    it can be read whole. Of several new ones the first by name is given, and no file twice. pattern: of the file names.
    """

    live = False
    spec: ClassVar[str] = "folder/"

    @classmethod
    def takes(cls, spec: str) -> bool:
        """Whether a spec without the driver's name is a folder, or ends like one.

        Args:
            spec: The words of the command line.
        """
        return spec.endswith("/") or (bool(spec) and Path(spec).is_dir())

    @classmethod
    def from_spec(cls, name: str, rest: str, *, triggered: bool = False) -> Self:
        """A camera that watches a folder, not opened yet.

        Args:
            name: The camera's name in the dataset.
            rest: The folder.
            triggered: Makes no difference: the pictures come from the folder either way.
        """
        return cls(name, rest)

    def __init__(self, name: str, folder: Path | str, pattern: str = "*") -> None:
        self.name = name
        self.folder, self.pattern = Path(folder), pattern
        self._number = 0

    def open(self) -> None:
        """HardwareError where there is no such folder."""
        self._read_stamps()

    def frame(self, timeout: float = 5.0) -> Frame:
        """The next picture that appears in the folder, once it is whole.

        Args:
            timeout: Seconds to wait for it.

        Returns:
            The picture with the time at which its file was last written.

        Raises:
            HardwareError: None came in time, or the folder cannot be read.
        """
        before = self._read_stamps()
        growing = {name for name, stamp in before.items() if self._is_growing(name, stamp)}
        partial: dict[str, ImageError] = {}

        def look() -> tuple[Grey, float] | None:
            for name, stamp in self._read_stamps().items():
                old = before.get(name)
                if old == stamp or (name in growing and old is not None and old.inode == stamp.inode):
                    continue
                try:
                    return read_picture(self.folder / name), stamp.changed / 1e9
                except ImageError as error:  # the other program is still writing it
                    partial[name] = error
            return None

        found = wait_for(look, timeout, pause=0.02)
        if found is None:
            raise self._no_picture_error(timeout, partial)
        self._number += 1
        return Frame(found[0], self._number, found[1])

    def close(self) -> None:
        """Nothing to release."""

    def _is_growing(self, name: str, stamp: _Stamp) -> bool:
        if time.time() - stamp.changed / 1e9 > MAX_WRITE_PAUSE_SECONDS:
            return False
        try:
            read_picture(self.folder / name)
        except ImageError:
            return True
        return False

    def _read_stamps(self) -> dict[str, _Stamp]:
        found: dict[str, _Stamp] = {}
        try:
            if not self.folder.is_dir():
                raise NotADirectoryError(f"there is no folder {self.folder}")
            for path in self.folder.glob(self.pattern):
                if path.suffix.lower() in ENDINGS and not path.name.startswith("."):
                    status = path.stat()
                    found[path.name] = _Stamp(status.st_ino, status.st_mtime_ns, status.st_size)
        except FileNotFoundError:  # a file was renamed between the listing and the look: the next look sees it
            pass
        except OSError as error:
            raise HardwareError(
                f"camera {self.name}: the folder {self.folder} cannot be watched.",
                why=str(error),
                fix="make the folder, or mount the disk, and tell the camera's program to save there",
            ) from error
        return {name: found[name] for name in in_order(found)}

    def _no_picture_error(self, timeout: float, partial: dict[str, ImageError]) -> HardwareError:
        if partial:
            name, error = next(iter(partial.items()))
            return HardwareError(
                f"camera {self.name}: {name} did not become a whole picture within {timeout:g} s.",
                why=error.what,
                fix="give it more time, or look at the disk and the program that writes it",
            )
        return HardwareError(
            f"camera {self.name}: no new picture in {self.folder} within {timeout:g} s.",
            why=f"none of {', '.join(ENDINGS)} that fits {self.pattern!r} appeared",
            fix="start the camera's program, and let it save into this folder",
        )
