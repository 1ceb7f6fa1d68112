"""The commands as a stranger meets them: examples run, JSON parses, errors help, and a kill hurts nobody."""

from __future__ import annotations

import csv
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from command_line import UNWATCHED, Cli, Ran, cli, files, made, read_measured, real  # noqa: F401  fixtures
from implicam import calibration_file, demo
from implicam.calibrators import load_calibration
from implicam.cli import show
from implicam.cli.commands import EXAMPLES, app
from implicam.coverage import Estimate
from implicam.dataset import read_dataset

pytestmark = pytest.mark.usefixtures("looks_kept")

COMMANDS = sorted(command.name for command in app.registered_commands)
HEAVY = [
    "starlette",
    "plotly",
    "matplotlib",
    "torch",
    "gpytorch",
    "pyarrow",
    "cv2",
    "sklearn",
    "scipy.stats",
    "scipy.signal",
]

# examples and help

MAKES = {
    "demo": {"implicam-demo"},
    "simulate": {"my-rig"},
    "board": {"board.pdf"},
    "shoot": {"my-shots"},
    "detect": set(),
    "label": set(),
    "calibrate": {"my-rig.implicam"},
    "world": {"my-world.implicam"},
    "measure": {"measured.csv"},
    "evaluate": {"report.html"},
    "check": {"checks.csv"},
    "verify": {"verify.html", "verify.csv"},
    "compare": {"compare.png"},
    "report": {"report.html"},
    "view": set(),
    "convert": {"my-rig.csv", "my-rig.csv.toml"},
    "export": {"cameras.toml"},
    "import": {"cameras.implicam"},
    "suggest": set(),
    "design": {"design.html"},
    "acquire": {"my-session"},
    "paper": {"implicam-paper"},
    "info": set(),
    "bugreport": {"my-rig-bugreport.zip"},
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


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_commands_and_their_options(shell: str, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    def complete(*words: str) -> str:
        monkeypatch.setenv("_IMPLICAM_COMPLETE", f"complete_{shell}")
        monkeypatch.setenv("COMP_WORDS", " ".join(words))
        monkeypatch.setenv("COMP_CWORD", str(len(words) - 1))
        monkeypatch.setenv("_TYPER_COMPLETE_ARGS", " ".join(words))
        monkeypatch.setenv("_TYPER_COMPLETE_FISH_ACTION", "get-args")
        return cli().out

    assert "detect" in complete("implicam", "det")
    assert "--radius" in complete("implicam", "detect", "my-photos", "--rad")  # an option of one detector
    assert "--lens" in complete("implicam", "calibrate", "my-rig", "--le")


HEAVY_EXAMPLES = ("demo", "compare", "report", "acquire", "paper")
"""Those that take 7 to 50 seconds of work each: with `make test-slow`."""


ASKS_A_PERSON = ("label", "view")
"""Those that end when a person does: tests/test_labelling.py and test_view.py run them with a browser."""


def example(command: str, folder: Path, run: Callable[[str, Path], Ran] = real) -> Ran:
    """Run the example of a command, as installed unless told otherwise, and look at what it leaves."""
    before = {path.name for path in folder.iterdir()}
    name, *words = shlex.split(EXAMPLES[command])
    assert name == "implicam"
    ran = run(shlex.join(words), folder)
    assert ran.code == 0, ran.err
    assert ran.out.strip()
    assert "Warning" not in ran.err
    after = {path.name for path in folder.iterdir()}
    assert after - before == MAKES[command] - before
    assert MAKES[command] <= after
    assert not [path for path in folder.rglob("*") if "partial" in path.name]
    return ran


@pytest.mark.slow
def test_every_example_runs_and_leaves_what_it_names(tmp_path: Path, cli: Cli) -> None:
    for module in ("plotly", "matplotlib"):
        pytest.importorskip(module)
    cli("simulate", "my-photos", "--images", "--cameras", "2R", "--grid", "3x2x2")
    cli("simulate", "my-wand", "--cameras", "2R", "--target", "wand", "--frames", "60", "--check", "8")
    cli("calibrate", "my-wand", "-o", "wand.implicam")
    shutil.copytree(tmp_path / "my-wand" / "check", tmp_path / "l-frame")
    for command in EXAMPLES:
        if command not in (*HEAVY_EXAMPLES, *ASKS_A_PERSON):  # in this process: to start one costs a second
            example(command, tmp_path, lambda words, folder: cli(*shlex.split(words)))
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


def test_importing_implicam_costs_numpy_and_scipy_only() -> None:
    heavy = [*HEAVY, "typer", "rich", "tomli_w", "threadpoolctl"]
    script = f"import implicam, sys; print(*(name for name in {heavy!r} if name in sys.modules))"
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert told.stdout.split() == []


@pytest.mark.slow
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
        "board": ["board", "print", "--board", "6x9", "--square", "20"],
        "shoot": ["shoot", "shots", "--cameras", "2R", "--count", "2"],
        "detect": ["detect", str(made / "photos"), "--no-overlays"],
        "calibrate": ["calibrate", rig, "-o", "out.implicam"],
        "world": ["world", str(made / "wand.implicam"), str(made / "wand" / "check"), "-o", "world.implicam"],
        "measure": ["measure", file, check],
        "evaluate": ["evaluate", file, check],
        "check": ["check", file, check],
        "verify": ["verify", file, str(made / "rig" / "lengths"), "--mpe", "2 + L/100"],
        "compare": ["compare", rig, "--methods", "inverse-gp,inverse-gp:matern-5/2", "--train", "3,20", "--seeds", "1"],
        "report": ["report", file, check],
        "convert": ["convert", rig, "out.npz"],
        "export": ["export", file, "--to", "colmap", "-o", "model"],
        "import": ["import", str(made / "cameras.toml"), "-o", "cameras.implicam"],
        "suggest": ["suggest", file, "-n", "3"],
        "design": ["design", "stereo", "--points", "20"],
        "info": ["info", file],
        "bugreport": ["bugreport", rig],
    }


@pytest.mark.parametrize(
    "command", [name for name in COMMANDS if name not in ("demo", "paper", "acquire", *ASKS_A_PERSON)]
)
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


@pytest.mark.slow
def test_acquire_goes_on_and_refuses_what_it_cannot(cli: Cli) -> None:
    words = ["acquire", "session", "--unattended", "--json"]
    first = cli(*words, "--rig", "stereo", "--speed", "1000", "--budget", "8")
    assert (first.code, first.json["points"], first.err) == (0, 8, "")
    again = cli(*words, "--budget", "9")
    assert (again.code, again.json["points"], again.err) == (0, 9, "")
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


def test_acquire_makes_no_folder_with_the_name_of_a_file(cli: Cli) -> None:
    Path("NOTES").write_text("a file")
    for name in ("README.md", "my-session.implicam", "NOTES"):
        ran = cli("acquire", name, "--unattended")
        assert (ran.code, ran.out) == (2, "")
        assert "file" in ran.err
        assert not Path(name).is_dir()


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


@pytest.mark.slow
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


def test_shares_are_whole_per_cent_with_their_interval() -> None:
    assert show.percent_interval(Estimate(0.912, 0.872, 0.938)) == "91 [87,94]"
    assert show.percent_interval(Estimate(np.nan, np.nan, np.nan)) == "-"


@pytest.mark.slow
def test_a_closed_pipe_is_no_error(made: Path) -> None:
    executable = Path(sys.executable).parent / "implicam"
    line = f"{shlex.quote(str(executable))} info {shlex.quote(str(made / 'rig.implicam'))} | head -n 1"
    told = subprocess.run(["bash", "-c", line], env=UNWATCHED, capture_output=True, text=True)
    assert told.stdout.startswith("sha256 = ")
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
    "compare RIG --methods inverse-gp:papre": "inverse-gp has no variant 'papre'",
    "compare RIG --methods forward-gp:nonee": "did you mean 'none'?",
    "compare RIG --methods forward-gp:paper": "forward-gp has no variant 'paper'",
    "compare RIG --methods mpl": "did you mean 'mlp'?",
    "compare RIG -o figure.txt": "is no picture",
    "convert RIG RIG --overwrite": "would be replaced by itself",
    "demo RIG": "was not made by the demo",
    "demo FILE": "is a file, and this command writes a folder",
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
    "simulate x.json": "this command writes a folder",
    "measure FILE CHECK -o m.json": "m.json: no table is written as .json",
    "measure FILE CHECK -o m.npz": "end the name in .csv, .xlsx or .parquet",
    "suggest FILE -o s.txt": "no table is written as .txt",
    "check FILE CHECK --log log.xlsx": "end it in .csv",
    "check FILE CHECK --repair today.csv": "end it in .implicam",
    "report FILE -o report.pdf": "report.pdf is no page",
    "evaluate FILE CHECK --report report.csv": "report.csv is no page",
    "export FILE --to opencv -o cameras.json": "opencv is not written as .json",
    "export FILE --to colmap -o model.txt": "it is a folder: leave the ending out",
    "export FILE --to onnx -o rig.csv": "end it in .onnx",
    "convert CHECK x.xlsx --to dltdv": "is not written as .xlsx",
    "convert CHECK x.csv --to sleap": "it is a folder: leave the ending out",
}
FAILURES = {
    "calibrate RIG -o x.implicam --cameras cam9": "there is no camera 'cam9'",
    "calibrate RIG -o x.implicam --without cam2,cam3": "there is no camera",
    "calibrate RIG -o x.implicam --points 7": "7 usable known points; forward-gp needs at least 8",
    "calibrate RIG -o x.implicam --points 3 --method inverse-gp": "3 usable known points; inverse-gp needs at least 5",
    "calibrate RIG -o x.implicam --points 500": "choose a number from 1 to",
    "calibrate nothing -o x.implicam": "nothing does not exist",
    "calibrate RIG -o /proc/nowhere/x.implicam": "cannot create the folder",
    "convert CHECK x.json": "no dataset is written as .json",
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
    "calibrate RIG -o RIG": "rig is a folder, and a file is to be written.",
    "measure FILE CHECK -o RIG": "rig is a folder, and a file is to be written.",
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


@pytest.mark.parametrize("words", [["--debug", "info", "nothing"], ["info", "nothing", "--debug"]])
def test_debug_adds_the_traceback(words: list[str], cli: Cli) -> None:
    ran = cli(*words)
    assert ran.code == 1
    assert ran.err.startswith("Traceback")
    assert "error: nothing does not exist." in ran.err
    assert cli("evaluate", "nothing", "--debug").code == 2


class CtrlC:
    """Comes while a module is loaded: a finder of modules, or what is called instead of something."""

    def __init__(self, module: str = "") -> None:
        self.module = module

    def find_spec(self, name: str, *_: object) -> None:
        if name == self.module:
            raise KeyboardInterrupt

    def __call__(self, *_: object, **__: object) -> None:
        raise KeyboardInterrupt


@pytest.mark.parametrize("module", ["implicam.cli.commands", "implicam.cli.options"])
def test_ctrl_c_while_modules_load_is_one_line(module: str, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, module)
    monkeypatch.setattr(sys, "meta_path", [CtrlC(module), *sys.meta_path])
    assert cli("info", "rig.implicam") == Ran(130, "", "interrupted\n")


@pytest.mark.parametrize("moment", ["make_context", "invoke"])
def test_ctrl_c_while_a_command_starts_or_runs_is_one_line(
    moment: str, made: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"typer.core.TyperCommand.{moment}", CtrlC())
    for words in (("info", made / "rig.implicam"), ("measure", made / "rig.implicam", made / "rig")):
        assert cli(*words) == Ran(130, "", "interrupted\n")
    assert "Traceback" in cli("info", made / "rig.implicam", "--debug").err


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


@pytest.mark.slow
def test_compare_without_gpytorch_says_what_it_left_out(made: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpytorch", None)
    ran = cli("compare", made / "rig", "--train", "20", "--seeds", "1")
    assert ran.code == 0
    assert "left out inverse-gp:paper" in ran.err
    assert "inverse-gp:paper" not in ran.out
