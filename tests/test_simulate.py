"""The simulator is the judge of everything else, so it is judged here: derivatives, limits, fractions, seeds."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from scipy.optimize import least_squares
from scipy.stats import binom

from implicam.dataset import Dataset
from implicam.errors import UsageError
from implicam.geometry import Pose
from implicam.lenses import BrownConrady
from implicam.simulate import (
    Optics,
    Rig,
    SimulatedCamera,
    ball_grid,
    build_rig,
    each_and_pairs,
    held_boards,
    moving_board,
    random_positions,
    record,
    simulate,
    simulate_boards,
    views,
    write_rig,
)
from implicam.simulate.rigs import Unusual
from implicam.simulate.truth import limit_of_detection, read_rig

SPECS = ["bar6", "stereo", "dome8"]


def some_points(rig: Rig, n: int = 40, seed: int = 0) -> np.ndarray:
    return random_positions(rig, n, np.random.default_rng(seed)).xyz


def pixels(rig: Rig, xyz: np.ndarray) -> np.ndarray:
    return np.stack([camera.pixel_from_world(xyz)[0] for camera in rig.cameras], axis=1)


def within(k: int, n: int, p: float) -> bool:
    """Whether k of n is what a probability p gives, in all but one case of a million."""
    low, high = binom.interval(1 - 1e-6, n, p)
    return low <= k <= high


@pytest.mark.parametrize("spec", SPECS)
@pytest.mark.parametrize("unit", ["mm", "m"])
def test_jacobian_is_the_derivative_smooth_error_included(spec: str, unit: str) -> None:
    rig = build_rig(
        spec, seed=1, lens_error=50.0, frame="random", unit=unit
    )  # a large error, so that forgetting it shows
    xyz, h = some_points(rig), 1e-3 * rig.units_per_mm
    for camera in rig.cameras:
        difference = [
            camera.pixel_from_world(xyz + h * e)[0] - camera.pixel_from_world(xyz - h * e)[0] for e in np.eye(3)
        ]
        numeric = np.stack(difference, axis=2) / (2 * h)
        jacobian = camera.jacobian(xyz)
        np.testing.assert_allclose(jacobian, numeric, rtol=1e-5, atol=1e-6 * np.abs(jacobian).max())
        plain = replace(
            camera, error=replace(camera.error, amplitudes=0 * camera.error.amplitudes, affine=0 * camera.error.affine)
        )
        assert np.abs(plain.jacobian(xyz) - jacobian).max() > 1e-3 * np.abs(jacobian).max()


def over_the_image(camera: SimulatedCamera) -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 50), np.linspace(0, camera.height - 1, 40))
    return np.column_stack([u.ravel(), v.ravel()])


@pytest.mark.parametrize("spec", SPECS)
def test_the_smooth_error_is_as_large_as_asked(spec: str) -> None:
    for camera in build_rig(spec, seed=2, lens_error=0.7).cameras:
        shift = camera.error.at(over_the_image(camera))
        np.testing.assert_allclose(np.sqrt(np.mean(shift**2, axis=0)), 0.7, rtol=0.05)
        np.testing.assert_allclose(shift.mean(axis=0), 0, atol=0.05)


def test_a_tilted_sensor_is_as_far_behind_the_lens_as_the_middle_of_the_image_says() -> None:
    """Whatever a lens of another package calls fx."""

    @dataclass(frozen=True)
    class Doubled(BrownConrady):
        """fx and fy are twice the focal length, as that of a double sphere is (1 + xi) times it."""

        def pixel_from_camera_point(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            uv, valid = super().pixel_from_camera_point(points)
            return 0.5 * (uv + np.array([self.cx, self.cy])), valid

        def jacobian(self, points: np.ndarray) -> np.ndarray:
            return 0.5 * super().jacobian(points)

    camera = build_rig("dome4", seed=3, lens_error=0.0).cameras[0]
    xyz = np.array([[150.0, 150, 600], [150, -150, 600]])
    one, other = (
        replace(camera, lens=lens, tilt=(0.2, 0.0)).pixel_from_world(xyz)[0]
        for lens in (BrownConrady(1000, 1000, 640, 512), Doubled(2000, 2000, 640, 512))
    )
    np.testing.assert_allclose(one, other, atol=1e-9)


@pytest.mark.slow
def test_no_lens_model_explains_the_smooth_error() -> None:
    """Refit everything the lens has, and its rotation: most of the error stays."""
    left = []
    for camera in [camera for seed in range(3) for camera in build_rig("bar6", seed=seed).cameras]:
        uv = over_the_image(camera)
        rays, valid = camera.lens.ray_from_pixel(uv)
        uv, rays = uv[valid], rays[valid]
        kind, start = type(camera.lens), np.array(list(vars_of(camera.lens).values()))
        scale = np.where(np.abs(start) > 1, 1.0, 1e-3)

        def residual(
            step: np.ndarray, kind=kind, start=start, scale=scale, rays=rays, uv=uv, camera=camera
        ) -> np.ndarray:
            turned = rays + np.cross(1e-3 * step[-3:], rays)
            found = kind(*(start + scale * step[:-3])).pixel_from_camera_point(turned)[0]
            return np.nan_to_num(found - uv - camera.error.at(uv)).ravel()

        fit = least_squares(residual, np.zeros(len(start) + 3), method="lm", max_nfev=150)
        left.append(np.sqrt(np.mean(fit.fun**2)) / 0.5)
    assert 0.6 < np.mean(left) < 1.0
    assert min(left) > 0.35


def vars_of(lens: object) -> dict[str, float]:
    return {field.name: getattr(lens, field.name) for field in fields(lens)}  # type: ignore[arg-type]


def triangulated(rig: Rig, uv: np.ndarray, seen: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Maximum likelihood with the true cameras, by Gauss-Newton."""
    x = start.copy()
    for _ in range(6):
        normal, gradient = np.zeros((len(x), 3, 3)), np.zeros((len(x), 3))
        for c, camera in enumerate(rig.cameras):
            jacobian = camera.jacobian(x) * seen[:, c, None, None]
            residual = np.where(seen[:, c, None], uv[:, c] - camera.pixel_from_world(x)[0], 0)
            normal += jacobian.transpose(0, 2, 1) @ jacobian
            gradient += np.einsum("nij,ni->nj", jacobian, residual)
        x += np.linalg.solve(normal, gradient[..., None])[..., 0]
    return x


