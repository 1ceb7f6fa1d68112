"""Lenses of other programs that are not among the families here: their formulas, to read them by a refit.

Camera frame x right, y down, z forward, pixels (0, 0) at the centre of the top-left pixel, as everywhere here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from implicam.lenses import Bools, Floats, Lens

Projection = Callable[[Floats], tuple[Floats, Bools]]
"""Points (n, 3) in the camera frame to their pixels (n, 2) and whether there is one (n,); what is not valid is
anything."""

PLANE_LIMIT = 1e-9
"""Least part of a ray's length that a denominator has before the lens counts as having no answer."""


@dataclass(frozen=True)
class OtherLens:
    """A lens by its formula. model: its name, for notes; cx, cy: its principal point, pixels."""

    model: str
    project: Projection
    cx: float
    cy: float


def rational_lens(linear: Sequence[float], coefficients: Sequence[float]) -> OtherLens:
    """OpenCV's lens with 8, 12 or 14 coefficients: rational, with a thin prism, and tilted.

    Formula: OpenCV, "Camera Calibration and 3D Reconstruction", detailed description.

    Args:
        linear: Fx, fy, cx, cy in pixels.
        coefficients: The first of k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y.
    """
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y = [*coefficients, *[0.0] * (14 - len(coefficients))]
    tilt = _tilt(tau_x, tau_y)

    def project(points: Floats) -> tuple[Floats, Bools]:
        xy, valid = _plane(points, points[:, 2])
        x, y = xy.T
        r2 = x * x + y * y
        below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / np.where(below > 0, below, np.nan)
        bent = np.column_stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4),
                np.ones(len(x)),
            ]
        )
        turned = bent @ tilt.T
        return _pixels(turned[:, :2] / turned[:, 2:], linear), valid & (below > 0) & (turned[:, 2] > 0)

    kinds = [("rational", coefficients[5:8]), ("thin prism", coefficients[8:12]), ("tilted", coefficients[12:])]
    model = f"OpenCV's {' and '.join(name for name, part in kinds if any(part))} lens model"
    return OtherLens(model, project, linear[2], linear[3])


def _tilt(tau_x: float, tau_y: float) -> Floats:
    """The homography (3, 3) onto a sensor that is tilted about x and y, by radians."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    turn = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    onto = np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]])
    return np.asarray(onto @ turn, dtype=np.float64)


def omnidirectional_lens(xi: float, linear: Sequence[float], radtan: Sequence[float]) -> OtherLens:
    """The unified sphere of Mei, Kalibr's `omni` and cv2.omnidir: C. Mei and P. Rives, ICRA 2007.

    Args:
        xi: How far the centre of projection is from that of the unit sphere.
        linear: Fx, fy, cx, cy in pixels, as these programs have them: focal lengths times (1 + xi) on the axis.
        radtan: k1, k2, p1, p2 on the plane behind the sphere.
    """
    k1, k2, p1, p2 = radtan

    def project(points: Floats) -> tuple[Floats, Bools]:
        length = np.linalg.norm(points, axis=1)
        depth = points[:, 2] + xi * length
        xy, valid = _plane(points, depth)
        x, y = xy.T
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * k2)
        bent = np.column_stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ]
        )
        # beyond -1/xi the sphere is seen from behind, where two rays share a pixel
        return _pixels(bent, linear), valid & (points[:, 2] > -length / max(xi, 1.0)) & (depth > 0)

    return OtherLens("the omnidirectional lens model", project, linear[2], linear[3])


def double_sphere_lens(xi: float, alpha: float, linear: Sequence[float]) -> OtherLens:
    """Kalibr's `ds`: V. Usenko, N. Demmel and D. Cremers, "The double sphere camera model", 3DV 2018, eqs. 40 to 45.

    Args:
        xi: The distance of the two spheres.
        alpha: The weight of the second sphere against the plane, from 0 to 1.
        linear: Fx, fy, cx, cy in pixels.
    """
    w1 = _field_limit(alpha)
    w2 = (w1 + xi) / np.sqrt(max(2 * w1 * xi + xi * xi + 1, PLANE_LIMIT))

    def project(points: Floats) -> tuple[Floats, Bools]:
        length = np.linalg.norm(points, axis=1)
        shifted = points[:, 2] + xi * length
        second = np.sqrt(np.sum(points[:, :2] ** 2, axis=1) + shifted**2)
        xy, valid = _plane(points, alpha * second + (1 - alpha) * shifted)
        return _pixels(xy, linear), valid & (points[:, 2] > -w2 * length)

    return OtherLens("the double sphere lens model", project, linear[2], linear[3])


def extended_unified_lens(alpha: float, beta: float, linear: Sequence[float]) -> OtherLens:
    """Kalibr's `eucm`: B. Khomutenko, G. Garcia and P. Martinet, "An enhanced unified camera model", RA-L 2016.

    Args:
        alpha: The weight of the ellipsoid against the plane, from 0 to 1.
        beta: The shape of the ellipsoid, greater than zero.
        linear: Fx, fy, cx, cy in pixels.
    """
    w = _field_limit(alpha)

    def project(points: Floats) -> tuple[Floats, Bools]:
        length = np.sqrt(np.maximum(beta * np.sum(points[:, :2] ** 2, axis=1) + points[:, 2] ** 2, 0))
        xy, valid = _plane(points, alpha * length + (1 - alpha) * points[:, 2])
        return _pixels(xy, linear), valid & (points[:, 2] > -w * length)

    return OtherLens("the extended unified lens model", project, linear[2], linear[3])


def _field_limit(alpha: float) -> float:
    """How far behind the camera, as a part of a ray's length, a sphere of this weight is seen once."""
    weight = min(max(alpha, PLANE_LIMIT), 1 - PLANE_LIMIT)
    return weight / (1 - weight) if weight <= 0.5 else (1 - weight) / weight


