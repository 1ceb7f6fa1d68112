"""Cameras of a calibration for other programs, and a calibration from cameras that another program calibrated."""

from __future__ import annotations

import numpy as np

from implicam.calibrators.explicit.calibration import Explicit, ExplicitCalibration
from implicam.calibrators.explicit.fitted import Fitted, posterior_of
from implicam.calibrators.explicit.lenses import Choice
from implicam.calibrators.protocol import Calibration, RigCalibration
from implicam.dataset import Camera, Dataset, KnownPositions, Observations
from implicam.errors import UsageError
from implicam.exchange import UNKNOWN_UNIT, ExplicitCamera, Rig
from implicam.geometry import Floats, Pose
from implicam.rig_model import (
    CentralCamera,
    Frame,
    Image,
    InitialCamera,
    Prior,
    lens_only_model,
)


def rig_of(calibration: Calibration) -> tuple[Rig, list[str]]:
    """The cameras of a calibration for other programs.

    Args:
        calibration: Of any method.

    Returns:
        The cameras, and notes on what is lost: forward-gp's lenses are fitted to all that it predicts, without its
        field.

    Raises:
        UsageError: The method has no cameras, or one of them has no lens that a file could hold.
    """
    if not isinstance(calibration, RigCalibration):
        raise UsageError(
            f"{calibration.method} has no cameras that could be exported.",
            why="it learns the map from pixels to positions as a whole",
            fix="calibrate the same data with --method explicit; or, by inverse-gp, --to onnx",
        )
    notes, cameras = [], []
    for camera in calibration.cameras.values():
        if camera.lens is None or camera.camera_from_world is None:
            raise UsageError(
                f"{camera.name} {camera.note}, and no camera file can say so.",
                why="other programs know lenses that see the world as it is",
                fix="calibrate the same data with --method explicit; or --to onnx or --to cpp, which hold every camera",
            )
        notes += [f"{camera.name}: {camera.note}"] if camera.note else []
        cameras.append(ExplicitCamera(camera.name, camera.width, camera.height, camera.lens, camera.camera_from_world))
    return Rig(tuple(cameras), calibration.map.length_unit), notes


def calibration_of(rig: Rig, name: str, noise: float) -> ExplicitCalibration:
    """A calibration that measures with the cameras of another program.

    Nothing is known of how well they are calibrated: the error bars are those of the pixels alone, and a note says so.

    Args:
        rig: The cameras.
        name: Of the calibration's dataset.
        noise: Of views that do not state theirs, pixels.

    Returns:
        The calibration, without known points.

    Raises:
        UsageError: There is one camera, or the length unit is not known.
    """
    if len(rig.cameras) < 2:
        raise UsageError("there is one camera; a position takes two.", fix="give the file of the whole rig")
    if rig.length_unit == UNKNOWN_UNIT:
        raise UsageError(
            "the file does not say what its lengths are in.", fix="state the unit of the cameras' places: --unit mm"
        )
    described = tuple(Camera(camera.name, camera.width, camera.height) for camera in rig.cameras)
    none = np.full((0, len(described), 2), np.nan)
    seen = Observations(np.zeros(0, dtype=np.str_), described, none, none)
    known = KnownPositions(np.zeros(0, dtype=np.str_), np.zeros((0, 3)), np.zeros((0, 3)))
    frame = _frame(rig)
    models = tuple(
        lens_only_model(InitialCamera(*_working(camera, frame), np.zeros(0, dtype=np.bool_)), _image(camera), noise)
        for camera in rig.cameras
    )
    fitted = Fitted(
        seen,
        frame,
        tuple(range(len(described))),
        posterior_of(models, np.zeros((1, sum(model.camera.size for model in models)))),
        tuple(Choice(model.camera.lens.family, {}) for model in models if isinstance(model.camera, CentralCamera)),
        np.zeros((0, 3)),
        np.zeros((0, 3)),
        (),
        (),
        (
            "The cameras were calibrated elsewhere, and nothing is known of how well: error bars hold the noise of the "
            f"pixels only ({noise:g} px where a view states none). Check them: implicam evaluate FILE DATASET.",
            *rig.notes,
        ),
        alone=True,
    )
    return ExplicitCalibration(Explicit(), Dataset(name, rig.length_unit, seen, known), fitted)


def _frame(rig: Rig) -> Frame:
    centres = np.array([camera.camera_from_world.centre for camera in rig.cameras])
    offset = centres.mean(axis=0)
    return Frame(offset, float(np.sqrt(np.mean((centres - offset) ** 2))) or 1.0)


def _working(camera: ExplicitCamera, frame: Frame) -> tuple[CentralCamera, Prior]:
    pose = camera.camera_from_world
    there = (pose.rotation @ frame.offset + pose.translation) / frame.scale
    central = CentralCamera(camera.lens, Pose(pose.rotation, there))
    return central, Prior(np.zeros(central.size), np.zeros((central.size, central.size)))


def _image(camera: ExplicitCamera) -> Image:
    if camera.width is None or camera.height is None:
        centre: Floats = np.array([camera.lens.cx, camera.lens.cy])
        return Image(centre, float(max(*centre, 1.0)))
    return Image(np.array([camera.width - 1, camera.height - 1]) / 2, max(camera.width, camera.height) / 2)
