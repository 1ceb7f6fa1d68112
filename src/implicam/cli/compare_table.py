"""The table of `implicam compare`, and which fits of it failed."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from rich.table import Table

from implicam.cli.show import text_table
from implicam.compare import RANDOM, SHOT, Row, Trial, plane_axis
from implicam.formatting import decimal_number


def compare_table(rows: Sequence[Row], unit: str) -> Table:
    """Methods by number of known points: mean ± standard error over the splits; most fit into 80 columns.

    Where planes of a lattice were held out, each method has a row for random splits, and one for the planes across x,
    y and z each, with how many times its error at random splits that is.
    """
    columns = _CompareColumns.needed(rows)
    if not columns.planes:
        cells = [[row.method, *_compare_cells(row, columns)] for row in rows]
    else:
        cells = _by_method(rows, columns)
    return text_table(_compare_title(rows, columns), columns.headings(unit), cells)


@dataclass(frozen=True)
class _CompareColumns:
    """Which columns say something: planes held out, numbers of points, limits, points that not all measured."""

    planes: bool
    sizes: bool
    limited: bool
    partial: bool
    uneven: bool

    @classmethod
    def needed(cls, rows: Sequence[Row]) -> _CompareColumns:
        means = [row.mean for row in rows]
        common = [(mean["rmse_common"], mean["rmse"]) for mean in means if math.isfinite(mean["rmse_common"])]
        planes = any(plane_axis(row.split) for row in rows)
        return cls(
            planes,
            not planes or len({row.known for row in rows}) > 1,
            any(math.isfinite(mean["rmse_over_limit"]) for mean in means),
            any(mean["measured"] < 1 for mean in means),
            not all(math.isclose(one, other, rel_tol=0.005) for one, other in common),  # what three digits show
        )

    def headings(self, unit: str) -> list[str]:
        return [
            "method", *["points"] * self.sizes, *["% mea-\nsured"] * self.partial, f"rmse 3D, {unit}",
            *["rmse on\ncommon"] * self.uneven, *["×\nrandom"] * self.planes, *["/limit"] * self.limited,
            "% in bars", "NEES", "fit, s",
        ]  # fmt: skip


def _by_method(rows: Sequence[Row], columns: _CompareColumns) -> list[list[str]]:
    """The rows of each method and number of points below its name."""
    groups: dict[tuple[int, str], list[Row]] = {}
    for known in sorted({row.known for row in rows}):
        for row in rows:
            if row.known == known:
                groups.setdefault((known, row.method), []).append(row)
    cells = []
    for (_, method), group in groups.items():
        cells.append([method, *[""] * (len(columns.headings("")) - 1)])
        at_random = next((row.mean["rmse"] for row in group if row.split == RANDOM), math.nan)
        for row in group:
            name = f"  {plane_axis(row.split)} planes" if plane_axis(row.split) else "  random"
            cells.append([name, *_compare_cells(row, columns, row.mean["rmse"] / at_random)])
    return cells


def _compare_title(rows: Sequence[Row], columns: _CompareColumns) -> str:
    over, also = "the seeds", ""
    if columns.planes:
        over, also = "seeds or planes left out", "; × random: rmse over that of random splits"
    elif rows[0].split == SHOT:
        over = f"{max(row.tried for row in rows)} shots left out"
        also = ", all other points are known" * rows[0].all_others
    known = "" if columns.sizes else f"{rows[0].known} known points. "
    error = " ± standard error" * (max(row.seeds for row in rows) > 1)
    return f"{known}Means{error} over {over};\nbars are 95 % ellipsoids{also}"


def _compare_cells(row: Row, columns: _CompareColumns, lattice_bias: float = math.nan) -> list[str]:
    mean, error = row.mean, row.standard_error
    return [
        *([str(row.known)] if columns.sizes else []),
        *([decimal_number(100 * mean["measured"])] if columns.partial else []),
        _plus_minus(mean["rmse"], error["rmse"]),
        *([decimal_number(mean["rmse_common"])] if columns.uneven else []),
        *([decimal_number(lattice_bias, 2) if plane_axis(row.split) else ""] if columns.planes else []),
        *([decimal_number(mean["rmse_over_limit"])] if columns.limited else []),
        _plus_minus(100 * mean["ellipsoid_95"], 100 * error["ellipsoid_95"]),
        decimal_number(mean["nees"]),
        decimal_number(mean["fit_seconds"], 2),
    ]


def compare_failures(trials: Sequence[Trial]) -> list[str]:
    """Which methods failed, in how many of their splits, and why, the commonest reason first."""
    cells = [(t.method, t.split, "all other" if t.all_others else str(t.known)) for t in trials]
    tried = Counter(cells)
    failed = Counter((cell, t.failure) for cell, t in zip(cells, trials, strict=True) if t.failure)
    same: dict[str, list[str]] = {}
    for ((method, split, points), reason), count in failed.most_common():
        where = f" ({split})" * (split != RANDOM)
        text = f"{points} points failed in {count} of {tried[method, split, points]} splits{where}: {reason}"
        same.setdefault(text, []).append(method)
    return [f"{', '.join(methods)} with {text}" for text, methods in same.items()]


def _plus_minus(mean: float, error: float) -> str:
    if not math.isfinite(mean):
        return "-"
    return decimal_number(mean) + (f" ± {decimal_number(error, 1)}" if math.isfinite(error) else "")
