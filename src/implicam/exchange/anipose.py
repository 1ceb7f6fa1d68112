"""`aniposelib` and `pose2sim`: the same TOML, with two readings.

    [cam_0]
    name, size = [width, height], matrix = 3 x 3, distortions, rotation = rvec, translation, fisheye = true (or absent)

                aniposelib                                   pose2sim
    tables      cam_0, cam_1, ...                            the camera's name
    lens        k1, k2, p1, p2, k3, or a fisheye's k1 ... k4 k1, k2, p1, p2
    lengths     of the board; the rig's own are written      metres
    [metadata]  adjusted, error; ours keeps length_unit      adjusted, error

Rotation and translation are camera_from_world; pixels are OpenCV's. Pose2Sim reads no `fisheye`.
"""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path
from typing import Any

from implicam.dataset.tables import naming
from implicam.dataset.units import UNKNOWN_UNIT
from implicam.errors import DatasetError
from implicam.exchange.checks import (
    MAX_CAMERAS,
    as_table,
    check_text,
    get_entry,
    lens_from_matrix,
    read_image_size,
    read_numbers,
    shorten,
)
from implicam.exchange.fits import fit_four_coefficients
from implicam.exchange.model import ExplicitCamera, Rig
from implicam.exchange.refits import make_camera
from implicam.exchange.source import Source, read_toml
from implicam.files import toml_text, write_text
from implicam.geometry import Pose, rotation_from_vector, vector_from_rotation
from implicam.lenses import KannalaBrandt, Lens

NON_CAMERA_TABLES = ("metadata", "capture_volume", "charuco", "checkerboard")
"""Tables that Pose2Sim and others leave out when they look for cameras."""


def write_aniposelib(rig: Rig, path: Path) -> list[str]:
    """Write the rig for aniposelib, in the rig's own unit.

    Args:
        rig: The cameras, all with image sizes.
        path: The TOML file.

    Returns:
        No notes: everything is kept.

    Raises:
        DatasetError: An image size is not known.
        ImplicamError: The file cannot be written.
    """
    width = len(str(len(rig.cameras) - 1))  # aniposelib sorts the tables as text
    tables = {f"cam_{i:0{width}}": _camera_table(camera, camera.lens) for i, camera in enumerate(rig.cameras)}
    metadata = {"adjusted": False, "error": 0.0, "length_unit": rig.length_unit}
    write_text(path, toml_text({**tables, "metadata": metadata}))
    return []


def write_pose2sim(rig: Rig, path: Path) -> list[str]:
    """Write the rig for Pose2Sim, in metres; a lens with more than k1, k2, p1, p2 is refitted.

    Args:
        rig: The cameras, all with image sizes, in a known unit.
        path: The TOML file.

    Returns:
        Notes on the unit, and on what refitting a lens cost in pixels.

    Raises:
        DatasetError: A name, a lens, an image size or the unit does not fit the format.
        ImplicamError: The file cannot be written.
    """
    metres, notes, tables = rig.in_unit("m"), [], {}
    if rig.length_unit != "m":
        notes.append(f"Lengths are in metres; the rig's unit was {rig.length_unit}.")
    for camera in metres.cameras:
        if camera.name in NON_CAMERA_TABLES:
            raise DatasetError(f"Pose2Sim takes {camera.name!r} for something else than a camera.", fix="rename it")
        lens, cost = fit_four_coefficients(camera)
        if cost:
            notes.append(f"Camera {camera.name!r}: Pose2Sim has k1, k2, p1, p2 only; fitted again with these: {cost}.")
        table = _camera_table(camera, lens)
        sides = [float(side) for side in camera.size]  # as Pose2Sim writes them
        tables[camera.name] = {**table, "size": sides, "distortions": table["distortions"][:4], "fisheye": False}
    write_text(path, toml_text({**tables, "metadata": {"adjusted": False, "error": 0.0}}))
    return notes


