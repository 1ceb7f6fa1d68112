"""A camera as fitted: its lens and pose, its residual field and its noise; and what such a camera saw."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.geometry import Bools, Floats
from implicam.gp.low_rank import LowRank
from implicam.rig_model.camera import Image, Prior, Sight, View
from implicam.rig_model.field import UNSCALED_DEPTH, DepthScale, field_coordinates
from implicam.rig_model.general_camera import AnyCamera


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A camera, its residual field and its noise; weights (m, 2) of the field's features, zero before the fit.

    The field is looked up where the `field_camera` sees a point: the camera as it was when the field was laid out. It
    stays when the camera moves, for a telephoto lens may move far along its axis with its focal length, and no pixel
    shows.
    """

    camera: AnyCamera
    field_camera: AnyCamera
    prior: Prior
    image: Image
    field: LowRank
    signal: float  # px
    noise: float  # px, of a view with the camera's usual noise
    weights: Floats
    depth: DepthScale = UNSCALED_DEPTH
    family: str = "ordinary"

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.camera.size + 2 * len(self.field.inducing)

    def coordinates(self, view: View | Sight) -> Floats:
        """Where the field is looked up.

        Args:
            view: What the `field_camera` sees of n points.

        Returns:
            (n, 3) pixel about the image's centre in half sides, and scaled log distance.
        """
        return field_coordinates(view, self.image, self.depth)

    def without_weights(self) -> CameraModel:
        """As it was before it saw anything."""
        return replace(self, weights=np.zeros_like(self.weights))

    @cached_property
    def _coefficients(self) -> Floats:
        return self.field.coefficients(self.signal * self.weights)

    def predict(self, points: Floats) -> tuple[Floats, Floats]:
        """Where the camera sees points, its residual field included.

        Args:
            points: (n, 3) in the working frame.

        Returns:
            Mean pixels (n, 2) and their derivative by the point (n, 2, 3); NaN where the lens has no answer.
        """
        at = self._look(points)
        return at.view.uv + at.K @ self._coefficients, self._slope(at, points)

    def pixel(self, points: Floats) -> Floats:
        """The mean pixels of `predict`, in a third of its time.

        Args:
            points: (n, 3) in the working frame.

        Returns:
            (n, 2), NaN where the lens has no answer.
        """
        seen = self.camera.sight(points)
        _, K = self._covariance(seen if self.field_camera is self.camera else self.field_camera.sight(points))
        return np.asarray(seen.uv + K @ self._coefficients, dtype=np.float64)

    def rows(self, points: Floats) -> Rows:
        """How the pixels of points depend on the camera's unknowns, about the present mean.

        Args:
            points: (n, 3) in the working frame.

        Returns:
            Mean pixels and their slopes; of these `by_point` is that of the camera without its field.
        """
        return self._rows(self._look(points))

    def rows_and_slope(self, points: Floats) -> tuple[Rows, Floats]:
        """`rows` and the slope of `predict` at once, in little more than the time of one.

        Args:
            points: (n, 3) in the working frame.

        Returns:
            How the pixels depend on the camera's unknowns; and (n, 2, 3) their derivative by the point, the field's
            included.
        """
        at = self._look(points)
        return self._rows(at), self._slope(at, points)

    def _look(self, points: Floats) -> _Looked:
        view = self.camera.view(points)
        q, K = self._covariance(view if self.field_camera is self.camera else self.field_camera.sight(points))
        return _Looked(view, q, K)

    def _covariance(self, measured: View | Sight) -> tuple[Floats, Floats]:
        """Where the field is looked up (n, 3), and its covariance with the inducing points (n, m)."""
        q = self.coordinates(measured)
        return q, self.field.kernel(q, self.field.inducing)

    def _rows(self, at: _Looked) -> Rows:
        phi = self.field.features_from(at.K)
        left = np.maximum(1 - np.sum(phi**2, axis=1), 0)
        mean = at.view.uv + at.K @ self._coefficients
        return Rows(mean, at.view.by_parameters, self.signal * phi, self.signal**2 * left, at.view.by_point)

    def _slope(self, at: _Looked, points: Floats) -> Floats:
        measured = at.view if self.field_camera is self.camera else self.field_camera.view(points)
        by_q = self.field.slope(at.q, at.K, self._coefficients)
        by_point = (
            at.view.by_point
            + by_q[:, :, :2] @ (measured.by_point / self.image.half)
            + by_q[:, :, 2, None] * (measured.distance_by_point[:, None, :] / self.depth.unit)
        )
        return np.asarray(by_point, dtype=np.float64)


class _Looked(NamedTuple):
    """What a camera sees of n points; where the field is looked up (n, 3), and its covariance with the inducing points
    (n, m)."""

    view: View
    q: Floats
    K: Floats


class Rows(NamedTuple):
    """pixel = mean + J step + phi (weights - their mean) + rest + noise, for n points.

    mean (n, 2); J (n, 2, p); phi (n, m), the same for u and v; rest (n,) variance the features leave, px^2; by_point
    (n, 2, 3).
    """

    mean: Floats
    J: Floats
    phi: Floats
    rest: Floats
    by_point: Floats


def apply_covariance_root(rows: Rows, root: Floats) -> Floats:
    """What a root of a camera's covariance makes of its pixels: the products `spread spread^T` of the result are the
    covariances of mean pixels.

    Args:
        rows: How n pixels depend on the camera's P unknowns.
        root: (q, P), W of the covariance W^T W.

    Returns:
        (n, 2, q) in pixels.
    """
    n, p, m = len(rows.J), rows.J.shape[2], rows.phi.shape[1]
    used = root.any(axis=1)  # of a rig whose cameras are tied, many rows are of other cameras alone
    if not used.all():
        wide = np.zeros((n, 2, len(root)))
        wide[:, :, used] = apply_covariance_root(rows, root[used])
        return wide
    out = (rows.J.reshape(2 * n, p) @ root[:, :p].T).reshape(n, 2, len(root))  # a stack of products takes ten times
    for i in range(2):
        out[:, i] += rows.phi @ root[:, p + i * m : p + (i + 1) * m].T
    return np.asarray(out, dtype=np.float64)


class CameraViews(NamedTuple):
    """What one camera saw: rows (n,) of the points, uv (n, 2), relative (n,) noise over the camera's."""

    rows: NDArray[np.int64]
    uv: Floats
    relative: Floats

    def select(self, keep: NDArray[np.bool_]) -> CameraViews:
        """Some of the views.

        Args:
            keep: (n,) which.

        Returns:
            These, in their order.
        """
        return CameraViews(self.rows[keep], self.uv[keep], self.relative[keep])


def thin_views(seen: CameraViews, most: int) -> CameraViews:
    """At most so many views, at random; always the same ones.

    Args:
        seen: What a camera saw.
        most: How many are kept.

    Returns:
        The views kept, in their order.
    """
    return seen if len(seen.rows) <= most else seen.select(random_subset(len(seen.rows), most))


def random_subset(n: int, most: int) -> Bools:
    """At most so many of n, at random; always the same ones.

    Args:
        n: How many there are.
        most: How many are kept.

    Returns:
        (n,) which are kept.
    """
    keep = np.full(n, n <= most)
    if n > most:
        keep[np.random.default_rng(0).choice(n, most, replace=False)] = True
    return keep
