"""Every threshold of mlp, and what of its training is a judgement; how to read a name: `implicam.settings`.

The layers are the paper's and no settings. Of their training the paper says nothing; mlp_training.py says what was
tried.
"""

from __future__ import annotations

from dataclasses import dataclass

from implicam.calibrators.every_camera import EveryCameraSettings


@dataclass(frozen=True, kw_only=True, repr=False)
class MLPSettings(EveryCameraSettings):
    """The settings of `MLP(settings=...)`.

    >>> import implicam as ic
    >>> ic.MLP(settings=ic.MLPSettings()).settings == ic.MLPSettings()
    True
    """

    # training
    held_out_share: float = 0.15
    """Share of the known points kept for early stopping, at least one point."""
    learning_rate: float = 1e-3
    """Learning rate of Adam, its default."""
    max_epochs: int = 5000
    """Epochs at most; with dropout most networks have found their best weights within 1000."""
    patience_epochs: int = 1000
    """Epochs without better weights after which a network stops."""
    check_every_epochs: int = 10
    """Epochs from one look at the points kept for early stopping to the next."""

    # the network
    leaky_relu_slope_ratio: float = 0.01
    """Slope of the leaky ReLU below zero over that above: PyTorch's default, the paper states none."""

    # error bars
    dropout_passes: int = 200
    """Passes with dropout: a standard deviation is then known to 5 %."""


DEFAULT_SETTINGS = MLPSettings()
"""What `MLP()` uses."""
