"""Where to measure next, from a calibration alone: what `implicam suggest` prints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from implicam.active.acquisitions import DEFAULT_ACQUISITION, Acquisition, acquisition_from_name, choose
from implicam.active.design_model import can_design_experiments, design_error, design_model_of
from implicam.active.loop import Target, make_targets, summarise_step
from implicam.active.stopping import Step
from implicam.active.workspace import Workspace
from implicam.calibrators import Calibration, ForwardGP, PredictsPixels
from implicam.dataset import Floats
from implicam.errors import UsageError


@dataclass(frozen=True, eq=False)
class Suggestion:
    """The next targets of a calibration.

    Attributes:
        targets: In the order in which to visit them.
        now: The uncertainty over the workspace now.
        then: The uncertainty to be expected when all targets are known points.
        workspace: Where targets can be.
    """

    targets: list[Target]
    now: Step
    then: Step
    workspace: Workspace


def suggest(
    calibration: Calibration,
    workspace: Workspace | None = None,
    *,
    count: int = 5,
    rule: Acquisition | None = None,
    here: Floats | None = None,
    reach: float = np.inf,
    candidates: int = 1500,
    judged: int = 400,
    seed: int = 0,
) -> Suggestion:
    """The best next targets for a calibration.

    Args:
        calibration: That of the rig.
        workspace: Where targets can be, and where the calibration has to be good; None for all that every camera sees
            near the known points.
        count: How many targets.
        rule: What scores the candidates; None for the default acquisition.
        here: (3,) where the target is now, in the world; with it, the targets are ordered to a short path.
        reach: The distance that costs as much time as one measurement.
        candidates: How many places are scored.
        judged: How many places the calibration is judged at.
        seed: Of the places and of random rules.

    Raises:
        UsageError: The method cannot say what one more point would add, or the cameras do not see the workspace.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig)
    >>> len(ic.suggest(calibration, count=2, candidates=200, judged=50).targets)
    2
    """
    if not can_design_experiments(calibration):
        raise design_error(calibration.method)
    rig: PredictsPixels = calibration if isinstance(calibration, PredictsPixels) else ForwardGP().fit(calibration.data)
    pilot = None if rig is calibration else rig
    if workspace is None:
        workspace = Workspace.in_view(rig, calibration.data.xyz)
    places = workspace.candidates(candidates, seed)
    design = design_model_of(calibration, places, workspace.judged(judged, seed), pilot)
    if not design.at_judged.measured.any():
        raise UsageError(
            "nowhere in the workspace can a position be measured.",
            why="no place of it is seen by enough of the calibrated cameras",
            fix="give another workspace (--workspace), one that the cameras look at",
        )
    rng = np.random.default_rng([seed, 3])
    chosen = choose(
        design, rule or acquisition_from_name(DEFAULT_ACQUISITION), rng, count=count, here=here, reach=reach
    )
    known = len(calibration.data)
    then = summarise_step(chosen.after.at_judged, known + len(chosen.index))
    targets = make_targets(design.candidates, chosen, calibration.data)
    return Suggestion(targets, summarise_step(design.at_judged, known), then, workspace)
