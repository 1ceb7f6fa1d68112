"""The guided session: what happens between "put the ball here" and "stop now", without any screen.

    aim -> moving -> shown -> fitting -> aim ...           -> done
                        \\-> trouble: something failed; nothing is lost, and `retry` goes on

Every method that does something returns when it is done; a page calls them from one worker thread. `state` may be read
at any time from any thread: it is a frozen value that is replaced, never changed.
"""

from __future__ import annotations

import logging
import math
import threading
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from implicam import calibration_file
from implicam.active import Loop, PredictedCovariance, Step, Target
from implicam.calibrators import Calibration, PredictsPixels
from implicam.dataset import Camera, Dataset, Floats, KnownPositions, Observations
from implicam.dataset.image_bounds import are_on_image
from implicam.dataset.units import METRES_PER_UNIT
from implicam.detect import Detected, Detector, View, correct_outlines
from implicam.detect.follow import Follower
from implicam.errors import HardwareError, ImplicamError, UsageError
from implicam.formatting import json_safe
from implicam.hardware import (
    Frame,
    FrameSource,
    GuardedRobot,
    MovedByHand,
    Robot,
    RobotOptions,
    Trigger,
    guard_robot,
    open_all,
    take_frames,
)
from implicam.hardware.protocol import format_position
from implicam.images import blank
from implicam.measurement import Measurement
from implicam.progress import Progress, silent
from implicam.rig_model.rough import rough_views
from implicam.session.detections import Look, reject_implausible
from implicam.session.journal import Session
from implicam.session.typed import (
    TYPED_COLUMN,
    PositionQuestion,
    TypedPosition,
    parse_position,
    questions_after,
    questions_before,
)
from implicam.threads import side_by_side

_LOG = logging.getLogger(__name__)

CALIBRATION_FILE, REPORT_FILE = "calibration.implicam", "report.html"

MAX_TARGETS_WITHOUT_BALL = 5
"""In a row, after which a session does not go on by itself."""

MAX_DRIFT_M = 5e-4
"""Metres that a robot may have gone from its position when the pictures are taken; further where its `sd` is larger."""

STOP_REPEAT_SECONDS = 2.0
"""For so long a robot that is to stop is told so again and again."""

HISTORY_KEY = "history"
"""The settings of the session that hold the curve of the uncertainty: "history 12" after 12 points. Older sessions have
all of it in "history"."""

MAX_ROUGH_POINTS = 12
"""Known points from which a camera that is not calibrated yet is looked at roughly: the last ones."""

SUSPECT_SQUARED_ERROR, SUSPECT_MEDIANS = 40.0, 5.0
"""A known point is looked at again where its squared error in standard deviations is larger, which chance leaves of one
in 10^8, and its distance so many times that of the others."""

MIN_REPORTED_POINTS = 12
"""Known points from which a report by cross-validation says anything."""


@dataclass(frozen=True, eq=False)
class Equipment:
    """What the session works with; the robot is guarded (`guard_robot`), whatever it is.

    Attributes:
        cameras: One or more.
        robot: That puts the ball somewhere.
        detector: Finds the ball in a picture.
        trigger: That exposes all cameras; None where they run freely.
        radius: Of the ball, in `unit`; None for no correction.
        timeout: Seconds for a picture.
        dry_run: The robot is never told to move, so nothing is kept.
        unit: The session's length unit.
        pulse_every: Seconds from one pulse of the trigger for the live pictures to the next; 0 for no such pulse.
    """

    cameras: Sequence[FrameSource]
    robot: Robot
    detector: Detector
    trigger: Trigger | None = None
    radius: float | None = None
    timeout: float = 10.0
    dry_run: bool = False
    unit: str = "mm"
    pulse_every: float = 0.0

    @property
    def shows_live(self) -> bool:
        """Whether pictures come between those that are taken: cameras run freely, or pulses are sent for that."""
        if self.trigger is not None:
            return self.pulse_every > 0
        return all(source.live for source in self.cameras)

    def __post_init__(self) -> None:
        if not isinstance(self.robot, GuardedRobot) or (self.dry_run and not self.robot.dry_run):
            options = RobotOptions(unit=self.unit, dry_run=self.dry_run)
            object.__setattr__(self, "robot", guard_robot(self.robot, options))


