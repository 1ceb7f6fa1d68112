"""Where a target is shown to the cameras: a ball on a robot, anywhere in the volume, or a board on a slide."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from implicam.dataset import Floats, Names
from implicam.errors import UsageError
from implicam.simulate.rigs import Rig


@dataclass(frozen=True, eq=False)
class Target:
    """Points with their true positions (n, 3), in the rig's world frame and unit, and the shot each belongs to.

    facing: (3,) the side a board shows, a unit vector in the world; None for a ball, which has no side. board: rows and
    columns of its inner corners, None for a ball.
    """

    name: str
    points: Names
    shots: Names
    xyz: Floats
    facing: Floats | None = None
    board: tuple[int, int] | None = None


def ball_grid(rig: Rig, shape: tuple[int, int, int] = (5, 5, 7)) -> Target:
    """A regular lattice that fills the working volume: along the bar, down, away; the paper's 175 positions."""
    _check_counts(shape=shape)
    steps = [np.linspace(-0.5, 0.5, n) if n > 1 else np.zeros(1) for n in shape]
    depth, down, along = np.meshgrid(*steps[::-1], indexing="ij")
    return _balls(rig, "ball", np.column_stack([along.ravel(), down.ravel(), depth.ravel()]))


def random_positions(rig: Rig, n: int, rng: np.random.Generator) -> Target:
    """`n` positions uniform in the working volume."""
    _check_counts(n=(n,))
    return _balls(rig, "random", rng.uniform(-0.5, 0.5, size=(n, 3)))


def moving_board(
    rig: Rig,
    *,
    corners: tuple[int, int] = (8, 11),
    square: float = 13.29,
    positions: int = 20,
    step: float = 10.0,
) -> Target:
    """A board's corners (rows, columns) at `positions` along its normal, nearest first; all in mm, as in the paper."""
    _check_counts(corners=corners, positions=(positions,))
    rows, columns = corners
    z, y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in (positions, rows, columns)), indexing="ij")
    box = np.column_stack([x.ravel() * square, y.ravel() * square, z.ravel() * step]) * rig.units_per_mm
    shots = [f"board{i + 1:02d}" for i in range(positions)]
    names = [f"{shot}-c{j + 1:03d}" for shot in shots for j in range(rows * columns)]
    pose = rig.volume.world_from_box
    facing = -pose.rotation[:, 2]
    return Target("board", np.array(names), np.repeat(shots, rows * columns), pose.apply(box), facing, corners)


def _balls(rig: Rig, name: str, parts: Floats) -> Target:
    """Balls at positions given as parts of the volume's edges, from -0.5 to 0.5."""
    names = np.array([f"{name}{i + 1:03d}" for i in range(len(parts))])
    return Target(name, names, names, rig.volume.world_from_box.apply(parts * rig.volume.size))


def _check_counts(**counts: tuple[int, ...]) -> None:
    for what, numbers in counts.items():
        if min(numbers) < 1:
            raise UsageError(f"{what} = {numbers}: a target needs at least one point.", fix=f"make {what} 1 or more")
