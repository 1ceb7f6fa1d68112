"""A Gaussian process in few features is the exact one: against dense NumPy, our exact process, and scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest

from implicam.gp import GaussianProcess, Kernel
from implicam.gp.low_rank import MAX_CANDIDATE_POINTS, LowRank, pivoted_cholesky, pivoted_kernel

NOISE_SD, SIGNAL = 0.1, 1.7
LENGTHSCALE = np.array([0.6, 0.6, 1.5])


def kernel() -> Kernel:
    return Kernel("squared-exponential", 1.0, LENGTHSCALE)


def points(n: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (n, 3))


def values(X: np.ndarray, seed: int) -> np.ndarray:
    noise = NOISE_SD * np.random.default_rng(seed).normal(size=len(X))
    return np.asarray(SIGNAL * np.sin(2 * X[:, 0] + X[:, 1] ** 2 - X[:, 2]) + noise)


def dense_kernel(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """The squared exponential, written down once more."""
    return np.asarray(np.exp(-0.5 * np.sum(((A[:, None] - B[None]) / LENGTHSCALE) ** 2, axis=2)))


def predicted(field: LowRank, X: np.ndarray, y: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd of the function at new inputs: Bayesian linear regression in the features, and what they leave."""
    phi, there = SIGNAL * field.features(X), SIGNAL * field.features(at)
    precision = np.eye(phi.shape[1]) + phi.T @ phi / NOISE_SD**2
    weights = np.linalg.solve(precision, phi.T @ y / NOISE_SD**2)
    variance = np.sum(there * np.linalg.solve(precision, there.T).T, axis=1)
    return there @ weights, np.sqrt(variance + SIGNAL**2 - np.sum(there**2, axis=1))


def spectrum_with_rank(rank: int, n: int, seed: int) -> np.ndarray:
    """A positive semidefinite matrix of that rank."""
    A = np.random.default_rng(seed).normal(size=(n, rank))
    return A @ A.T


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-8])
def test_features_reproduce_the_kernel_to_the_tolerance_at_the_points(tolerance: float) -> None:
    X = points(400, 0)
    field = LowRank.of(kernel(), X, tolerance)
    phi, K = field.features(X), dense_kernel(X, X)
    left = K - phi @ phi.T
    assert np.diag(left).max() < tolerance
    assert np.diag(left).min() > -1e-7  # the features never add variance
    assert np.abs(left).max() < tolerance + 1e-9  # a positive semidefinite matrix is largest on its diagonal
    assert 5 < len(field.inducing) < len(X)


def test_a_finer_tolerance_takes_more_inducing_points_and_keeps_the_first() -> None:
    X = points(300, 1)
    coarse, fine = (LowRank.of(kernel(), X, tolerance).inducing for tolerance in (1e-2, 1e-5))
    assert len(coarse) < len(fine)
    np.testing.assert_array_equal(fine[: len(coarse)], coarse)


def test_features_at_inducing_points_are_the_cholesky_factor() -> None:
    X = points(200, 2)
    field = LowRank.of(kernel(), X, 1e-3)
    expected = np.linalg.cholesky(dense_kernel(field.inducing, field.inducing))
    np.testing.assert_allclose(field.features(field.inducing), expected, atol=1e-9)
    np.testing.assert_allclose(field.features_from(dense_kernel(X, field.inducing)), field.features(X), atol=1e-8)


def test_coefficients_turn_weights_of_features_into_weights_of_kernels() -> None:
    X, at = points(200, 3), points(50, 4)
    field = LowRank.of(kernel(), X, 1e-4)
    weights = np.random.default_rng(5).normal(size=(len(field.inducing), 2))
    by_kernel = dense_kernel(at, field.inducing) @ field.coefficients(weights)
    np.testing.assert_allclose(by_kernel, field.features(at) @ weights, atol=1e-7)


