"""Explicit cameras in other programs' files: what each format is, how it is written and how it is read.

To add a format: write a file with `write(rig, path) -> notes`, `read(paths) -> Rig` and `knows(source) -> bool`, its
conventions in its head; add it to `FORMATS`, to the table of docs/exchange.md, and to the tests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from implicam.dataset.units import UNKNOWN_UNIT
from implicam.errors import DatasetError, UsageError, did_you_mean
from implicam.exchange import (
    anipose,
    caliscope,
    colmap,
    dlt,
    easymocap,
    fits,
    kalibr,
    myptv,
    opencv,
    opencv_stereo,
    openptv,
    qualisys,
    ros,
)
from implicam.exchange.model import ExplicitCamera, Rig
from implicam.exchange.source import Source
from implicam.files import is_file_name
from implicam.lenses import BrownConrady, KannalaBrandt

__all__ = [
    "FOLDERS",
    "FORMATS",
    "UNKNOWN_UNIT",
    "ExplicitCamera",
    "Format",
    "Rig",
    "export_cameras",
    "import_cameras",
]


Write = Callable[[Rig, Path], list[str]]
Read = Callable[[Sequence[Path]], Rig]


@dataclass(frozen=True)
class Format:
    """How a format is written, how it is read, how it is recognised, and what it is in a few words.

    write: gives notes, each a sentence on what the format lost or cost; none where it holds everything.
    read: takes the files or folders that belong together.
    knows: whether what is given is of this format, by its content.
    """

    write: Write
    read: Read
    knows: Callable[[Source], bool]
    what: str
    endings: tuple[str, ...] = ()
    """Of the names that are usual for its file; none where it is a folder."""
    fits_lenses: bool = False
    """Whether it fits its own camera to any lens; the others hold the two families of OpenCV as they are."""


def _one_file(read: Callable[[Path], Rig]) -> Read:
    """The reader of a format whose rigs are one file or folder."""

    def read_one(paths: Sequence[Path]) -> Rig:
        if len(paths) > 1:
            raise UsageError(
                f"{len(paths)} files are given, and this format keeps a whole rig in one.",
                fix="give the file of the whole rig; opencv and ros take a file for each camera",
            )
        return read(paths[0])

    return read_one


TOML, YAML = (".toml",), (".yaml", ".yml")

FORMATS = {
    "colmap": Format(colmap.write, _one_file(colmap.read), colmap.knows, "COLMAP's model, a folder"),
    "qualisys": Format(
        qualisys.write, _one_file(qualisys.read), qualisys.knows, "Qualisys's .qca.txt", (".txt", ".xml"), True
    ),
    "kalibr": Format(kalibr.write, _one_file(kalibr.read), kalibr.knows, "Kalibr's camchain.yaml", YAML),
    "caliscope": Format(
        caliscope.write, _one_file(caliscope.read), caliscope.knows, "caliscope's camera_array.toml", TOML
    ),
    "pose2sim": Format(
        anipose.write_pose2sim,
        _one_file(anipose.read_pose2sim),
        anipose.knows_pose2sim,
        "Pose2Sim's Calib.toml",
        TOML,
        True,
    ),
    "aniposelib": Format(
        anipose.write_aniposelib,
        _one_file(anipose.read_aniposelib),
        anipose.knows_aniposelib,
        "aniposelib's calibration.toml",
        TOML,
    ),
    "easymocap": Format(
        easymocap.write, easymocap.read, easymocap.knows, "EasyMocap's intri.yml and extri.yml", (), True
    ),
    "ros": Format(ros.write, ros.read, ros.knows, "ROS's camera_info, a file a camera"),
    "opencv-stereo": Format(
        opencv_stereo.write,
        opencv_stereo.read,
        opencv_stereo.knows,
        "K1, D1, K2, D2, R, T of cv2.stereoCalibrate",
        YAML,
    ),
    "opencv": Format(opencv.write, opencv.read, opencv.knows, "OpenCV FileStorage, YAML, XML or JSON", YAML),
    "openptv": Format(openptv.write, openptv.read, openptv.knows, "OpenPTV's .ori and .addpar with ptv.par", (), True),
    "myptv": Format(myptv.write, myptv.read, myptv.knows, "MyPTV's camera files, Tsai model", (), True),
    "dlt": Format(
        dlt.write,
        _one_file(dlt.read),
        dlt.knows,
        "DLT coefficients as a CSV of DLTdv or easyWand",
        (".csv", ".txt"),
        True,
    ),
}
"""In the order in which they are tried on a file: first the one that may be binary, and is known by names of files."""

FOLDERS = tuple(name for name, form in FORMATS.items() if not form.endings)
"""The names of those that are a folder when they are written."""


def export_cameras(rig: Rig, to: str, path: str | Path) -> list[str]:
    """Write the rig in another program's format, whole or not at all.

    Args:
        rig: The cameras.
        to: A name of `FORMATS`.
        path: The file, of COLMAP the folder.

    Returns:
        Notes, each a sentence on what the format lost or cost; none where it holds everything.

    Raises:
        UsageError: There is no such format, or the name has the ending of another.
        DatasetError: The format cannot hold the rig; the error names one that can.
        ImplicamError: The file cannot be written.
    """
    form, path = _find_format(to), Path(path)
    if is_file_name(path) and path.suffix.lower() not in form.endings and not path.is_dir():
        raise UsageError(
            f"{path}: {to} is not written as {path.suffix}.",
            fix=f"end the name in {' or '.join(form.endings)}"
            if form.endings
            else "it is a folder: leave the ending out",
        )
    for camera in rig.cameras:
        if not (form.fits_lenses or isinstance(camera.lens, BrownConrady | KannalaBrandt)):
            raise DatasetError(
                f"camera {camera.name!r} has a lens of the family {camera.lens.family}, which {to} does not know.",
                why="it holds the two families of OpenCV, brown-conrady and kannala-brandt",
                fix=", ".join(["calibrate with one of these", *_imitating(rig)]),
            )
    return form.write(rig, path)


def _imitating(rig: Rig) -> list[str]:
    """The end of a cure: the formats whose own camera comes near enough to all of a rig's; empty where none does."""
    near = []
    for name, imitates in (("pose2sim", fits.fit_four_coefficients), ("dlt", fits.fit_projection_matrix)):
        with suppress(DatasetError):
            costs = [imitates(camera)[1] for camera in rig.cameras]
            if all(cost is None or cost.largest <= fits.MAX_LENS_DIFFERENCE_PX for cost in costs):
                near.append(name)
    return [f"or export to {' or '.join(near)}, which comes within {fits.MAX_LENS_DIFFERENCE_PX:g} px"] if near else []


