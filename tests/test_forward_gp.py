"""forward-gp piece by piece: against finite differences, dense matrices, other optimisers, and the simulated truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.stats import chi2, kstest, multivariate_normal

from implicam.calibrators import ForwardGP, ForwardGPCalibration, load_calibration
from implicam.calibrators.forward_gp.evidence import CameraEvidence, RigEvidence
from implicam.cameras import BrownConrady, KannalaBrandt
from implicam.dataset import Camera, Dataset, KnownPositions, Observations, join
from implicam.errors import FitError, UsageError
from implicam.geometry import Pose, look_at
from implicam.gp.low_rank import LowRank
from implicam.measurement import Measurement
from implicam.rig_model.camera import PERSPECTIVE_K, CentralCamera, Image, Prior, ProjectiveCamera
from implicam.rig_model.camera_model import CameraModel, CameraViews
from implicam.rig_model.field import empty_field
from implicam.rig_model.general_camera import AnyCamera
from implicam.rig_model.initialise import start_camera
from implicam.rig_model.leave_one_out import left_out_residuals, squared_distances
from implicam.rig_model.posterior import Posterior, condition
from implicam.rig_model.shot_errors import SHOT_SD_PRIOR, WORLD_POLYNOMIAL_TERMS, ShotErrors, Shots
from implicam.rig_model.tied import Scatter, condition_scattered
from implicam.rig_model.triangulate import locate
from implicam.simulate import Rig, Target, build_rig, moving_board, random_positions, simulate

IMAGE = Image(np.array([639.5, 399.5]), 640.0)


def rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return np.asarray(q * np.linalg.det(q))


# lens

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


def numeric(f: Callable[[np.ndarray], np.ndarray], steps: np.ndarray) -> np.ndarray:
    """Central differences of f at zero, the variable last."""
    columns = []
    for i, h in enumerate(steps):
        d = np.zeros(len(steps))
        d[i] = h
        columns.append((f(d) - f(-d)) / (2 * h))
    return np.stack(columns, axis=-1)


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
    again = type(camera).from_array(array.copy())
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
            CentralCamera.from_array(array)


def test_a_mirror_is_not_a_rotation() -> None:
    array = CAMERAS["normal"][0].as_array()
    array[8:17] = (np.diag([1.0, 1.0, -1.0]) @ POSE.rotation).ravel()
    with pytest.raises(ValueError, match="rotation"):
        CentralCamera.from_array(array)


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


# start


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


# evidence

LENGTHSCALE = np.array([0.7, 1.5])


def camera_evidence(n: int = 40, p: int = 4, seed: int = 0, sizes: tuple[float, float] = (0.8, 0.2)) -> CameraEvidence:
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1, 1, (n, 3))
    X = rng.normal(size=(n, 2, p)) * 10.0 ** np.arange(p)
    root = rng.normal(size=(p, p)) / 10.0 ** np.arange(p)
    prior = Prior(np.zeros(p), np.linalg.inv(root.T @ root + np.diag(0.01 ** np.arange(p))))
    off, relative = rng.normal(size=p) / 10.0 ** np.arange(p), rng.uniform(0.5, 2, n)
    L = np.linalg.cholesky(se(q, q, LENGTHSCALE) + 1e-9 * np.eye(n))
    field = sizes[0] * L @ rng.normal(size=(n, 2))
    noise = sizes[1] * relative[:, None] * rng.normal(size=(n, 2))
    step = off + np.linalg.cholesky(np.linalg.inv(prior.precision)) @ rng.normal(size=p)
    return CameraEvidence(X @ step + field + noise, X, off, prior, q, relative)


def se(a: np.ndarray, b: np.ndarray, lengthscale: np.ndarray) -> np.ndarray:
    d = (a[:, None] - b[None]) / lengthscale[[0, 0, 1]]
    return np.asarray(np.exp(-0.5 * np.sum(d**2, axis=2)))


def minus_log_density(given: CameraEvidence, signal: float, noise: float, lengthscale: np.ndarray) -> float:
    """Both coordinates of all points as one dense normal vector."""
    K = signal**2 * se(given.q, given.q, lengthscale) + noise**2 * np.diag(given.relative**2)
    X = given.X.swapaxes(0, 1).reshape(-1, given.X.shape[2])
    cov = np.kron(np.eye(2), K) + X @ np.linalg.solve(given.prior.precision, X.T)
    return -float(multivariate_normal.logpdf(given.residual.T.ravel(), X @ given.off, cov, allow_singular=True))


SIZES = [(0.8, 0.2), (0.3, 0.2), (2.0, 0.5), (0.05, 1.0), (1.0, 0.03)]


@pytest.mark.parametrize("seed", range(3))
def test_the_evidence_is_that_of_one_dense_normal_distribution(seed: int) -> None:
    given = camera_evidence(seed=seed)
    for lengthscale in (LENGTHSCALE, np.array([3.0, 0.4])):
        spectrum = given.spectrum(lengthscale, 1e-13)
        found = np.array([given.objective(spectrum, *sizes)[0] for sizes in SIZES])
        expected = np.array([minus_log_density(given, *sizes, lengthscale) for sizes in SIZES])
        assert np.ptp(expected) > 10
        np.testing.assert_allclose(found - found[0], expected - expected[0], atol=1e-3, rtol=1e-6)


def test_the_evidence_compares_lengthscales_too() -> None:
    given = camera_evidence()
    lengthscales = [LENGTHSCALE, np.array([0.3, 1.0]), np.array([3.0, 0.4]), np.array([10.0, 30.0])]
    found = np.array([given.objective(given.spectrum(scale, 1e-13), 0.8, 0.2)[0] for scale in lengthscales])
    expected = np.array([minus_log_density(given, 0.8, 0.2, scale) for scale in lengthscales])
    assert np.ptp(expected) > 10
    np.testing.assert_allclose(found - found[0], expected - expected[0], atol=1e-3)


@pytest.mark.parametrize("sizes", SIZES)
def test_the_evidence_knows_its_gradient(sizes: tuple[float, float]) -> None:
    given = camera_evidence(seed=5)
    spectrum = given.spectrum(LENGTHSCALE, 1e-6)
    expected = numeric(
        lambda d: np.array(given.objective(spectrum, *(np.array(sizes) * np.exp(d)).tolist())[0]), np.full(2, 1e-5)
    )
    np.testing.assert_allclose(given.objective(spectrum, *sizes)[1:], expected, rtol=1e-5, atol=1e-4)


def test_sizes_and_lengthscales_are_found_again() -> None:
    """Three cameras, sizes as in pixels of an image 1280 wide; a misprint of a factor of two would show."""
    true = (0.4, 0.2)
    cameras = [camera_evidence(150, seed=10 + c, sizes=true) for c in range(3)]
    half, stated = np.full(3, 640.0), np.full(3, np.nan)
    found = RigEvidence(cameras, half, stated, "central", 1e-6).maximise()
    np.testing.assert_allclose(found.noise, true[1], rtol=0.15)
    np.testing.assert_allclose(found.signal, true[0], rtol=0.4)
    np.testing.assert_allclose(found.lengthscale, np.tile(LENGTHSCALE, (3, 1)), rtol=0.35)
    again = RigEvidence(cameras, half, stated, "central", 1e-6).maximise(found)
    np.testing.assert_allclose(again.noise, found.noise, rtol=0.03)
    np.testing.assert_allclose(again.lengthscale, found.lengthscale, rtol=0.2)


def test_with_little_data_the_stated_noise_decides() -> None:
    few = [camera_evidence(9, seed=30 + c, sizes=(0.3, 0.2)) for c in range(2)]
    for stated in (0.1, 0.4):
        found = RigEvidence(few, np.full(2, 640.0), np.full(2, stated), "central", 1e-6).maximise()
        assert np.abs(np.log(found.noise / stated)).max() < 0.5


# posterior


def two_cameras(
    *, field_points: int = 50, signal: float = 0.5, noise: float = 0.2, proper: bool = True
) -> tuple[tuple[CameraModel, ...], np.ndarray, tuple[CameraViews, ...]]:
    """Two cameras and 50 points, of which each sees most, with a smooth error and noise; models before the fit."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.2, 1.2, (50, 3))
    models, camera_views = [], []
    for number, centre in enumerate([(-2.5, 0.3, -3.5), (2.2, -0.4, -3.2)]):
        lens = KannalaBrandt(900.0, 901.0, 642.0, 396.0, *(0.5 * PERSPECTIVE_K).tolist())
        real = CentralCamera(lens, look_at(centre, (0.0, 0.0, 0.0), up=(0.0, -1.0, 0.0)))
        rows = np.sort(rng.choice(50, 44, replace=False))
        uv = real.pixel(points[rows])
        uv = uv + 0.5 * np.sin(uv[:, ::-1] / 150) + noise * rng.normal(size=uv.shape)
        step = rng.normal(size=14) * np.array([2, 2, 3, 3, 0.01, 0.01, 0.01, 0.01, *np.full(6, 1e-3)])
        camera = real.moved(step)
        prior = camera.prior(IMAGE, 0.6)
        if proper:
            precision = prior.precision.copy()
            precision[range(14), range(14)] += np.array([1e-4, 1e-4, *np.zeros(6), *np.full(6, 1e2)])
            prior = Prior(prior.mean, precision)
        none = empty_field(np.ones(2), np.zeros((1, 3)), 1.0)
        model = CameraModel(
            camera=camera,
            field_camera=camera,
            prior=prior,
            image=IMAGE,
            field=none,
            signal=signal,
            noise=noise * (1 + number),
            weights=np.zeros((1, 2)),
        )
        q = model.coordinates(camera.view(points[:field_points]))
        field = empty_field(LENGTHSCALE, q, 1e-7)
        weights = np.zeros((len(field.inducing), 2))
        models.append(replace(model, field=field, weights=weights))
        camera_views.append(CameraViews(rows, uv, rng.uniform(0.7, 1.5, len(rows))))
    return tuple(models), points, tuple(camera_views)


