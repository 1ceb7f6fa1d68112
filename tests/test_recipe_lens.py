"""The recipe "A lens" of CONTRIBUTING.md, followed to the letter by tests/toy_lens.py; every command is run with it."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import numpy as np
import pytest

from command_line import Cli, cli  # noqa: F401  a fixture
from implicam import registry
from implicam.calibrators import Explicit, load_calibration
from implicam.dataset import Dataset, write_dataset
from implicam.lenses import LENSES
from implicam.rig_model import CentralCamera
from implicam.simulate import build_rig, random_positions, simulate
from toy_lens import Equisolid


@pytest.fixture(autouse=True, params=["registered", "entry point"])
def known_lens(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LENSES, "_parts", dict(LENSES._parts))  # so that it is gone after the test
    if request.param == "registered":
        LENSES.register(Equisolid.family, Equisolid)
    else:
        added = EntryPoints([EntryPoint("equisolid", "toy_lens:Equisolid", "implicam.lenses")])
        monkeypatch.setattr(registry, "entry_points", lambda **by: added.select(**by))


def data(points: int, seed: int) -> Dataset:
    """What four cameras see whose lenses are equisolid ones, of the focal lengths of the simulated rig."""
    rig = build_rig("dome4", seed=3, lens_error=0.0)
    cameras = [replace(c, lens=Equisolid(c.lens.fx, c.lens.fy, c.lens.cx, c.lens.cy, -0.05, 0.01)) for c in rig.cameras]
    rig = replace(rig, cameras=tuple(cameras))
    return simulate(rig, random_positions(rig, points, np.random.default_rng(seed)), seed=seed)


def test_a_calibration_with_it_measures_and_its_file_names_it(tmp_path: Path) -> None:
    known, check = data(60, 1), data(60, 2)
    made = Explicit(lens="equisolid").fit(known)
    made.save(tmp_path / "toy.implicam")
    again = load_calibration(tmp_path / "toy.implicam")
    assert made.state()[0]["lenses"][0]["name"] == "equisolid"
    for before, after in zip(made.map.posterior.models, again.map.posterior.models, strict=True):
        assert isinstance(after.camera, CentralCamera)
        assert isinstance(after.camera.lens, Equisolid)
        assert after.camera.lens == before.camera.lens
    np.testing.assert_array_equal(again.measure(check.observations).xyz, made.measure(check.observations).xyz)
    errors = made.measure(check.observations).xyz - check.xyz
    assert np.sqrt(np.mean(errors**2)) < 0.2  # mm
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(made.measure(check.observations).cov), errors)
    assert 0.6 < nees.mean() / 3 < 1.6  # 180 numbers: 10 % of chance


def test_auto_chooses_it_where_its_views_are_predicted_best() -> None:
    made = Explicit(lens="auto").fit(data(100, 1))
    assert all(set(choice.held_out) >= {"equisolid", "kannala-brandt"} for choice in made.fitted.choices)


def test_a_file_with_a_lens_that_this_version_does_not_have_is_refused_by_name(
    cli: Cli,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    Explicit(lens="equisolid").fit(data(30, 1)).save(tmp_path / "toy.implicam")
    monkeypatch.setattr(LENSES, "_parts", {k: v for k, v in LENSES._parts.items() if k != "equisolid"})
    monkeypatch.setattr(registry, "entry_points", lambda **by: EntryPoints())
    write_dataset(data(5, 2), tmp_path / "new")
    ran = cli("measure", "toy.implicam", "new")
    assert ran.code == 1
    assert "lens of the family 'equisolid', which is not installed" in " ".join(ran.err.split())


@pytest.mark.slow
def test_every_command_takes_it(cli: Cli, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    if "entry point" in request.node.name:
        pytest.skip("run for the other way")
    write_dataset(data(40, 1), tmp_path / "rig")
    write_dataset(data(20, 2), tmp_path / "new")
    for words in (
        "calibrate rig -o toy.implicam --lens equisolid",
        "info toy.implicam",
        "measure toy.implicam new",
        "evaluate toy.implicam new",
        "evaluate rig --method explicit --lens equisolid --cv 3",
        "compare rig --methods explicit:equisolid --train 30 --seeds 1 -o compare.png",
        "suggest toy.implicam -n 1",
        "report toy.implicam -o report.html",
        "export toy.implicam --to dlt -o dlt.csv",
    ):
        ran = cli(*words.split())
        assert ran.code == 0, (words, ran.err)
    for to in ("opencv", "kalibr", "colmap", "aniposelib"):
        ran = cli(*f"export toy.implicam --to {to} -o {to}".split())
        assert ran.code == 1
        assert f"has a lens of the family equisolid, which {to} does not know" in " ".join(ran.err.split())
        assert not (tmp_path / to).exists()
    ran = cli(*["calibrate", "rig", "-o", "x.implicam", "--lens", "equisolit", "--method", "explicit"])
    assert "did you mean 'equisolid'" in ran.err
