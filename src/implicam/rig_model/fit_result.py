"""What a fit finds: the posterior of the cameras, the views in use, and how known positions and pixels are off."""

from __future__ import annotations

from dataclasses import dataclass

from implicam.geometry import Bools, Floats
from implicam.rig_model.field import Hyperparameters
from implicam.rig_model.heavy_tails import HeavyTails
from implicam.rig_model.position_errors import PositionErrors
from implicam.rig_model.posterior import Posterior
from implicam.rig_model.shot_errors import ShotErrors


@dataclass(frozen=True, eq=False)
class FitResult:
    """The posterior of the cameras that could be fitted, the views in use, and how positions and pixels are off.

    Attributes:
        posterior: What is known of the fitted cameras, in the working frame.
        cameras: Their numbers in the dataset, in the order of `posterior.models`.
        uncalibrated: (number, why) of the others.
        inliers: Per fitted camera (n seen,), the views used.
        hyperparameters: Of their fields and noise.
        errors: How known positions are off with their shots; None where they are not.
        label_sd: (1, k) the estimated sds of these, for error bars.
        tails: Of the pixel noise; None where it is normal.
        position_errors: How single known positions are off besides; None where they are not.
        plane_sd: (6,) how planes that are too few to tell may be off; None where there are none.
        ordinary_px: Per fitted camera, see `InitialCamera`; empty where no other camera was tried.
    """

    posterior: Posterior
    cameras: tuple[int, ...]
    uncalibrated: tuple[tuple[int, str], ...]
    inliers: tuple[Bools, ...]
    hyperparameters: Hyperparameters
    errors: ShotErrors | None
    label_sd: Floats | None
    tails: HeavyTails | None = None
    position_errors: PositionErrors | None = None
    plane_sd: Floats | None = None
    ordinary_px: tuple[float, ...] = ()

    def left_by_ordinary(self, number: int) -> float:
        """The median error that an ordinary camera would leave in a fitted camera.

        Args:
            number: Of the camera, in the order of `posterior.models`.

        Returns:
            In pixels; NaN where no other camera was tried.
        """
        return self.ordinary_px[number] if self.ordinary_px else float("nan")
