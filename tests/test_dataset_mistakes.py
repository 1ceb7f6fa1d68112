"""Every mistake in the files of a dataset is named with file, line, value and cure."""

# ruff: noqa: E501  (errors are asserted with their whole text)

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dataset_files import POINTS, TOML, VIEWS, WIDE, assert_same, folder, put, wide
from implicam.dataset import Dataset, KnownPositions, Observations, read_dataset, write_dataset
from implicam.errors import DatasetError
from implicam.simulate import simulated


def test_the_valid_files_are_valid(tmp_path: Path) -> None:
    assert len(read_dataset(folder(tmp_path))) == 2


@pytest.mark.parametrize(
    ("files", "name", "change"),
    [
        ("BOM", "*", lambda b: b"\xef\xbb\xbf" + b),
        ("CRLF", "*", lambda b: b.replace(b"\n", b"\r\n")),
        ("CRLF and BOM", "*", lambda b: b"\xef\xbb\xbf" + b.replace(b"\n", b"\r\n")),
        ("CRCRLF", "*.csv", lambda b: b.replace(b"\n", b"\r\r\n")),
        ("blank lines", "*", lambda b: b.replace(b"\n", b"\n\n  \n")),
        ("blank lines first", "*", lambda b: b"\n\n" + b),
        ("no line end at the end", "*", lambda b: b.rstrip(b"\n")),
        ("spaces around cells", "*.csv", lambda b: b.replace(b",", b" , ")),
        ("everything quoted", "*.csv", lambda b: b'"' + b[:-1].replace(b",", b'","').replace(b"\n", b'"\n"') + b'"\n'),
    ],
)
def test_harmless_differences_are_read(tmp_path: Path, files: str, name: str, change: Any) -> None:
    plain, path = folder(tmp_path / "plain"), folder(tmp_path / "changed")
    for file in path.glob(name):
        file.write_bytes(change(file.read_bytes()))
    assert_same(read_dataset(plain), read_dataset(path))


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root reads everything")
def test_no_permission(tmp_path: Path) -> None:
    path = folder(tmp_path)
    (path / "points.csv").chmod(0)
    with pytest.raises(DatasetError, match="cannot be read"):
        read_dataset(path)


def test_a_file_the_system_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder(tmp_path)

    def refuse(self: Path, *_: Any, **__: Any) -> Any:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(DatasetError) as caught:
        read_dataset(path)
    assert str(caught.value).splitlines() == [
        f"{path} cannot be read.",
        f"  why: [Errno 13] Permission denied: '{path / 'dataset.toml'}'",
        "  fix: check the name and the permissions",
    ]


def test_names_the_system_cannot_have() -> None:
    for path in ("x" * 5000, "a\0b.csv", "a\0b", "nowhere.parquet", "nowhere.npz", "nowhere.csv"):
        with pytest.raises(DatasetError):
            read_dataset(path)


