"""Naming dots in pictures by hand: what the page of `implicam label` shows and keeps.

A click is moved to the middle of the dot that is there, and is in labels.csv before anything else happens. From four
labels on the search of `detect` says where the others are, so that the fifth and sixth are a matter of agreeing, and a
wrong name shows at once.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from implicam.dataset import Floats, KnownPositions
from implicam.dataset.folder import DESCRIPTION, POINTS, read_description, read_points
from implicam.detect.blobs import find_spot_near
from implicam.detect.dot_search import DotSearch
from implicam.detect.dots import file_of, rows_of
from implicam.detect.folder import pictures_of
from implicam.detect.labels import LABELS_FILE, Labels, labels_csv, read_labels, require_plain
from implicam.detect.model import View
from implicam.errors import DatasetError, ImplicamError, UsageError, did_you_mean
from implicam.files import write_text
from implicam.formatting import list_some
from implicam.images import Grey, read_picture

MIN_LABELS_TO_GUESS = 4
"""Labels from which the places of other dots are guessed."""

MIN_APART_PX = 2.0
"""Pixels: two labels that are closer name the same dot."""

MIN_SCALE_LIMIT_PX, MAX_SCALE_LIMIT_PX = 1.5, 16.0
"""Pixels: between them is the largest scale of dots, an eighth of the way to the next if they fill the picture."""

MAX_WITHIN_PX = 40.0
"""Pixels: no click means a dot that is farther off, nor one that is as far as the next one may be."""

FAR_FROM_HIDDEN = 0.3
"""Of the diagonal of the drawing: how far a dot that cannot be seen makes others less likely to be proposed."""

TURNS: tuple[tuple[tuple[int, int], tuple[int, int]], ...] = tuple(
    (row, other)
    for row in ((1, 0), (-1, 0), (0, 1), (0, -1))
    for other in ((1, 0), (-1, 0), (0, 1), (0, -1))
    if row[0] * other[1] - row[1] * other[0]
)
"""Ways to lay a drawing down: what of its two axes goes right, and what goes down."""

UPRIGHT = ((1, 0), (0, -1))
"""Of these, the first axis to the right and the second upwards."""


class Guess(NamedTuple):
    """What the search makes of the labels of a picture.

    dots: name -> (u, v, sd) in pixels of every dot that the picture must show. found: those at whose place there is a
    spot, those that `detect` will find if there are labels enough. unsure: those whose place may be that of another.
    outside: how many dots lie outside the picture. lost: labels at which there is no spot. suspect: labels that the
    others contradict. doubt: why nothing of this is to be believed; empty where it is.
    """

    dots: Mapping[str, tuple[float, float, float]] = {}
    found: Collection[str] = ()
    unsure: Collection[str] = ()
    outside: int = 0
    lost: Collection[str] = ()
    suspect: Collection[str] = ()
    doubt: str = ""


@dataclass(eq=False)
class Labelling:
    """The labels of a dataset's pictures; make it with `open`. Several threads may use it.

    points: n names and `known`, where they are. pictures: the file of each picture to label, View(camera, "") where one
    stands for all shots of its camera. path: labels.csv, written at every change. name, unit: of the dataset. notes:
    what there is to say about how the pictures were found.
    """

    points: tuple[str, ...]
    known: KnownPositions
    pictures: Mapping[View, Path]
    path: Path
    name: str
    unit: str
    notes: tuple[str, ...] = ()
    _labels: Labels = field(default_factory=dict)
    _before: list[tuple[View, Labels]] = field(default_factory=list)
    _skipped: dict[View, set[str]] = field(default_factory=dict)
    _stamp: tuple[int, int] | None = None
    _lock: threading.RLock = field(default_factory=threading.RLock)

    @classmethod
    def open(
        cls,
        dataset: Path,
        *,
        layout: Path | None = None,
        labels: Path | None = None,
        pictures: str | None = None,
        pattern: str | None = None,
    ) -> Labelling:
        """Open a dataset for labelling, with the labels that it has.

        Args:
            dataset: The folder with the photographs.
            layout: A table with the columns of points.csv; None for the dataset's own.
            labels: The file to go on with, or to make; None for labels.csv of the dataset.
            pictures: The folder of the pictures, below `dataset`, as `pictures_of` takes it.
            pattern: How their names tell camera and shot, as `pictures_of` takes it.

        Raises:
            UsageError: There is no such folder.
            DatasetError: The layout or the labels have a mistake, or no picture belongs to them.
            ImageError: There are no pictures.
        """
        if not dataset.is_dir():
            raise UsageError(f"{dataset} is not a folder.", fix="give the folder that holds images/<camera>/<shot>.png")
        points, known = read_points(file_of(dataset, layout, POINTS))
        described = read_description(dataset) if (dataset / DESCRIPTION).exists() else None
        cameras = [camera.name for camera in described[2]] if described else []
        found, notes = pictures_of(dataset, pictures, pattern, cameras)
        usable = {camera: shots for camera, shots in found.items() if not cameras or camera in cameras}
        made = cls(
            tuple(points),
            known,
            _pictures_to_label(usable, known, list(found), cameras),
            file_of(dataset, labels, LABELS_FILE),
            described[0] if described else dataset.resolve().name,
            described[1] if described else "",
            notes,
        )
        made.refresh()
        return made

    def rows(self, view: View) -> list[int]:
        """Which rows of the layout a picture may show.

        Args:
            view: One of `pictures`.
        """
        return [int(row) for row in rows_of(self.known, view.shot)]

    def marks(self, view: View) -> dict[str, tuple[float, float]]:
        """The labels of a picture, in the order in which they were made.

        Args:
            view: One of `pictures`.
        """
        with self._lock:
            every, own = self._labels.get(View(view.camera, ""), {}), self._labels.get(view, {})
        names = {self.points[row] for row in self.rows(view)}
        return {name: uv for name, uv in {**every, **own}.items() if name in names}

    @property
    def can_undo(self) -> bool:
        """Whether something was changed since the start that can be taken back."""
        return bool(self._before)

    def refresh(self) -> bool:
        """Read the file again where another program has changed it; whether it had.

        Raises:
            DatasetError: It has a mistake now.
        """
        with self._lock:
            stamp = _stamp_of(self.path)
            if stamp == self._stamp:
                return False
            labels: Labels = {}
            if stamp is not None:
                require_plain(self.path)
                labels = read_labels(self.path, self.points)
            self._labels, self._stamp = labels, stamp
            self._before.clear()
            return True

    def place(self, view: View, point: str, uv: Floats, within: float) -> bool:
        """Label a dot, and save it.

        Args:
            view: One of `pictures`.
            point: The name of the dot.
            uv: (2,) pixel that was pointed at.
            within: The label goes to the middle of the spot that is so many pixels away at most; less where dots are
                dense.

        Returns:
            Whether there is one; without, the label is where it was pointed at.

        Raises:
            UsageError: The picture does not show such a point, or this dot has another name.
            ImplicamError: The labels cannot be saved.
        """
        self._check(view, point)
        picture = self.picture(view)
        if not ((uv > -0.5) & (uv < np.array(picture.shape)[::-1] - 0.5)).all():
            raise UsageError("this is outside the picture.", fix="click on a dot")
        others = {name: at for name, at in self.marks(view).items() if name != point}
        like = np.array(list(others.values())).reshape(-1, 2)
        step = float(np.hypot(*picture.shape) / np.sqrt(len(self.rows(view))))
        largest = float(np.clip(step / 8, MIN_SCALE_LIMIT_PX, MAX_SCALE_LIMIT_PX))
        spot = find_spot_near(picture, uv, min(within, max(step / 8, 4), MAX_WITHIN_PX), like=like, largest=largest)
        at = uv if spot is None else spot
        for name, other in others.items():
            if np.linalg.norm(at - other) < MIN_APART_PX:
                raise UsageError(
                    f"this dot is {name} already.", why=f"you chose {point}", fix=f"delete {name}, or click elsewhere"
                )
        self._change(view, point, (round(float(at[0]), 2), round(float(at[1]), 2)))
        return spot is not None

    def remove(self, view: View, point: str) -> None:
        """Take a label away, and save that.

        Args:
            view: One of `pictures`.
            point: The name of the dot.

        Raises:
            UsageError: There is no such label.
            ImplicamError: The labels cannot be saved.
        """
        self._check(view, point)
        if point not in self.marks(view):
            raise UsageError(f"{point} has no label here.", fix="choose one that has")
        self._change(view, point, None)

    def undo(self) -> View | None:
        """Take the last change back, and save that; the picture it was in, None where there is none.

        Raises:
            ImplicamError: The labels cannot be saved.
        """
        with self._lock:
            self.refresh()
            if not self._before:
                return None
            view, labels = self._before[-1]
            self._save(labels)
            self._before.pop()
            return view

    def skip(self, view: View, point: str) -> None:
        """Do not propose a dot any more: it cannot be seen.

        Args:
            view: One of `pictures`.
            point: The name of the dot.
        """
        self._check(view, point)
        self._skipped.setdefault(view, set()).add(point)

    def propose(self, view: View, guess: Guess = Guess()) -> str | None:  # noqa: B008  a frozen value
        """The dot whose label would tell most beside those there are; None where each has one.

        That is the one of the largest leverage in an affine map, among those that can be seen, as far as is known. The
        first three are the corners of the drawing, which people find; depths come after them. What lies near dots that
        cannot be seen is less likely to be seen.

        Args:
            view: One of `pictures`.
            guess: What `guess` gave for it.
        """
        rows, marks = self.rows(view), self.marks(view)
        xyz = self.known.xyz[rows]
        spread = xyz.std(axis=0)
        features = np.column_stack([np.ones(len(xyz)), (xyz - xyz.mean(axis=0)) / np.where(spread > 0, spread, 1)])
        names = [self.points[row] for row in rows]
        if len(marks) < 3:
            features = features[:, [0, *(1 + axis for axis in self.axes(view)[:2])]]
        known = features[[name in marks for name in names]]
        normal = known.T @ known + 1e-3 * np.eye(features.shape[1])
        leverage = np.einsum("ni,ij,nj->n", features, np.linalg.inv(normal), features)
        seen = set(guess.found) | set(guess.unsure) if guess.dots else set(names)
        skipped = self._skipped.get(view, set())
        if skipped and not guess.dots:
            leverage = leverage * self._distance_from(xyz[:, self.axes(view)[:2]], [name in skipped for name in names])
        for choice in (seen - skipped, seen, set(names)):
            left = [k for k, name in enumerate(names) if name in choice and name not in marks]
            if left:
                return names[left[int(np.argmax(np.round(leverage[left], 6)))]]
        return None

    def _distance_from(self, xy: Floats, some: list[bool]) -> Floats:
        """(n,) how far dots are from some of them, as a part of `FAR_FROM_HIDDEN` of the drawing, at most 1."""
        apart = np.linalg.norm(xy[:, None] - xy[some], axis=2).min(axis=1)
        whole = float(np.linalg.norm(np.ptp(xy, axis=0)))
        return np.asarray(np.clip(apart / (FAR_FROM_HIDDEN * whole or 1.0), 0, 1), dtype=np.float64)

    def guess(self, view: View) -> Guess:
        """Where the other dots are, by the labels there are: nothing with fewer than four.

        Args:
            view: One of `pictures`.
        """
        marks = self.marks(view)
        return _guess(self.picture(view), self.points, self.known.xyz, tuple(self.rows(view)), tuple(marks.items()))

    def turn(self, view: View) -> tuple[tuple[int, int], tuple[int, int]]:
        """How to lay the drawing down so that it looks as the picture does, as far as labels tell: one of `TURNS`.

        Args:
            view: One of `pictures`.
        """
        marks = self.marks(view)
        index = {name: row for row, name in enumerate(self.points)}
        xy = self.known.xyz[[index[name] for name in marks]][:, self.axes(view)[:2]]
        uv = np.array(list(marks.values())).reshape(-1, 2)
        if len(xy) < 3:
            return UPRIGHT
        xy, uv = xy - xy.mean(axis=0), uv - uv.mean(axis=0)
        size = np.linalg.svd(xy, compute_uv=False)
        if size[1] < 0.1 * size[0]:
            return UPRIGHT
        down = np.linalg.lstsq(xy, uv, rcond=None)[0].T
        return max(TURNS, key=lambda turn: float(np.sum(np.array(turn) * down)))

    def axes(self, view: View) -> list[int]:
        """The axes of a drawing of the layout: the two along which it is spread most, in order, and the third.

        Args:
            view: One of `pictures`.
        """
        spread = np.ptp(self.known.xyz[self.rows(view)], axis=0)
        depth = 2 - int(np.argmin(spread[::-1]))
        return [axis for axis in range(3) if axis != depth] + [depth]

    def picture(self, view: View) -> Grey:
        """A picture to label, as `read_picture` gives it.

        Args:
            view: One of `pictures`.

        Raises:
            UsageError: There is none.
            ImageError: It cannot be read.
        """
        if view not in self.pictures:
            raise UsageError(
                f"there is no picture of camera {view.camera!r}{f' in shot {view.shot!r}' * bool(view.shot)} to label.",
                fix="reload the page",
            )
        path = self.pictures[view]
        return _read_once(path, _stamp_of(path))

    def _check(self, view: View, point: str) -> None:
        names = [self.points[row] for row in self.rows(view)]
        if point not in names:
            raise UsageError(
                f"the layout has no point {point!r}{did_you_mean(point, names)}.", fix="choose one of the layout"
            )

    def _change(self, view: View, point: str, uv: tuple[float, float] | None) -> None:
        """Save the labels with another place for a point, or none."""
        with self._lock:
            self.refresh()
            labels = {key: dict(marks) for key, marks in self._labels.items()}
            every = labels.get(View(view.camera, ""), {})
            own = labels.setdefault(view, {})
            every.pop(point, None)
            own.pop(point, None)
            if uv is not None:
                own[point] = uv
            before = self._labels
            self._save({key: marks for key, marks in labels.items() if marks})
            self._before.append((view, before))

    def _save(self, labels: Labels) -> None:
        write_text(self.path, labels_csv(labels))
        self._labels, self._stamp = labels, _stamp_of(self.path)


def _pictures_to_label(
    found: Mapping[str, Mapping[str, Path]], known: KnownPositions, folders: list[str], cameras: list[str]
) -> dict[View, Path]:
    """One picture of each camera; where the layout has several shots, one of each of these."""
    shots = list(dict.fromkeys(map(str, known.shots)))
    if len(shots) == 1:
        pictures = {View(camera, ""): next(iter(files.values())) for camera, files in found.items()}
    else:
        pictures = {
            View(camera, shot): files[shot] for camera, files in found.items() for shot in shots if shot in files
        }
    if pictures:
        return pictures
    if not found:
        raise DatasetError(
            f"there are pictures of {list_some(folders)}, and the cameras of {DESCRIPTION} are {list_some(cameras)}.",
            fix=f"give the folders the cameras' names, or correct {DESCRIPTION}",
        )
    there = list(dict.fromkeys(shot for files in found.values() for shot in files))
    raise DatasetError(
        f"no picture shows a shot of the layout, which has {list_some(shots)}; there are pictures {list_some(there)}.",
        fix="name each picture after its shot, or correct the layout's column shot",
    )


def _stamp_of(path: Path) -> tuple[int, int] | None:
    """What changes when the file does; None where there is none."""
    try:
        state = path.stat()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ImplicamError(f"{path} cannot be read.", why=str(error), fix="check the file") from error
    return state.st_mtime_ns, state.st_size


@lru_cache(maxsize=4)
def _read_once(path: Path, stamp: tuple[int, int] | None) -> Grey:
    return read_picture(path)


def _guess(
    picture: Grey,
    points: tuple[str, ...],
    xyz: Floats,
    rows: tuple[int, ...],
    marks: tuple[tuple[str, tuple[float, float]], ...],
) -> Guess:
    if len(marks) < MIN_LABELS_TO_GUESS:
        return Guess()
    names = [points[row] for row in rows]
    index = {name: k for k, name in enumerate(names)}
    search = DotSearch.begin(
        picture, names, xyz[list(rows)], {index[name]: uv for name, uv in marks}, least=MIN_LABELS_TO_GUESS
    )
    if isinstance(search, str):
        return Guess(doubt=search)
    search.grow()
    lost = [names[row] for row in search.lost]
    doubt = search.explain_doubt()
    if doubt:
        return Guess(lost=lost, suspect=search.contradicted(), doubt=doubt)
    there = search.result()
    found = dict(zip(there.points, there.uv.tolist(), strict=True))
    inside = search.inside()
    dots = {}
    for k, name in enumerate(names):
        if inside[k] or name in found:
            u, v = found.get(name, search.uv[k])
            dots[name] = (float(u), float(v), float(search.sd[k]))
    unsure = [name for name in dots if name not in found and not search.sure[index[name]]]
    return Guess(dots, list(found), unsure, len(names) - len(dots), lost, search.contradicted())
