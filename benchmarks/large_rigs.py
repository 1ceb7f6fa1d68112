"""What a fit costs against known points and cameras, with the accuracy and coverage of what was fitted.

    python benchmarks/large_rigs.py [-o benchmarks/results/large_rigs.json] [--figure docs/images/speed.png]
    python benchmarks/large_rigs.py --only dome100          one line
    python benchmarks/large_rigs.py --draw                  only the figure, from what is kept

Lines: six cameras on a bar with 50 to 100,000 known points; domes of 6 to 100 cameras with 2,000 known points, each
seen by 5 to 20 of them; 20 boards of 88 corners; 2,000 known points that each have a declared error of 0.1 mm. Each in
a process of its own: seconds of its processor and by the clock, its peak memory in GB; and of 300 new places the error
(rms, all axes) over the Cramer-Rao limit of perfectly known cameras, and how many 95 % ellipsoids hold the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.special import chdtri

from forward_speed import boards, in_its_own_process, known, peak
from implicam import __version__
from implicam.calibrators import ForwardGP
from implicam.dataset import Dataset
from implicam.evaluation import evaluate
from implicam.files import write_text
from implicam.simulate import build_rig, random_positions, simulate

RESULTS = Path(__file__).parent / "results" / "large_rigs.json"
POINTS = (50, 157, 500, 2000, 10_000, 100_000)
CAMERAS = (6, 12, 25, 50, 100)
DOME_POINTS, FEWEST, MOST = 2000, 5, 20
NEW = 300
WANTED = {"bar6 157": 0.25, "bar6 100000": 20, "dome100": 15}


def dome(cameras: int) -> Dataset:
    """Known points of a dome, each seen by so many of its cameras."""
    data, rng = known(DOME_POINTS, f"dome{cameras}"), np.random.default_rng(0)
    uv = data.observations.uv.copy()
    for views in uv:
        seen = rng.choice(cameras, min(cameras, int(rng.integers(FEWEST, MOST + 1))), replace=False)
        views[np.setdiff1d(np.arange(cameras), seen)] = np.nan
    return replace(data, observations=replace(data.observations, uv=uv))


def declared(points: int) -> Dataset:
    """Known positions that are off by 0.1 mm each, and say so."""
    rig = build_rig("bar6", seed=3)
    return simulate(rig, random_positions(rig, points, np.random.default_rng(1)), seed=4, robot_noise=0.1)


def lines() -> dict[str, tuple[str, str]]:
    """Name -> the rig, and which known points."""
    some = {f"bar6 {n}": ("bar6", str(n)) for n in POINTS}
    some |= {f"dome{c}": (f"dome{c}", "dome") for c in CAMERAS}
    return some | {"boards": ("bar6", "boards"), "declared 2000": ("bar6", "declared")}


def one(name: str) -> dict[str, float]:
    """A line, in this process."""
    spec, what = lines()[name]
    made = {"dome": lambda: dome(int(spec[4:])), "boards": boards, "declared": lambda: declared(2000)}
    data = made[what]() if what in made else known(int(what), spec)
    before = peak()
    cpu, clock = time.process_time(), time.perf_counter()
    calibration = ForwardGP().fit(data)
    found = {
        "points": len(data),
        "cameras": len(calibration.camera_names),
        "views": int(data.observations.seen.sum()),
        "cpu": time.process_time() - cpu,
        "clock": time.perf_counter() - clock,
        "memory": peak(),
        "data_memory": before,
    }
    rig = build_rig(spec, seed=3)
    new = simulate(rig, random_positions(rig, NEW, np.random.default_rng(99)), seed=77)
    seen = calibration.measure(new.observations)
    error = seen.xyz - new.xyz
    distance = np.einsum("ni,nij,nj->n", error, np.linalg.inv(seen.cov), error)
    overall = evaluate(calibration, new, regions=False).coverage.overall
    return found | {"over_limit": overall.rmse_over_limit, "coverage": float(np.mean(distance < chdtri(3, 0.05)))}


def machine() -> dict[str, object]:
    """What a result was measured on."""
    model = ""
    if Path("/proc/cpuinfo").exists():
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
        model = next((line.partition(":")[2].strip() for line in text.splitlines() if "model name" in line), "")
    load = [round(x, 1) for x in os.getloadavg()] if hasattr(os, "getloadavg") else []
    return {
        "implicam": __version__, "python": platform.python_version(), "numpy": np.__version__,
        "processor": model or platform.processor(), "cores": os.cpu_count(), "load": load,
    }  # fmt: skip


def row(name: str, line: dict[str, float]) -> str:
    wanted = f"{WANTED[name]:g} s" if name in WANTED else ""
    return (
        f"| {name} | {line['points']:,.0f} | {line['cameras']:.0f} | {line['views']:,.0f} | {line['cpu']:.2f} | "
        f"{line['clock']:.2f} | {line['memory']:.2f} | {wanted} | {line['over_limit']:.3f} | "
        f"{100 * line['coverage']:.1f} % |"
    )


HEAD = (
    "| fit of | known points | cameras | views | CPU s | clock s | GB | wanted | error over limit | coverage |\n"
    + "|---" * 10
    + "|"
)


def draw(found: dict[str, dict[str, float]], path: Path) -> None:
    """Cost against known points and against cameras, both logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained", sharey=True)
    most = max(line["cpu"] for line in found.values())
    for axes, names, x, label, ticks in (
        (left, [f"bar6 {n}" for n in POINTS], "points", "known points of six cameras", POINTS),
        (right, [f"dome{c}" for c in CAMERAS], "cameras", f"cameras of a dome, {DOME_POINTS:,} known points", CAMERAS),
    ):
        there = [found[name] for name in names if name in found]
        at, spent = np.array([line[x] for line in there]), np.array([line["cpu"] for line in there])
        axes.loglog(at, spent, "o-", color="#1f5fa8")
        axes.loglog(at, spent[-1] * at / at[-1], "--", color="0.6", linewidth=1)
        axes.annotate("proportional", (at[-1] / 6, spent[-1] / 6), (8, -8), textcoords="offset points",
                      color="0.4", fontsize=8)  # fmt: skip
        axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
        axes.minorticks_off()
        axes.set_xlabel(label)
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
    for name, mark, label in (("boards", "s", "20 boards"), ("declared 2000", "^", "2,000 with declared errors")):
        if name in found:
            at, spent = found[name]["points"], found[name]["cpu"]
            left.plot(at, spent, mark, color="#c25a1a")
            left.annotate(label, (at, spent), (-6, 4), textcoords="offset points", ha="right", fontsize=8)
    seconds = [tick for tick in (0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) if tick < 2 * most]
    left.set_yticks(seconds, [f"{tick:g}" for tick in seconds])
    left.set_ylim(0.2, 2 * most)
    left.set_ylabel("seconds of the processor for a fit")
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--only", help="some lines, separated by commas")
    parser.add_argument("--draw", action="store_true", help="measure nothing")
    options = parser.parse_args()
    kept = json.loads(options.output.read_text(encoding="utf-8")) if options.output.exists() else {"lines": {}}
    print(HEAD, flush=True)
    names = [] if options.draw else options.only.split(",") if options.only else list(lines())
    for name in names:
        kept["lines"][name] = in_its_own_process(one, name)
        kept["machine"] = machine()
        write_text(options.output, json.dumps(kept, indent=1) + "\n")
        print(row(name, kept["lines"][name]), flush=True)
    if options.figure:
        draw(kept["lines"], options.figure)


if __name__ == "__main__":
    main()
