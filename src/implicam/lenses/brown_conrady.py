"""The perspective lens with radial and decentring distortion, as OpenCV names and defines its parameters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from implicam.errors import FitError
from implicam.lenses.base import Bools, DistortionSds, Floats, Lens, check_rays, pixel_from_plane, plane_from_pixel
from implicam.lenses.polynomials import divide, first_turning_point, invert_odd_polynomial, odd_polynomial, solve_2x2

MAX_FOCAL_LENGTHS_OFF_AXIS = 1e12
"""As good as beside the camera, and safe from overflow."""

MAX_ANGLE_RAD = np.radians(75.0)
"""Off the axis; a perspective lens is not tried beyond."""

PRIOR_SD, AT_EDGE_PRIOR_SD = (0.5, 0.5, 0.3, 0.005), (0.4, 0.3, 0.15)
"""Prior sd of k1, k2, k3, p1 and p2, about none; and of what k1, k2, k3 may each do at the edge of the image."""


@dataclass(frozen=True)
class BrownConrady:
    """Perspective lens with radial (k1, k2, k3) and decentring (p1, p2) distortion, for views up to about 100°.

    fx, fy, cx, cy in pixels. Formula: OpenCV, "Camera Calibration and 3D Reconstruction", detailed description.
    """

    family: ClassVar[str] = "brown-conrady"

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def pixel_from_camera_point(self, points: Floats) -> tuple[Floats, Bools]:
        """The pixels of points.

        Args:
            points: (n, 3) in the camera frame, any length unit.

        Returns:
            (n, 2) pixels, NaN where there is none, and (n,) whether there is one.
        """
        xy, valid = self._plane_from_point(points)
        return pixel_from_plane(self, self._distort(xy)), valid

    def jacobian(self, points: Floats) -> Floats:
        """The derivative of the pixels with respect to the points.

        Args:
            points: (n, 3) in the camera frame.

        Returns:
            (n, 2, 3) in pixels per length unit of the points; NaN where there is no pixel.
        """
        xy, valid = self._plane_from_point(points)
        z = np.where(valid, points[:, 2], np.nan)
        plane = np.zeros((len(xy), 2, 3))  # d (x/z, y/z) / d (x, y, z)
        plane[:, 0, 0] = plane[:, 1, 1] = 1 / z
        plane[:, :, 2] = -xy / z[:, None]
        focal = np.array([self.fx, self.fy])
        jacobian: Floats = focal[:, None] * (self._distort_slope(xy) @ plane)
        return jacobian

    def parameter_jacobian(self, points: Floats) -> Floats:
        """The derivative of the pixels with respect to fx, fy, cx, cy, k1, k2, p1, p2, k3.

        Args:
            points: (n, 3) in the camera frame.

        Returns:
            (n, 2, 9); NaN where there is no pixel.
        """
        xy, _ = self._plane_from_point(points)
        x, y = xy.T
        r2 = x * x + y * y
        distorted = self._distort(xy)
        out = np.zeros((len(xy), 2, 9))
        out[:, 0, 0], out[:, 1, 1] = distorted.T
        out[:, 0, 2] = out[:, 1, 3] = np.where(np.isnan(x), np.nan, 1.0)
        focal = np.array([self.fx, self.fy])
        for column, power in ((4, 1), (5, 2), (8, 3)):
            out[:, :, column] = focal * xy * (r2**power)[:, None]
        out[:, :, 6] = focal * np.column_stack([2 * x * y, r2 + 2 * y * y])
        out[:, :, 7] = focal * np.column_stack([r2 + 2 * x * x, 2 * x * y])
        return out

    def ray_from_pixel(self, uv: Floats) -> tuple[Floats, Bools]:
        """The rays that pixels look along.

        Args:
            uv: (n, 2) pixels.

        Returns:
            (n, 3) unit vectors in the camera frame, NaN where there is none, and (n,) whether there is one.
        """
        distorted = plane_from_pixel(self, uv)
        radius = np.hypot(*distorted.T)
        # Decentring pushes some pixels beyond the radial polynomial's reach: start them just inside its fold.
        within = np.minimum(radius, 0.999 * self._reach)
        undistorted = invert_odd_polynomial(within, self._radial, self.critical_radius)
        xy = distorted * divide(undistorted, radius, 1.0)[:, None]
        for _ in range(20):  # decentring is small: Newton's method from the radial answer
            xy = xy - solve_2x2(self._distort_slope(xy), self._distort(xy) - distorted)
        return check_rays(self, np.column_stack([xy, np.ones(len(xy))]), uv)

    def distortion_prior(self, widest: float, sds: DistortionSds | None = None) -> tuple[Floats, Floats]:
        """The prior of the distortion, as of `Lens`: independent, about no distortion.

        Args:
            widest: Radians off its axis up to which the lens is used; beyond 1.5 it counts as 1.5.
            sds: Of k1, k2, k3, and fourth of both p1 and p2; and of what k1, k2, k3 may do at the edge. None for
                `PRIOR_SD` and `AT_EDGE_PRIOR_SD`.

        Returns:
            Mean (5,), zero, and precision (5, 5) of k1, k2, p1, p2, k3.
        """
        own, at_edge = sds or (PRIOR_SD, AT_EDGE_PRIOR_SD)
        k1, k2, k3 = np.minimum(own[:3], at_edge / np.tan(min(widest, 1.5)) ** np.array([2, 4, 6]))
        return np.zeros(5), np.diag(1 / np.array([k1, k2, own[3], own[3], k3]) ** 2)

    @classmethod
    def nearest(cls, lens: Lens, points: Floats) -> BrownConrady:
        """The lens nearest to another, as of `Lens`; by linear least squares, with k1 and k2 only: a third term invites
        folds.

        Args:
            lens: Of any family.
            points: (n, 3) in the camera frame, all seen by that lens.

        Returns:
            A lens that sees all of them.

        Raises:
            FitError: The points are too far off the axis for a perspective lens, or none was found that sees them.
        """
        cure = "use kannala-brandt, or auto, for this camera"
        widest = float(np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2]).max())
        if not widest < MAX_ANGLE_RAD:
            raise FitError(f"a perspective lens cannot look {np.degrees(widest):.0f}° off its axis.", fix=cure)
        xy = points[:, :2] / points[:, 2:]
        uv = lens.pixel_from_camera_point(points)[0]
        centre, shape = np.array([lens.cx, lens.cy]), np.array([1.0, lens.fy / lens.fx])
        flat, target = xy.ravel(), ((uv - centre) / shape).ravel()
        # u - cx = fx x (1 + k1 r² + k2 r⁴): linear in fx, fx k1, fx k2
        powers = np.repeat(np.sum(xy**2, axis=1), 2)[:, None] ** np.arange(3)
        a = np.linalg.lstsq(flat[:, None] * powers, target, rcond=None)[0]
        for k in ((a[1] / a[0], a[2] / a[0]), (a[1] / a[0], 0.0), (0.0, 0.0)):
            found = cls(float(a[0]), float(a[0] * shape[1]), *centre.tolist(), *map(float, k))
            if a[0] > 0 and found.pixel_from_camera_point(points)[1].all():
                return found
        raise FitError("no perspective lens sees these points.", fix=cure)

    @property
    def _radial(self) -> tuple[float, ...]:
        return self.k1, self.k2, self.k3

    @cached_property
    def critical_radius(self) -> float:
        """Tangent of the angle to the axis up to which the radial distortion grows; infinite where it always does."""
        return first_turning_point(self._radial)

    @cached_property
    def _reach(self) -> float:
        """The largest radius in the image plane, without decentring."""
        turn = self.critical_radius
        return float(odd_polynomial(np.array(turn), self._radial)) if np.isfinite(turn) else turn

    def _plane_from_point(self, points: Floats) -> tuple[Floats, Bools]:
        """Undistorted (x/z, y/z), NaN where the lens has no answer."""
        front = points[:, 2] > 0
        xy = points[:, :2] / np.where(front, points[:, 2], np.nan)[:, None]
        xy[~(np.abs(xy).max(axis=1) < MAX_FOCAL_LENGTHS_OFF_AXIS)] = np.nan
        valid = np.hypot(*xy.T) < self.critical_radius
        # Decentring can fold the image a little before the radial polynomial turns back: there the determinant is zero.
        slope = self._distort_slope(xy)
        valid &= slope[:, 0, 0] * slope[:, 1, 1] > slope[:, 0, 1] ** 2
        xy[~valid] = np.nan
        return xy, valid

    def _distort(self, xy: Floats) -> Floats:
        x, y = xy.T
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return np.column_stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
            ]
        )

    def _distort_slope(self, xy: Floats) -> Floats:
        """(n, 2, 2) derivative of `_distort`; symmetric."""
        x, y = xy.T
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = 2 * (self.k1 + r2 * (2 * self.k2 + r2 * 3 * self.k3))  # d radial / d(x, y) = slope (x, y)
        out = np.empty((len(xy), 2, 2))
        out[:, 0, 0] = radial + slope * x * x + 2 * self.p1 * y + 6 * self.p2 * x
        out[:, 1, 1] = radial + slope * y * y + 6 * self.p1 * y + 2 * self.p2 * x
        out[:, 0, 1] = out[:, 1, 0] = slope * x * y + 2 * self.p1 * x + 2 * self.p2 * y
        return out
