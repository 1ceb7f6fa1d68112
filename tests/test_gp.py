"""The GP core against closed forms, finite differences, scikit-learn and GPyTorch."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from implicam.errors import NumericalError, UsageError
from implicam.gp import SHAPES, GaussianProcess, Kernel, maximise, maximise_each
from implicam.gp.fit import ProfiledLikelihood

ALL_SHAPES = pytest.mark.parametrize("shape", list(SHAPES))


def problem(n=40, d=3, seed=0, noise=0.05):
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, d))
    y = np.sin(X[:, 0]) + 0.5 * X[:, 1] ** 2 - X[:, -1] + noise * rng.normal(size=n)
    return X, y - y.mean()


def kernel_of(shape, d=3):
    return Kernel(shape, 1.7, np.linspace(0.8, 2.1, d))


# --- closed forms -------------------------------------------------------------------------------------------------


@ALL_SHAPES
def test_one_point_is_the_textbook_formula(shape):
    kernel = Kernel(shape, 2.0, [1.5])
    gp = GaussianProcess.condition(kernel, 0.5, [[0.0]], [1.0])
    k = kernel(np.array([[0.7]]), np.array([[0.0]]))[0, 0]
    mean, variance = gp.predict([[0.7]])
    assert mean[0] == pytest.approx(k / 2.5, abs=1e-14)
    assert variance[0] == pytest.approx(2.0 - k**2 / 2.5, abs=1e-14)
    assert gp.log_marginal_likelihood() == pytest.approx(-0.5 / 2.5 - 0.5 * np.log(2 * np.pi * 2.5), abs=1e-14)


def test_kernels_at_one_lengthscale():
    a, b = np.zeros((1, 1)), np.ones((1, 1))
    assert Kernel("squared-exponential", 1.0, [1.0])(a, b)[0, 0] == pytest.approx(np.exp(-0.5))
    s = np.sqrt(5)
    assert Kernel("matern-5/2", 1.0, [1.0])(a, b)[0, 0] == pytest.approx((1 + s + 5 / 3) * np.exp(-s))


def test_far_from_the_data_the_prior_comes_back():
    X, y = problem()
    gp = GaussianProcess.condition(kernel_of("squared-exponential"), 0.01, X, y, mean=3.0)
    mean, variance = gp.predict(np.full((1, 3), 100.0))
    assert (mean[0], variance[0]) == (3.0, 1.7)


@ALL_SHAPES
def test_leave_one_out_is_leaving_one_out(shape):
    X, y = problem(n=12)
    mean, variance = GaussianProcess.condition(kernel_of(shape), 0.1, X, y).leave_one_out()
    for i in range(len(y)):
        others = np.arange(len(y)) != i
        m, v = GaussianProcess.condition(kernel_of(shape), 0.1, X[others], y[others]).predict(X[[i]])
        assert (mean[i], variance[i]) == (pytest.approx(m[0], abs=1e-12), pytest.approx(v[0] + 0.1, abs=1e-12))


@ALL_SHAPES
def test_adding_a_point_equals_starting_again(shape):
    X, y = problem(n=25)
    grown = GaussianProcess.condition(kernel_of(shape), 0.01, X[:20], y[:20], mean=0.3)
    for x, value in zip(X[20:], y[20:], strict=True):
        grown = grown.add(x, value)
    fresh = GaussianProcess.condition(kernel_of(shape), 0.01, X, y, mean=0.3)
    at = np.random.default_rng(1).normal(size=(50, 3))
    np.testing.assert_allclose(grown.predict(at), fresh.predict(at), atol=1e-12)
    np.testing.assert_allclose(grown.L, fresh.L, atol=1e-12)
    assert grown.log_marginal_likelihood() == pytest.approx(fresh.log_marginal_likelihood(), abs=1e-10)


def test_blocks_do_not_change_the_prediction(monkeypatch):
    X, y = problem()
    gp = GaussianProcess.condition(kernel_of("matern-5/2"), 0.01, X, y)
    whole = gp.predict(X)
    monkeypatch.setattr("implicam.gp.regression.BLOCK_ENTRIES", 7 * len(X))
    np.testing.assert_allclose(gp.predict(X), whole, atol=1e-13)


@given(st.integers(0, 2**31), st.floats(0.1, 1e4), st.floats(-1e3, 1e3))
def test_units_do_not_matter(seed, scale, shift):
    """Inputs and outputs in other units give the same answer in those units."""
    X, y = problem(n=15, seed=seed)
    a = GaussianProcess.condition(kernel_of("squared-exponential"), 0.1, X, y)
    kernel = Kernel("squared-exponential", 1.7 * scale**2, kernel_of("squared-exponential").lengthscale * scale)
    b = GaussianProcess.condition(kernel, 0.1 * scale**2, X * scale + shift, y * scale)
    (ma, va), (mb, vb) = a.predict(X[:3] + 0.3), b.predict((X[:3] + 0.3) * scale + shift)
    tolerance = 1e-9 * (1 + (shift / scale) ** 2)  # r² is a difference of squares: see squared_distances
    np.testing.assert_allclose(mb / scale, ma, atol=tolerance)
    np.testing.assert_allclose(vb / scale**2, va, atol=tolerance)


# --- gradients ----------------------------------------------------------------------------------------------------


@ALL_SHAPES
def test_gradient_is_the_finite_difference(shape):
    likelihood = ProfiledLikelihood(*problem(), shape)
    for theta in np.random.default_rng(2).uniform([-0.5] * 3 + [-7], [2.0] * 3 + [-1], size=(10, 4)):
        _, gradient = likelihood(theta)
        steps = 1e-5 * np.eye(4)
        numeric = [(likelihood(theta + h)[0] - likelihood(theta - h)[0]) / 2e-5 for h in steps]
        np.testing.assert_allclose(gradient, numeric, rtol=1e-6, atol=1e-6)


@ALL_SHAPES
def test_profiled_value_is_the_marginal_likelihood_at_the_best_signal_variance(shape):
    X, y = problem()
    likelihood, theta = ProfiledLikelihood(X, y, shape), np.array([0.2, 0.4, 0.6, -4.0])
    best = likelihood.signal_variance(theta)

    def of_signal(signal):
        kernel = Kernel(shape, signal, np.exp(theta[:3]))
        return GaussianProcess.condition(kernel, signal * np.exp(-4.0), X, y).log_marginal_likelihood()

    assert of_signal(best) == pytest.approx(-likelihood(theta)[0], abs=1e-9)
    assert of_signal(best) > max(of_signal(best * 0.97), of_signal(best * 1.03))


@ALL_SHAPES
def test_fisher_information_is_the_expected_curvature(shape):
    """Mean over data drawn from the model of the finite-difference Hessian, within four standard errors."""
    rng = np.random.default_rng(3)
    X, theta = rng.normal(size=(60, 2)), np.array([0.1, 0.3, -3.0])
    kernel = Kernel(shape, 1.0, np.exp(theta[:2]))
    L = np.linalg.cholesky(kernel(X, X) + np.exp(-3.0) * np.eye(60))
    hessians = []
    for _ in range(300):
        likelihood = ProfiledLikelihood(X, L @ rng.normal(size=60), shape)
        rows = [(likelihood(theta + h)[1] - likelihood(theta - h)[1]) / 2e-4 for h in 1e-4 * np.eye(3)]
        hessians.append(np.array(rows))
    error = np.std(hessians, axis=0) / np.sqrt(300)
    # profiling takes one of n degrees of freedom away: a bias of 1/n that the four standard errors do not cover
    expected = likelihood.fisher_information(theta)
    assert (np.abs(np.mean(hessians, axis=0) - expected) < 4 * error + 2 / 60 * np.abs(expected)).all()


# --- the optimum --------------------------------------------------------------------------------------------------


@ALL_SHAPES
def test_optimum_is_flat_and_better_than_its_neighbours(shape):
    X, y = problem(n=120)
    fit = maximise(X, y, shape)
    assert fit.converged

    def value(lengthscale, signal, noise):
        gp = GaussianProcess.condition(Kernel(shape, signal, lengthscale), noise, X, y)
        return gp.log_marginal_likelihood()

    k = fit.kernel
    best = value(k.lengthscale, k.signal_variance, fit.noise_variance)
    # two roundings of a matrix of condition 1e9
    assert best == pytest.approx(fit.log_marginal_likelihood, abs=1e-5)
    for factor in (0.9, 1.1):
        assert value(k.lengthscale, k.signal_variance * factor, fit.noise_variance) < best
        assert value(k.lengthscale, k.signal_variance, fit.noise_variance * factor) < best
        for i in range(3):
            scaled = k.lengthscale * np.where(np.arange(3) == i, factor, 1.0)
            assert value(scaled, k.signal_variance, fit.noise_variance) < best


def test_noise_and_lengthscale_are_recovered():
    """Data drawn from a known GP: the noise within four standard errors, the lengthscales within a third."""
    rng = np.random.default_rng(4)
    X = rng.uniform(-3, 3, size=(300, 2))
    truth = Kernel("squared-exponential", 1.0, [1.0, 2.0])
    y = np.linalg.cholesky(truth(X, X) + 1e-8 * np.eye(300)) @ rng.normal(size=300) + 0.1 * rng.normal(size=300)
    fit = maximise(X, y)
    assert fit.noise_variance == pytest.approx(0.01, rel=4 * np.sqrt(2 / 260))
    np.testing.assert_allclose(fit.kernel.lengthscale, [1.0, 2.0], rtol=0.33)


def test_units_of_the_data_come_back():
    X, y = problem(n=60)
    a, b = maximise(X, y), maximise(X * [10, 1, 0.1] + 5, y * 1000)
    np.testing.assert_allclose(b.kernel.lengthscale / a.kernel.lengthscale, [10, 1, 0.1], rtol=1e-4)
    assert b.noise_variance / a.noise_variance == pytest.approx(1e6, rel=1e-4)
    assert b.log_marginal_likelihood == pytest.approx(a.log_marginal_likelihood - 60 * np.log(1000), abs=1e-5)


def test_a_warm_start_reaches_the_same_optimum_in_fewer_evaluations():
    X, y = problem(n=121)
    before, fresh = maximise(X[:120], y[:120]), maximise(X, y)
    warm = maximise(X, y, start=before)
    assert warm.log_marginal_likelihood == pytest.approx(fresh.log_marginal_likelihood, abs=1e-3)
    assert sum(warm.evaluations.values()) < sum(fresh.evaluations.values()) / 2


def test_outputs_side_by_side_are_outputs_one_by_one():
    X, y = problem(n=100)
    Y = np.column_stack([y, X[:, 0] ** 2, np.cos(X[:, 1])])
    steps = []
    together = maximise_each(X, Y, done=lambda done, of: steps.append((done, of)))
    for fit, column in zip(together, Y.T, strict=True):
        alone = maximise(X, column)
        assert fit.log_marginal_likelihood == pytest.approx(alone.log_marginal_likelihood, abs=1e-6)
        assert fit.evaluations == alone.evaluations
    assert sorted(steps) == [(k, 6) for k in range(1, 7)]


def test_the_same_seed_gives_the_same_bits():
    X, y = problem(n=150)
    a, b = maximise(X, y, seed=5), maximise(X, y, seed=5)
    assert a.kernel.lengthscale.tobytes() == b.kernel.lengthscale.tobytes()


# --- independent libraries ----------------------------------------------------------------------------------------


@ALL_SHAPES
def test_scikit_learn_agrees(shape):
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

    X, y = problem()
    ours = kernel_of(shape)
    part = RBF(ours.lengthscale) if shape == "squared-exponential" else Matern(ours.lengthscale, nu=2.5)
    theirs = GaussianProcessRegressor(ConstantKernel(1.7) * part + WhiteKernel(0.01), optimizer=None).fit(X, y)
    gp = GaussianProcess.condition(ours, 0.01, X, y)
    at = np.random.default_rng(1).normal(size=(30, 3))
    mean, variance = gp.predict(at)
    their_mean, their_sd = theirs.predict(at, return_std=True)
    np.testing.assert_allclose(mean, their_mean, atol=1e-6)
    np.testing.assert_allclose(variance + 0.01, their_sd**2, atol=1e-6)
    assert gp.log_marginal_likelihood() == pytest.approx(theirs.log_marginal_likelihood(), abs=1e-6)


@ALL_SHAPES
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")  # about its own search
def test_the_optimum_is_no_worse_than_scikit_learns(shape):
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

    for seed in range(3):
        X, y = problem(n=70, d=4, seed=seed)
        part = (
            RBF(np.ones(4), (1e-3, 1e6)) if shape == "squared-exponential" else Matern(np.ones(4), (1e-3, 1e6), nu=2.5)
        )
        kernel = ConstantKernel(1.0, (1e-8, 1e8)) * part + WhiteKernel(0.1, (1e-10, 1e2))
        theirs = GaussianProcessRegressor(kernel, n_restarts_optimizer=2, random_state=0).fit(X, y)
        assert maximise(X, y, shape).log_marginal_likelihood > theirs.log_marginal_likelihood_value_ - 1e-3


@ALL_SHAPES
def test_gpytorch_agrees(shape):
    torch, gpytorch = pytest.importorskip("torch"), pytest.importorskip("gpytorch")
    X, y = problem()
    ours = kernel_of(shape)

    class Exact(gpytorch.models.ExactGP):
        def __init__(self, X, y, likelihood):
            super().__init__(X, y, likelihood)
            self.mean_module = gpytorch.means.ZeroMean()
            part = gpytorch.kernels.RBFKernel if shape == "squared-exponential" else gpytorch.kernels.MaternKernel
            self.covar_module = gpytorch.kernels.ScaleKernel(part(ard_num_dims=3))

        def forward(self, x):
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    likelihood = gpytorch.likelihoods.GaussianLikelihood().double()
    model = Exact(torch.tensor(X), torch.tensor(y), likelihood).double()
    likelihood.noise, model.covar_module.outputscale = 0.01, 1.7
    model.covar_module.base_kernel.lengthscale = torch.tensor(ours.lengthscale)
    exactly = gpytorch.settings.fast_computations(False, False, False)
    at = np.random.default_rng(1).normal(size=(30, 3))
    with exactly, torch.no_grad():
        likelihood_of_data = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
        value = float(likelihood_of_data(model(torch.tensor(X)), torch.tensor(y))) * len(y)
        model.eval()
        theirs = model(torch.tensor(at))
    gp = GaussianProcess.condition(ours, 0.01, X, y)
    np.testing.assert_allclose(gp.predict(at), (theirs.mean.numpy(), theirs.variance.numpy()), atol=1e-6)
    assert gp.log_marginal_likelihood() == pytest.approx(value, abs=1e-6)


# --- failures -----------------------------------------------------------------------------------------------------


def test_a_repeated_point_without_noise_is_named():
    with pytest.raises(NumericalError, match="two inputs coincide"):
        GaussianProcess.condition(Kernel("squared-exponential", 1.0, [1.0]), 0.0, [[0.0], [1.0], [1.0]], [0, 1, 1])
    gp = GaussianProcess.condition(Kernel("squared-exponential", 1.0, [1.0]), 0.0, [[0.0], [1.0]], [0.0, 1.0])
    with pytest.raises(NumericalError, match="coincides"):
        gp.add(np.array([1.0]), 1.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(bad):
    X, y = problem(n=10)
    X[3, 1] = bad
    for call in (lambda: maximise(X, y), lambda: GaussianProcess.condition(kernel_of("matern-5/2"), 0.1, X, y)):
        with pytest.raises(NumericalError, match="not finite"):
            call()


def test_outputs_that_do_not_vary_are_refused():
    X, _ = problem(n=10)
    with pytest.raises(NumericalError, match="all outputs are zero"):
        maximise(X, np.zeros(10))


def test_a_misspelt_kernel_is_guessed():
    with pytest.raises(UsageError, match="did you mean 'matern-5/2'"):
        Kernel("matern-52", 1.0, [1.0])


@given(st.integers(0, 2**31), st.integers(2, 30), st.integers(1, 5))
def test_no_data_break_the_fit(seed, n, d):
    """Constant inputs, repeated points, wild scales: an optimum or a clear reason, never a crash."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, d)) * 10 ** rng.uniform(-8, 8, size=d)
    X[:, rng.random(d) < 0.3] = 1.0
    X[rng.random(n) < 0.3] = X[0]
    y = rng.normal(size=n) * 10 ** rng.uniform(-8, 8)
    fit = maximise(X, y)
    gp = GaussianProcess.condition(fit.kernel, fit.noise_variance, X, y)
    mean, variance = gp.predict(X)
    assert np.isfinite(mean).all()
    assert (variance >= 0).all()
