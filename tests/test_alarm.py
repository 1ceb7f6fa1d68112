"""A table as a whole: a rig that is not the one that was calibrated, and tables that are only bad."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.special import chdtrc

import implicam as ic
from implicam.cli import main
from implicam.dataset import Floats, Observations
from implicam.errors import DatasetError
from implicam.geometry import Pose, rotation_from_vector
from implicam.measurement import DOUBTFUL
from implicam.rig_model.alarm import Table, _inexplicable_probability, _misfit, _surprising_level
from implicam.rig_model.settings import DEFAULT_SETTINGS
from implicam.simulate import Rig, build_rig, random_positions, simulate

CASES = Path(__file__).parent / "data" / "cases"


@cache
def case(name: str) -> tuple[ic.ForwardGPCalibration, ic.Dataset]:
    calibration = ic.ForwardGP().fit(ic.read_dataset(CASES / name / "known.csv"))
    return calibration, ic.read_dataset(CASES / name / "new.csv")


@cache
def fitted(spec: str) -> tuple[Rig, ic.ForwardGPCalibration]:
    rig = build_rig(spec, seed=5)
    return rig, ic.ForwardGP().fit(simulate(rig, random_positions(rig, 40, np.random.default_rng(5)), seed=1))


def table(rig: Rig, points: int = 40, seed: int = 2, **how: float) -> Observations:
    target = random_positions(rig, points, np.random.default_rng(seed))
    return simulate(rig, target, seed=seed, **how).observations


def knocked(rig: Rig, camera: int, degrees: float) -> Rig:
    cameras = list(rig.cameras)
    turn = Pose(rotation_from_vector(np.radians([degrees, -degrees, 0.0]) / 2**0.5), np.zeros(3))
    cameras[camera] = replace(cameras[camera], camera_from_world=turn @ cameras[camera].camera_from_world)
    return replace(rig, cameras=tuple(cameras))


@pytest.mark.slow
def test_a_rig_that_was_knocked_raises_an_alarm() -> None:
    calibration, new = case("knocked-cameras-no-alarm")
    found = calibration.measure(new.observations)
    assert "of 80 points contradict the calibration; 0.01 % would be chance" in found.alarm
    assert "has a camera been moved" in found.alarm
    assert all(str(reason).startswith(DOUBTFUL) for reason in found.reason)
    assert found.measured.sum() > 10  # the numbers stay


def test_exchanged_cameras_are_named() -> None:
    calibration, new = case("swapped-cameras-no-alarm")
    found = calibration.measure(new.observations)
    assert "are cam1 and cam2 exchanged?" in found.alarm
    assert all(str(reason).startswith(DOUBTFUL) for reason in found.reason)
    assert DOUBTFUL not in " ".join(found.own_reason)


def test_the_command_fails_and_keeps_its_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    calibration, _ = case("swapped-cameras-no-alarm")
    rig, measured = tmp_path / "r.implicam", tmp_path / "m.csv"
    calibration.save(rig)
    new = str(CASES / "swapped-cameras-no-alarm" / "new.csv")
    with pytest.raises(SystemExit) as left:
        main(["measure", str(rig), new, "-o", str(measured), "--json"])
    assert left.value.code == 1
    assert "exchanged" in json.loads(capsys.readouterr().out)["alarm"]
    assert measured.read_text().count(DOUBTFUL) == 80
    with pytest.raises(SystemExit) as left:
        main(["evaluate", str(rig), new])
    assert left.value.code == 0  # evaluate judges, whatever it finds
    assert "alarm:" in capsys.readouterr().err


@pytest.mark.parametrize("spec", ["stereo", "bar3"])
@pytest.mark.parametrize("wrong", [0.0, 0.1, 0.2])
def test_ordinary_tables_raise_none(spec: str, wrong: float) -> None:
    rig, calibration = fitted(spec)
    for seed in range(6):
        points = (10, 12, 20, 40, 80, 150)[seed]
        found = calibration.measure(table(rig, points, seed, outliers=wrong, missing=0.1))
        assert found.alarm == "", (points, found.alarm)


def one_row_late(uv: Floats) -> Floats:
    return np.stack([uv[:, 0], np.roll(uv[:, 1], 1, axis=0)], axis=1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda uv: uv[:, ::-1], "are cam1 and cam2 exchanged?"),
        (one_row_late, "1 row"),
        (lambda uv: np.stack([uv[..., 0], 1023 - uv[..., 1]], axis=-1), "is v counted from below"),
        (lambda uv: uv[..., ::-1], "are u and v exchanged?"),
        (lambda uv: (uv + 0.5) / 2 - 0.5, "are the pictures half the size"),
        (lambda uv: (uv + 0.5) / 1.5 - 0.5, "are the pictures two thirds the size"),
    ],
)
def test_likely_causes_are_named(change: Callable[[Floats], Floats], said: str) -> None:
    """Two cameras: as people report of unsynchronised videos, exchanged names, resized pictures."""
    rig, calibration = fitted("stereo")
    seen = table(rig)
    uv = np.clip(change(seen.uv), 0, 1023) if "u and v" in said else change(seen.uv)
    assert said in calibration.measure(replace(seen, uv=uv)).alarm


def of_one(change: Callable[[Floats], Floats], camera: int = 1) -> Callable[[Floats], Floats]:
    def changed(uv: Floats) -> Floats:
        uv = uv.copy()
        uv[:, camera] = change(uv[:, camera])
        return uv

    return changed


@pytest.mark.parametrize(
    ("spec", "change", "said"),
    [
        ("stereo", lambda uv: np.clip(uv[:, ::-1], 0, 1023), "are u and v of cam2 exchanged?"),
        ("bar3", lambda uv: np.clip(uv[:, ::-1], 0, 799), "are u and v of cam2 exchanged?"),
        ("stereo", lambda uv: (uv + 0.5) / 2 - 0.5, "are the pictures of cam2 half the size"),
        ("bar3", lambda uv: (uv + 0.5) / 2 - 0.5, "are the pictures of cam2 half the size"),
        ("bar3", lambda uv: np.stack([uv[:, 0], 799 - uv[:, 1]], axis=1), "is v of cam2 counted from below"),
        ("stereo", lambda uv: np.roll(uv, 1, axis=0), "1 row"),  # two cameras: the one late, or the other early
        ("bar3", lambda uv: np.roll(uv, 1, axis=0), "are the pictures of cam2 1 row late?"),
    ],
)
def test_what_was_done_to_one_camera_is_named_before_it_is_called_moved(
    spec: str, change: Callable[[Floats], Floats], said: str
) -> None:
    rig, calibration = fitted(spec)
    seen = table(rig)
    assert said in calibration.measure(replace(seen, uv=of_one(change)(seen.uv))).alarm


def test_many_views_outside_of_the_image_are_no_slip() -> None:
    rig, _ = fitted("stereo")
    seen = table(rig)
    with pytest.raises(DatasetError, match="are its u and v exchanged, are these the pixels of another camera"):
        replace(seen, uv=seen.uv[..., ::-1] + [0, 300])


def test_one_camera_that_was_moved_is_named_and_left_out() -> None:
    rig, calibration = fitted("bar3")
    found = calibration.measure(table(knocked(rig, 1, 0.5)))
    assert (
        "has cam2 been moved or refocused, or are its pictures cropped? Without it 100 % of those tried agree"
        in found.alarm
    )


def test_a_camera_moved_a_little_needs_no_point_that_fails() -> None:
    """Two cameras: each point disagrees a little, and that so many do is the sign."""
    rig, calibration = fitted("stereo")
    target = random_positions(rig, 40, np.random.default_rng(2))
    found = calibration.measure(simulate(knocked(rig, 1, 0.04), target, seed=2).observations)
    assert (found.consistency < DEFAULT_SETTINGS.disagree_p_value).mean() < DEFAULT_SETTINGS.max_contradicting_share
    assert "points agree badly" in found.alarm
    assert "has a camera been moved or refocused a little" in found.alarm


@pytest.mark.parametrize("views", [2, 3, 8])
def test_error_bars_somewhat_too_small_are_no_alarm(views: int) -> None:
    """Honest points whose chi-squared is 1.25 squared too large: alarms are as rare as promised."""
    rng = np.random.default_rng(views)
    alarms = 0
    for n in (10, 30, 100, 300) * 250:
        p = chdtrc(2 * views - 3, 1.25**2 * rng.chisquare(2 * views - 3, size=n))
        alarms += _surprising_level(p, np.full(n, views), DEFAULT_SETTINGS) is not None
    assert alarms <= 3  # of 1000
    wide = chdtrc(2 * views - 3, 2.5**2 * rng.chisquare(2 * views - 3, size=60))
    assert _surprising_level(wide, np.full(60, views), DEFAULT_SETTINGS) is not None


def test_a_few_points_are_not_a_table() -> None:
    rig, calibration = fitted("stereo")
    seen = table(rig, 9)
    assert calibration.measure(replace(seen, uv=seen.uv[:, ::-1])).alarm == ""


@pytest.mark.parametrize(("views", "share"), [(2, 0.36), (3, 0.104), (5, 0.05792)])
def test_how_many_points_no_wrong_view_explains(views: int, share: float) -> None:
    assert _inexplicable_probability(views, DEFAULT_SETTINGS.usual_wrong_share) == pytest.approx(share)


@pytest.mark.filterwarnings("error")
def test_a_cause_of_which_most_views_are_nowhere_warns_nobody() -> None:
    """A quantile between two infinities is no number, and NumPy says so in the middle of the table."""
    seen = table(build_rig("stereo", seed=5), 20)
    looks = [(np.array([x, 0.0, 0.0]), np.tile([0.0, 0.0, 1.0], (20, 1))) for x in (0.0, 100.0)]
    nothing = Table(
        seen.cameras, seen.uv, np.ones((20, 2)), np.zeros(20), np.zeros((20, 2), dtype=bool),
        lambda uv: np.zeros(len(uv), dtype=bool), lambda uv: iter(looks), lambda x: np.full((len(x), 2, 2), np.nan),
    )  # fmt: skip
    assert _misfit(nothing, np.arange(20), seen.uv, np.ones((20, 2))) == np.inf
