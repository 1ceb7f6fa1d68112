"""The paper's network (De Boi et al., section "Moving Ball in Grid"): 2 cameras -> 128 -> 128 -> 64 -> 3.

After each hidden layer a leaky ReLU and dropout. In NumPy and float64, so that measuring needs no PyTorch; training is
in mlp_training.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from implicam.calibrators.mlp_settings import DEFAULT_SETTINGS
from implicam.dataset import Floats

HIDDEN = (128, 128, 64)


def layer_shapes(inputs: int) -> list[tuple[int, int]]:
    """(inputs, outputs) of each layer of weights.

    Args:
        inputs: Of the network: two a camera.

    Returns:
        One pair for each of the four layers.
    """
    return list(pairwise((inputs, *HIDDEN, 3)))


@dataclass(frozen=True, eq=False)
class Network:
    """Weights (inputs, outputs) and biases (outputs,) of each layer; slope of the leaky ReLU below zero; inputs and
    outputs are standardised."""

    weights: tuple[Floats, ...]
    biases: tuple[Floats, ...]
    slope: float = DEFAULT_SETTINGS.leaky_relu_slope_ratio

    def predict(self, X: Floats) -> Floats:
        """Outputs with every unit at work.

        Args:
            X: (n, d) standardised inputs.

        Returns:
            (n, 3) standardised outputs.
        """
        return self._above_first(self._first(X), [np.ones(width) for width in HIDDEN])

    def spread(self, X: Floats, masks: Floats) -> Floats:
        """The sample covariance of the outputs over passes with dropout.

        Monte-Carlo dropout: Gal and Ghahramani, "Dropout as a Bayesian Approximation", ICML 2016. Each pass uses one
        mask for all points, so that a point's answer does not depend on its company.

        Args:
            X: (n, d) standardised inputs.
            masks: (passes, units) as `draw_masks`, of two passes or more.

        Returns:
            (n, 3, 3) in standardised units.
        """
        first, centre = self._first(X), self.predict(X)
        total, squares = np.zeros((len(X), 3)), np.zeros((len(X), 3, 3))
        for mask in masks:
            off = self._above_first(first, np.split(mask, np.cumsum(HIDDEN)[:-1])) - centre
            total += off
            squares += off[:, :, None] * off[:, None, :]
        mean = total / len(masks)
        return (squares - len(masks) * mean[:, :, None] * mean[:, None, :]) / (len(masks) - 1)

    def _first(self, X: Floats) -> Floats:
        return _leaky_relu(X @ self.weights[0] + self.biases[0], self.slope)

    def _above_first(self, hidden: Floats, masks: list[Floats]) -> Floats:
        """(n, 3) outputs from the first hidden layer (n, 128), each hidden layer times its mask."""
        for mask, weight, bias in zip(masks[:-1], self.weights[1:-1], self.biases[1:-1], strict=True):
            hidden = _leaky_relu((hidden * mask) @ weight + bias, self.slope)
        return np.asarray((hidden * masks[-1]) @ self.weights[-1] + self.biases[-1])


def draw_masks(rng: np.random.Generator, passes: int, dropout: float) -> Floats:
    """Draw which hidden units are switched off.

    Args:
        rng: The source of chance.
        passes: How many masks.
        dropout: Probability that a unit is switched off.

    Returns:
        (passes, hidden units) zero where a unit is switched off, else 1 / (1 - dropout).
    """
    return (rng.random((passes, sum(HIDDEN))) >= dropout) / (1 - dropout)


def _leaky_relu(x: Floats, slope: float) -> Floats:
    return np.maximum(x, slope * x)
