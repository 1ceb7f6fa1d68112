"""What the cameras report: a dataset with noise, missing views, wrong detections, and the truth beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import TRUTH_COLUMNS, Camera, Dataset, Floats, KnownPositions, Names, Observations
from implicam.dataset.wand import FRAME, MARKER, Wand
from implicam.errors import UsageError
from implicam.simulate.camera import SimulatedCamera
from implicam.simulate.rigs import Rig
from implicam.simulate.targets import WAND_ENDS, WAND_JITTER_RATIO, Target, held_boards

Bools = NDArray[np.bool_]

MIN_FACING_COSINE = np.cos(np.radians(80.0))
"""A board seen more obliquely than 80° is not detected."""


def simulate(
    rig: Rig,
    target: Target,
    *,
    seed: int,
    robot_noise: float = 0.0,
    missing: float = 0.0,
    outliers: float = 0.0,
    visible: Bools | None = None,
    extra: Mapping[str, Any] | None = None,
) -> Dataset:
    """The dataset that the rig records of a target.

    Args:
        rig: The cameras.
        target: n points.
        seed: Of everything that is random here; the rig has a seed of its own.
        robot_noise: Standard deviation of the known positions per axis, in the rig's unit; all points of a shot have
            the same error, because a robot or a slide does.
        missing: Probability that a view is lost.
        outliers: Probability that a view left is a wrong detection, anywhere in the image.
        visible: (n, cameras) where a camera sees a point; None to compute it from the rig and the target.
        extra: Further entries of dataset.toml.

    Returns:
        The dataset. Its known positions carry the truth and the Cramer-Rao limit (`TRUTH_COLUMNS`), its observations
        true_u, true_v and outlier, as extra columns.

    Raises:
        UsageError: An option is out of range.
    """
    _check_options(seed, robot_noise, missing, outliers)
    to_robot, to_missing, to_outliers, to_pixels = (np.random.default_rng([seed, i]) for i in range(4))
    true_uv, in_view = views(rig, target)
    visible = in_view if visible is None else visible
    seen = visible & (to_missing.random(visible.shape) >= missing)
    wrong = seen & (to_outliers.random(visible.shape) < outliers)
    sizes = np.array([(camera.width, camera.height) for camera in rig.cameras])
    anywhere = to_outliers.uniform(-0.5, sizes - 0.5, size=true_uv.shape)
    noise_sd = np.array([camera.noise_sd for camera in rig.cameras])
    uv = true_uv + noise_sd[:, None] * to_pixels.normal(size=true_uv.shape)
    uv = np.where(seen[..., None], np.where(wrong[..., None], anywhere, uv), np.nan)
    columns = {
        "true_u": _numbers_as_text(true_uv[..., 0], seen),
        "true_v": _numbers_as_text(true_uv[..., 1], seen),
        "outlier": np.where(seen, np.where(wrong, "1", "0"), ""),
    }
    stated = np.where(seen & (noise_sd > 0), noise_sd, np.nan)[..., None].repeat(2, axis=2)
    cameras = tuple(Camera(camera.name, camera.width, camera.height) for camera in rig.cameras)
    known = _known_positions(target, robot_noise, to_robot, cramer_rao_limit(rig, target.xyz, seen & ~wrong))
    return Dataset(
        f"{rig.name}-{target.name}",
        rig.length_unit,
        Observations(target.points, cameras, uv, stated, columns),
        known,
        extra or {},
    )


def simulate_boards(
    rig: Rig,
    groups: Sequence[Sequence[str]],
    *,
    seed: int,
    missing: float = 0.0,
    outliers: float = 0.0,
    corners: tuple[int, int] = (8, 11),
    square: float = 13.29,
) -> Dataset:
    """The corners of a board held by hand, once for each group of cameras (`held_boards`), at unknown positions.

    Args:
        rig: The cameras.
        groups: For each board, the names of the cameras that take a picture of it.
        seed: Of the boards' poses and the noise.
        missing: Probability that a view is lost.
        outliers: Probability that a view left is a wrong detection.
        corners: Rows and columns of the board's inner corners.
        square: The edge of a square, mm.

    Returns:
        A dataset without known positions; its description says how the corners lie on the board.

    Raises:
        UsageError: An option is out of range, or no pose is found that a group sees together.
    """
    rng = np.random.default_rng([seed, 9])
    target = held_boards(rig, groups, rng, corners=corners, square=square)
    return as_boards(simulate(rig, target, seed=seed, missing=missing, outliers=outliers), target)


def as_boards(data: Dataset, target: Target) -> Dataset:
    """A recording of boards without their positions, but with how the corners lie on the board.

    Args:
        data: The recording.
        target: The board that was recorded, with its true positions.
    """
    assert target.board is not None
    rows, columns = target.board
    square = float(np.linalg.norm(target.xyz[1] - target.xyz[0]))
    kind = {"kind": "board", "rows": rows, "columns": columns, "square": square}
    return replace(data, known=None, extra={**data.extra, "target": kind})


def as_wand(data: Dataset, target: Target) -> Dataset:
    """A recording of a wand without its positions, but with its length, and whose frame and marker each point is.

    A marker that no camera saw is not in it.

    Args:
        data: The recording.
        target: The wand that was recorded.
    """
    assert target.wand is not None
    described = Wand(WAND_ENDS, target.wand, jitter=WAND_JITTER_RATIO * target.wand).as_table()
    marker = np.array([str(point).rsplit(" ", 1)[1] for point in data.points], dtype=np.str_)
    columns = {FRAME: data.shots, MARKER: marker}
    unknown = replace(data, known=None, extra={**data.extra, "target": described}, columns=columns)
    return unknown.select(data.observations.seen.any(axis=1))


def each_and_pairs(rig: Rig, each: int, pairs: int) -> list[tuple[str, ...]]:
    """The paper's budget of board pictures: some by every camera alone, and some by every two neighbours.

    Args:
        rig: The cameras.
        each: Pictures by each camera alone.
        pairs: Pictures by each pair of neighbours.

    Returns:
        For each picture, the names of the cameras that take it.
    """
    along = rig.volume.world_from_box.rotation[:, 0]
    left = sorted(rig.cameras, key=lambda camera: float(camera.camera_from_world.centre @ along))
    order = [left.pop(0)]
    while left:  # from one to the nearest: along a bar, and around a dome
        here = order[-1].camera_from_world.centre
        order.append(min(left, key=lambda camera: float(np.linalg.norm(camera.camera_from_world.centre - here))))
        left.remove(order[-1])
    alone = [(camera.name,) for camera in rig.cameras for _ in range(each)]
    together = [(a.name, b.name) for a, b in pairwise(order) for _ in range(pairs)]
    return [*alone, *together]


def views(rig: Rig, target: Target) -> tuple[Floats, Bools]:
    """The true pixels of a target.

    Args:
        rig: The cameras.
        target: n points.

    Returns:
        (n, cameras, 2) pixels, and (n, cameras) where a camera sees the point and takes a picture.
    """
    pairs = [camera.pixel_from_world(target.xyz) for camera in rig.cameras]
    uv = np.stack([uv for uv, _ in pairs], axis=1)
    visible = np.stack(
        [on & _is_facing(camera, target) for camera, (_, on) in zip(rig.cameras, pairs, strict=True)], axis=1
    )
    return uv, visible if target.takes is None else visible & target.takes


def cramer_rao_limit(rig: Rig, xyz: Floats, used: Bools, sd: Floats | None = None) -> Floats:
    """The smallest covariance that a position can have on average, with perfectly known cameras.

    It is the inverse of the Fisher information: the sum of J^T J / sd^2 over the cameras used.

    Args:
        rig: The cameras.
        xyz: (n, 3) positions in the rig's world frame and unit.
        used: (n, cameras) which views count.
        sd: (n, cameras, 2) of the pixels; that of each camera's noise where None.

    Returns:
        (n, 3, 3) in the rig's unit squared; NaN for fewer than two views.
    """
    information = np.zeros((len(xyz), 3, 3))
    for c, camera in enumerate(rig.cameras):
        noise = np.full((len(xyz), 2), camera.noise_sd) if sd is None else sd[:, c]
        jacobian = camera.jacobian(xyz)[used[:, c]] / np.maximum(noise[used[:, c]], 1e-12)[..., None]
        information[used[:, c]] += jacobian.transpose(0, 2, 1) @ jacobian
    limit = np.full_like(information, np.nan)
    enough = used.sum(axis=1) >= 2
    limit[enough] = np.linalg.inv(information[enough])
    return limit


def with_limit(rig: Rig, data: Dataset) -> Dataset:
    """A dataset with the Cramer-Rao limit that follows from the standard uncertainties of its own views.

    Args:
        rig: The cameras.
        data: Simulated with them.

    Raises:
        UsageError: The dataset has no simulated truth.
    """
    truth = data.truth
    if truth is None:
        raise UsageError(f"dataset {data.name!r} has no simulated truth, so its limit is not known.")
    observations = data.observations.with_cameras([camera.name for camera in rig.cameras])
    limit = cramer_rao_limit(rig, truth.xyz, observations.seen, observations.sd)
    known = data.positions
    columns = {**known.extra, **_truth_columns(truth.xyz, limit)}
    return replace(data, observations=observations, known=replace(known, extra=columns))


def _is_facing(camera: SimulatedCamera, target: Target) -> Bools:
    if target.facing is None:
        return np.ones(len(target.xyz), dtype=np.bool_)
    to_camera = camera.camera_from_world.centre - target.xyz
    cos = np.sum(to_camera * target.facing, axis=1) / np.linalg.norm(to_camera, axis=1)
    return np.asarray(cos > MIN_FACING_COSINE, dtype=np.bool_)


def _known_positions(target: Target, robot_noise: float, rng: np.random.Generator, limit: Floats) -> KnownPositions:
    """Known positions and their stated uncertainty, with the truth as extra columns."""
    shots, shot_of_point = np.unique(target.shots, return_inverse=True)
    shift = robot_noise * rng.normal(size=(len(shots), 3))
    sd = np.full_like(target.xyz, robot_noise if robot_noise > 0 else np.nan)
    return KnownPositions(target.shots, target.xyz + shift[shot_of_point], sd, _truth_columns(target.xyz, limit))


def _truth_columns(xyz: Floats, limit: Floats) -> dict[str, Names]:
    off_diagonal = limit[:, [0, 0, 1], [1, 2, 2]]
    table = np.hstack([xyz, np.sqrt(np.diagonal(limit, axis1=1, axis2=2)), off_diagonal])
    everywhere = np.ones(len(table), dtype=np.bool_)
    return {key: _numbers_as_text(table[:, i], everywhere) for i, key in enumerate(TRUTH_COLUMNS)}


def _numbers_as_text(numbers: Floats, where: Bools) -> Names:
    """Numbers as text that reads back to the same bits; empty elsewhere."""
    flat = [repr(float(x)) if here else "" for x, here in zip(numbers.ravel(), where.ravel(), strict=True)]
    return np.array(flat, dtype=np.str_).reshape(numbers.shape)


def _check_options(seed: int, robot_noise: float, missing: float, outliers: float) -> None:
    if seed < 0:
        raise UsageError(f"seed = {seed}; it must not be negative.", fix="use 0, 1, 2, ...")
    if not (np.isfinite(robot_noise) and robot_noise >= 0):
        raise UsageError(f"robot_noise = {robot_noise}; it must be zero or more.", fix="for example robot_noise = 0.1")
    for what, part in (("missing", missing), ("outliers", outliers)):
        if not 0 <= part <= 1:
            raise UsageError(f"{what} = {part}; it is a probability.", fix=f"for example {what} = 0.1")
