"""The guided session without its page: every way through it, on simulated hardware that can fail."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest

import implicam as ic
from implicam import load_calibration, read_dataset
from implicam.active import Step
from implicam.detect import Ball, Detected
from implicam.errors import FitError, HardwareError, ImplicamError, UsageError
from implicam.hardware import Person
from implicam.session import Session
from implicam.session.controller import CALIBRATION_FILE, REPORT_FILE, Equipment, SessionController, find_suspects
from implicam.session.setup import Setup, open_session, with_options

pytestmark = pytest.mark.usefixtures("looks_kept")

SETUP = Setup(rig="stereo", budget=12, speed=1e6)


@pytest.fixture
def controller(tmp_path: Path) -> Iterator[SessionController]:
    with open_session(tmp_path / "session", SETUP) as made:
        made.start()
        yield made


@pytest.fixture(scope="module")
def ten_points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a session that was closed after ten points, to be copied."""
    folder = tmp_path_factory.mktemp("ten") / "session"
    with open_session(folder, SETUP) as made:
        made.start()
        measured(made, 10)
    return folder


@pytest.fixture
def after_ten(ten_points: Path, tmp_path: Path) -> Iterator[SessionController]:
    with open_session(Path(shutil.copytree(ten_points, tmp_path / "ten")), None) as again:
        again.start()
        assert again.loop.points == 10
        yield again


def measured(controller: SessionController, points: int) -> SessionController:
    for _ in range(points):
        controller.go()
        controller.accept()
    return controller


@pytest.mark.slow
def test_a_session_from_start_to_report(controller: SessionController) -> None:
    phases = [controller.state.phase]
    for i in range(1, 13):
        assert controller.state.target is not None
        assert controller.state.message.startswith(f"point {i}")
        controller.go()
        phases.append(controller.state.phase)
        assert controller.state.cameras_with_ball == ["cam1", "cam2"]
        assert np.allclose(controller.state.position, controller.state.target.xyz)
        controller.accept()
        assert controller.session.data is not None
        assert len(controller.session.data) == i == controller.state.history[-1].points
    assert set(phases) == {"aim", "shown"}
    assert controller.state.stop == "all 12 points of the budget are measured"
    saved = controller.finish()
    assert controller.state.phase == "done"
    assert saved == controller.session.folder / CALIBRATION_FILE
    calibration = load_calibration(saved)
    assert len(calibration.data) == 12
    assert (controller.session.folder / REPORT_FILE).stat().st_size > 10_000
    on_disk = read_dataset(controller.session.folder)
    assert np.array_equal(on_disk.xyz, calibration.data.xyz)
    pictures = sorted(path.name for path in (controller.session.folder / "images" / "cam1").iterdir())
    assert pictures == [f"p{i:03d}.png" for i in range(1, 13)]


@pytest.mark.slow
def test_the_reticle_is_where_the_ball_will_be(after_ten: SessionController) -> None:
    after_ten.go()
    assert len(after_ten.state.looks) == 2
    for look in after_ten.state.looks:
        assert np.linalg.norm(look.uv - look.expected) < 5


@pytest.mark.slow
def test_the_live_ball_is_measured(controller: SessionController, after_ten: SessionController) -> None:
    assert np.isnan(controller.measured_live).all()  # nothing is known yet
    after_ten.go()
    after_ten.live()
    assert np.linalg.norm(after_ten.measured_live - after_ten.equipment.robot.position()) < 2


def test_a_covered_camera_costs_one_view(controller: SessionController) -> None:
    controller.equipment.cameras[0].cover()  # type: ignore[attr-defined]
    controller.go()
    assert controller.state.cameras_with_ball == ["cam2"]
    assert controller.state.looks[0].found.reason.startswith("no ball")
    controller.accept()
    assert controller.session.data is not None
    assert controller.session.data.observations.seen.tolist() == [[False, True]]


def test_a_ball_that_nobody_finds_cannot_be_accepted(controller: SessionController) -> None:
    for camera in controller.equipment.cameras:
        camera.cover()  # type: ignore[attr-defined]
    controller.go()
    assert controller.state.phase == "shown"
    assert "not found in any camera" in controller.state.message
    with pytest.raises(UsageError):
        controller.accept()
    assert controller.state.phase == "shown"
    controller.redo()
    assert controller.state.cameras_with_ball == ["cam1", "cam2"]
    controller.accept()
    assert controller.loop.points == 1


