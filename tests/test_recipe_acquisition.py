"""The recipe "An acquisition" of CONTRIBUTING.md, followed to the letter by a toy; every command is run with it."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import EntryPoint, EntryPoints
from typing import ClassVar

import numpy as np
import pytest

import test_active as contract
from command_line import Cli, Ran, cli, made  # noqa: F401  fixtures
from implicam import registry
from implicam.active import ACQUISITIONS, Acquisition, Budget, Loop, SimulatedOracle, Workspace, acquisition_from_name
from implicam.active.design_model import DesignModel
from implicam.calibrators import calibrator
from implicam.dataset import Dataset, Floats
from implicam.errors import UsageError
from implicam.simulate import Rig
from test_active import known, rig, room  # noqa: F401  fixtures

pytestmark = pytest.mark.usefixtures("looks_kept")

# Step 1: the rule


@dataclass(frozen=True)
class Highest(Acquisition):
    """As high up as a known point can be."""

    name: ClassVar[str] = "highest"

    def scores(self, design: DesignModel, rng: np.random.Generator) -> Floats:
        """The height above the lowest candidate."""
        z = design.candidates.xyz[:, 2]
        return z - z.min(initial=np.inf)


# Step 2: the registry; the two ways

HIGHEST = Highest()


@pytest.fixture(autouse=True, params=["registered", "entry point"])
def known_rules(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ACQUISITIONS, "_parts", dict(ACQUISITIONS._parts))  # so that it is gone after the test
    if request.param == "registered":
        ACQUISITIONS.register("highest", HIGHEST)
    else:
        added = EntryPoints([EntryPoint("highest", f"{__name__}:HIGHEST", "implicam.acquisitions")])
        monkeypatch.setattr(registry, "entry_points", lambda **by: added.select(**by))


# Step 3: the contract


@pytest.mark.parametrize("kind", [contract.forward, contract.inverse])
def test_it_keeps_the_contract(kind: object, known: Dataset, room: Workspace) -> None:
    contract.test_every_acquisition("highest", kind, known, room)


# every command


def run(cli: Cli, words: str) -> Ran:
    return cli(*words.split())


def test_suggest_works_with_it(made: object, cli: Cli) -> None:
    ran = cli("suggest", f"{made}/rig.implicam", "-n", 3, "--acquisition", "highest", "--json")
    assert ran.code == 0, ran.err
    highest = [target["xyz"][2] for target in ran.json["targets"]]
    usual = cli("suggest", f"{made}/rig.implicam", "-n", 3, "--acquisition", "random", "--json").json["targets"]
    assert highest == sorted(highest, reverse=True)
    assert min(highest) >= max(target["xyz"][2] for target in usual)


@pytest.mark.slow
def test_acquire_works_with_it(cli: Cli, request: pytest.FixtureRequest) -> None:
    if "entry point" in request.node.name:
        pytest.skip("run for the other way")
    ran = run(cli, "acquire s --unattended --cameras 2R --acquisition highest --budget 10 --json")
    assert ran.code == 0, ran.err
    assert 8 <= ran.json["points"] <= 10


@pytest.mark.parametrize("method", ["forward-gp", "inverse-gp"])
def test_the_loop_works_with_it(method: str, rig: Rig) -> None:
    loop = Loop(
        calibrator(method),
        Workspace.from_box(rig.volume),
        acquisition_from_name("highest"),
        Budget(10),
        candidates=60,
        judged=30,
    )
    loop = loop.run(SimulatedOracle(rig))
    assert loop.points == 10


@pytest.mark.parametrize(
    ("name", "says"), [("higest", "did you mean 'highest'"), ("highest:most", "highest has no variants")]
)
def test_another_name_is_refused_with_the_cure(name: str, says: str) -> None:
    with pytest.raises(UsageError, match=says) as error:
        acquisition_from_name(name)
    assert "highest" in error.value.fix
