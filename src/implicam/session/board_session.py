"""A guided session with a board held by hand: nobody knows where it is, and nobody has to press a key.

    aim -> (held still, sharp, and telling enough) -> fitting -> aim ...   -> done

The outline in the pictures says where the board is to be held. A picture is taken by itself when the board is held
still there, or at the key wherever it is. It is on disk before anything is said; then the next outline is shown, by
what the board must have told, while the cameras are fitted again in the background.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from implicam.active.board_loop import BoardLoop, BoardTarget, Ints
from implicam.active.board_poses import HELD_OUT_COLUMN, POSE_COLUMN
from implicam.calibrators import Calibration
from implicam.dataset import Camera, Dataset, Floats, KnownPositions, Observations
from implicam.dataset.boards import corner_name
from implicam.detect.sharpness import edge_width
from implicam.errors import HardwareError, UsageError
from implicam.evaluation import evaluate, leave_out_shots
from implicam.geometry import Pose
from implicam.progress import Progress, silent
from implicam.report import ReportData, report_of, write_report
from implicam.session.board_report import write_board_report
from implicam.session.by_hand import ByHandController, ByHandState, Judgement
from implicam.session.controller import MAX_TARGETS_WITHOUT_BALL, Equipment, SessionController
from implicam.session.detections import Look
from implicam.session.journal import Session

_LOG = logging.getLogger(__name__)

STILL_PX = 1.0
"""So far a corner may have gone, in the median, between two looks at a board that is held still."""

STILL_SECONDS = 0.3
"""For so long it is held still, at least, before a picture is taken by itself."""

MAX_EDGE_PX = 6.0
"""Pixels from black to white, beyond which a picture is blurred."""

NOT_SEEN = "no camera sees the board"

MIN_CORNERS = 12
"""Of a view that `explicit` takes."""

MAX_REFUSED = 30
"""Looks in a row at which a session without anybody takes no picture, before it goes on to another pose."""


class Hand(Protocol):
    """What holds the board, where that is not a person: see `SimulatedHand`."""

    seconds: float
    """That it takes from one outline to the next."""

    def follow(self, corners: Floats, pixels: Floats) -> None:
        """Move to where the corners are seen at these pixels.

        Args:
            corners: (n, 3) on the board.
            pixels: (cameras, n, 2); NaN where nothing is asked for.
        """

    def put(self, pose: Pose) -> None:
        """Put the board exactly somewhere, as into a slot.

        Args:
            pose: world_from_board.
        """


@dataclass(frozen=True, eq=False)
class BoardState(ByHandState):
    """As `ByHandState`. off: pixels from the corners to the outline, NaN where that is not known."""

    off: float = float("nan")


class BoardController(ByHandController):
    """One session with a board, its equipment, and the loop that says where to hold it next."""

    loop: BoardLoop
    state: BoardState

    thing, things, where = "board", "boards", "hold it into the outline"

    def __init__(
        self,
        session: Session,
        equipment: Equipment,
        loop: BoardLoop,
        *,
        auto: bool = True,
        hand: Hand | None = None,
        background: bool = True,
    ) -> None:
        super().__init__(session, equipment, loop, BoardState(auto=auto), background=background)
        self._hand = hand
        self._last: dict[str, tuple[Ints, Floats]] = {}  # the look before
        self._still_since = 0.0

    # called by a page

    def go(self) -> None:
        """Take a picture now, as the board is held, or let the robot put it there first; UsageError with the reason
        where it would be of no use."""
        if self.equipment.robot.moves:
            super().go()
        else:
            self._take(asked=True)

    def _take_pictures(self, where: Floats, *, typed: Any = None, asks: bool = False) -> None:
        """The robot has put the board there."""
        self._take(asked=True, where=where)

    def set_auto(self, auto: bool) -> None:
        """Turn on or off that a picture is taken by itself; of a robot, that it goes on by itself.

        Args:
            auto: Whether it is.

        Raises:
            UsageError: The robot is one that needs a person, or this is a dry run.
        """
        if self.equipment.robot.moves:
            SessionController.set_auto(self, auto)
        else:
            super().set_auto(auto)

    def skip(self, reason: str = "skipped by hand") -> None:
        """Show another pose instead of this one.

        Args:
            reason: Kept in the session.

        Raises:
            UsageError: There is no target now.
        """
        target = self._require_target()
        with self._working("fitting", "choosing another pose"):
            if np.isfinite(target.xyz).all():
                self.session.skip(target.xyz, reason)
                self.loop.refuse(target.xyz, reason)
            self._aim()

    def step(self) -> None:
        """Take a picture, if the board is held so that it tells enough; or let the robot put it there."""
        if self.equipment.robot.moves:
            self._step_of_robot()
        elif self.state.phase == "aim" and self.state.judgement.ready:
            with suppress(UsageError):  # it moved just now: the next look says so
                self._take(asked=False)

    def _step_of_robot(self) -> None:
        if self.state.phase != "aim":
            return
        try:
            self._move()
            self._targets_without_ball = 0
        except UsageError as error:  # no picture of it was kept
            self._targets_without_ball += 1
            if self._targets_without_ball < MAX_TARGETS_WITHOUT_BALL:
                self.skip(error.what)
                return
            self._targets_without_ball = 0
            self._report_trouble(
                HardwareError(
                    f"no picture of the board was kept at {MAX_TARGETS_WITHOUT_BALL} places in a row.",
                    why=error.what,
                    fix="look at the pictures, and at how the board is said to be turned (--facing)",
                )
            )

    def run(self, progress: Progress = silent) -> Path | None:
        """Take picture after picture until a rule says stop or something fails, then finish; somebody holds the board.

        Args:
            progress: Told after each picture how many boards there are.

        Returns:
            The path of the calibration's file; None where something failed, or there is no calibration.
        """
        self.set_auto(True)
        self._background = False
        if self._hand is not None:
            self._hand.seconds = 0.0  # nobody watches
        if self.state.phase == "starting":
            self.start()
        refused = 0
        while self.state.auto and self.state.phase == "aim" and not self.state.stop and self.state.target is not None:
            before = self.loop.points
            if self.equipment.robot.moves:
                self.step()
                progress("boards", self.loop.points, max(self.loop.points, self.loop.start))
                continue
            self.live()
            known = isinstance(self.state.target, BoardTarget) and self.state.target.known
            if known and self.loop.calibration is None and self._hand is not None:
                self._take(asked=True)  # nothing can check yet where the simulated hand has put it: it is there
            else:
                self.step()
            progress("boards", self.loop.points, max(self.loop.points, self.loop.start))
            refused = 0 if self.loop.points > before else refused + 1
            if refused >= MAX_REFUSED:
                refused = 0
                self.skip("no picture of it came about")
        return self.finish() if self.state.phase == "aim" and self.loop.calibration is not None else None

    def live(self) -> None:
        """As of every session; and judge how the board is held."""
        before = self.state.looks
        super().live()
        if self.equipment.robot.moves:
            return  # it is on no way there before somebody lets it go
        if self.state.phase == "aim" and self.state.looks is not before:
            with self._loop_lock:
                judged = self._judge(self.state.looks)
            if self.state.phase == "aim":
                self._show(judgement=judged, off=self._off(self.state.looks))

    # private

    def _too_few(self) -> UsageError:
        return UsageError(
            f"{self.loop.points} boards are too few to calibrate.",
            why=str(self.loop.problem.what) if self.loop.problem else "",
            fix=f"show each camera {self.loop.start} boards or more, in half of them two cameras at once",
        )

    def _report(self, path: Path, calibration: Calibration, data: Dataset) -> ReportData:
        if data.known is None:
            return write_board_report(path, self.session.name, self.loop.calibrator, calibration, data)
        title, held = f"{self.session.name}: a board at known poses", self.loop.held_out(data)
        if held is None:
            said = report_of(leave_out_shots(self.loop.calibrator.fit, data), title)
        else:
            by = f"{_boards(held)} boards held out, by a calibration from {self.loop.points} others"
            said = report_of(evaluate(calibration, held), title, calibration=calibration, by=by)
        write_report(path, said)
        return said

    def _used(self, data: Dataset) -> Dataset:
        used = self.loop.used(data)
        assert used is not None  # there is a calibration
        return used

    def _also(self, data: Dataset) -> str:
        held = self.loop.held_out(data)
        return "" if held is None else f", and {_boards(held)} held out"

    def _aim(self, before: str = "") -> None:
        try:
            with self._loop_lock:
                (target,) = self.loop.ask()
        except UsageError as error:  # all known poses are taken
            self._show(phase="aim", target=None, message=f"{before}{error.what}")
            return
        target = replace(target, name=self.session.next_name())
        if self.equipment.robot.moves and target.pose is not None:
            target = replace(target, xyz=target.pose.translation)  # what the robot is sent to: corner 1
        self._last, self._still_since = {}, 0.0
        self._show(
            phase="aim", target=target, message=f"{before}{target.words}", problem=None, judgement=Judgement(False, ""),
            cameras=tuple(self.loop.camera_progress()),
        )  # fmt: skip
        if self._hand is not None and self.equipment.robot.moves:
            return  # it carries the board
        if self._hand is not None and target.known and target.pose is not None:
            self._hand.put(target.pose)
        elif self._hand is not None:
            self._hand.follow(self.loop.shape.some(), target.corners)

    def _take(self, *, asked: bool, where: Floats | None = None) -> None:
        """Take a set of pictures and keep it; UsageError with the reason where it is of no use. where: (3,) corner 1,
        as the robot says."""
        target = self._require_target()
        assert isinstance(target, BoardTarget)
        if self.equipment.dry_run:
            raise UsageError("this is a dry run: nothing moves, so nothing is kept.", fix="skip, to see the next place")
        column = self.loop.name_of(target)
        if where is not None and target.pose is not None:
            target = replace(target, pose=Pose(target.pose.rotation, where))
        before = self._last
        with self._camera_lock:
            if asked and self._each_when_it_likes:  # it may be elsewhere than at the last look
                before = self._views(self._detect_all(self._take_frames(None)))
            frames = self._take_frames(self.equipment.trigger)
        if where is not None:
            self._check_standing(where)
        looks = self._detect_all(frames)
        views = self._views(looks)
        moved = _moved(before, views)
        why = self._refusal(looks, views)
        if not why and asked and target.known:
            worth = self.loop.worth(views, target)
            if np.isfinite(worth.share) and not worth.enough:
                why = worth.reason
        if not why and (self._each_when_it_likes or not asked) and not moved <= STILL_PX:
            why = "it moved while the pictures were taken"
        if why:
            _LOG.info("%s not taken: %s", target.name, why)
            self._show(looks=looks, judgement=Judgement(False, why))
            cure = "hold the board still, in sight of a camera"
            if where is not None:
                cure = (
                    "look whether it sits firmly, is turned as --facing says, and has squares as large as was said: "
                    "measure several with a ruler"
                )
            raise UsageError(f"no picture was kept: {why}.", fix=cure)
        shot = self._make_shot(target, looks, column)
        pictures = {look.camera: look.frame.picture for look in looks if look.frame is not None}
        notes = {
            "target": target.xyz.tolist() if np.isfinite(target.xyz).all() else [],
            "asked": asked,
            "reasons": {look.camera: look.found.reason for look in looks if look.found.reason},
        }
        with self._working("fitting", "Keeping the pictures"):
            begun = time.monotonic()
            self.session.accept(shot, pictures=pictures, notes=notes)
            _LOG.info("%s accepted: on disk after %.3f s", target.name, time.monotonic() - begun)
            data = self.session.data
            assert data is not None
            with self._loop_lock:
                self.loop.tell(data)
            self._show(taken=self.state.taken + 1)
            self._show_loop()
            self._fit_behind()
            self._aim()

    def _judge(self, looks: Sequence[Look]) -> Judgement:
        """Of live pictures: whether to take one now."""
        now, views = time.monotonic(), self._views(looks)
        before = self._last
        self._last = views
        moved = _moved(before, views)
        if not moved <= STILL_PX:
            self._still_since = now
        why = self._refusal(looks, views)
        if why:
            return Judgement(False, why)
        if not np.isfinite(moved):
            return Judgement(False, "looking")
        if moved > STILL_PX:
            return Judgement(False, f"hold it still: it moves by {moved:.0f} px")
        if now - self._still_since < STILL_SECONDS and self._hand is None:
            return Judgement(False, "hold it still")
        target = self.state.target
        worth = self.loop.worth(views, target if isinstance(target, BoardTarget) else None)
        return Judgement(worth.enough, worth.reason)

    def _refusal(self, looks: Sequence[Look], views: Mapping[str, tuple[Ints, Floats]]) -> str:
        """Why a picture would be of no use; empty where it would."""
        if not views:
            some = [look.found.reason for look in looks if len(look.found)]
            return "too few corners are seen: show more of the board" if some else NOT_SEEN
        if not self.loop.shape.edges:
            return ""
        blurred = []
        for look in looks:
            if look.camera in views and look.frame is not None:
                numbers, uv = views[look.camera]
                width = edge_width(look.frame.picture, self.loop.shape.corners[numbers], uv)
                if width > MAX_EDGE_PX:
                    blurred.append(f"{look.camera}: its edges are {width:.1f} px wide")
        return f"blurred ({'; '.join(blurred)})" if len(blurred) == len(views) else ""

    def _views(self, looks: Sequence[Look]) -> dict[str, tuple[Ints, Floats]]:
        """Camera -> numbers and pixels of the corners that it sees, where they are enough."""
        return {
            look.camera: (np.array([_number(point) for point in look.found.points], dtype=np.intp), look.found.uv)
            for look in looks
            if len(look.found) >= MIN_CORNERS
        }

    def _off(self, looks: Sequence[Look]) -> float:
        """Mean pixels from the corners to where the outline has them."""
        target = self.state.target
        if not isinstance(target, BoardTarget):
            return float("nan")
        some = {tuple(corner): k for k, corner in enumerate(self.loop.shape.some().tolist())}
        index = [some.get(tuple(corner)) for corner in self.loop.shape.corners.tolist()]
        off = []
        for c, look in enumerate(looks):
            for point, uv in zip(look.found.points, look.found.uv, strict=True):
                k = index[_number(point)]
                if k is not None and np.isfinite(target.corners[c, k]).all():
                    off.append(float(np.linalg.norm(uv - target.corners[c, k])))
        return float(np.mean(off)) if off else float("nan")

    def _make_shot(self, target: BoardTarget, looks: Sequence[Look], pose: str) -> Dataset:
        """What the cameras see, as corners of one board; with their positions, where those are known."""
        name = target.name
        numbers = sorted({_number(point) for look in looks for point in look.found.points})
        row = {number: i for i, number in enumerate(numbers)}
        uv, sd = (np.full((len(numbers), len(looks), 2), np.nan) for _ in range(2))
        for c, look in enumerate(looks):
            for point, place, spread in zip(look.found.points, look.found.uv, look.found.sd, strict=True):
                uv[row[_number(point)], c], sd[row[_number(point)], c] = place, spread
        names = np.array([corner_name(name, number) for number in numbers])
        cameras: Sequence[Camera] = self.session.cameras
        known = None
        if target.known and target.pose is not None:
            xyz = target.pose.apply(self.loop.shape.corners[numbers])
            spread = np.broadcast_to(np.array(self.equipment.robot.sd, dtype=np.float64), xyz.shape)
            columns = {POSE_COLUMN: np.full(len(numbers), pose)}
            if self.loop.holds_out:
                columns[HELD_OUT_COLUMN] = np.full(len(numbers), "yes" if target.held_out else "")
            known = KnownPositions(np.full(len(numbers), name), xyz, spread, columns)
        return Dataset(self.session.name, self.session.length_unit, Observations(names, tuple(cameras), uv, sd), known)


def _boards(data: Dataset) -> int:
    return len(set(data.shots.tolist()))


def _number(point: str) -> int:
    return int(point.rpartition("-c")[2]) - 1


def _moved(before: Mapping[str, tuple[Ints, Floats]], now: Mapping[str, tuple[Ints, Floats]]) -> float:
    """Pixels by which the board has moved in the camera that shows it most, in the median of its corners; NaN where no
    camera shows it in both."""
    moved = []
    for camera, (numbers, uv) in now.items():
        if camera in before:
            _, i, j = np.intersect1d(numbers, before[camera][0], return_indices=True)
            if len(i):
                moved.append(float(np.median(np.linalg.norm(uv[i] - before[camera][1][j], axis=1))))
    return max(moved, default=float("nan"))
