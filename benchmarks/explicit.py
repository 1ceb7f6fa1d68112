"""The classical calibration at its best, beside forward-gp: the tables of docs/choose.md on `explicit`.

    python benchmarks/explicit.py [--rigs 16] [--only points,boards,aligned,hard,photographs] [-o results/explicit.md]

points: the same known points for both; lenses inside the model family, and with errors outside of it (0.5 px rms).
boards: the paper's budgets of checkerboard pictures, simulated corners (0.2 px), 40 known points to align. aligned: the
error bars with few known points, and what they would be if they came from the boards alone. hard: 20
rigs with bad corners (0.5 px noise, lens errors of 1 px, 20 % missing, 5 % wrong). photographs: rendered boards, 5 %
noise and 1.5 px blur, through the detector. *limit*: Cramer-Rao with perfectly known cameras. ± and intervals: over
rigs, 95 %.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from forward import HEAD, held_out, row, run_parts
from implicam.calibrators import Explicit, ForwardGP
from implicam.calibrators.explicit import ExplicitCalibration
from implicam.calibrators.explicit.boards import boards_of
from implicam.calibrators.explicit.camera_groups import CameraGroups, calibrate_groups
from implicam.calibrators.explicit.from_boards import fit_to_boards
from implicam.calibrators.explicit.settings import ExplicitSettings
from implicam.coverage import tercile_labels
from implicam.dataset import Dataset, Observations
from implicam.detect.board import Board
from implicam.detect.model import View
from implicam.errors import ImplicamError
from implicam.geometry import depth_of_points
from implicam.progress import silent
from implicam.simulate import (
    Optics,
    Studio,
    as_boards,
    build_rig,
    each_and_pairs,
    held_boards,
    random_positions,
    simulate,
    simulate_boards,
)
from implicam.threads import blas_threads

RIGS = {"stereo": ("stereo", None), "6 cameras": ("bar6", None), "dome8": ("dome8", None)}
BUDGETS = ((50, 10), (25, 6), (10, 4))
KNOWN = 40
"""Points that bring a calibration from boards into the world."""
FEW, DRAWS = (8, 40), 4
"""The same where they are few, and how many draws of them on each rig."""


def outcome(make, known, others, seed):
    """As forward.outcome, of any calibrator; a sentence where it fails."""
    try:
        with blas_threads(1):
            m = make.fit(known).measure(others.observations)
    except ImplicamError as error:
        return str(error).replace("\n", " ")
    depth = tercile_labels(depth_of_points(others.truth.xyz, others.observations.uv))
    views = others.observations.seen.sum(axis=1)
    lost = int((~m.measured & (views >= 2)).sum())
    return m.xyz - others.truth.xyz, m.cov, others.truth.limit, np.full(len(m), str(seed)), depth, views, lost


def known_points(rig, n, seed, **options):
    return simulate(rig, random_positions(rig, n, np.random.default_rng(seed + 100)), seed=seed + 200, **options)


def from_points(job):
    name, n, lens_error, method, seed = job
    spec, cameras = RIGS[name]
    rig = build_rig(spec, seed=seed, frame="random", cameras=cameras, lens_error=lens_error)
    make = Explicit() if method == "explicit" else ForwardGP()
    return outcome(make, known_points(rig, n, seed), held_out(rig, seed), seed)


def points(pool, rigs):
    """From the same known points."""
    yield HEAD.format("rig, known points, lens error, method")
    for lens_error in (0.0, 0.5):
        for name in RIGS:
            for n in (17, 35, 157):
                for method in ("explicit", "forward-gp"):
                    jobs = [(name, n, lens_error, method, seed) for seed in range(rigs)]
                    yield row(f"{name}, {n}, {lens_error:g} px, {method}", list(pool.map(from_points, jobs)))


def from_boards(job):
    cameras, (each, pairs), lens_error, align, seed = job
    rig = build_rig("bar6", seed=seed, frame="random", cameras=cameras, lens_error=lens_error)
    shown = simulate_boards(rig, each_and_pairs(rig, each, pairs), seed=seed)
    return outcome(Explicit(boards=shown, align=align), known_points(rig, KNOWN, seed), held_out(rig, seed), seed)


def boards(pool, rigs):
    """From the paper's budgets of checkerboard pictures: each camera + each pair."""
    yield HEAD.format("cameras, pictures, lens error")
    for lens_error in (0.0, 0.5):
        for cameras in ("2R", "2R2W", "2R4W"):
            for each, pairs in BUDGETS:
                jobs = [(cameras, (each, pairs), lens_error, "points", seed) for seed in range(rigs)]
                yield row(f"{cameras}, {each} + {pairs}, {lens_error:g} px", list(pool.map(from_boards, jobs)))
    jobs = [("2R4W", (25, 6), 0.0, "icp", seed) for seed in range(rigs)]
    yield row("2R4W, 25 + 6, 0 px, aligned by icp", list(pool.map(from_boards, jobs)))