def _camera_table(camera: ExplicitCamera, lens: Lens) -> dict[str, Any]:
    pose = camera.camera_from_world
    numbers = {
        "matrix": [[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]],
        "distortions": [float(k) for k in astuple(lens)[4:]],
        "rotation": vector_from_rotation(pose.rotation).tolist(),
        "translation": pose.translation.tolist(),
    }
    fisheye = {"fisheye": True} if isinstance(lens, KannalaBrandt) else {}
    return {"name": camera.name, "size": list(camera.size), **numbers, **fisheye}


def read_aniposelib(path: Path) -> Rig:
    """Read a file of aniposelib or Anipose; its unit is known only where implicam wrote it.

    Args:
        path: The TOML file.

    Raises:
        DatasetError: The file has a mistake; the error names the key.
    """
    table = read_toml(path)
    metadata = as_table(table.get("metadata", {}), f"{path}: metadata")
    unit = check_text(metadata.get("length_unit", UNKNOWN_UNIT), f"{path}: metadata.length_unit")
    return _read_rig(table, path, unit)


def read_pose2sim(path: Path) -> Rig:
    """Read a Calib.toml of Pose2Sim, in metres.

    Args:
        path: The TOML file.

    Raises:
        DatasetError: The file has a mistake; the error names the key.
    """
    return _read_rig(read_toml(path), path, "m")


def knows_pose2sim(source: Source) -> bool:
    """Whether a TOML file has tables of cameras with four coefficients and no fisheye, as Pose2Sim writes them.

    Args:
        source: What is given.
    """
    cameras = _cameras_of(source)
    lengths = {len(c["distortions"]) for c in cameras if isinstance(c.get("distortions"), list)}
    return lengths == {4} and not any(c.get("fisheye") is True for c in cameras)


def knows_aniposelib(source: Source) -> bool:
    """Whether a TOML file has tables of cameras.

    Args:
        source: What is given.
    """
    return bool(_cameras_of(source))


def _cameras_of(source: Source) -> list[dict[str, Any]]:
    """The tables of a TOML file that look like a camera."""
    cameras = camera_tables(source.toml).values()
    return [camera for camera in cameras if {"matrix", "distortions", "rotation", "translation"} & set(camera)]


def camera_tables(table: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Those of the file's tables that are cameras.

    Args:
        table: The whole file, as `read_toml` gives it.

    Returns:
        Key -> table; what `NON_CAMERA_TABLES` names is left out.
    """
    return {key: value for key, value in table.items() if isinstance(value, dict) and key not in NON_CAMERA_TABLES}


def _read_rig(table: dict[str, Any], path: Path, unit: str) -> Rig:
    cameras = camera_tables(table)
    if not 0 < len(cameras) <= MAX_CAMERAS:
        raise DatasetError(f"{path}: it has {len(cameras)} tables of cameras.", fix="each camera is a table, [cam_0]")
    with naming(str(path)):
        read = [_read_camera(key, value, f"{path}: [{key}]") for key, value in cameras.items()]
        return Rig(tuple(camera for camera, _ in read), unit, tuple(note for _, notes in read for note in notes))


def _read_camera(key: str, table: dict[str, Any], place: str) -> tuple[ExplicitCamera, list[str]]:
    def array(name: str, *shape: int) -> Any:
        return read_numbers(get_entry(table, name, place), shape, f"{place} {name}")

    fisheye = table.get("fisheye", False)
    if not isinstance(fisheye, bool):
        raise DatasetError(f"{place}: fisheye = {shorten(fisheye)} must be true or false.", fix="correct the value")
    matrix = array("matrix", 3, 3)
    lens = lens_from_matrix(matrix, array("distortions", -1).tolist(), fisheye=fisheye, place=place)
    size = read_image_size(get_entry(table, "size", place), f"{place} size")
    pose = Pose(rotation_from_vector(array("rotation", 3)), array("translation", 3))
    return make_camera(check_text(table.get("name", key), f"{place} name"), size, lens, pose, place)
