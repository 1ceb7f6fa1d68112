"""Where a target is shown to the cameras: a ball on a robot, anywhere in the volume, or a board on a slide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats, Names
from implicam.errors import UsageError
from implicam.geometry import Pose, look_at, rotation_from_vector
from implicam.simulate.camera import SimulatedCamera
from implicam.simulate.rigs import Rig
from implicam.simulate.scene import Print


@dataclass(frozen=True, eq=False)
class Target:
    """Points with their true positions in the rig's world frame and unit.

    Attributes:
        name: What it is, for the name of the dataset.
        points: (n,) names.
        shots: (n,) the shot each point belongs to.
        xyz: (n, 3) positions.
        facing: (3,) or (n, 3) the side that a board shows, a unit vector in the world; None for a ball, which has none.
        board: Rows and columns of its inner corners; None for a ball.
        takes: (n, cameras) which cameras take a picture; None for all of them.
        marks: What is printed in the white squares of a board, as `scene.Checkerboard` has it; None for nothing.
        wand: Length of a wand, whose two ends the points are in turn; None for no wand.
        sheet: Of a board that is no checkerboard: world_from_board, and what is printed on it; None for nothing.
    """

    name: str
    points: Names
    shots: Names
    xyz: Floats
    facing: Floats | None = None
    board: tuple[int, int] | None = None
    takes: NDArray[np.bool_] | None = None
    marks: NDArray[np.float32] | None = None
    wand: float | None = None
    sheet: tuple[Pose, Print] | None = None


def ball_grid(rig: Rig, shape: tuple[int, int, int] = (5, 5, 7)) -> Target:
    """A ball on a regular lattice that fills the working volume: along the bar, down, away.

    Args:
        rig: The rig.
        shape: Positions along, down and away; by default the paper's 175.

    Raises:
        UsageError: A number is below 1.
    """
    _check_counts(shape=shape)
    steps = [np.linspace(-0.5, 0.5, n) if n > 1 else np.zeros(1) for n in shape]
    depth, down, along = np.meshgrid(*steps[::-1], indexing="ij")
    return _balls(rig, "ball", np.column_stack([along.ravel(), down.ravel(), depth.ravel()]))


def random_positions(rig: Rig, n: int, rng: np.random.Generator) -> Target:
    """A ball at positions uniform in the working volume.

    Args:
        rig: The rig.
        n: How many.
        rng: Random numbers.

    Raises:
        UsageError: The number is below 1.
    """
    _check_counts(n=(n,))
    return _balls(rig, "random", rng.uniform(-0.5, 0.5, size=(n, 3)))


WAND_SHARE = 0.6
"""Length of a wand over the shortest edge of the working volume."""
WAND_ENDS = ("a", "b")
"""Names of its markers."""
WAND_JITTER_RATIO = 1e-4
"""Sd of its length from frame to frame, over the length: it bends, and a marker is not quite round."""
WAND_TRIAL_COUNT = 1000
"""Places and directions that are tried for each frame."""


def waved_wand(rig: Rig, frames: int, rng: np.random.Generator, *, length: float | None = None) -> Target:
    """A wand with two markers, waved by hand in the working volume: any place, any direction, both ends inside.

    Args:
        rig: The rig.
        frames: How often it is seen.
        rng: Random numbers.
        length: Between the markers, in the rig's unit; None for 0.6 of the volume's shortest edge.

    Raises:
        UsageError: A number is below 1, or the wand does not fit into the volume.
    """
    _check_counts(frames=(frames,))
    size = rig.volume.size
    usual = WAND_SHARE * float(size.min()) if length is None else length
    if not 0 < usual < float(np.linalg.norm(size)):
        raise UsageError(
            f"a wand of {usual:g} {rig.length_unit} does not fit into the volume of this rig.",
            fix=f"it is {', '.join(f'{edge:g}' for edge in size)} {rig.length_unit} large",
        )
    ends = np.empty((frames, 2, 3))
    for frame in range(frames):
        along = rng.normal(size=(WAND_TRIAL_COUNT, 3))
        along *= usual * (1 + WAND_JITTER_RATIO * rng.normal()) / np.linalg.norm(along, axis=1)[:, None]
        middle = rng.uniform(-0.5, 0.5, size=(WAND_TRIAL_COUNT, 3)) * size
        tried = middle[:, None] + np.array([[-0.5], [0.5]]) * along[:, None]
        inside = np.flatnonzero((np.abs(tried) <= size / 2).all(axis=(1, 2)))
        if not len(inside):
            raise UsageError(f"a wand of {usual:g} {rig.length_unit} hardly fits into the volume.", fix="a shorter one")
        ends[frame] = tried[inside[0]]
    names = np.array([f"{frame + 1} {end}" for frame in range(frames) for end in WAND_ENDS])
    shots = np.repeat([f"{frame + 1}" for frame in range(frames)], 2)
    return Target("wand", names, shots, rig.volume.world_from_box.apply(ends.reshape(-1, 3)), wand=usual)


GAUGE_SHARE = 0.95
"""Length of a step gauge over that of the line in the volume that it is put on."""
GAUGE_MARKS = (0.0, 0.15, 0.32, 0.52, 0.75, 1.0)
"""Where its marks are, over its length: from the first, five lengths."""


class GaugeLength(NamedTuple):
    """A length between two marks of a step gauge: names of its ends, its true size, the name of its line."""

    a: str
    b: str
    length: float
    line: str


def step_gauge(rig: Rig) -> tuple[Target, list[GaugeLength]]:
    """A step gauge on seven lines: the four space diagonals of the working volume, and three along its edges.

    Args:
        rig: The rig.

    Returns:
        Its marks, and five lengths on each line.
    """
    half = rig.volume.size / 2
    diagonals = np.array([[1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]]) * half
    marks, names, lengths = list[Floats](), list[str](), list[GaugeLength]()
    for i, end in enumerate([*diagonals, *np.diag(half)]):
        line, size = f"L{i + 1}", 2 * GAUGE_SHARE * float(np.linalg.norm(end))
        names += [f"{line}-{k}" for k in range(len(GAUGE_MARKS))]
        marks += [GAUGE_SHARE * (2 * at - 1) * end for at in GAUGE_MARKS]
        lengths += [GaugeLength(f"{line}-0", f"{line}-{k}", at * size, line) for k, at in enumerate(GAUGE_MARKS) if k]
    points = np.array(names)
    return Target("lengths", points, points, rig.volume.world_from_box.apply(np.array(marks))), lengths


def moving_board(
    rig: Rig,
    *,
    corners: tuple[int, int] = (8, 11),
    square: float = 13.29,
    positions: int = 20,
    step: float = 10.0,
) -> Target:
    """The corners of a board on a slide along its normal, nearest position first, as in the paper.

    Args:
        rig: The rig.
        corners: Rows and columns of inner corners.
        square: The edge of a square, mm.
        positions: How many.
        step: From one position to the next, mm.

    Raises:
        UsageError: A number is below 1.
    """
    _check_counts(corners=corners, positions=(positions,))
    rows, columns = corners
    z, y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in (positions, rows, columns)), indexing="ij")
    box = np.column_stack([x.ravel() * square, y.ravel() * square, z.ravel() * step]) * rig.units_per_mm
    shots = [f"board{i + 1:02d}" for i in range(positions)]
    names = [f"{shot}-c{j + 1:03d}" for shot in shots for j in range(rows * columns)]
    pose = rig.volume.world_from_box
    facing = -pose.rotation[:, 2]
    return Target("board", np.array(names), np.repeat(shots, rows * columns), pose.apply(box), facing, corners)


def held_boards(
    rig: Rig,
    groups: Sequence[Sequence[str]],
    rng: np.random.Generator,
    *,
    corners: tuple[int, int] = (8, 11),
    square: float = 13.29,
) -> Target:
    """A board held by hand, once for each group of cameras, which all see all of it; only they take a picture.

    It is tilted up to 50 degrees, and as far away as lets its diagonal span 0.25 to 0.8 of the image's width.

    Args:
        rig: The rig.
        groups: For each board, the names of the cameras.
        rng: Random numbers.
        corners: Rows and columns of inner corners.
        square: The edge of a square, mm.

    Raises:
        UsageError: No pose is found that a group sees together.
    """
    _check_counts(corners=corners, pictures=(len(groups),))
    y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in corners), indexing="ij")
    flat = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * square * rig.units_per_mm
    names = [camera.name for camera in rig.cameras]
    positions, facing, takes = [], [], np.zeros((len(groups) * len(flat), len(names)), dtype=np.bool_)
    for g, group in enumerate(groups):
        xyz, towards = _hold_board(flat, [rig.cameras[names.index(name)] for name in group], rng)
        positions.append(xyz)
        facing.append(np.broadcast_to(towards, xyz.shape))
        takes[g * len(flat) : (g + 1) * len(flat), [names.index(name) for name in group]] = True
    shots = np.repeat([f"held{g + 1:03d}" for g in range(len(groups))], len(flat))
    points = np.array([f"{shot}-c{i % len(flat) + 1:03d}" for i, shot in enumerate(shots)])
    return Target("boards", points, shots, np.concatenate(positions), np.concatenate(facing), corners, takes)


POSE_TRIAL_COUNT = 1500
"""Places and tilts that are tried for a board; for neighbours on a bar one in a hundred is good."""


def _hold_board(flat: Floats, cameras: Sequence[SimulatedCamera], rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Corners (k, 3) of a board that all the cameras see, and the side (3,) it shows."""
    middle = np.mean([camera.camera_from_world.centre for camera in cameras], axis=0)
    up = -cameras[0].camera_from_world.rotation[1]
    for centre in _propose_places(float(np.linalg.norm(np.ptp(flat, axis=0))), cameras, rng):
        turn = rng.normal(size=3) * [1.0, 1.0, 0.4]  # tilted more than turned in its own plane
        turn *= np.radians(rng.uniform(0, 50)) / np.linalg.norm(turn)
        # a board's x runs to the right and y down as seen from its front: its z looks away from the cameras
        frame = look_at(middle, centre, up).rotation.T @ rotation_from_vector(turn)
        xyz, towards = flat @ frame.T + centre, -frame[:, 2]
        if all(_sees_all(each, xyz, towards) for each in cameras):
            return xyz, towards
    raise UsageError(
        f"no place was found where {', '.join(c.name for c in cameras)} see a whole board together.",
        fix="choose cameras that look at the same place, or a smaller board",
    )


