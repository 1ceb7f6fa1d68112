"""What is given to read: files or a folder; the values in a file as a table, and the names in it, for errors."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from implicam.dataset.tables import parse_toml
from implicam.errors import DatasetError, import_extra
from implicam.exchange.checks import as_table, list_names, read_text, shorten

_YAML_KEY = re.compile(r"""^(["']?)([A-Za-z_][-\w. ]{0,80})\1[ \t]*:(?:[ \t]|$)""", re.MULTILINE)


@dataclass(frozen=True)
class Source:
    """What a format is recognised by. paths: as given, at least one."""

    paths: tuple[Path, ...]

    @property
    def path(self) -> Path:
        """The first of the paths."""
        return self.paths[0]

    @cached_property
    def file_names(self) -> frozenset[str]:
        """The names of the files given, of a folder those of the files in it."""
        return frozenset(file.name for path in self.paths for file in (path.iterdir() if path.is_dir() else [path]))

    @cached_property
    def text(self) -> str:
        """The text of the first file; empty of a folder."""
        return "" if self.path.is_dir() else read_text(self.path)

    @cached_property
    def toml(self) -> dict[str, Any]:
        """The first file as TOML, whatever its name; empty where it is none. DatasetError if its name promises it."""
        if self.path.suffix.lower() == ".toml" and not self.path.is_dir():
            return read_toml(self.path)
        with suppress(ValueError, RecursionError):
            return parse_toml(self.text)
        return {}

    @cached_property
    def keys(self) -> tuple[str, ...]:
        """The names at the top of all files, in their order; none of folders, and where a file has none."""
        found: dict[str, None] = {}
        for path in self.paths:
            if not path.is_dir():
                found.update(dict.fromkeys(_top_keys(self.text if path == self.path else read_text(path))))
        return tuple(found)

    def described(self) -> str:
        """What is in it, as a part of an error message."""
        if self.path.is_dir():
            return f"the folder holds {list_names(sorted(self.file_names)) or 'nothing'}"
        if self.keys:
            return f"it has the keys {list_names(self.keys)}"
        first = next((line.strip() for line in self.text.splitlines() if line.strip()), "")
        return f"it begins with {shorten(first)}" if first else "it is empty"


def _top_keys(text: str) -> Iterable[str]:
    """The names at the top of YAML, JSON, XML or TOML; a file that cannot be parsed has those that can be seen."""
    head = text.lstrip()[:1]
    if head == "<":
        with suppress(ElementTree.ParseError, ValueError):
            root = _parse_xml(text)
            return [root.tag, *(child.tag for child in root)]
        return []
    if head == "{":
        with suppress(ValueError, RecursionError):
            return [str(key) for key in json.loads(text)]
    if re.search(r"^\s*\[[^\]\n]+\]\s*$", text, re.MULTILINE):
        with suppress(ValueError, RecursionError):
            return parse_toml(text)
    return [match[2].strip() for match in _YAML_KEY.finditer(text)]


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML, JSON or XML file, as OpenCV writes them, as a dict in which every value is text, a list or a dict.

    Tags, merges and types are not looked at: nothing in the file is run, and a few hundred bytes cannot unfold.

    Args:
        path: The file.

    Raises:
        DatasetError: There is no such file, or it is no YAML, JSON or XML with a table at its top.
        MissingExtraError: PyYAML is not installed.
    """
    text = read_text(path)
    if text.lstrip().startswith("<"):
        root = read_xml(path)
        return as_table(_value_of(root), str(path))
    yaml = import_extra("yaml", "exchange", "reading YAML")
    first, _, rest = text.lstrip().partition("\n")
    if first.startswith("%YAML"):  # OpenCV 4 writes "%YAML:1.0", which is no YAML directive
        text = "\n" + rest
    text = re.sub(r"\n(---|\.\.\.)\s*\Z", "\n", text)  # the end of a message that a program printed
    try:
        table = yaml.load(text, Loader=yaml.BaseLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise DatasetError(
            f"{path}: not valid YAML.",
            why=str(error).replace("\n", " ")[:300] or type(error).__name__,
            fix="correct the file there, or export it again, whole",
        ) from None
    return as_table(table, str(path))


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file as a dict.

    Args:
        path: The file.

    Raises:
        DatasetError: There is no such file, or it is no TOML.
    """
    try:
        return parse_toml(read_text(path))
    except ValueError as error:
        raise DatasetError(
            f"{path}: not valid TOML: {str(error)[:200]}.", fix="correct the file there, or export it again, whole"
        ) from None


def read_xml(path: Path) -> ElementTree.Element:
    """Read an XML file; one that defines entities, which could unfold without end, is refused.

    Args:
        path: The file.

    Returns:
        Its root.

    Raises:
        DatasetError: There is no such file, or it is no such XML.
    """
    try:
        return _parse_xml(read_text(path))
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise DatasetError(
            f"{path}: not valid XML: {str(error)[:200]}.", fix="correct the file there, or export it again, whole"
        ) from None


def _parse_xml(text: str) -> ElementTree.Element:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it has a document type, which no file of cameras needs")
    body = re.sub(r"^\s*<\?xml[^>]*\?>", "", text)  # the text is decoded already
    return ElementTree.fromstring(body)


def _value_of(element: ElementTree.Element) -> Any:
    """An element of OpenCV's XML as its YAML would be read."""
    children = list(element)
    if not children:
        text = (element.text or "").strip().strip('"')
        return text.split() if element.tag in ("data", "sizes") else text
    if all(child.tag == "_" for child in children):
        return [_value_of(child) for child in children]
    return {child.tag: _value_of(child) for child in children}