@pytest.mark.parametrize("spec", SPECS)
def test_the_limit_is_what_maximum_likelihood_reaches(spec: str) -> None:
    rig = build_rig(spec, seed=3, frame="random")
    few = random_positions(rig, 4, np.random.default_rng(0))
    draws = 400
    many = replace(
        few,
        points=np.arange(4 * draws).astype(str),
        shots=np.arange(4 * draws).astype(str),
        xyz=np.tile(few.xyz, (draws, 1)),
    )
    data = simulate(rig, many, seed=5, missing=0.0)
    error = triangulated(rig, data.observations.uv, data.observations.seen, many.xyz) - many.xyz
    assert data.truth is not None
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(data.truth.limit), error)
    assert abs(nees.mean() - 3) < 4 * np.sqrt(6 / len(nees))  # chi-squared with 3 degrees of freedom has variance 6
    for i in range(4):  # whitened by the limit, the empirical covariance is the unit matrix
        white = np.linalg.solve(np.linalg.cholesky(data.truth.limit[i]), error[i::4].T)
        np.testing.assert_allclose(np.cov(white), np.eye(3), atol=4 * np.sqrt(2 / draws))


def test_the_limit_counts_only_views_that_are_seen_and_right() -> None:
    rig = build_rig("bar6", seed=0)
    data = simulate(rig, ball_grid(rig), seed=1, missing=0.4, outliers=0.2)
    used = data.observations.seen & (data.observations.extra["outlier"] == "0")
    i = int(np.flatnonzero(used.sum(axis=1) == 3)[0])
    information = sum(
        rig.cameras[c].jacobian(data.truth.xyz[[i]])[0].T @ rig.cameras[c].jacobian(data.truth.xyz[[i]])[0] / 0.2**2
        for c in np.flatnonzero(used[i])
    )
    np.testing.assert_allclose(data.truth.limit[i], np.linalg.inv(information), rtol=1e-9)
    lost = used.sum(axis=1) < 2
    assert lost.any()
    assert (np.isnan(data.truth.limit).all(axis=(1, 2)) == lost).all()
    assert (data.positions.extra["limit_sd_x"][lost] == "nan").all()


