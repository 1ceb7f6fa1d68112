"""`dlt`: the eleven coefficients of the direct linear transformation, as DLTdv and easyWand keep them.

A CSV without header: eleven rows L1 ... L11, one column a camera, so that

    u = (L1 x + L2 y + L3 z + L4) / (L9 x + L10 y + L11 z + 1),   v = (L5 x + ... + L8) / (the same)

(Abdel-Aziz & Karara 1971). The file knows no names, no image sizes, no unit and not where its pixels begin, so all that
stands beside it, in NAME.csv.toml. Pixels are those of MATLAB: (1, 1) is the centre of the first pixel, which is the
top-left one (`image_origin = "upper-left"`; written) or, in older files of DLTdv and easyWand, the bottom-left one with
v upwards (`"lower-left"`). DLTdv 8 has a function, dlt_invert, that turns the one into the other.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset.model import Camera
from implicam.dataset.tables import naming
from implicam.errors import DatasetError
from implicam.exchange.checks import (
    as_list,
    as_table,
    check_text,
    get_entry,
    read_integer,
    read_numbers,
    read_text,
    shorten,
)
from implicam.exchange.fits import Cost, fit_projection_matrix, pinhole_from_matrix
from implicam.exchange.model import ExplicitCamera, Rig
from implicam.exchange.source import Source, read_toml
from implicam.files import toml_text, write_text
from implicam.lenses import Floats

ORIGINS = ("upper-left", "lower-left")
COEFFICIENTS_PER_CAMERA = 11


def write(rig: Rig, path: Path, points: Floats | None = None) -> list[str]:
    """Write coefficients and their description, in the rig's own unit.

    A pinhole is exact; a lens with distortion is replaced by the nearest transformation.

    Args:
        rig: The cameras, all with image sizes.
        path: The CSV file; its description is written beside it, as NAME.csv.toml.
        points: (n, 3) in the rig's world frame and unit, at which it is to be near, and for which the centre of
            projection may move too; None for the whole image.

    Returns:
        Notes on what a lens cost in pixels.

    Raises:
        DatasetError: A camera has no such form, sees fewer than 12 of the points, or its image size is not known.
        ImplicamError: The files cannot be written.
    """
    columns, notes = [], []
    for camera in rig.cameras:
        column, cost = find_coefficients(camera, points)
        columns.append(column)
        if cost:
            where = "over the image" if points is None else "at the given points"
            notes.append(f"Camera {camera.name!r}: DLT has no lens distortion; the nearest is off {where}: {cost}.")
    tables = [{"name": c.name, "width": c.size[0], "height": c.size[1]} for c in rig.cameras]
    head = {"length_unit": rig.length_unit, "image_origin": "upper-left", "cameras": tables}
    write_text(_description_path(path), toml_text(head))
    write_text(path, "".join(",".join(map(repr, row)) + "\n" for row in np.column_stack(columns).tolist()))
    return notes


def find_coefficients(camera: ExplicitCamera, points: Floats | None = None) -> tuple[Floats, Cost | None]:
    """The coefficients of one camera, for pixels from the upper left, and what the format costs.

    Args:
        camera: With its image size.
        points: (n, 3) at which it is to be near, see `write`; None for the whole image.

    Returns:
        (11,) L1 ... L11; and the cost, None where there is none (a pinhole).

    Raises:
        DatasetError: The camera has no such form, or sees fewer than 12 of the points.
    """
    p, cost = fit_projection_matrix(camera, points)
    p = np.linalg.inv(_ours_from_dlt("upper-left", camera.size[1])) @ p
    if abs(p[2, 3]) < 1e-9 * np.abs(p[2]).max():
        raise DatasetError(
            f"camera {camera.name!r} cannot be written with eleven coefficients.",
            why="the origin of the world lies beside the camera, in the plane through its centre: L12 would be zero",
            fix="choose an origin in front of the cameras",
        )
    return (p / p[2, 3]).ravel()[:COEFFICIENTS_PER_CAMERA], cost


def read(path: Path) -> Rig:
    """Read coefficients and the description beside them; a skew, which no camera has, is left out and noted.

    Args:
        path: The CSV file.

    Returns:
        Cameras without distortion; the rig's notes say what leaving out a skew cost.

    Raises:
        DatasetError: There is no description, or one of the files has a mistake.
    """
    columns = _read_columns(path)
    unit, origin, tables = _read_description(path, len(columns))
    cameras, notes = [], []
    for i, (table, column) in enumerate(zip(tables, columns, strict=True), 1):
        camera, cost = _make_camera(table, column, origin, f"{path}, column {i}")
        cameras.append(camera)
        if cost:
            notes.append(f"Camera {camera.name!r}: its axes were not at right angles; made so, pixels move: {cost}.")
    if all(camera.camera_from_world.translation[2] < 0 for camera in cameras):
        notes.append(f"Every camera looks away from the world's origin. Is image_origin {origin!r} right?")
    with naming(str(path)):
        return Rig(tuple(cameras), unit, tuple(notes))


def knows(source: Source) -> bool:
    """Whether a file holds numbers and commas, and nothing else.

    Args:
        source: What is given.
    """
    return re.fullmatch(r"[-+0-9.,eE\s]+", source.text) is not None


def _read_description(path: Path, columns: int) -> tuple[str, str, list[dict[str, Any]]]:
    """The unit, where the pixels begin, and a table for each column, from the description beside the coefficients."""
    beside = _description_path(path)
    if not beside.is_file():
        raise DatasetError(
            f"{path} says nothing of names, image sizes, unit and origin of the pixels.",
            why=f"they are read from {beside.name}, which does not exist",
            fix=f'write {beside.name} with length_unit = "mm", image_origin = "lower-left" (v upwards: older '
            'DLTdv and easyWand) or "upper-left", and for each column [[cameras]] with name, width and height',
        )
    head, place = read_toml(beside), str(beside)
    unit = check_text(get_entry(head, "length_unit", place), f"{place}: length_unit")
    origin = get_entry(head, "image_origin", place)
    if origin not in ORIGINS:
        raise DatasetError(f"{place}: image_origin = {shorten(origin)}.", fix=f"write one of {', '.join(ORIGINS)}")
    tables = as_list(get_entry(head, "cameras", place), f"{place}: cameras")
    if len(tables) != columns:
        raise DatasetError(
            f"{path} has {columns} columns, and {beside.name} names {len(tables)} cameras.",
            fix="name each column, in their order",
        )
    return unit, origin, [as_table(table, f"{place}: cameras[{i}]") for i, table in enumerate(tables)]


def _make_camera(table: dict[str, Any], column: Floats, origin: str, place: str) -> tuple[ExplicitCamera, Cost | None]:
    name = check_text(get_entry(table, "name", place), f"{place}: name")
    width, height = (read_integer(get_entry(table, key, place), f"{place}: {key}") for key in ("width", "height"))
    p = np.append(column, 1.0).reshape(3, 4)
    with naming(place):
        Camera(name, width, height)  # refuses a size that is none
        return pinhole_from_matrix(name, (width, height), _ours_from_dlt(origin, height) @ p, place)


def _ours_from_dlt(origin: str, height: int) -> Floats:
    """The map (3, 3) from the file's homogeneous pixels to ours."""
    if origin == "upper-left":
        return np.array([[1.0, 0, -1], [0, 1, -1], [0, 0, 1]])
    return np.array([[1.0, 0, -1], [0, -1, height], [0, 0, 1]])


def _read_columns(path: Path) -> list[Floats]:
    """The columns (11,) of the file; a header is refused."""
    rows = [line.split(",") for line in read_text(path).splitlines() if line.strip()]
    if len(rows) != COEFFICIENTS_PER_CAMERA:
        raise DatasetError(
            f"{path} has {len(rows)} rows; DLT coefficients are {COEFFICIENTS_PER_CAMERA} rows, one column a camera.",
            why="it is turned on its side" if rows and len(rows[0]) == COEFFICIENTS_PER_CAMERA else "",
            fix="give a CSV without header, L1 to L11 from top to bottom",
        )
    values = [
        read_numbers([cell.strip() for cell in row], (len(rows[0]),), f"{path}, row {i}")
        for i, row in enumerate(rows, 1)
    ]
    return list(np.array(values).T)


def _description_path(path: Path) -> Path:
    return path.with_name(path.name + ".toml")
