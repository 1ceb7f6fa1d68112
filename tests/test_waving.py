"""Waving a wand with guidance: what is covered, where to wave next, when it is enough."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from implicam.active.board_loop import Pictures
from implicam.active.stopping import Below, Within
from implicam.active.volume_design import linear_views
from implicam.active.wand_coverage import Cells, WaveDesign, _gains, count_views, ends_of, unknown_cells
from implicam.active.wand_loop import MIN_WHOLE_FRAMES, WandLoop
from implicam.active.workspace import Workspace
from implicam.calibrators import ForwardGP, ForwardGPCalibration
from implicam.dataset import Dataset
from implicam.dataset.image_bounds import are_on_image
from implicam.dataset.wand import Wand
from implicam.geometry import register
from implicam.simulate import Rig, as_wand, build_rig, simulate, waved_wand


def wave(rig: Rig, frames: int, seed: int = 3, **options: float) -> Dataset:
    target = waved_wand(rig, frames, np.random.default_rng(seed))
    return as_wand(simulate(rig, target, seed=seed, **options), target)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return build_rig("stereo", seed=1)


@pytest.fixture(scope="module")
def data(rig: Rig) -> Dataset:
    return wave(rig, 60)


@pytest.fixture(scope="module")
def calibration(data: Dataset) -> ForwardGPCalibration:
    return ForwardGP(wand=144.0).fit(data)


@pytest.fixture(scope="module")
def design(calibration: ForwardGPCalibration) -> WaveDesign:
    assert calibration.wand is not None
    return WaveDesign.of(calibration, calibration.wand, None)


def volume_of(rig: Rig, target: Any, calibration: ForwardGPCalibration) -> Workspace:
    """The rig's volume in the frame of the calibration."""
    row = {str(name): i for i, name in enumerate(target.points)}
    pose, _ = register(target.xyz[[row[str(name)] for name in calibration.data.points]], calibration.data.xyz)
    return Workspace.hull(pose.apply(Workspace.from_box(rig.volume).vertices))


# --- the judge ------------------------------------------------------------------------------------------------------


def test_a_position_is_said_to_be_known_as_well_as_measuring_it_says(design, calibration):
    """In the judged places the predicted covariance is that which a measurement of the same views states."""
    few = design.judged.select(np.arange(25))
    uv = np.where(few.seen[..., None], few.uv, np.nan)
    measured = calibration.measure_pixels(uv)
    good = design._counted[:25] & np.isfinite(measured.cov).all(axis=(1, 2))
    assert good.sum() > 15
    stated, predicted = (
        np.sqrt(np.trace(c[good], axis1=1, axis2=2)) for c in (measured.cov, design.at_judged.total[:25])
    )
    np.testing.assert_allclose(predicted, stated, rtol=0.02)


def test_the_places_of_a_wand_are_integrated_out(design):
    """Against the whole normal matrix of unknowns and places, inverted."""
    rng = np.random.default_rng(1)
    _, ends = design._candidates(rng)
    told = design._told(ends[:, :1])
    i = int(np.argmax(np.abs(told).sum(axis=(1, 2)) > 0))
    L, flat = told[i], ends[i, 0]
    seen = are_on_image(design.rig.trained, design.rig.predict(flat))
    assert seen.all()
    part = linear_views(design.rig, flat, seen)
    H = np.concatenate([*(part.half / part.sd[..., None]), np.zeros((1, part.half.shape[2]))])
    K = np.zeros((len(H), 6))
    K[:4, :3], K[4:8, 3:] = part.slope[0] / part.sd[0][:, None], part.slope[1] / part.sd[1][:, None]
    for axis in range(3):  # of the length, numerically
        step = 1e-4 * np.eye(3)[axis]
        long = np.linalg.norm(flat[1] + step - flat[0]) - np.linalg.norm(flat[1] - flat[0])
        K[8, 3 + axis] = long / 1e-4 / design.wand.jitter
        K[8, axis] = -K[8, 3 + axis]
    joint = np.block([[np.eye(H.shape[1]) + H.T @ H, H.T @ K], [K.T @ H, K.T @ K]])
    marginal = np.linalg.inv(joint)[: H.shape[1], : H.shape[1]]
    np.testing.assert_allclose(np.linalg.inv(np.eye(H.shape[1]) + L.T @ L), marginal, atol=2e-4)


def test_the_gain_is_what_the_weighted_variance_loses(design):
    _, ends = design._candidates(np.random.default_rng(2))
    L = design._told(ends[:3])
    M = design._moved[0].reshape(-1, L.shape[2])
    for one, gain in zip(L, _gains(L, M), strict=True):
        after = np.linalg.inv(np.eye(one.shape[1]) + one.T @ one)
        assert gain == pytest.approx(np.trace(M @ M.T) - np.trace(M @ after @ M.T), rel=1e-6)


