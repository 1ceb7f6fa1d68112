"""Methods side by side: the same splits, the same points, and nobody is flattered; table, figure and command."""

from __future__ import annotations

import contextlib
import io
import json
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from implicam.calibrators import METHODS, Calibration, ForwardGP, InverseGP, Method, calibrator_from_name, library_of
from implicam.cli import main
from implicam.cli.compare import _available_methods
from implicam.cli.compare_table import compare_failures, compare_table
from implicam.compare import (
    NUMBERS,
    Trial,
    as_json,
    compare,
    compare_on,
    plane_splits,
    random_splits,
    shot_splits,
    summarise,
)
from implicam.compare.splits import lattice_planes
from implicam.dataset import Dataset, KnownPositions, Observations, write_dataset
from implicam.errors import DatasetError, FitError, NumericalError, UsageError
from implicam.evaluation import evaluate
from implicam.figures import compare_figure
from implicam.geometry import rotation_from_vector
from implicam.measurement import Measurement
from implicam.progress import Progress, silent
from implicam.simulate import Rig, ball_grid, build_rig, moving_board, random_positions, simulate

with contextlib.suppress(ImportError), warnings.catch_warnings(action="ignore"):
    import gpytorch  # noqa: F401  now, because it warns of PyTorch when it is imported first


@cache
def rig() -> Rig:
    return build_rig("bar6", seed=5, cameras="2R2W")


@cache
def sets() -> tuple[Dataset, Dataset]:
    known = random_positions(rig(), 80, np.random.default_rng(1))
    others = random_positions(rig(), 150, np.random.default_rng(2))
    return complete(simulate(rig(), known, seed=1)), complete(simulate(rig(), others, seed=2))


@cache
def board() -> Dataset:
    return simulate(rig(), moving_board(rig(), corners=(3, 4), positions=6), seed=3)


@cache
def lattice() -> Dataset:
    return simulate(rig(), ball_grid(rig(), (5, 5, 7)), seed=3)


def complete(data: Dataset) -> Dataset:
    return data.select(data.observations.seen.all(axis=1))


def with_uv(data: Dataset, uv: np.ndarray) -> Dataset:
    return replace(data, observations=Observations(data.points, data.cameras, uv, np.full(uv.shape, np.nan)))


def at(data: Dataset, xyz: np.ndarray) -> Dataset:
    """The same points elsewhere, without the truth of a simulation."""
    return replace(data, known=KnownPositions(data.shots, xyz, np.full((len(data), 3), np.nan)))


def names(data: Dataset) -> set[str]:
    return set(map(str, data.points))


# methods that do as they are told


@dataclass(frozen=True)
class Told:
    """A calibration that is off by `error` along x, and measures only points that `sees` approves."""

    data: Dataset
    truth: Dataset
    error: float
    sees: Callable[[str], bool]
    method: str = "told"

    def measure(self, observations: Observations) -> Measurement:
        n, where = len(observations), {str(name): i for i, name in enumerate(self.truth.points)}
        xyz = np.array([self.truth.truth.xyz[where[str(name)]] for name in observations.points])  # type: ignore[union-attr]
        xyz[:, 0] += self.error * (1 + np.arange(n) % 2)
        xyz[[not self.sees(str(name)) for name in observations.points]] = np.nan
        cov = np.broadcast_to(np.eye(3), (n, 3, 3)).copy()
        return Measurement(
            observations.points, xyz, cov, np.full(n, 2), np.full(n, np.nan), np.full(n, ""), self.data.length_unit
        )

    @property
    def notes(self) -> list[str]:
        return []


@dataclass
class Tells:
    """Fits such calibrations, or fails in the fits (by number) it is told to fail in."""

    truth: Dataset
    error: float = 1.0
    sees: Callable[[str], bool] = lambda name: True
    fails: Sequence[int] = ()
    fits: int = 0
    method: str = "tells"

    def fit(self, data: Dataset, progress: Progress = silent) -> Any:
        self.fits += 1
        if self.fits - 1 in self.fails:
            raise FitError("told to fail.")
        return Told(data, self.truth, self.error, self.sees)


@dataclass
class FitsMany(Tells):
    """The same, all at once."""

    batches: list[list[int]] = field(default_factory=list)

    def fit_many(self, datasets: Sequence[Dataset], progress: Progress = silent) -> list[Any]:
        self.batches.append([len(data) for data in datasets])
        progress("training", 0, 1)
        found: list[Any] = []
        for data in datasets:
            try:
                found.append(self.fit(data))
            except FitError as error:
                found.append(error)
        return found


