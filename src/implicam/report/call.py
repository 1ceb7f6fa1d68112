"""`implicam.report(...)`: what `implicam report` does, as one call."""

from __future__ import annotations

from pathlib import Path

from implicam import calibration_file
from implicam.calibrators import Calibration
from implicam.calibrators.protocol import HoldsLengthsOut
from implicam.dataset import Dataset
from implicam.evaluation import Evaluation, cross_validate, evaluate
from implicam.files import refuse_folder
from implicam.progress import Progress, silent
from implicam.report.data import ReportData, report_of, report_of_lengths
from implicam.report.html_page import write_report

FOLDS = 10
"""Of the cross-validation of a calibration without other known points."""


def report(
    what: Evaluation | Calibration,
    path: str | Path = "report.html",
    *,
    data: Dataset | None = None,
    title: str = "",
    checksum: str = "",
    by: str = "",
    seed: int = 0,
    progress: Progress = silent,
) -> Evaluation | ReportData:
    """Write one page that a stranger understands: how good the measurement is, and whether its error bars are true.

    ic.report(calibration, "report.html", data=others)

    Args:
        what: An evaluation; or a calibration, which is evaluated.
        path: The page to write; it is replaced.
        data: Known points to judge a calibration by; None for its own, by 10-fold cross-validation, or of one from a
            wand by the wand's length in frames that a fit did not know.
        title: Of the page.
        checksum: The SHA-256 of the calibration file, for the page; of a calibration it is found out.
        by: Who reports, for the page.
        seed: Of the folds.
        progress: Told how far it is.

    Returns:
        The evaluation that the page shows; where no position is known, what it says of lengths.

    Raises:
        MissingExtraError: Plotly or Jinja2 is not installed.
        ImplicamError: The page cannot be written.
    """
    refuse_folder(Path(path))
    if isinstance(what, Evaluation):
        evaluation = what
    elif data is not None:
        evaluation = evaluate(what, data)
    elif isinstance(what, HoldsLengthsOut) and (held_out := what.hold_lengths_out(progress)) is not None:
        title = title or f"{what.data.name}, calibrated from lengths"
        found = report_of_lengths(what, held_out, title, checksum or calibration_file.checksum(what), by=by)
        write_report(path, found)
        return found
    else:
        evaluation = cross_validate(what.refit, what.data, min(FOLDS, len(what.data)), seed=seed, progress=progress)
    if not (checksum or isinstance(what, Evaluation)):
        checksum = calibration_file.checksum(what)
    title = title or f"{evaluation.data.name}, measured with {evaluation.method}"
    calibration = None if isinstance(what, Evaluation) else what
    write_report(path, report_of(evaluation, title, checksum, calibration=calibration, by=by))
    return evaluation
