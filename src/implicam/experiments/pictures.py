"""All figures of the paper's experiments, for print (PDF, PNG), and those in 3D for a browser too (HTML)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from implicam.experiments.evidence import Row, rows_by_rig, where
from implicam.experiments.plan import DRAWN_METHODS, FORWARD, GP, NETWORK, PAPER, slug
from implicam.experiments.source import BALL, BOARD, CHECK
from implicam.figures.interactive3d import draw_alignment_3d, html_page, panels_3d
from implicam.figures.panels3d import BOARD_SCALES, TEST_POINT_STEP, board_panels, clouds, draw_alignment
from implicam.figures.paper import active_curves, rmse_curves, sd_against_rmse, sd_curves
from implicam.files import replacing, write_text

NOISE_FLOOR_MM = 10.0
"""sqrt(1e-4 m^2) in mm: GPyTorch's lower bound of the noise, where positions are in metres."""
METHODS_IN_PAPER_SCALES = (PAPER, NETWORK)
"""Methods whose boards are drawn in the paper's scales; in those the others are twelve times the same dot."""

Values = Mapping[str, Mapping[str, Any]]


def draw(rows: Mapping[str, Sequence[Row]], values: Values, folder: Path) -> Iterator[tuple[str, str]]:
    """Draw the figures for which there are results.

    Args:
        rows: Of each experiment, lengths in mm.
        values: Of all cells of the first rig, by name, lengths in mm.
        folder: Where to write the figures.

    Yields:
        The name of each figure, without ending, and what it shows.
    """
    if rows.get("ball"):
        yield from _ball(rows["ball"], values, folder)
    if rows.get("active"):
        each = [{**row, "repeat": f"{row.get('rig', '')}/{row['repeat']}"} for row in where(rows["active"])]
        _save(active_curves(each), folder / "active")
        yield "active", "Uncertainty against points added by active learning (Figure 8)"
    if rows.get("board"):
        yield from _boards(rows["board"], values, folder)


def _ball(rows: Sequence[Row], values: Values, folder: Path) -> Iterator[tuple[str, str]]:
    for judged, name, where_judged in (
        (BALL, "ball-error", "at the positions left out of the lattice (Figure 5)"),
        (CHECK, "ball-error-random", "the same fits, at random positions"),
    ):
        shown = [row for row in where(rows, judged=judged) if row.get("trained", BALL) == BALL]
        if shown:
            _save(rmse_curves(shown, total=_total(values)), folder / name)
            yield name, f"Error against training points, {where_judged}"
    lattice = where(rows, judged=BALL, trained=BALL)
    if not lattice:
        return
    _save(sd_curves(lattice, total=_total(values)), folder / "ball-uncertainty")
    yield "ball-uncertainty", "Average stated standard deviation against training points (Figure 6)"
    _save(sd_against_rmse(lattice, floor=NOISE_FLOOR_MM), folder / "noise-floor")
    yield "noise-floor", "Stated standard deviation against error: the paper's software cannot state less than 10 mm"
    yield from _in_3d(values, folder)


def _total(values: Values) -> int | None:
    """How many positions the lattice has: training and test points of an example."""
    for name, found in values.items():
        if name.startswith("ball/example/"):
            return len(found["known_xyz"]) + len(found["true_xyz"])
    return None


def _in_3d(values: Values, folder: Path) -> Iterator[tuple[str, str]]:
    found = {name.rpartition("/")[2]: value for name, value in values.items() if name.startswith("ball/example/")}
    panels = [
        {**found[key], "title": method, "sd": None if method == NETWORK else found[key]["sd"]}
        for method, key in ((method, slug(method)) for method in (NETWORK, PAPER, GP, FORWARD))
        if key in found
    ]
    if panels:
        caption = (
            "One run with the most training points: predictions coloured by error, sized by uncertainty (Figure 7)"
        )
        _save(clouds(panels), folder / "ball-example")
        _save_page(panels_3d(panels), folder / "ball-example", caption)
        yield "ball-example", caption
    if "ball/alignment" in values:
        cloud = values["ball/alignment"]
        parts = (cloud["true_xyz"], cloud["aligned_xyz"], cloud["camera_xyz"])
        caption = "The points of explicit calibration, before and after alignment to the robot's positions (Figure 4)"
        _save(draw_alignment(*parts, camera=str(cloud["camera"])), folder / "ball-alignment")
        _save_page(draw_alignment_3d(*parts, camera=str(cloud["camera"])), folder / "ball-alignment", caption)
        yield "ball-alignment", caption


def _boards(rows: Sequence[Row], values: Values, folder: Path) -> Iterator[tuple[str, str]]:
    first = rows_by_rig(rows)[0]
    for method in DRAWN_METHODS:
        panels = []
        for row in where(first, method=method, judged=BOARD):
            found = values[f"board/{row['set']}/{row['boards']}/{slug(method)}"]
            panels.append({**found, "set": row["set"], "boards": row["boards"]})
        if panels:
            name = f"board-{slug(method)}"
            scales = BOARD_SCALES if method in METHODS_IN_PAPER_SCALES else None
            _save(board_panels(panels, scales=scales), folder / name)
            in_scales = "the paper's scales (Figure 11)" if scales else "scales of its own"
            caption = f"The moving board, measured with {method}, in {in_scales}"
            titled = [{**panel, "title": f"{panel['set']}, {panel['boards']} boards"} for panel in panels]
            _save_page(panels_3d(titled, scales=scales, every=TEST_POINT_STEP), folder / name, caption)
            yield name, caption
    shown = [row for row in where(rows, judged=BOARD) if row.get("mean_sd") is not None]
    if shown:
        _save(sd_against_rmse(shown, floor=NOISE_FLOOR_MM), folder / "noise-floor-boards")
        yield "noise-floor-boards", "Stated standard deviation against error, with 2, 3, 5 and 9 boards to train on"


def _save(figure: Any, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    for ending in ("png", "pdf"):
        with replacing(path.with_name(f"{path.name}.{ending}")) as temporary:
            figure.savefig(temporary, format=ending, dpi=160)


def _save_page(figure: Any, path: Path, caption: str) -> None:
    write_text(path.with_name(f"{path.name}.html"), html_page(figure, title=caption))
