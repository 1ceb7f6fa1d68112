"""The commands and their options; those that fill a file of their own are imported from it.

Every help text ends with an example that a test runs.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import implicam.cli.acquire
import implicam.cli.board
import implicam.cli.bugreport
import implicam.cli.cameras
import implicam.cli.check
import implicam.cli.compare
import implicam.cli.design
import implicam.cli.detect
import implicam.cli.label
import implicam.cli.paper
import implicam.cli.shoot
import implicam.cli.simulate
import implicam.cli.verify
import implicam.cli.view
import implicam.cli.world  # noqa: F401  these register their commands
from implicam import calibration_file
from implicam.calibrators import Calibration, Calibrator, Explicit, load_calibration
from implicam.calibrators.elsewhere import fit_on_cluster
from implicam.calibrators.explicit.boards import has_boards
from implicam.calibrators.protocol import SETTINGS, RigCalibration
from implicam.cli import show
from implicam.cli.app import (
    CALIBRATION_SUFFIX,
    EXAMPLES,
    Cameras,
    Json,
    LeaveOut,
    Method,
    Report,
    Scheduler,
    Seed,
    Without,
    app,
    chosen,
    command,
    must_be_calibration,
    must_be_folder,
    must_be_page,
    must_be_shot,
    must_not_replace,
    read,
    read_to_measure,
)
from implicam.cli.options import OptionsOfParts, calibrator_from_options, options_of_calibrators, with_table_options
from implicam.cli.settings import (
    SettingsFile,
    ShowSettings,
    settings_of,
    settings_table,
    settings_text,
    with_settings,
)
from implicam.dataset import Dataset, TableOptions, write_dataset
from implicam.dataset.programs import PROGRAMS, read_program, write_program
from implicam.dataset.table_options import DOCUMENTED
from implicam.dataset.units import metres_per
from implicam.dataset.written_table import check_table_name
from implicam.derived.table import distance_rows, distances_text, read_pairs
from implicam.errors import UsageError
from implicam.evaluation import Evaluation, cross_validate, evaluate, leave_out_shots
from implicam.files import refuse_folder, toml_text, write_text
from implicam.formatting import decimal_number, percent
from implicam.measurement import notes_outside
from implicam.verdict import DOUBTFUL, NOT_USABLE, Verdict, judge

__all__ = ["EXAMPLES", "app"]

MAX_DISTANCES_SHOWN = 20
"""On the terminal; all are in the table."""


@command("demo")
def demo_command(
    folder: Annotated[Path, typer.Argument(help="Where to put its files.")] = Path("implicam-demo"),
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Photograph a simulated rig, detect, calibrate, measure, judge, report: both methods, in about a minute."""
    from implicam.demo import run

    must_be_folder(folder)
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
        f"each to {decimal_number(made.typical_sd, 2)} px\n"
    )
    show.table(show.demo_table(made))
    show.line(
        "limit: the Cramer-Rao bound; with this noise of detection nobody does better on average, even with perfectly "
        "known cameras"
    )
    for key, path in files.items():
        show.line(f"  {key:<12}{path}")


def _calibrate(
    dataset: Annotated[Path, typer.Argument(help="Known points and what the cameras saw of them.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The calibration file to write.")],
    method: Method = None,
    points: Annotated[int | None, typer.Option(min=1, metavar="N", help="Use so many points, drawn at random.")] = None,
    cameras: Cameras = None,
    without: Without = None,
    table: TableOptions = DOCUMENTED,
    settings: SettingsFile = None,
    seed: Seed = 0,
    force: Annotated[bool, typer.Option("--force", help="Write the file even if it is not usable.")] = False,
    scheduler: Scheduler = None,
    json: Json = False,
    **options: Any,
) -> None:
    """Learn the rig from known points; points kept back with --points are there for `implicam evaluate`."""
    must_be_calibration(output)
    data = read(dataset, table, cameras, without)
    if points is not None and points != len(data):
        data, _ = data.split(points, seed=seed)
    if data.known is None and has_boards(data) and not _any_given(method, options):
        method = Explicit.method  # nothing else can be made of boards
    made = with_settings(calibrator_from_options(method, seed, options), settings)
    with show.progress(json) as progress:
        calibration = made.fit(data, progress) if scheduler is None else fit_on_cluster(made, data, scheduler)
        verdict = judge(calibration, progress)
    written = force or verdict.word != NOT_USABLE
    if written:
        calibration_file.save(calibration, output, verdict.as_table())
    _tell_calibration(calibration, verdict, output if written else None, json)
    if not written:
        raise typer.Exit(1)


