"""Does a calibration still hold? From new views alone, and from known points where there are some.

`check_calibration` is what `implicam check` does; the mathematics is in `rig_model.movement`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.linalg import orth
from scipy.special import chdtrc

from implicam.calibrators import Calibration
from implicam.calibrators.protocol import RigCalibration
from implicam.dataset import Dataset, Floats, Observations
from implicam.derived import joint
from implicam.errors import DatasetError, UsageError
from implicam.files import write_text
from implicam.formatting import decimal_number, number_with_sd
from implicam.geometry import cross_matrices
from implicam.rig_model import NUMBERS, Check, Evidence, errors_with_and_without, find_repair

STANDS, MOVED, ONE_MOVED, SEVERAL, BIASED = "stands", "moved", "one moved", "several moved", "biased"
MIDWAY = "moved midway"
DISAGREE = "disagree"
"""Of cameras of whose errors nothing is known: these may always have been so large."""
UNSEEN = "A rig whose cameras all moved together looks the same to itself: only known points could show it."
NEVER_EXACT = (
    "Nothing is known of how exact these cameras were when they were calibrated, so it cannot be told whether they "
    "have moved since or were never more exact."
)
NUMBER_NAMES = ("tilt", "pan", "roll", "right", "down", "forward", "zoom")
"""Of a movement: turns about the camera's axes that point right, down and forward in its picture (degrees), shifts
along these (length unit), and the zoom (per cent)."""
MIN_POINTS = 20
"""That a check takes: with fewer a movement that matters would rarely show."""
MAX_KNOWN_POINTS = 400
"""Known points that are compared; of more, evenly many."""
MIN_KNOWN_POINTS = 4
"""To see a shift, a turn and a growth."""
MIN_RELATIVE_SPREAD = 1e-6
"""Of known points across a line, over their extent: with less a turn about it moves none of them."""
LOG_COLUMNS = (
    "time", "dataset", "points", "p_value", "verdict", "camera",
    *(name for number in NUMBER_NAMES for name in (number, f"sd_{number}")), "p_value_known",
    "length_unit",
)  # fmt: skip
_LOG_HEAD = ",".join(LOG_COLUMNS) + "\n"


@dataclass(frozen=True, eq=False)
class CameraMovement:
    """How a camera moved, if it alone did.

    Attributes:
        camera: Its name.
        step: (7,) as `NUMBER_NAMES` has them: degrees, the calibration's length unit, per cent.
        sd: (7,) their standard uncertainties.
        cov: (7, 7) their covariance.
    """

    camera: str
    step: Floats
    sd: Floats
    cov: Floats


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
class CalibrationRepair:
    """A calibration after one camera has moved, and what that costs: medians over the points that showed the movement
    of the standard uncertainty of a position (root of the mean over the axes, length unit).

    >>> import implicam as ic
    >>> rig = ic.simulated("bar6", points=60, seed=1)
    >>> known, later = rig.split(30, seed=0)
    >>> uv = later.observations.uv.copy()
    >>> uv[:, 2] += [6.0, -4.0]  # as if cam3 had turned
    >>> moved = ic.Dataset.from_arrays(uv, cameras=rig.cameras)
    >>> repair = ic.check_calibration(ic.ForwardGP().fit(known), moved).repair()
    >>> repair.moved.camera, repair.sd < repair.sd_without
    ('cam3', True)

    Attributes:
        calibration: With the camera where it stands now.
        moved: How it moved.
        sd_unmoved: If it had not moved.
        sd: As it is.
        sd_without: Without the camera; NaN where the others see too little.
    """

    calibration: RigCalibration
    moved: CameraMovement
    sd_unmoved: float
    sd: float
    sd_without: float

    def sentence(self) -> str:
        """What was done and what it costs, in words."""
        unit = self.calibration.data.length_unit
        least = min(x for x in (self.sd_unmoved, self.sd, self.sd_without) if np.isfinite(x))
        digits = max(0, 2 - int(np.floor(np.log10(least))))
        unmoved, now, without = (f"{x:.{digits}f}" for x in (self.sd_unmoved, self.sd, self.sd_without))
        left = f" (without the camera {without})" if np.isfinite(self.sd_without) else ""
        return (
            f"With {self.moved.camera} where it stands now, a position has a standard uncertainty of {now} {unit}"
            f"{left}; {unmoved} if it had not moved."
        )


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
        verdict: `stands`, `moved` (the first of `cameras`), `one moved` (of `candidates`), `moved midway` (while these
            views were taken, see `midway`), `several moved`, `biased` or `disagree`: nothing is known of the errors of
            the cameras, and whether one has moved cannot be told.
        p_value: That chance alone makes the views disagree as a movement would.
        cameras: Of each camera how it moved if it alone did, the likeliest first; none where hardly two views agree, or
            nothing is known of the errors of the cameras.
        candidates: Names of the cameras of which one moved.
        known: The comparison with known points; None where there are none.
        points: How many points were used.
        noise_ratio: Sd of what is left, whatever moved, over what the views state.
        length_unit: Of shifts.
        not_judged: Names of cameras that saw too little to say anything of them.
        found: The same in the working frame of the calibration, with all that it was found from.
        units: (7,) degrees, length units and per cent of a unit there.
        calibration: That was checked.
        dataset: Name of the data.
        midway: The camera that moved while the views were taken, and after how many points; None where none did.
    """

    verdict: str
    p_value: float
    cameras: tuple[CameraMovement, ...]
    candidates: tuple[str, ...]
    known: KnownPointsTest | None
    points: int
    noise_ratio: float
    length_unit: str
    not_judged: tuple[str, ...]
    found: Check = field(repr=False)
    units: Floats = field(repr=False)
    calibration: RigCalibration = field(repr=False)
    dataset: str = ""
    midway: tuple[str, int] | None = None

    @cached_property
    def noticed(self) -> dict[str, Floats]:
        """Camera -> (7,) what each number of `NUMBER_NAMES` alone would have to be for the camera to be named half the
        time; infinite where none would do."""
        numbers = {name: c for c, name in enumerate(self.calibration.camera_names)}
        return {one.camera: self.found.noticed[numbers[one.camera]] * self.units for one in self.cameras}

    @property
    def holds(self) -> bool:
        """Whether nothing speaks against the calibration."""
        return self.verdict == STANDS

    def repair(self) -> CalibrationRepair:
        """The calibration with the camera that moved where it stands now, from the same views.

        Returns:
            It, and what the movement costs.

        Raises:
            UsageError: No single camera is known to have moved, or the calibration cannot be repaired.
        """
        one = self.found.named
        if one is None or self.verdict != MOVED:
            raise UsageError(
                f"there is no camera to put right: the verdict is {self.verdict!r}.",
                why="only of a single camera that moved can the others say where it stands now",
                fix="go on measuring with it" if self.holds else "calibrate again with known points",
            )
        moved = self.cameras[0]
        told = (
            f"{moved.camera} {describe_movement(moved, self.length_unit)}, as {self.points} points of "
            f"{self.dataset!r} showed"
        )
        repair = find_repair(self.found, one, told)
        after = self.calibration.with_repair(repair)
        rig = self.found.rig
        sizes = errors_with_and_without(rig, after.map.posterior, one)
        scale = self.calibration.map.frame.scale
        usual = [float(np.nanmedian(size)) * scale if np.isfinite(size).any() else float("nan") for size in sizes]
        return CalibrationRepair(after, moved, *usual)

    def sentences(self) -> list[str]:
        """What was found, in words."""
        unit, names = self.length_unit, self.calibration.camera_names
        doubtful = ", ".join(names[c] for c in self.found.contradicting)
        if 2 * len(self.found.contradicting) > len(names):
            doubtful = "most cameras"
        moved = self.cameras[0] if self.verdict == MOVED else None
        said = {
            STANDS: f"Nothing speaks against the calibration (p = {decimal_number(self.p_value, 2)}).",
            MOVED: "" if moved is None else f"{moved.camera} has moved: {describe_movement(moved, unit)}.",
            ONE_MOVED: f"One of {' and '.join(self.candidates)} has moved; from these views nobody can say which.",
            MIDWAY: ""
            if self.midway is None
            else f"{self.midway[0]} moved while these points were taken, after about {self.midway[1]} of them; nothing "
            "else shows before and after. Check the two parts apart.",
            SEVERAL: "The rig is not as it was calibrated, and no single camera's movement explains it: several moved"
            + (f", or many views of {doubtful} are wrong detections." if doubtful else "."),
            BIASED: "The views agree with each other, but not with the known points: all cameras moved together, or "
            "the known points did.",
            DISAGREE: f"The views disagree by more than their noise (p = {decimal_number(self.p_value, 2)}). "
            + NEVER_EXACT,
        }[self.verdict]
        found = [said]
        if self.verdict == BIASED and not self.calibration.map.posterior.errors_known:
            found.append(NEVER_EXACT)
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
    rig = _require_cameras(calibration)
    seen = int(np.sum(np.isfinite(rig.map.matched_views(data)[0]).all(axis=2).sum(axis=1) >= 2))
    if 0 < seen < MIN_POINTS:
        raise DatasetError(
            f"two cameras or more saw {seen} point{'s' * (seen != 1)}; a check takes {MIN_POINTS} or more.",
            why="with so few it cannot be told whether the calibration still holds",
            fix="show the cameras more points; none of them need be known",
        )
    share = level / 2 if data.known is not None else level
    found = rig.map.movement(data, level=share)
    if found is None:
        raise DatasetError(
            "no two cameras saw enough of the same points.", fix="show the cameras more points, 20 or more that all see"
        )
    known = None if data.known is None else _known_points_test(rig, data)
    concluded = _conclude(rig, found, known, share, data.name)
    midway = _find_midway(rig, data, share / 2) if concluded.verdict == SEVERAL or _is_mixed(found) else None
    return concluded if midway is None else replace(concluded, verdict=MIDWAY, midway=midway)


