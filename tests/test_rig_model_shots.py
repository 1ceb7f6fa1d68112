"""Errors of whole shots: rigid bodies, what is smooth along the traverse, labels near a shot and far from it."""

from __future__ import annotations

import numpy as np
import pytest

from forward_gp_cases import rotation
from implicam.rig_model.settings import DEFAULT_SETTINGS
from implicam.rig_model.shot_errors import WORLD_POLYNOMIAL_TERMS, ShotErrors, Shots


@pytest.mark.parametrize("size", [1e-2, 1.0, 30.0])
def test_the_update_of_the_shots_sds_maximises_their_posterior(size: float) -> None:
    """The expected log density of the unknowns and the prior of the sd, tried on a grid."""
    rng = np.random.default_rng(6)
    sd = np.column_stack([rng.uniform(1e-3, 3e-3, (5, 2)), rng.uniform(1e-4, 1e-3, (5, 1)), np.full((5, 1), 0.7)])
    errors = ShotErrors(np.zeros(3, dtype=np.int64), np.zeros((3, 3, 4)), sd, np.array([0, 0, 1, -1]))
    mean, variance = size * rng.normal(size=(5, 4)), rng.uniform(0.01, 1, (5, 4))
    median, log_sd = np.log(DEFAULT_SETTINGS.shot_sd_prior_median_wf), DEFAULT_SETTINGS.shot_sd_prior_log_sd
    updated, label = errors.update(mean, variance, DEFAULT_SETTINGS)
    np.testing.assert_array_equal(updated.sd[:, 3], 0.7)  # declared sds stay
    np.testing.assert_array_equal(label[:, 3], 0.7)
    for columns in ([0, 1], [2]):
        new = updated.sd[:, columns]
        assert np.ptp(new) == 0
        second = ((mean**2 + variance) * sd**2)[:, columns]
        u = np.log(new[0, 0]) + np.linspace(-2, 2, 400001)
        objective = -second.size * u - 0.5 * second.sum() * np.exp(-2 * u) - 0.5 * ((u - median) / log_sd) ** 2
        assert np.exp(u[np.argmax(objective)]) == pytest.approx(new[0, 0], rel=2e-5)
        told = np.sum(1 - variance[:, columns])
        np.testing.assert_allclose(label[:, columns], new * np.exp(1 / (2 * told + 1 / log_sd**2)))