@dataclass
class Fails:
    """A method that cannot do it."""

    error: Exception
    method: str = "fails"

    def fit(self, data: Dataset, progress: Progress = silent) -> Calibration:
        raise self.error


@dataclass
class FailsAtAll(Fails):
    """It cannot do many either."""

    def fit_many(self, datasets: Sequence[Dataset], progress: Progress = silent) -> list[Any]:
        raise self.error


@dataclass
class Watches:
    """inverse-gp, remembering what it was trained on."""

    seen: list[list[str]] = field(default_factory=list)
    method: str = "watches"

    def fit(self, data: Dataset, progress: Progress = silent) -> Calibration:
        self.seen.append([str(name) for name in data.points])
        return InverseGP().fit(data)


# the same splits


def test_all_methods_see_the_same_splits() -> None:
    data, a, b = sets()[0], Watches(), Watches()
    steps: list[tuple[str, int, int]] = []
    trials = compare(data, {"a": a, "b": b}, [20, 40], seeds=3, progress=lambda *step: steps.append(step))
    assert a.seen == b.seen
    assert [len(names) for names in a.seen] == [20] * 3 + [40] * 3
    assert len({tuple(names) for names in a.seen}) == 6
    assert [(t.method, t.known, t.seed) for t in trials[:3]] == [("a", 20, 0), ("b", 20, 0), ("a", 20, 1)]
    for first, second in zip(trials[::2], trials[1::2], strict=True):
        assert first.rmse == second.rmse == pytest.approx(first.rmse_common)
        assert first.held_out == first.common == len(data) - first.known
        assert first.unmeasured == 0
        assert first.limit > 0
        assert first.fit_seconds > 0
    assert steps == [("comparing", done, 12) for done in range(13)]


def test_a_comparison_is_an_evaluation() -> None:
    data = sets()[0]
    (trial,) = compare(data, {"gp": InverseGP()}, [40], seeds=1)
    train, rest = data.split(40, seed=0)
    overall = evaluate(InverseGP().fit(train), rest).coverage.overall
    assert (trial.rmse, trial.median, trial.nees) == (overall.rmse, overall.median_error, overall.nees.value)
    assert trial.limit == pytest.approx(np.sqrt(np.mean(np.trace(rest.truth.limit, axis1=1, axis2=2))))
    assert trial.coverage_95 == overall.level(0.95).pooled.value
    assert trial.ellipsoid_95 == overall.level(0.95).ellipsoid.value


def test_a_check_dataset_is_what_all_are_judged_by() -> None:
    known, others = sets()
    trials = compare(known, {"gp": InverseGP()}, [40, len(known)], seeds=2, check=others)
    assert [t.held_out for t in trials] == [len(others)] * 3
    assert [t.known for t in trials] == [40, 40, len(known)]  # all points can be drawn in one way only
    assert trials[2].rmse == evaluate(InverseGP().fit(known), others).coverage.overall.rmse


def test_the_same_number_twice_is_one_row() -> None:
    trials = compare(sets()[0], {"tells": Tells(sets()[0])}, [20, 30, 20], seeds=2)
    assert [(row.known, row.seeds) for row in summarise(trials)] == [(20, 2), (30, 2)]


# failures


@pytest.mark.parametrize(
    "error", [FitError("too few points"), NumericalError("not positive definite"), DatasetError("no such unit")]
)
@pytest.mark.parametrize("kind", [Fails, FailsAtAll])
def test_a_failure_is_reported_and_the_others_go_on(error: Any, kind: type[Fails]) -> None:
    trials = compare(sets()[0], {"fails": kind(error), "tells": Tells(sets()[0])}, [20], seeds=2)
    rows = {row.method: row for row in summarise(trials)}
    assert rows["fails"].failures == (error.what,)
    assert (rows["fails"].seeds, rows["fails"].tried) == (0, 2)
    assert np.isnan(list(rows["fails"].mean.values())).all()
    assert rows["tells"].failures == ()
    assert (rows["tells"].seeds, rows["tells"].tried) == (2, 2)
    assert rows["tells"].mean["rmse"] > 0


def test_equations_without_a_solution_are_a_failure() -> None:
    (trial,) = compare(sets()[0], {"fails": Fails(np.linalg.LinAlgError("singular"))}, [20], seeds=1)
    assert trial.failure == "the equations have no solution: singular."


def test_a_mistake_in_a_method_is_not_hidden_as_a_failure() -> None:
    with pytest.raises(ZeroDivisionError):
        compare(sets()[0], {"fails": Fails(ZeroDivisionError())}, [20], seeds=1)


