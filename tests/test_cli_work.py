"""The commands that work on rigs: simulate, calibrate, measure, evaluate, compare, convert, info, report."""

from __future__ import annotations

import hashlib
import re
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import Cli, cli, files, made, read_measured  # noqa: F401  fixtures
from implicam.calibrators import load_calibration
from implicam.dataset import read_dataset, write_dataset

# simulate


def test_simulate_writes_rig_truth_and_check_points(cli: Cli) -> None:
    ran = cli("simulate", "rig", "--cameras", "2R2W", "--grid", "2x3x4", "--check", "7", "--seed", "3")
    assert ran.code == 0
    data, check = read_dataset("rig"), read_dataset("rig/check")
    assert (len(data), len(check)) == (24, 7)
    assert data.observations.camera_names == ("cam2", "cam3", "cam4", "cam5")
    assert data.truth is not None
    assert check.truth is not None
    assert "rig: 24 points, " in ran.out
    assert "4 cameras" in ran.out
    assert (Path("rig") / "truth.toml").is_file()
    np.testing.assert_allclose(check.truth.xyz, check.xyz)


def test_simulate_options_do_what_they_say(cli: Cli) -> None:
    def simulated(*options: object) -> Any:
        name = f"rig{len(list(Path.cwd().iterdir()))}"
        assert cli("simulate", name, "--rig", "stereo", *options).code == 0
        return read_dataset(name)

    plain = simulated()
    assert len(plain) == 175
    assert plain.length_unit == "mm"
    share = 1 - simulated("--missing", 0.3).observations.seen.mean() / plain.observations.seen.mean()
    assert 0.2 < share < 0.4
    wrong = (simulated("--outliers", 0.2).observations.extra["outlier"] == "1").mean()
    assert 0.1 < wrong < 0.3
    noisy = simulated("--robot-noise", 0.5)
    assert np.std(noisy.xyz - noisy.truth.xyz) == pytest.approx(0.5, rel=0.15)
    assert (noisy.known.sd == 0.5).all()
    np.testing.assert_allclose(simulated("--unit", "m").xyz, plain.xyz / 1000)
    assert np.ptp(simulated("--frame", "random").xyz, axis=0) != pytest.approx(np.ptp(plain.xyz, axis=0), rel=0.01)
    board = simulated("--target", "board", "--boards", 3)
    assert len(np.unique(board.shots)) == 3
    quiet = simulated("--noise", 0, "--lens-error", 0)
    assert (
        np.abs(quiet.observations.uv - quiet.observations.extra["true_u"].astype(float)[..., None])[..., 0].max() == 0
    )
    np.testing.assert_array_equal(simulated().observations.uv, plain.observations.uv)
    again, other = simulated("--shots-seed", 7), simulated("--seed", 7)
    np.testing.assert_array_equal(again.xyz, plain.xyz)
    assert np.abs(again.observations.uv - plain.observations.uv).max() < 5  # the same rig, other noise
    assert np.abs(other.observations.uv - plain.observations.uv).max() > 5  # another rig
    assert len(simulated("--rig", "dome5", "--positions", "random", "--points", 12).cameras) == 5


def test_simulate_makes_cameras_that_are_not_ordinary(cli: Cli) -> None:
    odd = ["--tilt", "5", "--mirror", "cam2", "--aspect", "1.25", "--window", "15"]
    assert cli("simulate", "odd", "--rig", "stereo", "--noise", 0, *odd).code == 0
    assert cli("simulate", "plain", "--rig", "stereo", "--noise", 0).code == 0
    truth, plain_truth = (tomllib.loads((Path(name) / "truth.toml").read_text()) for name in ("odd", "plain"))
    assert (truth["tilt"], truth["mirror"], truth["aspect"], truth["window"]) == (5, "cam2", 1.25, 15)
    assert not set(truth) - set(plain_truth) - {"tilt", "mirror", "aspect", "window"}
    cam1, cam2 = truth["cameras"]
    assert "mirrored" not in cam1
    assert cam2["mirrored"]
    assert cam1["height"] == 1280
    assert cam1["window"]["thickness"] == 15
    data, plain = read_dataset("odd"), read_dataset("plain")
    np.testing.assert_array_equal(data.xyz, plain.xyz)
    assert data.truth is not None
    assert np.isfinite(data.truth.limit[data.observations.seen.all(axis=1)]).all()


