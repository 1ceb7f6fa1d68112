"""USB cameras: what they are set to, against OpenCV's own V4L2 code and a device that stands in (v4l2_stand_in.c).

There is no camera here, and no kernel module can be loaded. What a program asks of /dev/video90 is answered by a
library that is preloaded into a process of its own; everything above it, OpenCV too, is what runs with a real camera.
Where no C compiler is, these tests are left out. The others have a capture that behaves as people report (each names
the report).
"""

import json
import os
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from implicam.errors import HardwareError, UsageError
from implicam.hardware import OpenCVCamera, camera_from, compare_settings, device_settings, refuse_one_device_twice
from implicam.hardware import opencv_camera as module
from implicam.hardware.device_settings import apply_settings, differences, lasting_name, parse_settings, settings_words

SCRIPT = """
import json, os, sys, threading
from implicam.errors import ImplicamError
from implicam.hardware import camera_from
from implicam.hardware.protocol import take_frames
from concurrent.futures import ThreadPoolExecutor
answers = []
for spec, triggered, pulses in json.loads(sys.argv[1]):
    camera = camera_from("left", spec, triggered=triggered)
    answer = {}
    try:
        camera.open()
        answer["told"], answer["kept"] = camera.tell_settings(), camera.keep_settings()
        answer["grey"] = []
        for wait in pulses:
            if triggered:
                line = os.open(os.environ["V4L2_STAND_IN"] + "/pulse", os.O_RDWR)
                threading.Timer(wait, lambda: os.write(line, b"x")).start()
            frame = camera.frame(timeout=wait + 5)
            answer["grey"].append(round(float(frame.picture.mean()) * 255))
            answer["shape"] = frame.picture.shape
    except ImplicamError as error:
        answer["error"] = str(error)
    camera.close()
    answers.append(answer)
print(json.dumps(answers))
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("cc")
    if compiler is None or not Path("/usr/include/linux/videodev2.h").exists():
        pytest.skip("there is no C compiler, or no header of V4L2")
    made = tmp_path_factory.mktemp("stand-in") / "stand_in.so"
    source = Path(__file__).with_name("v4l2_stand_in.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-o", made, source, "-ldl", "-lpthread"], check=True)
    return made


def ask(library: Path, folder: Path, *cameras: tuple[str, bool, list[float]]) -> list[dict[str, Any]]:
    """What each camera answers, in a process that has the device."""
    more = {"LD_PRELOAD": str(library), "V4L2_STAND_IN": str(folder)}
    words = [sys.executable, "-c", SCRIPT, json.dumps(cameras)]
    ran = subprocess.run(words, capture_output=True, text=True, env={**os.environ, **more}, timeout=300, check=False)
    assert ran.returncode == 0, ran.stderr
    assert ran.stderr == ""
    return list(json.loads(ran.stdout))


def test_a_device_is_set_read_back_and_told(library: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "picture.jpg"), np.full((800, 1280), 100, np.uint8))
    full, wrong, unset, other = ask(
        library, tmp_path,
        ("/dev/video90,1280x800,MJPG,fps=60,exposure=200,gain=40,focus=32", False, [0]),
        ("90,640x481,MJPG", False, [0]),
        ("/dev/video91", False, [0]),
        ("91,GREY,320x240,fps=30,exposure=300,focus=auto", False, [0, 0, 0]),
    )  # fmt: skip
    words = "1280x800,MJPG,fps=60,exposure=200,gain=16,focus=30"
    assert full["told"] == [
        f"camera left: {words}",
        "camera left: gain 40 was asked for, the camera has 16",
        "camera left: focus 32 was asked for, the camera has 30",
    ]
    assert full["kept"] == {"device": "/dev/video90", "settings": words}
    assert (full["shape"], full["grey"]) == ([800, 1280], [100])
    assert wrong["error"].startswith("camera left: 640x481 was asked for, and its pictures are 1280x800.")
    assert "as MJPG it offers 1280x800, 640x480" in wrong["error"]
    assert "exposure is automatic, and its pictures change with the light; add exposure=NUMBER" in unset["told"][1]
    assert "a calibration holds for one focus only" in unset["told"][2]
    assert other["told"][0] == "camera left: 320x240,GREY,fps=30,exposure=300,gain=0,focus=auto"
    assert len(other["told"]) == 1  # an automatic focus that was asked for is no warning
    steps = np.diff(other["grey"]) % 256 // 8
    assert (steps >= 1).all()  # each picture is a newer one
    log = [line.split() for line in (tmp_path / "log").read_text().splitlines()]
    names = [name for name, _ in log[: log.index(["focus", "32"])]]
    assert max(k for k, name in enumerate(names) if name == "width") < names.index("exposure")  # a size undoes exposure


@pytest.mark.slow
def test_a_device_waits_for_its_trigger_as_long_as_it_takes(library: Path, tmp_path: Path) -> None:
    """opencv/opencv#10927, #25846: after a time without a pulse a read comes back with nothing, or with the last
    picture again. It is 10 s there; here 1 s, and the pulse comes after two."""
    os.mkfifo(tmp_path / "pulse")
    (answer,) = ask(library, tmp_path, ("90,GREY", True, [0.1, 2.2, 0.1]))
    assert answer["grey"] == [8, 16, 24]  # the picture of each pulse, and none twice


def test_no_bandwidth_is_said_to_be_that(library: Path, tmp_path: Path) -> None:
    """opencv/opencv#23787, #9540: all cameras open, and "no space left on device" comes with the first picture."""
    (tmp_path / "full").touch()
    (answer,) = ask(library, tmp_path, ("90", False, [0]))
    assert "is open, and does not begin to send" in answer["error"]
    assert "too many cameras on one USB controller" in answer["error"]
    assert "MJPG" in answer["error"]