def test_what_cannot_be_compared_is_refused() -> None:
    data = sets()[0]
    gp = {"gp": InverseGP()}
    with pytest.raises(UsageError, match=f"{len(data)} of {len(data)} points leave none"):
        compare(data, gp, [10, len(data)])
    for methods, sizes, seeds in (({}, [10], 1), (gp, [], 1), (gp, [10], 0)):
        with pytest.raises(UsageError, match="at least one method, one number of points and one seed"):
            compare(data, methods, sizes, seeds=seeds)
    for size in (0, -3):
        with pytest.raises(DatasetError, match="cannot split"):
            compare(data, gp, [size], seeds=1)
    with pytest.raises(DatasetError, match="cannot split"):
        compare(data, gp, [len(data) + 1], seeds=1, check=sets()[1])
    with pytest.raises(DatasetError, match="is in m"):
        compare(data, gp, [20], seeds=1, check=replace(sets()[1], length_unit="m"))
    with pytest.raises(DatasetError, match="no known positions"):
        compare(replace(data, known=None), gp, [20], seeds=1)


# all splits at once


def test_a_method_that_fits_many_is_given_all_splits_of_a_number_at_once() -> None:
    data = sets()[0]
    many, one = FitsMany(data, fails=[1]), Tells(data, fails=[1])
    steps: list[tuple[str, int, int]] = []
    trials = compare(data, {"many": many, "one": one}, [20, 40], seeds=3, progress=lambda *step: steps.append(step))
    assert many.batches == [[20] * 3, [40] * 3]
    for first, second in zip(trials[::2], trials[1::2], strict=True):
        assert (first.method, second.method) == ("many", "one")
        assert (first.known, first.seed, first.failure) == (second.known, second.seed, second.failure)
        assert np.array_equal([first.rmse, first.nees], [second.rmse, second.nees], equal_nan=True)
    assert [t.failure for t in trials if t.method == "many"] == ["", "told to fail.", "", "", "", ""]
    shares = [t.fit_seconds for t in trials if t.method == "many"]
    assert shares[0] == shares[2] > 0  # the time of all, divided
    assert np.isnan(shares[1])
    assert [step for step in steps if step[0] == "training"] == [("training", 0, 1)] * 2  # it may say how far it is
    assert [done for what, done, _ in steps if what == "comparing"] == [0, 3, 4, 5, 6, 9, 10, 11, 12]


# the points that all measured


def test_points_that_were_not_measured_are_counted() -> None:
    data = sets()[0]
    uv = data.observations.uv.copy()
    uv[::4, 1] = np.nan
    trials = compare(with_uv(data, uv), {"gp": InverseGP()}, [40], seeds=2)
    (row,) = summarise(trials)
    assert all(0 < t.unmeasured < t.held_out for t in trials)
    assert row.mean["measured"] == pytest.approx(np.mean([1 - t.unmeasured / t.held_out for t in trials]))
    assert row.mean["rmse_common"] == pytest.approx(row.mean["rmse"])  # alone, it measured what all measured


def test_errors_on_common_points_are_those_of_the_same_points() -> None:
    """One measures all points, one every other (of the first by name); errors alternate between 1 and 2."""
    data = sets()[0]
    order = {str(name): i for i, name in enumerate(data.points)}
    half = Tells(data, 3.0, sees=lambda name: order[name] < 40)
    trials = compare(data, {"all": Tells(data), "half": half, "none": Tells(data, sees=lambda name: False)}, [30])
    for k in range(0, len(trials), 3):
        everything, some, nothing = trials[k : k + 3]
        _, rest = data.split(30, seed=everything.seed)
        both = np.array([order[str(name)] < 40 for name in rest.points])
        error = 1.0 + np.arange(len(rest)) % 2
        assert everything.common == some.common == both.sum() < len(rest)
        assert everything.rmse == pytest.approx(np.sqrt(np.mean(error**2)))
        assert everything.rmse_common == pytest.approx(np.sqrt(np.mean(error[both] ** 2)))
        assert some.rmse == pytest.approx(some.rmse_common)
        assert some.rmse_common == pytest.approx(3 * everything.rmse_common)
        assert (nothing.common, nothing.unmeasured, nothing.failure) == (0, len(rest), "")
        assert np.isnan(nothing.rmse_common)


