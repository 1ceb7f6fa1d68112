"""Write files whole or not at all; read zip and NumPy files that may have been tampered with.

Every file is written under a temporary name and then renamed, so that after a crash either the old or the new file is
there, complete. The sizes that a zip or NumPy file declares are checked *before* memory is allocated; pickle is never
used.
"""

from __future__ import annotations

import ctypes
import io
import math
import os
import re
import reprlib
import secrets
import shutil
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from implicam.errors import DatasetError, ImplicamError

# A calibration or dataset is stored uncompressed by us, so a member is never larger than its file. Others may
# deflate: text shrinks perhaps tenfold, zip bombs a thousandfold. Bzip2 and LZMA may ask for
# gigabytes before the first byte, and NumPy files are not written with them: they are refused.
MAX_INFLATION_RATIO = 100
MIN_INFLATED_BYTES = 1 << 24

_ZIP_ERRORS = (
    zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, KeyError, ValueError, OSError,
    IndexError, OverflowError, MemoryError, struct.error,
)  # fmt: skip
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1

# The one header that NumPy writes. Matching it, rather than evaluating it as Python, is all the parsing we need.
_NPY_HEADER = re.compile(
    r"\{\s*'descr':\s*'([<>|=]?[fiubU][0-9]{1,6})',\s*'fortran_order':\s*(True|False),"
    r"\s*'shape':\s*\(((?:[0-9]{1,15},\s*)*(?:[0-9]{1,15}\s*)?)\)\s*(?:,\s*)?\}\s*"
)
_MAX_NPY_HEADER_BYTES = 10_000


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside a path; on leaving without error, rename it into place.

    Args:
        path: The file to write; missing folders above it are made.

    Yields:
        The temporary path, an empty file.

    Raises:
        ImplicamError: There is a folder of this name, or the system refuses to write.
    """
    path = Path(path)
    refuse_folder(path)
    parent = _existing_folder(path.parent)
    with convert_write_errors(str(path)):
        temporary = _partial_path(path, parent)
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))  # the umask applies
        try:
            yield temporary
            _flush(temporary)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


ENDINGS_OF_FILES = frozenset((
    ".csv", ".tsv", ".txt", ".xlsx", ".xls", ".xlsm", ".xlsb", ".ods", ".numbers", ".parquet", ".feather", ".npz",
    ".npy", ".json", ".toml", ".yaml", ".yml", ".xml", ".html", ".htm", ".pdf", ".png", ".svg", ".jpg", ".jpeg", ".tif",
    ".tiff", ".mat", ".h5", ".hdf5", ".pkl", ".zip", ".implicam", ".onnx",
    ".md", ".rst", ".log", ".db", ".py", ".ipynb", ".avi", ".mp4", ".mov", ".mkv",
))  # fmt: skip
"""Endings that promise what is in a file; another form is not written under such a name."""


def is_file_name(path: Path) -> bool:
    """Whether a name ends as one of `ENDINGS_OF_FILES`.

    Args:
        path: What is to be written.
    """
    return path.suffix.lower() in ENDINGS_OF_FILES


def refuse_folder(path: Path) -> None:
    """Check that a file can have a name.

    Args:
        path: The file to be written.

    Raises:
        ImplicamError: There is a folder of this name.
    """
    if path.is_dir():
        raise ImplicamError(
            f"{path} is a folder, and a file is to be written.", fix=f"name a file, {path / 'NAME'} say"
        )


def refuse_other_files(folder: Path, ours: Callable[[str], bool], what: str) -> None:
    """Check that writing a folder anew would delete nothing but what was written there before.

    Args:
        folder: The folder to be written; it need not exist.
        ours: Whether a file is one of those that are written; its path in the folder, with slashes.
        what: What is written, for the error.

    Raises:
        DatasetError: It is a file, or holds something else.
    """
    if not folder.is_dir():
        if folder.exists():
            raise DatasetError(
                f"{folder} is a file, and a folder is to be written.", fix="choose another name, or remove the file"
            )
        return
    entries = (entry for entry in folder.rglob("*") if entry.is_symlink() or not entry.is_dir())
    others = sorted(name for entry in entries if not ours(name := entry.relative_to(folder).as_posix()))
    if others:
        raise DatasetError(
            f"{folder} holds {reprlib.repr(others[0])}, which is no part of {what}.",
            why="the folder would be replaced, and this be lost",
            fix="choose a new folder",
        )


@contextmanager
def replacing_folder(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """As `replacing`, for a folder; an existing one is swapped when all is ready.

    Where the system cannot swap two folders in one step, a kill in the instant between two renames leaves the old
    folder beside its place; `find_left_behind` finds it, and nothing is lost.

    Args:
        path: The folder to write.
        overwrite: Whether to replace a folder that is not empty.

    Yields:
        The temporary path, an empty folder.

    Raises:
        ImplicamError: There is a file of this name, or a folder that must not be replaced, or the system refuses to
            write.
    """
    path = Path(path).resolve()
    if path.exists() and not path.is_dir():
        raise ImplicamError(f"{path} is a file, not a folder.", fix="choose another name, or remove the file")
    if path.exists() and not overwrite and not (path.is_dir() and not any(path.iterdir())):
        raise ImplicamError(
            f"{path} already exists.",
            why="writing into it would mix old and new files",
            fix="choose another name, remove it, or add --overwrite",
        )
    parent = _existing_folder(path.parent)
    with convert_write_errors(str(path)):
        temporary = _partial_path(path, parent)
        temporary.mkdir()
        try:
            yield temporary
            for file in sorted(temporary.rglob("*")):
                if file.is_file():
                    _flush(file)
            _swap_in(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def _swap_in(temporary: Path, path: Path) -> None:
    if not path.exists():
        temporary.rename(path)
        return
    if _exchanged(temporary, path):
        return  # the caller removes what is the old folder now
    retired = temporary.with_name(temporary.name + _RETIRED)
    path.rename(retired)
    try:
        temporary.rename(path)
    except BaseException:
        retired.rename(path)
        raise
    shutil.rmtree(retired, ignore_errors=True)


def _exchanged(a: Path, b: Path) -> bool:
    """Swap two folders in one step, where the system can: Linux, and most of its file systems."""
    try:
        swap = ctypes.CDLL(None).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    return bool(swap(here, os.fsencode(a), here, os.fsencode(b), exchange) == 0)


_RETIRED = ".old"


def _partial_prefix(path: Path) -> str:
    return f".{path.name}.partial-"


def _partial_path(path: Path, parent: Path) -> Path:
    """A name that nothing has yet. `tempfile` would give what it makes rights of its own, and the umask, by which to
    correct them, can only be read by changing it for the whole process."""
    return parent / f"{_partial_prefix(path)}{secrets.token_hex(4)}"


def find_left_behind(path: Path) -> Path | None:
    """The old folder that a kill in the middle of `replacing_folder` left behind.

    Args:
        path: The folder that is missing.

    Returns:
        The old folder beside it; None where there is none, or `path` exists.
    """
    path = Path(path).absolute()
    if path.exists() or not path.parent.is_dir():
        return None
    found = [
        entry
        for entry in path.parent.iterdir()
        if entry.name.startswith(_partial_prefix(path)) and entry.name.endswith(_RETIRED)
    ]
    return max(found, default=None, key=lambda entry: entry.stat().st_mtime)


@contextmanager
def convert_write_errors(what: str, check: str = "the name, the permissions and the free space") -> Iterator[None]:
    """Turn an error of the system into an ImplicamError that says what to check.

    Args:
        what: What is written, in words.
        check: What to check, in words.

    Raises:
        ImplicamError: The system refuses to write.
    """
    try:
        yield
    except OSError as error:
        raise ImplicamError(f"cannot write {what}.", why=str(error), fix=f"check {check}") from error


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


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all.

    Args:
        path: The file.
        text: Its content.

    Raises:
        ImplicamError: It cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


def toml_text(table: Mapping[str, Any]) -> str:
    """A dict as TOML.

    Args:
        table: Plain values.
    """
    import tomli_w  # late, so that `import implicam` needs NumPy and SciPy only

    return tomli_w.dumps(table)


def write_zip(file: Path | io.BytesIO, members: Mapping[str, bytes]) -> None:
    """Write an uncompressed zip whose bytes depend on the members only (no dates).

    Args:
        file: Where to.
        members: Name -> content.
    """
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0)), content)


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Arrays as the bytes of an .npz, the same bytes for the same arrays.

    Args:
        arrays: Name -> array; no objects.

    Raises:
        ValueError: An array holds objects.
    """
    members = {}
    for name, array in arrays.items():
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, np.asarray(array, order="C"), allow_pickle=False)
        members[f"{name}.npy"] = buffer.getvalue()
    archive = io.BytesIO()
    write_zip(archive, members)
    return archive.getvalue()


