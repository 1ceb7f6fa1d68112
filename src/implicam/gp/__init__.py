"""Gaussian-process mathematics only; knows nothing of cameras."""

from implicam.gp.fit import Fit, maximise, maximise_each
from implicam.gp.kernels import SHAPES, Floats, Kernel
from implicam.gp.kriging import Kriging, LengthscalePrior, Smoothness, maximise_posterior
from implicam.gp.regression import GaussianProcess

__all__ = [
    "SHAPES",
    "Fit",
    "Floats",
    "GaussianProcess",
    "Kernel",
    "Kriging",
    "LengthscalePrior",
    "Smoothness",
    "maximise",
    "maximise_each",
    "maximise_posterior",
]
