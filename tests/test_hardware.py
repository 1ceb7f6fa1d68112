"""Drivers: one contract over every camera and every robot, then what is special to each.

There is no camera and no robot here. Real are: OpenCV on a film file and on an HTTP stream; folders; sockets; both
libraries of ur-rtde, which talk to tests/rtde_stand_in.py as to a robot. Stand-ins: the Harvester object of harvesters
(no software GenTL producer is on the package index), and V4L2, of which only the error is tested.
"""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest

from drivers import ONE, SHAPE, nothing_left, number_in, picture, says_all, simulated_robot, write_film  # noqa: F401
from implicam import hardware
from implicam.errors import HardwareError
from implicam.hardware import FolderCamera, GenICamCamera, OpenCVCamera, simulated_rig
from implicam.hardware.genicam import to_grey
from implicam.images import write_picture

pytestmark = pytest.mark.usefixtures("looks_kept")

# ---- cameras -------------------------------------------------------------------------------------------------------


@dataclass
class Bench:
    """A camera; how to unplug it and to plug it in again; whether it is live."""

    camera: hardware.FrameSource
    unplug: Callable[[], None]
    plug: Callable[[], None]
    live: bool = True


class Stream:
    """An MJPEG camera on HTTP: 40 pictures a second, each with its number in it."""

    def __init__(self) -> None:
        self.sent, self.on = 0, True
        stream = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if not stream.on:
                    self.send_error(503)
                    return
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=b")
                self.end_headers()
                try:
                    while stream.on:
                        stream.sent += 1
                        jpeg = cv2.imencode(".jpg", picture(stream.sent))[1].tobytes()
                        head = f"--b\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                        self.wfile.write(head.encode() + jpeg + b"\r\n")
                        time.sleep(0.025)
                except OSError:
                    return

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = False
        self.address = f"http://127.0.0.1:{self.server.server_port}/video.mjpg"
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.02,))
        self.thread.start()

    def end(self) -> None:
        self.on = False
        self.server.shutdown()
        self.server.server_close()
        self.thread.join()


def film_bench(tmp_path: Path) -> Iterator[Bench]:
    path = write_film(tmp_path / "film.avi", 6)
    away = path.with_suffix(".away")
    yield Bench(OpenCVCamera("cam1", path), lambda: path.rename(away), lambda: away.rename(path), live=False)


def stream_bench(tmp_path: Path) -> Iterator[Bench]:
    stream = Stream()
    camera = OpenCVCamera("cam1", stream.address)

    def switch(on: bool) -> None:
        stream.on = on

    yield Bench(camera, lambda: switch(False), lambda: switch(True))
    camera.close()
    stream.end()


def folder_bench(tmp_path: Path) -> Iterator[Bench]:
    folder, ending = tmp_path / "shots", threading.Event()
    folder.mkdir()
    writes = threading.Event()
    writes.set()

    def fill() -> None:
        number = 0
        while not ending.wait(0.03):
            if writes.is_set():
                number += 1
                write_picture(folder / f"shot{number}.png", picture(number))

    thread = threading.Thread(target=fill)
    thread.start()
    yield Bench(FolderCamera("cam1", folder), writes.clear, writes.set)
    ending.set()
    thread.join()


class StandInHarvester:
    """Has the methods of harvesters 1.4's Harvester, and of its acquirer and buffers, that the driver calls."""

    on, open_buffers, number = True, 0, 0

    def add_file(self, path: str) -> None:
        self.file = path

    def update(self) -> None:
        self.device_info_list = [SimpleNamespace(serial_number="S1")] if StandInHarvester.on else []

    def create(self, which: dict[str, str]) -> "StandInHarvester":
        assert which == {"serial_number": "S1"}
        return self

    def start(self) -> None:
        self.waiting = 2  # old pictures in the buffers

    def stop(self) -> None: ...

    def destroy(self) -> None: ...

    def reset(self) -> None: ...

    def try_fetch(self, timeout: float) -> SimpleNamespace | None:
        if not StandInHarvester.on:
            raise OSError("the device is gone")
        if timeout == 0.0 and self.waiting == 0:
            return None
        self.waiting = max(0, self.waiting - 1)
        StandInHarvester.number += 1
        StandInHarvester.open_buffers += 1
        data = picture(StandInHarvester.number).ravel()
        image = SimpleNamespace(data=data, width=SHAPE[1], height=SHAPE[0], data_format="Mono8")

        def queue() -> None:
            StandInHarvester.open_buffers -= 1

        return SimpleNamespace(payload=SimpleNamespace(components=[image]), queue=queue)


