"""`opencv-stereo`: what people write after cv2.stereoCalibrate: two lenses, and the second camera against the first.

    K1, D1, K2, D2    camera matrices and distortion coefficients; M1, M2 in OpenCV's own sample
    R, T              x2 = R x1 + T

In one file, or in two: intrinsics.yml and extrinsics.yml. Names are read as people write them: K1, M1, mtx1,
cameraMatrix1, K_left, left_K, KL, ... (`MATRIX_STEMS`, `DISTORTION_STEMS`, `SIDES`). The world is the first camera; the
unit is that of the board's squares, which only a file from here says (`length_unit`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset.tables import naming
from implicam.dataset.units import UNKNOWN_UNIT
from implicam.errors import DatasetError
from implicam.exchange.checks import check_text, list_names
from implicam.exchange.model import Rig
from implicam.exchange.refits import make_camera
from implicam.exchange.source import Source, read_yaml
from implicam.exchange.storage import lens_lines, matrix_lines, read_lens, read_pose, read_size
from implicam.files import write_text
from implicam.geometry import Pose
from implicam.lenses import KannalaBrandt

SIDES = (("1", "2"), ("left", "right"), ("l", "r"), ("0", "1"))
MATRIX_STEMS = ("k", "m", "mtx", "cameramatrix", "intrinsic", "intrinsics", "intrinsicmatrix")
DISTORTION_STEMS = ("d", "dist", "distcoeffs", "distcoeff", "distcoefs", "distortion", "distortioncoefficients")
ROTATIONS = ("r", "rot", "rotation", "rotationmatrix", "stereor", "rmat", "rvec", "om")
TRANSLATIONS = ("t", "trans", "translation", "translationvector", "stereot", "tvec")

CHANGED_PLACES = "Written is the second camera against the first: the world is the first camera's frame."


def write(rig: Rig, path: Path) -> list[str]:
    """Write two cameras, in the rig's own unit, with the first as the world.

    Args:
        rig: Two cameras, both with image sizes.
        path: The YAML file.

    Returns:
        What is lost: the world, the names and the unit.

    Raises:
        DatasetError: The rig has not two cameras, or they have lenses of two kinds.
        ImplicamError: The file cannot be written.
    """
    if len(rig.cameras) != 2:
        raise DatasetError(
            f"the rig has {len(rig.cameras)} cameras.", why="opencv-stereo holds two", fix="export to opencv instead"
        )
    one, two = rig.cameras
    fisheye = isinstance(one.lens, KannalaBrandt)
    if fisheye != isinstance(two.lens, KannalaBrandt):
        raise DatasetError(
            "one camera is a fisheye and one is not.",
            why="cv2.stereoCalibrate and cv2.fisheye.stereoCalibrate know one kind",
            fix="export to opencv instead",
        )
    if one.size != two.size:
        raise DatasetError("the two images have two sizes.", why="the file holds one", fix="export to opencv instead")
    pose = two.camera_from_world @ one.camera_from_world.inverse()
    lines = [
        f"length_unit: {json.dumps(rig.length_unit)}",
        f"image_width: {one.size[0]}",
        f"image_height: {one.size[1]}",
        f"fisheye_model: {int(fisheye)}",
        *lens_lines(one.lens, "K1", "D1"),
        *lens_lines(two.lens, "K2", "D2"),
        *matrix_lines("R", pose.rotation),
        *matrix_lines("T", pose.translation[:, None]),
    ]
    write_text(path, "%YAML:1.0\n---\n" + "".join(f"{line}\n" for line in lines))
    return [CHANGED_PLACES, "The cameras are 1 and 2 in the file, which has no names."]


def knows(source: Source) -> bool:
    """Whether files have two camera matrices with the names of two sides.

    Args:
        source: What is given.
    """
    return _lens_keys(source.keys) is not None


def read(paths: Sequence[Path]) -> Rig:
    """Read a pair; its cameras are cam1 and cam2, or left and right where the keys say so.

    Args:
        paths: One file, or two that belong together.

    Raises:
        DatasetError: A file has a mistake, or lacks a part; the error names the keys that are there.
    """
    table: dict[str, Any] = {}
    for path in paths:
        for key, value in read_yaml(path).items():
            if table.setdefault(key, value) != value:
                raise DatasetError(
                    f"{path}: {key!r} has another value in another of the files.", fix="give files that belong together"
                )
    place = " and ".join(map(str, paths))
    lenses = _lens_keys(tuple(table))
    if lenses is None:
        raise DatasetError(
            f"{place}: there are no two lenses.",
            why=f"the keys there are {list_names(list(table)) or 'none'}; looked for are K1, D1, K2, D2",
            fix="give the file with the intrinsics as well, or name another kind",
        )
    rotation, translation = _find(table, ROTATIONS), _find(table, TRANSLATIONS)
    if rotation is None or translation is None:
        raise DatasetError(
            f"{place}: it does not say where the second camera stands against the first.",
            why=f"the keys there are {list_names(list(table))}; R and T are missing",
            fix="give the file with R and T (extrinsics.yml) as well",
        )
    return _read_pair(table, place, lenses, read_pose(table, place, rotation, translation))


def _read_pair(table: dict[str, Any], place: str, lenses: list[tuple[str, str, str]], pose: Pose) -> Rig:
    cameras, notes = [], ["The world is the frame of the first camera."]
    for (name, matrix, distortion), at in zip(lenses, (Pose(np.eye(3), np.zeros(3)), pose), strict=True):
        lens, said = read_lens(table, matrix, distortion, name, place)
        camera, cost = make_camera(name, read_size(table, place), lens, at, place)
        cameras.append(camera)
        notes += [*said, *cost]
    with naming(place):
        unit = check_text(table.get("length_unit", UNKNOWN_UNIT), f"{place}: length_unit")
        return Rig(tuple(cameras), unit, tuple(notes))


def _lens_keys(keys: Sequence[str]) -> list[tuple[str, str, str]] | None:
    """For both cameras name, key of the camera matrix and key of the distortion; None where these are not there."""
    plain = {_plain(key): key for key in keys}
    for sides in SIDES:
        found = []
        for side, number in zip(sides, ("1", "2"), strict=True):
            matrix, distortion = (
                next((plain[key] for stem in stems for key in (stem + side, side + stem) if key in plain), None)
                for stems in (MATRIX_STEMS, DISTORTION_STEMS)
            )
            name = {"l": "left", "r": "right"}.get(side[0], f"cam{number}")
            found += [(name, matrix, distortion)] if matrix and distortion else []
        if len(found) == 2:
            return found
    return None


def _find(table: Mapping[str, Any], names: Sequence[str]) -> str | None:
    plain = {_plain(key): key for key in table}
    return next((plain[name] for name in names if name in plain), None)


def _plain(key: str) -> str:
    return key.lower().replace("_", "").replace(" ", "").replace("-", "")
