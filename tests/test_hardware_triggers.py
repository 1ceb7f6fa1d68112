"""Triggers with several boxes, and that the pictures of a shot are of its own pulse.

The cameras here are stand-ins with a driver's buffer: a pulse puts a picture of its number into it, after a while.
"""

import shutil
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Empty, Queue

import numpy as np
import pytest

from drivers import nothing_left, says_all  # noqa: F401
from implicam.errors import HardwareError, UsageError
from implicam.hardware import TriggerBoxes, TriggerSimulator, take_frames, triggers_from
from implicam.hardware.protocol import Frame
from implicam.hardware.trigger import GREETING_PREFIX, NetworkTrigger
from implicam.session.controller import Equipment, SessionController
from implicam.session.setup import Setup, open_session

CAMERAS = [f"cam{k}" for k in range(1, 7)]


class Eye:
    """A triggered camera: the picture of pulse n is of grey n / 100, and is there `late` seconds after it. free: it
    does not heed the trigger, and sends pictures all the time."""

    live = False

    def __init__(self, name: str, *, late: float = 0.0, free: bool = False) -> None:
        self.name, self.late, self._free = name, late, free
        self._buffer: Queue[int] | None = None
        self.opened = 0

    def open(self) -> None:
        if self._buffer is None:
            self._buffer, self.opened = Queue(), self.opened + 1

    def close(self) -> None:
        self._buffer = None  # what was on its way is lost

    def pulse(self, number: int) -> None:
        buffer = self._buffer
        if buffer is not None:
            timer = threading.Timer(self.late, buffer.put, (number,))
            timer.start()

    def frame(self, timeout: float = 5.0) -> Frame:
        self.open()
        assert self._buffer is not None
        if self._free:
            return Frame(np.zeros((4, 4), np.float32), 0, time.time())
        while not self._buffer.empty():
            self._buffer.get()
        try:
            number = self._buffer.get(timeout=timeout)
        except Empty:
            raise HardwareError(f"camera {self.name}: no picture within {timeout:g} s.", why="it waits") from None
        return Frame(np.full((4, 4), number / 100, np.float32), number, time.time())


class Line:
    """A trigger whose pulses the eyes see. silent: it does not answer."""

    def __init__(self, eyes: list[Eye]) -> None:
        self.eyes, self.fired, self.silent = eyes, 0, False
        self.when: list[float] = []

    def open(self) -> None: ...
    def close(self) -> None: ...

    def fire(self) -> None:
        if self.silent:
            raise HardwareError("the trigger box does not answer.", why="no power")
        self.fired += 1
        self.when.append(time.monotonic())
        for eye in self.eyes:
            eye.pulse(self.fired)


# ---- several boxes -------------------------------------------------------------------------------------------------


def test_two_boxes_are_fired_together() -> None:
    with TriggerSimulator("udp") as a, TriggerSimulator("tcp") as b:
        trigger = triggers_from([f"{a.address}=cam1,cam2,cam3", f"{b.address}=cam4, cam5,cam6"], CAMERAS)
        assert isinstance(trigger, TriggerBoxes)
        trigger.open()
        apart = []
        for _ in range(10):
            trigger.fire()
            apart.append(abs(a._last[1] - b._last[1]))  # one clock here, microseconds
        trigger.close()
        assert len(a.fired) == len(b.fired) == 10
        assert np.median(apart) < 20_000  # on a busy machine


def test_a_box_without_an_answer_is_named_with_its_cameras() -> None:
    with TriggerSimulator("udp") as a, TriggerSimulator("udp") as b:
        boxes = [(NetworkTrigger(box.address, timeout=0.2), names) for box, names in ((a, ["cam1"]), (b, ["cam2"]))]
        trigger = TriggerBoxes(boxes)
        trigger.fire()
        b.drop_questions = 100
        with pytest.raises(HardwareError, match=f"{b.address} does not answer") as caught:
            trigger.fire()
        says_all(caught.value)
        assert "the cameras on it are cam2" in str(caught.value)
        with pytest.raises(HardwareError, match="does not answer"):
            trigger.open()  # and is not connected to the other
        assert boxes[0][0]._socket is None
        b.drop_questions = 0
        trigger.fire()
        trigger.close()


