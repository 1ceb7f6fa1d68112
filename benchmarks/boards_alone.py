"""Real boards held by hand before webcams without a trigger: how far apart are neighbouring corners, as measured?

    OPENBLAS_NUM_THREADS=1 python benchmarks/boards_alone.py ../shared/real/caliscope-charuco [--folds 2]

`explicit` from the boards alone, then every corner that two cameras saw is measured, and its distance to each neighbour
along rows and columns is compared with the square. With --folds each part of the shots is measured by a calibration
from the others.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import implicam as ic
from implicam.calibrators import Explicit
from implicam.dataset.boards import CORNER, corner_positions


def neighbours(data):
    """(n, 2) pairs of rows whose corners are a square apart on the same board."""
    found = [CORNER.fullmatch(str(point)) for point in data.points]
    flat = corner_positions(data.extra["target"]) / data.extra["target"]["square"]
    at = np.array([flat[int(match["number"]) - 1] for match in found])
    shots = np.array([match["shot"] for match in found])
    apart = np.abs(at[:, None] - at[None]).sum(axis=2)
    pairs = np.argwhere((shots[:, None] == shots[None]) & (np.abs(apart - 1) < 1e-6))
    return pairs[pairs[:, 0] < pairs[:, 1]]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--folds", type=int, default=1)
    options = parser.parse_args()
    data = ic.read_dataset(options.dataset)
    metres = data.metres_per_unit
    shots = np.array([CORNER.fullmatch(str(point))["shot"] for point in data.points])
    number = np.unique(shots, return_inverse=True)[1] % options.folds
    xyz = np.full((len(data), 3), np.nan)
    for fold in range(options.folds):
        mine = number == fold
        calibration = Explicit().fit(data.select(~mine) if options.folds > 1 else data)
        xyz[mine] = calibration.measure(data.observations.select(mine)).xyz
    pairs = neighbours(data)
    off = 1e3 * metres * (np.linalg.norm(xyz[pairs[:, 0]] - xyz[pairs[:, 1]], axis=1) - data.extra["target"]["square"])
    there = off[np.isfinite(off)]
    print(
        f"{len(there)} of {len(pairs)} neighbours measured: |distance - square| {np.median(np.abs(there)):.3f} mm "
        f"median, {np.sqrt(np.mean(there**2)):.3f} mm rms, mean {there.mean():+.3f} mm"
    )


if __name__ == "__main__":
    main()
