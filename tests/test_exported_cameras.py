"""Calibrations as cameras of other programs: these read the files, and see what the calibration sees, to the misfit
that the export states."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

import implicam as ic
from command_line import Cli, cli, files, made  # noqa: F401  fixtures
from deployed_rigs import fisheyes
from implicam.calibrators.explicit import rig_of
from implicam.calibrators.protocol import RigCalibration
from implicam.cli.cameras import WRITE_FOLDERS
from implicam.exchange import export_cameras
from implicam.simulate import build_rig, random_positions, simulate

NOTHING_LOST_PX = 0.01
"""Up to which an export says nothing."""

OTHER_PLACES = 1.25
"""The misfit was stated at other positions of the workspace; the largest of these may be so much larger."""

Seen = dict[str, np.ndarray]


def by_opencv(path: Path, xyz: np.ndarray) -> Seen:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)  # its nodes live as long as it
    nodes, found = storage.getNode("cameras"), {}
    for node in (nodes.at(i) for i in range(nodes.size())):
        project = cv2.fisheye.projectPoints if node.getNode("fisheye_model").real() == 1 else cv2.projectPoints
        k, d, r, t = (node.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients", "R", "T"))
        metres = 0.001 * xyz  # the rigs are in mm, the files in m
        found[node.getNode("name").string()] = project(metres[:, None], cv2.Rodrigues(r)[0], t, k, d)[0].reshape(-1, 2)
    return found


def by_pycolmap(path: Path, xyz: np.ndarray) -> Seen:
    model = pytest.importorskip("pycolmap").Reconstruction(path)
    images = model.images.values()
    return {image.name: image.camera.img_from_cam(image.cam_from_world() * xyz) - 0.5 for image in images}


def by_aniposelib(path: Path, xyz: np.ndarray) -> Seen:
    group = pytest.importorskip("aniposelib.cameras").CameraGroup.load(str(path))
    return dict(zip(group.get_names(), group.project(xyz), strict=True))


PROGRAMS: dict[str, Callable[[Path, np.ndarray], Seen]] = {
    "opencv": by_opencv,
    "colmap": by_pycolmap,
    "aniposelib": by_aniposelib,
}


@cache
def calibrated(kind: str) -> RigCalibration:
    rig = fisheyes() if "fisheye" in kind else build_rig("bar6", seed=4, cameras="2R")
    data = simulate(rig, random_positions(rig, 60, np.random.default_rng(5)), seed=5)
    lens = "kannala-brandt" if "fisheye" in kind else "brown-conrady"
    made: RigCalibration = (ic.Explicit(lens=lens) if "explicit" in kind else ic.ForwardGP()).fit(data)
    return made


def stated(notes: list[str], name: str) -> tuple[float, float]:
    """Rms and largest misfit of a camera, px."""
    told = [re.search(rf"^{name}: .* ([\d.e-]+) px rms are lost, at most ([\d.e-]+) px", note) for note in notes]
    found = [(float(match[1]), float(match[2])) for match in told if match]
    return found[0] if found else (NOTHING_LOST_PX, NOTHING_LOST_PX)


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize(
    "kind",
    [
        "forward-gp",
        "forward-gp fisheye",
        pytest.param("explicit", marks=pytest.mark.slow),
        pytest.param("explicit fisheye", marks=pytest.mark.slow),
    ],
)
def test_other_programs_see_what_the_calibration_sees(program: str, kind: str, tmp_path: Path) -> None:
    made = calibrated(kind)
    rig, lost = rig_of(made)
    assert bool(lost) == kind.startswith("forward-gp")
    export_cameras(rig, program, tmp_path / "cameras")
    low, high = made.data.xyz.min(axis=0), made.data.xyz.max(axis=0)
    xyz = np.random.default_rng(9).uniform(low, high, (500, 3))
    found, uv = PROGRAMS[program](tmp_path / "cameras", xyz), made.predict(xyz)
    assert found.keys() == set(made.camera_names)
    for c, name in enumerate(made.camera_names):
        camera = made.trained.cameras[c]
        size = np.array([camera.width, camera.height])
        inside = ((uv[:, c] > 0) & (uv[:, c] < size - 1)).all(axis=1)
        off = np.linalg.norm(found[name] - uv[:, c], axis=1)[inside]
        rms, largest = stated(lost, name)
        assert inside.sum() > 100
        assert np.sqrt(np.mean(off**2)) < OTHER_PLACES * rms
        assert off.max() < OTHER_PLACES * largest


@pytest.mark.parametrize("to", WRITE_FOLDERS)
def test_a_folder_that_holds_something_else_is_never_replaced(to: str, made: Path, cli: Cli) -> None:
    kept = Path("victim", "deep", "notes.txt")
    kept.parent.mkdir(parents=True)
    kept.write_text("mine")
    ran = cli("export", made / "rig.implicam", "--to", to, "-o", "victim")
    assert ran.code == 1
    assert "notes.txt', which is no part of " in ran.err or "cannot be written" in ran.err, ran.err
    assert files(Path("victim")) == {"deep/notes.txt": b"mine"}
