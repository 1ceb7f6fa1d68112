"""Cameras of the rig model: derivatives, lines of sight, priors, and a start from no guess."""

from __future__ import annotations

import numpy as np
import pytest

from forward_gp_cases import IMAGE, numeric, rotation
from implicam.errors import FitError
from implicam.geometry import Pose, look_at
from implicam.lenses import PERSPECTIVE_K, BrownConrady, KannalaBrandt
from implicam.rig_model.camera import CentralCamera, ProjectiveCamera
from implicam.rig_model.general_camera import AnyCamera
from implicam.rig_model.initialise import start_camera

POSE = Pose(rotation(0), np.array([0.1, -0.2, 0.3]))


CAMERAS: dict[str, tuple[AnyCamera, float]] = {
    "telephoto": (CentralCamera(KannalaBrandt(9000.0, 9010.0, 645.0, 390.0, *PERSPECTIVE_K), POSE), 4.0),
    "normal": (CentralCamera(KannalaBrandt(900.0, 903.0, 630.0, 405.0, 0.25, 0.1, 0.04, 0.01), POSE), 35.0),
    "fisheye": (CentralCamera(KannalaBrandt(330.0, 329.0, 642.0, 402.0, -0.02, 0.004, -1e-3, 1e-4), POSE), 105.0),
    "perspective": (
        CentralCamera(BrownConrady(900.0, 903.0, 630.0, 405.0, -0.1, 0.02, 4e-4, -3e-4, 0.001), POSE),
        35.0,
    ),
    "projective": (
        ProjectiveCamera(
            np.array([[900.0, 3.0, 640.0], [0.0, 905.0, 400.0], [0.0, 0.0, 1.0]])
            @ np.column_stack([POSE.rotation, POSE.translation])
        ),
        35.0,
    ),
}
"""And how far off the axis they see, in degrees."""


every_camera = pytest.mark.parametrize("name", CAMERAS)


def cone(degrees: float, n: int, seed: int) -> np.ndarray:
    """Points in the camera frame, up to so many degrees off the axis, at a distance from 1 to 3."""
    rng = np.random.default_rng(seed)
    theta = np.radians(degrees) * np.sqrt(rng.uniform(0.01, 1, n))
    phi = rng.uniform(0, 2 * np.pi, n)
    rays = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    return rays * rng.uniform(1, 3, (n, 1))


def seen_points(name: str, n: int = 60) -> np.ndarray:
    points = POSE.inverse().apply(cone(CAMERAS[name][1], n, 1))
    assert np.isfinite(CAMERAS[name][0].pixel(points)).all()
    return points


@every_camera
def test_derivatives_by_parameters(name: str) -> None:
    camera, points = CAMERAS[name][0], seen_points(name)
    if isinstance(camera, CentralCamera):
        bent = 1.0 if name == "telephoto" else 1e-4  # distortion, in which pixels are linear
        steps = np.array([*np.full(4, 1e-2), *np.full(camera.size - 10, bent), *np.full(6, 1e-5)])
    else:
        steps = 1e-5 * np.maximum(np.abs(camera.P), 0.1).ravel()
    expected = numeric(lambda step: camera.moved(step).pixel(points), steps)
    found = camera.view(points).by_parameters
    assert found.shape == (len(points), 2, camera.size)
    scale = np.abs(expected).max(axis=(0, 1))
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-6)


@every_camera
def test_derivatives_by_the_point(name: str) -> None:
    camera, points = CAMERAS[name][0], seen_points(name)
    view, steps = camera.view(points), np.full(3, 1e-5)
    expected = numeric(lambda d: camera.pixel(points + d), steps)
    np.testing.assert_allclose(view.by_point, expected, atol=2e-7 * np.abs(expected).max())
    expected = numeric(lambda d: camera.view(points + d).log_distance, steps)
    np.testing.assert_allclose(view.distance_by_point, expected, atol=1e-8)
    np.testing.assert_array_equal(view.uv, camera.pixel(points))


@every_camera
def test_the_log_distance_is_that(name: str) -> None:
    camera, points = CAMERAS[name][0], seen_points(name)
    there = POSE.apply(points)
    distance = np.linalg.norm(there, axis=1) if isinstance(camera, CentralCamera) else there[:, 2]
    np.testing.assert_allclose(camera.view(points).log_distance, np.log(distance), atol=1e-12)


@every_camera
def test_what_is_seen_at_a_glance_is_what_is_seen_in_full(name: str) -> None:
    camera, points = CAMERAS[name][0], seen_points(name)
    with np.errstate(invalid="ignore"):  # log w behind a linear projection
        for found, expected in zip(camera.sight(-points), camera.view(-points)[:2], strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-9)
    for found, expected in zip(camera.sight(points), camera.view(points)[:2], strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-9)


