"""Where to put the cameras, before anything is bought or drilled: the uncertainty that a placement will have.

>>> from implicam.design import Assumptions, compare_designs
>>> bar, grid = compare_designs(["bar6", "grid6"], Assumptions(noise=0.2), 36)
>>> grid.prediction.rig.length_unit, round(grid.prediction.blind, 2)
('mm', 0.0)
"""

from implicam.design.check import Realised, realise
from implicam.design.designs import Design, compare_designs
from implicam.design.prediction import Assumptions, Prediction, draw_rig, drawing_of, predict, set_workspace
from implicam.design.summary import CameraPart, Spread, judge_cameras, summarise_spreads

__all__ = [
    "Assumptions",
    "CameraPart",
    "Design",
    "Prediction",
    "Realised",
    "Spread",
    "compare_designs",
    "draw_rig",
    "drawing_of",
    "judge_cameras",
    "predict",
    "realise",
    "set_workspace",
    "summarise_spreads",
]
