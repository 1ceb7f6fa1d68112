"""Whose equipment a session may use: what its folder names is opened only after a person has confirmed it here.

A session folder may come from somebody else, and its store names cameras, a robot and a trigger: addresses that would
be connected to, a library that a camera's driver loads, a box and a speed for an arm. So what was typed on this machine
(beginning the session, or naming the equipment again), and what was confirmed by `--trust`, is remembered outside of
the folder, by the folder's path, value by value. Passwords are not kept, there or in the session.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from implicam.addresses import HIDDEN
from implicam.errors import ImplicamError, UsageError
from implicam.files import write_text
from implicam.films import FILM_ENDINGS
from implicam.hardware import Person
from implicam.images import ENDINGS

DEVICES = ("cameras", "robot", "trigger")
"""The settings that name what is opened."""

LIMITS = ("workspace", "speed", "tool", "dry_run", "unit")
"""Those that say how far and how fast a robot goes."""

_AS_IF_NOT_SAID = (None, False, "", "mm")

NATIVE_ENDINGS = (".cti", ".so", ".dll", ".dylib", ".pyd")
"""Of files with code that a driver would load."""

DATA_ENDINGS = (*ENDINGS, *FILM_ENDINGS, ".csv", ".toml")
"""Of the only files inside of a session's folder that equipment may name: a driver loads a library by any name."""

_FILES = {"rig": (".toml",), "workspace": (".csv",)}
"""Settings that may name a file to be read, by its endings."""

_ALL = (*DEVICES, *LIMITS, *(key for key in _FILES if key not in LIMITS))


def equipment_of(settings: Mapping[str, Any]) -> dict[str, Any]:
    """What a person has to confirm of a session from elsewhere, without passwords.

    Args:
        settings: As the session stores them (`Setup.as_settings`).

    Returns:
        Setting -> value; empty for a simulated rig with a name, which opens nothing.
    """
    robot = settings.get("robot") or ""
    keys = [key for key in DEVICES if settings.get(key)]
    if robot and robot != Person.spec and settings.get("cameras"):
        keys += LIMITS
    keys += [key for key, endings in _FILES.items() if str(settings.get(key)).lower().endswith(endings)]
    return {key: settings.get(key) for key in dict.fromkeys(keys)}


def in_words(equipment: Mapping[str, Any]) -> str:
    """Equipment as the options of the command line that name it; letters that would hide others are shown.

    Args:
        equipment: As `equipment_of` gives it.
    """
    words = [f"--camera {name}={spec}" for name, spec in equipment.get("cameras", ())]
    words += [f"--robot {equipment['robot']}"] if equipment.get("robot") else []
    words += [f"--trigger {spec}" for spec in _triggers(equipment)]
    for key, value in equipment.items():
        if key == "tool" and value is not None:
            words.append(f"--tool={','.join(map(str, value))}")
        elif key == "dry_run":
            words += ["--dry-run"] if value else []
        elif key not in DEVICES and value not in (None, ""):
            words.append(f"--{key}={value}")
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in " ".join(words))


def check_trusted(
    folder: Path, settings: Mapping[str, Any], *, named: Collection[str] = (), trust: bool = False
) -> None:
    """Refuse equipment that nobody has confirmed on this machine; what is confirmed now is remembered.

    Args:
        folder: Of the session.
        settings: All that it is to use.
        named: Settings that a person has named just now.
        trust: Whether the person confirms all of it.

    Raises:
        UsageError: It was not confirmed; the error shows it.
    """
    equipment, before = equipment_of(settings), _read_confirmed(folder)
    left = [
        key for key, value in equipment.items()
        if key not in named and (value != before[key] if key in before else value not in _AS_IF_NOT_SAID)
    ]  # fmt: skip
    if trust or not left:
        _remember(folder, before | {key: settings.get(key) for key in _ALL if key in equipment or key in named})
        return
    raise UsageError(
        f"the session in {folder} names equipment that nobody has confirmed on this machine.",
        why=f"it would use {in_words(equipment)}",
        fix="look at each part; where it is what stands before you, say --trust once, or name it again yourself",
    )


