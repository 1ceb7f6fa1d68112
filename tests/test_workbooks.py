"""Excel workbooks, and Parquet files of other programs."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dataset_files import assert_same
from implicam.dataset import Camera, Dataset, KnownPositions, Observations, read_dataset, write_dataset
from implicam.errors import DatasetError, ImplicamError
from implicam.simulate import simulated

HEADER = ["Marker", "X [m]", "Y [m]", "Z [m]", "Kamera 1 x", "Kamera 1 y", "Kamera 2 x", "Kamera 2 y"]


def workbook(path: Path, *sheets: list[list[Any]]) -> Path:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.remove(book.active)
    for i, rows in enumerate(sheets):
        sheet = book.create_sheet(f"Tabelle{i + 1}")
        for row in rows:
            sheet.append(row)
    book.save(path)
    return path


def test_a_workbook_as_people_have_it(tmp_path: Path) -> None:
    rows = [HEADER, [1, 2.829, 1, 0.187, 1098.61, 621.74, None, None], ["M2", 1.5, 1.25, 1, 875, 466.12, -1, -1]]
    read = read_dataset(workbook(tmp_path / "w.xlsx", rows, []))
    assert read.length_unit == "m"
    assert read.points.tolist() == ["1", "M2"]
    assert read.xyz.tolist() == [[2.829, 1, 0.187], [1.5, 1.25, 1]]
    assert read.observations.uv[:, 0].tolist() == [[1098.61, 621.74], [875, 466.12]]
    assert not read.observations.seen[:, 1].any()
    assert "'Marker' names the points" in read.notes[0]
    assert "(-1, -1)" in read.notes[1]


def test_a_dataset_comes_back_from_a_workbook(tmp_path: Path) -> None:
    pytest.importorskip("openpyxl")
    points = np.array(["=1+1", "-M 2", "'c", "1.50"])
    known = KnownPositions(points, np.arange(12.0).reshape(4, 3) / 8, np.full((4, 3), 0.1), {"note": points})
    uv = np.arange(16.0).reshape(4, 2, 2) / 4
    uv[2, 1] = np.nan
    cameras = (Camera("a", 640, 480), Camera("b"))
    data = Dataset("n", "mm", Observations(points, cameras, uv, np.full(uv.shape, np.nan)), known)
    write_dataset(data, tmp_path / "d.xlsx")
    assert_same(read_dataset(tmp_path / "d.xlsx"), data)
    simulation = simulated("stereo", points=5, seed=0)
    write_dataset(simulation, tmp_path / "s.xlsx")
    again = read_dataset(tmp_path / "s.xlsx")
    np.testing.assert_allclose(again.observations.uv, simulation.observations.uv, rtol=1e-15)  # openpyxl: 16 digits
    assert again.truth is not None


@pytest.mark.parametrize(
    ("sheets", "said"),
    [
        (
            [[HEADER, ["a", "=1+1", 2, 3, 4, 5, 6, 7]]],
            "row 2, cell 2: the value of the formula '=1+1' is not in the file",
        ),
        ([[HEADER, ["a", "#REF!", 2, 3, 4, 5, 6, 7]]], "X [m] = '#REF!' is not a number"),
        ([[HEADER, ["a", True, 2, 3, 4, 5, 6, 7]]], "X [m] = 'True' is not a number"),
        ([[HEADER, ["a", 1, 2, 3, 4, 5, 6, 7]]] * 2, "has 2 sheets with a table: 'Tabelle1', 'Tabelle2'"),
        ([[]], "is empty"),
        ([[HEADER]], "has a header and no rows"),
        ([[HEADER, ["a", 1, 2, 3, 4, None, 6, 7]]], "row 2, camera 'Kamera 1': u = 4, v = nan"),
    ],
)
def test_what_a_workbook_does_not_say_is_refused(sheets: list[list[list[Any]]], said: str, tmp_path: Path) -> None:
    path = workbook(tmp_path / "w.xlsx", *sheets)
    with pytest.raises(DatasetError) as caught:
        read_dataset(path)
    assert said in caught.value.what
    assert str(path) in caught.value.what
    assert caught.value.fix


PLACES = [["name", "X", "Y", "Z", "shot"], ["b", 4, 5, 6, "s"], ["a", 1, 2, 3, "s"], ["c", 7, 8, 9, "s"]]
PIXELS = [["point", "u_cam1", "v_cam1"], ["a", 1.5, 2.5], ["b", 3.5, 4.5]]


def test_positions_on_a_sheet_of_their_own_are_joined_by_name(tmp_path: Path) -> None:
    read = read_dataset(workbook(tmp_path / "w.xlsx", PLACES, PIXELS, [["seen by Ann"]]), unit="mm")
    assert read.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert read.shots.tolist() == ["s", "s"]
    assert "sheet 'Tabelle1', 1 of them of points that no camera saw" in read.notes[0]
    assert "left out are the sheets 'Tabelle3'" in read.notes[0]


@pytest.mark.parametrize(
    ("sheets", "said"),
    [
        ([PLACES[:2], PIXELS], "point 'a' has no known position"),
        ([[*PLACES, PLACES[1]], PIXELS], "the point 'b' is there twice"),
        ([PLACES, PLACES, PIXELS], "cannot be told which known positions"),
        ([PLACES, [row[1:] for row in PIXELS]], "cannot be told which known positions"),
    ],
)
def test_positions_on_a_sheet_that_do_not_fit_are_refused(sheets: Any, said: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        read_dataset(workbook(tmp_path / "w.xlsx", *sheets), unit="mm")
    assert said in caught.value.what


def test_a_workbook_that_grows_beyond_measure(tmp_path: Path) -> None:
    pytest.importorskip("openpyxl")
    with zipfile.ZipFile(tmp_path / "w.xlsx", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/worksheets/sheet1.xml", b"0" * (1 << 25))
    with pytest.raises(DatasetError, match="bytes unpacked"):
        read_dataset(tmp_path / "w.xlsx")


@pytest.mark.parametrize("name", ["w.xls", "w.ods", "w.xlsx"])
def test_what_is_no_workbook(name: str, tmp_path: Path) -> None:
    pytest.importorskip("openpyxl")
    (tmp_path / name).write_bytes(b"PK no zip at all")
    with pytest.raises(DatasetError) as caught:
        read_dataset(tmp_path / name)
    assert "as .xlsx" in caught.value.fix


@pytest.mark.parametrize("name", ["w.tsv", "w.ods", "w.txt"])
def test_what_is_not_written(name: str, tmp_path: Path) -> None:
    with pytest.raises(ImplicamError, match="no dataset is written as"):
        write_dataset(simulated("stereo", points=3, seed=0), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_parquet_of_another_program(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    columns = {
        "name": ["a", "b"], "X": [1.5, 2.0], "Y": [3, 4], "Z": [5.0, 6.0],
        "cam1_x": [7.25, None], "cam1_y": [8.0, None], "cam2_x": [9.0, float("nan")], "cam2_y": [1.0, float("nan")],
        "frame": [1, 2],
    }  # fmt: skip
    parquet.write_table(pyarrow.table(columns), tmp_path / "t.parquet")
    read = read_dataset(tmp_path / "t.parquet", unit="mm")
    assert read.points.tolist() == ["a", "b"]
    assert read.xyz.tolist() == [[1.5, 3, 5], [2, 4, 6]]
    assert read.observations.seen.tolist() == [[True, True], [False, False]]
    assert read.positions.extra["frame"].tolist() == ["1", "2"]
    with pytest.raises(DatasetError, match="length unit of x, y, z is not stated"):
        read_dataset(tmp_path / "t.parquet")