@pytest.mark.parametrize(
    ("specs", "words"),
    [
        (
            ["udp://a:1=cam1,cam2,cam3", "udp://b:1=cam3,cam4,cam5,cam6"],
            "cam3 hangs on two trigger boxes, udp://a:1 and",
        ),
        (["udp://a:1=cam1,cam2,cam3", "udp://b:1=cam5,cam6"], "on no trigger box hangs cam4"),
        (["udp://a:1=cam1"], "on no trigger box hangs cam2"),
        (["udp://a:1=cam1,cam2,cam3", "udp://b:1=cam4,cam5,cam66"], "'cam66', and there is no such camera"),
        (["udp://a:1", "udp://b:1=cam1"], "does not say which cameras hang on it"),
        (["udp://a:1=cam1,cam2,cam3", "udp://a:1=cam4,cam5,cam6"], "is there twice"),
        (["udp://a:1=", "udp://b:1=cam1"], "names no camera"),
        (["upd://a:1=cam1,cam2,cam3,cam4,cam5,cam6"], "did you mean 'udp'"),
        (["udp://a=cam1,cam2,cam3", "udp://b:1=cam4,cam5,cam6"], "no address of a trigger box"),
    ],
)
def test_wires_that_cannot_be_are_refused(specs: list[str], words: str) -> None:
    with pytest.raises(UsageError, match=words) as caught:
        triggers_from(specs, CAMERAS)
    assert caught.value.fix


def test_one_box_is_for_all_cameras() -> None:
    assert triggers_from([], CAMERAS) is None
    assert isinstance(triggers_from(["udp://a:1"], CAMERAS), NetworkTrigger)
    assert isinstance(triggers_from(["udp://a:1=" + ",".join(CAMERAS)], CAMERAS), NetworkTrigger)
    with pytest.raises(UsageError, match="two cameras 'left'"):
        Setup(cameras=(("left", "0"), ("left", "1")))


# ---- of its own pulse ----------------------------------------------------------------------------------------------


def numbers(frames: list[Frame]) -> list[int]:
    return [frame.number for frame in frames]


def test_a_late_picture_of_a_round_that_failed_is_not_taken_for_the_next() -> None:
    """genicam/harvesters#383, realsenseai/librealsense#9528: the picture of an earlier pulse comes out of a buffer."""
    quick, slow = Eye("quick"), Eye("slow", late=0.6)
    line = Line([quick, slow])
    with ThreadPoolExecutor(2) as pool:
        with pytest.raises(HardwareError, match="slow: no picture"):
            take_frames([quick, slow], line, 0.3, pool)
        slow.late = 0.5  # the picture of the first pulse would arrive before that of the second
        assert numbers(take_frames([quick, slow], line, 2.0, pool)) == [2, 2]
        assert (quick.opened, slow.opened) == (2, 2)


def test_a_camera_that_does_not_heed_its_trigger_is_named() -> None:
    """genicam/harvesters#77: the camera was triggered once, and then runs freely; its pictures are of no pulse."""
    eyes = [Eye("left"), Eye("right", free=True)]
    line = Line(eyes)
    with ThreadPoolExecutor(2) as pool, pytest.raises(HardwareError, match="right gave a picture before") as caught:
        take_frames(eyes, line, 0.2, pool)
    says_all(caught.value)
    assert line.fired == 0


def test_after_a_silent_box_no_camera_is_asked_twice_at_once() -> None:
    eyes = [Eye("left"), Eye("right")]
    line = Line(eyes)
    line.silent = True
    with ThreadPoolExecutor(2) as pool:
        with pytest.raises(HardwareError, match="box does not answer"):
            take_frames(eyes, line, 0.2, pool)
        line.silent = False
        assert numbers(take_frames(eyes, line, 1.0, pool)) == [1, 1]


# ---- live pictures -------------------------------------------------------------------------------------------------


def test_live_pictures_are_pulsed_now_and_then_and_never_in_a_shot(tmp_path: Path) -> None:
    with open_session(tmp_path / "s", Setup(rig="stereo", budget=12, speed=1e6)) as made:
        eyes = [Eye(camera.name, late=0.05) for camera in made.equipment.cameras]
        line = Line(eyes)
        equipment = Equipment(eyes, made.equipment.robot, made.equipment.detector, line, timeout=2.0, pulse_every=0.4)
        controller = SessionController(made.session, equipment, made.loop)
        controller.start()
        begun, ending = time.monotonic(), threading.Event()

        def look() -> None:
            while not ending.wait(0.005):
                controller.live()

        watcher = threading.Thread(target=look)
        watcher.start()
        shots = []
        while len(shots) < 6:
            with controller._camera_lock:
                before = line.fired
            controller.redo()
            taken = {look.frame.number for look in controller.state.looks if look.frame is not None}
            shots.append((before, taken, line.fired))
            controller.skip()
            time.sleep(0.15)
        ending.set()
        watcher.join()
        seconds = time.monotonic() - begun
        for _, taken, after in shots:
            assert len(taken) == 1  # all cameras of one pulse
            assert taken == {after}  # the last one fired: the shot's own, and none since
        live = line.fired - len(shots)
        assert 1 <= live <= seconds / 0.4 + 1
        quiet = SessionController(
            made.session, Equipment(eyes, made.equipment.robot, equipment.detector, line), made.loop
        )
        quiet.start()
        fired = line.fired
        quiet.live()
        assert line.fired == fired


