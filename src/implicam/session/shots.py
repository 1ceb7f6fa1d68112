"""Sets of pictures of all cameras, taken one after another into a dataset folder: what `implicam shoot` does.

    images/<camera>/0001.png   a set is the same number in every camera's folder
    dataset.toml               name, length unit, cameras with their size, and what USB cameras were set to

A set is whole, or it is not there. Its pictures are written into .taking/, which becomes .taken/ in one step, and go
from there to their places; what a killed process left in .taken/ is put in place by the next one, and .taking/ is
thrown away.
"""

from __future__ import annotations

import itertools
import math
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from implicam.dataset import Camera, Dataset, Observations
from implicam.dataset.folder import DESCRIPTION, IMAGES, description_text, read_description
from implicam.errors import HardwareError, ImplicamError, UsageError
from implicam.files import convert_write_errors, write_text
from implicam.hardware import (
    Frame,
    FrameSource,
    Trigger,
    compare_settings,
    keep_settings,
    open_all,
    simulated_rig,
    take_frames,
    tell_settings,
)
from implicam.images import Grey
from implicam.session.folder import check_pictures, flush_folder, write_pictures
from implicam.session.setup import LIVE_TIMEOUT_SECONDS, PICTURE_TIMEOUT_SECONDS, Setup, cameras_of, trigger_of
from implicam.simulate import random_positions

TAKING, TAKEN = ".taking", ".taken"

SLICE_SECONDS = 1.0
"""A camera that may have to wait for long is asked again and again for so long, so that Ctrl-C ends it."""

MAX_SET_SECONDS = 1.0
"""Pictures that come further apart are not of one pulse of a trigger that others fire."""


class Taken(NamedTuple):
    """A set that is on disk: its shot, and how far apart its pictures were received, seconds."""

    shot: str
    pictures: int
    spread: float

    def __str__(self) -> str:
        """In a line."""
        return f"{self.shot}: {self.pictures} pictures, received within {1000 * self.spread:.0f} ms"


@dataclass(frozen=True, eq=False)
class Shutter:
    """Takes a picture with every camera at once.

    Attributes:
        cameras: One or more.
        trigger: Fired for each set; None where the cameras run freely, or another one fires.
        waits: Whether a trigger that others fire exposes the cameras, however long that takes.
    """

    cameras: Sequence[FrameSource]
    trigger: Trigger | None = None
    waits: bool = False

    @contextmanager
    def opened(self) -> Iterator[Shutter]:
        """With all devices open; they are closed afterwards."""
        devices: list[FrameSource | Trigger] = [*self.cameras, *([] if self.trigger is None else [self.trigger])]
        try:
            with ThreadPoolExecutor(len(devices)) as pool:
                open_all(devices, pool)
            yield self
        finally:
            for device in devices:
                device.close()

    def take(self) -> list[Frame]:
        """A frame of each camera, in their order.

        Raises:
            HardwareError: A camera or the trigger failed, or the pictures are not of one pulse.
        """
        turn = _Turn(math.inf, MAX_SET_SECONDS) if self.waits else _Turn(PICTURE_TIMEOUT_SECONDS, math.inf)
        with ThreadPoolExecutor(len(self.cameras)) as pool:
            if self.trigger is not None:
                return take_frames(self.cameras, self.trigger, LIVE_TIMEOUT_SECONDS, pool)
            try:
                asked = [pool.submit(turn.ask, camera) for camera in self.cameras]
                wait(asked)
            finally:  # Ctrl-C, at any moment: those that wait for long end after a slice
                turn.ending.set()
            frames = [one.result() for one in asked]
        spread = spread_of(frames)
        if self.waits and spread > MAX_SET_SECONDS:
            raise HardwareError(
                f"the pictures came {spread:.1f} s apart.",
                why="they are not of one pulse: a camera missed it, or gave the picture of an earlier one",
                fix="look at the wires, and at how fast the trigger fires",
            )
        return frames


class _Turn:
    """One set that is waited for: `limit` seconds, and `apart` seconds once the first camera has its picture."""

    def __init__(self, limit: float, apart: float) -> None:
        self.ending = threading.Event()
        self._end, self._apart = time.monotonic() + limit, apart

    def ask(self, camera: FrameSource) -> Frame:
        if camera.live:
            return camera.frame(LIVE_TIMEOUT_SECONDS)
        while True:
            begun = time.monotonic()
            try:
                frame = camera.frame(SLICE_SECONDS)
            except HardwareError:
                now = time.monotonic()
                if now - begun < 0.9 * SLICE_SECONDS or now > self._end or self.ending.is_set():
                    raise
                continue
            self._end = min(self._end, time.monotonic() + self._apart)
            return frame


