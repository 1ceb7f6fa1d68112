"""The report of a calibration from boards alone: what it measures on boards that it has not seen.

Nobody knows where a board was, but how its corners lie on it. So every third board is held out, the others calibrate,
its corners are measured, and the board is laid on them where it fits best: what is left are errors of shape and size.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from implicam import calibration_file
from implicam.calibrators import Calibration, Calibrator
from implicam.dataset import Dataset
from implicam.dataset.boards import CORNER, corner_positions, corner_shots
from implicam.errors import FitError, UsageError
from implicam.geometry import register
from implicam.report import ReportData, write_report

HELD_OUT_EVERY = 3
"""One board in so many is held out."""

MIN_BOARDS = 9
"""From which boards can be held out."""


def write_board_report(path: Path, name: str, calibrator: Calibrator, calibration: Calibration, data: Dataset) -> None:
    """Write the page.

    Args:
        path: Where to.
        name: Of the session.
        calibrator: That made it.
        calibration: From all boards.
        data: The corners of all boards, at places that nobody knows.

    Raises:
        UsageError: There are too few boards to hold some out.
        FitError: The others do not calibrate the cameras.
        ImplicamError: The page cannot be written.
    """
    shots = corner_shots(data.points)
    names = list(dict.fromkeys(shots.tolist()))
    if len(names) < MIN_BOARDS:
        raise UsageError(f"{len(names)} boards are too few to hold some out.", fix=f"take {MIN_BOARDS} or more")
    out = np.isin(shots, names[HELD_OUT_EVERY - 1 :: HELD_OUT_EVERY])
    held_out = data.select(out)
    measured = calibrator.fit(data.select(~out)).measure(held_out.observations)
    flat = corner_positions(data.extra["target"])
    plan = np.column_stack([flat, np.zeros(len(flat))])
    numbers = np.array([int(match["number"]) - 1 for match in map(CORNER.fullmatch, held_out.points.tolist()) if match])
    true = np.full((len(held_out), 3), np.nan)
    for shot in dict.fromkeys(shots[out].tolist()):
        rows = np.flatnonzero(shots[out] == shot)
        try:
            pose, _ = register(plan[numbers[rows]], measured.xyz[rows])
        except FitError:
            continue  # fewer than two cameras saw it
        true[rows] = pose.apply(plan[numbers[rows]])
    judged = int(np.isfinite(true).all(axis=1).sum())
    if not judged:
        raise FitError("no board that was held out was seen by two cameras.", fix="show boards to two cameras at once")
    cameras = data.observations.camera_names
    facts = (
        ("Dataset", data.name),
        ("Method", calibration.method),
        ("Cameras", f"{len(cameras)}: {', '.join(cameras)}"),
        ("Boards", str(len(names))),
        ("Judged on", f"corners of every third board, by a calibration from the others: {judged} corners"),
        ("Length unit", data.length_unit),
        ("Calibration file, SHA-256", calibration_file.checksum(calibration)),
    )
    notes = (
        "Nobody knows where the boards were: each one held out is laid where its measured corners fit it best, and "
        "errors are what is left. They show noise, wrong scale and bent space, and no error that shifts or turns a "
        "board as a whole; error bars, which contain that too, are therefore not judged by them.",
        *calibration.notes,
    )
    title = f"{name}: calibrated with boards held by hand"
    write_report(path, ReportData(title, measured, facts=facts, true_xyz=true, notes=notes))
