"""Measured points in 3D beside the truth, as the paper shows them, for print: coloured by error, sized by uncertainty.

A panel is a mapping; lengths are mm and NaN is a point that was not measured:

    title      over the panel
    true_xyz   (n, 3) where the test points are
    xyz        (n, 3) where they were measured
    sd         (n,) stated standard deviation, averaged over x, y and z; None or absent where a method states none
    known_xyz  (m, 3) the training points; may be absent

`implicam.figures.interactive3d` draws the same panels for a browser.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from implicam.dataset import Floats
from implicam.errors import import_extra
from implicam.figures.printed import PURPOSE, new_figure, plain_log
from implicam.figures.style import BLACK, BLUE, GREEN, GREY, ORANGE, SKY, VERMILLION
from implicam.formatting import number

Panel = Mapping[str, Any]


@dataclass(frozen=True)
class Scales:
    """What colour and size mean; values beyond an end are drawn as that end.

    Attributes:
        error_top: Colour runs up to this error, mm.
        sd: Size runs over this range of the standard deviation, mm.
        sizes: The diameters at the ends, in pixels of a panel 400 wide.
        error_low: Colour runs from this error on, in equal steps of its logarithm; 0 for equal steps of the error.
    """

    error_top: float
    sd: tuple[float, float]
    sizes: tuple[float, float] = (7.0, 30.0)
    error_low: float = 0.0

    def diameters(self, sd: Floats | None, n: int) -> Floats:
        """The diameters of points.

        Args:
            sd: (n,) stated standard deviations, mm; None where none is stated.
            n: How many points.

        Returns:
            (n,) pixels of a panel 400 wide; the smallest where no uncertainty is stated.
        """
        low, high = self.sd
        share = np.zeros(n) if sd is None else (np.asarray(sd, dtype=np.float64) - low) / max(high - low, 1e-300)
        return np.asarray(np.interp(np.nan_to_num(share, posinf=1.0), [0, 1], self.sizes), dtype=np.float64)


BOARD_SCALES = Scales(error_top=100.0, sd=(10.0, 100.0))
"""The paper's scales for experiment 3."""
TEST_POINT_STEP = 10
"""The paper draws one test point in so many."""
_PANEL_PX = 400
VISIBLE_RESIDUAL_SHARE = 0.1
"""Of the cloud's diagonal: residuals are made about as long, or up to ten times shorter."""
LOG_COLOURS_FROM = 10.0
"""Ratio of the panels' median errors from which colours are steps of a factor."""
COLOUR_MAP = "cividis_r"
"""Light is right, dark is wrong: truths and lines, in black, stay visible on points that are nearly right."""


@dataclass(frozen=True)
class PanelPoints:
    """The points of a panel that were measured: k of n.

    Attributes:
        true: (k, 3) true positions, mm.
        xyz: (k, 3) measured positions, mm.
        error: (k,) distances between them, mm.
        sd: (k,) stated standard deviations, mm; None where none is stated.
        missing: How many test points were not measured.
    """

    true: Floats
    xyz: Floats
    error: Floats
    sd: Floats | None
    missing: int


def select_points(panel: Panel, every: int = 1) -> PanelPoints:
    """The test points of a panel that are drawn: one of so many, without those that were not measured.

    Args:
        panel: As in the head of this module.
        every: Take one test point of so many; 1 for all.
    """
    true, xyz = (np.asarray(panel[key], dtype=np.float64).reshape(-1, 3) for key in ("true_xyz", "xyz"))
    sd = None if panel.get("sd") is None else np.asarray(panel["sd"], dtype=np.float64).ravel()[::every]
    measured = np.asarray(np.isfinite(xyz).all(axis=1))
    i, missing = measured[::every], int((~measured).sum())
    true, xyz = true[::every][i], xyz[::every][i]
    return PanelPoints(true, xyz, np.linalg.norm(xyz - true, axis=1), None if sd is None else sd[i], missing)


