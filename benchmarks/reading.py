"""How long reading takes where a file is large, or is something else: seconds of CPU, one process.

    python benchmarks/reading.py

The tests say that these are read, or refused in little memory; how fast is said here only.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from implicam.calibrators import load_calibration
from implicam.dataset import Camera, Observations, read_dataset, write_dataset
from implicam.errors import ImplicamError
from implicam.simulate import build_rig, random_positions, simulate

NAMES = 100_000
COLUMNS = 30_000
DIGITS = 100_000
GIGABYTE = 1 << 30


def many_names(folder: Path) -> None:
    points = np.array([f"p{i}" for i in range(NAMES)])
    Observations(points, (Camera("a"),), np.zeros((NAMES, 1, 2)), np.full((NAMES, 1, 2), np.nan))


def dataset(folder: Path) -> Path:
    rig = build_rig("stereo", seed=0)
    write_dataset(simulate(rig, random_positions(rig, 5, np.random.default_rng(0)), seed=0), folder / "rig")
    return folder / "rig"


def many_columns(folder: Path) -> None:
    path = dataset(folder) / "points.csv"
    head, *lines = path.read_text().splitlines()
    wide = [head + "".join(f",c{i}" for i in range(COLUMNS)), *(line + ",1" * COLUMNS for line in lines)]
    path.write_text("\n".join(wide))
    read_dataset(path.parent)


def a_gigabyte_of_zeros(folder: Path) -> None:
    path = dataset(folder) / "observations.csv"
    with path.open("wb") as file:
        file.truncate(GIGABYTE)
    read_dataset(path.parent)


def an_enormous_number(folder: Path) -> None:
    path = folder / "rig.implicam"
    path.write_text("format_version = " + "9" * DIGITS)
    load_calibration(path)


READINGS: dict[str, Callable[[Path], None]] = {
    f"{NAMES:,} names checked": many_names,
    f"a table of {COLUMNS:,} columns read": many_columns,
    "a gigabyte of zeros refused": a_gigabyte_of_zeros,
    f"a calibration with a number of {DIGITS:,} digits refused": an_enormous_number,
}


def main() -> None:
    for what, read in READINGS.items():
        with tempfile.TemporaryDirectory() as folder:
            start, outcome = time.process_time(), "done"
            try:
                read(Path(folder))
            except ImplicamError:
                outcome = "refused"
            print(f"{time.process_time() - start:6.2f} s  {what} ({outcome})")


if __name__ == "__main__":
    main()
