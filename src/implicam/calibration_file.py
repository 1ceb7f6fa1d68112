"""A calibration is one file, `*.implicam`: a zip of calibration.toml (readable) and arrays.npz (never pickled).

It carries the observations it was fitted from, so it can be checked, continued and fitted again years later. Its bytes
depend on the calibration only: no dates, so the same fit gives the same file. Reading trusts nothing: sizes are
checked before memory is spent, the arrays against a SHA-256, every shape and sign against the data, and whatever does
not fit is a CalibrationFileError.

Format versions: 2: cameras of forward-gp say which model, lens and kind they are. 3: a camera has moved since
(`repairs`); a file without one is still written as 2. A newer version is refused with the cure; an older one is
converted in `_UPGRADES`.
"""

from __future__ import annotations

import hashlib
import io
import os
import platform
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from implicam.dataset import Dataset, arrays_from_dataset, dataset_from_arrays
from implicam.dataset.tables import parse_toml
from implicam.errors import CalibrationFileError, ImplicamError, PartError
from implicam.files import max_inflated_bytes, npz_bytes, read_npz, read_zip, replacing, toml_text, write_zip

FORMAT_VERSION, FORMAT_WITHOUT_REPAIRS = 3, 2
MAX_BYTES = 1 << 31
TOML, ARRAYS = "calibration.toml", "arrays.npz"
PIXEL_CONVENTION = "(u, v) = (column, row); (0, 0) is the centre of the top-left pixel"
_DATA, _METHOD = "data/", "method/"  # where an array belongs


