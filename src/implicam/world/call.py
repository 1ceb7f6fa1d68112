"""`implicam.set_world(...)`: what `implicam world` does, as one call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from implicam.calibrators import Calibration
from implicam.calibrators.protocol import PlacesItsWorld
from implicam.dataset import Dataset
from implicam.errors import UsageError
from implicam.world.axes import Axes, by_axes, flight
from implicam.world.known_points import by_known_points


def set_world(
    calibration: Calibration,
    data: Dataset | None = None,
    *,
    origin: str = "",
    x: str | Sequence[str] = (),
    y: str = "",
    plane: Sequence[str] = (),
    down: Sequence[str] = (),
    falling: str = "",
    camera: str = "",
) -> PlacesItsWorld:
    """The calibration with its world where something says; for one made without known positions, as from a wand.

    `data` with known positions: these are in the world, three or more that are not on one line, as the markers of an
    L-frame. Without: names of its points say where axes and planes are. What nothing is said of stays as it was, as far
    as that goes. A marker seen in several frames has stood still.

    Args:
        calibration: Made without known positions.
        data: What the cameras saw of these points.
        origin: The point at the origin.
        x: A point on the x axis, seen from the origin; or two, from the one to the other.
        y: A point on the side of the xy plane where y is positive.
        plane: Three points or more of the plane z = 0; z points to the cameras' side.
        down: Two points or more of a plumb line, from top to bottom: z points up.
        falling: A marker of a thing that was dropped or thrown, in frames at equal times: z points up, against what
            bends its way.
        camera: Its centre is the origin, its axes are x (right), y (down) and z (forward).

    Returns:
        The same calibration, which measures in this world; its first note says where that is.

    Raises:
        UsageError: The calibration has a world from its known positions, or what is given says no world.
        DatasetError: A point is not there or cannot be measured.
        FitError: The points lie on one line, are as in a mirror, or their distances contradict the calibration.

    >>> import implicam as ic
    >>> waved = ic.ForwardGP(wand=96).fit(ic.read_dataset("my-wand"))  # doctest: +SKIP
    >>> in_world = ic.set_world(waved, ic.read_dataset("l-frame"))  # doctest: +SKIP
    >>> on_floor = ic.set_world(waved, ic.read_dataset("floor"), plane=["a", "b", "c"], x=["a", "b"])  # doctest: +SKIP
    """
    if not (isinstance(calibration, PlacesItsWorld) and calibration.free_world):
        raise UsageError(
            f"the world of this calibration by {calibration.method} is that of its known positions.",
            why="another one can be set where no known position was used, as from a wand",
            fix="calibrate with known positions of that world; or move what it measures: measurement.transformed(pose)",
        )
    axes = Axes(origin, (x,) if isinstance(x, str) and x else tuple(x), y, tuple(plane), tuple(down))
    if camera:
        if data is not None or axes.named or falling:
            raise UsageError("the world of a camera takes no points.", fix="leave them out, or the camera")
        return calibration.in_world_of_camera(camera)
    if data is None:
        raise UsageError(
            "nothing says where the world is.",
            fix="give what the cameras saw of an L-frame, of known points, or of points on axes, a plane or a plumb "
            "line; or name a camera",
        )
    if falling:
        points, times = flight(data, falling, down)
        axes = replace(axes, down=points, times=times)
    middle = calibration.data.xyz.mean(axis=0)
    laid = by_axes(calibration, data, axes, middle) if axes.named else by_known_points(calibration, data, middle)
    return calibration.in_world(laid.placement, laid.told)
