"""The methods: known points in, a map from pixels to position with its uncertainty out."""

from __future__ import annotations

from typing import Any

from implicam.calibrators.inverse_gp import InverseGP, InverseGPCalibration
from implicam.calibrators.protocol import Calibration, Calibrator, Unused
from implicam.errors import UsageError, did_you_mean

METHODS: dict[str, tuple[type[Any], type[Any]]] = {
    InverseGP.method: (InverseGP, InverseGPCalibration),
}
"""Method name -> (calibrator, calibration)."""

DEFAULT_METHOD = InverseGP.method
COMING = ("forward-gp", "mlp", "explicit")


def calibrator(method: str, **options: Any) -> Calibrator:
    """The calibrator of a method by name; options that are None are left at their default."""
    if method not in METHODS:
        coming = method in COMING
        raise UsageError(
            f"method {method!r} is {'not in this version yet' if coming else 'not known'}"
            f"{'' if coming else did_you_mean(method, METHODS)}.",
            fix=f"the methods are {', '.join(METHODS)}",
        )
    made: Calibrator = METHODS[method][0](**{key: value for key, value in options.items() if value is not None})
    return made


__all__ = [
    "COMING",
    "DEFAULT_METHOD",
    "METHODS",
    "Calibration",
    "Calibrator",
    "InverseGP",
    "InverseGPCalibration",
    "Unused",
    "calibrator",
]
