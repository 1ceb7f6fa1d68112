"""Experiment 3, the moving board: trained on the corners of some boards, judged at those of the others.

The boards to train on are the nearest, the farthest and those between them at equal distances. All other corners judge,
and random positions in the space that the board sweeps.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators import calibrator_from_name
from implicam.compare import Split, judge
from implicam.dataset import Dataset
from implicam.errors import DatasetError
from implicam.experiments.ball import measure_panel, numbers
from implicam.experiments.cells import Cell
from implicam.experiments.plan import METHODS, PAPER, Plan, slug
from implicam.experiments.source import BOARD, BOARD_CHECK, Source, millimetres
from implicam.experiments.stored import Values

NAME = "board"


def cells(source: Source, plan: Plan) -> list[Cell]:
    """The cells of experiment 3: one for each set, number of boards and method.

    Args:
        source: The data.
        plan: How much is computed.

    Returns:
        GPyTorch with the most boards takes longest and comes first; none where the data have no board.

    Raises:
        DatasetError: There are too few boards.
    """
    if BOARD not in source.parts:
        return []
    of = shots(source.data(BOARD, next(iter(source.sets))))
    counts = [count for count in plan.boards if count < len(of)]
    if not counts:
        raise DatasetError(
            f"{source.folder}/{BOARD} has {len(of)} boards; to train on {min(plan.boards)}, there must be others.",
            fix="give the corners of each place of the board a shot of its own in points.csv",
        )
    return [
        Cell(
            learn,
            f"{NAME}/{cameras}/{count}/{slug(method)}",
            {"source": source.options, "cameras": cameras, "boards": count, "method": method},
        )
        for method in sorted(METHODS, key=lambda method: method != PAPER)
        for count in sorted(counts, reverse=True)
        for cameras in source.sets
    ]


def shots(data: Dataset) -> list[str]:
    """The boards, nearest first: in the natural order of their names (2 before 10).

    Args:
        data: The part with the board.
    """

    def parts(name: str) -> list[tuple[int, str]]:
        return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", name)]

    return sorted({str(shot) for shot in data.shots}, key=parts)


def training(of: list[str], count: int) -> list[str]:
    """The first and the last of the boards, and those between them at equal distances.

    Args:
        of: The names of the boards, nearest first.
        count: How many.
    """
    return [of[i] for i in np.unique(np.round(np.linspace(0, len(of) - 1, count)).astype(np.int64))]


def learn(source: Mapping[str, Any], cameras: str, boards: int, method: str) -> Values:
    """The rows of one method, and its panel.

    Args:
        source: The data: `Source.options`.
        cameras: A set of cameras.
        boards: How many boards to train on.
        method: Its name.

    Returns:
        "rows", with lengths in mm; and the arrays of `ball.measure_panel`.
    """
    of = Source(**source)
    data = of.data(BOARD, cameras)
    names = shots(data)
    taken = np.isin(data.shots, training(names, boards))
    train, held_out = data.select(taken), data.select(~taken)
    fit = calibrator_from_name(method).fit(train)
    panel = measure_panel(fit, train, held_out)
    where = {"set": cameras, "method": method, "boards": boards, "known": len(train), "trained": BOARD}
    scale = millimetres(train)
    trial = judge(method, Split(BOARD, train, held_out, 0), fit, 0.0)
    numbers_of_boards = np.array([names.index(str(shot)) for shot in held_out.shots])
    rows = [{**where, "judged": BOARD, **numbers(trial, scale), **_spreads(panel, numbers_of_boards)}]
    if BOARD_CHECK in of.parts:
        trial = judge(method, Split(BOARD_CHECK, train, of.data(BOARD_CHECK, cameras), 0), fit, 0.0)
        rows.append({**where, "judged": BOARD_CHECK, **numbers(trial, scale)})
    return {"rows": rows, **panel}


def _spreads(panel: Mapping[str, Any], number: NDArray[np.int64]) -> Values:
    """As in the paper's table, mean and standard deviation over the test points; and the mean of each board, by number.

    `error` is the distance from the truth; `sd` the standard deviation averaged over x, y and z.
    """
    error = np.linalg.norm(panel["xyz"] - panel["true_xyz"], axis=1)
    good = np.isfinite(error)
    if not good.any():
        return {"failure": "no position was measured"}
    row: Values = {"numbers": [int(i) for i in np.unique(number[good])]}
    for key, values in (("error", error[good]), ("sd", panel["sd"][good])):
        row |= {key: float(values.mean()), f"{key}_sd": float(values.std())}
        row[f"{key}_by_board"] = [float(values[number[good] == i].mean()) for i in row["numbers"]]
    return row
