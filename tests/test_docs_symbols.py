"""What the documentation says of the code is so: its names and files exist, the constants of docs/method.md have the
values that it gives.

In backticks, outside of blocks of code, these are taken for names of the package:

- what Python reads as an attribute or a call: `fit.fit_rig`, `CameraModel.rows`, `compare(data, methods)`. It begins
  with a module (the last part of its name is enough), a class, a function of the package, or a variable of VARIABLES;
- in docs/method.md every bare name too, and after a comma it belongs to the module or class of the one before it;
- in all other files, bare names in CamelCase;
- what ends in `.py`, in backticks or not, is a file of the repository; other files (SUFFIXES) are not looked at.

Options, commands, file contents and formulas are no Python expressions of these kinds, or bare words, and are skipped.
"""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest

from implicam.calibrators.forward_gp.settings import DEFAULT_SETTINGS

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "implicam"
METHOD = ROOT / "docs" / "method.md"
DOCUMENTS = sorted([*ROOT.glob("docs/*.md"), *ROOT.glob("docs/decisions/*.md"), *ROOT.glob("*.md")])
DOCUMENTS.remove(ROOT / "CHANGELOG.md")  # history

CONSTANTS = "## Constants"
"""Head of the table in docs/method.md that the last test reads."""

SUFFIXES = {
    "log",
    "avi", "cpp", "cti", "csv", "db", "hpp", "html", "implicam", "jpg", "json", "jsonl", "md", "npz", "parquet",
    "onnx", "png", "table", "tif", "toml", "tsv", "txt", "xml", "yaml", "yml",
}  # fmt: skip
"""What files end in that the documentation names."""

VARIABLES = {
    "ic": "implicam",
    "calibration": "implicam.calibrators.Calibration",
    "measured": "implicam.measurement.Measurement",
    "measurement": "implicam.measurement.Measurement",
    "loop": "implicam.active.Loop",
    "tested": "implicam.verification.Verification",
}
"""What a name that is no module, class or function stands for in the documentation."""

OTHERS = {"cv2", "scipy", "numpy", "functools"}
"""Libraries that the documentation names."""

NOT_OURS = {"MyMethod", "FileStorage", "sd_x", "sd_y", "sd_z", "message", "accuracy", "calibration_sha256"}
"""Names in examples that the reader is to write, columns of files, and what C++ and other programs call things."""

GONE: dict[str, set[str]] = {}
"""Decision -> names and files of its time that are no longer there. Mend the page rather than add to this."""


@cache
def modules() -> dict[str, list[str]]:
    """The last part of a module's name -> full names."""
    found: dict[str, list[str]] = {}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        found.setdefault(parts[-1], []).append(".".join(parts))
    return found


@cache
def definitions() -> dict[str, list[str]]:
    """Name of a class, function, method or constant -> modules that define it."""
    found: dict[str, list[str]] = {}
    for names in modules().values():
        for module in names:
            path = PACKAGE.parent / module.replace(".", "/")
            source = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text()
            for name in re.findall(r"^ *(?:def|class) (\w+)|^([A-Z_]+)\b", source, re.M):
                found.setdefault("".join(name), []).append(module)
    return found


def member(owner: Any, path: list[str]) -> bool:
    """Whether an attribute of a module or a class is there; fields of a dataclass without a default count."""
    for name in path:
        if isinstance(owner, ModuleType) and f"{owner.__name__}.{name}" in modules().get(name, []):
            importlib.import_module(f"{owner.__name__}.{name}")
        if isinstance(owner, type) and not hasattr(owner, name):
            return any(name in vars(base).get("__annotations__", {}) for base in owner.__mro__)
        if not hasattr(owner, name):
            return False
        owner = getattr(owner, name)
    return True


def resolved(name: str) -> Any:
    """The module or class of a full name."""
    module, _, last = name.rpartition(".")
    return getattr(importlib.import_module(module), last) if last[0].isupper() else importlib.import_module(name)


