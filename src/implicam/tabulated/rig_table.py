"""A rig as tables: measuring as fast as they allow where they are accurate, and exactly elsewhere."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from implicam.geometry import Floats
from implicam.progress import Progress, silent
from implicam.rig_model import FittedRig
from implicam.rig_model.triangulate import Located, as_labelled
from implicam.tabulated.array_solver import ArraySolver, Found
from implicam.tabulated.library import LEFT_TO_EXACT, Kernel, Map, kernel
from implicam.tabulated.sight_lines import SightLines, tabulate_sight_lines
from implicam.tabulated.spline_table import SplineTable, box_of, tabulate
from implicam.threads import cores, side_by_side

STEP_SDS, TIED_STEP_SDS = 0.2, 0.1
"""The last step of Gauss-Newton, in standard deviations of the position, and of cameras that are tied together: its
square is what remains of this, the step itself of the covariance, both times some hundredths."""

POINTS_PER_TASK = 8192
"""Points at a time of one thread of the kernel."""

ROWS_AT_A_TIME = 4096
"""The same of NumPy, whose arrays should stay in the processor's cache."""

MAX_BYTES = 1 << 30
"""Of a table."""


MAX_TIED_CAMERAS = 16
"""Cameras of a rig that errors of known positions tie together: the table of their pairs grows with the square."""


def why_not_tabulated(rig: FittedRig, known_points: int) -> str:
    """Why a rig is measured exactly only.

    Args:
        rig: The cameras.
        known_points: How many there are, which say where the workspace is.

    Returns:
        The reason; empty where tables can be made.
    """
    if rig.degrees is not None:
        return "the noise of its views has heavy tails"
    if not known_points:
        return "no known points say where its workspace is"
    if rig.laid is not None:
        return "its world was laid anew after the fit"
    if not rig.posterior.tied:
        return ""
    if len(rig.cameras) > MAX_TIED_CAMERAS:
        return f"errors of known positions tie its cameras together, which are more than {MAX_TIED_CAMERAS}"
    if kernel() is None:
        return "errors of known positions tie its cameras together, and the kernel is not compiled here"
    return ""


