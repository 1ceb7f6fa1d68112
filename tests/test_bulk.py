"""Tables of any length: what is measured in parts is what is measured at once, whatever ends it on the way."""

from __future__ import annotations

import csv
import json
from decimal import Decimal
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import implicam as ic
from command_line import Cli, cli  # noqa: F401
from implicam import bulk
from implicam.bulk import BulkResult, measure_file
from implicam.calibrators.protocol import RigCalibration
from implicam.errors import DatasetError, ImplicamError, UsageError
from implicam.measurement import MEASURED_COLUMNS

ROWS = 95


@cache
def made() -> RigCalibration:
    calibration: RigCalibration = ic.Explicit(lens="brown-conrady").fit(
        ic.simulated("bar4", points=135, seed=1).select(np.arange(40))
    )
    return calibration


@cache
def pixels() -> np.ndarray:
    uv = ic.simulated("bar4", points=135, seed=1).observations.uv[40:].copy()
    uv[np.random.default_rng(1).random(uv.shape[:2]) < 0.2] = np.nan
    uv[7], uv[8, 1:] = np.nan, np.nan
    uv[9] = ic.simulated("bar4", points=135, seed=1).observations.uv[49] + [[30.0, 0], [0, 0], [0, 0], [0, 0]]
    return uv


NAMES = [f'point {i}, "{i}"' for i in range(ROWS - 1)] + ["=1+1"]


def table(path: Path) -> Path:
    """The pixels in a file."""
    uv, cameras = pixels(), made().camera_names
    heads = [f"{axis}_{name}" for name in cameras for axis in "uv"]
    if path.suffix == ".npz":
        np.savez(path, uv=uv[:, ::-1], cameras=np.array(cameras)[::-1], point=np.array(NAMES))
    elif path.suffix == ".csv":
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["frame", "point", *heads])
            for i, row in enumerate(uv.reshape(ROWS, -1).tolist()):
                writer.writerow([i, NAMES[i], *("" if x != x else repr(x) for x in row)])
    else:
        arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
        columns = dict(zip(heads, uv.reshape(ROWS, -1).T, strict=True))
        parquet.write_table(arrow.table({"point": NAMES, **columns}), path, row_group_size=17)
    return path


def read(path: Path) -> dict[str, np.ndarray]:
    """x, y, z, sd_x, views, reason of what was written."""
    if path.suffix == ".npz":
        with np.load(path) as file:
            found = dict(file)
        sd = np.sqrt(found["cov"][:, 0, 0])
        return {
            "point": found["point"],
            "xyz": found["xyz"],
            "sd_x": sd,
            "views": found["views"],
            "code": found["code"],
        }
    if path.suffix == ".csv":
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file, strict=True))
        columns = {name: [row[name] for row in rows] for name in MEASURED_COLUMNS}
    else:
        columns = pytest.importorskip("pyarrow.parquet").read_table(path).to_pydict()
    number = {
        name: np.array([np.nan if x in ("", None) else float(x) for x in columns[name]])
        for name in ("x", "y", "z", "sd_x")
    }
    xyz = np.stack([number[axis] for axis in "xyz"], axis=1)
    views = np.array([int(x) for x in columns["views"]])
    return {
        "point": np.array(columns["point"]),
        "xyz": xyz,
        "sd_x": number["sd_x"],
        "views": views,
        "reason": np.array(columns["reason"]),
    }


@pytest.mark.parametrize(
    ("ending", "result"), [(".csv", ".csv"), (".parquet", ".parquet"), (".npz", ".npz"), (".npz", ".csv")]
)
def test_parts_are_the_whole(ending: str, result: str, tmp_path: Path) -> None:
    done = measure_file(made(), table(tmp_path / f"new{ending}"), tmp_path / f"measured{result}", points_at_once=20)
    whole = made().measure_pixels(pixels())
    found = read(tmp_path / f"measured{result}")
    assert done == BulkResult(ROWS, int(whole.measured.sum()), 0, ())
    np.testing.assert_allclose(found["xyz"], whole.xyz, rtol=1e-9)
    np.testing.assert_allclose(found["sd_x"], whole.sd[:, 0], rtol=1e-6)
    np.testing.assert_array_equal(found["views"], whole.views)
    if "reason" in found:
        assert found["reason"].tolist() == whole.reason.tolist()
    names = [*NAMES[:-1], "'=1+1" if result == ".csv" else "=1+1"]
    assert found["point"].tolist() == names
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([f"new{ending}", f"measured{result}"])


