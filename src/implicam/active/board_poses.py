"""A board at poses that are known: in the slots of a block, or on a slide. Its corners are known points of any method.

poses.csv has a row for each pose, in the order in which they are gone through:

    pose, x, y, z              its name, and where corner 1 of the board is, in the world
    nx, ny, nz                 the normal of its printed side, towards the cameras; rows lie as near to x as they can
    rx, ry, rz                 instead: its whole turn, world_from_board, a rotation vector in radians (OpenCV's rvec)

Without either, rows lie along x and columns along y, as on a slide along z.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from implicam.active.board_design import BoardDesign, PlacedBoardDesign
from implicam.active.board_loop import BoardLoop, BoardTarget, CameraProgress, Ints, Worth, shots_of
from implicam.active.design_model import Places, PredictedCovariance, can_design_experiments, design_model_of
from implicam.active.loop import summarise_step
from implicam.active.stopping import Step
from implicam.active.workspace import Workspace, lattice_places
from implicam.calibrators import Calibration, PredictsPixels
from implicam.dataset import Dataset, Floats
from implicam.errors import FitError, ImplicamError, UsageError
from implicam.geometry import Pose, rotation_from_vector
from implicam.progress import Progress, silent
from implicam.rig_model import MIN_POINTS_PER_CAMERA
from implicam.threads import blas_threads

POSE_COLUMN = "pose"
"""The column of points.csv that says at which of the known poses a board was."""

HELD_OUT_COLUMN = "held_out"
"""The column of points.csv that says "yes" of a board that does not calibrate, but judges."""

ENOUGH_EXCESS = 1.2
"""Times what pixel noise leaves of a position's uncertainty: then the bar of a camera is full."""

ROBOT_CANDIDATES = 60
"""Of the places where a robot can put the board: so many are weighed for the next picture."""

MAX_POSES = 1000

MAX_OFF_PX, MAX_OFF_SDS = 3.0, 6.0
"""From where a calibration must see the corners of a known pose, beyond which the board is somewhere else: pixels, or
standard deviations of what it predicts where these are more."""

MIN_MOVED_PX = 3.0
"""Pixels that a board must have moved since the picture before, in a camera: else it is still in the slot before."""


class KnownPose(NamedTuple):
    """Its name, and world_from_board: where corner 1 of the board is, and how it is turned."""

    name: str
    pose: Pose


def poses_from(text: str) -> tuple[KnownPose, ...]:
    """The poses that an argument of the command line stands for.

    Args:
        text: A CSV file as above; or the places of corner 1 on a slide or in a block, `x=0 y=0 z=0:190:10`.

    Raises:
        UsageError: The text or the file cannot be read, two poses have one name, or there are fewer than two.
    """
    if text.lower().endswith(".csv"):
        found = _read_poses(Path(text))
    else:
        places = lattice_places(text, "--poses")
        found = [KnownPose(f"pose{k + 1:02d}", Pose(np.eye(3), xyz)) for k, xyz in enumerate(places)]
    names = [one.name for one in found]
    if not 2 <= len(found) <= MAX_POSES or len(set(names)) < len(names):
        twice = next((name for name in names if names.count(name) > 1), None)
        raise UsageError(
            f"{text}: {len(found)} poses" + (f", {twice!r} twice." if twice else "."),
            fix=f"give from 2 to {MAX_POSES} poses, each with its own name",
        )
    return tuple(found)


