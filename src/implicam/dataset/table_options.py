"""How the pixels of a file are counted, where it does not say so itself: what the options of the commands state."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from implicam.dataset.model import Camera, Dataset
from implicam.errors import UsageError, did_you_mean
from implicam.registry import Option

PANEL = "A table of your own"

_SIZE = re.compile(r"(\d+)\s*[xX×]\s*(\d+)")


@dataclass(frozen=True)
class TableOptions:
    """What a table does not say itself.

    Attributes:
        unit: The length unit of the positions; None where the file states it.
        first_pixel: The number of the first pixel's centre, 0 or 1; 0 here and in OpenCV, 1 in MATLAB. None for 0, or
            for what another program is known to do.
        v_up: Whether v is counted upwards from the bottom row; needs the heights of the pictures.
        size: Width and height of the pictures: "1920x1080", or "cam1=1920x1080,cam2=1280x800"; None where the file
            states them, or they are not known.
    """

    unit: Annotated[
        str | None, Option("length unit of the positions, of a file that does not state it", "UNIT", panel=PANEL)
    ] = None
    first_pixel: Annotated[
        int | None, Option("the number of the first pixel: 0, or 1 as in MATLAB", "0|1", panel=PANEL)
    ] = None
    v_up: Annotated[bool, Option("v is counted from the bottom row upwards", panel=PANEL)] = False
    size: Annotated[
        str | None,
        Option("of the pictures: 1920x1080, or cam1=1920x1080,cam2=1280x800", "SIZE", panel=PANEL),
    ] = None

    def __post_init__(self) -> None:
        if self.first_pixel not in (None, 0, 1):
            raise UsageError(
                f"the first pixel cannot have the number {self.first_pixel!r}.",
                why="programs count the centres of pixels from 0, or from 1",
                fix="write --first-pixel 1, or leave it out for 0",
            )
        self.sizes(())

    def sizes(self, cameras: tuple[str, ...]) -> dict[str, tuple[int, int]]:
        """Camera -> width and height.

        Args:
            cameras: The names of all cameras, for a size that holds for all.

        Raises:
            UsageError: The text states no sizes.
        """
        found = dict[str, tuple[int, int]]()
        for part in (self.size or "").split(",") if self.size else ():
            name, _, text = part.rpartition("=")
            size = _SIZE.fullmatch(text.strip())
            if size is None:
                raise UsageError(
                    f"{self.size!r} is no size of pictures.",
                    fix="write --size 1920x1080, or --size cam1=1920x1080,cam2=1280x800",
                )
            found |= dict.fromkeys([name.strip()] if name else cameras, (int(size[1]), int(size[2])))
        return found

    def apply(self, data: Dataset) -> Dataset:
        """The dataset with pixels as here, (0, 0) the centre of the top-left one, and with the sizes of its pictures.

        Args:
            data: As the file has it; its missing views are NaN already.

        Returns:
            The dataset, with a note on what was changed.

        Raises:
            DatasetError: A pixel is far outside its picture.
            UsageError: A size contradicts that of the data, is of an unknown camera, or is missing for `v_up`.
        """
        if not (self.first_pixel or self.v_up or self.size):
            return data
        cameras = self._sized(data)
        observations, notes = data.observations, list(data.notes)
        uv = observations.uv - (self.first_pixel or 0)
        if self.first_pixel:
            notes.append("Pixels were counted from 1: u and v are less by 1 here, where the first is 0.")
        if self.v_up:
            heights = [camera.height for camera in cameras]
            unknown = [camera.name for camera in cameras if camera.height is None]
            if unknown:
                raise UsageError(
                    f"v cannot be turned around: the picture's height of camera {unknown[0]!r} is not known.",
                    fix="add the size of the pictures: --size 1920x1080",
                )
            uv[..., 1] = np.array(heights, dtype=np.float64) - 1.0 - uv[..., 1]
            notes.append("v was counted upwards from the bottom row: here it is counted downwards from the top row.")
        turned = replace(observations, cameras=cameras, uv=uv)
        return replace(data, observations=turned, notes=tuple(notes))

    def _sized(self, data: Dataset) -> tuple[Camera, ...]:
        names = data.observations.camera_names
        sizes = self.sizes(names)
        for name in sizes:
            if name not in names:
                raise UsageError(
                    f"--size names a camera {name!r}, which is not there{did_you_mean(name, names)}.",
                    fix=f"the cameras are {', '.join(names)}",
                )
        made = []
        for camera in data.cameras:
            width, height = sizes.get(camera.name, (camera.width, camera.height))
            for own, given in ((camera.width, width), (camera.height, height)):
                if own not in (None, given):
                    raise UsageError(
                        f"the data say that camera {camera.name!r} has pictures of {camera.width} x {camera.height} "
                        f"pixels, and --size says {width} x {height}.",
                        fix="leave out --size, or correct the description of the data",
                    )
            made.append(replace(camera, width=width, height=height))
        return tuple(made)


DOCUMENTED = TableOptions()
"""A file that says everything itself, or is as docs/formats.md has it."""


def size_text(size: str | tuple[int, int] | Mapping[str, tuple[int, int]] | None) -> str | None:
    """The sizes of pictures as the option states them.

    Args:
        size: One for all cameras, or one for each by name; a text as it is.
    """
    if size is None or isinstance(size, str):
        return size
    if isinstance(size, Mapping):
        return ",".join(f"{name}={width}x{height}" for name, (width, height) in size.items())
    return f"{size[0]}x{size[1]}"
