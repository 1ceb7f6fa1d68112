"""One camera model for any camera: any lens, pixels that are not square, a tilted or cropped sensor, a mirror.

    pixel = centre + focal B y,    y = m / (1 + tilt . m),    m = diag(s, 1) d(alpha) (X / a, Y / a)

with (X, Y, Z) = R x + T, a = hypot(X, Y), alpha = atan2(a, Z), d the Kannala-Brandt polynomial, B = exp([[p, q],
[q, -p]]) the shape of the pixels (symmetric, determinant 1) and s = -1 where the picture is mirrored: eq. (2) of
docs/method.md. `tilt` is a projective map of the image plane: a tilted sensor (Scheimpflug), an oblique window. With it
every linear projection is such a camera.

The parameters are chosen so that a telephoto lens is an ordinary case (weak perspective, Hartley & Zisserman, section
6.3): focal length over distance, the inverse distance rho of the working frame's origin, where that origin is seen
across the axis, and the rotation about it. Distortion is counted in the image and not in the angle, so that it stays
what it is while rho changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from implicam.geometry import Floats, Pose, rotation_from_vector
from implicam.lenses import PERSPECTIVE_K, KannalaBrandt
from implicam.rig_model.camera import CentralCamera, ProjectiveCamera, Sight, View

MIN_FOCAL_PX = 0.1
"""A picture smaller than a pixel: every point is in one place, which fits anything equally badly."""

MAX_SHAPE = 3.0
"""Of p and q: pixels 400 times as long as wide are none."""

MIN_RHO = 5e-4
"""Of the inverse distance, in the working frame: farther away nothing shows it, and the evidence loses its digits."""

PARAMETERS = (
    "log_scale", "p", "q", "tilt_u", "tilt_v", "cu", "cv", "kappa1", "kappa2", "kappa3", "kappa4", "rho", "across_x",
    "across_y", "turn_x", "turn_y", "turn_z",
)  # fmt: skip
"""A step's numbers, in order: log(focal * rho); shape of the pixels; tilt; principal point; distortion in the image;
1 / distance of the origin; where it is across the axis, as an arc; rotation about it."""

SHAPE, TILT, CENTRE, KAPPA, RHO = slice(1, 3), slice(3, 5), slice(5, 7), slice(7, 11), 11
_POWERS = np.array([2.0, 4.0, 6.0, 8.0])


@dataclass(frozen=True, eq=False)
class GeneralCamera:
    """focal px, the geometric mean of the two directions; shape (2,) p and q; tilt (2,); centre (2,) px; k (4,);
    mirrored; pose camera_from_world, where the world is the working frame."""

    focal: float
    shape: Floats
    tilt: Floats
    centre: Floats
    k: Floats
    mirrored: bool
    pose: Pose

    kind: ClassVar[str] = "general"
    size: ClassVar[int] = len(PARAMETERS)

    @cached_property
    def rho(self) -> float:
        """1 / distance of the working frame's origin."""
        return 1 / float(np.linalg.norm(self.pose.translation))

    @cached_property
    def parameters(self) -> Floats:
        """(17,) what the prior is about; the rotation has no prior and is zero here."""
        rho = self.rho
        kappa = (self.k - 0.5 * PERSPECTIVE_K) * rho**_POWERS
        direction = self.pose.translation * rho
        sine = float(np.hypot(*direction[:2]))
        arc = np.arctan2(sine, direction[2]) / (sine * rho) if sine > 0 else 1 / rho
        log_scale = np.log(self.focal * rho)
        return np.concatenate(
            [[log_scale], self.shape, self.tilt, self.centre, kappa, [rho], direction[:2] * arc, np.zeros(3)]
        )

    @property
    def sane(self) -> bool:
        """Not inside out, and every number finite."""
        whole = np.abs(self.shape).max() < MAX_SHAPE and np.abs(self.tilt).max() < 1e3
        return bool(MIN_FOCAL_PX < self.focal < 1e12 and whole)

    def moved(self, step: Floats) -> GeneralCamera:
        """The camera with its parameters changed; its inverse distance stays `MIN_RHO` at least.

        Args:
            step: (17,) as `PARAMETERS` names them.

        Returns:
            The new camera; whether it is `sane` is not checked.
        """
        x = self.parameters + step
        rho = max(float(x[RHO]), MIN_RHO)
        across = x[12:14]
        angle = rho * float(np.hypot(*across))
        translation = np.append(across * _sinc(angle), np.cos(angle) / rho)
        turn = rotation_from_vector(step[14:])
        return GeneralCamera(
            float(np.exp(min(x[0], 50.0)) / rho),
            x[SHAPE],
            x[TILT],
            x[CENTRE],
            0.5 * PERSPECTIVE_K + x[KAPPA] / rho**_POWERS,
            self.mirrored,
            Pose(turn @ self.pose.rotation, translation),
        )

    def with_shape(self, shape: Floats, tilt: Floats) -> GeneralCamera:
        """The camera with other pixels.

        Args:
            shape: (2,) p and q.
            tilt: (2,) of the image plane.

        Returns:
            The new camera.
        """
        return replace(self, shape=shape, tilt=tilt)

    def in_frame(self, pose: Pose) -> GeneralCamera:
        """The camera that sees of a point what this one sees of `pose.apply(point)`.

        Args:
            pose: From the new frame to that of this camera.
        """
        return replace(self, pose=self.pose @ pose)

    def zoomed(self, factor: float, middle: Floats) -> GeneralCamera:
        """The camera whose picture is larger.

        Args:
            factor: By how much.
            middle: (2,) the pixel that stays where it is.
        """
        return replace(self, focal=factor * self.focal, centre=middle + factor * (self.centre - middle))

    def pixel(self, points: Floats) -> Floats:
        """Where the camera sees points.

        Args:
            points: (n, 3) in the working frame.

        Returns:
            (n, 2) pixels, NaN where there is none.
        """
        return self._image(self._lens.pixel_from_camera_point(self.pose.apply(points))[0])[0]

    def view(self, points: Floats) -> View:
        """Everything that a camera sees of points, at once.

        Args:
            points: (n, 3) in the working frame.

        Returns:
            Pixels and log distance of each point, and their derivatives; NaN where the lens has no answer.
        """
        rotation = self.pose.rotation
        turned = rotation @ points.T  # points in columns: arithmetic on rows of two or three takes many times as long
        there = turned + self.pose.translation[:, None]
        bent = self._lens.bend(there.T)
        uv, y, w = self._image(bent.xy.T)
        y = y.T
        by_y, by_p, by_q = (self.focal * each for each in self.pixel_shape)
        away = by_y @ y
        by_m = by_y[:, :, None] - away[:, None] * self.tilt[:, None]  # y by m: (I - y tilt^T) / w
        by_m /= w
        if self.mirrored:
            by_m[:, 0] *= -1
        slope = by_m[:, :1] * bent.by_point[0] + by_m[:, 1:] * bent.by_point[1]
        outward = by_m[:, 0] * bent.outward[0] + by_m[:, 1] * bent.outward[1]
        rho = self.rho
        by_across, by_rho = self.translation_slopes()
        rest = np.column_stack([by_rho, by_across, rotation]).T @ slope
        out = np.empty((2, self.size, len(points)))
        out[:, 0] = away
        out[:, 1], out[:, 2] = by_p @ y, by_q @ y
        out[:, TILT] = -away[:, None] * y
        out[:, CENTRE] = np.eye(2)[:, :, None]
        lost = np.isnan(away[0])
        if lost.any():
            out[:, CENTRE, lost] = np.nan
        out[:, KAPPA] = outward[:, None] * (bent.powers * rho ** -_POWERS[:, None])
        by_own_rho = (_POWERS * (self.k - 0.5 * PERSPECTIVE_K) / rho) @ bent.powers
        out[:, RHO] = rest[:, 0] - away / rho - outward * by_own_rho
        out[:, 12:14] = rest[:, 1:3]
        for axis in range(3):  # slope . (omega x turned)
            one, other = (axis + 1) % 3, (axis + 2) % 3
            out[:, 14 + axis] = turned[one] * slope[:, other] - turned[other] * slope[:, one]
        squared = np.sum(there**2, axis=0)
        return View(
            uv,
            0.5 * np.log(squared),
            np.ascontiguousarray(out.transpose(2, 0, 1)),
            np.ascontiguousarray(rest[:, 3:].transpose(2, 0, 1)),
            np.ascontiguousarray((rotation.T @ there / squared).T),
        )

    def sight(self, points: Floats) -> Sight:
        """Pixels and log distance of `view`, in a fraction of its time.

        Args:
            points: (n, 3) in the working frame.
        """
        there = self.pose.apply(points)
        uv = self._image(self._lens.pixel_from_camera_point(there)[0])[0]
        return Sight(uv, 0.5 * np.log(np.sum(there**2, axis=1)))

    def lines(self, uv: Floats) -> tuple[Floats, Floats]:
        """The lines of sight of pixels.

        Args:
            uv: (n, 2) pixels.

        Returns:
            The camera's centre (3,) and unit directions (n, 3) in the working frame, NaN for none.
        """
        y = np.linalg.solve(self.focal * self.pixel_shape[0], (uv - self.centre).T).T
        w = 1 - y @ self.tilt
        m = y / np.where(w > 0, w, np.nan)[:, None]
        if self.mirrored:
            m = m * [-1.0, 1.0]
        rays, _ = self._lens.ray_from_pixel(m)
        return self.pose.centre, rays @ self.pose.rotation

    def as_array(self) -> Floats:
        """(24,) focal, shape, tilt, centre, k, +1 or -1 if mirrored, rotation, translation."""
        sign = -1.0 if self.mirrored else 1.0
        return np.concatenate(
            [
                [self.focal],
                self.shape,
                self.tilt,
                self.centre,
                self.k,
                [sign],
                self.pose.rotation.ravel(),
                self.pose.translation,
            ]
        )

    @classmethod
    def from_array(cls, array: Floats) -> GeneralCamera:
        """The inverse of `as_array`.

        Args:
            array: (24,) focal, shape, tilt, centre, k, +1 or -1 if mirrored, rotation, translation.

        Returns:
            The camera.

        Raises:
            ValueError: Its rotation, focal length, mirror sign or place is none.
        """
        rotation = array[12:21].reshape(3, 3)
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
            raise ValueError("a camera's rotation is not one")
        if not array[0] > 0 or abs(array[11]) != 1 or not np.linalg.norm(array[21:]) > 0:
            raise ValueError("a camera's focal length, mirror sign or place is none")
        pose = Pose(rotation, array[21:])
        return cls(float(array[0]), array[1:3], array[3:5], array[5:7], array[7:11], bool(array[11] < 0), pose)

    @classmethod
    def from_central(cls, camera: CentralCamera, *, mirrored_about: float | None = None) -> GeneralCamera:
        """The same camera as a Kannala-Brandt `CentralCamera`.

        Args:
            camera: It; its lens must be of this family.
            mirrored_about: The u, in pixels, at which its pictures, which were turned left for right, are turned back;
                None where they were not.

        Returns:
            The camera, with no tilt and no skew.
        """
        lens = camera.lens
        assert isinstance(lens, KannalaBrandt)
        p = 0.5 * np.log(lens.fx / lens.fy)
        cx = lens.cx if mirrored_about is None else 2 * mirrored_about - lens.cx
        return cls(
            float(np.sqrt(lens.fx * lens.fy)),
            np.array([p, 0.0]),
            np.zeros(2),
            np.array([cx, lens.cy]),
            np.array([lens.k1, lens.k2, lens.k3, lens.k4]),
            mirrored_about is not None,
            camera.pose,
        )

    def as_central(self) -> CentralCamera:
        """The Kannala-Brandt camera that is left when mirror, skew and tilt are not there."""
        fx, fy = self.focal * np.exp([self.shape[0], -self.shape[0]])
        lens = KannalaBrandt(float(fx), float(fy), *map(float, self.centre), *map(float, self.k))
        return CentralCamera(lens, self.pose)

    @cached_property
    def pixel_shape(self) -> tuple[Floats, Floats, Floats]:
        """B = exp([[p, q], [q, -p]]) of eq. (2), and its derivatives by p and q, (2, 2) each."""
        return _pixel_shape(self.shape)

    @cached_property
    def _lens(self) -> KannalaBrandt:
        return KannalaBrandt(1.0, 1.0, 0.0, 0.0, *self.k.tolist())

    def _image(self, bent: Floats) -> tuple[Floats, Floats, Floats]:
        """Pixels (n, 2), y (n, 2) and 1 + tilt . m (n,) of what the lens makes of a point (n, 2)."""
        m = bent * [-1.0, 1.0] if self.mirrored else bent
        w = 1 + m @ self.tilt
        w = np.where(w > 0, w, np.nan)
        y = m / w[:, None]
        return self.centre + self.focal * (y @ self.pixel_shape[0].T), y, w

    def translation_slopes(self) -> tuple[Floats, Floats]:
        """How the translation depends on where the origin is across the axis (3, 2), and on rho (3,)."""
        rho = self.rho
        direction = self.pose.translation * rho
        sine, cosine = float(np.hypot(*direction[:2])), float(direction[2])
        angle = np.arctan2(sine, cosine)
        outward = direction[:2] / sine if sine > 0 else np.array([1.0, 0.0])
        sideways = np.array([-outward[1], outward[0]])
        radial = np.append(outward * cosine, -sine)
        around = np.append(sideways * _sinc(angle), 0.0)
        by_across = np.outer(radial, outward) + np.outer(around, sideways)
        arc = angle / rho
        by_rho = radial * arc / rho - direction / rho**2
        return by_across, by_rho


AnyCamera = CentralCamera | ProjectiveCamera | GeneralCamera


def _sinc(angle: float) -> float:
    return float(np.sin(angle)) / angle if angle else 1.0


def _pixel_shape(shape: Floats) -> tuple[Floats, Floats, Floats]:
    """B = exp([[p, q], [q, -p]]) and its derivatives by p and q, (2, 2) each."""
    p, q = shape
    M = np.array([[p, q], [q, -p]])
    h2 = float(p * p + q * q)
    h = np.sqrt(h2)
    cosh, sinhc = np.cosh(h), np.sinh(h) / h if h > 0 else 1.0
    bend = (cosh - sinhc) / h2 if h > 1e-4 else 1 / 3 + h2 / 30
    B = cosh * np.eye(2) + sinhc * M
    by_p = sinhc * p * np.eye(2) + bend * p * M + sinhc * np.diag([1.0, -1.0])
    by_q = sinhc * q * np.eye(2) + bend * q * M + sinhc * np.array([[0.0, 1.0], [1.0, 0.0]])
    return B, by_p, by_q
