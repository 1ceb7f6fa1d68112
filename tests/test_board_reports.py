"""Sessions with boards in situations of public bug reports, rebuilt small: what the person beside the rig is told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from implicam.detect import Charuco, Detected
from implicam.errors import UsageError
from implicam.geometry import Pose, rotation_from_vector
from implicam.hardware import Frame
from implicam.hardware.simulated_hand import print_of
from implicam.session.board_session import NOT_SEEN, BoardController
from implicam.session.detections import Look
from implicam.session.setup import Setup, open_session
from implicam.viewer.board_words import headline


def session(folder: Path, **options: Any) -> BoardController:
    made = open_session(folder, Setup(**{"rig": "stereo", "target": "charuco", **options}))
    assert isinstance(made, BoardController)
    made._background = False
    made._hand.seconds = 0.0
    return made


def told(controller: BoardController) -> str:
    """What the page says after a look at the live pictures."""
    controller.live()
    assert controller.state.judgement.reason == NOT_SEEN
    return headline(controller.state).detail


@pytest.mark.slow
def test_a_board_printed_before_opencv_4_6_is_named(tmp_path):
    """opencv_contrib #3291: boards with an even number of rows have another pattern since 4.6."""
    with session(tmp_path / "s", board="8x12", square=13.29, marker=10.0) as controller:
        controller.start()
        hand = controller._hand
        hand.target = Charuco(8, 12, 13.29, 10.0, legacy=True).describe()
        hand.marks = print_of(hand.target)
        assert "--legacy for one printed with OpenCV before 4.6" in told(controller)
    with session(tmp_path / "right", board="8x12", square=13.29, marker=10.0, legacy=True) as controller:
        controller.start()
        controller.live()
        assert len(controller.state.looks[0].found) > 40


@pytest.mark.slow
def test_mirrored_pictures_are_named(tmp_path):
    """April-Tag-VR-FullBody-Tracker #144: a webcam that mirrors, and who stands there is told that nothing is found."""
    with session(tmp_path / "s") as controller:
        controller.start()
        taken = controller._take_frames
        controller._take_frames = lambda trigger: [  # type: ignore[method-assign]
            replace(frame, picture=np.ascontiguousarray(frame.picture[:, ::-1])) for frame in taken(trigger)
        ]
        assert "the picture is mirrored" in told(controller)


def test_a_board_that_looks_the_same_upside_down_begins_no_session(tmp_path):
    """robot_calibration #139, DeepLabCut #3239: counted from different ends in two cameras."""
    with pytest.raises(UsageError, match="looks the same upside down"):
        session(tmp_path / "s", target="checkerboard", board="8x10", square=20.0)
    with pytest.raises(UsageError, match="looks the same upside down"):
        session(tmp_path / "s", target="dots", board="10x4", spacing=20.0)
    assert not (tmp_path / "s").exists()


def test_parts_of_a_board_are_put_together_by_number(tmp_path):
    """Kalibr #261: where a corner was not seen, all later ones were taken for their neighbours."""
    with session(tmp_path / "s") as controller:
        controller.start()
        size = (1024, 1280)
        corners = controller.loop.shape.corners[:, :2]
        seen = {"cam1": np.arange(0, 60), "cam2": np.concatenate([np.arange(20, 40), np.arange(50, 88)])}
        looks = [
            Look(
                name,
                Frame(np.zeros(size, dtype=np.float32), 1, 0.0),
                Detected(
                    tuple(f"live-c{k + 1:03d}" for k in numbers),
                    corners[numbers] + 300 * c,
                    np.full((len(numbers), 2), 0.1),
                ),
                np.full(2, np.nan),
            )
            for c, (name, numbers) in enumerate(seen.items())
        ]
        shot = controller._make_shot(controller.state.target, looks, "")
        rows = {point: i for i, point in enumerate(shot.points.tolist())}
        name = controller.state.target.name
        for c, numbers in enumerate(seen.values()):
            for k in range(88):
                uv = shot.observations.uv[rows[f"{name}-c{k + 1:03d}"], c]
                expected = corners[k] + 300 * c if k in numbers else np.full(2, np.nan)
                assert np.array_equal(uv, expected, equal_nan=True)


@pytest.fixture
def on_a_robot(tmp_path):
    """After two boards, from which there is a calibration."""
    with session(tmp_path / "s", target="checkerboard", robot="simulated", speed=1000.0, sd=0.05) as controller:
        controller.start()
        controller.go()
        yield controller


@pytest.mark.slow
def test_a_board_printed_larger_is_refused_where_a_robot_knows_better(on_a_robot):
    """Anipose #45: squares of 28 mm instead of 25; by hand nothing but a ruler can tell."""
    hand = on_a_robot._hand
    hand.target = {**hand.target, "square": 28 / 25 * hand.target["square"]}
    on_a_robot.go()  # of two boards nothing is known that could contradict it
    with pytest.raises(UsageError, match="px from where this pose must be") as caught:
        on_a_robot.go()
    assert "ruler" in caught.value.fix
    assert on_a_robot.loop.points < 4


@pytest.mark.slow
def test_a_board_that_was_put_back_upside_down_is_refused(on_a_robot):
    """robot_calibration #139: turned half round in the gripper between two pictures."""
    on_a_robot.go()
    hand = on_a_robot._hand
    middle, carried = on_a_robot.loop.shape.middle, hand.carried
    turn = rotation_from_vector([0.0, 0.0, np.pi])

    def turned() -> Pose:
        pose = carried()
        return Pose(pose.rotation @ turn, pose.apply(middle) - pose.rotation @ turn @ middle)

    hand.carried = turned
    before = on_a_robot.loop.points
    with pytest.raises(UsageError, match="px from where this pose must be") as caught:
        on_a_robot.go()
    assert "--facing" in caught.value.fix
    assert on_a_robot.loop.points == before
