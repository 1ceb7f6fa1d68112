"""Robots, the simulated rig and triggers: one contract over every robot, then what is special to each."""

import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers import BOX, ONE, RIG, nothing_left, says_all, simulated_robot, write_film  # noqa: F401  a fixture
from implicam import hardware
from implicam.detect import Ball, View
from implicam.errors import HardwareError, UsageError
from implicam.hardware import (
    CsvPlayer,
    FolderCamera,
    GenICamCamera,
    MovedByHand,
    NetworkTrigger,
    OpenCVCamera,
    Person,
    TriggerSimulator,
    URRobot,
    camera_from,
    robot_from,
    simulated_rig,
    trigger_from,
)

pytestmark = pytest.mark.usefixtures("looks_kept")

# ---- robots --------------------------------------------------------------------------------------------------------


HOST = f"127.{os.getpid() >> 16 & 63}.{os.getpid() >> 8 & 255}.{os.getpid() & 255 or 1}"
"""The ports of a controller are fixed, so that each process of the tests has an address of its own on the loopback."""


class Controller:
    """The simulated UR controller, in its own process."""

    def __init__(self) -> None:
        script = Path(__file__).with_name("rtde_stand_in.py")
        self.process = subprocess.Popen(
            [sys.executable, str(script), HOST], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "ready\n"

    def tell(self, line: str = "state") -> dict[str, Any]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        return dict(json.loads(self.process.stdout.readline()))

    def end(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def controller(monkeypatch: pytest.MonkeyPatch) -> Iterator[Controller]:
    pytest.importorskip("rtde_control", reason="the extra robot is not installed")
    monkeypatch.setattr("implicam.hardware.ur.SILENCE_SECONDS", 3.0)  # it shares the cores with other tests
    made = Controller()
    yield made
    made.end()


@pytest.fixture
def arm(controller: Controller) -> Iterator[URRobot]:
    robot = URRobot(HOST, box=BOX, speed=0.25)
    yield robot
    robot.close()


@pytest.fixture(params=["csv", "person", "simulated", "ur"])
def robot(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[hardware.Robot]:
    if request.param == "ur":
        yield request.getfixturevalue("arm")
    elif request.param == "simulated":
        yield simulated_robot(sd=0.1)
    elif request.param == "csv":
        path = tmp_path / "places.csv"
        path.write_text("x,y,z,sd_x,sd_y,sd_z\n300,210,400,1,1,2\n320,200,400,,,\n")
        yield CsvPlayer(path)
    else:
        person = Person(lambda xyz: person.set_position(xyz))
        yield person


def test_a_robot_goes_where_it_is_told_and_knows_it(robot: hardware.Robot) -> None:
    robot.open()
    robot.open()
    for wish in ([300.0, 210.0, 400.0], [320.0, 200.0, 400.0]):
        there = robot.move(np.array(wish))
        assert there.shape == (3,)
        assert there.dtype == np.float64
        assert np.allclose(there, wish, atol=0.6)
        assert np.allclose(robot.position(), there, atol=0.6)
        there[:] = 0  # the caller's copy
        assert np.allclose(robot.position(), wish, atol=0.6)
    assert len(robot.sd) == 3
    assert all(math.isnan(sd) or sd > 0 for sd in robot.sd)
    assert robot.moves is (not isinstance(robot, Person))
    places = robot.reachable()
    assert places is None or places.shape == (0, 3)
    robot.stop()
    robot.close()
    robot.close()


@pytest.mark.parametrize("wish", [[np.nan, 0.0, 0.0], [0.0, 0.0], [np.inf, 1.0, 1.0]])
def test_no_robot_goes_to_what_is_no_place(robot: hardware.Robot, wish: list[float]) -> None:
    with pytest.raises(HardwareError) as caught:
        robot.move(np.array(wish))
    says_all(caught.value)


def test_the_arm_moves_in_metres_with_its_tool_and_orientation(controller: Controller) -> None:
    robot = URRobot(HOST, (0.0, 0.0, 50.0), box=BOX, speed=0.2)
    robot.move(np.array([310.0, 220.0, 410.0]))
    state = controller.tell()
    assert np.allclose(state["tcp"], [0, 0, 0.05, 0, 0, 0])
    assert np.allclose(state["moves"], [[0.31, 0.22, 0.41, 0.0, 3.0, 0.5, 0.2, 0.3, 1]])
    robot.close()
    assert controller.tell()["running"] is False  # its program was ended
    assert robot.sd == pytest.approx((0.1, 0.1, 0.1))
    assert URRobot(HOST, box=BOX, unit="m").sd == pytest.approx((1e-4,) * 3)


def on_its_way(controller: Controller, act: Callable[[], object]) -> threading.Thread:
    """Does something as soon as the arm has left (300, 200) towards (500, 500), however busy the machine is."""

    def wait_and_act() -> None:
        way = 0.0
        while way < 0.1:
            time.sleep(0.02)
            x, y = controller.tell()["pose"][:2]  # m
            way = float(np.hypot(1e3 * x - 300, 1e3 * y - 200) / np.hypot(200, 300))
        act()

    thread = threading.Thread(target=wait_and_act)
    thread.start()
    return thread


def test_stop_stops_the_arm_on_its_way(controller: Controller, arm: URRobot) -> None:
    arm.open()
    stopper = on_its_way(controller, arm.stop)
    with pytest.raises(HardwareError, match="was stopped at") as caught:
        arm.move(np.array([500.0, 500.0, 400.0]))
    stopper.join()
    says_all(caught.value)
    here = arm.position()
    assert 0.1 < np.linalg.norm(here - [300, 200, 400]) / np.hypot(200, 300) < 0.9
    time.sleep(0.1)
    assert np.array_equal(arm.position(), here)
    assert np.allclose(arm.move(np.array([300.0, 200.0, 400.0])), [300, 200, 400], atol=0.5)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("protective 1", "protective stop"),
        ("emergency 1", "emergency stop"),
        ("off 1", "no power"),
        pytest.param("silent 1", "connection .* is lost", marks=pytest.mark.slow),
        ("hang_up", "connection .* is lost"),
    ],
)
def test_what_halts_the_arm_on_its_way_is_named(controller: Controller, arm: URRobot, line: str, words: str) -> None:
    arm.open()
    halting = on_its_way(controller, lambda: controller.tell(line))
    with pytest.raises(HardwareError, match=words) as caught:
        arm.move(np.array([500.0, 500.0, 400.0]))
    halting.join()
    says_all(caught.value)
    if "lost" not in words:
        with pytest.raises(HardwareError, match=words):
            arm.move(np.array([300.0, 200.0, 400.0]))
    controller.tell(line.replace("1", "0") if line != "hang_up" else "state")
    time.sleep(0.1)  # a report of before may be on its way
    assert np.allclose(arm.move(np.array([300.0, 200.0, 400.0])), [300, 200, 400], atol=0.5)


@pytest.mark.parametrize("line", ["short 1", "script_fails 1"])
def test_an_arm_that_does_not_arrive_is_found_out(
    controller: Controller, arm: URRobot, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("implicam.hardware.ur.STANDSTILL_SECONDS", 0.5)
    controller.tell(line)
    with pytest.raises(HardwareError, match=r"stands (10|20)\.00 mm from its target"):
        arm.move(np.array([320.0, 200.0, 400.0]))


def test_nothing_is_sent_that_leaves_the_box_or_is_refused(controller: Controller) -> None:
    asked: list[tuple[list[float], list[float]]] = []

    def confirm(here: np.ndarray, there: np.ndarray) -> bool:
        asked.append((here.tolist(), there.tolist()))
        return False

    robot = URRobot(HOST, box=BOX, confirm=confirm)
    with pytest.raises(HardwareError, match=r"the target .* is outside of the box"):
        robot.move(np.array([300.0, 200.0, 600.1]))
    assert asked == []
    with pytest.raises(HardwareError, match="was refused"):
        robot.move(np.array([300.0, 200.0, 500.0]))
    assert np.allclose(asked, [([300, 200, 400], [300, 200, 500])])
    robot.close()
    inside = URRobot(HOST, box=((0, 0, 0), (600, 600, 300)))  # the arm stands above it
    with pytest.raises(HardwareError, match=r"the robot .* is outside of the box"):
        inside.move(np.array([300.0, 200.0, 200.0]))
    inside.close()
    assert controller.tell()["moves"] == []


def test_a_dry_run_says_what_it_would_do_and_uploads_nothing(controller: Controller) -> None:
    said: list[str] = []
    robot = URRobot(HOST, box=BOX, dry_run=True, say=said.append)
    assert np.allclose(robot.move(np.array([310.0, 220.0, 400.0])), [300, 200, 400])
    robot.stop()
    robot.close()
    assert said == [f"dry run, {HOST}: from (300, 200, 400) to (310, 220, 400) mm at 0.1 m/s"]
    assert controller.tell() == {"pose": [0.3, 0.2, 0.4, 0, 3, 0.5], "tcp": [0] * 6, "moves": [], "running": False,
                                 "moving": False}  # fmt: skip


def test_an_arm_that_is_not_there_and_options_that_cannot_be() -> None:
    with pytest.raises(HardwareError, match="does not answer on port 30004") as caught:
        URRobot(HOST, box=BOX).open()
    says_all(caught.value)
    for options in ({"speed": 0.3}, {"speed": 0.0}, {"unit": "yard"}, {"box": ((0, 0, 0), (1, 1, 0))}, {"box": (1, 2)}):
        with pytest.raises(UsageError):
            URRobot(HOST, **{"box": BOX, **options})  # type: ignore[arg-type]


SESSION = """
import signal, sys
import numpy as np
from implicam.hardware import URRobot
signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background of a shell ignores it
robot = URRobot(sys.argv[1], box=((0, 0, 0), (600, 600, 600)), speed=0.02)
robot.open()
print("ready", flush=True)
robot.move(np.array([590.0, 590.0, 400.0]))
"""


@pytest.mark.parametrize("kill", [signal.SIGINT, signal.SIGKILL])
def test_the_arm_stops_when_the_session_is_interrupted_or_dies(controller: Controller, kill: signal.Signals) -> None:
    command = [sys.executable, "-c", SESSION, HOST]
    session = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert session.stdout is not None
    assert session.stdout.readline() == "ready\n"
    while not controller.tell()["moving"]:
        time.sleep(0.01)
    session.send_signal(kill)
    session.communicate()
    end = time.monotonic() + 10
    while ((state := controller.tell())["moving"] or state["running"]) and time.monotonic() < end:
        time.sleep(0.01)
    assert not state["moving"]
    assert not state["running"]  # its program was ended
    assert np.linalg.norm(np.array(state["pose"][:2]) - 0.59) > 0.2


def test_the_player_goes_to_the_nearest_row_that_is_left(tmp_path: Path) -> None:
    path = tmp_path / "places.csv"
    path.write_text("\ufeffname,x,y,z,sd_x,sd_y,sd_z\na,0,0,0,0.1,0.2,0.3\nb,10,0,0,,,\n\nc,20,0,0,,,\n")
    player = CsvPlayer(path)
    with pytest.raises(HardwareError, match="at none of its rows"):
        player.position()
    assert player.reachable().tolist() == [[0, 0, 0], [10, 0, 0], [20, 0, 0]]
    assert player.move(np.array([1.0, 5.0, 0.0])).tolist() == [0, 0, 0]
    assert player.sd == (0.1, 0.2, 0.3)
    assert player.move(np.array([1.0, 5.0, 0.0])).tolist() == [10, 0, 0]
    assert np.isnan(player.sd).all()
    assert player.reachable().tolist() == [[20, 0, 0]]
    player.move(np.zeros(3))
    with pytest.raises(HardwareError, match="all 3 rows"):
        player.move(np.zeros(3))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "line 1: there is no single column x, y, z"),
        ("x,y\n1,2\n", "line 1: there is no single column z"),
        ("x,y,z,z\n", "no single column z"),
        ("x,y,z\n", "no row"),
        ("x,y,z\n1,2,3\n1,,3\n", "line 3: y = ''"),
        ("x,y,z\n1,2\n", "line 2: 2 cells under 3"),
        ("x,y,z\n1,2,nan\n", "line 2: z = 'nan'"),
        ("x,y,z,sd_x\n1,2,3,-1\n", "line 2: sd_x = -1"),
    ],
)
def test_a_bad_table_is_named_with_its_line(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "places.csv"
    path.write_text(text)
    with pytest.raises(HardwareError, match=words):
        CsvPlayer(path).open()
    with pytest.raises(HardwareError, match="cannot be read"):
        CsvPlayer(tmp_path / "none.csv").open()


def test_a_person_is_only_asked() -> None:
    asked: list[list[float]] = []
    person = Person(lambda xyz: asked.append(xyz.tolist()), (0.5, 0.5, 1.0))
    with pytest.raises(HardwareError, match="it is not known yet"):
        person.position()
    assert person.move(np.array([1.0, 2.0, 3.0])).tolist() == [1, 2, 3]
    assert asked == [[1, 2, 3]]
    with pytest.raises(HardwareError, match="it is not known yet"):
        person.position()
    person.set_position(np.array([1.1, 2.0, 3.0]))
    assert person.position().tolist() == [1.1, 2.0, 3.0]
    person.move(np.zeros(3))
    with pytest.raises(HardwareError):  # what was said before is not where it is now
        person.position()


# ---- the simulated rig ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_simulated_cameras_photograph_where_the_robot_is() -> None:
    cameras, robot = simulated_rig(RIG, seed=5, sd=2.0)
    rng, seen = np.random.default_rng(6), 0
    for _ in range(4):
        parts = rng.uniform(-0.3, 0.3, size=3)
        robot.move(RIG.volume.world_from_box.apply(parts * RIG.volume.size))
        for lens, camera in zip(RIG.cameras, cameras, strict=True):
            true, _ = lens.pixel_from_world(robot.true_position[None])
            found = Ball().detect(camera.frame().picture, View(camera.name, "now"))
            seen += len(found) == 1 and bool(np.linalg.norm(found.uv[0] - true[0]) < 0.5)
            camera.cover()
            hidden = Ball().detect(camera.frame().picture, View(camera.name, "now"))
            assert not any(np.linalg.norm(uv - true[0]) < 20 for uv in hidden.uv)
    assert seen >= 7  # of 8; a look-alike may be taken for it once


def test_the_simulated_robot_is_off_by_what_it_says() -> None:
    robot = simulated_robot(sd=0.5)
    off = []
    for i in range(400):
        reported = robot.move(np.array([float(i), 0.0, 0.0]))
        off.append(robot.true_position - reported)
    square = np.sum(np.square(off)) / 0.25  # chi-square with 1200 degrees: 1200 +- 4 * sqrt(2400)
    assert abs(square - 1200) < 4 * math.sqrt(2400)
    assert np.all(np.abs(np.mean(off, axis=0)) < 4 * 0.5 / 20)


def test_the_simulated_robot_fails_stops_and_takes_its_time() -> None:
    robot = simulated_robot(speed=100.0)
    robot.fail_next_move()
    with pytest.raises(HardwareError, match="stopped on its way"):
        robot.move(np.array([10.0, 0.0, 0.0]))
    assert robot.position().tolist() == [5, 0, 0]
    timer = threading.Timer(0.1, robot.stop)
    timer.start()
    with pytest.raises(HardwareError, match="stopped on its way"):
        robot.move(np.array([5.0, 1000.0, 0.0]))
    timer.join()
    assert 5 < robot.position()[1] < 500
    assert robot.move(robot.position()).shape == (3,)


def test_two_simulated_rigs_of_one_seed_take_the_same_pictures() -> None:
    pictures = [simulated_rig(ONE, seed=seed)[0][0].frame().picture for seed in (9, 9, 10)]
    assert np.array_equal(pictures[0], pictures[1])
    assert not np.array_equal(pictures[0], pictures[2])


# ---- triggers ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["udp", "tcp"])
def test_a_trigger_fires_once_a_call(kind: str) -> None:
    with TriggerSimulator(kind, lines=6) as box:
        trigger = trigger_from(box.address)
        trigger.open()
        trigger.open()
        for _ in range(3):
            trigger.fire()
        trigger.close()
        trigger.close()
        trigger.fire()  # opens by itself
        trigger.close()
        assert isinstance(trigger, NetworkTrigger)
        assert trigger.lines == 6
    first = box.fired[0]
    assert box.fired == [(first + i) % 2**31 for i in range(4)]


def test_lost_packets_do_not_fire_twice_nor_never() -> None:
    with TriggerSimulator("udp") as box:
        trigger = NetworkTrigger(box.address, timeout=0.5)
        trigger.open()
        box.drop_answers = 2
        trigger.fire()
        assert len(box.fired) == 1
        box.drop_questions = 2
        trigger.fire()
        assert len(box.fired) == 2
        box.delay = 0.15  # slower than a repeat: late answers of the one question are not taken for the next one's
        trigger.fire()
        trigger.fire()
        assert len(box.fired) == len(set(box.fired)) == 4
        box.drop_answers = 100
        with pytest.raises(HardwareError, match="does not answer") as caught:
            trigger.fire()
        says_all(caught.value)
        trigger.close()


@pytest.mark.parametrize("kind", ["udp", "tcp"])
def test_a_box_that_is_gone(kind: str) -> None:
    with TriggerSimulator(kind) as box:
        trigger = NetworkTrigger(box.address, timeout=0.3)
        trigger.fire()
    with pytest.raises(HardwareError, match="does not answer"):
        trigger.fire()
    with pytest.raises(HardwareError, match="does not answer"):
        trigger.open()
    trigger.close()


def test_what_a_box_answers() -> None:
    with TriggerSimulator("udp", lines=2) as box:
        assert box.answer("HELLO\n") == "IMPLICAM-TRIGGER 1 2\n"
        assert box.answer("TRIG 7").startswith("OK 7 ")
        assert box.answer("TRIG 7") == box.answer("TRIG 7")
        for bad in ("TRIG", "TRIG -1", "TRIG x", "TRIG 2147483648", "", "BANG 1", "TRIG ²"):
            assert box.answer(bad).startswith("ERR ")
        assert box.fired == [7]


# ---- words of the command line -------------------------------------------------------------------------------------


def test_words_name_drivers(tmp_path: Path) -> None:
    film = write_film(tmp_path / "film.avi", 1)
    kinds = {
        "0": OpenCVCamera, "/dev/video2": OpenCVCamera, "rtsp://10.0.0.1/main": OpenCVCamera,
        "http://10.0.0.1/a.mjpg": OpenCVCamera, str(film): OpenCVCamera, str(tmp_path): FolderCamera,
        "not-yet/": FolderCamera, "genicam:4711@/opt/maker.cti": GenICamCamera,
    }  # fmt: skip
    for spec, kind in kinds.items():
        camera = camera_from("cam7", spec)
        assert type(camera) is kind
        assert camera.name == "cam7"
    assert isinstance(robot_from("csv:a.csv").driver, CsvPlayer)
    assert isinstance(robot_from("ur:10.0.0.2", box=BOX, dry_run=True).driver, URRobot)
    person = robot_from("person", ask=lambda xyz: None)
    assert isinstance(person.driver, Person)
    assert isinstance(person, MovedByHand)
    assert not isinstance(robot_from("csv:a.csv"), MovedByHand)


@pytest.mark.parametrize(
    ("make", "spec", "words"),
    [
        (lambda s: camera_from("c", s), "genicm:1@a.cti", "did you mean 'genicam'"),
        (lambda s: camera_from("c", s), "genicam:1", "genicam:SERIAL@"),
        (lambda s: camera_from("c", s), "", "names no camera"),
        (lambda s: camera_from("c", s), "flim.avi", "there is no such file or folder"),
        (lambda s: camera_from("c", s), __file__, "by its ending it is no film; opencv:"),
        (lambda s: camera_from("c", s), "/dev/shm/left.npy", "names no camera"),
        (lambda s: camera_from("c", s), "GENICAM:1@a.cti", "did you mean 'genicam'"),
        (lambda s: camera_from("c", s), "opencv", r"is a driver's name[\s\S]*film.avi"),
        (lambda s: robot_from(s, tool=(0, 0, 1)), "csv:a.csv", "does not heed tool"),
        (lambda s: robot_from(s, ask=print, speed=0.1), "person", "does not heed speed"),
        (lambda s: robot_from(s, dry_run=True), "csv:a.csv", "has no dry run"),
        (robot_from, "ur10", "names no robot"),
        (robot_from, "persn", "did you mean 'person'"),
        (robot_from, "ur:10.0.0.2", r"needs a box[\s\S]*--workspace="),
        (trigger_from, "upd://box:1", "did you mean 'udp'"),
        (trigger_from, "udp://box", "no address of a trigger box"),
        (trigger_from, "udp://box:99999", "no address of a trigger box"),
    ],
)
def test_other_words_are_refused_with_a_hint(make: Callable[[str], object], spec: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        make(spec)