def spread_of(frames: Sequence[Frame]) -> float:
    """How far apart pictures were received, seconds.

    Args:
        frames: Of one set.
    """
    taken = [frame.taken for frame in frames]
    return max(taken) - min(taken)


class ShotFolder:
    """The dataset folder that sets are put into; a context manager, because one process at a time writes into it.

    Args:
        folder: A new one, an empty one, or one with such sets: then their numbers go on.
        cameras: Those that take the pictures, in order.
        unit: The length unit of a new dataset.toml; None for mm, or for what is there.
        say: Shows a line of text.

    Raises:
        UsageError: The folder is another process's, or a dataset with other cameras or another unit.
        DatasetError: Its dataset.toml is damaged.
    """

    def __init__(
        self, folder: Path, cameras: Sequence[FrameSource], unit: str | None, say: Callable[[str], None]
    ) -> None:
        self.folder, self._sources, self._say = folder, cameras, say
        self._names = [source.name for source in cameras]
        self._unit = unit or "mm"
        self.cameras: tuple[Camera, ...] = tuple(map(Camera, self._names))
        self._described = (folder / DESCRIPTION).exists()
        if self._described:
            self._check_description(unit)
        elif (folder / IMAGES).is_dir() or (folder.is_dir() and any(not _is_ours(entry) for entry in folder.iterdir())):
            raise UsageError(
                f"{folder} is not empty, and no dataset.",
                why=f"it has no {DESCRIPTION}, and pictures would mix with what is there",
                fix="choose a new or empty folder",
            )
        with convert_write_errors(str(folder)):
            folder.mkdir(parents=True, exist_ok=True)
        self._lock = _locked(folder)
        self._recover()
        files = [path.stem for name in self._names for path in (folder / IMAGES / name).glob("*")]
        self._next = 1 + max((int(name) for name in files if name.isdecimal()), default=0)

    def __enter__(self) -> ShotFolder:
        return self

    def __exit__(self, *error: object) -> None:
        with suppress(ImplicamError):  # the disk may be what is wrong
            self._recover()  # Ctrl-C may have come between two names
        if self._lock is not None:
            os.close(self._lock)

    def add(self, frames: Sequence[Frame]) -> Taken:
        """Put a set in place; it is on disk, all of it, when this returns, and where it raises nothing was added.

        Args:
            frames: One of each camera, in their order.

        Raises:
            ImageError: A picture has another size than those before.
            ImplicamError: The system refuses to write.
        """
        pictures = {name: frame.picture for name, frame in zip(self._names, frames, strict=True)}
        check_pictures(pictures, self.cameras)
        if not self._described:
            self._describe(pictures)
        shot = f"{self._next:04d}"
        with convert_write_errors(f"into {self.folder}", "the permissions and the free space"):
            try:
                write_pictures(self.folder / TAKING, shot, pictures)
                (self.folder / TAKING).rename(self.folder / TAKEN)
            except BaseException:
                shutil.rmtree(self.folder / TAKING, ignore_errors=True)
                raise
            self._next += 1
            self._put_in_place()
        return Taken(shot, len(frames), spread_of(frames))

    def _check_description(self, unit: str | None) -> None:
        _, self._unit, self.cameras, _ = read_description(self.folder)
        if unit not in (None, self._unit):
            raise UsageError(
                f"{self.folder / DESCRIPTION} is in {self._unit!r}, not in {unit!r}.", fix="leave out --unit"
            )
        names = [camera.name for camera in self.cameras]
        if names != self._names:
            raise UsageError(
                f"{self.folder} has the cameras {', '.join(names)}, and here are {', '.join(self._names)}.",
                fix="give the same cameras with the same names in the same order, or shoot into another folder",
            )

    def _recover(self) -> None:
        """What a killed process left: a set that was whole is put in place, another is thrown away."""
        with convert_write_errors(f"into {self.folder}", "the permissions and the free space"):
            shutil.rmtree(self.folder / TAKING, ignore_errors=True)
            if (self.folder / TAKEN).is_dir():
                self._put_in_place()

    def _put_in_place(self) -> None:
        staged = self.folder / TAKEN
        for picture in sorted(staged.glob(f"{IMAGES}/*/*")):
            place = self.folder / picture.relative_to(staged)
            place.parent.mkdir(parents=True, exist_ok=True)
            picture.rename(place)
            flush_folder(place.parent)
        shutil.rmtree(staged)
        flush_folder(self.folder)

    def tell(self) -> None:
        """Say what USB cameras, which are open, are set to, and whether they were set otherwise before."""
        before = {camera.name: camera.extra for camera in self.cameras}
        for text in (*tell_settings(self._sources), *compare_settings(before, keep_settings(self._sources))):
            self._say(text)

    def _describe(self, pictures: Mapping[str, Grey]) -> None:
        """Write dataset.toml with the first set: only the pictures tell their size."""
        kept = keep_settings(self._sources)
        self.cameras = tuple(
            Camera(name, picture.shape[1], picture.shape[0], kept.get(name, {})) for name, picture in pictures.items()
        )
        nothing = np.full((0, len(self.cameras), 2), np.nan)
        empty = Observations(np.zeros(0, dtype=np.str_), self.cameras, nothing, nothing)
        description = description_text(Dataset(self.folder.absolute().name, self._unit, empty))
        write_text(self.folder / DESCRIPTION, description)
        self._described = True


