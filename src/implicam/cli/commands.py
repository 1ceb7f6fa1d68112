"""The commands and their options. Every help text ends with an example that a test runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import typer

from implicam import calibration_file
from implicam.calibrators import (
    DEFAULT_METHOD,
    METHODS,
    MLP,
    Calibration,
    Explicit,
    ForwardGP,
    InverseGP,
    calibrator,
    load_calibration,
)
from implicam.calibrators.explicit import calibration_of, rig_of
from implicam.calibrators.explicit.boards import has_boards
from implicam.calibrators.explicit.lenses import FAMILIES
from implicam.cli import show
from implicam.compare import (
    Split,
    Trial,
    as_json,
    compare_on,
    plane_splits,
    random_splits,
    shot_splits,
    summarise,
)
from implicam.dataset import Dataset, folder_files, read_dataset, write_dataset
from implicam.dataset.folder import IMAGES
from implicam.errors import DatasetError, UsageError, import_extra
from implicam.evaluate import Evaluation, cross_validate, evaluate, leave_out_shots
from implicam.exchange import FORMATS, UNKNOWN, export_cameras, import_cameras
from implicam.files import replacing, toml_text
from implicam.images import PATTERN
from implicam.simulate import (
    Optics,
    as_boards,
    ball_grid,
    build_rig,
    each_and_pairs,
    held_boards,
    moving_board,
    random_positions,
    record,
    write_rig,
)

app = typer.Typer(
    name="implicam",
    help="Turn a set of fixed cameras into a 3D measuring instrument with honest error bars.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Start with: implicam demo      Any command: --debug shows the traceback of an error.",
)

EXAMPLES = {
    "demo": "implicam demo",
    "simulate": "implicam simulate my-rig --positions random --points 157 --check 300",
    "detect": "implicam detect my-photos --target ball --radius 8",
    "calibrate": "implicam calibrate my-rig -o my-rig.implicam",
    "measure": "implicam measure my-rig.implicam my-rig/check -o measured.csv",
    "evaluate": "implicam evaluate my-rig.implicam my-rig/check --report report.html",
    "compare": "implicam compare my-rig --train 35,87 --seeds 3 -o compare.png",
    "report": "implicam report my-rig.implicam -o report.html",
    "convert": "implicam convert my-rig my-rig.csv",
    "export": "implicam export my-rig.implicam --to aniposelib -o cameras.toml",
    "import": "implicam import cameras.toml -o cameras.implicam",
    "info": "implicam info my-rig.implicam",
}
"""Command -> an example, in an order in which they can be run."""

CALIBRATION_SUFFIX = ".implicam"
FILE_SUFFIXES = (".csv", ".parquet", ".npz")

Function = TypeVar("Function", bound=Callable[..., Any])


def _command(name: str) -> Callable[[Function], Function]:
    return app.command(name, epilog=f"Example:  [bold]{EXAMPLES[name]}[/bold]")


class Target(StrEnum):
    """What the simulated rig is shown."""

    ball = "ball"
    board = "board"
    boards = "boards"


class Positions(StrEnum):
    """Where the ball goes."""

    grid = "grid"
    random = "random"


class Frame(StrEnum):
    """The world frame of a simulated rig."""

    robot = "robot"
    random = "random"


Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]
Seed = Annotated[int, typer.Option("--seed", min=0, metavar="N", help="The same seed gives the same numbers.")]
Unit = Annotated[
    str | None, typer.Option("--unit", metavar="UNIT", help="Length unit of a wide CSV that does not state it.")
]
Method = Annotated[
    str | None, typer.Option("--method", metavar="NAME", help=f"Calibration method (default {DEFAULT_METHOD}).")
]
Kernel = Annotated[
    str | None, typer.Option("--kernel", metavar="NAME", help="inverse-gp: squared-exponential or matern-5/2.")
]
Preset = Annotated[
    str | None,
    typer.Option(
        "--preset", metavar="NAME", help='inverse-gp: standardised, or "paper" for the paper\'s own software.'
    ),
]
Lens = Annotated[
    str | None,
    typer.Option(
        "--lens", metavar="NAME", help="forward-gp: central or none; explicit: auto, brown-conrady, kannala-brandt."
    ),
]
Boards = Annotated[
    Path | None,
    typer.Option("--boards", metavar="DATASET", help="explicit: learn the cameras from these pictures of a board."),
]
Align = Annotated[
    str | None,
    typer.Option("--align", metavar="NAME", help="explicit: known points match boards by name (points), or icp."),
]
Cameras = Annotated[
    str | None, typer.Option("--cameras", metavar="LIST", help="Use only these cameras, separated by commas.")
]
Without = Annotated[
    str | None, typer.Option("--without", metavar="LIST", help="Leave these cameras out, separated by commas.")
]
Report = Annotated[Path | None, typer.Option("--report", help="Also write a one-page HTML report with a 3D view.")]


def _read(path: Path, unit: str | None, cameras: str | None = None, without: str | None = None) -> Dataset:
    return _chosen(read_dataset(path, unit=unit), cameras, without)


def _chosen(data: Dataset, cameras: str | None, without: str | None) -> Dataset:
    if cameras:
        data = data.with_cameras([name.strip() for name in cameras.split(",")])
    if without:
        data = data.without([name.strip() for name in without.split(",")])
    return data


@dataclass(frozen=True)
class _Wanted:
    """A method and its options, as far as they were given."""

    method: str | None
    lens: str | None
    kernel: str | None
    preset: str | None
    seed: int
    boards: Path | None = None
    align: str | None = None

    @property
    def given(self) -> bool:
        return any((self.method, self.lens, self.kernel, self.preset, self.boards, self.align))

    def calibrator(self) -> Any:
        options = {"lens": self.lens, "kernel": self.kernel, "preset": self.preset, "align": self.align}
        boards = None if self.boards is None else read_dataset(self.boards)
        return calibrator(self.method or self._likely(), **options, boards=boards, seed=self.seed)

    def _likely(self) -> str:
        """The method that is meant where only its options are given."""
        if self.boards or self.align or self.lens in FAMILIES:
            return Explicit.method
        return InverseGP.method if (self.kernel or self.preset) and not self.lens else DEFAULT_METHOD


@_command("demo")
def demo_command(
    folder: Annotated[Path, typer.Argument(help="Where to put its files.")] = Path("implicam-demo"),
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Photograph a simulated rig, detect, calibrate, measure, judge, report: both methods, in about a minute."""
    from implicam.demo import run

    _must_be_folder(folder)
    with show.progress(json) as progress:
        made = run(folder, seed=seed, progress=progress)
    files = {key: str(getattr(made, key)) for key in ("dataset", "calibration", "measured", "report")}
    files["photographs"] = str(made.photographs_seen)
    if json:
        counts = {"pictures": made.photographs, "found": made.found, "typical_sd_px": made.typical_sd}
        show.emit_json({"rows": [{"cameras": r.cameras, **asdict(r.trial)} for r in made.rows], **counts, **files})
        return
    show.line(
        f"{made.photographs} photographs taken; the ball found in {made.found}, "
        f"each to {show.number(made.typical_sd, 2)} px\n"
    )
    show.table(show.demo_table(made))
    show.line(
        "limit: the Cramer-Rao bound; with this noise of detection nobody does better on average, even with perfectly "
        "known cameras"
    )
    for key, path in files.items():
        show.line(f"  {key:<12}{path}")


