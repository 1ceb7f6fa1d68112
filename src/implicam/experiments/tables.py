"""The rows of all runs, put together into the tables that people read."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from implicam.dataset import Floats
from implicam.experiments import published
from implicam.experiments.evidence import Row, column, median_row, over_rigs, rows_by_rig, unpaired, where
from implicam.experiments.findings.active import EARLY_POINTS
from implicam.experiments.findings.board import nearest_and_farthest
from implicam.experiments.plan import FORWARD, GP, METHODS
from implicam.experiments.source import BALL, BOARD, CHECK, RANDOM

Table = list[dict[str, Any]]


def ball_table(rows: Sequence[Row]) -> Table:
    """A line for each set, method and number of points: quartiles of the rms errors of its runs, in mm.

    Of calibrations from subsets of the pictures also the error of that with the median reprojection error, which the
    paper takes, over the rigs.

    Args:
        rows: Of experiment 1.
    """
    keys = ("trained", "judged", "set", "method", "known", "budget")
    table = []
    for key, runs in _grouped(rows, keys):
        good = where(runs)
        line = {**key, "runs": len(good), "failed": len(runs) - len(good)}
        for name in ("rmse", "mean_sd", "ellipsoid_95", "limit"):
            line |= {name: quartiles(numbers(good, name))}
        if "budget" in key:
            chosen = [median_row(where(rig), "reprojection") for rig in rows_by_rig(runs)]
            line["by_reprojection"] = quartiles(numbers([row for found in chosen for row in found], "rmse"))
            line["reprojection"] = quartiles(numbers(good, "reprojection"))
        measured = numbers(good, "measured")
        table.append({**line, "measured": float(measured.mean()) if len(measured) else float("nan")})
    return table


def active_table(rows: Sequence[Row]) -> Table:
    """A line for each set, method and stage (the start, 20 points added, the end), in mm.

    Args:
        rows: Of experiment 2.

    Returns:
        Lowest, median and highest over the starts.
    """
    table = []
    steps = {0, EARLY_POINTS, max((int(row["added"]) for row in rows), default=0)}
    for key, runs in _grouped(rows, ("set", "method", "added", "known")):
        good = where(runs)
        if key["added"] in steps and good:
            line = {**key, "starts": len(good)}
            names = ("mean_sd", "max_sd", "rmse", "check_mean_sd", "check_rmse")
            line |= {name: _range(numbers(good, name)) for name in names}
            table.append(line)
    return table


def board_table(rows: Sequence[Row]) -> Table:
    """A line for each set, number of boards and method: mean and standard deviation over the test points, in mm.

    Of several rigs the mean of each number.

    Args:
        rows: Of experiment 3.
    """
    names = ("error", "error_sd", "sd", "sd_sd", "rmse", "mean_sd", "ellipsoid_95", "limit", "measured")
    table = []
    for key, rigs in _grouped(rows, ("set", "boards", "method", "judged", "known")):
        good = where(rigs)
        line = {**key, "rigs": len(good), "failure": next((row["failure"] for row in rigs if row.get("failure")), "")}
        table.append(line | {name: _mean(good, name) for name in names if any(name in row for row in good)})
    return table


def published_beside(rows: Sequence[Row]) -> Table:
    """The paper's table, and ours beside it: a line for each of its rows that was computed.

    Args:
        rows: Of experiment 3.
    """
    table = []
    for row in published.load("board").table:
        line: dict[str, Any] = {"set": row.set, "boards": row.boards}
        for key, spread in (("gp_rmse", row.gp_rmse), ("gp_sd", row.gp_sd), ("network_rmse", row.network_rmse)):
            line[f"paper_{key}"] = [spread.mean, spread.sd]
        for method in METHODS:
            own = where(rows, set=row.set, boards=row.boards, method=method, judged=BOARD)
            if own:
                pairs = {"rmse": ("error", "error_sd"), "sd": ("sd", "sd_sd")}
                line[method] = {key: [_mean(own, name) for name in names] for key, names in pairs.items()}
        if len(line) > 5:
            table.append(line)
    return table


def tenfold(rows: Sequence[Row]) -> Table:
    """forward-gp with the fewest points against inverse-gp, at random positions: with the most points, and at its best.

    Args:
        rows: Of experiment 1.

    Returns:
        For each set and part to train on; `times` is the ratio of the geometric means of the runs' errors, with its
        95 % interval, over the rigs where there are several.
    """
    table = []
    for cameras in dict.fromkeys(str(row["set"]) for row in rows):
        for trained in (BALL, RANDOM):
            ours, theirs = (
                where(rows, method=method, set=cameras, trained=trained, judged=CHECK) for method in (FORWARD, GP)
            )
            if not ours or not theirs:
                continue
            few, known = min(row["known"] for row in ours), sorted({row["known"] for row in theirs})
            errors = {size: numbers(where(theirs, known=size), "rmse") for size in known}
            best = min(known, key=lambda size: quartiles(errors[size])[1])
            own = numbers(where(ours, known=few), "rmse")
            line: dict[str, Any] = {"set": cameras, "trained": trained, "few": few, FORWARD: quartiles(own)}
            for key, size in (("most", known[-1]), ("best", best)):
                case = over_rigs(
                    [
                        unpaired(numbers(where(rig, known=size), "rmse"), numbers(where(mine, known=few), "rmse"), "{}")
                        for rig, mine in zip(rows_by_rig(theirs), rows_by_rig(ours), strict=True)
                    ]
                )
                times = [case.value, case.low, case.high]
                line[key] = {"known": size, GP: quartiles(errors[size]), "times": times}
            table.append(line)
    return table


def lattice_bias(rows: Sequence[Row]) -> Table:
    """Rms error over the limit, at held-out positions of the lattice and at random ones: a lattice hides errors.

    Only where the data have a Cramer-Rao limit: positions differ in how exactly they can be measured at all.

    Args:
        rows: Of experiment 1.
    """
    table = []
    for key, runs in _grouped(where(rows, trained=BALL), ("set", "method", "known")):
        over = {}
        for judged in (BALL, CHECK):
            own = where(runs, judged=judged)
            values = numbers(own, "rmse") / numbers(own, "limit") if own else np.zeros(0)
            values = values[np.isfinite(values)]
            if len(values):
                over[judged] = float(np.median(values))
        if len(over) == 2:
            table.append({**key, "lattice": over[BALL], "random": over[CHECK]})
    return table


def nearness(rows: Sequence[Row]) -> Table:
    """Stated standard deviation and error of the nearest third of the test boards, over those of the farthest.

    Args:
        rows: Of experiment 3.
    """
    table = []
    rigs = rows_by_rig(rows)
    for line, _ in _grouped(where(rows, judged=BOARD), ("set", "boards", "method")):
        for key in ("sd", "error"):
            ends = [nearest_and_farthest(rig, line["method"], line["set"], line["boards"], key) for rig in rigs]
            ratios = [np.log(near.mean() / far.mean()) for near, far in ends if len(far)]
            line[key] = float(np.exp(np.mean(ratios))) if ratios else float("nan")
        table.append(line)
    return table


def by_board(rows: Sequence[Row]) -> Table:
    """A line for each test board: mean error and mean stated standard deviation of its corners, in mm.

    Args:
        rows: Of experiment 3.
    """
    return [
        {
            **{key: row[key] for key in ("rig", "set", "boards", "method") if key in row},
            "board": number + 1,
            "error": error,
            "sd": sd,
        }
        for row in where(rows, judged=BOARD)
        for number, error, sd in zip(row["numbers"], row["error_by_board"], row["sd_by_board"], strict=True)
    ]


def quartiles(values: Floats) -> list[float]:
    """The quartiles of numbers.

    Args:
        values: (n,); what is not finite is left out.

    Returns:
        Three numbers; NaN where there are none.
    """
    values = values[np.isfinite(values)]
    return [float(q) for q in np.quantile(values, [0.25, 0.5, 0.75])] if len(values) else [float("nan")] * 3


def _mean(rows: Iterable[Row], key: str) -> float:
    values = numbers(rows, key)
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else float("nan")


def _range(values: Floats) -> list[float]:
    values = values[np.isfinite(values)]
    return [float(q) for q in np.quantile(values, [0, 0.5, 1])] if len(values) else [float("nan")] * 3


def numbers(rows: Iterable[Row], key: str) -> Floats:
    """A column of a table.

    Args:
        rows: n rows.
        key: The column.

    Returns:
        (n,), NaN where a row has no such number.
    """
    return column([{key: row.get(key, np.nan)} for row in rows], key)


def _grouped(rows: Iterable[Row], keys: Sequence[str]) -> Iterator[tuple[dict[str, Any], list[Row]]]:
    """Rows that agree in these keys, as far as they have them, in the order of the first of each."""
    groups: dict[tuple[tuple[str, Any], ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple((key, row[key]) for key in keys if key in row), []).append(row)
    yield from ((dict(key), found) for key, found in groups.items())
