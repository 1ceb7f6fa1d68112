"""The paper's experiments: what they are run on, what they compute, which findings hold, and how it is written down."""

from __future__ import annotations

import csv
import json
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from implicam.calibrators import InverseGP, InverseGPCalibration, calibrator_from_name
from implicam.calibrators.explicit import Explicit
from implicam.calibrators.explicit.boards import boards_of
from implicam.cli import main
from implicam.dataset import Dataset, write_dataset
from implicam.errors import DatasetError, FitError, MissingExtraError
from implicam.experiments import active, ball, board, evidence, findings, published, tables
from implicam.experiments.account import markdown
from implicam.experiments.cells import run
from implicam.experiments.evidence import FAILS, HOLDS, OPEN, Case, interval, ratio, share_of_drop, unpaired
from implicam.experiments.markdown import number, quartiles, table
from implicam.experiments.plan import (
    EXPLICIT_BUNDLE,
    EXPLICIT_PAPER,
    FORWARD,
    FULL,
    GP,
    LINES,
    METHODS,
    NETWORK,
    PAPER,
    QUICK,
    Plan,
)
from implicam.experiments.reproduction import EXPERIMENTS, reproduce
from implicam.experiments.source import BALL, BOARD, BOARDS, BUDGETS, CHECK, PARTS, RANDOM, Source
from implicam.simulate import ball_grid, build_rig, moving_board, random_positions, simulate, simulate_boards

ROOT = Path(__file__).parents[1]
TINY = Plan(
    name="tiny",
    shares=(80, 30),
    runs=dict.fromkeys(METHODS, 2),
    random_shares=(30,),
    random_runs=dict.fromkeys(METHODS, 2),
    subsets=1,
    additions=2,
    repeats=dict.fromkeys(METHODS, 2),
    lot=dict.fromkeys(METHODS, 2),
    boards=(2, 3),
)


# --- what they are run on ---


def test_the_simulated_data_are_the_papers_and_the_same_for_everybody() -> None:
    source = Source(3)
    assert source.parts == PARTS
    assert list(source.sets) == ["2R", "2R2W", "2R4W"]
    data = source.data(BALL, "2R")
    assert data.observations.camera_names == ("cam2", "cam3")
    assert [len(np.unique(values.round(6))) for values in data.xyz.T] == [7, 5, 5]  # away, along, down: a robot's axes
    assert len(source.data(BOARD, "2R4W")) == 20 * 88
    assert len(source.data(RANDOM, "2R")) == 175
    assert len(source.data(CHECK, "2R")) == 300
    assert data.truth is not None
    off = data.truth.xyz - data.xyz  # the robot says where it was sent
    assert np.sqrt(np.mean(off**2)) == pytest.approx(0.1, rel=0.1)
    np.testing.assert_array_equal(data.positions.sd, np.full((175, 3), 0.1))
    board = source.data(BOARD, "2R")
    off = board.truth.xyz - board.xyz  # type: ignore[union-attr]
    assert max(np.ptp(off[board.shots == shot], axis=0).max() for shot in np.unique(board.shots)) < 1e-9
    exact = replace(source, robot_noise_mm=0.0).data(BALL, "2R")
    again = simulate(build_rig("bar6", seed=3), ball_grid(build_rig("bar6", seed=3)), seed=30)
    np.testing.assert_array_equal(exact.observations.uv, again.with_cameras(["cam2", "cam3"]).observations.uv)
    for part in (BALL, RANDOM, CHECK, BOARD):
        truth = source.data(part, "2R2W").truth
        assert truth is not None
        assert np.isfinite(truth.limit).all()  # of these cameras, not of all six
    assert not np.array_equal(Source(4).data(BALL, "2R").observations.uv, data.observations.uv)


def test_random_positions_for_the_boards_lie_where_the_boards_were() -> None:
    boards, inside = Source(0).data(BOARD, "2R").xyz, Source(0).data("board/check", "2R").xyz
    assert (inside > boards.min(axis=0)).all()
    assert (inside < boards.max(axis=0)).all()
    assert (np.ptp(inside, axis=0) > 0.9 * np.ptp(boards, axis=0)).all()


@pytest.mark.slow
@pytest.mark.parametrize("cameras", ["2R", "2R2W"])
def test_a_budget_is_so_many_pictures_of_each_camera_and_of_every_pair(cameras: str) -> None:
    source = Source(0)
    names = source.sets[cameras]
    drawn = source.boards(cameras, 10, 4, 0)
    assert drawn is not None
    assert drawn.observations.camera_names == names
    seen: dict[int, set[int]] = {}
    for view in boards_of(drawn).views:
        seen.setdefault(view.board, set()).add(view.camera)
    groups = [tuple(sorted(cameras)) for cameras in seen.values()]
    pairs = len(names) * (len(names) - 1) // 2
    assert len(groups) == 10 * len(names) + 4 * pairs
    assert all(groups.count((c,)) == 10 for c in range(len(names)))
    assert len({group for group in groups if len(group) == 2}) == pairs
    other = source.boards(cameras, 10, 4, 1)
    assert other is not None
    assert set(other.points) != set(drawn.points)
    assert source.boards(cameras, 51, 4, 0) is None


