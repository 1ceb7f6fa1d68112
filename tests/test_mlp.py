"""The neural network: its arithmetic against PyTorch's own parts, its training, and what its error bars are worth."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from implicam.calibrators import MLP, MLPCalibration, load_calibration
from implicam.calibrators.mlp_network import HIDDEN, Network, draw_masks, layer_shapes
from implicam.calibrators.mlp_settings import DEFAULT_SETTINGS, MLPSettings
from implicam.calibrators.mlp_training import (
    Examples,
    _Batch,
    _Masks,
    gradients,
    initial_weights,
    train,
)
from implicam.dataset import Dataset, Observations
from implicam.errors import CalibrationFileError, FitError, MissingExtraError, UsageError
from implicam.progress import silent
from implicam.simulate import build_rig, random_positions, simulate

torch = pytest.importorskip("torch")


@cache
def known(n: int, seed: int = 7) -> Dataset:
    """`n` known points that all four cameras of 2R2W saw."""
    rig = build_rig("bar6", seed=seed, cameras="2R2W")
    data = simulate(rig, random_positions(rig, 2 * n, np.random.default_rng([seed, 1])), seed=seed)
    return data.select(np.flatnonzero(data.observations.seen.all(axis=1))[:n])


def others() -> Dataset:
    return known(400).select(np.arange(200, 400))


BRIEF = MLPSettings(max_epochs=60)
"""For what does not depend on how well it has learned."""


@cache
def fitted(n: int = 60, **options: Any) -> MLPCalibration:
    return MLP(**options).fit(known(400).select(np.arange(n)))


def layers_of(network: Network, dropout: float = 0.0) -> Any:
    """The same network out of PyTorch's own parts, in float64."""
    parts: list[Any] = []
    for weight, bias in zip(network.weights, network.biases, strict=True):
        linear = torch.nn.Linear(*weight.shape, dtype=torch.float64)
        linear.weight.data, linear.bias.data = torch.tensor(weight.T.copy()), torch.tensor(bias)
        parts += [linear, torch.nn.LeakyReLU(), torch.nn.Dropout(dropout)]
    return torch.nn.Sequential(*parts[:-2])


def torchs_passes(network: Network, X: np.ndarray, passes: int) -> np.ndarray:
    """(passes, n, 3) outputs with PyTorch's own dropout of 0.2, a mask of its own for every point and pass."""
    torch.manual_seed(0)
    with torch.no_grad():
        answers = layers_of(network, 0.2).train()(torch.tensor(np.tile(X, (passes, 1))))
    return answers.numpy().reshape(passes, len(X), 3)


def examples(n: int = 40, *, noise: float = 0.0, seed: int = 0, held_out: int = 8) -> Examples:
    """A smooth map, or (noise) none that could be learned."""
    rng = np.random.default_rng([seed, 99])
    X = rng.normal(size=(n, 4))
    Y = np.stack([np.sin(X[:, 0]), X[:, 1] * X[:, 2] / 2, X[:, 3]], axis=1)
    return Examples(X, Y * (1 - noise) + noise * rng.normal(size=Y.shape), np.arange(n) < held_out, seed)


def held_out_loss(run: Examples, network: Network) -> float:
    return float(np.mean((network.predict(run.X[run.held_out]) - run.Y[run.held_out]) ** 2))


def same_network(a: Network, b: Network, atol: float = 0.0) -> None:
    for one, other in zip((*a.weights, *a.biases), (*b.weights, *b.biases), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=atol)


# the network


@pytest.mark.slow
def test_its_layers_are_the_papers() -> None:
    assert layer_shapes(12) == [(12, 128), (128, 128), (128, 64), (64, 3)]
    assert [w.shape for w in fitted().network.weights] == [(8, 128), (128, 128), (128, 64), (64, 3)]
    assert MLP().dropout == 0.2


def test_numpy_predicts_what_torch_predicts() -> None:
    network = fitted().network
    X = np.random.default_rng(1).normal(size=(50, 8)) * 3
    theirs = layers_of(network, 0.2).eval()(torch.tensor(X)).detach().numpy()
    np.testing.assert_allclose(network.predict(X), theirs, rtol=0, atol=1e-12)


