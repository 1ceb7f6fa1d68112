"""Golden numbers: what every method measures on simulated rigs and a real one, as tests/data/golden stores it.

    python tests/make_golden.py --compare     the largest difference from the stored numbers; 1 where it is above 1e-9
    python tests/make_golden.py               store them anew: only where numbers are meant to change, with the reason
    python tests/make_golden.py --files       store calibrations of FILES in today's format, where there are none yet

A change that must not change any number (a renaming, a move) is proved by `--compare`, on the machine that stored them;
tests/test_golden.py allows for another machine. The rigs are small, and between them take the methods through their
branches: views that are missing or wrong, known positions with stated and with unstated errors, cameras that are
refused, heavy tails, planes of dots.

A difference is in standard deviations of the stored covariance: of a position along each axis; of a covariance, entry
by entry, over the product of the two standard deviations.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import platform
import re
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

import implicam as ic
from implicam.calibration_file import FORMAT_WITHOUT_REPAIRS
from implicam.simulate import Rig, Unusual, build_rig, moving_board, random_positions, simulate

GOLDEN = Path(__file__).parent / "data" / "golden"
TANK = Path(__file__).parent / "data" / "real" / "two-sided-tank"
NEW_POINTS = 10
SAME_MACHINE_SD = 1e-9
"""What rounding alone may change where the program is the same, in standard deviations."""

METHODS: dict[str, tuple[str, dict[str, str]]] = {
    "forward-gp": ("forward-gp", {}),
    "forward-gp:central": ("forward-gp", {"lens": "central"}),
    "forward-gp:none": ("forward-gp", {"lens": "none"}),
    "explicit": ("explicit", {}),
    "inverse-gp": ("inverse-gp", {}),
    "inverse-gp:plain": ("inverse-gp", {"preset": "plain"}),
    "inverse-gp:paper": ("inverse-gp", {"preset": "paper"}),
    "mlp": ("mlp", {}),
}
LIBRARY = {"inverse-gp:paper": "gpytorch", "mlp": "torch"}
"""What a method needs to be fitted beside the package's own dependencies."""

FILES = (("odd", "forward-gp"), ("odd", "explicit"), ("odd", "inverse-gp"), ("two-sided-tank", "forward-gp"))
"""Calibrations that are kept as files, which every later version must read: cameras of any kind, mirrored or refused,
errors of known positions, levels of a target. tests/test_calibration_file.py has some of the first days."""

Pair = tuple[ic.Dataset, ic.Dataset]


def of_new_points(rig: Rig, missing: float = 0.0, outliers: float = 0.0) -> ic.Dataset:
    target = random_positions(rig, NEW_POINTS, np.random.default_rng(2))
    return simulate(rig, target, seed=9, missing=missing, outliers=outliers)


def ordinary() -> Pair:
    """Two regular and two wide cameras; views are missing and wrong, known positions off by 0.05 mm, as they state."""
    rig = build_rig("bar6", seed=7, frame="random", cameras="2R2W")
    known = random_positions(rig, 36, np.random.default_rng(1))
    return (
        simulate(rig, known, seed=8, robot_noise=0.05, missing=0.03, outliers=0.01),
        of_new_points(rig, missing=0.03, outliers=0.03),
    )


def odd() -> Pair:
    """Tilted sensors, a mirror, pixels that are not square, a window with water behind it."""
    rig = build_rig("dome4", seed=7, frame="random", unusual=Unusual(tilt=8, mirror="cam1", aspect=1.3, window=12))
    return simulate(rig, random_positions(rig, 32, np.random.default_rng(1)), seed=8), of_new_points(rig)


def traverse() -> Pair:
    """Eight positions of a board, each off as a whole by 0.2 mm; nobody says so."""
    rig = build_rig("bar6", seed=7, frame="random", cameras="2R2W")
    known = simulate(rig, moving_board(rig, corners=(2, 3), square=40.0, positions=8, step=25.0), seed=8)
    assert known.known is not None
    off = np.random.default_rng(3).normal(0, 0.2, (8, 3)).repeat(6, axis=0)
    return replace(known, known=replace(known.known, xyz=known.known.xyz + off)), of_new_points(rig)


def heavy_tails() -> Pair:
    """Pixel noise of a t distribution with three degrees of freedom."""
    rig = build_rig("dome4", seed=7, frame="random")
    known = simulate(rig, random_positions(rig, 40, np.random.default_rng(1)), seed=1)
    return with_t_noise(known, 1), with_t_noise(of_new_points(rig), 2)


def with_t_noise(data: ic.Dataset, seed: int) -> ic.Dataset:
    seen = data.observations
    columns = [np.where(seen.extra[c] == "", "nan", seen.extra[c]).astype(float) for c in ("true_u", "true_v")]
    uv = np.stack(columns, axis=2)
    uv += 0.2 * np.random.default_rng(seed).standard_t(3, size=uv.shape)
    return replace(data, observations=replace(seen, uv=uv))


def two_sided_tank() -> Pair:
    """Real dots on three planes, which are off, through a real tank."""
    known, others = ic.read_dataset(TANK).split(45, seed=1)
    return known, others.select(np.arange(len(others.xyz)) < NEW_POINTS)


class Setup(NamedTuple):
    """Known points and new ones, and the methods they are for."""

    pair: Callable[[], Pair]
    methods: tuple[str, ...]


RIGS = {
    "ordinary": Setup(ordinary, tuple(METHODS)),
    "odd": Setup(odd, tuple(METHODS)),
    "traverse": Setup(traverse, ("forward-gp", "forward-gp:none", "explicit")),
    "heavy-tails": Setup(heavy_tails, ("forward-gp", "forward-gp:none", "explicit")),
    "two-sided-tank": Setup(two_sided_tank, tuple(METHODS)),
}