def measured(folder: Path, *, seed: int = 5) -> Path:
    """Stand-in for measured data: datasets of a stereo rig, with its own camera names and without the truth."""
    rig = build_rig("stereo", seed=seed)

    def write(data: Dataset, name: str) -> None:
        assert data.known is not None
        write_dataset(replace(data, known=replace(data.known, extra={})), folder / name)

    folder.mkdir()
    write(simulate(rig, ball_grid(rig, (3, 3, 3)), seed=1), "ball")
    write(simulate(rig, random_positions(rig, 12, np.random.default_rng(2)), seed=2), "check")
    write(simulate(rig, moving_board(rig, corners=(4, 5), positions=5), seed=3), "board")
    return folder


def test_measured_data_are_datasets_in_a_folder(tmp_path: Path) -> None:
    folder = measured(tmp_path / "mine")
    source = Source.of(folder, 0)
    assert source.parts == (BALL, CHECK, BOARD)
    assert source.sets == {"all": ("cam1", "cam2")}
    assert len(source.data(BALL, "all")) == 27
    assert source.data(BALL, "all").truth is None
    points = folder / "check" / "points.csv"
    points.write_text(points.read_text().replace("random002", "other"))
    observations = folder / "check" / "observations.csv"
    observations.write_text(observations.read_text().replace("random002", "other"))
    changed = Source.of(folder, 0)
    assert changed.stamp != source.stamp  # results of other data do not count
    assert "other" in changed.data(CHECK, "all").points
    with pytest.raises(DatasetError, match="no boards"):
        changed.data(BOARDS, "all")


def test_a_dataset_itself_is_the_ball(tmp_path: Path) -> None:
    source = Source.of(measured(tmp_path / "mine") / "ball", 0)
    assert source.parts == (BALL,)
    assert len(source.data(BALL, "all")) == 27
    assert board.cells(source, TINY) == []


def test_an_empty_folder_is_an_error_that_says_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="holds no dataset") as caught:
        Source.of(tmp_path, 0)
    assert "ball, boards, board" in caught.value.why


# --- what they compute ---


@pytest.mark.slow
def test_the_full_plan_is_the_papers() -> None:
    cells = ball.cells(Source(0), FULL)
    runs = {}
    for cell in cells:
        options = cell.options
        if options.get("trained") == BALL:
            key = options["method"]
            runs[key] = runs.get(key, 0) + options["runs"]
    assert runs[GP] == runs[NETWORK] == published.load("ball").numbers["runs"].value == 1350
    sizes = sorted({cell.options["known"] for cell in cells if cell.options.get("trained") == BALL})
    assert sizes == [17, 35, 52, 70, 87, 105, 122, 140, 157]
    for name in ("explicit", "explicit-paper", "explicit-paper-bundle"):
        lines = [cell.name for cell in cells if cell.name.startswith(f"ball/{name}/")]
        assert len(lines) == 3 * (1 + 10 + 10)
    growing = [cell for cell in active.cells(Source(0), FULL) if cell.options["method"] == GP]
    assert len(growing) == 3 * 5
    assert {(c.options["start"], c.options["additions"], c.options["lot"]) for c in growing} == {(35, 100, 1)}
    boards = board.cells(Source(0), FULL)
    assert {cell.options["boards"] for cell in boards} == {2, 3, 5, 9}
    assert len({cell.name for cell in [*cells, *boards]}) == len(cells) + len(boards)


def test_a_run_of_the_ball_is_a_fit_and_its_rms_error() -> None:
    source = Source(1)
    rows = ball.learn(source.options, BALL, "2R", GP, 35, 2)["rows"]
    assert [(row["run"], row["judged"]) for row in rows] == [(0, BALL), (0, CHECK), (1, BALL), (1, CHECK)]
    train, rest = source.data(BALL, "2R").split(35, seed=1)
    fit = InverseGP(preset="plain").fit(train)
    for row, held_out in zip(rows[2:], (rest, source.data(CHECK, "2R")), strict=True):
        found = fit.measure(held_out.observations)
        error = np.sqrt(((found.xyz - held_out.truth.xyz) ** 2).sum(axis=1).mean())
        assert row["rmse"] == pytest.approx(error, rel=1e-9)
        assert row["mean_sd"] == pytest.approx(found.sd.mean(), rel=1e-9)
        assert row["limit"] == pytest.approx(np.sqrt(np.trace(held_out.truth.limit, axis1=1, axis2=2).mean()), rel=1e-9)


