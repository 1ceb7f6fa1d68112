"""explicit: lens models and poses, from known points or from pictures of a board; the classical calibration."""

from implicam.calibrators.explicit.calibration import Explicit, ExplicitCalibration
from implicam.calibrators.explicit.exchanged import calibration_of, rig_of
from implicam.calibrators.explicit.settings import ExplicitSettings

__all__ = ["Explicit", "ExplicitCalibration", "ExplicitSettings", "calibration_of", "rig_of"]
