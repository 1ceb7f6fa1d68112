"""Writing that a kill cannot halve, and reading that a hostile file cannot exploit.

Every file is written beside its place and renamed into it, so that at any moment the old or the new file is
there, whole. Zip and NumPy containers are read with their declared sizes checked *before* memory is spent, and
never with pickle.
"""

from __future__ import annotations

import io
import math
import os
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.errors import ImplicamError

# A calibration or dataset is stored uncompressed by us, so a member is never larger than its file. Others may
# deflate: text shrinks perhaps tenfold, while the bombs we refuse shrink a thousandfold.
MAX_INFLATION = 100
SMALL_BYTES = 1 << 24

_ZIP_ERRORS = (
    zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, KeyError, ValueError, OSError,
    IndexError, OverflowError, MemoryError,
)  # fmt: skip


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path`; on leaving without error, rename it into place."""
    path = Path(path)
    parent = _existing_folder(path.parent)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.partial-", dir=parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        _flush(temporary)
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """The same for a folder. An existing one is refused unless `overwrite`, and then swapped when all is ready."""
    path = Path(path)
    if path.exists() and not overwrite and not (path.is_dir() and not any(path.iterdir())):
        raise ImplicamError(
            f"{path} already exists.",
            why="writing into it would mix old and new files",
            fix="choose another name, remove it, or add --overwrite",
        )
    parent = _existing_folder(path.parent)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.partial-", dir=parent))
    retired = temporary.with_name(temporary.name + ".old")
    try:
        yield temporary
        for file in sorted(temporary.rglob("*")):
            if file.is_file():
                _flush(file)
        temporary.chmod(0o777 & ~_umask())
        if path.exists():
            path.rename(retired)
        temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.rmtree(retired, ignore_errors=True)


def _existing_folder(parent: Path) -> Path:
    try:
        parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ImplicamError(
            f"cannot create the folder {parent}.", why=str(error), fix="choose a place you may write to"
        ) from error
    if not os.access(parent, os.W_OK):
        raise ImplicamError(f"cannot write into {parent}.", fix="choose a place you may write to")
    return parent


def _flush(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


def toml_text(table: Mapping[str, Any]) -> str:
    """A dict as TOML."""
    import tomli_w  # late, so that `import implicam` needs NumPy and SciPy only

    return tomli_w.dumps(table)


def write_zip(file: Path | io.BytesIO, members: Mapping[str, bytes]) -> None:
    """Write an uncompressed zip whose bytes depend on the members only (no dates)."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0)), content)


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Arrays as the bytes of an .npz, the same bytes for the same arrays."""
    members = {}
    for name, array in arrays.items():
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, np.asarray(array, order="C"), allow_pickle=False)
        members[f"{name}.npy"] = buffer.getvalue()
    archive = io.BytesIO()
    write_zip(archive, members)
    return archive.getvalue()


Refuse = Callable[[str], ImplicamError]
"""Turns a reason into the error of the room that reads."""


def read_zip(source: bytes, refuse: Refuse) -> dict[str, bytes]:
    """The members of a zip, after its directory has been checked; `refuse` makes the error."""
    try:
        with zipfile.ZipFile(io.BytesIO(source)) as archive:
            entries = archive.infolist()
            if len(entries) != len({entry.filename for entry in entries}):
                raise refuse("it names a member twice")
            declared = sum(entry.file_size for entry in entries)
            if declared > SMALL_BYTES + MAX_INFLATION * len(source):
                raise refuse(f"it claims to unpack to {declared:,} bytes from {len(source):,}")
            return {entry.filename: archive.read(entry) for entry in entries}
    except _ZIP_ERRORS as error:
        raise refuse(f"not a readable zip: {error or type(error).__name__}") from error


def read_npz(source: bytes, refuse: Refuse) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz; no pickles, and no array larger than the bytes it came in."""
    members = read_zip(source, refuse)
    return {name.removesuffix(".npy"): _read_npy(name, content, refuse) for name, content in members.items()}


def _read_npy(name: str, content: bytes, refuse: Refuse) -> NDArray[Any]:
    buffer = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(buffer)
        if version == (1, 0):
            shape, fortran, dtype = np.lib.format.read_array_header_1_0(buffer)
        elif version == (2, 0):
            shape, fortran, dtype = np.lib.format.read_array_header_2_0(buffer)
        else:
            raise refuse(f"array {name!r} has the unknown format version {version}")
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError, OverflowError) as error:
        raise refuse(f"array {name!r} has a damaged header: {error}") from error
    if dtype.kind not in "fiubU":
        raise refuse(f"array {name!r} holds {dtype} objects, which could run code; only numbers and text are read")
    expected = math.prod(shape) * dtype.itemsize
    rest = content[buffer.tell() :]
    if any(size < 0 for size in shape) or expected != len(rest):
        raise refuse(f"array {name!r} claims {expected:,} bytes and has {len(rest):,}")
    try:
        flat = np.frombuffer(rest, dtype=dtype) if expected else np.zeros(0, dtype=dtype)
        return flat.reshape(shape, order="F" if fortran else "C").copy()
    except (ValueError, TypeError) as error:
        raise refuse(f"array {name!r} is damaged: {error}") from error