def test_metres_are_told_as_millimetres(tmp_path: Path) -> None:
    rows = {}
    for unit in ("mm", "m"):
        rig = build_rig("stereo", seed=2, unit=unit)
        write_dataset(simulate(rig, ball_grid(rig, (4, 4, 4)), seed=1), tmp_path / unit)
        source = Source.of(tmp_path / unit, 0)
        (rows[unit],) = ball.learn(source.options, BALL, "all", GP, 40, 1)["rows"]
    assert rows["m"]["rmse"] == pytest.approx(rows["mm"]["rmse"], rel=1e-4)
    assert rows["m"]["mean_sd"] == pytest.approx(rows["mm"]["mean_sd"], rel=1e-4)


def test_a_failed_run_is_a_row_and_the_others_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    fit, calls = InverseGP.fit, []

    def sometimes(self: InverseGP, data: Dataset, *rest: Any) -> InverseGPCalibration:
        calls.append(data)
        if len(calls) == 1:
            raise FitError("no such luck.")
        return fit(self, data, *rest)

    monkeypatch.setattr(InverseGP, "fit", sometimes)
    rows = ball.learn(Source(0).options, RANDOM, "2R", GP, 17, 2)["rows"]
    assert [row["failure"] for row in rows] == ["no such luck.", ""]
    (line,) = tables.ball_table(rows)
    assert (line["runs"], line["failed"]) == (1, 1)
    assert np.isfinite(line["rmse"]).all()


def test_each_added_point_is_the_least_certain_one() -> None:
    source = Source(0)
    data = source.data(BALL, "2R")
    rows = active.grow(source.options, "2R", GP, [1], 20, 3, 1)["rows"]
    mask = np.isin(np.arange(len(data)), np.random.default_rng([1, 2]).permutation(len(data))[:20])
    for row in rows:
        assert row["known"] == mask.sum()
        fit = InverseGP(preset="plain").fit(data.select(mask))
        sd = fit.measure(data.select(~mask).observations).sd.mean(axis=1)
        assert row["max_sd"] == pytest.approx(sd.max(), rel=1e-9)
        assert row["mean_sd"] == pytest.approx(sd.mean(), rel=1e-9)
        mask[np.flatnonzero(~mask)[np.argmax(sd)]] = True


def test_between_two_fits_a_gaussian_process_keeps_its_hyperparameters() -> None:
    source = Source(0)
    data = source.data(BALL, "2R2W")
    rows = active.grow(source.options, "2R2W", GP, [0], 20, 2, 2)["rows"]
    assert [row["added"] for row in rows] == [0, 1, 2]
    mask = np.isin(np.arange(len(data)), np.random.default_rng([0, 2]).permutation(len(data))[:20])
    fit = InverseGP(preset="plain").fit(data.select(mask))
    sd = fit.measure(data.select(~mask).observations).sd.mean(axis=1)
    mask[np.flatnonzero(~mask)[np.argmax(sd)]] = True
    grown = replace(fit, data=data.select(mask))
    assert all(a is b for a, b in zip(grown.hyperparameters, fit.hyperparameters, strict=True))
    after = grown.measure(data.select(~mask).observations).sd.mean(axis=1)
    assert rows[1]["max_sd"] == pytest.approx(after.max(), rel=1e-9)
    assert after.max() < sd.max()  # more data, same hyperparameters: never less certain


@pytest.mark.slow
def test_other_methods_have_rows_where_they_are_fitted_only() -> None:
    rows = active.grow(Source(0).options, "2R", FORWARD, [0], 20, 5, 2)["rows"]
    assert [row["added"] for row in rows] == [0, 2, 4, 5]
    assert [row["known"] for row in rows] == [20, 22, 24, 25]


@pytest.mark.parametrize(("count", "which"), [(2, [0, 19]), (3, [0, 10, 19]), (5, [0, 5, 10, 14, 19])])
def test_the_boards_to_train_on_are_the_ends_and_those_between(count: int, which: list[int]) -> None:
    names = [f"board{i:02d}" for i in range(20)]
    assert board.training(names, count) == [names[i] for i in which]
    assert len(board.training(names, 9)) == 9
    assert board.training(names, 20) == names


def test_a_row_of_the_board_is_mean_and_spread_over_the_test_points() -> None:
    source = Source(0)
    found = board.learn(source.options, "2R", 3, GP)
    row, off = found["rows"]
    error = np.linalg.norm(found["xyz"] - found["true_xyz"], axis=1)
    assert len(error) == 17 * 88
    assert row["known"] == 3 * 88
    assert (row["error"], row["error_sd"]) == (pytest.approx(error.mean()), pytest.approx(error.std()))
    assert (row["sd"], row["sd_sd"]) == (pytest.approx(found["sd"].mean()), pytest.approx(found["sd"].std()))
    assert row["numbers"] == [i for i in range(20) if i not in (0, 10, 19)]
    assert np.mean(row["error_by_board"]) == pytest.approx(error.mean())
    assert off["judged"] == "board/check"
    assert 0.5 < off["rmse"] / row["rmse"] < 2


