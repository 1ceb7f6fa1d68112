"""How uncertain a placement will be: the cameras as drawn, known points, and forward-gp's own equations.

prediction = predict(build_rig("grid9", ...), known, places, lens_error=0.5)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from implicam.active import PredictedCovariance, Workspace
from implicam.calibrators.forward_gp import PlannedCamera, PlannedRig, plan_rig
from implicam.dataset import Floats
from implicam.errors import UsageError
from implicam.simulate import CAMERA_SETS, Placement, Rig, build_rig, error_process, placement_of
from implicam.simulate.camera import SimulatedCamera
from implicam.simulate.rigs import UNITS_PER_MM

Bools = NDArray[np.bool_]

MIN_NOISE_PX = 1e-3
"""Less noise than this no camera has."""


@dataclass(frozen=True, eq=False)
class Assumptions:
    """What is assumed of a rig that is not there yet.

    Attributes:
        noise: Standard deviation of a view in pixels, of cameras that the drawing says nothing of.
        lens_error: Root mean square in pixels of what no lens model contains.
        position_sd: Standard deviation of each coordinate of a known position, in the length unit; 0 for exact ones.
    """

    noise: float = 0.2
    lens_error: float = 0.5
    position_sd: float = 0.0

    def __post_init__(self) -> None:
        if not MIN_NOISE_PX <= self.noise < np.inf:
            raise UsageError(
                f"noise = {self.noise:g} px; a design needs at least {MIN_NOISE_PX:g} px.", fix="for example 0.2"
            )
        for what, value in (("lens_error", self.lens_error), ("position_sd", self.position_sd)):
            if not 0 <= value < np.inf:
                raise UsageError(f"{what} = {value:g}; it must be zero or more.", fix="for example 0.1")


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a placement will be worth.

    Attributes:
        rig: The cameras as drawn.
        assumed: What is assumed of it.
        known: (N, 3) the known points, in the frame and the unit of the drawing.
        places: (n, 3) evenly spread over the workspace.
        planned: What will be known of the cameras.
    """

    rig: Rig
    assumed: Assumptions
    known: Floats
    places: Floats
    planned: PlannedRig

    @cached_property
    def seen(self) -> Bools:
        """(n, C) which camera sees which place."""
        return views_of(self.rig, self.places)

    @cached_property
    def known_seen(self) -> Bools:
        """(N, C) which camera sees which known point."""
        return views_of(self.rig, self.known)

    @cached_property
    def predicted(self) -> PredictedCovariance:
        """The covariance at the places."""
        return self.at(self.places)

    @property
    def blind(self) -> float:
        """The part of the workspace that cannot be measured: fewer than two calibrated cameras see it, or only from one
        and the same place."""
        return float(np.mean(~self.predicted.measured))

    @property
    def uncalibrated(self) -> tuple[str, ...]:
        """Cameras that see too few known points."""
        return tuple(c.name for i, c in enumerate(self.rig.cameras) if i not in self.planned.numbers)

    def at(self, xyz: Floats) -> PredictedCovariance:
        """The covariance that positions would be measured with.

        Args:
            xyz: (n, 3) in the frame of the drawing.
        """
        seen = views_of(self.rig, xyz)
        return PredictedCovariance(self.planned.covariance(xyz, seen), lambda: self.planned.floor(xyz, seen))


def views_of(rig: Rig, xyz: Floats) -> Bools:
    """Which cameras see which places.

    Args:
        rig: The cameras.
        xyz: (n, 3) in the world.

    Returns:
        (n, C).
    """
    return np.stack([camera.pixel_from_world(xyz)[1] for camera in rig.cameras], axis=1)


def drawing_of(spec: str) -> tuple[Placement, str | None]:
    """The placement that a name or a file means, and which of its cameras; None for all of them.

    Args:
        spec: As `build_rig` takes it.

    Raises:
        UsageError: There is no such rig, or its file is wrong.
    """
    return (placement_of("bar6"), spec) if spec in CAMERA_SETS else (placement_of(spec), None)


def draw_rig(placement: Placement, assumed: Assumptions, unit: str | None = None, cameras: str | None = None) -> Rig:
    """The cameras exactly as drawn, in the frame of the drawing.

    Args:
        placement: The drawing.
        assumed: What is assumed of it.
        unit: Length unit; None for that of the drawing.
        cameras: As `build_rig` takes them.

    Raises:
        UsageError: The drawing does not say what its cameras watch.
    """
    return build_rig(
        placement,
        seed=0,
        lens_error=0.0,
        noise=assumed.noise,
        frame="bench",
        unit=unit,  # type: ignore[arg-type]
        cameras=cameras,
        as_drawn=True,
    )


def set_workspace(placement: Placement, workspace: Workspace, unit: str) -> Placement:
    """A placement whose cameras watch the box around a workspace.

    Args:
        placement: The drawing.
        workspace: In the frame of the drawing.
        unit: Length unit of the workspace.
    """
    mm = 1 / UNITS_PER_MM[unit]
    low, high = mm * workspace.vertices.min(axis=0), mm * workspace.vertices.max(axis=0)
    return replace(placement, size=high - low, centre=(low + high) / 2)


def predict(rig: Rig, assumed: Assumptions, known: Floats, places: Floats) -> Prediction:
    """What a rig will be worth after known points.

    Args:
        rig: The cameras as drawn.
        assumed: What is assumed of it.
        known: (N, 3) the known points, in the world of the rig.
        places: (n, 3) where it is judged.

    Raises:
        FitError: Fewer than two cameras would see enough known points.
    """
    cameras = [planned_camera(camera, assumed.lens_error) for camera in rig.cameras]
    planned = plan_rig(cameras, known, views_of(rig, known), assumed.position_sd)
    return Prediction(rig, assumed, known, places, planned)


def planned_camera(camera: SimulatedCamera, lens_error: float) -> PlannedCamera:
    """A camera as `plan_rig` takes it.

    Args:
        camera: As drawn.
        lens_error: Root mean square in pixels of what no lens model contains.

    Raises:
        UsageError: It has no noise.
    """
    if camera.noise_sd < MIN_NOISE_PX:
        raise UsageError(
            f"{camera.name} has a noise of {camera.noise_sd:g} px; a design needs at least {MIN_NOISE_PX:g} px.",
            fix="correct noise in its drawing, for example noise = 0.2",
        )
    sd, reach = error_process(camera.width, camera.height, lens_error)
    return PlannedCamera(
        camera.name, camera.width, camera.height, camera.lens, camera.camera_from_world, camera.noise_sd, sd, reach
    )
