"""The package as a newcomer meets it: every module has its own name, and what a package exports is there."""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType

import pytest

import implicam

MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(implicam.__path__, "implicam.")
    if module.name != "implicam.__main__"
)


@pytest.mark.parametrize("name", MODULES)
def test_a_module_is_what_its_name_says(name: str) -> None:
    module = importlib.import_module(name)
    package, _, last = name.rpartition(".")
    assert isinstance(getattr(importlib.import_module(package), last), ModuleType)
    for exported in getattr(module, "__all__", ()):
        assert hasattr(module, exported)


def test_the_documented_functions_keep_their_names() -> None:
    assert callable(implicam.evaluate)
    assert callable(implicam.assess)
    assert callable(importlib.import_module("implicam.active").suggest)
    assert callable(importlib.import_module("implicam.figures").scene)
    assert callable(importlib.import_module("implicam.report").page)
