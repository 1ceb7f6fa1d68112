"""Datasets: no form loses anything, every mistake is named with file, line, value and cure, nothing hostile hurts."""

# ruff: noqa: E501  (errors are asserted with their whole text)

from __future__ import annotations

import datetime as dt
import difflib
import math
import os
import random
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from implicam.dataset import Camera, Dataset, KnownPositions, Observations, join, read_dataset, write_dataset
from implicam.dataset.marks import MARKS
from implicam.errors import DatasetError, ImplicamError
from implicam.files import left_behind, replacing_folder
from implicam.simulate import simulated

FORMS = {"folder": "rig", "csv": "rig.csv", "parquet": "rig.parquet", "npz": "rig.npz"}


def same_value(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same_value(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same_value, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return (math.isnan(a) and math.isnan(b)) or (a == b and math.copysign(1, a) == math.copysign(1, b))
    return type(a) is type(b) and bool(a == b)


def same_numbers(a: np.ndarray, b: np.ndarray) -> bool:
    return np.array_equal(a, b, equal_nan=True) and bool((np.signbit(a) == np.signbit(b))[~np.isnan(a)].all())


def same_columns(a: Any, b: Any) -> bool:
    return set(a) == set(b) and all(np.array_equal(a[key], b[key]) for key in a)


def assert_same(a: Dataset, b: Dataset) -> None:
    assert (a.name, a.length_unit) == (b.name, b.length_unit)
    assert same_value(sort_tables_last(a.extra), sort_tables_last(b.extra))
    assert a.points.tolist() == b.points.tolist()
    assert [(c.name, c.width, c.height) for c in a.cameras] == [(c.name, c.width, c.height) for c in b.cameras]
    assert all(
        same_value(sort_tables_last(c.extra), sort_tables_last(d.extra))
        for c, d in zip(a.cameras, b.cameras, strict=True)
    )
    assert same_numbers(a.observations.uv, b.observations.uv)
    assert same_numbers(a.observations.sd, b.observations.sd)
    assert same_columns(a.observations.extra, b.observations.extra)
    assert (a.known is None) == (b.known is None)
    if a.known and b.known:
        assert a.known.shots.tolist() == b.known.shots.tolist()
        assert same_numbers(a.known.xyz, b.known.xyz)
        assert same_numbers(a.known.sd, b.known.sd)
        assert same_columns(a.known.extra, b.known.extra)


def sort_tables_last(value: Any) -> Any:
    """The order of keys in a TOML table has no meaning."""
    if isinstance(value, list):
        return [sort_tables_last(item) for item in value]
    return {k: sort_tables_last(value[k]) for k in sorted(value)} if isinstance(value, dict) else value


# --- any legal dataset ---------------------------------------------------------------------------------------------

NASTY = [
    "p,1",
    'say "hi"',
    "a;b",
    "#p1",
    "µ→点",
    "nan",
    "1.5",
    "u_cam1",
    "sd_u",
    "e\u0301",
    "'",
    "=1+1",
    "x",
    "a  b",
    "-",
]
letters = st.characters(exclude_categories=("C", "Z"))
names = st.sampled_from(NASTY) | st.text(letters | st.just(" "), min_size=1, max_size=8).filter(
    lambda s: s == s.strip() and s.isprintable()
)
camera_names = names.filter(lambda s: not set("/\\") & set(s) and not s.startswith("."))
texts = st.sampled_from(["", " ", "a\nb", "a\r\nb", "\r", '"', ",", " x ", "nan", "\t", "\ufeff"]) | st.text(
    st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=6
)
sizes = st.none() | st.integers(1, 5000)
toml_values = st.recursive(
    texts | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats() | st.dates() | st.times() | st.datetimes()
    | st.datetimes(timezones=st.builds(lambda m: dt.timezone(dt.timedelta(minutes=m)), st.integers(-1000, 1000))),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=5,
)  # fmt: skip


def extra_entries(taken: tuple[str, ...]) -> st.SearchStrategy[dict[str, Any]]:
    def allowed(key: str) -> bool:
        return key not in taken and not difflib.get_close_matches(key, ["width", "height"])

    return st.dictionaries(texts.filter(allowed), toml_values, max_size=3)


@st.composite
def datasets(draw: Any) -> Dataset:
    cameras = tuple(
        Camera(name, draw(sizes), draw(sizes), draw(extra_entries(("name", "width", "height"))))
        for name in draw(st.lists(camera_names, min_size=1, max_size=3, unique=True))
    )
    points = draw(st.lists(names, min_size=1, max_size=5, unique=True))
    n, c = len(points), len(cameras)
    uv, sd = np.full((n, c, 2), np.nan), np.full((n, c, 2), np.nan)
    stated = draw(st.booleans())
    for i in range(n):
        for k, camera in enumerate(cameras):
            if draw(st.integers(0, 3)):
                whole = camera.width is not None and camera.height is not None
                for axis, size in enumerate((camera.width, camera.height)):
                    uv[i, k, axis] = draw(
                        st.floats(-0.5, size - 0.5) if whole else st.floats(allow_nan=False, allow_infinity=False)
                    )
                if tuple(uv[i, k]) in MARKS:  # would be read as a missing view
                    uv[i, k] += 0.25
                if stated:
                    sd[i, k] = [draw(st.just(np.nan) | st.floats(1e-300, 1e300)) for _ in range(2)]
    seen = ~np.isnan(uv[..., 0])
    view_names = names.filter(lambda s: s not in ("point", "camera", "u", "v", "sd_u", "sd_v"))
    anywhere = draw(st.booleans())  # also text about views that are missing
    view_extra = {
        key: np.array([[draw(texts) if seen[i, k] or anywhere else "" for k in range(c)] for i in range(n)], np.str_)
        for key in draw(st.lists(view_names, max_size=2, unique=True))
    }
    known = None
    if draw(st.booleans()):
        finite = st.floats(allow_nan=False, allow_infinity=False)
        point_names = names.filter(lambda s: s not in ("point", "shot", "x", "y", "z", "sd_x", "sd_y", "sd_z"))
        sds = st.just(math.nan) | st.floats(0, 1e300)
        known = KnownPositions(
            np.array([draw(names) for _ in points], np.str_),
            np.array([[draw(finite) for _ in "xyz"] for _ in points]),
            np.array([[draw(sds) for _ in "xyz"] if draw(st.booleans()) else [math.nan] * 3 for _ in points]),
            {
                key: np.array([draw(texts) for _ in points], np.str_)
                for key in draw(st.lists(point_names, max_size=2, unique=True))
            },
        )
    observations = Observations(np.array(points, np.str_), cameras, uv, sd, view_extra)
    extra = draw(extra_entries(("name", "length_unit", "cameras", "wide_table")))
    return Dataset(draw(names), draw(names), observations, known, extra)


def refused_for(data: Dataset, form: str) -> str:
    """What a form may say it cannot hold; nothing where it must hold the dataset."""
    seen = data.observations.seen
    if form == "folder":
        if not seen.any():
            return "has no view at all"
        if data.known is None and not seen.any(axis=1).all():
            return "was seen by no camera"
        if any(((text != "") & ~seen).any() for text in data.observations.extra.values()):
            return "of a view that is missing"
    clash = bool(data.observations.extra or (data.known and data.known.extra))
    return "could be mistaken" if form in ("csv", "parquet") and clash else ""


@pytest.mark.parametrize("form", FORMS)
def test_every_form_keeps_everything(form: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    @settings(max_examples=120, deadline=None, suppress_health_check=list(HealthCheck))
    @given(datasets())
    def check(data: Dataset) -> None:
        path = tmp_path_factory.mktemp("d") / FORMS[form]
        may_refuse = refused_for(data, form)
        refusal = None
        try:
            write_dataset(data, path)
        except DatasetError as error:
            refusal = error
        if refusal is None:
            assert form != "folder" or not may_refuse
            assert_same(data, read_dataset(path))
        else:
            assert may_refuse, str(refusal)
            assert may_refuse in str(refusal)
            assert refusal.fix
            assert not path.exists()

    check()


def test_forms_keep_a_simulated_dataset_and_each_other(tmp_path: Path) -> None:
    data = simulated("stereo", points=12, seed=1)
    for form, name in FORMS.items():
        write_dataset(data, tmp_path / name)
        data = read_dataset(tmp_path / name)
        assert_same(data, simulated("stereo", points=12, seed=1))
        assert data.truth is not None, form


def test_the_same_dataset_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("rig.csv", "rig.npz"):
        write_dataset(simulated("stereo", points=5, seed=1), tmp_path / name)
        first = (tmp_path / name).read_bytes()
        write_dataset(simulated("stereo", points=5, seed=1), tmp_path / name)
        assert (tmp_path / name).read_bytes() == first


def test_wide_csv_without_description(tmp_path: Path) -> None:
    path = tmp_path / "w.csv"
    path.write_text("x,y,z,u_a,v_a,u_b,v_b,note\n1,2,3,4,5,,,hello\n4,5,6,nan,NaN,7,8,\n")
    data = read_dataset(path, unit="mm")
    assert data.name == "w"
    assert data.points.tolist() == ["p0001", "p0002"]
    assert data.observations.seen.tolist() == [[True, False], [False, True]]
    assert data.positions.extra["note"].tolist() == ["hello", ""]
    with pytest.raises(DatasetError, match="length unit of x, y, z is not stated"):
        read_dataset(path)


def test_a_wide_csv_leaves_other_toml_files_alone(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text("[project]\n")
    write_dataset(simulated("stereo", points=3, seed=0), tmp_path / "pyproject.csv")
    assert (tmp_path / "pyproject.toml").read_text() == "[project]\n"
    assert (tmp_path / "pyproject.csv.toml").exists()


def test_a_unit_that_contradicts_the_data_is_refused(tmp_path: Path) -> None:
    write_dataset(simulated("stereo", points=3, seed=0), tmp_path / "rig.npz")
    assert read_dataset(tmp_path / "rig.npz", unit="mm").length_unit == "mm"
    with pytest.raises(DatasetError, match="is in 'mm', not in 'm'"):
        read_dataset(tmp_path / "rig.npz", unit="m")


# --- the values check themselves -----------------------------------------------------------------------------------


def tiny(**changes: Any) -> Dataset:
    """Two cameras, two points."""
    camera = changes.pop("camera", {})
    uv = changes.pop("uv", [[[1, 2], [3, 4]], [[5, 6], [np.nan, np.nan]]])
    observations = Observations(
        np.array(changes.pop("points", ["p1", "p2"])),
        (Camera(**{"name": "a", "width": 100, "height": 80, **camera}), Camera("b")),
        np.array(uv, dtype=float),
        np.array(changes.pop("sd", np.full((2, 2, 2), np.nan))),
        changes.pop("view_extra", {}),
    )
    known = KnownPositions(np.array(["s", "s"]), [[0, 0, 0], [1, 1, 1]], np.full((2, 3), np.nan), changes.pop("pe", {}))
    return Dataset(**{"name": "rig", "length_unit": "mm", "observations": observations, "known": known, **changes})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"camera": {"extra": {"note": None}}}, "a value of type NoneType has no form in TOML"),
        ({"camera": {"extra": {"a": {"b": [object()]}}}}, "a value of type object has no form in TOML"),
        ({"camera": {"extra": {"a": {1: 2}}}}, "the keys of a table are text"),
        ({"camera": {"extra": {"width": 3}}}, "an extra entry cannot be named 'width'"),
        ({"camera": {"width": 10**7}}, "has width = 10000000; it must be a whole number of pixels"),
        ({"camera": {"width": np.float64(3)}}, "it must be a whole number of pixels"),
        ({"camera": {"height": None, "extra": {"heigth": 3}}}, "'heigth' may be a misspelling of it"),
        ({"camera": {"name": "../a"}}, "cannot name a folder"),
        ({"extra": {"cameras": []}}, "an extra entry cannot be named 'cameras'"),
        ({"extra": {"a": 2**63}}, "more than 64 bits"),
        ({"extra": {"a": "\ud800"}}, "surrogates not allowed"),
        ({"name": " rig"}, "dataset name ' rig' is not usable"),
        ({"name": "x" * 201}, "at most 200 characters"),
        ({"length_unit": "m\nm"}, "length unit"),
        ({"points": ["p1", "p1"]}, "point 'p1' is there twice"),
        ({"points": ["p1", ""]}, "point '' is not usable"),
        ({"points": ["p1", "a\nb"]}, "is not usable"),
        ({"uv": [[[1, 2], [3, 4]], [[5, np.nan], [1, 1]]]}, "point 'p2', camera 'a': u = 5, v = nan"),
        ({"uv": [[[1, 2], [3, np.inf]], [[5, 6], [1, 1]]]}, "point 'p1', camera 'b': u = 3, v = inf"),
        ({"uv": [[[1, 2], [3, 4]], [[500, 6], [1, 1]]]}, "point 'p2', camera 'a': pixel u = 500, v = 6 is far outside"),
        ({"uv": [[1, 2], [3, 4]]}, "uv has the shape"),
        ({"sd": np.zeros((2, 2, 2))}, "point 'p1', camera 'a': sd_u = 0, sd_v = 0"),
        ({"view_extra": {"u": [["", ""], ["", ""]]}}, "an extra column cannot be named 'u'"),
        ({"view_extra": {"": [["", ""], ["", ""]]}}, "column name '' is not usable"),
        ({"view_extra": {"n": ["", ""]}}, "a text column has the shape"),
        ({"pe": {"n": ["x" * 1001, ""]}}, "the column 'n' holds something else than text"),
        ({"pe": {"n": ["\ud800", ""]}}, "the column 'n' holds something else than text"),
        ({"pe": {"n": ["a\0b", ""]}}, "the column 'n' holds something else than text"),
        ({"pe": {"sd_x": ["", ""]}}, "an extra column cannot be named 'sd_x'"),
    ],
)
def test_illegal_values_are_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(DatasetError) as caught:
        tiny(**changes)
    assert said in str(caught.value)


