"""Naming dots by hand: the labels and what they let the search guess, the page behind its door, and a whole visit."""

from __future__ import annotations

import asyncio
import csv
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from http.cookiejar import CookieJar
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from implicam.dataset import KnownPositions
from implicam.detect import Dots, detect_folder
from implicam.detect.blobs import find_spot_near
from implicam.detect.labelling import TURNS, UPRIGHT, Guess, Labelling
from implicam.detect.labels import labels_csv, read_labels
from implicam.detect.model import Detected, View
from implicam.detect.overlay import Result, draw_overlay
from implicam.drawing import ORANGE, SKY, VERMILLION
from implicam.errors import DatasetError, ImageError, ImplicamError, UsageError
from implicam.files import write_text
from implicam.formatting import short_names
from implicam.images import brighten, read_picture, write_picture
from test_detect_dots import CORNERS, photograph, scene

VIEW = View("cam1", "")


@pytest.fixture(scope="module")
def scenes() -> Any:
    """Names, positions, pixels and picture of two cameras that see 121 dots at three depths, a mirrored one too."""
    names, xyz, uv, picture, _ = scene(hidden=[16, 71])
    flipped = uv * (-1, 1) + (picture.shape[1] - 1, 0)
    return names, xyz, {"cam1": uv, "cam2": flipped}, {"cam1": picture, "cam2": np.ascontiguousarray(picture[:, ::-1])}


@pytest.fixture
def folder(tmp_path: Path, scenes: Any) -> Path:
    names, xyz, _, pictures = scenes
    rows = ["point,shot,x,y,z", *(f"{name},target,{x},{y},{z}" for name, (x, y, z) in zip(names, xyz, strict=True))]
    write_text(tmp_path / "tank" / "points.csv", "\n".join([*rows, ""]))
    for camera, picture in pictures.items():
        write_picture(tmp_path / "tank" / "images" / camera / "target.png", picture)
    return tmp_path / "tank"


def label(own: Labelling, scenes: Any, rows: list[int], view: View = VIEW, off: float = 2.0) -> None:
    """Click on dots, some pixels beside them."""
    for k, row in enumerate(rows):
        own.place(view, scenes[0][row], scenes[2][view.camera][row] + off * np.array([np.cos(k), np.sin(k)]), 8.0)


# ------------------------------------------------------------------------------------------------ the labels


def test_a_click_goes_to_the_middle_of_the_dot_and_is_saved_at_once(folder: Path, scenes: Any) -> None:
    names, _, uv, _ = scenes
    own = Labelling.open(folder)
    assert list(own.pictures) == [VIEW, View("cam2", "")]
    label(own, scenes, CORNERS[:1], off=5.0)
    assert np.linalg.norm(np.array(own.marks(VIEW)[names[0]]) - uv["cam1"][0]) < 0.2
    label(own, scenes, CORNERS[1:3])
    assert list(read_labels(folder / "labels.csv", names)[VIEW]) == [names[row] for row in CORNERS[:3]]
    again = Labelling.open(folder)
    assert again.marks(VIEW) == own.marks(VIEW)
    assert not again.can_undo
    assert not own.place(VIEW, names[16], uv["cam1"][16], 5.0)  # hidden: it stays where it was clicked
    assert own.marks(VIEW)[names[16]] == pytest.approx(uv["cam1"][16], abs=0.01)


def test_undo_and_delete(folder: Path, scenes: Any) -> None:
    names = scenes[0]
    own = Labelling.open(folder)
    label(own, scenes, CORNERS[:2])
    label(own, scenes, CORNERS[:1], View("cam2", ""))
    first = own.marks(VIEW)
    own.remove(VIEW, names[0])
    assert list(own.marks(VIEW)) == [names[9]]
    assert own.undo() == VIEW
    assert own.marks(VIEW) == first
    assert own.undo() == View("cam2", "")
    assert [own.undo(), own.undo(), own.undo()] == [VIEW, VIEW, None]
    assert (folder / "labels.csv").read_text() == "point,camera,u,v\n"
    with pytest.raises(DatasetError, match="a header and no rows"):
        Dots.from_files(folder / "points.csv", folder / "labels.csv")


