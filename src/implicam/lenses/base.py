"""What a lens is: which pixel a point in front of a camera falls on, and which ray a pixel looks along.

Camera frame: x right, y down, z forward. Pixels (u, v), (0, 0) the centre of the top-left pixel. A lens without an
answer says `valid = False` and gives NaN: a point behind the camera, or so far off the axis that the distortion has
turned back and would put it on top of another point. To add a lens: CONTRIBUTING.md, "A lens".
"""

from __future__ import annotations

from dataclasses import Field, astuple
from typing import Any, ClassVar, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from implicam.errors import FitError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

ROUND_TRIP_PX = 1e-6
"""A ray that does not come back to its pixel within this (and rounding, far off the image) is no answer."""


class Lens(Protocol):
    """A frozen dataclass whose fields are the parameters of one family of lenses: fx, fy, cx, cy in pixels come first,
    then those of the distortion, all zero for none.
    """

    family: ClassVar[str]
    """The name of the family on the command line, in Python and in calibration files."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init__(self, *parameters: float) -> None: ...

    @property
    def fx(self) -> float:
        """Focal length along u, pixels."""

    @property
    def fy(self) -> float:
        """Focal length along v, pixels."""

    @property
    def cx(self) -> float:
        """Principal point, u."""

    @property
    def cy(self) -> float:
        """Principal point, v."""

    def pixel_from_camera_point(self, points: Floats) -> tuple[Floats, Bools]:
        """The pixels of points.

        Args:
            points: (n, 3) in the camera frame, any length unit.

        Returns:
            (n, 2) pixels, NaN where there is none, and (n,) whether there is one.
        """

    def jacobian(self, points: Floats) -> Floats:
        """(n, 2, 3) derivative of the pixels with respect to the points (n, 3); NaN where there is no pixel."""

    def parameter_jacobian(self, points: Floats) -> Floats:
        """(n, 2, p) derivative of the pixels of points (n, 3) by the p parameters; NaN where there is no pixel."""

    def ray_from_pixel(self, uv: Floats) -> tuple[Floats, Bools]:
        """The rays that pixels look along.

        Args:
            uv: (n, 2) pixels.

        Returns:
            (n, 3) unit vectors in the camera frame, NaN where there is none, and (n,) whether there is one.
        """

    def distortion_prior(self, widest: float, sds: DistortionSds | None = None) -> tuple[Floats, Floats]:
        """The normal prior of the distortion of a lens that is used up to an angle off its axis.

        Args:
            widest: the angle, radians.
            sds: standard deviations in the place of the family's own.

        Returns:
            Mean (p - 4,) and precision (p - 4, p - 4) of the parameters after cy.
        """

    @classmethod
    def nearest(cls, lens: Lens, points: Floats) -> Self:
        """The lens of this family whose pixels are nearest to those of another lens: what a fit starts from.

        Args:
            lens: of any family.
            points: (n, 3) in the camera frame, all seen by that lens.

        Raises:
            FitError: no lens of this family sees these points.
        """


DistortionSds = tuple[tuple[float, ...], tuple[float, ...]]
"""Of each parameter of the distortion: its sd, and the sd of what its term may do at the edge of the image."""

AnyLens = TypeVar("AnyLens", bound=Lens)


def fit_lens(start: AnyLens, points: Floats, uv: Floats) -> AnyLens:
    """The lens of a family whose pixels are nearest to given ones, by least squares.

    Args:
        start: a lens that sees all the points.
        points: (n, 3) in the camera frame.
        uv: (n, 2) their pixels.

    Raises:
        FitError: the start does not see them all.
    """
    kind, first = type(start), np.array(astuple(start))
    if not start.pixel_from_camera_point(points)[1].all():
        raise FitError(f"no {start.family} lens sees these points.", fix="use another lens, or auto, for this camera")
    scale = np.where(np.arange(len(first)) < 4, max(first[0], 1.0), 1.0)

    def residuals(step: Floats) -> Floats:
        pixel = kind(*(first + step * scale).tolist()).pixel_from_camera_point(points)[0]
        return np.nan_to_num(pixel - uv, nan=1e6).ravel()

    def slopes(step: Floats) -> Floats:
        slope = kind(*(first + step * scale).tolist()).parameter_jacobian(points) * scale
        return np.nan_to_num(slope).reshape(-1, len(first))

    found = least_squares(residuals, np.zeros(len(first)), slopes, max_nfev=50)
    return kind(*(first + found.x * scale).tolist())


def pixel_from_plane(lens: Lens, xy: Floats) -> Floats:
    """(n, 2) pixels of places (n, 2) in the plane at distance 1, distorted already."""
    return xy * [lens.fx, lens.fy] + [lens.cx, lens.cy]


def plane_from_pixel(lens: Lens, uv: Floats) -> Floats:
    """The inverse of `pixel_from_plane`."""
    plane: Floats = (uv - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
    return plane


def check_rays(lens: Lens, rays: Floats, uv: Floats) -> tuple[Floats, Bools]:
    """Unit rays, NaN where the lens does not bring them back to their pixel; and (n,) where it does."""
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    back, valid = lens.pixel_from_camera_point(rays)
    valid &= (np.abs(back - uv) < ROUND_TRIP_PX + 1e-12 * np.abs(uv)).all(axis=1)
    return np.where(valid[:, None], rays, np.nan), valid
