"""Rigs whose truth is known: cameras, targets, noise.

rig = build_rig("bar6", seed=1)
data = simulate(rig, ball_grid(rig), seed=2, missing=0.1)
"""

from implicam.simulate.camera import SimulatedCamera, SmoothError
from implicam.simulate.noise import cramer_rao_limit, simulate, views
from implicam.simulate.rigs import CAMERA_SETS, SPECS, Box, Rig, build_rig, write_rig
from implicam.simulate.targets import Target, ball_grid, moving_board, random_positions

__all__ = [
    "CAMERA_SETS",
    "SPECS",
    "Box",
    "Rig",
    "SimulatedCamera",
    "SmoothError",
    "Target",
    "ball_grid",
    "build_rig",
    "cramer_rao_limit",
    "moving_board",
    "random_positions",
    "simulate",
    "views",
    "write_rig",
]
