"""The world of a calibration from a wand: an L-frame, known points, axes, a plane, a plumb line, a camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import implicam as ic
from command_line import Cli, cli  # noqa: F401  a fixture
from implicam.calibrators import ForwardGP, ForwardGPCalibration, load_calibration
from implicam.calibrators.forward_gp.wand.gauge import cameras_move_with_the_world
from implicam.dataset import Dataset, write_dataset
from implicam.derived import distances, joint
from implicam.errors import DatasetError, FitError, UsageError
from implicam.geometry import Floats, Pose, rotation_from_vector
from implicam.measurement import Measurement, SharedErrors
from implicam.rig_model import CentralCamera
from implicam.rig_model.placement import lay_anew, placement_at_camera, step_between
from implicam.simulate import Rig, Target, as_wand, build_rig, random_positions, simulate, waved_wand
from implicam.world import lay_over, set_world, with_known_positions

FRAME = {"o": (0, 0, 0), "x1": (0.5, 0, 0), "x2": (1, 0, 0), "y": (0, 1, 0)}
"""An L-frame, its long arm being one."""


class Waving(NamedTuple):
    """A rig, a calibration from a wand, the true places of an L-frame, what the cameras saw of it."""

    rig: Rig
    calibration: ForwardGPCalibration
    corner: Pose
    edge: float
    seen: Dataset

    def in_frame(self, xyz: Floats) -> Floats:
        """True positions (n, 3) in the world of the L-frame."""
        return self.corner.inverse().apply(xyz)


def show(rig: Rig, names: Sequence[str], xyz: Floats, seed: int) -> Dataset:
    """What the cameras see of points, without positions."""
    seen = simulate(rig, Target("seen", np.array(names), np.array(names), xyz), seed=seed)
    return replace(seen, known=None)


def known_as(seen: Dataset, xyz: Floats, sd: float = np.nan) -> Dataset:
    """The same with positions."""
    known = ic.KnownPositions(seen.points, xyz, np.full(xyz.shape, sd))
    return replace(seen, known=known)


def wave(spec: str, frames: int, seed: int) -> Waving:
    rig = build_rig(spec, seed=seed)
    target = waved_wand(rig, frames, np.random.default_rng(seed))
    calibration = ForwardGP(wand=target.wand or 0.0).fit(as_wand(simulate(rig, target, seed=seed), target))
    edge = 0.5 * float(min(rig.volume.size))
    # its z looks to the cameras, as that of a frame on the floor below them does
    flipped = rig.volume.world_from_box @ Pose(np.diag([1.0, -1.0, -1.0]), np.array([-0.4, 0.4, 0]) * edge)
    seen = show(rig, list(FRAME), flipped.apply(edge * np.array(list(FRAME.values()), dtype=float)), seed + 50)
    return Waving(rig, calibration, flipped, edge, seen)


@pytest.fixture(scope="module")
def waving() -> Waving:
    return wave("stereo", 60, 4)


@pytest.fixture(scope="module")
def frame(waving: Waving) -> Dataset:
    return known_as(waving.seen, waving.edge * np.array(list(FRAME.values()), dtype=float))


def held_out(waving: Waving, n: int = 30) -> Dataset:
    return simulate(waving.rig, random_positions(waving.rig, n, np.random.default_rng(8)), seed=800)


def nees(calibration: ForwardGPCalibration, held: Dataset, truth: Floats) -> float:
    """Joint NEES of all positions together, over the degrees of freedom."""
    measured = calibration.measure(held.observations)
    rows = np.flatnonzero(measured.measured)
    found = joint(measured, rows.tolist())
    off = (found.xyz - truth[rows]).ravel()
    return float(off @ np.linalg.solve(found.cov, off)) / len(off)


def test_known_points_say_where_the_world_is(waving: Waving, frame: Dataset) -> None:
    in_world = set_world(waving.calibration, frame)
    held = held_out(waving)
    assert held.truth is not None
    truth = waving.in_frame(held.truth.xyz)
    measured = in_world.measure(held.observations)
    off = np.linalg.norm(measured.xyz - truth, axis=1)
    assert np.median(off / np.sqrt(np.trace(measured.cov, axis1=1, axis2=2))) < 1.5
    assert 0.4 < nees(in_world, held, truth) < 2.0
    assert in_world.notes[0].startswith("The world is that of 4 known points")
    assert not any("The world is the wand's" in note for note in in_world.notes)


@pytest.mark.parametrize("sd", [np.nan, 0.01])
def test_error_bars_contain_what_known_points_contradict(waving: Waving, frame: Dataset, sd: float) -> None:
    """An L-frame measured with a wrong ruler: 1.5 % too large, which the wand knows better."""
    large = known_as(waving.seen, 1.015 * waving.edge * np.array(list(FRAME.values()), dtype=float), sd)
    calibration, held = set_world(waving.calibration, large), held_out(waving)
    assert held.truth is not None
    said = " ".join(calibration.world)
    assert "% as far apart as the wand says" in said
    assert "the error bars contain it" in said
    measured = calibration.measure(held.observations)
    off = measured.xyz - waving.in_frame(held.truth.xyz)
    assert np.mean(np.einsum("ni,nij,nj->n", off, np.linalg.inv(measured.cov), off) < 7.81) > 0.85
    own = set_world(waving.calibration, frame).measure(held.observations)
    assert np.mean(np.trace(measured.cov, axis1=1, axis2=2) / np.trace(own.cov, axis1=1, axis2=2)) > 2


def test_a_point_off_the_plane_is_named_and_error_bars_contain_it(waving: Waving) -> None:
    corner = waving.edge * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, -0.1]])
    names = ["o", "x", "y", "high"]
    seen = show(waving.rig, names, waving.corner.apply(corner), 71)
    laid = set_world(waving.calibration, seen, plane=names, x=["o", "x"], origin="o")
    assert "not on one plane" in laid.world[1]
    assert "the error bars of this world contain it" in laid.world[1]
    measured = laid.measure(seen)
    off = measured.xyz - corner
    assert (np.abs(off[:3, 2]) < 2.5 * np.sqrt(measured.cov[:3, 2, 2])).all()
    assert np.abs(off[:3, 2]).max() > 0.01 * waving.edge  # the plane is wrong, and its error bars say so


def test_distances_are_what_they_were(waving: Waving, frame: Dataset) -> None:
    held = held_out(waving)
    pairs = [(0, i) for i in range(1, 20)]
    for other in (set_world(waving.calibration, frame), set_world(waving.calibration, camera="cam2")):
        before, after = (distances(one.measure(held), pairs) for one in (waving.calibration, other))
        for one, two in zip(before, after, strict=True):
            assert two.value == pytest.approx(one.value, rel=1e-9)
            assert two.sd == pytest.approx(one.sd, rel=1e-4)


def test_the_pose_of_the_camera_that_is_the_world_is_certain(waving: Waving) -> None:
    posterior, working = waving.calibration.posterior, waving.calibration.frame
    middle = np.array([30.0, -20.0, 10.0])
    model = posterior.models[1].camera
    assert isinstance(model, CentralCamera)
    here = Pose(model.pose.rotation, working.scale * model.pose.translation - model.pose.rotation @ working.offset)
    placement = placement_at_camera(model, posterior.root(1), working, here, middle)
    moved, frame, step = lay_anew(posterior, working, None, placement)
    assert posterior.joint is not None
    root = step.root(posterior.joint, cameras_move_with_the_world(moved.models, np.zeros(3)))
    after = replace(moved, joint=root)
    own = slice(model.size - 6, model.size)
    certain = np.abs(after.root(1)[:, own]).max(axis=0)
    assert (certain < 1e-5 * np.abs(posterior.root(1)[:, own]).max(axis=0)).all()
    camera = after.models[1].camera
    assert isinstance(camera, CentralCamera)
    assert np.allclose(camera.pose.rotation, np.eye(3), atol=1e-12)
    assert np.allclose(frame.scale * camera.pose.translation, frame.offset, atol=1e-9)
    # what is known of the lenses does not depend on the world
    for c in (0, 1):
        lens = slice(0, model.size - 6)
        before, now = (one[:, lens].T @ one[:, lens] for one in (posterior.root(c), after.root(c)))
        np.testing.assert_allclose(now, before, rtol=1e-6, atol=1e-9 * np.abs(before).max())


def test_it_does_not_matter_which_worlds_came_before(waving: Waving, frame: Dataset) -> None:
    held = held_out(waving)
    straight = set_world(waving.calibration, frame).measure(held)
    roundabout = set_world(set_world(set_world(waving.calibration, camera="cam2"), camera="cam1"), frame).measure(held)
    np.testing.assert_allclose(roundabout.xyz, straight.xyz, atol=0.01)
    np.testing.assert_allclose(roundabout.cov, straight.cov, rtol=0.01, atol=1e-4)


def test_the_step_between_two_poses_moves_places_so() -> None:
    rng = np.random.default_rng(0)
    before = Pose(rotation_from_vector([0.3, -0.8, 0.2]), np.array([5.0, 2.0, -7.0]))
    middle, x, h = np.array([1.0, 2.0, 3.0]), rng.normal(size=(4, 3)), 1e-5 * rng.normal(size=6)
    turn = rotation_from_vector(h[:3])
    after = before @ Pose(turn, middle - turn @ middle + h[3:])
    np.testing.assert_allclose(step_between(before, after, middle), h, atol=1e-9)
    moved = x + np.cross(h[:3], x - middle) + h[3:]
    np.testing.assert_allclose(after.apply(x), before.apply(moved), atol=1e-8)


def test_axes_by_points(waving: Waving) -> None:
    by_axes = set_world(waving.calibration, waving.seen, origin="o", x="x2", y="y")
    again = by_axes.measure(waving.seen)
    at = {str(name): xyz for name, xyz in zip(again.points, again.xyz, strict=True)}
    assert np.abs(at["o"]).max() < 0.5  # of its own noise: to measure a point again is not to know it
    assert np.abs(at["x2"][1:]).max() < 0.5
    assert at["x2"][0] > 0.9 * waving.edge
    assert at["y"][1] > 0.9 * waving.edge
    held = held_out(waving)
    assert held.truth is not None
    truth = waving.in_frame(held.truth.xyz)
    assert 0.4 < nees(by_axes, held, truth) < 2.0
    plane = set_world(waving.calibration, waving.seen, plane=["o", "x1", "x2", "y"], x=["o", "x2"], origin="o")
    assert 0.4 < nees(plane, held, truth) < 2.0
    assert "x points from o to x2" in plane.world[0]


def test_a_plumb_line_says_what_is_up(waving: Waving) -> None:
    world = waving.rig.volume.world_from_box
    line = waving.edge * np.array([[-0.3, 0.2, 0.9], [-0.3, 0.2, 0.1], [-0.3, 0.2, -0.8]])
    seen = show(waving.rig, ["top", "middle", "bottom"], world.apply(line), 61)
    upright = set_world(waving.calibration, seen, down=["top", "middle", "bottom"], origin="bottom")
    found = upright.measure(seen)
    assert np.abs(found.xyz[2]).max() < 0.5
    assert found.xyz[0] == pytest.approx([0, 0, 1.7 * waving.edge], abs=1.0)
    bent = world.apply(line + waving.edge * np.array([[0, 0, 0], [0.3, 0, 0], [0, 0, 0]]))
    with pytest.raises(FitError, match="not on one plumb line: b is"):
        set_world(waving.calibration, show(waving.rig, ["a", "b", "c"], bent, 62), down=["a", "b", "c"])


def test_what_falls_says_what_is_up(waving: Waving) -> None:
    world, n = waving.rig.volume.world_from_box, 25
    t = np.linspace(0, 1, n)
    way = waving.edge * np.stack([-0.8 + 1.6 * t, 0.3 * t, -0.4 + 3.6 * t - 3.8 * t**2], axis=1)  # thrown
    frames = np.array([str(100 + i) for i in range(n)])
    points = [f"{f} ball" for f in frames]
    seen = show(waving.rig, points, world.apply(way), 64)
    seen = replace(seen, columns={"frame": frames, "marker": np.full(n, "ball")})
    upright = set_world(waving.calibration, seen, falling="ball")
    assert "falling thing in 25 frames" in upright.world[0]
    assert len(upright.world) == 1
    measured = upright.measure(seen)
    bend = np.polyfit(t, measured.xyz, 2)[0]
    assert bend[2] < 0
    held = held_out(waving)
    assert held.truth is not None
    # which way the line through two measured points rises is known wherever the origin is
    up = upright.measure(held)
    line = np.array([world.apply(np.array([[0, 0, z]]))[0] for z in (0.0, 1.0)])
    rise = held.truth.xyz @ (line[1] - line[0])
    assert np.polyfit(rise, up.xyz[:, 2], 1)[0] == pytest.approx(1, abs=0.02)
    with pytest.raises(UsageError, match="in 3 frames"):
        set_world(
            waving.calibration, replace(seen.select([0, 9, 20]), columns=_first(seen, [0, 9, 20])), falling="ball"
        )
    with pytest.raises(DatasetError, match="no marker 'bal'"):
        set_world(waving.calibration, seen, falling="bal")
    flat = show(waving.rig, points, world.apply(way * [1, 1, 0.0]), 65)
    with pytest.raises(FitError, match="bends too little"):
        set_world(waving.calibration, replace(flat, columns=seen.columns), falling="ball")
    carried = way + waving.edge * 0.2 * np.sin(9 * t)[:, None]
    jumping = replace(show(waving.rig, points, world.apply(carried), 66), columns=seen.columns)
    with pytest.raises(FitError, match="do not fall freely"):
        set_world(waving.calibration, jumping, falling="ball")


def _first(data: Dataset, rows: list[int]) -> dict[str, np.ndarray]:
    return {name: np.asarray(column)[rows] for name, column in data.columns.items()}


def test_a_camera_is_the_world(waving: Waving) -> None:
    here = set_world(waving.calibration, camera="cam2")
    pose = here.cameras["cam2"].camera_from_world
    assert pose is not None
    assert np.allclose(pose.rotation, np.eye(3), atol=0.01)
    held = held_out(waving)
    assert held.truth is not None
    assert 0.4 < nees(here, held, waving.rig.cameras[1].camera_from_world.apply(held.truth.xyz)) < 2.0


def test_a_file_keeps_the_world(waving: Waving, frame: Dataset, tmp_path: Path) -> None:
    in_world = set_world(waving.calibration, frame)
    in_world.save(tmp_path / "world.implicam")
    again = load_calibration(tmp_path / "world.implicam")
    one, two = in_world.measure(waving.seen), again.measure(waving.seen)
    np.testing.assert_array_equal(one.xyz, two.xyz)
    np.testing.assert_array_equal(one.cov, two.cov)
    assert again.notes == in_world.notes
    assert again.data.xyz == pytest.approx(in_world.data.xyz)


def test_a_stated_motion_is_exact(waving: Waving) -> None:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_vector([0.1, 2.0, -0.4]), [10.0, 20.0, 30.0]
    moved, seen = waving.calibration.transformed(pose), waving.seen
    one, two = waving.calibration.measure(seen).transformed(pose), moved.measure(seen)
    np.testing.assert_allclose(two.xyz, one.xyz, atol=1e-6)
    np.testing.assert_allclose(two.cov, one.cov, rtol=1e-5, atol=1e-9)


def test_declared_errors_of_the_frame_are_in_the_error_bars(waving: Waving, frame: Dataset) -> None:
    assert frame.known is not None
    seen, sd = held_out(waving), 2.0
    exact, vague = (
        set_world(waving.calibration, replace(frame, known=replace(frame.known, sd=np.full((4, 3), one))))
        for one in (1e-4, sd)
    )
    more = np.trace(vague.measure(seen).cov - exact.measure(seen).cov, axis1=1, axis2=2)
    # four points, each off by sd: the shift alone is off by sd / 2 along each axis, and the turn comes on top
    assert (more > 3 * sd**2 / 4).all()
    assert (more < 40 * sd**2).all()


def test_wrong_frames_are_named(waving: Waving, frame: Dataset) -> None:
    assert frame.known is not None
    xyz = frame.known.xyz
    with pytest.raises(FitError, match="times as far apart as the wand says") as raised:
        set_world(waving.calibration, known_as(waving.seen, xyz * 1000.3))
    assert "two length units" in raised.value.why
    with pytest.raises(FitError, match="times as far apart as the wand says"):
        set_world(waving.calibration, known_as(waving.seen, xyz * 1.2))
    near = set_world(waving.calibration, known_as(waving.seen, xyz * 1.012, 0.01))
    assert any("% as far apart as the wand says" in note for note in near.world)
    with pytest.raises(FitError, match="on one line"):
        set_world(waving.calibration, frame.select([0, 1, 2]))
    with pytest.raises(DatasetError, match="2 of the known points"):
        set_world(waving.calibration, frame.select([0, 1]))
    one_camera = frame.observations.uv.copy()
    one_camera[:2, 1] = np.nan
    lost = replace(frame, observations=replace(frame.observations, uv=one_camera, extra={}))
    with pytest.raises(DatasetError, match="2 of the known points") as named:
        set_world(waving.calibration, lost)
    assert "o: " in named.value.why


def test_a_mirrored_frame_is_named(waving: Waving) -> None:
    box = waving.edge * np.array([[-1, -1, -1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [0.5, 0.8, 0.6]]) * 0.4
    seen = show(waving.rig, list("abcde"), waving.rig.volume.world_from_box.apply(box), 63)
    set_world(waving.calibration, known_as(seen, box))
    with pytest.raises(FitError, match="as in a mirror"):
        set_world(waving.calibration, known_as(seen, box * [1, 1, -1]))
    wrong = box.copy()
    wrong[3] += 12.0
    noted = set_world(waving.calibration, known_as(seen, wrong, 0.05))
    assert "are not used: d." in noted.world[1]


def test_a_frame_below_which_everything_lies_is_told(waving: Waving, frame: Dataset) -> None:
    assert frame.known is not None
    exchanged = replace(frame, known=replace(frame.known, xyz=frame.known.xyz[:, [1, 0, 2]]))
    upside_down = set_world(waving.calibration, exchanged)
    assert "below the plane z = 0" in upside_down.world[-1]
    assert "below the plane z = 0" not in set_world(waving.calibration, frame).world[-1]


def test_markers_that_stand_still_are_points(waving: Waving, frame: Dataset) -> None:
    assert frame.known is not None
    uv = np.concatenate([frame.observations.uv, frame.observations.uv + 0.1])
    markers = np.tile(np.array(list(FRAME)), 2)
    frames = np.repeat(["1", "2"], 4)
    points = np.array([f"{f} {m}" for f, m in zip(frames, markers, strict=True)])
    seen = Dataset.from_arrays(uv, points=points, cameras=frame.observations.cameras, unit="mm")
    seen = replace(seen, columns={"frame": frames, "marker": markers})
    names = list(FRAME)
    both = with_known_positions(seen, [*names, "elsewhere"], _more(frame.known))
    assert both.points.tolist() == names
    in_world = set_world(waving.calibration, both)
    assert "4 known points" in in_world.world[0]
    assert set_world(waving.calibration, seen, origin="o", x="x2", y="y").world[0].startswith("The world is laid")
    moving = seen.observations.uv.copy()
    moving[4:] += 40
    moved = replace(seen, observations=replace(seen.observations, uv=moving))
    with pytest.raises(DatasetError, match="marker 'o' moves"):
        set_world(waving.calibration, moved, origin="o", x="x2", y="y")
    with pytest.raises(DatasetError, match="none of the 1 known points"):
        with_known_positions(seen, ["zz"], frame.known.select([0]))


def _more(known: ic.KnownPositions) -> ic.KnownPositions:
    xyz = np.concatenate([known.xyz, [[1.0, 2.0, 3.0]]])
    return ic.KnownPositions(np.array([*known.shots, "e"]), xyz, np.full(xyz.shape, np.nan))


@pytest.mark.parametrize(
    ("asked", "what"),
    [
        ({}, "no known positions"),
        ({"x": "x2", "y": "y"}, "no point is that"),
        ({"origin": "o"}, "too little"),
        ({"plane": ["o", "x1"]}, "no plane"),
        ({"plane": ["o", "x1", "x2"]}, "on one line"),
        ({"down": ["o"]}, "no plumb line"),
        ({"plane": ["o", "x1", "y"], "down": ["o", "y"]}, "both say"),
        ({"plane": ["o", "x1", "y"], "y": "y"}, "say where y points"),
        ({"origin": "o", "x": ["o", "x1", "x2"], "y": "y"}, "3 points are given"),
        ({"origin": "o", "x": "x2", "y": "why"}, "no point 'why'"),
        ({"origin": "o", "x": "x2", "y": "x1"}, "on one line"),
        ({"camera": "cam1"}, "takes no points"),
    ],
)
def test_what_says_no_world_is_refused(waving: Waving, asked: dict[str, object], what: str) -> None:
    with pytest.raises((UsageError, DatasetError, FitError), match=what):
        set_world(waving.calibration, waving.seen, **asked)  # type: ignore[arg-type]


def test_other_calibrations_have_their_world(waving: Waving, frame: Dataset) -> None:
    known = ForwardGP().fit(ic.simulated("stereo", points=30, seed=1))
    with pytest.raises(UsageError, match="that of its known positions"):
        set_world(known, frame)
    with pytest.raises(UsageError, match="nothing says"):
        set_world(waving.calibration)
    with pytest.raises(UsageError, match="is not calibrated"):
        set_world(waving.calibration, camera="cam9")


def test_the_command(waving: Waving, frame: Dataset, tmp_path: Path, cli: Cli) -> None:
    waving.calibration.save(tmp_path / "wand.implicam")
    write_dataset(frame, tmp_path / "l-frame")
    write_dataset(waving.seen, tmp_path / "seen")
    file, out = str(tmp_path / "wand.implicam"), str(tmp_path / "world.implicam")
    ran = cli("world", file, str(tmp_path / "l-frame"), "-o", out)
    assert ran.code == 0
    assert "The world is that of 4 known points" in ran.out
    first = load_calibration(Path(out))
    ran = cli("world", file, str(tmp_path / "seen"), "--points", str(tmp_path / "l-frame" / "points.csv"), "-o", out)
    assert ran.code == 0
    assert load_calibration(Path(out)).data.xyz == pytest.approx(first.data.xyz, abs=1e-6)
    ran = cli("world", file, str(tmp_path / "seen"), "--plane", "o,x1,x2,y", "--x", "o,x2", "-o", out, "--json")
    assert ran.json["world"][0].startswith("The world is laid by points")
    ran = cli("world", file, str(tmp_path / "seen"), "-o", out)
    assert ran.code == 2
    assert "no known positions" in ran.err
    ran = cli("world", file, "--camera", "cam1", "-o", file)
    assert ran.code == 2


@pytest.mark.slow
def test_what_is_left_after_laying_over_has_the_covariance_that_is_stated() -> None:
    rng, n, q, repeats = np.random.default_rng(5), 12, 9, 400
    xyz = rng.normal(size=(n, 3)) * [100, 80, 60]
    E = 0.3 * rng.normal(size=(n, 3, q))
    roots = 0.2 * rng.normal(size=(n, 3, 3))
    own = roots @ roots.swapaxes(1, 2) + 0.01 * np.eye(3)
    sd = np.full((n, 3), 0.1)
    away = Pose(rotation_from_vector([0.4, -1.0, 0.3]), np.array([500.0, 20.0, -300.0]))
    whitened = []
    for _ in range(repeats):
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(own), rng.normal(size=(n, 3)))
        known = xyz + sd * rng.normal(size=(n, 3))
        measured = _measured(xyz + E @ rng.normal(size=q) + noise, own, E)
        laid = lay_over(measured, away.apply(known), sd)
        off = laid.measurement.xyz - away.apply(known)
        cov = laid.measurement.cov + away.rotation @ (sd[:, :, None] ** 2 * np.eye(3)) @ away.rotation.T
        whitened.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(cov), off).mean())
    # the mean of a squared distance is 3, whatever six numbers were taken out
    assert np.mean(whitened) == pytest.approx(3.0, abs=4 * np.std(whitened) / np.sqrt(repeats))
    assert np.std(whitened) / np.sqrt(repeats) < 0.08


def _measured(xyz: Floats, own: Floats, E: Floats) -> Measurement:
    n = len(xyz)
    shared = SharedErrors(lambda rows: E[rows], np.arange(n), np.eye(3))
    names = np.array([f"p{i}" for i in range(n)])
    cov = own + E @ E.swapaxes(1, 2)
    return Measurement(
        names, xyz, cov, np.full(n, 2), np.full(n, 0.5), np.full(n, ""), "mm", shared=shared
    )  # fmt: skip


def test_a_world_of_its_own_is_laid_over_the_points_that_judge_it(waving: Waving, frame: Dataset) -> None:
    held = held_out(waving)
    judged = ic.evaluate(waving.calibration, held)
    assert "laid over the known ones by a rigid motion" in judged.how
    assert judged.coverage.overall.rmse < 1.5
    assert 1.0 < judged.coverage.overall.nees.value < 7.0
    elsewhere = ic.evaluate(set_world(waving.calibration, frame), held)
    assert "in another frame than the calibration" in elsewhere.notes[0]
    assert "laid over" not in elsewhere.how
    with pytest.raises(DatasetError, match="5 of the known points"):
        ic.evaluate(waving.calibration, held.select(range(5)))


@pytest.mark.slow
def test_without_known_points_a_report_is_of_lengths(waving: Waving, tmp_path: Path, cli: Cli) -> None:
    pytest.importorskip("plotly")
    waving.calibration.save(tmp_path / "wand.implicam")
    ran = cli("report", str(tmp_path / "wand.implicam"))
    assert ran.code == 0
    assert "Distances between both ends of the wand in 20 frames held out" in ran.out
    assert "No position is known." in (tmp_path / "report.html").read_text()


def test_a_wand_is_not_compared(tmp_path: Path, cli: Cli) -> None:
    cli("simulate", "wand", "--target", "wand", "--frames", "30", "--cameras", "2R")
    ran = cli("compare", "wand", "--methods", "forward-gp")
    assert ran.code == 2
    assert "is of a wand, and compare needs known points" in ran.err
