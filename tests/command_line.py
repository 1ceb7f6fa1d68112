"""The commands for tests: run in this process or as installed; a rig and a calibration made by them."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import shlex
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from implicam.cli import main
from implicam.measurement import MEASURED_COLUMNS

UNWATCHED = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "80", "NO_COLOR": "1"}

with contextlib.suppress(ImportError), warnings.catch_warnings(action="ignore"):
    import gpytorch  # noqa: F401  now, because it warns of PyTorch when it is imported first


@dataclass(frozen=True)
class Ran:
    """What a command did."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        def refuse(word: str) -> None:
            raise ValueError(f"{word} is not JSON")

        return json.loads(self.out, parse_constant=refuse)


Cli = Callable[..., Ran]


@pytest.fixture
def cli(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Cli:
    """Runs a command in this process, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    for key in ("COLUMNS", "NO_COLOR"):
        monkeypatch.setenv(key, UNWATCHED[key])
    monkeypatch.setattr("implicam.cli.show.FIRST_LINE_SECONDS", 3600.0)  # of work that takes long on a busy machine

    def run(*words: object) -> Ran:
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            main([str(word) for word in words])
        told = capsys.readouterr()
        return Ran(int(end.value.code or 0), told.out, told.err)

    return run


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated rig of two cameras with check points and a calibration, to be read only."""
    folder = tmp_path_factory.mktemp("made")
    simulated = "simulate rig --cameras 2R --positions random --points 40 --check 30 --seed 1"
    photos = "simulate photos --images --cameras 2R --positions random --points 3"
    cameras = "export rig.implicam --to aniposelib -o cameras.toml"
    waved = "simulate wand --cameras 2R --target wand --frames 50 --check 8 --seed 1"
    with contextlib.chdir(folder):
        fits = ("calibrate rig -o rig.implicam", "calibrate wand -o wand.implicam --force")
        for words in (simulated, fits[0], photos, cameras, waved, fits[1]):
            with pytest.raises(SystemExit) as end:
                main(words.split())
            assert not end.value.code
    return folder


def real(words: str, cwd: Path) -> Ran:
    """The installed command, in a process of its own."""
    executable = shutil.which("implicam", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    assert executable, "implicam is not installed: pip install -e ."
    told = subprocess.run([executable, *shlex.split(words)], cwd=cwd, env=UNWATCHED, capture_output=True, text=True)
    return Ran(told.returncode, told.stdout, told.stderr)


def files(folder: Path) -> dict[str, bytes]:
    """Every file below a folder: name -> content."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def read_measured(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        rows = csv.DictReader(file)
        assert tuple(rows.fieldnames or ()) == MEASURED_COLUMNS
        return list(rows)
