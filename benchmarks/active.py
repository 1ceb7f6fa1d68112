"""How many known points: each acquisition against random positions and against the paper's grid, 10 seeds.

    python benchmarks/active.py            every table, the figure and benchmarks/results/active.json
    python benchmarks/active.py --quick    two seeds, fewer points: does it run?
    python benchmarks/active.py --only inverse-gp:excess        these again, the other runs of the file stay
    python benchmarks/active.py --draw     tables and figure again from the file

Every run starts from 8 (forward-gp) or 20 (inverse-gp) random positions of the simulated rig's working volume, and then
follows its rule; a new fit after every point. The stated uncertainty is judged at 400 places spread over the volume and
at its corners; errors at 300 other random positions with the same noise. *limit*: the Cramer-Rao bound with perfectly
known cameras.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from implicam.active import Budget, Loop, SimulatedOracle, Step, Workspace, acquisition_from_name
from implicam.calibrators import ForwardGP, InverseGP
from implicam.simulate import Rig, Target, build_rig, cramer_rao_limit, random_positions, simulate, views
from implicam.threads import blas_threads

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "active.json"
FIGURE = HERE.parent / "docs" / "images" / "active.png"
RIGS = {"2 cameras": ("bar6", "2R"), "2 cameras (stereo)": ("stereo", None), "6 cameras": ("bar6", None)}
METHODS = {"forward-gp": (ForwardGP, 8, 36), "inverse-gp": (InverseGP, 20, 120)}
RULES = ("random", "sobol", "variance", "excess", "integrated", "d-optimal")
GRIDS = (
    (2, 2, 2),
    (2, 2, 3),
    (3, 3, 2),
    (3, 3, 3),
    (3, 3, 4),
    (4, 4, 3),
    (4, 4, 4),
    (4, 4, 5),
    (5, 5, 4),
    (5, 5, 5),
    (5, 5, 7),
)
CHECK, WITHIN = 300, 1.3
COLUMNS = ("points", "worst", "usual", "excess", "over_limit", "rmse_over_limit", "coverage")


def main() -> None:
    """Run, or draw what was run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--draw", action="store_true")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", metavar="METHOD:RULE,...", default="")
    options = parser.parse_args()
    if not options.draw:
        only = [tuple(pair.split(":")) for pair in options.only.split(",") if pair]
        measure(2 if options.quick else options.seeds, options.jobs, options.quick, only)
    if not options.quick:
        report(json.loads(RESULTS.read_text())["runs"])


def wanted(method: str, rig: str, rule: str) -> bool:
    """Which combinations are run: the second pair of cameras shows that the first is no exception."""
    if rig == "2 cameras (stereo)":
        return method == "forward-gp" and rule in ("random", "variance", "excess", "integrated")
    return method == "forward-gp" or rule in ("random", "variance", "excess", "integrated", "grid")


def measure(seeds: int, jobs: int, quick: bool, only: list[tuple[str, ...]]) -> None:
    """Every run, seed by seed; the file is written again after each, so that a part of it is of use."""
    every = [
        (rig, method, rule, seed, quick)
        for seed in range(seeds)
        for method in METHODS
        for rig in RIGS
        for rule in (*RULES, "own start", "grid")
        if wanted(method, rig, rule) and (not only or (method, rule) in only)
    ]
    began, runs, before = time.perf_counter(), [], 0.0
    if only:
        file = json.loads(RESULTS.read_text())
        kept = (one for one in file["runs"] if wanted(one["method"], one["rig"], one["rule"]))
        before, runs = file["seconds"], [one for one in kept if (one["method"], one["rule"]) not in only]
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        for found in pool.imap_unordered(run, every):
            runs.append(found)
            if not quick:
                seconds = before + time.perf_counter() - began
                runs.sort(key=lambda one: (one["method"], one["rig"], one["rule"], one["seed"]))
                text = ",\n".join(json.dumps(one) for one in runs)
                RESULTS.write_text(f'{{"seconds": {seconds:.0f}, "runs": [\n{text}\n]}}\n')
    print(f"{len(every)} runs in {time.perf_counter() - began:.0f} s on {jobs} cores")


