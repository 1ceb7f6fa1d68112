"""What stands in front of the cameras: a ball on a tool before its white plate, a printed checkerboard, or a wand.

An object paints itself into a patch of rays: its albedo where it covers them, and how much of each it covers. The edge
of a thing is where a smooth function of the ray is zero; the function over its own slope is the distance from the edge
in samples, so that edges are anti-aliased exactly where they are straight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats
from implicam.images import opencv

Patch = NDArray[np.float32]
"""(rows, columns), one value per ray; or (rows, columns, 3), one vector."""


class Rays(NamedTuple):
    """Lines of sight.

    Attributes:
        centre: (3,) where they begin, in the world.
        directions: (rows, columns, 3) unit vectors in the world.
    """

    centre: Floats
    directions: Patch


@dataclass(frozen=True, eq=False)
class Light:
    """A lamp, with a brightness that changes across the volume.

    Attributes:
        towards: (3,) unit vector towards the lamp, in the world.
        slope: (3,) by how much the brightness grows per length unit.
        middle: (3,) where the brightness is 1, in the world.
    """

    towards: Floats
    slope: Floats
    middle: Floats

    def at(self, points: Patch) -> Patch:
        """How bright it is at points.

        Args:
            points: (..., 3) in the world.

        Returns:
            (...,) brightness; 1 in the middle of the volume.
        """
        return np.asarray(1 + (points - self.middle.astype(np.float32)) @ self.slope.astype(np.float32), np.float32)


@dataclass(frozen=True, eq=False)
class Ball:
    """A dark ball on a stem in front of a white plate, with the tool behind the plate.

    Attributes:
        centre: (3,) of the ball, in the world.
        facing: (3,) unit vector that the front of the plate faces.
        radius: Of the ball, in the length unit.
        light: The lamp.
    """

    centre: Floats
    facing: Floats
    radius: float
    light: Light

    GAP, PLATE, CORNER, STEM, TOOL, TOOL_LENGTH = 1.6, 5.0, 1.0, 0.22, 1.6, 9.0
    """In radii: ball to plate, half the plate's edge, its rounding, the radii of stem and tool, the tool's length."""

    def paint(self, rays: Rays, ground: Patch) -> Patch:
        """Paint it over what is behind it.

        Args:
            rays: One for each sample.
            ground: (rows, columns) brightness of what is behind it.

        Returns:
            (rows, columns) brightness.
        """
        plate_at = self.centre - self.GAP * self.radius * self.facing
        back = plate_at - self.TOOL_LENGTH * self.radius * self.facing
        layers: list[tuple[Patch, Any]] = [
            (_rod(rays, back, plate_at, self.TOOL * self.radius), np.float32(0.22)),
            self._plate(rays, plate_at),
            (_rod(rays, plate_at, self.centre, self.STEM * self.radius), np.float32(0.4)),
            self._sphere(rays),
        ]
        if (rays.centre - plate_at) @ self.facing < 0:  # seen from behind, the plate hides the ball
            layers.reverse()
        for cover, value in layers:
            ground = ground + cover * (value - ground)
        return ground

    def reach(self) -> Floats:
        """(n, 3) points in the world whose pixels enclose its picture."""
        a, b = _across(self.facing)
        half = self.PLATE * self.radius
        plate = self.centre - self.GAP * self.radius * self.facing
        corners = [plate + half * (i * a + j * b) for i in (-1, 1) for j in (-1, 1)]
        back = [c - self.TOOL_LENGTH * self.radius * self.facing for c in corners]
        return np.array([*corners, *back, self.centre])

    def _sphere(self, rays: Rays) -> tuple[Patch, Patch]:
        towards = self.centre - rays.centre
        distance = float(np.linalg.norm(towards))
        cover, along, aside = _sphere_cover(rays, self.centre, self.radius)
        depth = distance * along - np.sqrt(np.maximum(self.radius**2 - (distance * aside) ** 2, 0))
        normal = (depth[..., None] * rays.directions - towards.astype(np.float32)) / np.float32(self.radius)
        lamp = self.light.towards.astype(np.float32)
        lambert = np.maximum(normal @ lamp, 0)
        mirrored = 2 * lambert[..., None] * normal - lamp
        shine = np.maximum(-_dot(mirrored, rays.directions), 0) ** 60
        return cover, np.asarray(0.05 + 0.07 * lambert + 0.35 * shine, np.float32)

    def _plate(self, rays: Rays, middle: Floats) -> tuple[Patch, Patch]:
        a, b = _across(self.facing)
        hit = _on_plane(rays, middle, self.facing)
        x, y = (np.abs((hit - middle.astype(np.float32)) @ axis.astype(np.float32)) for axis in (a, b))
        half, corner = self.PLATE * self.radius, self.CORNER * self.radius
        qx, qy = x - np.float32(half - corner), y - np.float32(half - corner)
        outside = np.hypot(np.maximum(qx, 0), np.maximum(qy, 0)) + np.minimum(np.maximum(qx, qy), 0)
        cover = _cover(np.where(np.isnan(outside), np.inf, outside - np.float32(corner)))
        lamp = self.light.towards
        shadow_at = self.centre - lamp * ((self.centre - middle) @ self.facing) / max(float(lamp @ self.facing), 0.2)
        from_shadow = _length(hit - shadow_at.astype(np.float32)) / np.float32(self.radius)
        shade = 1 - 0.25 / (1 + np.exp(6 * (np.minimum(from_shadow, 9) - 1.1)))  # the ball's, soft: the lamp is large
        return cover, np.nan_to_num(np.asarray(0.75 * shade * self.light.at(hit), np.float32))


@dataclass(frozen=True, eq=False)
class Checkerboard:
    """A printed board. The outermost square at corner 1 is black; a white margin of one square follows.

    Attributes:
        corner: (3,) its inner corner 1, in the world.
        right: (3,) the step from a corner to the next in its row.
        down: (3,) the step to the next row.
        rows: Of inner corners.
        columns: Of inner corners.
        light: The lamp.
        marks: What is printed in its white squares, from 0, nothing, to 1, black: (k (rows + 1), k (columns + 1)), k
            samples a square; None for nothing.
    """

    corner: Floats
    right: Floats
    down: Floats
    rows: int
    columns: int
    light: Light
    marks: Patch | None = None

    def paint(self, rays: Rays, ground: Patch) -> Patch:
        """Paint it over what is behind it; seen from behind it is plain grey.

        Args:
            rays: One for each sample.
            ground: (rows, columns) brightness of what is behind it.

        Returns:
            (rows, columns) brightness.
        """
        facing = np.cross(self.down, self.right)
        hit = _on_plane(rays, self.corner, facing / np.linalg.norm(facing))
        offset = hit - self.corner.astype(np.float32)
        x = offset @ (self.right / (self.right @ self.right)).astype(np.float32)
        y = offset @ (self.down / (self.down @ self.down)).astype(np.float32)
        cover = _inside(x, -2, self.columns + 1) * _inside(y, -2, self.rows + 1)
        printed = _inside(x, -1, self.columns) * _inside(y, -1, self.rows)
        black = 0.5 + 0.5 * _stripes(x) * _stripes(y)
        if self.marks is not None:
            black = np.maximum(black, _read_print(self.marks, x + 1, y + 1, self.columns + 1, self.rows + 1))
        from_behind = bool((rays.centre - self.corner) @ facing < 0)
        return _paint_sheet(ground, cover, black * printed, self.light.at(hit), from_behind)

    def reach(self) -> Floats:
        """(4, 3) the corners of the sheet, in the world."""
        ends = [(i, j) for i in (-2, self.columns + 1) for j in (-2, self.rows + 1)]
        return np.array([self.corner + i * self.right + j * self.down for i, j in ends])


@dataclass(frozen=True, eq=False)
class Wand:
    """A dark rod with a bright ball at each end, and perhaps another between them: they shine by themselves.

    Attributes:
        ends: (n, 3) middles of the balls in the world; the rod goes from the first to the last.
        radii: (n,) of the balls, in the length unit.
        brightness: (n,) from 0 to 1.
        rod: Radius of the rod.
    """

    ends: Floats
    radii: Floats
    brightness: Floats
    rod: float

    def paint(self, rays: Rays, ground: Patch) -> Patch:
        """Paint it over what is behind it.

        Args:
            rays: One for each sample.
            ground: (rows, columns) brightness of what is behind it.

        Returns:
            (rows, columns) brightness.
        """
        order = np.argsort(-np.linalg.norm(self.ends - rays.centre, axis=1))  # the nearest last
        along = (self.ends[-1] - self.ends[0]) / np.linalg.norm(self.ends[-1] - self.ends[0])
        rod = _rod(rays, self.ends[0] + self.radii[0] * along, self.ends[-1] - self.radii[-1] * along, self.rod)
        for rank, ball in enumerate(order):
            cover, _, _ = _sphere_cover(rays, self.ends[ball], float(self.radii[ball]))
            ground = ground + cover * (np.float32(self.brightness[ball]) - ground)
            if rank == 0:  # the rod may hide the far ball in part, and the near one the rod
                ground = ground + rod * (np.float32(0.1) - ground)
        return np.asarray(ground, np.float32)

    def reach(self) -> Floats:
        """(n, 3) points in the world whose pixels enclose its picture."""
        corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
        return np.concatenate([end + radius * corners for end, radius in zip(self.ends, self.radii, strict=True)])


class Print(NamedTuple):
    """What is printed on a sheet.

    Attributes:
        black: (k, l) how black it is, from 0 to 1.
        low: (2,) its top left corner, on the board: x to the right, y down.
        size: (2,) its width and height.
    """

    black: Patch
    low: Floats
    size: Floats


@dataclass(frozen=True, eq=False)
class Sheet:
    """A sheet with any print: tags, dots.

    Attributes:
        corner: (3,) the origin of the board, in the world.
        right: (3,) a unit vector along its x.
        down: (3,) along its y.
        print: What is on it, in the unit of the world.
        light: The lamp.
    """

    corner: Floats
    right: Floats
    down: Floats
    print: Print
    light: Light

    def paint(self, rays: Rays, ground: Patch) -> Patch:
        """Paint it over what is behind it; seen from behind it is plain grey.

        Args:
            rays: One for each sample.
            ground: (rows, columns) brightness of what is behind it.

        Returns:
            (rows, columns) brightness.
        """
        facing = np.cross(self.down, self.right)
        hit = _on_plane(rays, self.corner, facing)
        offset = hit - self.corner.astype(np.float32)
        (width, height), low = self.print.size, self.print.low.astype(np.float32)
        x, y = offset @ self.right.astype(np.float32) - low[0], offset @ self.down.astype(np.float32) - low[1]
        cover = _inside(x, 0, width) * _inside(y, 0, height)
        black = _read_print(self.print.black, x, y, width, height)
        from_behind = bool((rays.centre - self.corner) @ facing < 0)
        return _paint_sheet(ground, cover, black, self.light.at(hit), from_behind)

    def reach(self) -> Floats:
        """(4, 3) its corners, in the world."""
        ends = [self.print.low + self.print.size * [i, j] for i in (0, 1) for j in (0, 1)]
        return np.array([self.corner + x * self.right + y * self.down for x, y in ends])


ShownObject = Ball | Checkerboard | Sheet | Wand


def _paint_sheet(ground: Patch, cover: Patch, black: Patch, light: Patch, from_behind: bool) -> Patch:
    """White paper with black print over what is behind it; its back is plain grey."""
    value = np.nan_to_num(np.asarray((0.78 - 0.70 * black) * light, np.float32))
    if from_behind:
        value = np.full_like(value, 0.3)
    return np.asarray(ground + np.nan_to_num(cover) * (value - ground), np.float32)


def _read_print(black: Patch, x: Patch, y: Patch, width: float, height: float) -> Patch:
    """A print where rays meet it, x and y from its top left corner, averaged over about what a sample covers."""
    cv2 = opencv()
    with np.errstate(invalid="ignore"):
        step = float(np.nanmedian(np.hypot(*np.gradient(x)))) if min(x.shape) > 1 else width
    part = float(np.clip(width / max(step * black.shape[1], 1e-3 * width), 0.02, 1.0))
    small = cv2.resize(black, None, fx=part, fy=part, interpolation=cv2.INTER_AREA)
    across, along = small.shape[1] / width, small.shape[0] / height
    u, v = (x * across - 0.5).astype(np.float32), (y * along - 0.5).astype(np.float32)
    found = cv2.remap(small, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(found, np.float32)


def _rod(rays: Rays, start: Floats, end: Floats, radius: float) -> Patch:
    """How much of each ray a rod with rounded ends covers."""
    axis = (end - start).astype(np.float32)
    towards = (start - rays.centre).astype(np.float32)
    # The point of the rod nearest to a ray, as a part of its length: both lines' mutual perpendicular, clipped.
    da, aa = rays.directions @ axis, np.float32(axis @ axis)
    dt, at = rays.directions @ towards, np.float32(axis @ towards)
    part = np.clip((da * dt - at) / np.maximum(aa - da * da, 1e-6 * aa), 0, 1)
    nearest = np.asarray(towards + part[..., None] * axis, np.float32)
    along = _dot(nearest, rays.directions)
    aside = _length(nearest - along[..., None] * rays.directions)
    return _cover(np.asarray((aside - radius) / np.maximum(along, radius), np.float32))


def _sphere_cover(rays: Rays, centre: Floats, radius: float) -> tuple[Patch, Patch, Patch]:
    """How much of each ray a ball covers; and the parts of the direction along the line to its middle and across."""
    towards = centre - rays.centre
    distance = float(np.linalg.norm(towards))
    axis = (towards / distance).astype(np.float32)
    along = rays.directions @ axis
    aside = _length(rays.directions - along[..., None] * axis)
    return _cover(aside - np.float32(radius / distance)), along, aside


def _across(normal: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors that span the plane across `normal`."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


def _dot(a: Patch, b: Patch) -> Patch:
    return np.asarray(np.einsum("ijk,ijk->ij", a, b), np.float32)


def _length(vectors: Patch) -> Patch:
    return np.sqrt(_dot(vectors, vectors))


def _on_plane(rays: Rays, origin: Floats, normal: Floats) -> Patch:
    """Where rays meet a plane; NaN where they do not, or from behind the eye."""
    slope = rays.directions @ normal.astype(np.float32)
    depth = np.float32((origin - rays.centre) @ normal) / np.where(np.abs(slope) > 1e-6, slope, np.nan)
    depth = np.where(depth > 0, depth, np.nan)
    return np.asarray(rays.centre.astype(np.float32) + depth[..., None] * rays.directions, np.float32)


def _cover(field: Patch) -> Patch:
    """How much of each sample lies where `field` is negative: half at zero, all half a sample inside."""
    return np.asarray(np.clip(0.5 - _in_samples(field), 0, 1), np.float32)


def _in_samples(field: Patch) -> Patch:
    """A field over its slope per sample: the distance from where it is zero."""
    with np.errstate(invalid="ignore"):
        down, right = np.gradient(field)
        slope = np.hypot(down, right)
        return np.asarray(np.nan_to_num(field / np.maximum(slope, 1e-12), nan=1e9), np.float32)


def _inside(x: Patch, low: float, high: float) -> Patch:
    """How much of each sample lies between two lines."""
    middle, half = np.float32((low + high) / 2), np.float32((high - low) / 2)
    return _cover(np.abs(x - middle) - half)


def _stripes(x: Patch) -> Patch:
    """+1 between 0 and 1, -1 between 1 and 2, and so on: what changes sign at every whole number, anti-aliased."""
    nearest = np.rint(x)
    sign = 1 - 2 * (nearest % 2)
    with np.errstate(invalid="ignore"):
        slope = np.hypot(*np.gradient(x))
        distance = np.clip(2 * (x - nearest) / np.maximum(slope, 1e-12), -1, 1)
    return np.asarray(sign * distance, np.float32)