MAX_LEFT_OUT, MAX_NOISE_RATIO = 0.1, 1.1
"""Part of a camera's views that contradict all others, and noise over what is stated: with more it is asked whether a
camera moved while the views were taken."""

SPLITS = (0.25, 0.5, 0.75)
"""Of the points, in the order of time: parts before and after which a camera stood differently."""

MAX_SAME_STAND = 24.3
"""Squared distance of two stands of one camera, of seven numbers, up to which they are one: p = 0.001."""


def _is_mixed(found: Check) -> bool:
    if not found.evidence:
        return False
    counts = found.rig.seen.sum(axis=0)
    lost = (counts - found.evidence[0].seen.sum(axis=0)) / np.maximum(counts, 1)
    return bool(lost.max() > MAX_LEFT_OUT or found.noise_ratio > MAX_NOISE_RATIO)


def _find_midway(rig: RigCalibration, data: Dataset, level: float) -> tuple[str, int] | None:
    """The camera that moved while the views were taken, their points being in the order of time, and after how many of
    them; None where the parts before and after do not tell of one camera."""
    uv, noise = rig.map.matched_views(data)
    best: tuple[float, int, int] | None = None
    for share in SPLITS:
        split = round(share * len(uv))
        if min(split, len(uv) - split) < MIN_POINTS:
            continue
        before, after = (
            rig.map.movement_in_views(uv[part], noise[part], level=level) for part in (slice(split), slice(split, None))
        )
        if before is None or after is None or before.several or after.several:
            continue
        named = {one.named.camera for one in (before, after) if one.named is not None}
        clear = all(named <= set(one.candidates) for one in (before, after) if one.alarm and one.named is None)
        if len(named) != 1 or not clear:
            continue
        camera = named.pop()
        stands = [one for part in (before, after) for one in part.evidence if one.camera == camera]
        if len(stands) < 2:
            continue
        step, cov = stands[1].step - stands[0].step, stands[0].cov + stands[1].cov
        unit = np.sqrt(np.diagonal(cov))
        ratio = max(before.noise_ratio, after.noise_ratio, 1.0)
        apart = float(step / unit @ np.linalg.solve(cov / np.outer(unit, unit), step / unit)) / ratio**2
        if apart > MAX_SAME_STAND and (best is None or apart > best[0]):
            best = apart, camera, split
    return None if best is None else (rig.map.camera_names[best[1]], best[2])


