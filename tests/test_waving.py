"""Waving a wand with guidance: what is covered, where to wave next, when it is enough."""

from __future__ import annotations

import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import cli  # noqa: F401
from implicam.active.board_loop import Pictures
from implicam.active.stopping import Below, Within
from implicam.active.volume_design import linear_views
from implicam.active.wand_coverage import Cells, WaveDesign, _gains, count_views, ends_of, unknown_cells
from implicam.active.wand_loop import MIN_WHOLE_FRAMES, WandLoop, WaveTarget
from implicam.active.workspace import Workspace
from implicam.calibrators import ForwardGP, ForwardGPCalibration, load_calibration
from implicam.dataset import Camera, Dataset, read_dataset
from implicam.dataset.image_bounds import are_on_image
from implicam.dataset.wand import Wand
from implicam.detect import Detected, View
from implicam.detect.wand import WandMarkers
from implicam.errors import UsageError
from implicam.geometry import register
from implicam.hardware import Frame, Person
from implicam.hardware.simulated_wave import SimulatedWave
from implicam.session.by_hand import Judgement
from implicam.session.controller import Equipment
from implicam.session.detections import Look
from implicam.session.folder import is_session
from implicam.session.journal import Session
from implicam.session.setup import Setup
from implicam.session.wand_session import CLUTTERED, FEW, TOO_FAST, UNTOLD, WandController, WandState, _surer
from implicam.session.wand_setup import made_wand_session, wand_settings
from implicam.simulate import Rig, as_wand, build_rig, simulate, waved_wand
from implicam.viewer.wand_words import headline, wand_snapshot


def wave(rig: Rig, frames: int, seed: int = 3, **options: float) -> Dataset:
    target = waved_wand(rig, frames, np.random.default_rng(seed))
    return as_wand(simulate(rig, target, seed=seed, **options), target)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return build_rig("stereo", seed=1)


@pytest.fixture(scope="module")
def data(rig: Rig) -> Dataset:
    return wave(rig, 60)


@pytest.fixture(scope="module")
def calibration(data: Dataset) -> ForwardGPCalibration:
    return ForwardGP(wand=144.0).fit(data)


@pytest.fixture(scope="module")
def design(calibration: ForwardGPCalibration) -> WaveDesign:
    assert calibration.wand is not None
    return WaveDesign.of(calibration, calibration.wand, None)


def volume_of(rig: Rig, target: Any, calibration: ForwardGPCalibration) -> Workspace:
    """The rig's volume in the frame of the calibration."""
    row = {str(name): i for i, name in enumerate(target.points)}
    pose, _ = register(target.xyz[[row[str(name)] for name in calibration.data.points]], calibration.data.xyz)
    return Workspace.hull(pose.apply(Workspace.from_box(rig.volume).vertices))


# --- the judge ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_position_is_said_to_be_known_as_well_as_measuring_it_says(design, calibration):
    """In the judged places the predicted covariance is that which a measurement of the same views states."""
    few = design.judged.select(np.arange(25))
    uv = np.where(few.seen[..., None], few.uv, np.nan)
    measured = calibration.measure_pixels(uv)
    good = design._counted[:25] & np.isfinite(measured.cov).all(axis=(1, 2))
    assert good.sum() > 15
    stated, predicted = (
        np.sqrt(np.trace(c[good], axis1=1, axis2=2)) for c in (measured.cov, design.at_judged.total[:25])
    )
    np.testing.assert_allclose(predicted, stated, rtol=0.02)


def test_the_places_of_a_wand_are_integrated_out(design):
    """Against the whole normal matrix of unknowns and places, inverted."""
    rng = np.random.default_rng(1)
    _, ends = design._candidates(rng)
    told = design._told(ends[:, :1])
    i = int(np.argmax(np.abs(told).sum(axis=(1, 2)) > 0))
    L, flat = told[i], ends[i, 0]
    seen = are_on_image(design.rig.trained, design.rig.predict(flat))
    assert seen.all()
    part = linear_views(design.rig, flat, seen)
    H = np.concatenate([*(part.half / part.sd[..., None]), np.zeros((1, part.half.shape[2]))])
    K = np.zeros((len(H), 6))
    K[:4, :3], K[4:8, 3:] = part.slope[0] / part.sd[0][:, None], part.slope[1] / part.sd[1][:, None]
    for axis in range(3):  # of the length, numerically
        step = 1e-4 * np.eye(3)[axis]
        long = np.linalg.norm(flat[1] + step - flat[0]) - np.linalg.norm(flat[1] - flat[0])
        K[8, 3 + axis] = long / 1e-4 / design.wand.jitter
        K[8, axis] = -K[8, 3 + axis]
    joint = np.block([[np.eye(H.shape[1]) + H.T @ H, H.T @ K], [K.T @ H, K.T @ K]])
    marginal = np.linalg.inv(joint)[: H.shape[1], : H.shape[1]]
    np.testing.assert_allclose(np.linalg.inv(np.eye(H.shape[1]) + L.T @ L), marginal, atol=2e-4)


