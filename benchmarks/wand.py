"""Cameras from a waved wand and no known position: does it start, how exact is it, and are its error bars true?

    python benchmarks/wand.py                          100 rigs: 200 frames, 10 % wrong and 30 % missing views
    python benchmarks/wand.py --clean                  all views there and right
    python benchmarks/wand.py --frames 50 --rigs 4     fewer frames, four rigs of each kind
    python benchmarks/wand.py --real ../shared/real/caliscope-charuco   two corners of a board held by hand as a wand
    python benchmarks/wand.py --worlds --rigs 3        joint NEES in the wand's world, and in others set later
    python benchmarks/wand.py -o benchmarks/results/wand.md   the tables that are kept: all of these

Every rig is another one (lens errors of 0.5 px, 0.2 px noise); the wand is 0.6 of the volume's shortest edge, waved at
random all over it; no focal length, lens or pose is given. Then 500 random positions are measured. The true positions
of the wand are laid over those of the calibration by least squares, turned and shifted but never scaled, and the same
motion brings the measured positions into the true frame: what the calibration states is relative to the wand.

*rmse / limit*: over what perfectly known cameras would reach. *in 95 %*: positions in their ellipsoids; *NEES*: 3 is
right. *lengths*: of 100 pairs of measured positions, with what their errors share: in their 95 % intervals, and rms of
error over sd. *wrong views used*: of those in use. Means over rigs with their standard errors; CPU time in seconds,
median and slowest.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np
from scipy.stats import chi2

import implicam as ic
from implicam.dataset.boards import CORNER, corner_positions
from implicam.derived import distances, joint
from implicam.errors import ImplicamError
from implicam.geometry import Pose, register
from implicam.simulate import Target, as_wand, build_rig, random_positions, simulate, waved_wand

KINDS = ("stereo", "bar2", "bar3", "bar4", "bar6", "bar8", "dome3", "dome4", "dome6", "dome8")
HEAD = (
    "| rig | rigs | started | rmse / limit | in 95 % | NEES | lengths in 95 % | error / sd | wrong views used "
    "| frames with a length | CPU s |\n|---|---|---|---|---|---|---|---|---|---|---|"
)
HELD_OUT, PAIRS = 500, 100


def one(kind: str, seed: int, frames: int, outliers: float, missing: float, lens_error: float) -> dict[str, float]:
    """All numbers of one rig; of one that cannot be calibrated only the time."""
    rig = build_rig(kind, seed=seed, lens_error=lens_error)
    target = waved_wand(rig, frames, np.random.default_rng([seed, 11]))
    recorded = simulate(rig, target, seed=seed, outliers=outliers, missing=missing)
    held = simulate(rig, random_positions(rig, HELD_OUT, np.random.default_rng([seed, 2])), seed=seed + 1_000_003)
    began = process_time()
    try:
        calibration = ic.ForwardGP(wand=target.wand).fit(as_wand(recorded, target))
    except ImplicamError as error:
        print(f"{kind} {seed}: {error.what}", flush=True)
        return {"seconds": process_time() - began}
    seconds = process_time() - began
    row = {str(name): i for i, name in enumerate(recorded.points)}
    rows = np.array([row[str(name)] for name in calibration.data.points])
    wrong = np.asarray(recorded.observations.extra["outlier"]) == "1"
    used = calibration.data.observations.seen.copy()
    for view in calibration.rejected:
        used[np.flatnonzero(calibration.data.points == view.point), calibration.camera_names.index(view.camera)] = False
    to_truth, _ = register(calibration.data.xyz, target.xyz[rows])
    measured = calibration.measure(held.observations)
    good = measured.measured
    error = to_truth.apply(measured.xyz[good]) - held.truth.xyz[good]
    cov = to_truth.rotation @ measured.cov[good] @ to_truth.rotation.T
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    limit = np.trace(held.truth.limit[good], axis1=1, axis2=2)
    z = np.array(list(length_errors(measured, held.truth.xyz)))
    return {
        "seconds": seconds,
        "ratio": float(np.sqrt(np.mean(np.sum(error**2, axis=1)) / np.mean(limit))),
        "inside": float(np.mean(nees < chi2.ppf(0.95, 3))),
        "nees": float(np.mean(nees)),
        "lengths": float(np.mean(np.abs(z) < 1.96)),
        "z": float(np.sqrt(np.mean(z**2))),
        "wrong": float((wrong[rows] & used).sum()),
        "frames": len(calibration.waved.errors),
        "cameras": len(calibration.camera_names) / len(rig.cameras),
    }


WORLDS = ("the wand's", "an L-frame", "the same by axes", "a camera", "ten known points in the fit")
LENGTH_SD, KNOWN_SD = 0.002, 0.001
"""Of a wand that is used together with known points, over its length; of these, over the volume's shortest edge."""


