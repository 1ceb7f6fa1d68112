"""A wand in pictures: two or three markers, named alike by every camera, or not at all."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from implicam.dataset import read_dataset
from implicam.detect import Detected, View, WandMarkers, detect_folder
from implicam.errors import UsageError
from implicam.images import write_picture
from implicam.simulate import Optics, Studio, build_rig, waved_wand

VIEW = View("cam1", "7")

Disc = tuple[float, float, float, float]
"""u, v, radius in pixels, brightness."""


def draw(*discs: Disc, noise: float = 0.01, seed: int = 0) -> np.ndarray:
    """Bright discs on a dark ground, drawn eight times as large as the picture, so that edges are exact."""
    fine = np.full((8 * 300, 8 * 400), 0.15, np.float32)
    for u, v, radius, grey in discs:
        middle = (round(16 * (8 * u + 3.5)), round(16 * (8 * v + 3.5)))
        cv2.circle(fine, middle, round(16 * 8 * radius), grey, -1, cv2.LINE_AA, 4)
    picture = cv2.GaussianBlur(cv2.resize(fine, (400, 300), interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    rng = np.random.default_rng(seed)
    return np.clip(picture + noise * rng.standard_normal(picture.shape), 0, 1).astype(np.float32)


def places(found: Detected) -> dict[str, tuple[float, float]]:
    return {name.removeprefix("7-"): (float(u), float(v)) for name, (u, v) in zip(found.points, found.uv, strict=True)}


@pytest.mark.parametrize("radius", [2.6, 3.4, 4.2, 9.0, 20.0])
def test_markers_of_all_sizes_are_where_they_are_drawn(radius: float) -> None:
    left, right = (120.3, 140.7), (250.45, 96.2)
    for a, b in ((left, right), (right, left)):  # the larger is `a`, on either side
        found = WandMarkers().detect(draw((*a, 1.4 * radius, 0.9), (*b, radius, 0.9)), VIEW)
        assert found.points == ("7-a", "7-b"), found.reason
        assert (np.abs(found.uv - [a, b]) < 4.5 * found.sd).all()  # eight numbers
        assert found.sd.max() < 0.05


def test_what_tells_the_ends_apart() -> None:
    bright, dim = (100.0, 100.0, 6.0, 0.9), (200.0, 150.0, 6.0, 0.5)
    found = WandMarkers(told_by="brightness").detect(draw(dim, bright), VIEW)
    assert places(found)["a"] == pytest.approx((100, 100), abs=0.1)
    three = [(80.0, 100.0, 5.0, 0.9), (120.0, 110.0, 5.0, 0.9), (240.0, 140.0, 5.0, 0.9)]
    line = places(WandMarkers(3, "spacing").detect(draw(*three), VIEW))
    assert line["a"] == pytest.approx((80, 100), abs=0.1)
    assert line["m"] == pytest.approx((120, 110), abs=0.1)
    assert line["b"] == pytest.approx((240, 140), abs=0.1)
    dark = 1 - draw((100.0, 100.0, 9.0, 0.9), (200.0, 150.0, 6.0, 0.9))
    assert places(WandMarkers(dark=True).detect(dark, VIEW))["a"] == pytest.approx((100, 100), abs=0.1)


A, B = (100.0, 120.0, 9.0, 0.9), (200.0, 150.0, 6.0, 0.9)
DOUBTS: dict[str, tuple[tuple[Disc, ...], str]] = {
    "nothing": ((), "no marker"),
    "one marker": ((A,), "one marker only, at (100, 120)"),
    "alike": ((A, (200.0, 150.0, 8.6, 0.9)), "not sure: the sizes at (100, 120) and (200, 150)"),
    "a third bright spot": ((A, B, (320.0, 60.0, 5.0, 0.8)), "3 things look like markers, at (100, 120), (200, 150)"),
    "reflected by the floor": ((A, B, (100.0, 240.0, 9.0, 0.7), (200.0, 210.0, 6.0, 0.7)), "4 things look like"),
    "end-on: one hides the other in part": ((A, (108.0, 124.0, 6.0, 0.9)), "marker"),
    "end-on: one hides the other": ((A, (103.0, 121.0, 5.0, 0.9)), "marker"),
    "cut by the border": ((A, (399.0, 150.0, 6.0, 0.9)), "one marker only"),
}


@pytest.mark.parametrize("case", DOUBTS)
def test_what_is_not_sure_is_left_out_and_the_reason_said(case: str) -> None:
    discs, reason = DOUBTS[case]
    found = WandMarkers().detect(draw(*discs), VIEW)
    assert not len(found)
    assert reason in found.reason


def test_a_faint_glint_is_no_rival_and_noise_no_marker() -> None:
    assert len(WandMarkers().detect(draw(A, B, (320.0, 60.0, 5.0, 0.35)), VIEW)) == 2
    assert not len(WandMarkers().detect(draw(noise=0.05), VIEW))


def test_three_markers_are_refused_out_of_line_and_with_a_fourth_in_line() -> None:
    detector = WandMarkers(3, "spacing")
    bent = detector.detect(draw((80, 100, 5, 0.9), (120, 130, 5, 0.9), (240, 140, 5, 0.9)), VIEW)
    assert "no three markers are in line" in bent.reason
    four = detector.detect(draw((80, 100, 5, 0.9), (120, 110, 5, 0.9), (240, 140, 5, 0.9), (320, 160, 5, 0.9)), VIEW)
    assert "threes of markers are in line" in four.reason
    hidden = detector.detect(draw((80, 100, 5, 0.9), (240, 140, 5, 0.9)), VIEW)
    assert "2 of 3 markers" in hidden.reason
    even = detector.detect(draw((80, 100, 5, 0.9), (158, 120, 5, 0.9), (240, 140, 5, 0.9)), VIEW)
    assert "the spacings" in even.reason


def test_what_stays_at_its_place_in_all_pictures_is_no_marker() -> None:
    lamp = (320.0, 60.0, 7.0, 0.95)
    detector, found, truth = WandMarkers(), {}, {}
    for k in range(6):
        a, b = (60.0 + 30 * k, 100.0 + 20 * k), (120.0 + 25 * k, 200.0 - 15 * k)
        truth[View("cam1", str(k))] = [a, b]
        found[View("cam1", str(k))] = detector.detect(
            draw((*a, 9, 0.9), (*b, 6, 0.9), lamp, seed=k), View("cam1", str(k))
        )
    assert all("3 things" in one.reason for one in found.values())
    for view, one in detector.settle(found).items():
        np.testing.assert_allclose(one.uv, truth[view], atol=0.1)


def test_a_ratio_that_differs_from_picture_to_picture_names_nothing() -> None:
    """Balls of nearly one size: what a picture shows is how far each is away, not which it is."""
    detector, rng = WandMarkers(), np.random.default_rng(4)
    found = {}
    for k in range(12):
        nearer = float(np.exp(0.35 * rng.standard_normal()))
        view = View("cam1", str(k))
        u, v = 20.0 * k, 10.0 * k
        found[view] = detector.detect(draw((60 + u, 80 + v, 8 * nearer, 0.9), (110 + u, 120 + v, 8, 0.9), seed=k), view)
    assert sum(len(one) > 0 for one in found.values()) >= 6
    settled = detector.settle(found)
    assert not any(len(one) for one in settled.values())
    assert any("the ratio of sizes is" in one.reason for one in settled.values())


def test_a_picture_less_clear_than_usual_is_left_out() -> None:
    detector, found = WandMarkers(), {}
    for k in range(9):
        small = 7.5 if k == 8 else 5.0  # the wand points at the camera
        view = View("cam1", str(k))
        found[view] = detector.detect(draw((60 + 30.0 * k, 90, 9, 0.9), (60 + 30.0 * k, 190, small, 0.9)), view)
    assert all(len(one) == 2 for one in found.values())
    settled = detector.settle(found)
    assert [len(one) for one in settled.values()] == 8 * [2] + [0]
    assert "and in most pictures by more than" in settled[View("cam1", "8")].reason


@pytest.mark.parametrize(
    ("options", "fix"),
    [
        ({"markers": 4}, "--markers 2 or 3"),
        ({"told_by": "colour"}, "--told-by size"),
        ({"markers": 3, "told_by": "size"}, "--markers 3 --told-by spacing"),
        ({"smallest": 9.0, "largest": 3.0}, "the smallest first"),
    ],
)
def test_wrong_options_are_refused_with_their_cure(options: dict[str, object], fix: str) -> None:
    with pytest.raises(UsageError) as error:
        WandMarkers.from_options(Path(), {}, **options)  # type: ignore[arg-type]
    assert fix in error.value.fix


def test_spacing_means_three_markers() -> None:
    assert WandMarkers.from_options(Path(), {}, told_by="spacing").markers == 3
    assert WandMarkers.from_options(Path(), {}, markers=3).told_by == "spacing"


def test_a_folder_of_pictures_becomes_the_table_that_a_wand_is_calibrated_from(tmp_path: Path) -> None:
    for k in range(4):
        a, b = (60.0 + 30 * k, 100.0 + 20 * k), (320.0 - 25 * k, 200.0 - 15 * k)
        for camera in ("left", "right"):
            ends = (a, b) if camera == "left" else (b, a)
            (tmp_path / "images" / camera).mkdir(parents=True, exist_ok=True)
            write_picture(tmp_path / "images" / camera / f"{k:03d}.png", draw((*ends[0], 9, 0.9), (*ends[1], 6, 0.9)))
    run = detect_folder(tmp_path, WandMarkers(length=500.0), unit="mm", overlays=False)
    data = read_dataset(tmp_path)
    assert run.data.points.tolist() == data.points.tolist()
    assert data.extra["target"]["kind"] == "wand"
    assert data.extra["target"]["ends"] == ["a", "b"]
    assert data.extra["target"]["length"] == 500.0
    assert data.columns["frame"].tolist() == ["000", "000", "001", "001", "002", "002", "003", "003"]
    assert data.columns["marker"].tolist() == ["a", "b"] * 4
    assert data.observations.seen.all()


@pytest.mark.slow
def test_rendered_wands_are_found_and_none_is_named_the_wrong_way_round() -> None:
    """Photographs with 14 look-alikes behind the wand, bright discs among them, in six cameras."""
    rig = build_rig("bar6", seed=1)
    frames = 10
    studio = Studio(rig, waved_wand(rig, frames, np.random.default_rng(3)), Optics(), 2)
    true, seen = studio.true_pixels
    detector = WandMarkers()
    found = {
        View(camera.name, shot): detector.detect(studio.picture(c, s), View(camera.name, shot))
        for c, camera in enumerate(rig.cameras)
        for s, shot in enumerate(studio.shots)
    }
    settled = list(detector.settle(found).values())
    at = true.reshape(frames, 2, len(rig.cameras), 2).transpose(2, 0, 1, 3).reshape(-1, 2, 2)
    both = seen.reshape(frames, 2, -1).all(axis=1).T.ravel()
    off = [np.abs(one.uv - uv).max() for one, uv in zip(settled, at, strict=True) if len(one)]
    assert len(off) >= 0.6 * both.sum()
    assert max(off) < 1.0
    assert np.median(off) < 0.05
