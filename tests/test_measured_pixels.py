"""Arrays in, arrays out: what `measure_pixels` finds is what `measure` finds of the same pixels."""

from __future__ import annotations

import numpy as np
import pytest

import implicam as ic
from forward_gp_cases import fitted, rig
from implicam.errors import UsageError
from implicam.rig_model.reasons import Reason
from implicam.simulate import random_positions, simulate


def pixels(n: int = 40) -> np.ndarray:
    """Of the rig of `fitted`: a third of the views missing, one point with one view, one with none, some wrong ones."""
    uv = simulate(rig(), random_positions(rig(), n, np.random.default_rng(5)), seed=6).observations.uv.copy()
    uv[np.random.default_rng(7).random(uv.shape[:2]) < 0.3] = np.nan
    uv[0], uv[1, 1:] = np.nan, np.nan
    uv[2:4] = simulate(rig(), random_positions(rig(), 2, np.random.default_rng(8)), seed=6).observations.uv
    uv[2, 0] += 40
    uv[3, :2] += 60
    return uv


def test_it_is_what_measure_finds() -> None:
    made, uv = fitted(), pixels()
    measured = made.measure(ic.Dataset.from_arrays(uv, cameras=list(made.trained.cameras)))
    found = made.measure_pixels(uv, exact=True)
    np.testing.assert_array_equal(found.xyz, measured.xyz)
    np.testing.assert_allclose(found.cov, measured.cov, rtol=1e-12)
    np.testing.assert_array_equal(found.consistency, measured.consistency)
    np.testing.assert_array_equal(found.views, measured.views)
    np.testing.assert_array_equal(found.measured, measured.measured)
    np.testing.assert_allclose(found.sd, measured.sd, rtol=1e-12)
    assert found.reason.tolist() == measured.own_reason.tolist()
    assert found.alarm == measured.alarm
    assert {Reason.NOT_SEEN_BY_CALIBRATED, Reason.NOT_SEEN} & set(found.code.tolist())
    assert found.code[1] == Reason.ONE_VIEW
    assert found.left_out[2].tolist() == [True, False, False, False]
    assert f"measured without {made.camera_names[0]}" in found.reason[2]


@pytest.mark.parametrize("noise", [0.5, np.full(4, 0.5), np.full((40, 4), 0.5)])
def test_noise_is_stated_as_of_views(noise: object) -> None:
    made, uv = fitted(), pixels()
    names = list(made.trained.cameras)
    expected = made.measure(ic.Dataset.from_arrays(uv, sd=0.5, cameras=names))
    np.testing.assert_allclose(made.measure_pixels(uv, noise, exact=True).cov, expected.cov, rtol=1e-9)  # type: ignore[arg-type]
    assert np.nanmax(made.measure_pixels(uv, exact=True).sd) != np.nanmax(expected.sd)


@pytest.mark.parametrize(("uv", "noise"), [(np.zeros((3, 2, 2)), None), (np.zeros((4, 2)), None), (pixels(4), [1, 2])])
def test_arrays_of_another_shape_are_refused(uv: np.ndarray, noise: object) -> None:
    with pytest.raises(UsageError):
        fitted().measure_pixels(uv, noise)  # type: ignore[arg-type]


def test_pixels_that_no_camera_has_are_no_position_and_no_warning() -> None:
    made, uv = fitted(), pixels()
    uv[4], uv[5, 0, 0], uv[6], uv[7] = 1e300, np.inf, -np.inf, -1e300
    found = made.measure_pixels(uv)
    assert not found.measured[[4, 6, 7]].any()
    assert found.reason[6] == "no camera saw it"
    assert not found.seen[5, 0]


def test_explicit_has_it_too() -> None:
    data = ic.simulated("stereo", points=40, seed=1)
    made = ic.Explicit().fit(data)
    assert made.measure_pixels(data.observations.uv).measured.all()