def _must_be_folder(path: Path) -> None:
    if path.suffix.lower() in FILE_SUFFIXES:
        raise UsageError(
            f"{path} is the name of a file, and this command writes a folder.",
            fix="leave the ending out; implicam convert makes a file of it",
        )


@_command("simulate")
def simulate_command(
    out: Annotated[Path, typer.Argument(help="Folder to write the dataset to.")],
    rig: Annotated[
        str, typer.Option(metavar="NAME", help="bar6 (the paper's), stereo, dome8, or any barN, domeN.")
    ] = "bar6",
    target: Annotated[
        Target, typer.Option(help="A ball on a robot, a board on a slide, boards held by hand.")
    ] = Target.ball,
    positions: Annotated[Positions, typer.Option(help="Where the ball goes.")] = Positions.grid,
    points: Annotated[int, typer.Option(min=1, metavar="N", help="How many random positions.")] = 157,
    grid: Annotated[str, typer.Option(metavar="AxBxC", help="Positions of the grid along, down and away.")] = "5x5x7",
    boards: Annotated[int, typer.Option(min=1, metavar="N", help="How many positions of the board.")] = 20,
    each: Annotated[int, typer.Option(min=0, metavar="N", help="boards: pictures by every camera alone.")] = 10,
    pairs: Annotated[int, typer.Option(min=0, metavar="N", help="boards: pictures by every two neighbours.")] = 4,
    check: Annotated[
        int, typer.Option(min=0, metavar="N", help="Also write so many random positions to OUT/check.")
    ] = 0,
    cameras: Annotated[
        str | None, typer.Option(metavar="LIST", help="2R, 2R2W, 2R4W, or names separated by commas.")
    ] = None,
    noise: Annotated[float, typer.Option(min=0, metavar="PX", help="Pixel noise, standard deviation.")] = 0.2,
    lens_error: Annotated[
        float, typer.Option(min=0, metavar="PX", help="Error no lens model contains, rms pixels.")
    ] = 0.5,
    robot_noise: Annotated[
        float, typer.Option(min=0, metavar="LENGTH", help="Error of the known positions, sd per axis.")
    ] = 0.0,
    missing: Annotated[
        float, typer.Option(min=0, max=1, metavar="SHARE", help="Share of views that are missing.")
    ] = 0.0,
    outliers: Annotated[
        float, typer.Option(min=0, max=1, metavar="SHARE", help="Share of views that are wrong.")
    ] = 0.0,
    images: Annotated[bool, typer.Option("--images", help="Also take photographs, for implicam detect.")] = False,
    image_noise: Annotated[
        float, typer.Option(min=0, max=0.5, metavar="PART", help="Noise of the photographs, part of full scale.")
    ] = 0.01,
    image_blur: Annotated[
        float, typer.Option(min=0, max=10, metavar="PX", help="Blur of the photographs, standard deviation.")
    ] = 0.7,
    frame: Annotated[Frame, typer.Option(help="World frame: axes along the bench, or any.")] = Frame.robot,
    unit: Annotated[str, typer.Option(metavar="UNIT", help="mm or m.")] = "mm",
    seed: Seed = 0,
    shots_seed: Annotated[
        int | None, typer.Option(min=0, metavar="N", help="Record the same rig again with other noise.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it exists.")] = False,
    json: Json = False,
) -> None:
    """Write a dataset of a simulated rig, with the truth and the Cramer-Rao limit of every point beside it."""
    _must_be_folder(out)
    if unit not in ("mm", "m"):
        raise UsageError(f"a simulated rig has no unit {unit!r}.", fix="choose mm or m")
    built = build_rig(
        rig, seed=seed, lens_error=lens_error, noise=noise, frame=frame.value, unit="mm" if unit == "mm" else "m",
        cameras=cameras,
    )  # fmt: skip
    shots = seed if shots_seed is None else shots_seed
    if target is Target.board:
        shown = moving_board(built, positions=boards)
    elif target is Target.boards:
        shown = held_boards(built, each_and_pairs(built, each, pairs), np.random.default_rng([shots, 9]))
    elif positions is Positions.grid:
        shown = ball_grid(built, _grid(grid))
    else:
        shown = random_positions(built, points, np.random.default_rng([shots, 1]))
    optics = Optics(noise=image_noise, blur=image_blur) if images else None
    files = {"truth.toml": toml_text({**write_rig(built), "shots_seed": shots})}
    with show.progress(json) as progress:
        recorded = record(
            built, shown, seed=shots, robot_noise=robot_noise, missing=missing, outliers=outliers, optics=optics
        )
        if target is Target.boards:  # nobody knows where a hand held them
            recorded = replace(recorded, data=as_boards(recorded.data, shown))
        parts = {"": recorded}
        if check:
            target_points = random_positions(built, check, np.random.default_rng([shots, 2]))
            parts["check"] = record(built, target_points, seed=shots + 1_000_003, missing=missing, optics=optics)
            files |= {f"check/{name}": text for name, text in folder_files(parts["check"].data).items()}

        def photographs(folder: Path) -> None:
            for part, one in parts.items():
                one.write_photographs(folder / part, progress)

        write_dataset(recorded.data, out, overwrite=overwrite, also=files, fill=photographs)
    data = recorded.data
    seen = int(data.observations.seen.sum())
    pictures = sum(one.photographs for one in parts.values())
    if json:
        show.emit_json(
            {"dataset": str(out), "points": len(data), "views": seen, "check_points": check, "pictures": pictures}
        )
        return
    show.line(f"{out}: {len(data)} points, {seen} views in {len(data.cameras)} cameras")
    if images:
        show.line(f"{out / 'images'}: {pictures} photographs{' with those of check' if check else ''}")
    if check:
        show.line(f"{out / 'check'}: {check} random positions to judge by")


