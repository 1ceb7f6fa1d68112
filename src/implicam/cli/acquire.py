"""`implicam suggest` and `implicam acquire`: where to measure next, once and as a guided session."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from implicam.calibrators import load_calibration
from implicam.cli import show
from implicam.cli.app import LOG, Json, Seed, command, command_line, must_not_replace
from implicam.dataset import Floats
from implicam.dataset.folder import csv_text
from implicam.errors import ImplicamError, UsageError, import_extra
from implicam.files import write_text
from implicam.formatting import decimal_number, percent
from implicam.images import opencv
from implicam.logs import log_to_file

RULES = "random, sobol, variance, excess, integrated, d-optimal"
Room = Annotated[
    str | None,
    typer.Option(
        "--workspace",
        metavar="WHERE",
        help="x0:x1,y0:y1,z0:z1, a CSV of places (x,y,z), or box or hull of the known points; suggest: or view.",
    ),
]
Rule = Annotated[str | None, typer.Option("--acquisition", metavar="NAME", help=f"{RULES}.")]
Reach = Annotated[
    float | None,
    typer.Option("--reach", metavar="LENGTH", help="A way that costs as much time as one measurement: no zigzag."),
]


@command("suggest")
def suggest_command(
    calibration: Annotated[Path, typer.Argument(help="A calibration file.")],
    count: Annotated[int, typer.Option("--count", "-n", min=1, max=200, metavar="N", help="How many targets.")] = 5,
    workspace: Room = None,
    acquisition: Rule = None,
    here: Annotated[
        str | None, typer.Option("--from", metavar="X,Y,Z", help="Where the robot is: the targets in a short order.")
    ] = None,
    reach: Reach = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="Also write a CSV of them.")
    ] = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Where to put the next known points, and what each camera will see."""
    from implicam.active import acquisition_from_name, suggest, workspace_from
    from implicam.active.acquisitions import DEFAULT_ACQUISITION

    if output is not None:
        must_not_replace(output, calibration)
    fitted = load_calibration(calibration)
    if reach is not None and not reach > 0:
        raise UsageError(f"a reach of {reach:g} is no length.", fix="give one greater than zero")
    room = None if workspace == "view" else workspace_from(workspace or "box", fitted.data.xyz)
    place = None if here is None else _place(here)
    found = suggest(
        fitted,
        room,
        count=count,
        rule=acquisition_from_name(acquisition or DEFAULT_ACQUISITION),
        here=place,
        reach=np.inf if reach is None else reach,
        seed=seed,
    )
    cameras, unit = fitted.data.observations.camera_names, fitted.data.length_unit
    if output is not None:
        write_text(output, csv_text(("point", "x", "y", "z", *_headings(cameras)), map(_cells, found.targets)))
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
    rows = [[str(i), *(f"{x:.5g}" for x in t.xyz)] for i, t in enumerate(found.targets, start=1)]
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


def _pairs(cameras: Sequence[str], uv: Floats) -> list[tuple[str, Floats]]:
    return list(zip(cameras, uv, strict=True))


def _headings(cameras: Sequence[str]) -> list[str]:
    return [f"{axis}_{name}" for name in cameras for axis in "uv"]


def _cells(target: Any) -> list[str]:
    numbers = (*target.xyz, *target.uv.ravel())
    return [target.name, *("" if np.isnan(x) else repr(float(x)) for x in numbers)]


def _pixel(uv: Floats) -> str:
    return f"{uv[0]:.0f}, {uv[1]:.0f}" if np.isfinite(uv[0]) else "-"


def _place(text: str) -> Floats:
    try:
        place = np.array([float(number) for number in text.split(",")], dtype=np.float64)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise ValueError("it takes three numbers")
    except ValueError as error:
        raise UsageError(f"{text!r} is no position.", why=str(error), fix="write --from=120,-40,300") from error
    return place


_SIMULATED, _REAL, _PLAN, _PAGE = "Without hardware", "Cameras and robot", "Where, and how long", "The page"


