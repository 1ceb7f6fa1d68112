"""`caliscope`: camera_array.toml of caliscope, and the config.toml of its older versions.

    [cameras.0]       in config.toml [cam_0]
    cam_id, size = [width, height], matrix = 3 x 3, distortions, fisheye = true (or absent)
    rotation          camera_from_world: a rotation vector, in older files a 3 x 3 matrix
    translation       metres

Pixels are OpenCV's. A camera without matrix or place is one that caliscope has not calibrated yet.
"""

from __future__ import annotations

import re
from dataclasses import astuple
from pathlib import Path
from typing import Any

from implicam.dataset.tables import naming
from implicam.errors import DatasetError
from implicam.exchange.anipose import NON_CAMERA_TABLES
from implicam.exchange.checks import MAX_CAMERAS, as_table, list_names
from implicam.exchange.model import ExplicitCamera, Rig
from implicam.exchange.refits import make_camera
from implicam.exchange.source import Source, read_toml
from implicam.exchange.storage import read_lens, read_pose, read_size
from implicam.files import toml_text, write_text
from implicam.geometry import vector_from_rotation
from implicam.lenses import KannalaBrandt

CALIBRATED = ("matrix", "distortions", "rotation", "translation")


def write(rig: Rig, path: Path) -> list[str]:
    """Write camera_array.toml, in metres.

    Args:
        rig: The cameras, all with image sizes, in a known unit.
        path: The TOML file.

    Returns:
        Notes on the numbers that stand for names, and on the unit.

    Raises:
        DatasetError: An image size or the unit is not known.
        ImplicamError: The file cannot be written.
    """
    numbers = [re.fullmatch(r"cam_(\d{1,6})", camera.name) for camera in rig.cameras]
    named = [int(number[1]) for number in numbers if number]
    ids = named if len(set(named)) == len(rig.cameras) else list(range(len(rig.cameras)))
    tables = {str(i): _camera_table(camera, i) for i, camera in zip(ids, rig.in_unit("m").cameras, strict=True)}
    write_text(path, toml_text({"cameras": tables}))
    notes = [] if rig.length_unit == "m" else [f"Lengths are in metres; the rig's unit was {rig.length_unit}."]
    renamed = [f"{i} is {c.name!r}" for i, c in zip(ids, rig.cameras, strict=True) if c.name != f"cam_{i}"]
    return notes + ([f"caliscope numbers its cameras: {list_names(renamed)}."] if renamed else [])


def _camera_table(camera: ExplicitCamera, i: int) -> dict[str, Any]:
    lens, pose = camera.lens, camera.camera_from_world
    return {
        "cam_id": i,
        "size": list(camera.size),
        "rotation_count": 0,
        "matrix": [[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]],
        "distortions": [float(k) for k in astuple(lens)[4:]],
        "rotation": vector_from_rotation(pose.rotation).tolist(),
        "translation": pose.translation.tolist(),
        "fisheye": isinstance(lens, KannalaBrandt),
    }


def knows(source: Source) -> bool:
    """Whether a TOML file has the cameras one level deeper, or rotations that are matrices.

    Args:
        source: What is given.
    """
    table = source.toml
    if "cameras" in table:
        return isinstance(table["cameras"], dict) and any(isinstance(v, dict) for v in table["cameras"].values())
    rotations = [camera.get("rotation") for camera in _tables(table).values()]
    return any(isinstance(r, list) and r and isinstance(r[0], list) for r in rotations)


def _tables(table: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The tables of cameras, by cam_N."""
    if isinstance(table.get("cameras"), dict):
        return {f"cam_{key}": as_table(value, f"[cameras.{key}]") for key, value in table["cameras"].items()}
    tables = {key: value for key, value in table.items() if isinstance(value, dict) and "size" in value}
    return {key: value for key, value in tables.items() if key not in NON_CAMERA_TABLES}


def read(path: Path) -> Rig:
    """Read the cameras that are calibrated.

    Args:
        path: The TOML file.

    Returns:
        The cameras, in metres, named cam_0, cam_1, ... by their numbers.

    Raises:
        DatasetError: The file has a mistake, or no camera is calibrated.
    """
    with naming(str(path)):
        tables = _tables(read_toml(path))
    skipped = [
        name for name, table in tables.items() if table.get("ignore") is True or not set(CALIBRATED) <= set(table)
    ]
    kept = {name: table for name, table in tables.items() if name not in skipped}
    if not 0 < len(kept) <= MAX_CAMERAS:
        raise DatasetError(
            f"{path}: {len(kept)} of {len(tables)} cameras are calibrated.",
            why=f"a calibrated camera has {', '.join(CALIBRATED)}",
            fix="calibrate in caliscope to the end, and give its camera_array.toml",
        )
    cameras, notes = [], [f"Left out, because they are not calibrated: {list_names(skipped)}."] if skipped else []
    for name, table in kept.items():
        place = f"{path}: {name}"
        lens, _ = read_lens({"fisheye": False, **table}, "matrix", "distortions", name, place)
        pose = read_pose(table, place, "rotation", "translation")
        camera, cost = make_camera(name, read_size(table, place), lens, pose, place)
        cameras.append(camera)
        notes += cost
    with naming(str(path)):
        return Rig(tuple(cameras), "m", tuple(notes))
