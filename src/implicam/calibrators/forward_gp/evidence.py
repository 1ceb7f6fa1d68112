"""How smooth, how large and how noisy: the hyperparameters by marginal likelihood, the lens integrated out.

Eqs. (8) to (12) of docs/method.md. Every camera has the same lengthscales; the size of the residual field and the
noise have a centre for the whole rig and a deviation of each camera from it, held by a prior: with a dozen points one
camera alone cannot tell its field from its noise, the rig together can; with many points each speaks for itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from implicam.calibrators.forward_gp.settings import ForwardGPSettings
from implicam.geometry import Floats
from implicam.gp.low_rank import pivoted_kernel
from implicam.rig_model.camera import Prior
from implicam.rig_model.field import Hyperparameters, field_kernel
from implicam.rig_model.normal_equations import stable_cholesky

LENGTHSCALE_GRID = ((0.6, 1.5, 4.0), (0.15, 0.5, 2.0))
"""Where the search looks first."""

FTOL = 1e-4
"""Change of the log posterior at which the search for the sizes ends, as a part of what it has gained: hundredths of a
nat."""

FIRST_LOG_STEP = 0.1
"""What log sizes are known to from a dozen points or more: the first step of the search for them."""

GTOL = 0.02
"""Slope by such a step at which the search ends while lengthscales are compared: thousandths of a nat."""

MIN_EIGENVALUE_RATIO = 1e-12
"""Eigenvalues below this part of the largest add nothing."""


class Spectrum(NamedTuple):
    """One camera's data in the eigenbasis of its field: eigenvalues e (m,), and what lies outside of it."""

    e: Floats
    y: Floats  # (m, 2)
    X: Floats  # (m, 2, p)
    yy: float
    Xy: Floats
    XX: Floats
    outside: int  # dimensions


@dataclass(frozen=True, eq=False)
class CameraEvidence:
    """Residuals (n, 2) of one camera, linear in parameters with prior: `residual = X step + field + noise`.

    X: (n, 2, p). off: (p,) prior mean minus where it is linearised. q: (n, 3) field coordinates. relative: (n,) the
    noise of each view over the camera's.
    """

    residual: Floats
    X: Floats
    off: Floats
    prior: Prior
    q: Floats
    relative: Floats

    def spectrum(self, lengthscale: Floats, tolerance: float) -> Spectrum:
        """The data seen from the field's eigenvectors.

        Args:
            lengthscale: (2,) as of `field_kernel`.
            tolerance: Variance of the field that may be left out.

        Returns:
            What `objective` needs.
        """
        p = self.X.shape[2]
        _, phi = pivoted_kernel(field_kernel(lengthscale), self.q, tolerance)
        phi /= self.relative[:, None]
        both = np.concatenate([self.residual[:, :, None], self.X], axis=2) / self.relative[:, None, None]
        e, V = np.linalg.eigh(phi.T @ phi)
        good = e > MIN_EIGENVALUE_RATIO * e[-1]
        e, V = e[good], V[:, good]
        basis = (phi @ V) / np.sqrt(e)
        flat = both.reshape(len(both), -1)
        inside = basis.T @ flat
        rest = (flat - basis @ inside).reshape(-1, p + 1)
        gram = rest.T @ rest
        inside = inside.reshape(len(e), 2, p + 1)
        return Spectrum(
            e, inside[:, :, 0], inside[:, :, 1:], float(gram[0, 0]), gram[1:, 0], gram[1:, 1:], 2 * (len(both) - len(e))
        )

    def objective(self, spectrum: Spectrum, signal: float, noise: float) -> tuple[float, float, float]:
        """Minus the log marginal likelihood, eq. (11).

        Args:
            spectrum: Of this camera.
            signal: Sd of the field, pixels.
            noise: Sd of the noise, pixels.

        Returns:
            Its value in nats, and its derivatives by log signal and log noise.
        """
        value, by_signal, by_noise = BatchedEvidence.of([self], [spectrum]).objective(
            np.array([signal]), np.array([noise])
        )
        return float(value[0]), float(by_signal[0]), float(by_noise[0])