def worlds(kind: str, seed: int, frames: int, outliers: float, missing: float, lens_error: float) -> dict[str, float]:
    """Joint NEES of 30 positions over 90, in each of the worlds; and how far off they are there (rms)."""
    rig = build_rig(kind, seed=seed, lens_error=lens_error)
    target = waved_wand(rig, frames, np.random.default_rng([seed, 11]))
    recorded = simulate(rig, target, seed=seed, outliers=outliers, missing=missing)
    held = simulate(rig, random_positions(rig, 30, np.random.default_rng([seed, 2])), seed=seed + 1_000_003)
    calibration = ic.ForwardGP(wand=target.wand).fit(as_wand(recorded, target))
    row = {str(name): i for i, name in enumerate(recorded.points)}
    at = target.xyz[[row[str(name)] for name in calibration.data.points]]
    own, _ = register(at, calibration.data.xyz)
    # an L-frame of half the shortest edge in the middle, exactly known
    edge = 0.5 * float(min(rig.volume.size))
    arms = edge * np.array([[0.0, 0, 0], [0.5, 0, 0], [1, 0, 0], [0, 1, 0]])
    corner = rig.volume.world_from_box @ Pose(np.eye(3), edge * np.array([-0.4, -0.4, 0]))
    names = np.array(["o", "x1", "x2", "y"])
    seen = simulate(rig, Target("l-frame", names, names, corner.apply(arms)), seed=seed + 500_009)
    known = replace(seen, known=ic.KnownPositions(names, arms, np.full((4, 3), 1e-4 * edge)))
    placed = {
        "the wand's": (calibration, own),
        "an L-frame": (ic.set_world(calibration, known), corner.inverse()),
        "the same by axes": (
            ic.set_world(calibration, replace(seen, known=None), origin="o", x="x2", y="y"), corner.inverse()
        ),
        "a camera": (ic.set_world(calibration, camera="cam1"), rig.cameras[0].camera_from_world),
    }  # fmt: skip
    rng = np.random.default_rng([seed, 7])
    shown = simulate(rig, random_positions(rig, 10, rng), seed=seed + 700_001)
    sd = KNOWN_SD * float(min(rig.volume.size))
    at = shown.truth.xyz + sd * rng.normal(size=(10, 3))
    known = replace(shown, known=ic.KnownPositions(shown.points, at, np.full((10, 3), sd)))
    length = target.wand * (1 + LENGTH_SD * rng.normal())
    together = ic.ForwardGP(wand=length, wand_sd=LENGTH_SD * length, known=known).fit(as_wand(recorded, target))
    placed["ten known points in the fit"] = together, Pose(np.eye(3), np.zeros(3))
    found = {}
    for name, (one, to_world) in placed.items():
        measured = one.measure(held.observations)
        good = np.flatnonzero(measured.measured)
        off = (measured.xyz[good] - to_world.apply(held.truth.xyz[good])).ravel()
        found[name] = float(off @ np.linalg.solve(joint(measured, good.tolist()).cov, off)) / len(off)
        found[f"{name} rms"] = float(np.sqrt(3 * np.mean(off**2)))
    return found


def table_of_worlds(kinds, count: int, seed0: int, frames: int, outliers: float, missing: float, lens_error: float):
    """Joint NEES over its degrees of freedom, line by line."""
    yield f"| rig | rigs | {' | '.join(WORLDS)} |\n|{'---|' * (2 + len(WORLDS))}"
    every = []
    for kind in kinds:
        rows = [worlds(kind, seed0 + i, frames, outliers, missing, lens_error) for i in range(count)]
        every += rows
        yield f"| {kind} | {count} | {' | '.join(told(rows, name, 2) for name in WORLDS)} |"
    yield f"| **all** | {len(every)} | {' | '.join(told(every, name, 3) for name in WORLDS)} |"
    wand = np.array([row["the wand's"] for row in every])
    parts = (
        f"{np.std([row[name] - wand[i] for i, row in enumerate(every)]) / len(every) ** 0.5:.3f}" for name in WORLDS[1:]
    )
    yield f"\nStandard errors of the differences from the first column: {', '.join(parts)}."


def length_errors(measured, true):
    """Errors over sd of the distances of random pairs."""
    rng, good = np.random.default_rng(0), np.flatnonzero(measured.measured)
    pairs = [tuple(map(int, rng.choice(good, 2, replace=False))) for _ in range(PAIRS)]
    for (i, j), found in zip(pairs, distances(measured, pairs), strict=True):
        yield (found.value - np.linalg.norm(true[i] - true[j])) / found.sd


