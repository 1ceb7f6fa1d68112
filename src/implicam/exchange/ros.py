"""`ros`: sensor_msgs/CameraInfo, as the YAML of camera_calibration_parsers, one file a camera, or as a printed message.

    image_width, image_height, camera_name
    camera_matrix              3 x 3, K
    distortion_model           plumb_bob (k1, k2, p1, p2, k3), rational_polynomial (8), equidistant (k1 ... k4)
    distortion_coefficients
    rectification_matrix       3 x 3, R: x_rectified = R x_camera
    projection_matrix          3 x 4, P: the pixels of the rectified image; P[0, 3] = f b, P[1, 3]

A file knows no place. Of a rectified pair the places follow all the same: all cameras share the rectified frame up to a
shift of (P[0, 3] / P[0, 0], P[1, 3] / P[1, 1], 0), in metres. The world is the first camera's frame.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset.tables import naming
from implicam.dataset.units import UNKNOWN_UNIT
from implicam.errors import DatasetError
from implicam.exchange.checks import check_text, get_entry, lens_from_matrix, rotation_matrix, shorten
from implicam.exchange.folders import write_folder
from implicam.exchange.model import ExplicitCamera, Rig
from implicam.exchange.other_lenses import OtherLens
from implicam.exchange.refits import make_camera
from implicam.exchange.source import Source, read_yaml
from implicam.exchange.storage import read_matrix, read_size
from implicam.geometry import Pose
from implicam.lenses import Floats, KannalaBrandt, Lens

MODELS = {
    "plumb_bob": False,
    "rational_polynomial": False,
    "equidistant": True,
    "fisheye": True,
    "thin_prism": False,
    "": False,
}
"""The models read, and whether each is OpenCV's fisheye; plumb_bob has any count of OpenCV's coefficients."""

SAME_PLACE = 1e-12
"""Two cameras nearer, as a part of the largest distance, are in one place: the file did not say where."""


def write(rig: Rig, path: Path) -> list[str]:
    """Write a folder with NAME.yaml for each camera; of two cameras with the rectification that holds their places.

    Args:
        rig: The cameras, all with image sizes; of two in a known unit.
        path: The folder.

    Returns:
        What is lost: places, but for two cameras, and the world.

    Raises:
        DatasetError: The folder holds something else, or an image size or the unit is not known.
        ImplicamError: The folder cannot be written.
    """
    pair = len(rig.cameras) == 2
    rectified = _rectify(*rig.in_unit("m").cameras) if pair else [_unrectified(camera) for camera in rig.cameras]
    texts = {f"{c.name}.yaml": _camera_text(c, *views) for c, views in zip(rig.cameras, rectified, strict=True)}
    write_folder(path, texts, "camera_info files")
    if pair:
        return ["The places of the two cameras are in R and P, in metres; the world is lost: it is the first camera's."]
    return ["camera_info holds no places, only those of a rectified pair: they are lost."]


def _unrectified(camera: ExplicitCamera) -> tuple[Floats, Floats]:
    return np.eye(3), np.column_stack([_camera_matrix(camera), np.zeros(3)])


def _camera_matrix(camera: ExplicitCamera) -> Floats:
    lens = camera.lens
    return np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])


def _rectify(one: ExplicitCamera, two: ExplicitCamera) -> list[tuple[Floats, Floats]]:
    """R and P of both cameras: the mean of their axes, turned so that the line between them is u, or v where they stand
    one above the other."""
    poses = [one.camera_from_world, two.camera_from_world]
    baseline = poses[1].centre - poses[0].centre
    length = float(np.linalg.norm(baseline))
    if length == 0:
        raise DatasetError("both cameras stand in one place.", fix="export to opencv instead")
    across = np.mean([pose.rotation @ baseline / length for pose in poses], axis=0)
    vertical = int(abs(across[1]) > abs(across[0]))
    along = baseline / length * np.sign(across[vertical] or 1.0)
    forward = np.sum([pose.rotation[2] for pose in poses], axis=0)
    forward = forward - along * (forward @ along)
    if np.linalg.norm(forward) < 1e-3:
        raise DatasetError(
            "the two cameras look along the line between them.",
            why="such a pair has no rectification, which is what camera_info keeps places in",
            fix="export to opencv instead",
        )
    forward = forward / np.linalg.norm(forward)
    other = np.cross(forward, along) if not vertical else np.cross(along, forward)
    axes = np.stack([other, along, forward] if vertical else [along, other, forward])
    focal, centre = one.lens.fx, np.array([(one.size[0] - 1) / 2, (one.size[1] - 1) / 2])
    found = []
    for pose in poses:
        shift = -focal * float((pose.centre - poses[0].centre) @ along)
        p = np.array([[focal, 0, centre[0], 0], [0, focal, centre[1], 0], [0, 0, 1, 0.0]])
        p[vertical, 3] = shift
        found.append((axes @ pose.rotation.T, p))
    return found


def _camera_text(camera: ExplicitCamera, r: Floats, p: Floats) -> str:
    lens = camera.lens
    fisheye = isinstance(lens, KannalaBrandt)
    lines = [
        f"image_width: {camera.size[0]}",
        f"image_height: {camera.size[1]}",
        f"camera_name: {json.dumps(camera.name, ensure_ascii=False)}",
        *_matrix_lines("camera_matrix", _camera_matrix(camera)),
        f"distortion_model: {'equidistant' if fisheye else 'plumb_bob'}",
        *_matrix_lines("distortion_coefficients", np.array(astuple(lens)[4:])[None]),
        *_matrix_lines("rectification_matrix", r),
        *_matrix_lines("projection_matrix", p),
    ]
    return "".join(f"{line}\n" for line in lines)


def _matrix_lines(name: str, values: Floats) -> list[str]:
    data = ", ".join(repr(float(x)) for x in values.ravel())
    return [f"{name}:", f"  rows: {values.shape[0]}", f"  cols: {values.shape[1]}", f"  data: [{data}]"]


def knows(source: Source) -> bool:
    """Whether a file has a distortion model beside its camera matrix; or the first file of a folder.

    Args:
        source: What is given.
    """
    files = _files_in(source.path) if source.path.is_dir() else []
    keys = set((Source((files[0],)) if files else source).keys)
    return "distortion_model" in keys and bool({"camera_matrix", "K", "k"} & keys)


@dataclass(frozen=True)
class _Info:
    """What a file says. rectified: R (3, 3), and where the rectified frame's origin is in it, metres."""

    name: str
    size: tuple[int, int] | None
    lens: Lens | OtherLens
    rectified: Pose
    place: str
    notes: list[str]