@dataclass(frozen=True, eq=False)
class RigTable:
    """The tables of a rig; compiled is the kernel that measures with them, None for NumPy.

    Outside of the box of the known points and a margin, where the table is not accurate enough, and where views
    disagree and it is not clear which of them is wrong, points are measured exactly.
    """

    rig: FittedRig
    table: SplineTable
    lines: SightLines
    compiled: Kernel | None

    @classmethod
    def of(cls, rig: FittedRig, xyz: Floats, progress: Progress = silent) -> RigTable:
        """Tabulate a rig, and check the tables against it.

        Args:
            rig: The cameras; `why_not_tabulated` has nothing to say of it.
            xyz: (n, 3) its known points, in the world.
            progress: Is told how far it is.

        Returns:
            The tables, as accurate as `spline_table` says.
        """
        low, high = box_of(rig, xyz)
        with np.errstate(all="ignore"):
            return cls(rig, tabulate(rig, low, high, progress), tabulate_sight_lines(rig, low, high), kernel())

    def locate(self, uv: Floats, noise: Floats) -> Located:
        """Where points are.

        Args:
            uv: (n, C, 2) pixels of the calibrated cameras, NaN where not seen.
            noise: (n, C) of the views, in pixels.

        Returns:
            In the working frame, within 1 % of a standard deviation of the exact path.
        """
        uv = np.ascontiguousarray(uv, dtype=np.float64)
        if self.compiled is None and self.rig.posterior.tied:
            return self.rig.locate(uv, noise)
        found = self._by_arrays(uv, noise) if self.compiled is None else self._by_kernel(self.compiled, uv, noise)
        exact = np.flatnonzero(found.code == LEFT_TO_EXACT)
        if len(exact):
            slow = self.rig.locate(uv[exact], noise[exact])
            found.xyz[exact], found.cov[exact], found.p[exact] = slow.xyz, slow.cov, slow.p
            found.left_out[exact], found.share[exact] = slow.left_out, slow.share
        return Located(found.xyz, found.cov, found.p, found.left_out, found.share)

    def _as_labelled(self, found: Found, tied: Floats) -> Found:
        """In the world as labelled, eqs. (22) and (28)."""
        labels = self.rig.labels
        if labels is None or not len(tied):
            return found

        def some(part: slice) -> tuple[Floats, Floats]:
            return as_labelled(labels, found.xyz[part], found.cov[part], found.cov[part] @ tied[part])

        parts = side_by_side(some, [slice(i, i + ROWS_AT_A_TIME) for i in range(0, len(tied), ROWS_AT_A_TIME)])
        xyz, cov = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        left = np.trace(found.cov, axis1=1, axis2=2) / np.trace(cov, axis1=1, axis2=2)
        return found._replace(xyz=xyz, cov=cov, share=np.clip(1 - (1 - found.share) * left, 0.0, 1.0))

    def _by_arrays(self, uv: Floats, noise: Floats) -> Found:
        tasks = [slice(i, i + ROWS_AT_A_TIME) for i in range(0, len(uv), ROWS_AT_A_TIME)] or [slice(0, 0)]
        found = side_by_side(lambda part: self.arrays.measure(uv[part], noise[part]), tasks, calls_blas=False)
        every = Found(*(np.concatenate(columns) for columns in zip(*found, strict=True)))
        return self._as_labelled(every, np.zeros((len(uv), 3, 0)))

    @cached_property
    def arrays(self) -> ArraySolver:
        """The tables as NumPy takes them."""
        settings = self.rig.settings
        return ArraySolver(self.table, self.lines, STEP_SDS, (settings.min_p_value, settings.disagree_p_value))

    def _by_kernel(self, compiled: Kernel, uv: Floats, noise: Floats) -> Found:
        n, C = uv.shape[:2]
        per_point = C if noise.strides[0] else 0
        noise = np.ascontiguousarray(noise if per_point else noise[:1], dtype=np.float64)
        found = Found(
            np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n), np.empty(n), np.empty(n, dtype=np.int8),
            np.empty((n, C), dtype=np.bool_),
        )  # fmt: skip
        tied = np.zeros((n, 3, self.table.through.shape[5]))

        def some(part: slice) -> None:
            out = [column[part].ctypes.data for column in (*found, tied)]
            workspace = ctypes.create_string_buffer(compiled.workspace_bytes(C, tied.shape[2]))
            sd = noise[part].ctypes.data if per_point else noise.ctypes.data
            compiled.measure(
                self.map, len(uv[part]), uv[part].ctypes.data, sd, per_point, *out, workspace, compiled.avx2
            )

        if n <= POINTS_PER_TASK or cores() == 1:
            some(slice(0, n))
        else:
            tasks = [slice(i, i + POINTS_PER_TASK) for i in range(0, n, POINTS_PER_TASK)]
            side_by_side(some, tasks, calls_blas=False)
        return self._as_labelled(found, tied)

    @cached_property
    def map(self) -> Map:
        """The tables as the kernel takes them; `_memory` keeps them alive."""
        table, settings, memory = self.table, self.rig.settings, self._memory
        made = Map(
            cameras=len(table.projections), sight_cells=self.lines.points.shape[1] - 3,
            min_p=settings.min_p_value, disagree_p=settings.disagree_p_value, agree_p=settings.agree_p_value,
            clearly_better=settings.clearly_better_ratio,
            step_sds=TIED_STEP_SDS if self.rig.posterior.tied else STEP_SDS,
            suspects_of_two=settings.max_suspects_of_two, unknowns=table.through.shape[5],
        )  # fmt: skip
        made.cells[:], made.low[:], made.per_length[:] = (
            table.cells.tolist(),
            table.low.tolist(),
            (1 / table.step).tolist(),
        )
        for name, array in memory.items():
            setattr(made, name, array.ctypes.data)
        return made

    @cached_property
    def _memory(self) -> dict[str, NDArray[np.generic]]:
        arrays: dict[str, NDArray[np.generic]] = {
            "projections": np.ascontiguousarray(self.table.projections, dtype=np.float64),
            "grid": _aligned(self.table.grid()),
            "sight_frames": np.ascontiguousarray(self.lines.frames, dtype=np.float64),
            "sight": _aligned(self.lines.points),
        }
        if self.table.ties.shape[3]:
            arrays["ties"], arrays["through"] = _aligned(self.table.ties), _aligned(self.table.through)
        if self.table.marked.any():
            arrays["marked"] = np.ascontiguousarray(self.table.marked, dtype=np.uint8)
        return arrays

    @property
    def marked_share(self) -> Floats:
        """(C,) the share of the box in which the table of a camera is not accurate enough."""
        return np.asarray(self.table.marked.mean(axis=(0, 1, 2)))


def _aligned(array: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same at a multiple of 64 bytes, so that eight floats never lie across two lines of the cache."""
    room = np.empty(array.nbytes + 64, dtype=np.uint8)
    start = -room.ctypes.data % 64
    out = room[start : start + array.nbytes].view(np.float32).reshape(array.shape)
    out[...] = array
    return out
