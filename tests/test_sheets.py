"""Tables as people write them: read right, or refused with the cure; never wrong in silence."""

from __future__ import annotations

import csv
import io
import random
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dataset_files import assert_same
from implicam.dataset import Camera, Dataset, KnownPositions, Observations, read_dataset, write_dataset
from implicam.dataset.headings import is_camera_name, read_headings, take_apart
from implicam.errors import DatasetError, ImplicamError, UsageError
from implicam.measurement import Measurement
from implicam.simulate import build_rig, random_positions, record

SPREADSHEETS = 30


def truth() -> Dataset:
    """Eight known points before three cameras; a few views are missing."""
    rng = np.random.default_rng(3)
    uv = np.round(rng.uniform(20.0, 1900.0, (8, 3, 2)), 2) + 0.001  # three decimals, never a whole number
    uv[[1, 4, 4], [0, 1, 2]] = np.nan
    xyz = np.round(rng.uniform(-0.9, 2.9, (8, 3)), 3)
    xyz[0] = -0.125, 0.5, 1.75
    points = np.array([f"Marker {i + 1:02d}" for i in range(8)])
    cameras = tuple(Camera(f"cam{k + 1}") for k in range(3))
    known = KnownPositions(points, xyz, np.full((8, 3), np.nan))
    return Dataset("t", "m", Observations(points, cameras, uv, np.full(uv.shape, np.nan)), known)


STYLES: list[dict[str, Any]] = [
    {"point": "point", "xyz": "xyz", "uv": ("u_cam{}", "v_cam{}")},
    {"point": "name", "xyz": "XYZ", "uv": ("cam{}_x", "cam{}_y")},
    {"point": "Marker", "xyz": ("X [m]", "Y [m]", "Z [m]"), "uv": ("Kamera {} x", "Kamera {} y")},
    {"point": "Punkt", "xyz": ("x_m", "y_m", "z_m"), "uv": ("Kamera {} x [px]", "Kamera {} y [px]")},
    {"point": "ID", "xyz": ("X (m)", "Y (m)", "Z (m)"), "uv": ("u{}", "v{}")},
    {"point": "label", "xyz": ("World X", "World Y", "World Z"), "uv": ("Cam {} - u", "Cam {} - v")},
    {"point": "Point name", "xyz": ("pos_x", "pos_y", "pos_z"), "uv": ("camera{}.x", "camera{}.y")},
    {"point": "#", "xyz": "XYZ", "uv": ("cam{}x", "cam{}y")},
    {"point": "target", "xyz": ("x in m", "y in m", "z in m"), "uv": ("cam{}_col", "cam{}_row")},
    {"point": "marker id", "xyz": "xyz", "uv": ("x (cam{})", "y (cam{})")},
    {"point": "nr", "xyz": ("x_ref", "y_ref", "z_ref"), "uv": ("View {} U", "View {} V")},
    {"point": "Name", "xyz": "XYZ", "uv": ("x{}", "y{}")},
]
MARKS = [
    ("", ""),
    ("-1", "-1"),
    ("NaN", "NaN"),
    ("0", "0"),
    ("n/a", "n/a"),
    ("-", "-"),
    ("nan", "nan"),
    ("#N/A", "#N/A"),
]