def test_fractions_are_as_asked_and_the_truth_is_told() -> None:
    rig = build_rig("dome8", seed=0)
    data = simulate(rig, random_positions(rig, 1000, np.random.default_rng(0)), seed=1, missing=0.15, outliers=0.08)
    seen, outlier = data.observations.seen, data.observations.extra["outlier"]
    visible = views(rig, random_positions(rig, 1000, np.random.default_rng(0)))[1]
    assert within(int((visible & ~seen).sum()), int(visible.sum()), 0.15)
    assert within(int((outlier == "1").sum()), int(seen.sum()), 0.08)
    assert set(outlier[~seen]) == {""}
    truth = np.stack([data.observations.extra[key] for key in ("true_u", "true_v")], axis=2)
    error = data.observations.uv[seen] - truth[seen].astype(float)
    wrong = outlier[seen] == "1"
    assert error[~wrong].std() == pytest.approx(0.2, rel=0.02)
    assert np.abs(error[~wrong]).max() < 1.2
    assert np.median(np.linalg.norm(error[wrong], axis=1)) > 100
    np.testing.assert_array_equal(data.observations.sd[seen], 0.2)
    np.testing.assert_allclose(truth[seen].astype(float), pixels(rig, data.truth.xyz)[seen], atol=1e-9)


def test_outliers_fill_the_image_evenly() -> None:
    rig = build_rig("stereo", seed=0)
    data = simulate(rig, random_positions(rig, 4000, np.random.default_rng(0)), seed=1, outliers=1.0)
    uv = data.observations.uv[data.observations.seen]
    assert np.abs(uv.mean(axis=0) / [1280, 1024] - 0.5).max() < 0.02
    assert (uv.min(axis=0) >= -0.5).all()
    assert (uv.max(axis=0) <= [1279.5, 1023.5]).all()


def test_known_positions_are_as_uncertain_as_stated_and_a_board_is_off_as_a_whole() -> None:
    rig = build_rig("bar6", seed=0)
    ball = simulate(rig, random_positions(rig, 2000, np.random.default_rng(0)), seed=1, robot_noise=0.3)
    assert (ball.xyz - ball.truth.xyz).std(axis=0) == pytest.approx([0.3] * 3, rel=0.1)
    np.testing.assert_array_equal(ball.positions.sd, 0.3)
    board = simulate(rig, moving_board(rig), seed=1, robot_noise=0.3)
    shift = board.xyz - board.truth.xyz
    for shot in np.unique(board.shots):
        assert np.ptp(shift[board.shots == shot], axis=0).max() < 1e-9
    assert len(np.unique(shift.round(6), axis=0)) == 20
    exact = simulate(rig, ball_grid(rig), seed=1)
    np.testing.assert_array_equal(exact.xyz, exact.truth.xyz)
    assert np.isnan(exact.positions.sd).all()


def same(a: Dataset, b: Dataset) -> bool:
    return np.array_equal(a.observations.uv, b.observations.uv, equal_nan=True) and np.array_equal(a.xyz, b.xyz)


@pytest.mark.parametrize("spec", SPECS)
def test_the_same_seeds_give_the_same_bits_and_others_do_not(spec: str) -> None:
    def run(rig_seed: int, seed: int) -> Dataset:
        rig = build_rig(spec, seed=rig_seed)
        return simulate(rig, ball_grid(rig), seed=seed, robot_noise=0.1, missing=0.1, outliers=0.05)

    assert same(run(1, 2), run(1, 2))
    assert not same(run(1, 2), run(1, 3))
    np.testing.assert_array_equal(run(1, 2).truth.xyz, run(1, 3).truth.xyz)  # the rig stands still
    assert write_rig(build_rig(spec, seed=1)) == write_rig(build_rig(spec, seed=1))


