"""`implicam view`: what a calibration looks like in 3D, the page behind its door, a visit by a browser."""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from http.cookiejar import CookieJar
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import implicam as ic
from deployed_rigs import RIGS
from implicam.dataset.image_bounds import image_bounds
from implicam.errors import ImageError, UsageError
from implicam.files import write_text
from implicam.images import write_picture
from implicam.measurement import notes_outside
from implicam.report.instrument import Instrument
from implicam.viewer.calibration_page import CalibrationPage
from implicam.viewer.calibration_scene import COLUMNS, ROWS, measured_points, scene, uncertainty_map

pytest.importorskip("starlette")


SUMS = {
    "LICENSE": "bfe119ea4fd413f5f7ca3fcd63adb0c4a073ed39daa2fe7d3e6b769e21272601",
    "OrbitControls.js": "b97879c748170baadeb3fb84cea1ffdf4674e283dc06042f34e2acb95a76042c",
    "three.core.min.js": "61ba0df005b05991361d040d8ff670e1aadfd0ce7aeebd1fdb0725957a8957de",
    "three.module.min.js": "e2b5ee6bccd38fd6d8a2428546b83c5f2426d84b152ef82be8055556e3b40eb6",
}


@pytest.fixture(scope="module")
def rig() -> Any:
    return ic.simulated("stereo", points=40, seed=3)


@pytest.fixture(scope="module")
def stereo(rig: Any) -> Any:
    return ic.ForwardGP().fit(rig)


# ---------------------------------------------------------------------------------------------------- what is drawn


@pytest.mark.parametrize("kind", ["fisheye", "mirror", "other pixels", "window", "a real tank"])
def test_pictures_stand_where_the_cameras_see_them(kind: str) -> None:
    """What lies behind a place of a drawn picture, as far away as the known points, has its image there."""
    made = RIGS[kind]()
    drawn, known = scene(made), made.data.xyz
    low, high = known.min(axis=0), known.max(axis=0)
    assert {camera["name"] for camera in drawn["cameras"]} == set(made.camera_names), drawn["notes"]
    assert not drawn["notes"]
    for camera in drawn["cameras"]:
        place = np.array([[np.nan if v is None else v for v in one] for one in camera["picture"]])
        c = made.map.trained.camera_names.index(camera["name"])
        (u0, v0), (u1, v1) = image_bounds(made.map.trained, c)  # type: ignore[misc]
        u, v = np.meshgrid(np.linspace(u0, u1, COLUMNS + 1), np.linspace(v0, v1, ROWS + 1))
        centre = np.array(camera["centre"])
        way = (place - centre) / np.linalg.norm(place - centre, axis=1)[:, None]
        behind = centre + way * np.linalg.norm(known.mean(axis=0) - centre)
        rows = np.flatnonzero(((behind > low) & (behind < high)).all(axis=1))
        if not len(rows):  # the points fill a small part of the picture
            continue
        off = made.map.predict(behind[rows])[:, c] - np.column_stack([u.ravel(), v.ravel()])[rows]
        assert np.linalg.norm(off, axis=1).max() < 0.1  # pixels
    assert np.linalg.norm(np.subtract(*drawn["box"])) > 0


def test_the_map_is_that_of_the_report_and_says_where_there_is_none(stereo: Any) -> None:
    instrument = Instrument(stereo)
    found = uncertainty_map(instrument)
    total = np.array([np.nan if v is None else v for v in found["maps"]["all sources"]])
    np.testing.assert_array_equal(total, instrument.sd)
    assert [len(axis) for axis in found["axes"]] == [11, 11, 11]
    parts = [np.array(values, dtype=float) for name, values in found["maps"].items() if name != "all sources"]
    np.testing.assert_allclose(sum(part**2 for part in parts), total**2, rtol=1e-9)
    json.dumps(found, allow_nan=False)


def test_measured_points_are_those_of_the_measurement_in_the_unit_of_the_page(rig: Any, stereo: Any) -> None:
    measured = stereo.measure(rig)
    found = measured_points(measured, stereo.data.length_unit)
    np.testing.assert_array_equal(found["xyz"], measured.xyz)
    xx, xy, xz, yy, yz, zz = np.array(found["cov"]).T
    cov = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).transpose(2, 0, 1)
    np.testing.assert_array_equal(cov, measured.cov)
    in_metres = measured_points(measured.in_unit("m"), stereo.data.length_unit)
    np.testing.assert_allclose(in_metres["xyz"], measured.xyz, rtol=1e-12)
    lone = measured.select([0, 1])
    lone = ic.Measurement(
        **{
            **{name: getattr(lone, name) for name in lone.__dataclass_fields__},
            "xyz": np.array([lone.xyz[0], [np.nan] * 3]),
        }
    )
    some = measured_points(lone, stereo.data.length_unit)
    assert (len(some["names"]), some["missing"]) == (1, [[str(measured.points[1]), "no reason given"]])
    json.dumps(some, allow_nan=False)