def read(paths: Sequence[Path]) -> Rig:
    """Read one camera, or a rectified pair.

    Args:
        paths: A file for each camera, or a folder of them.

    Returns:
        The cameras, in metres; of one camera the unit is not known.

    Raises:
        DatasetError: A file has a mistake; or there are several cameras, and no file says where they stand.
    """
    files = [file for path in paths for file in (_files_in(path) if path.is_dir() else [path])]
    if not files:
        raise DatasetError(f"{paths[0]}: there is no .yaml file.", fix="give the camera_info files, one a camera")
    infos = _distinct([_read_info(read_yaml(file), file) for file in files])
    first = infos[0].rectified
    own = Pose(np.eye(3), np.zeros(3))
    poses = [own, *(info.rectified.inverse() @ first for info in infos[1:])]
    notes = [note for info in infos for note in info.notes]
    centres = np.array([pose.centre for pose in poses])
    for i, centre in enumerate(centres[1:], 1):
        near = np.linalg.norm(centres[:i] - centre, axis=1) <= SAME_PLACE * (np.abs(centres).max() or 1.0)
        if near.any():
            raise DatasetError(
                f"{infos[i].place} does not say where the camera stands.",
                why=f"its projection matrix puts it in the place of {shorten(infos[int(np.argmax(near))].name)}, as of "
                "cameras that were calibrated one by one: camera_info holds the places of a rectified pair only",
                fix="give files of a stereo calibration; or import one camera, or calibrate the places: "
                "implicam calibrate --method explicit",
            )
    read = [make_camera(i.name, i.size, i.lens, pose, i.place) for i, pose in zip(infos, poses, strict=True)]
    notes += [note for _, said in read for note in said]
    alone = len(infos) == 1
    world = "The file has no pose: the world is the camera's own frame."
    notes.insert(0, world if alone else "The world is the first camera's frame; places are those of R and P.")
    with naming(str(paths[0])):
        return Rig(tuple(camera for camera, _ in read), UNKNOWN_UNIT if alone else "m", tuple(notes))


