"""Dots at known positions on a target, as particle-tracking labs photograph it.

A person labels six or more dots per camera, to a pixel or two (`labels.py`; `implicam label` is the page for it), and
the search finds the others from there (`dot_search.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import KnownPositions
from implicam.dataset.folder import POINTS, read_points
from implicam.detect.dot_search import DotSearch
from implicam.detect.labels import LABELS_FILE, MIN_LABELS, Labels, read_labels
from implicam.detect.model import Detected, DetectorBase, View, nothing
from implicam.errors import DatasetError, UsageError, did_you_mean
from implicam.formatting import list_some
from implicam.images import Grey
from implicam.registry import Option

Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Dots(DetectorBase):
    """Finds the dots of a target.

    points: n names and `known`, where they are; labels: pixels (u, v) of dots by point name, for each camera and shot,
    View(camera, "") for every shot of the camera. polarity: "bright" dots, "dark" ones, or what most labels show.
    Where the layout has several shots (plates), a picture is searched for the points of its own.
    """

    moves: ClassVar[bool] = False

    points: tuple[str, ...]
    known: KnownPositions
    labels: Labels
    polarity: str = "auto"

    def __post_init__(self) -> None:
        if self.polarity not in ("auto", "bright", "dark"):
            raise UsageError(
                f"there is no polarity {self.polarity!r}.",
                fix='dots are "bright" or "dark"; "auto" looks at the labels',
            )
        for view, marks in self.labels.items():
            for name in marks:
                if name not in self.points:
                    raise DatasetError(
                        f"the labels of camera {view.camera!r} name the point {name!r}, which is not in the layout"
                        f"{did_you_mean(name, self.points)}.",
                        fix="correct the name, or add the point to the layout",
                    )

    @classmethod
    def from_files(cls, layout: str | Path, labels: str | Path, *, polarity: str = "auto") -> Self:
        """Make the detector from a layout and labels.

        Args:
            layout: A table with the columns of points.csv.
            labels: A table with the columns point, camera, u, v in pixels, and perhaps shot.
            polarity: "bright", "dark" or "auto".

        Raises:
            DatasetError: A file has a mistake; names file, line and cure.
            UsageError: There is no such polarity.
        """
        points, known = read_points(Path(layout))
        marks = read_labels(Path(labels), points)
        if not marks:
            raise DatasetError(
                f"{labels} has a header and no rows.", fix=f"label {MIN_LABELS} dots or more for each camera"
            )
        return cls(tuple(points), known, marks, polarity)

    @classmethod
    def from_options(
        cls,
        dataset: Path,
        described: Mapping[str, Any],
        *,
        layout: Annotated[Path | None, Option("where they are (default DATASET/points.csv)", "FILE")] = None,
        labels: Annotated[Path | None, Option("six or more named (default DATASET/labels.csv)", "FILE")] = None,
    ) -> Dots:
        """Make the detector from the options of the command line.

        Args:
            dataset: The dataset's folder.
            described: The table [target] of dataset.toml; nothing of it is used here.
            layout: A table with the columns of points.csv; None for the dataset's own. A name that is not here may be
                that of a file in the dataset.
            labels: A table of labelled dots, as `layout`; None for labels.csv of the dataset.

        Raises:
            UsageError: There are no labels.
            DatasetError: A file has a mistake; names file, line and cure.
        """
        labels = file_of(dataset, labels, LABELS_FILE)
        if not labels.exists():
            raise UsageError(
                f"{labels} does not exist.",
                why="six or more dots of each camera must be named by a person",
                fix=f"run implicam label {dataset} and click them, or write {labels}: point,camera,u,v, a row for each "
                "labelled dot; a pixel or two off will do",
            )
        return cls.from_files(file_of(dataset, layout, POINTS), labels)

    def options(self) -> dict[str, Any]:
        """Layout, labels and polarity as plain values."""
        marks = [[*view, name, *uv] for view, named in self.labels.items() for name, uv in named.items()]
        layout = {"points": list(self.points), "shots": self.known.shots.tolist(), "xyz": self.known.xyz.tolist()}
        return {"target": "dots", "layout": layout, "labels": marks, "polarity": self.polarity}

    def detect(self, picture: Grey, view: View) -> Detected:
        """Find the dots in one picture.

        Args:
            picture: (height, width) grey from 0 to 1.
            view: Which picture it is; its camera has labels, and where the layout has several shots, it is one of them.

        Returns:
            The dots found, or the reason why there are none. Notes: "labelled", "missing" (where those not found are
            predicted), "scale" in pixels.
        """
        rows = rows_of(self.known, view.shot)
        if not len(rows):
            shots = sorted(set(self.known.shots.tolist()))
            return nothing(
                f"the layout has no shot {view.shot!r}{did_you_mean(view.shot, shots)}; it has {list_some(shots)}: "
                "name the picture after one of them, or correct the layout's column shot"
            )
        names = [self.points[row] for row in rows]
        marks = self._labels_of(view, names)
        if len(marks) < MIN_LABELS:
            return nothing(
                f"{len(marks)} labelled dots for camera {view.camera!r} in shot {view.shot!r}, but it takes "
                f"{MIN_LABELS}: label more dots, spread over the target and its depths"
            )
        search = DotSearch.begin(picture, names, self.known.xyz[rows], marks, self.polarity)
        if isinstance(search, str):
            return nothing(search)
        search.grow()
        doubt = search.explain_doubt()
        return nothing(doubt) if doubt else search.result()

    def _labels_of(self, view: View, names: Sequence[str]) -> dict[int, tuple[float, float]]:
        marks = {**self.labels.get(View(view.camera, ""), {}), **self.labels.get(view, {})}
        index = {name: i for i, name in enumerate(names)}
        return {index[name]: uv for name, uv in marks.items() if name in index}


def rows_of(known: KnownPositions, shot: str) -> Ints:
    """Which points a picture may show.

    Args:
        known: The layout.
        shot: Of the picture; it matters where the layout has several.

    Returns:
        (k,) rows of the layout; none where it has no such shot.
    """
    shots = known.shots
    return np.arange(len(shots)) if (shots == shots[0]).all() else np.flatnonzero(shots == shot)


def file_of(dataset: Path, given: Path | None, name: str) -> Path:
    """A file that was given by name, from where the command runs or from the dataset.

    Args:
        dataset: The dataset's folder.
        given: What was given; None for the file `name` of the dataset.
        name: Of the dataset's own file.
    """
    if given is None:
        return dataset / name
    return given if given.exists() or not (dataset / given).exists() else dataset / given
