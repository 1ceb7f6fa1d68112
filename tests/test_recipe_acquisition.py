"""The recipe "An acquisition" of CONTRIBUTING.md, followed to the letter by a toy; every command is run with it."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import EntryPoint, EntryPoints
from typing import ClassVar

import numpy as np
import pytest

from command_line import Cli, cli  # noqa: F401  a fixture
from implicam import registry
from implicam.active import ACQUISITIONS, Acquisition, Budget, DesignModel, Loop, SimulatedOracle, Workspace
from implicam.calibrators import ForwardGP
from implicam.dataset import Floats
from implicam.simulate import build_rig

# Steps 1 and 2: a frozen class with a name and scores


@dataclass(frozen=True)
class Outermost(Acquisition):
    """The candidate that is farthest from the middle of all: the corners first, whatever the cameras."""

    name: ClassVar[str] = "outermost"

    def scores(self, design: DesignModel, rng: np.random.Generator) -> Floats:
        """The distance."""
        xyz = design.candidates.xyz
        return np.linalg.norm(xyz - xyz.mean(axis=0), axis=1)


OUTERMOST = Outermost()

# Step 3: the registry; the two ways


@pytest.fixture(autouse=True, params=["registered", "entry point"])
def known_acquisition(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ACQUISITIONS, "_parts", dict(ACQUISITIONS._parts))  # so that it is gone after the test
    if request.param == "registered":
        ACQUISITIONS.register(OUTERMOST.name, OUTERMOST)
    else:
        added = EntryPoints([EntryPoint("outermost", f"{__name__}:OUTERMOST", "implicam.acquisitions")])
        monkeypatch.setattr(registry, "entry_points", lambda **by: added.select(**by))


def test_the_loop_measures_where_it_says() -> None:
    rig = build_rig("stereo", seed=1)
    loop = Loop(ForwardGP(), Workspace.of_box(rig.volume), OUTERMOST, Budget(14), candidates=100, judged=50).run(
        SimulatedOracle(rig)
    )
    assert loop.points == 14


def test_every_command_takes_it(cli: Cli, request: pytest.FixtureRequest) -> None:
    assert (
        cli(*["simulate", "rig", "--cameras", "2R", "--positions", "random", "--points", "20", "--seed", "1"]).code == 0
    )
    assert cli(*["calibrate", "rig", "-o", "r.implicam"]).code == 0
    ran = cli(*["suggest", "r.implicam", "-n", "2", "--acquisition", "outermost", "--json"])
    assert ran.code == 0, ran.err
    assert len(ran.json["targets"]) == 2
    ran = cli(*["suggest", "r.implicam", "--acquisition", "outmost"])
    assert "did you mean 'outermost'" in " ".join(ran.err.split())
    ran = cli(*["suggest", "r.implicam", "--acquisition", "outermost:2"])
    assert "has no variants" in " ".join(ran.err.split())
    if "entry point" in request.node.name:
        return  # a session takes long, and is run for the other way
    ran = cli(
        *["acquire", "s", "--unattended", "--cameras", "2R", "--acquisition", "outermost", "--budget", "8", "--json"]
    )
    assert ran.code == 0, ran.err
    assert ran.json["points"] == 8
