"""A command that is killed leaves the old or the new, and nothing between."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import UNWATCHED, files, made, read_measured, real  # noqa: F401  a fixture
from implicam.calibrators import load_calibration
from implicam.dataset import read_dataset, write_dataset
from implicam.files import find_left_behind
from implicam.simulate import build_rig, random_positions, simulate
from killed import processes, started

# kill -9: the old or the new, nothing between


@dataclass(frozen=True)
class Victim:
    """A command that replaces something old. OLD holds the rig of another seed; FILES what it may touch."""

    words: str
    target: str
    needs: str = "numpy"

    def __str__(self) -> str:
        return self.words.split()[0] + "-" + self.target


VICTIMS = [
    Victim("calibrate rig -o old.implicam --points 12", "old.implicam"),
    Victim("measure rig.implicam rig/check -o old-measured.csv", "old-measured.csv"),
    Victim("evaluate rig.implicam rig/check --report old.html", "old.html", "plotly"),
    Victim("simulate old --cameras 2R --positions random --points 20 --check 10 --seed 1 --overwrite", "old"),
    Victim("convert rig old-folder --overwrite", "old-folder"),
    Victim("convert rig old.npz", "old.npz"),
    Victim("convert rig old.csv", "old.csv"),
]

KILLER = '''
import os, shutil, sys
sys.dont_write_bytecode = True
from implicam.cli import main

folder, copies = sys.argv[1:3]
count, copying = 0, False

def inside(path):
    return not isinstance(path, int) and os.path.abspath(os.fsdecode(path)).startswith(folder)

def writes(event, args):
    """Whether an audit event is about to change a file in the working folder."""
    if event == "open":
        return bool(args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)) and inside(args[0])
    return event in ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.chmod") and inside(args[0])

def strike():
    """Keep the folder as it is now: what a kill at this instant would leave."""
    global count, copying
    if not copying:
        copying, count = True, count + 1
        shutil.copytree(folder, os.path.join(copies, str(count)))
        copying = False

fsync = os.fsync
def before_and_after(handle):
    strike()
    fsync(handle)
os.fsync = before_and_after
os.chdir(folder)
sys.addaudithook(lambda event, args: strike() if writes(event, args) else None)
out, sys.stdout = sys.stdout, open(os.devnull, "w")
try:
    main(sys.argv[3:])
finally:
    print(count, file=out)
'''


@pytest.fixture(scope="module")
def template(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything the victims need, and in place of their output something old and good; to be copied."""
    folder = tmp_path_factory.mktemp("victims") / "template"
    shutil.copytree(made, folder, ignore=shutil.ignore_patterns("photos"))
    rig = build_rig("bar6", seed=9, cameras="2R")
    old = simulate(rig, random_positions(rig, 25, np.random.default_rng(0)), seed=9)
    for name in ("old", "old-folder", "old.npz", "old.csv"):
        write_dataset(old, folder / name)
    shutil.copy(folder / "rig.implicam", folder / "old.implicam")
    calibration = load_calibration(folder / "rig.implicam")
    calibration.refit(old).save(folder / "old.implicam")
    calibration.measure(old.observations).write_csv(folder / "old-measured.csv")
    (folder / "old.html").write_text("<html>an older report</html>")
    return folder


def state(folder: Path, name: str) -> Any:
    """What stands under a name now: content of a file, or of all files of a folder; None for nothing."""
    path = folder / name
    return files(path) if path.is_dir() else path.read_bytes() if path.exists() else None


def load(path: Path) -> None:
    """Read what a command wrote, as the next command would."""
    if path.suffix == ".implicam":
        load_calibration(path)
    elif path.name.endswith("measured.csv"):
        read_measured(path)
    elif path.suffix == ".html":
        assert path.read_text().rstrip().endswith("</html>")
    else:
        read_dataset(path)


