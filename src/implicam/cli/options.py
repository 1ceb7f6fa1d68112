"""Options of the command line that are written elsewhere: by registered parts, such as detectors, or a dataclass."""

from __future__ import annotations

import copy
import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, get_args, get_type_hints

import typer
from typer.main import get_group

from implicam.calibrators import CALIBRATORS, Calibrator, calibrator, every_option, method_for, options_of
from implicam.dataset import TableOptions, read_dataset
from implicam.registry import Option

Options = Mapping[str, Mapping[str, inspect.Parameter]]

Function = TypeVar("Function", bound=Callable[..., Any])


class OptionsOfParts:
    """A command whose `**options` are those of the parts in a registry, as they are when the command is run.

    They are there after `load`, which asks the parts: so a part that cannot be imported stops no other command.

    Args:
        function: the command, with `**options` as its last parameter.
        position: the name of the parameter after which `--help` lists them.
        options: part -> option -> the parameter that describes it: annotated with its type and with `help`, `metavar`
            and `minimum`. An option that several parts have is one option, of the type that it has in the first.
            A part without a name ("") is not named in `--help`.
    """

    def __init__(self, function: Callable[..., None], position: str, options: Callable[[], Options]) -> None:
        functools.update_wrapper(self, function)
        self._function, self._position, self._options = function, position, options
        self._loaded: Options = {}

    def __call__(self, **given: Any) -> None:
        """Run the command."""
        self._function(**given)

    def load(self) -> None:
        """Ask the parts for their options; UsageError for one of another package that cannot be imported."""
        self._loaded = self._options()

    @property
    def __signature__(self) -> inspect.Signature:
        """What Typer reads to parse the command line."""
        own = list(inspect.signature(self._function, eval_str=True).parameters.values())[:-1]
        place = [parameter.name for parameter in own].index(self._position) + 1
        return inspect.Signature([*own[:place], *_merged(self._loaded), *own[place:]])


def load_options(app: typer.Typer, words: Sequence[str]) -> None:
    """Load the options of the command that the words of a command line name, and of no other."""
    name = next((word for word in words if not word.startswith("-")), "")
    for command in app.registered_commands:
        if command.name == name and isinstance(command.callback, OptionsOfParts):
            command.callback.load()


def only_command(app: typer.Typer, words: Sequence[str]) -> Callable[..., Any]:
    """The command line with nothing but the command that its first word names, and all of it where that is none: Typer
    reads the options of every command it is given, which is most of the time of a short command."""
    named = [command for command in app.registered_commands if command.name == next(iter(words), None)]
    if not named:
        return app
    alone = copy.copy(app)
    alone.registered_commands = named
    return get_group(alone)


def options_of_calibrators() -> Options:
    """Method -> option -> the field of its calibrator; a dataset is a path here."""
    return {method: {name: _parameter(method, name) for name in options_of(method)} for method in CALIBRATORS}


def _parameter(method: str, name: str) -> inspect.Parameter:
    about = options_of(method)[name].metadata
    kind = Path if about["is_dataset"] else get_type_hints(CALIBRATORS[method].calibrator)[name]
    described: Any = Annotated[kind | None, Option(about["help"], about["metavar"])]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=described)


def options_of_fields(made: type, *names: str) -> dict[str, inspect.Parameter]:
    """Field -> the option that a dataclass says it is (`Annotated[type, Option(...)]`); None where it is not given.

    Args:
        made: the dataclass.
        names: of some of its fields, to be listed under no heading; without, all.
    """
    found, fields = {}, inspect.signature(made, eval_str=True).parameters
    for name in names or fields:
        kind, option = get_args(fields[name].annotation)
        default = f" (default {fields[name].default})" if fields[name].default else ""
        option = option._replace(help=option.told() + default, panel=None if names else option.panel)
        described: Any = Annotated[(option.kind or kind) | None, option]
        found[name] = fields[name].replace(default=None, annotation=described)
    return found


def options_of_setup(*names: str) -> Options:
    """Those of a guided session, or some of them.

    Args:
        names: of some of its fields.
    """
    from implicam.session.setup import Setup  # late: of few commands

    return {"": options_of_fields(Setup, *names)}


def with_table_options(function: Function) -> Function:
    """A command whose parameter `table` is made of the options that tables without a description need.

    Args:
        function: with a keyword parameter `table`, a `TableOptions`.
    """
    own = list(inspect.signature(function, eval_str=True).parameters.values())
    place = [parameter.name for parameter in own].index("table")
    options = _merged({"": options_of_fields(TableOptions)})

    @functools.wraps(function)
    def run(**given: Any) -> Any:
        stated = {option.name: given.pop(option.name, None) for option in options}
        table = TableOptions(**{name: value for name, value in stated.items() if value is not None})
        return function(table=table, **given)

    signature = inspect.Signature([*own[:place], *options, *own[place + 1 :]])
    run.__signature__ = signature  # type: ignore[attr-defined]
    return cast(Function, run)


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
            parts = helps.setdefault(name, {}).setdefault(get_args(parameter.annotation)[1].told(), [])
            parts.append(part)
    made = []
    for name, parameter in first.items():
        kind, option = get_args(parameter.annotation)
        text = "; ".join(f"{', '.join(parts)}: {meaning}".removeprefix(": ") for meaning, parts in helps[name].items())
        metavar = None if kind in (bool, bool | None) else option.metavar
        flags = option.flags or f"--{name.replace('_', '-')}"
        told = typer.Option(flags, help=f"{text}.", metavar=metavar, min=option.minimum, rich_help_panel=option.panel)
        made.append(parameter.replace(annotation=Annotated[kind, told], kind=parameter.POSITIONAL_OR_KEYWORD))
    return made