def spreadsheet(data: Dataset, seed: int) -> tuple[list[list[str]], dict[str, Any]]:
    """Header and rows of a table as somebody may write it, and how the cells are to be put into a file."""
    rng = random.Random(seed)
    style = STYLES[seed % len(STYLES)]
    decimal = rng.choice(".,")
    separator = rng.choice(";\t" if decimal == "," else ",;\t")
    mark = rng.choice(MARKS)
    columns: list[tuple[str, list[str]]] = [(style["point"], data.points.tolist())]

    def number(value: float) -> str:
        return repr(float(value)).replace(".", decimal)

    columns += [(h, [number(x) for x in data.xyz[:, i]]) for i, h in enumerate(style["xyz"])]
    for k in range(len(data.cameras)):
        for q, heading in enumerate(style["uv"]):
            cells = data.observations.uv[:, k, q].tolist()
            columns.append((heading.format(k + 1), [mark[q] if c != c else number(c) for c in cells]))
    if rng.random() < 0.5:
        columns.append((rng.choice(["remark", "frame", "Bemerkung"]), [str(i) for i in range(len(data))]))
    if rng.random() < 0.6:
        rng.shuffle(columns)
    if rng.random() < 0.3:
        columns += [("", [""] * len(data))] * 2  # columns of a spreadsheet in which nothing stands
    rows = [[h for h, _ in columns], *map(list, zip(*(cells for _, cells in columns), strict=True))]
    how = {"delimiter": separator, "quoting": rng.choice([csv.QUOTE_MINIMAL, csv.QUOTE_ALL])}
    return rows, {"how": how, "encoding": rng.choice(["utf-8", "utf-8-sig"]), "end": rng.choice(["\n", "\r\n"])}


def write(path: Path, rows: list[list[str]], how: dict[str, Any]) -> Path:
    text = io.StringIO()
    csv.writer(text, lineterminator=how["end"], **how["how"]).writerows(rows)
    path.write_bytes(text.getvalue().encode(how["encoding"]))
    return path


def assert_right(read: Dataset, data: Dataset) -> None:
    """The same numbers and the same missing views; each camera is there, in any order, under its own number."""
    order = [
        next(k for k, name in enumerate(read.observations.camera_names) if name[-1] == c.name[-1]) for c in data.cameras
    ]
    assert len(read.cameras) == len(data.cameras)
    np.testing.assert_array_equal(read.observations.uv[:, order], data.observations.uv)
    np.testing.assert_array_equal(read.xyz, data.xyz)
    assert read.length_unit == "m"


@pytest.mark.parametrize("seed", range(SPREADSHEETS))
def test_spreadsheets_are_read_right(seed: int, tmp_path: Path) -> None:
    data = truth()
    rows, how = spreadsheet(data, seed)
    read = read_dataset(write(tmp_path / "s.csv", rows, how), unit="m")
    assert_right(read, data)
    assert read.points.tolist() == data.points.tolist()
    marks = {cell for row in rows[1:] for cell in row} & {"-1", "NaN", "0", "n/a", "-", "nan", "#N/A"} - {""}
    frames = {"remark", "frame", "Bemerkung"} & set(rows[0])
    for mark in marks - ({"0"} if frames else set()):
        assert any(mark in note and "missing" in note for note in read.notes), (mark, read.notes)


@pytest.mark.parametrize("seed", range(SPREADSHEETS))
def test_a_typing_error_in_a_heading_is_refused_or_changes_nothing(seed: int, tmp_path: Path) -> None:
    data, rng = truth(), random.Random(1000 + seed)
    rows, how = spreadsheet(data, seed)
    refused = 0
    for i, heading in enumerate(rows[0]):
        if not heading:
            continue
        at = rng.randrange(len(heading))
        for typo in (heading[:at] + heading[at + 1 :], heading[:at] + rng.choice("aexz1q_") + heading[at:]):
            spoilt = [[*rows[0][:i], typo, *rows[0][i + 1 :]], *rows[1:]]
            try:
                read = read_dataset(write(tmp_path / "s.csv", spoilt, how), unit="m")
            except DatasetError as error:
                refused += len(error.fix) > 0
            else:
                assert_right(read, data)
    assert refused


def sheet(tmp_path: Path, text: str, unit: str | None = "mm") -> Dataset:
    path = tmp_path / "w.csv"
    path.write_text(text, encoding="utf-8")
    return read_dataset(path, unit=unit)


