"""Everything once: simulate a rig, calibrate it with more and more known points, measure, judge, report.

Our method and the paper's, side by side on the same points.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from implicam.calibrators import Calibration, ForwardGP, InverseGP
from implicam.compare import Trial, trial_of
from implicam.dataset import Dataset, folder_files, write_dataset
from implicam.errors import UsageError, import_extra
from implicam.evaluate import Evaluation, evaluate
from implicam.files import toml_text
from implicam.progress import Progress, silent
from implicam.report import report_of, write_report
from implicam.simulate import Rig, build_rig, random_positions, simulate, write_rig

RIG, KNOWN, HELD_OUT = "bar6", 157, 500
SETS = {"2R": "2 cameras", "2R2W": "4 cameras", "2R4W": "6 cameras"}
SIZES = (17, 35, KNOWN)
METHODS = (ForwardGP, InverseGP)
BEST = ForwardGP.method
"""The method whose calibration with all cameras and points is kept, with its report."""
MADE_HERE = "# made by implicam demo, which may replace this folder\n"


@dataclass(frozen=True, eq=False)
class DemoRow:
    """One line of the demo's table."""

    cameras: str
    trial: Trial


@dataclass(frozen=True, eq=False)
class Demo:
    """What the demo made: the table, and the files."""

    rows: list[DemoRow]
    unit: str
    dataset: Path
    calibration: Path
    measured: Path
    report: Path


def run(folder: Path, *, seed: int = 0, progress: Progress = silent) -> Demo:
    """Run the demo into `folder`, a new one or that of an earlier demo, which it replaces."""
    if not may_replace(folder):
        raise UsageError(
            f"{folder} exists and was not made by the demo.", fix="give another folder: implicam demo OTHER-NAME"
        )
    import_extra("plotly", "report", "the report of the demo")  # before the work, not after
    steps = len(SETS) * len(SIZES) * len(METHODS) + 2
    progress("simulating", 0, steps)
    rig = build_rig(RIG, seed=seed)
    known, held_out = record(rig, KNOWN, seed=seed, shots=1), record(rig, HELD_OUT, seed=seed, shots=2)
    unit = known.length_unit
    extra = {
        "truth.toml": MADE_HERE + toml_text(write_rig(rig)),
        **{f"check/{k}": v for k, v in folder_files(held_out).items()},
    }
    write_dataset(known, folder, overwrite=True, also=extra)
    rows: list[DemoRow] = []
    best: tuple[Calibration, Evaluation] | None = None
    for cameras, label in SETS.items():
        part = build_rig(RIG, seed=seed, cameras=cameras)
        known, held_out = record(part, KNOWN, seed=seed, shots=1), record(part, HELD_OUT, seed=seed, shots=2)
        for size, method in product(SIZES, METHODS):
            progress("calibrating and measuring", len(rows), steps)
            calibration, evaluation, trial = _one(method(seed=seed), known, held_out, size)
            rows.append(DemoRow(label, trial))
            if trial.method == BEST:
                best = calibration, evaluation
    assert best is not None
    progress("reporting", steps - 1, steps)
    demo = Demo(rows, unit, folder, folder / "rig.implicam", folder / "measured.csv", folder / "report.html")
    calibration, evaluation = best
    calibration.save(demo.calibration)
    evaluation.measurement.write_csv(demo.measured)
    write_report(demo.report, report_of(evaluation, "implicam demo: a simulated six-camera rig"))
    progress("reporting", steps, steps)
    return demo


def may_replace(folder: Path) -> bool:
    """Whether nothing of anybody else stands there: nothing at all, or an earlier demo."""
    if not folder.is_dir():
        return not folder.exists()
    truth = folder / "truth.toml"
    return not any(folder.iterdir()) or (truth.is_file() and truth.read_bytes().startswith(MADE_HERE.encode()))


def record(rig: Rig, n: int, *, seed: int, shots: int) -> Dataset:
    """`n` random positions of the ball, seen by the rig; every `shots` gives others."""
    target = random_positions(rig, n, np.random.default_rng([seed, shots]))
    return simulate(rig, target, seed=1000 * seed + shots)


def _one(
    method: ForwardGP | InverseGP, known: Dataset, held_out: Dataset, size: int
) -> tuple[Calibration, Evaluation, Trial]:
    train = known if size == len(known) else known.split(size, seed=method.seed)[0]
    start = time.perf_counter()
    calibration: Calibration = method.fit(train)
    seconds = time.perf_counter() - start
    # against the check points only: the known ones that were not drawn are fewer, and differ from row to row
    evaluation = evaluate(calibration, held_out, regions=size == KNOWN)
    return calibration, evaluation, trial_of(evaluation, method.method, size, method.seed, seconds)
