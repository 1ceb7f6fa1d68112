"""What pyproject.toml, CITATION.cff, the hooks and the texts say of each other is true."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]


def brought_by(extra: str) -> set[str]:
    """The extras and the libraries that come with an extra."""
    found = {extra}
    for requirement in EXTRAS[extra]:
        name, others = re.findall(r"^([\w-]+)(?:\[([\w,-]+)\])?", requirement)[0]
        if name == "implicam":
            found |= set().union(*(brought_by(other) for other in others.split(",")))
        else:
            found.add(name)
    return found


def test_all_is_all_and_app_is_in_it() -> None:
    assert {"images", "report", "viewer", "exchange"} <= brought_by("app")
    assert brought_by("all") >= set(EXTRAS) - {"dev"}
    assert brought_by("dev") > brought_by("all")


def test_every_extra_that_a_text_or_an_error_names_is_there() -> None:
    texts = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "Makefile", *(ROOT / "docs").rglob("*.md")]
    named = set[str]()
    for path in texts:
        alone = "|`" if path.parent == ROOT else ""  # `[app]`; in docs, such a word may be a table of TOML
        for names in re.findall(rf"(?:implicam|\"\.{alone})\[([a-z,]+)\][\"`]", path.read_text()):
            named |= set(names.split(","))
    code = "\n".join(path.read_text() for path in (ROOT / "src").rglob("*.py"))
    needed = set(re.findall(r'import_extra\("[\w.]+", "([\w-]+)"', code))
    assert {"app", "all", "dev", "report"} <= named
    assert {"images", "report", "viewer"} <= needed
    assert named | needed <= set(EXTRAS)


def test_versions_of_python_are_those_that_are_supported() -> None:
    named = re.findall(r"Programming Language :: Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    assert named == sorted(named, key=lambda text: int(text[2:]))
    assert PROJECT["requires-python"] == f">={named[0]}"


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(citation)  # what the format requires
    assert (citation["title"], citation["version"]) == (PROJECT["name"], PROJECT["version"])
    assert (citation["license"], citation["abstract"]) == (PROJECT["license"], PROJECT["description"])
    assert citation["keywords"] == PROJECT["keywords"]
    assert [author["name"] for author in citation["authors"]] == [author["name"] for author in PROJECT["authors"]]


def test_the_hooks_fetch_nothing_and_run_a_target_of_make() -> None:
    config = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())
    assert [repository["repo"] for repository in config["repos"]] == ["local"]
    (hook,) = config["repos"][0]["hooks"]
    assert (hook["language"], hook["entry"]) == ("system", "make lint")
    assert re.search(r"^lint:", (ROOT / "Makefile").read_text(), re.MULTILINE)


@pytest.mark.parametrize("name", ["CITATION.cff", "CHANGELOG.md"])
def test_the_readme_leads_to(name: str) -> None:
    assert name in (ROOT / "README.md").read_text()
