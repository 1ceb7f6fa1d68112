"""The report of a calibration from a wand: its length in frames that a fit did not know."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from implicam import calibration_file
from implicam.calibrators import Calibration, HoldsLengthsOut
from implicam.dataset import Dataset
from implicam.errors import FitError
from implicam.report import KnownLengths, ReportData, write_report


def write_wand_report(path: Path, name: str, calibration: Calibration, data: Dataset) -> ReportData:
    """Write the page.

    Args:
        path: Where to.
        name: Of the session.
        calibration: From all frames.
        data: The markers of all frames.

    Returns:
        What the page says.

    Raises:
        FitError: Without a third of the frames there is no calibration, or nothing is measured there.
        ImplicamError: The page cannot be written.
    """
    assert isinstance(calibration, HoldsLengthsOut)
    wand, held_out = calibration.wand, calibration.hold_lengths_out()
    assert wand is not None
    if not len(held_out.errors):
        raise FitError("no frame that was held out could be measured.", fix="wave it longer")
    cameras, unit = data.observations.camera_names, data.length_unit
    facts = (
        ("Dataset", data.name),
        ("Method", calibration.method),
        ("Cameras", f"{len(cameras)}: {', '.join(cameras)}"),
        ("Wand", f"{wand.length:g} {unit} between its ends"),
        ("Judged on", f"its length in {len(held_out.errors)} frames, by a calibration from the others"),
        ("Length unit", unit),
        ("Calibration file, SHA-256", calibration_file.checksum(calibration)),
    )
    notes = (
        "Nobody knows where the wand was, but how long it is: in a third of the frames, which another fit did not "
        f"know, it comes out {wand.length + float(np.mean(held_out.errors)):.6g} {unit} in the mean. The points are "
        "the ends of the wand, as the calibration from all frames measures them.",
        *calibration.notes,
    )
    lengths = KnownLengths(
        f"the ends of the wand in {len(held_out.errors)} frames held out", held_out.errors, held_out.sds
    )
    found = ReportData(
        f"{name}: calibrated with a wand", calibration.measure(data.observations), facts=facts, notes=notes,
        lengths=lengths,
    )  # fmt: skip
    write_report(path, found)
    return found
