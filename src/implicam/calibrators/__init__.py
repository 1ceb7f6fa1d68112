"""The methods: known points in, a map from pixels to position with its uncertainty out."""

from implicam.calibrators.explicit import Explicit, ExplicitCalibration, ExplicitSettings
from implicam.calibrators.forward_gp import ForwardGP, ForwardGPCalibration, ForwardGPSettings
from implicam.calibrators.inverse_gp import InverseGP, InverseGPCalibration
from implicam.calibrators.inverse_gp_settings import InverseGPSettings
from implicam.calibrators.mlp import MLP, MLPCalibration
from implicam.calibrators.mlp_settings import MLPSettings
from implicam.calibrators.protocol import (
    Calibration,
    CalibrationBase,
    Calibrator,
    CalibratorBase,
    FindsFaults,
    FitSummary,
    FromWand,
    HasPositionProcesses,
    HoldsLengthsOut,
    LengthsHeldOut,
    PredictsPixels,
    RigCalibration,
    TakesPoints,
    TellsContradictions,
    Updatable,
)
from implicam.calibrators.registry import (
    CALIBRATORS,
    DEFAULT_METHOD,
    METHODS,
    Method,
    calibrator,
    calibrator_from_name,
    compared_names,
    every_option,
    library_of,
    load_calibration,
    method_for,
    options_of,
)
from implicam.dataset.unused import Rejected, Unused

__all__ = [
    "CALIBRATORS",
    "DEFAULT_METHOD",
    "METHODS",
    "MLP",
    "Calibration",
    "CalibrationBase",
    "Calibrator",
    "CalibratorBase",
    "Explicit",
    "ExplicitCalibration",
    "ExplicitSettings",
    "FindsFaults",
    "FitSummary",
    "ForwardGP",
    "ForwardGPCalibration",
    "ForwardGPSettings",
    "FromWand",
    "HasPositionProcesses",
    "HoldsLengthsOut",
    "InverseGP",
    "InverseGPCalibration",
    "InverseGPSettings",
    "LengthsHeldOut",
    "MLPCalibration",
    "MLPSettings",
    "Method",
    "PredictsPixels",
    "Rejected",
    "RigCalibration",
    "TakesPoints",
    "TellsContradictions",
    "Unused",
    "Updatable",
    "calibrator",
    "calibrator_from_name",
    "compared_names",
    "every_option",
    "library_of",
    "load_calibration",
    "method_for",
    "options_of",
]
