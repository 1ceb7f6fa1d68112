"""The chapters of the account, one for each experiment: tables and figures, with what a reader must know of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from implicam.experiments import published
from implicam.experiments.markdown import number, quartiles, span, spread, table
from implicam.experiments.plan import EXPLICIT, FORWARD, GP, METHODS, NETWORK, PAPER, SHOWN, slug
from implicam.experiments.source import BALL, BOARD_CHECK, BUDGETS, CHECK, RANDOM
from implicam.formatting import percent

Summary = Mapping[str, Any]


# experiment 1


def ball(summary: Summary, figures: str) -> str:
    """Experiment 1; nothing where it was not run."""
    if "ball" not in summary:
        return ""
    shown, rows = _shown(summary, figures), summary["ball"]
    return _joined(
        "## Experiment 1: a ball in a grid",
        "The paper prints no numbers for this experiment, only figures; what its text says is in the table above.",
        shown("ball-error"),
        _under("Errors at the positions left out of the lattice, medians of the runs:", _errors(rows, BALL, BALL)),
        _lines(rows),
        _under(
            "### Off the lattice\n\nHeld-out positions of a lattice lie on planes that were also trained on. The same "
            "fits, judged at random positions in the same volume:",
            _errors(rows, BALL, CHECK),
        ),
        _lattice_bias(summary.get("flattery", ())),
        _under("Trained on random positions, and judged at random ones:", _errors(rows, RANDOM, CHECK)),
        _tenfold(summary.get("tenfold", ())),
        shown("ball-error-random"),
        "### Uncertainty",
        shown("ball-uncertainty"),
        "The noise floor: GPyTorch keeps the noise variance above 1e-4 unless told otherwise. With positions in metres "
        "that is a standard deviation of 10 mm, whatever the error. With our fit the stated uncertainty follows the "
        "error where the points are dense; with few it is far too small.",
        shown("noise-floor"),
        _honesty(rows),
        shown("ball-example"),
        shown("ball-alignment"),
    )


def _joined(*parts: str) -> str:
    return "\n\n".join(part for part in parts if part)


def _under(text: str, body: str) -> str:
    """A table with what stands above it; nothing without the table."""
    return f"{text}\n\n{body}" if body else ""


def _errors(given: Iterable[Mapping[str, Any]], trained: str, judged: str) -> str:
    rows = [line for line in given if line.get("trained") == trained and line["judged"] == judged]
    methods = [method for method in METHODS if any(line["method"] == method for line in rows)]
    return _pivot(rows, methods, lambda line: quartiles(line["rmse"]) + _failed(line))


def _honesty(given: Iterable[Mapping[str, Any]]) -> str:
    rows = [line for line in given if line.get("trained") == BALL and line["judged"] == CHECK]
    at = "random positions" if rows else "the positions left out"
    rows = rows or [line for line in given if line.get("trained") == BALL]
    methods = [method for method in METHODS if any(line["method"] == method for line in rows)]
    return _under(
        f"How many % of {at} lie in their 95 % ellipsoids, and the average stated standard deviation:",
        _pivot(rows, methods, lambda line: f"{percent(line['ellipsoid_95'][1])}, {number(line['mean_sd'][1])} mm"),
    )


def _pivot(rows: Sequence[Mapping[str, Any]], methods: Sequence[str], cell: Callable[[Mapping[str, Any]], str]) -> str:
    """Sets and numbers of points down, methods across."""
    if not rows:
        return ""
    lines: dict[tuple[str, int], dict[str, str]] = {}
    for line in sorted(rows, key=lambda line: (line["set"], -line["known"])):
        lines.setdefault((line["set"], line["known"]), {})[line["method"]] = cell(line)
    body = [[name, str(known), *(found.get(m, "") for m in methods)] for (name, known), found in lines.items()]
    return table(["cameras", "points", *(f"`{method}`" for method in methods)], body)


def _lines(given: Iterable[Mapping[str, Any]]) -> str:
    rows = [line for line in given if line["method"] == EXPLICIT and "budget" in line]
    if not rows:
        return ""
    names, body = ["{}+{}".format(*budget) for budget in BUDGETS], list[list[str]]()
    for cameras in sorted({line["set"] for line in rows}):
        for judged, what in ((BALL, "lattice"), (CHECK, "random")):
            found = {line["budget"]: line for line in rows if line["set"] == cameras and line["judged"] == judged}
            if found:
                body.append([cameras, what, *(_line(found.get(name)) for name in names)])
    return (
        f"`{EXPLICIT}`, from pictures of a board (of each camera + of each pair); median of the subsets:\n\n"
        + table(["cameras", "judged at", *(name.replace("+", " + ") for name in names)], body, left=2)
    )


def _line(line: Mapping[str, Any] | None) -> str:
    return "" if line is None else quartiles(line["rmse"]) + _failed(line)


def _failed(line: Mapping[str, Any]) -> str:
    """What is missing: failed runs, and the share of positions that were measured."""
    said = [f"{line['failed']} failed"] if line.get("failed") else []
    measured = line.get("measured")
    said += [f"{percent(measured)} measured"] if measured is not None and measured < 1 else []
    return f" ({', '.join(said)})" if said else ""


def _tenfold(given: Sequence[Mapping[str, Any]]) -> str:
    found = [row for row in given if row["few"] < row["most"]["known"]]
    body = [
        [row["set"], "lattice" if row["trained"] == BALL else "random", f"{row['few']}: {quartiles(row[FORWARD])}",
         *(f"{of['known']}: {quartiles(of[GP])}, {_interval(of['times'])}" for of in (row["most"], row["best"]))]
        for row in found
    ]  # fmt: skip
    if not body:
        return ""
    return (
        f"`{FORWARD}` with the fewest points against `{GP}` with the most, and at its best, at random positions. "
        f"Points: error, and how many times that of `{FORWARD}` (95 % interval, over the runs of this rig):\n\n"
        + table(["cameras", "trained on", f"`{FORWARD}`", f"`{GP}`, most", f"`{GP}`, best"], body, left=2)
    )


def _interval(times: Sequence[float | None]) -> str:
    value, low, high = times
    return f"× {number(value)} [{number(low)}, {number(high)}]"


def _lattice_bias(given: Sequence[Mapping[str, Any]]) -> str:
    """Whom the lattice favours, with the most points."""
    if not given:
        return ""
    most = max(row["known"] for row in given)
    body = []
    for cameras in dict.fromkeys(row["set"] for row in given):
        cells = []
        for method in METHODS:
            row = next((r for r in given if (r["set"], r["method"], r["known"]) == (cameras, method, most)), None)
            cells.append("" if row is None else number(row["random"] / row["lattice"]))
        body.append([cameras, *cells])
    used = [any(line[1 + i] for line in body) for i in range(len(METHODS))]
    kept = [method for method, use in zip(METHODS, used, strict=True) if use]
    body = [[line[0], *(cell for cell, use in zip(line[1:], used, strict=True) if use)] for line in body]
    text = (
        "Whom the lattice favours: rmse over the Cramer-Rao limit at random positions, divided by the same on the "
        f"lattice, with {most} points. Above 1, a method looks better on the lattice than it is; below 1, the held-out "
        "positions on the faces of the lattice, where it must extrapolate, weigh more:"
    )
    return f"{text}\n\n" + table(["cameras", *(f"`{method}`" for method in kept)], body)


# experiments 2 and 3


def active(summary: Summary, figures: str) -> str:
    """Experiment 2; nothing where it was not run."""
    if not summary.get("active"):
        return ""
    off = any(row["check_rmse"][1] is not None for row in summary["active"])
    body = [
        [row["set"], f"`{row['method']}`", str(row["added"]), str(row["known"]), str(row["starts"]),
         *(span(row[key]) for key in ("mean_sd", "max_sd", "rmse")),
         *((span(row["check_mean_sd"]), span(row["check_rmse"])) if off else ())]
        for row in summary["active"]
    ]  # fmt: skip
    head = ["cameras", "method", "added", "points", "starts", "mean sd", "largest sd", "rmse"]
    head += ["mean sd, random", "rmse, random"] if off else []
    text = (
        "Started from a random fifth of the lattice; each added point is the one with the largest stated standard "
        f"deviation. {_lots(summary['plan']['lot'])} `{EXPLICIT}` learns from the same positions here, not from "
        "pictures of a board. Of the positions that are left, median over the starts, and lowest to highest"
        + ("; and at random positions, because those that are left are the easier ones" if off else "")
        + ":"
    )
    return _joined(
        "## Experiment 2: active learning", "The paper prints no numbers here either.",
        _shown(summary, figures)("active"), text, table(head, body, left=2),
    )  # fmt: skip


def _lots(lots: Mapping[str, int]) -> str:
    """How often each method is fitted anew."""
    groups: dict[int, list[str]] = {}
    for method, lot in lots.items():
        groups.setdefault(lot, []).append(f"`{method}`")
    words = [
        f"{', '.join(methods)} {'is' if len(methods) == 1 else 'are'} fitted anew after "
        + ("every point" if lot == 1 else f"every {lot} points")
        for lot, methods in sorted(groups.items())
    ]
    return "; ".join(words) + "."


def boards(summary: Summary, figures: str) -> str:
    """Experiment 3; nothing where it was not run."""
    if not summary.get("board"):
        return ""
    shown = _shown(summary, figures)
    where = "" if summary["source"]["folder"] else "The cameras are where x is small.\n\n"
    return _joined(
        "## Experiment 3: a moving board",
        _published(summary.get("published", ())),
        _nearness(summary.get("nearness", ())),
        _under(
            "At random positions in the space that the board sweeps, rms errors and % in the 95 % ellipsoids:",
            _off_the_boards(summary["board"]),
        ),
        where.strip(),
        *(shown(f"board-{slug(method)}") for method in SHOWN),
        shown("noise-floor-boards"),
    )


def _published(given: Sequence[Mapping[str, Any]]) -> str:
    if not given:
        return ""
    body = []
    for row in given:
        ours = row.get(PAPER)
        difference = number(ours["rmse"][0] - row["paper_gp_rmse"][0], sign=True) if ours else ""
        sd = number(ours["sd"][0] - row["paper_gp_sd"][0], sign=True) if ours else ""
        body.append(
            [row["set"], str(row["boards"]), spread(row["paper_gp_rmse"]), spread(ours and ours["rmse"]), difference,
             spread(row["paper_gp_sd"]), spread(ours and ours["sd"]), sd,
             *(spread(row[m]["rmse"]) if m in row else "" for m in (GP, FORWARD, EXPLICIT)),
             spread(row["paper_network_rmse"]), spread(row[NETWORK]["rmse"]) if NETWORK in row else ""]
        )  # fmt: skip
    head = [
        "cameras", "boards", "error, paper", f"`{PAPER}`", "difference", "average sd, paper", f"`{PAPER}`",
        "difference", f"error, `{GP}`", f"`{FORWARD}`", f"`{EXPLICIT}`", "network, paper", f"`{NETWORK}`",
    ]  # fmt: skip
    place = published.load("board").place
    return (
        f"The paper's Table 1 ({place}) and ours: mean / standard deviation over the test points. Error: the distance "
        f"from the truth. {_pattern(given)}`{EXPLICIT}` and `{FORWARD}` learn from the known corners, too; the paper "
        "leaves explicit calibration out here, because Zhang's method cannot use parallel boards at unknown places.\n\n"
        + table(head, body)
    )


def _pattern(given: Sequence[Mapping[str, Any]]) -> str:
    """What the paper's table shows of its software, in ours: the error changes, the standard deviation hardly does."""
    rows = [row for row in given if PAPER in row]
    if not rows:
        return ""
    sds = [row[PAPER]["sd"][0] for row in rows]
    counts = sorted({row["boards"] for row in rows})
    ends = [
        ", ".join(number(row[PAPER]["rmse"][0]) for row in rows if row["boards"] == n) for n in (counts[0], counts[-1])
    ]
    return (
        f"With `{PAPER}` the average standard deviation is {number(min(sds))} to {number(max(sds))} mm in every row "
        f"(the paper: 10.2 to 14.9), and the error goes from {ends[0]} mm with {counts[0]} boards to {ends[1]} mm with "
        f"{counts[-1]}. "
    )


