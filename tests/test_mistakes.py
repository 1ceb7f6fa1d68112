"""Mistakes with known points that the numbers give away: named, and never where there are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import implicam as ic
from implicam.dataset import Dataset, Floats
from implicam.errors import FitError
from implicam.mistakes import find_mistakes
from implicam.row_order import shift_rows
from implicam.simulate import ball_grid, build_rig, random_positions, simulate
from implicam.verdict import _of_data


def known(spec: str = "bar3", points: int = 30, seed: int = 3, **how: float) -> Dataset:
    built = build_rig(spec, seed=seed)
    return simulate(built, random_positions(built, points, np.random.default_rng(seed)), seed=seed, **how)


def lattice(spec: str = "bar3") -> Dataset:
    built = build_rig(spec, seed=4)
    return simulate(built, ball_grid(built, (4, 3, 3)), seed=4)


def at(data: Dataset, xyz: Floats) -> Dataset:
    return replace(data, known=replace(data.positions, xyz=xyz))


def with_column(data: Dataset, camera: int, uv: Floats) -> Dataset:
    pixels = data.observations.uv.copy()
    pixels[:, camera] = uv
    return replace(data, observations=replace(data.observations, uv=pixels))


@pytest.mark.parametrize("spec", ["stereo", "bar3", "dome8"])
@pytest.mark.parametrize("points", [12, 40, 150])
def test_right_points_have_none(spec: str, points: int) -> None:
    for seed in range(5):
        assert find_mistakes(known(spec, points, seed, missing=0.2, outliers=0.03, robot_noise=0.2)) == []


def test_a_place_that_is_gone_back_to_is_no_other_unit() -> None:
    """A robot that returns to the origin of its world, whose readings differ by a thousandth of the volume."""
    data = known(points=40)
    xyz, uv = data.xyz - data.xyz[0], data.observations.uv.copy()
    xyz[:8] = np.random.default_rng(0).normal(scale=0.03, size=(8, 3))
    uv[:8] = uv[0] + np.random.default_rng(1).normal(scale=0.2, size=uv[:8].shape)
    assert not any("unit" in one.reason for one in find_mistakes(at(with_pixels(data, uv), xyz)))


def with_pixels(data: Dataset, uv: Floats) -> Dataset:
    return replace(data, observations=replace(data.observations, uv=uv))


@pytest.mark.parametrize("factor", [1000.0, 100.0, 25.4])
@pytest.mark.parametrize("many", [3, 15, 26])
def test_points_in_another_unit_are_named(factor: float, many: int) -> None:
    data = known()
    xyz = data.xyz.copy()
    xyz[:many] /= factor
    (found,) = find_mistakes(at(data, xyz))
    assert found.grave
    assert f"{many} of 30 known positions" in found.reason
    assert f"times {factor:g}" in found.reason


@pytest.mark.parametrize("data", [known(), known("stereo", 13), lattice()])
@pytest.mark.parametrize(("rows", "said"), [(1, "1 row early"), (-1, "1 row late"), (-2, "2 rows late")])
def test_positions_in_another_order_are_named(data: Dataset, rows: int, said: str) -> None:
    (found,) = find_mistakes(at(data, np.roll(data.xyz, rows, axis=0)))
    assert found.grave
    assert "in another order than the views" in found.reason
    assert said in found.reason


def test_rows_from_the_last_to_the_first_are_named() -> None:
    data = known()
    (found,) = find_mistakes(at(data, data.xyz[::-1].copy()))
    assert "from the last row to the first" in found.reason


def test_one_camera_late_is_named() -> None:
    data = known()
    (found,) = find_mistakes(with_column(data, 1, np.roll(data.observations.uv[:, 1], 1, axis=0)))
    assert not found.grave
    assert found.reason.startswith("cam2: its pixels are 1 row late: put right they fit to")


@pytest.mark.slow
@pytest.mark.parametrize("method", [ic.ForwardGP, ic.Explicit])
def test_a_fit_that_fails_says_why(method: type[ic.ForwardGP] | type[ic.Explicit]) -> None:
    data = known()
    with pytest.raises(FitError, match="in another order than the views"):
        method().fit(at(data, np.roll(data.xyz, 1, axis=0)))


@pytest.mark.slow
@pytest.mark.parametrize("method", [ic.ForwardGP, ic.Explicit])
def test_a_fit_that_fails_says_it_once(method: type[ic.ForwardGP] | type[ic.Explicit]) -> None:
    data = known("stereo", 30)
    with pytest.raises(FitError) as error:
        method().fit(with_column(data, 1, np.roll(data.observations.uv[:, 1], 1, axis=0)))
    assert str(error.value).count("1 row late") == 1


def test_half_in_metres_is_not_usable() -> None:
    data = known("stereo", 40)
    xyz = data.xyz.copy()
    xyz[:20] /= 1000
    (said, *_) = [one for one in _of_data(at(data, xyz)) if one.grave]
    assert "in another unit" in said.reason


@pytest.mark.parametrize("rows", [-3, -1, 0, 2, 5])
def test_rows_are_moved_up_whatever_their_number(rows: int) -> None:
    for n in range(4):
        values = np.arange(2.0 * n).reshape(n, 2)
        expected = [values[i + rows] if 0 <= i + rows < n else np.full(2, np.nan) for i in range(n)]
        assert np.array_equal(shift_rows(values, rows), np.array(expected).reshape(n, 2), equal_nan=True)
