"""What a report is about."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from implicam.calibrators import Calibration, RigCalibration
from implicam.calibrators.protocol import LengthsHeldOut
from implicam.coverage import Coverage
from implicam.dataset import Floats
from implicam.errors import FitError, UsageError
from implicam.evaluation import Evaluation
from implicam.measurement import Measurement
from implicam.report.instrument import Instrument

NORMAL_95 = 1.96
"""Standard deviations to either side that contain 95 % of a normal distribution."""


@dataclass(frozen=True, eq=False)
class KnownLengths:
    """Distances between measured points whose true length is known, though not where the points were.

    Attributes:
        what: They are between, in words: "corners of 4 boards that were held out".
        errors: (n,) measured minus true, in the length unit.
        sd: (n,) stated standard uncertainty of each distance.
    """

    what: str
    errors: Floats
    sd: Floats

    @property
    def rms(self) -> float:
        """Of the errors."""
        return float(np.sqrt(np.mean(self.errors**2)))

    @property
    def stated_rms(self) -> float:
        """What the error bars say that `rms` should be."""
        return float(np.sqrt(np.mean(self.sd**2)))

    @property
    def inside(self) -> float:
        """Share of the distances that their 95 % interval contains, from 0 to 1."""
        return float(np.mean(np.abs(self.errors) <= NORMAL_95 * self.sd))


@dataclass(frozen=True, eq=False)
class ReportData:
    """A measurement and all that is known about it; everything but title and measurement may be left out.

    measurement: brings names, positions, covariances, views, unit, the reasons of points not measured, and which
    views others were measured without.
    true_xyz: (n, 3) where its points really were, NaN where unknown. coverage: `implicam.coverage.assess` of the same
    points, the base of the headline and of the verdict. known_xyz: (m, 3) points the rig was calibrated from.
    cameras: name -> (3,) centre. facts: label and value pairs for the head (rig, method, date, ...). notes: sentences
    for "how it was computed". instrument: the cameras themselves. lengths: what headline and verdict are about, where
    no truth is known but distances between points.
    """

    title: str
    measurement: Measurement
    subtitle: str = ""
    facts: tuple[tuple[str, str], ...] = ()
    coverage: Coverage | None = None
    true_xyz: Floats | None = None
    known_xyz: Floats | None = None
    cameras: Mapping[str, ArrayLike] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    instrument: Instrument | None = None
    lengths: KnownLengths | None = None

    def __post_init__(self) -> None:
        n = len(self.measurement)
        if self.true_xyz is not None and self.true_xyz.shape != (n, 3):
            raise UsageError(f"true_xyz has the shape {self.true_xyz.shape}; expected {(n, 3)}, as measured.")
        if self.coverage is not None and self.coverage.overall.n + self.coverage.overall.unmeasured != n:
            raise UsageError(
                "the coverage belongs to other points than the measurement.",
                why=f"it counts {self.coverage.overall.n + self.coverage.overall.unmeasured}, the measurement has {n}",
                fix="call assess(measurement.xyz - true_xyz, measurement.cov) on the same measurement",
            )

    @property
    def unit(self) -> str:
        """The length unit."""
        return self.measurement.length_unit

    @property
    def error(self) -> Floats | None:
        """(n,) distance of each measured point from its truth, NaN where either is missing."""
        if self.true_xyz is None:
            return None
        return np.asarray(np.linalg.norm(self.measurement.xyz - self.true_xyz, axis=1), dtype=np.float64)

    @property
    def sd(self) -> Floats:
        """(n, 3) standard uncertainties, NaN where a variance is negative (the coverage says so in words)."""
        with np.errstate(invalid="ignore"):
            return self.measurement.sd

    @property
    def spread(self) -> Floats:
        """(n,) stated uncertainty in 3D, sqrt of the trace of the covariance."""
        return np.asarray(np.linalg.norm(self.sd, axis=1), dtype=np.float64)

    @property
    def unmeasured(self) -> list[tuple[str, str]]:
        """Name and reason of each point without a position."""
        m = self.measurement
        return [(str(m.points[i]), str(m.reason[i]) or "no reason given") for i in np.flatnonzero(~m.measured)]

    @property
    def without_a_view(self) -> list[tuple[str, str]]:
        """Name of each point that was measured without one of its views, and which one."""
        m = self.measurement
        return [(str(m.points[i]), str(m.reason[i])) for i in np.flatnonzero(m.measured & (m.reason != ""))]

    @property
    def not_judged(self) -> list[tuple[str, str]]:
        """Name and reason of each point that was measured, but whose covariance could not be judged."""
        reasons = () if self.coverage is None else self.coverage.reasons
        return [(str(self.measurement.points[i]), reason) for i, reason in reasons]


def report_of(
    evaluation: Evaluation, title: str, checksum: str = "", *, calibration: Calibration | None = None, by: str = ""
) -> ReportData:
    """What a report says of an evaluation.

    Args:
        evaluation: As `evaluate` or `cross_validate` gives it.
        title: Of the page.
        checksum: The SHA-256 of the calibration file; empty where there is none.
        calibration: What is reported on; None where there are only its measurements.
        by: Who reports; empty for nobody.
    """
    data = evaluation.data
    facts = (
        ("Dataset", data.name),
        ("Method", evaluation.method),
        ("Cameras", f"{len(data.cameras)}: {', '.join(camera.name for camera in data.cameras)}"),
        ("Known points", str(len(evaluation.known_xyz))),
        ("Judged on", evaluation.how),
        ("Length unit", data.length_unit),
        *([("Calibration file, SHA-256", checksum)] if checksum else []),
        *([("By", by)] if by else []),
    )
    what: object = calibration
    instrument = Instrument(what) if isinstance(what, RigCalibration) and len(what.data.xyz) else None
    own_notes = [] if calibration is None else [note for note in calibration.notes if note not in evaluation.notes]
    return ReportData(
        title,
        evaluation.measurement,
        facts=facts,
        coverage=evaluation.coverage,
        true_xyz=evaluation.true_xyz,
        known_xyz=evaluation.known_xyz,
        notes=(f"Errors are taken against {evaluation.against}.", *evaluation.notes, *own_notes),
        cameras={} if instrument is None else instrument.calibration.centres(),
        instrument=instrument,
    )


def report_of_lengths(
    calibration: Calibration, held_out: LengthsHeldOut, title: str, checksum: str, *, by: str = ""
) -> ReportData:
    """What a report says of a calibration where no position is known, but lengths are.

    Args:
        calibration: What is reported on.
        held_out: Lengths that a fit did not know.
        title: Of the page.
        checksum: The SHA-256 of the calibration file.
        by: Who reports; empty for nobody.

    Raises:
        FitError: No length could be measured.
    """
    if not len(held_out.errors):
        raise FitError(
            "no length that was held out could be measured.",
            fix="wave the wand longer where two cameras see both its markers",
        )
    data = calibration.data
    facts = (
        ("Dataset", data.name),
        ("Method", calibration.method),
        ("Cameras", f"{len(data.cameras)}: {', '.join(camera.name for camera in data.cameras)}"),
        ("Judged on", f"distances between {held_out.what}"),
        ("Length unit", data.length_unit),
        ("Calibration file, SHA-256", checksum),
        *([("By", by)] if by else []),
    )
    instrument = Instrument(calibration) if isinstance(calibration, RigCalibration) else None
    return ReportData(
        title,
        calibration.measure(data.observations),
        facts=facts,
        known_xyz=data.xyz,
        notes=(
            "No position is known. The headline is of lengths in frames that a fit did not know; the points and the "
            "places shown are where the wand was, as the calibration from all frames has them.",
            *calibration.notes,
        ),
        cameras={} if instrument is None else instrument.calibration.centres(),
        instrument=instrument,
        lengths=KnownLengths(held_out.what, held_out.errors, held_out.sds),
    )
