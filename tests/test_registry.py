"""A registry finds parts by name: its own, those registered, those of other packages."""

from importlib.metadata import EntryPoint, EntryPoints

import pytest

from implicam import registry
from implicam.errors import UsageError
from implicam.registry import Registry


def colours():
    return Registry("colour", {"red": 1, "green": 2}, "implicam.no-such-group")


def test_parts_come_in_order_and_a_spec_is_a_name_and_a_variant():
    made = colours()
    made.register("blue", 3)
    assert dict(made) == {"red": 1, "green": 2, "blue": 3}
    assert len(made) == 3
    assert made.find("red") == (1, "")
    assert made.find("blue:dark:er") == (3, "dark:er")


def test_an_unknown_name_is_told_with_what_there_is():
    with pytest.raises(UsageError, match=r"colour 'gren' is not known \(did you mean 'green'\?\)") as error:
        colours().find("gren:x")
    assert "red, green" in error.value.fix


@pytest.mark.parametrize("name", ["red", "", "a:b"])
def test_a_name_that_is_taken_or_cannot_be_written_is_refused(name):
    with pytest.raises(ValueError, match="cannot name a colour"):
        colours().register(name, 9)


def test_a_part_of_another_package_that_cannot_be_imported_is_named_with_the_package(monkeypatch):
    there = EntryPoints([EntryPoint("mauve", "no_such_package.colours:MAUVE", "implicam.colours")])
    monkeypatch.setattr(registry, "entry_points", lambda **by: there.select(**by))
    with pytest.raises(UsageError, match=r"the colour 'mauve' of the package no_such_package.colours") as error:
        Registry("colour", {"red": 1}, "implicam.colours").find("mauve")
    assert "ModuleNotFoundError" in error.value.why


def test_another_package_adds_a_part_by_an_entry_point(monkeypatch):
    there = EntryPoints([EntryPoint("pi", "math:pi", "implicam.colours")])
    monkeypatch.setattr(registry, "entry_points", lambda **by: there.select(**by))
    made = Registry("colour", {"red": 1}, "implicam.colours")
    assert list(made) == ["red", "pi"]
    assert "pi" in made
    assert made["pi"] == pytest.approx(3.14159, abs=1e-5)