def run(job: tuple[str, str, str, int, bool]) -> dict[str, Any]:
    """One run: a column for each number, an entry for every number of points."""
    label, method, rule, seed, quick = job
    spec, cameras = RIGS[label]
    rig = build_rig(spec, seed=seed, cameras=cameras)
    kind, start, most = METHODS[method]
    most = start + 3 if quick else most
    with blas_threads(1):
        judge = Judge(rig, seed)
        steps = (
            grid(rig, kind(), judge, seed, 30 if quick else 1000)
            if rule == "grid"
            else grow(rig, kind(), rule, judge, seed, start, most)
        )
        rows = list(steps)
    columns = {key: [_rounded(row.get(key)) for row in rows] for key in COLUMNS}
    return {"rig": label, "method": method, "rule": rule, "seed": seed, **columns}


def _rounded(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(f"{value:.4g}")


class Judge:
    """What a loop is worth: its stated uncertainty, the same over the true limit, and its errors."""

    def __init__(self, rig: Rig, seed: int) -> None:
        self.rig = rig
        self.check = simulate(rig, random_positions(rig, CHECK, np.random.default_rng([seed, 77])), seed=10_000 + seed)

    def row(self, loop: Loop, errors: bool) -> dict[str, Any]:
        """The numbers after a fit."""
        step: Step = loop.history[-1]
        row: dict[str, Any] = {"points": step.points, "worst": step.worst, "usual": step.usual, "excess": step.excess}
        if loop.prospect is not None:
            names = np.array([f"j{i}" for i in range(len(loop.judged_at))])
            _, seen = views(self.rig, Target("judged", names, names, loop.judged_at))
            limit = np.sqrt(np.trace(cramer_rao_limit(self.rig, loop.judged_at, seen), axis1=1, axis2=2))
            row["over_limit"] = float(np.nanquantile(loop.prospect.sd / limit, 0.95))
        if errors and loop.calibration is not None:
            measured = loop.calibration.measure(self.check.observations)
            truth, ok = self.check.truth, measured.measured
            assert truth is not None
            off = measured.xyz[ok] - truth.xyz[ok]
            nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(measured.cov[ok]), off)
            bound = np.trace(truth.limit[ok], axis1=1, axis2=2)
            row |= {
                "rmse_over_limit": float(np.sqrt(np.nanmean(np.sum(off**2, axis=1)) / np.nanmean(bound))),
                "coverage": float(np.mean(nees <= 7.814727903)),
            }
        return row


def grow(rig: Rig, method: Any, rule: str, judge: Judge, seed: int, start: int, most: int) -> Iterator[dict[str, Any]]:
    """A run of the loop. `own start` is the default rule from evenly spread points, and not random ones."""
    own = rule == "own start"
    chosen = acquisition_from_name("integrated" if own else rule)
    loop = Loop(method, Workspace.from_box(rig.volume), chosen, Budget(most), start=start, seed=seed)
    oracle = SimulatedOracle(rig, seed)
    if not own:
        loop.reset(simulate(rig, random_positions(rig, start, np.random.default_rng([seed, 5])), seed=seed))
        yield judge.row(loop, True)
    while not loop.stop:
        (target,) = loop.ask()
        loop.tell(oracle.observe(target), target)
        if loop.points >= start:
            yield judge.row(loop, loop.points % 4 == 0)


def grid(rig: Rig, method: Any, judge: Judge, seed: int, most: int) -> Iterator[dict[str, Any]]:
    """Lattices of more and more points, up to the paper's 5 x 5 x 7."""
    from implicam.simulate import ball_grid

    for shape in GRIDS:
        if 8 <= np.prod(shape) <= most:
            loop = Loop(method, Workspace.from_box(rig.volume), seed=seed)
            loop.reset(simulate(rig, ball_grid(rig, shape), seed=seed))
            yield judge.row(loop, True)


def report(runs: list[dict[str, Any]]) -> None:
    """The tables, as Markdown, and the figure."""
    curves: dict[Any, Runs] = {}
    done = Counter(one["seed"] for one in runs)
    whole = {seed for seed, count in done.items() if count == max(done.values())}
    print(f"{len(whole)} seeds")
    for one in (one for one in runs if one["seed"] in whole):
        rows = [dict(zip(COLUMNS, values, strict=True)) for values in zip(*(one[key] for key in COLUMNS), strict=True)]
        curves.setdefault((one["method"], one["rig"], one["rule"]), {})[one["seed"]] = rows
    _within_limit(curves)
    _as_good_as_the_grid(curves)
    _errors(curves)
    _draw(curves)
    print(f"\nfigure: {FIGURE}")


Runs = dict[int, list[dict[str, Any]]]


