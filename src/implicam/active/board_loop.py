"""The loop with a board at places that nobody knows: where to hold it next, and when to stop.

loop = BoardLoop(Explicit(), shape, rule=Within(1.2) | Pictures(60))
while not loop.stop:
    (target,) = loop.ask()
    loop.reset(...)                   # all pictures so far, as a dataset of corners
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.active.board_coverage import Framing, framing_of, is_new, third_of, unseen_framing, usual_pixels
from implicam.active.board_design import BoardDesign, BoardShape, board_pose
from implicam.active.design_model import Bools, PredictedCovariance
from implicam.active.loop import Target, summarise_step
from implicam.active.stopping import Budget, Never, Rule, Step
from implicam.active.volume_design import MAX_EXCESS_PART
from implicam.active.workspace import Workspace
from implicam.calibrators import Calibration, Calibrator, PredictsPixels, TellsContradictions
from implicam.dataset import Camera, Dataset, Floats
from implicam.dataset.boards import CORNER
from implicam.errors import FitError, ImplicamError, UsageError
from implicam.formatting import decimal_number
from implicam.geometry import Pose, look_at
from implicam.progress import Progress, silent
from implicam.threads import blas_threads

Ints = NDArray[np.intp]

MIN_BOARDS = 4
"""Pictures of a camera before it is worth a fit: Zhang's method takes three, and one may be wrong."""

CANDIDATES = 200
"""Poses that are tried for the next picture."""

WORTH_SHARE = 0.3
"""Of what the suggested pose would tell: a pose that tells as much is worth a picture."""


@dataclass(frozen=True)
class Pictures(Budget):
    """When all pictures of the budget are taken.

    Attributes:
        what: They show: boards, frames of a wand.
    """

    what: str = "boards"

    def progress(self, history: Sequence[Step], unit: str = "") -> str:
        """How far it is from stopping.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.
        """
        return super().progress(history, unit).replace("points", self.what)

    def met(self, history: Sequence[Step], unit: str = "") -> str:
        """Why to stop now: the budget is spent.

        Args:
            history: The steps so far.
            unit: Of lengths, for the words.

        Returns:
            The number in words; empty where it is smaller than `points`.
        """
        return f"all {self.points} {self.what} of the budget are taken" if super().met(history, unit) else ""


@dataclass(frozen=True, eq=False)
class BoardTarget(Target):
    """Where to hold the board next. xyz and uv: of its middle; NaN where no calibration says where that is.

    Attributes:
        outlines: (cameras,) of the board's rim, (k, 2) pixels each; None for a camera that it is not held for.
        corners: (cameras, n, 2) pixels of `BoardShape.some`; NaN likewise.
        words: How to hold it: "left third of cam2, left side 30 degrees away, 400 mm from it".
        why: Why there.
        pose: In the frame of the calibration; None where there is none.
        known: Whether the board is put exactly there, so that its corners are known points.
        held_out: Whether its picture judges the calibration, and is not used for it.
    """

    outlines: tuple[Floats | None, ...] = ()
    corners: Floats = field(default_factory=lambda: np.zeros((0, 0, 2)))
    words: str = ""
    why: str = ""
    pose: Pose | None = None
    known: bool = False
    held_out: bool = False


class CameraProgress(NamedTuple):
    """How far a camera is.

    Attributes:
        part: From 0, nothing, to 1, enough.
        boards: How many it has seen.
        words: In a few words.
    """

    part: float
    boards: int
    words: str


class Worth(NamedTuple):
    """What a picture of the board as it is now would tell: enough to be taken, over the target's gain (NaN where no
    calibration says it), and why not."""

    enough: bool
    share: float
    reason: str


