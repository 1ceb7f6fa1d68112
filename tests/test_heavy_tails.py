"""Pixel noise with heavy tails: told from normal noise and from known positions that are off; honest error bars."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate
from scipy.stats import chi2, kstest

from implicam.calibrators import ForwardGP, load_calibration
from implicam.calibrators.forward_gp import heavy_tail_fit
from implicam.calibrators.forward_gp.calibration import ForwardGPCalibration
from implicam.dataset import Dataset, KnownPositions, Observations
from implicam.measurement import Measurement
from implicam.rig_model.heavy_tails import (
    _solve_stack,
    consistency,
    degrees_of_agreement,
    equivalent_normal_noise,
    information_loss,
    looks_heavy,
    outlier_distance,
    refine_positions,
    student_t_weights,
)
from implicam.rig_model.settings import DEFAULT_SETTINGS
from implicam.rig_model.wrong_views import LinearisedViews
from implicam.simulate import build_rig, random_positions, simulate

SCALE = 0.2


def with_noise(data: Dataset, seed: int, degrees: float = 3.0) -> Dataset:
    """The same with t noise of both pixel coordinates, each by itself."""
    o = data.observations
    true = np.stack([np.where(o.extra[c] == "", "nan", o.extra[c]).astype(float) for c in ("true_u", "true_v")], axis=2)
    noise = SCALE * np.random.default_rng([seed, 99]).standard_t(degrees, size=true.shape)
    return replace(data, observations=Observations(o.points, o.cameras, true + noise, o.sd))


@cache
def known(spec: str, n: int, seed: int = 0) -> Dataset:
    rig = build_rig(spec, seed=seed)
    return simulate(rig, random_positions(rig, n, np.random.default_rng([seed, 1])), seed=seed)


@cache
def others(spec: str, seed: int = 0) -> Dataset:
    rig = build_rig(spec, seed=seed)
    return simulate(rig, random_positions(rig, 300, np.random.default_rng([seed, 2])), seed=seed + 1)


@cache
def heavy(spec: str, n: int, seed: int = 0) -> ForwardGPCalibration:
    return ForwardGP().fit(with_noise(known(spec, n, seed), seed))


def normal_fit(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> ForwardGPCalibration:
    """As if noise were always normal."""
    with monkeypatch.context() as patch:
        patch.setattr(heavy_tail_fit, "looks_heavy", lambda *_: False)
        return ForwardGP().fit(data)


def judged(measured: Measurement, data: Dataset) -> tuple[float, np.ndarray]:
    """Mean squared error, and squared distances in the error bars."""
    assert data.truth is not None
    ok = measured.measured
    error = (measured.xyz - data.truth.xyz)[ok]
    distance = np.einsum("ni,nij,nj->n", error, np.linalg.inv(measured.cov[ok]), error)
    return float(np.mean(np.sum(error**2, axis=1))), distance


# the pieces


def test_the_wrong_are_as_rare_as_with_normal_noise() -> None:
    draw = np.random.default_rng(0)
    for degrees in (2.5, 4.0, 15.0):
        r = draw.normal(size=(400_000, 2)) / np.sqrt(draw.chisquare(degrees, 400_000) / degrees)[:, None]
        limit = outlier_distance(degrees, 9.0)
        assert np.mean(np.sum(r**2, axis=1) > limit) == pytest.approx(np.exp(-4.5), rel=0.05)
    assert outlier_distance(1e9, 25.0) == pytest.approx(25.0, rel=1e-6)


def test_weights_and_information_end_at_normal_noise() -> None:
    np.testing.assert_allclose(student_t_weights(np.array([0.0, 9.0]), 1e9), 1, rtol=1e-7)
    assert student_t_weights(np.array([300.0]), 3.0)[0] < 0.02
    assert information_loss(None) == 1
    assert information_loss(1e9) == pytest.approx(1)
    # Fisher information of a location, by simulation: the square of the score
    draw = np.random.default_rng(1)
    r = draw.normal(size=(200_000, 2)) / np.sqrt(draw.chisquare(4, 200_000) / 4)[:, None]
    score = student_t_weights(np.sum(r**2, axis=1), 4.0) * r[:, 0]
    assert 1 / np.mean(score**2) == pytest.approx(information_loss(4.0), rel=0.02)


def linear_views(n: int, C: int, degrees: float, seed: int) -> LinearisedViews:
    """About the true position, scale one."""
    draw = np.random.default_rng(seed)
    r = draw.normal(size=(n, C, 2))
    if np.isfinite(degrees):
        r /= np.sqrt(draw.chisquare(degrees, (n, C)) / degrees)[..., None]
    D = draw.normal(size=(n, C, 2, 3))
    return LinearisedViews(r, D, np.broadcast_to(np.eye(2), (n, C, 2, 2)).copy(), None)


@pytest.mark.slow
@pytest.mark.parametrize("C", [2, 3, 6])
def test_error_bars_are_those_of_the_t(C: int) -> None:
    views = linear_views(3000, C, 3.0, C)
    found = refine_positions(views, 3.0, DEFAULT_SETTINGS)
    ok = np.isfinite(found.step).all(axis=1)
    assert ok.mean() > 0.99
    distance = np.einsum("ni,nij,nj->n", found.step[ok], np.linalg.inv(found.cov[ok]), found.step[ok])
    assert 2.7 < np.mean(distance) < 3.4  # the covariance is right; the ellipsoid of something with tails holds less
    assert 0.91 < np.mean(distance < chi2.ppf(0.95, 3)) < 0.96
    p = consistency(found.distance, np.ones((3000, C), dtype=bool), 3.0)
    assert np.mean(p < 1e-4) < 0.004
    if C > 2:
        assert kstest(p, "uniform").statistic < 0.12
        normal = refine_positions(views, 1e6, DEFAULT_SETTINGS)
        assert np.mean(np.sum(found.step[ok] ** 2, axis=1)) < 0.9 * np.mean(np.sum(normal.step[ok] ** 2, axis=1))


def test_two_places_are_none() -> None:
    """Three views, one of them far off, and nothing says which."""
    draw = np.random.default_rng(0)
    D = np.broadcast_to(draw.normal(size=(1, 3, 2, 3)), (1, 3, 2, 3)).copy()
    r = np.zeros((1, 3, 2))
    left = np.linalg.svd(D[0].reshape(6, 3))[0][:, 3:]  # what no position explains
    r[0] = (left @ [60.0, 0.0, 0.0]).reshape(3, 2)
    each = np.broadcast_to(np.eye(2), (1, 3, 2, 2)).copy()
    found = refine_positions(LinearisedViews(r, D, each, None), 3.0, DEFAULT_SETTINGS)
    assert np.isnan(found.step).all()
    assert np.isfinite(refine_positions(LinearisedViews(0 * r, D, each, None), 3.0, DEFAULT_SETTINGS).step).all()


def test_the_posterior_of_a_position_is_integrated_rightly() -> None:
    """Against a fine grid, for three views of a point."""
    views = linear_views(4, 3, 3.0, 8)
    found = refine_positions(views, 3.0, DEFAULT_SETTINGS)
    for i in range(4):
        half = 12 * np.sqrt(np.diagonal(found.cov[i]))
        axes = [np.linspace(m - h, m + h, 81) for m, h in zip(found.step[i], half, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        left = views.r[i] - np.einsum("cij,xyzj->xyzci", views.D[i], grid)
        density = np.prod((1 + np.sum(left**2, axis=-1) / 3) ** -2.5, axis=-1)

        def mean(values: np.ndarray, density: np.ndarray = density, axes: list[np.ndarray] = axes) -> float:
            total = values * density
            for axis in reversed(axes):
                total = integrate.simpson(total, x=axis)
            return float(total)

        mass = mean(np.ones_like(density))
        at = np.array([mean(grid[..., k]) for k in range(3)]) / mass
        sd = np.sqrt([mean((grid[..., k] - at[k]) ** 2) / mass for k in range(3)])
        assert np.abs((found.step[i] - at) / sd).max() < 0.15
        np.testing.assert_allclose(np.sqrt(np.diagonal(found.cov[i])), sd, rtol=0.15)


def test_nearly_normal_noise_is_measured_as_normal_noise() -> None:
    views = linear_views(20, 4, np.inf, 3)
    found = refine_positions(views, 1e6, DEFAULT_SETTINGS)
    D, r = views.D.reshape(20, 8, 3), views.r.reshape(20, 8)
    cov = np.linalg.inv(D.swapaxes(1, 2) @ D)
    step = np.einsum("nij,nj->ni", cov, np.einsum("nki,nk->ni", D, r))
    sd = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    assert (np.abs(found.step - step) / sd).max() < 0.06
    np.testing.assert_allclose(found.cov, cov, rtol=0.1, atol=0.1 * sd.min() ** 2)


def test_two_views_are_taken_as_they_are() -> None:
    noise = equivalent_normal_noise(
        np.ones((2, 3)), np.full((2, 3), 50.0), np.array([[1, 1, 0], [1, 1, 1]], dtype=bool), 4.0
    )
    np.testing.assert_allclose(noise[0], np.sqrt(2))
    assert (noise[1] > 2).all()


@pytest.mark.slow
def test_degrees_are_found_from_agreement_alone() -> None:
    for degrees, low, high in ((3.0, 2.2, 5.0), (6.0, 3.5, 20.0)):
        views = linear_views(150, 5, degrees, 4)
        found = degrees_of_agreement(views.D, views.r, np.ones((150, 5), dtype=bool), DEFAULT_SETTINGS)
        assert found is not None
        assert low <= found <= high
    for seed in range(3):
        views = linear_views(150, 5, np.inf, seed)
        assert degrees_of_agreement(views.D, views.r, np.ones((150, 5), dtype=bool), DEFAULT_SETTINGS) is None


def test_wrong_detections_anywhere_are_no_tails() -> None:
    draw = np.random.default_rng(2)
    q = draw.chisquare(2, 1000)
    q[:150] = draw.uniform(0, 1000, (150, 2)).max(axis=1) ** 2 / 0.04
    background = np.full(1000, 2 * np.pi * 0.04 / 1280**2)
    assert not looks_heavy(q, background, DEFAULT_SETTINGS)
    heavy_ones = 2 * draw.f(2, 3, 1000)
    assert looks_heavy(heavy_ones, background, DEFAULT_SETTINGS)
    assert not looks_heavy(heavy_ones[:20], background[:20], DEFAULT_SETTINGS)


# the whole method


@pytest.mark.slow
@pytest.mark.parametrize(("n", "specs", "better"), [(120, ("bar6", "dome8"), 0.94), (40, ("bar6", "dome8"), 0.95)])
def test_heavy_tails_are_found_and_measured_with(
    n: int, specs: tuple[str, ...], better: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few hundred points only: the numbers of ten rigs are printed by benchmarks/heavy_tails.py."""
    inside, errors = [], []
    for spec in specs:
        seed = 0
        calibration, data = heavy(spec, n, seed), with_noise(others(spec, seed), seed + 50)
        assert calibration.fitted.tails is not None
        assert 2 < calibration.fitted.tails.degrees <= 7
        assert len(calibration.rejected) <= 1
        measured = calibration.measure(data.observations)
        error, distance = judged(measured, data)
        before, _ = judged(
            normal_fit(with_noise(known(spec, n, seed), seed), monkeypatch).measure(data.observations), data
        )
        errors.append(np.sqrt(error / before))
        inside.append(distance < chi2.ppf(0.95, 3))
        assert np.mean(measured.reason != "") < 0.02
        assert np.mean(measured.consistency < 1e-3) < 0.01
        (note,) = (note for note in calibration.notes if "heavy tails" in note)
        assert "px" in note
    assert 0.915 < np.mean(np.concatenate(inside)) < 0.98
    assert np.mean(errors) < better


