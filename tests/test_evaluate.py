"""Nothing is judged by what it has learned; threads keep order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from implicam import demo
from implicam.calibrators import Calibration, ForwardGP, InverseGP
from implicam.dataset import Dataset, KnownPositions, Observations, join
from implicam.errors import DatasetError, FitError, UsageError
from implicam.evaluation import cross_validate, evaluate, leave_out_shots
from implicam.measurement import Measurement
from implicam.progress import Progress, silent
from implicam.simulate import Rig, build_rig, moving_board, random_positions, simulate


@cache
def rig() -> Rig:
    return build_rig("bar6", seed=5, cameras="2R2W")


@cache
def sets() -> tuple[Dataset, Dataset]:
    known = random_positions(rig(), 80, np.random.default_rng(1))
    others = random_positions(rig(), 150, np.random.default_rng(2))
    return complete(simulate(rig(), known, seed=1)), complete(simulate(rig(), others, seed=2))


@cache
def fitted() -> Calibration:
    return InverseGP().fit(sets()[0])


@cache
def board() -> Dataset:
    return simulate(rig(), moving_board(rig(), corners=(3, 4), positions=6), seed=3)


def complete(data: Dataset) -> Dataset:
    return data.select(data.observations.seen.all(axis=1))


def renamed(data: Dataset, names: Sequence[str]) -> Dataset:
    return replace(data, observations=replace(data.observations, points=np.array(names)))


def with_uv(data: Dataset, uv: np.ndarray) -> Dataset:
    return replace(data, observations=Observations(data.points, data.cameras, uv, np.full(uv.shape, np.nan)))


def without_truth(data: Dataset) -> Dataset:
    return replace(data, known=KnownPositions(data.shots, data.xyz, np.full((len(data), 3), np.nan)))


@dataclass(frozen=True)
class Distorted:
    """A calibration whose covariance is multiplied: it must be found out."""

    calibration: Calibration
    factor: float
    method: str = "distorted"

    def __getattr__(self, name: str) -> Any:
        return getattr(self.calibration, name)

    def measure(self, observations: Observations) -> Measurement:
        measured = self.calibration.measure(observations)
        return replace(measured, cov=measured.cov * self.factor)


# evaluate


def test_points_of_the_fit_are_left_out() -> None:
    known, others = sets()
    evaluation = evaluate(fitted(), join(known, renamed(others, [f"new{i}" for i in range(len(others))])))
    np.testing.assert_array_equal(evaluation.data.xyz, others.xyz)
    assert len(evaluation.measurement) == len(evaluation.true_xyz) == evaluation.coverage.overall.n == len(others)
    assert f"{len(others)} points not used in the fit; {len(known)} of this dataset were" in evaluation.how
    np.testing.assert_array_equal(evaluation.known_xyz, known.xyz)


def test_a_point_of_the_fit_is_known_by_its_pixels() -> None:
    known, others = sets()
    n = len(known)
    fresh = others.select(np.arange(n))
    same_names = renamed(fresh, [str(name) for name in known.points])  # another recording counts its points from 1, too
    assert len(evaluate(fitted(), same_names).data) == n
    with pytest.raises(DatasetError, match="were used to fit"):  # a CSV without names numbers its rows anew
        evaluate(fitted(), renamed(known, [f"p{i}" for i in range(n)]))
    half = with_uv(known, np.where(np.arange(n)[:, None, None] < n // 2, known.observations.uv, fresh.observations.uv))
    assert len(evaluate(fitted(), half).data) == n - n // 2


def test_a_point_of_the_fit_is_found_whatever_the_cameras_order() -> None:
    known, others = sets()
    turned = join(known, renamed(others, [f"new{i}" for i in range(len(others))]))
    turned = turned.with_cameras(turned.observations.camera_names[::-1])
    assert len(evaluate(fitted(), turned).data) == len(others)


def test_points_kept_out_of_the_fit_for_missing_views_are_no_test_either() -> None:
    known = sets()[0]
    uv = known.observations.uv.copy()
    uv[4, 1] = np.nan
    holes = with_uv(known, uv)
    with pytest.raises(DatasetError, match="were used to fit"):
        evaluate(InverseGP().fit(holes), holes)


def test_a_dataset_that_was_all_learned_from_is_refused() -> None:
    with pytest.raises(DatasetError, match=r"all \d+ points of 'bar6-random' were used to fit") as caught:
        evaluate(fitted(), sets()[0])
    assert "--cv 10" in caught.value.fix


def test_a_dataset_without_known_positions_is_refused() -> None:
    with pytest.raises(DatasetError, match="no known positions"):
        evaluate(fitted(), replace(sets()[1], known=None))


def test_a_dataset_in_another_unit_is_refused() -> None:
    with pytest.raises(DatasetError, match="is in m, and the calibration is in mm"):
        evaluate(fitted(), replace(sets()[1], length_unit="m"))


def test_a_dataset_that_lacks_a_camera_is_refused() -> None:
    with pytest.raises(DatasetError, match="have no camera 'cam4'"):
        evaluate(fitted(), sets()[1].without(["cam4"]))


def test_the_truth_is_used_where_it_is_known() -> None:
    others = sets()[1]
    off = np.array([0.7, 0.0, 0.0])  # what the dataset believes is wrong; the truth beside it is not
    believed = replace(others, known=replace(others.known, xyz=others.xyz + off))
    evaluation = evaluate(fitted(), believed)
    assert evaluation.against == "the simulated truth"
    np.testing.assert_array_equal(evaluation.true_xyz, others.truth.xyz)
    assert evaluation.coverage.overall.rmse_over_limit > 1

    evaluation = evaluate(fitted(), without_truth(believed))
    assert evaluation.against == "the known positions"
    error = evaluation.measurement.xyz - believed.xyz
    assert evaluation.coverage.overall.rmse == pytest.approx(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    assert evaluation.coverage.overall.rmse_axes[0] > 0.6
    assert np.isnan(evaluation.coverage.overall.rmse_over_limit)


def test_fewer_cameras_in_the_calibration_than_in_the_dataset() -> None:
    known, others = sets()
    evaluation = evaluate(InverseGP().fit(known.with_cameras(["cam3", "cam2"])), others)
    assert evaluation.data.observations.camera_names == ("cam3", "cam2")
    assert (evaluation.measurement.views == 2).all()
    assert np.isnan(evaluation.coverage.overall.rmse_over_limit)  # the limit in the file is that of four cameras
    assert evaluation.coverage.overall.rmse > evaluate(fitted(), others).coverage.overall.rmse


def test_regions_by_depth_and_by_number_of_views() -> None:
    others = sets()[1]
    groups = {(row.group, row.region): row for row in evaluate(fitted(), others).coverage.rows}
    assert list(groups) == [("all", "all points"), *(("depth", name) for name in ("near", "middle", "far"))]
    assert sum(groups["depth", name].n for name in ("near", "middle", "far")) == len(others)

    uv = others.observations.uv.copy()
    uv[:20, 1] = np.nan
    evaluation = evaluate(fitted(), with_uv(others, uv))
    groups = {(row.group, row.region): row for row in evaluation.coverage.rows}
    assert (groups["views", "3 views"].n, groups["views", "3 views"].unmeasured) == (0, 20)
    assert (groups["views", "4 views"].n, groups["views", "4 views"].unmeasured) == (len(others) - 20, 0)
    assert evaluation.coverage.overall.unmeasured == 20
    assert len(evaluation.measurement) == len(others)

    assert [row.group for row in evaluate(fitted(), others, regions=False).coverage.rows] == ["all"]


def test_the_near_region_is_the_one_near_the_cameras() -> None:
    others = sets()[1]
    evaluation = evaluate(fitted(), others)
    from implicam.evaluation import _regions

    labels = _regions(evaluation.data)["depth"]
    distance = np.mean([np.linalg.norm(c.camera_from_world.apply(others.truth.xyz), axis=1) for c in rig().cameras], 0)
    assert distance[labels == "near"].mean() < distance[labels == "middle"].mean() < distance[labels == "far"].mean()


def test_error_bars_of_half_the_size_are_found_out() -> None:
    """150 points; at half the size the 95 % ellipsoid holds about 60 %, far outside what chance gives."""
    others = sets()[1]
    overall = evaluate(Distorted(fitted(), 0.25), others).coverage.overall
    assert overall.verdict == "too small"
    assert overall.sd_factor == pytest.approx(2 * evaluate(fitted(), others).coverage.overall.sd_factor)
    assert evaluate(Distorted(fitted(), 16), others).coverage.overall.verdict == "too large"


def test_notes_of_the_calibration_come_along() -> None:
    data = board()
    calibration = InverseGP().fit(data.select(data.shots != "board03"))
    evaluation = evaluate(calibration, data)
    assert evaluation.notes == tuple(calibration.notes)
    assert set(evaluation.data.shots) == {"board03"}


# in turn


@dataclass
class Recorder:
    """Fits, and remembers what it was given and what it measured."""

    learned: list[list[str]] = field(default_factory=list)

    def __call__(self, data: Dataset, progress: Progress = silent) -> Calibration:
        self.learned.append([str(name) for name in data.points])
        return InverseGP().fit(data)


def test_learned_points_are_left_out_where_the_data_lack_a_camera_too() -> None:
    known, _ = sets()
    calibration = ForwardGP().fit(known)
    fewer = known.without(["cam3"])
    with pytest.raises(DatasetError, match="were used to fit this calibration"):
        evaluate(calibration, fewer)


def test_cross_validation_holds_each_point_out_once() -> None:
    data, recorder = sets()[0], Recorder()
    steps: list[tuple[str, int, int]] = []
    evaluation = cross_validate(recorder, data, 4, seed=3, progress=lambda *step: steps.append(step))
    *rounds, last = recorder.learned
    assert len(rounds) == 4
    assert last == [str(name) for name in data.points]  # what is to be noted of all of them
    assert sorted(evaluation.data.points) == sorted(data.points)
    all_names = {str(name) for name in data.points}
    held_out = [all_names - set(names) for names in rounds]
    assert set.union(*held_out) == all_names
    assert sum(map(len, held_out)) == len(data)
    assert max(map(len, held_out)) - min(map(len, held_out)) <= 1
    assert [done for _, done, _ in steps] == [0, 1, 2, 3, 4]
    # rows stay together: the error of each point is small only where measurement, truth and name belong together
    np.testing.assert_array_equal(evaluation.measurement.points, evaluation.data.points)
    np.testing.assert_array_equal(evaluation.true_xyz, evaluation.data.truth.xyz)
    assert np.abs(evaluation.measurement.xyz - evaluation.true_xyz).max() < 10
    assert "4-fold" in evaluation.how
    assert "seed 3" in evaluation.how


def test_cross_validation_measures_as_a_fit_by_hand_does() -> None:
    data = sets()[0]
    evaluation = cross_validate(InverseGP().fit, data, 3)
    start = 0
    for _, others, fold in data.folds(3, seed=0):
        by_hand = InverseGP().fit(others).measure(fold.observations)
        part = slice(start, start + len(fold))
        np.testing.assert_array_equal(evaluation.measurement.points[part], by_hand.points)
        np.testing.assert_array_equal(evaluation.measurement.xyz[part], by_hand.xyz)
        np.testing.assert_array_equal(evaluation.measurement.cov[part], by_hand.cov)
        start += len(fold)


def test_the_seed_chooses_the_folds() -> None:
    data = sets()[0]
    a, b, c = (cross_validate(InverseGP().fit, data, 2, seed=seed).coverage.overall.rmse for seed in (1, 1, 2))
    assert a == b != c


def test_a_calibrations_own_refit_serves_too() -> None:
    a = cross_validate(fitted().refit, sets()[0], 2).coverage.overall.rmse
    assert a == cross_validate(InverseGP().fit, sets()[0], 2).coverage.overall.rmse


def test_each_shot_is_left_out_as_a_whole() -> None:
    data, recorder = board(), Recorder()
    evaluation = leave_out_shots(recorder, data)
    shot_of = dict(zip(map(str, data.points), map(str, data.shots), strict=True))
    rounds = recorder.learned[:-1]  # the last is a fit to all, for the notes
    left_out = [set(shot_of.values()) - {shot_of[name] for name in names} for names in rounds]
    assert [len(shots) for shots in left_out] == [1] * 6
    assert set.union(*left_out) == set(shot_of.values())
    assert sorted(evaluation.data.points) == sorted(data.points)
    np.testing.assert_array_equal(evaluation.measurement.points, evaluation.data.points)
    assert evaluation.how == "each of 6 shots left out in turn"
    assert evaluation.notes == tuple(InverseGP().fit(data).notes)
    assert evaluation.coverage.overall.cluster_kind == "shots"
    assert evaluation.coverage.overall.clusters == 6


def test_what_cannot_be_held_out_is_refused() -> None:
    data = board()
    with pytest.raises(DatasetError, match="cannot make 1 folds"):
        cross_validate(InverseGP().fit, data, 1)
    with pytest.raises(DatasetError, match="one shot only"):
        leave_out_shots(InverseGP().fit, data.select(data.shots == "board01"))
    with pytest.raises(FitError, match="4 usable known points"):
        cross_validate(InverseGP().fit, sets()[0].select(np.arange(6)), 3)


# demo


def test_the_demo_replaces_nothing_but_a_demo(tmp_path: Any) -> None:
    """What is refused is refused before anything is done."""
    for name, content in (("notes.txt", b"mine"), ("truth.toml", b"name = 'a simulated rig of mine'\n")):
        folder = tmp_path / name.partition(".")[0]
        folder.mkdir()
        (folder / name).write_bytes(content)
        with pytest.raises(UsageError, match="was not made by the demo"):
            demo.run(folder)
        assert (folder / name).read_bytes() == content
    with pytest.raises(UsageError, match="was not made by the demo"):
        demo.run(tmp_path / "notes" / "notes.txt")
