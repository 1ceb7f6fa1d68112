"""Does one kernel for correlated x, y and z help the paper's Gaussian process where points are few?

    python benchmarks/coregionalised.py --rigs 10 -o benchmarks/results/coregionalised.md

The paper names it as future work. Same points, same held-out random positions, same run: three independent processes
(`inverse-gp:plain`, the paper's model), one kernel with correlated outputs (`inverse-gp:coregionalised`), and the
default of `inverse-gp`. Intervals are over rigs.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from scipy import stats
from scipy.stats import chi2

from implicam.calibrators import calibrator_from_name
from implicam.simulate import build_rig, random_positions, simulate

METHODS = ("inverse-gp:plain", "inverse-gp:coregionalised", "inverse-gp")
SETS = ("2R", "2R4W")
POINTS = (17, 35, 157)
HELD_OUT = 300


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--rigs", type=int, default=10)
    options.add_argument("-o", "--output", type=Path)
    given = options.parse_args()
    lines = [
        "| cameras | points | method | rmse, mm | over that of independent, median | % in the 95 % ellipsoid | NEES "
        "| fit, s of CPU |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for cameras in SETS:
        for n in POINTS:
            found = {
                method: np.array([trial(cameras, n, seed, method) for seed in range(given.rigs)]) for method in METHODS
            }
            for method, of_rigs in found.items():
                ratio = np.median(of_rigs[:, 0] / found[METHODS[0]][:, 0])
                cells = [with_interval(of_rigs[:, 0]), f"{ratio:.2f}", with_interval(100 * of_rigs[:, 1])]
                cells += [f"{np.median(of_rigs[:, 2]):.3g}", f"{np.median(of_rigs[:, 3]):.2f}"]
                lines.append(f"| {cameras} | {n} | `{method}` | {' | '.join(cells)} |")
                print(lines[-1], flush=True)
    text = f"{given.rigs} rigs (seeds from 0), bar6, 0.2 px noise, 0.5 px lens errors; mean ± its standard error.\n\n"
    text += "\n".join(lines) + "\n"
    if given.output:
        given.output.write_text(text, encoding="utf-8")


def trial(cameras: str, n: int, seed: int, method: str) -> tuple[float, float, float, float]:
    """Rms error in mm, share in the 95 % ellipsoid, NEES, and seconds of CPU of the fit, on one rig."""
    rig = build_rig("bar6", seed=seed, cameras=cameras)
    known = simulate(rig, random_positions(rig, n, np.random.default_rng([seed, n])), seed=seed)
    check = simulate(rig, random_positions(rig, HELD_OUT, np.random.default_rng([seed, 2])), seed=seed + 1000)
    begin = time.process_time()
    fitted = calibrator_from_name(method).fit(known)
    seconds = time.process_time() - begin
    measured = fitted.measure(check.observations)
    good = measured.measured
    assert check.truth is not None
    off = (measured.xyz - check.truth.xyz)[good]
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(measured.cov[good]), off)
    rmse = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    return rmse, float(np.mean(squares <= chi2.ppf(0.95, 3))), float(squares.mean()), seconds


def with_interval(values: np.ndarray) -> str:
    return f"{values.mean():.3g} ± {stats.sem(values):.2g}"


if __name__ == "__main__":
    main()