REFUSED = {
    "points that may be cameras": (
        "nose_x,nose_y,tail_x,tail_y\n1,2,3,4\n",
        "'nose_x', 'nose_y' are a pair, and it cannot be told whether 'nose' is a camera",
        "name the pixels u_NAME and v_NAME",
    ),
    "DLTdv": (
        "pt1_cam1_X,pt1_cam1_Y,pt1_cam2_X,pt1_cam2_Y\n1,2,3,4\n",
        "it cannot be told whether 'pt1_cam1'",
        "u_NAME",
    ),
    "numbers without known positions": (
        "x1,y1,x2,y2\n1,2,3,4\n",
        "it cannot be told whether '1' is a camera",
        "u_NAME",
    ),
    "one camera": ("x,y,z,u,v\n1,2,3,4,5\n", "there are no camera columns", "u_cam1"),
    "half of a position": ("X,Y,cam1_x,cam1_y\n1,2,3,4\n", "x, y and z must all be there", "add the missing column"),
    "a camera misspelt twice": (
        "u_cam1,v_cam1,um_cam2,vm_cam2\n1,2,3,4\n",
        "the column 'um_cam2' names 'cam2', which has no columns of pixels",
        "correct the heading",
    ),
    "one half misspelt": (
        "cam1_x,cam1_y,cam2_xx,cam2_y\n1,2,3,4\n",
        "there is a column 'cam2_y' but no 'cam2_x' (did you mean 'cam2_xx'?)",
        "correct the heading",
    ),
    "two pairs": (
        "u_cam1,v_cam1,cam1_x,cam1_y,u_cam2,v_cam2\n1,2,3,4,5,6\n",
        "camera 'cam1' has two pairs of columns: 'u_cam1', 'v_cam1' and 'cam1_x', 'cam1_y'",
        "u_NAME",
    ),
    "two names": (
        "id,name,u_a,v_a\n1,a,2,3\n",
        "'id', 'name' may all name the points",
        "call the one that does 'point'",
    ),
    "two positions": (
        "x,y,z,x_ref,y_ref,z_ref,u_a,v_a\n1,2,3,4,5,6,7,8\n",
        "may all be known positions",
        "call the known positions x, y and z",
    ),
    "two units": ("x [m],y [mm],z [m],u_a,v_a\n1,2,3,4,5\n", "have several units", "convert the columns"),
    "another unit": ("x [m],y [m],z [m],u_a,v_a\n1,2,3,4,5\n", "is in 'm', not in 'mm'", "leave out --unit"),
    "thousands": (
        "x;y;z;u_a;v_a\n1,234;2,345;3,456;10;20\n",
        "line 2: '1,234' may be a number with a decimal comma, or with a comma between thousands",
        "decimal points",
    ),
    "commas and points": (
        "x;y;z;u_a;v_a\n0,234;2.345;3,456;10;20\n",
        "line 2: one number",
        "all numbers with decimal points",
    ),
    "thousands and decimals": (
        'x,y,z,u_a,v_a\n1,2,3,"1,098.61",20\n',
        "one number has a comma and one has a point",
        "points",
    ),
    "a comma splits a number": (
        "x,y,z,u_a,v_a\n1,5,2,3,4,5\n",
        "line 2: 6 cells, but the header names 5",
        "decimal points",
    ),
    "two separators": ("x;y,z;u\n1;2,3;4\n", "semicolons or commas may separate", "leave it out of the headings"),
    "the index of pandas": (",x,y,z,u_a,v_a\n5,1,2,3,4,5\n", "a column has no name", "give it a name"),
    "a view twice": ("point,camera,u,v\np,a,1,2\np,a,3,4\n", "point 'p' is seen twice by camera 'a'", "keep one"),
    "two places": (
        "point,camera,u,v,x,y,z\np,a,1,2,0,0,0\np,b,3,4,0,1,0\n",
        "y = 1, but 0 in the row of another",
        "one",
    ),
    "views of nothing": ("camera,u,v\na,1,2\n", "no column names the points", "add a column point"),
    "half a view": ("x;y;z;u_a;v_a\n1;2;3;4;n/a\n", "u = 4, v = nan", "leave both u and v empty"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_can_be_read_in_two_ways_is_refused(case: str, tmp_path: Path) -> None:
    text, said, cure = REFUSED[case]
    with pytest.raises(DatasetError) as caught:
        sheet(tmp_path, text)
    assert said in caught.value.what.replace("commas or semicolons", "semicolons or commas")
    assert cure in caught.value.fix
    assert str(tmp_path / "w.csv") in caught.value.what


def test_one_line_says_how_the_headings_were_read(tmp_path: Path) -> None:
    read = sheet(tmp_path, "Marker;X [m];Y [m];Z [m];Kamera 1 x;Kamera 1 y;Wetter\nM;0,5;1,5;2;10,25;20;gut\n", None)
    assert read.notes == (
        "The table was read so: separated by semicolons; decimal commas; 'Marker' names the points; 'X [m]', 'Y [m]', "
        "'Z [m]' are x, y, z in m; u and v of Kamera 1 ('Kamera 1 x', 'Kamera 1 y'); kept as they are: 'Wetter'.",
    )
    assert read.observations.uv.tolist() == [[[10.25, 20.0]]]
    assert sheet(tmp_path, "point,x,y,z,u_a,v_a\np,1,2,3,4,5\n").notes == ()


def test_a_table_of_views_that_this_program_wrote_can_be_read_alone(tmp_path: Path) -> None:
    """With the columns true_u and true_v, which are a pair as well."""
    rig = build_rig("bar4", seed=1)
    data = record(rig, random_positions(rig, 5, np.random.default_rng(1)), seed=1).data
    write_dataset(data, tmp_path / "rig")
    table = tmp_path / "rig" / "observations.csv"
    assert "true_u" in table.read_text()
    for cameras in ((), data.observations.camera_names):
        read = read_dataset(table, unit="mm", cameras=cameras)
        np.testing.assert_array_equal(read.observations.uv, data.observations.uv)
        assert "true_u" in read.observations.extra


BODY = "a{s}1{s}2{s}3{s}4.5{s}6.5\nb{s}4{s}5{s}6{s}7.5{s}8.5\n"
COMMA = BODY.format(s=",")
ABOVE = {
    "a comment": ("# of 3 Nov\npoint,x,y,z,u_cam1,v_cam1\n" + COMMA, "left out above the headings: '# of 3 Nov'"),
    "a title": ("Rig 2,,,,,\n,,,,,\npoint,x,y,z,u_cam1,v_cam1\n" + COMMA, "left out above the headings: 'Rig 2'"),
    "a title with a comma": (
        "Rig 2, Nov\npoint,x,y,z,u_cam1,v_cam1\n" + COMMA,
        "left out above the headings: 'Rig 2 Nov'",
    ),
    "numpy": ("# point,x,y,z,u_cam1,v_cam1\n" + COMMA, ""),
    "blanks": ("point x y z u_cam1 v_cam1\n" + BODY.format(s=" "), "separated by blanks"),
    "fixed width": ("point   x  y z u_cam1   v_cam1\n" + BODY.format(s="   "), "separated by blanks"),
    "two rows": ("point,World,,,Cam 1,\n,x,y,z,u,v\n" + COMMA, "the headings are in two rows: 'Cam 1 v'"),
    "pandas, counted": (",point,x,y,z,u_cam1,v_cam1\n0,a,1,2,3,4.5,6.5\n1,b,4,5,6,7.5,8.5\n", "counts the rows"),
    "pandas, named": (",x,y,z,u_cam1,v_cam1\n" + COMMA, "the first column names the points"),
    "px_x": ("point,x,y,z,px_x_1,px_y_1\n" + COMMA, "u and v of 1 ('px_x_1', 'px_y_1')"),
    "px_x in rows": ("point,cam,px_x,px_y,X,Y,Z\na,0,4.5,6.5,1,2,3\nb,0,7.5,8.5,4,5,6\n", "('px_x', 'px_y')"),
}


@pytest.mark.parametrize("case", ABOVE)
def test_headings_that_are_not_the_first_row_of_a_plain_table(case: str, tmp_path: Path) -> None:
    text, said = ABOVE[case]
    (tmp_path / "t.txt").write_text(text)
    data = read_dataset(tmp_path / "t.txt", unit="mm")
    assert data.points.tolist() == ["a", "b"]
    assert data.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert data.observations.uv[:, 0].tolist() == [[4.5, 6.5], [7.5, 8.5]]
    assert said in " ".join(data.notes)


def test_the_cameras_of_a_calibration_tell_what_x1_is(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("x1,y1,x2,y2\n1,2,3,4\n")
    assert read_dataset(tmp_path / "t.csv", cameras=["1", "2"]).camera_names == ("1", "2")
    with pytest.raises(DatasetError, match="cannot be told whether '1' is a camera") as caught:
        read_dataset(tmp_path / "t.csv", cameras=["left", "right"])
    assert "u_left and v_left, as the calibration has them: left, right" in caught.value.fix


@pytest.mark.parametrize(
    "text", ["point,camera,u,v\na,CAM1 ,1,2\nb,cam1,3,4\n", "point,u_cam1,v_cam1,u_Cam_1,v_Cam_1\na,1,2,3,4\n"]
)
def test_two_spellings_of_a_camera_are_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(DatasetError, match=r"\(1 view\) and '[cC]am_?1' \(1 view\) are two cameras"):
        read_dataset(tmp_path / "t.csv")


def test_shots_stay_shots(tmp_path: Path) -> None:
    assert sheet(tmp_path, "point,shot,x,y,z,u_a,v_a\np,s,1,2,3,4,5\n").shots.tolist() == ["s"]
    long = sheet(tmp_path, "point,shot,camera,x,y,z,u,v\np,s,a,1,2,3,4,5\np,s,b,1,2,3,4,5\n")
    assert long.shots.tolist() == ["s"]


def test_words_for_missing_views_are_counted(tmp_path: Path) -> None:
    read = sheet(tmp_path, "u_a,v_a,u_b,v_b\nn/a,n/a,1,2\n-,-,3,4\nNaN,NaN,5,6\n-1,-1,7,8\n,,9,9.5\n0,0,1,1\n")
    assert read.observations.seen[:, 0].tolist() == [False] * 6
    assert [note.partition(":")[0] for note in read.notes] == [
        "2 cells of pixels say 'n/a'", "2 cells of pixels say '-'", "2 cells of pixels say 'NaN'",
        "The pixel (-1, -1) occurs 1 times (a)", "The pixel (0, 0) occurs 1 times (a)",
    ]  # fmt: skip


def test_a_row_for_each_view(tmp_path: Path) -> None:
    read = sheet(tmp_path, "Point;Camera;x;y;weight\np2;a;1,5;2;w\np1;a;3;4;v\np2;b;5;6,25;w\n")
    assert read.points.tolist() == ["p2", "p1"]
    assert read.observations.camera_names == ("a", "b")
    np.testing.assert_array_equal(read.observations.uv, [[[1.5, 2], [5, 6.25]], [[3, 4], [np.nan, np.nan]]])
    known = sheet(tmp_path, "point,camera,u,v,x,y,z\np,a,1,2,0,0,0\np,b,3,4,0,0,0\nq,b,5,6,1,1,1\n")
    np.testing.assert_array_equal(known.xyz, [[0, 0, 0], [1, 1, 1]])


def test_markers_seen_again_in_each_frame_are_named_by_both(tmp_path: Path) -> None:
    text = "frame,marker,cam1_x,cam1_y,cam2_x,cam2_y\n1,A,1,2,3,4\n1,B,2,3,4,5\n2,A,3,4,5,6\n"
    read = sheet(tmp_path, text)
    assert read.points.tolist() == ["1 A", "1 B", "2 A"]
    assert "a point is named by 'frame' and 'marker', as '1 A'" in read.notes[0]
    long = sheet(tmp_path, "frame,marker,camera,u,v\n1,A,a,1,2\n1,A,b,2,3\n2,A,a,3,4\n")
    assert long.points.tolist() == ["1 A", "2 A"]


def test_columns_of_views_go_to_their_cameras(tmp_path: Path) -> None:
    read = sheet(tmp_path, "u_a,v_a,u_b,v_b,likelihood_a,b_likelihood,sd_u_a,sd_v_a\n1,2,3,4,.9,.8,.25,.5\n")
    assert read.observations.extra["likelihood"].tolist() == [[".9", ".8"]]
    assert read.observations.sd[0, 0].tolist() == [0.25, 0.5]


TRAJECTORY = (
    "point,frame,marker,u_a,v_a,u_b,v_b,likelihood_a,likelihood_b\n"
    "p1,1,A,1,2,3,4,.9,.8\np2,1,B,5,6,,,.7,\np3,2,A,,,,,,\n"
)


@pytest.mark.parametrize("form", ["again.csv", "again.npz", "again.parquet", "folder"])
def test_columns_of_points_that_are_to_be_measured_are_kept(form: str, tmp_path: Path) -> None:
    if form.endswith("parquet"):
        pytest.importorskip("pyarrow")
    data = sheet(tmp_path, TRAJECTORY)
    assert {name: column.tolist() for name, column in data.columns.items()} == {
        "frame": ["1", "1", "2"], "marker": ["A", "B", "A"],
    }  # fmt: skip
    if form == "folder":
        data = data.select([1, 0])  # a folder without positions has no place for a point that nobody saw
    write_dataset(data, tmp_path / form)
    assert_same(read_dataset(tmp_path / form), data)


def test_further_columns_reach_measured_csv(tmp_path: Path) -> None:
    data = sheet(tmp_path, TRAJECTORY)
    further = data.further_columns()
    assert {name: column.tolist() for name, column in further.items()} == {
        "frame": ["1", "1", "2"], "marker": ["A", "B", "A"], "likelihood_a": [".9", ".7", ""],
        "likelihood_b": [".8", "", ""],
    }  # fmt: skip
    nothing = np.full((3, 3), np.nan)
    measured = Measurement(
        data.points, nothing, np.full((3, 3, 3), np.nan), np.zeros(3, int), nothing[:, 0], np.array(["a"] * 3), "mm"
    )
    measured.with_columns({**further, "views": data.points}).write_csv(tmp_path / "m.csv")
    rows = list(csv.reader((tmp_path / "m.csv").read_text().splitlines()))
    assert rows[0][13:] == ["share_calibration", "frame", "marker", "likelihood_a", "likelihood_b", "views_"]
    assert rows[3][14:] == ["2", "A", "", "", "p3"]


def test_a_column_of_points_has_one_text_for_all_views(tmp_path: Path) -> None:
    write_dataset(sheet(tmp_path, TRAJECTORY).select([0]), tmp_path / "rig")
    path = tmp_path / "rig" / "observations.csv"
    path.write_text(path.read_text().replace("p1,b,3.0,4.0,1", "p1,b,3.0,4.0,2"))
    with pytest.raises(DatasetError, match="frame = '2', and '1' in another view of point 'p1'"):
        read_dataset(tmp_path / "rig")


@pytest.mark.parametrize("first", ["sep=;\n", "sep=;\r\n", '"sep=;"\n'])
def test_the_line_that_tells_excel_the_separator(first: str, tmp_path: Path) -> None:
    assert sheet(tmp_path, first + "x;y;z;u_a;v_a\n1;2;3;4;5\n").xyz.tolist() == [[1, 2, 3]]


def test_pixels_from_one_and_from_below(tmp_path: Path) -> None:
    path = tmp_path / "w.csv"
    path.write_text("u_a,v_a,u_b,v_b\n1,1,640,480\n0,0,-1,-1\n")
    read = read_dataset(path, unit="mm", first_pixel=1, v_up=True, size="640x480")
    np.testing.assert_array_equal(read.observations.uv[0], [[0, 479], [639, 0]])
    assert not read.observations.seen[1].any()  # marks are marks as the file has them
    assert [(camera.width, camera.height) for camera in read.cameras] == [(640, 480)] * 2
    assert any("counted from 1" in note for note in read.notes)
    assert any("bottom row" in note for note in read.notes)
    sizes = read_dataset(path, unit="mm", size={"a": (640, 480), "b": (1280, 800)})
    assert sizes.cameras[1].width == 1280
    assert sizes.observations.uv[0, 0].tolist() == [1, 1]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"first_pixel": 2}, "the first pixel cannot have the number 2"),
        ({"v_up": True}, "the picture's height of camera 'a' is not known"),
        ({"v_up": True, "size": "b=640x480"}, "the picture's height of camera 'a' is not known"),
        ({"size": "640*480"}, "'640*480' is no size of pictures"),
        ({"size": "c=640x480"}, "--size names a camera 'c', which is not there"),
        ({"size": "64x48"}, "far outside the 64 x 48 image"),
    ],
)
def test_options_that_do_not_fit_the_table(options: dict[str, Any], said: str, tmp_path: Path) -> None:
    path = tmp_path / "w.csv"
    path.write_text("u_a,v_a,u_b,v_b\n1,1,640,480\n")
    with pytest.raises(ImplicamError) as caught:
        read_dataset(path, unit="mm", **options)
    assert said in caught.value.what
    assert caught.value.fix


