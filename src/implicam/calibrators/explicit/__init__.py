"""explicit: lens models and poses, from known points or from pictures of a board; the classical calibration."""

from implicam.calibrators.explicit.calibration import Explicit, ExplicitCalibration

__all__ = ["Explicit", "ExplicitCalibration"]