def scales_of(panels: Iterable[Panel]) -> Scales:
    """One scale for all panels: colour up to the 98th percentile of the errors, so that one blunder does not set it.

    Where the panels' errors differ by more than a factor of `LOG_COLOURS_FROM`, the steps of the colour are factors, or
    the better ones would all look alike.

    Args:
        panels: As in the head of this module.
    """
    found = [select_points(panel) for panel in panels]
    errors = np.concatenate([np.zeros(0), *(d.error for d in found)])
    sd = np.concatenate([np.zeros(0), *(d.sd[np.isfinite(d.sd)] for d in found if d.sd is not None)])
    low, high = np.quantile(sd, [0.02, 0.98]) if len(sd) else (0.0, 0.0)
    top = float(np.quantile(errors, 0.98)) if len(errors) else 0.0
    medians = [float(np.median(d.error)) for d in found if len(d.error) and np.median(d.error) > 0]
    factors = len(medians) > 1 and max(medians) > LOG_COLOURS_FROM * min(medians)
    bottom = float(np.quantile(errors, 0.02)) if factors else 0.0
    return Scales(top or 1.0, (float(low), float(high)), sizes=(9.0, 24.0), error_low=bottom)


def title_of(panel: Panel, found: PanelPoints | None) -> str:
    """The panel's title, and how many points are not shown because they were not measured.

    Args:
        panel: As in the head of this module.
        found: Its points; None where it is empty.
    """
    left_out = f" ({found.missing} not measured)" if found and found.missing else ""
    return f"{panel.get('title', '')}{left_out}"


def line_segments(start: Floats, end: Floats) -> Floats:
    """Separate lines as one curve with gaps.

    Args:
        start: (n, 3) where each begins.
        end: (n, 3) where each ends.

    Returns:
        (3 n, 3) start, end, NaN of each.
    """
    return np.stack([start, end, np.full(start.shape, np.nan)], axis=1).reshape(-1, 3)


def clouds(panels: Iterable[Panel], *, scales: Scales | None = None) -> Any:
    """Panels side by side, with one scale for all (the paper's Figure 7).

    Args:
        panels: As in the head of this module.
        scales: What colour and size mean; None for scales of the panels.

    Returns:
        A matplotlib Figure.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    chosen = list(panels)
    figure = new_figure(1.4 + 4.1 * max(len(chosen), 1), 4.8)
    axes = figure.subplots(1, max(len(chosen), 1), squeeze=False, subplot_kw={"projection": _projection()})[0]
    return _fill(figure, axes, chosen, scales or scales_of(chosen), width=4.1, every=1)


def board_panels(panels: Iterable[Panel], *, scales: Scales | None = BOARD_SCALES, every: int = TEST_POINT_STEP) -> Any:
    """A row of panels for each set of cameras, a column for each number of boards (the paper's Figure 11).

    Args:
        panels: As in the head of this module, with the keys `set` and `boards` besides; without a title they get these
            as title. A combination that is missing is an empty panel.
        scales: What colour and size mean: the paper's scales, or None for scales of the panels.
        every: Draw one test point of so many.

    Returns:
        A matplotlib Figure.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    cells = {(str(panel["set"]), int(panel["boards"])): panel for panel in panels}
    sets, boards = sorted({name for name, _ in cells}), sorted({count for _, count in cells})
    shape = (max(len(sets), 1), max(len(boards), 1))
    figure = new_figure(1.2 + 2.6 * shape[1], 1.0 + 2.3 * shape[0])
    axes = figure.subplots(*shape, squeeze=False, subplot_kw={"projection": _projection()})
    chosen = [_with_title(cells.get((name, count), {}), name, count) for name in sets for count in boards]
    return _fill(figure, axes.ravel(), chosen, scales or scales_of(cells.values()), width=2.6, every=every)


def draw_alignment(
    true_xyz: Floats, aligned_xyz: Floats, camera_xyz: Floats | None = None, *, camera: str = "cam2"
) -> Any:
    """Explicit calibration's points before and after alignment (the paper's Figure 4).

    Args:
        true_xyz: (n, 3) the robot's positions, mm; NaN is not drawn.
        aligned_xyz: (n, 3) explicit calibration's, moved onto them, mm.
        camera_xyz: (n, 3) the same points in the frame of `camera`, before they were moved, mm.
        camera: The name of that camera.

    Returns:
        A matplotlib Figure.

    Raises:
        MissingExtraError: Matplotlib is not installed.
    """
    figure = new_figure(6.4, 5.2)
    axes = figure.add_subplot(projection=_projection())
    look: dict[str, Any] = {"ls": "", "mew": 0.8, "ms": 3.6}
    _plot(axes, true_xyz, **{**look, "ms": 7}, marker="+", color=BLUE, label="robot's positions")
    _plot(axes, aligned_xyz, **look, marker="o", mfc="none", color=GREEN, label="explicit, aligned")
    if camera_xyz is not None:
        _plot(
            axes, camera_xyz, **look, marker="^", mfc="none", color=ORANGE, label=f"explicit, in the frame of {camera}"
        )
    lines, words = exaggerated_residuals(true_xyz, aligned_xyz)
    _plot(axes, lines, color=VERMILLION, lw=1.0, label=words)
    _style_axes(axes, bounding_box(xyz for xyz in (true_xyz, aligned_xyz, camera_xyz) if xyz is not None), size=8)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return figure


def exaggerated_residuals(true_xyz: Floats, aligned_xyz: Floats) -> tuple[Floats, str]:
    """What is left after alignment, made so many times as long that it can be seen.

    Args:
        true_xyz: (n, 3) the robot's positions, mm.
        aligned_xyz: (n, 3) the points moved onto them, mm.

    Returns:
        Lines from the positions, with gaps, (k, 3); and what they are, with the rms residual in words.
    """
    true, aligned = (np.asarray(xyz, dtype=np.float64).reshape(-1, 3) for xyz in (true_xyz, aligned_xyz))
    good = np.isfinite(true).all(axis=1) & np.isfinite(aligned).all(axis=1)
    off = (aligned - true)[good]
    rms = float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) if len(off) else 0.0
    size = float(np.linalg.norm(np.ptp(true[good], axis=0))) if len(off) else 0.0
    wanted = VISIBLE_RESIDUAL_SHARE * size / rms if rms > 0 else 1.0
    factor = max(1, int(10 ** np.floor(np.log10(max(wanted, 1.0)))))
    return line_segments(true[good], true[good] + factor * off), f"residuals, {number(rms)} mm rms, × {factor:,}"


