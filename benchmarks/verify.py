"""Is what `verify` states true: its uncertainties, its power, its decisions?

    OPENBLAS_NUM_THREADS=1 python benchmarks/verify.py --trials 1000       all tables, two hours on one core
    OPENBLAS_NUM_THREADS=1 python benchmarks/verify.py --trials 20         does it run?
    python benchmarks/verify.py --real ../shared/real                      lengths in data of other people

Every trial is a rig of its own (lens errors of 0.5 px, 0.2 px noise), calibrated by forward-gp with known points at
random, and a step gauge or a ball bar whose true length differs from its certificate as that says: standard
uncertainty 5e-5 of the length, far more than good ones have, so that it shows; measured at 23 degrees C known to 0.2,
steel, its coefficient of expansion known to 1e-6 per K; and 0.01 mm of setup at each length.

coverage  of all lengths: the true error of the measured length is within the expanded uncertainty (k = 2, so 95.4 % is
          right) (a) of the test, about the error that it found; (b) that the calibration predicts of the measured
          length, about 0; (c) the error found is within both together. Of trials: (d) chi-squared of error bars above
          its 97.5 % quantile, (e) below its 2.5 % quantile, (f) an error of scale found where there is none. ± standard
          errors over trials.
power     the known points of the rig are too large by a scale error, so all that it measures is: how often the test of
          scale finds it, and the mean of the probabilities that it stated.
decision  35 lengths of a rig that is exactly at its limit, or 4 U inside or outside of it, measured without error
          of its own: how often conformity and non-conformity are proven.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import implicam as ic
from implicam.dataset.boards import CORNER, corner_positions
from implicam.simulate import Target, build_rig, random_positions, simulate, step_gauge
from implicam.verification import decide

SD_SCALE, SD_EXPANSION, SD_TEMPERATURE, SD_SETUP = 5e-5, 1e-6, 0.2, 0.01
EXPANSION, TEMPERATURE = 11.5e-6, 23.0
CASES = (("stereo", 157, 0.2, "bar"), ("bar6", 35, 0.2, "gauge"))
POWERS = (("stereo", 157, 0.05, 1e-4), ("stereo", 35, 0.05, 3e-4))
REAL = (
    ("caliscope-charuco", "half of the pictures"), ("two-sided-tank", "half of the dots"),
    ("water-tank-target", "half of the dots"), ("multiplane", "half of the dots"), ("rbc300", "half of the dots"),
    ("rbc300", "plane-z150"), ("multiplane", "plane2"),
)  # fmt: skip
REAL_LENGTHS = 60


@dataclass(frozen=True)
class Trial:
    """One verification of a simulated rig: what was stated, and the truth."""

    found: ic.Verification
    true_error: np.ndarray


def shown(rig, kind: str) -> tuple[Target, list[tuple[str, str, float]]]:
    """What is shown to the cameras, and the true lengths in it."""
    gauge, lengths = step_gauge(rig)
    if kind == "gauge":
        return gauge, [(one.a, one.b, one.length) for one in lengths]
    names, ends, pairs = [], [], []
    half = 0.3 * float(rig.volume.size.min())  # a ball bar, once at each of 35 places
    rng = np.random.default_rng(rig.seed + 77)
    for i in range(35):
        along = rng.normal(size=3)
        along *= half / np.linalg.norm(along)
        centre = rig.volume.world_from_box.apply(rng.uniform(-0.5, 0.5, (1, 3)) * (rig.volume.size - 2 * half))[0]
        names += [f"bar{i}_a", f"bar{i}_b"]
        ends += [centre - along, centre + along]
        pairs.append((names[-2], names[-1], 2 * half))
    return Target("bar", np.array(names), np.array(names), np.array(ends)), pairs


def trial(
    name: str, points: int, noise: float, kind: str, seed: int, *, scale: float = 0.0, exact: bool = False
) -> Trial:
    """A rig, its calibration, and a verification.

    scale: by which known points are too far apart. exact: the gauge is as its certificate says.
    """
    rig = build_rig(name, seed=seed, lens_error=0.5, noise=noise)
    known = simulate(rig, random_positions(rig, points, np.random.default_rng(seed)), seed=seed)
    if scale:
        known = replace(known, known=replace(known.known, xyz=known.xyz * (1 + scale)))
    target, pairs = shown(rig, kind)
    rng = np.random.default_rng([seed, 5])
    certificate, expansion, temperature = rng.normal(size=3) * (not exact)
    lengths, true = [], []
    for a, b, length in pairs:
        # the marks are at these places: the true length is given, and what it was at 20 degrees follows
        setup = SD_SETUP * rng.normal() * (not exact)
        warmer = TEMPERATURE + SD_TEMPERATURE * temperature - 20
        at_20 = (length - setup) / (1 + (EXPANSION + SD_EXPANSION * expansion) * warmer)
        lengths.append(
            ic.CalibratedLength(
                a, b, at_20 * (1 + SD_SCALE * certificate), sd=SD_SCALE * length, temperature=TEMPERATURE,
                sd_temperature=SD_TEMPERATURE, expansion=EXPANSION, sd_expansion=SD_EXPANSION, sd_setup=SD_SETUP,
            )
            if not exact
            else ic.CalibratedLength(a, b, length, sd=1e-6 * length)
        )  # fmt: skip
        true.append(length)
    calibration = ic.ForwardGP().fit(known)
    views = simulate(rig, target, seed=seed + 1_000_003)
    found = ic.verify(calibration, replace(views, known=None), lengths, next_lengths=0)
    return Trial(found, np.array([one.measured for one in found.lengths]) - np.array(true))


def coverage(trials: int) -> Iterator[str]:
    yield "| rig, known points, artefact | trials | (a) test | (b) predicted | (c) both | (d) | (e) | (f) |"
    yield "|:--|--:|--:|--:|--:|--:|--:|--:|"
    for name, points, noise, kind in CASES:
        rows = []
        for seed in range(trials):
            one = trial(name, points, noise, kind, seed)
            error, sd_test, sd = (
                np.array([getattr(row, what) for row in one.found.lengths])
                for what in ("error", "sd_test", "sd_predicted")
            )
            bars, scale = one.found.bars, one.found.scale
            rows.append(
                [
                    np.mean(np.abs(error - one.true_error) < 2 * sd_test), np.mean(np.abs(one.true_error) < 2 * sd),
                    np.mean(np.abs(error) < 2 * np.hypot(sd, sd_test)), bars.p_value < 0.025, bars.p_value > 0.975,
                    scale.found,
                ]
            )  # fmt: skip
        yield f"| {name}, {points}, {kind} | {trials} | {' | '.join(shares(rows))} |"


def shares(rows) -> list[str]:
    mean, error = np.mean(rows, axis=0), np.std(rows, axis=0, ddof=1) / np.sqrt(len(rows))
    return [f"{100 * m:.1f} ± {100 * e:.1f} %" for m, e in zip(mean, error, strict=True)]


def power(trials: int) -> Iterator[str]:
    yield "| rig, known points, noise | scale error | trials | found | stated | its sd |"
    yield "|:--|--:|--:|--:|--:|--:|"
    for name, points, noise, scale in POWERS:
        rows = []
        for seed in range(trials):
            test = trial(name, points, noise, "gauge", seed + 50_000, scale=scale, exact=True).found.scale
            rows.append([test.found, test.power(scale), test.sd])
        found, stated = shares([row[:2] for row in rows])
        sd = np.mean([row[2] for row in rows])
        yield f"| {name}, {points}, {noise} px | {scale:.0e} | {trials} | {found} | {stated} | {sd:.1e} |"


def decisions(trials: int) -> Iterator[str]:
    yield "| largest true error | trials | conformity proven | non-conformity proven | undecided |"
    yield "|:--|--:|--:|--:|--:|"
    rng, limit, sd = np.random.default_rng(0), 0.1, 0.005
    for what, true in (
        ("4 U inside the limit", limit - 8 * sd),
        ("at the limit", limit),
        ("4 U outside", limit + 8 * sd),
    ):
        found = []
        for _ in range(trials):
            errors = np.concatenate([[true], rng.uniform(-0.5, 0.5, 34) * true]) + sd * rng.normal()
            each = {decide(float(error), limit, 2 * sd) for error in errors}
            whole = next((d for d in ("does not conform", "undecided") if d in each), "conforms")
            found.append([whole == d for d in ("conforms", "does not conform", "undecided")])
        yield f"| {what} | {trials} | {' | '.join(shares(found))} |"


def real(folder: Path) -> Iterator[str]:
    yield "| set, left out | lengths | longest | largest error | rms error | predicted, rms | error bars | scale |"
    yield "|:--|--:|--:|--:|--:|--:|:--|:--|"
    for name, what in REAL:
        data = ic.read_dataset(folder / name)
        rng = np.random.default_rng(0)
        if data.known is None:
            calibration, views, lengths = boards(data, rng)
        else:
            shots = data.known.shots
            out = shots == what if what in shots else np.isin(np.arange(len(data)), rng.permutation(len(data))[::2])
            calibration, views = ic.ForwardGP().fit(data.select(~out)), data.select(out)
            usable = np.flatnonzero(calibration.measure(views.observations).measured)
            pairs = [rng.choice(usable, 2, replace=False) for _ in range(REAL_LENGTHS)]
            pairs = {tuple(sorted(map(int, pair))) for pair in pairs}
            lengths = [
                ic.CalibratedLength(*views.points[[a, b]], float(np.linalg.norm(views.xyz[a] - views.xyz[b])))
                for a, b in sorted(pairs)
            ]
        found = ic.verify(calibration, replace(views, known=None), lengths, next_lengths=0)
        error, sd = (np.array([getattr(one, of) for one in found.measured]) for of in ("error", "sd_predicted"))
        longest, unit = max(one.length.length for one in found.measured), found.length_unit
        low, high = found.scale.interval
        cells = [f"{longest:.4g} {unit}", *(f"{v:.3g} {unit}" for v in (found.worst.error, rms(error), rms(sd)))]
        bars = f"{found.bars.ratio:.2f} ({found.bars.low:.2f} to {found.bars.high:.2f}): {found.bars.verdict}"
        scale = f"{found.scale.value:+.1e} ({low:+.1e} to {high:+.1e})"
        yield f"| {name}, {what} | {len(error)} | {' | '.join(cells)} | {bars} | {scale} |"


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def boards(data, rng):
    """Calibrate from half of the pictures of boards; the lengths are diagonals of the boards in the others."""
    match = [CORNER.fullmatch(str(point)) for point in data.points]
    shot, corner = np.array([m["shot"] for m in match]), np.array([int(m["number"]) for m in match]) - 1
    mine = np.isin(shot, rng.permutation(np.unique(shot))[::2])
    calibration, views = ic.Explicit().fit(data.select(mine)), data.select(~mine)
    flat, measured = corner_positions(data.extra["target"]), calibration.measure(views.observations).measured
    lengths = []
    for one in np.unique(shot[~mine]):
        rows = np.flatnonzero((shot[~mine] == one) & measured)
        if len(rows) > 1:
            apart = np.linalg.norm(flat[corner[~mine][rows], None] - flat[corner[~mine][rows]], axis=2)
            a, b = np.unravel_index(apart.argmax(), apart.shape)  # one length a picture: the longest that was seen
            lengths.append(ic.CalibratedLength(*views.points[rows[[a, b]]], float(apart[a, b])))
    return calibration, views, lengths


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("coverage", "power", "decisions"))
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--real", type=Path, metavar="FOLDER")
    options = parser.parse_args()
    if options.real:
        for row in real(options.real):
            print(row, flush=True)
        return
    for name, table in {"coverage": coverage, "power": power, "decisions": decisions}.items():
        if options.only in (None, name):
            print(f"\n{name}\n", flush=True)
            for row in table(options.trials):
                print(row, flush=True)


if __name__ == "__main__":
    main()
