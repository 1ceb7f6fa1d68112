"""forward-gp on simulated rigs against the physical limit: the table of docs/choose.md.

    python benchmarks/forward.py [--rigs 12] [--only few,boards,...] [-o benchmarks/results/forward.md]

Every row pools `--rigs` rigs (seeds 0, 1, ...), each with its own lenses, lens errors of 0.5 px rms that no model
contains, 0.2 px noise, random positions and an arbitrary world frame, and 400 held-out random positions. *limit* is the
Cramer-Rao bound with perfectly known cameras. ± and intervals: 95 %, over rigs. Right values: coverage 0.95, NEES 3.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from implicam.calibrators import ForwardGP, InverseGP
from implicam.coverage import assess, tercile_labels
from implicam.dataset import Observations
from implicam.errors import ImplicamError
from implicam.files import write_text
from implicam.geometry import depth_of_points
from implicam.simulate import build_rig, moving_board, random_positions, simulate
from implicam.threads import blas_threads

RIGS = {
    "stereo": ("stereo", None),
    "4 cameras": ("bar6", "2R2W"),
    "6 cameras": ("bar6", None),
    "dome8": ("dome8", None),
}
HELD_OUT = 400
METHODS = {"forward-gp": ForwardGP(), "forward-gp:none": ForwardGP(lens="none"), "inverse-gp": InverseGP()}


def held_out(rig, seed, missing=0.0):
    return simulate(
        rig, random_positions(rig, HELD_OUT, np.random.default_rng(seed + 300)), seed=seed + 400, missing=missing
    )


def measured(method, known, others):
    """Errors (m, 3), covariances and limits of the held-out points measured, and the calibration."""
    calibration = METHODS[method].fit(known)
    m = calibration.measure(others.observations)
    return m, calibration


def ball(job):
    name, n, method, options, seed = job
    spec, cameras = RIGS[name]
    rig = build_rig(spec, seed=seed, frame="random", cameras=cameras)
    missing, unstated = options.get("missing", 0.0), options.get("unstated", False)
    known = simulate(
        rig,
        random_positions(rig, n, np.random.default_rng(seed + 100)),
        seed=seed + 200,
        missing=missing,
        outliers=options.get("outliers", 0.0),
        robot_noise=options.get("robot_noise", 0.0),
    )
    others = held_out(rig, seed, missing)
    if unstated:
        known, others = without_sd(known), without_sd(others)
    return outcome(method, known, others, seed)


def board(job):
    cameras, seed, method = job
    rig = build_rig("bar6", seed=seed, frame="random", cameras=cameras)
    all_boards = simulate(rig, moving_board(rig), seed=seed + 200)
    ends = np.isin(all_boards.shots, [all_boards.shots[0], all_boards.shots[-1]])
    others = all_boards.select(~ends)
    return outcome(method, all_boards.select(ends), others.select(np.arange(0, len(others), 4)), seed)


def outcome(method, known, others, seed):
    try:
        with blas_threads(1):
            m, _ = measured(method, known, others)
    except ImplicamError as error:
        return str(error).splitlines()[0]
    depth = tercile_labels(depth_of_points(others.truth.xyz, others.observations.uv))
    views = others.observations.seen.sum(axis=1)
    lost = int((~m.measured & (views >= 2)).sum())
    return m.xyz - others.truth.xyz, m.cov, others.truth.limit, np.full(len(m), str(seed)), depth, views, lost


def without_sd(data):
    o = data.observations
    return replace(data, observations=Observations(o.points, o.cameras, o.uv, np.full(o.uv.shape, np.nan)))


def pooled(outcomes):
    good = [o for o in outcomes if not isinstance(o, str)]
    if not good:
        return None, 0, outcomes[0]
    errors, cov, limit, rig, depth, views = (np.concatenate([o[k] for o in good]) for k in range(6))
    regions = {"depth": depth, "views": views.astype(str)}
    coverage = assess(errors, cov, clusters=rig, regions=regions, limit=limit)
    ratios = []
    for o in good:
        ok = np.isfinite(o[0][:, 0])
        ratios.append(np.sqrt(np.sum(o[0][ok] ** 2) / np.nansum(np.trace(o[2][ok], axis1=1, axis2=2))))
    spread = 1.96 * np.std(ratios, ddof=1) / np.sqrt(len(ratios)) if len(ratios) > 1 else np.nan
    failures = len(outcomes) - len(good)
    return coverage, spread, f"{sum(o[6] for o in good)} lost" + f", {failures} fits failed" * bool(failures)


def row(label, outcomes):
    coverage, spread, lost = pooled(outcomes)
    if coverage is None:
        return f"| {label} | {lost} | | | | |"
    s = coverage.overall
    level = s.level(0.95)
    regions = [r.level(0.95).pooled.value for r in coverage.rows[1:] if r.n >= 100]
    worst = f"{min(regions):.3f} - {max(regions):.3f}" if regions else ""
    return (
        f"| {label} | {s.rmse_over_limit:.3f} ± {spread:.3f} | {interval(level.pooled, 3)} | "
        f"{interval(level.ellipsoid, 3)} | {interval(s.nees, 2)} | {worst} |" + (f" {lost}" if s.unmeasured else "")
    )


def interval(estimate, digits):
    return f"{estimate.value:.{digits}f} ({estimate.low:.{digits}f} - {estimate.high:.{digits}f})"


HEAD = (
    "| {} | rmse / limit | 95 % coverage per axis | of the ellipsoid | NEES | regions: lowest - highest coverage |\n"
    "|---|---|---|---|---|---|"
)


def few(pool, rigs):
    """12 to 157 known points."""
    yield HEAD.format("rig, known points, method")
    for name in RIGS:
        for n in (12, 17, 35, 157):
            for method in ("forward-gp", "inverse-gp"):
                if method == "inverse-gp" and n < 35:
                    continue
                jobs = [(name, n, method, {}, seed) for seed in range(rigs)]
                yield row(f"{name}, {n}, {method}", list(pool.map(ball, jobs)))


def hard(pool, rigs):
    """Missing views, wrong detections, robot noise, noise not stated."""
    cases = [
        ("30 % of the views missing", 35, {"missing": 0.3}),
        ("30 % of the views missing", 157, {"missing": 0.3}),
        ("10 % wrong detections", 35, {"outliers": 0.1}),
        ("20 % wrong detections", 35, {"outliers": 0.2}),
        ("robot noise 0.1 mm, declared", 35, {"robot_noise": 0.1}),
        ("pixel noise not stated", 12, {"unstated": True}),
        ("pixel noise not stated", 17, {"unstated": True}),
    ]
    yield HEAD.format("rig, known points, what is hard")
    for what, n, options in cases:
        for name in RIGS:
            jobs = [(name, n, "forward-gp", options, seed) for seed in range(rigs)]
            yield row(f"{name}, {n}, {what}", list(pool.map(ball, jobs)))


def boards(pool, rigs):
    """The moving board: trained on the first and the last of 20 positions, judged on the 18 between."""
    yield HEAD.format("cameras, method")
    for cameras in ("2R", "2R2W", "2R4W"):
        for method in ("forward-gp", "inverse-gp"):
            jobs = [(cameras, seed, method) for seed in range(rigs)]
            yield row(f"{cameras}, {method}", list(pool.map(board, jobs)))


def implicit(pool, rigs):
    """Without any lens model."""
    yield HEAD.format("rig, known points, method")
    for name in RIGS:
        for n in (35, 157, 500):
            jobs = [(name, n, "forward-gp:none", {}, seed) for seed in range(min(rigs, 6))]
            yield row(f"{name}, {n}, forward-gp:none", list(pool.map(ball, jobs)))


def recalibrated(job):
    n, repeat = job
    rig = build_rig("bar6", seed=1, frame="random", cameras="2R2W")
    known = simulate(rig, random_positions(rig, n, np.random.default_rng(7)), seed=1000 + repeat)
    others = simulate(rig, random_positions(rig, 200, np.random.default_rng(8)), seed=5000 + repeat)
    complete = others.observations.seen.all(axis=1)  # the same points each time
    with blas_threads(1):
        m, _ = measured("forward-gp", known, others)
    return m.xyz - others.truth.xyz, m.cov, complete


def recalibrations(pool, rigs):
    """One rig of four cameras calibrated 100 times: the scatter of 200 positions against the predicted covariance."""
    del rigs
    yield "| known points | scatter / predicted variance along the predicted axes 1, 2, 3 | angle of the longest axis |"
    yield "|---|---|---|"
    for n in (35, 157):
        runs = list(pool.map(recalibrated, [(n, k) for k in range(100)]))
        errors, cov = np.array([r[0] for r in runs]), np.array([r[1] for r in runs])
        good = np.isfinite(errors).all(axis=(0, 2)) & runs[0][2]
        errors, predicted = errors[:, good], cov[:, good].mean(axis=0)
        centred = errors - errors.mean(axis=0)
        scatter = np.einsum("kni,knj->nij", centred, centred) / (len(runs) - 1)
        values, axes = np.linalg.eigh(predicted)
        along = np.einsum("nia,nij,nja->na", axes, scatter, axes) / values
        own = np.linalg.eigh(scatter)[1][:, :, -1]
        cosine = np.abs(np.einsum("ni,ni->n", own, axes[:, :, -1]))
        angle = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
        ratios = " / ".join(f"{x:.3f}" for x in along.mean(axis=0)[::-1])
        yield f"| {n} | {ratios} | median {np.median(angle):.1f}°, 90 % below {np.quantile(angle, 0.9):.1f}° |"


PARTS = {"few": few, "hard": hard, "boards": boards, "implicit": implicit, "recalibrations": recalibrations}


def run_parts(name, what, parts, doc, rigs):
    """Parse the options, run the parts, print them and write them down."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=rigs)
    parser.add_argument("--only", default=",".join(parts))
    parser.add_argument("-o", "--output", type=Path)
    args = parser.parse_args()
    only = f" --only {args.only}" * (args.only != ",".join(parts))
    lines = [f"{what} on simulated rigs: `python benchmarks/{name}.py --rigs {args.rigs}{only}`", ""]
    started = time.perf_counter()
    with ProcessPoolExecutor() as pool:
        for part in args.only.split(","):
            lines += [parts[part].__doc__, ""]
            print(f"\n{parts[part].__doc__}\n", flush=True)
            for line in parts[part](pool, args.rigs):
                print(line, flush=True)
                lines += line.splitlines() or [""]
            lines.append("")
    lines.append(f"{time.perf_counter() - started:.0f} s.")
    if args.output:
        write_text(args.output, "\n".join(lines) + "\n")


if __name__ == "__main__":
    run_parts("forward", "forward-gp", PARTS, __doc__, 12)
