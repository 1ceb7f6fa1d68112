"""The recipe "A robot" of CONTRIBUTING.md, followed to the letter by tests/toy_robot.py: a session is run with it."""

from __future__ import annotations

import threading
import time
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import numpy as np
import pytest

from command_line import Cli, cli  # noqa: F401  a fixture
from implicam import registry
from implicam.calibrators import load_calibration
from implicam.errors import UsageError
from implicam.hardware import CAMERAS, ROBOTS, TRIGGERS, camera_from, robot_from, trigger_from
from implicam.session import Session, is_session
from implicam.session.controller import CALIBRATION_FILE
from implicam.session.setup import Setup, open_session
from test_hardware_robots import HOST
from toy_robot import AXES, RIG, ToyCamera, ToyRobot, ToyTrigger

pytestmark = pytest.mark.usefixtures("looks_kept")

CORNERS = RIG.volume.world_from_box.apply((np.mgrid[0:2, 0:2, 0:2].reshape(3, -1).T - 0.5) * RIG.volume.size)
BOX = CORNERS.min(axis=0), CORNERS.max(axis=0)
CAMERA_SPECS = tuple((camera.name, f"toy:{number}") for number, camera in enumerate(RIG.cameras))
WORKSPACE = ",".join(f"{low:.1f}:{high:.1f}" for low, high in zip(*BOX, strict=True))