def test_a_size_that_contradicts_the_data(tmp_path: Path) -> None:
    path = tmp_path / "w.csv"
    path.write_text("u_a,v_a\n1,1\n")
    write_dataset(read_dataset(path, unit="mm", size="640x480"), tmp_path / "rig.npz")
    assert read_dataset(tmp_path / "rig.npz", size="640x480").cameras[0].width == 640
    with pytest.raises(UsageError, match=r"pictures of 640 x 480 pixels, and --size says 480 x 640"):
        read_dataset(tmp_path / "rig.npz", size=(480, 640))


FORMULAS = ["=1+1", "+M1", "@SUM(A1)", "-M 1", "'=1", "''=1", "'", "'name", "-1.5e3", "+7", "-", "=", "a=1", "'-5"]


@pytest.mark.parametrize("form", ["rig", "rig.csv"])
def test_no_name_is_a_formula_and_all_come_back(form: str, tmp_path: Path) -> None:
    points = np.array(FORMULAS)
    uv = np.arange(4.0 * len(points)).reshape(-1, 2, 2) + 1
    known = KnownPositions(points, np.full((len(points), 3), -1.5), np.full((len(points), 3), np.nan), {"=c": points})
    observations = Observations(
        points, (Camera("=a"), Camera("b")), uv, np.full(uv.shape, np.nan), {"n": np.stack([points] * 2, 1)}
    )
    data = Dataset("n", "mm", observations, known)
    write_dataset(data, tmp_path / form)
    files = [tmp_path / form] if (tmp_path / form).is_file() else sorted((tmp_path / form).glob("*.csv"))
    for file in files:
        for row in csv.reader(file.read_text().splitlines()):
            for cell in row:
                assert cell[:1] not in tuple("=+@-") or re.fullmatch(r"[-+][\d.e]+", cell)
    assert_same(read_dataset(tmp_path / form), data)


