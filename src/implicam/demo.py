"""Everything once: photograph a simulated rig, detect, calibrate with few and more points, measure, judge, report.

Our method and the paper's, side by side on the same points.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from implicam import calibration_file
from implicam.calibrators import Calibration, ForwardGP, ForwardGPCalibration, InverseGP
from implicam.compare import Trial, trial_from_evaluation
from implicam.dataset import Dataset, folder_files, write_dataset
from implicam.detect import Ball, DetectionRun, detect_folder
from implicam.errors import UsageError, import_extra
from implicam.evaluation import Evaluation, evaluate
from implicam.files import toml_text
from implicam.images import opencv
from implicam.progress import Progress, silent
from implicam.report import report_of, write_report
from implicam.simulate import (
    BALL_RADIUS_MM,
    Optics,
    Recorded,
    Rig,
    build_rig,
    random_positions,
    record,
    with_limit,
    write_rig,
)

RIG, KNOWN, HELD_OUT = "bar6", 35, 40
SETS = {"2R": "2 cameras", "2R2W": "4 cameras", "2R4W": "6 cameras"}
SIZES = (17, KNOWN)
OPTICS = Optics(noise=0.02, blur=1.0)
METHODS = (ForwardGP, InverseGP)
BEST = ForwardGP.method
"""The method whose calibration with all cameras and points is kept, with its report."""
MADE_HERE = "# made by implicam demo, which may replace this folder\n"


@dataclass(frozen=True, eq=False)
class DemoRow:
    """One line of the demo's table.

    Attributes:
        cameras: The set of cameras, in words.
        trial: The numbers.
    """

    cameras: str
    trial: Trial


@dataclass(frozen=True, eq=False)
class Demo:
    """What the demo made.

    Attributes:
        rows: The table.
        unit: Of lengths.
        photographs: How many photographs there are.
        found: In how many the ball was found.
        typical_sd: How exactly: the median standard uncertainty, pixels.
        dataset: The folder.
        calibration: The calibration file.
        measured: The table of measured positions.
        report: The HTML page.
        photographs_seen: The sheet that shows what was found in the photographs.
    """

    rows: list[DemoRow]
    unit: str
    photographs: int
    found: int
    typical_sd: float
    dataset: Path
    calibration: Path
    measured: Path
    report: Path
    photographs_seen: Path


def run(folder: Path, *, seed: int = 0, progress: Progress = silent) -> Demo:
    """Run the demo: photograph, detect, calibrate, measure, report.

    Args:
        folder: A new folder, or that of an earlier demo, which is replaced.
        seed: Of the rig, the positions and the noise.
        progress: Called as the work goes on.

    Raises:
        UsageError: The folder was not made by the demo.
        MissingExtraError: A library for photographs or for the report is not installed.
    """
    if not may_replace(folder):
        raise UsageError(
            f"{folder} exists and was not made by the demo.", fix="give another folder: implicam demo OTHER-NAME"
        )
    import_extra("plotly", "report", "the report of the demo")  # before the work, not after
    opencv()
    rig = build_rig(RIG, seed=seed)
    shown = [_show(rig, n, seed=seed, shots=shots) for n, shots in ((KNOWN, 1), (HELD_OUT, 2))]
    _photograph(rig, shown, folder, progress)
    known, held_out = _looked_at(folder, seed, progress)
    rows: list[DemoRow] = []
    best: tuple[Calibration, Evaluation] | None = None
    steps = len(SETS) * len(SIZES) * len(METHODS)
    for cameras, label in SETS.items():
        part = build_rig(RIG, seed=seed, cameras=cameras)
        names = [camera.name for camera in part.cameras]
        train, check = known.data.with_cameras(names), with_limit(part, held_out.data.with_cameras(names))
        for size, method in product(SIZES, METHODS):
            progress("calibrating and measuring", len(rows), steps)
            calibration, evaluation, trial = _one(method(seed=seed), train, check, size)
            rows.append(DemoRow(label, trial))
            if trial.method == BEST:
                best = calibration, evaluation
    progress("calibrating and measuring", steps, steps)
    assert best is not None
    calibration, evaluation = best
    demo = Demo(
        rows, known.data.length_unit, sum(one.photographs for one in shown), *_found(known, held_out), folder,
        folder / "rig.implicam", folder / "measured.csv", folder / "report.html", known.sheets[0],
    )  # fmt: skip
    calibration.save(demo.calibration)
    evaluation.measurement.write_csv(demo.measured)
    checksum = calibration_file.checksum(demo.calibration)
    write_report(demo.report, report_of(evaluation, "implicam demo: a simulated six-camera rig", checksum))
    return demo


def _show(rig: Rig, n: int, *, seed: int, shots: int) -> Recorded:
    """`n` random positions of the ball; every `shots` gives others."""
    target = random_positions(rig, n, np.random.default_rng([seed, shots]))
    return record(rig, target, seed=1000 * seed + shots, optics=OPTICS)


def _photograph(rig: Rig, shown: list[Recorded], folder: Path, progress: Progress) -> None:
    """The datasets of known and held-out positions, with their photographs."""
    known, held_out = shown
    also = {
        "truth.toml": MADE_HERE + toml_text(write_rig(rig)),
        **{f"check/{k}": v for k, v in folder_files(held_out.data).items()},
    }

    def fill(temporary: Path) -> None:
        known.write_photographs(temporary, progress)
        held_out.write_photographs(temporary / "check", progress)

    write_dataset(known.data, folder, overwrite=True, also=also, fill=fill)


def _looked_at(folder: Path, seed: int, progress: Progress) -> tuple[DetectionRun, DetectionRun]:
    """What is found in the photographs; that of the held-out positions is corrected without knowing them."""
    known = detect_folder(folder, Ball(radius=BALL_RADIUS_MM), progress=progress)
    calibration: ForwardGPCalibration = ForwardGP(seed=seed).fit(known.data)
    ball = Ball(radius=BALL_RADIUS_MM, calibration=calibration)
    return known, detect_folder(folder / "check", ball, overlays=False, progress=progress)


def _found(*runs: DetectionRun) -> tuple[int, float]:
    """In how many photographs the ball was found, and how exactly: the median sd in pixels."""
    sd = np.concatenate([run.data.observations.sd.ravel() for run in runs])
    return sum(count.found for run in runs for count in run.cameras), float(np.nanmedian(sd))


def may_replace(folder: Path) -> bool:
    """Whether a folder is empty, missing, or an earlier demo.

    Args:
        folder: The folder.
    """
    if not folder.is_dir():
        return not folder.exists()
    truth = folder / "truth.toml"
    return not any(folder.iterdir()) or (truth.is_file() and truth.read_bytes().startswith(MADE_HERE.encode()))


def _one(
    method: ForwardGP | InverseGP, known: Dataset, held_out: Dataset, size: int
) -> tuple[Calibration, Evaluation, Trial]:
    train = known if size == len(known) else known.split(size, seed=method.seed)[0]
    start = time.perf_counter()
    calibration: Calibration = method.fit(train)
    seconds = time.perf_counter() - start
    # against the check points only: the known ones that were not drawn are fewer, and differ from row to row
    evaluation = evaluate(calibration, held_out, regions=size == KNOWN)
    return calibration, evaluation, trial_from_evaluation(evaluation, method.method, size, method.seed, seconds)