def test_simulate_refuses_to_overwrite_unless_told(cli: Cli) -> None:
    assert cli("simulate", "rig", "--rig", "stereo", "--check", 5).code == 0
    before = files(Path("rig"))
    ran = cli("simulate", "rig", "--rig", "stereo", "--seed", 1)
    assert ran.code == 1
    assert "add --overwrite" in ran.err
    assert files(Path("rig")) == before
    assert cli("simulate", "rig", "--rig", "stereo", "--seed", 1, "--overwrite").code == 0
    after = files(Path("rig"))
    assert after["observations.csv"] != before["observations.csv"]
    assert not [name for name in after if name.startswith("check")]


# calibrate, measure, evaluate, convert, info


def test_the_default_method_is_forward_gp(made: Path, cli: Cli) -> None:
    assert "forward-gp from 40 points" in cli("calibrate", made / "rig", "-o", "x.implicam").out
    told = cli("info", "x.implicam", "--json").json
    assert (told["method"], told["options"]["lens"]) == ("forward-gp", "auto")
    assert "(default forward-gp)" in " ".join(cli("calibrate", "--help").out.replace("│", " ").split())
    assert cli("evaluate", made / "rig", "--cv", "3", "--json").json["method"] == "forward-gp"
    # an option that only the other method has means that method
    assert "inverse-gp from 40" in cli("calibrate", made / "rig", "-o", "x.implicam", "--kernel", "matern-5/2").out


@pytest.mark.slow
def test_the_lens_is_an_option_of_forward_gp(made: Path, cli: Cli) -> None:
    ran = cli("calibrate", made / "rig", "-o", "none.implicam", "--lens", "none")
    assert ran.code == 0
    assert "forward-gp from 40 points" in ran.out
    assert cli("info", "none.implicam", "--json").json["options"]["lens"] == "none"
    assert cli("measure", "none.implicam", made / "rig" / "check").out.startswith("measured.csv: 30 rows, 30 measured")
    assert cli("calibrate", made / "rig", "-o", "auto.implicam", "--lens", "auto").code == 0
    assert Path("auto.implicam").read_bytes() == (made / "rig.implicam").read_bytes()
    by_lens = [cli("evaluate", made / "rig", "--cv", "3", "--lens", lens, "--json") for lens in ("central", "none")]
    assert [ran.code for ran in by_lens] == [0, 0]
    assert by_lens[0].json["rows"] != by_lens[1].json["rows"]


@pytest.mark.slow
def test_compare_takes_forward_gp_with_either_lens(made: Path, cli: Cli) -> None:
    methods = ["forward-gp", "forward-gp:none", "inverse-gp"]
    words = ("compare", made / "rig", "--train", "12,30", "--seeds", "1", "--methods", ",".join(methods))
    told = cli(*words, "--json").json
    assert [(row["known"], row["method"], row["failures"]) for row in told["rows"]] == [
        (known, method, []) for known in (12, 30) for method in methods
    ]
    rmse = {(row["known"], row["method"]): row["mean"]["rmse"] for row in told["rows"]}
    assert len(set(rmse.values())) == 6
    assert rmse[12, "forward-gp"] < rmse[12, "inverse-gp"] / 5
    assert "forward-gp:none" in cli(*words).out


def displaced(folder: Path, views: dict[int, str], pixels: float = 30.0) -> list[tuple[str, str]]:
    """Move views (row of the point -> camera) of a dataset that far; the names of the points, and the cameras."""
    data = read_dataset(folder)
    uv = data.observations.uv.copy()
    for row, camera in views.items():
        uv[row, data.observations.camera_names.index(camera)] += pixels / np.sqrt(2)
    moved = replace(data, observations=replace(data.observations, uv=uv))
    write_dataset(moved, folder, overwrite=True)
    return [(str(data.points[row]), camera) for row, camera in views.items()]


def four_cameras(cli: Cli) -> None:
    """A rig of cam2, cam3, cam4, cam5 with 40 known points and 30 to check."""
    cli("simulate", "rig", "--cameras", "2R2W", "--positions", "random", "--points", 40, "--check", 30, "--seed", 1)
    shutil.move("rig/check", "check")


