"""`colmap`: a sparse model of COLMAP as text: a folder with cameras.txt, images.txt and an empty points3D.txt.

COLMAP puts (0, 0) at the *corner* of the top-left pixel: its cx, cy are ours + 0.5. A pose is camera_from_world, as a
quaternion (w, x, y, z) and a translation. COLMAP has no unit; a comment in cameras.txt keeps ours. Written is one image
a camera, with the camera's name. Models: docs/exchange.md and `MODELS`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from implicam.dataset.tables import naming
from implicam.errors import DatasetError, did_you_mean
from implicam.exchange.checks import MAX_CAMERAS, lens_from_numbers, read_numbers, read_text, shorten
from implicam.exchange.model import UNKNOWN_UNIT, Rig
from implicam.exchange.other_lenses import OtherLens
from implicam.exchange.refits import make_camera
from implicam.exchange.source import Source
from implicam.files import replacing_folder
from implicam.geometry import Pose
from implicam.images import ENDINGS
from implicam.lenses import KannalaBrandt, Lens

CAMERAS_FILE, IMAGES_FILE, POINTS_FILE = "cameras.txt", "images.txt", "points3D.txt"
MAX_BYTES = 1 << 26  # images.txt lists the points of every image
CENTRE_OFFSET_PX = 0.5  # COLMAP's u and v of the centre of the top-left pixel

_UNIT_COMMENT = "# implicam: the length unit is "

# How parameters become (fx, fy, cx, cy) and distortion in OpenCV's order.
Split = Callable[[list[float]], tuple[list[float], list[float]]]


def _split_one_focal(p: list[float]) -> tuple[list[float], list[float]]:
    return [p[0], p[0], p[1], p[2]], p[3:]


def _split_two_focals(p: list[float]) -> tuple[list[float], list[float]]:
    return p[:4], p[4:]


MODELS: dict[str, tuple[int, Split, bool]] = {
    "SIMPLE_PINHOLE": (3, _split_one_focal, False),
    "PINHOLE": (4, _split_two_focals, False),
    "SIMPLE_RADIAL": (4, _split_one_focal, False),
    "RADIAL": (5, _split_one_focal, False),
    "OPENCV": (8, _split_two_focals, False),
    "FULL_OPENCV": (12, _split_two_focals, False),
    "SIMPLE_FISHEYE": (3, _split_one_focal, True),
    "FISHEYE": (4, _split_two_focals, True),
    "SIMPLE_RADIAL_FISHEYE": (4, _split_one_focal, True),
    "RADIAL_FISHEYE": (5, _split_one_focal, True),
    "OPENCV_FISHEYE": (8, _split_two_focals, True),
}
"""The models read: the number of their parameters, their order, and whether it is a fisheye. Written are OPENCV,
FULL_OPENCV and OPENCV_FISHEYE."""


def write(rig: Rig, path: Path) -> list[str]:
    """Write the folder, in the rig's own unit; an earlier model in it is replaced, anything else is not touched.

    Args:
        rig: The cameras, all with image sizes.
        path: The folder.

    Returns:
        Notes on names and units, which COLMAP does not have.

    Raises:
        DatasetError: The folder holds something else, two names become the same, or an image size is not known.
        ImplicamError: The folder cannot be written.
    """
    there = {entry.name for entry in path.iterdir()} if path.is_dir() else set()
    others = there - {CAMERAS_FILE, IMAGES_FILE, POINTS_FILE}
    if others:
        raise DatasetError(
            f"{path} holds {shorten(min(others))}, which is no part of a COLMAP text model.",
            fix="choose a new folder for the model",
        )
    names, notes = _image_names(rig)
    cameras = [f"{_UNIT_COMMENT}{rig.length_unit}", "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS"]
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line for its points (none)"]
    for i, camera in enumerate(rig.cameras, 1):
        cameras.append(_join_values(i, *_lens_model(camera.lens)[:1], *camera.size, *_lens_model(camera.lens)[1]))
        x, y, z, w = Rotation.from_matrix(camera.camera_from_world.rotation).as_quat(canonical=True).tolist()
        images += [_join_values(i, w, x, y, z, *camera.camera_from_world.translation.tolist(), i, names[i - 1]), ""]
    with replacing_folder(path, overwrite=True) as folder:
        for name, lines in ((CAMERAS_FILE, cameras), (IMAGES_FILE, images), (POINTS_FILE, ["# no points"])):
            (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8", newline="")
    return notes


def _join_values(*values: object) -> str:
    return " ".join(repr(v) if isinstance(v, float) else str(v) for v in values)


def _lens_model(lens: Lens) -> tuple[str, list[float]]:
    fx, fy, cx, cy, *distortion = map(float, astuple(lens))
    linear = [fx, fy, cx + CENTRE_OFFSET_PX, cy + CENTRE_OFFSET_PX]
    if isinstance(lens, KannalaBrandt):
        return "OPENCV_FISHEYE", linear + distortion
    if distortion[4] == 0:
        return "OPENCV", linear + distortion[:4]
    return "FULL_OPENCV", linear + distortion + [0.0, 0.0, 0.0]


def _image_names(rig: Rig) -> tuple[list[str], list[str]]:
    """The names without spaces, at which COLMAP ends a name; and what to know."""
    names = ["_".join(camera.name.split()) for camera in rig.cameras]
    if len(set(names)) < len(names):
        raise DatasetError(
            "two cameras would have the same name in COLMAP.",
            why="a space ends a name there, and is written as _",
            fix="rename one of them",
        )
    notes = ["COLMAP knows images, not cameras by name: NAME in images.txt is the camera's; put your file names there."]
    if rig.length_unit != UNKNOWN_UNIT:
        notes.append(f"COLMAP has no unit: lengths are in {rig.length_unit}, which only a comment says.")
    if names != [camera.name for camera in rig.cameras]:
        notes.append("Spaces in camera names became _.")
    return names, notes


def knows(source: Source) -> bool:
    """Whether it is a folder, or a file of such a folder.

    Args:
        source: What is given.
    """
    return bool({CAMERAS_FILE, IMAGES_FILE} & source.file_names)


def read(path: Path) -> Rig:
    """Read a folder with cameras.txt and images.txt; each image becomes a camera, named after it.

    Args:
        path: The folder, or one of its files.

    Raises:
        DatasetError: It is no such folder, or a file has a mistake; the error names the line.
    """
    if path.is_file() and path.name in (CAMERAS_FILE, IMAGES_FILE, POINTS_FILE):
        path = path.parent
    if not (path / CAMERAS_FILE).is_file() or not (path / IMAGES_FILE).is_file():
        raise DatasetError(
            f"{path} is no COLMAP text model.",
            why=f"it must be a folder with {CAMERAS_FILE} and {IMAGES_FILE}",
            fix="colmap model_converter --input_path MODEL --output_path TEXT --output_type TXT",
        )
    text = read_text(path / CAMERAS_FILE, MAX_BYTES)
    lenses = dict(_read_camera(line, f"{path / CAMERAS_FILE}, line {n}") for n, line in _content_lines(text))
    lines = _image_lines(read_text(path / IMAGES_FILE, MAX_BYTES))
    images = [_read_image(line, f"{path / IMAGES_FILE}, line {n}") for n, line in lines]
    if len(images) > MAX_CAMERAS:
        raise DatasetError(
            f"{path / IMAGES_FILE} has {len(images)} images.",
            why=f"each image is a camera of the rig, and a rig has at most {MAX_CAMERAS}",
            fix="keep one image of each camera",
        )
    names, cameras, notes = _camera_names([name for name, _, _ in images]), [], []
    for name, (image, key, pose) in zip(names, images, strict=True):
        if key not in lenses:
            raise DatasetError(
                f"{path / IMAGES_FILE}: image {image!r} wants camera {key!r}, which {CAMERAS_FILE} does not have.",
                fix="export both files together",
            )
        size, lens = lenses[key]
        camera, cost = make_camera(name, size, lens, pose, str(path))
        cameras.append(camera)
        notes += cost
    unit = re.search(f"^{_UNIT_COMMENT}(.{{1,40}})$", text, re.MULTILINE)
    with naming(path):
        return Rig(tuple(cameras), unit[1].strip() if unit else UNKNOWN_UNIT, tuple(notes))


def _content_lines(text: str) -> list[tuple[int, str]]:
    """Lines with their numbers, from 1, that are neither empty nor comments."""
    lines = [(n, line.strip()) for n, line in enumerate(text.splitlines(), 1)]
    return [(n, line) for n, line in lines if line and not line.startswith("#")]


def _image_lines(text: str) -> list[tuple[int, str]]:
    """The first line of each image: the line after it lists points, and may be empty."""
    first, skip = [], False
    for n, line in enumerate(text.splitlines(), 1):
        if skip:
            skip = False
        elif line.strip() and not line.lstrip().startswith("#"):
            first.append((n, line.strip()))
            skip = True
    return first


def _read_camera(line: str, place: str) -> tuple[str, tuple[tuple[int, int], Lens | OtherLens]]:
    parts = line.split()
    if len(parts) < 4 or not (parts[2].isdecimal() and parts[3].isdecimal() and len(parts[2] + parts[3]) < 20):
        raise DatasetError(
            f"{place}: {shorten(line)} is not CAMERA_ID MODEL WIDTH HEIGHT PARAMS.", fix="export it again"
        )
    key, model = parts[:2]
    if model not in MODELS:
        raise DatasetError(
            f"{place}: the lens model {shorten(model)} is not supported{did_you_mean(model, MODELS)}.",
            why=f"supported are {', '.join(MODELS)}",
            fix="reconstruct with --ImageReader.camera_model OPENCV or OPENCV_FISHEYE",
        )
    count, split, fisheye = MODELS[model]
    linear, distortion = split(read_numbers(parts[4:], (count,), f"{place}: PARAMS of {model}").tolist())
    wanted = 4 if fisheye or len(distortion) < 4 else len(distortion)
    distortion += [0.0] * (wanted - len(distortion))
    linear[2:] = [linear[2] - CENTRE_OFFSET_PX, linear[3] - CENTRE_OFFSET_PX]
    return key, ((int(parts[2]), int(parts[3])), lens_from_numbers(linear, distortion, fisheye, place))


def _read_image(line: str, place: str) -> tuple[str, str, Pose]:
    parts = line.split()
    if len(parts) < 10:
        raise DatasetError(
            f"{place}: {shorten(line)} is not IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME.", fix="export it again"
        )
    w, x, y, z, *translation = read_numbers(parts[1:8], (7,), f"{place}: pose").tolist()
    if not abs(np.linalg.norm([w, x, y, z]) - 1) < 1e-3:
        raise DatasetError(f"{place}: the quaternion does not have length 1.", fix="export it again")
    return parts[9], parts[8], Pose(Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(translation))


def _camera_names(images: list[str]) -> list[str]:
    """Names for cameras: the folders of the images where each has its own, else the whole paths, without endings."""
    paths = [PurePosixPath(image.replace("\\", "/")) for image in images]
    folders = [path.parts[0] if len(path.parts) > 1 else "" for path in paths]
    if all(folders) and len(set(folders)) == len(folders):
        return folders
    names = [str(path.with_suffix("")) if path.suffix.lower() in ENDINGS else str(path) for path in paths]
    return [name.strip("/").replace("/", "_") for name in names]
