"""`implicam suggest` and `implicam acquire`: where to measure next, once and as a guided session."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from implicam.calibrators import FromWand, load_calibration
from implicam.cli import show
from implicam.cli.app import Json, Seed, command, command_line, must_be_folder, must_not_replace
from implicam.cli.options import OptionsOfParts, options_of_setup
from implicam.dataset import Floats
from implicam.dataset.written_table import check_table_name, write_table
from implicam.errors import ImplicamError, UsageError, import_extra
from implicam.files import refuse_folder
from implicam.formatting import decimal_number, json_safe, percent, without_dust
from implicam.images import opencv
from implicam.logs import LOG, log_to_file
from implicam.threads import return_large_memory

if TYPE_CHECKING:
    from implicam.active import Below, Within
    from implicam.session.controller import SessionController


def _suggest(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    count: Annotated[int, typer.Option("--count", "-n", min=1, max=200, metavar="N", help="How many targets.")] = 5,
    workspace: Annotated[
        str | None,
        typer.Option(
            metavar="WHERE",
            help="x0:x1,y0:y1,z0:z1, a CSV of places, box or hull of the known points, or view. Default box.",
        ),
    ] = None,
    here: Annotated[
        str | None, typer.Option("--from", metavar="X,Y,Z", help="Where the robot is: the targets in a short order.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Also write a table of them: .csv, .xlsx or .parquet."),
    ] = None,
    seed: Seed = 0,
    json: Json = False,
    **options: Any,
) -> None:
    """Where to put the next known points, and what each camera will see.

    Of a calibration from a wand: whether it was waved enough, and where not.
    """
    from implicam.active import acquisition_from_name, suggest, workspace_from
    from implicam.active.acquisitions import DEFAULT_ACQUISITION
    from implicam.session.setup import position_from_text

    reach = options["reach"]
    if output is not None:
        refuse_folder(output)
        must_not_replace(output, calibration)
        check_table_name(output)
    fitted = load_calibration(calibration)
    if isinstance(fitted, FromWand) and fitted.wand is not None:
        _advise_waving(fitted, workspace, count=count, below=options["below"], output=output, seed=seed, json=json)
        return
    if options["below"] is not None:
        raise UsageError("--below is for a calibration from a wand.", fix="leave it out: the uncertainty is printed")
    if reach is not None and not reach > 0:
        raise UsageError(f"a reach of {reach:g} is no length.", fix="give one greater than zero")
    space = None if workspace == "view" else workspace_from(workspace or "box", fitted.data.xyz)
    found = suggest(
        fitted,
        space,
        count=count,
        rule=acquisition_from_name(options["acquisition"] or DEFAULT_ACQUISITION),
        here=None if here is None else position_from_text(here, "--from"),
        reach=np.inf if reach is None else reach,
        seed=seed,
    )
    cameras, unit = fitted.data.observations.camera_names, fitted.data.length_unit
    if output is not None:
        write_table(output, _columns(cameras, found.targets))
    if json:
        targets = [
            {
                "name": t.name,
                "xyz": t.xyz.tolist(),
                "score": t.score,
                "pixels": {name: uv.tolist() if np.isfinite(uv[0]) else None for name, uv in _pairs(cameras, t.uv)},
            }
            for t in found.targets
        ]
        steps = {"now": asdict(found.now), "expected": asdict(found.then)}
        show.emit_json({"length_unit": unit, "workspace": found.workspace.name, "targets": targets, **steps})
        return
    rows = [[str(i), *(f"{x:.5g}" for x in without_dust(t.xyz.tolist()))] for i, t in enumerate(found.targets, start=1)]
    show.line(f"Where to put the next known points, in {unit}:")
    show.table(show.text_table("", ["", "x", "y", "z"], rows))
    seen = [[str(i), *(_pixel(uv) for _, uv in _pairs(cameras, t.uv))] for i, t in enumerate(found.targets, start=1)]
    show.line("Where each camera will see them, in pixels:")
    show.table(show.text_table("", ["", *cameras], seen))
    show.line(f"95 % uncertainty in 95 % of the workspace ({found.workspace.name}):")
    for words, step in (("now", found.now), (f"then, with all {len(found.targets)}", found.then)):
        times = f"{decimal_number(step.excess)} times what pixel noise alone leaves"
        show.line(f"  {words:<18} {decimal_number(step.usual)} {unit}, {times}")
    if found.now.measured < 0.995:
        show.note(f"{percent(found.now.measured)} of the workspace is seen by enough cameras; this is about that part.")
    if output is not None:
        show.line(f"{output}: {len(found.targets)} targets")


_shared_options = partial(options_of_setup, "acquisition", "reach", "below")
suggest_command = command("suggest")(OptionsOfParts(_suggest, "workspace", _shared_options))


def _advise_waving(
    fitted: FromWand, workspace: str | None, *, count: int, below: float | None, output: Path | None, seed: int,
    json: bool,
) -> None:  # fmt: skip
    """Was the wand waved enough, and where not: what the guided session says, of a recording afterwards."""
    from implicam.active import Below, Target, Within, Workspace, summarise_step, workspace_from
    from implicam.active.wand_loop import describe_lengths, describe_reach, judge_waving
    from implicam.calibrators import PredictsPixels

    wand, data = fitted.wand, fitted.data
    assert wand is not None
    assert isinstance(fitted, PredictsPixels)
    space = None if workspace in (None, "box", "view") else workspace_from(str(workspace), data.xyz)
    if workspace == "view":
        space = Workspace.in_view(fitted, data.xyz)
    rule = Within() if below is None else Below(below, "usual")
    with show.progress(json) as progress:
        found = judge_waving(
            fitted, wand, space, target=np.nan if below is None else below, seed=seed, count=count, progress=progress
        )
    cameras, unit, design = data.observations.camera_names, data.length_unit, found.design
    if design is None:
        raise UsageError(
            "hardly any place of the volume is seen by two cameras.", fix="give another --workspace, or leave it out"
        )
    now = summarise_step(design.at_judged, len(data))
    missing = [name for name in cameras if name not in fitted.camera_names]
    enough = "" if found.faults or missing else rule.met([now], unit)
    targets = [Target(f"w{k}", one.xyz, one.uv, one.gain) for k, one in enumerate(found.places, start=1)]
    cells = {
        camera.name: design.cells(c, data.observations.uv[:, c], (camera.width, camera.height)).known
        for c, camera in enumerate(data.cameras)
        if camera.name in fitted.camera_names and camera.width is not None and camera.height is not None
    }
    if output is not None:
        write_table(output, _columns(cameras, targets))
    if json:
        held_out = found.held_out
        show.emit_json({
            "length_unit": unit, "enough": bool(enough), "now": asdict(now), "reasons": list(found.faults),
            "out_of_reach": describe_reach(design, unit), "not_calibrated": missing,
            "held_out": None if held_out is None else {
                "errors": held_out.errors.tolist(), "sds": held_out.sds.tolist(),
            },
            "places": [
                {"xyz": one.xyz.tolist(), "words": one.words, "why": one.why, "gain": one.gain,
                 "pixels": {name: uv.tolist() if np.isfinite(uv[0]) else None for name, uv in _pairs(cameras, one.uv)}}
                for one in found.places
            ],
            "cells": {name: json_safe(known.tolist()) for name, known in cells.items()},
        })  # fmt: skip
        return
    reached = f"{decimal_number(now.usual, 3)} {unit} in 95 % of the volume"
    times = f"{decimal_number(now.excess, 3)} times what pixel noise alone leaves"
    show.line(f"95 % uncertainty: {reached}, {times}; enough is {_wanted(rule, unit)}.")
    if told := describe_lengths(found.held_out, wand, unit):
        show.line(f"{told[:1].upper()}{told[1:]}.")
    for text in (*found.faults, describe_reach(design, unit), *(f"{name} is not calibrated." for name in missing)):
        if text:
            show.note(text)
    show.line(f"Enough: {enough}. Where more would help most:" if enough else "Not enough. Where to wave next:")
    rows = [[str(k), one.words, one.why] for k, one in enumerate(found.places, start=1)]
    show.table(show.text_table("", ["", "where", "why"], rows))
    for name, known in cells.items():
        some = known[np.isfinite(known)]
        if len(some):
            show.line(f"  {name}: {percent(float(np.mean(some >= 1)))} of what it sees of the volume is well known")
    if output is not None:
        show.line(f"{output}: {len(targets)} places")


def _wanted(rule: Within | Below, unit: str) -> str:
    from implicam.active import Below

    return f"{rule.value:g} {unit}" if isinstance(rule, Below) else f"{rule.times:g} times"


def _pairs(cameras: Sequence[str], uv: Floats) -> list[tuple[str, Floats]]:
    return list(zip(cameras, uv, strict=True))


def _columns(cameras: Sequence[str], targets: Sequence[Any]) -> dict[str, NDArray[Any]]:
    """Of a table of the targets: where each is, and at which pixel each camera will see it."""
    numbers = np.array([[*target.xyz, *target.uv.ravel()] for target in targets], dtype=np.float64)
    headings = ["x", "y", "z", *(f"{axis}_{name}" for name in cameras for axis in "uv")]
    names = np.array([target.name for target in targets], dtype=np.str_)
    return {"point": names, **dict(zip(headings, numbers.T, strict=True))}


def _pixel(uv: Floats) -> str:
    return f"{uv[0]:.0f}, {uv[1]:.0f}" if np.isfinite(uv[0]) else "-"


_PAGE = "The page"

CLOSING_SECONDS = 1.5
"""How long a session may take to close after SIGTERM; one that still waits for a camera or a robot then is cut off, as
by `kill -9`, which loses nothing."""


def _acquire(
    folder: Annotated[Path, typer.Argument(help="The session: a new folder, or one to go on with.")],
    unattended: Annotated[
        bool, typer.Option("--unattended", help="No page: the simulated rig by itself.", rich_help_panel=_PAGE)
    ] = False,
    host: Annotated[
        str, typer.Option("--host", help="Another than localhost: others can reach it.", rich_help_panel=_PAGE)
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0: any free.", rich_help_panel=_PAGE)] = 8090,
    token: Annotated[str | None, typer.Option("--token", help="What the page asks for.", rich_help_panel=_PAGE)] = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.", rich_help_panel=_PAGE)
    ] = True,
    trust: Annotated[
        bool,
        typer.Option("--trust", help="Use what a session from elsewhere names", rich_help_panel="Cameras and robot"),
    ] = False,
    json: Json = False,
    **options: Any,
) -> None:
    """A guided calibration in the browser: put the ball here, and now you can stop.

    Without cameras it shows the simulated rig. Every accepted point is on disk; run it again to go on.
    """
    from implicam.session.folder import is_session, make_folder
    from implicam.session.setup import Setup, changes_to, open_session, with_options
    from implicam.viewer.front import check_address

    must_be_folder(folder)
    if not is_session(folder):
        with_options(Setup(), **options)  # what is wrong with the words is said before anything is begun
    opencv()
    return_large_memory()
    if not unattended:
        import_extra("starlette", "viewer", "the page of implicam acquire")
        check_address(host, port)  # before a folder is made
    if not is_session(folder):
        make_folder(folder)
    log = folder / LOG
    try:
        with _ended_by_sigterm(log), log_to_file(log, command_line()):
            before = _stored(folder)
            changed = options if before is None else changes_to(folder, before, options)
            setup = with_options(before or Setup(), **changed)
            if unattended and not setup.simulated:
                raise UsageError(
                    "nothing is moved, and nobody is asked, while nobody looks.",
                    why="--unattended is for the simulated rig",
                    fix="use the page: leave --unattended out",
                )
            named = {key for key, value in options.items() if value is not None}
            wanted = None if setup == before else setup
            with open_session(folder, wanted, named=named, trust=trust, say=show.say) as controller:
                if unattended:
                    _run(controller, json)
                else:
                    from implicam.viewer import serve

                    serve(controller, host=host, port=port, token=token, open_browser=browser, say=show.say)
                _tell(controller, json)
    except KeyboardInterrupt:
        show.say(f"interrupted; what was measured is kept in {folder}: the same command goes on from there")
        raise typer.Exit(130) from None


acquire_command = command("acquire")(OptionsOfParts(_acquire, "folder", options_of_setup))


@contextmanager
def _ended_by_sigterm(log: Path) -> Iterator[None]:
    """SIGTERM, or the end of the terminal, is as Ctrl-C while the block runs, and it ends within `CLOSING_SECONDS`."""

    def cut_off() -> None:
        with suppress(OSError), log.open("a", encoding="utf-8") as file:
            file.write(f"cut off: not closed {CLOSING_SECONDS:g} s after SIGTERM\n")
        os._exit(128 + signal.SIGTERM)

    def end(number: int, frame: object) -> None:
        for again in heard:
            signal.signal(again, signal.SIG_IGN)
        late.start()
        raise KeyboardInterrupt

    late = threading.Timer(CLOSING_SECONDS, cut_off)
    late.daemon = True
    signals = [signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
    heard = [number for number in signals if signal.getsignal(number) != signal.SIG_IGN]  # nohup ignores one
    before = {number: signal.signal(number, end) for number in heard}
    try:
        yield
    finally:
        late.cancel()
        for number, handler in before.items():
            signal.signal(number, handler)


def _stored(folder: Path) -> Any:
    """The setup of the session in a folder, None where there is none."""
    from implicam.session import Session, is_session
    from implicam.session.setup import Setup

    return Setup.from_settings(Session.read_settings(folder)) if is_session(folder) else None


def _run(controller: SessionController, json: bool) -> None:
    """By itself, to the end; ImplicamError where nothing is calibrated."""
    with show.progress(json) as progress:
        controller.run(progress)
    if controller.state.problem is not None:
        raise controller.state.problem
    if controller.state.phase != "done":
        raise ImplicamError("nothing was calibrated.", why=controller.state.message, fix="run it again to go on")


def _tell(controller: SessionController, json: bool) -> None:
    from implicam.session.controller import CALIBRATION_FILE

    state, folder = controller.state, controller.session.folder
    step = state.history[-1] if state.history else None
    saved = folder / CALIBRATION_FILE
    if json:
        show.emit_json({
            "session": str(folder), "points": step.points if step else 0, "stopped": state.stop,
            "length_unit": controller.session.length_unit, "worst": step and step.worst, "usual": step and step.usual,
            "excess": step and step.excess, "skipped": len(controller.session.skipped),
            "calibration": str(saved) if saved.exists() else None,
            "report": None if state.report is None else str(state.report),
        })  # fmt: skip
        return
    show.line(f"{folder}: {state.message or 'nothing measured'}")
    if state.stop:
        show.line(f"stopped: {state.stop}")