def test_the_position_is_the_network_between_its_scalings() -> None:
    calibration, new = fitted(), others()
    X = calibration.pixels.apply(new.observations.uv.reshape(len(new), -1))
    expected = layers_of(calibration.network).eval()(torch.tensor(X)).detach().numpy()
    expected = expected * calibration.positions.scale + calibration.positions.offset
    np.testing.assert_allclose(calibration.measure(new.observations).xyz, expected, rtol=0, atol=1e-9)


def test_it_starts_where_torchs_layers_start() -> None:
    """Uniform within 1 / sqrt(fan in): the largest of many draws is just inside, the variance a third of its square."""
    torch.manual_seed(0)
    arrays = initial_weights(12, np.random.default_rng(0))
    for weight, bias in zip(arrays[::2], arrays[1::2], strict=True):
        theirs = torch.nn.Linear(*weight.shape).weight.detach().numpy()
        bound = weight.shape[0] ** -0.5
        assert 0.95 * bound < np.abs(weight).max() <= bound
        assert np.abs(theirs).max() <= bound * (1 + 1e-6)
        assert np.std(weight) == pytest.approx(np.std(theirs), rel=0.1)
        assert bias.shape == (1, weight.shape[1])
        assert 0 < np.abs(bias).max() <= bound


@pytest.mark.slow
def test_the_spread_is_that_of_a_case_with_a_formula() -> None:
    """Constant last hidden units h and a linear output: the covariance is p / (1 - p) (h W)^T (h W), exactly."""
    rng = np.random.default_rng(3)
    h, w = rng.uniform(0.5, 1.5, HIDDEN[-1]), rng.normal(size=(HIDDEN[-1], 3))
    weights = [np.zeros(shape) for shape in layer_shapes(4)[:-1]]
    network = Network((*weights, w), (np.zeros(128), np.zeros(128), h, np.zeros(3)))
    passes, dropout = 40_000, 0.3
    spread = network.spread(np.zeros((2, 4)), draw_masks(rng, passes, dropout))
    expected = dropout / (1 - dropout) * (h[:, None] * w).T @ (h[:, None] * w)
    sd = np.sqrt(np.diag(expected))
    off = (spread - expected) / np.multiply.outer(sd, sd)  # standard error of a variance: sqrt(2 / passes) = 0.7 %
    assert np.abs(off).max() < 5 * np.sqrt(2 / passes)
    np.testing.assert_array_equal(spread[0], spread[1])


