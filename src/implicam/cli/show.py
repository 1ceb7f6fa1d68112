"""What the commands print: tables, progress, JSON, errors. Numbers go to stdout, talk goes to stderr."""

from __future__ import annotations

import json
import logging
import math
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement as Widths
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars
from rich.table import Table

from implicam.compare import Trial
from implicam.coverage import NEES_RIGHT, Estimate, Summary
from implicam.demo import HELD_OUT, Demo
from implicam.detect.folder import DetectionRun
from implicam.evaluation import Evaluation
from implicam.formatting import decimal_number, json_safe, percent, without_dust
from implicam.measurement import Measurement
from implicam.progress import Progress
from implicam.verdict import Verdict

MOST_NOTES = 6
FIRST_LINE_SECONDS, SECONDS_BETWEEN_LINES = 10.0, 30.0
"""Of progress where there is no terminal."""
_LOG = logging.getLogger(__name__)
err = Console(stderr=True, highlight=False)


def out(width: int | None = None) -> Console:
    """The console of results; made anew so that it follows a redirected stdout."""
    return Console(highlight=False, width=width)


@contextmanager
def progress(quiet: bool = False) -> Iterator[Progress]:
    """A progress bar on stderr with the time left where there is a terminal, else a line now and then; each step is
    logged."""
    if quiet or not err.is_terminal:
        yield _log_step if quiet else _LinesNowAndThen()
        return
    times = (TimeElapsedColumn(), TimeRemainingColumn())
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *times)
    with Bars(*columns, console=err, transient=True, speed_estimate_period=600) as bars:  # a cell may take minutes
        tasks: dict[str, Any] = {}

        def step(what: str, done: int, total: int) -> None:
            _log_step(what, done, total)
            if what not in tasks:
                tasks[what] = bars.add_task(escape(what), total=total)
            bars.update(tasks[what], completed=done, total=total)

        yield step


class _LinesNowAndThen:
    """Progress of long work where there is no terminal, such as a log of a batch job: silence for minutes looks like a
    hang, and a line for each step would fill pages."""

    def __init__(self) -> None:
        self._began: dict[str, float] = {}
        self._next = time.monotonic() + FIRST_LINE_SECONDS

    def __call__(self, what: str, done: int, total: int) -> None:
        _log_step(what, done, total)
        now = time.monotonic()
        began = self._began.setdefault(what, now)
        if now < self._next:
            return
        self._next = now + SECONDS_BETWEEN_LINES
        left = (
            f", about {max(1, round((now - began) / done * (total - done) / 60))} min left" if 0 < done < total else ""
        )
        say(f"{what}: {done} of {total}{left}")


def _log_step(what: str, done: int, total: int) -> None:
    _LOG.info("%s: %d of %d", what, done, total)


def emit_json(value: Any) -> None:
    """Print JSON; numbers that do not exist are null."""
    sys.stdout.write(json.dumps(json_safe(value), indent=2, ensure_ascii=False) + "\n")


def table_lines(name: str, tables: Iterable[Mapping[str, Any]]) -> str:
    """An array of tables in TOML, a key a line; numbers have six digits, for the eye."""
    lines = []
    for one in tables:
        lines += ["", f"[[{name}]]", *(f"{key} = {_value(value)}" for key, value in one.items())]
    return "\n".join(lines)


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {_value(one)}' for key, one in value.items())} }}" if value else "{}"
    if isinstance(value, list):
        value = without_dust(value) if all(isinstance(one, float) for one in value) else value
        return f"[{', '.join(map(_value, value))}]"
    return json.dumps(float(f"{value:.6g}") if isinstance(value, float) else value, ensure_ascii=False)


def line(text: str) -> None:
    """A line of result on stdout, never wrapped."""
    out().print(escape(text), soft_wrap=True)


def say(text: str) -> None:
    """A line of talk on stderr."""
    err.print(escape(text), soft_wrap=True)


def error_lines(text: str) -> None:
    """The three parts of an error."""
    head, *rest = text.splitlines()
    err.print(f"[bold red]error:[/] {escape(head)}", soft_wrap=True)
    for line in rest:
        say(line)


def note(text: str) -> None:
    """Something that the user should know before trusting a number."""
    err.print(f"[bold yellow]note:[/] {escape(text)}", soft_wrap=True)


def percent_interval(share: Estimate) -> str:
    """A share with its 95 % interval, both in whole per cent: more digits would be noise."""
    if not math.isfinite(share.value):
        return "-"
    return f"{100 * share.value:.0f} [{100 * share.low:.0f},{100 * share.high:.0f}]"


def reasons(measurement: Measurement) -> list[str]:
    """How many points could not be measured, and why, the commonest reason first."""
    own = measurement.own_reason[~measurement.measured]
    return counted(map(str, own), "point", "not measured")


