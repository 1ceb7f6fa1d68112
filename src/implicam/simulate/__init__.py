"""Rigs whose truth is known: cameras, targets, noise.

rig = build_rig("bar6", seed=1)
data = simulate(rig, ball_grid(rig), seed=2, missing=0.1)
"""

from __future__ import annotations

import numpy as np

from implicam.dataset import Dataset
from implicam.simulate.camera import SimulatedCamera, SmoothError, error_process
from implicam.simulate.noise import (
    as_boards,
    as_wand,
    cramer_rao_limit,
    each_and_pairs,
    simulate,
    simulate_boards,
    views,
    with_limit,
)
from implicam.simulate.photographs import BALL_RADIUS_MM, Optics, Recorded, Studio, record
from implicam.simulate.placements import SPECS, Placement, named_placement
from implicam.simulate.rig_file import read_placement
from implicam.simulate.rigs import CAMERA_SETS, Box, Rig, Unusual, build_rig, placement_of
from implicam.simulate.targets import (
    GaugeLength,
    Target,
    ball_grid,
    held_boards,
    moving_board,
    random_positions,
    step_gauge,
    waved_wand,
)
from implicam.simulate.truth import write_rig
from implicam.simulate.window import Window

__all__ = [
    "BALL_RADIUS_MM",
    "CAMERA_SETS",
    "SPECS",
    "Box",
    "GaugeLength",
    "Optics",
    "Placement",
    "Recorded",
    "Rig",
    "SimulatedCamera",
    "SmoothError",
    "Studio",
    "Target",
    "Unusual",
    "Window",
    "as_boards",
    "as_wand",
    "ball_grid",
    "build_rig",
    "cramer_rao_limit",
    "each_and_pairs",
    "error_process",
    "held_boards",
    "moving_board",
    "named_placement",
    "placement_of",
    "random_positions",
    "read_placement",
    "record",
    "simulate",
    "simulate_boards",
    "simulated",
    "step_gauge",
    "views",
    "waved_wand",
    "with_limit",
    "write_rig",
]


def simulated(rig: str = "bar6", *, points: int | None = None, seed: int = 0, cameras: str | None = None) -> Dataset:
    """A simulated dataset in one call: a ball on the paper's grid, or at random positions.

    Args:
        rig: The name of a rig, as of `build_rig`.
        points: How many random positions; None for the grid.
        seed: Of the rig, the positions and the noise.
        cameras: Names joined by commas, or a set of the paper; None for all.

    Returns:
        The dataset, with the truth in extra columns.

    Raises:
        UsageError: There is no such rig or camera, or a number is out of range.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> len(rig), rig.length_unit
    (30, 'mm')
    """
    built = build_rig(rig, seed=seed, cameras=cameras)
    rng = np.random.default_rng([seed, 17])
    target = ball_grid(built) if points is None else random_positions(built, points, rng)
    return simulate(built, target, seed=seed)
