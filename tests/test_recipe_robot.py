"""The recipe "A robot" of CONTRIBUTING.md, followed to the letter by tests/toy_robot.py: a session is run with it."""

from __future__ import annotations

from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import numpy as np
import pytest

from command_line import Cli, cli  # noqa: F401  a fixture
from implicam import registry
from implicam.calibrators import load_calibration
from implicam.errors import HardwareError, UsageError
from implicam.hardware import CAMERAS, ROBOTS, TRIGGERS, camera_from, robot_from, trigger_from
from implicam.session.controller import CALIBRATION_FILE
from implicam.session.setup import Setup, open_session
from toy_robot import RIG, Gantry, GantryCamera, GantryTrigger

CORNERS = RIG.volume.world_from_box.apply((np.mgrid[0:2, 0:2, 0:2].reshape(3, -1).T - 0.5) * RIG.volume.size)
BOX = CORNERS.min(axis=0), CORNERS.max(axis=0)
WORKSPACE = ",".join(f"{low:.1f}:{high:.1f}" for low, high in zip(*BOX, strict=True))


@pytest.fixture(autouse=True, params=["registered", "entry point"])
def known_drivers(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    for drivers in (CAMERAS, ROBOTS, TRIGGERS):
        monkeypatch.setattr(drivers, "_parts", dict(drivers._parts))  # so that they are gone after the test
    if request.param == "registered":
        ROBOTS.register("gantry", Gantry)
        CAMERAS.register("gantry", GantryCamera)
        TRIGGERS.register("gantry", GantryTrigger)
    else:
        added = EntryPoints(
            [
                EntryPoint("gantry", "toy_robot:Gantry", "implicam.robots"),
                EntryPoint("gantry", "toy_robot:GantryCamera", "implicam.cameras"),
                EntryPoint("gantry", "toy_robot:GantryTrigger", "implicam.triggers"),
            ]
        )
        monkeypatch.setattr(registry, "entry_points", lambda **by: added.select(**by))


def test_words_name_it_and_what_is_missing_is_told() -> None:
    made = robot_from("gantry:/dev/ttyUSB0", box=BOX)
    assert isinstance(made, Gantry)
    assert made.port == "/dev/ttyUSB0"
    assert isinstance(camera_from("left", "gantry:1"), GantryCamera)
    with pytest.raises(UsageError, match="needs a box"):
        robot_from("gantry:/dev/ttyUSB0")
    with pytest.raises(UsageError, match=r"names no robot[\s\S]*gantry:PORT"):
        robot_from("gantry", box=BOX)
    with pytest.raises(UsageError, match=r"did you mean 'gantry'[\s\S]*gantry:PORT"):
        robot_from("gantri:1", box=BOX)
    with pytest.raises(UsageError, match=r"names no camera[\s\S]*gantry:NUMBER"):
        camera_from("left", "gantry:left")
    assert isinstance(trigger_from("gantry:3"), GantryTrigger)
    with pytest.raises(UsageError, match=r"names no trigger[\s\S]*gantry:LINE"):
        trigger_from("gantry")


def test_it_keeps_the_contract_of_robots() -> None:
    robot = robot_from("gantry:1", box=BOX)
    robot.open()
    robot.open()
    wish = np.mean(BOX, axis=0)
    there = robot.move(wish)
    there[:] = 0  # the caller's copy
    np.testing.assert_array_equal(robot.position(), wish)
    with pytest.raises(HardwareError, match="out of the box"):
        robot.move(wish + 1e6)
    with pytest.raises(HardwareError):
        robot.move(np.full(3, np.nan))
    assert robot.reachable() is None
    robot.stop()
    robot.close()
    robot.close()


def test_a_session_is_run_with_it_and_goes_on(tmp_path: Path) -> None:
    cameras = tuple((camera.name, f"gantry:{number}") for number, camera in enumerate(RIG.cameras))
    setup = Setup(cameras=cameras, robot="gantry:1", trigger="gantry:3", workspace=WORKSPACE, budget=9, radius=8.0)
    with open_session(tmp_path / "s", setup, say=lambda text: None) as controller:
        controller.start()
        for _ in range(4):
            controller.go()
            controller.accept()
        assert isinstance(controller.equipment.trigger, GantryTrigger)
        assert controller.equipment.trigger.fired == 4
    with open_session(tmp_path / "s", None, auto=True) as controller:
        controller.run()
        assert controller.state.phase == "done", controller.state.message
        assert controller.loop.points == 9
    made = load_calibration(tmp_path / "s" / CALIBRATION_FILE)
    np.testing.assert_allclose(made.data.known.sd[0], 0.01)


def test_the_command_line_knows_it(cli: Cli) -> None:
    words = ["acquire", "s", "--camera", "cam1=gantry:0", "--camera", "cam2=gantry:1", "--unattended"]
    told = " ".join(cli(*words, "--robot", "gantry:1", "--workspace", WORKSPACE).err.split())
    assert "--unattended is for the simulated rig" in told
    told = " ".join(cli("acquire", "s", "--no-browser", "--camera", "cam1=gantry:0", "--robot", "gantri:1").err.split())
    assert "did you mean 'gantry'" in told
    assert "gantry:PORT" in told
    told = " ".join(cli("acquire", "--help").out.replace("│", " ").split())
    for spec in ("gantry:PORT", "gantry:NUMBER", "gantry:LINE"):
        assert spec in told