calibrate_command = command("calibrate")(
    OptionsOfParts(with_table_options(_calibrate), "method", options_of_calibrators)
)


def _any_given(method: str | None, options: Mapping[str, Any]) -> bool:
    return method is not None or any(value is not None for value in options.values())


def _tell_calibration(calibration: Calibration, verdict: Verdict, output: Path | None, json: bool) -> None:
    summary = calibration.summary()
    unused = [asdict(unused) for unused in calibration.unused]
    notes = [*calibration.data.notes, *calibration.notes]
    if json:
        show.emit_json(
            {"calibration": None if output is None else str(output), "verdict": verdict.as_table(),
             "method": calibration.method, "residuals": summary.as_table(), "unused": unused,
             "rejected": [asdict(view) for view in calibration.rejected], "notes": notes,
             "length_unit": calibration.data.length_unit}
        )  # fmt: skip
        return
    unit = calibration.data.length_unit
    show.line(f"{output or 'no file written'}: {calibration.method} from {summary.points_used} points")
    rms = summary.leave_one_out_rms
    names = [f"{axis} " for axis in rms] if len(rms) > 1 else [""]  # a wand has its length only, named before
    within = ", ".join(f"{name}{decimal_number(value)}" for name, value in zip(names, rms.values(), strict=True))
    show.line(f"{summary.how} within {within} {unit} rms")
    show.notes(show.counted((entry.reason for entry in calibration.unused), "known point", "not used"))
    show.notes([note for note in notes if note not in verdict.reasons])
    show.calibration_verdict(verdict, unit)
    if output is None:
        show.say("no file is written; --force writes it nevertheless")


def _measure_in_parts(
    calibration: Path,
    source: Path,
    output: Path,
    chunk: int | None,
    scheduler: str | None,
    *,
    others: Sequence[object],
    json: bool,
) -> None:
    """A table of any length, if that is wanted, and leave."""
    if chunk is None:
        if scheduler is not None:
            raise UsageError(
                "--scheduler goes with --chunk: a cluster measures tables in parts.", fix="add --chunk 100000"
            )
        return
    from implicam.bulk import measure_file
    from implicam.bulk_folder import measure_folder

    if any(others):
        raise UsageError(
            "--chunk goes with no other option of measure but -o, --scheduler and --json.",
            why="a table of any length has the columns u_CAMERA, v_CAMERA and point, and nothing else is read",
            fix="leave the other options out, or measure it as a whole",
        )
    fitted = load_calibration(calibration)
    if not isinstance(fitted, RigCalibration):
        raise UsageError(
            f"{fitted.method} does not measure tables in parts.",
            fix="measure it as a whole, or calibrate with forward-gp or explicit",
        )
    with show.progress(json) as progress:
        measure = measure_folder if source.is_dir() else measure_file
        found = measure(fitted, source, output, points_at_once=chunk, scheduler=scheduler, progress=progress)
    if json:
        show.emit_json({"measured": str(output), **asdict(found), "notes": _unknown_errors(fitted)})
    else:
        before = f", {found.resumed:,} of them before" if found.resumed else ""
        show.line(f"{output}: {found.rows:,} rows, {found.measured:,} measured{before}")
        show.notes(_unknown_errors(fitted))
        for alarm in found.alarms:
            show.alarm(f"{alarm}{'' if alarm.endswith('?') else '.'} These rows say that they are doubtful.")
    raise typer.Exit(int(bool(found.alarms)))


