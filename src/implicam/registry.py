"""The parts that people add: lenses, calibrators, acquisitions, detectors, robots, cameras, each in a registry.

A part is found by its name on the command line, in Python and in files. It is added by one line beside the others of
its kind, by `REGISTRY.register(name, part)`, or from a package of its own by an entry point. CONTRIBUTING.md has the
recipes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from importlib.metadata import EntryPoint, entry_points
from typing import NamedTuple, TypeVar

from implicam.errors import UsageError, did_you_mean

Part = TypeVar("Part")


class Option(NamedTuple):
    """An option of the command line that a part brings with it.

    Attributes:
        help: What `--help` says of it.
        metavar: What stands for its value there.
        minimum: The least value, of a number.
    """

    help: str
    metavar: str = "NAME"
    minimum: float | None = None


class Registry(Mapping[str, Part]):
    """Parts of one kind by name, in the order they were added; entry points of other packages come last.

    Args:
        kind: What an error calls a part: "lens", "robot".
        parts: Name -> part.
        group: The group of entry points that other packages add parts under, such as "implicam.lenses". One is imported
            when it is asked for, not before.
    """

    def __init__(self, kind: str, parts: Mapping[str, Part], group: str) -> None:
        self.kind, self.group = kind, group
        self._parts = dict(parts)

    def register(self, name: str, part: Part) -> None:
        """Add a part.

        Args:
            name: Its name.
            part: The part.

        Raises:
            ValueError: The name is empty, taken, or holds a colon, which separates a name from its variant.
        """
        if name in self._parts or ":" in name or not name:
            raise ValueError(f"{name!r} cannot name a {self.kind}: it is empty, taken, or has a colon")
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
        return self[name], variant

    def importable(self) -> dict[str, Part]:
        """Name -> part, without those of other packages that cannot be imported: for help, which is never refused."""
        found = {}
        for name in self:
            with suppress(UsageError):
                found[name] = self[name]
        return found

    def __getitem__(self, name: str) -> Part:
        if name not in self._parts:
            for entry in entry_points(group=self.group, name=name):
                self._parts[name] = self._load(entry)
        return self._parts[name]

    def _load(self, entry: EntryPoint) -> Part:
        """A part of another package; UsageError, which names the package, where it cannot be imported."""
        try:
            part: Part = entry.load()
        except (Exception, SystemExit) as error:
            package = entry.dist.name if entry.dist is not None else entry.module
            raise UsageError(
                f"the {self.kind} {entry.name!r} of the package {package} cannot be imported.",
                why=f"{type(error).__name__}: {error}",
                fix=f"mend or update {package}, or take it out: pip uninstall {package}",
            ) from error
        return part

    def __contains__(self, name: object) -> bool:
        return name in self._parts or name in entry_points(group=self.group).names

    def __iter__(self) -> Iterator[str]:
        yield from dict.fromkeys([*self._parts, *sorted(entry_points(group=self.group).names)])

    def __len__(self) -> int:
        return len(list(iter(self)))
