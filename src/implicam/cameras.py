"""Lens models: which pixel a point in front of a camera falls on, and which ray a pixel looks along.

Camera frame: x right, y down, z forward. Pixels (u, v), (0, 0) the centre of the top-left pixel. Parameters are named
and defined as in OpenCV, and the pixels agree with OpenCV to rounding wherever both are defined. A lens without an
answer says `valid = False` and gives NaN: a point behind the camera, or so far off the axis that the distortion
polynomial has turned back and would put it on top of another point.

To add a lens:
  1. write a frozen dataclass whose fields are its parameters, in OpenCV's order and names if it has any;
  2. give it `pixel_from_camera_point`, `jacobian`, `parameter_jacobian` and `ray_from_pixel`, with the contracts of
     `BrownConrady`;
  3. add it to `Lens` below;
  4. add it to `LENSES` in tests/test_cameras.py, where one contract test runs over every lens.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

FARTHEST = 1e12
"""Times the focal length off the axis: as good as beside the camera, and safe from overflow."""

ROUND_TRIP = 1e-6
"""Pixels. A ray that does not come back to its pixel within this (and rounding, far off the image) is no answer."""


@dataclass(frozen=True)
class BrownConrady:
    """Perspective lens with radial (k1, k2, k3) and decentring (p1, p2) distortion, for views up to about 100°.

    fx, fy, cx, cy in pixels. Formula: OpenCV, "Camera Calibration and 3D Reconstruction", detailed description.
    """

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
        """Pixels (n, 2) of points (n, 3) in the camera frame, any length unit; and (n,) where they exist, else NaN."""
        xy, valid = self._plane_from_point(points)
        return _pixel_from_plane(self, self._distort(xy)), valid

    def jacobian(self, points: Floats) -> Floats:
        """(n, 2, 3) derivative of the pixels with respect to the points; NaN where there is no pixel."""
        xy, valid = self._plane_from_point(points)
        z = np.where(valid, points[:, 2], np.nan)
        plane = np.zeros((len(xy), 2, 3))  # d (x/z, y/z) / d (x, y, z)
        plane[:, 0, 0] = plane[:, 1, 1] = 1 / z
        plane[:, :, 2] = -xy / z[:, None]
        focal = np.array([self.fx, self.fy])
        jacobian: Floats = focal[:, None] * (self._distort_slope(xy) @ plane)
        return jacobian

    def parameter_jacobian(self, points: Floats) -> Floats:
        """(n, 2, 9) derivative of the pixels with respect to fx, fy, cx, cy, k1, k2, p1, p2, k3; NaN for no pixel."""
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
        """Unit rays (n, 3) in the camera frame of pixels (n, 2); and (n,) where they exist, else NaN."""
        distorted = _plane_from_pixel(self, uv)
        radius = np.hypot(*distorted.T)
        # Decentring pushes some pixels beyond the radial polynomial's reach: start them just inside its fold.
        within = np.minimum(radius, 0.999 * self._reach)
        undistorted = _invert_odd(within, self._radial, self._critical_radius)
        xy = distorted * _ratio(undistorted, radius, 1.0)[:, None]
        for _ in range(20):  # decentring is small: Newton's method from the radial answer
            xy = xy - _solve2(self._distort_slope(xy), self._distort(xy) - distorted)
        return _checked_rays(self, np.column_stack([xy, np.ones(len(xy))]), uv)

    @property
    def _radial(self) -> tuple[float, ...]:
        return self.k1, self.k2, self.k3

    @cached_property
    def _critical_radius(self) -> float:
        return _first_turn(self._radial)

    @cached_property
    def _reach(self) -> float:
        """The largest radius in the image plane, without decentring."""
        turn = self._critical_radius
        return float(_odd(np.array(turn), self._radial)) if np.isfinite(turn) else turn

    def _plane_from_point(self, points: Floats) -> tuple[Floats, Bools]:
        """Undistorted (x/z, y/z), NaN where the lens has no answer."""
        front = points[:, 2] > 0
        xy = points[:, :2] / np.where(front, points[:, 2], np.nan)[:, None]
        xy[~(np.abs(xy).max(axis=1) < FARTHEST)] = np.nan
        valid = np.hypot(*xy.T) < self._critical_radius
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


@dataclass(frozen=True)
class KannalaBrandt:
    """Lens whose image radius is a polynomial of the angle to the axis; from telephoto to fisheye beyond 180°.

    fx, fy, cx, cy in pixels. Formula: OpenCV, "Fisheye camera model", with zero skew.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def pixel_from_camera_point(self, points: Floats) -> tuple[Floats, Bools]:
        """As `BrownConrady.pixel_from_camera_point`; a lens that bends so far sees points behind the camera."""
        at = self._polar(points)
        return _pixel_from_plane(self, at.xyz[:, :2] * at.across[:, None]), at.valid

    def jacobian(self, points: Floats) -> Floats:
        """(n, 2, 3) derivative of the pixels with respect to the points; NaN where there is no pixel."""
        return self._by_point(self._polar(points))

    def parameter_jacobian(self, points: Floats) -> Floats:
        """(n, 2, 8) derivative of the pixels with respect to fx, fy, cx, cy, k1 ... k4; NaN where there is no pixel."""
        return self._by_parameters(self._polar(points))

    def pixel_and_slopes(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Pixels, `jacobian` and `parameter_jacobian` at once, in half the time."""
        at = self._polar(points)
        pixel = _pixel_from_plane(self, at.xyz[:, :2] * at.across[:, None])
        return pixel, self._by_point(at), self._by_parameters(at)

    def _by_point(self, at: _Polar) -> Floats:
        x, y, z = at.xyz.T
        cos, sin = at.outward.T
        slope = _odd_slope(at.theta, self._radial) / (at.r * at.r + z * z)
        along = slope * z  # away from the axis
        out = np.empty((len(x), 2, 3))
        out[:, 0, 0] = along * cos * cos + at.across * sin * sin
        out[:, 1, 1] = along * sin * sin + at.across * cos * cos
        out[:, 0, 1] = out[:, 1, 0] = (along - at.across) * cos * sin
        out[:, 0, 2], out[:, 1, 2] = -slope * x, -slope * y
        jacobian: Floats = np.array([self.fx, self.fy])[:, None] * out
        return jacobian

    def _by_parameters(self, at: _Polar) -> Floats:
        out = np.zeros((len(at.xyz), 2, 8))
        diagonal = at.outward * at.bent[:, None]
        out[:, 0, 0], out[:, 1, 1] = diagonal.T
        out[:, 0, 2] = out[:, 1, 3] = np.where(np.isnan(at.theta), np.nan, 1.0)
        power = at.outward * [self.fx, self.fy] * at.theta[:, None]
        squared = (at.theta * at.theta)[:, None]
        for k in range(4, 8):
            power = power * squared
            out[:, :, k] = power
        return out

    def ray_from_pixel(self, uv: Floats) -> tuple[Floats, Bools]:
        """Unit rays (n, 3) in the camera frame of pixels (n, 2); and (n,) where they exist, else NaN."""
        bent = _plane_from_pixel(self, uv)
        radius = np.hypot(*bent.T)
        theta = _invert_odd(radius, self._radial, self._critical_angle)
        rays = np.column_stack([bent * _ratio(np.sin(theta), radius, 1.0)[:, None], np.cos(theta)])
        return _checked_rays(self, rays, uv)

    @property
    def _radial(self) -> tuple[float, ...]:
        return self.k1, self.k2, self.k3, self.k4

    @cached_property
    def _critical_angle(self) -> float:
        return min(_first_turn(self._radial), float(np.pi))

    def _polar(self, points: Floats) -> _Polar:
        r = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(r, points[:, 2])
        valid = (theta < self._critical_angle) & points.any(axis=1)
        xyz = points
        if not valid.all():
            xyz = np.where(valid[:, None], points, np.nan)
            r, theta = np.where(valid, r, np.nan), np.where(valid, theta, np.nan)
        bent = _odd(theta, self._radial)
        if (r > 0).all():
            return _Polar(xyz, valid, r, theta, bent, bent / r, xyz[:, :2] / r[:, None])
        across = _ratio(bent, r, 1 / np.where(r > 0, 1.0, xyz[:, 2]))
        outward = np.column_stack([_ratio(xyz[:, 0], r, 1.0), _ratio(xyz[:, 1], r, 0.0)])  # on the axis any will do
        return _Polar(xyz, valid, r, theta, bent, across, outward)


class _Polar(NamedTuple):
    """Of points xyz (n, 3), NaN where not valid (n,): how far off the axis r, at which angle theta, the image's radius
    bent, bent / r, and the direction away from the axis (n, 2)."""

    xyz: Floats
    valid: Bools
    r: Floats
    theta: Floats
    bent: Floats
    across: Floats
    outward: Floats


Lens = BrownConrady | KannalaBrandt


def _pixel_from_plane(lens: Lens, xy: Floats) -> Floats:
    return xy * [lens.fx, lens.fy] + [lens.cx, lens.cy]


def _plane_from_pixel(lens: Lens, uv: Floats) -> Floats:
    plane: Floats = (uv - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
    return plane


def _checked_rays(lens: Lens, rays: Floats, uv: Floats) -> tuple[Floats, Bools]:
    """Unit rays, NaN where the lens does not bring them back to their pixel."""
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    back, valid = lens.pixel_from_camera_point(rays)
    valid &= (np.abs(back - uv) < ROUND_TRIP + 1e-12 * np.abs(uv)).all(axis=1)
    return np.where(valid[:, None], rays, np.nan), valid


def _odd(t: Floats, k: tuple[float, ...]) -> Floats:
    """The distortion polynomial t (1 + k1 t² + k2 t⁴ + ...)."""
    return t * _polynomial([*k[::-1], 1.0], t * t)


def _odd_slope(t: Floats, k: tuple[float, ...]) -> Floats:
    return _polynomial(_slope_in_square(k), t * t)


def _polynomial(coefficients: list[float], x: Floats) -> Floats:
    """Horner's rule, the highest coefficient first; NumPy's is as long in its preparations."""
    value = coefficients[0] * x + coefficients[1]
    for c in coefficients[2:]:
        value = value * x + c
    return value


def _slope_in_square(k: tuple[float, ...]) -> list[float]:
    """Coefficients, highest first, of the polynomial's derivative 1 + 3 k1 t² + 5 k2 t⁴ + ... in t²."""
    return [(2 * i + 3) * k[i] for i in reversed(range(len(k)))] + [1.0]


def _first_turn(k: tuple[float, ...]) -> float:
    """The smallest positive t where the polynomial stops growing; infinite where it never does."""
    if min(k) >= 0:
        return float("inf")
    roots = np.roots(_slope_in_square(k))
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if real.size else float("inf")


def _invert_odd(value: Floats, k: tuple[float, ...], upper: float) -> Floats:
    """The t in [0, upper) where the polynomial is `value` >= 0, or NaN: Newton's method kept inside a bracket."""
    low, high = np.zeros_like(value), np.full_like(value, upper if np.isfinite(upper) else 1.0)
    if not np.isfinite(upper):
        for _ in range(60):  # grows without end, so some power of two is beyond
            high = np.where(_odd(high, k) < value, 2 * high, high)
    t = np.minimum(value, 0.5 * high)
    for _ in range(60):
        error = _odd(t, k) - value
        low, high = np.where(error <= 0, t, low), np.where(error >= 0, t, high)
        slope = _odd_slope(t, k)
        newton = t - error / np.where(slope > 0, slope, np.nan)
        t = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
    beyond = ~(value <= _odd(np.full_like(value, upper), k)) if np.isfinite(upper) else ~np.isfinite(value)
    return np.where(beyond, np.nan, t)


def _ratio(a: Floats, b: Floats, at_zero: Floats | float) -> Floats:
    """`a / b`, and its limit `at_zero` where b is zero."""
    zero = b == 0
    return np.where(zero, at_zero, a / np.where(zero, 1.0, b))


def _solve2(matrices: Floats, vectors: Floats) -> Floats:
    """Solve (n, 2, 2) x = (n, 2) by Cramer's rule; a singular matrix gives NaN."""
    (a, b), (c, d) = matrices[:, 0].T, matrices[:, 1].T
    det = a * d - b * c
    x, y = vectors.T
    return np.column_stack([d * x - b * y, a * y - c * x]) / np.where(det == 0, np.nan, det)[:, None]
