"""A part of another package that cannot be imported stops the commands that need its kind, by name, and no other."""

from __future__ import annotations

import os
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest

from command_line import UNWATCHED, Cli, cli, made, real  # noqa: F401  two fixtures
from implicam import registry
from implicam.session.setup import Setup, open_session

BROKEN = "raise OSError('libgantry.so.3: cannot open shared object file')\n"

NEEDS = {
    "lenses": "calibrate {rig} -o x.implicam --method explicit --lens broken",
    "calibrators": "calibrate {rig} -o x.implicam",
    "acquisitions": "suggest {rig}.implicam --acquisition broken",
    "detectors": "detect {rig}",
    "robots": "acquire s --camera left=0 --no-browser --robot broken:1",
    "cameras": "acquire s --camera left=broken:1 --no-browser --workspace=0:1,0:1,0:1",
    "triggers": "acquire s --camera left=0 --no-browser --workspace=0:1,0:1,0:1 --trigger broken:1",
}
"""Kind of part -> a command that needs it."""

REFUSED = {"calibrators": {"calibrate", "evaluate"}, "detectors": {"detect"}}
"""Kind of part -> the commands whose options are made of all parts of the kind, and which cannot show their help."""

each_kind = pytest.mark.parametrize("kind", NEEDS)


@pytest.fixture
def broken(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "broken_part.py").write_text(BROKEN)
    monkeypatch.syspath_prepend(tmp_path / "elsewhere")
    there = EntryPoints([EntryPoint("broken", "broken_part:Part", f"implicam.{kind}")])
    monkeypatch.setattr(registry, "entry_points", lambda **by: there.select(**by))
    return kind


@pytest.mark.slow
@each_kind
def test_what_needs_its_kind_is_stopped_and_says_which_part(broken: str, cli: Cli, made: Path) -> None:
    ran = cli(*NEEDS[broken].format(rig=made / "rig").split())
    assert (ran.code, ran.out) == (2, "")
    told = " ".join(ran.err.split())
    assert "'broken' of the package broken_part cannot be imported" in told
    assert "libgantry.so.3" in told
    assert "fix: mend or update" in told


@pytest.mark.slow
@each_kind
def test_what_does_not_need_its_kind_goes_on(broken: str, cli: Cli, made: Path) -> None:
    rig = made / "rig"
    for words in ("--help", f"info {rig}.implicam", f"convert {rig} rig.csv", f"measure {rig}.implicam {rig}/check"):
        ran = cli(*words.split())
        assert (ran.code, ran.err) == (0, "")
    for command in ("calibrate", "evaluate", "detect", "suggest", "acquire"):
        refused = command in REFUSED.get(broken, ())
        ran = cli(command, "--help")
        assert (ran.code, "cannot be imported" in ran.err) == (2 * refused, refused), command


@pytest.mark.parametrize("kind", ["robots", "cameras", "triggers"])
def test_the_other_drivers_work(broken: str, cli: Cli, tmp_path: Path) -> None:
    open_session(tmp_path / "s", Setup(rig="stereo")).close()
    told = cli("acquire", "t", "--camera", "left=0", "--no-browser", "--robot", "persn").err
    assert "did you mean 'person'" in told
    assert "csv:FILE" in told


@pytest.mark.slow
def test_a_package_that_is_really_installed(tmp_path: Path, made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a process of its own, with the folder that pip leaves."""
    about = tmp_path / "vendor_parts-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: vendor-parts\nVersion: 1.0\n")
    text = "".join(f"[implicam.{kind}]\nbroken = vendor_parts:Part\n" for kind in NEEDS)
    (about / "entry_points.txt").write_text(text)
    (tmp_path / "vendor_parts.py").write_text(BROKEN)
    monkeypatch.setitem(UNWATCHED, "PYTHONPATH", f"{tmp_path}{os.pathsep}{Path(registry.__file__).parents[1]}")
    assert real("--help", tmp_path).code == 0
    assert real(f"convert {made}/rig rig.csv", tmp_path).code == 0
    ran = real(f"calibrate {made}/rig -o rig.implicam", tmp_path)
    assert ran.code == 2
    assert "the method 'broken' of the package vendor-parts cannot be imported" in " ".join(ran.err.split())
    assert "pip uninstall vendor-parts" in ran.err
