"""Files of other programs: read with their own conventions, written so that they come back, refused with the cure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from implicam.cli import main
from implicam.dataset import Camera, Dataset, KnownPositions, Observations, read_dataset
from implicam.dataset.programs import PROGRAMS, read_program, write_program
from implicam.dataset.table_options import TableOptions
from implicam.errors import DatasetError, ImplicamError

MM = TableOptions(unit="mm")


def known_points() -> Dataset:
    points = np.array([f"p{i + 1:04d}" for i in range(6)])
    uv = np.random.default_rng(2).uniform(10, 600, (6, 3, 2)).round(3)
    uv[2, 1] = np.nan
    xyz = np.random.default_rng(3).uniform(-50, 50, (6, 3)).round(2)
    cameras = tuple(Camera(f"cam{k + 1}") for k in range(3))
    known = KnownPositions(points, xyz, np.full(xyz.shape, np.nan))
    return Dataset("rig", "mm", Observations(points, cameras, uv, np.full(uv.shape, np.nan)), known)


KEY_POINTS = ("deeplabcut", "sleap")


@pytest.mark.parametrize("kind", [name for name in PROGRAMS if name not in KEY_POINTS])
def test_what_is_written_comes_back(kind: str, tmp_path: Path) -> None:
    data = known_points()
    path = tmp_path / ("folder" if "ptv" in kind else "a_xypts.csv")
    notes = write_program(data, path, kind)
    assert notes
    again = read_program(path, kind, MM, None if "ptv" in kind else tmp_path / "a_xyz.csv")
    order = [again.xyz.tolist().index(xyz) for xyz in data.xyz.tolist()]
    np.testing.assert_allclose(again.observations.uv[order], data.observations.uv, atol=1e-10)
    assert again.observations.camera_names == data.observations.camera_names


def test_dltdv_counts_from_one_and_older_ones_from_below(tmp_path: Path) -> None:
    path = tmp_path / "a_xypts.csv"
    path.write_text("pt1_cam1_X,pt1_cam1_Y,pt1_cam2_X,pt1_cam2_Y\n1,1,NaN,NaN\nNaN,NaN,NaN,NaN\n11,21,31,41\n")
    read = read_program(path, "dltdv")
    np.testing.assert_array_equal(read.observations.uv[:, 0], [[0, 0], [10, 20]])
    assert read.points.tolist() == ["p0001", "p0003"]
    assert read.columns["frame"].tolist() == ["1", "3"]
    assert any("counted from 1" in note for note in read.notes)
    assert any("1 of 3 points were seen by no camera" in note for note in read.notes)
    older = read_program(path, "dltdv", TableOptions(v_up=True, size="640x480"))
    np.testing.assert_array_equal(older.observations.uv[:, 0], [[0, 479], [10, 459]])


def test_several_points_of_dltdv_are_named_by_frame_and_point(tmp_path: Path) -> None:
    path = tmp_path / "xypts.tsv"
    path.write_text("pt1_cam1_X\tpt1_cam1_Y\tpt2_cam1_X\tpt2_cam1_Y\n1\t2\t3\t4\n5\t6\t7\t8\n")
    assert read_program(path, "dltdv").points.tolist() == ["1 pt1", "1 pt2", "2 pt1", "2 pt2"]
    (tmp_path / "xyz.csv").write_text("0,0,0\n1,1,1\n")
    with pytest.raises(DatasetError, match="2 rows of 2 points, and there are 2 known positions"):
        read_program(path, "dltdv", MM, tmp_path / "xyz.csv")
    path.write_text("pt1_cam1_X\tpt1_cam1_Y\tpt2_cam1_X\tpt2_cam1_Y\n1\t2\t3\t4\n")
    assert read_program(path, "dltdv", MM, tmp_path / "xyz.csv").xyz.tolist() == [[0, 0, 0], [1, 1, 1]]


def test_sparse_tables_of_dltdv_are_the_flat_ones(tmp_path: Path) -> None:
    """A title, then rows, columns, entries; the offsets beside it have a column for each camera."""
    path = tmp_path / "a_xypts.tsv"
    path.write_text("DLTdv8a sparse data\n3\t8\t6\n1\t1\t11.5\n1\t2\t21.5\n3\t3\t31.5\n3\t4\t41.5\n2\t7\t5\n2\t8\t6\n")
    with pytest.raises(DatasetError, match="is a sparse table, which is not read"):
        read_program(path, "argus")
    with pytest.raises(DatasetError, match="how many cameras") as caught:
        read_program(path, "dltdv")
    assert "a_offsets.tsv" in caught.value.fix
    (tmp_path / "a_offsets.tsv").write_text("title\n3\t2\t0\n")
    read = read_program(path, "dltdv")
    assert read.points.tolist() == ["1 pt1", "2 pt2", "3 pt1"]
    nan = [np.nan, np.nan]
    np.testing.assert_array_equal(read.observations.uv, [[[10.5, 20.5], nan], [nan, [4, 5]], [nan, [30.5, 40.5]]])


@pytest.mark.parametrize(
    ("kind", "name"), [("easywand", "pt1_cam3_X,pt1_cam3_Y"), ("argus", "track_cam_3_x,track_cam_3_y")]
)
def test_a_table_without_headings_says_which_it_may_need(kind: str, name: str, tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("1,2,3,4,5,6\n7,8,9,10,11,NaN\n")
    with pytest.raises(DatasetError, match="6 columns of numbers, and no headings") as caught:
        read_program(tmp_path / "x.csv", kind)
    assert caught.value.fix.endswith(name)


def test_positions_may_have_headings(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("pt1_cam1_X,pt1_cam1_Y\n1,2\n3,4\n")
    (tmp_path / "xyz.csv").write_text('"X",Y,Z\n0,0,0\n1,1,1\n')
    assert read_program(tmp_path / "x.csv", "dltdv", MM, tmp_path / "xyz.csv").xyz.tolist() == [[0, 0, 0], [1, 1, 1]]


def test_the_camera_of_a_file_of_sleap_is_its_video_and_two_files_of_one_are_named(tmp_path: Path) -> None:
    head = "track,frame_idx,instance.score,head.x,head.y,head.score\n"
    for name in ("labels.v001.000_cam1.analysis", "labels.v002.slp.001_cam2.analysis", "cam3.analysis", "left_000"):
        (tmp_path / f"{name}.csv").write_text(head + "t0,0,.9,1,2,.8\n")
    assert sorted(read_program(tmp_path, "sleap").camera_names) == ["cam1", "cam2", "cam3", "left_000"]
    (tmp_path / "b").mkdir()
    for name in ("cam1DLC_x", "cam1DLC_x_filtered"):
        (tmp_path / "b" / f"{name}.csv").write_text("scorer,s,s\nbodyparts,nose,nose\ncoords,x,y\n0,1,2\n")
    with pytest.raises(
        DatasetError, match=r"cam1DLC_x.csv and cam1DLC_x_filtered.csv are both of camera 'cam1'"
    ) as caught:
        read_program(tmp_path / "b", "deeplabcut")
    assert "move cam1DLC_x_filtered.csv" in caught.value.fix


def test_key_points_without_pixels_are_missing_whatever_their_likelihood(tmp_path: Path) -> None:
    """DeepLabCut issue 1650: NaN, NaN with the likelihood 1."""
    head = "scorer,s,s,s,s,s,s\nbodyparts,nose,nose,nose,tail,tail,tail\ncoords,x,y,likelihood,x,y,likelihood\n"
    (tmp_path / "leftDLC_resnet50.csv").write_text(head + "0,1.5,2,.9,nan,nan,1.0\n1,3,4,.8,5,6,.7\n")
    (tmp_path / "rightDLC_resnet50.csv").write_text(head + "0,7,8,.6,9,10,.5\n1,,,1.0,11,12,.4\n")
    read = read_program(tmp_path, "deeplabcut")
    assert read.observations.camera_names == ("left", "right")
    assert read.points.tolist() == ["0 nose", "0 tail", "1 nose", "1 tail"]
    assert read.observations.seen.tolist() == [[True, True], [False, True], [True, False], [True, True]]
    assert read.observations.extra["likelihood"].tolist() == [[".9", ".6"], ["", ".5"], [".8", ""], [".7", ".4"]]
    assert read.columns["marker"].tolist() == ["nose", "tail", "nose", "tail"]


def test_animals_of_deeplabcut(tmp_path: Path) -> None:
    head = "scorer,s,s,s,s\nindividuals,a,a,b,b\nbodyparts,nose,nose,nose,nose\ncoords,x,y,x,y\n"
    (tmp_path / "cam1DLC.csv").write_text(head + "0,1,2,3,4\n")
    assert read_program(tmp_path, "deeplabcut").points.tolist() == ["0 a nose", "0 b nose"]


def test_sleap(tmp_path: Path) -> None:
    head = "track,frame_idx,instance.score,head.x,head.y,head.score,tail.x,tail.y,tail.score\n"
    (tmp_path / "cam1.csv").write_text(head + "t0,0,.9,1,2,.8,,,\n")
    (tmp_path / "cam2.csv").write_text(head + "t0,0,.9,3,4,.7,5,6,.6\n")
    read = read_program(tmp_path, "sleap")
    assert read.points.tolist() == ["0 t0 head", "0 t0 tail"]
    np.testing.assert_array_equal(read.observations.uv[1], [[np.nan, np.nan], [5, 6]])


def test_points_of_openptv_that_were_not_found(tmp_path: Path) -> None:
    for camera in "12":
        (tmp_path / f"plane_a_{camera}.tif.fix").write_text("  1  0.0 0.0 5.0\n  2  1.0 0.0 5.0\n")
    (tmp_path / "plane_a_1.tif.crd").write_text("1 10.5 20.5\n2 -999 -999\n")
    (tmp_path / "plane_a_2.tif.crd").write_text("1 30 40\n2 50 60\n")
    read = read_program(tmp_path, "openptv", MM)
    assert read.points.tolist() == ["plane_a 1", "plane_a 2"]
    assert read.observations.camera_names == ("cam1", "cam2")
    assert read.observations.seen.tolist() == [[True, True], [False, True]]
    assert read.xyz.tolist() == [[0, 0, 5], [1, 0, 5]]


REFUSED: dict[str, tuple[str, dict[str, str], str]] = {
    "half a pair": ("dltdv", {"x.csv": "pt1_cam1_X,pt1_cam2_Y\n1,2\n"}, "'pt1_cam1_X' but no 'pt1_cam1_Y'"),
    "another heading": ("dltdv", {"x.csv": "pt1_cam1_X,pt1_cam1_Y,note\n1,2,a\n"}, "'note' is not of the kind"),
    "half a view": ("dltdv", {"x.csv": "pt1_cam1_X,pt1_cam1_Y\n1,NaN\n"}, "u = 1, v = nan"),
    "nothing seen": ("dltdv", {"x.csv": "pt1_cam1_X,pt1_cam1_Y\nNaN,NaN\n"}, "all pixels are missing"),
    "no table of DeepLabCut": ("deeplabcut", {"x.csv": "a,b\n1,2\n"}, "is no table of DeepLabCut"),
    "no table of SLEAP": ("sleap", {"x.csv": "frame_idx,head.x\n1,2\n"}, "is no analysis table of SLEAP"),
    "four numbers": ("myptv", {"cam1_cal_points": "1 2 3 4\n"}, "4 cells"),
    "a word": ("myptv", {"cam1_cal_points": "1 2 3 4 five\n"}, "cell 5 = 'five' is not a number"),
    "a point twice": ("myptv", {"cam1_cal_points": "1 2 3 4 5\n6 7 3 4 5\n"}, "is seen twice by camera 'cam1'"),
    "targets alone": ("openptv", {"cam1.1_targets": "1\n0 1 2 3 4 5 6 -1\n"}, "has files _targets and no .crd"),
    "no positions": ("openptv", {"a1.tif.crd": "1 2 3\n"}, "has no a1.tif.fix beside it"),
    "two places": (
        "openptv",
        {"a1.tif.fix": "1 0 0 0", "a1.tif.crd": "1 2 3", "a2.tif.fix": "1 0 0 9", "a2.tif.crd": "1 2 3"},
        "is at (0.0, 0.0, 9.0), and at (0.0, 0.0, 0.0) elsewhere",
    ),
    "no unit": ("myptv", {"cam1_cal_points": "1 2 3 4 5\n"}, "the length unit of x, y, z is not stated"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_wrong_is_named(case: str, tmp_path: Path) -> None:
    kind, files, said = REFUSED[case]
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    path = tmp_path / "x.csv" if kind == "dltdv" else tmp_path
    with pytest.raises(DatasetError) as caught:
        read_program(path, kind, None if case == "no unit" else MM)
    assert said in caught.value.what
    assert caught.value.fix


def trajectory() -> Dataset:
    frames, markers = ["3", "3", "4", "4"], ["nose", "tail", "nose", "tail"]
    uv = np.random.default_rng(4).uniform(10, 600, (4, 2, 2)).round(3)
    uv[1, 0] = np.nan
    cameras = Camera("left"), Camera("right")
    likelihood = np.array([[".9", ".8"], ["", ".7"], [".6", ".5"], [".4", ".3"]])
    points = np.array([f"{frame} {marker}" for frame, marker in zip(frames, markers, strict=True)])
    views = Observations(points, cameras, uv, np.full(uv.shape, np.nan), {"likelihood": likelihood})
    return Dataset("walk", "mm", views, columns={"frame": np.array(frames), "marker": np.array(markers)})


@pytest.mark.parametrize("kind", KEY_POINTS)
def test_key_points_that_are_written_come_back(kind: str, tmp_path: Path) -> None:
    data = trajectory()
    assert write_program(data, tmp_path / "out", kind) == []
    again = read_program(tmp_path / "out", kind)
    assert again.points.tolist() == data.points.tolist()
    assert again.observations.camera_names == data.observations.camera_names
    np.testing.assert_allclose(again.observations.uv, data.observations.uv, atol=1e-10)
    assert again.observations.extra["likelihood"].tolist() == data.observations.extra["likelihood"].tolist()
    assert {name: texts.tolist() for name, texts in again.columns.items()} == {
        name: texts.tolist() for name, texts in data.columns.items()
    }
    notes = write_program(known_points(), tmp_path / "known", kind)
    assert any("names of points are lost" in note for note in notes)
    assert any("Known positions are not in it" in note for note in notes)
    np.testing.assert_allclose(read_program(tmp_path / "known", kind).observations.uv, known_points().observations.uv)


def test_tables_of_deeplabcut_are_what_pandas_reads_as_deeplabcut_does(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    write_program(trajectory(), tmp_path, "deeplabcut")
    table = pandas.read_csv(tmp_path / "leftDLC.csv", header=[0, 1, 2], index_col=0)
    assert table.index.tolist() == [3, 4]
    assert table.columns.tolist()[:3] == [("implicam", "nose", axis) for axis in ("x", "y", "likelihood")]
    np.testing.assert_array_equal(table["implicam", "tail", "x"], trajectory().observations.uv[1::2, 0, 0])


def test_unknown_programs(tmp_path: Path) -> None:
    with pytest.raises(ImplicamError, match="did you mean 'dltdv'"):
        read_program(tmp_path, "dltv")


def convert(*words: Any) -> int:
    with pytest.raises(SystemExit) as end:
        main(["convert", *map(str, words)])
    return int(end.value.code or 0)


def test_convert_reads_and_writes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = known_points()
    write_program(data, tmp_path / "cal_xypts.csv", "dltdv")
    words = ("--from", "dltdv", "--positions", tmp_path / "cal_xyz.csv", "--unit", "mm")
    assert convert(tmp_path / "cal_xypts.csv", tmp_path / "rig", *words) == 0
    np.testing.assert_allclose(read_dataset(tmp_path / "rig").observations.uv, data.observations.uv, atol=1e-10)
    assert convert(tmp_path / "rig", tmp_path / "ptv", "--to", "myptv") == 0
    assert (tmp_path / "ptv" / "target_file").exists()
    assert "names of the points are lost" in capsys.readouterr().err
    assert convert(tmp_path / "rig", tmp_path / "x.csv", "--positions", tmp_path / "cal_xyz.csv") == 2


@pytest.mark.parametrize("kind", ["dltdv", "easywand", "argus"])
def test_the_markers_of_a_wand_are_a_row_a_frame(kind: str, tmp_path: Path) -> None:
    uv = np.arange(24.0).reshape(6, 2, 2) + 10
    uv[1, 0] = np.nan
    frame, marker = np.array(["3", "3", "4", "4", "7", "7"]), np.array(["a", "b"] * 3)
    names = np.char.add(np.char.add(frame, " "), marker)
    seen = Observations(names, (Camera("left"), Camera("right")), uv, np.full(uv.shape, np.nan))
    data = Dataset("wand", "mm", seen, None, columns={"frame": frame, "marker": marker})
    path = tmp_path / "wand_xypts.csv"
    notes = write_program(data, path, kind)
    assert "The points are 1 = a, 2 = b." in notes
    assert "Row 1 is frame 3." in notes
    assert len(path.read_text(encoding="utf-8").splitlines()) == 6  # the heading, and frames 3 to 7
    again = read_program(path, kind, MM)
    assert again.columns["frame"].tolist() == ["1", "1", "2", "2", "5", "5"]
    assert len(set(again.columns["marker"].tolist())) == 2
    np.testing.assert_allclose(again.observations.uv, uv, atol=1e-9)