@command("measure")
@with_table_options
def measure_command(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    dataset: Annotated[Path, typer.Argument(help="What the cameras saw.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The table to write: .csv, .xlsx or .parquet.")] = Path(
        "measured.csv"
    ),
    between: Annotated[
        tuple[str, str] | None,
        typer.Option("--distance", metavar="A B", help="The distance of two points, with its uncertainty."),
    ] = None,
    pairs: Annotated[
        Path | None, typer.Option("--distances", metavar="CSV", help="The same for a table of pairs: a,b.")
    ] = None,
    chunk: Annotated[
        int | None,
        typer.Option(
            metavar="POINTS",
            help="Measure a .csv, .parquet or .npz of any length, or a folder of them, in parts of so many points; "
            "killed, the same command goes on.",
        ),
    ] = None,
    scheduler: Scheduler = None,
    table: TableOptions = DOCUMENTED,
    json: Json = False,
) -> None:
    """Measure every point of a dataset: position, standard uncertainty, covariance; or the reason why not.

    The table is in the length unit of the calibration, or in that of --unit. Distances of pairs go to distances.csv
    beside it: their uncertainty knows what the errors of the two points share, which the table does not say.
    """
    refuse_folder(output)
    must_not_replace(output, calibration, dataset)
    others = table != DOCUMENTED, between, pairs
    _measure_in_parts(calibration, dataset, output, chunk, scheduler, others=others, json=json)
    check_table_name(output)
    wanted = [*([between] if between else ()), *(read_pairs(pairs) if pairs else ())]
    beside = output.with_name("distances.csv")
    if wanted:
        must_not_replace(beside, calibration, dataset, output, *([pairs] if pairs else []))
    fitted = load_calibration(calibration)
    judged = calibration_file.describe(calibration).get("verdict", {}).get("word", "")
    unit = table.unit or fitted.data.length_unit  # one without a known size is converted to no other
    if unit != fitted.data.length_unit:
        metres_per(unit)  # refused before the work
        metres_per(fitted.data.length_unit)
    data = read_to_measure(dataset, replace(table, unit=None), fitted)
    with show.progress(json) as progress:
        progress("measuring", 0, 1)
        measured = fitted.measure(data.observations).with_columns(data.further_columns())
        outside = notes_outside(measured, fitted.data)
        progress("measuring", 1, 1)
    if unit != measured.length_unit:
        measured = measured.in_unit(unit)
    found = distance_rows(measured, wanted) if wanted else []
    measured.write(output)
    if wanted:
        write_text(beside, distances_text(found))
    count, typical = int(measured.measured.sum()), _typical(measured.sd)
    known = measured.share_calibration[np.isfinite(measured.share_calibration)]
    share = float(np.median(known)) if len(known) else math.nan
    notes = [*data.notes, *outside, *_views_not_used(fitted, data), *_unknown_errors(fitted)]
    if json:
        show.emit_json(
            {"measured": str(output), "rows": len(measured), "points_measured": count, "median_sd": typical,
             "median_share_calibration": share,
             "length_unit": measured.length_unit, "not_measured": show.reasons(measured),
             "views_left_out": show.left_out(measured), "notes": notes, "alarm": measured.alarm,
             **({"distances": str(beside)} if wanted else {})}
        )  # fmt: skip
        raise typer.Exit(int(bool(measured.alarm)))
    text = f"{output}: {len(measured)} rows, {count} measured"
    if count:
        text += f", typical sd {', '.join(f'{a} {decimal_number(v)}' for a, v in zip('xyz', typical, strict=True))} "
        text += measured.length_unit
    show.line(text)
    if math.isfinite(share):
        show.line(f"more known points could remove {percent(share)} of the variance (median); the rest is pixel noise")
    if wanted:
        show.line(f"{beside}: {len(wanted)} distance{'s' * (len(wanted) > 1)}")
        for row in found[:MAX_DISTANCES_SHOWN]:
            show.line(f"  {row}")
    if judged in (DOUBTFUL, NOT_USABLE):
        show.note(f"this calibration was found {judged} when it was made: implicam info {calibration} says why")
    show.notes(notes)
    show.notes(show.reasons(measured))
    show.notes(show.left_out(measured))
    if measured.alarm:
        show.alarm(f"{measured.alarm}{'' if measured.alarm.endswith('?') else '.'} Every row says that it is doubtful.")
    raise typer.Exit(int(bool(measured.alarm)))


def _views_not_used(fitted: Calibration, data: Dataset) -> list[str]:
    """Which cameras of the data measure nothing, because they are not calibrated."""
    names = fitted.camera_names if isinstance(fitted, RigCalibration) else fitted.data.observations.camera_names
    views = zip(data.observations.camera_names, data.observations.seen.sum(axis=0).tolist(), strict=True)
    lost = [f"{name} ({count})" for name, count in views if count and name not in names]
    return [f"views of cameras that are not calibrated are not used: {', '.join(lost)}"] if lost else []


def _unknown_errors(fitted: Calibration) -> list[str]:
    """What an imported calibration says of its error bars."""
    if len(fitted.data) or not isinstance(fitted, RigCalibration) or fitted.map.posterior.errors_known:
        return []
    return [
        "Another program calibrated these cameras, and nothing is known of how well: the standard uncertainties are "
        "of the noise of the pixels alone, and the errors may be larger."
    ]


