"""`opencv`: one YAML file that cv2.FileStorage reads, with the keys of OpenCV's own calibration programs.

    cameras:
       -
          name, image_width, image_height
          camera_matrix             3 x 3
          distortion_coefficients   k1, k2, p1, p2, k3; of a fisheye k1, k2, k3, k4
          fisheye_model             1 for cv2.fisheye, else 0
          R, T                      camera_from_world: x_camera = R x_world + T
    length_unit: m

OpenCV itself has no unit; its multi-camera functions want metres, so metres are written. Read are also files with
`rvec`, `tvec` in place of R, T, and the file of one camera that OpenCV's calibration program writes, which has no pose.
"""

from __future__ import annotations

import json
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset.tables import naming
from implicam.errors import DatasetError
from implicam.exchange.checks import (
    MAX_CAMERAS,
    as_list,
    as_table,
    check_text,
    get_entry,
    lens_from_matrix,
    read_integer,
    read_numbers,
    read_yaml,
    rotation_matrix,
    shorten,
)
from implicam.exchange.model import UNKNOWN_UNIT, ExplicitCamera, Rig
from implicam.files import write_text
from implicam.geometry import Pose, rotation_from_vector
from implicam.lenses import Floats, KannalaBrandt


def write(rig: Rig, path: Path) -> list[str]:
    """Write the rig in metres; nothing is lost but the unit.

    Args:
        rig: The cameras, all with image sizes, in a known unit.
        path: The YAML file.

    Returns:
        A note where the unit was another.

    Raises:
        DatasetError: An image size or the unit is not known.
        ImplicamError: The file cannot be written.
    """
    cameras = "".join(_camera_text(camera) for camera in rig.in_unit("m").cameras)
    write_text(path, f'%YAML:1.0\n---\nlength_unit: "m"\ncameras:\n{cameras}')
    return [] if rig.length_unit == "m" else [f"Lengths are in metres; the rig's unit was {rig.length_unit}."]


def _camera_text(camera: ExplicitCamera) -> str:
    lens, pose = camera.lens, camera.camera_from_world
    width, height = camera.size
    lines = [
        f"name: {json.dumps(camera.name, ensure_ascii=False)}",
        f"image_width: {width}",
        f"image_height: {height}",
        f"fisheye_model: {int(isinstance(lens, KannalaBrandt))}",
        *_matrix_lines("camera_matrix", np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])),
        *_matrix_lines("distortion_coefficients", np.array(astuple(lens)[4:])[:, None]),
        *_matrix_lines("R", pose.rotation),
        *_matrix_lines("T", pose.translation[:, None]),
    ]
    return "   -\n" + "".join(f"      {line}\n" for line in lines)


def _matrix_lines(name: str, values: Floats) -> list[str]:
    rows, columns = values.shape
    data = ", ".join(repr(float(x)) for x in values.ravel())
    return [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d", f"   data: [ {data} ]"]


def read(path: Path) -> Rig:
    """Read a rig; the head of this file says which files.

    Args:
        path: The YAML file.

    Raises:
        DatasetError: The file has a mistake; the error names the key and the cure.
    """
    table = read_yaml(path)
    place = str(path)
    unit = check_text(table.get("length_unit", UNKNOWN_UNIT), f"{place}: length_unit")
    if "cameras" not in table:
        posed = {"R", "rvec"} & set(table)
        notes = () if posed else ("The file has no pose: the world is the camera's own frame.",)
        return Rig((_read_camera({"name": path.stem, **table}, place),), unit, notes)
    places = [f"{place}: cameras[{i}]" for i in range(MAX_CAMERAS)]
    listed = zip(as_list(table["cameras"], f"{place}: cameras"), places, strict=False)
    cameras = tuple(_read_camera(as_table(camera, where), where) for camera, where in listed)
    with naming(place):
        return Rig(cameras, unit)


def _read_camera(table: dict[str, Any], place: str) -> ExplicitCamera:
    name = check_text(get_entry(table, "name", place), f"{place}: name")
    place = f"{place} ({shorten(name)})"
    k = _read_matrix(get_entry(table, "camera_matrix", place), f"{place}: camera_matrix", (3, 3))
    given = _read_matrix(get_entry(table, "distortion_coefficients", place), f"{place}: distortion_coefficients", (-1,))
    fisheye = read_integer(table.get("fisheye_model", 0), f"{place}: fisheye_model") != 0
    lens = lens_from_matrix(k, given.tolist(), fisheye=fisheye, place=place)
    sizes = [table[key] for key in ("image_width", "image_height") if key in table]
    width, height = [read_integer(size, f"{place}: image size") for size in sizes] if len(sizes) == 2 else (None, None)
    with naming(place):
        return ExplicitCamera(name, width, height, lens, _read_pose(table, place))


def _read_pose(table: dict[str, Any], place: str) -> Pose:
    if "R" in table or "T" in table:
        r = _read_matrix(get_entry(table, "R", place), f"{place}: R", (3, 3))
        return Pose(rotation_matrix(r, f"{place}: R"), _read_matrix(get_entry(table, "T", place), f"{place}: T", (3,)))
    if "rvec" in table or "tvec" in table:
        rotation = rotation_from_vector(_read_matrix(get_entry(table, "rvec", place), f"{place}: rvec", (3,)))
        return Pose(rotation, _read_matrix(get_entry(table, "tvec", place), f"{place}: tvec", (3,)))
    return Pose(np.eye(3), np.zeros(3))


def _read_matrix(value: object, place: str, shape: tuple[int, ...]) -> Floats:
    """An OpenCV matrix as an array; a vector may be a row, a column, one-dimensional (OpenCV 5) or a plain list."""
    if isinstance(value, list):
        return read_numbers(value, shape, place)
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
