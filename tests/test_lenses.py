"""One contract for every lens model, what it catches, and agreement with OpenCV."""

from __future__ import annotations

import re
from dataclasses import dataclass, make_dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import pytest

from implicam.errors import FitError
from implicam.lenses import LENSES, BrownConrady, KannalaBrandt, Lens, fit_lens
from implicam.testing import check_lens, edge_of
from lens_examples import EXAMPLES, WIDEST_RAD

EACH = {name: lens for family in EXAMPLES.values() for name, lens in family.items()}
FISHEYE = EXAMPLES["kannala-brandt"]["fisheye"]


@pytest.fixture(params=EACH, ids=str)
def lens(request: pytest.FixtureRequest) -> Lens:
    return EACH[request.param]


def rays(theta: Any, phi: Any) -> np.ndarray:
    return np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi])


def test_it_is_all_that_is_asked_of_a_lens(lens: Lens) -> None:
    check_lens(lens, WIDEST_RAD.get(lens.family))


def test_every_family_has_examples() -> None:
    assert set(LENSES) <= set(EXAMPLES), "add two or three lenses of the new family to tests/lens_examples.py"
    for family, examples in EXAMPLES.items():
        assert {lens.family for lens in examples.values()} == {family}


@dataclass(frozen=True)
class Otherwise(KannalaBrandt):
    """A lens of which one thing is wrong."""

    def parameter_jacobian(self, points: np.ndarray) -> np.ndarray:
        return np.nan_to_num(super().parameter_jacobian(points))


@dataclass(frozen=True)
class Scaled(KannalaBrandt):
    def pixel_from_camera_point(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        uv, valid = super().pixel_from_camera_point(points)
        return uv + (uv - [self.cx, self.cy]), valid

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        return 2 * super().jacobian(points)


@dataclass(frozen=True)
class Folding(KannalaBrandt):
    """With strong distortion it answers beyond its fold, with another point's pixels."""

    @cached_property
    def critical_angle(self) -> float:
        return super().critical_angle if self.k1 > -0.2 else 3.0


@dataclass(frozen=True)
class Plain(KannalaBrandt):
    @classmethod
    def nearest(cls, lens: Lens, points: np.ndarray) -> Any:
        return cls(lens.fx, lens.fy, lens.cx, lens.cy)


Swapped = make_dataclass("Swapped", [(name, float) for name in ("fy", "fx", "cx", "cy")], frozen=True)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (Swapped(433.0, 431.0, 630.0, 405.0), "the first fields must be fx, fy, cx, cy"),
        (Scaled(433.0, 431.0, 630.0, 405.0), "fx and fy are the focal lengths at the middle of the image"),
        (Otherwise(433.0, 431.0, 630.0, 405.0, -0.15), "parameter_jacobian must be NaN where there is no pixel"),
        (Folding(433.0, 431.0, 630.0, 405.0), "the image turns back on itself: Folding"),
        (Plain(300.0, 301.0, 630.0, 405.0, -0.1), "px (rms) from Plain"),
    ],
)
def test_the_contract_says_what_does_not_hold(wrong: Any, says: str) -> None:
    with pytest.raises(AssertionError, match=re.escape(says)):
        check_lens(wrong)


@dataclass(frozen=True)
class Blind(KannalaBrandt):
    """With strong distortion it sees nothing, which is an answer."""

    @cached_property
    def critical_angle(self) -> float:
        return super().critical_angle if self.k1 > -0.2 else 0.0


def test_a_lens_may_see_nothing_where_its_parameters_are_past_the_usual() -> None:
    check_lens(Blind(433.0, 431.0, 630.0, 405.0))


def test_a_perspective_lens_sees_nothing_behind() -> None:
    points = np.random.default_rng(4).normal(size=(200, 3))
    for lens in EXAMPLES["brown-conrady"].values():
        assert not lens.pixel_from_camera_point(points)[1][points[:, 2] <= 0].any()


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