def test_the_spread_is_the_sample_covariance_of_the_passes() -> None:
    """Each pass again as a network of its own, whose weights hold the mask."""
    network, X = fitted().network, np.random.default_rng(4).normal(size=(6, 8))
    masks = draw_masks(np.random.default_rng(5), 7, 0.4)
    passes = []
    for mask in masks:
        above = [w * m[:, None] for w, m in zip(network.weights[1:], np.split(mask, [128, 256]), strict=True)]
        passes.append(Network((network.weights[0], *above), network.biases).predict(X))
    expected = [np.cov(np.stack(passes)[:, i].T) for i in range(len(X))]
    np.testing.assert_allclose(network.spread(X, masks), expected, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_the_spread_is_that_of_torchs_dropout() -> None:
    """Another judge: PyTorch's own layers in training mode, 4000 passes; each variance has a standard error of 2 %."""
    network, passes = fitted().network, 4000
    X = np.random.default_rng(2).normal(size=(20, 8))
    ours = network.spread(X, draw_masks(np.random.default_rng(0), passes, 0.2))
    theirs = torchs_passes(network, X, passes)
    variances = theirs.var(axis=0, ddof=1)
    ratio = np.diagonal(ours, axis1=1, axis2=2) / variances
    assert np.abs(ratio - 1).max() < 5 * np.sqrt(2 * 2 / passes) * 1.5  # 60 of them, tails a little heavier than normal
    np.testing.assert_allclose(np.mean(ratio), 1, atol=0.03)


def test_masks_switch_off_the_share_and_keep_the_mean() -> None:
    masks = draw_masks(np.random.default_rng(0), 1000, 0.2)
    assert masks.shape == (1000, 320)
    np.testing.assert_allclose(np.unique(masks), [0, 1.25])
    assert np.mean(masks == 0) == pytest.approx(0.2, abs=5 * 0.4 / np.sqrt(masks.size))


# the training


def test_its_gradients_are_those_of_the_chain_rule() -> None:
    """In float64, with masks and without: NumPy, one network at a time, so that none gets another's slope."""
    rng = np.random.default_rng(0)
    starts = [initial_weights(4, rng) for _ in range(3)]
    parameters = [torch.tensor(np.stack(arrays)).requires_grad_() for arrays in zip(*starts, strict=True)]
    X, Y = rng.normal(size=(3, 7, 4)), rng.normal(size=(3, 7, 3))
    masks = [(rng.random((3, 7, width)) >= 0.3) / 0.7 for width in HIDDEN]
    for given in (masks, [np.ones_like(mask) for mask in masks]):
        tensors = [torch.tensor(mask) for mask in given] if given is masks else ()
        found = gradients(torch, parameters, torch.tensor(X), torch.tensor(Y), tensors)
        for i in range(3):
            weights, biases = starts[i][::2], starts[i][1::2]
            inputs, factors = [X[i]], []
            for weight, bias, mask in zip(weights, biases, given, strict=False):
                sums = inputs[-1] @ weight + bias
                factors.append(np.where(sums > 0, 1, DEFAULT_SETTINGS.leaky_relu_slope_ratio) * mask[i])
                inputs.append(sums * factors[-1])
            slope = 2 / 21 * (inputs[-1] @ weights[-1] + biases[-1] - Y[i])
            for layer in reversed(range(len(weights))):
                np.testing.assert_allclose(found[2 * layer][i], inputs[layer].T @ slope, rtol=0, atol=1e-14)
                np.testing.assert_allclose(found[2 * layer + 1][i, 0], slope.sum(axis=0), rtol=0, atol=1e-14)
                slope = slope @ weights[layer].T * (factors[layer - 1] if layer else 1)


def test_a_network_that_stays_is_not_disturbed_by_others_that_leave() -> None:
    """Given the same gradients, bit by bit: the weights, Adam's means and its count of steps, in any company."""
    rng = np.random.default_rng(0)
    batch = _Batch(torch, [examples(seed=seed) for seed in range(5)], 0.2)
    alone = [_Batch(torch, [examples(seed=seed)], 0.2) for seed in range(5)]
    for step in range(60):
        if step in (20, 40):
            batch._keep(batch.running != step / 20)
        for i, one in enumerate(alone):
            one.weights.grad[:] = torch.tensor(rng.normal(size=one.weights.shape))
            batch.weights.grad[batch.running == i] = one.weights.grad
            one.optimiser.step()
        batch.optimiser.step()
    assert list(batch.running) == [0, 3, 4]
    ours = batch.optimiser.state[batch.weights]
    for row, i in enumerate(batch.running):
        theirs = alone[i].optimiser.state[alone[i].weights]
        np.testing.assert_array_equal(batch.weights[row], alone[i].weights[0])
        assert ours["step"] == theirs["step"] == 60
        for name in ("exp_avg", "exp_avg_sq"):
            np.testing.assert_array_equal(ours[name][row], theirs[name][0])


def test_training_is_the_usual_loop_of_torch() -> None:
    """Without dropout, a loop written down here again with PyTorch's layers and Adam: float64 against our float32."""
    run = examples()
    (ours,) = train([run], 0.0, silent, MLPSettings(max_epochs=40))
    arrays = initial_weights(4, np.random.default_rng([run.seed, 1]))
    model = layers_of(Network(tuple(arrays[::2]), tuple(b[0] for b in arrays[1::2])))
    optimiser = torch.optim.Adam(model.parameters())
    X, Y = torch.tensor(run.X), torch.tensor(run.Y)
    fit, check = torch.tensor(~run.held_out), torch.tensor(run.held_out)
    losses = []
    for _ in range(40):
        optimiser.zero_grad()
        torch.nn.functional.mse_loss(model(X[fit]), Y[fit]).backward()
        optimiser.step()
        with torch.no_grad():
            losses.append(torch.nn.functional.mse_loss(model(X[check]), Y[check]).item())
    every = DEFAULT_SETTINGS.check_every_epochs
    assert ours.epoch == every * (1 + int(np.argmin(losses[every - 1 :: every])))
    assert ours.loss == pytest.approx(losses[ours.epoch - 1], rel=1e-3)


def drawn(masks: _Masks) -> np.ndarray:
    return np.concatenate([layer.numpy() for layer in masks.draw()], axis=2)


def test_training_drops_the_share_afresh_in_each_step() -> None:
    masks = _Batch(torch, [examples(seed=0), examples(seed=1)], 0.2).masks
    first, again = drawn(masks), drawn(masks)
    assert first.shape == (2, 32, sum(HIDDEN))
    assert (first != again).any()
    assert (first[0] != first[1]).any()
    np.testing.assert_allclose(np.unique(first), [0, 1.25], rtol=1e-6)
    share = np.mean([first == 0, again == 0])
    assert share == pytest.approx(0.2, abs=5 * 0.4 / np.sqrt(2 * first.size))
    assert _Batch(torch, [examples()], 0.0).masks.draw() == ()


@pytest.mark.parametrize("dropout", [0.01, 0.2, 0.5, 0.9])
def test_masks_are_independent_with_the_stated_probability(dropout: float) -> None:
    """4 million draws, five standard errors: the share of each layer, and pairs of units, points and steps."""
    masks = _Masks(torch, [np.random.SFC64(s) for s in (3, 4)], 3000, dropout)
    off = np.stack([drawn(masks) == 0 for _ in range(2)]) - dropout  # (step, network, point, unit)
    sd = dropout * (1 - dropout)
    for layer in np.split(off, np.cumsum(HIDDEN)[:-1], axis=3):
        assert abs(layer.mean()) < 5 * np.sqrt(sd / layer.size)
    pairs = [(off[..., :-k], off[..., k:]) for k in (1, 2, 3, 4, 8)]
    pairs += [(off[:, :, :-1], off[:, :, 1:]), (off[:, :1], off[:, 1:]), (off[:1], off[1:])]
    for a, b in pairs:
        assert abs(np.mean(a * b)) < 5 * sd / np.sqrt(a.size)


def test_masks_are_numpys_own_draws_of_16_bits() -> None:
    rng = np.random.Generator(np.random.SFC64(5))
    masks = _Masks(torch, [np.random.SFC64(5)], 7, 0.2)
    for _ in range(3):
        expected = rng.integers(0, 1 << 16, (7, sum(HIDDEN)), dtype=np.uint16) >= 0.2 * (1 << 16)
        np.testing.assert_array_equal(drawn(masks)[0] > 0, expected)


def test_masks_do_not_depend_on_the_company() -> None:
    together = _Batch(torch, [examples(seed=seed) for seed in range(3)], 0.2)
    alone = _Batch(torch, [examples(seed=2)], 0.2)
    np.testing.assert_array_equal(drawn(together.masks)[2], drawn(alone.masks)[0])
    together._step()  # Adam has no state to take along before the first step
    alone._step()
    together._keep(np.array([False, True, True]))
    np.testing.assert_array_equal(drawn(together.masks)[1], drawn(alone.masks)[0])


def test_it_stops_early_and_restores_the_best_weights() -> None:
    run = examples(noise=0.8)
    looked: list[int] = []
    (best,) = train(
        [run], 0.0, lambda what, done, of: looked.append(done), MLPSettings(max_epochs=2000, patience_epochs=100)
    )
    assert looked[-2] == best.epoch + 100 < 2000  # then it gave up, and all is done
    assert looked[-1] == 2000
    assert best.loss == pytest.approx(held_out_loss(run, best.network), rel=1e-5)
    same_network(train([run], 0.0, silent, MLPSettings(max_epochs=best.epoch))[0].network, best.network)
    patient = train([run], 0.0, silent, MLPSettings(max_epochs=best.epoch + 100, patience_epochs=2000))[0]
    same_network(patient.network, best.network)  # nothing better came in the epochs it waited


def test_no_weight_is_fitted_to_the_points_kept_for_early_stopping() -> None:
    run = examples()
    other = run._replace(Y=np.where(run.held_out[:, None], 50.0, run.Y), X=np.where(run.held_out[:, None], -1.0, run.X))
    (a,), (b,) = (
        train([r], 0.2, silent, MLPSettings(max_epochs=DEFAULT_SETTINGS.check_every_epochs)) for r in (run, other)
    )
    same_network(a.network, b.network)
    assert b.loss > 100 * a.loss


@pytest.mark.slow
def test_it_learns_a_map_and_not_noise() -> None:
    (learned,), (guessed,) = (
        train([examples(200, noise=noise)], 0.0, silent, MLPSettings(max_epochs=600)) for noise in (0.0, 1.0)
    )
    assert learned.loss < 0.05
    assert guessed.loss > 0.5


def test_networks_do_not_depend_on_their_company() -> None:
    """Other sizes, others that stop sooner, another place in the batch."""
    runs = [examples(noise=0.3, seed=0), examples(60, seed=1), examples(noise=1.0, seed=2), examples(seed=3)]
    together = train(runs, 0.2, silent, MLPSettings(max_epochs=300, patience_epochs=100))
    assert len({found.epoch for found in together}) > 1
    for run, found in zip(runs, together, strict=True):
        (alone,) = train([run], 0.2, silent, MLPSettings(max_epochs=300, patience_epochs=100))
        assert alone.epoch == found.epoch
        same_network(alone.network, found.network, atol=1e-5)


def test_the_seed_is_all_that_chance_depends_on() -> None:
    (a,), (b,), (other,) = (
        train([run], 0.2, silent, MLPSettings(max_epochs=50))
        for run in (examples(), examples(), examples()._replace(seed=1))
    )
    same_network(a.network, b.network)
    assert not np.allclose(a.network.weights[0], other.network.weights[0])


def test_training_leaves_the_threads_of_torch_alone() -> None:
    before = torch.get_num_threads()
    during: list[int] = []
    train([examples()], 0.2, lambda *_: during.append(torch.get_num_threads()), MLPSettings(max_epochs=10))
    assert set(during) <= {1, before}
    assert during[0] == 1
    assert torch.get_num_threads() == before

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train([examples()], 0.2, interrupt, MLPSettings(max_epochs=10))
    assert torch.get_num_threads() == before


# the calibration


def test_a_batch_of_datasets_is_the_single_fits_with_counted_seeds() -> None:
    data = known(400)
    sets = [data.select(np.arange(*rows)) for rows in ((30,), (3,), (20, 60))]
    found = MLP(seed=5, settings=BRIEF).fit_many(sets)
    assert isinstance(found[1], FitError)
    assert "3 usable known points" in str(found[1])
    for i in (0, 2):
        one, alone = found[i], MLP(seed=5 + i, settings=BRIEF).fit(sets[i])
        assert isinstance(one, MLPCalibration)
        assert one.calibrator == alone.calibrator == MLP(seed=5 + i, settings=BRIEF)
        assert one.data is sets[i]
        a, b = one.measure(others().observations), alone.measure(others().observations)
        np.testing.assert_allclose(a.xyz, b.xyz, rtol=0, atol=1e-3)
        np.testing.assert_allclose(a.sd, b.sd, rtol=1e-4)
    assert MLP().fit_many([]) == []


@pytest.mark.slow
def test_it_learns_what_a_linear_map_cannot() -> None:
    """Positions by least squares from pixels: what a network without its bends could do, on wide lenses.

    Dropout of 0.2 costs the paper's network that advantage: it stays 7 mm off, and the linear map is 6 mm off.
    """
    train_on, new = known(400).select(np.arange(157)), others()
    pixels = [np.column_stack([np.ones(len(d)), d.observations.uv.reshape(len(d), -1)]) for d in (train_on, new)]
    linear = pixels[1] @ np.linalg.lstsq(pixels[0], train_on.xyz, rcond=None)[0]

    def rms(xyz: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.sum((xyz - new.xyz) ** 2, axis=1))))

    with_dropout, without = (rms(fitted(157, dropout=p).measure(new.observations).xyz) for p in (0.2, 0.0))
    assert without < rms(linear) / 1.8
    assert without < with_dropout / 1.8
    size = float(np.sqrt(np.mean(np.sum((new.xyz - new.xyz.mean(axis=0)) ** 2, axis=1))))
    assert with_dropout < size / 10


