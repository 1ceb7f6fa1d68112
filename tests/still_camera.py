"""A camera that shows its number of pictures, and a process that shoots with two of them, for tests."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from implicam.errors import HardwareError
from implicam.hardware import FrameSource
from implicam.hardware.protocol import Frame
from implicam.session.shots import ShotFolder, Shutter, take_sets
from toy_robot import LINE


class Still:
    """A camera that shows its number of pictures; `fails` are the pictures that do not come. A triggered one waits for
    the line of the toy."""

    spec: ClassVar[str] = "still:"

    @classmethod
    def takes(cls, spec: str) -> bool:
        return False

    @classmethod
    def from_spec(cls, name: str, rest: str, *, triggered: bool) -> FrameSource:
        made = cls(name)
        made.live = not triggered
        return made

    def __init__(self, name: str, *fails: int, size: tuple[int, int] = (48, 64)) -> None:
        self.name, self._fails, self.size, self.number, self.live = name, fails, size, 0, True
        self.settings = "64x48,MJPG,exposure=200"

    def open(self) -> None: ...
    def close(self) -> None: ...

    def frame(self, timeout: float = 5.0) -> Frame:
        if not self.live and not LINE.wait_for_pulse(timeout):
            raise HardwareError(f"camera {self.name}: no picture within {timeout:g} s.", why="it waits for its trigger")
        self.number += 1
        if self.number in self._fails:
            raise HardwareError(f"camera {self.name} is gone.", why="a test")
        grey = np.full(self.size, self.number / 65535, np.float32)  # 16 bits
        return Frame(grey, self.number, time.time())

    def tell_settings(self) -> list[str]:
        return [f"camera {self.name}: {self.settings}"]

    def keep_settings(self) -> dict[str, str]:
        return {"device": f"/dev/v4l/by-id/{self.name}", "settings": self.settings}


def taken(folder: Path, cameras: Sequence[FrameSource], sets: int = 3, **how: int) -> tuple[int, list[str]]:
    said: list[str] = []
    with ShotFolder(folder, cameras, None, said.append) as kept, Shutter(cameras).opened() as shutter:
        kept.tell()
        return take_sets(shutter, kept, range(sets), missed=lambda error: said.append(str(error.what)), **how), said


def shoot_on(folder: str) -> None:
    taken(Path(folder), [Still("left"), Still("right")], 100_000)