@_command("detect")
def detect_command(
    dataset: Annotated[Path, typer.Argument(help="A folder with the photographs in images/<camera>/<shot>.png.")],
    target: Annotated[
        str | None, typer.Option(metavar="NAME", help="ball, board, charuco or dots (default: what dataset.toml says).")
    ] = None,
    radius: Annotated[
        float | None, typer.Option(min=0, metavar="LENGTH", help="ball: its radius, in the dataset's unit.")
    ] = None,
    bright: Annotated[bool, typer.Option("--bright", help="ball: it is lighter than what is behind it.")] = False,
    template: Annotated[
        Path | None, typer.Option(metavar="FILE", help="ball: a picture of it before its plate, ball in the middle.")
    ] = None,
    click: Annotated[
        str | None, typer.Option(metavar="FILE:U,V", help="ball: learn what it looks like at this pixel.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="ball: correct its outline's middle with this calibration.")
    ] = None,
    board: Annotated[
        str | None, typer.Option(metavar="RxC", help="board: inner corners, 8x11; charuco: squares, 9x12.")
    ] = None,
    square: Annotated[float | None, typer.Option(min=0, metavar="MM", help="board, charuco: edge of a square.")] = None,
    marker: Annotated[float | None, typer.Option(min=0, metavar="MM", help="charuco: edge of a marker.")] = None,
    dictionary: Annotated[
        str | None, typer.Option(metavar="NAME", help="charuco: OpenCV's name, such as DICT_5X5_100.")
    ] = None,
    layout: Annotated[
        Path | None, typer.Option(metavar="FILE", help="dots: where they are (default DATASET/points.csv).")
    ] = None,
    labels: Annotated[
        Path | None, typer.Option(metavar="FILE", help="dots: six or more named (default DATASET/labels.csv).")
    ] = None,
    pictures: Annotated[str, typer.Option("--pictures", metavar="FOLDER", help="Where they are in DATASET.")] = IMAGES,
    pattern: Annotated[
        str, typer.Option(metavar="PATTERN", help="How their names tell camera and shot, without ending.")
    ] = PATTERN,
    overlays: Annotated[bool, typer.Option(help="Draw what was found, to check by eye.")] = True,
    restart: Annotated[bool, typer.Option("--restart", help="Forget what an earlier run found.")] = False,
    unit: Annotated[
        str | None, typer.Option(metavar="UNIT", help="Length unit, where dataset.toml is missing.")
    ] = None,
    json: Json = False,
) -> None:
    """Find the target in photographs: images -> observations.csv, each view with its uncertainty."""
    from implicam.cli.detect import Wanted, tell
    from implicam.detect import detect_folder

    if not dataset.is_dir():
        raise UsageError(f"{dataset} is not a folder.", fix="give the folder that holds images/<camera>/<shot>.png")
    wanted = Wanted(
        target, radius, bright, template, click, board, square, marker, dictionary, layout, labels, calibration
    )
    detector, correct = wanted.detector(dataset)
    with show.progress(json) as progress:
        run = detect_folder(
            dataset, detector, unit=unit, pictures=pictures, pattern=pattern, overlays=overlays, restart=restart,
            correct=correct, progress=progress,
        )  # fmt: skip
    tell(run, json)


def _grid(text: str) -> tuple[int, int, int]:
    try:
        a, b, c = (int(part) for part in text.lower().split("x"))
        if min(a, b, c) < 1:
            raise ValueError(text)
    except ValueError:
        raise UsageError(f"--grid {text!r} is not a grid.", fix="write three numbers, for example 5x5x7") from None
    return a, b, c


@_command("calibrate")
def calibrate_command(
    dataset: Annotated[Path, typer.Argument(help="Known points and what the cameras saw of them.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The calibration file to write.")],
    method: Method = None,
    lens: Lens = None,
    kernel: Kernel = None,
    preset: Preset = None,
    boards: Boards = None,
    align: Align = None,
    points: Annotated[int | None, typer.Option(min=1, metavar="N", help="Use so many points, drawn at random.")] = None,
    cameras: Cameras = None,
    without: Without = None,
    unit: Unit = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Learn the rig from known points; points kept back with --points are there for `implicam evaluate`."""
    _must_be_calibration(output)
    data = _read(dataset, unit, cameras, without)
    if points is not None and points != len(data):
        data, _ = data.split(points, seed=seed)
    wanted = _Wanted(method, lens, kernel, preset, seed, boards, align)
    if data.known is None and has_boards(data) and not wanted.given:
        wanted = replace(wanted, method=Explicit.method)  # nothing else can be made of boards
    with show.progress(json) as progress:
        calibration = wanted.calibrator().fit(data, progress)
    calibration.save(output)
    _tell_calibration(calibration, output, json)


def _must_be_calibration(output: Path) -> None:
    if output.suffix.lower() != CALIBRATION_SUFFIX:
        raise UsageError(
            f"{output} is no name for a calibration.", fix=f"end it in {CALIBRATION_SUFFIX}: -o {output.stem}.implicam"
        )


def _tell_calibration(calibration: Calibration, output: Path, json: bool) -> None:
    residuals = calibration.residuals()
    unused = [asdict(unused) for unused in calibration.unused]
    notes = calibration.notes()
    if json:
        show.emit_json(
            {"calibration": str(output), "method": calibration.method, "residuals": residuals, "unused": unused,
             "rejected": [asdict(view) for view in calibration.rejected], "notes": notes,
             "length_unit": calibration.data.length_unit}
        )  # fmt: skip
        return
    unit = calibration.data.length_unit
    rms = residuals["leave_one_out_rms"]
    show.line(f"{output}: {calibration.method} from {residuals['points_used']} points")
    within = ", ".join(f"{axis} {show.number(value)}" for axis, value in rms.items())
    how = "each left out in turn is predicted from the rest"
    if "held_out" in residuals:
        how = residuals["held_out"]
    if "held_out_points" in residuals:  # a method that is not refitted for each
        how = f"the {residuals['held_out_points']} of them that it was not trained on are predicted"
    show.line(f"{how} within {within} {unit} rms")
    show.notes(show.counted((entry.reason for entry in calibration.unused), "known point", "not used"))
    show.notes(notes)


@_command("measure")
def measure_command(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    dataset: Annotated[Path, typer.Argument(help="What the cameras saw.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The table to write.")] = Path("measured.csv"),
    unit: Unit = None,
    json: Json = False,
) -> None:
    """Measure every point of a dataset: position, standard uncertainty, covariance; or the reason why not."""
    fitted = load_calibration(calibration)
    data = _read_to_measure(dataset, unit, fitted.data.length_unit)
    with show.progress(json) as progress:
        progress("measuring", 0, 1)
        measured = fitted.measure(data.observations)
        progress("measuring", 1, 1)
    measured.write_csv(output)
    count, typical = int(measured.measured.sum()), _typical(measured.sd)
    if json:
        show.emit_json(
            {"measured": str(output), "rows": len(measured), "points_measured": count, "median_sd": typical,
             "length_unit": measured.length_unit, "not_measured": show.reasons(measured),
             "views_left_out": show.left_out(measured)}
        )  # fmt: skip
        return
    text = f"{output}: {len(measured)} rows, {count} measured"
    if count:
        text += f", typical sd {', '.join(f'{a} {show.number(v)}' for a, v in zip('xyz', typical, strict=True))} "
        text += measured.length_unit
    show.line(text)
    show.notes(show.reasons(measured))
    show.notes(show.left_out(measured))


def _read_to_measure(path: Path, unit: str | None, likely: str) -> Dataset:
    """The unit of data to be measured does not matter; a wide CSV that states none is read as in the `likely` one."""
    try:
        return read_dataset(path, unit=unit)
    except DatasetError:
        if unit is not None or path.suffix.lower() != ".csv":
            raise
        return read_dataset(path, unit=likely)


def _typical(sd: Any) -> list[float]:
    measured = sd[np.isfinite(sd[:, 0])]
    return np.median(measured, axis=0).tolist() if len(measured) else [math.nan] * 3


@_command("evaluate")
def evaluate_command(
    file: Annotated[Path, typer.Argument(help="A calibration; with --cv or --leave-out, also known points.")],
    dataset: Annotated[Path | None, typer.Argument(help="Known points that the calibration has not seen.")] = None,
    cv: Annotated[
        int | None, typer.Option("--cv", min=2, metavar="K", help="Hold each of K random folds out in turn.")
    ] = None,
    leave_out: Annotated[
        str | None, typer.Option("--leave-out", metavar="shot", help="Hold each shot (a board, a plane) out in turn.")
    ] = None,
    report: Report = None,
    method: Method = None,
    lens: Lens = None,
    kernel: Kernel = None,
    preset: Preset = None,
    boards: Boards = None,
    align: Align = None,
    cameras: Cameras = None,
    without: Without = None,
    unit: Unit = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Judge errors and error bars against known positions: rmse, coverage, NEES, NLL, CRPS, by region."""
    wanted = _Wanted(method, lens, kernel, preset, seed, boards, align)
    _check_evaluate(dataset, cv, leave_out, wanted.given)
    if report is not None:
        _need_plotly()
    with show.progress(json) as progress:
        if dataset is not None:
            evaluation = evaluate(load_calibration(file), _read(dataset, unit, cameras, without))
        else:
            fit, data = _fit_and_data(file, wanted, cameras, without, unit)
            if cv is not None:
                evaluation = cross_validate(fit, data, cv, seed=seed, progress=progress)
            else:
                evaluation = leave_out_shots(fit, data, progress=progress)
    if report is not None:
        _write_report(evaluation, report)
    _tell_evaluation(evaluation, report, json)


def _check_evaluate(dataset: Path | None, cv: int | None, leave_out: str | None, options: bool) -> None:
    if leave_out not in (None, "shot"):
        raise UsageError(f"--leave-out {leave_out!r} is not known.", fix="write --leave-out shot")
    if cv is not None and leave_out is not None:
        raise UsageError("--cv and --leave-out exclude each other.", fix="give one of them")
    in_turn = cv is not None or leave_out is not None
    if in_turn and dataset is not None:
        raise UsageError("--cv and --leave-out take one path.", fix="give the dataset, or the calibration file")
    if not in_turn and dataset is None:
        raise UsageError(
            "evaluate needs a calibration file and a dataset.",
            fix="implicam evaluate FILE DATASET, or implicam evaluate DATASET --cv 10",
        )
    if not in_turn and options:
        raise _own_options()


def _fit_and_data(
    path: Path, wanted: _Wanted, cameras: str | None, without: str | None, unit: str | None
) -> tuple[Any, Dataset]:
    if path.suffix.lower() == CALIBRATION_SUFFIX:
        if wanted.given:
            raise _own_options()
        fitted = load_calibration(path)
        return fitted.refit, _chosen(fitted.data, cameras, without)
    return wanted.calibrator().fit, _read(path, unit, cameras, without)


def _own_options() -> UsageError:
    return UsageError("a calibration file brings its own method and options.", fix="leave out --method and its options")


def _tell_evaluation(evaluation: Evaluation, report: Path | None, json: bool) -> None:
    if json:
        show.emit_json(
            {"method": evaluation.method, "how": evaluation.how, "against": evaluation.against,
             "length_unit": evaluation.data.length_unit, **evaluation.coverage.as_dict(),
             "not_measured": show.reasons(evaluation.measurement),
             "views_left_out": show.left_out(evaluation.measurement), "notes": list(evaluation.notes),
             "report": None if report is None else str(report)}
        )  # fmt: skip
        return
    show.line(f"{evaluation.method} on {evaluation.data.name}: {evaluation.how}")
    for table in show.evaluation_tables(evaluation):
        show.table(table)
    show.line(show.verdict(evaluation.coverage.overall))
    if report is not None:
        show.line(f"report: {report}")
    show.notes(show.reasons(evaluation.measurement))
    show.notes(show.left_out(evaluation.measurement))
    show.notes(evaluation.notes)


def _need_plotly() -> None:
    """Say what is missing before the work, not after."""
    import_extra("plotly", "report", "the HTML report")


def _write_report(evaluation: Evaluation, path: Path) -> None:
    from implicam.report import report_of, write_report

    write_report(path, report_of(evaluation, f"{evaluation.data.name}, measured with {evaluation.method}"))


@_command("compare")
def compare_command(
    dataset: Annotated[Path, typer.Argument(help="Known points.")],
    methods: Annotated[
        str | None,
        typer.Option(
            "--methods", metavar="LIST", help="Separated by commas; a variant follows a colon (default: all)."
        ),
    ] = None,
    train: Annotated[
        str | None, typer.Option("--train", metavar="LIST", help="Numbers of known points, such as 17,35,87.")
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            "--seeds", min=1, metavar="N", help="Random splits (default 5); at most so many shots, planes (all)."
        ),
    ] = None,
    check: Annotated[Path | None, typer.Option("--check", help="Judge on this dataset of the same rig.")] = None,
    leave_out: Annotated[
        str | None, typer.Option("--leave-out", metavar="shot", help="Hold each shot (a board, a plane) out in turn.")
    ] = None,
    lattice: Annotated[bool, typer.Option("--lattice", help="Hold each inner plane of a lattice out, too.")] = False,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Figure to write (.png, .pdf or .svg).")] = None,
    cameras: Cameras = None,
    without: Without = None,
    unit: Unit = None,
    json: Json = False,
) -> None:
    """All methods on the same splits: one table, one figure, error bars over the splits."""
    if output is not None:
        _check_figure(output)
    data = _read(dataset, unit, cameras, without)
    check_data = None if check is None else _read(check, unit, cameras, without)
    splits = _splits(data, train, seeds, check_data, leave_out, lattice)
    names = [name.strip() for name in methods.split(",")] if methods else _available_methods()
    chosen = {name: _named_method(name) for name in names}
    with show.progress(json) as progress:
        trials = compare_on(splits, chosen, progress)
    if output is not None:
        _write_figure(trials, data.length_unit, output)
    if json:
        show.emit_json({"length_unit": data.length_unit, **as_json(trials), "figure": output and str(output)})
        return
    rows = summarise(trials)
    show.table(show.compare_table(rows, data.length_unit))
    if output is not None:
        show.line(f"figure: {output}")
    show.notes(show.compare_failures(trials))


SHOWN_VARIANTS = {ForwardGP.method: ("none",), InverseGP.method: ("paper",), MLP.method: ("no-dropout",)}
"""Variants that stand beside their method unless --methods names others."""

NEEDED = {
    "inverse-gp:paper": ("gpytorch", "paper"),
    "mlp": ("torch", "mlp"),
    "mlp:no-dropout": ("torch", "mlp"),
}
"""Method or variant -> the library it needs, and the extra that brings it."""


def _available_methods() -> list[str]:
    """All methods and the variants worth showing, as far as their libraries are installed."""
    names = [name for method in METHODS for name in (method, *_variants(method))]
    absent = [name for name in names if name in NEEDED and find_spec(NEEDED[name][0]) is None]
    for name in absent:
        show.note(f'left out {name}: pip install "implicam[{NEEDED[name][1]}]" to add it')
    return [name for name in names if name not in absent]


def _variants(method: str) -> list[str]:
    return [f"{method}:{variant}" for variant in SHOWN_VARIANTS.get(method, ())]


def _named_method(name: str) -> Any:
    method, _, variant = name.partition(":")
    if name in NEEDED:
        import_extra(*NEEDED[name], name)  # now, so that no fit is charged for it
    if not variant:
        return calibrator(method)
    if (method, variant) == (InverseGP.method, "paper"):
        return calibrator(method, preset=variant)
    if (method, variant) == (MLP.method, "no-dropout"):
        return calibrator(method, dropout=0.0)
    return calibrator(method, **{"kernel" if method == InverseGP.method else "lens": variant})


def _splits(
    data: Dataset, train: str | None, seeds: int | None, check: Dataset | None, leave_out: str | None, lattice: bool
) -> list[Split]:
    if leave_out not in (None, "shot"):
        raise UsageError(f"--leave-out {leave_out!r} is not known.", fix="write --leave-out shot")
    if (check is not None) + (leave_out is not None) + lattice > 1:
        raise UsageError("--check, --leave-out and --lattice exclude each other.", fix="give one of them")
    if leave_out is not None:
        return shot_splits(data, _sizes(train, len(data)) if train else None, most=seeds)
    draws = seeds or 5
    if not lattice:
        return random_splits(data, _sizes(train, len(data)), seeds=draws, check=check)
    fewest = min(len(split.train) for split in plane_splits(data))
    sizes = _sizes(train, len(data)) if train else [min(fewest, round(len(data) / 2), MOST_ON_LATTICE)]
    return random_splits(data, sizes, seeds=draws) + plane_splits(data, sizes, most=seeds)


MOST_ON_LATTICE = 200
"""Points to train on with --lattice, unless --train says more: every plane costs a fit of every method."""


def _sizes(text: str | None, n: int) -> list[int]:
    if text is None:
        return sorted({min(n - 1, max(5, round(n * share))) for share in (0.1, 0.2, 0.5, 0.9)})
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise UsageError(f"--train {text!r} is not a list of numbers.", fix="write for example 17,35,87") from None


def _check_figure(path: Path) -> None:
    """Before the work, not after."""
    if path.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise UsageError(f"{path} is no picture.", fix="end the name in .png, .pdf or .svg")
    import_extra("matplotlib", "report", "a figure for print")


def _write_figure(trials: Sequence[Trial], unit: str, path: Path) -> None:
    from implicam.figures import compare_figure

    figure = compare_figure([asdict(trial) for trial in trials], unit=unit)
    with replacing(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:].lower(), dpi=160)


