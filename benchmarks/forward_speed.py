"""Speed and memory of forward-gp: the second table of docs/speed.md.

    python benchmarks/forward_speed.py [-o benchmarks/results/forward_speed.md]

Simulated bar6 rig, six cameras. GPyTorch: the paper's three GPs on the same 157 points (Adam 0.1, 100 steps), as in
gp_fit.py. Medians of 5 fits. Memory is the peak of the whole process, after the line's work, in a process of its own.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from implicam.calibrators import ForwardGP
from implicam.files import write_text
from implicam.simulate import build_rig, moving_board, random_positions, simulate


def known(n):
    rig = build_rig("bar6", seed=3)
    return simulate(rig, random_positions(rig, n, np.random.default_rng(1)), seed=4)


def boards():
    rig = build_rig("bar6", seed=3)
    return simulate(rig, moving_board(rig), seed=4)


def fit_seconds(data, runs=5):
    def once():
        start = time.perf_counter()
        ForwardGP().fit(data)
        return time.perf_counter() - start

    once()
    return statistics.median(once() for _ in range(runs))


def gpytorch_seconds():
    from gp_fit import problem, with_gpytorch

    X, Y = problem(157, 12, 0)
    times = []
    for _ in range(3):
        start = time.perf_counter()
        with_gpytorch(X, Y)
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def small(_):
    return {n: fit_seconds(known(n)) for n in (17, 35, 157)}, fit_seconds(boards(), 3), gpytorch_seconds()


def large(n):
    data = known(n)
    before = peak()
    start = time.perf_counter()
    calibration = ForwardGP().fit(data)
    fitted = time.perf_counter() - start
    start = time.perf_counter()
    calibration.measure(data.observations)
    return before, fitted, time.perf_counter() - start, peak()


def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # GB on Linux


def in_its_own_process(work, argument):
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, argument).result()


def report():
    fits, board, gpytorch = in_its_own_process(small, None)
    yield "| what | seconds |"
    yield "|---|---|"
    for n, seconds in fits.items():
        yield f"| fit, {n} points, six cameras | {seconds:.2f} |"
    yield f"| GPyTorch, the paper's three GPs, 157 points | {gpytorch:.2f} ({gpytorch / fits[157]:.1f} times ours) |"
    yield f"| fit, 20 boards = 1760 corners, six cameras | {board:.2f} ({board / fits[157]:.1f} times 157 points) |"
    before, fitted, measured, after = in_its_own_process(large, 100_000)
    yield f"| fit, 100,000 points, six cameras | {fitted:.0f} |"
    memory = f"peak memory {after:.2f} GB, {before:.2f} of it the data"
    yield f"| measure the same 100,000 points | {measured:.0f} ({memory}) |"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    lines = []
    for line in report():
        print(line, flush=True)
        lines.append(line)
    if options.output:
        write_text(options.output, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