def test_a_dot_has_one_name_and_a_name_one_dot(folder: Path, scenes: Any) -> None:
    names, _, uv, _ = scenes
    own = Labelling.open(folder)
    label(own, scenes, [0])
    with pytest.raises(UsageError, match=f"this dot is {names[0]} already"):
        own.place(VIEW, names[1], uv["cam1"][0], 8.0)
    own.place(VIEW, names[0], uv["cam1"][1], 8.0)  # moved
    assert np.linalg.norm(np.array(own.marks(VIEW)[names[0]]) - uv["cam1"][1]) < 0.2
    assert len(own.marks(VIEW)) == 1
    for point, at in (("nobody", (5, 5)), (names[3], (-5, 5)), (names[3], (5, 1e8)), (names[3], (np.nan, 5))):
        with pytest.raises(UsageError):
            own.place(VIEW, point, np.array(at, float), 8.0)
    with pytest.raises(UsageError):
        own.place(View("cam9", ""), names[3], uv["cam1"][3], 8.0)
    with pytest.raises(UsageError):
        own.remove(VIEW, names[3])


def test_another_program_may_write_the_file_too(folder: Path, scenes: Any) -> None:
    names = scenes[0]
    own = Labelling.open(folder)
    label(own, scenes, CORNERS[:2])
    write_text(folder / "labels.csv", f"point,camera,u,v\n{names[5]},cam2,10,20\n{names[7]},elsewhere,1,2\n")
    label(own, scenes, CORNERS[2:3])
    assert (folder / "labels.csv").read_text().splitlines()[1:3] == [
        f"{names[5]},cam2,10.00,20.00",
        f"{names[7]},elsewhere,1.00,2.00",
    ]
    assert list(own.marks(VIEW)) == [names[60]]
    write_text(folder / "labels.csv", "point,camera,u,v\nnobody,cam1,1,2\n")
    before = (folder / "labels.csv").read_bytes()
    with pytest.raises(DatasetError, match="nobody"):
        label(own, scenes, CORNERS[2:3])
    assert (folder / "labels.csv").read_bytes() == before
    write_text(folder / "labels.csv", "point,camera,u,v,who\n")
    with pytest.raises(DatasetError, match="columns that would be lost: who"):
        Labelling.open(folder)


def test_labels_round_trip_with_and_without_shots(tmp_path: Path) -> None:
    for shot in ("", "s1"):
        labels = {View("a,b", shot): {"=p": (1.25, 2.5)}, View("c", ""): {"q": (3.0, 4.0)}}
        write_text(tmp_path / "labels.csv", labels_csv(labels))
        assert read_labels(tmp_path / "labels.csv", ["=p", "q"]) == labels


def test_the_other_dots_are_guessed_from_four_labels(folder: Path, scenes: Any) -> None:
    names, _, uv, _ = scenes
    own = Labelling.open(folder)
    label(own, scenes, CORNERS[:3])
    assert own.guess(VIEW) == Guess()
    label(own, scenes, CORNERS[3:4])
    guess = own.guess(VIEW)
    assert not guess.doubt
    assert len(guess.dots) == len(names)
    assert len(guess.found) >= 40
    for name in guess.found:
        assert np.linalg.norm(np.array(guess.dots[name][:2]) - uv["cam1"][names.index(name)]) < 0.5
    label(own, scenes, CORNERS[4:6])
    guess = own.guess(VIEW)
    assert set(names) - set(guess.found) == {names[16], names[71]}
    (own.path.parent / "labels.csv").write_text(labels_csv({VIEW: own.marks(VIEW)}))
    run = detect_folder(folder, Dots.from_files(folder / "points.csv", own.path), unit="mm", overlays=False)
    assert [count.points for count in run.cameras] == [len(guess.found), 0]  # as the page said


def test_a_wrong_name_is_told(folder: Path, scenes: Any) -> None:
    names, _, uv, _ = scenes
    own = Labelling.open(folder)
    label(own, scenes, CORNERS)
    wrong = {**own.marks(VIEW), names[60]: tuple(uv["cam1"][61])}
    write_text(own.path, labels_csv({VIEW: wrong}))
    own.refresh()
    guess = own.guess(VIEW)
    assert guess.suspect == [names[60]] or "do not fit" in guess.doubt


