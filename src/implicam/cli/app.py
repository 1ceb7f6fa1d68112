"""The command line itself: its examples, and the options and checks that several commands share."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from implicam.addresses import HIDDEN, without_secrets
from implicam.calibration_file import package_version
from implicam.calibrators import DEFAULT_METHOD, Calibration
from implicam.dataset import Dataset, TableOptions, read_dataset
from implicam.dataset.wide import is_unit_missing
from implicam.errors import DatasetError, UsageError, import_extra
from implicam.files import is_file_name, refuse_folder

app = typer.Typer(
    name="implicam",
    help="Turn a set of fixed cameras into a 3D measuring instrument with honest error bars.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Start with: implicam demo.  Any command: -v or --verbose tells what it does, --debug where an error is.",
)

EXAMPLES = {
    "demo": "implicam demo",
    "simulate": "implicam simulate my-rig --positions random --points 157 --check 300",
    "board": "implicam board print --board 8x11 --square 16 -o board.pdf",
    "shoot": "implicam shoot my-shots --cameras 2R --every 100ms --count 3",
    "detect": "implicam detect my-photos --target ball --radius 8",
    "label": "implicam label my-tank",
    "calibrate": "implicam calibrate my-rig -o my-rig.implicam",
    "world": "implicam world wand.implicam l-frame -o my-world.implicam",
    "measure": "implicam measure my-rig.implicam my-rig/check -o measured.csv",
    "evaluate": "implicam evaluate my-rig.implicam my-rig/check --report report.html",
    "check": "implicam check my-rig.implicam my-rig/check --log checks.csv",
    "verify": "implicam verify my-rig.implicam my-rig/lengths --mpe '0.5 + L/500'",
    "compare": "implicam compare my-rig --train 35,87 --seeds 3 -o compare.png",
    "report": "implicam report my-rig.implicam -o report.html",
    "view": "implicam view my-rig.implicam my-rig/check",
    "convert": "implicam convert my-rig my-rig.csv",
    "export": "implicam export my-rig.implicam --to aniposelib -o cameras.toml",
    "import": "implicam import cameras.toml -o cameras.implicam",
    "suggest": "implicam suggest my-rig.implicam -n 5",
    "acquire": "implicam acquire my-session --cameras 2R --budget 12 --unattended",
    "design": "implicam design bar6 grid9 --points 36 -o design.html",
    "paper": "implicam paper board --quick",
    "info": "implicam info my-rig.implicam",
    "bugreport": "implicam bugreport my-rig",
}
"""Command -> an example, in an order in which they can be run."""


def command_line() -> str:
    """What was typed, for a log; no passwords and tokens."""
    words = sys.argv[1:]
    for i, word in enumerate(words):
        words[i] = HIDDEN if i and words[i - 1] == "--token" else without_secrets(word)
    return f"implicam {package_version()}: {shlex.join(words)}"


CALIBRATION_SUFFIX = ".implicam"
FOLDER_FILES = ("dataset.toml", "points.csv", "observations.csv")

Function = TypeVar("Function", bound=Callable[..., Any])


def command(name: str) -> Callable[[Function], Function]:
    """Register a command; its help ends with its example, so it must be in `EXAMPLES`."""
    return app.command(name, epilog=f"Example:  [bold]{EXAMPLES[name]}[/bold]")


Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]
Scheduler = Annotated[
    str | None,
    typer.Option("--scheduler", metavar="ADDRESS", help="Compute on a Dask cluster, such as tcp://10.0.0.5:8786."),
]
Seed = Annotated[int, typer.Option("--seed", min=0, metavar="N", help="The same seed gives the same numbers.")]
Method = Annotated[
    str | None, typer.Option("--method", metavar="NAME", help=f"Calibration method (default {DEFAULT_METHOD}).")
]
Cameras = Annotated[
    str | None, typer.Option("--cameras", metavar="LIST", help="Use only these cameras, separated by commas.")
]
Without = Annotated[
    str | None, typer.Option("--without", metavar="LIST", help="Leave these cameras out, separated by commas.")
]
Pictures = Annotated[
    str | None, typer.Option("--pictures", metavar="FOLDER", help="Where they are in DATASET (default images).")
]
Pattern = Annotated[
    str | None, typer.Option(metavar="PATTERN", help='How their names tell camera and shot: "{shot}_{camera}".')
]
_PAGE = "The page"
Port = Annotated[int, typer.Option("--port", min=0, max=65535, help="0: any free.", rich_help_panel=_PAGE)]
Token = Annotated[
    str | None, typer.Option("--token", help="What the page asks for (default: a new one).", rich_help_panel=_PAGE)
]
Browser = Annotated[
    bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.", rich_help_panel=_PAGE)
]
LeaveOut = Annotated[
    str | None, typer.Option("--leave-out", metavar="shot", help="Hold each shot (a board, a plane) out in turn.")
]
Report = Annotated[Path | None, typer.Option("--report", help="Also write a one-page HTML report with a 3D view.")]


def read(
    path: Path,
    table: TableOptions,
    cameras: str | None = None,
    without: str | None = None,
    calibration: Calibration | None = None,
) -> Dataset:
    """The dataset, with the cameras that were asked for; a calibration knows the names that cameras have."""
    names = () if calibration is None else calibration.data.camera_names
    return chosen(read_dataset(path, **asdict(table), cameras=names), cameras, without)


def read_to_measure(path: Path, table: TableOptions, fitted: Calibration) -> Dataset:
    """The unit of data to be measured does not matter; a table that states none is read as in the calibration's."""
    try:
        return read(path, table, calibration=fitted)
    except DatasetError as error:
        if not is_unit_missing(error):
            raise
        return read(path, replace(table, unit=fitted.data.length_unit), calibration=fitted)