def test_rigs_differ_between_seeds_as_rigs_do() -> None:
    rigs = [build_rig("bar6", seed=seed) for seed in range(20)]
    focal = np.array([[camera.lens.fx for camera in rig.cameras] for rig in rigs])
    np.testing.assert_allclose(focal.mean(axis=0), np.array([1.55, 2.8, 2.8, 1.85, 2.2, 1.3]) / 0.003, rtol=0.02)
    assert 0.01 < (focal.std(axis=0) / focal.mean(axis=0)).mean() < 0.03
    centres = np.array(
        [[r.volume.world_from_box.inverse().apply(c.camera_from_world.centre) for c in r.cameras] for r in rigs]
    )
    np.testing.assert_allclose(centres.mean(axis=0)[:, 0], [-300, -75, 75, -180, 180, 300], atol=4)
    assert 2 < centres.std(axis=0).mean() < 5


def test_lens_error_noise_and_choice_of_cameras_leave_the_rig_alone() -> None:
    plain, other = build_rig("bar6", seed=4), build_rig("bar6", seed=4, lens_error=0, noise=1, cameras="2R2W")
    assert [camera.name for camera in other.cameras] == ["cam2", "cam3", "cam4", "cam5"]
    for camera in other.cameras:
        twin = next(c for c in plain.cameras if c.name == camera.name)
        assert camera.lens == twin.lens
        np.testing.assert_array_equal(camera.camera_from_world.rotation, twin.camera_from_world.rotation)
        assert np.abs(camera.error.at(over_the_image(camera))).max() == 0


def test_unit_scales_lengths_and_nothing_else() -> None:
    mm, m = (build_rig("bar6", seed=4, unit=unit) for unit in ("mm", "m"))
    for make in (ball_grid, moving_board):
        np.testing.assert_allclose(make(mm).xyz * 1e-3, make(m).xyz, atol=1e-12)
        np.testing.assert_allclose(views(mm, make(mm))[0], views(m, make(m))[0], atol=1e-8)
    assert simulate(m, ball_grid(m), seed=0).metres_per_unit == 1.0


def test_the_robot_frame_is_parallel_and_the_random_frame_is_not() -> None:
    for seed in range(5):
        robot, free = (build_rig("bar6", seed=seed, frame=frame).volume.world_from_box for frame in ("robot", "random"))
        assert set(np.abs(robot.rotation).ravel()) == {0.0, 1.0}
        np.testing.assert_array_equal(robot.rotation @ [0, 1, 0], [0, 0, -1])  # down on the bench is -z
        assert np.abs(free.rotation).max(axis=0).min() < 0.99
        for pose in (robot, free):
            assert np.linalg.det(pose.rotation) == pytest.approx(1)
            assert np.linalg.norm(pose.translation) > 300


@pytest.mark.parametrize("spec", SPECS)
def test_every_camera_sees_the_whole_volume(spec: str) -> None:
    for seed in range(8):
        rig = build_rig(spec, seed=seed)
        assert views(rig, ball_grid(rig))[1].all()
        if spec != "dome8":
            assert views(rig, moving_board(rig))[1].all()


def test_a_board_is_seen_from_its_front_only() -> None:
    rig = build_rig("dome8", seed=0)
    np.testing.assert_array_equal(
        views(rig, moving_board(rig))[1].all(axis=0), [True, True, False, False, False, False, False, True]
    )


def test_targets_are_the_papers() -> None:
    rig = build_rig("bar6", seed=0)
    ball, board = ball_grid(rig), moving_board(rig)
    assert (len(ball.points), len(set(ball.points)), len(board.points), len(set(board.shots))) == (175, 175, 1760, 20)
    assert list(ball.shots) == list(ball.points)
    corners = rig.volume.world_from_box.inverse().apply(board.xyz).reshape(20, 8, 11, 3)
    np.testing.assert_allclose(np.diff(corners[..., 0], axis=2), 13.29, atol=1e-9)
    np.testing.assert_allclose(np.diff(corners[..., 1], axis=1), 13.29, atol=1e-9)
    np.testing.assert_allclose(np.diff(corners[..., 2], axis=0), 10, atol=1e-9)  # away from the cameras: nearest first
    inside = rig.volume.world_from_box.inverse().apply(ball.xyz) / rig.volume.size
    assert np.abs(inside).max() == pytest.approx(0.5)
    assert len(np.unique(inside.round(9)[:, 2])) == 7