def design(model: CameraModel, points: np.ndarray) -> np.ndarray:
    """(n, 2, P) derivative of the pixels by the camera's unknowns."""
    rows = model.rows(points)
    n, m = rows.phi.shape
    wide = np.zeros((n, 2, 2 * m))
    wide[:, 0, :m] = wide[:, 1, m:] = rows.phi
    return np.concatenate([rows.J, wide], axis=2)


def regression(
    X: np.ndarray, y: np.ndarray, sd: np.ndarray, mean: np.ndarray, precision: np.ndarray, *, density: bool = True
) -> tuple[np.ndarray, np.ndarray, float]:
    """Bayesian linear regression: posterior mean and covariance, and the log density of y."""
    A = precision + X.T @ (X / sd[:, None] ** 2)
    scale = 1 / np.sqrt(np.diag(A))
    covariance = np.linalg.inv(A * np.outer(scale, scale)) * np.outer(scale, scale)
    posterior_mean = mean + covariance @ (X.T @ ((y - X @ mean) / sd**2))
    log_density = np.nan
    if density:
        spread = np.diag(sd**2) + X @ np.linalg.solve(precision, X.T)
        log_density = float(multivariate_normal.logpdf(y, X @ mean, spread, allow_singular=True))
    return posterior_mean, covariance, log_density


def dense_problem(
    models: tuple[CameraModel, ...], points: np.ndarray, camera_views: tuple[CameraViews, ...]
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Designs of each camera, y, sd, and the prior of all cameras' unknowns."""
    designs, y, sd, mean, precision = [], [], [], [], []
    for model, seen in zip(models, camera_views, strict=True):
        designs.append(design(model, points[seen.rows]).reshape(2 * len(seen.rows), -1))
        y.append((seen.uv - model.camera.pixel(points[seen.rows])).ravel())
        sd.append(np.repeat(model.noise * seen.relative, 2))
        m = len(model.field.inducing)
        mean.append(np.concatenate([model.prior.mean - model.camera.parameters, np.zeros(2 * m)]))
        precision.append(block_diag(model.prior.precision, np.eye(2 * m)))
    return designs, np.concatenate(y), np.concatenate(sd), np.concatenate(mean), block_diag(*precision)


def assert_close_covariance(found: np.ndarray, expected: np.ndarray, atol: float = 1e-6) -> None:
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(sd, sd), expected / np.outer(sd, sd), atol=atol)


def covariance_of(posterior: Posterior) -> np.ndarray:
    """Of all cameras' unknowns, in order; a posterior keeps roots."""
    if posterior.tied:
        joint = np.concatenate([posterior.root(c) for c in range(len(posterior.models))], axis=1)
        return joint.T @ joint
    return np.asarray(block_diag(*(root.T @ root for root in posterior.alone)))


