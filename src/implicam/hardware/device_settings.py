"""What a V4L2 camera is set to: the words that ask for it, setting it, and what the driver made of it.

    --camera left=/dev/video0,1280x800,MJPG,fps=60,exposure=200,gain=4,focus=30

OpenCV returns True for what a driver did not do, drivers round, and a change of format undoes earlier settings. So
everything is set in the one order that works (format, size, rate, then the controls), read back, and set once more
where it does not hold.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from implicam.errors import UsageError, did_you_mean
from implicam.images import opencv

Wanted = Mapping[str, str | float]
"""size "1280x800", format "MJPG", fps, exposure, gain, focus; exposure and focus may be "auto". What is not there is as
the camera has it."""

NUMBERS = ("fps", "exposure", "gain", "focus")
AUTOMATIC = ("exposure", "focus")
AUTO = "auto"

MANUAL_EXPOSURE, AUTO_EXPOSURE = 1, 3
"""Of V4L2_CID_EXPOSURE_AUTO: manual, and "aperture priority", the automatic one that USB cameras have."""

MAX_FPS_ERROR = 0.01
"""60 and 59.94 pictures a second are the same."""

LINKS = (Path("/dev/v4l/by-id"), Path("/dev/v4l/by-path"))
"""Where the system keeps names of cameras that stay: by serial number, and by the socket that it is plugged into."""

ENUM_FRAMESIZES, DISCRETE_SIZE, MAX_SIZES = 0xC02C564A, 1, 64
"""VIDIOC_ENUM_FRAMESIZES of linux/videodev2.h: _IOWR('V', 74, struct v4l2_frmsizeenum), 44 bytes."""


def parse_settings(words: Sequence[str], spec: str) -> dict[str, str | float]:
    """What the words after a device ask for.

    Args:
        words: "1280x800", "MJPG", "exposure=200", ... in any order.
        spec: All of the camera's words, for errors.

    Raises:
        UsageError: A word is none of them, is there twice, or has no number.
    """
    found: dict[str, str | float] = {}
    for word in words:
        key, value = _read_word(word.strip(), spec)
        if key in found:
            raise UsageError(f"{spec!r} says {key} twice.", fix="give it once")
        found[key] = value
    return {key: found[key] for key in ("size", "format", *NUMBERS) if key in found}


def _read_word(word: str, spec: str) -> tuple[str, str | float]:
    key, equals, value = word.partition("=")
    if equals and key in NUMBERS:
        if value == AUTO and key in AUTOMATIC:
            return key, AUTO
        try:
            number = float(value)
        except ValueError:
            number = float("nan")
        if not 0 <= number < 1e9 or (key == "fps" and number == 0):
            automatic = f", or {key}={AUTO}" if key in AUTOMATIC else ""
            raise UsageError(f"{word!r} in {spec!r} has no number.", fix=f"write for example {key}=30{automatic}")
        return key, number
    size = re.fullmatch(r"([1-9]\d{0,4})[xX]([1-9]\d{0,4})", word)
    if size:
        return "size", f"{size[1]}x{size[2]}"
    if not equals and re.fullmatch(r"[A-Za-z0-9]{3,4}", word):
        return "format", word.upper()
    raise UsageError(
        f"{word!r} in {spec!r} sets nothing of a camera{did_you_mean(key, NUMBERS)}.",
        why="known are a size, a pixel format of four letters, fps, exposure, gain and focus",
        fix="write for example /dev/video0,1280x800,MJPG,fps=60,exposure=200,gain=4,focus=30",
    )


def settings_words(settings: Wanted) -> str:
    """Settings as `parse_settings` takes them: "1280x800,MJPG,exposure=200".

    Args:
        settings: Asked for, or read back.
    """
    return ",".join(
        f"{key}={value:g}" if isinstance(value, float) else _word(key, value) for key, value in settings.items()
    )


def _word(key: str, value: str) -> str:
    return value if key in ("size", "format") else f"{key}={value}"


def apply_settings(capture: Any, wanted: Wanted) -> None:
    """Set what is asked for, in the order in which nothing undoes what is before it.

    Args:
        capture: An open cv2.VideoCapture of V4L2.
        wanted: As `parse_settings` gives it.
    """
    cv2 = opencv()
    if "format" in wanted:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*str(wanted["format"]).ljust(4)))
    if "size" in wanted:
        width, height = map(int, str(wanted["size"]).split("x"))
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
    if "fps" in wanted:
        capture.set(cv2.CAP_PROP_FPS, wanted["fps"])
    if "exposure" in wanted:
        # some cameras heed the time only after the mode has really changed
        modes = (AUTO_EXPOSURE,) if wanted["exposure"] == AUTO else (AUTO_EXPOSURE, MANUAL_EXPOSURE)
        for mode in modes:
            capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, mode)
    if "focus" in wanted:
        capture.set(cv2.CAP_PROP_AUTOFOCUS, 1 if wanted["focus"] == AUTO else 0)
    for key, what in (
        ("exposure", cv2.CAP_PROP_EXPOSURE), ("gain", cv2.CAP_PROP_GAIN), ("focus", cv2.CAP_PROP_FOCUS),
    ):  # fmt: skip
        if wanted.get(key, AUTO) != AUTO:
            capture.set(what, wanted[key])


def read_settings(capture: Any) -> dict[str, str | float]:
    """What the driver says it is set to; a control that the camera does not have is left out.

    Args:
        capture: An open cv2.VideoCapture of V4L2.
    """
    cv2 = opencv()
    code = int(capture.get(cv2.CAP_PROP_FOURCC))
    width, height = (int(capture.get(what)) for what in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    letters = "".join(chr(code >> shift & 0xFF) for shift in (0, 8, 16, 24)) if code > 0 else ""
    found: dict[str, str | float] = {"size": f"{width}x{height}"}
    if letters.strip():
        found["format"] = letters.strip()
    automatic = {
        "exposure": capture.get(cv2.CAP_PROP_AUTO_EXPOSURE) not in (-1, MANUAL_EXPOSURE),
        "focus": capture.get(cv2.CAP_PROP_AUTOFOCUS) == 1,
    }
    for key, what in (
        ("fps", cv2.CAP_PROP_FPS), ("exposure", cv2.CAP_PROP_EXPOSURE), ("gain", cv2.CAP_PROP_GAIN),
        ("focus", cv2.CAP_PROP_FOCUS),
    ):  # fmt: skip
        value = float(capture.get(what))
        if automatic.get(key, False):
            found[key] = AUTO
        elif value > 0 or (value == 0 and key != "fps"):
            found[key] = value
    return found


def differences(wanted: Wanted, given: Wanted) -> list[str]:
    """Where the driver did something else than it was asked, in words; empty where all holds.

    Args:
        wanted: What was asked for.
        given: What was read back.
    """
    return [
        f"{key} {_say(wanted[key])} was asked for, "
        + (f"the camera has {_say(given[key])}" if key in given else "the camera has no such setting")
        for key in wanted
        if not _same(key, wanted[key], given.get(key))
    ]


def _same(key: str, a: str | float, b: str | float | None) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return abs(a - b) <= (MAX_FPS_ERROR * a if key == "fps" else 0.5)
    return a == b


def _say(value: str | float) -> str:
    return f"{value:g}" if isinstance(value, float) else value


def changed_settings(before: str, now: str) -> list[str]:
    """What is other than in an earlier session, in words.

    Args:
        before: Settings as `settings_words` gave them then.
        now: As it gives them now.
    """
    try:
        then, today = (parse_settings(words.split(","), words) if words else {} for words in (before, now))
    except UsageError:  # somebody wrote something else there
        return []
    keys = [key for key in then if key in today and not _same(key, then[key], today[key])]
    return [f"{key} was {_say(then[key])}, and is {_say(today[key])}" for key in keys]


def device_path(source: int | str) -> Path:
    """The device's file.

    Args:
        source: Its number, or its file.
    """
    return Path(f"/dev/video{source}") if isinstance(source, int) else Path(source)


def lasting_name(source: int | str) -> str:
    """The name under which the system will find the same camera after the next start, when numbers may be others.

    Args:
        source: The device's number or file.

    Returns:
        The link by serial number, else that by socket; empty where there is none.
    """
    device = os.path.realpath(device_path(source))
    return next((str(link) for link in _links() if os.path.realpath(link) == device), "")


def _links() -> Iterator[Path]:
    for folder in LINKS:
        if folder.is_dir():
            yield from sorted(folder.iterdir())


def offered_sizes(source: int | str, pixel_format: str) -> list[str]:
    """The sizes that a device offers in a pixel format, the largest first; empty where it cannot be asked.

    Args:
        source: The device's number or file.
        pixel_format: Four letters.
    """
    try:
        import fcntl

        device = os.open(device_path(source), os.O_RDWR | os.O_NONBLOCK)
    except (ImportError, OSError):
        return []
    code = int.from_bytes(pixel_format.ljust(4)[:4].encode("latin-1"), "little")
    sizes: set[tuple[int, int]] = set()
    try:
        for index in range(MAX_SIZES):
            asked = bytearray(struct.pack("<11I", index, code, *[0] * 9))
            fcntl.ioctl(device, ENUM_FRAMESIZES, asked)
            _, _, kind, *numbers = struct.unpack("<11I", asked)
            if kind != DISCRETE_SIZE:  # a range: smallest and largest
                sizes |= {(numbers[0], numbers[3]), (numbers[1], numbers[4])}
                break
            sizes.add((numbers[0], numbers[1]))
    except OSError:  # there are no more
        pass
    finally:
        os.close(device)
    return [f"{width}x{height}" for width, height in sorted(sizes, reverse=True)]


def shared_device(sources: Iterable[tuple[str, int | str]]) -> tuple[str, str] | None:
    """Two cameras that are one device, under two of its names; None where there are none.

    Args:
        sources: Camera and device.
    """
    seen: dict[str, str] = {}
    for name, source in sources:
        device = os.path.realpath(device_path(source))
        if device in seen:
            return seen[device], name
        seen[device] = name
    return None
