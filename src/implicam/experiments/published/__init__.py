"""The paper's published numbers and findings as data, each with its place in the paper.

De Boi et al., "Implicit Multi-Camera System Calibration Using Gaussian Processes". Figures and tables are numbered as
they follow each other in its LaTeX source. Its figures print no numbers, so only experiment 3 has a table. Findings are
in our words.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from types import MappingProxyType
from typing import Any

from implicam.errors import UsageError, did_you_mean

EXPERIMENTS = ("setup", "ball", "active", "board")
"""`setup` is the rig, the methods and the software of all three."""


@dataclass(frozen=True)
class Number:
    """A number, or a list of numbers, that the paper states.

    Attributes:
        key: Its name in our data.
        value: The number or numbers.
        meaning: In words.
        place: Where it is in the paper.
        unit: Empty for a count or a share.
    """

    key: str
    value: float | tuple[float, ...]
    meaning: str
    place: str
    unit: str = ""


@dataclass(frozen=True)
class Finding:
    """What the paper concludes.

    Attributes:
        key: Its name in our data.
        statement: In words.
        sets: For which sets of cameras.
        place: Where it is in the paper.
        numbers: Keys of the numbers that it names.
        remark: Where the paper's own table says otherwise.
    """

    key: str
    statement: str
    sets: tuple[str, ...]
    place: str
    numbers: tuple[str, ...] = ()
    remark: str = ""


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation over test points.

    Attributes:
        mean: mm.
        sd: mm.
    """

    mean: float
    sd: float


@dataclass(frozen=True)
class TableRow:
    """A row of the paper's Table 1, mm.

    The paper does not say whether the "RMSE" of a point is its distance from the truth or that over root 3, the rms
    over its axes.

    Attributes:
        set: The set of cameras.
        boards: How many boards train.
        known: How many corners these have in all.
        gp_rmse: Error of the Gaussian process.
        gp_sd: Its posterior standard deviation, averaged over the axes.
        network_rmse: Error of the network.
    """

    set: str
    boards: int
    known: int
    gp_rmse: Spread
    gp_sd: Spread
    network_rmse: Spread


@dataclass(frozen=True)
class Published:
    """What the paper says about one experiment.

    Attributes:
        experiment: Its name.
        place: Where it is in the paper.
        numbers: By key, in the paper's order.
        findings: By key, in the paper's order.
        table: The rows of its table, where it has one.
    """

    experiment: str
    place: str
    numbers: Mapping[str, Number]
    findings: Mapping[str, Finding] = field(default_factory=dict)
    table: tuple[TableRow, ...] = ()


def load(experiment: str) -> Published:
    """What the paper says about an experiment.

    Args:
        experiment: One of `EXPERIMENTS`.

    Raises:
        UsageError: It is none of them.
    """
    if experiment not in EXPERIMENTS:
        raise UsageError(
            f"The paper has no experiment {experiment!r}{did_you_mean(experiment, EXPERIMENTS)}.",
            fix=f"Choose one of {', '.join(EXPERIMENTS)}.",
        )
    text = resources.files(__name__).joinpath(f"{experiment}.toml").read_text(encoding="utf-8")
    content = tomllib.loads(text)
    return Published(
        experiment=content["experiment"],
        place=content["place"],
        numbers=MappingProxyType({row["key"]: Number(**_frozen(row)) for row in content["numbers"]}),
        findings=MappingProxyType({row["key"]: Finding(**_frozen(row)) for row in content.get("findings", ())}),
        table=tuple(_table_row(row) for row in content.get("table", ())),
    )


def _frozen(row: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in row.items()}


def _table_row(row: Mapping[str, Any]) -> TableRow:
    spreads = {key: Spread(**row[key]) for key in ("gp_rmse", "gp_sd", "network_rmse")}
    return TableRow(**{**row, **spreads})
