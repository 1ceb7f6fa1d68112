"""Draw the pictures of the docs: `python docs/make_pictures.py` (needs Chromium).

Runs the demo in a temporary folder, opens its report in a real browser and photographs it; keeps one of the demo's
overlays, and two of simulated boards; compares all methods, which takes minutes.
Dots: `python benchmarks/dots.py ../shared/real --overlays docs/images`.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

IMAGES = Path(__file__).parent / "images"
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"]


def photograph(report: Path) -> None:
    """The first screen of the report."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1240, "height": 1360})
        page.goto(report.as_uri())
        page.wait_for_timeout(6000)  # software rendering of the 3D view takes its time
        page.screenshot(path=IMAGES / "report.png")
        browser.close()


def implicam(*words: str) -> None:
    """Run a command."""
    subprocess.run([sys.executable, "-m", "implicam", *words], check=True)


def main() -> None:
    IMAGES.mkdir(exist_ok=True)
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
        six = Path(folder) / "six"
        implicam("simulate", str(six), "--positions", "random", "--points", "200", "--check", "300")
        implicam("compare", str(six), "--train", "17,35,87,157", "--seeds", "3", "--check", str(six / "check"),
                 "-o", str(IMAGES / "compare.png"))  # fmt: skip


if __name__ == "__main__":
    main()