@dataclass(eq=False)
class BoardLoop:
    """Active learning of a calibration from boards; it changes with each picture that it is told.

    Attributes:
        calibrator: The method, which takes a dataset of boards at places nobody knows: `explicit`.
        shape: The board.
        cameras: Those that look at it, with the size of their pictures.
        volume: Where positions have to be good, in the frame of the first camera; None for where a board of this size
            is seen well by two cameras.
        rule: When to stop, once all cameras are calibrated.
        seed: Of the poses that are tried, and of the judged places.
        guided: Whether the next pose is the one that tells most; if not, any of those tried, to compare with.
        data: All corners so far; None for none.
        history: One step for each board: the uncertainty over the volume.
        calibration: The last fit; None before there is one.
        problem: Why the last fit failed; None where it did not.
    """

    calibrator: Calibrator
    shape: BoardShape
    cameras: tuple[Camera, ...]
    volume: Workspace | None = None
    rule: Rule = field(default_factory=Never)
    seed: int = 0
    guided: bool = True
    data: Dataset | None = None

    def __post_init__(self) -> None:
        self.history: list[Step] = []
        self.calibration: Calibration | None = None
        self.problem: ImplicamError | None = None
        self.design: BoardDesign | None = None
        self.start = MIN_BOARDS
        self._started = time.monotonic()
        self._refused: list[tuple[Floats, str]] = []
        self._asked = 0
        self._framings: dict[tuple[str, str], Framing | None] = {}
        self._fitted = 0  # boards of the last fit; what there is beyond is a forecast
        if self.data is not None:
            self.reset(self.data)

    # what a session and its page ask of any loop

    @property
    def stop(self) -> str:
        """Why to stop, in words; empty where not yet, or where a camera is not calibrated."""
        if self.data is None:
            return ""
        return self._met() if isinstance(self.rule, Never) or not self._cold() else ""

    def _met(self) -> str:
        """Why to stop by the rule, in words: by what a fit has found, and not by what a board is expected to bring, nor
        by uncertainties of cameras that contradict each other. Boards are counted, whatever they say."""
        unit = "" if self.data is None else self.data.length_unit
        fitted = [step for step in self.history if step.points <= self._fitted]
        found = "" if self.contradictions else self.rule.met(fitted, unit)
        counted = [Step(step.points, seconds=step.seconds) for step in self.history[-1:]]
        return found or self.rule.met([*self.history[:-1], *counted], unit)

    @property
    def contradictions(self) -> tuple[str, ...]:
        """What the last fit says of cameras that contradict each other, in words; empty where they do not."""
        found = self.calibration
        return tuple(found.contradictions) if isinstance(found, TellsContradictions) else ()

    @property
    def forecast(self) -> bool:
        """Whether the last step of the history is expected of a board that no fit has seen yet."""
        return self._fitted < self.points

    @property
    def points(self) -> int:
        """How many boards there are."""
        return len(self._shots())

    @property
    def holds_out(self) -> bool:
        """Whether some boards judge the calibration, and are not used for it."""
        return False

    @property
    def predicted(self) -> PredictedCovariance | None:
        """The covariance at the judged places; None before there is a calibration."""
        return None if self.design is None else self.design.at_judged

    @property
    def judged_at(self) -> Floats:
        """(g, 3) the judged places, in the frame of the first camera."""
        return np.zeros((0, 3)) if self.design is None else self.design.judged.xyz

    @property
    def workspace(self) -> Workspace:
        """The volume in which positions have to be good; about a board before there is any."""
        if self.volume is not None:
            return self.volume
        if self.design is not None:
            return Workspace.hull(self.design.judged.xyz)
        size = self.shape.diagonal
        return Workspace.box([-size, -size, size], [size, size, 3 * size])

    def used(self, data: Dataset | None) -> Dataset | None:
        """What calibrates.

        Args:
            data: All corners.
        """
        return data

    def held_out(self, data: Dataset | None) -> Dataset | None:
        """What is kept to judge the calibration; None where nothing is.

        Args:
            data: All corners.
        """
        return None

    def refuse(self, xyz: Floats, reason: str) -> None:
        """Another pose is asked for instead of this one.

        Args:
            xyz: (3,) where the middle of the board was to be.
            reason: Why, in words.
        """
        self._refused.append((xyz, reason))

    def reset(self, data: Dataset | None, progress: Progress = silent) -> None:
        """Go on with these corners, and fit.

        Args:
            data: All corners from now on; None for none.
            progress: Called as the fit goes on.
        """
        self.data = data
        self.adopt(data, self.fit(data, progress))

    def fit(self, data: Dataset | None, progress: Progress = silent) -> Calibration | ImplicamError | None:
        """What these corners say of the rig; nothing of the loop changes.

        Args:
            data: All corners; None for none.
            progress: Called as the fit goes on.

        Returns:
            The calibration, why there is none, or None where it is too early.
        """
        if data is None or np.sum([len(shots) >= MIN_BOARDS for shots in _seen_by(data).values()]) < 2:
            return None
        try:
            return self.calibrator.fit(data, progress)
        except FitError as error:
            return error

    def adopt(self, data: Dataset | None, found: Calibration | ImplicamError | None) -> None:
        """Take what `fit` gave.

        Args:
            data: The corners that it was fitted to; others may have come meanwhile.
            found: What it gave.
        """
        self._fitted = len(shots_of(data))
        self.problem = found if isinstance(found, ImplicamError) else None
        self.calibration = None if isinstance(found, ImplicamError) else found
        self.design = self._designed()
        shots = shots_of(data)
        self._note(len(shots))
        for shot in self._shots()[len(shots) :]:
            self._learn(shot)

    def wants_fit(self, data: Dataset) -> bool:
        """Whether a fit to these corners is worth its time: any board more is.

        Args:
            data: All corners.
        """
        return True

    def tell(self, data: Dataset) -> None:
        """One board more, without a fit: what it adds is predicted.

        Args:
            data: All corners, those of the new board last.
        """
        self.data = data
        self._learn(self._shots()[-1])

    # where to hold it next

    def ask(self, number: int = 1, here: Floats | None = None) -> list[BoardTarget]:
        """Where to hold the board next.

        Args:
            number: One is all there is.
            here: Not used.
        """
        self._asked += 1
        cold = self._cold()
        if self.data is None or self.design is None:
            return [self._unseen(cold)]
        waiting = [c for c in cold if self._boards(c) < 2 * MIN_BOARDS]
        if waiting and self.guided and self._asked % 2:  # in turn with what tells most of the others
            return [self._unseen(waiting)]
        found = self._informative()
        return [found if found is not None else self._unseen(cold or list(range(len(self._names))))]

    def worth(self, views: Mapping[str, tuple[Ints, Floats]], target: BoardTarget | None) -> Worth:
        """Whether a picture of the board as the cameras see it now would tell enough.

        Args:
            views: Camera -> numbers (n,) of the corners that it sees, from 0, and their pixels (n, 2).
            target: What was asked for.
        """
        cold = [c for c in self._cold() if self._names[c] in views]
        for c in cold:
            name = self._names[c]
            numbers, uv = views[name]
            framing = framing_of(self.shape, self.shape.corners[numbers], uv, self._size(c))
            if framing is not None and is_new(framing, self._seen_framings(c)):
                return Worth(True, float("nan"), "")
        if self.design is None or not isinstance(self.calibration, PredictsPixels):
            why = "no camera has been shown it so, or was" if not cold else "this was shown already: hold it otherwise"
            return Worth(False, float("nan"), why if cold else "move it into the outline")
        gain = self._gain_of(views)
        best = target.score if target is not None and np.isfinite(target.score) else float("nan")
        share = gain / best if best > 0 else float("nan")
        if share >= WORTH_SHARE:
            return Worth(True, share, "")
        if not np.isfinite(share):
            return Worth(False, share, "hold it as the outline shows")
        outlines = () if target is None else target.outlines
        blind = [name for name, outline in zip(self._names, outlines, strict=False) if outline is not None]
        blind = [name for name in blind if name not in views]
        if blind and len(blind) < sum(outline is not None for outline in outlines):
            which = f"{', '.join(blind)} {'does' if len(blind) == 1 else 'do'} not see it"
            return Worth(False, share, f"{which}: so it tells {100 * share:.0f} % of what the outline would")
        return Worth(False, share, f"so it tells {100 * share:.0f} % of what the outline would: go on to the outline")

    def name_of(self, target: BoardTarget) -> str:
        """The name of a known pose; that of the picture, where the pose is not known.

        Args:
            target: What was asked for.
        """
        return target.name

    def camera_progress(self) -> list[CameraProgress]:
        """How far each camera is, in the order of the dataset."""
        return [self._progress_of(c) for c in range(len(self._names))]

    # private

    def _progress_of(self, c: int) -> CameraProgress:
        boards = self._boards(c)
        if c in self._cold() or self.design is None:
            words = f"{boards} of {MIN_BOARDS} boards" if boards < MIN_BOARDS else "shares no board with the others yet"
            if boards >= MIN_BOARDS and self.calibration is None:
                words = f"{boards} boards"
            return CameraProgress(0.4 * min(1.0, boards / MIN_BOARDS), boards, words)
        unknown = float(self.design.pixel_sd()[c])
        if not np.isfinite(unknown):
            return CameraProgress(0.4, boards, "sees nothing of the volume")
        part = 0.4 + 0.6 * min(1.0, MAX_EXCESS_PART / max(unknown, 1e-9))
        noise = float(self.design.pixel_noise()[c])
        now, enough = decimal_number(unknown * noise, 2), decimal_number(MAX_EXCESS_PART * noise, 2)
        return CameraProgress(part, boards, f"calibrated to {now} px" + (f", {enough} is enough" if part < 1 else ""))

    @property
    def _names(self) -> tuple[str, ...]:
        return tuple(camera.name for camera in self.cameras)

    def _size(self, c: int) -> tuple[int, int]:
        camera = self.cameras[c]
        assert camera.width is not None  # as a session has all
        assert camera.height is not None
        return camera.width, camera.height

    def _cold(self) -> list[int]:
        """The cameras that are not calibrated."""
        known = self.calibration.camera_names if isinstance(self.calibration, PredictsPixels) else ()
        return [c for c, name in enumerate(self._names) if name not in known]

    def _shots(self) -> list[str]:
        return shots_of(self.data)

    def _boards(self, c: int) -> int:
        return 0 if self.data is None else len(_seen_by(self.data)[self._names[c]])

    def _designed(self) -> BoardDesign | None:
        if not isinstance(self.calibration, PredictsPixels):
            return None
        xyz = None if self.volume is None else self.volume.judged(150, self.seed)
        try:
            with blas_threads(1):
                design = BoardDesign.of(self.calibration, self.shape, xyz, self.seed)
                _ = design.at_judged
        except (UsageError, np.linalg.LinAlgError) as error:
            self.problem = error if isinstance(error, UsageError) else None
            return None
        return design

    def _learn(self, shot: str) -> None:
        """What the last board adds, by what is known so far."""
        views = self._views_of(shot)
        if self.design is not None:
            pose, seen = self._held(views)
            if pose is not None:
                self.design = self.design.after(pose, seen)
        self._note(self._shots().index(shot) + 1)

    def _note(self, boards: int) -> None:
        self.history = [step for step in self.history if step.points < boards]
        if not boards:
            return
        passed = time.monotonic() - self._started
        self.history.append(
            Step(boards, seconds=passed) if self.predicted is None else summarise_step(self.predicted, boards, passed)
        )

    def _gain_of(self, views: Mapping[str, tuple[Ints, Floats]]) -> float:
        assert self.design is not None
        pose, seen = self._held(views)
        return 0.0 if pose is None else float(self.design.gains([pose], [seen])[0])

    def _held(self, views: Mapping[str, tuple[Ints, Floats]]) -> tuple[Pose | None, Bools]:
        """Where the board is by what the calibrated cameras see, and which of them do."""
        assert isinstance(self.calibration, PredictsPixels)
        uv = np.full((len(self.shape.corners), len(self._names), 2), np.nan)
        for c, name in enumerate(self._names):
            if name in views and name in self.calibration.camera_names:
                uv[views[name][0], c] = views[name][1]
        seen = np.isfinite(uv[..., 0]).any(axis=0)
        rows = np.flatnonzero(np.isfinite(uv[..., 0]).any(axis=1))
        try:
            return board_pose(self.calibration, self.shape.corners[rows], uv[rows]), seen
        except (FitError, np.linalg.LinAlgError):
            return None, seen

    def _views_of(self, shot: str) -> dict[str, tuple[Ints, Floats]]:
        assert self.data is not None
        rows, numbers = _corners_of(self.data, shot)
        uv = self.data.observations.uv[rows]
        views = {}
        for c, name in enumerate(self._names):
            there = np.isfinite(uv[:, c, 0])
            if there.any():
                views[name] = numbers[there], uv[there, c]
        return views

    def _seen_framings(self, c: int) -> list[Framing]:
        name = self._names[c]
        for shot in _seen_by(self.data)[name] if self.data is not None else ():
            if (name, shot) not in self._framings:
                numbers, uv = self._views_of(shot)[name]
                corners = self.shape.corners[numbers]
                self._framings[name, shot] = framing_of(self.shape, corners, uv, self._size(c))
        return [one for (of, _), one in self._framings.items() if of == name and one is not None]

    def _unseen(self, cameras: Sequence[int]) -> BoardTarget:
        """For the camera that has seen the fewest boards: what it has not been shown."""
        c = min(cameras, key=self._boards)
        name, size = self._names[c], self._size(c)
        framing = unseen_framing(self.shape, size, self._seen_framings(c))
        pose = framing.camera_from_board
        outlines = [None] * len(self._names)
        corners = np.full((len(self._names), len(self.shape.some()), 2), np.nan)
        corners[c] = usual_pixels(pose.apply(self.shape.some()), size)
        rim = usual_pixels(pose.apply(_densified(self.shape.outline)), size)
        boards = self._boards(c)
        why = f"{name} has seen no board at this place and tilt yet"
        if 0 < boards < MIN_BOARDS:
            why += f", and {boards} of the {MIN_BOARDS} boards that it needs"
        if boards >= MIN_BOARDS and self.calibration is not None:
            why = f"{name} shares no board with the others: hold it where another camera sees it too"
        elif boards >= MIN_BOARDS:
            why += "; the best are boards that other cameras see too"
        words = ", ".join(
            part for part in (third_of(framing.place, name), _tilted(framing.tilt), _near(framing.span)) if part
        )
        nowhere = np.full(3, np.nan)
        uv = np.full((len(self._names), 2), np.nan)
        uv[c] = framing.place * size
        made = tuple(rim if k == c else one for k, one in enumerate(outlines))
        return BoardTarget(f"p{self.points + 1:03d}", nowhere, uv, float("nan"), made, corners, words, why)

    def _informative(self) -> BoardTarget | None:
        """The pose that tells most; None where no camera would see any."""
        assert self.design is not None
        rng = np.random.default_rng([self.seed, self._asked, 22])
        with blas_threads(1):
            poses = self.design.candidates(CANDIDATES, rng)
            if not poses:
                return None
            gains = self.design.gains(poses)
        for xyz, _ in self._refused:
            for i, pose in enumerate(poses):
                if np.linalg.norm(pose.apply(self.shape.middle) - xyz) < 0.25 * self.shape.diagonal:
                    gains[i] = 0
        i = int(np.argmax(gains)) if self.guided else 0
        return self._target(poses[i], float(gains[i]))

    def _target(self, pose: Pose, gain: float) -> BoardTarget:
        assert self.design is not None
        assert self.data is not None
        assert isinstance(self.calibration, PredictsPixels)
        (seen,) = self.design.visible([pose])
        then = self.design.after(pose)
        known, later = self.design.pixel_sd(), then.pixel_sd()
        unit = self.data.length_unit
        sd, sd_then = (float(np.nanmedian(one.at_judged.sd)) for one in (self.design, then))
        with np.errstate(invalid="ignore", divide="ignore"):
            better = np.nan_to_num(known / later)
        helped = self._names[int(np.argmax(better))]
        before, then_too = f"{sd:.2g} {unit}", f"{sd_then:.2g} {unit}"
        what = "the typical uncertainty of a position (sd in 3D)"
        why = f"Of {CANDIDATES} poses it tells most, mostly about {helped}: {what} would go from {before} to {then_too}"
        if before == then_too:
            why = f"No board would tell much more: {what} would stay {before}"
        middle, none = pose.apply(self.shape.middle), np.zeros((0, 2))
        target = BoardTarget(f"p{self.points + 1:03d}", middle, none, gain, why=why, pose=pose)
        target = self._with_pixels(target, pose, seen)
        return replace(target, words=self._words(pose, seen, target.uv))

    def _with_pixels(self, target: BoardTarget, pose: Pose, seen: Bools) -> BoardTarget:
        """With where the cameras that see it see it."""
        assert isinstance(self.calibration, PredictsPixels)
        rim = self.calibration.predict(pose.apply(_densified(self.shape.outline)))
        some = self.calibration.predict(pose.apply(self.shape.some())).swapaxes(0, 1)
        middle = self.calibration.predict(pose.apply(self.shape.middle)[None])[0]
        return replace(
            target,
            uv=np.where(seen[:, None], middle, np.nan),
            outlines=tuple(rim[:, c] if seen[c] else None for c in range(len(seen))),
            corners=np.where(seen[:, None, None], some, np.nan),
        )

    def _words(self, pose: Pose, seen: Bools, uv: Floats) -> str:
        """Where to hold it, as the camera in whose picture it is largest says."""
        assert self.data is not None
        assert isinstance(self.calibration, PredictsPixels)
        middle = pose.apply(self.shape.middle)
        found = []
        for c in np.flatnonzero(seen):
            centre, rays = self.calibration.lines_of_sight(self._names[c], np.stack([uv[c], uv[c] - [0.0, 20.0]]))
            far = float(np.linalg.norm(middle - centre))
            cosine = float((middle - centre) @ pose.rotation[:, 2]) / far
            found.append((cosine / far**2, int(c), far, look_at(centre, middle, rays[1] - rays[0]).rotation))
        _, nearest, far, frame = max(found, key=lambda one: one[0])
        facing = frame @ pose.rotation
        place = uv[nearest] / np.array(self._size(nearest))
        turned = "upright" if abs(facing[1, 0]) > 0.7 else ""
        parts = (third_of(place, self._names[nearest]), _tilted(-facing[:2, 2]), turned)
        told = ", ".join(part for part in parts if part)
        return f"{told}, {decimal_number(far, 2)} {self.data.length_unit} from it"


