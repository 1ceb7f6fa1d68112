"""Predicted against realised uncertainty of placements, and bars, grids and domes of 4 to 48 cameras.

    python benchmarks/design.py check            the table of predicted against realised; what is in
                                                 benchmarks/results/design_check.md already is kept
    python benchmarks/design.py study            the table and the figure of docs/design.md; draw: the figure again

check: each placement is built --rigs times (half as often where known positions are off), a little different each
time; forward-gp is fitted to the known points and measures 300 places all over the workspace. study: placements drawn
alike (`drawn`), with 36 known points.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from implicam.design import Assumptions, Design, compare_designs
from implicam.simulate.placements import grid_rows
from implicam.threads import blas_threads

HERE = Path(__file__).parent
RESULTS = HERE / "results"
FIGURE = HERE.parent / "docs" / "images" / "design-study.png"

WIDE = """
workspace = [[-200, 200], [-150, 150], [-150, 150]]
[every_camera]
size = [1280, 1024]
look_at = [0, 0, 0]
up = [0, -1, 0]
fov_deg = 60
[[cameras]]
position = [-400, 0, -600]
[[cameras]]
position = [400, 0, -600]
[[cameras]]
position = [0, -300, -400]
fov_deg = 120
"""
"""Two cameras, and one with a very wide lens between them."""
WIDE_NAME = "wide"

CASES = (
    ("2R", 36, 0.0),
    ("2R", 16, 0.0),
    ("2R", 36, 0.3),
    ("bar6", 36, 0.0),
    ("bar6", 16, 0.0),
    ("bar6", 36, 0.1),
    ("bar6", 100, 0.0),
    ("grid9", 36, 0.0),
    ("grid9", 36, 0.1),
    ("dome8", 36, 0.0),
    ("dome8", 16, 0.0),
    ("dome8", 36, 0.1),
    ("stereo", 36, 0.0),
    (WIDE_NAME, 36, 0.0),
    (WIDE_NAME, 36, 0.1),
    ("2R", 10, 0.0),
    ("bar6", 10, 0.0),
    ("bar12 of the study", 36, 0.0),
    ("dome24 of the study", 36, 0.0),
)
"""Placement, known points, and the sd of their positions in mm."""

HEADINGS = (
    "| placement | known points | their sd, mm | rigs | predicted, mm | rms error, mm | over predicted | "
    "stated sd, mm | over predicted | worst axis |"
)

CAMERAS = (4, 6, 8, 9, 12, 16, 24, 32, 48)
KINDS = ("bar", "grid", "corners", "dome")
DISTANCE_MM, HALF_WIDTH_MM, HALF_HEIGHT_MM = 1000.0, 700.0, 500.0
"""Of all cameras of the study from the middle, and half the sides of bar and grid."""
UNCERTAINTY_TICKS_MM = (0.1, 0.15, 0.2, 0.3, 0.4, 0.6)
STEP_MM = 60.0
"""Between the cameras that stand together at a corner of the grid's rectangle."""


