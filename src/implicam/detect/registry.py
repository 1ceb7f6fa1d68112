"""The detectors by name: from the name of a target and options, as the command line has them, to a detector.

CONTRIBUTING.md has the recipe for one more.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from implicam.dataset.folder import DESCRIPTION, read_description
from implicam.detect.aprilgrid import AprilGrid
from implicam.detect.ball import Ball
from implicam.detect.board import Board
from implicam.detect.charuco import Charuco
from implicam.detect.dotgrid import DotGrid
from implicam.detect.dots import Dots
from implicam.detect.model import Detector
from implicam.detect.wand import WandMarkers
from implicam.errors import UsageError, did_you_mean
from implicam.registry import Registry, offers


class DetectorClass(Detector, Protocol):
    """What the registry asks of a detector's class."""

    @classmethod
    def from_options(cls, dataset: Path, described: dict[str, Any], **options: Any) -> Detector:
        """The detector that the options of a command line mean; see `Detector`.

        Args:
            dataset: The folder.
            described: The table `[target]` of dataset.toml.
            **options: Named one by one; None where not given.
        """


TARGETS: Registry[type[Any]] = Registry(
    "target",
    {
        "ball": Ball,
        "board": Board,
        "charuco": Charuco,
        "aprilgrid": AprilGrid,
        "dotgrid": DotGrid,
        "dots": Dots,
        "wand": WandMarkers,
    },
    "implicam.detectors",
    offers(DetectorClass),
)
"""Target -> its detector."""


ALSO_CALLED = {"checkerboard": "board", "chessboard": "board"}
"""Other names that people give a target -> the name in `TARGETS`, which stands in files."""


def options_of(target: str) -> dict[str, inspect.Parameter]:
    """The options that a target has on the command line: the keyword arguments of its detector's `from_options`.

    Args:
        target: A name in `TARGETS`.

    Returns:
        Name -> parameter, with its annotation and default.

    Raises:
        KeyError: There is no such target.
    """
    parameters = inspect.signature(TARGETS[target].from_options, eval_str=True).parameters
    return {name: one for name, one in parameters.items() if one.kind is one.KEYWORD_ONLY}


def detector_from_options(target: str | None, dataset: Path, **options: Any) -> Detector:
    """The detector that finds a target in the pictures of a dataset folder.

    Args:
        target: A name in `TARGETS`; where it is None, the `kind` of the table `[target]` of dataset.toml.
        dataset: The folder; what dataset.toml says of the target fills the options that are not given.
        **options: Those of `options_of(target)`; None and False stand for "not given".

    Raises:
        UsageError: The target or an option is not known, or an option is missing or wrong.
    """
    described = _described_target(dataset)
    name = ALSO_CALLED.get(target or "", target or "") or str(described.get("kind", ""))
    if not name:
        raise UsageError(
            "which target is it?",
            why=f"neither --target nor {dataset / DESCRIPTION} says so",
            fix=f"--target {'|'.join(TARGETS)}",
        )
    _, variant = TARGETS.find(name)
    if variant:
        raise UsageError(f"target {name!r} has no variants.", fix=f"--target {name.partition(':')[0]}")
    known = options_of(name)
    given = {key: value for key, value in options.items() if value is not None and value is not False}
    for key in given:
        if key not in known:
            raise UsageError(
                f"the target {name!r} has no option --{key}{did_you_mean(key, known)}.",
                fix=f"leave it out; {name} has {', '.join(f'--{one}' for one in known) or 'none'}",
            )
    own = described if described.get("kind") == name else {}
    return _made(name, dataset, own, given)


def detector_of(described: Mapping[str, Any]) -> Detector:
    """The detector of a target that a dataset describes.

    Args:
        described: The table [target], with its kind.
    """
    return _made(str(described["kind"]), Path(), described, {})


def _made(name: str, dataset: Path, described: Mapping[str, Any], given: Mapping[str, Any]) -> Detector:
    stated = {key: described[key] for key in options_of(name) if key in described}
    made: Detector = TARGETS[name].from_options(dataset, described, **{**stated, **given})
    return made


def _described_target(dataset: Path) -> dict[str, Any]:
    """The table [target] of dataset.toml."""
    if not (dataset / DESCRIPTION).exists():
        return {}
    table = read_description(dataset)[3].get("target", {})
    return table if isinstance(table, dict) else {}
