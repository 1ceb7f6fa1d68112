"""Correspondences: read, check, split, join, write."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from implicam.dataset.copies import describe_copies, find_copies, remove_copies
from implicam.dataset.folder import folder_files, read_folder, write_folder
from implicam.dataset.joining import join
from implicam.dataset.marks import remove_marks
from implicam.dataset.model import (
    TRUTH_COLUMNS,
    Camera,
    Dataset,
    Floats,
    KnownPositions,
    Names,
    Observations,
    Truth,
    covariance_from_columns,
)
from implicam.dataset.table_options import TableOptions, size_text
from implicam.dataset.units import UNKNOWN_UNIT, refuse_length_unit
from implicam.dataset.wide import (
    arrays_from_dataset,
    dataset_from_arrays,
    read_excel_workbook,
    read_npz_dataset,
    read_parquet,
    read_wide_csv,
    write_excel_workbook,
    write_npz_dataset,
    write_parquet,
    write_wide_csv,
)
from implicam.errors import DatasetError
from implicam.files import find_left_behind, is_file_name

__all__ = [
    "TRUTH_COLUMNS",
    "Camera",
    "Dataset",
    "Floats",
    "KnownPositions",
    "Names",
    "Observations",
    "TableOptions",
    "Truth",
    "arrays_from_dataset",
    "covariance_from_columns",
    "dataset_from_arrays",
    "describe_copies",
    "find_copies",
    "folder_files",
    "join",
    "read_dataset",
    "remove_copies",
    "write_dataset",
]


TEXT_SUFFIXES = (".csv", ".tsv", ".txt")
OTHER_WORKBOOKS = (".xls", ".xlsm", ".xlsb", ".ods", ".numbers")


def read_dataset(
    path: str | Path,
    *,
    unit: str | None = None,
    first_pixel: int | None = None,
    v_up: bool = False,
    size: str | tuple[int, int] | Mapping[str, tuple[int, int]] | None = None,
    cameras: Sequence[str] = (),
    length_unit: None = None,
) -> Dataset:
    """Read a dataset from a folder, a .csv, .tsv or .txt, an .xlsx, a .parquet or an .npz.

    Args:
        path: The folder or file.
        unit: The length unit of a table without a description; None to use the unit that the data state.
        first_pixel: How the file counts the centre of the first pixel, 0 or 1; None for 0.
        v_up: Whether it counts v from the bottom row upwards.
        size: Width and height of the pictures, for all cameras or for each by name; None to use what the data state.
        cameras: Names that cameras are known to have, those of a calibration say: in a table of pixels alone, headings
            x1, y1 are then of camera 1, and of no marker.
        length_unit: Not used: it is `unit` here.

    Returns:
        The dataset, with marks for missing views read as missing, and pixels counted as docs/conventions.md says.

    Raises:
        DatasetError: If something is wrong, or the data state another unit; names file, line, value and cure.
        UsageError: If the options contradict the data.

    >>> import implicam as ic
    >>> import tempfile
    >>> from pathlib import Path
    >>> folder = Path(tempfile.mkdtemp()) / "rig"
    >>> ic.write_dataset(ic.simulated("stereo", points=30, seed=1), folder)
    >>> len(ic.read_dataset(folder))
    30
    """
    refuse_length_unit(length_unit)
    path = Path(path)
    options = TableOptions(unit, first_pixel, v_up, size_text(size))
    try:
        data = _read(path, unit, tuple(cameras))
    except OSError as error:  # permissions, a broken disk, a name too long
        raise DatasetError(
            f"{path} cannot be read.", why=str(error), fix="check the name and the permissions"
        ) from error
    if unit is not None and data.length_unit != unit and data.length_unit == UNKNOWN_UNIT:
        data = replace(data, length_unit=unit)
    if unit is not None and data.length_unit != unit:
        raise DatasetError(
            f"{path} is in {data.length_unit!r}, not in {unit!r}.",
            why="its own description states the length unit",
            fix="leave out --unit, or correct the description",
        )
    return options.apply(remove_marks(data))  # a mark is one as the file has it


def _read(path: Path, unit: str | None, cameras: tuple[str, ...]) -> Dataset:
    suffix = path.suffix.lower()
    if path.is_dir():
        return read_folder(path)
    if suffix in TEXT_SUFFIXES:
        return read_wide_csv(path, unit, cameras)
    if suffix == ".parquet":
        return read_parquet(path, unit, cameras)
    if suffix == ".xlsx":
        return read_excel_workbook(path, unit, cameras)
    if suffix == ".npz":
        return read_npz_dataset(path)
    old = find_left_behind(path)
    if old:
        raise DatasetError(
            f"{path} does not exist.", why="a program was killed while replacing it", fix=f"rename {old} to {path.name}"
        )
    raise DatasetError(
        f"{path} is not a dataset." if path.exists() else f"{path} does not exist.",
        why="" if path.exists() else f"the working folder is {Path.cwd()}",
        fix="save it as .xlsx or as CSV"
        if suffix in OTHER_WORKBOOKS
        else "give a folder with dataset.toml, or a .csv, .tsv, .xlsx, .parquet or .npz file; see docs/formats.md",
    )


def write_dataset(
    data: Dataset,
    path: str | Path,
    *,
    overwrite: bool = False,
    also: Mapping[str, str] | None = None,
    fill: Callable[[Path], None] | None = None,
) -> None:
    """Write a dataset completely or not at all.

    Args:
        data: The dataset.
        path: Where to; .csv, .xlsx, .parquet and .npz make a file, any other ending makes a folder.
        overwrite: Whether an existing dataset folder may be replaced.
        also: Text files to add to a folder: relative name -> text.
        fill: Called with the temporary folder to write more into it, before it is renamed.

    Raises:
        DatasetError: If this form cannot hold the dataset, or the folder must not be replaced.

    >>> import implicam as ic
    >>> import tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp()) / "rig.csv"
    >>> ic.write_dataset(ic.simulated("stereo", points=30, seed=1), path)
    >>> path.exists()
    True
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".csv":
        write_wide_csv(data, path)
    elif suffix == ".xlsx":
        write_excel_workbook(data, path)
    elif suffix == ".parquet":
        write_parquet(data, path)
    elif suffix == ".npz":
        write_npz_dataset(data, path)
    elif is_file_name(path) and not path.is_dir():
        raise DatasetError(
            f"{path}: no dataset is written as {suffix}.",
            fix="end the name in .csv, .xlsx, .parquet or .npz, or in nothing for a folder",
        )
    else:
        write_folder(data, path, overwrite=overwrite, also=also, fill=fill)
