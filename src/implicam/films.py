"""Films: picture after picture with its time, as far as the file can be read; those of a dataset.

Pictures are read in order and never sought: where a film is cut into groups of pictures that depend on each other,
seeking lands beside the picture that was meant. OpenCV is imported when the first film is opened.
"""

from __future__ import annotations

import os
from collections.abc import Container, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.errors import ImageError
from implicam.images import Grey, check_size, opencv, to_grey
from implicam.picture_names import in_order

FILM_ENDINGS = (
    ".avi", ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".mpg", ".mpeg", ".mjpg", ".mjpeg", ".ts", ".mts", ".wmv", ".flv",
    ".ogv", ".3gp", ".y4m",
)  # fmt: skip
"""Of files that are taken for films by their names."""

ROUNDED_SECONDS = 6e-4
"""Some files keep times to a millisecond. Times that differ by no more from even ones are even."""


class FilmPicture(NamedTuple):
    """A picture of a film: its number from 0, and grey values from 0 to 1."""

    number: int
    grey: Grey


@dataclass(frozen=True)
class Film:
    """A film file that can be opened. promised: how many pictures its header says it has, 0 where it does not say."""

    path: Path
    width: int
    height: int
    promised: int
    rate: float

    @classmethod
    def of(cls, path: Path) -> Film:
        """Look at a file.

        Args:
            path: The file.

        Raises:
            ImageError: It is missing, empty, damaged, or no film that can be decoded.
        """
        with _opened(path) as capture:
            cv2 = opencv()
            count, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
            good, image = capture.read()
            if not good:
                raise ImageError(
                    f"{path} holds no picture that can be decoded.",
                    why="it is damaged, cut off, or compressed in a way that OpenCV does not know",
                    fix="copy it again, or convert it: ffmpeg -i FILE -c:v mjpeg -q:v 2 out.avi",
                )
            height, width = image.shape[:2]
        return cls(path, width, height, max(0, round(count)) if 0 < count < 1e9 else 0, rate if 0 < rate < 1e5 else 0.0)

    def pictures(self, wanted: Container[int] | None = None) -> Iterator[FilmPicture]:
        """The pictures in order, as far as they can be decoded.

        Args:
            wanted: The numbers of those that are asked for; None for all.

        Raises:
            ImageError: The file cannot be opened any more, or a picture has another size than the first.
        """
        with _opened(self.path) as capture:
            number = 0
            while capture.grab():
                if wanted is None or number in wanted:
                    good, image = capture.retrieve()
                    if not good:
                        return
                    if image.shape[:2] != (self.height, self.width):
                        raise ImageError(
                            f"{self.path}: picture {number} is {image.shape[1]} x {image.shape[0]}, the first is "
                            f"{self.width} x {self.height}.",
                            fix="cut the film where the size changes",
                        )
                    yield FilmPicture(number, to_grey(image, self.path))
                number += 1

    def times(self) -> NDArray[np.float64]:
        """(n,) seconds of all pictures that can be read, by the file; even where they are but rounded."""
        cv2 = opencv()
        found = []
        with _opened(self.path) as capture:
            while capture.grab():
                found.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
        return even(np.array(found), self.rate)


def even(times: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
    """Times without what a file's rounding does to them.

    Args:
        times: (n,) seconds.
        rate: Pictures per second that the file states, 0 for none; used where it has no times.

    Returns:
        (n,) seconds, exactly even where they are even but for rounding.
    """
    n = len(times)
    if n < 3:
        return times
    if rate > 0 and np.ptp(times) == 0:
        return np.arange(n) / rate
    number = np.arange(n)
    slope, start = np.polyfit(number, times, 1)
    fitted = start + slope * number
    return np.asarray(fitted if np.abs(times - fitted).max() <= ROUNDED_SECONDS else times, np.float64)


def find_films(folder: Path, cameras: Sequence[str] = ()) -> dict[str, Path]:
    """The films of a folder by camera: <camera>.mp4, or the one film in a folder <camera>.

    Args:
        folder: Where to look.
        cameras: Names of cameras; None of them is needed.

    Returns:
        {camera: file} in natural order; empty where there is none.

    Raises:
        ImageError: A camera has two films.
    """
    found: dict[str, list[Path]] = {}
    if not folder.is_dir():
        return {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if path.is_file() and path.suffix.lower() in FILM_ENDINGS:
            found.setdefault(path.stem, []).append(path)
        elif path.is_dir() and (path.name in cameras or not cameras):
            own = [one for one in sorted(path.iterdir()) if one.suffix.lower() in FILM_ENDINGS and one.is_file()]
            if own:
                found.setdefault(path.name, []).extend(one for one in own if not one.name.startswith("."))
    for camera, files in found.items():
        if len(files) > 1:
            raise ImageError(
                f"camera {camera!r} has several films: {', '.join(one.name for one in files)}.",
                why="one film a camera is read, and nothing says how these follow each other",
                fix="join them, or leave one in the folder",
            )
    return {camera: found[camera][0] for camera in in_order(list(found))}


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    if not path.is_file():
        raise ImageError(f"there is no film {path}.", fix="check the name")
    if path.stat().st_size == 0:
        raise ImageError(f"{path} is empty.", fix="copy it again from where it was recorded")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # its own lines on stderr name no file; ours do
    cv2 = opencv()
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    finally:
        cv2.utils.logging.setLogLevel(level)
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # pixels are those of the sensor, as with photographs
    try:
        if not capture.isOpened():
            raise ImageError(
                f"{path} cannot be opened as a film.",
                why="it is cut off before its table of pictures, damaged, or no film",
                fix="copy it again from where it was recorded; where the recording was interrupted, a repair tool may "
                "rebuild the table; else convert it: ffmpeg -i FILE -c:v mjpeg -q:v 2 out.avi",
            )
        check_size(int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)), path)
        yield capture
    finally:
        capture.release()