# Each mistake with the whole text of its error; {at} is the folder.
MISTAKES: dict[str, tuple[dict[str, str | bytes | None], str]] = {
    'unknown camera': (
        put("observations.csv", "p1,cam2", "p1,cam 2"),
        (
            "{at}/rig/observations.csv, line 3: camera 'cam 2' is not in dataset.toml (did you mean 'cam2'?).\n"
            '  fix: the cameras are cam1, cam2; correct the row or add a [[cameras]] table'
        ),
    ),
    'duplicate view': (
        put("observations.csv", "p1,cam2", "p1,cam1"),
        (
            "{at}/rig/observations.csv, line 3: point 'p1' is seen twice by camera 'cam1' (first at {at}/rig/observations.csv, line 2).\n"
            '  fix: keep one of the two rows'
        ),
    ),
    'duplicate point': (
        put("points.csv", "\np2,s1", "\np1,s1"),
        (
            "{at}/rig/points.csv, line 3: point 'p1' is there twice (first at {at}/rig/points.csv, line 2).\n"
            '  fix: remove one, or give each point a name of its own'
        ),
    ),
    'text': (
        put("points.csv", "4,5,6", "4,five,6"),
        (
            "{at}/rig/points.csv, line 3: y = 'five' is not a number.\n"
            '  fix: correct the value or remove the row'
        ),
    ),
    'nan': (
        put("points.csv", "4,5,6", "4,nan,6"),
        (
            "{at}/rig/points.csv, line 3: y = 'nan' is not a finite number.\n"
            '  fix: a known point needs its position: add it, or remove the point'
        ),
    ),
    'inf': (
        put("points.csv", "4,5,6", "4,-inf,6"),
        (
            "{at}/rig/points.csv, line 3: y = '-inf' is not a finite number.\n"
            '  fix: a known point needs its position: add it, or remove the point'
        ),
    ),
    'huge': (
        put("points.csv", "4,5,6", "4,1e999,6"),
        (
            "{at}/rig/points.csv, line 3: y = '1e999' is not a finite number.\n"
            '  fix: a known point needs its position: add it, or remove the point'
        ),
    ),
    'empty number': (
        put("points.csv", "4,5,6", "4,,6"),
        (
            "{at}/rig/points.csv, line 3: y = '' is not a number.\n"
            '  why: the cell is empty\n'
            '  fix: a known point needs its position: add it, or remove the point'
        ),
    ),
    'decimal comma': (
        put("points.csv", "4,5,6", '4,"5,5",6'),
        (
            "{at}/rig/points.csv, line 3: y = '5,5' is not a number.\n"
            '  why: it has a decimal comma\n'
            '  fix: write it with a decimal point'
        ),
    ),
    'decimal comma unquoted': (
        put("points.csv", "4,5,6", '4,5,5,6'),
        (
            "{at}/rig/points.csv, line 3: 9 cells, but the header names 8: 'p2,s1,4,5,5,6,,,'.\n"
            '  why: a decimal comma splits a number in two\n'
            '  fix: give every column one cell; use decimal points'
        ),
    ),
    'underscore': (
        put("points.csv", "4,5,6", "4,1_000,6"),
        (
            "{at}/rig/points.csv, line 3: y = '1_000' is not a number.\n"
            '  fix: correct the value or remove the row'
        ),
    ),
    'unicode digits': (
        put("points.csv", "4,5,6", "4,٣,6"),
        (
            "{at}/rig/points.csv, line 3: y = '٣' is not a number.\n"
            '  fix: correct the value or remove the row'
        ),
    ),
    'hex': (
        put("points.csv", "4,5,6", "4,0x10,6"),
        (
            "{at}/rig/points.csv, line 3: y = '0x10' is not a number.\n"
            '  fix: correct the value or remove the row'
        ),
    ),
    'nan pixel': (
        put("observations.csv", "50,60", "nan,60"),
        (
            "{at}/rig/observations.csv, line 4, camera 'cam1': u = nan, v = 60.\n"
            '  why: a view has both u and v, finite, or neither\n'
            '  fix: correct the value, or leave both u and v empty (NaN) where the view is missing'
        ),
    ),
    'far outside': (
        put("observations.csv", "50,60", "50,-60"),
        (
            "{at}/rig/observations.csv, line 4, camera 'cam1': pixel u = 50, v = -60 is far outside the 640 x 480 image.\n"
            '  why: u is the column and v the row, counted from 0 at the centre of the top-left pixel\n'
            '  fix: correct the value, remove the row, or correct the width and height of the camera'
        ),
    ),
    'far outside 2': (
        put("observations.csv", "50,60", "1e4,60"),
        (
            "{at}/rig/observations.csv, line 4, camera 'cam1': pixel u = 10000, v = 60 is far outside the 640 x 480 image.\n"
            '  why: u is the column and v the row, counted from 0 at the centre of the top-left pixel\n'
            '  fix: correct the value, remove the row, or correct the width and height of the camera'
        ),
    ),
    'no known position': (
        put("observations.csv", "p2,cam1", "p3,cam1"),
        (
            "{at}/rig/observations.csv, line 4: point 'p3' has no known position in points.csv.\n"
            '  fix: add it to {at}/rig/points.csv, remove this row, or measure it from a dataset without points.csv'
        ),
    ),
    'only u': (
        put("observations.csv", "50,60", "50,"),
        (
            "{at}/rig/observations.csv, line 4, camera 'cam1': u = 50, v = nan.\n"
            '  why: a view has both u and v, finite, or neither\n'
            '  fix: correct the value, or leave both u and v empty (NaN) where the view is missing'
        ),
    ),
    'negative sd': (
        put("points.csv", ".1,.1,0", ".1,-.1,0"),
        (
            "{at}/rig/points.csv, line 2: sd_y = -0.1.\n"
            '  why: a standard uncertainty is at least zero and finite\n'
            '  fix: correct the value, or leave it empty (NaN) where no uncertainty is stated'
        ),
    ),
    'zero sd_u': (
        put("observations.csv", "10,20,.1,.1", "10,20,0,.1"),
        (
            "{at}/rig/observations.csv, line 2, camera 'cam1': sd_u = 0, sd_v = 0.1.\n"
            '  why: a standard uncertainty is greater than zero and finite\n'
            '  fix: correct the value, or leave it empty (NaN) where no uncertainty is stated'
        ),
    ),
    'sd nan': (
        put("observations.csv", "10,20,.1,.1", "10,20,nan,.1"),
        (
            "{at}/rig/observations.csv, line 2: sd_u = 'nan' is not a finite number.\n"
            '  fix: leave the cell empty where no uncertainty is stated'
        ),
    ),
    'empty point name': (
        put("observations.csv", "p2,cam1", ",cam1"),
        (
            "{at}/rig/observations.csv, line 4: point '' is not usable.\n"
            '  why: names are printable text of at most 200 characters without spaces at either end\n'
            '  fix: rename it'
        ),
    ),
    'unprintable shot': (
        put("points.csv", "p2,s1", "p2,s\u200b1"),
        (
            "{at}/rig/points.csv, line 3: shot 's\\u200b1' is not usable.\n"
            '  why: names are printable text of at most 200 characters without spaces at either end\n'
            '  fix: rename it'
        ),
    ),
    'toml syntax': (
        put("dataset.toml", 'length_unit = "mm"', "length_unit = mm"),
        (
            '{at}/rig/dataset.toml: not valid TOML: Invalid value (at line 2, column 15).\n'
            '  fix: check that line: text wants quotes (name = "my-rig"), tables are written [[cameras]]'
        ),
    ),
    'toml key': (
        put("dataset.toml", "length_unit", "lenght_unit"),
        (
            "{at}/rig/dataset.toml: 'length_unit' is missing.\n"
            "  why: 'lenght_unit' may be a misspelling of it\n"
            '  fix: write the line length_unit = "mm"'
        ),
    ),
    'toml camera key': (
        put("dataset.toml", 'name = "cam2"\nwidth', 'name = "cam2"\nwidht'),
        (
            "{at}/rig/dataset.toml: camera 'cam2' has no width.\n"
            "  why: 'widht' may be a misspelling of it\n"
            '  fix: write width = 1280, in pixels'
        ),
    ),
    'width text': (
        put("dataset.toml", 'name = "cam2"\nwidth = 640', 'name = "cam2"\nwidth = "640"'),
        (
            "{at}/rig/dataset.toml: camera 'cam2' has width = '640'; it must be a whole number of pixels.\n"
            '  fix: give the width of its images, for example width = 1280'
        ),
    ),
    'width float': (
        put("dataset.toml", 'name = "cam2"\nwidth = 640', 'name = "cam2"\nwidth = 640.0'),
        (
            "{at}/rig/dataset.toml: camera 'cam2' has width = 640.0; it must be a whole number of pixels.\n"
            '  fix: give the width of its images, for example width = 1280'
        ),
    ),
    'width bool': (
        put("dataset.toml", 'name = "cam2"\nwidth = 640', 'name = "cam2"\nwidth = true'),
        (
            "{at}/rig/dataset.toml: camera 'cam2' has width = True; it must be a whole number of pixels.\n"
            '  fix: give the width of its images, for example width = 1280'
        ),
    ),
    'width negative': (
        put("dataset.toml", 'name = "cam2"\nwidth = 640', 'name = "cam2"\nwidth = -640'),
        (
            "{at}/rig/dataset.toml: camera 'cam2' has width = -640; it must be a whole number of pixels.\n"
            '  fix: give the width of its images, for example width = 1280'
        ),
    ),
    'width enormous': (
        put("dataset.toml", 'name = "cam2"\nwidth = 640', 'name = "cam2"\nwidth = 0x' + "f" * 9000),
        (
            '{at}/rig/dataset.toml: not valid TOML: a whole number has more than 64 bits.\n'
            '  fix: check that line: text wants quotes (name = "my-rig"), tables are written [[cameras]]'
        ),
    ),
    'width endless': (
        put("dataset.toml", 'name = "cam2"\nwidth = 640', 'name = "cam2"\nwidth = ' + "9" * 9000),
        (
            '{at}/rig/dataset.toml: not valid TOML: Exceeds the limit (4300 digits) for integer string conversion: value has 9000 digits; use sys.set_int_max_str_digits() to increase the limit.\n'
            '  fix: check that line: text wants quotes (name = "my-rig"), tables are written [[cameras]]'
        ),
    ),
    'no cameras': (
        {"dataset.toml": 'name = "rig"\nlength_unit = "mm"\n'},
        (
            '{at}/rig/dataset.toml: there is no [[cameras]] table.\n'
            '  fix: add, for each camera, [[cameras]] with name = "cam1", width = 1280, height = 800'
        ),
    ),
    'camera misspelt': (
        {"dataset.toml": TOML.replace("cameras", "camera")},
        (
            '{at}/rig/dataset.toml: there is no [[cameras]] table.\n'
            "  why: 'camera' may be a misspelling of it\n"
            '  fix: add, for each camera, [[cameras]] with name = "cam1", width = 1280, height = 800'
        ),
    ),
    'duplicate camera': (
        put("dataset.toml", '"cam2"', '"cam1"'),
        (
            "{at}/rig/dataset.toml: camera 'cam1' is there twice.\n"
            '  fix: remove one, or give each camera a name of its own'
        ),
    ),
    'name no text': (
        put("dataset.toml", '"rig"', "5"),
        (
            '{at}/rig/dataset.toml: name = 5 must be text.\n'
            '  fix: write name = "my-rig"'
        ),
    ),
    'name unprintable': (
        put("dataset.toml", '"rig"', '"r\\u0007g"'),
        (
            "{at}/rig/dataset.toml: dataset name 'r\\x07g' is not usable.\n"
            '  why: names are printable text of at most 200 characters without spaces at either end\n'
            '  fix: rename it'
        ),
    ),
    'camera is a path': (
        put("dataset.toml", '"cam2"', '"../cam2"'),
        (
            "{at}/rig/dataset.toml: camera name '../cam2' cannot name a folder.\n"
            '  fix: leave out slashes, backslashes and a leading dot'
        ),
    ),
    'toml deep': (
        {"dataset.toml": "a = " + "[" * 5000},
        (
            '{at}/rig/dataset.toml: not valid TOML: it is nested too deeply.\n'
            '  fix: check that line: text wants quotes (name = "my-rig"), tables are written [[cameras]]'
        ),
    ),
    'toml deep key': (
        {"dataset.toml": "a" + ".a" * 200000 + " = 1"},
        (
            '{at}/rig/dataset.toml: not valid TOML: more than 500 dots in one line (at line 1); break it into several.\n'
            '  fix: check that line: text wants quotes (name = "my-rig"), tables are written [[cameras]]'
        ),
    ),
    'toml deep keys': (
        {"dataset.toml": "a" + ".a" * 60 + " = 1"},
        (
            '{at}/rig/dataset.toml: not valid TOML: it is nested too deeply.\n'
            '  fix: check that line: text wants quotes (name = "my-rig"), tables are written [[cameras]]'
        ),
    ),
    'toml utf16': (
        {"dataset.toml": TOML.encode("utf-16")},
        (
            '{at}/rig/dataset.toml, line 1: byte 0xff is not UTF-8 text.\n'
            '  fix: save the file as UTF-8'
        ),
    ),
    'toml latin-1': (
        {"dataset.toml": TOML.replace("rig", "r\u00eeg").encode("latin-1")},
        (
            '{at}/rig/dataset.toml, line 1: byte 0xee is not UTF-8 text.\n'
            '  fix: save the file as UTF-8'
        ),
    ),
    'toml CR': (
        {"dataset.toml": TOML.replace("\n", "\r")},
        (
            '{at}/rig/dataset.toml: not valid TOML: Expected newline or end of document after a statement (at line 1, column 13).\n'
            '  fix: check that line: text wants quotes (name = "my-rig"), tables are written [[cameras]]'
        ),
    ),
    'toml empty': (
        {"dataset.toml": ""},
        (
            "{at}/rig/dataset.toml: 'name' is missing.\n"
            '  fix: write the line name = "my-rig"'
        ),
    ),
    'toml NUL': (
        {"dataset.toml": "\0" * 100},
        (
            '{at}/rig/dataset.toml: not valid TOML: Invalid statement (at line 1, column 1).\n'
            '  fix: check that line: text wants quotes (name = "my-rig"), tables are written [[cameras]]'
        ),
    ),
    'old Mac': (
        {"observations.csv": VIEWS.replace("\n", "\r")},
        (
            '{at}/rig/observations.csv, line 1: the lines end as on old Macintosh computers (carriage return alone).\n'
            '  fix: save it as CSV UTF-8 with the line ends of Windows or Unix'
        ),
    ),
    'semicolons': (
        {"points.csv": POINTS.replace(",", ";")},
        (
            "{at}/rig/points.csv, line 1: the columns are separated by semicolons: 'point;shot;x;y;z;sd_x;sd_y;sd_z'.\n"
            '  why: implicam reads comma-separated tables with decimal points, so that 1,5 is never mistaken\n'
            "  fix: save as CSV with commas and decimal points (Excel: set the region to English, or pandas: read_csv(..., sep=';', decimal=',').to_csv(..., index=False))"
        ),
    ),
    'tabs': (
        {"points.csv": POINTS.replace(",", "\t")},
        (
            "{at}/rig/points.csv, line 1: the columns are separated by tabs: 'point\\tshot\\tx\\ty\\tz\\tsd_x\\tsd_y\\tsd_z'.\n"
            '  why: implicam reads comma-separated tables with decimal points, so that 1,5 is never mistaken\n'
            "  fix: save as CSV with commas and decimal points (Excel: set the region to English, or pandas: read_csv(..., sep='\\t', decimal=',').to_csv(..., index=False))"
        ),
    ),
    'utf16': (
        {"points.csv": POINTS.encode("utf-16")},
        (
            '{at}/rig/points.csv, line 1: the file is UTF-16 text.\n'
            '  fix: save it as CSV UTF-8'
        ),
    ),
    'utf16 no BOM': (
        {"points.csv": POINTS.encode("utf-16-le")},
        (
            '{at}/rig/points.csv, line 1: this is not a text table.\n'
            '  why: the line holds zero bytes\n'
            '  fix: export the data as comma-separated text (CSV, UTF-8)'
        ),
    ),
    'latin-1': (
        {"points.csv": POINTS.replace("p2", "p\u00b5").encode("latin-1")},
        (
            '{at}/rig/points.csv, line 3: byte 0xb5 is not UTF-8 text.\n'
            '  fix: save the file as CSV UTF-8'
        ),
    ),
    'empty': (
        {"points.csv": ""},
        (
            '{at}/rig/points.csv is empty.\n'
            '  fix: its first line must be point,shot,x,y,z, then one row per entry'
        ),
    ),
    'empty views': (
        {"observations.csv": "\n"},
        (
            '{at}/rig/observations.csv is empty.\n'
            '  fix: its first line must be point,camera,u,v, then one row per entry'
        ),
    ),
    'header only': (
        {"points.csv": "point,shot,x,y,z\n"},
        (
            '{at}/rig/points.csv has a header and no rows.\n'
            '  fix: add the known positions, or delete the file if they are unknown'
        ),
    ),
    'views header only': (
        {"observations.csv": "point,camera,u,v\n"},
        (
            '{at}/rig/observations.csv has a header and no rows.\n'
            '  fix: add one row per view: point,camera,u,v'
        ),
    ),
    'missing column': (
        put("points.csv", "point,shot,x,y,z", "point,shots,x,y,z"),
        (
            "{at}/rig/points.csv, line 1: the column 'shot' is missing; found 'point,shots,x,y,z,sd_x,sd_y,sd_z'.\n"
            "  why: 'shots' may be a misspelling of it\n"
            '  fix: the first line must name at least the columns point,shot,x,y,z'
        ),
    ),
    'duplicated column': (
        put("points.csv", "sd_x,sd_y,sd_z", "sd_x,sd_x,sd_z"),
        (
            "{at}/rig/points.csv, line 1: the column 'sd_x' is there 2 times.\n"
            '  fix: give every column a name of its own'
        ),
    ),
    'nameless column': (
        put("points.csv", "sd_x,sd_y,sd_z", "sd_x,,"),
        (
            "{at}/rig/points.csv, line 1: the column '' is there 2 times.\n"
            '  why: cells beyond the last name may be empty\n'
            '  fix: give every column a name of its own'
        ),
    ),
    'too few': (
        put("observations.csv", "50,60,,", "50,60"),
        (
            "{at}/rig/observations.csv, line 4: 4 cells, but the header names 6: 'p2,cam1,50,60'.\n"
            '  why: the row may be cut off\n'
            '  fix: give every column one cell; use decimal points'
        ),
    ),
    'too many': (
        put("observations.csv", "50,60,,", "50,60,,,"),
        (
            "{at}/rig/observations.csv, line 4: 7 cells, but the header names 6: 'p2,cam1,50,60,,,'.\n"
            '  why: a decimal comma splits a number in two\n'
            '  fix: give every column one cell; use decimal points'
        ),
    ),
    'unclosed quote': (
        put("observations.csv", "p1,cam2", '"p1,cam2'),
        (
            '{at}/rig/observations.csv, line 3: not a well-formed CSV row.\n'
            '  why: unexpected end of data\n'
            '  fix: write a cell that contains a comma or a quote as "...", with inner quotes doubled'
        ),
    ),
    'unclosed long quote': (
        {"observations.csv": VIEWS + '"p2,cam2' + ",1,2,,\n" * 50000},
        (
            '{at}/rig/observations.csv, line 5: not a well-formed CSV row.\n'
            '  why: field larger than field limit (131072)\n'
            '  fix: write a cell that contains a comma or a quote as "...", with inner quotes doubled'
        ),
    ),
    'text after quote': (
        put("observations.csv", "p1,cam2", '"p1"x,cam2'),
        (
            '{at}/rig/observations.csv, line 3: not a well-formed CSV row.\n'
            '  why: \',\' expected after \'"\'\n'
            '  fix: write a cell that contains a comma or a quote as "...", with inner quotes doubled'
        ),
    ),
    'NUL': (
        put("observations.csv", "50,60", "50,\0"),
        (
            '{at}/rig/observations.csv, line 4: this is not a text table.\n'
            '  why: the line holds zero bytes\n'
            '  fix: export the data as comma-separated text (CSV, UTF-8)'
        ),
    ),
    'long cell': (
        {"observations.csv": VIEWS.replace("sd_v", "sd_v,note").replace(",,\n", ",,,\n").replace(".1,.1\n", ".1,.1," + "x" * 2000 + "\n")},
        (
            "{at}/rig/observations.csv, line 2: a cell has 2000 characters: 'xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx'...\n"
            '  fix: shorten it to 1000 characters'
        ),
    ),
    'long name': (
        put("observations.csv", "p2,cam1", "p" * 300 + ",cam1"),
        (
            "{at}/rig/observations.csv, line 4: point 'pppppppppppppppppppppppppppppppppppppppppppppppppppppppppppp' is not usable.\n"
            '  why: names are printable text of at most 200 characters without spaces at either end\n'
            '  fix: rename it'
        ),
    ),
    'no toml': (
        {"dataset.toml": None},
        (
            '{at}/rig/dataset.toml does not exist.\n'
            '  why: {at}/rig holds: observations.csv, points.csv\n'
            '  fix: a dataset is a folder with dataset.toml, observations.csv and (unless it is to be measured) points.csv; see docs/formats.md'
        ),
    ),
    'no views': (
        {"observations.csv": None},
        (
            '{at}/rig/observations.csv does not exist.\n'
            '  why: {at}/rig holds: dataset.toml, points.csv\n'
            '  fix: put a comma-separated table with the columns point,camera,u,v there'
        ),
    ),
}  # fmt: skip

