"""The files of a COLMAP model, as text or binary, with or without rigs: what is in them, before it becomes cameras.

    cameras   CAMERA_ID MODEL WIDTH HEIGHT PARAMS
    images    IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and its points, which are passed over
    rigs      RIG_ID, its sensors, and for each but the first sensor_from_rig; since COLMAP 3.12
    frames    FRAME_ID RIG_ID rig_from_world, and the images of the moment

Binary files hold the same in little-endian numbers: COLMAP, "Output Format".
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from implicam.errors import DatasetError
from implicam.exchange.checks import MAX_CAMERAS, read_numbers, read_text, shorten
from implicam.geometry import Pose

MAX_BYTES = 1 << 26  # images lists the points of every image
MAX_NAME_BYTES = 1000
MAX_ENTRIES = 1_000_000  # of a file: a larger count is no count

MODEL_NUMBERS = {
    "SIMPLE_PINHOLE": (0, 3),
    "PINHOLE": (1, 4),
    "SIMPLE_RADIAL": (2, 4),
    "RADIAL": (3, 5),
    "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8),
    "FULL_OPENCV": (6, 12),
    "FOV": (7, 5),
    "SIMPLE_RADIAL_FISHEYE": (8, 4),
    "RADIAL_FISHEYE": (9, 5),
    "THIN_PRISM_FISHEYE": (10, 12),
    "RAD_TAN_THIN_PRISM_FISHEYE": (11, 16),
    "SIMPLE_DIVISION": (12, 4),
    "DIVISION": (13, 5),
    "SIMPLE_FISHEYE": (14, 3),
    "FISHEYE": (15, 4),
    "EUCM": (16, 6),
    "EQUIRECTANGULAR": (17, 2),
}
"""The number of a model in binary files, and how many parameters it has."""

CAMERA_SENSOR = "CAMERA"
SENSOR_TYPES = {0: CAMERA_SENSOR, 1: "IMU"}


@dataclass(frozen=True)
class CameraEntry:
    """A camera of the file: lens model, image size and parameters, in COLMAP's order."""

    model: str
    size: tuple[int, int]
    params: list[str]
    place: str


@dataclass(frozen=True)
class ImageEntry:
    """An image: its name, its camera, and camera_from_world."""

    name: str
    camera: str
    pose: Pose


@dataclass(frozen=True)
class RigEntry:
    """A rig: sensor_from_rig of its cameras, None where COLMAP does not know it."""

    key: str
    sensors: dict[str, Pose | None]


@dataclass(frozen=True)
class FrameEntry:
    """A moment: its rig, and rig_from_world."""

    rig: str
    pose: Pose


@dataclass(frozen=True)
class Model:
    """All that is read of a folder. comment: the text of the file of cameras; rigs, frames: empty in older models."""

    cameras: dict[str, CameraEntry]
    images: list[ImageEntry]
    rigs: list[RigEntry]
    frames: list[FrameEntry]
    comment: str


def read_model(path: Path) -> Model:
    """Read a folder; text where it has text, else binary.

    Args:
        path: The folder.

    Raises:
        DatasetError: It is no model, or a file has a mistake; the error names the line or the byte.
    """
    ending = next(
        (e for e in (".txt", ".bin") if all((path / f"{n}{e}").is_file() for n in ("cameras", "images"))), None
    )
    if ending is None:
        raise DatasetError(
            f"{path} is no COLMAP model.",
            why="it must be a folder with cameras.txt and images.txt, or with cameras.bin and images.bin",
            fix="give the folder that COLMAP wrote, such as sparse/0",
        )
    readers: list[tuple[str, Callable[[Any], Any], Callable[[Any], Any]]] = [
        ("cameras", _cameras_of_text, _cameras_of_bytes),
        ("images", _images_of_text, _images_of_bytes),
        ("rigs", _rigs_of_text, _rigs_of_bytes),
        ("frames", _frames_of_text, _frames_of_bytes),
    ]
    found: list[Any] = []
    for name, of_text, of_bytes in readers:
        file = path / f"{name}{ending}"
        if not file.is_file():
            found.append([])
        elif ending == ".txt":
            found.append(of_text(file))
        else:
            found.append(of_bytes(_Bytes(file)))
    cameras, images, rigs, frames = found
    return Model(
        dict(cameras), images, rigs, frames, read_text(path / "cameras.txt", MAX_BYTES) if ending == ".txt" else ""
    )


