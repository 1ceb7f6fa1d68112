"""Known lengths between points that lie still at places nobody knows: scale bars, or one distance that was measured.

A table `a,b,distance,sd` (docs/formats.md), or in one line `a,b,812.4,0.2; c,d,500`: names of two points, the distance
between them in the dataset's unit, and its standard uncertainty, which may be left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.dataset.dialect import read_brought_table
from implicam.dataset.model import Dataset
from implicam.errors import DatasetError, UsageError, did_you_mean


class ScaleBar(NamedTuple):
    """Points a and b, the distance between them, and its standard uncertainty (0: not stated)."""

    a: str
    b: str
    length: float
    sd: float = 0.0

    def __str__(self) -> str:
        return f"{self.a} - {self.b}"


def in_one_line(bars: Sequence[ScaleBar]) -> str:
    """As an option states them.

    Args:
        bars: Any number.

    >>> in_one_line([ScaleBar("a", "b", 812.4, 0.2), ScaleBar("c", "d", 500.0)])
    'a,b,812.4,0.2;c,d,500.0'
    """
    return ";".join(f"{b.a},{b.b},{b.length!r}" + (f",{b.sd!r}" if b.sd else "") for b in bars)


def read_bars(stated: str) -> tuple[ScaleBar, ...]:
    """Scale bars from one line, or from the file that it names.

    Args:
        stated: As above; or the path of a `.csv`.

    Raises:
        UsageError: It is neither.
        DatasetError: The file cannot be read, or is no such table.

    >>> read_bars("a,b,812.4,0.2; c,d,500")
    (ScaleBar(a='a', b='b', length=812.4, sd=0.2), ScaleBar(a='c', b='d', length=500.0, sd=0.0))
    """
    if stated.strip().lower().endswith(".csv"):
        header, rows, _ = read_brought_table(Path(stated.strip()), ("a", "b", "distance"))
        columns = [header.index(name) for name in ("a", "b", "distance")]
        columns += [header.index("sd")] if "sd" in header else []
        parts = [[row[column].strip() for column in columns] for _, row in rows]
    else:
        parts = [[word.strip() for word in part.split(",")] for part in stated.split(";") if part.strip()]
    bars = []
    for words in parts:
        try:
            a, b, length, sd = (*words, "") if len(words) == 3 else words
            bar = ScaleBar(a, b, float(length), float(sd or 0))
        except ValueError:
            raise _unreadable(",".join(words)) from None
        if not (a and b and a != b and 0 < bar.length < np.inf and 0 <= bar.sd < bar.length):
            raise _unreadable(",".join(words))
        bars.append(bar)
    if not bars:
        raise _unreadable(stated)
    return tuple(bars)


def _unreadable(words: str) -> UsageError:
    return UsageError(
        f"{words!r} is no scale bar.",
        why="that is two points, the distance between them, and its standard uncertainty if it is known",
        fix="--scale-bars a,b,812.4 or a,b,812.4,0.2 (several with semicolons), or a table a,b,distance,sd",
    )


def bar_rows(data: Dataset, bars: Sequence[ScaleBar]) -> tuple[list[str], NDArray[np.int64]]:
    """Bars, and single points.

    Args:
        data: Points, whose positions nobody knows.
        bars: Between some of them.

    Returns:
        (F,) a name of each bar, then of each other point; and (F, 2) the rows of both ends in the data, -1 for the
        second of a single point.

    Raises:
        DatasetError: A point is not in the data, or in two bars.
    """
    row = {str(name): i for i, name in enumerate(data.points)}
    used: dict[str, ScaleBar] = {}
    for bar in bars:
        for name in (bar.a, bar.b):
            if name not in row:
                raise DatasetError(
                    f"dataset {data.name!r} has no point {name!r}{did_you_mean(name, list(row))}.",
                    why="a scale bar ends there",
                    fix=f"its points are {', '.join(list(row)[:10])}{' ...' if len(row) > 10 else ''}",
                )
            if name in used:
                raise DatasetError(
                    f"point {name!r} is in two scale bars, {used[name]} and {bar}.",
                    why="both ends of a bar are adjusted together, and a point is there once",
                    fix="leave one of the two out, and look at it afterwards: implicam measure --distance",
                )
            used[name] = bar
    single = [i for name, i in row.items() if name not in used]
    rows = [(row[bar.a], row[bar.b]) for bar in bars] + [(i, -1) for i in single]
    return [*map(str, bars), *(str(data.points[i]) for i in single)], np.array(rows, dtype=np.int64)