def import_cameras(path: str | Path | Sequence[str | Path], kind: str | None = None, *, unit: str | None = None) -> Rig:
    """Read cameras from another program's files or folder.

    Args:
        path: The file or folder; or several files that belong together.
        kind: A name of `FORMATS`; None to recognise the format by the content.
        unit: The length unit, for a file that does not say it.

    Returns:
        The cameras; the rig's notes say what its reader should know.

    Raises:
        UsageError: There is no such format, or it takes one file and several are given.
        DatasetError: A file cannot be read, is not recognised, has a mistake, or states another unit.
    """
    paths = tuple(Path(one) for one in ([path] if isinstance(path, str | Path) else path))
    if not paths:
        raise UsageError("no file is given.", fix="give the file with the cameras")
    try:
        form = _find_format(kind) if kind else _recognise(Source(paths))
        rig = form.read(paths)
    except OSError as error:
        raise DatasetError(
            f"{paths[0]} cannot be read.", why=str(error), fix="check the name and the permissions"
        ) from error
    if unit is None and rig.length_unit == UNKNOWN_UNIT:
        return replace(rig, notes=(*rig.notes, "The file does not say its length unit: state it before you measure."))
    if unit is None or unit == rig.length_unit:
        return rig
    if rig.length_unit != UNKNOWN_UNIT:
        raise DatasetError(
            f"{paths[0]} is in {rig.length_unit!r}, not in {unit!r}.",
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


def _recognise(source: Source) -> Format:
    """The first format that knows what is given."""
    found = next((form for form in FORMATS.values() if form.knows(source)), None)
    if found is None:
        raise DatasetError(
            f"{source.path}: the format of these cameras is not recognised: {source.described()}.",
            why=f"read are {'; '.join(f'{name} ({entry.what})' for name, entry in FORMATS.items())}",
            fix="name the format, or export the cameras in one of these",
        )
    return found
