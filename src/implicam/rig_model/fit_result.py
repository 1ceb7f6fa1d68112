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
    """cameras: numbers of those that could be fitted, in order, as posterior.models. uncalibrated: (number, why) of the
    others. inliers: per fitted camera (n seen,) the views used. errors: how known positions are off, where they are;
    label_sd (1, k) its estimated sds, for error bars. tails: of the pixel noise, where it is not normal. label_errors:
    how single known positions are off besides, if they are; plane_sd (6,): how planes may be off that are too few to
    tell. ordinary_px: per fitted camera, see `InitialCamera`."""

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
        """The median error, px, that an ordinary camera would leave in fitted camera `number`; NaN if it is one."""
        return self.ordinary_px[number] if self.ordinary_px else float("nan")
