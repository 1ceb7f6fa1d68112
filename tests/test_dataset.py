"""Datasets: no form loses anything, every mistake is named with file, line, value and cure, nothing hostile hurts."""

from __future__ import annotations

import datetime as dt
import difflib
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dataset_files import FORMS, assert_same, numbered
from implicam.dataset import Camera, Dataset, KnownPositions, Observations, join, read_dataset, write_dataset
from implicam.dataset.marks import MISSING_VIEW_PIXELS
from implicam.errors import DatasetError, ImplicamError
from implicam.files import find_left_behind, replacing_folder
from implicam.simulate import simulated

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
                if tuple(uv[i, k]) in MISSING_VIEW_PIXELS:  # would be read as a missing view
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


@pytest.mark.slow
def test_every_form_keeps_everything(tmp_path_factory: pytest.TempPathFactory) -> None:
    """One draw serves all forms: to draw a dataset costs more than to write and read it."""

    @settings(max_examples=120, deadline=None, suppress_health_check=list(HealthCheck))
    @given(datasets())
    def check(data: Dataset) -> None:
        for form, name in FORMS.items():
            check_form(data, form, tmp_path_factory.mktemp("d") / name)

    check()


def check_form(data: Dataset, form: str, path: Path) -> None:
    may_refuse = refused_for(data, form)
    refusal = None
    try:
        write_dataset(data, path)
    except DatasetError as error:
        refusal = error
    if refusal is None:
        assert form != "folder" or not may_refuse, form
        assert_same(data, read_dataset(path))
    else:
        assert may_refuse, f"{form}: {refusal}"
        assert may_refuse in str(refusal)
        assert refusal.fix
        assert not path.exists()


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


def test_pixels_alone_need_no_unit(tmp_path: Path) -> None:
    (tmp_path / "new.csv").write_text("u_a,v_a,u_b,v_b\n1,2,3,4\n")
    data = read_dataset(tmp_path / "new.csv")
    assert data.length_unit == "unknown"
    for name in ("out.csv", "out.npz", "out"):
        write_dataset(data, tmp_path / name)
        assert read_dataset(tmp_path / name).length_unit == "unknown"
        assert read_dataset(tmp_path / name, unit="m").length_unit == "m"


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
        with pytest.raises(ImplicamError, match="is a folder, and a file is to be written"):
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
    old = find_left_behind(tmp_path / "rig")
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