# ---- the box itself ------------------------------------------------------------------------------------------------

ARDUINO = Path("/usr/share/arduino/hardware/arduino/avr")
AVR = ("-mmcu=atmega328p", "-DF_CPU=16000000L", "-DARDUINO=10819", "-DARDUINO_ARCH_AVR", "-Os", "-ffunction-sections")


@pytest.mark.slow
def test_the_sketch_of_the_docs_does_what_the_protocol_says(tmp_path: Path) -> None:
    """Compiled with the real Arduino core, and run by a simulated ATmega328P, with a serial line in place of the
    shield."""
    if shutil.which("avr-g++") is None or not ARDUINO.is_dir() or not Path("/usr/include/simavr").is_dir():
        pytest.skip("apt-get install gcc-avr avr-libc arduino-core-avr libsimavr-dev libelf-dev")
    here = Path(__file__).parent
    text = (here.parent / "docs" / "hardware.md").read_text(encoding="utf-8")
    sketch = text.partition("```cpp\n")[2].partition("```")[0]
    (tmp_path / "sketch.cpp").write_text("#include <Arduino.h>\n" + sketch)  # as the Arduino IDE does
    core, box = ARDUINO / "cores" / "arduino", here / "trigger_box"
    include = [f"-I{place}" for place in (core, ARDUINO / "variants" / "standard", box)]
    own = ["-std=gnu++11", "-fpermissive", "-fno-exceptions", "-fno-threadsafe-statics"]

    def build(*words: str | Path) -> None:
        subprocess.run(list(map(str, words)), check=True, cwd=tmp_path, capture_output=True)

    build("avr-g++", *AVR, *own, "-Wall", "-Wextra", "-Werror", *include, "-c", "sketch.cpp", "-o", "sketch.o")
    build("avr-g++", *AVR, *own, *include, "-c", box / "ethernet_over_serial.cpp", "-o", "ethernet.o")
    needed = ["wiring.c", "wiring_digital.c", "hooks.c", "main.cpp", "Print.cpp", "HardwareSerial.cpp"]
    needed += ["HardwareSerial0.cpp", "IPAddress.cpp", "Stream.cpp", "new.cpp", "abi.cpp"]
    for name in needed:
        compiler = ["avr-g++", *own] if name.endswith("pp") else ["avr-gcc"]
        build(*compiler, *AVR, "-w", *include, "-c", core / name, "-o", f"{name}.o")
    objects = [f"{name}.o" for name in needed]
    build("avr-gcc", AVR[0], "-Wl,--gc-sections", "-o", "box.elf", "sketch.o", "ethernet.o", *objects, "-lm")
    build("cc", "-w", box / "simulated_board.c", "-o", "board", "-lsimavr", "-lelf", "-lm")
    asked = ["HELLO", "TRIG 7", "TRIG 7", "TRIG 8", "TRIG 2147483647", "TRIG -1", "TRIG x", "BANG"]
    ran = subprocess.run(
        [tmp_path / "board", "box.elf"], input="".join(f"{line}\n" for line in asked), cwd=tmp_path, text=True,
        capture_output=True, check=True, timeout=100,
    )  # fmt: skip
    answers = [line.split("|") for line in ran.stdout.splitlines() if "|" in line]
    once, never = "1 1 1 1 1 1", "0 0 0 0 0 0"
    assert [pins for _, pins, _, _ in answers] == [never, once, never, once, once, never, never, never]
    texts = [text for text, _, _, _ in answers]
    assert texts[0] == f"{GREETING_PREFIX}6"
    assert [text.rpartition(" ")[0] for text in texts[1:5]] == ["OK 7", "OK 7", "OK 8", "OK 2147483647"]
    assert texts[1] == texts[2]  # the clock of the pulse, not of the answer
    assert all(text.startswith("ERR ") for text in texts[5:])
    for k in (1, 3, 4):
        assert 1000 <= float(answers[k][2]) < 1100  # microseconds
        assert float(answers[k][3]) < 40  # from the first pin to the last
