"""Files of other programs that hold points in pictures: what each is, how it is read, and how it is written.

To add one: write a file with `read(path, positions) -> Views` and `write(data, path) -> notes`, its conventions
in its head; add it to `PROGRAMS`, to the table of docs/formats.md, and to tests/test_programs.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from implicam.dataset.marks import remove_marks
from implicam.dataset.model import Dataset
from implicam.dataset.programs import pose, ptv, xypts
from implicam.dataset.programs.views import Numbers, Views, rows_of_numbers
from implicam.dataset.table_options import TableOptions
from implicam.dataset.units import UNKNOWN_UNIT
from implicam.errors import DatasetError, UsageError, did_you_mean
from implicam.files import is_file_name

__all__ = ["PROGRAMS", "Program", "read_program", "write_program"]


@dataclass(frozen=True)
class Program:
    """How a program's files are read and written, what they are, and how it counts the first pixel."""

    read: Callable[[Path, Sequence[Numbers]], Views]
    write: Callable[[Dataset, Path], list[str]]
    what: str
    first_pixel: int = 0
    folder: bool = False


PROGRAMS = {
    "dltdv": Program(xypts.read_dltdv, xypts.write_dltdv, "xypts.csv of DLTdv", 1),
    "easywand": Program(xypts.read_dltdv, xypts.write_dltdv, "xypts.csv, as easyWand takes it", 1),
    "argus": Program(xypts.read_argus, xypts.write_argus, "xypts.csv of Argus"),
    "myptv": Program(ptv.read_myptv, ptv.write_myptv, "a folder of cal_points of MyPTV", folder=True),
    "openptv": Program(ptv.read_openptv, ptv.write_openptv, "a folder of .fix and .crd of OpenPTV", folder=True),
    "deeplabcut": Program(
        pose.read_deeplabcut, pose.write_deeplabcut, "a folder of tables of DeepLabCut, one a camera", folder=True
    ),
    "sleap": Program(
        pose.read_sleap, pose.write_sleap, "a folder of analysis tables of SLEAP, one a camera", folder=True
    ),
}


def read_program(
    path: str | Path, kind: str, options: TableOptions | None = None, positions: str | Path | None = None
) -> Dataset:
    """Read points in pictures from the files of another program.

    Args:
        path: The file or folder.
        kind: A name of `PROGRAMS`.
        options: The unit, and how pixels are counted, where it is not as the program does.
        positions: A file of known positions, x, y, z in each row, with or without a line x,y,z above them; None where
            there is none.

    Raises:
        UsageError: There is no such program.
        DatasetError: The files have a mistake, or the unit of known positions is not stated.
    """
    program, path, options = _find(kind), Path(path), options or TableOptions()
    known = [] if positions is None else _read_positions(Path(positions))
    try:
        data = program.read(path, known).dataset(path.stem, options.unit)
    except OSError as error:
        raise DatasetError(f"{path} cannot be read.", why=str(error), fix="check the name") from error
    if data.known is not None and data.length_unit == UNKNOWN_UNIT:
        raise DatasetError(f"{path}: the length unit of x, y, z is not stated.", fix="add --unit mm")
    first = program.first_pixel if options.first_pixel is None else options.first_pixel
    return replace(options, first_pixel=first).apply(remove_marks(data))


def write_program(data: Dataset, path: str | Path, kind: str) -> list[str]:
    """Write points in pictures as another program has them; pixels are counted as it does.

    Args:
        data: The dataset.
        path: The file or folder.
        kind: A name of `PROGRAMS`.

    Returns:
        What the format could not hold, in sentences.

    Raises:
        UsageError: There is no such program, or the name has the ending of something else.
        DatasetError: The format cannot hold the dataset.
        ImplicamError: The files cannot be written.
    """
    program, path = _find(kind), Path(path)
    if is_file_name(path) and not path.is_dir() and (program.folder or path.suffix.lower() not in (".csv", ".txt")):
        raise UsageError(
            f"{path}: {program.what} is not written as {path.suffix}.",
            fix="it is a folder: leave the ending out" if program.folder else "end the name in .csv",
        )
    cameras = tuple(replace(camera, width=None, height=None) for camera in data.cameras)  # pixels from 1 may be outside
    observations = replace(data.observations, cameras=cameras, uv=data.observations.uv + program.first_pixel)
    return program.write(replace(data, observations=observations), path)


def _find(kind: str) -> Program:
    if kind not in PROGRAMS:
        raise UsageError(
            f"there is no program {kind!r}{did_you_mean(kind, PROGRAMS)}.",
            fix=f"choose one of {'; '.join(f'{name} ({one.what})' for name, one in PROGRAMS.items())}",
        )
    return PROGRAMS[kind]


def _read_positions(path: Path) -> list[Numbers]:
    if not path.is_file():
        raise DatasetError(f"{path} does not exist.", fix="give a file of x, y, z, a row for each known point")
    found = list(rows_of_numbers(path, (3,), "x, y, z", header=["x", "y", "z"]))
    for place, position in found:
        if any(value != value for value in position):
            raise DatasetError(f"{place}: a known position has no number.", fix="fill it in, or remove the point")
    return [position for _, position in found]