def test_proposals_are_spread_and_leave_out_what_is_not_seen(folder: Path, scenes: Any) -> None:
    names, xyz, _, _ = scenes
    own = Labelling.open(folder)
    proposed = []
    for _ in range(6):
        name = own.propose(VIEW)
        assert name is not None
        proposed.append(names.index(name))
        label(own, scenes, proposed[-1:])
    assert set(proposed[:3]) <= {0, 10, 110, 120}  # corners of the drawing
    assert len(set(xyz[proposed, 2])) >= 2
    name = own.propose(VIEW)
    own.skip(VIEW, str(name))
    assert own.propose(VIEW) not in (name, None)
    own.guess(VIEW)
    guess = Guess({names[5]: (1, 1, 1), names[6]: (2, 2, 1)}, found=[names[6]])
    assert own.propose(VIEW, guess) == names[6]
    single = Labelling(
        ("a",),
        KnownPositions(np.array(["s"]), np.zeros((1, 3)), np.full((1, 3), np.nan)),
        {VIEW: folder},
        folder / "l.csv",
        "",
        "",
    )
    assert single.propose(VIEW) == "a"


def test_the_drawing_is_laid_down_as_the_picture_shows_it(folder: Path, scenes: Any) -> None:
    own = Labelling.open(folder)
    assert len(TURNS) == 8
    assert own.turn(VIEW) == UPRIGHT
    for view in own.pictures:
        label(own, scenes, CORNERS[:4], view)
    assert own.turn(VIEW) == ((1, 0), (0, -1))  # y up
    assert own.turn(View("cam2", "")) == ((-1, 0), (0, -1))  # seen from behind
    assert own.axes(VIEW) == [0, 1, 2]


