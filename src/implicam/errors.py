"""One error tree. Every message says what happened, why, and how to fix it.

    ImplicamError
    ├── DatasetError          a file or a value in a dataset is wrong
    ├── ImageError            a photograph cannot be read, or is not what the rig records
    ├── FitError              a calibration cannot be computed from these data
    ├── CalibrationFileError  a .implicam file is damaged, unsafe or too new
    ├── NumericalError        a matrix that must be positive definite is not
    ├── MissingExtraError     an optional library is not installed
    ├── HardwareError         a camera, a trigger or a robot does not do what it was told
    └── UsageError            options that do not go together
        └── PartError         what another package brings is not installed, cannot be imported, or is not what it says

The command line prints the three lines and no traceback; `--debug` shows it.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable
from types import ModuleType
from typing import Any


class ImplicamError(Exception):
    """An error that says what happened, why, and how to fix it.

    Attributes:
        what: What happened.
        why: The cause, where it is known.
        fix: What the reader can do about it.

    >>> import implicam as ic
    >>> error = ic.ImplicamError("the light is out.", why="no camera sees anything", fix="switch it on")
    >>> print(error)
    the light is out.
      why: no camera sees anything
      fix: switch it on
    """

    def __init__(self, what: str, *, why: str = "", fix: str = "") -> None:
        super().__init__(what, why, fix)
        self.what, self.why, self.fix = what, why, fix

    def __reduce__(self) -> tuple[Any, ...]:
        """As another process sends it: not by its arguments, which differ from class to class."""
        return _restored, (type(self), self.args, self.__dict__)

    def __str__(self) -> str:
        lines = [self.what]
        if self.why:
            lines.append(f"  why: {self.why}")
        if self.fix:
            lines.append(f"  fix: {self.fix}")
        return "\n".join(lines)


def _restored(kind: type[ImplicamError], args: tuple[Any, ...], said: dict[str, Any]) -> ImplicamError:
    error = kind.__new__(kind, *args)
    error.args = args
    error.__dict__.update(said)
    return error


class DatasetError(ImplicamError):
    """A file or a value in a dataset is wrong; names the file, the line and the value.

    >>> import implicam as ic
    >>> try:
    ...     ic.read_dataset("nowhere")
    ... except ic.DatasetError as error:
    ...     print(error.what)
    nowhere does not exist.
    """


class ImageError(ImplicamError):
    """A photograph cannot be read, or is not what the rig records; names the file.

    >>> import implicam as ic
    >>> from pathlib import Path
    >>> from implicam.images import read_picture
    >>> try:
    ...     read_picture(Path("nowhere.png"))
    ... except ic.ImageError as error:
    ...     print(error.what)
    nowhere.png cannot be read.
    """


class FitError(ImplicamError):
    """A calibration cannot be computed from these data.

    >>> import implicam as ic
    >>> few = ic.simulated("stereo", points=30, seed=1).select(range(3))
    >>> try:
    ...     ic.ForwardGP().fit(few)
    ... except ic.FitError as error:
    ...     print(error.what)
    3 usable known points; forward-gp needs at least 8.
    """


class CalibrationFileError(ImplicamError):
    """A calibration file is damaged, unsafe or from a newer version; nothing in it was run.

    >>> import implicam as ic
    >>> try:
    ...     ic.load_calibration("nowhere.implicam")
    ... except ic.CalibrationFileError as error:
    ...     print(error.what)
    nowhere.implicam does not exist.
    """


class NumericalError(ImplicamError):
    """A matrix that must be positive definite is not, or a number that must be finite is not.

    >>> import implicam as ic
    >>> issubclass(ic.NumericalError, ic.ImplicamError)
    True
    """


class MissingExtraError(ImplicamError):
    """An optional library is not installed.

    >>> import implicam as ic
    >>> issubclass(ic.MissingExtraError, ic.ImplicamError)
    True
    """


class HardwareError(ImplicamError):
    """A camera, a trigger or a robot does not answer, or does not do what it was told; nothing was lost.

    >>> import implicam as ic
    >>> issubclass(ic.HardwareError, ic.ImplicamError)
    True
    """


class UsageError(ImplicamError):
    """Options or arguments that do not go together.

    >>> import implicam as ic
    >>> try:
    ...     ic.calibrator("forward")
    ... except ic.UsageError as error:
    ...     print(error.what)
    method 'forward' is not known (did you mean 'forward-gp'?).
    """


class PartError(UsageError):
    """A lens, a robot or another part that another package brings is missing or broken; names the package.

    >>> import implicam as ic
    >>> issubclass(ic.PartError, ic.UsageError)
    True
    """


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A hint at a known word that is close to another.

    Args:
        word: That was given.
        known: The words that would do.

    Returns:
        `" (did you mean 'cam1'?)"`; empty where no word is close.
    """
    as_written = {one.lower(): one for one in known}
    close = difflib.get_close_matches(word.lower(), list(as_written), n=1, cutoff=0.6)
    return f" (did you mean {as_written[close[0]]!r}?)" if close else ""


def import_extra(module: str, extra: str, purpose: str) -> ModuleType:
    """Import an optional library when it is needed.

    Args:
        module: The dotted name to import.
        extra: The extra of implicam that brings it.
        purpose: What needs it, in words.

    Raises:
        MissingExtraError: It is not installed; says which extra brings it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"{purpose} needs the library {module.partition('.')[0]!r}, which is not installed.",
            why=str(error),
            fix=f'pip install "implicam[{extra}]"',
        ) from error
