"""The account of a reproduction as Markdown: published, ours, the difference, and why. docs/reproduce.md is one.

The words are in templates/account.md; here are the tables that it shows.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from typing import Any

from implicam.experiments import plan, published
from implicam.experiments.evidence import FAILS, HOLDS
from implicam.experiments.markdown import number, quartiles, span, spread, table
from implicam.experiments.plan import DRAWN_METHODS, EXPLICIT, EXPLICIT_PAPER, GP, LINES, METHODS, PAPER, slug
from implicam.experiments.source import BALL, BOARD_CHECK, BUDGETS, CHECK, RANDOM
from implicam.formatting import percent
from implicam.templates import render

Summary = Mapping[str, Any]
Rows = Sequence[Mapping[str, Any]]

_HEADS = {"set": "cameras", "known": "points", "boards": "boards"}


def markdown(summary: Summary, *, figures: str = "figures") -> str:
    """Write the account.

    Args:
        summary: What `reproduction.reproduce` writes as summary.json.
        figures: Where the pictures are, as the text links them.

    Returns:
        The text, as Markdown.

    Raises:
        MissingExtraError: Jinja2 is not installed.
    """
    ball, bias = summary.get("ball", ()), summary.get("flattery", ())
    lattice = _select(ball, trained=BALL, judged=BALL)
    off_the_lattice = _select(ball, trained=BALL, judged=CHECK)
    most_points = max((row["known"] for row in bias), default=0)
    tables = {
        "findings": _tabulate_findings(summary["verdicts"]),
        "lattice": _tabulate_ball(lattice, _error),
        "off_the_lattice": _tabulate_ball(off_the_lattice, _error),
        "random": _tabulate_ball(_select(ball, trained=RANDOM, judged=CHECK), _error),
        "coverage": _tabulate_ball(off_the_lattice or lattice, _coverage),
        "explicit": _tabulate_explicit([row for row in ball if row["method"] in LINES]),
        "lattice_bias": _pivot(
            _select(bias, known=most_points), lambda row: number(row["random"] / row["lattice"]), "set"
        ),
        "nearness": _tabulate_boards(
            summary.get("nearness", ()), lambda row: f"{number(row['sd'])}, {number(row['error'])}"
        ),
        "off_the_boards": _tabulate_boards(
            _select(summary.get("board", ()), judged=BOARD_CHECK),
            lambda row: f"{number(row.get('rmse'))}, {percent(row.get('ellipsoid_95'))}",
        ),
    }
    text = render(
        __package__,
        "account.md",
        s=summary,
        figures=figures,
        tables=tables,
        reasons=_group_reasons(summary["verdicts"]),
        count_verdicts=_count_verdicts,
        most_points=most_points,
        judged_at="random positions" if off_the_lattice else "the positions left out",
        table_place=published.load("board").place,
        drawn_methods=[slug(method) for method in DRAWN_METHODS],
        number=number,
        quartiles=quartiles,
        span=span,
        spread=spread,
        **{
            name: getattr(plan, name)
            for name in ("PAPER", "GP", "NETWORK", "EXPLICIT", "FORWARD", "EXPLICIT_PAPER", "EXPLICIT_BUNDLE")
        },
    )
    return re.sub(r"\n{3,}", "\n\n", text).rstrip() + "\n"


def _select(rows: Rows, **wanted: Any) -> Rows:
    return [row for row in rows if all(row.get(key) == value for key, value in wanted.items())]


# findings


def _tabulate_findings(verdicts: Rows) -> str:
    """A line for each finding and its sets of cameras; the statement stands once, over the lines of its sets."""
    lines: list[list[str]] = []
    groups: dict[tuple[str, str, str], dict[str, Mapping[str, Any]]] = {}
    for verdict in verdicts:
        key = verdict["experiment"], verdict["key"], verdict["sets"]
        groups.setdefault(key, {})[verdict["method"]] = verdict
    for (_, _, sets), verdict_of in groups.items():
        statement = next(iter(verdict_of.values()))["statement"]
        cells = [_verdict(verdict_of.get(method)) for method in (PAPER, GP)]
        repeated = any(line[0] == statement for line in lines)
        lines.append(["" if repeated else statement, sets, *cells])
    heads = [f"the paper's software (`{PAPER}`, `{EXPLICIT_PAPER}`)", f"ours (`{GP}`, `{EXPLICIT}`)"]
    return table(["finding", "cameras", *heads], lines, left=4)


def _verdict(verdict: Mapping[str, Any] | None) -> str:
    return "" if verdict is None else f"**{verdict['verdict']}**: {verdict['number']}"


def _count_verdicts(verdicts: Rows, method: str) -> str:
    found = [verdict["verdict"] for verdict in verdicts if verdict["method"] == method]
    return f"{found.count(HOLDS)} of {len(found)} hold, {found.count(FAILS)} do not"


def _group_reasons(verdicts: Rows) -> dict[str, list[str]]:
    """Each reason that is known, with the statements of the findings that do not hold for it."""
    text = resources.files(__package__).joinpath("reasons.toml").read_text(encoding="utf-8")
    why = {key: reason["why"] for reason in tomllib.loads(text)["reasons"] for key in reason["findings"]}
    found: dict[str, dict[str, None]] = {}
    for verdict in verdicts:
        if verdict["verdict"] == FAILS and verdict["key"] in why:
            found.setdefault(why[verdict["key"]], {})[verdict["statement"]] = None
    return {reason: list(statements) for reason, statements in found.items()}


# tables with a column for each method


def _tabulate_ball(rows: Rows, cell: Callable[[Mapping[str, Any]], str]) -> str:
    return _pivot(sorted(rows, key=lambda row: (row["set"], -row["known"])), cell, "set", "known")


def _tabulate_boards(rows: Rows, cell: Callable[[Mapping[str, Any]], str]) -> str:
    return _pivot(sorted(rows, key=lambda row: (row["set"], row["boards"])), cell, "set", "boards")


def _pivot(rows: Rows, cell: Callable[[Mapping[str, Any]], str], *keys: str) -> str:
    """A line for each value of the keys, in the order of the rows; nothing without rows."""
    cells = {(*(row[key] for key in keys), row["method"]): cell(row) for row in rows}
    methods = [method for method in METHODS if any(key[-1] == method for key in cells)]
    lines = dict.fromkeys(key[:-1] for key in cells)
    body = [[*map(str, line), *(cells.get((*line, method), "") for method in methods)] for line in lines]
    return table([*(_HEADS[key] for key in keys), *(f"`{method}`" for method in methods)], body) if body else ""


def _error(row: Mapping[str, Any]) -> str:
    """The quartiles of the error, and what is missing: failed runs, and the share of positions that were measured."""
    missing = [f"{row['failed']} failed"] if row.get("failed") else []
    measured = row.get("measured")
    missing += [f"{percent(measured)} measured"] if measured is not None and measured < 1 else []
    return quartiles(row["rmse"]) + (f" ({', '.join(missing)})" if missing else "")


def _coverage(row: Mapping[str, Any]) -> str:
    return f"{percent(row['ellipsoid_95'][1])}, {number(row['mean_sd'][1])} mm"


def _tabulate_explicit(rows: Rows) -> str:
    """A line for each set of cameras, pipeline and where it was judged, a column for each budget of pictures."""
    budgets = ["{}+{}".format(*budget) for budget in BUDGETS]
    body = list[list[str]]()
    for cameras in sorted({row["set"] for row in rows}):
        for judged, words in ((BALL, "lattice"), (CHECK, "random")):
            for method in LINES:
                mine = _select(rows, set=cameras, method=method, judged=judged)
                found = {row["budget"]: _of_subsets(row) for row in mine}
                if found:
                    body.append([cameras, f"`{method}`", words, *(found.get(budget, "") for budget in budgets)])
    heads = ["cameras", "pipeline", "judged at", *(budget.replace("+", " + ") for budget in budgets)]
    return table(heads, body, left=3) if body else ""


def _of_subsets(row: Mapping[str, Any]) -> str:
    """The error of the calibration that the paper would take; of all subsets the middle half, and what is missing."""
    if "by_reprojection" not in row:  # a summary of before
        return _error(row)
    low, _, high = row["rmse"]
    chosen = number(row["by_reprojection"][1])
    between = f" [{number(low, 2)}, {number(high, 2)}]" if low != high else ""
    return chosen + between + (f" ({row['failed']} failed)" if row.get("failed") else "")
