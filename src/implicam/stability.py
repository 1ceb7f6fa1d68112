"""Does a calibration still hold? From new views alone, and from known points where there are some.

`check_calibration` is what `implicam check` does; the mathematics is in `rig_model.movement`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy.linalg import orth
from scipy.special import chdtrc

from implicam.calibrators import Calibration
from implicam.calibrators.protocol import RigCalibration
from implicam.dataset import Dataset, Floats
from implicam.derived import joint
from implicam.errors import DatasetError, UsageError
from implicam.files import write_text
from implicam.formatting import decimal_number, number_with_sd
from implicam.geometry import cross_matrices
from implicam.rig_model import NUMBERS, Check, Evidence

STANDS, MOVED, ONE_MOVED, SEVERAL, BIASED = "stands", "moved", "one moved", "several moved", "biased"
UNSEEN = "A rig whose cameras all moved together looks the same to itself: only known points could show it."
NUMBER_NAMES = ("tilt", "pan", "roll", "right", "down", "forward", "zoom")
"""Of a movement: turns about the camera's axes that point right, down and forward in its picture (degrees), shifts
along these (length unit), and the zoom (per cent)."""
MAX_KNOWN_POINTS = 400
"""Known points that are compared; of more, evenly many."""
MIN_KNOWN_POINTS = 4
"""To see a shift, a turn and a growth."""
MIN_RELATIVE_SPREAD = 1e-6
"""Of known points across a line, over their extent: with less a turn about it moves none of them."""
LOG_COLUMNS = (
    "time", "dataset", "points", "p_value", "verdict", "camera",
    *(name for number in NUMBER_NAMES for name in (number, f"sd_{number}")), "p_value_known",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class CameraMovement:
    """How a camera moved, if it alone did.

    Attributes:
        camera: Its name.
        step: (7,) as `NUMBER_NAMES` has them: degrees, the calibration's length unit, per cent.
        sd: (7,) their standard uncertainties.
        cov: (7, 7) their covariance.
        noticed: (7,) what each alone would have to be for the camera to be named half the time.
    """

    camera: str
    step: Floats
    sd: Floats
    cov: Floats
    noticed: Floats


@dataclass(frozen=True, eq=False)
class KnownPointsTest:
    """Known points against what was measured of them.

    Attributes:
        points: How many.
        p_value: That chance alone makes the known points look as shifted, turned and grown; what errors share is taken
            into account.
        bias: (3,) mean error, in the length unit.
        bias_sd: (3,) what its standard uncertainty is if the calibration holds.
    """

    points: int
    p_value: float
    bias: Floats
    bias_sd: Floats


@dataclass(frozen=True, eq=False)
class CalibrationCheck:
    """Whether a calibration still holds.

    >>> import implicam as ic
    >>> rig = ic.simulated("bar6", points=60, seed=1)
    >>> known, later = rig.split(30, seed=0)
    >>> check = ic.check_calibration(ic.ForwardGP().fit(known), later)
    >>> check.verdict, check.holds
    ('stands', True)

    Attributes:
        verdict: `stands`, `moved` (the first of `cameras`), `one moved` (of `candidates`), `several moved` or `biased`.
        p_value: That chance alone makes the views disagree as a movement would.
        cameras: Of each camera how it moved if it alone did, the likeliest first.
        candidates: Names of the cameras of which one moved.
        known: The comparison with known points; None where there are none.
        points: How many points were used.
        noise_ratio: Sd of what is left, whatever moved, over what the views state.
        length_unit: Of shifts.
        not_judged: Names of cameras that saw too little to say anything of them.
    """

    verdict: str
    p_value: float
    cameras: tuple[CameraMovement, ...]
    candidates: tuple[str, ...]
    known: KnownPointsTest | None
    points: int
    noise_ratio: float
    length_unit: str
    not_judged: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether nothing speaks against the calibration."""
        return self.verdict == STANDS

    def sentences(self) -> list[str]:
        """What was found, in words."""
        first, unit = self.cameras[0], self.length_unit
        said = {
            STANDS: f"Nothing speaks against the calibration (p = {decimal_number(self.p_value, 2)}).",
            MOVED: f"{first.camera} has moved: {describe_movement(first, unit)}.",
            ONE_MOVED: f"One of {' and '.join(self.candidates)} has moved; from these views nobody can say which.",
            SEVERAL: "The rig is not as it was calibrated, and no single camera's movement explains it: several moved.",
            BIASED: "The views agree with each other, but not with the known points: all cameras moved together, or "
            "the known points did.",
        }[self.verdict]
        found = [said]
        if self.known is not None:
            pairs = zip("xyz", self.known.bias, self.known.bias_sd, strict=True)
            bias = ", ".join(f"{axis} {number_with_sd(value, sd)}" for axis, value, sd in pairs)
            p = decimal_number(self.known.p_value, 2)
            found.append(f"{self.known.points} known points: mean error {bias} {unit}, p = {p}.")
        else:
            found.append(UNSEEN)
        if self.not_judged:
            found.append(f"Of {', '.join(self.not_judged)} nothing can be said: too few of the points were seen there.")
        return found


def describe_movement(moved: CameraMovement, unit: str) -> str:
    """A movement in words: its turn, its shift and its zoom with their uncertainties.

    Args:
        moved: The movement.
        unit: The length unit.
    """
    parts = []
    for part, what in ((slice(0, 3), "degrees"), (slice(3, 6), unit)):
        size = float(np.linalg.norm(moved.step[part]))
        along = moved.step[part] / size if size > 0 else np.ones(3) / np.sqrt(3)
        sd = float(np.sqrt(along @ moved.cov[part, part] @ along))
        parts.append(f"{'turned by' if part.start == 0 else 'shifted by'} {number_with_sd(size, sd)} {what}")
    return f"{', '.join(parts)}, zoomed by {number_with_sd(float(moved.step[6]), float(moved.sd[6]))} %"