def _typical(sd: Any) -> list[float]:
    measured = sd[np.isfinite(sd[:, 0])]
    return np.median(measured, axis=0).tolist() if len(measured) else [math.nan] * 3


def _evaluate(
    file: Annotated[Path, typer.Argument(help="A calibration; with --cv or --leave-out, also known points.")],
    dataset: Annotated[Path | None, typer.Argument(help="Known points that the calibration has not seen.")] = None,
    cv: Annotated[
        int | None, typer.Option("--cv", min=2, metavar="K", help="Hold each of K random folds out in turn.")
    ] = None,
    leave_out: LeaveOut = None,
    report: Report = None,
    method: Method = None,
    cameras: Cameras = None,
    without: Without = None,
    table: TableOptions = DOCUMENTED,
    seed: Seed = 0,
    json: Json = False,
    **options: Any,
) -> None:
    """Judge errors and error bars against known positions: rmse, coverage, NEES, NLL, CRPS, by region."""
    given = _any_given(method, options)
    _check_evaluate(dataset, cv, leave_out, given)
    if report is not None:
        must_not_replace(report, file, dataset)
        must_be_page(report)
    with show.progress(json) as progress:
        if dataset is not None:
            fitted = load_calibration(file)
            evaluation = evaluate(fitted, read(dataset, table, cameras, without, fitted))
        else:
            make = partial(calibrator_from_options, method, seed, options)
            fit, data = _fit_and_data(file, make, cameras, without, table, given)
            if cv is not None:
                evaluation = cross_validate(fit, data, cv, seed=seed, progress=progress)
            else:
                evaluation = leave_out_shots(fit, data, progress=progress)
    if report is not None:
        _write_report(evaluation, report, "" if dataset is None else calibration_file.checksum(file))
    _tell_evaluation(evaluation, report, json)


def _check_evaluate(dataset: Path | None, cv: int | None, leave_out: str | None, options: bool) -> None:
    must_be_shot(leave_out)
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


evaluate_command = command("evaluate")(OptionsOfParts(with_table_options(_evaluate), "method", options_of_calibrators))


def _fit_and_data(
    path: Path,
    make: Callable[[], Calibrator],
    cameras: str | None,
    without: str | None,
    table: TableOptions,
    given: bool,
) -> tuple[Any, Dataset]:
    if path.suffix.lower() == CALIBRATION_SUFFIX:
        if given:
            raise _own_options()
        fitted = load_calibration(path)
        return fitted.refit, chosen(fitted.data, cameras, without)
    return make().fit, read(path, table, cameras, without)


def _own_options() -> UsageError:
    return UsageError("a calibration file brings its own method and options.", fix="leave out --method and its options")


def _tell_evaluation(evaluation: Evaluation, report: Path | None, json: bool) -> None:
    if json:
        show.emit_json(
            {"method": evaluation.method, "how": evaluation.how, "against": evaluation.against,
             "length_unit": evaluation.data.length_unit, **evaluation.coverage.as_dict(),
             "not_measured": show.reasons(evaluation.measurement),
             "views_left_out": show.left_out(evaluation.measurement), "alarm": evaluation.measurement.alarm,
             "notes": list(evaluation.notes),
             "report": None if report is None else str(report)}
        )  # fmt: skip
        return
    show.line(f"{evaluation.method} on {evaluation.data.name}: {evaluation.how}")
    for table in show.evaluation_tables(evaluation):
        show.table(table)
    show.explain(*show.evaluation_words(evaluation))
    show.line(f"\n{show.verdict(evaluation.coverage.overall)}")
    if report is not None:
        show.line(f"report: {report}")
    show.notes(show.reasons(evaluation.measurement))
    show.notes(show.left_out(evaluation.measurement))
    if evaluation.measurement.alarm:
        show.alarm(evaluation.measurement.alarm)
    show.notes(evaluation.notes)


def _write_report(evaluation: Evaluation, path: Path, checksum: str) -> None:
    from implicam.report.call import report

    report(evaluation, path, checksum=checksum)


