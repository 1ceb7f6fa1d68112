"""Rows and cameras that are there twice, and marks for missing views that look like pixels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import implicam as ic
from implicam.dataset import Dataset, KnownPositions, Observations, describe_copies, find_copies, remove_copies
from implicam.errors import DatasetError
from implicam.simulate import ball_grid, build_rig, random_positions, simulate

CASES = Path(__file__).parent / "data" / "cases"


def rig(points: int = 20, cameras: str = "2R2W", seed: int = 1) -> Dataset:
    return ic.simulated("bar6", points=points, seed=seed, cameras=cameras)


def twice(data: Dataset, times: int = 2) -> Dataset:
    """The rows over again under other names."""
    again = np.tile(np.arange(len(data)), times)
    names = np.array([f"p{i}" for i in range(len(again))])
    o, k = data.observations, data.positions
    extra = {key: text[again] for key, text in o.extra.items()}
    observations = Observations(names, o.cameras, o.uv[again], o.sd[again], extra)
    known = KnownPositions(names, k.xyz[again], k.sd[again], {key: text[again] for key, text in k.extra.items()})
    return Dataset(data.name, data.length_unit, observations, known)


def with_pixels(data: Dataset, uv: np.ndarray) -> Dataset:
    return replace(data, observations=replace(data.observations, uv=uv))


# --- copies --------------------------------------------------------------------------------------------------------


def test_rows_joined_twice_are_one_and_said() -> None:
    data = ic.read_dataset(CASES / "rows-copied" / "known.csv")
    assert find_copies(data).points.sum() == 48
    assert len(remove_copies(data)) == 12
    (note,) = describe_copies(data)
    assert note.startswith("48 of 60 known points are copies of others")


@pytest.mark.slow
@pytest.mark.parametrize("method", [ic.ForwardGP(), ic.Explicit(), ic.InverseGP()])
def test_a_fit_uses_each_row_once(method: ic.ForwardGP | ic.Explicit | ic.InverseGP, tmp_path: Path) -> None:
    once = rig()
    data = twice(once)
    one, copied = method.fit(once), method.fit(data)
    assert copied.data is data
    assert copied.residuals["points_used"] == 20
    assert len(copied.unused) == 20
    assert "copies of others" in " ".join(copied.notes)
    new = rig(40, seed=1).observations
    a, b = one.measure(new), copied.measure(new)
    np.testing.assert_allclose(a.xyz, b.xyz, rtol=1e-9)
    np.testing.assert_allclose(a.cov, b.cov, rtol=1e-6)
    copied.save(tmp_path / "c.implicam")
    again = ic.load_calibration(tmp_path / "c.implicam")
    assert len(again.data) == 40
    np.testing.assert_allclose(again.measure(new).xyz, b.xyz, rtol=1e-9)


def test_the_case_of_rows_copied_is_measured_honestly() -> None:
    data = ic.read_dataset(CASES / "rows-copied" / "known.csv")
    judged = ic.evaluate(ic.ForwardGP().fit(data), ic.read_dataset(CASES / "rows-copied" / "new.csv"))
    assert judged.coverage.overall.level(0.95).ellipsoid.value >= 0.9  # 0.34 where copies counted
    assert judged.coverage.overall.rmse < 0.6


@pytest.mark.slow
def test_copies_are_not_counted_when_held_out() -> None:
    data = ic.read_dataset(CASES / "rows-copied" / "known.csv")
    judged = ic.cross_validate(ic.ForwardGP().fit, data, 4)
    assert judged.coverage.overall.n == 12
    assert judged.coverage.overall.rmse > 0.1  # 0.0000006 mm where they did
    assert "48 points are copies" in judged.how


def test_cameras_copied_are_one_and_named() -> None:
    data = ic.read_dataset(CASES / "cameras-copied" / "known.csv")
    names = np.array(data.observations.camera_names)
    assert list(names[~find_copies(data).cameras]) == ["k0", "k3", "k6", "k9"]
    calibration = ic.ForwardGP().fit(data)
    assert calibration.camera_names == ("k0", "k3", "k6", "k9")
    assert any("k1" in note and "those of k0" in note for note in calibration.notes)
    assert calibration.data.observations.camera_names == tuple(names)


@pytest.mark.slow
@pytest.mark.parametrize("method", [ic.Explicit(), ic.InverseGP()])
def test_other_methods_use_a_copied_camera_once(method: ic.Explicit | ic.InverseGP, tmp_path: Path) -> None:
    data = ic.read_dataset(CASES / "cameras-copied" / "known.csv")
    calibration, once = method.fit(data), method.fit(data.with_cameras(["k0", "k3", "k6", "k9"]))
    calibration.save(tmp_path / "c.implicam")
    again = ic.load_calibration(tmp_path / "c.implicam")
    assert "those of k0" in " ".join(again.notes)
    for other in (calibration, again):
        np.testing.assert_allclose(other.measure(data.observations).cov, once.measure(data.observations).cov, rtol=1e-6)


def test_the_copy_with_more_views_stays() -> None:
    data = rig(12, "2R")
    o = data.observations
    uv = np.concatenate([o.uv, o.uv[:, :1]], axis=1)
    uv[3:5, 0] = np.nan
    cameras = (*o.cameras, replace(o.cameras[0], name="again"))
    three = Observations(o.points, cameras, uv, np.full(uv.shape, np.nan))
    copies = find_copies(replace(data, observations=three))
    assert copies.cameras.tolist() == [True, False, False]
    assert copies.camera_of[0] == 2


@pytest.mark.parametrize("spec", ["stereo", "bar12", "dome8"])
def test_ordinary_rigs_without_noise_have_no_copies(spec: str) -> None:
    built = build_rig(spec, seed=2, noise=0.0, lens_error=0.0)
    for target in (ball_grid(built), random_positions(built, 60, np.random.default_rng(0))):
        data = simulate(built, target, seed=1, missing=0.3)
        assert remove_copies(data) is data


def test_whole_number_pixels_of_one_camera_are_no_copies() -> None:
    """A point at one known position seen twice by one camera: nothing proves that it is the same row."""
    data = twice(rig(30))
    uv = np.round(data.observations.uv)
    uv[30:, 1:] = np.nan
    uv[:30, 0] = np.where(np.arange(30)[:, None] < 15, uv[:30, 0], np.nan)
    assert not find_copies(with_pixels(data, uv)).points.any()


def test_points_seen_by_nobody_are_no_copies() -> None:
    data = twice(rig(10))
    assert not find_copies(with_pixels(data, np.full(data.observations.uv.shape, np.nan))).points.any()


def test_nothing_is_a_copy_where_positions_are_not_known() -> None:
    data = twice(rig(10))
    assert not find_copies(replace(data, known=None)).points.any()


# --- marks ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mark", ["-1,-1", "0,0", "-999,-999", "9999,9999"])
def test_marks_for_missing_views_are_none(mark: str, tmp_path: Path) -> None:
    clean = (CASES / "spreadsheets" / "known.csv").read_text()
    path = tmp_path / "marked.csv"
    path.write_text("\n".join(_marked(line, mark) for line in clean.splitlines()))
    data, right = ic.read_dataset(path, unit="m"), ic.read_dataset(CASES / "spreadsheets" / "known.csv", unit="m")
    np.testing.assert_array_equal(data.observations.uv, right.observations.uv)
    (note,) = data.notes
    u = mark.split(",")[0]
    missing = int((~right.observations.seen).sum())
    assert note.startswith(f"The pixel ({u}, {u}) occurs {missing} times (cam1, ")
    assert right.notes == ()
    assert data.select(np.arange(20)).notes == data.notes


def _marked(line: str, mark: str) -> str:
    cells = line.split(",")
    for i in range(4, len(cells), 2):
        if cells[i] == "":
            cells[i : i + 2] = mark.split(",")
    return ",".join(cells)


def test_a_detector_that_always_finds_one_spot_is_said(tmp_path: Path) -> None:
    data = rig(30)
    uv = data.observations.uv.copy()
    uv[::3, 1] = [317.25, 88.5]
    ic.write_dataset(with_pixels(data, uv), tmp_path / "d")
    found = ic.read_dataset(tmp_path / "d")
    assert "(317.25, 88.5) occurs 10 times (cam3)" in found.notes[0]
    assert found.observations.seen[:, 1].sum() == 20


def test_a_point_at_rest_is_no_mark(tmp_path: Path) -> None:
    data = rig(1)
    many = twice(data, 40)
    ic.write_dataset(replace(with_pixels(many, np.round(many.observations.uv)), known=None), tmp_path / "d.csv")
    found = ic.read_dataset(tmp_path / "d.csv")
    assert found.notes == ()
    assert found.observations.seen.all()


def test_rows_without_pixels_in_a_folder_are_missing_views(tmp_path: Path) -> None:
    ic.write_dataset(rig(10), tmp_path / "d")
    views = tmp_path / "d" / "observations.csv"
    head, first, second, *rest = views.read_text().splitlines()
    cells = [line.split(",") for line in (first, second)]
    cells[0][2:4], cells[1][2:4] = ["", ""], ["NaN", "nan"]
    views.write_text("\n".join([head, *(",".join(row) for row in cells), *rest]))
    found = ic.read_dataset(tmp_path / "d")
    assert found.notes == ("2 rows of observations.csv have no pixels: views that are missing.",)
    assert (~found.observations.seen).sum() == 2


@pytest.mark.parametrize("column", ["u_cam2", "v_cam2"])
def test_a_camera_does_not_vanish_for_a_typo(column: str, tmp_path: Path) -> None:
    path = tmp_path / "typo.csv"
    path.write_text((CASES / "spreadsheets" / "known.csv").read_text().replace(column, column + "x"))
    with pytest.raises(DatasetError, match=r"no 'v_cam2x?' \(did you mean '(v_cam2x?)'\?\)"):
        ic.read_dataset(path, unit="m")


def test_a_header_of_many_columns_is_read_in_linear_time(tmp_path: Path) -> None:
    """Where it is quadratic it takes longer than conftest.py lets a test take."""
    ic.write_dataset(rig(5), tmp_path / "d")
    path = tmp_path / "d" / "points.csv"
    lines = path.read_text().splitlines()
    wide = [lines[0] + "".join(f",c{i}" for i in range(30_000)), *(line + ",1" * 30_000 for line in lines[1:])]
    path.write_text("\n".join(wide))
    assert len(ic.read_dataset(tmp_path / "d").positions.extra) > 29_999
