"""Draw the pictures of the docs: `python docs/make_pictures.py` (needs Chromium); or one: `verify`, `view`, `acquire`.

Runs the demo in a temporary folder, opens its report in a real browser and photographs it; keeps one of the demo's
overlays, and two of simulated boards; compares all methods, which takes minutes.
Dots: `python benchmarks/dots.py ../shared/real --overlays docs/images`; the page of `implicam label` on one of these
targets: `python docs/make_pictures.py ../shared/real/water-tank-target`.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from implicam.calibrators import ForwardGP
from implicam.dataset import read_dataset
from implicam.detect.labelling import Labelling
from implicam.detect.model import View
from implicam.hardware import Person
from implicam.session.board_session import BoardController
from implicam.session.controller import SessionController
from implicam.session.setup import Setup, open_session
from implicam.viewer import bench_page
from implicam.viewer.calibration_page import LiveView
from implicam.viewer.label_page import open_page

IMAGES = Path(__file__).parent / "images"
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"]


def photograph(report: Path, name: str = "report.png", height: int = 1360) -> None:
    """The first screen of a page."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1240, "height": height})
        page.goto(report.as_uri())
        page.wait_for_timeout(6000)  # software rendering of the 3D view takes its time
        page.screenshot(path=IMAGES / name)
        browser.close()


def label(target: Path) -> None:
    """The page of `implicam label` after four clicks, those that it proposes."""
    data = read_dataset(target)
    view, at = View("cam1", ""), dict(zip(map(str, data.points), data.observations.uv[:, 0], strict=True))
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        page = Labelling.open(target, labels=Path(folder) / "labels.csv")
        for _ in range(4):
            name = page.propose(view)
            page.place(view, name, at[name], 4.0)
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        shown = browser.new_page(viewport={"width": 1440, "height": 900}, color_scheme="dark")
        with open_page(page, "implicam detect my-tank --target dots", port=0) as (url, _):
            shown.goto(url)
            shown.wait_for_function("image && guess && !guess.busy", timeout=60_000)
            shown.evaluate("all.name = 'my-tank'; all.file = 'my-tank/labels.csv'; paint()")
            shown.screenshot(path=IMAGES / "label.jpg", type="jpeg", quality=80)
        browser.close()


def view(folder: Path) -> None:
    """The page of `implicam view`, of six simulated cameras that took photographs."""
    rig = folder / "rig"
    implicam("simulate", str(rig), "--images", "--positions", "random", "--points", "60", "--check", "100")
    calibration = ForwardGP().fit(read_dataset(rig))
    with LiveView(calibration, pictures=rig / "images", browser=False) as live, sync_playwright() as playwright:
        live.add(calibration.measure(read_dataset(rig / "check")))
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.goto(live.url)
        page.wait_for_selector("body[data-ready]")
        page.wait_for_selector("body[data-pictures='6']")
        page.wait_for_timeout(2000)
        page.screenshot(path=IMAGES / "view.png")
        browser.close()


def acquire(folder: Path) -> None:
    """The page of `implicam acquire`: with eleven points by a robot; and without a robot, with five."""
    session = open_session(folder / "session", Setup(rig="bar6", speed=1e6))
    with session as controller, bench_page.open_page(controller) as (url, _), sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1440, "height": 900}, color_scheme="dark")
        page.goto(url)
        for _ in range(11):
            page.click("#go:enabled", timeout=60_000)
            page.click("#accept:enabled", timeout=60_000)
        page.wait_for_selector("#go:enabled", timeout=60_000)
        page.wait_for_timeout(4000)
        page.screenshot(path=IMAGES / "acquire.png")
        browser.close()
    by_hand(folder)
    board(folder)


def board(folder: Path) -> None:
    """The page with a board: five boards by a simulated hand, and the outline of the next."""
    setup = Setup(rig="stereo", target="charuco", budget=40)
    with open_session(folder / "board", setup) as controller:
        assert isinstance(controller, BoardController)
        controller.set_auto(False)
        controller.start()
        while controller.loop.points < 5:
            controller.live()
            controller.step()
        with bench_page.open_page(controller) as (url, _), sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
            page = browser.new_page(viewport={"width": 1440, "height": 900}, color_scheme="light")
            page.goto(url)
            page.wait_for_selector("svg polygon.aim", timeout=60_000)
            page.wait_for_timeout(4000)
            page.wait_for_function("window.implicam.state.title !== 'Looking'")
            page.screenshot(path=IMAGES / "acquire-board.png")
            browser.close()


