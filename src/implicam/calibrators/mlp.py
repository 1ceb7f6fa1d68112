"""mlp, the paper's neural network: the pixels of all cameras in, the position out.

De Boi et al., "Implicit Multi-Camera System Calibration Using Gaussian Processes", section "Moving Ball in Grid".
Network: mlp_network.py; training: mlp_training.py. Inputs and outputs are standardised.

Position: the network with every unit at work. Covariance: the spread of passes with random dropout. Dropout is a device
of training, and nothing makes its spread as large as the error, so a calibration counts on the points it kept for early
stopping how many lie within the error bars, and always says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

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
from implicam.calibrators.mlp_network import Network, draw_masks, layer_shapes
from implicam.calibrators.mlp_settings import DEFAULT_SETTINGS, MLPSettings
from implicam.calibrators.mlp_training import Examples, train
from implicam.calibrators.protocol import Arrays, CalibrationBase, CalibratorBase, FitSummary, finite_column, per_axis
from implicam.dataset import Dataset, Floats, Observations, describe_copies, remove_copies
from implicam.dataset.requirements import match_cameras, observations_of, require_dataset
from implicam.dataset.unused import Unused
from implicam.errors import FitError, UsageError
from implicam.formatting import percent
from implicam.measurement import Measurement
from implicam.progress import Progress, silent
from implicam.threads import blas_threads

MAX_DROPOUT = 0.9  # with more, many passes have no unit at work in the last layer
INTERVAL_95_SDS = 1.959964  # standard deviations of a normal distribution
SPLIT, SPREAD = 0, 3  # streams of random numbers of one seed; mlp_training.py has others


@dataclass(frozen=True)
class MLP(CalibratorBase):
    """The paper's network. dropout: probability that a hidden unit is switched off, 0 to 0.9.

    With dropout = 0 there is no spread, and the error bars are the rms errors of the points kept for early stopping.
    settings: all thresholds; a calibration file carries them, so that a refit years later is the same fit.

    >>> import implicam as ic
    >>> ic.MLP().method
    'mlp'
    """

    seed: int = 0
    dropout: float = 0.2
    settings: MLPSettings = DEFAULT_SETTINGS

    method: ClassVar[str] = "mlp"
    compared_variants: ClassVar[tuple[str, ...]] = ("no-dropout",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.dropout <= MAX_DROPOUT:
            raise UsageError(
                f"dropout is {self.dropout!r}; it must be between 0 and {MAX_DROPOUT}.",
                why="it is the probability that a hidden unit is switched off",
                fix="the paper has 0.2",
            )

    @classmethod
    def variants(cls) -> dict[str, dict[str, Any]]:
        """Without dropout."""
        return {"no-dropout": {"dropout": 0.0}}

    @property
    def library(self) -> tuple[str, str]:
        """The network is trained with PyTorch."""
        return "torch", "mlp"

    def fit(self, data: Dataset, progress: Progress = silent) -> MLPCalibration:
        """Fit to the points that every camera saw; the others are listed in `unused`, with the reason.

        Args:
            data: Known points and what the cameras saw of them.
            progress: Is told how far the training is.

        Returns:
            The calibration.

        Raises:
            FitError: There are too few points that every camera saw.
            MissingExtraError: PyTorch is not installed.
        """
        require_dataset(data)
        (found,) = self.fit_many([data], progress)
        if isinstance(found, FitError):
            raise found
        return found

    def fit_many(self, datasets: Sequence[Dataset], progress: Progress = silent) -> list[MLPCalibration | FitError]:
        """Fit to each dataset, number i with seed + i, as `fit` would; those with equally many points as one batch.

        Args:
            datasets: Known points and what the cameras saw of them.
            progress: Is told how far the training is.

        Returns:
            The calibrations in this order; in the place of one that cannot be made, its FitError.

        Raises:
            MissingExtraError: PyTorch is not installed.
        """
        prepared = [_prepare(replace(self, seed=self.seed + i), data) for i, data in enumerate(datasets)]
        examples = [ready.examples for ready in prepared if isinstance(ready, _Prepared)]
        trained = iter(train(examples, self.dropout, progress, self.settings))
        return [
            ready if isinstance(ready, FitError) else MLPCalibration(*ready[:-1], network=next(trained).network)
            for ready in prepared
        ]


class _Prepared(NamedTuple):
    """All that a calibration needs but the network, and what that is trained from."""

    calibrator: MLP
    data: Dataset
    unused: tuple[Unused, ...]
    held_out: NDArray[np.bool_]
    pixels: Scaling
    positions: Scaling
    examples: Examples


def _prepare(method: MLP, data: Dataset) -> _Prepared | FitError:
    """Split and standardise; the scaling, too, knows only the points that the weights are fitted to."""
    try:
        usable, unused = seen_by_all(data, method.method)
    except FitError as error:
        return error
    X, Y = pixels_of(usable), usable.xyz
    held_out = _split(len(usable), method.seed, method.settings.held_out_share)
    pixels, positions = Scaling.of(X[~held_out]), Scaling.of(Y[~held_out])
    examples = Examples(pixels.apply(X), positions.apply(Y), held_out, method.seed)
    return _Prepared(method, data, unused, held_out, pixels, positions, examples)


def _split(n: int, seed: int, share: float) -> NDArray[np.bool_]:
    """(n,) which points are kept for early stopping."""
    held_out = np.zeros(n, dtype=np.bool_)
    order = np.random.default_rng([seed, SPLIT]).permutation(n)
    held_out[order[: min(max(1, round(share * n)), n - 1)]] = True
    return held_out


@dataclass(frozen=True, eq=False, repr=False)
class MLPCalibration(CalibrationBase):
    """A trained network, and which of the usable known points (n,) were kept for early stopping.

    >>> import implicam as ic
    >>> ic.MLPCalibration.method
    'mlp'
    """

    calibrator: MLP
    data: Dataset
    unused: tuple[Unused, ...]
    held_out: NDArray[np.bool_]
    pixels: Scaling
    positions: Scaling
    network: Network = field(repr=False)

    method: ClassVar[str] = "mlp"

    @cached_property
    def used(self) -> Dataset:
        """The data without the points and cameras that are there twice."""
        return remove_copies(self.data, cameras_too=True)

    def measure(self, observations: Observations | Dataset) -> Measurement:
        """Measure the points that every camera saw.

        Args:
            observations: What the cameras saw, by their names; or a dataset that has it.

        Returns:
            Positions in the world with their covariances; other points keep their row, with a reason.

        Raises:
            DatasetError: A camera of the calibration is missing, or has images of another size.
        """
        observations = match_cameras(self.used.observations, observations_of(observations))
        seen = observations.seen
        complete = seen.all(axis=1)
        n = len(observations)
        xyz, cov = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
        uv = observations.uv[complete].reshape(-1, 2 * len(observations.cameras))
        xyz[complete], cov[complete] = self._predict(uv), self._covariance(uv)
        return Measurement(
            observations.points,
            xyz,
            cov,
            seen.sum(axis=1),
            np.full(n, np.nan),  # a map from all pixels to a position cannot ask whether the views agree
            missing_view_reasons(seen, observations.camera_names, self.method),
            self.data.length_unit,
        )

    def _predict(self, uv: Floats) -> Floats:
        """(n, 3) positions of pixels (n, 2 cameras)."""
        with blas_threads(1):
            return self.network.predict(self.pixels.apply(uv)) * self.positions.scale + self.positions.offset

    def _covariance(self, uv: Floats) -> Floats:
        """(n, 3, 3) dropout spread; without dropout the held-out points' mean squared errors, the same everywhere."""
        if not self.calibrator.dropout:
            squares = np.mean(self._held_out_errors**2, axis=0)
            return np.broadcast_to(np.diag(squares), (len(uv), 3, 3))
        rng = np.random.default_rng([self.calibrator.seed, SPREAD])
        masks = draw_masks(rng, self.calibrator.settings.dropout_passes, self.calibrator.dropout)
        with blas_threads(1):
            spread = self.network.spread(self.pixels.apply(uv), masks)
        return spread * np.multiply.outer(self.positions.scale, self.positions.scale)

    @cached_property
    def _kept(self) -> Dataset:
        """The points kept for early stopping, which no weight was fitted to; the epoch was chosen by them."""
        usable = self.used.select(self.used.observations.seen.all(axis=1))
        return usable.select(self.held_out)

    @cached_property
    def _held_out_errors(self) -> Floats:
        return self._predict(pixels_of(self._kept)) - self._kept.xyz

    @cached_property
    def _held_out_sds(self) -> Floats:
        return np.sqrt(np.diagonal(self._covariance(pixels_of(self._kept)), axis1=1, axis2=2))

    @property
    def _coverage(self) -> float:
        """Share of the held-out coordinates within their 95 % interval."""
        return float(np.mean(np.abs(self._held_out_errors) <= INTERVAL_95_SDS * self._held_out_sds))

    @property
    def notes(self) -> list[str]:
        """What the user should know before trusting this calibration: always what its error bars are worth."""
        return [
            self._worth_of_error_bars(),
            *describe_copies(self.data),
            *flat_note(self.data),
            *lattice_note(self.data, self.method, self.calibrator.settings),
        ]

    def _worth_of_error_bars(self) -> str:
        n = int(self.held_out.sum())
        known = f"the {n} known points" if n > 1 else "the one known point"
        if not self.calibrator.dropout:
            return (
                f"The error bars are the rms errors of {known} kept for early stopping, the same at every position: "
                "without dropout this network has no uncertainty of its own."
            )
        return (
            f"The error bars are dropout spread, not a measurement uncertainty: of the {3 * n} coordinates of {known} "
            f"kept for early stopping, {percent(self._coverage)} lie inside their 95 % bars."
        )

    def summary(self) -> FitSummary:
        """Errors of the points kept for early stopping, not of each left out in turn.

        The share inside the 95 % intervals flatters a little, because the epoch was chosen by these points; without
        dropout more, because then the intervals are made from them.
        """
        return FitSummary(
            points_used=len(self.held_out),
            points_unused=len(self.unused),
            leave_one_out_rms=per_axis(np.sqrt(np.mean(self._held_out_errors**2, axis=0))),
            leave_one_out_mean_sd=per_axis(self._held_out_sds.mean(axis=0)),
            held_out_points=int(self.held_out.sum()),
            held_out_in_95=self._coverage,
        )

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Options; weights, scalings and which points were kept for early stopping."""
        arrays: dict[str, NDArray[Any]] = {"held_out": self.held_out, **scaling_arrays(self.pixels, self.positions)}
        for k, (weight, bias) in enumerate(zip(self.network.weights, self.network.biases, strict=True)):
            arrays |= {f"weight{k}": weight, f"bias{k}": bias}
        return self.calibrator.as_table(), arrays

    @classmethod
    def from_state(cls, data: Dataset, table: Mapping[str, Any], arrays: Arrays) -> MLPCalibration:
        """Restore a calibration; PyTorch is not needed.

        Args:
            data: That it was fitted to.
            table: Of `state`.
            arrays: Of `state`.

        Returns:
            The calibration.

        Raises:
            KeyError, ValueError, TypeError: Something is missing or does not fit.
        """
        calibrator = MLP.from_table(table)
        usable, unused = seen_by_all(data, cls.method)
        held_out = arrays["held_out"]
        if held_out.dtype != np.bool_ or held_out.shape != (len(usable),) or held_out.all() or not held_out.any():
            raise ValueError(f"held_out must be {len(usable)} booleans, some true and some false")
        used = remove_copies(data, cameras_too=True)
        pixels, positions = scalings(arrays, used)
        shapes = list(enumerate(layer_shapes(2 * len(used.cameras))))
        network = Network(
            tuple(finite_column(arrays, f"weight{k}", shape) for k, shape in shapes),
            tuple(finite_column(arrays, f"bias{k}", shape[1:]) for k, shape in shapes),
            calibrator.settings.leaky_relu_slope_ratio,
        )
        return cls(calibrator, data, unused, held_out, pixels, positions, network)
