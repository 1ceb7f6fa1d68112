"""Experiment 3: the cases of each finding. A board is the unit: its corners share errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from implicam.dataset import Floats
from implicam.experiments.evidence import Case, Rows, Test, ratio, where
from implicam.experiments.plan import NETWORK
from implicam.experiments.source import BOARD

PANEL_BOARDS = 5
"""Boards of the panels in which the paper sees the uncertainty grow towards the cameras."""


def _by_board(rows: Rows, method: str, cameras: str, boards: int, key: str) -> dict[int, float]:
    """Mean over the corners of each board, by its number."""
    for row in where(rows, method=method, set=cameras, boards=boards, judged=BOARD):
        return {int(number): float(value) for number, value in zip(row["numbers"], row[f"{key}_by_board"], strict=True)}
    return {}


def _boards(rows: Rows, method: str, cameras: str) -> list[int]:
    return sorted({int(row["boards"]) for row in where(rows, method=method, set=cameras, judged=BOARD)})


def _on_common(a: Mapping[int, float], b: Mapping[int, float], words: str) -> Case:
    numbers = sorted(a.keys() & b.keys())
    return ratio(np.array([a[i] for i in numbers]), np.array([b[i] for i in numbers]), words)


def _network_loses(rows: Rows, gp: str, sets: Sequence[str]) -> list[Case]:
    return [
        _on_common(_by_board(rows, NETWORK, sets[0], boards, "error"), _by_board(rows, gp, sets[0], boards, "error"),
                   f"the network's error is {{}} times as large, with {boards} boards")
        for boards in _boards(rows, gp, sets[0])
    ]  # fmt: skip


def _more_boards(key: str, what: str) -> Test:
    def cases(rows: Rows, gp: str, sets: Sequence[str]) -> list[Case]:
        counts = _boards(rows, gp, sets[0])
        return [
            _on_common(_by_board(rows, gp, sets[0], fewer, key), _by_board(rows, gp, sets[0], more, key),
                       f"{what} with {fewer} boards {{}} times that with {more}")
            for fewer, more in pairwise(counts)
        ]  # fmt: skip

    return cases


def _last_gains_least(rows: Rows, gp: str, sets: Sequence[str]) -> list[Case]:
    """The smallest of the earlier gains over the last one."""
    counts = _boards(rows, gp, sets[0])
    steps = [(_by_board(rows, gp, sets[0], a, "error"), _by_board(rows, gp, sets[0], b, "error"))
             for a, b in pairwise(counts)]  # fmt: skip
    if len(steps) < 2:
        return []
    numbers = sorted(set.intersection(*(set(a) & set(b) for a, b in steps)))
    gains = [np.array([a[i] / b[i] for i in numbers]) for a, b in steps]
    last = f"{counts[-2]} to {counts[-1]}"
    return [
        ratio(gain, gains[-1], f"gain from {a} to {b} boards {{}} times that from {last}")
        for gain, a, b in zip(gains[:-1], counts, counts[1:], strict=False)
    ]


def _more_cameras(rows: Rows, gp: str, sets: Sequence[str]) -> list[Case]:
    return [
        _on_common(_by_board(rows, gp, fewer, boards, "error"), _by_board(rows, gp, more, boards, "error"),
                   f"error of {fewer} {{}} times that of {more}, with {boards} boards")
        for boards in _boards(rows, gp, sets[0])
        for fewer, more in pairwise(sets)
    ]  # fmt: skip


def _nearer(key: str, what: str) -> Test:
    """Each near test board against the one as far behind the middle, where that is a test board too."""

    def cases(rows: Rows, gp: str, sets: Sequence[str]) -> list[Case]:
        counts = _boards(rows, gp, sets[0])
        if not counts:
            return []
        boards = PANEL_BOARDS if PANEL_BOARDS in counts else counts[-1]
        found = _by_board(rows, gp, sets[0], boards, key)
        last = max(found) + 1  # the farthest board, which trains
        pairs = [(i, last - i) for i in found if i < last - i and last - i in found]
        words = f"{what} of a near board {{}} times that of the one as far behind the middle, with {boards} boards"
        near, far = (np.array([found[pair[k]] for pair in pairs], dtype=np.float64) for k in (0, 1))
        return [ratio(near, far, words)]

    return cases


def nearest_and_farthest(rows: Rows, method: str, cameras: str, boards: int, key: str) -> tuple[Floats, Floats]:
    """Means over the corners of each test board, of the nearest third of the boards and of the farthest.

    Args:
        rows: Of experiment 3.
        method: Its name.
        cameras: A set of cameras.
        boards: How many boards it was trained on.
        key: "error" or "sd".

    Returns:
        (k,) of the nearest and (k,) of the farthest, mm; empty where there is no such row.
    """
    found = _by_board(rows, method, cameras, boards, key)
    values = np.array([found[number] for number in sorted(found)], dtype=np.float64)
    third = max(1, len(values) // 3)
    return values[:third], values[-third:]


TESTS: dict[str, Test] = {
    "gp_beats_network": _network_loses,
    "more_boards_lower_rmse": _more_boards("error", "error"),
    "more_boards_lower_sd": _more_boards("sd", "sd"),
    "last_boards_gain_least": _last_gains_least,
    "more_cameras_lower_rmse": _more_cameras,
    "nearer_is_less_certain": _nearer("sd", "sd"),
    "nearer_is_less_accurate": _nearer("error", "error"),
}