# ---- without a compiler --------------------------------------------------------------------------------------------


class Capture:
    """Stands in for cv2.VideoCapture of a USB camera. `reads`: what each read gives, (seconds, image, time stamp); then
    nothing, at once, as after unplugging. forgets: its exposure is automatic again when it begins to stream."""

    def __init__(self, reads: list[tuple[float, np.ndarray | None, float]], *, forgets: bool = False) -> None:
        self.values: dict[int, float] = {
            cv2.CAP_PROP_FRAME_WIDTH: 64, cv2.CAP_PROP_FRAME_HEIGHT: 48, cv2.CAP_PROP_FPS: 30,
            cv2.CAP_PROP_AUTO_EXPOSURE: 3, cv2.CAP_PROP_EXPOSURE: 157,
        }  # fmt: skip
        self.log: list[tuple[int, float]] = []
        self.stamp, self._reads, self._forgets = 0.0, list(reads), forgets
        self.image: np.ndarray | None = None
        self.decoded = 0

    def set(self, what: int, value: float) -> bool:
        self.log.append((what, value))
        if what not in self.values:
            return False
        if what != cv2.CAP_PROP_EXPOSURE or self.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 1:
            self.values[what] = value
        return True  # whatever it did

    def get(self, what: int) -> float:
        return self.stamp if what == cv2.CAP_PROP_POS_MSEC else self.values.get(what, -1.0)

    def grab(self) -> bool:
        if self._forgets:
            self.values[cv2.CAP_PROP_AUTO_EXPOSURE], self._forgets = 3, False
        if not self._reads:
            return False
        seconds, self.image, self.stamp = self._reads.pop(0)
        time.sleep(seconds)
        return self.image is not None

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        self.decoded += 1
        if self.image is not None and self.image.size == 0:
            raise cv2.error("a picture that cannot be decoded")
        return self.image is not None, self.image

    def release(self) -> None: ...


def grey(value: int) -> np.ndarray:
    return np.full((48, 64), value, np.uint8)


