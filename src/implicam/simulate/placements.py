"""Where cameras stand and what lenses they have, as drawn: the bars, grids and domes that have names.

A placement is drawn on a bench, in millimetres. Of those with a name the working volume's centre is the origin, x runs
along the bar to the right, y down, z away from the cameras. `rig_file` reads others.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from implicam.dataset import Floats
from implicam.errors import UsageError, did_you_mean
from implicam.geometry import Pose, look_at
from implicam.lenses import BrownConrady, KannalaBrandt, Lens

BAR_FOCAL_MM = (1.55, 2.8, 2.8, 1.85, 2.2, 1.3)
"""The paper's effective focal lengths of cam1 ... cam6."""
BAR_X_MM = (-300.0, -75.0, 75.0, -180.0, 180.0, 300.0)
"""Where cam1 ... cam6 sit on the bar: the two regular lenses in the middle. Our assumption; the paper does not say."""
PIXEL_MM = 0.003
"""Pixel pitch of the bar's cameras. Our assumption; the paper does not say."""
BAR_DISTANCE_MM = 380.0
"""From the bar, or the plane of a grid, to the middle of the working volume."""
GRID_HALF_WIDTH_MM, GRID_HALF_HEIGHT_MM = 300.0, 200.0
"""Of a grid of cameras: as wide as the bar."""
MAX_GRID_ASPECT_RATIO = 2.0
"""Columns over rows of a grid of N cameras, beyond which its rows are rather not all full."""
PERSPECTIVE_FROM_PX = 850.0
"""Shorter lenses are wide: Kannala-Brandt, not Brown-Conrady."""
PERSPECTIVE_DISTORTION, WIDE_DISTORTION = (-0.08, 0.02, 0.0, 0.0), (-0.01, 0.0, 0.0, 0.0)
"""k1, k2, p1, p2 and k1 ... k4 of the two kinds of lenses, as drawn."""

SPECS = ("bar6", "grid9", "stereo", "dome8")
MAX_CAMERAS = 999


@dataclass(frozen=True, eq=False)
class Mount:
    """One camera as drawn.

    Attributes:
        name: Of the camera.
        width, height: Of its pictures, in pixels.
        lens: Its lens.
        camera_from_bench: Its pose; lengths in mm.
        noise: Standard deviation of a view in pixels; None for that of the rig.
    """

    name: str
    width: int
    height: int
    lens: Lens
    camera_from_bench: Pose
    noise: float | None = None


@dataclass(frozen=True, eq=False)
class Placement:
    """Cameras as drawn, and the box that they watch.

    Attributes:
        name: Of the rig.
        mounts: The cameras.
        size: (3,) of the box, along x, y and z of the bench, mm; None where nothing says what they watch.
        centre: (3,) of the box on the bench, mm.
        spread: How much rigs that are built differ from the drawing: 0 not at all, 1 as usual.
        length_unit: The drawing's own.
        own_panes: A window is a pane before each camera, and not one for all.
        drawn: Its frame is one that somebody chose.
    """

    name: str
    mounts: tuple[Mount, ...]
    size: Floats | None
    centre: Floats
    spread: float = 1.0
    length_unit: str = "mm"
    own_panes: bool = False
    drawn: bool = False


def named_placement(spec: str) -> Placement:
    """The placement that a name means.

    Args:
        spec: "stereo", "bar<N>", "grid<N>", "grid<COLUMNS>x<ROWS>" or "dome<N>".

    Raises:
        UsageError: There is no such rig.
    """
    if spec == "stereo":
        return _aimed(spec, [(x, 0.0, -700.0) for x in (-120.0, 120.0)], [1200.0], (1280, 1024), (300, 240, 240))
    found = re.fullmatch(r"(?:(bar|grid|dome)([1-9][0-9]{0,2})|grid([1-9][0-9]?)x([1-9][0-9]?))", spec)
    if found and found[3] and 2 <= int(found[3]) * int(found[4]) <= MAX_CAMERAS:
        return _grid(spec, [int(found[3])] * int(found[4]))
    if not found or found[3] or int(found[2]) < 2:
        raise UsageError(
            f"there is no rig {spec!r}{did_you_mean(spec, SPECS)}.",
            why=f"a rig is stereo, bar<N>, grid<N>, grid<COLUMNS>x<ROWS> or dome<N>, with 2 to {MAX_CAMERAS} cameras",
            fix=f"use one of {', '.join(SPECS)}, for example dome12, or your own drawing: RIG.toml (docs/design.md)",
        )
    n = int(found[2])
    if found[1] == "grid":
        return _grid(spec, grid_rows(n))
    return _dome(spec, n) if found[1] == "dome" else _bar(spec, n)


