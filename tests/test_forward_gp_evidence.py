"""The marginal likelihood of forward-gp, against one dense normal distribution and against differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from forward_gp_cases import LENGTHSCALE, numeric, se
from implicam.calibrators.forward_gp.evidence import CameraEvidence, RigEvidence
from implicam.calibrators.forward_gp.settings import DEFAULT_SETTINGS
from implicam.rig_model.camera import Prior


def camera_evidence(n: int = 40, p: int = 4, seed: int = 0, sizes: tuple[float, float] = (0.8, 0.2)) -> CameraEvidence:
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1, 1, (n, 3))
    X = rng.normal(size=(n, 2, p)) * 10.0 ** np.arange(p)
    root = rng.normal(size=(p, p)) / 10.0 ** np.arange(p)
    prior = Prior(np.zeros(p), np.linalg.inv(root.T @ root + np.diag(0.01 ** np.arange(p))))
    off, relative = rng.normal(size=p) / 10.0 ** np.arange(p), rng.uniform(0.5, 2, n)
    L = np.linalg.cholesky(se(q, q, LENGTHSCALE) + 1e-9 * np.eye(n))
    field = sizes[0] * L @ rng.normal(size=(n, 2))
    noise = sizes[1] * relative[:, None] * rng.normal(size=(n, 2))
    step = off + np.linalg.cholesky(np.linalg.inv(prior.precision)) @ rng.normal(size=p)
    return CameraEvidence(X @ step + field + noise, X, off, prior, q, relative)


def minus_log_density(given: CameraEvidence, signal: float, noise: float, lengthscale: np.ndarray) -> float:
    """Both coordinates of all points as one dense normal vector."""
    K = signal**2 * se(given.q, given.q, lengthscale) + noise**2 * np.diag(given.relative**2)
    X = given.X.swapaxes(0, 1).reshape(-1, given.X.shape[2])
    cov = np.kron(np.eye(2), K) + X @ np.linalg.solve(given.prior.precision, X.T)
    return -float(multivariate_normal.logpdf(given.residual.T.ravel(), X @ given.off, cov, allow_singular=True))


SIZES = [(0.8, 0.2), (0.3, 0.2), (2.0, 0.5), (0.05, 1.0), (1.0, 0.03)]


@pytest.mark.parametrize("seed", range(3))
def test_the_evidence_is_that_of_one_dense_normal_distribution(seed: int) -> None:
    given = camera_evidence(seed=seed)
    for lengthscale in (LENGTHSCALE, np.array([3.0, 0.4])):
        spectrum = given.spectrum(lengthscale, 1e-13)
        found = np.array([given.objective(spectrum, *sizes)[0] for sizes in SIZES])
        expected = np.array([minus_log_density(given, *sizes, lengthscale) for sizes in SIZES])
        assert np.ptp(expected) > 10
        np.testing.assert_allclose(found - found[0], expected - expected[0], atol=1e-3, rtol=1e-6)


def test_the_evidence_compares_lengthscales_too() -> None:
    given = camera_evidence()
    lengthscales = [LENGTHSCALE, np.array([0.3, 1.0]), np.array([3.0, 0.4]), np.array([10.0, 30.0])]
    found = np.array([given.objective(given.spectrum(scale, 1e-13), 0.8, 0.2)[0] for scale in lengthscales])
    expected = np.array([minus_log_density(given, 0.8, 0.2, scale) for scale in lengthscales])
    assert np.ptp(expected) > 10
    np.testing.assert_allclose(found - found[0], expected - expected[0], atol=1e-3)


@pytest.mark.parametrize("sizes", SIZES)
def test_the_evidence_knows_its_gradient(sizes: tuple[float, float]) -> None:
    given = camera_evidence(seed=5)
    spectrum = given.spectrum(LENGTHSCALE, 1e-6)
    expected = numeric(
        lambda d: np.array(given.objective(spectrum, *(np.array(sizes) * np.exp(d)).tolist())[0]), np.full(2, 1e-5)
    )
    np.testing.assert_allclose(given.objective(spectrum, *sizes)[1:], expected, rtol=1e-5, atol=1e-4)


def test_sizes_and_lengthscales_are_found_again() -> None:
    """Three cameras, sizes as in pixels of an image 1280 wide; a misprint of a factor of two would show."""
    true = (0.4, 0.2)
    cameras = [camera_evidence(150, seed=10 + c, sizes=true) for c in range(3)]
    half, stated = np.full(3, 640.0), np.full(3, np.nan)
    found = RigEvidence(cameras, half, stated, True, 1e-6, DEFAULT_SETTINGS).maximise()
    np.testing.assert_allclose(found.noise, true[1], rtol=0.15)
    np.testing.assert_allclose(found.signal, true[0], rtol=0.4)
    np.testing.assert_allclose(found.lengthscale, np.tile(LENGTHSCALE, (3, 1)), rtol=0.35)
    again = RigEvidence(cameras, half, stated, True, 1e-6, DEFAULT_SETTINGS).maximise(found)
    np.testing.assert_allclose(again.noise, found.noise, rtol=0.03)
    np.testing.assert_allclose(again.lengthscale, found.lengthscale, rtol=0.2)


def test_with_little_data_the_stated_noise_decides() -> None:
    few = [camera_evidence(9, seed=30 + c, sizes=(0.3, 0.2)) for c in range(2)]
    for stated in (0.1, 0.4):
        found = RigEvidence(few, np.full(2, 640.0), np.full(2, stated), True, 1e-6, DEFAULT_SETTINGS).maximise()
        assert np.abs(np.log(found.noise / stated)).max() < 0.5