def of_kept(calibration: MLPCalibration) -> tuple[np.ndarray, np.ndarray]:
    """Errors and stated sds of the points kept for early stopping, by measuring them like any others."""
    kept = calibration.data.select(calibration.held_out)
    measured = calibration.measure(kept.observations)
    return measured.xyz - kept.xyz, measured.sd


@pytest.mark.slow
@pytest.mark.parametrize("n", [5, 60, 157])
def test_the_coverage_it_states_is_what_it_says(n: int) -> None:
    calibration = fitted(n)
    errors, sds = of_kept(calibration)
    assert len(errors) == max(1, round(0.15 * n))
    inside = np.mean(np.abs(errors / sds) < 1.959964)
    residuals = calibration.residuals
    assert residuals["held_out_in_95"] == pytest.approx(inside)
    assert residuals["held_out_points"] == len(errors)
    np.testing.assert_allclose(list(residuals["leave_one_out_rms"].values()), np.sqrt(np.mean(errors**2, axis=0)))
    np.testing.assert_allclose(list(residuals["leave_one_out_mean_sd"].values()), sds.mean(axis=0))
    note = calibration.notes[0]
    assert "dropout spread, not a measurement uncertainty" in note
    assert f"{100 * inside:.0f} % lie inside their 95 % bars" in note
    assert (f"the {len(errors)} known points" if len(errors) > 1 else "the one known point") in note


