"""Gaussian-process mathematics only; knows nothing of cameras."""

from implicam.gp.fit import Fit, maximise, maximise_each
from implicam.gp.kernels import SHAPES, Floats, Kernel
from implicam.gp.kriging import Kriging, LengthscalePrior, Smoothness, most_probable
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
    "most_probable",
]
