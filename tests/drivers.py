"""What the tests of the drivers share: pictures that tell their number, a simulated rig, and that no thread is left."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from implicam import hardware
from implicam.errors import ImplicamError
from implicam.hardware import SimulatedRobot
from implicam.simulate import build_rig

BOX = ((0.0, 0.0, 0.0), (600.0, 600.0, 600.0))
SHAPE = (48, 64)


def picture(number: int) -> np.ndarray:
    """Grey (48, 64): its mean tells the number, up to 25."""
    return np.full(SHAPE, 10 * (number % 25) + 5, np.uint8)


def number_in(frame: hardware.Frame) -> int:
    return round((float(frame.picture.mean()) * 255 - 5) / 10)


@pytest.fixture(autouse=True)
def nothing_left() -> Iterator[None]:
    """Threads that a driver started have ended after the test."""
    before = set(threading.enumerate())
    yield
    end = time.monotonic() + 60
    while (left := set(threading.enumerate()) - before) and time.monotonic() < end:
        time.sleep(0.01)
    assert not left


RIG = build_rig("stereo", seed=1)
ONE = build_rig("stereo", seed=1, cameras="cam1")


def simulated_robot(*, sd: float = 0.0, speed: float = 1e5) -> SimulatedRobot:
    return SimulatedRobot(np.zeros(3), sd=sd, speed=speed, rng=np.random.default_rng(7))


def says_all(error: ImplicamError) -> None:
    assert error.what
    assert error.why
    assert error.fix


def write_film(path: Path, pictures: int) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, SHAPE[::-1])
    assert writer.isOpened()
    for number in range(1, pictures + 1):
        writer.write(cv2.cvtColor(picture(number), cv2.COLOR_GRAY2BGR))
    writer.release()
    return path