def test_names_in_measured_csv_are_no_formulas(tmp_path: Path) -> None:
    nothing = np.full((2, 3), np.nan)
    measured = Measurement(
        np.array(["=1+1", "b"]), nothing, np.full((2, 3, 3), np.nan), np.zeros(2, int), nothing[:, 0],
        np.array(["-seen by none", ""]), "mm",
    )  # fmt: skip
    measured.write_csv(tmp_path / "m.csv")
    rows = list(csv.reader((tmp_path / "m.csv").read_text().splitlines()))
    assert rows[1][0] == "'=1+1"
    assert rows[1][12] == "'-seen by none"


def test_rows_of_separators_and_empty_columns_are_nothing(tmp_path: Path) -> None:
    read = sheet(tmp_path, "x;y;z;u_a;v_a;;\n1;2;3;4;5;;\n;;;;;;\n6;7;8;9;10;;\n;;;;;;\n")
    assert read.xyz.tolist() == [[1, 2, 3], [6, 7, 8]]
    with pytest.raises(DatasetError, match="line 3: 4 cells"):
        sheet(tmp_path, "x;y;z;u_a;v_a;\n1;2;3;4;5;\n1;2;3;4\n")


@pytest.mark.parametrize(
    ("text", "label", "axis", "unit"),
    [
        ("u_cam 1 [left]", "cam 1 [left]", "u", ""),  # as in docs/formats.md: the name may be anything
        ("U_cam1", "cam1", "u", ""),
        ("Kamera 1 x", "Kamera 1", "x", ""),
        ("x [px] ", "", "x", "px"),
        ("cam1_x_px", "cam1", "x", "px"),
        ("X (mm)", "", "x", "mm"),
        ("x in µm", "", "x", "µm"),
        ("px1", "", "", ""),
        ("likelihood", "", "", ""),
        ("x_left_y", "", "", ""),
        ("max", "", "", ""),
        ("box", "", "", ""),
    ],
)
def test_a_heading_is_taken_apart(text: str, label: str, axis: str, unit: str) -> None:
    heading = take_apart(text.strip())
    assert (heading.label, heading.axis, heading.unit) == (label, axis, unit)


