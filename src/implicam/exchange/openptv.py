"""`openptv`: cameras of OpenPTV: NAME.ori with NAME.addpar for each, and parameters/ptv.par for all.

    NAME.ori      x0 y0 z0, omega phi kappa, the 3 x 3 matrix of these angles, xh yh, cc, the glass vector
    NAME.addpar   k1 k2 k3 p1 p2 scx she
    ptv.par       names, image size and pixel size, refractive indices; newer versions keep them in parameters_*.yaml

Lengths are millimetres. The camera looks along -z of its frame, x right and y up. A point falls on the plane at cc, is
moved by (xh, yh), bent about the *middle of the sensor* by k1, k2, k3, p1, p2 (of millimetres), scaled and sheared, and
pixel = (imx / 2 + x / pix_x, imy / 2 - y / pix_y), with (0, 0) at the *corner* of the first pixel: ours + 0.5. Where
xh = yh = she = 0, or there is no distortion, this is a lens here; else it is refitted.

Versions of OpenPTV do not agree on scx: since 0.3.2 it scales y as well. With 1, as usual, they do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from implicam.dataset.tables import naming
from implicam.errors import DatasetError
from implicam.exchange.angles import angles_from_rotation, rotation_from_angles
from implicam.exchange.checks import as_table, get_entry, read_integer, read_numbers, read_text, shorten
from implicam.exchange.fits import MAX_LENS_DIFFERENCE_PX, Cost, image_rays
from implicam.exchange.folders import write_folder
from implicam.exchange.model import ExplicitCamera, Rig
from implicam.exchange.other_lenses import OtherLens, Projection
from implicam.exchange.refits import make_camera
from implicam.exchange.source import Source, read_yaml
from implicam.geometry import Pose
from implicam.images import ENDINGS
from implicam.lenses import Bools, BrownConrady, Floats, Lens

CENTRE_OFFSET_PX = 0.5  # OpenPTV's x and y of the centre of the first pixel
PIXEL_SIZE_MM = 0.01  # of what is written: any would do, as cc scales with it
NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
LOOKS_ALONG_MINUS_Z = np.diag([1.0, -1.0, -1.0])
"""From OpenPTV's camera frame, y up and z back, to ours."""

LAST_LINES = ("hp", "allcam", "tiff", "imx", "imy", "pix_x", "pix_y", "chfield", "n1", "n2", "n3", "d")
"""Of ptv.par, after the names."""

NUMBERS_IN_ORI, NUMBERS_IN_ADDPAR = 21, 7


@dataclass(frozen=True)
class Sensor:
    """What all cameras share: image size, pixel size in millimetres, and whether light goes through air only."""

    size: tuple[int, int]
    pixel: tuple[float, float]
    indices: tuple[float, ...]
    names: tuple[str, ...]


def write(rig: Rig, path: Path) -> list[str]:
    """Write a folder with cal/NAME.tif.ori, cal/NAME.tif.addpar and parameters/ptv.par, in millimetres, in air.

    Args:
        rig: The cameras, all with the same image size, in a known unit.
        path: The folder.

    Returns:
        Notes on what refitting a lens cost, on names, and on the pixel size, which is invented.

    Raises:
        DatasetError: A lens, an image size or the unit does not fit the format.
        ImplicamError: The folder cannot be written.
    """
    sizes = {camera.size for camera in rig.cameras}
    if len(sizes) > 1:
        raise DatasetError("the cameras have several image sizes.", why="ptv.par holds one", fix="export to opencv")
    names = ["_".join(camera.name.split()) for camera in rig.cameras]
    if len(set(names)) < len(names):
        raise DatasetError("two cameras would have the same name in OpenPTV.", fix="rename one of them")
    texts, notes = {}, [f"Lengths are in mm; pixels are taken as {PIXEL_SIZE_MM:g} mm, and there is no glass or water."]
    for name, camera in zip(names, rig.in_unit("mm").cameras, strict=True):
        values, cost = _fit_numbers(camera)
        notes += [f"Camera {camera.name!r}: fitted again with OpenPTV's terms: {cost}."] if cost.largest > 1e-6 else []
        texts[f"cal/{name}.tif.ori"] = _ori_text(camera.camera_from_world, values[:3])
        texts[f"cal/{name}.tif.addpar"] = " ".join(repr(x) for x in [*values[3:], 1.0, 0.0]) + "\n"
    texts["parameters/ptv.par"] = _ptv_par(names, sizes.pop())
    write_folder(path, texts, "OpenPTV's cameras")
    notes += ["Spaces in camera names became _."] if names != [c.name for c in rig.cameras] else []
    return notes


