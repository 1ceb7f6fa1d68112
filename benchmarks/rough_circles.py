"""Is a place inside of the rough circle that is shown for it, after four to seven known points?

    python benchmarks/rough_circles.py [--rigs 16] [--kinds bar6,wide,mirror] [--real ../shared/real] [--wrong]

Of each rig the places that a session begins with, in its order; four cameras at most. Kinds are those of
benchmarks/odd_rigs.py, and the rigs with names. Shown: of all views, for how many there is a circle. Inside: of those
shown, in how many the place is seen; at least 95 % are wanted. Radius and distance: medians, in parts of the longer
side. --real: the targets of others, 20 draws of each camera, spread over the target. --wrong: one of the views is
anywhere in the picture.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import odd_rigs
from implicam.active import Loop, Workspace
from implicam.calibrators import ForwardGP
from implicam.dataset import read_dataset
from implicam.rig_model.rough import rough_views
from implicam.simulate import build_rig, random_positions, simulate

NAMED = ("bar6", "stereo", "dome8", "grid9")
REAL = ("rbc300", "water-tank-target", "two-sided-tank", "multiplane", "image-splitter")
MOST_CAMERAS, DRAWS = 4, 20


def one_view(known, uv, size, place, true, wrong=None):
    """Points, whether shown, whether inside, radius, distance, seconds of CPU."""
    if wrong is not None:
        uv = uv.copy()
        uv[wrong.integers(len(uv))] = wrong.uniform(0, 1, 2) * size
    begun = time.thread_time()
    found = rough_views(known, uv, size, place[None])
    spent = time.thread_time() - begun
    off = np.linalg.norm(found.uv[0] - true)
    shown = bool(np.isfinite(off))
    return len(known), shown, shown and off <= found.radius[0], found.radius[0] / max(size), off / max(size), spent


def simulated(kind, seed, wrong):
    """The views of one rig; those that a camera misses are left out."""
    rig = build_rig(kind, seed=seed) if kind in NAMED else odd_rigs.draw(kind, seed).rig
    rig = replace(rig, cameras=rig.cameras[:MOST_CAMERAS])
    loop = Loop(ForwardGP(), Workspace.from_box(rig.volume), judged=8, seed=seed)
    xyz = np.array([target.xyz for target in loop.ask(8)])
    target = replace(random_positions(rig, 8, np.random.default_rng(seed)), xyz=xyz)
    uv = simulate(rig, target, seed=seed).observations.uv
    for c, camera in enumerate(rig.cameras):
        for n in range(4, 8):
            if np.isfinite(uv[:n, c]).all(axis=1).sum() >= 4 and np.isfinite(uv[n, c]).all():
                yield one_view(xyz[:n], uv[:n, c], (camera.width, camera.height), xyz[n], uv[n, c], wrong)


def recorded(folder, wrong):
    """The views of a target that somebody else photographed."""
    data, rng = read_dataset(folder), np.random.default_rng(0)
    for c, camera in enumerate(data.cameras):
        seen = data.observations.seen[:, c]
        xyz, uv = data.xyz[seen], data.observations.uv[seen, c]
        for _ in range(DRAWS):
            some = rng.permutation(len(xyz))[:60]
            rows = [some[0]]
            while len(rows) < 8:
                far = np.min([np.linalg.norm(xyz[some] - xyz[row], axis=1) for row in rows], axis=0)
                rows.append(some[np.argmax(far)])
            rows = rng.permutation(rows)
            for n in range(4, 8):
                yield one_view(
                    xyz[rows[:n]], uv[rows[:n]], (camera.width, camera.height), xyz[rows[n]], uv[rows[n]], wrong
                )


def show(name, views):
    """One row for each number of points."""
    for n in range(4, 8):
        found = np.array([view[1:] for view in views if view[0] == n], dtype=float).reshape(-1, 5)
        shown = found[found[:, 0] > 0]
        inside = f"{100 * shown[:, 1].mean():.1f} %" if len(shown) else "-"
        radius, off = np.median(shown[:, 2:4], axis=0) if len(shown) else (np.nan, np.nan)
        print(f"{name:18} {n} {len(found):6} {100 * found[:, 0].mean():6.0f} % {inside:>8} {radius:8.3f} {off:8.4f} "
              f"{1000 * found[:, 4].mean():6.0f}", flush=True)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=16)
    parser.add_argument("--kinds", default=",".join((*NAMED, *odd_rigs.RANGES)))
    parser.add_argument("--real", type=Path)
    parser.add_argument("--wrong", action="store_true")
    options = parser.parse_args()
    wrong = np.random.default_rng(5) if options.wrong else None
    print(f"{'':18} n  views    shown   inside   radius distance  ms CPU")
    every = []
    for kind in filter(None, options.kinds.split(",")):
        views = [view for seed in range(options.rigs) for view in simulated(kind, seed, wrong)]
        show(kind, views)
        every += views
    for name in REAL if options.real is not None else ():
        views = list(recorded(options.real / name, wrong))
        show(name, views)
        every += views
    show("all", every)


if __name__ == "__main__":
    main()