def test_several_plates_are_labelled_one_by_one(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    uv = np.array([(60.0 + 50 * i, 60.0 + 50 * j) for i in range(4) for j in range(3)])
    rows = [f"{shot}{k},{shot},{u},{v},{z}" for z, shot in enumerate("ab") for k, (u, v) in enumerate(uv)]
    write_text(tmp_path / "points.csv", "\n".join(["point,shot,x,y,z", *rows, ""]))
    for shot in "abc":
        write_picture(tmp_path / "images" / "cam" / f"{shot}.png", photograph(uv, (220, 280), rng=rng))
    own = Labelling.open(tmp_path)
    assert list(own.pictures) == [View("cam", "a"), View("cam", "b")]
    own.place(View("cam", "b"), "b3", uv[3], 5.0)
    assert own.path.read_text().splitlines()[0] == "point,camera,u,v,shot"
    assert list(own.marks(View("cam", "b"))) == ["b3"]
    assert not own.marks(View("cam", "a"))
    with pytest.raises(UsageError):
        own.place(View("cam", "a"), "b4", uv[4], 5.0)
    shutil.rmtree(tmp_path / "images" / "cam")
    write_picture(tmp_path / "images" / "cam" / "x.png", photograph(uv, (220, 280), rng=rng))
    with pytest.raises(
        DatasetError, match=r"no picture shows a shot of the layout, which has a, b; there are pictures x"
    ):
        Labelling.open(tmp_path)


def test_what_cannot_be_labelled_is_said(folder: Path, tmp_path: Path, scenes: Any) -> None:
    with pytest.raises(UsageError, match="is not a folder"):
        Labelling.open(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match=r"points.csv does not exist"):
        Labelling.open(tmp_path)
    write_text(folder / "dataset.toml", 'name = "t"\nlength_unit = "mm"\n[[cameras]]\nname = "left"\n')
    with pytest.raises(
        DatasetError, match=r"there are pictures of cam1, cam2, and the cameras of dataset.toml are left"
    ):
        Labelling.open(folder)
    (folder / "dataset.toml").unlink()
    own = Labelling.open(folder)
    (folder / "images" / "cam1" / "target.png").write_bytes(b"no picture")
    with pytest.raises(ImageError):
        label(own, scenes, [0])
    shutil.rmtree(folder / "images")
    with pytest.raises(ImplicamError):
        label(own, scenes, [0])
    with pytest.raises(ImageError, match="holds no picture"):
        Labelling.open(folder)


def test_a_layout_beside_the_photographs_is_found_by_its_name(folder: Path, scenes: Any) -> None:
    own = Labelling.open(folder, layout=Path("points.csv"), labels=Path("mine.csv"))
    label(own, scenes, CORNERS[:6])
    assert Path("mine.csv").resolve() == own.path.resolve()  # it was nowhere: it is made where the command runs
    own.path.replace(folder / "mine.csv")
    made = Dots.from_options(folder, {}, layout=Path("points.csv"), labels=Path("mine.csv"))
    assert len(made.labels[VIEW]) == 6
    with pytest.raises(UsageError, match="implicam label"):
        Dots.from_options(folder, {}, labels=Path("none.csv"))


# ------------------------------------------------------------------------------------------------ spots and pictures


@pytest.mark.parametrize("dark", [False, True])
def test_the_spot_that_is_meant(dark: bool) -> None:
    rng = np.random.default_rng(3)
    uv = np.array([(50.3, 40.6), (90.1, 40.2), (50.7, 80.4)])
    picture = photograph(uv, (120, 140), radius=4.0, rng=rng)
    picture = 1 - picture if dark else picture
    for k, spot in enumerate(uv):
        found = find_spot_near(picture, spot + np.array([6.0, -5.0]), 12.0, like=uv[:k])
        assert found == pytest.approx(spot, abs=0.15)
    assert find_spot_near(picture, np.array([20.0, 100.0]), 8.0, like=uv) is None
    assert find_spot_near(picture, np.array([-9.0, 100.0]), 8.0) is None
    assert find_spot_near(np.zeros((50, 50), np.float32), np.array([20.0, 20.0]), 8.0) is None


def test_short_names() -> None:
    assert short_names(["t0001", "t0012", "t0436"]) == ["1", "12", "436"]
    assert short_names(["dot-a", "dot-b"]) == ["a", "b"]
    assert short_names(["p1", "p01"]) == ["p1", "p01"]  # 1 twice
    assert short_names(["p", "p1"]) == ["p", "p1"]
    assert short_names(["only"]) == ["only"]
    assert short_names([]) == []


def test_dark_parts_show_in_a_brightened_picture() -> None:
    grey = np.full((300, 300), 10, np.uint8)
    grey[100:140, 100:140] = 30
    grey[:3, :3] = 255
    bright = brighten(grey)
    assert bright[120, 120] > 200
    assert bright[200, 200] < 5
    assert (brighten(np.full((5, 5), 7, np.uint8)) <= 255).all()


def test_an_overlay_shows_found_labelled_and_missing_dots_with_names_that_can_be_read() -> None:
    uv = np.array([(20.0 + 14 * i, 20.0 + 14 * j) for i in range(20) for j in range(20)])
    names = [f"t{k:04d}" for k in range(400)]
    notes = {"labelled": names[:6], "missing": {names[-1]: uv[-1].tolist()}, "scale": 2.0}
    found = Detected(tuple(names[:-1]), uv[:-1], np.ones((399, 2)), "", notes=notes)
    page = draw_overlay(np.full((320, 1700), 90, np.uint8), Result(View("cam1", "target"), Path(), found, 400))
    assert page.shape[1] > 3000  # a name takes more than the 14 pixels from dot to dot
    scale = page.shape[1] / 1700

    def colours(k: int) -> set[tuple[int, int, int]]:
        u, v = ((uv[k] + 0.5) * scale).astype(int)
        return set(map(tuple, page[v - 14 : v + 20, u - 16 : u + 16].reshape(-1, 3)))

    assert {ORANGE} == colours(0) & {ORANGE, SKY, VERMILLION}
    assert {SKY} == colours(150) & {ORANGE, SKY, VERMILLION}
    assert VERMILLION in colours(399) - colours(150)


# ------------------------------------------------------------------------------------------------ the page


class Client:
    """Talks to the page as a browser does that was opened at its address."""

    def __init__(self, url: str) -> None:
        self.base = url.partition("?")[0]
        self.opener = urllib.request.build_opener(
            urllib.request.ProxyHandler({}), urllib.request.HTTPCookieProcessor(CookieJar())
        )
        self.first = self.opener.open(url).read().decode()

    def __call__(self, path: str, body: Any = None) -> Any:
        data = None if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
        try:
            with self.opener.open(urllib.request.Request(self.base + path, data)) as answer:
                return json.loads(answer.read())
        except urllib.error.HTTPError as error:
            return {"status": error.code, **json.loads(error.read())}


def test_the_page_labels_and_answers_nonsense_with_errors(folder: Path, scenes: Any) -> None:
    pytest.importorskip("starlette")
    from implicam.viewer.label_page import open_page

    names, _, uv, _ = scenes
    with open_page(Labelling.open(folder), "the next command", port=0, token="a b") as (url, page):
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(url.partition("?")[0])
        ask = Client(url)
        assert "implicam label" in ask.first
        whole = ask("api/labels")
        assert (whole["needed"], whole["then"], len(whole["pictures"])) == (6, "the next command", 2)
        here = {"camera": "cam1", "shot": ""}
        shown = ask("api/picture?camera=cam1&shot=")
        assert (len(shown["points"]), shown["marks"], shown["undo"], shown["short"][names[7]]) == (121, {}, False, "7")
        for row in CORNERS[:6]:
            done = ask(
                "api/place",
                {**here, "point": names[row], "u": uv["cam1"][row][0] + 2, "v": uv["cam1"][row][1], "within": 8},
            )
            assert not done["said"]
        assert len(done["marks"]) == 6
        assert len(ask("api/guess?camera=cam1&shot=")["found"]) == 119
        assert ask("api/remove", {**here, "point": names[0]})["undo"]
        assert names[0] in ask("api/undo", here)["marks"]
        assert "No dot was found" in ask("api/place", {**here, "point": names[16], "u": 5, "v": 5, "within": 3})["said"]
        for nonsense in (
            b"[",
            b"7",
            {**here, "point": 3},
            {**here, "point": "x", "u": 1, "v": 2, "within": 3},
            {},
            {**here, "point": names[0], "u": "1", "v": None, "within": True},
            {**here, "point": names[0], "u": 1e300, "v": 1, "within": 3},
        ):
            assert ask("api/place", nonsense)["status"] == 400
        assert ask("api/picture?camera=cam9&shot=")["status"] == 400
        with pytest.raises(urllib.error.HTTPError, match="400"):
            ask.opener.open(ask.base + "picture.jpg?camera=..%2F..&shot=")
        body = ask.opener.open(ask.base + "picture.jpg?camera=cam1&shot=&bright=1").read()
        (folder / "shown.jpg").write_bytes(body)
        assert read_picture(folder / "shown.jpg").shape == (600, 800)
        os.remove(folder / "labels.csv")
        assert ask("api/labels")["pictures"][0]["labels"] == 0
        (folder / "labels.csv").mkdir()
        assert ask("api/place", {**here, "point": names[0], "u": 50, "v": 50, "within": 3})["status"] == 400
        inner = [t for t in threading.enumerate() if t.name == "implicam-label"]
        assert inner
        assert not page.closed.is_set()
        ask("api/finish", {})
        assert page.closed.wait(60)
    with (
        pytest.raises(ConnectionRefusedError),
        socket.create_connection(("127.0.0.1", int(re.findall(r":(\d+)/", url)[0])), 2),
    ):
        pass


@pytest.mark.parametrize("path", ["/api/labels", "/picture.jpg"])
def test_the_page_answers_those_who_come_by_the_door_and_no_others(folder: Path, path: str) -> None:
    pytest.importorskip("starlette")
    from implicam.viewer.label_page import LabelPage

    application = LabelPage(Labelling.open(folder), "").application("http://secret.invalid")

    def status(*headers: tuple[bytes, bytes]) -> int:
        sent: list[Any] = []

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message: Any) -> None:
            sent.append(message)

        scope = {
            "type": "http",
            "method": "GET",
            "path": path,
            "query_string": b"camera=cam1&shot=",
            "headers": headers,
        }
        asyncio.run(application(scope, receive, send))
        return int(sent[0]["status"])

    assert status((b"origin", b"http://secret.invalid")) == 200
    assert status() == status((b"origin", b"http://localhost")) == 403


