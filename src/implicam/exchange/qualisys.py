"""`qualisys`: the calibration that QTM (Qualisys) exports, NAME.qca.txt, which is XML.

    cameras/camera    serial, model, active, calibrated, viewrotation, video_resolution: "1080p" is a number of rows
      fov_video       left, top, right, bottom: what of the sensor the pictures show
      transform       x, y, z: the camera's centre, mm; r11 ... r33: from the world to a camera frame with y up, z back
      intrinsic       focalLengthU, focalLengthV, centerPointU, centerPointV, in 1/64 pixel; sensorMaxU, sensorMaxV;
                      radialDistortion1 to 3, tangentalDistortion1 and 2: OpenCV's k1, k2, k3, p1, p2, not scaled

Where in a pixel its coordinates begin is not documented: they are taken as Pose2Sim does, 64 a pixel, from the centre
of the first one. Pose2Sim divides the distortion by 64 as well, which real files contradict.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import astuple
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from implicam.dataset.tables import naming
from implicam.errors import DatasetError
from implicam.exchange.checks import MAX_CAMERAS, get_entry, lens_from_matrix, list_names, read_numbers, rotation_matrix
from implicam.exchange.fits import nearest_brown_conrady
from implicam.exchange.model import ExplicitCamera, Rig
from implicam.exchange.refits import make_camera
from implicam.exchange.source import Source, read_xml
from implicam.files import write_text
from implicam.geometry import Pose

UNITS_PER_PIXEL = 64.0
HALF_PIXEL = "Qualisys does not say where in a pixel its coordinates begin: half a pixel is not known."
MAX_RELATIVE_ROWS = 0.02
"""How far "1080p" may be from the rows of the sensor; a sensor of 1088 has it."""
_ROWS = re.compile(r"(\d{2,5})p", re.IGNORECASE)
FROM_Y_UP = np.diag([1.0, -1.0, -1.0])

INTRINSICS = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV", "skew")
DISTORTION = (
    "radialDistortion1",
    "radialDistortion2",
    "tangentalDistortion1",
    "tangentalDistortion2",
    "radialDistortion3",
)
ROTATION = tuple(f"r{row}{column}" for row in "123" for column in "123")


def write(rig: Rig, path: Path) -> list[str]:
    """Write the file, in millimetres; names are written as serial numbers.

    Args:
        rig: The cameras, all with image sizes, in a known unit.
        path: The file.

    Returns:
        Notes on the unit, on half a pixel, and on what refitting a lens cost in pixels.

    Raises:
        DatasetError: The unit or an image size is not known, or a fisheye is too wide.
        ImplicamError: The file cannot be written.
    """
    root = Element("calibration", source="implicam", type="regular")
    cameras, notes = SubElement(root, "cameras"), [HALF_PIXEL]
    for camera in rig.in_unit("mm").cameras:
        lens, lost = nearest_brown_conrady(camera, "Qualisys")
        notes += lost
        width, height = camera.size
        element = SubElement(cameras, "camera", active="1", serial=camera.name, model="implicam", viewrotation="0")
        SubElement(element, "fov_video", left="0", top="0", right=str(width - 1), bottom=str(height - 1))
        pose = camera.camera_from_world
        turn = dict(zip(ROTATION, (FROM_Y_UP @ pose.rotation).ravel(), strict=True))
        SubElement(element, "transform", _texts({**dict(zip("xyz", pose.centre, strict=True)), **turn}))
        linear = [UNITS_PER_PIXEL * value for value in (lens.fx, lens.fy, lens.cx, lens.cy, 0.0)]
        ends = {"sensorMinU": 0, "sensorMinV": 0, "sensorMaxU": 64 * width - 1, "sensorMaxV": 64 * height - 1}
        distortion = dict(zip(DISTORTION, astuple(lens)[4:], strict=True))
        SubElement(element, "intrinsic", _texts({**dict(zip(INTRINSICS, linear, strict=True)), **ends, **distortion}))
    indent(root)
    write_text(path, '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n")
    return notes if rig.length_unit == "mm" else [*notes, f"Lengths are in mm; the rig's unit was {rig.length_unit}."]


def _texts(numbers: dict[str, float]) -> dict[str, str]:
    return {key: repr(value if isinstance(value, int) else float(value)) for key, value in numbers.items()}


def knows(source: Source) -> bool:
    """Whether it is XML of a calibration with cameras.

    Args:
        source: What is given.
    """
    return source.keys[:1] == ("calibration",) and "cameras" in source.keys


def read(path: Path) -> Rig:
    """Read the cameras that are active and calibrated, named by their serial numbers.

    Args:
        path: The .qca.txt file.

    Returns:
        The cameras, in millimetres.

    Raises:
        DatasetError: The file has a mistake; the error names the camera and the value.
    """
    elements = read_xml(path).findall("cameras/camera")
    left_out = {element: reason for element in elements for mark, reason in _UNUSABLE if _is_off(element, mark)}
    usable = [element for element in elements if element not in left_out]
    if not 0 < len(usable) <= MAX_CAMERAS:
        raise DatasetError(
            f"{path}: {len(usable)} of {len(elements)} cameras are active and calibrated.",
            fix="calibrate in QTM, and export the calibration again",
        )
    cameras, notes = [], [HALF_PIXEL]
    for i, element in enumerate(usable):
        camera, said = _read_camera(element, f"{path}: camera {element.get('serial', i)}")
        cameras.append(camera)
        notes += said
    for _, reason in _UNUSABLE:
        names = [element.get("serial", "?") for element, why in left_out.items() if why == reason]
        notes += [f"Left out, because they are {reason}: {list_names(names)}."] if names else []
    notes += _describe_sizes(zip(usable, cameras, strict=True))
    with naming(str(path)):
        return Rig(tuple(cameras), "mm", tuple(notes))


_UNUSABLE = (("active", "not active"), ("calibrated", "not calibrated"))
"""Attributes that say that the numbers of a camera are of no use, and what a note says then; the last that holds."""


def _is_off(element: Element, mark: str) -> bool:
    return element.get(mark, "1").strip().lower() in ("0", "false", "no")


def _describe_sizes(read: Iterable[tuple[Element, ExplicitCamera]]) -> list[str]:
    """Cameras whose videos have another number of rows than the view that the lens belongs to."""
    found: dict[tuple[str, str], list[str]] = {}
    for element, camera in read:
        stated = element.get("video_resolution", "")
        rows = _ROWS.fullmatch(stated.strip())
        view, sensor = min(camera.size), min(_sensor_size(element))  # a camera on its side has them as columns
        if rows and all(abs(int(rows[1]) - has) > MAX_RELATIVE_ROWS * has for has in (view, sensor)):
            found.setdefault((stated, " x ".join(map(str, camera.size))), []).append(camera.name)
    return [
        f"QTM states video_resolution {stated!r} for {list_names(names)}, and a view of {size} pixels: the lens is "
        f"that of {size}. Videos of another size must be enlarged to it before points are found in them."
        for (stated, size), names in found.items()
    ]


def _sensor_size(element: Element) -> list[float]:
    intrinsic = _child(element, "intrinsic", "intrinsic")
    return [(end + 1) // UNITS_PER_PIXEL for end in _numbers(intrinsic, ("sensorMaxU", "sensorMaxV"), "intrinsic")]


def _read_camera(element: Element, place: str) -> tuple[ExplicitCamera, list[str]]:
    name = str(get_entry(element.attrib, "serial", place))
    values, at, window = (_child(element, tag, place) for tag in ("intrinsic", "transform", "fov_video"))
    left, top, right, bottom = _numbers(window, ("left", "top", "right", "bottom"), f"{place}: fov_video")
    ends = _numbers(values, ("sensorMaxU", "sensorMaxV"), f"{place}: intrinsic")
    # some versions give the last pixel, some the one after it
    last = [int(far < (end + 1) // UNITS_PER_PIXEL) for far, end in zip((right, bottom), ends, strict=True)]
    size = int(right - left + last[0]), int(bottom - top + last[1])
    fx, fy, cx, cy, skew = (value / UNITS_PER_PIXEL for value in _numbers(values, INTRINSICS, f"{place}: intrinsic"))
    k = np.array([[fx, skew, cx - left], [0, fy, cy - top], [0, 0, 1.0]])
    lens = lens_from_matrix(k, _numbers(values, DISTORTION, f"{place}: intrinsic"), fisheye=False, place=place)
    given = np.array(_numbers(at, ROTATION, f"{place}: transform")).reshape(3, 3)
    turn = FROM_Y_UP @ rotation_matrix(given, f"{place}: r11 ... r33")
    centre = np.array(_numbers(at, ("x", "y", "z"), f"{place}: transform"))
    camera, notes = make_camera(name, size, lens, Pose(turn, -turn @ centre), place)
    if element.get("viewrotation", "0") not in ("0", "none"):
        notes.append(
            f"Camera {name!r}: QTM turns its view by {element.get('viewrotation')} degrees; the lens is that of the "
            "picture as the sensor has it."
        )
    return camera, notes


def _child(element: Element, tag: str, place: str) -> Element:
    found = element.find(tag)
    if found is None:
        raise DatasetError(
            f"{place}: {tag} is missing.",
            why=f"it has {list_names([child.tag for child in element]) or 'nothing'}",
            fix="export the calibration of video cameras again",
        )
    return found


def _numbers(element: Element, keys: tuple[str, ...], place: str) -> list[float]:
    given = [element.get(key, "0") if key == "skew" else get_entry(element.attrib, key, place) for key in keys]
    return [float(read_numbers(value, (), f"{place}: {key}")) for key, value in zip(keys, given, strict=True)]
