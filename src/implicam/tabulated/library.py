"""The compiled kernel, loaded by ctypes where there is one."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from pathlib import Path
from typing import Any

VERSION = 1
"""Of the interface of kernel.c."""

NAME = "kernel.native"
"""The file that an installation has beside this one, where it could be compiled."""

MEASURED, TOO_FEW_VIEWS, LEFT_TO_EXACT, CONTRADICTION = range(4)
"""What the kernel says of a point."""


class Map(ctypes.Structure):
    """The tables of a rig, as kernel.c has them."""

    _fields_ = (
        ("cameras", ctypes.c_int64),
        ("cells", ctypes.c_int64 * 3),
        ("sight_cells", ctypes.c_int64),
        ("low", ctypes.c_double * 3),
        ("per_length", ctypes.c_double * 3),
        ("projections", ctypes.c_void_p),
        ("grid", ctypes.c_void_p),
        ("marked", ctypes.c_void_p),
        ("sight_frames", ctypes.c_void_p),
        ("sight", ctypes.c_void_p),
        ("min_p", ctypes.c_double),
        ("disagree_p", ctypes.c_double),
        ("agree_p", ctypes.c_double),
        ("clearly_better", ctypes.c_double),
        ("step_sds", ctypes.c_double),
        ("suspects_of_two", ctypes.c_int64),
        ("ties", ctypes.c_void_p),
        ("through", ctypes.c_void_p),
        ("unknowns", ctypes.c_int64),
    )


class Kernel:
    """The functions of a compiled kernel."""

    def __init__(self, path: Path) -> None:
        """Load it.

        Args:
            path: The file.

        Raises:
            OSError: It is no library for this machine, or of another version.
        """
        library = ctypes.CDLL(str(path))
        try:
            version = self._function(library.implicam_kernel_version)()
            size = self._function(library.implicam_map_bytes)()
            self.avx2 = bool(self._function(library.implicam_has_avx2)())
            self.workspace_bytes = self._function(library.implicam_workspace_bytes, ctypes.c_int64, ctypes.c_int64)
            self.measure = library.implicam_measure
        except AttributeError as error:
            raise OSError(f"{path} is no kernel of implicam") from error
        if version != VERSION or size != ctypes.sizeof(Map):
            raise OSError(f"{path} is of another version of implicam")
        self.measure.restype = None
        numbers, arrays = [ctypes.c_int64], [ctypes.c_void_p]
        self.measure.argtypes = [ctypes.POINTER(Map), *numbers, *arrays * 2, *numbers, *arrays * 8, *numbers]
        self.path = path

    @staticmethod
    def _function(function: Any, *arguments: Any) -> Any:
        function.restype, function.argtypes = ctypes.c_int64, arguments
        return function

    def __str__(self) -> str:
        return f"compiled ({'AVX2' if self.avx2 else 'for any processor of its kind'})"


@lru_cache(maxsize=1)
def kernel() -> Kernel | None:
    """The compiled kernel of this installation; None where there is none that can be loaded."""
    path = Path(__file__).with_name(NAME)
    try:
        return Kernel(path) if path.exists() else None
    except OSError:  # of another machine or version: NumPy does it
        return None


def how_it_measures() -> str:
    """Which code of this installation measures by tables, in words."""
    found = kernel()
    return f"{found}, {found.path.name}" if found else "NumPy; the kernel is not compiled here, docs/speed.md says how"