def left_out(measurement: Measurement) -> list[str]:
    """How many points were measured without one of their views, and without which, the commonest first.

    The reason of a measured point says so, and goes on from its name: `measured without cam3, whose view ...`.
    """
    own = measurement.own_reason
    without = Counter(map(str, own[measurement.measured & (own != "")]))
    each = [f"{_count(count, 'point')} {reason}" for reason, count in without.most_common()]
    total = f"{without.total()} points measured without a view that contradicts the others; of these:"
    return each if len(each) < 2 else [total, *each]


def counted(reasons: Iterable[str], noun: str, what: str) -> list[str]:
    """`<count> <noun>s <what>: <reason>`, the commonest reason first."""
    counts = Counter(reasons).most_common()
    return [f"{_count(count, noun)} {what}: {reason}" for reason, count in counts]


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


def alarm(text: str) -> None:
    """Something that makes the numbers not to be trusted."""
    err.print(f"[bold red]alarm:[/] {escape(text)}", soft_wrap=True)


def calibration_verdict(found: Verdict, unit: str) -> None:
    """Whether a calibration is to be used, and why not."""
    text = found.word
    if found.held_out is not None:
        h = found.held_out
        text += (
            f"; {h.how}: {h.points} points are off by {decimal_number(h.rms)} {unit} rms, their error bars say "
            f"{decimal_number(h.stated)}, and {percent(h.inside)} are in their 95 % ellipsoids"
        )
    line(f"verdict: {text}")
    for reason in found.reasons:
        err.print(f"[bold red]{found.word}:[/] {escape(reason)}", soft_wrap=True)


def notes(texts: Sequence[str]) -> None:
    """The first few of many notes, and how many more there are."""
    for text in texts[:MOST_NOTES]:
        note(text)
    if len(texts) > MOST_NOTES:
        note(f"and {len(texts) - MOST_NOTES} more such notes; --json lists them all")


def text_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], *, left: int = 1) -> Table:
    """A table of text; the first `left` columns are words, the others numbers."""
    style: dict[str, Any] = {"box": box.SIMPLE_HEAD, "show_edge": False, "pad_edge": False, "padding": (0, 1, 0, 0)}
    table = Table(title=title, title_justify="left", title_style="bold", **style)
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="left" if i < left else "right", no_wrap=True, vertical="bottom")
    for cells in rows:
        table.add_row(*map(escape, cells))
    return table


def table(shown: Table) -> None:
    """Print a table on stdout, never cut: where the terminal is too narrow, its lines wrap."""
    console = out(width=10_000)
    console.width = max(1, Widths.get(console, console.options, shown).maximum)
    console.print(shown)
    console.print()


def evaluation_tables(evaluation: Evaluation) -> list[Table]:
    """Errors and error bars by region, and coverage by level; each fits into 80 columns."""
    unit = evaluation.data.length_unit
    rows = evaluation.coverage.rows
    limited = any(math.isfinite(row.rmse_over_limit) for row in rows)
    errors = text_table(
        f"Errors in {unit}, against {evaluation.against}",
        ["", "points", "rmse x", "y", "z", "3D", "median 3D", *(["rmse/limit"] if limited else [])],
        [_error_cells(row, limited) for row in rows],
    )
    bars = text_table(
        f"Error bars in {unit}",
        ["", "stated 3D", "NEES, ideal 3", "NLL", "CRPS", "they are"],
        [
            [
                row.region,
                decimal_number(row.stated_rms),
                interval(row.nees),
                decimal_number(row.nll),
                decimal_number(row.crps),
                row.verdict,
            ]
            for row in rows
            if row.n
        ],
    )
    return [errors, bars, _coverage_table(rows)]


_EXPLANATIONS = {
    "rmse": "root of the mean squared error, along each axis and in 3D",
    "limit": "Cramer-Rao bound: no method has a smaller rmse on average with this pixel noise;\n1 is the best there is",
    "stated": "the rmse that the error bars predict",
    "NEES": "mean squared error in units of the error bars: 3 is right, more is bars too small",
    "NLL, CRPS": "marks for errors and error bars together, to compare methods on the same data:\nsmaller is better",
    "per axis, ellipsoid": "% of errors inside the bars of one axis, and of all three at once\n"
    "(coverage): right is what stands above the column",
}


def explain(*words: str) -> None:
    """Say what words of a table mean, a line or two each, below it.

    Args:
        words: Keys of `_EXPLANATIONS`.
    """
    for word in words:
        first, *rest = _EXPLANATIONS[word].splitlines()
        line(f"{word}: {first}")
        for text in rest:
            line(f"  {text}")