def test_the_common_points_are_of_splits_in_which_nobody_failed() -> None:
    """Else the mean of the one would be over splits that the other found too hard."""
    data = sets()[0]
    trials = compare(data, {"sure": Tells(data), "shaky": Tells(data, 2.0, fails=[0, 2])}, [30], seeds=4)
    assert [np.isfinite(t.rmse_common) for t in trials if t.method == "sure"] == [False, True, False, True]
    sure, shaky = summarise(trials)
    assert shaky.mean["rmse_common"] == pytest.approx(2 * sure.mean["rmse_common"])
    assert (sure.seeds, shaky.seeds) == (4, 2)
    hopeless = compare(data, {"sure": Tells(data), "hopeless": Fails(FitError("no"))}, [30], seeds=4)
    assert summarise(hopeless)[0].mean["rmse_common"] == pytest.approx(summarise(hopeless)[0].mean["rmse"])


# shots left out


def test_each_shot_is_left_out_in_turn() -> None:
    data = board()
    splits = shot_splits(data)
    assert [split.left_out for split in splits] == [f"board{i:02}" for i in range(1, 7)]
    for split in splits:
        assert set(split.held_out.shots) == {split.left_out}
        assert names(split.train) | names(split.held_out) == names(data)
        assert not names(split.train) & names(split.held_out)
        assert split.all_others
    tells = Tells(data)
    trials = compare_on(splits, {"tells": tells})
    (row,) = summarise(trials)
    assert (row.split, row.all_others, row.seeds, row.known) == ("shot", True, 6, 60)
    assert [t.left_out for t in trials] == [split.left_out for split in splits]


def test_shots_of_different_size_are_one_row() -> None:
    data = board()
    uneven = data.select([i for i, shot in enumerate(data.shots) if shot != "board01" or i % 2])
    trials = compare_on(shot_splits(uneven), {"tells": FitsMany(data)})
    assert len({t.known for t in trials}) == 2
    (row,) = summarise(trials)
    assert (row.seeds, row.known) == (6, round(np.mean([t.known for t in trials])))
    assert row.mean["rmse"] == pytest.approx(np.mean([t.rmse for t in trials]))
    assert row.standard_error["rmse"] == pytest.approx(np.std([t.rmse for t in trials], ddof=1) / np.sqrt(6))


def test_so_many_points_of_the_other_shots_are_drawn() -> None:
    splits = shot_splits(board(), [20, 60, 20])
    assert [len(split.train) for split in splits] == [20] * 6 + [60] * 6
    assert not any(split.left_out in split.train.shots for split in splits)
    assert len({tuple(sorted(names(split.train))) for split in splits}) == 12
    assert [row.known for row in summarise(compare_on(splits, {"tells": Tells(board())}))] == [20, 60]
    again = shot_splits(board(), [20])
    assert [names(split.train) for split in again] == [names(split.train) for split in splits[:6]]


def test_at_most_so_many_shots_are_drawn() -> None:
    some = [split.left_out for split in shot_splits(board(), most=3)]
    assert len(set(some)) == 3
    assert some == sorted(some)
    assert some == [split.left_out for split in shot_splits(board(), most=3)]
    assert len(shot_splits(board(), most=60)) == 6


def test_shots_that_cannot_be_left_out_are_refused() -> None:
    with pytest.raises(UsageError, match="is a shot of its own") as told:
        shot_splits(sets()[0])
    assert "random splits" in told.value.fix
    with pytest.raises(DatasetError, match="one shot only"):
        shot_splits(board().select(board().shots == "board01"))
    with pytest.raises(UsageError, match="61 points cannot be drawn where board01 is left out: 60 others"):
        shot_splits(board(), [61])
    for options in ({"sizes": []}, {"most": 0}):
        with pytest.raises(UsageError, match="at least one"):
            shot_splits(board(), **options)


# planes of a lattice left out


def test_each_inner_plane_of_the_lattice_is_left_out_in_turn() -> None:
    data = lattice()
    splits = plane_splits(data)
    assert [split.kind for split in splits] == ["plane x"] * 5 + ["plane y"] * 3 + ["plane z"] * 3
    for split in splits:
        axis = "xyz".index(split.kind[-1])
        (value,) = np.unique(np.round(split.held_out.xyz[:, axis], 6))
        assert split.left_out == f"{'xyz'[axis]} = {value:g}"
        assert np.ptp(data.xyz[:, axis]) / 8 < np.abs(split.train.xyz[:, axis] - value).min()  # the whole plane is out
        assert split.train.xyz[:, axis].min() < value < split.train.xyz[:, axis].max()  # an inner one
        assert len(split.train) + len(split.held_out) == len(data) == 175
    assert {len(split.held_out) for split in splits} == {25, 35}
    drawn = [(split.kind, len(split.train)) for split in plane_splits(data, [40, 90])]
    assert drawn == [
        (f"plane {axis}", size) for axis, n in ("x5", "y3", "z3") for size in (40, 90) for _ in range(int(n))
    ]
    assert [split.kind[-1] for split in plane_splits(data, most=2)] == list("xxyyzz")


