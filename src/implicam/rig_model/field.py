"""The residual field of a camera: what no lens model contains, a Gaussian process over the image and the distance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from implicam.geometry import Floats
from implicam.gp import Kernel
from implicam.gp.low_rank import LowRank
from implicam.rig_model.camera import Image, Sight, View


class Hyperparameters(NamedTuple):
    """lengthscale (C, 2): across the image, in half its longer side, and in log distance, the same for cameras of one
    kind; signal and noise sd (C,) px."""

    lengthscale: Floats
    signal: Floats
    noise: Floats


def field_kernel(lengthscale: Floats) -> Kernel:
    """The kernel of a residual field over (u, v) in half the longer side and the log distance, eq. (8).

    Args:
        lengthscale: (2,) across the image, in half its longer side, and in scaled log distance.

    Returns:
        A squared-exponential kernel of unit variance.
    """
    return Kernel("squared-exponential", 1.0, lengthscale[[0, 0, 1]])


class DepthScale(NamedTuple):
    """How log distance becomes a coordinate of the field: its mean over the known points, and the unit it counts in."""

    mean: float = 0.0
    unit: float = 1.0

    @classmethod
    def of(cls, view: View | Sight, typical_sd: float) -> DepthScale:
        """The scale for the known points that a camera sees.

        Args:
            view: What the camera sees of them.
            typical_sd: Of their log distance in an ordinary rig.

        Returns:
            Their mean log distance; and as the unit their sd of it over the typical one, between 1e-6 and 1.
        """
        spread = float(np.std(view.log_distance))
        return cls(float(np.mean(view.log_distance)), min(max(spread / typical_sd, 1e-6), 1.0))


UNSCALED_DEPTH = DepthScale()
"""Log distance itself is the coordinate."""


def field_coordinates(view: View | Sight, image: Image, depth: DepthScale) -> Floats:
    """Where a field is looked up, eq. (8).

    Args:
        view: What a camera sees of n points.
        image: Where its pixels are measured from.
        depth: How log distance becomes a coordinate.

    Returns:
        (n, 3) pixel about the centre in half sides, scaled log distance.
    """
    return np.column_stack([(view.uv - image.centre) / image.half, (view.log_distance - depth.mean) / depth.unit])


def empty_field(lengthscale: Floats, q: Floats, tolerance: float) -> LowRank:
    """A field before it has any weights.

    Args:
        lengthscale: (2,) as of `field_kernel`.
        q: (n, 3) coordinates among which the inducing points are chosen.
        tolerance: As of `LowRank.of`.

    Returns:
        The field, with unit variance.
    """
    return LowRank.of(field_kernel(lengthscale), q, tolerance)
