"""The methods by name: from a name, with a variant and options, to a calibrator; from a file to a calibration.

CONTRIBUTING.md has the recipe for one more.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import Field, fields
from pathlib import Path
from typing import Any, NamedTuple

from implicam import calibration_file
from implicam.calibrators.explicit import Explicit, ExplicitCalibration
from implicam.calibrators.forward_gp import ForwardGP, ForwardGPCalibration
from implicam.calibrators.inverse_gp import InverseGP, InverseGPCalibration
from implicam.calibrators.mlp import MLP, MLPCalibration
from implicam.calibrators.protocol import Calibration, Calibrator
from implicam.errors import CalibrationFileError, PartError, UsageError, did_you_mean, import_extra
from implicam.registry import Registry, missing_members


class Method(NamedTuple):
    """A calibrator, and the calibration that it returns, which restores itself from a file."""

    calibrator: type[Any]
    calibration: type[Any]


def _what_is_wrong(name: str, part: Any) -> Iterator[str]:
    if not isinstance(part, Method):
        yield "it is no Method(calibrator, calibration) of implicam.calibrators"
        return
    for made, protocol in ((part.calibrator, Calibrator), (part.calibration, Calibration)):
        missing = missing_members(made, protocol)
        if missing:
            yield f"{made.__name__} has no {', '.join(missing)}"
    method = getattr(part.calibrator, "method", name)
    if method != name:
        yield f"its method is {method!r}, and it is added as {name!r}: the two must be the same"


CALIBRATORS = Registry(
    "method",
    {
        ForwardGP.method: Method(ForwardGP, ForwardGPCalibration),
        InverseGP.method: Method(InverseGP, InverseGPCalibration),
        MLP.method: Method(MLP, MLPCalibration),
        Explicit.method: Method(Explicit, ExplicitCalibration),
    },
    "implicam.calibrators",
    _what_is_wrong,
)
"""Method name -> (calibrator, calibration)."""

METHODS = CALIBRATORS

DEFAULT_METHOD = ForwardGP.method


def calibrator(name: str, **options: Any) -> Calibrator:
    """The calibrator of a method.

    Args:
        name: `method`, or `method:variant`, where the variant stands for options: `inverse-gp:plain`,
            `forward-gp:none`, `explicit:kannala-brandt`, `mlp:no-dropout`.
        **options: fields of the calibrator, which win over those of the variant; those that are None are left at
            their default, and so is `seed` for a method that leaves nothing to chance.

    Raises:
        UsageError: the method, the variant or an option is not known.

    >>> import implicam as ic
    >>> ic.calibrator("forward-gp") == ic.ForwardGP()
    True
    """
    (made, _), variant = CALIBRATORS.find(name)
    known = [field.name for field in fields(made)]
    given = {key: value for key, value in options.items() if value is not None and (key in known or key != "seed")}
    for key in given:
        if key not in known:
            raise UsageError(
                f"{made.method} has no option {key!r}{did_you_mean(key, known)}.",
                fix=f"leave it out; {made.method} has {', '.join(known) or 'none'}",
            )
    if not variant:
        return made(**given)  # type: ignore[no-any-return]
    variants = made.variants()
    if variant not in variants:
        raise UsageError(
            f"{made.method} has no variant {variant!r}{did_you_mean(variant, variants)}.",
            fix=f"use one of {', '.join(variants)}" if variants else f"write {made.method}, without a colon",
        )
    return made(**{**variants[variant], **given})  # type: ignore[no-any-return]


def calibrator_from_name(name: str) -> Calibrator:
    """The calibrator of `method` or `method:variant`, as tables and sweeps name them, everything else at its default.

    Args:
        name: Of the method, with a variant or without.

    Returns:
        The calibrator; the library that it needs is imported.

    Raises:
        UsageError: The method or the variant is not known.
        MissingExtraError: The library that it needs to be fitted is not installed.
    """
    made = calibrator(name)
    if made.library is not None:
        import_extra(*made.library, name)  # now, so that no fit is charged for it
    return made


def library_of(name: str) -> tuple[str, str] | None:
    """The library that a method or variant needs to be fitted, and the extra that brings it.

    Args:
        name: `method` or `method:variant`.

    Returns:
        The two names; None where nothing more is needed.

    Raises:
        UsageError: The method or the variant is not known.
    """
    return calibrator(name).library


def compared_names() -> list[str]:
    """The methods, each with the variants that stand beside it in a comparison."""
    return [
        name
        for method, (made, _) in CALIBRATORS.items()
        for name in (method, *(f"{method}:{variant}" for variant in made.compared_variants))
    ]


def options_of(method: str) -> dict[str, Field[Any]]:
    """The options that a method has on the command line: its calibrator's fields with an `option`, by name.

    Args:
        method: Its name.

    Returns:
        Name -> field.
    """
    return {field.name: field for field in fields(CALIBRATORS[method].calibrator) if "help" in field.metadata}


def every_option() -> dict[str, dict[str, Field[Any]]]:
    """Option -> method -> field, over all methods."""
    found: dict[str, dict[str, Field[Any]]] = {}
    for method in CALIBRATORS:
        for name, field in options_of(method).items():
            found.setdefault(name, {})[method] = field
    return found


def method_for(**options: Any) -> str:
    """The method that is meant where only options are given: the first that takes them all, the default one before.

    Where none takes them, the first that has options of these names, whose error says the most.

    Args:
        **options: Name -> value; those that are None are not given.

    Returns:
        The name of the method.
    """
    given = {key: value for key, value in options.items() if value is not None}
    methods = dict.fromkeys([DEFAULT_METHOD, *CALIBRATORS])
    able = [method for method in methods if set(given) <= set(options_of(method))]
    for method in able:
        try:
            calibrator(method, **given)
        except PartError:  # it is there, and broken
            return method
        except UsageError:
            continue
        return method
    return able[0] if able else DEFAULT_METHOD


def load_calibration(path: str | Path) -> Calibration:
    """Read a `.implicam` file.

    Args:
        path: Of the file.

    Returns:
        The calibration.

    Raises:
        CalibrationFileError: It cannot be used, and what is wrong with it.

    >>> import implicam as ic
    >>> import tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp()) / "rig.implicam"
    >>> ic.ForwardGP().fit(ic.simulated("stereo", points=30, seed=1)).save(path)
    >>> ic.load_calibration(path).method
    'forward-gp'
    """
    contents = calibration_file.read(path)
    if contents.method not in CALIBRATORS:
        raise CalibrationFileError(
            f"{path} was made by the method {contents.method!r}, which this version does not have.",
            why=f"the methods here are {', '.join(CALIBRATORS)}",
            fix="pip install --upgrade implicam",
        )
    with calibration_file.refusing(contents.path):
        restored: Calibration = CALIBRATORS[contents.method].calibration.from_state(
            contents.data, contents.options, contents.arrays
        )
    return restored
