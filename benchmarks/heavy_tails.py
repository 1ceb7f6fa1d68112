"""Pixel noise with heavy tails: the table of docs/decisions/0016.

    python benchmarks/heavy_tails.py [--points 120,40] [-o benchmarks/results/heavy_tails.md]

Rigs with three cameras or more (ten), and stereo pairs (five); 0.2 px noise of each pixel coordinate: Student's t with
three degrees of freedom (t3), the same of both coordinates together (t3 of views), or normal. "as normal": the same
program where noise is always taken for normal. 300 fresh points per rig, with the same noise. rmse: the geometric mean
over rigs; ratio: of heavy tails over that as normal.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from implicam.calibrators import ForwardGP
from implicam.calibrators.forward_gp import heavy_tail_fit
from implicam.dataset import Observations
from implicam.files import write_text
from implicam.simulate import build_rig, random_positions, simulate

RIGS = [("bar3", 0), ("bar3", 1), ("bar4", 0), ("bar4", 1), ("bar6", 0), ("bar6", 1), ("bar6", 2), ("dome8", 0)]
RIGS += [("dome8", 1), ("dome8", 2)]
STEREO = [("stereo", seed) for seed in range(5)]
SCALE = 0.2
TOLD = heavy_tail_fit.looks_heavy


def drawn(kind, shape, draw):
    if kind == "normal":
        return draw.normal(size=shape)
    if kind == "t3":
        return draw.standard_t(3, size=shape)
    return draw.normal(size=shape) / np.sqrt(draw.chisquare(3, size=shape[:2]) / 3)[..., None]


def dataset(spec, seed, n, kind, which):
    rig = build_rig(spec, seed=seed)
    data = simulate(rig, random_positions(rig, n, np.random.default_rng([seed, which])), seed=2 * seed + which)
    o = data.observations
    true = np.stack([np.where(o.extra[c] == "", "nan", o.extra[c]).astype(float) for c in ("true_u", "true_v")], axis=2)
    noise = SCALE * drawn(kind, true.shape, np.random.default_rng([seed, which, 99]))
    return replace(data, observations=Observations(o.points, o.cameras, true + noise, o.sd))


def trial(data, judged, heavy):
    heavy_tail_fit.looks_heavy = TOLD if heavy else lambda *_: False
    start = time.process_time()
    calibration = ForwardGP().fit(data)
    seconds = time.process_time() - start
    measured = calibration.measure(judged.observations)
    ok = measured.measured
    error = (measured.xyz - judged.truth.xyz)[ok]
    distance = np.einsum("ni,nij,nj->n", error, np.linalg.inv(measured.cov[ok]), error)
    told = calibration.fitted.tails is not None
    return np.mean(np.sum(error**2, axis=1)), distance, len(calibration.rejected), told, seconds


def report(sizes):
    yield "| rigs | noise | known points | | in the 95 % ellipsoid | NEES | rmse, mm | ratio | views rejected | tails seen | fit, s |"  # noqa: E501
    yield "|---|---|---|---|---|---|---|---|---|---|---|"
    for what, rigs in (("three cameras or more", RIGS), ("stereo", STEREO)):
        for kind in ("t3", "t3 of views", "normal"):
            for n in sizes:
                before = None
                for heavy in (False, True):
                    found = [
                        trial(dataset(*rig, n, kind, 1), dataset(*rig, 300, kind, 2), heavy)  # noqa: RUF100
                        for rig in rigs
                    ]
                    squares, distance, rejected, told, seconds = zip(*found, strict=True)
                    distance = np.concatenate(distance)
                    rmse = np.exp(0.5 * np.mean(np.log(squares)))
                    ratio = "" if before is None else f"{rmse / before:.3f}"
                    before = rmse
                    yield (
                        f"| {what} | {kind} | {n} | {'heavy tails' if heavy else 'as normal'} "
                        f"| {100 * np.mean(distance < chi2.ppf(0.95, 3)):.1f} % | {distance.mean():.2f} | {rmse:.4f} "
                        f"| {ratio} | {sum(rejected)} | {sum(told)} of {len(rigs)} | {np.mean(seconds):.2f} |"
                    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--points", default="120,40")
    options = parser.parse_args()
    lines = []
    for line in report([int(n) for n in options.points.split(",")]):
        print(line, flush=True)
        lines.append(line)
    if options.output:
        write_text(options.output, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
