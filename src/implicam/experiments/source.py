"""What the experiments are run on: the paper's rig, simulated, or folders of measured data.

The paper's data are not public, so by default its six cameras are simulated (`simulate.rigs`): lens errors of 0.5 px
rms that no lens model contains, noise of 0.2 px, its grid of 175 positions, its moving board, its budgets of
checkerboard pictures. Measured data are datasets in one folder DIR, each there or not:

    DIR or DIR/ball     known positions, best on a lattice     DIR/check        other known positions to judge by
    DIR/random          known positions at random to train on  DIR/board        a board moved along its normal, a shot
    DIR/boards          a board held by hand, for `explicit`                    each place, named in their order
    DIR/board/check     other known positions between them
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.explicit.boards import boards_of
from implicam.dataset import Dataset, Floats, read_dataset
from implicam.errors import DatasetError
from implicam.simulate import (
    CAMERA_SETS,
    Box,
    Rig,
    Target,
    ball_grid,
    build_rig,
    moving_board,
    random_positions,
    simulate,
    simulate_boards,
    with_limit,
)

RIG = "bar6"
BUDGETS = ((50, 10), (25, 6), (10, 4))
"""The paper's pictures of a checkerboard: of each camera, and of every pair of cameras."""
ROBOT_NOISE_MM = 0.1
"""The repeatability of the paper's robot, as the standard deviation of a known position per axis."""
MAX_STRAY_SHOTS = 2
"""Pictures of a board that some cameras took together by chance: another one had its view hidden."""
CHECK_POINTS = 300
"""Random positions to judge by."""
BALL, RANDOM, CHECK, BOARDS, BOARD, BOARD_CHECK = "ball", "random", "check", "boards", "board", "board/check"
PARTS = (BALL, RANDOM, CHECK, BOARDS, BOARD, BOARD_CHECK)
ALL_CAMERAS = "all"

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Source:
    """The simulated rig of a seed; or, where a folder is given, measured data.

    Attributes:
        seed: Of the simulated rig.
        folder: Of the measured data; empty for none.
        stamp: A digest of the content of its files.
        robot_noise_mm: Standard deviation per axis of the simulated known positions: the paper's robot repeats to 0.1.
    """

    seed: int = 0
    folder: str = ""
    stamp: str = ""
    robot_noise_mm: float = ROBOT_NOISE_MM

    @classmethod
    def of(cls, folder: Path | None, seed: int) -> Source:
        """Measured data where a folder is given, else the rig of a seed.

        Args:
            folder: With the measured data; None for none.
            seed: Of the simulated rig.

        Raises:
            DatasetError: The folder has no data.
        """
        if folder is None:
            return cls(seed)
        places = {part: _place(folder, part) for part in PARTS}
        found = {part: place for part, place in places.items() if place is not None}
        if not found:
            raise DatasetError(
                f"{folder} holds no dataset for the paper's experiments.",
                why="there is neither a dataset nor one of the folders ball, boards, board with one",
                fix="give a folder as implicam simulate writes it; docs/paper.md says which parts there may be",
            )
        return cls(seed, str(folder.resolve()), _stamp(found))

    @property
    def options(self) -> dict[str, Any]:
        """Plain values, as an option of a cell."""
        return asdict(self)

    @property
    def name(self) -> str:
        """For a folder of results; other data have another name."""
        return f"measured-{self.stamp}" if self.folder else f"{RIG}-{self.seed}"

    @property
    def parts(self) -> tuple[str, ...]:
        """The ones of `PARTS` that there are."""
        if not self.folder:
            return PARTS
        return tuple(part for part in PARTS if _place(Path(self.folder), part) is not None)

    @property
    def sets(self) -> Mapping[str, tuple[str, ...]]:
        """The paper's sets where the cameras are cam1 ... cam6; of any other rig all cameras, as one set."""
        if not self.folder:
            return CAMERA_SETS
        names = _read(self, self.parts[0]).observations.camera_names
        return CAMERA_SETS if set(names) == set(CAMERA_SETS["2R4W"]) else {ALL_CAMERAS: names}

    def data(self, part: str, cameras: str) -> Dataset:
        """A part as a set of cameras saw it.

        Args:
            part: One of `PARTS`.
            cameras: A key of `sets`.

        Raises:
            DatasetError: There is no such part, or it lacks a camera or known positions.
        """
        return _of_set(self, part, cameras)

    def boards(self, cameras: str, each: int, pairs: int, seed: int) -> Dataset | None:
        """Pictures of a board, drawn at random.

        A group of cameras that took only one or two pictures together did so by chance, and is left out.

        Args:
            cameras: A key of `sets`.
            each: Pictures by each camera alone.
            pairs: Pictures by each group of cameras that took some together.
            seed: Of the draw.

        Returns:
            The corners; None where there are fewer pictures.

        Raises:
            DatasetError: There is no such part.
        """
        drawn, rows = np.random.default_rng([seed, each, pairs]), list[Rows]()
        for group, shots in _groups(self).items():
            wanted = each if len(group) == 1 else pairs
            if not group <= set(self.sets[cameras]) or len(shots) <= MAX_STRAY_SHOTS:
                continue
            if len(shots) < wanted:
                return None
            rows += [shots[i] for i in drawn.permutation(len(shots))[:wanted]]
        if not rows:
            return None
        return _read(self, BOARDS).select(np.sort(np.concatenate(rows))).with_cameras(self.sets[cameras])