WIDE_MISTAKES: dict[str, tuple[str, str]] = {
    'no cameras': (
        "x,y,z,a\n1,2,3,4\n",
        (
            '{at}/w.csv, line 1: there are no camera columns.\n'
            '  fix: name them u_cam1,v_cam1,u_cam2,v_cam2, ...'
        ),
    ),
    'no heading': (
        "1,2,3,10,20\n1,2,4,11,21\n",
        (
            '{at}/w.csv, line 1: the first line holds numbers, and no names of columns.\n'
            '  fix: write x,y,z,u_cam1,v_cam1,u_cam2,v_cam2, ... as its first line'
        ),
    ),
    'half a camera': (
        "x,y,z,u_a,v_b\n1,2,3,4,5\n",
        (
            "{at}/w.csv, line 1: there is a column 'u_a' but no 'v_a' (did you mean 'v_b'?).\n"
            '  why: the pixels of a camera are a pair of columns, u_NAME and v_NAME\n'
            '  fix: correct the heading, add the other column, or give a column that is no pixel another name'
        ),
    ),
    'no z': (
        "x,y,u_a,v_a\n1,2,3,4\n",
        (
            '{at}/w.csv, line 1: x, y and z must all be there, or none.\n'
            "  why: found are 'x', 'y', and no 'z'\n"
            '  fix: add the missing column, or correct its heading'
        ),
    ),
    'half view': (
        WIDE.replace("10,20", "10,"),
        (
            "{at}/w.csv, line 2, camera 'cam1': u = 10, v = nan.\n"
            '  why: a view has both u and v, finite, or neither\n'
            '  fix: correct the value, or leave both u and v empty (NaN) where the view is missing'
        ),
    ),
    'no position': (
        WIDE.replace("4,5,6", "4,,6"),
        (
            "{at}/w.csv, line 3: point 'p2' has no known position.\n"
            '  fix: fill in x, y and z, remove the row, or leave the columns x, y, z out altogether to measure the points'
        ),
    ),
    'twice': (
        WIDE.replace("\np2", "\np1"),
        (
            "{at}/w.csv, line 3: point 'p1' is there twice (first at {at}/w.csv, line 2).\n"
            '  fix: remove one, or give each point a name of its own'
        ),
    ),
    'empty name': (
        WIDE.replace("\np2", "\n"),
        (
            "{at}/w.csv, line 3: point '' is not usable.\n"
            '  why: names are printable text of at most 200 characters without spaces at either end\n'
            '  fix: rename it'
        ),
    ),
    'sd zero': (
        WIDE.replace("20,.1", "20,0"),
        (
            "{at}/w.csv, line 2, camera 'cam1': sd_u = 0, sd_v = nan.\n"
            '  why: a standard uncertainty is greater than zero and finite\n'
            '  fix: correct the value, or leave it empty (NaN) where no uncertainty is stated'
        ),
    ),
    'sd negative': (
        WIDE.replace("3,.1", "3,-.1"),
        (
            '{at}/w.csv, line 2: sd_x = -0.1.\n'
            '  why: a standard uncertainty is at least zero and finite\n'
            '  fix: correct the value, or leave it empty (NaN) where no uncertainty is stated'
        ),
    ),
    'text': (
        WIDE.replace("4,5,6", "4,x,6"),
        (
            "{at}/w.csv, line 3: y = 'x' is not a number.\n"
            '  fix: correct the value or remove the row'
        ),
    ),
    'inf': (
        WIDE.replace("10,20", "10,inf"),
        (
            "{at}/w.csv, line 2: v_cam1 = 'inf' is not a finite number.\n"
            '  fix: leave the cell empty where there is no value'
        ),
    ),
    'comma': (
        WIDE.replace("4,5,6", '4,"5,5",6'),
        (
            "{at}/w.csv, lines 3 and 2: one number has a comma and one has a point: '5,5' and '.1'.\n"
            '  why: it cannot be told which is the decimal mark, and whether the other separates thousands\n'
            '  fix: write all numbers with decimal points, and without marks between thousands'
        ),
    ),
    'header only': (
        WIDE.splitlines()[0] + "\n",
        (
            '{at}/w.csv has a header and no rows.\n'
            '  fix: add one row per point'
        ),
    ),
    'empty': (
        "",
        (
            '{at}/w.csv is empty.\n'
            '  fix: its first line must be x,y,z,u_cam1,v_cam1,u_cam2,v_cam2, ..., then one row per entry'
        ),
    ),
    'camera twice': (
        WIDE.replace("sd_x", "u_cam1"),
        (
            "{at}/w.csv, line 1: the column 'u_cam1' is there 2 times.\n"
            '  fix: give every column a name of its own'
        ),
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_in_a_folder(mistake: str, tmp_path: Path) -> None:
    files, expected = MISTAKES[mistake]
    path = folder(tmp_path, files)
    with pytest.raises(DatasetError) as caught:
        read_dataset(path)
    assert str(caught.value).replace(str(tmp_path), "{at}") == expected


@pytest.mark.parametrize("mistake", WIDE_MISTAKES)
def test_mistakes_in_a_wide_table(mistake: str, tmp_path: Path) -> None:
    text, expected = WIDE_MISTAKES[mistake]
    path = wide(tmp_path, text)
    with pytest.raises(DatasetError) as caught:
        read_dataset(path, unit="mm")
    assert str(caught.value).replace(str(tmp_path), "{at}") == expected


PARQUET_MISTAKES: dict[str, tuple[str, Callable[[Any], Any], str]] = {
    "no description": ("x", lambda t: t.replace_schema_metadata({}), "the length unit of x, y, z is not stated"),
    "text": ("u_cam1", lambda t: t.set_column(0, "u_cam1", [["a", "b", "c"]]), "row 1: u_cam1 = 'a' is not a number"),
    "lists": (
        "u_cam1",
        lambda t: t.set_column(0, "u_cam1", [[[1.0], [2.0], [3.0]]]),
        "u_cam1 = '[1.0]' is not a number",
    ),
    "numbers as names": ("point", lambda t: t.set_column(0, "point", [[1, 2, 3]]), "row 1: point = '1' is not text"),
    "null names": ("point", lambda t: t.set_column(0, "point", [["a", None, "c"]]), "row 2: point '' is not usable"),
    "missing": ("x", lambda t: t.drop_columns(["u_cam1"]), "the column 'u_cam1' is missing"),
    "twice": ("x", lambda t: t.append_column("x", [[1.0, 2.0, 3.0]]), "the column 'x' is there 2 times"),
    "no z": ("x", lambda t: t.drop_columns(["z"]), "x, y and z must all be there"),
    "null x": ("x", lambda t: t.set_column(0, "x", [[1.0, None, 3.0]]), "row 2: point 'p2' has no known position"),
}


@pytest.mark.parametrize("mistake", PARQUET_MISTAKES)
def test_mistakes_in_parquet(mistake: str, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    data = simulated("stereo", points=3, seed=0)
    observations = Observations(np.array(["p1", "p2", "p3"]), data.cameras, data.observations.uv, data.observations.sd)
    known = KnownPositions(np.array(["s"] * 3), data.xyz, np.full((3, 3), np.nan))
    path = tmp_path / "rig.parquet"
    write_dataset(Dataset("a", "mm", observations, known), path)
    table = parquet.read_table(path)
    first, change, said = PARQUET_MISTAKES[mistake]
    parquet.write_table(change(table.select([first, *(n for n in table.column_names if n != first)])), path)
    with pytest.raises(DatasetError) as caught:
        read_dataset(path)
    assert said in str(caught.value)
    assert str(path) in str(caught.value)
