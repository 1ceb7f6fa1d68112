"""Flat boards at places nobody knows: what each camera saw of each board, and where the corners are on the board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.explicit.settings import DEFAULT_SETTINGS, ExplicitSettings
from implicam.dataset import Camera, Dataset, Names
from implicam.dataset.boards import CORNER, corner_positions, is_board
from implicam.errors import DatasetError, FitError
from implicam.geometry import Floats
from implicam.rig_model import Image, image_of, relative_noise, stated_noise

MIN_BOARDS = 3
"""Pictures that a camera needs: Zhang's method takes three planes for a lens."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """What camera number `camera` saw of board number `board`: corners (k, 3) on the board (z = 0), their pixels
    (k, 2), the noise of each over the camera's usual one (k,), and their rows (k,) in the dataset."""

    camera: int
    board: int
    xyz: Floats
    uv: Floats
    relative: Floats
    rows: NDArray[np.int64]

    def select(self, keep: NDArray[np.bool_]) -> BoardView:
        """Some of the corners.

        Args:
            keep: (k,) which.

        Returns:
            The view with these alone.
        """
        return replace(self, xyz=self.xyz[keep], uv=self.uv[keep], relative=self.relative[keep], rows=self.rows[keep])


@dataclass(frozen=True, eq=False)
class Boards:
    """All views of all boards. shots: (n,) of each row of the dataset; images: of each camera, where its pixels are
    measured from; stated: (C,) its noise; settings: priors and thresholds of all that is made of them."""

    cameras: tuple[Camera, ...]
    shots: Names
    views: tuple[BoardView, ...]
    images: tuple[Image, ...]
    stated: Floats
    settings: ExplicitSettings = DEFAULT_SETTINGS

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names."""
        return tuple(camera.name for camera in self.cameras)

    def of_camera(self, c: int) -> tuple[BoardView, ...]:
        """The views of one camera.

        Args:
            c: Its number.

        Returns:
            Its views, in the order of the boards.
        """
        return tuple(view for view in self.views if view.camera == c)


def boards_of(data: Dataset, scale: float = 1.0, settings: ExplicitSettings = DEFAULT_SETTINGS) -> Boards:
    """The boards of a dataset: corners as [target] in dataset.toml lays them out, or as its known positions do.

    Args:
        data: Corners and what the cameras saw of them.
        scale: What lengths are multiplied by.
        settings: How many corners a view takes.

    Returns:
        The boards; views of too few corners, or of corners on a line, are left out.

    Raises:
        FitError: Neither says where the corners are on the board.
    """
    shots, flat = _laid_out(data, settings.min_corners)
    flat = flat * scale
    names, number = np.unique(shots, return_inverse=True)
    observations = data.observations
    stated = stated_noise(observations)
    relative = relative_noise(observations, stated)
    views = []
    for c in range(len(observations.cameras)):
        for board in range(len(names)):
            rows = np.flatnonzero(observations.seen[:, c] & (number == board))
            if len(rows) >= settings.min_corners and _spread(flat[rows]):
                xyz = np.column_stack([flat[rows], np.zeros(len(rows))])
                views.append(BoardView(c, board, xyz, observations.uv[rows, c], relative[rows, c], rows))
    images = tuple(image_of(observations, c) for c in range(len(observations.cameras)))
    return Boards(observations.cameras, shots, tuple(views), images, stated, settings)


def has_boards(data: Dataset) -> bool:
    """Whether a dataset shows boards: [target] says so, or points are named as corners are.

    Args:
        data: The dataset; where it has no known positions, names like board01-c001 count.

    Returns:
        Whether it does; without [target] it cannot be said where the corners are, and `boards_of` tells it.
    """
    if is_board(data.extra.get("target")):
        return True
    return data.known is None and len(data) > 0 and all(CORNER.fullmatch(str(point)) for point in data.points)


def _laid_out(data: Dataset, least: int) -> tuple[Names, Floats]:
    """(n,) the shot of each corner, and (n, 2) where it is on the board; least: corners of one."""
    target = data.extra.get("target")
    if is_board(target):
        return _by_target(data, target)
    if data.known is None:
        raise FitError(
            f"nothing says where the corners of {data.name!r} are on the board.",
            why="[target] in dataset.toml is no board, or not there, and there is no points.csv",
            fix='write into dataset.toml: [target] kind = "board", rows = 8, columns = 11, square = 13.29; implicam '
            "detect writes it where --board and --square are given",
        )
    return data.shots, _by_positions(data, least)


def _by_target(data: Dataset, target: Mapping[str, Any]) -> tuple[Names, Floats]:
    try:
        places = corner_positions(target)
    except DatasetError as error:
        raise FitError(f"{data.name!r}: {error.what}", why=error.why, fix=error.fix) from error
    found = [CORNER.fullmatch(str(point)) for point in data.points]
    wrong = [str(point) for point, match in zip(data.points, found, strict=True) if match is None]
    numbers = np.array([int(match["number"]) - 1 if match else 0 for match in found], dtype=np.int64)
    if wrong or not ((numbers >= 0) & (numbers < len(places))).all():
        name = wrong[0] if wrong else str(data.points[np.argmax((numbers < 0) | (numbers >= len(places)))])
        raise FitError(
            f"point {name!r} is no corner of a board of {len(places)} corners, as [target] describes it.",
            fix="name corners as implicam detect does: board01-c001, counted along the rows",
        )
    shots = np.array([match["shot"] if match else "" for match in found], dtype=np.str_)
    return shots, places[numbers]


def _by_positions(data: Dataset, least: int) -> Floats:
    """(n, 2) known positions of each shot, in the plane of the shot."""
    flat = np.zeros((len(data), 2))
    for shot in np.unique(data.shots):
        rows = data.shots == shot
        centred = data.xyz[rows] - data.xyz[rows].mean(axis=0)
        _, extents, axes = np.linalg.svd(centred, full_matrices=False)
        if len(centred) < least or extents[2] > 1e-3 * extents[0]:
            raise FitError(
                f"the points of shot {str(shot)!r} are no flat board.",
                why=f"it has {len(centred)} points; a board has {least} or more, on one plane",
                fix="give pictures of a board with --boards, and balls as the dataset itself",
            )
        flat[rows] = centred @ axes[:2].T
    return flat


def _spread(flat: Floats) -> bool:
    extents = np.linalg.svd(flat - flat.mean(axis=0), compute_uv=False)
    return bool(extents[1] > 0.05 * extents[0])


def usable_cameras(boards: Boards) -> tuple[list[int], list[tuple[int, str]]]:
    """Which cameras saw enough boards.

    Args:
        boards: All views.

    Returns:
        Numbers of those that did; number and reason of the others.
    """
    counts = [len(boards.of_camera(c)) for c in range(len(boards.cameras))]
    good = [c for c, count in enumerate(counts) if count >= MIN_BOARDS]
    why = f"of the {MIN_BOARDS} boards that it takes, each with {boards.settings.min_corners} corners or more"
    poor = [(c, f"it saw {count} {why}") for c, count in enumerate(counts) if count < MIN_BOARDS]
    return good, poor


def renumbered(views: Sequence[BoardView]) -> tuple[tuple[BoardView, ...], list[int]]:
    """The views with boards counted from 0.

    Args:
        views: With any numbers of boards.

    Returns:
        The views, and the former number of each board.
    """
    boards = sorted({view.board for view in views})
    return tuple(replace(view, board=boards.index(view.board)) for view in views), boards
