"""One shot after the other, at once: nothing is allocated, named or checked twice that need not be."""

from __future__ import annotations

import ctypes

import numpy as np
from numpy.typing import ArrayLike

from implicam.errors import UsageError
from implicam.rig_model import FittedRig, MeasuredPixels
from implicam.rig_model.reasons import reason_codes
from implicam.tabulated.library import LEFT_TO_EXACT
from implicam.tabulated.rig_table import RigTable


class Live:
    """Measures shots as they come; `calibration.live()` makes it.

    What it returns are its own arrays, which the next shot overwrites: copy what is to be kept. One for each thread;
    the interpreter's lock is released while it measures.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> live = ic.ForwardGP().fit(rig).live()
    >>> found = live.measure(rig.observations.uv[0])
    >>> found.xyz.shape, found.cov.shape, found.reason.tolist()
    ((1, 3), (1, 3, 3), [''])
    """

    def __init__(self, rig: FittedRig, tables: RigTable | None, points: int = 1) -> None:
        """Make the arrays, and the tables where they are not made yet.

        Args:
            rig: The cameras.
            tables: Of them; None to measure exactly, which takes a thousand times as long.
            points: The most that one shot has.
        """
        C = len(rig.cameras)
        self.rig, self.tables, self.points = rig, tables, points
        self._fast = tables is not None and tables.compiled is not None and rig.labels is None
        self._uv = np.empty((points, C, 2))
        self._xyz, self._cov = np.empty((points, 3)), np.empty((points, 3, 3))
        self._p, self._share = np.empty(points), np.empty(points)
        self._code, self._left_out = np.empty(points, dtype=np.int8), np.empty((points, C), dtype=np.bool_)
        self._noise = np.ascontiguousarray(rig.noise_of_pixels(None, 1))
        self._names = rig.camera_names
        if tables is None or tables.compiled is None:
            return
        self._kernel = tables.compiled
        self._workspace = ctypes.create_string_buffer(self._kernel.workspace_bytes(C, 0))
        out = (self._xyz, self._cov, self._p, self._share, self._code, self._left_out)
        self._out = [*(array.ctypes.data for array in out), None]  # no labels
        self._map, self._at, self._usual = ctypes.byref(tables.map), self._uv.ctypes.data, self._noise.ctypes.data

    def measure(self, uv: ArrayLike, noise: ArrayLike | None = None) -> MeasuredPixels:
        """Measure one shot.

        Args:
            uv: (C, 2) pixels of one point, or (n, C, 2) of up to `points`; NaN where a camera does not see one.
            noise: Standard uncertainty of the views in pixels, as of `measure_pixels`; None for the usual one.

        Returns:
            Positions in the world, in arrays that the next shot overwrites.

        Raises:
            UsageError: The pixels have another shape.
        """
        given = np.asarray(uv, dtype=np.float64)
        n = 1 if given.ndim == 2 else len(given)
        if given.shape[-2:] != self._uv.shape[1:] or given.ndim not in (2, 3) or n > self.points:
            raise UsageError(
                f"pixels of the shape {given.shape} do not fit; "
                f"{self._uv.shape[1:]} of one point, or of up to {self.points} points, are wanted.",
                fix="for more points a shot: calibration.live(points=...); for many at once: measure_pixels",
            )
        pixels = self._uv[:n]
        pixels[:] = given
        if not self._fast:
            return self.rig.measure_pixels(pixels, noise, None if self.tables is None else self.tables.locate)
        sd = None if noise is None else np.ascontiguousarray(self.rig.noise_of_pixels(noise, n))
        at, stride = (self._usual, 0) if sd is None else (sd.ctypes.data, sd.shape[1])
        self._kernel.measure(self._map, n, self._at, at, stride, *self._out, self._workspace, self._kernel.avx2)
        code = self._code[:n]
        if code.any():
            self._others(n, sd)
        xyz, cov, frame = self._xyz[:n], self._cov[:n], self.rig.frame
        xyz *= frame.scale
        xyz += frame.offset
        cov *= frame.scale**2
        return MeasuredPixels(
            xyz, cov, self._p[:n], code, self._left_out[:n], self._share[:n], pixels, self._names,
            self.rig.length_unit, str,
        )  # fmt: skip

    def _others(self, n: int, noise: np.ndarray[tuple[int, ...], np.dtype[np.float64]] | None) -> None:
        """The points that the kernel has not measured: exactly, or why not."""
        rows = np.flatnonzero(self._code[:n])
        exact = rows[self._code[rows] == LEFT_TO_EXACT]
        if len(exact):
            every = np.broadcast_to(self._noise, (n, self._noise.shape[1])) if noise is None else noise
            found = self.rig.locate(self._uv[exact], every[exact])
            self._xyz[exact], self._cov[exact], self._p[exact] = found.xyz, found.cov, found.p
            self._left_out[exact], self._share[exact] = found.left_out, found.share
        usable = np.isfinite(self._uv[rows]).all(axis=2).sum(axis=1)
        self._code[rows] = reason_codes(np.isfinite(self._xyz[rows, 0]), self._p[rows], usable, usable)
