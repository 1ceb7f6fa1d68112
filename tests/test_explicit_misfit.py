"""explicit: error bars that learn from the known points how far the lens models are off."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag

from implicam.calibrators.explicit.misfit import Left, error_ratio, expected_squares
from implicam.geometry import Floats


def alignment(m: int, ratio: float, seed: int = 0, declared: float = 0.3) -> tuple[Left, Floats, Floats]:
    """What a weighted alignment leaves of errors `ratio` times as large as stated; three points to a shot. With the
    covariance of the errors from the cameras and views, and of that from the known positions, (3 m, 3 m)."""
    rng = np.random.default_rng(seed)
    G = np.concatenate([rng.normal(size=(m, 3, 3)), np.broadcast_to(np.eye(3), (m, 3, 3))], axis=2)
    half = rng.normal(size=(m, 3, 3)) + 2 * np.eye(3)
    point, spread = half @ half.swapaxes(1, 2), 0.3 * rng.normal(size=(m, 3, 4))
    known = declared * np.tile(np.diag([1.0, 2.0, 0.5]), (m, 1, 1))
    shots = np.array([f"shot{i // 3}" for i in range(m)])
    shared = np.zeros((3 * m, 3 * len(np.unique(shots))))
    for i in range(m):
        shared[3 * i : 3 * i + 3, 3 * (i // 3) : 3 * (i // 3) + 3] = known[i]
    flat = spread.reshape(3 * m, 4)
    cameras, positions = block_diag(*point) + flat @ flat.T, shared @ shared.T
    error = rng.multivariate_normal(np.zeros(3 * m), ratio**2 * cameras + positions)
    W = np.linalg.inv(point + spread @ spread.swapaxes(1, 2) + known @ known)
    Q = np.linalg.inv(np.einsum("nai,nab,nbj->ij", G, W, G))
    motion = Q @ np.einsum("nai,nab,nb->i", G, W, error.reshape(m, 3))
    residual = error.reshape(m, 3) - G @ motion
    return Left(residual, W, G, Q, point, spread, known, shots), cameras, positions


def test_what_is_expected_to_be_left_is_that_of_the_full_matrices() -> None:
    left, cameras, positions = alignment(7, 1.0)
    W, G = block_diag(*left.W), left.G.reshape(-1, 6)
    N = W - W @ G @ left.Q @ G.T @ W  # the sum of squares is error^T N error
    squares, from_cameras, from_positions, degrees = expected_squares(left)
    flat = left.residual.ravel()
    np.testing.assert_allclose(squares, flat @ W @ flat)
    np.testing.assert_allclose([from_cameras, from_positions], [np.trace(N @ cameras), np.trace(N @ positions)])
    S = cameras + positions
    np.testing.assert_allclose(degrees, np.trace(N @ S) ** 2 / np.trace(N @ S @ N @ S))
    alone = left._replace(spread=np.zeros((7, 3, 0)), declared=np.zeros((7, 3, 3)), W=np.linalg.inv(left.point))
    Q = np.linalg.inv(np.einsum("nai,nab,nbj->ij", G.reshape(7, 3, 6), alone.W, G.reshape(7, 3, 6)))
    np.testing.assert_allclose(expected_squares(alone._replace(Q=Q))[1:], [15.0, 0.0, 15.0], atol=1e-9)


@pytest.mark.parametrize("ratio", [0.6, 1.0, 2.5])
def test_many_points_tell_the_ratio_and_few_hardly(ratio: float) -> None:
    many = np.mean([error_ratio(alignment(60, ratio, seed)[0], 0.3) for seed in range(20)])
    np.testing.assert_allclose(many, ratio, rtol=0.08)  # 20 times 174 degrees of freedom: 2 %, and what the prior pulls
    few = np.mean([error_ratio(alignment(4, ratio, seed)[0], 0.3) for seed in range(40)])
    assert min(1.0, ratio) < few < 1.25 * max(1.0, ratio)
    assert abs(np.log(few)) < abs(np.log(ratio)) + 0.12


def test_where_the_known_positions_are_coarse_they_tell_nothing() -> None:
    coarse = [error_ratio(alignment(60, 2.5, seed, declared=300.0)[0], 0.3) for seed in range(5)]
    np.testing.assert_allclose(coarse, np.exp(0.3**2), rtol=0.05)  # the root of the prior's mean square


def test_a_prior_that_is_sure_changes_nothing() -> None:
    np.testing.assert_allclose(error_ratio(alignment(20, 2.5)[0], 1e-6), 1.0)
