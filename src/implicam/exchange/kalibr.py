"""`kalibr`: the camchain.yaml of Kalibr, for pinhole cameras with radtan, equidistant or no distortion.

    cam0, cam1, ...
      camera_model: pinhole, intrinsics: [fu, fv, pu, pv]
      distortion_model: radtan (k1, k2, p1, p2), equidistant (k1 ... k4) or none; distortion_coeffs
      resolution: [width, height]
      T_cn_cnm1: 4 x 4, from the camera before to this one; not of cam0
      rostopic: where Kalibr finds the pictures

In metres, with pixels as in OpenCV. Kalibr has no world and no names: a further key T_cam_world says where each camera
is, and camera_name what it is called; Kalibr leaves keys that it does not know alone.
"""

from __future__ import annotations

import json
from dataclasses import astuple
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset.tables import naming
from implicam.errors import DatasetError
from implicam.exchange.checks import (
    as_table,
    check_text,
    get_entry,
    lens_from_numbers,
    pose_from_matrix,
    read_image_size,
    read_numbers,
    read_yaml,
    shorten,
)
from implicam.exchange.fits import fit_four_coefficients
from implicam.exchange.model import ExplicitCamera, Rig
from implicam.files import write_text
from implicam.geometry import Pose
from implicam.lenses import Floats, KannalaBrandt, Lens

MAX_POSE_DIFFERENCE = 1e-5
"""How far T_cn_cnm1 and T_cam_world may be apart, as a part of the rig's size."""

DISTORTION_COEFFICIENTS = {"radtan": 4, "equidistant": 4, "none": 0}


def write(rig: Rig, path: Path) -> list[str]:
    """Write the chain, in metres; a lens with k3 is refitted without.

    Args:
        rig: The cameras, all with image sizes, in a known unit.
        path: The YAML file.

    Returns:
        Notes on what Kalibr does not have, and on what refitting a lens cost in pixels.

    Raises:
        DatasetError: A lens, an image size or the unit does not fit the format.
        ImplicamError: The file cannot be written.
    """
    rig = rig.in_unit("m")
    notes = [
        "Kalibr has no world frame: its frame is the first camera's. The keys T_cam_world and camera_name keep the "
        "world and the names for implicam; other programs do not read them."
    ]
    text = []
    for i, camera in enumerate(rig.cameras):
        lens, lost = _choose_lens(camera)
        notes += lost
        before = rig.cameras[i - 1].camera_from_world if i else None
        text.append(f"cam{i}:\n" + "".join(f"  {line}\n" for line in _camera_lines(camera, lens, before)))
    write_text(path, "".join(text))
    return notes


def _choose_lens(camera: ExplicitCamera) -> tuple[Lens, list[str]]:
    if isinstance(camera.lens, KannalaBrandt):
        return camera.lens, []
    lens, cost = fit_four_coefficients(camera)
    if cost is None:
        return lens, []
    return lens, [f"Camera {camera.name!r}: Kalibr's radtan has no k3, so the lens was fitted again without: {cost}."]


def _camera_lines(camera: ExplicitCamera, lens: Lens, before: Pose | None) -> list[str]:
    model = "equidistant" if isinstance(lens, KannalaBrandt) else "radtan"
    pose, name = camera.camera_from_world, json.dumps(camera.name, ensure_ascii=False)
    topic = json.dumps(f"/{camera.name}/image_raw", ensure_ascii=False)
    chain = _matrix_lines("T_cn_cnm1", pose @ before.inverse()) if before else []
    return [
        f"camera_name: {name}",
        "camera_model: pinhole",
        f"intrinsics: {_format_row(astuple(lens)[:4])}",
        f"distortion_model: {model}",
        f"distortion_coeffs: {_format_row(astuple(lens)[4:8])}",
        f"resolution: [{camera.size[0]}, {camera.size[1]}]",
        f"rostopic: {topic}",
        *chain,
        *_matrix_lines("T_cam_world", pose),
    ]


def _matrix_lines(name: str, pose: Pose) -> list[str]:
    rows = np.vstack([np.column_stack([pose.rotation, pose.translation]), [0, 0, 0, 1]])
    return [f"{name}:", *(f"- {_format_row(row)}" for row in rows.tolist())]


