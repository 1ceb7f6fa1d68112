"""`implicam.testing.check_robot`: the toy and the arm keep it, and each way not to is found out."""

from __future__ import annotations

import re
import threading
import time

import numpy as np
import pytest

from drivers import BOX as ARM_BOX
from drivers import nothing_left  # noqa: F401  a fixture
from implicam.errors import HardwareError
from implicam.hardware import RobotOptions, URRobot
from implicam.hardware.protocol import Box, Floats
from implicam.testing import StandIn, check_robot
from test_hardware_robots import HOST, Controller, controller  # noqa: F401  a fixture
from toy_robot import AXES, RIG, STAND_IN, ToyRobot

CORNERS = RIG.volume.world_from_box.apply((np.mgrid[0:2, 0:2, 0:2].reshape(3, -1).T - 0.5) * RIG.volume.size)
BOX = CORNERS.min(axis=0), CORNERS.max(axis=0)


@pytest.fixture(autouse=True)
def rested() -> None:
    """The axes stand in the middle."""
    AXES.silent, AXES.link = False, 0
    AXES.go(AXES.link, RIG.volume.world_from_box.translation, 1e9)
    time.sleep(0.001)


@pytest.mark.slow
def test_the_toy_keeps_the_contract_in_any_unit() -> None:
    check_robot(lambda options: ToyRobot.from_spec("1", options), BOX, STAND_IN)
    metres = StandIn(lambda: AXES.place() / 1e3, AXES.silence, AXES.cut)
    check_robot(lambda options: ToyRobot.from_spec("1", options), (BOX[0] / 1e3, BOX[1] / 1e3), metres, unit="m")


@pytest.mark.slow
def test_the_arm_keeps_the_contract(controller: Controller) -> None:
    def place() -> Floats:
        return 1e3 * np.array(controller.tell()["pose"][:3])

    arm = StandIn(place, lambda on: controller.tell(f"silent {int(on)}"), lambda: controller.tell("hang_up"))

    def make(options: RobotOptions) -> URRobot:
        robot = URRobot.from_spec(HOST, options)
        if options.speed is None:
            robot._speed = 0.25
        return robot

    check_robot(make, ARM_BOX, arm)


class NoStop(ToyRobot):
    def stop(self) -> None:
        pass


class StopsLate(ToyRobot):
    def stop(self) -> None:
        self._stopped.set()  # heard when the move is over

    def _ask(self) -> tuple[Floats, bool]:
        here, moving = super()._ask()
        if moving:
            time.sleep(0.8)
        return here, moving


class StopWaits(ToyRobot):
    def stop(self) -> None:
        super().stop()
        time.sleep(5.0)


class StopTwiceFails(ToyRobot):
    _stops = 0

    def stop(self) -> None:
        super().stop()
        self._stops += 1
        if self._stops > 1:
            raise RuntimeError("stopped already")


class ReturnsWhenStopped(ToyRobot):
    def move(self, xyz: Floats) -> Floats:
        try:
            return super().move(xyz)
        except HardwareError as error:
            if "was stopped" in error.what:
                return self.position()
            raise


class RemembersStop(ToyRobot):
    def move(self, xyz: Floats) -> Floats:
        if self._stopped.is_set():
            raise HardwareError("it was stopped.", why="stop() was called", fix="none")
        return super().move(xyz)


class NoBox(ToyRobot):
    def __init__(self, port: str, options: RobotOptions) -> None:
        super().__init__(port, options)
        self._box = Box.from_corners((np.full(3, -1e9), np.full(3, 1e9)))


class NeedsNoBox(ToyRobot):
    @classmethod
    def from_spec(cls, rest: str, options: RobotOptions) -> ToyRobot:
        return cls(rest, RobotOptions(box=BOX) if options.box is None else options)


class NoDryRun(ToyRobot):
    def __init__(self, port: str, options: RobotOptions) -> None:
        super().__init__(port, options)
        self._dry = False


