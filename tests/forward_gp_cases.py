"""What the tests of forward-gp and of the rig model share: cameras, rigs, fits and their data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
from scipy.linalg import block_diag

from implicam.calibrators import ForwardGP, ForwardGPCalibration
from implicam.dataset import Dataset, KnownPositions
from implicam.rig_model.camera import Image
from implicam.rig_model.camera_model import CameraModel
from implicam.rig_model.posterior import Posterior
from implicam.simulate import Rig, build_rig, random_positions, simulate

IMAGE = Image(np.array([639.5, 399.5]), 640.0)


def rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return np.asarray(q * np.linalg.det(q))


def numeric(f: Callable[[np.ndarray], np.ndarray], steps: np.ndarray) -> np.ndarray:
    """Central differences of f at zero, the variable last."""
    columns = []
    for i, h in enumerate(steps):
        d = np.zeros(len(steps))
        d[i] = h
        columns.append((f(d) - f(-d)) / (2 * h))
    return np.stack(columns, axis=-1)


LENGTHSCALE = np.array([0.7, 1.5])


def se(a: np.ndarray, b: np.ndarray, lengthscale: np.ndarray) -> np.ndarray:
    d = (a[:, None] - b[None]) / lengthscale[[0, 0, 1]]
    return np.asarray(np.exp(-0.5 * np.sum(d**2, axis=2)))


def design(model: CameraModel, points: np.ndarray) -> np.ndarray:
    """(n, 2, P) derivative of the pixels by the camera's unknowns."""
    rows = model.rows(points)
    n, m = rows.phi.shape
    wide = np.zeros((n, 2, 2 * m))
    wide[:, 0, :m] = wide[:, 1, m:] = rows.phi
    return np.concatenate([rows.J, wide], axis=2)


def covariance_of(posterior: Posterior) -> np.ndarray:
    """Of all cameras' unknowns, in order; a posterior keeps roots."""
    if posterior.tied:
        joint = np.concatenate([posterior.root(c) for c in range(len(posterior.models))], axis=1)
        return joint.T @ joint
    return np.asarray(block_diag(*(root.T @ root for root in posterior.alone)))


@cache
def rig(cameras: str = "2R2W") -> Rig:
    return build_rig("bar6", seed=3, frame="random", cameras=cameras)


@cache
def known(n: int = 50) -> Dataset:
    return simulate(rig(), random_positions(rig(), n, np.random.default_rng(11)), seed=12)


@cache
def fitted() -> ForwardGPCalibration:
    return ForwardGP().fit(known())


def with_positions(data: Dataset, xyz: np.ndarray | None = None, sd: np.ndarray | float | None = None) -> Dataset:
    old = data.positions
    new = old.sd if sd is None else np.broadcast_to(sd, old.xyz.shape).copy()
    return replace(data, known=KnownPositions(old.shots, old.xyz if xyz is None else xyz, new))


def joint_covariance(posterior: Posterior, x: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """(2C, 2C) of all views of one point, from the design of each camera, dense."""
    wide = block_diag(*(design(model, x[None])[0] for model in posterior.models))
    covariance = covariance_of(posterior)
    own = [n**2 + float(model.rows(x[None]).rest[0]) for n, model in zip(noise, posterior.models, strict=True)]
    return np.asarray(wide @ covariance @ wide.T + np.diag(np.repeat(own, 2)))


@cache
def declared_fit() -> ForwardGPCalibration:
    data = simulate(rig(), random_positions(rig(), 40, np.random.default_rng(15)), seed=16, robot_noise=0.2)
    return ForwardGP().fit(data)


@cache
def dots_fit() -> ForwardGPCalibration:
    """Known positions that are off by 0.15 mm each, which nothing says."""
    xyz = known().xyz + 0.15 * rig().units_per_mm * np.random.default_rng(18).normal(size=known().xyz.shape)
    return ForwardGP().fit(with_positions(known(), xyz, np.nan))