@_command("report")
def report_command(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    dataset: Annotated[Path | None, typer.Argument(help="Known points; without, its own by 10-fold.")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="The page to write.")] = Path("report.html"),
    unit: Unit = None,
    json: Json = False,
) -> None:
    """Write a one-page HTML report with an interactive 3D view."""
    _need_plotly()
    fitted = load_calibration(calibration)
    with show.progress(json) as progress:
        if dataset is None:
            evaluation = cross_validate(fitted.refit, fitted.data, min(10, len(fitted.data)), progress=progress)
        else:
            evaluation = evaluate(fitted, _read(dataset, unit))
    _write_report(evaluation, output)
    if json:
        show.emit_json({"report": str(output), "how": evaluation.how})
    else:
        show.line(f"{output}: {evaluation.how}")


@_command("convert")
def convert_command(
    dataset: Annotated[Path, typer.Argument(help="A folder, .csv, .parquet or .npz.")],
    out: Annotated[Path, typer.Argument(help="The same, in another form: the ending chooses.")],
    unit: Unit = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it is a folder that exists.")] = False,
    json: Json = False,
) -> None:
    """Write a dataset in another form: folder, wide CSV, Parquet, NPZ; nothing is lost."""
    if out.exists() and out.resolve() == dataset.resolve():
        raise UsageError(f"{dataset} would be replaced by itself.", fix="give another name to write to")
    data = read_dataset(dataset, unit=unit)
    write_dataset(data, out, overwrite=overwrite)
    if json:
        show.emit_json({"dataset": str(out), "points": len(data)})
    else:
        show.line(f"{out}: {len(data)} points, {len(data.cameras)} cameras")


