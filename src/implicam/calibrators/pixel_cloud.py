"""Whether pixels are like those that a method without cameras has learned from.

What C cameras see of a volume is a thin curved sheet of few dimensions in 2 C dimensions. The known points show where
it lies. Here it is described by its two leading principal components: the others are quadratic functions of these two,
plus what the known points scatter about that, in every direction by its own amount. So a point is far if it leaves the
known points' sheet (a wrong match), or leaves them where they are thin (positions in one plane, new ones off it).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from implicam.calibrators.inverse_gp_settings import DEFAULT_SETTINGS, InverseGPSettings
from implicam.dataset import Floats

LEADING_COMPONENTS = 2
ROUNDING_SDS = 1e-9
"""Of the pixels' spread: differences below it are rounding."""


@dataclass(frozen=True, eq=False)
class PixelCloud:
    """The known points' pixels: offset (d,), directions (d, d) divided by the common spread; coefficients (b, d - q) of
    the trailing components, scatter directions (d - q, d - q) scaled to unit variance, and the largest leave-one-out
    distance of a known point."""

    offset: Floats
    directions: Floats
    leading: int
    degree: int
    coefficients: Floats
    inverse: Floats
    whiten: Floats
    farthest: float

    @classmethod
    def of(cls, X: Floats, settings: InverseGPSettings = DEFAULT_SETTINGS) -> PixelCloud:
        """The cloud of the known points.

        Args:
            X: (n, d) their pixels.
            settings: From how many points on the sheet may be curved.

        Returns:
            Where their sheet lies, and how far they scatter about it.
        """
        n, d = X.shape
        offset = X.mean(axis=0)
        spread = np.sqrt(np.mean(X.var(axis=0)))
        directions = np.asarray(np.linalg.svd((X - offset) / spread)[2].T / spread)
        Z = (X - offset) @ directions
        q = min(LEADING_COMPONENTS, d - 1)
        curved = _terms(Z[:1, :q], 2).shape[1] + settings.min_points_for_curved_sheet
        degree = 2 if n >= curved else 1
        B = _terms(Z[:, :q], degree)
        Q, _ = np.linalg.qr(B)
        residual = Z[:, q:] - Q @ (Q.T @ Z[:, q:])
        freedom = max(1, n - B.shape[1])
        whiten = _whitening(residual.T @ residual / freedom, max(1, (freedom - 4) // 2))
        spare = np.maximum(1.0 - np.sum(Q**2, axis=1), 1e-6)
        left_out = np.linalg.norm(residual @ whiten, axis=1) / np.sqrt(spare)
        inverse, coefficients = np.asarray(np.linalg.pinv(B.T @ B)), np.asarray(np.linalg.pinv(B) @ Z[:, q:])
        return cls(offset, directions, q, degree, coefficients, inverse, whiten, float(left_out.max()))

    def farness(self, X: Floats) -> Floats:
        """How far pixels are off the known points' sheet.

        Args:
            X: (k, d) pixels.

        Returns:
            (k,) in the distance of the farthest known point from all others.
        """
        Z = (X - self.offset) @ self.directions
        B = _terms(Z[:, : self.leading], self.degree)
        variance_ratio = 1.0 + np.einsum("ij,jk,ik->i", B, self.inverse, B)
        off = np.linalg.norm((Z[:, self.leading :] - B @ self.coefficients) @ self.whiten, axis=1)
        return np.asarray(off / np.sqrt(variance_ratio) / self.farthest)


def _terms(T: Floats, degree: int) -> Floats:
    """(n, b) the powers of T (n, q) up to the degree, 1 or 2."""
    columns = [np.ones(len(T)), *T.T]
    if degree == 2:
        columns += [T[:, i] * T[:, j] for i in range(T.shape[1]) for j in range(i, T.shape[1])]
    return np.column_stack(columns)


def _whitening(covariance: Floats, directions: int) -> Floats:
    """(r, r) that gives the scatter unit variance in so many of its largest directions; the others, of which few points
    know little, share the mean of theirs."""
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, ROUNDING_SDS**2)
    least = max(0, len(values) - directions)
    if least:
        values[:least] = np.mean(values[:least])
    return np.asarray(vectors / np.sqrt(values))
