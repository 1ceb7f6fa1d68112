"""`deeplabcut` and `sleap`: key points of animals, one table for each camera, a row a frame.

DeepLabCut has three lines of headings (scorer, bodyparts, coords; with several animals a line individuals), and columns
x, y, likelihood for each body part. SLEAP has one: track, frame_idx, instance.score, NODE.x, NODE.y, NODE.score. Both
count the first pixel as 0. A body part without pixels is missing, whatever its likelihood says.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from implicam.dataset.folder import csv_text, format_cells
from implicam.dataset.model import Dataset
from implicam.dataset.programs.views import Numbers, Views, files_of, pixel_number
from implicam.dataset.tables import check_width, split_lines
from implicam.errors import DatasetError
from implicam.files import write_text

ONLY_MARKER = "point"


def read_deeplabcut(path: Path, positions: Sequence[Numbers]) -> Views:
    """Read the tables of DeepLabCut; the camera is the file's name before "DLC".

    Args:
        path: The folder, with the files of cameras that ran in step.
        positions: None: key points have no known positions.

    Raises:
        DatasetError: A file is none of DeepLabCut, or a cell is no number.
    """
    _refuse_positions(positions)
    views = Views()
    for camera, file in _one_a_camera(path, lambda file: re.split("DLC", file.stem)[0].rstrip("_- ") or file.stem):
        rows = list(split_lines(file))
        heads = {row[0].strip().lower(): row for _, row in rows[:4]}
        if "bodyparts" not in heads or "coords" not in heads:
            raise DatasetError(
                f"{file} is no table of DeepLabCut.",
                why="its first lines do not begin with scorer, bodyparts and coords",
                fix="give the folder with the .csv of each camera, and no other",
            )
        parts = heads["bodyparts"]
        first = next((i for i, cell in enumerate(heads["coords"]) if cell.strip().lower() == "x"), len(parts))
        animals = heads.get("individuals", [""] * len(parts))
        at = {(animals[i].strip(), parts[i].strip(), heads["coords"][i].strip()): i for i in range(first, len(parts))}
        body = rows[len([name for name in ("scorer", "individuals", "bodyparts", "coords") if name in heads]) :]
        for line, row in check_width(f"{file}, line", len(parts), body):
            frame = row[first - 1].strip()
            for animal, part, _ in (key for key in at if key[2] == "x"):
                name = " ".join(word for word in (frame, animal, part) if word)
                _add(views, name, camera, f"{file}, line {line}", {
                    axis: row[at[animal, part, axis]] for axis in ("x", "y", "likelihood") if (animal, part, axis) in at
                })  # fmt: skip
                views.describe(name, frame=frame, marker=" ".join(word for word in (animal, part) if word))
    return views


def read_sleap(path: Path, positions: Sequence[Numbers]) -> Views:
    """Read the analysis tables of SLEAP; the camera is the file's name, of LABELS.000_VIDEO.analysis.csv the video's.

    Args:
        path: The folder, with the files of cameras that ran in step.
        positions: None: key points have no known positions.

    Raises:
        DatasetError: A file is none of SLEAP, or a cell is no number.
    """
    _refuse_positions(positions)
    views = Views()
    for camera, file in _one_a_camera(path, _video_of_sleap):
        rows = list(split_lines(file))
        header = [cell.strip() for cell in rows[0][1]] if rows else []
        nodes = [column[:-2] for column in header if column.endswith(".x")]
        if "frame_idx" not in header or not nodes or any(f"{node}.y" not in header for node in nodes):
            raise DatasetError(
                f"{file} is no analysis table of SLEAP.",
                why="it has no columns frame_idx, NODE.x and NODE.y",
                fix="give the folder with the analysis .csv of each camera, and no other",
            )
        for line, row in check_width(f"{file}, line", len(header), rows[1:]):
            cells = dict(zip(header, row, strict=True))
            frame, track = cells["frame_idx"].strip(), cells.get("track", "").strip()
            for node in nodes:
                name = " ".join(word for word in (frame, track, node) if word)
                values = {"x": cells[f"{node}.x"], "y": cells[f"{node}.y"]}
                values |= {"likelihood": cells[f"{node}.score"]} if f"{node}.score" in cells else {}
                _add(views, name, camera, f"{file}, line {line}", values)
                views.describe(name, frame=frame, marker=" ".join(word for word in (track, node) if word))
    return views


def _one_a_camera(path: Path, camera_of: Callable[[Path], str]) -> list[tuple[str, Path]]:
    """The tables of a folder, each with its camera."""
    found: dict[str, Path] = {}
    for file in files_of(path, ["*.csv"], "tables (.csv)"):
        first = found.setdefault(camera_of(file), file)
        if first != file:
            raise DatasetError(
                f"{first} and {file.name} are both of camera {camera_of(file)!r}.",
                why="DeepLabCut leaves what it filtered beside what it found" if "_filtered" in file.stem else "",
                fix=f"keep one of each camera in the folder: move {file.name}, and others like it, to another",
            )
    return list(found.items())


def _video_of_sleap(file: Path) -> str:
    video = re.search(r"(?:^|\.)\d{3}_(.+)\.analysis$", file.stem)
    return video[1] if video else file.stem.removesuffix(".analysis")


def write_deeplabcut(data: Dataset, path: Path) -> list[str]:
    """Write a table for each camera, CAMERADLC.csv, as DeepLabCut has them for one animal.

    Args:
        data: The dataset; its columns `frame` and `marker` say what each point is. Without them a point is a frame.
        path: The folder.

    Returns:
        What it could not hold, in sentences.

    Raises:
        ImplicamError: A file cannot be written.
    """
    key_points = _KeyPoints(data)
    head = [
        ["scorer", *["implicam"] * (3 * len(key_points.markers))],
        ["bodyparts", *(marker for marker in key_points.markers for _ in range(3))],
        ["coords", *["x", "y", "likelihood"] * len(key_points.markers)],
    ]
    for c, camera in enumerate(data.observations.camera_names):
        write_text(path / f"{camera}DLC.csv", csv_text(head[0], [*head[1:], *key_points.rows(c)]))
    return key_points.notes


def write_sleap(data: Dataset, path: Path) -> list[str]:
    """Write a table for each camera, CAMERA.csv, as SLEAP exports the analysis of one animal.

    Args:
        data: The dataset; its columns `frame` and `marker` say what each point is. Without them a point is a frame.
        path: The folder.

    Returns:
        What it could not hold, in sentences.

    Raises:
        ImplicamError: A file cannot be written.
    """
    key_points = _KeyPoints(data)
    header = ["track", "frame_idx", "instance.score"]
    header += [f"{marker}.{axis}" for marker in key_points.markers for axis in ("x", "y", "score")]
    for c, camera in enumerate(data.observations.camera_names):
        rows = [["", row[0], "", *row[1:]] for row in key_points.rows(c)]
        write_text(path / f"{camera}.csv", csv_text(header, rows))
    return key_points.notes


class _KeyPoints:
    """The points of a dataset as markers in frames, and what such a table cannot hold."""

    def __init__(self, data: Dataset) -> None:
        columns = data.columns if data.known is None else data.known.extra
        self._data, self.notes = data, []
        at = list(zip(columns.get("frame", ()), columns.get("marker", ()), strict=True))
        if len(set(at)) == len(data) and all(frame.isdecimal() and marker for frame, marker in at):
            frames, of_points = [int(frame) for frame, _ in at], [str(marker) for _, marker in at]
        else:
            frames, of_points = list(range(len(data))), [ONLY_MARKER] * len(data)
            self.notes.append(
                f"Each point is a frame, numbered from 0, of one marker {ONLY_MARKER!r}; names of points are lost."
            )
        if data.known is not None:
            self.notes.append("Known positions are not in it: keep the dataset for them.")
        self.markers = list(dict.fromkeys(of_points))
        self._frames = sorted(set(frames))
        row = {frame: i for i, frame in enumerate(self._frames)}
        self._at = [row[frame] for frame in frames], [self.markers.index(marker) for marker in of_points]

    def rows(self, camera: int) -> list[list[str]]:
        """Of each frame its number, then u, v and the likelihood of each marker, empty where it was not seen."""
        observations = self._data.observations
        stated = observations.extra.get("likelihood")
        likelihood = stated[:, camera] if stated is not None else np.full(len(self._data), "")
        pixels, seen = observations.uv[:, camera], observations.seen[:, camera]
        cells = [[["", "", ""] for _ in self.markers] for _ in self._frames]
        for i, (frame, marker) in enumerate(zip(*self._at, strict=True)):
            if seen[i]:
                cells[frame][marker] = [*format_cells(pixels[i]), str(likelihood[i]) or "1"]
        return [
            [str(frame), *(cell for three in row for cell in three)]
            for frame, row in zip(self._frames, cells, strict=True)
        ]


def _add(views: Views, name: str, camera: str, place: str, cells: dict[str, str]) -> None:
    if "y" not in cells:
        raise DatasetError(f"{place}: {name!r} has x and no y.", fix="give the table as the program wrote it")
    pixel = pixel_number(cells.pop("x"), place, "x"), pixel_number(cells.pop("y"), place, "y")
    views.add(name, camera, pixel, place, **{key: text.strip() for key, text in cells.items()})


def _refuse_positions(positions: Sequence[Numbers]) -> None:
    if positions:
        raise DatasetError("the key points of animals have no known positions.", fix="leave out --positions")