def check_kill(folder: Path, victim: Victim, old: Any, new: Any, sources: dict[str, Any]) -> str:
    """After a kill: the old or the new, whole; or, between the two renames of a folder, the old beside its place."""
    now, outcome = state(folder, victim.target), "old"
    if now is None:
        beside = find_left_behind(folder / victim.target)
        assert beside is not None, f"{victim.target} is lost"
        assert files(beside) == old
        outcome = "beside"
    else:
        assert now in (old, new), f"{victim.target} is neither the old nor the new"
        load(folder / victim.target)
        outcome = "new" if now == new else "old"
    for name, content in sources.items():
        assert state(folder, name) == content
    return outcome


@pytest.mark.slow
@pytest.mark.parametrize("victim", VICTIMS, ids=str)
def test_killed_before_any_of_its_changes_the_old_or_the_new_is_there(
    victim: Victim, template: Path, tmp_path: Path
) -> None:
    """One run; before each of its file operations (open, write to disk, rename, remove, ...) the folder is copied.

    A copy holds what a process killed at that instant leaves behind: what is on its way to a file is in neither.
    """
    pytest.importorskip(victim.needs)
    shutil.copytree(template, tmp_path / "run")
    told = subprocess.run(
        [sys.executable, "-c", KILLER, str(tmp_path / "run"), str(tmp_path), *shlex.split(victim.words)],
        env=UNWATCHED, capture_output=True, text=True,
    )  # fmt: skip
    assert told.returncode == 0, told.stderr
    survived = int(told.stdout) + 1
    assert 2 < survived <= 60
    shutil.move(tmp_path / "run", tmp_path / str(survived))
    old, new = state(template, victim.target), state(tmp_path / str(survived), victim.target)
    assert old != new
    sources = {name: state(template, name) for name in ("rig", "rig.implicam")}
    outcomes = [check_kill(tmp_path / str(n), victim, old, new, sources) for n in range(1, survived + 1)]
    assert outcomes[0] == "old"
    assert outcomes[-1] == "new"
    assert outcomes == sorted(outcomes, key=["old", "beside", "new"].index)  # never back
    assert outcomes.count("beside") <= 1
    # what is left of the last kill is in nobody's way
    last = tmp_path / str(survived - 1)
    assert real(victim.words, last).code == 0
    assert state(last, victim.target) == new


def run_whole(victim: Victim, folder: Path, context: ForkServerContext) -> float:
    """Run the command to its end; how many seconds that took."""
    start = time.perf_counter()
    process = started(context, shlex.split(victim.words), folder)
    process.join()
    assert process.exitcode == 0
    return time.perf_counter() - start


def killed_at(victim: Victim, folder: Path, delay: float, context: ForkServerContext) -> bool:
    """Start the command, kill it after a while; whether that was in time."""
    process = started(context, shlex.split(victim.words), folder)
    process.join(delay)
    in_time = process.is_alive()
    process.kill()
    process.join()
    return in_time


@pytest.mark.slow
@pytest.mark.parametrize("victim", VICTIMS, ids=str)
def test_killed_at_any_moment_the_old_or_the_new_is_there(victim: Victim, template: Path, tmp_path: Path) -> None:
    """A dozen delays over a measured run. Each step of its writing is in the test above; this is a real kill."""
    pytest.importorskip(victim.needs)
    seconds, context = np.inf, processes()
    for name in ("again", "whole"):  # the shorter of two: a machine that was busy just then measures too much
        whole = tmp_path / name
        shutil.copytree(template, whole)
        seconds = min(seconds, run_whole(victim, whole, context))
    old, new = state(template, victim.target), state(whole, victim.target)
    sources = {name: state(template, name) for name in ("rig", "rig.implicam")}
    in_time = 0
    for i, share in enumerate(np.linspace(0.2, 1.1, 12)):
        folder = tmp_path / str(i)
        shutil.copytree(template, folder)
        killed = killed_at(victim, folder, float(share * seconds), context)
        in_time += killed
        if not killed and share < 0.9:  # it was done sooner: the machine was busier when the run was timed
            seconds *= 0.8
        check_kill(folder, victim, old, new, sources)
        run_whole(victim, folder, context)
        assert state(folder, victim.target) == new
    assert in_time > 3