def test_what_toml_cannot_hold_is_said_when_written(tmp_path: Path) -> None:
    odd = dt.datetime(2024, 1, 1, tzinfo=dt.timezone(dt.timedelta(seconds=30)))
    for extra in ({"when": odd}, {"text": "x" * 600_000}):
        with pytest.raises(DatasetError, match="the description of dataset 'rig' cannot be written"):
            write_dataset(tiny(extra=extra), tmp_path / "rig")


def test_values_are_copies_and_read_only() -> None:
    uv = np.zeros((1, 1, 2))
    note = {"k": [1]}
    observations = Observations(np.array(["p"]), (Camera("a", extra=note),), uv, np.full((1, 1, 2), np.nan))
    uv[:] = 5
    note["k"].append(2)
    assert not observations.uv.any()
    assert observations.cameras[0].extra == {"k": [1]}
    with pytest.raises(ValueError, match="read-only"):
        observations.uv[0] = 1


def test_sd_of_a_missing_view_is_not_kept() -> None:
    assert np.isnan(tiny(sd=np.ones((2, 2, 2))).observations.sd[1, 1]).all()


# --- split, folds, shots, cameras, join ----------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 30), st.data())
def test_splits_are_partitions(n: int, data: Any) -> None:
    whole = numbered(n)
    m, seed = data.draw(st.integers(1, n - 1)), data.draw(st.integers(0, 99))
    some, rest = whole.split(m, seed=seed)
    assert (len(some), len(rest)) == (m, n - m)
    assert sorted([*some.points, *rest.points]) == sorted(whole.points)
    assert whole.split(m, seed=seed)[0].points.tolist() == some.points.tolist()
    k = data.draw(st.integers(2, n))
    held: list[str] = []
    for name, others, fold in whole.folds(k, seed=seed):
        assert n // k <= len(fold) <= -(-n // k)
        assert sorted([*others.points, *fold.points]) == sorted(whole.points), name
        held += fold.points.tolist()
    assert sorted(held) == sorted(whole.points)


