"""The page of the guided session: its pictures, its 3D numbers, its words, its worker; and a whole session, for real.

The last test starts the real command in a process of its own, on the simulated rig, and plays it in a real browser:
points by hand, a ball that a hand covers, skip, undo, kill -9, resume, finish, report.
"""

from __future__ import annotations

import itertools
import os
import re
import signal
import socket
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
from implicam.active import AtLeast, Below, Budget, Never, Step, Target, Workspace
from implicam.detect import Detected
from implicam.errors import HardwareError, UsageError
from implicam.geometry import rotation_from_vector
from implicam.hardware import Frame
from implicam.session.controller import State
from implicam.session.detections import Look
from implicam.simulate import Target as Shown
from implicam.simulate import build_rig, simulate
from implicam.viewer import words
from implicam.viewer.legend import across, curve, legend, line
from implicam.viewer.pictures import BAD, BALL, PAPER, TARGET, current, layout, montage, verdict
from implicam.viewer.space import Eye, Placing, Scale, edges, eyes, turned_up, upwards, vantage
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


def middle_of(page: Any, colour: tuple[int, int, int]) -> Any:
    """(u, v) the middle of the box around all pixels of a colour, NaN where there are none."""
    there = np.argwhere((page == colour).all(axis=2))[:, ::-1]
    return (there.min(axis=0) + there.max(axis=0)) / 2 if len(there) else NOWHERE


# -------------------------------------------------------------------------------------------------------- pictures


