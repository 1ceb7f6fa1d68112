"""A wand waved before cameras of all kinds: how many rigs are fitted right, refused, or silently wrong.

    python benchmarks/odd_wands.py [--rigs 3] [--kinds tilt,mirror] [--seed0 0] [-o benchmarks/results/odd_wands.md]

The rigs are those of `odd_rigs.draw`: each from (kind, seed), with another noise, lens error and number of cameras. The
wand is 0.6 of the volume's shortest edge (0.6 of the second shortest in a thin slab), 200 frames, 5 % of the views
wrong and 15 % missing; nothing is given but its length. Then 300 random positions are measured, and laid over the true
ones without any change of scale; where all cameras are mirrored, so is the world, and that is allowed for.

*right*: rmse at most twice what perfect cameras would reach, and NEES below 8. *refused*: an error, or the verdict "not
usable"; *doubtful* is said too. *silently wrong*: none of these. *cameras*: calibrated, of all that there are.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from time import process_time

import numpy as np
from scipy.stats import chi2

import implicam as ic
import odd_rigs  # beside this file
from implicam.errors import ImplicamError
from implicam.geometry import register
from implicam.simulate import as_wand, random_positions, simulate, waved_wand

KINDS = ("ordinary", "aspect", "crop", "tilt", "mirror", "telephoto", "wide", "thin-slab", "window", "mixed")
HEAD = (
    "| kind | rigs | right | doubtful | refused | silently wrong | cameras | rmse / limit | in 95 % | NEES | CPU s |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|"
)
NEW_POINTS = 300


def one(kind: str, seed: int, frames: int, verbose: bool) -> dict[str, object]:
    """How a rig comes out."""
    odd = odd_rigs.draw(kind, seed)
    rig = odd.rig
    size = np.sort(rig.volume.size)
    length = 0.6 * float(size[1] if kind == "thin-slab" else size[0])
    target = waved_wand(rig, frames, np.random.default_rng([seed, 11]), length=length)
    recorded = simulate(rig, target, seed=seed, outliers=0.05, missing=0.15)
    held = simulate(rig, random_positions(rig, NEW_POINTS, np.random.default_rng([seed, 2])), seed=seed + 1_000_003)
    row: dict[str, object] = {"kind": kind, "seed": seed, "of": len(rig.cameras), "cameras": 0}
    began = process_time()
    try:
        calibration = ic.ForwardGP(wand=target.wand).fit(as_wand(recorded, target))
        row["seconds"] = process_time() - began
        verdict = odd_rigs.verdict_of(calibration)
        row["verdict"] = verdict
    except ImplicamError as error:
        row |= {"seconds": process_time() - began, "outcome": "refused", "why": error.what}
        if verbose:
            print(kind, seed, odd.about, "REFUSED", error.what, error.why, flush=True)
        return row
    names = {str(name): i for i, name in enumerate(recorded.points)}
    rows = np.array([names[str(name)] for name in calibration.data.points])
    measured = calibration.measure(held.observations)
    good = measured.measured
    best = None
    for flip in (np.eye(3), np.diag([1.0, 1.0, -1.0])):
        to_truth, _ = register(calibration.data.xyz @ flip, target.xyz[rows])
        turn = to_truth.rotation @ flip
        error = to_truth.apply(measured.xyz[good] @ flip) - held.truth.xyz[good]
        cov = turn @ measured.cov[good] @ turn.T
        rms = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
        if best is None or rms < best[0]:
            best = rms, error, cov
    _, error, cov = best
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    limit = np.trace(held.truth.limit[good], axis1=1, axis2=2)
    # the median of the squares is not that of one lost point
    row["ratio"] = float(np.sqrt(np.mean(np.sum(error**2, axis=1)) / np.mean(limit)))
    row["inside"], row["nees"] = float(np.mean(nees < chi2.ppf(0.95, 3))), float(np.mean(nees))
    row["cameras"] = len(calibration.camera_names) - len(calibration.fitted.uncalibrated)
    wrong = row["ratio"] > 2 or row["nees"] > 8
    row["outcome"] = (
        "refused" if verdict == "not usable" else "doubtful" if verdict == "doubtful" else "wrong" if wrong else "right"
    )
    if verbose:
        print(
            kind,
            seed,
            odd.about,
            {k: (round(v, 3) if isinstance(v, float) else v) for k, v in row.items()},
            [str(u) for u in calibration.fitted.uncalibrated][:3],
            flush=True,
        )
    return row


def table(rows: list[dict[str, object]]) -> list[str]:
    """A line per kind."""
    lines = [HEAD]
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == kind]
        count = {o: sum(row["outcome"] == o for row in own) for o in ("right", "doubtful", "refused", "wrong")}
        done = [row for row in own if "ratio" in row]
        mean = {key: np.mean([row[key] for row in done]) if done else np.nan for key in ("ratio", "inside", "nees")}
        cameras = f"{sum(row['cameras'] for row in own)} of {sum(row['of'] for row in own)}"
        seconds = np.median([row["seconds"] for row in own])
        lines.append(
            f"| {kind} | {len(own)} | {count['right']} | {count['doubtful']} | {count['refused']} | {count['wrong']} | "
            f"{cameras} | {mean['ratio']:.3g} | {mean['inside']:.3f} | {mean['nees']:.3g} | {seconds:.1f} |"
        )
    return lines


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=3)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--seed0", type=int, default=0)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("-v", action="store_true")
    parser.add_argument("-o", type=Path)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = [
        one(kind, seed, given.frames, given.v)
        for kind in given.kinds.split(",")
        for seed in range(given.seed0, given.seed0 + given.rigs)
    ]
    text = "\n".join(table(rows))
    print(text)
    if given.o is not None:
        given.o.write_text(f"```\n{__doc__.strip()}\n```\n\n{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