def grid_rows(n: int) -> list[int]:
    """How many cameras each row of a grid has: all the same where that makes no long stripe.

    Args:
        n: Cameras of the grid.

    Returns:
        The number in each row, the upper row first.
    """
    for rows in range(int(np.sqrt(n)), 0, -1):
        if n % rows == 0 and n // rows <= MAX_GRID_ASPECT_RATIO * rows:
            return [n // rows] * rows
    columns = int(np.ceil(np.sqrt(n)))
    rows = -(-n // columns)
    return [n // rows + (row < n % rows) for row in range(rows)]


def _bar(name: str, n: int) -> Placement:
    places = BAR_X_MM if n == len(BAR_X_MM) else np.linspace(-300, 300, n)
    return _before(name, [(float(x), 0.0, -BAR_DISTANCE_MM) for x in places])


def _grid(name: str, rows: Sequence[int]) -> Placement:
    """Rows of cameras in a plane, the upper one first."""
    heights = np.linspace(-GRID_HALF_HEIGHT_MM, GRID_HALF_HEIGHT_MM, len(rows)) if len(rows) > 1 else np.zeros(1)
    places = []
    for columns, y in zip(rows, heights, strict=True):
        along = np.linspace(-GRID_HALF_WIDTH_MM, GRID_HALF_WIDTH_MM, columns) if columns > 1 else np.zeros(1)
        places += [(float(x), float(y), -BAR_DISTANCE_MM) for x in along]
    return _before(name, places)


def _before(name: str, places: Sequence[ArrayLike]) -> Placement:
    """Cameras of the paper's kinds before the paper's volume."""
    return _aimed(name, places, [focal / PIXEL_MM for focal in BAR_FOCAL_MM], (1280, 800), (240, 160, 240))


def _dome(name: str, n: int) -> Placement:
    """Cameras all round at one metre, in turn low and high above the bench."""
    places = []
    for i in range(n):
        around, up = 2 * np.pi * i / n, np.radians((25.0, 55.0)[i % 2])
        places.append(1000 * np.array([np.sin(around) * np.cos(up), -np.sin(up), -np.cos(around) * np.cos(up)]))
    return _aimed(name, places, [1200.0], (1280, 1024), (400, 400, 400), own_panes=True)


def _aimed(
    name: str,
    places: Sequence[ArrayLike],
    focals: Sequence[float],
    image: tuple[int, int],
    size: tuple[float, float, float],
    *,
    own_panes: bool = False,
) -> Placement:
    """Cameras that look at the origin, with the focal lengths (px) in turn."""
    mounts = []
    for i, place in enumerate(places):
        pose = look_at(place, (0.0, 0.0, 0.0), up=(0.0, -1.0, 0.0))
        mounts.append(Mount(f"cam{i + 1}", *image, drawn_lens(focals[i % len(focals)], image), pose))
    return Placement(name, tuple(mounts), np.array(size, dtype=np.float64), np.zeros(3), own_panes=own_panes)


def drawn_lens(focal: float, image: tuple[int, int]) -> Lens:
    """A lens over the middle of the image, with the usual distortion of its kind.

    Args:
        focal: Focal length in pixels.
        image: Width and height in pixels.
    """
    cx, cy = (image[0] - 1) / 2, (image[1] - 1) / 2
    if focal < PERSPECTIVE_FROM_PX:
        return KannalaBrandt(focal, focal, cx, cy, *WIDE_DISTORTION)
    return BrownConrady(focal, focal, cx, cy, *PERSPECTIVE_DISTORTION)
