"""The page of a session behind its door: what buttons do, when a robot may move, who is told what, and how fast."""

from __future__ import annotations

import json
import time
import urllib.error
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from implicam.dataset import read_dataset
from implicam.errors import UsageError
from implicam.hardware import Person, SimulatedRobot
from implicam.session.controller import SessionController
from implicam.session.setup import Setup, open_session
from test_view import Client

pytest.importorskip("starlette")
from implicam.viewer.bench_page import BenchPage, open_page

SETUP = Setup(rig="stereo", budget=12, speed=1e6)


class Arm(SimulatedRobot):
    """A stand-in that does not say that it is one: the page has to treat it as a real arm."""

    simulated = False

    def __init__(self) -> None:
        super().__init__(np.zeros(3), sd=0.0, speed=1e9, rng=np.random.default_rng(1))
        self.went: list[Any] = []
        self.stopped = 0

    def move(self, xyz: Any) -> Any:
        self.went.append(xyz)
        return super().move(xyz)

    def stop(self) -> None:
        self.stopped += 1
        super().stop()


def until(happened: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.fixture
def controller(tmp_path: Path) -> Iterator[SessionController]:
    with open_session(tmp_path / "session", SETUP) as made:
        yield made


@pytest.fixture
def arm(controller: SessionController) -> Arm:
    made = Arm()
    made._reported = controller.equipment.robot.position()
    robot: Any = controller.equipment.robot
    robot._options = replace(robot._options, speed=0.1)
    controller.equipment.robot.driver = made  # type: ignore[attr-defined]
    return made


@pytest.fixture
def page(controller: SessionController) -> Iterator[BenchPage]:
    made = BenchPage(controller)
    made.start()
    until(lambda: controller.state.phase == "aim")
    yield made
    made.close()


# ------------------------------------------------------------------------------------------------ a robot that is real


@pytest.mark.slow
def test_a_real_robot_moves_once_for_each_yes(arm: Arm, controller: SessionController, page: BenchPage) -> None:
    target = controller.state.target
    assert target is not None
    asked = page.do({"word": "go"})["ask"]
    assert not arm.went
    assert "Is the way free?" in asked["text"]
    assert f"{target.xyz[0]:.6g}"[:5] in asked["text"]
    assert page.do({"word": "go", "yes": "a guess"})["ask"]["number"] != asked["number"]
    page.do({"word": "go", "yes": asked["number"]})
    until(lambda: controller.state.phase == "shown")
    assert len(arm.went) == 1
    page.do({"word": "accept"})
    until(lambda: controller.state.phase == "aim")
    page.do({"word": "go", "yes": asked["number"]})  # the yes of before
    assert "ask" in page.do({"word": "go"})
    assert len(arm.went) == 1


def test_a_move_that_nobody_let_it_do_is_refused_by_the_guard(
    arm: Arm, controller: SessionController, page: BenchPage
) -> None:
    controller.go()
    assert controller.state.phase == "trouble"
    assert "was not confirmed" in str(controller.state.problem)
    assert not arm.went


def test_a_yes_does_not_outlive_a_stop_a_minute_or_the_target(
    arm: Arm, controller: SessionController, page: BenchPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    from implicam.viewer import bench_page

    asked = page.do({"word": "go"})["ask"]["number"]
    page.stop({})
    assert arm.stopped
    assert "ask" in page.do({"word": "go", "yes": asked})
    asked = page.do({"word": "go"})["ask"]["number"]
    before = controller.state.target
    page.do({"word": "skip"})
    until(lambda: controller.state.phase == "aim" and controller.state.target is not before)
    assert "ask" in page.do({"word": "go", "yes": asked})  # it was for another target
    monkeypatch.setattr(bench_page, "YES_SECONDS", 0.0)
    asked = page.do({"word": "go"})["ask"]["number"]
    assert "ask" in page.do({"word": "go", "yes": asked})
    assert not arm.went


@pytest.mark.slow
def test_going_on_by_itself_needs_its_own_yes_and_ends_where_nobody_watches(
    arm: Arm, controller: SessionController, page: BenchPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    from implicam.viewer import bench_page

    monkeypatch.setattr(bench_page, "UNWATCHED_SECONDS", 0.5)
    go = page.do({"word": "go"})["ask"]["number"]
    assert "ask" in page.do({"word": "auto", "on": True, "yes": go})  # a yes to one move is none to all
    asked = page.do({"word": "auto", "on": True})["ask"]
    assert "anywhere it can reach" in asked["text"] or "in the box" in asked["text"]
    assert "at 0.1 m/s" in asked["text"]
    page.do({"word": "auto", "on": True, "yes": asked["number"]})
    assert controller.state.auto
    until(lambda: not controller.state.auto)
    went = len(arm.went)
    time.sleep(0.5)
    assert len(arm.went) <= went + 1  # the one that was begun
    assert "ask" in page.do({"word": "auto", "on": True})


def test_a_simulated_robot_is_not_asked_about(controller: SessionController, page: BenchPage) -> None:
    assert page.do({"word": "go"}) == {"begun": True}
    until(lambda: controller.state.phase == "shown")


def test_cameras_that_do_not_run_freely_say_when_a_picture_comes(controller: SessionController) -> None:
    for source in controller.equipment.cameras:
        source.live = False  # type: ignore[misc]  # as a folder's
    page = BenchPage(SessionController(controller.session, controller.equipment, controller.loop))
    page.start()
    until(lambda: page._sent.get("phase") == "aim")
    assert {one["reason"] for one in page._sent["cameras"]} == {"a picture comes with “Go”"}
    page.close()


def test_stop_takes_no_time(controller: SessionController, page: BenchPage) -> None:
    before = time.monotonic()
    page.stop({})
    assert time.monotonic() - before < 0.2


# ----------------------------------------------------------------------------------------------------- what is sent


def states(client: Client) -> Iterator[dict[str, Any]]:
    with client.opener.open(client.base + "api/state", timeout=60) as stream:
        while line := stream.readline().decode():
            if line.startswith("data: "):
                yield json.loads(line[6:])


def test_all_pages_are_told_and_pictures_come_as_they_are_shown(controller: SessionController) -> None:
    with open_page(controller) as (url, _):
        with pytest.raises(urllib.error.HTTPError, match="401"):
            Client(url.partition("?")[0])
        one, two = Client(url), Client(url)
        about = json.loads(one.get("api/about"))
        assert [camera["name"] for camera in about["cameras"]] == ["cam1", "cam2"]
        first, second = states(one), states(two)
        assert next(s for s in first if s["phase"] == "aim")["buttons"]["go"] == {
            "enabled": True,
            "next": True,
            "label": "Go",
        }
        assert next(s for s in second if s["phase"] == "aim")
        post(one, "api/do", {"word": "go"})
        shown = next(s for s in second if s["phase"] == "shown")
        assert [camera["says"] for camera in shown["cameras"]] == ["ball found"] * 2
        assert next(s for s in first if s["phase"] == "shown")["version"] == shown["version"]
        for width in ("480", "99999", "-1", "x"):
            assert one.get(f"picture.jpg?camera=cam1&width={width}")[:3] == b"\xff\xd8\xff"
        with pytest.raises(urllib.error.HTTPError, match="400"):
            one.get("picture.jpg?camera=..%2F..")
        scene = json.loads(one.get("api/scene"))
        assert len(scene["edges"]) == 12
        post(two, "api/do", {"word": "close"})


def post(client: Client, path: str, body: Any) -> Any:
    import urllib.request

    request = urllib.request.Request(client.base + path, json.dumps(body).encode())
    return json.loads(client.opener.open(request, timeout=60).read())


@pytest.mark.parametrize(
    "given",
    [{}, {"word": 3}, {"word": "stop it"}, {"word": "accept"}, {"word": ["go"]}, {"word": "undo"}, {"word": "do"}],
)
def test_nonsense_is_refused(page: BenchPage, given: Any) -> None:
    with pytest.raises(UsageError):
        page.do(given)


# ------------------------------------------------------------------------------------------------------ in a browser


@pytest.fixture
def by_hand(tmp_path: Path) -> Iterator[SessionController]:
    """A person moves the ball, as they say; the cameras see it where it always is."""
    with open_session(tmp_path / "session", SETUP) as made:
        person = Person(lambda wish: None)
        yield SessionController(made.session, replace(made.equipment, robot=person), made.loop)


@pytest.mark.slow
@pytest.mark.browser
def test_positions_are_kept_as_they_are_typed_and_what_is_odd_is_asked(
    by_hand: SessionController, chromium: dict[str, Any]
) -> None:
    sync_api = pytest.importorskip("playwright.sync_api")
    typed = [("-0.38296", "-382.5667340745084", "0,25"), ("1e-3", "−12,5 cm", "0.1m")]
    with open_page(by_hand) as (url, _), sync_api.sync_playwright() as play:
        browser = play.chromium.launch(**chromium)
        page = browser.new_page()
        page.set_default_timeout(60_000)
        page.goto(url)
        for k, texts in enumerate(typed):
            page.wait_for_selector("#go:enabled")
            assert by_hand.state.target is not None
            where = [f"{value:g}".replace("-", "−") for value in by_hand.state.target.xyz]
            for tool in ("ruler", "block", "slide-x", "slide-z"):
                page.select_option("#tool", tool)
                page.wait_for_function(
                    "(where) => where.every((one) => document.getElementById('drawing').textContent.includes(one))",
                    arg=where,
                )
            for axis, text in zip("xyz", texts, strict=True):
                assert page.input_value(f"#{axis}") == ""  # what nobody typed is not known
                page.fill(f"#{axis}", text)
            page.keyboard.press("Enter")
            page.wait_for_selector("#ask[open]")  # outside of the workspace: asked about
            assert page.evaluate("document.activeElement.textContent") == "Correct the numbers"
            page.get_by_role("button", name="It is there", exact=True).click()
            page.wait_for_selector("#accept:enabled")
            page.click("#accept")
            until(lambda k=k: by_hand.session.data is not None and len(by_hand.session.data) == k + 1)
            kept = read_dataset(by_hand.session.folder).xyz
        assert kept.tolist() == [[-0.38296, -382.5667340745084, 0.25], [1e-3, -125.0, 100.0]]  # to the last bit
        page.wait_for_selector("#go:enabled")
        page.fill("#x", "1,234")
        page.fill("#y", "1")
        page.fill("#z", "1")
        page.click("#go")
        page.get_by_text("may mean 1.234 or 1234").wait_for()
        page.fill("#x", "1.234")
        page.click("#go")
        page.get_by_text("may mean 1.234 or 1234").wait_for(state="detached")  # mended by a good one
        page.get_by_role("button", name="Correct the numbers", exact=True).click()
        # the list: one is looked at, one is deleted
        page.click("#list summary")
        row = page.locator("#points tbody", has_text="p001")
        row.get_by_role("button", name="look").click()
        page.wait_for_function(
            "[...document.querySelectorAll('#ask-pictures img')].filter((i) => i.naturalWidth).length == 2"
        )
        page.get_by_role("button", name="Close", exact=True).click()
        row.get_by_role("button", name="delete").click()
        page.get_by_role("button", name="Delete", exact=True).click()
        until(lambda: by_hand.session.data is not None and by_hand.session.data.points.tolist() == ["p002"])
        page.locator("#points tbody", has_text="p001").wait_for(state="detached")
        page.locator("#points tbody", has_text="p002").get_by_role("button", name="again").click()
        page.get_by_role("button", name="Measure it again").click()
        until(lambda: by_hand.session.data is None or not len(by_hand.session.data))
        there = [1e-3, -125.0, 100.0]
        until(lambda: by_hand.state.target is not None and by_hand.state.target.xyz.tolist() == there)
        browser.close()


@pytest.mark.slow
@pytest.mark.browser
def test_a_phone_and_two_desktops_each_have_their_layout_and_show_the_same(
    controller: SessionController, chromium: dict[str, Any]
) -> None:
    sync_api = pytest.importorskip("playwright.sync_api")
    with open_page(controller) as (url, _), sync_api.sync_playwright() as play:
        browser = play.chromium.launch(**chromium)
        wrong: list[str] = []
        pages = []
        for wide, high, scheme in ((1440, 900, "light"), (820, 1180, "dark"), (390, 844, "dark")):
            page = browser.new_context(viewport={"width": wide, "height": high}, color_scheme=scheme).new_page()
            page.set_default_timeout(60_000)
            page.on("pageerror", lambda error: wrong.append(str(error)))
            page.goto(url)
            page.wait_for_selector("body[data-phase=aim]")
            pages.append(page)
        desktop, tablet, phone = pages
        for page in pages:
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
            for name in ("#which", "#controls", "#progress", ".tile.chosen .top"):  # nothing is cut off at the right
                assert page.evaluate("(n) => (e => e.scrollWidth <= e.clientWidth)(document.querySelector(n))", name)
        assert [page.locator(".tile:visible").count() for page in pages] == [2, 2, 1]
        paper = [page.evaluate("getComputedStyle(document.body).backgroundColor") for page in pages]
        assert paper[0] != paper[1] == paper[2]
        phone.click("#go")  # the only button in green
        for page in pages:
            page.wait_for_selector("#accept:enabled")
            page.get_by_text("Found in 2 of 2 cameras").wait_for()
        seen = phone.locator("#stop").bounding_box()
        assert seen is not None
        assert seen["y"] + seen["height"] <= 844  # STOP is on the first screen
        phone.locator("#which button").nth(1).click()
        assert phone.locator(".tile:visible b").inner_text() == "cam2"
        desktop.keyboard.press("a")
        for page in pages:
            page.get_by_text("1 point").first.wait_for()
        tablet.keyboard.press("Escape")
        until(lambda: "robot stopped by hand" in [event.what for event in controller.session.events])
        assert not wrong
        browser.close()
