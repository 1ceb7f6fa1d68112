"""Where to measure next, and when to stop.

>>> from implicam.active import Budget, Loop, SimulatedOracle, Workspace
>>> from implicam.simulate import build_rig
>>> from implicam import ForwardGP
>>> rig = build_rig("stereo", seed=1)
>>> loop = Loop(ForwardGP(), Workspace.from_box(rig.volume), rule=Budget(12))
>>> loop = loop.run(SimulatedOracle(rig))
>>> loop.stop, len(loop.data)
('all 12 points of the budget are measured', 12)
"""

from implicam.active.acquisitions import ACQUISITIONS, Acquisition, acquisition_from_name, choose, path_length
from implicam.active.design_model import DesignModel, Places, PredictedCovariance, design_model_of
from implicam.active.loop import Answer, Loop, Oracle, Target, summarise_step
from implicam.active.oracles import RecordedOracle, SimulatedOracle
from implicam.active.stopping import AtLeast, Below, Budget, Converged, Never, Rule, Step, Time, Within
from implicam.active.suggestion import Suggestion, suggest
from implicam.active.workspace import Workspace, workspace_from

__all__ = [
    "ACQUISITIONS",
    "Acquisition",
    "Answer",
    "AtLeast",
    "Below",
    "Budget",
    "Converged",
    "DesignModel",
    "Loop",
    "Never",
    "Oracle",
    "Places",
    "PredictedCovariance",
    "RecordedOracle",
    "Rule",
    "SimulatedOracle",
    "Step",
    "Suggestion",
    "Target",
    "Time",
    "Within",
    "Workspace",
    "acquisition_from_name",
    "choose",
    "design_model_of",
    "path_length",
    "suggest",
    "summarise_step",
    "workspace_from",
]