@pytest.mark.parametrize("n", [1, 2, 3, 6, 8, 13])
@pytest.mark.parametrize(("width", "height"), [(700, 600), (1200, 300), (200, 900)])
def test_tiles_are_as_large_as_they_fit(n: int, width: int, height: int) -> None:
    plan = layout([1.25] * n, width, height)
    assert plan.columns * plan.rows >= n > plan.columns * (plan.rows - 1)
    assert plan.columns * plan.width + 8 * (plan.columns - 1) <= width
    assert plan.rows * plan.height + 8 * (plan.rows - 1) <= height
    for columns in range(1, n + 1):  # every other arrangement is no larger
        rows = -(-n // columns)
        wide = min((width - 8 * (columns - 1)) / columns, 1.25 * (height - 8 * (rows - 1)) / rows)
        assert plan.width >= int(wide)


def test_the_reticle_is_where_the_ball_has_to_go() -> None:
    at = np.array([420.0, 210.0])
    page = montage(aiming(look("left", expected=at)), ["left"], [1.6], 1280, 800)
    assert page.shape == (800, 1280, 3)
    text_away = page.copy()
    text_away[: round(at[1] * 2) - 30] = 0  # the word beside the reticle has its colour too
    reticle = middle_of(text_away[:, : round(at[0] * 2) + 80], TARGET)
    assert reticle[0] == pytest.approx((at[0] + 0.5) * 2 - 0.5, abs=1.5)


def test_what_was_found_is_ringed() -> None:
    at = np.array([200.0, 250.0])
    page = montage(aiming(look("left", uv=at)), ["left"], [1.6], 1280, 800)
    assert middle_of(page, BALL) == pytest.approx((at + 0.5) * 2 - 0.5, abs=1.5)


def test_the_distance_is_in_pixels_of_the_camera() -> None:
    state = aiming(look("left", uv=(100, 100), expected=(130, 140)))
    assert verdict(state, state.looks[0])[0] == "50 px to go"
    near = aiming(look("left", uv=(100, 100), expected=(103, 104)))
    assert verdict(near, near.looks[0])[0] == "on target"
    shown = replace(state, phase="shown")
    assert verdict(shown, shown.looks[0])[0] == "found, 50 px from the circle"
    done = replace(state, phase="done", target=None)
    assert verdict(done, done.looks[0])[0] == "ball found"


def test_a_camera_that_does_not_see_the_target_says_so(stereo: Any) -> None:
    _, calibration = stereo
    state = aiming(look("left", uv=(100, 100)), calibration=calibration)
    assert verdict(state, state.looks[0])[0] == "target not in view"


def test_pictures_of_the_point_before_get_the_reticle_of_the_next() -> None:
    old = look("left", uv=(100, 100), expected=(100, 100))
    state = replace(aiming(old), target=Target("p004", np.zeros(3), np.array([[300.0, 50.0]])))
    assert current(state).looks[0].expected.tolist() == [300, 50]
    assert current(replace(state, phase="shown")).looks[0].expected.tolist() == [100, 100]


def test_trouble_is_a_grey_tile_with_words() -> None:
    gone = HardwareError("camera left is gone.", why="unplugged")
    state = aiming(look("left"), look("right"), phase="trouble", problem=gone)
    page = montage(state, ["left", "right"], [1.6, 1.6], 1288, 400)
    left, right = page[60:, :640], page[60:, 648:]
    assert (left == PAPER).all(axis=2).mean() > 0.9  # paper and letters
    assert (right == PAPER).all(axis=2).mean() < 0.1
    assert (page[:, :640] == BAD).all(axis=2).any()
    assert not (page[:, 648:] == BAD).all(axis=2).any()


@pytest.mark.parametrize("phase", ["starting", "aim", "moving", "shown", "fitting", "trouble", "done"])
def test_nothing_is_too_odd_to_be_drawn(phase: str) -> None:
    odd = (
        look("far", uv=(1e12, -1e12), expected=(-1e9, 5)),
        look("tiny", shape=(1, 1)),
        look("tall", uv=(3, 3), expected=(2, 2), shape=(300, 7)),
        replace(look("unread"), frame=None),
        look("<b>&名前", why="x" * 500),
    )
    names = [*(one.camera for one in odd), "no look at all"]
    state = aiming(*odd, phase=phase, problem=UsageError("nothing"))
    page = montage(state, names, [1.6] * 6, 300, 200)
    assert page.dtype == np.uint8
    assert page.shape[1] == 300
    assert montage(State(phase=phase), names, [1.6] * 6, 300, 200).shape == page.shape


# -------------------------------------------------------------------------------------------------------- space


@pytest.fixture(scope="module")
def stereo() -> Any:
    """A simulated rig, and a calibration of it."""
    rig = build_rig("stereo", seed=3)
    xyz = Workspace.from_box(rig.volume).candidates(40, 1)
    names = np.array([f"p{i:03d}" for i in range(40)])
    return rig, ForwardGP().fit(simulate(rig, Shown("ball", names, names, xyz), seed=4))


def test_a_frustum_is_where_the_camera_is(stereo: Any) -> None:
    rig, calibration = stereo
    assert eyes(None) == []
    for eye, camera in zip(eyes(calibration), rig.cameras, strict=True):
        pose = camera.camera_from_world
        assert eye.name == camera.name
        assert np.linalg.norm(eye.centre - pose.centre) < 10  # of 700 mm
        assert np.degrees(np.arccos(np.clip(eye.rotation[:, 2] @ pose.rotation[2], -1, 1))) < 3
        assert np.degrees(np.arccos(np.clip(-eye.rotation[:, 1] @ -pose.rotation[1], -1, 1))) < 3
        assert np.linalg.det(eye.rotation) == pytest.approx(1)
        assert eye.fov == pytest.approx(2 * np.arctan(camera.height / 2 / camera.lens.fy), rel=0.06)
        assert eye.aspect == camera.width / camera.height


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_the_scene_has_its_own_size_and_turn(scale: float) -> None:
    rng = np.random.default_rng(5)
    points = rng.normal(size=(20, 3)) * scale + 1e4 * scale
    up = rotation_from_vector(rng.normal(size=3))[2]
    placing = Placing.of(Workspace.hull(points), up)
    scene = placing.place(points)
    assert np.linalg.norm(np.ptp(scene, axis=0)) < 2 * np.sqrt(3)
    assert np.linalg.norm(scene[:, None] - scene, axis=2) == pytest.approx(
        np.linalg.norm(points[:, None] - points, axis=2) * 2 / Workspace.hull(points).size, abs=1e-6
    )
    assert placing.place(points[0] + scale * up)[2] > scene[0, 2]


@pytest.mark.parametrize("up", [*np.eye(3), *-np.eye(3), np.array([1, 2, -2]) / 3, np.array([1e-9, 0, -1.0])])
def test_up_is_up(up: Any) -> None:
    turn = turned_up(up)
    assert turn @ up == pytest.approx([0, 0, 1], abs=1e-8)
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-8)
    assert np.linalg.det(turn) == pytest.approx(1)


def facing(forward: Any, down: Any) -> Eye:
    right = np.cross(down, forward)
    return Eye("eye", -np.array(forward, float), np.column_stack([right, down, forward]).astype(float), 1.0, 1.5)


