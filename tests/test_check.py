"""Does a calibration still hold: cameras that move are named with how far, rigs that stand raise no alarm."""

from __future__ import annotations

import csv
import importlib.util
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import implicam as ic
from command_line import Cli, cli  # noqa: F401  a fixture
from implicam.calibrators.explicit import calibration_of
from implicam.dataset import Dataset, Floats
from implicam.errors import DatasetError, UsageError
from implicam.exchange import ExplicitCamera
from implicam.exchange import Rig as ExplicitRig
from implicam.geometry import Pose
from implicam.rig_model.camera_model import apply_covariance_root
from implicam.rig_model.general_camera import GeneralCamera
from implicam.rig_model.movement import Motion, Stand, see_moved
from implicam.rig_model.repair import move_model
from implicam.simulate import Rig, Target, build_rig, random_positions, simulate
from implicam.stability import NUMBER_NAMES, append_to_log

NOTHING = np.zeros(7)


def moved(rig: Rig, camera: int, step: Floats) -> Rig:
    """A simulated rig with one camera turned (degrees) and shifted (mm) about its own axes, and zoomed (per cent)."""
    before = rig.cameras[camera]
    pose = before.camera_from_world
    turn = Rotation.from_rotvec(np.radians(step[:3])).as_matrix().T @ pose.rotation
    lens = replace(before.lens, fx=before.lens.fx * (1 + step[6] / 100), fy=before.lens.fy * (1 + step[6] / 100))
    after = replace(
        before, camera_from_world=Pose(turn, -turn @ (pose.centre + pose.rotation.T @ step[3:6])), lens=lens
    )
    return replace(rig, cameras=tuple(after if c == camera else one for c, one in enumerate(rig.cameras)))


@cache
def rig_and_calibration(name: str = "bar6", points: int = 157) -> tuple[Rig, ic.Calibration]:
    rig = build_rig(name, seed=1, lens_error=0.5)
    return rig, ic.ForwardGP().fit(simulate(rig, random_positions(rig, points, np.random.default_rng(1)), seed=1))


def views(rig: Rig, seed: int, points: int = 50) -> Dataset:
    return replace(simulate(rig, random_positions(rig, points, np.random.default_rng(seed)), seed=seed), known=None)


def step_of(**numbers: float) -> Floats:
    return np.array([numbers.get(name, 0.0) for name in NUMBER_NAMES])


