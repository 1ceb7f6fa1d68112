"""The page of the guided session: its marks, its 3D numbers, its words, its worker; and a whole session, for real.

The last test starts the real command in a process of its own, on the simulated rig, and plays it in a real browser:
points by hand, a ball that a hand covers, skip, undo, kill -9, resume, finish, report.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from implicam import ForwardGP, load_calibration, read_dataset
from implicam.active import AtLeast, Below, Budget, Never, Step, Target, Within, Workspace
from implicam.detect import Detected
from implicam.errors import HardwareError, UsageError
from implicam.geometry import rotation_from_vector
from implicam.hardware import Frame
from implicam.session.controller import State
from implicam.session.detections import Look
from implicam.simulate import Target as Shown
from implicam.simulate import build_rig, simulate
from implicam.viewer import words
from implicam.viewer.calibration_scene import list_cameras, up_of
from implicam.viewer.snapshot import curve, snapshot
from implicam.viewer.space import Placing, edges, levels, turned_up, upwards
from implicam.viewer.volume import volume
from implicam.viewer.worker import Worker

NOWHERE = np.full(2, np.nan)


def look(
    name: str, uv: Any = None, expected: Any = NOWHERE, shape: tuple[int, int] = (400, 640), why: str = ""
) -> Look:
    """A picture of noise, with a ball at uv."""
    picture = np.random.default_rng(1).uniform(0.3, 0.5, shape).astype(np.float32)
    found = Detected(reason=why)
    if uv is not None:
        turn = np.linspace(0, 2 * np.pi, 60)
        ring = np.array(uv) + 9 * np.column_stack([np.cos(turn), np.sin(turn)])
        found = Detected(("ball",), np.array([uv], float), np.ones((1, 2)), outlines=(ring,))
    return Look(name, Frame(picture, 1, 0.0), found, np.array(expected, float))


def aiming(*looks: Look, phase: str = "aim", **more: Any) -> State:
    target = Target("p003", np.array([1.0, 2.0, 3.0]), np.array([one.expected for one in looks]).reshape(-1, 2))
    return State(phase=phase, looks=looks, target=target, **more)


# ----------------------------------------------------------------------------------------------------------- marks


def test_the_distance_is_in_pixels_of_the_camera() -> None:
    state = aiming(look("left", uv=(100, 100), expected=(130, 140)))
    assert words.verdict(state, state.looks[0])[0] == "50 px to go"
    near = aiming(look("left", uv=(100, 100), expected=(103, 104)))
    assert words.verdict(near, near.looks[0])[0] == "on target"
    shown = replace(state, phase="shown")
    assert words.verdict(shown, shown.looks[0])[0] == "found, 50 px from the circle"
    done = replace(state, phase="done", target=None)
    assert words.verdict(done, done.looks[0])[0] == "ball found"


def test_a_camera_that_does_not_see_the_target_says_so(stereo: Any) -> None:
    _, calibration = stereo
    state = aiming(look("left", uv=(100, 100)), calibration=calibration)
    assert words.verdict(state, state.looks[0])[0] == "target not in view"


def test_rough_circles_are_said_to_be_rough() -> None:
    state = aiming(look("left", uv=(100, 100)))
    assert "No circles yet" in words.headline(state, False).detail
    u, v = 100.0, 100.0
    for circle, says in (([u + 30, v, 40], "in the rough circle"), ([u + 50, v, 40], "not in the rough circle")):
        rough = np.array([circle])
        assert words.verdict(state, state.looks[0], rough[0])[0] == says
        assert "rough" in words.headline(replace(state, rough=rough), False).detail
        nowhere = np.full(3, np.nan)
        shown = snapshot(replace(state, rough=rough), ["left"], nowhere, Budget(9), unit="mm", moves=False, skipped=0)
        assert (shown["cameras"][0]["rough"], shown["cameras"][0]["target"]) == (circle, None)


def test_the_volume_is_that_of_the_places_between_which_it_lies() -> None:
    box = Workspace.box([-100, 0, 50], [100, 160, 90])
    judged = box.judged(400)
    field = np.exp(0.01 * judged[:, 0] - 0.02 * judged[:, 1])
    found = volume(box, judged, {"u95": field})
    assert found is not None
    assert [(axis[0], axis[-1]) for axis in found["axes"]] == [(-100, 100), (0, 160), (50, 90)]
    x, y, _ = np.meshgrid(*found["axes"], indexing="ij")
    assert np.allclose(found["maps"]["u95"], np.exp(0.01 * x - 0.02 * y).ravel())  # linear in the logarithm
    blind = np.where(judged[:, 0] > 30, np.nan, field)
    some = volume(box, judged, {"u95": blind})
    assert some is not None
    missing = np.array([value is None for value in some["maps"]["u95"]]).reshape(x.shape)
    assert missing[x > 70].all()
    assert not missing[x < -10].any()
    assert volume(box, judged, {"u95": np.full(len(judged), np.nan)}) is None
    turned = Workspace.hull(box.vertices @ rotation_from_vector([0, 0, 0.3]).T)
    assert volume(turned, turned.judged(400), {"u95": field}) is None


def test_the_levels_of_a_block() -> None:
    block = Workspace.only([[x, y, z] for x in (0, 50, 100) for y in (0, 20) for z in (5, 9)])
    assert levels(block.places) == [[0, 50, 100], [0, 20], [5, 9]]
    assert block.places is not None
    assert levels(block.places[1:]) is None
    assert levels(None) is None


def test_pictures_of_the_point_before_get_the_reticle_of_the_next() -> None:
    old = look("left", uv=(100, 100), expected=(100, 100))
    state = replace(aiming(old), target=Target("p004", np.zeros(3), np.array([[300.0, 50.0]])))
    assert words.current(state).looks[0].expected.tolist() == [300, 50]
    assert words.current(replace(state, phase="shown")).looks[0].expected.tolist() == [100, 100]


def test_a_camera_in_trouble_says_so() -> None:
    problem = HardwareError("camera left does not answer.", why="unplugged", fix="plug it in")
    state = aiming(look("left", uv=(5, 5)), look("right", uv=(5, 5)), phase="trouble", problem=problem)
    left, right, third = snapped(state, ["left", "right", "third"])["cameras"]
    assert (left["shown"], left["says"], left["kind"], left["reason"]) == (False, "camera trouble", "bad", problem.what)
    assert right["shown"]
    assert (third["says"], third["reason"]) == ("no picture", "waiting for its first picture")


def snapped(state: State, cameras: list[str], measured: Any = None, rule: Any = None) -> dict[str, Any]:
    measured = np.full(3, np.nan) if measured is None else measured
    found = snapshot(state, cameras, measured, rule or Never(), unit="mm", moves=True, skipped=0)
    json.dumps(found, allow_nan=False)  # as it goes to the browser
    return found


@pytest.mark.parametrize("phase", ["starting", "aim", "moving", "shown", "fitting", "trouble", "done"])
def test_nothing_is_too_odd_to_be_told(phase: str, stereo: Any) -> None:
    _, calibration = stereo
    odd = look("left", uv=(np.nan, 3.0), expected=(1e12, -5.0))
    gone = replace(look("right"), frame=None)
    for looks in ((), (odd,), (odd, gone)):
        for more in ({}, {"calibration": calibration, "history": (Step(3), Step(9, 1.0, 0.5, 0.7, 1.3))}):
            found = snapped(aiming(*looks, phase=phase, **more), ["left", "right"])
            assert len(found["cameras"]) == 2
            assert found["title"]


def test_marks_are_in_pixels_of_the_picture() -> None:
    state = aiming(look("left", uv=(100.25, 200.5), expected=(300, 50)))
    (left,) = snapped(state, ["left"])["cameras"]
    assert (left["ball"], left["target"], left["width"], left["height"]) == ([100.25, 200.5], [300.0, 50.0], 640, 400)
    ring = np.array(left["outlines"][0])
    assert np.linalg.norm(ring - (100.25, 200.5), axis=1) == pytest.approx(9, abs=0.01)
    assert snapped(replace(state, phase="done", target=None), ["left"])["cameras"][0]["target"] is None


# -------------------------------------------------------------------------------------------------------- space


@pytest.fixture(scope="module")
def stereo() -> Any:
    """A simulated rig, and a calibration of it."""
    rig = build_rig("stereo", seed=3)
    xyz = Workspace.from_box(rig.volume).candidates(40, 1)
    names = np.array([f"p{i:03d}" for i in range(40)])
    return rig, ForwardGP().fit(simulate(rig, Shown("ball", names, names, xyz), seed=4))


def test_up_is_what_the_pictures_say(stereo: Any) -> None:
    rig, calibration = stereo
    up = up_of(list_cameras(calibration))
    pictures = -np.mean([camera.camera_from_world.rotation[1] for camera in rig.cameras], axis=0)
    assert up @ pictures > 0.4
    assert up_of(list_cameras(None)).tolist() == [0, 0, 1]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_the_scene_has_its_own_size_and_turn(scale: float) -> None:
    rng = np.random.default_rng(5)
    points = rng.normal(size=(20, 3)) * scale + 1e4 * scale
    up = rotation_from_vector(rng.normal(size=3))[2]
    placing = Placing.of(points.min(axis=0), points.max(axis=0), up)
    scene = placing.place(points)
    across = np.linalg.norm(np.ptp(points, axis=0))
    assert np.linalg.norm(scene[:, None] - scene, axis=2) == pytest.approx(
        np.linalg.norm(points[:, None] - points, axis=2) * 2 / across, abs=1e-6
    )
    assert placing.place(points[0] + scale * up)[2] > scene[0, 2]


@pytest.mark.parametrize("up", [*np.eye(3), *-np.eye(3), np.array([1, 2, -2]) / 3, np.array([1e-9, 0, -1.0])])
def test_up_is_up(up: Any) -> None:
    turn = turned_up(up)
    assert turn @ up == pytest.approx([0, 0, 1], abs=1e-8)
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-8)
    assert np.linalg.det(turn) == pytest.approx(1)


def test_which_way_is_up_in_a_world_nobody_chose() -> None:
    def facing(forward: Any, down: Any) -> list[float]:
        return upwards(-np.array([down], float), np.array([forward], float)).tolist()  # type: ignore[no-any-return]

    assert upwards(np.zeros((0, 3)), np.zeros((0, 3))).tolist() == [0, 0, 1]
    assert facing([1, 0, 0], [0, 0, -1]) == [0, 0, 1]  # z up, and the pictures agree
    assert facing([0, 0, 1], [0, 1, 0]) == [0, -1, 0]  # OpenCV's: y down, z away
    assert facing([0, 0, -1], [0, 1, 0]) == [0, 0, 1]  # from above
    assert facing([0, 1, 0], [0, 0, 1]) == [0, 0, -1]  # z down, as in the air and at sea


def test_edges_of_a_box_and_of_any_hull() -> None:
    box = edges(Workspace.box((0, 0, 0), (3, 4, 5)))
    assert sorted(np.linalg.norm(box[:, 1] - box[:, 0], axis=1)) == pytest.approx([3] * 4 + [4] * 4 + [5] * 4)
    for seed, rig in itertools.product(range(3), ("bar6", "dome8")):
        volume = build_rig(rig, seed=seed, frame="random", unit="m").volume
        assert len(edges(Workspace.from_box(volume))) == 12
    assert len(edges(Workspace.hull(np.concatenate([np.eye(3), -np.eye(3)])))) == 12
    hull = Workspace.hull(np.random.default_rng(2).normal(size=(200, 3)))
    assert len(edges(hull)) == 3 * len(hull.vertices) - 6  # Euler, of triangles


# -------------------------------------------------------------------------------------------------------- words


def test_only_buttons_that_make_sense(stereo: Any) -> None:
    _, calibration = stereo
    aim = aiming(look("left", uv=(5, 5)), data=calibration.data, calibration=calibration)

    def on(state: State, moves: bool = True) -> set[str]:
        return {word for word, may in words.allowed(state, moves).items() if may}

    assert on(aim) == {"go", "skip", "undo", "delete", "again", "finish", "auto", "stop"}
    assert on(replace(aim, data=None, calibration=None)) == {"go", "skip", "auto", "stop"}
    assert on(replace(aim, phase="shown")) == {
        "accept",
        "redo",
        "skip",
        "undo",
        "delete",
        "again",
        "finish",
        "auto",
        "stop",
    }
    assert "accept" not in on(replace(aim, phase="shown", looks=(look("left"),)))
    for busy in ("starting", "moving", "fitting"):
        assert on(replace(aim, phase=busy)) == {"auto", "stop"}
        assert on(replace(aim, phase=busy), moves=False) == set()
    assert on(replace(aim, phase="trouble")) == {"go", "stop"}
    assert on(replace(aim, phase="done", target=None)) == {"go", "finish", "stop"}
    assert on(replace(aim, auto=True)) == {"auto", "stop"}
    for phase in ("aim", "shown", "trouble", "done"):
        state = replace(aim, phase=phase)
        assert words.proposed(state) in on(state)
    assert words.proposed(replace(aim, stop="enough")) == "finish"
    assert words.labels(replace(aim, phase="trouble"), True, "mm")["go"] == "Try again"


def test_the_way_has_signs_and_no_false_digits() -> None:
    found = words.way(np.zeros(3), np.array([-0.004, 166.3, -82.0]), "mm")
    assert found == {"total": "185 mm", "axes": {"x": "−0 mm", "y": "+166 mm", "z": "−82 mm"}}
    assert words.way(np.zeros(3), np.array([0.0021, 0, 0]), "m")["total"] == "0.0021 m"
    state = aiming(look("left", uv=(0, 0), expected=(30, 40)), look("right", uv=(0, 0)))
    assert words.to_go(state, np.full(3, np.nan), "mm") == {"total": "50 px", "axes": {}}
    assert words.to_go(replace(state, phase="done"), np.zeros(3), "mm") is None


def test_how_far_every_rule_is_from_stopping() -> None:
    rule = (Below(1.2) & Within(1.3)) | Budget(60) | Never() | Below(0.5, "usual")
    state = State(history=(Step(9, 1.339, 0.5, 0.7, 1.456),))
    assert [text for text in snapped(state, [], rule=rule)["numbers"]["progress"] if text] == [
        "1.34 mm everywhere; stop at 1.20 mm",
        "1.46 times what pixel noise leaves; stop at 1.30",
        "9 of 60 points",
        "0.700 mm in 95 % of the workspace; stop at 0.500 mm",
    ]
    assert [text for text in snapped(State(), [], rule=rule)["numbers"]["progress"] if text] == ["0 of 60 points"]


def test_done_says_what_the_report_says() -> None:
    done = State(
        phase="done", verdict=("Off by 17 mm rms. The error bars are too small.", "bad"), suspects=(("p003", 60.0),)
    )
    said = words.headline(done, False)
    assert (said.kind, said.title) == ("bad", "Calibrated, but do not rely on it yet")
    assert "17 mm rms" in said.detail
    assert "p003 (60 mm off)" in said.detail
    assert words.headline(replace(done, verdict=("Fine.", "good"), suspects=()), False).kind == "good"
    assert words.headline(State(phase="done"), False).kind == "ask"


def test_a_point_that_is_elsewhere_and_a_stop_stand_in_the_headline() -> None:
    state = aiming(look("left"), suspects=tuple((f"p{i:03d}", 60.0 - i) for i in range(5)))
    assert "p002 (58 mm off) and 2 more" in words.headline(state, False).detail
    assert "p001" not in words.headline(replace(state, phase="fitting"), False).detail
    assert "nothing moves until Go" in words.headline(replace(state, stopped=True), True).detail
    assert words.headline(replace(state, stopped=True, phase="moving"), True).title == "Stopped"
    assert "yet: 7 views agree." in words.headline(replace(state, uncalibrated="7 views agree."), False).detail


def test_a_robot_goes_and_a_person_is_asked() -> None:
    state = aiming(look("left"))
    assert words.headline(state, True).title == "Point 3: press Go"
    assert words.headline(state, False).title == "Point 3: put the ball here"
    planned = Target("p003", np.zeros(3), np.array([[300.0, 50.0]]))
    assert words.headline(replace(state, target=planned), True).detail == "The robot takes the ball to the circle."
    unplanned = replace(state, target=replace(planned, uv=np.full((1, 2), np.nan)))
    assert "no circles yet" in words.headline(unplanned, True).detail
    rough = replace(unplanned, rough=np.array([[300.0, 50, 20]]))
    assert "dashed circles" in words.headline(rough, True).detail
    assert "enough" in words.headline(replace(state, stop="0.2 mm everywhere"), True).title
    for phase in ("starting", "aim", "moving", "shown", "fitting", "trouble", "done"):
        for moves in (True, False):
            assert words.headline(State(phase=phase), moves).title


def test_the_curve_has_what_is_known() -> None:
    steps = [Step(7), Step(8, 2.0, 1.0, 1.5), Step(9, 1.0, 0.4, 0.6)]
    found = curve(steps, (Below(0.3) & AtLeast(12)) | Budget(60))
    assert (found["points"], found["worst"], found["usual"]) == ([8, 9], [2, 1], [1.5, 0.6])
    assert (found["stops"], found["budgets"]) == ([{"value": 0.3, "of": "worst"}], [12, 60])
    assert curve([], Never()) == {"points": [], "worst": [], "usual": [], "stops": [], "budgets": []}


# -------------------------------------------------------------------------------------------------------- worker


class Slow:
    """In place of a guide: does nothing, slowly, and remembers it."""

    def __init__(self) -> None:
        self.state, self.gate = State(phase="aim"), threading.Event()
        self.done: list[str] = []

    def start(self) -> None:
        self.done.append("start")

    def slow(self) -> None:
        self.done.append("slow")
        self.gate.wait(60)

    def fail(self) -> None:
        raise UsageError("not now")

    def step(self) -> None:
        self.done.append("step")
        self.state = replace(self.state, stop="enough" if self.done.count("step") == 3 else "")

    def set_auto(self, auto: bool) -> None:
        self.state = replace(self.state, auto=auto)


@pytest.fixture
def work() -> Iterator[tuple[Slow, Worker, list[Any]]]:
    controller = Slow()
    complaints: list[Any] = []
    worker = Worker(controller, complaints.append)  # type: ignore[arg-type]
    worker.start()
    until(lambda: controller.done == ["start"])
    yield controller, worker, complaints
    controller.gate.set()
    worker.close()
    assert not worker._thread.is_alive()


def until(true: Any, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)


def asked(worker: Worker, action: Any) -> None:
    """Asked for until nothing else is being done."""
    until(lambda: worker.ask(action))


def test_a_button_pressed_twice_counts_once(work: Any) -> None:
    controller, worker, _ = work
    asked(worker, controller.slow)
    assert not worker.ask(controller.slow)
    assert not worker.ask(controller.fail)
    controller.gate.set()
    asked(worker, controller.slow)
    until(lambda: controller.done == ["start", "slow", "slow"])


def test_what_cannot_be_done_is_said_and_work_goes_on(work: Any) -> None:
    controller, worker, complaints = work
    asked(worker, controller.fail)
    until(lambda: [str(error) for error in complaints] == ["not now"])
    controller.gate.set()
    asked(worker, controller.slow)
    until(lambda: "slow" in controller.done)


def test_by_itself_until_a_rule_says_stop(work: Any) -> None:
    controller, _, _ = work
    controller.state = aiming(look("left"), auto=True)
    until(lambda: not controller.state.auto)
    assert controller.done == ["start", "step", "step", "step"]
    assert controller.state.stop == "enough"


# -------------------------------------------------------------------------------------------------------- for real

HAND = """
import sys
from pathlib import Path
from implicam.hardware.simulated import PhotographingCamera as Camera
hand, plain = Path(sys.argv[1]), Camera.frame
def frame(self, timeout=5.0):  # a hand before the ball, while there is a file
    if hand.exists():
        self.cover()
    return plain(self, timeout)
