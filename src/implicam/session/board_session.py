"""A guided session with a board held by hand: nobody knows where it is, and nobody has to press a key.

    aim -> (held still, sharp, and telling enough) -> fitting -> aim ...   -> done

The outline in the pictures says where the board is to be held. A picture is taken by itself when the board is held
still there, or at the key wherever it is. It is on disk before anything is said; then the next outline is shown, by
what the board must have told, while the cameras are fitted again in the background.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from implicam.active.board_loop import BoardLoop, BoardTarget, CameraProgress, Ints
from implicam.active.board_poses import POSE_COLUMN
from implicam.dataset import Camera, Dataset, Floats, KnownPositions, Observations
from implicam.dataset.boards import corner_name
from implicam.detect import Detected, View
from implicam.detect.sharpness import edge_width
from implicam.errors import FitError, ImplicamError, UsageError
from implicam.evaluation import leave_out_shots
from implicam.formatting import json_safe
from implicam.geometry import Pose
from implicam.hardware import Frame
from implicam.images import blank
from implicam.progress import Progress, silent
from implicam.report import report_of, write_report
from implicam.report.words import headline
from implicam.report.words import verdict as judgement
from implicam.session.board_report import write_board_report
from implicam.session.controller import (
    CALIBRATION_FILE,
    HISTORY_KEY,
    REPORT_FILE,
    Equipment,
    SessionController,
    State,
)
from implicam.session.detections import Look
from implicam.session.journal import Session

_LOG = logging.getLogger(__name__)

STILL_PX = 1.0
"""So far a corner may have gone, in the median, between two looks at a board that is held still."""

STILL_SECONDS = 0.3
"""For so long it is held still, at least, before a picture is taken by itself."""

MAX_EDGE_PX = 6.0
"""Pixels from black to white, beyond which a picture is blurred."""

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


class Judgement(NamedTuple):
    """What is to be said of the board as it is held now: whether a picture is taken, and if not, why."""

    ready: bool
    reason: str


@dataclass(frozen=True, eq=False)
class BoardState(State):
    """As `State`. judgement: of the board in the live pictures. cameras: how far each is. busy: whether the cameras are
    being fitted meanwhile. off: pixels from the corners to the outline, NaN where that is not known.
    contradictions: what the last fit says of cameras that contradict each other. unfitted: why the last fit failed.
    forecast: whether the last numbers are expected of boards that no fit has seen yet."""

    judgement: Judgement = field(default_factory=lambda: Judgement(False, ""))
    cameras: tuple[CameraProgress, ...] = ()
    busy: bool = False
    off: float = float("nan")
    taken: int = 0
    contradictions: tuple[str, ...] = ()
    unfitted: str = ""
    forecast: bool = False


class BoardController(SessionController):
    """One session with a board, its equipment, and the loop that says where to hold it next."""

    loop: BoardLoop  # type: ignore[assignment]
    state: BoardState

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
        super().__init__(session, equipment, loop, auto=auto)  # type: ignore[arg-type]
        self.state = BoardState(auto=auto)
        self._hand, self._background = hand, background
        self._fitter = ThreadPoolExecutor(1, thread_name_prefix="implicam-fit")
        self._fitting: Future[None] | None = None
        self._loop_lock = threading.RLock()
        self._last: dict[str, tuple[Ints, Floats]] = {}  # the look before
        self._still_since = 0.0

    # called by a page

    def go(self) -> None:
        """Take a picture now, as the board is held; UsageError with the reason where it would be of no use."""
        self._take(asked=True)

    def redo(self) -> None:
        """Nothing is shown to be judged here: a picture is kept or refused at once."""
        raise UsageError("there is nothing to look at again.", fix="take a picture")

    def report_position(self, position: Any, *, confirmed: bool = False) -> None:
        """Refuse: nobody has to know where the board is.

        Args:
            position: Not used.
            confirmed: Not used.

        Raises:
            UsageError: Always.
        """
        raise UsageError("a board held by hand needs no position.", fix="hold it into the outline")

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

    def remove(self, name: str, *, again: bool = False) -> None:
        """Take any picture back.

        Args:
            name: Of the board.
            again: Not used: the same pose is hard to find again.

        Raises:
            UsageError: There is no such board.
        """
        with self._working("fitting", f"taking {name} back"):
            self.session.remove(name)
            self._fit()
            self._aim(f"{name} is taken back. ")

    def set_auto(self, auto: bool) -> None:
        """Turn on or off that a picture is taken by itself.

        Args:
            auto: Whether it is.
        """
        self._show(auto=auto)

    def step(self) -> None:
        """Take a picture, if the board is held so that it tells enough."""
        if self.state.phase == "aim" and self.state.judgement.ready:
            with suppress(UsageError):  # it moved just now: the next look says so
                self._take(asked=False)

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
        if self.state.phase == "aim" and self.state.looks is not before:
            with self._loop_lock:
                judged = self._judge(self.state.looks)
            if self.state.phase == "aim":
                self._show(judgement=judged, off=self._off(self.state.looks))

    def finish(self) -> Path:
        """Calibrate with everything, save and report; the calibration's file, which is not there after trouble."""
        path = self.session.folder / CALIBRATION_FILE
        with self._working("fitting", "calibrating, and writing the report"):
            self._wait_for_fit()
            data = self.session.data
            if self.loop.calibration is None or data is None:
                raise UsageError(
                    f"{self.loop.points} boards are too few to calibrate.",
                    why=str(self.loop.problem.what) if self.loop.problem else "",
                    fix=f"show each camera {self.loop.start} boards or more, in half of them two cameras at once",
                )
            calibration = self.loop.calibrator.fit(data)
            calibration.save(path)
            report = self.session.folder / REPORT_FILE
            report.unlink(missing_ok=True)  # it may be of an earlier calibration
            words, verdict = f"{self.loop.points} boards. Saved: {path}", ("", "unknown")
            try:
                if data.known is None:
                    said = write_board_report(report, self.session.name, self.loop.calibrator, calibration, data)
                else:
                    title = f"{self.session.name}: a board at known poses"
                    said = report_of(leave_out_shots(self.loop.calibrator.fit, data), title)
                    write_report(report, said)
                about_bars, _, tone = judgement(said)
                verdict = f"{headline(said)} {about_bars}", tone
                words += f" and {report}"
            except ImplicamError as error:
                words += f". No report: {error.what}"
            self.session.log("finished", points=self.loop.points)
            self._show(
                phase="done", message=words, report=report if report.exists() else None, target=None, auto=False,
                verdict=verdict,
            )  # fmt: skip
        return path

    def close(self) -> None:
        """Close the equipment and the session, after a fit in the background; closing twice is harmless."""
        self._fitter.shutdown(wait=True, cancel_futures=True)
        super().close()

    @property
    def measured_live(self) -> Floats:
        """Nothing: a board is no point."""
        return np.full(3, np.nan)

    # private

    def _aim(self, before: str = "") -> None:
        try:
            with self._loop_lock:
                (target,) = self.loop.ask()
        except UsageError as error:  # all known poses are taken
            self._show(phase="aim", target=None, message=f"{before}{error.what}")
            return
        target = replace(target, name=self.session.next_name())
        self._last, self._still_since = {}, 0.0
        self._show(
            phase="aim", target=target, message=f"{before}{target.words}", problem=None, judgement=Judgement(False, ""),
            cameras=tuple(self.loop.camera_progress()),
        )  # fmt: skip
        if self._hand is not None and target.known and target.pose is not None:
            self._hand.put(target.pose)
        elif self._hand is not None:
            self._hand.follow(self.loop.shape.some(), target.corners)

    def _fit(self) -> None:
        """With everything, now."""
        self._wait_for_fit()
        with self._loop_lock:
            self.loop.reset(self.session.data)
        self._show_loop()

    def _fit_behind(self) -> None:
        """In the background, unless that is being done: then what comes meanwhile is predicted."""
        if not self._background:
            self._fit()
            return
        if self._fitting is None or self._fitting.done():
            self._show(busy=True)
            self._fitting = self._fitter.submit(self._fitted_behind)

    def _fitted_behind(self) -> None:
        data = None
        while data is not self.session.data:  # others came meanwhile
            data = self.session.data
            begun = time.monotonic()
            try:
                found = self.loop.fit(data)
            except Exception as error:  # of a library: what was accepted is on disk, and the next fit may do
                _LOG.exception("the fit in the background failed")
                found = FitError(f"the fit failed: {type(error).__name__}: {error}.", fix="take another board")
            first = self.loop.calibration is None
            with self._loop_lock:
                self.loop.adopt(data, found)
            _LOG.info("fitted %d boards in %.1f s", self.loop.points, time.monotonic() - begun)
            self._show_loop()
            if first and self.loop.calibration is not None and self.state.phase == "aim":
                self._aim()  # an outline for a camera alone is a poor one now
        self._show(busy=False)

    def _wait_for_fit(self) -> None:
        if self._fitting is not None:
            self._fitting.result()
            self._fitting = None

    def _show_loop(self) -> None:
        loop = self.loop
        for step in loop.history[-1:]:
            self.session.set(f"{HISTORY_KEY} {step.points}", json_safe(asdict(step)))
        self._show(
            data=loop.data, calibration=loop.calibration, predicted=loop.predicted, history=tuple(loop.history),
            stop=loop.stop, cameras=tuple(loop.camera_progress()), contradictions=loop.contradictions,
            unfitted="" if loop.problem is None else f"{loop.problem.what} To do: {loop.problem.fix}.",
            forecast=loop.forecast,
        )  # fmt: skip

    def _take(self, *, asked: bool) -> None:
        """Take a set of pictures and keep it; UsageError with the reason where it is of no use."""
        target = self._require_target()
        assert isinstance(target, BoardTarget)
        before = self._last
        with self._camera_lock:
            if asked and self._each_when_it_likes:  # it may be elsewhere than at the last look
                before = self._views(self._detect_all(self._take_frames(None)))
            frames = self._take_frames(self.equipment.trigger)
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
            raise UsageError(f"no picture was kept: {why}.", fix="hold the board still, in sight of a camera")
        shot = self._make_shot(target, looks)
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

    @property
    def _each_when_it_likes(self) -> bool:
        """Whether cameras take pictures by themselves, triggered by nothing: only of a board held still do these
        show one place."""
        return self.equipment.shows_live and self.equipment.trigger is None

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
            return "too few corners are seen: show more of the board" if some else "no camera sees the board"
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

    def _detect_all(self, frames: Sequence[Frame], *, live: bool = False) -> tuple[Look, ...]:
        names = [source.name for source in self.equipment.cameras]
        found = list(self._pool.map(self._detect, names, frames))
        nowhere = np.full(2, np.nan)
        return tuple(Look(n, f, d, nowhere) for n, f, d in zip(names, frames, found, strict=True))

    def _detect(self, camera: str, frame: Frame) -> Detected:
        why = blank(frame.picture)
        if why:
            return Detected(reason=f"the picture is {why}")
        return self.equipment.detector.detect(frame.picture, View(camera, "live"))

    def _make_shot(self, target: BoardTarget, looks: Sequence[Look]) -> Dataset:
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
            columns = {POSE_COLUMN: np.full(len(numbers), self.loop.name_of(target))}
            known = KnownPositions(np.full(len(numbers), name), xyz, spread, columns)
        return Dataset(self.session.name, self.session.length_unit, Observations(names, tuple(cameras), uv, sd), known)


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