def test_a_skipped_target_is_remembered_and_not_asked_for_again(controller: SessionController) -> None:
    first = controller.state.target
    assert first is not None
    controller.skip("the arm is in the way")
    assert controller.state.target is not None
    assert not np.array_equal(controller.state.target.xyz, first.xyz)
    (skipped,) = controller.session.skipped
    assert skipped.reason == "the arm is in the way"
    assert np.array_equal(skipped.xyz, first.xyz)


def test_a_skipped_target_stays_skipped_after_a_restart(tmp_path: Path) -> None:
    with open_session(tmp_path / "s", SETUP) as controller:
        controller.start()
        first = controller.state.target
        controller.skip("the arm is in the way")
        second = controller.state.target
    with open_session(tmp_path / "s", None) as again:
        again.start()
        assert first is not None
        assert second is not None
        assert again.state.target is not None
        assert np.array_equal(again.state.target.xyz, second.xyz)


def test_a_library_that_fails_in_its_own_way_does_not_end_the_session(controller: SessionController) -> None:
    class Broken:
        def detect(self, picture: Any, view: Any) -> Detected:
            raise ZeroDivisionError("in somebody's code")

    whole = controller.equipment
    controller.equipment = replace(whole, detector=Broken())  # type: ignore[arg-type]
    controller.go()
    assert controller.state.phase == "trouble"
    assert "ZeroDivisionError" in controller.state.message
    (unexpected,) = (event for event in controller.session.events if event.what == "unexpected")
    assert "in somebody's code" in unexpected.more["traceback"]
    controller.retry()
    controller.live()
    assert controller.state.phase == "trouble"
    controller.equipment = whole
    controller.retry()
    measured(controller, 1)
    assert controller.loop.points == 1


@pytest.mark.slow
def test_undo_takes_back_the_last_point_only(controller: SessionController) -> None:
    measured(controller, 9)
    assert controller.state.calibration is not None
    assert controller.undo() == "p009"
    assert [step.points for step in controller.state.history] == list(range(1, 9))
    assert controller.state.message.startswith("point p009 is taken back. point 9")
    assert controller.state.target is not None
    assert controller.state.target.name == "p010"  # a name is never used twice
    for _ in range(8):
        controller.undo()
    assert controller.undo() is None
    assert controller.session.data is None
    assert controller.state.phase == "aim"


@pytest.mark.slow
def test_any_point_can_be_taken_back_or_measured_again(after_ten: SessionController) -> None:
    before = after_ten.session.data
    assert before is not None
    after_ten.remove("p006")
    assert after_ten.state.message.startswith("point p006 is taken back. point 10")
    after_ten.remove("p007", again=True)
    assert after_ten.session.data is not None
    left = [name for name in before.points.tolist() if name not in ("p006", "p007")]
    assert after_ten.session.data.points.tolist() == left
    assert after_ten.state.data is not None
    assert len(after_ten.state.data) == 8
    target = after_ten.state.target
    assert target is not None
    assert (target.name, target.xyz.tolist()) == ("p011", before.xyz[6].tolist())
    assert (
        np.nanmax(np.abs(target.uv - before.observations.uv[6])) < 10
    )  # the outline's middle, and a calibration of eight points
    with pytest.raises(UsageError, match="no point 'p006'"):
        after_ten.remove("p006")
    assert after_ten.state.phase == "aim"


@pytest.mark.slow
@pytest.mark.parametrize("part", ["camera", "robot"])
def test_trouble_is_shown_and_the_session_waits(controller: SessionController, part: str) -> None:
    measured(controller, 3)
    controller.set_auto(True)
    if part == "camera":
        controller.equipment.cameras[1].fail_for(1)  # type: ignore[attr-defined]
    else:
        controller.equipment.robot.fail_next_move()  # type: ignore[attr-defined]
    controller.go()
    state = controller.state
    assert state.phase == "trouble"
    assert state.problem is not None
    assert state.problem.fix
    assert not state.auto
    assert controller.loop.points == 3
    assert controller.session.events[-1].what == "trouble"
    with pytest.raises(UsageError):
        controller.accept()
    controller.retry()
    assert controller.state.phase == "aim"
    assert controller.state.problem is None
    measured(controller, 1)
    assert controller.loop.points == 4