def _ori_text(pose: Pose, interior: Sequence[float]) -> str:
    turn = pose.rotation.T @ LOOKS_ALONG_MINUS_Z
    angles = angles_from_rotation(turn)
    xh, yh, cc = interior
    centre = pose.centre
    glass = -centre / np.linalg.norm(centre) if centre.any() else np.array([0.0, 0, 1])  # no glass: any direction
    rows = [centre, angles, [], *turn, [], [xh, yh], [cc], [], glass]
    return "".join(" ".join(repr(float(x)) for x in row) + "\n" for row in rows)


def _ptv_par(names: Sequence[str], size: tuple[int, int]) -> str:
    """The file of all cameras: its lines have no keys."""
    images = [line for name in names for line in (f"img/{name}.tif", f"cal/{name}.tif")]
    flags = ["1", "0", "1"]  # high pass, all cameras, TIFF
    numbers = [*map(str, size), *[f"{PIXEL_SIZE_MM!r}"] * 2, "0", "1.0", "1.0", "1.0", "1.0"]
    return "\n".join([str(len(names)), *images, *flags, *numbers]) + "\n"


def _fit_numbers(camera: ExplicitCamera) -> tuple[list[float], Cost]:
    """xh, yh, cc, k1, k2, k3, p1, p2 that come nearest over the image, and what they cost."""
    rays, uv = image_rays(camera, "OpenPTV's cameras")
    lens = camera.lens
    width, height = camera.size
    cc = PIXEL_SIZE_MM * (lens.fx + lens.fy) / 2
    xh = PIXEL_SIZE_MM * (lens.cx + CENTRE_OFFSET_PX - width / 2)
    yh = PIXEL_SIZE_MM * (height / 2 - lens.cy - CENTRE_OFFSET_PX)
    start = np.array([xh, yh, cc, *[0.0] * 5])
    # what each parameter moves at the edge is near one pixel
    half = PIXEL_SIZE_MM * max(width, height) / 2
    scale = PIXEL_SIZE_MM / np.array([1, 1, half / cc, half**3, half**5, half**7, half**2, half**2])
    sensor = Sensor(camera.size, (PIXEL_SIZE_MM, PIXEL_SIZE_MM), (), ())

    def project(x: Floats) -> Floats:
        values = (start + scale * x).tolist()
        return _projection(values[:3], [*values[3:], 1.0, 0.0], sensor)(rays)[0]

    x = least_squares(lambda x: (project(x) - uv).ravel(), np.zeros(8), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    cost = Cost.between(project(x), uv)
    if not cost.largest <= MAX_LENS_DIFFERENCE_PX:
        raise DatasetError(
            f"camera {camera.name!r} cannot be written for OpenPTV.",
            why=f"the nearest camera with its terms {cost.in_words()}",
            fix="export to opencv, or calibrate with brown-conrady",
        )
    return (start + scale * x).tolist(), cost


def knows(source: Source) -> bool:
    """Whether there are .ori files, or a folder cal with such.

    Args:
        source: What is given.
    """
    names = set(source.file_names)
    if source.path.is_dir() and (source.path / "cal").is_dir():
        names |= {file.name for file in (source.path / "cal").iterdir()}
    return any(name.endswith(".ori") for name in names)


def read(paths: Sequence[Path]) -> Rig:
    """Read the cameras of an experiment.

    Args:
        paths: The folder of the experiment, or its cal; or the .ori files, with the .addpar beside each; ptv.par, or
            parameters_*.yaml, may be given too, and is looked for beside them.

    Returns:
        The cameras, in millimetres.

    Raises:
        DatasetError: A file is missing or has a mistake; or the cameras look through glass or water.
    """
    sensor, place = _find_sensor(paths)
    oris = _find_oris(paths, sensor)
    if any(abs(index - sensor.indices[0]) > 1e-9 for index in sensor.indices):
        raise DatasetError(
            f"{place}: the cameras look through {' / '.join(f'{index:g}' for index in sensor.indices)} (refractive "
            "indices).",
            why="behind glass or water a camera has no single centre, and no lens here holds that",
            fix="calibrate from the known points (cal/*.txt): forward-gp learns what refraction does",
        )
    cameras, notes = [], []
    for ori in oris:
        camera, said = _read_camera(ori, sensor)
        cameras.append(camera)
        notes += said
    with naming(str(oris[0])):
        return Rig(tuple(cameras), "mm", tuple(notes))


def _find_oris(paths: Sequence[Path], sensor: Sensor) -> list[Path]:
    """The .ori files given, or of a folder those that ptv.par names, else all."""
    given = [path for path in paths if path.name.endswith(".ori")]
    for folder in (path for path in paths if path.is_dir()):
        named = [folder / f"{name}.ori" for name in sensor.names] + [
            folder / f"{Path(name).name}.ori" for name in sensor.names
        ]
        found = [file for file in named if file.is_file()]
        given += found or sorted([*folder.glob("*.ori"), *folder.glob("cal/*.ori")])
    if not given:
        raise DatasetError(
            f"{paths[0]}: there is no .ori file.", fix="give the folder of the experiment, or the .ori files"
        )
    return given


def _find_sensor(paths: Sequence[Path]) -> tuple[Sensor, Path]:
    """What all cameras share, from the file of it that is given or beside what is given."""
    for path in paths:
        if path.is_file() and path.suffix.lower() in (".par", ".yaml", ".yml"):
            return _read_sensor(path), path
    folders = [folder for path in paths for folder in ([path] if path.is_dir() else [path.parent])]
    around = [place for folder in folders for place in (folder, folder.parent)]
    for place in around:
        for pattern in ("parameters/ptv.par", "ptv.par", "parameters*.yaml", "parameters*/ptv.par"):
            for found in sorted(place.glob(pattern)):
                return _read_sensor(found), found
    raise DatasetError(
        f"{paths[0]}: ptv.par is missing.",
        why="the .ori files are in millimetres on the sensor; the sizes of image and pixel are in parameters/ptv.par, "
        "or in parameters_*.yaml of newer versions",
        fix="give that file too, beside the .ori files",
    )


def _read_sensor(path: Path) -> Sensor:
    if path.suffix.lower() != ".par":
        table = as_table(get_entry(read_yaml(path), "ptv", str(path)), f"{path}: ptv")
        names = table.get("img_cal")
        keys = ("imx", "imy", "pix_x", "pix_y", "chfield", "mmp_n1", "mmp_n2", "mmp_n3")
        values = [str(get_entry(table, key, f"{path}: ptv")) for key in keys]
    else:
        lines = [line.strip() for line in read_text(path).splitlines() if line.strip()]
        count = lines[0] if lines else ""
        if not (count.isdecimal() and 0 < int(count[:4]) <= 100):
            raise DatasetError(
                f"{path}: {shorten(count)} is no number of cameras.", fix="give OpenPTV's ptv.par, whole"
            )
        names = lines[2 : 2 * int(count) + 1 : 2]
        if len(lines) < 1 + 2 * int(count) + len(LAST_LINES):
            raise DatasetError(
                f"{path} has {len(lines)} lines, too few for {count} cameras.",
                why=f"after two names for each camera come {', '.join(LAST_LINES)}",
                fix="give OpenPTV's ptv.par, whole",
            )
        values = lines[-len(LAST_LINES) :][3:11]
    width, height = (read_integer(value, f"{path}: image size") for value in values[:2])
    pixel = read_numbers(values[2:4], (2,), f"{path}: pixel size")
    if read_integer(values[4], f"{path}: chfield"):
        raise DatasetError(
            f"{path}: chfield = {values[4]}.",
            why="it is of interlaced cameras, whose lines are counted twice",
            fix="calibrate with whole pictures",
        )
    if not (pixel > 0).all():
        raise DatasetError(f"{path}: the pixel size must be greater than zero.", fix="correct the value, in mm")
    indices = read_numbers(values[5:8], (3,), f"{path}: refractive indices")
    listed = tuple(str(name) for name in names) if isinstance(names, list) else ()
    return Sensor((width, height), (float(pixel[0]), float(pixel[1])), tuple(indices.tolist()), listed)


def _read_camera(ori: Path, sensor: Sensor) -> tuple[ExplicitCamera, list[str]]:
    words = read_text(ori).split()
    if len(words) not in (NUMBERS_IN_ORI, NUMBERS_IN_ORI - 3):  # the oldest have no glass
        raise DatasetError(
            f"{ori} has {len(words)} numbers; a camera of OpenPTV has {NUMBERS_IN_ORI}.",
            why="they are place, angles, matrix, xh yh, cc and the glass vector",
            fix="give the .ori file that OpenPTV wrote",
        )
    centre = read_numbers(words[:3], (3,), f"{ori}: place")
    angles = read_numbers(words[3:6], (3,), f"{ori}: angles")
    interior = read_numbers(words[15:18], (3,), f"{ori}: xh, yh, cc").tolist()
    if not interior[2] > 0:
        raise DatasetError(f"{ori}: cc = {interior[2]:g} must be greater than zero.", fix="correct the value, in mm")
    added, notes = _read_added(ori)
    turn = LOOKS_ALONG_MINUS_Z @ rotation_from_angles(angles).T
    name = ori.name.removesuffix(".ori")
    name = Path(name).stem if Path(name).suffix.lower() in ENDINGS else name
    if added[5] != 1:
        off = abs(added[5] - 1) * sensor.size[1] / 2
        notes.append(
            f"Camera {name!r}: scx = {added[5]:g} scales x and y, as in OpenPTV since 0.3.2; before, it scaled x only, "
            f"which is another {off:.2g} px at the edge."
        )
    camera, cost = make_camera(name, sensor.size, _lens(interior, added, sensor), Pose(turn, -turn @ centre), str(ori))
    return camera, [*notes, *cost]


def _read_added(ori: Path) -> tuple[list[float], list[str]]:
    """The numbers of the .addpar beside, and a note where there is none."""
    beside = ori.with_name(ori.name.removesuffix(".ori") + ".addpar")
    if not beside.is_file():
        return list(NO_DISTORTION), [f"{ori.name}: there is no {beside.name}, so the lens has no distortion."]
    words = read_text(beside).split()
    return read_numbers(words, (NUMBERS_IN_ADDPAR,), f"{beside}: k1 k2 k3 p1 p2 scx she").tolist(), []


def _lens(interior: Sequence[float], added: Sequence[float], sensor: Sensor) -> Lens | OtherLens:
    """The lens: OpenCV's where the distortion is about the principal point, or there is none."""
    xh, yh, cc = interior
    k1, k2, k3, p1, p2, scx, she = added
    (width, height), (pix_x, pix_y) = sensor.size, sensor.pixel
    middle = width / 2 - CENTRE_OFFSET_PX, height / 2 - CENTRE_OFFSET_PX
    centre = middle[0] + scx * xh / pix_x, middle[1] - scx * yh / pix_y
    if she == 0 and scx > 0 and (xh == yh == 0 or not any((k1, k2, k3, p1, p2))):
        bend = k1 * cc**2, k2 * cc**4, -p2 * cc, p1 * cc, k3 * cc**6
        return BrownConrady(scx * cc / pix_x, scx * cc / pix_y, *centre, *bend)
    return OtherLens("OpenPTV's lens model", _projection(interior, added, sensor), *centre)


def _projection(interior: Sequence[float], added: Sequence[float], sensor: Sensor) -> Projection:
    """OpenPTV's map from points in our camera frame to our pixels."""
    xh, yh, cc = interior
    k1, k2, k3, p1, p2, scx, she = added
    (width, height), (pix_x, pix_y) = sensor.size, sensor.pixel

    def project(points: Floats) -> tuple[Floats, Bools]:
        valid = points[:, 2] > 1e-9 * np.abs(points).max(axis=1)
        depth = np.where(valid, points[:, 2], np.nan)
        x, y = cc * points[:, 0] / depth + xh, -cc * points[:, 1] / depth + yh
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bent_x = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
        bent_y = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
        u = width / 2 + scx * (bent_x - np.sin(she) * bent_y) / pix_x
        v = height / 2 - scx * np.cos(she) * bent_y / pix_y
        return np.column_stack([u, v]) - CENTRE_OFFSET_PX, valid

    return project
