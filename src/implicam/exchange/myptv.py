"""`myptv`: a file for each camera, as MyPTV saves its Tsai model.

    Tsai model camera
    NAME
    WIDTH HEIGHT
    the centre O, the angles theta, f, xh yh
    E: three rows of five (of newer versions nine) coefficients

A pixel (eta, zeta) looks along  -([eta - WIDTH / 2 - xh, zeta - HEIGHT / 2 - yh, f] + E Z) R,  with R = Rx Ry Rz and
Z the powers eta, zeta, eta², zeta², eta zeta, ... of the pixel as it is. Without E this is a pinhole with one focal
length in pixels. It has no unit. Files of MyPTV's other model, extended Zolof, are polynomials without a lens, and
older ones do not say their image size: both are refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from implicam.dataset.tables import naming
from implicam.dataset.units import UNKNOWN_UNIT
from implicam.errors import DatasetError
from implicam.exchange.angles import angles_from_rotation, rotation_from_angles
from implicam.exchange.checks import check_text, read_image_size, read_numbers, read_text, shorten
from implicam.exchange.fits import MAX_LENS_DIFFERENCE_PX, Cost, image_rays
from implicam.exchange.folders import write_folder
from implicam.exchange.model import ExplicitCamera, Rig, has_distortion
from implicam.exchange.other_lenses import OtherLens
from implicam.exchange.refits import make_camera
from implicam.exchange.source import Source
from implicam.geometry import Pose
from implicam.lenses import Bools, BrownConrady, Floats, Lens

FIRST_LINE, OTHER_FIRST_LINE = "Tsai model camera", "extendedZolof"
LINES = 10
NEWTON_STEPS = 12


def write(rig: Rig, path: Path) -> list[str]:
    """Write a folder with a file for each camera, in the rig's own unit.

    Args:
        rig: The cameras, all with image sizes.
        path: The folder.

    Returns:
        Notes on the unit, and on what replacing a lens by MyPTV's correction cost in pixels.

    Raises:
        DatasetError: The folder holds something else, or a lens bends more than the correction follows.
        ImplicamError: The folder cannot be written.
    """
    texts, notes = {}, [f"MyPTV's files have no unit: lengths are in {rig.length_unit}."]
    names = ["_".join(camera.name.split()) for camera in rig.cameras]
    if len(set(names)) < len(names):
        raise DatasetError("two cameras would have the same name in MyPTV.", fix="rename one of them")
    for name, camera in zip(names, rig.cameras, strict=True):
        e, moved, cost = _fit_correction(camera)
        if cost is not None:
            notes.append(f"Camera {camera.name!r}: MyPTV has a quadratic correction only: {cost}.")
        pose, (width, height) = camera.camera_from_world, camera.size
        angles = angles_from_rotation(pose.rotation)
        shift = [camera.lens.cx - width / 2 - moved[0], camera.lens.cy - height / 2 - moved[1]]
        rows = [pose.centre, angles, [camera.lens.fx], shift, *e]
        lines = [FIRST_LINE, name, f"{width} {height} ", *(" ".join(repr(float(x)) for x in row) + " " for row in rows)]
        texts[name] = "\n".join(lines) + "\n"  # MyPTV cuts the last two characters of a line: a space and its end
    write_folder(path, texts, "MyPTV's cameras")
    return notes


def _fit_correction(camera: ExplicitCamera) -> tuple[Floats, Floats, Cost | None]:
    """E (3, 5) that comes nearest over the image, by linear least squares; how far it moves the principal point (2,),
    as E has no constant term; and its cost, None where nothing is lost."""
    lens = camera.lens
    rays, uv = image_rays(camera, "MyPTV's cameras")
    e = np.zeros((3, 5))
    if not has_distortion(lens) and lens.fx == lens.fy:
        return e, np.zeros(2), None
    wanted = lens.fx * rays[:, :2] - (uv - [lens.cx, lens.cy])
    terms = np.column_stack([_powers(uv, 5), np.ones(len(uv))])
    scale = np.abs(terms).max(axis=0)
    found = np.linalg.lstsq(terms / scale, wanted, rcond=None)[0] / scale[:, None]
    e[:2], moved = found[:5].T, found[5]
    cost = Cost.between(terms @ found, wanted)
    if not cost.largest <= MAX_LENS_DIFFERENCE_PX:
        raise DatasetError(
            f"camera {camera.name!r} cannot be written for MyPTV.",
            why=f"its correction is quadratic, and {cost.in_words()}",
            fix="export to openptv or opencv; or undistort the pictures first, and export the pinhole",
        )
    return e, moved, cost


def _powers(uv: Floats, count: int) -> Floats:
    """MyPTV's powers (n, 5 or 9) of pixels."""
    a, b = uv.T
    return np.column_stack([a, b, a * a, b * b, a * b, a**3, a * a * b, a * b * b, b**3][:count])


