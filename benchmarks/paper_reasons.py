"""Why the paper's explicit calibration loses to its Gaussian process, and ours does not: how much no lens model holds.

For lens errors of several sizes (rms in pixels, of what no lens model contains; the account has 0.5), error in mm at
the paper's 175 positions: of its own pipeline with OpenCV from 50 + 10 and from 10 + 4 pictures, and of its Gaussian
process with our fit, trained on 157 of the positions and judged at the others. Means over rigs.

    python benchmarks/paper_reasons.py --rigs 3
"""

from __future__ import annotations

import argparse
from itertools import combinations

import numpy as np

from implicam.calibrators import calibrator
from implicam.dataset import Dataset
from implicam.simulate import ball_grid, build_rig, simulate, simulate_boards

LENS_ERRORS_PX = (0.0, 0.5, 1.0, 2.0, 4.0)
SPLITS = 3


def rms_error(calibration, data: Dataset) -> float:
    off = calibration.measure(data.observations).xyz - data.truth.xyz
    return float(np.sqrt(np.nanmean(np.sum(off**2, axis=1))))


def errors(seed: int, cameras: str, lens_error: float) -> list[float]:
    rig = build_rig("bar6", seed=seed, cameras=cameras, lens_error=lens_error)
    names = [camera.name for camera in rig.cameras]
    data = simulate(rig, ball_grid(rig), seed=seed)
    found = []
    for each, pairs in ((50, 10), (10, 4)):
        seen = [(name,) for name in names for _ in range(each)]
        seen += [pair for pair in combinations(names, 2) for _ in range(pairs)]
        boards = simulate_boards(rig, seen, seed=seed + each)
        found.append(rms_error(calibrator("explicit:paper", boards=boards).fit(data), data))
    of_splits = []
    for split in range(SPLITS):
        train, held_out = data.split(157, seed=split)
        of_splits.append(rms_error(calibrator("inverse-gp:plain").fit(train), held_out))
    return [*found, float(np.mean(of_splits))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=3)
    parser.add_argument("--cameras", default="2R2W")
    options = parser.parse_args()
    print("| lens error, px | explicit:paper, 50 + 10 | explicit:paper, 10 + 4 | inverse-gp:plain, 157 |")
    print("| --: | --: | --: | --: |")
    for lens_error in LENS_ERRORS_PX:
        mean = np.mean([errors(100 + rig, options.cameras, lens_error) for rig in range(options.rigs)], axis=0)
        print(f"| {lens_error:g} | " + " | ".join(f"{value:.3g}" for value in mean) + " |", flush=True)


if __name__ == "__main__":
    main()