def test_planes_may_be_as_thick_as_the_error_of_a_robot() -> None:
    data, rng = lattice(), np.random.default_rng(0)
    extent = np.ptp(data.xyz, axis=0).max()
    off = data.xyz + rng.normal(size=(175, 3)) * extent * 1e-4
    assert len(plane_splits(at(data, off))) == 11
    off = data.xyz + rng.normal(size=(175, 3)) * extent * 1e-2
    with pytest.raises(DatasetError, match="stand on no lattice"):
        plane_splits(at(data, off))


@pytest.mark.parametrize("n", [5, 80, 300, 2000, 20000, 200000])
def test_random_positions_are_no_lattice_however_many(n: int) -> None:
    """Dense ones leave no gaps, sparse ones fall together too seldom; in between both have to be seen."""
    for seed in range(5 if n < 10000 else 1):
        xyz = np.random.default_rng(seed).uniform(size=(n, 3))
        for axis in range(3):
            planes = lattice_planes(xyz, axis)
            assert planes is None or len(planes) < 3


def test_a_lattice_at_an_angle_is_refused_with_the_reason() -> None:
    turned = lattice().xyz @ rotation_from_vector(np.array([0.3, -0.2, 0.4])).T
    with pytest.raises(DatasetError, match="stand on no lattice") as told:
        plane_splits(at(lattice(), turned))
    assert "x, y and z of the world only" in told.value.why
    assert "leave out --lattice" in told.value.fix
    about_z = lattice().xyz @ rotation_from_vector(np.array([0.0, 0.0, 0.4])).T
    assert {split.kind for split in plane_splits(at(lattice(), about_z))} == {"plane z"}  # the planes it still has


def test_where_there_is_no_inner_plane_there_is_nothing_to_leave_out() -> None:
    z = lattice().xyz[:, 2]
    two = lattice().select((z < z.min() + 1) | (z > z.max() - 1))
    assert {split.kind for split in plane_splits(two)} == {"plane x", "plane y"}
    for none in (sets()[0], lattice().select([]), lattice().select([3])):
        with pytest.raises(DatasetError, match="stand on no lattice"):
            plane_splits(none)
    with pytest.raises(UsageError, match=r"141 points cannot be drawn where y = .* is left out: 140 others"):
        plane_splits(lattice(), [141])


@pytest.mark.slow
def test_a_random_split_flatters_what_learns_planes_and_the_planes_show_it() -> None:
    """Without its bound of lengthscales inverse-gp learns the planes themselves (docs/decisions/0004)."""
    methods = {"forward-gp": ForwardGP(), "unbounded": InverseGP(preset="plain", shortest_lengthscale=0.05)}
    two = build_rig("bar6", seed=1, cameras="2R")
    known = complete(simulate(two, ball_grid(two), seed=1))
    splits = random_splits(known, [100], seeds=2)
    splits += [split for split in plane_splits(known, [100]) if split.kind == "plane y"]
    rows = {(row.method, row.split): row for row in summarise(compare_on(splits, methods))}
    lattice_bias = {name: rows[name, "plane y"].mean["rmse"] / rows[name, "random"].mean["rmse"] for name in methods}
    assert lattice_bias["unbounded"] > 20  # 75 in a trial, and 102 with another rig
    assert lattice_bias["forward-gp"] < 1.5
    assert rows["unbounded", "plane y"].mean["ellipsoid_95"] < 0.5


# rows


def trial(method: str, known: int, seed: int, rmse: float, **more: Any) -> Trial:
    return Trial(method, known, seed, **{"rmse": rmse, "limit": 2.0, "held_out": 10, "rmse_common": rmse, **more})


def test_summaries_are_means_and_standard_errors() -> None:
    trials = [
        trial("a", 10, 0, 1.0, unmeasured=5),
        trial("b", 10, 0, 7.0),
        trial("a", 10, 1, 2.0),
        Trial("b", 10, 1, failure="no"),
        trial("a", 10, 2, 6.0),
        Trial("b", 10, 2, failure="no"),
        trial("a", 20, 0, 9.0),
    ]
    a, b, more = summarise(trials)
    assert [(r.method, r.known, r.seeds, r.tried) for r in (a, b, more)] == [
        ("a", 10, 3, 3), ("b", 10, 1, 3), ("a", 20, 1, 1),
    ]  # fmt: skip
    assert a.mean["rmse"] == pytest.approx(3.0)
    assert a.standard_error["rmse"] == pytest.approx(np.std([1, 2, 6], ddof=1) / np.sqrt(3))
    assert a.mean["rmse_over_limit"] == pytest.approx(1.5)
    assert a.mean["measured"] == pytest.approx((0.5 + 1 + 1) / 3)
    assert b.mean["rmse"] == 7.0
    assert np.isnan(b.standard_error["rmse"])
    assert b.failures == ("no",)
    assert set(a.mean) == set(NUMBERS)
    assert summarise([]) == []
    plain = as_json(trials)
    assert len(plain["trials"]) == 7
    assert len(plain["rows"]) == 3


