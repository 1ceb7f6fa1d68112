"""A flat window between a camera and what it looks at: glass with water behind it, refraction by Snell's law."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats

GLASS_INDEX, WATER_INDEX = 1.49, 1.333
"""Refractive indices of acrylic glass, of which tanks are made, and of water; air has 1."""

NEWTON_STEP_COUNT = 40
"""Newton's method converges from one side, quadratically; grazing rays need about 15 steps."""


@dataclass(frozen=True, eq=False)
class Window:
    """A pane in the camera frame, with air in front and water behind.

    Attributes:
        normal: (3,) unit vector away from the camera.
        distance: From the camera's centre to its air side along the normal, in the unit of the world.
        thickness: Of the glass, in the unit of the world.
        glass: Refractive index.
        water: Refractive index.
    """

    normal: Floats
    distance: float
    thickness: float
    glass: float = GLASS_INDEX
    water: float = WATER_INDEX

    def scaled(self, scale: float) -> Window:
        """The same window in another unit of length.

        Args:
            scale: How many of the other unit one of this unit is.
        """
        return replace(self, distance=self.distance * scale, thickness=self.thickness * scale)

    def apparent(self, points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Where points in the water seem to be, if all were air.

        Only the direction from the camera means something: along the normal the points stay where they are.

        Args:
            points: (n, 3) in the camera frame.

        Returns:
            (n, 3) points in the camera frame, NaN for those that are not behind the glass; and (n,) which are behind
            it.
        """
        depth, aside, radius, behind = self._split(points)
        slope = self._slope_in_air(depth, radius)
        across = _ratio_or_limit(slope, radius, 1 / self._reach_per_slope(np.zeros_like(depth), depth))
        return depth[:, None] * (self.normal + across[:, None] * aside), behind

    def jacobian(self, points: Floats) -> Floats:
        """The derivative of `apparent` with respect to the points.

        Args:
            points: (n, 3) in the camera frame.

        Returns:
            (n, 3, 3); NaN for points not behind the glass.
        """
        depth, aside, radius, _ = self._split(points)
        slope = self._slope_in_air(depth, radius)
        growth = self._reach_per_slope(slope, depth)
        across = _ratio_or_limit(slope, radius, 1 / self._reach_per_slope(np.zeros_like(depth), depth))
        outward = _ratio_or_limit(aside, radius[:, None], 0.0)
        with_depth = -_tangent(slope, self.water) / growth  # d slope / d depth
        normal, n = self.normal, len(depth)
        along = np.broadcast_to(np.outer(normal, normal), (n, 3, 3))
        sideways = (depth * across)[:, None, None] * (np.eye(3) - along)
        by_depth = (across[:, None] * aside + (depth * with_depth)[:, None] * outward)[:, :, None] * normal
        bend = (depth * (1 / growth - across))[:, None, None] * outward[:, :, None] * outward[:, None, :]
        return np.asarray(along + sideways + by_depth + bend, dtype=np.float64)

    def _split(self, points: Floats) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
        """Depth along the normal (n,), the rest (n, 3) and its length (n,), and where a point is in the water."""
        depth = points @ self.normal
        behind = depth > self.distance + self.thickness
        depth = np.where(behind, depth, np.nan)
        aside = points - depth[:, None] * self.normal
        return depth, aside, np.linalg.norm(aside, axis=1), behind

    def _slope_in_air(self, depth: Floats, radius: Floats) -> Floats:
        """(n,) tangent of the ray's angle to the normal in air, so that it arrives `radius` beside the normal.

        How far a ray comes is concave in this tangent: from below, Newton's method never goes too far.
        """
        water = depth - self.distance - self.thickness
        slope = radius / (self.distance + self.thickness / self.glass + water / self.water)
        for _ in range(NEWTON_STEP_COUNT):
            comes = (
                self.distance * slope
                + self.thickness * _tangent(slope, self.glass)
                + water * _tangent(slope, self.water)
            )
            slope = slope + (radius - comes) / self._reach_per_slope(slope, depth)
        return np.asarray(slope, dtype=np.float64)

    def _reach_per_slope(self, slope: Floats, depth: Floats) -> Floats:
        """(n,) how much farther beside the normal a ray comes, per slope in air."""
        water = depth - self.distance - self.thickness
        bent = self.thickness * _tangent_slope(slope, self.glass) + water * _tangent_slope(slope, self.water)
        return np.asarray(self.distance + bent, dtype=np.float64)


def _tangent(slope: Floats, index: float) -> Floats:
    """Tangent of the angle in a medium with refractive index `index`, from the tangent in air."""
    return np.asarray(slope / np.sqrt(index**2 + (index**2 - 1) * slope**2), dtype=np.float64)


def _tangent_slope(slope: Floats, index: float) -> Floats:
    return np.asarray(index**2 / (index**2 + (index**2 - 1) * slope**2) ** 1.5, dtype=np.float64)


def _ratio_or_limit(a: Floats, b: Floats, at_zero: Floats | float) -> Floats:
    """`a / b`, and its limit `at_zero` where b is zero: straight through the pane."""
    zero = b == 0
    return np.asarray(np.where(zero, at_zero, a / np.where(zero, 1.0, b)), dtype=np.float64)
