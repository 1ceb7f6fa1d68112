"""implicam turns a set of fixed cameras into a 3D measuring instrument with honest error bars.

>>> import implicam as ic
>>> rig = ic.simulated("stereo", points=60, seed=1)         # or ic.read_dataset("my-rig")
>>> calibration = ic.ForwardGP().fit(rig)
>>> measured = calibration.measure(rig.observations)
>>> measured.xyz.shape, measured.cov.shape, str(measured.reason[0])
((60, 3), (60, 3, 3), '')

`import implicam` alone imports next to nothing: a method, and the libraries it needs, come when they are first asked
for (PEP 562). All of it needs NumPy and SciPy only; everything heavier is imported where it is used.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what type checkers and editors see; `_NAMES` says the same to Python, and a test compares
    from implicam.active import suggest as suggest
    from implicam.calibrators import METHODS as METHODS
    from implicam.calibrators import MLP as MLP
    from implicam.calibrators import Calibration as Calibration
    from implicam.calibrators import Explicit as Explicit
    from implicam.calibrators import ExplicitCalibration as ExplicitCalibration
    from implicam.calibrators import ExplicitSettings as ExplicitSettings
    from implicam.calibrators import ForwardGP as ForwardGP
    from implicam.calibrators import ForwardGPCalibration as ForwardGPCalibration
    from implicam.calibrators import ForwardGPSettings as ForwardGPSettings
    from implicam.calibrators import InverseGP as InverseGP
    from implicam.calibrators import InverseGPCalibration as InverseGPCalibration
    from implicam.calibrators import InverseGPSettings as InverseGPSettings
    from implicam.calibrators import MLPCalibration as MLPCalibration
    from implicam.calibrators import MLPSettings as MLPSettings
    from implicam.calibrators import calibrator as calibrator
    from implicam.calibrators import load_calibration as load_calibration
    from implicam.coverage import Coverage as Coverage
    from implicam.coverage import assess as assess
    from implicam.dataset import Camera as Camera
    from implicam.dataset import Dataset as Dataset
    from implicam.dataset import KnownPositions as KnownPositions
    from implicam.dataset import Observations as Observations
    from implicam.dataset import join as join
    from implicam.dataset import read_dataset as read_dataset
    from implicam.dataset import write_dataset as write_dataset
    from implicam.derived import Quantity as Quantity
    from implicam.derived import angle as angle
    from implicam.derived import distance as distance
    from implicam.derived import distances as distances
    from implicam.derived import fit_cylinder as fit_cylinder
    from implicam.derived import fit_motion as fit_motion
    from implicam.derived import fit_plane as fit_plane
    from implicam.derived import fit_sphere as fit_sphere
    from implicam.errors import CalibrationFileError as CalibrationFileError
    from implicam.errors import DatasetError as DatasetError
    from implicam.errors import FitError as FitError
    from implicam.errors import HardwareError as HardwareError
    from implicam.errors import ImageError as ImageError
    from implicam.errors import ImplicamError as ImplicamError
    from implicam.errors import MissingExtraError as MissingExtraError
    from implicam.errors import NumericalError as NumericalError
    from implicam.errors import PartError as PartError
    from implicam.errors import UsageError as UsageError
    from implicam.evaluation import Evaluation as Evaluation
    from implicam.evaluation import cross_validate as cross_validate
    from implicam.evaluation import evaluate as evaluate
    from implicam.evaluation import leave_out_shots as leave_out_shots
    from implicam.measurement import MeasuredPoint as MeasuredPoint
    from implicam.measurement import Measurement as Measurement
    from implicam.simulate import simulated as simulated
    from implicam.stability import CalibrationCheck as CalibrationCheck
    from implicam.stability import CalibrationRepair as CalibrationRepair
    from implicam.stability import CalibrationWatch as CalibrationWatch
    from implicam.stability import check_calibration as check_calibration
    from implicam.verdict import Verdict as Verdict
    from implicam.verdict import judge as judge
    from implicam.verification import CalibratedLength as CalibratedLength
    from implicam.verification import Verification as Verification
    from implicam.verification import verify as verify
    from implicam.viewer.calibration_page import LiveView as LiveView
    from implicam.world import set_world as set_world

    __version__: str

_NAMES = {
    "implicam.active": ("suggest",),
    "implicam.calibrators": (
        "METHODS", "MLP", "Calibration", "Explicit", "ExplicitCalibration", "ExplicitSettings", "ForwardGP",
        "ForwardGPCalibration", "ForwardGPSettings", "InverseGP", "InverseGPCalibration", "InverseGPSettings",
        "MLPCalibration", "MLPSettings", "calibrator", "load_calibration",
    ),
    "implicam.coverage": ("Coverage", "assess"),
    "implicam.dataset": (
        "Camera", "Dataset", "KnownPositions", "Observations", "join", "read_dataset", "write_dataset",
    ),
    "implicam.derived": (
        "Quantity", "angle", "distance", "distances", "fit_cylinder", "fit_motion", "fit_plane", "fit_sphere",
    ),
    "implicam.errors": (
        "CalibrationFileError", "DatasetError", "FitError", "HardwareError", "ImageError", "ImplicamError",
        "MissingExtraError", "NumericalError", "PartError", "UsageError",
    ),
    "implicam.evaluation": ("Evaluation", "cross_validate", "evaluate", "leave_out_shots"),
    "implicam.measurement": ("MeasuredPoint", "Measurement"),
    "implicam.simulate": ("simulated",),
    "implicam.stability": ("CalibrationCheck", "CalibrationRepair", "CalibrationWatch", "check_calibration"),
    "implicam.verdict": ("Verdict", "judge"),
    "implicam.verification": ("CalibratedLength", "Verification", "verify"),
    "implicam.viewer.calibration_page": ("LiveView",),
    "implicam.world": ("set_world",),
}  # fmt: skip
"""Module -> the public names it has."""
_HOMES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = sorted(_HOMES)

if not TYPE_CHECKING:  # it would tell type checkers that every name exists

    def __getattr__(name: str) -> Any:
        """A public name, or a module of the package, imported when it is first asked for."""
        if name in _HOMES:
            value = getattr(import_module(_HOMES[name]), name)
        elif name == "__version__":
            value = import_module("implicam.calibration_file").package_version()
        elif not name.startswith("_") and find_spec(f"implicam.{name}"):
            value = import_module(f"implicam.{name}")
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value  # so that this function is asked once
        return value


def __dir__() -> list[str]:
    return sorted({*__all__, "__version__", *(name for name in globals() if name.startswith("__"))})