class CalibrationWatch:
    """Watches whether a calibration still holds, while points come in.

    Every few points the last ones are checked as `check_calibration` does, at a level so low that a rig that stands
    raises a false alarm once in `points_per_false_alarm` points or less often.

    >>> import implicam as ic
    >>> rig = ic.simulated("bar6", points=90, seed=1)
    >>> known, later = rig.split(30, seed=0)
    >>> watch = ic.CalibrationWatch(ic.ForwardGP().fit(known), window=40, every=20)
    >>> [watch.add(later.select([i])) for i in range(60)].count(None)
    60

    Args:
        calibration: Of `forward-gp` or `explicit`.
        window: Points that a check uses: more notice less, later.
        every: Points from one check to the next.
        points_per_false_alarm: How rare false alarms are to be.

    Raises:
        UsageError: The method has no cameras that could move, or a number makes no sense.
    """

    def __init__(
        self, calibration: Calibration, *, window: int = 60, every: int = 10, points_per_false_alarm: int = 10_000
    ) -> None:
        if not 1 <= every <= window or points_per_false_alarm <= every:
            raise UsageError(
                f"a watch of {window} points, every {every}, one false alarm in {points_per_false_alarm}, cannot be.",
                why="a check takes the points since the last one and more, and false alarms must be rarer than checks",
                fix="leave the numbers at their defaults: 60, 10, 10 000",
            )
        self.calibration = _require_cameras(calibration)
        self.window, self.every, self.level = window, every, every / points_per_false_alarm
        self.points = 0
        self.last: CalibrationCheck | None = None
        cameras = len(self.calibration.camera_names)
        self._uv, self._noise = np.zeros((0, cameras, 2)), np.zeros((0, cameras))
        self._since = 0

    def add(self, data: Dataset | Observations) -> CalibrationCheck | None:
        """Add points as they come.

        Args:
            data: What the cameras saw of one or more; names of points do not matter here, and positions are not used.

        Returns:
            The check that raised an alarm; None where there is none.

        Raises:
            DatasetError: None of the cameras is one of the calibration, or one has images of another size.
        """
        uv, noise = self.calibration.map.matched_views(data)
        alarm = None
        for start in range(0, len(uv), self.every):
            part = slice(start, start + self.every)
            self._uv = np.concatenate([self._uv, uv[part]])[-self.window :]
            self._noise = np.concatenate([self._noise, noise[part]])[-self.window :]
            self.points += len(uv[part])
            self._since += len(uv[part])
            if self._since >= self.every and len(self._uv) >= min(self.window, MIN_POINTS):
                self._since = 0
                found = self.calibration.map.movement_in_views(self._uv, self._noise, level=self.level)
                self.last = None if found is None else _conclude(self.calibration, found, None, self.level, "stream")
                alarm = self.last if self.last is not None and not self.last.holds else alarm
        return alarm


