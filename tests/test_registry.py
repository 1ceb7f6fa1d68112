"""A registry finds parts by name: its own, those registered, those of other packages."""

from importlib.metadata import EntryPoint, EntryPoints

import pytest

from implicam import registry
from implicam.active.acquisitions import ACQUISITIONS
from implicam.calibrators import CALIBRATORS
from implicam.detect.registry import TARGETS
from implicam.errors import PartError, UsageError
from implicam.hardware import CAMERAS, ROBOTS, TRIGGERS
from implicam.lenses import LENSES
from implicam.registry import Registry

REGISTRIES = (ACQUISITIONS, CALIBRATORS, CAMERAS, LENSES, ROBOTS, TARGETS, TRIGGERS)


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


@pytest.mark.parametrize("how", ["import no_such_library", "import sys; sys.exit('no licence')"])
def test_a_part_of_another_package_that_cannot_be_imported_is_named_with_the_package(monkeypatch, tmp_path, how):
    (tmp_path / "broken_colours.py").write_text(how)
    monkeypatch.syspath_prepend(tmp_path)
    there = EntryPoints([EntryPoint("mauve", "broken_colours:MAUVE", "implicam.colours")])
    monkeypatch.setattr(registry, "entry_points", lambda **by: there.select(**by))
    made = Registry("colour", {"red": 1}, "implicam.colours")
    with pytest.raises(UsageError, match=r"the colour 'mauve' of the package broken_colours") as error:
        made.find("mauve")
    assert error.value.why in ("ModuleNotFoundError: No module named 'no_such_library'", "SystemExit: no licence")
    assert list(made) == ["red", "mauve"]
    assert made.importable() == {"red": 1}


def test_another_package_adds_a_part_by_an_entry_point(monkeypatch):
    there = EntryPoints([EntryPoint("pi", "math:pi", "implicam.colours")])
    monkeypatch.setattr(registry, "entry_points", lambda **by: there.select(**by))
    made = Registry("colour", {"red": 1}, "implicam.colours")
    assert list(made) == ["red", "pi"]
    assert "pi" in made
    assert made["pi"] == pytest.approx(3.14159, abs=1e-5)


def brought(monkeypatch, *entries):
    there = EntryPoints(EntryPoint(name, value, group) for name, value, group in entries)
    monkeypatch.setattr(registry, "entry_points", lambda **by: there.select(**by))


@pytest.mark.parametrize("parts", REGISTRIES, ids=lambda parts: parts.kind)
@pytest.mark.parametrize("what", ["math:pi", "collections:OrderedDict"])
def test_what_is_no_part_of_its_kind_is_refused_with_its_package_and_what_is_missing(monkeypatch, parts, what):
    brought(monkeypatch, ("odd", what, parts.group))
    module = what.partition(":")[0]
    with pytest.raises(PartError, match=f"the {parts.kind} 'odd' of the package {module} is none") as error:
        parts.find("odd")
    assert f"{what} (entry point of {parts.group}): it " in error.value.why
    assert f"pip uninstall {module}" in error.value.fix
    assert set(parts.refused()) == {"odd"}
    with pytest.raises(PartError, match=r"it is|it has no"):
        parts.register("odd", 3.14)


def test_what_is_here_is_what_its_registry_asks_for():
    for parts in REGISTRIES:
        for name, part in parts.items():
            assert not list(parts._check(name, part)), name
            assert parts.package_of(name) == "implicam"


def test_a_lens_is_refused_for_what_it_lacks_and_for_another_name(monkeypatch):
    group = LENSES.group
    brought(monkeypatch, ("kannala", "implicam.lenses:KannalaBrandt", group), ("half", "fractions:Fraction", group))
    with pytest.raises(PartError) as error:
        LENSES.find("kannala")
    assert "its family is 'kannala-brandt', and it is added as 'kannala'" in error.value.why
    with pytest.raises(PartError) as error:
        LENSES.find("half")
    assert "it has no cx, cy, distortion_prior, family, fx, fy, jacobian, nearest" in error.value.why


def test_the_name_of_another_part_is_refused_and_that_part_stays(monkeypatch):
    brought(monkeypatch, ("red", "math:pi", "implicam.colours"))
    made = Registry("colour", {"red": 1, "green": 2}, "implicam.colours")
    assert made["red"] == 1
    with pytest.raises(PartError, match="the package math brings a colour 'red', a name that is taken") as error:
        made.find("red")
    assert "pip uninstall math" in error.value.fix
    assert set(made.refused()) == {"red"}
    brought(monkeypatch, ("pi", "math:pi", "implicam.colours"), ("pi", "cmath:pi", "implicam.colours"))
    with pytest.raises(PartError, match="the packages math and cmath each bring a colour 'pi'"):
        made.find("pi")


def test_a_part_knows_its_package(monkeypatch):
    brought(monkeypatch, ("pi", "math:pi", "implicam.colours"))
    made = Registry("colour", {"red": 1}, "implicam.colours")
    assert made.package_of("pi") == "math"
    assert made.refused() == {}