def remember(folder: Path, settings: Mapping[str, Any]) -> None:
    """Keep that a person has named all that a session uses, by beginning it here.

    Args:
        folder: Of the session.
        settings: All that it uses.
    """
    if equipment_of(settings):
        _remember(folder, {key: settings.get(key) for key in _ALL})


def _remember(folder: Path, confirmed: Mapping[str, Any]) -> None:
    """Where it cannot be kept, it is asked again the next time."""
    if not confirmed or _read_confirmed(folder) == confirmed:
        return
    file = _file(folder)
    with suppress(ImplicamError, OSError):
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        write_text(file, json.dumps({"folder": str(folder.resolve()), "equipment": confirmed}, indent=1) + "\n")


def _read_confirmed(folder: Path) -> dict[str, Any]:
    """Setting -> value of what was confirmed of this folder."""
    try:
        kept = json.loads(_file(folder).read_text(encoding="utf-8"))["equipment"]
    except (OSError, ValueError, TypeError, KeyError):
        return {}
    return kept if isinstance(kept, dict) else {}


def check_passwords(folder: Path, settings: Mapping[str, Any]) -> None:
    """Refuse equipment whose passwords a session left out when it was stored.

    Args:
        folder: Of the session.
        settings: All that it is to use.

    Raises:
        UsageError: One has to be named again.
    """
    specs = [(f"camera {name!r}", spec) for name, spec in settings.get("cameras") or ()]
    specs += [("the robot", settings.get("robot") or ""), *(("the trigger", spec) for spec in _triggers(settings))]
    for what, spec in specs:
        if HIDDEN in spec:
            raise UsageError(
                f"the session in {folder} does not know the password of {what}.",
                why=f"passwords are not kept in a session: {spec}",
                fix="name it again with user name and password, all cameras together where it is one: "
                + in_words({key: settings[key] for key in DEVICES if HIDDEN in str(settings.get(key))}),
            )


def check_nothing_native(folder: Path, settings: Mapping[str, Any]) -> None:
    """Refuse code inside of a session's folder, whoever confirms it: it came with the data.

    Args:
        folder: Of the session.
        settings: All that it is to use.

    Raises:
        UsageError: A camera, robot or trigger names a library there.
    """
    inside = folder.resolve()
    specs = [spec for _, spec in settings.get("cameras") or ()] + [settings.get("robot") or "", *_triggers(settings)]
    for spec in specs:
        for part in _paths_in(spec):
            ending = os.path.splitext(part)[1].lower()
            code = ending in NATIVE_ENDINGS or (ending not in DATA_ENDINGS and os.path.isfile(part))
            if code and any(inside in Path(place).parents for place in (os.path.realpath(part), os.path.abspath(part))):
                raise UsageError(
                    f"{part} is inside of the session's folder, and may be code: it is never loaded.",
                    why="it came with the data, and would run as you",
                    fix="name the one that the camera's maker installs, outside of the folder",
                )


def _triggers(settings: Mapping[str, Any]) -> list[str]:
    given = settings.get("trigger") or ()  # older sessions have one text
    return [given] if isinstance(given, str) else list(given)


def _paths_in(spec: str) -> list[str]:
    """What may be a path in a spec: all of it, or what follows a colon, an @ or a comma; to a comma, or to the end."""
    starts = [i for i in range(len(spec)) if i == 0 or spec[i - 1] in ":@=,"]
    texts = [text for i in starts for text in (spec[i:], spec[i:].partition(",")[0]) if text and "\0" not in text]
    return [path for text in texts for path in (text, os.path.expanduser(text))]


def _file(folder: Path) -> Path:
    place = os.fsencode(platform.node()) + b"\0" + os.fsencode(folder.resolve())  # a home may be that of many machines
    return _state_folder() / "trusted" / f"{hashlib.sha256(place).hexdigest()}.json"


def _state_folder() -> Path:
    """Where a program keeps what is of this user on this machine."""
    given = os.environ.get("XDG_STATE_HOME") or (os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else None)
    return (Path(given) if given else Path.home() / ".local" / "state") / "implicam"
