"""What the readers of other programs' files share: views that are added one by one, and their numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset.model import Camera, Dataset, KnownPositions, Names, Observations
from implicam.dataset.tables import naming, read_lines, read_number
from implicam.dataset.units import UNKNOWN_UNIT
from implicam.errors import DatasetError

Numbers = tuple[float, ...]


class Views:
    """Views of points by cameras, in the order in which they come."""

    def __init__(self) -> None:
        self.points: dict[str, int] = {}
        self.cameras: dict[str, int] = {}
        self._pixels: dict[tuple[int, int], tuple[float, float]] = {}
        self._texts: dict[str, dict[tuple[int, int], str]] = {}
        self._columns: dict[str, dict[int, str]] = {}
        self._positions: dict[int, Numbers] = {}

    def add(self, point: str, camera: str, pixel: tuple[float, float], place: str, **texts: str) -> None:
        """Add a view.

        Args:
            point: The point's name.
            camera: The camera's name.
            pixel: u and v as the file has them; NaN for a view that is missing.
            place: File and line, for errors.
            texts: Further columns of the view.

        Raises:
            DatasetError: The view is there already, or half of the pixel is missing.
        """
        view = self.points.setdefault(point, len(self.points)), self.cameras.setdefault(camera, len(self.cameras))
        if view in self._pixels:
            raise DatasetError(
                f"{place}: point {point!r} is seen twice by camera {camera!r}.", fix="keep one of the two"
            )
        if np.isnan(pixel[0]) != np.isnan(pixel[1]):
            raise DatasetError(
                f"{place}: point {point!r}, camera {camera!r}: u = {pixel[0]:g}, v = {pixel[1]:g}.",
                why="a view has both u and v, or neither",
                fix="correct the value, or make both NaN where the view is missing",
            )
        self._pixels[view] = pixel
        for name, text in texts.items():
            if not np.isnan(pixel[0]):
                self._texts.setdefault(name, {})[view] = text

    def describe(self, point: str, **columns: str) -> None:
        """Say something of a point that was added, such as its frame.

        Args:
            point: Its name.
            columns: Column -> text.
        """
        for name, text in columns.items():
            self._columns.setdefault(name, {})[self.points[point]] = text

    def place_point(self, point: str, position: Numbers, place: str) -> None:
        """Say where a point that was added is known to be.

        Args:
            point: Its name.
            position: x, y and z.
            place: File and line, for errors.

        Raises:
            DatasetError: It is known to be elsewhere.
        """
        known = self._positions.setdefault(self.points[point], position)
        if known != position:
            raise DatasetError(
                f"{place}: point {point!r} is at {position}, and at {known} elsewhere.",
                fix="give a point one position in all files",
            )

    def dataset(self, name: str, unit: str | None, notes: Sequence[str] = ()) -> Dataset:
        """The dataset of all views; points that no camera saw are left out, unless their positions are known.

        Args:
            name: Its name.
            unit: The length unit; None where it is not known.
            notes: What its reader should know.

        Raises:
            DatasetError: There is no view.
        """
        shape = len(self.points), len(self.cameras)
        if not self._pixels:
            raise DatasetError(f"{name} has no views.", fix="check that the files are whole")
        uv = np.full((*shape, 2), np.nan)
        for view, pixel in self._pixels.items():
            uv[view] = pixel
        extra = {name: _filled(shape, texts) for name, texts in self._texts.items()}
        points = np.array(list(self.points), dtype=np.str_)
        cameras = tuple(Camera(camera) for camera in self.cameras)
        observations = Observations(points, cameras, uv, np.full(uv.shape, np.nan), extra)
        columns = {
            name: _filled(shape[:1], {(i,): t for i, t in texts.items()}) for name, texts in self._columns.items()
        }
        if self._positions:
            xyz = np.array([self._positions[i] for i in range(len(points))], dtype=np.float64)
            known = KnownPositions(points, xyz, np.full(xyz.shape, np.nan), columns)
            return Dataset(name, unit or UNKNOWN_UNIT, observations, known, notes=tuple(notes))
        data = Dataset(name, unit or UNKNOWN_UNIT, observations, notes=tuple(notes), columns=columns)
        seen = np.asarray(observations.seen.any(axis=1), dtype=np.bool_)
        if not seen.any():
            raise DatasetError(f"{name} has no view: all pixels are missing.", fix="check that the files are whole")
        if seen.all():
            return data
        more = f"{(~seen).sum()} of {len(self.points)} points were seen by no camera, and are left out."
        return replace(data.select(seen), notes=(*data.notes, more))


def _filled(shape: tuple[int, ...], texts: Mapping[Any, str]) -> Names:
    width = max(map(len, texts.values()), default=1)
    array = np.full(shape, "", dtype=f"<U{max(width, 1)}")
    for at, text in texts.items():
        array[at] = text
    return array


def pixel_number(text: str, place: str, column: str) -> float:
    """A number of pixels, NaN where the cell is empty or says NaN.

    Args:
        text: The cell.
        place: File and line, for errors.
        column: What it is, for errors.

    Raises:
        DatasetError: It is something else.
    """
    return read_number(text, place, column, cure_nan="write NaN where the view is missing", missing=("", "nan"))


def rows_of_numbers(
    path: Path, widths: Sequence[int], columns: str, *, header: Sequence[str] = ()
) -> Iterator[tuple[str, Numbers]]:
    """The rows of a table without a header: numbers with spaces, tabs or commas between them.

    Args:
        path: The file.
        widths: How many numbers a row may have.
        columns: What they are, for the error.
        header: What a first line may be that holds no numbers, in small letters.

    Yields:
        File and line, and the numbers.

    Raises:
        DatasetError: A row has another number of cells, or something that is no number.
    """
    for line, text in enumerate(read_lines(path), 1):
        place, cells = f"{path}, line {line}", text.replace(",", " ").split()
        if not cells or (line == 1 and header and [cell.strip('"').lower() for cell in cells] == list(header)):
            continue
        if len(cells) not in widths:
            raise DatasetError(
                f"{place}: {len(cells)} cells: {text.strip()[:60]!r}.", why=f"a row is {columns}", fix="correct the row"
            )
        with naming(place):
            yield place, tuple(pixel_number(cell, place, f"cell {i}") for i, cell in enumerate(cells, 1))


def files_of(path: Path, patterns: Sequence[str], what: str) -> list[Path]:
    """The files of a folder that have such names, in the order of the names; a file is itself.

    Args:
        path: A folder or a file.
        patterns: As `Path.glob` takes them.
        what: What they are, for the error.

    Raises:
        DatasetError: There is none.
    """
    if path.is_file():
        return [path]
    found = sorted({file for pattern in patterns for file in path.glob(pattern) if file.is_file()})
    if not found:
        raise DatasetError(
            f"{path} has no {what}." if path.is_dir() else f"{path} does not exist.",
            fix=f"give the folder with the files {', '.join(patterns)}",
        )
    return found