def _upgrade_1(table: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
    """forward-gp had one lens for all cameras, one lengthscale, and counted log distance as it is."""
    if table.get("method") != "forward-gp":
        return
    options = table["options"]
    lens = str(options["lens"])
    if lens not in ("central", "none"):
        raise ValueError(f"{lens!r} is no lens of forward-gp")
    described = {"model": lens, "lens": "none" if lens == "none" else "kannala-brandt"}
    described["kind"] = "none" if lens == "none" else "ordinary"
    options["cameras"] = [{"name": str(name), **described, "mirrored": False} for name in options["calibrated"]]
    sizes = arrays[_METHOD + "sizes"]
    arrays[_METHOD + "sizes"] = np.hstack([sizes, np.tile([0.0, 1.0], (len(sizes), 1))])
    arrays[_METHOD + "lengthscale"] = np.tile(arrays[_METHOD + "lengthscale"], (len(sizes), 1))


_UPGRADES: dict[int, Callable[[dict[str, Any], dict[str, NDArray[Any]]], None]] = {
    1: _upgrade_1,
    2: lambda table, arrays: None,
}
"""Format version -> a function that turns its table and arrays into those of the next."""


class Savable(Protocol):
    """What a calibration must offer to be saved."""

    @property
    def method(self) -> str:
        """The method's name."""

    @property
    def data(self) -> Dataset:
        """The data it was fitted to."""

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Its options as a readable table, and its arrays."""

    def summary(self) -> Any:
        """A `FitSummary`: how well it fits its own data."""


@dataclass(frozen=True, eq=False)
class Contents:
    """What a calibration file holds: everything that the method needs to restore itself.

    Attributes:
        path: The file.
        method: Its name.
        data: The data that the calibration was fitted to.
        options: The method's readable table.
        arrays: The method's arrays, by name.
    """

    path: Path
    method: str
    data: Dataset
    options: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]


def save(calibration: Savable, path: str | Path, verdict: Mapping[str, Any] | None = None) -> None:
    """Write a calibration, whole or not at all.

    Args:
        calibration: The calibration.
        path: The file; it is replaced.
        verdict: What `judge` says of it, for the readable table; None for nothing.

    Raises:
        ImplicamError: The file cannot be written.
    """
    members = _members_of(calibration, verdict)
    with replacing(Path(path)) as temporary:
        write_zip(temporary, members)


def _members_of(calibration: Savable, verdict: Mapping[str, Any] | None) -> dict[str, bytes]:
    """What a calibration file holds: name -> content."""
    method_table, method_arrays = calibration.state()
    arrays = {_DATA + name: array for name, array in arrays_from_dataset(calibration.data).items()}
    arrays |= {_METHOD + name: array for name, array in method_arrays.items()}
    content = npz_bytes(arrays)
    judged = {} if verdict is None else {"verdict": dict(verdict)}
    table = {
        "format_version": FORMAT_VERSION if method_table.get("repairs") else FORMAT_WITHOUT_REPAIRS,
        **_description(calibration),
        **judged,
        "arrays_sha256": hashlib.sha256(content).hexdigest(),
        "options": method_table,
    }
    return {TOML: toml_text(table).encode(), ARRAYS: content}


def checksum(calibration: Savable | str | Path) -> str:
    """The SHA-256 of a calibration file, as `sha256sum` prints it: the same data give the same on one machine.

    Args:
        calibration: The file; or a calibration, for that of the file which `calibration.save` writes.

    Returns:
        64 hexadecimal digits.

    Raises:
        CalibrationFileError: The file cannot be read.
    """
    if isinstance(calibration, str | Path):
        try:
            return hashlib.sha256(Path(calibration).read_bytes()).hexdigest()
        except OSError as error:
            raise CalibrationFileError(
                f"{calibration} cannot be read.", why=str(error), fix="check its name and its permissions"
            ) from error
    content = io.BytesIO()
    write_zip(content, _members_of(calibration, None))
    return hashlib.sha256(content.getvalue()).hexdigest()


def _description(calibration: Savable) -> dict[str, Any]:
    data = calibration.data
    known = data.xyz
    workspace = {"lowest": known.min(axis=0).tolist(), "highest": known.max(axis=0).tolist()} if len(known) else {}
    return {
        "method": calibration.method,
        "dataset": data.name,
        "length_unit": data.length_unit,
        "pixel_convention": PIXEL_CONVENTION,
        "known_points": len(data),
        "workspace": workspace,
        "residuals": calibration.summary().as_table(),
        "versions": {
            "implicam": package_version(),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scipy": scipy.__version__,
        },
        "cameras": [camera.as_table() for camera in data.cameras],
    }


def package_version() -> str:
    """The installed version of implicam."""
    try:
        return version("implicam")
    except PackageNotFoundError:
        return "not installed"


def read(path: str | Path) -> Contents:
    """Read a calibration file.

    Args:
        path: The file.

    Raises:
        CalibrationFileError: It is not a calibration file, not whole, changed, or from a newer version.
    """
    path = Path(path)
    members = _members(path)
    table = _table(path, members[TOML])
    if table.get("arrays_sha256") != hashlib.sha256(members[ARRAYS]).hexdigest():
        raise refusal(path, "its arrays are not those it was written with (their SHA-256 differs)")
    # a zip within a zip inflates twice: the bound is that of the outer one
    most = max_inflated_bytes(path.stat().st_size)
    arrays = read_npz(members[ARRAYS], lambda reason: refusal(path, reason), most=most)
    for older in range(table["format_version"], FORMAT_VERSION):
        _UPGRADES[older](table, arrays)
    method, options = table.get("method"), table.get("options")
    if not isinstance(method, str) or not isinstance(options, dict):
        raise refusal(path, f"{TOML} states no method, or no options")
    with refusing(path):
        data = dataset_from_arrays(_part(arrays, _DATA), path)
        _ = data.positions
    return Contents(path, method, data, options, _part(arrays, _METHOD))


@contextmanager
def refusing(path: Path) -> Iterator[None]:
    """Turn whatever a wrong value causes while a calibration is restored into a CalibrationFileError.

    Args:
        path: The file that it is restored from.

    Raises:
        CalibrationFileError: A value was missing or wrong.
    """
    try:
        yield
    except PartError as error:  # the file is sound; what it needs is not here
        raise CalibrationFileError(f"{path} cannot be used here: {error.what}", why=error.why, fix=error.fix) from error
    except ImplicamError as error:
        raise refusal(path, error.what) from error
    except KeyError as error:
        raise refusal(path, f"{error} is missing") from error
    except (ValueError, TypeError, IndexError, OverflowError) as error:
        raise refusal(path, str(error)) from error


def describe(path: str | Path) -> dict[str, Any]:
    """The readable table of a calibration file, without loading the arrays.

    Args:
        path: The file.

    Raises:
        CalibrationFileError: It is not a calibration file, or from a newer version.
    """
    path = Path(path)
    return _table(path, _members(path)[TOML])


def _members(path: Path) -> dict[str, bytes]:
    if not path.is_file():
        what = "is a folder, not a calibration" if path.is_dir() else "does not exist"
        raise CalibrationFileError(
            f"{path} {what}.", fix="give a file made by `implicam calibrate DATASET -o rig.implicam`"
        )
    if not os.access(path, os.R_OK):
        raise CalibrationFileError(f"{path} cannot be read.", fix="check its permissions")
    if path.stat().st_size > MAX_BYTES or not zipfile.is_zipfile(path):
        raise refusal(path, "it is not a zip, or it is cut off")
    members = read_zip(path, lambda reason: refusal(path, reason))
    if set(members) != {TOML, ARRAYS}:
        raise refusal(
            path, f"it must hold {TOML} and {ARRAYS}, and holds {', '.join(sorted(members))[:200] or 'nothing'}"
        )
    return members


def _table(path: Path, content: bytes) -> dict[str, Any]:
    try:
        table = parse_toml(content.decode("utf-8"))
    except ValueError as error:
        raise refusal(path, f"{TOML} is not readable: {error}") from None
    number = table.get("format_version")
    if not isinstance(number, int) or isinstance(number, bool) or number < 1:
        raise refusal(path, f"{TOML} states no format_version")
    if number > FORMAT_VERSION:
        raise CalibrationFileError(
            f"{path} is from a newer version of implicam (format {number}; this one reads up to {FORMAT_VERSION}).",
            fix="pip install --upgrade implicam",
        )
    return table


def _part(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def refusal(path: Path, reason: str) -> CalibrationFileError:
    """The error for a file that cannot be used.

    Args:
        path: The file.
        reason: Why, in words.
    """
    return CalibrationFileError(
        f"{path} is not a usable calibration file.",
        why=reason,
        fix="take it from your backup, or calibrate again; nothing in it was executed",
    )
