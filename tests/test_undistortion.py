"""Maps that make cameras pinholes: against OpenCV, against the truth of simulated rigs, and by what cv2.remap does."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

import implicam as ic
from implicam.calibrators import Calibration, ForwardGP
from implicam.calibrators.explicit import calibration_of, rig_of
from implicam.calibrators.undistortion import PinholeView, pinhole_maps
from implicam.errors import DatasetError, UsageError
from implicam.exchange import import_cameras
from implicam.exchange.pixel_maps import NO_PIXEL, PinholeMaps, read_maps, write_maps
from implicam.geometry import triangulate
from implicam.lenses import KannalaBrandt
from implicam.simulate import Rig, Unusual, build_rig, random_positions, simulate

SMALL = PinholeView(alpha=0.0, size=(160, 100))
"""The whole picture in an eighth of its size: 64 times as fast."""


def rig_of_kind(kind: str) -> Rig:
    """Two cameras (stereo), some of them unusual."""
    unusual = {"mirror": Unusual(mirror="all"), "window": Unusual(window=25.0)}.get(kind, Unusual())
    rig = build_rig("stereo", seed=5, unusual=unusual, lens_error=0.0 if kind == "lens" else 0.5)
    if kind == "fisheye":
        wide = KannalaBrandt(350.0, 350.0, 640.0, 400.0)  # 105 degrees off the axis at the left and right
        rig = replace(rig, cameras=tuple(replace(camera, lens=wide) for camera in rig.cameras))
    return rig


@cache
def fitted(kind: str, method: str = "forward-gp", points: int = 80) -> tuple[Rig, Calibration]:
    rig = rig_of_kind(kind)
    data = simulate(rig, random_positions(rig, points, np.random.default_rng(5)), seed=5)
    made: Calibration
    if method == "explicit":
        made = ic.Explicit(lens="brown-conrady").fit(data)
    else:
        made = ForwardGP(lens=method.removeprefix("forward-gp:") if ":" in method else "auto").fit(data)
    return rig, made


@cache
def maps_of(kind: str, method: str = "forward-gp") -> tuple[list[PinholeMaps], list[str]]:
    return pinhole_maps(fitted(kind, method)[1], SMALL)


def off_the_truth(kind: str, method: str = "forward-gp", *, beyond: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Errors of maps (n, 2), px, and their sds, at places as deep as the known points are."""
    rig, calibration = fitted(kind, method)
    rng, errors, sds = np.random.default_rng(0), [], []
    for maps, camera in zip(maps_of(kind, method)[0], rig.cameras, strict=True):
        v, u = np.nonzero(maps.filled & (maps.extrapolated == beyond))
        pose = maps.pinhole.camera_from_world
        depth = rng.choice(pose.apply(calibration.data.xyz)[:, 2], len(u))
        rays = np.linalg.solve(maps.K, np.stack([u, v, np.ones(len(u))])).T
        uv = camera.pixel_from_world(pose.inverse().apply(rays * depth[:, None]))[0]
        seen = np.isfinite(uv).all(axis=1)
        errors.append((np.column_stack([maps.map_x[v, u], maps.map_y[v, u]]) - uv)[seen])
        sds.append(np.column_stack([maps.sd_x[v, u], maps.sd_y[v, u]])[seen])
    return np.concatenate(errors), np.concatenate(sds)


# ---- the maps are right


def test_a_lens_of_opencv_has_the_maps_of_opencv() -> None:
    calibration = fitted("lens", "explicit")[1]
    for maps, camera in zip(maps_of("lens", "explicit")[0], calibration.cameras.values(), strict=True):
        lens = camera.lens
        matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
        distortion = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
        x, y = cv2.initUndistortRectifyMap(matrix, distortion, None, maps.K, maps.pinhole.size, cv2.CV_32FC1)
        np.testing.assert_allclose(maps.map_x, x, atol=1e-3)
        np.testing.assert_allclose(maps.map_y, y, atol=1e-3)


@pytest.mark.parametrize(
    ("kind", "method"),
    [("usual", "forward-gp"), ("usual", "forward-gp:none"), ("mirror", "forward-gp"), ("window", "forward-gp")],
)
def test_what_the_maps_are_off_is_what_their_sd_says(kind: str, method: str) -> None:
    """One rig's errors are one smooth draw a camera: the bounds are wide. docs/exchange.md has many rigs."""
    error, sd = off_the_truth(kind, method)
    assert 0.2 < np.mean((error / sd) ** 2) < 2.5
    assert np.mean(np.abs(error) < 1.96 * sd) > 0.8
    beyond, said = off_the_truth(kind, method, beyond=True)
    assert np.mean((beyond / said) ** 2) < 5
    assert np.median(said) > 2 * np.median(sd)  # nothing is known there, and it says so


