"""What a lens costs in a format that cannot hold it: the nearest lens it can hold, and how many pixels lie between.

The comparison is made over the whole image, on a lattice of its pixels: which ray each looks along, and where the other
lens puts that ray.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

import numpy as np
from scipy.linalg import rq
from scipy.optimize import least_squares

from implicam.errors import DatasetError
from implicam.exchange.model import ExplicitCamera, has_distortion
from implicam.geometry import Pose, rotation_from_vector
from implicam.lenses import BrownConrady, Floats, KannalaBrandt, Lens

LATTICE_POINTS_PER_SIDE = 25
"""Pixels of the lattice along each side of the image."""

MAX_LENS_DIFFERENCE_PX = 1.0
"""A lens that the nearest one of the format misses by more, anywhere in the image, is refused."""

ROUNDING_PX = 1e-6
"""A smaller difference is none."""

MIN_FORWARD_COSINE = 0.1
"""Least forward part of a unit ray that a plane image can hold: 84 degrees off the axis."""


@dataclass(frozen=True)
class Cost:
    """Distance in pixels between two lenses over the image: root mean square, and the largest."""

    rms: float
    largest: float

    @classmethod
    def between(cls, a: Floats, b: Floats) -> Cost:
        """The distance between two sets of pixels.

        Args:
            a: (n, 2).
            b: (n, 2).
        """
        distance = np.hypot(*(a - b).T)
        return cls(float(np.sqrt(np.mean(distance**2))), float(distance.max()))

    def in_words(self) -> str:
        """The largest, or that there is none, as the end of a sentence on the nearest lens."""
        if np.isfinite(self.largest):
            return f"is off by {self.largest:.3g} px somewhere in the image"
        return "shows a part of the image nowhere"

    def __str__(self) -> str:
        return f"rms {self.rms:.2g} px, at most {self.largest:.2g} px"


def pixel_lattice(camera: ExplicitCamera) -> Floats:
    """Pixels that cover the image from edge to edge.

    Args:
        camera: With its image size.

    Returns:
        (n, 2).

    Raises:
        DatasetError: The image size is not known.
    """
    return lattice_of(*camera.size)


def lattice_of(width: int, height: int) -> Floats:
    """Pixels that cover an image from edge to edge.

    Args:
        width: In pixels.
        height: In pixels.

    Returns:
        (n, 2).
    """
    u, v = (np.linspace(-0.5, side - 0.5, LATTICE_POINTS_PER_SIDE) for side in (width, height))
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def _known(lens: Lens) -> bool:
    """Whether formats with lenses of OpenCV hold it."""
    return isinstance(lens, BrownConrady | KannalaBrandt)


def image_rays(camera: ExplicitCamera, form: str) -> tuple[Floats, Floats]:
    """The rays of pixels that cover the image; pixels without a ray are left out.

    Args:
        camera: With its image size.
        form: What is wanted of it, for the error.

    Returns:
        Rays (n, 3) in the camera frame with z = 1; and their pixels (n, 2).

    Raises:
        DatasetError: The camera looks sideways or backwards somewhere, and `form` holds a plane only.
    """
    uv = pixel_lattice(camera)
    rays, valid = camera.lens.ray_from_pixel(uv)
    rays, uv = rays[valid], uv[valid]
    if not len(rays) or rays[:, 2].min() < MIN_FORWARD_COSINE:
        raise DatasetError(
            f"camera {camera.name!r} cannot be written as {form}.",
            why="a part of its image looks sideways or backwards, which a perspective lens cannot hold"
            if len(rays)
            else "no pixel of its image has a ray",
            fix="use a format with fisheye lenses: opencv, aniposelib, kalibr or colmap"
            if _known(camera.lens)
            else "calibrate with kannala-brandt, and use opencv, aniposelib, kalibr or colmap, which hold that",
        )
    return rays / rays[:, 2:], uv


def fit_four_coefficients(camera: ExplicitCamera) -> tuple[BrownConrady, Cost | None]:
    """The lens with k1, k2, p1, p2 alone that is nearest over the image, by Gauss-Newton on all eight parameters.

    Args:
        camera: With its image size.

    Returns:
        The lens; and the cost, None where it is the same lens.

    Raises:
        DatasetError: It is off by more than `MAX_LENS_DIFFERENCE_PX` pixels somewhere.
    """
    lens = camera.lens
    if isinstance(lens, BrownConrady) and lens.k3 == 0:
        return lens, None
    form = "a lens with four distortion coefficients"
    rays, uv = image_rays(camera, form)
    found = BrownConrady(lens.fx, lens.fy, lens.cx, lens.cy)
    for _ in range(30):
        at, valid = found.pixel_from_camera_point(rays)
        slope = found.parameter_jacobian(rays)[valid][:, :, :8].reshape(-1, 8)
        step = np.linalg.lstsq(slope, (uv - at)[valid].ravel(), rcond=None)[0]
        found = BrownConrady(*(np.array(astuple(found)[:8]) + step).tolist())
    at, valid = found.pixel_from_camera_point(rays)
    cost = Cost.between(at, uv) if valid.all() else Cost(np.inf, np.inf)
    if not cost.largest <= MAX_LENS_DIFFERENCE_PX:
        raise DatasetError(
            f"camera {camera.name!r} cannot be written as {form}.",
            why=f"the nearest such lens {cost.in_words()}",
            fix="use a format that holds its lens: opencv, aniposelib or colmap"
            if _known(lens)
            else "calibrate with brown-conrady or kannala-brandt, which opencv, aniposelib and colmap hold",
        )
    return found, cost


def nearest_brown_conrady(camera: ExplicitCamera, program: str) -> tuple[BrownConrady, list[str]]:
    """The lens of a program that has k1, k2, p1, p2, k3 and no fisheye: its own, or the nearest with the first four.

    Args:
        camera: With its image size.
        program: The program's name, for the note.

    Returns:
        The lens; and a note on what another one costs.

    Raises:
        DatasetError: It is off by more than `MAX_LENS_DIFFERENCE_PX` pixels somewhere.
    """
    if isinstance(camera.lens, BrownConrady):
        return camera.lens, []
    lens, cost = fit_four_coefficients(camera)
    return lens, [f"Camera {camera.name!r}: {program} has no fisheye; fitted again with k1, k2, p1, p2: {cost}."]


def projection_matrix(camera: ExplicitCamera) -> Floats:
    """The projection matrix of the camera without its distortion.

    Args:
        camera: Any.

    Returns:
        (3, 4) homogeneous `pixel_from_world`.
    """
    lens, pose = camera.lens, camera.camera_from_world
    k = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    return np.asarray(k @ np.column_stack([pose.rotation, pose.translation]), dtype=np.float64)


def fit_projection_matrix(camera: ExplicitCamera, points: Floats | None = None) -> tuple[Floats, Cost | None]:
    """The direct linear transformation that comes nearest to the camera, by least squares in pixels.

    Args:
        camera: With its image size.
        points: (n, 3) in the world: it is fitted to those in view, and the centre may move to suit them. None: it is
            fitted over the whole image with the camera's centre kept, so that it holds at every distance.

    Returns:
        P (3, 4), homogeneous `pixel_from_world`; and the cost, None for a pinhole.

    Raises:
        DatasetError: The camera looks sideways somewhere, or sees fewer than 12 of the points.
    """
    if not has_distortion(camera.lens):
        return projection_matrix(camera), None
    if points is None:
        q, uv = image_rays(camera, "a direct linear transformation")
    else:
        q, uv = _select_in_view(camera, points)
    k = projection_matrix(replace(camera, camera_from_world=Pose(np.eye(3), np.zeros(3))))[:, :3]
    centred = np.linalg.inv(_normalising_similarity(uv))
    depth = float(np.median(q[:, 2]))

    def matrix(x: Floats) -> tuple[Floats, Floats]:
        """A homography beside K, and how far the centre moves."""
        change = np.eye(3) + np.append(x[:8], 0).reshape(3, 3)
        return np.linalg.inv(centred) @ change @ centred @ k, depth * x[8:] if len(x) > 8 else np.zeros(3)

    def project(x: Floats) -> Floats:
        homography, shift = matrix(x)
        w = (q - shift) @ homography.T
        return np.asarray(w[:, :2] / w[:, 2:], dtype=np.float64)

    start = np.zeros(8 if points is None else 11)
    x = least_squares(lambda x: (project(x) - uv).ravel(), start, x_scale=0.01, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    homography, shift = matrix(x)
    pose = camera.camera_from_world
    p = homography @ np.column_stack([pose.rotation, pose.translation - shift])
    return p, Cost.between(project(x), uv)


def _select_in_view(camera: ExplicitCamera, points: Floats) -> tuple[Floats, Floats]:
    """The points (n, 3) that fall into the image, in the camera frame, and their pixels (n, 2)."""
    q = camera.camera_from_world.apply(np.asarray(points, dtype=np.float64))
    uv, valid = camera.lens.pixel_from_camera_point(q)
    inside = valid & (q[:, 2] > 0) & (uv >= -0.5).all(axis=1) & (uv <= np.array(camera.size) - 0.5).all(axis=1)
    if inside.sum() < 12:
        raise DatasetError(
            f"camera {camera.name!r} sees {inside.sum()} of the points; a direct linear transformation needs 12.",
            fix="give points in its view, or none: then the whole image is used",
        )
    return q[inside], uv[inside]


def _normalising_similarity(uv: Floats) -> Floats:
    """The similarity (3, 3) that brings [-1, 1] to where the pixels (n, 2) are."""
    low, high = uv.min(axis=0), uv.max(axis=0)
    half = float((high - low).max()) / 2 or 1.0
    return np.array([[half, 0, (low[0] + high[0]) / 2], [0, half, (low[1] + high[1]) / 2], [0, 0, 1]])


def pinhole_from_matrix(name: str, size: tuple[int, int], p: Floats, place: str) -> tuple[ExplicitCamera, Cost | None]:
    """A camera without distortion from a projection matrix.

    The matrix is split by the RQ decomposition (Hartley & Zisserman, 6.2.4). Eleven numbers hold a skew, which no
    camera has: the nearest camera without is taken, over the whole image.

    Args:
        name: Of the camera.
        size: Width and height in pixels.
        p: (3, 4) homogeneous `pixel_from_world`, of any scale and sign.
        place: Where it stands, for the error.

    Returns:
        The camera; and what leaving out the skew costs, None where there is none.

    Raises:
        DatasetError: It is no camera.
    """
    upper, rotation = rq(p[:, :3])
    signs = np.sign(np.diag(upper))
    if not signs.all() or np.linalg.cond(p[:, :3]) > 1e12:
        raise DatasetError(
            f"{place} is no camera.", why="its rays do not leave from one point", fix="correct the coefficients"
        )
    upper, rotation = upper * signs, signs[:, None] * rotation
    if np.linalg.det(rotation) < 0:  # P has no sign of its own
        rotation, p = -rotation, -p
    translation = np.linalg.solve(upper, p[:, 3])
    k = upper / upper[2, 2]
    lens = BrownConrady(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
    camera = ExplicitCamera(name, *size, lens, Pose(rotation, translation))
    if abs(k[0, 1]) < 1e-9 * k[0, 0]:
        return camera, None
    return _remove_skew(camera, np.linalg.inv(k))


def _remove_skew(camera: ExplicitCamera, ray_from_pixel: Floats) -> tuple[ExplicitCamera, Cost | None]:
    """The camera at the same place whose pixels are nearest to those of a skewed one, and what that costs."""
    uv = pixel_lattice(camera)
    rays = np.column_stack([uv, np.ones(len(uv))]) @ ray_from_pixel.T
    start = np.array(astuple(camera.lens)[:4])
    scale = np.append(np.full(4, start[0]), np.ones(3))

    def project_turned(x: Floats) -> tuple[Floats, Floats]:
        lens, turn = start + scale[:4] * x[:4], rotation_from_vector(x[4:])
        at = rays @ turn.T
        return lens, np.asarray(lens[:2] * at[:, :2] / at[:, 2:] + lens[2:], dtype=np.float64)

    x = least_squares(lambda x: (project_turned(x)[1] - uv).ravel(), np.zeros(7), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    lens, at = project_turned(x)
    turn, pose = rotation_from_vector(x[4:]), camera.camera_from_world
    moved = Pose(turn @ pose.rotation, turn @ pose.translation)
    cost = Cost.between(at, uv)
    found = replace(camera, lens=BrownConrady(*lens.tolist()), camera_from_world=moved)
    return found, cost if cost.largest > ROUNDING_PX else None
