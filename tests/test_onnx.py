"""Calibrations as ONNX graphs: what ONNX Runtime makes of them is what Python measures and predicts, to rounding."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import implicam as ic
from command_line import Cli, cli  # noqa: F401
from deployed_rigs import RIGS, boards, covariances, forward_gp
from implicam import calibration_file
from implicam.calibrators import Calibration
from implicam.calibrators.inverse_gp import InverseGPCalibration
from implicam.calibrators.protocol import RigCalibration
from implicam.errors import UsageError
from implicam.geometry import Pose
from implicam.rig_model import CentralCamera
from implicam.simulate import Rig, Unusual, build_rig, random_positions, simulate
from toy_lens import Equisolid

pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

from implicam.deploy import write_onnx  # noqa: E402
from implicam.deploy.onnx_cameras import forward_graph  # noqa: E402

WORKSPACE_PART, PART_OF_PLAIN = 1e-9, 1e-8
"""What a position or its sd may differ by, over the extent of the known positions. Python's own answers differ by a
third of it when the known points come in another order."""
PIXEL_PART = 1e-9
"""What a pixel may differ by, over the longer side of the image."""


def run(path: Path, feed: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return dict(zip([output.name for output in session.get_outputs()], session.run(None, feed), strict=True))


@cache
def four_cameras() -> Rig:
    return build_rig("bar6", seed=7, frame="random", cameras="2R2W")


@cache
def by_inverse_gp(**options: str) -> InverseGPCalibration:
    known = simulate(four_cameras(), random_positions(four_cameras(), 50, np.random.default_rng(1)), seed=8)
    return ic.InverseGP(**options).fit(known)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"preset": "plain"},
        {"outputs": "coregionalised"},
        {"kernel": "matern-5/2"},
        {"kernel": "matern-5/2", "preset": "plain"},
    ],
    ids=str,
)
def test_inverse_gp(options: dict[str, str], tmp_path: Path) -> None:
    made = by_inverse_gp(**options)
    new = simulate(
        four_cameras(), random_positions(four_cameras(), 100, np.random.default_rng(2)), seed=9, missing=0.03
    )
    seen = new.observations
    uv = seen.uv.copy()
    uv[3] += 300  # unlike anything learned
    measured = made.measure(ic.Observations(seen.points, seen.cameras, uv, seen.sd))
    assert np.isnan(measured.xyz).any(axis=1).sum() > 5

    assert write_onnx(made, tmp_path / "rig.onnx") == []
    found = run(tmp_path / "rig.onnx", {f"uv_{name}": uv[:, c] for c, name in enumerate(seen.camera_names)})
    most = (WORKSPACE_PART if not options else PART_OF_PLAIN) * float(np.ptp(made.data.xyz, axis=0).max())
    np.testing.assert_allclose(found["xyz"], measured.xyz, rtol=0, atol=most)  # NaN in the same rows
    np.testing.assert_allclose(found["sd"], measured.sd, rtol=0, atol=most)
    size = measured.sd[:, :, None] * measured.sd[:, None, :]
    np.testing.assert_allclose(found["covariance"] / size, measured.cov / size, rtol=0, atol=1e-4)
    assert found["xyz"].dtype == np.float64


def around(made: RigCalibration, seed: int = 0) -> np.ndarray:
    """Positions in the workspace, near it, and far away, behind the cameras too."""
    low, high = made.data.xyz.min(axis=0), made.data.xyz.max(axis=0)
    rng, size = np.random.default_rng(seed), high - low
    near = rng.uniform(low - 0.3 * size, high + 0.3 * size, (200, 3))
    far = rng.uniform(low - 20 * size, high + 20 * size, (100, 3))
    return np.concatenate([near, far, made.data.xyz[:20], [[np.nan, 0, 0]]])


FAST = {"perspective", "mirror", "no lens", "explicit brown-conrady", "explicit kannala-brandt"}


@pytest.mark.parametrize("kind", [pytest.param(k, marks=[] if k in FAST else [pytest.mark.slow]) for k in RIGS])
def test_the_forward_map(kind: str, tmp_path: Path) -> None:
    made = RIGS[kind]()
    notes = write_onnx(made, tmp_path / "rig.onnx")
    assert bool(notes) == made.map.posterior.tied
    xyz = around(made)
    found, uv = run(tmp_path / "rig.onnx", {"xyz": xyz}), made.predict(xyz)
    for name, covariance in zip(made.camera_names, covariances(made, xyz), strict=True):
        c = made.trained.camera_names.index(name)
        near = np.abs(uv[:, c]).max(axis=1, initial=0) < 1e5
        off = (found[f"uv_{name}"] - uv[:, c]) / np.where(near, 1000.0, np.abs(uv[:, c]).max(axis=1))[:, None]
        np.testing.assert_array_equal(np.isnan(found[f"uv_{name}"]), np.isnan(uv[:, c]))
        assert np.nanmax(np.abs(off)) < PIXEL_PART
        sd = np.sqrt(np.einsum("nii->ni", covariance))
        size = sd[:, :, None] * sd[:, None, :]
        np.testing.assert_allclose(found[f"covariance_{name}"] / size, covariance / size, rtol=0, atol=1e-8)
    assert np.isnan(uv).any()


@pytest.mark.slow
def test_positions_as_labelled_near_boards(tmp_path: Path) -> None:
    made = boards()
    labels = made.map.labels
    assert labels is not None
    assert labels.unknowns is not None
    write_onnx(made, tmp_path / "rig.onnx")
    xyz = around(made)
    assert np.abs(labels.off(made.map.frame.to_working(xyz[:-1]))).max() > 1e-6
    found, uv = run(tmp_path / "rig.onnx", {"xyz": xyz}), made.predict(xyz)
    for c, name in enumerate(made.camera_names):
        np.testing.assert_allclose(found[f"uv_{name}"][:200], uv[:200, c], rtol=0, atol=1e-6)


def test_the_command_and_what_the_file_says_of_itself(cli: Cli, tmp_path: Path) -> None:
    import onnx

    made = forward_gp(Unusual())
    made.save("rig.implicam")
    ran = cli("export", "rig.implicam", "--to", "onnx", "-o", "rig.onnx", "--json")
    assert ran.json == {"format": "onnx", "file": "rig.onnx", "notes": []}
    told = {entry.key: entry.value for entry in onnx.load("rig.onnx").metadata_props}
    assert told["calibration_sha256"] == calibration_file.checksum("rig.implicam")
    assert told["length_unit"] == made.data.length_unit
    assert [camera["width"] for camera in json.loads(told["cameras"])] == [1280, 1280]
    assert json.loads(told["noise_px"]).keys() == {"cam1", "cam2"}
    first = Path("rig.onnx").read_bytes()
    assert cli("export", "rig.implicam", "--to", "onnx", "-o", "rig.onnx").out.startswith("rig.onnx: a graph of ONNX")
    assert Path("rig.onnx").read_bytes() == first
    assert cli("export", "rig.implicam", "--to", "onnx", "-o", "rig.implicam").code == 2


def test_what_cannot_be_a_graph_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="mlp cannot be written"):
        write_onnx(cast(Calibration, SimpleNamespace(method="mlp")), tmp_path / "rig.onnx")
    rig = forward_gp(Unusual(), "central").map
    strange = replace(rig.posterior.models[0], camera=CentralCamera(Equisolid(1, 1, 0, 0), Pose(np.eye(3), np.ones(3))))
    posterior = replace(rig.posterior, models=(strange, *rig.posterior.models[1:]))
    with pytest.raises(UsageError, match="family equisolid cannot be written as a graph"):
        forward_graph(replace(rig, posterior=posterior))
