"""`kalibr`: the camchain.yaml of Kalibr.

    cam0, cam1, ...
      camera_model: pinhole, intrinsics: [fu, fv, pu, pv]
      distortion_model: radtan (k1, k2, p1, p2), equidistant (k1 ... k4) or none; distortion_coeffs
      resolution: [width, height]
      T_cn_cnm1: 4 x 4, from the camera before to this one; not of cam0
      T_cam_imu, or its inverse T_imu_cam: 4 x 4, from an IMU; read where there is no T_cn_cnm1
      rostopic: where Kalibr finds the pictures

In metres, with pixels as in OpenCV. Read are also the models of `MODELS` that no lens here has, by a refit, and files
that begin with OpenCV's %YAML:1.0. Kalibr has no world and no names: a further key T_cam_world says where each camera
is, and camera_name what it is called; Kalibr leaves keys that it does not know alone.
"""

from __future__ import annotations

import json
import re
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
    list_names,
    pose_from_matrix,
    read_image_size,
    read_numbers,
    shorten,
)
from implicam.exchange.fits import fit_four_coefficients
from implicam.exchange.model import ExplicitCamera, Rig
from implicam.exchange.other_lenses import (
    OtherLens,
    double_sphere_lens,
    extended_unified_lens,
    field_of_view_lens,
    omnidirectional_lens,
)
from implicam.exchange.refits import make_camera
from implicam.exchange.source import Source, read_yaml
from implicam.files import write_text
from implicam.geometry import Pose
from implicam.lenses import Floats, KannalaBrandt, Lens

MAX_POSE_DIFFERENCE = 1e-5
"""How far T_cn_cnm1 and T_cam_world may be apart, as a part of the rig's size."""

MAX_IMU_DIFFERENCE = 1e-3
"""The same of T_cn_cnm1 and the poses against an IMU, which people round by hand."""

MODELS = {
    ("pinhole", "radtan"): (0, 4),
    ("pinhole", "equidistant"): (0, 4),
    ("pinhole", "fov"): (0, 1),
    ("pinhole", "none"): (0, 0),
    ("omni", "radtan"): (1, 4),
    ("omni", "none"): (1, 0),
    ("eucm", "none"): (2, 0),
    ("ds", "none"): (2, 0),
}
"""The models read: how many parameters come before fu, fv, pu, pv, and how many are in distortion_coeffs."""

DISTORTION_ALIASES = {"equi": "equidistant", "plumb_bob": "radtan"}


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


def knows(source: Source) -> bool:
    """Whether a file is a chain: it has a camera cam0.

    Args:
        source: What is given.
    """
    return "cam0" in source.keys


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
    found = sorted((key for key in table if re.fullmatch(r"cam\d{1,4}", key)), key=lambda key: int(key[3:]))
    if not found or found != [f"cam{i}" for i in range(len(found))]:
        raise DatasetError(
            f"{path}: the cameras must be cam0, cam1, ...; found {list_names(list(table)) or 'none'}.",
            fix="give the camchain.yaml that kalibr_calibrate_cameras wrote",
        )
    entries = [(as_table(table[name], f"{path}: {name}"), f"{path}: {name}") for name in found]
    poses, notes = _read_poses(entries)
    cameras = []
    for (entry, place), pose in zip(entries, poses, strict=True):
        camera, cost = _read_camera(entry, pose, place)
        cameras.append(camera)
        notes += cost
    others = [key for key in table if key not in found]
    notes += [f"Left out: {list_names(others)}, which are no cameras."] if others else []
    with naming(str(path)):
        return Rig(tuple(cameras), "m", tuple(notes))


def _read_camera(table: dict[str, Any], pose: Pose, place: str) -> tuple[ExplicitCamera, list[str]]:
    key = place.rpartition(": ")[2]
    name = check_text(table.get("camera_name", key), f"{place}: camera_name")
    size = read_image_size(get_entry(table, "resolution", place), f"{place}: resolution")
    return make_camera(name, size, _read_lens(table, place), pose, place)