def field_of_view_lens(omega: float, linear: Sequence[float]) -> OtherLens:
    """The one-parameter lens, Kalibr's and COLMAP's `fov`: F. Devernay and O. Faugeras, MVA 2001, eqs. 13 and 14.

    Args:
        omega: Its field of view, radians; zero is a pinhole.
        linear: Fx, fy, cx, cy in pixels.
    """

    def project(points: Floats) -> tuple[Floats, Bools]:
        xy, valid = _plane(points, points[:, 2])
        radius = np.linalg.norm(xy, axis=1)
        small = radius * abs(omega) < PLANE_LIMIT
        safe = np.where(small, 1.0, radius)
        wide = np.arctan(2 * safe * np.tan(omega / 2)) / (safe * (omega or 1.0))
        ratio = np.where(small, 2 * np.tan(omega / 2) / omega if abs(omega) > PLANE_LIMIT else 1.0, wide)
        return _pixels(xy * ratio[:, None], linear), valid

    return OtherLens("the field-of-view lens model", project, linear[2], linear[3])


def division_lens(k: float, linear: Sequence[float]) -> OtherLens:
    """COLMAP's DIVISION: the undistorted radius is r / (1 + k r²); A. Fitzgibbon, CVPR 2001.

    Args:
        k: Of the squared distorted radius.
        linear: Fx, fy, cx, cy in pixels.
    """

    def project(points: Floats) -> tuple[Floats, Bools]:
        xy, valid = _plane(points, points[:, 2])
        root = 1 - 4 * k * np.sum(xy**2, axis=1)
        # r_u (1 + k r²) = r, the smaller root
        ratio = 2 / (1 + np.sqrt(np.where(root >= 0, root, np.nan)))
        return _pixels(xy * ratio[:, None], linear), valid & (root >= 0)

    return OtherLens("COLMAP's division model", project, linear[2], linear[3])


def thin_prism_fisheye_lens(linear: Sequence[float], coefficients: Sequence[float]) -> OtherLens:
    """COLMAP's THIN_PRISM_FISHEYE: OpenCV's radial, decentring and thin prism terms after the angle to the axis.

    Args:
        linear: Fx, fy, cx, cy in pixels, (0, 0) at the centre of the first one.
        coefficients: k1, k2, p1, p2, k3, k4, sx1, sy1.
    """
    k1, k2, p1, p2, k3, k4, sx1, sy1 = coefficients

    def project(points: Floats) -> tuple[Floats, Bools]:
        across = np.linalg.norm(points[:, :2], axis=1)
        theta = np.arctan2(across, points[:, 2])
        # at the axis the angle is the distance in the plane
        x, y = (points[:, :2] * np.where(across > 0, theta / np.where(across > 0, across, 1), 1)[:, None]).T
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        bent = np.column_stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + sx1 * r2,
                y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y) + sy1 * r2,
            ]
        )
        return _pixels(bent, linear), points[:, 2] > 0

    return OtherLens("COLMAP's thin prism fisheye", project, linear[2], linear[3])


def with_skew(lens: Lens | OtherLens, skew: float) -> OtherLens:
    """A lens whose pixel axes are not at right angles.

    Args:
        lens: The lens without.
        skew: The entry of the camera matrix beside fx, pixels.
    """
    project = lens.project if isinstance(lens, OtherLens) else lens.pixel_from_camera_point
    slope = skew / (focal_lengths(lens)[1] if isinstance(lens, OtherLens) else lens.fy)

    def skewed(points: Floats) -> tuple[Floats, Bools]:
        uv, valid = project(points)
        return uv + np.column_stack([slope * (uv[:, 1] - lens.cy), np.zeros(len(uv))]), valid

    return OtherLens("a lens with a skew", skewed, lens.cx, lens.cy)


def focal_lengths(lens: OtherLens) -> tuple[float, float]:
    """The focal lengths of a lens on its axis, by differences.

    Args:
        lens: Of any formula.

    Returns:
        Along u and along v, pixels.
    """
    h = 1e-4
    uv = lens.project(np.array([[h, 0, 1], [-h, 0, 1], [0, h, 1], [0, -h, 1.0]]))[0]
    return float(uv[0, 0] - uv[1, 0]) / (2 * h), float(uv[2, 1] - uv[3, 1]) / (2 * h)


def _plane(points: Floats, depth: Floats) -> tuple[Floats, Bools]:
    """X and y over a depth, and where that is possible."""
    valid = depth > PLANE_LIMIT * np.abs(points).max(axis=1)
    return points[:, :2] / np.where(valid, depth, np.nan)[:, None], valid


def _pixels(xy: Floats, linear: Sequence[float]) -> Floats:
    fx, fy, cx, cy = linear
    return np.asarray(xy * [fx, fy] + [cx, cy], dtype=np.float64)
