"""`implicam simulate`: a rig with known truth, what it is shown, and a dataset of it."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from implicam.cli import show
from implicam.cli.app import Json, Seed, command, must_be_folder
from implicam.dataset import Dataset, folder_files, write_dataset
from implicam.dataset.folder import csv_text, format_cells
from implicam.errors import UsageError
from implicam.files import toml_text
from implicam.simulate import (
    Optics,
    Rig,
    Unusual,
    as_boards,
    as_wand,
    ball_grid,
    build_rig,
    each_and_pairs,
    held_boards,
    moving_board,
    random_positions,
    record,
    simulate,
    step_gauge,
    waved_wand,
    write_rig,
)
from implicam.simulate import Target as Shown

GAUGE_U = 5e-6
"""Expanded uncertainty (k = 2) of a step gauge, over its length."""


class Target(StrEnum):
    """What the simulated rig is shown."""

    ball = "ball"
    board = "board"
    boards = "boards"
    wand = "wand"


class Positions(StrEnum):
    """Where the ball goes."""

    grid = "grid"
    random = "random"


class Frame(StrEnum):
    """The world frame of a simulated rig."""

    robot = "robot"
    random = "random"
    bench = "bench"


@command("simulate")
def simulate_command(
    out: Annotated[Path, typer.Argument(help="Folder to write the dataset to.")],
    rig: Annotated[
        str, typer.Option(metavar="NAME", help="bar6 (the paper's), grid9, dome8, any barN, gridAxB ..., or RIG.toml.")
    ] = "bar6",
    target: Annotated[
        Target, typer.Option(help="A ball on a robot, a board on a slide, boards held by hand, a waved wand.")
    ] = Target.ball,
    positions: Annotated[Positions, typer.Option(help="Where the ball goes.")] = Positions.grid,
    points: Annotated[int, typer.Option(min=1, metavar="N", help="How many random positions.")] = 157,
    grid: Annotated[str, typer.Option(metavar="AxBxC", help="Positions of the grid along, down and away.")] = "5x5x7",
    boards: Annotated[int, typer.Option(min=1, metavar="N", help="How many positions of the board.")] = 20,
    each: Annotated[int, typer.Option(min=0, metavar="N", help="boards: pictures by every camera alone.")] = 10,
    pairs: Annotated[int, typer.Option(min=0, metavar="N", help="boards: pictures by every two neighbours.")] = 4,
    frames: Annotated[int, typer.Option(min=1, metavar="N", help="wand: in how many frames it is seen.")] = 200,
    wand: Annotated[
        float | None, typer.Option(min=0, metavar="LENGTH", help="Its length; 0.6 of the volume's shortest edge.")
    ] = None,
    check: Annotated[
        int,
        typer.Option(
            min=0,
            metavar="N",
            help="Also write so many random positions to OUT/check, and a step gauge to OUT/lengths.",
        ),
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
    tilt: Annotated[
        float, typer.Option(metavar="DEG", help="Sensors tilted, each its own way (Scheimpflug), up to 30.")
    ] = 0.0,
    mirror: Annotated[
        str, typer.Option(metavar="LIST", help="Cameras that look into a mirror, or all: v from below.")
    ] = "",
    aspect: Annotated[
        float, typer.Option(metavar="RATIO", help="fy / fx: the pictures resized in height, 0.2 to 5.")
    ] = 1.0,
    window: Annotated[
        float, typer.Option(metavar="MM", help="Thickness of a flat window, water behind it; 0 for none.")
    ] = 0.0,
    images: Annotated[bool, typer.Option("--images", help="Also take photographs, for implicam detect.")] = False,
    image_noise: Annotated[
        float, typer.Option(min=0, max=0.5, metavar="PART", help="Noise of the photographs, part of full scale.")
    ] = 0.01,
    image_blur: Annotated[
        float, typer.Option(min=0, max=10, metavar="PX", help="Blur of the photographs, standard deviation.")
    ] = 0.7,
    frame: Annotated[
        Frame | None, typer.Option(help="World: axes along the bench (of names), any, as drawn (of RIG.toml).")
    ] = None,
    unit: Annotated[str | None, typer.Option(metavar="UNIT", help="mm (of rigs with names), or m.")] = None,
    seed: Seed = 0,
    shots_seed: Annotated[
        int | None, typer.Option(min=0, metavar="N", help="Record the same rig again with other noise.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it exists.")] = False,
    json: Json = False,
) -> None:
    """Write a dataset of a simulated rig, with the truth and the Cramer-Rao limit of every point beside it."""
    must_be_folder(out)
    if unit not in ("mm", "m", None):
        raise UsageError(f"a simulated rig has no unit {unit!r}.", fix="choose mm or m")
    built = build_rig(
        rig, seed=seed, lens_error=lens_error, noise=noise, frame=frame and frame.value, unit=unit,  # type: ignore[arg-type]
        cameras=cameras, unusual=Unusual(tilt, mirror, aspect, window),
    )  # fmt: skip
    shots = seed if shots_seed is None else shots_seed
    rng = np.random.default_rng([shots, _SEEDS.get(target, 1)])
    if target is Target.board:
        shown = moving_board(built, positions=boards)
    elif target is Target.boards:
        shown = held_boards(built, each_and_pairs(built, each, pairs), rng)
    elif target is Target.wand:
        shown = waved_wand(built, frames, rng, length=wand)
    else:
        shown = ball_grid(built, _grid(grid)) if positions is Positions.grid else random_positions(built, points, rng)
    optics = Optics(noise=image_noise, blur=image_blur) if images else None
    files = {"truth.toml": toml_text({**write_rig(built), "shots_seed": shots})}
    with show.progress(json) as progress:
        recorded = record(
            built, shown, seed=shots, robot_noise=robot_noise, missing=missing, outliers=outliers, optics=optics
        )
        recorded = replace(recorded, data=_as_seen(recorded.data, shown, target))
        parts = {"": recorded}
        if check:
            target_points = random_positions(built, check, np.random.default_rng([shots, 2]))
            parts["check"] = record(built, target_points, seed=shots + 1_000_003, missing=missing, optics=optics)
            files |= {f"check/{name}": text for name, text in folder_files(parts["check"].data).items()}
            files |= {f"lengths/{name}": text for name, text in _lengths(built, shots).items()}

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
        show.line(f"{out / 'lengths'}: a step gauge on seven lines, for implicam verify")


_SEEDS = {Target.boards: 9, Target.wand: 11}
"""Of what is shown at random, beside the number of the shots."""


def _as_seen(data: Dataset, shown: Shown, target: Target) -> Dataset:
    """Without the positions that nobody knows: where a hand held a board or a wand."""
    if target is Target.boards:
        return as_boards(data, shown)
    return as_wand(data, shown) if target is Target.wand else data


def _lengths(rig: Rig, seed: int) -> dict[str, str]:
    """The files of a dataset that shows a step gauge, whose positions are not known, and of its certificate."""
    gauge, lengths = step_gauge(rig)
    data = replace(simulate(rig, gauge, seed=seed + 2_000_003), known=None)
    expanded = GAUGE_U * max(one.length for one in lengths)
    scale = 1 + np.random.default_rng([seed, 3]).normal(0, GAUGE_U / 2)
    rows = [[one.line, one.a, one.b, *format_cells(np.array([one.length * scale, expanded]))] for one in lengths]
    return {**folder_files(data), "lengths.csv": csv_text(("line", "a", "b", "length", "U"), rows)}


def _grid(text: str) -> tuple[int, int, int]:
    try:
        a, b, c = (int(part) for part in text.lower().split("x"))
        if min(a, b, c) < 1:
            raise ValueError(text)
    except ValueError:
        raise UsageError(f"--grid {text!r} is not a grid.", fix="write three numbers, for example 5x5x7") from None
    return a, b, c
