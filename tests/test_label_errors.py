"""Errors of known positions: closed forms against brute force, the gate, levels, and what evaluate makes of them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import block_diag, expm
from scipy.stats import multivariate_normal

from implicam.calibrators import ForwardGP, ForwardGPCalibration
from implicam.dataset import Dataset, KnownPositions
from implicam.errors import FitError
from implicam.evaluation import cross_validate, evaluate
from implicam.rig_model.camera_model import CameraViews
from implicam.rig_model.leave_one_out import left_out_points
from implicam.rig_model.level_errors import find_levels, find_uncertain_planes
from implicam.rig_model.position_errors import (
    Agreement,
    PositionErrors,
    _evidence,
    _most_probable,
    _nodes,
    _objective,
    _Scales,
    _symmetric_matrix,
    estimate_position_errors,
)
from implicam.rig_model.settings import DEFAULT_SETTINGS
from implicam.rig_model.shot_errors import Shots
from implicam.rig_model.tied import Scatter, condition_scattered
from implicam.rig_model.training_data import camera_views_of, stated_noise
from implicam.simulate import Rig, Target, build_rig, moving_board, random_positions, simulate

SHOT_SD = DEFAULT_SETTINGS.shot_sd_prior_median_wf * float(np.exp(DEFAULT_SETTINGS.shot_sd_prior_log_sd))
LEVEL_SD = DEFAULT_SETTINGS.level_sd_ratio * SHOT_SD


def rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return np.asarray(q * np.linalg.det(q))


def covariance(seed: int, size: float) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(3, 3)) * size
    return np.asarray(root @ root.T)


def views(
    n: int, scale: np.ndarray, noise: float, *, freedom: float = np.inf, seed: int = 0, coordinates: int = 6
) -> tuple[Agreement, list[tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Residuals, covariances and slopes of n points, and what the estimate sees of them."""
    rng = np.random.default_rng(seed)
    each = []
    for _ in range(n):
        root = 0.3 * (np.eye(coordinates) + 0.3 * rng.normal(size=(coordinates, coordinates)))
        S, D = root @ root.T, 300 * rng.normal(size=(coordinates, 3))
        own = 1.0 if np.isinf(freedom) else freedom / rng.chisquare(freedom)
        off = rng.multivariate_normal(np.zeros(3), own * scale)
        each.append((noise * root @ rng.normal(size=coordinates) + D @ off, S, D))
    weighted = [np.linalg.solve(S, np.column_stack([D, r])) for r, S, D in each]
    return Agreement(
        np.array([D.T @ w[:, :3] for (_, _, D), w in zip(each, weighted, strict=True)]),
        np.array([D.T @ w[:, 3] for (_, _, D), w in zip(each, weighted, strict=True)]),
        np.array([r @ w[:, 3] for (r, _, _), w in zip(each, weighted, strict=True)]),
        np.full(n, float(coordinates)),
    ), each


@pytest.mark.parametrize("freedom", [np.inf, 4.0])
def test_the_likelihood_is_the_density_of_the_residuals(freedom: float) -> None:
    agreement, each = views(15, covariance(1, 1e-3), 0.7)
    nodes, weights = _nodes(freedom)
    found, expected = [], []
    for seed, noise in ((2, 0.5), (3, 0.9), (4, 0.2)):
        scale = covariance(seed, 1e-3)
        found.append(_Scales.of(agreement, scale).likelihood(np.log(noise), freedom).value)
        expected.append(
            -sum(
                np.log(
                    sum(
                        w * multivariate_normal.pdf(r, np.zeros(6), noise**2 * S + own * D @ scale @ D.T)
                        for own, w in zip(nodes, weights, strict=True)
                    )
                )
                for r, S, D in each
            )
        )
    assert np.ptp(expected) > 10
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-9)


