"""One contract for every lens model, and agreement with OpenCV."""

from __future__ import annotations

from dataclasses import astuple

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from implicam.lenses import LENSES as LENS_FAMILIES
from implicam.lenses import BrownConrady, KannalaBrandt, Lens
from toy_lens import Equisolid

LENSES: dict[str, Lens] = {
    "pinhole": BrownConrady(900.0, 910.0, 640.0, 400.0),
    "barrel": BrownConrady(930.0, 935.0, 651.0, 392.0, -0.1, 0.02, 4e-4, -3e-4, 0.001),
    "folding": BrownConrady(930.0, 935.0, 651.0, 392.0, -0.3, 0.02, 2e-3, -1e-3, 0.0),
    "pincushion": BrownConrady(1200.0, 1200.0, 640.0, 512.0, 0.2, 0.05, 0.0, 1e-4, 0.01),
    "equidistant": KannalaBrandt(430.0, 432.0, 640.0, 400.0),
    "fisheye": KannalaBrandt(433.0, 431.0, 630.0, 405.0, -0.02, 0.004, -1e-3, 2e-4),
    "folding fisheye": KannalaBrandt(433.0, 431.0, 630.0, 405.0, -0.15, 0.01, 0.0, 0.0),
    "equisolid": Equisolid(433.0, 431.0, 630.0, 405.0, -0.02, 0.004, -1e-3, 2e-4),
    "folding equisolid": Equisolid(433.0, 431.0, 630.0, 405.0, -0.15),
}


@pytest.fixture(params=LENSES, ids=str)
def lens(request: pytest.FixtureRequest) -> Lens:
    return LENSES[request.param]


def points_everywhere(seed: int, n: int = 400) -> np.ndarray:
    """Directions all round, at distances over three decades."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(0, 3, (n, 1)) ** 10


def edge_of(lens: Lens) -> float:
    """Angle to the axis, in radians, up to which the lens has pixels whatever the direction about the axis."""
    theta = np.linspace(1e-3, np.pi - 1e-3, 3000)
    phi = np.linspace(0, 2 * np.pi, 24)
    t, p = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    rays = np.column_stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)])
    valid = lens.pixel_from_camera_point(rays)[1].reshape(len(theta), -1).all(axis=1)
    return float(theta[valid.argmin() - 1]) if not valid.all() else float(theta[-1])


def inside(lens: Lens, seed: int, n: int = 300, part: float = 0.97) -> np.ndarray:
    """Points well inside what the lens sees, the axis itself included."""
    rng = np.random.default_rng(seed)
    theta, phi = rng.uniform(0, part * min(edge_of(lens), 3.0), n), rng.uniform(0, 2 * np.pi, n)
    theta[0] = 0.0
    rays = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    return rays * rng.uniform(0.5, 500, (n, 1))


def test_ray_and_pixel_cancel(lens: Lens) -> None:
    points = inside(lens, 1)
    uv, valid = lens.pixel_from_camera_point(points)
    rays, found = lens.ray_from_pixel(uv)
    assert valid.all()
    assert found.all()
    np.testing.assert_allclose(rays, points / np.linalg.norm(points, axis=1, keepdims=True), atol=1e-9)
    np.testing.assert_allclose(lens.pixel_from_camera_point(rays)[0], uv, rtol=1e-11, atol=1e-6)


def test_the_pixel_depends_on_the_direction_only(lens: Lens) -> None:
    points = inside(lens, 2)
    np.testing.assert_allclose(*(lens.pixel_from_camera_point(s * points)[0] for s in (1.0, 7.3)), atol=1e-8)
    jacobian = lens.jacobian(points)
    along = np.einsum("nij,nj->ni", jacobian, points)  # Euler: homogeneous of degree zero
    assert np.abs(along).max() < 1e-9 * np.abs(jacobian).max() * np.abs(points).max()


def test_jacobian_is_the_derivative(lens: Lens) -> None:
    points = inside(lens, 3, part=0.9)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    h = 1e-6
    numeric = np.stack(
        [
            (lens.pixel_from_camera_point(points + h * e)[0] - lens.pixel_from_camera_point(points - h * e)[0])
            / (2 * h)
            for e in np.eye(3)
        ],
        axis=2,
    )
    np.testing.assert_allclose(lens.jacobian(points), numeric, rtol=1e-6, atol=1e-4)


def test_invalid_is_nan_everywhere_and_never_a_warning(lens: Lens) -> None:
    points = np.concatenate([points_everywhere(4), np.zeros((1, 3)), [[0, 0, -1.0], [1.0, 0, 0], [1e-99, 0, 1e-99]]])
    uv, valid = lens.pixel_from_camera_point(points)
    assert (np.isfinite(uv).all(axis=1) == valid).all()
    assert (np.isfinite(lens.jacobian(points)).all(axis=(1, 2)) == valid).all()
    assert not valid[-4]  # the centre itself has no direction
    if isinstance(lens, BrownConrady):
        assert not valid[points[:, 2] <= 0].any()


def test_valid_pixels_are_one_to_one(lens: Lens) -> None:
    """Beyond the fold a point would land on another point's pixel: then at most one of them may be valid."""
    points = points_everywhere(5, 3000)
    uv, valid = lens.pixel_from_camera_point(points)
    near = valid & (np.abs(uv - [640, 400]) < 2e3).all(axis=1)
    rays, found = lens.ray_from_pixel(uv[near])
    directions = points[near] / np.linalg.norm(points[near], axis=1, keepdims=True)
    assert found.mean() > 0.98  # the last hair before the fold may be refused, but is never answered wrongly
    np.testing.assert_allclose(rays[found], directions[found], atol=1e-4)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(sorted(LENSES)), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4))
