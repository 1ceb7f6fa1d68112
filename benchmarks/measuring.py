"""How fast points are measured: by tables, compiled and by NumPy, and exactly; beside OpenCV's undistortPoints and
triangulatePoints of two views in the same process, with the accuracy and coverage of what was timed.

python benchmarks/measuring.py            # some minutes; --points 1000000 for a million of each

Rates are points per second of CPU time, the best of several runs by turns, so that other programs on the machine change
them little; *together* is by the clock with all cores, a median. *over OpenCV* is the ratio of CPU rates; OpenCV has no
triangulation of more than two views, so that of two is beside every row. *off* is the largest distance from the
exact path, in standard deviations of the position, and the largest error of its covariance, of 2,000 points;
*same views* how many points have the same views left out;
*coverage* the share of 95 % ellipsoids that hold the true position, of all points measured.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from scipy.special import chdtri

import implicam as ic
from implicam.calibrators.protocol import RigCalibration
from implicam.dataset import Dataset
from implicam.rig_model import MeasuredPixels
from implicam.simulate import Rig, build_rig, random_positions, simulate
from implicam.tabulated import RigTable
from implicam.tabulated.library import how_it_measures, kernel

COMPARED = 2000
RUNS = 7


def seconds(work: Callable[[], object], runs: int = RUNS) -> tuple[float, float]:
    """Least CPU time of the process, and median time by the clock."""
    spent = []
    for _ in range(runs):
        cpu, clock = time.process_time(), time.perf_counter()
        work()
        spent.append((time.process_time() - cpu, time.perf_counter() - clock))
    return min(cpu for cpu, _ in spent), float(np.median([clock for _, clock in spent]))


def opencv(points: int) -> Callable[[], object]:
    """Two cameras with five coefficients of distortion, and n points that both see."""
    cv2.setNumThreads(1)
    K, k = np.array([[1000.0, 0, 640], [0, 1000, 480], [0, 0, 1]]), np.array([-0.1, 0.02, 1e-3, 1e-3, 0])
    X = np.random.default_rng(0).uniform([-1, -1, 4], [1, 1, 6], (points, 3))
    P = [np.column_stack([np.eye(3), [x, 0, 0]]) for x in (0.0, -1.0)]
    uv = [cv2.projectPoints(X, np.zeros(3), p[:, 3], K, k)[0] for p in P]

    def work() -> object:
        left, right = (cv2.undistortPoints(pixels, K, k)[:, 0].T for pixels in uv)
        found = cv2.triangulatePoints(P[0], P[1], left, right)
        return (found[:3] / found[3]).T

    return work


def off(found: MeasuredPixels, exact: MeasuredPixels) -> tuple[float, float]:
    both = found.measured & exact.measured
    root = np.linalg.inv(np.linalg.cholesky(exact.cov[both]))
    away = np.linalg.norm((root @ (found.xyz - exact.xyz)[both][..., None])[..., 0], axis=1)
    sizes = np.linalg.eigvalsh(root @ found.cov[both] @ root.swapaxes(1, 2))
    return float(away.max()), float(np.abs(sizes - 1).max())


def coverage(found: MeasuredPixels, truth: np.ndarray) -> float:
    good = found.measured
    error = (found.xyz - truth)[good]
    distance = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.cov[good]), error)
    return float(np.mean(distance < chdtri(3, 0.05)))


def spoilt(uv: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One view of each point wrong by 20 px, towards the middle of the image."""
    out, row = uv.copy(), np.arange(len(uv))
    wrong = rng.integers(0, uv.shape[1], len(uv))
    towards = np.nanmean(uv, axis=(0, 1)) - uv[row, wrong]
    out[row, wrong] += 20 * towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return out


def rig_and_known(name: str) -> tuple[Rig, Dataset]:
    """A rig, and its known points: 157 at random; *declared*: of bar4, each known to 0.1 mm, which ties the
    cameras together."""
    rig = build_rig("bar4" if name == "declared" else name, seed=1)
    known = simulate(rig, random_positions(rig, 157, np.random.default_rng(1)), seed=1)
    if name != "declared":
        return rig, known
    sd = 0.1 * rig.units_per_mm
    off = known.positions.xyz + sd * np.random.default_rng(4).normal(size=(157, 3))
    return rig, replace(known, known=replace(known.positions, xyz=off, sd=np.full((157, 3), sd)))