def owners(first: str) -> Iterator[Any]:
    """What the first part of a dotted name may be."""
    for name in modules().get(first, []):
        yield importlib.import_module(name)
    if first in VARIABLES:
        yield resolved(VARIABLES[first])
    if first.lstrip("_")[:1].isupper():
        found = (importlib.import_module(module) for module in definitions().get(first, []))
        yield from (getattr(module, first) for module in found if hasattr(module, first))


class Name(NamedTuple):
    """A name of the package in a document; `before` is the dotted one that it continues after a comma, if any."""

    dotted: str
    before: str


def names_in(text: str, *, every_name: bool) -> Iterator[Name]:
    """The names of the package in backticks."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    before, end = "", -1
    for span in re.finditer(r"`([^`\n]+)`", text):
        if not every_name or not re.fullmatch(r"[,;]\s+", text[end : span.start()]):
            before = ""
        end = span.end()
        for dotted in expressions(span[1], every_name=every_name):
            starts_anew = dotted.split(".")[0] in {**modules(), **VARIABLES}
            yield Name(dotted, "" if starts_anew else before)
            if "." in dotted:
                before = dotted if starts_anew else f"{before.split('.')[0]}.{dotted}".lstrip(".")


def expressions(code: str, *, every_name: bool) -> Iterator[str]:
    """The dotted or called names in a span of code."""
    try:
        tree = ast.parse(code.strip(), mode="eval").body
    except (SyntaxError, ValueError):
        return
    if isinstance(tree, ast.Name):
        if every_name or re.fullmatch(r"[A-Z][a-z]+[A-Z]\w*", tree.id):
            yield tree.id
    elif isinstance(tree, ast.Attribute):
        if tree.attr not in SUFFIXES | {"py"} and isinstance(tree.value, ast.Name | ast.Attribute):
            yield ast.unparse(tree)
    elif isinstance(tree, ast.Call):
        yield from (ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call))


def exists(name: Name) -> bool:
    first, *rest = name.dotted.split(".")
    if first in OTHERS or name.dotted in NOT_OURS:
        return True
    if name.before:
        module, *classes = name.before.split(".")[:-1]
        inside = [classes[:depth] for depth in range(len(classes) + 1)]
        return any(member(owner, [*path, first, *rest]) for owner in owners(module) for path in inside)
    if rest:
        return any(member(owner, rest) for owner in owners(first))
    return not first.startswith("_") and (first in modules() or first in definitions())


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_names_in_the_documentation_exist(document: Path) -> None:
    text = document.read_text().split(CONSTANTS)[0]
    missing = {name.dotted for name in names_in(text, every_name=document == METHOD) if not exists(name)}
    assert missing == {name for name in GONE.get(document.name, set()) if not name.endswith(".py")}


@cache
def python_files() -> list[str]:
    folders = (ROOT / name for name in ("src", "tests", "benchmarks", "docs"))
    return ["/" + path.relative_to(ROOT).as_posix() for folder in folders for path in folder.rglob("*.py")]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_python_files_in_the_documentation_exist(document: Path) -> None:
    named = re.findall(r"(?<![\w./-])[\w/]+\.py\b", document.read_text())
    missing = {name for name in named if not any(path.endswith("/" + name) for path in python_files())}
    assert missing == {name for name in GONE.get(document.name, set()) if name.endswith(".py")}


def equations(text: str) -> list[str]:
    return re.findall(r"\\tag\{(\w+)\}", text)


def test_equation_numbers_are_unique_and_those_that_the_code_cites_exist() -> None:
    tags = equations(METHOD.read_text())
    assert len(tags) == len(set(tags))
    cited = {
        number
        for path in PACKAGE.rglob("*.py")
        for phrase in re.findall(r"\b[Ee]qs?\. ((?:\(\w+\)(?:,? and |, | to )?)+)", path.read_text())
        for number in re.findall(r"\w+(?=\))", phrase)
    }
    assert len(cited) > 20
    assert cited <= set(tags)


class Constant(NamedTuple):
    """A row of the table of constants in docs/method.md: an expression of the code, and the value it should have."""

    expression: str
    value: str


def constants() -> list[Constant]:
    table = METHOD.read_text().split(CONSTANTS)[1].split("\n## ")[0]
    return [Constant(*row) for row in re.findall(r"^\| `([^`]+)` \| ([^|]+?) \|", table, re.M)]


class Looked(NamedTuple):
    """Stands for a module in an expression: its attributes are those of any module of that name that has them."""

    name: str

    def __getattr__(self, attribute: str) -> Any:
        return next(getattr(owner, attribute) for owner in owners(self.name) if hasattr(owner, attribute))


@pytest.mark.parametrize("constant", constants(), ids=lambda constant: constant.expression)
def test_constants_have_the_values_of_the_method(constant: Constant) -> None:
    names: dict[str, Any] = {"exp": np.exp, "inf": np.inf, "settings": DEFAULT_SETTINGS}
    names |= {name: Looked(name) for name in re.findall(r"\b([a-z]\w*)\.[A-Z]", constant.expression)}
    in_code = np.asarray(eval(constant.expression, names), dtype=float)
    in_text = np.asarray(eval(constant.value, names), dtype=float)
    assert in_code.shape == in_text.shape
    np.testing.assert_allclose(in_code, in_text, rtol=1e-12)


WORDS = ["two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"]
FRACTIONS = {"half": 0.5, "quarter": 0.25, "tenth": 0.1, "twice": 2.0}


def numbers_in(text: str) -> set[float]:
    """The numbers of a text, in digits, as powers of ten, in words; percentages as parts too. No equation numbers."""
    text = re.sub(r"\\tag\{\w+\}|\(\d+\)", "", text)
    text = re.sub(r"([\d.]+) \\cdot 10\^\{?(-?\d+)\}?", r"\1e\2", text)
    text = re.sub(r"\b10\^\{(-?\d+)\}", r"1e\1", text)
    found = {float(number) for number in re.findall(r"(?<![\w.])\d+(?:\.\d+)?(?:e-?\d+)?", text)}
    found |= {float(a) / float(b) for a, b in re.findall(r"(\d+)/(\d+)", text)}
    found |= {float(number) / 100 for number in re.findall(r"([\d.]+)\$? \\?%", text)}
    found |= {number for number, word in enumerate(WORDS, start=2) if re.search(rf"\b{word}\b", text, re.I)}
    return found | {number for word, number in FRACTIONS.items() if re.search(rf"\b{word}\b", text, re.I)}


def test_the_text_of_the_method_quotes_the_constants() -> None:
    """Somewhere: where, a reader has to see."""
    quoted = numbers_in(METHOD.read_text().split(CONSTANTS)[0]) | {np.inf}
    for constant in constants():
        values = np.atleast_1d(eval(constant.value, {"inf": np.inf}))
        assert set(values.tolist()) <= quoted, constant


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("`errors.FitError`, `did_you_mean`, `gp.Kernel`", set()),
        ("`errors.NoSuchError`, `_nothing`", {"errors.NoSuchError", "_nothing"}),
        ("`measurement.Measurement.xyz`, `write_csv`; `MEASURED_COLUMNS`, `nothing`", {"nothing"}),
        ("`errors.FitError`, `Measurement.xyz`, `xyz`", {"Measurement.xyz", "xyz"}),
        ("`calibration.rejected`, `measured.xyz`, `nowhere.xyz`", {"nowhere.xyz"}),
        ('`InverseGP(preset="plain")`, `compare(data, {1: Mine()})`', {"Mine"}),
        ("`--json`, `cells/`, `points.csv`, `x,y,z`, `K (S + place)^-1 K^T`, `make check`, `import implicam`", set()),
        ("```\n`errors.NoSuchError`\n```", set()),
    ],
)
def test_what_is_taken_for_a_name(text: str, wrong: set[str]) -> None:
    assert {name.dotted for name in names_in(text, every_name=True) if not exists(name)} == wrong