def test_any_pixel_has_a_true_ray_or_none(name: str, u: float, v: float) -> None:
    lens, uv = LENSES[name], np.array([[u, v]])
    rays, valid = lens.ray_from_pixel(uv)
    if valid[0]:
        assert abs(np.linalg.norm(rays) - 1) < 1e-12
        np.testing.assert_allclose(lens.pixel_from_camera_point(rays)[0], uv, atol=2e-6)
    else:
        assert np.isnan(rays).all()


def test_nan_in_nan_out(lens: Lens) -> None:
    nan = np.full((2, 3), np.nan)
    assert not lens.pixel_from_camera_point(nan)[1].any()
    assert not lens.ray_from_pixel(nan[:, :2])[1].any()
    assert np.isnan(lens.jacobian(nan)).all()


def test_critical_radius_and_angle_have_the_closed_form() -> None:
    """With k1 alone, t + k1 t³ turns at t² = -1 / (3 k1)."""
    turn = np.sqrt(1 / 0.9)
    for part, expected in ((0.999, True), (1.001, False)):
        t = part * turn
        assert BrownConrady(1, 1, 0, 0, k1=-0.3).pixel_from_camera_point(np.array([[0, t, 1.0]]))[1][0] == expected
        ray = np.array([[np.sin(t), 0, np.cos(t)]])
        assert KannalaBrandt(1, 1, 0, 0, k1=-0.3).pixel_from_camera_point(ray)[1][0] == expected


def test_a_fisheye_sees_behind_itself() -> None:
    theta = np.radians(120)
    uv, valid = KannalaBrandt(100, 100, 0, 0).pixel_from_camera_point(np.array([[np.sin(theta), 0, np.cos(theta)]]))
    assert valid[0]
    np.testing.assert_allclose(uv[0], [100 * theta, 0], atol=1e-10)


def test_parameter_jacobian_is_the_derivative(lens: Lens) -> None:
    points = inside(lens, 7, part=0.9)
    at = np.array(astuple(lens))
    for column, exact in enumerate(np.moveaxis(lens.parameter_jacobian(points), 2, 0)):
        h = 1e-6 * max(abs(at[column]), 1e-2) * np.eye(len(at))[column]
        up, down = (type(lens)(*(at + s * h).tolist()).pixel_from_camera_point(points)[0] for s in (1, -1))
        both = np.isfinite(up) & np.isfinite(down)
        np.testing.assert_allclose(((up - down) / (2 * h[column]))[both], exact[both], rtol=1e-5, atol=1e-4)


def test_the_prior_of_the_distortion_is_a_normal_one(lens: Lens) -> None:
    for widest in (0.1, 0.7, 1.8):
        mean, precision = lens.distortion_prior(widest)
        assert mean.shape == (len(astuple(lens)) - 4,)
        np.testing.assert_allclose(precision, precision.T)
        assert np.linalg.eigvalsh(precision).min() > 0


@pytest.mark.parametrize("family", ["brown-conrady", "kannala-brandt", "equisolid"])
def test_the_nearest_lens_of_a_family_is_near_within_its_narrow_field(lens: Lens, family: str) -> None:
    kind = {"equisolid": Equisolid, **LENS_FAMILIES}[family]
    points = inside(lens, 8)
    points = points[np.hypot(points[:, 0], points[:, 1]) < np.tan(0.2) * points[:, 2]]
    found = kind.nearest(lens, points)
    assert isinstance(found, kind)
    off = found.pixel_from_camera_point(points)[0] - lens.pixel_from_camera_point(points)[0]
    assert np.abs(off).max() < 1.0


def test_agrees_with_opencv(lens: Lens) -> None:
    if not isinstance(lens, BrownConrady | KannalaBrandt):
        pytest.skip("OpenCV has no such lens")
    points = inside(lens, 6)
    points = points[points[:, 2] > 0.05 * np.linalg.norm(points, axis=1)]  # OpenCV stays in front of the camera
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    zero = np.zeros(3)
    if isinstance(lens, BrownConrady):
        k = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
        theirs = cv2.projectPoints(points, zero, zero, matrix, k)[0]
    else:
        k = np.array([lens.k1, lens.k2, lens.k3, lens.k4])
        theirs = cv2.fisheye.projectPoints(points[:, None], zero, zero, matrix, k)[0]
    np.testing.assert_allclose(lens.pixel_from_camera_point(points)[0], theirs.reshape(-1, 2), rtol=1e-12, atol=1e-9)