Refuse = Callable[[str], ImplicamError]
"""Turns a reason into the error that the reading module raises."""


def read_zip(source: bytes | Path, refuse: Refuse, *, most: int | None = None) -> dict[str, bytes]:
    """Read the members of a zip, after its directory has been checked.

    Args:
        source: The zip, or where it is.
        refuse: Makes the error from a reason.
        most: How many bytes all members may have together; None for what a zip of this size can plausibly hold.

    Returns:
        Name of the member -> its content.

    Raises:
        ImplicamError: What `refuse` makes: the zip is damaged, too large, encrypted, or names a member twice.
    """
    try:
        with zipfile.ZipFile(source if isinstance(source, Path) else io.BytesIO(source)) as archive:
            size = source.stat().st_size if isinstance(source, Path) else len(source)
            entries = archive.infolist()
            _check_directory(entries, size, max_inflated_bytes(size) if most is None else most, refuse)
            return {entry.filename: _member(archive, entry) for entry in entries}
    except _ZIP_ERRORS as error:
        raise refuse(f"not a readable zip: {str(error)[:200] or type(error).__name__}") from error


def max_inflated_bytes(size: int) -> int:
    """How many bytes a zip can plausibly hold.

    Args:
        size: Of the zip, bytes.
    """
    return MIN_INFLATED_BYTES + MAX_INFLATION_RATIO * size