@pytest.mark.parametrize("freedom", [np.inf, 8.0, 3.0])
def test_the_estimate_knows_its_gradient(freedom: float) -> None:
    agreement, _ = views(12, covariance(1, 1e-3), 0.7)
    objective = _objective(agreement, freedom, DEFAULT_SETTINGS)
    for seed in range(3):
        z = np.array([-14.0, -13, -15, 0, 0, 0, -0.4]) + 0.4 * np.random.default_rng(seed).normal(size=7)
        numeric = [(objective(z + d)[0] - objective(z - d)[0]) / 2e-5 for d in 1e-5 * np.eye(7)]
        np.testing.assert_allclose(objective(z)[1], numeric, rtol=1e-5, atol=1e-4)
    alike = np.array([-14.0, -14, -14, 0, 0, 0, -0.4])  # equal eigenvalues
    numeric = [(objective(alike + d)[0] - objective(alike - d)[0]) / 2e-5 for d in 1e-5 * np.eye(7)]
    np.testing.assert_allclose(objective(alike)[1], numeric, rtol=1e-5, atol=1e-4)


def test_the_estimate_turns_with_the_world() -> None:
    agreement, _ = views(40, np.diag([1e-3, 1e-3, 4e-3]) ** 2, 0.7)
    turn = rotation(3)
    turned = agreement._replace(information=turn @ agreement.information @ turn.T, pull=agreement.pull @ turn.T)
    a, b = estimate_position_errors(agreement, DEFAULT_SETTINGS), estimate_position_errors(turned, DEFAULT_SETTINGS)
    assert a is not None
    assert b is not None
    np.testing.assert_allclose(turn.T @ b.scale @ turn, a.scale, atol=0.03 * np.trace(a.scale))
    assert b.noise == pytest.approx(a.noise, rel=0.01)
    assert b.gain == pytest.approx(a.gain, abs=0.1)


def test_a_known_covariance_is_found_again() -> None:
    scale = covariance(5, 2e-3)
    agreement, _ = views(300, scale, 0.6)
    found = estimate_position_errors(agreement, DEFAULT_SETTINGS)
    assert found is not None
    assert np.isinf(found.freedom)
    assert found.noise == pytest.approx(0.6, rel=0.05)
    ratio = np.linalg.eigvals(np.linalg.solve(scale, found.covariance)).real
    assert ratio.min() > 0.75
    assert ratio.max() < 1.35


def test_positions_that_are_exact_are_left_so() -> None:
    gains = []
    for seed in range(20):
        agreement, _ = views(40, np.zeros((3, 3)), 1.0, seed=seed)
        assert estimate_position_errors(agreement, DEFAULT_SETTINGS) is None
        found = _most_probable(agreement, np.inf, None, DEFAULT_SETTINGS)
        gains.append(_evidence(agreement, found, DEFAULT_SETTINGS))
    assert np.mean(gains) < 0
    assert estimate_position_errors(agreement.select(np.arange(3)), DEFAULT_SETTINGS) is None


def test_a_few_points_far_off_are_a_tail() -> None:
    scale = np.eye(3) * 1e-6
    normal, heavy = (
        estimate_position_errors(views(300, scale, 0.6, freedom=f, seed=1)[0], DEFAULT_SETTINGS) for f in (np.inf, 3.0)
    )
    assert normal is not None
    assert heavy is not None
    assert np.isinf(normal.freedom)
    assert heavy.freedom <= 4
    assert np.trace(heavy.scale) == pytest.approx(np.trace(scale), rel=0.35)
    agreement, each = views(300, scale, 0.6, freedom=3.0, seed=1)
    distance = np.array([np.linalg.norm(np.linalg.lstsq(D, r, rcond=None)[0]) for r, _, D in each])
    weights = heavy.weights(agreement)
    assert np.corrcoef(np.argsort(np.argsort(distance)), np.argsort(np.argsort(weights)))[0, 1] > 0.9
    assert weights[np.argmax(distance)] > 5
    # of a t of three degrees the normal ellipsoid that holds 95 % is a little larger than that of its covariance
    assert 3 < np.trace(heavy.covariance) / np.trace(heavy.scale) < 4


