"""The parts that people add, each kind in a registry: lenses, calibrators, acquisitions, detectors, hardware.

A part is found by its name on the command line, in Python and in files. It is added by one line beside the others of
its kind, by `REGISTRY.register(name, part)`, or from a package of its own by an entry point. CONTRIBUTING.md has the
recipes.
"""

from __future__ import annotations

import importlib.metadata
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from importlib.metadata import EntryPoint, EntryPoints
from typing import Any, NamedTuple, TypeVar

from implicam.errors import PartError, UsageError, did_you_mean

Part = TypeVar("Part")


class Option(NamedTuple):
    """An option of the command line that a part brings with it.

    Attributes:
        help: What `--help` says of it, or a function that says it when it is asked for.
        metavar: What stands for its value there.
        minimum: The least value, of a number.
        flags: Its name there, where it is not that of the parameter: "--camera", "--bright/--dark".
        panel: The heading that `--help` lists it under.
        kind: Its type there, where the parameter takes another one as well.
    """

    help: str | Callable[[], str]
    metavar: str = "NAME"
    minimum: float | None = None
    flags: str = ""
    panel: str | None = None
    kind: Any = None

    def told(self) -> str:
        """The help, now."""
        return self.help() if callable(self.help) else self.help


def entry_points(**by: Any) -> EntryPoints:
    """Those of importlib.metadata, which reads the files of all packages whenever it is asked: 3 ms. Here they are read
    again when a package has come or gone.

    Args:
        by: What to select: group, name.
    """
    return _all_entry_points(tuple((path, _changed(path)) for path in sys.path)).select(**by)


@lru_cache(maxsize=1)
def _all_entry_points(places: tuple[tuple[str, int], ...]) -> EntryPoints:
    return importlib.metadata.entry_points()  # type: ignore[return-value]  # typed as that of Python 3.9


def _changed(path: str) -> int:
    try:
        return os.stat(path or ".").st_mtime_ns
    except OSError:
        return 0


