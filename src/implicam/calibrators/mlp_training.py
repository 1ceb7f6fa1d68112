"""Training the paper's network with PyTorch, many networks as one batch.

The paper says no more than the layers. The rest is what is usual: mean squared error of the standardised positions,
Adam with its defaults (learning rate 1e-3), PyTorch's initial weights and float32, all points in each step, early
stopping on points kept aside, the best weights restored. In trials on other simulated rigs than those we report on,
learning rates from 3e-4 to 1e-2, constant or falling as a cosine, weight decay of 0.01, batches of 32 points and 10 to
20 % of the points kept aside changed the error by a few percent or made it worse; initial weights after He doubled it.
The dropout of 0.2 costs most: without it the error is two to three times smaller where there are many points.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.mlp_network import HIDDEN, Network, layer_shapes
from implicam.calibrators.mlp_settings import DEFAULT_SETTINGS, MLPSettings
from implicam.dataset import Floats
from implicam.errors import import_extra
from implicam.progress import Progress

LAYERS = len(HIDDEN) + 1
ALIGNED_NUMBERS = 16
"""Numbers of a network are filled up to a multiple of this, the longest vector of a processor. Adam's fused step works
on vectors and rounds the rest at the end differently: a network would depend on its place in the batch."""
WEIGHTS, MASKS = 1, 2  # streams of random numbers of one seed; mlp.py has others


class Examples(NamedTuple):
    """Of one network: standardised inputs (n, d) and outputs (n, 3), which (n,) are kept aside, and its seed."""

    X: Floats
    Y: Floats
    held_out: NDArray[np.bool_]
    seed: int

    @property
    def size(self) -> tuple[int, ...]:
        """Numbers of points, of points kept aside and of inputs."""
        return len(self.X), int(self.held_out.sum()), self.X.shape[1]


class Trained(NamedTuple):
    """The best weights, the epoch they are from, and their mean squared error on the points kept aside."""

    network: Network
    epoch: int
    loss: float


def train(
    runs: Sequence[Examples],
    dropout: float,
    progress: Progress,
    settings: MLPSettings = DEFAULT_SETTINGS,
) -> list[Trained]:
    """Train one network for each run; those of the same size as one batch.

    Filling up small ones with zeros instead would make large batches of unequal networks, and round differently from a
    run of its own: without dropout that was seen to end in another optimum.

    Args:
        runs: What each network learns from.
        dropout: Probability that a hidden unit is switched off.
        progress: Is told how many epochs are done.
        settings: Learning rate, epochs and patience.

    Returns:
        The networks, in the order of the runs.

    Raises:
        MissingExtraError: PyTorch is not installed.
    """
    sizes, epochs = sorted({run.size for run in runs}), settings.max_epochs
    found: dict[int, Trained] = {}
    with _one_thread() as torch:
        for k, size in enumerate(sizes):
            which = [i for i, run in enumerate(runs) if run.size == size]
            batch = _Batch(torch, [runs[i] for i in which], dropout, settings)
            for epoch in batch.train():
                progress("training", k * epochs + epoch, len(sizes) * epochs)
            found |= {i: batch.best(j) for j, i in enumerate(which)}
            progress("training", (k + 1) * epochs, len(sizes) * epochs)
    return [found[i] for i in range(len(runs))]


@contextmanager
def _one_thread() -> Iterator[Any]:
    """PyTorch on one thread; see implicam.threads: its pool was measured to stall beside another process."""
    torch = import_extra("torch", "mlp", "training the neural network")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield torch
    finally:
        torch.set_num_threads(threads)


def initial_weights(inputs: int, rng: np.random.Generator) -> list[Floats]:
    """Weight, bias, weight, ...: uniform within 1 / sqrt(inputs of the layer), as `torch.nn.Linear` starts.

    Args:
        inputs: Of the network.
        rng: The source of chance.

    Returns:
        Weights (inputs of the layer, outputs) and biases (1, outputs), in turn.
    """
    return [
        rng.uniform(-1, 1, shape) / np.sqrt(fan_in)
        for fan_in, fan_out in layer_shapes(inputs)
        for shape in ((fan_in, fan_out), (1, fan_out))
    ]


def _in_line(arrays: Sequence[Floats]) -> Floats:
    """(numbers,) of one network's weight, bias, weight, ..., filled up with zeros; `_layers` is the way back."""
    line = np.concatenate([array.ravel() for array in arrays])
    return np.pad(line, (0, -len(line) % ALIGNED_NUMBERS))


