"""What every method that maps positions to pixels shares: cameras, what is known of them, and how they measure.

From data to a fitted rig, in the order of the modules: `training_data` (known points in the working frame),
`initialise` (a camera from no guess), `camera`, `general_camera`, `field` and `camera_model` (what a camera is),
`normal_equations`, `schur`, `tied`, `posterior` and `linearise` (what is known of all cameras), `leave_one_out` and
`diagnostics` (views that contradict the others), `shot_errors`, `level_errors`, `position_errors` and `heavy_tails`
(how positions and pixels are off), `fit_result`; then `rig`, `triangulate`, `wrong_views` and `alarm` (measuring),
`reasons` and `measured_pixels` (what became of the points), `movement` and `repair` (cameras that moved since). All of
it by what `settings` take for usual and for clear. The mathematics: docs/method.md.
"""

from implicam.rig_model.budget import SOURCES, Budget
from implicam.rig_model.camera import (
    CentralCamera,
    Image,
    Prior,
)
from implicam.rig_model.camera_model import CameraModel, CameraViews, apply_covariance_root
from implicam.rig_model.diagnostics import MAX_NAMED_IN_NOTE, Diagnosis
from implicam.rig_model.field import Hyperparameters
from implicam.rig_model.fit_result import FitResult
from implicam.rig_model.general_camera import GeneralCamera
from implicam.rig_model.initialise import (
    InitialCamera,
    lens_only_model,
    levenberg_marquardt,
    start_rig,
)
from implicam.rig_model.leave_one_out import update_inliers
from implicam.rig_model.linearise import iterate_linearisation
from implicam.rig_model.measured_pixels import MeasuredPixels
from implicam.rig_model.movement import NUMBERS, Check, Evidence, Motion
from implicam.rig_model.normal_equations import solve_normal
from implicam.rig_model.posterior import Posterior, condition
from implicam.rig_model.repair import Repair, all_repaired, errors_with_and_without, find_repair, white_unknowns
from implicam.rig_model.rig import FittedRig, Locator, Sensitivity
from implicam.rig_model.settings import CameraSettings, RigModelSettings
from implicam.rig_model.training_data import (
    MIN_POINTS_PER_CAMERA,
    Frame,
    TrainingData,
    image_of,
    relative_noise,
    stated_noise,
)
from implicam.rig_model.triangulate import Labels, locate

__all__ = [
    "MAX_NAMED_IN_NOTE",
    "MIN_POINTS_PER_CAMERA",
    "NUMBERS",
    "SOURCES",
    "Budget",
    "CameraModel",
    "CameraSettings",
    "CameraViews",
    "CentralCamera",
    "Check",
    "Diagnosis",
    "Evidence",
    "FitResult",
    "FittedRig",
    "Frame",
    "GeneralCamera",
    "Hyperparameters",
    "Image",
    "InitialCamera",
    "Labels",
    "Locator",
    "MeasuredPixels",
    "Motion",
    "Posterior",
    "Prior",
    "Repair",
    "RigModelSettings",
    "Sensitivity",
    "TrainingData",
    "all_repaired",
    "apply_covariance_root",
    "condition",
    "errors_with_and_without",
    "find_repair",
    "image_of",
    "iterate_linearisation",
    "lens_only_model",
    "levenberg_marquardt",
    "locate",
    "relative_noise",
    "solve_normal",
    "start_rig",
    "stated_noise",
    "update_inliers",
    "white_unknowns",
]
