"""Where to measure next, from a calibration alone: what `implicam suggest` prints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from implicam.active.acquisitions import DEFAULT, Acquisition, acquisition, choose
from implicam.active.design_model import cannot_design, design_model_of, designs_experiments
from implicam.active.loop import Target, step_of, targets_of
from implicam.active.stopping import Step
from implicam.active.workspace import Workspace
from implicam.calibrators import Calibration, ForwardGP, PredictsPixels
from implicam.dataset import Floats
from implicam.errors import UsageError


@dataclass(frozen=True, eq=False)
class Suggestion:
    """The next targets in the order in which to go there; what is known of the workspace now, and what is to be
    expected when all of them are known points."""

    targets: list[Target]
    now: Step
    then: Step


def suggest(
    calibration: Calibration,
    workspace: Workspace,
    *,
    count: int = 5,
    rule: Acquisition | None = None,
    here: Floats | None = None,
    reach: float = np.inf,
    candidates: int = 1500,
    judged: int = 400,
    seed: int = 0,
) -> Suggestion:
    """The `count` best next targets for a calibration. rule: the default acquisition where None. here, reach: as for
    `choose`. UsageError for a method that cannot say, and for a workspace that the cameras do not see."""
    if not designs_experiments(calibration):
        raise cannot_design(calibration.method)
    pilot = None if isinstance(calibration, PredictsPixels) else ForwardGP().fit(calibration.data)
    places = workspace.candidates(candidates, seed)
    design = design_model_of(calibration, places, workspace.judged(judged, seed), pilot)
    if not design.now.measured.any():
        raise UsageError(
            "nowhere in the workspace can a position be measured.",
            why="no place of it is seen by enough of the calibrated cameras",
            fix="give another workspace (--workspace), one that the cameras look at",
        )
    rng = np.random.default_rng([seed, 3])
    chosen = choose(design, rule or acquisition(DEFAULT), rng, count=count, here=here, reach=reach)
    known = len(calibration.data)
    then = step_of(chosen.after.now, known + len(chosen.index))
    return Suggestion(targets_of(design.candidates, chosen, calibration.data), step_of(design.now, known), then)
