"""explicit:paper: the paper's pipeline with OpenCV, against OpenCV itself, SciPy and the truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from implicam.calibrators import calibrator, load_calibration
from implicam.calibrators.explicit import Explicit, ExplicitCalibration, opencv_pipeline, rig_of
from implicam.calibrators.explicit.adjust import Bundle
from implicam.calibrators.explicit.boards import boards_of
from implicam.calibrators.explicit.opencv_pipeline import OpenCVRig, calibrate_with_opencv
from implicam.calibrators.explicit.paper_preset import triangulated
from implicam.compare import Split, fit_each, judge
from implicam.dataset import Dataset
from implicam.errors import CalibrationFileError, FitError, UsageError
from implicam.evaluation import evaluate
from implicam.lenses import BrownConrady, KannalaBrandt
from implicam.progress import silent
from implicam.simulate import Rig, build_rig, each_and_pairs, random_positions, simulate, simulate_boards


@cache
def rig() -> Rig:
    return build_rig("bar6", seed=2, frame="random", lens_error=0.0, cameras="2R2W")


@cache
def boards() -> Dataset:
    return simulate_boards(rig(), each_and_pairs(rig(), 10, 4), seed=3)


def points(n: int, seed: int) -> Dataset:
    return simulate(rig(), random_positions(rig(), n, np.random.default_rng(seed)), seed=seed)


@cache
def calibration(variant: str) -> ExplicitCalibration:
    found = calibrator(f"explicit:{variant}", boards=boards()).fit(points(60, 5))
    assert isinstance(found, ExplicitCalibration)
    return found


@cache
def by_opencv(joint: bool = False) -> OpenCVRig:
    return calibrate_with_opencv(boards_of(boards()), "auto", joint, silent)


both = pytest.mark.parametrize("variant", ["paper", "paper-bundle"])


@pytest.mark.slow
@both
def test_it_measures_near_the_limit_with_error_bars_that_are_of_the_right_size(variant: str) -> None:
    others = points(300, 6)
    judged = evaluate(calibration(variant), others).coverage.overall
    assert judged.rmse_over_limit < 1.2
    assert 0.85 < judged.level(0.95).ellipsoid.value <= 1


def test_wide_lenses_go_through_the_fisheye_interface_and_regular_ones_do_not() -> None:
    kinds = [type(camera.lens) for camera in by_opencv().bundle.cameras]
    assert kinds == [BrownConrady, BrownConrady, KannalaBrandt, KannalaBrandt]
    assert by_opencv().reference == 0


def test_the_lens_is_that_of_opencv_from_the_pictures_of_the_camera_alone() -> None:
    data = boards_of(boards())
    counts = np.bincount([view.board for view in data.views])
    own = [view for view in data.of_camera(1) if counts[view.board] == 1]
    assert len(own) == 10
    _, K, D, *_ = cv2.calibrateCamera(
        [view.xyz.astype(np.float32) for view in own], [view.uv.astype(np.float32) for view in own],
        (1280, 800), None, None,
    )  # fmt: skip
    lens = by_opencv().bundle.cameras[1].lens
    assert isinstance(lens, BrownConrady)
    np.testing.assert_allclose([lens.fx, lens.fy, lens.cx, lens.cy], [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], rtol=1e-6)
    np.testing.assert_allclose([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3], D.ravel()[:5], rtol=1e-4, atol=1e-6)


def test_cameras_are_where_they_are() -> None:
    first = rig().cameras[0].camera_from_world
    for camera, found in zip(rig().cameras, by_opencv().bundle.cameras, strict=True):
        truth = camera.camera_from_world @ first.inverse()
        np.testing.assert_allclose(found.pose.translation, truth.translation, atol=3.0)
        np.testing.assert_allclose(found.pose.rotation, truth.rotation, atol=5e-3)


def test_two_cameras_triangulate_as_opencv_does() -> None:
    found = calibration("paper")
    models = found.map.posterior.models[:2]
    uv = points(40, 7).observations.uv[:, :2]
    xyz, _, _, used = triangulated(models, 0, uv)
    assert used.all()
    a, b = (model.camera for model in models)
    normalised = []
    for camera, pixels in zip((a, b), uv.swapaxes(0, 1), strict=True):
        rays, _ = camera.lens.ray_from_pixel(pixels)
        normalised.append((rays[:, :2] / rays[:, 2:]).T.copy())
    second = b.pose @ a.pose.inverse()
    P = np.column_stack([second.rotation, second.translation])
    theirs = cv2.triangulatePoints(np.eye(3, 4), P, *normalised)
    np.testing.assert_allclose(xyz, a.pose.inverse().apply((theirs[:3] / theirs[3]).T), atol=1e-9)


@pytest.mark.slow
def test_the_joint_adjustment_ends_where_scipy_ends() -> None:
    """A few pictures of two cameras; every corner counts the same."""
    small = build_rig("bar6", seed=4, cameras="2R")
    data = boards_of(simulate_boards(small, [("cam2", "cam3")] * 6, seed=5))
    ours = calibrate_with_opencv(data, "auto", True, silent)
    start = replace(calibrate_with_opencv(data, "auto", False, silent).bundle, noise=np.ones(2))
    free = np.flatnonzero(np.concatenate([start.free, np.ones(6 * len(start.boards.translation), dtype=bool)]))
    scale = np.ones(len(free))

    def moved(step: np.ndarray) -> Bundle:
        every = np.zeros(start.starts[-1] + 6 * len(start.boards.translation))
        every[free] = step * scale
        return start.moved(every[: start.starts[-1]], every[start.starts[-1] :].reshape(-1, 6))

    def residuals(step: np.ndarray) -> np.ndarray:
        bundle = moved(step)
        return np.concatenate([bundle.residuals(c).ravel() for c in range(2)])

    found = least_squares(residuals, np.zeros(len(free)), x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    squares = sum(float(np.sum(ours.bundle.residuals(c) ** 2)) for c in range(2))
    assert squares == pytest.approx(2 * found.cost, rel=1e-5)
    assert squares < float(np.sum(residuals(np.zeros(len(free))) ** 2))


def test_adjusting_lowers_the_reprojection_error() -> None:
    assert 0.25 < by_opencv(True).reprojection < by_opencv().reprojection < 0.4


@both
def test_a_saved_one_measures_the_same(variant: str, tmp_path: Path) -> None:
    calibration(variant).save(tmp_path / "rig.implicam")
    loaded = load_calibration(tmp_path / "rig.implicam")
    others = points(20, 8).observations
    before, after = calibration(variant).measure(others), loaded.measure(others)
    np.testing.assert_array_equal(before.xyz, after.xyz)
    np.testing.assert_array_equal(before.cov, after.cov)
    assert isinstance(loaded, ExplicitCalibration)
    assert loaded.calibrator.preset == variant
    assert loaded.fitted.reprojection == calibration(variant).fitted.reprojection
    assert loaded.notes == calibration(variant).notes


@pytest.mark.parametrize(
    "changes", [{"inflation": 0.5}, {"reference": 9}, {"preset": "joint"}, {"inflation": "x"}, {"preset": "papers"}]
)
def test_a_damaged_file_is_refused(changes: dict[str, Any]) -> None:
    table, arrays = calibration("paper").state()
    with pytest.raises((ValueError, UsageError)):
        ExplicitCalibration.from_state(points(60, 5), {**table, **changes}, arrays)


def test_points_that_cannot_be_measured_keep_their_rows() -> None:
    data = points(8, 9)
    uv = data.observations.uv.copy()
    uv[0, 1:] = np.nan
    uv[1] = np.nan
    uv[2, 0] = np.nan
    uv[3, :2], uv[3, 2:] = ((10, 400), (1270, 400)), np.nan  # to the left and to the right: they meet behind
    seen = replace(data.observations, uv=uv, sd=np.full(uv.shape, np.nan))
    measured = calibration("paper").measure(seen)
    assert len(measured) == 8
    assert "only cam2 saw it" in str(measured.reason[0])
    assert str(measured.reason[1]) == "no camera saw it"
    assert "in front of" in str(measured.reason[3])
    assert measured.measured.tolist() == [False, False, True, False, *[True] * 4]
    assert measured.views.tolist() == [0, 0, 3, 0, *[4] * 4]
    np.testing.assert_array_equal(np.isnan(measured.cov[:, 0, 0]), ~measured.measured)
    empty = calibration("paper").measure(seen.select(np.zeros(0, dtype=np.int64)))
    assert empty.xyz.shape == (0, 3)


def test_the_unit_of_the_known_points_is_that_of_the_answer() -> None:
    known, others = points(30, 5), points(20, 6).observations
    metres = replace(
        known, length_unit="m", known=replace(known.positions, xyz=known.xyz / 1000, sd=known.positions.sd / 1000)
    )
    method = calibration("paper").calibrator
    in_mm, in_m = method.fit(known).measure(others), method.fit(metres).measure(others)
    np.testing.assert_allclose(1000 * in_m.xyz, in_mm.xyz, atol=0.01)
    np.testing.assert_allclose(1e6 * in_m.cov, in_mm.cov, rtol=1e-2)


@pytest.mark.slow
def test_it_is_compared_with_the_others_and_given_to_other_programs() -> None:
    fit = calibration("paper")
    train, held_out = points(60, 5).split(40, seed=0)
    [(again, seconds)] = fit_each(fit.calibrator, [train])
    trial = judge("explicit:paper", Split("ball", train, held_out, 0), again, seconds)
    assert not trial.failure
    assert trial.rmse < 1
    names = [camera.name for camera in rig_of(fit)[0].cameras]  # as OpenCV found them, for other programs
    assert names == ["cam2", "cam3", "cam4", "cam5"]


def test_without_boards_or_known_points_it_says_what_it_takes() -> None:
    with pytest.raises(UsageError, match="takes pictures of a board and known positions"):
        calibrator("explicit", preset="paper").fit(points(30, 5))
    with pytest.raises(UsageError, match="takes pictures of a board and known positions"):
        calibrator("explicit", preset="paper", boards=boards()).fit(boards())
    with pytest.raises(UsageError, match="did you mean 'paper'"):
        calibrator("explicit", preset="papers")


def shots(data: Dataset) -> np.ndarray:
    return np.array([str(point).rpartition("-")[0] for point in data.points])


def test_too_few_boards_are_told() -> None:
    few = boards().select(np.flatnonzero(np.isin(shots(boards()), np.unique(shots(boards()))[:2])))
    with pytest.raises(FitError, match="0 of 4 cameras can be calibrated together") as caught:
        calibrator("explicit:paper", boards=few).fit(points(30, 5))
    assert "of the 3 boards that it takes" in caught.value.why


def test_a_camera_that_no_pair_leads_to_is_left_out_with_the_reason() -> None:
    uv = boards().observations.uv.copy()
    uv[np.isfinite(uv).all(axis=2).sum(axis=1) > 1, 3] = np.nan
    alone = replace(boards(), observations=replace(boards().observations, uv=uv, sd=np.full(uv.shape, np.nan)))
    notes = calibrator("explicit:paper", boards=alone).fit(points(30, 5)).notes
    assert any("cam5 is not calibrated" in note and "no chain of pairs" in note for note in notes)


def test_a_fisheye_calibration_that_fails_names_camera_and_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any, **__: Any) -> None:
        raise cv2.error("fabs(norm_u1) > 0")

    monkeypatch.setattr(cv2.fisheye, "calibrate", fails)
    notes = calibrator("explicit:paper", boards=boards()).fit(points(30, 5)).notes
    for name in ("cam4", "cam5"):
        assert any(f"{name} is not calibrated" in note and "cv2.fisheye.calibrate fails" in note for note in notes)
    wide = build_rig("bar6", seed=2, lens_error=0.0, cameras="cam4,cam5")
    with pytest.raises(FitError, match="0 of 2 cameras") as caught:
        calibrator("explicit:paper", boards=boards().with_cameras(("cam4", "cam5"))).fit(
            simulate(wide, random_positions(wide, 20, np.random.default_rng(1)), seed=1)
        )
    assert "norm_u1" in caught.value.why


def test_two_wide_cameras_are_a_pair_of_the_fisheye_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    called = list[int]()
    stereo = cv2.fisheye.stereoCalibrate

    def counted(*arguments: Any, **options: Any) -> Any:
        called.append(1)
        return stereo(*arguments, **options)

    monkeypatch.setattr(cv2.fisheye, "stereoCalibrate", counted)
    wide = build_rig("bar6", seed=2, lens_error=0.0, cameras="cam4,cam5")
    data = simulate_boards(wide, each_and_pairs(wide, 10, 5), seed=3)
    found = calibrate_with_opencv(boards_of(data), "auto", False, silent)
    assert called == [1]
    truth = wide.cameras[1].camera_from_world @ wide.cameras[0].camera_from_world.inverse()
    np.testing.assert_allclose(found.bundle.cameras[1].pose.translation, truth.translation, atol=3.0)


def test_pictures_that_fisheye_leaves_far_off_are_taken_out_and_told() -> None:
    uv = boards().observations.uv.copy()
    first = shots(boards()) == next(
        shot
        for shot in np.unique(shots(boards()))
        if np.isfinite(uv[shots(boards()) == shot]).all(axis=2).any(axis=0).tolist() == [False, False, True, False]
    )
    uv[first, 2] += np.random.default_rng(0).normal(scale=15, size=uv[first, 2].shape)
    spoilt = replace(boards(), observations=replace(boards().observations, uv=uv, sd=np.full(uv.shape, np.nan)))
    found = calibrate_with_opencv(boards_of(spoilt), "auto", False, silent)
    assert found.cameras == (0, 1, 2, 3)
    assert any("cam4: 1 picture" in note for note in found.notes)


def test_known_points_of_another_rig_are_refused() -> None:
    known = points(30, 5)
    other = replace(known, known=replace(known.positions, xyz=known.xyz[::-1]))
    with pytest.raises((FitError, UsageError)):
        Explicit(preset="paper", boards=boards()).fit(other)
    matched = calibration("paper").calibrator.fit(other)  # closest points ask nobody for names
    assert np.sqrt(np.mean(np.sum((matched.measure(known.observations).xyz - known.xyz) ** 2, axis=1))) < 1


def test_a_wrong_file_is_not_read_as_one(tmp_path: Path) -> None:
    path = tmp_path / "rig.implicam"
    calibration("paper").save(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CalibrationFileError):
        load_calibration(path)


@pytest.mark.slow
def test_lenses_that_opencv_does_not_have_are_refused() -> None:
    assert opencv_pipeline.FAMILIES == ("brown-conrady", "kannala-brandt")
    method = Explicit(lens="kannala-brandt", preset="paper", boards=boards().with_cameras(("cam2", "cam3")))
    kinds = {
        type(camera.lens) for camera in rig_of(method.fit(points(30, 5).with_cameras(("cam2", "cam3"))))[0].cameras
    }
    assert kinds == {KannalaBrandt}