def take_sets(
    shutter: Shutter,
    folder: ShotFolder,
    due: Iterable[object],
    *,
    before: Callable[[], object] = lambda: None,
    kept: Callable[[Taken], object] = lambda taken: None,
    missed: Callable[[HardwareError], object] = lambda error: None,
    most_missed: int = 1,
) -> int:
    """Take set after set.

    Args:
        shutter: With its devices open.
        folder: Where they are put.
        due: Gives something whenever a set is to be taken; at its end it is over.
        before: Called before each set.
        kept: Told of each set that is on disk.
        missed: Told why a set was not kept.
        most_missed: So many in a row end it.

    Returns:
        The number of sets that were kept.

    Raises:
        HardwareError: The last of `most_missed` sets in a row that failed.
        ImplicamError: A set could not be written.
    """
    count = in_a_row = 0
    for _ in due:
        before()
        try:
            frames = shutter.take()
        except HardwareError as error:
            in_a_row += 1
            if in_a_row >= most_missed:
                raise
            missed(error)
            continue
        kept(folder.add(frames))
        count, in_a_row = count + 1, 0
    return count


def every(seconds: float, say: Callable[[str], object], count: int | None = None) -> Iterator[int]:
    """Gives something every so many seconds, counted from the first; what came too late is not made up for.

    Args:
        seconds: Between two.
        say: Told, once, that a set takes longer than that.
        count: How many; None for no end.
    """
    due, told = time.monotonic(), False
    for number in itertools.count() if count is None else range(count):
        time.sleep(max(0.0, due - time.monotonic()))
        yield number
        due += seconds
        late = time.monotonic() - due
        if late > 0:
            if not told:
                say(f"a set takes longer than {seconds:g} s: they come as fast as they can")
            due, told = due + late, True


def shutter_of(setup: Setup, *, waits: bool = False) -> tuple[Shutter, Callable[[], object]]:
    """The cameras of a setup, not opened yet.

    Args:
        setup: Without cameras, those of its simulated rig.
        waits: Whether a trigger that others fire exposes them.

    Returns:
        The shutter, and what is to be called before each set: it moves the simulated ball.

    Raises:
        UsageError: A spec names no camera or no trigger.
    """
    if not setup.simulated:
        return Shutter(cameras_of(setup, triggered=waits), trigger_of(setup), waits), lambda: None
    trigger_of(setup)  # there must be none
    rig, rng = setup.built(), np.random.default_rng([setup.seed, 12])
    cameras, robot = simulated_rig(rig, seed=setup.seed)
    return Shutter(cameras), lambda: robot.move(random_positions(rig, 1, rng).xyz[0])


def _is_ours(entry: Path) -> bool:
    return entry.name in (TAKING, TAKEN)


def _locked(folder: Path) -> int | None:
    """A handle of the folder that no other process has; the system lets go of it with the process. None where the
    system has no such locks."""
    try:
        import fcntl
    except ImportError:
        return None
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise UsageError(
            f"another process is shooting into {folder}.", fix="end it, or choose another folder"
        ) from None
    except OSError:  # some network shares
        os.close(handle)
        return None
    return handle
