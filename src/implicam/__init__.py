"""implicam turns a set of fixed cameras into a 3D measuring instrument with honest error bars.

>>> import implicam as ic
>>> rig = ic.simulated("stereo", points=60, seed=1)         # or ic.read_dataset("my-rig")
>>> calibration = ic.ForwardGP().fit(rig)
>>> measured = calibration.measure(rig.observations)
>>> measured.xyz.shape, measured.cov.shape, str(measured.reason[0])
((60, 3), (60, 3, 3), '')

`import implicam` needs NumPy and SciPy only; everything heavier is imported where it is used.
"""

from implicam.calibration_file import package_version
from implicam.calibrators import (
    METHODS,
    MLP,
    Calibration,
    Explicit,
    ExplicitCalibration,
    ForwardGP,
    ForwardGPCalibration,
    InverseGP,
    InverseGPCalibration,
    MLPCalibration,
    calibrator,
    load_calibration,
)
from implicam.coverage import Coverage, assess
from implicam.dataset import Camera, Dataset, KnownPositions, Observations, join, read_dataset, write_dataset
from implicam.errors import (
    CalibrationFileError,
    DatasetError,
    FitError,
    ImageError,
    ImplicamError,
    MissingExtraError,
    NumericalError,
    UsageError,
)
from implicam.evaluation import Evaluation, cross_validate, evaluate, leave_out_shots
from implicam.measurement import Measurement
from implicam.simulate import simulated
from implicam.verdict import Verdict, judge

__version__ = package_version()

__all__ = [
    "METHODS",
    "MLP",
    "Calibration",
    "CalibrationFileError",
    "Camera",
    "Coverage",
    "Dataset",
    "DatasetError",
    "Evaluation",
    "Explicit",
    "ExplicitCalibration",
    "FitError",
    "ForwardGP",
    "ForwardGPCalibration",
    "ImageError",
    "ImplicamError",
    "InverseGP",
    "InverseGPCalibration",
    "KnownPositions",
    "MLPCalibration",
    "Measurement",
    "MissingExtraError",
    "NumericalError",
    "Observations",
    "UsageError",
    "Verdict",
    "assess",
    "calibrator",
    "cross_validate",
    "evaluate",
    "join",
    "judge",
    "leave_out_shots",
    "load_calibration",
    "read_dataset",
    "simulated",
    "write_dataset",
]