@pytest.mark.slow
def test_calibrate_says_which_views_it_rejected(cli: Cli) -> None:
    four_cameras(cli)
    wrong = displaced(Path("rig"), {3: "cam3", 17: "cam5"})
    ran = cli("calibrate", "rig", "-o", "x.implicam")
    assert ran.code == 0
    assert "contradict" not in ran.out
    (note,) = [line for line in ran.err.splitlines() if "views contradict the others and are not used" in line]
    assert note.startswith("note: 2 of ")
    for point, camera in wrong:
        assert f"{point} in {camera} (" in note
    told = cli("calibrate", "rig", "-o", "x.implicam", "--json").json
    assert {(view["point"], view["camera"]) for view in told["rejected"]} == set(wrong)
    assert len(told["rejected"]) == 2
    assert [view["residual"] for view in told["rejected"]] == pytest.approx([30, 30], abs=3)
    assert told["unused"] == []
    assert cli("calibrate", "check", "-o", "y.implicam", "--json").json["rejected"] == []
    assert cli("calibrate", "rig", "-o", "x.implicam", "--method", "inverse-gp", "--json").json["rejected"] == []


@pytest.mark.slow
def test_a_point_measured_without_a_contradicting_view_counts_as_measured(cli: Cli) -> None:
    four_cameras(cli)
    cli("calibrate", "rig", "-o", "x.implicam")
    (one,) = displaced(Path("check"), {8: "cam4"})
    ran = cli("measure", "x.implicam", "check")
    assert ran.out.startswith("measured.csv: 30 rows, 30 measured, ")
    assert ran.err == "note: 1 point measured without cam4, whose view contradicts the others\n"
    rows = {row["point"]: row for row in read_measured(Path("measured.csv"))}
    assert rows[one[0]]["reason"] == "measured without cam4, whose view contradicts the others"
    assert rows[one[0]]["views"] == "3"
    assert rows[one[0]]["x"] != ""
    displaced(Path("check"), {11: "cam4", 12: "cam2"})
    ran = cli("measure", "x.implicam", "check")
    assert ran.err.splitlines() == [
        "note: 3 points measured without a view that contradicts the others; of these:",
        "note: 2 points measured without cam4, whose view contradicts the others",
        "note: 1 point measured without cam2, whose view contradicts the others",
    ]
    told = cli("measure", "x.implicam", "check", "--json").json
    assert (told["points_measured"], told["not_measured"], len(told["views_left_out"])) == (30, [], 3)
    ran = cli("evaluate", "x.implicam", "check")
    assert "note: 3 points measured without a view" in ran.err
    assert "not measured" not in ran.out + ran.err
    told = cli("evaluate", "x.implicam", "check", "--json").json
    assert (told["rows"][0]["n"], told["rows"][0]["unmeasured"], told["not_measured"]) == (30, 0, [])
    assert len(told["views_left_out"]) == 3


@pytest.mark.slow
def test_measure_does_without_a_camera_that_is_not_there(cli: Cli) -> None:
    four_cameras(cli)
    check = read_dataset("check")
    write_dataset(check.without(["cam4"]), "three")
    cli("calibrate", "rig", "-o", "x.implicam")
    ran = cli("measure", "x.implicam", "three")
    assert ran.out.startswith("measured.csv: 30 rows, 30 measured, ")
    assert ran.err == ""
    rows = read_measured(Path("measured.csv"))
    assert {row["views"] for row in rows} == {"3"}
    xyz = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
    assert np.sqrt(np.mean((xyz - check.xyz) ** 2)) < 1
    cli("calibrate", "rig", "-o", "x.implicam", "--method", "inverse-gp")
    ran = cli("measure", "x.implicam", "three")
    assert ran.code == 1
    assert "the observations have no camera 'cam4'" in ran.err


@pytest.mark.slow
def test_one_camera_alone_measures_nothing_and_says_why(cli: Cli) -> None:
    four_cameras(cli)
    cli("calibrate", "rig", "-o", "x.implicam")
    write_dataset(read_dataset("check").with_cameras(["cam4"]), "alone")
    ran = cli("measure", "x.implicam", "alone")
    assert ran.code == 0
    assert ran.out == "measured.csv: 30 rows, 0 measured\n"
    assert ran.err == "note: 30 points not measured: only cam4 saw it; a position takes two cameras\n"