@pytest.mark.parametrize("tolerance", [1.0, 1e-3, 1e-9])
def test_pivoted_cholesky_leaves_less_than_the_tolerance(tolerance: float) -> None:
    X = points(250, 6)
    K = dense_kernel(X, X) * np.outer(*2 * [np.linspace(0.5, 2, len(X))])
    pivots, factor = pivoted_cholesky(K, tolerance)
    left = np.diag(K - factor @ factor.T)
    assert len(np.unique(pivots)) == len(pivots) == factor.shape[1]
    assert left.max() <= tolerance * (1 + 1e-9)
    np.testing.assert_allclose(left[pivots], 0, atol=1e-12)
    before = np.diag(K - factor[:, :-1] @ factor[:, :-1].T)
    assert before.max() > tolerance  # one fewer would not have been enough
    assert pivots[-1] == np.argmax(before)


@pytest.mark.parametrize(("lengths", "n"), [(0.25, 300), (1.0, 600), (1.0, 40)])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-6])
def test_the_rows_of_the_pivots_alone_give_the_same_factor(lengths: float, n: int, tolerance: float) -> None:
    one, X = Kernel("squared-exponential", 1.7, lengths * LENGTHSCALE), points(n, 9)
    pivots, factor = pivoted_kernel(one, X, tolerance)
    expected, factor_expected = pivoted_cholesky(one(X, X), tolerance)
    np.testing.assert_array_equal(pivots, expected)
    np.testing.assert_allclose(factor, factor_expected, atol=1e-9)


def test_pivots_are_where_most_is_left() -> None:
    """The algorithm written down step by step."""
    K = spectrum_with_rank(40, 60, 7)
    pivots, factor = pivoted_cholesky(K, 1e-8)
    left, expected = K.copy(), []
    for _ in range(12):
        expected.append(int(np.argmax(np.diag(left))))
        column = left[:, expected[-1]]
        left = left - np.outer(column, column) / column[expected[-1]]
    assert pivots[:12].tolist() == expected
    np.testing.assert_allclose(K - factor[:, :12] @ factor[:, :12].T, left, atol=1e-9)


def test_pivoted_cholesky_of_a_matrix_without_full_rank_stops_at_its_rank() -> None:
    K = spectrum_with_rank(7, 50, 8)
    given = K.copy()
    pivots, factor = pivoted_cholesky(K, 1e-8)
    np.testing.assert_array_equal(K, given)  # LAPACK works in place, on a copy
    assert len(pivots) == 7 == np.linalg.matrix_rank(K)
    np.testing.assert_allclose(factor @ factor.T, K, atol=1e-9)


def test_pivoted_cholesky_of_full_rank_is_the_whole_matrix() -> None:
    K = spectrum_with_rank(30, 30, 9) + np.eye(30)
    pivots, factor = pivoted_cholesky(K, 0.0)
    assert sorted(pivots.tolist()) == list(range(30))
    np.testing.assert_allclose(factor @ factor.T, K, atol=1e-9)
    np.testing.assert_allclose(factor[pivots], np.linalg.cholesky(K[np.ix_(pivots, pivots)]), atol=1e-9)


def test_predictions_are_those_of_the_exact_process() -> None:
    X, at = points(300, 10), points(200, 11)
    y = values(X, 12)
    field = LowRank.of(kernel(), X, 1e-6)
    mean, sd = predicted(field, X, y, at)
    exact = GaussianProcess.condition(Kernel("squared-exponential", SIGNAL**2, LENGTHSCALE), NOISE_SD**2, X, y)
    exact_mean, variance = exact.predict(at)
    assert len(field.inducing) < 0.7 * len(X)
    assert np.abs((mean - exact_mean) / np.sqrt(variance)).max() < 0.01
    np.testing.assert_allclose(sd, np.sqrt(variance), rtol=0.01)