@command("acquire")
def acquire_command(
    folder: Annotated[Path, typer.Argument(help="The session: a new folder, or one to go on with.")],
    rig: Annotated[
        str | None,
        typer.Option("--rig", metavar="NAME", help="bar6 (default), stereo, dome8.", rich_help_panel=_SIMULATED),
    ] = None,
    rig_cameras: Annotated[
        str | None,
        typer.Option(
            "--cameras", metavar="LIST", help="Some cameras of it: 2R, cam1,cam4.", rich_help_panel=_SIMULATED
        ),
    ] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            "--camera",
            metavar="NAME=WHAT",
            help="One a camera: left=0, left=rtsp://..., left=folder/, left=genicam:SERIAL@FILE.cti.",
            rich_help_panel=_REAL,
        ),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option("--robot", metavar="WHAT", help="person (default), ur:HOST, csv:FILE.", rich_help_panel=_REAL),
    ] = None,
    trigger: Annotated[
        str | None,
        typer.Option("--trigger", metavar="WHAT", help="udp://HOST:PORT or tcp://HOST:PORT.", rich_help_panel=_REAL),
    ] = None,
    speed: Annotated[
        float | None, typer.Option("--speed", metavar="M/S", help="Of the robot.", rich_help_panel=_REAL)
    ] = None,
    sd: Annotated[
        float | None,
        typer.Option("--sd", metavar="LENGTH", help="Standard uncertainty of known positions.", rich_help_panel=_REAL),
    ] = None,
    tool: Annotated[
        str | None,
        typer.Option("--tool", metavar="X,Y,Z", help="ur: the ball's centre, from the flange.", rich_help_panel=_REAL),
    ] = None,
    dry_run: Annotated[
        bool | None,
        typer.Option("--dry-run/--no-dry-run", help="ur: say where it would go; move nothing.", rich_help_panel=_REAL),
    ] = None,
    radius: Annotated[
        float | None,
        typer.Option("--radius", metavar="LENGTH", help="Of the ball, to correct its outline.", rich_help_panel=_REAL),
    ] = None,
    bright: Annotated[
        bool | None,
        typer.Option("--bright/--dark", help="The ball is lighter than what is behind.", rich_help_panel=_REAL),
    ] = None,
    unit: Annotated[
        str | None, typer.Option("--unit", metavar="UNIT", help="Of lengths (default mm).", rich_help_panel=_REAL)
    ] = None,
    workspace: Annotated[
        str | None,
        typer.Option(
            "--workspace",
            metavar="WHERE",
            help="x0:x1,y0:y1,z0:z1 or a CSV of places (x,y,z): where the ball can be.",
            rich_help_panel=_PLAN,
        ),
    ] = None,
    below: Annotated[
        float | None,
        typer.Option(
            "--below", metavar="LENGTH", help="Stop at this 95 % uncertainty, everywhere.", rich_help_panel=_PLAN
        ),
    ] = None,
    within: Annotated[
        float | None,
        typer.Option(
            "--within",
            metavar="TIMES",
            help="Or at so many times what pixel noise leaves (default 1.2).",
            rich_help_panel=_PLAN,
        ),
    ] = None,
    budget: Annotated[
        int | None,
        typer.Option("--budget", min=1, metavar="N", help="Or after N points (default 60).", rich_help_panel=_PLAN),
    ] = None,
    acquisition: Annotated[
        str | None, typer.Option("--acquisition", metavar="NAME", help=f"{RULES}.", rich_help_panel=_PLAN)
    ] = None,
    reach: Annotated[
        float | None,
        typer.Option("--reach", metavar="LENGTH", help="A way that costs as much as one point.", rich_help_panel=_PLAN),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            "--method", metavar="NAME", help="forward-gp (default), inverse-gp, explicit.", rich_help_panel=_PLAN
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, metavar="N", help="Rig and choices.", rich_help_panel=_PLAN)
    ] = None,
    unattended: Annotated[
        bool,
        typer.Option("--unattended", help="No page: the simulated rig by itself.", rich_help_panel=_PAGE),
    ] = False,
    host: Annotated[
        str, typer.Option("--host", help="Another than localhost asks for a token.", rich_help_panel=_PAGE)
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0: any free.", rich_help_panel=_PAGE)] = 8090,
    token: Annotated[str | None, typer.Option("--token", help="What the page asks for.", rich_help_panel=_PAGE)] = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.", rich_help_panel=_PAGE)
    ] = True,
    json: Json = False,
) -> None:
    """A guided calibration in the browser: put the ball here, and now you can stop.

    Without cameras it shows the simulated rig. Every accepted point is on disk; run it again to go on.
    """
    from implicam.session.setup import Setup, changed, open_session

    given = {
        "rig": rig, "rig_cameras": rig_cameras, "cameras": _cameras(camera), "robot": robot, "trigger": trigger,
        "speed": speed, "sd": sd, "dry_run": dry_run, "radius": radius, "bright": bright, "unit": unit,
        "workspace": workspace, "below": below, "within": within, "budget": budget, "acquisition": acquisition,
        "reach": reach, "method": method, "seed": seed, "tool": None if tool is None else tuple(_place(tool)),
    }  # fmt: skip
    before = _stored(folder)
    setup = changed(before or Setup(), **given)
    if unattended and not setup.simulated:
        raise UsageError(
            "nothing is moved, and nobody is asked, while nobody looks.",
            why="--unattended is for the simulated rig",
            fix="use the page: leave --unattended out",
        )
    opencv()  # what is missing is said before anything is begun
    if not unattended:
        import_extra("viser", "viewer", "the page of implicam acquire")
    with (
        open_session(folder, None if setup == before else setup, say=show.say) as controller,
        log_to_file(folder / LOG, command_line()),
    ):
        if not unattended:
            from implicam.viewer import serve

            serve(controller, host=host, port=port, token=token, open_browser=browser, say=show.say)
        else:
            with show.progress(json) as progress:
                controller.run(progress)
            if controller.state.problem is not None:
                raise controller.state.problem
            if controller.state.phase != "done":
                raise ImplicamError(
                    "nothing was calibrated.", why=controller.state.message, fix="run it again to go on"
                )
        _tell(controller, json)


def _stored(folder: Path) -> Any:
    """The setup of the session in a folder, None where there is none."""
    from implicam.session import Session, is_session
    from implicam.session.setup import Setup

    if not is_session(folder):
        return None
    with Session.open(folder) as session:
        return Setup.from_settings(session.settings)


def _cameras(words: list[str] | None) -> tuple[tuple[str, str], ...] | None:
    if not words:
        return None
    pairs = [word.partition("=") for word in words]
    for name, equals, what in pairs:
        if not (name and equals and what):
            raise UsageError(f"--camera {name}{equals}{what} names no camera.", fix="write --camera left=0")
    return tuple((name, what) for name, _, what in pairs)


def _tell(controller: Any, json: bool) -> None:
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
