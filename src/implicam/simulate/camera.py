"""One simulated camera: a lens, a pose, and a smooth error of the image that no lens model contains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from implicam.cameras import Lens
from implicam.dataset import Floats
from implicam.geometry import Pose

WAVES = 64
RANGE = 0.6
"""Length scale of the smooth error, in half image diagonals."""


@dataclass(frozen=True, eq=False)
class SmoothError:
    """A smooth shift of the image, in pixels, as a function of the pixel: random waves minus their affine part.

    A sum of random Fourier features (Rahimi & Recht 2007) is nearly a sample of a Gaussian process with a
    squared-exponential kernel, and has an exact derivative. Its affine part is taken away because a focal length, a
    principal point or a rotation would absorb it.
    frequencies: (waves, 2) radians per pixel; phases: (waves,) radians; amplitudes: (waves, 2) pixels in u and v;
    affine: (3, 2) pixels, to be subtracted for (1, u, v). rms: over the image, pixels per coordinate.
    """

    frequencies: Floats
    phases: Floats
    amplitudes: Floats
    affine: Floats
    rms: float

    def at(self, uv: Floats) -> Floats:
        """(n, 2) shift at pixels (n, 2)."""
        waves: Floats = np.cos(uv @ self.frequencies.T + self.phases) @ self.amplitudes
        return waves - _affine_basis(uv) @ self.affine

    def jacobian(self, uv: Floats) -> Floats:
        """(n, 2, 2) derivative of the shift with respect to the pixel."""
        slope = -np.sin(uv @ self.frequencies.T + self.phases)
        waves: Floats = np.einsum("nw,wi,wj->nij", slope, self.amplitudes, self.frequencies, optimize=True)
        return waves - self.affine[1:].T


def random_error(rng: np.random.Generator, width: int, height: int, rms: float) -> SmoothError:
    """A smooth error whose root mean square over the image is `rms` pixels in u and in v."""
    frequencies = rng.normal(size=(WAVES, 2)) / (RANGE * 0.5 * np.hypot(width, height))
    phases = rng.uniform(0, 2 * np.pi, WAVES)
    amplitudes = rng.normal(size=(WAVES, 2))
    pixels = _pixel_grid(width, height)
    waves = np.cos(pixels @ frequencies.T + phases) @ amplitudes
    affine = np.linalg.lstsq(_affine_basis(pixels), waves)[0]
    size = np.sqrt(np.mean((waves - _affine_basis(pixels) @ affine) ** 2, axis=0))
    return SmoothError(frequencies, phases, amplitudes * rms / size, affine * rms / size, rms)


@dataclass(frozen=True, eq=False)
class SimulatedCamera:
    """A camera that knows itself perfectly: image size in pixels, lens, pose, smooth error, noise in pixels."""

    name: str
    width: int
    height: int
    lens: Lens
    camera_from_world: Pose
    error: SmoothError
    noise_sd: float

    def pixel_from_world(self, xyz: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Pixels (n, 2) of world points (n, 3), without noise, and (n,) where they fall on the image.

        NaN where the lens gives no pixel at all; a pixel outside the image keeps its numbers.
        """
        uv, valid = self.lens.pixel_from_camera_point(self.camera_from_world.apply(xyz))
        uv = uv + self.error.at(uv)
        on_image = (
            np.abs(uv - [(self.width - 1) / 2, (self.height - 1) / 2]) <= [self.width / 2, self.height / 2]
        ).all(1)
        return uv, valid & on_image

    def jacobian(self, xyz: Floats) -> Floats:
        """(n, 2, 3) derivative of the pixels with respect to the world points, the smooth error included."""
        points = self.camera_from_world.apply(xyz)
        uv, _ = self.lens.pixel_from_camera_point(points)
        bend = np.eye(2) + self.error.jacobian(uv)
        jacobian: Floats = bend @ self.lens.jacobian(points) @ self.camera_from_world.rotation
        return jacobian


def _affine_basis(uv: Floats) -> Floats:
    return np.column_stack([np.ones(len(uv)), uv])


def _pixel_grid(width: int, height: int) -> Floats:
    u, v = np.meshgrid(np.linspace(0, width - 1, 41), np.linspace(0, height - 1, 33))
    return np.column_stack([u.ravel(), v.ravel()])
