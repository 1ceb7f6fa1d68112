"""The page of a design: one HTML file that works offline, with the rigs and the uncertainty in 3D, and slices."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from implicam.dataset import Floats
from implicam.design.designs import Design
from implicam.design.prediction import Prediction
from implicam.figures.interactive3d import POLICY, figure_json, plotly_js
from implicam.figures.placement_figure import SLICE_AXES, UncertaintyScale, placement_scene, uncertainty_slices
from implicam.files import write_text
from implicam.formatting import number, percent
from implicam.simulate.camera import SimulatedCamera
from implicam.templates import Markup, render

SLICE_STEPS = 33
"""Places along each side of a slice."""
VIEW_DEPTH_RATIO = 0.25
"""How far the drawing of a camera's view reaches, as a part of its distance from the workspace."""
COLUMNS = ("median", "95 %", "worst")
COLOUR_QUANTILE = 0.98
"""The top of the colours, so that one corner does not paint all others alike."""


def write_page(path: Path, designs: Sequence[Design]) -> None:
    """Write the page of one or several designs (about 5 MB, nearly all of it plotly.js).

    Args:
        path: Of the HTML file.
        designs: Side by side, with the same workspace and unit.

    Raises:
        MissingExtraError: Without Plotly or Jinja2.
    """
    write_text(path, page(designs))


def page(designs: Sequence[Design]) -> str:
    """The page as HTML text.

    Args:
        designs: Side by side, with the same workspace and unit.
    """
    scale = _scale([design.prediction for design in designs])
    first = designs[0].prediction
    return render(
        __package__,
        "design.html",
        policy=POLICY,
        plotly_js=plotly_js("the page of a design"),
        css=Markup(render("implicam.report", "page.css")),
        js=Markup(render("implicam.report", "page.js")),
        title=" and ".join(design.name for design in designs),
        facts=_facts(designs),
        headline=_headline(designs),
        unit=first.rig.length_unit,
        designs=[_as_shown(design, scale) for design in designs],
        spreads=_spread_rows(designs),
        headings=["", *(f"{d.name}: {what}" if len(designs) > 1 else what for d in designs for what in COLUMNS)],
    )


def _facts(designs: Sequence[Design]) -> list[tuple[str, str]]:
    first = designs[0].prediction
    assumed, unit = first.assumed, first.rig.length_unit
    exact = f"known to {number(assumed.position_sd)} {unit}" if assumed.position_sd else "known exactly"
    return [
        ("known points", f"{len(first.known)}, {exact}"),
        ("pixel noise", f"{number(assumed.noise)} px"),
        ("errors of lenses", f"{number(assumed.lens_error)} px rms"),
        ("workspace", f"{designs[0].workspace.name} {unit}"),
    ]


def _headline(designs: Sequence[Design]) -> str:
    unit = designs[0].prediction.rig.length_unit
    parts = []
    for design in designs:
        (usual,) = (spread.usual for spread in design.spreads if spread.name == "95 % uncertainty")
        blind = design.prediction.blind
        if not np.isfinite(usual):
            parts.append(f"{design.name}: nothing of the workspace can be measured.")
            continue
        dark = f", and {percent(blind)} of it is blind" if blind else ""
        parts.append(f"{design.name}: 95 % uncertainty below {number(usual)} {unit} in 95 % of the workspace{dark}.")
    return " ".join(parts)


def _spread_rows(designs: Sequence[Design]) -> Iterator[list[str]]:
    for spreads in zip(*(design.spreads for design in designs), strict=True):
        cells = [f"{spreads[0].name} ({spreads[0].unit})" if spreads[0].unit else spreads[0].name]
        for each in spreads:
            values = (each.median, each.usual, each.worst)
            cells += [number(value) if each.unit else percent(value) for value in values]
        yield cells


def _as_shown(design: Design, scale: UncertaintyScale) -> dict[str, Any]:
    found = design.prediction
    parts = sorted(design.parts, key=lambda part: -part.lost)
    rows = [[p.name, str(p.known_seen), percent(p.part_seen), percent(p.lost, 1), percent(p.blind)] for p in parts]
    checked = [[axis, *(number(value) for value in values)] for axis, *values in design.check_rows()]
    return {
        "name": design.name,
        "cameras": len(found.rig.cameras),
        "uncalibrated": ", ".join(found.uncalibrated),
        "scene": figure_json(_scene(design, scale)),
        "slices": figure_json(_slices(design, scale)),
        "parts": rows,
        "checked": checked,
        "rigs": 0 if design.realised is None else len(design.realised.errors),
    }


def _scale(predictions: Sequence[Prediction]) -> UncertaintyScale:
    values = np.concatenate([one.predicted.u95 for one in predictions])
    values = values[np.isfinite(values)]
    unit = predictions[0].rig.length_unit
    if not len(values):
        return UncertaintyScale(0.0, 1.0, unit)
    return UncertaintyScale(float(values.min()), float(np.quantile(values, COLOUR_QUANTILE)), unit)


def _scene(design: Design, scale: UncertaintyScale) -> Any:
    found = design.prediction
    low, high = _ends(design)
    return placement_scene(
        found.places,
        found.predicted.u95,
        cameras={camera.name: _view_pyramid(camera, (low + high) / 2) for camera in found.rig.cameras},
        known_xyz=found.known,
        corners=np.array(list(product(*zip(low, high, strict=True)))),
        up=_up(found),
        scale=scale,
    )


def _up(prediction: Prediction) -> Floats:
    """(3,) the axis of the drawing that is up in most pictures, with its sign."""
    up = np.mean([-camera.camera_from_world.rotation[1] for camera in prediction.rig.cameras], axis=0)
    axis = np.zeros(3)
    strongest = int(np.argmax(np.abs(up)))
    axis[strongest] = 1.0 if up[strongest] >= 0 else -1.0
    return axis


def _ends(design: Design) -> tuple[Floats, Floats]:
    vertices = design.workspace.vertices
    return vertices.min(axis=0), vertices.max(axis=0)


def _view_pyramid(camera: SimulatedCamera, middle: Floats) -> Floats:
    """(5, 3) the centre of a camera, and the corners of its picture some way towards the workspace."""
    centre = camera.camera_from_world.centre
    depth = VIEW_DEPTH_RATIO * float(np.linalg.norm(middle - centre))
    w, h = camera.width - 1, camera.height - 1
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=np.float64)
    rays, valid = camera.ray_from_pixel(corners)
    if not valid.all() or (rays[:, 2] <= 0).any():  # a fisheye's corners see nothing, or behind: show what is before it
        rays = np.array([[-1, -1, 0.5], [1, -1, 0.5], [1, 1, 0.5], [-1, 1, 0.5]]) / 1.5
    return np.vstack([centre, centre + depth * rays @ camera.camera_from_world.rotation])


def _slices(design: Design, scale: UncertaintyScale) -> Any:
    low, high = _ends(design)
    middle = (low + high) / 2
    ends = tuple(np.linspace(a, b, SLICE_STEPS) for a, b in zip(low, high, strict=True))
    planes = []
    for across, upward, _ in SLICE_AXES:
        x, y = np.meshgrid(ends[across], ends[upward])
        xyz = np.tile(middle, (x.size, 1))
        xyz[:, across], xyz[:, upward] = x.ravel(), y.ravel()
        u95 = design.prediction.at(xyz).u95
        planes.append(np.where(design.workspace.inside(xyz), u95, np.nan).reshape(x.shape))
    return uncertainty_slices(
        (ends[0], ends[1], ends[2]), (planes[0], planes[1], planes[2]), middle, _up(design.prediction), scale
    )
