"""Public functions and methods with arguments have a docstring with a section Args, and it names the arguments that
they have. A folder with none missing is complete, and stays so.

`python tests/test_docstrings.py` prints how many are missing in each folder, and with the name of a folder which."""

from __future__ import annotations

import ast
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "implicam"

INCOMPLETE = {"cli", "viewer"}
"""Folders in which sections are still missing; "implicam" is the modules beside them. Take out what is complete."""

UNFINISHED_FILES: set[str] = set()
"""Files of complete folders in which sections are still missing."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


class Documented(NamedTuple):
    """A public function with arguments, and what its docstring says of them."""

    file: str
    name: str
    arguments: list[str]
    in_docstring: list[str]

    @property
    def folder(self) -> str:
        return self.file.split("/")[0] if "/" in self.file else "implicam"

    def __str__(self) -> str:
        return f"{self.file}: {self.name}({', '.join(self.arguments)})"


def functions(node: ast.Module | ast.ClassDef, prefix: str = "") -> Iterator[tuple[str, Function]]:
    """The public functions of a module, and the public methods of its public classes."""
    for one in node.body:
        if isinstance(one, Function | ast.ClassDef) and not one.name.startswith("_"):
            if isinstance(one, ast.ClassDef):
                yield from functions(one, f"{prefix}{one.name}.")
            elif not any(ast.unparse(decorator) == "overload" for decorator in one.decorator_list):
                yield prefix + one.name, one


def arguments_of(function: Function, *, is_method: bool) -> list[str]:
    a = function.args
    names = [one.arg for one in (*a.posonlyargs, *a.args)]
    if is_method and not any(ast.unparse(decorator) == "staticmethod" for decorator in function.decorator_list):
        names = names[1:]
    return names + [one.arg for one in (a.vararg, *a.kwonlyargs, a.kwarg) if one is not None]


def arguments_in(docstring: str) -> list[str]:
    """The arguments that a section Args names."""
    section = re.search(r"^Args:\n((?: .*\n|\n)*)", docstring + "\n", re.M)
    return re.findall(r"^    \**(\w+): \S", section[1], re.M) if section else []


def documented(text: str, file: str = "module.py") -> list[Documented]:
    found = []
    for name, function in functions(ast.parse(text)):
        arguments = arguments_of(function, is_method="." in name)
        if arguments:
            found.append(Documented(file, name, arguments, arguments_in(ast.get_docstring(function) or "")))
    return found


def all_documented() -> list[Documented]:
    files = sorted(PACKAGE.rglob("*.py"))
    return [one for path in files for one in documented(path.read_text(), path.relative_to(PACKAGE).as_posix())]


ALL = all_documented()


@pytest.mark.parametrize("folder", sorted({one.folder for one in ALL} - INCOMPLETE))
def test_a_complete_folder_stays_complete(folder: str) -> None:
    ours = [one for one in ALL if one.folder == folder and one.file not in UNFINISHED_FILES]
    missing = [str(one) for one in ours if not one.in_docstring]
    assert not missing, "give these a section Args in their docstrings:\n" + "\n".join(missing)


def test_arguments_in_docstrings_are_those_of_the_function() -> None:
    """All of them, in their order."""
    wrong = [f"{one} says {one.in_docstring}" for one in ALL if one.in_docstring not in ([], one.arguments)]
    assert not wrong, "\n".join(wrong)


def test_the_lists_of_what_is_incomplete_name_what_is_there() -> None:
    assert {one.folder for one in ALL} >= INCOMPLETE
    assert {one.file for one in ALL} >= UNFINISHED_FILES


def test_what_is_read() -> None:
    text = '''
def _private(a): pass
def bare(): pass
def f(a, *b, c=1, **d):
    """Say something.

    Args:
        a: Of it.
            more: of it.
        b: Others.

    Returns:
        c: no argument.
    """
class A:
    def m(self, x): pass
    @staticmethod
    def s(x):
        """Args: no section."""
    @property
    def p(self): pass
class _B:
    def m(self, x): pass
'''
    f, m, s = documented(text)
    assert (f.name, f.arguments, f.in_docstring) == ("f", ["a", "b", "c", "d"], ["a", "b"])
    assert (m.name, m.arguments, m.in_docstring) == ("A.m", ["x"], [])
    assert (s.name, s.arguments, s.in_docstring) == ("A.s", ["x"], [])


if __name__ == "__main__":
    missing = [one for one in ALL if not one.in_docstring]
    for folder, total in sorted(Counter(one.folder for one in ALL).items()):
        print(f"{folder:14}{sum(one.folder == folder for one in missing):4} of {total}")
    print(*(one for one in missing if one.folder in sys.argv[1:]), sep="\n")