class BatchedEvidence(NamedTuple):
    """Several cameras with as many parameters each, in stacks (C, ...): small matrices are fast only together.

    A camera with fewer eigenvalues than others is filled up with zeros, that is, with noise and no field.
    """

    e: Floats  # (C, m)
    y: Floats  # (C, 2 m)
    X: Floats  # (C, 2 m, p)
    yy: Floats
    Xy: Floats
    XX: Floats
    outside: Floats
    off: Floats
    precision: Floats

    @classmethod
    def of(cls, cameras: list[CameraEvidence], spectra: list[Spectrum]) -> BatchedEvidence:
        """Several cameras, padded with zeros to the largest.

        Args:
            cameras: Which have as many parameters each.
            spectra: Of these.

        Returns:
            The stacks.
        """
        m, p = max(len(s.e) for s in spectra), cameras[0].X.shape[2]
        e, y, X = np.zeros((len(spectra), m)), np.zeros((len(spectra), m, 2)), np.zeros((len(spectra), m, 2, p))
        for c, s in enumerate(spectra):
            e[c, : len(s.e)], y[c, : len(s.e)], X[c, : len(s.e)] = s.e, s.y, s.X
        return cls(
            e,
            y.reshape(len(e), 2 * m),
            X.reshape(len(e), 2 * m, p),
            np.array([s.yy for s in spectra]),
            np.array([s.Xy for s in spectra]),
            np.array([s.XX for s in spectra]),
            np.array([s.outside - 2.0 * (m - len(s.e)) for s in spectra]),
            np.array([camera.off for camera in cameras]),
            np.array([camera.prior.precision for camera in cameras]),
        )

    def objective(self, signal: Floats, noise: Floats) -> tuple[Floats, Floats, Floats]:
        """That of `CameraEvidence`, for every camera.

        Args:
            signal: (C,) pixels.
            noise: (C,) pixels.

        Returns:
            (C,) each: the values, and the derivatives by log signal and by log noise.
        """
        signal2, noise2 = signal**2, noise**2
        v = signal2[:, None] * self.e + noise2[:, None]
        v2 = v.repeat(2, axis=1)
        weighted = (self.X / v2[..., None]).swapaxes(1, 2)
        A = self.precision + self.XX / noise2[:, None, None] + weighted @ self.X
        pull = (self.precision @ self.off[..., None])[..., 0]
        b = pull + self.Xy / noise2[:, None] + (weighted @ self.y[..., None])[..., 0]
        scale = 1 / np.sqrt(np.diagonal(A, axis1=1, axis2=2))  # lens parameters differ by many orders of magnitude
        L = stable_cholesky(A * scale[:, :, None] * scale[:, None, :])
        inverse = np.linalg.inv(L) * scale[:, None, :]
        half = (inverse @ b[..., None])[..., 0]
        step = (inverse.swapaxes(1, 2) @ half[..., None])[..., 0]
        left = self.y - (self.X @ step[..., None])[..., 0]
        through = (self.XX @ step[..., None])[..., 0]
        left_outside = self.yy - 2 * (step * self.Xy).sum(axis=1) + (step * through).sum(axis=1)
        away = self.off - step
        prior = (away * (self.precision @ away[..., None])[..., 0]).sum(axis=1)
        quadratic = (left * left / v2).sum(axis=1) + left_outside / noise2 + prior
        logs = 2 * np.log(v).sum(axis=1) + self.outside * np.log(noise2)
        logs += 2 * np.log(np.diagonal(L, axis1=1, axis2=2) / scale).sum(axis=1)
        reach = self.X @ inverse.swapaxes(1, 2)
        spread = (reach * reach).sum(axis=2)
        by_v = 0.5 * (1 / v2 - (left * left + spread) / v2**2)
        outer = (inverse @ self.XX * inverse).sum(axis=(1, 2))  # trace(covariance XX)
        by_noise2 = by_v.sum(axis=1) + 0.5 * (self.outside / noise2 - (left_outside + outer) / noise2**2)
        by_signal2 = (by_v * self.e.repeat(2, axis=1)).sum(axis=1)
        return 0.5 * (quadratic + logs), 2 * signal2 * by_signal2, 2 * noise2 * by_noise2


