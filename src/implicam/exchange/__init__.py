"""Explicit cameras in other programs' files: what each format is, how it is written and how it is read.

To add a format: write a file with `write(rig, path) -> notes` and `read(path) -> Rig`, its conventions in its head; add
it to `FORMATS`, to `_find_kind` if its content tells what it is, to the table of docs/exchange.md, and to the tests.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from implicam.errors import DatasetError, UsageError, did_you_mean
from implicam.exchange import anipose, colmap, dlt, fits, kalibr, opencv
from implicam.exchange.checks import read_text
from implicam.exchange.model import UNKNOWN_UNIT, ExplicitCamera, Rig
from implicam.lenses import BrownConrady, KannalaBrandt

__all__ = ["FORMATS", "UNKNOWN_UNIT", "ExplicitCamera", "Format", "Rig", "export_cameras", "import_cameras"]


@dataclass(frozen=True)
class Format:
    """How a format is written, how it is read, and what it is in a few words.

    write: gives notes, each a sentence on what the format lost or cost; none where it holds everything.
    """

    write: Callable[[Rig, Path], list[str]]
    read: Callable[[Path], Rig]
    what: str
    fits_lenses: bool = False
    """Whether it fits its own camera to any lens; the others hold the two families of OpenCV as they are."""


FORMATS = {
    "opencv": Format(opencv.write, opencv.read, "OpenCV FileStorage, one YAML file"),
    "kalibr": Format(kalibr.write, kalibr.read, "Kalibr's camchain.yaml"),
    "colmap": Format(colmap.write, colmap.read, "COLMAP's text model, a folder"),
    "aniposelib": Format(anipose.write_aniposelib, anipose.read_aniposelib, "aniposelib's calibration.toml"),
    "pose2sim": Format(anipose.write_pose2sim, anipose.read_pose2sim, "Pose2Sim's Calib.toml", True),
    "dlt": Format(dlt.write, dlt.read, "DLT coefficients as a CSV of DLTdv or easyWand", True),
}


def export_cameras(rig: Rig, to: str, path: str | Path) -> list[str]:
    """Write the rig in another program's format, whole or not at all.

    Args:
        rig: The cameras.
        to: A name of `FORMATS`.
        path: The file, of COLMAP the folder.

    Returns:
        Notes, each a sentence on what the format lost or cost; none where it holds everything.

    Raises:
        UsageError: There is no such format.
        DatasetError: The format cannot hold the rig; the error names one that can.
        ImplicamError: The file cannot be written.
    """
    form = _find_format(to)
    for camera in rig.cameras:
        if not (form.fits_lenses or isinstance(camera.lens, BrownConrady | KannalaBrandt)):
            raise DatasetError(
                f"camera {camera.name!r} has a lens of the family {camera.lens.family}, which {to} does not know.",
                why="it holds the two families of OpenCV, brown-conrady and kannala-brandt",
                fix=", ".join(["calibrate with one of these", *_imitating(rig)]),
            )
    return form.write(rig, Path(path))


def _imitating(rig: Rig) -> list[str]:
    """The end of a cure: the formats whose own camera comes near enough to all of a rig's; empty where none does."""
    near = []
    for name, imitates in (("pose2sim", fits.fit_four_coefficients), ("dlt", fits.fit_projection_matrix)):
        with suppress(DatasetError):
            costs = [imitates(camera)[1] for camera in rig.cameras]
            if all(cost is None or cost.largest <= fits.MAX_LENS_DIFFERENCE_PX for cost in costs):
                near.append(name)
    return [f"or export to {' or '.join(near)}, which comes within {fits.MAX_LENS_DIFFERENCE_PX:g} px"] if near else []


def import_cameras(path: str | Path, kind: str | None = None, *, unit: str | None = None) -> Rig:
    """Read cameras from another program's file or folder.

    Args:
        path: The file or folder.
        kind: A name of `FORMATS`; None to recognise the format by the content.
        unit: The length unit, for a file that does not say it.

    Returns:
        The cameras; the rig's notes say what its reader should know.

    Raises:
        UsageError: There is no such format.
        DatasetError: The file cannot be read, is not recognised, has a mistake, or states another unit.
    """
    path = Path(path)
    try:
        rig = _find_format(kind or _find_kind(path)).read(path)
    except OSError as error:
        raise DatasetError(
            f"{path} cannot be read.", why=str(error), fix="check the name and the permissions"
        ) from error
    if unit is None and rig.length_unit == UNKNOWN_UNIT:
        return replace(rig, notes=(*rig.notes, "The file does not say its length unit: state it before you measure."))
    if unit is None or unit == rig.length_unit:
        return rig
    if rig.length_unit != UNKNOWN_UNIT:
        raise DatasetError(
            f"{path} is in {rig.length_unit!r}, not in {unit!r}.",
            why="the file, or its format, states the unit",
            fix="leave out the unit, and convert the rig afterwards",
        )
    return replace(rig, length_unit=unit)


def _find_format(name: str) -> Format:
    if name not in FORMATS:
        raise UsageError(
            f"there is no format {name!r}{did_you_mean(name, FORMATS)}.", fix=f"choose one of {', '.join(FORMATS)}"
        )
    return FORMATS[name]


def _find_kind(path: Path) -> str:
    """The format of a file or folder, by what is in it."""
    if path.is_dir() or path.name in (colmap.CAMERAS_FILE, colmap.IMAGES_FILE):
        return "colmap"
    text = read_text(path)
    if text.startswith("%YAML") or "opencv-matrix" in text:
        return "opencv"
    if re.search(r"^cam0\s*:", text, re.MULTILINE):
        return "kalibr"
    if re.search(r"^\s*\[[^\]\n]+\]\s*$", text, re.MULTILINE):
        return _find_kind_of_toml(path)
    if re.fullmatch(r"[-+0-9.,eE\s]+", text):
        return "dlt"
    raise DatasetError(
        f"{path}: the format of these cameras is not recognised.",
        why=f"read are {'; '.join(f'{name} ({entry.what})' for name, entry in FORMATS.items())}",
        fix="name the format, or export the cameras in one of these",
    )


def _find_kind_of_toml(path: Path) -> str:
    """Pose2Sim writes four coefficients and never a fisheye; aniposelib five, or a fisheye."""
    cameras = anipose.camera_tables(anipose.read_toml(path)).values()
    lengths = [len(c["distortions"]) for c in cameras if isinstance(c.get("distortions"), list)]
    fisheye = any(c.get("fisheye") is True for c in cameras)
    return "pose2sim" if lengths and set(lengths) == {4} and not fisheye else "aniposelib"