def _layers(lines: Any, inputs: int) -> list[Any]:
    """Weight, bias, weight, ... of networks (networks, numbers), as views; a bias is (networks, 1, outputs)."""
    shapes = [shape for fan_in, fan_out in layer_shapes(inputs) for shape in ((fan_in, fan_out), (1, fan_out))]
    ends = np.cumsum([rows * columns for rows, columns in shapes])
    return [
        lines[:, end - rows * columns : end].unflatten(1, (rows, columns))
        for end, (rows, columns) in zip(ends, shapes, strict=True)
    ]


def forward(
    torch: Any,
    parameters: Sequence[Any],
    X: Any,
    masks: Sequence[Any] = (),
    slope: float = DEFAULT_SETTINGS.leaky_relu_slope_ratio,
) -> Any:
    """Outputs of every network.

    Args:
        torch: The module.
        parameters: Weight (networks, inputs, outputs), bias (networks, 1, outputs), weight, ... of the layers.
        X: Standardised inputs (networks, n, d).
        masks: The factors (networks, n, units) of each hidden layer, zero or positive; or none.
        slope: Of the leaky ReLU below zero.

    Returns:
        Standardised outputs (networks, n, 3).
    """
    for layer in range(LAYERS):
        X = torch.baddbmm(parameters[2 * layer + 1], X, parameters[2 * layer])
        if layer < len(HIDDEN):
            # a leaky ReLU of m x is m times that of x where m >= 0: in this order both can be done in place
            X = torch.nn.functional.leaky_relu_(X.mul_(masks[layer]) if masks else X, slope)
    return X


def gradients(
    torch: Any,
    parameters: Sequence[Any],
    X: Any,
    Y: Any,
    masks: Sequence[Any] = (),
    slope: float = DEFAULT_SETTINGS.leaky_relu_slope_ratio,
) -> tuple[Any, ...]:
    """The gradients of every network's mean squared error.

    Args:
        torch: The module.
        parameters: As of `forward`.
        X: Standardised inputs (networks, n, d).
        Y: Standardised outputs (networks, n, 3).
        masks: As of `forward`.
        slope: Of the leaky ReLU below zero.

    Returns:
        Shaped as `parameters`.
    """
    predicted = forward(torch, parameters, X, masks, slope)
    # a network's weights are in no loss but its own
    loss = torch.nn.functional.mse_loss(predicted, Y, reduction="sum") / Y[0].numel()
    found: tuple[Any, ...] = torch.autograd.grad(loss, parameters)
    return found