def _files_in(folder: Path) -> list[Path]:
    return sorted([*folder.glob("*.yaml"), *folder.glob("*.yml")])


def _distinct(infos: list[_Info]) -> list[_Info]:
    """The cameras with names of their own: those of the files where camera_name is the same."""
    if len({info.name for info in infos}) == len(infos):
        return infos
    return [replace(info, name=Path(info.place).stem) for info in infos]


def _read_info(table: Mapping[str, Any], path: Path) -> _Info:
    place = str(path)
    message = "camera_matrix" not in table
    key = {name: name for name in ("K", "D", "R", "P")}
    if message:  # ROS 2 has small letters
        key = {name: name if name in table else name.lower() for name in key}
    else:
        long = ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix")
        key = dict(zip(key, long, strict=True))
    k = read_matrix(get_entry(table, key["K"], place), f"{place}: {key['K']}", (3, 3))
    given = read_matrix(get_entry(table, key["D"], place), f"{place}: {key['D']}", (-1,)).tolist()
    model = check_text(get_entry(table, "distortion_model", place), f"{place}: distortion_model")
    if model not in MODELS:
        raise DatasetError(
            f"{place}: distortion_model: {shorten(model)} is not supported.",
            why=f"supported are {', '.join(name for name in MODELS if name)}",
            fix="calibrate again with one of them",
        )
    lens = lens_from_matrix(k, given, fisheye=MODELS[model], place=place)
    name = check_text(table.get("camera_name", path.stem), f"{place}: camera_name").strip("/").replace("/", "_")
    return _Info(name, read_size(table, place), lens, _read_rectified(table, key, place), place, _binned(table, name))


def _read_rectified(table: Mapping[str, Any], key: dict[str, str], place: str) -> Pose:
    """Where the rectified frame is, rectified_from_camera, with the shift of the first camera's."""
    r, p = np.eye(3), np.zeros((3, 4))
    if key["R"] in table:
        given = read_matrix(table[key["R"]], f"{place}: {key['R']}", (3, 3))
        r = rotation_matrix(given, f"{place}: {key['R']}") if given.any() else r  # zeros: not rectified
    if key["P"] in table:
        p = read_matrix(table[key["P"]], f"{place}: {key['P']}", (3, 4))
    if not p[:, 3].any():
        return Pose(r, np.zeros(3))
    if not (p[0, 0] > 0 and p[1, 1] > 0):
        raise DatasetError(f"{place}: {key['P']} has no focal lengths.", fix="correct the values")
    # P puts a point of the first camera's rectified frame at f (x + t): this camera's frame is shifted by -t
    return Pose(r, -np.array([p[0, 3] / p[0, 0], p[1, 3] / p[1, 1], 0.0]))


def _binned(table: Mapping[str, Any], name: str) -> list[str]:
    """A note where a message is of pictures that are binned or cut out."""
    binning = [str(table.get(key, 0)) for key in ("binning_x", "binning_y")]
    roi = table.get("roi", {})
    offsets = [str(roi.get(key, 0)) for key in ("x_offset", "y_offset")] if isinstance(roi, dict) else []
    if all(value in ("0", "1") for value in binning) and all(value == "0" for value in offsets):
        return []
    return [f"Camera {name!r}: the message is of pictures that are binned or cut out; its lens is that of whole ones."]
