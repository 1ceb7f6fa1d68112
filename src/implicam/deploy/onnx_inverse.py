"""`inverse-gp` as an ONNX graph: from the pixels of all cameras to a position, with its covariance."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np

from implicam.calibrators.inverse_maps import Map, SmoothMap, ThreeMaps
from implicam.calibrators.pixel_cloud import PixelCloud
from implicam.dataset import Floats
from implicam.deploy.onnx_graph import Graph, Value, kernel, side_by_side, solve_lower
from implicam.gp.linalg import solve_lower as solve_lower_now


@runtime_checkable
class MapsPixels(Protocol):
    """What the graph is made of: Gaussian processes from standardised pixels to standardised positions, and from where
    on pixels are unlike those learned from (`smoothness` None: nowhere)."""

    used: Any
    pixels: Any
    positions: Any
    smoothness: Any

    @property
    def map(self) -> Map:
        """The processes."""

    @property
    def cloud(self) -> PixelCloud:
        """The pixels learned from."""

    @property
    def farthest(self) -> float:
        """From them, that is still measured."""


def inverse_graph(calibration: MapsPixels) -> Graph:
    """The graph of an `inverse-gp` calibration: what `measure` computes.

    Inputs: `uv_NAME` (n, 2) for each camera. Outputs: `xyz` (n, 3), `covariance` (n, 3, 3) and `sd` (n, 3), NaN where
    `measure` gives a reason instead: a view is missing (NaN), or the pixels are unlike those learned from.

    Args:
        calibration: It.

    Returns:
        The graph.

    Raises:
        MissingExtraError: The package onnx is not installed.
    """
    g = Graph()
    names = calibration.used.observations.camera_names
    uv = side_by_side([g.input(f"uv_{name}", 2) for name in names])
    X = (uv - calibration.pixels.offset[None]) / calibration.pixels.scale[None]
    made = calibration.map
    mean, covariance = _smooth(made, X) if isinstance(made, SmoothMap) else _three(made, X)
    scale = calibration.positions.scale
    mean = mean * scale[None] + calibration.positions.offset[None]
    covariance = covariance * np.outer(scale, scale).reshape(1, 9)
    bad = uv.nothing()
    if calibration.smoothness is not None:
        far = _farness(calibration.cloud, uv)
        bad = bad + (far * 0.0).only_where(far < np.nextafter(calibration.farthest, np.inf))
        covariance = covariance * far.at_least(1.0).squared()
    g.output("xyz", mean + bad, 3)
    g.output("covariance", covariance + bad, 3, 3)
    g.output("sd", covariance.column(0, 4, 8).sqrt() + bad, 3)
    return g


def _three(made: Map, X: Value) -> tuple[Value, Value]:
    """Mean (n, 3) and covariance (n, 9), standardised, of processes that know nothing of each other."""
    assert isinstance(made, ThreeMaps)
    means, variances = [], []
    for process in made.processes:
        K, _ = kernel(X, process.X, process.kernel.lengthscale, process.kernel.shape)
        K = K * process.kernel.signal_variance
        means.append(K @ process.alpha[:, None] + process.mean)
        left = process.kernel.signal_variance - solve_lower(K, process.L).squared().sum()
        variances.append(left.at_least(0.0) + process.noise_variance)
    shares = np.stack([np.outer(axis, axis).ravel() for axis in made.axes])
    return side_by_side(means) @ made.axes, side_by_side(variances) @ shares


def _smooth(made: SmoothMap, X: Value) -> tuple[Value, Value]:
    """Mean (n, 3) and covariance (n, 9), standardised, of one process for all coordinates."""
    k, m = made.kriging, 3
    d, scale = k.X.shape[1], k.kernel.lengthscale
    inputs, H = X @ made.basis, X @ made.axes
    one = X.nothing() + 1.0
    H = side_by_side([one, H]) if made.axes.shape[1] else one
    K, slope = kernel(inputs, k.X, scale, k.kernel.shape)
    V = solve_lower(K, k.L)
    W = solve_lower(H - V @ solve_lower_now(k.L, k.H), k.G)
    factor = (1.0 - V.squared().sum() + W.squared().sum()).at_least(0.0) + k.noise_variance
    mean = K @ k.a + H @ k.coefficients
    back, coefficients = k.constants_by_hyperparameters()
    moved = -(K @ back + H @ coefficients)  # (n, (d + 1) m)
    own = k.X / scale
    weighted = [_weighted_squares(slope, inputs.column(j) / scale[j], own[:, j], k.a) for j in range(d)]
    moved = moved + side_by_side([*weighted, X.nothing() * np.ones((1, m))])
    turned = moved @ np.kron(k.smoothness.root, np.eye(m))  # (n, (d + 1) m): sum over j of root_jc moved_jm
    uncertain = [
        sum(
            (turned.column(c * m + a) * turned.column(c * m + b) for c in range(1, d + 1)),
            start=turned.column(a) * turned.column(b),
        )
        for a in range(m)
        for b in range(m)
    ]
    return mean, factor * k.sigma.reshape(1, 9) + side_by_side(uncertain)


def _weighted_squares(weights: Value, new: Value, own: Floats, a: Floats) -> Value:
    """(n, m) `sum_i weights_i (new - own_i)^2 a_i`."""
    by_square, by_value = weights @ (own[:, None] ** 2 * a), weights @ (own[:, None] * a)
    return by_square - new * by_value * 2.0 + new.squared() * (weights @ a)


def _farness(cloud: PixelCloud, uv: Value) -> Value:
    """(n, 1) as `PixelCloud.farness`."""
    Z = (uv - cloud.offset[None]) @ cloud.directions
    q, d = cloud.leading, len(cloud.offset)
    T = [Z.column(i) for i in range(q)]
    terms = [T[0] * 0.0 + 1.0, *T] if q else [Z.nothing() + 1.0]
    if cloud.degree == 2:
        terms += [T[i] * T[j] for i in range(q) for j in range(i, q)]
    B = side_by_side(terms)
    ratio = ((B @ cloud.inverse) * B).sum() + 1.0
    rest = Z.column(*range(q, d)) - B @ cloud.coefficients
    return (rest @ cloud.whiten).squared().sum().sqrt() / ratio.sqrt() / cloud.farthest