@_command("export")
def export_command(
    calibration: Annotated[Path, typer.Argument(help="A calibration by explicit, or by forward-gp.")],
    to: Annotated[str, typer.Option("--to", metavar="NAME", help=f"One of {', '.join(FORMATS)}.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The file to write; for colmap a folder.")],
    json: Json = False,
) -> None:
    """Write the cameras for another program: lenses and places, as far as its format holds them."""
    rig, lost = rig_of(load_calibration(calibration))
    notes = [*lost, *export_cameras(rig, to, output)]
    if json:
        show.emit_json({"cameras": len(rig.cameras), "format": to, "file": str(output), "notes": notes})
        return
    show.line(f"{output}: {len(rig.cameras)} cameras as {FORMATS[to].what}")
    show.notes(notes)


@_command("import")
def import_command(
    cameras: Annotated[Path, typer.Argument(help="Cameras that another program calibrated.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The calibration file to write (*.implicam).")],
    kind: Annotated[
        str | None, typer.Option("--from", metavar="NAME", help="The format, where its content does not tell.")
    ] = None,
    noise: Annotated[
        float, typer.Option("--noise", min=1e-6, metavar="PX", help="Noise of views that do not state theirs.")
    ] = 0.3,
    unit: Annotated[
        str | None, typer.Option("--unit", metavar="UNIT", help="Length unit, where the file does not state it.")
    ] = None,
    json: Json = False,
) -> None:
    """Make a calibration of another program's cameras, to measure with them and to check them."""
    _must_be_calibration(output)
    rig = import_cameras(cameras, kind)
    rig = rig.in_unit(unit) if unit and rig.length_unit != UNKNOWN else import_cameras(cameras, kind, unit=unit)
    calibration = calibration_of(rig, cameras.stem, noise)
    calibration.save(output)
    if json:
        show.emit_json({"calibration": str(output), "cameras": len(rig.cameras), "notes": calibration.notes()})
        return
    show.line(f"{output}: {len(rig.cameras)} cameras, lengths in {rig.length_unit}")
    show.notes(calibration.notes())


@_command("info")
def info_command(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    json: Json = False,
) -> None:
    """Show what a calibration file says about itself."""
    load_calibration(calibration)  # a damaged file must not look healthy
    table = calibration_file.describe(calibration)
    if json:
        show.emit_json(table)
    else:
        show.line(toml_text(table).rstrip())


def _version(shown: bool) -> None:
    if shown:
        typer.echo(f"implicam {calibration_file.package_version()}")
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Turn a set of fixed cameras into a 3D measuring instrument with honest error bars."""