@pytest.fixture
def harvesters(monkeypatch: pytest.MonkeyPatch) -> type[StandInHarvester]:
    core = ModuleType("harvesters.core")
    core.Harvester = StandInHarvester  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "harvesters.core", core)
    StandInHarvester.on, StandInHarvester.open_buffers, StandInHarvester.number = True, 0, 0
    return StandInHarvester


def genicam_bench(tmp_path: Path) -> Iterator[Bench]:
    producer = tmp_path / "maker.cti"
    producer.write_bytes(b"\x7fELF")

    def switch(on: bool) -> None:
        StandInHarvester.on = on

    yield Bench(GenICamCamera("cam1", "S1", producer), lambda: switch(False), lambda: switch(True))
    assert StandInHarvester.open_buffers == 0


def simulated_bench(tmp_path: Path) -> Iterator[Bench]:
    (camera,), _ = simulated_rig(ONE, seed=2)
    yield Bench(camera, lambda: camera.fail_for(1), lambda: camera.fail_for(0))


BENCHES = [film_bench, stream_bench, folder_bench, genicam_bench, simulated_bench]


@pytest.fixture(params=BENCHES, ids=lambda bench: bench.__name__)
def bench(request: pytest.FixtureRequest, tmp_path: Path, harvesters: object) -> Iterator[Bench]:
    source = request.param(tmp_path)
    made = next(source)
    yield made
    made.camera.close()
    assert next(source, None) is None


def test_a_camera_gives_newer_pictures_each_time(bench: Bench) -> None:
    camera = bench.camera
    assert camera.name == "cam1"
    camera.open()
    camera.open()
    called, frames = time.time(), [camera.frame() for _ in range(3)]
    for frame in frames:
        assert frame.picture.dtype == np.float32
        assert frame.picture.ndim == 2
        assert 0 <= frame.picture.min() <= frame.picture.max() <= 1
        assert called - 0.05 <= frame.taken <= time.time() + 0.05
    assert [frame.number for frame in frames] == sorted({frame.number for frame in frames})
    assert not any(np.array_equal(a.picture, b.picture) for a, b in pairwise(frames))
    camera.close()
    camera.close()
    assert camera.frame().number > frames[-1].number  # frame opens by itself


def test_a_camera_that_is_unplugged_says_so_and_comes_back(bench: Bench) -> None:
    bench.camera.frame()
    if not bench.live:
        bench.camera.close()  # a film that is open needs no name
    bench.unplug()
    with pytest.raises(HardwareError) as caught:
        [bench.camera.frame(timeout=0.3) for _ in range(50)]  # what was on its way may still arrive
    says_all(caught.value)
    assert "cam1" in str(caught.value)
    bench.plug()
    assert bench.camera.frame().picture.size > 0


def test_a_film_gives_every_picture_in_order_and_ends(tmp_path: Path) -> None:
    camera = OpenCVCamera("cam1", write_film(tmp_path / "film.avi", 5))
    assert [number_in(camera.frame()) for _ in range(5)] == [1, 2, 3, 4, 5]
    for _ in range(2):
        with pytest.raises(HardwareError, match="is over"):
            camera.frame()
    camera.close()
    assert number_in(camera.frame()) == 1
    camera.close()


def test_a_stream_never_gives_a_picture_of_before_the_call() -> None:
    stream = Stream()
    camera = OpenCVCamera("cam1", stream.address)
    try:
        for pause in (0.0, 0.3, 0.1):
            camera.frame()
            time.sleep(pause)  # 0.3 s is 12 pictures that a driver without a thread would find in its buffer
            sent = stream.sent
            ahead = (number_in(camera.frame()) - sent) % 25
            assert 1 <= ahead < 12
    finally:
        camera.close()
        stream.end()


@pytest.mark.parametrize("source", ["/dev/video97", "97", "no-such.avi"])
def test_what_cannot_be_opened_is_named(source: str) -> None:
    with pytest.raises(HardwareError, match="cannot be opened") as caught:
        OpenCVCamera("cam1", source).open()
    says_all(caught.value)


def test_a_film_that_is_none(tmp_path: Path) -> None:
    path = tmp_path / "text.avi"
    path.write_text("no film")
    with pytest.raises(HardwareError, match="cannot be opened"):
        OpenCVCamera("cam1", path).frame()