def test_a_picture_that_its_file_says_is_turned_is_shown_as_the_sensor_saw_it(folder: Path, scenes: Any) -> None:
    """CVHub520/X-AnyLabeling issue 447: browsers turn what EXIF says, and the labels are those of another picture."""
    pytest.importorskip("starlette")
    image = pytest.importorskip("PIL.Image")
    from implicam.viewer.label_page import LabelPage

    exif = image.Exif()
    exif[0x0112] = 6  # a quarter turn
    for path in (folder / "images").glob("*/target.png"):
        with image.open(path) as picture:
            picture.save(path.with_suffix(".jpg"), exif=exif, quality=95)
        path.unlink()
    own = Labelling.open(folder)
    label(own, scenes, CORNERS[:1])
    assert np.linalg.norm(np.array(own.marks(VIEW)[scenes[0][0]]) - scenes[2]["cam1"][0]) < 0.2
    (folder / "shown.jpg").write_bytes(LabelPage(own, "").jpeg(VIEW, bright=True))
    with image.open(folder / "shown.jpg") as shown:
        assert shown.size == (800, 600)
        assert not shown.getexif()


def test_names_as_people_give_them(tmp_path: Path, scenes: Any) -> None:
    """Cameras with spaces, umlauts and what means something in an address; points in another order than the clicks."""
    pytest.importorskip("starlette")
    from urllib.parse import quote

    from implicam.viewer.label_page import open_page

    names, xyz, uv, pictures = scenes
    rows = ["point,shot,x,y,z", *(f"Punkt {n} ü,t,{x},{y},{z}" for n, (x, y, z) in zip(names, xyz, strict=True))]
    write_text(tmp_path / "points.csv", "\n".join([*rows, ""]))
    camera = "Kamera 1 & #2 ü+%41"
    write_picture(tmp_path / "images" / camera / "a.png", pictures["cam1"])
    with open_page(Labelling.open(tmp_path), "", port=0) as (url, _):
        ask = Client(url)
        assert ask("api/labels")["pictures"][0]["camera"] == camera
        point = f"Punkt {names[5]} ü"
        body = {"camera": camera, "shot": "", "point": point, "u": uv["cam1"][5][0], "v": uv["cam1"][5][1], "within": 5}
        assert list(ask("api/place", body)["marks"]) == [point]
        assert ask(f"api/picture?camera={quote(camera)}&shot=")["undo"]
    assert list(read_labels(tmp_path / "labels.csv", [point])) == [View(camera, "")]