@pytest.mark.slow
def test_the_papers_preset_cannot_state_less_than_ten_millimetres() -> None:
    pytest.importorskip("gpytorch")
    row = board.learn(Source(0).options, "2R", 2, PAPER)["rows"][0]
    assert 10 < row["sd"] < 15
    assert row["error"] > 5  # between two boards it can only guess


# --- which findings hold ---


def rows_of_the_ball(factors: dict[str, float], *, spread: float = 0.05, sets: tuple[str, ...] = ("2R",)) -> list[Any]:
    """Runs whose errors are `factor` times a run's own size."""
    rng = np.random.default_rng(0)
    rows = []
    for cameras in sets:
        for known in (17, 52, 157):
            own = 10 / known * np.exp(spread * rng.normal(size=20))
            for method, factor in factors.items():
                where = {"set": cameras, "method": method, "trained": BALL, "judged": BALL, "known": known}
                rows += [
                    {**where, "run": run, "rmse": float(x * factor), "mean_sd": float(x), "failure": ""}
                    for run, x in enumerate(own)
                ]
        for budget, size in zip(BUDGETS, (0.04, 0.05, 0.08), strict=True):
            where = {"set": cameras, "judged": BALL, "budget": "{}+{}".format(*budget), "failure": ""}
            for method in LINES:
                for k, reprojection in enumerate((0.33, 0.31, 0.35)):  # the first is the median one
                    row = {"method": method, "run": k, "rmse": size * (1 + 0.01 * k), "reprojection": reprojection}
                    rows.append({**where, **row})
    return rows


def judged(rows: list[Any], key: str, method: str) -> findings.Verdict:
    (found,) = [v for v in findings.verdicts({"ball": rows}) if v.key == key and v.method == method]
    return found


def test_a_finding_holds_where_every_case_is_on_its_side() -> None:
    found = judged(rows_of_the_ball({GP: 1.0, NETWORK: 3.0}), "gp_beats_network", GP)
    assert found.verdict == HOLDS
    assert "is 3.00 times" in found.number  # paired: the runs' own spread cancels
    found = judged(rows_of_the_ball({GP: 1.0, NETWORK: 0.5}), "gp_beats_network", GP)
    assert found.verdict == FAILS
    assert "is 0.500 times" in found.number
    rows = rows_of_the_ball({GP: 1.0, NETWORK: 1.0})
    for row in rows:
        if row["method"] == NETWORK:
            row["rmse"] *= 1.2 if row["run"] % 2 else 1 / 1.2
    assert judged(rows, "gp_beats_network", GP).verdict == OPEN


def test_one_case_on_the_other_side_is_enough_and_how_many_hold_is_said() -> None:
    rows = rows_of_the_ball({GP: 1.0, NETWORK: 3.0})
    for row in rows:
        if row["method"] == NETWORK and row["known"] == 52:
            row["rmse"] /= 6
    found = judged(rows, "gp_beats_network", GP)
    assert found.verdict == FAILS
    assert "with 52 points" in found.number
    assert "in 2 of 3 cases it holds" in found.number


def test_several_rigs_are_the_evidence_and_their_splits_are_not() -> None:
    """Twenty splits of one rig agree to the last digit; the next rig says otherwise."""
    factors = (3.0, 2.0, 0.9, 4.0, 2.5)
    rows = [
        {**row, "rig": f"bar6-{i}"}
        for i, factor in enumerate(factors)
        for row in rows_of_the_ball({GP: 1.0, NETWORK: factor})
    ]
    found = judged(rows, "gp_beats_network", GP)
    expected = stats.ttest_1samp(np.log(factors), 0).confidence_interval(0.95)
    value = np.exp(np.mean(np.log(factors)))
    assert interval(value, np.exp(expected.low), np.exp(expected.high)) in found.number
    assert found.verdict == (HOLDS if expected.low > 0 else OPEN)
    alone = judged([row for row in rows if row["rig"] == "bar6-2"], "gp_beats_network", GP)
    assert alone.verdict == FAILS


def test_a_rig_whose_runs_failed_leaves_the_verdict_to_the_others() -> None:
    rows = [{**row, "rig": f"bar6-{i}"} for i in range(3) for row in rows_of_the_ball({GP: 1.0, NETWORK: 3.0 + i})]
    rows = [row | ({"failure": "diverged"} if row["rig"] == "bar6-1" else {}) for row in rows]
    found = judged(rows, "gp_beats_network", GP)
    assert f"is {np.sqrt(15):.3g} [" in found.number  # of 3 and 5 times


def test_runs_without_the_partner_and_failed_ones_do_not_count() -> None:
    rows = rows_of_the_ball({GP: 1.0, NETWORK: 3.0})
    lost = [row for row in rows if row["method"] == NETWORK and row["run"] > 9]
    for row in lost:
        row |= {"failure": "diverged", "rmse": float("nan")}
    assert "is 3.00 times" in judged(rows, "gp_beats_network", GP).number


