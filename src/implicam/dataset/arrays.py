"""A dataset from NumPy arrays, for those who have no files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from implicam.dataset.marks import remove_marks
from implicam.dataset.model import Camera, Dataset, Floats, KnownPositions, Observations
from implicam.dataset.units import UNKNOWN_UNIT
from implicam.errors import DatasetError, UsageError

Size = tuple[int, int]


def default_names(n: int) -> list[str]:
    """The names of points that have none: p0001, p0002, ...

    Args:
        n: How many.
    """
    digits = max(4, len(str(n)))
    return [f"p{i:0{digits}d}" for i in range(1, n + 1)]


def from_arrays(
    uv: ArrayLike | Mapping[str, ArrayLike],
    xyz: ArrayLike | None = None,
    *,
    sd: ArrayLike | None = None,
    position_sd: ArrayLike | None = None,
    cameras: Sequence[str | Camera] | None = None,
    size: Size | Sequence[Size] | None = None,
    points: Sequence[object] | None = None,
    shots: Sequence[object] | None = None,
    unit: str | None = None,
    name: str = "arrays",
) -> Dataset:
    """`Dataset.from_arrays`.

    Args:
        uv: See there, as all others.
        xyz: Known positions.
        sd: Of the pixels.
        position_sd: Of the known positions.
        cameras: Their names.
        size: Of their images.
        points: Names of the points.
        shots: Which points belong to one exposure.
        unit: Of the positions.
        name: Of the dataset.

    Raises:
        UsageError: There are positions, and their unit is not stated.
        DatasetError: A shape, a type or a number is not possible.
    """
    if isinstance(uv, Mapping):
        if cameras is not None:
            raise DatasetError(
                "the cameras are named twice.",
                why="uv is a mapping of names to pixels",
                fix="leave out cameras=, or give uv as one array of (points, cameras, 2)",
            )
        cameras, uv = list(uv), _side_by_side({str(key): _numbers(one, f"uv[{key!r}]") for key, one in uv.items()})
    table = hasattr(uv, "to_numpy")
    pixels = _numbers(uv, "uv")
    positions = None if xyz is None else _numbers(xyz, "xyz")
    if positions is not None and unit is None:
        raise UsageError("the length unit of xyz is not stated.", fix='add it: unit="mm", "m", ...')
    if table and pixels.ndim != 3:
        raise DatasetError(
            f"uv is a {type(uv).__name__} of the shape {pixels.shape}; expected is an array (points, cameras, 2).",
            fix="give a table with headings to Dataset.from_dataframe, or the numbers: uv.to_numpy()"
            + (f".reshape(-1, {pixels.shape[1] // 2}, 2)" if pixels.ndim == 2 and pixels.shape[1] % 2 == 0 else ""),
        )
    _check_shapes(pixels, positions, None if cameras is None else len(cameras))
    n, c = pixels.shape[:2]
    named = _cameras([f"cam{k + 1}" for k in range(c)] if cameras is None else cameras, size, c)
    texts = default_names(n) if points is None else [str(one) for one in _of_length(points, n, "points")]
    names = np.array(texts, dtype=np.str_)
    observations = Observations(names, named, pixels, _pixel_sd(sd, pixels))
    known = None
    if positions is not None:
        _check_finite(positions, texts)
        shot = names if shots is None else np.array([str(one) for one in _of_length(shots, n, "shots")], dtype=np.str_)
        known = KnownPositions(shot, positions, _position_sd(position_sd, n))
    elif position_sd is not None or shots is not None:
        raise DatasetError("position_sd and shots belong to known positions.", fix="give xyz, or leave them out")
    return remove_marks(Dataset(name, unit or UNKNOWN_UNIT, observations, known))


def _numbers(value: Any, what: str) -> Floats:
    """A copy as floats; where an array is masked, NaN."""
    if isinstance(value, np.ma.MaskedArray):
        value = np.where(np.ma.getmaskarray(value), np.nan, value.data)
    try:
        given = np.asarray(value)
        if given.dtype.kind not in "fiuO":
            raise ValueError(f"its entries are of the type {given.dtype}")
        return np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DatasetError(
            f"{what} is no array of numbers.",
            why=str(error),
            fix=f"give {what} as an array of floats, NaN where something is missing",
        ) from error


def _check_finite(xyz: Floats, points: Sequence[str]) -> None:
    rows = np.flatnonzero(~np.isfinite(xyz).all(axis=1))
    if len(rows):
        more = f", and {len(rows) - 1} more" if len(rows) > 1 else ""
        raise DatasetError(
            f"xyz[{rows[0]}], of point {points[rows[0]]!r}, is {xyz[rows[0]].tolist()}{more}.",
            why="a known point needs its whole position",
            fix="leave such points out: keep = np.isfinite(xyz).all(axis=1), then uv[keep] and xyz[keep]; or measure "
            "them, from a dataset without xyz",
        )


def _side_by_side(pixels: dict[str, Floats]) -> Floats:
    pixels = {name: one[:, 0] if one.ndim == 3 and one.shape[1] == 1 else one for name, one in pixels.items()}
    shapes = {name: one.shape for name, one in pixels.items()}
    if not pixels or len(set(shapes.values())) > 1 or any(len(s) != 2 or s[1] != 2 for s in shapes.values()):
        told = ", ".join(f"{name} {shape}" for name, shape in list(shapes.items())[:6]) or "no camera"
        raise DatasetError(
            "the pixels of the cameras do not fit together.",
            why=f"the shapes are: {told}",
            fix="give each camera an array (points, 2), a row for every point, NaN where it did not see it",
        )
    return np.stack(list(pixels.values()), axis=1)


def _check_shapes(uv: Floats, xyz: Floats | None, cameras: int | None) -> None:
    """Refuse shapes that are not (points, cameras, 2) and (points, 3), with the call that makes them so."""
    if xyz is not None and (xyz.ndim != 2 or xyz.shape[1] != 3):
        turned = xyz.ndim == 2 and xyz.shape[0] == 3
        raise DatasetError(
            f"xyz has the shape {xyz.shape}; expected (points, 3).",
            fix="turn it: xyz.T" if turned else "one row for each point: x, y, z",
        )
    if uv.ndim != 3 or uv.shape[2] != 2:
        fix = "one entry for each point and camera: uv[point, camera] = (u, v), NaN where it was not seen"
        if uv.ndim == 2 and uv.shape[1] % 2 == 0:
            c = uv.shape[1] // 2
            fix = f"if its columns are u1, v1, u2, v2, ...: uv.reshape(-1, {c}, 2)" if c > 1 else "uv[:, None, :]"
        elif uv.ndim == 3 and uv.shape[1] == 2:
            fix = "if u and v are the second axis: uv.swapaxes(1, 2)"
        raise DatasetError(f"uv has the shape {uv.shape}; expected (points, cameras, 2).", fix=fix)
    n, c = uv.shape[:2]
    turned = (xyz is None or len(xyz) == c) and (cameras is None or cameras == n)
    if (xyz is not None and len(xyz) != n) or (cameras is not None and cameras != c):
        why = [f"uv has {n} points and {c} cameras"]
        why += [f"xyz has {len(xyz)} rows"] if xyz is not None else []
        why += [f"there are {cameras} names of cameras"] if cameras is not None else []
        raise DatasetError(
            "the arrays do not fit together.",
            why="; ".join(why),
            fix="cameras come first here: uv.swapaxes(0, 1)" if turned else "uv is (points, cameras, 2)",
        )


def _cameras(given: Sequence[str | Camera], size: Any, c: int) -> tuple[Camera, ...]:
    sizes: list[Any] = [None] * c
    if size is not None:
        array = _numbers(size, "size")
        if array.shape not in ((2,), (c, 2)) or not (array == np.round(array)).all():
            raise DatasetError(
                f"size = {size!r} is not the size of {c} image{'s' * (c != 1)}.",
                fix="give size=(1920, 1080), width before height, or one such pair for each camera",
            )
        sizes = [tuple(int(x) for x in pair) for pair in np.broadcast_to(array, (c, 2)).tolist()]
    found = []
    for one, pair in zip(given, sizes, strict=True):
        if not isinstance(one, str | Camera):
            raise DatasetError(f"{one!r} is no name of a camera.", fix='give text, for example "cam1"')
        if isinstance(one, Camera) and pair is not None:
            raise DatasetError("the cameras have sizes already.", fix="leave out size=")
        found.append(one if isinstance(one, Camera) else Camera(one, *(pair or ())))
    return tuple(found)


def _of_length(given: Sequence[object], n: int, what: str) -> list[object]:
    listed: list[object] = [given] if isinstance(given, str) else list(given)
    if len(listed) != n:
        raise DatasetError(f"there are {len(listed)} {what}, but uv has {n} rows.", fix="give one for each row of uv")
    return listed


def _pixel_sd(sd: Any, uv: Floats) -> Floats:
    n, c = uv.shape[:2]
    given = np.full((), np.nan) if sd is None else _numbers(sd, "sd")
    if given.shape not in ((), (c,), (n, c), (n, c, 2)):
        raise DatasetError(
            f"sd has the shape {given.shape}, and uv {uv.shape}.",
            fix="give a number of pixels, or (cameras,), (points, cameras) or (points, cameras, 2)",
        )
    if given.shape != (n, c, 2) and given.ndim:
        given = given[..., None]
    return np.broadcast_to(given, (n, c, 2)).copy()


def _position_sd(sd: Any, n: int) -> Floats:
    given = np.full((), np.nan) if sd is None else _numbers(sd, "position_sd")
    if given.shape not in ((), (3,), (n, 3)):
        raise DatasetError(
            f"position_sd has the shape {given.shape}.", fix="give a length, one for each of x, y, z, or (points, 3)"
        )
    return np.broadcast_to(given, (n, 3)).copy()