def _nearness(given: Sequence[Mapping[str, Any]]) -> str:
    methods = [method for method in METHODS if any(row["method"] == method for row in given)]
    lines: dict[tuple[str, int], dict[str, str]] = {}
    for row in given:
        lines.setdefault((row["set"], row["boards"]), {})[row["method"]] = (
            f"{number(row['sd'])}, {number(row['error'])}"
        )
    body = [[name, str(count), *(found.get(m, "") for m in methods)] for (name, count), found in sorted(lines.items())]
    if not body:
        return ""
    return (
        "Near and far: stated standard deviation, and error, of the nearest third of the test boards over those of the "
        "farthest. What is not known for want of data is larger near the cameras, as the paper finds; what pixel noise "
        f"does is larger far away, and that is most of what is left with `{FORWARD}`:\n\n"
        + table(["cameras", "boards", *(f"`{method}`" for method in methods)], body, left=1)
    )


def _off_the_boards(given: Iterable[Mapping[str, Any]]) -> str:
    rows = [row for row in given if row["judged"] == BOARD_CHECK]
    methods = [method for method in METHODS if any(row["method"] == method for row in rows)]
    lines: dict[tuple[str, int], dict[str, str]] = {}
    for row in rows:
        text = f"{number(row.get('rmse'))}, {percent(row.get('ellipsoid_95'))}"
        lines.setdefault((row["set"], row["boards"]), {})[row["method"]] = text
    body = [[name, str(count), *(found.get(m, "") for m in methods)] for (name, count), found in sorted(lines.items())]
    return table(["cameras", "boards", *(f"`{method}`" for method in methods)], body) if body else ""


def _shown(summary: Summary, figures: str) -> Callable[[str], str]:
    def one(name: str) -> str:
        caption = summary["figures"].get(name)
        return f"![{caption}]({figures}/{name}.png)\n\n*{caption}.*" if caption else ""

    return one