def rows_of_growing(sds: Any, *, last: int = 40, starts: int = 3) -> list[Any]:
    """Active learning whose mean and largest standard deviation are sds(start, points added)."""
    return [
        {"set": "2R", "method": GP, "repeat": k, "added": i, "max_sd": sds(k, i), "mean_sd": sds(k, i), "failure": ""}
        for k in range(starts)
        for i in range(last + 1)
    ]


def grown(rows: list[Any], key: str) -> list[findings.Verdict]:
    return [v for v in findings.verdicts({"active": rows}) if v.key == key and v.method == GP]


def test_a_rise_is_no_fast_drop_and_few_points_decide_nothing() -> None:
    (found,) = grown(rows_of_growing(lambda k, i: 1 + 9 * 0.8**i + 0.01 * k), "sd_drops_fast")
    assert found.verdict == HOLDS
    (found,) = grown(rows_of_growing(lambda k, i: 10 - 0.2 * i + 0.01 * k * i), "sd_drops_fast")
    assert found.verdict == OPEN  # a straight line: half of it by half of the points
    assert grown(rows_of_growing(lambda k, i: 1 + 0.1 * i), "sd_drops_fast") == []
    assert grown(rows_of_growing(lambda k, i: 10 * 0.5**i, last=10), "sd_drops_fast") == []


def test_starts_converge_when_they_differ_by_little_of_the_drop() -> None:
    (found,) = grown(rows_of_growing(lambda k, i: 10 + (1 + 0.5 * k) * 0.7**i), "any_start_converges")
    assert found.verdict == HOLDS
    (found,) = grown(rows_of_growing(lambda k, i: 10 + 0.5 * k + 0.7**i), "any_start_converges")
    assert found.verdict == FAILS  # a floor of 10 does not make them one


def test_the_case_that_decides_is_shown_and_one_without_numbers_is_not_decided() -> None:
    rows = rows_of_the_ball({GP: 1.0, NETWORK: 3.0})
    for row in rows:
        if row["method"] == GP and row["known"] == 17:
            row["failure"] = "no such luck"
        if row["method"] == NETWORK and row["known"] == 52:
            row["rmse"] *= 0.5  # holds still, by less than the others
    found = judged(rows, "gp_beats_network", GP)
    assert found.verdict == HOLDS
    assert "with 52 points" in found.number
    rows = [row for row in rows if row["method"] != NETWORK or row["known"] != 157]
    found = judged(rows, "gp_beats_network", GP)
    assert (found.verdict, "with 157 points" in found.number) == (OPEN, True)


def test_lines_for_more_pictures_than_there_are_are_not_begun(tmp_path: Path) -> None:
    """With 10 + 4 pictures of measured data, eleven cells could only fail."""
    folder = measured(tmp_path / "mine")
    rig = build_rig("stereo", seed=1)
    names = [camera.name for camera in rig.cameras]
    groups = [(name,) for name in names for _ in range(10)] + [tuple(names)] * 4
    write_dataset(simulate_boards(rig, groups, seed=2), folder / "boards")
    cells = ball.cells(Source.of(folder, 0), replace(FULL, subsets=2))
    budgets = {cell.name.split("/")[3] for cell in cells if cell.name.startswith("ball/explicit")}
    assert budgets == {"10+4"}
    assert not [cell for cell in cells if "alignment" in cell.name]


def test_boards_are_in_the_order_of_their_numbers() -> None:
    source = Source(0)
    data = source.data(BOARD, "2R")
    names = np.char.replace(np.char.replace(data.shots, "board0", "place "), "board", "place ")
    assert data.known is not None
    renamed = replace(data, known=replace(data.known, shots=names))
    assert board.shots(renamed) == [f"place {i}" for i in range(1, 21)]


def test_six_cameras_of_the_papers_names_are_its_sets_and_others_are_one_set(tmp_path: Path) -> None:
    for spec, expected in (("bar6", ["2R", "2R2W", "2R4W"]), ("bar7", ["all"]), ("stereo", ["all"])):
        rig = build_rig(spec, seed=1)
        write_dataset(simulate(rig, ball_grid(rig, (3, 3, 3)), seed=1), tmp_path / spec)
        assert list(Source.of(tmp_path / spec, 0).sets) == expected


def test_data_without_known_positions_are_an_error(tmp_path: Path) -> None:
    rig = build_rig("stereo", seed=1)
    data = simulate(rig, ball_grid(rig, (3, 3, 3)), seed=1)
    write_dataset(replace(data, known=None), tmp_path / "unknown")
    with pytest.raises(DatasetError, match="no known positions"):
        reproduce(["ball"], tmp_path / "out", Source.of(tmp_path / "unknown", 0), TINY)


