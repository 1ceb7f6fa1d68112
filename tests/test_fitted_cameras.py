"""The lens and the place of each calibrated camera: in Python, and what `implicam info` prints of them."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

import implicam as ic
from command_line import Cli, cli  # noqa: F401  a fixture
from implicam.calibrators.protocol import RigCalibration
from implicam.dataset import Dataset
from implicam.lenses import Lens, focal_lengths


@pytest.fixture(scope="module")
def data() -> Dataset:
    return ic.simulated("bar6", points=60, seed=1).with_cameras(["cam1", "cam2"])


@pytest.fixture(scope="module", params=["explicit", "forward-gp"])
def made(request: pytest.FixtureRequest, data: Dataset) -> RigCalibration:
    made = (ic.Explicit() if request.param == "explicit" else ic.ForwardGP()).fit(data)
    assert isinstance(made, RigCalibration)
    return made


def lens_of(made: RigCalibration, camera: str) -> Lens:
    lens = made.cameras[camera].lens
    assert lens is not None
    return lens


@pytest.mark.slow
def test_a_camera_has_its_lens_and_its_pose_in_the_world(made: RigCalibration, data: Dataset) -> None:
    """Within what the note says that a lens loses of forward-gp's field."""
    assert list(made.cameras) == ["cam1", "cam2"]
    predicted = made.predict(data.xyz)
    for number, camera in enumerate(made.cameras.values()):
        assert camera.camera_from_world is not None
        there = camera.camera_from_world.apply(data.xyz)
        off = lens_of(made, camera.name).pixel_from_camera_point(there)[0] - predicted[:, number]
        assert np.sqrt(np.nanmean(off**2)) < (0.5 if camera.note else 1e-6)
        np.testing.assert_allclose(camera.camera_from_world.centre, made.centres()[camera.name], atol=2.0)
    assert bool(camera.note) == (made.method == "forward-gp")  # type: ignore[attr-defined]


@pytest.mark.slow
def test_info_prints_them(made: RigCalibration, cli: Cli, tmp_path: Path) -> None:
    made.save(tmp_path / "rig.implicam")
    told = cli("info", "rig.implicam", "--json").json["fitted_cameras"]
    assert told == [camera.as_table() for camera in made.cameras.values()]
    lens = lens_of(made, "cam2")
    assert told[1]["lens"] == lens.family
    assert told[1]["focal_length_px"] == list(focal_lengths(lens))
    assert told[1]["principal_point_px"] == [lens.cx, lens.cy]
    assert all(getattr(lens, name) == value for name, value in told[1]["distortion"].items())
    assert len(told[1]["distortion"]) >= 4
    shown = tomllib.loads(cli("info", "rig.implicam").out)["fitted_cameras"][1]
    assert shown["distortion"] == pytest.approx(told[1]["distortion"], rel=1e-5)
    np.testing.assert_allclose(shown["rotation"], told[1]["rotation"], rtol=1e-5)
    assert shown["centre"] == pytest.approx(told[1]["centre"], rel=1e-5)


def test_a_camera_without_a_lens_says_so(data: Dataset, cli: Cli, tmp_path: Path) -> None:
    made = ic.ForwardGP(lens="none").fit(data)
    assert made.cameras["cam1"].lens is None
    assert made.cameras["cam1"].note == "has no lens model"
    made.save(tmp_path / "rig.implicam")
    told = cli("info", "rig.implicam", "--json").json["fitted_cameras"]
    assert told[0] == {"name": "cam1", "note": "has no lens model"}


def test_a_method_without_cameras_has_none(data: Dataset, cli: Cli, tmp_path: Path) -> None:
    ic.InverseGP().fit(data).save(tmp_path / "rig.implicam")
    assert cli("info", "rig.implicam", "--json").json["fitted_cameras"] == []
    assert "fitted_cameras" not in cli("info", "rig.implicam").out