@dataclass(frozen=True, eq=False)
class State:
    """All that a page shows. phase: starting, aim, moving, shown, fitting, trouble, done.

    message: what to do now, or what went wrong. position: (3,) where the robot says the ball is, or what the person
    typed; NaN where unknown. typed: what the person typed, as it was understood. looks: the pictures that are being
    judged (phase shown) or live. stop: why to stop now. stopped: a person has stopped the robot, and nothing moves
    until `go`. suspects: accepted points that are not where the calibration measures them, with how far they are off.
    verdict: the report in one sentence, and its tone: "good", "bad", "careful" or "unknown". uncalibrated: why there is
    no calibration, though there are points enough to try.
    """

    phase: str = "starting"
    message: str = ""
    target: Target | None = None
    position: Floats = field(default_factory=lambda: np.full(3, np.nan))
    typed: TypedPosition | None = None
    rough: Floats = field(default_factory=lambda: np.full((0, 3), np.nan))
    looks: tuple[Look, ...] = ()
    history: tuple[Step, ...] = ()
    stop: str = ""
    predicted: PredictedCovariance | None = None
    calibration: Calibration | None = None
    data: Dataset | None = None
    problem: ImplicamError | None = None
    auto: bool = False
    stopped: bool = False
    suspects: tuple[tuple[str, float], ...] = ()
    verdict: tuple[str, str] = ("", "")
    uncalibrated: str = ""
    report: Path | None = None
    version: int = 0

    @property
    def cameras_with_ball(self) -> list[str]:
        """The cameras that see the ball."""
        return [look.camera for look in self.looks if len(look.found)]


