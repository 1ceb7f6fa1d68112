"""What a calibration looks like in three dimensions, as tables for a page: cameras, known points, uncertainty, points.

Everything is in the world and the length unit of the calibration; the page only turns and scales it (`Placing`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from implicam.calibrators import Calibration, RigCalibration
from implicam.dataset import Floats
from implicam.dataset.image_bounds import image_bounds
from implicam.formatting import json_safe, list_some
from implicam.measurement import Measurement
from implicam.report.instrument import Instrument
from implicam.rig_model import SOURCES, FittedRig
from implicam.viewer.space import Placing, upwards

ROWS, COLUMNS = 9, 12
"""Cells of a picture: it is bent as the lens bends it, so that points lie on their images from where the camera is."""

PICTURE_SIZE = 0.15
"""Of a picture beside the box of the points."""
MISFIT_ROUNDS, MAX_MISFIT = 3, 0.05
"""Steps to the direction that the field about the lens asks for; part of the picture that it may be off, at most."""
NEAREST_PICTURE = 0.45
"""Part of the way to the points at which a picture stands, at most."""
FARTHEST = 2.0
"""Times the size of the box: of a camera farther off the picture is drawn at this distance, and its centre is not."""


def scene(calibration: Calibration) -> dict[str, Any]:
    """What stands still: the box of the known points, the cameras, the points.

    Args:
        calibration: By any method; one without cameras has none to show.
    """
    known = calibration.data.xyz
    cameras = list_cameras(calibration)
    low, high = _box(known, cameras)
    rejected = {view.point for view in calibration.rejected}
    unused = {entry.point for entry in calibration.unused}
    notes = []
    if not isinstance(calibration, RigCalibration):
        notes.append(f"{calibration.method} maps pixels to positions: it has no cameras and no map of uncertainty.")
    elif lacking := [name for name in calibration.camera_names if name not in {row["name"] for row in cameras}]:
        notes.append(f"Cannot be drawn: {list_some(lacking)}.")
    if not len(known):
        notes.append("Cameras without known points: there is no box to map the uncertainty in.")
    return {
        "unit": calibration.data.length_unit,
        "name": calibration.data.name,
        "method": calibration.method,
        "placing": Placing.of(low, high, up_of(cameras)).table,
        "box": [low.tolist(), high.tolist()],
        "cameras": cameras,
        "grid": [ROWS, COLUMNS],
        "known": {
            "names": [str(name) for name in calibration.data.points],
            "xyz": known.tolist(),
            "state": [
                "not used" if name in unused else "a view was not used" if name in rejected else ""
                for name in map(str, calibration.data.points)
            ],
        },
        "maps": len(known) > 0 and isinstance(calibration, RigCalibration),
        "notes": notes,
    }  # fmt: skip


def uncertainty_map(instrument: Instrument) -> dict[str, Any]:
    """Standard uncertainties on a grid over the box of the known points.

    Args:
        instrument: The calibration.

    Returns:
        `axes`: x, y and z; `maps`: name -> values, x slowest, None where fewer than two cameras see the place.
    """
    parts = {"all sources": instrument.sd}
    for name, variance in zip(SOURCES, instrument.variance.T, strict=True):
        if np.nanmax(variance, initial=0.0) > 0:
            parts[name] = np.sqrt(np.maximum(variance, 0))
    return {
        "axes": [axis.tolist() for axis in instrument.axes],
        "maps": {name: json_safe(values.tolist()) for name, values in parts.items()},
    }


def measured_points(measurement: Measurement, unit: str) -> dict[str, Any]:
    """The points of a measurement that have a position.

    Args:
        measurement: In any unit.
        unit: That of the page.
    """
    if measurement.length_unit != unit:
        measurement = measurement.in_unit(unit)
    some = measurement.select(np.flatnonzero(measurement.measured))
    upper = some.cov[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return {
        "names": [str(name) for name in some.points],
        "xyz": some.xyz.tolist(),
        "cov": upper.tolist(),
        "views": some.views.tolist(),
        "consistency": json_safe(some.consistency.tolist()),
        "reason": [str(reason) for reason in some.reason],
        "missing": [
            [str(measurement.points[i]), str(measurement.reason[i]) or "no reason given"]
            for i in np.flatnonzero(~measurement.measured)
        ],
        "alarm": measurement.alarm,
    }


def _box(known: Floats, cameras: list[dict[str, Any]]) -> tuple[Floats, Floats]:
    """Around the known points; of cameras alone, around them and what is before them."""
    known = known[np.isfinite(known).all(axis=1)]
    if len(known) > 1:
        return known.min(axis=0), known.max(axis=0)
    places = [place for row in cameras for place in (row["picture"][0], row["centre"])]
    around = np.array([[value for value in place if value is not None] or [0, 0, 0] for place in places] or [[0, 0, 0]])
    middle = known[0] if len(known) else around.mean(axis=0)
    reach = max(float(np.abs(around - middle).max()), 1e-9)
    return middle - reach, middle + reach


def up_of(cameras: list[dict[str, Any]]) -> Floats:
    """(3,) which way is up in the world, as the pictures of cameras have it.

    Args:
        cameras: As `list_cameras` gives them.
    """
    up: list[Floats] = []
    along: list[Floats] = []
    for row in cameras:
        grid = np.array([[np.nan if v is None else v for v in place] for place in row["picture"]])
        grid = grid.reshape(ROWS + 1, COLUMNS + 1, 3)
        r, c = ROWS // 2, COLUMNS // 2
        for found, way in ((up, grid[r, c] - grid[r + 1, c]), (along, grid[r, c] - row["centre"])):
            found.append(way / max(float(np.linalg.norm(way)), 1e-300))
    good = np.isfinite(np.array(up).reshape(-1, 3)).all(axis=1) & np.isfinite(np.array(along).reshape(-1, 3)).all(
        axis=1
    )
    return upwards(np.array(up).reshape(-1, 3)[good], np.array(along).reshape(-1, 3)[good])


def list_cameras(calibration: object) -> list[dict[str, Any]]:
    """Name, lens, noise, centre, whether it is too far to be drawn, and the places of a grid over its picture.

    Args:
        calibration: By any method; one without cameras, or none, has none.
    """
    if not isinstance(calibration, RigCalibration):
        return []
    rig, described = calibration.map, calibration.cameras
    known = calibration.data.xyz[np.isfinite(calibration.data.xyz).all(axis=1)]
    size = float(np.linalg.norm(np.ptp(known, axis=0))) if len(known) > 1 else 0.0
    found = []
    for row, (c, name) in enumerate(zip(rig.cameras, rig.camera_names, strict=True)):
        bounds = image_bounds(rig.trained, c)
        if bounds is None:
            continue
        (u0, v0), (u1, v1) = bounds
        u, v = np.meshgrid(np.linspace(u0, u1, COLUMNS + 1), np.linspace(v0, v1, ROWS + 1))
        uv = np.column_stack([u.ravel(), v.ravel()])
        centre, rays = rig.lines_of_sight(name, uv)
        way = known.mean(axis=0) - centre if len(known) else None
        if way is not None:
            rays = _with_misfit(rig, name, uv, rays, way)
        place = _picture(centre, rays.reshape(ROWS + 1, COLUMNS + 1, 3), way, size)
        if place is None:
            continue
        picture, far = place
        lens = described[name].lens
        found.append(
            {
                "name": name,
                "lens": "no lens model" if lens is None else lens.family,
                "noise": float(rig.posterior.models[row].noise),
                "centre": centre.tolist(),
                "far": far,
                "picture": json_safe(picture.reshape(-1, 3).tolist()),
            }
        )
    return found


def _with_misfit(rig: FittedRig, name: str, uv: Floats, rays: Floats, way: Floats) -> Floats:
    """(n, 3) directions to what has its image at pixels, as far away as the known points.

    The lens alone says nothing of what its field adds; behind glass and water that is some per cent of the picture.

    Args:
        rig: The cameras.
        name: Of one.
        uv: (n, 2) pixels.
        rays: (n, 3) directions by the lens alone.
        way: (3,) from the camera to the middle of the known points.
    """
    c, found = rig.trained.camera_names.index(name), rays
    centre, _ = rig.lines_of_sight(name, uv[:1])
    side = np.sign(rays @ way)[:, None]
    aimed = uv
    for _ in range(MISFIT_ROUNDS):
        off = rig.predict(centre + np.linalg.norm(way) * side * found)[:, c] - uv
        aimed = np.where(np.isfinite(off), aimed - off, np.nan)
        _, found = rig.lines_of_sight(name, aimed)
    near = np.linalg.norm(aimed - uv, axis=1) < MAX_MISFIT * np.ptp(uv, axis=0).max()
    return np.where((near & np.isfinite(found).all(axis=1))[:, None], found, rays)


def _picture(centre: Floats, rays: Floats, way: Floats | None, size: float) -> tuple[Floats, bool] | None:
    """Where the grid of a camera's picture is drawn, and whether its centre is too far; None where nothing is finite.

    Args:
        centre: (3,) of the camera.
        rays: (rows, columns, 3) unit directions; NaN where nothing is seen.
        way: (3,) from it to the middle of the known points; None where there are none.
        size: Of the box of the known points; 0 where there is none.
    """
    middle = rays[rays.shape[0] // 2, rays.shape[1] // 2]
    good = rays[np.isfinite(rays).all(axis=2)]
    if not len(good) or not np.isfinite(centre).all():
        return None
    if not np.isfinite(middle).all():
        middle = good.mean(axis=0)
    if way is not None and middle @ way < 0:  # a projective camera does not know which end is the front
        rays, good, middle = -rays, -good, -middle
    across = float(np.linalg.norm(good - middle / np.linalg.norm(middle), axis=1).max())
    if way is None or size == 0:
        return centre + rays, False
    distance = float(np.linalg.norm(way))
    reach = min(PICTURE_SIZE * size / max(across, 1e-12), NEAREST_PICTURE * distance)
    far = reach < distance - FARTHEST * size
    return centre + max(reach, distance - FARTHEST * size) * rays, far