@pytest.mark.parametrize(("method", "why", "testable"), [
    ("forward-gp", "only cam3 saw it; a position takes two cameras", True),
    ("inverse-gp", "inverse-gp needs every camera; not seen by cam2", False),
])  # fmt: skip
def test_measure_keeps_every_row(method: str, why: str, testable: bool, made: Path, cli: Cli) -> None:
    cli("calibrate", made / "rig", "-o", "rig.implicam", "--method", method)
    check = read_dataset(made / "rig" / "check")
    folder = Path("new-points")
    shutil.copytree(made / "rig" / "check", folder)
    (folder / "points.csv").unlink()  # to be measured: nobody knows where they are
    lines = (folder / "observations.csv").read_text().splitlines(keepends=True)
    (folder / "observations.csv").write_text("".join(lines[:1] + lines[2:]))  # the first point keeps one view
    ran = cli("measure", "rig.implicam", folder, "-o", "deep/measured.csv")
    assert ran.code == 0
    rows = read_measured(Path("deep/measured.csv"))
    assert [row["point"] for row in rows] == [str(name) for name in read_dataset(folder).points]
    one, *others = rows
    assert (one["views"], one["x"], one["sd_z"], one["cov_xy"]) == ("1", "", "", "")
    assert one["reason"] == why
    direct = load_calibration("rig.implicam").measure(check.observations)
    at = {str(name): i for i, name in enumerate(check.points)}
    for row in others:
        i = at[row["point"]]
        assert [float(row[axis]) for axis in "xyz"] == pytest.approx(direct.xyz[i], rel=1e-9)
        assert float(row["sd_x"]) == pytest.approx(direct.sd[i, 0], rel=1e-6)
        assert (row["views"], row["reason"]) == ("2", "")
        assert (row["consistency"] != "") is testable  # one map from all pixels has nothing to hold them against
        if testable:
            assert float(row["consistency"]) == pytest.approx(direct.consistency[i], rel=1e-9)
    assert "29 measured" in ran.out


def test_measure_from_every_form_gives_the_same(made: Path, cli: Cli) -> None:
    forms = ["check.csv", "check.npz", "check-folder"]
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        pass
    else:
        forms.append("check.parquet")
    assert cli("measure", made / "rig.implicam", made / "rig" / "check").code == 0
    expected = Path("measured.csv").read_bytes()
    for form in forms:
        assert cli("convert", made / "rig" / "check", form).code == 0
        assert cli("measure", made / "rig.implicam", form, "-o", "again.csv").code == 0
        assert Path("again.csv").read_bytes() == expected


@pytest.mark.slow
def test_a_wide_csv_of_a_stranger(made: Path, cli: Cli) -> None:
    """No description beside it: measuring needs none, learning must know the unit."""
    cli("convert", made / "rig", "rig.csv")
    Path("rig.csv.toml").unlink()
    ran = cli("calibrate", "rig.csv", "-o", "x.implicam")
    assert ran.code == 1
    assert "add --unit mm" in ran.err
    assert cli("calibrate", "rig.csv", "-o", "x.implicam", "--unit", "mm").code == 0
    ran = cli("measure", "x.implicam", "rig.csv")
    assert ran.code == 0
    assert "40 measured" in ran.out
    ran = cli("evaluate", "x.implicam", made / "rig" / "check")
    assert ran.code == 0


def test_the_unit_of_what_is_measured_does_not_matter_and_that_of_known_points_does(made: Path, cli: Cli) -> None:
    cli("simulate", "in-m", "--cameras", "2R", "--positions", "random", "--points", "10", "--unit", "m", "--seed", "1")
    assert cli("measure", made / "rig.implicam", "in-m").code == 0
    ran = cli("evaluate", made / "rig.implicam", "in-m")
    assert ran.code == 1
    assert "is in m, and the calibration is in mm" in ran.err