def test_straight_lines_of_the_world_are_straight() -> None:
    rig, calibration = fitted("fisheye")
    low, high = calibration.data.xyz.min(axis=0), calibration.data.xyz.max(axis=0)
    line = low + np.linspace(0.05, 0.95, 25)[:, None] * (high - low) * [1, 1, 0.3]
    for maps, camera in zip(maps_of("fisheye")[0], rig.cameras, strict=True):
        before = camera.pixel_from_world(line)[0]
        after = maps.undistort(before)
        sizes = [np.linalg.svd(uv - uv.mean(axis=0), compute_uv=False) for uv in (before, after)]
        bent = [across / along for along, across in sizes]
        assert bent[1] < 0.2 * bent[0]
        off = after - maps.pinhole.pixel_from_world(line)[0]  # and they are where the pinhole sees them
        scale = maps.K[0, 0] / camera.lens.fx
        assert np.sqrt(np.mean(off**2)) < 3 * scale * np.max(maps.sd[maps.filled & ~maps.extrapolated])


def test_a_mirrored_picture_is_turned_over() -> None:
    maps = maps_of("mirror")[0][0]
    assert np.linalg.det(maps.pinhole.camera_from_world.rotation) == pytest.approx(1)
    assert maps.map_x[50, 0] > maps.map_x[50, -1] or maps.map_y[0, 80] > maps.map_y[-1, 80]


def test_linear_triangulation_with_the_pinholes_measures_the_same() -> None:
    rig, calibration = fitted("usual")
    check = simulate(rig, random_positions(rig, 60, np.random.default_rng(9)), seed=9)
    maps = maps_of("usual")[0]
    measured = calibration.measure(check.observations)
    straight = np.stack([each.undistort(check.observations.uv[:, c]) for c, each in enumerate(maps)], axis=1)
    poses = [each.pinhole.camera_from_world for each in maps]
    projections = [
        each.K @ np.column_stack([pose.rotation, pose.translation]) for each, pose in zip(maps, poses, strict=True)
    ]
    xyz = triangulate(np.array(projections), straight)
    both = np.isfinite(xyz).all(axis=1) & measured.measured
    assert both.sum() > 20
    off = (xyz - measured.xyz)[both] / measured.sd[both]
    assert np.sqrt(np.mean(off**2)) < 0.5


def test_the_inverse_of_a_map_brings_back_its_pixels() -> None:
    maps = maps_of("usual")[0][0]
    at = np.array([[0.0, 0.0], [80.0, 50.0], [159.0, 99.0], [7.0, 75.0]])
    u, v = at.astype(int).T
    there = np.column_stack([maps.map_x[v, u], maps.map_y[v, u]]).astype(float)
    np.testing.assert_allclose(maps.undistort(there), at, atol=1e-3)
    assert np.isnan(maps.undistort(np.array([[-500.0, 3.0], [np.nan, 1.0]]))).all()
    assert maps.undistort(np.zeros((0, 2))).shape == (0, 2)


# ---- what is not known


def test_the_depth_is_said_and_can_be_chosen() -> None:
    calibration = fitted("window")[1]
    both, notes = maps_of("window")
    assert "no exact pinhole" in " ".join(notes)
    depths = both[0].depths
    one, told = pinhole_maps(calibration, replace(SMALL, depth=float(np.median(depths))))
    assert not any("no exact pinhole" in note for note in told)
    assert len(one[0].depths) == 1
    near = both[0].filled & ~both[0].extrapolated
    assert np.median(one[0].sd[near]) < np.median(both[0].sd[near])


def test_cameras_from_elsewhere_have_no_sd() -> None:
    rig, _ = rig_of(fitted("lens", "explicit")[1])
    maps, notes = pinhole_maps(calibration_of(rig, "elsewhere", 0.3), SMALL)
    assert np.isnan(maps[0].sd).all()
    assert maps[0].extrapolated.all()
    assert maps[0].filled.all()
    assert maps[0].summary()["largest_sd_px"] is None
    assert sum("nothing is known of how well" in note for note in notes) == 2


def test_what_a_lens_leaves_is_in_the_sd_of_explicit() -> None:
    calibration = fitted("usual", "explicit")[1]
    maps, notes = maps_of("usual", "explicit")
    for number, each in enumerate(maps):
        misfit = calibration.map.misfit(number)
        assert misfit > 0
        assert np.nanmin(each.sd) >= np.float32(misfit)
    assert "supposes that the family" in notes[-1]
    assert all(fitted("usual")[1].map.misfit(number) == 0 for number in range(2))  # its field follows the lens


