"""inverse-gp as it is by default (`smooth`), and the paper's model (`plain`): the tables of docs/decisions/0017.

    python benchmarks/inverse_gp.py [../shared/real] [--rigs 8] [--only simulated,real] [-o FILE]

Simulated: each row pools `--rigs` rigs (lens errors of 0.5 px rms, 0.2 px noise, random positions, an arbitrary world
frame), 300 held-out random positions each. Real: random splits, 5 seeds; and each inner plane left out. Right values:
95 % in the ellipsoid, NEES 3.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from implicam.calibrators import calibrator_from_name
from implicam.coverage import assess
from implicam.dataset import read_dataset
from implicam.files import write_text
from implicam.simulate import build_rig, random_positions, simulate

RIGS = {
    "stereo": ("stereo", None),
    "4 cameras": ("bar6", "2R2W"),
    "6 cameras": ("bar6", None),
    "dome8": ("dome8", None),
}
METHODS = ("inverse-gp:plain", "inverse-gp")
HELD_OUT = 300
SPLITS = {"water-tank-target": 175, "two-sided-tank": 45, "rbc300": 175}


def row(label, outcomes, seconds):
    """Errors, covariances and limits of several fits, as one line of a table."""
    errors, cov, limit = (np.concatenate([o[k] for o in outcomes]) for k in range(3))
    clusters = np.concatenate([np.full(len(o[0]), str(i)) for i, o in enumerate(outcomes)])
    s = assess(errors, cov, clusters=clusters, limit=limit).overall
    rms = [np.sqrt(np.nanmean(np.sum(o[0] ** 2, axis=1))) for o in outcomes]
    level = s.level(0.95)
    ratio = f"{s.rmse_over_limit:.2f}" if np.isfinite(limit).all() else ""
    return (
        f"| {label} | {np.mean(rms):.4g} ± {np.std(rms, ddof=1) / np.sqrt(len(rms)):.2g} | {ratio} | "
        f"{level.pooled.value:.3f} | {level.ellipsoid.value:.3f} | {s.nees.value:.2f} | "
        f"{np.isnan(errors[:, 0]).sum()} of {len(errors)} | {np.mean(seconds):.2f} |"
    )


HEAD = (
    "| data, known points, method | rmse, mm | rmse / limit | 95 % per axis | ellipsoid | NEES | not measured | s |\n"
    "|---|---|---|---|---|---|---|---|"
)


def outcome(method, known, others, truth, limit):
    """Errors, covariances, limits; and the seconds of the fit."""
    started = time.perf_counter()
    calibration = calibrator_from_name(method).fit(known)
    seconds = time.perf_counter() - started
    m = calibration.measure(others.observations)
    return (m.xyz - truth, m.cov, limit), seconds


def simulated(options):
    """Random positions in front of simulated rigs."""
    yield HEAD
    for n in (17, 35, 157):
        for rig_name, (spec, cameras) in RIGS.items():
            pairs = []
            for seed in range(options.rigs):
                rig = build_rig(spec, seed=seed, frame="random", cameras=cameras)
                known = simulate(rig, random_positions(rig, n, np.random.default_rng(seed + 100)), seed=seed + 200)
                xyz = random_positions(rig, HELD_OUT, np.random.default_rng(seed + 300))
                pairs.append((known, simulate(rig, xyz, seed=seed + 400)))
            for method in METHODS:
                found = [
                    outcome(method, k, complete(o), complete(o).truth.xyz, complete(o).truth.limit) for k, o in pairs
                ]
                yield row(f"{rig_name}, {n}, {method}", *zip(*found, strict=True))


def complete(data):
    return data.select(data.observations.seen.all(axis=1))


def real(options):
    """Targets that nobody here made."""
    yield HEAD
    for name, n in SPLITS.items():
        data = complete(read_dataset(options.folder / name))
        z = data.xyz[:, 2]
        parts = {f"{name}, {n} at random": [], f"{name}, each inner plane left out": []}
        for seed in range(5):
            known = data.split(n, seed=seed)[0]
            parts[f"{name}, {n} at random"].append((known, data.select(~np.isin(data.points, known.points))))
        for value in np.unique(z)[1:-1]:
            parts[f"{name}, each inner plane left out"].append((data.select(z != value), data.select(z == value)))
        for label, pairs in parts.items():
            for method in METHODS:
                found = [outcome(method, k, o, o.xyz, np.full((len(o), 3, 3), np.nan)) for k, o in pairs]
                yield row(f"{label}, {method}", *zip(*found, strict=True))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("../shared/real"))
    parser.add_argument("--rigs", type=int, default=8)
    parser.add_argument("--only", default="simulated,real")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    lines = []
    for part in options.only.split(","):
        for text in {"simulated": simulated, "real": real}[part](options):
            print(text, flush=True)
            lines += text.splitlines()
        lines.append("")
    if options.output:
        write_text(options.output, "\n".join(lines))


if __name__ == "__main__":
    main()
