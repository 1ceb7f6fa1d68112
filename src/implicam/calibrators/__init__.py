"""The methods: known points in, a map from pixels to position with its uncertainty out."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

from implicam import calibration_file
from implicam.calibrators.explicit import Explicit, ExplicitCalibration
from implicam.calibrators.forward_gp import ForwardGP, ForwardGPCalibration
from implicam.calibrators.inverse_gp import PRESETS, InverseGP, InverseGPCalibration
from implicam.calibrators.mlp import MLP, MLPCalibration
from implicam.calibrators.protocol import Calibration, Calibrator
from implicam.dataset.unused import Rejected, Unused
from implicam.errors import CalibrationFileError, UsageError, did_you_mean, import_extra

METHODS: dict[str, tuple[type[Any], type[Any]]] = {
    ForwardGP.method: (ForwardGP, ForwardGPCalibration),
    InverseGP.method: (InverseGP, InverseGPCalibration),
    MLP.method: (MLP, MLPCalibration),
    Explicit.method: (Explicit, ExplicitCalibration),
}
"""Method name -> (calibrator, calibration)."""

DEFAULT_METHOD = ForwardGP.method

NEEDED = {
    "inverse-gp:paper": ("gpytorch", "paper"),
    "mlp": ("torch", "mlp"),
    "mlp:no-dropout": ("torch", "mlp"),
}
"""Method or variant -> the library it needs to be fitted, and the extra that brings it."""


def calibrator(method: str, **options: Any) -> Calibrator:
    """The calibrator of a method by name; options that are None are left at their default."""
    if method not in METHODS:
        raise UsageError(
            f"method {method!r} is not known{did_you_mean(method, METHODS)}.",
            fix=f"the methods are {', '.join(METHODS)}",
        )
    given = {key: value for key, value in options.items() if value is not None}
    known_options = [field.name for field in fields(METHODS[method][0])]
    for key in given:
        if key not in known_options:
            raise UsageError(
                f"{method} has no option {key!r}{did_you_mean(key, known_options)}.",
                fix=f"leave it out; {method} has {', '.join(known_options)}",
            )
    made: Calibrator = METHODS[method][0](**given)
    return made


def calibrator_from_name(name: str) -> Calibrator:
    """The calibrator of a name, `method` or `method:variant`, as tables and sweeps name them.

    The variant is `paper` or `plain` (inverse-gp: its preset) or `no-dropout` (mlp); any other is a kernel of
    inverse-gp, or a lens of the other methods: `inverse-gp:matern-5/2`, `forward-gp:none`, `explicit:kannala-brandt`.
    What the name does not say is at its default. UsageError where the method or the variant is not known;
    MissingExtraError where its library (`NEEDED`) is not installed.
    """
    method, _, variant = name.partition(":")
    if name in NEEDED:
        import_extra(*NEEDED[name], name)  # now, so that no fit is charged for it
    if not variant:
        return calibrator(method)
    if method == InverseGP.method and variant in PRESETS:
        return calibrator(method, preset=variant)
    if (method, variant) == (MLP.method, "no-dropout"):
        return calibrator(method, dropout=0.0)
    return calibrator(method, **{"kernel" if method == InverseGP.method else "lens": variant})


def load_calibration(path: str | Path) -> Calibration:
    """Read a `.implicam` file; CalibrationFileError says what is wrong with one that cannot be used."""
    contents = calibration_file.read(path)
    if contents.method not in METHODS:
        raise CalibrationFileError(
            f"{path} was made by the method {contents.method!r}, which this version does not have.",
            why=f"the methods here are {', '.join(METHODS)}",
            fix="pip install --upgrade implicam",
        )
    with calibration_file.refusing(contents.path):
        restored: Calibration = METHODS[contents.method][1].from_state(contents.data, contents.options, contents.arrays)
    return restored


__all__ = [
    "DEFAULT_METHOD",
    "METHODS",
    "MLP",
    "NEEDED",
    "Calibration",
    "Calibrator",
    "Explicit",
    "ExplicitCalibration",
    "ForwardGP",
    "ForwardGPCalibration",
    "InverseGP",
    "InverseGPCalibration",
    "MLPCalibration",
    "Rejected",
    "Unused",
    "calibrator",
    "calibrator_from_name",
    "load_calibration",
]