def test_cells_count_views_and_the_emptiest_is_far_from_what_was_seen():
    uv = np.array([[0.0, 0.0], [199.9, 0.0], [1279.0, 799.0], [np.nan, np.nan], [1500.0, 10.0]])
    views = count_views(uv, (1280, 800))
    assert views.shape == (4, 6)
    assert (views[0, 0], views[3, 5], views.sum()) == (2, 1, 3)
    assert count_views(uv, (800, 1280)).shape == (6, 4)
    nothing = unknown_cells(np.zeros((0, 2)), (1280, 800))
    assert 0.4 < nothing.emptiest[0] < 0.6  # begin in the middle
    left = np.zeros((4, 6))
    left[:, :3] = 3
    assert Cells(np.minimum(left / 3, 1), left).emptiest[0] > 0.9


def test_a_half_of_the_volume_that_was_never_waved_at_is_red_and_is_named(rig):
    """All frames in the left half of what cam1 sees: the other half is uncertain, and there it is to be waved."""
    target = waved_wand(rig, 240, np.random.default_rng(5))
    whole = as_wand(simulate(rig, target, seed=5), target)
    ends = ends_of(whole, Wand())
    left = np.flatnonzero((ends[:, :, 0, 0] < 640).all(axis=1))[:60]
    rows = np.isin(whole.columns["frame"], [str(f + 1) for f in left])
    some = whole.select(rows)
    calibration = ForwardGP(wand=144.0).fit(some)
    design = WaveDesign.of(calibration, calibration.wand, volume_of(rig, target, calibration))
    u = design.judged.uv[:, 0, 0]
    sd = design.at_judged.excess
    assert np.nanmedian(sd[u > 800]) > 1.3 * np.nanmedian(sd[u < 500])
    cells = design.cells(0, ends[left][:, :, 0].reshape(-1, 2), (1280, 800))
    assert np.nanmean(cells.known[:, 3:]) < np.nanmean(cells.known[:, :3])
    (place, *_) = design.next_places(1)
    assert place.uv[0, 0] > 640
    assert 0 < place.gain < 1


# --- the loop -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def loop(data: Dataset) -> WandLoop:
    rule = Below(1e-3, "usual") | Pictures(60, "frames")
    return WandLoop(ForwardGP(wand=144.0), Wand(length=144.0), data.cameras, rule=rule, data=data)


def test_before_there_is_a_calibration_each_camera_is_shown_what_it_has_not_seen(data):
    loop = WandLoop(ForwardGP(wand=144.0), Wand(length=144.0), data.cameras)
    (first,) = loop.ask()
    assert first.words.startswith("middle")
    assert "another camera sees it too" in first.words
    few = data.select(np.arange(40))
    loop.tell(few)
    assert loop.fit(few) is None
    assert loop.points == 20 < MIN_WHOLE_FRAMES
    (target,) = loop.ask()
    assert np.isfinite(target.uv).all(axis=1).sum() == 1
    assert [one.boards for one in loop.camera_progress()] == [20, 20]
    assert all(one.part < 0.5 for one in loop.camera_progress())


def test_it_says_where_why_and_that_noise_alone_is_in_the_way(loop):
    assert loop.problem is None
    assert loop.stop == "all 60 frames of the budget are taken"
    assert loop.lengths is not None
    assert len(loop.lengths.errors) > 10
    assert "Pixel noise alone leaves" in loop.out_of_reach
    (target,) = loop.ask()
    assert target.words.endswith("mm from it")
    assert "is wanted" in target.why
    assert np.isfinite(target.xyz).all()
    (other,) = loop.ask()
    assert not np.allclose(other.xyz, target.xyz)
    assert all(0.5 < one.part <= 1 for one in loop.camera_progress())
    assert len(loop.history) == 1


def test_wrong_error_bars_are_never_enough(loop):
    """Lengths that were held out contradict them: the rule alone would stop."""
    other = replace(loop, rule=Within(50.0), data=None)
    other.data, other.history = loop.data, list(loop.history)
    other.fitted = loop.fitted
    assert "times what pixel noise alone leaves" in other.stop
    other.fitted = loop.fitted._replace(faults=("The wand comes out 5 mm off.",))
    assert other.stop == ""
    assert other.contradictions == ("The wand comes out 5 mm off.",)


def test_the_volume_of_a_session_is_in_the_frame_of_the_first_camera(rig, data):
    box = Workspace.hull(rig.cameras[0].camera_from_world.apply(Workspace.from_box(rig.volume).vertices))
    loop = WandLoop(ForwardGP(wand=144.0), Wand(length=144.0), data.cameras, box, data=data)
    assert loop.calibration is not None
    camera = loop.calibration.cameras["cam1"].camera_from_world
    assert camera is not None
    there = camera.apply(loop.workspace.vertices)
    np.testing.assert_allclose(np.sort(there, axis=0)[[0, -1]], np.sort(box.vertices, axis=0)[[0, -1]], atol=20)
