"""Measure points whose positions are known, and hold the stated covariance against the errors.

A point that the calibration was fitted from says nothing about its accuracy, so it is always left out.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators import Calibration
from implicam.calibrators.protocol import PlacesItsWorld
from implicam.coverage import Coverage, assess, tercile_labels
from implicam.dataset import Dataset, Floats, Names, Observations, find_copies
from implicam.dataset.model import fingerprint_rows
from implicam.errors import DatasetError
from implicam.geometry import depth_of_points
from implicam.measurement import Measurement
from implicam.progress import Progress, silent
from implicam.world import in_another_frame, lay_over


class Fits(Protocol):
    """Anything that turns data into a calibration: a calibrator, or a calibration's `refit`."""

    def __call__(self, data: Dataset, progress: Progress = silent) -> Calibration:
        """Fit.

        Args:
            data: Known points.
            progress: Called as the fit goes on.
        """


@runtime_checkable
class KnowsLabelErrors(Protocol):
    """A calibration that has estimated how far known positions are off."""

    def known_position_covariance(self, xyz: Floats) -> Floats:
        """The covariance of the error of a known position.

        Args:
            xyz: (n, 3) in the world.

        Returns:
            (n, 3, 3) of a known position near each; zero where none seems off.
        """


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Held-out points, measured, and what their errors say.

    Attributes:
        method: Of the calibration.
        data: The held-out points, rows as in `measurement`.
        measurement: Their measured positions.
        true_xyz: (n, 3) where they were: the simulated truth where the dataset carries it, else the known positions.
        known_xyz: (m, 3) the points that the calibration was fitted to (all of them, where each was held out in turn).
        coverage: How well covariances agree with errors.
        how: What was held out, in words.
        against: What `true_xyz` is, in words.
        notes: What should be known before the numbers are trusted.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig.select(range(20)))
    >>> evaluation = ic.evaluate(calibration, rig.select(range(20, 30)))
    >>> evaluation.method, evaluation.true_xyz.shape
    ('forward-gp', (10, 3))
    """

    method: str
    data: Dataset
    measurement: Measurement
    true_xyz: Floats
    known_xyz: Floats
    coverage: Coverage
    how: str
    against: str
    notes: tuple[str, ...] = ()


def evaluate(calibration: Calibration, data: Dataset, *, regions: bool = True) -> Evaluation:
    """Evaluate a calibration on the known points that it was not fitted to.

    Args:
        calibration: The calibration.
        data: Known points; those that were used in the fit are left out.
        regions: Whether to group the points by depth and number of views; the depth takes longer than everything else.

    Raises:
        DatasetError: There are no known positions, the length units differ, or all points were used in the fit.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> calibration = ic.ForwardGP().fit(rig.select(range(20)))
    >>> ic.evaluate(calibration, rig.select(range(20, 30))).coverage.overall.n
    10
    """
    _ = data.positions
    if data.length_unit != calibration.data.length_unit:
        raise DatasetError(
            f"{data.name!r} is in {data.length_unit}, and the calibration is in {calibration.data.length_unit}.",
            why="errors are differences of positions, so both must be in one length unit",
            fix=f"in Python evaluate(calibration, data.in_unit({calibration.data.length_unit!r})); or "
            + (
                "calibrate with known points in the unit of this dataset"
                if len(calibration.data)
                else f"import the cameras with --unit {data.length_unit}"
            ),
        )
    names = calibration.data.observations.camera_names
    if set(names) <= set(data.observations.camera_names):
        data = data.with_cameras(names)  # regions and limit are those of the cameras that measure
    used = _same_views(calibration.data.observations, data.observations)
    if used.all():
        raise DatasetError(
            f"all {len(data)} points of {data.name!r} were used to fit this calibration.",
            why="errors at points it has learned say nothing about new ones",
            fix="evaluate with --cv 10 or --leave-out shot, keep some points back (calibrate --points N), "
            "or give another dataset of the rig",
        )
    held_out = data.select(~used)
    how = f"{len(held_out)} points not used in the fit"
    if find_copies(held_out).points.any():
        how += f", of which {int(find_copies(held_out).points.sum())} are copies of others and not counted"
        held_out = held_out.select(~find_copies(held_out).points)
    if used.any():
        how += f"; {used.sum()} of this dataset were, and are left out"
    measurement = calibration.measure(held_out.observations)
    labels, known_xyz = _label_covariance(calibration, held_out), calibration.data.xyz
    xyz = held_out.xyz if held_out.truth is None else held_out.truth.xyz
    more: tuple[str, ...] = ()
    if isinstance(calibration, PlacesItsWorld) and calibration.free_world and not calibration.world:
        laid = lay_over(measurement, xyz, np.sqrt(np.diagonal(labels, axis1=1, axis2=2)))
        measurement, how = laid.measurement, f"{how}, {laid.told}"
        known_xyz = laid.new_from_old.apply(known_xyz)
    else:
        more = tuple(in_another_frame(measurement, xyz))
    found = _judge(calibration, held_out, measurement, labels, known_xyz, how, regions=regions)
    return replace(found, notes=(*more, *found.notes))


def cross_validate(fit: Fits, data: Dataset, k: int, *, seed: int = 0, progress: Progress = silent) -> Evaluation:
    """Hold each of several random folds out in turn: a fit to the others measures it.

    Args:
        fit: Makes a calibration from data.
        data: Known points; copies of others are left out.
        k: How many folds.
        seed: Of the folds.
        progress: Called after each fit.

    Raises:
        FitError: A fit without a fold fails.
        DatasetError: There are fewer positions than folds, or fewer than two folds.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> ic.cross_validate(ic.ForwardGP().fit, rig, 3).coverage.overall.n
    30
    """
    how = f"{k}-fold cross-validation (seed {seed})"
    data, how = _each_once(data, how)
    return _held_out_in_turn(fit, data, list(data.folds(k, seed=seed)), how, progress)


def leave_out_shots(fit: Fits, data: Dataset, *, progress: Progress = silent) -> Evaluation:
    """Hold each shot (a board, a plane) out in turn: a fit to the others measures it.

    Args:
        fit: Makes a calibration from data.
        data: Known points; copies of others are left out.
        progress: Called after each fit.

    Raises:
        FitError: A fit without a shot fails.
        DatasetError: There is only one shot.

    >>> import implicam as ic
    >>> from dataclasses import replace
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> shots = replace(rig, known=replace(rig.known, shots=[f"s{i % 3}" for i in range(30)]))
    >>> ic.leave_out_shots(ic.ForwardGP().fit, shots).coverage.overall.n
    30
    """
    data, more = _each_once(data, "")
    rounds = list(data.leave_out_shots())
    return _held_out_in_turn(fit, data, rounds, f"each of {len(rounds)} shots left out in turn{more}", progress)


def _each_once(data: Dataset, how: str) -> tuple[Dataset, str]:
    """Without copied points: a copy in another fold is a point that the fit knows, and no second piece of evidence.
    DatasetError where there is no point at all."""
    if not len(data):
        raise DatasetError(
            f"{data.name!r} has no known points, so none can be held out.",
            why="of cameras that another program calibrated a file holds none",
            fix="judge it by others: implicam evaluate FILE DATASET, or implicam report FILE DATASET",
        )
    copied = find_copies(data).points
    if not copied.any():
        return data, how
    return data.select(~copied), f"{how}; {copied.sum()} points are copies of others and not counted"


def _held_out_in_turn(
    fit: Fits, data: Dataset, rounds: list[tuple[str, Dataset, Dataset]], how: str, progress: Progress
) -> Evaluation:
    parts: list[tuple[Measurement, Dataset, Floats]] = []
    progress(how, 0, len(rounds))
    for i, (_, others, held_out) in enumerate(rounds):
        calibration = fit(others)
        parts.append((calibration.measure(held_out.observations), held_out, _label_covariance(calibration, held_out)))
        progress(how, i + 1, len(rounds))
    measurement = _stacked(m for m, _, _ in parts)
    labels = np.concatenate([covariance for _, _, covariance in parts])
    row = {str(name): i for i, name in enumerate(data.points)}
    held_out = data.select([row[str(name)] for _, part, _ in parts for name in part.points])
    # what there is to note is of all points, not of those that the last round happened to leave
    return _judge(fit(data), held_out, measurement, labels, data.xyz, how)


def _stacked(parts: Iterable[Measurement]) -> Measurement:
    all_parts = list(parts)

    names = ("points", "xyz", "cov", "views", "consistency", "reason", "share_calibration")
    columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in all_parts]) for name in names}
    return Measurement(**columns, length_unit=all_parts[0].length_unit)


def _judge(
    calibration: Calibration,
    data: Dataset,
    measurement: Measurement,
    labels: Floats,
    known_xyz: Floats,
    how: str,
    *,
    regions: bool = True,
) -> Evaluation:
    truth = data.truth
    true_xyz = data.xyz if truth is None else truth.xyz
    coverage = assess(
        measurement.xyz - true_xyz,
        measurement.cov + labels,
        clusters=data.shots,
        regions=_regions(data) if regions else None,
        limit=None if truth is None else truth.limit,
    )
    against = "the simulated truth"
    if truth is None:
        against = f"the known positions{_whose_errors(data, labels)}"
    notes = (*dict.fromkeys((*data.notes, *calibration.data.notes, *calibration.notes)),)
    return Evaluation(calibration.method, data, measurement, true_xyz, known_xyz, coverage, how, against, notes)


def _label_covariance(calibration: Calibration, data: Dataset) -> Floats:
    """(n, 3, 3) of the errors of the known positions that are judged by: as declared, or else as the calibration has
    estimated them; none of simulated true positions."""
    return np.zeros((len(data), 3, 3)) if data.truth is not None else known_position_covariance(calibration, data)


def known_position_covariance(calibration: Calibration, data: Dataset) -> Floats:
    """The covariance of the errors of known positions: as declared, or else as the calibration has estimated them.

    Args:
        calibration: The calibration.
        data: Known points.

    Returns:
        (n, 3, 3); zero where nothing is known of them.
    """
    if _declared(data) or not isinstance(calibration, KnowsLabelErrors):
        return np.asarray(np.nan_to_num(data.positions.sd)[:, :, None] ** 2 * np.eye(3), dtype=np.float64)
    return calibration.known_position_covariance(data.xyz)


def _declared(data: Dataset) -> bool:
    return bool((data.positions.sd > 0).any())


def _whose_errors(data: Dataset, labels: Floats) -> str:
    if not labels.any():
        return ""
    if _declared(data):
        return ", whose declared sd is part of the error bars"
    sd = ", ".join(f"{x:.2g}" for x in np.sqrt(np.diagonal(np.median(labels, axis=0))))
    return f", whose own errors, as estimated (sd {sd} {data.length_unit} in x, y, z), are part of the error bars"


def _regions(data: Dataset) -> dict[str, Names]:
    """Labels by depth (terciles of the mean distance from the cameras) and by number of views."""
    regions = {}
    sizes = [(c.width, c.height) for c in data.cameras if c.width is not None and c.height is not None]
    known_sizes = np.array(sizes, dtype=np.float64) if len(sizes) == len(data.cameras) else None
    depth = depth_of_points(data.xyz, data.observations.uv, known_sizes)
    if depth is not None:
        regions["depth"] = np.asarray(tercile_labels(depth), dtype=np.str_)
    views = data.observations.seen.sum(axis=1)
    if np.ptp(views) > 0:
        regions["views"] = np.array([f"{count} views" if count != 1 else "1 view" for count in views], dtype=np.str_)
    return regions


def _same_views(fitted: Observations, given: Observations) -> NDArray[np.bool_]:
    """(n,) which given points are points of the fit: the same pixels in the cameras of the fit, whatever their name.

    A table without names numbers its rows, so a name says little; the same pixels to the last bit are the same views.
    """
    names = [name for name in fitted.camera_names if name in given.camera_names]  # a camera left out hides nothing
    if not names:
        return np.zeros(len(given), dtype=np.bool_)  # measuring will say what is missing
    learned = set(_fingerprints(fitted.with_cameras(names)))
    return np.array([views in learned for views in _fingerprints(given.with_cameras(names))], dtype=np.bool_)


def _fingerprints(observations: Observations) -> list[bytes]:
    """Per point its pixels as bytes; a point without any is known by its name."""
    marks = fingerprint_rows(observations.uv.reshape(len(observations), 2 * len(observations.cameras)))
    seen = observations.seen.sum(axis=1) > 0
    return [mark if s else str(name).encode() for mark, s, name in zip(marks, seen, observations.points, strict=True)]
