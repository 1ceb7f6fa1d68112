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

from implicam.calibrators.mlp_network import HIDDEN, SLOPE, Network, layer_shapes
from implicam.dataset import Floats
from implicam.errors import import_extra
from implicam.progress import Progress

EPOCHS = 5000
"""At most; with dropout most networks have found their best weights within 1000."""
PATIENCE = 1000
"""Epochs without better weights after which a network stops."""
CHECK_EVERY = 10
LEARNING_RATE, DECAY_OF_MEAN, DECAY_OF_SQUARE, EPSILON = 1e-3, 0.9, 0.999, 1e-8
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
    runs: Sequence[Examples], dropout: float, progress: Progress, *, epochs: int = EPOCHS, patience: int = PATIENCE
) -> list[Trained]:
    """Train one network for each run; those of the same size as one batch.

    Filling up small ones with zeros instead would make large batches of unequal networks, and round differently from a
    run of its own: without dropout that was seen to end in another optimum.
    """
    sizes = sorted({run.size for run in runs})
    found: dict[int, Trained] = {}
    with _one_thread() as torch:
        for k, size in enumerate(sizes):
            which = [i for i, run in enumerate(runs) if run.size == size]
            batch = _Batch(torch, [runs[i] for i in which], dropout)
            for epoch in batch.train(epochs, patience):
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
    """Weight, bias, weight, ...: uniform within 1 / sqrt(inputs of the layer), as `torch.nn.Linear` starts."""
    return [
        rng.uniform(-1, 1, shape) / np.sqrt(fan_in)
        for fan_in, fan_out in layer_shapes(inputs)
        for shape in ((fan_in, fan_out), (1, fan_out))
    ]


def forward(torch: Any, parameters: Sequence[Any], X: Any, masks: Sequence[Any] = ()) -> Any:
    """(networks, n, 3) of X (networks, n, d); masks: one (networks, n, units) for each hidden layer, or none."""
    last = len(HIDDEN)
    for layer in range(last + 1):
        X = torch.baddbmm(parameters[2 * layer + 1], X, parameters[2 * layer])
        if layer < last:
            X = torch.nn.functional.leaky_relu(X, SLOPE)
            X = X * masks[layer] if masks else X
    return X


class _Adam:
    """Adam (Kingma and Ba 2015) on parameters (networks, ...) of which whole networks can be taken away.

    It works element by element, so every network has an optimiser of its own.
    """

    def __init__(self, torch: Any, parameters: Sequence[Any]) -> None:
        self.torch, self.steps = torch, 0
        self.parameters = [parameter.requires_grad_() for parameter in parameters]
        self.means = [torch.zeros_like(parameter) for parameter in parameters]
        self.squares = [torch.zeros_like(parameter) for parameter in parameters]

    def step(self, loss: Any) -> None:
        self.steps += 1
        rate = LEARNING_RATE / (1 - DECAY_OF_MEAN**self.steps)
        square_bias = (1 - DECAY_OF_SQUARE**self.steps) ** 0.5
        gradients = self.torch.autograd.grad(loss, self.parameters)
        with self.torch.no_grad():
            for value, slope, mean, square in zip(self.parameters, gradients, self.means, self.squares, strict=True):
                mean.lerp_(slope, 1 - DECAY_OF_MEAN)
                square.mul_(DECAY_OF_SQUARE).addcmul_(slope, slope, value=1 - DECAY_OF_SQUARE)
                value.addcdiv_(mean, square.sqrt().div_(square_bias).add_(EPSILON), value=-rate)

    def keep(self, which: NDArray[np.bool_]) -> None:
        self.parameters = [parameter.detach()[which].requires_grad_() for parameter in self.parameters]
        self.means = [mean[which] for mean in self.means]
        self.squares = [square[which] for square in self.squares]


class _Batch:
    """Networks of one size: those still `running`, by number, and the best weights of all."""

    def __init__(self, torch: Any, runs: Sequence[Examples], dropout: float) -> None:
        self.torch, self.dropout, self.running = torch, dropout, np.arange(len(runs))
        self.training, self.checking = (
            [self._stack([(run.X, run.Y)[k][run.held_out == aside] for run in runs]) for k in range(2)]
            for aside in (False, True)
        )
        starts = [initial_weights(run.X.shape[1], np.random.default_rng([run.seed, WEIGHTS])) for run in runs]
        self.optimiser = _Adam(torch, [self._stack(layer) for layer in zip(*starts, strict=True)])
        self.masks = [np.random.Generator(np.random.SFC64([run.seed, MASKS])) for run in runs]
        self.kept = [parameter.detach().clone() for parameter in self.optimiser.parameters]
        self.losses, self.epochs = np.full(len(runs), np.inf), np.zeros(len(runs), dtype=np.int64)

    def _stack(self, arrays: Sequence[Floats]) -> Any:
        return self.torch.from_numpy(np.stack(arrays).astype(np.float32))

    def train(self, epochs: int, patience: int) -> Iterator[int]:
        """Train until every network has stopped; yields the epochs at which it looks."""
        for epoch in range(1, epochs + 1):
            self._step()
            if epoch % CHECK_EVERY == 0 or epoch == epochs:
                self._check(epoch, patience)
                yield epoch
            if not len(self.running):
                return

    def best(self, i: int) -> Trained:
        """The best weights of network i."""
        arrays = [parameter[i].numpy().astype(np.float64) for parameter in self.kept]
        network = Network(tuple(arrays[::2]), tuple(bias[0] for bias in arrays[1::2]))
        return Trained(network, int(self.epochs[i]), float(self.losses[i]))

    def _step(self) -> None:
        """One step of each running network on all its points: the sum's gradients are those of its own loss."""
        X, Y = self.training
        predicted = forward(self.torch, self.optimiser.parameters, X, self._draw_masks(X.shape[1]))
        self.optimiser.step(_mean_squares(predicted, Y).sum())

    def _draw_masks(self, n: int) -> tuple[Any, ...]:
        """One (running, n, units) for each hidden layer, none without dropout; a network draws from its own stream."""
        if not self.dropout:
            return ()
        drawn = np.stack(  # 16 bits decide finely enough, and are quickly drawn
            [self.masks[i].integers(0, 1 << 16, (n, sum(HIDDEN)), dtype=np.uint16) for i in self.running]
        )
        factors = (drawn >= round(self.dropout * (1 << 16))) * np.float32(1 / (1 - self.dropout))
        return tuple(self.torch.from_numpy(factors).split(HIDDEN, dim=2))

    def _check(self, epoch: int, patience: int) -> None:
        """Note the weights that do better than before on the points kept aside, and stop who has not for too long."""
        X, Y = self.checking
        with self.torch.no_grad():
            losses = _mean_squares(forward(self.torch, self.optimiser.parameters, X), Y).numpy()
        better = losses < self.losses[self.running]
        improved = self.running[better]
        self.losses[improved], self.epochs[improved] = losses[better], epoch
        for kept, parameter in zip(self.kept, self.optimiser.parameters, strict=True):
            kept[improved] = parameter.detach()[better]
        going_on = epoch - self.epochs[self.running] < patience
        if not going_on.all():
            self.running = self.running[going_on]
            self.training = [tensor[going_on] for tensor in self.training]
            self.checking = [tensor[going_on] for tensor in self.checking]
            self.optimiser.keep(going_on)


def _mean_squares(predicted: Any, Y: Any) -> Any:
    """(networks,) mean squared error over points and axes."""
    return ((predicted - Y) ** 2).mean(dim=(1, 2))