def _read_poses(path: Path) -> list[KnownPose]:
    try:
        rows = list(csv.DictReader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"the poses {path} cannot be read.", why=str(error), fix="give a CSV file") from error
    columns = set(rows[0]) if rows else set()
    turned = [axes for axes in (("nx", "ny", "nz"), ("rx", "ry", "rz")) if set(axes) & columns]
    if not {"x", "y", "z"} <= columns or len(turned) > 1 or any(not set(axes) <= columns for axes in turned):
        raise UsageError(
            f"{path} has the columns {', '.join(map(str, sorted(columns, key=str))) or 'none'}.",
            fix="give pose,x,y,z and, where rows do not lie along x and columns along y, nx,ny,nz or rx,ry,rz",
        )
    found = []
    for number, row in enumerate(rows, start=1):
        try:
            place = np.array([float(row[axis]) for axis in "xyz"])
            turn = np.array([float(row[axis]) for axis in turned[0]]) if turned else None
            if not np.isfinite(place).all() or (turn is not None and not np.isfinite(turn).all()):
                raise ValueError("a number is not finite")
            rotation = np.eye(3) if turn is None else _rotation(turned[0][0], turn)
        except (TypeError, ValueError) as error:
            raise UsageError(
                f"{path}, row {number + 1}: this is no pose.", why=str(error), fix="give numbers in the dataset's unit"
            ) from error
        found.append(KnownPose(str(row.get("pose") or f"pose{number:02d}"), Pose(rotation, place)))
    return found


def _rotation(kind: str, turn: Floats) -> Floats:
    """(3, 3) world_from_board of a rotation vector, or of the normal of the printed side: the board's -z."""
    if kind == "rx":
        return rotation_from_vector(turn)
    length = float(np.linalg.norm(turn))
    if length == 0:
        raise ValueError("the normal is zero")
    away = -turn / length
    right = np.eye(3)[0] - away[0] * away
    if np.linalg.norm(right) < 1e-6:
        raise ValueError("the normal lies along x, so the turn in its plane is not known: give rx, ry, rz")
    right = right / np.linalg.norm(right)
    return np.column_stack([right, np.cross(away, right), away])


