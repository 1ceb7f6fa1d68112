"""`deeplabcut` and `sleap`: key points of animals, one table for each camera, a row a frame.

DeepLabCut has three lines of headings (scorer, bodyparts, coords; with several animals a line individuals), and columns
x, y, likelihood for each body part. SLEAP has one: track, frame_idx, instance.score, NODE.x, NODE.y, NODE.score. Both
count the first pixel as 0. A body part without pixels is missing, whatever its likelihood says.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from implicam.dataset.programs.views import Numbers, Views, files_of, pixel_number
from implicam.dataset.tables import check_width, split_lines
from implicam.errors import DatasetError


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
    for file in files_of(path, ["*.csv"], "tables (.csv)"):
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
                _add(views, name, re.split("DLC", file.stem)[0].rstrip("_- ") or file.stem, f"{file}, line {line}", {
                    axis: row[at[animal, part, axis]] for axis in ("x", "y", "likelihood") if (animal, part, axis) in at
                })  # fmt: skip
                views.describe(name, frame=frame, marker=" ".join(word for word in (animal, part) if word))
    return views


def read_sleap(path: Path, positions: Sequence[Numbers]) -> Views:
    """Read the analysis tables of SLEAP; the camera is the file's name.

    Args:
        path: The folder, with the files of cameras that ran in step.
        positions: None: key points have no known positions.

    Raises:
        DatasetError: A file is none of SLEAP, or a cell is no number.
    """
    _refuse_positions(positions)
    views = Views()
    for file in files_of(path, ["*.csv"], "tables (.csv)"):
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
                _add(views, name, file.stem, f"{file}, line {line}", values)
                views.describe(name, frame=frame, marker=" ".join(word for word in (track, node) if word))
    return views


def _add(views: Views, name: str, camera: str, place: str, cells: dict[str, str]) -> None:
    if "y" not in cells:
        raise DatasetError(f"{place}: {name!r} has x and no y.", fix="give the table as the program wrote it")
    pixel = pixel_number(cells.pop("x"), place, "x"), pixel_number(cells.pop("y"), place, "y")
    views.add(name, camera, pixel, place, **{key: text.strip() for key, text in cells.items()})


def _refuse_positions(positions: Sequence[Numbers]) -> None:
    if positions:
        raise DatasetError("the key points of animals have no known positions.", fix="leave out --positions")
