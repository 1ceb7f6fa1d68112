"""A lens written by the recipe "A lens" of CONTRIBUTING.md alone: the equisolid fisheye, with four distortion terms.

It has as many parameters as Kannala-Brandt's lens, so that nothing can tell the two apart but the name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from implicam.lenses import Bools, DistortionSds, Floats, Lens, fit_lens
from implicam.lenses.base import check_rays, pixel_from_plane, plane_from_pixel
from implicam.lenses.polynomials import divide, first_turning_point, invert_odd_polynomial


@dataclass(frozen=True)
class Equisolid:
    """Image radius 2 f sin(theta / 2), then a polynomial of that radius."""

    family: ClassVar[str] = "equisolid"

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @property
    def _k(self) -> tuple[float, ...]:
        return self.k1, self.k2, self.k3, self.k4

    @property
    def _largest(self) -> float:
        return min(first_turning_point(self._k), 2.0)

    def _plane(self, points: Floats) -> tuple[Floats, Floats, Bools]:
        distance = np.linalg.norm(points, axis=1)
        d = distance * (distance + points[:, 2])
        valid = d > 1e-14 * distance**2
        scale = np.sqrt(2 / np.where(valid, d, np.nan))
        plane = points[:, :2] * scale[:, None]
        valid &= np.hypot(*plane.T) < self._largest
        return np.where(valid[:, None], plane, np.nan), scale, valid

    def _bend(self, plane: Floats) -> Floats:
        r2 = np.sum(plane**2, axis=1)
        bent: Floats = plane * (1 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4))))[:, None]
        return bent

    def pixel_from_camera_point(self, points: Floats) -> tuple[Floats, Bools]:
        plane, _, valid = self._plane(points)
        return pixel_from_plane(self, self._bend(plane)), valid

    def jacobian(self, points: Floats) -> Floats:
        plane, scale, valid = self._plane(points)
        points = np.where(valid[:, None], points, np.nan)
        distance = np.linalg.norm(points, axis=1)
        by_point = 2 * points + (points[:, 2] / distance)[:, None] * points + distance[:, None] * [0, 0, 1]
        slope = np.zeros((len(points), 2, 3))
        slope[:, 0, 0] = slope[:, 1, 1] = scale
        slope -= plane[:, :, None] * by_point[:, None] / (2 * distance * (distance + points[:, 2]))[:, None, None]
        r2 = np.sum(plane**2, axis=1)
        k = np.array(self._k)
        powers = r2[:, None] ** np.arange(4)
        own, by_r2 = 1 + r2 * (powers @ k), powers @ (k * [1, 2, 3, 4])
        bend = own[:, None, None] * np.eye(2) + 2 * by_r2[:, None, None] * plane[:, :, None] * plane[:, None]
        jacobian: Floats = np.array([self.fx, self.fy])[:, None] * (bend @ slope)
        return jacobian

    def parameter_jacobian(self, points: Floats) -> Floats:
        plane, _, valid = self._plane(points)
        out = np.zeros((len(points), 2, 8))
        out[:, 0, 0], out[:, 1, 1] = self._bend(plane).T
        out[:, 0, 2] = out[:, 1, 3] = np.where(valid, 1.0, np.nan)
        r2 = np.sum(plane**2, axis=1)
        for k in range(4):
            out[:, :, 4 + k] = plane * [self.fx, self.fy] * (r2 ** (k + 1))[:, None]
        return out

    def ray_from_pixel(self, uv: Floats) -> tuple[Floats, Bools]:
        bent = plane_from_pixel(self, uv)
        radius = np.hypot(*bent.T)
        straight = invert_odd_polynomial(radius, self._k, self._largest)
        plane = bent * divide(straight, radius, 1.0)[:, None]
        r2 = straight**2
        rays = np.column_stack([plane * np.sqrt(1 - r2 / 4)[:, None], 1 - r2 / 2])
        return check_rays(self, rays, uv)

    def distortion_prior(self, widest: float, sds: DistortionSds | None = None) -> tuple[Floats, Floats]:
        return np.zeros(4), np.diag(1 / np.array([0.2, 0.1, 0.05, 0.02]) ** 2)

    @classmethod
    def nearest(cls, lens: Lens, points: Floats) -> Equisolid:
        starts = [cls(lens.fx, lens.fy, lens.cx, lens.cy, k1) for k1 in (0.0, -0.05, -0.1)]
        return fit_lens(starts, points, lens.pixel_from_camera_point(points)[0])