# ---- what the pinhole sees


def test_a_fisheye_is_cut() -> None:
    calibration = fitted("fisheye")[1]
    shown = {}
    for alpha in (0.0, 0.5, 1.0):
        (maps, _), notes = pinhole_maps(calibration, PinholeView(alpha=alpha, size=(161, 101), max_angle=60))
        shown[alpha] = maps
        assert "more than 60 degrees off its axis" in " ".join(notes)
        v, u = np.nonzero(maps.map_x != NO_PIXEL)
        rays = np.linalg.solve(maps.K, np.stack([u, v, np.ones(len(u))]))
        assert np.degrees(np.arctan(np.hypot(rays[0], rays[1]))).max() <= 60
        assert np.isnan(maps.sd[maps.map_x == NO_PIXEL]).all()
    assert shown[0.0].filled.mean() > 0.999
    assert shown[1.0].K[0, 0] < shown[0.5].K[0, 0] < shown[0.0].K[0, 0]
    assert not shown[1.0].filled[0, 0]


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"alpha": 1.5}, "alpha = 1.5"),
        ({"size": (4, 4)}, "from 16x16"),
        ({"max_angle": 90.0}, "up to 85 degrees"),
        ({"depth": 0.0}, "above zero"),
    ],
)
def test_a_view_that_cannot_be_is_refused(options: dict, what: str) -> None:
    with pytest.raises(UsageError, match=what):
        PinholeView(**options)


def test_methods_without_cameras_are_refused() -> None:
    data = fitted("usual")[1].data
    with pytest.raises(UsageError, match="no cameras that could become pinholes"):
        pinhole_maps(ic.InverseGP().fit(data.split(40, seed=0)[0]))


def test_a_camera_without_its_size_is_refused() -> None:
    data = fitted("lens", "explicit")[1].data
    cameras = tuple(replace(camera, width=None, height=None) for camera in data.observations.cameras)
    unknown = replace(data, observations=replace(data.observations, cameras=cameras))
    with pytest.raises(DatasetError, match="image size of camera"):
        pinhole_maps(ic.Explicit(lens="brown-conrady").fit(unknown))


# ---- files, and what others do with them


def test_numpy_and_opencv_read_the_same(tmp_path: Path) -> None:
    maps = maps_of("usual")[0]
    write_maps(maps, "mm", tmp_path / "maps")
    write_maps(maps, "mm", tmp_path / "maps")  # again, over its own
    name = maps[0].pinhole.name
    back, arrays = read_maps(tmp_path / "maps" / f"{name}.npz"), maps[0].arrays()
    storage = cv2.FileStorage(str(tmp_path / "maps" / f"{name}.yml.gz"), cv2.FILE_STORAGE_READ)
    for key, array in arrays.items():
        np.testing.assert_array_equal(back.arrays()[key], array)
        np.testing.assert_array_equal(np.squeeze(storage.getNode(key).mat()), np.squeeze(array))
    rig = import_cameras(tmp_path / "maps" / "pinholes.toml")
    assert rig.length_unit == "mm"
    x = fitted("usual")[1].data.xyz[:5]
    np.testing.assert_allclose(rig.cameras[0].pixel_from_world(x)[0], maps[0].pinhole.pixel_from_world(x)[0])
    (tmp_path / "maps" / "mine.txt").touch()
    with pytest.raises(DatasetError, match=r"mine.txt"):
        write_maps(maps, "mm", tmp_path / "maps")
    (tmp_path / "x.npz").write_bytes(b"no")
    with pytest.raises(DatasetError, match="cannot be read"):
        read_maps(tmp_path / "x.npz")


def test_remap_shows_what_the_pinhole_would() -> None:
    """A picture whose grey value is its own u: remapped, each pixel is where the map says; no pixel is black."""
    (maps, _), _ = pinhole_maps(fitted("fisheye")[1], PinholeView(alpha=1.0, size=(161, 101), max_angle=60))
    picture = np.tile(np.arange(1, 1281, dtype=np.float32), (800, 1))
    straight = cv2.remap(picture, maps.map_x, maps.map_y, cv2.INTER_LINEAR)
    np.testing.assert_allclose(straight[maps.filled], maps.map_x[maps.filled] + 1, atol=0.04)  # steps of 1/32 px
    assert (straight[maps.map_x == NO_PIXEL] == 0).all()