def main() -> None:
    """Run one of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("check", "study", "draw"))
    parser.add_argument("--rigs", type=int, default=20)
    options = parser.parse_args()
    with blas_threads(1):
        if options.what == "check":
            check(options.rigs)
        elif options.what == "study":
            study()
        else:
            draw(json.loads((RESULTS / "design_study.json").read_text()))


def check(rigs: int) -> None:
    """A row for each placement; those that the file has already are kept, so that a run goes on where it stopped."""
    path = RESULTS / "design_check.md"
    lines = path.read_text().splitlines() if path.exists() else [HEADINGS, "|---" * HEADINGS.count(" | ") + "|---|"]
    print("\n".join(lines), flush=True)
    with tempfile.TemporaryDirectory() as folder:
        drawings = {WIDE_NAME: WIDE, CASES[-2][0]: drawn("bar", 12), CASES[-1][0]: drawn("dome", 24)}
        for name, text in drawings.items():
            (Path(folder) / f"{name}.toml").write_text(text)
        for name, points, sd in CASES:
            key = f"| {name} | {points} | {sd:g} | "
            if any(line.startswith(key) for line in lines):
                continue
            spec = str(Path(folder) / f"{name}.toml") if name in drawings else name
            count = rigs // 2 if sd else rigs  # their fits take ten times as long
            (design,) = compare_designs([spec], Assumptions(position_sd=sd), points, places=300, check=count)
            lines.append(key + as_line(design))
            print(lines[-1], flush=True)
            path.write_text("\n".join(lines) + "\n")


def as_line(design: Design) -> str:
    """The numbers of one placement."""
    assert design.realised is not None
    *axes, (_, predicted, error, stated) = design.check_rows()
    ratios = [found / p for _, p, e, s in axes for found in (e, s)]
    worst = max(ratios, key=lambda ratio: abs(np.log(ratio)))
    (by_error, error_sd), (by_stated, stated_sd) = design.realised.error_ratio, design.realised.stated_ratio
    return (
        f"{len(design.realised.errors)} | {predicted:.3f} | {error:.3f} | {by_error:.3f} ± {error_sd:.3f} | "
        f"{stated:.3f} | {by_stated:.3f} ± {stated_sd:.3f} | {worst:.3f} |"
    )


def drawn(kind: str, n: int) -> str:
    """RIG.toml of n equal cameras, all aimed at the middle of the workspace and one metre from it."""
    lines = [
        "workspace = [[-200, 200], [-200, 200], [-200, 200]]\n[every_camera]\nsize = [1280, 1024]",
        "look_at = [0, 0, 0]\nup = [0, -1, 0]\nfov_deg = 55",
    ]
    for x, y, z in places(kind, n):
        lines.append(f"[[cameras]]\nposition = [{x:.3f}, {y:.3f}, {z:.3f}]")
    return "\n".join(lines)


def places(kind: str, n: int) -> Iterator[tuple[float, float, float]]:
    """Where the cameras stand: on the sphere of one metre, over a line, over a lattice, in four groups, or all
    round above."""
    if kind == "dome":  # a spiral that covers the upper half of the sphere evenly
        for i in range(n):
            up = (i + 0.5) / n
            around = i * np.pi * (3 - np.sqrt(5))
            aside = np.sqrt(1 - up**2)
            yield DISTANCE_MM * aside * np.cos(around), -DISTANCE_MM * up, DISTANCE_MM * aside * np.sin(around)
        return
    if kind == "corners":
        columns = int(np.ceil(np.sqrt(n // 4)))
        for i in range(n // 4):
            x, y = HALF_WIDTH_MM - STEP_MM * (i % columns), HALF_HEIGHT_MM - STEP_MM * (i // columns)
            for right, down in product((-1, 1), repeat=2):
                yield right * x, down * y, -float(np.sqrt(DISTANCE_MM**2 - x**2 - y**2))
        return
    rows = [n] if kind == "bar" else grid_rows(n)
    heights = np.linspace(-HALF_HEIGHT_MM, HALF_HEIGHT_MM, len(rows)) if len(rows) > 1 else np.zeros(1)
    for columns, y in zip(rows, heights, strict=True):
        for x in np.linspace(-HALF_WIDTH_MM, HALF_WIDTH_MM, columns):
            yield float(x), float(y), -float(np.sqrt(DISTANCE_MM**2 - x**2 - y**2))


def study() -> None:
    """The table and the figure."""
    rows = []
    print(
        "| cameras | placement | median sd x, mm | y | z | 95 % uncertainty, median | in 95 % | worst | calibration | ",
        end="",
    )
    print("without the best camera | without any one |\n|---|---|---|---|---|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for n in CAMERAS:
            for kind in KINDS if n % 4 == 0 else [kind for kind in KINDS if kind != "corners"]:
                path = Path(folder) / f"{kind}{n}.toml"
                path.write_text(drawn(kind, n))
                (design,) = compare_designs([str(path)], Assumptions(), 36)
                rows.append(study_row(kind, n, design))
                print(study_line(rows[-1]), flush=True)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "design_study.json").write_text(json.dumps(rows, indent=1))
    draw(rows)


def study_row(kind: str, n: int, design: Design) -> dict[str, Any]:
    """The numbers of one placement."""
    spreads = {spread.name: [spread.median, spread.usual, spread.worst] for spread in design.spreads}
    lost = [part.lost for part in design.parts]
    blind = design.prediction.blind
    return {"kind": kind, "cameras": n, "spreads": spreads, "lost": [max(lost), float(np.mean(lost))], "blind": blind}


def study_line(row: dict[str, Any]) -> str:
    """A line of the table."""
    s = row["spreads"]
    axes = " | ".join(f"{s[f'sd along {axis}'][0]:.4f}" for axis in "xyz")
    u95 = " | ".join(f"{value:.3f}" for value in s["95 % uncertainty"])
    share, (worst, mean) = s["share of calibration"][0], row["lost"]
    return (
        f"| {row['cameras']} | {row['kind']} | {axes} | {u95} | {100 * share:.0f} % | {100 * worst:.1f} % | "
        f"{100 * mean:.1f} % |"
    )


def draw(rows: list[dict[str, Any]]) -> None:
    """How the uncertainty falls with the number of cameras."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    looks = {"bar": ("#D55E00", "o"), "grid": ("#0072B2", "s"), "corners": ("#CC79A7", "D"), "dome": ("#009E73", "^")}
    for kind in KINDS:
        own = [row for row in rows if row["kind"] == kind]
        n = [row["cameras"] for row in own]
        colour, mark = looks[kind]
        u95 = np.array([row["spreads"]["95 % uncertainty"] for row in own])
        left.plot(n, u95[:, 1], color=colour, marker=mark, label=kind)
        axes = np.array([[row["spreads"][f"sd along {axis}"][0] for axis in "xyz"] for row in own])
        right.plot(n, axes.max(axis=1) / axes.min(axis=1), color=colour, marker=mark, label=kind)
    for axes, title, label in (
        (left, "95 % uncertainty, in 95 % of the workspace", "mm"),
        (right, "Worst axis over best axis", "ratio of the median sds"),
    ):
        axes.set(xscale="log", xticks=CAMERAS, xlabel="cameras", ylabel=label)
        axes.set_xticks(CAMERAS, [str(n) for n in CAMERAS])
        axes.minorticks_off()
        axes.set_title(title, fontsize=11, loc="left")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8)
    left.set_yscale("log")
    left.set_ylim(0.09, 0.7)
    left.set_yticks(UNCERTAINTY_TICKS_MM, [f"{tick:g}" for tick in UNCERTAINTY_TICKS_MM])
    left.minorticks_off()
    right.set_ylim(bottom=0)
    figure.savefig(FIGURE, dpi=110)


if __name__ == "__main__":
    main()