def test_the_matrix_logarithm_is_that() -> None:
    z = np.array([-1.0, -2, -1.5, 0.3, -0.2, 0.1])
    values, vectors = np.linalg.eigh(_symmetric_matrix(z))
    np.testing.assert_allclose((vectors * np.exp(values)) @ vectors.T, expm(_symmetric_matrix(z)))
    np.testing.assert_allclose(_symmetric_matrix(z), _symmetric_matrix(z).T)


# levels


def stepped(z: np.ndarray) -> np.ndarray:
    """Rows of dots at depths z, ten each, one beside the other."""
    x, y = np.meshgrid(5.0 * np.arange(len(z)), 4.0 * np.arange(10), indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), np.repeat(z, 10)])


STEPS = {
    "pyramid": np.array([0.0, -8, -16, -16, -8, 0]),
    "stairs": np.array([0.0, 0, -15, -15, -30, -30, -45, -45]),
    "two": np.array([0.0, 0, -6, -6]),
}


@pytest.mark.parametrize("name", STEPS)
def test_a_stepped_target_has_levels(name: str) -> None:
    z = STEPS[name]
    found = find_levels(stepped(z), DEFAULT_SETTINGS)
    assert found is not None
    np.testing.assert_allclose(np.abs(found.normal), [0, 0, 1], atol=1e-9)
    assert len(np.unique(found.number)) == len(np.unique(z))
    planes = find_uncertain_planes(stepped(z) / 20, np.full(len(z) * 10, "target"), DEFAULT_SETTINGS)
    assert planes is not None
    assert planes.sd[0] == pytest.approx(LEVEL_SD)
    assert planes.shots.pattern.shape[1] == max(len(np.unique(z)) - 3, 0)
    np.testing.assert_allclose(planes.shots.unresolved_covariance(stepped(z) / 20, planes.sd), 0, atol=1e-15)


def test_a_stepped_target_may_be_turned() -> None:
    turn = rotation(1)
    found = find_levels(stepped(STEPS["pyramid"]) @ turn.T + 100, DEFAULT_SETTINGS)
    assert found is not None
    assert abs(found.normal @ turn[:, 2]) == pytest.approx(1)
    assert len(np.unique(found.number)) == 3


def test_what_has_no_levels() -> None:
    rng = np.random.default_rng(0)
    assert find_levels(rng.uniform(-1, 1, (100, 3)), DEFAULT_SETTINGS) is None
    assert find_levels(stepped(STEPS["two"])[:9], DEFAULT_SETTINGS) is None
    points = stepped(STEPS["pyramid"])
    each = np.array([f"p{i}" for i in range(len(points))])  # a ball that stood on a lattice
    assert find_uncertain_planes(points, each, DEFAULT_SETTINGS) is None


def test_a_level_of_a_few_points_is_none() -> None:
    points = np.concatenate([stepped(STEPS["pyramid"]), [[12.0, 3.0, -30.0], [13.0, 8.0, -30.0]]])
    found = find_levels(points, DEFAULT_SETTINGS)
    assert found is not None
    assert (found.number[-2:] == -1).all()
    assert len(np.unique(found.number)) == 4


def test_the_world_is_the_parabola_or_the_line_through_its_shots() -> None:
    rng = np.random.default_rng(0)
    plate = np.column_stack([rng.uniform(-1, 1, (20, 2)), np.zeros(20)])
    axis = np.array([0.0, 0, 1])
    three = np.concatenate([plate + k * axis for k in (-1, 0, 1)])
    shots = Shots.of(three, np.repeat(["a", "b", "c"], 20), fewest=2, direction=axis)
    assert shots is not None
    at = shots.centre.mean(axis=0) + np.array([[0, 0, 2.0], [0, 0, 0], [0, 0, 0.5], [0, 0, 50]])
    np.testing.assert_allclose(
        shots.world_variance_ratio(at)[:3], [19, 1, (1 + 36 + 9) / 64], rtol=1e-9
    )  # 1, -3, 3 and so on
    assert shots.world_variance_ratio(at)[3] == 100
    two = Shots.of(three[:40], np.repeat(["a", "b"], 20), fewest=2, direction=axis)
    assert two is not None
    at = two.centre.mean(axis=0) + np.array([[0, 0, 1.5], [0, 0, 0]])
    np.testing.assert_allclose(two.world_variance_ratio(at), [5, 0.5], rtol=1e-9)
    planes = find_uncertain_planes(three, np.repeat(["a", "b", "c"], 20), DEFAULT_SETTINGS)
    assert planes is not None
    assert planes.sd[0] == pytest.approx(SHOT_SD)