def evaluation_words(evaluation: Evaluation) -> list[str]:
    """The words of `evaluation_tables` that want an explanation."""
    limited = any(math.isfinite(row.rmse_over_limit) for row in evaluation.coverage.rows)
    return [word for word in _EXPLANATIONS if word != "limit" or limited]


def _error_cells(row: Summary, limited: bool) -> list[str]:
    lengths = [decimal_number(value) for value in (*row.rmse_axes, row.rmse, row.median_error)]
    points = f"{row.n} of {row.n + row.unmeasured}" if row.unmeasured else str(row.n)
    return [row.region, points, *lengths, *([decimal_number(row.rmse_over_limit)] if limited else [])]


def _coverage_table(rows: Sequence[Summary]) -> Table:
    overall, *regions = rows
    cells = [["per axis", *(percent_interval(level.pooled) for level in overall.levels)]]
    cells += [
        [f"{axis} alone", *(percent_interval(level.axes[i]) for level in overall.levels)]
        for i, axis in enumerate("xyz")
    ]
    cells += [["ellipsoid", *(percent_interval(level.ellipsoid) for level in overall.levels)]]
    cells += [
        [f"  {row.region}", *(percent_interval(level.ellipsoid) for level in row.levels)] for row in regions if row.n
    ]
    headings = [percent(level.nominal) for level in overall.levels]
    return text_table("How many % of the points lie within their error bars [95 % interval]", ["", *headings], cells)


def interval(estimate: Estimate) -> str:
    """A number with its 95 % interval."""
    if not math.isfinite(estimate.low):
        return decimal_number(estimate.value)
    return f"{decimal_number(estimate.value)} [{decimal_number(estimate.low)}, {decimal_number(estimate.high)}]"


def verdict(overall: Summary) -> str:
    """What the coverage says of the error bars, in a sentence."""
    text = f"error bars: {overall.verdict}"
    if math.isfinite(overall.nees.value):
        text += f"; the mean NEES is {interval(overall.nees)}, and {NEES_RIGHT:.0f} is right"
    if math.isfinite(overall.sd_factor):
        inside, factor = percent(overall.level(0.95).ellipsoid.value, 1), decimal_number(overall.sd_factor)
        text += f"; the 95 % ellipsoids hold {inside}, and {factor} times as large would hold 95 %"
    return text


def detection_table(run: DetectionRun) -> Table:
    """A camera a row: how many pictures, in how many of them anything was found, and how sure of it."""
    sd = run.data.observations.sd
    rows = []
    for count in run.cameras:
        own = sd[:, run.data.observations.camera_names.index(count.camera)]
        own = own[np.isfinite(own[:, 0])]
        typical = decimal_number(float(np.sqrt(np.median(np.mean(own**2, axis=1))))) if len(own) else "-"
        rows.append([count.camera, str(count.pictures), str(count.found), str(count.points), typical])
    return text_table("", ["camera", "pictures", "with target", "points", "typical sd, px"], rows)


def maps_table(told: Sequence[Mapping[str, Any]]) -> Table:
    """A camera a row: the pinhole it becomes, how much of its picture is filled, and how well its map is known."""
    rows = [
        [
            str(each["name"]),
            f"{each['width']}x{each['height']}",
            decimal_number(each["focal_length_px"], 4),
            percent(each["share_filled"]),
            percent(each["share_among_known_points"]),
            *(decimal_number(math.nan if each[key] is None else each[key], 2) for key in
              ("median_sd_px", "median_sd_beyond_px")),
        ]
        for each in told
    ]  # fmt: skip
    headings = ["camera", "size", "focal\nlength", "filled", "known\npoints", "sd there,\npx", "sd beyond,\npx"]
    return text_table("", headings, rows)


def demo_table(demo: Demo) -> Table:
    """Cameras and known points down, accuracy and honesty of each method across."""
    lines: dict[tuple[str, int], list[Trial]] = {}
    for row in demo.rows:
        lines.setdefault((row.cameras, row.trial.known), []).append(row.trial)
    methods = dict.fromkeys(row.trial.method for row in demo.rows)
    headings = ["cameras", "points"]
    for name in methods:
        headings += [f"{name}\nrmse {demo.unit}", "rmse/\nlimit", "95 %\ncoverage"]
    shown = text_table(f"A simulated rig, judged at {HELD_OUT} photographed positions it has not seen", headings, [])
    for (cameras, known), trials in lines.items():
        cells: list[str] = []
        for t in trials:
            cells += [decimal_number(t.rmse), decimal_number(t.rmse / t.limit), percent(t.coverage_95, 1, none="-")]
        shown.add_row(cameras, str(known), *cells, end_section=known == demo.rows[-1].trial.known)
    return shown