def test_predictions_are_those_of_scikit_learn_far_away_too() -> None:
    sklearn = pytest.importorskip("sklearn.gaussian_process")
    X, at = points(150, 13), 4 * points(100, 14)  # most of them where there are no data
    y = values(X, 15)
    mean, sd = predicted(LowRank.of(kernel(), X, 1e-6), X, y, at)
    shape = sklearn.kernels.ConstantKernel(SIGNAL**2) * sklearn.kernels.RBF(LENGTHSCALE)
    other = sklearn.GaussianProcessRegressor(shape, alpha=NOISE_SD**2, optimizer=None).fit(X, y)
    other_mean, other_sd = other.predict(at, return_std=True)
    assert np.abs((mean - other_mean) / other_sd).max() < 0.01
    np.testing.assert_allclose(sd, other_sd, rtol=0.01)
    assert other_sd.max() > 0.99 * SIGNAL  # far away nothing is known, and the features say so


def test_slope_is_the_derivative() -> None:
    X, at, h = points(200, 16), points(40, 17), 1e-5
    field = LowRank.of(kernel(), X, 1e-3)
    coefficients = np.random.default_rng(18).normal(size=(len(field.inducing), 2))

    def value(where: np.ndarray) -> np.ndarray:
        return dense_kernel(where, field.inducing) @ coefficients

    slope = field.slope(at, field.kernel(at, field.inducing), coefficients)
    numeric = np.stack([(value(at + d) - value(at - d)) / (2 * h) for d in h * np.eye(3)], axis=2)
    np.testing.assert_allclose(slope, numeric, atol=1e-7 * np.abs(numeric).max())


def test_more_points_than_are_looked_at() -> None:
    """The inducing points come from a draw; what they leave at the points not drawn is as little."""
    X = points(3 * MAX_CANDIDATE_POINTS, 19)
    field = LowRank.of(kernel(), X, 1e-5)
    phi = field.features(X)
    assert (1 - np.sum(phi**2, axis=1)).max() < 1e-3
    assert np.mean(1 - np.sum(phi**2, axis=1) < 1e-5) > 0.9
    assert {tuple(row) for row in field.inducing} <= {tuple(row) for row in X}
    np.testing.assert_array_equal(LowRank.of(kernel(), X, 1e-5).inducing, field.inducing)  # the same every time
    y, at = values(X, 20), points(50, 21)
    mean, sd = predicted(field, X, y, at)
    exact = GaussianProcess.condition(
        Kernel("squared-exponential", SIGNAL**2, LENGTHSCALE),
        NOISE_SD**2,
        X[:MAX_CANDIDATE_POINTS],
        y[:MAX_CANDIDATE_POINTS],
    )
    exact_mean, variance = exact.predict(at)
    assert np.abs((mean - exact_mean) / np.sqrt(variance)).max() < 4  # a third of the data says the same, less well
    assert (sd < np.sqrt(variance)).all()


@pytest.mark.parametrize("copies", [2, 5])
def test_duplicates_among_the_points_change_nothing(copies: int) -> None:
    once = points(100, 22)
    X = np.repeat(once, copies, axis=0)
    field = LowRank.of(kernel(), X, 1e-7)
    assert len(np.unique(field.inducing, axis=0)) == len(field.inducing) <= len(once)
    phi = field.features(X)
    np.testing.assert_allclose(phi @ phi.T, dense_kernel(X, X), atol=2e-7)
    y, at = values(X, 23), points(30, 24)
    mean, sd = predicted(field, X, y, at)
    exact = GaussianProcess.condition(Kernel("squared-exponential", SIGNAL**2, LENGTHSCALE), NOISE_SD**2, X, y)
    exact_mean, variance = exact.predict(at)
    assert np.abs((mean - exact_mean) / np.sqrt(variance)).max() < 0.01
    np.testing.assert_allclose(sd, np.sqrt(variance), rtol=0.01)


def test_one_point_or_many_at_one_place() -> None:
    for X in (points(1, 25), np.zeros((20, 3))):
        field = LowRank.of(kernel(), X, 1e-6)
        np.testing.assert_array_equal(field.inducing, X[:1])
        np.testing.assert_allclose(field.features(X), 1.0)