def test_a_split_in_which_nothing_was_measured_does_not_wipe_out_the_others() -> None:
    blind = trial("a", 10, 1, np.nan, unmeasured=10)
    (row,) = summarise(
        [trial("a", 10, 0, 1.0), blind, trial("a", 10, 2, 3.0, nees=np.inf), trial("a", 10, 3, 5.0, nees=1.0)]
    )
    assert (row.mean["rmse"], row.seeds) == (3.0, 4)
    assert row.mean["measured"] == 0.75
    assert row.standard_error["rmse"] == pytest.approx(2 / np.sqrt(3))
    assert row.mean["nees"] == np.inf  # what is infinite stays so
    assert np.isnan(row.standard_error["nees"])


# table


def printed(trials: Sequence[Trial]) -> list[str]:
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(compare_table(summarise(trials), "mm"))
    return [line.rstrip() for line in console.export_text().splitlines()]


def words(lines: Sequence[str], start: str) -> list[list[str]]:
    return [line.split() for line in lines if line.strip().startswith(start)]


def test_the_table_shows_a_column_only_where_it_says_something() -> None:
    plain = [
        trial("a", 10, seed, 1.0 + seed, limit=np.nan, ellipsoid_95=0.9, nees=3.0, fit_seconds=0.1) for seed in (0, 1)
    ]
    lines = printed(plain)
    assert "over the seeds" in lines[0]
    assert words(lines, "a ") == [["a", "10", "1.50", "±", "0.5", "90.0", "±", "0", "3.00", "0.10"]]
    assert not any("common" in line or "sured" in line or "limit" in line for line in lines)
    partial = [replace(t, unmeasured=2, rmse_common=0.5 * t.rmse) for t in plain]
    lines = printed(partial)
    assert words(lines, "a ") == [["a", "10", "80.0", "1.50", "±", "0.5", "0.750", "90.0", "±", "0", "3.00", "0.10"]]
    assert any("common" in line for line in lines)
    assert max(map(len, lines)) <= 80


def test_the_table_of_a_lattice_shows_the_planes_beside_the_random_splits() -> None:
    trials = []
    for method, factor in (("inverse-gp:matern-5/2", 10.0), ("forward-gp", 1.0)):
        for split, of in (("random", 1.0), ("plane x", 1.0), ("plane z", factor)):
            trials += [trial(method, 30, seed, of * (1 + seed), limit=np.nan, split=split) for seed in (0, 1)]
    lines = printed([*trials[::2], *trials[1::2]])
    text = "\n".join(lines)
    assert "30 known points" in lines[0]
    assert [line.strip().split()[0] for line in lines[-8:]] == [
        "inverse-gp:matern-5/2", "random", "x", "z", "forward-gp", "random", "x", "z",
    ]  # fmt: skip
    assert [row[5] for row in words(lines, "z planes")] == ["10", "1.0"]
    assert "× random" in text
    assert max(map(len, lines)) <= 80


def test_the_table_of_shots_says_so() -> None:
    trials = [trial("a", 60 + seed % 2, seed, 1.0, split="shot", all_others=True) for seed in range(4)]
    assert "over 4 shots left out;" in printed(trials)[0]


def test_failures_are_told_once_with_how_many() -> None:
    trials = [Trial(m, 10, seed, failure="too few points.") for m in "ab" for seed in range(3)]
    trials += [Trial("a", 10, 3, failure="flat."), trial("a", 10, 4, 1.0)]
    trials += [Trial("a", 9 + seed, seed, failure="x", split="shot", all_others=True) for seed in (0, 1)]
    assert compare_failures(trials) == [
        "a with 10 points failed in 3 of 5 splits: too few points.",
        "b with 10 points failed in 3 of 3 splits: too few points.",
        "a with all other points failed in 2 of 2 splits (shot): x",
        "a with 10 points failed in 1 of 5 splits: flat.",
    ]
    both = [Trial(m, 10, 0, failure="no.") for m in "ab"]
    assert compare_failures(both) == ["a, b with 10 points failed in 1 of 1 splits: no."]