@pytest.mark.parametrize("ending", [".csv", ".parquet", ".npz"])
@pytest.mark.parametrize("after", [0, 2, 5])
def test_ended_anywhere_it_goes_on_and_no_row_is_there_twice_or_missing(
    ending: str, after: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = table(tmp_path / f"new{ending}"), tmp_path / f"measured{ending}"
    measure_file(made(), source, tmp_path / f"at once{ending}", points_at_once=20)
    write, written = bulk._WRITERS[ending], []

    def dies(*arguments: object) -> None:
        written.append(arguments)
        write(*arguments)  # type: ignore[arg-type]
        if len(written) > after:
            raise KeyboardInterrupt

    monkeypatch.setitem(bulk._WRITERS, ending, dies)
    if after < 5:
        with pytest.raises(KeyboardInterrupt):
            measure_file(made(), source, target, points_at_once=20)
    else:  # in putting together
        monkeypatch.setitem(bulk._JOINERS, ending, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            measure_file(made(), source, target, points_at_once=20)
    assert not target.exists()
    monkeypatch.undo()
    done = measure_file(made(), source, target, points_at_once=20)
    assert (done.rows, done.resumed) == (ROWS, min(20 * after, ROWS))
    for name, values in read(tmp_path / f"at once{ending}").items():
        np.testing.assert_array_equal(read(target)[name], values)


def test_without_pyarrow_csv_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = table(tmp_path / "new.csv")
    measure_file(made(), source, tmp_path / "one.csv", points_at_once=20)
    monkeypatch.setattr(bulk, "find_spec", lambda _: None)
    measure_file(made(), source, tmp_path / "two.csv", points_at_once=30)
    for name, values in read(tmp_path / "one.csv").items():
        np.testing.assert_array_equal(read(tmp_path / "two.csv")[name], values)


def test_parts_of_another_measurement_are_not_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = table(tmp_path / "new.csv")
    monkeypatch.setitem(bulk._JOINERS, ".csv", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        measure_file(made(), source, tmp_path / "m.csv", points_at_once=50)
    with pytest.raises(UsageError, match="another measurement"):
        measure_file(made(), source, tmp_path / "m.csv", points_at_once=60)
    source.write_text(source.read_text() + "\n")
    with pytest.raises(UsageError, match="another measurement"):
        measure_file(made(), source, tmp_path / "m.csv", points_at_once=50)


def test_a_folder_of_a_person_is_not_taken_for_parts(tmp_path: Path) -> None:
    notes = tmp_path / "m.csv.parts" / "notes.txt"
    notes.parent.mkdir()
    notes.write_text("mine")
    with pytest.raises(DatasetError, match=r"'notes\.txt', which is no part of a measurement in parts"):
        measure_file(made(), table(tmp_path / "new.csv"), tmp_path / "m.csv", points_at_once=50)
    assert notes.read_text() == "mine"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("point,u_cam1,v_cam1,u_cam2,v_cam2\na,1,2,3,4\nb,1,2,x,4\n", "row 2: u_cam2 is 'x'"),
        ("point,u_cam1,v_cam1,u_cam2,v_cam2\na,1,2,3\n", "row 1: v_cam2 is 'nothing'"),
        ("point,u_cam1,v_cam1,u_cam2,v_cam2\na,1,,3,4\n", "row 1, camera 'cam1'"),
        ("point,u_cam1,v_cam1,u_cam2,v_cam2\na,1,2,3,inf\n", "row 1, camera 'cam2'"),
        ("point,u_cam1,v_cam1,u_cam2,v_cam2\na,1,2,3,99999\n", "far outside"),
        ("point,u_cam1,v_cam1\na,1,2\n", "fewer than two cameras"),
        ("u_cam1,v_cam1,u_cam2,v_cam2,sd_u_cam1\n1,2,3,4,5\n", "sd_u_cam1"),
        ("u_cam1,v_cam1,u_cam2,v_cam2\n", "no points"),
        ("u_cam1,v_cam1,u_cam2,v_cam2,u_cam1\n1,2,3,4,5\n", "u_cam1 more than once"),
        ("u_cam1,v_cam1,u_cam2,v_cam2\n1,2,3,4\n1,5,2,3,4\n", "row 2 has 5 cells"),
        ('point,u_cam1,v_cam1,u_cam2,v_cam2\na,1,2,3,4\n"b\nc",1,2,3,4\n', "row 2: a cell goes over more"),
        ("", "fewer than two cameras"),
    ],
)
def test_mistakes_are_named(content: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "new.csv").write_text(content)
    with pytest.raises(ImplicamError, match=words):
        measure_file(made(), tmp_path / "new.csv", tmp_path / "m.csv")


def test_a_csv_of_another_encoding_is_named(tmp_path: Path) -> None:
    for encoding in ("utf-16", "latin-1"):
        (tmp_path / "new.csv").write_bytes("point,u_cam1,v_cam1,u_cam2,v_cam2\n\u00e9,1,2,3,4\n".encode(encoding))
        with pytest.raises(DatasetError, match=r"new\.csv is no UTF-8"):
            measure_file(made(), tmp_path / "new.csv", tmp_path / "m.csv")


@pytest.mark.parametrize("kind", ["dictionary", "text", "float32", "decimal"])
def test_parquet_of_other_types_is_the_same(kind: str, tmp_path: Path) -> None:
    """Columns that pandas, R and databases write; float32 keeps 1e-4 px of 2,000."""
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")

    def column(values: np.ndarray) -> object:
        if kind == "text":
            return ["" if x != x else repr(x) for x in values.tolist()]
        if kind == "decimal":
            return [None if x != x else Decimal(repr(x)).quantize(Decimal("1e-9")) for x in values.tolist()]
        if kind == "dictionary":
            return arrow.array(values, from_pandas=True).dictionary_encode()
        return values.astype(np.float32)

    heads = [f"{axis}_{name}" for name in made().camera_names for axis in "uv"]
    columns = {name: column(values) for name, values in zip(heads, pixels().reshape(ROWS, -1).T, strict=True)}
    parquet.write_table(
        arrow.table({"point": arrow.array(NAMES).dictionary_encode(), **columns}), tmp_path / "new.parquet"
    )
    measure_file(made(), tmp_path / "new.parquet", tmp_path / "m.parquet", points_at_once=20)
    found, whole = read(tmp_path / "m.parquet"), made().measure_pixels(pixels())
    np.testing.assert_allclose(found["xyz"], whole.xyz, atol=1e-3 if kind == "float32" else 1e-6)
    assert found["point"].tolist() == NAMES


def test_frame_numbers_with_gaps_keep_their_digits(tmp_path: Path) -> None:
    """Pandas makes floats of them: 2147483648.0, and of a missing one None or NaN."""
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    heads = [f"{axis}_{name}" for name in made().camera_names for axis in "uv"]
    columns = dict(zip(heads, pixels()[:4].reshape(4, -1).T, strict=True))
    for names in ([2.0**31, 2.0**53 - 1, None, float("nan")], [2**31, 2**53 - 1, None, None]):
        parquet.write_table(arrow.table({"point": arrow.array(names), **columns}), tmp_path / "new.parquet")
        measure_file(made(), tmp_path / "new.parquet", tmp_path / "m.parquet")
        assert read(tmp_path / "m.parquet")["point"].tolist() == ["2147483648", "9007199254740991", "", ""]


def test_parquet_that_has_no_pixels_is_named(tmp_path: Path) -> None:
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    heads, path = [f"{axis}_{name}" for name in made().camera_names for axis in "uv"], tmp_path / "new.parquet"
    numbers = arrow.array([1.0])
    others = {
        "row 1: u_cam1 is 'x'": arrow.array(["x"]),
        "u_cam1 is of the type timestamp": arrow.array([0], arrow.timestamp("s")),
        "u_cam1 is of the type bool": arrow.array([True]),
    }
    for words, values in others.items():
        parquet.write_table(arrow.table([values] + [numbers] * 7, names=heads), path)
        with pytest.raises(DatasetError, match=words):
            measure_file(made(), path, tmp_path / "m.csv")
    parquet.write_table(arrow.table([numbers] * 9, names=[*heads, heads[0]]), path)
    with pytest.raises(DatasetError, match="u_cam1 more than once"):
        measure_file(made(), path, tmp_path / "m.csv")
    path.write_bytes(path.read_bytes()[:100])  # as a writer leaves it that was killed
    with pytest.raises(DatasetError, match="cannot be read as Parquet"):
        measure_file(made(), path, tmp_path / "m.csv")


def test_what_is_no_table_is_refused(tmp_path: Path) -> None:
    (tmp_path / "new.npz").write_bytes(b"nothing")
    np.savez(tmp_path / "flat.npz", uv=np.zeros((3, 4)))
    for name in ("new.npz", "flat.npz", "none.csv"):
        with pytest.raises(DatasetError):
            measure_file(made(), tmp_path / name, tmp_path / "m.csv")
    with pytest.raises(UsageError, match="no table"):
        measure_file(made(), tmp_path / "new.xlsx", tmp_path / "m.csv")


def test_the_command(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made().save("rig.implicam")
    table(tmp_path / "new.csv")
    ran = cli("measure", "rig.implicam", "new.csv", "-o", "m.csv", "--chunk", "50")
    assert ran.code == 0, ran.err
    assert "m.csv: 95 rows, " in ran.out
    told = cli("measure", "rig.implicam", "new.csv", "-o", "m.npz", "--chunk", "50", "--json").json
    assert (told["rows"], told["resumed"]) == (95, 0)
    assert json.dumps(told)
    assert "goes with no other option" in cli("measure", "rig.implicam", "new.csv", "--chunk", "50", "--unit", "m").err
