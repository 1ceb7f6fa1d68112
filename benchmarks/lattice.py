"""What the shortest lengthscale allowed does on lattice and on random known positions: the table of decision 4.

    python benchmarks/lattice.py

bar6, 157 known points, 0.2 px noise; rmse / Cramer-Rao limit at 300 random positions, mean of three rigs.
"""

from __future__ import annotations

import numpy as np

from implicam.calibrators import InverseGP
from implicam.calibrators.inverse_gp import UNIFORM_EXTENT_SDS
from implicam.evaluation import evaluate
from implicam.simulate import ball_grid, build_rig, random_positions, simulate

BOUNDS = (0.05, 2.0, 3.0, UNIFORM_EXTENT_SDS, 5.0, 8.0)


def ratio(cameras, lattice, shortest, seed):
    rig = build_rig("bar6", seed=seed, cameras=cameras)
    target = ball_grid(rig) if lattice else random_positions(rig, 157, np.random.default_rng(seed))
    known = simulate(rig, target, seed=seed)
    if lattice:
        known = known.split(157, seed=0)[0]
    held_out = simulate(rig, random_positions(rig, 300, np.random.default_rng(2)), seed=2)
    calibration = InverseGP(preset="plain", shortest_lengthscale=shortest).fit(known)
    return evaluate(calibration, held_out, regions=False).coverage.overall.rmse_over_limit


def main():
    print("| cameras, known positions |", " | ".join(f"{bound:.2f}" for bound in BOUNDS), "|")
    print("|---" * (len(BOUNDS) + 1) + "|")
    for lattice in (True, False):
        for cameras, label in (("2R", "2"), ("2R2W", "4"), ("2R4W", "6")):
            means = [np.mean([ratio(cameras, lattice, bound, seed) for seed in (1, 2, 3)]) for bound in BOUNDS]
            print(f"| {label}, {'lattice' if lattice else 'random'} |", " | ".join(f"{m:.2f}" for m in means), "|")


if __name__ == "__main__":
    main()
