"""Both methods on real data of rigs that nobody here made: the table of docs/real-data.md.

    python benchmarks/real_data.py ../shared/real [-o benchmarks/results/real_data.md]

Random split: n known points at random, judged on the rest, mean over seeds. One shot (plane) left out: trained on the
others, judged on it; on a lattice that is the honest number. Errors are against the stated positions, whose own errors
(a few tenths of a millimetre per plane of rbc300) are part of them.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from implicam.calibrators import ForwardGP, InverseGP
from implicam.dataset import KnownPositions, read_dataset
from implicam.errors import FitError
from implicam.evaluation import cross_validate, evaluate
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


def random_split(method, data, n, seeds):
    return [evaluate(method.fit(data.split(n, seed=s)[0]), data) for s in range(seeds)]


def planes(method, data, label):
    """Each value of z left out in turn, inner ones each by itself, then the outer two, which are extrapolation."""
    z = data.xyz[:, 2]
    values = np.unique(z)

    def without(v):
        try:
            return evaluate(method.fit(data.select(z != v)), data.select(z == v))
        except FitError:  # what is left lies on one plane, say
            return None

    inner = [(v, without(v)) for v in values[1:-1]]
    tried = [e for _, e in inner if e is not None]
    refused = f", {len(inner) - len(tried)} refused" * (len(tried) < len(inner))
    yield line(label, f"each inner plane left out ({len(inner)}{refused})", tried)
    if label.startswith("rbc300"):
        for v, e in inner:
            yield line(label, f"plane z = {v:g} left out", [e])
    outer = [e for e in map(without, values[[0, -1]]) if e is not None]
    yield line(label, f"each outer plane left out ({len(outer)})", outer)


DOTS = 0.02
"""Mm: declared sd of each dot of the water tank's target, each by itself; of 0.02 ... 0.05 the most probable."""


def declared(data):
    """The same target, each dot with an error of its own."""
    known = data.positions
    return replace(data, known=KnownPositions(data.points, known.xyz, np.full(known.xyz.shape, DOTS)))


def particles(data, folder, what):
    """The real job: measure what nobody knows, and ask whether the views agree."""
    fitted = ForwardGP().fit(data)
    measured = fitted.measure(read_dataset(folder / "water-tank-particles").observations)
    uv = read_dataset(folder / "water-tank-particles").observations.uv
    residual = np.linalg.norm(fitted.predict(measured.xyz) - uv, axis=2)
    share = np.histogram(measured.consistency, 10, (0, 1))[0] / len(measured)
    yield f"water-tank-particles, forward-gp, {what}: {measured.measured.sum()} of {len(measured)} measured, median "
    yield f"residual {np.nanmedian(residual):.3f} px; p-values by tenths: {' '.join(f'{x:.2f}' for x in share)}"


METHODS = (ForwardGP(), InverseGP())


def report(folder):
    yield "| dataset | known points | held out | rmse 3D, mm | median, mm | 95 % per axis | 95 % ellipsoid | NEES (3) |"
    yield "|---|---|---|---|---|---|---|---|"
    for name, sizes in (("rbc300", (175, 500)), ("water-tank-target", (45, 175)), ("two-sided-tank", (45,))):
        data = read_dataset(folder / name)
        for method in METHODS:
            label = f"{name}, {method.method}"
            for n in sizes:
                yield line(label, f"{n} at random, 10 seeds", random_split(method, data, n, 10))
            yield from planes(method, data, label)
    data = declared(read_dataset(folder / "water-tank-target"))
    label = f"water-tank-target, dots declared to {DOTS} mm, forward-gp"
    yield line(label, "45 at random, 10 seeds", random_split(ForwardGP(), data, 45, 10))
    yield line(label, "175 at random, 2 seeds", random_split(ForwardGP(), data, 175, 2))
    data = read_dataset(folder / "image-splitter")
    for method in METHODS:
        label = f"image-splitter, {method.method}"
        yield line(label, "10-fold", [cross_validate(method.fit, data, 10)])
        yield from planes(method, data, label)
    yield ""
    target = read_dataset(folder / "water-tank-target")
    yield from particles(target, folder, "dots taken as exact")
    yield from particles(declared(target), folder, f"dots declared to {DOTS} mm")
    yield ""
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