@dataclass(frozen=True, eq=False)
class RigEvidence:
    """All cameras together. half: (C,) half the longer side in pixels; stated: (C,) stated noise in pixels or NaN;
    lens: whether they have a lens model, and are no linear projections."""

    cameras: list[CameraEvidence]
    half: Floats
    stated: Floats
    lens: bool
    tolerance: float
    settings: ForwardGPSettings

    def maximise(self, start: Hyperparameters | None = None, *, search: bool = True) -> Hyperparameters:
        """The most probable hyperparameters.

        Args:
            start: A good guess, from a moment ago.
            search: Look for other lengthscales than those of the guess.
        """
        shared = np.zeros(2)  # log deviations of signal and noise from their prior medians
        if start is not None:  # two pairs of them can be likely, a large field and large noise: stay with that found
            shared = np.clip(self._mean_deviations(start.signal, start.noise), -6.0, 6.0)
        tried: dict[tuple[float, ...], tuple[float, Floats, list[Spectrum]]] = {}
        median, log_sd = np.log(self.settings.lengthscale_prior_median), self.settings.lengthscale_prior_log_sd
        least, most = np.log(self.settings.min_lengthscale), np.log(self.settings.max_lengthscale)

        def at(log_lengthscale: Floats) -> float:
            nonlocal shared
            inside = np.clip(log_lengthscale, least, most)
            spectra = [camera.spectrum(np.exp(inside), self.tolerance) for camera in self.cameras]
            found = self._minimum(self._sizes_objective(spectra, own=False)[0], shared, GTOL)
            shared = found.x
            value = float(found.fun + 0.5 * np.sum(((inside - median) / log_sd) ** 2))
            tried[tuple(inside)] = value, shared, spectra
            return value + float(np.sum((log_lengthscale - inside) ** 2))

        if start is None:  # a second, shorter range can be as likely: look everywhere first
            for lengthscale in product(*LENGTHSCALE_GRID):
                at(np.log(lengthscale))
            best = min(tried, key=lambda key: tried[key][0])
            first, size, shared = np.array(best), 0.5, tried[best][1]
        else:
            first, size = np.log(start.lengthscale[0]), 0.2
        if start is not None and not search:
            at(first)
        else:
            simplex = first + size * np.array([[0, 0], [-1, 0.3], [0.3, -1]])
            options = {"initial_simplex": simplex, "xatol": 0.1, "fatol": 0.1, "maxfev": 12}
            minimize(at, first, method="Nelder-Mead", options=options)
        best = min(tried, key=lambda key: tried[key][0])
        _, shared, spectra = tried[best]
        signal, noise = self._average_sizes(spectra, shared)
        return Hyperparameters(np.tile(np.exp(best), (len(self.cameras), 1)), signal, noise)

    def _average_sizes(self, spectra: list[Spectrum], shared: Floats) -> tuple[Floats, Floats]:
        """Signal and noise (C,) whose squares are the posterior means of the variances, eq. (12).

        The most probable variance is smaller than the mean one, much so with few points: error bars made from it would
        be too small. In the logarithms the posterior is nearly normal, and the mean follows from its covariance.
        """
        objective, sds = self._sizes_objective(spectra, own=True)
        C = len(self.cameras)
        z = self._minimum(objective, np.concatenate([shared, np.zeros(2 * C)])).x
        to_logs = np.zeros((2 * C, len(z)))  # log signal and log noise of each camera
        to_logs[:C, 0] = to_logs[C:, 1] = 1
        to_logs[:, 2:] = np.eye(2 * C)
        h = 1e-3
        blocks = []  # each camera knows of its own sizes only, so all of them may move at once
        for moved in h * to_logs[:, :2].T:
            d = np.append([0.0, 0.0], moved)
            slope = (objective(z + d)[1] - objective(z - d)[1] - 2 * d / sds**2)[2:] / (2 * h)
            blocks.append(np.concatenate([np.diag(slope[:C]), np.diag(slope[C:])]))
        hessian = to_logs.T @ np.hstack(blocks) @ to_logs + np.diag(1 / sds**2)
        values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
        spread = vectors / np.maximum(values, 1 / sds.max() ** 2) @ vectors.T
        larger = np.exp(np.einsum("ij,jk,ik->i", to_logs, spread, to_logs))
        signal, noise = self._sizes(z)
        return signal * larger[:C], noise * larger[C:]

    def _medians(self) -> tuple[Floats, Floats]:
        usual = np.exp(self.settings.log_noise_prior[0]) * self.half
        noise = np.where(np.isfinite(self.stated), self.stated, usual)
        return np.exp(self.settings.log_signal_prior(lens=self.lens)[0]) * self.half, noise

    def _mean_deviations(self, signal: Floats, noise: Floats) -> Floats:
        """(2,) logs of signal and noise (C,) over their prior medians, in the mean of the rig."""
        pairs = zip((signal, noise), self._medians(), strict=True)
        return np.array([np.mean(np.log(found / median)) for found, median in pairs])

    def penalty(self, signal: Floats, noise: Floats) -> float:
        """Minus the log prior of sizes, as far as the rig shares them.

        Args:
            signal: (C,) pixels.
            noise: (C,) pixels.

        Returns:
            In nats, up to a constant.
        """
        return 0.5 * float(np.sum((self._mean_deviations(signal, noise) / self._shared_sds()) ** 2))

    def _shared_sds(self) -> Floats:
        stated, settings = np.isfinite(self.stated).all(), self.settings
        noise = settings.stated_noise_log_sd if stated else settings.noise_prior_log_sd
        return np.array([settings.log_signal_prior(lens=self.lens)[1], noise])

    def _sizes(self, z: Floats) -> tuple[Floats, Floats]:
        """Signal and noise (C,) from (shared signal, shared noise, own signals, own noises)."""
        signal, noise = self._medians()
        C = len(self.cameras)
        own = z[2:] if len(z) > 2 else np.zeros(2 * C)
        return signal * np.exp(z[0] + own[:C]), noise * np.exp(z[1] + own[C:])

    def _sizes_objective(
        self, spectra: list[Spectrum], *, own: bool
    ) -> tuple[Callable[[Floats], tuple[float, Floats]], Floats]:
        """Minus the log posterior of the sizes with its gradient, and the prior sd of each."""
        C = len(self.cameras)
        sds = self._shared_sds()
        if own:
            sds = np.append(sds, np.repeat([self.settings.camera_signal_log_sd, self.settings.camera_noise_log_sd], C))

        alike: dict[int, list[int]] = {}
        for c, camera in enumerate(self.cameras):
            alike.setdefault(camera.X.shape[2], []).append(c)
        groups = [
            (group, BatchedEvidence.of([self.cameras[c] for c in group], [spectra[c] for c in group]))
            for group in alike.values()
        ]

        def objective(z: Floats) -> tuple[float, Floats]:
            signal, noise = self._sizes(z)
            found = np.empty((3, C))
            for group, together in groups:
                found[:, group] = together.objective(signal[group], noise[group])
            value, by_signal, by_noise = found
            shared = np.array([by_signal.sum(), by_noise.sum()])
            gradient = np.concatenate([shared, by_signal, by_noise]) if own else shared
            return float(value.sum() + 0.5 * np.sum((z / sds) ** 2)), gradient + z / sds**2

        return objective, sds

    @staticmethod
    def _minimum(objective: Callable[[Floats], tuple[float, Floats]], start: Floats, gtol: float = 1e-5) -> Any:
        """The sizes z of the least objective near `start`; looked for in steps that sizes are known to."""
        bounds = [(-6.0 / FIRST_LOG_STEP, 6.0 / FIRST_LOG_STEP)] * len(start)
        before, slope = objective(start)  # its zero depends on the unit: what counts is what is gained

        def gained(u: Floats) -> tuple[float, Floats]:
            if np.array_equal(u, start / FIRST_LOG_STEP):
                return 0.0, slope * FIRST_LOG_STEP
            value, gradient = objective(u * FIRST_LOG_STEP)
            return value - before, gradient * FIRST_LOG_STEP

        options = {"ftol": FTOL, "gtol": gtol}
        found = minimize(gained, start / FIRST_LOG_STEP, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        found.fun += before
        found.x = found.x * FIRST_LOG_STEP
        return found
