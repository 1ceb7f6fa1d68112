"""Photographs: read one, whole or not at all; write one. Where those of a dataset are: picture_names.py.

A picture is grey, float32, (height, width), from 0 (black) to 1 (what the file's bits can hold at most).
OpenCV is imported when the first picture is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Condition
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.errors import ImageError, UsageError, import_extra
from implicam.files import replacing
from implicam.picture_heads import BEGINNINGS, JPEG, PNG, jpeg_segments, read_head

Grey = NDArray[np.float32]

ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
MAX_PIXELS = 160_000_000
"""Of a picture; the largest cameras have 151 million."""

MAX_BYTES = 2_000_000_000
MAX_UNPACKING_BYTES = 2_300_000_000
"""What all pictures that are unpacked at the same time in one process may take together, enough for the largest one of
16 bits and four channels; further ones wait."""


def opencv() -> Any:
    """The module cv2.

    Raises:
        MissingExtraError: It is not installed; says how to get it.
    """
    return import_extra("cv2", "images", "reading and writing photographs")


@contextmanager
def one_thread_each() -> Iterator[None]:
    """For many pictures side by side: OpenCV starts no threads of its own, and prints nothing."""
    cv2 = opencv()
    threads, level = cv2.getNumThreads(), cv2.utils.logging.getLogLevel()
    cv2.setNumThreads(1)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
        cv2.utils.logging.setLogLevel(level)


def read_picture(path: Path) -> Grey:
    """Read a photograph: PNG, JPEG or TIFF, grey or colour, 8 or 16 bits.

    A rotation that only the file's EXIF tag asks for is not done: pixels are those of the sensor (`stored_jpeg`).

    Args:
        path: The file.

    Returns:
        (height, width) grey values from 0 to 1.

    Raises:
        ImageError: It cannot be read, is cut off, has another form, or too many pixels, which its head says before
            anything is unpacked.
    """
    cv2 = opencv()
    data = _read_bytes(path)
    if not data.startswith(BEGINNINGS):  # others could not be measured before they are unpacked
        raise ImageError(
            f"{path} is not a picture that can be read.",
            why=f"{len(data):,} bytes, and no PNG, JPEG or TIFF",
            fix="export it again as PNG, JPEG or TIFF",
        )
    head = read_head(data)
    if head is None:
        raise _damaged_error(path, data)
    check_size(head.width, head.height, path)
    with _ROOM.taking(head.unpacking_bytes):
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
        except cv2.error as error:
            raise ImageError(f"{path} cannot be read.", why=str(error), fix="export it again as PNG or TIFF") from error
        if image is None:
            raise _damaged_error(path, data)
        return to_grey(image, path)


def _damaged_error(path: Path, data: bytes) -> ImageError:
    return ImageError(
        f"{path} is damaged or cut off.",
        why=f"it begins as a picture does, but its {len(data):,} bytes cannot be decoded",
        fix="copy it again from where it was recorded",
    )


def _read_bytes(path: Path) -> bytes:
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise ImageError(f"{path} has {size:,} bytes.", fix="one picture a file, at most 2 GB")
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"{path} cannot be read.", why=str(error), fix="check the file and its permissions") from error
    if not data:
        raise ImageError(f"{path} is empty.", fix="copy it again from where it was recorded")
    # Some decoders fill what is missing with grey and report no error.
    if (data.startswith(PNG) and b"IEND" not in data) or (data.startswith(JPEG) and not _ends_jpeg(data)):
        raise ImageError(
            f"{path} is cut off.",
            why=f"it ends after {len(data):,} bytes, before the picture does",
            fix="copy it again from where it was recorded",
        )
    return data


def _ends_jpeg(data: bytes) -> bool:
    """Whether the end mark is there. Segments before the pixels are skipped: a preview among them has its own."""
    for marker, start, _ in jpeg_segments(data):
        if marker == 0xDA:  # the pixels begin; what follows the end mark, a film perhaps, does not matter
            return data.find(b"\xff\xd9", start) > 0
    return False


@dataclass(frozen=True)
class Stored:
    """A JPEG as it is stored: width and height, and how its EXIF tag asks viewers to turn it; 1 for not at all."""

    size: tuple[int, int]
    orientation: int

    @property
    def shown(self) -> tuple[int, int]:
        """Width and height as viewers show it, and `cv2.imread` reads it."""
        return self.size if self.orientation < 5 else self.size[::-1]


def stored_jpeg(path: Path) -> Stored | None:
    """How a JPEG is stored, from its head.

    Args:
        path: The file.

    Returns:
        Size and orientation; None of a file that is no JPEG, or is damaged, which reading it tells.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_HEAD_BYTES)
    except OSError:
        return None
    head = read_head(data) if data.startswith(JPEG) else None
    return None if head is None else Stored((head.width, head.height), head.orientation)


_HEAD_BYTES = 1 << 18
"""EXIF with its preview has at most 64 KiB, and the frame comes soon after it."""


def check_size(width: int, height: int, path: Path | str) -> None:
    """Refuse a picture that is too large, before it is unpacked.

    Args:
        width: In pixels, as the file's head declares it.
        height: In pixels.
        path: The file, or what else the picture comes from, for the message.

    Raises:
        ImageError: It has more than `MAX_PIXELS`.
    """
    if width * height > MAX_PIXELS:
        raise ImageError(
            f"{path} has {width:,} x {height:,} pixels.",
            why=f"pictures may have {MAX_PIXELS // 1_000_000} million pixels at most, and this would be "
            f"{width * height / 1e6:,.0f} million once unpacked; it was not",
            fix="export it smaller, or cut out the part that is needed",
        )