def camera_with(
    monkeypatch: pytest.MonkeyPatch, capture: Capture, spec: str, *, triggered: bool = False
) -> OpenCVCamera:
    camera = camera_from("left", spec, triggered=triggered)
    assert isinstance(camera, OpenCVCamera)
    monkeypatch.setattr(camera, "_open_capture", lambda: capture)
    monkeypatch.setattr(module, "WAIT_SECONDS", 0.05)
    return camera


def test_what_a_camera_forgets_as_it_begins_to_stream_is_set_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """opencv/opencv#9738: the time of exposure is heeded only after the mode has changed to manual."""
    capture = Capture([(0, grey(1), 1.0)], forgets=True)
    camera = camera_with(monkeypatch, capture, "0,exposure=200")
    camera.open()
    assert camera.keep_settings()["settings"] == "64x48,fps=30,exposure=200"
    camera.close()
    deaf = Capture([(0, grey(1), 1.0)])
    del deaf.values[cv2.CAP_PROP_EXPOSURE]
    camera = camera_with(monkeypatch, deaf, "0,exposure=200")
    camera.open()
    assert camera.tell_settings()[1] == "camera left: exposure 200 was asked for, the camera has no such setting"
    camera.close()


def test_a_size_that_the_driver_claims_and_does_not_send_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """opencv/opencv#29254: `set` returns True, `get` the size that was set, and the pictures have another."""
    camera = camera_with(monkeypatch, Capture([(0, grey(1), 1.0)]), "0,32x24")
    with pytest.raises(HardwareError, match="32x24 was asked for, and its pictures are 64x48"):
        camera.open()
    late = Capture([(0, None, 0.0), (0.06, grey(1), 1.0)])
    late.values |= {cv2.CAP_PROP_FRAME_WIDTH: 32, cv2.CAP_PROP_FRAME_HEIGHT: 24}
    late._reads[0] = (0.06, None, 0.0)  # a triggered camera: no picture as it is opened
    late._reads[1] = (0.2, grey(1), 1.0)
    camera = camera_with(monkeypatch, late, "0,32x24", triggered=True)
    with pytest.raises(HardwareError, match="32x24 was asked for, and its pictures are 64x48"):
        camera.frame()