def has_library(name: str) -> bool:
    return name not in LIBRARY or importlib.util.find_spec(LIBRARY[name]) is not None


def fitted(known: ic.Dataset, name: str) -> ic.Calibration:
    """What a method makes of known points."""
    method, options = METHODS[name]
    if name in LIBRARY:
        with warnings.catch_warnings(action="ignore"):  # of other libraries, which warn where they are imported
            importlib.import_module(LIBRARY[name])
    with threadpool_limits(1):  # the order of a sum depends on the number of threads
        return ic.calibrator(method, **options).fit(known)


def measured_by(calibration: ic.Calibration, new: ic.Dataset) -> dict[str, Any]:
    """What a calibration measures of new points: JSON, None for NaN."""
    with threadpool_limits(1):
        measured = calibration.measure(new.observations)
    upper = measured.cov[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return {"xyz": plain(measured.xyz), "sd": plain(measured.sd), "cov": plain(upper), "views": measured.views.tolist()}


def numbers(pair: Pair, name: str) -> dict[str, Any]:
    """What a method, fitted to the first dataset, measures of the second."""
    return measured_by(fitted(pair[0], name), pair[1])


def pixels(pair: Pair) -> list[list[float | None]]:
    """Of each camera, the sums over known and new points of u and v that the methods are given."""
    return plain(np.column_stack([np.nansum(data.observations.uv, axis=0) for data in pair]))


def plain(rows: np.ndarray) -> list[list[float | None]]:
    return [[None if np.isnan(x) else float(x) for x in row] for row in rows]


def difference(stored: dict[str, Any], now: dict[str, Any]) -> float:
    """The largest difference in standard deviations; infinite where other points or views are measured."""
    xyz, sd, cov = (np.array(stored[what], float) for what in ("xyz", "sd", "cov"))
    xyz_now, cov_now = (np.array(now[what], float) for what in ("xyz", "cov"))
    if stored["views"] != now["views"] or not np.array_equal(np.isnan(cov), np.isnan(cov_now)):
        return np.inf
    products = np.column_stack([sd**2, sd[:, 0] * sd[:, 1], sd[:, 0] * sd[:, 2], sd[:, 1] * sd[:, 2]])
    far = np.concatenate([(xyz_now - xyz) / sd, (cov_now - cov) / products], axis=1)
    return float(np.nanmax(np.abs(far)))


def stored(rig: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((GOLDEN / f"{rig}.json").read_text())
    return content


def made_by() -> dict[str, str]:
    """The commit, the machine and the libraries."""
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    processor = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next((line.split(": ")[1] for line in lines if line.startswith("model name")), processor)
    return {
        "commit": subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip(),
        "machine": f"{processor}, {platform.system()}, Python {platform.python_version()}",
        **{name: version(name) for name in ("numpy", "scipy", "torch", "gpytorch")},
    }


def write() -> None:
    made = made_by()
    for rig, (pair, methods) in RIGS.items():
        measured = {name: numbers(pair(), name) for name in methods}
        content = {"made_by": made, "pixels": pixels(pair()), "methods": measured}
        (GOLDEN / f"{rig}.json").write_text(text(content))


def write_files() -> None:
    for rig, name in FILES:
        path = GOLDEN / f"v{FORMAT_WITHOUT_REPAIRS}-{rig}-{name}.implicam"
        if path.exists():
            print(f"{path.name} is there, and stays")
            continue
        known, new = RIGS[rig].pair()
        calibration = fitted(known, name)
        calibration.save(path)
        content = {"made_by": made_by(), "rig": rig, "measured": measured_by(calibration, new)}
        path.with_suffix(".json").write_text(text(content))


def text(content: dict[str, Any]) -> str:
    """JSON with a point a line."""
    numbers = r"(-?[\d.]+(?:e[+-]?\d+)?|null)"
    return re.sub(rf"\[\s+({numbers}(?:,\s+{numbers})*)\s+\]", one_line, json.dumps(content, indent=1)) + "\n"


def one_line(row: re.Match[str]) -> str:
    return "[" + re.sub(r"\s+", " ", row[1]) + "]"


def differences() -> Iterator[tuple[str, float]]:
    for rig, (pair, methods) in RIGS.items():
        content = stored(rig)
        if content["pixels"] != pixels(pair()):
            print(f"{rig}: the simulated pixels are not those of the stored numbers")
        for name in filter(has_library, methods):
            yield f"{rig:15s} {name:18s}", difference(content["methods"][name], numbers(pair(), name))


def compare(allowed_sd: float) -> float:
    made = stored("odd")["made_by"]
    print(f"difference in standard deviations from {made['commit']} on {made['machine']}")
    largest = 0.0
    for what, far in differences():
        print(f"{what} {far:.1e}", flush=True)
        largest = max(largest, far)
    print(f"largest {largest:.1e}; {allowed_sd:g} {'is kept' if largest <= allowed_sd else 'is EXCEEDED'}")
    return largest


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--compare", action="store_true", help="compare with the stored numbers; write nothing")
    parser.add_argument("--allowed", type=float, default=SAME_MACHINE_SD, metavar="SD", help="default %(default)s")
    parser.add_argument("--files", action="store_true", help="store the files of today's format that are not there")
    options = parser.parse_args()
    if options.files:
        write_files()
    elif not options.compare:
        write()
    elif compare(options.allowed) > options.allowed:
        sys.exit(1)
