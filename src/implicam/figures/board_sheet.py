"""A board to print, in its true size, with bars that show whether the printer kept it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset import Floats
from implicam.detect.prints import Print, Printable, moved, printed
from implicam.errors import UsageError
from implicam.figures.printed import new_figure
from implicam.files import replacing

PAPERS_MM = {
    "a4": (210.0, 297.0), "a3": (297.0, 420.0), "a2": (420.0, 594.0), "a1": (594.0, 841.0), "a0": (841.0, 1189.0),
    "letter": (215.9, 279.4), "tabloid": (279.4, 431.8),
}  # fmt: skip
"""Name -> width and height, upright."""

RIM_MM = 8.0
"""At the paper's edge, where printers leave out what is there."""

FOOT_MM, SIDE_MM = 24.0, 9.0
"""Below the board for the bar and the words, and left of it for the upright bar."""

BARS_MM = (200.0, 150.0, 100.0, 50.0, 20.0)
"""Lengths of bars: the longest that has room is drawn."""

MM_PER_INCH = 25.4


def draw_board(board: Printable, paper: str, path: Path) -> tuple[float, float]:
    """Draw a board whose lengths are millimetres.

    Args:
        board: What is to be printed.
        paper: A name in `PAPERS_MM`; it is turned where the board fits better so.
        path: Where to; .pdf, .svg or .png by its ending.

    Returns:
        Lengths in millimetres of the bar below the board and of the one beside it.

    Raises:
        UsageError: There is no such paper, or the board is larger than it.
        MissingExtraError: Matplotlib or OpenCV is not installed.
    """
    if paper.lower() not in PAPERS_MM:
        raise UsageError(f"there is no paper {paper!r}.", fix=f"use one of {', '.join(PAPERS_MM)}")
    sheet = printed(board)
    upright = np.array(PAPERS_MM[paper.lower()])
    needed = sheet.size + 2 * sheet.white + 2 * RIM_MM + [SIDE_MM, FOOT_MM]
    fitting = [page for page in (upright, upright[::-1]) if (needed <= page).all()]
    if not fitting:
        part = max(float(np.min((page - (needed - sheet.size)) / sheet.size)) for page in (upright, upright[::-1]))
        smaller = f", or make it {np.floor(100 * part):.0f} % as large" if part > 0.05 else ""
        raise UsageError(
            f"the board of {sheet.size[0]:g} x {sheet.size[1]:g} mm does not fit on {paper}.",
            why=f"with its white margin, the bars and the printer's rim it needs {needed[0]:.0f} x {needed[1]:.0f} mm",
            fix=f"choose a larger --paper{smaller}",
        )
    return _draw(sheet, fitting[0], path)


def _draw(sheet: Print, page: Floats, path: Path) -> tuple[float, float]:
    from matplotlib import rc_context
    from matplotlib.patches import Circle, PathPatch

    figure = new_figure(*(page / MM_PER_INCH))
    figure.set_layout_engine("none")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, page[0]), ylim=(page[1], 0))
    axes.axis("off")
    room = page - [SIDE_MM, FOOT_MM]
    corner = [SIDE_MM, 0] + (room - sheet.size) / 2
    # one outline for all that is black: between shapes of their own, viewers draw hairlines
    axes.add_patch(PathPatch(_outline(moved(sheet.black, corner)), facecolor="black", edgecolor="none", lw=0))
    for u, v, radius in sheet.discs:
        axes.add_patch(Circle((u + corner[0], v + corner[1]), radius, facecolor="black", edgecolor="none", lw=0))
    across = _longest(page[0] - 2 * RIM_MM - 4)
    along = _longest(page[1] - FOOT_MM - 2 * RIM_MM)
    below = page[1] - FOOT_MM + 7
    left = (page[0] - across) / 2
    _bar(axes, (left, below), (left + across, below), f"{across:g} mm")
    top = (page[1] - FOOT_MM - along) / 2 + RIM_MM / 2
    _bar(axes, (RIM_MM, top), (RIM_MM, top + along), f"{along:g} mm")
    told = (
        sheet.words[0],
        'Print in true size ("100 %"), then measure both bars: where one is not as long as it says, scale the lengths '
        "below alike.",
        f"implicam detect FOLDER {sheet.words[1]}",
    )
    for artist in (*axes.patches, *axes.lines):
        artist.set_snap(False)  # of a .png: edges where they are, in grey, and not on the next whole pixel
    size = min(7.0, 1.75 * (page[0] - 2 * RIM_MM) / max(map(len, told)) * 72 / MM_PER_INCH)
    for k, line in enumerate(told):
        font = "monospace" if k == 2 else "sans-serif"
        axes.text(page[0] / 2, below + 4.5 + 3.4 * k, line, ha="center", va="center", size=size, family=font)
    with rc_context({"svg.hashsalt": "implicam"}), replacing(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:].lower(), dpi=300, metadata=_undated(path))
    return across, along


def _outline(black: Floats) -> Any:
    from matplotlib.path import Path as Outline

    x, y, w, h = black.T
    corners = np.stack([(x, y), (x + w, y), (x + w, y + h), (x, y + h), (x, y)], axis=1).transpose(2, 1, 0)
    codes = [Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY]
    return Outline(corners.reshape(-1, 2), codes * len(black))


def _bar(axes: Any, start: tuple[float, float], end: tuple[float, float], text: str) -> None:
    """A line with ticks across it at both ends; it is as long as from the middle of one tick to that of the other."""
    across = start[1] == end[1]
    axes.plot(*zip(start, end, strict=True), color="black", lw=0.6, solid_capstyle="butt")
    for u, v in (start, end):
        ends = ([u, u], [v - 1.5, v + 1.5]) if across else ([u - 1.5, u + 1.5], [v, v])
        axes.plot(*ends, color="black", lw=0.6, solid_capstyle="butt")
    middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
    at = (middle[0], middle[1] - 2) if across else (middle[0] + 2, middle[1])
    axes.text(*at, text, ha="center", va="center", size=7, rotation=0 if across else 90)


def _longest(room: float) -> float:
    return next((length for length in BARS_MM if length <= room), BARS_MM[-1])


def _undated(path: Path) -> dict[str, Any] | None:
    """The same board is the same file: without the date of its making."""
    return {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(path.suffix.lower())
