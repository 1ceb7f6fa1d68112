"""`colmap`: a sparse model of COLMAP: a folder with cameras.txt, images.txt and an empty points3D.txt; read also .bin.

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
from implicam.dataset.units import UNKNOWN_UNIT
from implicam.errors import DatasetError, did_you_mean
from implicam.exchange.checks import MAX_CAMERAS, lens_from_numbers, read_numbers, shorten
from implicam.exchange.colmap_files import MODEL_NUMBERS, CameraEntry, Model, read_model
from implicam.exchange.model import Rig
from implicam.exchange.other_lenses import (
    OtherLens,
    division_lens,
    extended_unified_lens,
    field_of_view_lens,
    thin_prism_fisheye_lens,
)
from implicam.exchange.refits import make_camera
from implicam.exchange.source import Source
from implicam.files import refuse_other_files, replacing_folder
from implicam.geometry import Pose
from implicam.images import ENDINGS
from implicam.lenses import KannalaBrandt, Lens

CAMERAS_FILE, IMAGES_FILE, POINTS_FILE = "cameras.txt", "images.txt", "points3D.txt"
SAME_POSE = 1e-6  # of a rotation's entries, and as a part of the shift: a rig that did not move
CENTRE_OFFSET_PX = 0.5  # COLMAP's u and v of the centre of the top-left pixel

_UNIT_COMMENT = "# implicam: the length unit is "

# How parameters become fx, fy, cx, cy and a lens of them.
Make = Callable[[list[float], list[float], str], Lens | OtherLens]


def _perspective(linear: list[float], rest: list[float], place: str) -> Lens | OtherLens:
    """OpenCV's coefficients, of which one alone or two are k1, k2."""
    return lens_from_numbers(linear, rest + [0.0] * (4 - len(rest)), False, place)


def _fisheye(linear: list[float], rest: list[float], place: str) -> Lens | OtherLens:
    return lens_from_numbers(linear, rest + [0.0] * (4 - len(rest)), True, place)