class SessionController:
    """One session, its equipment, and the loop that says where to measure next. A context manager: it opens the
    equipment, and closes it and the session."""

    def __init__(self, session: Session, equipment: Equipment, loop: Loop, *, auto: bool = False) -> None:
        names = [source.name for source in equipment.cameras]
        if names != [camera.name for camera in session.cameras]:
            raise UsageError(
                f"the session in {session.folder} has the cameras {', '.join(c.name for c in session.cameras)}, and "
                f"here are {', '.join(names)}.",
                fix="use the same cameras with the same names, or begin a session in another folder",
            )
        self.session, self.equipment, self.loop = session, equipment, loop
        self.state = State(auto=auto)
        self._changed = threading.Condition()
        self._camera_lock = threading.Lock()  # a camera answers one thread at a time
        self._halted = threading.Event()  # stop was pressed: nothing moves until `go`
        self._ending = threading.Event()  # the session is being left: nothing moves, whoever says go
        self._targets_without_ball = 0
        self._followers = {name: Follower(equipment.detector, k) for k, name in enumerate(names)}
        self._next_pulse = 0.0  # time.monotonic() before which none is fired for live pictures
        loop.history = _read_history(session)
        for skipped in session.skipped:
            loop.refuse(skipped.xyz, skipped.reason)
        self._pool = ThreadPoolExecutor(max(1, len(names)))

    def __enter__(self) -> SessionController:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # called by a page

    def start(self) -> None:
        """Open cameras and robot, fit the points that the session has, and propose the first target."""
        self._ending.clear()
        with self._working("starting", "connecting to the cameras and the robot"):
            self._open_devices()
            self._fit()
            self._aim()

    def go(self) -> None:
        """Send the robot to the target, and take pictures. UsageError where a person moves the ball."""
        self._halted.clear()
        self._show(stopped=False)
        self._move()

    def _move(self) -> None:
        target = self._require_target()
        if not self.equipment.robot.moves:
            raise UsageError("nothing moves the ball but you.", fix="put it there, and type where it is")
        with self._working("moving", "the robot is on its way"):
            if self._halted.is_set() or self._ending.is_set():
                raise HardwareError("the robot was stopped by hand.", fix="press Go when it may move again")
            where = self.equipment.robot.move(target.xyz)
            self._take_pictures(where)

    def report_position(self, position: Floats | Sequence[str] | TypedPosition, *, confirmed: bool = False) -> None:
        """Say where the ball is, as measured by a person, and take pictures of it.

        Numbers are taken as they are. What a person typed is asked about where it is odd: outside of the workspace, far
        from the target, or far from what the calibration measures there.

        Args:
            position: (3,) in the session's length unit, world frame; or the texts of x, y and z; or these as they were
                understood.
            confirmed: The person was asked, and it is so.

        Raises:
            PositionQuestion: The person is to be asked; nothing was done. The same again with `confirmed` takes it.
            UsageError: A text is no length, or may mean two.
        """
        typed = None
        if isinstance(position, TypedPosition):
            typed = position
        elif not isinstance(position, np.ndarray):
            typed = parse_position(position, self.equipment.unit)
        xyz = np.asarray(position if typed is None else typed.xyz, dtype=np.float64)
        asks = typed is not None and not confirmed
        if asks:
            self._ask(questions_before(xyz, self.equipment.unit, self.loop.workspace, self.state.target))
        with self._working("moving", "looking"):
            if isinstance(self.equipment.robot, MovedByHand):
                self.equipment.robot.set_position(xyz)
            self._take_pictures(self.equipment.robot.position(), typed=typed, asks=asks)

    def _ask(self, questions: Sequence[str]) -> None:
        if questions:
            _LOG.info("asked: %s", "; ".join(questions))
            raise PositionQuestion(questions)

    def redo(self) -> None:
        """Take pictures again, at the same position."""
        with self._working("moving", "looking again"):
            self._take_pictures(self.equipment.robot.position(), typed=self.state.typed)

    def accept(self) -> None:
        """Keep what is shown: write it to disk, fit again, and propose the next target."""
        state = self.state
        if state.phase != "shown":
            raise UsageError("there is nothing to accept.", fix="take a picture first")
        if not state.cameras_with_ball:
            raise UsageError("no camera found the ball.", fix="redo it, or skip this target")
        if self.equipment.dry_run:
            raise UsageError(
                "this is a dry run: nothing moves, so nothing is kept.", fix="skip, to see the next target"
            )
        point = self._make_point(state)
        pictures = {look.camera: look.frame.picture for look in state.looks if look.frame is not None}
        with self._working("fitting", "fitting with everything"):
            begun = time.monotonic()
            self.session.accept(point, pictures=pictures, notes=_make_notes(state))
            _LOG.info("%s accepted: on disk after %.3f s", point.points[0], time.monotonic() - begun)
            self._targets_without_ball = 0
            self._fit()
            self._aim()

    def skip(self, reason: str = "skipped by hand") -> None:
        """Leave this target out; it is not proposed again.

        Args:
            reason: Kept in the session.

        Raises:
            UsageError: There is no target now.
        """
        target = self._require_target()
        _LOG.info("%s skipped: %s", target.name, reason)
        with self._working("fitting", "choosing another target"):
            self.session.skip(target.xyz, reason)
            self.loop.refuse(target.xyz, reason)
            self._aim()

    def undo(self) -> str | None:
        """Take the last accepted point back; its name, None where there is none."""
        with self._working("fitting", "taking the last point back"):
            name = self.session.undo()
            self._fit()
            self._aim(f"point {name} is taken back. " if name else "")
        return name

    def remove(self, name: str, *, again: bool = False) -> None:
        """Take any accepted point back.

        Args:
            name: Its name.
            again: The next target is where it was, so that it can be measured anew.

        Raises:
            UsageError: There is no such point.
        """
        with self._working("fitting", f"taking {name} back"):
            data = self.session.data
            self.session.remove(name)
            self._fit()
            self._aim(f"point {name} is taken back. ")
            if again and data is not None:
                self._aim_at(data.xyz[data.shots == name][0])

    def _aim_at(self, xyz: Floats) -> None:
        """The next target, as a person wants it."""
        self._show(target=self._target_at(xyz), rough=self._rough_circles(xyz))

    def _target_at(self, xyz: Floats) -> Target:
        """A target anywhere, with its pixels where a calibration predicts them."""
        uv = np.full((len(self.equipment.cameras), 2), np.nan)
        calibration = self.loop.calibration
        if isinstance(calibration, PredictsPixels):
            predicted = calibration.predict(xyz[None])
            uv = np.where(are_on_image(calibration.trained, predicted)[..., None], predicted, np.nan)[0]
        return Target(self.session.next_name(), xyz, uv)

    def retry(self) -> None:
        """After trouble: connect again, and go on."""
        with self._working("starting", "connecting again"):
            self._open_devices()
            self._fit()
            self._aim()

    def stop_robot(self) -> None:
        """Stop the robot at once, from any thread; automatic mode ends, and nothing moves until `go`."""
        self._halted.set()
        self._show(auto=False, stopped=self.equipment.robot.moves)
        end = time.monotonic() + STOP_REPEAT_SECONDS
        try:
            self.equipment.robot.stop()
            while self.state.phase == "moving" and time.monotonic() < end:  # a move may begin just now
                time.sleep(0.05)
                self.equipment.robot.stop()
        finally:
            with suppress(ImplicamError):
                self.session.log("robot stopped by hand")

    def leave(self) -> None:
        """The session is being left, by Ctrl-C for one: stop a robot that is on its way, at once, and let none begin.

        Never raises: what comes after it lets go of the equipment. `start` takes the session up again.
        """
        self._ending.set()
        try:
            if self.state.phase == "moving" or self.state.auto:
                self.stop_robot()
        except Exception as error:  # the link is dead: nothing more can be told
            _LOG.warning("the robot could not be told to stop: %s", error)

    def set_auto(self, auto: bool) -> None:
        """Turn on or off that good points are accepted, and the next target is gone to, without being asked.

        Args:
            auto: Whether to go on by itself.

        Raises:
            UsageError: The ball does not get there without a person's help, or this is a dry run.
        """
        if auto and (not self.equipment.robot.alone or self.equipment.dry_run):
            raise UsageError(
                "this session cannot go on by itself.",
                why="a person puts the ball there" if not self.equipment.dry_run else "it is a dry run",
                fix="go on target by target",
            )
        if auto:
            self._halted.clear()
        self._show(auto=auto, stopped=self.state.stopped and not auto)

    def finish(self) -> Path:
        """Calibrate with everything, save and report; the calibration's file, which is not there after trouble."""
        from implicam.report import report_of, write_report
        from implicam.report.words import headline
        from implicam.report.words import verdict as judgement

        path = self.session.folder / CALIBRATION_FILE
        with self._working("fitting", "calibrating, and writing the report"):
            if self.loop.calibration is None or self.loop.data is None:
                raise UsageError(
                    f"{self.loop.points} known points are too few to calibrate.",
                    why=str(self.loop.problem.what) if self.loop.problem else "",
                    fix=f"accept at least {self.loop.start}",
                )
            calibration = self.loop.calibrator.fit(self.loop.data)  # from scratch: the order of points must not matter
            calibration.save(path)
            report = self.session.folder / REPORT_FILE
            report.unlink(missing_ok=True)  # it may be of an earlier calibration
            words, verdict = f"{self.loop.points} points. Saved: {path}", ("", "unknown")
            try:
                if len(calibration.data) >= MIN_REPORTED_POINTS:
                    title = f"{self.session.name}: a guided calibration"
                    data = report_of(_evaluate(calibration), title, calibration_file.checksum(path))
                    write_report(report, data)
                    about_bars, _, tone = judgement(data)
                    verdict = f"{headline(data)} {about_bars}", tone
                    words += f" and {report}"
            except ImplicamError as error:
                words += f". No report: {error.what}"
            self.session.log("finished", points=self.loop.points)
            self._show(
                phase="done", message=words, report=report if report.exists() else None, target=None, auto=False,
                verdict=verdict, suspects=find_suspects(calibration, calibration.data),
            )  # fmt: skip
        return path

    def run(self, progress: Progress = silent) -> Path | None:
        """Measure target after target until a rule says stop or something fails, then finish.

        Args:
            progress: Told after each target how many points there are.

        Returns:
            The path of the calibration's file; None where something failed, or there is no calibration.

        Raises:
            UsageError: The session cannot go on by itself, see `set_auto`.
        """
        self.set_auto(True)
        if self.state.phase == "starting":
            self.start()
        while self.state.auto and self.state.phase == "aim" and not self.state.stop and self.state.target is not None:
            self.step()
            progress("measuring", self.loop.points, max(self.loop.points, self.loop.start))
        return self.finish() if self.state.phase == "aim" and self.loop.calibration is not None else None

    def step(self) -> None:
        """One target in automatic mode: move, take pictures, and accept or skip. After some targets in a row without a
        ball it stops: something is wrong."""
        if self.state.phase == "aim":
            self._move()
        if self.state.phase != "shown" or self._halted.is_set():
            return  # stopped while the pictures were taken: a person judges them
        if self.state.cameras_with_ball:
            self.accept()
            return
        self._targets_without_ball += 1
        if self._targets_without_ball < MAX_TARGETS_WITHOUT_BALL:
            self.skip("the ball was not found")
            return
        self._targets_without_ball = 0
        reasons = "; ".join(f"{look.camera}: {look.found.reason}" for look in self.state.looks)
        self._report_trouble(
            HardwareError(
                f"the ball was not found at {MAX_TARGETS_WITHOUT_BALL} targets in a row.",
                why=reasons,
                fix="look at the pictures, and retry",
            )
        )

    def live(self) -> None:
        """Take new pictures with all cameras to be shown; nothing happens where the session is busy, a picture is being
        judged, the cameras do not run freely (a film, a folder), or the trigger has fired for live pictures just now.

        A pulse for live pictures is over when all cameras have given theirs, and a shot waits for that.
        """
        phase = self.state.phase
        if not self.equipment.shows_live or phase not in ("aim", "done") or time.monotonic() < self._next_pulse:
            return
        if not self._camera_lock.acquire(blocking=False):
            return
        try:
            if self.state.phase != phase:  # a command began just now, and waits for the cameras
                return
            frames = self._take_frames(self.equipment.trigger)
            if self.equipment.trigger is not None:
                self._next_pulse = time.monotonic() + self.equipment.pulse_every
            if self.state.phase != phase:  # one that waits for the cameras does not wait for the balls as well
                return
            looks = self._detect_all(frames, live=True)
            if self.state.phase == phase:
                self._show(looks=looks)
        except Exception as error:
            if self.state.phase == phase:  # else a command is running, and will meet the error itself
                self._report_trouble(error) if isinstance(error, HardwareError) else self._report_unexpected(error)
        finally:
            self._camera_lock.release()

    def wait(self, version: int, timeout: float) -> State:
        """Wait until the state changes.

        Args:
            version: That of the state which the caller has.
            timeout: Seconds to wait at most.

        Returns:
            The state now; it has another version unless the time is over.
        """
        with self._changed:
            self._changed.wait_for(lambda: self.state.version != version, timeout)
        return self.state

    def close(self) -> None:
        """Stop a robot that is on its way, and close the equipment and the session; closing twice is harmless."""
        self.leave()
        with self._camera_lock:
            for device in self._list_devices():
                device.close()
        self._pool.shutdown()
        self.session.close()

    @property
    def measured_live(self) -> Floats:
        """(3,) where the calibration sees the ball in the live pictures; NaN where it cannot."""
        state = self.state
        measured = self._measure(state.looks, state.calibration)
        return np.full(3, np.nan) if measured is None else np.asarray(measured.xyz[0], dtype=np.float64)

    def _measure(self, looks: Sequence[Look], calibration: Calibration | None) -> Measurement | None:
        """The ball by what the cameras see; None where they cannot tell."""
        if calibration is None or sum(len(look.found) > 0 for look in looks) < 2:
            return None
        return calibration.measure(self._make_observations("live", looks))

    # private

    def _open_devices(self) -> None:
        open_all(self.equipment.cameras, self._pool)
        self.equipment.robot.open()
        if self.equipment.trigger is not None:
            self.equipment.trigger.open()

    def _list_devices(self) -> Iterator[FrameSource | Robot | Trigger]:
        yield from self.equipment.cameras
        yield self.equipment.robot
        if self.equipment.trigger is not None:
            yield self.equipment.trigger

    def _require_target(self) -> Target:
        if self.state.target is None:
            raise UsageError("there is no target now.", fix="start the session, or retry after trouble")
        return self.state.target

    @contextmanager
    def _working(self, phase: str, message: str) -> Iterator[None]:
        before, begun = self.state, time.monotonic()
        _LOG.info("%s: %s", phase, message)
        self._show(phase=phase, message=message)
        try:
            yield
            _LOG.info("%s took %.2f s", phase, time.monotonic() - begun)
        except ImplicamError as error:
            if isinstance(error, UsageError):  # nothing was done: show the phase before
                self._show(phase=before.phase, message=before.message)
                raise
            self._report_trouble(error)
        except Exception as error:  # an error of a library: the session waits, and shows it
            self._report_unexpected(error)
        except BaseException:  # Ctrl-C in this thread: nothing is being done any more
            self._show(phase=before.phase, message=before.message, auto=False)
            raise

    def _report_unexpected(self, error: Exception) -> None:
        """An error of another kind than ours."""
        with suppress(ImplicamError):
            self.session.log("unexpected", traceback="".join(traceback.format_exception(error)))
        self._report_trouble(
            ImplicamError(
                f"something unexpected happened: {type(error).__name__}: {error}.",
                why="the details are in session.db, in the table of events",
                fix="retry; what was accepted is on disk",
            )
        )

    def _report_trouble(self, error: ImplicamError) -> None:
        self._show(phase="trouble", message=str(error), problem=error, auto=False)
        with suppress(ImplicamError):  # the disk may be what is wrong
            self.session.log("trouble", what=error.what, why=error.why, fix=error.fix)

    def _show(self, **changes: Any) -> None:
        with self._changed:
            self.state = replace(self.state, **changes, version=self.state.version + 1)
            self._changed.notify_all()

    def _fit(self) -> None:
        data = self.session.data
        if data is not None and len(data) == 0:
            data = None
        if data is not None and self.equipment.radius is not None:
            data = self._correct_outlines(data)
        self.loop.reset(data)
        for step in self.loop.history[-1:]:  # those before are there
            if math.isfinite(step.usual):
                unit = self.equipment.unit
                _LOG.info("%d points: %.3g %s in 95 %% of the workspace", step.points, step.usual, unit)
            self.session.set(f"{HISTORY_KEY} {step.points}", json_safe(asdict(step)))
        why = self.loop.problem.what if self.loop.problem is not None and self.loop.calibration is None else ""
        self._show(
            data=data, calibration=self.loop.calibration, predicted=self.loop.predicted,
            history=tuple(self.loop.history), stop=self.loop.stop,
            suspects=find_suspects(self.loop.calibration, data),
            uncalibrated=why,
        )  # fmt: skip

    def _correct_outlines(self, data: Dataset) -> Dataset:
        """The pixels of the ball's middle, for those of its outline; by the last calibration, where there is one."""
        assert self.equipment.radius is not None
        last = self.loop.calibration
        return correct_outlines(data, self.equipment.radius, last if isinstance(last, PredictsPixels) else None)[0]

    def _aim(self, before: str = "") -> None:
        """Propose the next target; where there is none left, say so."""
        try:
            here = self.equipment.robot.position()
        except HardwareError:
            here = None
        try:
            (target,) = self.loop.ask(here=here)
        except UsageError as error:
            self._show(phase="aim", target=None, message=f"{before}{error.what}", looks=())
            return
        if len(target.uv) == 0:
            target = replace(target, uv=np.full((len(self.equipment.cameras), 2), np.nan))
        moves = self.equipment.robot.moves
        if not moves:
            target = self._target_at(self.loop.workspace.rounded(target.xyz))
        words = f"{before}point {self.loop.points + 1}: " + (
            "let the robot go there" if moves else "put the ball there, and type where it is"
        )
        self._show(
            phase="aim",
            target=replace(target, name=self.session.next_name()),
            rough=self._rough_circles(target.xyz),
            message=words + self._explain_uncalibrated(),
            problem=None,
        )

    def _rough_circles(self, xyz: Floats) -> Floats:
        """(cameras, 3) where those that are not calibrated see a place, from few known points."""
        data, calibration = self.loop.data, self.loop.calibration
        circles = np.full((len(self.equipment.cameras), 3), np.nan)
        if data is None:
            return circles
        sd = float(np.nan_to_num(np.max(self.equipment.robot.sd)))
        known, uv = data.xyz[-MAX_ROUGH_POINTS:], data.observations.uv[-MAX_ROUGH_POINTS:]
        names: Sequence[str] = () if calibration is None else data.observations.camera_names
        if isinstance(calibration, PredictsPixels):
            names = calibration.camera_names
        cameras = self.session.cameras  # with the size of their pictures

        def circle(c: int) -> Floats:
            found = rough_views(known, uv[:, c], (cameras[c].width or 0, cameras[c].height or 0), xyz[None], sd)
            return np.append(found.uv[0], found.radius)

        left = [c for c, camera in enumerate(cameras) if camera.name not in names]
        for c, found in zip(left, side_by_side(circle, left), strict=True):
            circles[c] = found
        return circles

    def _explain_uncalibrated(self) -> str:
        """Which cameras have not seen enough of the known points yet, in words."""
        calibration, data = self.loop.calibration, self.loop.data
        if not isinstance(calibration, PredictsPixels) or data is None:
            return ""
        seen = dict(zip(data.observations.camera_names, data.observations.seen.sum(axis=0), strict=True))
        missing = [name for name in seen if name not in calibration.camera_names]
        return "".join(f". {name} is not calibrated yet: it has seen {seen[name]} points" for name in missing)

    def _take_pictures(self, where: Floats, *, typed: TypedPosition | None = None, asks: bool = False) -> None:
        begun = time.monotonic()
        with self._camera_lock:
            frames = self._take_frames(self.equipment.trigger)
        taken = time.monotonic()
        self._check_standing(where)
        seen, sd = self._detect_all(frames), np.array(self.equipment.robot.sd, dtype=np.float64)
        if asks:
            measured = self._measure(seen, self.loop.calibration)
            self._ask(questions_after(where, sd, self.equipment.unit, self.loop.workspace, measured))
        looks = reject_implausible(seen, where, np.nan_to_num(sd), self.loop.calibration)
        _LOG.info(
            "%s at %s: %s; pictures took %.2f s, finding the ball %.2f s",
            self.state.target.name if self.state.target else "no target", format_position(where),
            ", ".join(map(_look_in_words, looks)), taken - begun, time.monotonic() - taken,
        )  # fmt: skip
        count = sum(len(look.found) > 0 for look in looks)
        words = f"found in {count} of {len(looks)} cameras"
        if not count:
            words = "the ball was not found in any camera: redo, or skip this target"
        self._show(phase="shown", looks=looks, position=where, typed=typed, message=words)

    def _check_standing(self, where: Floats) -> None:
        """HardwareError where the robot has left a position while it was photographed."""
        robot, unit = self.equipment.robot, self.equipment.unit
        if not robot.alone:
            return
        far = float(np.linalg.norm(robot.position() - where))
        if far > max(MAX_DRIFT_M / METRES_PER_UNIT[unit], *np.nan_to_num(robot.sd)):
            raise HardwareError(
                f"the robot moved {far:.3g} {unit} while the pictures were taken.",
                why="somebody else moves it, or it goes on by itself",
                fix="let it stand still, and look again",
            )

    def _take_frames(self, trigger: Trigger | None) -> list[Frame]:
        return take_frames(self.equipment.cameras, trigger, self.equipment.timeout, self._pool)

    def _detect_all(self, frames: Sequence[Frame], *, live: bool = False) -> tuple[Look, ...]:
        expected = self.state.target.uv if self.state.target is not None else np.full((len(frames), 2), np.nan)
        names = [source.name for source in self.equipment.cameras]
        found = list(self._pool.map(self._follow if live else self._detect, names, frames))
        return tuple(Look(n, f, d, e) for n, f, d, e in zip(names, frames, found, expected, strict=True))

    def _follow(self, camera: str, frame: Frame) -> Detected:
        """As `_detect`, of a live picture: near the last place first."""
        follower = self._followers[camera]
        near = follower.near(frame.picture, View(camera, "live"))
        return follower.found(frame.picture, self._detect(camera, frame)) if near is None else near

    def _detect(self, camera: str, frame: Frame) -> Detected:
        why = blank(frame.picture)
        if why:
            return Detected(reason=f"the picture is {why}")
        return self.equipment.detector.detect(frame.picture, View(camera, "live"))

    def _make_point(self, state: State) -> Dataset:
        """What is shown, as a known point."""
        assert state.target is not None
        name = state.target.name
        observations = self._make_observations(name, state.looks)
        sd = np.array([self.equipment.robot.sd], dtype=np.float64)
        columns = {} if state.typed is None else {TYPED_COLUMN: np.array([state.typed.as_typed])}
        known = KnownPositions(np.array([name]), state.position[None], sd, columns)
        return Dataset(self.session.name, self.session.length_unit, observations, known)

    def _make_observations(self, name: str, looks: Sequence[Look]) -> Observations:
        uv, sd = np.full((1, len(looks), 2), np.nan), np.full((1, len(looks), 2), np.nan)
        for c, look in enumerate(looks):
            if len(look.found):
                uv[0, c], sd[0, c] = look.found.uv[0], look.found.sd[0]
        cameras: Sequence[Camera] = self.session.cameras
        return Observations(np.array([name]), tuple(cameras), uv, sd)