# ------------------------------------------------------------------------------------------------ for real


LABEL = """
import signal, sys
from implicam.cli import main

signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background of a shell ignores it
main(sys.argv[1:])
"""


@pytest.fixture
def served(folder: Path) -> Any:
    """`implicam label` in a process of its own: the process and the address."""
    command = [sys.executable, "-c", LABEL, "label", str(folder), "--no-browser", "--port", "0"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "COLUMNS": "200"}
    )
    watch = threading.Timer(240, process.kill)
    watch.start()
    try:
        assert process.stderr is not None
        for line in process.stderr:
            if found := re.search(r"http://localhost:\d+/\?token=\S+", line):
                yield process, found[0]
                break
        else:
            raise AssertionError("no address was printed")
    finally:
        watch.cancel()
        process.kill()
        process.communicate(timeout=180)


def on_screen(page: Any, uv: Any) -> tuple[float, float]:
    x, y = page.evaluate(
        "(uv) => { const p = onScreen(uv), r = picture.getBoundingClientRect(); return [p[0] + r.x, p[1] + r.y]; }",
        [float(value) for value in uv],
    )
    return x, y


def ready(page: Any) -> None:
    page.wait_for_function("image !== null && data !== null && (!guess || !guess.busy)", timeout=120_000)


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.parametrize("phone", [False, True])
def test_a_visit(served: Any, folder: Path, scenes: Any, chromium: Any, phone: bool) -> None:
    sync_api = pytest.importorskip("playwright.sync_api")
    names, _, uv, _ = scenes
    process, url = served
    # Zoomed browsers and dense screens, where clicks of others went astray: annotorious/annotorious issue 21,
    # opendatalab/labelU issue 272, erikbernheim/img-labeler issue 12 (1.3 as there)
    size: dict[str, Any] = {
        "viewport": {"width": 1280, "height": 800}, "color_scheme": "light", "device_scale_factor": 1.3
    }  # fmt: skip
    if phone:
        size = {
            "viewport": {"width": 390, "height": 844}, "color_scheme": "dark", "device_scale_factor": 2,
            "has_touch": True, "is_mobile": True,
        }  # fmt: skip
    troubles: list[str] = []
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(**chromium)
        page = browser.new_context(**size).new_page()
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.goto(url)
        for camera in ("cam1", "cam2"):
            page.get_by_role("button", name=re.compile(f"^{camera}")).click()
            for count in range(6):
                ready(page)
                name = page.evaluate("wanted()")
                if count < 4:
                    x, y = on_screen(page, uv[camera][names.index(name)])
                    (page.touchscreen.tap if phone else page.mouse.click)(x + 2, y - 1)
                elif phone:
                    page.get_by_role("button", name="Accept").tap()
                else:
                    page.keyboard.press("Enter")
                page.wait_for_function(f"count() === {count + 1}", timeout=120_000)
            ready(page)
            assert "119 of 121 dots found; 2 missing" in page.inner_text("#guess")
            assert "Enough here" in page.inner_text("#task")
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert "implicam detect" in page.inner_text("#guess")
        before = (folder / "labels.csv").read_text()
        page.keyboard.press("u")
        page.wait_for_function("count() === 5", timeout=120_000)
        page.evaluate("chosen = Object.keys(data.marks)[0]; paint()")
        page.keyboard.press("Delete")
        page.wait_for_function("count() === 4", timeout=120_000)
        for _ in range(2):
            page.get_by_role("button", name="Undo").click()
            page.wait_for_function("count() > 4", timeout=120_000)
        ready(page)
        page.wait_for_timeout(300)
        scale = page.evaluate("scale")
        page.keyboard.press("+")
        assert page.evaluate("scale") > 1.4 * scale
        page.keyboard.press("0")
        assert page.evaluate("scale") == pytest.approx(scale, rel=0.01)
        turned = page.evaluate("JSON.stringify(turn)")
        page.keyboard.press("m")
        assert page.evaluate("JSON.stringify(turn)") != turned
        dark = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert dark == ("rgb(20, 24, 30)" if phone else "rgb(255, 255, 255)")
        marks = {(row["camera"], row["point"]) for row in csv.DictReader(before.splitlines())}
        assert len(marks) == 12
        page.get_by_role("button", name="Finish").click()
        page.get_by_text("Closed. Every label is saved").wait_for(timeout=120_000)
        browser.close()
    out, _ = process.communicate(timeout=180)  # a machine that is busy takes its time
    assert process.returncode == 0
    assert "cam1: 6 labels" in out
    assert f"next: implicam detect {folder} --target dots" in out
    assert troubles == []
    assert set(read_labels(folder / "labels.csv", names)) == {VIEW, View("cam2", "")}


@pytest.mark.slow
def test_a_kill_loses_nothing_and_ctrl_c_ends_it(served: Any, folder: Path, scenes: Any) -> None:
    pytest.importorskip("starlette")
    names, _, uv, _ = scenes
    process, url = served
    ask = Client(url)
    ask(
        "api/place",
        {"camera": "cam1", "shot": "", "point": names[0], "u": uv["cam1"][0][0], "v": uv["cam1"][0][1], "within": 4},
    )
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=180)  # a machine that is busy takes its time
    assert process.returncode == 0
    assert "cam1: 1 label, 5 more needed" in out
    assert list(Labelling.open(folder).marks(VIEW)) == [names[0]]
