"""What helps to find a mistake, in one zip: versions, machine, settings, log, tables and the store of a folder.

No pictures; and of addresses nothing but scheme and host. A password that is known, because an older session stored it
or because it stands in an address, is looked for in all that is packed, however it may be written there.
"""

from __future__ import annotations

import getpass
import json
import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from implicam.addresses import only_hosts, replacing_secrets, secrets_of
from implicam.calibration_file import package_version
from implicam.dataset.folder import DESCRIPTION, IMAGES, POINTS, VIEWS
from implicam.errors import ImplicamError, UsageError
from implicam.files import replacing, write_zip
from implicam.logs import LOG
from implicam.session.database import DATABASE, Database, copy_database
from implicam.session.folder import UNDONE, is_session
from implicam.threads import cores

MAX_LOG_BYTES = 5_000_000
"""Of the end of a log."""

MAX_TABLE_BYTES = 50_000_000
"""A table that is larger is left out."""

MAX_LISTED = 5_000
"""Names of files in the list."""


@dataclass
class Packed:
    """What a bug report holds: name -> bytes; and what was left out, in sentences."""

    members: dict[str, bytes] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)


def write_bugreport(folder: Path, output: Path) -> Packed:
    """Pack what helps to find a mistake.

    Args:
        folder: Of a session, or any other that implicam wrote into.
        output: The zip.

    Returns:
        What was packed, and what was left out.

    Raises:
        UsageError: There is no such folder.
        ImplicamError: The zip cannot be written.
    """
    if not folder.is_dir():
        raise UsageError(f"there is no folder {folder}.", fix="name the folder of a session, or of a dataset")
    packed = Packed()
    texts: dict[str, str] = {}
    for name in (f"{LOG}.1", LOG, DESCRIPTION, VIEWS, POINTS):
        text = _read_text(folder / name, packed)
        if text is not None:
            texts[name] = text
    try:
        database = Database.open(folder / DATABASE) if is_session(folder) else None
    except ImplicamError as error:
        database = None
        packed.left_out.append(f"{DATABASE}: {error.what} {error.why}")
    try:
        known = set() if database is None else _stored_secrets(database)
        for text in texts.values():
            known |= secrets_of(text)
        hide = hider(known)
        if database is not None:
            _pack_store(database, hide, packed)
    finally:
        if database is not None:
            database.close()
    packed.members |= {name: hide(text).encode() for name, text in texts.items()}
    packed.members["files.txt"] = hide("\n".join(_list_files(folder)) + "\n").encode()
    about = {**about_this_machine(folder), "left_out": packed.left_out}
    packed.members["about.json"] = hide_in(json.dumps(about, indent=1), hide).encode()
    packed.left_out = [hide(text) for text in packed.left_out]
    with replacing(output) as temporary:
        write_zip(temporary, dict(sorted(packed.members.items())))
    return packed


def about_this_machine(folder: Path) -> dict[str, Any]:
    """Versions and what the machine has; no name of it, and none of its user.

    Args:
        folder: The disk on which it is, is looked at.
    """
    needed = metadata.requires("implicam") if package_version() != "not installed" else None
    wanted = {re.split(r"[ <>=!~;\[(]", text)[0] for text in needed or ()}
    versions = {}
    for name in sorted(wanted | {"numpy", "scipy", "opencv-python-headless"}):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0
    return {
        "implicam": package_version(),
        "python": sys.version,
        "system": platform.platform(),
        "processor": platform.machine(),
        "cores": [cores(), os.cpu_count()],
        "memory_mb": memory // 2**20,
        "disk_free_mb": shutil.disk_usage(folder).free // 2**20,
        "encoding": [sys.getfilesystemencoding(), sys.stdout.encoding],
        "packages": versions,
    }


def hider(known: Iterable[str]) -> Callable[[str], str]:
    """What takes secrets out of a text.

    Args:
        known: Passwords and others that are known.

    Returns:
        Text -> text, without these in any way of writing, with addresses cut to scheme and host, without the name of
        the user in paths.
    """
    replace = replacing_secrets(known)
    home, user = str(Path.home()), re.escape(_user())
    places = re.compile(rf"(?<=[/\\]){user}(?=[/\\])") if user else None

    def hide(text: str) -> str:
        text = only_hosts(replace(text))
        text = text.replace(home, "~") if len(home) > 1 else text
        return places.sub("~", text) if places is not None else text

    return hide


def hide_in(text: str, hide: Callable[[str], str]) -> str:
    """A text without secrets, which may be JSON: then each text in it is looked at as it was before it was written.

    Args:
        text: JSON, or any other.
        hide: As `hider` gives it.
    """
    if text[:1] not in ("{", "[", '"'):
        return hide(text)
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return hide(text)

    def clean(value: Any) -> Any:
        if isinstance(value, str):
            return hide(value)
        if isinstance(value, list):
            return [clean(one) for one in value]
        return {hide(key): clean(one) for key, one in value.items()} if isinstance(value, dict) else value

    return json.dumps(clean(value), ensure_ascii=False, indent=1 if "\n" in text else None)


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):  # of no account
        return ""


def _stored_secrets(database: Database) -> set[str]:
    """Of the addresses of cameras, robot and trigger; an older session has their passwords."""
    found: set[str] = set()
    for (text,) in database.rows("SELECT value FROM settings WHERE key IN ('cameras', 'robot', 'trigger')"):
        for spec in _texts_in(json.loads(text)):
            found |= secrets_of(spec, whole=True)
    return found


def _texts_in(value: Any) -> list[str]:
    if isinstance(value, str):
        return [value]
    return [text for one in value for text in _texts_in(one)] if isinstance(value, list) else []


def _pack_store(database: Database, hide: Callable[[str], str], packed: Packed) -> None:
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / DATABASE
        copy_database(database, copy, lambda text: hide_in(text, hide))
        packed.members[DATABASE] = copy.read_bytes()
    settings = {key: json.loads(text) for key, text in database.rows("SELECT key, value FROM settings ORDER BY key")}
    packed.members["settings.json"] = hide_in(json.dumps(settings, indent=1), hide).encode()


def _read_text(path: Path, packed: Packed) -> str | None:
    """The end of a log, or all of a table; None where there is none, or it is left out."""
    if path.is_symlink() or not path.is_file():
        return None
    size, log = path.stat().st_size, path.name.startswith(LOG)
    if not log and size > MAX_TABLE_BYTES:
        packed.left_out.append(f"{path.name}: {size:,} bytes are too many")
        return None
    with path.open("rb") as file:
        file.seek(max(0, size - MAX_LOG_BYTES) if log else 0)
        return file.read().decode(errors="replace")


def _list_files(folder: Path) -> list[str]:
    """Names and sizes of what is in the folder; of pictures their names alone."""
    lines: list[str] = []
    for path in sorted(folder.rglob("*")):
        if len(lines) == MAX_LISTED:
            return [*lines, "..."]
        if path.is_file() and not path.is_symlink():
            name = path.relative_to(folder).as_posix()
            picture = name.split("/")[0] in (IMAGES, UNDONE)
            lines.append(f"{path.stat().st_size:>12,}  {name}{'  (a picture, not packed)' if picture else ''}")
    return lines
