"""Experiment 1, the ball in a grid: errors and uncertainties by method, set of cameras and number of points.

Each learner is trained on random shares of the lattice and judged at the rest, as in the paper, and at random positions
off the lattice; then the same with random positions to train on. `LINES` learn their cameras from pictures of a board,
and their points are aligned to the lattice by iterative closest point, as in the paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.special import chdtri

from implicam.calibrators import Calibration, calibrator_from_name
from implicam.calibrators.explicit import Explicit, ExplicitCalibration, rig_of
from implicam.calibrators.explicit.align import ICP
from implicam.compare import Split, fit_each, judge
from implicam.dataset import Dataset
from implicam.errors import DatasetError, ImplicamError
from implicam.experiments.cells import Cell
from implicam.experiments.plan import EXPLICIT, FORWARD, GP, LEARNERS, LINES, NETWORK, PAPER, Plan, slug
from implicam.experiments.source import BALL, BOARDS, BUDGETS, CHECK, RANDOM, Source, millimetres, true_positions
from implicam.experiments.stored import Values
from implicam.measurement import Measurement

NAME = "ball"
EXAMPLE_SET, ALIGNED_SET = "2R2W", "2R"
EXAMPLES = (NETWORK, PAPER, GP, FORWARD)
_COST = {NETWORK: 30.0, PAPER: 12.0, GP: 5.0, FORWARD: 8.0}  # of a run, in proportion: the longest cells come first


def cells(source: Source, plan: Plan) -> list[Cell]:
    """The cells of experiment 1: of the learners, of the explicit lines, and of the two figures in 3D.

    Args:
        source: The data.
        plan: How much is computed.

    Returns:
        The cells that take longest first.
    """
    parts, found = source.parts, list[tuple[float, Cell]]()
    for trained, shares, runs in (
        (BALL, plan.shares, plan.runs),
        (RANDOM, plan.random_shares, plan.random_runs),
    ):
        for cameras in list(source.sets) if trained in parts else []:
            total = len(source.data(trained, cameras))
            for known in dict.fromkeys(sizes(total, shares)):
                for method in LEARNERS:
                    options = {"trained": trained, "cameras": cameras, "method": method, "known": known}
                    name = f"{NAME}/{trained}/{cameras}/{slug(method)}/{known}"
                    cost = _COST[method] * runs[method] * known
                    found.append((cost, _cell(learn, name, source, **options, runs=runs[method])))
    longest_first = [cell for _, cell in sorted(found, key=lambda pair: -pair[0])]
    if BALL not in parts:
        return longest_first
    return [*longest_first, *_explicit_cells(source, plan), *_example_cells(source, plan)]


def _explicit_cells(source: Source, plan: Plan) -> list[Cell]:
    """The lines of explicit; of measured data those for which there are enough pictures."""
    if BOARDS not in source.parts:
        return []
    return [
        _cell(line, f"{NAME}/{slug(method)}/{cameras}/{each}+{pairs}/{subset}", source, cameras=cameras, method=method,
              each=each, pairs=pairs, subset=subset)
        for method in LINES
        for cameras in reversed(list(source.sets))
        for each, pairs in BUDGETS
        if not source.folder or source.boards(cameras, each, pairs, 0) is not None
        for subset in range(1 if (each, pairs) == BUDGETS[0] else plan.subsets)
    ]  # fmt: skip


def _example_cells(source: Source, plan: Plan) -> list[Cell]:
    names = list(source.sets)
    cameras = EXAMPLE_SET if EXAMPLE_SET in names else names[-1]
    known = max(sizes(len(source.data(BALL, cameras)), plan.shares))
    found = [
        _cell(example, f"{NAME}/example/{slug(method)}", source, cameras=cameras, method=method, known=known)
        for method in EXAMPLES
    ]
    pair = ALIGNED_SET if ALIGNED_SET in names else names[0]
    if BOARDS in source.parts and source.boards(pair, *BUDGETS[0], 0) is not None:
        found.append(_cell(alignment, f"{NAME}/alignment", source, cameras=pair))
    return found


def _cell(work: Any, name: str, source: Source, **options: Any) -> Cell:
    return Cell(work, name, {"source": source.options, **options})


def sizes(total: int, shares: tuple[int, ...]) -> list[int]:
    """Numbers of training points: of 175, the paper's 157 to 17.

    Args:
        total: How many points there are.
        shares: Per cent of them.
    """
    return [max(1, total * share // 100) for share in shares]


def learn(source: Mapping[str, Any], trained: str, cameras: str, method: str, known: int, runs: int) -> Values:
    """The rows of some random splits of one learner.

    Args:
        source: The data: `Source.options`.
        trained: The part to train on.
        cameras: A set of cameras.
        method: Its name.
        known: How many points to train on.
        runs: How many splits.

    Returns:
        "rows": one for each split and each part that it is judged at; lengths in mm.
    """
    of = Source(**source)
    data = of.data(trained, cameras)
    splits = [Split(trained, *data.split(known, seed=run), run) for run in range(runs)]
    check = of.data(CHECK, cameras) if CHECK in of.parts else None
    rows = list[Values]()
    for split, (fit, seconds) in zip(
        splits, fit_each(calibrator_from_name(method), [one.train for one in splits]), strict=True
    ):
        to_judge = {} if trained == RANDOM else {trained: split.held_out}
        to_judge |= {} if check is None else {CHECK: check}
        for judged, held_out in to_judge.items():
            trial = judge(method, Split(judged, split.train, held_out, split.seed), fit, seconds)
            where = {"set": cameras, "method": method, "trained": trained, "judged": judged, "known": known}
            rows.append({**where, "run": split.seed, **numbers(trial, millimetres(data))})
    return {"rows": rows}


def numbers(trial: Any, scale: float) -> Values:
    """The numbers of a trial, in mm, as plain values.

    Args:
        trial: The trial.
        scale: How many mm a length unit of the trial is.
    """
    lengths = {key: getattr(trial, key) * scale for key in ("rmse", "median", "limit", "mean_sd")}
    others = {key: getattr(trial, key) for key in ("ellipsoid_95", "nees", "fit_seconds", "failure")}
    return {**lengths, **others, "measured": 1 - trial.unmeasured / trial.held_out if trial.held_out else 0.0}


def line(source: Mapping[str, Any], cameras: str, method: str, each: int, pairs: int, subset: int) -> Values:
    """The rows of one of `LINES` from a subset of the pictures.

    Args:
        source: The data: `Source.options`.
        cameras: A set of cameras.
        method: Its name.
        each: Pictures by each camera alone.
        pairs: Pictures by each pair of cameras.
        subset: The number of the subset.

    Returns:
        "rows": one for each part that it is judged at, lengths in mm; with the reprojection error of the corners in
        pixels, by which the paper takes the median of the subsets.
    """
    of = Source(**source)
    data = of.data(BALL, cameras)
    fit: ExplicitCalibration | ImplicamError
    try:
        fit = explicit_of(of, cameras, method, each, pairs, subset)
    except ImplicamError as error:
        fit = error
    places = {BALL: data, **({CHECK: of.data(CHECK, cameras)} if CHECK in of.parts else {})}
    where = {"set": cameras, "method": method, "budget": f"{each}+{pairs}", "run": subset}
    return {"rows": [{**where, "judged": judged, **_errors(fit, held_out)} for judged, held_out in places.items()]}


def explicit_of(source: Source, cameras: str, method: str, each: int, pairs: int, subset: int) -> ExplicitCalibration:
    """One of `LINES` from a subset of the pictures, aligned to all positions of the lattice, as in the paper.

    Args:
        source: The data.
        cameras: A set of cameras.
        method: Its name.
        each: Pictures by each camera alone.
        pairs: Pictures by each pair of cameras.
        subset: The number of the subset.

    Raises:
        DatasetError: There are too few pictures.
        FitError: They do not fix the cameras.
    """
    boards = source.boards(cameras, each, pairs, subset)
    if boards is None:
        raise DatasetError(
            f"there are fewer than {each} pictures of each camera or {pairs} of each pair.",
            fix="the lines for smaller budgets are computed where there are enough pictures for them",
        )
    preset = Explicit.variants().get(method.partition(":")[2], {})
    return Explicit(**{**preset, "align": ICP, "boards": boards}).fit(source.data(BALL, cameras))


def _errors(fit: ExplicitCalibration | ImplicamError, data: Dataset) -> Values:
    """The positions that the cloud was aligned to count too: six numbers are all that it took from them."""
    if isinstance(fit, ImplicamError):
        return {"failure": fit.what}
    measured = fit.measure(data.observations)
    good = measured.measured
    off = (measured.xyz - true_positions(data))[good]
    nees = np.einsum("ni,ni->n", off, np.linalg.solve(measured.cov[good], off[..., None])[..., 0])
    inside = float(np.mean(nees <= chdtri(3, 0.05))) if good.any() else float("nan")
    calibrated = len(fit.camera_names)
    return {
        **errors(measured, data), "ellipsoid_95": inside, "reprojection": fit.fitted.reprojection,
        "calibrated": calibrated,
    }  # fmt: skip


def errors(measured: Measurement, data: Dataset) -> Values:
    """Error and stated standard deviation of the points that were measured.

    Args:
        measured: The points.
        data: Their true positions, rows as in `measured`.

    Returns:
        Numbers in mm; or why there are none.
    """
    good, scale = measured.measured, millimetres(data)
    squares = ((measured.xyz - true_positions(data))[good] ** 2).sum(axis=1)
    if not len(squares):
        return {"failure": "no position was measured"}
    return {
        "rmse": float(np.sqrt(squares.mean())) * scale,
        "mean_sd": float(measured.sd[good].mean()) * scale,
        "max_sd": float(measured.sd[good].mean(axis=1).max()) * scale,
        "measured": float(good.mean()),
        "failure": "",
    }


def example(source: Mapping[str, Any], cameras: str, method: str, known: int) -> Values:
    """One run to be drawn.

    Args:
        source: The data: `Source.options`.
        cameras: A set of cameras.
        method: Its name.
        known: How many points to train on.

    Returns:
        As `measure_panel`.
    """
    train, held_out = Source(**source).data(BALL, cameras).split(known, seed=0)
    return measure_panel(calibrator_from_name(method).fit(train), train, held_out)


def measure_panel(fit: Calibration, train: Dataset, held_out: Dataset) -> Values:
    """The arrays of a panel, in mm.

    Args:
        fit: The calibration.
        train: The points that it was fitted to.
        held_out: The n points to measure.

    Returns:
        xyz (n, 3), sd (n,), true_xyz (n, 3), known_xyz (m, 3).
    """
    measured, scale = fit.measure(held_out.observations), millimetres(train)
    return {
        "xyz": measured.xyz * scale,
        "sd": measured.sd.mean(axis=1) * scale,
        "true_xyz": true_positions(held_out) * scale,
        "known_xyz": train.xyz * scale,
    }


def alignment(source: Mapping[str, Any], cameras: str) -> Values:
    """The points of `explicit` in the frame of its first camera, and as they were moved onto the lattice.

    Args:
        source: The data: `Source.options`.
        cameras: A set of cameras.

    Returns:
        true_xyz, aligned_xyz, camera_xyz (n, 3) in mm, and the name of the camera.
    """
    of = Source(**source)
    data, scale = of.data(BALL, cameras), millimetres(of.data(BALL, cameras))
    calibration = explicit_of(of, cameras, EXPLICIT, *BUDGETS[0], 0)
    moved = calibration.measure(data.observations).xyz
    first = rig_of(calibration)[0].cameras[0]
    return {
        "true_xyz": data.xyz * scale,
        "aligned_xyz": moved * scale,
        "camera_xyz": first.camera_from_world.apply(moved) * scale,
        "camera": first.name,
    }