@dataclass(eq=False)
class KnownPosesLoop(BoardLoop):
    """The loop of a board at known poses; corners are known points then.

    Attributes:
        poses: In their order.
        free: Whether they are only where the board can be, as in the hands of a robot: the next is the one that tells
            most, until the rule says stop. If not, the board goes through all of them, one after the other.
        placed_sd: Standard uncertainty of where the board is put, along each axis.
        hold_out: So many boards are not used to calibrate, but to judge the calibration in the report: of poses in
            their order, spread evenly; of free ones, at random places once the others are enough.
    """

    poses: tuple[KnownPose, ...] = ()
    free: bool = False
    placed_sd: float = 0.0
    hold_out: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.hold_out < len(self.poses) - 1:
            raise UsageError(
                f"{self.hold_out} of {len(self.poses)} poses cannot be held out.",
                why="two poses or more calibrate",
                fix="give more poses, or hold out fewer",
            )
        step = len(self.poses) / max(self.hold_out, 1)
        self._judging = set() if self.free else {int((k + 0.5) * step) for k in range(self.hold_out)}
        self.held: Dataset | None = None
        corners = np.concatenate([one.pose.apply(self.shape.corners) for one in self.poses])
        self._swept = Workspace.hull(corners)
        self._predicted: PredictedCovariance | None = None
        self._skipped: set[str] = set()
        self._asked_design: BoardDesign | None = None
        super().__post_init__()

    @property
    def taken(self) -> list[str]:
        """The names of the poses at which there is a picture."""
        return [*_poses_in(self.data), *_poses_in(self.held)]

    @property
    def holds_out(self) -> bool:
        """Whether some boards judge the calibration, and are not used for it."""
        return self.hold_out > 0

    def used(self, data: Dataset | None) -> Dataset | None:
        """What calibrates: all corners but those of boards that are held out.

        Args:
            data: All corners.
        """
        if data is None or data.known is None or HELD_OUT_COLUMN not in data.known.extra:
            return data
        keep = data.known.extra[HELD_OUT_COLUMN] == ""
        return data.select(keep) if keep.any() else None

    def held_out(self, data: Dataset | None) -> Dataset | None:
        """The corners of boards that are held out; None where there are none.

        Args:
            data: All corners.
        """
        if data is None or data.known is None or HELD_OUT_COLUMN not in data.known.extra:
            return None
        out = data.known.extra[HELD_OUT_COLUMN] != ""
        return data.select(out) if out.any() else None

    @property
    def stop(self) -> str:
        """Why to stop: a rule says so, or all poses are taken; and the boards that are held out are there."""
        enough = self._enough()
        if not enough or self._held_left():
            return ""
        return f"{enough}, and {self.hold_out} more are held out" if self.hold_out else enough

    def _enough(self) -> str:
        """Why no more boards are needed to calibrate."""
        if self.data is None:
            return ""
        left = [one for one in self._left() if not self._judges(one)]
        count = len(self.poses) - len(self._judging)
        spent = f"all {count} poses are taken" if not left else ""
        if left and self._skipped and all(one.name in self._skipped for one in left):
            spent = f"{count - len(left)} of {count} poses are taken, and the others left out"
        return spent or self._met()

    def _judges(self, one: KnownPose) -> bool:
        """Whether a pose of those in their order is held out."""
        return bool(self._judging) and self.poses.index(one) in self._judging

    def _held_left(self) -> int:
        """How many boards are to be held out yet."""
        if self.free:
            return max(self.hold_out - len(_poses_in(self.held)), 0)
        return sum(self._judges(one) and one.name not in self._skipped for one in self._left())

    @property
    def predicted(self) -> PredictedCovariance | None:
        """The covariance at the judged places; None before there is a calibration, or where the method says none."""
        return self._predicted

    @property
    def judged_at(self) -> Floats:
        """(g, 3) the judged places, in the world."""
        return self.workspace.judged(150, self.seed)

    @property
    def workspace(self) -> Workspace:
        """The volume in which positions have to be good: what the board sweeps, where nothing else was said."""
        return self.volume if self.volume is not None else self._swept

    def refuse(self, xyz: Floats, reason: str) -> None:
        """A pose is left out.

        Args:
            xyz: (3,) where corner 1 or the middle of the board was to be; the next pose where none is there.
            reason: Not used.
        """
        left = [one for one in self._left() if one.name not in self._skipped]
        there = [one for one in left if _is_at(one.pose, self.shape.middle, xyz)]
        if there or left:
            self._skipped.add((there or left)[0].name)

    def reset(self, data: Dataset | None, progress: Progress = silent) -> None:
        """Go on with these corners, and fit.

        Args:
            data: All corners from now on; None for none.
            progress: Called as the fit goes on.
        """
        self.held = self.held_out(data)
        super().reset(self.used(data), progress)

    def adopt(self, data: Dataset | None, found: Calibration | ImplicamError | None) -> None:
        """Take what `fit` gave.

        Args:
            data: The corners that it was fitted to; others may have come meanwhile.
            found: What it gave.
        """
        super().adopt(self.used(data), found)

    def tell(self, data: Dataset) -> None:
        """One board more, without a fit.

        Args:
            data: All corners, those of the new board last.
        """
        self.held, used = self.held_out(data), self.used(data)
        if used is not None and len(shots_of(used)) > self.points:
            super().tell(used)

    def fit(self, data: Dataset | None, progress: Progress = silent) -> Calibration | ImplicamError | None:
        """What these corners say of the rig; nothing of the loop changes.

        Args:
            data: Corners of boards at known poses; None for none.
            progress: Called as the fit goes on.

        Returns:
            The calibration, why there is none, or None where it is too early.
        """
        data = self.used(data)
        if data is None or data.known is None or len(data) < MIN_POINTS_PER_CAMERA:
            return None
        if len(set(data.known.shots.tolist())) < 2:
            return None  # one plane says nothing of depth
        try:
            return self.calibrator.fit(data, progress)
        except FitError as error:
            return error

    def ask(self, number: int = 1, here: Floats | None = None) -> list[BoardTarget]:
        """The next pose.

        Args:
            number: One is all there is.
            here: Not used.

        Raises:
            UsageError: None is left.
        """
        left = [one for one in self._left() if one.name not in self._skipped] or self._left()
        if not left:
            raise UsageError(f"all {len(self.poses)} poses are taken.", fix="finish, or take one back")
        if self.free:
            return [self._of_a_robot(left)]
        one = left[0]
        place = 1 + self.poses.index(one)
        normal = -one.pose.rotation[:, 2]
        facing = ", ".join(f"{value:.2g}" for value in np.round(normal, 9) + 0.0)
        words = f"pose {place} of {len(self.poses)}: {one.name}, {_corner(one.pose)}, facing ({facing})"
        target = self._target_of(one, words, "press the key when it is there")
        return [self._judging_one(target) if self._judges(one) else target]

    def _target_of(self, one: KnownPose, words: str, why: str, gain: float = np.nan) -> BoardTarget:
        nowhere = tuple(None for _ in self.cameras)
        corners = np.full((len(self.cameras), len(self.shape.some()), 2), np.nan)
        target = BoardTarget(
            one.name, one.pose.apply(self.shape.middle), corners[:, 0], gain, nowhere, corners, words, why, one.pose,
            known=True,
        )  # fmt: skip
        return self._outlined(target, one.pose)

    def _judging_one(self, target: BoardTarget) -> BoardTarget:
        """The board is not used to calibrate."""
        number = 1 + self.hold_out - self._held_left()
        told = f"held-out board {number} of {self.hold_out}: it judges the calibration, and is not used for it"
        return replace(target, words=f"{target.words} ({told})", why=told, held_out=True)

    def _of_a_robot(self, left: Sequence[KnownPose]) -> BoardTarget:
        """Where a robot is to put the board: where it tells most; once that is enough, anywhere, to be held out."""
        self._asked += 1
        rng = np.random.default_rng([self.seed, self._asked, 23])
        if self._held_left() and self._enough():
            one = left[int(rng.integers(len(left)))]
            return self._judging_one(self._target_of(one, _corner(one.pose), ""))
        self._asked_design = self._asked_design or self._design_now()
        if self._asked_design is None or not self.guided:
            one = self._farthest(left) if self.guided else left[int(rng.integers(len(left)))]
            return self._target_of(one, _corner(one.pose), "the first places are spread through the workspace")
        some = [left[k] for k in rng.permutation(len(left))[:ROBOT_CANDIDATES]]
        with blas_threads(1):
            gains = self._asked_design.gains([one.pose for one in some])
        k = int(np.argmax(gains))
        why = f"of {len(some)} places this one tells most" if gains[k] > 0 else "no place would tell much more"
        return self._target_of(some[k], _corner(some[k].pose), why, float(gains[k]))

    def _farthest(self, left: Sequence[KnownPose]) -> KnownPose:
        """The pose farthest from those that were taken or left out; at first that nearest to the middle of all."""
        places = np.array([one.pose.translation for one in left])
        done = {*self.taken, *self._skipped}
        known = np.array([one.pose.translation for one in self.poses if one.name in done]).reshape(-1, 3)
        if not len(known):
            return left[int(np.argmin(np.linalg.norm(places - (places.min(axis=0) + places.max(axis=0)) / 2, axis=1)))]
        away = np.linalg.norm(places[:, None] - known, axis=2).min(axis=1)
        return left[int(np.argmax(away))]

    def _design_now(self) -> BoardDesign | None:
        """What the calibration knows, and what a board that is put somewhere would add; None where it is not known."""
        found = self.calibration
        if not isinstance(found, PredictsPixels) or self._cold():
            return None
        try:
            judged = Places.predicted(found, self.judged_at)
            return PlacedBoardDesign(found, judged, shape=self.shape, placed_sd=self.placed_sd)
        except UsageError as error:
            self.problem = error
            return None

    def name_of(self, target: BoardTarget) -> str:
        """The name of a known pose.

        Args:
            target: What was asked for.
        """
        return next(one.name for one in self.poses if one.pose is target.pose)

    def worth(self, views: Mapping[str, tuple[Ints, Floats]], target: BoardTarget | None) -> Worth:
        """Whether the board is where it is to be: by a calibration of the poses before, and moved since the last one.

        Args:
            views: Camera -> numbers (n,) of the corners that it sees, from 0, and their pixels (n, 2).
            target: What was asked for.
        """
        off = self.off(views, target)
        if not np.isfinite(off):
            return Worth(False, off, "press the key when it is there: nothing can check it yet")
        if off > self._may_be_off(target):
            return Worth(False, off, f"it is {off:.0f} px from where this pose must be")
        return Worth(True, off, "") if self._moved(views) else Worth(False, off, "move it on to this pose")

    def off(self, views: Mapping[str, tuple[Ints, Floats]], target: BoardTarget | None) -> float:
        """Pixels from the corners to where they must be at a known pose, in the median.

        Args:
            views: As of `worth`.
            target: The pose.

        Returns:
            NaN where no calibration says it.
        """
        if target is None or target.pose is None or not isinstance(self.calibration, PredictsPixels):
            return float("nan")
        uv = self.calibration.predict(target.pose.apply(self.shape.corners))
        away = [
            np.linalg.norm(uv[numbers, self._names.index(name)] - seen, axis=1)
            for name, (numbers, seen) in views.items()
        ]
        found = np.concatenate([np.zeros(0), *away])
        found = found[np.isfinite(found)]
        return float(np.median(found)) if len(found) else float("nan")

    def camera_progress(self) -> list[CameraProgress]:
        """How far each camera is: by the poses at which it has seen the board."""
        found = []
        for c in range(len(self.cameras)):
            boards = self._boards(c)
            part = min(1.0, boards / len(self.poses))
            if self.free:  # by what pixel noise leaves, of all cameras together
                reached = self.history[-1].excess if self.history else np.nan
                part = min(1.0, ENOUGH_EXCESS / reached) if reached > 0 else 0.0
            calibrated = c not in self._cold()
            part = 0.4 + 0.6 * part if calibrated else min(0.4, part)
            told = f"{boards} board{'s' * (boards != 1)}" if self.free else f"{boards} of {len(self.poses)} poses"
            found.append(CameraProgress(part, boards, told))
        return found

    # private

    def _left(self) -> list[KnownPose]:
        taken = set(self.taken)
        return [one for one in self.poses if one.name not in taken]

    def _may_be_off(self, target: BoardTarget | None) -> float:
        """Pixels by which a calibration of few boards may be wrong about a pose."""
        assert isinstance(self.calibration, PredictsPixels)
        assert target is not None
        assert target.pose is not None
        variances = [
            np.sum(part.half**2, axis=2) + part.noise + part.rest
            for part in self.calibration.sensitivities(target.pose.apply(self.shape.some()))
        ]
        spread = np.sqrt(np.nanmedian(np.concatenate([one.ravel() for one in variances])))
        return max(MAX_OFF_PX, MAX_OFF_SDS * float(spread))

    def _moved(self, views: Mapping[str, tuple[Ints, Floats]]) -> bool:
        shots = self._shots()
        before = self._views_of(shots[-1]) if shots else {}
        for name, (numbers, uv) in views.items():
            if name in before:
                _, i, j = np.intersect1d(numbers, before[name][0], return_indices=True)
                if len(i) and np.median(np.linalg.norm(uv[i] - before[name][1][j], axis=1)) > MIN_MOVED_PX:
                    return True
        return not any(name in before for name in views)

    def _outlined(self, target: BoardTarget, pose: Pose) -> BoardTarget:
        """With where the cameras see it, as soon as a calibration says so."""
        if not isinstance(self.calibration, PredictsPixels):
            return target
        design = BoardDesign.of(self.calibration, self.shape, self.judged_at)
        seen = design.visible([pose])[0]
        made = self._with_pixels(target, pose, np.asarray(seen))
        if self.free:
            return made
        return replace(made, why="a picture is taken by itself where the cameras see it there, held still")

    def _designed(self) -> BoardDesign | None:
        """Nothing to choose: the poses are given. What positions will be good for is said as of known points."""
        self._predicted = self._asked_design = None
        if self.calibration is None or not can_design_experiments(self.calibration):
            return None
        if not isinstance(self.calibration, PredictsPixels):
            return None
        try:
            with blas_threads(1):
                judged = self.judged_at
                self._predicted = design_model_of(self.calibration, judged[:0], judged).at_judged
        except (UsageError, FitError) as error:
            self.problem = error
        return None

    def _learn(self, shot: str) -> None:
        self._note(len(self._shots()))

    def _note(self, boards: int) -> None:
        self.history = [step for step in self.history if step.points < boards]
        if boards:
            passed = time.monotonic() - self._started
            known = self._predicted
            self.history.append(
                Step(boards, seconds=passed) if known is None else summarise_step(known, boards, passed)
            )


