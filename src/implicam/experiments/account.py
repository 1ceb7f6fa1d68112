"""The account of a reproduction as Markdown: published, ours, the difference, and why. docs/reproduce.md is one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from implicam.experiments import chapters
from implicam.experiments.evidence import FAILS, HOLDS
from implicam.experiments.markdown import number, table
from implicam.experiments.plan import EXPLICIT, FORWARD, GP, NETWORK, PAPER
from implicam.experiments.reasons import WHY

Summary = Mapping[str, Any]


def markdown(summary: Summary, *, figures: str = "figures") -> str:
    """The account; `figures` is where the pictures are, as the text links them."""
    parts = [
        _head(summary),
        _failures(summary["failures"]),
        _findings(summary),
        chapters.ball(summary, figures),
        chapters.active(summary, figures),
        chapters.boards(summary, figures),
        _times(summary),
    ]
    return "\n\n".join(part for part in parts if part).rstrip() + "\n"


def _head(summary: Summary) -> str:
    return f"""# The paper, reproduced

Written by `implicam paper`; run it again and this text is made anew. The paper is De Boi et al., "Implicit Multi-Camera
System Calibration Using Gaussian Processes".

{_data(summary)}

Methods: `{PAPER}` is the paper's Gaussian process with its own software (GPyTorch, positions in metres, its
defaults); `{GP}` the same model with our fit; `{NETWORK}` its network; `{EXPLICIT}` the classical calibration;
`{FORWARD}` our own method. Lengths are mm. Square brackets: 95 % intervals of ratios; of errors, the middle half of the
runs. {_runs(summary["plan"])}"""


def _runs(plan: Mapping[str, Any]) -> str:
    """How many runs the tables rest on."""
    parts = (("splits of the lattice", "runs"), ("splits of random positions", "random_runs"))
    said = [f"{what}: {_grouped(plan[key])}" for what, key in parts]
    return f"Runs for each number of points, {'; '.join(said)}. Subsets of the pictures: {plan['subsets']}."


def _grouped(counts: Mapping[str, int]) -> str:
    groups: dict[int, list[str]] = {}
    for method, count in counts.items():
        if method != EXPLICIT:
            groups.setdefault(count, []).append(f"`{method}`")
    return ", ".join(f"{count} of {' and '.join(names)}" for count, names in sorted(groups.items(), reverse=True))


def _failures(failures: Mapping[str, str]) -> str:
    if not failures:
        return ""
    lines = [f"- `{name}`: {reason}" for name, reason in failures.items()]
    return "\n\n".join([f"**{len(lines)} pieces of work failed**, and are missing below:", "\n".join(lines)])


def _data(summary: Summary) -> str:
    source = summary["source"]
    if source["folder"]:
        sets = "; ".join(f"{name}: {', '.join(cameras)}" for name, cameras in source["sets"].items())
        return f"The data are measured: `{source['folder']}`. Sets of cameras: {sets}."
    return f"""Its measured data are not public, so the same numbers cannot come out: what can be compared is what the
paper *finds*. The data here are its rig, simulated (seed {source["seed"]}): six cameras with its focal lengths on a
bar, noise of 0.2 px, lens errors of 0.5 px rms that no lens model contains, known positions without error."""


# findings


def _findings(summary: Summary) -> str:
    verdicts = summary["verdicts"]
    if not verdicts:
        return ""
    lines: list[list[str]] = []
    groups: dict[tuple[str, str, str], dict[str, Mapping[str, Any]]] = {}
    for verdict in verdicts:
        key = verdict["experiment"], verdict["key"], verdict["sets"]
        groups.setdefault(key, {})[verdict["method"]] = verdict
    for (_, _, sets), verdict_of in groups.items():
        first = next(iter(verdict_of.values()))
        cells = [_verdict(verdict_of.get(method)) for method in (PAPER, GP)]
        if "" in verdict_of:
            cells = [_verdict(verdict_of[""]), "the same"]
        said = any(line[0] == first["statement"] for line in lines)  # once, over the rows of its sets
        lines.append(["" if said else first["statement"], sets, *cells])
    counts = {method: _count(verdicts, method) for method in (PAPER, GP)}
    text = [
        "## Does what the paper finds hold?",
        "A row for each finding and set of cameras, with the case that decides and its 95 % interval over the runs. "
        f"With the paper's own software {counts[PAPER]}; with our fit of the same model {counts[GP]}.",
        table(["finding", "cameras", f"`{PAPER}`", f"`{GP}`"], lines, left=4),
    ]
    text.append(
        f"Standard deviations of `{PAPER}` contain a floor of 10 mm, so that theirs differ by parts of a percent: "
        "such a finding holds for the rest above the floor."
    )
    remarks = dict.fromkeys(f"- *{v['statement']}* {v['remark']}" for v in verdicts if v["remark"])
    if remarks:
        text += ["Where the paper's own table says otherwise:", "\n".join(remarks)]
    reasons = "" if summary["source"]["folder"] else _reasons(verdicts)
    if reasons:
        text += ["Why some do not hold on this rig:", reasons]
    return "\n\n".join(text)


def _reasons(verdicts: Sequence[Mapping[str, Any]]) -> str:
    """Each reason that is known, with the findings that do not hold for it."""
    found: dict[str, list[str]] = {}
    for verdict in verdicts:
        if verdict["verdict"] == FAILS and verdict["key"] in WHY:
            found.setdefault(WHY[verdict["key"]], []).append(f"*{verdict['statement']}*")
    return "\n".join(f"- {' '.join(dict.fromkeys(said))} {reason}" for reason, said in found.items())


def _verdict(verdict: Mapping[str, Any] | None) -> str:
    return "" if verdict is None else f"**{verdict['verdict']}**: {verdict['number']}"


def _count(verdicts: Sequence[Mapping[str, Any]], method: str) -> str:
    mine = [verdict["verdict"] for verdict in verdicts if verdict["method"] in (method, "")]
    return f"{mine.count(HOLDS)} of {len(mine)} hold, {mine.count(FAILS)} do not"


# how long


def _times(summary: Summary) -> str:
    body = []
    for name, part in summary["parts"].items():
        methods = ", ".join(f"{m} {number(s, 2)}" for m, s in sorted(part["by_method"].items(), key=lambda p: -p[1]))
        body.append([name, str(part["cells"]), number(part["seconds"]), methods])
    cells = summary["cells"]
    before = f"; {cells['already']} of {cells['all']} cells had been computed before" if cells["already"] else ""
    lost = f" {cells['failed']} cells failed." if cells["failed"] else ""
    return (
        f"## How long it took\n\nSeconds of work of one core, by part and method. Wall time of the run: "
        f"{number(summary['wall_seconds'])} s{before}.{lost}\n\n"
        + table(["part", "cells", "seconds", "by method"], body, left=1)
    )