def by_hand(folder: Path) -> None:
    """The page before there is a calibration: the drawing of how to reach x, y, z, and rough circles."""
    made = open_session(folder / "by-hand", Setup(rig="bar6", speed=1e6, workspace="-560:-380,-420:-240,-300:-130"))
    hand = made.equipment.robot  # holds the ball where the person says
    by_person = replace(made.equipment, robot=Person(lambda wish: None))
    with (
        SessionController(made.session, by_person, made.loop) as controller,
        bench_page.open_page(controller) as (url, _),
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1440, "height": 900}, color_scheme="light")
        page.goto(url)
        for k in range(6):
            page.wait_for_selector("#go:enabled", timeout=60_000)
            assert controller.state.target is not None
            hand.move(controller.state.target.xyz - [0, 9 if k == 5 else 0, 0])
            if k < 5:
                page.click("#there")
                page.click("#go:enabled", timeout=60_000)
                page.click("#accept:enabled", timeout=60_000)
        page.click("#reach summary")
        page.wait_for_timeout(4000)
        page.screenshot(path=IMAGES / "acquire-by-hand.png")
        browser.close()


def implicam(*words: str) -> None:
    """Run a command."""
    subprocess.run([sys.executable, "-m", "implicam", *words], check=True)


def verify(folder: Path) -> None:
    """The first screen of a protocol: a limit that is a little too tight."""
    rig, file = folder / "rig", folder / "rig.implicam"
    implicam("simulate", str(rig), "--positions", "random", "--points", "157", "--check", "300")
    implicam("calibrate", str(rig), "-o", str(file))
    protocol = folder / "verify.html"
    words = [sys.executable, "-m", "implicam", "verify", str(file), str(rig / "lengths"), "--mpe", "0.25 + L/5000",
             "--temperature", "21.5", "--expansion", "11.5e-6", "--by", "A. Meyer", "--instrument", "bar6, hall 3",
             "--certificate", "K-1234 (2026-03)", "-o", str(protocol)]  # fmt: skip
    subprocess.run(words, check=False)  # ends with 1
    photograph(protocol, "verify.png", 1240)


def main() -> None:
    IMAGES.mkdir(exist_ok=True)
    if sys.argv[1:] in (["verify"], ["view"], ["acquire"]):
        with tempfile.TemporaryDirectory() as folder:
            {"verify": verify, "view": view, "acquire": acquire}[sys.argv[1]](Path(folder))
        return
    if sys.argv[1:]:
        label(Path(sys.argv[1]))
        return
    with tempfile.TemporaryDirectory() as folder:
        demo, board = Path(folder) / "demo", Path(folder) / "board"
        implicam("demo", str(demo))
        photograph(demo / "report.html")
        shutil.copy(demo / "detections" / "overlays" / "cam2" / "random003.jpg", IMAGES / "detect-ball.jpg")
        implicam("simulate", str(board), "--images", "--target", "board", "--boards", "1", "--cameras", "cam5")
        implicam("detect", str(board))
        shutil.copy(board / "detections" / "overlays" / "cam5" / "board01.jpg", IMAGES / "detect-board.jpg")
        covered = Path(folder) / "covered"
        implicam("simulate", str(covered), "--images", "--target", "board", "--boards", "1", "--cameras", "cam5",
                 "--missing", "1", "--seed", "3")  # fmt: skip
        implicam("detect", str(covered), "--infer")
        overlay = Image.open(covered / "detections" / "overlays" / "cam5" / "board01.jpg")
        overlay.crop((430, 250, 800, 560)).resize((740, 620)).save(IMAGES / "detect-covered.jpg", quality=85)
        verify(Path(folder))
        view(Path(folder))
        acquire(Path(folder))
        six = Path(folder) / "six"
        implicam("simulate", str(six), "--positions", "random", "--points", "200", "--check", "300")
        implicam("compare", str(six), "--train", "17,35,87,157", "--seeds", "3", "--check", str(six / "check"),
                 "-o", str(IMAGES / "compare.png"))  # fmt: skip


if __name__ == "__main__":
    main()