def test_names_that_only_cameras_have() -> None:
    assert all(is_camera_name(name, False) for name in ("cam1", "Kamera 2", "left", "top view", "GoPro 3", "camera_A"))
    assert not any(is_camera_name(name, False) for name in ("1", "A", "nose", "pt1_cam1", "marker1", "c1", "left eye"))
    assert is_camera_name("1", True)
    assert is_camera_name("c1", True)


def test_a_header_of_many_columns_takes_linear_time(tmp_path: Path) -> None:
    """60 s once for 30,000 columns of points.csv; now half a second."""
    many = [f"c{i}" for i in range(30_000)]
    folder = tmp_path / "rig"
    folder.mkdir()
    (folder / "dataset.toml").write_text('name = "a"\nlength_unit = "mm"\n[[cameras]]\nname = "a"\n')
    (folder / "points.csv").write_text(f"point,shot,x,y,z,{','.join(many)}\np,p,1,2,3{',7' * len(many)}\n")
    (folder / "observations.csv").write_text("point,camera,u,v\np,a,1,2\n")
    began = time.process_time()
    assert len(read_dataset(folder).positions.extra) == 30_000
    assert len(read_headings(["u_a", "v_a", *many], "w.csv").further) == 30_000
    assert time.process_time() - began < 20.0  # a slow machine; quadratic took minutes