def chosen(data: Dataset, cameras: str | None, without: str | None) -> Dataset:
    """The cameras that `--cameras` and `--without` leave."""
    if cameras:
        data = data.with_cameras([name.strip() for name in cameras.split(",")])
    if without:
        data = data.without([name.strip() for name in without.split(",")])
    return data


def must_be_folder(path: Path) -> None:
    """UsageError where the name is that of a file: of one that is there, or by its ending."""
    if path.is_file():
        raise UsageError(f"{path} is a file, and this command writes a folder.", fix="give another name")
    if is_file_name(path) and not path.exists():
        raise UsageError(
            f"{path} is the name of a file, and this command writes a folder.",
            fix="leave the ending out",
        )


def must_be_calibration(output: Path) -> None:
    """An error where the name does not end as that of a calibration, or is that of a folder."""
    refuse_folder(output)
    if output.suffix.lower() != CALIBRATION_SUFFIX:
        raise UsageError(
            f"{output} is no name for a calibration.", fix=f"end it in {CALIBRATION_SUFFIX}: -o {output.stem}.implicam"
        )


def must_not_replace(output: Path, *sources: Path | None) -> None:
    """UsageError where writing `output` would destroy what the command reads: a file, or a file of a dataset folder."""
    target = output.resolve()
    for source in sources:
        if source is None:
            continue
        own = {source.resolve(), source.with_name(f"{source.name}.toml").resolve()}  # a wide CSV and its description
        if source.is_dir():
            own |= {(source / name).resolve() for name in FOLDER_FILES}
        if target in own:
            raise UsageError(
                f"{output} would be replaced: this command reads it.", fix="give another name to write to (-o)"
            )


def must_be_shot(leave_out: str | None) -> None:
    """UsageError where `--leave-out` names anything but a shot."""
    if leave_out not in (None, "shot"):
        raise UsageError(f"--leave-out {leave_out!r} is not known.", fix="write --leave-out shot")


def check_figure(path: Path) -> None:
    """Say that it cannot be drawn before the work, not after."""
    if path.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise UsageError(f"{path} is no picture.", fix="end the name in .png, .pdf or .svg")
    import_extra("matplotlib", "report", "a figure for print")


def must_be_page(path: Path) -> None:
    """Say that no page can be written before the work, not after."""
    refuse_folder(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{path} is no page.", fix="end the name in .html")
    import_extra("plotly", "report", "the HTML report")
