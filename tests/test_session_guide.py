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

from implicam import load_calibration, read_dataset
from implicam.detect import Ball, Detected
from implicam.errors import FitError, HardwareError, ImplicamError, UsageError
from implicam.hardware import Person
from implicam.session import Session
from implicam.session.guide import CALIBRATION, REPORT, Equipment, Guide
from implicam.session.setup import Setup, changed, open_guide

SETUP = Setup(rig="stereo", budget=12, speed=1e6)


@pytest.fixture
def guide(tmp_path: Path) -> Iterator[Guide]:
    with open_guide(tmp_path / "session", SETUP) as made:
        made.start()
        yield made


@pytest.fixture(scope="module")
def ten_points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a session that was closed after ten points, to be copied."""
    folder = tmp_path_factory.mktemp("ten") / "session"
    with open_guide(folder, SETUP) as made:
        made.start()
        measured(made, 10)
    return folder


@pytest.fixture
def after_ten(ten_points: Path, tmp_path: Path) -> Iterator[Guide]:
    with open_guide(Path(shutil.copytree(ten_points, tmp_path / "ten")), None) as again:
        again.start()
        assert again.loop.points == 10
        yield again


def measured(guide: Guide, points: int) -> Guide:
    for _ in range(points):
        guide.go()
        guide.accept()
    return guide


def test_a_session_from_start_to_report(guide: Guide) -> None:
    phases = [guide.state.phase]
    for i in range(1, 13):
        assert guide.state.target is not None
        assert guide.state.message.startswith(f"point {i}")
        guide.go()
        phases.append(guide.state.phase)
        assert guide.state.seen == ["cam1", "cam2"]
        assert np.allclose(guide.state.position, guide.state.target.xyz)
        guide.accept()
        assert guide.session.data is not None
        assert len(guide.session.data) == i == guide.state.history[-1].points
    assert set(phases) == {"aim", "shown"}
    assert guide.state.stop == "all 12 points of the budget are measured"
    saved = guide.finish()
    assert guide.state.phase == "done"
    assert saved == guide.session.folder / CALIBRATION
    calibration = load_calibration(saved)
    assert len(calibration.data) == 12
    assert (guide.session.folder / REPORT).stat().st_size > 10_000
    on_disk = read_dataset(guide.session.folder)
    assert np.array_equal(on_disk.xyz, calibration.data.xyz)
    pictures = sorted(path.name for path in (guide.session.folder / "images" / "cam1").iterdir())
    assert pictures == [f"p{i:03d}.png" for i in range(1, 13)]


def test_the_reticle_is_where_the_ball_will_be(after_ten: Guide) -> None:
    after_ten.go()
    assert len(after_ten.state.looks) == 2
    for look in after_ten.state.looks:
        assert np.linalg.norm(look.uv - look.expected) < 5


def test_the_live_ball_is_measured(guide: Guide, after_ten: Guide) -> None:
    assert np.isnan(guide.measured_live).all()  # nothing is known yet
    after_ten.go()
    after_ten.live()
    assert np.linalg.norm(after_ten.measured_live - after_ten.equipment.robot.position()) < 2


def test_a_covered_camera_costs_one_view(guide: Guide) -> None:
    guide.equipment.cameras[0].cover()  # type: ignore[attr-defined]
    guide.go()
    assert guide.state.seen == ["cam2"]
    assert guide.state.looks[0].found.reason.startswith("no ball")
    guide.accept()
    assert guide.session.data is not None
    assert guide.session.data.observations.seen.tolist() == [[False, True]]


def test_a_ball_that_nobody_finds_cannot_be_accepted(guide: Guide) -> None:
    for camera in guide.equipment.cameras:
        camera.cover()  # type: ignore[attr-defined]
    guide.go()
    assert guide.state.phase == "shown"
    assert "not found in any camera" in guide.state.message
    with pytest.raises(UsageError):
        guide.accept()
    assert guide.state.phase == "shown"
    guide.redo()
    assert guide.state.seen == ["cam1", "cam2"]
    guide.accept()
    assert guide.loop.points == 1


def test_a_skipped_target_is_remembered_and_not_asked_for_again(guide: Guide) -> None:
    first = guide.state.target
    assert first is not None
    guide.skip("the arm is in the way")
    assert guide.state.target is not None
    assert not np.array_equal(guide.state.target.xyz, first.xyz)
    (skipped,) = guide.session.skipped
    assert skipped.reason == "the arm is in the way"
    assert np.array_equal(skipped.xyz, first.xyz)


def test_a_skipped_target_stays_skipped_after_a_restart(tmp_path: Path) -> None:
    with open_guide(tmp_path / "s", SETUP) as guide:
        guide.start()
        first = guide.state.target
        guide.skip("the arm is in the way")
        second = guide.state.target
    with open_guide(tmp_path / "s", None) as again:
        again.start()
        assert first is not None
        assert second is not None
        assert again.state.target is not None
        assert np.array_equal(again.state.target.xyz, second.xyz)


def test_a_library_that_fails_in_its_own_way_does_not_end_the_session(guide: Guide) -> None:
    class Broken:
        def detect(self, picture: Any, view: Any) -> Detected:
            raise ZeroDivisionError("in somebody's code")

    whole = guide.equipment
    guide.equipment = replace(whole, detector=Broken())  # type: ignore[arg-type]
    guide.go()
    assert guide.state.phase == "trouble"
    assert "ZeroDivisionError" in guide.state.message
    (unexpected,) = (event for event in guide.session.events if event.what == "unexpected")
    assert "in somebody's code" in unexpected.more["traceback"]
    guide.retry()
    guide.live()
    assert guide.state.phase == "trouble"
    guide.equipment = whole
    guide.retry()
    measured(guide, 1)
    assert guide.loop.points == 1


def test_undo_takes_back_the_last_point_only(guide: Guide) -> None:
    measured(guide, 9)
    assert guide.state.calibration is not None
    assert guide.undo() == "p009"
    assert [step.points for step in guide.state.history] == list(range(1, 9))
    assert guide.state.message.startswith("point p009 is taken back. point 9")
    assert guide.state.target is not None
    assert guide.state.target.name == "p010"  # a name is never used twice
    for _ in range(8):
        guide.undo()
    assert guide.undo() is None
    assert guide.session.data is None
    assert guide.state.phase == "aim"


@pytest.mark.parametrize("part", ["camera", "robot"])
def test_trouble_is_shown_and_the_session_waits(guide: Guide, part: str) -> None:
    measured(guide, 3)
    guide.set_auto(True)
    if part == "camera":
        guide.equipment.cameras[1].fail_for(1)  # type: ignore[attr-defined]
    else:
        guide.equipment.robot.fail_next_move()  # type: ignore[attr-defined]
    guide.go()
    state = guide.state
    assert state.phase == "trouble"
    assert state.problem is not None
    assert state.problem.fix
    assert not state.auto
    assert guide.loop.points == 3
    assert guide.session.events[-1].what == "trouble"
    with pytest.raises(UsageError):
        guide.accept()
    guide.retry()
    assert guide.state.phase == "aim"
    assert guide.state.problem is None
    measured(guide, 1)
    assert guide.loop.points == 4


def test_the_robot_stops_at_once_from_another_thread(tmp_path: Path) -> None:
    with open_guide(tmp_path / "slow", replace(SETUP, speed=0.001)) as guide:
        guide.start()
        going = Thread(target=guide.go)
        going.start()
        while guide.state.phase != "moving":
            time.sleep(0.01)
        time.sleep(0.1)
        guide.stop_robot()
        going.join(timeout=10)
        assert not going.is_alive()
        assert guide.state.phase == "trouble"
        assert "stopped" in guide.state.message


def test_nothing_moves_after_stop_until_somebody_says_go(guide: Guide) -> None:
    guide.set_auto(True)
    guide.stop_robot()
    assert not guide.state.auto
    before = guide.equipment.robot.position()
    guide.step()
    assert guide.state.phase == "trouble"
    assert "stopped by hand" in guide.state.message
    assert np.array_equal(guide.equipment.robot.position(), before)
    guide.retry()
    guide.go()
    assert guide.state.phase == "shown"


def test_a_stop_that_fails_still_ends_what_goes_by_itself(guide: Guide, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost() -> None:
        raise HardwareError("the connection is lost.")

    guide.set_auto(True)
    monkeypatch.setattr(guide.equipment.robot, "stop", lost)
    with pytest.raises(HardwareError):
        guide.stop_robot()
    assert not guide.state.auto


def test_a_robot_that_never_shows_the_ball_gives_up(guide: Guide) -> None:
    for camera in guide.equipment.cameras:
        camera.cover(100)  # type: ignore[attr-defined]
    guide.set_auto(True)
    for _ in range(20):
        if guide.state.auto:
            guide.step()
    assert guide.state.phase == "trouble"
    assert "5 targets in a row" in guide.state.message
    assert len(guide.session.skipped) == 4


def test_only_what_moves_alone_goes_by_itself(guide: Guide) -> None:
    whole = guide.equipment
    for other in (replace(whole, robot=Person(lambda wish: None)), replace(whole, dry_run=True)):
        guide.equipment = other
        with pytest.raises(UsageError, match="by itself"):
            guide.set_auto(True)
    guide.equipment = replace(whole, robot=Person(lambda wish: None))
    with pytest.raises(UsageError, match="but you"):
        guide.go()
    guide.equipment = replace(whole, dry_run=True)
    guide.go()
    with pytest.raises(UsageError, match="dry run"):
        guide.accept()
    assert guide.session.data is None


def test_a_full_disk_is_trouble_and_not_the_end(guide: Guide, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*words: Any, **more: Any) -> None:
        raise ImplicamError("cannot write session.db.", why="no space left on device")

    guide.go()
    with monkeypatch.context() as broken:
        broken.setattr(guide.session, "accept", full)
        broken.setattr(guide.session, "log", full)
        guide.accept()
        assert guide.state.phase == "trouble"
        assert "no space left" in guide.state.message
    guide.retry()
    measured(guide, 1)


def test_a_camera_that_fails_is_left_alone_until_all_have_answered(guide: Guide) -> None:
    """A camera answers one thread at a time, also when another one fails meanwhile."""
    busy, most = 0, 0
    slow = guide.equipment.cameras[1]
    plain = slow.frame

    def frame(timeout: float = 5.0) -> Any:
        nonlocal busy, most
        busy += 1
        most = max(most, busy)
        time.sleep(0.3)
        busy -= 1
        return plain(timeout)

    slow.frame = frame  # type: ignore[method-assign]
    guide.equipment.cameras[0].fail_for(1)  # type: ignore[attr-defined]
    guide.go()
    assert guide.state.phase == "trouble"
    guide.retry()
    guide.go()
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


def test_triggered_cameras_are_asked_only_when_the_trigger_fires(guide: Guide) -> None:
    class Box:
        def open(self) -> None: ...
        def close(self) -> None: ...

        def fire(self) -> None:
            for eye in eyes:
                eye.fire()

    eyes = [Waits(camera) for camera in guide.equipment.cameras]
    equipment = replace(guide.equipment, cameras=eyes, trigger=Box(), timeout=2.0)
    triggered = Guide(guide.session, equipment, guide.loop)
    triggered.start()
    triggered.live()
    assert triggered.state.phase == "aim"
    triggered.go()
    assert triggered.state.seen == ["cam1", "cam2"]


def test_a_session_goes_on_where_it_was(tmp_path: Path) -> None:
    with open_guide(tmp_path / "s", SETUP) as guide:
        guide.start()
        measured(guide, 9)
        step, target = guide.state.history[-1], guide.state.target
    assert target is not None
    with open_guide(tmp_path / "s", None) as again:
        again.start()
        assert again.loop.points == 9
        assert again.state.history[-1].usual == pytest.approx(step.usual, rel=0.05)
        assert again.state.target is not None
        assert again.state.target.name == target.name == "p010"
        assert [step.points for step in again.state.history] == list(range(1, 10))


def test_two_sessions_on_one_folder_are_refused(guide: Guide) -> None:
    with pytest.raises(UsageError, match="open"):
        open_guide(guide.session.folder, None)
    measured(guide, 1)  # and the first one does not mind


def test_another_rig_is_refused_and_another_budget_is_not(tmp_path: Path) -> None:
    open_guide(tmp_path / "s", SETUP).close()
    with pytest.raises(UsageError, match="rig"):
        open_guide(tmp_path / "s", changed(SETUP, rig="bar6"))
    with pytest.raises(UsageError, match="cameras"):
        open_guide(tmp_path / "s", changed(SETUP, cameras=(("a", "0"),)))
    with pytest.raises(UsageError, match="workspace"):
        open_guide(tmp_path / "s", changed(SETUP, workspace="garbage"))
    open_guide(tmp_path / "s", None).close()  # what was refused was not kept
    with open_guide(tmp_path / "s", changed(SETUP, budget=20)):
        pass
    with Session.open(tmp_path / "s") as session:
        assert Setup.from_settings(session.settings) == changed(SETUP, budget=20)


def test_by_itself_until_the_rule_says_stop(tmp_path: Path) -> None:
    with open_guide(tmp_path / "s", replace(SETUP, below=1.0, budget=30)) as guide:
        guide.equipment.cameras[0].cover(1)  # type: ignore[attr-defined]
        guide.equipment.cameras[1].cover(1)  # type: ignore[attr-defined]
        path = guide.run()
        assert path is not None
        assert guide.state.stop.endswith("everywhere")
        assert guide.state.history[-1].worst <= 1.0
        assert [skipped.reason for skipped in guide.session.skipped] == ["the ball was not found"]


def test_finishing_too_early_says_how_many_are_missing(guide: Guide) -> None:
    measured(guide, 3)
    with pytest.raises(UsageError, match="too few") as error:
        guide.finish()
    assert "at least 8" in error.value.fix
    assert guide.state.phase == "aim"


def test_a_fit_that_fails_at_the_end_is_trouble(guide: Guide, monkeypatch: pytest.MonkeyPatch) -> None:
    measured(guide, 8)

    def fails(*words: Any) -> None:
        raise FitError("the known points do not fix the rig.")

    with monkeypatch.context() as broken:
        broken.setattr(type(guide.loop.calibrator), "fit", fails)
        guide.finish()
        assert guide.state.phase == "trouble"
    guide.retry()
    assert guide.finish().exists()


def test_a_person_types_where_the_ball_is(tmp_path: Path) -> None:
    """A person is the robot, and the simulated robot holds the ball that the cameras see."""
    with open_guide(tmp_path / "s", SETUP) as made:
        hand, person = made.equipment.robot, Person(lambda wish: None, sd=(0.5, 0.5, 0.5))
        guide = Guide(made.session, replace(made.equipment, robot=person), made.loop)
        guide.start()
        assert "type where it is" in guide.state.message
        assert guide.state.target is not None
        xyz = hand.move(guide.state.target.xyz + np.array([3.0, -2.0, 1.0]))
        guide.arrived(xyz)
        assert guide.state.phase == "shown"
        guide.accept()
        data = guide.session.data
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
def test_another_thing_is_not_taken_for_the_ball(after_ten: Guide, keeps: bool) -> None:
    guide = after_ten
    lamp = SeesALamp(Ball(), "cam2", keeps)
    guide.equipment = replace(guide.equipment, detector=lamp)
    assert isinstance(guide.equipment, Equipment)
    guide.go()
    look = guide.state.looks[1]
    if keeps:  # the ball was second: it is where it must be
        assert np.linalg.norm(look.uv - look.expected) < 5
    else:
        assert guide.state.seen == ["cam1"]
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
