"""The values that all formats share: cameras with explicit lenses and poses, and the rig they make.

Pixels (0, 0) at the centre of the top-left pixel, camera frame x right, y down, z forward, as everywhere here; each
format's own conventions are converted in its own file.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace

import numpy as np

from implicam.dataset.model import Camera
from implicam.dataset.units import metres_per
from implicam.errors import DatasetError, did_you_mean
from implicam.geometry import Pose
from implicam.lenses import Bools, BrownConrady, Floats, Lens


@dataclass(frozen=True, eq=False)
class ExplicitCamera:
    """A camera with a lens model and a place. width, height: in pixels, None where not known."""

    name: str
    width: int | None
    height: int | None
    lens: Lens
    camera_from_world: Pose

    def __post_init__(self) -> None:
        Camera(self.name, self.width, self.height)  # refuses what could not be a camera of a dataset
        pose = (self.camera_from_world.rotation, self.camera_from_world.translation)
        if not np.isfinite([*astuple(self.lens), *np.concatenate(pose, axis=None)]).all():
            raise DatasetError(f"camera {self.name!r} has a number that is not finite.", fix="correct the value")
        if not (self.lens.fx > 0 and self.lens.fy > 0):
            raise DatasetError(
                f"camera {self.name!r} has focal lengths {self.lens.fx:g}, {self.lens.fy:g}.",
                why="they are in pixels and greater than zero; a mirrored picture has no lens here",
                fix="correct the values",
            )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels; DatasetError where they are not known."""
        if self.width is None or self.height is None:
            raise DatasetError(
                f"the image size of camera {self.name!r} is not known, and the format needs it.",
                fix="give width and height",
            )
        return self.width, self.height

    def pixel_from_world(self, xyz: Floats) -> tuple[Floats, Bools]:
        """Project points into the camera.

        Args:
            xyz: (n, 3) in the rig's world frame and unit.

        Returns:
            Pixels (n, 2), NaN where there is none; and (n,) where there is one.
        """
        return self.lens.pixel_from_camera_point(self.camera_from_world.apply(xyz))


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras in one world frame.

    notes: what the reader of a file should know, each a sentence; none where all is well.
    """

    cameras: tuple[ExplicitCamera, ...]
    length_unit: str
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.cameras:
            raise DatasetError("the rig has no camera.", fix="keep at least one")
        for name, times in Counter(camera.name for camera in self.cameras).items():
            if times > 1:
                raise DatasetError(f"camera {name!r} is there {times} times.", fix="give each a name of its own")

    def with_sizes(self, sizes: Mapping[str, tuple[int, int]]) -> Rig:
        """The same rig with the image sizes that its file does not say.

        Args:
            sizes: Camera -> width and height in pixels.

        Raises:
            DatasetError: There is no such camera, or it has another size.
        """
        names = [camera.name for camera in self.cameras]
        for name in sizes:
            if name not in names:
                raise DatasetError(
                    f"there is no camera {name!r}{did_you_mean(name, names)}.",
                    fix=f"the cameras are {', '.join(names)}",
                )
        for camera in self.cameras:
            own = (camera.width, camera.height)
            if own not in ((None, None), sizes.get(camera.name, own)):
                raise DatasetError(
                    f"camera {camera.name!r} has images of {camera.width} x {camera.height} px in the file, and "
                    "another size is given.",
                    fix="leave out the size; the lens is that of images of the file's size",
                )
        known = {camera.name: (camera.width, camera.height) for camera in self.cameras} | dict(sizes)
        sized = [replace(c, width=known[c.name][0], height=known[c.name][1]) for c in self.cameras]
        return replace(self, cameras=tuple(sized))

    def in_unit(self, unit: str) -> Rig:
        """The same rig with lengths in another unit.

        Args:
            unit: For example "m".

        Raises:
            DatasetError: One of the two units is not known.
        """
        if unit == self.length_unit:
            return self
        scale = metres_per(self.length_unit) / metres_per(unit)
        poses = [camera.camera_from_world for camera in self.cameras]
        moved = [Pose(pose.rotation, pose.translation * scale) for pose in poses]
        cameras = [replace(c, camera_from_world=pose) for c, pose in zip(self.cameras, moved, strict=True)]
        return replace(self, cameras=tuple(cameras), length_unit=unit)


def has_distortion(lens: Lens) -> bool:
    """Whether a lens is anything but a pinhole.

    Args:
        lens: Of any family.
    """
    return not isinstance(lens, BrownConrady) or any(astuple(lens)[4:])
