"""One step of active learning: choose among 1,500 candidates, measure, fit again with everything.

Against the same step with GPyTorch: the paper's three GPs fitted again (the same settings as benchmarks/gp_fit.py: Adam
0.1, 100 steps, float64), in the same process on the same data.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from implicam.active import Loop, SimulatedOracle, Workspace, acquisition_from_name
from implicam.calibrators import ForwardGP, InverseGP
from implicam.calibrators.every_camera import Scaling
from implicam.simulate import build_rig, random_positions, simulate

POINTS, REPEATS = 135, 7
CAMERAS = {"2 cameras": "2R", "6 cameras": None}


def main() -> None:
    """Print the table."""
    print(f"One step at {POINTS} known points, 1,500 candidates, 400 judged places; medians of {REPEATS}, seconds.\n")
    print("| rig | method, acquisition | choose | fit, and judge | step | GPyTorch's fit alone | over ours |")
    print("|---|---|---|---|---|---|---|")
    for label, cameras in CAMERAS.items():
        rig = build_rig("bar6", seed=0, cameras=cameras)
        for noise in (0.0, 0.1):
            data = simulate(rig, random_positions(rig, POINTS, np.random.default_rng(0)), seed=0, robot_noise=noise)
            theirs = _median(lambda data=data: gpytorch(data))  # type: ignore[misc]
            for method, rule in ((InverseGP(), "variance"), (InverseGP(), "integrated"), (ForwardGP(), "integrated")):
                if noise and isinstance(method, InverseGP):
                    continue
                loop = Loop(method, Workspace.from_box(rig.volume), acquisition_from_name(rule), data=data)
                choose, fit = steps(loop, SimulatedOracle(rig, robot_noise=noise))
                what = f"{method.method}, {rule}" + (", positions known to 0.1 mm" if noise else "")
                step = choose + fit
                print(
                    f"| {label} | {what} | {choose:.3f} | {fit:.3f} | {step:.3f} | {theirs:.2f} | {theirs / step:.1f} |"
                )


def steps(loop: Loop, oracle: SimulatedOracle, repeats: int = REPEATS) -> tuple[float, float]:
    """Median seconds of choosing a target, and of the fit with it."""
    choosing, fitting = [], []
    for _ in range(repeats):
        start = time.perf_counter()
        (target,) = loop.ask()
        choosing.append(time.perf_counter() - start)
        answer = oracle.observe(target)
        start = time.perf_counter()
        loop.tell(answer, target)
        fitting.append(time.perf_counter() - start)
    return statistics.median(choosing), statistics.median(fitting)


def _median(work: Callable[[], Any]) -> float:
    times = []
    for _ in range(3):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def gpytorch(data: Any) -> None:
    """Fit the three GPs as the paper's software does."""
    from gp_fit import with_gpytorch

    pixels = data.observations.uv.reshape(len(data), -1)
    with_gpytorch(Scaling.of(pixels).apply(pixels), Scaling.of(data.xyz).apply(data.xyz))


if __name__ == "__main__":
    main()
