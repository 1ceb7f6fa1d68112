"""Calibrated cameras as other programs describe them: a lens and a pose in the world."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from implicam.geometry import Floats, Pose
from implicam.lenses import Lens, focal_lengths
from implicam.rig_model import (
    CameraModel,
    CentralCamera,
    FittedRig,
    Frame,
    GeneralCamera,
    Prior,
    levenberg_marquardt,
)

DRAWN_POSITIONS = 2000
"""In the workspace, at which a lens is fitted to what forward-gp predicts."""

MAX_LOSS_PX = 0.01
"""What a lens may lose without a note."""

MAX_IMAGE_HALVES = 1.2
"""Pixels are compared up to so far off the middle of the image."""


@dataclass(frozen=True, eq=False)
class FittedCamera:
    """One camera of a calibration.

    Attributes:
        name: Its name.
        width: Of its pictures, pixels; None where not known.
        height: Of its pictures, pixels; None where not known.
        lens: Its lens; of forward-gp, the nearest to all that it learned. None for a camera that no lens describes.
        camera_from_world: Its pose in the world frame of the known positions, in their length unit; None without a
            lens.
        note: What the lens does not hold of what was learned, or why there is none; empty where it holds all.
    """

    name: str
    width: int | None
    height: int | None
    lens: Lens | None
    camera_from_world: Pose | None
    note: str = ""

    def as_table(self) -> dict[str, Any]:
        """As plain values; a rotation is the rows of camera_from_world, a centre is in the world."""
        table: dict[str, Any] = {"name": self.name}
        if self.lens is not None and self.camera_from_world is not None:
            names = [field.name for field in fields(self.lens)][4:]
            table |= {
                "lens": self.lens.family,
                "focal_length_px": list(focal_lengths(self.lens)),
                "principal_point_px": [self.lens.cx, self.lens.cy],
                "distortion": {name: float(getattr(self.lens, name)) for name in names},
                "centre": self.camera_from_world.centre.tolist(),
                "rotation": self.camera_from_world.rotation.tolist(),
            }
        return table | ({"note": self.note} if self.note else {})


def fitted_cameras(rig: FittedRig, known: Floats) -> Iterator[FittedCamera]:
    """The calibrated cameras of a rig.

    Args:
        rig: The cameras.
        known: (n, 3) known positions in the world, about which a lens is fitted where a camera has more than a lens.
    """
    for number, c in enumerate(rig.cameras):
        described, model = rig.trained.cameras[c], rig.posterior.models[number]
        of = described.name, described.width, described.height
        camera = model.camera
        if isinstance(camera, GeneralCamera) and not camera.mirrored:
            camera = camera.as_central()
        if not isinstance(camera, CentralCamera):
            what = "sees a mirror image" if isinstance(camera, GeneralCamera) else "has no lens model"
            yield FittedCamera(*of, None, None, what)
            continue
        note = ""
        if len(model.field.inducing) and len(known):  # forward-gp; cameras of another program have no known points
            camera, note = _nearest(model, rig.frame.to_working(known), camera)
        yield FittedCamera(*of, camera.lens, world_pose(camera.pose, rig.frame), note)


def world_pose(pose: Pose, frame: Frame) -> Pose:
    """The pose in the world of a camera of the working frame: the inverse of its offset and scale.

    Args:
        pose: camera_from_working.
        frame: The working frame.

    Returns:
        camera_from_world, in the world's length unit.
    """
    return Pose(pose.rotation, pose.translation * frame.scale - pose.rotation @ frame.offset)


def _nearest(model: CameraModel, points: Floats, camera: CentralCamera) -> tuple[CentralCamera, str]:
    """The lens and place that come nearest to what forward-gp predicts around points, and the cost in pixels."""
    low, high = points.min(axis=0), points.max(axis=0)
    drawn = np.random.default_rng(0).uniform(low, high, size=(DRAWN_POSITIONS, 3))
    uv = model.predict(drawn)[0]
    near = np.abs(uv - model.image.centre) <= MAX_IMAGE_HALVES * model.image.half
    seen = np.isfinite(uv).all(axis=1) & near.all(axis=1)
    drawn, uv = drawn[seen], uv[seen]
    nothing = Prior(camera.parameters, np.zeros((camera.size, camera.size)))
    fitted = levenberg_marquardt(camera, nothing, drawn, uv, 0.1)
    assert isinstance(fitted, CentralCamera)
    off = np.linalg.norm(fitted.pixel(drawn) - uv, axis=1)
    if np.nanmax(off) < MAX_LOSS_PX:
        return fitted, ""
    return fitted, (
        f"a lens model cannot hold all that forward-gp has learned: {np.sqrt(np.nanmean(off**2)):.2g} px rms are lost, "
        f"at most {np.nanmax(off):.2g} px"
    )
