"""Predicted against realised: rigs are built as the drawing says, calibrated by forward-gp, and measure."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from implicam.calibrators import ForwardGP
from implicam.dataset import Floats
from implicam.design.prediction import Prediction
from implicam.errors import FitError
from implicam.progress import Progress, silent
from implicam.simulate import Placement, Target, build_rig, simulate

CHECK_SEED_OFFSET = 1_000_003
"""From the seed of the known points to that of the positions to judge by."""


@dataclass(frozen=True, eq=False)
class Realised:
    """What rigs as built measured at the places of a prediction.

    Attributes:
        predicted: (n, 3) variances along the axes that were predicted, NaN where nothing was.
        errors: (rigs, n, 3) true errors, NaN where nothing was measured.
        variances: (rigs, n, 3) as the rigs stated them.
        failed: Why rigs could not be calibrated; they are not among those above.
    """

    predicted: Floats
    errors: Floats
    variances: Floats
    failed: tuple[str, ...] = ()

    @cached_property
    def common(self) -> Floats:
        """(rigs, n, 1) one where something was both predicted and measured, else NaN."""
        both = np.isfinite(self.predicted[:, :1]) & np.isfinite(self.errors[..., :1])
        return np.where(both, 1.0, np.nan)

    @property
    def predicted_rms(self) -> Floats:
        """(3,) predicted along the axes, over what was measured."""
        return _rms(np.sqrt(self.predicted) * self.common)

    @property
    def error_rms(self) -> Floats:
        """(3,) of the true errors along the axes."""
        return _rms(self.errors * self.common)

    @property
    def stated_rms(self) -> Floats:
        """(3,) of the stated standard deviations along the axes."""
        return _rms(np.sqrt(self.variances) * self.common)

    @property
    def error_ratio(self) -> tuple[float, float]:
        """The rms error over that predicted, all axes together, and its standard error over the rigs."""
        return self._ratio(self.errors)

    @property
    def stated_ratio(self) -> tuple[float, float]:
        """The same of the stated standard deviation."""
        return self._ratio(np.sqrt(self.variances))

    def _ratio(self, values: Floats) -> tuple[float, float]:
        counted = self.common[..., 0]
        squares = np.nanmean(np.sum(values**2, axis=2) * counted, axis=1)
        predicted = np.nanmean(np.sum(self.predicted, axis=1) * counted, axis=1)
        whole = float(np.sqrt(np.mean(squares) / np.mean(predicted)))
        if len(squares) < 2:
            return whole, np.nan
        sd = float(np.std(squares / np.mean(predicted), ddof=1) / np.sqrt(len(squares)))
        return whole, sd / (2 * whole)


def realise(
    placement: Placement, prediction: Prediction, rigs: int, *, seed: int = 0, progress: Progress = silent
) -> Realised:
    """Build rigs as a drawing says, calibrate each from the known points, and measure at the places of the prediction.

    Args:
        placement: The drawing.
        prediction: Of this drawing.
        rigs: How many.
        seed: Of the first one.
        progress: Is told how far it is.

    Raises:
        FitError: None of the rigs can be calibrated.
    """
    found, failed = [], []
    for done, built in enumerate(range(seed, seed + rigs), 1):
        try:
            found.append(_measured(placement, prediction, built))
        except FitError as error:  # what as drawn sees just enough known points may see one too few as built
            failed.append(error.what)
        progress("building rigs", done, rigs)
    if not found:
        raise FitError(
            f"none of {rigs} rigs built like this can be calibrated.",
            why=failed[0],
            fix="plan more known points, or cameras that see more of the workspace",
        )
    errors, variances = (np.stack(parts) for parts in zip(*found, strict=True))
    predicted = np.diagonal(prediction.predicted.total, axis1=1, axis2=2)
    return Realised(predicted, errors, variances, tuple(failed))


def _measured(placement: Placement, prediction: Prediction, seed: int) -> tuple[Floats, Floats]:
    """Errors and stated variances (n, 3) of one rig."""
    assumed, unit = prediction.assumed, prediction.rig.length_unit
    rig = build_rig(
        placement,
        seed=seed,
        lens_error=assumed.lens_error,
        noise=assumed.noise,
        frame="bench",
        unit=unit,  # type: ignore[arg-type]
        cameras=",".join(camera.name for camera in prediction.rig.cameras),
    )
    known = simulate(rig, _balls(prediction.known), seed=seed, robot_noise=assumed.position_sd)
    shown = simulate(rig, _balls(prediction.places), seed=seed + CHECK_SEED_OFFSET)
    measured = ForwardGP().fit(known).measure(shown.observations)
    return measured.xyz - prediction.places, np.diagonal(measured.cov, axis1=1, axis2=2)


def _balls(xyz: Floats) -> Target:
    names = np.array([f"p{i + 1:05d}" for i in range(len(xyz))])
    return Target("design", names, names, xyz)


def _rms(values: Floats) -> Floats:
    return np.asarray(np.sqrt(np.nanmean(values**2, axis=(0, 1))), dtype=np.float64)


def as_rows(found: Realised) -> list[tuple[str, float, float, float]]:
    """Axis, predicted, rms error and stated standard deviation, for x, y, z and all axes together.

    Args:
        found: What was predicted, measured and stated.

    Returns:
        Four rows, in the length unit of `found`.
    """
    columns = [found.predicted_rms, found.error_rms, found.stated_rms]
    whole = [float(np.linalg.norm(column)) for column in columns]
    each = [(axis, *(float(column[i]) for column in columns)) for i, axis in enumerate("xyz")]
    return [*each, ("all", *whole)]  # type: ignore[list-item]
