"""Cholesky factors that either succeed or say why not. Jitter is never added.

SciPy's Python wrappers of LAPACK keep the interpreter locked while they work, so two threads take turns. The costly
calls therefore go to the same routines by their C pointers, which ctypes calls with the lock released.
"""

from __future__ import annotations

import ctypes
from ctypes import byref, c_char, c_int
from typing import Any

import numpy as np
from scipy.linalg import cython_lapack, lapack

from implicam.errors import NumericalError
from implicam.gp.kernels import Floats


def cholesky(K: Floats) -> Floats:
    """Lower L with `L L^T = K` (Rasmussen & Williams Alg. 2.1 line 2).

    Args:
        K: (n, n) symmetric; overwritten if it is Fortran-ordered.

    Returns:
        (n, n), zero above the diagonal.

    Raises:
        NumericalError: K is not finite, or not positive definite.
    """
    L, info = lapack.dpotrf(K, lower=1, clean=1, overwrite_a=1)
    if info != 0:
        raise _reason(K, info)
    return L  # type: ignore[no-any-return]


def covariance_root(C: Floats) -> Floats:
    """R with `R R^T = C`, of a covariance that may be singular; what is negative by rounding counts as zero.

    Args:
        C: (n, n) symmetric.

    Returns:
        (n, n).
    """
    values, vectors = np.linalg.eigh(0.5 * (C + C.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)), dtype=np.float64)


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


def load_routine(name: str, arguments: int) -> Any:
    """A LAPACK routine, by the pointer that SciPy publishes for C callers.

    Args:
        name: Of the routine.
        arguments: How many it has.
    """
    capsule = cython_lapack.__pyx_capi__[name]
    get_name, get_pointer = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    get_name.restype, get_name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    get_pointer.restype, get_pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    prototype = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)
    return prototype(get_pointer(capsule, get_name(capsule)))


_DPOTRF, _DPOTRI, _DTRTRS = load_routine("dpotrf", 5), load_routine("dpotri", 5), load_routine("dtrtrs", 10)


def address(A: Floats) -> int:
    """The address of an array's numbers, for LAPACK.

    Args:
        A: Writeable, Fortran-ordered, float64.

    Raises:
        TypeError: It is not.
    """
    if A.dtype != np.float64 or not A.flags.f_contiguous or not A.flags.writeable:
        raise TypeError("LAPACK works in place on writeable Fortran-ordered float64 arrays")
    return int(A.ctypes.data)


def factor_in_place(A: Floats) -> int:
    """Replace the lower triangle of a matrix by its Cholesky factor; the upper is not touched.

    Args:
        A: (n, n) as of `address`.

    Returns:
        0, or the number of the row that failed, from 1.
    """
    n, info = c_int(len(A)), c_int(0)
    _DPOTRF(byref(c_char(b"L")), byref(n), address(A), byref(n), byref(info))
    return info.value


def invert_in_place(L: Floats) -> None:
    """Replace a Cholesky factor by the inverse of the matrix that it factors, lower triangle only.

    Args:
        L: (n, n) as of `address`.
    """
    n, info = c_int(len(L)), c_int(0)
    _DPOTRI(byref(c_char(b"L")), byref(n), address(L), byref(n), byref(info))


def solve_lower(L: Floats, B: Floats) -> Floats:
    """`L^-1 B` for a lower-triangular L.

    Args:
        L: (n, n); Fortran order avoids a copy.
        B: (n,) or (n, m).

    Returns:
        The shape of B.

    Raises:
        NumericalError: There is a zero on the diagonal of L.
    """
    x = np.array(B, dtype=np.float64, order="F")
    n, m, info = c_int(len(L)), c_int(1 if x.ndim == 1 else x.shape[1]), c_int(0)
    factor = np.asfortranarray(L)
    lower, plain, not_unit = (byref(c_char(letter)) for letter in (b"L", b"N", b"N"))
    _DTRTRS(lower, plain, not_unit, byref(n), byref(m), factor.ctypes.data, byref(n), address(x), byref(n), byref(info))
    if info.value != 0:
        raise NumericalError(f"the triangular factor has a zero in row {info.value}.", fix="raise the noise variance")
    return x


def solve(L: Floats, b: Floats) -> Floats:
    """`(L L^T)^-1 b` for a Cholesky factor L.

    Args:
        L: (n, n) lower.
        b: (n,) or (n, m).

    Returns:
        The shape of b.
    """
    x, _ = lapack.dpotrs(L, b, lower=1)
    return x  # type: ignore[no-any-return]
