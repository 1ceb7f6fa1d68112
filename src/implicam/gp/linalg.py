"""Cholesky factors that either succeed or say why not. No jitter is ever added in silence."""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

from implicam.errors import NumericalError
from implicam.gp.kernels import Floats


def cholesky(K: Floats) -> Floats:
    """Lower L with `L L^T = K` (Rasmussen & Williams Alg. 2.1 line 2). K is overwritten if it is Fortran-ordered."""
    L, info = lapack.dpotrf(K, lower=1, clean=1, overwrite_a=1)
    if info != 0:
        raise _reason(K, info)
    return L  # type: ignore[no-any-return]


def _reason(K: Floats, info: int) -> NumericalError:
    if not np.isfinite(np.tril(K)).all():
        return NumericalError(
            "the covariance matrix holds NaN or infinity.",
            why="an input, an output or a hyperparameter is not finite, or too large for a float64",
            fix="check the data for absurd values and standardise them",
        )
    return NumericalError(
        f"the {len(K)} x {len(K)} covariance matrix is not positive definite: its leading {info} rows are not.",
        why=f"to rounding (1e-16), row {info} is a combination of the rows before it, and the noise variance is too "
        "small to tell them apart: two inputs coincide, or the lengthscales are far longer than the data's extent",
        fix="raise the noise variance, remove the repeated point, or shorten the lengthscales",
    )


def solve_lower(L: Floats, B: Floats) -> Floats:
    """`L^-1 B` for lower-triangular L; B is (n,) or (n, m)."""
    x, info = lapack.dtrtrs(L, B, lower=1)
    if info != 0:
        raise NumericalError(f"the triangular factor has a zero in row {info}.", fix="raise the noise variance")
    return x  # type: ignore[no-any-return]


def solve(L: Floats, b: Floats) -> Floats:
    """`(L L^T)^-1 b`."""
    x, _ = lapack.dpotrs(L, b, lower=1)
    return x  # type: ignore[no-any-return]