@pytest.mark.parametrize("method", [ic.InverseGP(), ic.Explicit()])
def test_other_methods(rig: Any, method: Any) -> None:
    drawn = scene(method.fit(rig))
    json.dumps(drawn, allow_nan=False)
    assert len(drawn["known"]["xyz"]) == len(rig)
    if isinstance(method, ic.InverseGP):
        assert (drawn["cameras"], drawn["maps"]) == ([], False)
        assert "no cameras" in drawn["notes"][0]
    else:
        assert len(drawn["cameras"]) == 2
        assert drawn["maps"]


def test_cameras_alone(stereo: Any, tmp_path: Path) -> None:
    """Imported from another program: there is no known point, and so no box to map the uncertainty in."""
    from implicam.cli import main

    stereo.save(tmp_path / "rig.implicam")
    for words in (
        ["export", str(tmp_path / "rig.implicam"), "--to", "aniposelib", "-o", str(tmp_path / "cameras.toml")],
        ["import", str(tmp_path / "cameras.toml"), "-o", str(tmp_path / "cameras.implicam")],
    ):
        with pytest.raises(SystemExit) as end:
            main(words)
        assert not end.value.code
    drawn = scene(ic.load_calibration(tmp_path / "cameras.implicam"))
    json.dumps(drawn, allow_nan=False)
    assert (len(drawn["cameras"]), drawn["known"]["xyz"], drawn["maps"]) == (2, [], False)
    assert "no box" in drawn["notes"][-1]


def test_the_library_that_draws_is_what_it_says() -> None:
    """three.js 0.180.0 (MIT), as published: nobody changed it here."""
    folder = resources.files("implicam.viewer") / "templates" / "three"
    assert "MIT" in (folder / "LICENSE").read_text()
    sums = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.iterdir()}
    assert sums == SUMS


# ---------------------------------------------------------------------------------------------------- behind the door


class Client:
    """A browser without a screen."""

    def __init__(self, url: str) -> None:
        self.base = url.partition("?")[0]
        self.opener = urllib.request.build_opener(
            urllib.request.ProxyHandler({}), urllib.request.HTTPCookieProcessor(CookieJar())
        )
        self.first = self.opener.open(url).read().decode()

    def get(self, path: str) -> bytes:
        return bytes(self.opener.open(self.base + path, timeout=60).read())

    def chunks(self, count: int, begin: int = 0) -> list[dict[str, Any]]:
        """So many events of the stream of points."""
        request = urllib.request.Request(self.base + "api/points", headers={"Last-Event-ID": str(begin)})
        found = []
        with self.opener.open(request, timeout=60) as stream:
            while len(found) < count:
                line = stream.readline().decode()
                if line.startswith("data: "):
                    found.append(json.loads(line[6:]))
        return found


def test_points_stream_to_the_page_and_are_not_sent_twice(rig: Any, stereo: Any) -> None:
    measured = stereo.measure(rig)
    with ic.LiveView(stereo, browser=False) as view:
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(view.url.partition("?")[0])
        page = Client(view.url)
        assert "implicam view" in page.first
        for file in ("view.js", "scene3d.js", "view.css", "page.css", "three.module.min.js", "OrbitControls.js"):
            assert page.get(file)
        assert [camera["name"] for camera in json.loads(page.get("api/scene"))["cameras"]] == ["cam1", "cam2"]
        assert "all sources" in json.loads(page.get("api/map"))["maps"]
        view.add(measured.select(np.arange(3)))
        threading.Timer(0.5, lambda: view.add(measured.select(np.arange(3, 7)))).start()
        first, second = page.chunks(2)
        assert [first["names"], second["names"]] == [measured.points[:3].tolist(), measured.points[3:7].tolist()]
        assert page.chunks(1, begin=1)[0]["names"] == second["names"]
        with pytest.raises(urllib.error.HTTPError, match="400"):
            page.get("picture.jpg?camera=cam1&shot=..%2F..")
    with pytest.raises(UsageError, match="closed"):
        view.add(measured)
    view.close()


