"""Stationary kernels with one lengthscale per input dimension (ARD).

With `r² = Σ_k ((x_k - x'_k) / lengthscale_k)²` a kernel is `signal_variance * correlation(r²)`; its derivative with
respect to `log lengthscale_k` is `signal_variance * slope(r²) * ((x_k - x'_k) / lengthscale_k)²`. So a kernel is these
two functions of r², and to add one is to add a line to `SHAPES`.
Rasmussen & Williams, Gaussian Processes for Machine Learning (2006), eqs. 4.9, 4.17 and section 5.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from implicam.errors import UsageError, did_you_mean

Floats = NDArray[np.float64]


def _squared_exponential(d2: Floats) -> tuple[Floats, Floats]:
    d2 *= -0.5
    correlation = np.exp(d2, out=d2)
    return correlation, correlation


def _matern52(d2: Floats) -> tuple[Floats, Floats]:
    s = np.sqrt(5.0 * np.maximum(d2, 0.0, out=d2))
    decay = np.exp(-s)
    slope = (5.0 / 3.0) * (1.0 + s) * decay
    return (1.0 + s + (5.0 / 3.0) * d2) * decay, slope


SHAPES: dict[str, Callable[[Floats], tuple[Floats, Floats]]] = {
    "squared-exponential": _squared_exponential,
    "matern-5/2": _matern52,
}
"""Name -> function of r² that gives (correlation, slope) and may overwrite its argument."""


def squared_distances(A: Floats, B: Floats) -> Floats:
    """Squared Euclidean distances, by one matrix product.

    Rounding leaves errors of about 1e-16 |a|², so inputs should be centred; negative results are set to zero.

    Args:
        A: (n, d).
        B: (m, d).

    Returns:
        (n, m).
    """
    d2 = A @ B.T
    d2 *= -2.0
    d2 += np.einsum("ij,ij->i", A, A)[:, None]
    d2 += np.einsum("ij,ij->i", B, B)
    if A is B:
        np.fill_diagonal(d2, 0.0)
    return np.maximum(d2, 0.0, out=d2)


@dataclass(frozen=True, eq=False)
class Kernel:
    """The covariance function `signal_variance * correlation(r²)`.

    Attributes:
        shape: A key of `SHAPES`.
        signal_variance: In squared units of the output.
        lengthscale: (d,), in units of the inputs.

    Raises:
        UsageError: There is no such shape, or a number is not positive and finite.
    """

    shape: str
    signal_variance: float
    lengthscale: Floats

    def __post_init__(self) -> None:
        lengthscale = np.array(self.lengthscale, dtype=np.float64)
        if self.shape not in SHAPES:
            raise UsageError(
                f"there is no kernel {self.shape!r}{did_you_mean(self.shape, SHAPES)}.",
                fix=f"the kernels are {', '.join(SHAPES)}",
            )
        positive = self.signal_variance > 0 and (lengthscale > 0).all()
        if lengthscale.ndim != 1 or not positive or not np.isfinite([self.signal_variance, *lengthscale]).all():
            raise UsageError("signal_variance and every lengthscale must be positive and finite, lengthscale (d,).")
        lengthscale.setflags(write=False)
        object.__setattr__(self, "lengthscale", lengthscale)

    def __call__(self, A: Floats, B: Floats) -> Floats:
        """The covariance of the function values at two sets of inputs.

        Args:
            A: (n, d).
            B: (m, d).

        Returns:
            (n, m).
        """
        scaled = A / self.lengthscale
        d2 = squared_distances(scaled, scaled if A is B else B / self.lengthscale)
        return self.of_squared_distances(d2)

    def of_squared_distances(self, d2: Floats) -> Floats:
        """The covariance of function values at inputs so far apart.

        Args:
            d2: Squared distances in lengthscales, of any shape; may be overwritten.

        Returns:
            The shape of `d2`.
        """
        return self.signal_variance * SHAPES[self.shape](d2)[0]