@command("report")
@with_table_options
def report_command(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    dataset: Annotated[Path | None, typer.Argument(help="Known points; without, its own by 10-fold.")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="The page to write.")] = Path("report.html"),
    by: Annotated[str, typer.Option("--by", metavar="NAME", help="Who reports, for the head of the page.")] = "",
    table: TableOptions = DOCUMENTED,
    json: Json = False,
) -> None:
    """Write a one-page HTML report: accuracy, error bars, where the uncertainty comes from, every camera, advice."""
    must_not_replace(output, calibration, dataset)
    must_be_page(output)
    fitted = load_calibration(calibration)
    from implicam.report.call import report
    from implicam.report.words import headline

    with show.progress(json) as progress:
        data = None if dataset is None else read(dataset, table, calibration=fitted)
        sha256 = calibration_file.checksum(calibration)
        found = report(fitted, output, data=data, checksum=sha256, by=by, progress=progress)
    how = found.how if isinstance(found, Evaluation) else headline(found)
    if json:
        show.emit_json({"report": str(output), "how": how})
    else:
        show.line(f"{output}: {how}")


@command("convert")
@with_table_options
def convert_command(
    dataset: Annotated[Path, typer.Argument(help="A folder, .csv, .tsv, .xlsx, .parquet or .npz.")],
    out: Annotated[Path, typer.Argument(help="The same, in another form: the ending chooses.")],
    table: TableOptions = DOCUMENTED,
    source: Annotated[
        str | None, typer.Option("--from", metavar="PROGRAM", help=f"Read the files of {', '.join(PROGRAMS)}.")
    ] = None,
    to: Annotated[str | None, typer.Option("--to", metavar="PROGRAM", help="Write the files of one of these.")] = None,
    positions: Annotated[
        Path | None, typer.Option("--positions", help="With --from dltdv, easywand, argus: rows of x,y,z.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it is a folder that exists.")] = False,
    json: Json = False,
) -> None:
    """Write a dataset in another form: folder, wide CSV, Excel, Parquet, NPZ, or the files of another program."""
    if out.exists() and out.resolve() == dataset.resolve():
        raise UsageError(f"{dataset} would be replaced by itself.", fix="give another name to write to")
    if positions is not None and source is None:
        raise UsageError("--positions belongs to the files of another program.", fix="add --from PROGRAM")
    data = read(dataset, table) if source is None else read_program(dataset, source, table, positions)
    if to is None:
        write_dataset(data, out, overwrite=overwrite)
        notes = list(data.notes)
    else:
        notes = [*data.notes, *write_program(data, out, to)]
    if json:
        show.emit_json({"dataset": str(out), "points": len(data), "notes": notes})
        return
    without = "" if data.known is not None else " without known positions"
    show.line(f"{out}: {len(data)} points{without}, {len(data.cameras)} cameras")
    show.notes(notes)


@command("info")
def info_command(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    settings: ShowSettings = False,
    json: Json = False,
) -> None:
    """Show what a calibration file says about itself."""
    loaded = load_calibration(calibration)  # a damaged file must not look healthy
    if settings:
        show.emit_json(settings_table(loaded)) if json else show.line(settings_text(loaded))
        return
    table = {"sha256": calibration_file.checksum(calibration), **calibration_file.describe(calibration)}
    cameras = loaded.cameras.values() if isinstance(loaded, RigCalibration) else ()
    table["fitted_cameras"] = [camera.as_table() for camera in cameras]
    if json:
        show.emit_json(table)
        return
    made_with = settings_of(loaded)
    table["options"].pop(SETTINGS, None)
    fitted = table.pop("fitted_cameras")
    show.line(toml_text(table).rstrip())
    if fitted:
        show.line(show.table_lines("fitted_cameras", fitted))
    if made_with is not None:
        changed, count = made_with.changed(), len(made_with.described())
        plain = {name: list(value) if isinstance(value, tuple) else value for name, value in changed.items()}
        text = f"\n[options.settings]\n{toml_text(plain).rstrip()}\n" if changed else "\n"
        show.line(f"{text}# the other {count - len(changed)} settings are at their defaults; --settings shows all")


def _version(shown: bool) -> None:
    if shown:
        typer.echo(f"implicam {calibration_file.package_version()}")
        if logging.getLogger("implicam").isEnabledFor(logging.INFO):  # -v
            from implicam.tabulated.library import how_it_measures

            typer.echo(f"many points are measured by tables: {how_it_measures()}")
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Turn a set of fixed cameras into a 3D measuring instrument with honest error bars."""


app.registered_commands.sort(key=lambda registered: list(EXAMPLES).index(str(registered.name)))  # their order in --help