def test_measured_points_come_in_the_unit_that_is_asked_for(made: Path, cli: Cli) -> None:
    tables = {}
    for unit in ("mm", "m"):
        ran = cli("measure", made / "rig.implicam", made / "rig" / "check", "--unit", unit, "-o", f"{unit}.csv")
        assert ran.code == 0
        assert f" {unit}\n" in ran.out
        tables[unit] = np.genfromtxt(f"{unit}.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    for column, power in (("x", 1), ("sd_z", 1), ("cov_xy", 2)):
        np.testing.assert_allclose(tables["m"][column] * 1e3**power, tables["mm"][column], rtol=1e-9)
    ran = cli("measure", made / "rig.implicam", made / "rig" / "check", "--unit", "furlong", "-o", "x.csv")
    assert ran.code == 1
    assert "furlong" in ran.err
    assert not Path("x.csv").exists()


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["csv", "xlsx", "parquet"])
def test_what_was_measured_is_written_as_its_name_says(ending: str, made: Path, cli: Cli) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip({"csv": "pandas", "xlsx": "openpyxl", "parquet": "pyarrow"}[ending])
    told = cli("measure", made / "rig.implicam", made / "rig" / "check").out
    assert cli("measure", made / "rig.implicam", made / "rig" / "check", "-o", f"new/m.{ending}").out == told.replace(
        "measured.csv", f"new/m.{ending}"
    )
    read = {"csv": pandas.read_csv, "xlsx": pandas.read_excel, "parquet": pandas.read_parquet}[ending]
    found = read(f"new/m.{ending}").replace("", float("nan"))
    pandas.testing.assert_frame_equal(found, pandas.read_csv("measured.csv"), check_dtype=False)


@pytest.mark.slow
def test_a_unit_without_a_known_size_measures_and_is_not_converted(made: Path, cli: Cli) -> None:
    cli("convert", made / "rig", "rig.csv")
    Path("rig.csv.toml").unlink()
    assert cli("calibrate", "rig.csv", "-o", "x.implicam", "--unit", "squares").code == 0
    assert cli("measure", "x.implicam", made / "rig" / "check").code == 0
    assert cli("measure", "x.implicam", made / "rig" / "check", "--unit", "squares").code == 0
    ran = cli("measure", "x.implicam", made / "rig" / "check", "--unit", "m", "-o", "x.csv")
    assert ran.code == 1
    assert "squares" in ran.err
    assert not Path("x.csv").exists()


@pytest.mark.slow
def test_cameras_and_without(cli: Cli) -> None:
    cli("simulate", "rig", "--positions", "random", "--points", "60", "--check", "20")
    assert cli("calibrate", "rig", "-o", "a.implicam", "--cameras", "cam2, cam3").code == 0
    assert cli("calibrate", "rig", "-o", "b.implicam", "--without", "cam1,cam4,cam5,cam6").code == 0
    assert Path("a.implicam").read_bytes() == Path("b.implicam").read_bytes()
    told = cli("info", "a.implicam", "--json").json
    assert [camera["name"] for camera in told["cameras"]] == ["cam2", "cam3"]
    told = cli("evaluate", "a.implicam", "rig/check", "--json").json
    assert told["rows"][0]["rmse_over_limit"] is None  # the limit written beside the points is that of six cameras
    # a calibration file carries its data, and the choice of cameras holds for those, too
    assert cli("calibrate", "rig", "-o", "all.implicam").code == 0
    of_file = cli("evaluate", "all.implicam", "--cv", "3", "--cameras", "cam2,cam3", "--json").json
    of_data = cli("evaluate", "rig", "--cv", "3", "--without", "cam1,cam4,cam5,cam6", "--json").json
    assert of_file["rows"] == of_data["rows"]


@pytest.mark.slow
def test_points_kept_back_are_there_to_evaluate(made: Path, cli: Cli) -> None:
    assert cli("calibrate", made / "rig", "-o", "x.implicam", "--points", "25").code == 0
    ran = cli("evaluate", "x.implicam", made / "rig")
    assert ran.code == 0
    assert "15 points not used in the fit; 25 of this dataset were, and are left out" in ran.out
    other = cli("calibrate", made / "rig", "-o", "y.implicam", "--points", "25", "--seed", "1")
    assert other.code == 0
    points = [set(load_calibration(f"{name}.implicam").data.points) for name in "xy"]
    assert points[0] != points[1]
    assert cli("calibrate", made / "rig", "-o", "all.implicam", "--points", "40").code == 0


@pytest.mark.slow
def test_evaluate_in_turn_by_file_or_by_dataset(made: Path, cli: Cli) -> None:
    by_file = cli("evaluate", made / "rig.implicam", "--cv", "4", "--json").json
    by_data = cli("evaluate", made / "rig", "--cv", "4", "--json").json
    assert by_file["rows"] == by_data["rows"]
    assert by_file["how"] == "4-fold cross-validation (seed 0)"
    assert cli("evaluate", made / "rig", "--cv", "4", "--seed", "9", "--json").json["rows"] != by_data["rows"]
    inverse = cli("evaluate", made / "rig", "--cv", "4", "--method", "inverse-gp", "--json").json
    other = cli("evaluate", made / "rig", "--cv", "4", "--kernel", "matern-5/2", "--json").json
    assert inverse["method"] == other["method"] == "inverse-gp"
    assert other["rows"] != inverse["rows"]
    cli("simulate", "board", "--rig", "stereo", "--target", "board", "--boards", "4", "--seed", "2")
    ran = cli("evaluate", "board", "--leave-out", "shot", "--json").json
    assert ran["how"] == "each of 4 shots left out in turn"
    assert ran["rows"][0]["cluster_kind"] == "shots"