Camera.frame = frame
sys.argv[1:] = sys.argv[2:]
from implicam.cli import main
main()
"""


class Command:
    """`implicam acquire` in a process of its own; a context manager, so that none is left behind."""

    def __init__(self, hand: Path, *options: str) -> None:
        code = [sys.executable, "-c", HAND, str(hand), "acquire", *options, "--no-browser", "--port", "0"]
        self.process = subprocess.Popen(
            code, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "COLUMNS": "200"}
        )
        assert self.process.stderr is not None
        self.log: list[str] = []
        for text in self.process.stderr:
            self.log.append(text)
            if found := re.search(r"http://localhost:\d+/\S*", text):
                self.url = found[0]
                return
        raise AssertionError("".join(self.log))

    def __enter__(self) -> Command:
        return self

    def __exit__(self, *error: object) -> None:
        if self.process.poll() is None:
            self.end(signal.SIGKILL)

    def end(self, how: signal.Signals | None = None) -> int:
        if how is not None:
            self.process.send_signal(how)
        self.process.communicate(timeout=180)
        return self.process.returncode


class Visitor:
    """Who sits before the page: reads, and presses buttons."""

    def __init__(self, page: Any) -> None:
        self.page = page

    def reads(self, text: str) -> None:
        self.page.get_by_text(text).first.wait_for(timeout=120_000)

    def presses(self, name: str) -> None:
        self.page.get_by_role("button", name=re.compile(rf"^{name}")).click(timeout=120_000)

    def measures(self, number: int) -> None:
        self.reads(f"Point {number}: press Go")
        self.presses("Go")
        self.reads("Found in 2 of 2 cameras")
        self.presses("Accept")


def by_hand(visitor: Visitor, hand: Path) -> None:
    """Points by buttons and by keys; a covered ball; skip; undo."""
    visitor.measures(1)
    visitor.measures(2)
    visitor.reads("Point 3: press Go")
    hand.touch()
    visitor.presses("Go")
    visitor.reads("The ball was not found")
    hand.unlink()
    visitor.presses("Redo")
    visitor.reads("Found in 2 of 2 cameras")
    visitor.page.keyboard.press("a")
    visitor.reads("3 points")
    visitor.reads("Point 4: press Go")
    visitor.presses("Skip")
    visitor.presses("Something is in the way")
    visitor.reads("3 points · 1 skipped")
    visitor.reads("Point 4: press Go")
    visitor.page.keyboard.press("u")
    visitor.reads("2 points · 1 skipped")


@pytest.mark.slow
@pytest.mark.browser
def test_a_whole_session_in_a_browser(tmp_path: Path, chromium: dict[str, Any]) -> None:
    pytest.importorskip("starlette")
    sync_api = pytest.importorskip("playwright.sync_api")
    folder, hand = tmp_path / "session", tmp_path / "hand"
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(**chromium)
        page = browser.new_page(viewport={"width": 1100, "height": 700})
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        visitor = Visitor(page)
        try:
            with Command(hand, str(folder), "--rig", "stereo", "--budget", "12") as command:
                page.goto(command.url)
                by_hand(visitor, hand)
                page.get_by_label("go on by itself").click()
                visitor.reads("10 points · 1 skipped")
                command.end(signal.SIGKILL)
            kept = read_dataset(folder)
            with Command(hand, str(folder)) as command:
                page.goto(command.url)
                visitor.reads("points · 1 skipped")
                page.get_by_label("go on by itself").click()
                visitor.reads("all 12 points of the budget are measured")
                visitor.presses("Finish")
                visitor.reads("Done: the rig is calibrated")
                here = command.url.partition("?")[0]
                report = page.request.get(f"{here}report.html").text()
                saved = page.request.get(f"{here}calibration.implicam").body()
                visitor.presses("Close the session")
                assert command.end() == 0
        except BaseException:
            page.screenshot(path=tmp_path / "failed.png")
            raise
        finally:
            browser.close()
    assert not errors
    assert len(kept) >= 10
    assert "a guided calibration" in report
    calibration = load_calibration(folder / "calibration.implicam")
    assert saved == (folder / "calibration.implicam").read_bytes()
    assert len(calibration.data) == 12
    assert np.array_equal(read_dataset(folder).xyz[: len(kept)], kept.xyz)
