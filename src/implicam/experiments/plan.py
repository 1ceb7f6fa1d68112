"""How much of the paper's experiments is computed: everything, or a taste."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

GP, PAPER, NETWORK, EXPLICIT, FORWARD = "inverse-gp:plain", "inverse-gp:paper", "mlp", "explicit", "forward-gp"
METHODS = (PAPER, GP, NETWORK, EXPLICIT, FORWARD)
"""The paper's Gaussian process with its own software, and with our fit; its network; explicit; ours."""
LEARNERS = (PAPER, GP, NETWORK, FORWARD)
"""Those that experiment 1 trains on positions; there, explicit learns from pictures of a board."""

EXPLICIT_PAPER, EXPLICIT_BUNDLE = "explicit:paper", "explicit:paper-bundle"
LINES = (EXPLICIT_PAPER, EXPLICIT_BUNDLE, EXPLICIT)
"""Those that learn from pictures of a board in experiment 1: the paper's pipeline with OpenCV without and with a joint
adjustment, since it does not say which it ran; ours."""

RIGS = 5
"""Simulated rigs, unless told otherwise: what holds for one may be an accident of its lenses."""

LEAST_RUNS_OF_A_RIG = 5
"""As many runs of each method as every rig keeps, where the rigs share the paper's 50."""

DRAWN_METHODS = (PAPER, NETWORK, FORWARD)
"""Whose boards are drawn."""


def slug(method: str) -> str:
    """A method as part of the name of a file.

    Args:
        method: Its name.
    """
    return method.replace(":", "-")


Counts = Mapping[str, int]


def _counts(**others: int) -> dict[str, int]:
    return dict.fromkeys(METHODS, others.pop("each")) | {
        {"gp": GP, "paper": PAPER, "network": NETWORK, "explicit": EXPLICIT, "forward": FORWARD}[key]: value
        for key, value in others.items()
    }


@dataclass(frozen=True)
class Plan:
    """The experiments' sizes; the paper's by default, with fewer runs of the methods that it does not have.

    Attributes:
        name: Of the plan.
        shares: Per cent of the ball's positions to train on.
        runs: Random splits of each share, by method.
        random_shares: As `shares`, with training positions off the lattice.
        random_runs: As `runs`, for `random_shares`.
        subsets: Of the pictures, for the smaller budgets of `LINES`.
        start_share: Per cent of the positions that active learning begins with.
        additions: Points that active learning adds.
        repeats: Runs of active learning, by method.
        lot: Points added between two fits, by method (a Gaussian process takes those between with its hyperparameters
            kept).
        boards: Numbers of boards to train on.
    """

    name: str = "full"
    shares: tuple[int, ...] = (90, 80, 70, 60, 50, 40, 30, 20, 10)
    runs: Counts = field(default_factory=lambda: _counts(each=50, paper=4, forward=5))
    random_shares: tuple[int, ...] = (90, 10)
    random_runs: Counts = field(default_factory=lambda: _counts(each=5, paper=2))
    subsets: int = 10
    start_share: int = 20
    additions: int = 100
    repeats: Counts = field(default_factory=lambda: _counts(each=2, gp=5, paper=5))
    lot: Counts = field(default_factory=lambda: _counts(each=20, gp=1, paper=20))
    boards: tuple[int, ...] = (2, 3, 5, 9)

    def with_runs(self, runs: int) -> Plan:
        """The same plan with a number of runs of every method.

        Args:
            runs: How many.
        """
        each = dict.fromkeys(METHODS, runs)
        return replace(self, name=f"{self.name}-{runs}-runs", runs=each, random_runs=each, repeats=each)

    def shared_by(self, rigs: int) -> Plan:
        """The plan for each of several rigs, which share the runs: two runs on one rig are alike, two rigs are not.

        Args:
            rigs: How many.
        """
        if rigs == 1:
            return self
        runs = {method: max(min(LEAST_RUNS_OF_A_RIG, count), count // rigs) for method, count in self.runs.items()}
        return replace(self, name=f"{self.name}-of-{rigs}-rigs", runs=runs)


FULL = Plan()
QUICK = Plan(
    name="quick",
    shares=(90, 50, 10),
    runs=_counts(each=3, gp=10, paper=2),
    random_shares=(90, 10),
    random_runs=_counts(each=2, paper=1),
    subsets=2,
    additions=30,
    repeats=_counts(each=2),
    lot=_counts(each=15, gp=3),
    boards=(2, 3),
)
"""A taste in a few minutes."""