@pytest.fixture(autouse=True, params=["registered", "entry point"])
def known_drivers(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    for drivers in (CAMERAS, ROBOTS, TRIGGERS):
        monkeypatch.setattr(drivers, "_parts", dict(drivers._parts))  # so that they are gone after the test
    if request.param == "registered":
        ROBOTS.register("toy", ToyRobot)
        CAMERAS.register("toy", ToyCamera)
        TRIGGERS.register("toy", ToyTrigger)
    else:
        added = EntryPoints(
            [
                EntryPoint("toy", "toy_robot:ToyRobot", "implicam.robots"),
                EntryPoint("toy", "toy_robot:ToyCamera", "implicam.cameras"),
                EntryPoint("toy", "toy_robot:ToyTrigger", "implicam.triggers"),
            ]
        )
        monkeypatch.setattr(registry, "entry_points", lambda **by: added.select(**by))


@pytest.fixture(autouse=True)
def rested(monkeypatch: pytest.MonkeyPatch) -> None:
    """The axes stand in the middle, and are fast."""
    AXES.silent, AXES.link = False, 0
    AXES.go(AXES.link, RIG.volume.world_from_box.translation, 1e9)
    monkeypatch.setattr(AXES, "haste", 100.0)
    time.sleep(0.001)


def test_words_name_it_and_what_is_missing_is_told() -> None:
    made = robot_from("toy:/dev/ttyUSB0", box=BOX)
    assert isinstance(made.driver, ToyRobot)
    assert made.port == "/dev/ttyUSB0"
    assert isinstance(camera_from("left", "toy:1"), ToyCamera)
    with pytest.raises(UsageError, match="needs a box"):
        robot_from("toy:/dev/ttyUSB0")
    with pytest.raises(UsageError, match=r"names no robot[\s\S]*toy:PORT"):
        robot_from("toy", box=BOX)
    with pytest.raises(UsageError, match=r"did you mean 'toy'[\s\S]*toy:PORT"):
        robot_from("toi:1", box=BOX)
    with pytest.raises(UsageError, match=r"names no camera[\s\S]*toy:NUMBER"):
        camera_from("left", "toy:left")
    assert isinstance(trigger_from("toy:3"), ToyTrigger)
    with pytest.raises(UsageError, match=r"names no trigger[\s\S]*toy:LINE"):
        trigger_from("toy")


def test_what_it_cannot_heed_is_refused_and_the_rest_is_heeded() -> None:
    assert robot_from("toy:1", box=BOX, sd=(1.0, 2.0, 3.0)).sd == (1.0, 2.0, 3.0)
    with pytest.raises(UsageError, match="does not heed tool"):
        robot_from("toy:1", box=BOX, tool=(0.0, 0.0, 50.0))
    with pytest.raises(UsageError, match="two corners"):
        robot_from("toy:1", box=((0, 0, 0), (1, 1)))


@pytest.mark.slow
def test_a_session_is_run_with_it_and_goes_on(tmp_path: Path) -> None:
    setup = Setup(cameras=CAMERA_SPECS, robot="toy:1", trigger="toy:3", workspace=WORKSPACE, budget=9, radius=8.0)
    with open_session(tmp_path / "s", setup, say=lambda text: None) as controller:
        controller.start()
        for _ in range(4):
            controller.go()
            controller.accept()
        assert isinstance(controller.equipment.trigger, ToyTrigger)
        assert controller.equipment.trigger.fired == 4
    with open_session(tmp_path / "s", None, auto=True) as controller:
        controller.run()
        assert controller.state.phase == "done", controller.state.message
        assert controller.loop.points == 9
    made = load_calibration(tmp_path / "s" / CALIBRATION_FILE)
    np.testing.assert_allclose(made.data.known.sd[0], 0.01)


def test_nothing_moves_in_a_dry_run(tmp_path: Path) -> None:
    said: list[str] = []
    setup = Setup(cameras=CAMERA_SPECS, robot="toy:1", workspace=WORKSPACE, radius=8.0, dry_run=True)
    place = AXES.place()
    with open_session(tmp_path / "s", setup, say=said.append) as controller:
        controller.start()
        controller.go()
        assert controller.state.phase == "shown"
        np.testing.assert_array_equal(controller.state.position, place)
        np.testing.assert_array_equal(AXES.place(), place)
        with pytest.raises(UsageError, match="dry run"):
            controller.accept()
    assert any(text.startswith("dry run, toy:1: from (") for text in said)


@pytest.mark.slow
def test_a_robot_that_goes_on_by_itself_is_not_photographed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its link falls silent on the way, and comes back before it has arrived."""
    setup = Setup(cameras=CAMERA_SPECS, robot="toy:1", workspace=WORKSPACE, radius=8.0, speed=0.1)
    with open_session(tmp_path / "s", setup, say=lambda text: None) as controller:
        controller.start()
        controller.go()
        controller.accept()
        monkeypatch.setattr(AXES, "haste", 0.2)
        silence = threading.Timer(0.3, AXES.silence, (True,))
        silence.start()
        controller.go()
        silence.join()
        assert "does not answer" in controller.state.message
        AXES.silence(False)
        for again in (controller.redo, controller.go):
            again()
            assert controller.state.phase == "trouble"
            assert "the toy moves" in controller.state.message
            with pytest.raises(UsageError, match="nothing to accept"):
                controller.accept()
        AXES.halt(AXES.link)
        monkeypatch.setattr(AXES, "haste", 100.0)
        controller.retry()
        controller.go()
        assert controller.state.phase == "shown"


def test_a_driver_of_a_package_is_asked_before_those_here(tmp_path: Path) -> None:
    (tmp_path / "folder.toy").mkdir()
    assert isinstance(camera_from("left", "1.toy"), ToyCamera)
    for spec in ("toy", "TOY:1", "Toy"):
        with pytest.raises(UsageError, match=r"toy:NUMBER") as error:
            camera_from("left", spec)
        assert "did you mean 'toy'" in str(error.value) or "is a driver's name" in str(error.value)
        assert f"{spec!r} names no camera (did you mean {spec!r}" not in str(error.value)
    with pytest.raises(UsageError, match="did you mean 'toy'"):
        robot_from("TOY:1", box=BOX)


@pytest.mark.slow
def test_a_robot_that_does_not_answer_is_said_at_once_and_not_kept(cli: Cli, tmp_path: Path) -> None:
    cameras = ["--no-browser", "--port", "0", "--camera", "cam1=toy:0", "--camera", "cam2=toy:1"]
    words = ["acquire", "s", *cameras, f"--workspace={WORKSPACE}"]
    for address, says in ((HOST, "30004"), ("no-such-host.invalid", "30004")):
        pytest.importorskip("rtde_receive", reason="the extra robot is not installed")
        ran = cli(*words, "--robot", f"ur:{address}")
        assert (ran.code, says in ran.err) == (1, True), ran.err
        assert not is_session(tmp_path / "s")
    open_session(tmp_path / "s", Setup(cameras=CAMERA_SPECS, robot="toy:1", workspace=WORKSPACE)).close()
    AXES.silence(True)
    ran = cli("acquire", "s", "--no-browser", "--port", "0", "--robot", "toy:2")
    assert (ran.code, "the toy at 2 does not answer" in ran.err) == (1, True), ran.err
    with Session.open(tmp_path / "s") as session:
        assert session.settings["robot"] == "toy:1"


@pytest.mark.slow
def test_a_session_whose_driver_is_gone_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_session(tmp_path / "s", Setup(cameras=CAMERA_SPECS, robot="toy:1", workspace=WORKSPACE)).close()
    monkeypatch.setattr(registry, "entry_points", lambda **by: EntryPoints())
    monkeypatch.setattr(ROBOTS, "_parts", {key: part for key, part in ROBOTS._parts.items() if key != "toy"})
    with pytest.raises(UsageError, match=r"cannot go on: 'toy:1' names no robot") as error:
        open_session(tmp_path / "s", None)
    assert "it was begun with --camera cam1=toy:0 --camera cam2=toy:1 --robot toy:1" in error.value.why
    assert "Where a package brought what is missing, install it again" in error.value.fix


def test_the_command_line_knows_it(cli: Cli) -> None:
    words = ["acquire", "s", "--camera", "cam1=toy:0", "--camera", "cam2=toy:1", "--unattended"]
    told = " ".join(cli(*words, "--robot", "toy:1", "--workspace", WORKSPACE).err.split())
    assert "--unattended is for the simulated rig" in told
    told = " ".join(cli("acquire", "s", "--no-browser", "--camera", "cam1=toy:0", "--robot", "toi:1").err.split())
    assert "did you mean 'toy'" in told
    assert "toy:PORT" in told
    told = " ".join(cli("acquire", "--help").out.replace("│", " ").split())
    for spec in ("toy:PORT", "toy:NUMBER", "toy:LINE"):
        assert spec in told