MODELS: dict[str, tuple[int, Make]] = {
    "SIMPLE_PINHOLE": (1, _perspective),
    "PINHOLE": (2, _perspective),
    "SIMPLE_RADIAL": (1, _perspective),
    "RADIAL": (1, _perspective),
    "OPENCV": (2, _perspective),
    "FULL_OPENCV": (2, _perspective),
    "SIMPLE_FISHEYE": (1, _fisheye),
    "FISHEYE": (2, _fisheye),
    "SIMPLE_RADIAL_FISHEYE": (1, _fisheye),
    "RADIAL_FISHEYE": (1, _fisheye),
    "OPENCV_FISHEYE": (2, _fisheye),
    "FOV": (2, lambda linear, rest, _: field_of_view_lens(rest[0], linear)),
    "EUCM": (2, lambda linear, rest, _: extended_unified_lens(rest[0], rest[1], linear)),
    "THIN_PRISM_FISHEYE": (2, lambda linear, rest, _: thin_prism_fisheye_lens(linear, rest)),
    "SIMPLE_DIVISION": (1, lambda linear, rest, _: division_lens(rest[0], linear)),
    "DIVISION": (2, lambda linear, rest, _: division_lens(rest[0], linear)),
}
"""The models read: how many focal lengths come first, and the lens of the parameters after cx, cy. Written are OPENCV,
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
    refuse_other_files(path, {CAMERAS_FILE, IMAGES_FILE, POINTS_FILE}.__contains__, "a COLMAP text model")
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
    """Whether it is a folder of a model, or a file of one.

    Args:
        source: What is given.
    """
    return bool(
        {f"{name}{ending}" for name in ("cameras", "images") for ending in (".txt", ".bin")} & source.file_names
    )


def read(path: Path) -> Rig:
    """Read a model, text or binary.

    Each image becomes a camera, named after it; of a model with a rig each of its sensors, at the place it has in the
    rig, which is the world where the rig moved.

    Args:
        path: The folder, or one of its files.

    Raises:
        DatasetError: It is no such folder, or a file has a mistake; the error names the line or the byte.
    """
    path = path.parent if path.is_file() else path
    model = read_model(path)
    views, notes = _rig_views(model)
    if not views:
        views, notes = [(image.name, image.camera, image.pose) for image in model.images], []
    if len(views) > MAX_CAMERAS:
        raise DatasetError(
            f"{path}: it has {len(views)} images.",
            why=f"each image is a camera of the rig, and a rig has at most {MAX_CAMERAS}",
            fix="keep one image of each camera",
        )
    cameras = []
    for name, (image, key, pose) in zip(_camera_names([view[0] for view in views]), views, strict=True):
        if key not in model.cameras:
            raise DatasetError(
                f"{path}: image {image!r} wants camera {key!r}, which the file of cameras does not have.",
                fix="export both files together",
            )
        entry = model.cameras[key]
        camera, cost = make_camera(name, entry.size, _lens_of(entry), pose, str(path))
        cameras.append(camera)
        notes += cost
    unit = re.search(f"^{_UNIT_COMMENT}(.{{1,40}})$", model.comment, re.MULTILINE)
    with naming(path):
        return Rig(tuple(cameras), unit[1].strip() if unit else UNKNOWN_UNIT, tuple(notes))


def _rig_views(model: Model) -> tuple[list[tuple[str, str, Pose]], list[str]]:
    """For each sensor of the rigs the name of one of its images, its camera and its place; and what to know of them.

    None where each camera is a rig of its own, as in models without rigs. Places are those of rigs and frames, not of
    images: COLMAP 4.2.0 writes images that do not agree with them (colmap/colmap issue 4752).
    """
    rigs = [rig for rig in model.rigs if len(rig.sensors) > 1 and None not in rig.sensors.values()]
    if not rigs or len(rigs) < len(model.rigs):
        return [], []
    views, moved = [], False
    for rig in rigs:
        frames = [frame.pose for frame in model.frames if frame.rig == rig.key]
        world = frames[0] if frames else Pose(np.eye(3), np.zeros(3))
        if any(not _is_same(world, frame) for frame in frames):
            world, moved = Pose(np.eye(3), np.zeros(3)), True
        names = {image.camera: image.name for image in reversed(model.images)}
        views += [(names.get(k, f"camera{k}"), k, p @ world) for k, p in rig.sensors.items() if p is not None]
    if moved and len(rigs) > 1:
        return [], []
    return views, ["The rig moved: the world is its own frame, that of its first sensor."] if moved else []


def _is_same(a: Pose, b: Pose) -> bool:
    near = np.abs(a.translation - b.translation).max() <= SAME_POSE * (np.abs(a.translation).max() or 1.0)
    return bool(near and np.abs(a.rotation - b.rotation).max() <= SAME_POSE)


def _lens_of(entry: CameraEntry) -> Lens | OtherLens:
    if entry.model not in MODELS:
        raise DatasetError(
            f"{entry.place}: the lens model {shorten(entry.model)} is not supported"
            f"{did_you_mean(entry.model, MODELS)}.",
            why=f"supported are {', '.join(MODELS)}",
            fix="reconstruct with --ImageReader.camera_model OPENCV or OPENCV_FISHEYE",
        )
    focals, make = MODELS[entry.model]
    count = MODEL_NUMBERS[entry.model][1]
    params = read_numbers(entry.params, (count,), f"{entry.place}: PARAMS of {entry.model}").tolist()
    f, (cx, cy), rest = params[:focals], params[focals : focals + 2], params[focals + 2 :]
    return make([f[0], f[-1], cx - CENTRE_OFFSET_PX, cy - CENTRE_OFFSET_PX], rest, entry.place)


def _camera_names(images: list[str]) -> list[str]:
    """Names for cameras: the folders of the images where each has its own, else the whole paths, without endings."""
    paths = [PurePosixPath(image.replace("\\", "/")) for image in images]
    folders = [path.parts[0] if len(path.parts) > 1 else "" for path in paths]
    if all(folders) and len(set(folders)) == len(folders):
        return folders
    names = [str(path.with_suffix("")) if path.suffix.lower() in ENDINGS else str(path) for path in paths]
    return [name.strip("/").replace("/", "_") for name in names]