def _check_directory(entries: list[zipfile.ZipInfo], size: int, most: int, refuse: Refuse) -> None:
    if len(entries) != len({entry.filename for entry in entries}):
        raise refuse("it names a member twice")
    declared = sum(entry.file_size for entry in entries)
    if declared > most:
        raise refuse(f"it claims to unpack to {declared:,} bytes from {size:,}")
    for entry in entries:
        if entry.flag_bits & _ENCRYPTED:
            raise refuse(f"its member {entry.filename[:60]!r} is encrypted")
        if entry.compress_type not in _COMPRESSIONS:
            raise refuse(f"its member {entry.filename[:60]!r} is compressed by an unusual method")


def _member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    # read() without a number inflates everything before it cuts to the declared size: a zip bomb would fill the memory
    with archive.open(entry) as file:
        content = file.read(entry.file_size)
    if len(content) != entry.file_size:
        raise EOFError(f"member {entry.filename[:60]!r} is cut off")
    return content


def read_npz(source: bytes | Path, refuse: Refuse, *, most: int | None = None) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz; no pickles, and no array larger than the bytes it came in.

    Args:
        source: The .npz, or where it is.
        refuse: Makes the error from a reason.
        most: How many bytes all arrays may have together; None for what a file of this size can plausibly hold.

    Returns:
        Name -> array.

    Raises:
        ImplicamError: What `refuse` makes: as `read_zip`, or an array is damaged or holds objects.
    """
    members = read_zip(source, refuse, most=most)
    for name in members:
        if not name.endswith(".npy"):
            raise refuse(f"its member {name[:60]!r} is no array")
    return {name.removesuffix(".npy"): _read_npy(name[:60], content, refuse) for name, content in members.items()}


def _read_npy(name: str, content: bytes, refuse: Refuse) -> NDArray[Any]:
    if content[:8] not in (b"\x93NUMPY\x01\x00", b"\x93NUMPY\x02\x00"):
        raise refuse(f"array {name!r} is not in a format that NumPy writes")
    start, width = (10, "<H") if content[6] == 1 else (12, "<I")
    if len(content) < start:
        raise refuse(f"array {name!r} is cut off")
    end = start + struct.unpack(width, content[8:start])[0]
    header = content[start : min(end, start + _MAX_NPY_HEADER_BYTES)].decode("latin-1")
    match = _NPY_HEADER.fullmatch(header)
    if match is None:
        raise refuse(
            f"array {name!r} holds objects, which could run code, or has a damaged header: {header[:80].strip()!r}; "
            "only numbers and text are read"
        )
    try:
        dtype = np.dtype(match[1])
        shape = tuple(int(size) for size in match[3].replace(",", " ").split())
        expected = math.prod(shape) * dtype.itemsize
        if expected != len(content) - end:
            raise ValueError(f"its shape {shape} takes {expected:,} bytes, and it has {max(0, len(content) - end):,}")
        flat = np.frombuffer(content, dtype=dtype, offset=end) if expected else np.zeros(0, dtype=dtype)
        if dtype.kind == "U" and expected:
            letters = np.frombuffer(content, dtype=np.dtype("u4").newbyteorder(dtype.byteorder), offset=end)
            if letters.max() > sys.maxunicode:  # NumPy would make a str of it that crashes Python
                raise ValueError("its text has letters that do not exist")
        return flat.reshape(shape, order="F" if match[2] == "True" else "C").copy()
    except (ValueError, TypeError) as error:
        raise refuse(f"array {name!r} is damaged: {str(error)[:200]}") from error