def numbered(n: int) -> Dataset:
    points = np.array([f"p{i:03d}" for i in range(n)])
    uv = np.arange(4.0 * n).reshape(n, 2, 2)
    known = KnownPositions(np.array([f"s{i % 3}" for i in range(n)]), np.ones((n, 3)), np.full((n, 3), np.nan))
    return Dataset("n", "mm", Observations(points, (Camera("a"), Camera("b")), uv, np.full(uv.shape, np.nan)), known)


def test_seeds_matter() -> None:
    whole = numbered(30)
    assert whole.split(10, seed=0)[0].points.tolist() != whole.split(10, seed=1)[0].points.tolist()
    folds = [[fold.points.tolist() for _, _, fold in whole.folds(3, seed=seed)] for seed in (0, 0, 1)]
    assert folds[0] == folds[1] != folds[2]


def test_shots_are_left_out_whole() -> None:
    whole = numbered(10)
    held = list(whole.leave_out_shots())
    assert [name for name, _, _ in held] == ["s0", "s1", "s2"]
    for name, others, shot in held:
        assert set(shot.shots) == {name}
        assert name not in others.shots
        assert len(others) + len(shot) == 10


def test_select_and_cameras() -> None:
    whole = numbered(4)
    assert whole.select([2, 0]).points.tolist() == ["p002", "p000"]
    assert len(whole.select([])) == len(whole.select(np.zeros(4, dtype=bool))) == 0
    turned = whole.with_cameras(["b", "a"])
    assert np.array_equal(turned.observations.uv, whole.observations.uv[:, ::-1])
    assert whole.without(["a"]).observations.camera_names == ("b",)
    with pytest.raises(DatasetError, match="'p001' is there twice"):
        whole.select([1, 1])


