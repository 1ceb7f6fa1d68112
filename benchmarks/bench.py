"""All that is promised of speed, in one table: `make bench`.

    python benchmarks/bench.py [-o FILE.md] [--only import,gp,fit,active,measure,bulk,reading]

Every section runs in a process of its own, by the functions of the benchmark that it is from, and each is timed beside
its peer in that process. *over peer*: how many times as fast as it. *of limit*: how many times the limit's time it
takes; the limit is LAPACK's own time for the same factors, or what memory can carry of the pixels that come in and the
positions and covariances that go out. *wanted*: of issue and docs/speed.md. What an error is over, and what coverage is
of, say the heads of those benchmarks. Kept in benchmarks/results/bench/, a file for each version and processor.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from forward_speed import in_its_own_process
from implicam.files import write_text
from large_rigs import machine

FOLDER = Path(__file__).parent / "results" / "bench"
POINTS = 100_000
BULK_POINTS = 200_000
HEADS = ("what", "value", "unit", "wanted", "peer", "over peer", "limit", "of limit", "accuracy", "coverage")


@dataclass(frozen=True)
class Row:
    """A line of the table; wanted: the limit, a smallest one where the unit is a rate."""

    what: str
    value: float
    unit: str
    wanted: float | None = None
    peer: str = ""
    over_peer: float | None = None
    limit: str = ""
    of_limit: float | None = None
    accuracy: str = ""
    coverage: float | None = None

    def cells(self) -> list[str]:
        """As the table has them."""

        def number(value: float | None) -> str:
            return "" if value is None else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"

        met = "" if self.wanted is None else (self.value >= self.wanted) == self.unit.endswith("/s")
        wanted = "" if self.wanted is None else f"{number(self.wanted)} {'reached' if met else 'missed'}"
        covered = "" if self.coverage is None else f"{100 * self.coverage:.1f} %"
        return [self.what, number(self.value), self.unit, wanted, self.peer, number(self.over_peer), self.limit,
                number(self.of_limit), self.accuracy, covered]  # fmt: skip


def importing(_: None) -> list[Row]:
    from import_time import LIMIT_SECONDS, STATEMENTS, cpu_seconds

    spent = {name: min(cpu_seconds(STATEMENTS[name]) for _ in range(3)) for name in STATEMENTS}
    theirs = spent["numpy and scipy.linalg, to compare"]
    wanted = {"import implicam": LIMIT_SECONDS}
    return [
        Row(name, seconds, "CPU s", wanted.get(name), "numpy, scipy.linalg", theirs / seconds)
        for name, seconds in spent.items()
        if "compare" not in name
    ]


def processes(_: None) -> list[Row]:
    from gp_fit import measure

    rows = []
    for n in (157, 792):
        found = measure(n, 12, 3, 1)
        gained = found["lml"]["ours"] - found["lml"]["GPyTorch"]
        rows.append(
            Row(f"three GPs, {n} points of 12 inputs", found["ours"], "s", None, "GPyTorch",
                found["GPyTorch"] / found["ours"], "LAPACK", found["ours"] / found["lapack"], f"{gained:+.0f} nats")
        )  # fmt: skip
    return rows


def fitting(name: str) -> Row:
    from large_rigs import WANTED, one

    found = one(name)
    memory = f"{found['memory']:.2f} GB; " if found["memory"] > 0.5 else ""
    accuracy = f"{memory}error {found['over_limit']:.2f} of the Cramer-Rao limit"
    return Row(f"fit, {name}", found["clock"], "s", WANTED.get(name), accuracy=accuracy, coverage=found["coverage"])


def learning(_: None) -> list[Row]:
    import active_speed as speed
    from implicam.active import Loop, SimulatedOracle, Workspace, acquisition_from_name
    from implicam.calibrators import ForwardGP, InverseGP
    from implicam.simulate import build_rig, random_positions, simulate

    rows = []
    for method, noise, wanted in ((InverseGP(), 0.0, 0.2), (ForwardGP(), 0.0, 0.2), (ForwardGP(), 0.1, 0.4)):
        rig = build_rig("bar6", seed=0)
        places = random_positions(rig, speed.POINTS, np.random.default_rng(0))
        data = simulate(rig, places, seed=0, robot_noise=noise)
        loop = Loop(method, Workspace.from_box(rig.volume), acquisition_from_name("integrated"), data=data)
        step = sum(speed.steps(loop, SimulatedOracle(rig, robot_noise=noise), 3))
        start = time.perf_counter()
        speed.gpytorch(data)
        theirs = time.perf_counter() - start
        what = f"a step of active learning, {method.method}{', declared errors' * bool(noise)}"
        rows.append(Row(what, step, "s", wanted, "GPyTorch's fit alone", theirs / step))
    return rows


def bandwidth() -> float:
    """Bytes a second that one core copies, of an array no cache holds."""
    some = np.zeros(1 << 25)
    other = some.copy()
    best = np.inf
    for _ in range(5):
        start = time.process_time()
        np.copyto(other, some)
        best = min(best, time.process_time() - start)
    return 2 * some.nbytes / best


def measuring(name: str) -> list[Row]:
    import measuring as by
    from implicam.calibrators import ForwardGP
    from implicam.simulate import random_positions, simulate
    from implicam.tabulated import RigTable
    from implicam.tabulated.library import kernel

    usual = by.seconds(by.opencv(20_000), 9)[0] / 20_000
    rig, known = by.rig_and_known(name)
    new = simulate(rig, random_positions(rig, POINTS, np.random.default_rng(2)), seed=2)
    made = ForwardGP().fit(known)
    start = time.process_time()
    tables = RigTable.of(made.map, known.xyz)
    spent = time.process_time() - start
    uv = np.ascontiguousarray(new.observations.uv)
    views = uv.shape[1]
    carried = bandwidth() / (8 * (2 * views + 3 + 9 + 2))
    wanted = {"stereo": 2 / usual, "bar6": 800_000, "declared": 300_000}
    rows = []
    for how, locator, pixels in (
        ("compiled" if kernel() else "NumPy", tables, uv),
        ("one wrong view in each", tables, by.spoilt(uv, np.random.default_rng(3))),
    ):
        if how.startswith("one wrong") and name != "bar6":
            continue
        case = by.measured(made, locator, pixels, new.truth.xyz, 3)
        least = wanted[name] if pixels is uv else 100_000
        told = (
            f"off {case.off_sd:.4f} sd, covariance {case.off_covariance:.4f}; {100 * case.same_views:.1f} % same views"
        )
        rows.append(
            Row(f"measure, {name}, {views} views, {how}", case.rate, "points/s", least, "OpenCV, 2 views",
                case.rate * usual, "memory", carried / case.rate, told, case.coverage)
        )  # fmt: skip
    if name == "bar6":
        middle, last = by.live_seconds(made, uv)
        rows.append(
            Row("live, one six-view shot", 1e3 * middle, "ms", 0.05, accuracy=f"99 % within {1e3 * last:.3f} ms")
        )
        rows.append(Row("tables of six cameras", spent, "CPU s", 0.5))
    return rows


def in_bulk(_: None) -> list[Row]:
    from implicam.bulk import measure_file
    from implicam.calibrators import ForwardGP
    from implicam.simulate import build_rig, random_positions, simulate
    from large_rigs import known, peak

    rig = build_rig("bar6", seed=3)
    calibration = ForwardGP().fit(known(157))
    uv = simulate(rig, random_positions(rig, BULK_POINTS, np.random.default_rng(5)), seed=5).observations.uv.copy()
    uv[np.random.default_rng(6).random(uv.shape[:2]) < 0.1] = np.nan
    calibration.measure_pixels(uv[:100])  # makes the tables
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        columns = {f"{a}_{c}": uv[:, i, k] for i, c in enumerate(calibration.camera_names) for k, a in enumerate("uv")}
        np.savez(Path(folder) / "t.npz", uv=uv, cameras=calibration.camera_names)
        import pyarrow
        import pyarrow.csv
        import pyarrow.parquet

        table = pyarrow.table({name: pyarrow.array(column, from_pandas=True) for name, column in columns.items()})
        pyarrow.csv.write_csv(table, Path(folder) / "t.csv")
        pyarrow.parquet.write_table(table, Path(folder) / "t.parquet")
        for ending, wanted in ((".csv", 12), (".parquet", 4), (".npz", None)):
            start = time.process_time()
            measure_file(calibration, Path(folder) / f"t{ending}", Path(folder) / f"m{ending}")
            spent = (time.process_time() - start) * 1e6 / BULK_POINTS
            rows.append(
                Row(f"a million points from and to {ending}", spent, "CPU s", wanted, accuracy=f"{peak():.2f} GB")
            )
    return rows


def reading(_: None) -> list[Row]:
    from implicam.errors import ImplicamError
    from reading import READINGS

    rows = []
    for what, read in READINGS.items():
        with tempfile.TemporaryDirectory() as folder:
            start = time.process_time()
            with suppress(ImplicamError):
                read(Path(folder))
            rows.append(Row(what, time.process_time() - start, "CPU s"))
    return rows


FITS = ("bar6 157", "boards", "dome100", "declared 2000", "bar6 100000")
SECTIONS: dict[str, list[tuple[Callable[..., object], object]]] = {
    "import": [(importing, None)],
    "gp": [(processes, None)],
    "fit": [(fitting, name) for name in FITS],
    "active": [(learning, None)],
    "measure": [(measuring, name) for name in ("stereo", "bar6", "declared")],
    "bulk": [(in_bulk, None)],
    "reading": [(reading, None)],
}


def place(about: dict[str, object]) -> Path:
    """Where the results of this version on this processor are kept."""
    processor = re.sub(r"[^a-z0-9]+", "-", str(about["processor"]).lower()).strip("-") or "unknown"
    return FOLDER / f"{about['implicam']}-{processor}.md"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--only", default=",".join(SECTIONS), help="sections, separated by commas")
    options = parser.parse_args()
    about, rows = machine(), []
    head = ", ".join(f"{key} {value}" for key, value in about.items())
    lines = [head, "", "| " + " | ".join(HEADS) + " |", "|---" * len(HEADS) + "|"]
    print("\n".join(lines), flush=True)
    output = options.output or place(about)
    output.parent.mkdir(parents=True, exist_ok=True)
    for section in options.only.split(","):
        for work, argument in SECTIONS[section]:
            found = in_its_own_process(work, argument)
            for row in found if isinstance(found, list) else [found]:
                rows.append(asdict(row))
                lines.append("| " + " | ".join(row.cells()) + " |")
                print(lines[-1], flush=True)
            write_text(output, "\n".join(lines) + "\n")
            write_text(output.with_suffix(".json"), json.dumps({"machine": about, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
