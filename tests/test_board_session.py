"""A board held by hand: which pose tells most, what a session keeps of it, and sessions played by a simulated hand."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import implicam as ic
from board_pictures import checkered, corners_of, photograph, rotated
from implicam.active.board_coverage import framing_of, is_new, unseen_framing, usual_pixels
from implicam.active.board_design import BoardDesign, BoardShape, PlacedBoardDesign, board_pose
from implicam.active.board_loop import BoardLoop, BoardTarget, Pictures
from implicam.active.board_poses import (
    HELD_OUT_COLUMN,
    POSE_COLUMN,
    KnownPose,
    KnownPosesLoop,
    carried_poses,
    described,
    poses_from,
    poses_of,
    turn_from,
)
from implicam.active.stopping import Step, Within
from implicam.active.volume_design import linear_views
from implicam.dataset import Camera, Dataset, KnownPositions, Observations, read_dataset
from implicam.dataset.boards import corner_positions
from implicam.detect import AprilGrid, Charuco, View
from implicam.detect.sharpness import edge_width
from implicam.errors import DatasetError, HardwareError, UsageError
from implicam.geometry import Pose, look_at, rotation_from_vector, vector_from_rotation
from implicam.hardware.simulated import SimulatedRobot
from implicam.hardware.simulated_hand import board_target, match_pose, simulated_hand
from implicam.report import words
from implicam.session import board_report
from implicam.session.board_session import BoardController, BoardState
from implicam.session.journal import TARGET_KEY, Session
from implicam.session.setup import Setup, changes_to, open_session
from implicam.simulate import build_rig, simulate, simulate_boards
from implicam.viewer.board_page import BoardPage
from implicam.viewer.board_words import CURE, headline

BOARD = {"kind": "board", "rows": 5, "columns": 8, "square": 20.0}
CHARUCO = Charuco(9, 12, 13.29, 10.0)


def shape_of(table: dict[str, Any], *, whole: bool = True) -> BoardShape:
    flat = corner_positions(table)
    return BoardShape(np.column_stack([flat, np.zeros(len(flat))]), float(table["square"]), whole)


@pytest.fixture(scope="module")
def rig() -> Any:
    return build_rig("stereo", seed=1, lens_error=0.0)


@pytest.fixture(scope="module")
def calibration() -> Any:
    """In a world of its own; a design takes any that predicts pixels."""
    return ic.Explicit(lens="brown-conrady").fit(ic.simulated("stereo", points=30, seed=1))


@pytest.fixture(scope="module")
def design(calibration: Any) -> BoardDesign:
    return BoardDesign.of(calibration, shape_of(BOARD))


@pytest.fixture(scope="module")
def poses(design: BoardDesign) -> list[Pose]:
    return design.candidates(30, np.random.default_rng(2))


# --- the design of the experiment -----------------------------------------------------------------------------------


def test_the_gain_of_a_pose_is_what_the_covariance_loses(design, poses):
    gains = design.gains(poses[:4])
    assert (gains > 0).all()
    for pose, gain in zip(poses[:4], gains, strict=True):
        now, then = (np.trace(one.at_judged.total, axis1=1, axis2=2) for one in (design, design.after(pose)))
        assert np.nanmean(now - then) == pytest.approx(gain, rel=1e-6)
        assert (then <= now * (1 + 1e-9))[np.isfinite(now)].all()
        assert (then >= np.trace(design.at_judged.floor, axis1=1, axis2=2) * (1 - 1e-9))[np.isfinite(now)].all()
    assert np.nanmean(design.after(poses[0]).pixel_sd()) < np.nanmean(design.pixel_sd())


def test_the_pose_of_the_board_is_integrated_out(design, calibration, poses):
    """Against the whole normal matrix of unknowns and pose, inverted."""
    pose = poses[int(np.argmax(design.gains(poses)))]
    (S,) = design._informations([pose], None)
    xyz = pose.apply(design.shape.some())
    linear = linear_views(design.rig, xyz, np.tile(design.visible([pose]), (len(xyz), 1)))
    many = np.sqrt(len(design.shape.corners) / len(xyz))
    weight = np.where(linear.seen, many / linear.sd, 0)[..., None]
    H = (linear.half * weight).reshape(-1, linear.half.shape[2])
    steps = np.eye(6)
    K = []
    for step in steps:  # numerically: turned about the board's origin, shifted
        moved = 1e-4 * step
        there = rotation_from_vector(moved[:3]) @ pose.rotation
        far = design.shape.some() @ there.T + pose.translation + moved[3:]
        K.append((calibration.predict(far) - calibration.predict(xyz)).reshape(len(xyz), -1) / 1e-4)
    K = (np.stack(K, axis=2) * weight).reshape(-1, 6)
    joint = np.block([[np.eye(len(S)) + H.T @ H, H.T @ K], [K.T @ H, K.T @ K]])
    marginal = np.linalg.inv(joint)[: len(S), : len(S)]
    assert np.allclose(np.linalg.inv(np.eye(len(S)) + S), marginal, atol=1e-4)


def test_of_a_board_that_is_put_somewhere_its_shift_alone_is_integrated_out(design, poses):
    """Against the joint normal matrix of unknowns and shift, the shift with its prior; and the gain is what is lost."""
    placed = PlacedBoardDesign(design.rig, design.judged, shape=design.shape, placed_sd=0.2)
    pose = poses[int(np.argmax(design.gains(poses)))]
    (S,) = placed._informations([pose], None)
    xyz = pose.apply(design.shape.some())
    linear = linear_views(design.rig, xyz, np.tile(design.visible([pose]), (len(xyz), 1)))
    weight = np.where(linear.seen, np.sqrt(len(design.shape.corners) / len(xyz)) / linear.sd, 0)[..., None]
    H = (linear.half * weight).reshape(-1, linear.half.shape[2])
    K = (linear.slope * weight).reshape(-1, 3)
    joint = np.block([[np.eye(len(S)) + H.T @ H, H.T @ K], [K.T @ H, K.T @ K + np.eye(3) / 0.2**2]])
    assert np.allclose(np.linalg.inv(np.eye(len(S)) + S), np.linalg.inv(joint)[: len(S), : len(S)], atol=1e-6)
    now, then = (np.trace(one.at_judged.total, axis1=1, axis2=2) for one in (placed, placed.after(pose)))
    assert placed.gains([pose])[0] == pytest.approx(np.nanmean(now - then), rel=1e-6)
    exact = PlacedBoardDesign(design.rig, design.judged, shape=design.shape)
    assert exact.gains([pose])[0] > placed.gains([pose])[0]  # who knows it better learns more
    assert np.nanmean(exact.at_judged.sd**2) > np.nanmean(design.at_judged.sd**2)  # in the world, not in its own frame


def test_errors_that_move_the_whole_rig_do_not_count(design):
    moved, rigid = design._moved
    xyz = design.judged.xyz[design._counted]
    for axis in np.eye(3):
        for motion in (np.broadcast_to(axis, xyz.shape), np.cross(axis, xyz - xyz.mean(axis=0))):
            assert np.abs(np.einsum("nk,nkq->q", motion, moved)).max() < 1e-6 * np.abs(moved).max() * motion.size
    assert rigid.shape == moved.shape


def test_candidates_are_seen_well_and_a_pose_is_found_again(design, calibration, poses):
    seen = design.visible(poses)
    assert len(poses) > 10
    assert seen.any(axis=1).all()
    best = poses[int(np.argmax(seen.sum(axis=1)))]
    uv = np.where(
        design.visible([best])[0][None, :, None], calibration.predict(best.apply(design.shape.corners)), np.nan
    )
    found = board_pose(calibration, design.shape.corners, uv)
    assert np.abs(found.apply(design.shape.corners) - best.apply(design.shape.corners)).max() < 1e-3
    turned = Pose(best.rotation @ np.diag([1.0, -1.0, -1.0]), best.translation)
    assert not design.visible([turned]).any()  # its back


# --- before there is a calibration ----------------------------------------------------------------------------------


def test_a_camera_is_shown_what_it_has_not_seen():
    shape, size, seen = shape_of(BOARD), (1280, 800), []
    for _ in range(5):
        framing = unseen_framing(shape, size, seen)
        assert is_new(framing, seen)
        uv = usual_pixels(framing.camera_from_board.apply(shape.corners), size)
        assert ((uv > 0) & (uv < size)).all()
        again = framing_of(shape, shape.corners, uv, size)
        assert again is not None
        assert np.allclose(again.features, framing.features, atol=1e-6)
        seen.append(framing)
        assert not is_new(again, seen)


def boards_of_rig(rig: Any, count: int) -> Dataset:
    names = [camera.name for camera in rig.cameras]
    return simulate_boards(rig, [names] * count, seed=3)


@pytest.fixture(scope="module")
def eight(rig: Any) -> Dataset:
    return boards_of_rig(rig, 8)


@pytest.fixture(scope="module")
def loop(rig: Any, eight: Dataset) -> BoardLoop:
    """With eight boards, fitted."""
    found = BoardLoop(
        ic.Explicit(lens="brown-conrady"), shape_of(dict(eight.extra["target"])), eight.cameras, rule=Pictures(8)
    )
    assert isinstance(found.ask()[0], BoardTarget)
    found.reset(eight)
    assert found.problem is None
    return found


@pytest.mark.slow
def test_the_loop_says_where_why_and_how_far(loop):
    assert loop.points == 8
    assert loop.stop == "all 8 boards of the budget are taken"
    (target,) = loop.ask()
    assert target.pose is not None
    assert target.score > 0
    assert target.words.endswith("mm from it")
    assert "the typical uncertainty of a position (sd in 3D) would " in target.why
    (first,) = BoardLoop(loop.calibrator, loop.shape, loop.cameras).ask()
    assert first.why == "cam1 has seen no board at this place and tilt yet"
    for c, outline in enumerate(target.outlines):
        assert (outline is None) == np.isnan(target.corners[c]).all()
    progress = loop.camera_progress()
    assert [one.boards for one in progress] == [8, 8]
    assert all(0.4 < one.part <= 1 for one in progress)
    known = loop.design.pixel_sd() * loop.design.pixel_noise()
    assert loop.design.pixel_noise() == pytest.approx(0.2, rel=0.2)
    assert [one.words.split(",")[0] for one in progress] == [f"calibrated to {px:.2g} px" for px in known]
    step = loop.history[-1]
    assert step.points == 8
    assert step.usual < step.worst < 50


@pytest.mark.slow
def test_a_board_where_one_was_is_worth_little_and_one_in_the_outline_enough(loop):
    (target,) = loop.ask()
    calibration, shape = loop.calibration, loop.shape
    seen = loop.design.visible([target.pose])[0]
    uv = calibration.predict(target.pose.apply(shape.corners))
    numbers = np.arange(len(shape.corners))
    views = {name: (numbers, uv[:, c]) for c, name in enumerate(calibration.trained.camera_names) if seen[c]}
    assert loop.worth(views, target).enough
    assert loop.worth(views, target).share == pytest.approx(1, abs=0.05)
    best = replace(target, score=20 * target.score)
    assert not loop.worth(views, best).enough
    assert "5 %" in loop.worth(views, best).reason
    assert "go on to the outline" in loop.worth(views, best).reason
    name = min(views)
    both = replace(best, outlines=tuple(np.zeros((4, 2)) for _ in best.outlines))
    alone = loop.worth({name: views[name]}, both).reason  # it is in its place, and another camera is to see it, too
    assert alone.startswith("cam2 does not see it: so it tells" if name == "cam1" else "cam1 does not see it")


def test_a_board_more_is_predicted_before_it_is_fitted(loop, rig, eight):
    more = BoardLoop(loop.calibrator, loop.shape, loop.cameras)
    more.data = eight
    more.adopt(eight, loop.calibration)
    before = more.history[-1]
    more.tell(boards_of_rig(rig, 9))
    assert [step.points for step in more.history] == [8, 9]
    assert more.history[-1].usual < before.usual
    assert more.forecast


def test_good_enough_is_said_from_a_fit_and_not_of_cameras_that_contradict_each_other(loop, rig, eight, monkeypatch):
    found = loop.history[-1].excess
    more = BoardLoop(loop.calibrator, loop.shape, loop.cameras, rule=Within(found - 1e-6) | Pictures(10))
    more.data = eight
    more.adopt(eight, loop.calibration)
    more.tell(boards_of_rig(rig, 9))
    assert more.history[-1].excess < found - 1e-6  # as expected of the ninth
    assert not more.stop
    more.rule = Within(found + 1e-6) | Pictures(9)
    assert "times what pixel noise" in more.stop  # by the fit of eight
    said = "cam1 and cam2 contradict each other on the 8 boards"
    monkeypatch.setattr(type(loop.calibration), "contradictions", [said])
    assert more.contradictions == (said,)
    assert more.stop == "all 9 boards of the budget are taken"


def test_the_page_says_at_once_that_cameras_contradict_each_other():
    said = "cam1 and cam2 contradict each other on the 14 boards that both saw."
    state = BoardState(phase="aim", stop="all 9 boards of the budget are taken", contradictions=(said,))
    for one in (state, replace(state, phase="done")):
        head = headline(one)
        assert head.kind == "bad"
        assert "contradict each other" in head.title
        assert said in head.detail
        assert CURE in head.detail
        assert "ood enough" not in head.title + head.detail
    failed = headline(replace(state, stop="", contradictions=(), unfitted="the cameras contradict each other."))
    assert "The last fit failed: the cameras contradict" in failed.detail


@pytest.mark.slow
def test_the_report_says_how_far_distances_on_boards_held_out_are_off(tmp_path, rig, monkeypatch):
    data = boards_of_rig(rig, 9)
    calibrator = ic.Explicit(lens="brown-conrady")
    fitted = calibrator.fit(data)
    monkeypatch.setattr(type(calibrator), "fit", lambda self, some: fitted)  # of all: it is quick, and nearly the same
    monkeypatch.setattr(board_report, "write_report", lambda path, found: None)
    found = board_report.write_board_report(tmp_path / "r.html", "b", calibrator, fitted, data)
    lengths = found.lengths
    assert lengths.rms == pytest.approx(lengths.stated_rms, rel=0.4)
    assert 0.8 < lengths.inside <= 1
    assert words.headline(found).startswith("Distances between far corners of 3 boards held out are off by 0.")
    title, why, tone = words.verdict(found)
    assert (title, tone) == ("The error bars hold for distances.", "good")
    assert "times that" in why
    wrong = replace(found, lengths=replace(lengths, errors=4 * lengths.errors))
    assert words.verdict(wrong)[2] == "bad"
    assert any("rms error of distances" in label for label, _, _ in words.tiles(found))
    done = BoardState(phase="done", verdict=(words.headline(found), tone))
    assert "held out are off by" in headline(done).detail


def test_pictures_are_counted_in_words():
    rule = Pictures(3)
    assert rule.progress([Step(2)]) == "2 of 3 boards"
    assert not rule.met([Step(2)])


# --- pictures -------------------------------------------------------------------------------------------------------


def test_edges_are_measured_sharp_and_blurred():
    h = rotated(0.2, 30)
    uv, flat = corners_of(5, 8, h), corner_positions({**BOARD, "square": 1.0})
    for blur in (0.8, 2.5):
        picture = photograph(checkered(5, 8), h, blur=blur, noise=0.003, fine=3)
        width = edge_width(picture, flat, uv)
        assert width == pytest.approx(2.5 * np.hypot(blur, 0.3), rel=0.25), blur


def test_a_hand_follows_an_outline_and_its_board_is_read(rig):
    cameras, hand = simulated_hand(rig, CHARUCO.describe(), seed=1)
    camera = rig.cameras[0]
    place = camera.camera_from_world.inverse().apply(np.array([20.0, 10.0, 420.0]))
    middle = hand.corners.mean(axis=0)
    frame = look_at(camera.camera_from_world.centre, place, -camera.camera_from_world.rotation[1]).rotation.T
    goal = Pose(frame @ rotation_from_vector([0.3, -0.2, 0.1]), np.zeros(3))
    goal = Pose(goal.rotation, place - goal.rotation @ middle)
    pixels = np.stack([one.pixel_from_world(goal.apply(hand.corners))[0] for one in rig.cameras])
    found = match_pose(rig, hand.corners, pixels)
    assert np.abs(found.apply(hand.corners) - goal.apply(hand.corners)).max() < 0.05
    hand.follow(hand.corners, pixels)
    off = np.linalg.norm(hand.pose().apply(middle) - goal.apply(middle))
    assert 0 < off < 60
    frame = cameras[0].frame()
    seen = CHARUCO.detect(frame.picture, View("cam1", "p001"))
    assert len(seen) > 60, seen.reason
    numbers = [int(point[-3:]) - 1 for point in seen.points]
    true, _ = camera.pixel_from_world(hand.pose().apply(hand.corners)[numbers])
    assert np.abs(seen.uv - true).max() < 0.1


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_a_printed_board_is_shown_where_it_is(unit):
    rig = build_rig("stereo", seed=1, lens_error=0.0, unit=unit)
    scale = rig.units_per_mm
    board = AprilGrid(5, 7, 16.0 * scale, 4.8 * scale)
    cameras, hand = simulated_hand(rig, board.describe(), seed=1)
    seen = board.detect(cameras[0].frame().picture, View("cam1", "p001"))
    assert len(seen) > 120, seen.reason
    numbers = [int(point[-3:]) - 1 for point in seen.points]
    true, _ = rig.cameras[0].pixel_from_world(hand.pose().apply(hand.corners)[numbers])
    off = (seen.uv - true) / seen.sd
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1, abs=0.35)
    assert np.abs(off.mean(axis=0)).max() < 0.4


def test_a_set_of_pictures_is_of_one_place_however_long_it_takes(rig):
    cameras, hand = simulated_hand(rig, CHARUCO.describe(), seed=1, seconds=0.2)
    hand.put(Pose(np.eye(3), hand.pose().translation + np.array([30.0, 0.0, 0.0])))
    first = hand.held(0)
    time.sleep(0.05)
    assert hand.held(1) is first  # though the hand is on its way
    assert hand.held(1) is not first
    time.sleep(0.2)
    cameras[0].fail_for(1)
    with pytest.raises(HardwareError):
        cameras[0].frame()
    later = hand.held(0)  # one that has failed has had its turn
    assert not np.array_equal(later[0].translation, first[0].translation)
    assert np.array_equal(later[0].translation, later[1].translation)


# --- what a session keeps, and what it refuses ----------------------------------------------------------------------


def test_boards_at_unknown_places_are_kept_and_come_back(tmp_path, eight):
    target = dict(eight.extra["target"])
    shots = np.array([point.rpartition("-c")[0] for point in eight.points.tolist()])
    names = list(dict.fromkeys(shots.tolist()))
    with Session.create(
        tmp_path / "s", name="b", length_unit="mm", cameras=eight.cameras, settings={TARGET_KEY: target}
    ) as session:
        for name in names[:3]:
            session.accept(eight.select(shots == name))
        assert session.undo() == names[2]
        other = eight.select(shots == names[3])
        somewhere = KnownPositions(
            np.full(len(other), names[3]), np.zeros((len(other), 3)), np.full((len(other), 3), 1.0)
        )
        with pytest.raises(DatasetError, match="known positions or none"):
            session.accept(replace(other, known=somewhere))
    with Session.open(tmp_path / "s") as session:
        data = session.data
        assert data.known is None
        assert list(dict.fromkeys(point.rpartition("-c")[0] for point in data.points.tolist())) == names[:2]
        assert np.array_equal(
            data.observations.uv, eight.select(np.isin(shots, names[:2])).observations.uv, equal_nan=True
        )
    read = read_dataset(tmp_path / "s")
    assert read.known is None
    assert read.extra["target"] == target


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"target": "charcuo"}, "did you mean 'charuco'"),
        ({"target": "checkerboard", "board": "8x11"}, "size of the squares"),
        ({"target": "board", "board": "8x11"}, "size of the squares"),
        ({"target": "board", "board": "8x11", "square": 13290.0}, "no size for a board"),
        ({"target": "charuco", "tag": 3.0}, "no option --tag"),
        ({"target": "charuco", "robot": "ur:10.0.0.1"}, "in front of simulated cameras"),
        ({"target": "charuco", "facing": "0,0,-1"}, "how a robot holds the board"),
        ({"target": "charuco", "robot": "simulated", "facing": "0,0"}, "does not say how the board is turned"),
        ({"target": "charuco", "hold_out": 3}, "held out by themselves"),
        (
            {
                "target": "charuco",
                "board": "9x12",
                "square": 20.0,
                "marker": 15.0,
                "robot": "ur:10.0.0.1",
                "cameras": ["a=0", "b=1"],
            },
            "there is no workspace",
        ),
        (
            {
                "target": "charuco",
                "square": 20.0,
                "marker": 15.0,
                "board": "9x12",
                "robot": "ur:10.0.0.1",
                "cameras": ["a=0", "b=1"],
                "workspace": "0:1,0:1,0:1",
            },
            "how the board is turned is not known",
        ),
        ({"target": "wand", "board": "8x11"}, "--board: the target is a wand"),
        ({"wand": 500.0}, "--wand: the target is a ball"),
        ({"target": "charuco", "told_by": "size"}, "--told-by: the target is a charuco"),
        ({"hold_out": 3}, "are those of a board"),
        ({"target": "charuco", "method": "inverse-gp"}, "takes no boards"),
        ({"target": "aprilgrid", "board": "6x6"}, "needs --tag"),
    ],
)
def test_what_a_session_with_a_board_cannot_be(tmp_path, options, says):
    with pytest.raises(UsageError) as caught:
        open_session(tmp_path / "s", Setup(rig="stereo", **options)).close()
    assert says in str(caught.value)
    assert caught.value.fix


def test_a_session_knows_its_board_when_it_goes_on(tmp_path):
    before = Setup(rig="stereo", target="charuco")
    assert changes_to(tmp_path, before, {"square": 13.29, "budget": 9})["square"] is None
    with pytest.raises(UsageError, match=r"was begun with square 13\.29"):
        changes_to(tmp_path, before, {"square": 30.0})
    with pytest.raises(UsageError, match="was begun with target charuco"):
        changes_to(tmp_path, before, {"target": "board"})
    plain = Setup(rig="stereo", target="checkerboard")
    assert plain.target == "board"
    assert changes_to(tmp_path, plain, {"target": "checkerboard"})["target"] == "board"


# --- known poses ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def slots(rig: Any) -> tuple[KnownPose, ...]:
    """A board in front of both cameras, at four depths."""
    shape = shape_of(BOARD)
    box = rig.volume.world_from_box
    depths = rig.volume.size[2] * np.array([-0.4, -0.1, 0.2, 0.4])
    poses = [Pose(box.rotation, box.apply(np.array([0.0, 0.0, z]) - shape.middle)) for z in depths]
    return tuple(KnownPose(f"slot {k}", pose) for k, pose in enumerate(poses, start=1))


def corners_at(rig: Any, slots: tuple[KnownPose, ...], count: int) -> Dataset:
    """What the cameras see of the board in the first slots, as known points."""
    parts = []
    for k, (name, pose) in enumerate(slots[:count], start=1):
        seen = simulate(rig, board_target(BOARD, pose), seed=k)
        shot, n = f"p{k:03d}", len(seen)
        names = np.array([point.replace("held", shot) for point in seen.points.tolist()])
        known = KnownPositions(np.full(n, shot), seen.xyz, np.full((n, 3), np.nan), {POSE_COLUMN: np.full(n, name)})
        observations = Observations(names, seen.cameras, seen.observations.uv, seen.observations.sd)
        parts.append(Dataset("b", "mm", observations, known, {"target": BOARD}))
    return ic.join(parts)


def test_poses_are_read_with_normals_turns_and_as_a_slide(tmp_path):
    file = tmp_path / "poses.csv"
    file.write_text("pose,x,y,z,nx,ny,nz\nA,1,2,3,0,0,-1\nB,4,5,6,0,-1,-1\n")
    a, b = poses_from(str(file))
    assert (a.name, b.name) == ("A", "B")
    assert np.allclose(a.pose.rotation, np.eye(3))
    assert np.allclose(b.pose.rotation[:, 2], [0, 0.5**0.5, 0.5**0.5])
    assert np.allclose(b.pose.rotation[:, 0], [1, 0, 0])
    assert np.linalg.det(b.pose.rotation) == pytest.approx(1)
    file.write_text("pose,x,y,z,rx,ry,rz\nA,1,2,3,0.1,0.2,0.3\nB,4,5,6,0,0,0\n")
    assert np.allclose(poses_from(str(file))[0].pose.rotation, rotation_from_vector([0.1, 0.2, 0.3]))
    slide = poses_from("x=0 y=0 z=0:190:10")
    assert len(slide) == 20
    assert slide[-1].pose.translation.tolist() == [0, 0, 190]
    kept = poses_of(described(slide))
    assert [one.name for one in kept] == [one.name for one in slide]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("pose,x,y\nA,1,2\n", "has the columns"),
        ("pose,x,y,z\nA,1,2,3\nA,1,2,4\n", "'A' twice"),
        ("pose,x,y,z\nA,1,2,3\n", "1 poses"),
        ("pose,x,y,z,nx,ny,nz\nA,1,2,3,1,0,0\nB,1,2,3,0,0,1\n", "lies along x"),
        ("pose,x,y,z,nx,ny,nz\nA,1,2,3,0,0,0\nB,1,2,3,0,0,1\n", "normal is zero"),
        ("pose,x,y,z\nA,1,2,nan\nB,1,2,3\n", "not finite"),
        ("pose,x,y,z\nA,1,2,\nB,1,2,3\n", "row 2"),
        ("pose,x,y,z,nx,ny,nz,rx,ry,rz\nA,1,2,3,0,0,1,0,0,0\nB,1,2,3,0,0,1,0,0,0\n", "has the columns"),
    ],
)
def test_poses_that_are_none(tmp_path, text, says):
    file = tmp_path / "poses.csv"
    file.write_text(text)
    with pytest.raises(UsageError) as caught:
        poses_from(str(file))
    assert says in str(caught.value)
    assert caught.value.fix


def test_a_board_goes_through_known_poses_by_number(rig, slots):
    cameras = tuple(Camera(camera.name, camera.width, camera.height) for camera in rig.cameras)
    loop = KnownPosesLoop(ic.Explicit(lens="brown-conrady"), shape_of(BOARD), cameras, poses=slots)
    (first,) = loop.ask()
    assert first.words.startswith("pose 1 of 4: slot 1, corner 1 at x ")
    assert first.known
    assert all(outline is None for outline in first.outlines)
    data = corners_at(rig, slots, 3)
    loop.reset(data)
    assert loop.problem is None
    assert loop.taken == ["slot 1", "slot 2", "slot 3"]
    (last,) = loop.ask()
    assert last.words.startswith("pose 4 of 4: slot 4")
    assert loop.name_of(last) == "slot 4"
    assert all(outline is not None for outline in last.outlines)

    def seen(pose: Pose) -> dict[str, Any]:
        xyz = pose.apply(loop.shape.corners)
        return {one.name: (np.arange(len(xyz)), one.pixel_from_world(xyz)[0]) for one in rig.cameras}

    assert loop.worth(seen(slots[3].pose), last).enough
    still = loop.worth(seen(slots[2].pose), last)  # nobody has moved it yet
    assert not still.enough
    assert "px from where this pose must be" in still.reason
    again = replace(last, pose=slots[2].pose)
    assert loop.worth(seen(slots[2].pose), again).reason == "move it on to this pose"
    assert loop.history[-1].worst > 0
    assert [one.words for one in loop.camera_progress()] == ["3 of 4 poses"] * 2
    loop.reset(corners_at(rig, slots, 4))
    assert loop.stop == "all 4 poses are taken"
    with pytest.raises(UsageError, match="all 4 poses"):
        loop.ask()


def test_poses_that_judge_are_spread_and_do_not_calibrate(rig, slots):
    cameras = tuple(Camera(camera.name, camera.width, camera.height) for camera in rig.cameras)
    loop = KnownPosesLoop(ic.Explicit(lens="brown-conrady"), shape_of(BOARD), cameras, poses=slots, hold_out=1)
    data = corners_at(rig, slots, 2)
    loop.reset(data)
    (third,) = loop.ask()
    assert third.held_out
    assert "slot 3" in third.words
    assert "held-out board 1 of 1: it judges the calibration" in third.words
    extra = {**corners_at(rig, slots, 4).known.extra}
    whole = corners_at(rig, slots, 4)
    extra[HELD_OUT_COLUMN] = np.where(extra[POSE_COLUMN] == "slot 3", "yes", "")
    whole = replace(whole, known=replace(whole.known, extra=extra))
    assert set(loop.held_out(whole).shots.tolist()) == {"p003"}
    assert set(loop.used(whole).shots.tolist()) == {"p001", "p002", "p004"}
    loop.tell(whole.select(whole.shots != "p004"))
    assert loop.points == 2  # that it has come changes nothing
    assert not loop.ask()[0].held_out
    loop.adopt(whole, loop.calibration)
    loop.held, loop.data = loop.held_out(whole), loop.used(whole)
    assert loop.stop == "all 3 poses are taken, and 1 more are held out"
    with pytest.raises(UsageError, match="cannot be held out"):
        KnownPosesLoop(loop.calibrator, loop.shape, cameras, poses=slots, hold_out=3)


@pytest.fixture(scope="module")
def carried(rig: Any) -> tuple[KnownPose, ...]:
    """Where a robot can put a board in front of both cameras, without turning it."""
    box, shape = rig.volume.world_from_box, shape_of(BOARD)
    lattice = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.4, 0.0, 0.4)])
    return carried_poses(box.apply(lattice * rig.volume.size - shape.middle), box.rotation)


def test_a_robot_is_sent_far_apart_first_then_where_most_is_told_then_for_boards_that_judge(rig, carried, slots):
    cameras = tuple(Camera(camera.name, camera.width, camera.height) for camera in rig.cameras)
    loop = KnownPosesLoop(
        ic.Explicit(lens="brown-conrady"), shape_of(BOARD), cameras, rule=Pictures(3), poses=carried, free=True,
        hold_out=2,
    )  # fmt: skip
    (first,) = loop.ask()
    places = np.array([one.pose.translation for one in carried])
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    assert np.linalg.norm(first.pose.translation - middle) == np.linalg.norm(places - middle, axis=1).min()
    loop.refuse(first.pose.translation, "in the way")  # the robot is sent to corner 1
    (second,) = loop.ask()
    assert second.name != first.name
    chosen = (carried[0], carried[4], carried[11])
    loop.reset(corners_at(rig, chosen[:2], 2))
    assert loop.problem is None
    (third,) = loop.ask()
    assert third.score > 0
    assert third.why.startswith("of 9 places this one tells most")
    assert not third.held_out
    assert [one.words for one in loop.camera_progress()] == ["2 boards"] * 2
    left = [one for one in carried if one.name not in (first.name, *loop.taken)]
    gains = loop._design_now().gains([one.pose for one in left])
    assert third.name == left[int(np.argmax(gains))].name
    loop.reset(corners_at(rig, chosen, 3))
    assert not loop.stop  # enough to calibrate, and two are missing that judge
    (judging,) = loop.ask()
    assert judging.held_out
    assert "held-out board 1 of 2" in judging.words


@pytest.mark.parametrize(
    ("text", "says"),
    [("0,0", "three numbers"), ("0,0,0", "normal is zero"), ("1,0,0", "lies along x"), ("x:1,2,3", "")],
)
def test_turns_that_are_none(text, says):
    with pytest.raises(UsageError, match="how the board is turned") as caught:
        turn_from(text, "--facing")
    assert says in str(caught.value)


def test_how_a_board_is_turned_is_read():
    assert np.allclose(turn_from("0,0,-2", "--facing"), np.eye(3))
    assert np.allclose(turn_from("r:0.1,0.2,0.3", "--facing"), rotation_from_vector([0.1, 0.2, 0.3]))


# --- played sessions ------------------------------------------------------------------------------------------------


def controller_of(folder: Path, **options: Any) -> BoardController:
    made = open_session(folder, Setup(**{"rig": "stereo", "target": "charuco", **options}))
    assert isinstance(made, BoardController)
    made.loop.calibrator = ic.Explicit(lens="brown-conrady")  # of a choice of lenses each fit takes twice as long
    return made


@pytest.mark.slow
def test_a_session_is_played_to_its_end_and_goes_on_after_it_was_left(tmp_path):
    folder = tmp_path / "s"
    with controller_of(folder, budget=9) as controller:
        controller._hand.seconds, controller._background = 0.0, False
        controller.start()
        while controller.loop.points < 4:
            controller.live()
            controller.step()
        assert controller.state.taken == controller.loop.points
    assert len(list((folder / "images" / "cam1").glob("*.png"))) == 4
    with open_session(folder, None) as controller:
        assert controller.loop.rule is not None
        path = controller.run()
        assert controller.state.phase == "done", controller.state.problem
        assert controller.state.stop
        assert controller.loop.points >= 5
        assert path is not None
        assert path.exists()
        boards = controller.loop.points
    found = ic.load_calibration(path)
    assert set(found.camera_names) == {"cam1", "cam2"}
    if boards >= 9:
        assert "held by hand" in (folder / "report.html").read_text()
    again = ic.Explicit(lens="brown-conrady").fit(read_dataset(folder))  # the folder is a dataset of boards
    assert set(again.camera_names) == {"cam1", "cam2"}


@pytest.mark.slow
def test_a_robot_carries_the_board_where_it_is_let_and_some_boards_judge(tmp_path):
    setup = Setup(
        rig="stereo", seed=1, target="checkerboard", board="5x8", square=20.0, robot="simulated", speed=1000.0,
        budget=8, hold_out=2, sd=0.05,
    )  # fmt: skip
    folder = tmp_path / "s"
    with open_session(folder, setup) as controller:
        assert isinstance(controller, BoardController)
        controller._background = False
        assert not controller.state.auto  # it moves when somebody says so
        controller.start()
        assert not np.isfinite(controller.state.history[-1].worst if controller.state.history else np.nan)
        controller.go()
        controller.go()
        assert controller.loop.points == 2
        assert np.allclose(controller.equipment.robot.position(), controller.session.data.xyz[-1], atol=200)
        controller.stop_robot()
        assert headline(controller.state, moves=True).detail.startswith("Stopped by hand")
    with open_session(folder, None) as controller:
        path = controller.run()
        assert controller.state.phase == "done", controller.state.problem
        assert controller.state.stop.endswith("and 2 more are held out")
        assert "2 held out" in controller.state.message
    data = read_dataset(folder)
    judging = data.known.extra[HELD_OUT_COLUMN] == "yes"
    assert len(set(data.shots[judging].tolist())) == 2
    found = ic.load_calibration(path)
    assert set(found.data.shots.tolist()) == set(data.shots[~judging].tolist())
    off = found.measure(data.select(judging).observations).xyz - data.xyz[judging]
    assert np.sqrt(np.nanmean(off**2)) < 0.5  # mm
    assert "2 boards held out" in (folder / "report.html").read_text()


def test_each_move_of_a_board_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr(SimulatedRobot, "simulated", False)  # it asks, as a real one
    setup = Setup(rig="stereo", target="checkerboard", board="5x8", square=20.0, robot="simulated", speed=1000.0)
    controller = open_session(tmp_path / "s", setup)
    try:
        robot = controller.equipment.robot
        page = BoardPage(controller)
        controller.start()
        asked = page.do({"word": "go"})["ask"]
        assert asked["title"] == "The robot moves"
        before = robot.position()
        with pytest.raises(HardwareError, match="not confirmed"):
            robot.move(controller.state.target.xyz)
        assert page.do({"word": "auto", "on": True})["ask"]["yes"] == "Go on by itself"
        assert np.array_equal(robot.position(), before)
        taken: list[Any] = []
        controller._take = lambda **given: taken.append(given)  # type: ignore[method-assign]
        place = controller.state.target.xyz
        page._action("go", {"yes": asked["number"]})()
        assert np.array_equal(robot.position(), place)
        assert np.array_equal(taken[0]["where"], place)
        state = page._snapshot(controller.state, np.full(3, np.nan), 0)
        assert state["buttons"]["stop"]["enabled"]
        assert state["buttons"]["go"]["label"] == "Go"
    finally:
        controller.close()


def test_poses_that_no_simulated_camera_sees_are_refused_with_where_cameras_look(tmp_path, slots):
    """Where the rig's box is turned, poses that face along z are edge-on: a session would wait for ever."""
    rows = [[*pose.translation, *vector_from_rotation(pose.rotation)] for _, pose in slots[:2]]
    turned = slots[2].pose.rotation @ rotation_from_vector([0.0, np.pi, 0.0])
    rows.append([*slots[2].pose.apply(np.array([[140.0, 0.0, 0.0]]))[0], *vector_from_rotation(turned)])
    for name, wrong, says in (("back", rows, "at pose03 (1 of 3 poses)"), ("far", [[0, 0, 300]] * 2, "(2 of 2 poses)")):
        file = tmp_path / f"{name}.csv"
        head = "x,y,z,rx,ry,rz" if name == "back" else "x,y,z"
        file.write_text("\n".join([head, *(",".join(map(str, row)) for row in wrong)]))
        setup = Setup(rig="stereo", seed=1, target="board", board="5x8", square=20.0, poses=str(file))
        with pytest.raises(UsageError) as caught:
            open_session(tmp_path / name, setup).close()
        assert says in str(caught.value)
        assert ("they see its back, or it lies edge-on" in str(caught.value)) == (name == "back")
        assert "its cameras look at x" in str(caught.value)


