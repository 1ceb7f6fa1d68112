"""Does `check` name the camera that moved, how far it moved, and nobody when nothing did?

    OPENBLAS_NUM_THREADS=1 python benchmarks/check.py --rigs 20 --trials 50      1000 trials of each kind
    python benchmarks/check.py --rigs 2 --trials 10                              does it run?
    python benchmarks/check.py --only half --rigs 5 --trials 20

bar6 rigs (lens errors of 0.5 px, 0.2 px noise), 157 known points at random, forward-gp; each trial 50 random positions
that nobody knows. Turned: one camera by 0.05 degree about a random axis across its line of sight. Shifted: by 0.4 mm
across it. Two: two cameras turned so. Shares of the trials, ± the standard error over the rigs. Covered: the 95 %
ellipsoid of all seven numbers of the movement holds the truth.
half: a camera moved by what the check says it would name half the time, by each of its seven numbers alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

import implicam as ic
from implicam.geometry import Pose, rotation_from_vector
from implicam.simulate import build_rig, random_positions, simulate
from implicam.stability import NUMBER_NAMES

TURN_DEG, SHIFT_MM, POINTS = 0.05, 0.4, 50
HEAD = "| what | trials | alarm | right camera named | a wrong one named | several | covered |"


def moved(rig, camera: int, step: np.ndarray):
    """One camera turned (degrees) and shifted (mm) about its own axes, and zoomed (per cent)."""
    before = rig.cameras[camera]
    pose, lens, zoom = before.camera_from_world, before.lens, 1 + step[6] / 100
    turn = rotation_from_vector(np.radians(step[:3])).T @ pose.rotation
    pose = Pose(turn, -turn @ (pose.centre + pose.rotation.T @ step[3:6]))
    after = replace(before, camera_from_world=pose, lens=replace(lens, fx=lens.fx * zoom, fy=lens.fy * zoom))
    return replace(rig, cameras=tuple(after if c == camera else one for c, one in enumerate(rig.cameras)))


def across(rng, first: int, size: float) -> np.ndarray:
    """A step of a random direction across the line of sight; first: 0 for a turn, 3 for a shift."""
    angle, step = rng.uniform(0, 2 * np.pi), np.zeros(7)
    step[first : first + 2] = size * np.cos(angle), size * np.sin(angle)
    return step


def calibrated(seed: int):
    rig = build_rig("bar6", seed=seed, lens_error=0.5)
    return rig, ic.ForwardGP().fit(simulate(rig, random_positions(rig, 157, np.random.default_rng(seed)), seed=seed))


def checked(calibration, rig, seed: int):
    views = simulate(rig, random_positions(rig, POINTS, np.random.default_rng(seed)), seed=seed)
    return ic.check_calibration(calibration, replace(views, known=None))


def covers(found, name: str, step: np.ndarray) -> bool:
    one = next(one for one in found.cameras if one.camera == name)
    error = one.step - step
    return bool(error @ np.linalg.solve(one.cov, error) < chi2.ppf(0.95, 7))


def trials(rigs: int, count: int) -> Iterator[str]:
    yield HEAD
    yield "|:--|--:|--:|--:|--:|--:|--:|"
    rows: dict[str, list[np.ndarray]] = {}
    for seed in range(rigs):
        rig, calibration = calibrated(seed)
        names, rng = calibration.camera_names, np.random.default_rng(seed)
        found: dict[str, list[list[float]]] = {}
        for k in range(count):
            one, other = (int(c) for c in rng.choice(len(names), 2, replace=False))
            turned, shifted = across(rng, 0, TURN_DEG), across(rng, 3, SHIFT_MM)
            kinds = {
                "nothing moved": (rig, (), np.zeros(7)),
                f"turned by {TURN_DEG} degrees": (moved(rig, one, turned), (one,), turned),
                f"shifted by {SHIFT_MM} mm": (moved(rig, one, shifted), (one,), shifted),
                "two turned": (moved(moved(rig, one, turned), other, across(rng, 0, TURN_DEG)), (one, other), turned),
            }
            for kind, (there, which, step) in kinds.items():
                check = checked(calibration, there, 10_000 * (seed + 1) + k)
                named = check.cameras[0].camera if check.verdict == "moved" else None
                right = named in [names[c] for c in which]
                covered = covers(check, names[one], step) if len(which) == 1 else np.nan
                found.setdefault(kind, []).append(
                    [not check.holds, right, named is not None and not right, check.verdict == "several moved", covered]
                )
        for kind, values in found.items():
            rows.setdefault(kind, []).append(np.mean(values, axis=0))
    for kind, values in rows.items():
        mean, error = np.mean(values, axis=0), np.std(values, axis=0, ddof=1) / np.sqrt(rigs)
        cells = [f"{100 * m:.1f} ± {100 * e:.1f} %" if np.isfinite(m) else "" for m, e in zip(mean, error, strict=True)]
        yield f"| {kind} | {rigs * count} | {' | '.join(cells)} |"


def half(rigs: int, count: int) -> Iterator[str]:
    yield "| moved by what is named half the time | trials | named |\n|:--|--:|--:|"
    rows = np.zeros((rigs, 7))
    for seed in range(rigs):
        rig, calibration = calibrated(seed)
        least = {one.camera: one.noticed for one in checked(calibration, rig, 999).cameras}
        rng = np.random.default_rng(seed)
        for i in range(7):
            for k in range(count):
                c = int(rng.integers(len(rig.cameras)))
                name = calibration.camera_names[c]
                check = checked(calibration, moved(rig, c, least[name][i] * np.eye(7)[i]), 20_000 * (seed + 1) + k)
                rows[seed, i] += (check.verdict == "moved" and check.cameras[0].camera == name) / count
    for i, number in enumerate(NUMBER_NAMES):
        error = rows[:, i].std(ddof=1) / np.sqrt(rigs)
        yield f"| {number} | {rigs * count} | {100 * rows[:, i].mean():.0f} ± {100 * error:.0f} % |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("trials", "half"), default="trials")
    parser.add_argument("--rigs", type=int, default=20)
    parser.add_argument("--trials", type=int, default=50)
    options = parser.parse_args()
    for row in {"trials": trials, "half": half}[options.only](options.rigs, options.trials):
        print(row, flush=True)


if __name__ == "__main__":
    main()
