"""What stands between a session and any robot, for the driver that forgot something."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from drivers import BOX, says_all
from implicam.errors import HardwareError, UsageError
from implicam.hardware import GuardedRobot, Person, RobotOptions, guard_robot
from implicam.hardware.protocol import Floats


class Careless:
    """Goes wherever it is told, at once, whatever the options are."""

    moves = alone = True
    sd = (np.nan, np.nan, np.nan)

    def __init__(self) -> None:
        self.here: Any = np.array([300.0, 200.0, 400.0])
        self.moved: list[list[float]] = []
        self.stops = 0
        self.error: BaseException | None = None

    def open(self) -> None: ...
    def close(self) -> None: ...

    def position(self) -> Floats:
        return self.here

    def move(self, xyz: Floats) -> Floats:
        self.moved.append(list(xyz))
        if self.error is not None:
            raise self.error
        self.here = xyz
        return self.here

    def stop(self) -> None:
        self.stops += 1

    def reachable(self) -> None: ...


NEAR = np.array([310.0, 200.0, 400.0])


def guarded(**options: Any) -> tuple[GuardedRobot, Careless]:
    driver = Careless()
    return guard_robot(driver, RobotOptions(**{"box": BOX, **options}), "toy:1"), driver


def test_in_a_dry_run_the_driver_is_never_told_to_move() -> None:
    said: list[str] = []
    robot, driver = guarded(dry_run=True, speed=0.1, say=said.append)
    assert robot.move(NEAR).tolist() == [300, 200, 400]
    assert driver.moved == []
    assert said == ["dry run, toy:1: from (300, 200, 400) to (310, 200, 400) mm at 0.1 m/s"]
    robot.stop()
    assert driver.stops == 1


@pytest.mark.parametrize("wish", [[300, 200, 600.1], [-0.1, 200, 400], [np.nan, 0, 0], [1, 2]])
def test_the_driver_does_not_hear_of_a_move_that_leaves_the_box(wish: list[float]) -> None:
    robot, driver = guarded()
    with pytest.raises(HardwareError) as caught:
        robot.move(np.array(wish))
    says_all(caught.value)
    assert (driver.moved, driver.stops) == ([], 0)


def test_nor_of_one_that_begins_outside_nor_of_one_that_is_not_confirmed() -> None:
    robot, driver = guarded(box=((0, 0, 0), (600, 600, 300)))
    with pytest.raises(HardwareError, match=r"the robot at .* is outside of the box"):
        robot.move(np.array([300.0, 200.0, 200.0]))
    robot, refused = guarded(confirm=lambda here, there: "yes")  # only True lets it move
    with pytest.raises(HardwareError, match="was refused"):
        robot.move(NEAR)
    assert driver.moved == refused.moved == []
    robot, driver = guarded(confirm=lambda here, there: True)
    assert robot.move(NEAR).tolist() == NEAR.tolist()


@pytest.mark.parametrize("answer", [None, [1, 2], np.full(3, np.nan), "here", np.zeros((1, 3)), 3.0])
def test_what_a_driver_answers_is_checked(answer: object) -> None:
    robot, driver = guarded()
    driver.here = answer
    with pytest.raises(HardwareError, match=r"toy:1 does not say where it is: its driver's position\(\)") as caught:
        robot.position()
    says_all(caught.value)
    robot, driver = guarded()
    driver.move = lambda xyz: answer  # type: ignore[method-assign, assignment, return-value]
    with pytest.raises(HardwareError, match=r"its driver's move\(\)"):
        robot.move(NEAR)
    assert driver.stops == 1


def test_a_list_will_do_and_nobody_shares_an_array() -> None:
    robot, driver = guarded()
    driver.here = [300, 200, 400]
    assert robot.position().dtype == np.float64
    there = robot.move(NEAR)
    there[:] = 0
    assert robot.position().tolist() == NEAR.tolist()


@pytest.mark.parametrize("error", [KeyboardInterrupt(), HardwareError("silent."), OSError("cable"), SystemExit()])
def test_a_move_that_ends_with_an_error_is_stopped_and_it_has_no_position_until_it_stands(error: BaseException) -> None:
    robot, driver = guarded()
    driver.error = error
    with pytest.raises(type(error)):
        robot.move(NEAR)
    assert driver.stops == 1
    ending = threading.Event()

    def creep() -> None:  # 2 mm/s
        while not ending.wait(0.05):
            driver.here = np.add(driver.here, (0.1, 0.0, 0.0))

    creeping = threading.Thread(target=creep)
    creeping.start()
    driver.error = None
    try:
        for ask in (robot.position, lambda: robot.move(NEAR)):
            with pytest.raises(HardwareError, match="toy:1 still moves") as caught:
                ask()
            says_all(caught.value)
    finally:
        ending.set()
        creeping.join()
    assert len(driver.moved) == 1
    assert robot.position().tolist() == driver.here.tolist()
    assert robot.move(NEAR).tolist() == NEAR.tolist()


def test_a_stop_while_a_person_is_asked_is_heard() -> None:
    robot, driver = guarded(confirm=lambda here, there: robot.stop() is None)
    with pytest.raises(HardwareError, match="was stopped before it moved"):
        robot.move(NEAR)
    assert driver.moved == []


def test_a_driver_that_is_not_complete_is_refused_when_it_is_made() -> None:
    class Half:
        moves = alone = True

        def move(self, xyz: Floats) -> Floats:
            return xyz

    for half in (Half(), None):
        with pytest.raises(UsageError, match=r"the driver of half:1 is not complete: it has no .*stop") as caught:
            guard_robot(half, RobotOptions(), "half:1")  # type: ignore[arg-type]
        says_all(caught.value)


def test_a_person_is_guarded_too() -> None:
    robot = guard_robot(Person(lambda wish: None), RobotOptions(box=((0, 0, 0), (1, 1, 0))))  # a flat table
    robot.set_position(np.array([1.0, 2.0, 3.0]))
    assert robot.position().tolist() == [1, 2, 3]
    with pytest.raises(HardwareError):
        robot.set_position(np.array([1.0, 2.0]))
