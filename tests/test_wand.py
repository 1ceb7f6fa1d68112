"""Cameras from a waved wand: two markers a known distance apart, at places nobody knows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2

from implicam.calibrators import ForwardGP, ForwardGPCalibration, load_calibration
from implicam.calibrators.forward_gp.wand.bundle import FrameEquations, Lengths, WhiteRows
from implicam.calibrators.forward_gp.wand.gauge import cameras_grow_with_the_world, cameras_move_with_the_world
from implicam.calibrators.forward_gp.wand.pairs import meet_two, pair_starts
from implicam.dataset import Dataset, read_dataset, write_dataset
from implicam.dataset.wand import Wand, marker_rows, wand_of
from implicam.derived import distances
from implicam.errors import DatasetError, FitError, UsageError
from implicam.geometry import Pose, register, rotation_from_vector
from implicam.rig_model import image_of
from implicam.simulate import Rig, Target, as_wand, build_rig, random_positions, simulate, waved_wand
from implicam.verdict import judge


class Waving(NamedTuple):
    """A simulated rig, the wand as it was waved, what was recorded with and without its truth, a calibration."""

    rig: Rig
    target: Target
    recorded: Dataset
    data: Dataset
    calibration: ForwardGPCalibration


def wave(spec: str, frames: int, seed: int, **options: float) -> Waving:
    rig = build_rig(spec, seed=seed)
    target = waved_wand(rig, frames, np.random.default_rng(seed))
    recorded = simulate(rig, target, seed=seed, **options)
    data = as_wand(recorded, target)
    return Waving(rig, target, recorded, data, ForwardGP(wand=target.wand or 0.0).fit(data))


@pytest.fixture(scope="module")
def waving() -> Waving:
    return wave("bar3", 70, 3, outliers=0.05, missing=0.1)


def true_rows(waving: Waving) -> list[int]:
    """Of the known points of the calibration, in the recording."""
    row = {str(name): i for i, name in enumerate(waving.recorded.points)}
    return [row[str(name)] for name in waving.calibration.data.points]


def judged(waving: Waving, n: int = 300) -> tuple[float, float, float]:
    """Rms error over the limit, share in the 95 % ellipsoids, mean NEES of positions measured anew."""
    rig, calibration = waving.rig, waving.calibration
    held = simulate(rig, random_positions(rig, n, np.random.default_rng(9)), seed=900)
    to_truth, _ = register(calibration.data.xyz, waving.target.xyz[true_rows(waving)])
    measured = calibration.measure(held.observations)
    good = measured.measured
    assert held.truth is not None
    error = to_truth.apply(measured.xyz[good]) - held.truth.xyz[good]
    cov = to_truth.rotation @ measured.cov[good] @ to_truth.rotation.T
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    limit = np.trace(held.truth.limit[good], axis1=1, axis2=2).mean()
    return (
        float(np.sqrt(np.mean(np.sum(error**2, axis=1)) / limit)),
        float(np.mean(nees < chi2.ppf(0.95, 3))),
        float(np.mean(nees)),
    )


def test_positions_are_nearly_as_exact_as_perfect_cameras_would_have_them(waving: Waving) -> None:
    ratio, inside, nees = judged(waving)
    assert ratio < 1.35
    assert inside > 0.88
    assert 2 < nees < 4.5


def test_wrong_views_are_not_used(waving: Waving) -> None:
    wrong = np.asarray(waving.recorded.observations.extra["outlier"]) == "1"
    rejected = {(view.point, view.camera) for view in waving.calibration.rejected}
    names = waving.data.observations.camera_names
    known = waving.calibration.data
    mine = wrong[true_rows(waving)]
    views = {(str(known.points[i]), names[c]) for i, c in np.argwhere(mine)}
    assert wrong.sum() >= 10
    assert views <= rejected


def test_the_world_is_laid_over_the_wand(waving: Waving) -> None:
    calibration = waving.calibration
    assert np.linalg.norm(calibration.data.xyz.mean(axis=0)) < 5  # of 240 mm: the middle of all, and not of those known
    first = calibration.cameras["cam1"].camera_from_world
    assert np.allclose(first.rotation, np.eye(3), atol=0.02)
    assert "of cam1 (x right, y down, z forward)" in calibration.notes[0]


def test_lengths_come_out_as_their_standard_uncertainties_say(waving: Waving) -> None:
    waved = waving.calibration.waved
    assert waved is not None
    assert len(waved.errors) > 40
    assert 0.7 < np.sqrt(np.mean((waved.errors / waved.sds) ** 2)) < 1.4
    assert set(waving.calibration.summary().leave_one_out_rms) == {"length"}


def test_a_file_measures_the_same(waving: Waving, tmp_path: Path) -> None:
    path = tmp_path / "wand.implicam"
    waving.calibration.save(path)
    again = load_calibration(path)
    few = waving.data.select(np.arange(20))
    one, two = waving.calibration.measure(few), again.measure(few)
    np.testing.assert_array_equal(one.xyz, two.xyz)
    np.testing.assert_array_equal(one.cov, two.cov)
    assert again.notes == waving.calibration.notes
    assert again.unused == waving.calibration.unused
    assert again.summary() == waving.calibration.summary()


def test_cameras_move_and_grow_with_the_world(waving: Waving) -> None:
    models = waving.calibration.posterior.models
    rng, middle, h = np.random.default_rng(0), np.array([0.1, -0.2, 0.3]), 1e-4
    x = rng.normal(size=(5, 3))
    turned, shift = cameras_move_with_the_world(models, middle), rng.normal(size=6)
    there = middle + (x - middle) @ rotation_from_vector(h * shift[:3]).T + h * shift[3:]
    grown = middle + (1 + h) * (x - middle)
    by_motion, by_growth = np.zeros(0), np.zeros(0)
    start = 0
    for model in models:
        own = slice(start, start + model.camera.size)
        start += model.size
        moved = model.camera.moved(h * turned[own] @ shift)
        larger = model.camera.moved(h * cameras_grow_with_the_world(models, middle)[own])
        before = model.camera.pixel(x)
        by_motion = np.append(by_motion, moved.pixel(there) - before)
        by_growth = np.append(by_growth, larger.pixel(grown) - before)
    assert np.abs(by_motion).max() < 1e-4  # px, where points move by a hundred thousandth of the volume and more
    assert np.abs(by_growth).max() < 1e-4


@pytest.mark.slow
def test_no_known_point_can_be_held_out(waving: Waving) -> None:
    with pytest.raises(UsageError, match="made from a wand"):
        waving.calibration.refit(waving.calibration.data)
    with pytest.raises(UsageError, match="made from a wand"):
        waving.calibration.refit_from(waving.calibration.data)
    assert judge(waving.calibration).held_out is None


@pytest.mark.slow
def test_lengths_of_frames_that_were_left_out_judge_it(waving: Waving) -> None:
    held_out = waving.calibration.hold_lengths_out()
    assert len(held_out.errors) >= 15
    squares = (held_out.errors / held_out.sds) ** 2
    assert 0.2 < squares.mean() < 2.5  # the mean of fifteen squares: 1 +- 0.37
    waved = waving.calibration.waved
    assert waved is not None
    assert judge(waving.calibration).word == "usable"
    few = replace(waved, errors=waved.errors[:19], sds=waved.sds[:19])
    (reason,) = judge(replace(waving.calibration, waved=few)).reasons
    assert "in 19 frames only" in reason
    longer = replace(waved, wand=waved.wand._replace(length=1.05 * waved.wand.length))
    verdict = judge(replace(waving.calibration, waved=longer))
    assert verdict.word == "not usable"
    assert "frames that a fit did not know" in verdict.reasons[0]


def test_a_folder_says_what_the_wand_is(waving: Waving, tmp_path: Path) -> None:
    write_dataset(waving.data, tmp_path / "wand")
    again = read_dataset(tmp_path / "wand")
    assert wand_of(again) == wand_of(waving.data)
    assert again.columns["marker"].tolist() == waving.data.columns["marker"].tolist()
    frames, rows = marker_rows(again, ("a", "b"))
    assert again.points[rows[0, 0]] == f"{frames[0]} a"


def test_single_points_are_frames_of_one_marker() -> None:
    names = np.array(["1 a", "1 b", "1 dot", "2 b"])
    columns = {"frame": np.array(["1", "1", "1", "2"]), "marker": np.array(["a", "b", "dot", "b"])}
    data = replace(
        Dataset.from_arrays(np.zeros((4, 2, 2)) + np.arange(4)[:, None, None], points=names), columns=columns
    )
    frames, rows = marker_rows(data, ("b", "a"))
    assert frames == ["1", "2", "1"]
    assert rows.tolist() == [[1, 0], [3, -1], [2, -1]]
    with pytest.raises(DatasetError, match="has 3 markers"):
        marker_rows(data, ())
    with pytest.raises(DatasetError, match="no marker 'c'"):
        marker_rows(data, ("a", "c"))
    with pytest.raises(DatasetError, match="does not say which"):
        marker_rows(replace(data, columns={}), ())
    twice = replace(data, columns={**columns, "marker": np.array(["a", "a", "dot", "b"])})
    with pytest.raises(DatasetError, match="'a' is twice in frame '1'"):
        marker_rows(twice, ("a", "b"))


def test_what_makes_no_sense_is_refused(waving: Waving) -> None:
    with pytest.raises(UsageError, match="length of the wand is not known"):
        ForwardGP().fit(replace(waving.data, extra={"target": {"kind": "wand"}}))
    with pytest.raises(UsageError, match="markers are not known"):
        ForwardGP(wand=96).fit(waving.recorded)
    with pytest.raises(UsageError, match="it is a length"):
        ForwardGP(wand=-1.0)
    with pytest.raises(UsageError, match="two ends"):
        ForwardGP(wand=1.0, wand_ends="a")
    with pytest.raises(DatasetError, match="must be a length"):
        wand_of(replace(waving.data, extra={"target": {"kind": "wand", "length": "long"}}))
    with pytest.raises(FitError, match="no two cameras"):
        ForwardGP(wand=96).fit(waving.data.select(np.arange(8)))


def test_a_wand_that_does_not_fit_is_not_waved() -> None:
    rig = build_rig("bar3", seed=1)
    with pytest.raises(UsageError, match="does not fit"):
        waved_wand(rig, 3, np.random.default_rng(0), length=1000.0)


def test_eliminated_frames_give_the_answer_of_the_whole_system() -> None:
    rng = np.random.default_rng(0)
    white = [
        WhiteRows(np.arange(4), rng.normal(size=(4, 2)), rng.normal(size=(4, 2, 3)), rng.normal(size=(4, 2, 3)))
        for _ in range(3)
    ]
    places = rng.normal(size=(2, 2, 3))
    lengths = Lengths(np.array([0, 1]), 1.0, np.array([0.1, 0.2]))
    found = FrameEquations.of(white, 2, (lengths.frames, *lengths.linear(places)))
    whole = np.zeros((9 + 12, 9 + 12))
    whole[:9, :9], right = found.A, np.concatenate([found.b, found.g.ravel()])
    for f in range(2):
        part = slice(9 + 6 * f, 15 + 6 * f)
        whole[part, part], whole[part, :9], whole[:9, part] = found.H[f], found.G[f], found.G[f].T
    _, G, g = found.halved()
    cameras = np.linalg.solve(found.A - G.T @ G, found.b - G.T @ g)
    np.testing.assert_allclose(cameras, np.linalg.solve(whole, right)[:9], rtol=1e-6)


def test_two_cameras_start_from_no_guess() -> None:
    rig = build_rig("stereo", seed=5)
    target = waved_wand(rig, 60, np.random.default_rng(5))
    recorded = simulate(rig, target, seed=5, outliers=0.1)
    uv, observations = recorded.observations.uv, recorded.observations
    rows = np.arange(len(uv))
    lengths = np.full(len(uv), target.wand)
    best = pair_starts(uv, rows // 2, rows % 2, [image_of(observations, c) for c in range(2)], lengths)[0]
    assert best.px < 1.0
    assert best.spread < 0.2
    assert 0.6 < best.cameras[0].lens.fx / rig.cameras[0].lens.fx < 1.6
    base = np.linalg.norm(best.cameras[1].pose.translation)
    assert base == pytest.approx(240.0, rel=0.4)


def test_lines_of_sight_meet_where_the_point_is() -> None:
    second = Pose(rotation_from_vector([0.1, -0.3, 0.05]), np.array([-1.0, 0.2, 0.3]))
    x = np.array([[0.2, -0.1, 3.0], [0.5, 0.4, 5.0]])
    seen = np.stack([x, second.apply(x)])
    found, before = meet_two(seen / np.linalg.norm(seen, axis=2, keepdims=True), second)
    np.testing.assert_allclose(found, x, atol=1e-12)
    assert before.all()
    assert Wand(("a", "b"), 2.0).as_table() == {"kind": "wand", "ends": ["a", "b"], "length": 2.0}


@pytest.mark.slow
def test_the_error_of_the_wand_itself_is_the_same_part_of_every_distance(waving: Waving) -> None:
    L = waving.target.wand or 0.0
    unsure = ForwardGP(wand=L, wand_sd=0.002 * L).fit(waving.data)
    held = simulate(waving.rig, random_positions(waving.rig, 12, np.random.default_rng(9)), seed=900)
    rows = [(0, i) for i in range(1, 12)]
    found = (distances(one.measure(held.observations), rows) for one in (waving.calibration, unsure))
    for one, two in zip(*found, strict=True):
        assert two.value == pytest.approx(one.value, abs=0.05 * one.sd)
        assert two.sd**2 == pytest.approx(one.sd**2 + (0.002 * one.value) ** 2, rel=0.02)


@pytest.mark.slow
def test_a_camera_whose_markers_are_exchanged_is_put_right_and_named() -> None:
    rig = build_rig("bar3", seed=3)
    target = waved_wand(rig, 70, np.random.default_rng(3))
    recorded = simulate(rig, target, seed=3)
    uv = recorded.observations.uv.copy()
    uv[0::2, 1], uv[1::2, 1] = recorded.observations.uv[1::2, 1], recorded.observations.uv[0::2, 1]
    whole = np.isfinite(uv).all(axis=2).reshape(-1, 2, 3).all(axis=1).repeat(2, axis=0)
    uv[~whole] = np.nan
    observations = replace(recorded.observations, uv=uv, extra={})
    calibration = ForwardGP(wand=target.wand or 0.0).fit(as_wand(replace(recorded, observations=observations), target))
    assert calibration.camera_names == ("cam1", "cam2", "cam3")
    assert any(
        "pictures of cam2 the two ends of the wand bore each other's names" in note for note in calibration.notes
    )


@pytest.mark.slow
@pytest.mark.parametrize("spec", ["stereo", "bar6", "dome4"])
def test_rigs_from_no_guess_with_wrong_and_missing_views(spec: str) -> None:
    ratio, inside, nees = judged(wave(spec, 200, 7, outliers=0.1, missing=0.3))
    assert ratio < (1.6 if spec == "stereo" else 1.25)
    assert inside > 0.85
    assert nees < 5


@pytest.mark.slow
def test_a_camera_with_more_noise_than_the_others_counts_less_though_nothing_says_so() -> None:
    rig = build_rig("bar3", seed=11)
    sds = (0.15, 0.45, 0.15)
    rig = replace(rig, cameras=tuple(replace(one, noise_sd=sd) for one, sd in zip(rig.cameras, sds, strict=True)))
    target = waved_wand(rig, 150, np.random.default_rng(11))
    data = as_wand(simulate(rig, target, seed=11, outliers=0.05), target)
    data = replace(data, observations=replace(data.observations, sd=np.full_like(data.observations.uv, np.nan)))
    calibration = ForwardGP(wand=target.wand or 0.0).fit(data)
    noise = [model.noise for model in calibration.posterior.models]
    assert noise == pytest.approx(sds, rel=0.35)
