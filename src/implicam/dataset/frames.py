"""Another frame of the world, another length unit, fewer points: what data and measurements share."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.model import TRUTH_COLUMNS, Dataset, Floats, Names
from implicam.errors import UsageError, did_you_mean
from implicam.formatting import list_some

MAX_NOT_RIGID = 1e-6
"""How far a matrix may be from a rotation, entry by entry: more than rounding in a text file with seven digits."""


def rigid_parts(pose: Any) -> tuple[Floats, Floats]:
    """The rotation and the shift of a pose.

    Args:
        pose: SciPy's Rotation, a rotation matrix (3, 3), or a rigid 4 x 4 matrix.

    Returns:
        (3, 3) and (3,): a position x becomes rotation @ x + shift.

    Raises:
        UsageError: It is none of these.
    """
    shift = np.zeros(3)
    try:
        matrix = np.asarray(pose.as_matrix() if hasattr(pose, "as_matrix") else pose, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape == (4, 4) and np.allclose(matrix[3], [0, 0, 0, 1], rtol=0, atol=MAX_NOT_RIGID):
        matrix, shift = matrix[:3, :3], matrix[:3, 3]
    rigid = matrix.shape == (3, 3) and np.allclose(matrix @ matrix.T, np.eye(3), rtol=0, atol=MAX_NOT_RIGID)
    if not rigid or np.linalg.det(matrix) < 0 or not np.isfinite(shift).all():
        raise UsageError(
            "this is no rigid transform of the world.",
            why="it mirrors" if rigid and np.linalg.det(matrix) < 0 else "a length would change, or its shape is wrong",
            fix="give scipy.spatial.transform.Rotation, or a 4 x 4 matrix [[R, t], [0, 0, 0, 1]] of a rotation and a "
            "shift; another length unit: in_unit",
        )
    return matrix, shift


def keep_others(points: Names, names: Iterable[str]) -> NDArray[np.bool_]:
    """(n,) where a point is none of those named.

    Args:
        points: (n,) all names.
        names: Those to leave out.

    Raises:
        UsageError: There is no such point.
    """
    leave = [names] if isinstance(names, str) else [str(name) for name in names]
    known = set(points.tolist())
    for name in leave:
        if name not in known:
            raise UsageError(
                f"there is no point {name!r}{did_you_mean(name, known)}.",
                fix=f"the points are {list_some(list(known))}",
            )
    return ~np.isin(points, leave)


def move_known_positions(data: Dataset, rotation: Floats, shift: Floats, factor: float, unit: str) -> Dataset:
    """The dataset with known positions, their uncertainties and a simulated truth in another frame or unit.

    Args:
        data: The dataset.
        rotation: (3, 3).
        shift: (3,), in the length unit of before.
        factor: Lengths are multiplied by it, at last.
        unit: The length unit of afterwards.

    Returns:
        The dataset. Uncertainties that differ from axis to axis become correlated when they turn, which no column can
        say: then a note says so.
    """
    known = data.known
    if known is None:
        return replace(data, length_unit=unit)
    turns = not np.array_equal(rotation, np.eye(3))
    sd, notes = known.sd * factor, data.notes
    if turns:
        sd = np.sqrt((known.sd * factor) ** 2 @ (rotation**2).T)
        if np.nanmax(np.nan_to_num(np.ptp(known.sd, axis=1)), initial=0.0) > 0:
            notes = (*notes, "The stated uncertainties of the known positions differ from axis to axis; turned, they "
                     "are correlated, and this is not kept.")  # fmt: skip
    extra, truth = dict(known.extra), data.truth
    if truth is not None:
        xyz = (truth.xyz @ rotation.T + shift) * factor
        cov = rotation @ truth.limit @ rotation.T * factor**2
        axes = np.diagonal(cov, axis1=1, axis2=2)
        table = np.column_stack([xyz, np.sqrt(axes), cov[:, [0, 0, 1], [1, 2, 2]]])
        extra |= {key: np.array([repr(float(x)) for x in one]) for key, one in zip(TRUTH_COLUMNS, table.T, strict=True)}
    moved = replace(known, xyz=(known.xyz @ rotation.T + shift) * factor, sd=sd, extra=extra)
    return replace(data, known=moved, length_unit=unit, notes=notes)
