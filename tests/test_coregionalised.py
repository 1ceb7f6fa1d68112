"""The intrinsic coregionalisation model: against the dense matrix, differences, and GPyTorch's own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.stats import multivariate_normal

from implicam.gp import Kernel, maximise_each
from implicam.gp.coregionalised import CoregionalisedLikelihood, maximise_coregionalised

RNG = np.random.default_rng(3)


def problem(n: int, d: int = 2, m: int = 3, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Inputs, outputs drawn from the model, and the covariances of signal and noise."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, d))
    half = rng.normal(size=(m, m))
    B = half @ half.T + 0.1 * np.eye(m)
    half = 0.05 * rng.normal(size=(m, m))
    N = half @ half.T + 1e-4 * np.eye(m)
    K = Kernel("squared-exponential", 1.0, np.array([1.5, 3.0][:d]))(X, X)
    covariance = np.kron(K, B) + np.kron(np.eye(n), N)
    return X, rng.multivariate_normal(np.zeros(n * m), covariance).reshape(n, m), B, N


@pytest.mark.parametrize("shape", ["squared-exponential", "matern-5/2"])
def test_likelihood_is_that_of_the_dense_matrix_and_its_gradient_that_of_differences(shape: str) -> None:
    X, Y, _, _ = problem(12)
    likelihood = CoregionalisedLikelihood(X, Y, shape)
    signals, mixing = np.array([3.0, 40.0, 200.0]), RNG.normal(size=(3, 3)) + 3 * np.eye(3)
    theta = np.concatenate([np.log([1.3, 2.0]), np.log(signals), mixing.ravel()])
    value, gradient = likelihood(theta)
    back = np.linalg.inv(mixing)
    K = Kernel(shape, 1.0, np.array([1.3, 2.0]))(X, X)
    dense = np.kron(K, back.T @ np.diag(signals) @ back) + np.kron(np.eye(12), back.T @ back)
    assert -value == pytest.approx(multivariate_normal(np.zeros(36), dense).logpdf(Y.ravel()), rel=1e-9)
    differences = approx_fprime(theta, lambda t: likelihood(t)[0], 1e-7)
    np.testing.assert_allclose(gradient, differences, rtol=2e-4, atol=2e-4)


@pytest.mark.slow
def test_the_covariances_of_signal_and_noise_are_found() -> None:
    X, Y, B, N = problem(220, seed=5)
    starts = maximise_each(X, Y, shortest=0.3)
    found = maximise_coregionalised(X, Y, "squared-exponential", starts, shortest=0.3)
    assert found.converged
    np.testing.assert_allclose(found.kernels[0].lengthscale, [1.5, 3.0], rtol=0.15)
    sd = np.sqrt(np.diag(N))
    np.testing.assert_allclose(found.noise_covariance / np.outer(sd, sd), N / np.outer(sd, sd), atol=0.2)
    # a draw has few wavelengths, and so says little of the signal's covariance: but nothing is less probable than truth
    eigen, vectors = np.linalg.eigh(np.linalg.solve(np.linalg.cholesky(N), np.linalg.solve(np.linalg.cholesky(N), B).T))
    mixing = np.linalg.inv(np.linalg.cholesky(N)).T @ vectors
    truth = np.concatenate([np.log([1.5, 3.0]), np.log(eigen), mixing.ravel()])
    value = CoregionalisedLikelihood(X, Y, "squared-exponential")(truth)[0]
    assert -value <= found.log_marginal_likelihood <= -value + 20


def test_it_is_never_less_probable_than_independent_outputs_with_the_same_lengthscales() -> None:
    for seed in range(4):
        X, Y, _, _ = problem(40, seed=seed)
        starts = maximise_each(X, Y, shortest=0.3)
        found = maximise_coregionalised(X, Y, "squared-exponential", starts, shortest=0.3)
        for start in starts:
            likelihood = CoregionalisedLikelihood(X, Y, "squared-exponential")
            noise = Y.var(axis=0) * start.noise_variance / start.kernel.signal_variance
            signals = np.full(3, start.kernel.signal_variance / start.noise_variance)
            theta = np.concatenate([np.log(start.kernel.lengthscale), np.log(signals), np.diag(noise**-0.5).ravel()])
            assert found.log_marginal_likelihood > -likelihood(theta)[0] - 1e-6


def test_agrees_with_gpytorchs_multitask_model() -> None:
    torch, gpytorch = pytest.importorskip("torch"), pytest.importorskip("gpytorch")
    X, Y, _, _ = problem(30, seed=2)
    starts = maximise_each(X, Y, shortest=0.3)
    found = maximise_coregionalised(X, Y, "squared-exponential", starts, shortest=0.3)

    class Model(gpytorch.models.ExactGP):
        def __init__(self, x, y, likelihood):
            super().__init__(x, y, likelihood)
            self.mean = gpytorch.means.MultitaskMean(gpytorch.means.ZeroMean(), num_tasks=3)
            base = gpytorch.kernels.RBFKernel(ard_num_dims=2)
            self.kernel = gpytorch.kernels.MultitaskKernel(base, num_tasks=3, rank=3)

        def forward(self, x):
            return gpytorch.distributions.MultitaskMultivariateNormal(self.mean(x), self.kernel(x))

    x, y = torch.tensor(X), torch.tensor(Y)
    likelihood = gpytorch.likelihoods.MultitaskGaussianLikelihood(num_tasks=3, rank=3, has_global_noise=False)
    model = Model(x, y, likelihood).double()
    likelihood.double()
    model.kernel.data_covar_module.lengthscale = torch.tensor(found.kernels[0].lengthscale)
    model.kernel.task_covar_module.covar_factor.data = torch.tensor(np.linalg.cholesky(found.signal_covariance))
    model.kernel.task_covar_module.var = torch.full((3,), 1e-12, dtype=torch.float64)
    likelihood.task_noise_covar_factor.data = torch.tensor(np.linalg.cholesky(found.noise_covariance))
    model.train()
    with gpytorch.settings.fast_computations(covar_root_decomposition=False, log_prob=False, solves=False):
        theirs = likelihood(model(x)).log_prob(y).item()
    assert found.log_marginal_likelihood == pytest.approx(theirs, rel=1e-5)
