"""Is a calibration to be used? Ordinary rigs are; what is wrong is named, with its cure."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import implicam as ic
from implicam import calibration_file
from implicam.calibrators.protocol import CalibrationBase, FitSummary, per_axis
from implicam.cli import commands, main
from implicam.dataset import Dataset, Floats
from implicam.geometry import Pose, rotation_from_vector
from implicam.measurement import Measurement
from implicam.simulate import ball_grid, build_rig, random_positions, simulate
from implicam.verdict import DOUBTFUL, NOT_USABLE, USABLE, _moved_at, _of_data, _of_surface

CASES = Path(__file__).parent / "data" / "cases"


def rig(points: int, spec: str = "bar3", seed: int = 3, noise_of_positions: float = 0.0, **how: float) -> Dataset:
    built = build_rig(spec, seed=seed)
    data = simulate(built, random_positions(built, points, np.random.default_rng(seed)), seed=seed, **how)
    off = noise_of_positions * np.random.default_rng(seed + 1).normal(size=(points, 3))
    return replace(data, known=replace(data.positions, xyz=data.xyz + off))


def with_pixels(data: Dataset, uv: Floats) -> Dataset:
    return replace(data, observations=replace(data.observations, uv=uv))


@pytest.mark.parametrize(("spec", "points"), [("stereo", 17), ("bar3", 30)])
def test_an_ordinary_rig_is_usable(spec: str, points: int) -> None:
    verdict = ic.judge(ic.ForwardGP().fit(rig(points, spec, outliers=0.03, missing=0.05)))
    assert (verdict.word, verdict.reasons) == (USABLE, ())
    assert verdict.held_out is not None
    assert verdict.held_out.points >= points - 5
    assert verdict.held_out.inside > 0.8
    assert verdict.held_out.rms < 3 * verdict.held_out.stated


def test_known_positions_that_are_slightly_off_are_no_doubt_where_the_fit_has_found_it() -> None:
    """What was held out are known positions, whose errors are estimated by the fit though nobody states them."""
    data = rig(50, noise_of_positions=0.1)
    calibration = ic.ForwardGP().fit(data)
    assert calibration.fitted.position_errors is not None
    verdict = ic.judge(calibration)
    assert (verdict.word, verdict.reasons) == (USABLE, ())
    assert verdict.held_out is not None
    assert 0.1 < verdict.held_out.rms < 1.5 * verdict.held_out.stated


@pytest.mark.slow
@pytest.mark.parametrize("method", [ic.ForwardGP, ic.Explicit])
def test_known_positions_stated_far_too_good_are_doubtful(method: type[ic.ForwardGP] | type[ic.Explicit]) -> None:
    """Off by 1 mm, stated as 0.01 mm: half of the points lay in their ellipsoids, and it was usable."""
    data = rig(50, noise_of_positions=1.0)
    verdict = ic.judge(method().fit(replace(data, known=replace(data.positions, sd=np.full((50, 3), 0.01)))))
    assert verdict.word == DOUBTFUL
    assert " ".join(verdict.reasons).count("The stated sds of the known positions seem too small") == 1


@pytest.mark.slow
@pytest.mark.parametrize("sd", [0.1, 1.0])
def test_known_positions_stated_right_are_usable(sd: float) -> None:
    data = rig(50, noise_of_positions=sd)
    verdict = ic.judge(ic.Explicit().fit(replace(data, known=replace(data.positions, sd=np.full((50, 3), sd)))))
    assert (verdict.word, verdict.reasons) == (USABLE, ())


def test_explicit_is_judged_too() -> None:
    assert ic.judge(ic.Explicit().fit(rig(25, "stereo"))).word == USABLE


def test_few_points_are_doubtful() -> None:
    verdict = ic.judge(ic.ForwardGP().fit(rig(10)))
    assert verdict.word == DOUBTFUL
    assert "10 known points are few" in verdict.reasons[0]


def test_rows_copied_are_doubtful_and_the_error_is_that_of_new_points(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "r.implicam"
    with pytest.raises(SystemExit) as left:
        main(["calibrate", str(CASES / "rows-copied" / "known.csv"), "-o", str(file), "--json"])
    assert left.value.code == 0
    told = json.loads(capsys.readouterr().out)["verdict"]
    assert told["word"] == DOUBTFUL
    assert told["reasons"][0].startswith("48 of 60 known points are copies of others")
    assert 0.05 < told["held_out"]["rms"] < 1  # 0.53 mm at new points, where 0.0000006 was believed
    assert calibration_file.describe(file)["verdict"] == told
    with pytest.raises(SystemExit):
        main(["measure", str(file), str(CASES / "rows-copied" / "new.csv"), "-o", str(tmp_path / "m.csv")])
    assert "found doubtful when it was made" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.slow
def test_one_camera_late_is_said_once() -> None:
    data = rig(40)
    uv = data.observations.uv.copy()
    uv[:, 1] = np.roll(uv[:, 1], 1, axis=0)
    reasons = ic.judge(ic.ForwardGP().fit(with_pixels(data, uv))).reasons
    assert sum("1 row late" in reason for reason in reasons) == 1
    assert not any("cam2 misses" in reason or "like another camera" in reason for reason in reasons)


@pytest.mark.slow
def test_a_camera_that_moved_halfway_is_named() -> None:
    """As people report who bump a tripod while they calibrate."""
    built = build_rig("bar3", seed=3)
    target = random_positions(built, 30, np.random.default_rng(3))
    before, cameras = simulate(built, target, seed=3), list(built.cameras)
    turn = Pose(rotation_from_vector(np.radians([0.3, -0.2, 0.2])), np.zeros(3))
    cameras[2] = replace(cameras[2], camera_from_world=turn @ cameras[2].camera_from_world)
    after = simulate(replace(built, cameras=tuple(cameras)), target, seed=3)
    uv = before.observations.uv.copy()
    uv[15:] = after.observations.uv[15:]
    verdict = ic.judge(ic.ForwardGP().fit(with_pixels(before, uv)))
    assert verdict.word != USABLE
    assert " ".join(verdict.reasons).count("cam3: from row 16 on it sees like another camera") == 1
    assert "cam3 misses" not in " ".join(verdict.reasons)


def test_residuals_with_two_means_are_a_move_and_a_few_wrong_views_are_none() -> None:
    rng = np.random.default_rng(0)
    for n in (12, 30, 200):
        honest = rng.normal(size=(n, 2))
        assert _moved_at(honest) is None
        assert _moved_at(np.linspace(-1, 1, n)[:, None] + 0.7 * honest) is None  # a lens, seen along a lattice
        wild = honest.copy()
        wild[-2] += 500
        assert _moved_at(wild) is None
        assert _moved_at(honest + 10.0 * (np.arange(n) >= 5)[:, None]) == 5
    assert _moved_at(np.zeros((11, 2))) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("off", "said"),
    [
        (np.linspace(0, 12, 35), "cam2: from row"),
        (np.linspace(-12, 12, 35)[np.random.default_rng(0).permutation(35)], "cam2 misses its own known points"),
    ],
    ids=["more and more", "at random"],
)
def test_one_of_two_cameras_that_slips_is_named(off: Floats, said: str) -> None:
    """The median of two is their mean, and no camera is ten times as bad as a mean that it is half of."""
    data = rig(35, "stereo")
    uv = data.observations.uv.copy()
    uv[:, 1] += off[:, None]
    silent = replace(data, observations=replace(data.observations, uv=uv, sd=np.full_like(uv, np.nan)))
    verdict = ic.judge(ic.ForwardGP().fit(silent))
    assert verdict.word == DOUBTFUL
    assert said in " ".join(verdict.reasons)


def test_two_pictures_of_one_camera_are_not_usable_though_the_error_bars_are_honest() -> None:
    """Detected twice, so that no pixel is the same to the last bit: no depth, and error bars as large as the room."""
    data = rig(35, "stereo")
    uv = data.observations.uv.copy()
    uv[:, 1] = uv[:, 0] + 0.1 * np.random.default_rng(4).normal(size=uv[:, 0].shape)
    verdict = ic.judge(ic.ForwardGP().fit(with_pixels(data, uv)))
    assert verdict.word != USABLE
    assert "different directions" in " ".join(verdict.reasons) or "no measurement" in " ".join(verdict.reasons)


@pytest.mark.slow
def test_marks_that_came_by_the_api_are_said() -> None:
    data = rig(25)
    uv = data.observations.uv.copy()
    uv[::5, 0] = -1
    verdict = ic.judge(ic.ForwardGP().fit(with_pixels(data, uv)))
    assert verdict.word == DOUBTFUL
    assert "The pixel (-1, -1) occurs 5 times (cam1)" in verdict.reasons[0]
    assert "taken for a pixel" in verdict.reasons[0]


def test_points_nearly_on_a_plane_are_doubtful() -> None:
    data = rig(25)
    xyz = data.xyz.copy()
    xyz[:, 0] = xyz[:, 0].mean() + 0.002 * (xyz[:, 0] - xyz[:, 0].mean())
    (finding,) = _of_data(replace(data, known=replace(data.positions, xyz=xyz)))
    assert "nearly on a plane" in finding.reason
    assert not finding.grave


class _Pretends(CalibrationBase):
    """A calibration that is off by `off` in each axis and believes in 0.02."""

    method, unused = "pretends", ()

    def __init__(self, data: Dataset, off: float) -> None:
        self.data, self.off = data, off

    def refit(self, data: Dataset) -> _Pretends:
        return _Pretends(data, self.off)

    def summary(self) -> FitSummary:
        zero = per_axis(np.zeros(3))
        return FitSummary(points_used=25, points_unused=0, leave_one_out_rms=zero, leave_one_out_mean_sd=zero)

    def measure(self, observations: ic.Observations) -> Measurement:
        row = {str(name): xyz for name, xyz in zip(TRUE.points, TRUE.xyz, strict=True)}
        xyz = np.array([row[str(name)] for name in observations.points])
        n = len(xyz)
        off = self.off * np.random.default_rng(n).normal(size=(n, 3))
        cov = np.tile(0.02**2 * np.eye(3), (n, 1, 1))
        reasons = np.full(n, "")
        return Measurement(observations.points, xyz + off, cov, np.full(n, 3), np.full(n, 0.5), reasons, "mm")


TRUE = rig(25)


@pytest.mark.parametrize(("off", "word"), [(0.02, USABLE), (0.06, DOUBTFUL), (5.0, NOT_USABLE), (500.0, NOT_USABLE)])
def test_errors_far_above_the_error_bars(off: float, word: str) -> None:
    verdict = ic.judge(_Pretends(TRUE, off))
    assert verdict.word == word
    assert bool(verdict.reasons) == (word != USABLE)


def test_error_bars_too_small_beside_stated_sds() -> None:
    stated = replace(TRUE, known=replace(TRUE.positions, sd=np.full((25, 3), 0.01)))
    verdict = ic.judge(_Pretends(stated, 0.06))
    assert verdict.word == DOUBTFUL
    assert verdict.reasons[0].endswith("The stated sds of the known positions seem too small.")


def test_not_usable_writes_nothing_unless_forced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ic.write_dataset(rig(20), tmp_path / "d")
    file = tmp_path / "r.implicam"
    monkeypatch.setattr(commands, "judge", lambda *_: ic.Verdict(NOT_USABLE, ("it is nonsense.",)))
    with pytest.raises(SystemExit) as left:
        main(["calibrate", str(tmp_path / "d"), "-o", str(file)])
    assert left.value.code == 1
    assert not file.exists()
    said = capsys.readouterr()
    assert "no file written" in said.out
    assert "it is nonsense" in said.err
    with pytest.raises(SystemExit) as left:
        main(["calibrate", str(tmp_path / "d"), "-o", str(file), "--force"])
    assert left.value.code == 0
    assert calibration_file.describe(file)["verdict"]["word"] == NOT_USABLE


@pytest.mark.parametrize(("lens", "levels", "said"), [("none", 2, True), ("none", 3, False), ("auto", 2, False)])
def test_two_planes_are_doubtful_where_no_lens_restrains_the_cameras(lens: str, levels: int, said: bool) -> None:
    """A tank of the menagerie: 30 points on two levels, errors of 11 times the limit between them, folds as they
    should be."""
    built = build_rig("stereo", seed=1)
    grid = ball_grid(built, (6, 6, levels))
    findings = list(_of_surface(ic.ForwardGP(lens).fit(simulate(built, grid, seed=2))))
    assert ["two planes" in finding.reason for finding in findings] == [True] * said