@pytest.mark.parametrize("stamps", [True, False])
def test_a_picture_that_is_the_last_one_again_is_none(stamps: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """opencv/opencv#10927: where the time limit of a read is over, some versions return True and the last picture."""
    first, second = (1.0, 2.0) if stamps else (0.0, 0.0)
    reads = [(0.06, None, 0.0), (0.06, grey(1), first), (0.06, grey(1), first), (0.06, grey(1), first)]
    camera = camera_with(monkeypatch, Capture([*reads, (0.3, grey(2), second)]), "0", triggered=True)
    assert round(float(camera.frame().picture.mean()) * 255) == 1
    assert round(float(camera.frame().picture.mean()) * 255) == 2
    camera.close()


def test_a_picture_that_was_damaged_on_its_way_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """lerobot#4084 and many more: MJPG is what fits through USB, and OpenCV raises where a part of one is lost."""
    lost = np.zeros((0, 0), np.uint8)
    reads = [(0.0, grey(1), 1.0), (0.01, lost, 2.0), (0.1, grey(2), 3.0), (0.01, lost, 4.0), (0.1, grey(3), 5.0)]
    camera = camera_with(monkeypatch, Capture([*reads, (0.1, grey(4), 6.0), (0.1, grey(5), 7.0)]), "0")
    assert round(float(camera.frame().picture.mean()) * 255) >= 2
    camera.close()


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("0,gian=4", "did you mean 'gain'"),
        ("/dev/video0,exposure=fast", "has no number"),
        ("0,exposure=-7", "has no number"),
        ("0,gain=auto", "has no number"),
        ("0,fps=0", "has no number"),
        ("0,1280x800,640x480", "says size twice"),
        ("0,1280*800", "sets nothing"),
        ("0,", "sets nothing"),
    ],
)
def test_words_that_set_nothing_are_refused(spec: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        camera_from("left", spec)


def test_words_and_settings_are_each_others_inverse() -> None:
    words = "1280x800,MJPG,fps=59.94,exposure=auto,gain=4,focus=0"
    assert settings_words(parse_settings(words.split(","), words)) == words
    wanted = parse_settings(["focus=auto", "y16", "320X240"], "")
    assert wanted == {"size": "320x240", "format": "Y16", "focus": "auto"}
    assert differences({"fps": 60.0}, {"fps": 59.94}) == []
    capture = Capture([])
    apply_settings(capture, parse_settings(["focus=3", "exposure=200", "fps=60", "MJPG", "1280x800"], ""))
    order = [what for what, _ in capture.log]
    assert order.index(cv2.CAP_PROP_FOURCC) < order.index(cv2.CAP_PROP_FRAME_WIDTH) < order.index(cv2.CAP_PROP_FPS)
    assert order.index(cv2.CAP_PROP_FPS) < order.index(cv2.CAP_PROP_AUTO_EXPOSURE) < order.index(cv2.CAP_PROP_EXPOSURE)


def test_a_camera_is_known_by_a_name_that_lasts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """ccrisan/motionpie#120, obs-studio#3003: numbers of devices change with each start; links by serial number do not.
    wpilibsuite/WPILibPi#118: two of a kind without serial numbers are told apart by their socket."""
    devices = [tmp_path / "video0", tmp_path / "video1"]
    by_id, by_path = tmp_path / "by-id", tmp_path / "by-path"
    for folder in (by_id, by_path):
        folder.mkdir()
    for device in devices:
        device.touch()
    (by_id / "usb-Maker_A1").symlink_to(devices[1])
    (by_path / "usb-0:2").symlink_to(devices[0])
    (by_path / "usb-0:3").symlink_to(devices[1])
    monkeypatch.setattr(device_settings, "LINKS", (by_id, by_path))
    assert [lasting_name(str(device)) for device in devices] == [str(by_path / "usb-0:2"), str(by_id / "usb-Maker_A1")]
    before = {"left": {"device": lasting_name(str(devices[1])), "settings": "64x48,MJPG,exposure=200"}}
    (by_id / "usb-Maker_A1").unlink()
    (by_id / "usb-Maker_A1").symlink_to(devices[0])  # after the next start
    now = {"left": {"device": lasting_name(str(devices[1])), "settings": "64x48,MJPG,exposure=156"}}
    told = compare_settings(before, now)
    assert told == [
        f"camera left is another device than before: it was {by_id / 'usb-Maker_A1'}, and is {by_path / 'usb-0:3'}",
        "camera left: exposure was 200, and is 156",
    ]
    for nonsense in ([], {"left": 3}, {"left": {"settings": 3}}, {"left": {"settings": "a thousand words"}}):
        assert compare_settings(nonsense, now) == []  # of a file
    monkeypatch.setattr(device_settings, "device_path", lambda source: Path(source))
    cameras = [OpenCVCamera(name, source) for name, source in (("a", "/dev/x"), ("b", "/dev/y"))]
    refuse_one_device_twice(cameras)
    cameras[0].source, cameras[1].source = str(devices[0]), str(by_id / "usb-Maker_A1")
    with pytest.raises(UsageError, match="the cameras a and b are one and the same device"):
        refuse_one_device_twice(cameras)


def test_only_what_is_asked_for_is_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = Capture([(0.002, grey(k % 200), float(k)) for k in range(1, 400)])
    camera = camera_with(monkeypatch, capture, "0")
    shown = []
    for _ in range(3):
        shown.append(round(float(camera.frame().picture.mean()) * 255))
        time.sleep(0.05)
    camera.close()
    assert np.all(np.diff(shown) > 5)  # all were taken out of the buffer
    assert capture.decoded == 4  # with the first, which tells the size


def test_no_thread_outlives_a_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = camera_with(monkeypatch, Capture([(0.01, grey(1), float(k)) for k in range(1, 200)]), "0")
    camera.frame()
    camera.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "camera left"]