def test_parts_of_different_cameras_are_an_error_that_names_the_part(tmp_path: Path) -> None:
    folder = measured(tmp_path / "mine")
    rig = build_rig("bar2", seed=1)
    data = simulate(rig, moving_board(rig, corners=(4, 5), positions=5), seed=3)
    renamed = data.observations.cameras[0]
    cameras = (replace(renamed, name="left"), data.observations.cameras[1])
    other = replace(data, observations=replace(data.observations, cameras=cameras))
    write_dataset(other, folder / "board", overwrite=True)
    with pytest.raises(DatasetError, match="board has no camera cam1"):
        Source.of(folder, 0).data(BOARD, "all")


def test_explicit_is_a_line_that_the_most_points_must_cross() -> None:
    rows = rows_of_the_ball({GP: 0.5, NETWORK: 0.6}, sets=("2R2W",))
    found = judged(rows, "gp_beats_explicit", GP)  # 0.29, 0.096, 0.032 against 0.04
    assert found.verdict == HOLDS
    assert "its own with 157 points" in found.number
    assert judged(rows, "few_boards_hurt_explicit", GP).verdict == HOLDS  # 0.08 over 0.04: twice
    assert "2.00" in judged(rows, "few_boards_hurt_explicit", GP).number
    assert judged(rows, "learners_beat_poor_explicit", GP).verdict == HOLDS
    assert judged(rows_of_the_ball({GP: 2.0}), "explicit_wins_2R", GP).verdict == HOLDS
    assert judged(rows_of_the_ball({GP: 0.5}), "explicit_wins_2R", GP).verdict == FAILS


@pytest.mark.slow
@pytest.mark.parametrize("method", LINES)
def test_each_line_is_computed_by_its_own_pipeline(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    taken = list[Explicit]()

    def fit(self: Explicit, data: Dataset) -> None:
        taken.append(self)
        raise FitError("enough is known.")

    monkeypatch.setattr(Explicit, "fit", fit)
    rows = ball.line(Source(0).options, "2R", method, 10, 4, 0)["rows"]
    assert [(row["judged"], row["method"], row["failure"]) for row in rows] == [
        (judged, method, "enough is known.") for judged in (BALL, CHECK)
    ]
    assert (taken[0].preset, taken[0].align) == (method.partition(":")[2] or "joint", "icp")
    assert taken[0].boards is not None


@pytest.mark.slow
def test_a_line_of_the_papers_pipeline_has_its_reprojection_error() -> None:
    for row in ball.line(Source(0).options, "2R", EXPLICIT_PAPER, 10, 4, 0)["rows"]:
        assert not row["failure"]
        assert 0.2 < row["rmse"] < 0.8
        assert 0.25 < row["reprojection"] < 0.4
        assert 0.8 < row["ellipsoid_95"] <= 1
        assert row["calibrated"] == 2


def test_the_papers_software_is_judged_by_the_papers_pipeline_in_both_variants() -> None:
    rows = rows_of_the_ball({PAPER: 0.5, GP: 0.5, NETWORK: 0.6}, sets=("2R2W",))
    for row in rows:
        if row["method"] == EXPLICIT_BUNDLE and row["budget"] == "10+4":
            row["rmse"] /= 2  # few boards do not hurt this one
    assert judged(rows, "few_boards_hurt_explicit", GP).verdict == HOLDS
    found = judged(rows, "few_boards_hurt_explicit", PAPER)
    assert found.verdict == FAILS
    assert "explicit:paper-bundle" in found.number
    assert "in 1 of 2 cases" in found.number


def test_of_the_subsets_the_one_with_the_median_reprojection_error_counts() -> None:
    rows = [{"rmse": 9.0, "reprojection": 0.3}, {"rmse": 1.0, "reprojection": 0.4}, {"rmse": 2.0, "reprojection": 0.2}]
    assert evidence.median_row(rows, "reprojection") == rows[:1]
    assert evidence.median_row(rows[:2], "reprojection") == rows[:1]  # the lower one of two
    assert evidence.median_row([], "reprojection") == []


def test_every_finding_of_the_paper_is_judged() -> None:
    for experiment in EXPERIMENTS:
        assert set(findings.TESTS[experiment]) == set(published.load(experiment).findings)


def test_other_cameras_than_the_papers_are_judged_too() -> None:
    found = findings.verdicts({"ball": rows_of_the_ball({GP: 1.0, NETWORK: 3.0}, sets=("all",))})
    assert {verdict.sets for verdict in found} == {"all"}
    assert {v.verdict for v in found if v.key == "gp_beats_network" and v.method == GP} == {HOLDS}
    assert not [v for v in found if v.key == "more_cameras_lower_sd"]  # there is one set only


def test_intervals_are_students() -> None:
    rng = np.random.default_rng(4)
    a, b = np.exp(rng.normal(size=8)), np.exp(rng.normal(0.3, size=8))
    case = ratio(a, b, "{}")
    paired = stats.ttest_rel(np.log(a), np.log(b)).confidence_interval(0.95)
    assert (case.low, case.high) == (pytest.approx(np.exp(paired.low)), pytest.approx(np.exp(paired.high)))
    case = unpaired(a, b[:1], "{}")
    single = stats.ttest_1samp(np.log(a), np.log(b[0])).confidence_interval(0.95)
    np.testing.assert_allclose([case.low, case.high], np.exp([single.low, single.high]) / b[0], rtol=1e-9)


def test_a_drop_is_fast_when_more_than_half_of_it_comes_early() -> None:
    first, last = np.log(np.array([8.0, 9.0, 10.0])), np.log(np.array([1.0, 1.1, 1.2]))
    assert share_of_drop(first, 0.2 * first + 0.8 * last, last, "20").verdict == HOLDS
    assert share_of_drop(first, 0.8 * first + 0.2 * last, last, "20").verdict == FAILS
    assert Case(2.0, 0.5, 3.0, "").verdict == OPEN


# --- tables and text ---


def test_the_tables_say_what_the_rows_say() -> None:
    where = {"set": "2R", "judged": CHECK, "failure": "", "trained": BALL}
    rows = [{**where, "method": FORWARD, "known": 17, "run": k, "rmse": 1.0 + k, "limit": 0.5} for k in range(3)]
    rows += [{**where, "method": GP, "known": 157, "run": k, "rmse": 4.0, "limit": 0.5} for k in range(3)]
    (line,) = tables.tenfold(rows)
    assert (line["few"], line["most"]["known"], line["best"]["known"]) == (17, 157, 157)
    assert line[FORWARD] == [1.5, 2.0, 2.5]
    assert line["most"][GP] == [4.0, 4.0, 4.0]
    assert line["most"]["times"][0] == pytest.approx(4.0 / 6.0 ** (1 / 3))  # over the geometric mean of 1, 2, 3
    rows += [{**where, "method": GP, "known": 87, "run": k, "rmse": 2.0, "limit": 0.5} for k in range(3)]
    assert tables.tenfold(rows)[0]["best"]["known"] == 87
    rows = rows[:-3]
    rows += [{**row, "judged": BALL, "rmse": row["rmse"] / 4} for row in rows]
    assert {(r["method"], r["random"] / r["lattice"]) for r in tables.lattice_bias(rows)} == {(FORWARD, 4.0), (GP, 4.0)}


def test_markdown_numbers() -> None:
    assert (number(None), number(-1.234, sign=True), number(1.234, sign=True)) == ("–", "−1.23", "+1.23")
    assert (quartiles([1, 1, 1]), quartiles([1.0, 2.0, 3.0])) == ("1.00", "2.00 [1.0, 3.0]")
    assert table(["a", "b"], [["x", "1"]]) == "| a | b |\n| :-- | --: |\n| x | 1 |"


# --- everything, on data of somebody else ---


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Source, Any]:
    for library in ("torch", "gpytorch", "joblib", "matplotlib", "plotly"):
        pytest.importorskip(library)
    folder = tmp_path_factory.mktemp("paper")
    source = Source.of(measured(folder / "mine"), 0)
    return folder / "out", source, reproduce(EXPERIMENTS, folder / "out", source, TINY, jobs=1)