def knows(source: Source) -> bool:
    """Whether it is a file of MyPTV, of either model; or a folder of such.

    Args:
        source: What is given.
    """
    if source.path.is_dir():
        return any(_is_camera(file) for file in sorted(source.path.iterdir())[:20])
    return source.text.startswith((FIRST_LINE, OTHER_FIRST_LINE))


def _is_camera(file: Path) -> bool:
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return stream.read(40).startswith((FIRST_LINE.encode(), OTHER_FIRST_LINE.encode()))


def read(paths: Sequence[Path]) -> Rig:
    """Read the cameras.

    Args:
        paths: A file for each camera, or a folder of them.

    Raises:
        DatasetError: A file has a mistake, or is of the model that has no lens.
    """
    files = [file for path in paths for file in (_cameras_in(path) if path.is_dir() else [path])]
    if not files:
        raise DatasetError(f"{paths[0]}: there is no camera of MyPTV.", fix="give the files of the cameras")
    read = [_read_camera(file) for file in files]
    notes = [note for _, said in read for note in said]
    with naming(str(paths[0])):
        return Rig(tuple(camera for camera, _ in read), UNKNOWN_UNIT, tuple(notes))


def _cameras_in(folder: Path) -> list[Path]:
    return [file for file in sorted(folder.iterdir()) if _is_camera(file)]


def _read_camera(path: Path) -> tuple[ExplicitCamera, list[str]]:
    lines = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    if lines and lines[0].startswith(OTHER_FIRST_LINE):
        raise DatasetError(
            f"{path} is a camera of MyPTV's extended Zolof model.",
            why="its polynomials are no lens with a place",
            fix="give its known points (cal_points) to implicam calibrate; or calibrate MyPTV's Tsai model",
        )
    if len(lines) != LINES or lines[0] != FIRST_LINE:
        raise DatasetError(
            f"{path} has {len(lines)} lines, the first {shorten(lines[0] if lines else '')}.",
            why=f"a camera of MyPTV has {LINES}, the first {FIRST_LINE!r}; older ones do not say the size of the image",
            fix=f"write {FIRST_LINE!r} before the name, and after it a line with width and height",
        )
    name = check_text(lines[1], f"{path}: the name")
    size = read_image_size(lines[2].split(), f"{path}, line 3")
    centre, angles = (read_numbers(lines[i].split(), (3,), f"{path}, line {i + 1}") for i in (3, 4))
    (f,) = read_numbers(lines[5].split(), (1,), f"{path}, line 6")
    shift = read_numbers(lines[6].split(), (2,), f"{path}, line 7")
    count = 9 if len(lines[7].split()) == 9 else 5
    e = np.array([read_numbers(lines[i].split(), (count,), f"{path}, line {i + 1}") for i in (7, 8, 9)])
    if f == 0:
        raise DatasetError(f"{path}, line 6: f must not be zero.", fix="correct the value")
    # for a negative f both axes are turned: half a turn about the line of sight
    sign = float(np.sign(f))
    turn = np.diag([sign, sign, 1.0]) @ rotation_from_angles(angles)
    linear = [abs(float(f)), *(np.array(size) / 2 + shift).tolist()]
    lens = _lens(linear, np.diag([1.0, 1.0, sign]) @ e)
    return make_camera(name, size, lens, Pose(turn, -turn @ centre), str(path))


def _lens(linear: Sequence[float], e: Floats) -> Lens | OtherLens:
    f, cx, cy = linear
    if not e.any():
        return BrownConrady(f, f, cx, cy)

    def plane(uv: Floats) -> Floats:
        """Where in the plane at distance 1 pixels look."""
        ray = np.column_stack([uv - [cx, cy], np.full(len(uv), f)]) + _powers(uv, e.shape[1]) @ e.T
        return np.asarray(ray[:, :2] / ray[:, 2:], dtype=np.float64)

    def project(points: Floats) -> tuple[Floats, Bools]:
        front = points[:, 2] > 1e-9 * np.abs(points).max(axis=1)
        wanted = points[:, :2] / np.where(front, points[:, 2], np.nan)[:, None]
        uv = f * wanted + [cx, cy]
        for _ in range(NEWTON_STEPS):  # the correction is small: the step of the pinhole is near Newton's
            uv = uv - f * (plane(uv) - wanted)
        return uv, front & (np.abs(plane(uv) - wanted).max(axis=1) * f < 1e-3)

    return OtherLens("MyPTV's correction", project, cx, cy)
