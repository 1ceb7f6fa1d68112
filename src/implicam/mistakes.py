"""Mistakes that people make with known points, and that can be seen in the numbers; they are named before all else.

Positions partly in another unit, and views that belong to other rows: of most cameras, and then the positions are in
another order, or of some, whose rows row_order.py checks one camera at a time. None of these sentences is a guess: with
the mistake corrected the numbers fit, and without they do not.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Dataset, Floats
from implicam.dataset.copies import remove_copies
from implicam.errors import FitError
from implicam.row_order import MIN_VIEWS, describe_order, find_row_order

UNITS = {
    1000.0: "metres and millimetres, say",
    100.0: "metres and centimetres, say",
    25.4: "inches and millimetres, say",
}
"""By how much positions in two units differ."""

MIN_POINTS_IN_UNIT = 3
"""Points in another unit."""

WIDTH_RATIO_RANGE = (0.1, 3.0)
"""Width of the points in another unit, once converted, over that of the others; of their pixels at least the first."""


class Finding(NamedTuple):
    """Something that speaks against a calibration, with its cure.

    Attributes:
        grave: Whether no number can be right.
        reason: What it is and what to do, in sentences.
        cameras: The cameras it is about, where it is about some.
    """

    grave: bool
    reason: str
    cameras: tuple[str, ...] = ()


def find_mistakes(data: Dataset) -> list[Finding]:
    """What is plainly wrong with known points.

    Args:
        data: The dataset; its copies are left out.

    Returns:
        Findings; empty where nothing is wrong, or there are no known points.
    """
    if data.known is None:
        return []
    data = remove_copies(data)
    return list(_two_units(data)) or list(_other_rows(data))


@contextmanager
def explain_fit_error(data: Dataset) -> Iterator[None]:
    """Add to the error of a failing fit which mistake in the data causes it.

    A mistake of the whole rig replaces the reason of the error; those of single cameras are added to it.

    Args:
        data: The known points that are fitted to.

    Raises:
        FitError: The fit failed.
    """
    try:
        yield
    except FitError as error:
        found = find_mistakes(data)
        grave = [one.reason for one in found if one.grave]
        if grave:
            raise FitError(error.what, why=" ".join(grave), fix="correct them first") from error
        unsaid = [one.reason for one in found if not _said(one, error)]
        if not unsaid:
            raise
        raise FitError(error.what, why=" ".join([error.why, *unsaid]).strip(), fix=error.fix) from error


def _said(mistake: Finding, error: FitError) -> bool:
    """Whether the error tells of this camera's rows already."""
    words = mistake.reason.partition(": ")[2].partition(". ")[0]
    return words.casefold() in str(error).casefold()


def _two_units(data: Dataset) -> Iterator[Finding]:
    xyz = data.xyz
    size = np.linalg.norm(xyz, axis=1)
    order = np.argsort(size)
    if len(xyz) < 2 * MIN_POINTS_IN_UNIT or not size[order[0]] > 0:
        return
    parts = range(MIN_POINTS_IN_UNIT, len(xyz) - MIN_POINTS_IN_UNIT + 1)
    k = max(parts, key=lambda k: float(size[order[k]] / size[order[k - 1]]))
    few, many = order[:k], order[k:]
    low, high = xyz[many].min(axis=0), xyz[many].max(axis=0)
    width = float(np.linalg.norm(high - low))
    for factor, units in UNITS.items():
        converted = factor * xyz[few]
        ratio = float(np.linalg.norm(np.ptp(converted, axis=0))) / max(width, 1e-300)
        beside = (converted > low - 0.5 * width) & (converted < high + 0.5 * width)
        apart = size[few].max() * 2 < size[many].min()
        if apart and WIDTH_RATIO_RANGE[0] < ratio < WIDTH_RATIO_RANGE[1] and beside.all() and _as_wide(data, few, many):
            names = ", ".join(str(data.points[i]) for i in np.sort(few)[:3])
            yield Finding(
                True,
                f"{len(few)} of {len(xyz)} known positions ({names}, ...) are in another unit than the rest: times "
                f"{factor:g} they lie among them ({units}). Give all of them in one unit.",
            )
            return


def _as_wide(data: Dataset, few: NDArray[np.int64], many: NDArray[np.int64]) -> bool:
    """Whether cameras see points that are told to be at one place as far apart as the others."""
    uv = data.observations.uv
    ratios = []
    for c in range(uv.shape[1]):
        widths = [_spread(uv[rows, c]) for rows in (few, many)]
        if all(width > 0 for width in widths):
            ratios.append(widths[0] / widths[1])
    return bool(ratios) and float(np.median(ratios)) > WIDTH_RATIO_RANGE[0]


def _spread(uv: Floats) -> float:
    """Of pixels (n, 2) about their middle; zero for fewer than two."""
    uv = uv[~np.isnan(uv[:, 0])]
    return float(np.sqrt(np.mean(np.sum((uv - uv.mean(axis=0)) ** 2, axis=1)))) if len(uv) > 1 else 0.0


def _other_rows(data: Dataset) -> Iterator[Finding]:
    """Each camera alone: do its views fit the positions of other rows, and not those of their own?"""
    names, uv = data.observations.camera_names, data.observations.uv
    orders = {name: order for c, name in enumerate(names) if (order := find_row_order(data.xyz, uv[:, c])) is not None}
    judged = sum(np.isfinite(uv[..., 0]).sum(axis=0) >= MIN_VIEWS)
    for rows, count in Counter(order.rows for order in orders.values()).items():
        if count > 0.5 * judged:
            those = {name: order for name, order in orders.items() if order.rows == rows}
            first = next(iter(those))
            yield Finding(
                True,
                "The known positions are in another order than the views: the pixels of "
                f"{_and(list(those))} are {those[first].how}. Put right {those[first].fit} ({first}). "
                "Look at how rows were matched with pictures.",
                tuple(those),
            )
            return
    for name, order in orders.items():
        yield row_finding(name, describe_order(order))


def row_finding(camera: str, why: str) -> Finding:
    """What is wrong with the rows of one camera, as a finding.

    Args:
        camera: Its name.
        why: What is wrong, in words.
    """
    return Finding(
        False,
        f"{camera}: {why}. Look at its pictures and the order of its rows, or leave it out with --without {camera}.",
        (camera,),
    )


def _and(names: list[str]) -> str:
    return " and ".join(names) if len(names) < 3 else f"{', '.join(names[:-1])} and {names[-1]}"