class Case(NamedTuple):
    """Points a second of CPU time, and together by the clock; how far off the exact path, in sd and as a part of the
    covariance; the share of points with the same views left out; coverage."""

    rate: float
    together: float
    off_sd: float
    off_covariance: float
    same_views: float
    coverage: float


def measured(
    made: RigCalibration, tables: RigTable | None, uv: np.ndarray, truth: np.ndarray, runs: int = RUNS
) -> Case:
    locator = None if tables is None else tables.locate
    n = COMPARED if tables is None else len(uv) if tables.compiled else min(len(uv), 40_000)
    found = made.map.measure_pixels(uv[:n], None, locator)
    least, clock = seconds(lambda: made.map.measure_pixels(uv[:n], None, locator), runs if locator else 1)
    exact = made.map.measure_pixels(uv[:COMPARED])
    few = made.map.measure_pixels(uv[:COMPARED], None, locator)
    away, part = off(few, exact)
    alike = float((few.left_out == exact.left_out).all(axis=1).mean())
    return Case(n / least, n / clock, away, part, alike, coverage(found, truth[:n]))


def row(name: str, views: int, case: Case, peer: float) -> str:
    return (
        f"| {name} | {views} | {case.rate:,.0f} | {case.together:,.0f} | {peer * case.rate:.2f} | {case.off_sd:.4f} | "
        f"{case.off_covariance:.4f} | {100 * case.same_views:.2f} % | {100 * case.coverage:.1f} % |"
    )


def live_seconds(made: RigCalibration, uv: np.ndarray) -> tuple[float, float]:
    """Median and 99th percentile of one shot."""
    one, spent = made.live(), []
    for k in range(20000):
        start = time.perf_counter()
        one.measure(uv[k % len(uv)])
        spent.append(time.perf_counter() - start)
    middle, last = np.quantile(spent, [0.5, 0.99])
    return float(middle), float(last)


def live(made: RigCalibration, uv: np.ndarray) -> str:
    middle, last = live_seconds(made, uv)
    return f"{1e6 * middle:.1f} us, 99th percentile {1e6 * last:.1f} us"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--points", type=int, default=400_000)
    parser.add_argument("--rigs", default="stereo,bar4,bar6,dome8,declared")
    options = parser.parse_args()
    peer = opencv(20_000)
    usual = min(seconds(peer, 15)[0], seconds(peer, 15)[0]) / 20_000
    print(f"tables: {how_it_measures()}; OpenCV {cv2.__version__}: {1 / usual:,.0f} points/s of two views\n")
    heads = ("by", "views", "points/s", "together", "over OpenCV", "off, sd", "covariance", "same views", "coverage")
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|", flush=True)
    notes = []
    for name in options.rigs.split(","):
        rig, known = rig_and_known(name)
        new = simulate(rig, random_positions(rig, options.points, np.random.default_rng(2)), seed=2)
        made: RigCalibration = ic.ForwardGP().fit(known)
        start = time.process_time()
        tables = RigTable.of(made.map, known.xyz)
        notes.append(f"{name}: tables made in {time.process_time() - start:.2f} s of CPU time")
        assert new.truth is not None
        uv, truth = np.ascontiguousarray(new.observations.uv), new.truth.xyz
        wrong = spoilt(uv, np.random.default_rng(3))
        cases: list[tuple[str, RigTable | None, np.ndarray]] = [(f"{name}, exact", None, uv)]
        if not made.map.posterior.tied:
            cases.insert(0, (f"{name}, NumPy", replace(tables, compiled=None), uv))
        if kernel():
            cases.insert(0, (f"{name}, compiled", tables, uv))
            if len(made.camera_names) > 3 and not made.map.posterior.tied:
                cases.insert(1, (f"{name}, compiled, one wrong view in each", tables, wrong))
            notes.append(f"{name}: live, one shot {live(made, uv)}")
        for what, by, pixels in cases:
            again = seconds(peer, 5)[0] / 20_000
            usual = min(usual, again)
            print(row(what, uv.shape[1], measured(made, by, pixels, truth), usual), flush=True)
    print("\n" + "\n".join(notes))


if __name__ == "__main__":
    main()
