"""Whatever OpenCV can open: a USB camera, a network stream, a film file.

A live camera is read in a thread, all the time, so that no old picture waits in a buffer.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from implicam.errors import HardwareError, ImplicamError
from implicam.films import FILM_ENDINGS
from implicam.hardware.protocol import Frame, Grey
from implicam.images import check_size, opencv

STREAM_PREFIXES = ("rtsp://", "rtsps://", "http://", "https://", "udp://")
STALE_DEVICE_PICTURES, STALE_STREAM_PICTURES = 1, 2
"""Pictures after the call that may have been exposed before it: the one on its way, and the one in a stream's decoder,
which knows that a picture is whole when the next begins."""

SILENCE_MS = 5000
"""A stream that sends nothing for so long is gone."""


class OpenCVCamera:
    """The `FrameSource` of a V4L2 camera (2 or "/dev/video2"), a stream (rtsp://, http://) or a film file.

    triggered: the camera exposes only when its trigger fires, so that the first picture after the call is the one. A
    free-running camera's first ones may have been exposed before the call: a later one is given. A film gives its
    pictures in order; at its end, HardwareError until it is closed and opened again.
    """

    spec: ClassVar[str] = "0, /dev/video0, rtsp://..., http://..., film.avi"

    @classmethod
    def takes(cls, spec: str) -> bool:
        """Whether a spec without the driver's name is a device, the address of a stream, or a file named like a film.

        Args:
            spec: The words of the command line.
        """
        film = Path(spec).suffix.lower() in FILM_ENDINGS and Path(spec).is_file()
        return spec.isdecimal() or _is_device(spec) or spec.startswith(STREAM_PREFIXES) or film

    @classmethod
    def from_spec(cls, name: str, rest: str, *, triggered: bool = False) -> Self:
        """A camera of a device, stream or film, not opened yet.

        Args:
            name: The camera's name in the dataset.
            rest: The number or file of a device, the address of a stream, or a film.
            triggered: The camera exposes only when a trigger fires.
        """
        return cls(name, rest, triggered=triggered)

    def __init__(self, name: str, source: int | str | Path, *, triggered: bool = False) -> None:
        self.name = name
        text = str(source)
        self.source: int | str = int(text) if text.isdecimal() else text
        self._source_text = re.sub("//[^/]*@", "//...@", text)  # no password in a message
        self._device = isinstance(self.source, int) or _is_device(text)
        self._film = not self._device and not text.startswith(STREAM_PREFIXES)
        self.live = not (triggered or self._film)
        self._skip = 0 if triggered else STALE_DEVICE_PICTURES if self._device else STALE_STREAM_PICTURES
        self._number = 0
        self._capture: Any = None  # of a film
        self._grabber: _Grabber | None = None  # of a live camera

    def open(self) -> None:
        """Open the device, stream or file; HardwareError where OpenCV cannot, ImageError where it is too large."""
        if self._capture is not None or (self._grabber is not None and self._grabber.running):
            return
        self.close()
        if self._film:
            self._capture = self._open_capture()
        else:
            self._grabber = _Grabber(self._open_capture(), f"camera {self.name}")

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
        self._number += 1
        return Frame(_to_grey(image), self._number, taken)

    def close(self) -> None:
        """End the thread and release the camera."""
        if self._capture is not None:
            self._capture.release()
        if self._grabber is not None:
            self._grabber.end()
        self._capture = self._grabber = None

    def _open_capture(self) -> Any:
        cv2 = opencv()
        with _silence_opencv(cv2):
            if self._device:
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
        elif self._device:
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
                f"camera {self.name}: the film {self.source} is over.",
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
    """Reads a capture until it is told to end or nothing comes any more; keeps the newest picture."""

    def __init__(self, capture: Any, name: str) -> None:
        self.running = True
        self._newest: tuple[NDArray[np.uint8], float] | None = None
        self._arrived = 0
        self._arrival = threading.Condition()
        self._thread = threading.Thread(target=self._grab, args=(capture,), name=name, daemon=True)
        self._thread.start()

    def after(self, skip: int, timeout: float) -> tuple[NDArray[np.uint8], float] | None:
        """The newest picture once more than `skip` have arrived since the call, and when; None where they do not."""
        with self._arrival:
            wanted = self._arrived + 1 + skip
            self._arrival.wait_for(lambda: self._arrived >= wanted or not self.running, timeout)
            return self._newest if self._arrived >= wanted else None

    def end(self) -> None:
        """Stop reading; a read that hangs ends by its own time limit."""
        self.running = False
        self._thread.join(SILENCE_MS / 1000 + 1)

    def _grab(self, capture: Any) -> None:
        try:
            while self.running:
                good, image = capture.read()
                if not good:
                    return
                with self._arrival:
                    self._newest, self._arrived = (image, time.time()), self._arrived + 1
                    self._arrival.notify_all()
        finally:
            capture.release()
            with self._arrival:
                self.running = False
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


def _is_device(text: str) -> bool:
    return text.startswith("/dev/") and not text.startswith("/dev/shm/")


def _to_grey(image: NDArray[np.uint8]) -> Grey:
    cv2 = opencv()
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 and image.shape[2] == 3 else image
    return np.asarray(grey, np.float32).reshape(image.shape[:2]) * np.float32(1 / 255)