class _Masks:
    """Dropout of the hidden units at n points, for every network out of a stream of its own."""

    def __init__(self, torch: Any, streams: Sequence[np.random.SFC64], n: int, dropout: float) -> None:
        self.streams, self.dropout = streams, dropout
        units = sum(HIDDEN)
        self.words = np.empty((len(streams), n * units // 4), dtype=np.uint64)
        self.on = np.empty((len(streams), n, units), dtype=np.bool_)
        self.factors = [np.empty((len(streams), n, width), dtype=np.float32) for width in HIDDEN]
        self.layers = tuple(torch.from_numpy(factors) for factors in self.factors)

    def draw(self) -> tuple[Any, ...]:
        """One (networks, n, units) for each hidden layer, none without dropout; the next draw overwrites it."""
        if not self.dropout:
            return ()
        for words, stream in zip(self.words, self.streams, strict=True):
            words[:] = stream.random_raw(words.size)
        # 16 bits decide finely enough, and one word of the stream has four times as many
        drawn = self.words.view(np.uint16).reshape(self.on.shape)
        np.greater_equal(drawn, np.uint16(round(self.dropout * (1 << 16))), out=self.on)
        for on, factors in zip(np.split(self.on, np.cumsum(HIDDEN)[:-1], axis=2), self.factors, strict=True):
            np.multiply(on, np.float32(1 / (1 - self.dropout)), out=factors)
        return self.layers


class _Batch:
    """Networks of one size: those still `running`, by number, and the best weights of all."""

    def __init__(
        self, torch: Any, runs: Sequence[Examples], dropout: float, settings: MLPSettings = DEFAULT_SETTINGS
    ) -> None:
        self.torch, self.dropout, self.settings, self.running = torch, dropout, settings, np.arange(len(runs))
        self.training, self.checking = (
            [self._stack([(run.X, run.Y)[k][run.held_out == aside] for run in runs]) for k in range(2)]
            for aside in (False, True)
        )
        self.streams = [np.random.SFC64([run.seed, MASKS]) for run in runs]
        starts = [initial_weights(run.X.shape[1], np.random.default_rng([run.seed, WEIGHTS])) for run in runs]
        self._prepare(self._stack([_in_line(arrays) for arrays in starts]))
        self.kept = self.weights.clone()
        self.losses, self.epochs = np.full(len(runs), np.inf), np.zeros(len(runs), dtype=np.int64)

    @property
    def slope(self) -> float:
        return self.settings.leaky_relu_slope_ratio

    def _stack(self, arrays: Sequence[Floats]) -> Any:
        return self.torch.from_numpy(np.stack(arrays).astype(np.float32))

    def _prepare(self, weights: Any) -> None:
        """All that a step of the running networks needs, from their weights (running, numbers)."""
        _, n, inputs = self.training[0].shape
        self.weights, weights.grad = weights, self.torch.zeros_like(weights)
        self.optimiser = self.torch.optim.Adam([weights], lr=self.settings.learning_rate, fused=True)
        self.parameters = _layers(weights, inputs)
        for parameter in self.parameters:
            parameter.requires_grad_()
        numbers = sum(fan_out * (fan_in + 1) for fan_in, fan_out in layer_shapes(inputs))
        self.filling = weights.new_zeros(len(weights), weights.shape[1] - numbers)
        self.masks = _Masks(self.torch, [self.streams[i] for i in self.running], n, self.dropout)

    def train(self) -> Iterator[int]:
        """Train until every network has stopped; yields the epochs at which it looks."""
        epochs, every = self.settings.max_epochs, self.settings.check_every_epochs
        for epoch in range(1, epochs + 1):
            self._step()
            if epoch % every == 0 or epoch == epochs:
                self._check(epoch)
                yield epoch
            if not len(self.running):
                return

    def best(self, i: int) -> Trained:
        """The best weights of network i."""
        parameters = _layers(self.kept[[i]], self.training[0].shape[2])
        arrays = [parameter[0].numpy().astype(np.float64) for parameter in parameters]
        network = Network(tuple(arrays[::2]), tuple(bias[0] for bias in arrays[1::2]), self.slope)
        return Trained(network, int(self.epochs[i]), float(self.losses[i]))

    def _step(self) -> None:
        """One step of each running network on all its points."""
        X, Y = self.training
        found = gradients(self.torch, self.parameters, X, Y, self.masks.draw(), self.slope)
        self.torch.cat([*(one.flatten(1) for one in found), self.filling], 1, out=self.weights.grad)
        self.optimiser.step()

    def _check(self, epoch: int) -> None:
        """Note the weights that do better than before on the points kept aside, and stop who has not for too long."""
        X, Y = self.checking
        with self.torch.no_grad():
            losses = ((forward(self.torch, self.parameters, X, slope=self.slope) - Y) ** 2).mean(dim=(1, 2)).numpy()
        better = losses < self.losses[self.running]
        improved = self.running[better]
        self.losses[improved], self.epochs[improved] = losses[better], epoch
        self.kept[improved] = self.weights[better]
        going_on = epoch - self.epochs[self.running] < self.settings.patience_epochs
        if not going_on.all():
            self._keep(going_on)

    def _keep(self, which: NDArray[np.bool_]) -> None:
        """Go on with these only. Adam works element by element: each network takes its own means and squares along."""
        self.running = self.running[which]
        self.training, self.checking = ([tensor[which] for tensor in pair] for pair in (self.training, self.checking))
        state = self.optimiser.state[self.weights]
        self._prepare(self.weights[which])
        self.optimiser.state[self.weights] = {name: x[which] if x.ndim else x for name, x in state.items()}
