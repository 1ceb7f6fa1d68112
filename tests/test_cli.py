"""The commands as a stranger meets them: examples run, JSON parses, errors help, and a kill hurts nobody."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from implicam import calibration_file, demo
from implicam.calibrators import load_calibration
from implicam.cli import main, show
from implicam.cli.commands import EXAMPLES, app
from implicam.coverage import Estimate
from implicam.dataset import read_dataset, write_dataset
from implicam.files import left_behind
from implicam.measurement import MEASURED_COLUMNS
from implicam.simulate import build_rig, random_positions, simulate

COMMANDS = sorted(command.name for command in app.registered_commands)
UNWATCHED = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "80", "NO_COLOR": "1"}
HEAVY = ["viser", "plotly", "matplotlib", "torch", "gpytorch", "pyarrow", "cv2", "sklearn"]

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
    with contextlib.chdir(folder):
        for words in (simulated, "calibrate rig -o rig.implicam", photos, cameras):
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


# examples and help

MAKES = {
    "demo": {"implicam-demo"},
    "simulate": {"my-rig"},
    "detect": set(),
    "calibrate": {"my-rig.implicam"},
    "measure": {"measured.csv"},
    "evaluate": {"report.html"},
    "compare": {"compare.png"},
    "report": {"report.html"},
    "convert": {"my-rig.csv", "my-rig.csv.toml"},
    "export": {"cameras.toml"},
    "import": {"cameras.implicam"},
    "suggest": set(),
    "acquire": {"my-session"},
    "paper": {"implicam-paper"},
    "info": set(),
}


def test_every_command_has_an_example() -> None:
    assert set(EXAMPLES) == set(COMMANDS) == set(MAKES)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_the_example_on_one_line(command: str, cli: Cli) -> None:
    ran = cli(command, "--help")
    assert ran.code == 0
    assert EXAMPLES[command] in ran.out  # on one line even at 80 columns, so that it can be copied
    assert "…" not in ran.out
    assert max(map(len, ran.out.splitlines())) <= 80
    assert cli(command, "-h").out == ran.out


def test_the_first_help_names_every_command_and_where_to_start(cli: Cli) -> None:
    ran = cli("--help")
    assert ran.code == 0
    for command in COMMANDS:
        assert re.search(rf"^│ {command} ", ran.out, re.MULTILINE)
    assert "implicam demo" in ran.out
    assert "--debug" in ran.out
    assert "implicam demo" in cli().out  # without any word, the same help


def test_the_version(cli: Cli) -> None:
    ran = cli("--version")
    assert (ran.code, ran.out.split()) == (0, ["implicam", calibration_file.package_version()])


HEAVY_EXAMPLES = ("demo", "compare", "report", "acquire", "paper")
"""Those that take 7 to 50 seconds of work each: with `make test-slow`."""


def example(command: str, folder: Path) -> Ran:
    """Run the example of a command, as installed, and look at what it leaves."""
    before = {path.name for path in folder.iterdir()}
    name, *words = shlex.split(EXAMPLES[command])
    assert name == "implicam"
    ran = real(shlex.join(words), folder)
    assert ran.code == 0, ran.err
    assert ran.out.strip()
    assert "Warning" not in ran.err
    after = {path.name for path in folder.iterdir()}
    assert after - before == MAKES[command] - before
    assert MAKES[command] <= after
    assert not [path for path in folder.rglob("*") if "partial" in path.name]
    return ran


def test_every_example_runs_and_leaves_what_it_names(tmp_path: Path) -> None:
    for module in ("plotly", "matplotlib"):
        pytest.importorskip(module)
    real("simulate my-photos --images --cameras 2R --grid 3x2x2", tmp_path)
    for command in EXAMPLES:
        if command not in HEAVY_EXAMPLES:
            example(command, tmp_path)
    assert len(read_dataset(tmp_path / "my-rig")) == 157
    assert len(read_dataset(tmp_path / "my-rig.csv")) == 157
    assert len(read_measured(tmp_path / "measured.csv")) == 300
    load_calibration(tmp_path / "my-rig.implicam")
    assert (tmp_path / "report.html").read_text().rstrip().endswith("</html>")  # that of evaluate


@pytest.mark.slow
@pytest.mark.parametrize("command", HEAVY_EXAMPLES)
def test_every_heavy_example_runs_and_leaves_what_it_names(command: str, tmp_path: Path) -> None:
    for module in ("plotly", "matplotlib", "torch", "gpytorch", "joblib"):
        pytest.importorskip(module)
    for needed in {"compare": ["simulate"], "report": ["simulate", "calibrate"]}.get(command, []):
        example(needed, tmp_path)
    ran = example(command, tmp_path)
    if command == "demo":
        check_readme(ran.out)
        assert {path.name for path in (tmp_path / "implicam-demo").iterdir()} == {
            "dataset.toml", "points.csv", "observations.csv", "truth.toml", "check", "rig.implicam", "measured.csv",
            "report.html", "images", "detections", "observations.before-detect.csv",
        }  # fmt: skip
    if command == "compare":
        assert (tmp_path / "compare.png").read_bytes().startswith(b"\x89PNG")


def check_readme(printed: str) -> None:
    """The table of the README is the one that the demo prints; numbers may differ in the last digits by machine."""
    _, *table = printed.split("\n\nlimit:")[0].split("\n\n", 1)[1].splitlines()  # without count and title
    text = Path(__file__, "../../README.md").resolve().read_text()
    shown = re.search(r"^```\n( +forward-gp .*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert shown
    number = re.compile(r"\d+\.\d+")
    lines = ([line.rstrip() for line in part] for part in (table, shown[1].splitlines()))
    for ours, readme in zip(*lines, strict=True):
        assert number.sub("", ours).split() == number.sub("", readme).split()
        values = ([float(value) for value in number.findall(line)] for line in (ours, readme))
        assert next(values) == pytest.approx(next(values), rel=0.02)


def read_measured(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        rows = csv.DictReader(file)
        assert tuple(rows.fieldnames or ()) == MEASURED_COLUMNS
        return list(rows)


def test_importing_implicam_costs_numpy_and_scipy_only() -> None:
    heavy = [*HEAVY, "typer", "rich", "tomli_w", "threadpoolctl", "scipy.stats"]
    script = f"import implicam, sys; print(*(name for name in {heavy!r} if name in sys.modules))"
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert told.stdout.split() == []


def test_the_command_line_loads_no_heavy_library_before_it_is_needed() -> None:
    heavy = HEAVY
    script = f"import implicam.cli.commands, sys; print(*(name for name in {heavy!r} if name in sys.modules))"
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert told.stdout.split() == []


# JSON


def json_commands(made: Path) -> dict[str, list[str]]:
    rig, check, file = str(made / "rig"), str(made / "rig" / "check"), str(made / "rig.implicam")
    return {
        "simulate": ["simulate", "out", "--missing", "0.3", "--positions", "random", "--points", "10", "--check", "5"],
        "detect": ["detect", str(made / "photos"), "--no-overlays"],
        "calibrate": ["calibrate", rig, "-o", "out.implicam"],
        "measure": ["measure", file, check],
        "evaluate": ["evaluate", file, check],
        "compare": ["compare", rig, "--methods", "inverse-gp,inverse-gp:matern-5/2", "--train", "3,20", "--seeds", "1"],
        "report": ["report", file, check],
        "convert": ["convert", rig, "out.npz"],
        "export": ["export", file, "--to", "colmap", "-o", "model"],
        "import": ["import", str(made / "cameras.toml"), "-o", "cameras.implicam"],
        "suggest": ["suggest", file, "-n", "3"],
        "acquire": ["acquire", "session", "--rig", "stereo", "--budget", "9", "--speed", "1000", "--unattended"],
        "info": ["info", file],
    }


@pytest.mark.parametrize("command", [command for command in COMMANDS if command not in ("demo", "paper")])
def test_json_is_json_and_nothing_else(command: str, made: Path, cli: Cli) -> None:
    ran = cli(*json_commands(made)[command], "--json")
    assert ran.code == 0
    assert isinstance(ran.json, dict)
    assert ran.err == ""


@pytest.mark.slow
def test_json_of_the_demo(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "SETS", {"2R": "2 cameras"})
    monkeypatch.setattr(demo, "HELD_OUT", 8)
    ran = cli("demo", "--json", "--seed", "1")
    assert [(row["method"], row["known"]) for row in ran.json["rows"]] == [
        (method, known) for known in (17, 35) for method in ("forward-gp", "inverse-gp")
    ]
    assert ran.json["pictures"] == 6 * (35 + 8)
    assert 0.97 * ran.json["pictures"] <= ran.json["found"] <= ran.json["pictures"]
    assert Path(ran.json["photographs"]).read_bytes().startswith(b"\xff\xd8")
    best = load_calibration(ran.json["calibration"])
    assert (best.method, len(best.data)) == ("forward-gp", 35)
    assert "forward-gp" in Path(ran.json["report"]).read_text()
    assert all(row["rmse"] > 0 for row in ran.json["rows"])
    assert Path(ran.json["report"]).is_file()
    assert ran.err == ""
    assert demo.may_replace(Path("implicam-demo"))


def test_json_says_what_the_tables_say(made: Path, cli: Cli) -> None:
    commands = json_commands(made)
    told = cli(*commands["evaluate"], "--json").json
    assert told["length_unit"] == "mm"
    assert told["rows"][0]["n"] == 30
    assert told["rows"][0]["verdict"] in cli(*commands["evaluate"]).out
    told = cli(*commands["compare"], "--json").json
    assert [(row["known"], row["failures"] != []) for row in told["rows"]] == [
        (3, True), (3, True), (20, False), (20, False),
    ]  # fmt: skip
    assert told["rows"][0]["mean"]["rmse"] is None  # no NaN
    told = cli(*commands["measure"], "--json").json
    assert (told["rows"], told["points_measured"], told["not_measured"]) == (30, 30, [])
    assert told["views_left_out"] == []
    assert cli(*commands["info"], "--json").json["method"] == "forward-gp"
    told = cli(*commands["suggest"], "--json").json
    assert [target["name"] for target in told["targets"]] == ["p041", "p042", "p043"]
    assert told["expected"]["usual"] < told["now"]["usual"]


def test_suggest_says_where_and_what_the_cameras_see(made: Path, cli: Cli) -> None:
    file = str(made / "rig.implicam")
    told = cli("suggest", file, "-n", "4", "--from=0,0,0", "--reach", "100", "-o", "targets.csv", "--json").json
    rows = list(csv.DictReader(Path("targets.csv").read_text().splitlines()))
    assert [float(row["x"]) for row in rows] == [target["xyz"][0] for target in told["targets"]]
    for row, target in zip(rows, told["targets"], strict=True):
        for camera, pixel in target["pixels"].items():
            assert row[f"u_{camera}"] == ("" if pixel is None else repr(pixel[0]))
    for words, why in (
        ("--workspace 1:0,0:1,0:1", "empty"),
        ("--from 1,2", "position"),
        ("--acquisition best", "best"),
    ):
        ran = cli("suggest", file, *words.split())
        assert (ran.code, ran.out) == (2, "")
        assert why in ran.err
        assert "fix:" in ran.err


def test_acquire_goes_on_and_refuses_what_it_cannot(cli: Cli) -> None:
    words = ["acquire", "session", "--unattended", "--json"]
    assert cli(*words, "--rig", "stereo", "--speed", "1000", "--budget", "8").json["points"] == 8
    again = cli(*words, "--budget", "9")
    assert again.json["points"] == 9
    assert again.json["stopped"] == "all 9 points of the budget are measured"
    assert len(read_dataset("session")) == 9
    for wrong, why in (
        (["--rig", "bar6"], "begun with rig stereo"),
        (["--camera", "left"], "names no camera"),
        (["--camera", "left=0"], "while nobody looks"),
        (["--sd", "-1"], "sd = -1 is not possible"),
        (["--unit", "furlong"], "length unit"),
        (["--method", "mlp"], "where to measure next"),
    ):
        ran = cli(*words, *wrong)
        assert (ran.code, ran.out) == (2, "")
        assert why in ran.err
        assert "fix:" in ran.err


def test_a_failure_with_json_leaves_stdout_empty(cli: Cli) -> None:
    ran = cli("info", "nothing.implicam", "--json")
    assert (ran.code, ran.out) == (1, "")
    assert ran.err.startswith("error: nothing.implicam does not exist.")


# what is told where


def test_notes_go_to_stderr_and_results_to_stdout(made: Path, cli: Cli) -> None:
    cli("simulate", "holes", "--cameras", "2R", "--missing", "0.2", "--check", "20")
    ran = cli("calibrate", "holes", "-o", "holes.implicam", "--method", "inverse-gp")
    assert ran.code == 0
    assert "not used" not in ran.out
    assert "known points not used: inverse-gp needs every camera; not seen by cam2" in ran.err
    assert "lie on a lattice" in ran.err
    ran = cli("measure", "holes.implicam", "holes/check")
    assert ran.out.startswith("measured.csv: 20 rows, ")
    assert "not measured: inverse-gp needs every camera; not seen by" in ran.err
    assert not re.search(r"note: 1 (known )?points", ran.err)
    # one view of two is still of use to forward-gp, for the calibration
    ran = cli("calibrate", "holes", "-o", "holes.implicam")
    assert "not used" not in ran.out
    assert re.search(r"note: \d+ known points not used: no camera saw it", ran.err)
    ran = cli("measure", "holes.implicam", "holes/check")
    assert "not measured: only cam" in ran.err
    assert "saw it; a position takes two cameras" in ran.err


def test_many_reasons_are_cut_with_the_number_of_those_left_out(cli: Cli) -> None:
    cli("simulate", "holes", "--missing", "0.15", "--positions", "random", "--points", "100")
    inverse = ("calibrate", "holes", "-o", "holes.implicam", "--method", "inverse-gp")
    ran = cli(*inverse)
    assert ran.err.count("note:") == show.MOST_NOTES + 1
    assert re.search(r"and \d+ more such notes; --json lists them all", ran.err)
    unused = cli(*inverse, "--json").json["unused"]
    seen = read_dataset("holes").observations.seen
    assert len(unused) == int((~seen.all(axis=1)).sum())


def test_progress_goes_to_stderr_where_somebody_watches(made: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    quiet = cli("evaluate", made / "rig", "--cv", "2")
    monkeypatch.setattr(show, "err", Console(stderr=True, force_terminal=True, width=80))
    watched = cli("evaluate", made / "rig", "--cv", "2")
    assert watched.out == quiet.out
    assert "2-fold cross-validation" in watched.err
    assert "cross-validation" not in quiet.err
    assert cli("evaluate", made / "rig", "--cv", "2", "--json").err == ""


@pytest.mark.parametrize("columns", ["40", "80", "200"])
def test_tables_are_never_cut_and_fit_eighty_columns(
    columns: str, made: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    evaluation = cli("evaluate", made / "rig.implicam", made / "rig" / "check")
    compared = cli("compare", made / "rig", "--train", "20,30", "--seeds", "2", "--methods",
                   "inverse-gp,inverse-gp:matern-5/2")  # fmt: skip
    for ran in (evaluation, compared):
        assert ran.code == 0
        assert "…" not in ran.out
        tables = [line for line in ran.out.splitlines() if "  " in line.strip()]
        assert max(map(len, tables)) <= 80
    for words in ("all points", "rmse/limit", "NEES, ideal 3", "  middle", "error bars: "):
        assert words in evaluation.out
    assert re.search(
        r"inverse-gp:matern-5/2 +20 +[\d.]+ ± [\d.]+ +[\d.]+ +[\d.]+ ± [\d.]+ +[\d.]+ +[\d.]+", compared.out
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (1.0, "1.00"), (123456.0, "123456"), (-2.714, "-2.71"), (0.00001234, "0.0000123"), (np.nan, "-"),
     (1e-30, "1.00e-30"), (np.inf, "-"), (99.96, "100.0")],
)  # fmt: skip
def test_numbers_read_as_people_write_them(value: float, text: str) -> None:
    assert show.number(value) == text


def test_shares_are_whole_per_cent_with_their_interval() -> None:
    assert show.percent(Estimate(0.912, 0.872, 0.938)) == "91 [87,94]"
    assert show.percent(Estimate(np.nan, np.nan, np.nan)) == "-"


def test_a_closed_pipe_is_no_error(made: Path) -> None:
    executable = Path(sys.executable).parent / "implicam"
    line = f"{shlex.quote(str(executable))} info {shlex.quote(str(made / 'rig.implicam'))} | head -n 1"
    told = subprocess.run(["bash", "-c", line], env=UNWATCHED, capture_output=True, text=True)
    assert told.stdout.startswith("format_version")
    assert told.stderr == ""


# errors: exit code, what is said

USAGE = {
    "calibrate RIG -o x.implicam --lens fisheye --method explicit": "explicit has no lens 'fisheye'",
    "calibrate RIG -o x.implicam --align icq": "did you mean 'icp'?",
    "calibrate RIG -o x.implicam --boards RIG --method mlp": "mlp has no option 'boards'",
    "import RIG -o x.csv": "end it in .implicam: -o x.implicam",
    "export FILE --to colmpa -o x": "did you mean 'colmap'?",
    "calibrate RIG -o x.implicam --method froward-gp": "did you mean 'forward-gp'?",
    "calibrate RIG -o x.implicam --lens nonee": "did you mean 'none'?",
    "calibrate RIG -o x.implicam --lens none --method inverse-gp": "inverse-gp has no option 'lens'",
    "calibrate RIG -o x.implicam --lens none --kernel matern-5/2": "forward-gp has no option 'kernel'",
    "calibrate RIG -o x.implicam --preset paper --method forward-gp": "forward-gp has no option 'preset'",
    "calibrate RIG -o x.implicam --method inverse-pg": "did you mean 'inverse-gp'?",
    "calibrate RIG -o x.implicam --preset papre": "did you mean 'paper'?",
    "calibrate RIG -o x.implicam --preset paper --kernel matern-5/2": "squared-exponential kernel only",
    "calibrate RIG -o x.csv": "end it in .implicam: -o x.implicam",
    "compare RIG --train 17,x": "not a list of numbers",
    "compare RIG --train 500": "500 of 40 points leave none",
    "compare RIG --methods inverse-gp:papre": "inverse-gp has no kernel 'papre'",
    "compare RIG --methods forward-gp:nonee": "did you mean 'none'?",
    "compare RIG --methods forward-gp:paper": "forward-gp has no lens 'paper'",
    "compare RIG --methods mpl": "did you mean 'mlp'?",
    "compare RIG -o figure.txt": "is no picture",
    "convert RIG RIG --overwrite": "would be replaced by itself",
    "demo RIG": "was not made by the demo",
    "demo FILE": "was not made by the demo",
    "demo demo.csv": "this command writes a folder",
    "evaluate FILE": "needs a calibration file and a dataset",
    "evaluate FILE CHECK --cv 5": "take one path",
    "evaluate FILE CHECK --leave-out shot": "take one path",
    "evaluate FILE CHECK --method inverse-gp": "brings its own method",
    "evaluate FILE --cv 5 --kernel matern-5/2": "brings its own method",
    "evaluate FILE --cv 5 --lens none": "brings its own method",
    "evaluate RIG --cv 5 --lens none --method inverse-gp": "inverse-gp has no option 'lens'",
    "evaluate RIG --cv 5 --leave-out shot": "exclude each other",
    "evaluate RIG --leave-out plane": "write --leave-out shot",
    "simulate x --rig bra6": "did you mean 'bar6'?",
    "simulate x --cameras 2W": "did you mean",
    "simulate x --cameras 2R --rig stereo": "belongs to bar6",
    "simulate x --grid 5x5": "is not a grid",
    "simulate x --grid 0x5x5": "is not a grid",
    "simulate x --unit km": "choose mm or m",
    "simulate x --tilt 40": "it must be from 0 to 30 degrees",
    "simulate x --aspect 0": "it must be from 0.2 to 5",
    "simulate x --window -2": "it must be from 0 to 100 mm",
    "simulate x --mirror cam7": "has no camera 'cam7'",
    "simulate x --window 10 --images": "looks through a window cannot be photographed",
    "simulate x --mirror all --images --target board": "a board in a mirror cannot be photographed",
    "simulate x.csv": "this command writes a folder",
}
FAILURES = {
    "calibrate RIG -o x.implicam --cameras cam9": "there is no camera 'cam9'",
    "calibrate RIG -o x.implicam --without cam2,cam3": "there is no camera",
    "calibrate RIG -o x.implicam --points 7": "7 usable known points; forward-gp needs at least 8",
    "calibrate RIG -o x.implicam --points 3 --method inverse-gp": "3 usable known points; inverse-gp needs at least 5",
    "calibrate RIG -o x.implicam --points 500": "choose a number from 1 to",
    "calibrate nothing -o x.implicam": "nothing does not exist",
    "calibrate RIG -o /proc/nowhere/x.implicam": "cannot create the folder",
    "convert nothing x.csv": "nothing does not exist",
    "convert RIG CHECK": "already exists",
    "evaluate FILE RIG": "were used to fit this calibration",
    "evaluate RIG --cv 500": "choose a number from 2 to 40",
    "evaluate RIG RIG": "is a folder, not a calibration",
    "info RIG": "is a folder, not a calibration",
    "info CSV": "not a usable calibration file",
    "measure CSV RIG": "not a usable calibration file",
    "measure FILE CSV": "empty.csv is empty",
    "measure FILE nothing": "nothing does not exist",
    "report nothing": "nothing does not exist",
    "simulate RIG": "add --overwrite",
}
OF_TYPER = ["calibrat", "measure", "measure --outptu x", "calibrate RIG", "simulate x --seed -1", "evaluate RIG --cv 1",
            "simulate x --frame upside-down", "simulate x --missing 1.5", "info FILE FILE"]  # fmt: skip


def words_of(line: str, made: Path, folder: Path) -> list[str]:
    (folder / "empty.csv").write_text("")
    names = {"RIG": "rig", "CHECK": "rig/check", "FILE": "rig.implicam"}
    places = {key: str(made / name) for key, name in names.items()} | {"CSV": str(folder / "empty.csv")}
    return [places.get(word, word) for word in line.split()]


@pytest.mark.parametrize(("line", "text", "code"), [
    *((line, text, 2) for line, text in USAGE.items()), *((line, text, 1) for line, text in FAILURES.items()),
])  # fmt: skip
def test_errors_say_what_and_how_to_fix_it(line: str, text: str, code: int, made: Path, cli: Cli) -> None:
    before = files(made)
    ran = cli(*words_of(line, made, Path.cwd()))
    assert ran.code == code
    assert ran.out == ""
    assert text in ran.err
    what, *rest = ran.err.splitlines()
    assert re.fullmatch(r"error: \S.*[.?]", what)
    assert [part[:7] for part in rest] in (["  why: ", "  fix: "], ["  fix: "])
    assert "Traceback" not in ran.err
    assert {path.name for path in Path.cwd().iterdir()} == {"empty.csv"}
    assert files(made) == before


@pytest.mark.parametrize("line", OF_TYPER)
def test_wrong_usage_shows_the_usage(line: str, made: Path, cli: Cli) -> None:
    ran = cli(*words_of(line, made, Path.cwd()))
    assert ran.code == 2
    assert ran.out == ""
    assert "Usage: implicam" in ran.err
    assert "Traceback" not in ran.err


def test_the_real_command_returns_the_same_codes(made: Path, tmp_path: Path) -> None:
    assert real("info nothing", tmp_path).code == 1
    assert real("info", tmp_path).code == 2
    assert real("evaluate nothing", tmp_path).code == 2


@pytest.mark.parametrize("words", [["--debug", "info", "nothing"], ["info", "nothing", "--debug"]])
def test_debug_adds_the_traceback(words: list[str], cli: Cli) -> None:
    ran = cli(*words)
    assert ran.code == 1
    assert ran.err.startswith("Traceback")
    assert "error: nothing does not exist." in ran.err
    assert cli("evaluate", "nothing", "--debug").code == 2


def test_a_mistake_of_ours_is_told_as_one(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(path: Path) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("implicam.cli.commands.load_calibration", broken)
    ran = cli("info", "rig.implicam")
    assert ran.code == 1
    assert ran.err.splitlines()[0] == "error: an unexpected ZeroDivisionError: division by zero"
    assert "--debug" in ran.err
    assert "Traceback" not in ran.err
    assert 'raise ZeroDivisionError("division by zero")' in cli("info", "rig.implicam", "--debug").err


@pytest.mark.parametrize(("absent", "words", "extra"), [
    ("plotly", "evaluate FILE CHECK --report r.html", "report"),
    ("plotly", "report FILE", "report"),
    ("plotly", "demo", "report"),
    ("cv2", "demo", "images"),
    ("cv2", "simulate photos --images --cameras 2R --positions random --points 2", "images"),
    ("matplotlib", "compare RIG -o figure.png", "report"),
    ("gpytorch", "compare RIG --methods inverse-gp:paper", "paper"),
    ("gpytorch", "calibrate RIG -o x.implicam --preset paper", "paper"),
])  # fmt: skip
def test_a_missing_extra_is_told_before_the_work_with_its_cure(
    absent: str, words: str, extra: str, made: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, absent, None)
    if absent == "plotly":
        monkeypatch.setitem(sys.modules, "plotly.offline", None)
    ran = cli(*words_of(words, made, Path.cwd()))
    assert (ran.code, ran.out) == (1, "")
    assert f"needs the library '{absent}', which is not installed" in ran.err
    assert f'fix: pip install "implicam[{extra}]"' in ran.err
    assert {path.name for path in Path.cwd().iterdir()} == {"empty.csv"}


def test_compare_without_gpytorch_says_what_it_left_out(made: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpytorch", None)
    ran = cli("compare", made / "rig", "--train", "20", "--seeds", "1")
    assert ran.code == 0
    assert "left out inverse-gp:paper" in ran.err
    assert "inverse-gp:paper" not in ran.out


# simulate


def test_simulate_writes_rig_truth_and_check_points(cli: Cli) -> None:
    ran = cli("simulate", "rig", "--cameras", "2R2W", "--grid", "2x3x4", "--check", "7", "--seed", "3")
    assert ran.code == 0
    data, check = read_dataset("rig"), read_dataset("rig/check")
    assert (len(data), len(check)) == (24, 7)
    assert data.observations.camera_names == ("cam2", "cam3", "cam4", "cam5")
    assert data.truth is not None
    assert check.truth is not None
    assert "rig: 24 points, " in ran.out
    assert "4 cameras" in ran.out
    assert (Path("rig") / "truth.toml").is_file()
    np.testing.assert_allclose(check.truth.xyz, check.xyz)


def test_simulate_options_do_what_they_say(cli: Cli) -> None:
    def simulated(*options: object) -> Any:
        name = f"rig{len(list(Path.cwd().iterdir()))}"
        assert cli("simulate", name, "--rig", "stereo", *options).code == 0
        return read_dataset(name)

    plain = simulated()
    assert len(plain) == 175
    assert plain.length_unit == "mm"
    share = 1 - simulated("--missing", 0.3).observations.seen.mean() / plain.observations.seen.mean()
    assert 0.2 < share < 0.4
    wrong = (simulated("--outliers", 0.2).observations.extra["outlier"] == "1").mean()
    assert 0.1 < wrong < 0.3
    noisy = simulated("--robot-noise", 0.5)
    assert np.std(noisy.xyz - noisy.truth.xyz) == pytest.approx(0.5, rel=0.15)
    assert (noisy.known.sd == 0.5).all()
    np.testing.assert_allclose(simulated("--unit", "m").xyz, plain.xyz / 1000)
    assert np.ptp(simulated("--frame", "random").xyz, axis=0) != pytest.approx(np.ptp(plain.xyz, axis=0), rel=0.01)
    board = simulated("--target", "board", "--boards", 3)
    assert len(np.unique(board.shots)) == 3
    quiet = simulated("--noise", 0, "--lens-error", 0)
    assert (
        np.abs(quiet.observations.uv - quiet.observations.extra["true_u"].astype(float)[..., None])[..., 0].max() == 0
    )
    np.testing.assert_array_equal(simulated().observations.uv, plain.observations.uv)
    again, other = simulated("--shots-seed", 7), simulated("--seed", 7)
    np.testing.assert_array_equal(again.xyz, plain.xyz)
    assert np.abs(again.observations.uv - plain.observations.uv).max() < 5  # the same rig, other noise
    assert np.abs(other.observations.uv - plain.observations.uv).max() > 5  # another rig
    assert len(simulated("--rig", "dome5", "--positions", "random", "--points", 12).cameras) == 5


def test_simulate_makes_cameras_that_are_not_ordinary(cli: Cli) -> None:
    odd = ["--tilt", "5", "--mirror", "cam2", "--aspect", "1.25", "--window", "15"]
    assert cli("simulate", "odd", "--rig", "stereo", "--noise", 0, *odd).code == 0
    assert cli("simulate", "plain", "--rig", "stereo", "--noise", 0).code == 0
    truth, plain_truth = (tomllib.loads((Path(name) / "truth.toml").read_text()) for name in ("odd", "plain"))
    assert (truth["tilt"], truth["mirror"], truth["aspect"], truth["window"]) == (5, "cam2", 1.25, 15)
    assert not set(truth) - set(plain_truth) - {"tilt", "mirror", "aspect", "window"}
    cam1, cam2 = truth["cameras"]
    assert "mirrored" not in cam1
    assert cam2["mirrored"]
    assert cam1["height"] == 1280
    assert cam1["window"]["thickness"] == 15
    data, plain = read_dataset("odd"), read_dataset("plain")
    np.testing.assert_array_equal(data.xyz, plain.xyz)
    assert data.truth is not None
    assert np.isfinite(data.truth.limit[data.observations.seen.all(axis=1)]).all()


def test_simulate_refuses_to_overwrite_unless_told(cli: Cli) -> None:
    assert cli("simulate", "rig", "--rig", "stereo", "--check", 5).code == 0
    before = files(Path("rig"))
    ran = cli("simulate", "rig", "--rig", "stereo", "--seed", 1)
    assert ran.code == 1
    assert "add --overwrite" in ran.err
    assert files(Path("rig")) == before
    assert cli("simulate", "rig", "--rig", "stereo", "--seed", 1, "--overwrite").code == 0
    after = files(Path("rig"))
    assert after["observations.csv"] != before["observations.csv"]
    assert not [name for name in after if name.startswith("check")]


# calibrate, measure, evaluate, convert, info


def test_the_default_method_is_forward_gp(made: Path, cli: Cli) -> None:
    assert "forward-gp from 40 points" in cli("calibrate", made / "rig", "-o", "x.implicam").out
    told = cli("info", "x.implicam", "--json").json
    assert (told["method"], told["options"]["lens"]) == ("forward-gp", "auto")
    assert "(default forward-gp)" in " ".join(cli("calibrate", "--help").out.replace("│", " ").split())
    assert cli("evaluate", made / "rig", "--cv", "3", "--json").json["method"] == "forward-gp"
    # an option that only the other method has means that method
    assert "inverse-gp from 40" in cli("calibrate", made / "rig", "-o", "x.implicam", "--kernel", "matern-5/2").out


def test_the_lens_is_an_option_of_forward_gp(made: Path, cli: Cli) -> None:
    ran = cli("calibrate", made / "rig", "-o", "none.implicam", "--lens", "none")
    assert ran.code == 0
    assert "forward-gp from 40 points" in ran.out
    assert cli("info", "none.implicam", "--json").json["options"]["lens"] == "none"
    assert cli("measure", "none.implicam", made / "rig" / "check").out.startswith("measured.csv: 30 rows, 30 measured")
    assert cli("calibrate", made / "rig", "-o", "auto.implicam", "--lens", "auto").code == 0
    assert Path("auto.implicam").read_bytes() == (made / "rig.implicam").read_bytes()
    by_lens = [cli("evaluate", made / "rig", "--cv", "3", "--lens", lens, "--json") for lens in ("central", "none")]
    assert [ran.code for ran in by_lens] == [0, 0]
    assert by_lens[0].json["rows"] != by_lens[1].json["rows"]


def test_compare_takes_forward_gp_with_either_lens(made: Path, cli: Cli) -> None:
    methods = ["forward-gp", "forward-gp:none", "inverse-gp"]
    words = ("compare", made / "rig", "--train", "12,30", "--seeds", "1", "--methods", ",".join(methods))
    told = cli(*words, "--json").json
    assert [(row["known"], row["method"], row["failures"]) for row in told["rows"]] == [
        (known, method, []) for known in (12, 30) for method in methods
    ]
    rmse = {(row["known"], row["method"]): row["mean"]["rmse"] for row in told["rows"]}
    assert len(set(rmse.values())) == 6
    assert rmse[12, "forward-gp"] < rmse[12, "inverse-gp"] / 5
    assert "forward-gp:none" in cli(*words).out


def displaced(folder: Path, views: dict[int, str], pixels: float = 30.0) -> list[tuple[str, str]]:
    """Move views (row of the point -> camera) of a dataset that far; the names of the points, and the cameras."""
    data = read_dataset(folder)
    uv = data.observations.uv.copy()
    for row, camera in views.items():
        uv[row, data.observations.camera_names.index(camera)] += pixels / np.sqrt(2)
    moved = replace(data, observations=replace(data.observations, uv=uv))
    write_dataset(moved, folder, overwrite=True)
    return [(str(data.points[row]), camera) for row, camera in views.items()]


def four_cameras(cli: Cli) -> None:
    """A rig of cam2, cam3, cam4, cam5 with 40 known points and 30 to check."""
    cli("simulate", "rig", "--cameras", "2R2W", "--positions", "random", "--points", 40, "--check", 30, "--seed", 1)
    shutil.move("rig/check", "check")


def test_calibrate_says_which_views_it_rejected(cli: Cli) -> None:
    four_cameras(cli)
    wrong = displaced(Path("rig"), {3: "cam3", 17: "cam5"})
    ran = cli("calibrate", "rig", "-o", "x.implicam")
    assert ran.code == 0
    assert "contradict" not in ran.out
    (note,) = [line for line in ran.err.splitlines() if "views contradict the others and are not used" in line]
    assert note.startswith("note: 2 of ")
    for point, camera in wrong:
        assert f"{point} in {camera} (" in note
    told = cli("calibrate", "rig", "-o", "x.implicam", "--json").json
    assert {(view["point"], view["camera"]) for view in told["rejected"]} == set(wrong)
    assert len(told["rejected"]) == 2
    assert [view["residual"] for view in told["rejected"]] == pytest.approx([30, 30], abs=3)
    assert told["unused"] == []
    assert cli("calibrate", "check", "-o", "y.implicam", "--json").json["rejected"] == []
    assert cli("calibrate", "rig", "-o", "x.implicam", "--method", "inverse-gp", "--json").json["rejected"] == []


def test_a_point_measured_without_a_contradicting_view_counts_as_measured(cli: Cli) -> None:
    four_cameras(cli)
    cli("calibrate", "rig", "-o", "x.implicam")
    (one,) = displaced(Path("check"), {8: "cam4"})
    ran = cli("measure", "x.implicam", "check")
    assert ran.out.startswith("measured.csv: 30 rows, 30 measured, ")
    assert ran.err == "note: 1 point measured without cam4, whose view contradicts the others\n"
    rows = {row["point"]: row for row in read_measured(Path("measured.csv"))}
    assert rows[one[0]]["reason"] == "measured without cam4, whose view contradicts the others"
    assert rows[one[0]]["views"] == "3"
    assert rows[one[0]]["x"] != ""
    displaced(Path("check"), {11: "cam4", 12: "cam2"})
    ran = cli("measure", "x.implicam", "check")
    assert ran.err.splitlines() == [
        "note: 3 points measured without a view that contradicts the others; of these:",
        "note: 2 points measured without cam4, whose view contradicts the others",
        "note: 1 point measured without cam2, whose view contradicts the others",
    ]
    told = cli("measure", "x.implicam", "check", "--json").json
    assert (told["points_measured"], told["not_measured"], len(told["views_left_out"])) == (30, [], 3)
    ran = cli("evaluate", "x.implicam", "check")
    assert "note: 3 points measured without a view" in ran.err
    assert "not measured" not in ran.out + ran.err
    told = cli("evaluate", "x.implicam", "check", "--json").json
    assert (told["rows"][0]["n"], told["rows"][0]["unmeasured"], told["not_measured"]) == (30, 0, [])
    assert len(told["views_left_out"]) == 3


def test_measure_does_without_a_camera_that_is_not_there(cli: Cli) -> None:
    four_cameras(cli)
    check = read_dataset("check")
    write_dataset(check.without(["cam4"]), "three")
    cli("calibrate", "rig", "-o", "x.implicam")
    ran = cli("measure", "x.implicam", "three")
    assert ran.out.startswith("measured.csv: 30 rows, 30 measured, ")
    assert ran.err == ""
    rows = read_measured(Path("measured.csv"))
    assert {row["views"] for row in rows} == {"3"}
    xyz = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
    assert np.sqrt(np.mean((xyz - check.xyz) ** 2)) < 1
    cli("calibrate", "rig", "-o", "x.implicam", "--method", "inverse-gp")
    ran = cli("measure", "x.implicam", "three")
    assert ran.code == 1
    assert "the observations have no camera 'cam4'" in ran.err


def test_one_camera_alone_measures_nothing_and_says_why(cli: Cli) -> None:
    four_cameras(cli)
    cli("calibrate", "rig", "-o", "x.implicam")
    write_dataset(read_dataset("check").with_cameras(["cam4"]), "alone")
    ran = cli("measure", "x.implicam", "alone")
    assert ran.code == 0
    assert ran.out == "measured.csv: 30 rows, 0 measured\n"
    assert ran.err == "note: 30 points not measured: only cam4 saw it; a position takes two cameras\n"


@pytest.mark.parametrize(("method", "why", "testable"), [
    ("forward-gp", "only cam3 saw it; a position takes two cameras", True),
    ("inverse-gp", "inverse-gp needs every camera; not seen by cam2", False),
])  # fmt: skip
def test_measure_keeps_every_row(method: str, why: str, testable: bool, made: Path, cli: Cli) -> None:
    cli("calibrate", made / "rig", "-o", "rig.implicam", "--method", method)
    check = read_dataset(made / "rig" / "check")
    folder = Path("new-points")
    shutil.copytree(made / "rig" / "check", folder)
    (folder / "points.csv").unlink()  # to be measured: nobody knows where they are
    lines = (folder / "observations.csv").read_text().splitlines(keepends=True)
    (folder / "observations.csv").write_text("".join(lines[:1] + lines[2:]))  # the first point keeps one view
    ran = cli("measure", "rig.implicam", folder, "-o", "deep/measured.csv")
    assert ran.code == 0
    rows = read_measured(Path("deep/measured.csv"))
    assert [row["point"] for row in rows] == [str(name) for name in read_dataset(folder).points]
    one, *others = rows
    assert (one["views"], one["x"], one["sd_z"], one["cov_xy"]) == ("1", "", "", "")
    assert one["reason"] == why
    direct = load_calibration("rig.implicam").measure(check.observations)
    at = {str(name): i for i, name in enumerate(check.points)}
    for row in others:
        i = at[row["point"]]
        assert [float(row[axis]) for axis in "xyz"] == pytest.approx(direct.xyz[i], rel=1e-9)
        assert float(row["sd_x"]) == pytest.approx(direct.sd[i, 0], rel=1e-6)
        assert (row["views"], row["reason"]) == ("2", "")
        assert (row["consistency"] != "") is testable  # one map from all pixels has nothing to hold them against
        if testable:
            assert float(row["consistency"]) == pytest.approx(direct.consistency[i], rel=1e-9)
    assert "29 measured" in ran.out


def test_measure_from_every_form_gives_the_same(made: Path, cli: Cli) -> None:
    forms = ["check.csv", "check.npz", "check-folder"]
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        pass
    else:
        forms.append("check.parquet")
    assert cli("measure", made / "rig.implicam", made / "rig" / "check").code == 0
    expected = Path("measured.csv").read_bytes()
    for form in forms:
        assert cli("convert", made / "rig" / "check", form).code == 0
        assert cli("measure", made / "rig.implicam", form, "-o", "again.csv").code == 0
        assert Path("again.csv").read_bytes() == expected


def test_a_wide_csv_of_a_stranger(made: Path, cli: Cli) -> None:
    """No description beside it: measuring needs none, learning must know the unit."""
    cli("convert", made / "rig", "rig.csv")
    Path("rig.csv.toml").unlink()
    ran = cli("calibrate", "rig.csv", "-o", "x.implicam")
    assert ran.code == 1
    assert "add --unit mm" in ran.err
    assert cli("calibrate", "rig.csv", "-o", "x.implicam", "--unit", "mm").code == 0
    ran = cli("measure", "x.implicam", "rig.csv")
    assert ran.code == 0
    assert "40 measured" in ran.out
    ran = cli("evaluate", "x.implicam", made / "rig" / "check")
    assert ran.code == 0


def test_the_unit_of_what_is_measured_does_not_matter_and_that_of_known_points_does(made: Path, cli: Cli) -> None:
    cli("simulate", "in-m", "--cameras", "2R", "--positions", "random", "--points", "10", "--unit", "m", "--seed", "1")
    assert cli("measure", made / "rig.implicam", "in-m").code == 0
    ran = cli("evaluate", made / "rig.implicam", "in-m")
    assert ran.code == 1
    assert "is in m, and the calibration is in mm" in ran.err


def test_cameras_and_without(cli: Cli) -> None:
    cli("simulate", "rig", "--positions", "random", "--points", "60", "--check", "20")
    assert cli("calibrate", "rig", "-o", "a.implicam", "--cameras", "cam2, cam3").code == 0
    assert cli("calibrate", "rig", "-o", "b.implicam", "--without", "cam1,cam4,cam5,cam6").code == 0
    assert Path("a.implicam").read_bytes() == Path("b.implicam").read_bytes()
    told = cli("info", "a.implicam", "--json").json
    assert [camera["name"] for camera in told["cameras"]] == ["cam2", "cam3"]
    told = cli("evaluate", "a.implicam", "rig/check", "--json").json
    assert told["rows"][0]["rmse_over_limit"] is None  # the limit written beside the points is that of six cameras
    # a calibration file carries its data, and the choice of cameras holds for those, too
    assert cli("calibrate", "rig", "-o", "all.implicam").code == 0
    of_file = cli("evaluate", "all.implicam", "--cv", "3", "--cameras", "cam2,cam3", "--json").json
    of_data = cli("evaluate", "rig", "--cv", "3", "--without", "cam1,cam4,cam5,cam6", "--json").json
    assert of_file["rows"] == of_data["rows"]


def test_points_kept_back_are_there_to_evaluate(made: Path, cli: Cli) -> None:
    assert cli("calibrate", made / "rig", "-o", "x.implicam", "--points", "25").code == 0
    ran = cli("evaluate", "x.implicam", made / "rig")
    assert ran.code == 0
    assert "15 points not used in the fit; 25 of this dataset were, and are left out" in ran.out
    other = cli("calibrate", made / "rig", "-o", "y.implicam", "--points", "25", "--seed", "1")
    assert other.code == 0
    points = [set(load_calibration(f"{name}.implicam").data.points) for name in "xy"]
    assert points[0] != points[1]
    assert cli("calibrate", made / "rig", "-o", "all.implicam", "--points", "40").code == 0


def test_evaluate_in_turn_by_file_or_by_dataset(made: Path, cli: Cli) -> None:
    by_file = cli("evaluate", made / "rig.implicam", "--cv", "4", "--json").json
    by_data = cli("evaluate", made / "rig", "--cv", "4", "--json").json
    assert by_file["rows"] == by_data["rows"]
    assert by_file["how"] == "4-fold cross-validation (seed 0)"
    assert cli("evaluate", made / "rig", "--cv", "4", "--seed", "9", "--json").json["rows"] != by_data["rows"]
    inverse = cli("evaluate", made / "rig", "--cv", "4", "--method", "inverse-gp", "--json").json
    other = cli("evaluate", made / "rig", "--cv", "4", "--kernel", "matern-5/2", "--json").json
    assert inverse["method"] == other["method"] == "inverse-gp"
    assert other["rows"] != inverse["rows"]
    cli("simulate", "board", "--rig", "stereo", "--target", "board", "--boards", "4", "--seed", "2")
    ran = cli("evaluate", "board", "--leave-out", "shot", "--json").json
    assert ran["how"] == "each of 4 shots left out in turn"
    assert ran["rows"][0]["cluster_kind"] == "shots"


def test_the_verdict_says_how_much(made: Path, cli: Cli) -> None:
    ran = cli("evaluate", made / "rig.implicam", made / "rig" / "check")
    assert re.search(
        r"^error bars: (too small|right|too large|cannot tell); the mean NEES is [\d.]+ \[[\d.]+,\s?[\d.]+\], and 3 is "
        r"right; the 95 % ellipsoids hold [\d.]+ %, and [\d.]+ times as large would hold 95 %$",
        ran.out,
        re.MULTILINE,
    )


def test_convert_round_trip_loses_nothing(made: Path, cli: Cli) -> None:
    original = files(made / "rig" / "check")
    for form in ("a.csv", "b.npz", "c"):
        assert cli("convert", made / "rig" / "check", form).code == 0
        ran = cli("convert", form, f"back-{form.replace('.', '-')}")
        assert ran.code == 0
        assert "30 points, 2 cameras" in ran.out
        assert files(Path(f"back-{form.replace('.', '-')}")) == original


def test_info_shows_the_readable_part(made: Path, cli: Cli) -> None:
    ran = cli("info", made / "rig.implicam")
    assert 'method = "forward-gp"' in ran.out
    assert "known_points = 40" in ran.out
    damaged = Path("damaged.implicam")
    damaged.write_bytes((made / "rig.implicam").read_bytes()[:-100])
    assert cli("info", damaged).code == 1


def test_report_of_a_calibration_alone_and_with_points(made: Path, cli: Cli) -> None:
    pytest.importorskip("plotly")
    ran = cli("report", made / "rig.implicam")
    assert ran.code == 0
    assert "report.html: 10-fold cross-validation" in ran.out
    assert "10-fold" in Path("report.html").read_text()
    assert cli("report", made / "rig.implicam", made / "rig" / "check", "-o", "b.html").code == 0
    assert "30 points not used in the fit" in Path("b.html").read_text()


def test_the_same_command_writes_the_same_bytes(made: Path, cli: Cli) -> None:
    cli("calibrate", made / "rig", "-o", "again.implicam")
    assert Path("again.implicam").read_bytes() == (made / "rig.implicam").read_bytes()
    cli(
        "simulate",
        "again",
        "--cameras",
        "2R",
        "--positions",
        "random",
        "--points",
        "40",
        "--check",
        "30",
        "--seed",
        "1",
    )
    assert files(Path("again")) == files(made / "rig")


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
    Victim("calibrate rig -o old.implicam", "old.implicam"),
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


def victims_folder(made: Path, folder: Path) -> Path:
    """Everything the victims need, and in place of their output something old and good."""
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
        beside = left_behind(folder / victim.target)
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


@pytest.mark.parametrize("victim", VICTIMS, ids=str)
def test_killed_before_any_of_its_changes_the_old_or_the_new_is_there(
    victim: Victim, made: Path, tmp_path: Path
) -> None:
    """One run; before each of its file operations (open, write to disk, rename, remove, ...) the folder is copied.

    A copy holds what a process killed at that instant leaves behind: what is on its way to a file is in neither.
    """
    pytest.importorskip(victim.needs)
    template = victims_folder(made, tmp_path / "template")
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


def killed_at(victim: Victim, folder: Path, delay: float) -> bool:
    """Start the real command, kill its whole process group after a while; whether that was in time."""
    executable = str(Path(sys.executable).parent / "implicam")
    process = subprocess.Popen(
        [executable, *shlex.split(victim.words)], cwd=folder, env=UNWATCHED,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    time.sleep(delay)
    in_time = process.poll() is None
    if in_time:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return in_time


@pytest.mark.slow
@pytest.mark.parametrize("victim", VICTIMS, ids=str)
def test_killed_at_any_moment_the_old_or_the_new_is_there(victim: Victim, made: Path, tmp_path: Path) -> None:
    """Two dozen delays over the last part of a measured run, where the files are written."""
    pytest.importorskip(victim.needs)
    template = victims_folder(made, tmp_path / "template")
    whole = tmp_path / "whole"
    shutil.copytree(template, whole)
    start = time.perf_counter()
    assert real(victim.words, whole).code == 0
    seconds = time.perf_counter() - start
    old, new = state(template, victim.target), state(whole, victim.target)
    sources = {name: state(template, name) for name in ("rig", "rig.implicam")}
    in_time = 0
    for i, delay in enumerate(np.linspace(0.3 * seconds, 1.1 * seconds, 24)):
        folder = tmp_path / str(i)
        shutil.copytree(template, folder)
        in_time += killed_at(victim, folder, float(delay))
        check_kill(folder, victim, old, new, sources)
        assert real(victim.words, folder).code == 0
        assert state(folder, victim.target) == new
    assert in_time > 5


def test_the_classical_way_on_the_command_line(made: Path, cli: Cli) -> None:
    assert cli("simulate", "boards", "--target", "boards", "--cameras", "2R", "--seed", "1", "--pairs", "6").code == 0
    ran = cli("calibrate", made / "rig", "--boards", "boards", "-o", "b.implicam")  # nobody means another method
    assert ran.code == 0
    assert ran.out.startswith("b.implicam: explicit from 40 points\neach left out in turn is predicted from the rest")
    same = cli("calibrate", made / "rig", "--boards", "boards", "--align", "icp", "-o", "c.implicam", "--json").json
    assert set(same["residuals"]["lens"]) == {"cam2", "cam3"}
    told = cli("evaluate", "b.implicam", made / "rig" / "check", "--json").json
    assert told["rows"][0]["rmse_over_limit"] < 3
    alone = cli("calibrate", "boards", "-o", "alone.implicam")
    assert alone.out.startswith("alone.implicam: explicit from")
    assert "Positions are in the frame of cam2" in alone.err
    turned = cli("evaluate", made / "rig", "--cv", "4", "--boards", "boards", "--json").json
    assert (turned["method"], turned["rows"][0]["n"]) == ("explicit", 40)
    assert cli("calibrate", made / "rig", "--lens", "kannala-brandt", "-o", "k.implicam").out.startswith(
        "k.implicam: explicit from 40 points"
    )
    for to, name in (("opencv", "b.yaml"), ("kalibr", "camchain.yaml"), ("colmap", "model"), ("dlt", "b.csv")):
        ran = cli("export", "b.implicam", "--to", to, "-o", name)
        assert ran.code == 0
        assert ran.out.startswith(f"{name}: 2 cameras as ")
    for name, more in (("b.yaml", []), ("camchain.yaml", []), ("model", ["--unit", "mm"]), ("b.csv", [])):
        assert cli("import", name, "-o", "i.implicam", *more).code == 0
        assert cli("measure", "i.implicam", made / "rig" / "check").code == 0
    assert cli("import", "b.yaml", "-o", "i.implicam", "--unit", "mm").code == 0  # written in metres, as OpenCV has it
    same = cli("evaluate", "i.implicam", made / "rig" / "check", "--json").json
    assert same["rows"][0]["rmse"] == pytest.approx(told["rows"][0]["rmse"], rel=0.05)
    assert "made without known points" in cli("evaluate", "alone.implicam", "--cv", "3").err


def test_a_neural_network_says_what_its_numbers_are(made: Path, cli: Cli) -> None:
    pytest.importorskip("torch")
    ran = cli("calibrate", made / "rig", "--method", "mlp", "-o", "n.implicam")
    assert "of them that it was not trained on are predicted within" in ran.out
    assert "dropout" in ran.err
