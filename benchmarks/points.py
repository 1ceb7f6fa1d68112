"""Cameras from points that nobody knows and one known length, without a wand: how exact, and are error bars true?

    python benchmarks/points.py bar4 dome6 --rigs 4                one length, which is exact
    python benchmarks/points.py bar4 --bars 8 --points 60          eight scale bars, 60 points
    python benchmarks/points.py bar4 --relative-sd 0.003           the length is off by as much, and stated so

Rigs as in benchmarks/wand.py (lens errors of 0.5 px, 0.2 px noise, no guess); points anywhere in the volume, 20 % of
the views missing, 5 % wrong. Bars are longer than 0.7 of the volume's shortest edge; their ends may have wrong views.
500 other positions are measured. The true points are laid over those of the calibration without any change of scale.

*rmse / limit*: over what perfectly known cameras would reach. *in 95 %*, *NEES*: 0.95 and 3 are right. *lengths*: of
100 pairs, in their 95 % intervals, and rms of error over sd. *scale*: mean error of lengths in 1e-4. CPU seconds.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from time import process_time

import numpy as np
from scipy.stats import chi2

import implicam as ic
from implicam.dataset.scale_bars import ScaleBar, in_one_line
from implicam.derived import distances
from implicam.errors import ImplicamError
from implicam.geometry import register
from implicam.simulate import build_rig, random_positions, simulate

COLUMNS = (
    "rmse / limit",
    "in 95 %",
    "NEES",
    "lengths in 95 %",
    "error / sd",
    "scale, 1e-4",
    "wrong views used",
    "CPU s",
)
MIN_BAR = 0.7


def one(kind: str, seed: int, points: int, bars: int, relative_sd: float) -> dict[str, float] | None:
    """A rig; None where it cannot be calibrated."""
    rig, rng = build_rig(kind, seed=seed, lens_error=0.5), np.random.default_rng([seed, 3])
    target = random_positions(rig, points, np.random.default_rng([seed, 11]))
    recorded = simulate(rig, target, seed=seed, outliers=0.05, missing=0.2)
    held = simulate(rig, random_positions(rig, 500, np.random.default_rng([seed, 2])), seed=seed + 1_000_003)
    free, chosen = list(rng.permutation(np.flatnonzero(recorded.observations.seen.sum(axis=1) >= 3))), []
    while len(chosen) < bars and len(free) > 1:
        i = free.pop(0)
        away = np.linalg.norm(target.xyz[free] - target.xyz[i], axis=1)
        far = np.flatnonzero(away > MIN_BAR * min(rig.volume.size))
        if len(far):
            j, length = free.pop(int(far[0])), float(away[far[0]])
            stated = length * (1 + relative_sd * float(rng.normal()))
            chosen.append(ScaleBar(str(target.points[i]), str(target.points[j]), stated, relative_sd * length))
    began = process_time()
    try:
        calibration = ic.ForwardGP(scale_bars=in_one_line(chosen)).fit(replace(recorded, known=None, extra={}))
    except ImplicamError as error:
        print(f"{kind} {seed}: {error.what}", flush=True)
        return None
    seconds = process_time() - began
    row = {str(name): i for i, name in enumerate(recorded.points)}
    rows = np.array([row[str(name)] for name in calibration.data.points])
    wrong = np.asarray(recorded.observations.extra["outlier"]) == "1"
    used = calibration.data.observations.seen.copy()
    for view in calibration.rejected:
        used[np.flatnonzero(calibration.data.points == view.point), calibration.camera_names.index(view.camera)] = False
    to_truth, _ = register(calibration.data.xyz, target.xyz[rows])
    measured = calibration.measure(held.observations)
    good = np.flatnonzero(measured.measured)
    error = to_truth.apply(measured.xyz[good]) - held.truth.xyz[good]
    cov = to_truth.rotation @ measured.cov[good] @ to_truth.rotation.T
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    limit = np.trace(held.truth.limit[good], axis1=1, axis2=2)
    pairs = [tuple(map(int, rng.choice(good, 2, replace=False))) for _ in range(100)]
    found, true = distances(measured, pairs), [np.linalg.norm(np.subtract(*held.truth.xyz[list(p)])) for p in pairs]
    off = np.array([length.value for length in found]) - true
    z = off / [length.sd for length in found]
    numbers = (
        np.sqrt(np.mean(np.sum(error**2, axis=1)) / np.mean(limit)), np.mean(nees < chi2.ppf(0.95, 3)), np.mean(nees),
        np.mean(np.abs(z) < 1.96), np.sqrt(np.mean(z**2)), 1e4 * np.mean(off / true), (wrong[rows] & used).sum(),
        seconds,
    )  # fmt: skip
    return dict(zip(COLUMNS, map(float, numbers), strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="+")
    parser.add_argument("--rigs", type=int, default=4)
    parser.add_argument("--seed0", type=int, default=100)
    parser.add_argument("--points", type=int, default=300)
    parser.add_argument("--bars", type=int, default=1)
    parser.add_argument("--relative-sd", type=float, default=0.0)
    args = parser.parse_args()
    print(f"| rig | started | {' | '.join(COLUMNS)} |\n|{'---|' * (2 + len(COLUMNS))}", flush=True)
    for kind in args.kinds:
        seeds = range(args.seed0, args.seed0 + args.rigs)
        rows = [row for s in seeds if (row := one(kind, s, args.points, args.bars, args.relative_sd)) is not None]
        told = (f"{np.mean([r[c] for r in rows]):.2f} ± {np.std([r[c] for r in rows]) / len(rows) ** 0.5:.2f}"
                for c in COLUMNS) if rows else ["-"] * len(COLUMNS)  # fmt: skip
        print(f"| {kind} | {len(rows)} of {args.rigs} | {' | '.join(told)} |", flush=True)


if __name__ == "__main__":
    main()