def test_which_way_is_up_in_a_world_nobody_chose() -> None:
    assert upwards([]).tolist() == [0, 0, 1]
    assert upwards([facing([1, 0, 0], [0, 0, -1])]).tolist() == [0, 0, 1]  # z up, and the pictures agree
    assert upwards([facing([0, 0, 1], [0, 1, 0])]).tolist() == [0, -1, 0]  # OpenCV's: y down, z away
    assert upwards([facing([0, 0, -1], [0, 1, 0])]).tolist() == [0, 0, 1]  # from above
    assert upwards([facing([0, 1, 0], [0, 0, 1])]).tolist() == [0, 0, -1]  # z down, as in the air and at sea


def test_edges_of_a_box_and_of_any_hull() -> None:
    box = edges(Workspace.box((0, 0, 0), (3, 4, 5)))
    assert sorted(np.linalg.norm(box[:, 1] - box[:, 0], axis=1)) == pytest.approx([3] * 4 + [4] * 4 + [5] * 4)
    for seed, rig in itertools.product(range(3), ("bar6", "dome8")):
        volume = build_rig(rig, seed=seed, frame="random", unit="m").volume
        assert len(edges(Workspace.from_box(volume))) == 12
    assert len(edges(Workspace.hull(np.concatenate([np.eye(3), -np.eye(3)])))) == 12
    hull = Workspace.hull(np.random.default_rng(2).normal(size=(200, 3)))
    assert len(edges(hull)) == 3 * len(hull.vertices) - 6  # Euler, of triangles


@pytest.mark.parametrize("aspect", [0.3, 0.6, 2.0])
@pytest.mark.parametrize("calibrated", [True, False])
def test_everything_is_in_view(stereo: Any, aspect: float, calibrated: bool) -> None:
    rig, calibration = stereo
    room = Workspace.from_box(rig.volume)
    seen = eyes(calibration) if calibrated else []
    placing = Placing.of(room, upwards(seen))
    position, at = vantage(seen, room.vertices, placing, aspect, 1.3)
    forward = (at - position) / np.linalg.norm(at - position)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    there = placing.place(np.array([*room.vertices, *(eye.centre for eye in seen)])) - position
    depth = there @ forward
    seen_at = np.abs(there @ np.column_stack([right, np.cross(right, forward)])) / depth[:, None]
    assert (depth > 0).all()
    assert (seen_at < np.tan(0.65) * np.array([aspect, 1.0])).all()
    assert (seen_at > 0.7 * np.tan(0.65) * np.array([aspect, 1.0])).any()  # and not from far away


def test_a_colour_means_a_length() -> None:
    scale = Scale.around(0.3)
    assert (scale.low, scale.high) == (0.2, 4.0)
    assert scale.ticks() == [0.2, 0.5, 1, 2]
    colours = scale.colours(np.array([0.01, 0.2, 0.9, 4.0, 99.0, np.nan])).astype(int)
    assert colours[0].tolist() == colours[1].tolist() == [253, 231, 37]
    assert colours[3].tolist() == colours[4].tolist() == [68, 1, 84]
    assert colours[5].tolist() == [120, 124, 132]
    grey = scale.colours(np.geomspace(0.2, 4, 50)) @ [0.299, 0.587, 0.114]
    assert (np.diff(grey) < 0).all()  # darker is worse, for those who see no colour
    for value in (1.0, 0.5, 2e-7, 9.99, 3e5):
        assert 0.4 * value <= Scale.around(value).low <= value
    assert "0.2" in legend(scale, "95 % uncertainty", "mm")


# -------------------------------------------------------------------------------------------------------- words


def test_only_buttons_that_make_sense(stereo: Any) -> None:
    _, calibration = stereo
    aim = aiming(look("left", uv=(5, 5)), data=calibration.data, calibration=calibration)

    def on(state: State, moves: bool = True) -> set[str]:
        return {word for word, may in words.allowed(state, moves).items() if may}

    assert on(aim) == {"go", "skip", "undo", "finish", "auto", "stop"}
    assert on(replace(aim, data=None, calibration=None)) == {"go", "skip", "auto", "stop"}
    assert on(replace(aim, phase="shown")) == {"accept", "redo", "skip", "undo", "finish", "auto", "stop"}
    assert "accept" not in on(replace(aim, phase="shown", looks=(look("left"),)))
    for busy in words.BUSY:
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