@cache
def _of_set(source: Source, part: str, cameras: str) -> Dataset:
    whole, names = _read(source, part), source.sets[cameras]
    absent = sorted(set(names) - set(whole.observations.camera_names))
    if absent:
        raise DatasetError(
            f"{_place(Path(source.folder), part)} has no camera {', '.join(absent)}.",
            why=f"the cameras are those of {source.parts[0]}: {', '.join(names)}",
            fix="give all parts the same cameras",
        )
    data = whole.with_cameras(names)
    _ = data.positions  # without known positions nothing can be learned or judged
    return data if source.folder else with_limit(build_rig(RIG, seed=source.seed, cameras=cameras), data)


@cache
def _groups(source: Source) -> dict[frozenset[str], list[Rows]]:
    """The rows of each shot of the boards, by the cameras that saw it."""
    found = boards_of(_read(source, BOARDS))
    names, number = np.unique(found.shots, return_inverse=True)
    seen: list[set[str]] = [set() for _ in names]
    for view in found.views:
        seen[view.board].add(found.names[view.camera])
    order = np.argsort(number, kind="stable")
    rows = np.split(order, np.searchsorted(number[order], np.arange(1, len(names))))
    groups: dict[frozenset[str], list[Rows]] = {}
    for cameras, mine in zip(seen, rows, strict=True):
        groups.setdefault(frozenset(cameras), []).append(mine)
    return {group: shots for group, shots in groups.items() if group}


@cache
def _read(source: Source, part: str) -> Dataset:
    if not source.folder:
        return _simulated(source, part)
    place = _place(Path(source.folder), part)
    if place is None:
        raise DatasetError(
            f"{source.folder} has no data for this experiment: no {part}.",
            fix=f"add the folder {part}, a dataset; or choose another experiment",
        )
    return read_dataset(place)


def _simulated(source: Source, part: str) -> Dataset:
    seed, rig = source.seed, build_rig(RIG, seed=source.seed)

    def by_robot(target: Target) -> Dataset:
        return _placed_by_robot(rig, target, source.robot_noise_mm * rig.units_per_mm, stream)

    stream = 10 * seed + PARTS.index(part)
    rng = np.random.default_rng([seed, 61, PARTS.index(part)])
    if part == BALL:
        return by_robot(ball_grid(rig))
    if part == BOARD:
        return by_robot(moving_board(rig))
    if part == BOARDS:
        return simulate_boards(rig, each_and_every_pair(rig), seed=stream)
    if part == BOARD_CHECK:
        return simulate(_within_boards(rig), random_positions(_within_boards(rig), CHECK_POINTS, rng), seed=stream)
    if part == CHECK:
        return simulate(rig, random_positions(rig, CHECK_POINTS, rng), seed=stream)
    return by_robot(random_positions(rig, len(ball_grid(rig).xyz), rng))


def _placed_by_robot(rig: Rig, target: Target, sd: float, seed: int) -> Dataset:
    """What the cameras see of a target that a robot places: it says that it is where it was sent, and is nearly there.

    So the known positions are those of the lattice, to the last bit, and the true ones are not: a method that learns
    the planes of a lattice has as good a chance to as with a real robot.
    """
    shots, number = np.unique(target.shots, return_inverse=True)
    off = sd * np.random.default_rng([seed, 62]).normal(size=(len(shots), 3))
    data = simulate(rig, replace(target, xyz=target.xyz + off[number]), seed=seed)
    stated = np.full_like(target.xyz, sd if sd > 0 else np.nan)
    return replace(data, known=replace(data.positions, xyz=target.xyz, sd=stated))


def each_and_every_pair(rig: Rig) -> list[tuple[str, ...]]:
    """The paper's largest budget: pictures by every camera alone and by every two, the board whole in both.

    Args:
        rig: The cameras.

    Returns:
        For each picture, the names of the cameras that take it.
    """
    (each, pairs), names = BUDGETS[0], [camera.name for camera in rig.cameras]
    return [(name,) for name in names for _ in range(each)] + [
        pair for pair in combinations(names, 2) for _ in range(pairs)
    ]


def _within_boards(rig: Rig) -> Rig:
    """The rig with the space that the moving board sweeps as its volume."""
    pose = rig.volume.world_from_box
    corners = pose.inverse().apply(moving_board(rig).xyz)
    return replace(rig, volume=Box(pose, np.ptp(corners, axis=0)))


def _place(folder: Path, part: str) -> Path | None:
    """Where a part of measured data is."""
    choices = {
        BALL: [folder / BALL, folder],
        CHECK: [folder / CHECK, folder / BALL / CHECK],
        RANDOM: [folder / RANDOM],
        BOARDS: [folder / BOARDS],
        BOARD: [folder / BOARD],
        BOARD_CHECK: [folder / BOARD / CHECK],
    }
    return next((place for place in choices[part] if (place / "observations.csv").is_file()), None)


def _stamp(places: Mapping[str, Path]) -> str:
    """Of the content of all files that are read: with other content, results of before do not count."""
    digest = hashlib.sha256()
    for part, place in places.items():
        for name in ("dataset.toml", "points.csv", "observations.csv"):
            file = place / name
            digest.update(f"{part}/{name}".encode() + (file.read_bytes() if file.is_file() else b""))
    return digest.hexdigest()[:16]


def true_positions(data: Dataset) -> Floats:
    """What errors are measured against: the simulated truth where there is one, else the known positions.

    Args:
        data: n known points.

    Returns:
        (n, 3) in the length unit of the data.
    """
    return data.xyz if data.truth is None else data.truth.xyz


def millimetres(data: Dataset) -> float:
    """How many mm a length unit of the data is.

    Args:
        data: The dataset.

    Raises:
        DatasetError: Its unit is not known.
    """
    return 1000 * data.metres_per_unit