class SaysItMoved(ToyRobot):
    def move(self, xyz: Floats) -> Floats:
        return xyz if self._dry else super().move(xyz)


class Deaf(ToyRobot):
    """Waits for an answer for ever."""

    def _ask(self) -> tuple[Floats, bool]:
        while AXES.silent and not ended.is_set():
            time.sleep(0.01)
        return super()._ask()


class OwnError(ToyRobot):
    def _lost_error(self, error: OSError) -> HardwareError:
        self._link = None
        raise ConnectionError("the link is dead")


class Mute(ToyRobot):
    def _lost_error(self, error: OSError) -> HardwareError:
        self._link = None
        return HardwareError("lost.")


class NeverComesBack(ToyRobot):
    def open(self) -> None:
        if self._link is None:
            self._link = 0


class PositionWhileItMoves(ToyRobot):
    def position(self) -> Floats:
        return self._ask()[0]


class Homes(ToyRobot):
    def open(self) -> None:
        super().open()
        AXES.go(AXES.link, BOX[0], 250.0)


class OwnArray(ToyRobot):
    def move(self, xyz: Floats) -> Floats:
        self._there = super().move(xyz)
        return self._there

    def position(self) -> Floats:
        return getattr(self, "_there", super().position())


class ReturnsList(ToyRobot):
    def move(self, xyz: Floats) -> Floats:
        return super().move(xyz).tolist()  # type: ignore[return-value]


class TakesAnything(ToyRobot):
    def move(self, xyz: Floats) -> Floats:
        return super().move(np.nan_to_num(np.resize(xyz, 3), nan=AXES.place()[0], posinf=AXES.place()[0]))


class OwnSpeed(ToyRobot):
    def __init__(self, port: str, options: RobotOptions) -> None:
        super().__init__(port, options)
        self._speed = 250.0


class OwnSd(ToyRobot):
    def __init__(self, port: str, options: RobotOptions) -> None:
        super().__init__(port, options)
        self.sd = (0.01, 0.01, 0.01)


class LeavesThread(ToyRobot):
    def open(self) -> None:
        if self._link is None:
            threading.Thread(target=ended.wait, args=(60.0,), name="left over").start()
        super().open()


ended = threading.Event()

BAD = {
    NoStop: "stop() does not stop it",
    StopsLate: "stop() does not stop it",
    StopWaits: "stop() has not returned after 2 s",
    StopTwiceFails: "twice from other threads, raises RuntimeError",
    ReturnsWhenStopped: "returns as if it had arrived, once it was stopped",
    RemembersStop: "does not move again after it was stopped",
    NoBox: "which is outside of the box",
    NeedsNoBox: "without a box",
    NoDryRun: "a dry run moves it",
    SaysItMoved: "a dry run says that it has moved",
    Deaf: "waits for ever when the robot falls silent",
    OwnError: "when the robot falls silent raises ConnectionError",
    Mute: "must say what, why and how to fix it",
    NeverComesBack: "does not come back after it lost its link",
    PositionWhileItMoves: "while it still moves",
    Homes: "open() moves it",
    OwnArray: "its own array",
    ReturnsList: "not an array",
    TakesAnything: "which is no position",
    OwnSpeed: "a speed that is not heeded must be refused",
    OwnSd: "sd is given",
    LeavesThread: "leaves threads: left over",
}


@pytest.mark.slow
@pytest.mark.parametrize("driver", BAD, ids=lambda driver: driver.__name__)
def test_a_driver_that_breaks_it_is_found_out(driver: type[ToyRobot], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("implicam.hardware.contract.ANSWER_SECONDS", 2.0)
    monkeypatch.setattr("implicam.hardware.contract.BEGIN_SECONDS", 3.0)
    ended.clear()
    try:
        with pytest.raises(AssertionError, match=re.escape(BAD[driver])):
            check_robot(lambda options: driver.from_spec("1", options), BOX, STAND_IN)
    finally:
        ended.set()
        AXES.silent = False