def _projection() -> str:
    """The name under which matplotlib knows its 3D axes, once they are imported."""
    import_extra("mpl_toolkits.mplot3d", "report", PURPOSE)
    return "3d"


def _with_title(panel: Panel, name: str, boards: int) -> Panel:
    return {"title": f"{name}, {boards} boards", **panel}


def _fill(
    figure: Any, axes: Sequence[Any], panels: Sequence[Panel], scales: Scales, *, width: float, every: int
) -> Any:
    """Draw the panels, `width` inches wide each, then the scale of colours and that of sizes."""
    points_per_pixel = 72 * width / _PANEL_PX
    found = [select_points(panel, every) if "xyz" in panel else None for panel in panels]
    corners = bounding_box(
        [c for panel, d in zip(panels, found, strict=True) if d for c in points_in_view(panel, d, scales)]
    )
    shown = None
    for place, panel, points in zip(axes, panels, found, strict=False):
        place.set_title(title_of(panel, points), size=9, y=1.0)
        if points is None:
            place.set_axis_off()
            place.text2D(0.5, 0.5, "no result", ha="center", color="0.4", transform=place.transAxes)
        else:
            shown = _draw(place, known_of(panel), points, scales, points_per_pixel)
            _style_axes(place, corners, size=6 if width < 3 else 8)
    if shown is not None:
        ends = "both" if scales.error_low > 0 else "max"
        bar = figure.colorbar(shown, ax=list(axes), shrink=0.5, aspect=25, pad=0.02, extend=ends)
        if scales.error_low > 0:
            plain_log(bar.ax.yaxis, name="y")
        bar.set_label("distance from the truth (mm)")
        bar.outline.set_visible(False)
    _legend(figure, panels, scales, points_per_pixel)
    return figure


def known_of(panel: Panel) -> Floats:
    """The training points of a panel.

    Args:
        panel: As in the head of this module.

    Returns:
        (m, 3) mm; m = 0 where it has none.
    """
    known = panel.get("known_xyz")
    return np.zeros((0, 3)) if known is None else np.asarray(known, dtype=np.float64).reshape(-1, 3)