def test_the_robot_stops_at_once_from_another_thread(tmp_path: Path) -> None:
    with open_session(tmp_path / "slow", replace(SETUP, speed=0.001)) as controller:
        controller.start()
        going = Thread(target=controller.go)
        going.start()
        while controller.state.phase != "moving":
            time.sleep(0.01)
        time.sleep(0.1)
        controller.stop_robot()
        going.join(timeout=60)
        assert not going.is_alive()
        assert controller.state.phase == "trouble"
        assert "stopped" in controller.state.message


def test_nothing_moves_after_stop_until_somebody_says_go(controller: SessionController) -> None:
    controller.set_auto(True)
    controller.stop_robot()
    assert not controller.state.auto
    before = controller.equipment.robot.position()
    controller.step()
    assert controller.state.phase == "trouble"
    assert "stopped by hand" in controller.state.message
    assert np.array_equal(controller.equipment.robot.position(), before)
    controller.retry()
    controller.go()
    assert controller.state.phase == "shown"


def test_a_stop_while_pictures_are_taken_leaves_the_point_to_a_person(
    controller: SessionController, monkeypatch: pytest.MonkeyPatch
) -> None:
    take = controller._take_pictures

    def stopped_meanwhile(where: Any, **more: Any) -> None:
        controller.stop_robot()
        assert controller.state.stopped
        take(where, **more)

    monkeypatch.setattr(controller, "_take_pictures", stopped_meanwhile)
    controller.set_auto(True)
    controller.step()
    assert (controller.state.phase, controller.state.auto, controller.loop.points) == ("shown", False, 0)
    controller.accept()
    assert (controller.loop.points, controller.state.stopped) == (1, True)
    monkeypatch.undo()
    controller.go()
    assert not controller.state.stopped


def test_a_known_point_that_is_elsewhere_is_named_with_how_far() -> None:
    right = ic.simulated("stereo", points=14, seed=3)
    assert find_suspects(ic.ForwardGP().fit(right), right) == ()
    xyz = right.xyz.copy()
    xyz[2] += [0, 0, 60.0]  # a block too many under it
    wrong = replace(right, known=replace(right.positions, xyz=xyz))
    ((name, far),) = find_suspects(ic.ForwardGP().fit(wrong), wrong)
    assert (name, round(far)) == (right.points[2], 60)
    assert find_suspects(None, wrong) == ()