def test_the_gain_is_what_the_weighted_variance_loses(design):
    _, ends = design._candidates(np.random.default_rng(2))
    L = design._told(ends[:3])
    M = design._moved[0].reshape(-1, L.shape[2])
    for one, gain in zip(L, _gains(L, M), strict=True):
        after = np.linalg.inv(np.eye(one.shape[1]) + one.T @ one)
        assert gain == pytest.approx(np.trace(M @ M.T) - np.trace(M @ after @ M.T), rel=1e-6)


def test_cells_count_views_and_the_emptiest_is_far_from_what_was_seen():
    uv = np.array([[0.0, 0.0], [199.9, 0.0], [1279.0, 799.0], [np.nan, np.nan], [1500.0, 10.0]])
    views = count_views(uv, (1280, 800))
    assert views.shape == (4, 6)
    assert (views[0, 0], views[3, 5], views.sum()) == (2, 1, 3)
    assert count_views(uv, (800, 1280)).shape == (6, 4)
    nothing = unknown_cells(np.zeros((0, 2)), (1280, 800))
    assert 0.4 < nothing.emptiest[0] < 0.6  # begin in the middle
    left = np.zeros((4, 6))
    left[:, :3] = 3
    assert Cells(np.minimum(left / 3, 1), left).emptiest[0] > 0.9


@pytest.mark.slow
def test_a_half_of_the_volume_that_was_never_waved_at_is_red_and_is_named(rig):
    """All frames in the left half of what cam1 sees: the other half is uncertain, and there it is to be waved."""
    target = waved_wand(rig, 240, np.random.default_rng(5))
    whole = as_wand(simulate(rig, target, seed=5), target)
    ends = ends_of(whole, Wand())
    left = np.flatnonzero((ends[:, :, 0, 0] < 640).all(axis=1))[:60]
    rows = np.isin(whole.columns["frame"], [str(f + 1) for f in left])
    some = whole.select(rows)
    calibration = ForwardGP(wand=144.0).fit(some)
    design = WaveDesign.of(calibration, calibration.wand, volume_of(rig, target, calibration))
    u = design.judged.uv[:, 0, 0]
    sd = design.at_judged.excess
    assert np.nanmedian(sd[u > 800]) > 1.3 * np.nanmedian(sd[u < 500])
    cells = design.cells(0, ends[left][:, :, 0].reshape(-1, 2), (1280, 800))
    assert np.nanmean(cells.known[:, 3:]) < np.nanmean(cells.known[:, :3])
    (place, *_) = design.next_places(1)
    assert place.uv[0, 0] > 640
    assert 0 < place.gain < 1


# --- the loop -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def loop(data: Dataset) -> WandLoop:
    rule = Below(1e-3, "usual") | Pictures(60, "frames")
    return WandLoop(ForwardGP(wand=144.0), Wand(length=144.0), data.cameras, rule=rule, data=data)


def test_before_there_is_a_calibration_each_camera_is_shown_what_it_has_not_seen(data):
    loop = WandLoop(ForwardGP(wand=144.0), Wand(length=144.0), data.cameras)
    (first,) = loop.ask()
    assert first.words.startswith("middle")
    assert "another camera sees it too" in first.words
    few = data.select(np.arange(40))
    loop.tell(few)
    assert loop.fit(few) is None
    assert loop.points == 20 < MIN_WHOLE_FRAMES
    (target,) = loop.ask()
    assert np.isfinite(target.uv).all(axis=1).sum() == 1
    assert [one.boards for one in loop.camera_progress()] == [20, 20]
    assert all(one.part < 0.5 for one in loop.camera_progress())