# figure


@pytest.mark.slow
def test_the_figure_shows_mean_and_standard_error(tmp_path: Path) -> None:
    table = [
        {"method": method, "known": known, "seed": seed, "rmse": base * (1 + seed) / known, "ellipsoid_95": cover,
         "fit_seconds": 0.1 * known, "limit": 0.1}
        for method, base, cover in (("forward-gp", 10, 0.95), ("mlp", 50, None))
        for known in (20, 50) for seed in (0, 1, 2)
    ]  # fmt: skip
    figure = compare_figure(
        [*table, {"method": "never", "known": 20, "rmse": np.nan, "ellipsoid_95": np.nan}], unit="mm"
    )
    error, inside, seconds = figure.axes
    assert [container.get_label() for container in error.containers] == ["forward-gp", "mlp"]
    assert list(error.containers[0].lines[0].get_ydata()) == pytest.approx([1.0, 0.4])
    bars = [bar[:, 1].tolist() for bar in error.containers[0].lines[2][0].get_segments()]
    half = 1 / np.sqrt(3)  # of 1, 2, 3
    assert bars[0] == pytest.approx([1 - 0.5 * half, 1 + 0.5 * half])
    assert bars[1] == pytest.approx([0.4 - 0.2 * half, 0.4 + 0.2 * half])
    assert [container.get_label() for container in inside.containers] == ["forward-gp"]
    assert [container.get_label() for container in seconds.containers] == ["forward-gp", "mlp"]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["Cramér-Rao limit", "forward-gp", "mlp"]
    assert legend.get_title().get_text() == "mean ± standard error over the seeds"
    for ending in ("png", "pdf", "svg"):
        figure.savefig(tmp_path / f"compare.{ending}")
        assert (tmp_path / f"compare.{ending}").stat().st_size > 5000
    compare_figure([], unit="mm").savefig(tmp_path / "empty.png")


def test_a_bar_never_reaches_zero_on_a_log_axis() -> None:
    """The standard error of (0, 0, r) is as large as its mean."""
    table = [
        {"method": "a", "known": 20, "rmse": rmse, "ellipsoid_95": 0.9, "fit_seconds": 1} for rmse in (1e-9, 1e-9, 9)
    ]
    (bar,) = compare_figure(table, unit="mm").axes[0].containers[0].lines[2][0].get_segments()
    assert bar[0, 1] > 0


def test_the_figure_of_what_was_left_out_has_a_line_per_method(tmp_path: Path) -> None:
    trials = [
        trial(method, 30, seed, rmse * (1 + seed), split=split, ellipsoid_95=0.9)
        for split in ("random", "plane x", "plane z") for method, rmse in (("a", 1.0), ("b", 3.0)) for seed in (0, 1, 2)
    ]  # fmt: skip
    trials = [replace(t, rmse=np.nan) if (t.method, t.split) == ("b", "plane z") else t for t in trials]
    figure = compare_figure([vars(t) for t in trials], unit="mm")
    error, _ = figure.axes
    assert [text.get_text() for text in error.get_yticklabels()] == ["a", "b"]
    assert [c.get_label() for c in error.containers] == [
        "random splits", "planes across x left out", "planes across z left out",
    ]  # fmt: skip
    random, _, z = error.containers
    assert list(random.lines[0].get_xdata()) == pytest.approx([2.0, 6.0])
    bars = [bar[:, 0].tolist() for bar in random.lines[2][0].get_segments()]
    assert bars[0] == pytest.approx([2 - 1 / np.sqrt(3), 2 + 1 / np.sqrt(3)])
    assert list(z.lines[0].get_xdata()) == pytest.approx([2.0])
    assert [text.get_text() for text in error.texts] == ["no result"]
    dots = sorted(float(x) for line in error.lines if line.get_alpha() == 0.35 for x in line.get_xdata())
    assert dots == pytest.approx(sorted(t.rmse for t in trials if np.isfinite(t.rmse)))
    figure.savefig(tmp_path / "left-out.png")


def test_shots_are_curves_where_numbers_of_points_were_asked_for() -> None:
    asked = [trial("a", known, seed, 1.0, split="shot") for known in (20, 40) for seed in (0, 1)]
    figure = compare_figure([vars(t) for t in asked], unit="mm")
    assert figure.axes[0].get_xlabel() == "known points"
    assert figure.legends[0].get_title().get_text() == "mean ± standard error over the shots left out"
    others = [trial("a", 60 + seed, seed, 1.0, split="shot", all_others=True) for seed in (0, 1)]
    assert len(compare_figure([vars(t) for t in others], unit="mm").axes) == 2


