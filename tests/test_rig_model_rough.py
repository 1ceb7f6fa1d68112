"""Circles from four to seven known points: the place is inside, or nothing is shown. For the statistics over many rigs:
benchmarks/rough_circles.py."""

from __future__ import annotations

import numpy as np
import pytest

from implicam.active import Workspace
from implicam.dataset import Floats
from implicam.rig_model.rough import RoughViews, rough_views
from implicam.simulate import Rig, SimulatedCamera, Unusual, build_rig


def views(rig: Rig, c: int) -> tuple[SimulatedCamera, Floats, Floats]:
    """A camera, the places to begin with, and where it sees them."""
    xyz = Workspace.from_box(rig.volume).design(9, 0)
    return rig.cameras[c], xyz, rig.cameras[c].pixel_from_world(xyz)[0]


def circles(camera: SimulatedCamera, xyz: Floats, uv: Floats, n: int) -> RoughViews:
    return rough_views(xyz[:n], uv[:n], (camera.width, camera.height), xyz[n:])


@pytest.mark.parametrize(
    ("spec", "unusual"), [("bar6", Unusual()), ("dome8", Unusual(mirror="all")), ("2R2W", Unusual(aspect=1.5))]
)
def test_a_place_is_inside_of_its_circle(spec: str, unusual: Unusual) -> None:
    camera, xyz, uv = views(build_rig(spec, seed=2, unusual=unusual), 0)
    for n, most in ((6, 0.1), (7, 0.05)):
        found = circles(camera, xyz, uv, n)
        shown = np.isfinite(found.radius)
        off = np.linalg.norm(found.uv - uv[n:], axis=1)
        assert (off[shown] <= found.radius[shown]).all()
        assert shown.any()
        assert found.radius[shown].max() < most * camera.width


def test_more_points_and_surer_ones_make_smaller_circles() -> None:
    camera, xyz, uv = views(build_rig("bar6", seed=4), 1)
    four, seven = (float(np.nanmedian(circles(camera, xyz, uv, n).radius)) for n in (4, 7))
    assert seven < four
    unsure = rough_views(xyz[:7], uv[:7], (camera.width, camera.height), xyz[7:], sd=3.0)
    assert np.nanmedian(unsure.radius) > 1.3 * seven


def test_nothing_is_shown_that_could_mislead() -> None:
    camera, xyz, uv = views(build_rig("bar6", seed=4), 0)
    size = (camera.width, camera.height)
    missed = uv[:5].copy()
    missed[[0, 3]] = np.nan
    wrong = uv[:6].copy()
    wrong[2] += [310, -180]
    for known, seen in (
        (xyz[:3], uv[:3]),  # any focal length fits
        (np.repeat(xyz[:3], 2, axis=0), np.repeat(uv[:3], 2, axis=0)),
        (xyz[:5], missed),
        (xyz[:6], wrong),
        (np.tile(xyz[:1], (5, 1)), uv[:5]),  # one place
    ):
        found = rough_views(known, seen, size, xyz[7:])
        assert np.isnan(found.uv).all()
        assert np.isnan(found.radius).all()


def test_a_place_that_is_not_in_the_picture_has_no_circle() -> None:
    camera, xyz, uv = views(build_rig("bar6", seed=4), 0)
    outside = camera.camera_from_world.inverse().apply(np.array([[900.0, 0, 600], [0, 0, -300]]))
    assert np.isnan(rough_views(xyz[:7], uv[:7], (camera.width, camera.height), outside).radius).all()