# ---- text


def _content_lines(path: Path) -> Iterator[tuple[str, str]]:
    """Lines that are neither empty nor comments, each with its place."""
    for n, line in enumerate(read_text(path, MAX_BYTES).splitlines(), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield line.strip(), f"{path}, line {n}"


def _cameras_of_text(path: Path) -> Iterator[tuple[str, CameraEntry]]:
    for line, place in _content_lines(path):
        parts = line.split()
        if len(parts) < 4 or not (parts[2].isdecimal() and parts[3].isdecimal() and len(parts[2] + parts[3]) < 20):
            raise DatasetError(
                f"{place}: {shorten(line)} is not CAMERA_ID MODEL WIDTH HEIGHT PARAMS.", fix="export it again"
            )
        yield parts[0], CameraEntry(parts[1], (int(parts[2]), int(parts[3])), parts[4:], place)


def _images_of_text(path: Path) -> list[ImageEntry]:
    """The first line of each image: the line after it lists points, and may be empty."""
    found, skip = [], False
    for n, line in enumerate(read_text(path, MAX_BYTES).splitlines(), 1):
        if skip:
            skip = False
        elif line.strip() and not line.lstrip().startswith("#"):
            found.append(_image_of_line(line.strip(), f"{path}, line {n}"))
            skip = True
    return found


def _image_of_line(line: str, place: str) -> ImageEntry:
    parts = line.split()
    if len(parts) < 10:
        raise DatasetError(
            f"{place}: {shorten(line)} is not IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME.", fix="export it again"
        )
    return ImageEntry(parts[9], parts[8], _pose(parts[1:8], place))


def _rigs_of_text(path: Path) -> list[RigEntry]:
    rigs = []
    for line, place in _content_lines(path):
        words = iter(line.split())
        key, count = _take(words, 2, line, place)
        sensors: dict[str, Pose | None] = {}
        for i in range(_count(count, place)):
            kind, sensor = _take(words, 2, line, place)
            known = i == 0 or _take(words, 1, line, place) == ["1"]
            pose = Pose(np.eye(3), np.zeros(3)) if i == 0 else None
            if i and known:
                pose = _pose(_take(words, 7, line, place), place)
            if kind == CAMERA_SENSOR:
                sensors[sensor] = pose
        rigs.append(RigEntry(key, sensors))
    return rigs


def _frames_of_text(path: Path) -> list[FrameEntry]:
    frames = []
    for line, place in _content_lines(path):
        words = iter(line.split())
        _, rig = _take(words, 2, line, place)
        frames.append(FrameEntry(rig, _pose(_take(words, 7, line, place), place)))
    return frames


def _take(words: Iterator[str], count: int, line: str, place: str) -> list[str]:
    """The next words of a line."""
    taken = list(islice(words, count))
    if len(taken) < count:
        raise DatasetError(f"{place}: {shorten(line)} ends too early.", fix="export it again")
    return taken


def _count(text: str, place: str) -> int:
    if not (text.isdecimal() and len(text) < 7):
        raise DatasetError(f"{place}: {shorten(text)} is no number of sensors.", fix="export it again")
    return int(text)


def _pose(numbers: object, place: str) -> Pose:
    """A quaternion (w, x, y, z) and a translation."""
    w, x, y, z, *translation = read_numbers(numbers, (7,), f"{place}: pose").tolist()
    if not abs(np.linalg.norm([w, x, y, z]) - 1) < 1e-3:
        raise DatasetError(f"{place}: the quaternion does not have length 1.", fix="export it again")
    return Pose(Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(translation))


# ---- binary


class _Bytes:
    """A binary file that is read from its beginning, and says where it ends too early."""

    def __init__(self, path: Path) -> None:
        if path.stat().st_size > MAX_BYTES:
            raise DatasetError(
                f"{path} is {path.stat().st_size:,} bytes long; at most {MAX_BYTES:,} are read.",
                fix=f"keep one image of each camera, at most {MAX_CAMERAS}, in the model",
            )
        self.path, self.content, self.at = path, path.read_bytes(), 0

    def numbers(self, layout: str) -> tuple[Any, ...]:
        """The next numbers, by the letters of `struct`."""
        size = struct.calcsize(f"<{layout}")
        if self.at + size > len(self.content):
            raise DatasetError(
                f"{self.path} ends at byte {len(self.content):,}, in the middle of an entry.",
                fix="copy or export the file again: a part of it is missing",
            )
        found = struct.unpack_from(f"<{layout}", self.content, self.at)
        self.at += size
        return found

    def count(self) -> int:
        """The next number, of entries."""
        (number,) = self.numbers("Q")
        if number > MAX_ENTRIES:
            raise DatasetError(
                f"{self.path}, byte {self.at - 8:,}: {number:,} entries.", fix="give a binary file of COLMAP, whole"
            )
        return int(number)

    def name(self) -> str:
        """The next text, which a zero ends."""
        end = self.content.find(b"\0", self.at, self.at + MAX_NAME_BYTES)
        try:
            if end < 0:
                raise ValueError
            text = self.content[self.at : end].decode("utf-8")
        except ValueError:
            raise DatasetError(
                f"{self.path}, byte {self.at:,}: there is no name of an image.", fix="export the model again"
            ) from None
        self.at = end + 1
        return text

    @property
    def place(self) -> str:
        """Where it is, for errors."""
        return f"{self.path}, byte {self.at:,}"


def _cameras_of_bytes(data: _Bytes) -> Iterator[tuple[str, CameraEntry]]:
    models = {number: (name, count) for name, (number, count) in MODEL_NUMBERS.items()}
    for _ in range(data.count()):
        place = data.place
        key, number, width, height = data.numbers("IiQQ")
        if number not in models:
            raise DatasetError(
                f"{place}: the lens model of number {number} is not known.",
                why=f"known are {', '.join(MODEL_NUMBERS)}",
                fix="write the model as text, with colmap model_converter --output_type TXT",
            )
        name, count = models[number]
        params = data.numbers(f"{count}d")
        yield str(key), CameraEntry(name, (width, height), [repr(float(p)) for p in params], place)


def _images_of_bytes(data: _Bytes) -> list[ImageEntry]:
    images = []
    for _ in range(data.count()):
        place = data.place
        numbers = data.numbers("I7dI")
        name = data.name()
        points = data.count()
        data.numbers(f"{24 * points}x")
        images.append(ImageEntry(name, str(numbers[8]), _pose(list(numbers[1:8]), place)))
    return images


def _rigs_of_bytes(data: _Bytes) -> list[RigEntry]:
    rigs = []
    for _ in range(data.count()):
        key, count = data.numbers("II")
        sensors: dict[str, Pose | None] = {}
        for i in range(count):
            place = data.place
            kind, sensor = data.numbers("iI")
            pose = Pose(np.eye(3), np.zeros(3)) if i == 0 else None
            if i and data.numbers("B")[0]:
                pose = _pose(list(data.numbers("7d")), place)
            if SENSOR_TYPES.get(kind) == CAMERA_SENSOR:
                sensors[str(sensor)] = pose
        rigs.append(RigEntry(str(key), sensors))
    return rigs


def _frames_of_bytes(data: _Bytes) -> list[FrameEntry]:
    frames = []
    for _ in range(data.count()):
        place = data.place
        _, rig, *numbers = data.numbers("II7d")
        (count,) = data.numbers("I")
        data.numbers(f"{16 * count}x")
        frames.append(FrameEntry(str(rig), _pose(numbers, place)))
    return frames
