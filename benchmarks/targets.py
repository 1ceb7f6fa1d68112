"""The same rigs from four targets: a ball on a robot, a board on a slide, a board held by hand, a wand.

    python benchmarks/targets.py [--seeds 2] [-o benchmarks/results/targets.md]

What two minutes give, as a person or a robot works: 35 positions of the ball (a robot that stops at each), 20 of
the board (a slide, a stop each), boards held by hand in 10 pictures by each camera and 4 by each two neighbours, 200
frames of a wand that is 0.6 of the volume's shortest edge. Lens errors of 0.5 px, noise of 0.2 px, 5 % of the views
missing. Then 400 random positions are measured.

*rmse / limit*: over what perfectly known cameras would reach, after the measured positions are laid over the true ones
by a rigid motion, without scale: where the world is, is not asked here. *scale*: by how much distances are wrong, the
scale of that motion if it had one. *in 95 %*: positions in their ellipsoids, in the calibration's own world; of a wand,
laid over its places; a board by hand has a world of its own, and nothing to lay it over. CPU seconds of the fit.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from time import process_time

import numpy as np
from scipy.stats import chi2

import implicam as ic
from implicam.errors import ImplicamError
from implicam.geometry import register
from implicam.simulate import (
    as_boards,
    as_wand,
    build_rig,
    each_and_pairs,
    held_boards,
    moving_board,
    random_positions,
    simulate,
    waved_wand,
)

RIGS = ("stereo", "bar6", "dome8")
TARGETS = ("ball on a robot, 35", "board on a slide, 20", "board by hand", "wand, 200 frames")
HEAD = "| rig | target | rmse / limit | scale, 1e-4 | in 95 % | NEES | CPU s |\n|---|---|---|---|---|---|---|"


def fitted(rig, kind, seed):
    """A calibration from a target, and the true positions of its own points."""
    rng = np.random.default_rng([seed, 7])
    if kind == TARGETS[0]:
        data = simulate(rig, random_positions(rig, 35, rng), seed=seed, missing=0.05)
        return ic.ForwardGP().fit(data), None
    if kind == TARGETS[1]:
        data = simulate(rig, moving_board(rig), seed=seed, missing=0.05)
        return ic.ForwardGP().fit(data), None
    if kind == TARGETS[2]:
        target = held_boards(rig, each_and_pairs(rig, 10, 4), rng)
        data = as_boards(simulate(rig, target, seed=seed, missing=0.05), target)
        return ic.Explicit().fit(data), "anywhere"
    target = waved_wand(rig, 200, rng)
    recorded = simulate(rig, target, seed=seed, missing=0.05)
    calibration = ic.ForwardGP(wand=target.wand).fit(as_wand(recorded, target))
    row = {str(name): i for i, name in enumerate(recorded.points)}
    return calibration, target.xyz[[row[str(name)] for name in calibration.data.points]]


def one(spec, kind, seed):
    """Its numbers; only the reason where there is no calibration."""
    rig = build_rig(spec, seed=seed)
    held = simulate(rig, random_positions(rig, 400, np.random.default_rng([seed, 2])), seed=seed + 1_000_003)
    began = process_time()
    try:
        calibration, true = fitted(rig, kind, seed)
    except ImplicamError as error:
        print(spec, kind, seed, error.what, flush=True)
        return {}
    seconds = process_time() - began
    measured = calibration.measure(held.observations)
    good = measured.measured
    x, truth, cov = measured.xyz[good], held.truth.xyz[good], measured.cov[good]
    laid, _ = register(x, truth)
    error = laid.apply(x) - truth
    own = (x - x.mean(axis=0)) @ laid.rotation.T
    scale = np.sum(own * (truth - truth.mean(axis=0))) / np.sum(own**2) - 1
    anywhere = isinstance(true, str)
    world = None if true is None or anywhere else register(calibration.data.xyz, true)[0]
    off = x - truth if world is None else world.apply(x) - truth
    turn = np.eye(3) if world is None else world.rotation
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(turn @ cov @ turn.T), off)
    limit = np.trace(held.truth.limit[good], axis1=1, axis2=2)
    return {
        "ratio": float(np.sqrt(np.mean(np.sum(error**2, axis=1)) / np.mean(limit))),
        "scale": 1e4 * abs(float(scale)),
        "inside": np.nan if anywhere else float(np.mean(nees < chi2.ppf(0.95, 3))),
        "nees": np.nan if anywhere else float(np.mean(nees)),
        "seconds": seconds,
    }


def main():
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("-o", type=Path)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    lines = [HEAD]
    print(HEAD, flush=True)
    for spec in RIGS:
        for kind in TARGETS:
            found = [row for seed in range(1, given.seeds + 1) if (row := one(spec, kind, seed))]
            if not found:
                lines.append(f"| {spec} | {kind} | no calibration | | | | |")
            else:
                mean = {key: float(np.mean([row[key] for row in found])) for key in found[0]}
                bars = "- | -" if np.isnan(mean["nees"]) else f"{mean['inside']:.3f} | {mean['nees']:.2f}"
                lines.append(
                    f"| {spec} | {kind} | {mean['ratio']:.2f} | {mean['scale']:.2g} | {bars} | {mean['seconds']:.1f} |"
                )
            print(lines[-1], flush=True)
    if given.o is not None:
        given.o.write_text(f"```\n{__doc__.strip()}\n```\n\n" + "\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