def test_limits_of_the_moving_board_are_those_of_the_design_notes() -> None:
    for cameras, expected in (("2R", 0.14), ("2R2W", 0.06), ("2R4W", 0.05)):
        rig = build_rig("bar6", seed=0, noise=0.1, cameras=cameras)
        limit = simulate(rig, moving_board(rig), seed=0).truth.limit
        assert expected / 2 < np.sqrt(np.trace(limit, axis1=1, axis2=2).mean()) < expected * 2


def test_noise_zero_states_no_uncertainty() -> None:
    rig = build_rig("stereo", seed=0, noise=0)
    data = simulate(rig, ball_grid(rig), seed=0)
    assert np.isnan(data.observations.sd).all()
    np.testing.assert_array_equal(data.observations.uv, pixels(rig, data.truth.xyz))


def test_write_rig_is_plain_and_enough_to_build_it_again() -> None:
    rig = build_rig("bar6", seed=9, lens_error=0.3, noise=0.1, frame="random", unit="m", cameras="2R2W")
    table = tomllib.loads(tomli_w.dumps(write_rig(rig)))
    assert table == write_rig(rig)
    assert table["cameras"][2]["lens"]["model"] == "KannalaBrandt"
    again = build_rig(
        table["name"],
        seed=table["seed"],
        lens_error=table["cameras"][0]["lens_error_rms_px"],
        noise=table["cameras"][0]["noise_sd_px"],
        frame=table["frame"],
        unit=table["length_unit"],
        cameras=",".join(camera["name"] for camera in table["cameras"]),
    )
    np.testing.assert_array_equal(pixels(again, some_points(rig)), pixels(rig, some_points(rig)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: build_rig("bra6", seed=0), "did you mean 'bar6'"),
        (lambda: build_rig("dome1", seed=0), "no rig 'dome1'"),
        (lambda: build_rig("bar6", seed=0, cameras="cam2,cam9"), "no camera 'cam9'"),
        (lambda: build_rig("dome8", seed=0, cameras="2R"), "belongs to bar6"),
        (lambda: build_rig("bar6", seed=-1), "must not be negative"),
        (lambda: build_rig("bar6", seed=0, noise=-1), "zero or more"),
        (lambda: build_rig("bar6", seed=0, frame="robto"), "did you mean 'robot'"),
        (lambda: build_rig("bar6", seed=0, unit="cm"), "no unit 'cm'"),
        (lambda: ball_grid(build_rig("bar6", seed=0), (0, 1, 1)), "at least one point"),
        (lambda: simulate(r := build_rig("stereo", seed=0), ball_grid(r), seed=0, missing=1.5), "probability"),
        (lambda: simulate(r := build_rig("stereo", seed=0), ball_grid(r), seed=0, robot_noise=-1), "zero or more"),
    ],
)
def test_wrong_usage_is_told(call, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        call()
    assert "fix: " in str(caught.value)


@pytest.mark.parametrize("spec", ["bar2", "bar9", "dome2", "dome5"])
def test_any_number_of_cameras(spec: str) -> None:
    rig = build_rig(spec, seed=0, frame="random")
    data = simulate(rig, ball_grid(rig, (3, 3, 3)), seed=0)
    assert len(data.cameras) == int(spec.lstrip("bardome"))
    assert data.observations.seen.mean() > 0.9


# boards held by hand


def test_held_boards_are_seen_whole_by_their_group_and_by_nobody_else() -> None:
    rig = build_rig("bar6", seed=5, lens_error=0.0)
    groups = each_and_pairs(rig, 2, 1)
    assert groups == [(c.name,) for c in rig.cameras for _ in range(2)] + [
        ("cam1", "cam4"), ("cam4", "cam2"), ("cam2", "cam3"), ("cam3", "cam5"), ("cam5", "cam6"),
    ]  # fmt: skip
    target = held_boards(rig, groups, np.random.default_rng(0))
    data = simulate_boards(rig, groups, seed=1)
    assert data.known is None
    assert data.extra["target"]["kind"] == "board"
    assert data.extra["target"]["square"] == pytest.approx(13.29)
    names = [camera.name for camera in rig.cameras]
    for g, group in enumerate(groups):
        rows = slice(88 * g, 88 * g + 88)
        seen = data.observations.seen[rows]
        np.testing.assert_array_equal(seen.all(axis=0), [name in group for name in names])
        np.testing.assert_array_equal(seen.any(axis=0), seen.all(axis=0))
        corners = target.xyz[rows].reshape(8, 11, 3)
        for axis in (0, 1):
            np.testing.assert_allclose(np.linalg.norm(np.diff(corners, axis=axis), axis=-1), 13.29)
        assert target.facing is not None
        away = np.cross(corners[0, 1] - corners[0, 0], corners[1, 0] - corners[0, 0])
        np.testing.assert_allclose(away / np.linalg.norm(away), -target.facing[88 * g], atol=1e-12)


def test_cameras_that_share_no_place_cannot_hold_a_board_together() -> None:
    rig = build_rig("bar6", seed=5)
    turned = replace(
        rig.cameras[0],
        camera_from_world=Pose(np.diag([-1.0, 1.0, -1.0]), np.zeros(3)) @ rig.cameras[0].camera_from_world,
    )
    with pytest.raises(UsageError, match="no place was found where cam1, cam2 see"):
        held_boards(replace(rig, cameras=(turned, rig.cameras[1])), [("cam1", "cam2")], np.random.default_rng(0))


@pytest.mark.slow
def test_only_the_cameras_of_the_group_take_a_photograph(tmp_path: Path) -> None:
    rig = build_rig("bar6", seed=5, cameras="2R")
    target = held_boards(rig, [("cam2",), ("cam3",), ("cam2", "cam3")], np.random.default_rng(0))
    recorded = record(rig, target, seed=1, optics=Optics())
    assert recorded.photographs == 4
    recorded.write_photographs(tmp_path)
    assert sorted(str(p.relative_to(tmp_path / "images")) for p in tmp_path.rglob("*.png")) == [
        "cam2/held001.png", "cam2/held003.png", "cam3/held002.png", "cam3/held003.png",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("spec", "options"),
    [
        ("bar6", {"seed": 0}),
        ("2R", {"seed": 3, "noise": 0.1}),
        ("grid9", {"seed": 2, "frame": "random", "lens_error": 0.0}),
        ("dome8", {"seed": 4, "unit": "m", "cameras": "cam5,cam2"}),
        ("bar6", {"seed": 1, "unusual": Unusual(tilt=5, mirror="cam2", window=10.0)}),
    ],
)
def test_a_rig_is_built_again_from_its_truth(spec: str, options: dict[str, Any], tmp_path: Path) -> None:
    rig = build_rig(spec, **options)
    path = tmp_path / "truth.toml"
    path.write_text(tomli_w.dumps({**write_rig(rig), "shots_seed": 1}))
    again = read_rig(path)
    assert again is not None
    xyz = some_points(rig, 10)
    for one, other in zip(rig.cameras, again.cameras, strict=True):
        np.testing.assert_allclose(other.jacobian(xyz), one.jacobian(xyz))
    table = tomllib.loads(path.read_text())
    table["cameras"][0]["lens"]["fx"] *= 1.001
    for text in (tomli_w.dumps(table), "", "name = 3", "[", 'name = "my-drawing.toml"'):
        path.write_text(text)
        assert read_rig(path) is None
    assert read_rig(tmp_path / "none.toml") is None


def test_the_limit_of_a_detection_is_that_of_its_views(tmp_path: Path) -> None:
    rig = build_rig("stereo", seed=1, noise=0.2)
    data = simulate(rig, random_positions(rig, 20, np.random.default_rng(0)), seed=2)
    assert data.truth is not None
    finer = replace(data, observations=replace(data.observations, sd=np.full_like(data.observations.uv, 0.02)))
    limit, note = limit_of_detection(tmp_path, finer)
    assert limit.truth is not None
    assert np.isnan(limit.truth.limit).all()
    assert "taken out" in note
    np.testing.assert_array_equal(limit.truth.xyz, data.truth.xyz)
    (tmp_path / "truth.toml").write_text(tomli_w.dumps(write_rig(rig)))
    for folder in (tmp_path, tmp_path / "check"):
        limit, note = limit_of_detection(folder, finer)
        assert limit.truth is not None
        np.testing.assert_allclose(limit.truth.limit, data.truth.limit / 100, rtol=1e-9)
        assert "as detected" in note
    real = replace(data, known=replace(data.positions, extra={}))
    assert limit_of_detection(tmp_path, real) == (real, "")
