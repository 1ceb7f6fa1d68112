"""The acceptance test: calibrated lengths against a limit, in the manner of VDI/VDE 2634 part 1 and ISO 10360.

`verify` is what `implicam verify` does; docs/verify.md says what each number means.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from implicam.active import Workspace
from implicam.calibrators import Calibration
from implicam.dataset import Dataset, Floats
from implicam.dataset.units import METRES_PER_UNIT
from implicam.derived import joint_distances
from implicam.derived.joint_positions import find_point
from implicam.errors import DatasetError, UsageError
from implicam.formatting import decimal_number, list_some, number_with_sd
from implicam.measurement import Measurement
from implicam.verification.lengths import (
    CalibratedLength,
    check_pairs,
    lengths_by_names,
    read_lengths,
    shared_covariance,
)
from implicam.verification.limit import MaximumPermissibleError
from implicam.verification.result import NO_LIMIT, UNDECIDED, LengthResult, Verification, decide
from implicam.verification.statistics import (
    ScaleTest,
    check_error_bars,
    constant_rather_than_scale,
    fit_scale,
    unlike_the_others,
)
from implicam.verification.volume import VolumeCoverage, cover

COVERAGE_FACTOR = 2.0
NEXT_LENGTHS = 3
MAX_UNIT_RATIO_ERROR, MAX_RATIO = 0.05, 1.2
"""Lengths that are all longer or shorter than this ratio are in another unit, or of other points; near one of the
usual ratios of units, it is named."""
UNIT_RATIOS = tuple(
    sorted({a / b for a in METRES_PER_UNIT.values() for b in METRES_PER_UNIT.values() if a / b > MAX_RATIO})
)


def verify(
    calibration: Calibration,
    what: Dataset | Measurement,
    lengths: str | Path | float | Sequence[CalibratedLength],
    *,
    mpe: str | float | None = None,
    k: float = COVERAGE_FACTOR,
    workspace: Workspace | None = None,
    next_lengths: int = NEXT_LENGTHS,
    length_unit: str = "",
) -> Verification:
    """Test an instrument with calibrated lengths.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=60, seed=1)
    >>> length = float(sum((rig.xyz[0] - rig.xyz[1]) ** 2)) ** 0.5
    >>> known = ic.CalibratedLength(*rig.points[:2], length, sd=0.001)
    >>> ic.verify(ic.ForwardGP().fit(rig), rig, [known], mpe=1e-6).decision
    'does not conform'

    Args:
        calibration: Of the instrument.
        what: What its cameras saw of the ends of the lengths; or what it measured of that.
        lengths: A table `lengths.csv`; or the calibrated lengths; or one length, between all points that are named
            alike but for their ends, `bar01_a` and `bar01_b`.
        mpe: The maximum permissible error, a number or "A + L/K", in the length unit. None: no decision.
        k: Coverage factor of the uncertainty of the test.
        workspace: The measuring volume, in the length unit; None for the hull of the calibration's known points.
        next_lengths: How many further lengths to place.
        length_unit: Of lengths, limit and result; empty for that of the calibration.

    Returns:
        The errors, the decision, and what else the lengths tell.

    Raises:
        UsageError: A limit or a length is impossible, a point is not there.
        DatasetError: The table cannot be read, no length was measured, or all are in another unit.
    """
    if not k >= 1:
        raise UsageError(f"a coverage factor of {k!r} is not usual.", fix="give 2, or 1.65 for one-sided 95 %")
    limit = None if mpe is None else MaximumPermissibleError.parse(mpe)
    measurement = calibration.measure(what.observations) if isinstance(what, Dataset) else what
    if length_unit and length_unit != measurement.length_unit:
        measurement = measurement.in_unit(length_unit)
    known = _calibrated_lengths(lengths, measurement)
    rows = np.array([[find_point(measurement, one.a), find_point(measurement, one.b)] for one in known])
    seen = measurement.measured[rows].all(axis=1)
    if not seen.any():
        raise DatasetError(
            "no length was measured.", why=_reason(measurement, rows[0]), fix="both ends must be seen by two cameras"
        )
    ends = measurement.xyz[rows[seen]]
    measured = np.full(len(known), np.nan)
    measured[seen] = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    calibrated = np.array([one.corrected for one in known])
    _refuse_other_unit(measured[seen] / calibrated[seen], measurement.length_unit)
    cov = _predicted_covariance(measurement, rows[seen])
    used = [one for one, there in zip(known, seen, strict=True) if there]
    error, bars, scale, constant, odd = (measured - calibrated)[seen], None, None, None, list[int]()
    if cov is not None:
        total = cov + shared_covariance(used)
        odd = unlike_the_others(error, calibrated[seen], total)
        rest = np.setdiff1d(np.arange(len(error)), odd)
        bars = check_error_bars(error[rest], total[np.ix_(rest, rest)])
        of_rest = error[rest], calibrated[seen][rest], total[np.ix_(rest, rest)]
        scale, constant = fit_scale(*of_rest), constant_rather_than_scale(*of_rest)
    volume = _volume(calibration, measurement, workspace, ends, used, next_lengths)
    lines = iter(volume.lines if volume else [one.line for one in used])
    sds = iter(np.sqrt(np.diagonal(cov)) if cov is not None else np.full(len(used), np.nan))
    results = tuple(
        _result(one, next(lines), value, float(next(sds)), limit, k) if there
        else _not_measured(one, limit, k, _reason(measurement, pair))
        for one, value, there, pair in zip(known, measured.tolist(), seen, rows, strict=True)
    )  # fmt: skip
    notes = _notes(measurement, known, used, [used[i] for i in odd], scale, cov is None)
    if constant is not None:
        notes.append(
            f"All lengths are off by {number_with_sd(constant.value, constant.sd)} {measurement.length_unit} alike, "
            "whatever their size, which explains their errors better than an error of scale: look for marks that are "
            "not found where they were calibrated, or a constant in the table of lengths."
        )
    return Verification(
        results, limit, k, bars, scale, volume, calibration.method, measurement.length_unit, tuple(notes)
    )


def _calibrated_lengths(
    given: str | Path | float | Sequence[CalibratedLength], measurement: Measurement
) -> list[CalibratedLength]:
    if isinstance(given, str | Path):
        found = read_lengths(Path(given))
    elif isinstance(given, int | float):
        found = lengths_by_names(list(map(str, measurement.points)), float(given))
    else:
        found = list(given)
    if not found:
        raise UsageError("there is no calibrated length.", fix="give one or more")
    check_pairs(found)
    return found


def _reason(measurement: Measurement, pair: np.ndarray) -> str:
    missing = [i for i in pair if not measurement.measured[i]]
    return "; ".join(f"{measurement.points[i]} was not measured: {measurement.reason[i]}" for i in missing)


def _refuse_other_unit(ratio: Floats, unit: str) -> None:
    """All lengths far off in the same sense are no errors of an instrument."""
    middle = float(np.median(ratio))
    away = max(middle, 1 / middle) if middle > 0 else math.inf
    if away < MAX_RATIO:
        return
    near = min(UNIT_RATIOS, key=lambda usual: abs(math.log(usual / away)))
    named = abs(near / away - 1) < MAX_UNIT_RATIO_ERROR
    raise DatasetError(
        f"the lengths are measured {decimal_number(middle)} times as long as they were calibrated.",
        why=f"the table of lengths is in another unit than the calibration ({unit}), which differs by {near:g}"
        if named
        else "a length was stated for other points, or in another unit",
        fix=f"write all lengths in {unit}, or say their unit (--unit)"
        + ("" if named else ", and look at which points are their ends"),
    )


def _predicted_covariance(measurement: Measurement, rows: np.ndarray) -> Floats | None:
    """(n, n) of the measured lengths; None where the method does not say what errors share."""
    if measurement.shared is None:
        return None
    return joint_distances(measurement, [(int(a), int(b)) for a, b in rows]).cov


def _volume(
    calibration: Calibration, measurement: Measurement, workspace: Workspace | None, ends: Floats,
    lengths: Sequence[CalibratedLength], count: int,
) -> VolumeCoverage | None:  # fmt: skip
    if workspace is None:
        known = calibration.data
        if known.known is None:
            return None
        same = measurement.length_unit == known.length_unit
        data = known if same else known.in_unit(measurement.length_unit)
        xyz = data.xyz[np.isfinite(data.xyz).all(axis=1)]
        try:
            workspace = Workspace.hull(xyz)
        except UsageError:  # fewer than four, or all in a plane
            return None
    sizes = [one.length for one in lengths]
    return cover(workspace, ends, [one.line for one in lengths], measurement.length_unit, sizes=sizes, count=count)


def _result(
    one: CalibratedLength, line: str, measured: float, sd: float, mpe: MaximumPermissibleError | None, k: float
) -> LengthResult:
    error, expanded = measured - one.corrected, k * one.sd_test
    limit = math.nan if mpe is None else mpe.at(one.length)
    decision = NO_LIMIT if mpe is None else decide(error, limit, expanded)
    return LengthResult(one, line, measured, error, one.sd_test, expanded, limit, sd, decision)


def _not_measured(one: CalibratedLength, mpe: MaximumPermissibleError | None, k: float, why: str) -> LengthResult:
    nan, limit = math.nan, math.nan if mpe is None else mpe.at(one.length)
    decision = NO_LIMIT if mpe is None else UNDECIDED
    return LengthResult(one, one.line, nan, nan, one.sd_test, k * one.sd_test, limit, nan, decision, why)


def _notes(
    measurement: Measurement, known: Sequence[CalibratedLength], used: Sequence[CalibratedLength],
    odd: Sequence[CalibratedLength], scale: ScaleTest | None, unpredicted: bool,
) -> list[str]:  # fmt: skip
    notes = [measurement.alarm] if measurement.alarm else []
    if len(used) < len(known):
        count = len(known) - len(used)
        notes.append(f"Of {len(known)} lengths {count} could not be measured: conformity is not proven without them.")
    notes += [
        f"{one.title} is unlike the others, more than chance explains: look for a mistake in its marks or its row, and "
        "measure it again. It counts in the decision; error bars and scale are judged without it."
        for one in odd
    ]
    if unstated := [one.title for one in known if one.sd is None]:
        which = "no length has" if len(unstated) == len(known) else f"{list_some(unstated)} have no"
        notes.append(f"{which} an uncertainty of its certificate; it counts as none.".replace("no an", "no"))
    if all(one.temperature is None for one in known):
        notes.append("No temperature is stated: lengths count as they were calibrated, and its uncertainty as none.")
    if scale is not None and scale.widened > 1:
        notes.append(
            f"The lengths scatter {decimal_number(scale.widened, 2)} times as much as predicted, and the uncertainty "
            "of the scale was multiplied by it."
        )
    if unpredicted:
        notes.append(
            "The calibration does not say what the errors of two points share: no test of error bars or scale."
        )
    return notes