def shots_of(data: Dataset | None) -> list[str]:
    """The boards of a dataset of corners, in their order.

    Args:
        data: None for none.
    """
    return [] if data is None else list(dict.fromkeys(_shot_and_number(str(point))[0] for point in data.points))


def _shot_and_number(point: str) -> tuple[str, int]:
    match = CORNER.fullmatch(point)
    assert match is not None  # as detectors of boards name them
    return match["shot"], int(match["number"]) - 1


def _corners_of(data: Dataset, shot: str) -> tuple[Ints, Ints]:
    """Rows and corner numbers of one board."""
    named = [(i, *_shot_and_number(str(point))) for i, point in enumerate(data.points)]
    found = np.array([(i, number) for i, of, number in named if of == shot], dtype=np.intp).reshape(-1, 2)
    return found[:, 0], found[:, 1]


def _seen_by(data: Dataset) -> dict[str, list[str]]:
    """Camera -> the shots in which it saw the board."""
    of = np.array([_shot_and_number(str(point))[0] for point in data.points])
    seen = data.observations.seen
    return {name: list(dict.fromkeys(of[seen[:, c]].tolist())) for c, name in enumerate(data.observations.camera_names)}


def _densified(rim: Floats, steps: int = 8) -> Floats:
    """(4 steps, 3) a closed line with points between its corners: lenses bend it."""
    part = np.arange(steps)[:, None] / steps
    return np.concatenate([a + part * (b - a) for a, b in zip(rim, np.roll(rim, -1, axis=0), strict=True)])


def _tilted(tilt: Floats) -> str:
    """Which side is farther away: a board that faces right has its right side behind."""
    angle = float(np.degrees(np.arcsin(np.clip(np.linalg.norm(tilt), 0, 1))))
    if angle < 8:
        return "facing it"
    least = 0.4 * float(np.linalg.norm(tilt))
    across = "" if abs(tilt[0]) < least else "left" if tilt[0] < 0 else "right"
    down = "" if abs(tilt[1]) < least else "upper" if tilt[1] < 0 else "lower"
    sides = " and ".join(side for side in (down, across) if side)
    return f"{sides} side tilted {angle:.0f}° away"


def _near(span: float) -> str:
    return f"so near that it fills {10 * round(10 * span)} % of the width"