class Wide:
    """Radius 731 sin(t / 2) (1 + 0.1 sin(t / 2)²): of no family, and seen up to 123 degrees."""

    family = "wide"
    fx = fy = 275.0
    """Not the focal length at the middle, which a lens of another package may get wrong."""
    cx, cy = 639.5, 511.5

    def pixel_from_camera_point(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r = np.hypot(points[:, 0], points[:, 1])
        s = np.sin(np.arctan2(r, points[:, 2]) / 2)
        radius = 731 * s * (1 + 0.1 * s**2)
        return points[:, :2] / np.maximum(r, 1e-300)[:, None] * radius[:, None] + [self.cx, self.cy], r >= 0

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        return np.tile(365.5 * np.eye(3)[:2], (len(points), 1, 1))


def test_the_nearest_lens_is_found_whatever_the_start() -> None:
    """From a focal length of 275 where the middle has 366, every step of a fit ended at a fold, 40 px off."""
    rng, wide = np.random.default_rng(0), Wide()
    points = rays(rng.uniform(0, 2.15, 200), rng.uniform(0, 6.28, 200))
    uv = wide.pixel_from_camera_point(points)[0]
    start = KannalaBrandt(275.0, 275.0, 639.5, 511.5)
    for found in (KannalaBrandt.nearest(wide, points), fit_lens(start, points, uv)):  # type: ignore[arg-type]
        assert np.abs(found.pixel_from_camera_point(points)[0] - uv).max() < 0.2
        assert abs(found.fx - 365.5) < 1


def test_of_several_starts_the_best_fit_is_kept_and_those_that_see_too_little_are_left_out() -> None:
    points = rays(np.linspace(0, 1.6, 60), np.linspace(0, 60, 60))
    uv = FISHEYE.pixel_from_camera_point(points)[0]
    blind = KannalaBrandt(433.0, 431.0, 630.0, 405.0, -0.5)
    found = fit_lens([blind, KannalaBrandt(433.0, 431.0, 630.0, 405.0), FISHEYE], points, uv)
    np.testing.assert_allclose(found.pixel_from_camera_point(points)[0], uv, atol=1e-6)
    with pytest.raises(FitError, match=r"no start of kannala-brandt sees these points") as refused:
        fit_lens(blind, points, uv)
    assert re.search(r"sees \d+ of 60", refused.value.why)
    assert "other starts" in refused.value.fix


def test_a_fit_that_stalls_says_so() -> None:
    """Pixels that no lens has: the outer ones are nearer to the middle than the inner ones."""
    theta = np.linspace(0.05, 1.5, 60)
    points, phi = rays(theta, 7 * theta), 7 * theta
    folded = 400 * np.where(theta < 1, theta, 2 - theta)[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    with pytest.raises(FitError, match=r"the fit of kannala-brandt to these points stalled \d.* px \(rms\) off"):
        fit_lens(KannalaBrandt(400.0, 400.0, 0.0, 0.0), points, folded)


def test_agrees_with_opencv(lens: Lens) -> None:
    if not isinstance(lens, BrownConrady | KannalaBrandt):
        pytest.skip("OpenCV has no such lens")
    widest = min(0.97 * edge_of(lens), np.radians(87))  # OpenCV stays in front of the camera
    points = rays(*np.random.default_rng(6).uniform([[0], [0]], [[widest], [2 * np.pi]], (2, 300)))
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    zero = np.zeros(3)
    if isinstance(lens, BrownConrady):
        k = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
        theirs = cv2.projectPoints(points, zero, zero, matrix, k)[0]
    else:
        k = np.array([lens.k1, lens.k2, lens.k3, lens.k4])
        theirs = cv2.fisheye.projectPoints(points[:, None], zero, zero, matrix, k)[0]
    np.testing.assert_allclose(lens.pixel_from_camera_point(points)[0], theirs.reshape(-1, 2), rtol=1e-12, atol=1e-9)