def points_in_view(panel: Panel, found: PanelPoints, scales: Scales) -> list[Floats]:
    """The points that the axes must hold: all but those measured farther off than the colours reach.

    Args:
        panel: As in the head of this module.
        found: Its points.
        scales: What colour means.

    Returns:
        Arrays (k, 3), mm.
    """
    return [known_of(panel), found.true, found.xyz[found.error <= scales.error_top]]


def bounding_box(clouds: Iterable[Floats]) -> Floats:
    """A box around all points, with a margin.

    Args:
        clouds: Arrays (k, 3); NaN is left out.

    Returns:
        (2, 3) lowest and highest corner; a unit box where there are no points.
    """
    points = np.concatenate([np.zeros((0, 3)), *(np.asarray(c, dtype=np.float64).reshape(-1, 3) for c in clouds)])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return np.array([[0.0] * 3, [1.0] * 3])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.04 * max(float((high - low).max()), 1e-9)
    return np.stack([low - margin, high + margin])


def _draw(axes: Any, known: Floats, found: PanelPoints, scales: Scales, points_per_pixel: float) -> Any:
    axes.computed_zorder = False  # truths and lines above the circles, whatever their depth
    _plot(axes, known, ls="", marker="+", ms=9 * points_per_pixel, mew=0.5, color=SKY, zorder=1)
    diameter = points_per_pixel * scales.diameters(found.sd, len(found.xyz))
    shown = axes.scatter(
        *found.xyz.T, s=diameter**2, c=found.error, cmap=COLOUR_MAP, norm=_norm(scales),
        linewidths=0.3, edgecolors=BLACK, depthshade=False, zorder=2,
    )  # fmt: skip
    _plot(axes, line_segments(found.xyz, found.true), color=BLACK, lw=0.7, zorder=3)
    _plot(axes, found.true, ls="", marker=".", ms=4.5 * points_per_pixel, mew=0, color=BLACK, zorder=4)
    return shown


def _norm(scales: Scales) -> Any:
    colours = import_extra("matplotlib.colors", "report", PURPOSE)
    if scales.error_low > 0:
        return colours.LogNorm(scales.error_low, scales.error_top, clip=True)
    return colours.Normalize(0, scales.error_top)


def _plot(axes: Any, xyz: Floats, **look: Any) -> None:
    axes.plot(*np.asarray(xyz, dtype=np.float64).reshape(-1, 3).T, **look)


def _style_axes(axes: Any, corners: Floats, *, size: float) -> None:
    """Equal lengths along all axes, pale walls, few ticks."""
    low, high = corners
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=0.95)
    axes.grid(False)
    axes.patch.set_visible(False)  # it would hide the labels of its neighbour
    ticker = import_extra("matplotlib.ticker", "report", PURPOSE)
    for axis, name, shade in zip((axes.xaxis, axes.yaxis, axes.zaxis), "xyz", (0.97, 0.95, 0.92), strict=True):
        axis.set_major_locator(ticker.MaxNLocator(3))
        axis.set_pane_color((shade, shade, shade, 1))
        axis.set_label_text(f"{name} (mm)", size=size)
        axis.set_tick_params(labelsize=size, pad=2 if name == "z" else -2)  # beside the z axis, a minus needs room
        axis.labelpad = -2 if name == "z" else -5


def _legend(figure: Any, panels: Sequence[Panel], scales: Scales, points_per_pixel: float) -> None:
    lines = import_extra("matplotlib.lines", "report", PURPOSE)

    def entry(label: str, **look: Any) -> Any:
        return lines.Line2D([], [], ls="", label=label, **look)

    entries = [
        entry("training point", marker="+", ms=6, color=SKY),
        entry("truth", marker=".", ms=4, color=BLACK),
    ]
    if any(panel.get("sd") is not None for panel in panels):
        low, high = scales.sd
        for sd in (low, (low + high) / 2, high):
            (diameter,) = points_per_pixel * scales.diameters(np.array([sd]), 1)
            entries.append(entry(f"sd {number(sd, 2)} mm", marker="o", ms=diameter, mfc="none", mew=0.7, color=GREY))
    figure.legend(handles=entries, loc="outside lower center", ncols=len(entries), frameon=False, fontsize=9)