def test_a_folder_waits_for_the_whole_picture(tmp_path: Path) -> None:
    write_picture(tmp_path / "old.png", picture(1))
    whole = cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, SHAPE, np.uint8))[1].tobytes()
    early = cv2.imencode(".png", picture(2))[1].tobytes()
    half = tmp_path / "half-written-before-the-call.png"
    half.write_bytes(early[: len(early) // 2])
    camera = FolderCamera("cam1", tmp_path)

    def write() -> None:
        time.sleep(0.1)
        half.write_bytes(early)  # of before the call: not this one
        with (tmp_path / "new.png").open("wb") as file:
            file.write(whole[:500])
            file.flush()
            time.sleep(0.2)
            file.write(whole[500:])

    thread = threading.Thread(target=write)
    thread.start()
    frame = camera.frame()
    thread.join()
    assert np.array_equal(np.rint(frame.picture * 255), cv2.imdecode(np.frombuffer(whole, np.uint8), 0))
    with pytest.raises(HardwareError, match="no new picture"):
        camera.frame(timeout=0.2)


def test_a_folder_says_what_stays_cut_off_and_what_is_not_there(tmp_path: Path) -> None:
    camera = FolderCamera("cam1", tmp_path)
    timer = threading.Timer(0.1, lambda: (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n"))
    timer.start()
    with pytest.raises(HardwareError, match=r"a\.png did not become a whole picture"):
        camera.frame(timeout=0.4)
    timer.join()
    with pytest.raises(HardwareError, match="cannot be watched"):
        FolderCamera("cam1", tmp_path / "none").open()


def test_a_folder_takes_a_picture_that_replaces_another(tmp_path: Path) -> None:
    write_picture(tmp_path / "latest.png", picture(1))
    timer = threading.Timer(0.1, lambda: write_picture(tmp_path / "latest.png", picture(2)))
    timer.start()
    assert number_in(FolderCamera("cam1", tmp_path, "lat*").frame()) == 2
    timer.join()


def test_genicam_skips_what_waited_in_the_buffers(tmp_path: Path, harvesters: type[StandInHarvester]) -> None:
    producer = tmp_path / "maker.cti"
    producer.write_bytes(b"")
    free = GenICamCamera("cam1", "S1", producer)
    assert number_in(free.frame()) == 4  # two old ones, and one that may have begun before the call
    free.close()
    triggered = GenICamCamera("cam1", "S1", producer, triggered=True)
    assert number_in(triggered.frame()) == 4 + 3
    triggered.close()
    with pytest.raises(HardwareError, match="S1, not S2"):
        GenICamCamera("cam1", "S2", producer).open()
    with pytest.raises(HardwareError, match="no GenTL producer"):
        GenICamCamera("cam1", "S1", tmp_path / "none.cti").open()


@pytest.mark.parametrize(("bits", "name"), [(8, "Mono8"), (10, "Mono10"), (12, "Mono12"), (16, "Mono16")])
def test_grey_formats_keep_every_bit(bits: int, name: str) -> None:
    values = np.random.default_rng(1).integers(0, 2**bits, SHAPE).astype(np.uint8 if bits == 8 else np.uint16)
    grey = to_grey(values.ravel(), SHAPE[1], SHAPE[0], name)
    assert np.array_equal(np.rint(grey.astype(np.float64) * (2**bits - 1)), values)


@pytest.mark.parametrize("order", ["RG", "BG", "GR", "GB"])
def test_a_mosaic_of_one_colour_has_that_colours_grey(order: str) -> None:
    colour = {"R": 200, "G": 90, "B": 30}
    second = {"RG": "GB", "BG": "GR", "GR": "BG", "GB": "RG"}[order]
    tile = np.array([[colour[letter] for letter in row] for row in (order, second)], np.uint8)
    grey = to_grey(np.tile(tile, (24, 32)).ravel(), 64, 48, f"Bayer{order}8")
    wanted = (0.299 * 200 + 0.587 * 90 + 0.114 * 30) / 255  # ITU-R BT.601
    assert np.allclose(grey, wanted, atol=1.5 / 255)
    rgb = np.broadcast_to(np.array([200, 90, 30], np.uint8), (48, 64, 3))
    assert np.allclose(to_grey(rgb.ravel(), 64, 48, "RGB8"), wanted, atol=1 / 255)
    with pytest.raises(HardwareError, match="Mono12p"):
        to_grey(tile, 2, 2, "Mono12p")
