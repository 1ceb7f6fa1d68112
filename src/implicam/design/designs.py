"""Placements side by side: the same workspace, the same known points, the same places to judge by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from implicam.active import Workspace
from implicam.dataset import Floats
from implicam.design.check import Realised, as_rows, realise
from implicam.design.prediction import Assumptions, Prediction, draw_rig, drawing_of, predict, set_workspace
from implicam.design.summary import CameraPart, Spread, judge_cameras, summarise_spreads
from implicam.errors import FitError, UsageError
from implicam.progress import Progress, silent

PLACE_COUNT = 1000
"""Places at which a placement is judged."""


@dataclass(frozen=True, eq=False)
class Design:
    """A placement and what it will be worth.

    Attributes:
        name: Of the rig, or of its file.
        workspace: In the frame of the drawing.
        prediction: At places all over the workspace.
        spreads: What the prediction says in a few numbers.
        parts: What each camera is worth.
        realised: What simulated rigs measured; None where none were built.
    """

    name: str
    workspace: Workspace
    prediction: Prediction
    spreads: tuple[Spread, ...]
    parts: tuple[CameraPart, ...]
    realised: Realised | None = None

    def check_rows(self) -> list[tuple[str, float, float, float]]:
        """Axis, predicted, rms error and stated standard deviation; empty where no rigs were built."""
        return [] if self.realised is None else as_rows(self.realised)


def compare_designs(
    specs: Sequence[str],
    assumed: Assumptions,
    points: int | Floats = 36,
    *,
    workspace: Workspace | None = None,
    unit: str | None = None,
    places: int = PLACE_COUNT,
    check: int = 0,
    seed: int = 0,
    progress: Progress = silent,
) -> list[Design]:
    """What placements will be worth, side by side.

    Args:
        specs: Names or files of rigs.
        assumed: What is assumed of all of them.
        points: How many known points, evenly spread over the workspace; or (N, 3) their positions.
        workspace: Where positions will be measured; None for what the first drawing says.
        unit: Length unit of everything; None for that of the first drawing.
        places: At how many places they are judged.
        check: So many rigs are built in simulation and measured with; 0 for none.
        seed: Of the places, the known points and the first rig.
        progress: Is told how far it is.

    Raises:
        UsageError: A drawing is wrong, or nothing says where positions will be measured.
        FitError: Fewer than two cameras of a rig would see enough known points.
    """
    drawings = [(_name_of(spec), *drawing_of(spec)) for spec in specs]
    first = drawings[0][1]
    unit = unit or first.length_unit
    if workspace is None:
        if first.size is None:
            raise UsageError(
                f"{drawings[0][0]} does not say what its cameras watch.",
                fix="say where positions will be measured: --workspace=-120:120,-80:80,0:240",
            )
        workspace = Workspace.from_box(draw_rig(first, assumed, unit).volume)
    known = workspace.design(points, seed) if isinstance(points, int) else points
    judged = workspace.judged(places, seed)
    found = []
    for name, drawn, cameras in drawings:
        placement = set_workspace(drawn, workspace, unit)
        rig = draw_rig(placement, assumed, unit, cameras)
        try:
            prediction = predict(rig, assumed, known, judged)
        except FitError as error:
            raise FitError(f"{name}: {error.what}", why=error.why, fix=error.fix) from error
        parts = judge_cameras(prediction, progress)
        realised = realise(placement, prediction, check, seed=seed, progress=progress) if check else None
        found.append(Design(name, workspace, prediction, summarise_spreads(prediction), parts, realised))
    return found


def _name_of(spec: str) -> str:
    """As tables call a rig: without the folders of its file."""
    return Path(spec).stem if spec.lower().endswith(".toml") else spec
