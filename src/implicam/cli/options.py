"""Options of the command line that registered parts bring with them, such as those of detectors."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

import typer

from implicam.calibrators import CALIBRATORS, Calibrator, calibrator, every_option, method_for, options_of
from implicam.dataset import read_dataset
from implicam.registry import Option

Options = Mapping[str, Mapping[str, inspect.Parameter]]


class OptionsOfParts:
    """A command whose `**options` are those of the parts in a registry, as they are when the command is run.

    Args:
        function: the command, with `**options` as its last parameter.
        position: the name of the parameter after which `--help` lists them.
        options: part -> option -> the parameter that describes it: annotated with its type and with `help`, `metavar`
            and `minimum`. An option that several parts have is one option, of the type that it has in the first.
    """

    def __init__(self, function: Callable[..., None], position: str, options: Callable[[], Options]) -> None:
        functools.update_wrapper(self, function)
        self._function, self._position, self._options = function, position, options

    def __call__(self, **given: Any) -> None:
        """Run the command."""
        self._function(**given)

    @property
    def __signature__(self) -> inspect.Signature:
        """What Typer reads to parse the command line."""
        own = list(inspect.signature(self._function, eval_str=True).parameters.values())[:-1]
        place = [parameter.name for parameter in own].index(self._position) + 1
        return inspect.Signature([*own[:place], *_merged(self._options()), *own[place:]])


def options_of_calibrators() -> Options:
    """Method -> option -> the field of its calibrator; a dataset is a path here."""
    return {method: {name: _parameter(method, name) for name in options_of(method)} for method in CALIBRATORS}


def _parameter(method: str, name: str) -> inspect.Parameter:
    about = options_of(method)[name].metadata
    kind = Path if about["is_dataset"] else get_type_hints(CALIBRATORS[method].calibrator)[name]
    described: Any = Annotated[kind | None, Option(about["help"], about["metavar"])]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=described)


def calibrator_from_options(method: str | None, seed: int, options: Mapping[str, Any]) -> Calibrator:
    """The calibrator that the options of a command line mean; those that were not given are None."""
    datasets = {name for name, by in every_option().items() if any(one.metadata["is_dataset"] for one in by.values())}
    read = {name: read_dataset(value) if value and name in datasets else value for name, value in options.items()}
    return calibrator(method or method_for(**read), seed=seed, **read)


def _merged(options: Options) -> list[inspect.Parameter]:
    """One parameter for each option, with the help of all parts that have it."""
    helps: dict[str, dict[str, list[str]]] = {}
    first: dict[str, inspect.Parameter] = {}
    for part, parameters in options.items():
        for name, parameter in parameters.items():
            first.setdefault(name, parameter)
            parts = helps.setdefault(name, {}).setdefault(get_args(parameter.annotation)[1].help, [])
            parts.append(part)
    made = []
    for name, parameter in first.items():
        kind, option = get_args(parameter.annotation)
        text = "; ".join(f"{', '.join(parts)}: {meaning}" for meaning, parts in helps[name].items())
        metavar = None if kind is bool else option.metavar
        told = typer.Option(f"--{name.replace('_', '-')}", help=f"{text}.", metavar=metavar, min=option.minimum)
        made.append(parameter.replace(annotation=Annotated[kind, told], kind=parameter.POSITIONAL_OR_KEYWORD))
    return made
