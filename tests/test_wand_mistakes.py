"""What goes wrong with a wand: its ends exchanged, cameras out of step, groups of cameras that share nothing."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from implicam.calibrators import ForwardGP, ForwardGPCalibration
from implicam.calibrators.forward_gp.wand.exchanged import _minority
from implicam.calibrators.forward_gp.wand.waves import Waves
from implicam.dataset import Dataset
from implicam.errors import FitError, UsageError
from implicam.geometry import register
from implicam.rig_model import CameraViews, Image
from implicam.simulate import Rig, Target, as_wand, build_rig, random_positions, simulate, waved_wand
from implicam.verdict import judge


def exchange(data: Dataset, camera: int, share: float, seed: int = 0) -> tuple[Dataset, int]:
    """The markers of a wand exchanged in a share of the frames of a camera; and in how many that sees both."""
    uv = data.observations.uv.copy()
    rows: dict[str, list[int]] = {}
    for row, frame in enumerate(data.columns["frame"].tolist()):
        rows.setdefault(frame, []).append(row)
    both = [pair for pair in rows.values() if len(pair) == 2]
    chosen = np.random.default_rng(seed).permutation(len(both))[: round(share * len(both))]
    whole = 0
    for k in chosen:
        uv[both[k], camera] = uv[both[k][::-1], camera]
        whole += bool(np.isfinite(uv[both[k], camera]).all())
    return replace(data, observations=replace(data.observations, uv=uv)), whole


def error_of(rig: Rig, target: Target, recorded: Dataset, calibration: ForwardGPCalibration) -> float:
    """Rms error of new positions, over the limit."""
    row = {str(name): i for i, name in enumerate(recorded.points)}
    rows = [row[str(name)] for name in calibration.data.points]
    to_truth, _ = register(calibration.data.xyz, target.xyz[rows])
    held = simulate(rig, random_positions(rig, 200, np.random.default_rng(9)), seed=900)
    measured = calibration.measure(held.observations)
    assert held.truth is not None
    error = to_truth.apply(measured.xyz[measured.measured]) - held.truth.xyz[measured.measured]
    limit = np.trace(held.truth.limit[measured.measured], axis1=1, axis2=2).mean()
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1)) / limit))


def recorded_wand(spec: str, frames: int, **options: float) -> tuple[Rig, Target, Dataset, Dataset]:
    rig = build_rig(spec, seed=3)
    target = waved_wand(rig, frames, np.random.default_rng(4))
    recorded = simulate(rig, target, seed=4, **options)
    return rig, target, recorded, as_wand(recorded, target)


@pytest.mark.slow
@pytest.mark.parametrize(("spec", "share"), [("bar3", 0.15), ("bar3", 1.0), ("stereo", 1.0), ("stereo", 0.1)])
def test_exchanged_ends_are_put_right_and_named(spec: str, share: float) -> None:
    rig, target, recorded, data = recorded_wand(spec, 120, outliers=0.03)
    wrong, many = exchange(data, 1, share)
    calibration = ForwardGP(wand=target.wand or 0.0).fit(wrong)
    assert calibration.waved is not None
    found = dict(calibration.waved.exchanged)
    # of two cameras nobody knows which has them exchanged
    assert set(found) == {"cam2"} if spec == "bar3" else len(found) == 1
    assert 0.85 * many <= sum(found.values()) <= 1.02 * many
    assert any("bore each other's names" in note for note in calibration.notes)
    assert not calibration.fitted.uncalibrated
    assert error_of(rig, target, recorded, calibration) < 1.5


def test_right_ends_stay() -> None:
    _, target, _, data = recorded_wand("bar3", 60, outliers=0.1)
    calibration = ForwardGP(wand=target.wand or 0.0).fit(data)
    assert calibration.waved is not None
    assert calibration.waved.exchanged == ()


def test_the_fewer_are_exchanged_and_nothing_where_votes_contradict_each_other() -> None:
    def votes(*pairs: tuple[int, int, int]) -> np.ndarray:
        table = np.zeros((4, 4), dtype=np.int8)
        for i, j, vote in pairs:
            table[i, j] = table[j, i] = vote
        return table

    assert _minority(votes((0, 1, -1), (0, 2, -1), (1, 2, 1))).tolist() == [True, False, False, False]
    assert _minority(votes((0, 3, -1))).tolist() == [False, False, False, True]
    assert _minority(votes((0, 1, -1), (0, 2, 1), (1, 2, 1))).tolist() == [False] * 4


def test_views_keep_their_order_when_their_names_are_exchanged() -> None:
    views = CameraViews(np.array([0, 1, 3]), np.array([[0.0, 0], [1, 1], [3, 3]]), np.array([1.0, 2, 3]))
    none = np.zeros((2, 1), dtype=np.bool_)
    waves = Waves(
        np.arange(4).reshape(2, 2), (views,), (Image(np.zeros(2), 1.0),), np.array([np.nan]), 1.0, 0.1,
        np.ones(2, dtype=np.bool_), none, ("cam1",), ("1", "2"),
    )  # fmt: skip
    again = waves.all_exchanged(0)
    assert again.seen[0].rows.tolist() == [0, 1, 2]
    assert again.seen[0].uv[:, 0].tolist() == [1, 0, 3]
    assert again.seen[0].relative.tolist() == [2, 1, 3]
    assert again.exchanged.all()
    assert not again.all_exchanged(0).exchanged.any()


def swung(rig: Rig, frames: int, late: dict[str, float], *, speed: float = 1.0) -> tuple[Dataset, float]:
    """A wand that moves on as a hand does, seen by cameras some of which are late by so many frames."""

    def ends(time: np.ndarray) -> np.ndarray:
        t = 2 * np.pi * speed * time[:, None] / 90
        size = rig.volume.size
        middle = 0.27 * size * np.sin(t * [1.0, 1.37, 0.81] + [0.0, 1.0, 2.0])
        way = np.stack([np.sin(1.1 * t[:, 0]), np.cos(0.93 * t[:, 0]), np.sin(0.71 * t[:, 0] + 1)], axis=1)
        way *= length / np.linalg.norm(way, axis=1)[:, None]
        both = middle[:, None] + np.array([-0.5, 0.5])[:, None] * way[:, None]
        return rig.volume.world_from_box.apply(both.reshape(-1, 3))

    length = 0.45 * float(rig.volume.size.min())
    like = waved_wand(rig, frames, np.random.default_rng(0), length=length)
    number = np.arange(frames, dtype=np.float64)
    each = {}
    for shift in {0.0, *late.values()}:
        each[shift] = simulate(rig, replace(like, xyz=ends(number + shift)), seed=6)
    uv = np.stack(
        [each[late.get(camera.name, 0.0)].observations.uv[:, c] for c, camera in enumerate(rig.cameras)], axis=1
    )
    whole = each[0.0]
    merged = replace(whole, observations=replace(whole.observations, uv=uv))
    return as_wand(merged, like), length


@pytest.mark.slow
@pytest.mark.parametrize(("spec", "late"), [("bar4", 0.08), ("bar4", -0.1), ("stereo", 0.1), ("bar4", 0.0)])
def test_a_camera_a_little_late_is_named_with_its_offset(spec: str, late: float) -> None:
    """Situation of multicam_calibration issue 7: cameras that expose at about the same time."""
    rig = build_rig(spec, seed=3)
    data, length = swung(rig, 180, {"cam2": late})
    calibration = ForwardGP(wand=length).fit(data)
    assert calibration.waved is not None
    found = {camera: (frames, sd) for camera, frames, sd in calibration.waved.offsets}
    if not late:
        assert not found
        return
    assert set(found) == {"cam2"}
    frames, sd = found["cam2"]
    assert abs(frames - late) < max(5 * sd, 0.02)
    assert any("cam2 are taken" in note for note in calibration.notes)
    assert judge(calibration).word != "usable"


@pytest.mark.slow
@pytest.mark.parametrize(("late", "said"), [(7.0, "7 frames after"), (-0.4, "frames before")])
def test_a_camera_far_out_of_step_is_named_with_the_reason(late: float, said: str) -> None:
    """Situation of JARVIS issue 7 and calico issue 3: one film begins elsewhere than the others."""
    rig = build_rig("bar4", seed=3)
    data, length = swung(rig, 180, {"cam3": late})
    calibration = ForwardGP(wand=length).fit(data)
    assert any("cam3" in note and said in note for note in calibration.notes)


@pytest.mark.slow
def test_two_cameras_out_of_step_are_refused_with_the_offset() -> None:
    data, length = swung(build_rig("stereo", seed=3), 150, {"cam2": 2.0})
    with pytest.raises(FitError) as error:
        ForwardGP(wand=length).fit(data)
    said = re.search(r"the pictures of cam2 are taken about ([\d.]+) frames after those of cam1", error.value.why)
    assert said is not None
    assert float(said[1]) == pytest.approx(2, abs=0.2)


@pytest.mark.slow
def test_groups_of_cameras_that_hardly_share_the_wand_are_named() -> None:
    _, target, _, data = recorded_wand("bar6", 200)
    uv = data.observations.uv.copy()
    frame = np.array([int(name) for name in data.columns["frame"]])
    uv[np.ix_(frame <= 100, [3, 4, 5])] = np.nan  # two groups, one after the other
    uv[np.ix_(frame > 103, [0, 1, 2])] = np.nan
    apart = replace(data, observations=replace(data.observations, uv=uv))
    calibration = ForwardGP(wand=target.wand or 0.0).fit(apart)
    left = dict(calibration.fitted.uncalibrated)
    names = data.observations.camera_names
    assert len(left) == 3
    for c, why in left.items():
        assert "of the markers that the others place" in why
        assert any(f"With {names[other]} it shares" in why for other in left if other != c)


def test_two_cameras_that_share_nothing_are_named() -> None:
    _, target, _, data = recorded_wand("stereo", 60)
    uv = data.observations.uv.copy()
    frame = np.array([int(name) for name in data.columns["frame"]])
    uv[frame > 32, 0] = np.nan
    uv[frame < 28, 1] = np.nan
    with pytest.raises(FitError) as error:
        ForwardGP(wand=target.wand or 0.0).fit(replace(data, observations=replace(data.observations, uv=uv)))
    assert "cam1 and cam2, which share most, see 10 markers" in error.value.why


@pytest.mark.parametrize("given", [0.144, 14.4, 144000.0])
def test_a_length_in_another_unit_than_the_datasets_is_refused(given: float) -> None:
    """Situation of Pose2Sim issue 48 and Anipose issue 122: metres here and millimetres there."""
    _, target, _, data = recorded_wand("stereo", 30)
    assert target.wand == pytest.approx(144.0)
    with pytest.raises(UsageError) as error:
        ForwardGP(wand=given).fit(data)
    assert "144 mm" in error.value.what
    assert "another unit" in error.value.why


@pytest.mark.slow
def test_cameras_that_are_joined_in_a_chain_have_error_bars_that_hold() -> None:
    """Situation of caliscope issue 660: neighbours see the wand together, and no camera sees it with all others."""
    rig, target, recorded, data = recorded_wand("bar6", 240)
    uv = data.observations.uv.copy()
    frame = np.array([int(name) for name in data.columns["frame"]])
    for c in range(6):
        uv[np.abs(frame % 5 - c + 0.5) > 1, c] = np.nan  # in a frame two neighbours see it
    chain = replace(data, observations=replace(data.observations, uv=uv))
    calibration = ForwardGP(wand=target.wand or 0.0).fit(chain)
    row = {str(name): i for i, name in enumerate(recorded.points)}
    rows = [row[str(name)] for name in calibration.data.points]
    to_truth, _ = register(calibration.data.xyz, target.xyz[rows])
    held = simulate(rig, random_positions(rig, 200, np.random.default_rng(9)), seed=900)
    measured = calibration.measure(held.observations)
    good = measured.measured
    assert held.truth is not None
    error = to_truth.apply(measured.xyz[good]) - held.truth.xyz[good]
    cov = to_truth.rotation @ measured.cov[good] @ to_truth.rotation.T
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    assert good.mean() > 0.9
    assert np.mean(nees < 7.81) > 0.85


@pytest.mark.slow
def test_what_lies_outside_of_where_the_wand_was_has_larger_error_bars_that_hold() -> None:
    rig = build_rig("bar4", seed=5)
    small = replace(rig, volume=replace(rig.volume, size=0.4 * rig.volume.size))
    length = 0.5 * float(small.volume.size.min())
    target = waved_wand(small, 160, np.random.default_rng(4), length=length)
    recorded = simulate(rig, target, seed=4)
    calibration = ForwardGP(wand=length).fit(as_wand(recorded, target))
    row = {str(name): i for i, name in enumerate(recorded.points)}
    to_truth, _ = register(calibration.data.xyz, target.xyz[[row[str(name)] for name in calibration.data.points]])
    held = simulate(rig, random_positions(rig, 300, np.random.default_rng(9)), seed=900)
    measured = calibration.measure(held.observations)
    good = measured.measured
    assert held.truth is not None
    truth = held.truth.xyz[good]
    error = to_truth.apply(measured.xyz[good]) - truth
    cov = to_truth.rotation @ measured.cov[good] @ to_truth.rotation.T
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    inside = (np.abs(rig.volume.world_from_box.inverse().apply(truth)) < small.volume.size / 2).all(axis=1)
    size = np.sqrt(np.trace(cov, axis1=1, axis2=2))
    assert np.median(size[~inside]) > 1.5 * np.median(size[inside])
    assert np.mean(nees[~inside] < 7.81) > 0.85
    narrow = [note for note in calibration.notes if "saw the wand in" in note]
    assert len(narrow) == 4
    assert "of its picture (u from" in narrow[0]


@pytest.mark.slow
def test_a_wand_that_makes_a_rig_of_millimetres_is_asked_about() -> None:
    _, target, _, data = recorded_wand("stereo", 40)
    data = replace(data, extra={})
    notes = [ForwardGP(wand=length).fit(data).notes for length in ((target.wand or 0.0) / 1000, target.wand or 0.0)]
    asked = ["is that length in mm?" in " ".join(one) for one in notes]
    assert asked == [True, False]
