"""What settings of forward-gp and of the rig model do; test_settings_contract.py has what holds for every method."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from forward_gp_cases import IMAGE, fitted, known, rig, rotation, with_positions
from implicam.calibrators import ForwardGP, ForwardGPCalibration, ForwardGPSettings
from implicam.dataset import Dataset
from implicam.errors import UsageError
from implicam.geometry import Pose
from implicam.lenses import KannalaBrandt
from implicam.rig_model.camera import CentralCamera, ProjectiveCamera
from implicam.rig_model.level_errors import find_levels
from implicam.rig_model.settings import RigModelSettings
from implicam.rig_model.shot_errors import Shots
from implicam.settings import BELOW_ONE
from implicam.simulate import moving_board, random_positions, simulate

FIELDS = {field.name: field for field in fields(ForwardGPSettings)}


def other(name: str) -> Any:
    """Another value of a setting."""
    default = FIELDS[name].default
    if isinstance(default, tuple):
        return tuple(1.1 * value if not name.endswith(BELOW_ONE) else 0.9 * value for value in default)
    return default + 1 if isinstance(default, int) else 0.9 * default


def test_settings_are_shown_as_they_would_be_written() -> None:
    shown = repr(ForwardGP(settings=ForwardGPSettings(max_rounds=9, min_lengthscale=(1.0, 0.2))))
    assert shown.endswith("settings=ForwardGPSettings(min_lengthscale=(1.0, 0.2), max_rounds=9))")
    assert repr(RigModelSettings()) == "RigModelSettings()"


@cache
def with_wrong_views() -> Dataset:
    return simulate(rig(), random_positions(rig(), 60, np.random.default_rng(5)), seed=6, outliers=0.05)


@cache
def plates() -> Dataset:
    """A moving board whose fourth position is labelled 1 mm too far along the slide."""
    data = simulate(rig("2R"), moving_board(rig("2R"), corners=(4, 5), positions=7, step=30.0, square=25.0), seed=71)
    xyz = data.xyz.copy()
    xyz[data.shots == "board04"] += rig("2R").volume.world_from_box.rotation[:, 2]
    return with_positions(data, xyz)


@cache
def two_plates() -> Dataset:
    return simulate(rig("2R"), moving_board(rig("2R"), corners=(4, 5), positions=2, step=90.0, square=25.0), seed=71)


@cache
def dots() -> Dataset:
    data = known(120)
    return with_positions(data, data.xyz + np.random.default_rng(3).standard_t(3, size=data.xyz.shape) * 0.3)


@cache
def default_fit(data: str) -> ForwardGPCalibration:
    return ForwardGP().fit(DATA[data]())


DATA = {
    "points": known,
    "wrong views": with_wrong_views,
    "plates": plates,
    "two plates": two_plates,
    "dots": dots,
}
CHANGES: list[tuple[str, dict[str, Any]]] = [
    ("wrong views", {"max_squared_mahalanobis": 6.0}),
    ("points", {"typical_log_distance_sd": 1.0}),
    ("points", {"ordinary_kind": (0.05, 0.01, 0.01, 0.2, 1.0)}),
    ("points", {"rho_prior_sd_per_wf": 0.1}),
    ("points", {"distortion_prior_sd": (1e-3, 1e-3, 1e-3, 1e-3)}),
    ("points", {"lengthscale_prior_median": (3.0, 6.0)}),
    ("points", {"min_lengthscale": (5.0, 5.0)}),
    ("points", {"signal_prior_median_half_sides": 5e-3}),
    ("points", {"camera_noise_log_sd": 1.0}),
    ("points", {"max_points_for_sizes": 20}),
    ("plates", {"max_rounds_with_shots": 2}),
    ("plates", {"shot_sd_prior_median_wf": 3e-2}),
    ("plates", {"initial_shot_sd_wf": 2e-2, "max_rounds_with_shots": 1}),
    ("plates", {"label_reach_gaps": 0.02}),
    ("plates", {"min_points_per_shot": 50}),
    ("two plates", {"across_sd_ratio": 0.1}),
    ("dots", {"position_sd_prior_median_wf": 5e-2}),
    ("dots", {"min_position_gain_nats": 1e6}),
    ("dots", {"error_bar_level": 0.5, "position_degrees_of_freedom": (3.0,), "min_position_tail_gain_nats": 1e-9}),
]


@pytest.mark.slow
@pytest.mark.parametrize(("data", "changed"), CHANGES, ids=[" ".join([of, *changed]) for of, changed in CHANGES])
def test_a_changed_setting_changes_the_fit_or_its_error_bars(data: str, changed: dict[str, Any]) -> None:
    usual = default_fit(data)
    calibration = ForwardGP(settings=ForwardGPSettings(**changed)).fit(DATA[data]())
    between = usual.data.xyz + 5.0
    assert not np.array_equal(
        calibration.measure(usual.data.observations).cov + calibration.known_position_covariance(between),
        usual.measure(usual.data.observations).cov + usual.known_position_covariance(between),
        equal_nan=True,
    )


@pytest.mark.slow
def test_settings_of_measuring_are_those_of_the_calibration() -> None:
    """Which views disagree, when there is no position, and when that is an alarm."""
    data = with_wrong_views()
    usual = fitted().measure(data.observations)

    def measured(**changed: Any) -> Any:
        calibration = replace(fitted(), calibrator=ForwardGP(settings=ForwardGPSettings(**changed)))
        return calibration.measure(data.observations)

    left_out = [sum("measured without" in why for why in m.reason) for m in (usual, measured(agree_p_value=1 - 1e-9))]
    assert left_out[0] > 3
    assert left_out[1] == 0
    strict = measured(min_p_value=0.9)
    assert np.isnan(strict.xyz[:, 0]).sum() > 30
    assert not usual.alarm
    assert measured(max_contradicting_share=0.01, usual_wrong_share=1e-6, false_alarm_probability=0.99).alarm


@pytest.mark.parametrize(
    "name",
    ["distortion_prior_sd", "distortion_at_edge_prior_sd", "log_aspect_prior_sd", "centre_prior_sd_sides",
     "projection_prior_relative_sd"],
)  # fmt: skip
def test_priors_of_cameras_are_those_of_the_settings(name: str) -> None:
    pose, widest = Pose(rotation(0), np.array([0.1, -0.2, 3.0])), 1.05
    cameras = (
        CentralCamera(KannalaBrandt(400.0, 401.0, 630.0, 405.0, 0.02, 0.0, 0.0, 0.0), pose),
        ProjectiveCamera(np.column_stack([pose.rotation, pose.translation])),
    )
    changed = ForwardGPSettings(**{name: other(name)})
    same = [
        np.array_equal(camera.prior(IMAGE, widest).precision, camera.prior(IMAGE, widest, changed).precision)
        for camera in cameras
    ]
    assert same == [name == "projection_prior_relative_sd", name != "projection_prior_relative_sd"]


@pytest.mark.parametrize(
    "changed",
    [{"min_levels": 4}, {"max_levels": 2}, {"min_points_per_level": 13}, {"max_level_thickness_ratio": 1e-7}],
)
def test_what_a_level_is_the_settings_say(changed: dict[str, Any]) -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([np.column_stack([rng.uniform(-1, 1, (12, 2)), np.full(12, z)]) for z in (0.0, 0.4, 1.0)])
    points[:, 2] += rng.uniform(0, 1e-4, len(points))
    found = find_levels(points, ForwardGPSettings())
    assert found is not None
    assert len(np.unique(found.number)) == 3
    assert find_levels(points, ForwardGPSettings(**changed)) is None


def test_what_parallel_plates_are_the_settings_say() -> None:
    """Where plates are none, the direction of the traverse is that of their centres."""
    data = plates()
    points = data.xyz / 100 + np.random.default_rng(0).normal(scale=5e-4, size=data.xyz.shape)
    along = [
        Shots.of(points, data.shots, ForwardGPSettings(**changed)).along[0]  # type: ignore[union-attr]
        for changed in ({}, {"max_plate_thickness_ratio": 1e-6}, {"max_plate_one_minus_cosine": 1e-15})
    ]
    assert not np.array_equal(along[0], along[1])
    np.testing.assert_array_equal(along[1], along[2])


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("max_squared_mahalanobis", -1.0, "above 0"),
        ("max_squared_mahalanobis", float("nan"), "above 0"),
        ("max_squared_mahalanobis", float("inf"), "above 0"),
        ("max_squared_mahalanobis", "25", "a number"),
        ("max_squared_mahalanobis", True, "a number"),
        ("max_rounds", 2.5, "a whole number"),
        ("max_rounds", 0, "above 0"),
        ("agree_p_value", 1.5, "below 1"),
        ("max_contradicting_share", 1.0, "below 1"),
        ("alarm_p_values", (0.05, 2.0), "below 1"),
        ("alarm_p_values", 0.05, "a tuple of numbers"),
        ("tail_degrees_of_freedom", (2.0, 3.0), "above 2"),
        ("tail_degrees_of_freedom", (), "at least one"),
        ("lengthscale_prior_median", (1.0, 2.0, 3.0), "2 numbers"),
    ],
)
def test_a_setting_that_makes_no_sense_is_refused(name: str, value: Any, words: str) -> None:
    with pytest.raises(UsageError, match=rf"the setting {name} must be .*{words}"):
        ForwardGPSettings(**{name: value})


def test_a_setting_that_is_not_there_is_refused_with_the_nearest() -> None:
    with pytest.raises(UsageError, match=r"there is no setting 'max_round'.*max_rounds"):
        ForwardGPSettings.from_table({"max_round": 3})
    with pytest.raises(UsageError, match="no setting 'max_round'"):
        ForwardGPSettings(max_round=3)  # type: ignore[call-arg]
    with pytest.raises(UsageError, match="no setting 'max_rounds'"):
        RigModelSettings.from_table({"max_rounds": 3})
    with pytest.raises(UsageError, match="settings of forward-gp are of the type"):
        ForwardGP(settings=RigModelSettings())  # type: ignore[arg-type]
