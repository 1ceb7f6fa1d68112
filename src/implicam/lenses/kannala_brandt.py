"""The lens whose image radius is a polynomial of the angle to the axis, as OpenCV's fisheye model defines it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from implicam.lenses.base import (
    Bools,
    DistortionSds,
    Floats,
    Lens,
    check_rays,
    fit_lens,
    focal_lengths,
    pixel_from_plane,
    plane_from_pixel,
)
from implicam.lenses.polynomials import (
    divide,
    first_turning_point,
    invert_odd_polynomial,
    odd_polynomial,
    odd_polynomial_slope,
)

PERSPECTIVE_K = np.array([1 / 3, 2 / 15, 17 / 315, 62 / 2835])
"""k1 ... k4 of a perspective lens: tan(t) = t + t^3/3 + 2 t^5/15 + ..."""

PRIOR_SD, AT_EDGE_PRIOR_SD = (0.15, 0.1, 0.05, 0.02), (0.15, 0.1, 0.07, 0.05)
"""Prior sd of k1 ... k4 off that line, and of what each term may do at the edge of the image."""


@dataclass(frozen=True)
class KannalaBrandt:
    """Lens whose image radius is a polynomial of the angle to the axis; from telephoto to fisheye beyond 180°.

    fx, fy, cx, cy in pixels. Formula: OpenCV, "Fisheye camera model", with zero skew.
    """

    family: ClassVar[str] = "kannala-brandt"

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def pixel_from_camera_point(self, points: Floats) -> tuple[Floats, Bools]:
        """The pixels of points; a lens that bends so far sees points behind the camera.

        Args:
            points: (n, 3) in the camera frame, any length unit.

        Returns:
            (n, 2) pixels, NaN where there is none, and (n,) whether there is one.
        """
        at = self._polar(points)
        return pixel_from_plane(self, at.xyz[:, :2] * at.across[:, None]), at.valid

    def jacobian(self, points: Floats) -> Floats:
        """The derivative of the pixels with respect to the points.

        Args:
            points: (n, 3) in the camera frame.

        Returns:
            (n, 2, 3) in pixels per length unit of the points; NaN where there is no pixel.
        """
        return self._by_point(self._polar(points))

    def parameter_jacobian(self, points: Floats) -> Floats:
        """The derivative of the pixels with respect to fx, fy, cx, cy, k1 ... k4.

        Args:
            points: (n, 3) in the camera frame.

        Returns:
            (n, 2, 8); NaN where there is no pixel.
        """
        return self._by_parameters(self._polar(points))

    def bend(self, points: Floats) -> Bent:
        """What the lens makes of points in the plane at distance 1, and its slopes, at once in a fraction of the time.

        Args:
            points: (n, 3) in the camera frame.

        Returns:
            Of n points in columns, which are many times as fast as rows; NaN where there is no pixel.
        """
        at = self._polar(points)
        squared = at.theta * at.theta
        powers = np.empty((4, len(squared)))
        powers[0] = at.theta * squared
        for k in range(1, 4):
            np.multiply(powers[k - 1], squared, out=powers[k])
        return Bent(at.xyz[:, :2].T * at.across, self._slopes(at), at.outward.T, powers)

    def _slopes(self, at: _Polar) -> Floats:
        """(2, 3, n) of what is in the plane at distance 1, by the points."""
        x, y, z = at.xyz.T
        cos, sin = at.outward.T
        slope = odd_polynomial_slope(at.theta, self._radial) / (at.r * at.r + z * z)
        along = slope * z  # away from the axis
        out = np.empty((2, 3, len(x)))
        out[0, 0] = along * cos * cos + at.across * sin * sin
        out[1, 1] = along * sin * sin + at.across * cos * cos
        out[0, 1] = out[1, 0] = (along - at.across) * cos * sin
        out[0, 2], out[1, 2] = -slope * x, -slope * y
        return out

    def _by_point(self, at: _Polar) -> Floats:
        jacobian: Floats = np.array([self.fx, self.fy])[:, None] * self._slopes(at).transpose(2, 0, 1)
        return np.ascontiguousarray(jacobian)

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
        """The rays that pixels look along.

        Args:
            uv: (n, 2) pixels.

        Returns:
            (n, 3) unit vectors in the camera frame, NaN where there is none, and (n,) whether there is one.
        """
        bent = plane_from_pixel(self, uv)
        radius = np.hypot(*bent.T)
        theta = invert_odd_polynomial(radius, self._radial, self.critical_angle)
        rays = np.column_stack([bent * divide(np.sin(theta), radius, 1.0)[:, None], np.cos(theta)])
        return check_rays(self, rays, uv)

    def distortion_prior(self, widest: float, sds: DistortionSds | None = None) -> tuple[Floats, Floats]:
        """The prior of the distortion, as of `Lens`: about the line from an equidistant to a perspective lens, eq. (3)
        of docs/method.md.

        Args:
            widest: Radians off its axis up to which the lens is used.
            sds: Of k1 ... k4, and of what each may do at the edge. None for `PRIOR_SD` and `AT_EDGE_PRIOR_SD`.

        Returns:
            Mean (4,) and precision (4, 4) of k1 ... k4.
        """
        own, at_edge = sds or (PRIOR_SD, AT_EDGE_PRIOR_SD)
        sd = np.minimum(own, at_edge / widest ** np.array([2, 4, 6, 8]))
        covariance = np.diag(sd**2) + 0.25 * np.outer(PERSPECTIVE_K, PERSPECTIVE_K)
        return 0.5 * PERSPECTIVE_K, np.asarray(np.linalg.inv(covariance), dtype=np.float64)

    @classmethod
    def nearest(cls, lens: Lens, points: Floats) -> KannalaBrandt:
        """The lens nearest to another, as of `Lens`; one of this family is itself.

        Args:
            lens: Of any family.
            points: (n, 3) in the camera frame, all seen by that lens.

        Returns:
            A lens that sees all of them.

        Raises:
            FitError: No lens of this family was found that sees these points.
        """
        if isinstance(lens, cls):
            return lens
        uv = lens.pixel_from_camera_point(points)[0]
        fx, fy = focal_lengths(lens)
        starts = [cls(fx, fy, lens.cx, lens.cy), *(cls._linear(lens, points, uv, terms) for terms in (1, 4))]
        return fit_lens(starts, points, uv)

    @classmethod
    def _linear(cls, lens: Lens, points: Floats, uv: Floats, terms: int) -> KannalaBrandt:
        """By linear least squares, with another lens's axis and shape of pixels, and the first terms of k1 ... k4; it
        may fold before it sees all the points."""
        fx, fy = focal_lengths(lens)
        r = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(r, points[:, 2])
        outward = points[:, :2] * divide(1.0, r, 0.0)[:, None]
        flat, target = outward.ravel(), ((uv - [lens.cx, lens.cy]) / [1.0, fy / fx]).ravel()
        # (u - cx) r / x = fx (theta + k1 theta³ + ...): linear in fx, fx k1, ...
        powers = np.repeat(theta, 2)[:, None] ** (2 * np.arange(terms + 1) + 1)
        a = np.linalg.lstsq(flat[:, None] * powers, target, rcond=None)[0]
        k = (a[1:] / a[0]).tolist() if a[0] else []
        return cls(float(a[0]), float(a[0] * fy / fx), lens.cx, lens.cy, *k)

    @property
    def _radial(self) -> tuple[float, ...]:
        return self.k1, self.k2, self.k3, self.k4

    @cached_property
    def critical_angle(self) -> float:
        """The angle to the axis, in radians, up to which the lens has an answer."""
        return min(first_turning_point(self._radial), float(np.pi))

    def _polar(self, points: Floats) -> _Polar:
        r = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(r, points[:, 2])
        valid = (theta < self.critical_angle) & points.any(axis=1)
        xyz = points
        if not valid.all():
            xyz = np.where(valid[:, None], points, np.nan)
            r, theta = np.where(valid, r, np.nan), np.where(valid, theta, np.nan)
        bent = odd_polynomial(theta, self._radial)
        if (r > 0).all():
            return _Polar(xyz, valid, r, theta, bent, bent / r, xyz[:, :2] / r[:, None])
        across = divide(bent, r, 1 / np.where(r > 0, 1.0, xyz[:, 2]))
        outward = np.column_stack([divide(xyz[:, 0], r, 1.0), divide(xyz[:, 1], r, 0.0)])  # on the axis any will do
        return _Polar(xyz, valid, r, theta, bent, across, outward)


class Bent(NamedTuple):
    """What a lens makes of n points in the plane at distance 1: xy (2, n); by_point (2, 3, n) its derivative; outward
    (2, n) the direction away from the axis; powers (4, n) of the angle to it, third to ninth: outward times powers is
    the derivative by k1 ... k4."""

    xy: Floats
    by_point: Floats
    outward: Floats
    powers: Floats


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