def test_words_of_others_are_text() -> None:
    evil = HardwareError("<script>alert(1)</script>", why="<img src=x onerror=alert(2)>", fix="'\"&")
    page = words.banner(aiming(look("left"), phase="trouble", problem=evil), np.full(3, np.nan), "<u>", True)
    assert "<script" not in page
    assert "<img" not in page
    assert "&lt;script&gt;" in page
    assert "Nothing is lost" in page
    assert "<u>" not in words.numbers([Step(9, 1.0, 0.5, 0.7)], "<u>", 2)


def test_the_way_has_signs_and_no_false_digits() -> None:
    text = re.sub(r"<[^>]+>", " ", words.way(np.zeros(3), np.array([-0.004, 166.3, -82.0]), "mm"))
    assert " ".join(text.split()) == "185 mm to go x −0 mm y +166 mm z −82 mm"
    assert "0.0021 m" in words.way(np.zeros(3), np.array([0.0021, 0, 0]), "m")
    state = aiming(look("left", uv=(0, 0), expected=(30, 40)), look("right", uv=(0, 0)))
    assert "50 px" in words.to_go(state, np.full(3, np.nan), "mm")
    assert words.to_go(replace(state, phase="done"), np.zeros(3), "mm") == ""


def test_a_robot_goes_and_a_person_is_asked() -> None:
    state = aiming(look("left"))
    assert words.headline(state, True).title == "Point 3: press Go"
    assert words.headline(state, False).title == "Point 3: put the ball here"
    assert "enough" in words.headline(replace(state, stop="0.2 mm everywhere"), True).title
    for phase in ("starting", "aim", "moving", "shown", "fitting", "trouble", "done"):
        for moves in (True, False):
            assert words.headline(State(phase=phase), moves).title


def test_the_curve_has_what_is_known() -> None:
    rule = (Below(0.3) & AtLeast(12)) | Budget(60)
    stop = line(rule)
    assert stop is not None
    assert stop.value == 0.3
    assert line(Never() | Budget(3)) is None
    steps = [Step(7), Step(8, 2.0, 1.0, 1.5), Step(9, 1.0, 0.4, 0.6)]
    x, worst, usual, below = curve(steps, rule)
    assert (x.tolist(), worst.tolist(), usual.tolist()) == ([8, 9], [2, 1], [1.5, 0.6])
    assert below.tolist() == [0.3, 0.3]
    assert len(curve([], rule)[0]) == 2
    for points in (0, 14, 15, 16, 1000):
        assert points < across(points)["x"]["range"][1] <= max(15, 2 * points)


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


# -------------------------------------------------------------------------------------------------------- viser


def test_viser_itself_takes_nobody_who_did_not_come_by_the_front_door() -> None:
    pytest.importorskip("viser")
    from implicam.viewer.page import _handshake, _inner_server

    server, origin = _inner_server()
    try:
        assert _handshake(server.get_port(), origin) == 101
        for other in ("http://localhost", f"http://localhost:{server.get_port()}", "http://evil.example", "null", ""):
            assert _handshake(server.get_port(), other) == 403
        assert server.request_share_url() is None
    finally:
        server.stop()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", server.get_port()), timeout=1).close()


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
            if found := re.search(r"http://localhost:\d+/", text):
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
        self.page.get_by_role("button", name=name, exact=name != "Stop now").click(timeout=120_000)

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
    visitor.page.keyboard.press("Space")
    visitor.reads("3 points")
    visitor.reads("Point 4: press Go")
    visitor.presses("Skip")
    visitor.presses("something is in the way")
    visitor.reads("3 points · 1 skipped")
    visitor.reads("Point 4: press Go")
    visitor.page.keyboard.press("u")
    visitor.reads("2 points · 1 skipped")


@pytest.mark.slow
@pytest.mark.browser
def test_a_whole_session_in_a_browser(tmp_path: Path, chromium: dict[str, Any]) -> None:
    pytest.importorskip("viser")
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
                page.get_by_label("automatic").click()
                visitor.reads("10 points · 1 skipped")
                command.end(signal.SIGKILL)
            kept = read_dataset(folder)
            with Command(hand, str(folder)) as command:
                page.goto(command.url)
                visitor.reads("points · 1 skipped")
                page.get_by_label("automatic").click()
                visitor.reads("all 12 points of the budget are measured")
                visitor.presses("Stop now")
                visitor.reads("Done: the rig is calibrated")
                report = page.request.get(f"{command.url}report.html").text()
                saved = page.request.get(f"{command.url}calibration.implicam").body()
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