class _Room:
    """So many bytes for pictures that are being unpacked; who finds too few waits until others are done."""

    def __init__(self, size: int) -> None:
        self.size = self._free = size
        self._changed = Condition()

    @contextmanager
    def taking(self, amount: int) -> Iterator[None]:
        """A context that holds so many bytes; all of them where more are asked for."""
        amount = min(amount, self.size)
        with self._changed:
            self._changed.wait_for(lambda: self._free >= amount)
            self._free -= amount
        try:
            yield
        finally:
            with self._changed:
                self._free += amount
                self._changed.notify_all()


_ROOM = _Room(MAX_UNPACKING_BYTES)


def to_grey(image: NDArray[Any], path: Path) -> Grey:
    """A decoded picture as grey from 0 to 1.

    Args:
        image: (height, width) or (height, width, channels) of 8 or 16 bits; blue, green, red.
        path: Its file, for the message.

    Raises:
        ImageError: It has other numbers, or too many.
    """
    cv2 = opencv()
    if image.dtype not in (np.uint8, np.uint16):
        raise ImageError(
            f"{path} holds {image.dtype} numbers.", why="pictures have 8 or 16 bits", fix="export it with 8 or 16 bits"
        )
    check_size(image.shape[1], image.shape[0], path)
    if image.ndim == 3 and image.shape[2] in (3, 4):
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY)
    elif image.ndim == 3:
        image = image[:, :, 0]
    grey = image.astype(np.float32)
    grey *= np.float32(1 / np.iinfo(image.dtype).max)
    return grey


def write_picture(path: Path, picture: NDArray[Any], *, bits: int = 8) -> None:
    """Write a picture; the ending of the file chooses its format.

    Args:
        path: The file; it is replaced whole.
        picture: (height, width) grey from 0 to 1, or uint8 as it is; colour is (height, width, 3) blue, green, red.
        bits: 8, or anything else for 16, of a picture that is not uint8.

    Raises:
        UsageError: The ending is none of `ENDINGS`.
        ImplicamError: The file cannot be written.
    """
    cv2 = opencv()
    if picture.dtype != np.uint8:
        most, kind = (255, np.uint8) if bits == 8 else (65535, np.uint16)
        picture = np.clip(np.rint(picture * most), 0, most).astype(kind)
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise UsageError(f"{path} is no name for a picture.", fix=f"end it in {', '.join(ENDINGS)}")
    quality = [cv2.IMWRITE_JPEG_QUALITY, 85]
    options = {".png": [cv2.IMWRITE_PNG_COMPRESSION, 1], ".jpg": quality, ".jpeg": quality}.get(ending, [])
    _, encoded = cv2.imencode(ending, picture, options)
    with replacing(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


def eight_bit(picture: Grey) -> NDArray[np.uint8]:
    """The picture as OpenCV's detectors need it: its darkest and brightest per mille become 0 and 255.

    Args:
        picture: (height, width) grey.

    Returns:
        (height, width).
    """
    sample = picture[::7, ::7]
    low, high = np.quantile(sample, (0.001, 0.999))
    scale = 255 / max(float(high - low), 1e-3)
    out: NDArray[np.uint8] = np.clip((picture - low) * scale, 0, 255).astype(np.uint8)
    return out


def brighten(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture whose dark parts show: the darkest hundredth black, the brightest fiftieth white, and a gamma of 0.6.

    Args:
        grey: (height, width) as `eight_bit` gives it.

    Returns:
        (height, width).
    """
    low, high = np.quantile(grey[::3, ::3], (0.01, 0.98))
    levels = np.clip((np.arange(256) - low) / max(float(high - low), 1.0), 0, 1) ** 0.6
    table: NDArray[np.uint8] = np.rint(255 * levels).astype(np.uint8)
    return table[grey]


def blank(picture: Grey) -> str:
    """What a picture without anything in it is.

    It is blank where the means of blocks of 8 x 8 pixels differ by no more than the noise from pixel to pixel explains.
    The noise is the root mean square of Immerkaer's operator (1996); the few edges of a small target hardly enlarge it.

    Args:
        picture: (height, width) grey from 0 to 1.

    Returns:
        "black", "white" or "uniformly grey"; empty where there is something in it.
    """
    cv2 = opencv()
    height, width = picture.shape
    laplacian = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6
    noise = float(np.sqrt(np.mean(np.square(cv2.filter2D(picture, cv2.CV_32F, laplacian), dtype=np.float64))))
    blocks = cv2.resize(picture, (-(-width // 8), -(-height // 8)), interpolation=cv2.INTER_AREA)
    low, high = float(blocks.min()), float(blocks.max())
    # The largest of n Gaussian numbers is near sqrt(2 ln n), and with +2 beyond it in one picture of thousands only.
    widest = 2 * (np.sqrt(2 * np.log(blocks.size + 1)) + 2) * noise * np.sqrt(blocks.size / picture.size)
    if high - low > max(widest, 1e-6):
        return ""
    return "black" if high < 0.03 else "white" if low > 0.97 else "uniformly grey"
