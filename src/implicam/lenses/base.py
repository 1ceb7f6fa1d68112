"""What a lens is: which pixel a point in front of a camera falls on, and which ray a pixel looks along.

Camera frame: x right, y down, z forward. Pixels (u, v), (0, 0) the centre of the top-left pixel. A lens without an
answer says `valid = False` and gives NaN: a point behind the camera, or so far off the axis that the distortion has
turned back and would put it on top of another point. To add a lens: CONTRIBUTING.md, "A lens".
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import Field, astuple
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from implicam.errors import FitError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_LOG = logging.getLogger(__name__)

ROUND_TRIP_PX = 1e-6
"""A ray that does not come back to its pixel within this (and rounding, far off the image) is no answer."""


class Lens(Protocol):
    """A frozen dataclass whose fields are the parameters of one family of lenses: fx, fy, cx, cy in pixels come first,
    then those of the distortion, all zero for none. `implicam.testing.check_lens` checks all that is said here.

    A fit moves the parameters without bounds: whatever they are, pixels are one-to-one, or NaN.
    """

    family: ClassVar[str]
    """The name of the family on the command line, in Python and in calibration files."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init__(self, *parameters: float) -> None: ...

    @property
    def fx(self) -> float:
        """Focal length along u at the middle of the image, pixels: the slope of the pixels on the axis."""

    @property
    def fy(self) -> float:
        """Focal length along v at the middle of the image, pixels."""

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
        """The derivative of the pixels with respect to the points.

        Args:
            points: (n, 3) in the camera frame.

        Returns:
            (n, 2, 3) in pixels per length unit of the points; NaN where there is no pixel.
        """

    def parameter_jacobian(self, points: Floats) -> Floats:
        """The derivative of the pixels with respect to the p parameters.

        Args:
            points: (n, 3) in the camera frame.

        Returns:
            (n, 2, p), in the order of the fields; NaN where there is no pixel.
        """

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
            sds: standard deviations in the place of the family's own, which the settings have for the families of
                this package only; another family may ignore them.

        Returns:
            Mean (p - 4,), which need not be zero, and precision (p - 4, p - 4) of the parameters after cy.
        """

    @classmethod
    def nearest(cls, lens: Lens, points: Floats) -> Self:
        """The lens of this family whose pixels are nearest to those of another lens: what a fit starts from.

        Args:
            lens: of any family.
            points: (n, 3) in the camera frame, all seen by that lens.

        Raises:
            FitError: no lens of this family was found that sees these points.
        """


DistortionSds = tuple[tuple[float, ...], tuple[float, ...]]
"""Of each parameter of the distortion: its sd, and the sd of what its term may do at the edge of the image."""

AnyLens = TypeVar("AnyLens", bound=Lens)

MAX_FIT_STEPS = 200

WAYPOINTS = 16

MIN_GAIN_PX = 1e-3
"""A later start must be nearer by more than this: where there is nothing to tell them apart, the first is kept."""

MAX_STALLED_COSINE = 1e-3
"""Of the angle between what a fit left and what its parameters can still change: at the optimum it is zero."""

MAX_STALLED_FOCAL_LENGTHS = 1e-3
"""A fit that stalled is taken where it is off by no more than this (rms): it is near enough to start from."""


def fit_lens(start: AnyLens | Sequence[AnyLens], points: Floats, uv: Floats) -> AnyLens:
    """The lens of a family whose pixels are nearest to given ones, by least squares.

    Args:
        start: a lens that sees all the points; or several, where the sum of squares has more than one minimum: those
            that do not see them all are left out, and the best fit is kept.
        points: (n, 3) in the camera frame.
        uv: (n, 2) their pixels.

    Raises:
        FitError: no start sees them all; or the best fit stalled, so that a nearer lens may exist.
    """
    starts = list(start) if isinstance(start, Sequence) else [start]
    family = starts[0].family
    able = [one for one in starts if one.pixel_from_camera_point(points)[1].all()]
    if not able:
        seen = max(int(one.pixel_from_camera_point(points)[1].sum()) for one in starts)
        raise FitError(
            f"no start of {family} sees these points.",
            why=f"the best of {len(starts)} sees {seen} of {len(points)}; a wider lens of the family may see them all",
            fix=f"use another lens, or auto, for this camera; or give {family} other starts in its `nearest`",
        )
    best, *others = (_fit_from(one, points, uv) for one in able)
    for other in others:
        best = other if other.rms < best.rms - MIN_GAIN_PX else best
    if best.stalled:
        raise FitError(
            f"the fit of {family} to these points stalled {best.rms:.3g} px (rms) off.",
            why="every step to a nearer lens loses some of the points, or the steps ran out",
            fix=f"use another lens, or auto, for this camera; or give {family} other starts in its `nearest`",
        )
    if best.cosine > MAX_STALLED_COSINE and best.rms > ROUND_TRIP_PX:
        _LOG.info("the fit of %s stalled %.3g px off, which is near enough to start from", family, best.rms)
    return best.lens


class _LensFit(NamedTuple, Generic[AnyLens]):
    """A lens, its rms distance in pixels, the cosine of `MAX_STALLED_COSINE`, and the focal length it began with."""

    lens: AnyLens
    rms: float
    cosine: float
    focal: float

    @property
    def stalled(self) -> bool:
        """Whether it is neither at an optimum nor near enough."""
        return self.cosine > MAX_STALLED_COSINE and self.rms > MAX_STALLED_FOCAL_LENGTHS * self.focal


def _fit_from(start: AnyLens, points: Floats, uv: Floats) -> _LensFit[AnyLens]:
    """By one fit; or, where it stalls at a fold, by several to pixels on the way there: between two images that are
    one-to-one lie others that are."""
    direct = _fit(start, points, uv)
    if not direct.stalled:
        return direct
    before, found = start.pixel_from_camera_point(points)[0], _LensFit(start, 0.0, 0.0, direct.focal)
    for part in np.arange(1, WAYPOINTS + 1) / WAYPOINTS:
        found = _fit(found.lens, points, before + part * (uv - before))
    return min(direct, found, key=lambda fit: fit.rms)


def _fit(start: AnyLens, points: Floats, uv: Floats) -> _LensFit[AnyLens]:
    kind, first = type(start), np.array(astuple(start))
    scale = np.where(np.arange(len(first)) < 4, max(first[0], 1.0), 1.0)

    def residuals(step: Floats) -> Floats:
        pixel = kind(*(first + step * scale).tolist()).pixel_from_camera_point(points)[0]
        return np.nan_to_num(pixel - uv, nan=1e6).ravel()  # a step that loses a point is not taken

    def slopes(step: Floats) -> Floats:
        slope = kind(*(first + step * scale).tolist()).parameter_jacobian(points) * scale
        return np.nan_to_num(slope).reshape(-1, len(first))

    found = least_squares(residuals, np.zeros(len(first)), slopes, x_scale="jac", max_nfev=MAX_FIT_STEPS)
    left = np.linalg.norm(found.fun)
    sizes = np.linalg.norm(found.jac, axis=0) * left
    cosine = np.abs(found.jac.T @ found.fun) / np.where(sizes > 0, sizes, 1.0)
    lens = kind(*(first + found.x * scale).tolist())
    return _LensFit(lens, float(left / np.sqrt(len(points))), float(cosine.max()), abs(float(first[0])))


def focal_lengths(lens: Lens) -> tuple[float, float]:
    """The focal lengths at the middle of the image; by contract, the lens's fx and fy.

    Args:
        lens: Of any family.

    Returns:
        Along u and along v, pixels.
    """
    fx, fy = np.diagonal(lens.jacobian(np.array([[0.0, 0.0, 1.0]]))[0]).tolist()
    return fx, fy


def pixel_from_plane(lens: Lens, xy: Floats) -> Floats:
    """The pixels of places in the plane at distance 1, distorted already.

    Args:
        lens: Its focal lengths and principal point are used, and nothing else.
        xy: (n, 2) in the plane.

    Returns:
        (n, 2) pixels.
    """
    return xy * [lens.fx, lens.fy] + [lens.cx, lens.cy]


def plane_from_pixel(lens: Lens, uv: Floats) -> Floats:
    """The inverse of `pixel_from_plane`.

    Args:
        lens: Its focal lengths and principal point are used, and nothing else.
        uv: (n, 2) pixels.

    Returns:
        (n, 2) in the plane at distance 1, distorted still.
    """
    plane: Floats = (uv - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
    return plane


def check_rays(lens: Lens, rays: Floats, uv: Floats) -> tuple[Floats, Bools]:
    """Which rays a lens brings back to their pixels.

    Args:
        lens: Of any family.
        rays: (n, 3) directions in the camera frame, of any length.
        uv: (n, 2) pixels they should look along.

    Returns:
        Unit rays (n, 3), NaN where they do not come back within `ROUND_TRIP_PX`; and (n,) where they do.
    """
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    back, valid = lens.pixel_from_camera_point(rays)
    valid &= (np.abs(back - uv) < ROUND_TRIP_PX + 1e-12 * np.abs(uv)).all(axis=1)
    return np.where(valid[:, None], rays, np.nan), valid
