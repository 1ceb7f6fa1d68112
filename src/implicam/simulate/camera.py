"""One simulated camera: a lens, a pose, and a smooth error of the image that no lens model contains.

The light of a point goes through a window if there is one, a mirror if there is one, the lens, and falls on a sensor
that may be tilted; the smooth error comes last. Pixels that are not square and a sensor that is cropped are the lens's
own fx, fy, cx, cy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats
from implicam.geometry import Pose, rotation_from_vector
from implicam.lenses import Lens, focal_lengths
from implicam.simulate.window import Window

WAVE_COUNT = 64
LENGTH_SCALE_HALF_DIAGONALS = 0.6
"""Length scale of the smooth error, in half image diagonals."""


@dataclass(frozen=True, eq=False)
class SmoothError:
    """A smooth shift of the image, in pixels, as a function of the pixel: random waves minus their affine part.

    A sum of random Fourier features (Rahimi & Recht 2007) is nearly a sample of a Gaussian process with a
    squared-exponential kernel, and has an exact derivative. Its affine part is taken away because a focal length, a
    principal point or a rotation would absorb it.

    Attributes:
        frequencies: (waves, 2) radians per pixel.
        phases: (waves,) radians.
        amplitudes: (waves, 2) pixels in u and v.
        affine: (3, 2) pixels, to be subtracted for (1, u, v).
        rms: Root mean square over the image, pixels per coordinate.
    """

    frequencies: Floats
    phases: Floats
    amplitudes: Floats
    affine: Floats
    rms: float

    def at(self, uv: Floats) -> Floats:
        """The shift at pixels.

        Args:
            uv: (n, 2) pixels.

        Returns:
            (n, 2) pixels.
        """
        waves: Floats = np.cos(uv @ self.frequencies.T + self.phases) @ self.amplitudes
        return waves - _affine_basis(uv) @ self.affine

    def jacobian(self, uv: Floats) -> Floats:
        """The derivative of the shift with respect to the pixel.

        Args:
            uv: (n, 2) pixels.

        Returns:
            (n, 2, 2).
        """
        slope = -np.sin(uv @ self.frequencies.T + self.phases)
        waves: Floats = np.einsum("nw,wi,wj->nij", slope, self.amplitudes, self.frequencies, optimize=True)
        return waves - self.affine[1:].T


def random_error(rng: np.random.Generator, width: int, height: int, rms: float) -> SmoothError:
    """A random smooth error of a given size.

    Args:
        rng: Random numbers.
        width: Of the image, pixels.
        height: Of the image, pixels.
        rms: Its root mean square over the image, in pixels, in u and in v.
    """
    frequencies = rng.normal(size=(WAVE_COUNT, 2)) / (LENGTH_SCALE_HALF_DIAGONALS * 0.5 * np.hypot(width, height))
    phases = rng.uniform(0, 2 * np.pi, WAVE_COUNT)
    amplitudes = rng.normal(size=(WAVE_COUNT, 2))
    pixels = _pixel_grid(width, height)
    waves = np.cos(pixels @ frequencies.T + phases) @ amplitudes
    affine = np.linalg.lstsq(_affine_basis(pixels), waves)[0]
    size = np.sqrt(np.mean((waves - _affine_basis(pixels) @ affine) ** 2, axis=0))
    return SmoothError(frequencies, phases, amplitudes * rms / size, affine * rms / size, rms)


def error_process(width: int, height: int, rms: float) -> tuple[float, float]:
    """The Gaussian process that smooth errors are drawn from, before their affine part is taken away.

    Args:
        width: Of the image, in pixels.
        height: Of the image, in pixels.
        rms: Root mean square in pixels of what is left on average.

    Returns:
        Its standard deviation in pixels, and its lengthscale in half the longer side of the image.
    """
    lengthscale = LENGTH_SCALE_HALF_DIAGONALS * 0.5 * float(np.hypot(width, height))
    pixels = _pixel_grid(width, height)[::2]
    scaled = pixels / lengthscale
    squares = np.sum(scaled**2, axis=1)
    K = np.exp(-0.5 * (squares[:, None] + squares - 2 * scaled @ scaled.T))
    basis = np.linalg.qr(_affine_basis(pixels))[0]
    left = (np.trace(K) - np.trace(basis.T @ K @ basis)) / len(pixels)
    return rms / float(np.sqrt(left)), lengthscale / (max(width, height) / 2)


@dataclass(frozen=True, eq=False)
class SimulatedCamera:
    """A camera whose model is known exactly.

    Attributes:
        name: Its name.
        width: Of the image, pixels.
        height: Of the image, pixels.
        lens: The lens.
        camera_from_world: The pose; of a mirrored camera, where it seems to stand behind the mirror.
        error: The smooth error that no lens model contains.
        noise_sd: Standard deviation of a view per coordinate, pixels.
        tilt: Rotation vector in radians about the image's u and v axes by which the sensor is turned away from square
            to the lens's axis, about the point where that axis meets it (Scheimpflug).
        mirrored: Whether it looks into a plane mirror; v counted from below and a left-handed world are the same.
        window: A flat pane in front of it, with water behind; None for none.
    """

    name: str
    width: int
    height: int
    lens: Lens
    camera_from_world: Pose
    error: SmoothError
    noise_sd: float
    tilt: tuple[float, float] = (0.0, 0.0)
    mirrored: bool = False
    window: Window | None = None

    def pixel_from_world(self, xyz: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """The pixels of world points, without noise.

        Args:
            xyz: (n, 3) in the world.

        Returns:
            (n, 2) pixels, NaN where the lens gives none; and (n,) whether they fall on the image. A pixel outside the
            image keeps its numbers.
        """
        uv, valid = self.lens.pixel_from_camera_point(self._before_lens(xyz))
        if self._tilting is not None:
            uv, facing = _projected(self._tilting, uv)
            valid = valid & facing
        uv = uv + self.error.at(uv)
        on_image = (
            np.abs(uv - [(self.width - 1) / 2, (self.height - 1) / 2]) <= [self.width / 2, self.height / 2]
        ).all(1)
        return uv, valid & on_image

    def jacobian(self, xyz: Floats) -> Floats:
        """The derivative of the pixels with respect to the world points, the smooth error included.

        Args:
            xyz: (n, 3) in the world.

        Returns:
            (n, 2, 3) pixels per length unit; NaN where there is no pixel.
        """
        points = self._before_lens(xyz)
        uv, _ = self.lens.pixel_from_camera_point(points)
        along = self.lens.jacobian(points)
        if self._tilting is not None:
            along = _projected_slope(self._tilting, uv) @ along
            uv, _ = _projected(self._tilting, uv)
        if self.mirrored:
            along = along * MIRROR_SIGNS
        if self.window is not None:
            along = along @ self.window.jacobian(self.camera_from_world.apply(xyz))
        bend = np.eye(2) + self.error.jacobian(uv)
        jacobian: Floats = bend @ along @ self.camera_from_world.rotation
        return jacobian

    def ray_from_pixel(self, uv: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """The rays that pixels look along, in front of any window.

        The smooth error is left out: subtract it from the pixels first where it matters.

        Args:
            uv: (n, 2) pixels.

        Returns:
            (n, 3) unit vectors in the camera frame, NaN where there is none; and (n,) whether there is one.
        """
        if self._tilting is not None:
            uv, _ = _projected(np.asarray(np.linalg.inv(self._tilting), dtype=np.float64), uv)
        rays, valid = self.lens.ray_from_pixel(uv)
        return rays * MIRROR_SIGNS if self.mirrored else rays, valid

    def _before_lens(self, xyz: Floats) -> Floats:
        """Where world points (n, 3) seem to be to the lens, in the camera frame."""
        points = self.camera_from_world.apply(xyz)
        if self.window is not None:
            points, _ = self.window.apparent(points)
        return points * MIRROR_SIGNS if self.mirrored else points

    @cached_property
    def _tilting(self) -> Floats | None:
        """(3, 3) pixels on the tilted sensor from pixels on one square to the axis, None for none.

        A ray (x, y, 1) meets the plane through (0, 0, 1) that the rotation's first two columns span.
        """
        if not any(self.tilt):
            return None
        turn = rotation_from_vector([*self.tilt, 0.0])
        ray_to_plane = np.vstack([turn.T[:2] * turn[2, 2] - np.outer(turn[2, :2], turn[:, 2]), turn[:, 2]])
        fx, fy = focal_lengths(self.lens)  # not its own fx and fy: a lens of another package may mean others by them
        intrinsics = np.array([[fx, 0, self.lens.cx], [0, fy, self.lens.cy], [0, 0, 1]])
        return np.asarray(intrinsics @ ray_to_plane @ np.linalg.inv(intrinsics), dtype=np.float64)


MIRROR_SIGNS = np.array([-1.0, 1.0, 1.0])
"""Signs of x, y, z in the camera frame after a mirror."""


def _projected(homography: Floats, uv: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Pixels (n, 2) by a homography, and (n,) which are before it; NaN for the others."""
    ends = uv @ homography[:, :2].T + homography[:, 2]
    before = ends[:, 2] > 0
    return ends[:, :2] / np.where(before, ends[:, 2], np.nan)[:, None], before


def _projected_slope(homography: Floats, uv: Floats) -> Floats:
    """(n, 2, 2) derivative of `_projected`."""
    to, _ = _projected(homography, uv)
    scale = uv @ homography[2, :2] + homography[2, 2]
    slope = homography[:2, :2] - to[:, :, None] * homography[2, :2]
    return np.asarray(slope / scale[:, None, None], dtype=np.float64)


def _affine_basis(uv: Floats) -> Floats:
    return np.column_stack([np.ones(len(uv)), uv])


def _pixel_grid(width: int, height: int) -> Floats:
    u, v = np.meshgrid(np.linspace(0, width - 1, 41), np.linspace(0, height - 1, 33))
    return np.column_stack([u.ravel(), v.ravel()])