# command


@dataclass(frozen=True)
class Ran:
    """What a command did."""

    code: int
    out: str
    err: str


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Ran]:
    """The command, in a folder that holds a board, a lattice and random positions."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("NO_COLOR", "1")
    for name, data in (("board", board()), ("lattice", lattice()), ("random", sets()[0])):
        write_dataset(data, tmp_path / name)

    def compared(*options: str) -> Ran:
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            main(["compare", *options])
        told = capsys.readouterr()
        return Ran(int(end.value.code or 0), told.out, told.err)

    return compared


@pytest.mark.slow
def test_shots_from_the_command_line(run: Callable[..., Ran], tmp_path: Path) -> None:
    ran = run("board", "--leave-out", "shot", "--methods", "forward-gp,inverse-gp", "-o", "shots.png", "--json")
    assert (ran.code, ran.err) == (0, "")
    told = json.loads(ran.out)
    assert [(row["method"], row["split"], row["tried"], row["all_others"]) for row in told["rows"]] == [
        ("forward-gp", "shot", 6, True), ("inverse-gp", "shot", 6, True),
    ]  # fmt: skip
    assert {t["left_out"] for t in told["trials"]} == {f"board{i:02}" for i in range(1, 7)}
    assert told["length_unit"] == "mm"
    assert (tmp_path / "shots.png").read_bytes().startswith(b"\x89PNG")
    some = json.loads(run("board", "--leave-out", "shot", "--methods", "inverse-gp", "--train", "20,30",
                          "--seeds", "2", "--json").out)  # fmt: skip
    assert [(row["known"], row["seeds"]) for row in some["rows"]] == [(20, 2), (30, 2)]


@pytest.mark.slow
def test_a_lattice_from_the_command_line(run: Callable[..., Ran]) -> None:
    words = ("lattice", "--lattice", "--methods", "inverse-gp", "--seeds", "2")
    told = json.loads(run(*words, "--json").out)
    assert [(row["split"], row["known"], row["tried"]) for row in told["rows"]] == [
        ("random", 88, 2), ("plane x", 88, 2), ("plane y", 88, 2), ("plane z", 88, 2),
    ]  # fmt: skip
    assert [row["known"] for row in json.loads(run(*words, "--train", "40", "--json").out)["rows"]] == [40] * 4
    shown = run(*words, "-o", "lattice.png")
    assert "figure: lattice.png" in shown.out
    assert all(name in shown.out for name in ("  random", "  x planes", "  y planes", "  z planes"))


@pytest.mark.parametrize(("words", "says"), [
    ("random --leave-out shot", "is a shot of its own"),
    ("random --leave-out shoot", "write --leave-out shot"),
    ("random --lattice", "stand on no lattice"),
    ("lattice --lattice --leave-out shot", "exclude each other"),
    ("lattice --lattice --check random", "exclude each other"),
    ("board --leave-out shot --train 61", "choose numbers up to 60"),
    ("lattice --lattice --train 141", "choose numbers up to 140"),
    ("board --methods inverse-gp:matern", "inverse-gp has no variant 'matern' (did you mean 'matern-5/2'?)"),
    ("board --methods explicit:fisheye", "explicit has no"),
])  # fmt: skip
def test_what_the_command_refuses(words: str, says: str, run: Callable[..., Ran]) -> None:
    ran = run(*words.split())
    assert ran.code in (1, 2)
    assert says in " ".join(ran.err.split())
    assert "fix:" in ran.err
    assert ran.out == ""


def test_all_methods_are_those_that_are_there(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Other(InverseGP):
        method = "other"
        library = ("no_such_library", "other-extra")

    monkeypatch.setitem(METHODS._parts, "other", Method(Other, Other))
    names = _available_methods()
    assert "other" not in names
    assert 'left out other: pip install "implicam[other-extra]"' in capsys.readouterr().err
    Other.library = None
    names = _available_methods()
    assert {"forward-gp", "forward-gp:none", "inverse-gp", "other"} <= set(names)
    assert {name for name in METHODS if not library_of(name)} <= set(names)
    for name in names:
        assert calibrator_from_name(name).method == name.partition(":")[0]
    assert calibrator_from_name("inverse-gp:matern-5/2").kernel == "matern-5/2"
    assert calibrator_from_name("forward-gp:none").lens == "none"
    assert calibrator_from_name("explicit:kannala-brandt").lens == "kannala-brandt"
