"""Tables of pairs of points, and of their distances."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from implicam.dataset.dialect import read_brought_table
from implicam.dataset.folder import csv_text, format_cells
from implicam.derived.joint_positions import find_point
from implicam.derived.quantities import Quantity, distances
from implicam.measurement import Measurement

DISTANCE_COLUMNS = ("a", "b", "distance", "sd", "low_95", "high_95", "note")

Pair = tuple[str, str]


def read_pairs(path: Path) -> list[Pair]:
    """Read pairs of names: a table with a line `a,b`, also with semicolons or tabs, then a row for each pair.

    Args:
        path: The file.

    Raises:
        DatasetError: It cannot be read, or is no such table.
    """
    header, rows, _ = read_brought_table(path, ("a", "b"))
    first, second = header.index("a"), header.index("b")
    return [(row[first].strip(), row[second].strip()) for _, row in rows]


class DistanceRow(NamedTuple):
    """The distance of two points, or why there is none."""

    pair: Pair
    distance: Quantity | None
    note: str

    def __str__(self) -> str:
        return f"{self.pair[0]} - {self.pair[1]}: {self.distance or self.note}"


def distance_rows(measurement: Measurement, pairs: Sequence[Pair]) -> list[DistanceRow]:
    """The distances of pairs; one of which a point was not measured keeps its row, with the reason.

    Args:
        measurement: As a calibration gave it.
        pairs: Names of points.

    Raises:
        UsageError: A point is not there, both are one, or the method does not say what errors share.
    """
    missing = {}
    for pair in pairs:
        for name in pair:
            number = find_point(measurement, name)
            if not measurement.measured[number]:
                missing[pair] = f"{name} was not measured: {measurement.reason[number]}"
    found = iter(distances(measurement, [pair for pair in pairs if pair not in missing]))
    rows = []
    for pair in pairs:
        one = None if pair in missing else next(found)
        rows.append(DistanceRow(pair, one, one.note if one else missing[pair]))
    return rows


def distances_text(rows: Sequence[DistanceRow]) -> str:
    """The text of distances.csv.

    Args:
        rows: Of `distance_rows`.
    """
    table = []
    for pair, one, note in rows:
        numbers = np.array([one.value, one.sd, *one.interval()]) if one else np.full(4, np.nan)
        table.append([*pair, *format_cells(numbers), note])
    return csv_text(DISTANCE_COLUMNS, table)
