"""`myptv` and `openptv`: calibration points of particle tracking, one file for each camera.

MyPTV has a file `cam1_cal_points` with a row u, v, x, y, z for each point. OpenPTV has two files for each plane and
camera, `plane1.tif.fix` with number, x, y, z and `plane1.tif.crd` with number, u, v, where the last character before
.tif is the camera; -999 is a point that was not found.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from implicam.dataset.folder import format_cells
from implicam.dataset.model import Dataset
from implicam.dataset.programs.views import Numbers, Views, files_of, rows_of_numbers
from implicam.errors import DatasetError
from implicam.files import replacing_folder

NOT_FOUND = -999.0
MAX_OPENPTV_CAMERAS = 9


def read_myptv(path: Path, positions: Sequence[Numbers]) -> Views:
    """Read the files cal_points of MyPTV; points are the same where their positions are.

    Args:
        path: The folder.
        positions: None: they are in the files.

    Raises:
        DatasetError: There is no such file, or a row is not u, v, x, y, z.
    """
    _refuse_positions(positions, path)
    views, seen = Views(), dict[str, Path]()
    for file in files_of(path, ["*cal_points*"], "files named cal_points"):
        camera = re.sub(r"[\s_.-]*cal_points[\s_.-]*", "", file.name) or file.name
        if camera in seen:
            raise DatasetError(f"{file} and {seen[camera]} are both of camera {camera!r}.", fix="keep one of the two")
        seen[camera] = file
        for place, (u, v, *xyz) in rows_of_numbers(file, (5,), "u, v, x, y, z"):
            name = " ".join(f"{value:.10g}" for value in xyz)
            views.add(name, camera, (u, v), place)
            views.place_point(name, tuple(xyz), place)
    return views


def read_openptv(path: Path, positions: Sequence[Numbers]) -> Views:
    """Read the files .fix and .crd of OpenPTV.

    Args:
        path: The folder.
        positions: None: they are in the files.

    Raises:
        DatasetError: There is no such file, one of a pair is missing, or their numbers differ.
    """
    _refuse_positions(positions, path)
    if path.is_dir() and not list(path.glob("*.crd")) and list(path.glob("*_targets")):
        raise DatasetError(
            f"{path} has files _targets and no .crd.",
            why="they list what each camera saw, and not which of it belongs together",
            fix="give the files .fix and .crd of a calibration",
        )
    views = Views()
    for detected in files_of(path, ["*.crd"], "files .crd"):
        base = detected.name.removesuffix(".crd").removesuffix(".tif")
        known = detected.with_suffix(".fix")
        if not known.is_file():
            raise DatasetError(f"{detected} has no {known.name} beside it.", fix="add the file of known positions")
        plane, camera = base[:-1].rstrip("_-. "), base[-1]
        if not camera.isdigit():
            raise DatasetError(
                f"{detected}: the name does not end in the number of a camera.",
                fix="name it as OpenPTV does: the plane, the camera's number, .tif.crd",
            )
        where = {int(row[0]): (row[1:], place) for place, row in rows_of_numbers(known, (4,), "number, x, y, z")}
        for place, (number, u, v) in rows_of_numbers(detected, (3,), "number, u, v"):
            if int(number) not in where:
                raise DatasetError(f"{place}: point {number:g} is not in {known.name}.", fix="add its position")
            name = f"{plane} {number:g}".strip()
            missing = NOT_FOUND in (u, v)
            views.add(name, f"cam{camera}", (float("nan"),) * 2 if missing else (u, v), place)
            views.place_point(name, *where[int(number)])
    return views


def _refuse_positions(positions: Sequence[Numbers], path: Path) -> None:
    if positions:
        raise DatasetError(f"the known positions are in the files of {path} themselves.", fix="leave out --positions")


def write_myptv(data: Dataset, path: Path) -> list[str]:
    """Write a folder with a file cal_points for each camera, and target_file.

    Args:
        data: The dataset; its positions must be known.
        path: The folder.

    Returns:
        What it could not hold, in sentences.

    Raises:
        DatasetError: The positions are not known.
        ImplicamError: The folder exists, or cannot be written.
    """
    positions = [format_cells(row) for row in data.xyz]
    with replacing_folder(path) as folder:
        for k, camera in enumerate(data.cameras):
            views = zip(data.observations.uv[:, k], positions, data.observations.seen[:, k], strict=True)
            rows = [[*format_cells(uv), *xyz] for uv, xyz, seen in views if seen]
            (folder / f"{camera.name}_cal_points").write_text(_lines(rows), encoding="utf-8")
        (folder / "target_file").write_text(_lines(positions), encoding="utf-8")
    return ["The names of the points are lost: MyPTV knows them by their positions."]


def write_openptv(data: Dataset, path: Path) -> list[str]:
    """Write a folder with files .fix and .crd for each camera, all points as one plane.

    Args:
        data: The dataset; its positions must be known.
        path: The folder.

    Returns:
        What it could not hold, in sentences.

    Raises:
        DatasetError: The positions are not known, or there are more than nine cameras.
        ImplicamError: The folder exists, or cannot be written.
    """
    if len(data.cameras) > MAX_OPENPTV_CAMERAS:
        raise DatasetError(
            f"OpenPTV has no names for {len(data.cameras)} cameras.", fix="leave some out, or write another format"
        )
    seen = data.observations.seen
    with replacing_folder(path) as folder:
        for k in range(len(data.cameras)):
            numbers = [i for i in range(len(data)) if seen[i, k]]
            known = [[str(i + 1), *format_cells(data.xyz[i])] for i in numbers]
            found = [[str(i + 1), *format_cells(data.observations.uv[i, k])] for i in numbers]
            (folder / f"cal_{k + 1}.tif.fix").write_text(_lines(known), encoding="utf-8")
            (folder / f"cal_{k + 1}.tif.crd").write_text(_lines(found), encoding="utf-8")
    return [f"The cameras are {', '.join(f'{i} = {c.name}' for i, c in enumerate(data.cameras, 1))}; names are lost."]


def _lines(rows: list[list[str]]) -> str:
    return "".join("\t".join(row) + "\n" for row in rows)