def _look_in_words(look: Look) -> str:
    if not len(look.found):
        return f"{look.camera} missed it ({look.found.reason or 'no ball'})"
    u, v = look.uv
    return f"{look.camera} ({u:.2f}, {v:.2f})"


def _make_notes(state: State) -> Mapping[str, Any]:
    target = state.target
    return {
        "target": [] if target is None else target.xyz.tolist(),
        "reasons": {look.camera: look.found.reason for look in state.looks if look.found.reason},
    }


def _read_history(session: Session) -> list[Step]:
    """The curve as far as it was when the session was left; the last point is computed again."""
    kept = 0 if session.data is None else len(session.data) - 1
    settings = session.settings
    found = [
        *settings.get(HISTORY_KEY, []),
        *(row for key, row in settings.items() if key.startswith(f"{HISTORY_KEY} ")),
    ]
    try:
        known: list[dict[str, Any]] = [{key: math.nan if x is None else x for key, x in row.items()} for row in found]
        steps = {row["points"]: Step(**row) for row in known}
        return [steps[points] for points in sorted(steps) if points <= kept]
    except (TypeError, KeyError, AttributeError):  # another version's: the curve begins anew
        return []


def find_suspects(calibration: Calibration | None, data: Dataset | None) -> tuple[tuple[str, float], ...]:
    """Known points that cannot be where they are said to be: far from where the calibration measures them.

    Args:
        calibration: Fitted to them; None: there is none yet.
        data: The known points.

    Returns:
        Name and distance in the length unit of each, the farthest first.
    """
    if calibration is None or data is None:
        return ()
    measured = calibration.measure(data.observations)
    there = np.flatnonzero(measured.measured)
    off = measured.xyz[there] - data.xyz[there]
    stated = np.nan_to_num(data.positions.sd[there])
    square = np.einsum(
        "ni,nij,nj->n", off, np.linalg.inv(measured.cov[there] + stated[:, :, None] ** 2 * np.eye(3)), off
    )
    far = np.linalg.norm(off, axis=1)
    wrong = (square > SUSPECT_SQUARED_ERROR) & (far > SUSPECT_MEDIANS * np.median(far)) if len(far) else square > 0
    found = [(str(data.points[i]), float(d)) for i, d in zip(there[wrong], far[wrong], strict=True)]
    return tuple(sorted(found, key=lambda one: -one[1]))


def _evaluate(calibration: Calibration) -> Any:
    from implicam.evaluation import cross_validate

    return cross_validate(calibration.refit, calibration.data, min(10, len(calibration.data)))
