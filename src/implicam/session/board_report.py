"""The report of a calibration from boards alone: what it measures on boards that it has not seen.

Nobody knows where a board was, but how its corners lie on it. So every third board is held out, the others calibrate,
its corners are measured, and the board is laid on them where it fits best: what is left are errors of shape and size.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from implicam import calibration_file
from implicam.calibrators import Calibration, Calibrator
from implicam.dataset import Dataset, Floats
from implicam.dataset.boards import CORNER, corner_positions, corner_shots
from implicam.derived import distances
from implicam.errors import FitError, UsageError
from implicam.geometry import register
from implicam.measurement import Measurement
from implicam.report import KnownLengths, ReportData, write_report

HELD_OUT_EVERY = 3
"""One board in so many is held out."""

MIN_BOARDS = 9
"""From which boards can be held out."""


def write_board_report(
    path: Path, name: str, calibrator: Calibrator, calibration: Calibration, data: Dataset
) -> ReportData:
    """Write the page.

    Args:
        path: Where to.
        name: Of the session.
        calibrator: That made it.
        calibration: From all boards.
        data: The corners of all boards, at places that nobody knows.

    Returns:
        What the page says.

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
        "the errors of its points are what is left: no error that shifts or turns a board as a whole. The headline is "
        "of distances, from each corner to the farthest one on its board, which need no such fit; their error bars are "
        "those of both ends with what these share.",
        *calibration.notes,
    )
    title = f"{name}: calibrated with boards held by hand"
    lengths = _lengths(measured, held_out, flat[numbers])
    found = ReportData(title, measured, facts=facts, true_xyz=true, notes=notes, lengths=lengths)
    write_report(path, found)
    return found


def _lengths(measured: Measurement, held_out: Dataset, flat: Floats) -> KnownLengths | None:
    """From each corner to the farthest on its board that was measured: the error of the distance is known, wherever the
    board was. None where there is no such pair."""
    shots, pairs, boards = corner_shots(held_out.points), [], 0
    for shot in dict.fromkeys(shots.tolist()):
        rows = np.flatnonzero((shots == shot) & measured.measured)
        if len(rows) < 2:
            continue
        far = np.linalg.norm(flat[rows][:, None] - flat[rows], axis=2).argmax(axis=1)
        pairs += sorted({(min(a, b), max(a, b)) for a, b in zip(rows.tolist(), rows[far].tolist(), strict=True)})
        boards += 1
    if not pairs:
        return None
    found = distances(measured, pairs)
    first, second = np.array(pairs).T
    true = np.linalg.norm(flat[first] - flat[second], axis=1)
    return KnownLengths(
        f"far corners of {boards} board{'s' * (boards != 1)} held out",
        np.array([one.value for one in found]) - true,
        np.array([one.sd for one in found]),
    )
