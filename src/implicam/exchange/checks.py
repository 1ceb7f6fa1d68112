"""Reading numbers that others wrote: each mistake is a DatasetError that names file, key and cure."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from implicam.errors import DatasetError, did_you_mean, import_extra
from implicam.geometry import Pose
from implicam.lenses import BrownConrady, Floats, KannalaBrandt, Lens

MAX_BYTES = 1 << 18  # YAML takes seconds for more
MAX_COEFFICIENTS = 14  # of OpenCV's largest lens model
MAX_CAMERAS = 1000
MAX_EXACT_INTEGER = 1 << 53  # every smaller float that is whole is exact

ROTATION_ROUNDING, MAX_ROTATION_ERROR = 1e-9, 1e-3
"""A rotation matrix off orthogonal by less than the first is kept, by less than the second is made orthogonal."""


def read_text(path: Path, most: int = MAX_BYTES) -> str:
    """Read the text of a file of cameras.

    Args:
        path: The file.
        most: Bytes that it may have.

    Raises:
        DatasetError: There is no such file, it is too long, or it is no UTF-8 text.
        OSError: The system refuses to read it; `import_cameras` turns this into a DatasetError.
    """
    if not path.is_file():
        state = "is a folder, not a file" if path.is_dir() else "does not exist"
        raise DatasetError(f"{path} {state}.", fix="give the file that the other program wrote")
    if path.stat().st_size > most:
        raise DatasetError(
            f"{path} is {path.stat().st_size:,} bytes long; a file of cameras has at most {most:,}.",
            fix="give the file with the cameras, not one with pictures or points",
        )
    content = path.read_bytes()
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise DatasetError(
            f"{path}, line {line}: byte {content[error.start]:#04x} is not UTF-8 text.",
            fix="give the text form of the file, saved as UTF-8",
        ) from None
    if "\0" in text:
        raise DatasetError(f"{path} holds zero bytes: it is not a text file.", fix="give the text form of the file")
    return text


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file as a dict, in which every value is text, a list or a dict; OpenCV's matrices are dicts.

    Tags, merges and types are not looked at: nothing in the file is run, and a few hundred bytes cannot unfold.

    Args:
        path: The file.

    Raises:
        DatasetError: There is no such file, or it is no YAML with a table at its top.
        MissingExtraError: PyYAML is not installed.
    """
    text = read_text(path)
    yaml = import_extra("yaml", "exchange", "reading YAML")
    if text.lstrip().startswith("<"):
        raise DatasetError(f"{path} is XML, which is not read.", fix="let OpenCV write it with the ending .yml")
    first, _, rest = text.partition("\n")
    if first.startswith("%YAML"):  # OpenCV 4 writes "%YAML:1.0", which is no YAML directive
        text = "\n" + rest
    try:
        table = yaml.load(text, Loader=yaml.BaseLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise DatasetError(
            f"{path}: not valid YAML.",
            why=str(error).replace("\n", " ")[:300] or type(error).__name__,
            fix="the file may be cut off: export it again",
        ) from None
    return as_table(table, str(path))


def as_table(value: object, place: str) -> dict[str, Any]:
    """Check that a value is a mapping with text keys.

    Args:
        value: From a file.
        place: Where it stands, for the error.

    Raises:
        DatasetError: It is something else.
    """
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise DatasetError(f"{place}: {shorten(value)} is no table of named values.", fix="export the file again")
    return value


def as_list(value: object, place: str) -> list[Any]:
    """Check that a value is a list of 1 to `MAX_CAMERAS` entries.

    Args:
        value: From a file.
        place: Where it stands, for the error.

    Raises:
        DatasetError: It is something else.
    """
    if not isinstance(value, list) or not 0 < len(value) <= MAX_CAMERAS:
        raise DatasetError(
            f"{place}: {shorten(value)} is no list of cameras.", fix=f"give from 1 to {MAX_CAMERAS} cameras"
        )
    return value


def get_entry(table: Mapping[str, Any], key: str, place: str) -> Any:
    """A value that must be in a table.

    Args:
        table: From a file.
        key: Of the value.
        place: Where the table stands, for the error.

    Raises:
        DatasetError: It is missing.
    """
    if key not in table:
        raise DatasetError(
            f"{place}: {key!r} is missing{did_you_mean(key, table)}.",
            fix="the file may be cut off, or of another kind: export it again",
        )
    return table[key]


def check_text(value: object, place: str) -> str:
    """Check that a value is text.

    Args:
        value: From a file.
        place: Where it stands, for the error.

    Raises:
        DatasetError: It is something else.
    """
    if not isinstance(value, str):
        raise DatasetError(f"{place} = {shorten(value)} must be text.", fix="write it in quotes")
    return value


def read_integer(value: object, place: str) -> int:
    """Read a whole number, which some programs write as 1280.0.

    Args:
        value: A number, or text.
        place: Where it stands, for the error.

    Raises:
        DatasetError: It is no whole number, or is too large to be exact.
    """
    number = _read_number(value, place)
    if not (number.is_integer() and abs(number) < MAX_EXACT_INTEGER):
        raise DatasetError(f"{place} = {shorten(value)} must be a whole number.", fix="correct the value")
    return int(number)


def read_image_size(value: object, place: str) -> tuple[int, int]:
    """Read width and height in pixels from a pair.

    Args:
        value: A list of two whole numbers.
        place: Where it stands, for the error.

    Raises:
        DatasetError: It is something else.
    """
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise DatasetError(f"{place} = {shorten(value)} must be [width, height] in pixels.", fix="correct the value")
    return read_integer(value[0], f"{place}[0]"), read_integer(value[1], f"{place}[1]")


def read_numbers(value: object, shape: tuple[int, ...], place: str) -> Floats:
    """Read finite numbers as an array.

    The lengths are checked on the way down, so that a file whose lists repeat each other cannot grow without end.

    Args:
        value: Lists in lists, of numbers or text.
        shape: That of the array; of a vector, -1 is any length up to `MAX_COEFFICIENTS`.
        place: Where it stands, for the error.

    Returns:
        float64 of this shape.

    Raises:
        DatasetError: The shape is another, or a number is none or not finite.
    """
    return np.array(_read_nested(value, shape, place), dtype=np.float64)


def _read_nested(value: object, shape: tuple[int, ...], place: str) -> Any:
    if not shape:
        return _read_number(value, place)
    wanted, size = shape[0], len(value) if isinstance(value, list | tuple) else None
    if size is None or not (size <= MAX_COEFFICIENTS if wanted == -1 else size == wanted):
        many = f"at most {MAX_COEFFICIENTS}" if wanted == -1 else f"{wanted}"
        raise DatasetError(f"{place} = {shorten(value)} must be a list of {many}.", fix="correct the value")
    assert isinstance(value, Sequence)
    return [_read_nested(item, shape[1:], f"{place}[{i}]") for i, item in enumerate(value)]


def _read_number(value: object, place: str) -> float:
    try:
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise ValueError
        if isinstance(value, str) and ("_" in value or not value.isascii()):
            raise ValueError
        number = float(value)  # text too: of YAML and of tables everything is text
        if not np.isfinite(number):
            raise ValueError
    except (ValueError, OverflowError):
        raise DatasetError(f"{place} = {shorten(value)} is not a finite number.", fix="correct the value") from None
    return number


def rotation_matrix(matrix: Floats, place: str) -> Floats:
    """Check a rotation matrix, which may have been rounded to a few digits.

    Args:
        matrix: (3, 3).
        place: Where it stands, for the error.

    Returns:
        (3, 3); orthogonal to rounding where it was off by `ROTATION_ROUNDING` or more.

    Raises:
        DatasetError: It is no rotation, or it mirrors.
    """
    off = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if not off < MAX_ROTATION_ERROR or np.linalg.det(matrix) < 0:
        mirror = off < MAX_ROTATION_ERROR
        raise DatasetError(
            f"{place} is not a rotation matrix.",
            why="it mirrors: its determinant is -1" if mirror else f"R R^T differs from the identity by {off:.2g}",
            fix="correct the signs of its rows" if mirror else "write it with more digits, or export it again",
        )
    if off < ROTATION_ROUNDING:
        return matrix
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ vt, dtype=np.float64)