def few_aligned(job):
    """For each number of known points, and error bars from the boards alone or not, the outcome of all draws."""
    cameras, (each, pairs), lens_error, seed = job
    rig = build_rig("bar6", seed=seed, cameras=cameras, lens_error=lens_error)
    shown = simulate_boards(rig, each_and_pairs(rig, each, pairs), seed=seed)
    others, found = held_out(rig, seed), {}
    with blas_threads(1):
        groups = calibrate_groups(boards_of(shown), "auto")
        for alone in (True, False):
            settings = ExplicitSettings(error_ratio_prior_log_sd=1e-6) if alone else ExplicitSettings()
            own = [replace(g, bundle=replace(g.bundle, settings=settings)) for g in groups.groups]
            make = AlreadyAdjusted(replace(groups, groups=tuple(own)), shown, settings)
            for n in FEW:
                of_draws = [outcome(make, known_points(rig, n, 1000 * seed + k), others, seed) for k in range(DRAWS)]
                columns = zip(*(one for one in of_draws if not isinstance(one, str)), strict=True)
                found[n, alone] = tuple(sum(c) if isinstance(c[0], int) else np.concatenate(c) for c in columns)
    return found


class AlreadyAdjusted(NamedTuple):
    """explicit from boards that are adjusted already."""

    groups: CameraGroups
    shown: Dataset
    settings: ExplicitSettings

    def fit(self, known):
        """Align it to known points."""
        fitted = fit_to_boards(known, self.groups, self.shown, "points", silent)
        return ExplicitCalibration(Explicit(boards=self.shown, settings=self.settings), known, fitted)


def aligned(pool, rigs):
    """Few known points to align with, four draws of them on each rig."""
    yield HEAD.format("cameras, pictures, lens error, known points, error bars")
    for cameras, budget, lens_error in (("2R", (10, 4), 0.0), ("2R", (10, 4), 0.5), ("2R", (50, 10), 0.5)):
        jobs = [(cameras, budget, lens_error, seed) for seed in range(rigs)]
        outcomes = list(pool.map(few_aligned, jobs))
        for n in FEW:
            for alone in (True, False):
                bars = "from the boards alone" if alone else "from the known points, too"
                label = f"{cameras}, {budget[0]} + {budget[1]}, {lens_error:g} px, {n}, {bars}"
                yield row(label, [one[n, alone] for one in outcomes])


def badly(job):
    each, pairs, seed = job
    rig = build_rig("bar6", seed=seed, frame="random", lens_error=1.0, noise=0.5)
    shown = simulate_boards(rig, each_and_pairs(rig, each, pairs), seed=seed, missing=0.2, outliers=0.05)
    return outcome(Explicit(boards=shown), known_points(rig, KNOWN, seed, outliers=0.05), held_out(rig, seed), seed)


def hard(pool, rigs):
    """Bad corners of six cameras, four of them wide: does it diverge?"""
    yield from _rig_by_rig(pool, badly, [(10, 4, seed) for seed in range(20)], "10 + 4 boards")
    yield from _rig_by_rig(pool, badly, [(6, 3, seed) for seed in range(20)], "6 + 3 boards")


def photographed(seed):
    """Rendered photographs through the detector."""
    rig = build_rig("bar6", seed=seed, frame="random", lens_error=0.5)
    target = held_boards(rig, each_and_pairs(rig, 6, 3), np.random.default_rng([seed, 9]))
    studio = Studio(rig, target, Optics(noise=0.05, blur=1.5), seed, 0.0)
    shown = as_boards(simulate(rig, target, seed=seed), target)
    uv = np.full(shown.observations.uv.shape, np.nan)
    sd = np.full(uv.shape, np.nan)
    number = {str(point): i for i, point in enumerate(shown.points)}
    detector = Board(*target.board)
    for c, s in studio.jobs:
        found = detector.detect(studio.picture(c, s), View(rig.cameras[c].name, studio.shots[s]))
        rows = [number[point] for point in found.points]
        uv[rows, c], sd[rows, c] = found.uv, found.sd
    seen = Observations(shown.points, shown.observations.cameras, uv, sd)
    known = known_points(rig, KNOWN, seed)
    return outcome(Explicit(boards=replace(shown, observations=seen)), known, held_out(rig, seed), seed)


def photographs(pool, rigs):
    """Bad photographs (5 % noise, 1.5 px blur) of 6 + 3 boards, six cameras: does it diverge?"""
    yield from _rig_by_rig(pool, photographed, list(range(20)), "6 + 3 photographed boards")


def _rig_by_rig(pool, work, jobs, label):
    outcomes = list(pool.map(work, jobs))
    yield HEAD.format(f"{len(jobs)} rigs")
    yield row(label, outcomes)
    ratios = sorted(_ratio(o) for o in outcomes if not isinstance(o, str))
    yield ""
    yield f"rmse / limit of each: {' '.join(f'{ratio:.2f}' for ratio in ratios)}"
    for seed, found in enumerate(outcomes):
        if isinstance(found, str):
            yield f"rig {seed}: {found}"
    yield ""


def _ratio(found):
    errors, _, limit = found[:3]
    ok = np.isfinite(errors[:, 0])
    return np.sqrt(np.sum(errors[ok] ** 2) / np.nansum(np.trace(limit[ok], axis1=1, axis2=2)))


PARTS = {"points": points, "boards": boards, "aligned": aligned, "hard": hard, "photographs": photographs}


if __name__ == "__main__":
    run_parts("explicit", "explicit", PARTS, __doc__, 16)