@every_camera
def test_a_line_of_sight_passes_through_what_is_seen_on_it(name: str) -> None:
    camera, points = CAMERAS[name][0], seen_points(name)
    centre, directions = camera.lines(camera.pixel(points))
    np.testing.assert_allclose(centre, POSE.centre, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    away = points - centre
    np.testing.assert_allclose(directions, away / np.linalg.norm(away, axis=1, keepdims=True), atol=1e-8)


def test_what_no_camera_sees_is_nan() -> None:
    behind = POSE.inverse().apply(np.array([[0.1, 0.2, -1.0], [0.0, 0.0, -2.0]]))
    folding = CentralCamera(KannalaBrandt(900.0, 900.0, 640.0, 400.0, -0.3), POSE)  # turns back at 60 degrees
    for camera in (folding, CAMERAS["projective"][0]):
        view = camera.view(behind)
        assert np.isnan(view.uv).all()
        assert np.isnan(camera.pixel(behind)).all()
        assert np.isnan(view.by_point).all()
    _, directions = folding.lines(np.array([[640.0, 400.0], [640.0, 400.0 + 2000.0]]))
    assert np.isfinite(directions[0]).all()
    assert np.isnan(directions[1]).all()


@every_camera
def test_a_camera_and_its_array_are_the_same(name: str) -> None:
    camera, points = CAMERAS[name][0], seen_points(name)
    array = camera.as_array()
    kind = type(camera)
    again = kind.from_array(array.copy(), *([type(camera.lens)] if kind is CentralCamera else []))
    np.testing.assert_array_equal(again.as_array(), array)
    np.testing.assert_array_equal(again.pixel(points), camera.pixel(points))
    assert array.dtype == np.float64
    assert array.shape == ({14: 20, 15: 21}[camera.size] if isinstance(camera, CentralCamera) else 12,)


def test_an_array_without_a_rotation_is_refused() -> None:
    good = CAMERAS["normal"][0].as_array()
    for wrong in (1.01 * POSE.rotation, np.zeros((3, 3)), np.full((3, 3), np.nan), POSE.rotation + np.eye(3)[0]):
        array = good.copy()
        array[8:17] = wrong.ravel()
        with pytest.raises(ValueError, match="rotation"):
            CentralCamera.from_array(array, KannalaBrandt)


def test_a_mirror_is_not_a_rotation() -> None:
    array = CAMERAS["normal"][0].as_array()
    array[8:17] = (np.diag([1.0, 1.0, -1.0]) @ POSE.rotation).ravel()
    with pytest.raises(ValueError, match="rotation"):
        CentralCamera.from_array(array, KannalaBrandt)


def test_the_lens_prior_holds_square_pixels_and_both_kinds_of_lenses() -> None:
    """Its square, a chi-squared of as many terms as it has directions, for lenses that exist and for others."""

    def square(lens: KannalaBrandt, widest: float) -> float:
        camera = CentralCamera(lens, POSE)
        prior = camera.prior(IMAGE, widest)
        off = camera.parameters - prior.mean
        assert np.linalg.eigvalsh(prior.precision).min() > -1e-9 * np.linalg.eigvalsh(prior.precision).max()
        np.testing.assert_array_equal(prior.precision[8:], 0)  # the pose is free
        return float(off @ prior.precision @ off)

    for widest in (0.3, 0.6, 1.0):
        assert square(KannalaBrandt(900.0, 900.0, *IMAGE.centre.tolist(), *PERSPECTIVE_K.tolist()), widest) < 2
        assert square(KannalaBrandt(900.0, 900.0, *IMAGE.centre.tolist()), widest) < 2
    assert square(KannalaBrandt(900.0, 909.0, *IMAGE.centre.tolist()), 0.5) > 20  # 1 % off square
    assert square(KannalaBrandt(900.0, 900.0, 750.0, 400.0), 0.5) > 10  # 110 px off the centre
    a, b = (square(KannalaBrandt(f, f, *IMAGE.centre.tolist()), 0.5) for f in (300.0, 3000.0))
    assert a == pytest.approx(b)  # the focal length is free


def made(fov: float, n: int, seed: int) -> tuple[CentralCamera, np.ndarray, np.ndarray]:
    """A camera with a full field of view in degrees over an image 1280 wide, points in front of it, and its pixels."""
    rng = np.random.default_rng(seed)
    widest = np.radians(fov / 2)
    k = 0.5 * PERSPECTIVE_K if fov < 100 else np.array([-0.02, 0.004, -5e-4, 1e-5])
    focal = 600 / float(widest * np.polyval([*k[::-1], 1.0], widest**2))
    scale, offset = 10 ** rng.uniform(-1, 3), rng.uniform(-5, 5, 3)
    centre = scale * (offset + rng.normal(size=3))
    pose = look_at(centre, centre + rng.normal(size=3), up=rng.normal(size=3))
    lens = KannalaBrandt(focal, focal * 1.0005, *(IMAGE.centre + rng.normal(scale=5, size=2)).tolist(), *k.tolist())
    camera = CentralCamera(lens, pose)
    points = pose.inverse().apply(scale * cone(fov / 2, n, seed + 1000))
    return camera, points, camera.pixel(points)


def working(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    offset, scale = points.mean(axis=0), float(points.std(axis=0).max())
    return (points - offset) / scale, offset, scale


@pytest.mark.parametrize("fov", [40.0, 70.0, 110.0, 150.0, 185.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_camera_is_found_from_nothing(fov: float, seed: int) -> None:
    camera, world, uv = made(fov, 80, seed)
    points, offset, scale = working(world)
    started = start_camera(points[:60], uv[:60], IMAGE, "central")
    assert isinstance(started.camera, CentralCamera)
    assert started.inliers.all()
    assert np.abs(started.camera.pixel(points[60:]) - uv[60:]).max() < 0.05  # px; the prior holds it that far
    centre = started.camera.pose.centre * scale + offset
    assert np.linalg.norm(centre - camera.pose.centre) < 1e-3 * scale
    turn = started.camera.pose.rotation @ camera.pose.rotation.T
    assert np.trace(turn) > 1 + 2 * np.cos(2e-3)
    assert started.camera.lens.fx == pytest.approx(camera.lens.fx, rel=2e-3)


@pytest.mark.parametrize("fov", [60.0, 100.0, 160.0])
@pytest.mark.parametrize("seed", range(4))
def test_a_fifth_of_wrong_detections_does_not_lead_it_astray(fov: float, seed: int) -> None:
    rng = np.random.default_rng([seed, 7])
    camera, world, uv = made(fov, 40, seed + 20)
    points, offset, scale = working(world)
    wrong = np.zeros(40, dtype=np.bool_)
    wrong[rng.choice(40, 8, replace=False)] = True
    noisy = uv + rng.normal(scale=0.2, size=uv.shape)
    for i in np.flatnonzero(wrong):
        while np.linalg.norm(noisy[i] - uv[i]) < 30:
            noisy[i] = rng.uniform(0, [1280, 800])
    started = start_camera(points, noisy, IMAGE, "central")
    assert not started.inliers[wrong].any()
    assert started.inliers[~wrong].sum() >= 31
    assert np.sqrt(np.mean((started.camera.pixel(points) - uv) ** 2)) < 0.4
    assert isinstance(started.camera, CentralCamera)
    assert np.linalg.norm(started.camera.pose.centre * scale + offset - camera.pose.centre) < 0.05 * scale


@pytest.mark.parametrize("seed", range(3))
def test_a_projective_camera_is_found_exactly(seed: int) -> None:
    points = seen_points("projective", 30)
    turn, shift = rotation(seed), np.random.default_rng(seed).normal(size=3)
    uv = CAMERAS["projective"][0].pixel(points)
    moved, offset, scale = working(points @ turn.T + 100 * shift)
    started = start_camera(moved, uv, IMAGE, "none")
    np.testing.assert_allclose(started.camera.pixel(moved), uv, atol=1e-5)
    centre, _ = started.camera.lines(uv)
    np.testing.assert_allclose((centre * scale + offset - 100 * shift) @ turn, POSE.centre, atol=1e-6)
    wrong = uv.copy()
    wrong[4] += 80
    inliers = start_camera(moved, wrong, IMAGE, "none").inliers
    assert not inliers[4]
    assert inliers.sum() >= 28


@pytest.mark.parametrize("lens", ["central", "none"])
def test_points_that_do_not_fix_a_camera_are_refused(lens: str) -> None:
    _, world, uv = made(60.0, 40, 1)
    points, _, _ = working(world)
    for n in (5, 7):
        with pytest.raises(FitError):
            start_camera(points[:n], uv[:n], IMAGE, lens)
    camera = CAMERAS["normal"][0]
    flat = POSE.inverse().apply(np.column_stack([np.random.default_rng(0).uniform(-0.5, 0.5, (40, 2)), np.full(40, 2)]))
    line = POSE.inverse().apply(np.linspace([-0.5, 0.1, 1.5], [0.6, 0.3, 2.5], 40))
    for some in (flat, line):
        with pytest.raises(FitError):
            start_camera(some, camera.pixel(some), IMAGE, lens)