@pytest.mark.parametrize(
    ("do", "said"),
    [
        (lambda d: d.split(0, seed=0), "cannot split 4 points into 0 and the rest"),
        (lambda d: d.split(4, seed=0), "choose a number from 1 to 3"),
        (lambda d: list(d.folds(1, seed=0)), "choose a number from 2 to 4"),
        (lambda d: list(d.folds(5, seed=0)), "cannot make 5 folds of 4 points"),
        (lambda d: list(d.select([0]).leave_out_shots()), "has one shot only"),
        (lambda d: d.with_cameras(["A"]), "there is no camera 'A'"),
        (lambda d: d.without(["c"]), "the cameras are a, b"),
        (lambda d: d.without(["a", "b"]), "there is no camera"),
        (lambda d: d.with_cameras(["a", "a"]), "camera 'a' is there twice"),
        (lambda d: join(d, d), "point 'p000' is there twice"),
        (lambda d: join(d, d.with_cameras(["a"])), "do not belong to one rig"),
        (lambda d: join(d, Dataset("n", "m", d.observations, d.known)), "do not belong to one rig"),
        (lambda d: join(d, Dataset("n", "mm", d.observations)), "the other has none"),
        (lambda d: Dataset("n", "mm", d.observations).xyz, "has no known positions"),
        (lambda d: Dataset("n", "mm", d.observations, d.select([0]).known), "4 observed points, but 1 known"),
        (lambda d: Dataset("n", "mmm", d.observations).metres_per_unit, "did you mean 'mm'?"),
    ],
)
def test_errors_of_splits_and_joins(do: Callable[[Dataset], Any], said: str) -> None:
    with pytest.raises(DatasetError) as caught:
        do(numbered(4))
    assert said in str(caught.value)


