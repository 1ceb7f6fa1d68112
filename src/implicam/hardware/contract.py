"""What every robot that moves by itself must do, checked against a stand-in for its hardware: `check_robot`.

To be imported from `implicam.testing`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace

import numpy as np

from implicam.dataset.units import METRES_PER_UNIT
from implicam.errors import HardwareError, ImplicamError, UsageError
from implicam.hardware.protocol import Floats, Robot, RobotOptions
from implicam.registry import missing_members

HALT_SECONDS = 0.5
"""From `stop` to a stand."""

STOP_SECONDS = 2.0
"""What `stop` itself may take: it does not wait for the move."""

BEGIN_SECONDS, ANSWER_SECONDS = 20.0, 10.0
"""Until a move has begun, which may connect first; until a move that cannot go on says so."""

ARRIVAL_M, STILL_M = 1e-3, 1e-5
"""Metres from its target at which it has arrived; metres between two looks within which it stands."""

LOOK_SECONDS = 0.1
"""Between two looks at whether it stands."""

STEP_SHARE, FAR_SHARE = 0.02, 0.9
"""Of the box: a short way, and how far from one face to the other a long one goes."""

SLOW_M_S, SLOW_STEP_M = 0.02, 0.01
"""A speed that is asked for, and the way on which it is timed."""


@dataclass(frozen=True)
class StandIn:
    """What stands in for the robot's hardware, as a test can handle it.

    Attributes:
        place: (3,) where the target really is, in the dataset's unit and world frame.
        silence: Given True: hear nothing and say nothing, while what moves goes on. Given False: talk again. None where
            its link cannot fall silent.
        cut: Break the link; what moves goes on, and a new link can be made. None where it has none.
    """

    place: Callable[[], Floats]
    silence: Callable[[bool], object] | None = None
    cut: Callable[[], object] | None = None


def check_robot(
    make: Callable[[RobotOptions], Robot],
    box: tuple[Sequence[float] | Floats, Sequence[float] | Floats],
    stand_in: StandIn,
    *,
    unit: str = "mm",
) -> None:
    """Check that a robot which moves by itself keeps what `Robot` says, on the bare driver: without a session's guard.

    Takes half a minute of little work. The way through the box must take the robot some two seconds.

    Args:
        make: Makes a robot, as `from_spec` does; it is called several times, one robot at a time.
        box: Two opposite corners (3,) of the space it may move in; it stands inside.
        stand_in: Of its hardware.
        unit: Of lengths.

    Raises:
        AssertionError: Something does not hold; it says what.
    """
    before = set(threading.enumerate())
    check = _Check(make, RobotOptions(unit=unit, box=box, say=lambda text: None), stand_in)
    check.members_and_options()
    with check.robot() as robot:
        check.goes(robot)
        check.refuses(robot)
        check.stops(robot)
        check.survives(robot)
    check.dry_run()
    check.speed()
    end = time.monotonic() + ANSWER_SECONDS
    while (left := set(threading.enumerate()) - before) and time.monotonic() < end:
        time.sleep(LOOK_SECONDS)
    assert not left, f"close() leaves threads: {', '.join(thread.name for thread in left)}"


class _Move:
    """A move in a thread of its own."""

    def __init__(self, robot: Robot, target: Floats) -> None:
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(robot, target), daemon=True)
        self._thread.start()

    def _run(self, robot: Robot, target: Floats) -> None:
        try:
            robot.move(target)
        except BaseException as error:
            self.error = error

    @property
    def over(self) -> bool:
        return not self._thread.is_alive()

    def failed(self, why: str) -> None:
        """Wait for it; AssertionError where it does not end with a HardwareError."""
        self._thread.join(ANSWER_SECONDS)
        assert self.over, f"move() waits for ever {why}"
        assert self.error is not None, f"move() returns as if it had arrived, {why}"
        _assert_says_all(self.error, f"move() {why}")


class _Check:
    def __init__(self, make: Callable[[RobotOptions], Robot], options: RobotOptions, stand_in: StandIn) -> None:
        assert options.box is not None
        self._make, self._options, self._stand_in = make, options, stand_in
        corners = np.array(options.box, dtype=np.float64)
        self._low, self._high = corners.min(axis=0), corners.max(axis=0)
        self._metres = METRES_PER_UNIT[options.unit]
        self._near = ARRIVAL_M / self._metres

    @contextmanager
    def robot(self, **options: object) -> Iterator[Robot]:
        robot = self._make(replace(self._options, **options))  # type: ignore[arg-type]
        try:
            yield robot
        finally:
            with suppress(ImplicamError):
                robot.close()

    def members_and_options(self) -> None:
        robot = self._make(self._options)
        missing = missing_members(robot, Robot)
        assert not missing, f"it has no {', '.join(missing)}"
        assert robot.moves is True, "check_robot is for robots that move by themselves"
        assert robot.alone is True, "check_robot is for robots that move by themselves"
        robot.close()
        with suppress(UsageError):
            sd = self._make(replace(self._options, sd=(0.5, 0.6, 0.7))).sd
            assert np.allclose(sd, (0.5, 0.6, 0.7)), (
                f"sd is given, and neither heeded nor refused with a UsageError: {sd}"
            )
        with suppress(UsageError):
            self._make(replace(self._options, box=None))
            raise AssertionError("it can be made without a box; that must be a UsageError")

    def goes(self, robot: Robot) -> None:
        place = self._place()
        robot.open()
        robot.open()
        self._assert_stood(place, "open() moves it")
        for sign in (1.0, -1.0):
            wish = self._inside(place + sign * self._step)
            there = robot.move(wish.copy())
            assert isinstance(there, np.ndarray), f"move() returns {there!r}, not an array"
            assert there.shape == (3,), f"move() returns {there!r}, not (3,)"
            assert there.dtype == np.dtype(np.float64), f"move() returns {there.dtype}, not float64"
            for what, found in (("move()", there), ("position()", robot.position()), ("the stand-in", self._place())):
                assert self._apart(found, wish) < self._near, f"sent to {wish}, {what} says {found}"
            there[:] = 0.0
            assert self._apart(robot.position(), wish) < self._near, "move() returns its own array, not a copy"
        sd = np.array(robot.sd, dtype=np.float64)
        assert sd.shape == (3,), f"sd = {robot.sd}: it has three numbers"
        assert not (sd <= 0).any(), f"sd = {robot.sd}: they are above zero, or NaN"

    def refuses(self, robot: Robot) -> None:
        place, outside = self._place(), self._high + 0.1 * (self._high - self._low)
        for wish in (np.array([np.nan, *place[1:]]), place[:2], np.array([np.inf, *place[1:]])):
            self._assert_refused(robot, wish, place, f"{wish}, which is no position")
        for axis in range(3):
            wish = np.where(np.arange(3) == axis, outside, place)
            self._assert_refused(robot, wish, place, f"{wish}, which is outside of the box")

    def stops(self, robot: Robot) -> None:
        far, going = self._begin(robot)
        errors: list[BaseException] = []
        stoppers = [threading.Thread(target=self._stop, args=(robot, errors), daemon=True) for _ in range(2)]
        for stopper in stoppers:
            stopper.start()
        time.sleep(HALT_SECONDS)
        place = self._place()
        assert self._apart(place, far) > self._near, "stop() does not stop it: it went on to its target"
        self._assert_stood(place, f"stop() does not stop it: {HALT_SECONDS:g} s later it still moves")
        for stopper in stoppers:
            stopper.join(STOP_SECONDS)
            assert not stopper.is_alive(), f"stop() has not returned after {STOP_SECONDS:g} s"
        assert not errors, f"stop(), twice from other threads, raises {errors[0]!r}"
        going.failed("once it was stopped")
        self._assert_stood(place, "it goes on after it was stopped")
        self._goes_again(robot, "after it was stopped")
        for _ in range(2):
            robot.stop()
        self._goes_again(robot, "after a stop while it stood still")

    def survives(self, robot: Robot) -> None:
        """A link that falls silent, and one that breaks, each while it moves."""
        silence, cut = self._stand_in.silence, self._stand_in.cut
        if silence is not None:
            _, going = self._begin(robot)
            silence(True)
            try:
                going.failed("when the robot falls silent")
            finally:
                silence(False)
            self._honest_until_it_stands(robot, "fell silent")
        if cut is not None:
            _, going = self._begin(robot)
            cut()
            going.failed("when its link breaks")
            self._honest_until_it_stands(robot, "lost its link")

    def dry_run(self) -> None:
        place = self._place()
        with self.robot(dry_run=True) as robot:
            robot.open()
            there = robot.move(self._inside(place + self._step))
            robot.stop()
            self._assert_stood(place, "a dry run moves it")
            assert self._apart(there, place) < self._near, "a dry run says that it has moved"

    def speed(self) -> None:
        step = SLOW_STEP_M / self._metres
        try:
            robot = self._make(replace(self._options, speed=SLOW_M_S))
        except UsageError:
            return  # it cannot be told, and says so
        try:
            robot.open()
            wish = self._inside(self._place() + np.array([step, 0.0, 0.0]))
            way, begun = self._apart(wish, self._place()) * self._metres, time.monotonic()
            robot.move(wish)
            seconds = time.monotonic() - begun
            assert seconds > 0.8 * way / SLOW_M_S, (
                f"told to go at {SLOW_M_S:g} m/s it goes {way:g} m in {seconds:.2f} s; "
                "a speed that is not heeded must be refused with a UsageError"
            )
        finally:
            robot.close()

    # inside

    @property
    def _step(self) -> Floats:
        return np.asarray(STEP_SHARE * (self._high - self._low))

    def _inside(self, xyz: Floats) -> Floats:
        return np.clip(xyz, self._low, self._high)

    def _place(self) -> Floats:
        return np.array(self._stand_in.place(), dtype=np.float64)

    @staticmethod
    def _apart(a: Floats, b: Floats) -> float:
        return float(np.linalg.norm(np.asarray(a) - b))

    def _begin(self, robot: Robot) -> tuple[Floats, _Move]:
        """A long move, that has begun."""
        place, middle = self._place(), (self._low + self._high) / 2
        far = middle + np.where(place < middle, 1.0, -1.0) * (FAR_SHARE / 2) * (self._high - self._low)
        going, end = _Move(robot, far), time.monotonic() + BEGIN_SECONDS
        while self._apart(self._place(), place) < 5 * STILL_M / self._metres:
            assert not going.over, f"a move to {far}, which is inside the box, did not begin: {going.error!r}"
            assert time.monotonic() < end, f"a move to {far} has not begun within {BEGIN_SECONDS:g} s"
            time.sleep(0.01)
        assert self._apart(self._place(), far) > self._near, "the way is too short to stop on: slow the stand-in down"
        return far, going

    def _stands(self, place: Floats) -> bool:
        time.sleep(LOOK_SECONDS)
        return self._apart(self._place(), place) < STILL_M / self._metres

    def _assert_stood(self, place: Floats, otherwise: str) -> None:
        assert self._stands(place), otherwise

    def _assert_refused(self, robot: Robot, wish: Floats, place: Floats, what: str) -> None:
        try:
            robot.move(wish)
        except HardwareError as error:
            _assert_says_all(error, f"the refusal of {what}")
        except Exception as error:
            raise AssertionError(f"move({what}) raises {error!r}, not a HardwareError") from error
        else:
            raise AssertionError(f"it takes {what}")
        self._assert_stood(place, f"it refuses {what}, and moves")

    @staticmethod
    def _stop(robot: Robot, errors: list[BaseException]) -> None:
        try:
            robot.stop()
        except BaseException as error:
            errors.append(error)

    def _goes_again(self, robot: Robot, when: str) -> None:
        wish = self._inside(self._place() - np.sign(self._place() - (self._low + self._high) / 2) * self._step)
        try:
            robot.move(wish)
        except ImplicamError as error:
            raise AssertionError(f"it does not move again {when}: {error}") from error
        assert self._apart(self._place(), wish) < self._near, f"it does not go where it is told {when}"

    def _honest_until_it_stands(self, robot: Robot, after: str) -> None:
        """position() is where it stands, or a HardwareError; then it moves again."""
        end = time.monotonic() + BEGIN_SECONDS
        while True:
            assert time.monotonic() < end, f"it does not come back after it {after}"
            try:
                here = robot.position()
            except HardwareError as error:
                _assert_says_all(error, f"position() after it {after}")
                time.sleep(LOOK_SECONDS)
                continue
            place = self._place()
            assert self._stands(place), f"position() says {here} while it still moves, after it {after}"
            assert self._apart(here, place) < self._near, f"position() says {here} and it stands at {place}"
            break
        self._goes_again(robot, f"after it {after}")


def _assert_says_all(error: BaseException, what: str) -> None:
    assert isinstance(error, HardwareError), f"{what} raises {error!r}, not a HardwareError"
    said = all((error.what, error.why, error.fix))
    assert said, f"{what}: the error must say what, why and how to fix it: {error}"