@pytest.mark.slow
def test_a_session_goes_through_the_slots_of_a_block_and_calibrates_by_any_method(tmp_path, slots):
    file = tmp_path / "poses.csv"
    rows = [[name, *pose.translation, *vector_from_rotation(pose.rotation)] for name, pose in slots]
    file.write_text("\n".join(["pose,x,y,z,rx,ry,rz", *(",".join(map(str, row)) for row in rows)]))
    setup = Setup(rig="stereo", seed=1, target="board", board="5x8", square=20.0, poses=str(file))
    with open_session(tmp_path / "s", setup) as controller:
        assert isinstance(controller, BoardController)
        controller._hand.seconds, controller._background = 0.0, False
        controller.start()
        file.unlink()  # the session has them
        for _ in slots:
            controller.go()
        assert controller.state.stop == "all 4 poses are taken"
        path = controller.finish()
    assert ic.load_calibration(path).method == "forward-gp"
    data = read_dataset(tmp_path / "s")
    assert set(data.known.extra[POSE_COLUMN].tolist()) == {name for name, _ in slots}
    assert (tmp_path / "s" / "report.html").exists()


@pytest.mark.slow
@pytest.mark.parametrize("target", ["charuco", "aprilgrid"])
def test_a_session_in_a_browser_shows_outline_corners_and_progress(tmp_path, chromium, target):
    playwright = pytest.importorskip("playwright.sync_api")
    from implicam.viewer.bench_page import open_page

    with controller_of(tmp_path / "s", budget=30, target=target) as controller:
        controller._hand.seconds = 0.3
        with open_page(controller) as (url, _), playwright.sync_playwright() as play:
            browser = play.chromium.launch(**chromium)
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            errors: list[str] = []
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.goto(url)
            page.wait_for_selector("svg polygon.aim", timeout=60_000)
            page.wait_for_selector("svg circle.corner", timeout=60_000)
            assert page.is_hidden("#place")
            assert page.is_hidden("#stop")
            assert page.is_hidden("#accept")
            assert "simulated" in page.inner_text("#by-itself")
            page.wait_for_function("window.implicam.state.numbers.points >= 1", timeout=120_000)
            page.click("#auto")
            page.wait_for_function("!window.implicam.state.auto")
            before = controller.loop.points
            end = time.monotonic() + 60
            while controller.loop.points == before and time.monotonic() < end:  # at the key, wherever it is
                page.keyboard.press("g")
                time.sleep(2)
            assert controller.loop.points > before
            page.wait_for_selector(".part:not([hidden])")
            browser.close()
            assert not errors