def test_join_keeps_all_columns() -> None:
    first, second = tiny(view_extra={"n": [["1", "2"], ["3", ""]]}, pe={"k": ["x", "y"]}), tiny(points=["q1", "q2"])
    both = join(first, second)
    assert both.points.tolist() == ["p1", "p2", "q1", "q2"]
    assert both.observations.extra["n"].tolist() == [["1", "2"], ["3", ""], ["", ""], ["", ""]]
    assert both.positions.extra["k"].tolist() == ["x", "y", "", ""]


# --- mistakes ------------------------------------------------------------------------------------------------------

TOML = """name = "rig"
length_unit = "mm"

[[cameras]]
name = "cam1"
width = 640
height = 480

[[cameras]]
name = "cam2"
width = 640
height = 480
"""
POINTS = "point,shot,x,y,z,sd_x,sd_y,sd_z\np1,s1,1,2,3,.1,.1,0\np2,s1,4,5,6,,,\n"
VIEWS = "point,camera,u,v,sd_u,sd_v\np1,cam1,10,20,.1,.1\np1,cam2,30,40,,\np2,cam1,50,60,,\n"
WIDE = "point,x,y,z,sd_x,u_cam1,v_cam1,sd_u_cam1\np1,1,2,3,.1,10,20,.1\np2,4,5,6,,,,\n"
FILES = {"dataset.toml": TOML, "points.csv": POINTS, "observations.csv": VIEWS}


