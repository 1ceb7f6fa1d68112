"""Does `check` name the camera that moved, how far it moved, and nobody when nothing did?

    OPENBLAS_NUM_THREADS=1 python benchmarks/check.py --rigs 20 --trials 50      1000 trials of each kind
    python benchmarks/check.py --rigs 2 --trials 10                              does it run?
    python benchmarks/check.py --only half --rigs 25 --trials 8
    python benchmarks/check.py --only repair --rigs 40
    python benchmarks/check.py --only real --real ../shared/real
    python benchmarks/check.py --only history                      docs/images/check-history.png

bar6 rigs (lens errors of 0.5 px, 0.2 px noise), 157 known points at random, forward-gp; each trial 50 random positions
that nobody knows. Turned: one camera by 0.05 degree about a random axis across its line of sight. Shifted: by 0.4 mm
across it. Two: two cameras turned so; knocked: 20 times as far. Shares of the trials, ± the standard error over the
rigs. Covered: the 95 % ellipsoid of all seven numbers of the movement holds the truth.
half: a camera moved by what the check says it would name half the time, by each of its seven numbers alone.
repair: a camera turned by about a degree and shifted by about 5 mm, in any direction, and put right from the 50 points;
then 200 others measured. Before: by the calibration as it was. Not moved: the same positions before the movement.
real: of published data 60 % of the points calibrate, the rest are seen by a camera whose pixels are shifted by (3, -2)
and turned by 3 mrad about the middle of what it sees; their positions are withheld from the check. Nobody moved these
cameras: the movement is ours, the cameras, lenses, targets and mistakes are theirs.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.stats import chi2

import implicam as ic
from implicam.figures.check_history import check_history_figure
from implicam.geometry import Pose, rotation_from_vector
from implicam.simulate import build_rig, random_positions, simulate
from implicam.stability import NUMBER_NAMES, append_to_log, read_log

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
                "two knocked": (
                    moved(moved(rig, one, 20 * turned), other, across(rng, 0, 20 * TURN_DEG)),
                    (one, other),
                    turned,
                ),
            }
            if k >= count / 4:  # a share that is to be 5 % at most takes fewer trials than one that is to be 95
                del kinds["two turned"], kinds["two knocked"]
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
        number = rigs * (count if not kind.startswith("two") else -(-count // 4))
        yield f"| {kind} | {number} | {' | '.join(cells)} |"


def half(rigs: int, count: int) -> Iterator[str]:
    yield "| moved by what is named half the time | trials | named |\n|:--|--:|--:|"
    rows = np.zeros((rigs, 7))
    for seed in range(rigs):
        rig, calibration = calibrated(seed)
        least = checked(calibration, rig, 999).noticed
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


def errors(calibration, data) -> tuple[float, float, float]:
    """Rms of the errors of positions, the share within their 95 % ellipsoids, and how many were measured."""
    measured = calibration.measure(data)
    error = measured.xyz - data.xyz
    good = np.isfinite(error).all(axis=1)
    error, cov = error[good], measured.cov[good]
    if hasattr(calibration, "known_position_covariance"):
        cov = cov + calibration.known_position_covariance(data.xyz[good])
    inside = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error) < chi2.ppf(0.95, 3)
    return float(np.sqrt(np.mean(error**2))), float(np.mean(inside)), int(good.sum())


def repair(rigs: int, count: int) -> Iterator[str]:
    found: dict[str, list[tuple[float, ...]]] = {}
    stated, named = [], 0
    for seed in range(rigs):
        rig, calibration = calibrated(seed)
        rng = np.random.default_rng(seed)
        step = rng.normal(size=7) * [*[1.0] * 3, *[5.0] * 3, 0.3]
        c = int(rng.integers(len(rig.cameras)))
        there = moved(rig, c, step)
        check = checked(calibration, there, 30_000 + seed)
        if check.verdict != "moved" or check.cameras[0].camera != calibration.camera_names[c]:
            continue
        named += 1
        after = check.repair()
        stated.append([after.sd_unmoved, after.sd, after.sd_without])
        where = random_positions(there, 200, np.random.default_rng(40_000 + seed))
        views, before = simulate(there, where, seed=seed), simulate(rig, where, seed=seed)
        others = replace(
            views,
            observations=views.observations.with_cameras(
                [name for name in calibration.camera_names if name != calibration.camera_names[c]]
            ),
        )
        for what, made, data in (
            ("not moved", calibration, before), ("before the repair", calibration, views),
            ("without the camera", calibration, others), ("repaired", after.calibration, views),
        ):  # fmt: skip
            found.setdefault(what, []).append(errors(made, data))
    each = ", ".join(f"{x:.4f}" for x in np.mean(stated, axis=0))
    yield f"Named {named} of {rigs}; stated: {each} mm (not moved, now, without it)\n"
    yield "| | rms, mm | in 95 % |\n|:--|--:|--:|"
    for what, values in found.items():
        each = np.array(values)
        error = each[:, 1].std(ddof=1) / np.sqrt(len(each))
        rms = np.sqrt(np.mean(each[:, 0] ** 2))
        yield f"| {what} | {rms:.4f} | {100 * each[:, 1].mean():.1f} ± {100 * error:.1f} % |"


REAL = ("rbc300", "two-sided-tank", "image-splitter", "water-tank-target")


def real(folder: Path, splits: int) -> Iterator[str]:
    yield "| data | trials | named | rms not moved, mm | moved | repaired | in 95 % not moved | repaired |"
    yield "|:--|--:|--:|--:|--:|--:|--:|--:|"
    for name in REAL:
        data, rows, right, trials_ = ic.read_dataset(folder / name), [], 0, 0
        for seed in range(splits):
            known, later = data.split(int(0.6 * len(data)), seed=seed)
            calibration = ic.ForwardGP().fit(known)
            for camera in calibration.camera_names:
                k, turn = later.observations.camera_names.index(camera), 0.003
                uv = later.observations.uv.copy()
                middle = np.nanmean(uv[:, k], axis=0)
                rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
                uv[:, k] = (uv[:, k] - middle) @ rotation.T + middle + [3.0, -2.0]
                views = replace(later, observations=replace(later.observations, uv=uv))
                check = ic.check_calibration(calibration, replace(views, known=None))
                trials_ += 1
                if check.verdict != "moved" or check.cameras[0].camera != camera:
                    continue
                right += 1
                made = (calibration, later), (calibration, views), (check.repair().calibration, views)
                rows.append([errors(*one) for one in made])
        each = np.array(rows)
        rms = np.sqrt(np.mean(each[:, :, 0] ** 2, axis=0))
        inside = 100 * each[:, :, 1].mean(axis=0)
        sizes = " | ".join(f"{x:.4f}" for x in rms)
        yield f"| {name} | {trials_} | {right} | {sizes} | {inside[0]:.0f} % | {inside[2]:.0f} % |"


def history(path: Path) -> Iterator[str]:
    """14 weekly checks: from the seventh on cam2 pans by 0.01 degrees a week, in the last but one cam5 is knocked."""
    rig, calibration = calibrated(0)
    with TemporaryDirectory() as folder:
        log = Path(folder) / "checks.csv"
        for week in range(14):
            there = moved(rig, 1, np.array([0, 0.01 * max(week - 5, 0), 0, 0, 0, 0, 0]))
            if week == 12:
                there = moved(there, 4, np.array([0.3, 0, 0, 1, 0, 0, 0]))
            now = datetime(2026, 9, 1, 8, tzinfo=UTC) + timedelta(weeks=week)
            append_to_log(log, checked(calibration, there, week), f"week {week}", now=now)
        check_history_figure(read_log(log)).savefig(path, dpi=90)
    yield str(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("trials", "half", "repair", "real", "history"), default="trials")
    parser.add_argument("--rigs", type=int, default=20)
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--real", type=Path, default=Path("../shared/real"))
    options = parser.parse_args()
    if options.only == "real":
        rows = real(options.real, splits=2)
    elif options.only == "history":
        rows = history(Path("docs/images/check-history.png"))
    else:
        rows = {"trials": trials, "half": half, "repair": repair}[options.only](options.rigs, options.trials)
    for row in rows:
        print(row, flush=True)


if __name__ == "__main__":
    main()
