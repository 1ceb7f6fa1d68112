"""One central camera for every lens, and a camera without any lens model; with their derivatives and priors.

Both see points (n, 3) of the working frame (world, centred and scaled; calibration.Frame) and offer the same:
`view(points)`, `pixel(points)`, `moved(step)`, `lines(uv)` and `prior`. Equation numbers: docs/method.md.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import ClassVar, NamedTuple

import numpy as np

from implicam.geometry import Floats, Pose, camera_centre, rotation_from_vector
from implicam.lenses import Lens
from implicam.rig_model.settings import DEFAULT_SETTINGS, CameraSettings, RigModelSettings


class Image(NamedTuple):
    """Where pixels are measured from: centre (2,) and half the longer side, in pixels."""

    centre: Floats
    half: float


class View(NamedTuple):
    """What a camera sees of n points: pixels (n, 2), log distance (n,), and derivatives.

    by_parameters (n, 2, p); by_point (n, 2, 3); distance_by_point (n, 3). NaN where the lens has no answer.
    """

    uv: Floats
    log_distance: Floats
    by_parameters: Floats
    by_point: Floats
    distance_by_point: Floats


class Sight(NamedTuple):
    """Where a camera sees n points, and no derivatives: pixels (n, 2), log distance (n,)."""

    uv: Floats
    log_distance: Floats


class Prior(NamedTuple):
    """A normal prior on the parameters: mean (p,), precision (p, p); zero where nothing is known, as of the pose."""

    mean: Floats
    precision: Floats


@dataclass(frozen=True, eq=False)
class CentralCamera:
    """A lens and its place, eq. (2). A step is (lens parameters, rotation vector, translation)."""

    lens: Lens
    pose: Pose  # camera_from_world

    kind: ClassVar[str] = "central"

    @property
    def size(self) -> int:
        """Number of unknowns: those of the lens, and six of the pose."""
        return len(fields(self.lens)) + 6

    def view(self, points: Floats) -> View:
        """Everything that a camera sees of points, at once.

        Args:
            points: (n, 3) in the working frame.

        Returns:
            Pixels and log distance of each point, and their derivatives; NaN where the lens has no answer.
        """
        turned = points @ self.pose.rotation.T
        there = turned + self.pose.translation
        uv, _ = self.lens.pixel_from_camera_point(there)
        slope = self.lens.jacobian(there)
        by_parameters = np.empty((len(points), 2, self.size))
        by_parameters[:, :, :-6] = self.lens.parameter_jacobian(there)
        by_parameters[:, :, -6:-3] = cross(turned[:, None, :], slope)  # slope . (omega x turned)
        by_parameters[:, :, -3:] = slope
        squared = np.sum(there**2, axis=1)
        return View(
            uv,
            0.5 * np.log(squared),
            by_parameters,
            slope @ self.pose.rotation,
            there @ self.pose.rotation / squared[:, None],
        )

    def sight(self, points: Floats) -> Sight:
        """Pixels and log distance of `view`, in a fraction of its time.

        Args:
            points: (n, 3) in the working frame.
        """
        there = self.pose.apply(points)
        return Sight(self.lens.pixel_from_camera_point(there)[0], 0.5 * np.log(np.sum(there**2, axis=1)))

    def pixel(self, points: Floats) -> Floats:
        """Where the camera sees points.

        Args:
            points: (n, 3) in the working frame.

        Returns:
            (n, 2) pixels, NaN where there is none.
        """
        return self.lens.pixel_from_camera_point(self.pose.apply(points))[0]

    def lines(self, uv: Floats) -> tuple[Floats, Floats]:
        """The lines of sight of pixels.

        Args:
            uv: (n, 2) pixels.

        Returns:
            The camera's centre (3,) and unit directions (n, 3) in the working frame, NaN for none.
        """
        rays, _ = self.lens.ray_from_pixel(uv)
        return self.pose.centre, rays @ self.pose.rotation

    @property
    def parameters(self) -> Floats:
        """(size,) what the prior is about; the pose has no prior and is zero here."""
        return np.concatenate([lens_parameters(self.lens), np.zeros(6)])

    @property
    def sane(self) -> bool:
        """Not inside out."""
        return self.lens.fx > 0 and self.lens.fy > 0

    def moved(self, step: Floats) -> CentralCamera:
        """The camera with its parameters changed.

        Args:
            step: (size,) of the lens parameters, the rotation vector (radians, applied after the rotation that it has),
                and the translation in the working frame.

        Returns:
            The new camera, with a lens of the same family; whether it is `sane` is not checked.
        """
        lens = type(self.lens)(*(lens_parameters(self.lens) + step[:-6]).tolist())
        turn = rotation_from_vector(step[-6:-3])
        return CentralCamera(lens, Pose(turn @ self.pose.rotation, self.pose.translation + step[-3:]))

    def in_frame(self, pose: Pose) -> CentralCamera:
        """The camera that sees of a point what this one sees of `pose.apply(point)`.

        Args:
            pose: From the new frame to that of this camera.
        """
        return CentralCamera(self.lens, self.pose @ pose)

    def zoomed(self, factor: float, middle: Floats) -> CentralCamera:
        """The camera whose picture is larger.

        Args:
            factor: By how much.
            middle: (2,) the pixel that stays where it is.
        """
        lens = self.lens
        cx, cy = (middle + factor * (np.array([lens.cx, lens.cy]) - middle)).tolist()
        return CentralCamera(replace(lens, fx=factor * lens.fx, fy=factor * lens.fy, cx=cx, cy=cy), self.pose)

    def prior(self, image: Image, widest: float, settings: CameraSettings = DEFAULT_SETTINGS) -> Prior:
        """The prior of the lens, eq. (3); of the pose there is none.

        Args:
            image: Where pixels are measured from; the principal point is expected at its centre.
            widest: Radians off its axis up to which the lens is used.
            settings: The prior's standard deviations.

        Returns:
            Mean (size,) and precision (size, size), zero for what nothing is known of.
        """
        mean, precision = np.zeros(self.size), np.zeros((self.size, self.size))
        aspect = 1 / (settings.log_aspect_prior_sd * self.lens.fx) ** 2
        precision[:2, :2] = aspect * np.array([[1, -1], [-1, 1]])
        mean[2:4] = image.centre
        precision[2, 2] = precision[3, 3] = 1 / (settings.centre_prior_sd_sides * 2 * image.half) ** 2
        own = slice(4, self.size - 6)
        mean[own], precision[own, own] = self.lens.distortion_prior(widest, settings.distortion_sds(self.lens.family))
        return Prior(mean, precision)

    def as_array(self) -> Floats:
        """(p + 12,) the p lens parameters, rotation and translation; which lens they are of is said beside it."""
        return np.concatenate([lens_parameters(self.lens), self.pose.rotation.ravel(), self.pose.translation])

    @classmethod
    def from_array(cls, array: Floats, lens: type[Lens]) -> CentralCamera:
        """The inverse of `as_array`.

        Args:
            array: (p + 12,) lens parameters, rotation and translation.
            lens: Its family of lenses.

        Returns:
            The camera.

        Raises:
            ValueError: The array does not have this length, or its rotation is none.
        """
        if len(array) != len(fields(lens)) + 12:
            raise ValueError(f"an array of {len(array)} numbers is no {lens.family} lens with its pose")
        rotation = array[-12:-3].reshape(3, 3)
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
            raise ValueError("a camera's rotation is not one")
        return cls(lens(*array[:-12].tolist()), Pose(rotation, array[-3:]))


def cross(a: Floats, b: Floats) -> Floats:
    """Cross products (..., 3) of a and b; NumPy's takes several times as long for few.

    Args:
        a: (..., 3).
        b: (..., 3), which broadcasts with a.

    Returns:
        (..., 3) a x b.
    """
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    return np.stack([y * b[..., 2] - z * b[..., 1], z * b[..., 0] - x * b[..., 2], x * b[..., 1] - y * b[..., 0]], -1)


def lens_parameters(lens: Lens) -> Floats:
    """The parameters of a lens, in the order of its fields.

    Args:
        lens: Of any family.

    Returns:
        (p,) fx, fy, cx, cy in pixels, then those of the distortion.
    """
    return np.array([getattr(lens, field.name) for field in fields(lens)])


@dataclass(frozen=True, eq=False)
class ProjectiveCamera:
    """A linear projection, w (u, v, 1) = P (x, y, z, 1), eq. (4): no lens model at all. A step is that of P."""

    P: Floats

    kind: ClassVar[str] = "none"
    size: ClassVar[int] = 12

    def view(self, points: Floats) -> View:
        """Everything that a camera sees of points, as `CentralCamera.view`; the distance is w, up to a factor.

        Args:
            points: (n, 3) in the working frame.

        Returns:
            Pixels and log w of each point, and their derivatives; NaN behind the camera.
        """
        homogeneous = np.column_stack([points, np.ones(len(points))])
        x, y, w = (homogeneous @ self.P.T).T
        w = np.where(w > 0, w, np.nan)
        uv = np.column_stack([x / w, y / w])
        by_parameters = np.zeros((len(points), 2, 12))
        for row in range(2):
            by_parameters[:, row, 4 * row : 4 * row + 4] = homogeneous / w[:, None]
            by_parameters[:, row, 8:] = -uv[:, row, None] * homogeneous / w[:, None]
        by_point = (self.P[None, :2, :3] - uv[:, :, None] * self.P[2, :3]) / w[:, None, None]
        return View(uv, np.log(w), by_parameters, by_point, self.P[2, :3] / w[:, None])

    def pixel(self, points: Floats) -> Floats:
        """Where the camera sees points.

        Args:
            points: (n, 3) in the working frame.

        Returns:
            (n, 2) pixels, NaN behind the camera.
        """
        return self.sight(points).uv

    def sight(self, points: Floats) -> Sight:
        """Pixels and log w of `view`, in a fraction of its time.

        Args:
            points: (n, 3) in the working frame.
        """
        x, y, w = (np.column_stack([points, np.ones(len(points))]) @ self.P.T).T
        w = np.where(w > 0, w, np.nan)
        return Sight(np.column_stack([x / w, y / w]), np.log(w))

    def lines(self, uv: Floats) -> tuple[Floats, Floats]:
        """The lines of sight of pixels, as `CentralCamera.lines`.

        Args:
            uv: (n, 2) pixels.

        Returns:
            The camera's centre (3,) and unit directions (n, 3) in the working frame.
        """
        directions = np.linalg.solve(self.P[:, :3], np.column_stack([uv, np.ones(len(uv))]).T).T
        return camera_centre(self.P), directions / np.linalg.norm(directions, axis=1, keepdims=True)

    @property
    def parameters(self) -> Floats:
        """(12,)."""
        return self.P.ravel()

    @property
    def sane(self) -> bool:
        """Anything goes."""
        return True

    def moved(self, step: Floats) -> ProjectiveCamera:
        """The camera with its matrix changed.

        Args:
            step: (12,) added to P, row by row.

        Returns:
            The new camera.
        """
        return ProjectiveCamera(self.P + step.reshape(3, 4))

    def in_frame(self, pose: Pose) -> ProjectiveCamera:
        """The camera that sees of a point what this one sees of `pose.apply(point)`.

        Args:
            pose: From the new frame to that of this camera.
        """
        return ProjectiveCamera(
            np.column_stack([self.P[:, :3] @ pose.rotation, self.P @ np.append(pose.translation, 1.0)])
        )

    def zoomed(self, factor: float, middle: Floats) -> ProjectiveCamera:
        """The camera whose picture is larger.

        Args:
            factor: By how much.
            middle: (2,) the pixel that stays where it is.
        """
        grow = np.diag([factor, factor, 1.0])
        grow[:2, 2] = (1 - factor) * middle
        return ProjectiveCamera(grow @ self.P)

    def prior(self, image: Image, widest: float, settings: RigModelSettings = DEFAULT_SETTINGS) -> Prior:
        """Roughly what the linear resection found; and the scale of P, which no pixel shows, stays what it is.

        Args:
            image: Not used: there is no lens model.
            widest: Not used either.
            settings: The relative sd of the entries of P.

        Returns:
            Mean (12,), which is P itself, and precision (12, 12).
        """
        scale = np.maximum(np.abs(self.P), 1e-3 * np.abs(self.P).max(axis=1, keepdims=True))
        along = (self.P / scale**2).ravel()
        own = np.diag(1 / (settings.projection_prior_relative_sd * scale.ravel()) ** 2)
        return Prior(self.P.ravel(), own + 1e4 * np.outer(along, along))

    def as_array(self) -> Floats:
        """(12,)."""
        return self.P.ravel()

    @classmethod
    def from_array(cls, array: Floats) -> ProjectiveCamera:
        """The inverse of `as_array`.

        Args:
            array: (12,) P, row by row.

        Returns:
            The camera.

        Raises:
            ValueError: The array does not have 12 numbers.
        """
        return cls(array.reshape(3, 4))