# the whole method


@cache
def rig() -> Rig:
    return build_rig("bar6", seed=3, frame="random", cameras="2R2W")


def without_sd(data: Dataset) -> Dataset:
    o = data.observations
    return replace(data, observations=replace(o, sd=np.full_like(o.sd, np.nan)))


def moved(data: Dataset, sd_mm: float, seed: int, declared: float | None = None) -> Dataset:
    """Known positions that are off, and nothing but what is declared to say so; no simulated truth."""
    xyz = data.xyz + sd_mm * rig().units_per_mm * np.random.default_rng(seed).normal(size=data.xyz.shape)
    sd = np.full(xyz.shape, np.nan if declared is None else declared * rig().units_per_mm)
    return replace(data, known=KnownPositions(data.shots, xyz, sd))


@cache
def known() -> Dataset:
    return without_sd(simulate(rig(), random_positions(rig(), 60, np.random.default_rng(1)), seed=2))


@cache
def others() -> Dataset:
    return without_sd(simulate(rig(), random_positions(rig(), 150, np.random.default_rng(3)), seed=4))


DOTS = 0.15


@cache
def dots() -> ForwardGPCalibration:
    return ForwardGP().fit(moved(known(), DOTS, 5))


def test_dots_that_are_off_are_found_noted_and_judged_by() -> None:
    calibration = dots()
    errors = calibration.fitted.position_errors
    assert errors is not None
    sd = np.sqrt(np.trace(calibration.known_position_covariance(np.zeros((1, 3)))[0]) / 3) / rig().units_per_mm
    assert sd == pytest.approx(DOTS, rel=0.25)
    assert any("Single known positions" in note and "State sd_x, sd_y, sd_z" in note for note in calibration.notes)
    by_truth = evaluate(calibration, others(), regions=False)
    by_labels = evaluate(calibration, moved(others(), DOTS, 6), regions=False)
    for judged in (by_truth, by_labels):
        assert 0.89 < judged.coverage.overall.level(0.95).ellipsoid.value < 0.985
        assert 1.8 < judged.coverage.overall.nees.value < 4
    assert by_truth.against == "the simulated truth"
    assert "as estimated (sd " in by_labels.against
    np.testing.assert_array_equal(by_truth.measurement.cov, by_labels.measurement.cov)  # measure states true positions


def test_noise_is_told_from_errors_of_known_positions() -> None:
    exact = ForwardGP().fit(known())
    assert exact.fitted.position_errors is None
    noise = [np.median([m.noise for m in c.posterior.models]) for c in (exact, dots())]
    assert noise[1] == pytest.approx(noise[0], rel=0.25)


@pytest.mark.slow
def test_what_is_declared_is_not_estimated() -> None:
    calibration = ForwardGP().fit(moved(known(), DOTS, 5, declared=DOTS))
    assert calibration.fitted.position_errors is None
    assert calibration.fitted.plane_sd is None
    assert not calibration.known_position_covariance(known().xyz).any()
    # what the held-out positions declare is judged by, and not the estimate besides
    judged = evaluate(dots(), moved(others(), DOTS, 6, declared=DOTS), regions=False)
    assert "declared sd" in judged.against


@pytest.mark.parametrize("seed", range(4))
def test_exact_positions_are_fitted_as_before(seed: int) -> None:
    one = build_rig("bar6", seed=seed, frame="random", cameras="2R2W")
    data = without_sd(simulate(one, random_positions(one, 25, np.random.default_rng(seed + 100)), seed=seed + 200))
    calibration = ForwardGP().fit(data)
    assert calibration.fitted.position_errors is None
    assert not calibration.posterior.tied
    assert not calibration.known_position_covariance(data.xyz).any()


