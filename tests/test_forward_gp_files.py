"""forward-gp: shots that contradict each other, and what a calibration file carries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import block_diag

from forward_gp_cases import (
    declared_fit,
    design,
    dots_fit,
    fitted,
    joint_covariance,
    known,
    numeric,
    rig,
    with_positions,
)
from implicam.calibrators import ForwardGP, ForwardGPCalibration, load_calibration
from implicam.errors import FitError, UsageError
from implicam.rig_model.triangulate import locate
from implicam.simulate import build_rig, moving_board, random_positions, simulate


@cache
def board_fit() -> tuple[ForwardGPCalibration, float]:
    """A moving board whose fourth position is labelled 1 mm too far along the slide."""
    two = rig("2R")
    data = simulate(two, moving_board(two, corners=(4, 5), positions=7, step=30.0, square=25.0), seed=71)
    xyz = data.xyz.copy()
    moved = 1.0
    xyz[data.shots == "board04"] += moved * two.volume.world_from_box.rotation[:, 2]
    return ForwardGP().fit(with_positions(data, xyz)), moved


def test_a_shot_that_is_off_is_found_and_noted() -> None:
    calibration, moved = board_fit()
    displacement = calibration.posterior.displacement
    assert displacement is not None
    of_shot = displacement[calibration.data.shots == "board04"].mean(axis=0) * calibration.frame.scale
    axis = rig("2R").volume.world_from_box.rotation[:, 2]
    # of a shift of the middle one of seven a parabola hides a third: sum of the smooth patterns' squares there
    t = np.linspace(-1, 1, 7)
    q, _ = np.linalg.qr(np.vander(t, 3))
    assert of_shot @ axis == pytest.approx(-moved * (1 - np.sum(q[3] ** 2)), abs=0.15)
    assert np.linalg.norm(of_shot - (of_shot @ axis) * axis) < 0.1
    assert any("The shots contradict each other" in note for note in calibration.notes)
    assert not calibration.rejected


def test_between_shots_that_contradict_the_error_bars_are_wider() -> None:
    calibration, _ = board_fit()
    two = rig("2R")
    target = moving_board(two, corners=(4, 5), positions=13, step=15.0, square=25.0)  # every other one is between
    data = simulate(two, target, seed=72)
    measured = calibration.measure(data.observations)
    axis = two.volume.world_from_box.rotation[:, 2]
    number = np.array([int(shot[5:7]) for shot in data.shots])
    inside = (number > 2) & (number < 12)

    def wider(cov: np.ndarray) -> float:
        sd = np.sqrt(np.einsum("i,nij,j->n", axis, cov, axis))
        return float(sd[inside & (number % 2 == 0)].mean() / sd[inside & (number % 2 == 1)].mean())

    assert wider(measured.cov) > 1.15  # what the world is there: the parabola of its shots
    # whoever judges by a known position there must add its own error
    assert wider(measured.cov + calibration.known_position_covariance(data.xyz)) > 1.3


@cache
def unlensed_fit() -> ForwardGPCalibration:
    return ForwardGP(lens="none").fit(known())


def test_positions_are_measured_in_the_world_as_labelled() -> None:
    calibration, moved = board_fit()
    data = calibration.data
    measured = calibration.measure(data.observations)
    axis = rig("2R").volume.world_from_box.rotation[:, 2]
    off = (measured.xyz - data.xyz) @ axis
    for shot in np.unique(data.shots):
        assert abs(off[data.shots == shot].mean()) < 0.15 * moved


def test_the_covariance_of_a_labelled_position_is_that_of_a_difference() -> None:
    """Of a position and of the error of a label, whose uncertainties the cameras tie together: dense matrices."""
    calibration, _ = board_fit()
    posterior, labels = calibration.posterior, calibration._labels
    assert labels is not None
    assert posterior.joint is not None
    some = np.arange(0, 140, 23)
    uv = calibration.data.observations.uv[some]
    noise = np.array([[model.noise for model in posterior.models]] * len(some))
    bare, labelled = locate(posterior, uv, noise), locate(posterior, uv, noise, labels)
    assert labels.unknowns is not None
    known, unknown = labels.shots.label_slope(bare.xyz, labels.sd), labels.world(bare.xyz)
    np.testing.assert_allclose(labelled.xyz, bare.xyz - known @ labels.unknowns.mean, atol=1e-12)
    cross = posterior.joint.T @ labels.unknowns.cross
    for i, x in enumerate(bare.xyz):

        def pixels(d: np.ndarray, x: np.ndarray = x) -> np.ndarray:
            return np.concatenate([model.predict((x + d)[None])[0][0] for model in posterior.models])

        D, wide = numeric(pixels, np.full(3, 1e-5)), block_diag(*(design(m, x[None])[0] for m in posterior.models))
        gain = bare.cov[i] @ D.T @ np.linalg.inv(joint_covariance(posterior, x, noise[i]))
        tied = gain @ wide @ cross @ known[i].T
        own = known[i] @ labels.unknowns.covariance @ known[i].T
        expected = own + tied + tied.T + unknown[i]
        assert np.abs(tied).max() > 1e-3 * np.abs(own).max()  # small here, so it is compared for itself
        np.testing.assert_allclose(labelled.cov[i] - bare.cov[i], expected, atol=0.05 * np.abs(tied).max())


SAVED: dict[str, Callable[[], ForwardGPCalibration]] = {
    "exact positions": fitted,
    "declared noise": declared_fit,
    "estimated shots": lambda: board_fit()[0],
    "dots off": lambda: dots_fit(),
    "no lens": lambda: unlensed_fit(),
}


every_saved = pytest.mark.parametrize("kind", SAVED)


@every_saved
def test_a_saved_calibration_measures_the_same_bits(kind: str, tmp_path: Path) -> None:
    calibration = SAVED[kind]()
    calibration.save(tmp_path / "rig.implicam")
    loaded = load_calibration(tmp_path / "rig.implicam")
    assert isinstance(loaded, ForwardGPCalibration)
    observations = calibration.data.observations.select(np.arange(0, len(calibration.data), 3))
    a, b = calibration.measure(observations), loaded.measure(observations)
    assert a.measured.any()
    for name in ("xyz", "cov", "views", "consistency", "reason"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    exact = ("exact positions", "no lens")
    missing = {"joint": (*exact, "dots off"), "displacement": exact}
    missing["ties"] = tuple(name for name in SAVED if name != "dots off")
    for name in ("joint", "displacement", "ties"):
        x, y = getattr(calibration.posterior, name), getattr(loaded.posterior, name)
        assert (x is None) == (y is None) == (kind in missing[name])
        if x is not None:
            np.testing.assert_array_equal(x, y)
    assert (loaded.posterior.unknowns is not None) == (kind == "estimated shots")
    assert loaded.notes == calibration.notes
    assert loaded.residuals == calibration.residuals
    assert loaded.rejected == calibration.rejected
    assert loaded.unused == calibration.unused


MAY_BE_MISSING = ("joint", "displacement", "shots/mean", "untold_sd")
"""As a whole: each takes the others with it."""


@every_saved
def test_a_state_that_does_not_fit_is_refused(kind: str) -> None:
    calibration = SAVED[kind]()
    table, arrays = calibration.state()
    ForwardGPCalibration.from_state(calibration.data, table, arrays)
    refused = (KeyError, ValueError, TypeError)  # as in Calibration.from_state
    accepted = []

    def attempt(what: str, changed: dict[str, np.ndarray]) -> None:
        try:
            ForwardGPCalibration.from_state(calibration.data, table, changed)
        except refused:
            return
        accepted.append(what)

    for name, array in arrays.items():
        if name not in MAY_BE_MISSING:
            attempt(f"{name} dropped", {key: value for key, value in arrays.items() if key != name})
        attempt(f"{name} longer", arrays | {name: np.concatenate([array, array[-1:]])})
        attempt(f"{name} shorter", arrays | {name: array[:-1]})
        attempt(f"{name} deeper", arrays | {name: array[..., None]})
        attempt(f"{name} a number", arrays | {name: np.array(1.0)})
        if array.dtype == np.float64:
            for value in (np.nan, np.inf):
                spoilt = array.copy()
                spoilt.flat[spoilt.size // 2] = value
                attempt(f"{name} with {value}", arrays | {name: spoilt})
            attempt(f"{name} as float32", arrays | {name: array.astype(np.float32)})
        else:
            attempt(f"{name} as numbers", arrays | {name: array.astype(np.float64)})
    assert accepted == []


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("declared noise", "joint"),
        ("declared noise", "displacement"),
        ("estimated shots", "joint"),
        ("estimated shots", "displacement"),
        ("estimated shots", "shots/mean"),
        ("dots off", "ties"),
        ("dots off", "displacement"),
        ("dots off", "labels/size"),
    ],
)
def test_a_state_with_half_of_what_ties_the_cameras_is_refused(kind: str, name: str) -> None:
    calibration = SAVED[kind]()
    table, arrays = calibration.state()
    with pytest.raises((KeyError, ValueError, TypeError)):
        ForwardGPCalibration.from_state(
            calibration.data, table, {key: value for key, value in arrays.items() if key != name}
        )


def test_a_table_that_does_not_fit_is_refused() -> None:
    table, arrays = fitted().state()
    wrong = [
        {"lens": "fisheye"},
        {"seed": "x"},
        {"calibrated": table["calibrated"][:1]},
        {"calibrated": table["calibrated"][:3]},
        {"calibrated": [*table["calibrated"][:3], "another"]},
        {"calibrated": table["calibrated"][:3], "not_calibrated": {"cam2": "why"}},
        {"calibrated": 3},
    ]
    for change in wrong:
        with pytest.raises((KeyError, ValueError, TypeError, UsageError)):
            ForwardGPCalibration.from_state(fitted().data, table | change, arrays)
    younger = {"settings", "wand", "wand_sd", "wand_jitter", "wand_ends", "scale_bars"}
    for key in table.keys() - younger:  # files from before there were settings, or wands, have none
        with pytest.raises(KeyError):
            ForwardGPCalibration.from_state(fitted().data, {k: v for k, v in table.items() if k != key}, arrays)


def test_what_is_said_of_one_camera_and_of_points_on_an_axis() -> None:
    """More points are no cure for one camera, and other y alone would leave the points on a plane."""
    rig = build_rig("bar3", seed=1)
    data = simulate(rig, random_positions(rig, 20, np.random.default_rng(1)), seed=1)
    with pytest.raises(FitError, match="use two cameras or more"):
        ForwardGP().fit(data.with_cameras(data.observations.camera_names[:1]))
    assert data.known is not None
    flat = replace(data, known=replace(data.known, xyz=data.xyz * [1.0, 0.0, 0.0]))
    with pytest.raises(FitError, match="same y = 0, z = 0") as told:
        ForwardGP().fit(flat)
    assert "add points with other y and z" in str(told.value)
