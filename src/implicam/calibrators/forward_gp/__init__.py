"""forward-gp: world to pixels, learned with a lens model and a Gaussian process; measured by inversion."""

from implicam.calibrators.forward_gp.calibration import ForwardGP, ForwardGPCalibration
from implicam.calibrators.forward_gp.planned import PlannedCamera, PlannedRig, plan_rig
from implicam.calibrators.forward_gp.settings import ForwardGPSettings

__all__ = ["ForwardGP", "ForwardGPCalibration", "ForwardGPSettings", "PlannedCamera", "PlannedRig", "plan_rig"]