def real(folder: Path, seed: int) -> str:
    """Two corners of a board, three squares apart, are a wand; then all neighbouring corners are measured."""
    data = ic.read_dataset(folder)
    square, at = data.extra["target"]["square"], corner_positions(data.extra["target"])
    found = [CORNER.fullmatch(str(point)) for point in data.points]
    row = {(one["shot"], int(one["number"]) - 1): i for i, one in enumerate(found)}
    rng, rows = np.random.default_rng(seed), list[tuple[int, str, str]]()
    apart = np.linalg.norm(at[:, None] - at, axis=2)
    for shot in dict.fromkeys(one["shot"] for one in found):
        seen = [(i, j) for i, j in np.argwhere(np.isclose(apart, 3 * square)) if {(shot, i), (shot, j)} <= row.keys()]
        if seen:
            i, j = sorted(seen[rng.integers(len(seen))])
            rows += [(row[shot, i], shot, "a"), (row[shot, j], shot, "b")]
    frames, markers = (np.array([one[k] for one in rows]) for k in (1, 2))
    seen = data.observations.select(np.array([one[0] for one in rows]))
    seen = replace(seen, points=np.array([f"{frame} {marker}" for frame, marker in zip(frames, markers, strict=True)]))
    waved = replace(data, observations=seen, columns={"frame": frames, "marker": markers}, extra={})
    calibration = ic.ForwardGP(wand=3 * square).fit(waved)
    measured = calibration.measure(data.observations)
    pairs = [
        (row[shot, i], row[shot, j]) for (shot, i) in row for j in np.flatnonzero(np.isclose(apart[i], square))
        if j > i and (shot, j) in row and measured.measured[[row[shot, i], row[shot, j]]].all()
    ]  # fmt: skip
    lengths = distances(measured, pairs)
    error = np.array([one.value for one in lengths]) - square
    inside = np.mean(np.abs(error) < 1.96 * np.array([one.sd for one in lengths]))
    return (
        f"{len(rows) // 2} frames: {len(pairs)} neighbouring corners are off by {np.median(np.abs(error)):.2g} "
        f"{data.length_unit} in the median, {np.sqrt(np.mean(error**2)):.2g} rms; {100 * inside:.0f} % in their 95 %"
    )


def told(rows: list[dict[str, float]], name: str, digits: int = 3) -> str:
    """Mean and standard error."""
    values = np.array([row[name] for row in rows if name in row])
    if not len(values):
        return "-"
    error = np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return f"{np.mean(values):.{digits}f} ± {error:.{digits}f}"


def line(name: str, rows: list[dict[str, float]]) -> str:
    """A row of the table."""
    good = [row for row in rows if "ratio" in row]
    seconds = [row["seconds"] for row in rows]
    started = f"{sum(row['cameras'] == 1 for row in good)}"
    return (
        f"| {name} | {len(rows)} | {started} "
        f"| {told(rows, 'ratio')} | {told(rows, 'inside')} | {told(rows, 'nees', 2)} "
        f"| {told(rows, 'lengths')} | {told(rows, 'z', 2)} | {sum(row['wrong'] for row in good):.0f} "
        f"| {np.mean([row['frames'] for row in good]) if good else 0:.0f} "
        f"| {np.median(seconds):.1f}, {max(seconds):.1f} |"
    )


def table(kinds, count: int, seed0: int, frames: int, outliers: float, missing: float, lens_error: float):
    """The table, line by line."""
    yield HEAD
    every: list[tuple[str, dict[str, float]]] = []
    for kind in kinds:
        rows = [one(kind, seed0 + i, frames, outliers, missing, lens_error) for i in range(count)]
        every += [(kind, row) for row in rows]
        yield line(kind, rows)
    two = ("stereo", "bar2")
    parts = {"two cameras": [r for k, r in every if k in two], "three and more": [r for k, r in every if k not in two]}
    for name, wanted in parts.items():
        if wanted:
            yield line(f"**{name}**", wanted)


def kept(seed0: int):
    """The page of results."""
    yield __doc__.split("\n\n", 1)[1].split("\n\n", 1)[1]
    for title, count, frames, outliers, missing in (
        ("200 frames, 10 % wrong and 30 % missing views", 10, 200, 0.1, 0.3),
        ("200 frames, all views there and right", 4, 200, 0.0, 0.0),
        ("100 frames, 10 % wrong and 30 % missing views", 4, 100, 0.1, 0.3),
        ("50 frames, 10 % wrong and 30 % missing views", 4, 50, 0.1, 0.3),
        ("50 frames, all views there and right", 4, 50, 0.0, 0.0),
    ):
        yield f"\n## {title}\n"
        yield from table(KINDS, count, seed0, frames, outliers, missing, 0.5)
    for frames in (200, 100):
        yield f"\n## Joint NEES in the world that is named, {frames} frames\n"
        yield from table_of_worlds(KINDS, 3, seed0, frames, 0.1, 0.3, 0.5)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", default=KINDS)
    parser.add_argument("--rigs", type=int, default=10)
    parser.add_argument("--seed0", type=int, default=100)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--lens-error", type=float, default=0.5)
    parser.add_argument("--clean", action="store_true")
    parser.add_argument("--worlds", action="store_true")
    parser.add_argument("-o", type=Path)
    parser.add_argument("--real", type=Path)
    args = parser.parse_args()
    if args.real:
        for seed in range(3):
            print(real(args.real, seed), flush=True)
        return
    if args.o:
        lines = ["# Calibrated from a wand", ""]
        for text in kept(args.seed0):
            print(text, flush=True)
            lines.append(text)
        args.o.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return
    wrong, missing = (0.0, 0.0) if args.clean else (0.1, 0.3)
    lines = table_of_worlds if args.worlds else table
    for text in lines(args.kinds, args.rigs, args.seed0, args.frames, wrong, missing, args.lens_error):
        print(text, flush=True)


if __name__ == "__main__":
    main()
