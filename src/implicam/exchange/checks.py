"""Reading numbers that others wrote: each mistake is a DatasetError that names file, key and cure."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from implicam.errors import DatasetError, did_you_mean
from implicam.exchange.other_lenses import OtherLens, rational_lens, with_skew
from implicam.geometry import Pose
from implicam.lenses import BrownConrady, Floats, KannalaBrandt, Lens

MAX_BYTES = 1 << 18  # YAML takes seconds for more
MAX_COEFFICIENTS = 14  # of OpenCV's largest lens model
MAX_CAMERAS = 1000
MAX_NAMES_SHOWN = 12  # in an error message
MAX_NUMBER = 1e100  # larger ones cannot be squared
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
            why=f"the keys there are {list_names(list(table))}" if table else "there is no key at all",
            fix="add it, or export the file again; of another kind of file, name the kind",
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
    if abs(number) > MAX_NUMBER:
        raise DatasetError(f"{place} = {shorten(value)} is too large a number.", fix="correct the value")
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


def lens_from_matrix(matrix: Floats, coefficients: Sequence[float], *, fisheye: bool, place: str) -> Lens | OtherLens:
    """Make a lens from OpenCV's camera matrix and distortion coefficients.

    Args:
        matrix: (3, 3), in pixels; it may have a skew.
        coefficients: In OpenCV's order, see `lens_from_numbers`.
        fisheye: Whether they are those of cv2.fisheye.
        place: Where they stand, for the error.

    Raises:
        DatasetError: It is no camera matrix, or there is no such lens.
    """
    if any((matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[2, 2] - 1)):
        raise DatasetError(
            f"{place}: the camera matrix {shorten(matrix.tolist())} has entries beside fx, fy, cx, cy.",
            why="it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
            fix="correct the values; of a projection matrix, give the camera matrix",
        )
    linear = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    lens = lens_from_numbers(linear, coefficients, fisheye, place)
    return with_skew(lens, float(matrix[0, 1])) if matrix[0, 1] else lens


def lens_from_numbers(
    linear: Sequence[float], coefficients: Sequence[float], fisheye: bool, place: str
) -> Lens | OtherLens:
    """Make a lens from focal lengths, principal point and OpenCV's distortion coefficients.

    Args:
        linear: Fx, fy, cx, cy in pixels.
        coefficients: The first 0, 4, 5, 8, 12 or 14 of k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y; of
            a fisheye k1, k2, k3, k4.
        fisheye: Whether they are those of cv2.fisheye.
        place: Where they stand, for the error.

    Returns:
        The lens; one that is not among the families here where a coefficient beyond k3 is not zero.

    Raises:
        DatasetError: Their number is wrong.
    """
    given = [float(k) for k in coefficients]
    counts = (0, 4) if fisheye else (0, 4, 5, 8, 12, 14)
    if len(given) not in counts:
        raise DatasetError(
            f"{place}: {len(given)} distortion coefficients.",
            why=f"{'a fisheye lens has k1, k2, k3, k4' if fisheye else 'OpenCV has k1, k2, p1, p2, k3, ...'}",
            fix=f"give {' or '.join(map(str, counts))} of them",
        )
    focal = [float(x) for x in linear]
    if fisheye:
        return KannalaBrandt(*focal, *given)
    return rational_lens(focal, given) if any(given[5:]) else BrownConrady(*focal, *given[:5])


def shorten(value: object) -> str:
    """A value as an error message shows it, at most 80 characters.

    Args:
        value: Anything.
    """
    return reprlib.repr(value)[:80]


def list_names(names: Sequence[str]) -> str:
    """Names as an error message shows them: the first `MAX_NAMES_SHOWN`, each shortened.

    Args:
        names: Of keys or files.
    """
    shown = ", ".join(shorten(name)[1:-1] for name in names[:MAX_NAMES_SHOWN])
    return shown + (f" and {len(names) - MAX_NAMES_SHOWN} more" if len(names) > MAX_NAMES_SHOWN else "")
