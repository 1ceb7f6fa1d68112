"""explicit: the bundle adjustment, and the lens of one camera, against closed forms, SciPy and OpenCV."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from implicam.calibrators.explicit.adjust import Bundle, Placed, Views, _Normal, adjust
from implicam.calibrators.explicit.boards import BoardView, boards_of
from implicam.calibrators.explicit.zhang import calibrate_camera, planar_poses
from implicam.errors import FitError
from implicam.geometry import Pose, candidate_rays, rotation_from_vector
from implicam.lenses import BrownConrady, KannalaBrandt
from implicam.rig_model.camera import CentralCamera, Image, Prior
from implicam.simulate import Rig, build_rig, simulate_boards

# a small bundle, made by hand

FLAT = np.column_stack([*(a.ravel() for a in np.meshgrid(np.arange(6), np.arange(5))), np.zeros(30)]) * 20.0
LENSES = (
    KannalaBrandt(433.0, 431.0, 630.0, 405.0, -0.02, 0.004, -1e-3, 2e-4),
    BrownConrady(930.0, 935.0, 651.0, 392.0, -0.1, 0.02, 4e-4, -3e-4, 0.001),
)


def no_prior(camera: CentralCamera) -> Prior:
    return Prior(np.zeros(camera.size), np.zeros((camera.size, camera.size)))


def small_bundle(noise: float = 0.2, boards: int = 12, seed: int = 0) -> Bundle:
    """Two cameras with different lenses, each board seen by both or by one of them; at the truth."""
    rng = np.random.default_rng(seed)
    poses = (
        Pose(np.eye(3), np.zeros(3)),
        Pose(rotation_from_vector([0.02, 0.15, -0.03]), np.array([-120.0, 4.0, 10.0])),
    )
    cameras = tuple(CentralCamera(lens, pose) for lens, pose in zip(LENSES, poses, strict=True))
    placed, views = [], []
    for k in range(boards):
        turn = rotation_from_vector(rng.normal(scale=0.35, size=3))
        middle = np.array([*rng.uniform([-20, -60], [90, 60]), rng.uniform(280, 420)])
        placed.append(Pose(turn, middle - turn @ FLAT.mean(axis=0)))
        for c in range(2):
            if k % 3 != c:
                uv = cameras[c].pixel(placed[k].apply(FLAT)) + rng.normal(scale=noise, size=(len(FLAT), 2))
                relative = np.where(np.arange(len(FLAT)) % 7 == 0, 2.0, 1.0)
                views.append(BoardView(c, k, FLAT, uv, relative, np.arange(len(FLAT)) + 100 * k))
    assert all(np.isfinite(view.uv).all() for view in views)
    priors = tuple(no_prior(camera) for camera in cameras)
    return Bundle(cameras, priors, Placed.of(placed), Views(tuple(views), 2), np.full(2, noise))


def packed_residuals(bundle: Bundle, z: np.ndarray) -> np.ndarray:
    """All residuals in standard deviations, after a step z of the free unknowns and the boards."""
    step = np.zeros(len(bundle.free))
    step[bundle.free] = z[: bundle.free.sum()]
    moved = bundle.moved(step, z[bundle.free.sum() :].reshape(-1, 6))
    parts = [
        moved.residuals(c) / (bundle.noise[c] * bundle.views.stacks[c].relative)[:, None]
        for c in range(len(bundle.cameras))
    ]
    return np.concatenate(parts).ravel()


def numeric_jacobian(bundle: Bundle) -> np.ndarray:
    steps = np.concatenate(
        [
            *(np.concatenate([np.full(4, 1e-2), np.full(c.size - 10, 1e-5), np.full(3, 1e-6), np.full(3, 1e-4)])
              for c in bundle.cameras)
        ]
    )[bundle.free]  # fmt: skip
    steps = np.concatenate([steps, np.tile([*np.full(3, 1e-6), *np.full(3, 1e-4)], len(bundle.boards.translation))])
    columns = []
    for i, h in enumerate(steps):
        z = np.zeros(len(steps))
        z[i] = h
        columns.append((packed_residuals(bundle, z) - packed_residuals(bundle, -z)) / (2 * h))
    return np.stack(columns, axis=1)


def test_the_normal_equations_are_those_of_the_numeric_jacobian() -> None:
    bundle = small_bundle()
    J, r = numeric_jacobian(bundle), packed_residuals(bundle, np.zeros(bundle.free.sum() + 6 * 12))
    normal, p = _Normal.of(bundle, robust=False), int(bundle.free.sum())
    H, g = J.T @ J, -J.T @ r
    scale = np.sqrt(np.diag(H))
    np.testing.assert_allclose(
        (normal.A[np.ix_(bundle.free, bundle.free)] / scale[:p]).T / scale[:p],
        (H[:p, :p] / scale[:p]).T / scale[:p],
        atol=1e-6,
    )
    np.testing.assert_allclose(normal.a[bundle.free] / scale[:p], g[:p] / scale[:p], atol=1e-3)
    for k in range(12):
        own = slice(p + 6 * k, p + 6 * k + 6)
        np.testing.assert_allclose(
            normal.D[k] / np.outer(scale[own], scale[own]), H[own, own] / np.outer(scale[own], scale[own]), atol=1e-6
        )
        np.testing.assert_allclose(
            normal.B[k][bundle.free] / np.outer(scale[:p], scale[own]),
            H[:p, own] / np.outer(scale[:p], scale[own]),
            atol=1e-6,
        )


def test_a_step_and_the_covariance_are_those_of_the_full_system() -> None:
    bundle = small_bundle()
    J, r = numeric_jacobian(bundle), packed_residuals(bundle, np.zeros(bundle.free.sum() + 6 * 12))
    full = np.linalg.lstsq(J, -r, rcond=None)[0]
    normal, p = _Normal.of(bundle, robust=False), int(bundle.free.sum())
    cameras, boards = normal.step(0.0)
    sd = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    np.testing.assert_allclose(cameras[bundle.free] / sd[:p], full[:p] / sd[:p], atol=2e-4)
    np.testing.assert_allclose(boards.ravel() / sd[p:], full[p:] / sd[p:], atol=2e-4)
    root = normal.root()
    covariance = (root.T @ root)[np.ix_(bundle.free, bundle.free)]
    np.testing.assert_allclose(
        covariance / np.outer(sd[:p], sd[:p]), np.linalg.inv(J.T @ J)[:p, :p] / np.outer(sd[:p], sd[:p]), atol=1e-4
    )
    assert (root[:, ~bundle.free] == 0).all()


def test_it_ends_where_scipy_ends() -> None:
    bundle = small_bundle(boards=6)
    rng = np.random.default_rng(1)
    n = int(bundle.free.sum()) + 36
    start = rng.normal(size=n) * np.concatenate(
        [np.full(n - 36, 1e-3), np.tile([*np.full(3, 0.01), *np.full(3, 2.0)], 6)]
    )
    step = np.zeros(len(bundle.free))
    step[bundle.free] = start[:-36]
    ours = adjust(bundle.moved(step, start[-36:].reshape(6, 6)), robust=False)
    assert ours.converged
    theirs = least_squares(
        lambda z: packed_residuals(bundle, z), np.zeros(n), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    cost = sum(np.sum((ours.bundle.lengths(c) / bundle.noise[c]) ** 2) for c in range(2))
    assert cost == pytest.approx(2 * theirs.cost, rel=1e-7)


def test_one_camera_is_opencvs_calibratecamera() -> None:
    bundle = small_bundle(boards=15)
    views = tuple(replace(v, camera=0) for v in bundle.views.each if v.camera == 1)
    boards = sorted({v.board for v in views})
    views = tuple(replace(v, board=boards.index(v.board), relative=np.ones(len(v.rows))) for v in views)
    poses = Placed.of([bundle.cameras[1].pose @ bundle.boards.pose(k) for k in boards])
    camera = CentralCamera(LENSES[1], Pose(np.eye(3), np.zeros(3)))
    ours = adjust(Bundle((camera,), (no_prior(camera),), poses, Views(views, 1), np.ones(1)), robust=False)
    rms, matrix, distortion, _, _ = cv2.calibrateCamera(
        [v.xyz.astype(np.float32) for v in views],
        [v.uv.astype(np.float32) for v in views],
        (1280, 800),
        np.array([[930.0, 0, 651], [0, 935, 392], [0, 0, 1]]),
        np.zeros(5),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 300, 1e-14),
    )
    lens = ours.bundle.cameras[0].lens
    assert isinstance(lens, BrownConrady)
    sd = np.sqrt(np.diag(ours.root.T @ ours.root)) * 0.2
    theirs = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion.ravel()])
    found = np.array([lens.fx, lens.fy, lens.cx, lens.cy, lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
    np.testing.assert_allclose((found - theirs) / sd[:9], 0, atol=0.02)  # OpenCV has float32 pixels
    left = np.sqrt(np.mean(ours.bundle.lengths(0) ** 2))
    assert left == pytest.approx(float(np.ravel(rms)[0]), rel=1e-5)


def test_one_fisheye_is_opencvs_fisheye() -> None:
    bundle = small_bundle(boards=15)
    views = tuple(v for v in bundle.views.each if v.camera == 0)
    boards = sorted({v.board for v in views})
    views = tuple(replace(v, board=boards.index(v.board), relative=np.ones(len(v.rows))) for v in views)
    poses = Placed.of([bundle.boards.pose(k) for k in boards])
    ours = adjust(Bundle(bundle.cameras[:1], bundle.priors[:1], poses, Views(views, 1), np.ones(1)), robust=False)
    rms, matrix, distortion, _, _ = cv2.fisheye.calibrate(
        [v.xyz.reshape(1, -1, 3) for v in views],
        [v.uv.reshape(1, -1, 2) for v in views],
        (1280, 800),
        np.array([[433.0, 0, 630], [0, 431, 405], [0, 0, 1]]),
        np.zeros(4),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW,
        criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 300, 1e-12),
    )
    lens = ours.bundle.cameras[0].lens
    assert isinstance(lens, KannalaBrandt)
    sd = np.sqrt(np.diag(ours.root.T @ ours.root)) * 0.2
    theirs = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion.ravel()])
    found = np.array([lens.fx, lens.fy, lens.cx, lens.cy, lens.k1, lens.k2, lens.k3, lens.k4])
    np.testing.assert_allclose((found - theirs) / sd[:8], 0, atol=0.05)
    assert np.sqrt(np.mean(ours.bundle.lengths(0) ** 2)) == pytest.approx(float(np.ravel(rms)[0]), rel=1e-4)


def test_a_known_lens_places_a_board_as_solvepnp_does() -> None:
    bundle = small_bundle()
    view = next(v for v in bundle.views.each if v.camera == 1)
    camera = CentralCamera(LENSES[1], Pose(np.eye(3), np.zeros(3)))
    start = Placed.of([Pose(np.eye(3), np.array([0.0, 0.0, 400.0]))])
    only = Views((replace(view, camera=0, board=0, relative=np.ones(len(view.rows))),), 1)
    found = adjust(Bundle((camera,), (no_prior(camera),), start, only, np.ones(1), held=True), robust=False).bundle
    assert found.cameras[0] is camera
    matrix = np.array([[930.0, 0, 651], [0, 935, 392], [0, 0, 1]])
    _, rvec, tvec = cv2.solvePnP(view.xyz, view.uv, matrix, np.array([-0.1, 0.02, 4e-4, -3e-4, 0.001]))
    np.testing.assert_allclose(found.boards.rotation[0], rotation_from_vector(rvec.ravel()), atol=1e-5)
    np.testing.assert_allclose(found.boards.translation[0], tvec.ravel(), rtol=1e-5, atol=1e-3)


def test_wrong_corners_hardly_matter_to_the_robust_sum() -> None:
    clean = small_bundle()
    rng = np.random.default_rng(2)
    spoilt = []
    for view in clean.views.each:
        uv = view.uv.copy()
        wrong = rng.choice(len(uv), 3, replace=False)
        uv[wrong] += rng.uniform(-40, 40, size=(3, 2))
        spoilt.append(replace(view, uv=uv))
    bundle = replace(clean, views=Views(tuple(spoilt), 2))
    robust, plain = adjust(bundle), adjust(bundle, robust=False)
    truth, sd = clean.cameras[1].pose.centre, np.sqrt(np.diag(robust.root.T @ robust.root))[-3:].max()
    assert np.linalg.norm(robust.bundle.cameras[1].pose.centre - truth) < 8 * sd
    assert np.linalg.norm(plain.bundle.cameras[1].pose.centre - truth) > 8 * sd


# one camera


@pytest.mark.parametrize("pinhole", [True, False])
def test_a_board_without_noise_is_placed_exactly_for_the_right_lens_only(pinhole: bool) -> None:
    focal, of_pinhole, _ = candidate_rays(np.array([[400.0, 0.0]]))
    rung = int(np.flatnonzero(of_pinhole == pinhole)[20])
    f = float(focal[rung])
    pose = Pose(rotation_from_vector([0.3, -0.4, 0.1]), np.array([-30.0, -20.0, 250.0]))
    there = pose.apply(FLAT)
    r = np.hypot(there[:, 0], there[:, 1])
    theta = np.arctan2(r, there[:, 2])
    uv = there[:, :2] / r[:, None] * (f * (np.tan(theta) if pinhole else theta))[:, None]
    rays = candidate_rays(np.vstack([uv, [400.0, 0.0]]))[2][:, :-1]
    poses, errors = planar_poses(FLAT[:, :2], rays, focal)
    assert np.argmin(np.sum(errors**2, axis=1)) == rung
    assert errors[rung].max() < 1e-4
    np.testing.assert_allclose(poses[rung].rotation, pose.rotation, atol=1e-7)
    np.testing.assert_allclose(poses[rung].translation, pose.translation, atol=1e-5)


def views_of(rig: Rig, camera: str, count: int, seed: int, **options: Any) -> tuple[tuple[BoardView, ...], Image]:
    data = simulate_boards(rig, [(camera,)] * count, seed=seed, **options).with_cameras([camera])
    boards = boards_of(data)
    return boards.views, boards.images[0]


@pytest.mark.slow
@pytest.mark.parametrize(("camera", "focal_sd"), [("cam2", 4.0), ("cam1", 2.0), ("cam6", 2.0)])
def test_zhang_finds_the_lens_of_any_camera(camera: str, focal_sd: float) -> None:
    for seed in range(2):
        rig = build_rig("bar6", seed=seed, lens_error=0.0)
        truth = next(c for c in rig.cameras if c.name == camera).lens
        found, choice = calibrate_camera(*views_of(rig, camera, 12, seed), "auto")
        assert abs(found.camera.lens.fx - truth.fx) < focal_sd
        assert abs(found.camera.lens.cx - truth.cx) < 2 * focal_sd
        assert 0.17 < found.noise < 0.23
        if isinstance(truth, KannalaBrandt):
            assert choice.lens == "kannala-brandt"


def test_a_strongly_decentred_lens_is_told_from_a_fisheye() -> None:
    rig = build_rig("stereo", seed=0, lens_error=0.0)
    lens = BrownConrady(1200.0, 1200.0, 640.0, 512.0, -0.2, 0.05, 3e-3, -2e-3, 0.0)
    rig = replace(rig, cameras=(replace(rig.cameras[0], lens=lens), rig.cameras[1]))
    found, choice = calibrate_camera(*views_of(rig, "cam1", 15, 0), "auto")
    assert choice.lens == "brown-conrady"
    assert choice.held_out["brown-conrady"] < choice.held_out["kannala-brandt"]
    assert isinstance(found.camera.lens, BrownConrady)
    assert found.camera.lens.p1 == pytest.approx(3e-3, abs=5e-4)


def test_a_named_lens_is_used_or_refused_with_the_reason() -> None:
    rig = build_rig("bar6", seed=1, lens_error=0.0)
    found, choice = calibrate_camera(*views_of(rig, "cam2", 8, 1), "brown-conrady")
    assert choice.lens == "brown-conrady"
    assert isinstance(found.camera.lens, BrownConrady)
    wide = CentralCamera(KannalaBrandt(300.0, 300.0, 640.0, 400.0), Pose(np.eye(3), np.zeros(3)))
    with pytest.raises(FitError, match="cannot look 84° off its axis"):
        BrownConrady.nearest(wide.lens, np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.1]]))


def test_corners_of_no_board_are_refused() -> None:
    rig = build_rig("bar6", seed=1)
    views, image = views_of(rig, "cam1", 6, 1)
    rng = np.random.default_rng(0)
    nonsense = [replace(v, uv=rng.uniform(0, 800, size=v.uv.shape)) for v in views]
    with pytest.raises(FitError, match="no lens explains the corners of its 6 boards"):
        calibrate_camera(nonsense, image, "auto")