def plates(
    count: int = 7, corners: int = 5, seed: int = 2, step: float = 0.4
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points on plates along a slanted traverse, their shots, the traverse, and where along it each plate is."""
    turn = rotation(seed)
    t = step * (np.arange(count) - (count - 1) / 2) + 0.01 * np.random.default_rng(seed).normal(size=count)
    y, x = np.meshgrid(np.linspace(-0.8, 0.8, corners), np.linspace(-1, 1, corners), indexing="ij")
    plate = np.column_stack([x.ravel(), y.ravel(), np.zeros(corners**2)])
    points = np.concatenate([plate + np.array([0, 0, z]) for z in t]) @ turn.T
    return points, np.repeat([f"shot{i}" for i in range(count)], corners**2), turn[:, 2], t


def test_a_shot_is_displaced_as_a_rigid_body() -> None:
    points, labels, _, _ = plates()
    shots = Shots.of(points, labels)
    assert shots is not None
    errors = shots.errors(points)
    k = errors.basis.shape[2]
    assert errors.estimated
    assert k == 6 * (7 - WORLD_POLYNOMIAL_TERMS)
    every = []
    for s in range(7):
        members = labels == f"shot{s}"
        X, d = points[members] - points[members].mean(axis=0), errors.basis[members]
        rigid = np.concatenate([np.broadcast_to(np.eye(3), (len(X), 3, 3)), -cross_matrices(X)], axis=2).reshape(-1, 6)
        motion, *_ = np.linalg.lstsq(rigid, d.reshape(-1, k), rcond=None)
        np.testing.assert_allclose(rigid @ motion, d.reshape(-1, k), atol=1e-12)
        every.append(motion)
    assert np.linalg.matrix_rank(np.concatenate(every)) == k  # each pattern is another one


def cross_matrices(v: np.ndarray) -> np.ndarray:
    """(n, 3, 3) such that `matrix @ w = v x w`."""
    return np.stack([np.cross(v, e) for e in np.eye(3)], axis=2)


def test_what_is_smooth_along_the_traverse_is_no_error_of_a_shot() -> None:
    points, labels, along, t = plates()
    shots = Shots.of(points, labels)
    assert shots is not None
    np.testing.assert_allclose(np.abs(shots.along[0] @ along), 1, atol=1e-9)
    basis = shots.errors(points).basis.reshape(-1, shots.errors(points).basis.shape[2])
    rng = np.random.default_rng(3)
    for degree in range(5):
        coefficients = rng.normal(size=3)
        shift = (t**degree)[np.repeat(np.arange(7), 25), None] * coefficients
        smooth = sum(np.linalg.lstsq(basis, shift.reshape(-1, 1), rcond=None)[1].tolist())
        represented = 1 - smooth / np.sum(shift**2)
        if degree < WORLD_POLYNOMIAL_TERMS:
            np.testing.assert_allclose(basis.T @ shift.ravel(), 0, atol=1e-9)
            assert abs(represented) < 1e-9
        else:
            assert represented > 0.01


def test_the_sds_of_shots_belong_to_three_kinds_of_error() -> None:
    points, labels, along, _ = plates()
    shots = Shots.of(points, labels)
    assert shots is not None
    errors = shots.errors(points)
    means = np.stack([errors.basis[labels == f"shot{s}"].mean(axis=0) for s in range(7)])  # (S, 3, k)
    by_along = np.abs(np.einsum("sik,i->sk", means, along)).max(axis=0)
    size = np.linalg.norm(means, axis=1).max(axis=0)
    np.testing.assert_allclose(by_along[errors.group == 0], size[errors.group == 0], rtol=1e-9)
    assert by_along[errors.group == 1].max() < 1e-9
    assert size[errors.group == 2].max() < 1e-9  # tilts leave the middle where it is
    assert size[errors.group < 2].min() > 0.05


def test_shots_too_few_or_too_small_are_taken_as_they_are() -> None:
    points, labels, _, _ = plates()
    assert Shots.of(points[:75], labels[:75]) is None  # three plates: a parabola explains all of it
    assert Shots.of(points[:100], labels[:100]) is not None
    small = np.isin(np.arange(len(points)) % 25, [0, 4, 12, 20, 24])
    assert Shots.of(points[small], labels[small]) is None
    assert Shots.of(points, np.array([f"p{i}" for i in range(len(points))])) is None
    assert Shots.of(np.tile(points[:25], (7, 1)), labels) is None  # all at the same place


def test_the_label_at_a_shot_is_known_and_far_away_it_is_not() -> None:
    points, labels, _, _ = plates()
    shots = Shots.of(points, labels)
    assert shots is not None
    errors = shots.errors(points)
    each = np.array([3e-3, 1e-3, 1e-3, 5e-4, 5e-4, 5e-4])
    sd = np.repeat(each, 7 - WORLD_POLYNOMIAL_TERMS)
    np.testing.assert_allclose(shots.label_slope(points, sd), errors.basis * sd, atol=1e-12)
    np.testing.assert_allclose(shots.unresolved_covariance(points, each), 0, atol=1e-15)
    shift_only, far = np.array([2e-3, 2e-3, 2e-3, 0, 0, 0]), points[:5] + 50 * shots.along[0]
    np.testing.assert_allclose(shots.label_slope(far, sd), 0, atol=1e-15)
    left = shots.unresolved_covariance(far, shift_only)
    np.testing.assert_allclose(left, np.broadcast_to(4e-6 * np.eye(3), (5, 3, 3)), atol=1e-12)
    between = 0.5 * (points[:25] + points[25:50])
    left = shots.unresolved_covariance(between, shift_only)
    share = np.diagonal(left, axis1=1, axis2=2) / 4e-6
    assert (share > 0.5).all()  # halfway a label says little
    assert (share < 1).all()


def test_the_unknown_part_of_a_label_turns_with_the_world() -> None:
    points, labels, along, _ = plates(seed=2)
    shots = Shots.of(points, labels)
    assert shots is not None
    left = shots.unresolved_covariance(points[:1] + 50 * along, np.array([3e-3, 1e-3, 1e-3, 0, 0, 0]))
    expected = 9e-6 * np.outer(along, along) + 1e-6 * (np.eye(3) - np.outer(along, along))
    np.testing.assert_allclose(left[0], expected, atol=1e-12)


def test_the_unknown_tilt_of_a_label_turns_with_the_world() -> None:
    points, labels, along, _ = plates()
    turn, sd = rotation(12), np.array([0, 0, 0, 1e-3, 1e-3, 1e-3])
    at = points[::10] + 5 * along
    a, b = Shots.of(points, labels), Shots.of(points @ turn.T, labels)
    assert a is not None
    assert b is not None
    turned = turn.T @ b.unresolved_covariance(at @ turn.T, sd) @ turn
    np.testing.assert_allclose(turned, a.unresolved_covariance(at, sd), atol=1e-9)
