"""Speed of small fits of forward-gp beside GPyTorch, and where the time of a fit goes.

    python benchmarks/forward_speed.py [-o benchmarks/results/forward_speed.md]
    python benchmarks/forward_speed.py --stages       only where the processor time of a fit goes

Simulated bar6 rig, six cameras. GPyTorch: the paper's three GPs on the same 157 points (Adam 0.1, 100 steps), as in
gp_fit.py. Medians of 5 fits. Large rigs: large_rigs.py.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import patch

import numpy as np

from implicam.calibrators import ForwardGP
from implicam.calibrators.forward_gp import calibration, fit, position_error_fit, rounds
from implicam.files import write_text
from implicam.simulate import build_rig, moving_board, random_positions, simulate
from implicam.verdict import judge
from odd_rigs import draw

STAGES = {
    "kinds": (fit, "_start_cameras"),
    "sizes": (rounds, "estimate_hyperparameters"),
    "posterior": (rounds, "iterate_linearisation"),
    "wrong views": (fit, "update_inliers"),
    "tails": (position_error_fit, "refit_with_heavy_tails"),
    "projections": (fit, "_try_linear_projections"),
    "known positions": (calibration, "separate_position_errors"),
}
"""The parts of a fit, each with all that it calls."""

ORDINARY = (("stereo", 17), ("bar6", 17), ("bar6", 157), ("dome8", 157))
ODD = (("window", 9), ("tilt", 5), ("tank", 10))
"""Rigs of odd_rigs.py with six or seven cameras and 234 to 915 points."""


def known(n, spec="bar6"):
    rig = build_rig(spec, seed=3)
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


def by_stage(data, runs=3):
    """Seconds of the processor: of each stage, of the whole fit, and of the verdict. The fastest of some fits, which
    others on the same machine disturb least."""
    fitted = ForwardGP().fit(data)
    found = min((_by_stage(data) for _ in range(runs)), key=lambda found: found["fit"])
    start = time.process_time()
    judge(fitted)
    return {**found, "verdict": time.process_time() - start}


def _by_stage(data):
    spent, inside = dict.fromkeys(STAGES, 0.0), []

    def timed(name, work):
        def one(*args, **kwargs):
            if inside:  # part of another stage
                return work(*args, **kwargs)
            inside.append(name)
            start = time.process_time()
            try:
                return work(*args, **kwargs)
            finally:
                spent[name] += time.process_time() - start
                inside.pop()

        return one

    with ExitStack() as all_patched:
        for name, (module, function) in STAGES.items():
            all_patched.enter_context(patch.object(module, function, timed(name, getattr(module, function))))
        start = time.process_time()
        ForwardGP().fit(data)
        spent["fit"] = time.process_time() - start
    return spent


def stages():
    yield f"| seconds of the processor | {' | '.join(STAGES)} | fit | verdict |"
    yield "|---" * (len(STAGES) + 3) + "|"
    rigs = [(f"{spec}, {n} points", known(n, spec)) for spec, n in ORDINARY]
    for kind, seed in ODD:
        data = draw(kind, seed).known
        rigs.append((f"{kind} {seed}: {len(data.observations.cameras)} cameras, {len(data)} points", data))
    for name, data in rigs:
        yield f"| {name} | {' | '.join(f'{seconds:.3f}' for seconds in by_stage(data).values())} |"


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
    yield ""
    yield from stages()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--stages", action="store_true", help="only the table of the stages")
    options = parser.parse_args()
    lines = []
    for line in stages() if options.stages else report():
        print(line, flush=True)
        lines.append(line)
    if options.output:
        write_text(options.output, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