def test_the_verdict_says_how_much(made: Path, cli: Cli) -> None:
    ran = cli("evaluate", made / "rig.implicam", made / "rig" / "check")
    assert re.search(
        r"^error bars: (too small|right|too large|cannot tell); the mean NEES is [\d.]+ \[[\d.]+,\s?[\d.]+\], and 3 is "
        r"right; the 95 % ellipsoids hold [\d.]+ %, and [\d.]+ times as large would hold 95 %$",
        ran.out,
        re.MULTILINE,
    )


def test_convert_round_trip_loses_nothing(made: Path, cli: Cli) -> None:
    original = files(made / "rig" / "check")
    for form in ("a.csv", "b.npz", "c"):
        assert cli("convert", made / "rig" / "check", form).code == 0
        ran = cli("convert", form, f"back-{form.replace('.', '-')}")
        assert ran.code == 0
        assert "30 points, 2 cameras" in ran.out
        assert files(Path(f"back-{form.replace('.', '-')}")) == original


def test_info_shows_the_readable_part(made: Path, cli: Cli) -> None:
    ran = cli("info", made / "rig.implicam")
    assert 'method = "forward-gp"' in ran.out
    assert "known_points = 40" in ran.out
    sha256 = hashlib.sha256((made / "rig.implicam").read_bytes()).hexdigest()
    assert ran.out.startswith(f'sha256 = "{sha256}"')
    assert cli("info", made / "rig.implicam", "--json").json["sha256"] == sha256
    damaged = Path("damaged.implicam")
    damaged.write_bytes((made / "rig.implicam").read_bytes()[:-100])
    assert cli("info", damaged).code == 1


@pytest.mark.slow
def test_report_of_a_calibration_alone_and_with_points(made: Path, cli: Cli) -> None:
    pytest.importorskip("plotly")
    ran = cli("report", made / "rig.implicam")
    assert ran.code == 0
    assert "report.html: 10-fold cross-validation" in ran.out
    assert "10-fold" in Path("report.html").read_text()
    assert hashlib.sha256((made / "rig.implicam").read_bytes()).hexdigest() in Path("report.html").read_text()
    assert cli("report", made / "rig.implicam", made / "rig" / "check", "-o", "b.html").code == 0
    assert "30 points not used in the fit" in Path("b.html").read_text()


@pytest.mark.slow
def test_the_same_command_writes_the_same_bytes(made: Path, cli: Cli) -> None:
    cli("calibrate", made / "rig", "-o", "again.implicam")
    assert Path("again.implicam").read_bytes() == (made / "rig.implicam").read_bytes()
    cli(
        "simulate",
        "again",
        "--cameras",
        "2R",
        "--positions",
        "random",
        "--points",
        "40",
        "--check",
        "30",
        "--seed",
        "1",
    )
    assert files(Path("again")) == files(made / "rig")