def carried_poses(positions: Floats, rotation: Floats) -> tuple[KnownPose, ...]:
    """The poses of a board that a robot carries without turning it.

    Args:
        positions: (n, 3) of corner 1, in the world.
        rotation: (3, 3) world_from_board.
    """
    return tuple(KnownPose(f"place{k + 1:03d}", Pose(rotation, xyz)) for k, xyz in enumerate(positions))


def turn_from(text: str, option: str) -> Floats:
    """How a board is turned, from the words of a command line.

    Args:
        text: "nx,ny,nz", the normal of the printed side, towards the cameras; or "r:rx,ry,rz", a rotation vector.
        option: That the error names.

    Returns:
        (3, 3) world_from_board.

    Raises:
        UsageError: It is neither.
    """
    kind, _, numbers = text.rpartition(":")
    try:
        turn = np.array([float(part) for part in numbers.split(",")])
        if turn.shape != (3,) or not np.isfinite(turn).all() or kind not in ("", "r"):
            raise ValueError("it takes three numbers")
        return _rotation("rx" if kind else "nx", turn)
    except ValueError as error:
        raise UsageError(
            f"{text!r} does not say how the board is turned.",
            why=str(error),
            fix=f"write {option}=0,0,-1, the normal of its printed side; or {option}=r:0.1,0,0, its whole turn",
        ) from error


def _poses_in(data: Dataset | None) -> list[str]:
    return [] if data is None or data.known is None else list(dict.fromkeys(data.known.extra[POSE_COLUMN].tolist()))


def _is_at(pose: Pose, middle: Floats, xyz: Floats) -> bool:
    return any(np.allclose(place, xyz, rtol=1e-9, atol=1e-9) for place in (pose.translation, pose.apply(middle)))


def _corner(pose: Pose) -> str:
    told = ", ".join(f"{axis} {value:.5g}" for axis, value in zip("xyz", pose.translation, strict=True))
    return f"corner 1 at {told}"


def described(poses: Sequence[KnownPose]) -> list[list[object]]:
    """Poses as plain values, for the settings of a session.

    Args:
        poses: In their order.
    """
    return [[one.name, one.pose.rotation.tolist(), one.pose.translation.tolist()] for one in poses]


def poses_of(rows: Sequence[Sequence[object]]) -> tuple[KnownPose, ...]:
    """The inverse of `described`.

    Args:
        rows: Plain values.
    """
    return tuple(
        KnownPose(str(name), Pose(np.array(turn, dtype=np.float64), np.array(place, dtype=np.float64)))
        for name, turn, place in rows
    )
