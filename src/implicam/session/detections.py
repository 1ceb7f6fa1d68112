"""What the cameras show of the ball, and which detections are plausible."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from implicam.calibrators import Calibration, PredictsPixels
from implicam.dataset import Floats
from implicam.detect import Detected
from implicam.hardware import Frame

MAX_DISTANCE_SDS = 6.0
"""A detection farther than this from the prediction is of another object ..."""

MAX_DISTANCE_PX = 8.0
"""... if it is also farther than this."""


@dataclass(frozen=True, eq=False)
class Look:
    """What one camera shows: its picture, what was found in it, why nothing was; where the target is expected, (2,)
    pixels, NaN where that is not known or it is not in view."""

    camera: str
    frame: Frame | None
    found: Detected
    expected: Floats

    @property
    def uv(self) -> Floats:
        """(2,) where the ball is, NaN for nowhere."""
        return self.found.uv[0] if len(self.found) else np.full(2, np.nan)


def reject_implausible(
    looks: tuple[Look, ...], where: Floats, where_sd: Floats, calibration: Calibration | None
) -> tuple[Look, ...]:
    """Leave out what is too far from where the ball must be, because it is something else.

    Args:
        looks: One for each camera of the calibration, in its order.
        where: (3,) where the ball is, in the calibration's world frame and unit.
        where_sd: (3,) standard uncertainty of `where` along x, y, z.
        calibration: Says where each camera must see the ball; where it predicts no pixels, all looks stay as they are.

    Returns:
        The looks; of several things that might be the ball the nearest, and where it is too far, nothing and a reason.
    """
    if not isinstance(calibration, PredictsPixels):
        return looks
    xyz = where[None]
    uv = calibration.predict(xyz)[0]
    sd = np.full(len(uv), np.nan)
    for part in calibration.sensitivities(xyz):
        variance = np.einsum("nij,nij->ni", part.half, part.half)[0] + part.rest[0] + part.noise[0]
        variance += (part.slope[0] ** 2) @ where_sd**2
        sd[list(part.cameras)] = np.sqrt(variance.reshape(-1, 2).mean(axis=1))
    plausible = []
    for look, predicted, sd_px in zip(looks, uv, sd, strict=True):
        far = max(MAX_DISTANCE_PX, MAX_DISTANCE_SDS * sd_px) if np.isfinite(sd_px) else np.inf
        near = _find_nearest(look.found, predicted)
        if near is None or np.linalg.norm(near.uv[0] - predicted) <= far or not np.isfinite(predicted).all():
            plausible.append(replace(look, found=look.found if near is None else near))
            continue
        away = float(np.linalg.norm(near.uv[0] - predicted))
        reason = f"what was found is {away:.0f} px from where the ball must be: left out"
        plausible.append(replace(look, found=Detected(reason=reason)))
    return tuple(plausible)


def _find_nearest(found: Detected, uv: Floats) -> Detected | None:
    """Of what may be the ball, the nearest to a pixel; None where nothing was found."""
    options = [one for one in (found, *found.others) if len(one)]
    if not options or not np.isfinite(uv).all():
        return found if len(found) else None
    return min(options, key=lambda one: float(np.linalg.norm(one.uv[0] - uv)))