class Registry(Mapping[str, Part]):
    """Parts of one kind by name, in the order they were added; entry points of other packages come last.

    Args:
        kind: What an error calls a part: "lens", "robot".
        parts: Name -> part.
        group: The group of entry points that other packages add parts under, such as "implicam.lenses". One is imported
            when it is asked for, not before.
        check: What is wrong with a part that is added under a name, in words; nothing where all is well. `offers` makes
            one.
    """

    def __init__(
        self, kind: str, parts: Mapping[str, Part], group: str, check: Callable[[str, Any], Iterable[str]] | None = None
    ) -> None:
        self.kind, self.group = kind, group
        self._parts = dict(parts)
        self._brought: dict[str, tuple[EntryPoint, Part]] = {}
        self._check = check or (lambda name, part: ())

    def register(self, name: str, part: Part) -> None:
        """Add a part.

        Args:
            name: A new one.
            part: What the others of this registry are.

        Raises:
            ValueError: the name is taken, or holds a colon, which separates a name from its variant.
            PartError: it is no such part; the error says what is missing.
        """
        if name in self._parts or ":" in name or not name:
            raise ValueError(f"{name!r} cannot name a {self.kind}: it is empty, taken, or has a colon")
        wrong = list(self._check(name, part))
        if wrong:
            raise PartError(
                f"what is registered as {name!r} is no {self.kind}: {'; '.join(wrong)}.", fix="see CONTRIBUTING.md"
            )
        self._parts[name] = part

    def find(self, spec: str) -> tuple[Part, str]:
        """The part that a spec names, and what the spec says after the first colon: "ur:10.0.0.2" -> (ur, "10.0.0.2").

        Args:
            spec: A name, or a name, a colon and a variant.

        Returns:
            The part, and the variant; empty where the spec has none.

        Raises:
            UsageError: There is no part of this name; the error says which there are.
        """
        name, _, variant = spec.partition(":")
        if name not in self:
            raise UsageError(
                f"{self.kind} {name!r} is not known{did_you_mean(name, list(self))}.",
                fix=f"use one of {', '.join(self)}",
            )
        clash = self._clash(name)
        if clash is not None:
            raise clash
        return self[name], variant

    def refused(self) -> dict[str, PartError]:
        """Name -> what is wrong, of what other packages bring that cannot be used, or has the name of another part."""
        found = {}
        for name in self:
            try:
                _ = self[name]
            except PartError as error:
                found[name] = error
            else:
                clash = self._clash(name)
                if clash is not None:
                    found[name] = clash
        return found

    def package_of(self, name: str) -> str:
        """The package that brings a part; "implicam" for those here.

        Args:
            name: The name of the part.

        Raises:
            KeyError: There is no part of this name.
        """
        part = self[name]
        entry, brought = self._brought.get(name, (None, None))
        if entry is not None and part is brought:
            return _package(entry)
        module = getattr(part, "__module__", type(part).__module__)
        return str(module).partition(".")[0]

    def importable(self) -> dict[str, Part]:
        """Name -> part, without those of other packages that cannot be imported: for help, which is never refused."""
        found = {}
        for name in self:
            with suppress(PartError):
                found[name] = self[name]
        return found

    def __getitem__(self, name: str) -> Part:
        if name not in self._parts:
            entries = tuple(entry_points(group=self.group, name=name))
            if len(entries) > 1:
                packages = " and ".join(_package(entry) for entry in entries)
                raise PartError(
                    f"the packages {packages} each bring a {self.kind} {name!r}.",
                    why="a part is known by its name",
                    fix="take out all but one: pip uninstall PACKAGE",
                )
            for entry in entries:
                self._parts[name] = self._load(entry)
                self._brought[name] = entry, self._parts[name]
        return self._parts[name]

    def _load(self, entry: EntryPoint) -> Part:
        """A part of another package; PartError, which names the package, where it cannot be used."""
        package = _package(entry)
        cure = f"mend or update {package}, or take it out: pip uninstall {package}"
        try:
            part: Part = entry.load()
        except (Exception, SystemExit) as error:
            raise PartError(
                f"the {self.kind} {entry.name!r} of the package {package} cannot be imported.",
                why=f"{type(error).__name__}: {error}",
                fix=cure,
            ) from error
        wrong = list(self._check(entry.name, part))
        if wrong:
            raise PartError(
                f"the {self.kind} {entry.name!r} of the package {package} is none.",
                why=f"{entry.value} (entry point of {self.group}): {'; '.join(wrong)}",
                fix=cure,
            )
        return part

    def _clash(self, name: str) -> PartError | None:
        """Of a package that brings a part under the name of another one, which stays what it is."""
        entry, part = self._brought.get(name, (None, None))
        if name not in self._parts or (entry is not None and self._parts[name] is part):
            return None
        for other in entry_points(group=self.group, name=name):
            package = _package(other)
            return PartError(
                f"the package {package} brings a {self.kind} {name!r}, a name that is taken.",
                why=f"{self.package_of(name)} has a {self.kind} of this name, and files know it by that",
                fix=f"give it another name in {package}, or take that out: pip uninstall {package}",
            )
        return None

    def __contains__(self, name: object) -> bool:
        return name in self._parts or name in entry_points(group=self.group).names

    def __iter__(self) -> Iterator[str]:
        yield from dict.fromkeys([*self._parts, *sorted(entry_points(group=self.group).names)])

    def __len__(self) -> int:
        return len(list(iter(self)))


def offers(protocol: type, own_name: str = "", *, a_class: bool = True) -> Callable[[str, Any], Iterator[str]]:
    """The check of a registry whose parts are what a protocol says.

    Args:
        protocol: Its public attributes and methods are asked for.
        own_name: The attribute in which a part says its name, which must be that of the registry; empty for none.
        a_class: Parts are classes; if not, they are instances.
    """

    def what_is_wrong(name: str, part: Any) -> Iterator[str]:
        if isinstance(part, type) != a_class:
            yield f"it is {'no class' if a_class else 'a class, and an instance is asked for'}"
            return
        missing = missing_members(part, protocol)
        if missing:
            yield f"it has no {', '.join(missing)}"
        own = getattr(part, own_name, name) if own_name else name
        if own != name:
            yield f"its {own_name} is {own!r}, and it is added as {name!r}: the two must be the same"

    return what_is_wrong


def missing_members(part: Any, protocol: type) -> list[str]:
    """The public attributes and methods of a protocol that a part has not.

    Args:
        part: A class, or an instance.
        protocol: The protocol, with what it inherits.
    """
    bases = [base for base in protocol.__mro__ if base.__module__ not in ("builtins", "typing")]
    asked = {name for base in bases for name in (*vars(base), *vars(base).get("__annotations__", {})) if name[0] != "_"}
    there = {*dir(part), *getattr(part, "__dataclass_fields__", ())}
    return sorted(asked - there)


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else entry.module
