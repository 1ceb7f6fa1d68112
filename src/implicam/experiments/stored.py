"""A result file: what a cell computed, and from what, in one .npz that is whole or not there.

    json         uint8: the UTF-8 text of {"work", "options", "implicam", "seconds", "keys", "arrays", "values"}
    0, 1, 2 ...  the arrays of the result, in the order in which "arrays" names their keys

JSON keeps a float64 to the bit (Python writes the shortest text that reads back the same) and knows NaN and infinity.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from implicam.calibration_file import package_version
from implicam.errors import ImplicamError
from implicam.files import npz_bytes, read_npz, replacing

Values = dict[str, Any]
"""Plain JSON values and NumPy arrays by name: what a cell's work returns."""

_HEAD = "json"
_NUMBERS_AND_TEXT = "fiubU"  # the kinds of arrays that `files.read_npz` reads


@dataclass(frozen=True)
class Stored:
    """A result as it is in its file.

    Attributes:
        work: The name of the function that made it.
        options: Its options as canonical JSON text.
        version: Of implicam.
        seconds: That the work took.
        values: The result.
    """

    work: str
    options: str
    version: str
    seconds: float
    values: Values


def canonical(options: Mapping[str, Any]) -> str:
    """Options as the one JSON text that equal options share.

    Args:
        options: Plain values.

    Raises:
        TypeError: A value has no form in JSON.
        ValueError: A list or dict contains itself.
    """
    return json.dumps(dict(options), sort_keys=True)


def encode(work: str, options: str, seconds: float, values: Mapping[str, Any]) -> bytes:
    """The bytes of a result file.

    Args:
        work: The name of the function that made it.
        options: Its options as canonical JSON text.
        seconds: That the work took.
        values: The result: plain values, and arrays of numbers or text.

    Raises:
        TypeError: A value cannot be kept.
        ValueError: A list or dict contains itself.
    """
    if not isinstance(values, Mapping):
        raise TypeError(f"{work} returned a {type(values).__name__}; a cell returns a dict")
    odd = [key for key in values if not isinstance(key, str)]
    if odd:
        raise TypeError(f"{work} returned the key {odd[0]!r}; the keys of a result are text")
    arrays = {key: value for key, value in values.items() if isinstance(value, np.ndarray)}
    for key, array in arrays.items():
        if array.dtype.kind not in _NUMBERS_AND_TEXT:
            raise TypeError(f"{work} returned {key!r} as an array of {array.dtype}; numbers and text can be stored")
    head = {
        "work": work,
        "options": options,
        "implicam": package_version(),
        "seconds": seconds,
        "keys": list(values),
        "arrays": list(arrays),
        "values": {key: value for key, value in values.items() if key not in arrays},
    }
    text = json.dumps(head, default=_number).encode()
    numbered = {str(i): array for i, array in enumerate(arrays.values())}
    return npz_bytes({_HEAD: np.frombuffer(text, np.uint8), **numbered})


def _number(value: object) -> Any:
    """A NumPy number as Python's, for `json`."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(
        f"a {type(value).__name__} within a list or a dict cannot be stored; "
        "a result holds plain JSON values, and arrays under their own names"
    )


def decode(source: bytes | Path) -> Stored:
    """The inverse of `encode`.

    Args:
        source: The bytes, or the file.

    Raises:
        ImplicamError: The file is damaged, or no result file; `why` has the reason.
    """
    members = read_npz(source, _damaged)
    try:
        head = json.loads(members[_HEAD].tobytes())
        arrays = {key: members[str(i)] for i, key in enumerate(head["arrays"])}
        values = {key: arrays[key] if key in arrays else head["values"][key] for key in head["keys"]}
        work, options, version = (str(head[key]) for key in ("work", "options", "implicam"))
        return Stored(work, options, version, float(head["seconds"]), values)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise _damaged(f"{type(error).__name__}: {str(error)[:200]}") from error


def _damaged(reason: str) -> ImplicamError:
    return ImplicamError("a result file is damaged.", why=reason, fix="remove it: it will be computed again")


def result_file(folder: Path, name: str) -> Path:
    """Where the result of a cell is.

    Args:
        folder: Of the results.
        name: Of the cell.
    """
    return folder / f"{name}.npz"


def failure_file(folder: Path, name: str) -> Path:
    """The file that says why a cell failed, with the traceback.

    Args:
        folder: Of the results.
        name: Of the cell.
    """
    return folder / f"{name}.failed.txt"


def write_result(folder: Path, name: str, content: bytes) -> None:
    """Write a result, whole; the file of an earlier failure is removed.

    Args:
        folder: Of the results.
        name: Of the cell.
        content: As of `encode`.

    Raises:
        ImplicamError: It cannot be written.
    """
    with replacing(result_file(folder, name)) as temporary:
        temporary.write_bytes(content)
    failure_file(folder, name).unlink(missing_ok=True)
