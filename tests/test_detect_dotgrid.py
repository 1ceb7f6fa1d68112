"""Plates with dots in staggered rows: numbered from one end however they are turned, measured as well as they state."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from implicam.detect import DotGrid, View, detector_from_options
from implicam.detect.dotgrid import _middles_off
from implicam.errors import UsageError
from implicam.geometry import Pose, rotation_from_vector
from implicam.hardware.simulated_hand import board_target, print_of, simulated_hand
from implicam.simulate import build_rig

PLATE = DotGrid(11, 4, 12.0)
VIEW = View("cam1", "p001")


@pytest.fixture(scope="module")
def rig():
    return build_rig("stereo", seed=1, lens_error=0.0)


@pytest.fixture(scope="module")
def held(rig):
    """A camera, the hand that holds the plate, and the picture."""
    cameras, hand = simulated_hand(rig, PLATE.describe(), seed=1)
    return cameras[0], hand, cameras[0].frame().picture


def true_pixels(rig, hand, points) -> np.ndarray:
    numbers = [int(point[-3:]) - 1 for point in points]
    return rig.cameras[0].pixel_from_world(hand.pose().apply(hand.corners)[numbers])[0]


@pytest.mark.slow
def test_all_dots_are_found_within_what_they_state(rig, held):
    _, hand, picture = held
    found = PLATE.detect(picture, VIEW)
    assert len(found) == 44, found.reason
    off = (found.uv - true_pixels(rig, hand, found.points)) / found.sd
    assert np.abs(off).max() < 4
    assert found.sd.max() < 0.05
    # turned half round it is numbered from its other end, which is then the top one in the picture
    turned = PLATE.detect(np.ascontiguousarray(picture[::-1, ::-1]), VIEW)
    assert turned.points == found.points
    back = np.array(picture.shape)[::-1] - 1 - turned.uv
    assert np.abs(back - found.uv).max() < 0.03
    bright = PLATE.detect(1 - picture, VIEW)  # bright dots on a dark plate
    assert np.abs(bright.uv - found.uv).max() < 0.01


def test_a_hidden_dot_does_not_put_the_others_off(held):
    _, _, picture = held
    found = PLATE.detect(picture, VIEW)
    hidden = picture.copy()
    u, v = np.round(found.uv[20]).astype(int)
    hidden[v - 20 : v + 20, u - 20 : u + 20] = picture.max()
    again = PLATE.detect(hidden, VIEW)  # OpenCV wants all of them: nothing, or the others where they are
    for point, uv in zip(again.points, again.uv, strict=True):
        assert np.linalg.norm(uv - found.uv[found.points.index(point)]) < 0.1


def test_the_middle_of_an_ellipse_is_not_that_of_the_disc():
    """Against the centroid of the disc's outline, seen by a pinhole."""
    pose = Pose(rotation_from_vector([0.5, -0.4, 0.2]), np.array([0.3, -0.2, 9.0]))
    nodes = np.column_stack([np.arange(12) % 4, np.arange(12) // 4]).astype(float)

    def seen(flat):
        xyz = pose.apply(np.column_stack([flat, np.zeros(len(flat))]))
        return 800 * xyz[:, :2] / xyz[:, 2:]

    radius, angle = 0.4, np.linspace(0, 2 * np.pi, 4001)[:-1]
    middles, areas = [], []
    for node in nodes:
        x, y = seen(node + radius * np.column_stack([np.cos(angle), np.sin(angle)])).T
        cross = x * np.roll(y, -1) - np.roll(x, -1) * y
        areas.append(cross.sum() / 2)
        middles.append([np.sum((p + np.roll(p, -1)) * cross) / (6 * areas[-1]) for p in (x, y)])
    uv, truth = np.array(middles), seen(nodes)
    assert np.abs(uv - truth).max() > 0.1
    off = _middles_off(nodes, uv, np.abs(areas))
    assert np.abs(uv - off - truth).max() < 0.02 * np.abs(uv - truth).max()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"board": "10x4", "spacing": 12.0}, "looks the same upside down"),
        ({"board": "11x4"}, "needs --spacing"),
        ({"board": "2x4", "spacing": 12.0}, "cannot be found"),
        ({"spacing": 12.0}, "size of the board"),
    ],
)
def test_plates_that_cannot_be(options, says):
    with pytest.raises(UsageError) as caught:
        detector_from_options("dotgrid", Path("nowhere"), **options)
    assert says in str(caught.value)
    assert caught.value.fix


def test_no_plate_another_plate_and_nothing_to_see(held):
    _, _, picture = held
    for plate, shown in ((replace(PLATE, rows=9, columns=5), picture), (PLATE, np.full_like(picture, 0.5))):
        found = plate.detect(shown, VIEW)
        assert not len(found)
        assert found.reason


def test_a_plate_is_described_and_printed():
    table = PLATE.describe()
    assert table == {"kind": "dotgrid", "rows": 11, "columns": 4, "spacing": 12.0}
    target = board_target(table, Pose(np.eye(3), np.zeros(3)), print_of(table))
    assert target.xyz[:, :2].max(axis=0).tolist() == [84.0, 120.0]
    black = target.sheet[1].black
    share = 44 * np.pi * 4.8**2 / np.prod(target.sheet[1].size)  # of the sheet
    assert black.mean() == pytest.approx(share, rel=0.01)