def test_its_covariance_is_the_spread_in_the_datasets_unit() -> None:
    calibration, new = fitted(), others().observations.select(np.arange(5))
    measured = calibration.measure(new)
    X = calibration.pixels.apply(new.uv.reshape(5, -1))
    passes = torchs_passes(calibration.network, X, 4000) * calibration.positions.scale
    for i in range(5):
        theirs = np.cov(passes[:, i].T)
        sd = np.sqrt(np.diag(theirs))
        # 200 passes know a covariance to 1 / sqrt(200) = 7 % (10 % on the diagonal) of the product of the two sds
        assert np.abs((measured.cov[i] - theirs) / np.multiply.outer(sd, sd)).max() < 0.4
    assert np.abs(measured.cov[:, 0, 1]).min() > 0  # a full covariance


@pytest.mark.slow
def test_without_dropout_the_bars_are_the_errors_of_the_points_kept() -> None:
    calibration = fitted(157, dropout=0.0)
    errors, sds = of_kept(calibration)
    np.testing.assert_allclose(sds, np.broadcast_to(np.sqrt(np.mean(errors**2, axis=0)), sds.shape))
    assert "are the rms errors of the 24 known points kept" in calibration.notes[0]


@pytest.mark.parametrize("dropout", [-0.1, 0.91, 1.0, np.nan, np.inf])
def test_dropout_is_a_probability(dropout: float) -> None:
    with pytest.raises(UsageError, match=r"between 0 and 0\.9"):
        MLP(dropout=dropout)


