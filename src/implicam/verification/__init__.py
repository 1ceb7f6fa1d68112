"""Acceptance and reverification with calibrated lengths: the decision, whether error bars and scale are true, where the
next lengths help most, and a protocol to print.
"""

from implicam.verification.acceptance import verify
from implicam.verification.lengths import CalibratedLength, read_lengths
from implicam.verification.limit import MaximumPermissibleError
from implicam.verification.result import LengthResult, Verification, decide
from implicam.verification.statistics import ErrorBarsTest, ScaleTest
from implicam.verification.volume import ArrangementCheck, PlacedLength, VolumeCoverage

__all__ = [
    "ArrangementCheck",
    "CalibratedLength",
    "ErrorBarsTest",
    "LengthResult",
    "MaximumPermissibleError",
    "PlacedLength",
    "ScaleTest",
    "Verification",
    "VolumeCoverage",
    "decide",
    "read_lengths",
    "verify",
]
