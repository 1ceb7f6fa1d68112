"""labels.csv: dots that a person has named in the pictures of each camera.

    point,camera,u,v[,shot]

A row without a shot is meant for every picture of its camera.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from implicam.dataset.folder import csv_text
from implicam.dataset.tables import read_name, read_number, read_table
from implicam.detect.model import View
from implicam.errors import DatasetError, did_you_mean
from implicam.formatting import list_some

Marks = Mapping[str, tuple[float, float]]
"""Pixels (u, v) of dots by point name."""

Labels = Mapping[View, Marks]
"""The marks of each camera and shot, View(camera, "") for every shot of the camera."""

LABELS_FILE = "labels.csv"

COLUMNS, SHOT = ("point", "camera", "u", "v"), "shot"

MIN_LABELS = 6
"""Labels that a camera needs."""


def read_labels(path: Path, points: Sequence[str]) -> dict[View, dict[str, tuple[float, float]]]:
    """Read labelled dots, in the order of the file.

    Args:
        path: The file.
        points: Names that there are.

    Returns:
        The marks of each camera and shot; none where the file has a header only.

    Raises:
        DatasetError: The file has a mistake; names file, line and cure.
    """
    header, rows = read_table(path, COLUMNS)
    at = {column: header.index(column) for column in header}
    index = set(points)
    labels: dict[View, dict[str, tuple[float, float]]] = {}
    for line, row in rows:
        place = f"{path}, line {line}"
        name, camera = (read_name(row[at[c]], c, place) for c in ("point", "camera"))
        if name not in index:
            raise DatasetError(
                f"{place}: point {name!r} is not in the layout{did_you_mean(name, points)}.",
                fix="correct the name, or add the point to the layout",
            )
        u, v = (read_number(row[at[c]], place, c, cure_nan="a label needs its pixel: remove the row") for c in "uv")
        marks = labels.setdefault(View(camera, row[at[SHOT]].strip() if SHOT in at else ""), {})
        if name in marks:
            raise DatasetError(f"{place}: point {name!r} of camera {camera!r} is labelled twice.", fix="remove one row")
        marks[name] = (u, v)
    return labels


def require_plain(path: Path) -> None:
    """Refuse a file that would lose something if it were written again.

    Args:
        path: The file.

    Raises:
        DatasetError: It has columns that `labels_csv` does not write; or it is no table.
    """
    header, _ = read_table(path, COLUMNS)
    others = [name for name in header if name not in (*COLUMNS, SHOT)]
    if others:
        raise DatasetError(
            f"{path} has columns that would be lost: {list_some(others)}.",
            why="every click writes the file again, with " + ", ".join((*COLUMNS, SHOT)),
            fix="give another file with --labels, or take these columns out",
        )


def labels_csv(labels: Labels) -> str:
    """The content of a file that `read_labels` reads.

    Args:
        labels: The marks of each camera and shot; a column for the shot is written where one is named.
    """
    shots = any(view.shot for view in labels)
    rows = [
        (name, view.camera, f"{u:.2f}", f"{v:.2f}", *([view.shot] if shots else []))
        for view, marks in labels.items()
        for name, (u, v) in marks.items()
    ]
    return csv_text((*COLUMNS, *([SHOT] if shots else [])), rows)