@pytest.mark.slow
def test_it_says_where_why_and_that_noise_alone_is_in_the_way(loop):
    assert loop.problem is None
    assert loop.stop == "all 60 frames of the budget are taken"
    assert loop.lengths is not None
    assert len(loop.lengths.errors) > 10
    assert "Pixel noise alone leaves" in loop.out_of_reach
    (target,) = loop.ask()
    assert target.words.endswith("mm from it")
    assert "is wanted" in target.why
    assert np.isfinite(target.xyz).all()
    (other,) = loop.ask()
    assert not np.allclose(other.xyz, target.xyz)
    assert all(0.5 < one.part <= 1 for one in loop.camera_progress())
    assert len(loop.history) == 1


def test_wrong_error_bars_are_never_enough(loop):
    """Lengths that were held out contradict them: the rule alone would stop."""
    other = replace(loop, rule=Within(50.0), data=None)
    other.data, other.history = loop.data, list(loop.history)
    other.fitted, other._fitted = loop.fitted, 60
    assert "times what pixel noise alone leaves" in other.stop
    other.fitted = loop.fitted._replace(faults=("The wand comes out 5 mm off.",))
    assert other.stop == ""
    assert other.contradictions == ("The wand comes out 5 mm off.",)


@pytest.mark.slow
def test_the_volume_of_a_session_is_in_the_frame_of_the_first_camera(rig, data):
    box = Workspace.hull(rig.cameras[0].camera_from_world.apply(Workspace.from_box(rig.volume).vertices))
    loop = WandLoop(ForwardGP(wand=144.0), Wand(length=144.0), data.cameras, box, data=data)
    assert loop.calibration is not None
    camera = loop.calibration.cameras["cam1"].camera_from_world
    assert camera is not None
    there = camera.apply(loop.workspace.vertices)
    np.testing.assert_allclose(np.sort(there, axis=0)[[0, -1]], np.sort(box.vertices, axis=0)[[0, -1]], atol=20)


# --- the session ----------------------------------------------------------------------------------------------------


class TableCamera:
    """A camera whose pictures show nothing: `TableDetector` knows where the ends are."""

    live = simulated = True

    def __init__(self, rig: Rig, c: int, hand: SimulatedWave) -> None:
        camera = rig.cameras[c]
        self.name, self.hand, self.number = camera.name, hand, c
        self.picture = np.tile(np.linspace(0, 1, camera.width, dtype=np.float32), (camera.height, 1))

    def open(self) -> None:
        pass

    def frame(self, timeout: float = 5.0) -> Frame:
        self.hand.held(self.number)
        return Frame(self.picture.copy(), 1, time.time())

    def close(self) -> None:
        pass


class TableDetector(WandMarkers):
    """Where the simulated hand holds the ends, with noise; nothing where a camera does not see both."""

    def detect(self, picture: Any, view: View) -> Detected:
        rig, hand = HANDS[0]
        camera = next(one for one in rig.cameras if one.name == view.camera)
        uv, inside = camera.pixel_from_world(hand.shown(hand._held[0]).xyz)
        if not inside.all():
            return Detected(reason="one marker only", notes={"spots": [[0.0] * 6]})
        noise = 0.2 * RNG.normal(size=(2, 2))
        return Detected((f"{view.shot}-a", f"{view.shot}-b"), uv + noise, np.full((2, 2), 0.2), notes={"spots": []})

    def settle(self, found: Any) -> Any:
        return dict(found)


HANDS: list[tuple[Rig, SimulatedWave]] = []
RNG = np.random.default_rng(4)


def session_of(folder: Path, **options: Any) -> WandController:
    """A session with the stereo rig whose pictures are made up."""
    rig = build_rig("stereo", seed=1)
    hand = SimulatedWave(rig, 144.0, seed=3)
    HANDS[:] = [(rig, hand)]
    setup = Setup(rig="stereo", seed=1, target="wand", **options)
    cameras = [TableCamera(rig, c, hand) for c in range(2)]
    if is_session(folder):
        session = Session.open(folder)
    else:
        sized = tuple(Camera(camera.name, camera.width, camera.height) for camera in rig.cameras)
        kept = {**setup.as_settings(), **wand_settings(setup)}
        session = Session.create(folder, name="s", length_unit="mm", cameras=sized, settings=kept)
    robot = Person(lambda _: None, (np.nan,) * 3)
    return made_wand_session(session, setup, Equipment(cameras, robot, TableDetector(length=144.0)), None)