PUBLIC_REPORTS = {
    # SheetJS issue 2239: the comma of the numbers was taken for the separator, and numbers were cut in two
    "semicolons with decimal commas": ("u_a;v_a;u_b;v_b\n1,1;2,2;3,3;4,1\n", [[1.1, 2.2], [3.3, 4.1]]),
    # IATI.cloud issue 1622: the first line tells Excel the separator, and is no heading
    "sep=": ("sep=;\nu_a;v_a;u_b;v_b\n1,5;2;3;4\n", [[1.5, 2], [3, 4]]),
    # BTKCore issue 9: points that are hidden were exported as 0
    "zeros": ("u_a,v_a,u_b,v_b\n0,0,3,4\n", [[np.nan, np.nan], [3, 4]]),
    # openturns issue 3064: a table in which a row has nothing but nan
    "nothing but nan": ('"u_a";"v_a";"u_b";"v_b"\nnan;nan;nan;nan\n', [[np.nan, np.nan], [np.nan, np.nan]]),
    # biodiverse issue 691: blank or NA coordinates stopped the import
    "blank and NA": ("u_a,v_a,u_b,v_b\nNA,NA,,\n", [[np.nan, np.nan], [np.nan, np.nan]]),
}


@pytest.mark.parametrize("report", PUBLIC_REPORTS)
def test_tables_of_public_bug_reports(report: str, tmp_path: Path) -> None:
    text, pixels = PUBLIC_REPORTS[report]
    np.testing.assert_array_equal(sheet(tmp_path, text).observations.uv[0], pixels)


def test_point_pairs_of_one_picture_are_no_cameras(tmp_path: Path) -> None:
    """Calcam issue 102: nobody knew how its table of point pairs looks, and a guess was read without a word."""
    with pytest.raises(DatasetError, match="it cannot be told whether 'Image' is a camera"):
        sheet(tmp_path, "Machine X,Machine Y,Machine Z,Image X,Image Y\n1,2,3,4,5\n")