def test_slopes_of_a_moved_camera_are_its_differences() -> None:
    _, calibration = rig_and_calibration()
    fitted = calibration.map
    model, points = fitted.posterior.models[2], fitted.frame.to_working(calibration.data.xyz[:6])
    stand = Stand.of(model)
    motion = stand.moved(Motion(), np.array([0.02, -0.03, 0.05, 0.1, -0.05, 0.2, 0.02]))
    views_there = see_moved(model, stand, motion, points)
    h = 1e-6
    for i in range(7):
        ahead, behind = (see_moved(model, stand, stand.moved(motion, s * h * np.eye(7)[i]), points).uv for s in (1, -1))
        np.testing.assert_allclose(views_there.by_step[:, :, i], (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-4)
    for i in range(3):
        ahead, behind = (see_moved(model, stand, motion, points + s * h * np.eye(3)[i]).uv for s in (1, -1))
        np.testing.assert_allclose(views_there.by_point[:, :, i], (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "step",
    [
        step_of(tilt=0.05),
        pytest.param(step_of(right=0.4), marks=pytest.mark.slow),
        step_of(pan=3.0, down=20.0),
        pytest.param(step_of(zoom=2.0), marks=pytest.mark.slow),
        pytest.param(step_of(roll=-10.0), marks=pytest.mark.slow),
    ],
    ids=["a little tilt", "a little shift", "knocked", "zoomed", "rolled"],
)
def test_a_camera_that_moved_is_named_with_how_far(step: Floats) -> None:
    rig, calibration = rig_and_calibration()
    found = ic.check_calibration(calibration, views(moved(rig, 3, step), 7))
    assert found.verdict == "moved"
    first = found.cameras[0]
    assert first.camera == "cam4"
    # about the true axes, which the calibration knows to some minutes of arc only
    stand, true = Stand.of(calibration.map.posterior.models[3]), rig.cameras[3].camera_from_world.rotation
    to_fitted = (true @ stand.axes).T
    right = np.array([*(to_fitted @ step[:3]), *(to_fitted @ step[3:6]), step[6]])
    error = first.step - right
    assert error @ np.linalg.solve(first.cov, error) < 24.3  # 7 degrees of freedom, 0.1 %
    assert "cam4 has moved" in found.sentences()[0]


@pytest.mark.slow
def test_wrong_detections_do_not_hide_it() -> None:
    rig, calibration = rig_and_calibration()
    data = views(moved(rig, 3, step_of(pan=0.1)), 8, points=60)
    uv, rng = data.observations.uv.copy(), np.random.default_rng(0)
    for i in range(0, 60, 5):  # one point in five has a wrong view
        uv[i, rng.integers(6)] += rng.uniform(20, 200, 2)
    found = ic.check_calibration(calibration, replace(data, observations=replace(data.observations, uv=uv)))
    assert (found.verdict, found.cameras[0].camera) == ("moved", "cam4")
    assert found.cameras[0].step[1] == pytest.approx(0.1, abs=4 * found.cameras[0].sd[1])
    assert found.cameras[0].sd[1] < 0.04  # only the wrong views are left out: all others were, once


@pytest.mark.slow
def test_two_cameras_that_moved_are_no_single_one() -> None:
    rig, calibration = rig_and_calibration()
    both = moved(moved(rig, 3, step_of(pan=0.1)), 1, step_of(tilt=0.1))
    assert ic.check_calibration(calibration, views(both, 9)).verdict == "several moved"


@pytest.mark.slow
@pytest.mark.parametrize("after", [30, 60])
def test_a_camera_that_moved_while_views_were_taken_is_named(after: int) -> None:
    rig, calibration = rig_and_calibration()
    first, second = views(rig, 9, 80), views(moved(rig, 3, step_of(pan=0.3)), 9, 80)
    uv = np.concatenate([first.observations.uv[:after], second.observations.uv[after:]])
    data = replace(first, observations=replace(first.observations, uv=uv))
    found = ic.check_calibration(calibration, data)
    assert found.verdict == "moved midway"
    assert found.midway is not None
    assert found.midway[0] == "cam4"
    assert abs(found.midway[1] - after) <= 20  # of 80: after a quarter, half or three quarters
    assert "cam4 moved while these points were taken" in found.sentences()[0]


@pytest.mark.slow
@pytest.mark.parametrize("which", [(3, 1), (0, 1, 2, 4, 5)], ids=["two", "all but one"])
def test_cameras_that_were_knocked_away_are_not_taken_for_wrong_detections(which: tuple[int, ...]) -> None:
    """All views of the second were left out as wrong, and the first was named alone."""
    rig, calibration = rig_and_calibration()
    there = rig
    for k, camera in enumerate(which):
        there = moved(there, camera, step_of(tilt=1.0 + k, pan=-0.5 * k, right=3.0))
    found = ic.check_calibration(calibration, views(there, 9))
    assert found.verdict == "several moved"
    assert "or many views of" in found.sentences()[0]


def test_of_two_cameras_nobody_can_say_which() -> None:
    rig, calibration = rig_and_calibration("stereo", 60)
    found = ic.check_calibration(calibration, views(moved(rig, 1, step_of(tilt=0.5)), 10))
    assert found.verdict == "one moved"
    assert set(found.candidates) == set(calibration.camera_names)
    assert "nobody can say which" in found.sentences()[0]


@pytest.mark.slow
def test_all_cameras_together_are_seen_by_known_points_alone() -> None:
    rig, calibration = rig_and_calibration()
    data = simulate(rig, random_positions(rig, 40, np.random.default_rng(11)), seed=11)
    assert ic.check_calibration(calibration, data).verdict == "stands"
    shifted = data.transformed(np.array([[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    found = ic.check_calibration(calibration, shifted)
    assert found.verdict == "biased"
    assert found.known is not None
    assert found.known.bias[0] == pytest.approx(-0.5, abs=4 * found.known.bias_sd[0])
    unknown = ic.check_calibration(calibration, replace(shifted, known=None))
    assert unknown.verdict == "stands"
    assert "moved together looks the same" in unknown.sentences()[1]


@pytest.mark.slow
@pytest.mark.parametrize("along", [50.0, 0.0], ids=["a line", "one place"])
def test_known_points_that_fill_no_volume_show_no_bias_that_is_not_there(along: float) -> None:
    """A turn about their line moves none of them, and where they stand in one place no growth does."""
    rig, calibration = rig_and_calibration()
    names = np.array([f"q{i}" for i in range(20)])
    places = calibration.data.xyz.mean(axis=0) + along * np.outer(np.linspace(-1, 1, 20), [1, 0.2, 0.1])
    p_values = []
    for seed in range(2):
        data = simulate(rig, Target("line", names, names, places), seed=seed)
        known = ic.check_calibration(calibration, data).known
        assert known is not None
        p_values.append(known.p_value)
    assert min(p_values) > 0.05 / 2 / 5


def test_cameras_of_which_nothing_can_be_said_are_named() -> None:
    rig, calibration = rig_and_calibration()
    data = views(rig, 14)
    uv = data.observations.uv.copy()
    uv[:, 4] = np.nan
    found = ic.check_calibration(calibration, replace(data, observations=replace(data.observations, uv=uv)))
    assert found.not_judged == ("cam5",)
    assert any("Of cam5 nothing can be said" in sentence for sentence in found.sentences())


def test_what_cannot_be_checked_is_refused() -> None:
    rig, calibration = rig_and_calibration()
    with pytest.raises(UsageError, match="no cameras that could have moved"):
        ic.check_calibration(ic.InverseGP().fit(rig_and_calibration("stereo", 60)[1].data), views(rig, 12))
    with pytest.raises(UsageError, match="no probability"):
        ic.check_calibration(calibration, views(rig, 12), level=5)
    with pytest.raises(DatasetError, match=r"saw 19 points; a check takes 20"):
        ic.check_calibration(calibration, views(rig, 12, points=19))
    data = views(rig, 12, points=3)
    uv = data.observations.uv.copy()
    uv[:, 1:] = np.nan
    with pytest.raises(DatasetError, match="no two cameras saw enough"):
        ic.check_calibration(calibration, replace(data, observations=replace(data.observations, uv=uv)))


def imported(rig: Rig, off: float = 0.0) -> ic.Calibration:
    """The true cameras as another program's file has them, the first turned by `off` degrees: nothing is known of how
    well they were calibrated."""
    told = moved(rig, 0, step_of(pan=off))
    cameras = [ExplicitCamera(c.name, c.width, c.height, c.lens, c.camera_from_world) for c in told.cameras]
    return calibration_of(ExplicitRig(tuple(cameras), "mm"), "cameras", 0.3)


def test_of_cameras_that_were_never_exact_none_is_said_to_have_moved(cli: Cli, tmp_path: Path) -> None:
    rig = build_rig("bar4", seed=1, lens_error=0.0)
    assert ic.check_calibration(imported(rig), views(rig, 15)).verdict == "stands"
    calibration = imported(rig, off=0.05)
    found = ic.check_calibration(calibration, views(rig, 15))
    assert found.found.named is not None  # what would be named, were these cameras known to be exact
    assert (found.verdict, found.holds, found.cameras, found.candidates, found.noticed) == (
        "disagree",
        False,
        (),
        (),
        {},
    )
    said = " ".join(found.sentences())
    assert "disagree by more than their noise" in said
    assert "moved since or were never more exact" in said
    assert not any(name in said for name in calibration.camera_names)
    with pytest.raises(UsageError, match="'disagree'"):
        found.repair()
    calibration.save("imported.implicam")
    ic.write_dataset(views(rig, 15), "new.csv")
    ran = cli("check", "imported.implicam", "new.csv", "--repair", "after.implicam", "--log", "checks.csv")
    assert ran.code == 1
    assert "after.implicam is not written: of these cameras it cannot be told" in ran.out
    assert "if it alone moved" not in ran.out


@pytest.mark.slow
def test_what_an_imported_calibration_does_not_know_is_not_said(cli: Cli) -> None:
    rig = build_rig("bar4", seed=1)
    calibration = imported(rig)
    assert np.isnan(calibration.measure(views(rig, 15)).share_calibration).all()
    calibration.save("imported.implicam")
    ic.write_dataset(views(rig, 15), "new.csv")
    ran = cli("measure", "imported.implicam", "new.csv")
    assert "more known points" not in ran.out
    assert "of the noise of the pixels alone" in ran.err
    told = cli("measure", "imported.implicam", "new.csv", "--json").json
    assert told["median_share_calibration"] is None
    assert any("nothing is known of how well" in note for note in told["notes"])
    np.savez("new.npz", uv=views(rig, 15).observations.uv)
    ran = cli("measure", "imported.implicam", "new.npz", "--chunk", "100", "-o", "parts.csv")
    assert "of the noise of the pixels alone" in ran.err
    imported(replace(rig, cameras=rig.cameras[:3])).save("three.implicam")
    assert "cameras that are not calibrated are not used: cam4 (50)" in cli("measure", "three.implicam", "new.csv").err
    assert "not calibrated" not in ran.err
    for words in (("evaluate", "imported.implicam", "--cv", "5"), ("report", "imported.implicam")):
        said = cli(*words).err
        assert "has no known points, so none can be held out" in said
        assert "evaluate FILE DATASET" in said
    if importlib.util.find_spec("onnx"):
        said = cli("export", "imported.implicam", "--to", "onnx", "-o", "rig.onnx").err
        assert "Nothing is known of the errors of these cameras" in said
        assert "known positions" not in said


def knocked(rig: Rig, camera: int) -> Rig:
    return moved(rig, camera, step_of(tilt=1.0, pan=-0.5, roll=0.7, right=3.0, forward=-4.0, zoom=0.3))


@pytest.mark.parametrize("kind", ["central", "general", "none"])
def test_a_model_that_is_moved_sees_what_a_moved_camera_sees(kind: str) -> None:
    """In its pixels, its slopes, and what is unknown of it."""
    if kind == "none":
        rig = build_rig("bar6", seed=1)
        method = ic.ForwardGP(lens="none")
        calibration = method.fit(simulate(rig, random_positions(rig, 60, np.random.default_rng(1)), seed=1))
    else:
        _, calibration = rig_and_calibration()
    model = calibration.map.posterior.models[2]
    if kind == "central":
        assert isinstance(model.camera, GeneralCamera)
        model = replace(model, camera=model.camera.as_central())
    stand = Stand.of(model)
    motion = stand.moved(Motion(), np.array([0.02, -0.03, 0.05, 0.1, -0.05, 0.2, 0.02]))
    points = calibration.map.frame.to_working(calibration.data.xyz[:8])
    root = np.random.default_rng(0).standard_normal((3, model.size))
    wanted, after = see_moved(model, stand, motion, points, root), move_model(model, stand, motion)
    uv, slope = after.predict(points)
    np.testing.assert_allclose(uv, wanted.uv, rtol=1e-9)
    np.testing.assert_allclose(slope, wanted.by_point, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(after.rows(points).rest, wanted.rest, rtol=1e-6, atol=1e-12)
    own = np.zeros((3, model.size))
    own[:, model.camera.size :] = root[:, model.camera.size :]  # the field, whose weights stay what they are
    wanted = see_moved(model, stand, motion, points, own)
    np.testing.assert_allclose(apply_covariance_root(after.rows(points), own), wanted.half, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_a_repaired_calibration_is_right_with_true_error_bars_and_in_a_file(tmp_path: Path) -> None:
    rig, calibration = rig_and_calibration()
    there = knocked(rig, 2)
    repaired = ic.check_calibration(calibration, views(there, 20)).repair()
    assert repaired.moved.camera == "cam3"
    assert repaired.sd_unmoved < repaired.sd < repaired.sd_without
    after = repaired.calibration
    assert any("After the calibration cam3 turned by" in note for note in after.notes)
    after.save(tmp_path / "after.implicam")
    read = ic.load_calibration(tmp_path / "after.implicam")
    data = simulate(there, random_positions(there, 200, np.random.default_rng(21)), seed=21)
    measured = after.measure(data)
    error = measured.xyz - data.xyz
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(measured.cov), error)
    assert nees.mean() == pytest.approx(3, abs=0.9)  # points share the calibration's error
    np.testing.assert_allclose(read.measure(data).xyz, measured.xyz, rtol=1e-9)
    np.testing.assert_allclose(read.measure(data).cov, measured.cov, rtol=1e-7)
    assert read.notes == after.notes
    assert ic.check_calibration(read, replace(data.select(range(50)), known=None)).holds
    with pytest.raises(UsageError, match="moved after its known points"):
        read.in_unit("m")


@pytest.mark.slow
@pytest.mark.parametrize("method", [ic.ForwardGP(), ic.Explicit()], ids=["forward-gp", "explicit"])
def test_what_a_movement_costs_is_what_recalibrations_show(method: ic.ForwardGP | ic.Explicit) -> None:
    """The error of a place in the repaired rig is that of its covariance: six rigs, three places each."""
    normal = []
    for seed in range(6):
        rig = build_rig("bar6", seed=seed)
        known = random_positions(rig, 40, np.random.default_rng(seed))
        calibration = method.fit(simulate(rig, known, seed=seed))
        there = knocked(rig, seed % 6)
        found = ic.check_calibration(calibration, views(there, 100 + seed, points=30))
        after = found.repair().calibration
        exact = simulate(there, random_positions(there, 3, np.random.default_rng(200 + seed)), seed=seed)
        measured = after.measure(exact)
        error = measured.xyz - exact.xyz
        normal.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(measured.cov), error))
    assert np.mean(normal) == pytest.approx(3, abs=3.3 * np.sqrt(6 / 18))


@pytest.mark.slow
def test_cameras_that_errors_of_known_positions_tie_are_repaired_too() -> None:
    """Their errors stay tied: a shot that is off takes all cameras with it."""
    rig = build_rig("bar6", seed=2)
    data = simulate(rig, random_positions(rig, 80, np.random.default_rng(2)), seed=2)
    known = replace(
        data.known, sd=np.full((80, 3), 0.2), xyz=data.xyz + np.random.default_rng(3).normal(0, 0.2, (80, 3))
    )
    calibration = ic.ForwardGP().fit(replace(data, known=known))
    assert calibration.posterior.tied
    there = knocked(rig, 4)
    after = ic.check_calibration(calibration, views(there, 30)).repair().calibration
    exact = simulate(there, random_positions(there, 100, np.random.default_rng(31)), seed=31)
    measured = after.measure(exact)
    error = measured.xyz - exact.xyz
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(measured.cov), error)
    assert nees.mean() == pytest.approx(3, abs=1.2)


@pytest.mark.slow
def test_what_cannot_be_repaired_is_refused() -> None:
    rig, calibration = rig_and_calibration()
    with pytest.raises(UsageError, match="no camera to put right: the verdict is 'stands'"):
        ic.check_calibration(calibration, views(rig, 13)).repair()
    with pytest.raises(UsageError, match="'several moved'"):
        ic.check_calibration(calibration, views(knocked(knocked(rig, 3), 1), 9)).repair()


@pytest.mark.slow
def test_a_watch_tells_when_a_camera_moves_and_not_before() -> None:
    rig, calibration = rig_and_calibration()
    watch = ic.CalibrationWatch(calibration, window=40, every=20)
    before, after = views(rig, 40, points=80), views(moved(rig, 1, step_of(pan=0.1)), 41, points=40)
    assert watch.add(before) is None
    assert watch.last is not None
    assert watch.last.points == 40
    alarms = [watch.add(after.select([i])) for i in range(40)]
    first = next(i for i, alarm in enumerate(alarms) if alarm is not None)
    assert first < 40
    assert alarms[-1] is not None
    assert (alarms[-1].verdict, alarms[-1].cameras[0].camera) == ("moved", "cam2")
    with pytest.raises(UsageError, match="cannot be"):
        ic.CalibrationWatch(calibration, window=5, every=10)


@pytest.mark.slow
def test_on_the_command_line_with_a_history(cli: Cli) -> None:
    rig, calibration = rig_and_calibration()
    calibration.save("rig.implicam")
    ic.write_dataset(views(rig, 13), "stands.csv")
    ic.write_dataset(views(moved(rig, 0, step_of(pan=0.2)), 13), "moved.csv")
    ran = cli("check", "rig.implicam", "stands.csv", "--log", "checks.csv")
    assert ran.code == 0, ran.err
    assert "Nothing speaks against the calibration" in ran.out
    options = ("--log", "checks.csv", "--figure", "checks.png", "--repair", "after.implicam")
    ran = cli("check", "rig.implicam", "moved.csv", *options)
    assert ran.code == 1
    assert "cam1 has moved" in ran.out + ran.err
    assert "With cam1 where it stands now, a position has a standard uncertainty of" in ran.out
    assert Path("checks.png").stat().st_size > 10_000
    ran = cli("check", "after.implicam", "moved.csv", "--repair", "again.implicam")
    assert ran.code == 0, ran.err
    assert "again.implicam is not written: there is nothing to repair" in ran.out
    assert not Path("again.implicam").exists()
    assert cli("check", "rig.implicam", "moved.csv", "--figure", "x.png").code == 2
    ran = cli("check", "rig.implicam", "moved.csv", "--json")
    assert json.loads(ran.out)["cameras"][0]["camera"] == "cam1"
    with open("checks.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["verdict"] for row in rows] == ["stands"] * 6 + ["moved"] * 6
    assert float(rows[6]["pan"]) == pytest.approx(0.2, abs=4 * float(rows[6]["sd_pan"]))
    Path("other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(DatasetError, match="no history of checks"):
        append_to_log(Path("other.csv"), ic.check_calibration(calibration, views(rig, 13)), "x")
    assert Path("other.csv").read_text() == "a,b\n1,2\n"


@pytest.mark.slow
def test_rigs_that_stand_raise_as_many_alarms_as_stated() -> None:
    """30 trials on five rigs; benchmarks/check.py has more."""
    alarms = 0
    for seed in range(5):
        rig = build_rig("bar6", seed=seed, lens_error=0.5)
        known = simulate(rig, random_positions(rig, 60, np.random.default_rng(seed)), seed=seed)
        calibration = ic.ForwardGP().fit(known)
        alarms += sum(not ic.check_calibration(calibration, views(rig, 1000 + 20 * seed + k)).holds for k in range(6))
    assert alarms <= 6  # 5 % of 30, and more than three standard deviations
