"""`easymocap`: a folder with intri.yml and extri.yml, as EasyMocap keeps its cameras.

    intri.yml   names, and for each NAME: K_NAME, dist_NAME (k1, k2, p1, p2, k3), H_NAME, W_NAME (which may be absent)
    extri.yml   names, and for each NAME: R_NAME (a rotation vector), Rot_NAME (its matrix), T_NAME

R and T are camera_from_world; pixels are OpenCV's. It has no unit. Only the vector is read, as EasyMocap does; the
matrix where there is no vector.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

from implicam.dataset.tables import naming
from implicam.dataset.units import UNKNOWN_UNIT
from implicam.errors import DatasetError
from implicam.exchange.checks import MAX_CAMERAS, check_text, get_entry, list_names, read_integer, shorten
from implicam.exchange.fits import nearest_brown_conrady
from implicam.exchange.folders import write_folder
from implicam.exchange.model import Rig
from implicam.exchange.refits import make_camera
from implicam.exchange.source import Source, read_yaml
from implicam.exchange.storage import lens_lines, matrix_lines, read_lens, read_pose
from implicam.geometry import vector_from_rotation

INTRINSICS_FILE, EXTRINSICS_FILE = "intri.yml", "extri.yml"


def write(rig: Rig, path: Path) -> list[str]:
    """Write the folder, in the rig's own unit; a fisheye is refitted.

    Args:
        rig: The cameras, all with image sizes.
        path: The folder.

    Returns:
        Notes on names, on the unit, and on what refitting a lens cost in pixels.

    Raises:
        DatasetError: The folder holds something else, two names become the same, or a fisheye is too wide.
        ImplicamError: The folder cannot be written.
    """
    names = [re.sub(r"\W", "_", camera.name, flags=re.ASCII) for camera in rig.cameras]  # a name is a part of keys
    if len(set(names)) < len(names):
        raise DatasetError("two cameras would have the same name in EasyMocap.", fix="rename one of them")
    listed = ["%YAML:1.0", "---", "names:", *(f"  - {json.dumps(name)}" for name in names)]
    intrinsics, extrinsics, notes = list(listed), list(listed), []
    for name, camera in zip(names, rig.cameras, strict=True):
        lens, lost = nearest_brown_conrady(camera, "EasyMocap")
        notes += lost
        pose = camera.camera_from_world
        intrinsics += lens_lines(lens, f"K_{name}", f"dist_{name}")
        intrinsics += [f"H_{name}: {camera.size[1]}", f"W_{name}: {camera.size[0]}"]
        extrinsics += matrix_lines(f"R_{name}", vector_from_rotation(pose.rotation)[:, None])
        extrinsics += matrix_lines(f"Rot_{name}", pose.rotation)
        extrinsics += matrix_lines(f"T_{name}", pose.translation[:, None])
    texts = {INTRINSICS_FILE: intrinsics, EXTRINSICS_FILE: extrinsics}
    write_folder(path, {file: "\n".join(lines) + "\n" for file, lines in texts.items()}, "EasyMocap's cameras")
    if names != [camera.name for camera in rig.cameras]:
        notes.append("What is no letter or digit in camera names became _.")
    return [f"EasyMocap's files have no unit: lengths are in {rig.length_unit}.", *notes]


def knows(source: Source) -> bool:
    """Whether it is such a folder, or a file of one.

    Args:
        source: What is given.
    """
    if {INTRINSICS_FILE, EXTRINSICS_FILE} <= source.file_names:
        return True
    return "names" in source.keys and any(re.match("(K|R|Rot|T|dist)_", key) for key in source.keys)


def read(paths: Sequence[Path]) -> Rig:
    """Read the folder.

    Args:
        paths: The folder; or one of its two files, with the other beside it; or both.

    Raises:
        DatasetError: A file is missing or has a mistake; the error names the key.
    """
    intrinsics_path, extrinsics_path = _both_files(paths)
    intrinsics, extrinsics = read_yaml(intrinsics_path), read_yaml(extrinsics_path)
    names = get_entry(intrinsics, "names", str(intrinsics_path))
    if not isinstance(names, list) or not 0 < len(names) <= MAX_CAMERAS:
        raise DatasetError(f"{intrinsics_path}: names = {shorten(names)} is no list of names.", fix="correct the value")
    cameras, notes = [], []
    for name in (check_text(name, f"{intrinsics_path}: names") for name in names):
        place = f"{intrinsics_path} ({shorten(name)})"
        distortion = f"D_{name}" if f"dist_{name}" not in intrinsics and f"D_{name}" in intrinsics else f"dist_{name}"
        lens, _ = read_lens(intrinsics, f"K_{name}", distortion, name, place)
        sides = [read_integer(intrinsics.get(f"{side}_{name}", -1), f"{place}: {side}") for side in "WH"]
        where = f"{extrinsics_path} ({shorten(name)})"
        rotation = f"Rot_{name}" if f"R_{name}" not in extrinsics and f"Rot_{name}" in extrinsics else f"R_{name}"
        pose = read_pose(extrinsics, where, rotation, f"T_{name}")
        camera, cost = make_camera(name, (sides[0], sides[1]) if min(sides) > 0 else None, lens, pose, place)
        cameras.append(camera)
        notes += cost
    with naming(str(intrinsics_path)):
        return Rig(tuple(cameras), UNKNOWN_UNIT, tuple(notes))


def _both_files(paths: Sequence[Path]) -> tuple[Path, Path]:
    """The two files: as given, or beside the one that is given."""
    folders = {path if path.is_dir() else path.parent for path in paths}
    files = [path for path in paths if path.is_file()]
    if len(files) == 2:
        first = [any(key.startswith("K_") for key in read_yaml(file)) for file in files]
        if first.count(True) == 1:
            return files[first.index(True)], files[first.index(False)]
    folder = folders.pop()
    found = {file.name for file in folder.iterdir()} if folder.is_dir() else set()
    missing = sorted({INTRINSICS_FILE, EXTRINSICS_FILE} - found)
    if missing:
        raise DatasetError(
            f"{folder}: {' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing.",
            why=f"lenses and places are in two files; the folder holds {list_names(sorted(found)) or 'nothing'}",
            fix="give the folder with both, or both files",
        )
    return folder / INTRINSICS_FILE, folder / EXTRINSICS_FILE