def of_pixels(designs: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(n, 2, 2) covariance of mean pixels."""
    return np.asarray(np.einsum("nip,pq,njq->nij", designs, covariance, designs, optimize=True))


def unknowns_of(posterior: Posterior) -> np.ndarray:
    """Steps and weights of all cameras, in order."""
    each = [np.concatenate([s, m.weights.T.ravel()]) for s, m in zip(posterior.steps, posterior.models, strict=True)]
    return np.concatenate(each)


def test_exact_positions_give_each_camera_its_own_linear_regression() -> None:
    models, points, camera_views = two_cameras()
    posterior = condition(models, points, camera_views, None)
    assert posterior.joint is None
    for c in range(2):
        designs, y, sd, mean, precision = dense_problem(models[c : c + 1], points, camera_views[c : c + 1])
        expected, covariance, _ = regression(designs[0], y, sd, mean, precision)
        found = np.concatenate([posterior.steps[c], posterior.models[c].weights.T.ravel()])
        np.testing.assert_allclose(
            found / np.sqrt(np.diag(covariance)), expected / np.sqrt(np.diag(covariance)), atol=1e-5
        )
        assert_close_covariance(posterior.alone[c].T @ posterior.alone[c], covariance)
        np.testing.assert_array_equal(posterior.root(c), posterior.alone[c])
        moved = models[c].camera.moved(expected[:14])
        np.testing.assert_allclose(posterior.models[c].camera.as_array(), moved.as_array(), rtol=1e-7, atol=1e-9)


def test_the_evidence_of_a_posterior_is_the_density_of_what_was_seen() -> None:
    found, expected = [], []
    for signal, noise in ((0.5, 0.2), (0.1, 0.4), (2.0, 0.3)):
        models, points, camera_views = two_cameras()
        models = tuple(replace(m, signal=signal, noise=noise) for m in models)
        designs, y, sd, mean, precision = dense_problem(models, points, camera_views)
        found.append(condition(models, points, camera_views, None).evidence)
        expected.append(regression(block_diag(*designs), y, sd, mean, precision)[2])
    assert np.ptp(expected) > 10
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-5)


def test_the_prediction_is_universal_kriging() -> None:
    """With the full kernel matrix and no features: eq. 4 of the design."""
    models, points, camera_views = two_cameras()
    model, seen = models[0], camera_views[0]
    posterior = condition(models, points, camera_views, None)
    at = np.random.default_rng(9).uniform(-1, 1, (20, 3))

    def seen_at(where: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        view = model.camera.view(where)
        return view.uv, view.by_parameters, model.coordinates(view)

    (uv, J, q), (there, J_there, q_there) = seen_at(points[seen.rows]), seen_at(at)
    sd2 = (model.noise * seen.relative) ** 2
    W = np.linalg.inv(model.signal**2 * se(q, q, LENGTHSCALE) + np.diag(sd2))
    K = model.signal**2 * se(q_there, q, LENGTHSCALE)
    off = model.prior.mean - model.camera.parameters
    A = model.prior.precision + sum(J[:, i].T @ W @ J[:, i] for i in range(2))
    S = np.linalg.inv(A)
    step = S @ (model.prior.precision @ off + sum(J[:, i].T @ W @ (seen.uv - uv)[:, i] for i in range(2)))
    mean = there + J_there @ step
    mean += np.stack([K @ W @ (seen.uv[:, i] - uv[:, i] - J[:, i] @ step) for i in range(2)], axis=1)
    R = np.stack([J_there[:, i] - K @ W @ J[:, i] for i in range(2)], axis=1)
    own = model.signal**2 - np.sum((K @ W) * K, axis=1)
    covariance = own[:, None, None] * np.eye(2) + R @ S @ R.swapaxes(1, 2)
    bare = model.rows(at)
    found = there + np.einsum("nip,p->ni", bare.J, posterior.steps[0]) + bare.phi @ posterior.models[0].weights
    spread = of_pixels(design(model, at), posterior.alone[0].T @ posterior.alone[0]) + bare.rest[
        :, None, None
    ] * np.eye(2)
    np.testing.assert_allclose(spread, covariance, rtol=0.01, atol=1e-2 * np.median(own))
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.abs((found - mean) / sd).max() < 0.01
    # the camera moved to the posterior mean differs by the curvature of the lens only
    assert np.abs((posterior.models[0].predict(at)[0] - mean) / sd).max() < 0.5


def declared(points: np.ndarray, shots: int, k: int = 3) -> ShotErrors:
    rng = np.random.default_rng(4)
    shot = np.sort(rng.integers(0, shots, len(points)))
    basis = np.broadcast_to(np.eye(3), (len(points), 3, 3)) if k == 3 else rng.normal(size=(len(points), 3, k))
    return ShotErrors(shot.astype(np.int64), basis, rng.uniform(1e-3, 5e-3, (shots, k)), np.full(k, -1))


def dense_with_shots(
    models: tuple[CameraModel, ...],
    points: np.ndarray,
    camera_views: tuple[CameraViews, ...],
    errors: ShotErrors,
    *,
    density: bool = True,
) -> tuple[np.ndarray, np.ndarray, float]:
    """All cameras and all shots as one linear regression."""
    designs, y, sd, mean, precision = dense_problem(models, points, camera_views)
    shots, k = errors.sd.shape
    by_shot = []
    for model, seen in zip(models, camera_views, strict=True):
        D = model.camera.view(points[seen.rows]).by_point
        wide = np.zeros((len(D), 2, shots, k))
        for i, row in enumerate(seen.rows):
            s = errors.shot[row]
            wide[i, :, s] = D[i] @ (errors.basis[row] * errors.sd[s])
        by_shot.append(wide.reshape(2 * len(D), -1))
    X = np.concatenate([block_diag(*designs), np.concatenate(by_shot)], axis=1)
    extra = shots * k
    return regression(
        X, y, sd, np.concatenate([mean, np.zeros(extra)]), block_diag(precision, np.eye(extra)), density=density
    )


@pytest.mark.parametrize(
    ("shots", "k", "estimated"), [(50, 3, False), (12, 3, False), (5, 6, False), (1, 4, True), (7, 3, True)]
)
def test_positions_that_may_be_off_tie_the_cameras(shots: int, k: int, estimated: bool) -> None:
    models, points, camera_views = two_cameras()
    errors = declared(points, shots, k)
    if estimated:
        errors = replace(errors, group=np.zeros(k, dtype=np.int64))
    mean, covariance, _ = dense_with_shots(models, points, camera_views, errors)
    posterior = condition(models, points, camera_views, errors)
    total = posterior.offsets[-1]
    assert posterior.joint is not None
    sd = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(unknowns_of(posterior) / sd[:total], mean[:total] / sd[:total], atol=1e-4)
    joint, first = covariance_of(posterior), models[0].size
    assert_close_covariance(joint, covariance[:total, :total], 1e-5)
    assert np.abs(joint[:first, first:]).max() > 0
    np.testing.assert_allclose(posterior.root(1).T @ posterior.root(1), joint[first:, first:], rtol=1e-9)
    z = mean[total:].reshape(shots, k)
    displacement = np.stack([errors.basis[i] @ (errors.sd[s] * z[s]) for i, s in enumerate(errors.shot)])
    assert posterior.displacement is not None
    np.testing.assert_allclose(posterior.displacement, displacement, atol=1e-6 * np.abs(displacement).max())
    for c in range(2):
        designs, y, noise, off, precision = dense_problem(models[c : c + 1], points, camera_views[c : c + 1])
        assert_close_covariance(
            posterior.alone[c].T @ posterior.alone[c], regression(designs[0], y, noise, off, precision)[1]
        )
    if not estimated:
        assert posterior.unknowns is None
        return
    assert posterior.unknowns is not None
    np.testing.assert_allclose(posterior.unknowns.mean, mean[total:], atol=1e-5)
    np.testing.assert_allclose(posterior.unknowns.covariance, covariance[total:, total:], atol=1e-6)
    cross = covariance[:total, total:] / sd[:total, None]
    found = posterior.joint.T @ posterior.unknowns.cross
    np.testing.assert_allclose(found / sd[:total, None], cross, atol=1e-5)


@pytest.mark.parametrize("shots", [0, 4])
def test_single_positions_that_are_off_tie_the_cameras(shots: int) -> None:
    """Of themselves, and with shots that are off besides: one dense linear regression."""
    models, points, camera_views = two_cameras()
    rng = np.random.default_rng(5)
    n = len(points)
    scatter = Scatter(rng.normal(size=(3, 3)) * 2e-3, rng.uniform(0.5, 3, n))
    own = ShotErrors(np.arange(n), scatter.root * scatter.size[:, None, None], np.ones((n, 3)), np.full(3, -1))
    errors = replace(declared(points, 1, shots), group=np.zeros(shots, dtype=np.int64)) if shots else None
    designs, y, sd, mean, precision = dense_problem(models, points, camera_views)
    X = [block_diag(*designs)]
    for each in (own, *([errors] * (shots > 0))):
        k = each.basis.shape[2]
        wide = []
        for model, seen in zip(models, camera_views, strict=True):
            D = model.camera.view(points[seen.rows]).by_point @ each.scaled[seen.rows]
            block = np.zeros((len(D), 2, each.count, k))
            block[np.arange(len(D)), :, each.shot[seen.rows]] = D
            wide.append(block.reshape(2 * len(D), -1))
        X.append(np.concatenate(wide))
    design_matrix = np.concatenate(X, axis=1)
    total, extra = len(mean), design_matrix.shape[1] - len(mean)
    found, covariance, density = regression(
        design_matrix, y, sd, np.concatenate([mean, np.zeros(extra)]), block_diag(precision, np.eye(extra))
    )
    posterior = condition_scattered(models, points, camera_views, errors, scatter)
    sds = np.sqrt(np.diag(covariance))[:total]
    assert posterior.joint is None
    assert posterior.ties is not None
    assert len(posterior.ties) < total
    np.testing.assert_allclose(unknowns_of(posterior) / sds, found[:total] / sds, atol=1e-4)
    assert_close_covariance(covariance_of(posterior), covariance[:total, :total], 2e-4)
    z = found[total : total + 3 * n].reshape(n, 3)
    moved_by = np.einsum("nij,nj->ni", own.basis, z)
    if errors is not None:
        moved_by = moved_by + errors.scaled @ found[total + 3 * n :]
        assert posterior.unknowns is not None
        np.testing.assert_allclose(posterior.unknowns.mean, found[total + 3 * n :], atol=1e-4)
        np.testing.assert_allclose(
            posterior.unknowns.covariance, covariance[total + 3 * n :, total + 3 * n :], atol=1e-4
        )
        joint = np.concatenate([posterior.root(c) for c in range(2)], axis=1)
        cross = joint.T @ posterior.unknowns.cross / sds[:, None]
        np.testing.assert_allclose(cross, covariance[:total, total + 3 * n :] / sds[:, None], atol=1e-4)
    assert posterior.displacement is not None
    np.testing.assert_allclose(posterior.displacement, moved_by, atol=1e-5 * np.abs(moved_by).max())
    exact = condition(models, points, camera_views, None)
    expected = density - regression(*_stacked(dense_problem(models, points, camera_views)))[2]
    assert abs(expected) > 5
    assert posterior.evidence - exact.evidence == pytest.approx(expected, abs=1e-2)


def test_more_shots_and_points_than_fit_in_one_piece_of_work() -> None:
    models, few, _ = two_cameras()
    models = tuple(replace(m, field=empty_field(LENGTHSCALE, m.coordinates(m.camera.view(few)), 0.3)) for m in models)
    models = tuple(replace(m, weights=np.zeros((len(m.field.inducing), 2))) for m in models)
    rng = np.random.default_rng(17)
    for n, shots in ((4200, 0), (600, 560)):
        points = rng.uniform(-1, 1, (n, 3))
        seen = []
        for model in models:
            rows = np.flatnonzero(rng.random(n) < 0.98)
            uv = model.camera.pixel(points[rows]) + 0.3 * rng.normal(size=(len(rows), 2))
            seen.append(CameraViews(rows, uv, rng.uniform(0.7, 1.5, len(rows))))
        if shots:
            errors = replace(declared(points, shots), shot=np.arange(n) % shots)
            posterior = condition(models, points, tuple(seen), errors)
            mean, covariance, _ = dense_with_shots(models, points, tuple(seen), errors, density=False)
        else:
            posterior = condition(models, points, tuple(seen), None)
            designs, y, sd, off, precision = dense_problem(models, points, tuple(seen))
            mean, covariance, _ = regression(block_diag(*designs), y, sd, off, precision, density=False)
        total = posterior.offsets[-1]
        assert total < 150
        sds = np.sqrt(np.diag(covariance))[:total]
        np.testing.assert_allclose(unknowns_of(posterior) / sds, mean[:total] / sds, atol=1e-3)
        assert_close_covariance(covariance_of(posterior), covariance[:total, :total], 1e-4)


def test_the_evidence_of_tied_cameras_is_the_density_of_what_was_seen() -> None:
    models, points, camera_views = two_cameras()
    errors = declared(points, 12)
    found, expected = [], []
    for factor in (0.1, 1.0, 10.0):
        scaled = replace(errors, sd=factor * errors.sd)
        found.append(condition(models, points, camera_views, scaled).evidence)
        expected.append(dense_with_shots(models, points, camera_views, scaled)[2])
    found.append(condition(models, points, camera_views, None).evidence)
    expected.append(regression(*_stacked(dense_problem(models, points, camera_views)))[2])
    assert np.ptp(expected) > 5
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-4, atol=1e-3)


def _stacked(
    training: tuple[list[np.ndarray], np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    designs, y, sd, mean, precision = training
    return block_diag(*designs), y, sd, mean, precision


def test_rows_and_predictions_agree_with_each_other_and_with_differences() -> None:
    models, points, camera_views = two_cameras()
    model = condition(models, points, camera_views, None).models[0]
    at = points[:20] * 0.9
    mean, slope = model.predict(at)
    np.testing.assert_allclose(model.rows(at).mean, mean, atol=1e-9)
    expected = numeric(lambda d: model.predict(at + d)[0], np.full(3, 1e-5))
    np.testing.assert_allclose(slope, expected, atol=1e-6 * np.abs(expected).max())
    smooth = np.abs(mean - model.camera.pixel(at)).max()
    rows = replace(model, signal=3.0).rows(4 * at)  # beyond what it has seen its features leave much
    np.testing.assert_allclose(np.sum(rows.phi**2, axis=1) + rows.rest, 9.0)
    assert rows.rest.max() > 1
    assert smooth > 0.05  # there is a field to be differentiated


# fit: one view left out


def converged(models: tuple[CameraModel, ...], points: np.ndarray, camera_views: tuple[CameraViews, ...]) -> Posterior:
    for _ in range(6):
        posterior = condition(models, points, camera_views, None)
        models = posterior.models
    return posterior


def test_leaving_a_view_out_in_closed_form_is_leaving_it_out() -> None:
    models, points, camera_views = two_cameras(proper=False)
    posterior = converged(models, points, camera_views)
    seen, inliers = camera_views[0], np.ones(len(camera_views[0].rows), dtype=np.bool_)
    residual, spread = left_out_residuals(posterior, 0, points, seen, inliers)
    distance = squared_distances(posterior, 0, points, seen, inliers)
    for i in (0, 7, 20, 43):
        without = inliers.copy()
        without[i] = False
        again = condition(posterior.models, points, (seen.select(without), camera_views[1]), None)
        step, weights = again.steps[0], again.models[0].weights
        where = points[seen.rows[[i]]]
        before = replace(posterior.models[0], weights=np.zeros_like(weights))
        bare, sd = before.rows(where), before.noise * seen.relative[i]
        covariance = again.alone[0].T @ again.alone[0]
        expected = of_pixels(design(before, where), covariance)[0] + (sd**2 + bare.rest[0]) * np.eye(2)
        difference = seen.uv[i] - (bare.mean[0] + bare.J[0] @ step + bare.phi[0] @ weights)
        np.testing.assert_allclose(spread[i], expected, rtol=1e-3, atol=1e-3 * expected[0, 0])
        np.testing.assert_allclose(residual[i], difference, atol=1e-3 * np.sqrt(expected[0, 0]))
        assert distance[i] == pytest.approx(difference @ np.linalg.solve(expected, difference), rel=5e-3, abs=1e-4)
        # a view that was not used is simply predicted, by the camera that has moved a little
        unused, its_spread = left_out_residuals(again, 0, points, seen, without)
        predicted = seen.uv[i] - again.models[0].predict(where)[0][0]
        np.testing.assert_allclose(unused[i], predicted, atol=1e-9)
        np.testing.assert_allclose(unused[i], residual[i], atol=0.05 * np.sqrt(expected[0, 0]))
        np.testing.assert_allclose(its_spread[i], expected, rtol=0.05, atol=0.05 * expected[0, 0])


# shots


@pytest.mark.parametrize("size", [1e-2, 1.0, 30.0])
def test_the_update_of_the_shots_sds_maximises_their_posterior(size: float) -> None:
    """The expected log density of the unknowns and the prior of the sd, tried on a grid."""
    rng = np.random.default_rng(6)
    sd = np.column_stack([rng.uniform(1e-3, 3e-3, (5, 2)), rng.uniform(1e-4, 1e-3, (5, 1)), np.full((5, 1), 0.7)])
    errors = ShotErrors(np.zeros(3, dtype=np.int64), np.zeros((3, 3, 4)), sd, np.array([0, 0, 1, -1]))
    mean, variance = size * rng.normal(size=(5, 4)), rng.uniform(0.01, 1, (5, 4))
    updated, label = errors.updated(mean, variance)
    np.testing.assert_array_equal(updated.sd[:, 3], 0.7)  # declared sds stay
    np.testing.assert_array_equal(label[:, 3], 0.7)
    for columns in ([0, 1], [2]):
        new = updated.sd[:, columns]
        assert np.ptp(new) == 0
        second = ((mean**2 + variance) * sd**2)[:, columns]
        u = np.log(new[0, 0]) + np.linspace(-2, 2, 400001)
        objective = (
            -second.size * u
            - 0.5 * second.sum() * np.exp(-2 * u)
            - 0.5 * ((u - SHOT_SD_PRIOR[0]) / SHOT_SD_PRIOR[1]) ** 2
        )
        assert np.exp(u[np.argmax(objective)]) == pytest.approx(new[0, 0], rel=2e-5)
        told = np.sum(1 - variance[:, columns])
        np.testing.assert_allclose(label[:, columns], new * np.exp(1 / (2 * told + 1 / SHOT_SD_PRIOR[1] ** 2)))


def plates(
    count: int = 7, corners: int = 5, seed: int = 2, step: float = 0.4
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points on plates along a slanted traverse, their shots, the traverse, and where along it each plate is."""
    turn = rotation(seed)
    t = step * (np.arange(count) - (count - 1) / 2) + 0.01 * np.random.default_rng(seed).normal(size=count)
    y, x = np.meshgrid(np.linspace(-0.8, 0.8, corners), np.linspace(-1, 1, corners), indexing="ij")
    plate = np.column_stack([x.ravel(), y.ravel(), np.zeros(corners**2)])
    points = np.concatenate([plate + np.array([0, 0, z]) for z in t]) @ turn.T
    return points, np.repeat([f"shot{i}" for i in range(count)], corners**2), turn[:, 2], t


def test_a_shot_is_displaced_as_a_rigid_body() -> None:
    points, labels, _, _ = plates()
    shots = Shots.of(points, labels)
    assert shots is not None
    errors = shots.errors(points)
    k = errors.basis.shape[2]
    assert errors.estimated
    assert k == 6 * (7 - WORLD_POLYNOMIAL_TERMS)
    every = []
    for s in range(7):
        members = labels == f"shot{s}"
        X, d = points[members] - points[members].mean(axis=0), errors.basis[members]
        rigid = np.concatenate([np.broadcast_to(np.eye(3), (len(X), 3, 3)), -cross_matrices(X)], axis=2).reshape(-1, 6)
        motion, *_ = np.linalg.lstsq(rigid, d.reshape(-1, k), rcond=None)
        np.testing.assert_allclose(rigid @ motion, d.reshape(-1, k), atol=1e-12)
        every.append(motion)
    assert np.linalg.matrix_rank(np.concatenate(every)) == k  # each pattern is another one


def cross_matrices(v: np.ndarray) -> np.ndarray:
    """(n, 3, 3) such that `matrix @ w = v x w`."""
    return np.stack([np.cross(v, e) for e in np.eye(3)], axis=2)


def test_what_is_smooth_along_the_traverse_is_no_error_of_a_shot() -> None:
    points, labels, along, t = plates()
    shots = Shots.of(points, labels)
    assert shots is not None
    np.testing.assert_allclose(np.abs(shots.along[0] @ along), 1, atol=1e-9)
    basis = shots.errors(points).basis.reshape(-1, shots.errors(points).basis.shape[2])
    rng = np.random.default_rng(3)
    for degree in range(5):
        coefficients = rng.normal(size=3)
        shift = (t**degree)[np.repeat(np.arange(7), 25), None] * coefficients
        smooth = sum(np.linalg.lstsq(basis, shift.reshape(-1, 1), rcond=None)[1].tolist())
        represented = 1 - smooth / np.sum(shift**2)
        if degree < WORLD_POLYNOMIAL_TERMS:
            np.testing.assert_allclose(basis.T @ shift.ravel(), 0, atol=1e-9)
            assert abs(represented) < 1e-9
        else:
            assert represented > 0.01


def test_the_sds_of_shots_belong_to_three_kinds_of_error() -> None:
    points, labels, along, _ = plates()
    shots = Shots.of(points, labels)
    assert shots is not None
    errors = shots.errors(points)
    means = np.stack([errors.basis[labels == f"shot{s}"].mean(axis=0) for s in range(7)])  # (S, 3, k)
    by_along = np.abs(np.einsum("sik,i->sk", means, along)).max(axis=0)
    size = np.linalg.norm(means, axis=1).max(axis=0)
    np.testing.assert_allclose(by_along[errors.group == 0], size[errors.group == 0], rtol=1e-9)
    assert by_along[errors.group == 1].max() < 1e-9
    assert size[errors.group == 2].max() < 1e-9  # tilts leave the middle where it is
    assert size[errors.group < 2].min() > 0.05


def test_shots_too_few_or_too_small_are_taken_as_they_are() -> None:
    points, labels, _, _ = plates()
    assert Shots.of(points[:75], labels[:75]) is None  # three plates: a parabola explains all of it
    assert Shots.of(points[:100], labels[:100]) is not None
    small = np.isin(np.arange(len(points)) % 25, [0, 4, 12, 20, 24])
    assert Shots.of(points[small], labels[small]) is None
    assert Shots.of(points, np.array([f"p{i}" for i in range(len(points))])) is None
    assert Shots.of(np.tile(points[:25], (7, 1)), labels) is None  # all at the same place


def test_the_label_at_a_shot_is_known_and_far_away_it_is_not() -> None:
    points, labels, _, _ = plates()
    shots = Shots.of(points, labels)
    assert shots is not None
    errors = shots.errors(points)
    sd = np.repeat([3e-3, 1e-3, 1e-3, 5e-4, 5e-4, 5e-4], 7 - WORLD_POLYNOMIAL_TERMS)
    known, left = shots.labels(points, sd)
    np.testing.assert_allclose(known, errors.basis * sd, atol=1e-12)
    np.testing.assert_allclose(left, 0, atol=1e-15)
    shift_only = np.where(np.repeat(np.arange(6) < 3, 7 - WORLD_POLYNOMIAL_TERMS), 2e-3, 0.0)
    known, left = shots.labels(points[:5] + 50 * shots.along[0], shift_only)
    np.testing.assert_allclose(known, 0, atol=1e-15)
    np.testing.assert_allclose(left, np.broadcast_to(4e-6 * np.eye(3), (5, 3, 3)), atol=1e-12)
    between = 0.5 * (points[:25] + points[25:50])
    _, left = shots.labels(between, shift_only)
    share = np.diagonal(left, axis1=1, axis2=2) / 4e-6
    assert (share > 0.5).all()  # halfway a label says little
    assert (share < 1).all()


def test_the_unknown_part_of_a_label_turns_with_the_world() -> None:
    points, labels, along, _ = plates(seed=2)
    shots = Shots.of(points, labels)
    assert shots is not None
    sd = np.repeat([3e-3, 1e-3, 1e-3, 0, 0, 0], 7 - WORLD_POLYNOMIAL_TERMS)
    _, left = shots.labels(points[:1] + 50 * along, sd)
    expected = 9e-6 * np.outer(along, along) + 1e-6 * (np.eye(3) - np.outer(along, along))
    np.testing.assert_allclose(left[0], expected, atol=1e-12)


def test_the_unknown_tilt_of_a_label_turns_with_the_world() -> None:
    points, labels, along, _ = plates()
    turn, sd = rotation(12), np.repeat([0, 0, 0, 1e-3, 1e-3, 1e-3], 7 - WORLD_POLYNOMIAL_TERMS)
    at = points[::10] + 5 * along
    a, b = Shots.of(points, labels), Shots.of(points @ turn.T, labels)
    assert a is not None
    assert b is not None
    np.testing.assert_allclose(turn.T @ b.labels(at @ turn.T, sd)[1] @ turn, a.labels(at, sd)[1], atol=1e-9)


# the whole method


@cache
def rig(cameras: str = "2R2W") -> Rig:
    return build_rig("bar6", seed=3, frame="random", cameras=cameras)


@cache
def known(n: int = 50) -> Dataset:
    return simulate(rig(), random_positions(rig(), n, np.random.default_rng(11)), seed=12)


@cache
def others(n: int = 60) -> Dataset:
    data = simulate(rig(), random_positions(rig(), n, np.random.default_rng(13)), seed=14)
    return data.select(data.observations.seen.all(axis=1))


@cache
def fitted() -> ForwardGPCalibration:
    return ForwardGP().fit(known())


def with_views(data: Dataset, change: Callable[[np.ndarray, np.ndarray], None], extra: bool = False) -> Dataset:
    """The same data with other pixels and sds: `change` writes into both."""
    o = data.observations
    uv, sd = o.uv.copy(), o.sd.copy()
    change(uv, sd)
    return replace(data, observations=Observations(o.points, o.cameras, uv, sd, o.extra if extra else {}))


def with_positions(data: Dataset, xyz: np.ndarray | None = None, sd: np.ndarray | float | None = None) -> Dataset:
    old = data.positions
    new = old.sd if sd is None else np.broadcast_to(sd, old.xyz.shape).copy()
    return replace(data, known=KnownPositions(old.shots, old.xyz if xyz is None else xyz, new))


def truth(data: Dataset) -> np.ndarray:
    assert data.truth is not None
    return data.truth.xyz


def in_sds(measured: Measurement, xyz: np.ndarray) -> np.ndarray:
    return np.asarray(np.abs(measured.xyz - xyz) / measured.sd)


def joint_covariance(posterior: Posterior, x: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """(2C, 2C) of all views of one point, from the design of each camera, dense."""
    wide = block_diag(*(design(model, x[None])[0] for model in posterior.models))
    covariance = covariance_of(posterior)
    own = [n**2 + float(model.rows(x[None]).rest[0]) for n, model in zip(noise, posterior.models, strict=True)]
    return np.asarray(wide @ covariance @ wide.T + np.diag(np.repeat(own, 2)))


@cache
def declared_fit() -> ForwardGPCalibration:
    data = simulate(rig(), random_positions(rig(), 40, np.random.default_rng(15)), seed=16, robot_noise=0.2)
    return ForwardGP().fit(data)


def coarse(posterior: Posterior) -> Posterior:
    """With three features per field, so that these leave much of it."""
    models, roots = [], []
    for model, root in zip(posterior.models, posterior.alone, strict=True):
        p, m = model.camera.size, len(model.field.inducing)
        field = LowRank(model.field.kernel, model.field.inducing[:3])
        models.append(replace(model, field=field, weights=model.weights[:3], signal=3 * model.noise))
        roots.append(root[:, [*range(p + 3), *range(p + m, p + m + 3)]])
    return replace(posterior, models=tuple(models), alone=tuple(roots))


@cache
def dots_fit() -> ForwardGPCalibration:
    """Known positions that are off by 0.15 mm each, which nothing says."""
    xyz = known().xyz + 0.15 * rig().units_per_mm * np.random.default_rng(18).normal(size=known().xyz.shape)
    return ForwardGP().fit(with_positions(known(), xyz, np.nan))


@pytest.mark.parametrize("kind", ["independent cameras", "tied cameras", "dots off", "coarse fields"])
def test_the_position_is_the_most_probable_one(kind: str) -> None:
    """Another optimiser, and finite differences for the covariance."""
    calibration = {"tied cameras": declared_fit, "dots off": dots_fit}.get(kind, fitted)()
    posterior, frame = calibration.posterior, calibration.frame
    assert (posterior.joint is not None) == (kind == "tied cameras")
    posterior = coarse(posterior) if kind == "coarse fields" else posterior
    inside, volume, names = others().select(np.arange(4)), rig().volume, np.array(["behind", "far behind"])
    deeper = volume.world_from_box.apply(np.array([[0.2, 0.1, 1.3], [-0.3, 0.0, 1.8]]) * volume.size)
    data = join(inside, simulate(rig(), Target("deeper", names, names, deeper), seed=1))
    assert data.observations.seen.all()
    noise = np.array([[model.noise * (1 + 0.5 * i) for i, model in enumerate(posterior.models)]] * 6)
    found = locate(posterior, data.observations.uv, noise)
    for i in range(6):
        root = np.linalg.inv(np.linalg.cholesky(joint_covariance(posterior, found.xyz[i], noise[i])))

        def residuals(x: np.ndarray, i: int = i, root: np.ndarray = root) -> np.ndarray:
            pixels = np.concatenate([model.predict(x[None])[0][0] for model in posterior.models])
            return np.asarray(root @ (data.observations.uv[i].ravel() - pixels))

        best = least_squares(residuals, frame.to_working(truth(data)[i]), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        sd = np.sqrt(np.diag(found.cov[i]))
        assert np.abs((best.x - found.xyz[i]) / sd).max() < 2e-3
        J = numeric(lambda d: residuals(best.x + d), np.full(3, 1e-5))  # noqa: B023
        np.testing.assert_allclose(found.cov[i], np.linalg.inv(J.T @ J), rtol=2e-3, atol=1e-4 * sd.min() ** 2)
        assert found.p[i] == pytest.approx(float(chi2.sf(2 * best.cost, 5)), rel=0.01)


def test_a_point_takes_two_views() -> None:
    data = others().select(np.arange(6))

    def hide(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[0, 1:] = uv[1, 2:] = uv[2, 3:] = uv[3] = np.nan

    measured = fitted().measure(with_views(data, hide).observations)
    names = data.observations.camera_names
    assert measured.reason[0] == f"only {names[0]} saw it; a position takes two cameras"
    assert measured.reason[3] == "no camera saw it"
    np.testing.assert_array_equal(measured.measured, [False, True, True, False, True, True])
    np.testing.assert_array_equal(measured.views, [1, 2, 3, 0, 4, 4])
    assert in_sds(measured, truth(data))[measured.measured].max() < 4.5
    np.testing.assert_array_equal(np.isnan(measured.consistency), [True, False, False, True, False, False])
    whole = fitted().measure(data.observations)
    assert (measured.sd[1] > whole.sd[1]).all()  # fewer views tell less
    assert (measured.sd[2] > whole.sd[2]).all()
    np.testing.assert_allclose(measured.xyz[4:], whole.xyz[4:], rtol=1e-9)


@pytest.mark.parametrize("bad", range(4))
def test_one_grossly_wrong_view_is_left_out_and_named(bad: int) -> None:
    data, name = others().select(np.arange(15)), rig().cameras[bad].name
    direction = np.random.default_rng(bad).choice([-25.0, 25.0], (15, 2))

    def spoil(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[:, bad] += direction

    def hide(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[:, bad] = np.nan

    spoilt = fitted().measure(with_views(data, spoil).observations)
    without = fitted().measure(with_views(data, hide).observations)
    told = without.consistency > 0.01  # else the others are not of one mind either
    assert told.sum() >= 12
    assert set(spoilt.own_reason[told].tolist()) == {f"measured without {name}, whose view contradicts the others"}
    assert (spoilt.views[told] == 3).all()
    np.testing.assert_allclose(spoilt.xyz[told], without.xyz[told], rtol=1e-9)
    np.testing.assert_allclose(spoilt.cov[told], without.cov[told], rtol=1e-6)
    np.testing.assert_allclose(spoilt.consistency[told], without.consistency[told], rtol=1e-5)


def test_two_wrong_views_among_six_are_left_out() -> None:
    six = rig("2R4W")
    calibration = ForwardGP().fit(simulate(six, random_positions(six, 50, np.random.default_rng(11)), seed=12))
    data = simulate(six, random_positions(six, 60, np.random.default_rng(13)), seed=14)
    data = data.select(np.flatnonzero(data.observations.seen.all(axis=1))[:12])

    def spoil(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[:, 1] += [20.0, -30.0]
        uv[:, 4] += [-25.0, 35.0]

    def hide(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[:, [1, 4]] = np.nan

    spoilt = calibration.measure(with_views(data, spoil).observations)
    without = calibration.measure(with_views(data, hide).observations)
    told = without.consistency > 0.01
    assert told.sum() >= 9
    why = "measured without cam2 and cam5, whose view contradicts the others"
    assert set(spoilt.own_reason[told].tolist()) == {why}
    assert (spoilt.views[told] == 4).all()
    np.testing.assert_allclose(spoilt.xyz[told], without.xyz[told], rtol=1e-9)


def test_a_point_is_measured_the_same_among_thousands() -> None:
    few = others().observations.select(np.arange(40))
    times = 110  # beyond one piece of work
    names = np.array([f"p{i}" for i in range(40 * times)])
    many = Observations(names, few.cameras, np.tile(few.uv, (times, 1, 1)), np.tile(few.sd, (times, 1, 1)))
    a, b = fitted().measure(few), fitted().measure(many)
    np.testing.assert_allclose(b.xyz, np.tile(a.xyz, (times, 1)), rtol=1e-9)
    np.testing.assert_allclose(b.cov, np.tile(a.cov, (times, 1, 1)), rtol=1e-6, atol=1e-9)


def test_two_views_that_contradict_each_other_give_no_position() -> None:
    data = others().with_cameras(["cam2", "cam3"]).select(np.arange(10))

    def spoil(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[::2, 0, 1] += 40  # across the epipolar lines, for the cameras sit side by side

    measured = fitted().measure(with_views(data, spoil).observations)
    np.testing.assert_array_equal(measured.measured, np.arange(10) % 2 == 1)
    assert (measured.consistency[::2] < 1e-10).all()
    assert np.isnan(measured.cov[::2]).all()
    assert all("contradict each other" in why for why in measured.reason[::2])
    assert (measured.reason[1::2] == "").all()


def test_views_that_agree_have_uniform_p_values_and_honest_error_bars() -> None:
    calibration = ForwardGP().fit(known(120))
    data = simulate(rig(), random_positions(rig(), 450, np.random.default_rng(21)), seed=22)
    measured = calibration.measure(data.observations)
    for views in (2, 3, 4):
        some = data.observations.seen.sum(axis=1) == views
        if some.sum() > 50:
            assert kstest(measured.consistency[some], "uniform").pvalue > 1e-3
    ok = measured.measured
    assert ok.sum() >= 400
    error = (measured.xyz - truth(data))[ok]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(measured.cov[ok]), error)
    assert 2.4 < nees.mean() < 3.8
    assert 0.91 < np.mean(nees < chi2.ppf(0.95, 3)) < 0.98


def test_a_fifth_of_wrong_detections_is_found_out() -> None:
    data = simulate(rig(), random_positions(rig(), 100, np.random.default_rng(31)), seed=32, outliers=0.2)
    calibration = ForwardGP().fit(data)
    o = data.observations
    true = np.stack([_numbers(o.extra[column]) for column in ("true_u", "true_v")], axis=2)
    off = np.linalg.norm(o.uv - true, axis=2)
    wrong = (o.extra["outlier"] == "1") & (off > 5)  # chance puts few nearer
    row, column = ({str(name): i for i, name in enumerate(names)} for names in (data.points, o.camera_names))
    rejected = np.zeros(wrong.shape, dtype=np.bool_)
    for view in calibration.rejected:
        i, c = row[view.point], column[view.camera]
        rejected[i, c] = True
        assert view.residual == pytest.approx(off[i, c], abs=1.5)
    assert wrong.sum() > 50
    assert rejected[wrong].all()
    good = o.extra["outlier"] == "0"
    assert rejected[good].sum() <= 0.01 * good.sum()
    residuals = [view.residual for view in calibration.rejected]
    assert residuals == sorted(residuals, reverse=True)
    assert calibration.residuals()["views_rejected"] == len(residuals)
    (note,) = (note for note in calibration.notes() if "contradict" in note)
    assert note.startswith(f"{len(residuals)} of {o.seen.sum()} views contradict the others")
    measured, clean = calibration.measure(others().observations), fitted().measure(others().observations)
    assert in_sds(measured, truth(others())).max() < 5
    assert np.median(measured.sd / clean.sd) < 1.3


def test_a_fifth_of_wrong_detections_does_not_break_a_fit_without_a_lens() -> None:
    for seed in range(3):
        target = random_positions(rig(), 60, np.random.default_rng(seed))
        calibration = ForwardGP(lens="none").fit(simulate(rig(), target, seed=seed, outliers=0.2))
        error = calibration.measure(others().observations).xyz - truth(others())
        assert np.nanmedian(np.abs(error)) < 2


def test_nothing_but_wrong_detections_is_refused_with_a_reason() -> None:
    for seed in range(2):
        target = random_positions(rig(), 60, np.random.default_rng(seed))
        with pytest.raises(FitError):
            ForwardGP().fit(simulate(rig(), target, seed=seed, outliers=1.0))


def _numbers(text: np.ndarray) -> np.ndarray:
    return np.where(text == "", "nan", text).astype(np.float64)


def test_a_known_position_that_is_wrong_is_told_from_wrong_images() -> None:
    data, xyz = known(), known().xyz.copy()
    full = int(np.flatnonzero(data.observations.seen.all(axis=1))[5])
    xyz[full] += [15.0, -10.0, 12.0]
    calibration = ForwardGP().fit(with_positions(data, xyz))
    assert {view.point for view in calibration.rejected} == {str(data.points[full])}
    assert any(f"Most views of {data.points[full]} " in note for note in calibration.notes())
    assert [unused.point for unused in calibration.unused] == [str(data.points[full])]
    measured = calibration.measure(data.observations.select([full]))
    assert in_sds(measured, truth(data)[[full]]).max() < 4.5


def in_one_plane(data: Dataset, chosen: np.ndarray) -> Dataset:
    """The chosen points moved into the plane that fits them best, as the rig would see them there."""
    xyz = data.xyz.copy()
    off = xyz[chosen] - xyz[chosen].mean(axis=0)
    normal = np.linalg.svd(off)[2][2]
    xyz[chosen] -= (off @ normal)[:, None] * normal
    uv = np.stack([camera.pixel_from_world(xyz)[0] for camera in rig().cameras], axis=1)
    uv += 0.2 * np.random.default_rng(51).normal(size=uv.shape)
    o = data.observations
    uv = np.where(o.seen[..., None], uv, np.nan)
    return replace(with_positions(data, xyz), observations=Observations(o.points, o.cameras, uv, o.sd))


@pytest.mark.parametrize("saw", ["five points", "one plane"])
def test_a_camera_that_saw_too_little_is_named_and_the_rest_calibrates(saw: str) -> None:
    data, names = known(), known().observations.camera_names
    few = np.zeros(len(data), dtype=np.bool_)
    if saw == "five points":
        few[np.flatnonzero(data.observations.seen[:, 1])[:5]] = True
    else:
        few[np.argsort(np.abs((data.xyz - data.xyz.mean(axis=0)) @ [0.3, 0.2, 0.9]))[:15]] = True
        data = in_one_plane(data, few)

    def hide(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[~few, 1] = np.nan

    calibration = ForwardGP().fit(with_views(data, hide))
    assert calibration.camera_names == tuple(name for name in names if name != names[1])
    assert any(note.startswith(f"{names[1]} is not calibrated") for note in calibration.notes())
    measured = calibration.measure(others().observations)
    assert (measured.views == 3).all()
    assert in_sds(measured, truth(others())).max() < 5

    def only_that_one(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[3:, [0, 2, 3]] = np.nan

    measured = calibration.measure(with_views(others(), only_that_one).observations)
    assert set(measured.reason[3:].tolist()) == {"no calibrated camera saw it"}
    assert measured.measured[:3].all()


def test_nothing_measurable_among_several_points_is_an_answer_too() -> None:
    data = others().select(np.arange(3))

    def hide(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[:, 1:] = np.nan

    measured = fitted().measure(with_views(data, hide).observations)
    assert set(measured.reason.tolist()) == {"only cam2 saw it; a position takes two cameras"}


@pytest.mark.parametrize("shape", ["plane", "line"])
def test_points_without_depth_are_refused(shape: str) -> None:
    volume = rig().volume
    parts = np.random.default_rng(5).uniform(-0.5, 0.5, (40, 3))
    parts[:, 2] = 0.4 * parts[:, 0] - 0.3 * parts[:, 1]
    if shape == "line":
        parts = parts[:, :1] * [0.9, 0.5, 0.7]
    names = np.array([f"p{i}" for i in range(40)])
    target = Target(shape, names, names, volume.world_from_box.apply(parts * volume.size))
    with pytest.raises(FitError, match=f"the 40 known points lie on one {shape}"):
        ForwardGP().fit(simulate(rig(), target, seed=1))


def test_one_camera_is_not_enough() -> None:
    with pytest.raises(FitError, match="1 of 1 cameras can be calibrated; a position takes two"):
        ForwardGP().fit(known().with_cameras(["cam2"]))


def test_image_sizes_need_not_be_known() -> None:
    def unsized(data: Dataset) -> Dataset:
        cameras = tuple(Camera(camera.name, None, None) for camera in data.cameras)
        return replace(data, observations=replace(data.observations, cameras=cameras))

    measured = ForwardGP().fit(unsized(known())).measure(unsized(others()).observations)
    assert measured.measured.all()
    error = measured.xyz - truth(others())
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(measured.cov), error)
    assert nees.mean() < 5
    assert np.median(measured.sd / fitted().measure(others().observations).sd) < 1.3


def test_a_view_stated_as_worse_weighs_less() -> None:
    data = others().select(np.arange(20))
    shift = np.zeros_like(data.observations.uv)
    shift[:, 1] = 0.3

    def worse(uv: np.ndarray, sd: np.ndarray) -> None:
        sd[:, 1] *= 10

    def measured(data: Dataset, by: float) -> Measurement:
        def moved(uv: np.ndarray, sd: np.ndarray) -> None:
            uv += by * shift

        return fitted().measure(with_views(data, moved).observations)

    weak = with_views(data, worse)
    a, b = measured(data, 0.0), measured(weak, 0.0)
    increase = np.linalg.eigvalsh(b.cov - a.cov)
    assert (increase.min(axis=1) > -2e-3 * increase.max(axis=1)).all()  # nothing is known better
    assert (np.linalg.det(b.cov) > 1.3 * np.linalg.det(a.cov)).all()
    pull = np.linalg.norm(measured(data, 1.0).xyz - a.xyz, axis=1)
    assert (np.linalg.norm(measured(weak, 1.0).xyz - b.xyz, axis=1) < 0.1 * pull).all()


def test_a_known_view_stated_as_worse_weighs_less_in_the_fit() -> None:
    rng = np.random.default_rng(41)
    bad = rng.random(known().observations.seen.shape) < 0.3
    noise = 2.0 * rng.normal(size=known().observations.uv.shape)

    def spoil(uv: np.ndarray, sd: np.ndarray) -> None:
        uv[bad] += noise[bad]

    def say(uv: np.ndarray, sd: np.ndarray) -> None:
        sd[bad] = 2.0

    spoilt = with_views(known(), spoil)
    told = ForwardGP().fit(with_views(spoilt, say))
    assert len(told.rejected) <= 2
    measured = told.measure(others().observations)
    assert in_sds(measured, truth(others())).max() < 5
    noise_px = told.residuals()["noise_px"]
    assert all(0.14 < value < 0.28 for value in noise_px.values())  # 0.2 px, of a usual view


def test_declared_noise_of_the_known_positions_widens_the_error_bars() -> None:
    exact = fitted().measure(others().observations)
    unsure = ForwardGP().fit(with_positions(known(), sd=0.5))
    measured = unsure.measure(others().observations)
    assert unsure.posterior.joint is not None
    assert np.median(measured.sd / exact.sd) > 1.1
    widening = np.linalg.det(measured.cov) / np.linalg.det(exact.cov)
    assert np.mean(widening > 1) > 0.95


def test_an_error_that_all_known_positions_share_is_in_every_measurement() -> None:
    """One shot: no camera can tell where it really was, so its declared variance is added to every position's."""
    declared_sd = np.array([0.8, 0.1, 0.4])
    positions = known().positions
    one = KnownPositions(np.full(len(known()), "all"), positions.xyz, np.tile(declared_sd, (len(known()), 1)))
    measured = ForwardGP().fit(replace(known(), known=one)).measure(others().observations)
    exact = fitted().measure(others().observations)
    added = measured.cov - exact.cov
    np.testing.assert_allclose(added, np.broadcast_to(np.diag(declared_sd**2), added.shape), atol=0.02 * 0.8**2)
    assert in_sds(measured, exact.xyz).max() < 0.1


def test_error_bars_stay_honest_with_a_noisy_robot() -> None:
    nees = []
    for seed in range(3):
        data = simulate(
            rig(), random_positions(rig(), 40, np.random.default_rng([seed, 1])), seed=seed + 50, robot_noise=0.4
        )
        measured = ForwardGP().fit(data).measure(others().observations)
        error = measured.xyz - truth(others())
        nees.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(measured.cov), error).mean())
    assert 1 < np.mean(nees) < 5.5


def test_an_answer_turns_with_the_world() -> None:
    turn = rotation(8)
    calibration = ForwardGP().fit(with_positions(known(), known().xyz @ turn.T))
    a, b = fitted().measure(others().observations), calibration.measure(others().observations)
    assert (np.abs(b.xyz @ turn - a.xyz) / a.sd).max() < 0.02
    back = turn.T @ b.cov @ turn
    scale = a.sd[:, :, None] * a.sd[:, None, :]
    assert (np.abs(back - a.cov) / scale).max() < 0.02


@pytest.mark.parametrize("cameras", [["cam2", "cam3"], ["cam2", "cam3", "cam4", "cam5"]])
def test_any_match_gives_a_sound_number_or_a_reason(cameras: list[str]) -> None:
    """Random pixels, parallel and diverging lines of sight, and the corners of the images."""
    rng = np.random.default_rng(61)
    n, C = 300, len(cameras)
    uv = rng.uniform(0, [1279, 799], (n, C, 2))
    uv[:100] = uv[:100, :1] + rng.normal(scale=0.5, size=(100, C, 2))  # the same pixel: far away, or behind
    uv[100:150, :, 1] = 400 + rng.normal(scale=2, size=(50, C))  # along the bar: meet anywhere on a line, or behind
    uv[150:160] = rng.choice([0, 1], (10, C, 2)) * [1279.0, 799.0]
    uv = np.clip(uv, 0, [1279, 799])
    names = np.array([f"p{i}" for i in range(n)])
    sized = tuple(Camera(name, 1280, 800) for name in cameras)
    measured = fitted().measure(Observations(names, sized, uv, np.full(uv.shape, np.nan)))
    ok = measured.measured
    np.testing.assert_array_equal(ok, np.isfinite(measured.xyz).all(axis=1))
    np.testing.assert_array_equal(ok, np.isfinite(measured.cov).all(axis=(1, 2)))
    assert not np.isinf(measured.cov).any()
    assert (measured.reason[~ok] != "").all()
    assert (~ok).sum() > 50
    assert (np.linalg.eigvalsh(measured.cov[ok])[:, 0] > 0).all()


# files


@cache
def board_fit() -> tuple[ForwardGPCalibration, float]:
    """A moving board whose fourth position is labelled 1 mm too far along the slide."""
    two = rig("2R")
    data = simulate(two, moving_board(two, corners=(4, 5), positions=7, step=30.0, square=25.0), seed=71)
    xyz = data.xyz.copy()
    moved = 1.0
    xyz[data.shots == "board04"] += moved * two.volume.world_from_box.rotation[:, 2]
    return ForwardGP().fit(with_positions(data, xyz)), moved


def test_a_shot_that_is_off_is_found_and_noted() -> None:
    calibration, moved = board_fit()
    displacement = calibration.posterior.displacement
    assert displacement is not None
    of_shot = displacement[calibration.data.shots == "board04"].mean(axis=0) * calibration.frame.scale
    axis = rig("2R").volume.world_from_box.rotation[:, 2]
    # of a shift of the middle one of seven a parabola hides a third: sum of the smooth patterns' squares there
    t = np.linspace(-1, 1, 7)
    q, _ = np.linalg.qr(np.vander(t, 3))
    assert of_shot @ axis == pytest.approx(-moved * (1 - np.sum(q[3] ** 2)), abs=0.15)
    assert np.linalg.norm(of_shot - (of_shot @ axis) * axis) < 0.1
    assert any("The shots contradict each other" in note for note in calibration.notes())
    assert not calibration.rejected


def test_between_shots_that_contradict_the_error_bars_are_wider() -> None:
    calibration, _ = board_fit()
    two = rig("2R")
    target = moving_board(two, corners=(4, 5), positions=13, step=15.0, square=25.0)  # every other one is between
    data = simulate(two, target, seed=72)
    measured = calibration.measure(data.observations)
    axis = two.volume.world_from_box.rotation[:, 2]
    number = np.array([int(shot[5:7]) for shot in data.shots])
    inside = (number > 2) & (number < 12)

    def wider(cov: np.ndarray) -> float:
        sd = np.sqrt(np.einsum("i,nij,j->n", axis, cov, axis))
        return float(sd[inside & (number % 2 == 0)].mean() / sd[inside & (number % 2 == 1)].mean())

    assert wider(measured.cov) > 1.15  # what the world is there: the parabola of its shots
    # whoever judges by a known position there must add its own error
    assert wider(measured.cov + calibration.known_position_covariance(data.xyz)) > 1.3


@cache
def unlensed_fit() -> ForwardGPCalibration:
    return ForwardGP(lens="none").fit(known())


def test_positions_are_measured_in_the_world_as_labelled() -> None:
    calibration, moved = board_fit()
    data = calibration.data
    measured = calibration.measure(data.observations)
    axis = rig("2R").volume.world_from_box.rotation[:, 2]
    off = (measured.xyz - data.xyz) @ axis
    for shot in np.unique(data.shots):
        assert abs(off[data.shots == shot].mean()) < 0.15 * moved


def test_the_covariance_of_a_labelled_position_is_that_of_a_difference() -> None:
    """Of a position and of the error of a label, whose uncertainties the cameras tie together: dense matrices."""
    calibration, _ = board_fit()
    posterior, labels = calibration.posterior, calibration._labels
    assert labels is not None
    assert posterior.joint is not None
    some = np.arange(0, 140, 23)
    uv = calibration.data.observations.uv[some]
    noise = np.array([[model.noise for model in posterior.models]] * len(some))
    bare, labelled = locate(posterior, uv, noise), locate(posterior, uv, noise, labels)
    assert labels.unknowns is not None
    known, unknown = labels.shots.labels(bare.xyz, labels.sd)[0], labels.world(bare.xyz)
    np.testing.assert_allclose(labelled.xyz, bare.xyz - known @ labels.unknowns.mean, atol=1e-12)
    cross = posterior.joint.T @ labels.unknowns.cross
    for i, x in enumerate(bare.xyz):

        def pixels(d: np.ndarray, x: np.ndarray = x) -> np.ndarray:
            return np.concatenate([model.predict((x + d)[None])[0][0] for model in posterior.models])

        D, wide = numeric(pixels, np.full(3, 1e-5)), block_diag(*(design(m, x[None])[0] for m in posterior.models))
        gain = bare.cov[i] @ D.T @ np.linalg.inv(joint_covariance(posterior, x, noise[i]))
        tied = gain @ wide @ cross @ known[i].T
        own = known[i] @ labels.unknowns.covariance @ known[i].T
        expected = own + tied + tied.T + unknown[i]
        assert np.abs(tied).max() > 1e-3 * np.abs(own).max()  # small here, so it is compared for itself
        np.testing.assert_allclose(labelled.cov[i] - bare.cov[i], expected, atol=0.05 * np.abs(tied).max())


SAVED: dict[str, Callable[[], ForwardGPCalibration]] = {
    "exact positions": fitted,
    "declared noise": declared_fit,
    "estimated shots": lambda: board_fit()[0],
    "dots off": lambda: dots_fit(),
    "no lens": lambda: unlensed_fit(),
}
every_saved = pytest.mark.parametrize("kind", SAVED)


@every_saved
def test_a_saved_calibration_measures_the_same_bits(kind: str, tmp_path: Path) -> None:
    calibration = SAVED[kind]()
    calibration.save(tmp_path / "rig.implicam")
    loaded = load_calibration(tmp_path / "rig.implicam")
    assert isinstance(loaded, ForwardGPCalibration)
    observations = calibration.data.observations.select(np.arange(0, len(calibration.data), 3))
    a, b = calibration.measure(observations), loaded.measure(observations)
    assert a.measured.any()
    for name in ("xyz", "cov", "views", "consistency", "reason"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    exact = ("exact positions", "no lens")
    missing = {"joint": (*exact, "dots off"), "displacement": exact}
    missing["ties"] = tuple(name for name in SAVED if name != "dots off")
    for name in ("joint", "displacement", "ties"):
        x, y = getattr(calibration.posterior, name), getattr(loaded.posterior, name)
        assert (x is None) == (y is None) == (kind in missing[name])
        if x is not None:
            np.testing.assert_array_equal(x, y)
    assert (loaded.posterior.unknowns is not None) == (kind == "estimated shots")
    assert loaded.notes() == calibration.notes()
    assert loaded.residuals() == calibration.residuals()
    assert loaded.rejected == calibration.rejected
    assert loaded.unused == calibration.unused


MAY_BE_MISSING = ("joint", "displacement", "shots/mean", "untold_sd")
"""As a whole: each takes the others with it."""


@every_saved
def test_a_state_that_does_not_fit_is_refused(kind: str) -> None:
    calibration = SAVED[kind]()
    table, arrays = calibration.state()
    ForwardGPCalibration.from_state(calibration.data, table, arrays)
    refused = (KeyError, ValueError, TypeError)  # as in Calibration.from_state
    accepted = []

    def attempt(what: str, changed: dict[str, np.ndarray]) -> None:
        try:
            ForwardGPCalibration.from_state(calibration.data, table, changed)
        except refused:
            return
        accepted.append(what)

    for name, array in arrays.items():
        if name not in MAY_BE_MISSING:
            attempt(f"{name} dropped", {key: value for key, value in arrays.items() if key != name})
        attempt(f"{name} longer", arrays | {name: np.concatenate([array, array[-1:]])})
        attempt(f"{name} shorter", arrays | {name: array[:-1]})
        attempt(f"{name} deeper", arrays | {name: array[..., None]})
        attempt(f"{name} a number", arrays | {name: np.array(1.0)})
        if array.dtype == np.float64:
            for value in (np.nan, np.inf):
                spoilt = array.copy()
                spoilt.flat[spoilt.size // 2] = value
                attempt(f"{name} with {value}", arrays | {name: spoilt})
            attempt(f"{name} as float32", arrays | {name: array.astype(np.float32)})
        else:
            attempt(f"{name} as numbers", arrays | {name: array.astype(np.float64)})
    assert accepted == []


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("declared noise", "joint"),
        ("declared noise", "displacement"),
        ("estimated shots", "joint"),
        ("estimated shots", "displacement"),
        ("estimated shots", "shots/mean"),
        ("dots off", "ties"),
        ("dots off", "displacement"),
        ("dots off", "labels/size"),
    ],
)
def test_a_state_with_half_of_what_ties_the_cameras_is_refused(kind: str, name: str) -> None:
    calibration = SAVED[kind]()
    table, arrays = calibration.state()
    with pytest.raises((KeyError, ValueError, TypeError)):
        ForwardGPCalibration.from_state(
            calibration.data, table, {key: value for key, value in arrays.items() if key != name}
        )


def test_a_table_that_does_not_fit_is_refused() -> None:
    table, arrays = fitted().state()
    wrong = [
        {"lens": "fisheye"},
        {"seed": "x"},
        {"calibrated": table["calibrated"][:1]},
        {"calibrated": table["calibrated"][:3]},
        {"calibrated": [*table["calibrated"][:3], "another"]},
        {"calibrated": table["calibrated"][:3], "not_calibrated": {"cam2": "why"}},
        {"calibrated": 3},
    ]
    for change in wrong:
        with pytest.raises((KeyError, ValueError, TypeError, UsageError)):
            ForwardGPCalibration.from_state(fitted().data, table | change, arrays)
    for key in table:
        with pytest.raises(KeyError):
            ForwardGPCalibration.from_state(fitted().data, {k: v for k, v in table.items() if k != key}, arrays)


def test_what_is_said_of_one_camera_and_of_points_on_an_axis() -> None:
    """More points are no cure for one camera, and other y alone would leave the points on a plane."""
    rig = build_rig("bar3", seed=1)
    data = simulate(rig, random_positions(rig, 20, np.random.default_rng(1)), seed=1)
    with pytest.raises(FitError, match="use two cameras or more"):
        ForwardGP().fit(data.with_cameras(data.observations.camera_names[:1]))
    assert data.known is not None
    flat = replace(data, known=replace(data.known, xyz=data.xyz * [1.0, 0.0, 0.0]))
    with pytest.raises(FitError, match="same y = 0, z = 0") as told:
        ForwardGP().fit(flat)
    assert "add points with other y and z" in str(told.value)