def test_much_dropout_still_has_error_bars() -> None:
    much = replace(fitted(), calibrator=MLP(dropout=0.9))
    assert np.linalg.eigvalsh(much.measure(others().observations).cov).min() > 0


def test_the_scaling_knows_only_the_points_the_weights_are_fitted_to() -> None:
    calibration = fitted()
    fit_to = calibration.data.select(~calibration.held_out)
    np.testing.assert_allclose(calibration.positions.offset, fit_to.xyz.mean(axis=0))
    np.testing.assert_allclose(calibration.positions.scale, fit_to.xyz.std(axis=0))
    np.testing.assert_allclose(calibration.pixels.scale, fit_to.observations.uv.reshape(len(fit_to), -1).std(axis=0))


# files


def test_torch_is_needed_to_train_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calibration, new = fitted(), others()
    expected = calibration.measure(new.observations)
    calibration.save(tmp_path / "rig.implicam")
    monkeypatch.setitem(sys.modules, "torch", None)
    loaded = load_calibration(tmp_path / "rig.implicam")
    measured = loaded.measure(new.observations)
    np.testing.assert_array_equal(measured.xyz, expected.xyz)
    np.testing.assert_array_equal(measured.cov, expected.cov)
    with pytest.raises(MissingExtraError, match="needs the library 'torch'") as caught:
        loaded.refit(known(400).select(np.arange(30)))
    assert 'pip install "implicam[mlp]"' in caught.value.fix


