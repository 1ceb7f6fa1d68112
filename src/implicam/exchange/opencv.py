"""`opencv`: YAML, XML or JSON of cv2.FileStorage, with the keys of OpenCV's own calibration programs.

    cameras:
       -
          name, image_width, image_height
          camera_matrix             3 x 3
          distortion_coefficients   k1, k2, p1, p2, k3; of a fisheye k1, k2, k3, k4
          fisheye_model             1 for cv2.fisheye, else 0
          R, T                      camera_from_world: x_camera = R x_world + T
    length_unit: m

OpenCV itself has no unit; its multi-camera functions want metres, so metres are written. Read are also files with
`rvec`, `tvec` in place of R, T, the file of one camera that OpenCV's calibration program writes, several of these with
their poses, up to 14 coefficients and `xi` of cv2.omnidir (by a refit), and the keys of `MATRIX_KEYS`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset.tables import naming
from implicam.dataset.units import UNKNOWN_UNIT
from implicam.errors import DatasetError
from implicam.exchange.checks import MAX_CAMERAS, as_list, as_table, check_text, get_entry, shorten
from implicam.exchange.model import ExplicitCamera, Rig
from implicam.exchange.refits import make_camera
from implicam.exchange.source import Source, read_yaml
from implicam.exchange.storage import lens_lines, matrix_lines, read_lens, read_pose, read_size
from implicam.files import write_text
from implicam.geometry import Pose
from implicam.lenses import KannalaBrandt

MATRIX_KEYS = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "M", "mtx")
DISTORTION_KEYS = (
    "distortion_coefficients",
    "Distortion_Coefficients",
    "distCoeffs",
    "dist_coeffs",
    "dist_coeff",
    "dist",
    "D",
)


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
        *lens_lines(lens, "camera_matrix", "distortion_coefficients"),
        *matrix_lines("R", pose.rotation),
        *matrix_lines("T", pose.translation[:, None]),
    ]
    return "   -\n" + "".join(f"      {line}\n" for line in lines)


def knows(source: Source) -> bool:
    """Whether a file has a camera matrix, or a list of cameras.

    Args:
        source: What is given.
    """
    keys = set(source.keys)
    short = bool(set(MATRIX_KEYS) & keys) and bool(set(DISTORTION_KEYS) & keys)
    return short or bool({"cameras", "camera_matrix", "Camera_Matrix", "cameraMatrix"} & keys)


def read(paths: Sequence[Path]) -> Rig:
    """Read a rig; the head of this file says which files.

    Args:
        paths: One file, or several that belong together, each with one camera or more.

    Raises:
        DatasetError: A file has a mistake, or does not say where a camera of several stands; the error names the key
            and the cure.
    """
    tables = [(table, place) for path in paths for table, place in _camera_tables(path)]
    units = {check_text(table.get("length_unit", UNKNOWN_UNIT), f"{place}: length_unit") for table, place in tables}
    if len(units) > 1:
        raise DatasetError(f"{paths[0]} and others have the units {shorten(sorted(units))}.", fix="give one unit")
    cameras, notes = [], []
    for table, place in tables:
        camera, said = _read_camera(table, place, alone=len(tables) == 1)
        cameras.append(camera)
        notes += said
    with naming(str(paths[0])):
        return Rig(tuple(cameras), units.pop(), tuple(notes))


def _camera_tables(path: Path) -> list[tuple[dict[str, Any], str]]:
    """The cameras of a file, each with its place."""
    table, place = read_yaml(path), str(path)
    if "cameras" not in table:
        return [({"name": path.stem, **table}, place)]
    unit = {"length_unit": table["length_unit"]} if "length_unit" in table else {}
    listed = as_list(table["cameras"], f"{place}: cameras")
    places = [f"{place}: cameras[{i}]" for i in range(MAX_CAMERAS)]
    return [(as_table(camera, where) | unit, where) for camera, where in zip(listed, places, strict=False)]


def _read_camera(table: dict[str, Any], place: str, *, alone: bool) -> tuple[ExplicitCamera, list[str]]:
    name = check_text(get_entry(table, "name", place), f"{place}: name")
    place = f"{place} ({shorten(name)})"
    matrix = next((key for key in MATRIX_KEYS if key in table), MATRIX_KEYS[0])
    distortion = next((key for key in DISTORTION_KEYS if key in table), DISTORTION_KEYS[0])
    lens, notes = read_lens(table, matrix, distortion, name, place)
    pose = _read_pose(table, place)
    if pose is None and not alone:
        raise DatasetError(
            f"{place} does not say where the camera stands.",
            why="it has neither R and T nor rvec and tvec, and there are several cameras",
            fix="add R and T (x_camera = R x_world + T), for the camera that is the world the identity and zeros; or "
            "calibrate the places: implicam calibrate --method explicit",
        )
    notes += [] if pose else ["The file has no pose: the world is the camera's own frame."]
    camera, cost = make_camera(name, read_size(table, place), lens, pose or Pose(np.eye(3), np.zeros(3)), place)
    return camera, [*notes, *cost]


def _read_pose(table: dict[str, Any], place: str) -> Pose | None:
    for rotation, translation in (("R", "T"), ("rvec", "tvec")):
        if rotation in table or translation in table:
            return read_pose(table, place, rotation, translation)
    return None