def test_known_positions_left_out_in_closed_form_are_left_out() -> None:
    """Whole points, of the cameras as they are conditioned: against conditioning without them."""
    calibration = dots()
    fitted, frame, data = calibration.fitted, calibration.frame, calibration.data
    errors, points = fitted.position_errors, frame.to_working(data.xyz)
    assert errors is not None
    assert errors.size is not None
    all_seen = camera_views_of(data.observations, stated_noise(data.observations))
    seen = tuple(all_seen[c] for c in fitted.cameras)
    found, spread = left_out_points(fitted, points, seen)
    assert len(found) == len(points)
    used = tuple(one.select(k) for one, k in zip(seen, fitted.inliers, strict=True))
    scatter = Scatter(errors.root, errors.size)
    for row in (3, 17):

        def without(one: CameraViews, row: int = row) -> CameraViews:
            return one.select(one.rows != row)

        # conditioning takes the prior of a model, which a posterior keeps
        posterior = condition_scattered(
            fitted.posterior.models, points, tuple(without(one) for one in used), None, scatter
        )
        other = replace(calibration, fitted=replace(fitted, posterior=posterior))
        measured = other.measure(data.observations.select(np.array([row])))
        off = (measured.xyz[0] - data.xyz[row]) / frame.scale
        sd = np.sqrt(np.diag(spread[row]))
        assert np.abs((off - found[row]) / sd).max() < 0.03
        expected = measured.cov[0] / frame.scale**2 + errors.covariance
        np.testing.assert_allclose(spread[row] / np.outer(sd, sd), expected / np.outer(sd, sd), atol=0.03)


@pytest.mark.slow
def test_cross_validation_judges_by_what_each_fold_has_found() -> None:
    data = moved(known(), DOTS, 5)
    judged = cross_validate(ForwardGP().fit, data, 3)
    assert "as estimated" in judged.against
    assert 0.85 < judged.coverage.overall.level(0.95).ellipsoid.value <= 1
    bare = np.einsum(
        "ni,nij,nj->n",
        e := judged.measurement.xyz - data.xyz[[list(data.points).index(p) for p in judged.measurement.points]],
        np.linalg.inv(judged.measurement.cov),
        e,
    )
    assert judged.coverage.overall.nees.value < 0.6 * np.mean(bare)


def test_boards_that_are_too_few_widen_the_bars_between_them() -> None:
    one = rig()
    data = simulate(one, moving_board(one, corners=(5, 6), positions=3, step=80.0, square=25.0), seed=7)
    inner = data.shots == "board02"
    calibration = ForwardGP().fit(data.select(~inner))
    assert calibration.fitted.plane_sd is not None
    assert any(note.startswith("2 shots cannot contradict each other") for note in calibration.notes)
    size = SHOT_SD * calibration.frame.scale
    measured = calibration.measure(data.observations)
    own = calibration.known_position_covariance(data.xyz)
    assert np.sqrt(np.linalg.eigvalsh(own[inner])[:, -1]).min() > 0.9 * size
    assert np.sqrt(np.linalg.eigvalsh(own[~inner])[:, -1]).max() < 0.1 * size
    widest = np.sqrt(np.linalg.eigvalsh(measured.cov)[:, -1])
    assert widest[inner].min() > 0.6 * size  # the line between two planes: a half of the variance of each
    assert widest[~inner].max() < widest[inner].min()


def test_levels_of_one_target_widen_the_bars_between_them() -> None:
    one = rig()
    box = stepped(np.array([0.0, 0, 1, 1, 2, 2, 1, 1]))
    box = (box - box.mean(axis=0)) * [6.0, 6.0, 60.0] * one.units_per_mm
    pose, names = one.volume.world_from_box, np.array([f"t{i}" for i in range(len(box))])
    data = simulate(one, Target("target", names, np.full(len(box), "target"), pose.apply(box)), seed=8)
    calibration = ForwardGP().fit(data)
    assert calibration.fitted.plane_sd is not None
    assert any(note.startswith("3 levels of one target") for note in calibration.notes)
    between = pose.apply(np.array([[0.0, 0, 30], [5, 20, -30]]) * one.units_per_mm)
    own = np.sqrt(np.linalg.eigvalsh(calibration.known_position_covariance(between))[:, -1])
    assert (own > 0.9 * LEVEL_SD * calibration.frame.scale).all()