def _read_lens(table: dict[str, Any], place: str) -> Lens | OtherLens:
    model, distortion = (get_entry(table, key, place) for key in ("camera_model", "distortion_model"))
    distortion = DISTORTION_ALIASES.get(distortion, distortion) if isinstance(distortion, str) else distortion
    if (model, distortion) not in MODELS:
        raise DatasetError(
            f"{place}: the lens model {shorten(model)} with {shorten(distortion)} is not supported.",
            why=f"supported are {', '.join(f'{one} with {other}' for one, other in MODELS)}",
            fix="calibrate again with --models pinhole-radtan or pinhole-equi",
        )
    own, count = MODELS[model, distortion]
    numbers = read_numbers(get_entry(table, "intrinsics", place), (own + 4,), f"{place}: intrinsics").tolist()
    given = get_entry(table, "distortion_coeffs", place) if count else []
    coefficients = read_numbers(given, (count,), f"{place}: distortion_coeffs").tolist()
    linear = numbers[own:]
    if model == "omni":
        return omnidirectional_lens(numbers[0], linear, coefficients or [0.0] * 4)
    if model == "eucm":
        return extended_unified_lens(numbers[0], numbers[1], linear)
    if model == "ds":
        return double_sphere_lens(numbers[0], numbers[1], linear)
    if distortion == "fov":
        return field_of_view_lens(coefficients[0], linear)
    return lens_from_numbers(linear, coefficients, distortion == "equidistant", place)


def _read_poses(entries: list[tuple[dict[str, Any], str]]) -> tuple[list[Pose], list[str]]:
    """Where the cameras are, `camera_from_world`; and what to know of them."""
    chain, by_imu, notes = _chain(entries), _by_imu(entries), []
    if chain is None:
        if by_imu is None:
            table, place = next((t, place) for t, place in entries[1:] if "T_cn_cnm1" not in t)
            get_entry(table, "T_cn_cnm1", place)
        assert by_imu is not None
        chain = [pose @ by_imu[0].inverse() for pose in by_imu]
        notes.append("The places are those against the IMU (T_cam_imu or T_imu_cam): no camera has T_cn_cnm1.")
    elif by_imu is not None and len(entries) > 1:
        apart = _largest_difference(chain, by_imu)
        if apart > MAX_IMU_DIFFERENCE:
            notes.append(
                f"T_cn_cnm1 and the poses against the IMU differ by {apart:.2g} of the rig's size; T_cn_cnm1 is used."
            )
    if not all("T_cam_world" in table for table, _ in entries):
        return chain, ["The world is the frame of the first camera: Kalibr knows no other.", *notes]
    world = [pose_from_matrix(t["T_cam_world"], f"{place}: T_cam_world") for t, place in entries]
    for i, (_, place) in enumerate(entries[1:], 1):
        if _largest_difference(chain[i - 1 : i + 1], world[i - 1 : i + 1], _rig_size(world)) > MAX_POSE_DIFFERENCE:
            raise DatasetError(
                f"{place}: T_cn_cnm1 and T_cam_world do not agree.",
                why="one of them was changed after the file was written",
                fix="remove T_cam_world from every camera: the world is then the first camera's frame",
            )
    return world, notes


def _chain(entries: list[tuple[dict[str, Any], str]]) -> list[Pose] | None:
    """The poses by T_cn_cnm1, from the first camera on; None where a camera has none."""
    if not all("T_cn_cnm1" in table for table, _ in entries[1:]):
        return None
    chain = [Pose(np.eye(3), np.zeros(3))]
    for table, place in entries[1:]:
        chain.append(pose_from_matrix(table["T_cn_cnm1"], f"{place}: T_cn_cnm1") @ chain[-1])
    return chain


def _by_imu(entries: list[tuple[dict[str, Any], str]]) -> list[Pose] | None:
    """The poses from the IMU's frame, by T_cam_imu or its inverse; None where a camera has neither."""
    poses = []
    for table, place in entries:
        if "T_cam_imu" in table:
            poses.append(pose_from_matrix(table["T_cam_imu"], f"{place}: T_cam_imu"))
        elif "T_imu_cam" in table:
            poses.append(pose_from_matrix(table["T_imu_cam"], f"{place}: T_imu_cam").inverse())
    return poses if len(poses) == len(entries) else None


def _rig_size(poses: list[Pose]) -> float:
    """The largest distance from the first camera; 1 where all are in one place."""
    return max(float(np.linalg.norm(pose.centre - poses[0].centre)) for pose in poses) or 1.0


def _largest_difference(a: list[Pose], b: list[Pose], size: float | None = None) -> float:
    """The largest difference of two chains from one camera to the next, as a part of the rig's size."""
    size = size or _rig_size(b)
    return max(
        _pose_difference(a2 @ a1.inverse(), b2 @ b1.inverse(), size)
        for (a1, a2), (b1, b2) in zip(pairwise(a), pairwise(b), strict=True)
    )


def _pose_difference(a: Pose, b: Pose, size: float) -> float:
    turn: Floats = np.abs(a.rotation - b.rotation)
    return max(float(turn.max()), float(np.abs(a.translation - b.translation).max()) / size)
