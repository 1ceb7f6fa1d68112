"""Poses, registration, resection, triangulation, depth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from implicam.errors import FitError
from implicam.geometry import (
    Pose,
    camera_centre,
    depth_of_points,
    look_at,
    register,
    resect,
    resect_any_lens,
    resect_rays,
    rotation_from_vector,
    triangulate,
    vector_from_rotation,
)
from implicam.simulate import ball_grid, build_rig, moving_board, random_positions, simulate


def any_pose(rng: np.random.Generator) -> Pose:
    return Pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 300)


def pinhole(pose: Pose) -> np.ndarray:
    k = np.array([[900.0, 0, 640], [0, 905, 400], [0, 0, 1]])
    return k @ np.column_stack([pose.rotation, pose.translation])


def project(p: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    w = np.column_stack([xyz, np.ones(len(xyz))]) @ p.T
    return w[:, :2] / w[:, 2:]


def pinholes_round(rng: np.random.Generator, n: int) -> np.ndarray:
    """Camera matrices about 600 from the origin of a world that lies somewhere else."""
    centres = rng.normal(size=(n, 3))
    centres *= 600 / np.linalg.norm(centres, axis=1, keepdims=True)
    return np.stack([pinhole(look_at(c, (0, 0, 0))) for c in centres])


def test_poses_compose_and_cancel() -> None:
    rng = np.random.default_rng(0)
    a_from_b, b_from_c, xyz = any_pose(rng), any_pose(rng), rng.normal(size=(5, 3))
    np.testing.assert_allclose((a_from_b @ b_from_c).apply(xyz), a_from_b.apply(b_from_c.apply(xyz)), atol=1e-9)
    np.testing.assert_allclose(a_from_b.inverse().apply(a_from_b.apply(xyz)), xyz, atol=1e-9)
    np.testing.assert_allclose(a_from_b.apply(a_from_b.centre), 0, atol=1e-9)


@pytest.mark.parametrize("target", [(0, 0, 0), (100, 200, 900), (100, 200, -5)])  # the last two: straight up and down
def test_look_at(target: tuple[float, float, float]) -> None:
    pose = look_at((100, 200, 300), target)
    x, y, z = pose.apply(np.array(target, dtype=float))
    assert abs(x) < 1e-9
    assert abs(y) < 1e-9
    assert z == pytest.approx(np.linalg.norm(np.subtract(target, (100, 200, 300))))
    assert np.linalg.det(pose.rotation) == pytest.approx(1)
    np.testing.assert_allclose(pose.centre, (100, 200, 300))


def test_look_at_keeps_up_up() -> None:
    pose = look_at((0, -500, 0), (0, 0, 0))  # looks along +y: x is right, z up is -y in the image
    np.testing.assert_allclose(pose.apply(np.array([10.0, 0, 20])), [10, -20, 500], atol=1e-9)


def test_rotation_vectors() -> None:
    np.testing.assert_allclose(rotation_from_vector([0, 0, np.pi / 2]) @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    vector = np.random.default_rng(0).normal(size=(4, 3))
    np.testing.assert_allclose(vector_from_rotation(rotation_from_vector(vector)), vector, atol=1e-12)


def test_registration_finds_the_motion_and_leaves_out_nan() -> None:
    rng = np.random.default_rng(0)
    pose, source = any_pose(rng), rng.normal(size=(20, 3)) * 100
    target = pose.apply(source)
    target[3] = np.nan
    found, rms = register(source, target)
    np.testing.assert_allclose(found.rotation, pose.rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, pose.translation, atol=1e-9)
    assert rms < 1e-9


def test_registration_rms_is_the_noise_and_a_mirror_image_stays_mirrored() -> None:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(20_000, 3)) * 100
    _, rms = register(source, source + rng.normal(scale=0.3, size=source.shape))
    assert rms == pytest.approx(0.3 * np.sqrt(3), rel=0.02)
    pose, rms = register(source, source * [1, 1, -1])
    assert np.linalg.det(pose.rotation) == pytest.approx(1)
    assert rms > 50


@pytest.mark.parametrize("points", [np.zeros((2, 3)), np.outer(np.arange(9.0), [1, 2, 3])], ids=["two", "line"])
def test_registration_refuses_what_does_not_fix_it(points: np.ndarray) -> None:
    with pytest.raises(FitError, match="do not fix a rigid motion"):
        register(points, points)


def test_resection_is_exact_without_noise_and_signs_depth() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-100, 100, (12, 3))
    p = pinholes_round(rng, 1)[0]
    uv = project(p, xyz)
    uv[4] = np.nan
    shift = np.array([3000.0, -700, 50])
    found = resect(xyz + shift, uv)
    np.testing.assert_allclose(found[:, :3], p[:, :3] / np.linalg.norm(p[2, :3]), atol=1e-5)
    np.testing.assert_allclose(project(found, xyz[[4]] + shift), project(p, xyz[[4]]), atol=1e-6)
    np.testing.assert_allclose(camera_centre(found) - shift, camera_centre(p), atol=1e-5)


def test_resection_refuses_few_and_flat_points_with_a_cure() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-100, 100, (30, 3))
    p = pinholes_round(rng, 1)[0]
    with pytest.raises(FitError, match="needs at least 6"):
        resect(xyz[:5], project(p, xyz[:5]))
    flat = xyz * [1, 1, 0] + [0, 0, 7]
    for method in (resect, resect_any_lens):
        with pytest.raises(FitError, match="one plane") as caught:
            method(flat, project(p, flat))
        assert "fix: " in str(caught.value)
    with pytest.raises(FitError, match="do not fix the camera"):
        resect(xyz, np.full((30, 2), 5.0))


def test_triangulation_is_exact_and_a_missing_view_drops_out() -> None:
    rng = np.random.default_rng(0)
    xyz, cameras = rng.uniform(-100, 100, (6, 3)), pinholes_round(rng, 4)
    uv = np.stack([project(p, xyz) for p in cameras], axis=1)
    uv[0, 1] = np.nan
    uv[1, [0, 1]] = np.nan
    uv[2, [0, 1, 3]] = np.nan
    uv[3] = np.nan
    found = triangulate(cameras, uv)
    np.testing.assert_allclose(found[[0, 1, 4, 5]], xyz[[0, 1, 4, 5]], atol=1e-8)
    assert np.isnan(found[[2, 3]]).all()


def test_two_views_from_one_place_fix_nothing() -> None:
    p = pinholes_round(np.random.default_rng(0), 1)[0]
    uv = project(p, np.array([[10.0, 20, 30]]))
    assert np.isnan(triangulate(np.stack([p, p]), np.stack([uv, uv], axis=1))).all()


def test_triangulation_does_not_depend_on_origin_or_unit() -> None:
    rng = np.random.default_rng(1)
    xyz, cameras = rng.uniform(-100, 100, (6, 3)), pinholes_round(rng, 3)
    uv = np.stack([project(p, xyz) for p in cameras], axis=1) + rng.normal(scale=0.5, size=(6, 3, 2))
    scale, shift = 1e-3, np.array([5.0, -2, 1])
    old_from_new = np.eye(4)
    old_from_new[:3] = np.column_stack([np.eye(3) / scale, -shift / scale])
    np.testing.assert_allclose(
        triangulate(cameras @ old_from_new, uv), triangulate(cameras, uv) * scale + shift, atol=1e-9
    )


def test_resection_from_rays_is_exact() -> None:
    rng = np.random.default_rng(0)
    pose, xyz = any_pose(rng), rng.normal(size=(12, 3)) * 100 + 900
    rays = pose.apply(xyz) / np.linalg.norm(pose.apply(xyz), axis=1, keepdims=True)  # all round: a fisheye's
    found = resect_rays(xyz, rays)
    np.testing.assert_allclose(found.rotation, pose.rotation, atol=1e-8)
    np.testing.assert_allclose(found.centre, pose.centre, atol=1e-5)


def true_depth(rig, data) -> np.ndarray:
    cameras = [c for c, n in zip(rig.cameras, data.observations.seen.sum(axis=0), strict=True) if n >= 6]
    return np.mean([np.linalg.norm(data.xyz - c.camera_from_world.centre, axis=1) for c in cameras], axis=0)


@pytest.mark.parametrize("spec", ["bar6", "stereo", "dome8", "bar2"])
@pytest.mark.parametrize("seed", [0, 1])
def test_depth_orders_the_points_of_any_rig(spec: str, seed: int) -> None:
    rig = build_rig(spec, seed=seed, frame="random")
    for target in (
        ball_grid(rig),
        random_positions(rig, 20, np.random.default_rng(seed)),
        moving_board(rig, corners=(3, 4)),
    ):
        data = simulate(rig, target, seed=seed, missing=0.1)
        depth = depth_of_points(data.xyz, data.observations.uv)
        assert depth is not None
        assert spearmanr(depth, true_depth(rig, data))[0] > 0.95


@pytest.mark.parametrize("seed", [0, 1])
def test_depth_bears_wrong_detections(seed: int) -> None:
    rig = build_rig("bar6", seed=seed)
    data = simulate(rig, ball_grid(rig), seed=seed, outliers=0.1)
    sizes = np.array([(c.width, c.height) for c in rig.cameras], dtype=float)
    depth = depth_of_points(data.xyz, data.observations.uv, sizes)
    assert depth is not None
    assert spearmanr(depth, true_depth(rig, data))[0] > 0.95


@pytest.mark.parametrize("spec", ["bar6", "stereo", "dome8"])
def test_depth_is_a_length(spec: str) -> None:
    rig = build_rig(spec, seed=3, unit="m")
    data = simulate(rig, ball_grid(rig), seed=3)
    sizes = np.array([(c.width, c.height) for c in rig.cameras], dtype=float)
    np.testing.assert_allclose(depth_of_points(data.xyz, data.observations.uv, sizes), true_depth(rig, data), rtol=0.15)


def test_there_is_no_depth_without_depth() -> None:
    rig = build_rig("bar6", seed=0)
    board = simulate(rig, moving_board(rig, positions=1), seed=0)
    assert depth_of_points(board.xyz, board.observations.uv) is None
    assert depth_of_points(board.xyz[:4], board.observations.uv[:4]) is None