def check_calibration(calibration: Calibration, data: Dataset, *, level: float = 0.05) -> CalibrationCheck:
    """Check whether a calibration still holds.

    >>> import implicam as ic
    >>> rig = ic.simulated("bar6", points=60, seed=1)
    >>> known, later = rig.split(30, seed=0)
    >>> ic.check_calibration(ic.ForwardGP().fit(known), later).holds
    True

    Args:
        calibration: Of `forward-gp` or `explicit`.
        data: New views, 20 points or more; known positions are used where there are some.
        level: How often a rig that stands may raise an alarm; half of it for each test where points are known.

    Returns:
        What was found.

    Raises:
        UsageError: The method has no cameras that could move, or the level is no probability.
        DatasetError: The views are too few.
    """
    if not 0 < level < 1:
        raise UsageError(f"a level of {level!r} is no probability.", fix="give one above 0 and below 1")
    if not isinstance(calibration, RigCalibration):
        raise UsageError(
            f"a calibration by {calibration.method} has no cameras that could have moved.",
            why="it maps the pixels of all cameras to a position, and cannot ask whether the views agree",
            fix="calibrate with forward-gp or explicit",
        )
    share = level / 2 if data.known is not None else level
    found = calibration.map.movement(data, level=share)
    if found is None:
        raise DatasetError(
            "no two cameras saw enough of the same points.", fix="show the cameras more points, 20 or more that all see"
        )
    known = None if data.known is None else _known_points_test(calibration, data)
    names, scale = calibration.map.camera_names, calibration.map.frame.scale
    cameras = tuple(_in_units(one, names, scale, found) for one in found.evidence)
    candidates = tuple(names[c] for c in found.candidates)
    judged = {one.camera for one in cameras}
    return CalibrationCheck(
        _verdict(found, known, share),
        found.p_value,
        cameras,
        candidates,
        known,
        found.points,
        found.noise_ratio,
        calibration.data.length_unit,
        tuple(name for name in names if name not in judged),
    )


def _verdict(found: Check, known: KnownPointsTest | None, level: float) -> str:
    if found.several:
        return SEVERAL
    if found.named is not None:
        return MOVED
    if found.candidates:
        return ONE_MOVED
    return BIASED if known is not None and known.p_value < level else STANDS


def _in_units(one: Evidence, names: Sequence[str], scale: float, found: Check) -> CameraMovement:
    units = np.array([*[np.degrees(1.0)] * 3, *[scale] * 3, 100.0])
    assert len(units) == NUMBERS
    cov = one.cov * np.outer(units, units) * max(found.noise_ratio**2, 1.0)
    return CameraMovement(
        names[one.camera], one.step * units, np.sqrt(np.diagonal(cov)), cov, found.noticed[one.camera] * units
    )


def _known_points_test(calibration: RigCalibration, data: Dataset) -> KnownPointsTest | None:
    """A few numbers that a bias shows in, and not all errors together: of many points these would tell a noise that is
    stated a few per cent too small from chance."""
    measured = calibration.measure(data.observations)
    rows = np.flatnonzero(measured.measured & np.isfinite(data.xyz).all(axis=1))
    if len(rows) < MIN_KNOWN_POINTS:
        return None
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MAX_KNOWN_POINTS)).astype(int))]
    points = joint(measured, [int(i) for i in rows])
    sd = np.nan_to_num(data.known.sd[rows]) if data.known is not None else np.zeros((len(rows), 3))
    cov = points.cov + np.diag(sd.ravel() ** 2)
    error, off = (measured.xyz - data.xyz)[rows].ravel(), data.xyz[rows] - data.xyz[rows].mean(axis=0)
    off = off / max(np.abs(off).max(), np.finfo(float).tiny)
    # what a world that shifted, turned or grew would do to them, (3 n, 7): fewer ways where they lie on a line
    pattern = np.concatenate([np.tile(np.eye(3), (len(rows), 1, 1)), cross_matrices(off), off[:, :, None]], axis=2)
    ways = orth(pattern.reshape(len(error), -1), rcond=MIN_RELATIVE_SPREAD)
    found = ways.T @ error
    p = float(chdtrc(len(found), found @ np.linalg.solve(ways.T @ cov @ ways, found)))
    mean = np.tile(np.eye(3), len(rows)) / len(rows)
    return KnownPointsTest(len(rows), p, mean @ error, np.sqrt(np.diagonal(mean @ cov @ mean.T)))


def append_to_log(path: Path, check: CalibrationCheck, name: str, *, now: datetime | None = None) -> None:
    """Add a check to a history: a row for each camera.

    Args:
        path: The table; it is begun where it does not exist.
        check: What was found.
        name: Of the dataset.
        now: The time; None for that of the clock.

    Raises:
        DatasetError: The file is something else.
        ImplicamError: It cannot be written.
    """
    head = ",".join(LOG_COLUMNS) + "\n"
    before = path.read_text(encoding="utf-8") if path.is_file() else head
    if not before.startswith(head):
        raise DatasetError(f"{path} is no history of checks.", fix="give another name for it")
    at = (now or datetime.now(UTC)).isoformat(timespec="seconds")
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    known = "" if check.known is None else repr(check.known.p_value)
    for camera in check.cameras:
        numbers = [repr(float(value)) for pair in zip(camera.step, camera.sd, strict=True) for value in pair]
        rows.writerow([at, name, check.points, repr(check.p_value), check.verdict, camera.camera, *numbers, known])
    write_text(path, before + text.getvalue())