def wave_at(controller: WandController, frames: int) -> None:
    while controller.loop.points < frames:
        controller.live()
        controller.step()


def test_frames_are_on_disk_before_they_are_counted_and_a_kill_loses_none(tmp_path):
    with session_of(tmp_path / "s") as controller:
        controller._hand.seconds = 0.0
        controller.start()
        assert controller.state.phase == "aim"
        assert controller.state.target.words.startswith("middle of cam")
        wave_at(controller, 5)
        (tmp_path / "killed").mkdir()
        shutil.copy(tmp_path / "s" / "session.db", tmp_path / "killed")  # as the disk is after kill -9
        kept = controller.state.taken
        assert kept == 5
        assert (
            wand_snapshot(controller.state, ["cam1", "cam2"], controller.loop.rule, unit="mm", skipped=0)["numbers"][
                "points"
            ]
            == kept
        )
    with session_of(tmp_path / "killed") as again:
        again._hand.seconds = 0.0
        again.start()
        assert again.loop.points == kept
        assert set(again.session.data.columns["marker"].tolist()) == {"a", "b"}
        again.remove("p002")
        assert again.loop.points == kept - 1
    data = read_dataset(tmp_path / "killed")
    assert set(data.columns["frame"].tolist()) == {"p001", "p003", "p004", "p005"}
    assert data.extra["target"]["length"] == 144.0


def test_what_would_be_wrong_is_left_out_and_counted_by_why(tmp_path):
    with session_of(tmp_path / "s") as controller:
        look = Look(
            "cam1", None, Detected(reason="?", notes={"spots": [[0.0] * 6] * 2, "log_ratio": 0.01}), np.zeros(2)
        )
        assert controller._judge((look,)) == (False, UNTOLD)
        many = replace(look, found=Detected(reason="?", notes={"spots": [[0.0] * 6] * 4}))
        assert controller._judge((many,)) == (False, CLUTTERED)
        nobody = replace(look, found=Detected(reason="no marker", notes={"spots": []}))
        assert controller._judge((nobody,)).reason == FEW
        assert controller._left_out == {UNTOLD: 1, CLUTTERED: 1}  # where nobody waves nothing is left out
        controller._require_target = lambda: None  # type: ignore[assignment]
        controller._detect_all = lambda frames, **_: (nobody,)  # type: ignore[method-assign]
        with pytest.raises(UsageError, match="nothing was kept"):
            controller.go()


def test_cameras_without_a_trigger_take_no_wand_that_is_fast(tmp_path):
    with session_of(tmp_path / "s") as controller:
        controller._simulated = False

        def at(u: float) -> tuple[Look, ...]:
            found = Detected(("1-a", "1-b"), np.array([[u, 100.0], [u, 300.0]]), np.full((2, 2), 0.2))
            return tuple(Look(name, Frame(np.zeros((2, 2)), 1, 0.0), found, np.zeros(2)) for name in ("cam1", "cam2"))

        controller._judge(at(100))
        controller._before = (time.monotonic() - 0.2, controller._before[1])
        assert controller._judge(at(160)).reason == TOO_FAST  # 300 px a second: 10 px within a thirtieth
        controller._before = (time.monotonic() - 0.2, controller._before[1])
        assert controller._judge(at(161)) == (True, "")
        controller._kept = controller._before[1]
        controller._before = (time.monotonic() - 0.2, controller._before[1])
        assert controller._judge(at(162)) == (False, "")  # as the one before


@pytest.mark.slow
def test_a_session_by_itself_calibrates_reports_and_says_what_it_rests_on(tmp_path):
    with session_of(tmp_path / "s", budget=70) as controller:
        path = controller.run()
        state = controller.state
        assert path is not None
        assert state.phase == "done"
        assert state.stop == "all 70 frames of the budget are taken"
        assert "held-out lengths 14" in state.lengths
        assert "both ends of the wand in" in state.verdict[0]
        assert state.report is not None
        snapshot = wand_snapshot(state, ["cam1", "cam2"], controller.loop.rule, unit="mm", skipped=0)
        assert snapshot["title"].startswith(("Done", "Calibrated"))
        assert len(snapshot["cameras"][0]["cells"]) == 4
        assert controller.loop.design is not None
        assert len(controller.loop.design.good) == len(controller.loop.judged_at)
    calibration = load_calibration(path)
    assert calibration.wand.length == 144.0
    again = ForwardGP().fit(read_dataset(tmp_path / "s"))
    np.testing.assert_allclose(again.data.xyz, calibration.data.xyz, atol=1e-6)