def pose_from_matrix(value: object, place: str) -> Pose:
    """Read a pose from a homogeneous matrix.

    Args:
        value: (4, 4), lists in lists.
        place: Where it stands, for the error.

    Raises:
        DatasetError: It is no such matrix.
    """
    matrix = read_numbers(value, (4, 4), place)
    if not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise DatasetError(f"{place}: the last row must be 0, 0, 0, 1.", fix="correct the value")
    return Pose(rotation_matrix(matrix[:3, :3], place), matrix[:3, 3])


def lens_from_matrix(matrix: Floats, coefficients: Sequence[float], *, fisheye: bool, place: str) -> Lens:
    """Make a lens from OpenCV's camera matrix and distortion coefficients.

    Args:
        matrix: (3, 3), in pixels.
        coefficients: In OpenCV's order, see `lens_from_numbers`.
        fisheye: Whether they are those of cv2.fisheye.
        place: Where they stand, for the error.

    Raises:
        DatasetError: The matrix has a skew, or there is no such lens here.
    """
    skew = (matrix[0, 1], matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[2, 2] - 1)
    if any(skew):
        raise DatasetError(
            f"{place}: the camera matrix {shorten(matrix.tolist())} has entries beside fx, fy, cx, cy.",
            why="it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; the lens models here have no skew",
            fix="calibrate without skew",
        )
    return lens_from_numbers((matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]), coefficients, fisheye, place)


def lens_from_numbers(linear: Sequence[float], coefficients: Sequence[float], fisheye: bool, place: str) -> Lens:
    """Make a lens from focal lengths, principal point and OpenCV's distortion coefficients.

    Args:
        linear: Fx, fy, cx, cy in pixels.
        coefficients: k1, k2, p1, p2, k3 or a part of them; of a fisheye k1, k2, k3, k4. Any beyond k3 must be zero.
        fisheye: Whether they are those of cv2.fisheye.
        place: Where they stand, for the error.

    Raises:
        DatasetError: Their number is wrong, or the lens model has more terms than ours.
    """
    given = [float(k) for k in coefficients]
    counts = (4,) if fisheye else (0, 4, 5, 8, 12, 14)
    if len(given) not in counts:
        raise DatasetError(
            f"{place}: {len(given)} distortion coefficients.",
            why=f"{'a fisheye lens has k1, k2, k3, k4' if fisheye else 'OpenCV has k1, k2, p1, p2, k3, ...'}",
            fix=f"give {' or '.join(map(str, counts))} of them",
        )
    focal = [float(x) for x in linear]
    if fisheye:
        return KannalaBrandt(*focal, *given)
    if any(given[5:]):
        raise DatasetError(
            f"{place}: distortion coefficients beyond k3 are not zero: {shorten(given[5:])}.",
            why="the rational, thin-prism and tilted lens models of OpenCV are not supported; supported are "
            "Brown-Conrady (k1, k2, p1, p2, k3) and Kannala-Brandt (fisheye, k1 ... k4)",
            fix="calibrate with five coefficients, or with the fisheye model",
        )
    return BrownConrady(*focal, *given[:5])


def shorten(value: object) -> str:
    """A value as an error message shows it, at most 80 characters.

    Args:
        value: Anything.
    """
    return reprlib.repr(value)[:80]
