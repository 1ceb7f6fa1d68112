"""All methods on the same splits: the six-camera rig and the real data sets; the first table of docs/choose.md.

    python benchmarks/methods.py ../shared/real [--rigs 5] [-o benchmarks/results/methods.md]

Six cameras (bar6): lens errors of 0.5 px rms, 0.2 px noise, random positions, judged at 300 other ones; mean
over rigs. Real data: mean over three random splits; and each inner plane across z left out in turn, trained on as many
points of the others. A cell: rmse in mm ± standard error, and how many % of the points lie in their 95 % ellipsoids.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from implicam.calibrators import MLP, Explicit, ForwardGP, InverseGP
from implicam.compare import Split, compare_on, plane_splits, random_splits, summarise
from implicam.dataset import read_dataset
from implicam.files import write_text
from implicam.simulate import build_rig, random_positions, simulate

METHODS = {
    "forward-gp": ForwardGP(),
    "forward-gp:none": ForwardGP(lens="none"),
    "explicit": Explicit(),
    "inverse-gp": InverseGP(),
    "inverse-gp:paper": InverseGP(preset="paper"),
    "mlp": MLP(),
    "mlp:no-dropout": MLP(dropout=0.0),
}
SIZES = (17, 35, 87, 157)
REAL = {"rbc300": 175, "water-tank-target": 175, "two-sided-tank": 45, "image-splitter": 45}
"""Data set -> known points to train on."""


def six_cameras(rigs):
    for n in SIZES:
        splits = []
        for seed in range(rigs):
            rig = build_rig("bar6", seed=seed, frame="random")
            known = simulate(rig, random_positions(rig, n, np.random.default_rng([seed, n, 1])), seed=seed + 200)
            others = simulate(rig, random_positions(rig, 300, np.random.default_rng([seed, 2])), seed=seed + 400)
            splits.append(Split("random", known, others, seed))
        yield f"6 cameras, {n}", splits


def real(folder):
    for name, n in REAL.items():
        data = read_dataset(folder / name)
        yield f"{name}, {n} at random", random_splits(data, [n], seeds=3)
        planes = [split for split in plane_splits(data) if split.kind == "plane z"]
        fewest = min(len(split.train) for split in planes)
        cut = [split for split in plane_splits(data, [min(n, fewest)]) if split.kind == "plane z"]
        yield f"{name}, inner plane of z left out, {min(n, fewest)}", cut


def short(x):
    return f"{x:.1g}" if x < 9.5 else f"{round(x, -1):.0f}"


def cell(row):
    if not row.seeds or not np.isfinite(row.mean["rmse"]):
        return "no result"
    text = f"{row.mean['rmse']:.3g}"
    if np.isfinite(row.standard_error["rmse"]):
        text += f" ± {short(row.standard_error['rmse'])}"
    text += f" / {100 * row.mean['ellipsoid_95']:.0f} %"
    return text + (f", {100 * row.mean['measured']:.0f} % measured" if row.mean["measured"] < 0.995 else "")


def report(folder, rigs):
    yield f"| data, known points | {' | '.join(METHODS)} |"
    yield "|---" * (len(METHODS) + 1) + "|"
    seconds = {}
    for label, splits in [*six_cameras(rigs), *(real(folder) if folder else ())]:
        rows = {row.method: row for row in summarise(compare_on(splits, METHODS))}
        yield f"| {label} | {' | '.join(cell(rows[name]) for name in METHODS)} |"
        seconds[label] = [rows[name].mean["fit_seconds"] for name in METHODS]
    yield ""
    yield f"| seconds of one fit | {' | '.join(METHODS)} |"
    yield "|---" * (len(METHODS) + 1) + "|"
    for label in seconds:
        if label.endswith((", 35", ", 157", "175 at random")):
            yield f"| {label} | {' | '.join(f'{s:.2g}' for s in seconds[label])} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="the folder that holds rbc300, water-tank-target, ...")
    parser.add_argument("--rigs", type=int, default=5)
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    lines = []
    for text in report(options.folder, options.rigs):
        print(text, flush=True)
        lines.append(text)
    if options.output:
        write_text(options.output, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