def folder(tmp_path: Path, files: dict[str, str | bytes | None] | None = None) -> Path:
    path = tmp_path / "rig"
    path.mkdir(parents=True, exist_ok=True)
    for name, content in {**FILES, **(files or {})}.items():
        if content is not None:
            (path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def test_the_valid_files_are_valid(tmp_path: Path) -> None:
    assert len(read_dataset(folder(tmp_path))) == 2


def wide(tmp_path: Path, content: str) -> Path:
    path = tmp_path / "w.csv"
    path.write_text(content)
    return path


def put(name: str, old: str, new: str) -> dict[str, str | bytes | None]:
    assert FILES[name].count(old) == 1, (name, old)
    return {name: FILES[name].replace(old, new)}


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
            "{at}/rig/observations.csv, line 3: point 'p1' is seen twice by camera 'cam1' (first on line 2).\n"
            '  fix: keep one of the two rows'
        ),
    ),
    'duplicate point': (
        put("points.csv", "\np2,s1", "\np1,s1"),
        (
            "{at}/rig/points.csv, line 3: point 'p1' is there twice (first on line 2).\n"
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
            "{at}/rig/observations.csv, line 4: u = 'nan' is not a finite number.\n"
            '  fix: leave both u and v empty where the view is missing, or remove the row'
        ),
    ),
    'far outside': (
        put("observations.csv", "50,60", "50,-60"),
        (
            "{at}/rig/observations.csv, line 4: pixel u = 50, v = -60 is far outside the 640 x 480 image of 'cam1'.\n"
            '  why: u is the column and v the row, counted from 0 at the centre of the top-left pixel\n'
            '  fix: correct the value, remove the row, or correct width and height in dataset.toml'
        ),
    ),
    'far outside 2': (
        put("observations.csv", "50,60", "1e4,60"),
        (
            "{at}/rig/observations.csv, line 4: pixel u = 10000, v = 60 is far outside the 640 x 480 image of 'cam1'.\n"
            '  why: u is the column and v the row, counted from 0 at the centre of the top-left pixel\n'
            '  fix: correct the value, remove the row, or correct width and height in dataset.toml'
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
            "{at}/rig/observations.csv, line 4: v = '' is not a number.\n"
            '  why: the cell is empty\n'
            '  fix: leave both u and v empty where the view is missing, or remove the row'
        ),
    ),
    'negative sd': (
        put("points.csv", ".1,.1,0", ".1,-.1,0"),
        (
            "{at}/rig/points.csv, line 2: sd_y = '-.1' must be at least zero.\n"
            '  why: it is a standard uncertainty\n'
            '  fix: leave the cell empty where no uncertainty is stated'
        ),
    ),
    'zero sd_u': (
        put("observations.csv", "10,20,.1,.1", "10,20,0,.1"),
        (
            "{at}/rig/observations.csv, line 2: sd_u = '0' must be greater than zero.\n"
            '  why: it is a standard uncertainty\n'
            '  fix: leave the cell empty where no uncertainty is stated'
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
            "{at}/rig/observations.csv, line 4: point '' is not a name.\n"
            '  fix: every row needs a printable point name of at most 200 characters'
        ),
    ),
    'unprintable shot': (
        put("points.csv", "p2,s1", "p2,s\u200b1"),
        (
            "{at}/rig/points.csv, line 3: shot 's\\u200b1' is not a name.\n"
            '  fix: every row needs a printable shot name of at most 200 characters'
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
            "{at}/rig/dataset.toml: camera 'cam1' is there 2 times.\n"
            '  fix: give each camera a name of its own'
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
            "{at}/rig/observations.csv, line 4: point 'pppppppppppppppppppppppppppppppppppppppppppppppppppppppppppp' is not a name.\n"
            '  fix: every row needs a printable point name of at most 200 characters'
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
            '  fix: add the missing column'
        ),
    ),
    'half view': (
        WIDE.replace("10,20", "10,"),
        (
            '{at}/w.csv, line 2: only one of u_cam1 and v_cam1 is there.\n'
            '  fix: a missing view leaves both empty'
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
            "{at}/w.csv, line 3: point '' is not a name.\n"
            '  fix: every row needs a printable point name of at most 200 characters'
        ),
    ),
    'sd zero': (
        WIDE.replace("20,.1", "20,0"),
        (
            '{at}/w.csv, line 2: sd_u_cam1 and sd_v_cam1 must be greater than zero.\n'
            '  why: they are standard uncertainties\n'
            '  fix: leave the cell empty where no uncertainty is stated'
        ),
    ),
    'sd negative': (
        WIDE.replace("3,.1", "3,-.1"),
        (
            '{at}/w.csv, line 2: sd_x = -0.1 must be at least zero.\n'
            '  why: it is a standard uncertainty\n'
            '  fix: leave the cell empty where no uncertainty is stated'
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
            "{at}/w.csv, line 3: y = '5,5' is not a number.\n"
            '  why: it has a decimal comma\n'
            '  fix: write it with a decimal point'
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
    'semicolons': (
        WIDE.replace(",", ";"),
        (
            "{at}/w.csv, line 1: the columns are separated by semicolons: 'point;x;y;z;sd_x;u_cam1;v_cam1;sd_u_cam1'.\n"
            '  why: implicam reads comma-separated tables with decimal points, so that 1,5 is never mistaken\n'
            "  fix: save as CSV with commas and decimal points (Excel: set the region to English, or pandas: read_csv(..., sep=';', decimal=',').to_csv(..., index=False))"
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
    "no description": ("x", lambda t: t.replace_schema_metadata({}), "carries no implicam description"),
    "text": ("u_cam1", lambda t: t.set_column(0, "u_cam1", [["a", "b", "c"]]), "row 1: u_cam1 = 'a' is not a number"),
    "lists": (
        "u_cam1",
        lambda t: t.set_column(0, "u_cam1", [[[1.0], [2.0], [3.0]]]),
        "u_cam1 = '[1.0]' is not a number",
    ),
    "numbers as names": ("point", lambda t: t.set_column(0, "point", [[1, 2, 3]]), "row 1: point = '1' is not text"),
    "null names": ("point", lambda t: t.set_column(0, "point", [["a", None, "c"]]), "row 2: point '' is not a name"),
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


@pytest.mark.parametrize("name", ["dataset.toml", "points.csv", "observations.csv"])
def test_a_folder_in_the_place_of_a_file(name: str, tmp_path: Path) -> None:
    path = folder(tmp_path, {name: None})
    (path / name).mkdir()
    with pytest.raises(DatasetError) as caught:
        read_dataset(path)
    assert caught.value.what == f"{path / name} is a folder, not a file."


@pytest.mark.parametrize("name", ["w.csv", "w.parquet", "w.npz", "w"])
def test_an_empty_folder_named_like_a_file(name: str, tmp_path: Path) -> None:
    (tmp_path / name).mkdir()
    with pytest.raises(DatasetError, match=r"dataset\.toml does not exist"):
        read_dataset(tmp_path / name)


def test_a_wide_table_that_names_an_unknown_camera(tmp_path: Path) -> None:
    write_dataset(numbered(3), tmp_path / "w.csv")
    text = (tmp_path / "w.csv").read_text().replace("u_b,v_b", "u_b,v_b,u_bb,v_bb").replace("\n", ",1,2\n")
    (tmp_path / "w.csv").write_text(text.replace("v_bb,1,2", "v_bb"))
    with pytest.raises(DatasetError, match="the columns u_bb and v_bb belong to no camera"):
        read_dataset(tmp_path / "w.csv")


GIGABYTE = 1 << 30


def endless(path: Path) -> None:
    """One line of a gigabyte, cheap to make: a hole would be zeros."""
    with path.open("wb") as file:
        file.write(b"1," * (1 << 19))
        file.truncate(GIGABYTE)


def zeros(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(GIGABYTE)


def header_then_zeros(path: Path) -> None:
    header = {"observations.csv": VIEWS, "points.csv": POINTS, "dataset.toml": TOML, "w.csv": WIDE}
    start = header.get(path.name, "").encode() or {"w.npz": b"PK\x03\x04", "w.parquet": b"PAR1"}[path.name]
    with path.open("wb") as file:
        file.write(start)
        file.truncate(GIGABYTE)


@pytest.mark.skipif(os.name != "posix", reason="needs sparse files")
@pytest.mark.parametrize("make", [zeros, header_then_zeros, endless])
@pytest.mark.parametrize("name", ["observations.csv", "points.csv", "dataset.toml", "w.csv", "w.npz", "w.parquet"])
def test_a_gigabyte_of_something_else(name: str, make: Callable[[Path], None], tmp_path: Path) -> None:
    path = folder(tmp_path) if name in FILES else tmp_path
    make(path / name)
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError, match=name):
            read_dataset(path if name in FILES else path / name, unit="mm")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
        (path / name).unlink()
    assert peak < 10 << 20


# --- writing -------------------------------------------------------------------------------------------------------


def test_writing_over_something(tmp_path: Path) -> None:
    data = numbered(3)
    write_dataset(data, tmp_path / "rig")
    with pytest.raises(ImplicamError, match="already exists"):
        write_dataset(data, tmp_path / "rig")
    write_dataset(numbered(4), tmp_path / "rig", overwrite=True)
    assert len(read_dataset(tmp_path / "rig")) == 4
    (tmp_path / "rig" / "images").mkdir()
    with pytest.raises(DatasetError, match="photographs cannot be computed again"):
        write_dataset(data, tmp_path / "rig", overwrite=True)
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.tex").write_text("years of work")
    with pytest.raises(DatasetError, match="is not a dataset, so it is not overwritten"):
        write_dataset(data, tmp_path / "thesis", overwrite=True)
    (tmp_path / "file").write_text("x")
    with pytest.raises(ImplicamError, match="is a file, not a folder"):
        write_dataset(data, tmp_path / "file", overwrite=True)
    for name in ("dir.csv", "dir.npz", "dir.parquet"):
        (tmp_path / name).mkdir()
        with pytest.raises(ImplicamError, match="cannot write"):
            write_dataset(data, tmp_path / name)
    (tmp_path / "empty").mkdir()
    write_dataset(data, tmp_path / "empty")
    assert sorted(p.name for p in tmp_path.iterdir() if "partial" in p.name) == []


def test_a_link_to_a_dataset_stays_a_link(tmp_path: Path) -> None:
    write_dataset(numbered(3), tmp_path / "real")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write_dataset(numbered(5), tmp_path / "link", overwrite=True)
    assert (tmp_path / "link").is_symlink()
    assert len(read_dataset(tmp_path / "real")) == 5
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "real"]


def test_a_failed_swap_keeps_the_old_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_dataset(numbered(3), tmp_path / "rig")
    monkeypatch.setattr("implicam.files._exchanged", lambda a, b: False)  # a system that cannot swap in one step
    rename = Path.rename

    def fail(self: Path, target: Path) -> Path:
        if ".old" not in self.name and target == tmp_path / "rig":
            raise OSError(28, "No space left on device")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(ImplicamError, match=r"cannot write .*rig\.\n  why: .*No space"):
        write_dataset(numbered(4), tmp_path / "rig", overwrite=True)
    monkeypatch.undo()
    assert len(read_dataset(tmp_path / "rig")) == 3
    assert [p.name for p in tmp_path.iterdir()] == ["rig"]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux swaps two folders in one step")
def test_a_folder_is_swapped_in_one_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rig").mkdir()
    (tmp_path / "rig" / "old").touch()
    monkeypatch.setattr(Path, "rename", lambda a, b: pytest.fail("the folder is gone between two renames"))
    with replacing_folder(tmp_path / "rig", overwrite=True) as folder:
        (folder / "new").touch()
    assert [entry.name for entry in (tmp_path / "rig").iterdir()] == ["new"]
    assert [entry.name for entry in tmp_path.iterdir()] == ["rig"]


def test_a_kill_between_the_renames_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kill runs no `except`: as if every later file operation did nothing."""
    write_dataset(numbered(3), tmp_path / "rig")
    monkeypatch.setattr("implicam.files._exchanged", lambda a, b: False)  # a system that cannot swap in one step
    rename = Path.rename
    monkeypatch.setattr(Path, "rename", lambda a, b: rename(a, b) if b.name.endswith(".old") else a)
    monkeypatch.setattr("shutil.rmtree", lambda *_, **__: None)
    write_dataset(numbered(4), tmp_path / "rig", overwrite=True)
    monkeypatch.undo()
    old = left_behind(tmp_path / "rig")
    assert old is not None
    assert len(read_dataset(old)) == 3
    with pytest.raises(DatasetError) as caught:
        read_dataset(tmp_path / "rig")
    assert caught.value.fix == f"rename {old} to rig"
    assert caught.value.why == "a program was killed while replacing it"


def test_an_error_while_writing_leaves_nothing(tmp_path: Path) -> None:
    def fail_half_way() -> None:
        with replacing_folder(tmp_path / "new") as temporary:
            (temporary / "half").write_text("x")
            raise KeyError

    with pytest.raises(KeyError):
        fail_half_way()
    assert list(tmp_path.iterdir()) == []


def test_no_points_and_no_views(tmp_path: Path) -> None:
    nothing = numbered(3).select([])
    for name in ("rig", "rig.csv", "rig.parquet"):
        with pytest.raises(DatasetError, match=r"has no (view at all|points)"):
            write_dataset(nothing, tmp_path / name)
    write_dataset(nothing, tmp_path / "rig.npz")
    assert_same(nothing, read_dataset(tmp_path / "rig.npz"))


# --- fuzz ----------------------------------------------------------------------------------------------------------

SPICE = [
    b",",
    b'"',
    b"\n",
    b"\r",
    b"\0",
    b"\xff",
    b"nan",
    b"1e999",
    b"-",
    b"\xef\xbb\xbf",
    b";",
    b"[[",
    b"]]",
    b"=",
    b"9" * 40,
]


def mutated(content: bytes, rng: random.Random) -> bytes:
    """A few random changes: flips, cuts, insertions, repetitions, swaps."""
    data = bytearray(content)
    for _ in range(rng.choice([1, 1, 1, 2, 5])):
        i, j = sorted((rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)))
        match rng.randrange(7):
            case 0 if data:
                data[min(i, len(data) - 1)] ^= 1 << rng.randrange(8)
            case 1:
                del data[i : i + rng.choice([1, 2, 20])]
            case 2:
                data[i:i] = rng.choice(SPICE)
            case 3:
                data[i:i] = rng.randbytes(rng.choice([1, 4, 30]))
            case 4:
                data[i:i] = data[i : min(j, i + 50)]
            case 5:
                del data[i:]
            case 6:
                data[i:j] = bytes(reversed(data[i:j]))
    return bytes(data)


@pytest.mark.parametrize("form", FORMS)
def test_fuzz(form: str, tmp_path: Path) -> None:
    """Whatever is done to the bytes: a valid dataset, or an error that names the file. Never anything else."""
    data = simulated("stereo", points=3, seed=0)
    path = tmp_path / FORMS[form]
    write_dataset(data, path)
    files = sorted(path.iterdir()) if path.is_dir() else sorted(tmp_path.iterdir())
    originals = {file: file.read_bytes() for file in files}
    rng = random.Random(f"fuzz {form}")
    refused = 0
    for _ in range(1200):
        file = rng.choice(files)
        content = mutated(originals[file], rng)
        file.write_bytes(content)
        said = ""
        try:
            assert isinstance(read_dataset(path), Dataset)
        except ImplicamError as error:
            refused += 1
            said = error.what
        assert not said or path.name in said, (said, content)
        file.write_bytes(originals[file])
    assert refused > 300