def _require_cameras(calibration: Calibration) -> RigCalibration:
    if isinstance(calibration, RigCalibration):
        return calibration
    raise UsageError(
        f"a calibration by {calibration.method} has no cameras that could have moved.",
        why="it maps the pixels of all cameras to a position, and cannot ask whether the views agree",
        fix="calibrate with forward-gp or explicit",
    )


def _conclude(
    calibration: RigCalibration, found: Check, known: KnownPointsTest | None, level: float, dataset: str
) -> CalibrationCheck:
    names, scale = calibration.map.camera_names, calibration.map.frame.scale
    units = np.array([*[np.degrees(1.0)] * 3, *[scale] * 3, 100.0])
    assert len(units) == NUMBERS
    cameras = tuple(_in_units(one, names, units, found.noise_ratio) for one in found.evidence)
    judged = {one.camera for one in cameras}
    verdict, errors_known = _verdict(found, known, level), calibration.map.posterior.errors_known
    return CalibrationCheck(
        verdict if errors_known or verdict in (STANDS, BIASED) else DISAGREE,
        found.p_value,
        cameras if errors_known else (),
        tuple(names[c] for c in found.candidates) if errors_known else (),
        known,
        found.points,
        found.noise_ratio,
        calibration.data.length_unit,
        tuple(name for name in names if name not in judged) if judged else (),
        found,
        units,
        calibration,
        dataset,
    )


def _verdict(found: Check, known: KnownPointsTest | None, level: float) -> str:
    if found.several:
        return SEVERAL
    if found.named is not None:
        return MOVED
    if found.candidates:
        return ONE_MOVED
    return BIASED if known is not None and known.p_value < level else STANDS


def _in_units(one: Evidence, names: Sequence[str], units: Floats, noise_ratio: float) -> CameraMovement:
    cov = one.cov * np.outer(units, units) * max(noise_ratio**2, 1.0)
    return CameraMovement(names[one.camera], one.step * units, np.sqrt(np.diagonal(cov)), cov)


def _known_points_test(calibration: RigCalibration, data: Dataset) -> KnownPointsTest | None:
    """A few numbers that a bias shows in, and not all errors together: of many points these would tell a noise that is
    stated a few per cent too small from chance."""
    measured = calibration.measure(data.observations)
    if data.known is not None and data.length_unit != measured.length_unit:
        data = data.in_unit(measured.length_unit)
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


def read_log(path: Path) -> list[dict[str, str]]:
    """A history of checks.

    Args:
        path: The table, as `append_to_log` writes it.

    Returns:
        A row for each check and camera, column -> text.

    Raises:
        DatasetError: The file is something else.
    """
    text = path.read_text(encoding="utf-8", errors="replace")
    rows = list(csv.DictReader(io.StringIO(text)))
    if not text.startswith(_LOG_HEAD) or any(None in row or None in row.values() for row in rows):
        raise DatasetError(f"{path} is no history of checks.", fix="give another name for it")
    return rows


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
    before = _LOG_HEAD
    if path.is_file():
        read_log(path)
        before = path.read_text(encoding="utf-8")
    at = (now or datetime.now(UTC)).isoformat(timespec="seconds")
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    known = "" if check.known is None else repr(check.known.p_value)
    unknown = np.full(NUMBERS, np.nan)
    nothing = [CameraMovement(name, unknown, unknown, np.diag(unknown)) for name in check.calibration.camera_names]
    for camera in check.cameras or nothing:
        numbers = [repr(float(value)) for pair in zip(camera.step, camera.sd, strict=True) for value in pair]
        rows.writerow(
            [
                at,
                name,
                check.points,
                repr(check.p_value),
                check.verdict,
                camera.camera,
                *numbers,
                known,
                check.length_unit,
            ]
        )
    write_text(path, before + text.getvalue())
