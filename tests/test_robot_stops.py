"""Ctrl-C and SIGTERM stop a robot that is on its way, at once: `implicam acquire` in a process of its own."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command_line import UNWATCHED
from implicam.errors import HardwareError
from implicam.session.setup import Setup, open_session
from test_hardware_robots import HOST, Controller, controller  # noqa: F401  a fixture
from toy_robot import RIG

pytestmark = pytest.mark.usefixtures("looks_kept")

HALT_SECONDS = 0.5

ACQUIRE = f"""
import signal, sys, threading, time
sys.path.insert(0, {str(Path(__file__).parent)!r})
import toy_robot
from implicam.cli import main
from implicam.hardware import CAMERAS, ROBOTS
from implicam.viewer.bench_page import BenchPage

signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background of a shell ignores it
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # and after nohup
CAMERAS.register("toy", toy_robot.ToyCamera)
ROBOTS.register("toy", toy_robot.ToyRobot)
begin = BenchPage.start

def start(page):
    begin(page)
    threading.Thread(target=press_go, args=(page,), daemon=True).start()

def press_go(page):
    while page._controller.state.phase != "aim":
        time.sleep(0.01)
    asked = page.do(dict(word="go"))["ask"]
    page.do(dict(word="go", yes=asked["number"]))
    while True:
        print(time.monotonic(), *toy_robot.AXES.place(), flush=True)
        time.sleep(0.02)

BenchPage.start = start
main(sys.argv[1:])
"""


def begun(folder: Path, robot: str, workspace: str) -> subprocess.Popen[str]:
    words = f"acquire s --no-browser --port 0 --radius 8 --robot {robot} --speed 0.02 --workspace={workspace}".split()
    cameras = [f"--camera={camera.name}=toy:{number}" for number, camera in enumerate(RIG.cameras)]
    command = [sys.executable, "-c", ACQUIRE, *words, *cameras]
    return subprocess.Popen(command, cwd=folder, env=UNWATCHED, stdout=-1, stderr=-1, text=True)


def waited(true: Callable[[], bool], seconds: float) -> float:
    """Seconds until it was true."""
    start = time.monotonic()
    while not true():
        assert time.monotonic() < start + seconds, f"not within {seconds:g} s"
        time.sleep(0.01)
    return time.monotonic() - start


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals")
@pytest.mark.parametrize("sent", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_the_arm_halts_when_the_session_is_ended(
    controller: Controller,
    tmp_path: Path,
    sent: str,
) -> None:
    pytest.importorskip("starlette")
    process = begun(tmp_path, f"ur:{HOST}", "0:600,0:600,0:600")
    waited(lambda: bool(controller.tell()["moving"]), 60)
    process.send_signal(signal.Signals[sent])
    seconds = waited(lambda: not controller.tell()["moving"], 10)
    state = controller.tell()
    out, err = process.communicate(timeout=180)
    assert seconds < HALT_SECONDS, out + err
    assert controller.tell()["pose"] == state["pose"]
    assert np.linalg.norm(np.subtract(state["pose"], state["moves"][-1][:6])) > 0.01  # it was on its way
    print(f"{sent}: {seconds:.2f} s, exit code {process.returncode}")
    assert process.returncode in (0, 130, 128 + signal.SIGTERM), out + err  # the last: cut off while it closed


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals")
def test_a_robot_of_a_package_halts_at_ctrl_c(tmp_path: Path) -> None:
    pytest.importorskip("starlette")
    corners = RIG.volume.world_from_box.apply((np.mgrid[0:2, 0:2, 0:2].reshape(3, -1).T - 0.5) * RIG.volume.size)
    workspace = ",".join(f"{a:.1f}:{b:.1f}" for a, b in zip(corners.min(axis=0), corners.max(axis=0), strict=True))
    process = begun(tmp_path, "toy:1", workspace)
    assert process.stdout is not None
    lines: list[list[float]] = []

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            with suppress(ValueError):
                lines.append([float(word) for word in line.split()])

    reader = threading.Thread(target=read)
    reader.start()
    waited(lambda: len(lines) > 10 and lines[-1][1:] != lines[-10][1:], 60)
    sent = time.monotonic()
    process.send_signal(signal.SIGINT)
    process.wait(timeout=180)
    reader.join()
    process.stdout.close()
    process.stderr.close()
    places = np.array([line for line in lines if len(line) == 4])
    moved = places[:-1, 0][np.any(np.diff(places[:, 1:], axis=0) != 0, axis=1)]
    print(f"SIGINT: {moved[-1] - sent:.2f} s, the process lived {places[-1, 0] - sent:.2f} s")
    assert moved[-1] - sent < HALT_SECONDS
    assert process.returncode in (0, 130)


SLOW = Setup(rig="stereo", speed=1e-4)  # hours to get there


def test_leaving_a_session_stops_its_robot_before_anything_is_waited_for(tmp_path: Path) -> None:
    with open_session(tmp_path / "s", SLOW) as guided:
        guided.start()
        going = threading.Thread(target=guided.go)
        going.start()
        waited(lambda: guided.state.phase == "moving", 10)
        with guided._camera_lock:  # a camera takes its time
            guided.leave()
            going.join(timeout=60)
            assert not going.is_alive()
        assert guided.state.phase == "trouble"
        guided.go()  # pressed just before
        assert "was stopped" in guided.state.message
        guided.start()  # the page again
        assert guided.state.phase == "aim"


def test_a_session_that_is_closed_stops_its_robot(tmp_path: Path) -> None:
    guided = open_session(tmp_path / "s", SLOW)
    guided.start()
    going = threading.Thread(target=guided.go)
    going.start()
    waited(lambda: guided.state.phase == "moving", 10)
    guided.close()
    going.join(timeout=60)
    assert not going.is_alive()


def test_a_dead_link_does_not_keep_a_session_from_being_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost() -> None:
        raise HardwareError("the connection is lost.")

    with open_session(tmp_path / "s", replace(SLOW, speed=1e6)) as guided:
        guided.start()
        guided.set_auto(True)
        monkeypatch.setattr(guided.equipment.robot, "stop", lost)
        guided.leave()
        assert not guided.state.auto


def test_ctrl_c_in_the_thread_that_moves_stops_the_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_session(tmp_path / "s", SLOW) as guided:
        guided.start()
        stopped = []
        driver = guided.equipment.robot.driver  # type: ignore[attr-defined]

        def interrupted(xyz: np.ndarray) -> np.ndarray:
            raise KeyboardInterrupt

        monkeypatch.setattr(driver, "move", interrupted)
        monkeypatch.setattr(driver, "stop", lambda: stopped.append(True))
        with pytest.raises(KeyboardInterrupt):
            guided.go()
        assert stopped == [True]
        assert guided.state.phase == "aim"


def test_a_robot_that_moves_while_it_is_photographed_is_trouble(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_session(tmp_path / "s", replace(SLOW, speed=1e6)) as guided:
        guided.start()
        camera, driver = guided.equipment.cameras[0], guided.equipment.robot.driver  # type: ignore[attr-defined]
        plain = camera.frame

        def frame(timeout: float = 5.0) -> object:
            driver._reported = driver._reported + 1.0
            return plain(timeout)

        with monkeypatch.context() as pushed:
            pushed.setattr(camera, "frame", frame)
            guided.go()
        assert "the robot moved 1.73 mm while the pictures were taken" in guided.state.message
        guided.retry()
        guided.go()
        assert guided.state.phase == "shown"
