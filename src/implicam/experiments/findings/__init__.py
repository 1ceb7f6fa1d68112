"""Which of the paper's findings hold: each with a number and its 95 % interval.

A finding is a ratio that should be above one (or a number above a threshold that is stated). Ratios are of geometric
means, over paired runs (the same split, the same board) where there are pairs. Their 95 % interval is that of a mean of
logarithms, after Student: over rigs, where there are several; over the runs, of a single one. *Holds*: the interval
lies on the finding's side, in every case that the finding speaks of; *does not hold*: in some case it lies on the other
side; *not decided*: neither. The case that decides is shown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from implicam.experiments import published
from implicam.experiments.evidence import FAILS, HOLDS, OPEN, Case, Rows, Test, over_rigs, rows_by_rig
from implicam.experiments.findings import active, ball, board
from implicam.experiments.plan import GP, PAPER
from implicam.simulate import CAMERA_SETS

TESTS: dict[str, dict[str, Test]] = {"ball": ball.TESTS, "active": active.TESTS, "board": board.TESTS}
FINDINGS_ABOUT_SEVERAL_SETS = ("more_cameras_lower_sd", "more_cameras_lower_rmse")
"""Findings about several sets of cameras at once."""


@dataclass(frozen=True)
class Verdict:
    """What became of a finding for a set of cameras (or several) and a Gaussian process.

    Attributes:
        experiment: Its name.
        key: Of the finding.
        statement: The finding in words.
        sets: The sets of cameras.
        method: The Gaussian process, and whose explicit calibration is meant: the paper's software, or ours.
        verdict: `HOLDS`, `FAILS` or `OPEN`.
        number: The case that decides, in words.
        remark: Where the paper's own table says otherwise.
    """

    experiment: str
    key: str
    statement: str
    sets: str
    method: str
    verdict: str
    number: str
    remark: str = ""


def verdicts(rows: Mapping[str, Rows]) -> list[Verdict]:
    """The verdicts on all findings of the experiments that have rows, for each Gaussian process.

    Data of another rig have other sets of cameras: a finding is then judged for each of those.

    Args:
        rows: "ball", "active" or "board" -> rows; those of several rigs have a column "rig".
    """
    found = []
    for experiment, tests in TESTS.items():
        mine = list(rows.get(experiment, ()))
        rigs = rows_by_rig(mine)
        for key, finding in published.load(experiment).findings.items() if mine else ():
            for sets in _groups(finding.sets, mine, key in FINDINGS_ABOUT_SEVERAL_SETS):
                for method in (PAPER, GP):
                    of_rigs = [tests[key](rig, method, sets) for rig in rigs]
                    whole = [cases for cases in of_rigs if len(cases) == max(map(len, of_rigs))]
                    cases = [over_rigs(same) for same in zip(*whole, strict=True)]
                    if any(np.isfinite(case.value) for case in cases):
                        names, (verdict, number) = ", ".join(sets), _judge_cases(cases)
                        found.append(
                            Verdict(experiment, key, finding.statement, names, method, verdict, number, finding.remark)
                        )
    return found


def _groups(sets: Sequence[str], rows: Rows, together: bool) -> list[tuple[str, ...]]:
    """The sets that a finding is judged for, one by one or together."""
    present = list(dict.fromkeys(str(row["set"]) for row in rows))
    asked = [name for name in sets if name in present] or ([] if set(present) & set(CAMERA_SETS) else present)
    if together:
        return [tuple(asked)] if len(asked) > 1 else []
    return [(name,) for name in asked]


def _judge_cases(cases: Sequence[Case]) -> tuple[str, str]:
    """The verdict, and the case that decides: of those with this verdict the one that is farthest from holding."""
    verdict = min((case.verdict for case in cases), key=(FAILS, OPEN, HOLDS).index)
    deciding = [case for case in cases if case.verdict == verdict]
    shown = min(deciding, key=lambda case: case.low / case.least if np.isfinite(case.low) else np.inf)
    holding = sum(case.verdict == HOLDS for case in cases)
    some = f" (in {holding} of {len(cases)} cases it holds)" if verdict != HOLDS and holding else ""
    return verdict, shown.words + some
