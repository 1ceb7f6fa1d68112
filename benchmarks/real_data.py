"""inverse-gp on real data of rigs that nobody here made: the table of docs/real-data.md.

    python benchmarks/real_data.py ../shared/real [-o benchmarks/results/real_data.md]

Random split: n known points at random, judged on the rest, mean over seeds. One shot (plane) left out: trained on the
others, judged on it; on a lattice that is the honest number. Errors are against the stated positions, whose own errors
(a few tenths of a millimetre per plane of rbc300) are part of them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from implicam.calibrators import InverseGP
from implicam.dataset import read_dataset
from implicam.evaluate import cross_validate, evaluate
from implicam.files import write_text


def numbers(evaluations):  # of those that measured anything
    """Means over evaluations: rmse, median, coverage per axis and of the ellipsoid, NEES."""
    rows = [e.coverage.overall for e in evaluations if e.coverage.overall.n]
    if not rows:
        return [float("nan")] * 5, float("nan")
    table = np.array(
        [
            [r.rmse, r.median_error, r.level(0.95).pooled.value, r.level(0.95).ellipsoid.value, r.nees.value]
            for r in rows
        ]
    )
    spread = table[:, 0].std(ddof=1) / np.sqrt(len(table)) if len(table) > 1 else float("nan")
    return table.mean(axis=0), spread


def line(dataset, what, evaluations):
    (rmse, median, axes, ellipsoid, nees), spread = numbers(evaluations)
    if not np.isfinite(rmse):
        return f"| {dataset} | {what} | 0 | no held-out point is seen by all cameras | | | | |"
    error = f"{rmse:.3f} ± {spread:.3f}" if np.isfinite(spread) else f"{rmse:.3f}"
    held_out = round(np.mean([e.coverage.overall.n for e in evaluations]))
    return f"| {dataset} | {what} | {held_out} | {error} | {median:.3f} | {axes:.3f} | {ellipsoid:.3f} | {nees:.1f} |"


def random_split(data, n, seeds):
    return [evaluate(InverseGP(seed=s).fit(data.split(n, seed=s)[0]), data) for s in range(seeds)]


def planes(data, label):
    """Each value of z left out in turn, inner ones apart from the outer two, which are extrapolation."""
    z = data.xyz[:, 2]
    values = np.unique(z)
    for inner, chosen in (("inner", values[1:-1]), ("outer", values[[0, -1]])):
        evaluations = [evaluate(InverseGP().fit(data.select(z != v)), data.select(z == v)) for v in chosen]
        yield line(label, f"each {inner} plane left out ({len(chosen)})", evaluations)


def report(folder):
    yield "| dataset | known points | held out | rmse 3D, mm | median, mm | 95 % per axis | 95 % ellipsoid | NEES (3) |"
    yield "|---|---|---|---|---|---|---|---|"
    data = read_dataset(folder / "rbc300")
    for n in (175, 500):
        yield line("rbc300", f"{n} at random, 10 seeds", random_split(data, n, 10))
    yield from planes(data, "rbc300")
    data = read_dataset(folder / "water-tank-target")
    yield line("water-tank-target", "175 at random, 10 seeds", random_split(data, 175, 10))
    yield from planes(data, "water-tank-target")
    data = read_dataset(folder / "two-sided-tank")
    yield line("two-sided-tank", "45 at random, 10 seeds", random_split(data, 45, 10))
    yield from planes(data, "two-sided-tank")
    data = read_dataset(folder / "image-splitter")
    yield line("image-splitter", "10-fold", [cross_validate(InverseGP().fit, data, 10)])
    yield from planes(data, "image-splitter")
    yield ""
    yield "What inverse-gp could not use, because a camera did not see it:"
    yield ""
    for name in ("two-sided-tank", "image-splitter"):
        data = read_dataset(folder / name)
        calibration = InverseGP().fit(data)
        yield f"- {name}: {len(calibration.unused)} of {len(data)} known points, each listed with its reason."
    calibration = InverseGP().fit(read_dataset(folder / "water-tank-target"))
    measured = calibration.measure(read_dataset(folder / "water-tank-particles").observations)
    sd = np.median(measured.sd[measured.measured], axis=0)
    yield (
        f"- water-tank-particles: {len(measured)} rows, {int(measured.measured.sum())} measured, calibrated on "
        f"water-tank-target; median sd {sd[0]:.3f}, {sd[1]:.3f}, {sd[2]:.3f} mm in x, y, z."
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the folder that holds rbc300, water-tank-target, ...")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    lines = []
    for text in report(options.folder):
        print(text, flush=True)
        lines.append(text)
    if options.output:
        write_text(options.output, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
