"""inverse-gp: Gaussian processes from the pixels of all cameras to x, y and z.

Three presets. `smooth`, the default: one process for all three coordinates, a linear mean, priors on how smooth optics
are, and error bars that hold what is uncertain of all that (inverse_maps.py, docs/decisions/0017-inverse-gp.md).
`plain`, the paper's model: De Boi et al., "Implicit Multi-Camera System Calibration Using Gaussian Processes", section
"Implicit Camera Calibration": inputs u1, v1, u2, v2, ...; three exact GPs with an ARD squared-exponential kernel;
maximum marginal likelihood. `paper`: the same, trained with the paper's software and its defaults (paper_preset.py).

The stated covariance is that of a new noisy output: the function's plus the noise, since a pixel error of the
measurement moves the position as much as one in the training data did. Of `plain` and `paper` it is diagonal, because
the three GPs know nothing of each other; unless outputs are coregionalised: one kernel for correlated x, y and z
(gp/coregionalised.py), the paper's model with its "future work".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from implicam.calibrators.every_camera import (
    Scaling,
    flat_note,
    lattice_note,
    missing_view_reasons,
    pixels_of,
    scaling_arrays,
    scalings,
    seen_by_all,
)
from implicam.calibrators.inverse_gp_settings import DEFAULT_SETTINGS, OF_PAPER_PRESET, OF_SMOOTH, InverseGPSettings
from implicam.calibrators.inverse_maps import Map, SmoothMap, ThreeMaps, is_principal, learn_smooth
from implicam.calibrators.pixel_cloud import PixelCloud
from implicam.calibrators.position_processes import PositionProcess, PositionProcesses
from implicam.calibrators.protocol import (
    Arrays,
    CalibrationBase,
    CalibratorBase,
    CheckPlan,
    FitSummary,
    finite_column,
    option,
    per_axis,
)
from implicam.dataset import Dataset, Floats, Observations, describe_copies, remove_copies
from implicam.dataset.requirements import match_cameras, observations_of, require_dataset
from implicam.dataset.unused import Unused
from implicam.errors import UsageError, did_you_mean
from implicam.gp import SHAPES, Fit, GaussianProcess, Kernel, Smoothness, maximise_each
from implicam.gp.coregionalised import maximise_coregionalised
from implicam.gp.linalg import covariance_root, solve_lower
from implicam.measurement import Measurement, SharedErrors
from implicam.progress import Progress, silent
from implicam.threads import side_by_side

PRESETS = ("smooth", "plain", "paper")
INDEPENDENT, COREGIONALISED = "independent", "coregionalised"
OUTPUTS = (INDEPENDENT, COREGIONALISED)
FORMER_PRESETS = {"standardised": "plain"}
"""Name in earlier versions -> name now."""
UNIFORM_EXTENT_SDS = 2 * 3**0.5  # what a uniform spread extends over, in its standard deviations


@dataclass(frozen=True, eq=False)
class Hyperparameters:
    """Of one output: kernel, noise variance and constant mean, all in standardised units."""

    kernel: Kernel
    noise_variance: float
    mean: float = 0.0


@dataclass(frozen=True)
class InverseGP(CalibratorBase):
    """kernel: `squared-exponential` or `matern-5/2`; preset: `smooth`, `plain` or `paper`; outputs: of `plain`,
    `independent` as in the paper, or `coregionalised`, which makes the preset `plain`.

    shortest_lengthscale: bound of every lengthscale, in standard deviations of the pixels. Optics are smooth across
    the image, so by default it is the extent of the pixels themselves (docs/decisions/0004-lattices.md).
    settings: all priors and thresholds; a calibration file carries them, so that a refit years later is the same fit.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> ic.InverseGP().fit(rig).measure(rig).xyz.shape
    (30, 3)
    """

    kernel: str = field(default="squared-exponential", metadata=option(" or ".join(SHAPES)))
    preset: str = field(
        default="smooth", metadata=option('smooth; "plain", the paper\'s model; "paper", its own software')
    )
    outputs: str = field(
        default=INDEPENDENT,
        metadata=option('independent, or "coregionalised": one kernel for correlated x, y and z (preset plain)'),
    )
    seed: int = 0
    shortest_lengthscale: float = UNIFORM_EXTENT_SDS
    settings: InverseGPSettings = DEFAULT_SETTINGS

    method: ClassVar[str] = "inverse-gp"
    compared_variants: ClassVar[tuple[str, ...]] = ("paper",)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "preset", FORMER_PRESETS.get(self.preset, self.preset))
        for what, value, known in (
            ("kernel", self.kernel, SHAPES),
            ("preset", self.preset, PRESETS),
            ("outputs", self.outputs, OUTPUTS),
        ):
            if value not in known:
                raise UsageError(
                    f"inverse-gp has no {what} {value!r}{did_you_mean(value, known)}.",
                    fix=f"choose one of {', '.join(known)}",
                )
        if self.outputs == COREGIONALISED and self.preset == "paper":
            raise UsageError(
                "the paper preset has independent outputs only.", fix="--preset plain --outputs coregionalised"
            )
        if self.outputs == COREGIONALISED:  # `smooth` has one process for correlated outputs as it is
            object.__setattr__(self, "preset", "plain")
        if not 0 < self.shortest_lengthscale < np.inf:
            raise UsageError(f"shortest_lengthscale is {self.shortest_lengthscale!r}; it must be positive and finite.")
        if self.preset == "paper" and self.kernel != "squared-exponential":
            raise UsageError("the paper preset has the squared-exponential kernel only.", fix="leave out --kernel")

    @classmethod
    def variants(cls) -> dict[str, dict[str, Any]]:
        """The presets, the kernels, and coregionalised outputs."""
        presets = {preset: {"preset": preset} for preset in PRESETS}
        return presets | {shape: {"kernel": shape} for shape in SHAPES} | {COREGIONALISED: {"outputs": COREGIONALISED}}

    @property
    def library(self) -> tuple[str, str] | None:
        """The paper's preset is trained with the paper's software."""
        return ("gpytorch", "paper") if self.preset == "paper" else None

    @property
    def idle_settings(self) -> frozenset[str]:
        """Names of the settings that do nothing with this preset."""
        used_by = {"smooth": OF_SMOOTH, "paper": OF_PAPER_PRESET}
        return frozenset(name for preset, names in used_by.items() if preset != self.preset for name in names)

    def fit(self, data: Dataset, progress: Progress = silent) -> InverseGPCalibration:
        """Fit to the points that every camera saw; the others are listed in `unused`, with the reason.

        Args:
            data: Known points and what the cameras saw of them.
            progress: Is told how far the fit is.

        Returns:
            The calibration.

        Raises:
            FitError: There are too few points that every camera saw.
            MissingExtraError: The preset is `paper`, and its software is not installed.
            NumericalError: No search for the hyperparameters succeeded.
        """
        require_dataset(data)
        if self.preset == "smooth":
            return self._fitted_smooth(data, progress)
        if self.preset == "paper":
            from implicam.calibrators.paper_preset import train
        else:
            train = _train
        return self._fitted(data, train, progress)

    def _fitted(self, data: Dataset, train: Train, progress: Progress) -> InverseGPCalibration:
        usable, unused = seen_by_all(data, self.method)
        inputs, outputs = pixels_of(usable), usable.xyz
        pixels, positions = Scaling.of(inputs), Scaling.of(outputs)
        if self.preset == "paper":  # it never standardised its positions: they are in metres, from the robot's origin
            positions = Scaling(np.zeros(3), np.full(3, 1.0 / data.metres_per_unit))
        X, Y = pixels.apply(inputs), positions.apply(outputs)
        hyper = train(self, X, Y, progress)
        if self.outputs == INDEPENDENT:
            return InverseGPCalibration(self, data, unused, pixels, positions, hyper)
        starts = [Fit(h.kernel, h.noise_variance, 0.0) for h in hyper]
        found = maximise_coregionalised(X, Y, self.kernel, starts, shortest=self.shortest_lengthscale)
        hyper = tuple(Hyperparameters(kernel, 1.0) for kernel in found.kernels)
        return InverseGPCalibration(self, data, unused, pixels, positions, hyper, mixing=found.mixing)

    def _fitted_smooth(
        self, data: Dataset, progress: Progress, start: tuple[Smoothness, bool] | None = None, anew: bool = True
    ) -> InverseGPCalibration:
        usable, unused = seen_by_all(data, self.method)
        inputs, outputs = pixels_of(usable), usable.xyz
        pixels, positions = Scaling.of(inputs), Scaling.of(outputs)
        X, Y = pixels.apply(inputs), positions.apply(outputs)
        progress("fitting", 0, 1)
        found = learn_smooth(
            X, Y, pixels.scale, self.kernel, self.shortest_lengthscale, self.seed, self.settings, start, anew=anew
        )
        progress("fitting", 1, 1)
        return InverseGPCalibration(self, data, unused, pixels, positions, (), *found)


Train = Callable[[InverseGP, Floats, Floats, Progress], tuple[Hyperparameters, ...]]
"""Hyperparameters of three outputs (n, 3) at inputs (n, d), both standardised."""


def _train(
    method: InverseGP, X: Floats, Y: Floats, progress: Progress, starts: Sequence[Fit] = (), anew: bool = True
) -> tuple[Hyperparameters, ...]:
    """Our own fit, the three outputs side by side."""
    fits = maximise_each(
        X,
        Y,
        method.kernel,
        shortest=method.shortest_lengthscale,
        seed=method.seed,
        done=lambda done, of: progress("fitting", done, of),
        starts=starts,
        anew=anew,
    )
    return tuple(Hyperparameters(fit.kernel, fit.noise_variance) for fit in fits)


@dataclass(frozen=True, eq=False, repr=False)
class InverseGPCalibration(CalibrationBase):
    """GPs conditioned on the known points that every camera saw.

    hyperparameters: of the three of `plain` and `paper`; smoothness and basis: of the one of `smooth`; mixing (3, 3):
    of coregionalised outputs, the three are of `positions @ mixing`.

    >>> import implicam as ic
    >>> rig = ic.simulated("stereo", points=30, seed=1)
    >>> ic.InverseGP().fit(rig).method
    'inverse-gp'
    """

    calibrator: InverseGP
    data: Dataset
    unused: tuple[Unused, ...]
    pixels: Scaling
    positions: Scaling
    hyperparameters: tuple[Hyperparameters, ...] = field(repr=False)
    smoothness: Smoothness | None = field(default=None, repr=False)
    basis: Floats | None = field(default=None, repr=False)
    mixing: Floats | None = field(default=None, repr=False)

    method: ClassVar[str] = "inverse-gp"

    @cached_property
    def used(self) -> Dataset:
        """The data without the points and cameras that are there twice."""
        return remove_copies(self.data, cameras_too=True)

    @property
    def check_plan(self) -> CheckPlan:
        """A few fits to a hundred points: they take seconds."""
        return CheckPlan(folds=3, fits=1 if self.calibrator.preset == "paper" else 3, max_points=120)

    @cached_property
    def processes(self) -> tuple[GaussianProcess, ...]:
        """The three conditioned GPs of `plain` and `paper`, in standardised units; none of `smooth`."""
        X, Y = self._known
        Y = Y if self.mixing is None else Y @ self.mixing

        def one(pair: tuple[Hyperparameters, Floats]) -> GaussianProcess:
            h, y = pair
            return GaussianProcess.condition(h.kernel, h.noise_variance, X, y, h.mean)

        return tuple(side_by_side(one, list(zip(self.hyperparameters, Y.T, strict=False))))

    @cached_property
    def map(self) -> Map:
        """From standardised pixels to standardised positions."""
        if self.smoothness is None or self.basis is None:
            axes = np.eye(3) if self.mixing is None else np.linalg.inv(self.mixing)
            return ThreeMaps(self.processes, np.asarray(axes, dtype=np.float64))
        return SmoothMap.condition(
            self.smoothness, self.basis, self.pixels.scale, *self._known, self.calibrator.settings
        )

    @cached_property
    def cloud(self) -> PixelCloud:
        """The pixels that it has learned from."""
        return PixelCloud.of(pixels_of(self._usable), self.calibrator.settings)

    def farness(self, uv: Floats) -> Floats:
        """The factor by which error bars grow away from the pixels learned from; what is beyond `farthest` is not
        measured.

        Args:
            uv: (k, d) concatenated pixels.

        Returns:
            (k,) 1 among the pixels learned from, and everywhere for the presets `plain` and `paper`, which know nothing
            of it.
        """
        if self.smoothness is None:
            return np.ones(len(uv))
        return np.maximum(self.cloud.farness(uv), 1.0)

    @property
    def _usable(self) -> Dataset:
        return self.used.select(self.used.observations.seen.all(axis=1))

    @property
    def _known(self) -> tuple[Floats, Floats]:
        """Standardised pixels (n, d) and positions (n, 3)."""
        usable = self._usable
        return self.pixels.apply(pixels_of(usable)), self.positions.apply(usable.xyz)

    def measure(self, observations: Observations | Dataset) -> Measurement:
        """Measure the points that every camera saw, and whose pixels are like those learned from (`smooth`).

        Args:
            observations: What the cameras saw, by their names; or a dataset that has it.

        Returns:
            Positions in the world with their covariances; other points keep their row, with a reason.

        Raises:
            DatasetError: A camera of the calibration is missing, or has images of another size.
        """
        observations = match_cameras(self.used.observations, observations_of(observations))
        seen = observations.seen
        reason = missing_view_reasons(seen, observations.camera_names, self.method).astype(object)
        complete = np.flatnonzero(seen.all(axis=1))
        n = len(observations)
        xyz, cov, share = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), np.full(n, np.nan)
        uv = observations.uv[complete].reshape(-1, 2 * len(observations.cameras))
        far = self.farness(uv)
        reason[complete[far > self.farthest]] = [unlike_reason(f) for f in far[far > self.farthest]]
        complete, uv, far = complete[far <= self.farthest], uv[far <= self.farthest], far[far <= self.farthest]
        mean, covariance = self.map.predict(self.pixels.apply(uv))
        scale, offset = self.positions.scale, self.positions.offset
        xyz[complete] = mean * scale + offset
        cov[complete] = covariance * np.outer(scale, scale) * far[:, None, None] ** 2
        from_noise = np.sum(np.diag(self.map.noise) * scale**2)
        share[complete] = np.clip(1 - from_noise / np.trace(cov[complete], axis1=1, axis2=2), 0.0, 1.0)
        return Measurement(
            observations.points,
            xyz,
            cov,
            seen.sum(axis=1),
            np.full(n, np.nan),  # a map from all pixels to a position cannot ask whether the views agree
            reason.astype(np.str_),
            self.data.length_unit,
            share_calibration=share,
            shared=SharedErrors(partial(self._shared_errors, observations.uv), np.arange(n), np.eye(3)),
        )

    def _shared_errors(self, uv: Floats, rows: NDArray[np.int64]) -> Floats:
        """(k, 3, 3 k) of measured points: a root of the joint covariance of the function at their pixels. What is
        uncertain of lengthscales counts as each point's own."""
        at = self.position_processes(uv[rows])
        everywhere = slice(None)
        joint = sum(np.kron(one.covariance(everywhere, everywhere), one.share) for one in at.processes)
        root = covariance_root(np.asarray(joint)).reshape(len(rows), 3, -1)
        return np.asarray(np.sqrt(at.widened)[:, None, None] * root, dtype=np.float64)

    def position_processes(self, uv: Floats) -> PositionProcesses:
        """What the processes say of places together; for one that a camera does not see, what they would say at the
        middle of the data.

        Args:
            uv: (n, cameras, 2) the pixels of the places, NaN where not seen.

        Returns:
            The processes at these places, in squared length units of the world.
        """
        pixels = self.pixels.apply(uv.reshape(len(uv), -1))
        pixels = np.where(np.isfinite(pixels), pixels, 0.0)
        square = np.outer(self.positions.scale, self.positions.scale)
        X = self.map.inputs(pixels)
        known = [solve_lower(part.process.L, part.process.kernel(part.process.X, X)) for part in self.map.parts]
        processes = tuple(
            PositionProcess(
                part.process.kernel, part.process.noise_variance, part.share * square, part.outputs, X, V, W
            )
            for part, V, W in zip(self.map.parts, known, self.map.drift(pixels, known), strict=True)
        )
        far = self.farness(pixels * self.pixels.scale + self.pixels.offset)
        widened = np.where(far > self.farthest, np.nan, far**2)
        return PositionProcesses(processes, self.map.uncertain(pixels) * square, widened)

    def condition_on(self, data: Dataset) -> InverseGPCalibration:
        """The same hyperparameters, with these known points.

        Args:
            data: All known points from now on, of the same cameras.

        Returns:
            The calibration, with the same scaling of pixels and positions.
        """
        return replace(self, data=data)

    def refit_from(self, data: Dataset, progress: Progress = silent, *, anew: bool = False) -> InverseGPCalibration:
        """As `refit`, starting from what is known, for some points more. The paper's preset always starts from its
        defaults.

        Args:
            data: All known points from now on.
            progress: Is told how far the fit is.
            anew: Start from no guess as well; the more probable of both counts.

        Returns:
            The new calibration.

        Raises:
            FitError: There are too few points that every camera saw.
        """
        if self.calibrator.preset == "paper":
            return self.calibrator.fit(data, progress)
        if self.smoothness is not None and self.basis is not None:
            known = self.smoothness, is_principal(self.basis)
            return self.calibrator._fitted_smooth(data, progress, known, anew)
        usable, _ = seen_by_all(data, self.method)
        ratio = self.pixels.scale / Scaling.of(pixels_of(usable)).scale  # lengthscales are in standard deviations
        starts = [
            Fit(replace(h.kernel, lengthscale=h.kernel.lengthscale * ratio), h.noise_variance, 0.0)
            for h in self.hyperparameters
        ]
        return self.calibrator._fitted(data, partial(_train, starts=starts, anew=anew), progress)

    @property
    def notes(self) -> list[str]:
        """What the user should know before trusting this calibration; empty where all is well."""
        flat = flat_note(self.data) or self._thin_note()
        return [
            *describe_copies(self.data),
            *flat,
            *lattice_note(self.data, self.method, self.calibrator.settings),
            *self._suspects(),
            *self.calibrator.idle_settings_note(),
        ]

    @cached_property
    def _thickness(self) -> tuple[float, float]:
        """Rms thickness of the known positions, whichever way they lie flat, and the rms leave-one-out error there."""
        xyz = self._usable.xyz
        normal = np.linalg.svd(xyz - xyz.mean(axis=0))[2][-1]
        errors, _ = self.map.leave_one_out()
        across = (errors * self.positions.scale) @ normal
        return float(np.std(xyz @ normal)), float(np.sqrt(np.mean(across**2)))

    @cached_property
    def farthest(self) -> float:
        """How far pixels may be and still be measured: less where the known positions are nearly in one plane."""
        settings = self.calibrator.settings
        return settings.max_plane_distance_ratio if self._is_thin else settings.max_distance_ratio

    @property
    def _is_thin(self) -> bool:
        """Whether the known positions are no thicker than what the pixels tell of them."""
        thickness, error = self._thickness
        return not error < self.calibrator.settings.max_thin_error_ratio * thickness

    def _thin_note(self) -> list[str]:
        """A note on known points that are no thicker than what the pixels tell of them."""
        if not self._is_thin:
            return []
        (thickness, error), unit = self._thickness, self.data.length_unit
        most = self.calibrator.settings.max_thin_error_ratio
        errors = self.map.leave_one_out()[0] * self.positions.scale
        if (np.sqrt(np.mean(errors**2, axis=0)) > most * np.std(self._usable.xyz, axis=0)).all():
            return [
                "The pixels tell little of any coordinate of the known positions: they are too few, or some are wrong."
            ]
        return [
            f"The known positions lie nearly in one plane: {thickness:.2g} {unit} (rms) thick, of which the pixels "
            f"tell to {error:.2g} {unit}. Positions off it are not measured but guessed: add known points in front of "
            "it and behind."
        ]

    def _suspects(self) -> list[str]:
        """Known points that the others contradict: a wrong detection, a wrong position."""
        errors, variances = self.map.leave_one_out()
        worst = np.max(np.abs(errors) / np.sqrt(variances), axis=1)
        names = self.used.points[self.used.observations.seen.all(axis=1)]
        most = self.calibrator.settings.max_left_out_error_sds
        found = [f"{names[i]} ({worst[i]:.0f} sd)" for i in np.argsort(-worst) if worst[i] > most]
        if not found:
            return []
        more = f" and {len(found) - 5} more" if len(found) > 5 else ""
        return [
            f"{len(found)} known point{'s' * (len(found) > 1)} far from what all others predict: "
            f"{', '.join(found[:5])}{more}. Look for a wrong detection or position: nothing is rejected here."
        ]

    def summary(self) -> FitSummary:
        """Leave-one-out errors of the known points: in closed form, hyperparameters kept."""
        errors, variances = self.map.leave_one_out()
        sds = np.sqrt(variances) * self.positions.scale
        return FitSummary(
            points_used=len(errors),
            points_unused=len(self.unused),
            leave_one_out_rms=per_axis(np.sqrt(np.mean(errors**2, axis=0)) * self.positions.scale),
            leave_one_out_mean_sd=per_axis(np.mean(sds, axis=0)),
        )

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Options, and the hyperparameters in standardised units with the scaling."""
        h = self.hyperparameters
        table = self.calibrator.as_table()
        if self.smoothness is not None and self.basis is not None:
            return table, {
                **scaling_arrays(self.pixels, self.positions),
                "basis": self.basis,
                "lengthscale": self.smoothness.lengthscale,
                "noise_ratio": np.array([self.smoothness.noise_ratio]),
                "uncertainty": self.smoothness.root,
            }
        arrays = {
            **scaling_arrays(self.pixels, self.positions),
            "lengthscale": np.stack([x.kernel.lengthscale for x in h]),
            "signal_variance": np.array([x.kernel.signal_variance for x in h]),
            "noise_variance": np.array([x.noise_variance for x in h]),
            "mean": np.array([x.mean for x in h]),
        }
        if self.mixing is not None:
            arrays["mixing"] = self.mixing
        return table, arrays

    @classmethod
    def from_state(cls, data: Dataset, table: Mapping[str, Any], arrays: Arrays) -> InverseGPCalibration:
        """Restore a calibration; the factors are computed again, which takes less time than reading them would.

        Args:
            data: That it was fitted to.
            table: Of `state`.
            arrays: Of `state`.

        Returns:
            The calibration.

        Raises:
            KeyError, ValueError, TypeError: Something is missing or does not fit.
        """
        calibrator = InverseGP.from_table({"outputs": INDEPENDENT, **table})  # files had none before
        _, unused = seen_by_all(data, cls.method)
        used = remove_copies(data, cameras_too=True)
        d = 2 * len(used.cameras)
        pixels, positions = scalings(arrays, used)
        if calibrator.preset == "smooth":
            smoothness = Smoothness(
                calibrator.kernel,
                finite_column(arrays, "lengthscale", (d,), positive=True),
                float(finite_column(arrays, "noise_ratio", (1,), positive=True)[0]),
                finite_column(arrays, "uncertainty", (d + 1, d + 1)),
            )
            return cls(
                calibrator, data, unused, pixels, positions, (), smoothness, finite_column(arrays, "basis", (d, d))
            )
        lengthscale = finite_column(arrays, "lengthscale", (3, d), positive=True)
        signal = finite_column(arrays, "signal_variance", (3,), positive=True)
        noise, mean = finite_column(arrays, "noise_variance", (3,), positive=True), finite_column(arrays, "mean", (3,))
        hyper = tuple(
            Hyperparameters(
                Kernel(calibrator.kernel, float(signal[i]), lengthscale[i]), float(noise[i]), float(mean[i])
            )
            for i in range(3)
        )
        mixing = None
        if calibrator.outputs == COREGIONALISED:
            mixing = finite_column(arrays, "mixing", (3, 3))
            if np.linalg.matrix_rank(mixing) < 3:
                raise ValueError("the mixing of the outputs is singular")
        return cls(calibrator, data, unused, pixels, positions, hyper, mixing=mixing)


def unlike_reason(far: float) -> str:
    """Why pixels so far from all known points are not measured.

    Args:
        far: Times as far as the farthest of the known points from the others.

    Returns:
        The reason in words.
    """
    return (
        f"pixels unlike any it has learned: {far:.0f} times as far from the known points' as the farthest of these "
        "(a wrong match, or a place away from where known points are)"
    )
