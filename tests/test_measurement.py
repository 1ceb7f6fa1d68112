"""measured.csv is a contract: its columns, its empty cells, its reasons."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from implicam.dataset import covariance_from_columns
from implicam.errors import ImplicamError
from implicam.measurement import MEASURED_COLUMNS, Measurement

REASON = 'inverse-gp needs all 3 cameras; not seen by cam1, "left"'
SD = np.array([[0.1, 0.2, 1 / 3], [np.nan] * 3, [1e-9, 2e5, 0.25]])
OFF = np.array([[0.001, -0.002, 0.003], [np.nan] * 3, [0.0, 1e-7, -1e-12]])


def measurement() -> Measurement:
    """Three points, the second not measured."""
    return Measurement(
        np.array(["p1", "a,b", "µ→3"]),
        np.array([[1.1, -2.2, 1e-17], [np.nan] * 3, [0.1 + 0.2, 1e300, -0.0]]),
        covariance_from_columns(SD, OFF),
        np.array([3, 1, 2]),
        np.array([0.7, np.nan, np.nan]),
        np.array(["", REASON, ""]),
        "mm",
    )


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file, strict=True))


def numbers(table: list[dict[str, str]], *columns: str) -> np.ndarray:
    return np.array([[float(row[c]) if row[c] else np.nan for c in columns] for row in table])


def test_the_columns_are_those_of_the_contract(tmp_path: Path) -> None:
    measurement().write_csv(tmp_path / "measured.csv")
    text = (tmp_path / "measured.csv").read_bytes().decode("utf-8")
    assert (
        text.split("\n")[0]
        == "point,x,y,z,sd_x,sd_y,sd_z,cov_xy,cov_xz,cov_yz,views,consistency,reason,share_calibration"
    )
    assert ",".join(MEASURED_COLUMNS) == text.split("\n")[0]
    assert "\r" not in text
    assert text.endswith("\n")
    assert text.count("\n") == 4


def test_every_number_reads_back(tmp_path: Path) -> None:
    m = measurement()
    m.write_csv(tmp_path / "measured.csv")
    table = rows(tmp_path / "measured.csv")
    assert [row["point"] for row in table] == m.points.tolist()
    xyz = numbers(table, "x", "y", "z")
    assert np.array_equal(xyz, m.xyz, equal_nan=True)
    assert np.signbit(xyz[2, 2])
    assert np.array_equal(numbers(table, "sd_x", "sd_y", "sd_z"), m.sd, equal_nan=True)
    assert np.array_equal(numbers(table, "cov_xy", "cov_xz", "cov_yz"), OFF, equal_nan=True)
    assert [row["views"] for row in table] == ["3", "1", "2"]
    cov = covariance_from_columns(numbers(table, "sd_x", "sd_y", "sd_z"), numbers(table, "cov_xy", "cov_xz", "cov_yz"))
    np.testing.assert_allclose(cov, m.cov, rtol=1e-15)


def test_what_is_not_there_is_empty_and_has_a_reason(tmp_path: Path) -> None:
    measurement().write_csv(tmp_path / "measured.csv")
    table = rows(tmp_path / "measured.csv")
    numeric = [c for c in MEASURED_COLUMNS if c not in ("point", "views", "reason")]
    assert [table[1][c] for c in numeric] == [""] * len(numeric)
    assert table[1]["reason"] == REASON
    assert (table[0]["reason"], table[2]["reason"]) == ("", "")
    assert [row["consistency"] for row in table] == ["0.7", "", ""]
    assert "nan" not in (tmp_path / "measured.csv").read_text(encoding="utf-8")
    assert f'"{REASON.replace(chr(34), chr(34) * 2)}"' in (tmp_path / "measured.csv").read_text(encoding="utf-8")


def test_nothing_measured_is_a_header(tmp_path: Path) -> None:
    nothing = Measurement(
        np.array([], dtype=np.str_),
        np.zeros((0, 3)),
        np.zeros((0, 3, 3)),
        np.zeros(0, dtype=np.int64),
        np.zeros(0),
        np.array([], dtype=np.str_),
        "mm",
    )
    nothing.write_csv(tmp_path / "measured.csv")
    assert rows(tmp_path / "measured.csv") == []
    assert len(nothing) == 0


def test_measured_and_sd() -> None:
    m = measurement()
    assert m.measured.tolist() == [True, False, True]
    np.testing.assert_allclose(m.sd[0], SD[0])
    assert np.isnan(m.sd[1]).all()


def test_writing_is_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "new" / "measured.csv"
    measurement().write_csv(path)  # makes the folder
    measurement().write_csv(str(path))  # and replaces the file
    assert [p.name for p in path.parent.iterdir()] == ["measured.csv"]
    (tmp_path / "dir.csv").mkdir()
    with pytest.raises(ImplicamError, match="is a folder, and a file is to be written"):
        measurement().write_csv(tmp_path / "dir.csv")


def test_a_covariance_is_symmetric_whatever_order_it_was_summed_in() -> None:
    m = measurement()
    skewed = m.cov.copy()
    skewed[0, 0, 1] = np.nextafter(skewed[0, 0, 1], 1.0)
    cov = Measurement(m.points, m.xyz, skewed, m.views, m.consistency, m.reason, "mm").cov
    np.testing.assert_array_equal(cov, cov.swapaxes(1, 2))
    np.testing.assert_allclose(cov, m.cov, rtol=1e-15)