def test_a_stop_that_fails_still_ends_what_goes_by_itself(
    controller: SessionController, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost() -> None:
        raise HardwareError("the connection is lost.")

    controller.set_auto(True)
    monkeypatch.setattr(controller.equipment.robot, "stop", lost)
    with pytest.raises(HardwareError):
        controller.stop_robot()
    assert not controller.state.auto


@pytest.mark.slow
def test_a_robot_that_never_shows_the_ball_gives_up(controller: SessionController) -> None:
    for camera in controller.equipment.cameras:
        camera.cover(100)  # type: ignore[attr-defined]
    controller.set_auto(True)
    for _ in range(20):
        if controller.state.auto:
            controller.step()
    assert controller.state.phase == "trouble"
    assert "5 targets in a row" in controller.state.message
    assert len(controller.session.skipped) == 4


def test_only_what_moves_alone_goes_by_itself(controller: SessionController) -> None:
    whole = controller.equipment
    for other in (replace(whole, robot=Person(lambda wish: None)), replace(whole, dry_run=True)):
        controller.equipment = other
        with pytest.raises(UsageError, match="by itself"):
            controller.set_auto(True)
    controller.equipment = replace(whole, robot=Person(lambda wish: None))
    with pytest.raises(UsageError, match="but you"):
        controller.go()
    controller.equipment = replace(whole, dry_run=True)
    controller.go()
    with pytest.raises(UsageError, match="dry run"):
        controller.accept()
    assert controller.session.data is None


def test_a_full_disk_is_trouble_and_not_the_end(controller: SessionController, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*words: Any, **more: Any) -> None:
        raise ImplicamError("cannot write session.db.", why="no space left on device")

    controller.go()
    with monkeypatch.context() as broken:
        broken.setattr(controller.session, "accept", full)
        broken.setattr(controller.session, "log", full)
        controller.accept()
        assert controller.state.phase == "trouble"
        assert "no space left" in controller.state.message
    controller.retry()
    measured(controller, 1)


def test_a_camera_that_fails_is_left_alone_until_all_have_answered(controller: SessionController) -> None:
    """A camera answers one thread at a time, also when another one fails meanwhile."""
    busy, most = 0, 0
    slow = controller.equipment.cameras[1]
    plain = slow.frame

    def frame(timeout: float = 5.0) -> Any:
        nonlocal busy, most
        busy += 1
        most = max(most, busy)
        time.sleep(0.3)
        busy -= 1
        return plain(timeout)

    slow.frame = frame  # type: ignore[method-assign]
    controller.equipment.cameras[0].fail_for(1)  # type: ignore[attr-defined]
    controller.go()
    assert controller.state.phase == "trouble"
    controller.retry()
    controller.go()
    assert most == 1


class Waits:
    """A camera that exposes when its trigger fires, and a box that fires it."""

    live = False

    def __init__(self, camera: Any) -> None:
        self.name, self._camera, self._fired = camera.name, camera, Event()

    def open(self) -> None: ...
    def close(self) -> None: ...

    def fire(self) -> None:
        self._fired.set()

    def frame(self, timeout: float = 5.0) -> Any:
        if not self._fired.wait(timeout):
            raise HardwareError(f"camera {self.name}: no picture within {timeout} s.")
        self._fired.clear()
        return self._camera.frame(timeout)


def test_triggered_cameras_are_asked_only_when_the_trigger_fires(controller: SessionController) -> None:
    class Box:
        def open(self) -> None: ...
        def close(self) -> None: ...

        def fire(self) -> None:
            for eye in eyes:
                eye.fire()

    eyes = [Waits(camera) for camera in controller.equipment.cameras]
    equipment = replace(controller.equipment, cameras=eyes, trigger=Box(), timeout=2.0)
    triggered = SessionController(controller.session, equipment, controller.loop)
    triggered.start()
    triggered.live()
    assert triggered.state.phase == "aim"
    triggered.go()
    assert triggered.state.cameras_with_ball == ["cam1", "cam2"]


@pytest.mark.slow
def test_a_session_goes_on_where_it_was(tmp_path: Path) -> None:
    with open_session(tmp_path / "s", SETUP) as controller:
        controller.start()
        measured(controller, 9)
        step, target = controller.state.history[-1], controller.state.target
    assert target is not None
    with open_session(tmp_path / "s", None) as again:
        again.start()
        assert again.loop.points == 9
        assert again.state.history[-1].usual == pytest.approx(step.usual, rel=0.05)
        assert again.state.target is not None
        assert again.state.target.name == target.name == "p010"
        assert [step.points for step in again.state.history] == list(range(1, 10))


def test_two_sessions_on_one_folder_are_refused(controller: SessionController) -> None:
    with pytest.raises(UsageError, match="open"):
        open_session(controller.session.folder, None)
    measured(controller, 1)  # and the first one does not mind


def test_another_rig_is_refused_and_another_budget_is_not(tmp_path: Path) -> None:
    open_session(tmp_path / "s", SETUP).close()
    with pytest.raises(UsageError, match="rig"):
        open_session(tmp_path / "s", with_options(SETUP, rig="bar6"))
    with pytest.raises(UsageError, match="cameras"):
        open_session(tmp_path / "s", with_options(SETUP, cameras=(("a", "0"),)))
    with pytest.raises(UsageError, match="workspace"):
        open_session(tmp_path / "s", with_options(SETUP, workspace="garbage"))
    open_session(tmp_path / "s", None).close()  # what was refused was not kept
    with open_session(tmp_path / "s", with_options(SETUP, budget=20)):
        pass
    with Session.open(tmp_path / "s") as session:
        assert Setup.from_settings(session.settings) == with_options(SETUP, budget=20)


@pytest.mark.slow
def test_by_itself_until_the_rule_says_stop(tmp_path: Path) -> None:
    with open_session(tmp_path / "s", replace(SETUP, below=1.0, budget=30)) as controller:
        controller.equipment.cameras[0].cover(1)  # type: ignore[attr-defined]
        controller.equipment.cameras[1].cover(1)  # type: ignore[attr-defined]
        path = controller.run()
        assert path is not None
        assert controller.state.stop.endswith("everywhere")
        assert controller.state.history[-1].worst <= 1.0
        assert [skipped.reason for skipped in controller.session.skipped] == ["the ball was not found"]


@pytest.mark.slow
def test_finishing_too_early_says_how_many_are_missing(controller: SessionController) -> None:
    measured(controller, 3)
    with pytest.raises(UsageError, match="too few") as error:
        controller.finish()
    assert "at least 8" in error.value.fix
    assert controller.state.phase == "aim"


@pytest.mark.slow
def test_a_fit_that_fails_at_the_end_is_trouble(controller: SessionController, monkeypatch: pytest.MonkeyPatch) -> None:
    measured(controller, 8)

    def fails(*words: Any) -> None:
        raise FitError("the known points do not fix the rig.")

    with monkeypatch.context() as broken:
        broken.setattr(type(controller.loop.calibrator), "fit", fails)
        controller.finish()
        assert controller.state.phase == "trouble"
    controller.retry()
    assert controller.finish().exists()


def test_a_person_types_where_the_ball_is(tmp_path: Path) -> None:
    """A person is the robot, and the simulated robot holds the ball that the cameras see."""
    with open_session(tmp_path / "s", SETUP) as made:
        hand, person = made.equipment.robot, Person(lambda wish: None, sd=(0.5, 0.5, 0.5))
        controller = SessionController(made.session, replace(made.equipment, robot=person), made.loop)
        controller.start()
        assert "type where it is" in controller.state.message
        assert controller.state.target is not None
        assert (controller.state.target.xyz % 1 == 0).all()  # as somebody with a ruler wants it
        xyz = hand.move(controller.state.target.xyz + np.array([3.0, -2.0, 1.0]))
        controller.report_position(xyz)
        assert controller.state.phase == "shown"
        controller.accept()
        data = controller.session.data
        assert data is not None
        assert data.xyz.tolist() == [xyz.tolist()]
        assert (data.positions.sd == 0.5).all()


@dataclass(frozen=True)
class SeesALamp:
    """The detector of balls, but in one camera a lamp far away looks more like one."""

    found: Ball
    camera: str

    def options(self) -> dict[str, Any]:
        return self.found.options()

    def detect(self, picture: Any, view: Any) -> Detected:
        ball = self.found.detect(picture, view)
        if view.camera != self.camera or not len(ball):
            return ball
        return replace(ball, uv=np.array([[40.0, 50.0]]), others=(replace(ball, others=()),) if self.keeps else ())

    def settle(self, found: Any) -> Any:
        return found

    keeps: bool = True


@pytest.mark.parametrize("keeps", [True, False])
def test_another_thing_is_not_taken_for_the_ball(after_ten: SessionController, keeps: bool) -> None:
    controller = after_ten
    lamp = SeesALamp(Ball(), "cam2", keeps)
    controller.equipment = replace(controller.equipment, detector=lamp)
    assert isinstance(controller.equipment, Equipment)
    controller.go()
    look = controller.state.looks[1]
    if keeps:  # the ball was second: it is where it must be
        assert np.linalg.norm(look.uv - look.expected) < 5
    else:
        assert controller.state.cameras_with_ball == ["cam1"]
        assert "px from where the ball must be" in look.found.reason


def test_setups_that_cannot_be_say_why() -> None:
    for wrong in (
        {"unit": "furlong"},
        {"method": "mlp"},
        {"acquisition": "best"},
        {"below": -1.0},
        {"reach": 0.0},
        {"budget": 5},
    ):
        with pytest.raises(UsageError) as error:
            Setup(**wrong)  # type: ignore[arg-type]
        assert error.value.fix
    assert Setup.from_settings({**SETUP.as_settings(), "of a newer version": 1}) == SETUP


def test_a_session_stops_when_it_has_converged_or_the_time_is_over() -> None:
    """The rules of the command line, each by its own words."""
    steady = [Step(8 + i, 2.0, 1.5, 1.0 + 0.001 * i, 3.0, 1.0, 10.0 * i) for i in range(8)]
    assert Setup(rig="stereo", converged=5).rule.met(steady).startswith("the last 5 points changed it by")
    assert Setup(rig="stereo", converged=0.1).rule.met(steady) == ""
    assert Setup(rig="stereo", minutes=1).rule.met(steady) == "70 s have passed"
    assert Setup(rig="stereo", minutes=2).rule.met(steady) == ""
    for wrong in ({"minutes": 0}, {"converged": -1.0}):
        with pytest.raises(UsageError, match="is not possible"):
            Setup(**wrong)