def _propose_places(diagonal: float, cameras: Sequence[SimulatedCamera], rng: np.random.Generator) -> Floats:
    """(n, 3) places for a board's middle, of `POSE_TRIAL_COUNT` those that all cameras see."""
    chosen = rng.integers(len(cameras), size=POSE_TRIAL_COUNT)
    part, span = rng.uniform(0.05, 0.95, size=(POSE_TRIAL_COUNT, 2)), rng.uniform(0.25, 0.8, size=POSE_TRIAL_COUNT)
    places = np.full((POSE_TRIAL_COUNT, 3), np.nan)
    for c, camera in enumerate(cameras):
        mine = chosen == c
        rays, _ = camera.ray_from_pixel(part[mine] * [camera.width - 1, camera.height - 1])
        reach = camera.lens.fx * diagonal / (span[mine] * camera.width)
        world = rays @ camera.camera_from_world.rotation
        places[mine] = camera.camera_from_world.centre + reach[:, None] * world
    places = places[np.isfinite(places).all(axis=1)]
    seen = np.all([camera.pixel_from_world(places)[1] for camera in cameras], axis=0)
    return np.asarray(places[seen], dtype=np.float64)


def _sees_all(camera: SimulatedCamera, xyz: Floats, towards: Floats) -> bool:
    to_camera = camera.camera_from_world.centre - xyz
    cos = to_camera @ towards / np.linalg.norm(to_camera, axis=1)
    return bool((cos > 0.3).all() and camera.pixel_from_world(xyz)[1].all())


def _balls(rig: Rig, name: str, parts: Floats) -> Target:
    """Balls at positions given as parts of the volume's edges, from -0.5 to 0.5."""
    names = np.array([f"{name}{i + 1:03d}" for i in range(len(parts))])
    return Target(name, names, names, rig.volume.world_from_box.apply(parts * rig.volume.size))


def _check_counts(**counts: tuple[int, ...]) -> None:
    for what, numbers in counts.items():
        if min(numbers) < 1:
            raise UsageError(f"{what} = {numbers}: a target needs at least one point.", fix=f"make {what} 1 or more")
