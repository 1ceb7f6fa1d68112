"""What a fit of forward models starts from: the working frame, what each camera saw, how known points may be off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from implicam.dataset import Dataset, Observations
from implicam.dataset.requirements import require_points, require_volume
from implicam.geometry import MAX_PIXEL_DISTANCE_RATIO, Floats
from implicam.rig_model.camera import Image
from implicam.rig_model.camera_model import CameraViews
from implicam.rig_model.settings import DEFAULT_SETTINGS, RigModelSettings
from implicam.rig_model.shot_errors import ShotErrors, Shots

MIN_POINTS_PER_CAMERA = 8
"""Known points that a camera must see: 16 numbers for the 14 of lens and pose."""


@dataclass(frozen=True, eq=False)
class Frame:
    """The working frame: world positions about their mean, in their overall standard deviation."""

    offset: Floats
    scale: float

    @classmethod
    def of(cls, data: Dataset, method: str) -> Frame:
        """The working frame of a dataset.

        Args:
            data: The known points; those that some camera sees count.
            method: The name of the method, for the error.

        Returns:
            The frame about these points.

        Raises:
            FitError: They are too few, or do not fill a volume.
        """
        seen = data.observations.seen.any(axis=1)
        _ = data.positions  # a clear error where there are none
        counts = data.observations.seen.sum(axis=0)
        why = ", ".join(f"{n} sees {k}" for n, k in zip(data.observations.camera_names, counts, strict=True))
        xyz = data.xyz[seen]
        places = len(np.unique(data.places[seen]))
        if places < len(xyz):
            why += f"; {len(xyz)} known points stand at {places} different positions"
        require_points(places, MIN_POINTS_PER_CAMERA, method, why)
        require_volume(xyz, method)
        offset = xyz.mean(axis=0)
        return cls(offset, float(np.sqrt(np.mean((xyz - offset) ** 2))))

    @classmethod
    def from_array(cls, array: Floats) -> Frame:
        """The inverse of `as_array`.

        Args:
            array: (4,) offset and scale.

        Returns:
            The frame.

        Raises:
            ValueError: The scale is not positive.
        """
        if array[3] <= 0:
            raise ValueError("the scale of the frame must be positive")
        return cls(array[:3], float(array[3]))

    def as_array(self) -> Floats:
        """(4,) offset and scale."""
        return np.append(self.offset, self.scale)

    def to_working(self, xyz: Floats) -> Floats:
        """Positions in the working frame.

        Args:
            xyz: (..., 3) in the world.

        Returns:
            (..., 3) in the working frame.
        """
        return (xyz - self.offset) / self.scale

    def to_world(self, points: Floats) -> Floats:
        """Positions in the world.

        Args:
            points: (..., 3) in the working frame.

        Returns:
            (..., 3) in the world.
        """
        return points * self.scale + self.offset


def camera_views_of(observations: Observations, stated: Floats) -> tuple[CameraViews, ...]:
    """What each camera saw, all of it.

    Args:
        observations: Of C cameras.
        stated: (C,) their usual stated noise, as `stated_noise` gives it.

    Returns:
        Per camera, its views.
    """
    relative = relative_noise(observations, stated)
    seen = (np.flatnonzero(column) for column in observations.seen.T)
    return tuple(CameraViews(rows, observations.uv[rows, c], relative[rows, c]) for c, rows in enumerate(seen))


def image_of(observations: Observations, c: int) -> Image:
    """Where the pixels of a camera are measured from.

    Args:
        observations: What the cameras saw.
        c: Number of the camera.

    Returns:
        The middle of its image and half the longer side; where its size is not told, of what it saw.
    """
    camera = observations.cameras[c]
    if camera.width is not None and camera.height is not None:
        return Image(np.array([camera.width - 1, camera.height - 1]) / 2, max(camera.width, camera.height) / 2)
    uv = observations.uv[observations.seen[:, c], c]  # not told: what is seen must do
    if not len(uv):
        return Image(np.zeros(2), 1.0)
    low, high = pixel_extent(uv)  # one wild view must not say where the image is
    return Image((low + high) / 2, float(max((high - low).max() / 2, 1.0)))


def stated_noise(observations: Observations) -> Floats:
    """The usual stated noise of each camera.

    Args:
        observations: Of C cameras.

    Returns:
        (C,) medians in pixels, NaN where none is stated.
    """
    size = view_noise(observations)
    known = np.isfinite(size) & observations.seen
    return np.array([np.median(size[known[:, c], c]) if known[:, c].any() else np.nan for c in range(size.shape[1])])


def relative_noise(observations: Observations, stated: Floats) -> Floats:
    """The stated noise of each view over the camera's usual one.

    Args:
        observations: n points and C cameras.
        stated: (C,) the usual one, pixels.

    Returns:
        (n, C) ratios; 1 where no noise is stated.
    """
    relative = view_noise(observations) / stated
    return np.where(np.isfinite(relative) & (relative > 0), relative, 1.0)


def view_noise(observations: Observations) -> Floats:
    """The stated noise of u and v together.

    Args:
        observations: n points and C cameras.

    Returns:
        (n, C) in pixels; NaN where none is stated.
    """
    return np.asarray(np.sqrt(np.mean(observations.sd**2, axis=2)), dtype=np.float64)


def _declares(data: Dataset) -> bool:
    return bool((data.positions.sd > 0).any())


def _declared(data: Dataset, frame: Frame) -> ShotErrors | None:
    """A shot is off as a whole by its declared sd: a robot or a slide puts all its points there together."""
    if not _declares(data):
        return None
    _, shot = np.unique(data.shots, return_inverse=True)
    sd = np.nan_to_num(data.positions.sd) / frame.scale
    count = np.bincount(shot)
    of_shot = np.stack([np.sqrt(np.bincount(shot, weights=sd[:, k] ** 2) / count) for k in range(3)], axis=1)
    basis = np.broadcast_to(np.eye(3), (len(data), 3, 3))
    return ShotErrors(shot.astype(np.int64), basis, of_shot, np.full(3, -1))


def pixel_extent(uv: Floats) -> tuple[Floats, Floats]:
    """The lowest and highest of pixels, wild ones aside.

    Args:
        uv: (n, 2) pixels, one or more.

    Returns:
        The lowest (2,) and the highest (2,).
    """
    away = np.linalg.norm(uv - np.median(uv, axis=0), axis=1)
    inside = uv[away <= MAX_PIXEL_DISTANCE_RATIO * np.quantile(away, 0.75)]
    return inside.min(axis=0), inside.max(axis=0)


@dataclass(frozen=True, eq=False)
class TrainingData:
    """What a fit starts from.

    Attributes:
        points: Known positions (n, 3) in the working frame.
        names: Of the C cameras.
        camera_views: Per camera what it saw, all of it.
        images: Per camera, where its pixels are measured from.
        stated: (C,) stated noise in pixels, NaN where none is.
        errors: How known positions may be off with their shots; None where they are exact.
        lens: "auto", "central" or "none".
        settings: What the fit takes for usual and for clear.
    """

    points: Floats
    names: tuple[str, ...]
    camera_views: tuple[CameraViews, ...]
    images: tuple[Image, ...]
    stated: Floats
    errors: ShotErrors | None
    lens: str
    settings: RigModelSettings

    @classmethod
    def of(
        cls,
        lens: str,
        data: Dataset,
        frame: Frame,
        settings: RigModelSettings = DEFAULT_SETTINGS,
        *,
        shots_off: bool = True,
    ) -> Self:
        """What known points say.

        Args:
            lens: "auto", "central" or "none".
            data: The known points and what the cameras saw of them.
            frame: The working frame.
            settings: What the fit takes for usual and for clear.
            shots_off: Estimate how shots are off as a whole, where nothing is declared.
        """
        observations, points = data.observations, frame.to_working(data.xyz)
        stated = stated_noise(observations)
        images = tuple(image_of(observations, c) for c in range(len(observations.cameras)))
        estimated = shots_off and not _declares(data)  # many points each, and nothing declared
        shots = Shots.of(points, data.shots, settings) if estimated else None
        errors = shots.errors(points) if shots is not None else _declared(data, frame)
        camera_views = camera_views_of(observations, stated)
        return cls(points, observations.camera_names, camera_views, images, stated, errors, lens, settings)

    def of_cameras(self, cameras: Sequence[int]) -> Self:
        """The same of some cameras.

        Args:
            cameras: Their numbers.

        Returns:
            Their names, views, images and noise in this order; points and errors are the same.
        """
        return replace(
            self,
            names=tuple(self.names[c] for c in cameras),
            camera_views=tuple(self.camera_views[c] for c in cameras),
            images=tuple(self.images[c] for c in cameras),
            stated=self.stated[list(cameras)],
        )
