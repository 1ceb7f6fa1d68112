"""The camera for any camera: derivatives, inverses, and closed forms it must contain."""

from __future__ import annotations

import numpy as np
import pytest

from implicam.geometry import Pose, rotation_from_vector
from implicam.lenses import PERSPECTIVE_K, KannalaBrandt
from implicam.rig_model.camera import CentralCamera
from implicam.rig_model.general_camera import MIN_RHO, GeneralCamera

RNG = np.random.default_rng(0)


def camera(distance: float, *, mirrored: bool, angle: float = 0.2, tilt: float = 0.2) -> GeneralCamera:
    """One that sees the unit ball at a distance, `angle` off its axis; everything odd at once."""
    k = 0.5 * PERSPECTIVE_K * 0.4 + np.array([0.02, -0.01, 0.003, 0.0])
    direction = np.array([np.sin(angle) * 0.6, np.sin(angle) * 0.8, np.cos(angle)])
    pose = Pose(rotation_from_vector(np.array([0.3, -0.2, 0.5])), distance * direction)
    return GeneralCamera(
        300.0 * distance, np.array([0.15, -0.07]), np.array([tilt, -0.1]), np.array([640.0, 390.0]), k, mirrored, pose
    )


CAMERAS = [
    camera(4.0, mirrored=False),
    camera(4.0, mirrored=True),
    camera(2.0, mirrored=False, angle=1.2, tilt=0.05),
    camera(300.0, mirrored=True, angle=0.002),
    camera(1500.0, mirrored=False, angle=0.0),
]
POINTS = RNG.uniform(-0.7, 0.7, size=(40, 3))


@pytest.mark.parametrize("one", CAMERAS)
def test_derivatives_agree_with_finite_differences(one: GeneralCamera) -> None:
    view = one.view(POINTS)
    for found, expected in zip(one.sight(POINTS), view[:2], strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-9)
    scale = np.abs(view.by_parameters).max(axis=(0, 1))
    for number in range(one.size):
        h = 1e-3 / scale[number] if scale[number] > 0 else 1e-6  # a step of a thousandth of a pixel
        step = np.zeros(one.size)
        step[number] = h
        slope = (one.moved(step).pixel(POINTS) - one.moved(-step).pixel(POINTS)) / (2 * h)
        np.testing.assert_allclose(view.by_parameters[:, :, number], slope, atol=2e-4 * scale[number])
    for axis, d in enumerate(1e-6 * np.eye(3)):
        slope = (one.pixel(POINTS + d) - one.pixel(POINTS - d)) / 2e-6
        np.testing.assert_allclose(view.by_point[:, :, axis], slope, rtol=1e-5, atol=1e-3)
        far = (one.view(POINTS + d).log_distance - one.view(POINTS - d).log_distance) / 2e-6
        np.testing.assert_allclose(view.distance_by_point[:, axis], far, atol=1e-6)


@pytest.mark.parametrize("one", CAMERAS)
def test_a_line_of_sight_goes_back_through_the_point(one: GeneralCamera) -> None:
    centre, directions = one.lines(one.pixel(POINTS))
    aside = np.linalg.norm(np.cross(POINTS - centre, directions), axis=1)
    assert aside.max() < 1e-6


@pytest.mark.parametrize("one", CAMERAS)
def test_arrays_and_steps_round_trip(one: GeneralCamera) -> None:
    np.testing.assert_allclose(one.moved(np.zeros(17)).pixel(POINTS), one.pixel(POINTS), atol=1e-6)
    np.testing.assert_array_equal(GeneralCamera.from_array(one.as_array()).as_array(), one.as_array())
    step = RNG.normal(size=17) * [
        1e-2,
        0.1,
        0.1,
        0.1,
        0.1,
        5,
        5,
        *1e-3 * one.rho ** np.array([2, 4, 6, 8]),
        0.1 * one.rho,
        0.1,
        0.1,
        0,
        0,
        0,
    ]
    moved = one.moved(step)
    np.testing.assert_allclose(moved.parameters, one.parameters + step, rtol=1e-6, atol=1e-12)


def test_without_oddities_it_is_the_central_camera() -> None:
    lens = KannalaBrandt(900.0, 1100.0, 640.0, 400.0, 0.1, -0.02, 0.01, 0.0)
    central = CentralCamera(lens, Pose(rotation_from_vector([0.1, 0.2, 0.3]), np.array([0.1, 0.0, 3.0])))
    general = GeneralCamera.from_central(central)
    np.testing.assert_allclose(general.pixel(POINTS), central.pixel(POINTS), rtol=1e-12)
    np.testing.assert_allclose(general.as_central().pixel(POINTS), central.pixel(POINTS), rtol=1e-12)
    turned = GeneralCamera.from_central(central, mirrored_about=500.0)
    expected = central.pixel(POINTS) * [-1, 1] + [1000.0, 0.0]
    np.testing.assert_allclose(turned.pixel(POINTS), expected, rtol=1e-12)


def test_a_tilted_sensor_is_the_intersection_of_rays_with_a_plane() -> None:
    """A pinhole whose sensor is turned: each ray meets the sensor's plane, in the sensor's own coordinates."""
    turn = rotation_from_vector([0.12, -0.2, 0.05])  # sensor axes in the lens's frame, columns
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 5.0]))
    rays = pose.apply(POINTS)
    foot, normal = np.array([0.0, 0.0, 1.0]), turn[:, 2]
    hits = rays * ((foot @ normal) / (rays @ normal))[:, None]
    uv = 800.0 * (hits - foot) @ turn[:, :2]
    # the same as a homography of the ideal image, whose first-order part is B and a rotation of the whole picture
    ideal = rays[:, :2] / rays[:, 2:]
    tilt = normal[:2] / normal[2]
    y = ideal / (1 + ideal @ tilt)[:, None]
    linear = np.linalg.lstsq(y, uv, rcond=None)[0]
    np.testing.assert_allclose(y @ linear, uv, atol=1e-9)


def test_a_telephoto_lens_may_go_far_and_no_pixel_jumps() -> None:
    one = camera(1000.0, mirrored=False, angle=0.003, tilt=0.0)
    step = np.zeros(17)
    step[11] = -1.0
    assert one.moved(step).rho == pytest.approx(MIN_RHO)
    assert np.abs(one.moved(step).pixel(POINTS) - one.pixel(POINTS)).max() < 2.0


def test_what_is_no_camera_is_refused() -> None:
    array = CAMERAS[0].as_array()
    for index, value in ((0, -1.0), (11, 0.5), (12, 9.0)):
        broken = array.copy()
        broken[index] = value
        with pytest.raises(ValueError, match="camera"):
            GeneralCamera.from_array(broken)