def _first(run: list[dict[str, Any]], key: str, value: float) -> float:
    """Points at which a curve is first at or below a value; infinity for never."""
    return min((row["points"] for row in run if (row[key] or np.inf) <= value), default=np.inf)


def _within_limit(curves: dict[Any, Runs]) -> None:
    needed = f"needed for {WITHIN} in 95 % of the volume: median [quartiles]"
    print(f"\n| forward-gp, from 8 points | {needed} | at 12 | at 16 | at 20 | at 36 |")
    print("|---|---|---|---|---|---|")
    for (method, rig, rule), runs in curves.items():
        if method != "forward-gp":
            continue
        needed = [_first(run, "over_limit", WITHIN) for run in runs.values()]
        cells = [_mean_se(runs, n, "over_limit") for n in (12, 16, 20, 36)]
        print(f"| {rig}, {rule} | {_quartiles(needed)} | {' | '.join(cells)} |")


def _as_good_as_the_grid(curves: dict[Any, Runs]) -> None:
    goal = "worst 95 % uncertainty of the grid, mm | points needed for as much: median [quartiles]"
    print(f"\n| as good as the grid's 175 | {goal} | part of the grid's |")
    print("|---|---|---|---|")
    for (method, rig, rule), runs in curves.items():
        whole = curves.get((method, rig, "grid"))
        if rule == "grid" or whole is None or method == "forward-gp":  # which stops at 36 points
            continue
        goal = {seed: run[-1]["worst"] for seed, run in whole.items()}
        needed = [_first(run, "worst", goal[seed]) for seed, run in runs.items()]
        part = np.median(needed) / 175
        print(f"| {method}, {rig}, {rule} | {np.mean(list(goal.values())):.3g} | {_quartiles(needed)} | {part:.2f} |")


def _errors(curves: dict[Any, Runs]) -> None:
    print("\n| errors at other positions | points | rmse / limit, mean ± se | coverage of the 95 % ellipsoid |")
    print("|---|---|---|---|")
    for (method, rig, rule), runs in curves.items():
        counts = (88, 120) if method == "inverse-gp" else (16, 20, 36)
        counts = (175,) if rule == "grid" else counts
        for n in counts:
            errors, coverage = _mean_se(runs, n, "rmse_over_limit"), _mean_se(runs, n, "coverage")
            print(f"| {method}, {rig}, {rule} | {n} | {errors} | {coverage} |")


def _draw(curves: dict[Any, Runs]) -> None:
    from implicam.compare import mean_and_error
    from implicam.figures.learning import Panel, learning

    def panel(method: str, rig: str, key: str, ylabel: str, line: tuple[float, str] | None) -> Panel:
        rules = {}
        for (m, r, rule), runs in curves.items():
            if (m, r) == (method, rig) and wanted(method, rig, rule):
                counts = sorted(
                    set.intersection(*({row["points"] for row in run if row[key]} for run in runs.values()))
                )
                if method == "forward-gp":
                    counts = [n for n in counts if n <= METHODS[method][2]]
                table = np.array([[row[key] for row in run if row["points"] in counts] for run in runs.values()])
                mean, error = np.array([mean_and_error(column) for column in table.T]).T
                rules[rule] = (np.array(counts), mean, error)
        return Panel(f"{method}, {rig}", ylabel, rules, line)

    forward = [
        panel(
            "forward-gp", rig, "over_limit", "sd / limit, in 95 % of the volume", (WITHIN, f"{WITHIN} times the limit")
        )
        for rig in RIGS
    ]
    inverse = [
        panel("inverse-gp", rig, "worst", "worst 95 % uncertainty, mm", None)
        for rig in RIGS
        if ("inverse-gp", rig, "variance") in curves
    ]
    learning([forward, inverse]).savefig(FIGURE, dpi=110)


def _mean_se(runs: Runs, n: int, key: str) -> str:
    values = [row[key] for run in runs.values() for row in run if row["points"] == n and row[key] is not None]
    if len(values) < 2:
        return "–"
    return f"{np.mean(values):.2f} ± {np.std(values, ddof=1) / np.sqrt(len(values)):.2f}"


def _quartiles(values: list[float]) -> str:
    low, middle, high = (np.quantile(values, q, method="nearest") for q in (0.25, 0.5, 0.75))
    return " ".join([_count(middle), f"[{_count(low)}, {_count(high)}]"])


def _count(value: float) -> str:
    return f"{value:.0f}" if np.isfinite(value) else "more"


if __name__ == "__main__":
    main()