def test_points_that_are_added_while_others_are_on_their_way_are_sent(rig: Any, stereo: Any) -> None:
    """They come from another thread, so at any moment: also between an event and the next."""
    measured = stereo.measure(rig)
    page = CalibrationPage(stereo)
    page.add(measured.select(np.arange(3)))

    async def watch() -> list[str]:
        events = []
        async for event in page._stream(0):
            if "data: " in event:
                events.append(event)
                if len(events) == 1:
                    page.add(measured.select(np.arange(3, 7)))  # while the first is written to the socket
                    threading.Timer(5.0, page.closed.set).start()
                if len(events) == 2:
                    page.closed.set()
        return events

    events = asyncio.run(watch())
    assert [event.partition("\n")[0] for event in events] == ["id: 1", "id: 2"]


def test_of_very_many_points_the_page_says_that_some_are_not_shown(
    rig: Any, stereo: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from implicam.viewer import calibration_page

    monkeypatch.setattr(calibration_page, "MAX_POINTS", 50)
    monkeypatch.setattr(calibration_page, "CHUNK_POINTS", 16)
    with ic.LiveView(stereo, browser=False) as view:
        view.add(stereo.measure(rig))
        view.add(stereo.measure(rig))
        chunks = Client(view.url).chunks(6)
    assert sum(len(chunk["names"]) for chunk in chunks) == 50
    assert sum(chunk["not_shown"] for chunk in chunks) == 30


def test_pictures_of_other_cameras_are_refused(stereo: Any, tmp_path: Path) -> None:
    for camera in ("left", "right"):
        write_picture(tmp_path / "images" / camera / "a.png", np.zeros((40, 50), np.uint8))
    with pytest.raises(ImageError, match="no picture is of a camera"):
        ic.LiveView(stereo, pictures=tmp_path / "images", browser=False)


def test_pictures_of_another_size_are_not_drawn(stereo: Any, tmp_path: Path) -> None:
    for camera in stereo.camera_names:
        write_picture(tmp_path / "images" / camera / "a.png", np.zeros((800, 1280), np.uint8))
    with ic.LiveView(stereo, pictures=tmp_path / "images", browser=False) as view:
        with pytest.raises(urllib.error.HTTPError) as refused:
            Client(view.url).get("picture.jpg?camera=cam1&shot=a")
        said = json.loads(refused.value.read())
    assert "1280 x 800 pixels" in said["error"]
    assert "1280 x 1024" in said["why"]


def test_points_where_nothing_was_known_are_told(rig: Any, stereo: Any) -> None:
    """Behind a window error bars there were several times too small, and nothing said so."""
    order = np.argsort(rig.xyz[:, 0])
    slab = ic.ForwardGP().fit(rig.select(order[10:30]))
    measured = slab.measure(rig)
    with ic.LiveView(slab, browser=False) as view:
        view.add(measured)
        chunks = Client(view.url).chunks(2)
    low, high = slab.data.xyz.min(axis=0), slab.data.xyz.max(axis=0)
    beyond = np.linalg.norm(np.maximum(np.maximum(low - measured.xyz, measured.xyz - high), 0), axis=1)
    count = int((beyond > 0.05 * np.linalg.norm(high - low)).sum())
    assert count > 5
    assert chunks[1]["note"].startswith(f"{count} of 40 points are outside of the box of the known points")
    assert notes_outside(stereo.measure(rig), stereo.data) == []


# ------------------------------------------------------------------------------------------------ the command, for real

COMMAND = """
import signal, sys
from implicam.cli import main

signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background of a shell ignores it
main(sys.argv[1:])
"""


class Running:
    """`implicam view ...` in a process of its own."""

    def __init__(self, *words: str) -> None:
        command = [sys.executable, "-c", COMMAND, "view", *words, "--no-browser", "--port", "0", "--json"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self._watch = threading.Timer(240, self.process.kill)
        self._watch.start()
        assert self.process.stderr is not None
        for line in self.process.stderr:
            if found := re.search(r"http://localhost:\d+/\?token=\S+", line):
                self.url = found[0]
                break
        else:
            raise AssertionError("no address was printed")

    def end(self) -> dict[str, Any]:
        """What it prints when it is done."""
        try:
            out, err = self.process.communicate(timeout=180)
        finally:
            self._watch.cancel()
            self.process.kill()
        assert self.process.returncode == 0, err
        return dict(json.loads(out))


def rows(data: Any, points: range) -> str:
    """Observations as lines, point by point."""
    found = data.observations
    return "".join(
        f"{found.points[i]},{found.camera_names[c]},{found.uv[i, c, 0]},{found.uv[i, c, 1]}\n"
        for i in points
        for c in range(len(found.camera_names))
        if found.seen[i, c]
    )


@pytest.mark.slow
def test_points_of_a_growing_file_are_shown_as_they_come_and_only_when_complete(
    rig: Any, stereo: Any, tmp_path: Path
) -> None:
    stereo.save(tmp_path / "rig.implicam")
    seen = tmp_path / "seen.csv"  # it is not there yet: a recording begins so
    running = Running(str(tmp_path / "rig.implicam"), str(seen), "--follow")
    page, begin = Client(running.url), 0

    def told(what: str, count: int) -> list[Any]:
        """So many names, or the next note."""
        nonlocal begin
        found: list[Any] = []
        while len(found) < count:
            chunk = page.chunks(1, begin)[0]
            begin += 1
            if what in chunk:
                found += chunk[what] if what == "names" else [chunk[what]]
            if what == "names" and what in chunk:
                at = [expected.points.tolist().index(name) for name in chunk["names"]]
                np.testing.assert_allclose(chunk["xyz"], expected.xyz[at], rtol=1e-9)  # with both of its views
        return found

    expected = stereo.measure(rig)
    assert told("note", 1)[0] == f"waiting for {seen}"
    write_text(seen, "point,camera,u,v\n" + rows(rig, range(2)))
    assert told("names", 2) == expected.points[:2].tolist()
    more = rows(rig, range(2, 5)).encode()
    with seen.open("ab", buffering=0) as file:  # half a line, then the rest of it, then the last view of a point
        last = more[:-1].rindex(b"\n") + 1
        for piece in (more[:37], more[37:last], more[last:]):
            file.write(piece)
            time.sleep(0.4)
    assert told("names", 3) == expected.points[2:5].tolist()
    write_text(seen, seen.read_text() + "rubbish\n")
    assert "Nothing new is shown until that is mended." in told("note", 1)[0]
    first, second = (str(name) for name in rig.points[:2])
    moved = rows(rig, range(1, 2)).replace(second, first)  # the first point is where the second is
    write_text(seen, "point,camera,u,v\n" + moved + rows(rig, range(1, 5)))
    chunk = page.chunks(2, begin)
    names = [name for one in chunk for name in one.get("names", ())]
    assert names == [first]  # measured again, since its views are others
    running.process.send_signal(signal.SIGINT)
    assert running.end()["points"] == 5


SLIDE = """(value) => {
  const slider = document.getElementById("threshold");
  slider.value = value;
  slider.dispatchEvent(new Event("input"));
}"""

VOLUME = """() => {  // enclosed by the surface, of the whole box
  const mesh = implicam.scene.groups.volume.children[0];
  if (!mesh) return 0;
  const at = mesh.geometry.attributes.position, index = mesh.geometry.index.array;
  let sum = 0;
  for (let k = 0; k < index.length; k += 3) {
    const [a, b, c] = [0, 1, 2].map((i) => [at.getX(index[k + i]), at.getY(index[k + i]), at.getZ(index[k + i])]);
    sum += a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0]);
  }
  const [low, high] = implicam.world.box, scale = implicam.world.placing.scale;
  return sum / 6 / [0, 1, 2].reduce((product, i) => product * scale * (high[i] - low[i]), 1);
}"""


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.parametrize(("wide", "high", "scheme"), [(1440, 900, "light"), (820, 1180, "dark"), (390, 844, "dark")])
def test_a_visit(
    stereo: Any, rig: Any, tmp_path: Path, chromium: dict[str, Any], wide: int, high: int, scheme: Any
) -> None:
    playwright = pytest.importorskip("playwright.sync_api")
    stereo.save(tmp_path / "rig.implicam")
    for k, camera in enumerate(stereo.camera_names):
        write_picture(tmp_path / "images" / camera / "a.png", np.full((1024, 1280), 80 + 90 * k, np.uint8))
    measured = stereo.measure(rig)
    options = {
        **chromium,
        "args": [*chromium.get("args", []), "--use-gl=swiftshader", "--enable-webgl", "--ignore-gpu-blocklist"],
    }
    with ic.LiveView(stereo, pictures=tmp_path / "images", browser=False) as view, playwright.sync_playwright() as play:
        browser = play.chromium.launch(**options)
        page = browser.new_page(viewport={"width": wide, "height": high}, color_scheme=scheme)
        wrong: list[str] = []
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda line: wrong.append(line.text) if line.type == "error" else None)
        page.set_default_timeout(120_000)
        page.goto(view.url)
        page.wait_for_selector("body[data-ready]")
        page.wait_for_selector("body[data-pictures='2']")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        # the region above a threshold holds what the map says
        sd = np.sort(Instrument(stereo).sd)
        for part in (0, 40, 90):
            page.evaluate(SLIDE, part)
            words = page.inner_text("#level")
            assert f"{100 - part} % of the box" in words, words
            share = page.evaluate(VOLUME)
            field = refined(Instrument(stereo))
            level = sd[min(int(part / 100 * len(sd)), len(sd) - 1)]
            assert abs(share - np.mean(field >= level)) < 0.06, (part, share)
        # points come while it is open
        view.add(measured.select(np.arange(30)))
        page.wait_for_function("document.getElementById('count').textContent.startsWith('30 points')")
        view.add(measured.select(np.arange(30, 40)))
        page.wait_for_function("document.getElementById('count').textContent.startsWith('40 points')")
        drawn = page.evaluate("implicam.scene.groups.ellipsoids.children[0].count")
        assert drawn == 40
        shape = np.array(
            page.evaluate("[...implicam.scene.groups.ellipsoids.children[0].instanceMatrix.array.slice(0, 16)]")
        )
        half = shape.reshape(4, 4).T[:3, :3] / page.evaluate("implicam.scene.placing.scale * implicam.scene.magnified")
        turn = np.array(page.evaluate("implicam.world.placing.rotation"))
        np.testing.assert_allclose(half @ half.T, 7.814728 * turn @ measured.cov[0] @ turn.T, rtol=1e-4, atol=1e-12)
        # from a camera's place its points lie on their images
        page.select_option("#from", "cam2")
        off = page.evaluate(ON_PICTURE, [stereo.map.predict(rig.xyz[:10])[:, 1].tolist(), rig.xyz[:10].tolist()])
        assert max(off) < 4.0  # pixels of the screen; its grid has cells of 100 pixels of the picture
        page.keyboard.press("0")
        assert page.input_value("#from") == ""
        shot = page.locator("#scene").screenshot()
        assert len(np.unique(np.frombuffer(shot, np.uint8))) > 100
        assert not wrong, wrong
        page.click("#end")
        view.wait()
        browser.close()


ON_PICTURE = """([pixels, places]) => {  // pixels of the screen from where each place is drawn to its image
  const scene = implicam.scene, {at, rows, columns} = scene.pictures.cam2;
  scene.camera.updateMatrixWorld();
  const screen = (p) => { const q = p.clone().project(scene.camera);
    return [q.x * scene.canvas.clientWidth / 2, q.y * scene.canvas.clientHeight / 2]; };
  return pixels.map(([u, v], n) => {
    const x = (u + 0.5) / 1280 * columns, y = (v + 0.5) / 1024 * rows, c = Math.min(Math.floor(x), columns - 1);
    const r = Math.min(Math.floor(y), rows - 1), [s, t] = [x - c, y - r], cell = (i, j) => at[i * (columns + 1) + j];
    const image = cell(r, c).clone().multiplyScalar((1 - s) * (1 - t)).addScaledVector(cell(r, c + 1), s * (1 - t))
      .addScaledVector(cell(r + 1, c), (1 - s) * t).addScaledVector(cell(r + 1, c + 1), s * t);
    const [a, b] = [screen(image), screen(scene.place(places[n]))];
    return Math.hypot(a[0] - b[0], a[1] - b[1]);
  });
}"""


def refined(instrument: Instrument) -> np.ndarray:
    """The map between its places, linear along each axis."""
    from scipy.interpolate import RegularGridInterpolator

    cube = instrument.sd.reshape([len(axis) for axis in instrument.axes])
    fine = [np.linspace(axis[0], axis[-1], 41) for axis in instrument.axes]
    found: np.ndarray = RegularGridInterpolator(instrument.axes, cube)(np.stack(np.meshgrid(*fine, indexing="ij"), -1))
    return found
