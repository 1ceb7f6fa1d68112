"""Whatever OpenCV can open: a USB camera, a network stream, a film file.

A live camera is read in a thread, all the time, so that no old picture waits in a buffer. What a USB camera is set to:
device_settings.py.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from implicam.addresses import without_secrets
from implicam.errors import HardwareError, ImplicamError
from implicam.films import FILM_ENDINGS
from implicam.hardware.device_settings import (
    AUTO,
    AUTOMATIC,
    apply_settings,
    device_path,
    differences,
    lasting_name,
    offered_sizes,
    parse_settings,
    read_settings,
    settings_words,
)
from implicam.hardware.protocol import Frame, Grey
from implicam.images import check_size, opencv

STREAM_PREFIXES = ("rtsp://", "rtsps://", "http://", "https://", "udp://")
STALE_DEVICE_PICTURES, STALE_STREAM_PICTURES = 1, 2
"""Pictures after the call that may have been exposed before it: the one on its way, and the one in a stream's decoder,
which knows that a picture is whole when the next begins."""

SILENCE_MS = 5000
"""A stream that sends nothing for so long is gone."""

WAIT_VARIABLE, WAIT_SECONDS = "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", 1
"""For so long OpenCV waits for a picture of a device, and it is asked again: where there is a trigger, it may be hours
until it fires. OpenCV takes the value from the environment, once."""


class OpenCVCamera:
    """The `FrameSource` of a V4L2 camera (2 or "/dev/video2"), a stream (rtsp://, http://) or a film file.

    triggered: the camera exposes only when its trigger fires, so that the first picture after the call is the one. A
    free-running camera's first ones may have been exposed before the call: a later one is given. A film gives its
    pictures in order; at its end, HardwareError until it is closed and opened again. wanted: what a V4L2 camera is to
    be set to, as `device_settings.parse_settings` gives it.
    """

    spec: ClassVar[str] = "0, /dev/video0,1280x800,MJPG, rtsp://..., http://..., film.avi"

    @classmethod
    def takes(cls, spec: str) -> bool:
        """Whether a spec without the driver's name is a device, the address of a stream, or a file named like a film.

        Args:
            spec: The words of the command line.
        """
        film = Path(spec).suffix.lower() in FILM_ENDINGS and Path(spec).is_file()
        return spec.split(",")[0].isdecimal() or _is_device(spec) or spec.startswith(STREAM_PREFIXES) or film

    @classmethod
    def from_spec(cls, name: str, rest: str, *, triggered: bool = False) -> Self:
        """A camera of a device, stream or film, not opened yet.

        Args:
            name: The camera's name in the dataset.
            rest: The number or file of a device, and what it is to be set to, with commas between; the address of a
                stream; or a film.
            triggered: The camera exposes only when a trigger fires.

        Raises:
            UsageError: What a device is to be set to cannot be read.
        """
        source, *words = rest.split(",") if rest.split(",")[0].isdecimal() or _is_device(rest) else [rest]
        return cls(name, source, triggered=triggered, wanted=parse_settings(words, rest))

    def __init__(
        self,
        name: str,
        source: int | str | Path,
        *,
        triggered: bool = False,
        wanted: Mapping[str, str | float] | None = None,
    ) -> None:
        self.name = name
        text = str(source)
        self.source: int | str = int(text) if text.isdecimal() else text
        self._source_text = without_secrets(text)  # no password in a message
        self.device = isinstance(self.source, int) or _is_device(text)
        self._film = not self.device and not text.startswith(STREAM_PREFIXES)
        self.live = not (triggered or self._film)
        self._triggered, self._wanted = triggered, dict(wanted or {})
        self._given: dict[str, str | float] = {}  # as read back when the device was opened last
        self._skip = 0 if triggered else STALE_DEVICE_PICTURES if self.device else STALE_STREAM_PICTURES
        self._number = 0
        self._capture: Any = None  # of a film
        self._grabber: _Grabber | None = None  # of a live camera

    def open(self) -> None:
        """Open the device, stream or file; HardwareError where OpenCV cannot, or a device has another size than it was
        asked for; ImageError where its pictures are too large.

        A device streams when this returns, so that a trigger may fire.
        """
        if self._capture is not None or (self._grabber is not None and self._grabber.running):
            return
        self.close()
        if self._film:
            self._capture = self._open_capture()
            return
        capture = self._open_capture()
        if self.device:  # else OpenCV warns of each second in which no trigger fires
            opencv().utils.logging.setLogLevel(opencv().utils.logging.LOG_LEVEL_ERROR)
        try:
            if self.device:
                self._ready(capture)
        except BaseException:
            capture.release()
            raise
        self._grabber = _Grabber(capture, f"camera {self.name}", patient=self.device)

    def frame(self, timeout: float = 5.0) -> Frame:
        """The next picture of a film, or one that a live camera took after the call.

        Args:
            timeout: Seconds that a live camera has; a film does not wait.

        Returns:
            The picture with the time at which it was read.

        Raises:
            HardwareError: None came in time, the camera is gone or cannot be opened, or the film is over.
        """
        self.open()
        image, taken = self._read_film() if self._film else self._read_live(timeout)
        self._check_size(image)
        self._number += 1
        return Frame(_to_grey(image), self._number, taken)

    def close(self) -> None:
        """End the thread and release the camera."""
        if self._capture is not None:
            self._capture.release()
        if self._grabber is not None:
            self._grabber.end()
        self._capture = self._grabber = None

    def tell_settings(self) -> list[str]:
        """What the driver said when the device was opened last, in sentences; empty for a stream or a film."""
        if not self._given:
            return []
        who, lasting = f"camera {self.name}", lasting_name(self.source)
        told = [f"{who}: {settings_words(self._given)}"]
        told += [f"{who}: {text}" for text in differences(self._wanted, self._given)]
        why = {"exposure": "its pictures change with the light", "focus": "a calibration holds for one focus only"}
        for key in AUTOMATIC:
            if self._given.get(key) == AUTO and self._wanted.get(key) != AUTO:
                told.append(f"{who}: its {key} is automatic, and {why[key]}; add {key}=NUMBER")
        if lasting and lasting != str(self.source):
            told.append(f"{who}: after the next start {self._source_text} may be another camera; this is {lasting}")
        return told

    def keep_settings(self) -> dict[str, str]:
        """The device's lasting name and its settings, in words, for a later session; empty for a stream or a film."""
        if not self._given:
            return {}
        device = lasting_name(self.source) or str(device_path(self.source))
        return {"device": device, "settings": settings_words(self._given)}

    def _ready(self, capture: Any) -> None:
        """Set the device, let it stream, and see what it has become: some forget then what they were told."""
        apply_settings(capture, self._wanted)
        first = _read(capture)
        if first.image is None and not first.broken and first.waited < WAIT_SECONDS / 2:
            raise HardwareError(
                f"camera {self.name}: {self._source_text} is open, and does not begin to send.",
                why="mostly there are too many cameras on one USB controller (no space left on device)",
                fix="add MJPG, a smaller size or fewer pictures a second (fps=...), or plug it into another controller",
            )
        controls = {key: value for key, value in self._wanted.items() if key not in ("size", "format", "fps")}
        if differences(controls, read_settings(capture)):
            apply_settings(capture, controls)
        self._given = read_settings(capture)
        if first.image is not None:  # what a driver says of the size and what it sends may differ
            self._given["size"] = _size_of(first.image)
        if "size" in self._wanted and self._given["size"] != self._wanted["size"]:
            raise self._size_error(str(self._given["size"]))

    def _check_size(self, image: NDArray[np.uint8]) -> None:
        if "size" in self._wanted and _size_of(image) != self._wanted["size"]:
            self.close()
            raise self._size_error(_size_of(image))

    def _size_error(self, given: str) -> HardwareError:
        pixel_format = str(self._wanted.get("format", self._given.get("format", "")))
        sizes = offered_sizes(self.source, pixel_format)
        return HardwareError(
            f"camera {self.name}: {self._wanted['size']} was asked for, and its pictures are {given}.",
            why=f"as {pixel_format} it offers {', '.join(sizes)}" if sizes else "the camera does not offer that size",
            fix="ask for a size that it offers, or another format, MJPG say: `v4l2-ctl --list-formats-ext` lists them",
        )

    def _open_capture(self) -> Any:
        cv2 = opencv()
        with _silence_opencv(cv2):
            if self.device:
                os.environ.setdefault(WAIT_VARIABLE, str(WAIT_SECONDS))
                capture = cv2.VideoCapture(self.source, cv2.CAP_V4L2)
                capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
            else:
                limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, SILENCE_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, SILENCE_MS]
                limits += [cv2.CAP_PROP_N_THREADS, 1]  # each further thread of the decoder holds back a picture
                capture = cv2.VideoCapture(self.source, cv2.CAP_FFMPEG, [] if self._film else limits)
                if not capture.isOpened() and self._film:
                    capture = cv2.VideoCapture(self.source, cv2.CAP_ANY)
        try:
            if not capture.isOpened():
                raise self._cannot_open_error()
            size = [int(capture.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
            check_size(size[0], size[1], f"camera {self.name}: {self._source_text}")
        except ImplicamError:
            capture.release()
            raise
        return capture

    def _cannot_open_error(self) -> HardwareError:
        if self._film:
            missing = not Path(str(self.source)).is_file()
            why = "there is no such file" if missing else "it is no film that OpenCV can decode"
            fix = "check the name" if missing else "convert it, for example to MJPG in .avi"
        elif self.device:
            why = "it is not plugged in, another program has it, or you may not read it"
            fix = "list them with `ls /dev/video*`, close other programs, and join the group video"
        else:
            why = f"nothing answers there within {SILENCE_MS / 1000:g} s, or what comes is no film"
            fix = "open the address in a film player, check user name and password in it, and the network"
        return HardwareError(f"camera {self.name}: {self._source_text} cannot be opened.", why=why, fix=fix)

    def _read_film(self) -> tuple[NDArray[np.uint8], float]:
        good, image = self._capture.read()
        if not good:
            raise HardwareError(
                f"camera {self.name}: the film {self._source_text} is over.",
                why=f"it gave {self._number} pictures",
                fix="end the session, or close and open it to begin again",
            )
        return image, time.time()

    def _read_live(self, timeout: float) -> tuple[NDArray[np.uint8], float]:
        assert self._grabber is not None
        found = self._grabber.after(self._skip, timeout)
        if found is not None:
            return found
        if self._grabber.running:
            raise HardwareError(
                f"camera {self.name}: no picture within {timeout:g} s.",
                why="it is open, and sends nothing" if self._skip else "it waits for its trigger",
                fix="wait longer, or look at its cable, its light and its trigger",
            )
        self.close()
        raise HardwareError(
            f"camera {self.name} is gone: {self._source_text} sends no more pictures.",
            why="it was unplugged, switched off, or the network failed",
            fix="plug it in again; the next picture opens it by itself",
        )


class _Grabber:
    """Takes every picture out of a capture until it is told to end or nothing comes any more; decodes those that are
    asked for: a camera may send sixty a second, and to decode one costs some milliseconds.

    patient: a wait that was long and brought nothing is no sign of anything, because a trigger may not have fired.
    """

    def __init__(self, capture: Any, name: str, *, patient: bool = False) -> None:
        self.running, self._patient = True, patient
        self._stamp, self._last = 0.0, np.zeros((0, 0), np.uint8)  # of the last picture; the last that was decoded
        self._arrived = 0
        self._wanted: int | None = None  # the first arrival that is to be decoded; None for none
        self._found: tuple[NDArray[np.uint8], float] | None = None
        self._arrival = threading.Condition()
        self._thread = threading.Thread(target=self._grab, args=(capture,), name=name, daemon=True)
        self._thread.start()

    def after(self, skip: int, timeout: float) -> tuple[NDArray[np.uint8], float] | None:
        """The first picture after `skip` that arrive after the call, and when it did; None where it does not."""
        with self._arrival:
            self._wanted, self._found = self._arrived + 1 + skip, None
            self._arrival.wait_for(lambda: self._found is not None or not self.running, timeout)
            found, self._wanted, self._found = self._found, None, None
            return found

    def end(self) -> None:
        """Stop reading; a read that hangs ends by its own time limit."""
        self.running = False
        self._thread.join(SILENCE_MS / 1000 + 1)

    def _in_vain(self, capture: Any, good: bool, waited: float) -> bool:
        """Whether a wait ended by its time limit: then there is no picture, or, by some versions of OpenCV, the last
        one again."""
        before, self._stamp = self._stamp, float(capture.get(opencv().CAP_PROP_POS_MSEC))
        if waited < 0.9 * WAIT_SECONDS:
            return False
        if not good:
            return True
        if self._stamp > 0:
            return self._stamp == before
        image = _decode(capture)
        return image is None or np.array_equal(image, self._last)

    def _grab(self, capture: Any) -> None:
        try:
            while self.running:
                begun = time.monotonic()
                good, taken = capture.grab(), time.time()
                if self._patient and self._in_vain(capture, good, time.monotonic() - begun):
                    continue
                if not good:
                    return
                self._hand_out(capture, taken)
        finally:
            capture.release()
            with self._arrival:
                self.running = False
                self._arrival.notify_all()

    def _hand_out(self, capture: Any, taken: float) -> None:
        """Count what was grabbed, and decode it where somebody waits for it; one that cannot be is as if lost."""
        with self._arrival:
            self._arrived += 1
            wanted = self._wanted
        if wanted is None or self._arrived < wanted:
            return
        image = _decode(capture)
        if image is None:
            return
        self._last = image
        with self._arrival:
            if self._wanted == wanted:  # else it was for a call that is over
                self._found, self._wanted = (image, taken), None
                self._arrival.notify_all()


@contextmanager
def _silence_opencv(cv2: Any) -> Iterator[None]:
    """Keep OpenCV from printing its own messages: our error says more."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


class _Read(NamedTuple):
    """What a read brought: a picture or None; whether one was lost on its way and cannot be decoded; and how long it
    took to come, seconds."""

    image: NDArray[np.uint8] | None
    broken: bool
    waited: float


def _read(capture: Any) -> _Read:
    begun = time.monotonic()
    good = capture.grab()
    waited = time.monotonic() - begun
    image = _decode(capture) if good else None
    return _Read(image, good and image is None, waited)


def _decode(capture: Any) -> NDArray[np.uint8] | None:
    """The picture that was grabbed; None where it cannot be decoded."""
    try:
        good, image = capture.retrieve()
    except opencv().error:
        return None
    return image if good else None


def _size_of(image: NDArray[np.uint8]) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _is_device(text: str) -> bool:
    return text.startswith("/dev/") and not text.startswith("/dev/shm/")


def _to_grey(image: NDArray[np.uint8]) -> Grey:
    cv2 = opencv()
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 and image.shape[2] == 3 else image
    return np.asarray(grey, np.float32).reshape(image.shape[:2]) * np.float32(1 / 255)