def test_points_that_cannot_be_used_are_left_out_and_none_is_kept_for_stopping(tmp_path: Path) -> None:
    data = known(400).select(np.arange(40))
    o = data.observations
    uv = o.uv.copy()
    uv[[3, 17, 31], [0, 1, 3]] = np.nan
    holes = replace(data, observations=Observations(o.points, o.cameras, uv, o.sd))
    calibration = MLP(settings=BRIEF).fit(holes)
    assert [u.point for u in calibration.unused] == [str(data.points[i]) for i in (3, 17, 31)]
    assert calibration.unused[0].reason == "mlp needs every camera; not seen by cam2"
    assert len(calibration.held_out) == 37
    complete = data.select(np.setdiff1d(np.arange(40), [3, 17, 31]))
    expected = MLP(settings=BRIEF).fit(complete)
    np.testing.assert_array_equal(calibration.measure(o).xyz, expected.measure(o).xyz)
    calibration.save(tmp_path / "rig.implicam")
    assert load_calibration(tmp_path / "rig.implicam").residuals == calibration.residuals


def spoiled(name: str, change: Callable[[np.ndarray], np.ndarray]) -> tuple[Dataset, dict[str, Any], dict[str, Any]]:
    table, arrays = fitted().state()
    return fitted().data, table, arrays | {name: change(arrays[name])}


HOSTILE: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "a weight is NaN": ("weight1", lambda a: np.where(np.arange(a.size).reshape(a.shape) == 5, np.nan, a)),
    "a weight is infinite": ("weight3", lambda a: a + np.inf),
    "a layer is of another shape": ("weight1", lambda a: a[:64]),
    "a layer is transposed": ("weight2", lambda a: a.T.copy()),
    "weights are float32": ("weight0", lambda a: a.astype(np.float32)),
    "weights are text": ("weight0", lambda a: a.astype(str)),
    "a bias is short": ("bias3", lambda a: a[:2]),
    "a scale is zero": ("pixel_scale", lambda a: a * 0),
    "a scale is negative": ("position_scale", lambda a: -a),
    "no point is kept": ("held_out", lambda a: a & False),
    "all points are kept": ("held_out", lambda a: a | True),
    "kept are numbers": ("held_out", lambda a: np.flatnonzero(a)),
    "kept are too few": ("held_out", lambda a: a[:-1]),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_hostile_arrays_are_refused(what: str) -> None:
    with pytest.raises((ValueError, TypeError)):
        MLPCalibration.from_state(*spoiled(*HOSTILE[what]))


def test_a_missing_array_or_option_is_refused() -> None:
    data, (table, arrays) = fitted().data, fitted().state()
    for name in arrays:
        with pytest.raises(KeyError):
            MLPCalibration.from_state(data, table, {key: a for key, a in arrays.items() if key != name})
    for name in set(table) - {"settings"}:  # files from before there were settings have none
        with pytest.raises(KeyError):
            MLPCalibration.from_state(data, {key: v for key, v in table.items() if key != name}, arrays)
    with pytest.raises(UsageError):
        MLPCalibration.from_state(data, table | {"dropout": 1.5}, arrays)


def test_a_hostile_file_is_an_error_of_the_file(tmp_path: Path) -> None:
    network = fitted().network
    weights = (network.weights[0] * np.nan, *network.weights[1:])
    wrong = replace(fitted(), network=Network(weights, network.biases))
    with np.errstate(invalid="ignore"):
        wrong.save(tmp_path / "rig.implicam")
    with pytest.raises(CalibrationFileError) as caught:
        load_calibration(tmp_path / "rig.implicam")
    assert "weight0 must be finite" in caught.value.why
