"""The default method on real data before and after a change: errors of the same splits, and their paired difference.

    python benchmarks/real_paired.py ../shared/real -o after.json
    PYTHONPATH=/checkout/of/before/src python benchmarks/real_paired.py ../shared/real -o before.json
    python benchmarks/real_paired.py --compare before.json after.json          the table of docs/real-data.md

rms error against the stated positions, of held-out points that both measure, mean over seeds; the difference with its
standard error.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from implicam.calibrators import ForwardGP
from implicam.dataset import read_dataset
from implicam.errors import FitError

ROWS = (
    ("water-tank-target", 45, 10),
    ("water-tank-target", 175, 10),
    ("two-sided-tank", 45, 10),
    ("image-splitter", 45, 10),
    ("rbc300", 175, 10),
    ("rbc300", 500, 5),
)
"""Data set, known points, seeds."""


def squared_errors(data, n, seed):
    """Of each held-out point; NaN where it is not measured."""
    train, held_out = data.split(n, seed=seed)
    try:
        measured = ForwardGP().fit(train).measure(held_out.observations)
    except FitError:
        return [float("nan")] * len(held_out)
    return np.sum((measured.xyz - held_out.xyz) ** 2, axis=1).tolist()


def compared(before, after):
    yield "| random split | before | now | difference |"
    yield "|---|---|---|---|"
    for name, seeds in after.items():
        rms = []
        for one, other in zip(before[name], seeds, strict=True):
            both = np.array([one, other])[:, np.isfinite([one, other]).all(axis=0)]
            rms.append(np.sqrt(both.mean(axis=1)))
        mean, difference = np.mean(rms, axis=0), np.diff(rms, axis=1)
        error = difference.std(ddof=1) / np.sqrt(len(rms))
        yield f"| {name}, {len(rms)} seeds | {mean[0]:.4f} | {mean[1]:.4f} | {difference.mean():.4f} ± {error:.4f} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("-o", "--output", type=Path, default=Path("real_paired.json"))
    parser.add_argument("--compare", type=Path, nargs=2)
    options = parser.parse_args()
    if options.compare:
        print("\n".join(compared(*(json.loads(path.read_text()) for path in options.compare))))
        return
    found = {}
    for name, n, seeds in ROWS:
        data = read_dataset(options.folder / name)
        found[f"{name}, {n}"] = [squared_errors(data, n, seed) for seed in range(seeds)]
        options.output.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
