"""Photographs: read one, whole or not at all; write one; find those of a dataset.

A picture is grey, float32, (height, width), from 0 (black) to 1 (what the file's bits can hold at most). Same file
name = same instant. OpenCV is imported when the first picture is read.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.errors import ImageError, UsageError, import_extra
from implicam.files import replacing

Grey = NDArray[np.float32]

ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
MAX_PIXELS = 400_000_000
MAX_BYTES = 2_000_000_000

PATTERN = "{camera}/{shot}"
"""Where the picture of a camera and a shot is, below the folder of images and without its ending."""


def opencv() -> Any:
    """The module cv2, or a MissingExtraError that says how to get it."""
    return import_extra("cv2", "images", "reading and writing photographs")


def read_picture(path: Path) -> Grey:
    """A photograph as grey values from 0 to 1: PNG, JPEG or TIFF, grey or colour, 8 or 16 bits.

    ImageError for what cannot be read, is cut off, or has another form. A rotation that only the file's EXIF tag asks
    for is not done: pixels are those of the sensor.
    """
    cv2 = opencv()
    data = _bytes(path)
    image = None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise ImageError(f"{path} cannot be read.", why=str(error), fix="export it again as PNG or TIFF") from error
    if image is None:
        raise ImageError(
            f"{path} is not a picture that can be read.",
            why=f"{len(data):,} bytes, and no PNG, JPEG or TIFF",
            fix="export it again as PNG, JPEG or TIFF",
        )
    return _grey(image, path)


def _bytes(path: Path) -> bytes:
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise ImageError(f"{path} has {size:,} bytes.", fix="one picture a file, at most 2 GB")
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"{path} cannot be read.", why=str(error), fix="check the file and its permissions") from error
    if not data:
        raise ImageError(f"{path} is empty.", fix="copy it again from where it was recorded")
    # The decoders fill what is missing with grey, and say nothing that a program could hear.
    cut_png = data.startswith(b"\x89PNG\r\n\x1a\n") and b"IEND" not in data[-64:]
    cut_jpeg = data.startswith(b"\xff\xd8\xff") and b"\xff\xd9" not in data[-4096:]
    if cut_png or cut_jpeg:
        raise ImageError(
            f"{path} is cut off.",
            why=f"it ends after {len(data):,} bytes, before the picture does",
            fix="copy it again from where it was recorded",
        )
    return data


def _grey(image: NDArray[Any], path: Path) -> Grey:
    cv2 = opencv()
    if image.dtype not in (np.uint8, np.uint16):
        raise ImageError(
            f"{path} holds {image.dtype} numbers.", why="pictures have 8 or 16 bits", fix="export it with 8 or 16 bits"
        )
    if image.size > MAX_PIXELS:
        raise ImageError(f"{path} has {image.size:,} values.", fix="pictures may have 400 million at most")
    if image.ndim == 3 and image.shape[2] in (3, 4):
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY)
    elif image.ndim == 3:
        image = image[:, :, 0]
    grey = image.astype(np.float32)
    grey *= np.float32(1 / np.iinfo(image.dtype).max)
    return grey


def write_picture(path: Path, picture: NDArray[Any], *, bits: int = 8) -> None:
    """Write a grey picture from 0 to 1 (or a uint8 array as it is, colour as blue, green, red); the ending chooses."""
    cv2 = opencv()
    if picture.dtype != np.uint8:
        most, kind = (255, np.uint8) if bits == 8 else (65535, np.uint16)
        picture = np.clip(np.rint(picture * most), 0, most).astype(kind)
    ending = path.suffix.lower()
    options = {".png": [cv2.IMWRITE_PNG_COMPRESSION, 1], ".jpg": [cv2.IMWRITE_JPEG_QUALITY, 85]}.get(ending, [])
    good, encoded = cv2.imencode(ending, picture, options)
    if not good:
        raise UsageError(f"{path} is no name for a picture.", fix=f"end it in {', '.join(ENDINGS)}")
    with replacing(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


def eight_bit(picture: Grey) -> NDArray[np.uint8]:
    """The picture as OpenCV's detectors want it: its darkest and brightest per mille become 0 and 255."""
    sample = picture[::7, ::7]
    low, high = np.quantile(sample, (0.001, 0.999))
    scale = 255 / max(float(high - low), 1e-3)
    out: NDArray[np.uint8] = np.clip((picture - low) * scale, 0, 255).astype(np.uint8)
    return out


def find_pictures(folder: Path, pattern: str = PATTERN) -> dict[str, dict[str, Path]]:
    """The files by camera and shot: {camera: {shot: path}}, both sorted as people count (2 before 10).

    pattern: the path below `folder` with {camera} and {shot}, without the ending: "{camera}/{shot}" (a folder per
    camera), "{shot}_{camera}", ... UsageError for a pattern without both; ImageError where two files claim one place.
    """
    expression = _expression(pattern)
    if not folder.is_dir():
        raise ImageError(f"there is no folder {folder}.", fix="put the pictures of each camera into images/<camera>/")
    found: dict[str, dict[str, Path]] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() not in ENDINGS or not path.is_file() or path.name.startswith("."):
            continue
        match = expression.fullmatch(path.relative_to(folder).with_suffix("").as_posix())
        if match is None:
            continue
        shots = found.setdefault(match["camera"], {})
        if match["shot"] in shots:
            raise ImageError(
                f"{shots[match['shot']]} and {path} are both the picture of shot {match['shot']!r}.",
                why="the same name is the same instant",
                fix="remove one of them",
            )
        shots[match["shot"]] = path
    if not found:
        raise ImageError(
            f"{folder} holds no picture that fits the pattern {pattern!r}.",
            why=f"looked for {', '.join(ENDINGS)}",
            fix="put the pictures of each camera into images/<camera>/, or give --pattern, "
            'for example --pattern "{shot}_{camera}"',
        )
    return {camera: {shot: found[camera][shot] for shot in in_order(found[camera])} for camera in in_order(found)}


def in_order(names: Sequence[str] | dict[str, Any]) -> list[str]:
    """Names as people count: img2 before img10."""

    def key(name: str) -> list[tuple[int, int, str]]:
        parts = re.split(r"(\d+)", name)
        return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts]

    return sorted(names, key=key)


def _expression(pattern: str) -> re.Pattern[str]:
    for word in ("{camera}", "{shot}"):
        if pattern.count(word) != 1:
            raise UsageError(
                f"the pattern {pattern!r} must contain {word} once.",
                why="a picture belongs to one camera and one shot",
                fix='write for example "{camera}/{shot}" or "{shot}_{camera}"',
            )
    text = re.escape(pattern).replace(r"\{camera\}", "(?P<camera>[^/]+?)").replace(r"\{shot\}", "(?P<shot>[^/]+)")
    return re.compile(text)
