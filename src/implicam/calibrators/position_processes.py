"""Gaussian processes from pixels to positions, at several places together: what is known there, and what one known
point more would add."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from implicam.dataset import Floats
from implicam.gp import Kernel

Index = slice | NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PositionProcess:
    """One Gaussian process of the pixels, at n places.

    Attributes:
        kernel: its covariance before any known point.
        noise_variance: of one output.
        share: (3, 3) by which its variance is part of the covariance of a position, in squared length units.
        outputs: how many coordinates it stands for.
        X: (n, d) what it takes at the places.
        known: V (points, n), drift: W (p, n), with `covariance of the places = K + W^T W - V^T V`.
    """

    kernel: Kernel
    noise_variance: float
    share: Floats
    outputs: int
    X: Floats
    known: Floats
    drift: Floats

    def covariance(self, a: Index, b: Index) -> Floats:
        """The covariance between places, of the function without noise.

        Args:
            a: Some of the places.
            b: Others.

        Returns:
            (a, b).
        """
        V, W = self.known, self.drift
        return np.asarray(self.kernel(self.X[a], self.X[b]) + W[:, a].T @ W[:, b] - V[:, a].T @ V[:, b])

    @cached_property
    def variances(self) -> Floats:
        """(n,) of the function without noise."""
        explained = np.einsum("ij,ij->j", self.known, self.known)
        drift = np.einsum("ij,ij->j", self.drift, self.drift)
        return np.asarray(np.maximum(self.kernel.signal_variance + drift - explained, 0.0))

    def with_known(self, i: int) -> PositionProcess:
        """The same when place i is a known point too: V gets one more row.

        Args:
            i: Number of the place.

        Returns:
            The process at the same places.
        """
        row = self.covariance(slice(i, i + 1), slice(None)) / np.sqrt(self.variances[i] + self.noise_variance)
        return replace(self, known=np.concatenate([self.known, row]))


@dataclass(frozen=True, eq=False)
class PositionProcesses:
    """All processes of a calibration at n places.

    Attributes:
        processes: whose variances, each times its share, add up to the covariance of a position.
        beside: (n, 3, 3) what else is uncertain, whatever is added, in squared length units.
        widened: (n,) the factor of the covariance away from what was learned, NaN where nothing is measured.
    """

    processes: tuple[PositionProcess, ...]
    beside: Floats
    widened: Floats

    @cached_property
    def covariance(self) -> Floats:
        """(n, 3, 3) of a position measured at each place."""
        variances = np.stack([one.variances + one.noise_variance for one in self.processes], axis=1)
        total = np.einsum("nk,kij->nij", variances, np.stack([one.share for one in self.processes])) + self.beside
        return np.asarray(total * self.widened[:, None, None])

    @property
    def noise_covariance(self) -> Floats:
        """(3, 3) what the processes take for noise."""
        noise = np.array([one.noise_variance for one in self.processes])
        return np.asarray(np.einsum("k,kij->ij", noise, np.stack([one.share for one in self.processes])))

    def with_known(self, i: int) -> PositionProcesses:
        """The same when place i is a known point too.

        Args:
            i: Number of the place.

        Returns:
            The processes at the same places.
        """
        return replace(self, processes=tuple(one.with_known(i) for one in self.processes))
