"""The odd polynomial t (1 + k1 t² + k2 t⁴ + ...) of distortion, its inverse, and divisions that may be by zero."""

from __future__ import annotations

import numpy as np

from implicam.lenses.base import Floats


def odd_polynomial(t: Floats, k: tuple[float, ...]) -> Floats:
    """The distortion polynomial t (1 + k1 t² + k2 t⁴ + ...).

    Args:
        t: Where; of any shape.
        k: k1, k2, ...: one or more.

    Returns:
        Its values, of the same shape.
    """
    return t * _polynomial([*k[::-1], 1.0], t * t)


def odd_polynomial_slope(t: Floats, k: tuple[float, ...]) -> Floats:
    """The derivative of `odd_polynomial` by t.

    Args:
        t: Where; of any shape.
        k: k1, k2, ...: one or more.

    Returns:
        The slopes, of the same shape.
    """
    return _polynomial(_slope_in_square(k), t * t)


def _polynomial(coefficients: list[float], x: Floats) -> Floats:
    """Horner's rule, the highest coefficient first; NumPy's is as long in its preparations."""
    value = coefficients[0] * x + coefficients[1]
    for c in coefficients[2:]:
        value = value * x + c
    return value


def _slope_in_square(k: tuple[float, ...]) -> list[float]:
    """Coefficients, highest first, of the polynomial's derivative 1 + 3 k1 t² + 5 k2 t⁴ + ... in t²."""
    return [(2 * i + 3) * k[i] for i in reversed(range(len(k)))] + [1.0]


def first_turning_point(k: tuple[float, ...]) -> float:
    """The smallest positive t where the polynomial stops growing; infinite where it never does.

    Args:
        k: k1, k2, ...: one or more.

    Returns:
        This t.
    """
    if min(k) >= 0:
        return float("inf")
    roots = np.roots(_slope_in_square(k))
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if real.size else float("inf")


def invert_odd_polynomial(value: Floats, k: tuple[float, ...], upper: float) -> Floats:
    """The t at which the polynomial has given values: Newton's method kept inside a bracket.

    Args:
        value: 0 or more; of any shape.
        k: k1, k2, ...: one or more.
        upper: Where the polynomial stops growing, as `first_turning_point` says; may be infinite.

    Returns:
        t in [0, upper), of the same shape; NaN where the polynomial does not come so far.
    """
    low, high = np.zeros_like(value), np.full_like(value, upper if np.isfinite(upper) else 1.0)
    if not np.isfinite(upper):
        for _ in range(60):  # grows without end, so some power of two is beyond
            high = np.where(odd_polynomial(high, k) < value, 2 * high, high)
    t = np.minimum(value, 0.5 * high)
    for _ in range(60):
        error = odd_polynomial(t, k) - value
        low, high = np.where(error <= 0, t, low), np.where(error >= 0, t, high)
        slope = odd_polynomial_slope(t, k)
        newton = t - error / np.where(slope > 0, slope, np.nan)
        t = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
    beyond = ~(value <= odd_polynomial(np.full_like(value, upper), k)) if np.isfinite(upper) else ~np.isfinite(value)
    return np.where(beyond, np.nan, t)


def divide(a: Floats | float, b: Floats, at_zero: Floats | float) -> Floats:
    """`a / b`, and its limit `at_zero` where b is zero.

    Args:
        a: The numerator.
        b: The denominator, of any shape that broadcasts with `a`.
        at_zero: The value where b is zero.

    Returns:
        The quotients.
    """
    zero = b == 0
    return np.where(zero, at_zero, a / np.where(zero, 1.0, b))


def solve_2x2(matrices: Floats, vectors: Floats) -> Floats:
    """Solve (n, 2, 2) x = (n, 2) by Cramer's rule; a singular matrix gives NaN.

    Args:
        matrices: (n, 2, 2).
        vectors: (n, 2) right hand sides.

    Returns:
        (n, 2) the x; NaN where a matrix is singular.
    """
    (a, b), (c, d) = matrices[:, 0].T, matrices[:, 1].T
    det = a * d - b * c
    x, y = vectors.T
    return np.column_stack([d * x - b * y, a * y - c * x]) / np.where(det == 0, np.nan, det)[:, None]
