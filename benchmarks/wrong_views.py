"""What wrong views cost and which are found: the tables of docs/decisions/0016.

    python benchmarks/wrong_views.py [--exhaustive] [-o benchmarks/results/wrong_views.md]

Simulated rigs, 80 known points. Every point measured has one wrong view (or two, or three), off by so many pixels in
any direction. time: of measuring them, over that of the same points without wrong views (CPU, one process). found:
the wrong views, and no other, are left out; other: a view that is right is left out; none: no views left out.
--exhaustive tries all choices too (one and two views): how many points it decides and how many of these alike.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np

from implicam.calibrators import ForwardGP
from implicam.files import write_text
from implicam.rig_model.triangulate import locate
from implicam.simulate import build_rig, random_positions, simulate

RIGS = {"bar3": 400, "bar4": 400, "bar6": 400, "dome8": 400, "dome30": 120, "dome100": 40}
"""Points measured with each; as many as stay below the seconds one waits."""
SIZES = (3, 10, 50, 300)
KNOWN = 80


def prepared(spec, n):
    """A rig's posterior, pixels and noise of n points that all cameras see."""
    rig = build_rig(spec, seed=3)
    calibration = ForwardGP().fit(simulate(rig, random_positions(rig, KNOWN, np.random.default_rng(1)), seed=4))
    data = simulate(rig, random_positions(rig, 3 * n, np.random.default_rng(7)), seed=8)
    data = data.select(np.argsort(-data.observations.seen.sum(axis=1), kind="stable")[:n])
    return calibration.posterior, *calibration.map.views(data.observations)


def spoilt(uv, count, size, seed=0):
    """Pixels with `count` wrong views of each point, and which."""
    draw = np.random.default_rng([seed, count, size])
    seen = np.isfinite(uv).all(axis=2)
    order = np.argsort(np.where(seen, draw.random(seen.shape), 2), axis=1)[:, :count]
    wrong = np.zeros_like(seen)
    np.put_along_axis(wrong, order, True, axis=1)
    angle = draw.uniform(0, 2 * np.pi, seen.shape)
    off = size * np.stack([np.cos(angle), np.sin(angle)], axis=2)
    return uv + np.where(wrong[..., None], off, 0), wrong


def seconds(work, runs=3):
    times = []
    for _ in range(runs):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def row(posterior, uv, noise, clean, count, size, exhaustive):
    bad, wrong = spoilt(uv, count, size)
    found = locate(posterior, bad, noise)
    cost = seconds(lambda: locate(posterior, bad, noise)) / clean
    right = (found.left_out == wrong).all(axis=1)
    other = (found.left_out & ~wrong).any(axis=1)
    none = ~found.left_out.any(axis=1)
    text = f"{cost:.1f} | {100 * right.mean():.1f} % | {100 * other.mean():.2f} % | {100 * none.mean():.1f} %"
    if not exhaustive or count > 2 or uv.shape[1] > 8:
        return text + (" | | |" if exhaustive else " |")
    from exhaustive_views import by_trying_all

    start = time.process_time()
    _, _, all_tried = by_trying_all(posterior, bad, noise)
    cost = (time.process_time() - start) / clean
    decided = all_tried.any(axis=1)
    same = (all_tried == found.left_out).all(axis=1)
    wrongly = (all_tried & ~wrong).any(axis=1)
    decides = f"{100 * decided.mean():.1f} %, of it wrongly {100 * wrongly.mean():.2f} %"
    return f"{text} {decides}; {cost:.0f} times | {100 * same[decided].mean() if decided.any() else 100:.2f} % |"


def report(rigs, exhaustive):
    more = " all tried: decides; costs | alike |" if exhaustive else ""
    yield "| rig | wrong views | off by, px | time | found | other | none |" + more
    yield "|---|---|---|---|---|---|---|" + ("---|---|" if exhaustive else "")
    for spec in rigs:
        posterior, uv, noise = prepared(spec, RIGS[spec])
        clean = seconds(lambda: locate(posterior, uv, noise))  # noqa: B023
        for count in (1, 2, 3):
            if 2 * count + 1 > uv.shape[1] or (count == 3 and uv.shape[1] < 8):
                continue
            for size in SIZES:
                yield f"| {spec} | {count} | {size} | {row(posterior, uv, noise, clean, count, size, exhaustive)}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--rigs", default=",".join(RIGS))
    parser.add_argument("--exhaustive", action="store_true")
    options = parser.parse_args()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # threads of a BLAS that wait would count
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    lines = []
    for line in report(options.rigs.split(","), options.exhaustive):
        print(line, flush=True)
        lines.append(line)
    if options.output:
        write_text(options.output, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
