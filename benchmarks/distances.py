"""Whether intervals of distances are true, and how wrong adding the two covariances would have been.

    python benchmarks/distances.py                          20 rigs each
    python benchmarks/distances.py --only again --rigs 1    one rig, calibrated again and again

rigs: simulated rigs (lens errors of 0.5 px, 0.2 px noise), known points at random; 60 pairs of random positions each at
20 mm from each other, at a third of the workspace, and across all of it. Share of true distances in their 95 %
intervals, and rms of error over stated sd (1 is right), ± standard errors over the rigs; and the same if the two
covariances had been added.

again: the same rig, known points and pairs, with new noise in all pixels each time: standard deviation of the distances
found over the one stated.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np

import implicam as ic
from implicam.derived import distances
from implicam.simulate import Target, build_rig, random_positions, simulate

PAIRS, NEAR_MM = 60, 20.0
WHERE = ("20 mm", "a third", "across")
CASES = (
    ("stereo", 17, "forward-gp"), ("stereo", 157, "forward-gp"), ("bar6", 35, "forward-gp"),
    ("bar6", 157, "forward-gp"), ("dome8", 35, "forward-gp"), ("bar6", 35, "explicit"), ("bar6", 157, "inverse-gp"),
)  # fmt: skip


def pairs_of(rig, rng) -> dict[str, np.ndarray]:
    """(2 * PAIRS, 3) positions in the workspace, the two of each pair one after the other."""
    xyz = random_positions(rig, 40_000, rng).xyz
    a, b = xyz[0::2], xyz[1::2]
    apart = np.linalg.norm(b - a, axis=1)
    extent = float(np.linalg.norm(np.ptp(xyz, axis=0)))
    near = a + NEAR_MM * (b - a) / apart[:, None]
    chosen = {
        "20 mm": (a, near, np.ones(len(a), dtype=bool)),
        "a third": (a, b, np.abs(apart / extent - 0.33) < 0.05),
        "across": (a, b, apart > 0.6 * extent),
    }
    return {
        name: np.stack([p[good][:PAIRS], q[good][:PAIRS]], axis=1).reshape(-1, 3)
        for name, (p, q, good) in chosen.items()
    }


def observed(rig, xyz, seed):
    names = np.array([f"p{i:04d}" for i in range(len(xyz))])
    return simulate(rig, Target("pairs", names, names, xyz), seed=seed)


def judged(measured, true) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of distances, their sds, and the sds if covariances were added; of the pairs that were measured."""
    good = measured.measured.reshape(-1, 2).all(axis=1)
    rows = [(2 * int(i), 2 * int(i) + 1) for i in np.flatnonzero(good)]
    found = distances(measured, rows)
    right = np.linalg.norm(true[0::2] - true[1::2], axis=1)[good]
    step = (measured.xyz[1::2] - measured.xyz[0::2])[good]
    along = step / np.linalg.norm(step, axis=1)[:, None]
    added = np.einsum("ni,nij,nj->n", along, (measured.cov[1::2] + measured.cov[0::2])[good], along)
    return np.array([one.value for one in found]) - right, np.array([one.sd for one in found]), np.sqrt(added)


def rigs(count: int) -> Iterator[str]:
    yield "| rig, known points, method | pairs | in 95 % | error / sd, rms | covariances added: in 95 % | error / sd |"
    yield "| :-- | :-- | --: | --: | --: | --: |"
    for name, points, method in CASES:
        rows: dict[str, list[list[float]]] = {where: [] for where in WHERE}
        for seed in range(count):
            rig, rng = build_rig(name, seed=seed, lens_error=0.5), np.random.default_rng(seed)
            known = simulate(rig, random_positions(rig, points, rng), seed=seed)
            calibration = ic.calibrator(method).fit(known)
            for where, xyz in pairs_of(rig, rng).items():
                new = observed(rig, xyz, seed + 1000)
                error, sd, added = judged(calibration.measure(new.observations), new.truth.xyz)
                row = [f(error / s) for s in (sd, added) for f in (share, rms)]
                rows[where].append(row)
        for where, found in rows.items():
            mean, se = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(count)
            cells = [f"{100 * mean[0]:.1f} ± {100 * se[0]:.1f} %", f"{mean[1]:.3f} ± {se[1]:.3f}"]
            cells += [f"{100 * mean[2]:.1f} ± {100 * se[2]:.1f} %", f"{mean[3]:.3f} ± {se[3]:.3f}"]
            yield f"| {name}, {points}, {method} | {where} | {' | '.join(cells)} |"


def share(z: np.ndarray) -> float:
    return float(np.mean(np.abs(z) < 1.96))


def rms(z: np.ndarray) -> float:
    return float(np.sqrt(np.mean(z**2)))


def again(count: int, times: int = 1000) -> Iterator[str]:
    yield f"| rig | pairs | sd of {times} recalibrations over stated, mean (lowest - highest of ten pairs) |"
    yield "| :-- | :-- | --: |"
    for seed in range(count):
        rig, rng = build_rig("stereo", seed=seed, lens_error=0.0), np.random.default_rng(seed)
        target, pairs = random_positions(rig, 35, rng), pairs_of(rig, rng)
        pairs = {where: xyz[:20] for where, xyz in pairs.items()}
        found: dict[str, list[list[float]]] = {where: [] for where in WHERE}
        stated: dict[str, list[list[float]]] = {where: [] for where in WHERE}
        for repeat in range(times):
            calibration = ic.ForwardGP().fit(simulate(rig, target, seed=10_000 * seed + repeat))
            for where, xyz in pairs.items():
                measured = calibration.measure(observed(rig, xyz, 5_000_000 + 10_000 * seed + repeat).observations)
                some = distances(measured, [(2 * i, 2 * i + 1) for i in range(len(xyz) // 2)])
                found[where].append([one.value for one in some])
                stated[where].append([one.sd for one in some])
        for where in WHERE:
            ratio = np.std(found[where], axis=0, ddof=1) / np.sqrt(np.mean(np.square(stated[where]), axis=0))
            yield f"| stereo, seed {seed}, 35 | {where} | {ratio.mean():.3f} ({ratio.min():.3f} - {ratio.max():.3f}) |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("rigs", "again"), default="rigs")
    parser.add_argument("--rigs", type=int, default=20)
    parser.add_argument("--times", type=int, default=1000)
    options = parser.parse_args()
    for row in rigs(options.rigs) if options.only == "rigs" else again(options.rigs, options.times):
        print(row, flush=True)


if __name__ == "__main__":
    main()