@pytest.mark.slow
def test_the_classical_way_on_the_command_line(made: Path, cli: Cli) -> None:
    assert cli("simulate", "boards", "--target", "boards", "--cameras", "2R", "--seed", "1", "--pairs", "6").code == 0
    ran = cli("calibrate", made / "rig", "--boards", "boards", "-o", "b.implicam")  # nobody means another method
    assert ran.code == 0
    assert ran.out.startswith("b.implicam: explicit from 40 points\neach left out in turn is predicted from the rest")
    same = cli("calibrate", made / "rig", "--boards", "boards", "--align", "icp", "-o", "c.implicam", "--json").json
    assert set(same["residuals"]["lens"]) == {"cam2", "cam3"}
    told = cli("evaluate", "b.implicam", made / "rig" / "check", "--json").json
    assert told["rows"][0]["rmse_over_limit"] < 3
    alone = cli("calibrate", "boards", "-o", "alone.implicam")
    assert alone.out.startswith("alone.implicam: explicit from")
    assert "Positions are in the frame of cam2" in alone.err
    turned = cli("evaluate", made / "rig", "--cv", "4", "--boards", "boards", "--json").json
    assert (turned["method"], turned["rows"][0]["n"]) == ("explicit", 40)
    assert cli("calibrate", made / "rig", "--lens", "kannala-brandt", "-o", "k.implicam").out.startswith(
        "k.implicam: explicit from 40 points"
    )
    for to, name in (("opencv", "b.yaml"), ("kalibr", "camchain.yaml"), ("colmap", "model"), ("dlt", "b.csv")):
        ran = cli("export", "b.implicam", "--to", to, "-o", name)
        assert ran.code == 0
        assert ran.out.startswith(f"{name}: 2 cameras as ")
    for name, more in (("b.yaml", []), ("camchain.yaml", []), ("model", ["--unit", "mm"]), ("b.csv", [])):
        assert cli("import", name, "-o", "i.implicam", *more).code == 0
        assert cli("measure", "i.implicam", made / "rig" / "check").code == 0
    assert cli("export", "b.implicam", "--to", "ros", "-o", "infos").code == 0
    pair = cli("import", "infos/cam2.yaml", "infos/cam3.yaml", "-o", "i.implicam", "--unit", "mm")
    assert pair.out == "i.implicam: 2 cameras, lengths in mm\n"
    assert cli("import", "b.yaml", "-o", "i.implicam", "--unit", "mm").code == 0  # written in metres, as OpenCV has it
    same = cli("evaluate", "i.implicam", made / "rig" / "check", "--json").json
    assert same["rows"][0]["rmse"] == pytest.approx(told["rows"][0]["rmse"], rel=0.05)
    assert "made without known points" in cli("evaluate", "alone.implicam", "--cv", "3").err


@pytest.mark.slow
def test_the_command_writes_maps(made: Path, cli: Cli) -> None:
    words = ("export", made / "rig.implicam", "--to", "undistortion-maps")
    ran = cli(*words, "-o", "maps", "--size", "160x100", "--alpha", "0")
    assert ran.code == 0
    assert ran.out.startswith("maps: pixel maps that make pinholes of ")
    told = cli(*words, "-o", "maps", "--size", "160x100", "--json").json
    assert {f"{camera['name']}.npz" for camera in told["cameras"]} < {path.name for path in Path("maps").iterdir()}
    assert told["cameras"][0]["width"] == 160
    for wrong, said in (
        (["--size", "160"], "is no size"),
        (["--alpha", "3"], "from 0 to 1"),
    ):
        assert said in cli(*words, "-o", "maps", *wrong).err
    assert "option of undistortion-maps" in cli(*words[:3], "opencv", "-o", "x.yml", "--alpha", "0").err
    assert "did you mean 'undistortion-maps'" in cli(*words[:3], "undistortion", "-o", "x").err


@pytest.mark.slow
def test_a_neural_network_says_what_its_numbers_are(made: Path, cli: Cli) -> None:
    pytest.importorskip("torch")
    ran = cli("calibrate", made / "rig", "--method", "mlp", "-o", "n.implicam")
    assert "of them that it was not trained on are predicted within" in ran.out
    assert "dropout" in ran.err


@pytest.mark.parametrize(
    "words",
    [
        "measure rig.implicam rig/check -o rig/check/observations.csv",
        "measure rig.implicam new.csv -o new.csv",
        "measure rig.implicam new.csv -o new.csv.toml",
        "measure rig.implicam new.csv -o rig.implicam",
        "evaluate rig.implicam rig/check --report rig.implicam",
        "report rig.implicam -o rig.implicam",
        "export rig.implicam --to opencv -o rig.implicam",
        "suggest rig.implicam -o rig.implicam",
    ],
)
def test_no_command_replaces_what_it_reads(made: Path, cli: Cli, words: str) -> None:
    """Pixels that took a day to gather were gone, and a table of positions stood in their place."""
    for name in ("rig", "rig.implicam"):
        copy = shutil.copytree if (made / name).is_dir() else shutil.copy
        copy(made / name, name)
    cli("convert", "rig/check", "new.csv")
    before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
    ran = cli(*words.split())
    assert ran.code == 2
    assert "would be replaced: this command reads it" in ran.err
    assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before