def test_a_moving_or_a_blurred_board_is_refused_with_the_reason(tmp_path):
    controller = controller_of(tmp_path / "s", budget=9)
    try:
        table = controller.equipment.detector.describe()
        flat = corner_positions(table)
        here = {"cam1": (np.arange(len(flat)), 2 * flat + 100)}
        assert controller._judge(()).reason == "no camera sees the board"
        controller.state = replace(controller.state, looks=())
        controller._views = lambda looks: here  # type: ignore[method-assign]
        controller._last = {"cam1": (here["cam1"][0], here["cam1"][1] + 14)}
        judged = controller._judge(())
        assert not judged.ready
        assert judged.reason == "hold it still: it moves by 20 px"
        controller.state = replace(controller.state, target=controller.loop.ask()[0], phase="aim")
        places = [here["cam1"][1] + 2, here["cam1"][1]]  # by 2.8 px, which live pictures did not show
        numbers = here["cam1"][0]
        controller._take_frames = lambda trigger: []  # type: ignore[method-assign]
        controller._detect_all = lambda frames, **_: ()  # type: ignore[method-assign]
        controller._refusal = lambda looks, views: ""  # type: ignore[method-assign]
        for asked in (False, True):
            left = iter(places)
            controller._views = lambda looks, left=left: {"cam1": (numbers, next(left))}  # type: ignore[method-assign]
            controller._last = {"cam1": (numbers, here["cam1"][1])}
            with pytest.raises(UsageError, match="it moved while the pictures were taken"):
                controller._take(asked=asked)
        assert threading.active_count() < 50
    finally:
        controller.close()