@pytest.mark.slow
def test_measured_data_of_another_rig_run_through(done: tuple[Path, Source, Any]) -> None:
    out, source, made = done
    assert made.failures == {}
    assert made.summary["source"]["folder"] == source.folder
    for name in ("ball", "active", "board"):
        with (out / f"{name}.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert {row["method"] for row in rows} >= {PAPER, GP, NETWORK, FORWARD}
        assert {row["set"] for row in rows} == {"all"}
    text = (out / "reproduce.md").read_text()
    assert "The data are measured" in text
    assert "NaN" not in text
    assert " nan" not in text
    for name in made.summary["figures"]:
        assert (out / "figures" / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
        assert (out / "figures" / f"{name}.pdf").read_bytes()[:4] == b"%PDF"
        assert f"figures/{name}.png" in text
    page = (out / "figures" / "ball-example.html").read_text()
    assert "<script src" not in page
    assert json.loads((out / "summary.json").read_text())["cells"]["failed"] == 0


@pytest.mark.slow
def test_run_again_nothing_is_computed_twice(done: tuple[Path, Source, Any]) -> None:
    out, source, made = done
    before = (out / "ball.csv").read_bytes()
    again = reproduce(EXPERIMENTS, out, source, TINY)
    assert again.summary["cells"]["already"] == again.summary["cells"]["all"]
    assert (out / "ball.csv").read_bytes() == before
    assert again.summary["verdicts"] == made.summary["verdicts"]


@pytest.mark.slow
def test_one_experiment_keeps_the_others_in_the_account(done: tuple[Path, Source, Any]) -> None:
    out, source, made = done
    again = reproduce(["board"], out, source, TINY)
    assert again.summary["parts"].keys() == made.summary["parts"].keys()
    assert json.dumps(again.summary["ball"]) == json.dumps(made.summary["ball"])  # a NaN is not equal to itself


@pytest.mark.slow
def test_other_plans_have_results_of_their_own(done: tuple[Path, Source, Any]) -> None:
    out, source, _ = done
    assert {path.name for path in (out / "cells").iterdir()} == {f"tiny-{source.name}"}
    assert len({QUICK.name, FULL.name, FULL.with_runs(3).name, FULL.with_runs(4).name, FULL.shared_by(5).name}) == 5


def test_rigs_share_the_runs_but_each_keeps_a_few() -> None:
    assert FULL.shared_by(1) is FULL
    for rigs in (2, 5, 20):
        of_each = FULL.shared_by(rigs).runs
        assert of_each[NETWORK] == of_each[GP] == max(5, 50 // rigs)
        assert {of_each[method] - FULL.runs[method] for method in (PAPER, FORWARD)} == {0}


def test_an_experiment_without_data_is_named(tmp_path: Path) -> None:
    source = Source.of(measured(tmp_path / "mine") / "ball", 0)
    with pytest.raises(DatasetError, match="no data for board"):
        reproduce(["board"], tmp_path / "out", source, TINY)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_cell_that_fails_is_told_and_the_rest_is_written(tmp_path: Path) -> None:
    folder = measured(tmp_path / "mine")
    cells = ball.cells(Source.of(folder, 0), TINY)
    broken = [replace(cell, options={**cell.options, "method": "no-such"}) for cell in cells[:1]]
    results = run([*broken, *cells[-1:]], tmp_path / "cells", jobs=1)
    assert "no-such" in results.failures[cells[0].name]
    assert cells[-1].name in results.values


def command(*words: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main(["paper", *words])
    said = capsys.readouterr()
    return int(ended.value.code or 0), said.out, said.err


@pytest.mark.slow
def test_the_command_prints_tables_or_json_and_goes_on_from_what_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("implicam.experiments.plan.QUICK", replace(TINY, name="quick", boards=(2,)))
    monkeypatch.setattr("implicam.experiments.board.METHODS", (GP, FORWARD))
    monkeypatch.setattr("implicam.cli.show.FIRST_LINE_SECONDS", 3600.0)  # of work that takes long on a busy machine
    words = ["board", "--quick", "--jobs", "1", "--data", str(measured(tmp_path / "mine")), "-o", str(tmp_path / "out")]
    code, out, err = command(*words, capsys=capsys)
    assert (code, err) == (0, "")
    assert "seconds of work" in out
    assert str(tmp_path / "out" / "reproduce.md") in out
    code, out, err = command(*words, "--json", capsys=capsys)
    told = json.loads(out)
    assert (code, err) == (0, "")
    assert told["cells"] == {"all": 2, "already": 2, "failed": 0}
    assert {row["method"] for row in told["board"]} == {GP, FORWARD}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["board", "--data", "no-such"], "is not a folder"),
        (["board", "-o", "out.csv"], "is the name of a file"),
        (["boards"], "boards"),
        (["board", "--quick", "--jobs", "2", "--scheduler", "tcp://localhost:1"], "not both"),
        (["board", "--quick", "--scheduler", "tcp://localhost:1"], "no Dask scheduler"),
    ],
)
def test_wrong_usage_is_told_and_leaves_nothing(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("implicam.workers.CONNECT_SECONDS", 1)
    code, _, err = command(*words, capsys=capsys)
    assert code in (1, 2)
    assert said in err
    assert not list(tmp_path.rglob("*.csv"))


def test_without_a_library_the_error_comes_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpytorch", None)
    with pytest.raises(MissingExtraError, match="gpytorch"):
        reproduce(["board"], tmp_path / "out", Source(0), TINY)
    assert not (tmp_path / "out").exists()


def test_the_page_of_the_docs_is_what_its_numbers_make() -> None:
    """docs/reproduce.md is written by `make paper`; its numbers are kept in benchmarks/results."""
    summary = json.loads((ROOT / "benchmarks" / "results" / "paper.json").read_text())
    assert (ROOT / "docs" / "reproduce.md").read_text() == markdown(summary, figures="images/paper")


def test_reasons_are_of_findings_of_the_paper() -> None:
    reasons = tomllib.loads((ROOT / "src" / "implicam" / "experiments" / "reasons.toml").read_text())["reasons"]
    given = [key for reason in reasons for key in reason["findings"]]
    assert len(given) == len(set(given))
    assert set(given) <= {key for name in EXPERIMENTS for key in published.load(name).findings}


def test_every_method_has_a_name_that_makes_it() -> None:
    pytest.importorskip("gpytorch")
    for name in METHODS:
        assert calibrator_from_name(name).method == name.partition(":")[0]