def test_label_errors_with_no_tail_have_their_scale_as_covariance() -> None:
    scale = covariance(1, 1e-3)
    np.testing.assert_array_equal(PositionErrors(scale, np.inf, 0.5, 10, 0.95).covariance, scale)
    root = PositionErrors(scale, 3.0, 0.5, 10, 0.95).root
    np.testing.assert_allclose(root @ root.T, scale)


def test_plates_follow_each_other_along_their_normal() -> None:
    """Random points of wide plates close together: their centres lie farther apart across than along."""
    rng = np.random.default_rng(0)
    turn = rotation(2)
    points = np.column_stack([rng.uniform(-1, 1, (60, 2)), np.repeat(0.05 * np.arange(5), 12)]) @ turn.T
    shots = Shots.of(points, np.repeat(list("abcde"), 12))
    assert shots is not None
    assert abs(shots.along[0] @ turn[:, 2]) == pytest.approx(1, abs=1e-6)


def test_a_calibration_that_grows_finds_them_again() -> None:
    before, data = dots(), moved(known(), DOTS, 5)
    grown = before.refit_from(data)
    errors, again = before.fitted.position_errors, grown.fitted.position_errors
    assert errors is not None
    assert again is not None
    assert np.trace(again.covariance) == pytest.approx(np.trace(errors.covariance), rel=0.1)
    assert again.noise == pytest.approx(errors.noise, rel=0.1)


def test_what_cameras_see_is_sensitive_to_what_ties_them() -> None:
    """One table of all cameras, whose products are the covariances between them."""
    calibration = dots()
    (found,) = calibration.map.sensitivities(known().xyz[:3])
    posterior = calibration.posterior
    joint = np.concatenate([posterior.root(c) for c in range(len(posterior.models))], axis=1)
    x = calibration.frame.to_working(known().xyz[:3])
    designs = []
    for model in posterior.models:
        rows = model.rows(x)
        m = rows.phi.shape[1]
        wide = np.zeros((3, 2, model.size))
        wide[:, :, : model.camera.size] = rows.J
        wide[:, 0, model.camera.size : model.camera.size + m] = wide[:, 1, model.camera.size + m :] = rows.phi
        designs.append(wide)
    for i in range(3):
        design = block_diag(*(d[i] for d in designs))
        expected = design @ joint.T @ joint @ design.T
        np.testing.assert_allclose(found.half[i] @ found.half[i].T, expected, rtol=1e-6, atol=1e-9 * expected.max())
        assert np.abs(expected[:2, 2:]).max() > 0


def test_more_cameras_than_can_be_tied_are_refused_or_said() -> None:
    rig = build_rig("bar4", seed=1)
    data = simulate(rig, random_positions(rig, 40, np.random.default_rng(1)), seed=2, robot_noise=0.5)
    few = ForwardGP(settings=replace(ForwardGP().settings, max_tied_unknowns=100))
    with pytest.raises(FitError, match="too many for known positions with declared errors") as refused:
        few.fit(data)
    assert "leave sd_x, sd_y and sd_z out" in str(refused.value.fix)
    assert data.known is not None
    exact = few.fit(replace(data, known=replace(data.known, sd=np.full((40, 3), np.nan))))
    assert not exact.posterior.tied
    (note,) = [note for note in exact.notes if "was not looked for" in note]
    assert "rather too large than too small" in note
    new = simulate(rig, random_positions(rig, 300, np.random.default_rng(3)), seed=4)
    overall = evaluate(exact, new, regions=False).coverage.overall
    assert overall.nees.value < 3.3, "too small error bars; a perfect calibration has 3"
