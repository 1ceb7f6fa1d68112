"""What files of cv2.FileStorage have in common: matrices, poses, image sizes and lenses, by the names people give."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple
from typing import Any

import numpy as np

from implicam.errors import DatasetError
from implicam.exchange.checks import (
    as_table,
    get_entry,
    lens_from_matrix,
    read_image_size,
    read_integer,
    read_numbers,
    rotation_matrix,
    shorten,
)
from implicam.exchange.other_lenses import OtherLens, omnidirectional_lens, with_skew
from implicam.geometry import Pose, rotation_from_vector
from implicam.lenses import Floats, Lens

FOUR_COEFFICIENTS = (
    "Camera {name!r}: its four distortion coefficients are read as k1, k2, p1, p2. Of cv2.fisheye, write "
    "fisheye_model: 1 beside them."
)
"""What is said where a file does not tell which of OpenCV's two models its four coefficients are of."""


def matrix_lines(name: str, values: Floats, indent: str = "   ") -> list[str]:
    """A matrix as lines of OpenCV's YAML.

    Args:
        name: Its key.
        values: (rows, columns).
        indent: Of its inner lines.
    """
    rows, columns = values.shape
    data = ", ".join(repr(float(x)) for x in values.ravel())
    inner = [f"rows: {rows}", f"cols: {columns}", "dt: d", f"data: [ {data} ]"]
    return [f"{name}: !!opencv-matrix", *(f"{indent}{line}" for line in inner)]


def lens_lines(lens: Lens, matrix: str, distortion: str) -> list[str]:
    """Camera matrix and distortion coefficients of a lens of OpenCV, as lines of its YAML.

    Args:
        lens: Brown-conrady or kannala-brandt.
        matrix: The key of the camera matrix.
        distortion: The key of the coefficients.
    """
    k = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    return [*matrix_lines(matrix, k), *matrix_lines(distortion, np.array(astuple(lens)[4:])[None])]


def read_matrix(value: object, place: str, shape: tuple[int, ...]) -> Floats:
    """Read a matrix of OpenCV; a vector may be a row, a column, one-dimensional (OpenCV 5) or a plain list.

    Args:
        value: A table with rows, cols and data, or lists.
        place: Where it stands, for the error.
        shape: As of `read_numbers`.

    Raises:
        DatasetError: It is no such matrix.
    """
    if isinstance(value, list):
        nested = len(shape) == 1 and all(isinstance(item, list) and len(item) == 1 for item in value)
        flat = len(shape) == 2 and len(value) == shape[0] * shape[1] and not isinstance(value[0], list)
        if nested:  # a column, as NumPy's tolist gives it
            value = [item[0] for item in value]
        elif len(shape) == 1 and len(value) == 1 and isinstance(value[0], list):
            value = value[0]
        return (
            read_numbers(value, (shape[0] * shape[1],), place).reshape(shape)
            if flat
            else read_numbers(value, shape, place)
        )
    matrix = as_table(value, place)
    keys = ("rows", "cols")
    given = get_entry(matrix, "sizes", place) if "sizes" in matrix else [get_entry(matrix, key, place) for key in keys]
    sizes = tuple(int(size) for size in read_numbers(given, (-1,), f"{place} size"))
    if len(shape) == 2 and sizes != shape:
        raise DatasetError(
            f"{place} has the size {shorten(sizes)}; it must be {' x '.join(map(str, shape))}.", fix="correct the value"
        )
    count = shape if len(shape) == 1 else (shape[0] * shape[1],)
    return read_numbers(get_entry(matrix, "data", place), count, f"{place}.data").reshape(shape)


def read_lens(
    table: Mapping[str, Any], matrix: str, distortion: str, name: str, place: str
) -> tuple[Lens | OtherLens, list[str]]:
    """Read the lens of a camera; `fisheye_model` and `xi` beside it say that it is one of cv2.fisheye or cv2.omnidir.

    Args:
        table: With its values.
        matrix: The key of the camera matrix.
        distortion: The key of the coefficients.
        name: Of the camera, for notes.
        place: Where the table stands, for the error.

    Returns:
        The lens; and a note where the file leaves open which it is.

    Raises:
        DatasetError: A value is wrong.
    """
    k = read_matrix(get_entry(table, matrix, place), f"{place}: {matrix}", (3, 3))
    given = read_matrix(get_entry(table, distortion, place), f"{place}: {distortion}", (-1,)).tolist()
    if "xi" in table:
        value = table["xi"]
        xi = (
            read_matrix(value, f"{place}: xi", (1,))
            if isinstance(value, dict | list)
            else read_numbers(value, (), "xi")
        )
        lens = omnidirectional_lens(float(np.ravel(xi)[0]), [k[0, 0], k[1, 1], k[0, 2], k[1, 2]], given[:4])
        return with_skew(lens, float(k[0, 1])) if k[0, 1] else lens, []
    stated = next((key for key in ("fisheye_model", "fisheye") if key in table), None)
    text = {"true": "1", "false": "0"}.get(str(table[stated]).lower(), table[stated]) if stated else 0
    fisheye = read_integer(text, f"{place}: {stated}") != 0
    told = stated is not None or len(given) != 4 or not any(given)
    notes = [] if told else [FOUR_COEFFICIENTS.format(name=name)]
    return lens_from_matrix(k, given, fisheye=fisheye, place=place), notes


def read_size(table: Mapping[str, Any], place: str) -> tuple[int, int] | None:
    """Read the image size, under any of its names; None where there is none.

    Args:
        table: With its values.
        place: Where it stands, for the error.

    Raises:
        DatasetError: It is no size.
    """
    for width, height in (("image_width", "image_height"), ("width", "height"), ("img_width", "img_height")):
        if width in table and height in table:
            return read_integer(table[width], f"{place}: image size"), read_integer(
                table[height], f"{place}: image size"
            )
    for key in ("image_size", "imageSize", "img_size", "size", "resolution"):
        if isinstance(table.get(key), str):
            return read_image_size(table[key].split(), f"{place}: {key}")
        if isinstance(table.get(key), dict):
            values = read_matrix(table[key], f"{place}: {key}", (2,)).tolist()
            return read_image_size(values, f"{place}: {key}")
        if key in table:
            return read_image_size(table[key], f"{place}: {key}")
    return None


def read_pose(table: Mapping[str, Any], place: str, rotation: str, translation: str) -> Pose:
    """Read a pose, camera_from_world, from a rotation matrix or vector and a translation.

    Args:
        table: With its values.
        place: Where it stands, for the error.
        rotation: The key of a (3, 3) matrix, or of a rotation vector.
        translation: The key of the translation.

    Raises:
        DatasetError: A value is missing or wrong.
    """
    value = get_entry(table, rotation, place)
    t = read_matrix(get_entry(table, translation, place), f"{place}: {translation}", (3,))
    if _is_vector(value):
        return Pose(rotation_from_vector(read_matrix(value, f"{place}: {rotation}", (3,))), t)
    r = read_matrix(value, f"{place}: {rotation}", (3, 3))
    return Pose(rotation_matrix(r, f"{place}: {rotation}"), t)


def _is_vector(value: object) -> bool:
    """Whether a value has three numbers, and so is no matrix."""
    data = value.get("data") if isinstance(value, dict) else value
    return (
        isinstance(data, list)
        and len(data) in (1, 3)
        and not (len(data) == 3 and isinstance(data[0], list) and len(data[0]) == 3)
    )