def test_the_page_says_where_to_wave_and_never_enough_where_lengths_contradict():
    state = WandState(
        phase="aim", auto=True, stop="0.29 mm in 95 % of the workspace", lengths="held-out lengths 500 mm"
    )
    assert headline(state).title == "Enough: 0.29 mm in 95 % of the workspace"
    assert "Held-out lengths 500 mm." in headline(state).detail
    assert headline(replace(state, contradictions=("5 mm off.",))).kind == "bad"
    target = WaveTarget(
        "p1",
        np.full(3, np.nan),
        np.full((2, 2), np.nan),
        words="left third, upper part of cam2, 300 mm from it",
        why="red",
    )
    assert (
        headline(WandState(phase="aim", auto=True, target=target)).title
        == "Wave it in the left third, upper part of cam2"
    )
    untold = WandState(phase="aim", auto=True, target=target, judgement=Judgement(False, UNTOLD))
    assert "turn the wand across" in headline(untold).detail
    assert headline(replace(untold, auto=False)).title.startswith("Paused")


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"cameras": ("left=0", "right=1")}, "the length of the wand is not known"),
        ({"method": "inverse-gp"}, "takes no wand"),
        ({"told_by": "colour"}, "not told apart by 'colour'"),
        ({"robot": "ur:10.0.0.1", "wand": 500.0, "cameras": ("left=0",)}, "waves no wand"),
        ({"poses": "x=0 y=0 z=0:190:10"}, "those of a board"),
    ],
)
def test_what_is_wrong_with_a_session_with_a_wand_is_said_first(options, what):
    with pytest.raises(UsageError, match=what):
        Setup(**{"target": "wand", **options})
    assert Setup(target="wand").most == 1000


# --- afterwards -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_suggest_says_of_a_recording_whether_it_was_waved_enough(calibration, cli):
    calibration.save("w.implicam")
    told = cli("suggest", "w.implicam", "--below", "30", "--json").json
    assert told["enough"]
    assert told["places"][0]["words"].endswith("mm from it")
    assert set(told["cells"]) == {"cam1", "cam2"}
    out = cli("suggest", "w.implicam", "-n", "2", "-o", "where.csv").out
    assert "Not enough. Where to wave next:" in out
    assert "Held-out lengths 14" in out
    assert len(Path("where.csv").read_text().splitlines()) == 3


def test_a_wand_near_the_cameras_is_told_by_each_picture_where_a_few_together_leave_it_open():
    clear = Detected(("1-a", "1-b"), np.zeros((2, 2)), np.ones((2, 2)), notes={"log_ratio": 0.4})
    nothing = Detected(reason="which end is which is not sure")
    assert _surer(clear, nothing, 0.2) is clear
    assert _surer(replace(clear, notes={"log_ratio": 0.15}), nothing, 0.2) is nothing
    assert _surer(nothing, clear, 0.2) is clear  # what stands still was left out


@pytest.mark.slow
def test_a_camera_that_never_sees_the_wand_together_with_another_is_named_and_is_never_enough():
    """As in JARVIS-AcquisitionTool issue 18: two of seven cameras rarely or never see the target with the others."""
    data = wave(build_rig("bar3", seed=1), 75)
    alone = np.array([int(frame) > 55 for frame in data.columns["frame"]])
    uv = data.observations.uv.copy()
    uv[~alone, 2], uv[alone, :2] = np.nan, np.nan
    sd = np.where(np.isfinite(uv), data.observations.sd, np.nan)
    extra = {}  # the truth of a simulation, which is not missing where a view is
    data = replace(data, observations=replace(data.observations, uv=uv, sd=sd, extra=extra))
    length = float(data.extra["target"]["length"])
    loop = WandLoop(ForwardGP(), Wand(("a", "b"), length), data.cameras, rule=Within(50.0), data=data)
    assert loop.calibration is not None
    assert loop.points == 55
    assert loop.stop == ""
    cold = [target for target in (loop.ask()[0], loop.ask()[0]) if target.words.endswith("another camera sees it too")]
    assert "of cam3, where another camera sees it too" in cold[0].words
    assert loop.camera_progress()[2].part < 0.5 < loop.camera_progress()[0].part