def _format_row(values: Any) -> str:
    return "[" + ", ".join(_format_number(float(x)) for x in values) + "]"


def _format_number(x: float) -> str:
    """The shortest text that is the same number, with a dot: without, 1e-05 is text in YAML 1.1."""
    text = repr(x)
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def read(path: Path) -> Rig:
    """Read a chain; the world is that of T_cam_world where every camera has it, else the first camera's frame.

    Args:
        path: The YAML file.

    Returns:
        The cameras, in metres.

    Raises:
        DatasetError: The file has a mistake; the error names the key.
    """
    table = read_yaml(path)
    names = [f"cam{i}" for i in range(len(table))]
    if not names or set(names) != set(table):
        raise DatasetError(
            f"{path}: the cameras must be cam0, cam1, ...; found {shorten(list(table))}.",
            fix="give the camchain.yaml that kalibr_calibrate_cameras wrote",
        )
    entries = [(as_table(table[name], f"{path}: {name}"), f"{path}: {name}") for name in names]
    poses, notes = _read_poses(entries)
    with naming(str(path)):
        cameras = [_read_camera(t, pose, place) for (t, place), pose in zip(entries, poses, strict=True)]
        return Rig(tuple(cameras), "m", notes)


def _read_camera(table: dict[str, Any], pose: Pose, place: str) -> ExplicitCamera:
    key = place.rpartition(": ")[2]
    name = check_text(table.get("camera_name", key), f"{place}: camera_name")
    width, height = read_image_size(get_entry(table, "resolution", place), f"{place}: resolution")
    return ExplicitCamera(name, width, height, _read_lens(table, place), pose)


def _read_lens(table: dict[str, Any], place: str) -> Lens:
    model, distortion = (get_entry(table, key, place) for key in ("camera_model", "distortion_model"))
    if model != "pinhole" or distortion not in DISTORTION_COEFFICIENTS:
        raise DatasetError(
            f"{place}: the lens model {shorten(model)} with {shorten(distortion)} is not supported.",
            why=f"supported are pinhole with {', '.join(DISTORTION_COEFFICIENTS)}",
            fix="calibrate again with --models pinhole-radtan or pinhole-equi",
        )
    linear = read_numbers(get_entry(table, "intrinsics", place), (4,), f"{place}: intrinsics")
    given = get_entry(table, "distortion_coeffs", place) if DISTORTION_COEFFICIENTS[distortion] else []
    coefficients = read_numbers(given, (DISTORTION_COEFFICIENTS[distortion],), f"{place}: distortion_coeffs")
    return lens_from_numbers(linear.tolist(), coefficients.tolist(), distortion == "equidistant", place)


def _read_poses(entries: list[tuple[dict[str, Any], str]]) -> tuple[list[Pose], tuple[str, ...]]:
    """Where the cameras are, `camera_from_world`; and the note that the world is the first camera's."""
    chain = [Pose(np.eye(3), np.zeros(3))]
    for table, place in entries[1:]:
        step = pose_from_matrix(get_entry(table, "T_cn_cnm1", place), f"{place}: T_cn_cnm1")
        chain.append(step @ chain[-1])
    if not all("T_cam_world" in table for table, _ in entries):
        return chain, ("The world is the frame of the first camera: Kalibr knows no other.",)
    world = [pose_from_matrix(t["T_cam_world"], f"{place}: T_cam_world") for t, place in entries]
    size = max(float(np.linalg.norm(pose.centre - world[0].centre)) for pose in world) or 1.0
    for (a, b), (c, d), (_, place) in zip(pairwise(chain), pairwise(world), entries[1:], strict=True):
        if _pose_difference(b @ a.inverse(), d @ c.inverse(), size) > MAX_POSE_DIFFERENCE:
            raise DatasetError(
                f"{place}: T_cn_cnm1 and T_cam_world do not agree.",
                why="one of them was changed after the file was written",
                fix="remove T_cam_world from every camera: the world is then the first camera's frame",
            )
    return world, ()


def _pose_difference(a: Pose, b: Pose, size: float) -> float:
    turn: Floats = np.abs(a.rotation - b.rotation)
    return max(float(turn.max()), float(np.abs(a.translation - b.translation).max()) / size)