@pytest.mark.slow
@pytest.mark.parametrize("spec", ["stereo", "bar4"])
def test_normal_noise_is_left_alone(spec: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for n in (20, 120):
        data = known(spec, n)
        calibration, same = ForwardGP().fit(data), normal_fit(data, monkeypatch)
        assert calibration.fitted.tails is None
        some = others(spec).observations.select(np.arange(20))
        np.testing.assert_array_equal(calibration.measure(some).xyz, same.measure(some).xyz)


@pytest.mark.slow
def test_known_positions_that_are_off_are_no_heavy_tails() -> None:
    """A few by half a millimetre, or all by a tenth, undeclared."""
    data = known("bar6", 60)
    draw = np.random.default_rng(0)
    for some, size in ((slice(0, 6), 0.5), (slice(None), 0.1)):
        xyz = data.xyz.copy()
        xyz[some] += size * draw.normal(size=xyz[some].shape)
        off = replace(data, known=KnownPositions(data.positions.shots, xyz, data.positions.sd))
        assert ForwardGP().fit(off).fitted.tails is None


@pytest.mark.slow
def test_a_gross_error_is_still_found() -> None:
    calibration, data = heavy("bar6", 120), with_noise(others("bar6"), 60)
    some = data.select(np.flatnonzero(data.observations.seen.all(axis=1))[:20])
    o = some.observations
    uv = o.uv.copy()
    uv[:, 2] += [90.0, 80.0]
    measured = calibration.measure(Observations(o.points, o.cameras, uv, o.sd))
    assert some.truth is not None
    assert np.mean([f"without {o.camera_names[2]}," in reason for reason in measured.reason]) > 0.8
    ok = measured.measured
    assert (np.abs(measured.xyz - some.truth.xyz)[ok] / measured.sd[ok]).max() < 5


@pytest.mark.slow
def test_two_views_are_no_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    """A calibration that knows of the tails, from six cameras, measures with two of them."""
    data = with_noise(others("bar6"), 70)
    pair = Observations(
        data.points,
        data.observations.cameras,
        np.where(np.array([0, 1, 1, 0, 0, 0], dtype=bool)[None, :, None], data.observations.uv, np.nan),
        data.observations.sd,
    )
    error, distance = judged(heavy("bar6", 120).measure(pair), data)
    before, _ = judged(normal_fit(with_noise(known("bar6", 120), 0), monkeypatch).measure(pair), data)
    assert np.sqrt(error / before) < 1.02
    assert 0.92 < np.mean(distance < chi2.ppf(0.95, 3)) < 0.98


@pytest.mark.slow
def test_tied_cameras_weigh_their_views_too(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = build_rig("bar4", seed=0)
    data = simulate(rig, random_positions(rig, 40, np.random.default_rng(3)), seed=5, robot_noise=0.1)
    calibration = ForwardGP().fit(with_noise(data, 5))
    assert calibration.posterior.joint is not None
    if calibration.fitted.tails is None:
        pytest.fail("t noise with three degrees of freedom was not seen")
    some = with_noise(others("bar4"), 51)
    error, distance = judged(calibration.measure(some.observations), some)
    before, plain = judged(normal_fit(with_noise(data, 5), monkeypatch).measure(some.observations), some)
    inside, inside_before = (np.mean(d < chi2.ppf(0.95, 3)) for d in (distance, plain))
    assert inside > inside_before - 0.02
    assert np.sqrt(error / before) < 1.02


@pytest.mark.slow
def test_it_is_saved(tmp_path: Path) -> None:
    calibration = heavy("bar6", 40)
    assert calibration.fitted.tails is not None
    path = tmp_path / "rig.implicam"
    calibration.save(path)
    again = load_calibration(path)
    assert isinstance(again, ForwardGPCalibration)
    assert again.fitted.tails is not None
    assert again.fitted.tails.degrees == calibration.fitted.tails.degrees
    assert again.notes == calibration.notes
    some = with_noise(others("bar6"), 1).observations.select(np.arange(30))
    np.testing.assert_array_equal(again.measure(some).xyz, calibration.measure(some).xyz)
    np.testing.assert_array_equal(again.measure(some).cov, calibration.measure(some).cov)


def test_a_state_with_half_of_the_tails_is_refused() -> None:
    calibration = heavy("bar6", 40)
    table, arrays = calibration.state()
    for change in ({"tails": np.array([1.5])}, {"0/tail_weights": np.ones(3)}):
        with pytest.raises(ValueError, match=r"tail|degrees"):
            ForwardGPCalibration.from_state(calibration.data, table, {**arrays, **change})
    plain = {name: value for name, value in arrays.items() if "tail" not in name}
    assert ForwardGPCalibration.from_state(calibration.data, table, plain).fitted.tails is None


def test_a_point_that_its_views_do_not_fix_costs_no_rig() -> None:
    """A stack with one singular matrix, as a tank gave it, is solved where it can be."""
    H = np.stack([np.eye(3), np.diag([1.0, 1.0, 0.0])])
    found = _solve_stack(H, np.ones((2, 3)))
    np.testing.assert_allclose(found[0], 1.0, rtol=1e-9)
    np.testing.assert_allclose(found[1, :2], 1.0, rtol=1e-9)
