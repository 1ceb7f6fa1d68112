"""Settings of a method on the command line: from a file that sets some, and all of them to be read."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from implicam.calibrators import Calibration, Calibrator
from implicam.calibrators.protocol import SETTINGS
from implicam.dataset.tables import parse_toml
from implicam.errors import UsageError
from implicam.settings import Described, Settings

SettingsFile = Annotated[
    Path | None,
    typer.Option("--settings", metavar="FILE", help="Priors and thresholds, a TOML file of NAME = VALUE lines."),
]
ShowSettings = Annotated[
    bool, typer.Option("--settings", help="Show all priors and thresholds: a file for calibrate --settings.")
]

LINE_WIDTH = 100
"""Characters of a line of text."""


def with_settings(calibrator: Calibrator, path: Path | None) -> Calibrator:
    """The calibrator with the settings that a TOML file changes.

    Raises:
        UsageError: the file cannot be read, the method has no settings, or one of them is unknown or makes no sense.
    """
    if path is None:
        return calibrator
    usual = settings_of(calibrator)
    if usual is None:
        raise UsageError(f"{calibrator.method} has no settings.", fix="leave --settings out")
    table = _read(path)
    try:
        settings = type(usual).from_table(table)
    except UsageError as error:
        raise UsageError(
            f"{path}: {error.what}",
            why=f"the settings are those of {calibrator.method}",
            fix=f"{error.fix}; implicam info FILE --settings shows all, of a calibration by {calibrator.method}",
        ) from error
    return replace(calibrator, settings=settings)  # type: ignore[type-var]


def _idle(holder: Calibrator | Calibration) -> frozenset[str]:
    """Names of the settings that do nothing with the options of a calibration."""
    return frozenset(getattr(getattr(holder, "calibrator", holder), "idle_settings", ()))


def settings_of(holder: Calibrator | Calibration) -> Settings | None:
    """The settings of a calibrator, or of the one that made a calibration; None where it has none."""
    found = getattr(getattr(holder, "calibrator", holder), SETTINGS, None)
    return found if isinstance(found, Settings) else None


def _read(path: Path) -> dict[str, Any]:
    """A flat table of TOML."""
    fix = "write a line for each setting: max_squared_mahalanobis = 30.0"
    try:
        table = parse_toml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(
            f"the settings {path} cannot be read.", why=error.strerror or str(error), fix="check the name"
        ) from error
    except ValueError as error:  # no TOML, or no UTF-8
        raise UsageError(f"{path} is no TOML file.", why=str(error), fix=fix) from error
    for name, value in table.items():
        if isinstance(value, Mapping):
            raise UsageError(
                f"{path}: [{name}] is a table, and settings are not in tables.", fix=f"take that line out; {fix}"
            )
    return table


def settings_text(calibration: Calibration) -> str:
    """All settings of a calibration as TOML, each with its text, its unit and its default; last those that do nothing
    with its options.

    Raises:
        UsageError: its method has none.
    """
    settings, idle = _needed(calibration), _idle(calibration)
    changed = len(settings.changed())
    of = f"{calibration.method}: {len(settings.described())} settings, "
    lines = [f"# {of}{'all at their defaults' if not changed else f'{changed} not at the default'}"]
    in_force = [one for one in settings.described() if one.name not in idle]
    lines += [line for one in in_force for line in _setting_lines(one)]
    if idle:
        lines += ["", f"# --- {len(idle)} settings that do nothing with the options of this calibration ---"]
        lines += [line for one in settings.described() if one.name in idle for line in _setting_lines(one)]
    return "\n".join(lines)


def _setting_lines(one: Described) -> list[str]:
    usual = "" if one.value == one.default else f"; the default is {_toml(one.default)}"
    text = [f"# {line}" for line in textwrap.wrap(one.text, LINE_WIDTH - 2)]
    return ["", *text, f"{one.name} = {_toml(one.value)}  # {one.unit}{usual}"]


def settings_table(calibration: Calibration) -> dict[str, Any]:
    """The same for machines; UsageError where its method has none."""
    idle = _idle(calibration)
    return {
        "method": calibration.method,
        "settings": [
            one._replace(value=_plain(one.value), default=_plain(one.default))._asdict()
            | {"in_force": one.name not in idle}
            for one in _needed(calibration).described()
        ],
    }


def _needed(calibration: Calibration) -> Settings:
    settings = settings_of(calibration)
    if settings is None:
        raise UsageError(f"{calibration.method} has no settings.", fix="leave --settings out")
    return settings


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _toml(value: Any) -> str:
    return repr(_plain(value))
